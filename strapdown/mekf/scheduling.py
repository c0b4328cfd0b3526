"""Measurements of all sensors in one order of time, as the kernels take them, and their innovations sorted back by sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.kernels import filter_loop
from strapdown.kernels.machine import compiled
from strapdown.records import Innovations
from strapdown.vectors import KINDS, VectorMeasurements, triad

_KIND_CODES = {
    "direction": filter_loop.DIRECTION,
    "vector": filter_loop.VECTOR,
    "heading": filter_loop.HEADING,
    "attitude": filter_loop.ATTITUDE,
}


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
        first = [np.ascontiguousarray(column) for column in joined[:6]]
        sorted_columns = tuple(np.empty_like(column) for column in first)
        compiled(filter_loop.gather_events)(order, *first, sorted_columns)
        joined = [*sorted_columns, *(np.take(column, order, axis=0) for column in joined[6:])]
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
    if len(events.sensors) == 1:
        time, parted = events.time, rows
        bounds = np.array([0, len(rows)])
    else:
        bounds = np.concatenate([[0], np.cumsum(np.bincount(events.sensor, minlength=len(events.sensors)))])
        time, parted = np.empty_like(events.time), np.empty_like(rows)
        compiled(filter_loop.part_by_sensor)(events.sensor, events.time, rows, bounds[:-1].copy(), time, parted)
    result = {}
    for i, (sensor, kind) in enumerate(zip(events.sensors, events.kinds, strict=True)):
        mine = slice(bounds[i], bounds[i + 1])
        filled = parted[mine, : 2 * KINDS[kind]]
        result[sensor] = Innovations(
            time=time[mine],
            innovation=filled[:, 0::2],
            variance=filled[:, 1::2],
            weight=None if weight is None else weight if len(events.sensors) == 1 else weight[events.sensor == i],
        )
    return result
