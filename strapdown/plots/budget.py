"""Error budgets of a covariance analysis: predicted errors, and the fraction of each source."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from strapdown.checks import Array
from strapdown.covariance import Analysis
from strapdown.plots.style import BLUE, CYCLE, VERMILION, YELLOW, legend_above, log_scale, new_figure
from strapdown.units import angle_unit, rate_unit

_SHADES = (*CYCLE, YELLOW, "#666666", "#8C564B", "#17BECF", "#AEC7E8", "#C5B0D5")
_MIN_SHARE = 0.01  # sources below this fraction of the mean square at all times are combined


def error_budget(analysis: Analysis, *, title: str = "") -> Figure:
    """Draw RMS error and the filter's σ of attitude and bias over time, and below the fraction of each source in the mean square error.

    Parameters
    ----------
    analysis : Analysis
        Result of :func:`strapdown.covariance.analyse`.
    title : str
        Title of the figure.

    Returns
    -------
    Figure
        Sources below 1 % of both mean squares at all times are combined, and so are errors that are the same in every run.
    """
    figure, axes = new_figure(2, 2, size=(9.0, 6.6), sharex=True, height_ratios=(1.0, 1.25))
    parts = (slice(0, 3), slice(3, 6))
    shares = [_shares(analysis, part) for part in parts]
    names = [name for name in shares[0] if max(_largest(share[name]) for share in shares) >= _MIN_SHARE]
    colours = {name: _SHADES[k % len(_SHADES)] for k, name in enumerate(names)}
    handles: dict[str, Any] = {}
    for column, (part, share) in enumerate(zip(parts, shares, strict=True)):
        top, bottom = axes[:, column]
        what = ("attitude", "bias")[column]
        rms = np.sqrt(np.mean(analysis.rms[:, part] ** 2, axis=1))
        sigma = np.sqrt(np.mean(analysis.filter_sigma[:, part] ** 2, axis=1))
        # The unit is chosen for the converged filter; the initial σ is orders of magnitude larger.
        unit, size = (angle_unit if column == 0 else rate_unit)(rms[len(rms) // 2 :])
        error = np.where(rms > 0.0, rms / size, np.nan)
        top.plot(analysis.time, error, color=VERMILION, linewidth=2.4, label="RMS error")
        top.plot(analysis.time, sigma / size, color=BLUE, linewidth=1.2, label="σ of the filter")
        log_scale(top)
        top.set_ylabel(f"{what} error, one axis, {unit}")
        shown = {name: share[name] for name in names}
        rest = 1.0 - np.sum(list(shown.values()), axis=0)
        if _largest(rest) > 1e-3:
            shown["all others"] = np.maximum(rest, 0.0)
        filling = [colours.get(name, "0.85") for name in shown]
        stack = bottom.stackplot(analysis.time, 100.0 * np.array(list(shown.values())), colors=filling, linewidth=0.0)
        handles.update(zip(shown, stack, strict=True))
        bottom.set(ylim=(0.0, 100.0), xlim=(analysis.time[0], analysis.time[-1]), xlabel="time, s")
        bottom.set_ylabel(f"fraction of mean square {what} error, %")
    legend_above(axes[0, 0])
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False)
    if title:
        figure.suptitle(title)
    return figure


def _largest(share: Array) -> float:
    return float(np.fmax.reduce(share, initial=0.0))


def _shares(analysis: Analysis, part: slice) -> dict[str, Array]:
    """Return the fraction (m,) of each source in the mean square error; errors equal in every run add linearly and are one fraction."""
    total = np.sum(analysis.rms[:, part] ** 2, axis=1)
    total = np.where(total > 0.0, total, np.nan)
    share = {
        name: np.trace(analysis.contributions[:, k, part, part], axis1=1, axis2=2) / total
        for k, name in enumerate(analysis.sources)
    }
    if analysis.fixed:
        share["fixed errors"] = np.sum(analysis.mean_error[:, part] ** 2, axis=1) / total
    for k, name in enumerate(analysis.considered):
        key = name.partition(",")[0]
        square = np.sum(analysis.considered_errors[:, k, part] ** 2, axis=1)
        share[key] = share.get(key, np.zeros(len(total))) + square / total
    return share
