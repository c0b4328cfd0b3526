"""The live filter against the filter over records, sample by sample: in order, late, gated, with error states, and what it refuses."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from measured import series_of, unit
from test_step_filter import NOISE, OPTIONS, begun, record_of, start

from strapdown import estimation, motion
from strapdown.checks import InputError
from strapdown.estimation import LiveFilter, error_states, forward
from strapdown.estimation.gating import Gate, Robust
from strapdown.gyro import GyroSpec
from strapdown.randomness import generator
from strapdown.records import ImuRecord
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import AttitudeSensor, VectorMeasurements, VectorSensor

STATES = {
    "none": (),
    "walk and velocity": (
        error_states.VectorBias(sensor="a", bias_sigma=0.01, rate_random_walk=1e-4),
        error_states.BoundedVelocity(
            sensor="b", velocity_time=2.0, velocity_sigma=0.01, acceleration_time=1.0 / 18.0, strength=1.0
        ),
    ),
}
"""With the structure of tests/test_error_states_recovery.py; sensors of other kinds have no states here."""


CASES = [
    pytest.param(states, option, marks=pytest.mark.slow if STATES[states] and option == "plain" else [])
    for states in STATES
    for option in OPTIONS
]
"""In the default run error states come with a gate only: each takes seconds to compile."""


def record_for(states):
    """Return a record with sensors of three kinds, or with two whole vectors for the states."""
    record = record_of()
    if states == "none":
        return record
    directions = (s for s in record.vectors if s.kind == "direction")
    return replace(
        record, vectors=tuple(replace(s, kind="vector", reference_f=unit(s.reference_f)) for s in directions)
    )


def sample(series, k):
    return (series.vector_b if series.attitude is None else series.attitude)[k]


def live_of(record, initial, states=(), **options):
    return LiveFilter(NOISE, initial, states, sensors=record.vectors, time=record.time[0], **options)


def given_in_order(record, live):
    """Give each gyro sample with what was measured at its end."""
    at = {}
    for series in record.vectors:
        for k, time in enumerate(series.time):
            at.setdefault(time, {})[series.sensor] = sample(series, k)
    for time, increment in zip(record.time[1:], record.increments, strict=True):
        live.update(time, delta_theta=increment, **dict(reversed(at.get(time, {}).items())))
    return live


def given_late(record, live, latency):
    """Give each measurement ``latency`` (series, sample) after its time, after the gyro sample that is due then."""
    late = [
        (time + delay, time, series.sensor, sample(series, k))
        for series, delays in zip(record.vectors, latency, strict=True)
        for k, (time, delay) in enumerate(zip(series.time, delays, strict=True))
    ]
    late.sort(key=lambda measurement: measurement[:3])
    for k, increment in enumerate(record.increments):
        live.update(record.time[k + 1], delta_theta=increment)
        while late and late[0][0] <= record.time[k + 1]:
            _, time, sensor, value = late.pop(0)
            live.update(time, **{sensor: value})
    for _, time, sensor, value in late:
        live.update(time, **{sensor: value})
    return live


def same(first, second):
    """Whether two states are equal to the bit."""
    parts = ("attitude", "bias", "values", "covariance")
    return all(np.array_equal(getattr(first, part), getattr(second, part)) for part in parts)


def apart(first, second):
    """How far two states are from each other, over the σ of the second."""
    sigma = np.sqrt(np.diag(second.covariance))
    state = np.concatenate(
        [2.0 * (first.attitude - second.attitude)[1:], first.bias - second.bias, first.values - second.values]
    )
    covariance = (first.covariance - second.covariance) / np.outer(sigma, sigma)
    return max(np.abs(state / sigma).max(), np.abs(covariance).max())


@pytest.mark.parametrize(("states", "option"), CASES)
def test_equals_the_record(states, option):
    record, options, blocks = record_for(states), OPTIONS[option], STATES[states]
    initial = begun(record, option)
    live = given_in_order(record, live_of(record, initial, blocks, **options))
    estimate, end = estimation.run_part(record, NOISE, initial, blocks, **options)
    assert same(live.state(), end)
    assert live.refused == {name: innovations.refused for name, innovations in estimate.innovations.items()}
    assert [(e.kind, e.start, e.end, e.sensor) for e in live.events] == [
        (e.kind, e.start, e.end, e.sensor) for e in estimate.events
    ]
    for name, innovations in live.innovations.items():
        assert innovations.innovation[-1] == pytest.approx(
            estimate.innovations[name].innovation[-1], rel=1e-6, abs=1e-12
        )
        assert innovations.used[-1] == estimate.innovations[name].used[-1]
    assert len(live.innovations) == len(record.vectors)


@pytest.mark.parametrize("option", ["gate, Huber", "lost"])
def test_error_states_equal_the_record_to_the_bit(option):
    """Between the gyro's edges too, with missing measurements, an interval that is divided into sub-steps, and from rates."""
    record, blocks = record_for("walk and velocity"), STATES["walk and velocity"]
    options = {
        "gate": Gate(probability=0.99 if option != "lost" else 0.9999, recovery=4),
        "robust": Robust(kind="huber"),
    }
    rates = record.increments / np.diff(record.time)[:, None]
    rates[40] *= 100.0
    fewer = tuple(s.taken(np.arange(len(s.time)) % 7 != i) for i, s in enumerate(record.vectors))
    increments = rates * np.diff(record.time)[:, None]
    record = replace(record, increments=increments, vectors=fewer, truth=None, origin=None)
    initial = begun(record_for("walk and velocity"), option)
    live = live_of(record, initial, blocks, **options)
    for k, rate in enumerate(rates):
        now = {s.sensor: sample(s, int(i)) for s in fewer for i in np.flatnonzero(s.time == record.time[k + 1])}
        live.update(record.time[k + 1], rate, **now)
    estimate, end = estimation.run_part(record, NOISE, initial, blocks, **options)
    assert same(live.state(), end)
    assert sum(live.refused.values()) == sum(innovations.refused for innovations in estimate.innovations.values()) > 0


@pytest.mark.parametrize("shifts", [(0.0, 0.0, 0.0, 0.0), (0.0, -0.0071, -0.003, -0.003)], ids=["edges", "between"])
@pytest.mark.parametrize(("states", "option"), CASES)
def test_late_measurements_lead_to_the_same_bits(states, option, shifts):
    """All at common stamps, which are the gyro's edges, or most between them; the first sensor's begin at the start."""
    record, options, blocks = record_for(states), OPTIONS[option], STATES[states]
    moved = tuple(
        replace(s, time=s.time - s.time[0] * (i == 0) + shift)
        for i, (s, shift) in enumerate(zip(record.vectors, shifts, strict=False))
    )
    record = replace(record, vectors=moved, truth=None, origin=None)
    initial = begun(record_for(states), option)
    draw = generator(3, 0, "latency")
    latency = [draw.uniform(0.0, 0.2, len(series.time)) for series in record.vectors]
    latency[-1][:] = 0.0  # in time, but last in the order of the sensors
    live = given_late(record, live_of(record, initial, blocks, look_back=0.25, **options), latency)
    problem = forward.prepared(record, NOISE, initial, blocks)
    passed = forward.filtered(problem, forward.Options(**options))
    assert live.late == 0
    # All measurements lie in the record, the last ones in its last interval.
    assert same(live.state(), passed.end)
    assert live.refused == {name: innovations.refused for name, innovations in passed.estimate.innovations.items()}
    assert [(e.kind, e.start, e.end, e.value) for e in live.events] == [
        (e.kind, e.start, e.end, e.value) for e in passed.estimate.events
    ]


def test_its_state_continues_a_record_and_a_record_continues_it():
    record, states, option = record_for("walk and velocity"), STATES["walk and velocity"], OPTIONS["lost"]
    initial = begun(record, "lost")
    whole = given_in_order(record, live_of(record, initial, states, **option))
    for middle in (13, 47):  # before the recovery, with a candidate, and after it
        time = record.time[middle]
        first = replace(
            record,
            time=record.time[: middle + 1],
            increments=record.increments[:middle],
            vectors=tuple(s.taken(s.time <= time) for s in record.vectors),
            truth=None,
            origin=None,
        )
        second = replace(
            record,
            time=record.time[middle:],
            increments=record.increments[middle:],
            vectors=tuple(s.taken(s.time > time) for s in record.vectors),
            truth=None,
            origin=None,
        )
        live = given_in_order(first, live_of(record, initial, states, **option))
        assert same(estimation.run_part(second, NOISE, live.state(), states, **option)[1], whole.state())
        _, end = estimation.run_part(first, NOISE, initial, states, **option)
        resumed = LiveFilter(NOISE, end, states, sensors=record.vectors, time=time, **option)
        assert same(given_in_order(second, resumed).state(), whole.state())


def test_lock_outs_that_go_on_are_one_event():
    """A sensor 30 σ off the others is refused for good: one lock-out, from the first refusal to the last."""
    up = VectorSensor(name="up", reference_f=[0.0, 0.0, 1.0], sigma=1e-3, rate=10.0)
    wrong = VectorSensor(name="wrong", reference_f=[1.0, 0.0, 0.0], sigma=1e-3, rate=10.0)
    live = LiveFilter(NOISE, start(1e-3), sensors=[up, wrong], gate=Gate(recovery=None), look_back=1.0)
    for k in range(1, 41):
        live.update(0.1 * k, (0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0))
    for k in range(5, 41):  # late, which repeats what came after
        live.update(0.1 * k, wrong=(0.9, 0.4, 0.0))
    assert live.late == 25  # those before the last second
    (event,) = live.events
    assert (event.kind, event.sensor, event.value) == ("lock-out", "wrong", 11.0)
    assert (event.start, event.end) == (pytest.approx(3.0), pytest.approx(4.0))
    assert live.refused == {"up": 0, "wrong": 11}


def measured_as(kind, sigma, reference, value):
    measurement = (
        {"attitude": value[None]} if kind == "attitude" else {"vector_b": value[None], "reference_f": reference}
    )
    return VectorMeasurements(sensor="s", kind=kind, time=np.array([0.1]), sigma=np.array([sigma]), **measurement)


@pytest.mark.parametrize("kind", ["direction", "vector", "heading", "attitude"])
def test_noise_and_reference_of_one_measurement(kind):
    """Given with a measurement they are as if the sensor had been declared with them."""
    r, z = np.array([0.6, 0.8, 0.5]), np.array([0.5, 0.9, 0.4])
    if kind != "vector":
        r, z = r / np.linalg.norm(r), z / np.linalg.norm(z)
    if kind == "attitude":
        r, z = np.zeros(3), np.array([1.0, 0.01, -0.02, 0.03])
        z /= np.linalg.norm(z)
    exact = LiveFilter(NOISE, start(), sensors=[measured_as(kind, 0.03, r, z)])
    exact.update(0.1, (0.0, 0.1, 0.0), s=z)
    other = LiveFilter(NOISE, start(), sensors=[measured_as(kind, 0.01, np.array([1.0, 0.0, 0.0]), z)])
    reference = None if kind == "attitude" else {"s": r}
    other.update(0.1, (0.0, 0.1, 0.0), s=z, sigma={"s": 0.03}, reference_f=reference)
    assert same(other.state(), exact.state())
    # The next one has the declared noise again.
    again = LiveFilter(NOISE, other.state(), sensors=[measured_as(kind, 0.01, np.array([1.0, 0.0, 0.0]), z)], time=0.1)
    for live in (other, again):
        live.update(0.2, (0.0, 0.1, 0.0), s=z)
    assert apart(other.state(), again.state()) < 1e-12
    assert not same(other.state(), exact.state())


def test_covariances_of_sensors():
    """A sensor with a covariance in body axes, beside one with a σ, as the record's filter has them."""
    r = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    whole = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.2], [0.0, 0.2, 3.0]]) * 1e-4
    times = np.arange(1, 6) / 10.0
    z = generator(1, 0, "z").normal(0.0, 0.01, (2, 5, 3)) + r[:, None]
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    vectors = (
        VectorMeasurements(sensor="a", kind="direction", time=times, vector_b=z[0], reference_f=r[0], covariance=whole),
        series_of("b", "direction", times, z[1], r[1], 0.01),
        VectorMeasurements(
            sensor="c", kind="vector", time=times, vector_b=3.0 * z[1], reference_f=3.0 * r[1], covariance=whole
        ),
    )
    record = ImuRecord(time=np.arange(6) / 10.0, increments=np.full((5, 3), 0.01), vectors=vectors)
    live = given_in_order(record, live_of(record, start()))
    assert apart(live.state(), estimation.run_part(record, NOISE, start())[1]) < 1e-12


def test_missing_and_vertical_are_skipped():
    sensors = [
        VectorSensor(name="north", reference_f=[0.0, 1.0, -1.0], sigma=1e-2, rate=10.0, kind="heading"),
        VectorSensor(name="up", reference_f=[0.0, 0.0, 1.0], sigma=1e-2, rate=10.0),
        AttitudeSensor(name="tracker", sigma_across=1e-2, sigma_about=1e-2, rate=10.0),
    ]
    still = Scenario(
        motion=motion.ConstantRate(rate=(0, 0, 0)), gyro=GyroSpec(), sensors=sensors, rate=10.0, duration=1
    )
    live = LiveFilter(NOISE, start(), sensors=simulate(still).vectors)
    alone = LiveFilter(NOISE, start(), sensors=simulate(still).vectors)
    live.update(0.1, (0.0, 0.0, 0.1), north=None, up=[np.nan, 0.0, 1.0], tracker=np.full(4, np.nan))
    alone.update(0.1, (0.0, 0.0, 0.1))
    live.update(0.1, north=(0.0, 0.0, 1.0), up=np.full(3, np.nan))
    assert same(live.state(), alone.state())
    assert live.skipped == {"north": 2, "up": 2, "tracker": 1}
    live.update(0.1, (1.0, 1.0, 1.0))
    assert live.repeated == 1
    assert same(live.state(), alone.state())
    live.update(0.05, up=(0.0, 0.0, 1.0))
    assert live.late == 1
    assert same(live.state(), alone.state())
    live.update(0.1, north=(0.0, 0.0, 1.0), up=(0.0, 0.0, 1.0))
    assert live.skipped == {"north": 3, "up": 2, "tracker": 1}


def test_declared_sensors_are_those_of_a_scenario():
    up = VectorSensor(name="up", reference_f=[0.0, 0.0, 2.0], sigma=1e-2, rate=10.0)
    north = VectorSensor(name="north", reference_f=[0.0, 1.0, -2.0], sigma=1e-2, rate=10.0, kind="heading")
    scenario = Scenario(
        motion=motion.ConstantRate(rate=(0, 0, 0.3)), gyro=GyroSpec(), sensors=(up, north), rate=10.0, duration=1
    )
    record = simulate(scenario)
    live = given_in_order(record, live_of(record, start()))
    declared = given_in_order(record, LiveFilter(NOISE, start(), sensors=[up, north], time=record.time[0]))
    assert same(live.state(), declared.state())


def test_too_many_measurements_in_an_interval():
    up = VectorSensor(name="up", reference_f=[0.0, 0.0, 1.0], sigma=1e-2, rate=10.0)
    live = LiveFilter(NOISE, start(), sensors=[up], look_back=1.0)
    live.update(0.1, (0.0, 0.0, 0.1))
    for k in range(64):
        live.update(0.001 * (k + 1), up=(0.0, 0.1, 1.0))
    before = live.state()
    with pytest.raises(InputError, match="more than 64 measurements in one gyro interval"):
        live.update(0.09, up=(0.0, 0.1, 1.0))
    live.update(0.2, (0.0, 0.0, 0.0))
    assert before.covariance[0, 0] < live.covariance[0, 0]
    with pytest.raises(TypeError, match="start another one from its state"):
        pickle.dumps(live)
