"""The right-invariant filter with an additive bias ("imperfect": Barrau & Bonnabel 2017): the fixed-side filter without its reset.

The rows of a constant reference do not depend on the estimate, so its unobservable direction stays unobservable.
"""

from __future__ import annotations

from strapdown.kernels.algebra import add
from strapdown.kernels.filters.extended import turned_in_fixed_axes
from strapdown.kernels.filters.fixed_side import error_rows, from_body_side, propagated, to_body_side

__all__ = ["closed", "error_rows", "from_body_side", "propagated", "to_body_side"]


def closed(q, b, A, B, C, correction, bias_correction):
    """Correct the state by (δφ, δb), without a change of the covariance, as in invariant filters."""
    return turned_in_fixed_axes(q, correction), add(b, bias_correction), A, B, C
