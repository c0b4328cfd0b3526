"""State at the first sample of an IMU: attitude by TRIAD from the specific force and the field, and its variances."""

from __future__ import annotations

from typing import NamedTuple

from strapdown.kernels.algebra import cross, dot, scale, square_root
from strapdown.kernels.rotation import unit


class Constants(NamedTuple):
    """Constants of the variances."""

    attitude_sigma: float
    """σ of the tilt of a unit at rest, rad."""
    max_tilt_sigma: float
    swing_time: float
    """Time over which the first rate is assumed to accelerate the unit, s."""
    gravity: float
    min_level: float
    """Squared cosine of the dip beyond which a field has hardly a heading."""
    field_sigma: float
    """σ of a disturbance of the field, relative to its magnitude."""


def first_attitude(force, across):
    """Return the attitude in East, North, up axes from the specific force and the field, or any other direction, in body axes."""
    up, north = direction(force), direction(across)
    east = direction(cross(north, up))
    north = cross(up, east)
    # Shepperd's method: the rows of 4 q qᵀ, of which the one with the largest component is normalised.
    w, x = 1.0 + (east[0] + north[1] + up[2]), 1.0 + (east[0] - north[1] - up[2])
    y, z = 1.0 + (north[1] - east[0] - up[2]), 1.0 + (up[2] - east[0] - north[1])
    if w >= x and w >= y and w >= z:
        q = (w, up[1] - north[2], east[2] - up[0], north[0] - east[1])
    elif x >= y and x >= z:
        q = (up[1] - north[2], x, north[0] + east[1], east[2] + up[0])
    elif y >= z:
        q = (east[2] - up[0], north[0] + east[1], y, up[1] + north[2])
    else:
        q = (north[0] - east[1], east[2] + up[0], up[1] + north[2], z)
    q = unit(q)
    if q[0] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    return q


def direction(v):
    """Return a vector of length 1."""
    return scale(1.0 / square_root(dot(v, v)), v)


def least_axis(v):
    """Return the axis to which a vector has the smallest component."""
    x, y, z = abs(v[0]), abs(v[1]), abs(v[2])
    if x <= y and x <= z:
        return (1.0, 0.0, 0.0)
    if y <= z:
        return (0.0, 1.0, 0.0)
    return (0.0, 0.0, 1.0)


def sine_of_dip(force, field):
    """Return the cosine of the angle between specific force and field."""
    return dot(direction(force), direction(field))


def tilt_variance(constants, force, rate):
    """Return the variance of the tilt, rad², with the deviation from gravity and the motion that the first rate implies."""
    moved = square_root(dot(force, force)) / constants.gravity - 1.0
    swing = constants.swing_time * square_root(dot(rate, rate))
    sigma = min(square_root(constants.attitude_sigma**2 + moved * moved + swing * swing), constants.max_tilt_sigma)
    return sigma * sigma


def heading_variance(constants, sine, tilt):
    """Return the variance of the heading, rad², by the tilt, because the field dips, and by a disturbance of the field."""
    return (sine * sine * tilt + constants.field_sigma**2) / max(1.0 - sine * sine, constants.min_level)


def iron_variance(sigma, sine):
    """Return the variance of the heading, rad², by iron with σ relative to the magnitude of the field."""
    return sigma * sigma / max(1.0 - sine * sine, 1e-12)
