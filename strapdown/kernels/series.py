"""Series coefficients of the rotation functions, as polynomials in the squared angle.

A polynomial in ``x = θ²`` has no branch and no square root, and is accurate to rounding at the small angles of gyro increments, where the
closed forms lose digits. Its degree limits the angle: see :data:`LARGEST_ANGLE`.
"""

from __future__ import annotations

import math

LARGEST_ANGLE = 1.0 / 3.0
"""Maximum angle, rad, at which the polynomials below are accurate to rounding; larger increments are divided into sub-steps. Beyond it
their accuracy decreases gradually: 1e-10 at 1 rad, 1e-6 at 2 rad."""
SQUARED_RANGE = LARGEST_ANGLE * LARGEST_ANGLE
"""The same limit for the squared angle, rad²."""

_COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(6))
_SINC = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(6))
_SECOND = tuple((-1.0) ** k / math.factorial(2 * k + 2) for k in range(6))
_THIRD = tuple((-1.0) ** k / math.factorial(2 * k + 3) for k in range(6))
_FOURTH = tuple((-1.0) ** k / math.factorial(2 * k + 4) for k in range(6))
_FIFTH = tuple(2.0 * (-1.0) ** k / math.factorial(2 * k + 5) for k in range(6))


def polynomial(x, c0, c1, c2, c3, c4, c5):
    """Return Σ cₖ xᵏ by Estrin's scheme: one multiplication more than Horner's, but a dependency chain half as long."""
    xx = x * x
    return ((c5 * x + c4) * xx + (c3 * x + c2)) * xx + (c1 * x + c0)


def cosine(x):
    """Return cos √x."""
    return polynomial(x, *_COSINE)


def sinc(x):
    """Return sin √x / √x."""
    return polynomial(x, *_SINC)


def second(x):
    """Return (1 − cos θ)/θ² at θ = √x; tends to 1/2."""
    return polynomial(x, *_SECOND)


def third(x):
    """Return (θ − sin θ)/θ³ at θ = √x; tends to 1/6."""
    return polynomial(x, *_THIRD)


def fourth(x):
    """Return (θ²/2 − 1 + cos θ)/θ⁴ at θ = √x; tends to 1/24."""
    return polynomial(x, *_FOURTH)


def fifth(x):
    """Return (1/3 − 2(θ − sin θ)/θ³)/θ² at θ = √x; tends to 1/60."""
    return polynomial(x, *_FIFTH)
