"""The page of a tuning: the verdict, tables and words that `strapdown tune` wrote to its JSON, with its charts and its filter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import InputError, one_of
from strapdown.consistency.judgement import VERDICTS
from strapdown.files import reading
from strapdown.plots.tuning import TALLEST, interval, measure_of
from strapdown.report import page
from strapdown.results import Table, counted


def report(path: Path) -> tuple[str, dict[str, Any]]:
    """Return the page and the statistics for the JSON of a tuning, with its verdict."""
    content, listed, charts = read(path)
    shown, toml = content["report"], path.with_suffix(".toml")
    parts = [
        page.verdict(shown["verdict"], shown["reason"], shown["details"]),
        *listed,
        *map(page.paragraph, shown["words"]),
    ]
    parts += [page.section(title, *drawn) for title, drawn in charts.items()]
    making = [page.provenance({"records": ", ".join(content["records"]), "units of the JSON": content["units"]})]
    if toml.exists():
        making += [page.paragraph(f"The filter, {toml.name}:"), page.code(reading.text(toml, link=False))]
    making += [
        page.paragraph("To use it with a record; the estimate of a recording takes no filter:"),
        page.code(f'estimate = sd.estimate(record, setup=sd.estimation.setup.read_setup("{toml.name}"))'),
    ]
    subtitle = counted(len(content["records"]), "record")
    html = page.page(f"Tuning: {path.name}", subtitle, *parts, page.section("Provenance", *making))
    return html, {
        "source": path.name,
        "judgement": {key: shown[key] for key in ("verdict", "reason")},
        "tuning": content,
    }


def read(path: Path) -> tuple[dict[str, Any], list[str], dict[str, list[str]]]:
    """Read the JSON of a tuning; return it with the HTML of its tables, and of its charts by the title of their section."""
    content = reading.json_file(path)
    try:
        shown = content["report"]
        one_of("report.verdict", shown["verdict"], VERDICTS)
        texts = [content["units"], *content["records"], shown["reason"], *shown["details"], *shown["words"]]
        tables = [Table(**table) for table in shown["tables"]]
        texts += [
            text for table in tables for row in ([table.title], table.columns, table.notes, *table.rows) for text in row
        ]
        if not all(isinstance(text, str) for text in texts) or not all(isinstance(table.left, int) for table in tables):
            raise TypeError("what is no text")
        listed = [page.listed(table) for table in tables]
        charts = {}
        if "slices" in content:  # of the command
            measure = measure_of(content["objective"]["name"] != "likelihood")
            pairs = zip(content["slices"], content["parameters"], strict=True)
            charts["Likelihood along each parameter"] = [_slice(*pair, measure) for pair in pairs]
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {error} does not fit a tuning; give the JSON that `strapdown tune` writes beside its filter.toml"
        ) from None
    return content, listed, charts


def _slice(curve: dict[str, Any], parameter: dict[str, Any], measure: str) -> str:
    """Return a chart of the likelihood along a parameter, with its interval, its tuned and its previous value."""
    size, unit = parameter.get("si_per_unit", 1.0), parameter.get("unit", "")
    values = np.array(curve["values"]) / size
    first, last = float(values[0]), float(values[-1])
    value, before, low, high = np.array([parameter[key] for key in ("value", "start", "lower", "upper")], float) / size
    low, high = np.fmax(low, first), np.fmin(high, last)
    # A vertical line is two points of one value.
    marks = [x for x in (low, high, value, value, before, before) if first <= x <= last]
    x = np.sort(np.concatenate([np.geomspace(first, last, 400), marks]))
    fallen = np.interp(np.log(x), np.log(values), np.array(curve["fallen"], float))
    up = np.arange(len(x)) % 2 == 1
    line = lambda at: np.where(x == at, np.where(up, TALLEST, 0.0), np.nan)  # noqa: E731
    within = (x >= low) & (x <= high)
    limits = (interval(parameter["identified"]), "its lower limit")
    series = [
        *page.band(np.where(within, 0.0, np.nan), np.where(within, TALLEST, np.nan), limits),
        page.Series(label=measure, value=np.where(fallen <= TALLEST, fallen, np.nan)),
        page.Series(label="tuned", value=line(value), colour="--c"),
        page.Series(label="before", value=line(before), colour="--b", dash=True),
    ]
    axis = f"{curve['name']}, {unit}" if unit else curve["name"]
    return page.chart(curve["name"], measure, x, series, x=axis, log_x=last > 20.0 * first)
