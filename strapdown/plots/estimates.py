"""One estimate over time: attitude, bias, σ, errors."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from strapdown import quaternion
from strapdown.checks import Array, InputError, are_finite, instance
from strapdown.consistency import errors
from strapdown.plots import style
from strapdown.plots.decimation import BAND_COLUMNS, decimated, envelope, extreme_rows
from strapdown.records import Estimate, Truth, outputs
from strapdown.records.estimate import state_unit
from strapdown.units import DEGREE, angle_unit, error_state_name, rate_unit

THREE_SIGMA = "±3σ (99.7 %)"
"""Legend of a band of three standard deviations, with the probability of a normal error of one axis within it."""


def errors_in_envelope(time: Array, error: Array, sigma: Array, ax: Axes | None = None) -> Axes:
    """Draw errors (runs, n) over time (n,), s, with the filter's ±3σ (n,), in the unit of the axis, which the caller labels.

    The axis has the range of what comes after the first twentieth of the time, in which a filter converges.
    For a long series the band is dark up to the minimum 3σ of each pixel column and light up to the maximum: σ increases between two
    measurements, and lines that follow it would merge into a grey area that hides the errors.
    """
    ax = style.axes_or_new(ax)
    edges, least, most = envelope(time, 3.0 * sigma)
    dark: dict[str, Any] = {"color": style.SKY, "alpha": 0.35, "linewidth": 0}
    light = {**dark, "alpha": 0.18}
    ax.fill_between(edges, -least, least, label=f"{THREE_SIGMA} of the filter", **dark)
    if (most > 1.02 * least).any():
        ax.fill_between(edges, least, most, label="its increase between measurements", **light)
        ax.fill_between(edges, -most, -least, **light)
    ax.axhline(0.0, color=style.ink(), linewidth=0.6)
    words = f"error, {len(error)} runs" if len(error) > 1 else "error"
    for k, component in enumerate(error):
        label = words if k == 0 else None
        ax.plot(*decimated(time, component), color=style.VERMILION, linewidth=0.8, alpha=0.8, label=label)
    reach = style.reach(error.T, 3.0 * sigma)
    ax.set(xlim=(time[0], time[-1]), ylim=(-reach, reach), xlabel="time, s")
    return ax


def roll_pitch_yaw(attitude: Array) -> Array:
    """Return roll, pitch and yaw of the sequence Z-Y-X (n, 3), degrees."""
    return np.rad2deg(outputs.euler(attitude).angles[:, ::-1])


def angle_labels(fixed_frame: str = "") -> tuple[str, str, str]:
    """Return labels of roll, pitch and yaw of the sequence Z-Y-X, with their positive directions.

    Yaw is from East if ``fixed_frame`` begins with "East-North-Up", otherwise from the fixed x axis.
    """
    yaw = "from East to North" if fixed_frame.startswith("East-North-Up") else "from fixed x to y"
    return "roll about body x, y to z", "pitch about y, z to x", f"yaw about fixed z, {yaw}"


def wraps(angle: Array, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the places in ``rows`` before which an angle (n,) in degrees wraps at ±180°, where its line must be interrupted."""
    turned = np.unwrap(angle, period=360.0)[rows]
    return np.flatnonzero((np.abs(np.diff(angle[rows])) > 180.0) & (np.abs(np.diff(turned)) < 180.0)) + 1


def unbroken(time: Array, angle: Array) -> tuple[Array, Array]:
    """Return the points of the line of an angle in degrees, reduced as other lines, with a gap where it wraps at ±180°."""
    rows = extreme_rows(time, angle)
    breaks = wraps(angle, rows)
    return np.insert(time[rows], breaks, time[rows][breaks]), np.insert(angle[rows], breaks, np.nan)


def estimate_overview(estimate: Estimate, *, title: str = "", fixed_frame: str = "") -> Figure:
    """Draw roll, pitch and yaw (sequence Z-Y-X), and if they are known the gyro bias with its ±3σ and the attitude's σ over time."""
    estimate = estimate.taken(estimate.known)
    heights = [1.0, 1.0, 1.0, *[1.7] * estimate.has_bias, *[1.3] * estimate.has_covariance]
    size = (9.0, 10.0 * sum(heights) / 6.0)
    figure, axes = style.new_figure(len(heights), 1, size=size, sharex=True, height_ratios=heights)
    for ax, angle, name in zip(axes, roll_pitch_yaw(estimate.attitude).T, angle_labels(fixed_frame), strict=False):
        ax.plot(*unbroken(estimate.time, angle), color=style.BLUE, linewidth=0.9)
        ax.set_ylabel(f"{name.split()[0]}, °")
        if np.ptp(angle) > 180.0:
            ax.yaxis.set_major_locator(MultipleLocator(90.0))
        ax.set_title(f"Euler angles Z-Y-X: {name}", loc="right", fontsize="small")
    if estimate.has_bias:
        _bias(axes[3], estimate)
    if estimate.has_covariance:
        _attitude_sigma(axes[-1], estimate)
    axes[-1].set_xlabel("time, s")
    axes[-1].set_xlim(estimate.time[0], estimate.time[-1])
    axes[0].set_title(title, loc="left")
    return figure


def _bias(ax: Axes, estimate: Estimate) -> None:
    """Draw the gyro bias with its ±3σ over time."""
    unit, size = rate_unit(style.settled(3.0 * estimate.sigma[:, 3:]))
    values, spread = estimate.bias / size, 3.0 * estimate.sigma[:, 3:] / size
    for name, color, bias, three_sigma in zip(style.AXES, style.CYCLE, values.T, spread.T, strict=False):
        bounds = envelope(estimate.time, bias - three_sigma, bias + three_sigma)
        ax.fill_between(*bounds, color=color, alpha=0.18, linewidth=0)
        label = f"{name}, band {THREE_SIGMA}"
        ax.plot(*decimated(estimate.time, bias), color=color, linewidth=1.0, label=label)
    reach = style.reach(values, np.abs(values) + spread)
    ax.set_ylim(-reach, reach)
    ax.set_ylabel(f"gyro bias, {unit}")
    style.legend_above(ax)


def _attitude_sigma(ax: Axes, estimate: Estimate) -> None:
    """Draw the σ of the attitude over time."""
    total = np.linalg.norm(estimate.sigma[:, :3], axis=1)
    settled = style.settled(total)
    unit, size = angle_unit(settled)
    words = "root sum square of the three axes"
    # A line that follows the changes of σ between measurements would be a black area.
    edges, least, most = envelope(estimate.time, total / size)
    ax.fill_between(edges, least, most, color=style.SKY, linewidth=0)
    ax.plot(edges, most, color=style.ink(), linewidth=0.8)
    if len(total) > BAND_COLUMNS:
        words += ", minimum to maximum of each pixel"
    ax.set_ylabel(f"attitude σ, {unit}")
    ax.set_title(words, loc="right", fontsize="small")
    if total.max() > 5.0 * settled.max():  # a large initial σ would make the rest unreadable
        style.log_scale(ax)
        ax.set_ylim(bottom=0.4 * total.min() / size)  # a label below the curve
    else:
        ax.set_ylim(bottom=0.0)


def states_over_time(estimate: Estimate, *, title: str = "") -> Figure:
    """Draw the error states of an estimate over time with their ±3σ, one axes for each declaration and unit, in their order."""
    panels = [
        (name, block, unit, [k for k, each in enumerate(block.units) if each == unit])
        for name, block in estimate.error_states.items()
        for unit in dict.fromkeys(block.units)
    ]
    figure, grid = style.new_figure(len(panels), 1, size=(9.0, 1.2 + 1.8 * len(panels)), sharex=True)
    axes = np.atleast_1d(grid)
    for ax, (name, block, unit, members) in zip(axes, panels, strict=True):
        word, size = state_unit(estimate, name, unit)
        values, spread = block.values[:, members] / size, 3.0 * block.sigma[:, members] / size
        for k, member in enumerate(members):
            color = style.CYCLE[k % len(style.CYCLE)]
            edges, low, high = envelope(estimate.time, values[:, k] - spread[:, k], values[:, k] + spread[:, k])
            if len(members) == 1:
                ax.fill_between(edges, low, high, color=color, alpha=0.18, linewidth=0)
            else:  # filled bands of several components would hide each other
                for edge in (low, high):
                    ax.plot(edges, edge, ":", color=color, linewidth=0.9)
            ax.plot(*decimated(estimate.time, values[:, k]), color=color, linewidth=0.9, label=block.components[member])
        reach = style.reach(np.abs(values) + spread)
        ax.set_ylim(-reach, reach)
        ax.set_ylabel(word)
        ax.set_title(error_state_name(name, "", unit), loc="left")
        style.legend_above(ax, ncols=min(len(members), 9))
    axes[-1].set_xlabel("time, s")
    axes[-1].set_xlim(estimate.time[0], estimate.time[-1])
    figure.suptitle("; ".join([*([title] if title else []), f"dotted or shaded: {THREE_SIGMA}"]))
    return figure


def recording_errors(estimate: Estimate, reference: Array, movement: np.ndarray | None = None) -> Figure:
    """Draw the errors of an estimate relative to a reference q_fb (n, 4), heading above, the two of the vertical below, with its ±3σ.

    They are a rotation vector in the fixed frame, from estimate to reference; ``movement`` (n,) are the samples that are judged, shaded.
    """
    known = are_finite(reference)
    error = np.full((len(known), 3), np.nan)
    error[known] = quaternion.log(quaternion.multiply(reference[known], quaternion.conjugate(estimate.attitude[known])))
    turn = quaternion.to_matrix(estimate.attitude)
    if estimate.covariance is None:
        sigma = np.sqrt(np.einsum("nij,nj->ni", turn**2, estimate.variance[:, :3]))
    else:
        sigma = np.sqrt(np.einsum("nij,njk,nik->ni", turn, estimate.covariance[:, :3, :3], turn))
    figure, axes = style.new_figure(3, 1, size=(9.0, 6.6), sharex=True)
    mask = np.zeros(len(known), int) if movement is None else movement.astype(int)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]])))
    for ax, axis, name in zip(axes, (2, 0, 1), ("heading", "vertical, about x", "vertical, about y"), strict=True):
        for k, (first, last) in enumerate(edges.reshape(-1, 2)):
            words = "movement (judged)" if k == 0 else None
            ax.axvspan(*estimate.time[[first, last - 1]], color=style.ink(), alpha=0.07, linewidth=0, label=words)
        errors_in_envelope(estimate.time, error[None, :, axis] / DEGREE, sigma[:, axis] / DEGREE, ax)
        largest = style.reach(error[:, axis])
        reach = max(largest, min(3.6 * np.median(style.settled(sigma[:, axis])), 5.0 * largest)) / DEGREE
        ax.set_ylim(-reach, reach)
        ax.set_ylabel(f"{name}, °")
        if ax is not axes[-1]:
            ax.set_xlabel("")
    figure.suptitle("Error relative to the reference, axes of the fixed frame")
    style.legend_below(figure, axes, ncols=4)
    return figure


class StateError(NamedTuple):
    """The error of one state of attitude or bias (n,) with the filter's σ (n,) in the unit that both are read best in; NaN: unknown."""

    what: str
    axis: str
    unit: str
    error: Array
    sigma: Array


def state_errors(estimate: Estimate, truth: Truth) -> list[StateError]:
    """Return the errors of the attitude (rotation vector in body axes) and of the gyro bias, if they are known, relative to a truth."""
    if len(truth.attitude) != len(estimate.time):
        raise InputError(
            f"truth has {len(truth.attitude)} times, the estimate {len(estimate.time)}; give both at the same times"
        )
    known = estimate.known & truth.known
    error = np.full((len(known), 6), np.nan)
    error[known] = errors(estimate.attitude[known], estimate.bias[known], truth.attitude[known], truth.bias[known])
    states = []
    for what, first, unit_of in (("attitude", 0, angle_unit), ("bias", 3, rate_unit)):
        part = slice(first, first + 3)
        if np.isfinite(error[:, part]).any():
            spread = 3.0 * estimate.sigma[:, part]
            unit, size = unit_of(style.settled(spread if np.isfinite(spread).any() else error[:, part]))
            sized = zip(style.AXES, error[:, part].T / size, estimate.sigma[:, part].T / size, strict=True)
            states += [StateError(what, axis, unit, *values) for axis, *values in sized]
    return states


def error_overview(estimate: Estimate, truth: Truth | None = None, *, title: str = "") -> Figure:
    """Draw the six errors relative to a truth with the filter's ±3σ: attitude left, bias right.

    Parameters
    ----------
    estimate : Estimate
        Attitude and bias with their σ.
    truth : Truth, optional
        Truth at the times of the estimate. Default: the estimate's own.
    title : str
        Name of the estimate, for the title.

    Returns
    -------
    Figure
        Attitude errors as a rotation vector in body axes, ``q_true = q_est ⊗ exp(δθ)``.
    """
    truth = estimate.truth if truth is None else truth
    instance("truth", truth, Truth, "give that of the record, record.truth")
    assert truth is not None
    drawn = state_errors(estimate, truth)
    if not drawn:
        raise InputError("truth has no attitude at a time of the estimate; give one that is known there")
    columns = len(drawn) // 3
    figure, axes = style.new_figure(3, columns, size=(5.0 * columns, 6.6), sharex=True, squeeze=False)
    for ax, (what, axis, unit, error, sigma) in zip(axes.T.flat, drawn, strict=True):
        errors_in_envelope(estimate.time, error[None], sigma, ax)
        ax.set(ylabel=f"{what} {axis}, {unit}", xlabel="time, s" if axis == "z" else "")
    titles = ("Attitude error, rotation vector in body axes", "Gyro bias error, body axes")
    for ax, words in zip(axes[0], titles, strict=False):
        ax.set_title(words)
    style.legend_below(figure, [axes[0, 0]])
    figure.suptitle(f"{title}{': e' if title else 'E'}rrors against the truth")
    return figure


def draw_estimate(
    estimate: Estimate, folder: str | os.PathLike[str], form: str = "png", *, title: str = ""
) -> list[Path]:
    """Write the figures of an estimate, its error states, and its errors relative to its truth or reference; return the files."""
    truth, target = estimate.truth, Path(folder)
    figures = {target / "estimate": estimate_overview(estimate, title=title, fixed_frame=estimate.fixed_frame)}
    if estimate.error_states:
        figures[target / "states"] = states_over_time(estimate, title=title)
    if truth is not None and truth.has_bias:
        figures[target / "errors"] = error_overview(estimate, title=title)
    elif truth is not None:
        figures[target / "errors"] = recording_errors(estimate, truth.attitude, truth.movement)
    return style.save_as(figures, form)
