"""Sensor of one known direction.

Noise of a normalised vector
----------------------------
A direction is a noisy vector divided by its length. With noise σ per component, relative to the length, the variance across the
direction is σ²(1 − σ² − σ⁴ − …), exactly ``σ² [1 − √2 σ D(1/(√2 σ))]`` with Dawson's function D, and the mean of the measured
component along the direction is about 1 − σ². Filters assume σ² and 1. The NIS of a correct filter is therefore too small by a fraction
of about σ²: 0.25 % at σ = 0.05 rad, 1 % at 0.1 rad, 4.2 % at 0.2 rad, 10 % at 0.3 rad. If that matters (``σ`` above 0.1 rad), give the
whole vector (kind ``"vector"``), whose noise is the same in all components.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from strapdown.checks import Array, one_of
from strapdown.vectors.measurements import Kind, direction
from strapdown.vectors.sensor import Sampled, in_body, unit_vector


@dataclass(frozen=True, kw_only=True, eq=False)
class VectorSensor(Sampled):
    """A sensor of one known direction: a star, the sun, a beacon.

    Parameters
    ----------
    name : str
        Name of the sensor and of its stream of random numbers.
    rate : float
        Measurements per second, Hz.
    phase : float, default 0.0
        Time of the first measurement after the start, s; 0: one interval after it.
    faults : Faults, default no faults
        Errors beyond the white noise.
    reference_f : ndarray (3,)
        Direction measured, fixed frame; it is normalised.
    sigma : float
        Noise of each component of the unit direction before it is normalised, rad; above 0.1 rad the NIS of a correct filter is too small,
        by a fraction of about σ².
    kind : {"direction", "heading"}, default "direction"
        ``"direction"``, or ``"heading"`` (only the rotation about the fixed z axis).

    Examples
    --------
    >>> star = VectorSensor(name="star 1", reference_f=[3.0, 0.0, 4.0], sigma=20.0 * np.pi / 648000.0, rate=1.0)
    >>> print(star.reference_f)
    [0.6 0.  0.8]
    """

    reference_f: Array
    sigma: float
    kind: Kind = "direction"

    def __post_init__(self) -> None:
        object.__setattr__(self, "reference_f", direction(f"{self.name}: reference_f", self.reference_f))
        self._check_sampling("rad", sigma=self.sigma)
        one_of(f"{self.name}: kind", self.kind, ("direction", "heading"))

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        noisy = in_body(motion, time, self.reference_f) + self.sigma * white + correlated
        # The noise of a heading is that across the direction divided by its horizontal part.
        level = float(np.hypot(self.reference_f[0], self.reference_f[1])) if self.kind == "heading" else 1.0
        return {
            "kind": self.kind,
            "vector_b": unit_vector(noisy),
            "reference_f": self.reference_f,
            "sigma": np.full(len(time), self.sigma / level),
        }
