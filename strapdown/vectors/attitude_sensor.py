"""Star tracker that measures the whole attitude."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, one_of
from strapdown.vectors.measurements import direction
from strapdown.vectors.sensor import Sampled, attitude_of


def _boresight(name: str, value: Any) -> str | tuple[float, ...]:
    """Return a boresight as "x", "y" or "z" if it is along that axis, in either direction, otherwise as a unit vector."""
    if isinstance(value, str):
        return one_of(name, value.removeprefix("-"), ("x", "y", "z"))
    b = direction(name, value)
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
        Noise about the boresight, rad. A linear filter is optimistic, and its covariance analysis does not show it, if half the product of
        ``sigma_about`` and the predicted σ across the boresight is not small compared with ``sigma_across``.
    boresight : {"x", "y", "z"} or array_like (3,), default "z"
        Boresight: a body axis, or a direction in body axes. Stored as an axis or a unit vector.
    """

    sigma_across: float
    sigma_about: float
    boresight: str | tuple[float, ...] = "z"

    def __post_init__(self) -> None:
        self._check_sampling("rad", sigma_across=self.sigma_across, sigma_about=self.sigma_about)
        object.__setattr__(self, "boresight", _boresight(f"{self.name}: boresight", self.boresight))

    @property
    def covariance(self) -> Array | None:
        """Covariance of the noise in body axes (3, 3), rad²; None if the boresight is a body axis."""
        if isinstance(self.boresight, str):
            return None
        b = np.asarray(self.boresight)
        along = np.outer(b, b)
        return np.asarray(self.sigma_across**2 * (np.eye(3) - along) + self.sigma_about**2 * along)

    @property
    def sigma_axes(self) -> Array:
        """Noise about each body axis (3,), rad."""
        if isinstance(self.boresight, str):
            return np.where(np.arange(3) == "xyz".index(self.boresight), self.sigma_about, self.sigma_across)
        return np.sqrt(np.diagonal(self.covariance))  # type: ignore[arg-type]

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        covariance, noise = self.covariance, self.sigma_axes * white
        if covariance is not None:
            b = np.asarray(self.boresight)
            noise = self.sigma_across * white + (self.sigma_about - self.sigma_across) * (white @ b)[:, None] * b
        return {
            "kind": "attitude",
            "attitude": quaternion.multiply(attitude_of(motion, time), quaternion.exp(noise + correlated)).reshape(
                -1, 4
            ),
            "sigma_axes": self.sigma_axes if covariance is None else None,
            "covariance": covariance,
        }
