"""The rigid body free of torque."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks, quaternion
from strapdown.checks import Array
from strapdown.motion.constant_rate import ConstantRate
from strapdown.motion.euler_poinsot import EulerPoinsot
from strapdown.motion.parameters import IDENTITY, edge_stamps, store_attitude, store_vector, times


@dataclass(frozen=True, kw_only=True)
class TorqueFree:
    """Rigid body free of torque, by Jacobi elliptic functions (Landau and Lifshitz, *Mechanics*, §37).

    Any moments and any initial rate: both energy branches, the separatrix between them, symmetric and spherical bodies, spin about
    a principal axis. Constants are computed to 60 digits, so long times cost no accuracy: attitude, rates and increments are
    accurate to a few 1e-16 relative (closed forms for each interval). Very close to the separatrix 1 − m is exact, not 1 less a
    rounded m.

    Parameters
    ----------
    inertia : array_like (3,)
        Principal moments about the body axes x, y, z, kg m² (only their ratios matter); none may exceed the sum of the others.
    initial_rate : array_like (3,)
        w_b at time 0, rad/s.
    initial_attitude : array_like (4,), default identity
        Unit quaternion q_fb at time 0.
    """

    inertia: Sequence[float]
    initial_rate: Sequence[float]
    initial_attitude: Sequence[float] = IDENTITY

    def __post_init__(self) -> None:
        moments = store_vector(self, "inertia")
        for i, moment in enumerate(moments):
            checks.positive(f"inertia[{i}]", moment, unit="kg m²")
        for i, moment in enumerate(moments):
            if moment > (moments[i - 1] + moments[i - 2]) * (1.0 + 1e-12):
                raise checks.InputError(
                    f"inertia[{i}] is {moment:g}, more than the sum of the other two; no rigid body has such principal moments"
                )
        store_vector(self, "initial_rate")
        store_attitude(self, "initial_attitude")

    @functools.cached_property
    def _solution(self) -> EulerPoinsot | ConstantRate:
        moments, w = [Fraction(i) for i in self.inertia], [Fraction(r) for r in self.initial_rate]
        if all((moments[i] - moments[i - 1]) * w[i] * w[i - 1] == 0 for i in range(3)):
            return ConstantRate(rate=self.initial_rate, initial_attitude=self.initial_attitude)
        return EulerPoinsot.of(self.inertia, self.initial_rate)

    @functools.cached_property
    def _fixed_side(self) -> Array:
        return quaternion.multiply(
            np.array(self.initial_attitude), quaternion.conjugate(self._solution.attitude(np.zeros(())))
        )

    @property
    def energy(self) -> float:
        """Kinetic energy T, J; constant."""
        return 0.5 * math.fsum(i * w * w for i, w in zip(self.inertia, self.initial_rate, strict=True))

    @property
    def angular_momentum(self) -> Array:
        """Angular momentum h_f in fixed axes (3,), kg m²/s; constant."""
        return quaternion.rotate(np.array(self.initial_attitude), np.array(self.inertia) * np.array(self.initial_rate))

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb (..., 4)."""
        t = times(time)
        if isinstance(self._solution, ConstantRate):
            return self._solution.attitude(t)
        return quaternion.multiply(self._fixed_side, self._solution.attitude(t))

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b, rad/s."""
        return self._solution.body_rate(times(time))

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return dw_b/dt from Euler's equations, ``I ẇ = (I w) × w``, rad/s²."""
        w, moments = self.body_rate(time), np.array(self.inertia)
        return np.asarray(np.cross(moments * w, w) / moments)

    def increments(self, edges: ArrayLike) -> Array:
        """Return ∫ w_b dt over each interval, rad."""
        return self._solution.increments(edge_stamps(edges))
