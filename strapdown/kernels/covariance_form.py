"""The multiplicative EKF of attitude and gyro bias with its covariance in blocks: the fast body of :mod:`strapdown.kernels.walk`.

The first functions are the filter without options, whose state stays in registers. Those under *for the gate* let
:mod:`strapdown.kernels.gate` wrap it.

A covariance in double precision has sixteen digits. If a measurement is much more precise than the state, or attitude and bias errors are
almost fully correlated after an outage, too few are left (Bierman 1977, chapter V): the walk stops, and :mod:`strapdown.kernels.root_form`
continues.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    add,
    combine,
    congruent,
    dot,
    full,
    matrix_times_vector,
    minus_outer,
    multiply,
    scale,
    symmetric_minus_outer,
    symmetric_times_vector,
    transpose_times_vector,
)
from strapdown.kernels.filter_step import predict as propagated
from strapdown.kernels.filter_step import update_attitude, update_direction, update_heading, update_row
from strapdown.kernels.gate_rules import (
    FIRST_BIAS,
    count_widening,
    may_widen,
    reset_candidate,
    restart_attitude,
    restart_width,
    start_undone,
)
from strapdown.kernels.iterated_update import arc_over_chord, seen_from
from strapdown.kernels.measurement import (
    ATTITUDE,
    DIRECTION,
    HEADING,
    KIND,
    VECTOR,
    frame_of,
    has_heading,
    heading_error,
    heading_row,
    independent_rows,
    measurement_rows,
    sigma_of,
    value_of,
)
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix
from strapdown.kernels.state import SIZE, keep_state, load_state, store_state
from strapdown.kernels.walk import step_within, turn_squared

CALLED = ("least_share",)


class Body(NamedTuple):
    """State, noise and numerical limits of the filter."""

    states: np.ndarray
    """Packed states (2, 28): the filter and the restart candidate of a gate; at return, the end state."""
    angle_variance: float
    """σ_v², rad²/s."""
    rate_variance: float
    """σ_u², rad²/s³."""
    sharpness: float
    """Maximum ratio of innovation variance to measurement variance; above it the covariance keeps too few digits."""
    least_share: float
    """Minimum of :func:`least_share`, for the same reason."""
    check: int
    """Number of output rows between checks of the covariance."""
    good: np.ndarray
    """Row and number of measurements at the last check passed (2,); if the walk stopped, ``states[0]`` is the state there."""
    work: np.ndarray
    """Scratch (7, 6)."""


class Restart(NamedTuple):
    """Initial values of a restart candidate."""

    bias_variance: np.ndarray
    """Added to the bias's variance (3,), (rad/s)²."""


class Outputs(NamedTuple):
    """Output arrays: a row for each stored edge (m); innovations by measurement."""

    attitude: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    """Blocks A, B, C (m, 21), or (0, 21)."""
    innovation: np.ndarray
    """e₁, s₁, e₂, s₂, e₃, s₃ (events, 4 or 6): independent innovations and their variances, as many as there are degrees of freedom."""
    segments: np.ndarray
    """Each prediction, for a smoother (k, 32), or (0, 32): dt, increment (3), state before it (28)."""


def least_share(state, work):
    """Return the smallest ratio of a state's variance given the states after it to its variance; 1 for a state without variance.

    It is the squared diagonal of the triangular factor over the variance. If the covariance has lost its digits, it is at the level of
    rounding or negative. ``state`` holds (q, b, A, B, C), ``work`` (7, 6) is scratch.
    """
    k = 0
    for i in range(3):
        for j in range(i, 3):
            work[i, j] = state[7 + k]
            work[3 + i, 3 + j] = state[22 + k]
            k += 1
        for j in range(3):
            work[i, 3 + j] = state[13 + 3 * i + j]
    for j in range(6):
        work[6, j] = work[j, j]
    least = 1.0
    for j in range(5, -1, -1):
        pivot = work[j, j]
        if work[6, j] == 0.0:
            continue
        share = pivot / work[6, j]
        if not share >= least:
            least = share
        if not share > 0.0:
            return share
        for i in range(j):
            factor = work[i, j] / pivot
            for c in range(i, j):
                work[i, c] -= factor * work[c, j]
    return least


def store_segment(out, k, dt, part, q, b, A, B, C):
    """Write row k of the segments: dt, increment, state."""
    out[k, 0] = dt
    out[k, 1], out[k, 2], out[k, 3] = part
    store_state(out[k, 4:], q, b, A, B, C)


# ------------------------------------------------------------------------------------------------------------ the filter without options


def begin(body):
    """Return (q, b, A, B, C), the number of segments, and whether the covariance has lost its digits."""
    q, b, A, B, C = load_state(body.states[0])
    body.good[0] = 0
    body.good[1] = 0
    # From an array, and not the literal 0: numba would compile the body for that type too.
    segments = body.good[0]
    return q, b, A, B, C, segments, not least_share(body.states[0], body.work) >= body.least_share


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return step_within(turn_squared(part, dt, state[1]), dt)


def predict(state, part, dt, body, out):
    """Store the prediction for a smoother, and propagate."""
    q, b, A, B, C, segments, lost = state
    if segments < len(out.segments):
        store_segment(out.segments, segments, dt, part, q, b, A, B, C)
        segments += 1
    q, A, B, C = propagated(q, b, A, B, C, part, dt, body.angle_variance, body.rate_variance)
    return q, b, A, B, C, segments, lost


def update(state, e, now, measured, body, out):
    """Update with a measurement whose noise is isotropic, or of an attitude one variance an axis."""
    q, b, A, B, C, segments, lost = state
    R = rotation_matrix(q)
    at = measured.place[e]
    s = measured.sensor[e]
    kind = measured.series[s, KIND]
    frame = frame_of(measured, at, s)
    z = value_of(measured, at, s)
    sigma = sigma_of(measured, at, s)
    variance = sigma * sigma
    if kind == ATTITUDE:
        q, b, A, B, C, e1, s1, e2, s2, e3, s3 = update_attitude(q, b, A, B, C, frame[:4], z)
        out.innovation[at, 4] = e3
        out.innovation[at, 5] = s3
        sharp = s1 > body.sharpness * z[0] or s2 > body.sharpness * z[1] or s3 > body.sharpness * z[2]
    elif kind != HEADING:
        if kind == VECTOR:
            # The length has no information about the attitude but is part of the innovation.
            out.innovation[at, 4] = dot(transpose_times_vector(R, frame[6:]), z) - 1.0
            out.innovation[at, 5] = variance
        q, b, A, B, C, e1, s1, e2, s2 = update_direction(q, b, A, B, C, R, frame[:3], frame[3:6], z, variance)
        sharp = s1 + s2 > body.sharpness * variance
    else:
        e1, s1, e2, s2 = math.nan, 0.0, 0.0, 1.0
        if has_heading(R, z):
            error = heading_error(R, z, frame[6:])
            q, b, A, B, C, e1, s1 = update_heading(q, b, A, B, C, heading_row(R, z), error, variance)
        sharp = s1 > body.sharpness * variance
    out.innovation[at, 0] = e1
    out.innovation[at, 1] = s1
    out.innovation[at, 2] = e2
    out.innovation[at, 3] = s2
    return q, b, A, B, C, segments, lost or sharp


def keep(state, row, e, body, out):
    """Write a row; every ``check`` rows, check that the covariance has enough digits, and store the state."""
    q, b, A, B, C, segments, lost = state
    keep_state(out, row, q, b, A, B, C)
    if row > 0 and row % body.check == 0:
        lost = checked(q, b, A, B, C, row, e, body)
    return q, b, A, B, C, segments, lost


def checked(q, b, A, B, C, row, e, body):
    """Return whether the covariance of a state has lost its digits; if not, store the state as the last good one."""
    store_state(body.states[1], q, b, A, B, C)
    if not least_share(body.states[1], body.work) >= body.least_share:
        return True
    store_state(body.states[0], q, b, A, B, C)
    body.good[0] = row
    body.good[1] = e
    return False


def stopped(state):
    """Return whether the covariance has lost its digits."""
    return state[6]


def finish(state, row, e, body):
    """Store the end state and return the number of segments; −1: the covariance has lost its digits."""
    q, b, A, B, C, segments, lost = state
    if lost or checked(q, b, A, B, C, row, e, body):
        return -1
    return segments


# -------------------------------------------------------------------------------------------------------------------------- for the gate


def load(form, i):
    """Return state i: (q, b, A, B, C)."""
    return load_state(form.states[i])


def save(form, i, state):
    """Store state i."""
    q, b, A, B, C = state
    store_state(form.states[i], q, b, A, B, C)


def become(form):
    """Replace the filter by the restart candidate."""
    for j in range(SIZE):
        form.states[0, j] = form.states[1, j]


def attitude_of(state):
    """Return q_fb of a state."""
    return state[0]


def bias_at(form, i):
    """Return the gyro bias of state i."""
    s = form.states
    return (s[i, 4], s[i, 5], s[i, 6])


def step_limit(form):
    """Return the longest step, s, allowed by states other than the attitude."""
    return math.inf


def digits_left(form, i):
    """Return :func:`least_share` of state i."""
    return least_share(form.states[i], form.work)


def propagate(form, i, state, part, dt):
    """Return a state after an increment over dt."""
    q, b, A, B, C = state
    q, A, B, C = propagated(q, b, A, B, C, part, dt, form.angle_variance, form.rate_variance)
    return q, b, A, B, C


def store_prediction(form, i, state, k, part, dt, out):
    """Store a prediction for a smoother."""
    q, b, A, B, C = state
    store_segment(out.segments, k, dt, part, q, b, A, B, C)


def attitude_covariance(form, i, state):
    """Return the covariance of the attitude (6-tuple)."""
    return state[2]


def start_update(form, i):
    """Start the linearisation at the state."""


def linearised(form, i, e, now_q, q, M, z, frame, noise, kind, sensor, prior):
    """Return rows, y (3,), its prediction by the prior (3,), variances (3,), and θ/sin θ and cos θ of a direction's angle, all at now_q.

    The rows (h1, h2, h3) are transformed to the tangent space of the prior by Mᵀ.
    """
    R = rotation_matrix(now_q)
    h1, h2, h3, y1, y2, y3, covariance = measurement_rows(kind, now_q, R, z, frame, noise)
    far, along = 1.0, 1.0
    if kind in (DIRECTION, VECTOR):
        along = dot(transpose_times_vector(R, frame[6:]), z)
        far = arc_over_chord(math.sqrt(y1 * y1 + y2 * y2), along)
    h1, h2, h3, y1, y2, y3, variance = independent_rows(h1, h2, h3, y1, y2, y3, covariance)
    predicted = (dot(h1, prior), dot(h2, prior), dot(h3, prior))
    rows = (transpose_times_vector(M, h1), transpose_times_vector(M, h2), transpose_times_vector(M, h3))
    return rows, (y1, y2, y3), predicted, variance, far, along


def innovation_covariance(form, i, state, rows):
    """Return H P Hᵀ (6-tuple)."""
    h1, h2, h3 = rows
    A = state[2]
    p1 = symmetric_times_vector(A, h1)
    p2 = symmetric_times_vector(A, h2)
    p3 = symmetric_times_vector(A, h3)
    return (dot(h1, p1), dot(h1, p2), dot(h1, p3), dot(h2, p2), dot(h2, p3), dot(h3, p3))


def step_of(form, i, state, rows, u, M, prior, q, now_q):
    """Return the step (3,) from the linearisation given by P Hᵀ u, and its squared size as seen by the rows."""
    h1, h2, h3 = rows
    back = add(combine(u[0], h1, u[1], h2), scale(u[2], h3))
    step = add(prior, matrix_times_vector(M, symmetric_times_vector(state[2], back)))
    return step, dot(step, step)


def relinearise(form, i, q, old_q, now_q, prior, fresh):
    """Change the point of linearisation."""


def correct(form, i, state, rows, e, variance):
    """Update with three independent rows of innovations e (3,), prior's tangent space; return the state and the attitude's correction."""
    q, b, A, B, C = state
    h1, h2, h3 = rows
    first, b, A, B, C, _ = update_row(b, A, B, C, h1, e[0], variance[0])
    second, b, A, B, C, _ = update_row(b, A, B, C, h2, e[1] - dot(h2, first), variance[1])
    taken = add(first, second)
    third, b, A, B, C, _ = update_row(b, A, B, C, h3, e[2] - dot(h3, taken), variance[2])
    return (q, b, A, B, C), add(taken, third)


def turn_tangent(form, i, state, M):
    """Transform the covariance to another tangent space by M."""
    q, b, A, B, C = state
    return q, b, congruent(M, A), multiply(M, B), C


def set_attitude(form, i, state, q, before):
    """Return the state with the attitude q in place of ``before``."""
    return q, state[1], state[2], state[3], state[4]


def keep_row(form, state, row, out):
    """Write the state at a stored edge."""
    q, b, A, B, C = state
    keep_state(out, row, q, b, A, B, C)


def start_candidate(form, memory, now, attitude_sigma, restart):
    """Write row 1: the state of the filter with an initial covariance; ``restart.bias_variance`` (3,) is added to that of the bias.

    Both increase with the number of candidates before it.
    """
    states, bias_variance = form.states, restart.bias_variance
    sigma = restart_attitude(attitude_sigma, memory)
    width = restart_width(memory)
    for i in range(SIZE):
        states[1, i] = states[0, i]
    for i in range(7, 22):
        states[1, i] = 0.0
    for i in (7, 10, 12):
        states[1, i] = sigma * sigma
    states[1, 22] += width * width * bias_variance[0]
    states[1, 25] += width * width * bias_variance[1]
    states[1, 27] += width * width * bias_variance[2]
    reset_candidate(memory, now, bias_at(form, 1), (states[1, 22], states[1, 25], states[1, 27]))


def widen(form, memory):
    """Increase the initial bias variance of the candidate retroactively, if that start still determines its bias."""
    q, b, A, B, C = load_state(form.states[1])
    if not may_widen((C[0], C[3], C[5]), memory):
        return
    turn = (0.0, 0.0, 0.0)
    for i in range(3):
        P = full(C)
        pa = (B[i], B[3 + i], B[6 + i])
        pb = (P[i], P[3 + i], P[6 + i])
        inverse = start_undone(i, P[4 * i], memory)
        ka = scale(inverse, pa)
        kb = scale(inverse, pb)
        innovation = memory[FIRST_BIAS + i] - b[i]
        turn = combine(1.0, turn, innovation, ka)
        b = combine(1.0, b, innovation, kb)
        A = symmetric_minus_outer(A, ka, pa)
        B = minus_outer(B, ka, pb)
        C = symmetric_minus_outer(C, kb, pb)
    q, A, B = corrected(q, A, B, turn)
    store_state(form.states[1], q, b, A, B, C)
    count_widening(memory)


def corrected(q, A, B, correction):
    """Return q, A and B after a correction (3,), rad, as in :func:`strapdown.kernels.iterated_update.seen_from`."""
    turn, M = seen_from(correction, A)
    return quaternion_multiply(q, turn), congruent(M, A), multiply(M, B)
