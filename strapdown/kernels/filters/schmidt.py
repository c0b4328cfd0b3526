"""The MEKF that considers the gyro bias and does not estimate it (Schmidt 1966; Woodbury & Junkins 2010).

For a bias that is not to be estimated on line (a calibration, or an estimate from the ground): its uncertainty enters the covariance of the
attitude, and the bias is constant. The gain of the bias is zero; that of the attitude is optimal under this condition.
"""

from __future__ import annotations

from strapdown.kernels.filters.body_side import closed, error_rows, from_body_side, propagated, to_body_side
from strapdown.kernels.filters.extended import joseph_row

__all__ = ["closed", "error_rows", "from_body_side", "propagated", "row_update", "to_body_side"]


def row_update(a, c, A, B, C, h, y, variance):
    """Update the attitude with one scalar row: with ``K = (k_a, 0)``, A and B are updated as usual; C and the bias are unchanged."""
    a, _, A, B, _, innovation, s = joseph_row(a, c, A, B, C, h, y, variance)
    return a, c, A, B, C, innovation, s
