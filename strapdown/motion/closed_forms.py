"""Motions in closed form: constant rate, coning, spin with a rocking axis, and a rotation from rest to rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import localcontext
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks, quaternion
from strapdown.checks import Array
from strapdown.motion.exact_phase import DIGITS, cosine_sine, exact_sum, harmonic_integrals, to_decimal, to_pair
from strapdown.motion.protocol import IDENTITY, edge_stamps, stacked, store_attitude, store_numbers, store_vector, times


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
        store_attitude(self)

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


class _Cone:
    """Rate of a body whose z axis precesses on a cone of half-angle β at Ω_p while the body spins about it at Ω_s."""

    precession_rate: float
    spin_rate: float
    angle: float

    def _store_angle(self) -> None:
        angle = checks.non_negative("angle", self.angle, unit="rad")
        if angle > math.pi:
            raise checks.InputError(f"angle is {angle:g} rad; a cone angle lies between 0 and π (is it in degrees?)")
        object.__setattr__(self, "angle", angle)

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b = (Ω_p sinβ sin Ω_s t, Ω_p sinβ cos Ω_s t, Ω_p cosβ + Ω_s), rad/s."""
        cosine, sine = cosine_sine((self.spin_rate, 0.0), times(time))
        across = self.precession_rate * math.sin(self.angle)
        return stacked(across * sine, across * cosine, self._rate_along)

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return dw_b/dt = Ω_p Ω_s sinβ (cos Ω_s t, −sin Ω_s t, 0), rad/s²."""
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


@dataclass(frozen=True, kw_only=True)
class Coning(_Cone):
    """Coning motion, equation (18): ``q = (cos β/2, sin β/2 (cos ωt, sin ωt, 0))`` with ω = 2π ``frequency``.

    Equation (18) of *Quaternion differentiation*, with the rate ``w_b = (−ω sinβ sin ωt, ω sinβ cos ωt, ω(cosβ − 1))``.

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
        self._store_angle()
        store_numbers(self, frequency="Hz")

    @property
    def rate(self) -> float:
        """ω, rad/s."""
        return 2.0 * math.pi * self.frequency

    precession_rate = rate  # type: ignore[assignment]

    @property
    def spin_rate(self) -> float:  # type: ignore[override]
        """Rate −ω about the body z axis, rad/s."""
        return -self.rate

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb, equation (18)."""
        cosine, sine = cosine_sine((self.rate, 0.0), times(time))
        half = math.sin(0.5 * self.angle)
        return stacked(math.cos(0.5 * self.angle), half * cosine, half * sine, 0.0)


@dataclass(frozen=True, kw_only=True)
class SpinCone(_Cone):
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
        store_numbers(self, precession_rate="rad/s", spin_rate="rad/s")
        self._store_angle()

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb (..., 4)."""
        t = times(time)
        pc, ps = cosine_sine((0.5 * self.precession_rate, 0.0), t)
        sc, ss = cosine_sine((0.5 * self.spin_rate, 0.0), t)
        c, s = math.cos(0.5 * self.angle), math.sin(0.5 * self.angle)
        return stacked(
            c * (pc * sc - ps * ss), s * (pc * sc + ps * ss), s * (ps * sc - pc * ss), c * (ps * sc + pc * ss)
        )


@dataclass(frozen=True, kw_only=True)
class SpinRock:
    """Spin about body z at a constant rate while the spin axis rocks about the fixed x axis.

    ``q = q_x(α) q_z(Ω_s t)`` with ``α = A sin(2π f t + φ)``, so ``w_b = (α̇ cos Ω_s t, −α̇ sin Ω_s t, Ω_s)``.

    Parameters
    ----------
    rock_angle : float
        Amplitude A of the rocking, rad.
    rock_frequency : float
        Frequency f of the rocking, Hz.
    spin_rate : float
        Rate Ω_s of the spin about body z, rad/s.
    rock_phase : float, default 0.0
        Phase φ of the rocking at time 0, rad.
    """

    rock_angle: float
    rock_frequency: float
    spin_rate: float
    rock_phase: float = 0.0

    def __post_init__(self) -> None:
        store_numbers(self, rock_angle="rad", rock_frequency="Hz", spin_rate="rad/s", rock_phase="rad")

    @property
    def rock_rate(self) -> float:
        """2π f, rad/s."""
        return 2.0 * math.pi * self.rock_frequency

    def _rock(self, time: Array) -> tuple[Array, Array, Array]:
        """Return α, α̇, α̈."""
        cosine, sine = cosine_sine((self.rock_rate, 0.0), time, self.rock_phase)
        amplitude, rate = self.rock_angle, self.rock_rate
        return amplitude * sine, amplitude * rate * cosine, -amplitude * rate * rate * sine

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb (..., 4)."""
        t = times(time)
        rock = self._rock(t)[0]
        rc, rs = np.cos(0.5 * rock), np.sin(0.5 * rock)
        sc, ss = cosine_sine((0.5 * self.spin_rate, 0.0), t)
        return stacked(rc * sc, rs * sc, -rs * ss, rc * ss)

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b = (α̇ cos Ω_s t, −α̇ sin Ω_s t, Ω_s), rad/s."""
        t = times(time)
        rock_rate = self._rock(t)[1]
        cosine, sine = cosine_sine((self.spin_rate, 0.0), t)
        return stacked(rock_rate * cosine, -rock_rate * sine, self.spin_rate)

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return dw_b/dt, rad/s²."""
        t = times(time)
        _, rate, acceleration = self._rock(t)
        cosine, sine = cosine_sine((self.spin_rate, 0.0), t)
        spin = self.spin_rate
        return stacked(acceleration * cosine - spin * rate * sine, -acceleration * sine - spin * rate * cosine, 0.0)

    def increments(self, edges: ArrayLike) -> Array:
        """Return ∫ w_b dt over each interval, rad, with products of two harmonics written as sums and their rates added exactly."""
        stamps = edge_stamps(edges)
        up_cosine, up_sine = harmonic_integrals(exact_sum(self.rock_rate, self.spin_rate), stamps, self.rock_phase)
        down_cosine, down_sine = harmonic_integrals(exact_sum(self.rock_rate, -self.spin_rate), stamps, self.rock_phase)
        half = 0.5 * self.rock_angle * self.rock_rate
        return stacked(
            half * (up_cosine + down_cosine), -half * (up_sine - down_sine), self.spin_rate * np.diff(stamps)
        )


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
        store_numbers(self, start="s")
        store_attitude(self)

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
