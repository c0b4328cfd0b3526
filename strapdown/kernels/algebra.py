"""Vectors, 3×3 matrices and symmetric matrices as tuples of scalars.

A 3-vector is a 3-tuple, a 3×3 matrix a 9-tuple by rows, a symmetric one the 6-tuple of its upper triangle (00, 01, 02, 11, 12, 22).
The scalars may be Python floats, numba scalars, SIMD lanes (:mod:`strapdown.kernels.lanes`), or NumPy arrays.
"""

from __future__ import annotations

import math


def square_root(x):
    """Return √x (the lanes overload this one function)."""
    return math.sqrt(x)


def dot(a, b):
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    """Return a × b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def add(a, b):
    """Return a + b of two 3-vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def subtract(a, b):
    """Return a − b of two 3-vectors."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(s, a):
    """Return s a of a scalar and a 3-vector."""
    return (s * a[0], s * a[1], s * a[2])


def combine(s, a, t, b):
    """Return s a + t b of scalars and 3-vectors."""
    return (s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2])


def matrix_times_vector(A, v):
    """Return A v."""
    return tuple(A[i] * v[0] + A[i + 1] * v[1] + A[i + 2] * v[2] for i in (0, 3, 6))


def transpose_times_vector(A, v):
    """Return Aᵀ v."""
    return (
        A[0] * v[0] + A[3] * v[1] + A[6] * v[2],
        A[1] * v[0] + A[4] * v[1] + A[7] * v[2],
        A[2] * v[0] + A[5] * v[1] + A[8] * v[2],
    )


def symmetric_times_vector(S, v):
    """Return S v of a symmetric matrix."""
    return matrix_times_vector(full(S), v)


def multiply(A, B):
    """Return A B."""
    return tuple(A[i] * B[j] + A[i + 1] * B[j + 3] + A[i + 2] * B[j + 6] for i in (0, 3, 6) for j in range(3))


def multiply_add(A, B, S):
    """Return A B + S, summed so that every product fuses with an addition."""
    return tuple(
        A[i] * B[j] + (A[i + 1] * B[j + 3] + (A[i + 2] * B[j + 6] + S[i + j])) for i in (0, 3, 6) for j in range(3)
    )


def transpose(A):
    """Return Aᵀ."""
    return (A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8])


def symmetric_index(i, j):
    """Return the index of element (i, j) of a symmetric matrix in its 6-tuple."""
    return (0, 1, 2, 1, 3, 4, 2, 4, 5)[3 * i + j]


def full(S):
    """Return a symmetric matrix as a 9-tuple."""
    return (S[0], S[1], S[2], S[1], S[3], S[4], S[2], S[4], S[5])


def scale_matrix(s, A):
    """Return s A of a scalar and a 9-tuple."""
    return tuple(s * a for a in A)


def add_matrices(A, B):
    """Return A + B of two tuples of any length."""
    return tuple(a + b for a, b in zip(A, B, strict=True))


def combine_matrices(s, A, t, B):
    """Return s A + t B of scalars and matrices, both whole or both symmetric."""
    return tuple(s * a + t * b for a, b in zip(A, B, strict=True))


def add_to_diagonal(S, d):
    """Return S + d I of a symmetric matrix."""
    return (S[0] + d, S[1], S[2], S[3] + d, S[4], S[5] + d)


def times_transpose_upper(A, B):
    """Return the upper triangle of A Bᵀ, known to be symmetric."""
    return tuple(A[i] * B[j] + A[i + 1] * B[j + 1] + A[i + 2] * B[j + 2] for i in (0, 3, 6) for j in range(i, 9, 3))


def times_transpose_upper_add(A, B, S):
    """Return the upper triangle of A Bᵀ + S, summed so that every product fuses with an addition (S symmetric, 6-tuple)."""
    T = full(S)
    return tuple(
        A[i] * B[j] + (A[i + 1] * B[j + 1] + (A[i + 2] * B[j + 2] + T[i + j // 3]))
        for i in (0, 3, 6)
        for j in range(i, 9, 3)
    )


def minus_times_transpose_upper(S, A, B):
    """Return the upper triangle of S − A Bᵀ, known to be symmetric."""
    T = full(S)
    return tuple(
        ((T[i + j // 3] - A[i] * B[j]) - A[i + 1] * B[j + 1]) - A[i + 2] * B[j + 2]
        for i in (0, 3, 6)
        for j in range(i, 9, 3)
    )


def minus_outer(A, a, b):
    """Return A − a bᵀ."""
    return tuple(A[3 * i + j] - a[i] * b[j] for i in range(3) for j in range(3))


def symmetric_minus_outer(S, a, b):
    """Return S − a bᵀ, known to be symmetric."""
    T = full(S)
    return tuple(T[3 * i + j] - a[i] * b[j] for i in range(3) for j in range(i, 3))


def skew_polynomial(identity, linear, quadratic, v):
    """Return ``identity`` I + ``linear`` [v] + ``quadratic`` [v]², with [v] the skew matrix of v and [v]² = v vᵀ − |v|² I."""
    xx = v[0] * v[0]
    yy = v[1] * v[1]
    zz = v[2] * v[2]
    xy = quadratic * (v[0] * v[1])
    xz = quadratic * (v[0] * v[2])
    yz = quadratic * (v[1] * v[2])
    x = linear * v[0]
    y = linear * v[1]
    z = linear * v[2]
    return (
        identity - quadratic * (yy + zz),
        xy - z,
        xz + y,
        xy + z,
        identity - quadratic * (xx + zz),
        yz - x,
        xz - y,
        yz + x,
        identity - quadratic * (xx + yy),
    )


def factored(S):
    """Return S = L D Lᵀ of a symmetric positive-definite matrix, as (l10, l20, l21, 1/d0, 1/d1, 1/d2).

    Elimination without fractions (Bareiss 1968), so that no division waits for another: the differences, and so the rounding, are those of
    the elimination by rows multiplied by the previous pivots.
    """
    m11 = S[0] * S[3] - S[1] * S[1]
    m21 = S[0] * S[4] - S[1] * S[2]
    m22 = S[0] * S[5] - S[2] * S[2]
    i0 = 1.0 / S[0]
    j1 = 1.0 / m11
    i2 = (S[0] * m11) / (m11 * m22 - m21 * m21)
    return (S[1] * i0, S[2] * i0, m21 * j1, i0, S[0] * j1, i2)


def solved(F, v):
    """Return S⁻¹ v from the factors of S."""
    y1 = v[1] - F[0] * v[0]
    y2 = v[2] - F[1] * v[0] - F[2] * y1
    x2 = F[5] * y2
    x1 = F[4] * y1 - F[2] * x2
    return (F[3] * v[0] - F[0] * x1 - F[1] * x2, x1, x2)


def divided(X, F):
    """Return X S⁻¹ of a matrix X, from the factors of S."""
    return solved(F, X[:3]) + solved(F, X[3:6]) + solved(F, X[6:])


def congruent(M, S):
    """Return the symmetric M S Mᵀ."""
    return times_transpose_upper(multiply(M, full(S)), M)


def inverse(A):
    """Return A⁻¹."""
    a, b, c = A[:3], A[3:6], A[6:]
    x, y, z = cross(b, c), cross(c, a), cross(a, b)
    d = 1.0 / dot(a, x)
    return tuple(d * v[i] for i in range(3) for v in (x, y, z))
