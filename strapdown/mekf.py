"""Multiplicative extended Kalman filter: attitude and gyro bias from gyro increments and vector measurements.

The process model is equation (17), ``q̇ = ½ q ⊗ (w_meas − b)``; the error state is ``(δθ, δb)`` with ``q_true = q ⊗ exp(δθ)`` and
``δb = b_true − b``. Transition and process noise are exact at constant rate; after each correction the covariance is carried to the new
tangent space. Two faces, held equal by a test: :func:`run`, compiled, for whole records, and :class:`StepFilter`, on filterpy, for
people who look inside.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import filterpy.kalman
import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, quaternion, wahba
from strapdown.checks import (
    Array,
    InputError,
    array,
    count,
    covariance,
    finite,
    non_negative,
    positive,
    unit_quaternions,
)
from strapdown.kernels import filter_loop, filter_step, robust_loop, robust_step
from strapdown.kernels.machine import compiled
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.records import Estimate, Event, ImuRecord, Innovations
from strapdown.robustness import WIDE_PASSES, Gate, Monitor, Robust, Rows, linearise, tilt_unknown
from strapdown.vectors import KINDS, VectorMeasurements, triad

_KIND_CODES = {
    "direction": filter_loop.DIRECTION,
    "vector": filter_loop.VECTOR,
    "heading": filter_loop.HEADING,
    "attitude": filter_loop.ATTITUDE,
}

GAP_FACTOR = 5.0
"""A gyro interval longer than so many times the median one is told as a gap."""


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


FIRST_SETS = 10
"""Sets of first measurements that a start is tried from, one after the other, should one hold an outlier."""
VERTICAL = math.radians(1.0)
"""A reference so near the fixed z axis is the vertical, rad."""
ONCE = 10.0
"""The start is believed so many times less than the measurements it is made from, for the filter takes them in again."""


def first_state(
    record: ImuRecord, process_noise: ProcessNoise, *, bias_sigma: float, bias: ArrayLike = (0.0, 0.0, 0.0)
) -> State:
    """Return a state at the first edge from the first measurements: a measured attitude, or by Wahba's problem two directions or more.

    Each is taken back to the first edge by the gyro. Its noise grows on the way by that of the gyro and of the bias; the attitude's σ is
    ``ONCE`` times what all of that leaves, so that these measurements, which the filter takes in again, count once.

    Parameters
    ----------
    record : ImuRecord
    process_noise : ProcessNoise
    bias_sigma : float
        Standard deviation of the bias error, each axis, rad/s.
    bias : array_like (3,)
        Gyro bias, rad/s.

    Raises
    ------
    InputError
        If no measurement gives the attitude: fewer than two directions, all on one line, or none that fit together.
    """
    positive("bias_sigma", bias_sigma, unit="rad/s")
    b = array("bias", bias, (3,))
    problem = "the record holds no measurement that gives an attitude"
    for k in range(FIRST_SETS):
        try:
            attitude, P = _attitude_of_set(record, process_noise, b, bias_sigma, k)
        except InputError as error:
            problem = problem if k else str(error)
            continue
        whole = np.zeros((6, 6))
        whole[:3, :3] = ONCE**2 * P
        whole[3:, 3:] = bias_sigma**2 * np.eye(3)
        return State(attitude=attitude, bias=b, covariance=whole)
    raise InputError(f"the first measurements do not give the attitude: {problem}; give the initial attitude")


def _attitude_of_set(
    record: ImuRecord, process_noise: ProcessNoise, bias: Array, bias_sigma: float, k: int
) -> tuple[Array, Array]:
    """Return attitude and covariance at the first edge from the k-th usable measurement of each sensor."""
    body, fixed, sigmas, headings = [], [], [], []
    for series in record.vectors:
        content = series.vector_b if series.attitude is None else series.attitude
        inside = (series.time >= record.time[0]) & (series.time <= record.time[-1]) & np.isfinite(content).all(axis=1)
        if np.sum(inside) <= k:
            continue
        one = series.taken(np.flatnonzero(inside)[k : k + 1])
        turn = _turn_until(record, bias, float(one.time[0]))
        span = one.time[0] - record.time[0]
        grown = process_noise.angle_random_walk**2 * span + (bias_sigma * span) ** 2
        if one.attitude is not None:
            attitude = quaternion.multiply(one.attitude[0], quaternion.conjugate(turn))
            R = quaternion.to_matrix(turn)
            return attitude, R @ one.covariances[0] @ R.T + grown * np.eye(3)
        reference = one.references_f[0]
        length = float(np.linalg.norm(reference))
        body.append(quaternion.rotate(turn, one.vector_b[0] / np.linalg.norm(one.vector_b[0])))
        fixed.append(reference / length)
        scale = length if one.kind == "vector" else 1.0
        sigmas.append(float(np.hypot(one.sigma[0] / scale, np.sqrt(grown))))
        if one.kind == "heading":
            headings.append((body.pop(), fixed.pop(), sigmas.pop()))
    if len(body) == 1 and headings and abs(fixed[0][2]) > np.cos(VERTICAL):
        # Beside the vertical a heading is a direction: the horizontal part of its vector.
        seen, reference, sigma = headings[0]
        body.append(seen - body[0] * (seen @ body[0]))
        fixed.append(reference - fixed[0] * (reference @ fixed[0]))
        sigmas.append(sigma)
    if len(body) < 2:
        raise InputError(
            f"two directions are needed, or the vertical and a heading, and it has {len(body)} of directions "
            f"and {len(headings)} of headings"
        )
    solution = wahba.solve(np.array(body), np.array(fixed), np.array(sigmas))
    return solution.attitude, solution.covariance


def _turn_until(record: ImuRecord, bias: Array, time: float) -> Array:
    """Return the turn q from the first edge to a time, by the gyro."""
    k = int(np.searchsorted(record.time, time, side="right")) - 1
    dt = np.diff(record.time[: k + 2])
    steps = record.increments[: k + 1] - bias * dt[:, None]
    if k < len(record.increments):
        # The last interval is entered only so far.
        steps[k] *= (time - record.time[k]) / dt[k]
    turns = quaternion.exp(steps)
    while len(turns) > 1:  # pairs of neighbours
        odd = turns[len(turns) // 2 * 2 :]
        turns = np.concatenate([quaternion.multiply(turns[0 : len(turns) - len(odd) : 2], turns[1::2]), odd])
    return quaternion.normalize(turns[0])


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
    noise: Array | None = None
    """Upper triangles of the covariances in body axes (events, 6), over the squared lengths of the references, if any is anisotropic."""

    @property
    def body_noise(self) -> Array:
        """Upper triangle of each measurement's covariance in body axes (events, 6); of a heading the first number is its variance."""
        if self.noise is not None:
            return self.noise
        attitude = (self.kind == filter_loop.ATTITUDE)[:, None]
        rows = np.zeros((len(self.time), 6))
        rows[:, [0, 3, 5]] = np.where(attitude, self.vector_b, self.variance[:, None])
        return rows


def schedule(
    vectors: tuple[VectorMeasurements, ...], start: float, end: float, *, anisotropic: bool = False
) -> Schedule:
    """Return the measurements inside [start, end] in order of time; missing (NaN) ones and those outside are counted as skipped.

    A caller that takes measurements by their ``noise`` says so by ``anisotropic``; otherwise a series that has more than one σ a sample (of
    an attitude one an axis) is refused.
    """
    for series in vectors:
        if series.anisotropic and not anisotropic:
            raise InputError(
                f"{series.sensor}: this filter takes one sigma a sample, not sigma_axes or covariance; use mekf.run, or give sigma"
            )
    parts = [_scheduled(series, start, end) for series in vectors]
    rows = np.cumsum([0, *(len(part.frames) for part in parts)])
    columns = [
        (
            part.time,
            part.value,
            part.variance,
            np.full(len(part.time), i, np.uint8),
            part.frame + np.int32(rows[i]),
            np.full(len(part.time), _KIND_CODES[series.kind], np.uint8),
            *((part.noise,) if any(s.anisotropic for s in vectors) else ()),
        )
        for i, (series, part) in enumerate(zip(vectors, parts, strict=True))
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
    time, value, variance, sensor, reference, kind, *noise = joined
    return Schedule(
        time=time,
        kind=kind,
        vector_b=np.ascontiguousarray(value),
        variance=variance,
        sensor=sensor,
        reference=reference,
        triads=np.concatenate([part.frames for part in parts]) if parts else np.empty((0, 9)),
        sensors=tuple(series.sensor for series in vectors),
        kinds=tuple(series.kind for series in vectors),
        skipped={s.sensor: len(s.time) - len(part.time) for s, part in zip(vectors, parts, strict=True)},
        noise=noise[0] if noise else None,
    )


@dataclass(frozen=True, kw_only=True)
class _Part:
    """The usable measurements of one series."""

    time: Array
    value: Array
    variance: Array
    frame: np.ndarray
    """Rows of ``frames``."""
    frames: Array
    """(rows, 9)."""
    series: VectorMeasurements
    length: Array | float = 1.0
    """Lengths of the references of whole vectors."""

    @property
    def noise(self) -> Array:
        """Upper triangles of the covariances (m, 6) over the squared length of the reference."""
        whole = self.series.covariances / np.square(self.length)[..., None, None]
        return np.asarray(whole[:, *np.triu_indices(3)])


def _scheduled(series: VectorMeasurements, start: float, end: float) -> _Part:
    """Return the usable measurements of one series."""
    _need_noise(series)
    inside = slice(*np.searchsorted(series.time, [start, np.nextafter(end, np.inf)]))
    used = series if inside == slice(0, len(series.time)) else series.taken(inside)
    content = used.vector_b if used.attitude is None else used.attitude
    if not np.isfinite(content).all():
        used = used.taken(np.isfinite(content).all(axis=1))
    if used.attitude is not None:
        assert used.sigma_axes is not None
        frames = np.zeros((len(used.time), 9))
        frames[:, :4] = used.attitude
        return _Part(
            time=used.time,
            value=used.sigma_axes**2,
            variance=used.sigma**2,
            frame=np.arange(len(used.time), dtype=np.int32),
            frames=frames,
            series=used,
        )
    moving = used.reference_f.ndim == 2
    frame = np.arange(len(used.time), dtype=np.int32) if moving else np.zeros(len(used.time), np.int32)
    value, variance = used.vector_b, used.sigma**2
    length: Array | float = 1.0
    if used.kind == "vector":
        # A vector is taken over the length of its reference, so that the kernel sees unit references only.
        length = np.asarray(np.linalg.norm(used.reference_f, axis=-1))
        value, variance = value / (length[:, None] if moving else length), variance / length**2
    return _Part(
        time=used.time,
        value=value,
        variance=variance,
        frame=frame,
        frames=triad(used.reference_f).reshape(-1, 9),
        series=used,
        length=length,
    )


def _need_noise(series: VectorMeasurements) -> None:
    """Refuse a series with a noise of zero about some axis."""
    if not np.all(series.sigma > 0.0):
        k = int(np.argmin(series.sigma > 0.0))
        raise InputError(f"{series.sensor}: sigma[{k}] is 0 rad; a filter needs a noise greater than zero")
    if series.sigma_axes is not None and not np.all(series.sigma_axes > 0.0):
        k = int(np.argmin(np.all(series.sigma_axes > 0.0, axis=1)))
        raise InputError(
            f"{series.sensor}: sigma_axes[{k}] has a 0; a filter needs a noise greater than zero about each axis"
        )
    if series.covariance is not None and len(series.time):
        # A (3, 3) spread over all samples is one matrix.
        whole = series.covariance[:1] if series.covariance.strides[0] == 0 else series.covariance
        spread = np.linalg.eigvalsh(whole)
        if np.any(spread[:, 0] <= 1e-12 * spread[:, -1]):
            k = int(np.argmin(spread[:, 0] / spread[:, -1]))
            raise InputError(
                f"{series.sensor}: covariance[{k}] is singular; a filter needs a noise greater than zero in every direction"
            )


def innovations_by_sensor(events: Schedule, rows: Array, weight: Array | None = None) -> dict[str, Innovations]:
    """Return what a kernel wrote of each event, e₁, s₁, e₂, s₂, …, by sensor, as many as each has degrees of freedom."""
    result = {}
    for i, (sensor, kind) in enumerate(zip(events.sensors, events.kinds, strict=True)):
        mine = slice(None) if len(events.sensors) == 1 else events.sensor == i
        filled = rows[mine, : 2 * KINDS[kind]]
        result[sensor] = Innovations(
            time=events.time[mine],
            innovation=filled[:, 0::2],
            variance=filled[:, 1::2],
            weight=None if weight is None else weight[mine],
        )
    return result


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int = 1,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
    monitor: Monitor | None = None,
) -> Estimate:
    """Run the filter over a whole record, compiled.

    Gyro intervals are split exactly at the times of measurements. Intervals in which the body turns by more than a third of a radian are
    taken in sub-steps of the same constant-rate model. Missing measurements and those outside the record are counted as skipped; gaps of
    the gyro are told as events.

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
    gate : Gate, optional
        Refuse measurements that no right filter would see, and recover where they agree with each other. Default: take in all.
    robust : Robust, optional
        Weigh measurements by how far they lie off. Default: all alike.
    monitor : Monitor, optional
        Report when the running NIS leaves its bounds. Default: do not watch it.

    Returns
    -------
    Estimate
    """
    return run_on(
        record,
        process_noise,
        initial,
        every=every,
        full_covariance=full_covariance,
        gate=gate,
        robust=robust,
        monitor=monitor,
    )[0]


def run_on(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int = 1,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
    monitor: Monitor | None = None,
) -> tuple[Estimate, State]:
    """Run the filter and return the end state too, from which the next part of a record goes on, bit for bit.

    A gate's count of refusals, its challenger and a monitor start anew in each part.
    """
    events = schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    estimate, end, _ = run_events(
        record,
        events,
        process_noise,
        initial,
        every=every,
        full_covariance=full_covariance,
        segments=0,
        gate=gate,
        robust=robust,
        monitor=monitor,
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
    gate: Gate | None = None,
    robust: Robust | None = None,
    monitor: Monitor | None = None,
) -> tuple[Estimate, Array, Array]:
    """Run the kernel over scheduled events; return the estimate, the packed end state (28,), and up to ``segments`` predicted segments.

    A segment (32,) is what a smoother needs of one prediction: dt, increment (3), packed state (28) that it starts from. Where any are
    asked for, one row more follows them: the end state, from which nothing is predicted (dt and increment 0).
    """
    count("every", every)
    rows = (len(record.increments)) // every + 1
    states = np.empty((2, 28))
    state = states[0]
    state[:] = pack(initial.attitude, initial.bias, initial.covariance)
    attitude, bias, variance = np.empty((rows, 4)), np.empty((rows, 3)), np.empty((rows, 6))
    blocks = np.empty((rows if full_covariance else 0, 21))
    plain = gate is None and robust is None and events.noise is None
    width = max([4, *(2 * KINDS[kind] for kind in events.kinds)]) if plain else 6
    innovation = np.empty((len(events.time), width))
    stored = np.empty((segments + 1 if segments else 0, 32))
    weight, recoveries = None, np.empty((0, 4))
    if plain:
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
    else:
        options = _KernelOptions.of(gate, robust, initial)
        weight = np.empty(len(events.time))
        # A recovery takes at least two refusals.
        recoveries = np.empty((len(events.time) // 2, 4))
        number, recovered = compiled(robust_loop.run_robust)(
            record.time,
            np.ascontiguousarray(record.increments),
            process_noise.angle_random_walk**2,
            process_noise.rate_random_walk**2,
            events.time,
            events.kind,
            events.sensor,
            events.vector_b,
            events.body_noise,
            events.reference,
            events.triads,
            options.thresholds,
            options.robust,
            options.robust_parameters,
            options.robust_passes,
            options.recovery,
            options.restart_attitude_variance,
            options.restart_bias_variance,
            np.zeros(len(events.sensors), np.int64),
            states,
            every,
            attitude,
            bias,
            variance,
            blocks,
            innovation,
            weight,
            recoveries,
            stored[:segments],
        )
        recoveries = recoveries[:recovered]
    if segments:
        stored[number, :4] = 0.0
        stored[number, 4:] = state
    told = [*gaps(record.time), *_recovery_events(recoveries, events.sensors)]
    if monitor is not None:
        told += monitor.watch(*_nis_in_order(events, innovation, weight, gate))
    estimate = Estimate(
        time=record.time[::every],
        attitude=attitude,
        bias=bias,
        variance=variance,
        covariance=covariance_matrices(blocks) if full_covariance else None,
        innovations=innovations_by_sensor(events, innovation, weight),
        skipped=events.skipped,
        events=tuple(sorted(told, key=lambda event: event.start)),
    )
    return estimate, state, stored[: number + 1]


@dataclass(frozen=True, kw_only=True)
class _KernelOptions:
    """A gate and a robust update as the kernel takes them."""

    thresholds: Array
    robust: int
    robust_parameters: Array
    robust_passes: int
    recovery: int
    restart_attitude_variance: float
    restart_bias_variance: Array

    @classmethod
    def of(cls, gate: Gate | None, robust: Robust | None, initial: State) -> _KernelOptions:
        return cls(
            thresholds=np.full(3, np.inf) if gate is None else gate.thresholds,
            robust=0 if robust is None else {"huber": robust_step.HUBER, "student": robust_step.STUDENT}[robust.kind],
            robust_parameters=np.ones((3, 2)) if robust is None else robust.parameters,
            robust_passes=0 if robust is None else robust.iterations,
            recovery=0 if gate is None else gate.recovery or 0,
            restart_attitude_variance=0.0 if gate is None else gate.restart_attitude_sigma**2,
            restart_bias_variance=np.zeros(3) if gate is None else gate.restart_bias_variance(initial.covariance),
        )


def gaps(time: Array, factor: float = GAP_FACTOR) -> list[Event]:
    """Return the gyro intervals that are more than ``factor`` times as long as the median interval, as events."""
    steps = np.diff(time)
    usual = float(np.median(steps))
    return [
        Event(kind="gap", start=float(time[k]), end=float(time[k + 1]), value=float(steps[k] / usual))
        for k in np.flatnonzero(steps > factor * usual)
    ]


def _recovery_events(rows: Array, sensors: tuple[str, ...]) -> list[Event]:
    return [
        Event(kind="recovery", start=float(since), end=float(time), sensor=sensors[int(sensor)], value=float(number))
        for time, sensor, since, number in rows
    ]


def _nis_in_order(
    events: Schedule, innovation: Array, weight: Array | None, gate: Gate | None
) -> tuple[Array, Array, np.ndarray]:
    """Return times, NIS and degrees of freedom of all measurements in order; of refused ones the gate's threshold."""
    degrees = np.array([KINDS[kind] for kind in events.kinds], np.int64)[events.sensor]
    each = innovation[:, 0::2] ** 2 / innovation[:, 1::2]
    nis = np.sum(np.where(np.arange(each.shape[1]) < degrees[:, None], each, 0.0), axis=1)
    if gate is not None and weight is not None:
        nis = np.where(weight > 0.0, nis, gate.thresholds[degrees - 1])
    return events.time, nis, degrees


Measured = Callable[[Array], Rows]
"""A measurement as a function of the attitude it is linearised at."""


class StepFilter(filterpy.kalman.ExtendedKalmanFilter):  # type: ignore[misc]
    """The same filter step by step, on filterpy: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K`` and ``Saver`` work as its users expect.

    ``x`` is the error state (δθ, δb) (6,): zero before and after each update, because the correction moves into ``attitude`` and
    ``bias``; ``x_post`` keeps the last correction. ``attitude`` (4,) is q_fb, ``bias`` (3,) in rad/s, ``time`` in s, ``nis`` that of the
    last measurement and ``weight`` that it was taken in with. ``refused`` counts by sensor what the gate refused, ``late`` what came later
    than the look-back, ``repeated`` gyro samples without an interval; ``events`` tells of recoveries.

    Parameters
    ----------
    process_noise : ProcessNoise
    initial : State
    gate : Gate, optional
    robust : Robust, optional
    look_back : float
        s; a measurement may be given so long after its time. The filter goes back to that time, takes it in, and does again what followed:
        the result is that of the filter which had it in order. What it did in that span is kept, in memory.
    time : float
        Time of the initial state, s.
    """

    def __init__(
        self,
        process_noise: ProcessNoise,
        initial: State,
        *,
        gate: Gate | None = None,
        robust: Robust | None = None,
        look_back: float = 0.0,
        time: float = 0.0,
    ) -> None:
        super().__init__(dim_x=6, dim_z=2)
        self.process_noise = process_noise
        self.gate = gate
        self.robust = robust
        self.look_back = non_negative("look_back", look_back, unit="s")
        self.time = finite("time", time, unit="s")
        self.attitude: Array = initial.attitude.copy()
        self.bias: Array = initial.bias.copy()
        self.x = np.zeros(6)
        self.P = initial.covariance.copy()
        self.y = np.zeros(2)
        self.nis = 0.0
        self.weight = 1.0
        self.late = 0
        self.repeated = 0
        self.refused: dict[str, int] = {}
        self.events: tuple[Event, ...] = ()
        self._initial_covariance = initial.covariance
        self._passes = 1
        self._in_a_row: dict[str, int] = {}
        self._challenger: _Challenger | None = None
        self._done: list[_Done] = []

    def predict(self, delta_theta: ArrayLike, dt: float) -> None:
        """Propagate over one gyro increment (3,), rad, of dt seconds; a repeated sample (dt = 0) is counted and changes nothing."""
        increment = array("delta_theta", delta_theta, (3,))
        step = non_negative("dt", dt, unit="s")
        if step == 0.0:
            self.repeated += 1
            return
        self._remember(_Done(kept=self._kept(), dt=step, increment=increment))
        self._predict(increment, step)

    def _predict(self, increment: Array, step: float) -> None:
        parts = int(np.linalg.norm(increment) / LARGEST_ANGLE) + 1
        for _ in range(parts):
            phi = increment / parts - self.bias * (step / parts)
            self.F, self.Q = transition_and_noise(phi, step / parts, self.process_noise)
            super().predict()
            self.attitude = quaternion.normalize(quaternion.multiply(self.attitude, quaternion.exp(phi)))
        self.time += step
        if self._challenger is not None:
            self._challenger.filter._predict(increment, step)

    def update_direction(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        covariance: ArrayLike | None = None,
        sensor: str = "",
        time: float | None = None,
    ) -> bool:
        """Update with a measured unit direction (3,) of a known one (3,): two degrees of freedom.

        The noise is ``sigma``, rad across it, or one each body axis (3,), or ``covariance`` (3, 3) in body axes, of which the part across
        the direction counts. ``sensor`` names what the gate counts by; ``time`` is that of validity, s, if it is not now. Returns whether
        it was taken in.
        """
        z = array("vector_b", vector_b, (3,))
        frame = triad(array("reference_f", reference_f, (3,)))
        C = _body_covariance(sigma, covariance)

        def rows(attitude: Array) -> Rows:
            u, v, r = frame @ quaternion.to_matrix(attitude)
            basis = np.stack([u, v])
            H = np.stack([-v, u])
            return basis @ z, H, basis @ C @ basis.T, *_arc(basis @ z, float(r @ z))

        return self._measure(rows, sensor, time)

    def update_vector(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        covariance: ArrayLike | None = None,
        sensor: str = "",
        time: float | None = None,
    ) -> bool:
        """Update with a measured vector (3,) of a known one (3,), noise in their unit: three degrees of freedom. Else as a direction."""
        r = array("reference_f", reference_f, (3,))
        z = array("vector_b", vector_b, (3,))
        frame = triad(r)
        length = float(np.linalg.norm(r))
        C = _body_covariance(sigma, covariance)

        def rows(attitude: Array) -> Rows:
            basis = frame @ quaternion.to_matrix(attitude)
            H = np.stack([-length * basis[1], length * basis[0], np.zeros(3)])
            residual = basis @ z - np.array([0.0, 0.0, length])
            arc = _arc(residual[:2] / length, float(basis[2] @ z) / length)
            return residual, H, basis @ C @ basis.T, *arc

        return self._measure(rows, sensor, time)

    def update_heading(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: float,
        *,
        sensor: str = "",
        time: float | None = None,
    ) -> bool:
        """Update with the heading of a measured vector's horizontal part: one degree of freedom, ``sigma`` rad."""
        z = array("vector_b", vector_b, (3,))
        reference = array("reference_f", reference_f, (3,))
        variance = positive("sigma", sigma, unit="rad") ** 2

        def rows(attitude: Array) -> Rows:
            R = quaternion.to_matrix(attitude)
            m = R @ z
            error = filter_loop.heading_error(tuple(R.ravel()), z, reference)
            H = (np.array([*(-m[2] * m[:2] / (m[:2] @ m[:2])), 1.0]) @ R)[None]
            return np.array([error]), H, np.array([[variance]]), 0.0, 1.0

        return self._measure(rows, sensor, time, of_heading=True)

    def update_attitude(
        self,
        attitude: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        covariance: ArrayLike | None = None,
        sensor: str = "",
        time: float | None = None,
    ) -> bool:
        """Update with a measured attitude q_fb (4,): three degrees of freedom, noise in rad about the body axes. Else as a direction."""
        measured = unit_quaternions("attitude", array("attitude", attitude, (4,)))
        C = _body_covariance(sigma, covariance)

        def rows(estimate: Array) -> Rows:
            residual = quaternion.log(quaternion.multiply(quaternion.conjugate(estimate), measured))
            return residual, np.eye(3), C, 0.0, 1.0

        return self._measure(rows, sensor, time)

    def _measure(self, rows: Measured, sensor: str, time: float | None, of_heading: bool = False) -> bool:
        """Take in a measurement now, or at its time and what followed after it."""
        when = self.time if time is None else finite("time", time, unit="s")
        if when > self.time:
            raise InputError(f"time is {when:.9g} s, after the filter's {self.time:.9g} s; predict up to it first")
        if when == self.time:
            return self._take_now(rows, sensor, of_heading)
        if when < self.time - self.look_back or not self._done or when < self._done[0].kept["time"]:
            self.late += 1
            return False
        first = next(k for k, done in enumerate(self._done) if done.end > when)
        after, self._done = self._done[first:], self._done[:first]
        self._restore(after[0].kept)
        split, after = after[0], after[1:]
        head = when - self.time
        if head > 0.0:
            self._again(_Done(kept=self._kept(), dt=head, increment=split.increment * (head / split.dt)))
        accepted = self._take_now(rows, sensor, of_heading)
        rest = split.dt - head
        self._again(_Done(kept=self._kept(), dt=rest, increment=split.increment * (rest / split.dt)))
        for done in after:
            self._again(done)
        return accepted

    def _take_now(self, rows: Measured, sensor: str, of_heading: bool) -> bool:
        self._remember(_Done(kept=self._kept(), rows=rows, sensor=sensor, of_heading=of_heading))
        accepted = self._correct(rows, of_heading)
        if not accepted:
            self.refused[sensor] = self.refused.get(sensor, 0) + 1
        if self.gate is not None:
            self._oversee(rows, sensor, accepted, of_heading)
        return bool(accepted)

    def _correct(self, rows: Measured, of_heading: bool) -> bool | None:
        """Take in a measurement; return whether it was, None where it was passed over."""
        threshold = np.inf if self.gate is None else float(self.gate.thresholds[len(rows(self.attitude)[0]) - 1])
        seen = linearise(rows, self.attitude, self.P, self._passes, threshold)
        self.nis = seen.nis
        self.dim_z = len(seen.residual)
        unknown = self._passes > 1 and of_heading and tilt_unknown(self.attitude, self.P)
        if unknown or not seen.acceptable(threshold):
            self.weight = 0.0
            self.y, self.S = seen.innovation, seen.predicted + seen.noise
            return None if unknown else False
        self.weight = 1.0 if self.robust is None else seen.weight(self.robust)
        self.attitude, self.P = seen.attitude, seen.covariance
        self.x = np.array([*seen.prior, 0.0, 0.0, 0.0])
        H = np.hstack([seen.H, np.zeros((self.dim_z, 3))])
        super().update(seen.residual, HJacobian=lambda x: H, Hx=lambda x: H @ x, R=seen.noise / self.weight)
        correction = self.x[:3]
        self.attitude = quaternion.normalize(quaternion.multiply(self.attitude, quaternion.exp(correction)))
        self.bias = self.bias + self.x[3:]
        G = np.eye(6)
        G[:3, :3] = kinematics.right_jacobian(correction)
        self.P = G @ self.P @ G.T
        self.P_post = self.P.copy()
        self.x = np.zeros(6)
        return True

    def _oversee(self, rows: Measured, sensor: str, accepted: bool | None, of_heading: bool) -> None:
        """Count refusals, and start, drop or follow a challenger (:class:`strapdown.robustness.Gate`)."""
        gate = self.gate
        assert gate is not None
        in_a_row = self._in_a_row.get(sensor, 0)
        if accepted is not None:
            self._in_a_row[sensor] = 0 if accepted else in_a_row + 1
        if not gate.recovery:
            return
        if accepted is False and self._challenger is None:
            self._challenger = _Challenger(filter=self._restarted(gate), since=self.time)
        rival = self._challenger
        if rival is None:
            return
        agreed = rival.filter._correct(rows, of_heading)
        if agreed is False:
            rival.misses += 1
        elif agreed and self._in_a_row.get(sensor, 0) > 0:
            rival.hits += 1
        if rival.misses > rival.hits or not any(self._in_a_row.values()):
            self._challenger = None
        elif self._in_a_row.get(sensor, 0) >= gate.recovery and rival.hits >= gate.recovery:
            number = self._in_a_row[sensor]
            told = Event(kind="recovery", start=rival.since, end=self.time, sensor=sensor, value=float(number))
            self.events = (*self.events, told)
            self.attitude, self.bias, self.P = rival.filter.attitude, rival.filter.bias, rival.filter.P
            self._passes = WIDE_PASSES
            self._in_a_row = {}
            self._challenger = None

    def _restarted(self, gate: Gate) -> StepFilter:
        P = np.zeros((6, 6))
        P[:3, :3] = gate.restart_attitude_sigma**2 * np.eye(3)
        P[3:, 3:] = self.P[3:, 3:] + np.diag(gate.restart_bias_variance(self._initial_covariance))
        state = State(attitude=self.attitude, bias=self.bias, covariance=P)
        rival = StepFilter(self.process_noise, state, gate=gate, robust=self.robust, time=self.time)
        rival._passes = WIDE_PASSES
        return rival

    def _remember(self, done: _Done) -> None:
        """Keep what is done for as long as a measurement may still come in before it."""
        if self.look_back == 0.0:
            return
        self._done.append(done)
        while self._done[0].end < self.time - self.look_back:
            del self._done[0]

    def _again(self, done: _Done) -> None:
        if done.rows is None:
            self._remember(_Done(kept=self._kept(), dt=done.dt, increment=done.increment))
            self._predict(done.increment, done.dt)
        else:
            self._take_now(done.rows, done.sensor, done.of_heading)

    def _kept(self) -> dict[str, Any]:
        """Return what must come back when the filter goes back to this moment; nothing where it never does."""
        if self.look_back == 0.0:
            return {}
        rival = self._challenger
        return {
            "time": self.time,
            "attitude": self.attitude,
            "bias": self.bias,
            "P": self.P.copy(),
            "refused": dict(self.refused),
            "events": self.events,
            "_passes": self._passes,
            "_in_a_row": dict(self._in_a_row),
            "_challenger": None if rival is None else copy.deepcopy(rival),
        }

    def _restore(self, kept: dict[str, Any]) -> None:
        for name, value in kept.items():
            setattr(self, name, value)


@dataclass(frozen=True, kw_only=True)
class _Done:
    """A prediction, or a measurement, that the step face took in, with what it was before."""

    kept: dict[str, Any]
    dt: float = 0.0
    increment: Array = field(default_factory=lambda: np.zeros(3))
    rows: Measured | None = None
    sensor: str = ""
    of_heading: bool = False

    @property
    def end(self) -> float:
        """Time after it, s."""
        return float(self.kept["time"]) + self.dt


@dataclass(kw_only=True)
class _Challenger:
    """A filter beside the filter, and how it did."""

    filter: StepFilter
    since: float
    hits: int = 0
    misses: int = 0


def _body_covariance(sigma: ArrayLike | None, covariance_b: ArrayLike | None) -> Array:
    """Return the covariance (3, 3) in body axes of one σ, one an axis, or itself."""
    if (sigma is None) == (covariance_b is None):
        raise InputError("give either sigma or covariance: the noise of the measurement")
    if sigma is None:
        return covariance("covariance", np.asarray(covariance_b), 3)
    spread = np.array([positive("sigma", value) for value in np.broadcast_to(np.asarray(sigma, np.float64), 3)])
    return np.diag(spread**2)


def _arc(across: Array, along: float) -> tuple[float, float]:
    """Return the angle between a measured and a predicted direction, rad, and that over the length of the part across."""
    sine = float(np.linalg.norm(across))
    angle = math.atan2(sine, along)
    return angle, 1.0 if sine < 1e-9 else angle / sine


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
