"""Earth-horizon sensor on an orbit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from strapdown.checks import Array, instance
from strapdown.results import ByValue
from strapdown.vectors.sensor import Faults, Sampled, check_sampling, in_body, unit_vector

if TYPE_CHECKING:
    from strapdown.motion.orbit import CircularOrbit


@dataclass(frozen=True, kw_only=True, eq=False)
class HorizonSensor(Sampled, ByValue):
    """An earth-horizon sensor on an orbit: the direction of the earth's centre, which moves in the fixed frame.

    Parameters
    ----------
    name : str
        As for :class:`VectorSensor`.
    orbit : CircularOrbit
        Orbit of the body, in the fixed frame.
    sigma : float
        Noise of each component of the unit direction, rad.
    rate, phase, faults : float, float, Faults
        As for :class:`VectorSensor`.
    """

    name: str
    orbit: CircularOrbit
    sigma: float
    rate: float
    phase: float = 0.0
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        """Check every field."""
        from strapdown.motion.orbit import CircularOrbit  # imports all motions, which recordings do not need

        check_sampling(self.name, self.sigma, "rad", self.rate, self.phase)
        instance(f"{self.name}: orbit", self.orbit, CircularOrbit, "give an orbit.CircularOrbit")

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        down_f = -unit_vector(self.orbit.position(time).reshape(-1, 3))
        return {
            "kind": "direction",
            "vector_b": unit_vector(in_body(motion, time, down_f) + self.sigma * white + correlated),
            "reference_f": down_f,
            "sigma": np.full(len(time), self.sigma),
        }
