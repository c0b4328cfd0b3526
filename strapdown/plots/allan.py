"""Allan deviations with their fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from strapdown.allan import AllanDeviation, NoiseFit
from strapdown.checks import Array
from strapdown.plots.style import (
    AXES,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    YELLOW,
    axes_or_new,
    ink,
    new_figure,
)
from strapdown.units import DEGREE_PER_HOUR


def allan_axis(
    deviation: AllanDeviation, fit: NoiseFit, curves: Mapping[str, Array], axis: int, ax: Axes | None = None
) -> Axes:
    """Draw one axis of an Allan deviation with its confidence band, the fit, and the fitted terms (``curves``, rad/s at the same τ)."""
    ax = axes_or_new(ax)
    scale = DEGREE_PER_HOUR
    band = (deviation.lower[axis] / scale, deviation.upper[axis] / scale)
    ax.fill_between(
        deviation.taus, *band, color=SKY, alpha=0.5, linewidth=0, label=f"{100 * deviation.level:.0f} % band"
    )
    ax.loglog(deviation.taus, deviation.deviation[axis] / scale, "o", color=BLUE, markersize=2.5, label="measured")
    ax.loglog(deviation.taus, curves["total"] / scale, color=ink(), linewidth=1.4, label="fit")
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
    drawn = deviation.deviation[deviation.deviation > 0.0] / DEGREE_PER_HOUR
    axes[0, 0].set_ylim(0.2 * drawn.min(), 3.0 * drawn.max())  # shared: the last axis alone would cut the others off
    handles = {label: handle for ax in axes[0] for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure
