"""Star tracker that measures the whole attitude."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, InputError, non_negative, numbers, one_of, unit_quaternions
from strapdown.vectors.measurements import direction
from strapdown.vectors.sensor import Sampled, attitude_of

Boresight = str | tuple[float, ...] | tuple[tuple[float, ...], ...]


def _boresight(name: str, value: Any) -> str | tuple[float, ...]:
    """Return a boresight as "x", "y" or "z" if it is along that axis, in either direction, otherwise as a unit vector."""
    if isinstance(value, str):
        return one_of(name, value.removeprefix("-"), ("x", "y", "z"))
    components = np.asarray(numbers(name, value))
    if components.shape == (4,):
        (q,) = unit_quaternions(name, components[None])
        b = quaternion.rotate(q, np.array([0.0, 0.0, 1.0]))
    elif components.shape == (3, 3):
        if not np.allclose(components @ components.T, np.eye(3), atol=1e-6) or np.linalg.det(components) < 0.0:
            raise InputError(f"{name} is no rotation matrix: its rows must be orthogonal unit vectors, right-handed")
        b = components[:, 2]
    elif components.shape == (3,):
        b = components
    else:
        raise InputError(
            f"{name} has shape {components.shape}; give x, y or z, a direction (3,), or the mounting as a quaternion (4,) or matrix (3, 3)"
        )
    b = direction(name, b)
    k = int(np.argmax(np.abs(b)))
    return "xyz"[k] if abs(b[k]) > 1.0 - 1e-12 else tuple(b.tolist())


@dataclass(frozen=True, kw_only=True, eq=False)
class AttitudeSensor(Sampled):
    """A star tracker that measures the attitude as a quaternion; less precise about its boresight than across it.

    Parameters
    ----------
    name, rate, phase, faults : str, float, float, Faults
        As for :class:`VectorSensor`.
    sigma_across : float
        Noise about the two axes across the boresight, rad.
    sigma_about : float
        Noise about the boresight, rad.
    boresight : {"x", "y", "z"} or array_like (3,), (4,) or (3, 3), default "z"
        Boresight: a body axis, a direction in body axes (3,), or the mounting, sensor to body, as a quaternion (4,), scalar first,
        or a rotation matrix (3, 3), whose z axis is the boresight. Stored as an axis or a unit vector.
    """

    sigma_across: float
    sigma_about: float
    boresight: Boresight = "z"

    def __post_init__(self) -> None:
        """Check every field."""
        self._check_sampling(self.sigma_across, "rad")
        non_negative(f"{self.name}: sigma_about", self.sigma_about, unit="rad")
        object.__setattr__(self, "boresight", _boresight(f"{self.name}: boresight", self.boresight))

    @property
    def covariance(self) -> Array | None:
        """Covariance of the noise in body axes (3, 3), rad²; None if the boresight is a body axis."""
        if isinstance(self.boresight, str):
            return None
        b = np.asarray(self.boresight)
        return np.asarray(
            self.sigma_across**2 * (np.eye(3) - np.outer(b, b)) + self.sigma_about**2 * np.outer(b, b), np.float64
        )

    @property
    def sigma_axes(self) -> Array:
        """Noise about each body axis (3,), rad."""
        if isinstance(self.boresight, str):
            return np.where(np.arange(3) == "xyz".index(self.boresight), self.sigma_about, self.sigma_across)
        assert self.covariance is not None
        return np.sqrt(np.diag(self.covariance))

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        noise = self.sigma_axes * white
        if not isinstance(self.boresight, str):
            b = np.asarray(self.boresight)
            noise = self.sigma_across * white + (self.sigma_about - self.sigma_across) * (white @ b)[:, None] * b
        error = quaternion.exp(noise + correlated)
        whole = self.covariance
        return {
            "kind": "attitude",
            "attitude": quaternion.multiply(attitude_of(motion, time), error).reshape(-1, 4),
            "sigma_axes": self.sigma_axes if whole is None else None,
            "covariance": whole,
        }
