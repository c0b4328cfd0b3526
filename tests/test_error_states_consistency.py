"""Monte Carlo of the filter with optional states: its covariance is consistent with each error state, and not with one left out."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from measured import FIELD, HAND, beside_silent, drawn_start, series_of, state_errors

from strapdown import consistency, estimation, gyro, motion, quaternion, workflows
from strapdown.estimation import error_states
from strapdown.estimation.observability import state_names
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.estimation.states import ProcessNoise
from strapdown.randomness import generator
from strapdown.records import ImuRecord, Truth
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import Accelerometer, Faults, Magnetometer

ATTITUDE_SIGMA, BIAS_SIGMA = 0.02, 3e-3
ARW, RRW = 1e-3, 1e-4

SCALE = error_states.GyroScale(scale_sigma=0.01, misalignment_sigma=0.01)
IRON = error_states.VectorBias(sensor="mag", bias_sigma=5e-6, unit="T")
SWAY = error_states.GaussMarkov(sensor="force", noise_sigma=0.4 / 9.81, correlation_time=1.0)
MOUNTING = error_states.SensorMounting(sensor="mag", mounting_sigma=0.02)
DRIFT = error_states.GyroGaussMarkov(bias_sigma=4e-3, correlation_time=5.0)

CASES = {
    "gyro scale": (SCALE,),
    "hard iron": (IRON,),
    "acceleration": (SWAY,),
    "gyro drift": (DRIFT,),
    "mounting": (MOUNTING,),
    "every kind": (SCALE, DRIFT, IRON, SWAY),
}
"""The last has the structure of :data:`measured.EVERY_KIND`: its kernels are those of other tests, and the rest is slow."""
GYRO_RATE = {"gyro scale": 200.0}
"""Hz; at 50 Hz the rate that is taken as constant within an interval looks like a scale factor of half its σ after 40 s."""


@dataclasses.dataclass(frozen=True)
class Run:
    """One record, what it starts from, and the truth of the blocks at every edge."""

    record: object
    initial: estimation.State
    noise: ProcessNoise
    truth: dict


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
            ),
            Accelerometer(
                name="force",
                sigma=0.05,
                rate=25.0,
                phase=0.013,
                faults=Faults(correlated_sigma=0.4, correlation_time=1.0) if SWAY in blocks else Faults(),
            ),
        ),
        rate=GYRO_RATE.get(case, 50.0),
        duration=duration,
    )
    record = simulate(scenario, seed, run)
    mag, force = record.vectors
    if MOUNTING in blocks:
        turn = quaternion.exp(-truth[MOUNTING.name])
        mag = dataclasses.replace(mag, vector_b=quaternion.rotate(turn, mag.vector_b))
    mag = dataclasses.replace(mag, sigma=0.0, covariance=mag.covariances)
    record = dataclasses.replace(record, vectors=beside_silent(mag, force))
    if SWAY in blocks:
        truth[SWAY.name] = np.zeros(3)
    if drifts:
        truth[DRIFT.name] = record.truth.bias - turn_on
    begin = Truth(attitude=record.truth.attitude, bias=turn_on[None]) if drifts else record.truth
    initial = drawn_start(begin, rng.standard_normal(6), ATTITUDE_SIGMA, BIAS_SIGMA)
    noise = ProcessNoise(angle_random_walk=ARW, rate_random_walk=0.0 if drifts else RRW)
    return Run(record=record, initial=initial, noise=noise, truth=truth)


@cache
def runs(case: str, number: int, duration: float, seed: int = 11) -> tuple[Run, ...]:
    return tuple(simulated(case, seed, k, duration) for k in range(number))


def judged(
    case: str, blocks, number: int, duration: float, *, smoothed=False, seed=11
) -> dict[str, consistency.Verdict]:
    """Return verdicts on attitude, bias and each block, and on all, at five epochs of the second half; 99 % of right filters have all.

    Of an acceleration the package's simulator gives no truth, so it is left out of the error, and its own covariance with it.
    """
    names = np.array([name.rpartition(" ")[0] for name in state_names(blocks)[0]])
    parts = {name: np.flatnonzero(names == name) for name in dict.fromkeys(names) if name != SWAY.name}
    parts["all"] = np.flatnonzero(names != SWAY.name)
    values: dict[str, list] = {name: [] for name in parts}
    for run in runs(case, number, duration, seed):
        face = estimation.smooth if smoothed else estimation.run
        estimate = face(run.record, run.noise, run.initial, blocks, full_covariance=True)
        epochs = (np.linspace(0.4, 0.95, 5) * (len(estimate.time) - 1)).astype(int)
        true_bias = run.record.truth.bias
        if DRIFT.name in run.truth and any(block.name == DRIFT.name for block in blocks):
            true_bias = true_bias - run.truth[DRIFT.name]
        truth = {block.name: run.truth[block.name] for block in blocks}
        error = state_errors(estimate, run.record.truth.attitude, true_bias, truth)[epochs]
        P = (estimate.whole_covariance if blocks else estimate.covariance)[epochs]
        for name, part in parts.items():
            values[name].append(consistency.nees(error[:, part], P[:, part][:, :, part]))
    each = 1.0 - 0.01 / len(parts)
    return {
        name: consistency.Verdict(
            mean=np.mean(values[name], axis=0) / len(part), degrees=len(part), runs=number, confidence_level=each
        )
        for name, part in parts.items()
    }


def wrong(verdicts) -> dict[str, np.ndarray]:
    """Return what lies outside its bounds."""
    return {name: verdict.mean for name, verdict in verdicts.items() if not verdict.consistent}


@pytest.mark.parametrize("smoothed", [False, True], ids=["filter", "smoother"])
def test_the_covariance_is_consistent(smoothed):
    assert wrong(judged("every kind", CASES["every kind"], 40, 12.0, smoothed=smoothed)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("smoothed", [False, True], ids=["filter", "smoother"])
@pytest.mark.parametrize("case", CASES)
def test_the_covariance_is_consistent_in_many_runs(case, smoothed):
    assert wrong(judged(case, CASES[case], 600, 40.0, smoothed=smoothed, seed=12)) == {}


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_a_rate_that_changes_within_an_interval_looks_like_a_scale_factor(share):
    """Between samples an angle A sin Ωt is interpolated along its chord, which is smaller by ½ f (1 − f) (Ωh)²."""
    step, frequency, amplitude = 0.02, 2.0 * np.pi * 0.8, 0.3
    angle = lambda t: np.multiply.outer(amplitude * np.sin(frequency * t), [0.0, 0.0, 1.0])  # noqa: E731
    edges = step * np.arange(2001)
    time = edges[:-1:5] + share * step
    star = quaternion.rotate(quaternion.exp(-angle(time)), [1.0, 0.0, 0.0])
    series = series_of("star", "direction", time, star, [1.0, 0.0, 0.0], 1e-3)
    record = ImuRecord(time=edges, increments=np.diff(angle(edges), axis=0), vectors=(series,))
    initial = estimation.initial_state(np.array([1.0, 0.0, 0.0, 0.0]), attitude_sigma=0.01, bias_sigma=1e-3)
    noise = ProcessNoise(angle_random_walk=1e-5, rate_random_walk=0.0)
    block = error_states.GyroScale(scale_sigma=(0.0, 0.0, 0.01), misalignment_sigma=0.0)
    scale = estimation.run(record, noise, initial, (block,)).error_states["gyro scale"].values[-1, 0]
    assert scale == pytest.approx(-0.5 * share * (1.0 - share) * (frequency * step) ** 2, rel=0.05)


BROKEN = {
    "a prior too narrow": (0, {"scale_sigma": 0.002, "misalignment_sigma": 0.002}),
    "a drift too small": (1, {"bias_sigma": 1e-3}),
    "no hard iron": (2, {"bias_sigma": 1e-12}),
    "a correlation too short": (3, {"correlation_time": 0.1}),
}


@pytest.mark.parametrize("how", BROKEN)
def test_it_is_not_with_a_block_broken(how):
    blocks = list(CASES["every kind"])
    k, changes = BROKEN[how]
    blocks[k] = dataclasses.replace(blocks[k], **changes)
    assert wrong(judged("every kind", tuple(blocks), 40, 12.0))


@pytest.mark.parametrize("case", [pytest.param("mounting", marks=pytest.mark.slow), "every kind"])
def test_calibration_is_found(case):
    """After a while of turning, what the simulated sensors have is found to a fraction of what was known before."""
    run = simulated(case, 21, 0, 60.0)
    estimate = estimation.run(run.record, run.noise, run.initial, CASES[case])
    for block in CASES[case]:
        if block in (SWAY, DRIFT):
            continue
        state = estimate.error_states[block.name]
        error = run.truth[block.name] - state.values[-1]
        assert np.all(np.abs(error) < 4.0 * state.sigma[-1])
        assert np.all(state.sigma[-1] < 0.25 * block.sigma)
        assert np.linalg.norm(error) < 0.25 * np.linalg.norm(run.truth[block.name])


def test_a_start_from_measurements_includes_the_errors_of_the_sensors_that_are_states():
    """With biases of fifteen times the noise, the attitude after the first measurements has the covariance that they leave."""
    nees, field = [], np.array([0.0, 2e-5, -4e-5])
    deviation = {"force": 0.03, "mag": 0.03}
    states = States(sensors={name: SensorStates(bias_sigma=sigma) for name, sigma in deviation.items()})
    noise = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)
    setup = FilterSetup(process_noise=noise, attitude_sigma=0.1, bias_sigma=1e-3, states=states)
    for seed in range(24):
        bias, iron = generator(seed, 0, "biases").standard_normal((2, 3))
        sensors = (
            Accelerometer(name="force", rate=20.0, sigma=0.02, bias=9.80665 * deviation["force"] * bias),
            Magnetometer(
                name="mag",
                rate=20.0,
                field_f=field,
                sigma=9e-8,
                hard_iron=deviation["mag"] * np.linalg.norm(field) * iron,
            ),
        )
        spec = gyro.GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-6, turn_on_bias_sigma=1e-3)
        resting = Scenario(motion=motion.rest(), gyro=spec, sensors=sensors, rate=100.0, duration=2.5)
        record = simulate(resting, seed)
        estimate = workflows.estimate(record, setup=setup)
        k = int(np.searchsorted(estimate.time, 0.055))
        error = quaternion.rotation_between(estimate.attitude[k], record.truth.attitude[k])
        nees.append(error @ np.linalg.solve(estimate.covariance[k, :3, :3], error))
    assert 0.5 < np.mean(nees) / 3.0 < 1.7  # 72 degrees of freedom: 99.9 % of right filters
