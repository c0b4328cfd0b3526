"""One estimate over time: attitude, bias, σ, errors."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from strapdown import quaternion
from strapdown.checks import Array
from strapdown.consistency import ReferenceErrors, errors
from strapdown.plots.decimation import decimated
from strapdown.plots.style import AXES, BLUE, CYCLE, SKY, VERMILION, angle_unit, axes_or_new, ink, new_figure, rate_unit
from strapdown.records import Estimate, Truth
from strapdown.units import DEGREE


def errors_in_envelope(time: Array, error: Array, sigma: Array, ax: Axes | None = None) -> Axes:
    """Draw errors (runs, m) over time inside ±3σ of the filter's own (m,); both in the unit of the axis that the caller labels."""
    ax = axes_or_new(ax)
    when, spread = decimated(time, 3.0 * sigma)
    ax.fill_between(when, -spread, spread, color=SKY, alpha=0.35, linewidth=0, label="±3σ of the filter")
    ax.axhline(0.0, color=ink(), linewidth=0.6)
    for k, one in enumerate(error):
        ax.plot(
            *decimated(time, one),
            color=VERMILION,
            linewidth=0.8,
            alpha=0.8,
            label=f"{len(error)} runs" if k == 0 else None,
        )
    ax.set_xlabel("time, s")
    return ax


def estimate_overview(estimate: Estimate, *, title: str = "") -> Figure:
    """Draw the attitude as roll, pitch and yaw, the gyro bias, and their standard deviations over time."""
    figure, axes = new_figure(3, 1, size=(9.0, 7.5), sharex=True)
    euler = quaternion.to_rotation(estimate.attitude).as_euler("ZYX", degrees=True)[:, ::-1]
    for k, name in enumerate(("roll", "pitch", "yaw")):
        # Breaks where the angle wraps, so that no line crosses the whole plot.
        angle = np.where(np.abs(np.diff(euler[:, k], prepend=euler[0, k])) > 180.0, np.nan, euler[:, k])
        axes[0].plot(*decimated(estimate.time, angle), color=CYCLE[k], linewidth=0.9, label=name)
    sigma = estimate.sigma
    settled = slice(len(estimate.time) // 20, None)
    reach = np.abs(estimate.bias[settled]).max() + 3.0 * sigma[settled, 3:].max()
    unit, size = rate_unit(3.0 * sigma[settled, 3:])
    for k, name in enumerate(AXES):
        bias, spread = estimate.bias[:, k] / size, 3.0 * sigma[:, 3 + k] / size
        when, low = decimated(estimate.time, bias - spread)
        high = np.interp(when, estimate.time, bias + spread)
        axes[1].fill_between(when, low, high, color=CYCLE[k], alpha=0.18, linewidth=0)
        axes[1].plot(*decimated(estimate.time, bias), color=CYCLE[k], linewidth=1.0, label=f"{name}, ±3σ")
    axes[2].plot(*decimated(estimate.time, np.linalg.norm(sigma[:, :3], axis=1) / DEGREE), color=ink(), linewidth=1.0)
    axes[1].set_ylim(-1.2 * reach / size, 1.2 * reach / size)
    axes[0].set_ylabel("attitude, °")
    axes[1].set_ylabel(f"gyro bias, {unit}")
    axes[2].set_ylabel("attitude σ, all axes, °")
    axes[2].set_ylim(bottom=0.0)
    axes[2].set_xlabel("time, s")
    for ax in axes[:2]:  # above the curves, which fill the axes
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=3, frameon=False)
    axes[0].set_title(title, loc="left")
    return figure


def states_over_time(estimate: Estimate, *, title: str = "") -> Figure:
    """Draw the optional states over time inside their ±3σ, one axes a block and unit, in the states' units."""
    panels = [
        (name, block, unit, [k for k, one in enumerate(block.units) if one == unit])
        for name, block in estimate.error_states.items()
        for unit in dict.fromkeys(block.units)
    ]
    figure, grid = new_figure(len(panels), 1, size=(9.0, 1.2 + 1.8 * len(panels)), sharex=True)
    axes = np.atleast_1d(grid)
    settled = slice(len(estimate.time) // 10, None)
    for ax, (name, block, unit, members) in zip(axes, panels, strict=True):
        values, spread = block.values[:, members], 3.0 * block.sigma[:, members]
        for k, member in enumerate(members):
            color = CYCLE[k % len(CYCLE)]
            when, low = decimated(estimate.time, values[:, k] - spread[:, k])
            high = np.interp(when, estimate.time, values[:, k] + spread[:, k])
            ax.fill_between(when, low, high, color=color, alpha=0.15, linewidth=0)
            label = f"{block.components[member]}, ±3σ"
            ax.plot(*decimated(estimate.time, values[:, k]), color=color, linewidth=0.9, label=label)
        reach = 1.2 * float(np.max(np.abs(values[settled]) + spread[settled]))
        ax.set_ylim(-reach, reach)
        ax.set_ylabel(unit)
        ax.set_title(name, loc="left")
        ax.legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=min(len(members), 9), frameon=False
        )
    axes[-1].set_xlabel("time, s")
    if title:
        figure.suptitle(title)
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
            color=ink(),
            alpha=0.07,
            linewidth=0,
            label="movement (judged)" if k == 0 else None,
        )
    for name, color in (("total", ink()), ("heading", BLUE), ("inclination", VERMILION)):
        ax.plot(*decimated(time, getattr(errors, name) / DEGREE), color=color, linewidth=0.9, label=name)
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel("time, s")
    ax.set_ylabel("error, °")
    ax.legend(loc="upper left", ncols=4, frameon=False)
    return figure


def error_overview(estimate: Estimate, truth: Truth, *, title: str = "") -> Figure:
    """Draw the six errors against the truth at the estimate's times inside the filter's own ±3σ: attitude left, bias right."""
    figure, axes = new_figure(3, 2, size=(10.0, 6.6), sharex=True)
    error = errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)
    settled = slice(len(estimate.time) // 20, None)
    for column, (what, unit_of) in enumerate((("attitude", angle_unit), ("bias", rate_unit))):
        states = slice(3 * column, 3 * column + 3)
        unit, size = unit_of(3.0 * estimate.sigma[settled, states])
        for k in range(3):
            state = 3 * column + k
            ax = axes[k, column]
            errors_in_envelope(estimate.time, error[None, :, state] / size, estimate.sigma[:, state] / size, ax)
            reach = max(4.0 * estimate.sigma[settled, state].max(), 1.2 * np.abs(error[settled, state]).max()) / size
            ax.set_ylim(-reach, reach)
            ax.set_ylabel(f"{what} error {AXES[k]}, {unit}")
            if k < 2:
                ax.set_xlabel("")
    handles, _ = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, ["±3σ of the filter", "error"], loc="outside lower center", ncols=2)
    figure.suptitle(title or "Errors against the truth, in the body frame")
    return figure
