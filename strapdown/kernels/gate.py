"""A gate and robust weights around the filter of :mod:`strapdown.kernels.filter`: a body of :mod:`strapdown.kernels.walk`.

The consequences of refusals are in :mod:`strapdown.kernels.gate_rules`. Row 0 of the states is the filter, row 1 the restart candidate, if
there is one; both are processed by the same code.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import add, factored, matrix_times_vector, scale, solved
from strapdown.kernels.filter import (
    attitude_at,
    attitude_covariance,
    become,
    bias_at,
    correct,
    innovation_covariance,
    judge,
    linearised,
    propagate_row,
    put_attitude,
    relinearise,
    start_candidate,
    start_update,
    step_of,
    store_segment,
    turn_attitude,
    widen,
    write_row,
)
from strapdown.kernels.filter import increment_over as increment_of_filter
from strapdown.kernels.gate_rules import (
    CANDIDATE,
    DROPPED,
    PASSES,
    TOO_NARROW,
    WIDE_PASSES,
    judge_candidate,
    judge_filter,
    recover,
    takes_over,
)
from strapdown.kernels.iterated_update import (
    ACCEPTED,
    IDENTITY,
    KNOWN,
    MIN_CORRECTION_UNKNOWN,
    PASSED_OVER,
    REFUSED,
    RELINEARIZED,
    TURN_ASIDE,
    UNKNOWN,
    UNKNOWN_TILT,
    least_certain_axis,
    robust_weight,
    seen_from,
    tangent_at,
    tilt_variance,
)
from strapdown.kernels.measurement import (
    DIRECTION,
    HEADING,
    KIND,
    degrees_of_freedom,
    has_heading,
    store_innovations,
    value_of,
)
from strapdown.kernels.rotation import moved, quaternion_multiply, rotation_matrix
from strapdown.kernels.structure import MAX_PRECISION
from strapdown.kernels.structure import Body as Filter
from strapdown.kernels.structure import Outputs as FilterOutputs
from strapdown.kernels.walk import step_within, turn_squared


class Options(NamedTuple):
    """Gate and robust update, in the form of the kernels."""

    thresholds: np.ndarray
    """Maximum NIS accepted for 1, 2, 3 degrees of freedom (3,)."""
    robust: int
    """Kind of robust weight (:mod:`strapdown.kernels.iterated_update`); 0: none."""
    parameters: np.ndarray
    """Parameters of the robust weight, a row for each number of degrees of freedom (3, 2)."""
    iterations: int
    """Number of iterations of the robust weight."""
    recovery: int
    """Number of consecutive refusals that lead to recovery; 0: never."""
    lock_out: int
    """Excess of refusals over acceptances of a sensor above which a lock-out is reported."""
    attitude_sigma: float
    """σ of the first candidate's attitude, rad."""


class Restart(NamedTuple):
    """Initial values of a restart candidate."""

    bias_variance: np.ndarray
    """Increase of the variance of the bias (3,), (rad/s)²."""
    values: np.ndarray
    """Error states (m,) at ``time``."""
    covariance: np.ndarray
    """Their covariance (m, m)."""
    time: float


class Body(NamedTuple):
    """A filter with its gate."""

    form: Filter
    options: Options
    restart: Restart
    """Initial values of a candidate."""
    counters: np.ndarray
    """Counters of each sensor (sensors, ``COUNTERS``); at return, their final values."""
    memory: np.ndarray
    """Counters of the candidate (``MEMORY``,); at return, final values. Initially zero, except ``PASSES`` = 1."""


class Outputs(NamedTuple):
    """Outputs of a run in addition to those of the form."""

    form: FilterOutputs
    weight: np.ndarray
    """Weight of each measurement (events,), by place; 0: refused."""
    events: np.ndarray
    """(rows, 5): kind, sensor, start, end and number of refusals of each recovery and lock-out, except lock-outs in the counters."""


# ------------------------------------------------------------------------------------------------------------------ the body of the walk


def increment_over(increments, k, body):
    """Return the increment of interval k."""
    return increment_of_filter(increments, k, body.form)


def begin(body):
    """Return the numbers of states, events and segments, and whether a measurement was too precise."""
    # From an array, and not literals: numba would compile the body for that type too.
    none = 0 * len(body.memory)
    running = none + 1
    if body.memory[CANDIDATE] > 0.0:
        running = none + 2
    return running, none, none, running < 0


def largest_turn(running, part, dt, body):
    """Return the largest squared rotation angle of the states."""
    squared = 0.0
    for i in range(running):
        squared = max(squared, turn_squared(part, dt, bias_at(body.form, i)))
    return squared


def longest_step(state, part, dt, body):
    """Return the longest step, s, common to all states."""
    return min(step_within(largest_turn(state[0], part, dt, body), dt), body.form.model.limit)


def predict(state, part, dt, body, out):
    """Propagate the filter and the candidate."""
    running, events, segments, lost = state
    form = body.form
    if segments < len(out.form.segments):
        store_segment(out.form.segments, segments, dt, part, form.x[0], form.P[0])
        segments += 1
    for i in range(running):
        propagate_row(form, i, part, dt, 0.0)
    return running, events, segments, lost


def update(state, e, now, measured, body, out):
    """Test a measurement with the filter and the candidate, if there is one, and update."""
    running, events, segments, lost = state
    form, options, memory, counters = body.form, body.options, body.memory, body.counters
    recovery, limit = options.recovery, options.lock_out
    place = measured.place[e]
    sensor = measured.sensor[e]
    degrees = degrees_of_freedom(measured.series[sensor, KIND])
    i = 0
    while i < running:
        passes = int(memory[PASSES]) if i == 0 else WIDE_PASSES
        if passes == 1:
            outcome, weight, innovation, variance, far = judge(form.shape[sensor], form, measured, e, options, 0.0)
        else:
            outcome, weight, innovation, variance, far = iterated_update(form, i, e, measured, passes, options)
        if i == 0:
            lost = lost or far
            out.weight[place] = weight
            store_innovations(out.form.innovation, place, innovation, variance)
            events, start = judge_filter(outcome, now, sensor, recovery, limit, counters, memory, out.events, events)
            if start:
                start_candidate(form, memory, now, options.attitude_sigma, body.restart)
                running = 2
        else:
            nis = 0.0
            for r in range(3):
                nis += innovation[r] * innovation[r] / variance[r]
            verdict = judge_candidate(outcome, nis, degrees, sensor, counters, memory, bias_at(form, 1))
            if verdict == DROPPED:
                running = 1
            elif verdict == TOO_NARROW:
                widen(form, memory)
            if verdict != DROPPED and takes_over(sensor, recovery, counters, memory):
                events = recover(now, sensor, limit, counters, memory, out.events, events)
                become(form)
                running = 1
        i += 1
    return running, events, segments, lost


def keep(state, row, e, body, out):
    """Write a row."""
    write_row(body.form, row, out.form)
    return state


def stopped(state):
    """Return whether a measurement was too precise for double precision."""
    return state[3]


def finish(state, row, e, body):
    """Return the numbers of segments (−1: a measurement was too precise) and events."""
    _, events, segments, lost = state
    if lost:
        segments = -1
    return segments, events


# ---------------------------------------------------------------------------------------------------------- one measurement, tested first


def iterated_update(form, i, e, measured, passes, options):
    """Test a measurement with state i, and update if its NIS does not exceed the threshold and a direction is within 90° of the predicted.

    The update is relinearised at its own result, at most ``passes`` times, while the correction exceeds ``RELINEARIZED``. Rows are
    transformed to the tangent space of the prior, and the final covariance to that of the estimate
    (:func:`strapdown.kernels.iterated_update.tangent_at`). If the result exceeds the threshold and the attitude is nearly unknown, the
    update is repeated from 120° to either side about the least certain axis.

    A heading is skipped while the tilt, on which its row depends, is unknown; that of a vertical vector is undefined, with an innovation of
    NaN.

    Returns ``ACCEPTED``, ``REFUSED`` or ``PASSED_OVER``, the weight, independent innovations (3,) with their variances (3,) under the
    nominal noise, from the last linearisation or, without convergence, from the first, and whether it was too precise for double precision.
    """
    place = measured.place[e]
    sensor = measured.sensor[e]
    kind = measured.series[sensor, KIND]
    z = value_of(measured, place)
    degrees = degrees_of_freedom(kind)
    threshold = options.thresholds[degrees - 1]
    parameter, numerator = options.parameters[degrees - 1, 0], options.parameters[degrees - 1, 1]
    q = attitude_at(form, i)
    R = rotation_matrix(q)
    if kind == HEADING and not has_heading(R, z):
        return PASSED_OVER, 0.0, (math.nan, 0.0, 0.0), (1.0, 1.0, 1.0), False
    A = attitude_covariance(form, i)
    unknown = A[0] + A[3] + A[5] >= UNKNOWN
    tolerance = MIN_CORRECTION_UNKNOWN if unknown else RELINEARIZED
    now_q = q
    M = IDENTITY
    prior = (0.0, 0.0, 0.0)  # prior mean relative to the attitude of the linearisation
    start_update(form, i)
    first_e = prior
    first_F = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    done = 1
    trials = 0
    while True:
        rows, y, p, variance, far, along = linearised(form, e, now_q, q, M, measured, kind, sensor)
        S = innovation_covariance(form, i, rows)
        F = factored(with_noise(S, variance))
        innovation = (y[0] - p[0], y[1] - p[1], y[2] - p[2])
        e1, e2, e3 = independent(F, innovation)
        accepted = e1 * e1 * F[3] + e2 * e2 * F[4] + e3 * e3 * F[5] <= threshold
        if kind == DIRECTION and along < 0.0 and threshold < math.inf:
            accepted = False  # more than 90° from the predicted one, which the transverse rows cannot detect
        if done == 1 and trials == 0:
            first_e = (e1, e2, e3)
            first_F = F
        weight, weighted = 1.0, F
        if options.robust > 0:
            # Linearised at the result of the weighted update: that of an outlier lies elsewhere.
            weight = robust_weight(options.robust, parameter, numerator, options.iterations, S, innovation, variance)
            weighted = factored(with_noise(S, scale(1.0 / weight, variance)))
        u = solved(weighted, (far * y[0] - p[0], far * y[1] - p[1], innovation[2]))
        step, squared = step_of(form, rows, u, M, q, now_q)
        converged = squared < tolerance * tolerance
        fresh = False
        if converged or done >= passes:
            accepted = accepted and converged
            if accepted or trials == 2 or not unknown:
                if not converged:
                    e1, e2, e3 = first_e
                    F = first_F
                break
            trials += 1
            done = 0
            now_q = q
            fresh = True
            step = scale(math.copysign(TURN_ASIDE, trials - 1.5), least_certain_axis(A))
        old_q = now_q
        now_q, _ = moved(now_q, step)
        M, prior = tangent_at(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), now_q), A)
        relinearise(form, i, q, old_q, now_q, prior, fresh)
        done += 1
    lost = False
    outcome = REFUSED
    if kind == HEADING and tilt_variance(R, A) > UNKNOWN_TILT:
        outcome, weight = PASSED_OVER, 0.0
    elif accepted:
        outcome = ACCEPTED
        lost = min(F[3] * variance[0], F[4] * variance[1], F[5] * variance[2]) < 1.0 / MAX_PRECISION
        taken = correct(form, i, rows, innovation, scale(1.0 / weight, variance))
        reset_from(form, i, q, now_q, add(prior, matrix_times_vector(M, taken)), M)
    else:
        weight = 0.0
    return outcome, weight, (e1, e2, e3), (1.0 / F[3], 1.0 / F[4], 1.0 / F[5]), lost


def with_noise(S, variance):
    """Return an innovation covariance, upper triangle (6,), with the noise of its rows added."""
    return S[0] + variance[0], S[1], S[2], S[3] + variance[1], S[4], S[5] + variance[2]


def independent(F, innovation):
    """Return the innovations (3,) made independent by the factors of their covariance."""
    e1 = innovation[0]
    e2 = innovation[1] - F[0] * e1
    return e1, e2, innovation[2] - F[1] * e1 - F[2] * e2


def reset_from(form, i, q, now_q, step, M):
    """Move the attitude of the linearisation by a step, and the covariance to the tangent space of the result."""
    turn_attitude(form.P[i], M)
    A = attitude_covariance(form, i)
    new_q, G = moved(now_q, step)
    if A[0] + A[3] + A[5] > KNOWN:
        _, G = seen_from(step, A)
    turn_attitude(form.P[i], G)
    put_attitude(form.x[i], form.P[i], q, new_q)
