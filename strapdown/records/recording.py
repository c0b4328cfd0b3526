"""The recording: point samples of rate, specific force and magnetic field on one time axis, from any file."""

from __future__ import annotations

import copy
import functools
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, increasing, median, not_back, one_of
from strapdown.results import Listed, Table
from strapdown.units import DEGREE, STANDARD_GRAVITY

RATE_UNITS = {"rad/s": 1.0, "deg/s": DEGREE, "mrad/s": 1e-3, "mdeg/s": 1e-3 * DEGREE}
"""Units of a gyro column, and their factor to rad/s."""
FORCE_UNITS = {"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY, "mm/s2": 1e-3}
"""Units of an accelerometer column, and their factor to m/s²."""
MAGNETIC_UNITS = {"T": 1.0, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "G": 1e-4, "mG": 1e-7}
"""Units of a magnetometer column, and their factor to T."""
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of a time column, and their factor to s."""

CLOCK_OFFSET = 1e8
"""Stamps above this, s, count from 1970 or from the start of a machine; the time of a recording then begins at its first stamp."""

BRIDGED = 0.1
"""Maximum interval between two stamps of a reference for interpolation, s."""

GAP = 5.0
"""Minimum interval between stamps that counts as a gap, in median intervals."""

SENSORS = {"gyro": "rate", "accelerometer": "specific_force", "magnetometer": "magnetic_field"}
"""Field of a recording by sensor."""
FIELDS = {**SENSORS, "temperature": "temperature", "reference": "true_attitude", "movement": "movement"}
"""Field by what a recording may contain."""
_ROWS = ("time", *FIELDS.values())


FEW_REPEATED = 0.01
"""Share of rows with the stamp of the row before and other samples, below which they are left out."""
LONGEST_GAP = 30.0 * 86400.0
"""Maximum interval between samples, s. Longer ones are a clock that was set, and a filter would divide them into millions of steps."""
LARGEST_RATE = 2000.0
"""Maximum rate, rad/s, five times the range of the fastest gyros. Larger values are raw counts or a damaged row, and a filter would divide
each interval into thousands of steps."""
LARGEST_FORCE = 1000.0
"""Maximum specific force, m/s², of a sample that is used: 100 g, beyond the accelerometers of attitude units. A single damaged sample
above it can turn the attitude over, for minutes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording(Listed):
    """A recording of one inertial measurement unit.

    Parameters
    ----------
    source : str
        Name of the file or object that the recording was read from.
    time : ndarray (n,)
        Time stamps, s, increasing.
    rate : ndarray (n, 3)
        Angular rate at the stamps, rad/s, body axes.
    specific_force : ndarray (n, 3), optional
        Specific force, m/s², body axes: +9.81 along the upward axis at rest. Rows of NaN are missing.
    magnetic_field : ndarray (n, 3), optional
        Magnetic field in any unit, body axes. Rows of NaN are missing.
    magnetic_unit : str, default ""
        Unit of the magnetic field, a key of :data:`MAGNETIC_UNITS`; empty if unknown.
    temperature : ndarray (n,), optional
        Temperature of the sensor, °C; NaN is missing.
    true_attitude : ndarray (n, 4), optional
        Reference attitude q_fb; fixed frame East-North-Up, magnetic North. Rows of NaN are missing.
    movement : ndarray of bool (n,), optional
        Samples over which errors are judged; None: all.
    epoch_ns : int, default 0
        Reading of the source's clock at time 0, ns; nanoseconds since 1970 for a clock that counts from then.
    missing_gyro : ndarray (k,), default empty
        Stamps of rows without a gyro sample, or of zeros, s. These rows are left out (:func:`with_gyro`): the intervals on both sides are
        joined, the rotation is computed from the samples at the ends, and the covariance of a filter grows over the whole interval.
    repeated : ndarray (k,), default empty
        Stamps of rows that repeat the stamp of the row before and add no sensor's sample, s; they are left out. If the share of those with
        other samples is above :data:`FEW_REPEATED`, the file is rejected.
    remarks : tuple of str, default empty
        Choices and omissions of the reader, one sentence each: columns guessed, topics used.
    """

    source: str
    time: Array
    rate: Array
    specific_force: Array | None = None
    magnetic_field: Array | None = None
    magnetic_unit: str = ""
    temperature: Array | None = None
    true_attitude: Array | None = None
    movement: np.ndarray | None = None
    epoch_ns: int = 0
    missing_gyro: Array = field(default_factory=lambda: np.empty(0))
    repeated: Array = field(default_factory=lambda: np.empty(0))
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        time = increasing(f"{self.source}: time", self.time, minimum=2)
        n = len(time)
        if time[-1] - time[0] > LONGEST_GAP and np.max(np.diff(time)) > LONGEST_GAP:
            k = int(np.argmax(np.diff(time)))
            raise InputError(
                f"{self.source}: time[{k + 1}] jumps to {time[k + 1]:.9g} s after {time[k]:.9g} s, as if the clock was set; cut the "
                "recording there"
            )
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "rate", array(f"{self.source}: rate", self.rate, (n, 3)))
        if np.max(np.abs(self.rate)) > LARGEST_RATE:
            row, axis = (int(i) for i in np.unravel_index(np.argmax(np.abs(self.rate)), self.rate.shape))
            raise InputError(
                f"{self.source}: rate[{row}, {axis}] is {self.rate[row, axis]:g} rad/s, which no gyro "
                "measures; convert raw counts by the datasheet, declare another unit, or remove the row"
            )
        for sensor in ("accelerometer", "magnetometer", "reference"):
            name = FIELDS[sensor]
            value = getattr(self, name)
            if value is not None:
                value = array(f"{self.source}: {name}", value, (n, 4 if sensor == "reference" else 3), allow_nan=True)
                if np.isnan(value).all():
                    words = f"The {sensor} has no sample from {time[0]:.3g} s on."
                    object.__setattr__(self, "remarks", (*self.remarks, words))
                    value = None
                elif sensor != "reference" and not np.any(np.abs(value) > 0.0):
                    raise InputError(f"{self.source}: {name} is 0 in every row; leave its columns out")
                object.__setattr__(self, name, value)
        if self.temperature is not None:
            value = array(f"{self.source}: temperature", self.temperature, (n,), allow_nan=True)
            object.__setattr__(self, "temperature", value)
        if self.magnetic_unit:
            one_of(f"{self.source}: magnetic_unit", self.magnetic_unit, MAGNETIC_UNITS)
        for name in ("missing_gyro", "repeated"):
            object.__setattr__(self, name, array(f"{self.source}: {name}", getattr(self, name), ("k",)))
        if self.movement is not None and np.shape(self.movement) != (n,):
            raise InputError(f"{self.source}: movement has shape {np.shape(self.movement)}, wanted ({n},)")

    def listing(self) -> Table:
        """Return each sensor with the magnitudes of its samples, which show a wrong unit, and the reader's remarks, as a table."""
        span = self.time[-1] - self.time[0]
        rows = []
        for name, unit, values in (
            ("gyro", "°/s", self.rate / DEGREE),
            ("accelerometer", "m/s²", self.specific_force),
            ("magnetometer", self.magnetic_unit or "?", self.magnetic_field),
        ):
            if values is not None:
                size = np.linalg.norm(values[~np.isnan(values).any(axis=1)], axis=1)
                ends = (float(np.median(size)), float(size.max())) if len(size) else (None, None)
                rows.append((name, unit, len(size), *ends))
        title = f"{self.source}: {len(self.time)} samples over {span:.6g} s, {(len(self.time) - 1) / span:.4g} Hz"
        notes = [sentence for sentence in (*self.remarks, self.left_out_words) if sentence]
        return Table(title, ("sensor", "unit", "samples", "median size", "largest"), rows, notes, left=2)

    @functools.cached_property
    def interval(self) -> float:
        """Median interval between the stamps, s."""
        steps = np.sort(np.diff(self.time))  # of nearly equal numbers, to select one takes seven times as long
        return float(0.5 * (steps[(len(steps) - 1) // 2] + steps[len(steps) // 2]))

    def taken(self, which: Any) -> Recording:
        """Return the samples that an index selects, such as ``slice(first, None)``.

        Parameters
        ----------
        which : ndarray or slice
            Mask (n,), slice or array of indices, of at least two samples in order of time.

        Returns
        -------
        Recording
            The selected samples.
        """
        parts: dict[str, Any] = {n: None if getattr(self, n) is None else getattr(self, n)[which] for n in _ROWS}
        begin, end = parts["time"][[0, -1]]
        missing, repeated = (x[(begin < x) & (x <= end)] for x in (self.missing_gyro, self.repeated))
        return replace(self, missing_gyro=missing, repeated=repeated, **parts)

    @property
    def clock_ns(self) -> NDArray[np.int64]:
        """Time stamps (n,) of the source's clock, ns."""
        return whole_ns(self.time) + self.epoch_ns

    @property
    def parts(self) -> tuple[str, ...]:
        """Quantities that it contains."""
        return tuple(name for name, field in FIELDS.items() if getattr(self, field) is not None)

    @property
    def left_out_words(self) -> str:
        """Description of the rows that were left out; empty if there are none."""
        words = []
        if len(self.missing_gyro):
            words.append(
                f"{len(self.missing_gyro)} rows without a gyro sample, the first at {self.missing_gyro[0]:.3f} s, were left out, "
                "and other samples in them moved to the nearest row."
            )
        if len(self.repeated):
            words.append(
                f"{len(self.repeated)} rows with the stamp of the row before, the first at {self.repeated[0]:.3f} s, were left out."
            )
        return " ".join(words)


def with_gyro(*, source: str, time: Array, rate: Array, **columns: Any) -> Recording:
    """Return a recording of the rows that have a gyro sample and do not repeat the row before, with the stamps of the other rows.

    A log may have a row for each sensor: rows of one stamp are one, and vectors and temperatures in rows without the gyro go to the nearest
    row with it that lacks them.
    """
    not_back(f"{source}: time", time)  # before rows are left out
    columns = _without_zeros(columns | {"time": time, "rate": rate})
    if (np.diff(time) == 0.0).any():
        columns = _one_row_a_stamp(source, columns)
    known = np.asarray(~np.isnan(columns["rate"]).any(axis=1))
    if not known.all():
        if np.sum(known) < 2:
            raise InputError(
                f"{source}: {np.sum(known)} of {len(known)} rows have a whole gyro sample; at least 2 are needed"
            )
        stamps = increasing(f"{source}: time", columns["time"])
        moved, remarks = {}, columns.get("remarks", ())
        for sensor in ("accelerometer", "magnetometer", "temperature"):
            if (values := columns.get(name := FIELDS[sensor])) is not None and len(values) == len(known):
                there = ~np.isnan(values.reshape(len(values), -1)).any(axis=1)
                moved[name], lost = at_nearest(stamps[known], stamps[there], values[there])
                if lost:
                    remarks += (
                        f"{lost} of {there.sum()} samples of the {sensor} were left out: others are nearer to the gyro's.",
                    )
        columns = _rows(columns, known) | moved | {"missing_gyro": stamps[~known], "remarks": remarks}
    return Recording(source=source, **columns)


def _without_zeros(columns: dict[str, Any]) -> dict[str, Any]:
    """Return the columns with NaN in rows in which gyro and vectors are zero, as some loggers write for lost packets.

    If most are, the accelerometer is not connected.
    """
    vectors = {name: columns[name] for name in SENSORS.values() if columns.get(name) is not None}
    zero = ~vectors["rate"].any(axis=1)
    if len(vectors) == 1 or not zero.any():
        return columns
    zero &= ~np.hstack(list(vectors.values())).any(axis=1)
    if np.mean(zero) > 0.5:
        return columns
    return columns | {name: np.where(zero[:, None], np.nan, values) for name, values in vectors.items()}


def _one_row_a_stamp(source: str, columns: dict[str, Any]) -> dict[str, Any]:
    """Return the columns with one row for each stamp, which has the first sample of each sensor; rows that add none are ``repeated``."""
    time = columns["time"]
    first = np.append(True, np.diff(time) != 0.0)
    row_of_stamp, stamp = np.flatnonzero(first), np.cumsum(first) - 1
    used, other = first.copy(), np.zeros(len(time), bool)
    merged = {"time": time[first]}
    for name in FIELDS.values():
        values = columns.get(name)
        if values is None or np.shape(values)[:1] != time.shape:
            continue
        samples = np.reshape(values, (len(time), -1)).astype(np.float64)
        known = np.flatnonzero(~np.isnan(samples).any(axis=1))
        row = row_of_stamp.copy()
        row[stamp[known[::-1]]] = known[::-1]  # the first comes last and stays
        used[row] = True
        other[known] |= (samples[known] != samples[row[stamp[known]]]).any(axis=1)
        merged[name] = values[row]
    if np.mean(other) >= FEW_REPEATED:
        k = int(np.argmax(other))
        raise InputError(
            f"{source}: rows with the stamp of the row before and other samples: {other.sum()} of {len(time)}, the first "
            f"{time[k]:.9g} s in row {k + 1}; drop them, write the stamps with more digits, or space evenly those of samples that came "
            "together"
        )
    return columns | merged | {"repeated": time[~used]}


def _rows(columns: dict[str, Any], kept: NDArray[np.bool_]) -> dict[str, Any]:
    """Return the columns with those rows; entries without rows (units, remarks, stamps of repeated rows) are unchanged."""
    return {n: c[kept] if n in _ROWS and np.shape(c)[:1] == kept.shape else c for n, c in columns.items()}


def whole_ns(time: Array) -> NDArray[np.int64]:
    """Return times, s, in ns."""
    return np.asarray(np.rint(time * 1e9)).astype(np.int64)


def relative_time(clock_ns: NDArray[np.int64]) -> tuple[Array, int]:
    """Return stamps of a clock that counts ns as time in s, and the clock's reading at time 0 (``epoch_ns``).

    Time begins at the first stamp if the clock is beyond :data:`CLOCK_OFFSET`, because float64 would otherwise lose digits.
    """
    epoch = int(clock_ns[0]) if len(clock_ns) and abs(int(clock_ns[0])) > CLOCK_OFFSET * 1e9 else 0
    return np.asarray((clock_ns - epoch) / 1e9), epoch


def matched(stamps: Array, time: Array, tolerance: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return for each time (m,) the row of the same stamp in ``stamps`` (n,), and whether there is one within a tolerance, s."""
    rows = np.minimum(np.searchsorted(stamps, time - tolerance), len(stamps) - 1)
    return rows, np.abs(stamps[rows] - time) <= tolerance


def rows_of(recording: Recording, time: Array) -> NDArray[np.int64]:
    """Return the row of each time (m,) of an estimate, all of which must be stamps of the recording."""
    rows, same = matched(recording.time, time, 1e-6)
    if not same.all():
        missing = f"{recording.source} has no stamp {time[np.argmin(same)]:.6g} s, as the estimate has"
        raise InputError(f"{missing}; give the recording it was made from")
    return rows


def at_nearest(time: Array, other: Array, values: Array) -> tuple[Array, int]:
    """Return the samples of a sensor with its own stamps at the nearest of ``time``, NaN elsewhere, and the number not used.

    Samples are not interpolated, because that would correlate their noise: each moves by at most half an interval of ``time``. If several
    samples have the same nearest stamp, only the closest is used; samples more than an interval outside ``time`` are not used.
    """
    placed = np.full((len(time), *values.shape[1:]), np.nan)
    right = np.clip(np.searchsorted(time, other), 1, len(time) - 1)
    nearest = np.where(other - time[right - 1] < time[right] - other, right - 1, right)
    distance = np.abs(other - time[nearest])
    usable = distance <= np.median(np.diff(time))
    order = np.flatnonzero(usable)[np.argsort(-distance[usable], kind="stable")]  # the nearest comes last and stays
    placed[nearest[order]] = values[order]
    return placed, int(len(other) - len(np.unique(nearest[usable])))


def beside(topic: str, stamps_ns: NDArray[np.int64], values: Array, time: Array, epoch_ns: int) -> tuple[Array, str]:
    """Return the samples of another topic of a log at the nearest of ``time``, and a remark that counts them."""
    placed, lost = at_nearest(time, (stamps_ns - epoch_ns) / 1e9, values)
    return placed, f"Topic {topic}: {len(stamps_ns)} messages{f', {lost} of them beyond its stamps' if lost else ''}."


def interpolated(time: Array, stamps: Array, q: Array, bridged: float = BRIDGED) -> Array:
    """Return attitudes (n, 4) at ``time`` (n,) between unit quaternions at ``stamps`` along the shortest rotation.

    NaN outside, and between stamps that are further than ``bridged`` apart, s.
    """
    result = np.full((len(time), 4), np.nan)
    if len(stamps) < 2:
        return result
    k = np.clip(np.searchsorted(stamps, time, side="right") - 1, 0, len(stamps) - 2)
    width = stamps[k + 1] - stamps[k]
    share = (time - stamps[k]) / width
    usable = (share >= -1e-9 / width) & (share <= 1.0 + 1e-9 / width) & (width <= bridged)
    k, share = k[usable], share[usable]
    turn = quaternion.rotation_between(q[k], q[k + 1])
    result[usable] = quaternion.multiply(q[k], quaternion.exp(share[:, None] * turn))
    return result


def field_in(unit: str, recording: Recording) -> Array:
    """Return the magnetic field of a recording (n, 3) in a unit, a key of :data:`MAGNETIC_UNITS`; its own unit must be known."""
    assert recording.magnetic_field is not None
    if not recording.magnetic_unit:
        raise InputError(
            f"{recording.source} does not declare the unit of its magnetometer, which is needed in {unit}; declare it in the header or by "
            f"option ({' or '.join(MAGNETIC_UNITS)})"
        )
    return np.asarray(recording.magnetic_field * (MAGNETIC_UNITS[recording.magnetic_unit] / MAGNETIC_UNITS[unit]))


def increments(recording: Recording) -> Array:
    """Return body increments (n − 1, 3), rad, over the intervals between the stamps, by the trapezoid rule.

    Point samples at unequal intervals support no higher order; at equal intervals :func:`strapdown.coning.increments_from_rates` fits
    polynomials of higher order.
    """
    return np.asarray(0.5 * (recording.rate[1:] + recording.rate[:-1]) * np.diff(recording.time)[:, None])


def corrected(recording: Recording, **samples: Array) -> Recording:
    """Return the recording with other samples at the same stamps, which are not checked again."""
    result = copy.copy(recording)
    for name, values in samples.items():
        object.__setattr__(result, name, values)
    return result


def sampled(samples: Array) -> np.ndarray:
    """Return a mask (n,) of the rows (n, k) of a sensor that are samples: neither NaN nor all 0."""
    return np.asarray(np.abs(samples) @ np.ones(samples.shape[1]) > 0.0)


def gaps(time: ArrayLike) -> list[tuple[float, float]]:
    """Return start and duration, s, of each gap between stamps: intervals of more than five median intervals.

    Examples
    --------
    >>> gaps([0.0, 1.0, 2.0, 3.0, 9.0, 10.0])
    [(3.0, 6.0)]
    """
    stamps = np.asarray(time, np.float64)
    steps = np.diff(stamps)
    if len(steps) == 0 or steps.max() <= GAP * steps.min():
        return []  # saves the median of nearly every recording
    usual = median(steps)
    return [(float(stamps[k]), float(steps[k])) for k in np.flatnonzero(steps > GAP * usual)]
