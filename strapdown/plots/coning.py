"""The coning study: drift by algorithm, and its effect on the filter."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from strapdown.montecarlo.coning_study import PROBABILITY, ROUNDING, ConingStudy, Drift, FilterOutcome
from strapdown.plots import style
from strapdown.plots.estimates import errors_in_envelope
from strapdown.plots.statistics import nees_over_time, nis_over_time
from strapdown.units import ARCSECOND, DEGREE, DEGREE_PER_HOUR


def drift_by_algorithm(drifts: Sequence[Drift], ax: Axes | None = None) -> Axes:
    """Draw the magnitude of each algorithm's drift, measured and predicted, °/h on a log axis."""
    ax = style.axes_or_new(ax)
    places = np.arange(len(drifts))
    measured = np.array([abs(drift.measured) / DEGREE_PER_HOUR for drift in drifts])
    predicted = np.array([abs(drift.predicted) / DEGREE_PER_HOUR for drift in drifts])
    shown = [x for x in (*measured, *predicted) if x > ROUNDING]
    low, high = min(shown, default=ROUNDING) / 4.0, max(shown, default=1.0) * 8.0
    ax.set_yscale("log")
    ax.set(xlim=(-0.6, len(drifts) - 0.4), ylim=(low, high))
    bars = np.where(measured > ROUNDING, measured, np.nan)
    ax.bar(places, bars, width=0.55, color=style.SKY, label="measured relative to the closed form")
    lines = np.where(predicted > ROUNDING, predicted, np.nan)
    ax.hlines(lines, places - 0.36, places + 0.36, color=style.ink(), linewidth=2, label="predicted by the formula")
    for place, value, line in zip(places, measured, lines, strict=True):
        text = f"{value:.3g}" if value > ROUNDING else "rounding"
        top = max(value, np.nan_to_num(line), low)
        ax.annotate(text, (place, top), xytext=(0, 5), textcoords="offset points", ha="center")
    ax.set_xticks(places, [drift.algorithm.replace("-", "-\n", 1) for drift in drifts])
    ax.grid(visible=False, axis="x")
    ax.set_ylabel("magnitude of the drift about the cone's axis, °/h")
    style.legend_above(ax)
    return ax


MAX_COLUMNS = 5
"""Maximum number of algorithms beside each other in a figure; more go into further rows."""


def coning_errors(outcomes: Sequence[FilterOutcome]) -> Figure:
    """Draw the errors about the cone's axis with the filter's ±3σ for each integration algorithm: attitude above, bias below."""
    rows = -(-len(outcomes) // MAX_COLUMNS)
    columns = -(-len(outcomes) // rows)
    figure, grid = style.new_figure(
        2 * rows, columns, size=(2.2 * max(columns, 3), 5.2 * rows), sharex=True, squeeze=False
    )
    # Attitude above bias, in as many pairs of rows as needed: (2, columns of all rows).
    axes = np.stack([np.concatenate(grid[0::2]), np.concatenate(grid[1::2])])
    for ax in axes[:, len(outcomes) :].ravel():
        ax.set_visible(False)
    axes = axes[:, : len(outcomes)]
    for j, outcome in enumerate(outcomes):
        s = outcome.statistics
        for ax, state, unit in ((axes[0, j], 2, ARCSECOND), (axes[1, j], 5, DEGREE_PER_HOUR)):
            errors_in_envelope(s.time, s.example_error[:, :, state] / unit, s.sigma[:, state] / unit, ax)
        verdict = outcome.judgement.verdict
        axes[0, j].set_title(f"{outcome.integration}:\n{verdict}", loc="left")
        late = slice(len(s.time) // 10, None)
        attitude = 1.3 * 3.0 * s.sigma[late, 2].max() / ARCSECOND
        axes[0, j].set_ylim(-attitude, attitude)
        bias = max(1.6 * 3.0 * s.sigma[late, 5].max(), 1.25 * float(np.abs(s.example_error[:, late, 5]).max()))
        axes[1, j].set_ylim(-bias / DEGREE_PER_HOUR, bias / DEGREE_PER_HOUR)
        axes[0, j].set_xlabel("")
    for row in axes:
        style.match_scales(row)
    for first in range(0, len(outcomes), columns):
        axes[0, first].set_ylabel("attitude error, arcsec")
        axes[1, first].set_ylabel("bias error, °/h")
    style.legend_below(figure, [axes[0, 0]])
    figure.suptitle(
        "Errors about the cone's axis. The integration drift is a constant rate,\nwhich the filter estimates as gyro bias."
    )
    return figure


def coning_consistency(outcomes: Sequence[FilterOutcome]) -> Figure:
    """Draw NEES of attitude and of bias and NIS over time for each integration algorithm, with the bounds of a consistent filter."""
    figure, axes = style.new_figure(1, 3, size=(10.5, 4.6))
    named = [(outcome.integration, outcome.statistics) for outcome in outcomes]
    first = outcomes[0].statistics
    percent = f"{100 * PROBABILITY:g} %"
    for ax, subset in zip(axes[:2], ("attitude", "bias"), strict=True):
        bounds = first.verdict(first.judged_epochs, subset).simultaneous_bounds
        nees_over_time(named, bounds, subset, ax, label=f"NEES: {percent} bounds, all judged epochs")
        epochs = first.time[first.judged_epochs]
        below = {"transform": ax.get_xaxis_transform(), "color": style.ink(), "markersize": 5}
        ax.plot(epochs, np.full(len(epochs), 0.015), "|", label="judged epoch", **below)
        passing = _passing(outcomes, "ANEES", subset)
        ax.set_title(f"{subset.capitalize()}: {passing}\nTest of the judged epochs", loc="left")
    low, high = axes[0].get_ylim()
    axes[0].set_ylim(min(0.3, low), max(3.0, min(high, 30.0)))
    nis_over_time(named, axes[2], label=f"NIS: {percent} bounds, each interval")
    axes[2].set_title(f"NIS: {_passing(outcomes, 'NIS')}\nTest of the mean over all time", loc="left")
    style.legend_below(figure, list(axes))
    return figure


def _passing(outcomes: Sequence[FilterOutcome], statistic: str, of: str = "") -> str:
    """Return how many of the filters a statistic does not contradict, in words; ``of``: subset of the states, or for any sensor nothing."""
    passing = [
        not any(f.rejected for f in outcome.judgement.findings if f.name == statistic and of in ("", f.of))
        for outcome in outcomes
    ]
    return f"{sum(passing)} of {len(outcomes)} pass"


def draw_coning_study(study: ConingStudy, folder: str | os.PathLike[str], form: str = "png") -> list[Path]:
    """Write the figures of a coning study to a folder, which is created if missing; return the files."""
    figure, ax = style.new_figure(size=(7.0, 4.2))
    drift_by_algorithm(study.drifts, ax)
    p = study.parameters
    figure.suptitle(
        f"Coning {p.angle / DEGREE:g}° at {p.frequency:g} Hz, gyro at {p.rate:g} Hz ({p.rate / p.frequency:.3g} samples per cycle)"
    )
    target = Path(folder)
    figures = {
        target / "drift": figure,
        target / "errors": coning_errors(study.outcomes),
        target / "consistency": coning_consistency(study.outcomes),
    }
    return style.save_as(figures, form)
