"""The error of the MEKF, body side: ``q_true = q ⊗ exp(δθ)``, ``δb = b_true − b``: the default of the other filters."""

from __future__ import annotations

from strapdown.kernels.algebra import add, congruent, multiply
from strapdown.kernels.filter_step import predict as propagated
from strapdown.kernels.filters.extended import joseph_row as row_update
from strapdown.kernels.measurement import measurement_rows as error_rows
from strapdown.kernels.rotation import moved, unit

__all__ = ["closed", "error_rows", "from_body_side", "propagated", "row_update", "to_body_side"]


def from_body_side(q, A, B, C):
    """Return the blocks unchanged."""
    return A, B, C


to_body_side = from_body_side


def closed(q, b, A, B, C, correction, bias_correction):
    """Correct the state, and transform the covariance to the new tangent space by J_r."""
    q, G = moved(q, correction)
    return unit(q), add(b, bias_correction), congruent(G, A), multiply(G, B), C
