"""Allan deviations with fits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from strapdown.allan import AllanDeviation, NoiseFit, curves_by_axis
from strapdown.allan.noise_fit import UNITS
from strapdown.checks import Array
from strapdown.plots import style


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
        _draw_axis(axes[0, axis], deviation, fit, curves, axis, scale)
        axes[0, axis].set_title(f"{style.AXES[axis]} axis", loc="left")
    axes[0, 0].set_ylabel(f"Allan deviation, {unit}")
    drawn = deviation.deviation[deviation.deviation > 0.0] / scale
    axes[0, 0].set_ylim(0.3 * drawn.min(), 3.0 * drawn.max())
    style.legend_below(figure, list(axes[0]), ncols=min(4, 2 * number))
    return figure


def _draw_axis(
    ax: Axes, deviation: AllanDeviation, fit: NoiseFit, curves: Mapping[str, Array], axis: int, scale: float
) -> None:
    """Draw one axis with its confidence band, the fit, and the fitted terms (``curves``, SI at the same τ)."""
    taus, upper = deviation.taus, deviation.upper[axis]
    upper = np.where(np.isfinite(upper), upper, np.nan)
    band: dict[str, Any] = {"color": style.SKY, "alpha": 0.5, "linewidth": 0}
    words = f"{100 * deviation.confidence_level:.0f} % confidence"
    ax.fill_between(taus, deviation.lower[axis] / scale, upper / scale, label=words, **band)
    measured: dict[str, Any] = {"color": style.BLUE, "markersize": 2.5, "label": "measured"}
    ax.loglog(taus, deviation.deviation[axis] / scale, "o", **measured)
    ax.loglog(taus, curves["total"] / scale, color=style.ink(), linewidth=1.4, label="fit")
    colors = (style.PURPLE, style.VERMILION, style.GREEN, style.ORANGE, style.YELLOW)
    for term, supported, color in zip(fit.terms, fit.supported[axis], colors, strict=False):
        if supported:
            label = UNITS[fit.sensor][term].name.replace("_", " ")
            ax.loglog(taus, curves[term] / scale, "--", color=color, linewidth=1.1, label=label)
    ax.set_xlabel("averaging time τ, s")
