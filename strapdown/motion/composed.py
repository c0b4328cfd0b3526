"""A vibration on a base motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks, quaternion
from strapdown.checks import Array
from strapdown.motion.protocol import Motion, break_times, edge_stamps, times
from strapdown.motion.quadrature import interval_integrals


@dataclass(frozen=True, kw_only=True)
class Composed:
    """A vibration on a base motion, ``q = q_base ⊗ q_vibration``: the body vibrates, and may cone, about the moving base.

    The rate is ``w_b = R_vᵀ w_base + w_v``. The increments are the exact ones of the vibration plus the integral of ``R_vᵀ w_base``,
    converged to rounding.

    Parameters
    ----------
    base : Motion
        Attitude of the base in the fixed frame.
    vibration : Motion
        Attitude of the body relative to the base.
    """

    base: Motion
    vibration: Motion

    def __post_init__(self) -> None:
        for name in ("base", "vibration"):
            if not isinstance(getattr(self, name), Motion):
                raise checks.InputError(f"{name} is {getattr(self, name)!r}; give a motion, such as motion.Coning(…)")
            break_times(name, getattr(self, name))

    @property
    def breaks(self) -> Array:
        """The breaks of the base and of the vibration, s."""
        return np.union1d(break_times("base", self.base), break_times("vibration", self.vibration))

    def _carried_rate(self, time: Array) -> Array:
        """Return R_vᵀ w_base: the rate of the base in body axes."""
        return quaternion.rotate(quaternion.conjugate(self.vibration.attitude(time)), self.base.body_rate(time))

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb (..., 4)."""
        t = times(time)
        return quaternion.multiply(self.base.attitude(t), self.vibration.attitude(t))

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b = R_vᵀ w_base + w_v, rad/s."""
        t = times(time)
        return self._carried_rate(t) + self.vibration.body_rate(t)

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return dw_b/dt = R_vᵀ ẇ_base − w_v × R_vᵀ w_base + ẇ_v, rad/s²."""
        t = times(time)
        turned = quaternion.rotate(
            quaternion.conjugate(self.vibration.attitude(t)), self.base.body_angular_acceleration(t)
        )
        carried = np.cross(self._carried_rate(t), self.vibration.body_rate(t))
        return np.asarray(turned + carried + self.vibration.body_angular_acceleration(t))

    def increments(self, edges: ArrayLike) -> Array:
        """Return ∫ w_b dt over each interval, rad."""
        stamps = edge_stamps(edges)
        return interval_integrals(self._carried_rate, stamps, self.breaks) + self.vibration.increments(stamps)
