"""Smooth motion through given attitudes."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks, quaternion
from strapdown.checks import Array
from strapdown.motion.protocol import edge_stamps, times
from strapdown.motion.quadrature import interval_integrals
from strapdown.results import ByValue

_WIDEST_DEGREES = 170.0


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledAttitude(ByValue):
    """Smooth motion through given attitudes: a spline of the quaternions in four dimensions, scaled to the unit sphere.

    ``q = s/|s|`` with s a spline of degree 5, four times continuously differentiable. Unlike a spline of rotation vectors it needs no
    iteration and no small-angle approximation, and the motion does not depend on the choice of body and fixed axes. The rate
    ``w_b = 2 vec(s* ⊗ ṡ)/|s|²`` is exact for this motion; increments are its integrals, converged to rounding.

    Parameters
    ----------
    time : array_like (n,)
        Times, s, increasing; the motion is defined between the first and the last.
    attitudes : array_like (n, 4)
        Unit quaternions q_fb, of either sign, consecutive ones less than 170° apart.
    ends : {"free", "rest"}, default "free"
        Condition at the ends: none, or zero rate and angular acceleration.
    """

    time: Array
    attitudes: Array
    ends: str = "free"

    def __post_init__(self) -> None:
        checks.one_of("ends", self.ends, ("free", "rest"))
        time = checks.increasing("time", self.time, minimum=6 if self.ends == "free" else 2).copy()
        samples = checks.unit_quaternions("attitudes", checks.array("attitudes", self.attitudes, ("n", 4)))
        if len(samples) != len(time):
            raise checks.InputError(f"attitudes has {len(samples)} rows for {len(time)} stamps; give one per stamp")
        turns = np.sum(samples[1:] * samples[:-1], axis=-1)
        wide = np.abs(turns) < math.cos(0.5 * math.radians(_WIDEST_DEGREES))
        if wide.any():
            k = int(np.argmax(wide))
            raise checks.InputError(
                f"attitudes[{k + 1}] is {math.degrees(2.0 * math.acos(min(1.0, abs(turns[k])))):.0f}° from the one before; "
                f"give samples less than {_WIDEST_DEGREES:g}° apart, so that the rotation between them is unambiguous"
            )
        samples[1:] *= np.cumprod(np.where(turns < 0.0, -1.0, 1.0))[:, None]
        time.flags.writeable = samples.flags.writeable = False
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "attitudes", samples)

    @property
    def breaks(self) -> Array:
        """Times of the samples, s, at which the polynomial pieces of the spline meet."""
        return self.time

    @functools.cached_property
    def _splines(self) -> tuple[Any, Any, Any]:
        from scipy.interpolate import make_interp_spline

        still = [(order, np.zeros(4)) for order in (1, 2)]
        ends = (still, still) if self.ends == "rest" else None
        spline = make_interp_spline(self.time, self.attitudes, k=5, bc_type=ends)
        return spline, spline.derivative(), spline.derivative(2)

    def _inside(self, time: Array) -> Array:
        outside = (time < self.time[0]) | (time > self.time[-1])
        if outside.any():
            value = float(time[outside][0]) if time.ndim else float(time)
            raise checks.InputError(
                f"time {value:g} s is outside the samples, {self.time[0]:g} s to {self.time[-1]:g} s; "
                "a sampled motion does not extrapolate"
            )
        return time

    def _smooth(self, time: Array, derivatives: int) -> tuple[Array, ...]:
        t = self._inside(time)
        return tuple(np.asarray(spline(t)) for spline in self._splines[: derivatives + 1])

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb (..., 4)."""
        return quaternion.normalize(self._smooth(times(time), 0)[0])

    def body_rate(self, time: ArrayLike) -> Array:
        """Return ``w_b = 2 vec(s* ⊗ ṡ)/|s|²``, rad/s."""
        s, velocity = self._smooth(times(time), 1)
        product = quaternion.multiply(quaternion.conjugate(s), velocity)[..., 1:]
        return np.asarray(2.0 * product / np.sum(s * s, axis=-1, keepdims=True))

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return ``dw_b/dt = 2 vec(s* ⊗ s̈)/|s|² − 2 w_b (s · ṡ)/|s|²``, rad/s²."""
        s, velocity, acceleration = self._smooth(times(time), 2)
        back, squared = quaternion.conjugate(s), np.sum(s * s, axis=-1, keepdims=True)
        growth = 2.0 * np.sum(s * velocity, axis=-1, keepdims=True) / squared
        rate = 2.0 * quaternion.multiply(back, velocity)[..., 1:] / squared
        return np.asarray(2.0 * quaternion.multiply(back, acceleration)[..., 1:] / squared - growth * rate)

    def increments(self, edges: ArrayLike) -> Array:
        """Return ∫ w_b dt over each interval, rad, by converged quadrature between the samples."""
        stamps = self._inside(edge_stamps(edges))
        return interval_integrals(self.body_rate, stamps, self.time)


def waypoints(time: ArrayLike, attitudes: ArrayLike) -> SampledAttitude:
    """Return the smooth motion from rest through the given attitudes to rest.

    Parameters
    ----------
    time : array_like (n,)
        Times, s, increasing; n ≥ 2.
    attitudes : array_like (n, 4)
        Unit quaternions q_fb, consecutive ones less than 170° apart.

    Returns
    -------
    SampledAttitude
        The motion, with ``ends="rest"``.
    """
    return SampledAttitude(time=np.asarray(time), attitudes=np.asarray(attitudes), ends="rest")
