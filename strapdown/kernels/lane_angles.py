"""Angles over lanes: an arctangent by arithmetic and selection, accurate to rounding, and the rotation vector of a quaternion.

Scalar code uses libm and branches (:mod:`strapdown.kernels.rotation`).
"""

from __future__ import annotations

import math

import numpy as np

from strapdown.kernels.algebra import square_root
from strapdown.kernels.lane_values import narrowed, select

_QUARTER_ARM = math.sqrt(2.0) - 1.0
"""tan 22.5°: above it the angle is computed relative to 45°."""
_A = tuple((-1.0) ** k / (2 * k + 1) for k in range(20))
_A00, _A01, _A02, _A03, _A04, _A05, _A06, _A07, _A08, _A09 = _A[:10]
_A10, _A11, _A12, _A13, _A14, _A15, _A16, _A17, _A18, _A19 = _A[10:]


_SINGLE = np.float32(0.0)


def inverse_root(x):
    """Return 1/√x for 1e-30 < x < 1e30, accurate to a few roundings: an estimate in single precision and two Newton steps.

    A square root and a division in double precision take four times as long.
    """
    y = narrowed(1.0 / square_root(narrowed(x, _SINGLE)), x)
    h = 0.5 * x
    y = y * (1.5 - h * y * y)
    return y * (1.5 - h * y * y)


def arctangent_series(t):
    """Return atan t for |t| ≤ tan 22.5° by the power series, whose twentieth term is below 1e-16."""
    w = t * t
    ww = w * w
    p = (_A19 * w + _A18) * ww + (_A17 * w + _A16)
    p = p * ww + (_A15 * w + _A14)
    p = p * ww + (_A13 * w + _A12)
    p = p * ww + (_A11 * w + _A10)
    p = p * ww + (_A09 * w + _A08)
    p = p * ww + (_A07 * w + _A06)
    p = p * ww + (_A05 * w + _A04)
    p = p * ww + (_A03 * w + _A02)
    # The leading 1 is not part of the product, which halves a digit of its rounding error.
    return t + t * (p * ww + _A01 * w)


def arctangent(y, x):
    """Return the angle of the point (x, y), rad in [−π, π]; 0 at the origin."""
    across = select(y < 0.0, -y, y)
    along = select(x < 0.0, -x, x)
    steep = across > along
    short = select(steep, along, across)
    long = select(steep, across, along)
    near_half = short > _QUARTER_ARM * long
    top = select(near_half, short - long, short)
    bottom = select(near_half, short + long, long)
    bottom = select(bottom > 0.0, bottom, 1.0)
    angle = arctangent_series(top / bottom)
    angle = select(near_half, angle + 0.25 * math.pi, angle)
    angle = select(steep, 0.5 * math.pi - angle, angle)
    angle = select(x < 0.0, math.pi - angle, angle)
    return select(y < 0.0, -angle, angle)


def rotation_vector(q):
    """Return the rotation vector of a unit quaternion, the shorter way round."""
    squared = q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    sine = square_root(squared)
    w = select(q[0] < 0.0, -q[0], q[0])
    rotates = squared > 1e-36  # below, the angle is twice the vector part, and the square may have underflowed
    factor = select(rotates, 2.0 * arctangent(sine, w) / select(rotates, sine, 1.0), 2.0)
    factor = select(q[0] < 0.0, -factor, factor)
    return (factor * q[1], factor * q[2], factor * q[3])
