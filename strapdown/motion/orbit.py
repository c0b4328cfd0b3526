"""A circular low orbit: position and magnetic field along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, array, finite, positive

__all__ = ["CircularOrbit"]

EARTH_RADIUS = 6371.2e3
"""Mean radius of the earth, m; the reference radius of the geomagnetic field."""
EARTH_GRAVITATION = 3.986004418e14
"""Gravitational parameter of the earth, m³/s² (WGS 84)."""
DIPOLE_STRENGTH = 2.98e-5
"""Field of the dipole at the magnetic equator, T (IGRF-13, epoch 2020)."""


@dataclass(frozen=True, kw_only=True)
class CircularOrbit:
    """A circular orbit in an inertial fixed frame, with z to the north pole and the ascending node on the x axis.

    Parameters
    ----------
    altitude : float, default 500e3
        Altitude above the mean radius of the earth, m.
    inclination : float, default 1.7
        Inclination to the equator, rad.
    phase : float, default 0.0
        Angle from the ascending node at time 0, rad.
    """

    altitude: float = 500e3
    inclination: float = 1.7
    phase: float = 0.0

    def __post_init__(self) -> None:
        positive("altitude", self.altitude, unit="m")
        finite("inclination", self.inclination, unit="rad")
        finite("phase", self.phase, unit="rad")

    @property
    def radius(self) -> float:
        """Radius of the orbit, m."""
        return EARTH_RADIUS + self.altitude

    @property
    def rate(self) -> float:
        """Angular rate √(μ/r³), rad/s."""
        return float(np.sqrt(EARTH_GRAVITATION / self.radius**3))

    def position(self, time: ArrayLike) -> Array:
        """Return the position.

        Parameters
        ----------
        time : array_like (...)
            Times, s.

        Returns
        -------
        ndarray (..., 3)
            Position, m, fixed (inertial) frame.
        """
        angle = self.phase + self.rate * np.asarray(time, np.float64)
        level = np.sin(angle)
        axes = [np.cos(angle), level * np.cos(self.inclination), level * np.sin(self.inclination)]
        return np.asarray(self.radius * np.stack(axes, axis=-1))

    def magnetic_field(self, time: ArrayLike) -> Array:
        """Return the magnetic field of a dipole at the centre along −z: ``B = B₀ (R/r)³ (3 (m·r̂) r̂ − m)``.

        Parameters
        ----------
        time : array_like (...)
            Times, s.

        Returns
        -------
        ndarray (..., 3)
            Field, T, fixed frame.
        """
        return dipole_field(self.position(time))


def dipole_field(position_f: ArrayLike) -> Array:
    """Return the field (..., 3), T, of the axial dipole, whose south pole lies in the north, at positions (..., 3), m."""
    r = array("position_f", position_f, (..., 3))
    distance = np.linalg.norm(r, axis=-1, keepdims=True)
    up = r / distance
    moment = np.array([0.0, 0.0, -1.0])
    return np.asarray(DIPOLE_STRENGTH * (EARTH_RADIUS / distance) ** 3 * (3.0 * (up @ moment)[..., None] * up - moment))
