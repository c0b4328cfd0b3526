"""Scenarios: the built-in ones, files and their errors, and streams that do not disturb each other."""

import dataclasses
import tomllib

import numpy as np
import pytest
import scipy.stats
from measured import differing

import strapdown as sd
from strapdown import gyro, montecarlo, motion, quaternion, scenarios, vectors
from strapdown.checks import InputError
from strapdown.consistency import Judgement
from strapdown.gyro import GyroSpec
from strapdown.motion import orbit
from strapdown.scenarios import Scenario, load_scenario, scenario_from_toml, scenario_to_table, scenario_to_toml

FIRST = "rate_hz = 10.0\nduration_s = 2.0\n"
REST = FIRST + '[motion]\ntype = "rest"\n'


def test_the_built_in_ones_are_those_asked_for():
    moving = {"coning", "spin", "slew-vibration", "tumbling-satellite", "low-orbit", "magnetometer-only", "hand-held"}
    assert set(scenarios.SCENARIOS) == moving | {"rest", "two-stars", "earth-observer", "ship", "cubesat"}
    table = scenarios.builtin()
    assert [row[0] for row in table.rows] == list(scenarios.SCENARIOS)
    assert [note.partition(": ")[0] for note in table.notes] == list(scenarios.SCENARIOS)
    assert all(note.partition(": ")[2] for note in table.notes)


@pytest.mark.parametrize("name", ["cubesat", "earth-observer", "low-orbit", "magnetometer-only", "tumbling-satellite"])
def test_satellites_are_in_free_fall(name):
    assert load_scenario(name).gravity_f == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("value", ["star", ("star",), (vectors.AttitudeSensor,)])
def test_what_is_no_sensor_is_refused(value):
    with pytest.raises(InputError, match=r"^a sensor is .*; give sensors, such as VectorSensor"):
        dataclasses.replace(load_scenario("two-stars"), sensors=value)


def test_one_sensor_is_given_as_a_tuple():
    sensor = load_scenario("cubesat").sensors[0]
    with pytest.raises(InputError, match=r"^sensors is AttitudeSensor\(.*\); give a tuple"):
        dataclasses.replace(load_scenario("cubesat"), sensors=sensor)


@pytest.mark.parametrize("value", ["slew", motion.Coning])
def test_what_is_no_motion_is_refused(value):
    with pytest.raises(InputError, match=r"^motion is .*(slew|Coning).*; give a motion, such as motion\.rest"):
        dataclasses.replace(load_scenario("two-stars"), motion=value)


@pytest.mark.parametrize("name", scenarios.SCENARIOS)
def test_built_in_scenarios_simulate_and_survive_a_file(name, tmp_path):
    short = dataclasses.replace(load_scenario(name), duration=4.0)
    path = tmp_path / "own.toml"
    path.write_text(scenario_to_toml(short), encoding="utf-8")
    read = load_scenario(path)
    assert scenario_to_table(read) == scenario_to_table(short)
    record = scenarios.simulate(short)
    assert not differing(record, scenarios.simulate(read))
    assert len(record.increments) == round(4.0 * short.rate)
    np.testing.assert_array_equal(record.truth.attitude, short.motion.attitude(record.time))
    assert differing(record, scenarios.simulate(short, seed=99))
    assert differing(record, scenarios.simulate(short, run=1))


MOTIONS = [
    motion.Coning(angle=0.1234, frequency=3.3),
    motion.SpinCone(precession_rate=0.3, spin_rate=0.7, angle=0.11),
    motion.ConstantRate(rate=[0.1, 0.2, 0.3], initial_attitude=[0.6, 0.8, 0.0, 0.0]),
    motion.SpinRock(rock_angle=0.1, rock_frequency=2.0, spin_rate=1.0, rock_phase=0.3),
    motion.Slew(rotation_vector=[0.1, 1.0, 2.0], duration=7.0, start=1.0),
    motion.TorqueFree(inertia=[1.0, 2.0, 3.0], initial_rate=[0.1, 1.0, 0.1]),
    motion.HarmonicRates(
        harmonics=[motion.Harmonic(amplitude=[0.1, 0.0, 0.2], frequency=0.3, phase=0.1)], mean=[0.0, 0.1, 0.0]
    ),
    motion.Composed(
        base=motion.Slew(rotation_vector=[0.0, 1.0, 0.0], duration=3.0),
        vibration=motion.Coning(angle=0.01, frequency=30.0),
    ),
    motion.rest(),
]
FAULTS = vectors.Faults(
    latency=0.1,
    outages=[(1.0, 1.3)],
    outlier_probability=0.1,
    outlier_scale=7.0,
    correlated_sigma=1e-5,
    correlation_time=3.0,
)
SENSORS = (
    vectors.VectorSensor(name="star", reference_f=[1.0, 2.0, 3.0], sigma=1.1e-4, rate=3.0, phase=0.1, faults=FAULTS),
    vectors.VectorSensor(name="level", reference_f=[1.0, 0.2, 0.3], sigma=1.1e-4, rate=3.0, kind="heading"),
    vectors.AttitudeSensor(name="tracker", sigma_across=1e-4, sigma_about=3e-4, rate=2.0, boresight="y"),
    vectors.Magnetometer(
        name="mag",
        field_f=[2e-5, 1e-6, 3e-5],
        sigma=1e-7,
        rate=3.0,
        kind="vector",
        hard_iron=[1e-7, 0.0, 2e-7],
        soft_iron=0.01 * np.eye(3),
    ),
    vectors.Magnetometer(
        name="dipole", field_f=orbit.CircularOrbit(altitude=6e5, inclination=0.9).magnetic_field, sigma=1e-7, rate=3.0
    ),
    vectors.Accelerometer(
        name="acc", sigma=0.01, rate=5.0, lever_arm_b=[0.1, 0.2, 0.3], bias=[0.01, 0.0, 0.0], faults=FAULTS
    ),
    vectors.HeadingPair(name="gnss", baseline_b=[1.0, 0.5, 0.0], sigma=0.01, rate=1.0),
)


@pytest.mark.parametrize("body", MOTIONS, ids=lambda body: type(body).__name__)
def test_every_motion_and_sensor_survives_a_file(body):
    whole = Scenario(
        motion=body,
        gyro=GyroSpec(angle_random_walk=1e-4, bias_instability=1e-6, turn_on_bias=[1e-5, 0.0, 2e-5]),
        sensors=SENSORS,
        rate=50.0,
        duration=3.0,
        name="x",
        seed=5,
        gravity_f=(0.0, 0.0, -1.62),
    )
    read = scenario_from_toml(scenario_to_toml(whole))
    assert scenario_to_table(read) == scenario_to_table(whole)
    assert read.motion == body
    assert read.gyro == whole.gyro
    assert not differing(scenarios.simulate(whole), scenarios.simulate(read))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[motoin]\n", "did you mean 'motion'"),
        (FIRST, "motion is missing"),
        ("duration_s = 1.0\n[motion]\ntype='rest'", "rate_hz is missing"),
        (FIRST + "[motion]\nangle_deg = 1.0", "type is missing"),
        (FIRST + "motion = 3", "must be a table"),
        (FIRST + "[motion]\ntype = 'conning'", "did you mean 'coning'"),
        (FIRST + "[motion]\ntype = 'coning'\nangle_degree = 1.0", "did you mean 'angle_deg'"),
        (FIRST + "[motion]\ntype = 'coning'\nangle_deg = 1.0", "frequency_hz is missing"),
        (FIRST + "[motion]\ntype = 'coning'\nangle_deg = '1'\nfrequency_hz=1.0", "must be a number"),
        (FIRST + "[motion]\ntype = 'composed'\nbase = {type='rest'}", "vibration"),
        (REST + "[gyro]\npreset = 'stim30'", "did you mean 'stim300'"),
        (REST + "[gyro]\npreset = 'stim300'\nscale_factor_pmp = 3.0", "did you mean 'scale_factor_ppm'"),
        (REST + "[[sensors]]\ntype='direction'\nsgma_arcsec=1.0", "did you mean 'sigma_arcsec'"),
        (REST + "[[sensors]]\ntype='direction'\nname='a'\nsigma_arcsec=1.0\nrate_hz=1.0", "reference_f is missing"),
        (REST + "[[sensors]]\ntype='direction'\nlatancy_s=1.0", "did you mean 'latency_s'"),
        (REST + "[[sensors]]\ntype='magnetometer'\norbit={altitude=3}", "did you mean 'altitude_"),
        (REST + "[sensors]\ntype='direction'", "two brackets"),
        (FIRST.replace("10.0", "-1.0") + "[motion]\ntype='rest'", "rate is -1"),
        ("rate_hz = = 3", "not TOML"),
    ],
)
def test_wrong_files_are_refused_with_the_nearest_key(text, message):
    with pytest.raises(InputError, match=message):
        scenario_from_toml(text)


def test_missing_files_and_names(tmp_path):
    with pytest.raises(InputError, match="did you mean 'coning'"):
        load_scenario("conning")
    with pytest.raises(InputError, match="does not exist"):
        load_scenario(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot be read"):
        load_scenario(tmp_path / "bytes.toml")


def test_what_has_no_form_in_a_file_is_refused():
    base = scenario_from_toml(REST)

    class OwnMotion(motion.ConstantRate):
        """Not a motion of the package, though it moves as one."""

    for change in (
        {"motion": OwnMotion(rate=(0.1, 0.2, 0.3))},
        {"sensors": (vectors.Magnetometer(name="m", field_f=lambda t: np.ones((len(t), 3)), sigma=1.0, rate=1.0),)},
        {
            "sensors": (
                vectors.Accelerometer(name="a", acceleration_f=lambda t: np.ones((len(t), 3)), sigma=1.0, rate=1.0),
            )
        },
    ):
        with pytest.raises(InputError, match="cannot be written to a file"):
            scenario_to_toml(dataclasses.replace(base, **change))


def test_a_preset_may_be_changed_in_a_file():
    plain = scenario_from_toml(REST + "[gyro]\npreset = 'stim300'")
    changed = scenario_from_toml(REST + "[gyro]\npreset = 'stim300'\nrange_deg_per_s = 100.0")
    assert plain.gyro_preset == "stim300"
    assert changed.gyro == dataclasses.replace(plain.gyro, range=np.deg2rad(100.0))
    assert scenario_from_toml(scenario_to_toml(changed)).gyro == changed.gyro


def test_adding_a_sensor_changes_no_other_stream():
    spec = GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, bias_instability=1e-6)
    base = Scenario(motion=MOTIONS[0], gyro=spec, sensors=SENSORS[:2], rate=50.0, duration=3.0)
    alone, more = scenarios.simulate(base, 3, 7), scenarios.simulate(dataclasses.replace(base, sensors=SENSORS), 3, 7)
    assert np.array_equal(alone.increments, more.increments)
    for a, b in zip(alone.vectors, more.vectors[:2], strict=True):
        assert np.array_equal(a.vector_b, b.vector_b)
    twins = tuple(dataclasses.replace(SENSORS[1], name=name) for name in ("one", "other"))
    first, other = scenarios.simulate(dataclasses.replace(base, sensors=twins), 3, 7).vectors
    assert not np.any(first.vector_b == other.vector_b)
    with pytest.raises(InputError, match="two sensors"):
        dataclasses.replace(base, sensors=(SENSORS[0], SENSORS[0]))


def test_jitter_has_the_truth_where_it_sampled_and_losses_are_bridged():
    spec = GyroSpec(sampling_jitter=1e-3, timestamp_offset=0.5, drop_probability=0.2)
    fast = motion.ConstantRate(rate=[0.0, 0.0, 3.0])
    base = Scenario(
        motion=fast, gyro=dataclasses.replace(spec, drop_probability=0.0), sensors=(), rate=50.0, duration=20.0
    )
    record = scenarios.simulate(base, 1)
    np.testing.assert_allclose(record.time, base.edges + 0.5)
    sampled = 2.0 * np.unwrap(np.arctan2(record.truth.attitude[:, 3], record.truth.attitude[:, 0]), period=np.pi) / 3.0
    assert np.std(sampled - base.edges) == pytest.approx(1e-3, rel=0.1)
    np.testing.assert_allclose(np.diff(sampled) * 3.0, record.increments[:, 2], atol=1e-9)
    lossy = scenarios.simulate(dataclasses.replace(base, gyro=spec), 1)
    assert len(lossy.increments) == pytest.approx(800, abs=60)
    np.testing.assert_allclose(lossy.rates[:, 2], 3.0, atol=1.0)
    assert set(lossy.time) <= set(record.time)
    left = np.searchsorted(record.time, lossy.time)
    np.testing.assert_array_equal(lossy.truth.attitude, record.truth.attitude[left])
    steady = scenarios.simulate(dataclasses.replace(base, gyro=GyroSpec(drop_probability=0.2)), 1)
    np.testing.assert_allclose(steady.rates[:, 2], 3.0, rtol=1e-12)


def test_saturation_is_counted_and_named_everywhere():
    """The limit is passed by the motion or by bias and scale factor; a low-pass filter before it lowers the rate."""
    shaken = load_scenario("two-stars")
    shaken = dataclasses.replace(
        shaken, duration=20.0, rate=100.0, motion=motion.Coning(angle=0.05, frequency=1.0), gyro=GyroSpec(range=0.3)
    )
    exact = simulate_exactly(shaken)
    assert 200 < exact < 2000
    assert shaken.saturation == f"the gyro's saturation at 17.19 °/s in {exact} of 2000 samples"
    within = dataclasses.replace(shaken, gyro=GyroSpec(range=0.32))
    biased = dataclasses.replace(shaken, gyro=GyroSpec(range=0.32, turn_on_bias=(0.1, 0.0, 0.0)))
    assert within.saturation == dataclasses.replace(shaken, gyro=GyroSpec()).saturation == ""
    assert f"in {simulate_exactly(biased)} of" in biased.saturation
    smooth = dataclasses.replace(shaken, gyro=GyroSpec(range=0.3, bandwidth=0.2))
    assert simulate_exactly(smooth) < 0.2 * exact  # at the start only, where the filter has the first rate
    assert f"in {simulate_exactly(smooth)} of" in smooth.saturation

    noisy = dataclasses.replace(shaken, gyro=GyroSpec(range=0.3, angle_random_walk=1e-4))
    record = sd.simulate(noisy)
    assert f"warning: {noisy.saturation}" in record.listing().notes
    result = sd.estimate(record)
    assert noisy.saturation in " ".join(result.remarks)
    assert noisy.saturation in sd.check(result).headline
    plan = sd.workflows.plan(noisy)
    assert noisy.saturation in plan.unmodelled
    analysis = sd.covariance_analysis(noisy, plan.setup, epochs=5)
    assert ("gyro range" in analysis.fixed, analysis.left_out) == (True, ())


def test_a_motion_that_changes_after_the_end_only_is_warned_of():
    slew = load_scenario("slew-vibration")
    for start, late in ((10.0, False), (39.0, False), (40.0, True), (100.0, True)):
        base = dataclasses.replace(slew.motion.base, start=start)
        scene = dataclasses.replace(slew, motion=dataclasses.replace(slew.motion, base=base))
        plan = sd.workflows.plan(scene)
        runs = montecarlo.campaign.Campaign(plan=plan, machine="scalar", chunk=1, runs=1, statistics=None)
        verdict = Judgement(verdict="consistent", reason="", findings=(), limits=(), confidence_level=0.99)
        for said in (sd.simulate(scene).listing().notes, montecarlo.campaign.words(runs, verdict)):
            assert (f"the motion changes at {start:g} s, after the end at 40 s" in " ".join(said)) == late
    assert load_scenario("coning").late_motion == ""


def simulate_exactly(scenario: Scenario) -> int:
    """Return the number of samples of a scenario without noise that the gyro clips."""
    free = dataclasses.replace(scenario, gyro=dataclasses.replace(scenario.gyro, range=np.inf))
    clipped, whole = (sd.simulate(each).increments for each in (scenario, free))
    return int(np.sum(np.any(clipped != whole, axis=1)))


def test_a_g_sensitive_gyro_feels_gravity_and_not_in_free_fall():
    spec = GyroSpec(g_sensitivity=1e-4 * np.eye(3))
    base = Scenario(motion=motion.rest(), gyro=spec, sensors=(), rate=10.0, duration=1.0)
    np.testing.assert_allclose(
        scenarios.simulate(base, 1).rates, np.tile([0.0, 0.0, 9.80665e-4], (10, 1)), rtol=1e-12, atol=1e-18
    )
    assert not np.any(scenarios.simulate(dataclasses.replace(base, gravity_f=(0.0, 0.0, 0.0)), 1).rates)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("rate_hz = 100.0", "rate_hz = 0"), r"rate is 0 Hz; it must be greater than zero \(two.toml: rate_hz = 0\)"),
        (("seed = 1", "seed = -1"), r"\(two.toml: seed = -1\)"),
        (
            ("angle_random_walk_deg_per_sqrt_hour = 0.15", "angle_random_walk_deg_per_sqrt_hour = -1"),
            r"\(two.toml: gyro: angle_random_walk_deg_per_sqrt_hour = -1\)",
        ),
        (("sigma_arcsec = 20.0", "sigma_arcsec = -20.0"), r"\(two.toml: sensors\[0\]: sigma_arcsec = -20.0\)"),
        (
            ("rate_hz = 1.0", "rate_hz = 1.0\noutlier_probability = 2"),
            r"\(two.toml: sensors\[0\]: outlier_probability = 2\)",
        ),
        (('name = "star 1"', 'name = " "'), "two.toml: a sensor has no name"),
        (('name = "star 1"', 'name = "star 2"'), r"two.toml: two sensors are named 'star 2'"),
        (("[gyro]", '[gyro]\npreset = "mpu"'), r"two.toml: gyro: preset 'mpu' is not known; did you mean 'mpu-9250'\?"),
    ],
)
def test_what_is_wrong_in_a_file_is_reported_with_the_file_and_as_typed(tmp_path, change, words):
    text = scenarios.toml.BUILTIN.joinpath("two-stars.toml").read_text(encoding="utf-8")
    assert change[0] in text
    (tmp_path / "two.toml").write_text(text.replace(*change, 1), encoding="utf-8")
    with pytest.raises(InputError, match=words):
        load_scenario(tmp_path / "two.toml")


def test_a_byte_order_mark_is_no_matter(tmp_path):
    """Editors of Windows write one."""
    text = scenario_to_toml(load_scenario("two-stars"))
    (tmp_path / "two.toml").write_text(text, encoding="utf-8-sig")
    assert scenario_to_toml(load_scenario(tmp_path / "two.toml")) == text
    (tmp_path / "gyro.toml").write_text("[gyro]\nquantization_rad = 1e-6\n", encoding="utf-8-sig")
    assert gyro.read_spec(tmp_path / "gyro.toml").quantization == 1e-6


def test_lists_of_numbers_stand_on_one_line():
    for name in ("hand-held", "ship", "cubesat"):
        scenario = load_scenario(name)
        assert tomllib.loads(scenario_to_toml(scenario)) == scenario_to_table(scenario)
    assert "rate_deg_per_s = [0.1, -0.2, 0.5]\n" in scenario_to_toml(load_scenario("two-stars"))


def test_one_scale_factor_for_all_axes_and_any_boresight_go_through_a_file():
    tracker = """[gyro]
scale_factor_ppm = 200
[[sensors]]
type = "attitude"
name = "tracker"
sigma_across_arcsec = 5.0
sigma_about_arcsec = 30.0
rate_hz = 2.0
boresight = [1.2, 0.0, 1.6]
"""
    scenario = scenario_from_toml(REST + tracker)
    np.testing.assert_allclose(scenario.gyro.scale_factor, [200e-6] * 3, rtol=1e-15)
    np.testing.assert_allclose(scenario.sensors[0].boresight, [0.6, 0.0, 0.8])
    again = scenario_from_toml(scenario_to_toml(scenario))
    assert again.sensors == scenario.sensors
    np.testing.assert_array_equal(again.gyro.scale_factor, scenario.gyro.scale_factor)


def test_a_duty_cycle_and_lost_samples_leave_the_rest_as_it_was():
    """On for 3 of every 10 s, a fifth lost; what is left has the noise of the sensor without either."""
    from strapdown.vectors import Faults, VectorSensor

    def heard(**faults):
        sensor = VectorSensor(
            name="star", reference_f=np.array([1.0, 0.0, 0.0]), sigma=1e-3, rate=4.0, faults=Faults(**faults)
        )
        return sensor.observe(motion.rest(), 0.0, 4000.0, np.random.default_rng(3))

    whole, cycle, lossy = heard(), heard(duty_period=10.0, duty_share=0.3), heard(drop_probability=0.2)
    inside = np.mod(whole.time, 10.0) <= 3.0
    np.testing.assert_array_equal(cycle.time, whole.time[inside])
    np.testing.assert_array_equal(cycle.vector_b, whole.vector_b[inside])
    kept = np.isin(whole.time, lossy.time)
    np.testing.assert_array_equal(lossy.vector_b, whole.vector_b[kept])
    low, high = scipy.stats.binom.ppf([0.0005, 0.9995], len(kept), 0.8)
    assert low <= kept.sum() <= high
    np.testing.assert_array_equal(heard(drop_probability=0.2, outlier_probability=0.3).time, lossy.time)
    for bad in ({"drop_probability": 1.5}, {"duty_share": -0.1}, {"duty_period": -1.0}):
        with pytest.raises(InputError, match=next(iter(bad))):
            Faults(**bad)


def test_a_horizon_sensor_sees_the_earths_centre():
    from strapdown.motion.orbit import CircularOrbit
    from strapdown.vectors import HorizonSensor

    path = CircularOrbit(altitude=600e3, inclination=1.2)
    sensor = HorizonSensor(name="horizon", orbit=path, sigma=0.0, rate=0.1)
    body = motion.ConstantRate(rate=(0.01, 0.02, -0.03))
    series = sensor.observe(body, 0.0, 3000.0, np.random.default_rng(1))
    down = quaternion.rotate(body.attitude(series.time), series.vector_b)
    np.testing.assert_allclose(
        down * np.linalg.norm(path.position(series.time), axis=1)[:, None],
        -path.position(series.time),
        rtol=1e-9,
        atol=1e-3,
    )
    with pytest.raises(InputError, match="orbit is missing"):
        scenario_from_toml(REST + '[[sensors]]\ntype = "horizon"\nname = "h"\nsigma_deg = 1.0\nrate_hz = 1.0')


def test_a_flight_in_samples_is_a_motion_of_a_file():
    """A recorded flight can be simulated again with other sensors: its attitudes stand in the file."""
    flown = motion.Coning(angle=0.3, frequency=0.1)
    time = np.linspace(0.0, 20.0, 201)
    again = motion.SampledAttitude(time=time, attitudes=flown.attitude(time))
    scenario = dataclasses.replace(load_scenario("two-stars"), motion=again, duration=20.0)
    read = scenario_from_toml(scenario_to_toml(scenario))
    np.testing.assert_array_equal(read.motion.attitudes, again.attitudes)
    record = scenarios.simulate(read)
    np.testing.assert_array_equal(record.truth.attitude, again.attitude(record.time))
    # A spline of degree 5 through samples a tenth of a second apart, of a cone of ten seconds.
    assert np.max(quaternion.angle_between(record.truth.attitude, flown.attitude(record.time))) < 1e-6
