"""A spinning body whose spin axis rocks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array
from strapdown.motion.exact_phase import cosine_sine, exact_sum, harmonic_integrals
from strapdown.motion.parameters import edge_stamps, stacked, store_number, times


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
        store_number(self, "rock_angle", "rad")
        store_number(self, "rock_frequency", "Hz")
        store_number(self, "spin_rate", "rad/s")
        store_number(self, "rock_phase", "rad")

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
