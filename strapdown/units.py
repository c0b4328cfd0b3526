"""Units at the rim: factors that take a value in the named unit to SI and radians. Multiply on the way in, divide on the way out."""

from __future__ import annotations

import math

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
