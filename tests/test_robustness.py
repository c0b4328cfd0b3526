"""Gate, recovery, robust updates: false alarms, lock-in, contaminated noise, each with its two sides."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from measured import assert_inside, drawn_start, errors, recoveries, turn_to
from scipy.stats import binom, chi2, kstest

from strapdown import consistency, estimation, motion, quaternion, records
from strapdown.estimation import forward, gating
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import GateMemory, ProcessNoise, initial_state, restart_bias_variance
from strapdown.gyro import GyroSpec
from strapdown.kernels import gate_rules, layout, machine, restart_candidate, structure
from strapdown.kernels.iterated_update import ACCEPTED, PASSED_OVER, REFUSED
from strapdown.randomness import generator
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import AttitudeSensor, Faults, VectorMeasurements, VectorSensor

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
STARS = (np.array([1.0, 0.2, 0.0]), np.array([0.0, 1.0, 1.0]))


def scenario(faults=None, duration=8.0, rate=10.0, kind="direction", sensors=None):
    return Scenario(
        motion=motion.Coning(angle=0.3, frequency=0.3),
        gyro=GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias=np.array([1e-3, -2e-3, 5e-4])),
        sensors=sensors
        or tuple(
            VectorSensor(name=name, reference_f=r, sigma=1e-3, rate=rate, kind=kind, faults=faults or Faults())
            for name, r in zip("ab", STARS, strict=True)
        ),
        rate=50.0,
        duration=duration,
    )


def started(record, run, attitude_sigma=1e-2, bias_sigma=1e-3):
    """The initial state, off by errors drawn from its own covariance."""
    return drawn_start(record.truth, generator(77, run, "initial error").standard_normal(6), attitude_sigma, bias_sigma)


def lost_start(record, run, bias_sigma=1e-3):
    """Anywhere at all, with an initial σ of half a degree."""
    anywhere = quaternion.normalize(generator(3, run, "lost").standard_normal(4))
    start = started(record, run, bias_sigma=bias_sigma)
    return replace(start, attitude=quaternion.multiply(record.truth.attitude[0], anywhere))


def turned(start, rotation_vector=(0.0, 1.57, 0.0)):
    return replace(start, attitude=quaternion.multiply(start.attitude, quaternion.exp(rotation_vector)))


def anees(estimates, records_, rows, every):
    """NEES per state averaged over runs at the given rows, of the attitude and of all states (rows, 2)."""
    nees = []
    for estimate, record in zip(estimates, records_, strict=True):
        e, P = errors(estimate, record.truth, every)[rows], estimate.covariance[rows]
        nees.append([consistency.nees(e[:, :3], P[:, :3, :3]) / 3.0, consistency.nees(e, P) / 6.0])
    return np.mean(nees, axis=0).T


# ------------------------------------------------------------------------------------------------------------------------- the gate


def test_constants_are_the_quantiles_of_chi_squared():
    assert pytest.approx(np.pi / np.sqrt(3.0)) == gating.UNIFORM_SIGMA  # of an angle uniform over a full rotation
    assert np.allclose(Gate(probability=0.99).thresholds, chi2.ppf(0.99, [1, 2, 3]), rtol=1e-12)
    assert Robust(kind="huber").parameters[0, 0] == pytest.approx(1.345**2, rel=0.01)
    assert np.array_equal(Robust(kind="student", degrees_of_freedom=5.0).parameters[:, 1], [6.0, 7.0, 8.0])


@pytest.mark.parametrize("degrees", [1, 2, 3])
@pytest.mark.parametrize("probability", [0.9, 0.999])
def test_accepted_innovations_without_their_gate_are_standard_normal(degrees, probability):
    white = np.random.default_rng(degrees).standard_normal((20_000, degrees))
    white = white[np.sum(white**2, axis=1) <= chi2.ppf(probability, degrees)]
    white[0] = 0.0
    ungated = Gate(probability=probability).ungated(white)
    assert kstest(ungated.ravel(), "norm").pvalue > 0.01
    assert kstest(np.sum(ungated**2, axis=1), chi2(degrees).cdf).pvalue > 0.01
    if degrees == 2:  # χ² of two degrees of freedom is exponential
        nis = np.sum(white**2, axis=1)
        expected = -2.0 * np.log1p(np.expm1(-0.5 * nis) / probability)
        np.testing.assert_allclose(np.sum(ungated**2, axis=1), expected, rtol=1e-6)
    assert np.isfinite(Gate().ungated(np.full((1, degrees), 1e3))).all()


@pytest.mark.parametrize("kind", ["direction", "heading", "attitude"])
def test_false_alarms_are_as_often_as_asked_for(kind):
    probability = 0.98
    sensors = {
        "direction": scenario(rate=25.0).sensors,
        "heading": (
            VectorSensor(name="a", reference_f=np.array([0.0, 1.0, 1.0]), sigma=1e-3, rate=25.0, kind="heading"),
            VectorSensor(name="b", reference_f=np.array([0.3, 0.1, 1.0]), sigma=1e-3, rate=25.0),
        ),
        "attitude": (AttitudeSensor(name="a", sigma_across=1e-3, sigma_about=5e-3, rate=25.0),),
    }[kind]
    record = simulate(scenario(duration=160.0, sensors=sensors), 2)
    estimate = estimation.run(record, NOISE, started(record, 0), gate=Gate(probability=probability))
    used = estimate.innovations["a"].used
    low, high = binom.ppf([0.005, 0.995], len(used), 1.0 - probability)
    assert low <= estimate.refused["a"] <= high
    assert estimate.refused["a"] == np.sum(~used)
    assert not estimate.events
    nis = estimate.innovations["a"].nis
    threshold = chi2.ppf(probability, estimate.innovations["a"].innovation.shape[1])
    assert np.array_equal(nis <= threshold, used)  # the right number of degrees of freedom


def test_isolated_outliers_are_refused_and_start_no_recovery():
    faults = Faults(outlier_probability=0.2, outlier_scale=30.0)
    record = simulate(scenario(faults, duration=60.0), 2)
    gated = estimation.run(record, NOISE, started(record, 0), gate=Gate(), full_covariance=True)
    plain = estimation.run(record, NOISE, started(record, 0))
    assert not gated.events
    share = sum(gated.refused.values()) / sum(len(i.time) for i in gated.innovations.values())
    assert 0.15 < share < 0.25
    rms = [np.sqrt(np.mean(errors(e, record.truth)[500:, :3] ** 2)) for e in (gated, plain)]
    assert rms[0] < 0.2 * rms[1]


# ------------------------------------------------------------------------------------------------------------------------- recovery


def lost_runs(runs, recovery=10, every=50):
    """Runs that start anywhere at all, with an initial σ of half a degree."""
    estimates, records_ = [], []
    for run in range(runs):
        record = simulate(scenario(), 3, run)
        lost, gate = lost_start(record, run), Gate(recovery=recovery)
        records_.append(record)
        estimates.append(estimation.run(record, NOISE, lost, gate=gate, every=every, full_covariance=True))
    return estimates, records_


@pytest.mark.parametrize("runs", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_filter_that_is_lost_recovers_within_its_number_and_is_consistent_afterwards(runs):
    recovery = 10
    estimates, records_ = lost_runs(runs, recovery)
    for estimate in estimates:
        (event,) = recoveries(estimate)
        assert event.start <= 0.1 + 1e-9
        # Of two sensors at one time either may come to the number first; a chance agreement costs one measurement more.
        assert event.end <= 0.1 * (recovery + 2) + 1e-9
        assert event.value >= recovery
    assert_inside(anees(estimates, records_, [2, 4, 8], 50)[:, 0], 3, runs, 0.99)


def stepped_bias(record, step, at):
    """The record whose gyro bias jumps by ``step`` rad/s at edge ``at``."""
    dt = np.diff(record.time)[:, None]
    later = (np.arange(len(dt)) >= at)[:, None]
    bias = record.truth.bias + (np.arange(len(record.time)) > at)[:, None] * step
    return replace(record, increments=record.increments + later * dt * step, truth=replace(record.truth, bias=bias))


def stepped_runs(runs, step, bias_sigma, duration=24.0, at=300, fixed=None):
    """Runs whose gyro bias jumps by ``step`` rad/s in any direction at edge ``at``, under the default gate."""
    estimates, records_ = [], []
    for run in range(runs):
        draw = generator(5, run, "step").standard_normal(3)
        jump = step * draw / np.linalg.norm(draw) if fixed is None else fixed
        record = stepped_bias(simulate(scenario(duration=duration), 4, run), jump, at)
        start = started(record, run, attitude_sigma=2e-3, bias_sigma=bias_sigma)
        records_.append(record)
        estimates.append(estimation.run(record, NOISE, start, gate=Gate(), every=5, full_covariance=True))
    return estimates, records_


def whole_nees(estimates, records_, after, every=5):
    """NEES per state, averaged over runs, so many seconds after the last recovery (len(after),)."""
    nees = []
    for estimate, record in zip(estimates, records_, strict=True):
        rows = np.searchsorted(estimate.time, recoveries(estimate)[-1].end + np.array(after))
        nees.append(consistency.nees(errors(estimate, record.truth, every)[rows], estimate.covariance[rows]) / 6.0)
    return np.mean(nees, axis=0)


@pytest.mark.parametrize(
    ("step", "bias_sigma", "most"), [(3e-3, 1e-3, 1), (2e-2, 1e-3, 1), (0.1, 1e-3, 1), (1.0, 1e-3, 1), (1e-2, 1e-4, 3)]
)
@pytest.mark.parametrize("runs", [16, pytest.param(200, marks=pytest.mark.slow)])
def test_a_default_gate_follows_bias_steps_of_any_size(runs, step, bias_sigma, most):
    """3 to 1000 times the initial σ: a candidate that cannot follow is not started as narrow again and again.

    It takes over because its innovations agree, which favours the lucky: over 200 runs NEES per state is up to 1.2 after 2 s, and inside
    its bounds after 5 s. A step of 3σ may be followed without a recovery, once in 200 runs.
    """
    estimates, records_ = stepped_runs(runs, step, bias_sigma)
    pairs = [(estimate, record) for estimate, record in zip(estimates, records_, strict=True) if recoveries(estimate)]
    assert len(pairs) >= (runs if step / bias_sigma >= 20.0 else 0.98 * runs)
    for estimate, _ in pairs:
        assert len(recoveries(estimate)) <= most
        assert recoveries(estimate)[0].start >= 6.0
    if step / bias_sigma >= 20.0:  # a small one does not show at once
        assert max(recoveries(estimate)[-1].end for estimate in estimates) < (8.5 if most == 1 else 11.0)
    nees = whole_nees(*zip(*pairs, strict=True), [2.0, 5.0])
    low, high = consistency.mean_bounds(6, len(pairs), 0.999)
    assert low < nees[0] < max(high, 1.25)
    assert low < nees[1] < high


def test_the_restart_is_as_wide_as_the_start_by_default():
    first = estimation.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=1.0, bias_sigma=[2.0, 3.0, 4.0])
    assert np.array_equal(restart_bias_variance(Gate(), first), [4.0, 9.0, 16.0])
    assert np.array_equal(restart_bias_variance(Gate(restart_bias_sigma=3.0), first), [9.0, 9.0, 9.0])
    record = simulate(scenario(duration=1.0), 3)
    start = started(record, 0, bias_sigma=0.02)
    _, end = estimation.run_part(records.cut(record, 0, 20), NOISE, turned(start), gate=Gate())
    assert end.gate.counts[gate_rules.CANDIDATE] == 1.0
    first = end.gate.counts[gate_rules.FIRST_BIAS + 3 : gate_rules.FIRST_BIAS + 6]
    assert np.all(first > 1.9 * 0.02**2)  # what the filter had left, and the restart's


@pytest.mark.parametrize("factor", [5.0, 30.0])
def test_a_filter_that_models_far_too_little_noise_says_that_it_is_locked_out(factor):
    record = simulate(scenario(duration=60.0), 5)
    modelled = replace(record, vectors=tuple(s.noise_scaled(1.0 / factor) for s in record.vectors))
    estimate = estimation.run(modelled, NOISE, started(record, 0), gate=Gate())
    lock_outs = [event for event in estimate.events if event.kind == "lock-out"]
    assert {event.sensor for event in lock_outs} == {"a", "b"}
    assert sum(estimate.refused.values()) > 1000
    assert sum(event.value for event in lock_outs) > 0.9 * sum(estimate.refused.values())
    assert f"measurements of {lock_outs[0].sensor} were rejected" in str(lock_outs[0])
    if not recoveries(estimate):
        assert estimation.smooth(modelled, NOISE, started(record, 0), gate=Gate()).events == estimate.events


def judged(outcomes, recovery=3, limit=4):
    """Rows of a gate with two sensors after outcomes (sensor, filter's, candidate's or None); verdicts and events."""
    memory, counters = np.zeros(gate_rules.MEMORY), np.zeros((2, gate_rules.COUNTERS))
    events, count, verdicts = np.zeros((9, 5)), 0, []
    for k, (sensor, mine, other) in enumerate(outcomes):
        count, begins = gate_rules.judge_filter(
            mine, float(k), sensor, recovery, limit, counters, memory, events, count
        )
        if begins:
            gate_rules.reset_candidate(memory, float(k), np.zeros(3), np.ones(3))
        if memory[gate_rules.CANDIDATE]:
            verdicts.append(gate_rules.judge_candidate(other, 2.0, 2, sensor, counters, memory, np.zeros(3)))
    return memory, counters, [list(row) for row in events[:count]], verdicts


def test_the_rules_of_a_gate():
    """Plain numbers: when a candidate is dropped, accepted, wider; what is reported; what a widening resets."""
    dropped, followed, narrow = gate_rules.DROPPED, gate_rules.FOLLOWED, gate_rules.TOO_NARROW
    refused, both = (0, REFUSED, ACCEPTED), (0, REFUSED, REFUSED)
    assert judged([refused, refused, (0, ACCEPTED, ACCEPTED)])[3] == [followed, followed, dropped]
    assert judged([refused, (1, ACCEPTED, ACCEPTED)])[3] == [
        followed,
        followed,
    ]  # of which the other sensor is none refused
    assert judged([refused, (1, ACCEPTED, ACCEPTED)])[0][gate_rules.HITS] == 1.0  # what the filter accepts too is none
    memory, counters, _, verdicts = judged([refused, both, both])
    assert verdicts == [followed, followed, dropped]  # two misses are more than 1 + half of one hit
    assert (memory[gate_rules.LEVEL], memory[gate_rules.CANDIDATE]) == (1.0, 0.0)
    assert judged([refused] * 6 + [both] * 3)[3][-2:] == [followed, dropped]  # three in a row
    assert judged([refused] * 6 + [both] * 2 + [refused, both])[3][-1] == followed
    assert judged([refused] * 3 + [(0, ACCEPTED, ACCEPTED)] * 2)[1][0, gate_rules.EXCESS] == 1.0
    memory, counters, _, _ = judged([(0, REFUSED, PASSED_OVER)] * 4)
    assert not gate_rules.takes_over(0, 3, counters, memory)
    memory, counters, _, verdicts = judged([(1, ACCEPTED, None)] * 15 + [refused, both, both, refused])
    assert memory[gate_rules.LEVEL] == 1.0
    for accepted, level in ((14, 1.0), (15, 0.0)):  # 5 × 3 accepted since
        memory, _, _, _ = judged([refused, both, both] + [(1, ACCEPTED, ACCEPTED)] * accepted + [refused])
        assert memory[gate_rules.LEVEL] == level
    memory, counters, events, verdicts = judged([refused] * 6)
    (event,) = forward.last_lock_outs(counters, ("a", "b"))
    assert (event.kind, event.start, event.end, event.sensor, event.value) == ("lock-out", 0.0, 5.0, "a", 6.0)
    assert not events
    assert gate_rules.takes_over(0, 3, counters, memory)
    assert not gate_rules.takes_over(1, 3, counters, memory)
    assert not gate_rules.takes_over(0, 7, counters, memory)
    rows = np.zeros((3, 5))
    memory[gate_rules.SINCE] = 2.0
    assert gate_rules.recover(5.0, 0, 4, counters, memory, rows, 1) == 2  # the lock-out is part of it
    assert list(rows[1]) == [gate_rules.RECOVERY, 0.0, 0.0, 5.0, 6.0]
    assert not counters.any()
    assert memory[gate_rules.PASSES] == gate_rules.WIDE_PASSES
    memory, counters, _, _ = judged([(1, REFUSED, ACCEPTED)] + [refused] * 9)
    assert counters[0, gate_rules.EXCESS] == 8.0  # twice the limit, and no more
    assert gate_rules.recover(9.0, 0, 4, counters, memory, rows, 0) == 2
    # From the first refusal of the other sensor, which started the candidate; and a lock-out longer than a recovery stands for.
    assert rows[:2].tolist() == [[gate_rules.RECOVERY, 0.0, 0.0, 9.0, 9.0], [gate_rules.LOCK_OUT, 0.0, 1.0, 9.0, 9.0]]
    memory, counters, events, _ = judged([refused] * 5 + [(0, ACCEPTED, REFUSED)] * 5 + [refused])
    assert events == [[gate_rules.LOCK_OUT, 0.0, 0.0, 4.0, 5.0]]
    assert not forward.last_lock_outs(counters, ("a", "b"))
    memory, counters, events, _ = judged([refused] * 5 + [(0, ACCEPTED, REFUSED)] * 5)
    assert not events
    assert gate_rules.recover(9.0, 0, 4, counters, memory, rows, 0) == 2  # it had ended before
    memory[gate_rules.LEVEL] = gate_rules.WIDEST
    gate_rules.step_aside(memory)
    assert memory[gate_rules.LEVEL] == 0.0
    memory, counters, _, _ = judged([refused])
    for nis, expected in ((2.0, followed), (40.0, narrow)):
        assert gate_rules.judge_candidate(ACCEPTED, nis, 2, 0, counters, memory, np.zeros(3)) == expected
    assert gate_rules.judge_candidate(ACCEPTED, 0.0, 99, 0, counters, memory, np.array([1.6, 0.0, 0.0])) == narrow
    assert gate_rules.may_widen(np.full(3, 1.04), memory)
    assert not gate_rules.may_widen([1.0, 1.06, 1.0], memory)
    assert gate_rules.start_undone(0, 1.0, memory) == pytest.approx(-8.0)
    assert gate_rules.start_undone(0, 1.2, memory) == 0.0
    gate_rules.count_widening(memory)
    assert np.array_equal(memory[gate_rules.FIRST_VARIANCE :], [9.0, 9.0, 9.0])
    assert (memory[gate_rules.LEVEL], memory[gate_rules.NIS], memory[gate_rules.DEGREES]) == (1.0, 0.0, 0.0)
    assert gate_rules.restart_attitude(0.1, memory) == pytest.approx(0.3)
    assert gate_rules.restart_attitude(1.0, memory) == gating.UNIFORM_SIGMA


@pytest.mark.parametrize(("kind", "attitude_sigma"), [("heading", 0.3), ("vector", 1.0)])
def test_a_refused_update_that_does_not_converge_is_reported_at_the_prior(kind, attitude_sigma):
    """Innovation and variance of each row in closed form, after a recovery; from one start and, where little is known, from three."""
    counts = np.zeros(gate_rules.MEMORY)
    counts[gate_rules.PASSES] = gate_rules.WIDE_PASSES
    memory = GateMemory(restart_bias_variance=np.full(3, 1e-6), counts=counts, counters={})
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=attitude_sigma, bias_sigma=1e-3)
    turn, wide = np.deg2rad(150.0), attitude_sigma**2
    if kind == "heading":  # of a vector at 45°: a rotation about either horizontal axis changes it
        r, z = [1.0, 0.0, 0.0], np.sqrt(0.5) * np.array([np.cos(turn), np.sin(turn), 1.0])
        expected, variance = [turn**2 / (2.0 * wide + 0.01)], [2.0 * wide + 0.01]
    else:  # half its length
        r, z = [0.0, 0.0, 1.0], [0.5 * np.sin(turn), 0.0, 0.5 * np.cos(turn)]
        expected, variance = [z[0] ** 2 / (wide + 0.01), (z[2] - 1.0) ** 2 / 0.01], [0.01, wide + 0.01, wide + 0.01]
    series = VectorMeasurements(sensor="s", kind=kind, time=[0.0], vector_b=[z], reference_f=r, sigma=0.1)
    record = records.ImuRecord(time=np.array([0.0, 1.0]), increments=np.zeros((1, 3)), vectors=(series,))
    innovation = estimation.run(record, NOISE, replace(start, gate=memory), gate=Gate()).innovations["s"]
    assert innovation.weight[0] == 0.0
    np.testing.assert_allclose(np.sort(innovation.variance[0]), variance, rtol=1e-12)
    np.testing.assert_allclose(innovation.nis[0], sum(expected), rtol=1e-12)


def test_a_widened_candidate_is_one_that_started_wider():
    """Of the information of all its measurements, P⁻¹, that of its start counts a ninth: in matrices, without a gain."""
    kernels, sizes = (
        machine.instance(module, STRUCTURE=structure.SIX_STATES) for module in (restart_candidate, layout)
    )
    rng = np.random.default_rng(3)
    for _ in range(20):
        variance = rng.uniform(0.5, 2.0, 3)
        root = rng.standard_normal((6, 6))
        information = root @ root.T
        P = np.linalg.inv(information + np.diag([0.0, 0.0, 0.0, *(1.0 / variance)]))
        bias, first = rng.standard_normal(3), 1e-7 * rng.standard_normal(3)
        x, matrices = np.zeros((2, 7)), np.zeros((2, 6, sizes.W))
        x[1], matrices[1, :, :6] = [1.0, 0.0, 0.0, 0.0, *bias], P
        form = SimpleNamespace(x=x, P=matrices.reshape(2, -1), work=np.zeros(sizes.LINES * sizes.LINE))
        memory = np.zeros(gate_rules.MEMORY)
        memory[gate_rules.FIRST_BIAS :] = [*(bias + first), *variance]
        kernels.widen(form, memory)
        expected = np.linalg.inv(information + np.diag([0.0, 0.0, 0.0, *(1.0 / (9.0 * variance))]))
        # The mean solves P⁻¹ x = information x̂ + start, of which the start's part shrinks too.
        mean = -expected[:, 3:] @ (8.0 / 9.0 / variance * first)
        assert np.allclose(matrices[1, :, :6], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
        assert np.allclose(x[1, 4:7] - bias, mean[3:], rtol=1e-6, atol=1e-14)
        assert np.allclose(quaternion.log(x[1, :4]), mean[:3], rtol=1e-6, atol=1e-14)
        assert np.allclose(memory[gate_rules.FIRST_BIAS + 3 :], 9.0 * variance)


def test_a_prior_is_seen_from_elsewhere_as_its_turn_and_tilt_say():
    """``exp(α n) ⊗ exp(ε)`` differentiated about (α₀, ε₀) by differences, of a variance with one axis hardly known."""
    from strapdown.kernels.iterated_update import tangent_at

    rng = np.random.default_rng(4)
    for _ in range(20):
        n = rng.standard_normal(3)
        n /= np.linalg.norm(n)
        across = np.eye(3) - np.outer(n, n)
        root = across @ rng.standard_normal((3, 3))
        A = 3.0 * np.outer(n, n) + 0.01 * root @ root.T + 1e-6 * np.eye(3)
        B = rng.standard_normal((3, 3))
        turn, tilt = rng.uniform(-3.0, 3.0), 0.02 * across @ rng.standard_normal(3)

        def at(turn, tilt, n=n):
            return quaternion.multiply(quaternion.exp(turn * n), quaternion.exp(tilt))

        now = at(turn, tilt)

        def error(d, n=n, across=across, turn=turn, tilt=tilt, now=now):
            moved = at(turn + n @ d, tilt + across @ d)
            return turn_to(now, moved)

        h = 1e-5
        G = np.stack([(error(h * e) - error(-h * e)) / (2.0 * h) for e in np.eye(3)], axis=1)
        for same in (now, -now):
            M, back = tangent_at(tuple(same), tuple(A[np.triu_indices(3)]))
            M = np.reshape(M, (3, 3))
            assert np.allclose(M @ B, G @ B, atol=1e-3)
            assert np.allclose(M @ A @ M.T, G @ A @ G.T, atol=1e-3)
            assert np.allclose(back, G @ (-turn * n - tilt), atol=1e-3)
        # To the first order in the tilt nothing is left out: the unknown axis is where no row of a direction sees it.
        assert np.allclose(G @ n, quaternion.rotate(quaternion.exp(-tilt), n), atol=1e-9)
        known = 3.0 * np.outer(n, n) + 1e-9 * np.eye(3)
        M = np.reshape(tangent_at(tuple(now), tuple(known[np.triu_indices(3)]))[0], (3, 3))
        assert np.allclose(M @ known @ M.T, 3.0 * np.outer(G @ n, G @ n), atol=1e-8)


def turn_and_tilt(estimate, record, reference, every):
    """Errors (m, 6) with the attitude's as turn about the reference and tilt across it, body axes, and the axis (m, 3).

    Where the turn is not known these are what the covariance is of; a rotation vector bends the tilt's part by up to π/2.
    """
    q, true = estimate.attitude, record.truth.attitude[::every]
    n = quaternion.rotate(quaternion.conjugate(q), np.broadcast_to(reference / np.linalg.norm(reference), (len(q), 3)))
    d = quaternion.multiply(quaternion.conjugate(q), true)
    turn = 2.0 * np.arctan2(np.sum(n * d[:, 1:], axis=1), d[:, 0])[:, None]
    tilt = quaternion.log(quaternion.multiply(quaternion.exp(-turn * n), d))
    turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
    return np.concatenate([turn * n + tilt, record.truth.bias[::every] - estimate.bias], axis=1), n


@pytest.mark.parametrize("runs", [60, pytest.param(400, marks=pytest.mark.slow)])
def test_a_recovery_on_one_direction_knows_what_it_does_not_know(runs):
    """The turn about it stays uniform, whatever comes; NEES per state used to be 4.1 on the mean and its σ to fall to 25°."""
    nees, turns = [], []
    for run in range(runs):
        one_star = replace(scenario(duration=16.0), sensors=scenario().sensors[:1])
        record = simulate(one_star, 31, run)
        estimate = estimation.run(record, NOISE, lost_start(record, run), gate=Gate(), every=50, full_covariance=True)
        assert len(recoveries(estimate)) == 1
        error, n = turn_and_tilt(estimate, record, STARS[0], 50)
        nees.append(consistency.nees(error, estimate.covariance)[[2, 4, 8, 16]] / 6.0)
        turns.append(np.sqrt(np.einsum("ki,kij,kj->k", n, estimate.covariance[:, :3, :3], n))[2:])
    assert_inside(np.mean(nees, axis=0), 6, runs, 0.999)
    assert np.allclose(turns, gating.UNIFORM_SIGMA, rtol=0.02)


@pytest.mark.parametrize("bias_sigma", [1e-3, 2e-2])
@pytest.mark.parametrize("runs", [40, pytest.param(400, marks=pytest.mark.slow)])
def test_after_a_recovery_on_one_direction_a_second_one_measures_the_turn(runs, bias_sigma):
    """NEES per state used to be 4 and 18 after it: what ties tilt and bias together does not turn about the first direction."""
    estimates, records_ = [], []
    for run in range(runs):
        a, b = scenario().sensors
        interrupted = replace(
            scenario(duration=10.0),
            motion=motion.Coning(angle=0.3, frequency=0.1),
            sensors=(a, replace(b, faults=Faults(outages=((0.0, 6.0),)))),
        )
        record = simulate(interrupted, 31, run)
        lost = lost_start(record, run, bias_sigma)
        records_.append(record)
        estimates.append(estimation.run(record, NOISE, lost, gate=Gate(), every=25, full_covariance=True))
        assert len(recoveries(estimates[-1])) == 1
    assert_inside(anees(estimates, records_, [13, 14, 20], 25)[:, 1], 6, runs, 0.999)


def contradicted(until):
    """A record of three sensors, one of which is turned by 20° until a time."""
    third = VectorSensor(name="c", reference_f=np.array([0.3, -1.0, 1.0]), sigma=1e-3, rate=10.0)
    record = simulate(replace(scenario(), sensors=(*scenario().sensors, third)), 6)
    a, b, c = record.vectors
    turned = quaternion.rotate(quaternion.exp([0.2, 0.2, -0.2]), c.vector_b)
    c = replace(c, vector_b=np.where(c.time[:, None] <= until, turned, c.vector_b))
    return replace(record, vectors=(a, b, c))


def test_a_lock_out_is_reported_in_the_part_in_which_it_ends():
    record = contradicted(2.0)
    middle = int(np.searchsorted(record.time, 2.0)) + 1
    start, gate = started(record, 0, attitude_sigma=1e-3), Gate()
    first, state = estimation.run_part(records.cut(record, 0, middle), NOISE, start, gate=gate)
    second, _ = estimation.run_part(records.cut(record, middle, len(record.time) - 1), NOISE, state, gate=gate)
    assert [(event.kind, event.end) for event in first.events] == [("lock-out", pytest.approx(2.0))]
    assert second.events == ()


def test_a_sensor_that_contradicts_two_others_is_refused_and_not_followed():
    """The two that agree are used."""
    record = contradicted(np.inf)
    c = record.vectors[2]
    estimate = estimation.run(record, NOISE, started(record, 0, attitude_sigma=1e-3), gate=Gate())
    (event,) = estimate.events
    assert (event.kind, event.sensor, event.value) == ("lock-out", "c", len(c.time))
    assert (event.start, event.end) == (c.time[0], c.time[-1])
    assert estimate.refused["c"] == len(c.time)
    assert estimate.refused["a"] + estimate.refused["b"] <= 2
    assert quaternion.angle_between(estimate.attitude[-1], record.truth.attitude[-1]) < 5e-3


# ------------------------------------------------------------------------------------------------------------------- robust updates

TREATMENTS = {
    "plain": {},
    "gate": {"gate": Gate(probability=0.999)},
    "huber": {"robust": Robust(kind="huber")},
    "student": {"robust": Robust(kind="student")},
}


def contaminated(runs, faults, duration=16.0):
    """RMS attitude error over the second half of each treatment, over the runs, and ANEES of the attitude at its end."""
    squares, consistent = dict.fromkeys(TREATMENTS, 0.0), dict.fromkeys(TREATMENTS, 0.0)
    for run in range(runs):
        record = simulate(scenario(faults, duration=duration), 9, run)
        start = started(record, run)
        for name, treatment in TREATMENTS.items():
            estimate = estimation.run(record, NOISE, start, every=50, full_covariance=True, **treatment)
            e = errors(estimate, record.truth, 50)[8:, :3]
            squares[name] += np.mean(e**2) / runs
            consistent[name] += np.mean(consistency.nees(e, estimate.covariance[8:, :3, :3])) / 3.0 / runs
    return {name: np.sqrt(value) for name, value in squares.items()}, consistent


def test_robust_updates_in_contaminated_noise():
    """A tenth of the measurements ten times as noisy, 40 runs: RMS error 0.37 (gate), 0.40 (Huber), 0.41 (Student) of the plain filter's.

    Mean NEES per state 8.3 (plain), 1.1, 1.26, 1.2: the weighing ones are overconfident by a tenth in σ, the plain one threefold.
    """
    rms, anees_ = contaminated(40, Faults(outlier_probability=0.1, outlier_scale=10.0))
    for name in ("gate", "huber", "student"):
        assert 0.3 < rms[name] / rms["plain"] < 0.45
    assert rms["gate"] < rms["huber"]
    assert anees_["plain"] > 6.0
    assert 0.9 < anees_["gate"] < 1.25
    assert 1.0 < anees_["student"] < 1.4
    assert 1.05 < anees_["huber"] < 1.45


def test_what_robustness_costs_where_the_noise_is_normal():
    """RMS error 1.01 (gate), 1.02 (Huber), 1.06 (Student) of the plain filter's; its consistency stays within a few hundredths."""
    rms, anees_ = contaminated(40, Faults())
    for name, most in (("gate", 1.03), ("huber", 1.04), ("student", 1.09)):
        assert 1.0 <= rms[name] / rms["plain"] < most
        assert 0.97 < anees_[name] / anees_["plain"] < 1.08


def test_a_weight_is_the_fixed_point_of_its_equation():
    """Student's t: w = (ν + d)/(ν + E|r|²/σ²) under the posterior that w itself leads to, by a plain iteration in matrices."""
    from strapdown.kernels.iterated_update import STUDENT, robust_weight

    rng = np.random.default_rng(1)
    for _ in range(20):
        root = rng.standard_normal((3, 3))
        A = root @ root.T
        H = rng.standard_normal((3, 3))
        variance = rng.uniform(0.1, 2.0, 3)
        y = 3.0 * rng.standard_normal(3)
        S = tuple((H @ A @ H.T)[np.triu_indices(3)])
        w = robust_weight(STUDENT, 5.0, 7.0, 200, S, tuple(y), tuple(variance))
        R = np.diag(variance) / w
        gain = A @ H.T @ np.linalg.inv(H @ A @ H.T + R)
        posterior = A - gain @ H @ A
        r = y - H @ gain @ y
        expected = r @ (r / variance) + np.trace(H @ posterior @ H.T / variance[:, None])
        assert w == pytest.approx(7.0 / (5.0 + expected), rel=1e-9)


def test_hubers_update_is_the_minimum_of_hubers_cost():
    """½ xᵀP⁻¹x + ρ(√(rᵀR⁻¹r)), ρ quadratic up to k and linear beyond: by scipy.optimize, without weights."""
    from scipy.optimize import minimize

    from strapdown.kernels.iterated_update import HUBER, robust_weight

    rng = np.random.default_rng(2)
    for _ in range(10):
        A = np.diag(rng.uniform(0.05, 0.5, 3))
        H = rng.standard_normal((3, 3))
        variance = rng.uniform(0.1, 0.5, 3)
        y = 6.0 * rng.standard_normal(3)
        k = 1.5
        S = tuple((H @ A @ H.T)[np.triu_indices(3)])
        w = robust_weight(HUBER, k * k, 0.0, 400, S, tuple(y), tuple(variance))
        R = np.diag(variance) / w
        x = A @ H.T @ np.linalg.solve(H @ A @ H.T + R, y)

        def cost(x, A=A, H=H, y=y, variance=variance, k=k):
            d = np.sqrt(np.sum((y - H @ x) ** 2 / variance))
            return 0.5 * x @ np.linalg.solve(A, x) + (0.5 * d * d if d <= k else k * d - 0.5 * k * k)

        best = minimize(cost, np.zeros(3), method="BFGS", options={"gtol": 1e-9})
        assert np.allclose(x, best.x, atol=1e-5)


# --------------------------------------------------------------------------------------------------------------------- the smoother


def test_the_smoother_leaves_out_what_the_filter_refused():
    record = simulate(scenario(Faults(outlier_probability=0.1, outlier_scale=30.0)), 2)
    start = started(record, 0)
    gated = estimation.run(record, NOISE, start, gate=Gate())
    cleaned = tuple(
        replace(s, vector_b=np.where(gated.innovations[s.sensor].used[:, None], s.vector_b, np.nan))
        for s in record.vectors
    )
    smoothed = estimation.smooth(record, NOISE, start, gate=Gate(), full_covariance=True)
    other = estimation.smooth(replace(record, vectors=cleaned), NOISE, start, full_covariance=True)
    assert gated.refused["a"] > 3
    assert np.allclose(smoothed.attitude, other.attitude, rtol=0.0, atol=1e-12)
    assert np.allclose(smoothed.covariance, other.covariance, rtol=1e-7, atol=1e-16)


def test_robust_smoothing_is_better_and_consistent():
    squares, nees = np.zeros(3), 0.0
    for run in range(20):
        record = simulate(scenario(Faults(outlier_probability=0.1, outlier_scale=10.0)), 9, run)
        start = started(record, run)
        robust = estimation.smooth(record, NOISE, start, robust=Robust(), full_covariance=True)
        filtered = estimation.run(record, NOISE, start, robust=Robust())
        plain = estimation.smooth(record, NOISE, start)
        squares += [np.mean(errors(e, record.truth)[100:300, :3] ** 2) / 20.0 for e in (robust, filtered, plain)]
        e, P = errors(robust, record.truth)[100:300:20, :3], robust.covariance[100:300:20, :3, :3]
        nees += np.mean(consistency.nees(e, P)) / 3.0 / 20.0
    assert squares[0] < 0.7 * squares[1]
    assert squares[0] < 0.4 * squares[2]
    assert 0.7 < nees < 1.7
