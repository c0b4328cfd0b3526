"""What filters, their states, gates, error states and setups refuse: a call, and the argument that is named."""

from dataclasses import replace

import numpy as np
import pytest
from measured import EVERY_KIND, record_of, resting, sample, series_of

import strapdown as sd
from strapdown import estimation, records, scenarios
from strapdown.checks import InputError
from strapdown.estimation import LiveFilter, error_states, filters, multiple_model, setup
from strapdown.estimation.error_states import BoundedVelocity, GaussMarkov, GyroForce, GyroScale, LeverArm, VectorBias
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.model import assemble
from strapdown.estimation.setup import FilterSetup, states
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.estimation.states import ProcessNoise, initial_state
from strapdown.estimation.step_filter import StepFilter
from strapdown.gyro import GyroSpec
from strapdown.vectors import VectorMeasurements, VectorSensor

X, Y, UP = np.eye(3)
IDENTITY = (1.0, 0.0, 0.0, 0.0)
NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
SERIES = series_of("s", "direction", [0.5], [X], X, 0.1)
RECORD = resting(SERIES)
SETUP = FilterSetup(process_noise=NOISE, bias_sigma=1e-5)
SENSOR = VectorSensor(name="up", reference_f=UP, sigma=1e-2, rate=10.0)
TRACKER = VectorMeasurements(
    sensor="tracker", kind="attitude", time=[0.5], attitude=[IDENTITY], sigma_axes=[[1e-3] * 3]
)
HUGE = 10**400


def noise(**changes):
    return ProcessNoise(**{"angle_random_walk": 1e-4, "rate_random_walk": 0.0, **changes})


def start(**changes):
    return initial_state(**{"attitude": IDENTITY, "attitude_sigma": 0.1, "bias_sigma": 1e-3, **changes})


def state(**changes):
    return estimation.State(**{"attitude": np.array(IDENTITY), "bias": np.zeros(3), "covariance": np.eye(6), **changes})


def markov(**changes):
    return GaussMarkov(**{"sensor": "mag", "noise_sigma": 1.0, "correlation_time": 1.0, **changes})


def velocity(**changes):
    return BoundedVelocity(
        sensor="acc", **{"velocity_time": 1.0, "velocity_sigma": 1.0, "acceleration_time": 1.0, **changes}
    )


def block_of(n=1, base=error_states.ErrorStates, **fields):
    """Return a block of another package."""
    properties = {name: property(lambda self, value=value: np.asarray(value)) for name, value in fields.items()}
    names = {"name": "x", "components": tuple("abcd"[:n]), "units": ("1",) * n, "sigma": np.ones(n)}
    return type("Foreign", (base,), {**names, **properties})()


def foreign(**fields):
    assemble((block_of(**fields),), {"acc": "vector"})


class Lopsided(BoundedVelocity):
    """Chains that differ by axis."""

    @property
    def decay(self):
        return super().decay * np.array([1.0, 1.0, 1.0, 1.0, 1.0, 2.0])


def run(blocks=(), initial=None, **options):
    record = record_of(duration=1.0, anisotropic=True)
    return estimation.run(record, NOISE, initial or start(), blocks, **options)


def with_lever(record):
    filter_setup = replace(SETUP, states=States(sensors={"force": SensorStates(lever_arm_sigma=0.1)}))
    return setup.run(record, filter_setup, start())


def uneven():
    record = record_of()
    return replace(record, time=np.where(np.arange(len(record.time)) > 99, record.time + 0.01, record.time))


def measured(**changes):
    """Run the filter over a direction with this noise."""
    arguments = {"kind": "direction", "time": [0.1], "vector_b": [X], "reference_f": X}
    estimation.run(resting(VectorMeasurements(sensor="sun", **arguments, **changes)), NOISE, start())


def predicted(**arguments):
    f = StepFilter(NOISE, start())
    try:
        f.predict(**{"delta_theta": np.zeros(3), **arguments})
    finally:
        assert np.array_equal(f.P, start().covariance)


def given_live(**arguments):
    """Give a sample to a live filter, which stays as it was if it refuses it."""
    live = LiveFilter(NOISE, start(), sensors=[SENSOR], look_back=1.0)
    live.update(0.1, (0.0, 0.0, 0.1), up=(0.0, 0.1, 1.0))
    before = live.state()
    try:
        live.update(**{"time": 0.2, "gyro": (0, 0, 0), **arguments})
    finally:
        for part in ("attitude", "bias", "covariance"):
            assert np.array_equal(getattr(live.state(), part), getattr(before, part))
        assert (live.time, live.skipped) == (0.1, {"up": 0})


def live(sensors):
    return LiveFilter(NOISE, start(), sensors=sensors)


def stepped(blocks=(), update=None, k=0, **options):
    f = StepFilter(NOISE, start(), blocks, **options)
    if update is not None:
        f.update(update, k)


def banked(**options):
    return multiple_model.run(RECORD, NOISE, **options)


def tabled(**table):
    return states.from_table(table, "f.toml: filter: states")


def tabled_sensor(**table):
    return states.from_table({"sensors": {"mag": table}}, "f.toml: filter: states")


def setup_from(**table):
    return setup.from_table(table)


def changed_setup(**changes):
    return replace(SETUP, **changes)


MAG_BIAS = VectorBias(sensor="mag", bias_sigma=1.0)
UP_SAMPLE = sample("direction", X, X, 0.1, "up")
TABLE = [
    (noise, {"angle_random_walk": 0.0}, "angle_random_walk"),
    (noise, {"angle_random_walk": 1e200}, "angle_random_walk is 1e+200"),
    (noise, {"rate_random_walk": -1e-9}, "rate_random_walk"),
    (noise, {"rate_random_walk": 1e10}, "rate_random_walk is"),
    (start, {"attitude": (1.0, 0.1, 0.0, 0.0)}, "norm"),
    (start, {"attitude": [1.0, 0.0, [0.0], 0.0]}, "is not an array of numbers"),
    (start, {"bias": [0.0, [0.0], 0.0]}, "is not an array of numbers"),
    (start, {"bias_sigma": [1.0, 0.0, 1.0]}, "bias_sigma[1]"),
    (start, {"bias_sigma": [1.0, 2.0]}, "bias_sigma has shape (2,)"),
    (start, {"attitude_sigma": [1.0, 2.0]}, "attitude_sigma has shape (2,)"),
    (start, {"attitude_sigma": "1°"}, "attitude_sigma is not"),
    (start, {"attitude_sigma": [1.0, 3.2, 1.0]}, "attitude_sigma is 3.2 rad; no attitude error is larger than π"),
    (state, {"covariance": np.eye(6) - 0.3 * np.ones((6, 6))}, "positive definite"),
    (Gate, {"probability": 1.0}, "between 0 and 1"),
    (Gate, {"recovery": 1}, "recovery"),
    (Gate, {"restart_attitude_sigma": 0.0}, "restart_attitude_sigma"),
    (Gate, {"restart_attitude_sigma": 3.2}, "restart_attitude_sigma is 3.2 rad"),
    (Gate, {"restart_bias_sigma": 0.0}, "restart_bias_sigma"),
    (Robust, {"kind": "hubert"}, "'huber'"),
    (Robust, {"degrees_of_freedom": 0.0}, "degrees_of_freedom"),
    (Robust, {"iterations": 0}, "iterations"),
    # Error states.
    (GyroScale, {"scale_sigma": np.zeros(3), "misalignment_sigma": np.zeros((3, 3))}, "misalignment_sigma are both 0"),
    (
        GyroScale,
        {"scale_sigma": 0.01, "misalignment_sigma": np.triu(np.ones((3, 3)), 1), "symmetric": True},
        "misalignment_sigma of xy is 1, of yx 0",
    ),
    (GyroScale, {"scale_sigma": 0.01, "misalignment_sigma": 0.01, "symmetric": "false"}, "symmetric is 'false'"),
    (GyroForce, {"along_sigma": 0.0}, "along_sigma and across_sigma are both 0"),
    (LeverArm, {"sensor": "acc", "arm_sigma": 0.0}, "arm_sigma is 0"),
    (LeverArm, {"sensor": "acc", "arm_sigma": [0.1, -1.0, 0.0]}, "arm_sigma[1] is -1 m"),
    (VectorBias, {"sensor": "mag", "bias_sigma": [1.0, -1.0, 1.0]}, "bias_sigma[1] is -1"),
    (markov, {"correlation_time": -1.0}, "correlation_time is -1 s"),
    (markov, {"frame": "bodi"}, "'body'"),
    (markov, {"noise_sigma": [1.0, 2.0, 1.0], "frame": "fixed"}, "differs by axis"),
    (velocity, {"velocity_time": 0.0}, "velocity_time is 0 s"),
    (velocity, {"velocity_sigma": -1.0}, "velocity_sigma is -1"),
    (velocity, {"acceleration_time": 0.0}, "acceleration_time is 0 s"),
    (velocity, {"position_time": np.nan}, "position_time is nan"),
    (velocity, {"strength": 0.0}, "strength is 0"),
    (foreign, {"n": 2, "feed": [1.0, 1.0]}, "no state follows it"),
    (foreign, {"n": 4, "feed": [1.0, 1.0, 1.0, 0.0]}, "a chain has at most 3"),
    (foreign, {"n": 2, "feed": [1.0, 0.0], "gyro_offset": np.eye(3)[:2]}, "enters the gyro"),
    (foreign, {"n": 2, "feed": [1.0, 0.0, 0.0]}, "feed"),
    (lambda: run((block_of(sigma=np.zeros(1)),)), {}, "sigma[0] is 0"),
    (lambda: run((block_of(units=()),)), {}, "0 units for 1"),
    (
        lambda: assemble(
            (Lopsided(sensor="acc", velocity_time=0.3, velocity_sigma=0.5, acceleration_time=0.1),), {"acc": "vector"}
        ),
        {},
        "axes x, y and z, in this order",
    ),
    (run, {"blocks": (VectorBias(sensor="mga", bias_sigma=1.0),)}, "'mag'"),
    (run, {"blocks": (MAG_BIAS,) * 2}, "are named 'mag bias'"),
    (run, {"blocks": ("mag",)}, "declares no error states"),
    (run, {"blocks": (error_states.SensorMounting(sensor="tracker", mounting_sigma=0.1),)}, "whole attitudes"),
    (
        run,
        {"initial": estimation.with_error_states(start(), (MAG_BIAS,)), "blocks": EVERY_KIND},
        "initial has 3 error states",
    ),
    (run, {"every": 0}, "every is 0"),
    (lambda: estimation.observability(RECORD, NOISE, start(), threshold=0.0), {}, "threshold is 0"),
    (lambda: estimation.with_error_states(start(), MAG_BIAS), {}, "give a tuple"),
    (lambda: replace(RECORD, vectors=SERIES), {}, "(series,)"),
    (lambda: resting(X), {}, "vectors[0] is"),
    (lambda: records.compress(RECORD, "two-samples"), {}, "'two-sample'"),
    (run, {"every": 1.5}, "every is 1.5"),
    (measured, {"sigma": 0.0}, "sun: sigma[0] is 0 rad"),
    (measured, {"sigma_axes": [0.0, 1.0, 1.0]}, "sun: sigma_axes[0] has a 0"),
    (measured, {"covariance": np.diag([0.0, 1.0, 1.0])}, "sun: covariance[0] is singular"),
    (lambda: filters.compare(RECORD, NOISE, start(), filters=()), {}, "filters is empty"),
    (lambda: filters.compare(RECORD, NOISE, start(), filters=["mefk"]), {}, "'mekf'"),
    (banked, {"bias_sigma": [1.0, 2.0]}, "bias_sigma has shape (2,)"),
    (banked, {"bias_sigma": [1.0, 0.0, 1.0]}, "bias_sigma[1]"),
    (banked, {"bias_sigma": -1.0}, "bias_sigma"),
    (banked, {"hypotheses": 4}, "hypotheses"),
    (banked, {"every": 200}, "stored edge"),
    (lambda: multiple_model.run(resting(), NOISE), {}, "no direction"),
    # Step by step.
    (predicted, {"dt": -0.1}, "dt is -0.1 s"),
    (predicted, {"dt": 0.0, "delta_theta": [0.1, 0.0, 0.0]}, "dt is 0 s"),
    (predicted, {"dt": 0.1, "delta_theta": [0.0, np.nan, 0.0]}, "delta_theta[1] is nan"),
    (predicted, {"dt": 0.01, "delta_theta": [0.0, 1e200, 0.0]}, "too large for the rotation"),
    (predicted, {"dt": 0.01, "delta_theta": [0.0, -2e6, 0.0]}, "too large for the rotation"),
    (stepped, {"update": np.array([0.5, 0.0])}, "not of class VectorMeasurements"),
    (stepped, {"update": UP_SAMPLE, "k": 1}, "k is 1, but the series of up has 1 samples"),
    (stepped, {"update": UP_SAMPLE, "k": -1}, "k is -1"),
    (lambda: StepFilter(NOISE, start()).predict_update(X, lambda x: X), {}, "not of class VectorMeasurements"),
    (stepped, {"blocks": MAG_BIAS}, "give a tuple"),
    (
        stepped,
        {"blocks": (MAG_BIAS,), "sensors": ("acc", "Mag"), "update": sample("direction", X, X, 0.1, "mag")},
        "'Mag'",
    ),
    (stepped, {"blocks": (MAG_BIAS,), "sensors": "mag"}, "sensors is 'mag'"),
    (stepped, {"sensors": "mag"}, "sensors is 'mag'"),
    (stepped, {"blocks": (MAG_BIAS,), "sensors": ("mag",), "update": sample("direction", X, X, 0.1, "up")}, "'up'"),
    # Live.
    (given_live, {"time": 0.05}, "time is 0.05 s, before"),
    (given_live, {"gyro": None}, "time is 0.2 s, after"),
    (given_live, {"time": np.nan}, "time is nan s"),
    (given_live, {"time": HUGE}, "time is 1"),
    (given_live, {"gyro": (0, 0)}, "gyro is (0, 0)"),
    (given_live, {"gyro": (0, np.nan, 0)}, "gyro has a NaN"),
    (given_live, {"gyro": (0, np.inf, 0)}, "gyro is (0, inf, 0)"),
    (given_live, {"gyro": (0, 1e9, 0)}, "too large for the rotation"),
    (given_live, {"gyro": (0, HUGE, 0)}, "gyro is (0, 1"),
    (given_live, {"delta_theta": (0, 0, 0)}, "both gyro and delta_theta"),
    (given_live, {"down": (0, 0, 1)}, "sensor 'down'"),
    (given_live, {"up": (0, 0, -np.inf)}, "up is (0, 0, -inf)"),
    (given_live, {"up": "abc"}, "up is 'abc'"),
    (given_live, {"up": (0, 0, 0)}, "up is (0, 0, 0)"),
    (given_live, {"up": (HUGE, 0, 0)}, "up is (1"),
    (given_live, {"up": UP, "sigma": {"up": 0.0}}, "up: sigma is 0"),
    (given_live, {"up": UP, "sigma": {"up": HUGE}}, "up: sigma is 1"),
    (given_live, {"up": UP, "sigma": {"up": 1e200}}, "up: sigma is 1e+200, whose square"),
    (given_live, {"up": UP, "sigma": {"up": 1e-162}}, "up: sigma is 1e-162, whose"),
    (given_live, {"up": UP, "sigma": {"up": 1e-12}}, "as precise as the state"),
    (given_live, {"time": 0.05, "gyro": None, "up": UP, "sigma": {"up": 1e-12}}, "as precise as the state"),
    (given_live, {"sigma": {"down": 0.1}}, "sensor 'down'"),
    (given_live, {"up": UP, "reference_f": {"up": (0, 0, 0)}}, "up: reference_f"),
    (live, {"sensors": [SENSOR, SENSOR]}, "a name twice: up, up"),
    (live, {"sensors": ["up"]}, "give vectors.VectorSensor"),
    (live, {"sensors": SENSOR}, "give a list of sensors"),
    (live, {"sensors": [replace(SENSOR, name="gyro")]}, "named 'gyro'"),
    (live, {"sensors": [SERIES.taken(slice(0))]}, "the series is empty"),
    (lambda: live([SENSOR]).update(1e12, (0.0, 0.0, 0.1)), {}, "time is that of the initial state"),
    (lambda: live([TRACKER]).update(0.1, (0.0, 0.0, 0.1), tracker=(2.0, 0.0, 0.0, 0.0)), {}, "tracker has norm 2"),
    (lambda: live([TRACKER]).update(0.1, (0.0, 0.0, 0.1), tracker=(1.0, 0.0, 0.0)), {}, "wanted (4,)"),
    # Setups and their tables.
    (tabled, {"gyro_scale_sigma_pmm": 1.0}, "'gyro_scale_sigma_ppm'"),
    (tabled, {"gyro_scale_sigma_ppm": [1.0, 2.0]}, "gyro_scale_sigma has shape (2,)"),
    (tabled, {"gyro_scale_sigma_ppm": -5.0}, "must not be negative"),
    (tabled, {"gyro_misalignment_sigma_mrad": [[1.0, 0, 0], [0, 0, 0], [0, 0, 0]]}, "on its diagonal"),
    (tabled, {"gyro_drift_sigma_deg_per_hour": [1.0]}, "1 entries and gyro_drift_time 0"),
    (tabled, {"gyro_drift_sigma_deg_per_hour": [1.0], "gyro_drift_time_s": [0.0]}, "gyro_drift_time[0] is 0 s"),
    (tabled, {"gyro_force_sigma_deg_per_hour_per_g": 1.0, "gravity_f_m_per_s2": [0, 0, 0]}, "free fall"),
    (tabled, {"sensors": 3}, "a table of tables"),
    (tabled, {"sensors": {"mag": 3}}, "mag is 3"),
    (tabled_sensor, {"bias_sigm": 1.0}, "'bias_sigma'"),
    (tabled_sensor, {"bias_sigma": [1.0, 0.0, 1.0]}, "above zero for every axis"),
    (tabled_sensor, {"correlated_sigma": 1.0}, "both above zero"),
    (tabled_sensor, {"correlated_sigma": 1.0, "correlation_time_s": 1.0, "frame": "bodi"}, "'body'"),
    (tabled_sensor, {"varying": 1}, "varying is 1"),
    (tabled_sensor, {"velocity_time_s": 0.3}, "velocity_sigma is 0 m/s"),
    (tabled_sensor, {"velocity_sigma_m_per_s": 0.3}, "velocity_time is 0 s"),
    (tabled_sensor, {"velocity_time_s": -0.3}, "velocity_time is -0.3 s"),
    (tabled_sensor, {"velocity_sigma_m_s": 0.3}, "'velocity_sigma_m_per_s'"),
    (States, {"sensors": {"mag": {}}}, "must be SensorStates"),
    (lambda: States(gyro_scale_sigma=1.0).select(("gyro.scael",)), {}, "'gyro.scale'"),
    (lambda: States().select(("gyro.scale",)), {}, "scale_factor_ppm"),
    (
        lambda: States(
            sensors={"a": SensorStates(velocity_time=1.0, velocity_sigma=1.0, acceleration_time=1.0)}
        ).blocks({"a": "heading"}),
        {},
        "a: velocity_time needs an accelerometer",
    ),
    (
        lambda: setup.run(RECORD, replace(SETUP, states=States(sensors={"t": SensorStates(bias_sigma=1.0)})), None),
        {},
        "'t'",
    ),
    (lambda: with_lever(uneven()), {}, "equal gyro intervals"),
    (lambda: with_lever(record_of(duration=1.0)), {}, "needs 100"),
    (setup_from, {"bias_sigma_deg_per_hour": 1.0}, "angle_random_walk_deg_per_sqrt_hour is missing"),
    (
        setup_from,
        {"angle_random_walk_deg_per_sqrt_hour": 0.1, "rate_random_walk_rad_per_s_per_sqrt_s": 0.0},
        "bias_sigma",
    ),
    (setup_from, {"angle_random_walk_deg_per_hour": 0.1}, "angle_random_walk_deg_per_sqrt_hour"),
    (setup_from, {"integration": "four"}, "four-sample"),
    (setup_from, {"sigma": 3.0}, "must be a table"),
    (setup_from, {"sigma": {"star": "big"}}, "sigma: star"),
    (setup_from, {"sigma": {"star": [1e-4, 1e-4]}}, "star has 2 numbers"),
    (setup_from, {"sigma": {"star": [1e-4, 1e-4, "1e-4"]}}, "star: z is '1e-4'"),
    (setup_from, {"gate": 0.99}, "must be a table"),
    (setup_from, {"gate": {"probabilty_ratio": 0.9}}, "probability_ratio"),
    (setup_from, {"robust": {"kind": "hubr"}}, "huber"),
    (changed_setup, {"states": {}}, "states is {}, not of class States"),
    (changed_setup, {"attitude_sigma": 0.0}, "greater than zero"),
    (changed_setup, {"attitude_sigma": 8.7}, "attitude_sigma is 8.7 rad"),
    (changed_setup, {"bias_sigma": -1.0}, "greater than zero"),
    (changed_setup, {"sigma": {"star": 0.0}}, "greater than zero"),
    (changed_setup, {"sigma": {"star": (1e-4, 0.0, 1e-4)}}, "greater than zero"),
    (changed_setup, {"integration": "four-sample"}, "integration is"),
    (changed_setup, {"process_noise": 1e-4}, "process_noise is"),
    (sd.covariance_analysis, {"scenario": "spin", "setup": "mine"}, "setup is 'mine', not of class FilterSetup"),
    (
        sd.monte_carlo,
        {"scenario": "two-stars", "runs": 2, "setup": "mekf"},
        "setup is 'mekf', not of class FilterSetup",
    ),
    (sd.covariance_analysis, {"scenario": "spin", "consider": {"scale_factor": 1e-4}}, "not of class Consider"),
    (sd.monte_carlo, {"scenario": "spin", "dispersions": {"bias_sigma": 1.0}}, "not of class Dispersions"),
    (lambda: replace(scenarios.load_scenario("spin"), gyro=1e-4), {}, "gyro is 0.0001, not of class GyroSpec"),
    *(
        (sd.tune, {"sources": RECORD, "setup": SETUP, "free": free}, f"free is {free!r}, not of class list or tuple")
        for free in ("gyro.arw", "")
    ),
    (
        lambda: FilterSetup.for_scenario(replace(scenarios.load_scenario("coning"), gyro=GyroSpec()), states=False),
        {},
        "angle random walk",
    ),
]


@pytest.mark.parametrize(("call", "arguments", "named"), TABLE, ids=[f"{k} {row[2]}" for k, row in enumerate(TABLE)])
def test_it_is_refused_by_the_name_of_the_argument(call, arguments, named):
    with pytest.raises(InputError) as refused:
        call(**arguments)
    assert named in str(refused.value)
    if call in (tabled, tabled_sensor):
        assert "f.toml: filter: states" in str(refused.value)  # and by its place


FACES = {
    "estimation.run": estimation.run,
    "estimation.smooth": estimation.smooth,
    "StepFilter": lambda record, *arguments: StepFilter(*arguments),
    "estimation.observability": estimation.observability,
    "multiple_model.run": lambda record, noise, initial: multiple_model.run(record, noise),
    "filters.compare": lambda *arguments: filters.compare(*arguments, filters=["mekf"]),
}
WRONG = {"record": None, "process_noise": 1e-4, "initial": None, "gate": 0.999, "robust": "huber"}
CLASSES = dict(zip(WRONG, ("ImuRecord", "ProcessNoise", "State", "Gate", "Robust"), strict=True))


def wants(face, name):
    """Whether a face has an argument of that name."""
    if name in ("gate", "robust"):
        return face in ("estimation.run", "estimation.smooth")
    return (face, name) not in {("multiple_model.run", "initial"), ("StepFilter", "record")}


@pytest.mark.parametrize(("face", "name"), [(face, name) for face in FACES for name in WRONG if wants(face, name)])
def test_every_face_refuses_an_argument_of_another_class(face, name):
    arguments = {"record": RECORD, "process_noise": NOISE, "initial": start(), name: WRONG[name]}
    three = [arguments.pop(argument) for argument in ("record", "process_noise", "initial")]
    with pytest.raises(InputError, match=f"^{name} is {WRONG[name]!r}, not of class {CLASSES[name]}; "):
        FACES[face](*three, **arguments)
