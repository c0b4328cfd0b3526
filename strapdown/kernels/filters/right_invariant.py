"""The right-invariant filter with an additive bias ("imperfect": Barrau & Bonnabel 2017): the fixed-side filter without its reset.

The rows of a constant reference do not depend on the estimate, so what they do not show stays unobserved for ever.
"""

from __future__ import annotations

from strapdown.kernels.algebra import add
from strapdown.kernels.filters.extended import turned_in_fixed_axes
from strapdown.kernels.filters.fixed_side import error_rows, from_body_side, propagated, to_body_side

__all__ = ["closed", "error_rows", "from_body_side", "propagated", "to_body_side"]


def closed(q, b, A, B, C, correction, bias_correction):
    """Move the state by a correction of (δφ, δb) and leave the covariance, as invariant filters do."""
    return turned_in_fixed_axes(q, correction), add(b, bias_correction), A, B, C
