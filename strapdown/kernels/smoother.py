"""The fixed-interval smoother for any number of error states: Rauch–Tung–Striebel on the manifold, backward over the filter's segments.

The gain is that of :mod:`strapdown.kernels.smoother_step`, where its reasons are: with the process noise of a step referred to its start,
``Q̄ = Φ⁻¹ Q Φ⁻ᵀ``, it is ``G = N Φ⁻¹``, ``N = I − Q̄ (P + Q̄)⁻¹ = P (P + Q̄)⁻¹``, and the covariance is a sum, ``G P_s Gᵀ + N Q̄``, in which
nothing of the size of P is subtracted. A row of N is by the first form, or by the second if the variance of its state is smaller than that
of the noise. The later covariance is transformed to the tangent space at the predicted attitude before the step, and the result to that at
the smoothed attitude after it; so are states that rotate with the attitude.

Matrices are stored by rows, padded to a multiple of eight columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.chains import fill_coefficients
from strapdown.kernels.lane_values import WIDTH, broadcast, lanes_of, load, load_like, store
from strapdown.kernels.layout import CHUNKS, EIGHT, STATES, STRUCTURE, N, W, chunk_at, copy_values, put_chunk
from strapdown.kernels.model import (
    CHAINED,
    advance_state,
    advance_without_noise,
    apply_transition,
    warm,
    write_noise,
    write_transition,
)
from strapdown.kernels.rotation import inverse_right_jacobian, logarithm, moved, quaternion_multiply
from strapdown.kernels.structure import Model
from strapdown.kernels.tangent_space import put_attitude, turn_attitude, turn_carried

CALLED = ("factorise", "solve", "add_product", "load_segment", "write_small_columns")

ROWS = 6
"""Rows that :func:`add_product` computes together."""
NOISY = tuple(sorted({*range(6), *CHAINED}))
"""States with process noise."""
NOISY_WIDTH = len(NOISY) + 7 - (len(NOISY) + 7) % 8
NOISY_CHUNKS = tuple(range(0, NOISY_WIDTH, 8))


class Models(NamedTuple):
    """Numbers of the model: those of the filter, and those with noise of negative variance."""

    forward: Model
    backward: Model


class Workspace(NamedTuple):
    """State at the end of a segment, and work space, for n states.

    Matrices are by rows, padded, with ``ROWS`` rows more, which :func:`add_product` may read; ``gain`` with eight numbers more.
    """

    x: np.ndarray
    """Filtered state at the start of the segment (n + 1,)."""
    predicted: np.ndarray
    """Predicted state at its end, and a copy that is propagated back (n + 1,)."""
    after: np.ndarray
    later_x: np.ndarray
    """Smoothed state."""
    P: np.ndarray
    """Filtered covariance at the start of the segment; then the factor of P + Q̄ (:func:`factorise`)."""
    Q: np.ndarray
    """Q̄, whose other elements than those of a step are zero."""
    later_P: np.ndarray
    """Smoothed covariance."""
    gain: np.ndarray
    """(P + Q̄)⁻¹ Q̄, with columns for the states with process noise, −(P + Q̄)⁻¹ P of those whose noise is larger; then those of Nᵀ."""
    columns: np.ndarray
    """The same columns of Q̄, then of ``Y Nᵀ + Q̄``."""
    block: np.ndarray
    """The rows of these states of ``N (Y Nᵀ + Q̄)``, with the same columns."""
    kept: np.ndarray
    """1 for the columns of the first form, 0 for the others."""
    top: np.ndarray
    """Rows of the attitude of Φ⁻¹ (3 × padded width)."""
    error: np.ndarray
    """Smoothed error relative to the predicted state, then to the filtered one (n,), and the numbers of a row of ``gain``."""
    coefficients: np.ndarray
    states: np.ndarray
    """States with process noise."""
    warming: np.ndarray
    """Half the change of temperature in each segment, K; empty without slopes of the bias."""


class Outputs(NamedTuple):
    """Arrays that the passes write, a row an edge."""

    x: np.ndarray
    """q, b and c (edges, n + 1)."""
    variance: np.ndarray
    covariance: np.ndarray
    """(edges, m, m) for the first m states, or (0, m, m)."""


def load_segment(segments, k, x, P):
    """Read state and upper triangle of the covariance of row k of the segments; what is below the diagonal is not defined."""
    for i in range(N + 1):
        x[i] = segments[k, 4 + i]
    at = 5 + N + k * segments.shape[1]
    for i in range(N):
        for j in range(i, N, WIDTH):
            store(P, W * i + j, load(segments, at + j - i))  # the excess is in the next row, which is written after it
        at += N - i


def mirror(P):
    """Copy the upper triangle of a matrix to the lower one."""
    for i in range(N):
        for j in range(i + 1, N):
            P[W * j + i] = P[W * i + j]


def factorise(A):
    """Replace the upper triangle of A by U in ``A = Uᵀ D⁻¹ U``, with D the diagonal of U; the diagonal then holds D⁻¹."""
    for i in range(N):
        row = row_at(A, i)
        for k in range(i):
            row = minus_row(row, A[W * k + i] * A[W * k + k], row_at(A, k))
        put_row(A, i, 1.0, row)
        A[W * i + i] = 1.0 / A[W * i + i]


def solve(U, B):
    """Replace B, with columns for the states with process noise, by the solution X of ``Uᵀ D⁻¹ U X = B``; U as :func:`factorise` leaves it.

    Two rows of X are subtracted from the others as soon as they are known: these do not wait for each other, as terms of a sum would.
    """
    for i in range(0, N - 1, 2):
        first, second = noisy_row_at(B, i), noisy_row_at(B, i + 1)
        a, b = U[W * i + i], U[W * (i + 1) + i + 1]
        second = minus_row(second, a * U[W * i + i + 1], first)
        put_noisy_row(B, i + 1, 1.0, second)
        for k in range(i + 2, N):
            row = minus_row(noisy_row_at(B, k), a * U[W * i + k], first)
            put_noisy_row(B, k, 1.0, minus_row(row, b * U[W * (i + 1) + k], second))
    for i in range(N):
        put_noisy_row(B, i, U[W * i + i], noisy_row_at(B, i))
    for i in range(N - 1, 0, -2):
        second, first = noisy_row_at(B, i), noisy_row_at(B, i - 1)
        first = minus_row(first, U[W * (i - 1) + i] * U[W * (i - 1) + i - 1], second)
        put_noisy_row(B, i - 1, 1.0, first)
        for k in range(i - 1):
            a = U[W * k + k]
            row = minus_row(noisy_row_at(B, k), a * U[W * k + i], second)
            put_noisy_row(B, k, 1.0, minus_row(row, a * U[W * k + i - 1], first))


def add_product(A, row, column, B, C, count, inner, width):
    """Add A B to C, which has ``count`` rows of ``width``; element (i, k) of A is ``A[row * i + column * k]``, with ``inner`` values of k.

    Six rows at once, so that their sums do not wait for each other; rows after the last are read and written too.
    """
    for c in range(0, width, WIDTH):
        for i in range(0, count, ROWS):
            s = width * i + c
            t0, t1, t2 = load(C, s), load(C, s + width), load(C, s + 2 * width)
            t3, t4, t5 = load(C, s + 3 * width), load(C, s + 4 * width), load(C, s + 5 * width)
            a = row * i
            for k in range(inner):
                b = load(B, width * k + c)
                t0 = t0 + A[a] * b
                t1 = t1 + A[a + row] * b
                t2 = t2 + A[a + 2 * row] * b
                t3 = t3 + A[a + 3 * row] * b
                t4 = t4 + A[a + 4 * row] * b
                t5 = t5 + A[a + 5 * row] * b
                a += column
            store(C, s, t0)
            store(C, s + width, t1)
            store(C, s + 2 * width, t2)
            store(C, s + 3 * width, t3)
            store(C, s + 4 * width, t4)
            store(C, s + 5 * width, t5)


def step_back(segments, k, models, space):
    """Propagate the smoothed state from the end of segment k back to its start.

    A step back in time has the transition Φ⁻¹ and, for noise of negative variance, the process noise Q̄ = Φ⁻¹ Q Φ⁻ᵀ. If temperature drives
    the bias, its changes before and after the step have no noise: both states are transformed to the step's start and end without them.
    """
    x, predicted, after = space.x, space.predicted, space.after
    P, Q, gain, kept, columns, block = space.P, space.Q, space.gain, space.kept, space.columns, space.block
    later_x, later_P, error, coefficients = space.later_x, space.later_P, space.error, space.coefficients
    load_segment(segments, k, x, P)
    if STRUCTURE.slopes:
        mirror(P)
        warm(x, P, space.warming[k])
        warm(later_x, later_P, -space.warming[k])
    dt = segments[k, 0]
    part, back = (segments[k, 1], segments[k, 2], segments[k, 3]), (-segments[k, 1], -segments[k, 2], -segments[k, 3])
    copy_values(x, predicted, N + 1, 0.0)
    fill_coefficients(coefficients, dt, models.forward)
    advance_state(predicted, part, dt, models.forward, coefficients, 0.0)
    relative_error(predicted, later_x, later_P, error)
    fill_coefficients(coefficients, -dt, models.backward)
    write_transition(predicted, back, -dt, models.backward, coefficients, space.top, 0.0)
    apply_transition(error, space.top, coefficients, 0.0)
    write_noise(predicted, Q, back, -dt, models.backward, coefficients, 0.0)
    copy_values(predicted, after, N + 1, 0.0)
    advance_without_noise(after, later_P, back, -dt, models.backward, coefficients, 0.0)
    clear(columns, N * NOISY_WIDTH)
    gather_noisy_columns(Q, columns)
    for i in range(0, N * NOISY_WIDTH, WIDTH):
        store(gain, i, load(columns, i))
    write_small_columns(P, Q, gain, kept, space.states)
    for i in range(0, N * W, WIDTH):
        store(P, i, load(P, i) + load(Q, i))
    factorise(P)
    solve(P, gain)
    subtract_from_kept(gain, kept, space.states)
    reduce_error(error, gain, space.states)
    # N (Y Nᵀ + Q̄), Y the later covariance at the start: only rows and columns of states with noise differ from those of Y.
    add_product(later_P, W, 1, gain, columns, N, N, NOISY_WIDTH)
    clear(block, 0)
    add_product(gain, 1, NOISY_WIDTH, columns, block, len(NOISY), N, NOISY_WIDTH)
    scatter_noisy_columns(columns, block, later_P)
    correct_filtered(x, error, later_x, later_P)
    if STRUCTURE.slopes:
        warm(later_x, later_P, -space.warming[k])


def clear(A, start):
    """Set A to zero from ``start`` on."""
    for i in range(start, len(A), WIDTH):
        store(A, i, broadcast(0.0))


def write_small_columns(P, Q, gain, kept, states):
    """Write columns of −P, of its upper triangle, for the states whose variance is below their noise's; ``kept`` is 0 for these."""
    for r in range(len(states)):
        k = states[r]
        kept[r] = 1.0
        if P[W * k + k] < Q[W * k + k]:
            kept[r] = 0.0
            for i in range(N):
                gain[NOISY_WIDTH * i + r] = -P[W * min(i, k) + max(i, k)]


def subtract_from_kept(gain, kept, states):
    """Replace the gain by the columns of Nᵀ for the states with process noise."""
    for i in range(0, len(gain), WIDTH):
        store(gain, i, -1.0 * load(gain, i))
    for r in range(len(states)):
        gain[NOISY_WIDTH * states[r] + r] += kept[r]


def reduce_error(error, gain, states):
    """Replace the error by N times it; ``gain`` has the columns of Nᵀ for the ``states`` with process noise."""
    product = error[N:]
    put_noisy_row(product, 0, error[0], noisy_row_at(gain, 0))
    row = noisy_row_at(product, 0)
    for k in range(1, N):
        row = minus_row(row, -error[k], noisy_row_at(gain, k))
    put_noisy_row(product, 0, 1.0, row)
    for r in range(len(states)):
        error[states[r]] = product[r]


def relative_error(predicted, later_x, later_P, error):
    """Write the smoothed error relative to the predicted state, and transform the smoothed covariance to the tangent space there.

    exp(a) ⊗ exp(ε) = exp(a + J_r(a)⁻¹ ε).
    """
    q = (predicted[0], predicted[1], predicted[2], predicted[3])
    later_q = (later_x[0], later_x[1], later_x[2], later_x[3])
    a = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), later_q))
    turn_attitude(later_P, inverse_right_jacobian(a))
    turn_carried(later_x, later_P, later_q, q)
    error[0], error[1], error[2] = a
    for i in range(3, len(later_x) - 1):
        error[i] = later_x[1 + i] - predicted[1 + i]


def correct_filtered(x, error, later_x, later_P):
    """Write the filtered state corrected by the error, and transform the covariance to the tangent space there."""
    q = (x[0], x[1], x[2], x[3])
    new_q, J = moved(q, (error[0], error[1], error[2]))
    for i in range(3, len(x) - 1):
        later_x[1 + i] = x[1 + i] + error[i]
    turn_attitude(later_P, J)
    put_attitude(later_x, later_P, q, new_q)


def smooth_back(segments, starts, models, space, out):
    """Smooth from the filtered state at the last edge back to the first, and write all edges.

    Parameters
    ----------
    segments : array (rows, numbers)
        The filter's predictions, the last row the end state.
    starts : array (edges,)
        Row that starts at each edge.
    models : Models
    space : Workspace
    out : Outputs
    """
    edge = len(starts) - 1
    s = starts[edge]
    load_segment(segments, s, space.later_x, space.later_P)
    mirror(space.later_P)
    while True:
        while edge >= 0 and starts[edge] == s:
            write_smoothed(out, edge, space.later_x, space.later_P)
            edge -= 1
        if edge < 0:
            break
        s -= 1
        step_back(segments, s, models, space)


def write_smoothed(out, edge, x, P):
    """Write a smoothed state to the row of an edge; of the covariance the mean of both triangles."""
    for i in range(N + 1):
        out.x[edge, i] = x[i]
    for i in range(N):
        out.variance[edge, i] = P[W * i + i]
    if edge < len(out.covariance):
        for i in range(out.covariance.shape[1]):
            for j in range(i, out.covariance.shape[2]):
                value = 0.5 * (P[W * i + j] + P[W * j + i])
                out.covariance[edge, i, j] = value
                out.covariance[edge, j, i] = value


# ------------------------------------------------------------- matrices with a column for each state, and for the states with process noise


def row_at(A, i):
    """Return row i of a matrix (rows of W)(chunks)."""
    return tuple(chunk_at(A, i, c, 0.0) for c in CHUNKS)


def minus_row(row, factor, other):
    """Return a row less a factor times another."""
    return tuple(t - factor * u for t, u in zip(row, other, strict=True))


def put_row(A, i, factor, row):
    """Write a factor times a row to row i of a matrix."""
    for c, t in zip(CHUNKS, row, strict=True):
        put_chunk(A, i, c, factor * t)


def noisy_row_at(A, i):
    """Return row i of a matrix with columns for the states with process noise(chunks)."""
    return tuple(load_like(A, NOISY_WIDTH * i + c, lanes_of(EIGHT)) for c in NOISY_CHUNKS)


def put_noisy_row(A, i, factor, row):
    """Write a factor times a row to row i of such a matrix."""
    for c, t in zip(NOISY_CHUNKS, row, strict=True):
        store(A, NOISY_WIDTH * i + c, factor * t)


def gather_noisy_columns(A, B):
    """Write the columns of a matrix (rows of W), of which only rows of states with process noise are not zero, for these states to B."""
    for i in STATES:
        if i in NOISY:
            for c, k in enumerate(NOISY):
                B[NOISY_WIDTH * i + c] = A[W * i + k]
        else:
            for c in NOISY_CHUNKS:
                store(B, NOISY_WIDTH * i + c, lanes_of(EIGHT))


def scatter_noisy_columns(columns, block, P):
    """Write such columns to P on both sides of the diagonal; ``block`` has the rows of the states with process noise."""
    for c, k in enumerate(NOISY):
        for i in STATES:
            if i not in NOISY:
                P[W * i + k] = P[W * k + i] = columns[NOISY_WIDTH * i + c]
        for d, j in enumerate(NOISY):
            P[W * k + j] = block[NOISY_WIDTH * c + d]
