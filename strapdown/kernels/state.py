"""A state (q, b, A, B, C) as 28 numbers: attitude, bias, and the blocks of the covariance; and lanes of several components."""

from __future__ import annotations

from strapdown.kernels.algebra import full
from strapdown.kernels.lane_values import WIDTH, load, store

SIZE = 28


def load_state(row):
    """Return (q, b, A, B, C) from 28 numbers."""
    n = tuple(row[i] for i in range(SIZE))
    return n[:4], n[4:7], n[7:13], n[13:22], n[22:]


def store_state(row, q, b, A, B, C):
    """Write (q, b, A, B, C) to 28 numbers."""
    for i, value in enumerate((*q, *b, *A, *B, *C)):
        row[i] = value


def store_row(out, row, values):
    """Write a row of an array."""
    for i, value in enumerate(values):
        out[row, i] = value


def covariance_rows(A, B, C):
    """Return P by rows (36) from its blocks."""
    A, C = full(A), full(C)
    return sum((A[i : i + 3] + B[i : i + 3] for i in (0, 3, 6)), ()) + sum(
        (B[i::3] + C[3 * i : 3 * i + 3] for i in (0, 1, 2)), ()
    )


def keep_state(out, row, q, b, A, B, C):
    """Write a state to a row of the outputs: attitude, bias, variances, and, if the outputs have them, covariances by rows."""
    store_row(out.attitude, row, q)
    store_row(out.bias, row, b)
    store_row(out.variance, row, (A[0], A[3], A[5], C[0], C[3], C[5]))
    if row < len(out.covariance):
        store_row(out.covariance, row, covariance_rows(A, B, C))


def load_triple(array, start):
    """Return the lanes of three components from ``array[start]`` on."""
    return tuple(load(array, start + i * WIDTH) for i in range(3))


def load_quaternion(array, start):
    """Return the lanes of four components likewise."""
    return tuple(load(array, start + i * WIDTH) for i in range(4))


def load_matrix(array, start):
    """Return the lanes of a 9-tuple likewise."""
    return tuple(load(array, start + i * WIDTH) for i in range(9))


def store_several(array, start, values):
    """Write the lanes of any number of components from ``array[start]`` on."""
    for i, value in enumerate(values):
        store(array, start + i * WIDTH, value)
