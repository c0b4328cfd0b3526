"""Rotation at a constant rate, and rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import localcontext
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array
from strapdown.motion.exact_phase import DIGITS, cosine_sine, to_decimal, to_pair
from strapdown.motion.parameters import IDENTITY, edge_stamps, stacked, store_attitude, store_vector, times


@dataclass(frozen=True, kw_only=True)
class ConstantRate:
    """Rotation at a constant body rate, ``q = q_0 ⊗ exp(w_b t)``.

    Parameters
    ----------
    rate : array_like (3,)
        Rate w_b about each body axis, rad/s.
    initial_attitude : array_like (4,), default identity
        Unit quaternion q_fb at time 0.

    Examples
    --------
    >>> ConstantRate(rate=(0.0, 0.0, np.pi)).attitude(1.0).round(12).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """

    rate: Sequence[float]
    initial_attitude: Sequence[float] = IDENTITY

    def __post_init__(self) -> None:
        store_vector(self, "rate")
        store_attitude(self, "initial_attitude")

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb (..., 4)."""
        t = times(time)
        squared = sum((Fraction(component) ** 2 for component in self.rate), Fraction(0))
        with localcontext(prec=DIGITS):
            half_norm = to_pair(to_decimal(squared).sqrt() / 2)
        cosine, sine = cosine_sine(half_norm, t)
        x, y, z = (0.5 * component / half_norm[0] if half_norm[0] else 0.0 for component in self.rate)
        return quaternion.multiply(np.array(self.initial_attitude), stacked(cosine, x * sine, y * sine, z * sine))

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b, rad/s."""
        return np.broadcast_to(np.array(self.rate), (*times(time).shape, 3)).copy()

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return zeros, rad/s²."""
        return np.zeros((*times(time).shape, 3))

    def increments(self, edges: ArrayLike) -> Array:
        """Return w_b h for each interval of duration h, rad."""
        return np.asarray(np.diff(edge_stamps(edges))[:, None] * np.array(self.rate))


def rest(initial_attitude: Sequence[float] = IDENTITY) -> ConstantRate:
    """Return the motion of a body at rest.

    Parameters
    ----------
    initial_attitude : array_like (4,), default identity
        Unit quaternion q_fb.

    Returns
    -------
    ConstantRate
        The motion with rate zero.
    """
    return ConstantRate(rate=(0.0, 0.0, 0.0), initial_attitude=initial_attitude)
