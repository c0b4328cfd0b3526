"""Tables of studies, written as CSV with all digits and as LaTeX.

The numbers of a study are rows with the unit in each key, as in its JSON; in LaTeX the key is printed in words.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.files import written_beside
from strapdown.units import ARCSECOND, DEGREE_PER_HOUR

Value = str | float | int | bool | None
"""Content of a cell; None and NaN are empty."""


@dataclass(frozen=True, eq=False)
class Table:
    """One table of a study."""

    name: str
    """Name of the files without suffix."""
    caption: str
    columns: Sequence[str]
    """Keys of the rows, in the order of the columns; other keys are not written."""
    rows: Sequence[Mapping[str, Any]]

    def cells(self) -> list[list[Value]]:
        """Return the values, one list per row."""
        return [[row[key] for key in self.columns] for row in self.rows]


def write(tables: Sequence[Table], folder: str | os.PathLike[str]) -> list[Path]:
    r"""Write tables to a folder, which is created if missing, as ``NAME.csv`` and ``NAME.tex``; return the files."""
    written = []
    for table in tables:
        for suffix, content in (("csv", to_csv(table)), ("tex", to_latex(table))):
            written.append(Path(folder) / f"{table.name}.{suffix}")
            with written_beside(written[-1]) as temporary:
                temporary.write_text(content, encoding="utf-8", errors="backslashreplace", newline="")
    return written


def to_csv(table: Table) -> str:
    """Return a table as CSV (RFC 4180), UTF-8, with one header line."""
    stream = io.StringIO()
    writer = csv.writer(stream)
    writer.writerow(table.columns)
    writer.writerows([["" if _empty(cell) else _no_formula(cell) for cell in row] for row in table.cells()])
    return stream.getvalue()


def _no_formula(cell: Value) -> Value:
    """Return a cell, text that a spreadsheet would run as a formula behind an apostrophe: names may come from a file of someone else."""
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@", "\t", "\r")) else cell


def to_latex(table: Table) -> str:
    """Return a table as LaTeX: a ``tabular`` with rules of ``booktabs``, text left-aligned and numbers right-aligned."""
    rows = table.cells()
    sides = [
        "l" if any(isinstance(row[k], (str, bool, np.bool_)) for row in rows) else "r"
        for k in range(len(table.columns))
    ]
    lines = [f"% {_line(table.caption)}", "% needs \\usepackage{booktabs}", f"\\begin{{tabular}}{{{''.join(sides)}}}"]
    lines += ["\\toprule", _row(_escaped(_heading(key)) for key in table.columns), "\\midrule"]
    lines += [_row(_cell(cell) for cell in row) for row in rows]
    lines += ["\\bottomrule", "\\end{tabular}"]
    return "\n".join(lines) + "\n"


def _empty(cell: Value) -> bool:
    return cell is None or (isinstance(cell, float) and math.isnan(cell))


def _line(text: str) -> str:
    """Return text on one line, for a comment."""
    return " ".join(text.split())


def _row(cells: Any) -> str:
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
    digits, _, exponent = (str(cell) if isinstance(cell, int) else f"{cell:.4g}").partition("e")
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


def of_coning(summary: Mapping[str, Any]) -> list[Table]:
    """Return the tables of a coning study's :meth:`~strapdown.montecarlo.coning_study.ConingStudy.summary`: ``drift`` and ``filters``."""
    scenario = summary["scenario"]
    case = f"coning {scenario['angle_deg']:g}° at {scenario['frequency_hz']:g} Hz, gyro at {scenario['rate_hz']:g} Hz"
    rows = [{**row, "bias_mean_z_deg_per_hour": row["bias_mean_deg_per_hour"][2]} for row in summary["filter"]]
    errors = ("attitude_rms_arcsec", "attitude_sigma_arcsec", "bias_rms_deg_per_hour", "bias_sigma_deg_per_hour")
    tests = ("bias_mean_z_deg_per_hour", "anees_attitude", "anees_bias", "nis", "consistent")
    return [
        Table(
            "drift",
            f"Drift about the cone's axis by integration algorithm, {case}",
            ("algorithm", "samples", "drift_deg_per_hour", "predicted_deg_per_hour"),
            summary["integration"],
        ),
        Table(
            "filters",
            f"The same filter with each algorithm, {scenario['runs']} runs, {case}",
            ("integration", *errors, *tests),
            rows,
        ),
    ]


def of_algorithms(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Return the table of the integration algorithms from the rows of :func:`strapdown.coning.algorithm_rows`, with times if given."""
    keyed = [{key.replace(" ", "_"): value for key, value in row.items()} for row in rows]
    known = ("name", "needs", "samples", "previous", "following", "order", "drift_order", "drift_constant")
    shown = [key for key in (*known, "ns_per_sample", "source") if all(key in row for row in keyed)]
    caption = (
        "Integration algorithms: drift under small coning is -C β² ω (ωh)^n, C the drift constant and n the drift order"
    )
    return [Table("algorithms", caption, shown, keyed)]


def of_vibration(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Return the table of the drift due to a vibration spectrum, from rows ``algorithm, sample_rate_hz, drift_deg_per_hour``."""
    columns = ("algorithm", "sample_rate_hz", "drift_deg_per_hour")
    return [Table("coning-budget", "Drift due to a vibration spectrum", columns, rows)]


def of_montecarlo(summary: Mapping[str, Any]) -> list[Table]:
    """Return the tables of a Monte Carlo's :func:`strapdown.montecarlo.summary`: ``consistency`` and ``errors`` (last epoch)."""
    rows = [
        {"statistic": "NEES", "of": subset, "mean": part["anees"], **_ends(part)} | {key: part[key] for key in _RANGE}
        for subset, part in summary["nees"].items()
    ]
    rows += [
        {"statistic": "NIS", "of": part["sensor"], "mean": part["nis"], **_ends(part)} | dict.fromkeys(_RANGE)
        for part in summary["nis"]
    ]
    last, coverage = summary["last_epoch"], summary["coverage"]
    quantiles = sorted(key.split("_")[3] for key in last if key.startswith("attitude_error_quantile_"))
    sizes = ("mean_error", "rms_error", "sigma", *(f"error_quantile_{q}" for q in quantiles))
    errors = [
        {"state": f"{what} {axis}", "unit": shown, **{key: last[f"{what}_{key}_{unit}"][k] for key in sizes}}
        for what, unit, shown in (("attitude", "arcsec", "arcsec"), ("bias", "deg_per_hour", "°/h"))
        if f"{what}_rms_error_{unit}" in last  # not all filters estimate a bias
        for k, axis in enumerate("xyz")
    ]
    inside = [f"inside_{k}_sigma" for k in (1, 2, 3)]
    shares = [{"of": what, **dict(zip(inside, coverage[what], strict=True))} for what in coverage]
    runs = f"{summary['runs']} runs"
    return [
        Table(
            "consistency",
            f"NEES and NIS per degree of freedom, {runs}, bounds {100 * summary['probability']:g} % together",
            ("statistic", "of", "mean", *_RANGE, "lower_bound", "upper_bound", "consistent"),
            rows,
        ),
        Table(
            "errors",
            f"Errors at {last['time_s']:g} s, {runs}; quantiles of the absolute error",
            ("state", "unit", *sizes),
            errors,
        ),
        Table("coverage", f"Fraction of errors within 1, 2, 3 σ at the tested epochs, {runs}", ("of", *inside), shares),
    ]


_RANGE = ("least", "greatest")


def _ends(part: Mapping[str, Any]) -> dict[str, Any]:
    low, high = part["bounds"]
    return {"lower_bound": low, "upper_bound": high, "consistent": part["consistent"]}


def of_covariance(budget: Sequence[tuple[str, str, float, float]]) -> list[Table]:
    """Return the error budget of :meth:`strapdown.covariance.Analysis.budget`, sorted by decreasing attitude error."""
    columns = ("source", "kind", "attitude_arcsec", "bias_deg_per_hour")
    rows = [
        dict(zip(columns, (source, kind, attitude / ARCSECOND, bias / DEGREE_PER_HOUR), strict=True))
        for source, kind, attitude, bias in sorted(budget, key=lambda row: -row[2])
    ]
    return [Table("budget", "Error budget at the end, RMS of one axis", columns, rows)]


def of_tuning(content: Mapping[str, Any]) -> list[Table]:
    """Return the tables for the JSON of a tuning: ``parameters`` and, if data were held out, ``held-out``."""
    per = lambda one, key: None if one[key] is None else one[key] / one["si_per_unit"]  # noqa: E731
    rows = [
        {**one, "before": per(one, "start"), "after": per(one, "value")}
        | {"lower_95": per(one, "lower"), "upper_95": per(one, "upper")}
        for one in content["parameters"]
    ]
    columns = ("name", "unit", "before", "after", "lower_95", "upper_95", "identified")
    tables = [Table("parameters", "Tuned noise parameters with 95 % intervals", columns, rows)]
    if "held_out" in content:
        held = [
            {**one, "filter": name, "nis_lower": one["nis_bounds"][0], "nis_upper": one["nis_bounds"][1]}
            for name, one in content["held_out"].items()
        ]
        statistics = ("log_likelihood_per_innovation", "nis_per_degree", "nis_lower", "nis_upper", "anees_per_state")
        caption = "The filter before and after tuning on held-out data; NIS with 99 % bounds"
        tables.append(Table("held-out", caption, ("filter", *statistics, "attitude_rms_rad"), held))
    return tables


def of_allan(rows: Sequence[Mapping[str, Any]], sensor: str) -> list[Table]:
    """Return the noise coefficients of a sensor, from the rows of :func:`strapdown.allan.table`, as ``SENSOR-noise``."""
    shown = [
        {
            **row,
            "axis": "xyz"[int(row["axis"])],
            "term": str(row["term"]).replace("_", " "),
            **{key: row[key] if row["supported"] else None for key in ("estimate", "lower")},
        }
        for row in rows
    ]
    columns = ("axis", "term", "symbol", "unit", "estimate", "lower", "upper", "supported")
    return [Table(f"{sensor}-noise", f"Noise coefficients of the {sensor} with 95 % intervals", columns, shown)]


STUDIES: dict[str, Callable[..., list[Table]]] = {
    "coning": of_coning,
    "algorithms": of_algorithms,
    "coning budget": of_vibration,
    "montecarlo": of_montecarlo,
    "covariance": of_covariance,
    "tuning": of_tuning,
    "allan": of_allan,
}
"""Functions that return the tables of each study."""
