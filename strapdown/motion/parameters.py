"""Checks of every motion's parameters and times, and the shape of its results."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks
from strapdown.checks import Array

IDENTITY = (1.0, 0.0, 0.0, 0.0)
"""Attitude of a body whose axes are the fixed axes."""


def times(time: ArrayLike) -> Array:
    """Return finite times, s, of any shape."""
    return checks.array("time", time, (...,))


def edge_stamps(edges: ArrayLike) -> Array:
    """Return the edges (n + 1,) of n ≥ 1 intervals, s, increasing."""
    return checks.increasing("edges", edges, minimum=2)


def store_number(motion: object, name: str, unit: str) -> float:
    """Check a parameter of a frozen motion and store it as a finite float."""
    value = checks.finite(name, getattr(motion, name), unit=unit)
    object.__setattr__(motion, name, value)
    return value


def store_vector(motion: object, name: str) -> tuple[float, ...]:
    """Check a parameter of a frozen motion and store it as three floats."""
    value = tuple(checks.array(name, getattr(motion, name), (3,)).tolist())
    object.__setattr__(motion, name, value)
    return value


def store_attitude(motion: object, name: str) -> None:
    """Check a parameter of a frozen motion and store it as a unit quaternion."""
    value = checks.unit_quaternions(name, checks.array(name, getattr(motion, name), (4,)))
    object.__setattr__(motion, name, tuple(value.tolist()))


def stacked(*components: float | Array) -> Array:
    """Return the components stacked along a new last axis."""
    return np.stack(np.broadcast_arrays(*components), axis=-1).astype(np.float64, copy=False)
