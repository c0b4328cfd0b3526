"""A weighted set of attitude filters, until their mixture is close to one Gaussian: a body of :mod:`strapdown.kernels.walk`.

Each hypothesis is the filter of :mod:`strapdown.kernels.filter_step` with two changes for a large covariance. Directions are processed by
an iterated update (Gauss–Newton), so row and likelihood are those at the updated attitude. A correction a transforms the covariance by
``exp(−[a])`` instead of J_r(a): its axes remain constant in the *fixed* frame (right-invariant error), so the variance of the rotation
about a constant reference is unchanged by its measurements.
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
    matrix_times_vector,
    multiply,
    scale,
    skew_polynomial,
    subtract,
    symmetric_times_vector,
)
from strapdown.kernels.filter_step import predict as propagated
from strapdown.kernels.filter_step import update_attitude, update_heading, update_row
from strapdown.kernels.gate import Options
from strapdown.kernels.iterated_update import HUBER, STUDENT
from strapdown.kernels.measurement import (
    ATTITUDE,
    HEADING,
    KIND,
    VECTOR,
    degrees_of_freedom,
    direction_rows,
    frame_of,
    heading_error,
    heading_row,
    measurement_rows,
    quaternion_at,
    sigma_of,
    value_of,
    vector_at,
)
from strapdown.kernels.rotation import (
    inverse_right_jacobian,
    logarithm,
    moved,
    quaternion_multiply,
    rotation_matrix,
    turned,
    unit,
)
from strapdown.kernels.series import second, sinc
from strapdown.kernels.state import load_state, store_row, store_state
from strapdown.kernels.walk import step_within, turn_squared

CALLED = ("updated", "moment_match", "normalized_weights")

PASSES = 5
"""Maximum number of Gauss–Newton iterations of an update."""
MIN_STEP = 1e-6
"""Squared step, rad², below which the iteration ends."""
NEVER = -1
LOST = -2
"""Values in place of the edge of convergence: not converged; lost, as successive measurements were refused by more than half the weight."""


def update_iterated(q, b, A, B, C, u, v, z, variance):
    """Update with a unit direction ``z`` (body), its reference r = u × v, by Gauss–Newton iteration.

    The point of linearisation q converges to the most probable attitude. At each point the prior has the mean ``m`` (body axes of that
    point) and the covariance transformed to it. Returns (q, b, A, B, C) and both innovations with their variances.
    """
    m = (0.0, 0.0, 0.0)
    e1 = e2 = s1 = s2 = 1.0
    A_new, B_new, C_new, b_new = A, B, C, b
    for _ in range(PASSES):
        h1, y1, h2, y2 = direction_rows(rotation_matrix(q), u, v, z)
        e1 = y1 - dot(h1, m)
        first, b_new, A_new, B_new, C_new, s1 = update_row(b, A, B, C, h1, e1, variance)
        e2 = y2 - dot(h2, m) - dot(h2, first)
        last, b_new, A_new, B_new, C_new, s2 = update_row(b_new, A_new, B_new, C_new, h2, e2, variance)
        step = add(m, add(first, last))
        squared = dot(step, step)
        turn = skew_polynomial(1.0, -sinc(squared), second(squared), step)
        q = unit(turned(q, step))
        A = congruent(turn, A)
        B = multiply(turn, B)
        A_new = congruent(turn, A_new)
        B_new = multiply(turn, B_new)
        m = matrix_times_vector(turn, subtract(m, step))
        if squared < MIN_STEP:
            break
    return q, b_new, A_new, B_new, C_new, e1, s1, e2, s2


def updated(kind, q, b, A, B, C, z, frame, variance, weight):
    """Update with one measurement of any kind, its variance divided by ``weight``.

    ``frame`` is the row of the triads. Returns (q, b, A, B, C), the innovations with their variances (e₁, s₁, e₂, s₂, e₃, s₃), padded by
    (0, 1), and the two parts of the mean square of the residual after the update over the undivided noise variance R: rᵀR⁻¹r and
    tr R⁻¹HP⁺Hᵀ.
    """
    e1, s1, e2, s2, e3, s3 = 0.0, 1.0, 0.0, 1.0, 0.0, 1.0
    if kind == ATTITUDE:
        q, b, A, B, C, e1, s1, e2, s2, e3, s3 = update_attitude(q, b, A, B, C, frame[:4], scale(1.0 / weight, z))
    elif kind == HEADING:
        R = rotation_matrix(q)
        error = heading_error(R, z, frame[6:])
        q, b, A, B, C, e1, s1 = update_heading(q, b, A, B, C, heading_row(R, z), error, variance / weight)
    else:
        q, b, A, B, C, e1, s1, e2, s2 = update_iterated(q, b, A, B, C, frame[:3], frame[3:6], z, variance / weight)
    h1, h2, _, y1, y2, y3, _ = measurement_rows(kind, q, rotation_matrix(q), z, frame, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    if kind == ATTITUDE:
        distance = y1 * y1 / z[0] + y2 * y2 / z[1] + y3 * y3 / z[2]
        spread = A[0] / z[0] + A[3] / z[1] + A[5] / z[2]
    else:
        distance = (y1 * y1 + y2 * y2) / variance + y3 * y3 / variance
        spread = (dot(h1, symmetric_times_vector(A, h1)) + dot(h2, symmetric_times_vector(A, h2))) / variance
    if kind == VECTOR:
        e3, s3 = y3, variance / weight  # the length has no information about the attitude but is part of the innovation
    return q, b, A, B, C, e1, s1, e2, s2, e3, s3, distance, spread


def heavy_tailed(robust, parameter, numerator, nis):
    """Return the term that replaces the NIS in −2 log likelihood for a robust update: Huber's function, or that of Student's t."""
    if robust == STUDENT:
        return numerator * math.log(1.0 + nis / parameter)
    if robust == HUBER and nis > parameter:
        return 2.0 * math.sqrt(parameter * nis) - parameter
    return nis


def mean_attitude(states, weight):
    """Return the weighted mean attitude, Σ w Log(q̄⁻¹ ⊗ q_i) = 0, nearest to the hypothesis of the largest weight."""
    heaviest = 0
    for i in range(len(weight)):
        if weight[i] > weight[heaviest]:
            heaviest = i
    q = quaternion_at(states, heaviest)
    for _ in range(20):
        shift = (0.0, 0.0, 0.0)
        for i in range(len(weight)):
            if weight[i] > 0.0:
                d = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), quaternion_at(states, i)))
                shift = combine(1.0, shift, weight[i], d)
        q, _ = moved(q, shift)
        q = unit(q)
        if dot(shift, shift) < 1e-24:
            break
    return q


def moment_match(states, weight, between, out):
    """Write the first two moments of the mixture to ``out`` (28,), and the covariance between its members to ``between`` (12,).

    Relative to the mean (q̄, b̄) a member is at d_i = Log(q̄⁻¹ ⊗ q_i), b_i − b̄; its covariance is transformed by G_i = J_r⁻¹(d_i):
    ``P = Σ w_i (G_i P_i G_iᵀ + d_i d_iᵀ)``. ``between`` holds the attitude and bias blocks of the second term.
    """
    q = mean_attitude(states, weight)
    mean = (0.0, 0.0, 0.0)
    for i in range(len(weight)):
        if weight[i] > 0.0:
            mean = combine(1.0, mean, weight[i], vector_at(states[:, 4:], i))
    for n in range(12):
        between[n] = 0.0
    for n in range(28):
        out[n] = 0.0
    out[0], out[1], out[2], out[3] = q
    out[4], out[5], out[6] = mean
    for i in range(len(weight)):
        w = weight[i]
        if w > 0.0:
            own, b, A, B, C = load_state(states[i])
            d = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), own))
            e = subtract(b, mean)
            G = inverse_right_jacobian(d)
            A = congruent(G, A)
            B = multiply(G, B)
            k = 0
            for r in range(3):
                for c in range(r, 3):
                    between[k] += w * d[r] * d[c]
                    between[6 + k] += w * e[r] * e[c]
                    out[7 + k] += w * (A[k] + d[r] * d[c])
                    out[22 + k] += w * (C[k] + e[r] * e[c])
                    k += 1
                for c in range(3):
                    out[13 + 3 * r + c] += w * (B[3 * r + c] + d[r] * e[c])


def share_between(total, part):
    """Return tr(T⁻¹ S) for symmetric T > 0 and S: the fraction of a covariance due to differences between members, summed over the axes.

    By the Cholesky factor T = L Lᵀ, a column of L⁻¹ at a time: the standard deviations of T may differ by a factor of 1e5.
    """
    a = math.sqrt(total[0])
    b, c = total[1] / a, total[2] / a
    d = math.sqrt(total[3] - b * b)
    e = (total[4] - b * c) / d
    f = math.sqrt(total[5] - c * c - e * e)
    # Rows of L⁻¹, each then w S wᵀ.
    x = (1.0 / a, 0.0, 0.0)
    y = (-b / (a * d), 1.0 / d, 0.0)
    z = ((b * e - c * d) / (a * d * f), -e / (d * f), 1.0 / f)
    S = (part[0], part[1], part[2], part[3], part[4], part[5])
    return (
        dot(x, symmetric_times_vector(S, x))
        + dot(y, symmetric_times_vector(S, y))
        + dot(z, symmetric_times_vector(S, z))
    )


def normalized_weights(log_weight, least, weight):
    """Write normalised weights, permanently 0 below ``least``; return the value subtracted from each logarithm to make the largest 0."""
    best = -math.inf
    for i in range(len(log_weight)):
        best = max(best, log_weight[i])
    total = 0.0
    for i in range(len(log_weight)):
        relative = math.exp(log_weight[i] - best)
        if relative < least:
            log_weight[i] = -math.inf
            relative = 0.0
        else:
            log_weight[i] -= best
        weight[i] = relative
        total += relative
    for i in range(len(log_weight)):
        weight[i] /= total
    return best


class Body(NamedTuple):
    """Hypotheses and options.

    Further sets of hypotheses, of zero weight at first, may start from the measurements ``later``, each from one of them, in case earlier
    measurements are outliers. At its measurement, a set is given the weight that the earlier sets would have if they had refused all
    directions until then at a NIS of ``charge``. Hypotheses are not merged before the first of these measurements.
    """

    angle_variance: float
    """σ_v², rad²/s."""
    rate_variance: float
    """σ_u², rad²/s³."""
    states: np.ndarray
    """(h, 28); after convergence, row 0 is the merged Gaussian."""
    log_weight: np.ndarray
    """(h,), as ``weight``; at return, the final values."""
    weight: np.ndarray
    later: np.ndarray
    """Measurements at which further sets start (k,), counted from the first of the walk."""
    sets: np.ndarray
    """First hypothesis of each further set, and the total number of hypotheses (k + 1,)."""
    charge: float
    options: Options
    """Gate and robust weights. ``recovery``: consecutive refusals by more than half the weight after which all are lost; 0: never."""
    min_weight: float
    """Minimum weight relative to the largest; hypotheses below it are dropped."""
    max_share: float
    """Maximum fraction of the covariance of attitude and of bias due to differences between hypotheses, below which these are merged."""
    first_edge: int
    """Index in the record of the first edge of the walk."""
    on_edge: bool
    """Whether that is an edge, not a time between two."""
    every: int
    room: np.ndarray
    """Scratch (40,)."""


class Outputs(NamedTuple):
    """Output arrays: a row for each stored edge; innovations by measurement."""

    attitude: np.ndarray
    bias: np.ndarray
    covariance: np.ndarray
    weights: np.ndarray
    """(rows, h), or (0, h)."""
    innovation: np.ndarray
    """Innovations of the hypothesis of the largest weight (events, 6)."""
    share: np.ndarray
    """Its weight of each measurement (events,)."""


def begin(body):
    """Return number of sets started, log weight of refusing all, consecutive refusals, rows written, and edge of convergence."""
    normalized_weights(body.log_weight, body.min_weight, body.weight)
    refused = 0.0
    for i in range(len(body.weight)):
        if body.weight[i] > 0.0:
            refused += math.exp(body.log_weight[i])
    none = 0 * len(body.weight)
    return none, math.log(refused), none, none, none + NEVER


def largest_turn(part, dt, body):
    """Return the largest squared rotation angle of the hypotheses."""
    squared = 0.0
    for i in range(len(body.weight)):
        if body.weight[i] > 0.0:
            squared = max(squared, turn_squared(part, dt, vector_at(body.states[:, 4:], i)))
    return squared


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return step_within(largest_turn(part, dt, body), dt)


def predict(state, part, dt, body, out):
    """Propagate every hypothesis."""
    for i in range(len(body.weight)):
        if body.weight[i] > 0.0:
            q, b, A, B, C = load_state(body.states[i])
            q, A, B, C = propagated(q, b, A, B, C, part, dt, body.angle_variance, body.rate_variance)
            store_state(body.states[i], q, b, A, B, C)
    return state


def update(state, e, now, measured, body, out):
    """Update every hypothesis with a measurement, and its weight by the likelihood."""
    started, refused, streak, row, one_at = state
    options, weight, log_weight = body.options, body.weight, body.log_weight
    place = measured.place[e]
    sensor = measured.sensor[e]
    kind = measured.series[sensor, KIND]
    threshold = options.thresholds[degrees_of_freedom(kind) - 1]
    leader = 0
    for i in range(len(weight)):
        if weight[i] > weight[leader]:
            leader = i
    refusing = 0.0
    height = 0.0
    for i in range(len(weight)):
        if weight[i] > 0.0:
            share, nis, e_s = update_one(i, place, sensor, kind, threshold, measured, body)
            if share == 0.0:
                refusing += weight[i]
            spread = math.log(e_s[1]) + math.log(e_s[3]) + math.log(e_s[5])
            log_weight[i] -= 0.5 * (nis + spread)
            if i == leader:
                height = spread
                out.share[place] = share
                for n in range(6):
                    out.innovation[place, n] = e_s[n]
    refused -= 0.5 * (height + (1.0 if kind == HEADING else body.charge))
    if started < len(body.later) and e == body.later[started]:
        members = body.sets[started + 1] - body.sets[started]
        for i in range(body.sets[started], body.sets[started + 1]):
            log_weight[i] = refused - math.log(members)
        started += 1
    refused -= normalized_weights(log_weight, body.min_weight, weight)
    streak = streak + 1 if refusing > 0.5 else 0 * streak
    if options.recovery > 0 and streak >= options.recovery:
        one_at = 0 * one_at + LOST
    return started, refused, streak, row, one_at


def update_one(i, place, sensor, kind, threshold, measured, body):
    """Update hypothesis i; return its weight of the measurement (0: refused), the NIS for the likelihood, and e₁, s₁, e₂, s₂, e₃, s₃."""
    options = body.options
    degrees = degrees_of_freedom(kind)
    parameter, numerator = options.parameters[degrees - 1, 0], options.parameters[degrees - 1, 1]
    z = value_of(measured, place, sensor)
    frame = frame_of(measured, place, sensor)
    sigma = sigma_of(measured, place, sensor)
    variance = sigma * sigma
    q, b, A, B, C = load_state(body.states[i])
    done = updated(kind, q, b, A, B, C, z, frame, variance, 1.0)
    e_s = (done[5], done[6], done[7], done[8], done[9], done[10])
    nis = e_s[0] * e_s[0] / e_s[1] + e_s[2] * e_s[2] / e_s[3] + e_s[4] * e_s[4] / e_s[5]
    share = 1.0
    if nis > threshold:
        share = 0.0
    elif options.robust != 0:
        for _ in range(options.iterations):
            distance, spread = done[11], done[12]
            if options.robust == STUDENT:
                share = numerator / (parameter + distance + spread)
            elif distance > parameter:
                share = math.sqrt(parameter / distance)
            else:
                share = 1.0
            done = updated(kind, q, b, A, B, C, z, frame, variance, share)
    if share > 0.0:
        store_state(body.states[i], done[0], done[1], done[2], done[3], done[4])
    # A refused measurement counts as one at the threshold: otherwise no hypothesis would survive an outlier.
    return share, min(heavy_tailed(options.robust, parameter, numerator, nis), threshold), e_s


def keep(state, row, e, body, out):
    """Write the mixture at a stored edge, and check whether the hypotheses have converged."""
    started, refused, streak, written, one_at = state
    edge = body.first_edge + row
    if one_at == NEVER and edge % body.every == 0 and (row > 0 or body.on_edge):
        between, matched = body.room[:12], body.room[12:]
        moment_match(body.states, body.weight, between, matched)
        q, b, A, B, C = load_state(matched)
        store_row(out.attitude, written, q)
        store_row(out.bias, written, b)
        store_row(out.covariance, written, A + B + C)
        left = 0
        for i in range(len(body.weight)):
            if written < len(out.weights):
                out.weights[written, i] = body.weight[i]
            left += body.weight[i] > 0.0
        written += 1
        apart = max(share_between(matched[7:13], between[:6]), share_between(matched[22:28], between[6:]))
        if (started > 0 or len(body.later) == 0) and (left == 1 or apart < body.max_share):
            for n in range(28):
                body.states[0, n] = matched[n]
            one_at = edge
    return started, refused, streak, written, one_at


def stopped(state):
    """Return whether the hypotheses have converged or are lost."""
    return state[4] != NEVER


def finish(state, row, e, body):
    """Return the number of rows written, the edge of convergence (or ``NEVER``, ``LOST``), and the index of the next measurement.

    If the hypotheses are lost, the index is that of the first of the consecutive refusals.
    """
    _, _, streak, written, one_at = state
    return written, one_at, e - streak if one_at == LOST else e
