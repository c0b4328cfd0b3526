"""Figures. Each function takes results and an optional ``ax``, draws, and returns the axes; nothing here computes statistics.

Colours are those of Okabe and Ito, told apart by every kind of colour vision. :func:`new_figure` makes a figure that needs no display.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from strapdown import quaternion
from strapdown.allan import AllanDeviation, NoiseFit
from strapdown.checks import Array
from strapdown.coning_study import ConingStudy, Drift, FilterOutcome
from strapdown.consistency import ReferenceErrors, mean_bounds
from strapdown.files import written_beside
from strapdown.montecarlo import Statistics
from strapdown.records import Estimate
from strapdown.units import ARCSECOND, DEGREE, DEGREE_PER_HOUR

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


def _axes(ax: Axes | None) -> Axes:
    return new_figure()[1] if ax is None else ax


def drift_by_algorithm(drifts: Sequence[Drift], ax: Axes | None = None) -> Axes:
    """Draw the size of each algorithm's drift, measured and predicted, °/h on a log axis."""
    ax = _axes(ax)
    places = np.arange(len(drifts))
    measured = [abs(drift.measured) / DEGREE_PER_HOUR for drift in drifts]
    predicted = [abs(drift.predicted) / DEGREE_PER_HOUR for drift in drifts]
    ax.bar(places, measured, width=0.55, color=SKY, label="measured against the closed form")
    ax.hlines(predicted, places - 0.36, places + 0.36, color=BLACK, linewidth=2, label="predicted by the formula")
    rounding = 1e-6  # °/h: below it a drift is rounding of the run that measures it
    for place, value, line in zip(places, measured, predicted, strict=True):
        text = f"{value:.3g}" if value > rounding else "rounding"
        ax.annotate(
            text,
            (place, max(value, np.nan_to_num(line), rounding)),
            xytext=(0, 5),
            textcoords="offset points",
            ha="center",
        )
    ax.set_yscale("log")
    shown = [x for x in (*measured, *predicted) if x > rounding]
    ax.set_ylim(min(shown, default=rounding) / 4.0, max(shown, default=1.0) * 8.0)
    ax.set_xticks(places, [drift.algorithm for drift in drifts])
    ax.grid(visible=False, axis="x")
    ax.set_ylabel("drift, °/h")
    ax.legend(loc="upper right", frameon=False)
    return ax


def errors_in_envelope(time: Array, error: Array, sigma: Array, ax: Axes | None = None) -> Axes:
    """Draw errors (runs, m) over time inside ±3σ of the filter's own (m,); both in the unit of the axis that the caller labels."""
    ax = _axes(ax)
    ax.fill_between(time, -3.0 * sigma, 3.0 * sigma, color=SKY, alpha=0.35, linewidth=0, label="±3σ of the filter")
    ax.axhline(0.0, color=BLACK, linewidth=0.6)
    for k, one in enumerate(error):
        ax.plot(time, one, color=VERMILION, linewidth=0.8, alpha=0.8, label=f"{len(error)} runs" if k == 0 else None)
    ax.set_xlabel("time, s")
    return ax


def _layered(k: int, number: int) -> dict[str, Any]:
    """Style of line k of several that may lie on each other: the later, the thinner, so that all show."""
    return {"color": CYCLE[k % len(CYCLE)], "linewidth": 1.0 + 0.8 * (number - 1 - k)}


def nees_over_time(
    named: Sequence[tuple[str, Statistics]], bounds: tuple[float, float], subset: str, ax: Axes | None = None
) -> Axes:
    """Draw the ANEES of a ``subset`` ("state", "attitude", "bias") at each epoch with its bounds, on a log axis."""
    ax = _axes(ax)
    column = ("state", "attitude", "bias").index(subset)
    ax.axhspan(*bounds, color=BLACK, alpha=0.12, linewidth=0, label="bounds of a right filter")
    for k, (name, statistics) in enumerate(named):
        ax.plot(statistics.time, statistics.anees[:, column], label=name, **_layered(k, len(named)))
    ax.set_yscale("log")
    ax.set_xlabel("time, s")
    ax.set_ylabel(f"NEES of the {subset}, per state")
    return ax


def nis_over_time(
    named: Sequence[tuple[str, Statistics]], ax: Axes | None = None, *, probability: float = 0.99
) -> Axes:
    """Draw the mean NIS per degree of freedom in each bin of time with its bounds."""
    ax = _axes(ax)
    for k, (name, statistics) in enumerate(named):
        seen = statistics.nis_degrees > 0
        ax.plot(statistics.nis_time[seen], statistics.nis[seen], label=name, **_layered(k, len(named)))
    first = named[0][1]
    typical = round(float(np.median(first.nis_degrees[first.nis_degrees > 0]) * first.runs))
    ax.axhspan(
        *mean_bounds(1, typical, probability), color=BLACK, alpha=0.12, linewidth=0, label="bounds of a right filter"
    )
    ax.set_xlabel("time, s")
    ax.set_ylabel("NIS per degree of freedom")
    return ax


def coning_errors(outcomes: Sequence[FilterOutcome]) -> Figure:
    """Draw, for each integration algorithm, the errors about the cone's axis inside the filter's ±3σ: attitude above, bias below."""
    figure, axes = new_figure(2, len(outcomes), size=(3.1 * len(outcomes), 5.2), sharex=True, squeeze=False)
    for j, outcome in enumerate(outcomes):
        s = outcome.statistics
        for ax, state, unit in ((axes[0, j], 2, ARCSECOND), (axes[1, j], 5, DEGREE_PER_HOUR)):
            errors_in_envelope(s.time, s.example_error[:, :, state] / unit, s.sigma[:, state] / unit, ax)
        axes[0, j].set_title(f"{outcome.integration}: {'consistent' if outcome.consistent else 'NOT consistent'}")
        late = s.sigma[len(s.time) // 10 :]
        axes[0, j].set_ylim(-1.3 * 3.0 * late[:, 2].max() / ARCSECOND, 1.3 * 3.0 * late[:, 2].max() / ARCSECOND)
        top = max(1.6 * 3.0 * late[:, 5].max(), 1.25 * float(np.abs(s.example_error[:, len(s.time) // 10 :, 5]).max()))
        axes[1, j].set_ylim(-top / DEGREE_PER_HOUR, top / DEGREE_PER_HOUR)
        axes[0, j].set_xlabel("")
    axes[0, 0].set_ylabel("attitude error, arcsec")
    axes[1, 0].set_ylabel("bias error, °/h")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    figure.suptitle(
        "Errors about the cone's axis. Commutation error is a constant rate: the filter takes it for gyro bias."
    )
    return figure


def coning_consistency(outcomes: Sequence[FilterOutcome]) -> Figure:
    """Draw NEES of attitude and of bias and NIS over time for each integration algorithm, with the bounds of a right filter."""
    figure, axes = new_figure(1, 3, size=(12.0, 4.2))
    named = [(outcome.integration, outcome.statistics) for outcome in outcomes]
    first = outcomes[0]
    for ax, subset in zip(axes[:2], ("attitude", "bias"), strict=True):
        nees_over_time(named, first.statistics.verdict(first.epochs, subset, first.probability).bounds, subset, ax)
    low, high = axes[0].get_ylim()
    axes[0].set_ylim(min(0.3, low), max(3.0, min(high, 30.0)))
    nis_over_time(named, axes[2], probability=first.probability)
    for ax, subset in zip(axes[:2], ("attitude", "bias"), strict=True):
        passed = sum(o.statistics.verdict(o.epochs, subset, o.probability).consistent for o in outcomes)
        ax.set_title(f"{subset.capitalize()}: {passed} of {len(outcomes)} pass at the judged epochs")
    axes[2].set_title("Innovations")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return figure


def draw_coning_study(study: ConingStudy, folder: str | os.PathLike[str]) -> list[Path]:
    """Write the figures of the coning study to a folder and return their paths."""
    figure, ax = new_figure(size=(7.0, 4.2))
    drift_by_algorithm(study.drifts, ax)
    p = study.parameters
    ax.set_title(
        f"Coning {p.angle / DEGREE:g}° at {p.frequency:g} Hz, gyro at {p.rate:g} Hz ({p.rate / p.frequency:.3g} samples a cycle)"
    )
    target = Path(folder)
    return [
        save(figure, target / "drift.png"),
        save(coning_errors(study.outcomes), target / "errors.png"),
        save(coning_consistency(study.outcomes), target / "consistency.png"),
    ]


def estimate_overview(estimate: Estimate, *, title: str = "") -> Figure:
    """Draw the attitude as roll, pitch and yaw, the gyro bias, and their standard deviations over time."""
    figure, axes = new_figure(3, 1, size=(9.0, 7.5), sharex=True)
    euler = quaternion.to_rotation(estimate.attitude).as_euler("ZYX", degrees=True)[:, ::-1]
    for k, name in enumerate(("roll", "pitch", "yaw")):
        # Breaks where the angle wraps, so that no line crosses the whole plot.
        angle = np.where(np.abs(np.diff(euler[:, k], prepend=euler[0, k])) > 180.0, np.nan, euler[:, k])
        axes[0].plot(estimate.time, angle, color=CYCLE[k], linewidth=0.9, label=name)
    sigma = estimate.sigma
    for k, name in enumerate(AXES):
        bias, spread = estimate.bias[:, k] / DEGREE, 3.0 * sigma[:, 3 + k] / DEGREE
        axes[1].fill_between(estimate.time, bias - spread, bias + spread, color=CYCLE[k], alpha=0.18, linewidth=0)
        axes[1].plot(estimate.time, bias, color=CYCLE[k], linewidth=1.0, label=f"{name}, ±3σ")
    axes[2].plot(estimate.time, np.linalg.norm(sigma[:, :3], axis=1) / DEGREE, color=BLACK, linewidth=1.0)
    settled = slice(len(estimate.time) // 10, None)
    reach = np.abs(estimate.bias[settled]).max() + 3.0 * sigma[settled, 3:].max()
    axes[1].set_ylim(-1.2 * reach / DEGREE, 1.2 * reach / DEGREE)
    axes[0].set_ylabel("attitude, °")
    axes[1].set_ylabel("gyro bias, °/s")
    axes[2].set_ylabel("attitude σ, all axes, °")
    axes[2].set_ylim(bottom=0.0)
    axes[2].set_xlabel("time, s")
    for ax in axes[:2]:
        ax.legend(loc="upper right", ncols=3, frameon=False)
    axes[0].set_title(title)
    return figure


def recording_errors(time: Array, errors: ReferenceErrors, movement: np.ndarray | None = None) -> Figure:
    """Draw total, heading and inclination errors against a reference over time, the movement phase shaded."""
    figure, ax = new_figure(size=(9.0, 4.0))
    mask = np.zeros(len(time), int) if movement is None else movement.astype(int)
    inside = np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]])))
    for k, (first, last) in enumerate(inside.reshape(-1, 2)):
        ax.axvspan(
            time[first],
            time[last - 1],
            color=BLACK,
            alpha=0.07,
            linewidth=0,
            label="movement (judged)" if k == 0 else None,
        )
    for name, color in (("total", BLACK), ("heading", BLUE), ("inclination", VERMILION)):
        ax.plot(time, getattr(errors, name) / DEGREE, color=color, linewidth=0.9, label=name)
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel("time, s")
    ax.set_ylabel("error, °")
    ax.legend(loc="upper left", ncols=4, frameon=False)
    return figure


def allan_axis(
    deviation: AllanDeviation, fit: NoiseFit, curves: Mapping[str, Array], axis: int, ax: Axes | None = None
) -> Axes:
    """Draw one axis of an Allan deviation with its confidence band, the fit, and the fitted terms (``curves``, rad/s at the same τ)."""
    ax = _axes(ax)
    scale = DEGREE_PER_HOUR
    band = (deviation.lower[axis] / scale, deviation.upper[axis] / scale)
    ax.fill_between(
        deviation.taus, *band, color=SKY, alpha=0.5, linewidth=0, label=f"{100 * deviation.level:.0f} % band"
    )
    ax.loglog(deviation.taus, deviation.deviation[axis] / scale, "o", color=BLUE, markersize=2.5, label="measured")
    ax.loglog(deviation.taus, curves["total"] / scale, color=BLACK, linewidth=1.4, label="fit")
    colors = dict(zip(fit.terms, (PURPLE, VERMILION, GREEN, ORANGE, YELLOW), strict=False))
    for i, term in enumerate(fit.terms):
        if fit.supported[axis, i]:
            ax.loglog(
                deviation.taus,
                curves[term] / scale,
                "--",
                color=colors[term],
                linewidth=1.1,
                label=term.replace("_", " "),
            )
    low, high = deviation.deviation[axis].min() / scale, deviation.deviation[axis].max() / scale
    ax.set_ylim(0.2 * low, 3.0 * high)
    ax.set_xlabel("averaging time τ, s")
    ax.set_ylabel("Allan deviation, °/h")
    return ax


def allan_overview(deviation: AllanDeviation, fit: NoiseFit, curves: Sequence[Mapping[str, Array]]) -> Figure:
    """Draw each axis of an Allan deviation with its fit, side by side."""
    number = len(deviation.deviation)
    figure, axes = new_figure(1, number, size=(1.5 + 4.2 * number, 4.8), sharey=True, squeeze=False)
    for axis in range(number):
        ax = allan_axis(deviation, fit, curves[axis], axis, axes[0, axis])
        ax.set_title(AXES[axis])
        ax.set_ylabel("Allan deviation, °/h" if axis == 0 else "")
    handles = {label: handle for ax in axes[0] for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure
