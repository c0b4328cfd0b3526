"""Magnetometer in a known field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from strapdown.checks import Array, InputError, array, one_of
from strapdown.vectors.measurements import Kind
from strapdown.vectors.sensor import Sampled, in_body, unit_vector


@dataclass(frozen=True, kw_only=True, eq=False)
class Magnetometer(Sampled):
    """A magnetometer in a known field: ``m_b = (I + S) R_fbᵀ B_f + h + v``, S soft iron, h hard iron (the residual of the calibration).

    Parameters
    ----------
    name, rate, phase, faults : str, float, float, Faults
        As for :class:`VectorSensor`.
    field_f : ndarray (3,) or callable
        Magnetic field, T, fixed frame; in Python also a function of time (m,), s, that returns it (m, 3), in a file instead a table
        ``orbit``.
    sigma : float
        Noise of each component, T.
    hard_iron : ndarray (3,), default zeros
        Hard iron h: field of magnetised parts that move with the body, T, body axes.
    soft_iron : ndarray (3, 3), default zeros
        Soft iron S: effect of parts magnetised by the external field, dimensionless.
    kind : {"direction", "heading", "vector"}, default "direction"
        ``"direction"``, ``"heading"`` (about the fixed z axis) or ``"vector"`` (the whole field, T).
    """

    field_f: Array | Callable[[Array], Array]
    sigma: float
    hard_iron: Array = field(default_factory=lambda: np.zeros(3))
    soft_iron: Array = field(default_factory=lambda: np.zeros((3, 3)))
    kind: Kind = "direction"

    def __post_init__(self) -> None:
        self._check_sampling("T", sigma=self.sigma)
        one_of(f"{self.name}: kind", self.kind, ("direction", "heading", "vector"))
        if not callable(self.field_f):
            object.__setattr__(self, "field_f", array(f"{self.name}: field_f", self.field_f, (3,)))
            effective = self.field_f[:2] if self.kind == "heading" else self.field_f
            if not np.any(effective):
                part = "horizontal part of field_f" if self.kind == "heading" else "field_f"
                raise InputError(
                    f"{self.name}: {part} is zero, which has no direction; give the field at the location of the body"
                )
        object.__setattr__(self, "hard_iron", array(f"{self.name}: hard_iron", self.hard_iron, (3,)))
        object.__setattr__(self, "soft_iron", array(f"{self.name}: soft_iron", self.soft_iron, (3, 3)))

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        true_f = self.field_f
        if callable(true_f):
            true_f = array(f"{self.name}: field_f", true_f(time), (len(time), 3))
        exact = in_body(motion, time, true_f) @ (np.eye(3) + self.soft_iron).T + self.hard_iron
        measured = exact + self.sigma * white + correlated
        strength = np.broadcast_to(np.linalg.norm(true_f, axis=-1), time.shape)
        level = np.broadcast_to(np.hypot(true_f[..., 0], true_f[..., 1]), time.shape)
        scale = {"vector": np.ones(len(time)), "direction": strength, "heading": level}[self.kind]
        return {
            "kind": self.kind,
            "vector_b": measured if self.kind == "vector" else unit_vector(measured),
            "reference_f": true_f,
            "sigma": self.sigma / scale,
        }
