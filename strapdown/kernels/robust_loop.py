"""The filter over one whole record with all its options: any noise, a gate that recovers, robust weights.

:func:`strapdown.kernels.filter_loop.run_filter` is the same filter without them, and faster; what a gate makes of a measurement is in
:mod:`strapdown.kernels.robust_gate`. The state lives in rows of an array: row 0 the filter, row 1 the challenger beside it while there is
one, so that both go through one piece of code.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import combine, dot, full, minus_outer, scale, symmetric_minus_outer
from strapdown.kernels.filter_loop import (
    CHECKED,
    DIRECTION,
    HEADING,
    MOST_TURN,
    least_share,
    store_segment,
    store_state,
    vector_at,
)
from strapdown.kernels.filter_step import predict
from strapdown.kernels.robust_gate import (
    CHALLENGED,
    DROPPED,
    FIRST_BIAS,
    PASSES,
    TOO_NARROW,
    WIDE_PASSES,
    begin_challenge,
    count_widening,
    is_believed,
    judge_challenger,
    judge_filter,
    may_widen,
    recover,
    restart_attitude,
    restart_width,
    start_undone,
)
from strapdown.kernels.robust_step import ACCEPTED, corrected, take_in
from strapdown.kernels.series import LARGEST_ANGLE

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""

LENIENT = 1e3
"""A challenger, which starts with next to nothing known, may lose so many times more of its covariance's digits than the filter."""


def state_at(rows, i):
    """Return (q, b, A, B, C) of row i of packed states."""
    s = rows[i]
    return (
        (s[0], s[1], s[2], s[3]),
        (s[4], s[5], s[6]),
        (s[7], s[8], s[9], s[10], s[11], s[12]),
        (s[13], s[14], s[15], s[16], s[17], s[18], s[19], s[20], s[21]),
        (s[22], s[23], s[24], s[25], s[26], s[27]),
    )


def bias_at(states, i):
    """Return the bias of row i."""
    return (states[i, 4], states[i, 5], states[i, 6])


def six_at(array, k):
    """Return row k of an (n, 6) array as a 6-tuple."""
    return (array[k, 0], array[k, 1], array[k, 2], array[k, 3], array[k, 4], array[k, 5])


def frame_at(triads, t):
    """Return row t of the schedule's frames as a 9-tuple."""
    return (
        triads[t, 0],
        triads[t, 1],
        triads[t, 2],
        triads[t, 3],
        triads[t, 4],
        triads[t, 5],
        triads[t, 6],
        triads[t, 7],
        triads[t, 8],
    )


def start_challenger(states, memory, now, attitude_sigma, bias_variance):
    """Write row 1: the filter's state, as uncertain as a fresh start; ``bias_variance`` (3,) is added to that of the bias.

    Both are widened by how many challengers have been before it.
    """
    sigma = restart_attitude(attitude_sigma, memory)
    width = restart_width(memory)
    for i in range(28):
        states[1, i] = states[0, i]
    for i in range(7, 22):
        states[1, i] = 0.0
    for i in (7, 10, 12):
        states[1, i] = sigma * sigma
    states[1, 22] += width * width * bias_variance[0]
    states[1, 25] += width * width * bias_variance[1]
    states[1, 27] += width * width * bias_variance[2]
    begin_challenge(memory, now, bias_at(states, 1), (states[1, 22], states[1, 25], states[1, 27]))


def widen(states, memory):
    """Make the challenger what it would be had its bias started wider, if that holds it back."""
    q, b, A, B, C = state_at(states, 1)
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
    store_state(states[1], q, b, A, B, C)
    count_widening(memory)


def run_robust(
    edges,
    increments,
    angle_variance,
    rate_variance,
    event_time,
    event_kind,
    event_sensor,
    event_value,
    event_noise,
    event_reference,
    triads,
    thresholds,
    robust,
    robust_parameters,
    robust_passes,
    recovery,
    lock_out_limit,
    restart_attitude_sigma,
    restart_bias_variance,
    standing,
    memory,
    states,
    every,
    attitude_out,
    bias_out,
    variance_out,
    covariance_out,
    innovation_out,
    weight_out,
    recovery_out,
    lock_out_out,
    segment_out,
    sharp,
    least,
    work,
):
    """Run the filter over a record as :func:`strapdown.kernels.filter_loop.run_filter` does, with options.

    ``event_noise`` (events, 6) is the covariance of each measurement in body axes; ``thresholds`` (3,) the largest NIS accepted of 1, 2, 3
    degrees of freedom; ``robust`` 0 or a kind of :mod:`strapdown.kernels.robust_step` with ``robust_parameters`` (3, 2), a row for each
    number of degrees of freedom; ``recovery`` the refusals in a row that lead to it, 0: none; ``lock_out_limit`` how many more of a sensor
    may be refused than accepted before it is told. ``states`` (2, 28) holds the initial state in row 0, a challenger in row 1, and is left
    at the end state; ``standing`` (sensors, ``STANDING``) and ``memory`` (``MEMORY``,) what the gate remembers, likewise: at the start of a
    record zeros, but for ``PASSES``, 1, and ``TOLD``, −1.

    ``weight_out`` (events,) gets the weight of each measurement, 0 where it was refused; ``recovery_out`` (rows, 4) time, sensor, time of
    the first refusal and refusals in a row of each recovery; ``lock_out_out`` (rows, 4) times of the first and of the last refusal, sensor
    and number of refusals of each lock-out, 0 of one that a recovery tells of.
    Returns the numbers of segments, of recoveries and of lock-outs; of segments −1 where a covariance would lose its digits, by what
    ``sharp`` and ``least`` mean to ``run_filter`` (of a challenger's ``LENIENT`` times more). The run ends there, and all of it is to be
    taken in the square root (:func:`strapdown.mekf.factored.run_robust_sharp`). ``work`` (7, 6) is scratch.
    """
    n = len(increments)
    least_noise = 1.0 / sharp
    check = CHECKED
    running = 1
    if memory[CHALLENGED] > 0.0:
        running = 2
    for i in range(running):
        if not least_share(states[i], work) >= (least if i == 0 else least / LENIENT):
            return -1, 0, 0
    recoveries = 0
    lock_outs = 0
    events = len(event_time)
    e = 0
    k = -1
    now = edges[0]
    end = now
    whole = 1.0
    theta = (0.0, 0.0, 0.0)
    countdown = 0
    row = 0
    segments = 0
    while k < n:
        due = e < events and event_time[e] <= end
        stop = event_time[e] if due else end
        dt = stop - now
        if dt > 0.0:
            part = theta
            if dt < whole:
                part = scale(dt / whole, theta)
            # Sub-steps as in filter_loop; all states that run go the same ones.
            squared = 0.0
            for i in range(running):
                turn = combine(1.0, part, -dt, bias_at(states, i))
                squared = max(squared, dot(turn, turn))
            if LARGEST_ANGLE * LARGEST_ANGLE < squared < MOST_TURN * MOST_TURN:
                share = LARGEST_ANGLE / math.sqrt(squared)
                dt = share * dt
                part = scale(share, part)
                stop = now + dt
                due = False
            for i in range(running):
                q, b, A, B, C = state_at(states, i)
                if i == 0 and segments < len(segment_out):
                    store_segment(segment_out, segments, dt, part, q, b, A, B, C)
                    segments += 1
                q, A, B, C = predict(q, b, A, B, C, part, dt, angle_variance, rate_variance)
                store_state(states[i], q, b, A, B, C)
            now = stop
        if due:
            kind = event_kind[e]
            sensor = event_sensor[e]
            degrees = 3
            if kind == HEADING:
                degrees = 1
            elif kind == DIRECTION:
                degrees = 2
            i = 0
            while i < running:
                q, b, A, B, C = state_at(states, i)
                outcome, w, q, b, A, B, C, e1, s1, e2, s2, e3, s3, noise_share = take_in(
                    q,
                    b,
                    A,
                    B,
                    C,
                    kind,
                    vector_at(event_value, e),
                    frame_at(triads, event_reference[e]),
                    six_at(event_noise, e),
                    int(memory[PASSES]) if i == 0 else WIDE_PASSES,
                    thresholds[degrees - 1],
                    robust,
                    robust_parameters[degrees - 1, 0],
                    robust_parameters[degrees - 1, 1],
                    robust_passes,
                )
                if outcome == ACCEPTED:
                    if not noise_share >= (least_noise if i == 0 else least_noise / LENIENT):
                        return -1, recoveries, lock_outs
                    store_state(states[i], q, b, A, B, C)
                if i == 0:
                    weight_out[e] = w
                    innovation_out[e, 0] = e1
                    innovation_out[e, 1] = s1
                    innovation_out[e, 2] = e2
                    innovation_out[e, 3] = s2
                    innovation_out[e, 4] = e3
                    innovation_out[e, 5] = s3
                    lock_outs, challenge = judge_filter(
                        outcome, now, sensor, recovery, lock_out_limit, standing, memory, lock_out_out, lock_outs
                    )
                    if challenge:
                        start_challenger(states, memory, now, restart_attitude_sigma, restart_bias_variance)
                        running = 2
                else:
                    nis = e1 * e1 / s1 + e2 * e2 / s2 + e3 * e3 / s3
                    verdict = judge_challenger(outcome, nis, degrees, sensor, standing, memory, bias_at(states, 1))
                    if verdict == DROPPED:
                        running = 1
                    elif verdict == TOO_NARROW:
                        widen(states, memory)
                    if verdict != DROPPED and is_believed(sensor, recovery, standing, memory):
                        recover(now, sensor, lock_out_limit, standing, memory, recovery_out[recoveries], lock_out_out)
                        recoveries += 1
                        for j in range(28):
                            states[0, j] = states[1, j]
                        running = 1
                i += 1
            e += 1
        if now >= end and (e == events or event_time[e] > end):
            if countdown == 0:
                countdown = every
                for j in range(4):
                    attitude_out[row, j] = states[0, j]
                for j in range(3):
                    bias_out[row, j] = states[0, 4 + j]
                variance_out[row, 0] = states[0, 7]
                variance_out[row, 1] = states[0, 10]
                variance_out[row, 2] = states[0, 12]
                variance_out[row, 3] = states[0, 22]
                variance_out[row, 4] = states[0, 25]
                variance_out[row, 5] = states[0, 27]
                if row < len(covariance_out):
                    for j in range(21):
                        covariance_out[row, j] = states[0, 7 + j]
                row += 1
            countdown -= 1
            k += 1
            if k >= check or k == n:
                check = k + CHECKED
                for i in range(running):
                    if not least_share(states[i], work) >= (least if i == 0 else least / LENIENT):
                        return -1, recoveries, lock_outs
            if k < n:
                end = edges[k + 1]
                whole = end - now
                theta = vector_at(increments, k)
    return segments, recoveries, lock_outs
