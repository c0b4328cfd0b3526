"""Style of all figures: colours, sizes, saving."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import AutoLocator, LogFormatterSciNotation, LogLocator, NullLocator

from strapdown.checks import Array, one_of
from strapdown.files import atomic_write

BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, YELLOW = "#CC79A7", "#56B4E9", "#F0E442"
CYCLE = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)
AXES = ("x", "y", "z")

STYLE: Any = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "axes.titlesize": "medium",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": "small",
    "font.size": 9.5,
    "axes.prop_cycle": cycler(color=CYCLE),
    "axes.formatter.min_exponent": 5,  # log axes: 0.01, 1, 1000; powers of ten only beyond
    "axes.formatter.useoffset": False,
    "pdf.fonttype": 42,  # TrueType, required by journals
    "svg.hashsalt": "strapdown",  # reproducible files
}
FORMATS = ("png", "pdf", "svg")
"""File formats of figures."""


def ink() -> str:
    """Return the colour of lines and bands that are neither data nor background: black, or light in a dark style of Matplotlib."""
    return str(matplotlib.rcParams["text.color"])


def new_figure(
    rows: int = 1, columns: int = 1, *, size: tuple[float, float] = (8.0, 4.5), **options: Any
) -> tuple[Figure, Any]:
    """Return a figure of ``rows`` × ``columns`` axes in the package's style, which needs no display.

    Parameters
    ----------
    rows : int
        Number of rows of axes.
    columns : int
        Number of columns of axes.
    size : (float, float)
        Width and height, inches.
    **options
        Options of ``Figure.subplots``, such as ``sharex``.

    Returns
    -------
    Figure, Axes or array of Axes
        The figure, with constrained layout, and its axes.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, dpi=150, layout="constrained")
        return figure, figure.subplots(rows, columns, **options)


def save(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure as PNG, PDF or SVG, by the suffix; atomically, and without a date in the file.

    Parameters
    ----------
    figure : Figure
        Figure, as returned by the functions of this package.
    path : path
        File with the suffix .png, .pdf or .svg.

    Returns
    -------
    Path
        The file written.
    """
    label_alike(figure)
    undated: dict[str, Any] = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
    with atomic_write(path) as temporary, matplotlib.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph .* missing from font")  # characters of a file name, drawn as boxes
        figure.savefig(temporary, metadata=undated.get(Path(path).suffix.lower()))
    return Path(path)


def save_as(figures: Mapping[Path, Figure], form: str) -> list[Path]:
    """Write figures, by path, in one format, which replaces the suffix of the path; return the files."""
    one_of("format", form, FORMATS)
    written = [save(figure, path.with_suffix(f".{form}")) for path, figure in figures.items()]
    for path in figures:
        for other in set(FORMATS) - {form}:
            path.with_suffix(f".{other}").unlink(missing_ok=True)
    return written


def label_alike(figure: Figure) -> None:
    """Label logarithmic axes that reach 100,000 or 0.00001 by powers of ten throughout: Matplotlib would write 10000 beside 10⁵."""
    for axis in (axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)):
        if axis.get_scale() == "log" and type(axis.get_major_formatter()) is LogFormatterSciNotation:
            low, high = axis.get_view_interval()
            if low <= 1e-5 or high >= 1e5:
                axis.set_major_formatter(lambda value, _: f"$\\mathdefault{{10^{{{np.log10(value):.0f}}}}}$")


class _LogLocator(LogLocator):
    """Places of labels; at powers of ten only if there would be more than ten labels, at equal distances if there would be one."""

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        """Return the places, of which some may be outside of the limits."""
        ticks = super().tick_values(vmin, vmax)
        number = sum(vmin <= tick <= vmax for tick in ticks)
        return ticks if 2 <= number <= 10 else (AutoLocator() if number < 2 else LogLocator()).tick_values(vmin, vmax)


def log_scale(ax: Axes) -> None:
    """Make the vertical axis logarithmic, with labels in steps of 1, 2, 5 up to three decades: powers of ten may leave one label."""
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(_LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_locator(NullLocator())


def axes_or_new(ax: Axes | None) -> Axes:
    """Return ``ax``, or the axes of a new figure."""
    return new_figure()[1] if ax is None else ax


def layered(k: int, number: int) -> dict[str, Any]:
    """Return the style of line k of several that may coincide: later lines are thinner, so that all are visible."""
    return {"color": CYCLE[k % len(CYCLE)], "linewidth": 0.9 + 0.6 * (number - 1 - k)}


def legend_above(ax: Axes, *, ncols: int = 4) -> None:
    """Put the legend of axes above them on the right, where it covers no curve; the title is on the left."""
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=ncols, frameon=False)


def legend_below(figure: Figure, axes: Sequence[Axes], *, ncols: int = 4) -> None:
    """Put one legend for several axes, each label once, below a figure."""
    handles = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=ncols, frameon=False)


def settled(values: Array) -> Array:
    """Return the values (n, …) over time from the first twentieth on, within which a filter converges: they decide on units and scales."""
    return values[len(values) // 20 :]


def reach(*curves: Array) -> float:
    """Return the limit ± of an axis that shows the settled part of curves (n, …)."""
    return 1.3 * (max(float(np.nanmax(np.abs(settled(curve)), initial=0.0)) for curve in curves) or 1.0)


ALIKE = 2.0
"""Vertical scales of adjacent axes that differ by less than this factor are made equal."""


def match_scales(axes: Sequence[Axes]) -> None:
    """Give adjacent axes the same vertical scale unless it would hide a curve, and mark those with a larger scale."""
    spans = np.array([float(np.ptp(ax.get_ylim())) for ax in axes])
    alike = spans < ALIKE * spans.min()
    for ax, span, is_alike in zip(axes, spans, alike, strict=True):
        if is_alike:
            ax.set_ylim(np.array(ax.get_ylim()) * (spans[alike].max() / span))
        else:
            ratio = span / spans[alike].max()
            ax.set_title(f"vertical scale ×{ratio:.2g}", loc="right", fontsize="small", color=VERMILION)
