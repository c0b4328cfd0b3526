"""Monte Carlo of the filter with optional states: its covariance is consistent with each error state, and not with one left out."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from measured import FIELD, HAND, UP, drawn_start, in_body, series_of

from strapdown import consistency, estimation, gyro, quaternion
from strapdown.checks import InputError
from strapdown.estimation import error_states
from strapdown.estimation.observability import state_names
from strapdown.estimation.states import ProcessNoise
from strapdown.randomness import generator
from strapdown.records import ImuRecord, Truth
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import Accelerometer, Faults, Magnetometer

ATTITUDE_SIGMA, BIAS_SIGMA = 0.02, 3e-3
ARW, RRW = 1e-3, 1e-4

SCALE = error_states.GyroScale(scale_sigma=0.01, misalignment_sigma=0.01)
IRON = error_states.VectorBias(sensor="mag", bias_sigma=5e-6, unit="T")
SOFT = error_states.VectorScale(sensor="mag", scale_sigma=0.02)
SWAY = error_states.GaussMarkov(sensor="acc", noise_sigma=0.4, correlation_time=1.0, unit="m/s²")
MOUNTING = error_states.SensorMounting(sensor="mag", mounting_sigma=0.02)
DRIFT = error_states.GyroGaussMarkov(bias_sigma=4e-3, correlation_time=5.0)

CASES = {
    "gyro scale": (SCALE,),
    "hard iron": (IRON,),
    "soft iron": (SOFT,),
    "acceleration": (SWAY,),
    "gyro drift": (DRIFT,),
    "mounting": (MOUNTING,),
    "all": (SCALE, IRON, SWAY),
}


@dataclasses.dataclass(frozen=True)
class Run:
    """One record, what it starts from, and the truth of the blocks at every edge."""

    record: object
    initial: estimation.State
    noise: ProcessNoise
    truth: dict


def mounted(record: ImuRecord, theta: np.ndarray) -> ImuRecord:
    """Return the record with the magnetometer's axes turned by theta, rad, exactly."""
    turned = [
        dataclasses.replace(series, vector_b=quaternion.rotate(quaternion.exp(-theta), series.vector_b))
        if series.sensor == "mag"
        else series
        for series in record.vectors
    ]
    return dataclasses.replace(record, vectors=tuple(turned))


def simulated(case: str, seed: int, run: int, duration: float) -> Run:
    """Draw the truth of the blocks from their own prior, and what the package's own sensors make of it."""
    blocks = CASES[case]
    rng = generator(seed, run, "truth")
    truth = {block.name: block.sigma * rng.standard_normal(block.size) for block in blocks}
    M = truth[SCALE.name].reshape(3, 3) if SCALE in blocks else np.zeros((3, 3))
    drifts = DRIFT in blocks
    turn_on = BIAS_SIGMA * rng.standard_normal(3)
    spec = gyro.GyroSpec(
        angle_random_walk=ARW,
        rate_random_walk=0.0 if drifts else RRW,
        turn_on_bias=turn_on,
        scale_factor=np.diag(M).copy(),
        misalignment=M - np.diag(np.diag(M)),
        markov_noise=np.sqrt(2.0 / DRIFT.correlation_time) * 4e-3 if drifts else 0.0,
        markov_correlation_time=DRIFT.correlation_time if drifts else np.inf,
    )
    scenario = Scenario(
        motion=HAND,
        gyro=spec,
        sensors=(
            Magnetometer(
                name="mag",
                field_f=FIELD,
                sigma=5e-7,
                rate=10.0,
                kind="vector",
                hard_iron=truth[IRON.name] if IRON in blocks else np.zeros(3),
                soft_iron=truth[SOFT.name].reshape(3, 3) if SOFT in blocks else np.zeros((3, 3)),
            ),
            Accelerometer(
                name="acc",
                sigma=0.05,
                rate=25.0,
                phase=0.013,
                kind="vector",
                faults=Faults(correlated_sigma=0.4, correlation_time=1.0) if SWAY in blocks else Faults(),
            ),
        ),
        rate=50.0,
        duration=duration,
    )
    record = simulate(scenario, seed, run)
    if MOUNTING in blocks:
        record = mounted(record, truth[MOUNTING.name])
    if SWAY in blocks:
        truth[SWAY.name] = None
    if drifts:
        truth[DRIFT.name] = record.truth.bias - turn_on
    begin = Truth(attitude=record.truth.attitude, bias=turn_on[None]) if drifts else record.truth
    initial = drawn_start(begin, rng.standard_normal(6), ATTITUDE_SIGMA, BIAS_SIGMA)
    noise = ProcessNoise(angle_random_walk=ARW, rate_random_walk=0.0 if drifts else RRW)
    return Run(record=record, initial=initial, noise=noise, truth=truth)


@cache
def runs(case: str, number: int, duration: float, seed: int = 11) -> tuple[Run, ...]:
    return tuple(simulated(case, seed, k, duration) for k in range(number))


def judged(case: str, blocks, number: int, duration: float, *, smoothed=False, known=None, seed=11):
    """Return the verdict on all states whose truth is known at an instant, at five epochs of the second half.

    Of an acceleration the package's simulator gives no truth, so it is left out of the error, and its own covariance with it.
    """
    epochs = None
    values = []
    for run in runs(case, number, duration, seed):
        face = estimation.smooth if smoothed else estimation.run
        estimate = face(run.record, run.noise, run.initial, blocks, full_covariance=True)
        if epochs is None:
            epochs = np.linspace(0.4, 0.95, 5) * (len(estimate.time) - 1)
            epochs = epochs.astype(int)
        true_bias = run.record.truth.bias
        if case == "gyro drift":
            true_bias = true_bias - run.truth[DRIFT.name]
        truth = {block.name: run.truth[block.name] for block in blocks if block is not SWAY}
        if any(block is SWAY or block.name == SWAY.name for block in blocks):
            truth[SWAY.name] = np.zeros(3)
        error = estimate.errors(run.record.truth.attitude, true_bias, truth)[epochs]
        P = (estimate.whole_covariance if blocks else estimate.covariance)[epochs]
        names = state_names(blocks)[0]
        kept = [k for k, name in enumerate(names) if not name.startswith(SWAY.name)]
        values.append(consistency.nees(error[:, kept], P[:, kept][:, :, kept]))
    mean = np.mean(values, axis=0) / len(kept)
    return consistency.Verdict(mean=mean, degrees=len(kept), runs=number, probability=0.99)


def quick_or_slow(cases, quick=("gyro scale", "hard iron", "acceleration", "gyro drift")) -> list:
    """Mark the cases slow whose states no other test compiles, which takes 3 to 7 s each."""
    return [pytest.param(case, marks=[] if case in quick else pytest.mark.slow) for case in cases]


@pytest.mark.parametrize(
    ("case", "smoothed"),
    [
        pytest.param(*param.values, smoothed, marks=param.marks)
        for cases, smoothed in ((CASES, False), (("gyro scale", "mounting", "gyro drift", "all"), True))
        for param in quick_or_slow(cases)
    ],
)
def test_the_covariance_is_consistent(case, smoothed):
    verdict = judged(case, CASES[case], 40, 12.0, smoothed=smoothed)
    assert verdict.consistent, (verdict.mean, verdict.simultaneous_bounds)


@pytest.mark.slow
@pytest.mark.parametrize("smoothed", [False, True], ids=["filter", "smoother"])
@pytest.mark.parametrize("case", CASES)
def test_the_covariance_is_consistent_in_many_runs(case, smoothed):
    verdict = judged(case, CASES[case], 600, 40.0, smoothed=smoothed, seed=12)
    assert verdict.consistent, (verdict.mean, verdict.simultaneous_bounds)


@pytest.mark.parametrize("case", [name for name in CASES if name != "all"])
def test_it_is_not_with_the_block_left_out(case):
    verdict = judged(case, (), 40, 12.0)
    assert verdict.outside == 5
    assert np.all(verdict.mean > 1.5)


def otherwise(block, **effect):
    """A block with another effect on the magnetometer."""
    names = {name: getattr(block, name) for name in ("name", "components", "units", "sigma")}
    effects = {"mag": error_states.Effect(**effect)}
    return type("Otherwise", (error_states.ErrorStates,), {**names, "effects": effects})()


BROKEN = {
    "a prior too narrow": ("gyro scale", error_states.GyroScale(scale_sigma=0.002, misalignment_sigma=0.002)),
    "the wrong sign": ("hard iron", otherwise(IRON, offset_b=-np.eye(3))),
    "a correlation too short": ("acceleration", dataclasses.replace(SWAY, correlation_time=0.1)),
    "a drift too small": ("gyro drift", dataclasses.replace(DRIFT, bias_sigma=1e-3)),
    "rows for columns": ("soft iron", otherwise(SOFT, scale=np.swapaxes(np.eye(9).reshape(9, 3, 3), 1, 2))),
    "a mounting of another sensor": ("mounting", dataclasses.replace(MOUNTING, sensor="acc")),
}


@pytest.mark.parametrize(
    "how", quick_or_slow(BROKEN, ("a prior too narrow", "a correlation too short", "a drift too small"))
)
def test_it_is_not_with_the_block_broken(how):
    case, block = BROKEN[how]
    assert not judged(case, (block,), 40, 12.0).consistent


@pytest.mark.parametrize("case", quick_or_slow(["gyro scale", "hard iron", "soft iron", "mounting", "all"]))
def test_calibration_is_found(case):
    """After a while of turning, what the simulated sensors have is found to a fraction of what was known before."""
    run = simulated(case, 21, 0, 60.0)
    estimate = estimation.run(run.record, run.noise, run.initial, CASES[case])
    for block in CASES[case]:
        if block is SWAY:
            continue
        state = estimate.error_states[block.name]
        error = run.truth[block.name] - state.values[-1]
        assert np.all(np.abs(error) < 4.0 * state.sigma[-1])
        assert np.all(state.sigma[-1] < 0.25 * block.sigma)
        assert np.linalg.norm(error) < 0.25 * np.linalg.norm(run.truth[block.name])


def swaying(seed: int, sigma: float, tau: float, duration: float = 60.0):
    """A record simulated here: a Gauss–Markov specific force in fixed axes, and what it was at each second edge but the first."""
    rng = generator(seed, 0, "sway")
    edges = np.arange(round(50.0 * duration) + 1) / 50.0
    phi = np.exp(-0.04 / tau)
    time = edges[2::2]
    sway = sigma * rng.standard_normal((len(time), 3))
    for k in range(1, len(time)):
        sway[k] = phi * sway[k - 1] + np.sqrt(1.0 - phi**2) * sway[k]
    series = []
    for name, reference, noise, extra in (("acc", UP, 0.05, sway), ("mag", FIELD, 5e-7, np.zeros(3))):
        z = in_body(HAND.attitude(time), reference + extra) + noise * rng.standard_normal(sway.shape)
        series.append(series_of(name, "vector", time, z, reference, noise))
    increments = HAND.increments(edges) + ARW * np.sqrt(0.02) * rng.standard_normal((len(edges) - 1, 3))
    block = error_states.GaussMarkov(sensor="acc", noise_sigma=sigma, correlation_time=tau, frame="fixed", unit="m/s²")
    return ImuRecord(time=edges, increments=increments, vectors=tuple(series)), sway, block


def test_an_acceleration_is_followed():
    record, sway, block = swaying(5, 0.5, 0.8)
    initial = estimation.initial_state(HAND.attitude(np.array(0.0)), attitude_sigma=0.01, bias_sigma=1e-3)
    noise = ProcessNoise(angle_random_walk=ARW, rate_random_walk=0.0)
    disturbance = estimation.run(record, noise, initial, (block,), every=2).error_states["acc disturbance"]
    error = sway - disturbance.values[1:]
    late = slice(200, None)
    assert np.sqrt(np.mean(error[late] ** 2)) < 0.2
    assert 0.7 < np.mean((error[late] / disturbance.sigma[1:][late]) ** 2) < 1.4


@pytest.mark.parametrize("initial_sigma", [8e-3, np.array([1e-3, 4e-3, 3e-2])])
def test_a_drift_that_starts_larger_settles_to_its_stationary_sigma(initial_sigma):
    """Without measurements the variance is σ² + (σ₀² − σ²) e^{−2t/τ}; the attitude has the integral of the drift, by quadrature."""
    sigma, tau, dt, steps = 2e-3, 3.0, 0.1, 120
    block = error_states.GyroGaussMarkov(bias_sigma=sigma, initial_sigma=initial_sigma, correlation_time=tau)
    silent = tuple(series_of(name, "vector", [], np.empty((0, 3)), UP, 0.05) for name in ("mag", "acc"))
    record = ImuRecord(time=dt * np.arange(steps + 1), increments=np.zeros((steps, 3)), vectors=silent)
    start = estimation.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=1e-9, bias_sigma=1e-12)
    noise = ProcessNoise(angle_random_walk=1e-9, rate_random_walk=0.0)
    estimate = estimation.run(record, noise, start, (block,), full_covariance=True)
    t, start_variance = estimate.time[:, None], np.broadcast_to(np.square(initial_sigma), 3)
    expected = sigma**2 + (start_variance - sigma**2) * np.exp(-2.0 * t / tau)
    np.testing.assert_allclose(estimate.error_states["gyro drift"].sigma ** 2, expected, rtol=1e-9)
    # E of the square of ∫ c dt: that of the start decays, the driven rest is white.
    s, end = np.linspace(0.0, t[-1, 0], 4001), t[-1, 0]
    gain = tau * -np.expm1(-(end - s) / tau)
    driven = 2.0 * sigma**2 / tau * np.trapezoid(gain**2, s)
    angle = start_variance * gain[0] ** 2 + driven
    np.testing.assert_allclose(np.diagonal(estimate.covariance[-1, :3, :3]), angle, rtol=1e-5)


def test_a_drift_without_an_initial_sigma_is_stationary():
    block = error_states.GyroGaussMarkov(bias_sigma=2e-3, correlation_time=3.0)
    assert dataclasses.replace(block, bias_sigma=1e-3).sigma.tolist() == [1e-3] * 3
    with pytest.raises(InputError, match=r"gyro drift: initial_sigma\[0\] is -1"):
        dataclasses.replace(block, initial_sigma=-1.0)


@pytest.mark.parametrize("sigma", [0.5, 5.0])
def test_an_acceleration_shows_no_heading(sigma):
    """Turn body and acceleration about the vertical together: nothing changes. The variance of the heading only grows."""
    record, _, block = swaying(6, sigma, 0.8)
    acc, mag = record.vectors
    silent = dataclasses.replace(
        mag, vector_b=np.full_like(mag.vector_b, np.nan)
    )  # the structure is that of other tests
    record = dataclasses.replace(record, vectors=(acc, silent))
    initial = estimation.initial_state(HAND.attitude(np.array(0.0)), attitude_sigma=0.01, bias_sigma=1e-6)
    noise = ProcessNoise(angle_random_walk=ARW, rate_random_walk=0.0)
    estimate = estimation.run(record, noise, initial, (block,), every=50, full_covariance=True)
    vertical = quaternion.rotate(quaternion.conjugate(estimate.attitude), [0.0, 0.0, 1.0])
    heading = np.einsum("ki,kij,kj->k", vertical, estimate.covariance[:, :3, :3], vertical)
    expected = 0.01**2 + ARW**2 * estimate.time
    np.testing.assert_allclose(heading, expected, rtol=0.05)
