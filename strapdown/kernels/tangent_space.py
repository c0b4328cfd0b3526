"""A state and its covariance transformed to the tangent space at another attitude, with the vectors that are carried with the attitude.

A vector of carried states is defined in the axes of the *estimated* attitude: a correction that rotates the attitude by A in fixed axes
changes it to A c, and its error likewise. These functions are for one run.
"""

from __future__ import annotations

from strapdown.kernels.algebra import matrix_times_vector
from strapdown.kernels.layout import AXES, CHUNKS, STATES, STRUCTURE, W, chunk_at, put_chunk
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix
from strapdown.kernels.structural_zeros import products


def fixed_turn(before, after):
    """Return the rotation from one attitude to another, as a matrix in fixed axes."""
    return rotation_matrix(quaternion_multiply(after, (before[0], -before[1], -before[2], -before[3])))


def rotate_vectors(array, first, A):
    """Rotate the carried vectors among n neighbouring numbers, one per state, by A."""
    for v in STRUCTURE.vectors:
        old = tuple(array[first + k] for k in v)
        for k, value in zip(v, matrix_times_vector(A, old), strict=True):
            array[first + k] = value


def turn_attitude(P, M):
    """Transform the attitude in a covariance by M."""
    turn_covariance(P, AXES, M)


def turn_carried(x, P, before, after):
    """Rotate the carried vectors of a state and its covariance from one attitude to another."""
    A = fixed_turn(before, after)
    rotate_vectors(x, 1, A)
    for v in STRUCTURE.vectors:
        turn_covariance(P, v, A)


def turn_covariance(P, v, A):
    """Transform the states v of a covariance by A."""
    for c in CHUNKS:
        old = tuple(chunk_at(P, k, c, 0.0) for k in v)
        for i, k in enumerate(v):
            put_chunk(P, k, c, products(A[3 * i : 3 * i + 3], old))
    for k in v:
        block = tuple(P[W * k + j] for j in v)
        for d, j in enumerate(v):
            P[W * k + j] = products(A[3 * d : 3 * d + 3], block)
    for j in STATES:
        if j not in v:
            for k in v:
                P[W * j + k] = P[W * k + j]


def put_attitude(x, P, before, after):
    """Replace the attitude of a state, and rotate the states that are carried with it."""
    turn_carried(x, P, before, after)
    for j, value in enumerate(after):
        x[j] = value
