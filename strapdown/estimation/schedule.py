"""Measurements of all sensors in order of time, as the kernels' arguments, and their innovations by sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from strapdown.checks import Array, InputError, are_finite
from strapdown.kernels import measurement
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.measurement import KIND_CODES
from strapdown.records import Estimate, Innovations
from strapdown.vectors import KINDS, VectorMeasurements, triad


@dataclass(frozen=True, kw_only=True, eq=False)
class Schedule:
    """Measurements of all sensors and their order of time. Simultaneous ones keep the order of the sensors.

    The measured values stay in the arrays of their series. The columns in order of time are computed on request.
    """

    series_time: tuple[Array, ...]
    """Times (m,) of each sensor, s."""
    series_vector_b: tuple[Array, ...]
    """Measured vectors over the length of their references (m, 3) of each sensor; for an attitude its three variances."""
    series_sigma: tuple[Array, ...]
    """σ of each component of the vector (m,) of each sensor."""
    noise_by_axis: Array | None = None
    """Upper triangles of the covariances in body axes (events, 6), over the squared lengths of the references, one sensor after the
    other, if any sensor is anisotropic."""
    bounds: np.ndarray
    """Index of each sensor's first event, and the number of events, with one sensor after the other (sensors + 1,)."""
    codes: np.ndarray
    """Code of each sensor's kind in :mod:`strapdown.kernels.measurement` (sensors,)."""
    frames: np.ndarray
    """Row of ``triads`` of each sensor's first event, and step in rows to the next event's, 0 or 1 (sensors, 2)."""
    triads: Array
    """Right-handed frames (u, v, r) about the references r (rows, 9), one per sensor or one per measurement; for an attitude the measured
    quaternion."""
    sensors: tuple[str, ...]
    kinds: tuple[str, ...]
    skipped: dict[str, int]

    @cached_property
    def order(self) -> tuple[Array, np.ndarray, np.ndarray]:
        """Time, row (one sensor after the other) and sensor of each event, in order of time (events,)."""
        number = int(self.bounds[-1])
        # One byte for the sensor if possible: the loops read it for each event.
        narrow = np.uint8 if len(self.sensors) <= 256 else np.uint32
        time, row, sensor = np.empty(number), np.empty(number, np.uint32), np.empty(number, narrow)
        first, *others = self.series_time or (np.empty(0),)
        if all(np.array_equal(first, other) for other in others):
            compiled(measurement.common_order)(first, len(self.sensors), time, row, sensor)
        else:
            held_time = np.concatenate(self.series_time)
            compiled(measurement.merge_order)(held_time, self.bounds[:-1].copy(), self.bounds[1:], time, row, sensor)
        return time, row, sensor

    @property
    def time(self) -> Array:
        """Times in order (events,), s."""
        return self.order[0]

    @property
    def row(self) -> np.ndarray:
        """Row of each event, one sensor after the other, in order of time (events,)."""
        return self.order[1]

    @property
    def sensor(self) -> np.ndarray:
        """Index of the sensor of each event, in order of time (events,)."""
        return self.order[2]

    @cached_property
    def vector_b(self) -> Array:
        """Measured vectors in order of time (events, 3)."""
        return self._ordered(_joined(self.series_vector_b, (0, 3)))

    @cached_property
    def variance(self) -> Array:
        """Variances in order of time (events,)."""
        return self._ordered(_joined(self.series_sigma, (0,)) ** 2)

    @cached_property
    def noise(self) -> Array | None:
        """Upper triangles of the covariances in order of time (events, 6), if any is anisotropic."""
        return None if self.noise_by_axis is None else self._ordered(self.noise_by_axis)

    @cached_property
    def kind(self) -> np.ndarray:
        """Codes in order of time (events,)."""
        return np.asarray(self.codes[self.sensor])

    @cached_property
    def reference(self) -> np.ndarray:
        """Row of ``triads`` of each event in order of time (events,)."""
        first, step = self.frames.T
        rows = first[self.sensor] + step[self.sensor] * (self.row - self.bounds[self.sensor])
        return np.asarray(rows, dtype=np.int32)

    def _ordered(self, column: Array) -> Array:
        return column if len(self.sensors) < 2 else np.take(column, self.row, axis=0)

    @cached_property
    def measurements(self) -> measurement.Measurements:
        """Measurements as the kernels' argument."""
        value, sigma = _joined(self.series_vector_b, (0, 3)).reshape(-1), _joined(self.series_sigma, (0,))
        series = np.column_stack([self.codes.astype(np.int64), self.bounds[:-1], self.frames])
        noise = np.empty((0, 6)) if self.noise_by_axis is None else self.noise_by_axis
        columns = (*self.order, value, sigma, noise, series, self.triads)
        return measurement.Measurements(*map(read_only, columns))

    @property
    def body_noise(self) -> Array:
        """Upper triangle of each measurement's covariance in body axes (events, 6); for a heading the first number is its variance."""
        if self.noise is not None:
            return self.noise
        attitude = (self.kind == measurement.ATTITUDE)[:, None]
        rows = np.zeros((len(self.time), 6))
        rows[:, [0, 3, 5]] = np.where(attitude, self.vector_b, self.variance[:, None])
        return rows


def schedule(vectors: tuple[VectorMeasurements, ...], start: float, end: float) -> Schedule:
    """Return the measurements inside [start, end] in order of time; missing (NaN) ones and those outside are counted as skipped."""
    parts = [_scheduled(series, start, end) for series in vectors]
    bounds = np.array([0, *accumulate(len(part.series.time) for part in parts)])
    first_frames = [0, *accumulate(len(part.frames) for part in parts)]
    return Schedule(
        series_time=tuple(read_only(part.series.time) for part in parts),
        series_vector_b=tuple(read_only(part.value) for part in parts),
        series_sigma=tuple(read_only(part.sigma) for part in parts),
        noise_by_axis=_joined([part.noise for part in parts], (0, 6)) if any(s.anisotropic for s in vectors) else None,
        bounds=bounds,
        codes=np.array([KIND_CODES[series.kind] for series in vectors], np.uint8),
        frames=np.array(
            [(first, part.moving) for first, part in zip(first_frames, parts, strict=False)], np.int64
        ).reshape(-1, 2),
        triads=_joined([part.frames for part in parts], (0, 9)),
        sensors=tuple(series.sensor for series in vectors),
        kinds=tuple(series.kind for series in vectors),
        skipped={s.sensor: len(s.time) - len(part.series.time) for s, part in zip(vectors, parts, strict=True)},
    )


def _joined(columns: Sequence[Array], empty: tuple[int, ...]) -> Array:
    """Return the columns one after the other, contiguous; a single one is not copied."""
    if len(columns) == 1:
        return np.ascontiguousarray(columns[0])
    return np.concatenate(columns) if columns else np.empty(empty)


class _Part(NamedTuple):
    """The usable measurements of one series."""

    series: VectorMeasurements
    value: Array
    sigma: Array
    moving: bool
    """Whether the reference changes between measurements."""
    frames: Array
    """(rows, 9)."""
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
    used = series
    if len(series.time) and not (start <= series.time[0] and series.time[-1] <= end):
        used = series.taken(slice(*np.searchsorted(series.time, [start, np.nextafter(end, np.inf)])))
    content = used.vector_b if used.attitude is None else used.attitude
    # One non-finite number makes the sum non-finite; a sum needs no memory.
    if not np.isfinite(content.sum()):
        used = used.taken(are_finite(content))
    if used.attitude is not None:
        assert used.sigma_axes is not None
        frames = np.zeros((len(used.time), 9))
        frames[:, :4] = used.attitude
        return _Part(used, used.sigma_axes**2, used.sigma, True, frames)
    moving = used.reference_f.ndim == 2
    value, sigma = used.vector_b, used.sigma
    length: Array | float = 1.0
    if used.kind == "vector":
        # A vector is divided by the length of its reference, so that the kernel sees unit references only.
        length = np.asarray(np.linalg.norm(used.reference_f, axis=-1))
        value, sigma = value / (length[:, None] if moving else length), sigma / length
    return _Part(used, value, sigma, moving, triad(used.reference_f).reshape(-1, 9), length)


def _need_noise(series: VectorMeasurements) -> None:
    """Refuse a series with a noise of zero about some axis."""
    if len(series.sigma) and not series.sigma.min() > 0.0:
        k = int(np.argmin(series.sigma > 0.0))
        raise InputError(f"{series.sensor}: sigma[{k}] is 0 rad; a filter needs a noise greater than zero")
    if series.sigma_axes is not None and not np.all(series.sigma_axes > 0.0):
        k = int(np.argmin(np.all(series.sigma_axes > 0.0, axis=1)))
        raise InputError(
            f"{series.sensor}: sigma_axes[{k}] has a 0; a filter needs a noise greater than zero about each axis"
        )
    if series.covariance is not None and len(series.time):
        # A (3, 3) broadcast over all samples is one matrix.
        whole = series.covariance[:1] if series.covariance.strides[0] == 0 else series.covariance
        spread = np.linalg.eigvalsh(whole)
        if np.any(spread[:, 0] <= 1e-12 * spread[:, -1]):
            k = int(np.argmin(spread[:, 0] / spread[:, -1]))
            raise InputError(
                f"{series.sensor}: covariance[{k}] is singular; a filter needs a noise greater than zero in every direction"
            )


def innovations_by_sensor(events: Schedule, rows: Array, weight: Array | None = None) -> dict[str, Innovations]:
    """Return the innovations written by a kernel, e₁, s₁, e₂, s₂, … per measurement, by sensor, with their degrees of freedom.

    Headings of a vertical vector, whose row is NaN, are omitted (:func:`skipped_too`).
    """
    result = {}
    for i, (sensor, kind) in enumerate(zip(events.sensors, events.kinds, strict=True)):
        mine = slice(events.bounds[i], events.bounds[i + 1])
        e, s = rows[mine, 0 : 2 * KINDS[kind] : 2], rows[mine, 1 : 2 * KINDS[kind] : 2]
        share = None if weight is None else weight[mine]
        innovations = Innovations(time=events.series_time[i], innovation=e, variance=s, weight=share)
        if kind == "heading" and np.isnan(np.sum(e)):
            innovations = selected(innovations, ~np.isnan(e[:, 0]))
        result[sensor] = innovations
    return result


def selected(innovations: Innovations, which: np.ndarray) -> Innovations:
    """Return the innovations of the measurements selected by a mask (m,)."""
    return replace(
        innovations, **{name: value[which] for name, value in vars(innovations).items() if value is not None}
    )


def skipped_too(events: Schedule, innovations: Mapping[str, Innovations]) -> dict[str, int]:
    """Return the number of skipped measurements by sensor: those that were not scheduled, and headings of a vertical vector."""
    return {
        sensor: events.skipped[sensor] + len(time) - len(innovations[sensor].time)
        for sensor, time in zip(events.sensors, events.series_time, strict=True)
    }


def joined(parts: Sequence[Estimate]) -> Estimate:
    """Return the estimates of successive parts of a record as one; at a common edge, the row of the first part."""
    if len(parts) == 1:
        return parts[0]

    def rows(*values: Array | None) -> Any:
        return (
            None if values[0] is None else np.concatenate([v[k > 0 :] for k, v in enumerate(values) if v is not None])
        )

    names = ("time", "attitude", "bias", "variance", "covariance", "whole_covariance")
    innovations = {}
    for sensor in dict.fromkeys(name for part in parts for name in part.innovations):
        own = [part.innovations[sensor] for part in parts if sensor in part.innovations]
        weights = [part.weight for part in own if part.weight is not None]
        innovations[sensor] = Innovations(
            time=np.concatenate([part.time for part in own]),
            innovation=np.concatenate([part.innovation for part in own]),
            variance=np.concatenate([part.variance for part in own]),
            weight=np.concatenate(weights) if len(weights) == len(own) else None,
        )
    blocks = {
        name: replace(
            block,
            values=rows(*(part.error_states[name].values for part in parts)),
            variance=rows(*(part.error_states[name].variance for part in parts)),
        )
        for name, block in parts[0].error_states.items()
    }
    # A lock-out that continues is reported by each part, by the last as a whole.
    events = {(event.kind, event.sensor, event.start): event for part in parts for event in part.events}
    return replace(
        parts[0],
        innovations=innovations,
        events=tuple(events.values()),
        error_states=blocks,
        **{name: rows(*(getattr(part, name) for part in parts)) for name in names},
    )
