"""The multiplicative EKF of N error states, run by :mod:`strapdown.kernels.walk`.

- ``layout``: arrays of state, covariance and work space, for one run or several in lanes;
- ``model``: Φ, Q and the prediction;
- ``rows``: rows of measurements of every kind;
- ``update``: gains, corrections and the reset to the new tangent space;
- here: the walk's functions, and what they store.
"""

from __future__ import annotations

from strapdown.kernels.lane_values import lanes_of, load_like, store
from strapdown.kernels.layout import EIGHT, STRUCTURE, N, W, bias_at, element_at
from strapdown.kernels.measurement import vector_at
from strapdown.kernels.model import propagate
from strapdown.kernels.structure import Progress
from strapdown.kernels.update import take
from strapdown.kernels.walk import step_within, turn_squared


def begin(body):
    """Return the state of the walk before the first measurement."""
    # From an array, and not the literal 0: numba would compile the body for that type too.
    return Progress(0 * len(body.length), len(body.length) < 0)


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return min(step_within(turn_squared(part, dt, bias_at(body, 0)), dt), body.model.limit)


def increment_over(increments, k, body):
    """Return the increment of interval k, zero for the interval before the first edge; set the change of temperature in the interval."""
    if k < 0:
        return (0.0, 0.0, 0.0)
    if STRUCTURE.slopes:
        body.warming_now[0] = body.warming[k]
    return vector_at(increments, k)


def predict(state, part, dt, body, out):
    """Store the prediction for a smoother, and propagate."""
    segments = state.segments
    if segments < len(out.segments):
        store_segment(out.segments, segments, dt, part, body.x[0], body.P[0])
        segments += 1
    propagate(body, 0, part, dt, 0.0)
    return Progress(segments, state.lost)


def update(state, e, now, measured, body, out):
    """Update with a measurement."""
    lost = take(body.shape[measured.sensor[e]], body, measured, e, out.innovation, 0.0)
    return Progress(state.segments, state.lost or lost)


def keep(state, row, e, body, out):
    """Write a row."""
    write_row(body, row, out)
    return state


def stopped(state):
    """Return whether a measurement was too precise for double precision."""
    return state.lost


def finish(state, row, e, body):
    """Return the number of segments; −1: a measurement was too precise."""
    return -1 if state.lost else state.segments


def store_segment(out, k, dt, part, x, P):
    """Write row k of the segments: dt, increment (3), x, and the upper triangle of P by rows, with seven unused numbers at the end."""
    out[k, 0] = dt
    out[k, 1], out[k, 2], out[k, 3] = part
    at = 4 + k * out.shape[1]
    eight = lanes_of(EIGHT)
    for i in range(0, N + 1, 8):  # the next row overwrites the excess
        store(out, at + i, load_like(x, i, eight))
    at += N + 1
    for i in range(N):
        for c in range(i, N, 8):
            store(out, at + c - i, load_like(P, W * i + c, eight))
        at += N - i


def write_row(body, row, out):
    """Write the state of the filter to a row of the outputs, with covariances and the whole bias if these are requested."""
    x, P = body.x[0], body.P[0]
    for i in range(N + 1):
        out.x[row, i] = x[i]
    for i in range(N):
        out.variance[row, i] = P[W * i + i]
    if row < len(out.covariance):
        for i in range(out.covariance.shape[1]):
            for j in range(out.covariance.shape[2]):
                out.covariance[row, i, j] = P[W * i + j]
    if row < len(out.whole_variance):
        write_whole_bias(P, body.offsets, row, out)


def write_whole_bias(P, offsets, row, out):
    """Write variances and, if requested, covariance of attitude and whole gyro bias."""
    for a in range(6):
        for b in range(a, 6):
            s = whole_element(P, offsets, a, b, 0.0)
            if a == b:
                out.whole_variance[row, a] = s
            if row < len(out.whole_covariance):
                out.whole_covariance[row, a, b] = s
                out.whole_covariance[row, b, a] = s


def whole_element(P, offsets, a, b, like):
    """Return an element, a ≤ b, of the covariance of attitude and *whole* gyro bias, ``b + Σ c e`` over the states that are an offset."""
    s = element_at(P, a, b, like)
    for k in range(N - 6):
        if b >= 3:
            s = s + offsets[k, b - 3] * element_at(P, a, 6 + k, like)
        if a >= 3:
            s = s + offsets[k, a - 3] * element_at(P, b, 6 + k, like)
            for j in range(N - 6):
                s = s + offsets[k, a - 3] * offsets[j, b - 3] * element_at(P, 6 + k, 6 + j, like)
    return s
