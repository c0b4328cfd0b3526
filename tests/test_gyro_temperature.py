"""The gyro's bias over temperature in simulator, files and filter: closed forms, a linear filter as oracle, consistency over runs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import strapdown as sd
from sims import hand_held
from strapdown import consistency, estimation, montecarlo, records, scenarios
from strapdown.checks import InputError
from strapdown.estimation import error_states, setup
from strapdown.estimation.gating import Gate
from strapdown.estimation.setup.for_record import drawn_start
from strapdown.gyro.temperature import from_table, to_table
from strapdown.montecarlo import lanes
from strapdown.recordings import formats, recordfiles
from strapdown.units import DEGREE_PER_HOUR, DEGREE_PER_ROOT_HOUR
from strapdown.vectors import VectorMeasurements

SLOPE = 20.0 * DEGREE_PER_HOUR  # rad/s/K
TOML = """
rate_hz = 50.0
duration_s = 300.0

[motion]
type = "constant-rate"
rate_deg_per_s = [0.0, 0.0, 2.0]

[gyro]
angle_random_walk_deg_per_sqrt_hour = 0.3
rate_random_walk_deg_per_hour_per_sqrt_hour = 3.0
turn_on_bias_deg_per_hour = [50.0, 0.0, 0.0]

[gyro.temperature]
reference_degc = 30.0
lowest_degc = 15.0
highest_degc = 45.0
bias_rad_per_s = [1e-4, 0.0, 0.0]
bias_rad_per_s_per_k = [1e-5, -2e-5, 0.0]
sigma_rad_per_s_per_k = [1e-4, 1e-4, 1e-4]
bias_rad_per_s_per_k2 = [0.0, 1e-6, 0.0]
sigma_rad_per_s_per_k2 = [0.0, 0.0, 0.0]

[temperature]
start_degc = 20.0
end_degc = 40.0
time_constant_s = 100.0

[[sensors]]
type = "attitude"
name = "tracker"
rate_hz = 1.0
sigma_across_arcsec = 60.0
sigma_about_arcsec = 60.0
"""


def test_the_simulated_bias_is_the_polynomial_of_the_course(tmp_path):
    scenario = scenarios.scenario_from_toml(TOML)
    assert scenarios.scenario_from_toml(scenarios.scenario_to_toml(scenario)) == scenario
    table = to_table(scenario.gyro.temperature)
    assert from_table(table) == scenario.gyro.temperature
    constant = {key: value for key, value in table.items() if "_per_k" not in key}
    with pytest.raises(InputError, match=r"known: .*bias_rad_per_s_per_k, sigma_rad_per_s_per_k"):
        from_table({**constant, "slope_deg_per_hour_per_k": [0.0] * 3})
    quiet = replace(scenario.gyro, angle_random_walk=0.0, rate_random_walk=0.0)
    record = scenarios.simulate(replace(scenario, gyro=quiet))
    T = 40.0 - 20.0 * np.exp(-record.time / 100.0)
    np.testing.assert_allclose(record.temperature, T, rtol=1e-14)
    expected = np.zeros((len(T), 3))
    expected[:, 0] = 50.0 * DEGREE_PER_HOUR + 1e-4 + 1e-5 * (T - 30.0)
    expected[:, 1] = -2e-5 * (T - 30.0) + 1e-6 * (T - 30.0) ** 2
    np.testing.assert_allclose(record.truth.bias, expected, rtol=0.0, atol=1e-16)
    still = scenario.motion.increments(record.time)
    mean = 0.5 * (expected[1:] + expected[:-1]) * 0.02
    np.testing.assert_allclose(record.increments - still, mean, rtol=0.0, atol=1e-15)
    # Beyond the polynomial's span the bias is that at its end; a course without a time constant is a straight line.
    ramp = replace(scenario, temperature=scenarios.Temperature(start=20.0, end=60.0))
    hot = scenarios.simulate(replace(ramp, gyro=quiet))
    np.testing.assert_allclose(hot.temperature, np.linspace(20.0, 60.0, len(hot.time)), rtol=1e-14)
    assert hot.truth.bias[-1, 1] == pytest.approx(-2e-5 * 15.0 + 1e-6 * 225.0, rel=1e-12)
    recordfiles.write_record(tmp_path / "record.h5", record)
    np.testing.assert_array_equal(recordfiles.read_record(tmp_path / "record.h5").temperature, record.temperature)
    np.testing.assert_array_equal(formats.from_record(record).temperature, record.temperature[1:])
    part = records.cut(record, 10, 20)
    np.testing.assert_array_equal(part.temperature, record.temperature[10:21])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "[temperature]\nstart_degc = 20.0\nend_degc = 40.0\ntime_constant_s = 100.0",
            "",
            "add the table \\[temperature\\]",
        ),
        ("time_constant_s = 100.0", "time_constant_s = 0.0", "temperature: time_constant_s = 0.0"),
        ("start_degc = 20.0\n", "", "temperature: start_degc is missing"),
        ("reference_degc = 30.0", "reference_degc = 50.0", "gyro: temperature: reference_degc is 50, outside"),
        ("sigma_rad_per_s_per_k =", "sigma_rad_per_s_per_c =", "sigma_rad_per_s_per_c"),
        ("lowest_degc = 15.0\n", "", "gyro: temperature lacks lowest_degc"),
    ],
)
def test_a_wrong_table_is_refused_by_its_place(old, new, words):
    with pytest.raises(InputError, match=words):
        scenarios.simulate(scenarios.scenario_from_toml(TOML.replace(old, new)))


def _still(seed, slope, T, dt, white, sensor):
    """Return a record at rest with an attitude sensor every tenth sample, whose bias has a slope over T, and its initial state."""
    random = np.random.default_rng(seed)
    n = len(T) - 1
    time = dt * np.arange(n + 1)
    middle = 0.5 * (T[1:] + T[:-1])
    turns = slope * (middle - T[0])[:, None] * dt + white * np.sqrt(dt) * random.standard_normal((n, 3))
    at = time[10::10]
    angles = sensor * random.standard_normal((len(at), 3))
    series = VectorMeasurements(
        sensor="tracker",
        kind="attitude",
        time=at,
        attitude=sd.quaternion.exp(angles),
        sigma_axes=np.full((len(at), 3), sensor),
    )
    return records.ImuRecord(time=time, increments=turns, vectors=(series,), temperature=T), angles


def test_the_driven_bias_is_that_of_a_linear_filter_with_the_temperature_in_every_sample():
    """The oracle: one axis at rest, states (θ, b, c), ``θ' = θ − (b + c (T − T₀)) dt`` in each sample, T up and down again."""
    n, dt, white, walk, sensor, prior = 6000, 0.05, 1e-5, 1e-7, 1e-3, 5e-4
    T = 25.0 + 8.0 * np.sin(np.linspace(0.0, 5.0, n + 1))
    record, angles = _still(1, np.array([3e-4, -2e-4, 0.0]), T, dt, white, sensor)
    start = estimation.initial_state([1.0, 0, 0, 0], attitude_sigma=0.01, bias_sigma=1e-3)
    noise = estimation.ProcessNoise(angle_random_walk=white, rate_random_walk=walk)
    block = error_states.GyroTemperature(slope_sigma=prior)
    estimate = estimation.run(record, noise, start, (block,), every=10)
    middle = 0.5 * (T[1:] + T[:-1]) - T[0]
    H = np.array([1.0, 0.0, 0.0])
    x, P = (
        np.zeros((3, 3)),
        np.diag([0.01, 1e-3, prior]) ** 2,
    )  # states by rows, axes by columns: P is that of each axis
    rows, spreads, steps = [], [], []
    Q = np.zeros((3, 3))
    Q[:2, :2] = [
        [white**2 * dt + walk**2 * dt**3 / 3.0, -(walk**2) * dt**2 / 2.0],
        [-(walk**2) * dt**2 / 2.0, walk**2 * dt],
    ]
    for k in range(n):
        F = np.array([[1.0, -dt, -middle[k] * dt], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        before = x, P
        x = F @ x
        x[0] += record.increments[k]
        P = F @ P @ F.T + Q
        steps.append((*before, x, P, F))
        if (k + 1) % 10 == 0:
            K = P @ H / (P[0, 0] + sensor**2)
            x, P = x + np.outer(K, angles[(k + 1) // 10 - 1] - x[0]), P - np.outer(K, H @ P)
            J = np.array([1.0, T[k + 1] - T[0]])
            rows.append([x[0], x[1] + x[2] * J[1], x[2]])
            spreads.append([P[0, 0], J @ P[1:, 1:] @ J, P[2, 2]])
    sigma = np.sqrt(np.array(spreads))[:, :, None]
    slopes = estimate.error_states["gyro temperature"]
    ours = np.stack([estimate.rotation.as_rotvec(), estimate.bias, slopes.values], axis=1)[1:]
    # The axes turn into each other by the error's own size.
    assert np.abs((ours - rows) / sigma)[20:].max() < 5e-3
    spread = np.stack([estimate.sigma[:, :3], estimate.sigma[:, 3:], slopes.sigma], axis=1)[1:]
    assert np.abs(spread / sigma - 1.0).max() < 1e-6
    # The smoother, at the start: Rauch, Tung & Striebel.
    for x_f, P_f, x_p, P_p, F in reversed(steps):
        C = np.linalg.solve(P_p, F @ P_f).T
        x, P = x_f + C @ (x - x_p), P_f + C @ (P - P_p) @ C.T
    smoothed = estimation.smooth(record, noise, start, (block,))
    slopes, sigma = smoothed.error_states["gyro temperature"], np.sqrt(np.diag(P))
    ours = np.stack([smoothed.rotation[0].as_rotvec(), smoothed.bias[0], slopes.values[0]])
    assert (np.abs(ours - x) < 5e-3 * sigma[:, None]).all()
    spread = np.stack([smoothed.sigma[0, :3], smoothed.sigma[0, 3:], slopes.sigma[0]])
    np.testing.assert_allclose(spread, np.tile(sigma[:, None], 3), rtol=1e-4)
    np.testing.assert_allclose(smoothed.bias[-1], estimate.bias[-1], rtol=1e-12)
    observed = estimation.observability(record, noise, start, (block,))
    np.testing.assert_allclose(observed.start_sigma, spread.ravel(), rtol=1e-4)


@pytest.mark.parametrize("gate", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["parts", "gate"])
def test_parts_of_a_record_and_a_gate_agree_with_the_whole(gate):
    T = 25.0 + 0.01 * np.arange(4001)
    record, _ = _still(2, np.array([3e-4, -2e-4, 1e-4]), T, 0.05, 1e-5, 1e-3)
    start = estimation.initial_state([1.0, 0, 0, 0], attitude_sigma=0.01, bias_sigma=1e-3)
    noise = estimation.ProcessNoise(angle_random_walk=1e-5, rate_random_walk=1e-7)
    blocks = (error_states.GyroTemperature(slope_sigma=5e-4),)
    whole = estimation.run(record, noise, start, blocks, full_covariance=True)
    assert whole.whole_covariance.shape == (4001, 9, 9)
    assert whole.skipped == {"tracker": 0}
    assert len(whole.innovations["tracker"].time) == 400
    middle = estimation.run_part(records.cut(record, 0, 2000), noise, start, blocks)[1]
    second, end = estimation.run_part(records.cut(record, 2000, 4000), noise, middle, blocks)
    np.testing.assert_allclose(second.bias[-1], whole.bias[-1], rtol=1e-12)
    np.testing.assert_allclose(end.bias, second.bias[-1], rtol=1e-9)  # both at the temperature of the last edge
    if not gate:
        return
    # An outlier and a lasting fault of the sensor: the gate's candidate goes along with the temperature.
    series = record.vectors[0]
    wrong = sd.quaternion.multiply(series.attitude, sd.quaternion.exp([0.0, 0.2, 0.0]))
    bad = np.where((series.time > 100.0)[:, None], wrong, series.attitude)
    faulty = replace(record, vectors=(replace(series, attitude=bad),))
    gated = estimation.run(faulty, noise, start, blocks, gate=Gate(probability=0.999, recovery=5))
    assert [event.kind for event in gated.events] == ["recovery"]
    slope = gated.error_states["gyro temperature"]
    assert (np.abs(slope.values[-1] - [3e-4, -2e-4, 1e-4]) < 4.0 * slope.sigma[-1]).all()
    # The smoother, in parts at the recovery.
    smoothed = estimation.smooth(faulty, noise, start, blocks, gate=Gate(probability=0.999, recovery=5))
    bias = (T - T[0])[:, None] * np.array([3e-4, -2e-4, 1e-4])
    assert (np.abs(smoothed.bias - bias) < 5.0 * smoothed.sigma[:, 3:]).all()
    np.testing.assert_allclose(smoothed.bias[-1], gated.bias[-1], rtol=1e-9)


def test_beyond_the_span_of_the_slope_the_temperature_does_not_drive_the_bias():
    T = 25.0 + 0.01 * np.arange(4001)
    record, _ = _still(2, np.array([3e-4, -2e-4, 1e-4]), np.clip(T, 30.0, 45.0), 0.05, 1e-5, 1e-3)
    states = setup.States(gyro_temperature_sigma=5e-4, gyro_temperature_span=(30.0, 45.0))
    assert setup.states.from_table(setup.states.to_table(states)) == states
    noise = estimation.ProcessNoise(angle_random_walk=1e-5, rate_random_walk=1e-7)
    start = estimation.initial_state([1.0, 0, 0, 0], attitude_sigma=0.01, bias_sigma=1e-3)
    within, beyond = (
        estimation.run(replace(record, temperature=course), noise, start, states.blocks({}))
        for course in (record.temperature, T)
    )
    np.testing.assert_array_equal(beyond.bias, within.bias)
    assert (np.abs(beyond.bias[-1] - 15.0 * np.array([3e-4, -2e-4, 1e-4])) < 4.0 * beyond.sigma[-1, 3:]).all()
    with pytest.raises(InputError, match="span is"):
        error_states.GyroTemperature(slope_sigma=5e-4, span=(45.0, 30.0))


def test_where_nothing_drives_the_bias_the_state_is_refused():
    T = 25.0 + 0.01 * np.arange(101)
    record, _ = _still(2, np.zeros(3), T, 0.05, 1e-5, 1e-3)
    start = estimation.initial_state([1.0, 0, 0, 0], attitude_sigma=0.01, bias_sigma=1e-3)
    noise = estimation.ProcessNoise(angle_random_walk=1e-5, rate_random_walk=1e-7)
    blocks = (error_states.GyroTemperature(slope_sigma=5e-4),)
    with pytest.raises(InputError, match="the record has no temperature, which drives the gyro's bias"):
        estimation.run(replace(record, temperature=None), noise, start, blocks)
    with pytest.raises(InputError, match="a filter of single samples has no bias driven by temperature"):
        estimation.LiveFilter(noise, start, blocks, sensors=record.vectors)
    with pytest.raises(InputError, match="slope_sigma"):
        error_states.GyroTemperature(slope_sigma=[1e-4, 0.0, 1e-4])


@pytest.mark.parametrize("runs", [8, pytest.param(40, marks=pytest.mark.slow)])
def test_a_filter_with_the_slope_is_consistent_over_units_and_one_without_is_not(runs):
    """Each unit has its own slope, drawn from the specification; ANEES of attitude and bias at three times, two-sided."""
    scenario = scenarios.scenario_from_toml(TOML)
    flat = replace(
        scenario.gyro.temperature, coefficients=np.zeros((3, 3)), sigma=np.array([[0.0] * 3, [SLOPE] * 3, [0.0] * 3])
    )
    scenario = replace(
        scenario, gyro=replace(scenario.gyro, temperature=flat, turn_on_bias=np.zeros(3)), duration=120.0
    )
    states = setup.States(gyro_temperature_sigma=SLOPE)
    noise = estimation.ProcessNoise(
        angle_random_walk=0.3 * DEGREE_PER_ROOT_HOUR, rate_random_walk=3.0 * DEGREE_PER_HOUR / 60.0
    )
    filter_setup = setup.FilterSetup(
        process_noise=noise, attitude_sigma=1e-3, bias_sigma=50.0 * DEGREE_PER_HOUR, states=states
    )
    nees = {True: [], False: []}
    for run in range(runs):
        record = scenarios.simulate(scenarios.drawn(scenario, 7, run), 7, run)
        start, truth = drawn_start(record, filter_setup).state, record.truth
        for driven_too, values in nees.items():
            used = filter_setup if driven_too else replace(filter_setup, states=None)
            estimate = setup.run(record, used, start, every=50, full_covariance=True)
            error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude[::50], truth.bias[::50])
            values.append(consistency.nees(error, estimate.covariance)[[20, 60, -1]])
    low, high = chi2.ppf([0.0005, 0.9995], runs * 6) / (runs * 6)
    anees = np.mean(nees[True], axis=0) / 6.0
    assert (low < anees).all()
    assert (anees < high).all()
    assert np.mean(nees[False]) / 6.0 > 2.0


def test_the_matched_filter_has_the_slope_and_a_plain_one_is_named_for_lacking_it():
    scenario = scenarios.scenario_from_toml(TOML)
    warm = replace(
        scenario.gyro.temperature, coefficients=np.array([[0.0] * 3, [1e-5, -2e-5, 0.0]]), sigma=np.zeros((2, 3))
    )
    linear = replace(scenario, gyro=replace(scenario.gyro, temperature=warm))
    states = setup.FilterSetup.for_scenario(linear, states=True).states
    np.testing.assert_allclose(states.gyro_temperature_sigma, [1e-5, 2e-5, 0.0], rtol=1e-12)
    assert "gyro.temperature" in states.names
    assert states.select(("gyro.temperature",)).gyro_temperature_sigma == states.gyro_temperature_sigma
    assert states.select(()).names == ()
    (block,) = states.blocks({})
    np.testing.assert_allclose(block.sigma, [1e-5, 2e-5, 2e-11], rtol=1e-12)  # an axis without one is none, in effect
    missing = "the gyro's bias over temperature"
    plain = setup.FilterSetup.for_scenario(linear, states=False)
    origin = records.Origin(gyro=linear.gyro, scenario=linear)
    assert missing in setup.unmodelled_errors(origin, plain)
    assert missing not in setup.unmodelled_errors(origin, replace(plain, states=states))
    # With a quadratic bias c₂ (T − T₀)² over T₀ ± h the mean square of the slope 2 c₂ (T − T₀) is (2 c₂ h)²/3.
    bent = replace(warm, coefficients=np.array([[0.0] * 3, [0.0] * 3, [1e-6] * 3]), sigma=np.zeros((3, 3)))
    course = scenarios.Temperature(start=20.0, end=40.0)
    curved = replace(scenario, gyro=replace(scenario.gyro, temperature=bent), temperature=course)
    sigma = setup.FilterSetup.for_scenario(curved, states=True).states.gyro_temperature_sigma
    np.testing.assert_allclose(sigma, 2e-6 * 10.0 / np.sqrt(3.0), rtol=1e-3)
    # Below the span, where the bias is constant, the state is not driven, and the size of the slope is that within it.
    beyond = replace(linear, temperature=scenarios.Temperature(start=5.0, end=40.0))
    of_span = setup.FilterSetup.for_scenario(beyond, states=True).states
    assert of_span.gyro_temperature_span == warm.span
    np.testing.assert_allclose(of_span.gyro_temperature_sigma, [1e-5, 2e-5, 0.0], rtol=1e-12)
    # A parabola c₂ (T − T₀)² over T₀ ± h is at most 2/3 c₂ h² from its line of least squares, at the ends.
    for case, said in ((linear, False), (curved, True), (beyond, False)):
        origin = records.Origin(gyro=case.gyro, scenario=case)
        words = setup.unmodelled_errors(origin, setup.FilterSetup.for_scenario(case, states=True))
        assert any("curve of the gyro's bias over temperature" in text for text in words) == said
    assert curved.temperature_curve == pytest.approx(1e-6 * 10.0**2 * 2.0 / 3.0, rel=1e-2)
    plan = montecarlo.Plan(scenario=linear, setup=setup.FilterSetup.for_scenario(linear, states=True))
    assert "bias over temperature" in lanes.supports(plan)
    drawn_only = replace(warm, coefficients=np.zeros((2, 3)), sigma=np.array([[0.0] * 3, [SLOPE] * 3]))
    of_units = replace(scenario, gyro=replace(scenario.gyro, temperature=drawn_only))
    np.testing.assert_allclose(
        setup.FilterSetup.for_scenario(of_units, states=True).states.gyro_temperature_sigma, SLOPE, rtol=1e-12
    )


def test_a_recording_is_corrected_by_the_table_of_its_gyro_or_by_another_one(monkeypatch):
    class Reached(Exception):  # noqa: N818
        pass

    def corrected(source, parameters, warm, **_):
        raise Reached(warm)

    monkeypatch.setattr(sd.ahrs, "without_temperature", corrected)
    spec = scenarios.scenario_from_toml(TOML).gyro
    other = replace(spec.temperature, reference=31.0)
    recording = hand_held.simulated(1, 0, 4.0)
    for options, wanted in (({}, spec.temperature), ({"temperature": other}, other)):
        with pytest.raises(Reached) as reached:
            sd.estimate(recording, noise=spec, **options)
        assert reached.value.args[0] is wanted


def test_lost_samples_keep_their_temperature():
    scenario = scenarios.scenario_from_toml(TOML)
    record = scenarios.simulate(replace(scenario, gyro=replace(scenario.gyro, drop_probability=0.1)))
    T = 40.0 - 20.0 * np.exp(-record.time / 100.0)
    assert len(T) == pytest.approx(13_500, abs=150)  # four σ
    np.testing.assert_allclose(record.temperature, T, rtol=1e-14)
