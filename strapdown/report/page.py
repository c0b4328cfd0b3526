"""One self-contained HTML page, without network access or other files. Figures in a light and a dark version, interactive charts."""

from __future__ import annotations

import base64
import html
import importlib.resources
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from strapdown.checks import Array
from strapdown.plots import style
from strapdown.plots.decimation import column_starts, extreme_rows
from strapdown.plots.estimates import wraps

CHART_POINTS = 6000
"""Maximum number of times of an interactive chart; longer series are reduced to the extremes of each column."""
_DOTS_PER_INCH = 120
_WIDE = 7.0
"""Width in inches above which a figure scrolls on a narrow page instead of shrinking."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """One line of a chart."""

    label: str
    value: Array
    """Values (n,), in the unit of the chart."""
    colour: str = "--a"
    """Colour, by its name in page.css."""
    band: bool = False
    """Whether it is the upper limit, followed by the lower limit, of a band, which is filled without lines."""
    wraps: bool = False
    """Whether it is an angle in degrees, whose line is interrupted where it wraps at ±180°."""


def text(content: Any) -> str:
    """Return text escaped for HTML."""
    return html.escape(str(content))


def section(title: str, *parts: str) -> str:
    """Return a section with a heading."""
    return f"<section><h2>{text(title)}</h2>\n" + "\n".join(parts) + "</section>\n"


def paragraph(content: str, *, faint: bool = False) -> str:
    """Return a paragraph of plain text."""
    return f"<p{' class=faint' if faint else ''}>{text(content)}</p>"


def code(content: str) -> str:
    """Return preformatted text."""
    return f"<pre>{text(content)}</pre>"


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], *, numbers: int = 0, marked: Sequence[str] = ()) -> str:
    """Return a table, which scrolls horizontally on a narrow page.

    The last ``numbers`` columns contain numbers and are right-aligned; a table without numbers wraps its text instead of scrolling.
    ``marked`` is the class of the first cell of each row: "pass", "fail", "unsure" or "" for none.
    """
    plain = len(head) - numbers
    heads = [f"<th{' class=number' if j >= plain else ''}>{text(cell)}</th>" for j, cell in enumerate(head)]
    lines = ["<tr>" + "".join(heads) + "</tr>"]
    for k, row in enumerate(rows):
        cells = []
        for j, cell in enumerate(row):
            mark = marked[k] if j == 0 and k < len(marked) else ""
            kind = ' class="number"' if j >= plain else f' class="{mark}"' if mark else ""
            cells.append(f"<td{kind}>{text(cell)}</td>")
        lines.append("<tr>" + "".join(cells) + "</tr>")
    kind = "scroll" if numbers else "wrap"
    focus = ' tabindex="0"' if numbers else ""  # so that the arrow keys scroll it
    return f'<div class="{kind}"{focus}><table>' + "\n".join(lines) + "</table></div>"


def number(value: float, digits: int = 4) -> str:
    """Return a number as text; empty for NaN."""
    return "" if math.isnan(value) else f"{value:.{digits}g}"


def figure(draw: Callable[[], Figure], caption: str) -> str:
    """Return a figure, drawn in each theme; the page shows that of the reader's colour scheme."""
    (light, wide), (dark, _) = (_image(draw, theme) for theme in ("light", "dark"))
    kind = " class=wide" if wide else ""
    return (
        f'<figure{kind}><div class="scroll" tabindex="0"><picture><source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img src="{light}" alt="{text(caption)}"></picture></div><figcaption>{text(caption)}</figcaption></figure>'
    )


def _image(draw: Callable[[], Figure], theme: str) -> tuple[str, bool]:
    """Return a figure as a data URL, and whether it is too wide to be readable when shrunk to a phone."""
    with style.theme(theme):
        buffer = io.BytesIO()
        drawn = draw()
        drawn.savefig(buffer, format="png", dpi=_DOTS_PER_INCH)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode(), drawn.get_figwidth() > _WIDE


def chart(title: str, unit: str, time: Array, series: Sequence[Series], *, reach: float | None = None) -> str:
    """Return an interactive time series with its data; the initial vertical axis is ±``reach``, or the range of the data."""
    lines = [one.value for one in series if not one.band]
    bands = [k for k, one in enumerate(series) if one.band][::2]
    columns = CHART_POINTS // (2 * len(lines))
    rows = np.unique(np.concatenate([extreme_rows(time, value, columns) for value in lines]))
    reduced = len(rows) < len(time)
    shown = [one.value[rows] for one in series]
    if reduced:
        starts = column_starts(time, columns)
        group = np.searchsorted(starts, rows, side="right") - 1
        for k in bands:
            shown[k] = np.fmax.reduceat(series[k].value, starts)[group]
            shown[k + 1] = np.fmin.reduceat(series[k + 1].value, starts)[group]
    for k, one in enumerate(series):
        if one.wraps:
            shown[k] = np.where(np.isin(np.arange(len(rows)), wraps(one.value, rows)), np.nan, shown[k])
    content = {
        "unit": unit,
        "series": [{"label": s.label, "colour": s.colour, "band": s.band} for s in series],
        "bands": [[1 + k, 2 + k] for k in bands],
        "range": None if reach is None else [-reach, reach],
        "data": [_numbers(time[rows]), *(_numbers(values) for values in shown)],
    }
    plain = json.dumps(content, allow_nan=False).replace("</", "<\\/")
    widest = ", band at its widest" if bands else ""
    note = f" ({len(rows)} of {len(time)} times, extremes kept{widest})" if reduced else ""
    return (
        f'<div class="chart"><h3>{text(title + note)}</h3><div class="plot"></div>'
        f'<script type="application/json">{plain}</script></div>'
    )


def _numbers(values: Array) -> list[float | None]:
    return [float(f"{x:.7g}") if math.isfinite(x) else None for x in values.tolist()]


def verdict(answer: str, reason: str, details: Sequence[str] = ()) -> str:
    """Return the verdict box: the verdict, its reason, and findings against it."""
    kind = {"consistent": "consistent", "not consistent": "not"}.get(answer, "cannot")
    items = "".join(f"<li>{text(detail)}</li>" for detail in details)
    listing = f"<ul>{items}</ul>" if items else ""
    said = f"{reason[:1].upper()}{reason[1:]}{'' if reason.endswith('.') else '.'}"
    return f'<div class="verdict {kind}"><strong>{text(answer.capitalize())}.</strong> {text(said)}{listing}</div>'


def page(title: str, subtitle: str, *parts: str) -> str:
    """Return the complete page."""
    read = lambda name: (importlib.resources.files("strapdown.report") / name).read_text(encoding="utf-8")  # noqa: E731
    scripts = ""
    if any('class="chart"' in part for part in parts):
        library = read("uplot/uPlot.iife.min.js").replace("</script", "<\\/script")
        scripts = f"<script>{library}</script>\n<script>{read('charts.js')}</script>\n"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n"
        '<link rel="icon" href="data:,">\n'
        f"<style>{read('uplot/uPlot.min.css')}\n{read('page.css')}</style></head>\n<body>\n"
        f'<header><h1>{text(title)}</h1><p class="faint">{text(subtitle)}</p></header>\n'
        + "\n".join(parts)
        + f"\n{scripts}</body></html>\n"
    )


def provenance(attributes: Mapping[str, Any]) -> str:
    """Return the attributes of a result file: short ones as a table, long ones (such as the TOML of a scenario) in full."""
    short: list[tuple[str, str]] = []
    long: list[tuple[str, str]] = []
    for name, value in attributes.items():
        content = (
            f"{value:.6g}" if isinstance(value, float) else str(value.decode() if isinstance(value, bytes) else value)
        )
        (long if "\n" in content or len(content) > 160 else short).append((name.replace("_", " "), content))
    parts = [table(("attribute", "value"), short)] if short else []
    parts += [f"<p>{text(name)}</p>" + code(content) for name, content in long]
    return "\n".join(parts)
