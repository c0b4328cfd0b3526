"""The fixed-interval smoother for any number of error states: Rauch–Tung–Striebel on the manifold, backward over the filter's segments.

The gain is that of :mod:`strapdown.kernels.smoother_step`, where its reasons are: with the process noise of a step referred to its start,
``Q̄ = Φ⁻¹ Q Φ⁻ᵀ``, it is ``G = N Φ⁻¹``, ``N = I − Q̄ (P + Q̄)⁻¹ = P (P + Q̄)⁻¹``, and the covariance is a sum, ``G P_s Gᵀ + N Q̄``, in which
nothing of the size of P is subtracted. A row of N is by the first form, or by the second if the variance of its state is smaller than that
of the noise. The later covariance is transformed to the tangent space at the predicted attitude before the step, and the result to that at
the smoothed attitude after it; so are states that rotate with the attitude.

The functions in ``OPEN`` are those of an instance of :mod:`strapdown.kernels.filter`. Matrices are stored by rows, padded to a multiple of
eight columns.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.filter import (
    apply_transition,
    fill_coefficients,
    fixed_turn,
    gather_noisy_columns,
    minus_row,
    predict_state,
    put_row,
    rotate_vectors,
    row_at,
    rows_of_noisy,
    rows_to_noisy,
    scale_noisy_row,
    scatter_noisy_columns,
    subtract_noisy_row,
    transform,
    turn_attitude,
    turn_vectors,
    write_noise,
    write_transition,
)
from strapdown.kernels.lane_values import WIDTH, load, store
from strapdown.kernels.rotation import inverse_right_jacobian, logarithm, moved, quaternion_multiply
from strapdown.kernels.structure import Model

OPEN = (
    "apply_transition",
    "fill_coefficients",
    "gather_noisy_columns",
    "minus_row",
    "predict_state",
    "put_row",
    "rotate_vectors",
    "row_at",
    "rows_of_noisy",
    "rows_to_noisy",
    "scale_noisy_row",
    "scatter_noisy_columns",
    "subtract_noisy_row",
    "transform",
    "turn_attitude",
    "turn_vectors",
    "write_noise",
    "write_transition",
)
CALLED = ("factorise", "solve", "subtract_products", "load_segment", "gather_small_columns", "clear_rows")


class Models(NamedTuple):
    """Numbers of the model: those of the filter, and those with noise of negative variance."""

    forward: Model
    backward: Model


class Workspace(NamedTuple):
    """State at the end of a segment, and work space, for n states; matrices are by rows, padded, with eight numbers more."""

    x: np.ndarray
    """Filtered state at the start of the segment (n + 1,)."""
    predicted: np.ndarray
    """Predicted state at its end, and a copy that is propagated back (n + 1,)."""
    after: np.ndarray
    later_x: np.ndarray
    """Smoothed state."""
    P: np.ndarray
    """Filtered covariance at the start of the segment; then the Cholesky factor of P + Q̄."""
    Q: np.ndarray
    """Q̄, whose other elements than those of a step are zero."""
    work: np.ndarray
    later_P: np.ndarray
    """Smoothed covariance."""
    gain: np.ndarray
    """(P + Q̄)⁻¹ Q̄, with columns for the states with process noise; −(P + Q̄)⁻¹ P of those whose noise is larger."""
    kept: np.ndarray
    """1 for the columns of the first form, 0 for the others."""
    top: np.ndarray
    """Rows of the attitude of Φ⁻¹ (3 × padded width)."""
    error: np.ndarray
    """Smoothed error relative to the predicted state, then to the filtered one (n,), and as many numbers more."""
    coefficients: np.ndarray
    states: np.ndarray
    """States with process noise."""
    noisy: int
    """Their number."""


class Outputs(NamedTuple):
    """Arrays that the passes write, a row an edge."""

    x: np.ndarray
    """q, b and c (edges, n + 1)."""
    variance: np.ndarray
    covariance: np.ndarray
    """(edges, m, m) for the first m states, or (0, m, m)."""


def load_segment(segments, k, x, P, width):
    """Read state and upper triangle of the covariance of row k of the segments; what is below the diagonal is not defined."""
    n = len(x) - 1
    for i in range(n + 1):
        x[i] = segments[k, 4 + i]
    at = 5 + n + k * segments.shape[1]
    for i in range(n):
        for j in range(i, n, WIDTH):
            store(
                P, width * i + j, load(segments, at + j - i)
            )  # the excess is in the next row, which is written after it
        at += n - i


def mirror(P, n, width):
    """Copy the upper triangle of a matrix to the lower one."""
    for i in range(n):
        for j in range(i + 1, n):
            P[width * j + i] = P[width * i + j]


def factorise(A, n, width):
    """Replace the upper triangle of A by its Cholesky factor U, ``A = Uᵀ U``; the diagonal holds the reciprocals of U's."""
    for i in range(n):
        row = row_at(A, i)
        for k in range(i):
            row = minus_row(row, A[width * k + i], row_at(A, k))
        put_row(A, i, 1.0, row)
        inverted = 1.0 / math.sqrt(A[width * i + i])
        put_row(A, i, inverted, row)
        A[width * i + i] = inverted


def solve(U, B, n, width):
    """Replace B, with columns for the states with process noise, by the solution X of ``Uᵀ U X = B``.

    Each row of X is subtracted from the others as soon as it is known: these do not wait for each other, as terms of a sum would.
    """
    for i in range(n):
        row = scale_noisy_row(B, i, U[width * i + i])
        for k in range(i + 1, n):
            subtract_noisy_row(B, k, U[width * i + k], row)
    for i in range(n - 1, -1, -1):
        row = scale_noisy_row(B, i, U[width * i + i])
        for k in range(i - 1, -1, -1):
            subtract_noisy_row(B, k, U[width * k + i], row)


def subtract_products(gain, A, B, n, noisy):
    """Subtract gainᵀ A from B, which has a row for each of the ``noisy`` states with process noise; three rows at once."""
    width = len(gain) // n
    for r in range(0, noisy, 3):
        s, t = min(r + 1, noisy - 1), min(r + 2, noisy - 1)
        first, second, third = row_at(B, r), row_at(B, s), row_at(B, t)
        for k in range(n):
            row = row_at(A, k)
            first = minus_row(first, gain[width * k + r], row)
            second = minus_row(second, gain[width * k + s], row)
            third = minus_row(third, gain[width * k + t], row)
        put_row(B, r, 1.0, first)
        put_row(B, s, 1.0, second)
        put_row(B, t, 1.0, third)


def step_back(segments, k, models, space):
    """Propagate the smoothed state from the end of segment k back to its start.

    A step back in time has the transition Φ⁻¹ and, for noise of negative variance, the process noise Q̄ = Φ⁻¹ Q Φ⁻ᵀ.
    """
    x, predicted, after = space.x, space.predicted, space.after
    P, Q, gain, kept, work = space.P, space.Q, space.gain, space.kept, space.work
    later_x, later_P, error, coefficients = space.later_x, space.later_P, space.error, space.coefficients
    n, width, noisy = len(x) - 1, len(space.top) // 3, space.noisy
    load_segment(segments, k, x, P, width)
    dt = segments[k, 0]
    part, back = (segments[k, 1], segments[k, 2], segments[k, 3]), (-segments[k, 1], -segments[k, 2], -segments[k, 3])
    for i in range(n + 1):
        predicted[i] = x[i]
    fill_coefficients(coefficients, dt, models.forward)
    predict_state(predicted, part, dt, models.forward, coefficients, 0.0)
    relative_error(predicted, later_x, later_P, error)
    fill_coefficients(coefficients, -dt, models.backward)
    write_transition(predicted, back, -dt, models.backward, coefficients, space.top, 0.0)
    apply_error(error, space.top, coefficients)
    write_noise(predicted, Q, back, -dt, models.backward, coefficients, 0.0)
    copy_state(predicted, after)
    transform(after, later_P, back, -dt, models.backward, coefficients, 0.0)
    gather_noisy_columns(Q, gain)
    small = gather_small_columns(P, Q, gain, kept, space.states, n, width)
    for i in range(0, n * width, WIDTH):
        store(P, i, load(P, i) + load(Q, i))
    factorise(P, n, width)
    solve(P, gain, n, width)
    reduce_error(error, gain, kept, space.states, n)
    # N (Y Nᵀ + Q̄), Y the later covariance at the start: only rows and columns of states with noise differ from those of Y.
    rows_of_noisy(later_P, work)
    if small:
        clear_rows(work, kept, width)
    subtract_products(gain, later_P, work, n, noisy)
    scatter_noisy_columns(work, later_P)
    for i in range(0, n * width, WIDTH):
        store(later_P, i, load(later_P, i) + load(Q, i))
    rows_of_noisy(later_P, work)
    if small:
        clear_rows(work, kept, width)
    subtract_products(gain, later_P, work, n, noisy)
    rows_to_noisy(work, later_P)
    correct_filtered(x, error, later_x, later_P)


def copy_state(x, y):
    """Copy a state to y."""
    for i in range(len(x)):
        y[i] = x[i]


def apply_error(error, top, coefficients):
    """Apply the transition to an error."""
    apply_transition(error, top, coefficients, 0.0)


def gather_small_columns(P, Q, gain, kept, states, n, width):
    """Write columns of −P, of its upper triangle, for the states whose variance is below their noise's; return whether there are any."""
    columns, small = len(gain) // n, False
    for r in range(len(states)):
        k = states[r]
        kept[r] = 1.0
        if P[width * k + k] < Q[width * k + k]:
            kept[r] = 0.0
            small = True
            for i in range(n):
                gain[columns * i + r] = -P[width * min(i, k) + max(i, k)]
    return small


def clear_rows(A, kept, width):
    """Set the rows of these states to zero."""
    for r in range(len(kept)):
        for c in range(width):
            A[width * r + c] *= kept[r]


def reduce_error(error, gain, kept, states, n):
    """Replace the error by N times it; ``states`` are those with process noise."""
    width = len(gain) // n
    for r in range(len(states)):
        t = 0.0
        for k in range(n):
            t += gain[width * k + r] * error[k]
        error[n + r] = kept[r] * error[states[r]] - t
    for r in range(len(states)):
        error[states[r]] = error[n + r]


def relative_error(predicted, later_x, later_P, error):
    """Write the smoothed error relative to the predicted state, and transform the smoothed covariance to the tangent space there.

    exp(a) ⊗ exp(ε) = exp(a + J_r(a)⁻¹ ε).
    """
    q = (predicted[0], predicted[1], predicted[2], predicted[3])
    later_q = (later_x[0], later_x[1], later_x[2], later_x[3])
    a = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), later_q))
    turn_attitude(later_P, inverse_right_jacobian(a))
    A = fixed_turn(later_q, q)
    rotate_vectors(later_x, 1, A)
    turn_vectors(later_P, A)
    error[0], error[1], error[2] = a
    for i in range(3, len(later_x) - 1):
        error[i] = later_x[1 + i] - predicted[1 + i]


def correct_filtered(x, error, later_x, later_P):
    """Write the filtered state corrected by the error, and transform the covariance to the tangent space there."""
    q = (x[0], x[1], x[2], x[3])
    new_q, J = moved(q, (error[0], error[1], error[2]))
    for i, value in enumerate(new_q):
        later_x[i] = value
    for i in range(3, len(x) - 1):
        later_x[1 + i] = x[1 + i] + error[i]
    turn_attitude(later_P, J)
    A = fixed_turn(q, new_q)
    rotate_vectors(later_x, 1, A)
    turn_vectors(later_P, A)


def smooth_back(segments, starts, first, models, space, out):
    """Go back from the filtered state at the last edge to edge ``first``, and write all between.

    Parameters
    ----------
    segments : array (rows, numbers)
        The filter's predictions, the last row the end state.
    starts : array (edges,)
        Row that starts at each edge.
    first : int
    models : Models
    space : Workspace
    out : Outputs
    """
    n = len(space.x) - 1
    width = len(space.top) // 3
    edge = len(starts) - 1
    s = starts[edge]
    load_segment(segments, s, space.later_x, space.later_P, width)
    mirror(space.later_P, n, width)
    while True:
        while edge >= first and starts[edge] == s:
            write_smoothed(out, edge, space.later_x, space.later_P, n, width)
            edge -= 1
        if edge < first:
            break
        s -= 1
        step_back(segments, s, models, space)


def write_smoothed(out, edge, x, P, n, width):
    """Write a smoothed state to the row of an edge; of the covariance the mean of both triangles."""
    for i in range(n + 1):
        out.x[edge, i] = x[i]
    for i in range(n):
        out.variance[edge, i] = P[width * i + i]
    if edge < len(out.covariance):
        for i in range(out.covariance.shape[1]):
            for j in range(i, out.covariance.shape[2]):
                value = 0.5 * (P[width * i + j] + P[width * j + i])
                out.covariance[edge, i, j] = value
                out.covariance[edge, j, i] = value
