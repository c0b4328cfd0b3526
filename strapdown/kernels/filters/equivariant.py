"""The equivariant filter for attitude and gyro bias (van Goor, Hamel & Mahony 2022; Fornasier, Ng, Mahony & Weiss 2022, Overcoming bias).

On the symmetry group SO(3) ⋉ so(3), which acts on attitude and bias by ``φ((A, a), (R, b)) = (R A, Aᵀ (b − a))``, the error of the estimate
is ``e = (R_true R_estᵀ, R_est (b_true − b_est))``: that of :mod:`strapdown.kernels.filters.two_frame`, whose linearised dynamics depend on
the estimated rate in fixed axes only, not on the true state. Equivariance adds a better output approximation: the row of a direction is
linearised at the mean of the reference r and the measured direction R_est z, so its error is of third order in the attitude error, while
that of the other filters is of second order.
"""

from __future__ import annotations

from strapdown.kernels.algebra import cross, matrix_times_vector
from strapdown.kernels.filters.extended import rows_in_fixed_axes
from strapdown.kernels.filters.two_frame import closed, from_body_side, propagated, to_body_side
from strapdown.kernels.measurement import DIRECTION, VECTOR

__all__ = ["closed", "error_rows", "from_body_side", "propagated", "to_body_side"]


def error_rows(kind, q, R, z, frame, noise):
    """Return a measurement's rows in fixed axes, for directions and vectors the equivariant ones.

    With m = R_est z: ``m − r = −δφ × ½ (m + r) (1 + O(θ²))``, by Cayley's formula. The rows of its components along u and v are
    ``u × ½ (m + r)`` and ``v × ½ (m + r)``.
    """
    h1, h2, h3, y1, y2, y3, noise = rows_in_fixed_axes(kind, q, R, z, frame, noise)
    if kind in (DIRECTION, VECTOR):
        m = matrix_times_vector(R, z)
        middle = (0.5 * (m[0] + frame[6]), 0.5 * (m[1] + frame[7]), 0.5 * (m[2] + frame[8]))
        h1 = cross((frame[0], frame[1], frame[2]), middle)
        h2 = cross((frame[3], frame[4], frame[5]), middle)
    return h1, h2, h3, y1, y2, y3, noise
