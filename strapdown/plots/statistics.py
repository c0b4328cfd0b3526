"""Error statistics over many runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from strapdown.checks import Array, one_of
from strapdown.consistency import mean_bounds
from strapdown.consistency.bounds import COVERED
from strapdown.montecarlo import Statistics
from strapdown.montecarlo.statistics import SUBSETS
from strapdown.plots import style
from strapdown.units import angle_unit, rate_unit

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
    first = named[0][1]
    typical = round(float(np.median(first.nis_degrees[first.nis_degrees > 0]) * first.runs))
    ax.axhspan(*mean_bounds(1, typical), color=style.ink(), alpha=0.12, linewidth=0, label=label)
    ax.set_xlabel("time, s")
    ax.set_ylabel("NIS per degree of freedom")
    return ax


STATES = tuple(f"{what} {axis}" for what in ("attitude", "bias") for axis in style.AXES)
"""Names of the six states of the error (δθ, δb)."""


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


def state_unit(state: int, value: Array) -> tuple[str, float]:
    """Return the unit in which an error of a state (0 to 5) of this magnitude is printed."""
    return angle_unit(value) if state < 3 else rate_unit(value)


def coverage_by_state(statistics: Statistics, epoch: int = -1, ax: Axes | None = None) -> Axes:
    """Draw the fraction of the runs within 1, 2 and 3 σ at one epoch, by state, with the 99 % binomial bounds of a consistent filter."""
    from scipy.stats import binom

    ax = style.axes_or_new(ax)
    runs = int(statistics.finite[epoch])
    for k, expected in enumerate(COVERED):
        low, high = binom.ppf([0.005, 0.995], runs, expected) / runs
        ax.axhspan(100 * low, 100 * high, color=style.CYCLE[k], alpha=0.2, linewidth=0)
        words = f"within {k + 1}σ, expected {100 * expected:.1f} %"
        ax.plot(range(6), 100 * statistics.covered[epoch, :, k], "o", color=style.CYCLE[k], label=words)
    ax.set_xticks(range(6), STATES, rotation=20)
    ax.grid(visible=False, axis="x")
    ax.plot([], [], color=style.ink(), alpha=0.2, linewidth=6, label="99 % bounds of a consistent filter")
    ax.set_ylim(0.0, 104.0)
    ax.set_ylabel(f"fraction of {runs} runs, %")
    style.legend_above(ax, ncols=2)
    return ax


def covariance_ellipses(claimed: Array, actual: Array, pair: tuple[int, int] = (0, 1), ax: Axes | None = None) -> Axes:
    """Draw the 95 % ellipses of the errors of two states: by the filter's covariance, and of the actual errors."""
    from scipy.stats import chi2

    ax = style.axes_or_new(ax)
    i, j = pair
    largest = np.sqrt(max(claimed[i, i], actual[i, i])), np.sqrt(max(claimed[j, j], actual[j, j]))
    alike = i // 3 == j // 3  # two angles, or two rates: the same unit
    (unit_i, size_i), (unit_j, size_j) = (
        state_unit(s, 3.0 * np.array(largest if alike else [x])) for s, x in zip(pair, largest, strict=True)
    )
    scale = np.array([size_i, size_j])
    reach = float(np.sqrt(chi2.ppf(0.95, 2)))
    styles: tuple[tuple[str, Array, dict[str, Any]], ...] = (
        ("filter", claimed, {"edgecolor": style.VERMILION, "linewidth": 2.0}),
        ("actual errors", actual, {"edgecolor": style.ink(), "linewidth": 1.2, "linestyle": "--"}),
    )
    for name, matrix, look in styles:
        P = matrix[np.ix_(pair, pair)] / np.outer(scale, scale)
        value, vector = np.linalg.eigh(P)
        axes = 2.0 * reach * np.sqrt(np.maximum(value, 0.0))
        angle = float(np.degrees(np.arctan2(vector[1, 0], vector[0, 0])))
        ax.add_patch(Ellipse((0.0, 0.0), *axes, angle=angle, facecolor="none", label=name, **look))
    spread = 1.25 * reach * np.array(largest) / scale
    ax.set(xlim=(-spread[0], spread[0]), ylim=(-spread[1], spread[1]))
    ax.set(xlabel=f"{STATES[i]} error, {unit_i}", ylabel=f"{STATES[j]} error, {unit_j}")
    ax.set_title("95 % ellipses", loc="left")
    style.legend_above(ax)
    return ax
