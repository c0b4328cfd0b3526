"""Recordings as delimited text (CSV, TSV and similar), with a header of any names.

The separator is the one of ``, ; tab |`` that splits the header into most columns. Lines above the header are skipped if they have fewer
fields than time and gyro need. Lines that begin with ``#`` are comments; if there is no other header before the numbers, the last comment
is the header (EuRoC). Two header rows are joined: an empty cell of the first takes the
value of the cell before it (RepoIMU), and a second row of units is put in brackets. If the separator is not a comma, decimal commas are
accepted. Roles of the columns: :mod:`strapdown.recordings.columns`. Axes, units and clock are those of the file's columns. Integer stamps
are read as integers, so that nanoseconds since 1970 keep all their digits. A time may be an ISO 8601 date, to the microsecond, UTC unless
it has a time zone.

:func:`write_columns` writes the package's names with units in brackets and 17 digits per number; time is in ns of the source's clock if
that counts from 1970, else in s.
"""

from __future__ import annotations

import csv
import datetime
import io
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from strapdown.checks import Array, InputError
from strapdown.files import atomic_write, reading
from strapdown.recordings import columns as naming
from strapdown.records.recording import Recording

SEPARATORS = ",;\t|"
_SEPARATOR = f"[{SEPARATORS}]"
FEWEST_COLUMNS = 4
"""Time and the three axes of a gyro: lines above the header with fewer fields are skipped."""


def read_csv(
    file: Path, *, units: Mapping[str, str] | None = None, columns: Mapping[str, str] | None = None
) -> Recording:
    """Read a text table, by default with columns ``time, gx, gy, gz[, ax, ay, az[, mx, my, mz]]`` in any order.

    Other columns are ignored. Empty fields of accelerometer and magnetometer are missing samples. Rows with an empty field of the gyro are
    left out and listed in ``missing_gyro``, their other samples moved to the nearest row; rows with the stamp of the row before are left
    out and listed in ``repeated``. Options as for :func:`strapdown.read`.
    """
    return naming.recording(Table(file), units=units, columns=columns)


class Table:
    """A header and rows of numbers; only the requested columns are read, the others may have any content."""

    def __init__(self, file: Path) -> None:
        self.source = file.name
        lines = io.StringIO(reading.text(file), newline="")
        self.header, self._separator, first = _head(self.source, lines)
        self._stamps: list[str] = []  # cells of the time
        rest = (line for line in lines if line.strip() and not line.lstrip().startswith("#"))
        self._rows = csv.reader(itertools.chain(first, rest), delimiter=self._separator)

    def load(self, places: Sequence[int], time: int) -> dict[int, Array]:
        """Return the numbers (n,) of columns; empty fields are NaN, dates in the time column are ns since 1970."""
        result: list[list[float]] = []
        width = len(self.header)
        for k, row in enumerate(self._rows):
            if len(row) == width + 1 and not row[-1].strip():
                del row[-1]  # a separator at the end of the line
            if len(row) != width:
                numbers = width < len(row) and all(re.fullmatch(r"\s*-?\d+(e-?\d+)?\s*", part) for part in row)
                why = "the file is truncated or damaged there"
                why = "it seems to have decimal commas: write points" if numbers else why
                raise InputError(f"{self.source}: data row {k + 1} has {len(row)} fields, the header {width}; {why}")
            try:
                result.append([float(cell) if (cell := row[j]).strip() else np.nan for j in places])
            except ValueError:
                result.append([self._number(k, j, row[j], j == time) for j in places])
            self._stamps.append(row[time])
        if not result:
            raise InputError(f"{self.source} has a header but no data rows")
        return dict(zip(places, np.array(result).T.copy(), strict=True))

    def _number(self, row: int, place: int, cell: str, time: bool) -> float:
        """Return a cell's number; it may have a decimal comma if that is not the separator, and a time may be a date."""
        try:
            if time and (date := date_ns(cell)) is not None:
                return float(date)
            return float(cell if self._separator == "," else cell.replace(",", ".")) if cell.strip() else np.nan
        except ValueError:
            where = f"data row {row + 1}, column {self.header[place]}"
            remedy = "; write seconds, or dates such as 2026-11-28T10:15:30.25" if time else ""
            raise InputError(f"{self.source}: {where} is {cell!r}, not a number{remedy}") from None

    def clock_ns(self, unit: str) -> NDArray[np.int64] | None:
        """Return the loaded stamps, of a unit, "" if unknown, if they are dates, or integers that count ns from 1970; else None."""
        if date_ns(self._stamps[0]) is not None:
            stamps = list(map(date_ns, self._stamps))
        elif unit in ("", "ns") and all(re.fullmatch(r"\s*\d{18,19}\s*", cell) for cell in self._stamps):
            stamps = list(map(int, self._stamps))
        else:
            return None
        return None if None in stamps else np.array(stamps, np.int64)


def _head(source: str, lines: Iterator[str]) -> tuple[list[str], str, list[str]]:
    """Return the names of the columns of a table, its separator, and its first lines of numbers."""
    titles: list[str] = []
    above: list[str] = []
    comment = ""
    first: list[str] = []
    for line in lines:
        if not line.strip():
            continue
        if line.lstrip().startswith("#"):
            comment = line.lstrip().lstrip("#").strip() or comment
            continue
        if not titles and len(re.split(_SEPARATOR, line)) < FEWEST_COLUMNS:
            above.append(line.strip())
            continue
        if _numeric(line):
            titles, first = titles or [comment], [line]  # without a header line, the last comment may be the header
            break
        titles.append(line.rstrip("\r\n"))
        if len(titles) == 3:
            first = [titles.pop()]
            break
    titles = titles or above[:1]
    if not any(title.strip() for title in titles):
        words = "has no header" if first else "is empty"
        raise InputError(f"{source} {words}; wanted a header like time,gx,gy,gz,ax,ay,az")
    separator = max(SEPARATORS, key=titles[0].count)
    cells = [next(csv.reader([title], delimiter=separator)) for title in titles]
    # A second row belongs to the header if it has no number, and the width of the first.
    numbers = any(is_number(cell) and cell.strip() for cell in cells[-1])
    if len(cells) == 2 and (numbers or len(cells[0]) != len(cells[1])):
        first, cells = [titles[1], *first], cells[:1]  # a data row that is not numeric: the error names its place
    names = [cell.strip() for cell in cells[0]] if len(cells) == 1 else _joined(*cells)
    while names and not names[-1]:
        names.pop()
    return names, separator, first


def date_ns(cell: str) -> int | None:
    """Return an ISO 8601 date and time in ns since 1970, UTC if it has no time zone; None for other text."""
    if not re.match(r"\s*\d{4}-\d\d-\d\d[T ]", cell):
        return None
    try:
        date = datetime.datetime.fromisoformat(cell.strip())
    except ValueError:
        return None
    date = date if date.tzinfo else date.replace(tzinfo=datetime.UTC)
    since = date - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


def _joined(first: Sequence[str], second: Sequence[str]) -> list[str]:
    """Return the names from two header rows: a second row of units is put in brackets, one of axes or names is appended."""
    if all(any(naming.unit_of(group, cell) for group in naming.UNITS) for cell in second if cell.strip()):
        return [f"{a.strip()} [{b.strip()}]" if b.strip() else a.strip() for a, b in zip(first, second, strict=True)]
    names, before = [], ""
    for a, b in zip(first, second, strict=True):
        before = a.strip() or before
        column = naming.column(before)
        name = f"{column.name} {b.strip()}".strip()
        names.append(f"{name} [{column.unit}]" if column.unit and "[" not in b else name)
    return names


def _numeric(line: str) -> bool:
    """Return whether at least half of the non-empty fields of a line are numbers, with any separator."""
    filled = [cell for part in re.split(_SEPARATOR, line) if (cell := part.strip().strip('"'))]
    return bool(filled) and 2 * sum(map(is_number, filled)) >= len(filled)


def is_number(cell: str) -> bool:
    """Return whether a cell is a number or empty."""
    try:
        float(cell or "nan")
    except ValueError:
        return False
    return True


def write_columns(path: Path, columns: Mapping[str, NDArray[np.generic]], units: Mapping[str, str]) -> None:
    """Write columns of numbers as text, with 17 digits per number, integers as integers; NaN is an empty field.

    Units are in brackets behind the names. If the extension is ``.tsv``, the separator is a tab.
    """
    names = [f"{name} [{units[name]}]" if name in units else name for name in columns]
    separator = "\t" if path.suffix.lower() == ".tsv" else ","
    texts = [["" if math.isnan(x) else repr(x) for x in column.tolist()] for column in columns.values()]
    with atomic_write(path) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
        file.write(separator.join(names) + "\n")
        file.writelines(separator.join(row) + "\n" for row in zip(*texts, strict=True))
