"""Factors from the named unit to SI and radians: multiply on input, divide on output; and the unit that a size is read best in."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

__all__ = [
    "ARCSECOND",
    "DEGREE",
    "DEGREE_PER_HOUR",
    "DEGREE_PER_HOUR_PER_ROOT_HOUR",
    "DEGREE_PER_ROOT_HOUR",
    "STANDARD_GRAVITY",
]

DEGREE = math.pi / 180.0
"""rad"""
ARCSECOND = DEGREE / 3600.0
"""rad"""
DEGREE_PER_HOUR = DEGREE / 3600.0
"""rad/s"""
DEGREE_PER_ROOT_HOUR = DEGREE / 60.0
"""rad/√s, the usual unit of angle random walk; equals π/10800"""
DEGREE_PER_HOUR_PER_ROOT_HOUR = DEGREE / 3600.0 / 60.0
"""rad/s/√s, the usual unit of rate random walk"""
STANDARD_GRAVITY = 9.80665
"""m/s²"""


def angle_unit(value: ArrayLike) -> tuple[str, float]:
    """Return the name and size of the unit in which angles of this size (rad) are read best."""
    typical = float(np.nanmax(np.abs(value), initial=0.0))
    return ("arcsec", ARCSECOND) if typical < 0.05 * DEGREE else ("°", DEGREE)


def rate_unit(value: ArrayLike) -> tuple[str, float]:
    """Return the name and size of the unit in which rates of this size (rad/s) are read best."""
    typical = float(np.nanmax(np.abs(value), initial=0.0))
    return ("°/h", DEGREE_PER_HOUR) if typical < 0.1 * DEGREE else ("°/s", DEGREE)


_STATE_UNITS: dict[str, dict[str, tuple[str, float]]] = {
    **{f"attitude {axis}": {"rad": ("°", DEGREE)} for axis in "xyz"},
    "gyro bias": {"rad/s": ("°/h", DEGREE_PER_HOUR)},
    "gyro scale": {"1": ("ppm", 1e-6), "rad": ("mrad", 1e-3)},
    "gyro misalignment": {"rad": ("mrad", 1e-3)},
    "gyro drift": {"rad/s": ("°/h", DEGREE_PER_HOUR)},
    "gyro temperature": {"rad/s/K": ("°/h/K", DEGREE_PER_HOUR)},
    "gyro force": {"rad s/m": ("°/h/g", DEGREE_PER_HOUR / STANDARD_GRAVITY)},
}


def error_state_name(block: str, component: str, unit: str) -> str:
    """Return the name of one state from its declaration, its component, which may begin with the same word, and its SI unit."""
    block = "gyro misalignment" if (block, unit) == ("gyro scale", "rad") else block
    return f"{block} {component.removeprefix(block.rsplit(maxsplit=1)[-1]).strip()}".strip()


def error_state_unit(name: str, unit: str) -> tuple[str, float]:
    """Return the name and the factor to SI of the printed unit of a state, from its name and SI unit."""
    # rad: mounting and disturbance of a star tracker
    usual = {"1": ("dimensionless", 1.0), "rad": ("arcsec", ARCSECOND)}
    return _STATE_UNITS.get(" ".join(name.split()[:2]), {}).get(unit) or usual.get(unit, (unit, 1.0))
