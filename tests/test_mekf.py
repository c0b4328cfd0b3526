"""The filter as a whole: two faces, independent references, closed forms, splits, gaps and bad input."""

from dataclasses import replace

import in_steps
import numpy as np
import pytest
from filterpy.common import Saver

from strapdown import coning, consistency, estimation, gyro, motion, quaternion, records, vectors
from strapdown.checks import InputError
from strapdown.estimation.schedule import schedule
from strapdown.estimation.states import ONCE, ProcessNoise, initial_state
from strapdown.estimation.step_filter import StepFilter
from strapdown.kernels import measurement
from strapdown.randomness import generator
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


def with_vector_series(record):
    """Add a whole-vector series (three degrees of freedom) of unit 9.8 at times of its own."""
    time = np.linspace(0.05, record.time[-1] - 0.03, 61)
    index = np.searchsorted(record.time, time)
    up = np.array([0.0, 0.0, 9.8])
    noise = 0.05 * generator(3, 0, "force").standard_normal((len(time), 3))
    value = quaternion.rotate(quaternion.conjugate(record.truth.attitude[index]), up) + noise
    series = VectorMeasurements(
        sensor="force", kind="vector", time=time, vector_b=value, reference_f=up, sigma=np.full(len(time), 0.05)
    )
    return replace(record, vectors=(*record.vectors, series))


def with_attitude_series(record):
    """Add whole attitudes (three degrees of freedom), their noise different about each body axis."""
    time = np.linspace(0.033, record.time[-1] - 0.01, 37)
    index = np.searchsorted(record.time, time)
    sigma = np.array([1e-3, 2e-3, 5e-3])
    error = sigma * generator(4, 0, "tracker").standard_normal((len(time), 3))
    measured = quaternion.multiply(record.truth.attitude[index], quaternion.exp(error))
    series = VectorMeasurements(sensor="tracker", kind="attitude", time=time, attitude=measured, sigma_axes=sigma)
    return replace(record, vectors=(*record.vectors, series))


def with_moving_reference(record):
    """Add directions to something that moves in the fixed frame, each with its own reference."""
    time = np.linspace(0.02, record.time[-1] - 0.02, 53)
    index = np.searchsorted(record.time, time)
    reference = np.stack([np.cos(time), np.sin(time), 0.2 * np.ones_like(time)], axis=-1)
    reference /= np.linalg.norm(reference, axis=1, keepdims=True)
    seen = quaternion.rotate(quaternion.conjugate(record.truth.attitude[index]), reference)
    series = VectorMeasurements(
        sensor="planet",
        kind="direction",
        time=time,
        vector_b=seen,
        reference_f=reference,
        sigma=np.full(len(time), 1e-3),
    )
    return replace(record, vectors=(*record.vectors, series))


def stepped(record, initial, saver=None):
    """Run the step-by-step face over a record, splitting intervals at the measurements."""
    f = StepFilter(NOISE, initial)
    history = Saver(f) if saver else None
    return in_steps.fed(f, record, lambda used: None if history is None else history.save()), history


@pytest.mark.parametrize("fast", [False, True], ids=["slow turn", "12 rad/s"])
def test_both_faces_are_one_filter(fast):
    body_motion = motion.ConstantRate(rate=(80.0, -60.0, 70.0)) if fast else None  # 1.2 rad a sample: sub-steps
    record = with_vector_series(simulate(scenario(body_motion, duration=2.0), 1))
    record = with_moving_reference(with_attitude_series(record))
    initial = off(record)
    whole = estimation.run(record, NOISE, initial, full_covariance=True)
    (attitude, bias, P), _ = stepped(record, initial)
    d = np.sqrt(np.einsum("kii->ki", P))
    assert np.max(quaternion.angle_between(attitude, whole.attitude[1:])) < 1e-10
    assert np.abs(bias - whole.bias[1:]).max() < 1e-10
    assert np.abs((P - whole.covariance[1:]) / (d[:, :, None] * d[:, None, :])).max() < 1e-10


def test_the_step_face_keeps_what_filterpys_users_expect():
    record = simulate(scenario(duration=2.0), 1)
    _, history = stepped(record, off(record), saver=True)
    assert {np.shape(y)[0] for y in history.y} == {1, 2}
    assert all(np.shape(K) == (6, np.shape(y)[0]) for K, y in zip(history.K, history.y, strict=True))
    assert np.array_equal(history.x[-1], np.zeros(6))
    assert np.linalg.norm(history.x_post[0]) > 0.0


def test_innovations_agree_with_the_step_face():
    record = simulate(scenario(sensors=SENSORS[:1], duration=3.0), 1)
    whole = estimation.run(record, NOISE, off(record))
    _, history = stepped(record, off(record), saver=True)
    nis = [float(y @ np.linalg.solve(S, y)) for y, S in zip(history.y, history.S, strict=True)]
    assert np.allclose(whole.innovations["a"].nis, nis, rtol=1e-8)


@pytest.mark.parametrize("at", [1, 333, 799])
def test_a_split_run_is_the_whole_run_to_the_bit(at):
    record = with_moving_reference(with_attitude_series(with_vector_series(simulate(scenario(), 1))))
    whole, end = estimation.run_part(record, NOISE, off(record), full_covariance=True)
    first, middle = estimation.run_part(records.cut(record, 0, at), NOISE, off(record), full_covariance=True)
    second, last = estimation.run_part(
        records.cut(record, at, len(record.increments)), NOISE, middle, full_covariance=True
    )
    for name in ("attitude", "bias", "variance", "covariance"):
        joined = np.concatenate([getattr(first, name)[:-1], getattr(second, name)])
        assert np.array_equal(joined, getattr(whole, name)), name
    assert np.array_equal(last.covariance, end.covariance)


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
        VectorMeasurements(
            sensor=name, kind="direction", time=time[1:], vector_b=np.tile(r, (steps, 1)), reference_f=r, sigma=sigma
        )
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


def _skew(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def test_two_orthogonal_equal_directions_and_a_diffuse_prior():
    """P = σ² diag(1, 1, ½): the axis across both directions is seen twice."""
    sigma = 1e-3
    series = tuple(
        VectorMeasurements(sensor=n, kind="direction", time=[0.0], vector_b=[r], reference_f=r, sigma=sigma)
        for n, r in (("x", [1.0, 0.0, 0.0]), ("y", [0.0, 1.0, 0.0]))
    )
    record = ImuRecord(time=[0.0, 1.0], increments=np.zeros((1, 3)), vectors=series)
    initial = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e3, bias_sigma=1.0)
    after = estimation.run(record, NOISE, initial, full_covariance=True).covariance[0, :3, :3]
    assert np.allclose(after, sigma**2 * np.diag([1.0, 1.0, 0.5]), rtol=1e-9, atol=1e-9 * sigma**2)


def test_an_attitude_and_a_diffuse_prior_is_the_attitude():
    """The measured attitude, with its covariance carried to the estimate's tangent space; its NIS has three degrees of freedom."""
    sigma = np.array([1e-3, 2e-3, 3e-3])
    measured = quaternion.exp([0.3, -0.2, 0.5])
    series = VectorMeasurements(sensor="t", kind="attitude", time=[0.0], attitude=[measured], sigma_axes=sigma)
    record = ImuRecord(time=[0.0, 1.0], increments=np.zeros((1, 3)), vectors=(series,))
    start = quaternion.multiply(measured, quaternion.exp([1e-3, 1e-3, -1e-3]))
    initial = initial_state(start, attitude_sigma=1e2, bias_sigma=1.0)
    result = estimation.run(record, NOISE, initial, full_covariance=True)
    assert quaternion.angle_between(result.attitude[0], measured) < 1e-10
    assert np.allclose(result.covariance[0, :3, :3], np.diag(sigma**2), rtol=2e-3, atol=1e-8)
    assert result.innovations["t"].whitened.shape == (1, 3)


def test_scaled_noise_reaches_every_kind():
    record = with_attitude_series(with_vector_series(simulate(scenario(duration=2.0), 1)))
    modelled = replace(record, vectors=tuple(series.noise_scaled(3.0) for series in record.vectors))
    plain, scaled = schedule(record.vectors, 0.0, 2.0), schedule(modelled.vectors, 0.0, 2.0)
    attitude = plain.kind == measurement.ATTITUDE
    assert np.allclose(scaled.variance, 9.0 * plain.variance, rtol=1e-14)
    assert np.allclose(scaled.vector_b[attitude], 9.0 * plain.vector_b[attitude], rtol=1e-14)
    assert np.array_equal(scaled.vector_b[~attitude], plain.vector_b[~attitude])


def test_the_heading_of_an_inclined_vector_shifts_with_tilt():
    """Its row is the derivative of the heading by a small turn about each body axis."""
    from strapdown.kernels.measurement import heading_error, heading_row

    q = quaternion.exp([0.4, -0.3, 0.8])
    reference = np.array([0.3, 0.9, -1.2])
    z = quaternion.rotate(quaternion.conjugate(q), reference)
    R = tuple(quaternion.to_matrix(q).ravel())
    h = heading_row(R, tuple(z))
    for axis in np.eye(3) * 1e-6:
        seen = quaternion.rotate(quaternion.conjugate(quaternion.multiply(q, quaternion.exp(axis))), reference)
        assert heading_error(R, tuple(seen), tuple(reference)) == pytest.approx(np.dot(h, axis), abs=1e-11)


def test_one_interval_or_many_at_constant_rate_are_the_same():
    """The model is exact at constant rate: a turn of 3 rad in one interval (sub-steps) equals a thousand small ones."""
    turn = np.array([1.0, -2.0, 2.0])
    initial = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-3, bias_sigma=1e-4)
    one = estimation.run(ImuRecord(time=[0.0, 1.0], increments=[turn]), NOISE, initial, full_covariance=True)
    many = ImuRecord(time=np.linspace(0.0, 1.0, 1001), increments=np.tile(turn / 1000.0, (1000, 1)))
    fine = estimation.run(many, NOISE, initial, every=1000, full_covariance=True)
    assert quaternion.angle_between(one.attitude[-1], fine.attitude[-1]) < 1e-13
    assert quaternion.angle_between(one.attitude[-1], quaternion.exp(turn)) < 1e-14
    d = np.sqrt(np.diag(one.covariance[-1]))
    assert np.abs((one.covariance[-1] - fine.covariance[-1]) / np.outer(d, d)).max() < 1e-11


def test_many_series_are_one_series_of_as_many_references():
    """300 stars, each a series of its own, and the same as one series: a byte would not number them."""
    stars = np.random.default_rng(4).standard_normal((300, 3))
    stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    time = 0.01 * np.arange(301)
    body = motion.ConstantRate(rate=(0.3, -0.5, 0.4))
    seen = quaternion.rotate(quaternion.conjugate(body.attitude(time[1:])), stars)
    each = tuple(
        VectorMeasurements(
            sensor=f"star {k}", kind="direction", time=[time[k + 1]], vector_b=[seen[k]], reference_f=star, sigma=1e-3
        )
        for k, star in enumerate(stars)
    )
    whole = VectorMeasurements(
        sensor="stars", kind="direction", time=time[1:], vector_b=seen, reference_f=stars, sigma=1e-3
    )
    noise = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=0.1, bias_sigma=0.1)
    ran = [
        estimation.run(ImuRecord(time=time, increments=body.increments(time), vectors=some), noise, start)
        for some in (each, (whole,))
    ]
    np.testing.assert_array_equal(ran[0].attitude, ran[1].attitude)
    np.testing.assert_array_equal(ran[0].variance, ran[1].variance)


@pytest.mark.parametrize("dip", [0.1, 1.17])
def test_a_start_from_vertical_and_heading_knows_what_the_tilt_does_to_the_heading(dip):
    """By tan(dip) times as much, of a coarse accelerometer beside a sharp magnetometer: eᵀP⁻¹e about each axis and all three."""
    reference = np.array([0.0, np.cos(dip), -np.sin(dip)])
    tilt_sigma, heading_sigma = 0.02, 0.002
    whole, about_vertical = [], []
    for seed in range(400):
        draw = np.random.default_rng(seed)
        q = quaternion.normalize(draw.standard_normal(4))
        up = quaternion.rotate(quaternion.conjugate(q), [0.0, 0.0, 1.0]) + tilt_sigma * draw.standard_normal(3)
        turned = quaternion.rotate(quaternion.exp([0.0, 0.0, heading_sigma * draw.standard_normal()]), reference)
        series = [
            VectorMeasurements(sensor=name, kind=kind, time=[0.0], vector_b=[z], reference_f=r, sigma=sigma)
            for name, kind, z, r, sigma in (
                ("up", "direction", up / np.linalg.norm(up), [0.0, 0.0, 1.0], tilt_sigma),
                ("north", "heading", quaternion.rotate(quaternion.conjugate(q), turned), reference, heading_sigma),
            )
        ]
        record = ImuRecord(time=[0.0, 1.0], increments=np.zeros((1, 3)), vectors=tuple(series))
        state = estimation.first_state(
            record, ProcessNoise(angle_random_walk=1e-6, rate_random_walk=0.0), bias_sigma=1e-3
        )
        P = state.covariance[:3, :3] / ONCE**2
        e = quaternion.log(quaternion.multiply(quaternion.conjugate(state.attitude), q))
        vertical = quaternion.to_matrix(state.attitude)[2]
        whole.append(e @ np.linalg.solve(P, e) / 3.0)
        about_vertical.append((e @ vertical) ** 2 / (vertical @ P @ vertical))
    assert 0.85 < np.mean(whole) < 1.15  # 99 % of 1200 degrees of freedom: 0.90 to 1.11
    assert 0.8 < np.mean(about_vertical) < 1.2  # of 400: 0.83 to 1.19
    level = VectorMeasurements(
        sensor="north", kind="heading", time=[0.0], vector_b=[[0.0, 0.0, 1.0]], reference_f=reference, sigma=0.01
    )
    up = replace(level, sensor="up", kind="direction", reference_f=np.array([0.0, 0.0, 1.0]))
    blind = ImuRecord(time=[0.0, 1.0], increments=np.zeros((1, 3)), vectors=(up, level))
    with pytest.raises(InputError, match="do not give the attitude"):
        estimation.first_state(blind, ProcessNoise(angle_random_walk=1e-6, rate_random_walk=0.0), bias_sigma=1e-3)


def test_a_start_from_a_measured_attitude_goes_back_to_the_first_edge():
    """Its noise, in body axes of its own time, turns back with it, and grows by the gyro's and by the bias's over the time between."""
    turn, bias, axes = np.array([0.8, -0.5, 1.1]), np.array([0.01, -0.02, 0.03]), np.array([1e-3, 2e-3, 5e-3])
    q = quaternion.exp([0.3, 0.2, -0.4])
    seen = VectorMeasurements(
        sensor="t",
        kind="attitude",
        time=[2.0],
        attitude=[quaternion.multiply(q, quaternion.exp(turn))],
        sigma_axes=axes,
    )
    increments = np.outer([1.0, 2.0], 0.5 * turn + bias)
    record = ImuRecord(time=[0.0, 1.0, 3.0], increments=increments, vectors=(seen,))
    noise = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=0.0)
    state = estimation.first_state(record, noise, bias_sigma=2e-3, bias=bias)
    R = quaternion.to_matrix(quaternion.exp(turn))
    expected = R @ np.diag(axes**2) @ R.T + (1e-6 * 2.0 + (2e-3 * 2.0) ** 2) * np.eye(3)
    assert quaternion.angle_between(state.attitude, q) < 1e-12
    np.testing.assert_allclose(state.covariance[:3, :3] / ONCE**2, expected, rtol=1e-10, atol=1e-18)


def test_a_start_from_whole_vectors_is_that_from_their_directions():
    q, references = quaternion.exp([0.3, 0.2, -0.4]), np.array([[1.0, 0.0, 0.0], [0.0, 0.6, -0.8]])
    noise = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=0.0)
    found = []
    for kind, length in (("direction", 1.0), ("vector", 20.0)):
        series = tuple(
            VectorMeasurements(
                sensor=f"{k}",
                kind=kind,
                time=[0.0],
                vector_b=[length * quaternion.rotate(quaternion.conjugate(q), r)],
                reference_f=length * r,
                sigma=(k + 1) * 1e-3 * length,
            )
            for k, r in enumerate(references)
        )
        record = ImuRecord(time=[0.0, 1.0], increments=np.zeros((1, 3)), vectors=series)
        found.append(estimation.first_state(record, noise, bias_sigma=1e-3))
    assert quaternion.angle_between(*(state.attitude for state in found)) < 1e-12
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-9, atol=1e-18)


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


def test_compressed_steps_feed_the_filter():
    record = simulate(scenario(motion.Coning(angle=0.01, frequency=5.0), sensors=SENSORS[:2], duration=8.0), 1)
    short = records.compress(record, coning.ALGORITHMS["two-sample"])
    assert len(short.increments) == 400
    result = estimation.run(short, NOISE, off(record))
    assert np.array_equal(result.time, record.time[::2])


BAD = {
    "zero angle random walk": (lambda: ProcessNoise(angle_random_walk=0.0, rate_random_walk=0.0), "angle_random_walk"),
    "negative rate random walk": (
        lambda: ProcessNoise(angle_random_walk=1.0, rate_random_walk=-1e-9),
        "rate_random_walk",
    ),
    "not unit": (lambda: initial_state((1.0, 0.1, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=1.0), "norm"),
    "zero sigma": (
        lambda: initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=[1.0, 0.0, 1.0]),
        r"bias_sigma\[1\]",
    ),
    "not positive definite": (
        lambda: estimation.State(
            attitude=np.array([1.0, 0, 0, 0]), bias=np.zeros(3), covariance=np.eye(6) - 0.3 * np.ones((6, 6))
        ),
        "positive definite",
    ),
    "not symmetric": (
        lambda: estimation.State(
            attitude=np.array([1.0, 0, 0, 0]), bias=np.zeros(3), covariance=np.eye(6) + np.diag([0.1] * 5, 1)
        ),
        "not symmetric",
    ),
    "unsorted": (lambda: ImuRecord(time=[0.0, 2.0, 1.0], increments=np.zeros((2, 3))), r"time\[2\]"),
    "repeated": (lambda: ImuRecord(time=[0.0, 1.0, 1.0], increments=np.zeros((2, 3))), "repeats"),
    "wrong shape": (lambda: ImuRecord(time=[0.0, 1.0, 2.0], increments=np.zeros((3, 3))), r"\(3, 3\)"),
    "NaN": (lambda: ImuRecord(time=[0.0, 1.0], increments=[[0.0, np.nan, 0.0]]), r"increments\[0, 1\] is nan"),
    "not a unit vector": (
        lambda: VectorMeasurements(
            sensor="s", kind="direction", time=[0.0], vector_b=[[2.0, 0, 0]], reference_f=[1.0, 0, 0], sigma=1.0
        ),
        "length 2",
    ),
    "unknown kind": (
        lambda: VectorMeasurements(
            sensor="s", kind="directoin", time=[0.0], vector_b=[[1.0, 0, 0]], reference_f=[1.0, 0, 0], sigma=1.0
        ),
        "did you mean 'direction'",
    ),
    "zero reference": (
        lambda: VectorMeasurements(
            sensor="s", kind="direction", time=[0.0], vector_b=[[1.0, 0, 0]], reference_f=[0.0, 0, 0], sigma=1.0
        ),
        "zero vector",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, words = BAD[case]
    with pytest.raises(InputError, match=words):
        make()


def test_zero_measurement_noise_is_refused_by_the_filter():
    series = VectorMeasurements(
        sensor="star", kind="direction", time=[0.5], vector_b=[[1.0, 0, 0]], reference_f=[1.0, 0, 0], sigma=0.0
    )
    record = ImuRecord(time=[0.0, 1.0], increments=np.zeros((1, 3)), vectors=(series,))
    with pytest.raises(InputError, match=r"star: sigma\[0\] is 0"):
        estimation.run(record, NOISE, initial_state((1.0, 0, 0, 0), attitude_sigma=1.0, bias_sigma=1.0))


def test_triad_is_right_handed():
    for r in np.random.default_rng(0).normal(size=(50, 3)):
        frame = vectors.triad(r)
        assert np.allclose(frame @ frame.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(frame) == pytest.approx(1.0)
        assert np.allclose(frame[2], r / np.linalg.norm(r))


def test_noise_and_starts_that_are_none_are_refused():
    with pytest.raises(InputError, match=r"angle_random_walk is 1e\+200 rad/√s, more than any gyro has"):
        ProcessNoise(angle_random_walk=1e200, rate_random_walk=0.0)
    with pytest.raises(InputError, match="rate_random_walk is"):
        ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e10)
    for ragged in ({"attitude": [1.0, 0.0, [0.0], 0.0]}, {"attitude": quaternion.IDENTITY, "bias": [0.0, [0.0], 0.0]}):
        with pytest.raises(InputError, match="is not an array of numbers"):
            initial_state(**ragged, attitude_sigma=0.1, bias_sigma=0.1)
