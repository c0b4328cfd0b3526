"""A circular low orbit: position, eclipses and magnetic field along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, InputError, array, finite, positive

__all__ = [
    "CircularOrbit",
]

EARTH_RADIUS = 6371.2e3
"""m, mean; the reference radius of the geomagnetic field."""
EARTH_GRAVITATION = 3.986004418e14
"""m³/s² (WGS 84)."""
DIPOLE_STRENGTH = 2.98e-5
"""T, at the magnetic equator (IGRF-13, epoch 2020)."""


@dataclass(frozen=True, kw_only=True)
class CircularOrbit:
    """A circular orbit in an inertial fixed frame, z to the north pole, its ascending node on the x axis.

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
        """Check every field."""
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

    def eclipses(self, sun_f: ArrayLike, start: float, end: float) -> tuple[tuple[float, float], ...]:
        """Return the windows in the earth's shadow, a cylinder away from the sun's direction.

        Parameters
        ----------
        sun_f : array_like (3,)
            Direction of the sun, fixed frame, of any length.
        start, end : float
            Interval [start, end], s.

        Returns
        -------
        tuple of (float, float)
            Windows (from, to), s.

        Raises
        ------
        InputError
            If ``sun_f`` is zero.
        """
        sun = array("sun_f", sun_f, (3,))
        if not np.linalg.norm(sun) > 0.0:
            raise InputError("sun_f is the zero vector, which has no direction")
        sun = sun / np.linalg.norm(sun)
        # ŝ·r̂ = A cos(θ − θ₀) over the orbit; shadow where it is below −√(1 − (R/r)²).
        first = sun[0]
        second = np.cos(self.inclination) * sun[1] + np.sin(self.inclination) * sun[2]
        amplitude = float(np.hypot(first, second))
        limit = float(np.sqrt(1.0 - (EARTH_RADIUS / self.radius) ** 2))
        if amplitude <= limit:
            return ()
        middle = float(np.arctan2(second, first)) + np.pi
        half = float(np.arccos(limit / amplitude))
        lowest = np.floor((self.phase + self.rate * start - middle - half) / (2.0 * np.pi))
        highest = np.ceil((self.phase + self.rate * end - middle + half) / (2.0 * np.pi))
        windows = []
        for turn in np.arange(lowest, highest + 1.0):
            centre = middle + 2.0 * np.pi * turn - self.phase
            a, b = (max(start, (centre - half) / self.rate), min(end, (centre + half) / self.rate))
            if a < b:
                windows.append((float(a), float(b)))
        return tuple(windows)


def dipole_field(position_f: ArrayLike) -> Array:
    """Return the magnetic field of the axial dipole, whose south magnetic pole lies in the north.

    Parameters
    ----------
    position_f : array_like (..., 3)
        Positions from the centre of the earth, m, z to the north pole.

    Returns
    -------
    ndarray (..., 3)
        Field, T, fixed frame.

    Examples
    --------
    >>> dipole_field([EARTH_RADIUS, 0.0, 0.0]).tolist()  # north at the equator
    [0.0, 0.0, 2.98e-05]
    """
    r = array("position_f", position_f, (..., 3))
    distance = np.linalg.norm(r, axis=-1, keepdims=True)
    up = r / distance
    moment = np.array([0.0, 0.0, -1.0])
    return np.asarray(DIPOLE_STRENGTH * (EARTH_RADIUS / distance) ** 3 * (3.0 * (up @ moment)[..., None] * up - moment))
