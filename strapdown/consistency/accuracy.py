"""Errors of an estimate: against a reference, convergence time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, increasing, positive


def convergence_time(time: ArrayLike, magnitude: ArrayLike, threshold: float) -> float:
    """Return the time, s, from which on ``magnitude`` (n,) stays at or below ``threshold`` to the end; NaN if it never does."""
    stamps = increasing("time", time)
    size = array("magnitude", magnitude, (len(stamps),))
    above = np.flatnonzero(np.abs(size) > positive("threshold", threshold))
    first = int(above[-1]) + 1 if len(above) else 0
    return float(stamps[first]) if first < len(stamps) else math.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceErrors:
    """Errors of an estimated attitude against a reference, as defined by the BROAD benchmark, rad; NaN where there is no reference."""

    total: Array
    """Angle of the rotation between estimate and reference (n,)."""
    heading: Array
    """Angle of its part about the vertical (n,)."""
    inclination: Array
    """Angle of the remaining rotation, between the two verticals (n,)."""

    def rms(self, movement: np.ndarray | None = None) -> dict[str, float]:
        """Return the RMS of each error, rad, over the samples with a reference; if given, only those of the ``movement`` mask."""
        judged = np.isfinite(self.total) if movement is None else np.isfinite(self.total) & movement
        if not judged.any():
            raise InputError(
                "no sample to judge has a valid reference attitude; check the movement mask and the reference"
            )
        return {
            name: float(np.sqrt(np.mean(getattr(self, name)[judged] ** 2)))
            for name in ("total", "heading", "inclination")
        }


def reference_errors(attitude: ArrayLike, reference: ArrayLike) -> ReferenceErrors:
    """Return the attitude errors against a reference whose fixed frame has its z axis vertical.

    With ``d = q_est ⊗ q_ref⁻¹`` in the fixed frame: total 2 acos |d_w|, heading 2 atan |d_z / d_w|, inclination 2 acos √(d_w² + d_z²), in
    forms that are accurate for small errors.

    Parameters
    ----------
    attitude : array_like (n, 4)
        Estimated q_fb.
    reference : array_like (n, 4)
        Reference q_fb; rows of NaN are unknown.

    Returns
    -------
    ReferenceErrors
        Angles, rad; NaN where the reference is unknown.

    References
    ----------
    D. Laidig, M. Caruso, A. Cereatti, T. Seel, BROAD — A benchmark for robust inertial orientation estimation, Data 6(7):72, 2021, section
    4.1.
    """
    q = array("attitude", attitude, ("n", 4))
    r = array("reference", reference, (len(q), 4), allow_nan=True)
    known = np.isfinite(r).all(axis=1)
    zero = known & (np.linalg.norm(r, axis=1) == 0.0)
    if zero.any():
        raise InputError(f"reference[{int(np.argmax(zero))}] is the zero quaternion; mark missing rows as NaN")
    d = quaternion.multiply(q[known], quaternion.conjugate(quaternion.normalize(r[known])))
    w, x, y, z = np.moveaxis(d, -1, 0)
    results = np.full((3, len(q)), np.nan)
    results[0, known] = 2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w))
    results[1, known] = 2.0 * np.arctan2(np.abs(z), np.abs(w))
    results[2, known] = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z))
    return ReferenceErrors(total=results[0], heading=results[1], inclination=results[2])
