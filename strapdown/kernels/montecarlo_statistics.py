"""Sums over the runs of a Monte Carlo, eight runs at a time, in double precision: what :mod:`strapdown.montecarlo.statistics` defines.

Every eighth run goes into the same lane of a sum, in the order of the runs, and the lanes are added up at the end of a chunk in one order
(:func:`strapdown.kernels.lane_values.total`), so the sums have the same bits on every machine and for every number of lanes.
"""

from __future__ import annotations

import numpy as np

from strapdown.kernels.algebra import dot, subtract
from strapdown.kernels.lane_angles import rotation_vector
from strapdown.kernels.lane_values import (
    bits_of,
    chosen,
    lanes_of,
    load_like,
    number_of_bits,
    number_where,
    store_like,
)
from strapdown.kernels.montecarlo_run import KEPT
from strapdown.kernels.rotation import quaternion_multiply

SUMS = 6 + 21 + 21 + 3 + 6
"""Numbers summed at an epoch: e, e eᵀ and P (upper triangles in blocks θθ, θb, bb), the NEES of state, attitude, bias, and the product of
each NEES over the runs, whose logarithm is the sum of logarithms: a number from 1 to 2, and the powers of two that it lacks."""
_PRODUCT, _COVARIANCE, _NEES, NEES_PRODUCT = 6, 27, 48, 51

_TINY = 2.2250738585072014e-308
_UNIT, _INTEGER, _MANTISSA = np.uint64(0x3FF0000000000000), np.uint64(0x4330000000000000), np.uint64((1 << 52) - 1)
_S52 = np.uint64(52)
_EXPONENT_BIAS = 4503599627370496.0 + 1023.0
_INFINITE = float("inf")
_LARGEST = 1.7976931348623157e308


def triangular(S):
    """Return L (3 numbers below the unit diagonal) and 1/D of S = L D Lᵀ, and whether D is positive."""
    i0 = 1.0 / S[0]
    l10 = S[1] * i0
    l20 = S[2] * i0
    d1 = S[3] - l10 * S[1]
    i1 = 1.0 / d1
    t = S[4] - l20 * S[1]
    l21 = t * i1
    d2 = S[5] - l20 * S[2] - l21 * t
    return (l10, l20, l21), (i0, i1, 1.0 / d2), (S[0] > 0.0) & (d1 > 0.0) & (d2 > 0.0)


def solved(L, v):
    """Return L⁻¹ v."""
    y1 = v[1] - L[0] * v[0]
    return (v[0], y1, v[2] - L[1] * v[0] - L[2] * y1)


def weighted(w, a, b):
    """Return Σ w_k a_k b_k."""
    return w[0] * a[0] * b[0] + w[1] * a[1] * b[1] + w[2] * a[2] * b[2]


def normalized_squares(e_theta, e_bias, A, B, C):
    """Return the NEES of state, attitude and bias, and whether P is positive definite; by blocks, with the Schur complement of A."""
    L, w, definite = triangular(A)
    y = solved(L, e_theta)
    attitude = weighted(w, y, y)
    c0 = solved(L, (B[0], B[3], B[6]))
    c1 = solved(L, (B[1], B[4], B[7]))
    c2 = solved(L, (B[2], B[5], B[8]))
    rest = (
        C[0] - weighted(w, c0, c0),
        C[1] - weighted(w, c0, c1),
        C[2] - weighted(w, c0, c2),
        C[3] - weighted(w, c1, c1),
        C[4] - weighted(w, c1, c2),
        C[5] - weighted(w, c2, c2),
    )
    r = subtract(e_bias, (weighted(w, c0, y), weighted(w, c1, y), weighted(w, c2, y)))
    L2, w2, definite2 = triangular(rest)
    z = solved(L2, r)
    L3, w3, definite3 = triangular(C)
    x = solved(L3, e_bias)
    return attitude + weighted(w2, z, z), attitude, weighted(w3, x, x), definite & definite2 & definite3


def bin_numbers(x, first, last):
    """Return the bins of non-negative lanes: bits shifted right less ``first``, within 0 and ``last`` less ``first``."""
    word = bits_of(x) >> np.uint64(49)
    word = chosen(word < first, first, word)
    word = chosen(word > last, last, word)
    return word - first


def add_up(sums, row, place, good, x):
    """Add the good lanes of x to a number of an epoch."""
    at = (row * SUMS + place) * len(x)
    store_like(sums, at, load_like(sums, at, x) + chosen(good, x, 0.0))


def accumulate(
    pattern, kept, width, column, valid, truth, error_bins, nees_bins, finite, sums, coverage, histogram, scratch, score
):
    """Add eight runs to the sums.

    Parameters
    ----------
    pattern : tuple of 8 floats
    kept : array
        Flat, of :func:`strapdown.kernels.montecarlo_run.advance` of ``width`` runs, of which those from ``column`` on are taken.
    valid : array (8,)
        1 for each run that counts, 0 for the others.
    truth : array (m, 4)
        True attitudes.
    error_bins, nees_bins : array of words (2,)
        First and last of the shifted bits.
    finite, sums, coverage, histogram : arrays (m,), (m · SUMS · 8,), (m, 6, 3), (m, 9, bins)
        ``sums`` by lane, from zeros on, the products of NEES from ones.
    scratch : array of words (9 · 8,)
    score : array (8,)
        Largest NEES of each run; infinite if one was not finite.
    """
    like = lanes_of(pattern)
    n = len(like)
    counted = load_like(valid, 0, like) > 0.5
    worst = like
    for row in range(len(truth)):
        at = row * KEPT * width + column
        conjugate = (
            load_like(kept, at, like),
            -load_like(kept, at + width, like),
            -load_like(kept, at + 2 * width, like),
            -load_like(kept, at + 3 * width, like),
        )
        b = triple_at(kept, at + 4 * width, width, like)
        A0, A1, A2 = triple_at(kept, at + 7 * width, width, like)
        A3, A4, A5 = triple_at(kept, at + 10 * width, width, like)
        B0, B1, B2 = triple_at(kept, at + 13 * width, width, like)
        B3, B4, B5 = triple_at(kept, at + 16 * width, width, like)
        B6, B7, B8 = triple_at(kept, at + 19 * width, width, like)
        C0, C1, C2 = triple_at(kept, at + 22 * width, width, like)
        C3, C4, C5 = triple_at(kept, at + 25 * width, width, like)
        e_theta = rotation_vector(
            quaternion_multiply(conjugate, (truth[row, 0], truth[row, 1], truth[row, 2], truth[row, 3]))
        )
        e_bias = subtract(triple_at(kept, at + 28 * width, width, like), b)
        state, attitude, bias, definite = normalized_squares(
            e_theta, e_bias, (A0, A1, A2, A3, A4, A5), (B0, B1, B2, B3, B4, B5, B6, B7, B8), (C0, C1, C2, C3, C4, C5)
        )
        sound = (
            definite
            & (state <= _LARGEST)
            & (bias <= _LARGEST)
            & (dot(e_theta, e_theta) <= _LARGEST)
            & (dot(e_bias, e_bias) <= _LARGEST)
        )
        worst = chosen(sound, chosen(state > worst, state, worst), _INFINITE)
        good = sound & counted
        finite[row] += number_where(good)
        e0, e1, e2 = e_theta
        e3, e4, e5 = e_bias
        add_up(sums, row, 0, good, e0)
        add_up(sums, row, 1, good, e1)
        add_up(sums, row, 2, good, e2)
        add_up(sums, row, 3, good, e3)
        add_up(sums, row, 4, good, e4)
        add_up(sums, row, 5, good, e5)
        add_outer(sums, row, _PRODUCT, good, e_theta, e_bias)
        add_symmetric(sums, row, _COVARIANCE, good, (A0, A1, A2, A3, A4, A5))
        add_symmetric(sums, row, _COVARIANCE + 6, good, (B0, B1, B2, B3, B4, B5))
        add_up(sums, row, _COVARIANCE + 12, good, B6)
        add_up(sums, row, _COVARIANCE + 13, good, B7)
        add_up(sums, row, _COVARIANCE + 14, good, B8)
        add_symmetric(sums, row, _COVARIANCE + 15, good, (C0, C1, C2, C3, C4, C5))
        add_nees(sums, row, 0, good, state)
        add_nees(sums, row, 1, good, attitude)
        add_nees(sums, row, 2, good, bias)
        add_coverage(coverage, row, 0, good, e0, A0)
        add_coverage(coverage, row, 1, good, e1, A3)
        add_coverage(coverage, row, 2, good, e2, A5)
        add_coverage(coverage, row, 3, good, e3, C0)
        add_coverage(coverage, row, 4, good, e4, C3)
        add_coverage(coverage, row, 5, good, e5, C5)
        store_bins(scratch, 0, error_bins, e0)
        store_bins(scratch, n, error_bins, e1)
        store_bins(scratch, 2 * n, error_bins, e2)
        store_bins(scratch, 3 * n, error_bins, e3)
        store_bins(scratch, 4 * n, error_bins, e4)
        store_bins(scratch, 5 * n, error_bins, e5)
        store_bins(scratch, 6 * n, nees_bins, state)
        store_bins(scratch, 7 * n, nees_bins, attitude)
        store_bins(scratch, 8 * n, nees_bins, bias)
        store_like(score, 0, chosen(good, 1.0, like))
        for lane in range(n):
            if score[lane] > 0.0:
                for c in range(9):
                    histogram[row, c, scratch[c * n + lane]] += 1
    store_like(score, 0, worst)


def triple_at(kept, at, width, like):
    """Return three neighbouring places of so many runs each."""
    return (load_like(kept, at, like), load_like(kept, at + width, like), load_like(kept, at + 2 * width, like))


def add_symmetric(sums, row, place, good, S):
    """Add six numbers."""
    add_up(sums, row, place, good, S[0])
    add_up(sums, row, place + 1, good, S[1])
    add_up(sums, row, place + 2, good, S[2])
    add_up(sums, row, place + 3, good, S[3])
    add_up(sums, row, place + 4, good, S[4])
    add_up(sums, row, place + 5, good, S[5])


def add_outer(sums, row, place, good, a, b):
    """Add (a, b) (a, b)ᵀ: the upper triangle of a aᵀ, a bᵀ by rows, the upper triangle of b bᵀ."""
    add_symmetric(
        sums, row, place, good, (a[0] * a[0], a[0] * a[1], a[0] * a[2], a[1] * a[1], a[1] * a[2], a[2] * a[2])
    )
    add_symmetric(
        sums, row, place + 6, good, (a[0] * b[0], a[0] * b[1], a[0] * b[2], a[1] * b[0], a[1] * b[1], a[1] * b[2])
    )
    add_up(sums, row, place + 12, good, a[2] * b[0])
    add_up(sums, row, place + 13, good, a[2] * b[1])
    add_up(sums, row, place + 14, good, a[2] * b[2])
    add_symmetric(
        sums, row, place + 15, good, (b[0] * b[0], b[0] * b[1], b[0] * b[2], b[1] * b[1], b[1] * b[2], b[2] * b[2])
    )


def add_nees(sums, row, column, good, x):
    """Add a NEES, and multiply their product by it."""
    add_up(sums, row, _NEES + column, good, x)
    n = len(x)
    at = (row * SUMS + NEES_PRODUCT + 2 * column) * n
    bits = bits_of(load_like(sums, at, x) * chosen(good, chosen(x > _TINY, x, _TINY), 1.0))
    store_like(sums, at, number_of_bits((bits & _MANTISSA) | _UNIT))
    binades = number_of_bits((bits >> _S52) | _INTEGER) - _EXPONENT_BIAS
    store_like(sums, at + n, load_like(sums, at + n, x) + binades)


def add_coverage(coverage, row, i, good, e, variance):
    """Count the runs with |e| ≤ σ, 2σ, 3σ."""
    squared = e * e
    coverage[row, i, 0] += number_where(good & (squared <= variance))
    coverage[row, i, 1] += number_where(good & (squared <= 4.0 * variance))
    coverage[row, i, 2] += number_where(good & (squared <= 9.0 * variance))


def store_bins(scratch, at, bounds, x):
    """Write the bins of |x|."""
    store_like(scratch, at, bin_numbers(chosen(x < 0.0, -x, x), bounds[0], bounds[1]))
