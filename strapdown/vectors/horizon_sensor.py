"""Earth-horizon sensor on an orbit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from strapdown.checks import Array, instance
from strapdown.vectors.sensor import Sampled, in_body, unit_vector

if TYPE_CHECKING:
    from strapdown.motion.orbit import CircularOrbit


@dataclass(frozen=True, kw_only=True, eq=False)
class HorizonSensor(Sampled):
    """An earth-horizon sensor on an orbit: the direction of the earth's centre, which moves in the fixed frame.

    Parameters
    ----------
    name, rate, phase, faults : str, float, float, Faults
        As for :class:`VectorSensor`.
    orbit : CircularOrbit
        Orbit of the body, in the fixed frame.
    sigma : float
        Noise of each component of the unit direction, rad.
    """

    orbit: CircularOrbit
    sigma: float

    def __post_init__(self) -> None:
        from strapdown.motion.orbit import CircularOrbit  # imports all motions, which recordings do not need

        self._check_sampling("rad", sigma=self.sigma)
        instance(f"{self.name}: orbit", self.orbit, CircularOrbit, "give an orbit.CircularOrbit")

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        down_f = -unit_vector(self.orbit.position(time).reshape(-1, 3))
        return {
            "kind": "direction",
            "vector_b": unit_vector(in_body(motion, time, down_f) + self.sigma * white + correlated),
            "reference_f": down_f,
            "sigma": np.full(len(time), self.sigma),
        }
