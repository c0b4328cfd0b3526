"""Tables written as CSV with all digits and as LaTeX, which prints the keys of the columns in words."""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from strapdown.files import write_text
from strapdown.results import Table, Value


def write(tables: Sequence[Table], folder: str | os.PathLike[str]) -> list[Path]:
    r"""Write tables to a folder, which is created if missing, as ``NAME.csv`` and ``NAME.tex``; return the files."""
    written = []
    for table in tables:
        for suffix, content in (("csv", to_csv(table)), ("tex", to_latex(table))):
            written.append(Path(folder) / f"{table.name}.{suffix}")
            write_text(written[-1], content, errors="backslashreplace", newline="")
    return written


def to_csv(table: Table) -> str:
    """Return a table as CSV (RFC 4180), UTF-8, with one header line."""
    stream = io.StringIO()
    writer = csv.writer(stream)
    writer.writerow(table.keys)
    for row in table.records:
        cells = ("" if _empty(cell) else cell for cell in row.values())
        # Text that a spreadsheet would run as a formula behind an apostrophe: names may come from a file of someone else.
        formulas = ("=", "+", "-", "@", "\t", "\r")
        writer.writerow([f"'{x}" if isinstance(x, str) and x.startswith(formulas) else x for x in cells])
    return stream.getvalue()


def to_latex(table: Table) -> str:
    """Return a table as LaTeX: a ``tabular`` with rules of ``booktabs``, text left-aligned and numbers right-aligned."""
    rows = [list(row.values()) for row in table.records]
    sides = [
        "l" if any(isinstance(row[k], (str, bool, np.bool_)) for row in rows) else "r" for k in range(len(table.keys))
    ]
    lines = [f"% {_line(table.title)}", "% needs \\usepackage{booktabs}", f"\\begin{{tabular}}{{{''.join(sides)}}}"]
    lines += ["\\toprule", _row(_escaped(_heading(key)) for key in table.keys), "\\midrule"]
    lines += [_row(_cell(cell) for cell in row) for row in rows]
    lines += ["\\bottomrule", "\\end{tabular}"]
    return "\n".join(lines) + "\n"


def _empty(cell: Value) -> bool:
    return cell is None or (isinstance(cell, float) and math.isnan(cell))


def _line(text: str) -> str:
    """Return text on one line, for a comment."""
    return " ".join(text.split())


def _row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _cell(cell: Value) -> str:
    if _empty(cell):
        return ""
    if isinstance(cell, (bool, np.bool_)):
        return "yes" if cell else "no"
    if isinstance(cell, str):
        return _escaped(cell)
    if math.isinf(cell):  # type: ignore[arg-type]
        return r"$-\infty$" if cell < 0 else r"$\infty$"  # type: ignore[operator]
    digits, _, exponent = (str(cell) if isinstance(cell, (int, np.integer)) else f"{cell:.4g}").partition("e")
    power = rf" \times 10^{{{int(exponent)}}}" if exponent else ""
    return f"${digits}{power}$"


_SIGNS = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "°": r"$^\circ$",
    "±": r"$\pm$",
    "−": r"$-$",
    "²": r"$^2$",
    "µ": r"$\mu$",
    "σ": r"$\sigma$",
    "β": r"$\beta$",
    "ω": r"$\omega$",
    "τ": r"$\tau$",
    "χ": r"$\chi$",
    "…": r"\dots{}",
}


def _escaped(text: str) -> str:
    parts = re.split(r"√(\w+)", _line(text))  # every second part is under a root
    plain = ["".join(_SIGNS.get(sign, sign) for sign in part) for part in parts]
    return "".join(rf"$\sqrt{{\mathrm{{{part}}}}}$" if k % 2 else part for k, part in enumerate(plain))


_UNITS = {"_deg_per_hour": ", °/h", "_arcsec": ", arcsec", "_hz": ", Hz", "_rad": ", rad"}
_WORDS = {"rms": "RMS", "sigma": "σ", "anees": "ANEES", "nis": "NIS"}


def _heading(key: str) -> str:
    """Return a key in words, followed by a comma and its unit."""
    unit = next((unit for unit in _UNITS if key.endswith(unit)), "")
    words = key.removesuffix(unit).split("_")
    return " ".join(_WORDS.get(word, word) for word in words) + _UNITS.get(unit, "")
