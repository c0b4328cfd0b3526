"""Allan deviations with fits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from strapdown.allan import AllanDeviation, NoiseFit, curves_by_axis
from strapdown.allan.noise_fit import UNITS
from strapdown.checks import Array
from strapdown.plots import style


def allan_axis(
    deviation: AllanDeviation, fit: NoiseFit, curves: Mapping[str, Array], axis: int, ax: Axes | None = None
) -> Axes:
    """Draw one axis of an Allan deviation with its confidence band, the fit, and the fitted terms (``curves``, SI at the same τ)."""
    ax = style.axes_or_new(ax)
    unit, scale, *_ = UNITS[fit.sensor]["bias_instability"]
    upper = np.where(np.isfinite(deviation.upper[axis]), deviation.upper[axis], np.nan)
    band = (deviation.lower[axis] / scale, upper / scale)
    ax.fill_between(
        deviation.taus,
        *band,
        color=style.SKY,
        alpha=0.5,
        linewidth=0,
        label=f"{100 * deviation.confidence_level:.0f} % confidence",
    )
    ax.loglog(
        deviation.taus, deviation.deviation[axis] / scale, "o", color=style.BLUE, markersize=2.5, label="measured"
    )
    ax.loglog(deviation.taus, curves["total"] / scale, color=style.ink(), linewidth=1.4, label="fit")
    colors = dict(
        zip(fit.terms, (style.PURPLE, style.VERMILION, style.GREEN, style.ORANGE, style.YELLOW), strict=False)
    )
    for i, term in enumerate(fit.terms):
        if fit.supported[axis, i]:
            ax.loglog(
                deviation.taus,
                curves[term] / scale,
                "--",
                color=colors[term],
                linewidth=1.1,
                label=UNITS[fit.sensor][term].name.replace("_", " "),
            )
    low, high = np.nanmin(deviation.deviation[axis]) / scale, np.nanmax(deviation.deviation[axis]) / scale
    ax.set_ylim(0.2 * low, 3.0 * high)
    ax.set_xlabel("averaging time τ, s")
    ax.set_ylabel(f"Allan deviation, {unit}")
    return ax


def allan_overview(deviation: AllanDeviation, fit: NoiseFit) -> Figure:
    """Draw each axis of an Allan deviation with its fit, side by side, in the units of the sensor.

    Parameters
    ----------
    deviation : AllanDeviation
        Deviation, SI.
    fit : NoiseFit
        Fit to the same samples.

    Returns
    -------
    Figure
        One panel for each axis of the sensor.
    """
    unit, scale, *_ = UNITS[fit.sensor]["bias_instability"]
    number = len(deviation.deviation)
    figure, axes = style.new_figure(1, number, size=(1.2 + 3.0 * number, 4.2), sharey=True, squeeze=False)
    for axis, curves in enumerate(curves_by_axis(fit, deviation)):
        ax = allan_axis(deviation, fit, curves, axis, axes[0, axis])
        ax.set_title(f"{style.AXES[axis]} axis", loc="left")
        ax.set_ylabel(f"Allan deviation, {unit}" if axis == 0 else "")
    drawn = deviation.deviation[deviation.deviation > 0.0] / scale
    axes[0, 0].set_ylim(0.3 * drawn.min(), 3.0 * drawn.max())  # shared: those of the last axis could cut off others
    style.legend_below(figure, list(axes[0]), ncols=8)
    return figure
