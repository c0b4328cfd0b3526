"""The geometric filter of Andrle & Crassidis (2015): the bias error in one common frame, ``η = b_true − exp(−[δθ]) b``, body side.

The covariance is that of (δθ, δb), with a shear for each change of b in η.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    add_matrices,
    combine,
    cross,
    dot,
    full,
    multiply,
    scale,
    skew_polynomial,
    times_transpose_upper_add,
    transpose,
)
from strapdown.kernels.filters.body_side import error_rows, from_body_side, propagated, row_update, to_body_side
from strapdown.kernels.rotation import moved, sine_and_versine, unit

__all__ = ["closed", "error_rows", "from_body_side", "propagated", "row_update", "to_body_side"]

LARGEST_CORRECTION = 1.8954942670339809
"""Maximum correction, rad: the root of θ = 2 sin θ. A correction a changes the bias b to ``exp(−[a]) b − b × a``; for components across a
this is a multiplication by ``e^{−iθ} + iθ``, of magnitude ``√(1 + θ² − 2 θ sin θ)``, above one for larger angles. Each correction would
then increase the bias and, by the shear, its variance and the next correction, without limit."""


def closed(q, b, A, B, C, correction, bias_correction):
    """Correct the state by (δθ, δb) and transform the covariance, as in a filter of (δθ, η), η = δb − [b] δθ.

    The correction of (δθ, η) is (a, c − [b] a); it changes the bias to ``b⁺ = exp(−[a]) b + c − b × a`` and leaves the covariance unchanged
    (Andrle & Crassidis 2015). In (δθ, δb) this is one shear by [b⁺ − b]: a transformation to η and back would lose the digits of a bias
    variance much smaller than b² times that of the attitude. A correction above ``LARGEST_CORRECTION`` is scaled down to it.
    """
    squared = dot(correction, correction)
    if squared > LARGEST_CORRECTION * LARGEST_CORRECTION:
        shorter = LARGEST_CORRECTION / math.sqrt(squared)
        correction, bias_correction = scale(shorter, correction), scale(shorter, bias_correction)
    s, c = sine_and_versine(dot(correction, correction))
    turn = cross(correction, b)
    step = add(bias_correction, combine(1.0 - s, turn, c, cross(correction, turn)))
    B, C = sheared(A, B, C, skew_polynomial(0.0, 1.0, 0.0, step))
    return unit(moved(q, correction)[0]), add(b, step), A, B, C


def sheared(A, B, C, X):
    """Return the covariance blocks of (x, y + X x) from those of (x, y)."""
    AX = multiply(full(A), transpose(X))
    S = times_transpose_upper_add(X, transpose(AX), C)
    XB = multiply(X, B)
    return (
        add_matrices(B, AX),
        (
            S[0] + 2.0 * XB[0],
            S[1] + (XB[1] + XB[3]),
            S[2] + (XB[2] + XB[6]),
            S[3] + 2.0 * XB[4],
            S[4] + (XB[5] + XB[7]),
            S[5] + 2.0 * XB[8],
        ),
    )
