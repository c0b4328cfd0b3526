"""Tuning a filter with optional states: the same likelihood as without them, its derivatives, what is recovered, what is held out."""

import dataclasses

import numpy as np
import pytest
import two_stars
from measured import FIELD
from measured import HAND as SWAY
from measured import errors as errors_of
from two_stars import drawn_case as case_of

from strapdown import coning, consistency, gyro, motion, quaternion, records, scenarios, tuning, vectors
from strapdown.estimation import forward, setup
from strapdown.estimation.setup import running
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.randomness import generator
from strapdown.scenarios import Scenario
from strapdown.tuning import parameters
from strapdown.tuning.objective import thinned

COLOURED = {"acc.correlated_sigma": 0.4, "acc.correlation_time": 1.0, "acc.sigma": 0.05}
"""What the simulated sensor has."""


def swaying(duration=60.0, **changes) -> Scenario:
    return Scenario(
        motion=SWAY,
        gyro=gyro.GyroSpec(angle_random_walk=1e-3, rate_random_walk=1e-4, turn_on_bias_sigma=3e-3),
        sensors=(
            vectors.Magnetometer(name="mag", field_f=FIELD, sigma=5e-7, rate=5.0, kind="vector", **changes),
            vectors.Accelerometer(
                name="acc",
                sigma=0.05,
                rate=20.0,
                kind="vector",
                faults=vectors.Faults(correlated_sigma=0.4, correlation_time=1.0),
            ),
        ),
        rate=20.0,
        duration=duration,
    )


def filter_setup(scenario) -> setup.FilterSetup:
    """Return the filter that matches, without a better integration, as the motion is slow; with a lever arm, as some test needs one."""
    matched = setup.FilterSetup.for_scenario(scenario, states=True)
    arm = dataclasses.replace(matched.states.sensors["acc"], lever_arm_sigma=(0.0, 0.0, 0.3))
    states = dataclasses.replace(matched.states, sensors={**matched.states.sensors, "acc": arm})
    return dataclasses.replace(matched, states=states, integration=coning.ALGORITHMS["one-sample"])


def wrong(right, factors) -> setup.FilterSetup:
    values = tuning.values_of(right, list(factors), [])
    return tuning.with_values(right, {name: factor * values[name] for name, factor in factors.items()})


# ------------------------------------------------------------------------------------------------------------------- the likelihood


OF_THE_GYRO = States(
    gyro_scale_sigma=1e-2,
    gyro_cross_force_sigma=((0.0, 1e-4, 2e-4), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    gyro_drift_sigma=(1e-3, 2e-3),
    gyro_drift_time=(50.0, 20.0),
    gyro_fast_bias_sigma=1e-4,
)
OF_SENSORS = States(
    sensors={
        "up": SensorStates(velocity_sigma=0.1, velocity_time=1.0, acceleration_time=2.0),
        "north": SensorStates(correlated_sigma=1e-2, correlation_time=2.0),
        "tracker": SensorStates(bias_sigma=1e-2),
    }
)
"""Two times and a rate of 1/s are equal only at the starting point."""
FEW = States(
    gyro_drift_sigma=(1e-3,),
    gyro_drift_time=(50.0,),
    sensors={"north": SensorStates(correlated_sigma=1e-2, correlation_time=2.0)},
)
EVERY_STATE = {
    "few": (FEW, {}, ("gyro.arw", "up.sigma", "north.sigma", "tracker.sigma")),
    "gyro": (OF_THE_GYRO, {}, ("gyro.arw", "up.sigma", "north.sigma", "tracker.sigma")),
    "sensors": (
        OF_SENSORS,
        {"sun": (1e-2, 2e-2, 1e-2)},
        ("gyro.rrw", "initial.attitude", "initial.bias", "sun.sigma"),
    ),
}


@pytest.mark.slow  # each takes 10 s to compile
@pytest.mark.parametrize(("states", "sigma", "others"), EVERY_STATE.values(), ids=EVERY_STATE)
def test_every_lane_is_the_filter_itself_with_every_state_and_kind_of_sensor(states, sigma, others):
    record = two_stars.every_kind(gaps=False)
    filter_setup = dataclasses.replace(two_stars.KINDS, states=states, sigma=sigma)
    case = tuning.record_case(record, filter_setup, seed=3)
    names = (*others, *parameters.state_names(states))
    objective = tuning.likelihood([case], filter_setup, names)
    points = objective.start + np.random.default_rng(1).uniform(-0.5, 0.5, (9, len(names)))
    points[8] = objective.start
    if "gyro.scale_sigma" in names:
        points[3, names.index("gyro.scale_sigma")] = -np.inf  # a state that is zero
    expected = []
    for point in points:
        used = objective.setup(point)
        expected.append(two_stars.minus_log(setup.run(record, used, objective.initial(case, used))))
    # A step is cut where the bias of any lane needs it, which matters to scale factors and forces.
    np.testing.assert_allclose(objective.minus_log(points), expected, rtol=1e-6 if states is OF_THE_GYRO else 1e-9)
    step = 1e-4 * np.eye(len(names))
    slopes = objective.minus_log(points[8] + step) - objective.minus_log(points[8] - step)
    derivatives = objective.derivatives(points[8])
    np.testing.assert_allclose(derivatives.score.sum(axis=0), slopes / 2e-4, rtol=1e-3, atol=1e-2)
    assert np.linalg.eigvalsh(derivatives.information).min() > -1e-9 * derivatives.information.max()


def test_of_a_bias_over_temperature_it_is_that_of_a_linear_filter():
    """The oracle: one axis at rest, states (θ, b, c), ``θ' = θ − (b + c (T − T₀)) dt``, T up and down again; on z c is zero."""
    random, dt, sensor = np.random.default_rng(2), 0.05, 1e-4
    T = 25.0 + 8.0 * np.sin(np.linspace(0.0, 5.0, 1201))
    warm = 0.5 * (T[1:] + T[:-1]) - T[0]
    turns = np.array([3e-5, -2e-5, 0.0]) * warm[:, None] * dt + 1e-6 * random.standard_normal((1200, 3))
    time = dt * np.arange(1201)
    angles = sensor * random.standard_normal((120, 3))
    tracker = vectors.VectorMeasurements(
        sensor="tracker",
        kind="attitude",
        time=time[10::10],
        attitude=quaternion.exp(angles),
        sigma_axes=np.full(3, sensor),
    )
    record = records.ImuRecord(time=time, increments=turns, vectors=(tracker,), temperature=T)
    filter_setup = dataclasses.replace(
        two_stars.ANGLES, bias_sigma=1e-5, states=States(gyro_temperature_sigma=(2e-5, 2e-5, 0.0))
    )
    case = tuning.Case(record=record, initial=setup.initial_state(filter_setup, quaternion.IDENTITY))
    objective = tuning.likelihood([case], filter_setup, ["gyro.temperature_sigma", "gyro.rrw", "tracker.sigma"])
    points = objective.start + np.array([[0.0, 0.0, 0.0], [0.5, -0.3, 0.2]])
    for point, value in zip(points, objective.minus_log(points), strict=True):
        slope, walk, noise = np.exp(point)
        white, expected, H = filter_setup.process_noise.angle_random_walk, 0.0, np.array([1.0, 0.0, 0.0])
        for axis in range(3):
            x, P = np.zeros(3), np.diag([filter_setup.attitude_sigma, 1e-5, slope * (axis < 2)]) ** 2.0
            for k in range(1200):
                F = np.eye(3)
                F[0, 1:] = -dt, -dt * warm[k]
                x = F @ x + turns[k, axis] * H
                P = F @ P @ F.T + np.diag([white**2 * dt + walk**2 * dt**3 / 3.0, walk**2 * dt, 0.0])
                P[0, 1] = P[1, 0] = P[0, 1] - 0.5 * walk**2 * dt**2
                if k % 10 == 9:
                    e, s = angles[k // 10, axis] - x[0], P[0, 0] + noise**2
                    expected += 0.5 * (np.log(s) + e * e / s)
                    x, P = x + P[:, 0] * e / s, P - np.outer(P[:, 0], P[0]) / s
        assert value == pytest.approx(expected, rel=1e-6)
    (_, bias, P) = objective.estimates(0, points[:1], np.array([1000]))
    assert np.abs(bias[0, 0] - np.array([3e-5, -2e-5, 0.0]) * (T[1000] - T[0])).max() < 4.0 * np.sqrt(P[0, 0, 3, 3])


def test_it_is_that_of_ordinary_runs_and_score_and_curvature_are_its_derivatives():
    scenario = swaying(20.0)
    matched = filter_setup(scenario)
    case = case_of(scenario, matched, 5)
    objective = tuning.likelihood([case], matched, [*COLOURED, "gyro.arw"])
    point = objective.start + 0.2
    points = np.stack([objective.start, point, objective.start + np.array([0.5, -0.4, 0.3, -0.2])])
    used = [objective.setup(x) for x in points]
    runs = [setup.run(case.record, each, objective.initial(case, each)) for each in used]
    expected = list(map(two_stars.minus_log, runs))
    np.testing.assert_allclose(objective.minus_log(points), expected, rtol=1e-9)
    derivatives = objective.derivatives(point)
    slopes = two_stars.differences(lambda x: objective.minus_log(x)[0], point)
    np.testing.assert_allclose(derivatives.score.sum(axis=0), slopes, rtol=1e-3, atol=1e-2)
    curvature = objective.curvature(point)
    step = 0.02
    for j in range(len(point)):
        three = objective.minus_log(point + step * np.array([[-1.0], [0.0], [1.0]]) * np.eye(4)[j])
        assert curvature[j, j] == pytest.approx((three[0] - 2.0 * three[1] + three[2]) / step**2, rel=0.02, abs=0.3)
    # What is observed scatters about what is expected.
    expected = objective.derivatives(objective.start).information[:3, :3]
    observed = objective.curvature(objective.start)[:3, :3]
    np.testing.assert_allclose(np.diag(observed), np.diag(expected), rtol=0.5)


@pytest.mark.parametrize("spacing", [0.0, 0.5])
def test_evaluations_are_ordinary_runs_but_prepare_the_gyro_only_once(spacing, monkeypatch):
    """Neither the integration of the gyro nor the angular acceleration at the measurements depends on what is tuned."""
    scenario = swaying(20.0)
    matched = filter_setup(scenario)
    states = dataclasses.replace(matched.states, gyro_fast_bias_sigma=1e-4)
    matched = dataclasses.replace(
        matched, integration=coning.ALGORITHMS["two-sample"], sigma={"mag": 6e-7}, states=states
    )
    case = case_of(scenario, matched, 5)
    objective = tuning.likelihood([case], matched, ["gyro.arw", "acc.sigma", "acc.lever_sigma"], spacing=spacing)
    point, epochs = objective.start + 0.1, np.arange(0, 200, 10)
    used = objective.setup(point)
    record = setup.modelled_record(case.record, used)
    record = dataclasses.replace(record, vectors=tuple(thinned(series, spacing) for series in record.vectors))
    plain = dataclasses.replace(used, sigma={}, integration=coning.ALGORITHMS["one-sample"])
    expected = setup.run(record, plain, case.initial, full_covariance=True)
    monkeypatch.setattr(forward, "turning", None)
    monkeypatch.setattr(running, "compress", None)
    assert objective.minus_log(point)[0] == pytest.approx(two_stars.minus_log(expected), rel=1e-12)
    attitude, bias, P = objective.estimates(0, point[None], epochs)
    np.testing.assert_allclose(attitude[:, 0], expected.attitude[epochs], rtol=1e-12)
    np.testing.assert_allclose(bias[:, 0], expected.bias[epochs], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(P[:, 0], expected.covariance[epochs], rtol=1e-9, atol=1e-18)


def test_values_scale_all_axes_alike_and_the_rest_stays():
    states = States(
        gyro_scale_sigma=(1e-3, 0.0, 2e-3),
        gyro_drift_sigma=(1e-6, 1e-6),
        gyro_drift_time=(60.0, 6.0),
        gyro_fast_bias_sigma=4e-7,
        sensors={"mag": SensorStates(bias_sigma=(1.0, 2.0, 2.0)), "a.b": SensorStates(lever_arm_sigma=0.3)},
    )
    assert parameters.state_names(states) == (
        "gyro.scale_sigma",
        "gyro.drift_sigma",
        "gyro.drift_time",
        "mag.bias_sigma",
        "a.b.lever_sigma",
    )
    filter_setup = dataclasses.replace(setup.FilterSetup.for_scenario(swaying(5.0), states=False), states=states)
    values = tuning.values_of(filter_setup, ["mag.bias_sigma", "gyro.scale_sigma"], [])
    assert list(values.values()) == pytest.approx([np.sqrt(3.0), 1e-3 * np.sqrt(2.5)])
    changed = tuning.with_values(
        filter_setup, {"mag.bias_sigma": 2.0 * np.sqrt(3.0), "gyro.drift_sigma": 3e-6, "a.b.lever_sigma": 0.1}
    ).states
    assert changed.sensors["mag"].bias_sigma == pytest.approx((2.0, 4.0, 4.0))
    assert changed.gyro_drift_sigma == pytest.approx((3e-6, 3e-6))
    assert changed.gyro_fast_bias_sigma == pytest.approx(12e-7)
    assert changed.sensors["a.b"].lever_arm_sigma == pytest.approx(0.1)
    assert changed.gyro_scale_sigma == states.gyro_scale_sigma
    twice = tuning.with_values(filter_setup, {"filter.scale": 2.0}).states
    assert twice.gyro_scale_sigma == pytest.approx((2e-3, 0.0, 4e-3))
    assert twice.gyro_drift_sigma == pytest.approx((2e-6, 2e-6))
    assert (twice.gyro_drift_time, twice.gyro_fast_bias_sigma) == (states.gyro_drift_time, 8e-7)
    assert twice.sensors["mag"].bias_sigma == pytest.approx((2.0, 4.0, 4.0))
    assert twice.sensors["a.b"].lever_arm_sigma == 0.6


def test_a_search_stays_where_a_state_makes_sense():
    """Scale factors below a tenth, for the filter is linear in them; times from a part of the interval to many records."""
    scenario = swaying(20.0)
    matched = filter_setup(scenario)
    matched = dataclasses.replace(matched, states=dataclasses.replace(matched.states, gyro_scale_sigma=1e-3))
    free = ["gyro.scale_sigma", "acc.correlation_time", "acc.correlated_sigma"]
    objective = tuning.likelihood([case_of(scenario, matched, 1)], matched, free)
    far, near = (objective.setup(objective.start + step).states for step in (12.0, -12.0))
    assert far.gyro_scale_sigma == pytest.approx(0.1)
    assert far.sensors["acc"].correlation_time == pytest.approx(100.0 * 20.0)
    assert near.sensors["acc"].correlation_time == pytest.approx(
        0.05 * 20.0 / len(objective.cases[0].record.vectors[1].time)
    )
    assert far.sensors["acc"].correlated_sigma == pytest.approx(0.4 * np.exp(12.0))
    assert near.gyro_scale_sigma == pytest.approx(1e-3 * np.exp(-12.0))


# ---------------------------------------------------------------------------------------------------------------------- what is found


def recovered(seeds, duration) -> np.ndarray:
    """Return errors of the log parameters over their standard errors, by seed and parameter."""
    scenario = swaying(duration)
    matched = filter_setup(scenario)
    off = wrong(matched, {"acc.correlated_sigma": 3.0, "acc.correlation_time": 0.3})
    off = dataclasses.replace(off, sigma={"acc": 0.12})
    ratios = []
    for seed in seeds:
        objective = tuning.likelihood([case_of(scenario, matched, seed)], off, list(COLOURED))
        fit = tuning.fit(objective, starts=1, intervals=False)
        ratios.append([np.log(fit[name].value / value) / fit[name].standard_error for name, value in COLOURED.items()])
    return np.array(ratios)


@pytest.mark.parametrize(
    ("seeds", "duration", "inside_of", "squares"),
    [(4, 30.0, 0.75, (0.26, 2.4)), pytest.param(100, 60.0, 0.88, (0.65, 1.5), marks=pytest.mark.slow)],
)
def test_a_coloured_sensor_is_recovered_within_its_intervals(seeds, duration, inside_of, squares):
    """Over the few seeds the three parameters are taken together, over the many each is judged."""
    ratios = recovered(range(seeds), duration)
    ratios = ratios if seeds > 10 else ratios.reshape(-1, 1)
    assert np.all(np.mean(np.abs(ratios) < 1.96, axis=0) >= inside_of), ratios
    size = np.mean(ratios**2, axis=0)
    assert np.all((squares[0] < size) & (size < squares[1])), size


@pytest.mark.slow
def test_a_state_that_nothing_shows_is_not_identified():
    """At rest the scale of a quiet gyro is multiplied by nothing, and its σ makes no difference. (Of a noisy one the noise is.)"""
    quiet = gyro.GyroSpec(angle_random_walk=1e-6, rate_random_walk=1e-9, turn_on_bias_sigma=1e-6)
    scenario = dataclasses.replace(swaying(20.0), motion=motion.rest(), gyro=quiet)
    matched = filter_setup(scenario)
    matched = dataclasses.replace(matched, states=dataclasses.replace(matched.states, gyro_scale_sigma=1e-3))
    objective = tuning.likelihood(
        [case_of(scenario, matched, 2)], matched, ["gyro.scale_sigma", "acc.correlated_sigma"]
    )
    fit = tuning.fit(objective, starts=1)
    assert not fit.composite  # the curvature of innovations is their information
    assert not fit["gyro.scale_sigma"].identified
    assert "not identified" in fit["gyro.scale_sigma"].note
    assert fit["acc.correlated_sigma"].identified


@pytest.mark.slow
def test_hard_iron_is_tuned_from_several_records():
    """σ of a bias drawn anew for every record, from eight of them: 24 draws, known to 1/√48."""
    sigma = 3e-6
    records = []
    for k in range(8):
        iron = sigma * generator(9, k, "iron").standard_normal(3)
        records.append(swaying(15.0, hard_iron=iron))
    matched = filter_setup(records[0])
    off = dataclasses.replace(
        matched,
        states=dataclasses.replace(
            matched.states, sensors={**matched.states.sensors, "mag": SensorStates(bias_sigma=sigma / 5.0)}
        ),
    )
    cases = [case_of(scenario, off, 9, k) for k, scenario in enumerate(records)]
    fit = tuning.fit(tuning.likelihood(cases, off, ["mag.bias_sigma"]), starts=1, intervals=False)
    parameter = fit["mag.bias_sigma"]
    assert 0.1 < parameter.standard_error < 0.25
    assert abs(np.log(parameter.value / sigma)) < 2.6 * parameter.standard_error


# ------------------------------------------------------------------------------------------------------------------------- held out

FREE = {
    "spin": ("gyro.arw", "sun sensor.sigma", "star.sigma"),
    "hand-held": ("gyro.arw", "accelerometer.sigma", "magnetometer.sigma", "magnetometer.correlated_sigma"),
    "low-orbit": ("gyro.arw", "sun sensor.sigma", "magnetometer.sigma", "gyro.drift_sigma"),
    "coning": ("gyro.arw", "star 1.sigma", "star 2.sigma"),
    "slew-vibration": ("gyro.arw", "star 1.sigma", "star 2.sigma", "star 3.sigma"),
    "tumbling-satellite": ("gyro.arw", "star tracker 1.sigma", "star tracker 2.sigma", "star tracker 3.sigma"),
    "magnetometer-only": ("gyro.arw", "magnetometer.sigma"),
    "two-stars": ("gyro.arw", "gyro.rrw", "star 1.sigma", "star 2.sigma"),
}
"""What is tuned of each built-in scenario that measures anything; what the record says nothing of stays as it is specified."""


def tuned_and_held_out(name: str, train: int, test: int, seed: int, **changes) -> list[str]:
    """Return what is outside its bounds on records not used, after tuning from σ wrong by a factor of three either way."""
    scenario = dataclasses.replace(scenarios.load_scenario(name), **changes)
    filter_setup = setup.FilterSetup.for_scenario(scenario, states=True)
    free = FREE[name]
    plain = [part for part in free if part not in parameters.state_names(filter_setup.states)]
    cases = [case_of(scenarios.drawn(scenario, seed, run), filter_setup, seed, run) for run in range(train)]
    values = tuning.values_of(filter_setup, plain, [case.record for case in cases])
    off = tuning.with_values(
        filter_setup, {part: value * 3.0 ** (-1) ** k for k, (part, value) in enumerate(values.items())}
    )
    off = wrong(off, {part: 1.0 / 3.0 for part in free if part not in plain}) if len(plain) < len(free) else off
    fit = tuning.fit(tuning.likelihood(cases, off, free), starts=1, intervals=False)
    nees: dict = {subset: [] for subset in consistency.SUBSETS}
    nis: dict = {}
    for run in range(train, train + test):
        case = case_of(scenarios.drawn(scenario, seed, run), filter_setup, seed, run)
        steps = len(setup.modelled_record(case.record, fit.setup).increments)
        estimate = setup.run(case.record, fit.setup, case.initial, every=steps // 5, full_covariance=True)
        truth = setup.modelled_record(case.record, fit.setup).truth
        every = steps // 5
        error = errors_of(estimate, truth, every)[1:6]
        for subset, states in consistency.SUBSETS.items():
            nees[subset].append(consistency.nees(error, estimate.covariance[1:6], states))
        for sensor, innovation in estimate.innovations.items():
            total = nis.setdefault(sensor, np.zeros(2))
            total += (innovation.nis.sum(), innovation.innovation.size)
    wrong_ones = []
    for subset, values_of_runs in nees.items():
        degrees = len(consistency.SUBSETS[subset])
        verdict = consistency.Verdict(
            mean=np.mean(values_of_runs, axis=0) / degrees, degrees=degrees, runs=test, confidence_level=0.998
        )
        if not verdict.consistent:
            wrong_ones.append(f"NEES of the {subset}: {verdict.mean} outside {verdict.simultaneous_bounds}")
    for sensor, (total, degrees) in nis.items():
        # The tuned σ has an error of its own, of as many measurements as it was tuned on.
        low, high = consistency.mean_bounds(1, degrees * train / (train + test), 0.998)
        if not low < total / degrees < high:
            wrong_ones.append(f"NIS of {sensor}: {total / degrees} outside {low, high}")
    return wrong_ones


SHORTER = {"low-orbit": 2400.0, "coning": 20.0, "tumbling-satellite": 120.0}
"""Seconds of the runs of the study where whole ones take too long; the others are whole."""
SLOW = [pytest.param(name, 20, SHORTER.get(name, 0.0), marks=pytest.mark.slow) for name in FREE]


@pytest.mark.parametrize(("name", "test", "duration"), [("spin", 4, 150.0), *SLOW])
def test_after_tuning_held_out_statistics_pass(name, test, duration):
    assert tuned_and_held_out(name, 2, test, 40 + (test > 4), **({"duration": duration} if duration else {})) == []


def test_a_parameter_is_printed_in_the_unit_by_whose_factor_it_is_divided():
    degree, g = np.pi / 180.0, 9.80665
    size = {"s": 1.0, "1": 1.0, "m": 1.0, "m/s": 1.0, "m/s²": 1.0, "rad, or unit of the reference": 1.0}
    size |= {"%": 0.01, "ppm": 1e-6, "mrad": 1e-3, "°": degree, "°/h": degree / 3600.0, "°/h/g": degree / 3600.0 / g}
    size |= {"°/h/K": degree / 3600.0, "°/√h": degree / 60.0, "°/h/√h": degree / 3600.0 / 60.0}
    names = (*parameters.PLAIN, *parameters.GYRO_STATES, *parameters.WHOLE)
    for name in (*names, *(f"mag.{state}" for state in parameters.SENSOR_STATES)):
        assert parameters.unit_of(name).factor == pytest.approx(size[parameters.unit_of(name).name], rel=1e-12), name
