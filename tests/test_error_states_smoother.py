"""The smoother with error states: one least-squares problem for each kind of block, and recoveries."""

import dataclasses
import math

import numpy as np
import pytest
import scipy.linalg
from measured import SWAY as BODY
from measured import (
    UP,
    beside_silent,
    every_kind,
    in_body,
    recoveries,
    resting,
    series_of,
    state_errors,
    turn_to,
    unit,
)

from strapdown import estimation, kinematics, quaternion, records
from strapdown.estimation import error_states
from strapdown.estimation.angular_acceleration import turning
from strapdown.estimation.gating import Gate
from strapdown.estimation.states import ProcessNoise
from strapdown.records import ImuRecord

FIELD = np.array([0.0, 0.6, -0.8])


# --------------------------------------------------------------------------------------------- one least-squares problem over the record


@dataclasses.dataclass(frozen=True, kw_only=True)
class Small:
    """A short record of a body that turns, and the state at its start."""

    record: ImuRecord
    noise: ProcessNoise
    initial: estimation.State
    blocks: tuple
    attitude: np.ndarray | None = None
    """What it is, at the edges (n + 1, 4)."""
    values: np.ndarray | None = None
    """What the states are (n + 1, m)."""


def stacked(blocks, name, shape):
    return np.concatenate([np.empty((0, *shape)), *(getattr(block, name) for block in blocks)])


def effects_on(blocks, sensor):
    """a, d, U and lever a′ of all states on a sensor."""
    shapes = ((3,), (3,), (3, 3), (3,))
    parts = [[np.empty((0, *shape)) for shape in shapes]]
    for block in blocks:
        effect = block.effects.get(sensor, error_states.Effect())
        values = (effect.offset_b, effect.offset_f, effect.scale, effect.lever)
        parts.append([np.zeros((block.size, *s)) if v is None else v for v, s in zip(values, shapes, strict=True)])
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


def turns_of(blocks, increments, dt, q, b, c):
    """The body's turns over intervals by the gyro's model (n, 3), its rate held."""
    T, e = stacked(blocks, "gyro_scale", (3, 3)), stacked(blocks, "gyro_offset", (3,))
    G, decay = stacked(blocks, "gyro_force", (3, 3)), stacked(blocks, "decay", ())
    force_f = sum((block.force_f for block in blocks), np.zeros(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(decay > 0.0, -np.expm1(-decay * dt) / decay, dt)
    felt = quaternion.rotate(
        quaternion.conjugate(quaternion.multiply(q, quaternion.exp(0.5 * (increments - b * dt)))), force_f
    )
    left = increments - b * dt - (mean * c) @ e - dt * np.einsum("nk,kij,nj->ni", c, G, felt)
    return np.linalg.solve(np.eye(3) + np.einsum("nk,kij->nij", c, T), left[..., None])[..., 0]


def system(blocks):
    """A of ``ċ = A c + …``."""
    return np.diag(-stacked(blocks, "decay", ())) + np.diag(stacked(blocks, "feed", ())[:-1], 1)


def transition_of(blocks, dt):
    return scipy.linalg.expm(system(blocks) * dt) if blocks else np.empty((0, 0))


def driven(blocks, noise, w, dt):
    """Q of (δθ, δb, δc) over an interval of rate w, by Van Loan."""
    m = sum(block.size for block in blocks)
    A, D = np.zeros((6 + m, 6 + m)), np.zeros((6 + m, 6 + m))
    A[:3, :3], A[:3, 3:6] = -kinematics.skew(w), -np.eye(3)
    A[:3, 6:] = -stacked(blocks, "gyro_offset", (3,)).T
    A[6:, 6:] = system(blocks) if m else 0.0
    D[:3, :3], D[3:6, 3:6] = noise.angle_random_walk**2 * np.eye(3), noise.rate_random_walk**2 * np.eye(3)
    D[6:, 6:] = np.diag(stacked(blocks, "density", ()))
    whole = scipy.linalg.expm(np.block([[-A, D], [np.zeros_like(A), A.T]]) * dt)
    n = 6 + m
    return whole[n:, n:].T @ whole[:n, n:]


def root_inverse(P):
    """A whitening matrix of a covariance, of which some states may have none: those are held fast."""
    sigma = np.sqrt(np.diag(P))
    scale = np.where(sigma > 0.0, sigma, 1e-9)
    return (
        np.linalg.inv(np.linalg.cholesky(P / np.outer(scale, scale) + np.diag(np.where(sigma > 0.0, 0.0, 1.0)))) / scale
    )


def predicted_vectors(blocks, series, q, c, W):
    a, d, U, lever = effects_on(blocks, series.sensor)
    r = series.reference_f + np.einsum("mk,ki->mi", c, d)
    z = in_body(q, r)
    z = z + np.einsum("mk,kij,mj->mi", c, U, z) + c @ a
    z = z + np.einsum("mij,kj,mk->mi", W, lever, c)
    return unit(z) if series.kind == "direction" else z


def turning_matrices(blocks, record, series):
    """W of a lever arm at each measurement, by the gyro."""
    if not any(effect.lever is not None for block in blocks for effect in block.effects.values()):
        return np.zeros((len(series.time), 3, 3))
    turns, _ = turning(record, series.time)
    w = kinematics.skew(turns[:, :3])
    return kinematics.skew(turns[:, 3:]) + w @ w


def optimum(small: Small, guess: np.ndarray, q0: np.ndarray):
    """The trajectory of least squares: attitudes (n + 1, 4), biases and values (n + 1, 3 + m), from a first guess, and the covariances."""
    record, blocks, initial = small.record, small.blocks, small.initial
    edges, n = len(record.time), guess.shape[1]
    dt = float(record.time[1] - record.time[0])
    prior = root_inverse(initial.covariance)
    phi = transition_of(blocks, dt)
    whitening = np.array(
        [root_inverse(driven(blocks, small.noise, increment / dt, dt)) for increment in record.increments]
    )
    measuring = [s for s in record.vectors if len(s.time)]
    rows = [(s, np.searchsorted(record.time, s.time), turning_matrices(blocks, record, s)) for s in measuring]

    def residuals(x):
        q, b, c = quaternion.multiply(q0, quaternion.exp(x[:, :3])), x[:, 3:6], x[:, 6:]
        off = turn_to(initial.attitude, q[0])
        there = quaternion.multiply(
            q[:-1], quaternion.exp(turns_of(blocks, record.increments, dt, q[:-1], b[:-1], c[:-1]))
        )
        step = turn_to(there, q[1:])
        step = np.concatenate([step, np.diff(b, axis=0), c[1:] - c[:-1] @ phi.T], axis=1)
        parts = [
            prior @ np.concatenate([off, b[0] - initial.bias, c[0] - initial.values]),
            np.einsum("nij,nj->ni", whitening, step).ravel(),
        ]
        for series, at, W in rows:
            miss = series.vector_b - predicted_vectors(blocks, series, q[at], c[at], W)
            parts.append((miss / series.sigma[:, None]).ravel())
        return np.concatenate(parts)

    # Gauss–Newton. An edge meets its neighbours only: the columns of every third one are differenced together.
    owner = [np.zeros(n, int), *(np.full(n, k) for k in range(edges - 1)), *(np.repeat(at, 3) for _, at, _ in rows)]
    later = [np.zeros(n, int), *(np.full(n, k + 1) for k in range(edges - 1)), *owner[edges:]]
    owner, later = np.concatenate(owner), np.concatenate(later)
    x = guess.copy()
    x[:, :3] = 0.0
    h = 1e-4 * np.sqrt(np.diag(initial.covariance))
    for _ in range(12):
        now = residuals(x)
        J = np.zeros((len(owner), edges, n))
        for group in range(3):
            mine = np.arange(group, edges, 3)
            edge = np.where(owner % 3 == group, owner, later)
            hit = (owner % 3 == group) | (later % 3 == group)
            for i in range(n):
                step = np.zeros_like(x)
                step[mine, i] = h[i]
                J[hit, edge[hit], i] = ((residuals(x + step) - residuals(x - step)) / (2.0 * h[i]))[hit]
        J = J.reshape(len(owner), -1) * np.tile(h, edges)
        move = np.linalg.lstsq(J, -now, rcond=None)[0]
        move = move.reshape(edges, n) * h
        x = x + move
        if np.max(np.abs(move) / h) < 0.1:
            break
    every = np.arange(edges)
    P = np.linalg.inv(J.T @ J).reshape(edges, n, edges, n)[every, :, every] * np.outer(h, h)
    return quaternion.multiply(q0, quaternion.exp(x[:, :3])), x[:, 3:], P


def beside_the_optimum(small: Small, attitude: np.ndarray, rest: np.ndarray, P: np.ndarray):
    """How far an estimate lies from the optimum, over the optimum's σ, and the ratio of its σ to that (n + 1, 6 + m) each."""
    q, right, covariance = optimum(small, np.concatenate([np.zeros_like(attitude[:, 1:]), rest], axis=1), attitude)
    for block in small.blocks[:1]:
        if any(effect.carried for effect in block.effects.values()):
            # Its error is that relative to the estimated attitude: exp(−δφ) c beside c, δφ = R δθ.
            T = np.tile(np.eye(6 + block.size), (len(q), 1, 1))
            for k in range(block.size // 3):
                own = np.arange(k, block.size, block.size // 3)
                T[:, 6 + own, :3] = kinematics.skew(right[:, 3 + own]) @ quaternion.to_matrix(q)
            covariance = T @ covariance @ np.swapaxes(T, 1, 2)
    sigma = np.sqrt(np.einsum("kii->ki", covariance))
    off = turn_to(attitude, q)
    off = np.concatenate([off, right - rest], axis=1)
    return np.abs(off) / sigma, np.sqrt(np.einsum("kii->ki", P)) / sigma


RATE = np.array([0.6, -0.9, 1.2])


def small_record(blocks, scale, *, seed=3, steps=8, dt=0.1, late=False, off=(1.0, -0.7, 0.5)) -> Small:
    """A record that the model makes, errors of attitude and sensors ``scale`` times tenths, that of the start ``off``.

    ``late``: the field is seen at the end only. A disturbed "force" is a direction, beside the sensors of the filter of every kind.
    """
    rng = np.random.default_rng(seed)
    noise = ProcessNoise(angle_random_walk=0.01 * scale, rate_random_walk=0.003 * scale)
    initial = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=0.1 * scale, bias_sigma=0.02 * scale)
    initial = estimation.with_error_states(initial, blocks)
    time, m = dt * np.arange(steps + 1), len(initial.values)
    b = 0.02 * scale * rng.standard_normal(3)
    c, q = np.empty((steps + 1, m)), np.empty((steps + 1, 4))
    P = initial.covariance[6:, 6:]
    c[0], q[0] = np.linalg.cholesky(P) @ rng.standard_normal(m), quaternion.normalize(rng.standard_normal(4))
    increments, phi = np.empty((steps, 3)), transition_of(blocks, dt)
    for k in range(steps):
        turn = RATE * dt * (1.0 + 0.3 * np.sin(2.0 * time[k]))
        increments[k] = turn
        for _ in range(10):  # what the model turns into this
            increments[k] += turn - turns_of(blocks, increments[k : k + 1], dt, q[k : k + 1], b[None], c[k : k + 1])[0]
        increments[k] += noise.angle_random_walk * math.sqrt(dt) * rng.standard_normal(3)
        q[k + 1] = quaternion.multiply(q[k], quaternion.exp(turn))
        value, vector = np.linalg.eigh(driven(blocks, noise, turn / dt, dt)[6:, 6:])
        c[k + 1] = phi @ c[k] + vector @ (np.sqrt(np.maximum(value, 0.0)) * rng.standard_normal(m))
    bare = ImuRecord(time=time, increments=increments)
    series = []
    every = any("force" in block.effects for block in blocks)
    force = ("force", "direction", UP / 9.81, 0.02 * scale) if every else ("acc", "vector", UP, 0.2 * scale)
    for (name, kind, reference, sigma), at in (
        (force, np.arange(1, steps + 1)),
        (("mag", "vector", FIELD, 0.02 * scale), np.array([steps]) if late else np.arange(2, steps + 1, 2)),
    ):
        template = series_of(name, kind, time[at], np.tile(reference, (len(at), 1)), reference, sigma)
        z = predicted_vectors(blocks, template, q[at], c[at], turning_matrices(blocks, bare, template))
        z = z + sigma * rng.standard_normal(z.shape)
        series.append(dataclasses.replace(template, vector_b=unit(z) if kind == "direction" else z))
    if every:
        series[1] = dataclasses.replace(series[1], sigma=0.0, covariance=series[1].covariances)
        series = beside_silent(*series)
    start = quaternion.multiply(q[0], quaternion.exp(0.1 * scale * np.array(off)))
    return Small(
        record=dataclasses.replace(bare, vectors=tuple(series)),
        noise=noise,
        initial=dataclasses.replace(initial, attitude=start),
        blocks=blocks,
        attitude=q,
        values=c,
    )


KINDS = {
    "none": lambda f: (),
    "every kind": lambda f: every_kind(
        gyro_scale={"scale_sigma": 0.02 * f, "misalignment_sigma": 0.01 * f},
        gyro_drift={"bias_sigma": 0.02 * f, "correlation_time": 0.7},
        mag_bias={"bias_sigma": 0.05 * f},
        force_disturbance={"noise_sigma": 0.15 * f},
    ),
    "gyro force": lambda f: (error_states.GyroForce(along_sigma=2e-3 * f, across_sigma=1e-3 * f * (1.0 - np.eye(3))),),
    "mounting": lambda f: (error_states.SensorMounting(sensor="acc", mounting_sigma=0.03 * f),),
    "lever arm": lambda f: (error_states.LeverArm(sensor="acc", arm_sigma=0.2 * f, strength=1.0),),
}
CARRIED = {
    "coloured, fixed axes": error_states.GaussMarkov(
        sensor="acc", noise_sigma=3.0, correlation_time=0.7, frame="fixed"
    ),
    "velocity": error_states.BoundedVelocity(
        sensor="acc", velocity_time=0.5, velocity_sigma=0.7, acceleration_time=0.3, strength=1.0
    ),
    "position": error_states.BoundedVelocity(
        sensor="acc", velocity_time=0.5, velocity_sigma=0.7, acceleration_time=0.3, position_time=1.0, strength=1.0
    ),
}


def smoothed_beside_the_optimum(small: Small):
    """What :func:`beside_the_optimum` says of the smoother."""
    estimate = estimation.smooth(small.record, small.noise, small.initial, small.blocks, full_covariance=True)
    rest = np.concatenate([estimate.bias, *(block.values for block in estimate.error_states.values())], axis=1)
    P = estimate.covariance if estimate.whole_covariance is None else estimate.whole_covariance
    return beside_the_optimum(small, estimate.attitude, rest, P)


def slow(kinds, *which):
    return [pytest.param(kind, marks=pytest.mark.slow if kind in which else []) for kind in kinds]


@pytest.mark.parametrize("kind", slow(KINDS, "gyro force", "mounting", "lever arm"))
def test_the_smoother_is_least_squares_to_first_order(kind):
    """Of the whole trajectory, prior and gyro noise and measurements together, by Gauss–Newton.

    With a lever arm rates and angular accelerations are taken from the gyro, which wants a hundred samples.
    """
    size = {"steps": 100, "dt": 0.03} if kind == "lever arm" else {"steps": 6}
    off, ratio = smoothed_beside_the_optimum(small_record(KINDS[kind](0.01), 0.01, **size))
    assert np.max(off) < 0.02
    np.testing.assert_allclose(ratio, 1.0, rtol=1e-2)


@pytest.mark.parametrize("late", [True, False], ids=["heading at the end", "heading at all times"])
@pytest.mark.parametrize("kind", slow(CARRIED, "coloured, fixed axes", "position"))
def test_what_is_carried_turns_with_the_attitude(kind, late):
    """Values of several σ of their sensor, of a body whose attitude is corrected after it has felt the push, or whose heading comes only
    at the end: the filter, which the last edge is, and the smoother turn what they know of the push along.
    """
    off, ratio = smoothed_beside_the_optimum(small_record((CARRIED[kind],), 0.01, late=late))
    assert np.max(off) < 0.01
    np.testing.assert_allclose(ratio, 1.0, rtol=1e-2)


def test_a_correction_by_a_radian_is_carried_back_with_all_that_turns():
    """A body at rest, and no noise: what is measured at the end says of the start what it would have said there."""
    blocks = (
        error_states.BoundedVelocity(
            sensor="acc", velocity_time=1e9, acceleration_time=1e9, velocity_sigma=1e9, strength=1.0
        ),
    )
    still = ProcessNoise(angle_random_walk=1e-9, rate_random_walk=1e-12)
    initial = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=[0.1, 0.2, 2.0], bias_sigma=1e-9)
    true = quaternion.exp([0.1, -0.05, 1.3])
    felt = quaternion.rotate(quaternion.conjugate(true), np.array([0.6, -0.3, 10.01]))
    estimates = []
    for run, at in ((estimation.smooth, 1.0), (estimation.run, 0.0)):
        acc = series_of("acc", "vector", [at], [felt], UP, 0.05)
        mag = series_of("mag", "vector", [at], [in_body(true, FIELD)], FIELD, 0.01)
        estimates.append(run(resting(acc, mag), still, initial, blocks, full_covariance=True))
    assert difference(*estimates, 0, 0) < 1e-6
    assert np.linalg.norm(quaternion.log(estimates[0].attitude[0])) > 0.9


NOISE = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-4)
IRON = error_states.VectorBias(sensor="mag", bias_sigma=0.05, rate_random_walk=1e-3)
SWAY = error_states.GaussMarkov(sensor="acc", noise_sigma=0.3, correlation_time=0.4, frame="fixed")


def swaying(duration=2.0, seed=1, start_error=(0.05, -0.02, 0.03)):
    """A record of a swaying body, sensors at times of their own, some on edges and an event just beside one; and the initial state."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(50 * duration) + 1) / 50.0
    turns = BODY.increments(time) + 1e-3 * math.sqrt(0.02) * rng.standard_normal((len(time) - 1, 3))
    series = []
    for name, reference, sigma, at in (
        ("acc", UP, 0.05, np.arange(0.013, duration, 0.11)),
        ("mag", FIELD, 0.02, np.nextafter(time[5::10], np.where(np.arange(len(time[5::10])) % 3 == 0, 9.0, 0.0))),
    ):
        z = in_body(BODY.attitude(at), reference)
        series.append(series_of(name, "vector", at, z + sigma * rng.standard_normal(z.shape), reference, sigma))
    attitude = quaternion.multiply(BODY.attitude(np.array(0.0)), quaternion.exp(start_error))
    truth = records.Truth(attitude=BODY.attitude(time), bias=np.zeros((len(time), 3)))
    record = ImuRecord(time=time, increments=turns, vectors=tuple(series[::-1]), truth=truth)
    return record, estimation.initial_state(attitude, attitude_sigma=0.05, bias_sigma=3e-3)


def difference(first, second, k=slice(None), j=slice(None)):
    """Largest difference of rows k of one estimate and j of another, in σ, and of covariances scaled to correlations."""
    mine, theirs = (
        e.covariance[r] if e.whole_covariance is None else e.whole_covariance[r] for e, r in ((first, k), (second, j))
    )
    sigma = np.sqrt(np.einsum("...ii->...i", theirs))
    off = turn_to(first.attitude[k], second.attitude[j])
    parts = [off, first.bias[k] - second.bias[j]]
    parts += [block.values[k] - second.error_states[name].values[j] for name, block in first.error_states.items()]
    P = (mine - theirs) / (sigma[..., :, None] * sigma[..., None, :])
    return max(np.max(np.abs(np.concatenate(parts, axis=-1)) / sigma), np.max(np.abs(P)))


# --------------------------------------------------------------------------------------------------------------------- recoveries


def lost_start(seed: int, duration: float = 2.5, blocks=(IRON,)):
    """A record of a body with constant hard iron, the truth of it, and a start radians off with a σ of 3°."""
    rng = np.random.default_rng([3, seed])
    record, initial = swaying(duration, [4, seed])
    iron = 0.05 * rng.standard_normal(3)
    mag, acc = record.vectors
    record = dataclasses.replace(record, vectors=(dataclasses.replace(mag, vector_b=mag.vector_b + iron), acc))
    axis = quaternion.normalize(np.append(rng.standard_normal(3), 0.0))[:3]
    attitude = quaternion.multiply(record.truth.attitude[0], quaternion.exp(rng.uniform(0.8, 3.1) * axis))
    return record, iron, dataclasses.replace(initial, attitude=attitude)


STILL = error_states.VectorBias(sensor="mag", bias_sigma=0.05)
GATE = Gate(recovery=4, restart_bias_sigma=3e-3)


def test_what_is_smoothed_of_a_recovery_and_what_is_not():
    record, iron, initial = lost_start(1)
    ahead = estimation.run(record, NOISE, initial, (STILL,), gate=GATE, full_covariance=True)
    both = estimation.smooth(record, NOISE, initial, (STILL,), gate=GATE, full_covariance=True)
    (event,) = recoveries(ahead)
    assert both.events == ahead.events
    assert both.innovations["mag"].weight == pytest.approx(ahead.innovations["mag"].weight)
    first, last = np.searchsorted(record.time, [event.start, event.end])
    assert last - first > 10
    truth = record.truth.attitude, record.truth.bias, {"mag bias": iron}
    off = np.abs(state_errors(both, *truth)) / np.sqrt(np.einsum("kii->ki", both.whole_covariance))
    wrong = np.abs(state_errors(ahead, *truth)) / np.sqrt(np.einsum("kii->ki", ahead.whole_covariance))
    assert np.min(np.max(wrong[first:last], axis=1)) > 10.0  # what the filter said in between is wrong
    assert np.max(off[first:]) < 5.0
    assert np.all(both.sigma[last:] <= ahead.sigma[last:] * (1.0 + 1e-2))
    # What came before the first refusal knows nothing of what came after it.
    assert difference(both, ahead, 0, 0) < 1e-10
    assert difference(both, ahead, -1, -1) < 1e-10


SPUN = dataclasses.replace(BODY, mean=(3.0, -2.0, 4.0))
WALKING = error_states.VectorBias(sensor="mag", bias_sigma=1e-3, rate_random_walk=0.05)
COLOURED = error_states.GaussMarkov(sensor="acc", noise_sigma=0.3, correlation_time=0.4)
NOISY = ProcessNoise(angle_random_walk=0.02, rate_random_walk=0.02)


def jumped(lost: float, blocks) -> tuple[ImuRecord, estimation.State]:
    """A record of a noisy gyro with a bias, with the states hard iron that walks from nothing and a large acceleration that dies away, in
    which all that is fixed turns by 0.6 rad at a time; and the state at the start, which is right.
    """
    rng = np.random.default_rng(2)
    time, bias, shaken = 0.04 * np.arange(31), np.array([0.05, -0.04, 0.06]), np.array([1.0, -0.8, 0.6])
    turns = SPUN.increments(time) + 0.04 * bias + 0.02 * 0.2 * rng.standard_normal((30, 3))
    axis = quaternion.normalize(np.append(rng.standard_normal(3), 0.0))[:3]
    turned = np.where((time > lost)[:, None], quaternion.exp(0.6 * axis), quaternion.IDENTITY)
    back = quaternion.conjugate(quaternion.multiply(turned, SPUN.attitude(time)))
    walked = np.cumsum(0.05 * 0.2 * rng.standard_normal((31, 3)), axis=0)
    errors = (np.exp(-time / 0.4)[:, None] * shaken, walked) if blocks else np.zeros((2, 31, 3))
    series = []
    for name, reference, sigma, at, error in (
        ("acc", UP, 0.05, slice(1, 31, 2), errors[0]),
        ("mag", FIELD, 0.01, slice(2, 31, 2), errors[1]),
    ):
        vector_b = quaternion.rotate(back[at], reference) + error[at]
        vector_b = vector_b + sigma * rng.standard_normal(vector_b.shape)
        series.append(series_of(name, "vector", time[at], vector_b, reference, sigma))
    start = SPUN.attitude(np.array(0.0))
    initial = estimation.initial_state(start, attitude_sigma=0.03, bias=bias, bias_sigma=3e-3)
    initial = estimation.with_error_states(initial, blocks)
    initial = dataclasses.replace(initial, values=np.concatenate([np.zeros(3), shaken])[: len(initial.values)])
    return ImuRecord(time=time, increments=turns, vectors=tuple(series)), initial


@pytest.mark.parametrize(
    "blocks", [(), pytest.param((WALKING, COLOURED), marks=pytest.mark.slow)], ids=["none", "states"]
)
@pytest.mark.parametrize(("lost", "since"), [(0.0, 3), (0.5, 15)])
def test_a_trajectory_begins_with_its_candidate(lost, since, blocks):
    """From its start on it is the least-squares trajectory of what was measured from there on, and of what the candidate started from:
    attitude and bias of the lost filter, with three times the gate's σ as one candidate has failed, and the prior of the states by then.
    """
    record, initial = jumped(lost, blocks)
    gate = Gate(recovery=4, restart_attitude_sigma=0.1, restart_bias_sigma=3e-3)
    ahead = estimation.run(record, NOISY, initial, blocks, gate=gate)
    both = estimation.smooth(record, NOISY, initial, blocks, gate=gate, full_covariance=True)
    begin = record.time[since]
    assert begin - recoveries(both)[0].start == pytest.approx(0.08)
    rest = ImuRecord(
        time=record.time[since:],
        increments=record.increments[since:],
        vectors=tuple(s.taken(s.time >= begin) for s in record.vectors),
    )
    aged = (dataclasses.replace(WALKING, bias_sigma=math.hypot(1e-3, 0.05 * math.sqrt(begin))), COLOURED)[: len(blocks)]
    fresh = estimation.initial_state(
        ahead.attitude[since],
        attitude_sigma=0.3,
        bias=ahead.bias[since],
        bias_sigma=np.sqrt(ahead.variance[since, 3:] + 9e-3**2),
    )
    fresh = estimation.with_error_states(fresh, aged)
    kept = np.repeat([1.0, math.exp(-begin / 0.4)], 3)[: len(initial.values)]
    fresh = dataclasses.replace(fresh, values=kept * initial.values)
    rest = Small(record=rest, noise=NOISY, initial=fresh, blocks=aged)
    values = np.concatenate([both.bias, *(block.values for block in both.error_states.values())], axis=1)[since:]
    P = both.whole_covariance if blocks else both.covariance
    off, ratio = beside_the_optimum(rest, both.attitude[since:], values, P[since:])
    assert np.max(off) < 0.1
    np.testing.assert_allclose(ratio, 1.0, rtol=0.04)


@pytest.mark.slow
def test_the_parts_about_a_recovery_keep_the_unit_of_the_start():
    """A bias that is fixed in the unit of a sensor whose σ grows: whatever the unit, the bias in it says the same."""
    record, _, initial = lost_start(2)
    mag, acc = record.vectors
    unit = mag.vector_b / np.linalg.norm(mag.vector_b, axis=1, keepdims=True)
    sigma = np.geomspace(0.01, 0.05, len(unit))
    mag = dataclasses.replace(mag, kind="direction", vector_b=unit, sigma=sigma)
    record = dataclasses.replace(record, vectors=(mag, acc))
    estimates = []
    for ratio in (1.0, 3.0):
        blocks = (error_states.VectorBias(sensor="mag", bias_sigma=0.05 * ratio, varying=True),)
        start = dataclasses.replace(
            estimation.with_error_states(initial, blocks),
            unit_sigma={} if ratio == 1.0 else {"mag": ratio * float(np.sqrt(np.mean(sigma**2)))},
        )
        estimates.append(estimation.smooth(record, NOISE, start, blocks, gate=GATE))
    first, second = estimates
    assert recoveries(first) == recoveries(second)
    assert len(recoveries(first)) == 1
    np.testing.assert_allclose(first.attitude, second.attitude, rtol=0, atol=1e-10)
    np.testing.assert_allclose(first.variance, second.variance, rtol=1e-7)
