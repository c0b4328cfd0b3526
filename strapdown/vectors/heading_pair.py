"""Two GNSS antennas that measure a heading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, array
from strapdown.vectors.measurements import direction
from strapdown.vectors.sensor import Sampled, attitude_of, unit_vector


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadingPair(Sampled):
    """Two GNSS antennas on the body: the heading of the line between them.

    The line is known in the body and measured in the fixed frame, so ``vector_b`` is exact and ``reference_f`` (m, 3) has the noise.

    Parameters
    ----------
    name, rate, phase, faults : str, float, float, Faults
        As for :class:`VectorSensor`.
    baseline_b : ndarray (3,)
        Vector from the first antenna to the second, m, body axes.
    sigma : float
        Noise of each component of the relative position, m; that of the heading is this divided by the baseline's horizontal length.
    """

    baseline_b: Array
    sigma: float

    def __post_init__(self) -> None:
        self._check_sampling("m", sigma=self.sigma)
        object.__setattr__(self, "baseline_b", array(f"{self.name}: baseline_b", self.baseline_b, (3,)))
        direction(f"{self.name}: baseline_b", self.baseline_b)

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        line_f = quaternion.rotate(attitude_of(motion, time), self.baseline_b).reshape(-1, 3)
        level = np.hypot(line_f[:, 0], line_f[:, 1])
        measured = (line_f + self.sigma * white + correlated) * np.array([1.0, 1.0, 0.0])
        return {
            "kind": "heading",
            "vector_b": np.tile(unit_vector(self.baseline_b), (len(time), 1)),
            "reference_f": measured,
            "sigma": self.sigma / level,
        }
