"""The filter as a whole: two faces, independent references, closed forms, splits, gaps and bad input."""

from dataclasses import replace

import in_steps
import numpy as np
import pytest
from filterpy.common import Saver
from measured import resting, series_of

from strapdown import consistency, estimation, gyro, motion, quaternion, records
from strapdown.checks import InputError
from strapdown.estimation.states import PRIOR_INFLATION, ProcessNoise, initial_state
from strapdown.estimation.step_filter import StepFilter
from strapdown.records import ImuRecord, Truth
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
    in_steps.fed(f, record, lambda sensor: history.save())
    assert {np.shape(y)[0] for y in history.y} == {1, 2}
    assert all(np.shape(K) == (6, np.shape(y)[0]) for K, y in zip(history.K, history.y, strict=True))
    assert np.array_equal(history.x[-1], np.zeros(6))
    assert np.linalg.norm(history.x_post[0]) > 0.0


def noise_free(record, body_motion):
    """The same record with exact increments and vectors; the filter still models noise."""
    series = tuple(
        replace(s, vector_b=quaternion.rotate(quaternion.conjugate(body_motion.attitude(s.time)), s.reference_f))
        for s in record.vectors
    )
    return replace(record, increments=body_motion.increments(record.time), vectors=series)


def test_without_noise_there_is_no_error():
    body_motion = motion.ConstantRate(rate=(0.4, -0.3, 0.2), initial_attitude=(0.5, 0.5, -0.5, 0.5))
    record = noise_free(simulate(scenario(body_motion, duration=20.0), 1), body_motion)
    truth = Truth(attitude=body_motion.attitude(record.time), bias=np.zeros((len(record.time), 3)))
    result = estimation.run(record, NOISE, initial_state(truth.attitude[0], attitude_sigma=1e-2, bias_sigma=1e-3))
    error = consistency.errors(result.attitude, result.bias, truth.attitude, truth.bias)
    assert np.abs(error[:, :3]).max() < 1e-14
    # The vectors are rounded, and a rounding over the tenth of a second between two of them is a rate.
    assert np.abs(error[:, 3:]).max() < np.finfo(float).eps / 0.1


def test_steady_state_is_farrenkopfs_closed_form():
    """One axis at rest (Farrenkopf 1978; the covariance is that of two states however many axes there are)."""
    dt, sigma, steps = 1.0, 1e-4, 20_000
    noise = ProcessNoise(angle_random_walk=3e-5, rate_random_walk=1e-6)
    time = dt * np.arange(steps + 1)
    series = tuple(
        series_of(name, "direction", time[1:], np.tile(r, (steps, 1)), r, sigma)
        for name, r in (("x", [1.0, 0.0, 0.0]),)
    )
    record = ImuRecord(time=time, increments=np.zeros((steps, 3)), vectors=series)
    initial = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-3, bias_sigma=1e-4)
    after = estimation.run(record, noise, initial, every=steps, full_covariance=True).covariance[-1]
    s_u, s_v = 1e-6 * dt**1.5 / sigma, 3e-5 * np.sqrt(dt) / sigma
    gamma = np.sqrt(1.0 + s_v**2 / 4.0 + s_u**2 / 48.0)
    zeta = gamma + s_u / 4.0 + 0.5 * np.sqrt(2.0 * gamma * s_u + s_v**2 + s_u**2 / 3.0)
    bias = 1e-6 * sigma / np.sqrt(dt) * (zeta - 1.0 / zeta) - 0.5 * 1e-12 * dt
    for axis in (1, 2):  # the axes that the fixed x direction shows
        assert after[axis, axis] == pytest.approx(sigma**2 * (1.0 - zeta**-2), rel=1e-9)
        assert after[3 + axis, 3 + axis] == pytest.approx(bias, rel=1e-9)


def test_a_start_from_a_measured_attitude_goes_back_to_the_first_edge():
    """Its noise, in body axes of its own time, turns back with it, and grows by the gyro's and by the bias's over the time between."""
    turn, bias, axes = np.array([0.8, -0.5, 1.1]), np.array([0.01, -0.02, 0.03]), np.array([1e-3, 2e-3, 5e-3])
    q = quaternion.exp([0.3, 0.2, -0.4])
    tracker = VectorMeasurements(
        sensor="t",
        kind="attitude",
        time=[*np.linspace(1.0, 1.5, 11), 2.0],
        attitude=[*np.full((11, 4), np.nan), quaternion.multiply(q, quaternion.exp(turn))],  # the first are missing
        sigma_axes=axes,
    )
    increments = np.outer([1.0, 2.0], 0.5 * turn + bias)
    record = ImuRecord(time=[0.0, 1.0, 3.0], increments=increments, vectors=(tracker,))
    noise = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=0.0)
    state = estimation.first_state(record, noise, bias_sigma=2e-3, bias=bias)
    R = quaternion.to_matrix(quaternion.exp(turn))
    expected = R @ np.diag(axes**2) @ R.T + (1e-6 * 2.0 + (2e-3 * 2.0) ** 2) * np.eye(3)
    assert quaternion.angle_between(state.attitude, q) < 1e-12
    np.testing.assert_allclose(state.covariance[:3, :3] / PRIOR_INFLATION**2, expected, rtol=1e-10, atol=1e-18)


def test_a_start_from_whole_vectors_is_that_from_their_directions():
    q, references = quaternion.exp([0.3, 0.2, -0.4]), np.array([[1.0, 0.0, 0.0], [0.0, 0.6, -0.8]])
    noise = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=0.0)
    states = []
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
        states.append(estimation.first_state(record, noise, bias_sigma=1e-3))
    assert quaternion.angle_between(*(state.attitude for state in states)) < 1e-12
    np.testing.assert_allclose(states[0].covariance, states[1].covariance, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize(
    "times", [(0.2, 1.2), (1.2, 0.2), (1.0, 1.0)], ids=["vertical first", "heading first", "together"]
)
def test_sigma_of_a_start_from_vertical_and_heading_has_the_tilt_s_part_and_the_gyro_s_error_between(times):
    """A dip of 1.17 rad: a tilt, of the measurement or by the gyro's error between the two, changes the heading by 2.4 times as much."""
    dip, white, sigmas, runs, dt = 1.17, 0.01, (0.02, 0.002) if times[0] == times[1] else (0.003, 0.005), 80, 0.1
    field = np.array([0.0, np.cos(dip), -np.sin(dip)])
    noise = ProcessNoise(angle_random_walk=white, rate_random_walk=0.0)
    random, nees, about_vertical = np.random.default_rng(21), [], []
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
        P, vertical = state.covariance[:3, :3] / PRIOR_INFLATION**2, quaternion.to_matrix(state.attitude)[2]
        nees.append(error @ np.linalg.solve(P, error) / 3.0)
        about_vertical.append((error @ vertical) ** 2 / (vertical @ P @ vertical))
    assert abs(np.mean(nees) - 1.0) < 4.0 * np.sqrt(2.0 / (3.0 * runs))
    assert abs(np.mean(about_vertical) - 1.0) < 4.0 * np.sqrt(2.0 / runs)


def test_a_start_from_a_vertical_vector_and_its_heading_is_refused():
    level = series_of("north", "heading", [0.0], [[0.0, 0.0, 1.0]], [0.0, 1.0, -2.0], 0.01)
    up = replace(level, sensor="up", kind="direction", reference_f=np.array([0.0, 0.0, 1.0]))
    with pytest.raises(InputError, match="do not give the attitude"):
        estimation.first_state(resting(up, level), NOISE, bias_sigma=1e-3)


def test_missing_and_outside_measurements_are_counted():
    record = simulate(scenario(sensors=SENSORS[:1]), 1)
    series = record.vectors[0]
    value = series.vector_b.copy()
    value[3:7] = np.nan
    holed = replace(record, vectors=(replace(series, vector_b=value),))
    result = estimation.run(holed, NOISE, off(record))
    assert result.skipped == {"a": 4}
    assert len(result.innovations["a"].time) == len(series.time) - 4
    late = replace(record, vectors=(replace(series, time=series.time + 1000.0),))
    counted = f"a: 0 measurements, {len(series.time)} more missing or outside the record, none used"
    assert counted in str(estimation.run(late, NOISE, off(record)))
    short = replace(records.cut(record, 0, 100), vectors=record.vectors)
    assert estimation.run(short, NOISE, off(record)).skipped["a"] == int(np.sum(series.time > 1.0))
