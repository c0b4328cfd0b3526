"""Accelerometer as a sensor of the vertical, and the specific force that it measures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, array, one_of
from strapdown.units import STANDARD_GRAVITY
from strapdown.vectors.measurements import Kind, direction
from strapdown.vectors.sensor import Sampled, in_body, unit_vector

if TYPE_CHECKING:
    from strapdown.motion import Motion

GRAVITY_F = (0.0, 0.0, -STANDARD_GRAVITY)
"""Acceleration of gravity if the fixed z axis points up, m/s²."""


def specific_force(
    motion: Motion,
    time: ArrayLike,
    *,
    lever_arm_b: ArrayLike = (0.0, 0.0, 0.0),
    acceleration_f: Callable[[Array], Array] | None = None,
    gravity_f: ArrayLike = GRAVITY_F,
) -> Array:
    """Return the specific force at a point of the body: the output of an ideal accelerometer there.

    Parameters
    ----------
    motion : Motion
        Motion of the body.
    time : array_like (...)
        Times, s.
    lever_arm_b : array_like (3,), default zeros
        Position r of the point, m, body axes, from the point that moves with ``acceleration_f``.
    acceleration_f : callable, optional
        Acceleration a_f, m/s², fixed frame: a function of time (m,), s, that returns (m, 3). Default: zero.
    gravity_f : array_like (3,), default (0, 0, −9.80665)
        Acceleration of gravity g_f, m/s², fixed frame.

    Returns
    -------
    ndarray (..., 3)
        ``f_b = R_fbᵀ (a_f − g_f) + ẇ_b × r + w_b × (w_b × r)``, m/s², body axes.

    Examples
    --------
    >>> from strapdown.motion import rest
    >>> specific_force(rest(), 0.0).tolist()
    [0.0, 0.0, 9.80665]
    """
    t = np.asarray(time, np.float64)
    arm = array("lever_arm_b", lever_arm_b, (3,))
    rate = motion.body_rate(t)
    pull = np.broadcast_to(-array("gravity_f", gravity_f, (3,)), (*t.shape, 3))
    if acceleration_f is not None:
        pull = pull + acceleration_f(t)
    turning = np.cross(motion.body_angular_acceleration(t), arm) + np.cross(rate, np.cross(rate, arm))
    return np.asarray(in_body(motion, t, pull) + turning)


@dataclass(frozen=True, kw_only=True, eq=False)
class Accelerometer(Sampled):
    """An accelerometer used as a sensor of the vertical: correct at rest, otherwise in error by the acceleration of the body.

    Parameters
    ----------
    name, rate, phase, faults : str, float, float, Faults
        As for :class:`VectorSensor`.
    sigma : float
        Noise of each component, m/s².
    lever_arm_b : ndarray (3,), default zeros
        Position on the body, m, from the point that moves with ``acceleration_f``.
    bias : ndarray (3,), default zeros
        Bias, m/s², body axes.
    acceleration_f : callable, optional
        Acceleration of that point, m/s², fixed frame: a function of time (m,), s, that returns (m, 3); None: zero.
    gravity_f : ndarray (3,), default (0, 0, −9.80665)
        Acceleration of gravity, m/s², fixed frame.
    kind : {"direction", "vector"}, default "direction"
        ``"direction"`` (of the vertical) or ``"vector"`` (the specific force, m/s²).
    """

    sigma: float
    lever_arm_b: Array = field(default_factory=lambda: np.zeros(3))
    bias: Array = field(default_factory=lambda: np.zeros(3))
    acceleration_f: Callable[[Array], Array] | None = None
    gravity_f: Array = field(default_factory=lambda: np.array(GRAVITY_F))
    kind: Kind = "direction"

    def __post_init__(self) -> None:
        self._check_sampling("m/s²", sigma=self.sigma)
        one_of(f"{self.name}: kind", self.kind, ("direction", "vector"))
        for name in ("lever_arm_b", "bias", "gravity_f"):
            object.__setattr__(self, name, array(f"{self.name}: {name}", getattr(self, name), (3,)))
        direction(f"{self.name}: gravity_f", self.gravity_f)

    def _measured(self, motion: Motion, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        exact = specific_force(
            motion, time, lever_arm_b=self.lever_arm_b, acceleration_f=self.acceleration_f, gravity_f=self.gravity_f
        )
        measured = exact + self.bias + self.sigma * white + correlated
        whole = self.kind == "vector"
        return {
            "kind": self.kind,
            "vector_b": measured if whole else unit_vector(measured),
            "reference_f": -self.gravity_f,
            "sigma": np.full(len(time), self.sigma / (1.0 if whole else float(np.linalg.norm(self.gravity_f)))),
        }
