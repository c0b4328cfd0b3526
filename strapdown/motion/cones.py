"""Coning, equation (18) of *Quaternion differentiation*, and its generalisation, the spin-cone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks
from strapdown.checks import Array
from strapdown.motion.exact_phase import cosine_sine, harmonic_integrals
from strapdown.motion.parameters import edge_stamps, stacked, store_number, times


@dataclass(frozen=True, kw_only=True)
class Coning:
    """Coning motion, equation (18): ``q = (cos β/2, sin β/2 (cos ωt, sin ωt, 0))`` with ω = 2π ``frequency``.

    Equation (18) of *Quaternion differentiation*; the body and fixed rates are those given after it.

    Parameters
    ----------
    angle : float
        β, the half-angle of the cone swept by the body z axis, rad; 0 to π.
    frequency : float
        Coning frequency, Hz; negative reverses the direction.

    Examples
    --------
    >>> float(Coning(angle=0.01, frequency=10.0).increments([0.0, 0.1])[0, 2].round(9))  # −2π (1 − cos β)
    -0.000314157
    """

    angle: float
    frequency: float

    def __post_init__(self) -> None:
        _store_cone_angle(self)
        store_number(self, "frequency", "Hz")

    @property
    def rate(self) -> float:
        """ω, rad/s."""
        return 2.0 * math.pi * self.frequency

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb, equation (18)."""
        cosine, sine = cosine_sine((self.rate, 0.0), times(time))
        half = math.sin(0.5 * self.angle)
        return stacked(math.cos(0.5 * self.angle), half * cosine, half * sine, 0.0)

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b = (−ω sinβ sin ωt, ω sinβ cos ωt, ω(cosβ − 1)), rad/s."""
        cosine, sine = cosine_sine((self.rate, 0.0), times(time))
        across = self.rate * math.sin(self.angle)
        return stacked(-across * sine, across * cosine, self._rate_along)

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return dw_b/dt = −ω² sinβ (cos ωt, sin ωt, 0), rad/s²."""
        cosine, sine = cosine_sine((self.rate, 0.0), times(time))
        across = self.rate**2 * math.sin(self.angle)
        return stacked(-across * cosine, -across * sine, 0.0)

    def increments(self, edges: ArrayLike) -> Array:
        """Return ∫ w_b dt over each interval, rad."""
        stamps = edge_stamps(edges)
        cosine, sine = harmonic_integrals((self.rate, 0.0), stamps)
        across = self.rate * math.sin(self.angle)
        return stacked(-across * sine, across * cosine, self._rate_along * np.diff(stamps))

    @property
    def _rate_along(self) -> float:
        # ω(cosβ − 1) without the cancellation at small β.
        return -2.0 * self.rate * math.sin(0.5 * self.angle) ** 2


@dataclass(frozen=True, kw_only=True)
class SpinCone:
    """Spin-cone motion ``q = q_z(Ω_p t) q_x(β) q_z(Ω_s t)``: spin about body z, which precesses on a cone.

    ``spin_rate = −precession_rate`` is coning, equation (18) of *Quaternion differentiation*.

    Parameters
    ----------
    precession_rate : float
        Ω_p, precession rate of the body z axis, rad/s.
    spin_rate : float
        Ω_s, rate about the body z axis, rad/s.
    angle : float
        β, the half-angle of the cone, rad; 0 to π.
    """

    precession_rate: float
    spin_rate: float
    angle: float

    def __post_init__(self) -> None:
        store_number(self, "precession_rate", "rad/s")
        store_number(self, "spin_rate", "rad/s")
        _store_cone_angle(self)

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb (..., 4)."""
        t = times(time)
        pc, ps = cosine_sine((0.5 * self.precession_rate, 0.0), t)
        sc, ss = cosine_sine((0.5 * self.spin_rate, 0.0), t)
        c, s = math.cos(0.5 * self.angle), math.sin(0.5 * self.angle)
        return stacked(
            c * (pc * sc - ps * ss), s * (pc * sc + ps * ss), s * (ps * sc - pc * ss), c * (ps * sc + pc * ss)
        )

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b = (Ω_p sinβ sin Ω_s t, Ω_p sinβ cos Ω_s t, Ω_p cosβ + Ω_s), rad/s."""
        cosine, sine = cosine_sine((self.spin_rate, 0.0), times(time))
        across = self.precession_rate * math.sin(self.angle)
        return stacked(across * sine, across * cosine, self._rate_along)

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return dw_b/dt, rad/s²."""
        cosine, sine = cosine_sine((self.spin_rate, 0.0), times(time))
        across = self.precession_rate * self.spin_rate * math.sin(self.angle)
        return stacked(across * cosine, -across * sine, 0.0)

    def increments(self, edges: ArrayLike) -> Array:
        """Return ∫ w_b dt over each interval, rad."""
        stamps = edge_stamps(edges)
        cosine, sine = harmonic_integrals((self.spin_rate, 0.0), stamps)
        across = self.precession_rate * math.sin(self.angle)
        return stacked(across * sine, across * cosine, self._rate_along * np.diff(stamps))

    @property
    def _rate_along(self) -> float:
        # Ω_p cosβ + Ω_s without the cancellation near coning at small β.
        return (self.precession_rate + self.spin_rate) - 2.0 * self.precession_rate * math.sin(0.5 * self.angle) ** 2


def _store_cone_angle(motion: object) -> None:
    angle = checks.non_negative("angle", getattr(motion, "angle"), unit="rad")  # noqa: B009
    if angle > math.pi:
        raise checks.InputError(f"angle is {angle:g} rad; a cone angle lies between 0 and π (is it in degrees?)")
    object.__setattr__(motion, "angle", angle)
