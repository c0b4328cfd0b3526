"""Recordings as columns in memory or in Parquet. Libraries: ``pandas``, ``polars``, ``xarray``, ``pyarrow``.

Roles and units of the columns are found from their names (:mod:`strapdown.recordings.columns`); a column's unit may also be its
attribute ``units`` (xarray) or the metadata ``unit`` of its field (Parquet). A time column, or an index named time, may contain dates:
they are converted to ns since 1970, UTC. Missing values are missing samples. Axes are those of the columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strapdown.checks import Array, InputError, numbers
from strapdown.files import atomic_write, library, reading
from strapdown.recordings import columns as naming
from strapdown.recordings.delimited import date_ns, write_columns
from strapdown.records import Estimate
from strapdown.records.recording import CLOCK_OFFSET, FIELDS, Recording


def from_table(
    table: Any,
    *,
    source: str = "table",
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
) -> Recording:
    """Return the recording of a data frame, an xarray ``Dataset``, a structured array, or a mapping of names to arrays.

    ``source`` is its name in messages; options as for :func:`strapdown.read`.
    """
    return naming.recording(ArrayTable(source, _columns(source, table)), units=units, columns=columns)


class ArrayTable:
    """A table in memory."""

    def __init__(self, source: str, columns: Mapping[str, NDArray[np.generic]]) -> None:
        self.source, self.header = source, list(columns)
        self._arrays = [_dates(column) for column in columns.values()]
        self._time = 0
        for name, column in zip(self.header, self._arrays, strict=True):
            if np.shape(column) != np.shape(self._arrays[0]) or np.ndim(column) != 1:
                raise InputError(
                    f"{source}: column {name} has shape {np.shape(column)}, the first {np.shape(self._arrays[0])}; give arrays (n,) or "
                    "(n, 3) of one length"
                )

    def load(self, places: Sequence[int], time: int) -> dict[int, Array]:
        """Return the numbers (n,) of columns, from their indices and that of the time."""
        self._time = time
        return {k: self._numbers(k) for k in places}

    def _numbers(self, k: int) -> Array:
        x = self._arrays[k]
        converted = x.astype(np.float64) if x.dtype.kind == "b" or (k == self._time and x.dtype.kind in "mM") else x
        return numbers(f"{self.source}: column {self.header[k]}", converted, allow_nan=True)

    def clock_ns(self, unit: str) -> NDArray[np.int64] | None:
        """Return the loaded stamps, of a unit, "" if unknown, if they are dates, or integers that count ns from 1970; else None."""
        x = self._arrays[self._time]
        if x.dtype.kind in "mM":
            if np.isnat(x).any():
                row = int(np.argmax(np.isnat(x)))
                raise InputError(f"{self.source}: {self.header[self._time]}[{row}] is not a date; drop such rows")
            return x.astype(f"{x.dtype.kind}8[ns]").astype(np.int64)
        large = x.dtype.kind in "iu" and unit in ("", "ns") and len(x) and abs(int(x[0])) > CLOCK_OFFSET * 1e9
        return x.astype(np.int64) if large else None


def _columns(source: str, table: Any) -> dict[str, NDArray[np.generic]]:
    """Return names, with their units if the table declares them, and arrays."""
    if hasattr(table, "data_vars"):
        return _of_dataset(table)
    if hasattr(table, "__arrow_c_stream__") and not hasattr(table, "index"):
        return _of_arrow(library("pyarrow", f"{source} of {type(table).__module__.partition('.')[0]}").table(table))
    if isinstance(table, np.ndarray):
        if table.dtype.names is None:
            raise InputError(f"{source} is an array without names of columns; give a structured one or arrays by name")
        table = {name: table[name] for name in table.dtype.names}
    columns: dict[str, NDArray[np.generic]] = {}
    if hasattr(table, "columns"):  # a DataFrame
        index = table.index
        if (index.name or getattr(index, "tz", None) is not None or np.asarray(index).dtype.kind in "mM") and not (
            {"time", index.name} & {str(name) for name in table.columns}
        ):
            columns[str(index.name or "time")] = _plain(index)
        columns |= {str(name): _plain(table[name]) for name in table.columns}
    else:
        for name, values in dict(table).items():
            columns |= _by_axis(str(name), _unmasked(values))
    if not columns:
        raise InputError(f"{source} has no columns; give time, gx, gy, gz, …")
    return columns


def _plain(series: Any) -> NDArray[np.generic]:
    """Return a column as an array; dates with a time zone as UTC, missing values of nullable types as NaN."""
    options: dict[str, Any] = {}
    if getattr(getattr(series, "dt", series), "tz", None) is not None:
        options = {"dtype": "M8[ns]"}
    elif getattr(series.dtype, "kind", "O") in "iuf" and series.isna().any():
        options = {"dtype": np.float64, "na_value": np.nan}
    return np.asarray(series.to_numpy(**options))


def _dates(column: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return dates as texts or objects as datetime64, UTC; other columns unchanged."""
    if column.dtype.kind not in "OSUT" or column.ndim != 1 or len(column) == 0 or date_ns(str(column[0])) is None:
        return column
    counts = [date_ns(str(value)) for value in column]
    return np.array([np.datetime64("NaT") if count is None else np.datetime64(count, "ns") for count in counts])


def _unmasked(values: Any) -> NDArray[np.generic]:
    """Return an array with NaN, or NaT, in place of masked values."""
    if not np.ma.is_masked(values):
        return np.asarray(values)
    dates = values.dtype.kind in "mM"
    result = np.array(values.data if dates or values.dtype.kind == "c" else values.data.astype(np.float64))
    result[np.ma.getmaskarray(values)] = np.array("NaT", result.dtype) if dates else np.nan
    return result


def _by_axis(name: str, values: NDArray[np.generic]) -> dict[str, NDArray[np.generic]]:
    """Return one column, or three of an array (n, 3), the unit behind the axis."""
    if values.shape[1:] != (3,):
        return {name: values}
    said = naming.column(name)
    unit = f" [{said.unit}]" if said.unit else ""
    return {f"{said.name}_{axis}{unit}": values[:, k] for k, axis in enumerate("xyz")}


def _of_dataset(table: Any) -> dict[str, NDArray[np.generic]]:
    columns: dict[str, NDArray[np.generic]] = {}
    for name, variable in {**table.coords, **table.data_vars}.items():
        unit = str(variable.attrs.get("units", variable.attrs.get("unit", "")))
        values = np.asarray(variable.values)
        declared = f" [{unit}]" if unit and values.dtype.kind not in "mM" else ""
        if (values.ndim == 1 and values.dtype.kind not in "OSU" and name != "axis") or values.shape[1:] == (3,):
            columns |= _by_axis(f"{name}{declared}", values)
    length = max((len(values) for values in columns.values()), default=0)
    return {name: values for name, values in columns.items() if len(values) == length}


def read_parquet(
    file: Path, *, units: Mapping[str, str] | None = None, columns: Mapping[str, str] | None = None
) -> Recording:
    """Read a recording from Parquet; options as for :func:`strapdown.read`."""
    return naming.recording(parquet_table(file), units=units, columns=columns)


def parquet_table(file: Path) -> ArrayTable:
    """Return the numbers, flags and dates of a Parquet file."""
    parquet = library("pyarrow.parquet", f"{file.name} is Parquet, which")
    types = library("pyarrow.types", "Parquet")
    with parquet.ParquetFile(file, page_checksum_verification=True) as content:
        schema, rows = content.schema_arrow, content.metadata.num_rows
        # Other columns, which may have any size, are not read.
        flat = [k for k, column in enumerate(schema) if types.is_primitive(column.type) or types.is_null(column.type)]
        reading.need_room(file, 8.0 * rows * len(flat))
        table = content.read([schema[k].name for k in flat], use_threads=False)
    return ArrayTable(file.name, _of_arrow(table))


def _of_arrow(table: Any) -> dict[str, NDArray[np.generic]]:
    """Return the columns of an Arrow table, with units from the metadata of their fields; nulls are NaN or NaT."""
    columns: dict[str, NDArray[np.generic]] = {}
    for entry, chunks in zip(table.schema, table.columns, strict=True):
        unit = (entry.metadata or {}).get(b"unit", b"").decode()
        columns[f"{entry.name} [{unit}]" if unit else entry.name] = np.asarray(chunks.to_numpy())
    return columns


def write_recording(recording: Recording, path: Path) -> None:
    """Write a recording as Parquet or text, by the extension, so that reading it gives the same numbers."""
    _write(path, *_columns_of(recording))


def write_estimate(estimate: Estimate, path: Path, **options: Any) -> None:
    """Write an estimate as Parquet or text, by the extension; options as for :meth:`strapdown.records.Estimate.table`."""
    _write(path, estimate.table(**options), {})


def _write(path: Path, columns: Mapping[str, NDArray[np.generic]], units: Mapping[str, str]) -> None:
    """Write columns as text, or as Parquet with units as metadata of the fields."""
    if path.suffix.lower() != ".parquet":
        write_columns(path, columns, units)
        return
    arrow, parquet = (library(name, f"writing {path.name}") for name in ("pyarrow", "pyarrow.parquet"))
    arrays = [arrow.array(np.ascontiguousarray(values)) for values in columns.values()]
    fields = [
        arrow.field(name, values.type, metadata={"unit": unit} if (unit := units.get(name)) else None)
        for name, values in zip(columns, arrays, strict=True)
    ]
    with atomic_write(path) as temporary:
        table = arrow.Table.from_arrays(arrays, schema=arrow.schema(fields))
        parquet.write_table(table, temporary, write_page_checksum=True)


def _columns_of(recording: Recording) -> tuple[dict[str, NDArray[np.generic]], dict[str, str]]:
    """Return the data of a recording as columns by the package's names, and the units of the columns that have one."""
    clock = bool(recording.epoch_ns)
    columns: dict[str, NDArray[np.generic]] = {"time": recording.clock_ns if clock else recording.time}
    unit = {"time": "ns" if clock else "s"}
    units = {"gyro": "rad/s", "accelerometer": "m/s2", "magnetometer": recording.magnetic_unit, "temperature": "degC"}
    for group in recording.parts:
        values, roles = getattr(recording, FIELDS[group]), naming.GROUPS[group]
        values = values.astype(np.int64) if group == "movement" else values
        columns |= dict(zip(roles, values.reshape(len(values), -1).T, strict=True))
        unit |= dict.fromkeys(roles, units[group]) if units.get(group) else {}
    return columns, unit
