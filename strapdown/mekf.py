"""Multiplicative extended Kalman filter: attitude and gyro bias from gyro increments and vector measurements.

The process model is equation (17), ``q̇ = ½ q ⊗ (w_meas − b)``; the error state is ``(δθ, δb)`` with ``q_true = q ⊗ exp(δθ)`` and
``δb = b_true − b``. Transition and process noise are exact at constant rate; after each correction the covariance is carried to the new
tangent space. Two faces, held equal by a test: :func:`run`, compiled, for whole records, and :class:`StepFilter`, on filterpy, for
people who look inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import filterpy.kalman
import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, quaternion
from strapdown.checks import Array, InputError, array, count, covariance, non_negative, positive, unit_quaternions
from strapdown.kernels import filter_loop, filter_step
from strapdown.kernels.machine import compiled
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.records import Estimate, ImuRecord, Innovations
from strapdown.vectors import KINDS, VectorMeasurements, triad

_KIND_CODES = {
    "direction": filter_loop.DIRECTION,
    "vector": filter_loop.VECTOR,
    "heading": filter_loop.HEADING,
    "attitude": filter_loop.ATTITUDE,
}


@dataclass(frozen=True, kw_only=True)
class ProcessNoise:
    """What the filter believes of the gyro."""

    angle_random_walk: float
    """σ_v, rad/√s; greater than zero."""
    rate_random_walk: float
    """σ_u, rad/s/√s; zero is a constant bias."""

    def __post_init__(self) -> None:
        """Check both."""
        positive("angle_random_walk", self.angle_random_walk, unit="rad/√s")
        non_negative("rate_random_walk", self.rate_random_walk, unit="rad/s/√s")


@dataclass(frozen=True, kw_only=True)
class State:
    """Attitude, bias and the covariance of their error."""

    attitude: Array
    """q_fb (4,)."""
    bias: Array
    """Gyro bias (3,), rad/s."""
    covariance: Array
    """P (6, 6) of (δθ, δb): rad², rad²/s, (rad/s)²."""

    def __post_init__(self) -> None:
        """Check shapes, the norm and positive definiteness."""
        object.__setattr__(self, "attitude", unit_quaternions("attitude", array("attitude", self.attitude, (4,))))
        object.__setattr__(self, "bias", array("bias", self.bias, (3,)))
        object.__setattr__(self, "covariance", covariance("covariance", self.covariance, 6))


def initial_state(
    attitude: ArrayLike, *, attitude_sigma: ArrayLike, bias_sigma: ArrayLike, bias: ArrayLike = (0.0, 0.0, 0.0)
) -> State:
    """Return a state with independent errors: ``attitude_sigma`` rad and ``bias_sigma`` rad/s, scalars or one an axis."""
    sigma = np.concatenate([np.broadcast_to(attitude_sigma, 3), np.broadcast_to(bias_sigma, 3)]).astype(np.float64)
    if not np.all(sigma > 0.0):
        k = int(np.argmin(sigma > 0.0))
        raise InputError(
            f"{'attitude' if k < 3 else 'bias'}_sigma[{k % 3}] is {sigma[k]:g}; it must be greater than zero"
        )
    return State(attitude=np.asarray(attitude), bias=np.asarray(bias), covariance=np.diag(sigma**2))


# Blocks of P as the kernels hold them: rows and columns of A = P_θθ (upper), B = P_θb, C = P_bb (upper).
_UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
_ROWS = np.array([*_UPPER[0], *np.repeat(range(3), 3), *(3 + np.array(_UPPER[0]))])
_COLUMNS = np.array([*_UPPER[1], *(3 + np.tile(range(3), 3)), *(3 + np.array(_UPPER[1]))])


def pack(attitude: Array, bias: Array, covariance: Array) -> Array:
    """Return a state as the kernels' 28 numbers: q, b, and P in blocks."""
    return np.concatenate([attitude, bias, covariance[_ROWS, _COLUMNS]])


def covariance_matrices(blocks: Array) -> Array:
    """Return whole matrices P (..., 6, 6) of the kernels' 21 numbers (..., 21)."""
    P = np.empty((*blocks.shape[:-1], 6, 6))
    P[..., _ROWS, _COLUMNS] = blocks
    P[..., _COLUMNS, _ROWS] = blocks
    return P


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Measurements of all sensors in one order of time, as the kernel takes them. Those at one time keep the order of the sensors."""

    time: Array
    """Times (events,), s."""
    kind: np.ndarray
    """Codes of :mod:`strapdown.kernels.filter_loop` (events,)."""
    vector_b: Array
    """Measured vectors over the length of their references (events, 3); of an attitude its three variances."""
    variance: Array
    """Variance of each component of the vector (events,)."""
    sensor: np.ndarray
    """Index of the sensor (events,)."""
    reference: np.ndarray
    """Row of ``triads`` (events,)."""
    triads: Array
    """Right-handed frames (u, v, r) by rows about the references r (rows, 9), one a sensor or one a measurement; of an attitude the
    measured quaternion."""
    sensors: tuple[str, ...]
    kinds: tuple[str, ...]
    skipped: dict[str, int]


def schedule(vectors: tuple[VectorMeasurements, ...], start: float, end: float) -> Schedule:
    """Return the measurements inside [start, end] in order of time; missing (NaN) ones and those outside are counted as skipped."""
    parts = [_scheduled(series, start, end) for series in vectors]
    rows = np.cumsum([0, *(len(frames) for *_, frames in parts)])
    columns = [
        (
            time,
            value,
            variance,
            np.full(len(time), i, np.uint8),
            frame + np.int32(rows[i]),
            np.full(len(time), _KIND_CODES[series.kind], np.uint8),
        )
        for i, (series, (time, value, variance, frame, _)) in enumerate(zip(vectors, parts, strict=True))
    ]
    if not columns:
        none = np.empty(0, np.uint8)
        columns.append((np.empty(0), np.empty((0, 3)), np.empty(0), none, np.empty(0, np.int32), none))
    joined = columns[0] if len(columns) == 1 else [np.concatenate(column) for column in zip(*columns, strict=True)]
    if len(columns) > 1:
        bounds = np.cumsum([0, *(len(column[0]) for column in columns)])
        order = np.empty(bounds[-1], np.int64)
        compiled(filter_loop.merge_order)(joined[0], bounds[:-1].copy(), bounds[1:], order)
        joined = [np.take(column, order, axis=0) for column in joined]
    time, value, variance, sensor, reference, kind = joined
    return Schedule(
        time=time,
        kind=kind,
        vector_b=np.ascontiguousarray(value),
        variance=variance,
        sensor=sensor,
        reference=reference,
        triads=np.concatenate([frames for *_, frames in parts]) if parts else np.empty((0, 9)),
        sensors=tuple(series.sensor for series in vectors),
        kinds=tuple(series.kind for series in vectors),
        skipped={s.sensor: len(s.time) - len(part[0]) for s, part in zip(vectors, parts, strict=True)},
    )


def _scheduled(series: VectorMeasurements, start: float, end: float) -> tuple[Array, Array, Array, np.ndarray, Array]:
    """Return the usable measurements of one series: times, values, variances, rows of frames, frames (rows, 9)."""
    if not np.all(series.sigma > 0.0):
        k = int(np.argmin(series.sigma > 0.0))
        raise InputError(f"{series.sensor}: sigma[{k}] is 0 rad; a filter needs a noise greater than zero")
    inside = slice(*np.searchsorted(series.time, [start, np.nextafter(end, np.inf)]))
    used = series if inside == slice(0, len(series.time)) else series.taken(inside)
    content = used.vector_b if used.attitude is None else used.attitude
    if not np.isfinite(content).all():
        used = used.taken(np.isfinite(content).all(axis=1))
    if used.attitude is not None:
        assert used.sigma_axes is not None
        frames = np.zeros((len(used.time), 9))
        frames[:, :4] = used.attitude
        return used.time, used.sigma_axes**2, used.sigma**2, np.arange(len(used.time), dtype=np.int32), frames
    moving = used.reference_f.ndim == 2
    frame = np.arange(len(used.time), dtype=np.int32) if moving else np.zeros(len(used.time), np.int32)
    value, variance = used.vector_b, used.sigma**2
    if used.kind == "vector":
        # A vector is taken over the length of its reference, so that the kernel sees unit references only.
        length = np.linalg.norm(used.reference_f, axis=-1)
        value, variance = value / (length[:, None] if moving else length), variance / length**2
    return used.time, value, variance, frame, triad(used.reference_f).reshape(-1, 9)


def innovations_by_sensor(events: Schedule, rows: Array) -> dict[str, Innovations]:
    """Return what a kernel wrote of each event, e₁, s₁, e₂, s₂, …, by sensor, as many as each has degrees of freedom."""
    result = {}
    for i, (sensor, kind) in enumerate(zip(events.sensors, events.kinds, strict=True)):
        mine = slice(None) if len(events.sensors) == 1 else events.sensor == i
        filled = rows[mine, : 2 * KINDS[kind]]
        result[sensor] = Innovations(time=events.time[mine], innovation=filled[:, 0::2], variance=filled[:, 1::2])
    return result


def run(
    record: ImuRecord, process_noise: ProcessNoise, initial: State, *, every: int = 1, full_covariance: bool = False
) -> Estimate:
    """Run the filter over a whole record, compiled.

    Gyro intervals are split exactly at the times of measurements. Intervals in which the body turns by more than a third of a radian are
    taken in sub-steps of the same constant-rate model.

    Parameters
    ----------
    record : ImuRecord
        Increments are taken as turns at constant rate: correct them for coning first (:func:`strapdown.records.compress`).
    process_noise : ProcessNoise
    initial : State
        State at the first edge.
    every : int
        Keep the state at every ``every``-th edge, the first included.
    full_covariance : bool
        Keep whole covariance matrices too.

    Returns
    -------
    Estimate
    """
    return run_on(record, process_noise, initial, every=every, full_covariance=full_covariance)[0]


def run_on(
    record: ImuRecord, process_noise: ProcessNoise, initial: State, *, every: int = 1, full_covariance: bool = False
) -> tuple[Estimate, State]:
    """Run the filter and return the end state too, from which the next part of a record goes on, bit for bit."""
    events = schedule(record.vectors, record.time[0], record.time[-1])
    estimate, end, _ = run_events(
        record, events, process_noise, initial, every=every, full_covariance=full_covariance, segments=0
    )
    return estimate, State(attitude=end[:4], bias=end[4:7], covariance=covariance_matrices(end[7:]))


def run_events(
    record: ImuRecord,
    events: Schedule,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int,
    full_covariance: bool,
    segments: int,
) -> tuple[Estimate, Array, Array]:
    """Run the kernel over scheduled events; return the estimate, the packed end state (28,), and up to ``segments`` predicted segments.

    A segment (32,) is what a smoother needs of one prediction: dt, increment (3), packed state (28) that it starts from. Where any are
    asked for, one row more follows them: the end state, from which nothing is predicted (dt and increment 0).
    """
    count("every", every)
    rows = (len(record.increments)) // every + 1
    state = pack(initial.attitude, initial.bias, initial.covariance)
    attitude, bias, variance = np.empty((rows, 4)), np.empty((rows, 3)), np.empty((rows, 6))
    blocks = np.empty((rows if full_covariance else 0, 21))
    innovation = np.empty((len(events.time), max([4, *(2 * KINDS[kind] for kind in events.kinds)])))
    stored = np.empty((segments + 1 if segments else 0, 32))
    number = compiled(filter_loop.run_filter)(
        record.time,
        np.ascontiguousarray(record.increments),
        process_noise.angle_random_walk**2,
        process_noise.rate_random_walk**2,
        events.time,
        events.kind,
        events.vector_b,
        events.variance,
        events.reference,
        events.triads,
        state,
        every,
        attitude,
        bias,
        variance,
        blocks,
        innovation,
        stored[:segments],
    )
    if segments:
        stored[number, :4] = 0.0
        stored[number, 4:] = state
    estimate = Estimate(
        time=record.time[::every],
        attitude=attitude,
        bias=bias,
        variance=variance,
        covariance=covariance_matrices(blocks) if full_covariance else None,
        innovations=innovations_by_sensor(events, innovation),
        skipped=events.skipped,
    )
    return estimate, state, stored[: number + 1]


class StepFilter(filterpy.kalman.ExtendedKalmanFilter):  # type: ignore[misc]
    """The same filter step by step, on filterpy: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K`` and ``Saver`` work as its users expect.

    ``x`` is the error state (δθ, δb) (6,): zero before and after each update, because the correction moves into ``attitude`` and
    ``bias``; ``x_post`` keeps the last correction. ``attitude`` (4,) is q_fb, ``bias`` (3,) in rad/s, ``nis`` that of the last update.
    """

    def __init__(self, process_noise: ProcessNoise, initial: State) -> None:
        super().__init__(dim_x=6, dim_z=2)
        self.process_noise = process_noise
        self.attitude: Array = initial.attitude.copy()
        self.bias: Array = initial.bias.copy()
        self.x = np.zeros(6)
        self.P = initial.covariance.copy()
        self.y = np.zeros(2)
        self.nis = 0.0

    def predict(self, delta_theta: ArrayLike, dt: float) -> None:
        """Propagate over one gyro increment (3,), rad, of dt seconds."""
        increment = array("delta_theta", delta_theta, (3,))
        step = positive("dt", dt, unit="s")
        parts = int(np.linalg.norm(increment) / LARGEST_ANGLE) + 1
        for _ in range(parts):
            phi = increment / parts - self.bias * (step / parts)
            self.F, self.Q = transition_and_noise(phi, step / parts, self.process_noise)
            super().predict()
            self.attitude = quaternion.normalize(quaternion.multiply(self.attitude, quaternion.exp(phi)))

    def update_direction(self, vector_b: ArrayLike, reference_f: ArrayLike, sigma: float) -> None:
        """Update with a measured unit direction (3,) of a known one (3,): two degrees of freedom, ``sigma`` rad across it."""
        z = array("vector_b", vector_b, (3,))
        u, v, _ = triad(array("reference_f", reference_f, (3,))) @ quaternion.to_matrix(self.attitude)
        H = np.zeros((2, 6))
        H[0, :3], H[1, :3] = -v, u
        self._correct(np.array([u @ z, v @ z]), H, positive("sigma", sigma, unit="rad"))

    def update_vector(self, vector_b: ArrayLike, reference_f: ArrayLike, sigma: float) -> None:
        """Update with a measured vector (3,) of a known one (3,): three degrees of freedom, ``sigma`` each component, in their unit."""
        r = array("reference_f", reference_f, (3,))
        basis = triad(r) @ quaternion.to_matrix(self.attitude)
        H = np.zeros((3, 6))
        H[:2, :3] = np.linalg.norm(r) * np.array([-basis[1], basis[0]])
        residual = basis @ array("vector_b", vector_b, (3,)) - np.array([0.0, 0.0, np.linalg.norm(r)])
        self._correct(residual, H, positive("sigma", sigma))

    def update_heading(self, vector_b: ArrayLike, reference_f: ArrayLike, sigma: float) -> None:
        """Update with the heading of a measured vector's horizontal part: one degree of freedom, ``sigma`` rad."""
        R, z = quaternion.to_matrix(self.attitude), array("vector_b", vector_b, (3,))
        m = R @ z
        error = filter_loop.heading_error(tuple(R.ravel()), z, reference_f)
        H = np.zeros((1, 6))
        H[0, :3] = np.array([*(-m[2] * m[:2] / (m[:2] @ m[:2])), 1.0]) @ R
        self._correct(np.array([error]), H, positive("sigma", sigma, unit="rad"))

    def update_attitude(self, attitude: ArrayLike, sigma: ArrayLike) -> None:
        """Update with a measured attitude q_fb (4,): three degrees of freedom, ``sigma`` rad about each body axis, or one for all."""
        measured = unit_quaternions("attitude", array("attitude", attitude, (4,)))
        residual = quaternion.log(quaternion.multiply(quaternion.conjugate(self.attitude), measured))
        H = np.eye(3, 6)
        spread = np.array([positive("sigma", value, unit="rad") for value in np.broadcast_to(sigma, 3)])
        self._correct(residual, H, spread)

    def _correct(self, residual: Array, H: Array, sigma: float | Array) -> None:
        self.dim_z = len(residual)
        zero = np.zeros(len(residual))
        super().update(residual, HJacobian=lambda x: H, Hx=lambda x: zero, R=np.eye(len(residual)) * sigma**2)
        self.nis = float(self.y @ np.linalg.solve(self.S, self.y))
        correction = self.x[:3]
        self.attitude = quaternion.normalize(quaternion.multiply(self.attitude, quaternion.exp(correction)))
        self.bias = self.bias + self.x[3:]
        G = np.eye(6)
        G[:3, :3] = kinematics.right_jacobian(correction)
        self.P = G @ self.P @ G.T
        self.P_post = self.P.copy()
        self.x = np.zeros(6)


def transition_and_noise(phi: ArrayLike, dt: float, process_noise: ProcessNoise) -> tuple[Array, Array]:
    """Return Φ and Q (6, 6) of the error state over a turn φ = ω dt (3,) at constant rate, |φ| ≤ 1/3 rad.

    The kernels' own formulas (:mod:`strapdown.kernels.filter_step`), as matrices.
    """
    turn = tuple(float(component) for component in array("phi", phi, (3,)))
    phi11, phi12 = filter_step.transition(turn, dt)
    q11, q12, q22 = filter_step.process_noise(
        turn, dt, process_noise.angle_random_walk**2, process_noise.rate_random_walk**2
    )
    F = np.eye(6)
    F[:3, :3] = np.reshape(phi11, (3, 3))
    F[:3, 3:] = np.reshape(phi12, (3, 3))
    return F, covariance_matrices(np.array([*q11, *q12, q22, 0.0, 0.0, q22, 0.0, q22]))
