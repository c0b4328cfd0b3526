"""A gated filter that is lost on one slowly turning direction hands over to a bank, and takes over from it again."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from strapdown import consistency, estimation, quaternion, records, scenarios
from strapdown.checks import InputError
from strapdown.estimation import multiple_model
from strapdown.estimation.gating import Gate, Monitor, Robust
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.kernels import gate_rules
from strapdown.motion import ConstantRate
from strapdown.randomness import generator
from strapdown.units import DEGREE, DEGREE_PER_HOUR
from strapdown.vectors import VectorMeasurements

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
SIGMA, BIAS_SIGMA, START_SIGMA = 1e-3, 2e-3, 1.0 * DEGREE


def references(time, rate, tilt=0.6):
    """A direction that turns about the fixed z axis, inclined to it."""
    return np.stack(
        [np.cos(rate * time) * np.cos(tilt), np.sin(rate * time) * np.cos(tilt), np.full(len(time), np.sin(tilt))],
        axis=1,
    )


def measured(name, time, attitude, reference, random, outliers=0.0):
    noise = SIGMA * random.standard_normal((len(time), 3))
    noise *= np.where(random.random(len(time)) < outliers, 10.0, 1.0)[:, None]
    vector_b = quaternion.rotate(quaternion.conjugate(attitude), reference) + noise
    vector_b /= np.linalg.norm(vector_b, axis=1, keepdims=True)
    return VectorMeasurements(
        sensor=name, kind="direction", time=time, vector_b=vector_b, reference_f=reference, sigma=SIGMA
    )


def lost_record(
    run, *, duration=45.0, jumps=(), lost=False, rate=0.02, stars=1, outliers=0.0, step=(0.0, 0.0), seed=5, steps=50
):
    """A record in which the body is turned anyhow at each of ``jumps``, unseen by the gyro, and its start, which may be ``lost``.

    Stars are seen ten times a second. The gyro bias jumps by ``step`` rad/s in any direction at the time that comes first.
    """
    scenario = scenarios.Scenario(
        motion=ConstantRate(rate=np.array([0.1, -0.05, 0.2])),
        gyro=GyroSpec(
            angle_random_walk=1e-4,
            rate_random_walk=1e-5,
            turn_on_bias=BIAS_SIGMA * generator(seed, run, "bias").standard_normal(3),
        ),
        sensors=(),
        rate=float(steps),
        duration=duration,
    )
    record = scenarios.simulate(scenario, seed, run)
    random = generator(seed, run, "all else")
    truth, bias = record.truth.attitude, record.truth.bias
    for at in jumps:
        turn = quaternion.normalize(random.standard_normal(4))
        truth = np.where((record.time < at)[:, None], quaternion.multiply(turn, truth), truth)
    at, size = step
    axis = random.standard_normal(3)
    stepped = size * axis / np.linalg.norm(axis)
    increments = record.increments + np.where(record.time[:-1] >= at, np.diff(record.time), 0.0)[:, None] * stepped
    bias = bias + (record.time > at)[:, None] * stepped
    every = steps // 10
    time = record.time[::every]
    seen = tuple(
        measured(f"star {k}", time, truth[::every], references(time, rate, tilt), random, outliers)
        for k, tilt in enumerate((0.6, -0.7)[:stars])
    )
    record = dataclasses.replace(
        record, increments=increments, vectors=seen, truth=records.Truth(attitude=truth, bias=bias)
    )
    error = quaternion.exp(START_SIGMA * random.standard_normal(3))
    anywhere = quaternion.normalize(random.standard_normal(4))
    start = quaternion.multiply(truth[0], anywhere if lost else error)
    return record, estimation.initial_state(start, attitude_sigma=START_SIGMA, bias_sigma=BIAS_SIGMA)


def events(estimate, kind):
    return [event for event in estimate.events if event.kind == kind]


def nees(estimate, record):
    edges = np.searchsorted(record.time, estimate.time)
    e = consistency.errors(estimate.attitude, estimate.bias, record.truth.attitude[edges], record.truth.bias[edges])
    return consistency.nees(e, estimate.covariance) / 6.0


AFTER = np.array([0.0, 2.0, 8.0, 14.0, 24.0])
"""Times after the first recovery, s."""


def study(runs, filtered=multiple_model.run_recovering, gate=None, every=5, **options):
    """NEES per state (runs, times) after the recovery; a start that happens to be right across the first direction needs none."""
    found = []
    for run in range(runs):
        record, start = lost_record(run, **options)
        estimate = filtered(record, NOISE, start, gate=gate or Gate(), every=every, full_covariance=True)
        ends = [event.end for event in events(estimate, "recovery") if event.end > sum(options.get("jumps", ()))]
        if ends:
            rows = np.searchsorted(estimate.time, ends[0] + AFTER)
            found.append(nees(estimate, record)[np.minimum(rows, len(estimate.time) - 1)])
    assert len(found) > 0.95 * runs
    return np.array(found)


CASES = {
    "lost": {"lost": True},
    "turned": {"jumps": (15.0,)},
    "turned, among outliers": {"jumps": (15.0,), "outliers": 0.05},
}


# ------------------------------------------------------------------------------------------------------------------- consistency


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("runs", [40, pytest.param(600, marks=pytest.mark.slow)])
def test_after_a_recovery_on_one_turning_direction_it_is_consistent(case, runs):
    """Mean NEES per state used to be hundreds. At first it is modest by what the gate adds to the variance of a bias that was right."""
    found = study(runs, **CASES[case])
    mean = np.mean(found, axis=0)
    low, high = consistency.mean_bounds(6, len(found), 1.0 - 0.01 / len(AFTER))
    assert np.all(mean < high), (mean, high)
    assert np.all(mean[:2] > 0.5 * low), (mean, low)
    assert np.all(mean[2:] > low), (mean, low)


@pytest.mark.parametrize("runs", [40, pytest.param(600, marks=pytest.mark.slow)])
def test_with_a_bias_prior_that_is_right_it_is_consistent_at_once(runs):
    """But for a tenth, by which the bank doubts its first directions longer than it need."""
    found = study(runs, lost=True, gate=Gate(restart_bias_sigma=1e-5))
    mean = np.mean(found, axis=0)
    low, high = consistency.mean_bounds(6, len(found), 1.0 - 0.01 / len(AFTER))
    assert np.all(mean < high), (mean, high)
    assert np.all(mean[1:] > low), (mean, low)
    assert mean[0] > 0.9 * low


def test_the_gate_alone_comes_out_of_it_too_sure():
    assert np.mean(study(20, estimation.run, lost=True)[:, -1]) > 3.0


@pytest.mark.parametrize("size", [3.0, 10.0, 30.0])
@pytest.mark.parametrize("runs", [6, pytest.param(100, marks=pytest.mark.slow)])
def test_bias_steps_of_any_size_are_followed_on_one_direction(size, runs):
    """A bank that was too narrow for it is lost again, and the next one is three times as wide."""
    last = []
    for run in range(runs):
        record, start = lost_record(run, duration=60.0, step=(15.0, size * BIAS_SIGMA))
        estimate = multiple_model.run_recovering(record, NOISE, start, gate=Gate(), every=5, full_covariance=True)
        last.append(nees(estimate, record)[-1])
    # Of 30 σ one run in a hundred is lost for the third time when the record ends: what the second bank became lasted a while.
    right = np.array(last) < 5.0
    assert np.sum(~right) <= 0.01 * runs
    low, high = consistency.mean_bounds(6, int(np.sum(right)), 0.99)
    assert low < np.mean(np.array(last)[right]) < high


def orbit(run, *, jump, duration, seed=21):
    """The magnetometer alone in a low orbit, turned anyhow at a time."""
    scenario = dataclasses.replace(scenarios.load_scenario("magnetometer-only"), duration=duration)
    random = generator(seed, run, "anywhere")
    q, turn = quaternion.normalize(random.standard_normal((2, 4)))
    scenario = dataclasses.replace(scenario, motion=dataclasses.replace(scenario.motion, initial_attitude=q))
    record = scenarios.simulate(scenario, seed, run)
    one = record.vectors[0]
    truth = np.where(
        (record.time < jump)[:, None], quaternion.multiply(turn, record.truth.attitude), record.truth.attitude
    )
    q, r = truth[np.searchsorted(record.time, one.time)], one.references_f
    seen = quaternion.rotate(quaternion.conjugate(q), r / np.linalg.norm(r, axis=1, keepdims=True))
    seen += one.sigma[:, None] * random.standard_normal(seen.shape)
    one = dataclasses.replace(one, vector_b=seen / np.linalg.norm(seen, axis=1, keepdims=True))
    record = dataclasses.replace(record, vectors=(one,), truth=dataclasses.replace(record.truth, attitude=truth))
    start = quaternion.multiply(truth[0], quaternion.exp(START_SIGMA * random.standard_normal(3)))
    belief = ProcessNoise(
        angle_random_walk=scenario.gyro.angle_random_walk, rate_random_walk=scenario.gyro.rate_random_walk
    )
    return (
        record,
        belief,
        estimation.initial_state(start, attitude_sigma=START_SIGMA, bias_sigma=20.0 * DEGREE_PER_HOUR),
    )


@pytest.mark.parametrize("runs", [40, pytest.param(600, marks=pytest.mark.slow)])
def test_a_magnetometer_in_orbit_is_consistent_after_a_turn_that_nothing_saw(runs):
    """The gate alone: 5 on the mean of 100 runs, 420 in the worst."""
    found = []
    for run in range(runs):
        record, belief, start = orbit(run, jump=1000.0, duration=2500.0)
        estimate = multiple_model.run_recovering(record, belief, start, gate=Gate(), every=10, full_covariance=True)
        assert len(events(estimate, "hypotheses")) == len(events(estimate, "recovery")) == 1
        found.append(nees(estimate, record)[np.searchsorted(estimate.time, [1400.0, 1800.0, 2490.0])])
    low, high = consistency.mean_bounds(6, runs, 1.0 - 0.01 / 3)
    assert np.all((low < np.mean(found, axis=0)) & (np.mean(found, axis=0) < high)), np.mean(found, axis=0)


# ------------------------------------------------------------------------------------------------- where there is nothing to hand over


@pytest.mark.parametrize("robust", [None, Robust()], ids=["", "Student"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"stars": 2, "jumps": (15.0, 25.0), "outliers": 0.05},
        {"stars": 2, "lost": True},
        {"stars": 2, "step": (15.0, 0.06)},
    ],
    ids=["right", "turned twice", "lost", "bias step"],
)
def test_with_nothing_open_it_is_the_gated_filter_to_the_bit(options, robust):
    for run in range(2):
        record, start = lost_record(run, duration=35.0, **options)
        given = {
            "gate": Gate(),
            "every": 7,
            "robust": robust,
            "monitor": Monitor(window=20),
            "full_covariance": run > 0,
        }
        plain = estimation.run(record, NOISE, start, **given)
        mine = multiple_model.run_recovering(record, NOISE, start, **given)
        assert len(events(plain, "recovery")) >= len(options.get("jumps", ())) + options.get("lost", 0)
        for name in ("time", "attitude", "bias", "variance", "covariance"):
            assert np.array_equal(getattr(mine, name), getattr(plain, name))
        assert mine.events == plain.events
        assert mine.skipped == plain.skipped
        for sensor, one in plain.innovations.items():
            assert np.array_equal(mine.innovations[sensor].innovation, one.innovation)
            assert np.array_equal(mine.innovations[sensor].weight, one.weight)


@pytest.mark.parametrize(
    "gate",
    [Gate(recovery=None), Gate(restart_attitude_sigma=0.5)],
    ids=["no recovery", "a restart that knows something"],
)
def test_a_gate_that_leaves_no_turn_open_hands_nothing_over(gate):
    record, start = lost_record(0, jumps=(15.0,), duration=30.0)
    plain = estimation.run(record, NOISE, start, gate=gate)
    mine = multiple_model.run_recovering(record, NOISE, start, gate=gate)
    assert np.array_equal(mine.attitude, plain.attitude)
    assert mine.events == plain.events != ()


def test_a_second_direction_that_comes_at_once_leaves_nothing_open_and_one_that_comes_late_does():
    """Of two directions that do not turn: the second measures the turn about the first, and it is one filter's from then on."""
    record, start = lost_record(1, lost=True, rate=0.0, stars=2, duration=20.0)
    late = record.vectors[1].taken(record.vectors[1].time > 10.0)
    for second, handed in ((record.vectors[1], 0), (late, 1)):
        both = dataclasses.replace(record, vectors=(record.vectors[0], second))
        estimate = multiple_model.run_recovering(both, NOISE, start, gate=Gate(), full_covariance=True)
        (recovery,) = events(estimate, "recovery")
        assert recovery.end < 2.0
        open_part = events(estimate, "hypotheses")
        assert len(open_part) == handed
        for event in open_part:
            assert event.start == recovery.end
            assert 10.0 < event.end < 11.0
            assert event.value == 0.0
        assert nees(estimate, both)[-1] < 3.0


# ------------------------------------------------------------------------------------------------------------------ how it is joined


@functools.cache
def one_recovery():
    record, start = lost_record(3, jumps=(15.0,), duration=40.0)
    later = np.where(np.arange(len(record.time)) > 300, 0.11, 0.0) + np.where(
        np.arange(len(record.time)) > 1900, 0.13, 0.0
    )
    (one,) = record.vectors
    moved = dataclasses.replace(one, time=one.time + later[::5])
    vector_b = np.array(one.vector_b)
    vector_b[[20, 153, 180, 390]] = np.nan  # before it, while it is lost, in the bank's part, and after
    record = dataclasses.replace(
        record, time=record.time + later, vectors=(dataclasses.replace(moved, vector_b=vector_b),)
    )
    return record, start, multiple_model.run_recovering(record, NOISE, start, gate=Gate(), full_covariance=True)


def test_its_parts_are_the_filter_the_bank_and_the_filter_again():
    record, start, estimate = one_recovery()
    (recovery,), (open_part,) = events(estimate, "recovery"), events(estimate, "hypotheses")
    assert (open_part.start, open_part.sensor, open_part.value) == (recovery.end, "star 0", 0.0)
    assert open_part.start < open_part.end < record.time[-1]
    assert np.array_equal(estimate.time, record.time)
    before = estimation.run(record, NOISE, start, gate=Gate(), full_covariance=True)
    early = record.time < recovery.end
    assert np.array_equal(estimate.attitude[early], before.attitude[early])
    assert np.array_equal(estimate.covariance[early], before.covariance[early])
    # It starts with the bias before the first refusal, as uncertain as the candidate did; from then on it is a bank alone.
    first, last = (int(np.searchsorted(record.time, time)) for time in (recovery.start - 1e-9, recovery.end))
    first -= 1
    _, end = estimation.run_part(records.cut(record, 0, last), NOISE, start, gate=Gate())
    sigma = np.sqrt(end.gate.counts[gate_rules.FIRST_BIAS + 3 : gate_rules.FIRST_BIAS + 6])
    assert np.all(sigma**2 >= before.variance[first, 3:] + BIAS_SIGMA**2)
    rest = records.cut(record, first, len(record.time) - 1)
    alone = multiple_model.run(
        rest, NOISE, bias=before.bias[first], bias_sigma=sigma, gate=Gate(restart_bias_sigma=BIAS_SIGMA)
    )
    assert alone.became_one == open_part.end
    same = np.searchsorted(alone.estimate.time, record.time[~early])
    assert np.array_equal(estimate.attitude[~early], alone.estimate.attitude[same])
    assert np.array_equal(estimate.covariance[~early], alone.estimate.covariance[same])
    at = int(np.searchsorted(record.time, open_part.end))
    one = estimation.State(attitude=estimate.attitude[at], bias=estimate.bias[at], covariance=estimate.covariance[at])
    rest = records.cut(record, at, len(record.time) - 1)
    after = estimation.run(rest, NOISE, one, gate=Gate(restart_bias_sigma=BIAS_SIGMA))
    assert np.array_equal(estimate.attitude[at:], after.attitude)


def test_each_measurement_is_reported_once_and_what_was_missing_is_counted():
    record, start, estimate = one_recovery()
    (one,) = record.vectors
    there = np.isfinite(one.vector_b).all(axis=1)
    innovations = estimate.innovations["star 0"]
    assert np.array_equal(innovations.time, one.time[there])
    assert estimate.skipped == {"star 0": 4}
    (recovery,) = events(estimate, "recovery")
    lost = (innovations.time >= recovery.start) & (innovations.time <= recovery.end)
    assert not np.any(innovations.used[lost])
    assert np.sum(lost) == recovery.value
    assert estimate.refused["star 0"] < recovery.value + 4
    assert 1.5 < np.mean(innovations.nis[innovations.time > recovery.end]) < 2.5
    assert [(event.kind, event.start) for event in estimate.events if event.kind != "gap"] == [
        ("recovery", recovery.start),
        ("hypotheses", recovery.end),
    ]
    assert events(estimate, "gap") == estimation.gaps(record.time)
    assert len(events(estimate, "gap")) == 2
    taken = dataclasses.replace(record, vectors=(one.taken(there),))
    other = multiple_model.run_recovering(taken, NOISE, start, gate=Gate(), full_covariance=True)
    assert np.array_equal(other.attitude, estimate.attitude)
    assert np.array_equal(other.covariance, estimate.covariance)
    assert other.events == estimate.events


def test_it_is_the_same_each_time_and_whatever_is_kept():
    record, start, estimate = one_recovery()
    again = multiple_model.run_recovering(record, NOISE, start, gate=Gate())
    assert again.covariance is None
    for name in ("attitude", "bias", "variance"):
        assert np.array_equal(getattr(again, name), getattr(estimate, name))
    (open_part,) = events(estimate, "hypotheses")
    coarse = multiple_model.run_recovering(record, NOISE, start, gate=Gate(), every=16)
    assert np.array_equal(coarse.time, record.time[::16])
    mine = coarse.time <= open_part.end  # they become one at kept edges
    assert np.array_equal(coarse.attitude[mine], estimate.attitude[::16][mine])
    (later,) = events(coarse, "hypotheses")
    assert later.start == open_part.start
    assert open_part.end <= later.end <= open_part.end + 16 * 0.02 + 1e-9
    assert quaternion.angle_between(coarse.attitude[-1], estimate.attitude[-1]) < 0.1 * DEGREE


@pytest.mark.parametrize("second", [19.0, 45.0], ids=["by the bank", "by the filter"])
def test_a_second_loss_is_recovered_from_as_the_first(second):
    """Before the bank has become one, when most often it recovers by itself, and after."""
    last, own = [], 0
    for run in range(8):
        record, start = lost_record(run, jumps=(15.0, second), duration=70.0)
        estimate = multiple_model.run_recovering(record, NOISE, start, gate=Gate(), every=5, full_covariance=True)
        assert np.array_equal(estimate.time, record.time[::5])
        assert np.array_equal(estimate.innovations["star 0"].time, record.vectors[0].time)
        last.append(nees(estimate, record)[-1])
        times = [event.start for event in events(estimate, "recovery")]
        assert np.allclose(times, (15.0, second), atol=0.8)
        open_part = events(estimate, "hypotheses")
        assert open_part[0].start == events(estimate, "recovery")[0].end
        assert all(event.value == 0.0 for event in open_part)
        if len(open_part) == 1:
            assert open_part[0].end > events(estimate, "recovery")[1].end
            own += 1
        # It starts as uncertain of the bias as at first, of which one direction shows two axes at once.
        row = int(np.searchsorted(estimate.time, events(estimate, "recovery")[1].end))
        assert np.linalg.eigvalsh(estimate.covariance[row, 3:, 3:])[-1] > 0.8 * BIAS_SIGMA**2
        between = (estimate.time > second - 1.0) & (estimate.time < second)
        assert np.mean(nees(estimate, record)[between]) < 4.0  # what the first bank said stands until it recovers
    low, high = consistency.mean_bounds(6, 8, 0.99)
    assert low < np.mean(last) < high
    assert own > 4 if second < 20.0 else own == 0


@pytest.mark.parametrize(("rate", "duration"), [(0.02, 19.0), (0.0, 30.0)], ids=["too short", "it never turns"])
def test_a_record_that_ends_before_they_are_one_says_so(rate, duration):
    record, start = lost_record(2, jumps=(15.0,), rate=rate, duration=duration)
    estimate = multiple_model.run_recovering(record, NOISE, start, gate=Gate(), full_covariance=True)
    (recovery,), (open_part,) = events(estimate, "recovery"), events(estimate, "hypotheses")
    assert (open_part.start, open_part.end) == (recovery.end, record.time[-1])
    assert open_part.value > 8
    assert nees(estimate, record)[-1] < 3.0
    widest = np.sqrt(np.linalg.eigvalsh(estimate.covariance[-1, :3, :3])[-1])
    assert widest > 1.0 * DEGREE if rate else widest > multiple_model.UNKNOWN


def test_a_takeover_after_the_last_kept_edge_changes_no_row():
    record, start = lost_record(2, jumps=(15.0,), duration=17.0)
    plain = estimation.run(record, NOISE, start, gate=Gate(), every=780)
    mine = multiple_model.run_recovering(record, NOISE, start, gate=Gate(), every=780)
    assert events(plain, "recovery")[0].end > plain.time[-1] == 15.6
    assert np.array_equal(mine.attitude, plain.attitude)
    assert mine.events == plain.events


def test_the_monitor_watches_the_filters_parts():
    record, start, estimate = one_recovery()
    watched = multiple_model.run_recovering(
        record, NOISE, start, gate=Gate(), monitor=Monitor(window=5, probability=0.5)
    )
    (open_part,) = events(estimate, "hypotheses")
    times = [(event.start, event.end) for event in events(watched, "divergence")]
    assert any(end <= open_part.start for _, end in times)
    assert any(start > open_part.end for start, _ in times)
    assert not any(start < open_part.end and end > open_part.start for start, end in times)
    assert np.array_equal(watched.attitude, estimate.attitude)


def test_a_smoother_takes_what_follows():
    record, _, estimate = one_recovery()
    at = int(np.searchsorted(record.time, events(estimate, "hypotheses")[0].end))
    one = estimation.State(attitude=estimate.attitude[at], bias=estimate.bias[at], covariance=estimate.covariance[at])
    smooth = estimation.smooth(
        records.cut(record, at, len(record.time) - 1), NOISE, one, gate=Gate(), full_covariance=True
    )
    assert np.all(smooth.variance[0] < estimate.variance[at])
    assert np.mean(nees(smooth, record)) < 2.5


def test_a_part_that_begins_amid_refusals_recovers():
    """The end state of one part has six of them; the bank starts from those that this part has."""
    record, start = lost_record(3, jumps=(15.0,), duration=40.0)
    _, state = estimation.run_part(records.cut(record, 0, 778), NOISE, start, gate=Gate())
    assert state.gate.counters["star 0"][gate_rules.IN_A_ROW] == 6.0
    rest = records.cut(record, 778, 2000)
    estimate = multiple_model.run_recovering(rest, NOISE, state, gate=Gate(), every=2, full_covariance=True)
    assert len(events(estimate, "recovery")) == len(events(estimate, "hypotheses")) == 1
    assert nees(estimate, rest)[-1] < 4.0


def test_a_chance_refusal_just_before_it_is_none_of_its_measurements():
    """A star that is off at 14.9 s: it is the first of the candidate's, but not of those that agree with what follows."""
    record, start = lost_record(3, jumps=(15.0,), duration=30.0)
    (one,) = record.vectors
    vector_b = np.array(one.vector_b)
    vector_b[145:148] = -vector_b[145:148]
    record = dataclasses.replace(record, vectors=(dataclasses.replace(one, vector_b=vector_b),))
    estimate = multiple_model.run_recovering(record, NOISE, start, gate=Gate(), every=5, full_covariance=True)
    (recovery,) = events(estimate, "recovery")
    assert recovery.end < 17.0
    after = estimate.time >= recovery.end
    assert np.mean(nees(estimate, record)[after]) < 2.0


def test_a_heading_alone_starts_no_bank():
    """The star is hidden from the turn on: only headings are left, of which none can make a circle."""
    record, start = lost_record(4, jumps=(15.0,), duration=25.0)
    (one,) = record.vectors
    heading = dataclasses.replace(one, sensor="compass", kind="heading").taken(one.time > 15.0)
    hidden = dataclasses.replace(record, vectors=(one.taken(one.time < 15.0), heading))
    plain = estimation.run(hidden, NOISE, start, gate=Gate(), every=5)
    mine = multiple_model.run_recovering(hidden, NOISE, start, gate=Gate(), every=5)
    assert np.array_equal(mine.attitude, plain.attitude)
    assert mine.events == plain.events


def test_what_makes_no_sense_is_refused():
    record, start = lost_record(0, duration=1.0)
    with pytest.raises(InputError, match="gate is None"):
        multiple_model.run_recovering(record, NOISE, start, gate=None)
    with pytest.raises(InputError, match="hypotheses"):
        multiple_model.run_recovering(record, NOISE, start, gate=Gate(), hypotheses=4)
    with pytest.raises(InputError, match="every"):
        multiple_model.run_recovering(record, NOISE, start, gate=Gate(), every=0)
