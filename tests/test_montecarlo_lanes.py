"""The lane machine of the Monte Carlo: the same runs whatever the chunks and lanes, the right distributions, against the scalar machine."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from strapdown import coning, motion, quaternion, vectors
from strapdown.consistency import errors, nees
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.montecarlo import lanes, scalar
from strapdown.montecarlo.plan import Dispersions, Plan
from strapdown.montecarlo.statistics import Statistics
from strapdown.motion.orbit import CircularOrbit
from strapdown.scenarios import Scenario

ARW, RRW = 1e-4, 1e-5
NOISE = ProcessNoise(angle_random_walk=ARW, rate_random_walk=RRW)
UP = vectors.VectorSensor(name="up", reference_f=[0.1, 0.2, 1.0], sigma=0.01, rate=10.0)
NORTH = vectors.VectorSensor(name="north", reference_f=[1.0, 0.0, 0.0], sigma=0.02, rate=7.0, phase=0.033)
SCENARIO = Scenario(
    motion=motion.SpinCone(angle=0.4, precession_rate=0.5, spin_rate=-0.8),
    gyro=GyroSpec(angle_random_walk=ARW, rate_random_walk=RRW, turn_on_bias_sigma=1e-3),
    sensors=(UP, NORTH),
    rate=50.0,
    duration=8.0,
)
SETUP = FilterSetup(process_noise=NOISE, attitude_sigma=0.03, bias_sigma=1e-3)
PLAN = Plan(scenario=SCENARIO, setup=SETUP, seed=5, epochs=20, nis_bins=8)


@pytest.fixture(scope="module")
def many() -> Statistics:
    return lanes.run_chunk(PLAN, 0, 1600)


# ----------------------------------------------------------------------------------------------------- the same runs


def test_an_equal_plan_whose_preparation_is_used_may_be_deleted_meanwhile(monkeypatch):
    class Forgotten(dict):
        def __setitem__(self, plan, prepared):
            pass

    for machine, name in ((lanes, "_PREPARED"), (scalar, "_SCENARIOS")):
        monkeypatch.setattr(machine, name, Forgotten())
        machine.replay(PLAN, 3)


def test_the_replay_is_the_run_bit_for_bit():
    chunk = lanes.run_chunk(PLAN, 3, 1)
    replay = lanes.replay(PLAN, 3)
    estimate, truth = replay.estimate, replay.record.truth
    assert truth is not None
    np.testing.assert_array_equal(chunk.example_error[0, :, 3:], (truth.bias - estimate.bias)[:: PLAN.every])
    np.testing.assert_array_equal(chunk.example_sigma[0], np.sqrt(estimate.variance)[:: PLAN.every])
    np.testing.assert_array_equal(chunk.covariance_sum, estimate.covariance[:: PLAN.every])
    e = errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)[:: PLAN.every]
    np.testing.assert_allclose(chunk.error_sum, e, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(chunk.error_product_sum, e[:, :, None] * e[:, None], rtol=1e-8, atol=1e-17)
    P = estimate.covariance[:: PLAN.every]
    for column, part in enumerate((slice(0, 6), slice(0, 3), slice(3, 6))):
        wanted = nees(e[:, part], P[:, part, part])
        np.testing.assert_allclose(chunk.nees_sum[:, column], wanted, rtol=1e-8)
        np.testing.assert_allclose(chunk.log_nees_sum[:, column], np.log(wanted), atol=1e-8)
        if column == 0:
            assert chunk.worst_score.tolist() == pytest.approx([wanted.max()], rel=1e-8)
    nis = np.array([innovations.nis.sum() for innovations in estimate.innovations.values()])
    np.testing.assert_allclose(chunk.sensor_nis_sum.sum(axis=1), nis, rtol=1e-9)
    eight = lanes.run_chunk(PLAN, 0, 8)  # all of which are kept
    inside = np.abs(eight.example_error)[..., None] <= np.array([1.0, 2.0, 3.0]) * eight.example_sigma[..., None]
    np.testing.assert_array_equal(eight.coverage, inside.sum(axis=0))


# ----------------------------------------------------------------------------------------------------- the right distributions


def test_a_right_filter_is_consistent(many):
    assert (many.finite == 1600).all()
    for column, degrees in ((0, 6), (1, 3), (2, 3)):
        total = many.nees_sum[::4, column]
        p = stats.chi2.cdf(total, 1600 * degrees)
        assert (p > 1e-4).all()
        assert (p < 1.0 - 1e-4).all()
    low, high = many.nis_bounds(confidence_level=0.9999)
    assert low < many.mean_nis < high
    score = many.mean_error / (many.sigma / math.sqrt(1600))
    assert np.abs(score).max() < 4.6
    np.testing.assert_allclose(many.covered, np.array([0.6827, 0.9545, 0.9973]) * np.ones((21, 6, 1)), atol=0.05)


def test_initial_errors_are_the_priors(many):
    start = many.mean_square_error[0]
    expected = np.diag([0.03**2] * 3 + [1e-3**2] * 3)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((start - expected) / scale).max() < 4.5 * math.sqrt(2.0 / 1600)


def test_fixed_errors_and_dispersions():
    prior = Dispersions(attitude_sigma=0.06, bias_sigma=2e-3)  # twice the filter's
    assert lanes.run_chunk(replace(PLAN, dispersions=prior), 0, 400).anees[0, 0] == pytest.approx(4.0, rel=0.12)
    fixed = Dispersions(
        attitude_sigma=0.0, bias_sigma=0.0, attitude_error=[0.01, -0.02, 0.03], bias_error=[1e-3, 0.0, -1e-3]
    )
    s = lanes.run_chunk(replace(PLAN, dispersions=fixed), 0, 8)
    np.testing.assert_allclose(s.mean_error[0], [0.01, -0.02, 0.03, 1e-3, 0.0, -1e-3], rtol=1e-9, atol=1e-15)
    # Without sensors and gyro noise an error matrix M turns the attitude by M ∫w dt.
    plain = replace(SCENARIO, gyro=GyroSpec(), sensors=(), motion=motion.ConstantRate(rate=[0.3, 0.0, 0.0]))
    dispersions = Dispersions(attitude_sigma=0.0, bias_sigma=0.0, scale_factor_sigma=1e-3, misalignment_sigma=2e-3)
    s = lanes.run_chunk(Plan(scenario=plain, setup=SETUP, epochs=20, dispersions=dispersions), 0, 800)
    # Along the axis of turning the error grows with the angle; across it comes round: |∫ R dt| = 2 sin(θ/2)/θ of that.
    angle = 0.3 * 8.0
    across = 2e-3 * 2.0 * math.sin(0.5 * angle)
    expected = [1e-3 * angle, across / math.sqrt(2.0) * math.sqrt(2.0), across]
    np.testing.assert_allclose(s.rms_error[-1, :3], expected, rtol=4.5 / math.sqrt(1600))


@pytest.mark.parametrize(
    ("spec", "exact"),
    [
        # Variance of the angle and of the bias after t: closed forms.
        (GyroSpec(angle_random_walk=1e-3), lambda t: (1e-6 * t, 0.0)),
        (GyroSpec(rate_random_walk=1e-3), lambda t: (1e-6 * t**3 / 3.0, 1e-6 * t)),
        (
            GyroSpec(markov_noise=1e-3, markov_correlation_time=2.0),
            lambda t: (2.0e-6 * 2.0 * (t - 2.0 * (1.0 - math.exp(-t / 2.0))), 1e-6),
        ),
        (GyroSpec(turn_on_bias_sigma=1e-3), lambda t: (1e-6 * t * t, 1e-6)),
    ],
)
def test_gyro_noise_has_its_closed_form(spec, exact):
    """A filter that starts right, with no noise model and no measurement, has the gyro's errors: angle and bias, at rest."""
    still = replace(SCENARIO, gyro=spec, sensors=(), motion=motion.rest())
    dispersions = Dispersions(attitude_sigma=0.0, bias_sigma=0.0)
    plan = Plan(scenario=still, setup=SETUP, epochs=20, dispersions=dispersions)
    group = lanes._Group(plan)
    angle, bias = [], []
    for first in range(0, 1200, 8):
        group.advance(first)
        kept = group.kept.reshape(21, 31, 8)[-1]
        # The filter's bias stays where it started, at the true one; so the angle is that of the drift since, and the start's share.
        start = group.kept.reshape(21, 31, 8)[0, 28:31]
        turned = 2.0 * np.arcsin(kept[1:4])
        angle.append(turned + start * 8.0)
        bias.append(kept[28:31].copy())
    angle_variance, bias_variance = exact(8.0)
    n = 3 * 1200
    assert np.mean(np.square(angle)) == pytest.approx(angle_variance, rel=4.5 * math.sqrt(2.0 / n))
    assert np.mean(np.square(bias)) == pytest.approx(bias_variance, rel=4.5 * math.sqrt(2.0 / n), abs=1e-30)


def test_the_noises_of_a_run_are_independent():
    """White noise and walk of the gyro's three axes and the noise of a sensor, each of the right size: no two share their normals."""
    field = vectors.Magnetometer(name="field", field_f=[1.0, 0.0, 0.0], sigma=0.01, rate=50.0, kind="vector")
    spec = GyroSpec(angle_random_walk=1e-3, rate_random_walk=1e-3)
    still = replace(SCENARIO, gyro=spec, sensors=(field,), motion=motion.rest())
    plan = Plan(scenario=still, setup=SETUP, seed=4, epochs=20)
    columns = []
    for run in range(6):
        record = lanes.replay(plan, run).record
        assert record.truth is not None
        bias, dt = record.truth.bias, 1.0 / still.rate
        white = (record.increments - 0.5 * dt * (bias[1:] + bias[:-1])) / math.sqrt(1e-6 * (dt + dt**3 / 12.0))
        walk = np.diff(bias, axis=0) / (1e-3 * math.sqrt(dt))
        noise = (record.vectors[0].vector_b - [1.0, 0.0, 0.0]) / 0.01
        columns.append(np.hstack([white, walk, noise]))
    x = np.concatenate(columns)
    np.testing.assert_allclose(x.T @ x / len(x), np.eye(9), atol=4.5 * math.sqrt(2.0 / len(x)))


def test_flicker_is_the_simulators():
    spec = GyroSpec(bias_instability=1e-3)
    plan = Plan(scenario=replace(SCENARIO, gyro=spec, sensors=(), motion=motion.rest()), setup=SETUP, epochs=20)
    group = lanes._Group(plan, every=1)
    bias = []
    for first in range(0, 400, 8):
        group.advance(first)
        bias.append(group.kept.reshape(-1, 31, 8)[:, 28:31].copy())
    b = np.stack(bias, axis=1).reshape(len(bias[0]), -1)
    slow = np.stack([scalar.record_of(plan, k).truth.bias for k in range(60)], axis=1).reshape(len(b), -1)
    for lag in (0, 1, 10, 100):
        got, wanted = (np.mean((x[lag:] - x[: len(x) - lag]) ** 2) if lag else np.mean(x**2) for x in (b, slow))
        assert got == pytest.approx(wanted, rel=0.12 if lag else 0.25)
    record = lanes.replay(plan, 0).record  # the bias at an edge is the mean of the drift before it and after it
    drift = record.increments * SCENARIO.rate
    np.testing.assert_allclose(record.truth.bias[1:-1], 0.5 * (drift[1:] + drift[:-1]), rtol=0.0, atol=1e-15)


def test_range_and_resolution_are_the_simulators():
    """Without noise both machines have the same record: clipped in places, rounded by axis."""
    spec = GyroSpec(range=0.3, rate_resolution=np.array([0.01, 0.0, 0.003]), turn_on_bias=[0.1, 0.2, -0.3])
    plan = replace(PLAN, scenario=replace(SCENARIO, gyro=spec))
    increments, wanted = lanes.replay(plan, 0).record.increments, scalar.record_of(plan, 0).increments
    limit = 0.3 / SCENARIO.rate
    assert np.any(np.isclose(wanted, limit, rtol=1e-9))
    assert np.any(np.isclose(wanted, -limit, rtol=1e-9))
    np.testing.assert_allclose(increments, wanted, rtol=0.0, atol=1e-15)


# ----------------------------------------------------------------------------------------------------- all kinds of sensors

SENSORS = {
    "vector": vectors.Magnetometer(
        name="field", field_f=[2e-5, 1e-6, -4e-5], sigma=5e-7, rate=10.0, kind="vector", hard_iron=[1e-8, 0.0, 0.0]
    ),
    "heading": vectors.Magnetometer(name="compass", field_f=[2e-5, 1e-6, -4e-5], sigma=2e-7, rate=10.0, kind="heading"),
    "attitude": vectors.AttitudeSensor(name="tracker", sigma_across=1e-3, sigma_about=5e-3, rate=5.0),
    "tilted": vectors.AttitudeSensor(
        name="tracker", sigma_across=1e-3, sigma_about=8e-3, rate=5.0, boresight=(0.6, 0.0, 0.8)
    ),
    "horizon": vectors.HorizonSensor(name="horizon", orbit=CircularOrbit(altitude=5e5), sigma=0.01, rate=10.0),
    "accelerometer": vectors.Accelerometer(name="up", sigma=0.1, rate=10.0),
    "outliers": replace(UP, faults=vectors.Faults(outlier_probability=0.1, outlier_scale=5.0, outages=((2.0, 3.0),))),
    "correlated": replace(UP, faults=vectors.Faults(correlated_sigma=0.02, correlation_time=0.5)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "tilted" else []) for name in SENSORS]
)
def test_every_sensor_is_that_of_the_scalar_machine(name):
    """Innovations of both machines have the same mean square, by sensor; and the replayed run is what the scalar filter makes of it."""
    sensor = SENSORS[name]
    plan = Plan(scenario=replace(SCENARIO, sensors=(sensor, NORTH)), setup=SETUP, seed=9, epochs=20, nis_bins=8)
    assert not lanes.supports(plan)
    fast, slow = lanes.run_chunk(plan, 0, 2400), scalar.run_chunk(plan, 0, 40)
    np.testing.assert_array_equal(fast.sensor_degrees, 60 * slow.sensor_degrees)
    np.testing.assert_allclose(fast.sensor_nis, slow.sensor_nis, rtol=0.15 if name == "correlated" else 0.08)
    replay = lanes.replay(plan, 2)
    estimate = setup.run(replay.record, SETUP, replay.initial, full_covariance=True)
    np.testing.assert_allclose(estimate.attitude, replay.estimate.attitude, atol=1e-13)
    np.testing.assert_allclose(estimate.bias, replay.estimate.bias, atol=1e-14)
    np.testing.assert_allclose(estimate.variance, replay.estimate.variance, rtol=1e-9)
    innovations = replay.estimate.innovations[sensor.name]
    np.testing.assert_allclose(estimate.innovations[sensor.name].whitened, innovations.whitened, atol=1e-9)


def test_the_noise_of_a_tilted_tracker_is_that_about_its_boresight(monkeypatch):
    """Drawn with the filter of isotropic noise behind it, whose kernel is there already: what is drawn does not depend on it."""
    plan = Plan(scenario=replace(SCENARIO, sensors=(SENSORS["tilted"],)), setup=SETUP, seed=9, epochs=20, nis_bins=8)
    prepared = lanes._prepare(plan)
    assert prepared.filter is not lanes.montecarlo_six
    monkeypatch.setitem(lanes._PREPARED, plan, replace(prepared, filter=lanes.montecarlo_six))
    errors_b = []
    for run in range(30):
        tracker = lanes.replay(plan, run).record.vectors[0]
        truth = plan.scenario.motion.attitude(tracker.time)
        errors_b.append(quaternion.log(quaternion.multiply(quaternion.conjugate(truth), tracker.attitude)))
    e, about = np.concatenate(errors_b), np.array([0.6, 0.0, 0.8])
    wanted = 1e-3**2 * np.eye(3) + (8e-3**2 - 1e-3**2) * np.outer(about, about)
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    np.testing.assert_allclose(e.T @ e / len(e) / scale, wanted / scale, atol=4.5 * math.sqrt(2.0 / len(e)))


def test_coning_algorithms_and_substeps():
    fast = replace(SCENARIO, rate=400.0, motion=motion.Coning(angle=0.05, frequency=20.0))
    four = replace(SETUP, integration=coning.ALGORITHMS["four-sample"])
    plan = Plan(scenario=fast, setup=four, seed=2, epochs=20, nis_bins=8)
    s = lanes.run_chunk(plan, 0, 400)
    assert abs(s.anees[-1, 0] - 1.0) < 4.5 * math.sqrt(2.0 / (6 * 400))
    spun = replace(SCENARIO, motion=motion.ConstantRate(rate=[0.0, 0.0, 60.0]))  # 1.2 rad a sample
    plan = replace(PLAN, scenario=spun)
    s = lanes.run_chunk(plan, 0, 400)
    assert abs(s.anees[-1, 0] - 1.0) < 4.5 * math.sqrt(2.0 / (6 * 400))
    replay = lanes.replay(plan, 0)
    estimate = setup.run(replay.record, SETUP, replay.initial)
    np.testing.assert_allclose(estimate.attitude, replay.estimate.attitude, atol=1e-12)


def test_a_measurement_at_the_end_of_a_cut_step_is_in_the_row_there():
    """Steps of two halves, whose sum rounds to the edge or not, and a measurement at each edge."""
    rate = [0.0, 0.0, 100.0 / 3.0]  # two thirds of a radian a sample
    spun = replace(SCENARIO, motion=motion.ConstantRate(rate=rate), sensors=(replace(UP, rate=50.0),))
    replay = lanes.replay(replace(PLAN, scenario=spun), 0)
    time, half = replay.record.time, 0.5 * np.diff(replay.record.time)
    middle = time[:-1] + half
    assert np.any((time[1:] - middle > half) & (middle + half == time[1:]))  # cut, and yet at the edge
    estimate = setup.run(replay.record, SETUP, replay.initial)
    np.testing.assert_allclose(estimate.variance, replay.estimate.variance, rtol=1e-9)
    np.testing.assert_allclose(estimate.attitude, replay.estimate.attitude, atol=1e-12)


# ----------------------------------------------------------------------------------------------------- what is not served


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gyro": GyroSpec(quantization=1e-6)}, "quantization"),
        ({"gyro": GyroSpec(bandwidth=20.0)}, "bandwidth"),
        ({"sensors": (replace(UP, faults=vectors.Faults(latency=0.1)),)}, "latency"),
        (
            {"sensors": (vectors.HeadingPair(name="pair", baseline_b=[1.0, 0.0, 0.0], sigma=0.01, rate=1.0),)},
            "HeadingPair",
        ),
        ({}, "initial attitude"),
    ],
)
def test_reasons(changes, words):
    vague = SETUP if changes else replace(SETUP, attitude_sigma=1.0)
    assert words in lanes.supports(replace(PLAN, scenario=replace(SCENARIO, **changes), setup=vague))
