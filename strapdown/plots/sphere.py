"""The path of a body axis on the unit sphere of the fixed frame."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from strapdown import quaternion
from strapdown.checks import Array, InputError, array
from strapdown.plots.style import AXES, BLUE, STYLE, VERMILION, axes_or_new, ink, legend_above

MOST_POINTS = 20_000
"""Points of a drawn path; a longer one is thinned evenly."""


NARROW = 0.35
"""Reach of a path about its mean, below which it is drawn without the sphere, beside which it could not be seen."""

LEAST_REACH = 1e-6
"""Half the width of the figure of an axis that stands still."""


def body_axis_path(attitude: Array, axis: int = 2) -> Array:
    """Return the direction of a body axis (0, 1, 2: x, y, z) in the fixed frame, unit vectors (n, 3), of attitudes q_fb (n, 4)."""
    if axis not in (0, 1, 2):
        raise InputError(f"axis is {axis!r}; it must be 0, 1 or 2 (x, y, z)")
    return quaternion.rotate(array("attitude", attitude, ("n", 4)), np.eye(3)[axis])


def body_axis_on_sphere(estimated: Array, true: Array | None = None, axis: int = 2, ax: Axes | None = None) -> Axes:
    """Draw the path of a body axis on the unit sphere, estimated and, where it is known, true, projected along its mean direction.

    A narrow cone fills the figure as a wide one does; the two coordinates are components of a unit vector.

    Parameters
    ----------
    estimated, true : (n, 4)
        Attitudes q_fb.
    axis : {0, 1, 2}
        Body x, y or z.
    ax : Axes, optional
        A new figure's if not given.

    Returns
    -------
    Axes
        What was drawn on.
    """
    ax = axes_or_new(ax)
    paths = [("estimated", body_axis_path(estimated, axis), VERMILION, 0.8)]
    if true is not None:
        paths.insert(0, ("true", body_axis_path(true, axis), BLUE, 2.4))
    across = _plane(paths[0][1])
    for name, path, color, width in paths:
        flat = (path @ across.T)[:: -(-len(path) // MOST_POINTS)]
        ax.plot(flat[:, 0], flat[:, 1], color=color, linewidth=width, alpha=0.9, label=name)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(f"body {AXES[axis]} axis, first component normal to its mean")
    ax.set_ylabel("second component")
    legend_above(ax)
    return ax


def _plane(path: Array) -> Array:
    """Return two unit vectors (2, 3) across the mean direction of a path."""
    mean = path.mean(axis=0)
    length = float(np.linalg.norm(mean))
    direction = mean / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def sphere_figure(estimated: Array, true: Array | None = None, axis: int = 2) -> Figure:
    """Draw the path of a body axis on the whole unit sphere in three dimensions, estimated and, where it is known, true."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.0, 5.6), dpi=150, layout="constrained")
        ax: Any = figure.add_subplot(projection="3d")
        paths = [("estimated", body_axis_path(estimated, axis), VERMILION, 0.9)]
        if true is not None:
            paths.insert(0, ("true", body_axis_path(true, axis), BLUE, 2.2))
        for name, path, color, width in paths:
            few = path[:: -(-len(path) // MOST_POINTS)]
            ax.plot(few[:, 0], few[:, 1], few[:, 2], color=color, linewidth=width, label=name)
        mean = paths[0][1].mean(axis=0)
        reach = max(float(np.abs(paths[0][1] - mean).max()), LEAST_REACH)
        narrow = reach < NARROW
        if not narrow:
            _wire(ax)
        _dress(ax, axis, mean if narrow else np.zeros(3), 1.2 * reach if narrow else 1.0)
        if np.linalg.norm(mean) > 1e-6:  # look at the path, from a little aside
            ax.view_init(
                elev=float(np.degrees(np.arctan2(mean[2], np.hypot(mean[0], mean[1])))) * 0.7 + 8.0,
                azim=float(np.degrees(np.arctan2(mean[1], mean[0]))) + 20.0,
            )
        ax.legend(loc="upper left", frameon=False)
        return figure


def _wire(ax: Any) -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    for latitude in np.radians([-60.0, -30.0, 0.0, 30.0, 60.0]):
        ring = np.cos(latitude)
        ax.plot(ring * np.cos(turn), ring * np.sin(turn), np.sin(latitude), color=ink(), linewidth=0.3, alpha=0.4)
    for longitude in np.radians(np.arange(0.0, 180.0, 30.0)):
        x, y = np.cos(turn) * np.cos(longitude), np.cos(turn) * np.sin(longitude)
        ax.plot(x, y, np.sin(turn), color=ink(), linewidth=0.3, alpha=0.4)


def _dress(ax: Any, axis: int, centre: Array, reach: float) -> None:
    ax.set_box_aspect((1.0, 1.0, 1.0), zoom=0.82)  # room for the labels, which the layout does not measure
    for name, middle in zip(AXES, centre, strict=True):
        getattr(ax, f"set_{name}lim")(middle - reach, middle + reach)
        getattr(ax, f"set_{name}label")(f"fixed {name}")
        getattr(ax, f"{name}axis").set_major_locator(MaxNLocator(4))
        pane = getattr(ax, f"{name}axis").pane
        pane.fill = False
        pane.set_edgecolor(ink())
        pane.set_alpha(0.3)
    ax.grid(visible=False)
    ax.tick_params(labelsize="small")
    ax.set_title(f"Direction of the body {AXES[axis]} axis in the fixed frame", loc="left")
