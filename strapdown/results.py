"""Base classes of frozen dataclasses of arrays: equality by value, and printing as a short table. Private.

Specifications (of a gyro, a sensor, a filter) and results that are kept in files derive from :class:`ByValue`: they are written and read
back, and are equal if their values are. Other data are compared by identity; for them ``@dataclass(eq=False)`` is enough. Results derive
from :class:`Listed`.
"""

from __future__ import annotations

import base64
import dataclasses
import io
import math
import re
import textwrap
import types
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any, ClassVar, NamedTuple

import numpy as np

__all__ = ["ByValue", "Column", "Listed", "Table", "counted", "default_of", "equal", "figure", "not_default"]

WIDTH = 88
"""Maximum number of characters in a line of a title or a note."""


_NUMBER = re.compile(r"[-+−±×<>≤≥ ]*[\d∞]|-$")
"""Begin of a cell with a number, or a missing one."""

Value = str | float | int | bool | None
"""Content of a cell; None and NaN are empty."""


class Column(NamedTuple):
    """A column of a :class:`Table`."""

    label: str | None
    """Heading in text, ``quantity`` or ``quantity, unit``; None: the column is in files only."""
    key: str | None = None
    """Heading in CSV, a name with the unit; None: the column is in text only."""
    digits: int = 4
    """Number of significant digits in text."""
    shown: Callable[[Any], str] | None = None
    """Text of a value, if not a number with these digits."""


@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """A table of values with a title and notes: text and HTML here, CSV and LaTeX in :mod:`strapdown.report.tables`."""

    title: str
    columns: Sequence[Column | str]
    """A text is the label of a column."""
    rows: Sequence[Sequence[Any]]
    """One value for each column."""
    notes: Sequence[str] = ()
    left: int = 1
    """Number of leading columns that are at the left also if they hold numbers."""
    name: str = ""
    """Name of its files without suffix."""

    @property
    def _labelled(self) -> list[tuple[int, Column]]:
        columns = [Column(column) if isinstance(column, str) else column for column in self.columns]
        return [(k, column) for k, column in enumerate(columns) if column.label is not None]

    @property
    def head(self) -> list[str]:
        """Headings in text."""
        return [str(column.label) for _, column in self._labelled]

    @property
    def cells(self) -> list[list[str]]:
        """Rows as text."""
        return [[_shown(row[k], column) for k, column in self._labelled] for row in self.rows]

    @property
    def keys(self) -> dict[str, int]:
        """Headings in CSV, and the places of their columns."""
        return {
            column.key: k
            for k, column in enumerate(self.columns)
            if isinstance(column, Column) and column.key is not None
        }

    @property
    def records(self) -> list[dict[str, Any]]:
        """Rows by the keys of the columns."""
        return [{key: row[k] for key, k in self.keys.items()} for row in self.rows]

    @property
    def as_text(self) -> dict[str, Any]:
        """The table with its rows as text, as the arguments of another table."""
        notes = list(self.notes)
        return {"title": self.title, "columns": self.head, "rows": self.cells, "notes": notes, "left": self.left}

    @property
    def sides(self) -> list[str]:
        """Side of each column in text: words are at the left, and numbers after the first columns at the right."""
        columns = list(zip(*self.cells, strict=True)) or [()] * len(self.head)
        return ["right" if k >= self.left and any(map(_NUMBER.match, c)) else "left" for k, c in enumerate(columns)]

    @property
    def lines(self) -> list[str]:
        """Heading, with units in a second line, rule and rows as lines of text; none without rows."""
        heads = list(filter(any, zip(*((*label.rsplit(", ", 1), "")[:2] for label in self.head), strict=True)))
        cells, marks = [*heads, *self.cells], ["<" if side == "left" else ">" for side in self.sides]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        layout = "  ".join(f"{{:{mark}{width}}}" for mark, width in zip(marks, widths, strict=True))
        lines = [layout.format(*row).rstrip() for row in cells]
        return [*lines[: len(heads)], "-" * max(map(len, lines)), *lines[len(heads) :]] if self.rows else []

    @property
    def text(self) -> str:
        """The table with title and notes as text."""
        title = textwrap.wrap(self.title, WIDTH) or [""]
        notes = [
            part
            for note in self.notes
            for line in note.splitlines()
            for part in textwrap.wrap(line, WIDTH, subsequent_indent="  ", break_long_words=False)
        ]
        return "\n".join(line.rstrip() for line in (*title, *self.lines, *notes))

    @property
    def html(self) -> str:
        """The table as HTML, for notebooks."""

        def row(cells: Sequence[str], tag: str) -> str:
            parts = zip(self.sides, cells, strict=True)
            return "".join(f'<{tag} style="text-align:{side}">{escape(cell)}</{tag}>' for side, cell in parts)

        body = "".join(f"<tr>{row(cells, 'td')}</tr>" for cells in self.cells)
        table = f"<table><thead><tr>{row(self.head, 'th')}</tr></thead><tbody>{body}</tbody></table>"
        notes = "".join(f"<p>{escape(line)}</p>" for note in self.notes for line in note.splitlines())
        return f"<div><p><b>{escape(self.title)}</b></p>{table if self.rows else ''}{notes}</div>"


def _shown(value: Value, column: Column) -> str:
    """Return a value as text."""
    if column.shown is not None:
        return column.shown(value)
    if isinstance(value, str):
        return value
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if value is None or not isinstance(value, (int, np.integer)):
        return figure(value, column.digits)
    return str(value)


class Listed:
    """Base of a result that prints as a short table.

    Examples
    --------
    >>> class Result(Listed):
    ...     def listing(self):
    ...         return Table("Errors", ("axis", "deg"), [("x", 0.1), ("y", 12.3)])
    >>> print(Result())
    Errors
    axis   deg
    ----------
    x      0.1
    y     12.3
    """

    _drawn_by: ClassVar[str] = ""
    """Name of the function of ``strapdown.plots`` whose figure a notebook shows below the table."""

    def listing(self) -> Table:
        """Return the result as a table."""
        raise NotImplementedError

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.__repr__ = Listed.__str__  # type: ignore[method-assign, assignment]  # that of a dataclass would print all arrays

    def __str__(self) -> str:
        return self.listing().text

    def _repr_html_(self) -> str:
        html = self.listing().html
        if not self._drawn_by:
            return html
        import strapdown  # loads plots on first use; a layer above this one

        buffer = io.BytesIO()
        getattr(strapdown.plots, self._drawn_by)(self).savefig(buffer, format="png", dpi=90)
        data = base64.b64encode(buffer.getvalue()).decode()
        return f'<div>{html}<img alt="{self._drawn_by}" src="data:image/png;base64,{data}" /></div>'


def figure(value: float | None, digits: int = 4) -> str:
    """Return a number with the given number of significant digits, without exponent up to a million; a dash for None and NaN.

    Examples
    --------
    >>> figure(0.123456), figure(float("nan")), figure(float("inf"))
    ('0.1235', '-', '∞')
    """
    if value is None or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "∞" if value > 0.0 else "-∞"
    number = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+" in number and abs(value) < 1e6 else number


def counted(number: int, noun: str) -> str:
    """Return a number of things in words, such as ``"1 run"`` and ``"20 runs"``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


class ByValue:
    """Base of a frozen dataclass, declared with ``eq=False``, whose instances are equal if all their fields are (:func:`equal`).

    It prints as the fields that differ from their defaults, large arrays as their shapes.

    Examples
    --------
    >>> import numpy as np
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, eq=False)
    ... class Course(ByValue):
    ...     values: np.ndarray
    ...     step: float = 1.0
    >>> Course(np.array([1.0, np.nan])) == Course(np.array([1.0, np.nan]))
    True
    >>> Course(np.zeros((100, 3)))
    Course(values=<array (100, 3)>)
    """

    def __init_subclass__(cls) -> None:
        cls.__repr__ = vars(cls).get("__repr__", ByValue.__repr__)  # type: ignore[method-assign]  # not that of a dataclass
        super().__init_subclass__()

    def __repr__(self) -> str:
        def words(value: Any) -> str:
            return f"<array {value.shape}>" if isinstance(value, np.ndarray) and value.size > 9 else repr(value)

        fields = [f"{name}={words(value)}" for name, value in not_default(self).items()]
        return f"{type(self).__name__}({', '.join(fields)})"

    def __eq__(self, other: object) -> bool:
        """Compare all fields, arrays element by element."""
        if not (isinstance(other, type(self)) or isinstance(self, type(other))):
            return NotImplemented
        names = [field.name for field in dataclasses.fields(self) if field.compare]  # type: ignore[arg-type]
        return self is other or all(equal(getattr(self, name), getattr(other, name)) for name in names)

    def __hash__(self) -> int:
        """Return a hash that equal instances share: that of the names of the fields, since arrays and mappings have none."""
        return hash(tuple(field.name for field in dataclasses.fields(self)))  # type: ignore[arg-type]


def default_of(field: dataclasses.Field[Any]) -> Any:
    """Return the default of a field, ``MISSING`` if there is none."""
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def not_default(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that differ from their defaults; of any other object none."""
    declared = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
    fields = {field: getattr(value, field.name) for field in declared}
    return {field.name: content for field, content in fields.items() if not equal(content, default_of(field))}


def equal(first: Any, other: Any) -> bool:
    """Return whether two values are equal: arrays by their elements, NaN equal to NaN, sequences and mappings by their contents."""
    if isinstance(first, np.ndarray) or isinstance(other, np.ndarray):
        a, b = np.asarray(first), np.asarray(other)
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f" and b.dtype.kind == "f")
    if isinstance(first, Mapping) and isinstance(other, Mapping):
        return set(first) == set(other) and all(equal(first[name], other[name]) for name in first)
    if isinstance(first, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(first) == len(other) and all(map(equal, first, other))
    if isinstance(first, float) and isinstance(other, float) and math.isnan(first):
        return math.isnan(other)
    if isinstance(first, types.MethodType) and isinstance(
        other, types.MethodType
    ):  # Python compares their objects by identity
        return first.__func__ is other.__func__ and bool(first.__self__ == other.__self__)
    return bool(first == other)
