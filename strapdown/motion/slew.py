"""A smooth rotation about one axis from rest to rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks, quaternion
from strapdown.checks import Array
from strapdown.motion.parameters import IDENTITY, edge_stamps, store_attitude, store_number, store_vector, times


@dataclass(frozen=True, kw_only=True)
class Slew:
    """Rest-to-rest rotation about one axis, ``q = q_0 ⊗ exp(s(x) Φ)``, ``x = (t − start)/duration``; at rest before and after.

    ``s = 35 x⁴ − 84 x⁵ + 70 x⁶ − 20 x⁷``: rate, angular acceleration and its derivative are zero at start and end. The maximum rate is
    ``35/16 |Φ|/duration``.

    Parameters
    ----------
    rotation_vector : array_like (3,)
        Φ, the total rotation in body axes, rad; may exceed π.
    duration : float
        Duration of the rotation, s.
    start : float, default 0.0
        Time at which the rotation begins, s.
    initial_attitude : array_like (4,), default identity
        Unit quaternion q_fb before the slew.
    """

    rotation_vector: Sequence[float]
    duration: float
    start: float = 0.0
    initial_attitude: Sequence[float] = IDENTITY

    def __post_init__(self) -> None:
        store_vector(self, "rotation_vector")
        object.__setattr__(self, "duration", checks.positive("duration", self.duration, unit="s"))
        store_number(self, "start", "s")
        store_attitude(self, "initial_attitude")

    @property
    def end(self) -> float:
        """Time at which the slew ends, s."""
        return self.start + self.duration

    @property
    def breaks(self) -> Array:
        """Start and end, s, at which the third derivative of the rate is discontinuous."""
        return np.array([self.start, self.end])

    def _elapsed(self, time: Array) -> tuple[Array, Array]:
        """Return the time since the start and until the end, s, of the time clipped to the slew."""
        inside = np.clip(time, self.start, self.end)
        return inside - self.start, self.end - inside

    def _rate(self, since: Array, until: Array) -> Array:
        """Return ds/dt = 140 x³ (1 − x)³/duration, with 1 − x computed from the time until the end to avoid cancellation."""
        length = self.end - self.start
        return np.asarray(140.0 * (since / length * (until / length)) ** 3 / length)

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb (..., 4)."""
        x = self._elapsed(times(time))[0] / (self.end - self.start)
        angle = np.asarray(x**4 * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x))))
        turn = quaternion.exp(angle[..., None] * np.array(self.rotation_vector))
        return quaternion.multiply(np.array(self.initial_attitude), turn)

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b, rad/s."""
        return np.asarray(self._rate(*self._elapsed(times(time)))[..., None] * np.array(self.rotation_vector))

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return dw_b/dt, rad/s²."""
        since, until = self._elapsed(times(time))
        length = self.end - self.start
        x, y = since / length, until / length
        acceleration = np.asarray(420.0 * (x * y) ** 2 * (y - x) / length**2)
        return np.asarray(acceleration[..., None] * np.array(self.rotation_vector))

    def increments(self, edges: ArrayLike) -> Array:
        """Return ∫ w_b dt over each interval, rad; four Gauss points are exact, because the rate is a polynomial of degree 6."""
        since, until = self._elapsed(edge_stamps(edges))
        step = np.diff(np.clip(np.asarray(edges, dtype=np.float64), self.start, self.end))
        nodes, weights = np.polynomial.legendre.leggauss(4)
        before, after = 0.5 * (1.0 + nodes) * step[:, None], 0.5 * (1.0 - nodes) * step[:, None]
        rate = self._rate(since[:-1, None] + before, until[1:, None] + after)
        return np.asarray((0.5 * step * (rate @ weights))[:, None] * np.array(self.rotation_vector))
