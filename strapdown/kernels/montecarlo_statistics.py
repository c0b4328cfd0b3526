"""Sums over Monte Carlo runs, eight runs at a time in lanes (SIMD), in double precision: see :mod:`strapdown.montecarlo.statistics`.

Every eighth run is added to the same lane of a sum, in the order of the runs, and the lanes are summed at the end of a chunk in a fixed
order (:func:`strapdown.kernels.lane_values.sum_lanes`), so the sums have the same bits on every machine and for any number of lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    divided,
    dot,
    factored,
    matrix_times_vector,
    minus_times_transpose_upper,
    solved,
    subtract,
    transpose,
)
from strapdown.kernels.lane_angles import rotation_vector
from strapdown.kernels.lane_values import (
    bits_of,
    lanes_of,
    load_like,
    number_of_bits,
    number_where,
    select,
    store,
)
from strapdown.kernels.measurement import quaternion_at
from strapdown.kernels.montecarlo_run import KEPT, PATTERN
from strapdown.kernels.rotation import quaternion_multiply

SUMS = 6 + 21 + 21 + 3 + 6
"""Number of sums at an epoch: e, e eᵀ and P (upper triangles in blocks θθ, θb, bb), the NEES of state, attitude and bias, and the product
of each NEES over the runs, whose logarithm is the sum of logarithms: its mantissa, from 1 to 2, and its exponent of two."""
NEES_PRODUCT = 51

_TINY = 2.2250738585072014e-308
_UNIT, _INTEGER, _MANTISSA = np.uint64(0x3FF0000000000000), np.uint64(0x4330000000000000), np.uint64((1 << 52) - 1)
_S52 = np.uint64(52)
_EXPONENT_BIAS = 4503599627370496.0 + 1023.0
_INFINITE = float("inf")
_LARGEST = 1.7976931348623157e308


def definite(F):
    """Return whether a matrix with these factors is positive definite."""
    return (F[3] > 0.0) & (F[4] > 0.0) & (F[5] > 0.0)


def normalized_squares(e_theta, e_bias, A, B, C):
    """Return the NEES of state, attitude and bias, and whether P is positive definite; by blocks, with the Schur complement of A."""
    bt = transpose(B)
    F, H = factored(A), factored(C)
    K = divided(bt, F)  # Bᵀ A⁻¹
    G = factored(minus_times_transpose_upper(C, K, bt))
    r = subtract(e_bias, matrix_times_vector(K, e_theta))
    attitude = dot(e_theta, solved(F, e_theta))
    nees = (attitude + dot(r, solved(G, r)), attitude, dot(e_bias, solved(H, e_bias)))
    return nees, definite(F) & definite(G) & definite(H)


def bin_numbers(x, first, last):
    """Return the bins of non-negative lanes: their shifted bits, limited to ``first`` and ``last``, minus ``first``."""
    word = bits_of(x) >> np.uint64(49)
    word = select(word < first, first, word)
    word = select(word > last, last, word)
    return word - first


def add_up(sums, row, place, good, values):
    """Add the good lanes of values to neighbouring numbers of an epoch."""
    for i, x in enumerate(values):
        at = (row * SUMS + place + i) * len(x)
        store(sums, at, load_like(sums, at, x) + select(good, x, 0.0))


class Sums(NamedTuple):
    """Sums over runs at m epochs."""

    finite: np.ndarray
    """Number of runs included (m,)."""
    sums: np.ndarray
    """By lane (m · SUMS · 8,), initially zero, the products of NEES one."""
    coverage: np.ndarray
    """(m, 6, 3)"""
    histogram: np.ndarray
    """(m, 6, bins)"""
    scratch: np.ndarray
    """Words (6 · 8,)."""


def accumulate(kept, valid, truth, bins, out, score):
    """Add eight runs to the sums.

    Parameters
    ----------
    kept : array
        Flat, as :func:`strapdown.kernels.montecarlo_run.keep` writes it.
    valid : array (8,)
        1 for each run that counts, 0 for the others.
    truth : array (m, 4)
        True attitudes.
    bins : array of words (2,)
        First and last of the shifted bits.
    out : Sums
    score : array (8,)
        Largest NEES of each run; infinite if one was not finite.
    """
    like = lanes_of(PATTERN)
    n = len(like)
    counted = load_like(valid, 0, like) > 0.5
    worst = like
    for row in range(len(truth)):
        state = kept_state(kept, row, like)
        q, P, C = state[:4], state[7:28], state[22:28]
        e_theta = rotation_vector(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), quaternion_at(truth, row)))
        e_bias = subtract(state[28:], state[4:7])
        nees, definite = normalized_squares(e_theta, e_bias, P[:6], P[6:15], C)
        sound = (
            definite
            & (nees[0] <= _LARGEST)
            & (nees[2] <= _LARGEST)
            & (dot(e_theta, e_theta) <= _LARGEST)
            & (dot(e_bias, e_bias) <= _LARGEST)
        )
        worst = select(sound, select(nees[0] > worst, nees[0], worst), _INFINITE)
        good = sound & counted
        out.finite[row] += number_where(good)
        e = (*e_theta, *e_bias)
        add_up(out.sums, row, 0, good, (*e, *products(e_theta, e_bias), *P, *nees))
        multiply_nees(out.sums, row, good, nees)
        add_coverage(out.coverage, row, good, e, (P[0], P[3], P[5], C[0], C[3], C[5]))
        store_bins(out.scratch, bins, e)
        store(score, 0, select(good, 1.0, like))
        for lane in range(n):
            if score[lane] > 0.0:
                for c in range(6):
                    out.histogram[row, c, out.scratch[c * n + lane]] += 1
    store(score, 0, worst)


def kept_state(kept, row, like):
    """Return the stored values of an epoch."""
    return tuple(load_like(kept, (row * KEPT + i) * len(like), like) for i in range(KEPT))


def products(a, b):
    """Return (a, b) (a, b)ᵀ: the upper triangle of a aᵀ, a bᵀ by rows, the upper triangle of b bᵀ."""
    pairs = [(a[i], a[j]) for i in range(3) for j in range(i, 3)]
    pairs += [(x, y) for x in a for y in b]
    pairs += [(b[i], b[j]) for i in range(3) for j in range(i, 3)]
    return tuple(x * y for x, y in pairs)


def multiply_nees(sums, row, good, nees):
    """Multiply the products of NEES by those of a run."""
    for column, x in enumerate(nees):
        n = len(x)
        at = (row * SUMS + NEES_PRODUCT + 2 * column) * n
        bits = bits_of(load_like(sums, at, x) * select(good, select(x > _TINY, x, _TINY), 1.0))
        store(sums, at, number_of_bits((bits & _MANTISSA) | _UNIT))
        binades = number_of_bits((bits >> _S52) | _INTEGER) - _EXPONENT_BIAS
        store(sums, at + n, load_like(sums, at + n, x) + binades)


def add_coverage(coverage, row, good, e, variances):
    """Count the runs with |e| ≤ σ, 2σ, 3σ."""
    for i, (x, variance) in enumerate(zip(e, variances, strict=True)):
        squared = x * x
        coverage[row, i, 0] += number_where(good & (squared <= variance))
        coverage[row, i, 1] += number_where(good & (squared <= 4.0 * variance))
        coverage[row, i, 2] += number_where(good & (squared <= 9.0 * variance))


def store_bins(scratch, bounds, values):
    """Write the bins of |x| of each value."""
    for i, x in enumerate(values):
        store(scratch, i * len(x), bin_numbers(select(x < 0.0, -x, x), bounds[0], bounds[1]))
