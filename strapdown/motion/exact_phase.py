"""Phases ω t without rounding error: exact products of floats, constants to 60 digits, and cosines and integrals of them.

The floats ω and t are treated as exact; the rounding error of their product is computed and corrected.
"""

from __future__ import annotations

import math
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np

from strapdown.checks import Array

Pair = tuple[float, float]
"""A number as the unevaluated sum high + low of two floats: about 32 digits."""

DIGITS = 60
"""Number of decimal digits of constants before they are rounded to a :data:`Pair`."""


def to_decimal(value: Fraction) -> Decimal:
    """Return a fraction rounded to the precision of the decimal context."""
    return Decimal(value.numerator) / Decimal(value.denominator)


def to_pair(value: Decimal) -> Pair:
    """Return a decimal number as a pair, to 32 digits."""
    high = float(value)
    return high, float(value - Decimal(high))


def halved(rate: Pair) -> Pair:
    """Return half a pair, exactly."""
    return 0.5 * rate[0], 0.5 * rate[1]


def exact_sum(a: Any, b: Any) -> tuple[Any, Any]:
    """Return a + b exactly, as the rounded sum and its rounding error (Knuth's two-sum); numbers or arrays."""
    high = a + b
    part = high - a
    return high, (a - (high - part)) + (b - part)


def product_error(a: float, b: Array, product: Array) -> Array:
    """Return a b − fl(a b) exactly (Dekker's product; Veltkamp's split at 27 bits)."""
    split = 134217729.0
    ca = split * a
    a_high = ca - (ca - a)
    a_low = a - a_high
    cb = split * b
    b_high = cb - (cb - b)
    b_low = b - b_high
    return np.asarray(((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low)


def cosine_sine(rate: Pair, time: Array, phase: float = 0.0) -> tuple[Array, Array]:
    """Return cos and sin of ω t + φ without rounding error of the product ω t."""
    angle = np.asarray(rate[0] * time)
    error = product_error(rate[0], time, angle) + rate[1] * time
    cosine, sine = np.cos(angle), np.sin(angle)
    cosine, sine = cosine - error * sine, sine + error * cosine
    if phase:
        c, s = math.cos(phase), math.sin(phase)
        cosine, sine = c * cosine - s * sine, c * sine + s * cosine
    return cosine, sine


def harmonic_integrals(rate: Pair, edges: Array, phase: float = 0.0) -> tuple[Array, Array]:
    """Return ∫ cos(ω t + φ) dt and ∫ sin(ω t + φ) dt over each interval.

    Computed as ``h sin(ωh/2)/(ωh/2)`` times the cosine and sine at the middle, which avoids the difference of nearly equal terms.
    """
    step = np.diff(edges)
    cosine, sine = cosine_sine(rate, edges[:-1], phase)
    half_cosine, half_sine = cosine_sine(halved(rate), step)
    half = 0.5 * rate[0] * step
    width = step * np.divide(half_sine, half, out=np.ones_like(half), where=half != 0.0)
    return width * (cosine * half_cosine - sine * half_sine), width * (sine * half_cosine + cosine * half_sine)
