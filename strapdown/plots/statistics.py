"""Error statistics over many runs and over one record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from strapdown.consistency import mean_bounds
from strapdown.montecarlo import Statistics
from strapdown.plots.style import BLACK, axes_or_new, layered


def nees_over_time(
    named: Sequence[tuple[str, Statistics]], bounds: tuple[float, float], subset: str, ax: Axes | None = None
) -> Axes:
    """Draw the ANEES of a ``subset`` ("state", "attitude", "bias") at each epoch with its bounds, on a log axis."""
    ax = axes_or_new(ax)
    column = ("state", "attitude", "bias").index(subset)
    ax.axhspan(*bounds, color=BLACK, alpha=0.12, linewidth=0, label="bounds of a right filter")
    for k, (name, statistics) in enumerate(named):
        ax.plot(statistics.time, statistics.anees[:, column], label=name, **layered(k, len(named)))
    ax.set_yscale("log")
    ax.set_xlabel("time, s")
    ax.set_ylabel(f"NEES of the {subset}, per state")
    return ax


def nis_over_time(
    named: Sequence[tuple[str, Statistics]], ax: Axes | None = None, *, probability: float = 0.99
) -> Axes:
    """Draw the mean NIS per degree of freedom in each bin of time with its bounds."""
    ax = axes_or_new(ax)
    for k, (name, statistics) in enumerate(named):
        seen = statistics.nis_degrees > 0
        ax.plot(statistics.nis_time[seen], statistics.nis[seen], label=name, **layered(k, len(named)))
    first = named[0][1]
    typical = round(float(np.median(first.nis_degrees[first.nis_degrees > 0]) * first.runs))
    ax.axhspan(
        *mean_bounds(1, typical, probability), color=BLACK, alpha=0.12, linewidth=0, label="bounds of a right filter"
    )
    ax.set_xlabel("time, s")
    ax.set_ylabel("NIS per degree of freedom")
    return ax
