"""The filter as a whole: two faces, independent references, closed forms, splits, gaps and bad input."""

import pickle
from dataclasses import replace

import in_steps
import numpy as np
import pytest
from filterpy.common import Saver
from measured import record_of, resting, series_of

from strapdown import estimation, gyro, motion, quaternion, records
from strapdown.estimation.schedule import schedule
from strapdown.estimation.states import PRIOR_INFLATION, ProcessNoise, initial_state
from strapdown.estimation.step_filter import StepFilter
from strapdown.kernels import measurement
from strapdown.records import ImuRecord
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import VectorMeasurements, VectorSensor

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
SENSORS = (
    VectorSensor(name="a", reference_f=np.array([1.0, 0.0, 0.0]), sigma=1e-3, rate=13.0),
    VectorSensor(name="b", reference_f=np.array([0.0, 1.0, 1.0]), sigma=2e-3, rate=5.0, phase=0.013),
    VectorSensor(name="north", reference_f=np.array([0.0, 1.0, -1.0]), sigma=5e-3, rate=4.0, kind="heading"),
)


def scenario(body_motion=None, sensors=SENSORS, duration=8.0):
    return Scenario(
        motion=body_motion or motion.Coning(angle=0.02, frequency=1.0),
        gyro=gyro.GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias=np.array([1e-3, -2e-3, 5e-4])),
        sensors=sensors,
        rate=100.0,
        duration=duration,
    )


def off(record, error=(1e-2, -2e-2, 1e-2)):
    attitude = quaternion.multiply(record.truth.attitude[0], quaternion.exp(error))
    return initial_state(attitude, attitude_sigma=2e-2, bias_sigma=3e-3)


def test_the_step_face_keeps_what_filterpys_users_expect():
    record = simulate(scenario(duration=2.0), 1)
    f = StepFilter(NOISE, off(record))
    history = Saver(f)
    in_steps.fed(f, record, lambda used: history.save())
    assert {np.shape(y)[0] for y in history.y} == {1, 2}
    assert all(np.shape(K) == (6, np.shape(y)[0]) for K, y in zip(history.K, history.y, strict=True))
    assert np.array_equal(history.x[-1], np.zeros(6))
    assert np.linalg.norm(history.x_post[0]) > 0.0
    copy = pickle.loads(pickle.dumps(f))
    for one in (f, copy):
        one.update(record.vectors[0], 0)
    assert np.array_equal(copy.P, f.P)
    assert np.array_equal(copy.attitude, f.attitude)


@pytest.mark.parametrize("at", [1, 133, 199])
def test_a_split_run_is_the_whole_run_to_the_bit(at):
    record = record_of()
    begin = initial_state(quaternion.exp([1e-2, -2e-2, 1e-2]), attitude_sigma=2e-2, bias_sigma=3e-3)
    whole, end = estimation.run_part(record, NOISE, begin, full_covariance=True)
    first, middle = estimation.run_part(records.cut(record, 0, at), NOISE, begin, full_covariance=True)
    second, last = estimation.run_part(
        records.cut(record, at, len(record.increments)), NOISE, middle, full_covariance=True
    )
    for name in ("attitude", "bias", "variance", "covariance"):
        joined = np.concatenate([getattr(first, name)[:-1], getattr(second, name)])
        assert np.array_equal(joined, getattr(whole, name)), name
    assert np.array_equal(last.covariance, end.covariance)


def test_scaled_noise_reaches_every_kind():
    record = record_of(duration=2.0)
    modelled = replace(record, vectors=tuple(series.noise_scaled(3.0) for series in record.vectors))
    plain, scaled = schedule(record.vectors, 0.0, 2.0), schedule(modelled.vectors, 0.0, 2.0)
    attitude = plain.kind == measurement.ATTITUDE
    assert np.allclose(scaled.variance, 9.0 * plain.variance, rtol=1e-14)
    assert np.allclose(scaled.vector_b[attitude], 9.0 * plain.vector_b[attitude], rtol=1e-14)
    assert np.array_equal(scaled.vector_b[~attitude], plain.vector_b[~attitude])


def test_many_series_are_one_series_of_as_many_references():
    """300 stars, each a series of its own, and the same as one series: a byte would not number them."""
    stars = np.random.default_rng(4).standard_normal((300, 3))
    stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    time = 0.01 * np.arange(301)
    body = motion.ConstantRate(rate=(0.3, -0.5, 0.4))
    seen = quaternion.rotate(quaternion.conjugate(body.attitude(time[1:])), stars)
    each = tuple(
        series_of(f"star {k}", "direction", [time[k + 1]], [seen[k]], star, 1e-3) for k, star in enumerate(stars)
    )
    whole = series_of("stars", "direction", time[1:], seen, stars, 1e-3)
    noise = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=0.1, bias_sigma=0.1)
    ran = [
        estimation.run(ImuRecord(time=time, increments=body.increments(time), vectors=some), noise, start)
        for some in (each, (whole,))
    ]
    np.testing.assert_array_equal(ran[0].attitude, ran[1].attitude)
    np.testing.assert_array_equal(ran[0].variance, ran[1].variance)


def test_a_start_from_a_measured_attitude_goes_back_to_the_first_edge():
    """Its noise, in body axes of its own time, turns back with it, and grows by the gyro's and by the bias's over the time between."""
    turn, bias, axes = np.array([0.8, -0.5, 1.1]), np.array([0.01, -0.02, 0.03]), np.array([1e-3, 2e-3, 5e-3])
    q = quaternion.exp([0.3, 0.2, -0.4])
    seen = VectorMeasurements(
        sensor="t",
        kind="attitude",
        time=[*np.linspace(1.0, 1.5, 11), 2.0],
        attitude=[*np.full((11, 4), np.nan), quaternion.multiply(q, quaternion.exp(turn))],  # the first are missing
        sigma_axes=axes,
    )
    increments = np.outer([1.0, 2.0], 0.5 * turn + bias)
    record = ImuRecord(time=[0.0, 1.0, 3.0], increments=increments, vectors=(seen,))
    noise = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=0.0)
    state = estimation.first_state(record, noise, bias_sigma=2e-3, bias=bias)
    R = quaternion.to_matrix(quaternion.exp(turn))
    expected = R @ np.diag(axes**2) @ R.T + (1e-6 * 2.0 + (2e-3 * 2.0) ** 2) * np.eye(3)
    assert quaternion.angle_between(state.attitude, q) < 1e-12
    np.testing.assert_allclose(state.covariance[:3, :3] / PRIOR_INFLATION**2, expected, rtol=1e-10, atol=1e-18)


def test_a_start_from_whole_vectors_is_that_from_their_directions():
    q, references = quaternion.exp([0.3, 0.2, -0.4]), np.array([[1.0, 0.0, 0.0], [0.0, 0.6, -0.8]])
    noise = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=0.0)
    found = []
    for kind, length in (("direction", 1.0), ("vector", 20.0)):
        series = tuple(
            series_of(
                f"{k}",
                kind,
                [0.0],
                [length * quaternion.rotate(quaternion.conjugate(q), r)],
                length * r,
                (k + 1) * 1e-3 * length,
            )
            for k, r in enumerate(references)
        )
        record = resting(*series)
        found.append(estimation.first_state(record, noise, bias_sigma=1e-3))
    assert quaternion.angle_between(*(state.attitude for state in found)) < 1e-12
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize(
    "times", [(0.2, 1.2), (1.2, 0.2), (1.0, 1.0)], ids=["vertical first", "heading first", "together"]
)
def test_sigma_of_a_start_from_vertical_and_heading_has_the_gyro_s_error_between_them(times):
    """A dip of 1.17 rad: a tilt by the gyro's error between the two changes the heading by 2.4 times as much. ANEES of 250 starts."""
    dip, white, sigmas, runs, dt = 1.17, 0.01, (0.003, 0.005), 250, 0.1
    field = np.array([0.0, np.cos(dip), -np.sin(dip)])
    noise = ProcessNoise(angle_random_walk=white, rate_random_walk=0.0)
    random, nees = np.random.default_rng(21), []
    for _ in range(runs):
        q = quaternion.normalize(random.standard_normal(4))
        up = quaternion.rotate(quaternion.conjugate(q), [0.0, 0.0, 1.0]) + sigmas[0] * random.standard_normal(3)
        level = quaternion.exp([0.0, 0.0, sigmas[1] * random.standard_normal()])
        north = quaternion.rotate(quaternion.conjugate(q), quaternion.rotate(level, field))
        series = (
            series_of("force", "direction", [times[0]], [up / np.linalg.norm(up)], [0.0, 0.0, 1.0], sigmas[0]),
            series_of("field", "heading", [times[1]], [north], [0.0, 1.0, 0.0], sigmas[1]),
        )
        turns = white * np.sqrt(dt) * random.standard_normal((14, 3))
        record = ImuRecord(time=dt * np.arange(15), increments=turns, vectors=series)
        state = estimation.first_state(record, noise, bias_sigma=1e-9)
        error = quaternion.log(quaternion.multiply(quaternion.conjugate(state.attitude), q))
        nees.append(error @ np.linalg.solve(state.covariance[:3, :3] / PRIOR_INFLATION**2, error) / 3.0)
    assert abs(np.mean(nees) - 1.0) < 4.0 * np.sqrt(2.0 / (3.0 * runs))


def test_missing_and_outside_measurements_are_counted():
    record = simulate(scenario(sensors=SENSORS[:1]), 1)
    series = record.vectors[0]
    value = series.vector_b.copy()
    value[3:7] = np.nan
    holed = replace(record, vectors=(replace(series, vector_b=value),))
    result = estimation.run(holed, NOISE, off(record))
    assert result.skipped == {"a": 4}
    assert len(result.innovations["a"].time) == len(series.time) - 4
    short = replace(records.cut(record, 0, 100), vectors=record.vectors)
    assert estimation.run(short, NOISE, off(record)).skipped["a"] == int(np.sum(series.time > 1.0))
