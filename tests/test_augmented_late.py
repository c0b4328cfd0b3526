"""The step face with optional states where it is used live: late and simultaneous measurements, and a monitor on both faces."""

from __future__ import annotations

import dataclasses
import functools
import pickle

import numpy as np
import pytest
from filterpy.common import Saver

from strapdown import augmented, mekf, motion, quaternion
from strapdown.estimation.error_states import Block
from strapdown.checks import InputError
from strapdown.gyro import GyroSpec
from strapdown.mekf import ProcessNoise
from strapdown.randomness import generator
from strapdown.records import ImuRecord
from strapdown.estimation.gating import Gate, Monitor, Robust
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import AttitudeSensor, Faults, VectorSensor

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
X, Y, UP = np.eye(3)


@dataclasses.dataclass(frozen=True)
class Walking(augmented.GeneralBlock):
    """A bias of a direction that walks, and a known latency of it, told by functions."""

    name: str = "walking"
    components: tuple[str, ...] = ("x", "y", "z")
    units: tuple[str, ...] = ("1",) * 3

    @property
    def sigma(self):
        return np.full(3, 0.01)

    def measured(self, values, view):
        return (values + 2e-3 * np.cross(view.expected_b, view.rate), np.eye(3)) if view.sensor == "a" else None

    def propagate(self, values, interval):
        return values, np.eye(3), np.zeros((3, 3)), 1e-8 * interval.dt * np.eye(3)


IRON = augmented.VectorBias(sensor="a", bias_sigma=0.01, rate_random_walk=1e-4)
SWAY = augmented.GaussMarkov(sensor="b", noise_sigma=0.02, correlation_time=0.5, frame="fixed")
DRIFT = augmented.GyroGaussMarkov(bias_sigma=1e-3, correlation_time=5.0)
BLOCKS: dict[str, tuple[Block, ...]] = {
    "bias, drift and sway": (IRON, DRIFT, SWAY),
    "by functions": (Walking(), SWAY),
}
OPTIONS: dict[str, dict] = {
    "plain": {},
    "gate, Student, monitor": {
        "gate": Gate(probability=0.9999),
        "robust": Robust(degrees_of_freedom=3.0),
        "monitor": Monitor(window=5, probability=0.9),
    },
    "lost": {"gate": Gate(recovery=4)},
}


@functools.cache
def record_of(duration: float = 1.2) -> ImuRecord:
    """Sensors of three kinds, all at the same ten stamps a second, some of them far off."""
    outliers = Faults(outlier_probability=0.1)
    scenario = Scenario(
        motion=motion.Coning(angle=0.3, frequency=0.3),
        gyro=GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias=np.array([1e-3, -2e-3, 5e-4])),
        sensors=(
            VectorSensor(name="a", reference_f=[1.0, 0.2, 0.0], sigma=1e-3, rate=10.0, faults=outliers),
            VectorSensor(name="north", reference_f=[0.0, 1.0, -1.0], sigma=5e-3, rate=10.0, kind="heading"),
            AttitudeSensor(name="tracker", sigma_across=1e-2, sigma_about=5e-2, rate=10.0),
            VectorSensor(name="b", reference_f=[0.0, 1.0, 1.0], sigma=2e-3, rate=10.0, faults=outliers),
        ),
        rate=50.0,
        duration=duration,
    )
    return simulate(scenario, 5)


def begun(record: ImuRecord, option: str) -> mekf.State:
    error = (1.0, 0.5, -1.0) if option == "lost" else (0.05, -0.06, 0.07)
    attitude = quaternion.multiply(record.truth.attitude[0], quaternion.exp(error))
    return mekf.initial_state(attitude, attitude_sigma=1e-2 if option == "lost" else 0.1, bias_sigma=3e-3)


def handed_over(record, initial, blocks, arrivals, stops=(), **options) -> augmented.StepFilter:
    """Run the step face over a record; ``arrivals`` (series, sample) says when each measurement is handed over, and it stops besides."""
    names = [s.sensor for s in record.vectors]
    f = augmented.StepFilter(NOISE, initial, blocks, time=record.time[0], sensors=names, **options)
    queue = [(arrivals[i][k], i, k) for i, s in enumerate(record.vectors) for k in range(len(s.time))]
    queue = sorted([*queue, *((stop, -1, 0) for stop in stops)])
    kinds = {"direction": f.update_direction, "heading": f.update_heading}
    for n, delta in enumerate(record.increments):
        now, end = record.time[n], record.time[n + 1]
        whole = end - now
        while queue and queue[0][0] <= end:
            handed, i, k = queue.pop(0)
            if handed > now:
                f.predict(delta * ((handed - now) / whole), time=handed)
                now = handed
            s = record.vectors[i]
            if i < 0:
                continue
            if s.kind == "attitude":
                f.update_attitude(s.attitude[k], s.sigma_axes[k], sensor=s.sensor, time=s.time[k])
            else:
                kinds[s.kind](s.vector_b[k], s.references_f[k], s.sigma[k], sensor=s.sensor, time=s.time[k])
        if end > now:
            f.predict(delta * ((end - now) / whole), time=end)
    return f


def apart(one: augmented.StepFilter, other: augmented.StepFilter) -> float:
    """How far two filters are from each other, over the σ of the second."""
    sigma = np.sqrt(np.diag(other.P))
    turn = quaternion.log(quaternion.multiply(quaternion.conjugate(other.attitude), one.attitude))
    state = np.concatenate([turn, one.bias - other.bias, one.values - other.values]) / sigma
    return max(np.abs(state).max(), np.abs((one.P - other.P) / np.outer(sigma, sigma)).max())


@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize(
    ("states", "latency"),
    [
        ("bias, drift and sway", "all of them, each its own"),
        ("bias, drift and sway", "reversed"),
        ("by functions", "all of them, each its own"),
    ],
)
def test_late_measurements_at_common_stamps_equal_the_filter_in_order(states, option, latency):
    record, given, blocks = record_of(), OPTIONS[option], BLOCKS[states]
    initial, end, draw = begun(record, option), record.time[-1], generator(3, 0, "latency")
    at_once = [s.time for s in record.vectors]
    if latency == "reversed":
        arrivals = [time + 0.01 * (3 - i) for i, time in enumerate(at_once)]
    else:
        arrivals = [time + draw.uniform(0.0, 0.2, len(time)) for time in at_once]
    arrivals = [np.minimum(arrival, end) for arrival in arrivals]
    # A gyro's drift is exact to the sixth order of a step: both stop where the other does.
    ordered = handed_over(record, initial, blocks, at_once, stops=np.concatenate(arrivals), **given)
    late = handed_over(record, initial, blocks, arrivals, look_back=0.25, **given)
    assert late.late == 0
    assert late.refused == ordered.refused
    assert late.time == ordered.time == record.time[-1]
    assert apart(late, ordered) < 1e-12
    assert [(event.kind, event.start, event.end) for event in late.events] == [
        (event.kind, event.start, event.end) for event in ordered.events
    ]
    assert bool(ordered.events) == (option != "plain")
    estimate = augmented.run(record, NOISE, initial, blocks, **given)
    assert quaternion.angle_between(estimate.attitude[-1], late.attitude) < 1e-9


def test_what_comes_too_late_is_counted_and_changes_nothing():
    f = augmented.StepFilter(NOISE, begun(record_of(), "plain"), (IRON,), look_back=0.3)
    for k in range(1, 11):
        f.predict([0.0, 0.0, 1.0], time=0.1 * k)  # in sub-steps
        assert f.time == 0.1 * k
    f.attitude = np.array([1.0, 0.0, 0.0, 0.0])
    before = f.P.copy()
    assert not f.update_direction(X, X, 0.1, "a", time=0.6)
    assert f.late == 1
    assert np.array_equal(f.P, before)
    assert f.update_direction(X, X, 0.1, "a", time=0.75)
    assert f.late == 1
    with pytest.raises(InputError, match="after the filter's"):
        f.update_direction(X, X, 0.1, "a", time=1.1)
    with pytest.raises(InputError, match=r"use .*update_direction"):
        f.update(np.zeros(2), None, None)


def test_noise_is_told_by_sigma_or_by_covariance():
    C = np.array([[2e-4, 1e-5, 0.0], [1e-5, 1e-4, 2e-5], [0.0, 2e-5, 3e-4]])
    found = []
    for noise in ({"sigma": C}, {"covariance": C}):
        f = augmented.StepFilter(NOISE, begun(record_of(), "plain"), (IRON,))
        assert f.update_direction(X, X, sensor="a", **noise)
        found.append(f.P)
    assert np.array_equal(*found)
    for bad in ({}, {"sigma": 0.1, "covariance": C}):
        with pytest.raises(InputError, match="either sigma or covariance"):
            f.update_direction(X, X, sensor="a", **bad)


def test_saver_and_pickle_take_a_look_back_and_a_monitor():
    record = record_of()
    f = augmented.StepFilter(
        NOISE,
        begun(record, "lost"),
        BLOCKS["bias, drift and sway"],
        gate=Gate(recovery=4),
        monitor=Monitor(window=5, probability=0.9),
        look_back=0.3,
        sensors=("a", "b"),
    )
    history = Saver(f, save_current=True)
    a, _, _, b = record.vectors
    for k, t in enumerate(a.time):
        if t > f.time:
            now, then = np.searchsorted(record.time, [f.time, t])
            f.predict(record.increments[now:then].sum(axis=0), time=t)
        for series in (a, b):
            f.update_direction(series.vector_b[k], series.references_f[k], 2e-3, series.sensor)
        history.save()
    history.to_array()
    assert history.P.shape == (len(a.time) + 1, 15, 15)
    copy = pickle.loads(pickle.dumps(f))
    for one in (f, copy):
        assert {event.kind for event in one.events} == {"divergence", "recovery"}
        one.update_direction(X, X, 0.5, "a", time=f.time - 0.15)
    assert np.array_equal(copy.P, f.P)
    assert copy.events == f.events


# ------------------------------------------------------------------------------------------------------------------------ monitor

WATCH = Monitor(window=8, probability=0.99)


def divergences(events):
    return [event for event in events if event.kind == "divergence"]


@pytest.mark.parametrize("option", ["plain", "gate"])
def test_without_blocks_a_monitor_tells_what_the_plain_filter_s_does(option):
    record = record_of()
    given = {"gate": Gate(recovery=4)} if option == "gate" else {}
    start = begun(record, "lost")
    plain = mekf.run(record, NOISE, start, monitor=WATCH, **given)
    other = augmented.run(record, NOISE, start, monitor=WATCH, **given)
    assert divergences(plain.events)
    assert len(plain.events) == len(other.events)
    for one, same in zip(plain.events, other.events, strict=True):
        assert (one.kind, one.start, one.end, one.sensor) == (same.kind, same.start, same.end, same.sensor)
        assert one.value == pytest.approx(same.value, rel=1e-8)


@pytest.mark.parametrize("gate", [None, Gate(recovery=None)], ids=["none", "gate"])
@pytest.mark.parametrize("states", BLOCKS)
def test_a_monitor_watches_both_faces_alike(states, gate):
    """Of sensors that are far off now and then."""
    record, blocks = record_of(4.0), BLOCKS[states]
    start = begun(record, "plain")
    whole = augmented.run(record, NOISE, start, blocks, gate=gate, monitor=WATCH)
    without = augmented.run(record, NOISE, start, blocks, gate=gate)
    face = handed_over(record, start, blocks, [s.time for s in record.vectors], gate=gate, monitor=WATCH)
    told = divergences(whole.events)
    assert told
    assert bool(sum(whole.refused.values())) == (gate is not None)
    assert np.array_equal(whole.attitude, without.attitude)
    assert [event for event in whole.events if event not in told] == list(without.events)
    assert len(divergences(face.events)) == len(told)
    for one, other in zip(told, divergences(face.events), strict=True):
        assert (one.start, one.end) == pytest.approx((other.start, other.end))
        assert one.value == pytest.approx(other.value, rel=1e-6)
    # All innovations in order of time, of refused ones the threshold.
    rows = []
    for place, (name, found) in enumerate(whole.innovations.items()):
        degrees = {"north": 1, "tracker": 3}.get(name, 2)
        for k, time in enumerate(found.time):
            nis = np.sum(found.innovation[k] ** 2 / found.variance[k])
            refused = gate is not None and found.weight[k] == 0.0
            rows.append((time, place, gate.thresholds[degrees - 1] if refused else nis, degrees))
    time, _, nis, degrees = (np.array(column) for column in zip(*sorted(rows), strict=True))
    assert WATCH.watch(time, nis, degrees) == told


def test_a_monitor_that_is_none_is_refused():
    with pytest.raises(InputError, match="monitor is True"):
        augmented.run(record_of(), NOISE, begun(record_of(), "plain"), (IRON,), monitor=True)
    with pytest.raises(InputError, match="monitor is True"):
        augmented.StepFilter(NOISE, begun(record_of(), "plain"), (IRON,), monitor=True)
