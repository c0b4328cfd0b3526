"""Innovations of one record: magnitude, distribution, autocorrelation."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from strapdown.checks import Array
from strapdown.consistency import Autocorrelation
from strapdown.plots.decimation import decimated
from strapdown.plots.style import AXES, BLUE, CYCLE, ORANGE, SKY, VERMILION, axes_or_new, ink, legend_above
from strapdown.records import Innovations
from strapdown.units import angle_unit

WINDOW = 50
"""Number of measurements of a moving average."""
HISTOGRAM_REACH = 5.0
"""Range of histograms of whitened innovations, ±σ; the number beyond it is in the legend."""


def innovation_histogram(whitened: Array, ax: Axes | None = None) -> Axes:
    """Draw the histogram of whitened innovations (n, dof), all components together, and the standard normal density."""
    ax = axes_or_new(ax)
    z = whitened[np.isfinite(whitened)]
    number = int(np.clip(np.sqrt(len(z)), 12, 80))
    edges = np.linspace(-HISTOGRAM_REACH, HISTOGRAM_REACH, number + 1)
    clipped, words = np.clip(z, -HISTOGRAM_REACH, HISTOGRAM_REACH), f"{len(z)} innovations"
    ax.hist(clipped, bins=edges.tolist(), density=True, color=SKY, edgecolor="none", label=words)
    x = np.linspace(-HISTOGRAM_REACH, HISTOGRAM_REACH, 401)
    ax.plot(x, np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi), color=ink(), linewidth=1.4, label="standard normal")
    beyond = int(np.sum(np.abs(z) > HISTOGRAM_REACH))
    if beyond:
        ax.plot([], [], " ", label=f"{beyond} beyond {HISTOGRAM_REACH:g} σ, in the outermost bins")
    ax.set_xlabel("innovation over its σ")
    ax.set_ylabel("density")
    legend_above(ax)
    return ax


def innovation_autocorrelation(result: Autocorrelation, ax: Axes | None = None) -> Axes:
    """Draw the autocorrelation of each component with the bounds for one lag and for all lags together."""
    ax = axes_or_new(ax)
    lags, number = result.lags, result.values.shape[1]
    width = 0.7 / number
    for k in range(number):
        places = lags + (k - 0.5 * (number - 1)) * width
        label = AXES[k] if number > 1 else "innovations"
        ax.bar(places, result.values[:, k], width=width, color=CYCLE[k % len(CYCLE)], label=label)
    percent = f"{100 * result.probability:g} %"
    for bounds, style, name in (
        (result.bounds, ":", f"{percent} bounds, each lag"),
        (result.simultaneous_bounds, "--", f"{percent}, all lags"),
    ):
        for sign in (1.0, -1.0):
            ax.plot(lags, sign * bounds, style, color=ink(), linewidth=1.0, label=name if sign > 0 else None)
    ax.axhline(0.0, color=ink(), linewidth=0.6)
    top = max(1.6 * float(result.simultaneous_bounds.max()), 1.25 * float(np.abs(result.values).max()))
    ax.set_ylim(-top, top)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("lag, measurements")
    ax.set_ylabel("autocorrelation")
    legend_above(ax, ncols=5)
    return ax


def nis_over_record(innovations: Innovations, bounds: tuple[float, float], ax: Axes | None = None) -> Axes:
    """Draw the NIS of one sensor per degree of freedom over time, its moving average, and the 99 % ``bounds`` of one measurement."""
    ax = axes_or_new(ax)
    degrees = innovations.innovation.shape[1]
    value = innovations.nis / degrees
    ax.axhspan(*bounds, color=ink(), alpha=0.12, linewidth=0, label="99 % bounds, each")
    few, low = decimated(innovations.time, np.maximum(value, 1e-4))
    ax.plot(few, low, ".", color=SKY, markersize=2.5, label="one measurement")
    if len(value) >= 2 * WINDOW:
        mean = np.convolve(value, np.full(WINDOW, 1.0 / WINDOW), mode="valid")
        middle = innovations.time[WINDOW // 2 : WINDOW // 2 + len(mean)]
        ax.plot(*decimated(middle, mean), color=VERMILION, linewidth=1.2, label=f"mean of {WINDOW}")
    ax.axhline(1.0, color=ink(), linewidth=0.6)
    ax.set_yscale("log")
    ax.set_ylim(0.3 * min(bounds[0], float(np.quantile(value, 0.01)) + 1e-4), 3.0 * max(bounds[1], float(value.max())))
    ax.set_xlabel("time, s")
    ax.set_ylabel("NIS per degree of freedom")
    legend_above(ax)
    return ax


def error_distribution(error: Array, ax: Axes | None = None) -> Axes:
    """Draw the cumulative distribution of attitude errors (n,), rad, with the median and the 95 % quantile marked; NaN is left out."""
    ax = axes_or_new(ax)
    values = np.sort(error[np.isfinite(error)])
    median, most, nearly_all, all_but_few = np.quantile(values, [0.5, 0.95, 0.99, 0.999], method="inverted_cdf")
    unit, size = angle_unit(nearly_all)
    ax.plot(*decimated(values / size, 100.0 * (np.arange(1, len(values) + 1) / len(values))), color=BLUE)
    for percent, at, color in ((50, median / size, ORANGE), (95, most / size, VERMILION)):
        ax.plot([at, at, 0.0], [0.0, percent, percent], ":", color=color, linewidth=1.2)
        ax.annotate(f"{percent} %: {at:.3g} {unit}", (at, percent), xytext=(6, -12), textcoords="offset points")
    ax.set_xlim(0.0, 1.15 * all_but_few / size)
    ax.set_ylim(0.0, 102.0)
    ax.set_xlabel(f"attitude error, {unit}")
    ax.set_ylabel("fraction of the time, %")
    return ax
