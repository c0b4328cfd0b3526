"""The MEKF that considers the gyro bias and does not estimate it (Schmidt 1966; Woodbury & Junkins 2010).

For a bias that nothing corrects (an estimate from the ground, a calibration): its uncertainty is in the covariance of the attitude, where
it belongs, and the bias stays what it was. The gain of the bias is zero; that of the attitude is the best one under that condition.
"""

from __future__ import annotations

from strapdown.kernels.filters.body_side import closed, error_rows, from_body_side, propagated, to_body_side
from strapdown.kernels.filters.extended import joseph_row

__all__ = ["closed", "error_rows", "from_body_side", "propagated", "row_update", "to_body_side"]


def row_update(a, c, A, B, C, h, y, variance):
    """Update the attitude with one scalar row: with ``K = (k_a, 0)`` the blocks A and B are as ever, and C and the bias stay."""
    a, _, A, B, _, innovation, s = joseph_row(a, c, A, B, C, h, y, variance)
    return a, c, A, B, C, innovation, s
