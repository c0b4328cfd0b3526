"""Tuning: the likelihood along each parameter."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from strapdown.plots import style
from strapdown.tuning import Slices, Tuning

TALLEST = 15.0
"""Upper limit of the slices, −2 Δ log likelihood."""


def measure_of(composite: bool) -> str:
    """Return the name of what a slice shows, by whether the objective is a composite likelihood."""
    return "2 Δ objective" if composite else "−2 Δ log likelihood"


def interval(identified: bool) -> str:
    """Return the name of the region between the limits of a parameter."""
    return "95 % interval" if identified else "below the 95 % bound"


def likelihood_slice(slices: Slices, tuning: Tuning, number: int, ax: Axes | None = None) -> Axes:
    """Draw twice the decrease of the log-likelihood along one parameter, with its interval and its previous value."""
    ax = style.axes_or_new(ax)
    parameter = tuning.parameters[number]
    unit = parameter.unit
    values = slices.values[number] / unit.factor
    ax.semilogx(values, slices.fallen[number], color=style.BLUE, linewidth=1.4)
    if not tuning.composite:
        ax.axhline(3.84, color=style.ink(), linewidth=0.6, linestyle=":", label="3.84: 95 % of χ², one parameter")
    lower, upper = max(parameter.lower / unit.factor, values[0]), min(parameter.upper / unit.factor, values[-1])
    ax.axvspan(lower, upper, color=style.SKY, alpha=0.3, linewidth=0, label=interval(parameter.identified))
    ax.axvline(parameter.value / unit.factor, color=style.BLUE, linewidth=0.8, label="tuned")
    before = parameter.start / unit.factor
    drawn = values[0] <= before <= values[-1]
    if drawn:
        ax.axvline(before, color=style.VERMILION, linewidth=1.0, linestyle="--", label="before")
    ax.set_xlim(values[0], values[-1])
    ax.xaxis.set_minor_formatter(NullFormatter())
    if values[-1] < 10.0 * values[0]:
        ax.xaxis.set_major_locator(MaxNLocator(4))
    elif values[-1] < 100.0 * values[0]:  # powers of ten alone would leave one label
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    if values[-1] < 100.0 * values[0]:
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:.4g}")
    ax.set_ylim(0.0, TALLEST)
    ax.set_title(parameter.name)
    ax.set_xlabel(unit.name if drawn else f"{unit.name}  (before: {before:.3g})")
    return ax


def likelihood_slices(slices: Slices, tuning: Tuning) -> Figure:
    """Draw the slices of all parameters side by side."""
    number = len(tuning.parameters)
    columns = min(number, 4)
    rows = -(-number // columns)
    size = (1.0 + 3.0 * columns, 0.7 + 2.7 * rows)
    figure, axes = style.new_figure(rows, columns, size=size, squeeze=False, sharey=True)
    for k in range(number):
        likelihood_slice(slices, tuning, k, axes.flat[k])
    for ax in axes.flat[number:]:
        ax.set_visible(False)
    for ax in axes[:, 0]:
        ax.set_ylabel(measure_of(tuning.composite))
    style.legend_below(figure, list(axes.ravel()), ncols=2 * columns - 1)
    return figure
