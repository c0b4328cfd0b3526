"""Error statistics over many runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from strapdown.checks import one_of
from strapdown.montecarlo import Statistics
from strapdown.montecarlo.statistics import SUBSETS
from strapdown.plots import style

BOUNDS = "bounds of a consistent filter"


def nees_over_time(
    named: Sequence[tuple[str, Statistics]],
    bounds: tuple[float, float],
    subset: str,
    ax: Axes | None = None,
    *,
    label: str = BOUNDS,
) -> Axes:
    """Draw the ANEES of a subset of the states at each epoch with its bounds, on a log axis.

    Parameters
    ----------
    named : sequence of (str, Statistics)
        Statistics, each with its name for the legend.
    bounds : (float, float)
        Lower and upper bound of the ANEES per state.
    subset : {"state", "attitude", "bias"}
    ax : Axes, optional
        Axes to draw on. Default: those of a new figure.
    label : str
        Legend of the bounds; should state their confidence level.

    Returns
    -------
    Axes
        The axes.
    """
    state = SUBSETS[one_of("subset", subset, SUBSETS)][0]
    ax = style.axes_or_new(ax)
    ax.axhspan(*bounds, color=style.ink(), alpha=0.12, linewidth=0, label=label)
    for k, (name, statistics) in enumerate(named):
        ax.plot(statistics.time, statistics.anees[:, state], label=name, **style.layered(k, len(named)))
    style.log_scale(ax)
    ax.set_xlabel("time, s")
    ax.set_ylabel(f"NEES of the {subset},\nper state (log scale)")
    return ax


def nis_over_time(
    named: Sequence[tuple[str, Statistics]], ax: Axes | None = None, *, label: str = "99 % bounds, each interval"
) -> Axes:
    """Draw the mean NIS per degree of freedom in each interval of time, with the 99 % bounds of one interval.

    Parameters
    ----------
    named : sequence of (str, Statistics)
        Statistics, each with its name for the legend.
    ax : Axes, optional
        Axes to draw on. Default: those of a new figure.
    label : str
        Legend of the bounds.

    Returns
    -------
    Axes
        The axes.
    """
    ax = style.axes_or_new(ax)
    for k, (name, statistics) in enumerate(named):
        measured = statistics.nis_degrees > 0
        ax.plot(statistics.nis_time[measured], statistics.nis[measured], label=name, **style.layered(k, len(named)))
    ax.axhspan(*named[0][1].nis_interval_bounds, color=style.ink(), alpha=0.12, linewidth=0, label=label)
    ax.set_xlabel("time, s")
    ax.set_ylabel("NIS per degree of freedom")
    return ax


def runs_overview(statistics: Statistics) -> Figure:
    """Draw ANEES of attitude and bias, and the NIS, over time, with the bounds of a consistent filter; dots are the tested epochs."""
    figure, axes = style.new_figure(1, 3, size=(10.5, 4.2))
    axes[1].set_visible(statistics.has_bias)
    findings = statistics.judge().findings
    judged = statistics.judged_epochs
    label = "99 % bounds, all tests together"
    low, high = np.nanmin(statistics.anees), np.nanmax(statistics.anees)
    for ax, subset in zip(axes, ("attitude", "bias") if statistics.has_bias else ("attitude",), strict=False):
        bounds = next(
            (finding.low, finding.high) for finding in findings if (finding.name, finding.of) == ("ANEES", subset)
        )
        nees_over_time([("all runs", statistics)], bounds, subset, ax, label=label)
        anees = statistics.anees[judged, SUBSETS[subset][0]]
        ax.plot(statistics.time[judged], anees, ".", color=style.CYCLE[0], label="epochs judged")
        ax.set_ylim(min(0.5, 0.8 * float(low)), max(2.0, 1.3 * float(high)))
    if statistics.sensor_degrees.sum() > 0:
        nis_over_time([("all runs", statistics)], axes[2])
    else:
        axes[2].set_visible(False)
    style.legend_below(figure, [ax for ax in axes if ax.get_visible()], ncols=4)
    return figure
