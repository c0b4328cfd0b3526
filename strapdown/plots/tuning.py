"""Tuning: the likelihood along each parameter, and the filter before and after tuning on held-out data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from strapdown.checks import Array
from strapdown.plots import style
from strapdown.tuning import Comparison, Slices, Tuning

TALLEST = 15.0
"""Upper limit of the slices, −2 Δ log likelihood."""


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
    ax.axvspan(
        lower,
        upper,
        color=style.SKY,
        alpha=0.3,
        linewidth=0,
        label="95 % interval" if parameter.identified else "below the 95 % bound",
    )
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
    figure, axes = style.new_figure(
        rows, columns, size=(1.0 + 3.0 * columns, 0.7 + 2.7 * rows), squeeze=False, sharey=True
    )
    for k, ax in enumerate(axes.ravel()):
        if k >= number:
            ax.set_visible(False)
            continue
        likelihood_slice(slices, tuning, k, ax)
        if k % columns == 0:
            ax.set_ylabel("2 Δ objective" if tuning.composite else "−2 Δ log likelihood")
    style.legend_below(figure, list(axes.ravel()), ncols=5)
    return figure


def figure_paths(beside: Path, form: str) -> tuple[Path, Path]:
    """Return the paths of the figures beside a filter: of the likelihood, and of the held-out data."""
    return beside.with_name(f"{beside.stem}-likelihood.{form}"), beside.with_name(f"{beside.stem}-heldout.{form}")


def draw_tuning(tuning: Tuning, slices: Slices, beside: Path, form: str = "png") -> list[Path]:
    """Write the figures of a tuning beside its filter, in place of those of an earlier one; return the files."""
    likelihood, heldout = figure_paths(beside, form)
    figures = {likelihood: likelihood_slices(slices, tuning)}
    if tuning.comparison is not None:
        figures[heldout] = before_and_after(tuning.comparison, title="Held-out part of the first record")
    for other in style.FORMATS:
        heldout.with_suffix(f".{other}").unlink(missing_ok=True)
    return style.save_as(figures, form)


def before_and_after(comparison: Comparison, *, title: str = "") -> Figure:
    """Draw NIS, and NEES if there is a truth, on the held-out data before and after tuning, with the bounds of a consistent filter."""
    both = (("before", comparison.before, style.VERMILION), ("after", comparison.after, style.BLUE))
    rows = len(comparison.after.courses)
    figure, axes = style.new_figure(rows, 1, size=(9.0, 1.6 + 2.4 * rows), squeeze=False, sharex=rows > 1)
    for number, course in enumerate(comparison.after.courses):
        drawn = []
        for name, performance, color in both:
            own = performance.courses[number]
            drawn.append((name, color, float(np.nanmean(own.mean)) if number else performance.nis, own.time, own.mean))
        _course(axes[number, 0], drawn, course.bounds, course.label)
    figure.suptitle(title)
    axes[-1, 0].set_xlabel("time, s")
    return figure


def _course(
    ax: Axes, courses: Sequence[tuple[str, str, float, Array, Array]], bounds: tuple[float, float], label: str
) -> None:
    """Draw means over intervals of time, whose expectation is 1 for a consistent filter, before and after tuning."""
    for name, color, mean, time, values in courses:
        there = np.isfinite(values)
        ax.plot(time[there], values[there], ".-", color=color, linewidth=1.0, label=f"{name}: mean {mean:.3g}")
    ax.axhspan(*bounds, color=style.ink(), alpha=0.12, linewidth=0, label="99 % bounds, each interval")
    finite = np.concatenate([values[np.isfinite(values)] for *_, values in courses])
    if finite.max() > 5.0 or finite.min() < 0.2:
        style.log_scale(ax)
        label += "\n(log scale)"
    ax.axhline(1.0, color=style.ink(), linewidth=0.6, linestyle=":")
    ax.set_ylabel(label)
    style.legend_above(ax)
