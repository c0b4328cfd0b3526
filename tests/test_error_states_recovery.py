"""A gate that recovers beside optional states: lock-in by a wrong start, a gap, a magnet; what a candidate knows; both faces; outliers."""

import dataclasses
import itertools
from collections.abc import Callable

import in_steps
import numpy as np
import pytest
from gated_steps import GatedStepFilter
from measured import (
    FIELD,
    HAND,
    UP,
    assert_inside,
    drawn_start,
    errors,
    in_body,
    recoveries,
    sample,
    series_of,
    state_errors,
    unit,
)

from strapdown import consistency, estimation, montecarlo, quaternion, records
from strapdown.estimation import error_states, forward, setup
from strapdown.estimation.gating import UNIFORM_SIGMA, Gate, Robust
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.estimation.states import ProcessNoise, State, restart_bias_variance
from strapdown.gyro import GyroSpec
from strapdown.kernels import gate_rules
from strapdown.kernels.gate_rules import WIDE_PASSES
from strapdown.randomness import generator
from strapdown.records import ImuRecord, Truth
from strapdown.scenarios import Scenario
from strapdown.vectors import Accelerometer, Magnetometer, VectorMeasurements

NOISE = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-5)
ATTITUDE_SIGMA, BIAS_SIGMA = 0.01, 3e-3

IRON = error_states.VectorBias(sensor="mag", bias_sigma=1e-6, unit="T")
SCALE = error_states.GyroScale(scale_sigma=0.01, misalignment_sigma=0.01)
SWAY = error_states.GaussMarkov(sensor="acc", noise_sigma=0.2, correlation_time=1.0, unit="m/s²")


CASES: dict[str, tuple[tuple[str, ...], tuple[error_states.ErrorStates, ...]]] = {
    "hard iron": (("mag", "acc"), (IRON,)),
    "all": (("mag", "acc"), (IRON, SCALE, SWAY)),
}
"""Which sensors measure, and the states."""
QUICK = ("hard iron", "chains")
"""Cases of the default run; with a gate each takes 6 to 10 s to compile."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """A record, what a right filter starts from, and the truth of the blocks."""

    record: ImuRecord
    initial: estimation.State
    truth: dict


def simulated(
    case: str, run: int, duration: float = 12.0, rate: float = 10.0, magnet: float = 0.0, states: float = 1.0
) -> Trial:
    """Draw the truth of the states from their prior, and what sensors make of it, each at times of its own.

    ``magnet``: so long, in s, the hard iron is off by 3.3 standard deviations. ``states`` is the share of the states that there is.
    """
    sensors, blocks = CASES[case]
    rng = generator(5, run, case)
    truth = {block.name: states * block.sigma * rng.standard_normal(block.size) for block in blocks}
    edges = np.arange(round(50 * duration) + 1) / 50.0
    bias = BIAS_SIGMA * rng.standard_normal(3)
    turn = HAND.increments(edges)
    if SCALE.name in truth:
        turn = turn + turn @ truth[SCALE.name].reshape(3, 3).T
    turn = turn + 0.02 * bias + 1e-3 * np.sqrt(0.02) * rng.standard_normal(turn.shape)
    series = tuple(
        measured(name, np.arange(0.0123 * k, duration, 1.0 / rate), truth, rng, magnet)
        for k, name in enumerate(sensors)
    )
    q = HAND.attitude(edges)
    known = Truth(attitude=q, bias=np.broadcast_to(bias, (len(edges), 3)).copy())
    record = ImuRecord(time=edges, increments=turn, vectors=series, truth=known)
    initial = drawn_start(known, rng.standard_normal(6), ATTITUDE_SIGMA, BIAS_SIGMA)
    return Trial(record=record, initial=initial, truth=truth)


def measured(name, time, truth, rng, magnet) -> VectorMeasurements:
    def seen_by(reference):
        return in_body(HAND.attitude(time), reference)

    def white(sigma):
        return sigma * rng.standard_normal((len(time), 3))

    def series(kind, reference, value, sigma):
        return series_of(name, kind, time, value, reference, sigma)

    if name == "mag":
        off = truth[IRON.name] + np.where(time[:, None] < magnet, 3.3e-6 * np.array([0.6, -0.8, 0.0]), 0.0)
        return series("vector", FIELD, seen_by(FIELD) + off + white(3e-7), 3e-7)
    coloured = np.zeros((len(time), 3))
    if np.any(truth.get(SWAY.name, 0.0)):
        keep = np.exp(-np.diff(time, prepend=time[0]) / SWAY.correlation_time)
        drive = white(0.2) * np.sqrt(1.0 - keep**2)[:, None]
        coloured[0] = truth[SWAY.name]
        for k in range(1, len(time)):
            coloured[k] = keep[k] * coloured[k - 1] + drive[k]
    return series("vector", UP, seen_by(UP) + coloured + white(0.05), 0.05)


def lost(state: estimation.State, run: int) -> estimation.State:
    """The state turned by a quarter to half a turn about any axis, and as sure of itself as before."""
    rng = generator(6, run, "lost")
    turn = unit(rng.standard_normal(3)) * rng.uniform(0.5 * np.pi, np.pi)
    return dataclasses.replace(state, attitude=quaternion.multiply(state.attitude, quaternion.exp(turn)))


def without_gyro(trial: Trial, begin: float, end: float) -> Trial:
    """The gyro, and all else, is out for a while, in which the body turns on: over the gap no turn is measured."""
    record = trial.record
    i, j = np.searchsorted(record.time, [begin - 1e-9, end - 1e-9])
    kept = np.r_[0 : i + 1, j : len(record.time)]
    increments = np.concatenate([record.increments[:i], np.zeros((1, 3)), record.increments[j:]])
    series = tuple(s.taken(np.flatnonzero((s.time < begin) | (s.time > end))) for s in record.vectors)
    truth = Truth(attitude=record.truth.attitude[kept], bias=record.truth.bias[kept])
    cut = ImuRecord(time=record.time[kept], increments=increments, vectors=series, truth=truth)
    return dataclasses.replace(trial, record=cut)


def judged(case: str, runs: int, make: Callable[[int], Trial], after, since: float = 0.0, bias_sigma: float = 1e-5):
    """Return of each run the recoveries, and ANEES of attitude, bias and blocks at times after the first that ends after ``since``.

    ``bias_sigma`` is how far the bias has jumped. There is no truth of an acceleration, and it is left out.
    """
    gate = Gate(restart_bias_sigma=bias_sigma)
    blocks = CASES[case][1]
    recovered, nees = [], []
    for run in range(runs):
        trial = make(run)
        estimate = estimation.run(trial.record, NOISE, trial.initial, blocks, gate=gate, full_covariance=True)
        recovered.append([event for event in recoveries(estimate) if event.end > since])
        if not recovered[-1]:
            continue
        values = {block.name: np.zeros(3) if block is SWAY else trial.truth[block.name] for block in blocks}
        error = state_errors(estimate, trial.record.truth.attitude, trial.record.truth.bias, values)
        last = 6 + sum(block.size for block in blocks if block is not SWAY)  # which comes last
        rows = np.searchsorted(estimate.time, recovered[-1][0].end + np.asarray(after) - 1e-9)
        parts = slice(0, 3), slice(3, 6), slice(6, last)
        P = estimate.whole_covariance
        nees.append([[consistency.nees(error[k, s], P[k][s, s]) / len(error[k, s]) for s in parts] for k in rows])
    return recovered, np.mean(nees, axis=0)


def assert_consistent(case: str, mean, runs: int) -> None:
    size = sum(block.size for block in CASES[case][1] if block is not SWAY)
    for part, degrees in enumerate((3, 3, size)):
        assert_inside(mean[:, part], degrees, runs, 0.9999)


def quick_or_slow(cases) -> list:
    return [pytest.param(case, marks=[] if case in QUICK else pytest.mark.slow) for case in cases]


RUNS = [40, pytest.param(400, marks=pytest.mark.slow)]


# --------------------------------------------------------------------------------------------------------------------------- lock-in


@pytest.mark.parametrize("runs", RUNS)
@pytest.mark.parametrize("case", quick_or_slow(CASES))
def test_a_lost_start_is_recovered_from_and_all_states_are_consistent(case, runs):
    def make(run):
        trial = simulated(case, run)
        return dataclasses.replace(trial, initial=lost(trial.initial, run))

    recovered, mean = judged(case, runs, make, (0.1, 1.0, 3.0, 8.0))
    for events in recovered:
        (event,) = events
        assert event.start <= 0.1 + 1e-9
        assert event.end <= 1.2 + 1e-9
        assert event.value >= 10
        assert event.sensor in CASES[case][0]
        assert f"measurements of {event.sensor} in a row were rejected" in str(event)
    assert_consistent(case, mean, runs)


@pytest.mark.parametrize("runs", RUNS)
@pytest.mark.parametrize("case", quick_or_slow(CASES))
def test_a_turn_in_a_gap_of_the_gyro_is_recovered_from(case, runs):
    """20 s of calibration, then 2 s without a gyro: the attitude is off by up to half a turn, and all else is as it was."""
    recovered, mean = judged(
        case, runs, lambda run: without_gyro(simulated(case, run, 35.0), 20.0, 22.0), (0.1, 1.0, 3.0, 11.0), since=20.0
    )
    for events in recovered:
        (event,) = events
        assert 19.0 <= event.start <= 22.3  # from the first refusal on, which may be one by chance right before the gap
        assert event.end <= 23.5
    assert_consistent(case, mean, runs)


@pytest.mark.parametrize("runs", RUNS)
def test_a_state_that_was_led_astray_recovers_too(runs):
    """A magnet is carried for 15 s and learnt as hard iron; taken away, that is off by 3.3 σ of the prior, and by 50 of its own."""
    recovered, mean = judged(
        "hard iron", runs, lambda run: simulated("hard iron", run, 27.0, magnet=15.0), (0.1, 1.0, 3.0, 10.0), since=15.0
    )
    for events in recovered:
        (event,) = events
        assert 14.9 < event.start < 15.2
        assert event.sensor == "mag"
    assert_consistent("hard iron", mean, runs)


@pytest.mark.parametrize("runs", RUNS)
def test_a_step_of_the_bias_is_recovered_from(runs):
    """By 17 °/s (1 σ) on each axis after 12 s: the attitude is off when it shows, and the states, which it has drawn along, start anew."""

    def make(run):
        trial = simulated("hard iron", run, 24.0)
        step = 0.3 * generator(8, run, "step").standard_normal(3)
        record = trial.record
        later = (record.time[1:] > 12.0)[:, None]
        truth = Truth(attitude=record.truth.attitude, bias=record.truth.bias + (record.time >= 12.0)[:, None] * step)
        stepped = dataclasses.replace(record, increments=record.increments + 0.02 * later * step, truth=truth)
        return dataclasses.replace(trial, record=stepped)

    recovered, mean = judged("hard iron", runs, make, (0.1, 1.0, 3.0, 9.0), since=12.0, bias_sigma=0.3)
    assert all(len(events) == 1 and events[0].start < 13.2 for events in recovered)
    assert_consistent("hard iron", mean, runs)


def test_by_default_a_candidate_doubts_the_bias_as_at_the_start():
    """After a gap the bias is as it was; the default, which allows it to have changed, is on the safe side until it is learnt anew."""
    gate = Gate()
    P = np.diag([1.0, 1.0, 1.0, 1e-4, 2e-4, 3e-4, 5.0])
    first = State(attitude=quaternion.IDENTITY, bias=np.zeros(3), values=np.zeros(1), covariance=P)
    assert np.array_equal(restart_bias_variance(gate, first), [1e-4, 2e-4, 3e-4])
    gap = lambda run: without_gyro(simulated("hard iron", run, 32.0), 20.0, 22.0)  # noqa: E731
    _, mean = judged("hard iron", 20, gap, (0.1, 9.0), 20.0, BIAS_SIGMA)
    high = consistency.mean_bounds(3, 20, 0.9999)[1]
    assert mean[0, 1] < 0.5
    assert np.all(mean < high)


# ---------------------------------------------------------------------------------------------------------- what a candidate knows


def test_a_start_that_is_surer_than_its_blocks_is_not_accepted_by_a_candidate():
    """A start that goes on from an earlier part: its values are kept, and what it knows of them is what the block says at least."""
    trial = simulated("hard iron", 2)
    begun = estimation.with_error_states(trial.initial, (IRON,))
    P = begun.covariance.copy()
    P[6:, 6:] = np.diag([1e-8, 1e-8, 3e-6]) ** 2
    P[6, 7] = P[7, 6] = 5e-17
    values, covariance = forward.restart_states(
        dataclasses.replace(begun, values=np.array([1e-6, 2e-6, 3e-6]), covariance=P), (IRON,)
    )
    assert np.array_equal(values, [1e-6, 2e-6, 3e-6])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [1e-6, 1e-6, 3e-6])
    assert covariance[0, 1] == 5e-17


@pytest.mark.parametrize("seed", range(8))
def test_attitude_and_hard_iron_from_nothing_are_the_batch_solution(seed):
    """An attitude of which nothing is known, a field with an unknown hard iron, then the vertical: as one least squares of both.

    The turn about the field, of up to half a turn, is found last, and must leave alone what ties tilt and hard iron in the body.
    """
    from scipy.optimize import least_squares

    rng = np.random.default_rng(seed)
    true, guess = unit(rng.standard_normal(4)), unit(rng.standard_normal(4))
    iron = 1e-6 * rng.standard_normal(3)
    mag = in_body(true, FIELD) + iron + 3e-7 * rng.standard_normal(3)
    acc = in_body(true, UP) + 0.05 * rng.standard_normal(3)
    start = estimation.initial_state(guess, attitude_sigma=UNIFORM_SIGMA, bias_sigma=BIAS_SIGMA)
    face = GatedStepFilter(NOISE, start, (IRON,), sensors=("mag", "acc"))
    face._passes = WIDE_PASSES
    assert face.update(sample("vector", mag, FIELD, 3e-7, "mag"))
    assert face.update(sample("vector", acc, UP, 0.05, "acc"))

    def residuals(p):
        q = quaternion.multiply(true, quaternion.exp(p[:3]))
        field = in_body(q, FIELD) + 1e-6 * p[3:]
        return np.concatenate([(mag - field) / 3e-7, (acc - in_body(q, UP)) / 0.05, p[3:]])

    solution = least_squares(residuals, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    best = quaternion.multiply(true, quaternion.exp(solution.x[:3]))
    P = np.linalg.inv(solution.jac.T @ solution.jac)
    turn = quaternion.log(quaternion.multiply(quaternion.conjugate(face.attitude), best))
    error = np.concatenate([turn, solution.x[3:] - 1e6 * face.values])
    assert np.max(np.abs(error) / np.sqrt(np.diag(P))) < 0.3
    kept, unit_of = [0, 1, 2, 6, 7, 8], np.array([1.0, 1.0, 1.0, 1e-6, 1e-6, 1e-6])
    mine = face.P[np.ix_(kept, kept)] / np.outer(unit_of, unit_of)
    ratio = np.linalg.eigvals(np.linalg.solve(P, mine)).real
    assert 0.7 < ratio.min() <= ratio.max() < 1.4


# ------------------------------------------------------------------------------------------------------------------------- the faces


@pytest.mark.parametrize("gap", [False, True], ids=["lost start", "gap"])
@pytest.mark.parametrize("at", [(7,), (20, 21), range(1, 150)], ids=len)
def test_in_parts_a_gate_goes_on_as_in_one(at, gap):
    """Cut before, within and after the time that a candidate runs: its state, all counts and the prior of states that change go on."""
    trial = simulated("hard iron", 3, duration=3.0)
    options = {"gate": Gate(recovery=5), "full_covariance": True}
    start = lost(trial.initial, 3)
    if gap:
        trial, start = without_gyro(simulated("hard iron", 3, duration=4.0), 1.5, 2.5), trial.initial
    whole, end = estimation.run_part(trial.record, NOISE, start, (WALKING, HELD), **options)
    (recovered,) = recoveries(whole)
    state, attitudes, events = start, [], []
    for first, last in itertools.pairwise((0, *at, len(trial.record.increments))):
        part = records.cut(trial.record, first, last)
        estimate, state = estimation.run_part(part, NOISE, state, (WALKING, HELD), **options)
        attitudes.append(estimate.attitude[0 if first == 0 else 1 :])
        events += recoveries(estimate)
    assert events == [recovered]
    assert np.array_equal(np.concatenate(attitudes), whole.attitude)
    assert np.array_equal(state.covariance, end.covariance)
    assert np.array_equal(state.values, end.values)


WALKING = error_states.VectorBias(sensor="mag", bias_sigma=1e-6, rate_random_walk=1e-8, unit="T")


HELD = error_states.BoundedVelocity(
    sensor="acc", velocity_time=2.0, velocity_sigma=0.1, acceleration_time=1.0 / 18.0, strength=1.0
)
FACES = {**CASES, "hard iron that walks": (("mag", "acc"), (WALKING,)), "chains": (("mag", "acc"), (WALKING, HELD))}


@pytest.mark.parametrize("case", quick_or_slow(FACES))
def test_both_faces_recover_alike(case):
    trial = simulated(case if case in CASES else "hard iron", 3, duration=1.6)
    assert_recover_alike(trial.record, lost(trial.initial, 3), FACES[case][1], Robust())


def test_both_faces_recover_alike_from_what_the_prior_says_by_then():
    """The gyro fails for a second: restart candidates start two seconds after the prior, which has grown meanwhile."""
    trial = without_gyro(simulated("hard iron", 3, duration=4.0), 1.5, 2.5)
    quick = dataclasses.replace(WALKING, rate_random_walk=1e-6)
    assert_recover_alike(trial.record, trial.initial, (quick, HELD), None)


def assert_recover_alike(record, start, blocks, robust):
    options = {"gate": Gate(recovery=5), "robust": robust}
    whole = estimation.run(record, NOISE, start, blocks, full_covariance=True, **options)
    step = in_steps.run(record, NOISE, start, blocks, **options)
    assert recoveries(whole)
    in_steps.assert_alike(whole, step, 1e-9)


@pytest.mark.parametrize("case", ["hard iron", "chains"])
def test_both_faces_widen_a_candidate_alike(case):
    """The bias is off by thirty times what the gate allows it to have changed."""
    trial = simulated("hard iron", 3, duration=2.0)
    start = dataclasses.replace(lost(trial.initial, 3), bias=trial.initial.bias + np.array([0.3, -0.2, 0.25]))
    gate, blocks = Gate(recovery=5, restart_bias_sigma=1e-2), FACES[case][1]
    whole, end = estimation.run_part(trial.record, NOISE, start, blocks, gate=gate, full_covariance=True)
    step = in_steps.run(trial.record, NOISE, start, blocks, gate=gate)
    assert end.gate.counts[gate_rules.LEVEL] > 1.0
    assert recoveries(whole)
    in_steps.assert_alike(whole, step, 1e-8)


# ------------------------------------------------------------------------------------------------------------------------- setups


def test_a_campaign_of_lost_starts_with_states_ends_consistent():
    """A Monte Carlo gives the gate of a setup with states its records; starts a radian off on each axis with a σ of 2° all recover."""
    scenario = Scenario(
        motion=HAND,
        gyro=GyroSpec(angle_random_walk=1e-3, rate_random_walk=1e-5),
        sensors=(
            Magnetometer(name="mag", field_f=FIELD, sigma=3e-7, rate=10.0, kind="vector"),
            Accelerometer(name="acc", sigma=0.05, rate=10.0, kind="vector"),
        ),
        rate=50.0,
        duration=6.0,
    )
    states = States(sensors={"mag": SensorStates(bias_sigma=1e-7)})
    filter_setup = FilterSetup(
        process_noise=NOISE, attitude_sigma=0.03, bias_sigma=1e-4, states=states, gate=Gate(restart_bias_sigma=1e-5)
    )
    far = montecarlo.Dispersions(attitude_sigma=1.0)
    gated, blind = montecarlo.run(
        scenario,
        (filter_setup, dataclasses.replace(filter_setup, gate=Gate(recovery=None))),
        runs=12,
        seed=3,
        epochs=10,
        dispersions=far,
        threads=1,
    )
    assert np.max(gated.finite) == 12
    assert_inside(gated.anees[-1, 1], 3, 12, 0.9999)
    assert blind.anees[-1, 1] > 100.0


@pytest.mark.slow
def test_a_lever_arm_recovers():
    trial = simulated("hard iron", 5, duration=6.0)
    states = States(sensors={"mag": SensorStates(bias_sigma=1e-6), "acc": SensorStates(lever_arm_sigma=0.05)})
    filter_setup = FilterSetup(process_noise=NOISE, bias_sigma=BIAS_SIGMA, states=states, gate=Gate())
    estimate = setup.run(trial.record, filter_setup, lost(trial.initial, 5), full_covariance=True)
    assert len(recoveries(estimate)) == 1
    assert np.all(np.abs(errors(estimate, trial.record.truth)[-1]) < 4.5 * estimate.sigma[-1])
    arm = estimate.error_states["acc lever arm"]
    assert np.all(np.abs(arm.values[-1]) < 4.5 * arm.sigma[-1])
