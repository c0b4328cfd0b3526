"""IMU records in files: HDF5, self-describing; CSV, for exchange.

HDF5 stores everything exactly: increments, every vector series, the truth, the specification of the gyro, the scenario,
seed, units, conventions and version. CSV stores the gyro in one file, and each vector series in another one.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import strapdown
from strapdown import gyro
from strapdown.checks import Array, InputError, count, known_keys
from strapdown.files import reading, set_attributes, written_beside
from strapdown.records import CONVENTIONS, ImuRecord, Origin, Truth, put, result_file
from strapdown.vectors import KINDS, VectorMeasurements

KIND = "strapdown record"
"""The attribute ``kind`` of a record's file."""

FORMAT = 1
"""Version of the layout; a newer one is rejected by the reader."""
_SERIES = {
    "time": "s",
    "vector_b": "1 (kind vector: the unit of sigma)",
    "reference_f": "1 (kind vector: the unit of sigma)",
    "sigma": "rad (kind vector: the unit of the vector)",
    "attitude": "1",
    "sigma_axes": "rad (kind vector: the unit of the vector)",
    "covariance": "the square of sigma's",
    "arrival": "s",
}
_RESERVED = ("kind", "format", "version", "conventions", "gyro", "scenario", "seed", "run")


def write_record(
    path: str | os.PathLike[str], record: ImuRecord, *, attributes: Mapping[str, Any] | None = None
) -> None:
    """Write a record to HDF5, with its origin; the file is created only when complete.

    A scenario with a Python function or a user-defined class cannot be written to a file and is left out. ``attributes`` are additional
    attributes of the file.
    """
    for name in attributes or {}:
        if name in _RESERVED:
            raise InputError(f"attributes has {name!r}, which is reserved by the file; choose another name")
    with result_file(path, "record", {"format": FORMAT}) as file:
        made = {
            name: json.dumps(value) if name == "gyro" else value
            for name, value in origin_attributes(record.origin).items()
        }
        set_attributes(file, {**made, **(attributes or {})})
        put(file, "time", record.time, "s", "edges of the sample intervals, one more than there are increments")
        put(
            file,
            "increments",
            record.increments,
            "rad",
            "integral of the measured body rate over each interval, body axes",
        )
        for number, series in enumerate(record.vectors):
            group = file.create_group(f"vectors/{number}")
            degrees = KINDS[series.kind]
            set_attributes(group, {"sensor": series.sensor, "kind": series.kind, "degrees_of_freedom": degrees})
            for name, unit in _SERIES.items():
                value = getattr(series, name)
                if value is not None and not (series.kind == "attitude" and name in ("vector_b", "sigma")):
                    put(group, name, value, unit)
        if record.truth is not None:
            put(file, "truth/attitude", record.truth.attitude, "1", "q_fb at the edges")
            put(file, "truth/bias", record.truth.bias, "rad/s", "gyro bias at the edges, body axes")
        if record.temperature is not None:
            put(file, "temperature", record.temperature, "degC", "of the gyro, at the edges")


def is_record(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is marked as written by :func:`write_record` or :func:`export_csv`; its content is not checked."""
    return _begins(path, f"{_MARK} record".encode()) or reading.kind(path) == KIND


def _begins(path: str | os.PathLike[str], mark: bytes) -> bool:
    with reading.opened(path) as file:
        return file.read(len(mark)) == mark


def read_record(path: str | os.PathLike[str]) -> ImuRecord:
    """Read the record of a file written by :func:`write_record` or :func:`export_csv`, with its origin.

    Measurements of NaN are missing. An increment must not be NaN, because the rotation over its interval would be unknown. If a row of a
    CSV is left out, the next one must contain the rotation over both intervals.
    """
    if _begins(path, _MARK.encode()):
        with reading.from_file(path):
            return _read_csv_record(Path(path))
    with reading.hdf5(path) as file:
        attributes = reading.attributes(file)
        kind = attributes.get("kind")
        if kind != KIND:
            raise InputError(
                f"{path} is {f'a {kind}' if kind else 'HDF5 of another program'}, not a {KIND}; give a file written by write_record"
            )
        if count("format", attributes["format"]) > FORMAT:
            raise InputError(
                f"{path} has layout {attributes['format']}, this version ({strapdown.__version__}) reads up to {FORMAT}; update it"
            )
        if attributes.get("conventions", CONVENTIONS) != CONVENTIONS:
            raise InputError(
                f"{path} follows other conventions ({attributes['conventions']}); convert it to those of this package: {CONVENTIONS}"
            )
        group = file.get("vectors", {})
        series = tuple(_series(group[str(number)]) for number in range(len(group)))
        truth = None
        if "truth" in file:
            truth = Truth(attitude=_values(file, "truth/attitude", "1"), bias=_values(file, "truth/bias", "rad/s"))
        return ImuRecord(
            time=_values(file, "time", "s"),
            increments=_values(file, "increments", "rad"),
            vectors=series,
            truth=truth,
            origin=_origin(attributes, path),
            temperature=_values(file, "temperature", "degC") if "temperature" in file else None,
        )


def origin_attributes(origin: Origin | None) -> dict[str, Any]:
    """Return the known fields of a record's origin as values for a file."""
    if origin is None:
        return {}
    scenario = None
    if origin.scenario is not None:
        from strapdown.scenarios import scenario_to_toml  # imported late, because it imports every motion

        with contextlib.suppress(InputError):
            scenario = scenario_to_toml(origin.scenario)
    spec = None if origin.gyro is None else gyro.to_table(origin.gyro)
    made = {"gyro": spec, "scenario": scenario, "seed": origin.seed, "run": origin.run}
    return {name: value for name, value in made.items() if value is not None}


class _FiledOrigin(Origin):
    """The origin from a file; its scenario is read on first access, because one with a gyro preset takes half a second."""

    def __init__(self, text: str, path: str | os.PathLike[str], made: Mapping[str, Any]) -> None:
        """Store the TOML; if there is no specification of the gyro, that of the scenario is used."""
        super().__init__(**made)
        vars(self).pop("scenario")
        vars(self).update(_text=text, _path=path)
        if self.gyro is None:
            vars(self).update(gyro=self.scenario.gyro)

    @functools.cached_property
    def scenario(self) -> Any:  # type: ignore[override]
        """The scenario."""
        from strapdown.scenarios import scenario_from_toml  # imported late, because it imports every motion

        with reading.from_file(self._path):
            return scenario_from_toml(self._text, f"{self._path}: scenario")

    _text: str
    _path: str | os.PathLike[str]


def _origin(attributes: Mapping[str, Any], path: str | os.PathLike[str]) -> Origin | None:
    """Return the origin of a record from the attributes of its file."""
    made: dict[str, Any] = {
        name: count(name, attributes[name], minimum=0) for name in ("seed", "run") if name in attributes
    }
    if "gyro" in attributes:
        table = attributes["gyro"]
        table = reading.from_json(table, f"{path}: gyro") if isinstance(table, str) else table
        made["gyro"] = gyro.from_table(table, f"{path}: gyro")
    if "scenario" not in attributes:
        return Origin(**made) if made else None
    if not isinstance(attributes["scenario"], str):
        raise InputError(f"{path}: scenario is {attributes['scenario']!r}; it must be TOML text")
    return _FiledOrigin(attributes["scenario"], path, made)


def _values(group: Any, name: str, unit: str) -> Array:
    """Return an array of a file; its attribute ``unit``, if present, must be the expected one."""
    value = reading.numbers(group, name)
    own = reading.attributes(group[name]).get("unit", unit)
    if own != unit:
        raise InputError(
            f"{group.file.filename}: {f'{group.name}/{name}'.lstrip('/')} is in {own!r}, but must be in {unit!r}; convert it"
        )
    return value


def _series(group: Any) -> VectorMeasurements:
    fields = {name: _values(group, name, unit) for name, unit in _SERIES.items() if name in group}
    attributes = reading.attributes(group)
    if attributes["kind"] != "attitude" and not fields.keys() & {"sigma", "sigma_axes", "covariance"}:
        raise InputError(
            f"{group.file.filename}: {group.name.lstrip('/')} ({attributes['sensor']}) has no sigma; give each measurement its standard "
            "deviation"
        )
    return VectorMeasurements(sensor=attributes["sensor"], kind=attributes["kind"], **fields)


# --------------------------------------------------------------------------------------------------------------------- CSV

_GYRO_COLUMNS: tuple[str, ...] = ("time_s", "increment_x_rad", "increment_y_rad", "increment_z_rad")
_TRUTH_COLUMNS = ("q_w", "q_x", "q_y", "q_z", "bias_x_rad_per_s", "bias_y_rad_per_s", "bias_z_rad_per_s")
_TEMPERATURE = "temperature_degc"
_VECTOR_COLUMNS = ("time_s", "x_b", "y_b", "z_b", "sigma", "x_f", "y_f", "z_f")
_ATTITUDE_COLUMNS = ("time_s", "q_w", "q_x", "q_y", "q_z", "sigma_x_rad", "sigma_y_rad", "sigma_z_rad")
_ARRIVAL = "arrival_s"
_MARK = "# strapdown"
_COUNTED, _MADE = " vector series", "; made by "


def export_csv(path: str | os.PathLike[str], record: ImuRecord) -> tuple[Path, ...]:
    """Write a record as CSV, 17 digits per number; return the files written, the record first.

    ``path`` has one row per edge: its time, the increment of the interval that ends there (NaN in the first row), and the truth if there
    is one. Each vector series is written to ``STEM-vectors-N.csv`` in the same folder. The first line of each file is a comment with the
    kind of file, the time of its last row, and for the record the number of its series; the second line has the names of the columns with
    their units. The record is written last. Extra series files of an earlier record of the same name are removed. Noise that differs
    between body axes is rejected, because CSV has no columns for it.
    """
    for series in record.vectors:
        if series.anisotropic:
            raise InputError(f"{series.sensor}: CSV has no columns for sigma_axes or covariance; write HDF5")
    target = Path(path)
    first = np.full((1, 3), np.nan)
    columns = [record.time[:, None], np.concatenate([first, record.increments])]
    names = _GYRO_COLUMNS
    if record.truth is not None:
        columns += [record.truth.attitude, record.truth.bias]
        names += _TRUTH_COLUMNS
    if record.temperature is not None:
        columns.append(record.temperature[:, None])
        names += (_TEMPERATURE,)
    table = np.concatenate(columns, axis=1)
    comment = (
        f"{_MARK} record, version {strapdown.__version__}, to {record.time[-1]:.17g} s, {len(record.vectors)}{_COUNTED}; "
        f"{CONVENTIONS}"
    )
    made = origin_attributes(record.origin)
    if made:
        comment += f"{_MADE}{json.dumps(made)}"
    written = [target]
    for number, series in enumerate(record.vectors):
        beside = _series_file(target, number)
        own: tuple[str, ...]
        if series.kind == "attitude" and series.attitude is not None and series.sigma_axes is not None:
            own, columns = _ATTITUDE_COLUMNS, [series.time[:, None], series.attitude, series.sigma_axes]
        else:
            own, columns = (
                _VECTOR_COLUMNS,
                [series.time[:, None], series.vector_b, series.sigma[:, None], series.references_f],
            )
        if series.arrival is not None:
            own, columns = (*own, _ARRIVAL), [*columns, series.arrival[:, None]]
        head = json.dumps(
            {
                "sensor": series.sensor,
                "kind": series.kind,
                "constant_reference": series.reference_f.ndim == 1,
                "last_time_s": series.time[-1] if len(series.time) else None,
            }
        )
        _write_csv(beside, f"{_MARK} vectors {head}", own, np.concatenate(columns, axis=1))
        written.append(beside)
    _write_csv(target, comment, names, table)
    for number in itertools.count(len(record.vectors)):
        stale = _series_file(target, number)
        if not stale.is_file() or not _begins(stale, f"{_MARK} vectors ".encode()):
            break
        stale.unlink()
    return tuple(written)


def _series_file(target: Path, number: int) -> Path:
    return target.with_name(f"{target.stem}-vectors-{number}.csv")


def _write_csv(path: Path, comment: str, names: tuple[str, ...], rows: Array) -> None:
    with written_beside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(f"{comment}\n{','.join(names)}\n")
        np.savetxt(file, rows, delimiter=",", fmt="%.17g")


def _read_csv_record(target: Path) -> ImuRecord:
    comment, names, rows = _read_csv(target)
    if not comment.startswith(f"{_MARK} record"):
        raise InputError(f"{target} does not begin with '{_MARK} record'; it is not a record written by export_csv")
    warm = names[-1:] == (_TEMPERATURE,)
    if names[: len(names) - warm] not in (_GYRO_COLUMNS, _GYRO_COLUMNS + _TRUTH_COLUMNS):
        raise InputError(
            f"{target} has the columns {', '.join(names)}; wanted {', '.join(_GYRO_COLUMNS)} and optionally "
            f"{', '.join((*_TRUTH_COLUMNS, _TEMPERATURE))}"
        )
    comment, _, made = comment.partition(_MADE)
    lost = np.argwhere(np.isnan(rows[1:, 1:4]))
    if len(lost):
        row, column = lost[0]
        raise InputError(
            f"{target}, line {row + 4}: {names[column + 1]} is nan; leave the row out; the next one needs the rotation over both intervals"
        )
    truth = Truth(attitude=rows[:, 4:8], bias=rows[:, 8:11]) if len(names) > 5 else None
    series = tuple(_import_series(beside) for beside in _series_beside(target, comment))
    temperature = rows[:, -1] if warm else None
    record = ImuRecord(time=rows[:, 0], increments=rows[1:, 1:4], vectors=series, truth=truth, temperature=temperature)
    end = re.search(r", to (\S+) s,", comment)
    _need_end(target, rows, float(end[1]) if end else rows[-1, 0])
    if not made:
        return record
    try:
        own = reading.from_json(made, f"{target}, line 1")
        known_keys(f"{target}, line 1", own, ("gyro", "scenario", "seed", "run"))
        return replace(record, origin=_origin(own, target))
    except (InputError, TypeError) as error:
        raise InputError(
            f"{target}, line 1: the origin of the record cannot be read ({error}); remove '{_MADE.strip()} …'"
        ) from None


def _need_end(path: Path, rows: Array, stated: float | None) -> None:
    """Reject a file whose last time differs from that in its first line (None: no rows), the only sign of truncation between two lines."""
    ends = rows[-1, 0] if len(rows) else None
    if ends != stated:
        raise InputError(
            f"{path} ends at {ends} s, but its first line states {stated} s; it was truncated or extended: restore it, or "
            "change the time in that line if the rows are intended"
        )


def _series_beside(target: Path, comment: str) -> list[Path]:
    """Return the files of the vector series of a record: the stated number, or if none is stated, all numbered in sequence."""
    stated = re.search(rf", (\d+){_COUNTED};", comment)
    if stated is None:
        return list(itertools.takewhile(Path.is_file, (_series_file(target, number) for number in itertools.count())))
    files = []
    for number in range(int(stated[1])):
        file = _series_file(target, number)
        files.append(file)
        if not file.is_file():
            raise InputError(
                f"{file} does not exist, one of {stated[1]} vector series of {target.name}; put it in the folder of the record"
            )
    return files


def _import_series(path: Path) -> VectorMeasurements:
    comment, names, rows = _read_csv(path, link=False)
    mark = f"{_MARK} vectors "
    try:
        head = reading.from_json(
            comment.removeprefix(mark), str(path)
        )  # for another kind of file the mark remains, and the text is not JSON
        attitude = head["kind"] == "attitude"
        wanted = _ATTITUDE_COLUMNS if attitude else _VECTOR_COLUMNS
        if names[:8] != wanted or names[8:] not in ((), (_ARRIVAL,)):
            raise ValueError
        own: dict[str, Any] = {"sensor": head["sensor"], "kind": head["kind"], "time": rows[:, 0]}
        constant = bool(head["constant_reference"])
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path} is not a vector series written by export_csv; check its first two lines") from None
    if "last_time_s" in head:
        _need_end(path, rows, head["last_time_s"])
    if attitude:
        own.update(attitude=rows[:, 1:5], sigma_axes=rows[:, 5:8])
    else:
        own.update(vector_b=rows[:, 1:4], sigma=rows[:, 4])
        if len(rows):
            own["reference_f"] = rows[0, 5:8] if constant else rows[:, 5:8]
    if len(names) > 8:
        own["arrival"] = rows[:, 8]
    return VectorMeasurements(**own)


def _read_csv(path: Path, *, link: bool = True) -> tuple[str, tuple[str, ...], Array]:
    """Return the comment, the names of the columns and the rows; ``link`` as for :func:`strapdown.files.reading.opened`."""
    lines = reading.text(path, link=link).splitlines()
    if len(lines) < 2 or not lines[0].startswith(_MARK):
        raise InputError(f"{path} does not begin with '{_MARK}'; it is not a file written by export_csv")
    names = tuple(lines[1].split(","))
    rows = np.empty((len(lines) - 2, len(names)))
    for number, line in enumerate(lines[2:]):
        cells = line.split(",")
        try:
            if len(cells) != len(names):
                raise ValueError(f"{len(cells)} cells instead of {len(names)}")
            rows[number] = [float(cell) for cell in cells]
        except ValueError as error:
            raise InputError(f"{path}, line {number + 3}: {error}; the file is truncated or was edited") from None
    return lines[0], names, rows
