"""What all figures share: colours, sizes, saving."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import matplotlib
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from strapdown.files import written_beside

BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, YELLOW, BLACK = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
    "#F0E442",
    "#000000",
)
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
}


def new_figure(
    rows: int = 1, columns: int = 1, *, size: tuple[float, float] = (8.0, 4.5), **options: Any
) -> tuple[Figure, Any]:
    """Return a figure of ``rows`` × ``columns`` axes (an array of them where there are several), laid out without overlap."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, dpi=150, layout="constrained")
        return figure, figure.subplots(rows, columns, **options)


def save(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure (PNG, PDF or SVG by the suffix); the file appears whole or not at all."""
    with written_beside(path) as temporary, matplotlib.rc_context(STYLE):
        figure.savefig(temporary)
    return Path(path)


def axes_or_new(ax: Axes | None) -> Axes:
    """Return ``ax``, or the axes of a new figure."""
    return new_figure()[1] if ax is None else ax


def layered(k: int, number: int) -> dict[str, Any]:
    """Return the style of line k of several that may lie on each other: the later, the thinner, so that all show."""
    return {"color": CYCLE[k % len(CYCLE)], "linewidth": 1.0 + 0.8 * (number - 1 - k)}
