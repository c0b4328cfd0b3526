"""One self-contained HTML page, without network access or other files. Figures and interactive charts in a light and a dark theme."""

from __future__ import annotations

import base64
import html
import importlib.resources
import json
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from strapdown.checks import Array, InputError
from strapdown.files import reading
from strapdown.plots.decimation import extreme_rows
from strapdown.plots.estimates import wraps
from strapdown.results import Table

if TYPE_CHECKING:
    from strapdown.consistency import Judgement

CHART_SAMPLES = 200_000
"""Maximum number of times of an interactive chart; longer series are reduced to the extremes of each column."""


COLOURS = ("--a", "--b", "--c")
"""Colours of up to three lines, by their names in page.css."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """One line of a chart."""

    label: str
    value: Array
    """Values (n,), in the unit of the chart; a limit of a filled band may be one number."""
    colour: str = "--a"
    """Colour, by its name in page.css."""
    band: bool = False
    """Whether it is the upper limit, followed by the lower limit, of a band, which is filled without lines."""
    wraps: bool = False
    """Whether it is an angle in degrees, whose line is interrupted where it wraps at ±180°."""
    dash: bool = False
    """Whether the line is dashed."""


def band(low: Any, high: Any, labels: tuple[str, str] = ("upper bound", "lower bound"), **look: Any) -> list[Series]:
    """Return the series of a band, by default filled, from its limits; ``labels`` are those of the upper and the lower one."""
    look = look or {"colour": "--faint", "band": True}
    return [Series(label=label, value=value, **look) for label, value in zip(labels, (high, low), strict=True)]


def lines(labels: Sequence[str], values: Iterable[Array], **look: Any) -> list[Series]:
    """Return the series of up to three axes or results, each in its colour."""
    named = zip(labels, values, COLOURS, strict=False)
    return [Series(label=label, value=value, colour=colour, **look) for label, value, colour in named]


def text(content: Any) -> str:
    """Return text escaped for HTML."""
    return html.escape(str(content))


def prose(content: Any) -> str:
    """Return text escaped for HTML, what stands between backticks as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", text(content))


def section(title: str, *parts: str) -> str:
    """Return a section with a heading."""
    anchor = re.sub(r"\W+", "-", title.lower()).strip("-")
    return f'<section id="{anchor}"><h2>{text(title)}</h2>\n' + "\n".join(parts) + "</section>\n"


def _contents(parts: Sequence[str]) -> str:
    """Return links to the sections among the parts of a page."""
    heads = [head for part in parts for head in re.findall(r'<section id="([^"]*)"><h2>(.*?)</h2>', part)]
    links = "".join(f'<li><a href="#{anchor}">{title}</a></li>' for anchor, title in heads)
    return f'<nav aria-label="Contents"><ul>{links}</ul></nav>\n' if len(heads) > 1 else ""


def paragraph(content: str, *, faint: bool = False) -> str:
    """Return a paragraph of text."""
    return f"<p{' class=faint' if faint else ''}>{prose(content)}</p>"


def code(content: str) -> str:
    """Return preformatted text."""
    return f"<pre>{text(content)}</pre>"


MARKS = {"pass": "pass", "FAIL": "fail", "likely": "fail"}
"""Classes of cells by their text."""


def table(content: Table) -> str:
    """Return a table and its notes, without its title; it scrolls on a narrow page, or without numbers wraps its text."""
    kinds = [' class="number"' if side == "right" else "" for side in content.sides]
    head = "".join(f"<th{kind}>{text(cell)}</th>" for kind, cell in zip(kinds, content.head, strict=True))
    rows = []
    for row in content.cells:
        own = [f' class="{MARKS[cell]}"' if cell in MARKS else kind for kind, cell in zip(kinds, row, strict=True)]
        cells = "".join(f"<td{kind}>{prose(cell)}</td>" for kind, cell in zip(own, row, strict=True))
        rows.append(f"<tr>{cells}</tr>")
    frame = 'class="scroll" tabindex="0"' if any(kinds) else 'class="wrap"'  # the arrow keys scroll what has the focus
    notes = (paragraph(note, faint=True) for note in content.notes)
    body = "\n".join([f"<thead><tr>{head.replace(', ', '<br>')}</tr></thead><tbody>", *rows, "</tbody>"])
    return "\n".join([f"<div {frame}><table>{body}</table></div>", *notes])


def listed(content: Table) -> str:
    """Return the section of a table."""
    return section(content.title, table(content))


_KINDS = {"png": ("image/png", b"\x89PNG\r\n\x1a\n"), "svg": ("image/svg+xml", b"<?xml")}
"""Media type and first bytes of the image formats that a page can show."""


def stored_figure(stem: Path, caption: str) -> str:
    """Return the section of a figure that a command wrote beside its result, or the name of its PDF; empty if there is none."""
    pdf = stem.with_name(f"{stem.name}.pdf")
    if pdf.exists():
        return section(caption, paragraph(f"In {pdf.name}, beside the result; draw it as PNG or SVG to see it here."))
    for suffix, (kind, first) in _KINDS.items():
        path = stem.with_name(f"{stem.name}.{suffix}")
        if path.exists():
            content = reading.content(path, link=False)
            if not content.startswith(first):
                raise InputError(f"{path} is not a {suffix.upper()} file; remove it, or draw it again")
            data = base64.b64encode(content).decode()  # the style sheet turns it dark in the dark theme
            return section(
                caption,
                f'<figure class=wide><div class="scroll" tabindex="0"><img src="data:{kind};base64,{data}" '
                f'alt="{text(caption)}"></div><figcaption>{text(caption)}</figcaption></figure>',
            )
    return ""


def chart(
    title: str,
    unit: str,
    time: Array,
    series: Sequence[Series],
    *,
    reach: float | None = None,
    x: str = "time, s",
    ticks: Sequence[str] = (),
    log: bool = False,
    log_x: bool = False,
) -> str:
    """Return an interactive chart over ``time`` (n,), increasing, with its data, all samples as 16-bit numbers, compressed.

    ``unit`` and ``x`` are the labels of the axes. The vertical axis is ±``reach`` at first; None: the range of the data. ``ticks`` are the
    names of 0, 1, … on the horizontal axis, if it has no numbers; lines are then drawn as points.
    """
    rows = np.arange(len(time))
    if len(rows) > CHART_SAMPLES:  # a page of some ten megabytes
        drawn = [line.value for line in series if not line.band]
        columns = CHART_SAMPLES // (2 * len(drawn))
        rows = np.unique(np.concatenate([extreme_rows(time, value, columns) for value in drawn]))
    values = [np.broadcast_to(line.value, time.shape)[rows] for line in series]
    for value, line in zip(values, series, strict=True):
        if line.wraps:
            value[wraps(line.value, rows)] = np.nan
    content = {
        "title": title,
        "unit": unit,
        "x": x,
        "ticks": list(ticks),
        "log": log,
        "log_x": log_x,
        "series": [{"label": s.label, "colour": s.colour, "band": s.band, "dash": s.dash} for s in series],
        "range": None if reach is None else [-reach, reach],
        "time": packed_time(time[rows]),
        "data": [packed(value) for value in values],
    }
    note = f" ({len(rows)} of {len(time)} times, extremes kept)" if len(rows) < len(time) else ""
    return (
        f'<div class="chart"><h3>{text(title + note)}</h3><div class="plot" tabindex="0"></div>'
        f'<script type="application/json">{_json(content)}</script></div>'
    )


def beside_body(charts: Sequence[str], time: Array, attitude: Array) -> str:
    """Return charts beside a picture of the body that shows the attitude q_fb (n, 4) at their cursor."""
    rows = np.unique(np.linspace(0, len(time) - 1, min(len(time), CHART_SAMPLES)).astype(int))
    content = {"time": packed_time(time[rows]), "data": [packed(attitude[rows, k]) for k in range(4)]}
    return (
        f'<div class="beside"><div>{"".join(charts)}</div>'
        '<div class="body"><canvas width="360" height="360" role="img" aria-label="Attitude of the body at the cursor"></canvas>'
        f'<p class="faint"></p><script type="application/json">{_json(content)}</script></div></div>'
    )


def _json(content: Any) -> str:
    return json.dumps(content, allow_nan=False).replace("</", "<\\/")


BLOCK = 4096
"""Number of samples that share a scale, so that a large value does not coarsen the others."""
_MISSING = -32768


def packed(values: Array) -> dict[str, Any]:
    """Return numbers as differences of 16-bit integers, compressed: 1/65534 of the range of each block of 4096; NaN is a gap."""
    scales, offsets = [], []
    integers = np.full(len(values), _MISSING, np.int16)
    for start in range(0, len(values), BLOCK):
        part = values[start : start + BLOCK]
        known = np.isfinite(part)
        low, high = (float(part[known].min()), float(part[known].max())) if known.any() else (0.0, 0.0)
        offset, scale = 0.5 * (low + high), (high - low) / 65534.0
        integers[start : start + BLOCK][known] = np.rint((part[known] - offset) / scale) if scale > 0.0 else 0
        scales.append(scale)
        offsets.append(offset)
    return {"scale": scales, "offset": offsets, "deflate": _compressed(np.diff(integers, prepend=np.int16(0)))}


def packed_time(time: Array) -> dict[str, Any]:
    """Return times as differences of whole microseconds, or of other ticks if 32 bits or the intervals ask for them, compressed."""
    intervals = np.diff(time)
    least = float(intervals[intervals > 0.0].min(initial=1.0))
    tick = max(min(1e-6, 1e-3 * least), float(intervals.max(initial=0.0)) / 2.0**30)
    ticks = np.rint((time - time[0]) / tick).astype(np.int64)
    return {"first": float(time[0]), "tick": tick, "deflate": _compressed(np.diff(ticks, prepend=0).astype(np.int32))}


def _compressed(integers: NDArray[Any]) -> str:
    """Return little-endian integers as base64 of zlib, low bytes before high bytes, which compress better apart."""
    plane = np.ascontiguousarray(integers.astype(integers.dtype.newbyteorder("<"))).view(np.uint8)
    return base64.b64encode(zlib.compress(plane.reshape(len(integers), -1).T.tobytes(), 9)).decode()


def verdict(answer: str, reason: str, details: Sequence[str] = ()) -> str:
    """Return the verdict box: the verdict, its reason, and findings against it."""
    kind = {"consistent": "consistent", "not consistent": "not"}.get(answer, "cannot")
    items = "".join(f"<li>{prose(detail)}</li>" for detail in details)
    listing = f"<ul>{items}</ul>" if items else ""
    said = f"{reason[:1].upper()}{reason[1:]}{'' if reason.endswith('.') else '.'}"
    return f'<div class="verdict {kind}"><strong>{text(answer.capitalize())}.</strong> {prose(said)}{listing}</div>'


def judged(judgement: Judgement) -> str:
    """Return the verdict box of a judgement."""
    reasons = [finding.means for finding in judgement.findings if finding.rejected]
    return verdict(judgement.verdict, judgement.reason, reasons)


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
        f'<header><h1>{text(title)}</h1><p class="faint">{text(subtitle)}</p></header>\n{_contents(parts)}'
        + "\n".join(parts)
        + f"\n{scripts}</body></html>\n"
    )


def provenance(attributes: Mapping[str, Any]) -> str:
    """Return the attributes of a result file: short ones as a table, long ones (such as the TOML of a scenario) in full."""
    short: list[tuple[str, str]] = []
    long: list[tuple[str, str]] = []
    for name, value in attributes.items():
        if isinstance(value, float):
            content = f"{value:.6g}"
        elif isinstance(value, list):  # of sentences
            content = " ".join(map(str, value))
        else:
            content = str(value.decode() if isinstance(value, bytes) else value)
        (long if "\n" in content or len(content) > 160 else short).append((name.replace("_", " "), content))
    parts = [table(Table("", ("attribute", "value"), short, left=2))] if short else []
    parts += [f"<p>{text(name)}</p>" + code(content) for name, content in long]
    return "\n".join(parts)
