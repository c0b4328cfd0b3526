"""Recordings from the bench and the field: reading BROAD HDF5 files and CSV, with clear words where a file is not what it should be.

A recording holds point samples of rate, specific force and magnetic field as a device gave them, on one time axis. What a filter makes
of it is in :mod:`strapdown.ahrs`.
"""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import recordfiles
from strapdown.checks import Array, InputError, array, increasing, known_keys, one_of, positive
from strapdown.files import existing_file
from strapdown.units import DEGREE, STANDARD_GRAVITY

RATE_UNITS = {"rad/s": 1.0, "deg/s": DEGREE}
"""Units of a gyro column, and their factor to rad/s."""
FORCE_UNITS = {"m/s2": 1.0, "g": STANDARD_GRAVITY}
"""Units of an accelerometer column, and their factor to m/s²."""
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of a time column, and their factor to s."""

SHORT_STAMPS = 0.1
"""Share of the rows with the stamp of the row before, above which stamps lack digits rather than that a row is wrong."""

FEW_REPEATED = 0.01
"""Share of the rows with the stamp of the row before, below which they are left out though their samples differ."""

_COLUMNS = {"gyro": ("gx", "gy", "gz"), "accelerometer": ("ax", "ay", "az"), "magnetometer": ("mx", "my", "mz")}


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recording of one inertial measurement unit."""

    source: str
    """Where it comes from: the file's name."""
    time: Array
    """Time stamps (n,), s, increasing."""
    rate: Array
    """Angular rate at the stamps (n, 3), rad/s, body axes."""
    specific_force: Array | None = None
    """Specific force (n, 3), m/s², body axes: at rest 9.81 upwards; rows of NaN are missing."""
    magnetic_field: Array | None = None
    """Magnetic field (n, 3), any one unit, body axes; rows of NaN are missing."""
    true_attitude: Array | None = None
    """Reference q_fb (n, 4), fixed frame East-North-Up with magnetic North; rows of NaN are missing."""
    movement: np.ndarray | None = None
    """Samples that errors are judged over (n,), bool."""
    missing_gyro: Array = field(default_factory=lambda: np.empty(0))
    """Stamps of the file's rows without a gyro sample (k,), s. They are left out as a whole: the intervals on both sides are one, the turn
    over it is taken from the samples at its ends, and a filter's covariance grows over all of it."""
    repeated: Array = field(default_factory=lambda: np.empty(0))
    """Stamps of the file's rows that have the stamp of the row before (k,), s: they are left out. Where they are more than
    :data:`FEW_REPEATED` of all, and their samples differ, the file is refused, for two samples at one time have no interval."""

    def __post_init__(self) -> None:
        """Check shapes, order and values."""
        time = increasing(f"{self.source}: time", self.time, least=2)
        n = len(time)
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "rate", array(f"{self.source}: rate", self.rate, (n, 3)))
        for name, width in (("specific_force", 3), ("magnetic_field", 3), ("true_attitude", 4)):
            value = getattr(self, name)
            if value is not None:
                value = array(f"{self.source}: {name}", value, (n, width), allow_nan=True)
                if name != "true_attitude" and not np.any(value[~np.isnan(value)]) and not np.isnan(value).all():
                    raise InputError(
                        f"{self.source}: {name} is 0 in every row, as where there is no such sensor; leave its columns out"
                    )
                object.__setattr__(self, name, value)
        for name in ("missing_gyro", "repeated"):
            object.__setattr__(self, name, array(f"{self.source}: {name}", getattr(self, name), ("k",)))
        if self.movement is not None and np.shape(self.movement) != (n,):
            raise InputError(f"{self.source}: movement has shape {np.shape(self.movement)}, wanted ({n},)")

    def since(self, first: int) -> Recording:
        """Return the recording from sample ``first`` on."""
        rows = slice(first, None)
        fields = ("time", "rate", "specific_force", "magnetic_field", "true_attitude", "movement")
        parts: dict[str, Any] = {n: None if getattr(self, n) is None else getattr(self, n)[rows] for n in fields}
        begin = parts["time"][0]
        missing, repeated = (stamps[stamps > begin] for stamps in (self.missing_gyro, self.repeated))
        return replace(self, missing_gyro=missing, repeated=repeated, **parts)

    @property
    def left_out_words(self) -> str:
        """What is to be said of rows that were left out; nothing where there are none."""
        words = []
        if len(self.missing_gyro):
            words.append(
                f"{len(self.missing_gyro)} rows without a gyro sample, the first at {self.missing_gyro[0]:.3f} s, were left out: the "
                "turn across them is taken from the samples beside them."
            )
        if len(self.repeated):
            words.append(
                f"{len(self.repeated)} rows that repeat the row before, the first at {self.repeated[0]:.3f} s, were left out."
            )
        return " ".join(words)


def read(
    path: str | os.PathLike[str], *, units: Mapping[str, str] | None = None, gyro_alone: bool = False
) -> Recording:
    """Read a recording, HDF5 in the layout of BROAD or CSV, told apart by the suffix.

    Parameters
    ----------
    path : path
        ``.hdf5``, ``.h5`` or ``.csv``.
    units : mapping, optional
        For CSV: units of ``time``, ``gyro`` and ``accelerometer`` where the header does not declare them.
    gyro_alone : bool
        For CSV: leave the columns of the other sensors alone, whose units need not be known then.

    Raises
    ------
    InputError
        If the file is missing, truncated, of another layout, or its units are unknown or undeclared.
    """
    file = Path(path)
    existing_file(file)
    if file.suffix.lower() in (".hdf5", ".h5"):
        if units:
            raise InputError(
                f"{file.name} is HDF5, whose layout says its units; drop the option for {', '.join(units)}"
            )
        return read_broad(file)
    if file.suffix.lower() == ".csv":
        return read_csv(file, units=units, gyro_alone=gyro_alone)
    raise InputError(f"{file} has the suffix {file.suffix!r}; recordings are .hdf5 or .h5 (BROAD layout) or .csv")


def read_broad(path: str | os.PathLike[str]) -> Recording:
    """Read a trial of the BROAD data set (Laidig et al. 2021): ``imu_gyr``, ``imu_acc``, ``imu_mag``, ``opt_quat``, ``movement``."""
    import h5py

    name = Path(path).name
    try:
        with h5py.File(path, "r") as file:
            kind = str(file.attrs.get("kind", ""))
            if kind.startswith("strapdown ") and kind != recordfiles.KIND:
                raise InputError(f"{name} is a {kind}, a result and no recording; give what it was made from")
            if kind == recordfiles.KIND:
                raise InputError(
                    f"{name} is a simulated record, no recording; integrate it (`strapdown integrate`) or filter it (`strapdown estimate`)"
                )
            missing = [key for key in ("imu_gyr",) if key not in file]
            if "sampling_rate" not in file.attrs:
                missing.append("the attribute sampling_rate")
            if missing:
                raise InputError(
                    f"{name} lacks {', '.join(missing)}; it is not in the layout of BROAD (has: {', '.join(file)})"
                )
            rate = file["imu_gyr"][:]
            sampling = positive(f"{name}: sampling_rate", file.attrs["sampling_rate"], unit="Hz")
            return _with_gyro(
                source=name,
                time=np.arange(len(rate)) / sampling,
                rate=rate,
                specific_force=file["imu_acc"][:] if "imu_acc" in file else None,
                magnetic_field=file["imu_mag"][:] if "imu_mag" in file else None,
                true_attitude=file["opt_quat"][:] if "opt_quat" in file else None,
                movement=file["movement"][:].astype(bool) if "movement" in file else None,
            )
    except OSError as error:
        raise InputError(f"{name} cannot be read as HDF5 ({error}); the file is truncated or of another kind") from None


def read_csv(
    path: str | os.PathLike[str], *, units: Mapping[str, str] | None = None, gyro_alone: bool = False
) -> Recording:
    """Read columns ``time, gx, gy, gz[, ax, ay, az[, mx, my, mz]]`` in any order; other columns are left alone.

    A header may declare units in brackets, ``gx [deg/s]``; ``units`` ("time", "gyro", "accelerometer") declares them for files that do
    not. A gyro or accelerometer without a unit is refused rather than guessed: a factor of 57.3 or 9.81 is the commonest mistake there
    is. Time is in s unless declared otherwise. Empty fields of the accelerometer and the magnetometer are missing samples; rows with an
    empty field of the gyro are left out, and told in ``missing_gyro``, as are rows that repeat the row before, in ``repeated``.
    """
    file = Path(path)
    known_keys("units", units or {}, ("time", "gyro", "accelerometer"))
    try:
        stream = io.StringIO(file.read_text(encoding="utf-8-sig"), newline="")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file.name} cannot be read as text ({error}); pass a CSV file in UTF-8") from None
    if recordfiles.is_record(file):
        raise InputError(
            f"{file.name} is a simulated record, no recording; integrate it (`strapdown integrate`) or filter it (`strapdown estimate`)"
        )
    with stream:
        rows = csv.reader(line for line in stream if line.strip() and not line.lstrip().startswith("#"))
        header = next(rows, None)
        if header is None:
            raise InputError(f"{file.name} is empty; wanted a header like time,gx,gy,gz,ax,ay,az")
        names, declared = _header(file.name, header)
        present = {
            group: any(name in names for name in members) and (group == "gyro" or not gyro_alone)
            for group, members in _COLUMNS.items()
        }
        needed = [
            "time",
            *_COLUMNS["gyro"],
            *(name for group in _COLUMNS if present[group] for name in _COLUMNS[group]),
        ]
        missing = [name for name in dict.fromkeys(needed) if name not in names]
        if missing:
            other = next((mark for mark in (";", "\t", "|") if any(mark in name for name in names)), "")
            words = f"; its columns are parted by {other!r}: write commas, and points in the decimals" if other else ""
            raise InputError(f"{file.name}: the header lacks {', '.join(missing)} (it has: {', '.join(names)}){words}")
        values = _numbers(file.name, rows, len(names), header)
    _need_digits(file.name, values, names.index("time"))
    factors = _factors(file.name, {group for group, there in present.items() if there}, declared, units or {})

    def columns(group: str) -> Array:
        return values[:, [names.index(name) for name in _COLUMNS[group]]] * factors[group]

    return _with_gyro(
        source=file.name,
        time=_seconds(values[:, names.index("time")], factors["time"]),
        rate=columns("gyro"),
        specific_force=columns("accelerometer") if present["accelerometer"] else None,
        magnetic_field=columns("magnetometer") if present["magnetometer"] else None,
    )


def _with_gyro(*, source: str, time: Array, rate: Array, **columns: Any) -> Recording:
    """Return a recording of the rows that have a gyro sample and do not repeat the row before; the stamps of the others go along."""
    same = np.diff(time) == 0.0
    few = np.mean(same) < FEW_REPEATED
    for column in (rate, *columns.values()):
        if few or np.shape(column)[:1] != time.shape:
            continue  # not there, or not of this length, which is refused below
        rows = np.asarray(column).reshape(len(time), -1).astype(np.float64)
        same &= np.all((rows[1:] == rows[:-1]) | (np.isnan(rows[1:]) & np.isnan(rows[:-1])), axis=1)
    if same.any():
        new = np.concatenate([[True], ~same])
        columns = {name: None if column is None else column[new] for name, column in columns.items()}
        columns["repeated"] = time[~new]
        time, rate = time[new], rate[new]
    known = np.asarray(~np.isnan(rate).any(axis=1))
    if known.all():
        return Recording(source=source, time=time, rate=rate, **columns)
    if np.sum(known) < 2:
        raise InputError(
            f"{source}: {np.sum(known)} of {len(known)} rows have a gyro sample about each axis; at least 2 are needed"
        )
    stamps = increasing(f"{source}: time", time)
    gone = stamps[~known]
    kept = {n: c if c is None or n == "repeated" else c[known] for n, c in columns.items()}
    return Recording(source=source, time=stamps[known], rate=rate[known], missing_gyro=gone, **kept)


def _need_digits(source: str, values: Array, time: int) -> None:
    """Refuse stamps, one in ten of which is that of the row before though the rows differ: they were written with too few digits."""
    before, after = values[:-1], values[1:]
    differ = np.any((before != after) & ~(np.isnan(before) & np.isnan(after)), axis=1)
    repeats = np.flatnonzero((before[:, time] == after[:, time]) & differ)
    if len(repeats) > max(2, SHORT_STAMPS * len(after)):
        raise InputError(
            f"{source}: {len(repeats)} of {len(values)} rows have the stamp of the row before and other samples, the first of them "
            f"{after[repeats[0], time]:.17g} in data row {repeats[0] + 2}; write the stamps with more digits"
        )


def _seconds(stamps: Array, factor: float) -> Array:
    """Return time stamps in s; those of a clock that counts from 1970 are told from the first one on, or they would lose digits."""
    origin = stamps[0] if abs(stamps[0] * factor) > 1e8 else 0.0
    return np.asarray((stamps - origin) * factor)


def _header(source: str, header: list[str]) -> tuple[list[str], dict[str, str]]:
    """Return the column names and, by group, the units that the header declares."""
    names: list[str] = []
    declared: dict[str, str] = {}
    groups = {name: group for group, members in _COLUMNS.items() for name in members} | {"time": "time"}
    for cell in header:
        name, bracket, rest = cell.strip().partition("[")
        name = name.strip().lower()
        if name in names:
            raise InputError(f"{source}: the header names the column {name!r} twice; rename or drop one")
        names.append(name)
        if bracket and name in groups:
            unit = rest.strip().removesuffix("]").strip().replace("²", "2").replace("^", "").replace("°", "deg")
            if declared.setdefault(groups[name], unit) != unit:
                raise InputError(
                    f"{source}: column {name} is in {unit} but another {groups[name]} column in {declared[groups[name]]}; "
                    "give all axes of one sensor the same unit"
                )
    return names, declared


def _numbers(source: str, rows: csv.reader, width: int, header: list[str]) -> Array:  # type: ignore[valid-type]
    result: list[list[float]] = []
    for k, row in enumerate(rows):  # type: ignore[var-annotated,arg-type]
        if len(row) != width:
            decimals = width < len(row) and all(re.fullmatch(r"\s*-?\d+(e-?\d+)?\s*", part) for part in row)
            words = (
                "its decimals seem to have commas: write points"
                if decimals
                else "the file is truncated or damaged there"
            )
            raise InputError(f"{source}: data row {k + 1} has {len(row)} fields, the header {width}; {words}")
        try:
            result.append([float(field) if field.strip() else np.nan for field in row])
        except ValueError:
            bad = next(j for j, field in enumerate(row) if not _is_number(field))
            raise InputError(
                f"{source}: data row {k + 1}, column {header[bad].strip()} is {row[bad]!r}, not a number"
            ) from None
    if not result:
        raise InputError(f"{source} has a header but no data rows")
    return np.array(result)


def _is_number(field: str) -> bool:
    try:
        float(field or "nan")
    except ValueError:
        return False
    return True


def _factors(
    source: str, present: Collection[str], declared: Mapping[str, str], given: Mapping[str, str]
) -> dict[str, float]:
    """Return the factor to SI of each group of columns that the file has."""
    known = {"time": TIME_UNITS, "gyro": RATE_UNITS, "accelerometer": FORCE_UNITS}
    factors = {"magnetometer": 1.0}
    for group, units in known.items():
        if group != "time" and group not in present:
            continue
        unit = given.get(group) or declared.get(group) or ("s" if group == "time" else None)
        if unit is None:
            raise InputError(
                f"{source} does not say the unit of its {group} columns; declare it in the header, as in "
                f"{_COLUMNS[group][0]} [{next(iter(units))}], or by option ({' or '.join(units)})"
            )
        if given.get(group) and declared.get(group) and given[group] != declared[group]:
            raise InputError(
                f"{source}: the header says {declared[group]} for the {group}, the option {given[group]}; drop one"
            )
        factors[group] = units[one_of(f"{source}: unit of the {group}", unit, units)]
    return factors


def increments(recording: Recording) -> Array:
    """Return body increments (n − 1, 3), rad, over the intervals between the stamps, by the trapezoid rule.

    Point samples of rate say no more at uneven stamps; at even ones :func:`strapdown.coning.increments_from_rates` fits higher
    polynomials.
    """
    return np.asarray(0.5 * (recording.rate[1:] + recording.rate[:-1]) * np.diff(recording.time)[:, None])


@dataclass(frozen=True, kw_only=True)
class GyroSamples:
    """Gyro samples at even intervals, for noise identification."""

    values: Array
    """Rates (n, axes), rad/s, or increments, rad."""
    sample_interval: float
    """s"""
    kind: str
    """"rate" or "increments"."""


GAP = 5.0
"""An interval between stamps of more than this many usual ones is a gap."""


def gaps(time: Array) -> list[tuple[float, float]]:
    """Return (begin, length) of every gap between stamps, s: what the body did there, no sample tells."""
    steps = np.diff(time)
    return [(float(time[k]), float(steps[k])) for k in np.flatnonzero(steps > GAP * np.median(steps))]


EVEN = 1e-3
"""Largest relative departure of a sample interval from their mean that still counts as even."""


def read_gyro(
    path: str | os.PathLike[str], *, rate: float | None = None, units: Mapping[str, str] | None = None
) -> GyroSamples:
    """Read the gyro of a simulated record (HDF5), a BROAD trial, a CSV file, or a NPY array (n,) or (n, 3) of rates.

    An array tells neither its rate nor its unit: give ``rate`` in Hz and ``units={"gyro": ...}``. Samples must lie at even intervals.
    """
    file = Path(path)
    existing_file(file)
    given = dict(units or {})
    if file.suffix.lower() == ".npy":
        if rate is None or "gyro" not in given:
            raise InputError(f"{file.name} is a bare array; give its rate in Hz and its unit (rad/s or deg/s)")
        try:
            values = np.load(file, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(
                f"{file.name} cannot be read as an array ({error}); the file is truncated or of another kind"
            ) from None
        factor = RATE_UNITS[one_of(f"{file.name}: unit of the gyro", given["gyro"], RATE_UNITS)]
        columns = array(file.name, np.reshape(values, (-1, 1)) if np.ndim(values) == 1 else values, ("n", "axes"))
        return GyroSamples(
            values=columns * factor, sample_interval=1.0 / positive("rate", rate, unit="Hz"), kind="rate"
        )
    if rate is not None:
        raise InputError(f"{file.name} tells its own rate; drop the option rate")
    if recordfiles.is_record(file):
        if given:
            raise InputError(
                f"{file.name} is a record, whose layout says its units; drop the option for {', '.join(given)}"
            )
        record = recordfiles.read_record(file)
        return GyroSamples(values=record.increments, sample_interval=_even(file.name, record.time), kind="increments")
    recording = read(file, units=given, gyro_alone=True)
    return GyroSamples(values=recording.rate, sample_interval=_even(file.name, recording.time), kind="rate")


def _even(source: str, time: Array) -> float:
    steps = np.diff(time)
    mean = float(steps.mean())
    worst = int(np.argmax(np.abs(steps - mean)))
    if abs(steps[worst] - mean) > EVEN * mean:
        raise InputError(
            f"{source}: the interval after {time[worst]:.6g} s is {steps[worst]:.6g} s, the mean {mean:.6g} s; cut the recording to where "
            "its samples lie at even intervals"
        )
    return mean
