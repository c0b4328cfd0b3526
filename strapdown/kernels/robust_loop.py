"""The filter over one whole record with all its options: any noise, a gate that recovers, robust weights.

:func:`strapdown.kernels.filter_loop.run_filter` is the same filter without them, and faster. The state lives in rows of an array: row 0
the filter, row 1 the challenger beside it while there is one, so that both go through one piece of code.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import combine, dot, full, minus_outer, scale, symmetric_minus_outer
from strapdown.kernels.filter_loop import DIRECTION, HEADING, MOST_TURN, store_segment, store_state, vector_at
from strapdown.kernels.filter_step import predict
from strapdown.kernels.robust_step import ACCEPTED, PASSED_OVER, REFUSED, corrected, take_in
from strapdown.kernels.series import LARGEST_ANGLE

WIDE_PASSES = 20
"""Linearisations of one update at most, of a challenger and of a filter that has recovered."""
WIDENING = 3.0
"""Each challenger that fails makes the next one's σ so many times wider, and so is one made that was too narrow."""
WIDEST = 7
"""After so many widenings, to 2187 times the first σ, the next challenger is as narrow as the first."""
UNKNOWN_ATTITUDE = math.pi * math.pi / 3.0
"""Variance of an angle uniform over the whole turn, rad²: no widening of the attitude goes beyond."""
BIAS_MOVE = 2.366
"""Largest squared move of a challenger's bias over its first variance: the median of χ² of three degrees of freedom. One that moves
farther is held back by its start, and is made wider; one wider than need be does no harm."""
MISFIT = 3.0
"""The NIS of what a challenger accepts may add up to so many standard deviations above the degrees of freedom, or it is made wider."""
TOLERANCE = 1
"""A challenger may refuse so many measurements, and half of those that it accepts, before it is dropped."""
MISSES_IN_A_ROW = 3
"""It is dropped when it refuses so many in a row."""
FORGOTTEN = 5.0
"""When the filter has accepted so many times ``recovery`` since a challenger failed or took over, the next is as narrow as the first."""

# What a gate remembers, beside the challenger's state: columns of ``memory``, and of each sensor's row of ``standing``.
CHALLENGED = 0
"""Whether there is a challenger."""
PASSES = 1
"""Linearisations of an update of the filter."""
LEVEL = 2
"""How often the next challenger's σ is widened."""
HITS = 3
MISSES = 4
SINCE = 5
"""Start of the challenger, s."""
NIS = 6
DEGREES = 7
"""The NIS of what it has accepted, added up, and the degrees of freedom."""
MISSED = 8
"""What it has refused in a row."""
TRUSTED = 9
"""What the filter has accepted since a challenger failed or took over."""
FIRST_BIAS = 10
"""Its bias then, three columns, and the variances of it, three more."""
MEMORY = 16
BIAS_VARIANCE = (22, 25, 27)
"""Where a packed state has the variances of the bias."""
IN_A_ROW = 0
"""Refusals in a row."""
EXCESS = 1
"""Refusals less acceptances, between zero and twice the limit."""
NUMBER = 2
"""Refusals since the excess was zero, the time of the first and of the last of them, s."""
FIRST = 3
LAST = 4
TOLD = 5
"""Row of ``lock_out_out`` that tells of them, −1 while none does."""
STANDING = 6


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


def six_at(array, k):
    """Return row k of an (n, 6) array as a 6-tuple."""
    return (array[k, 0], array[k, 1], array[k, 2], array[k, 3], array[k, 4], array[k, 5])


def start_challenger(states, memory, now, attitude_variance, bias_variance):
    """Write row 1: the filter's state, as uncertain as a fresh start; ``bias_variance`` (3,) is added to that of the bias.

    Both are widened by how many challengers have been before it.
    """
    widened = WIDENING ** (2.0 * memory[LEVEL])
    for i in range(28):
        states[1, i] = states[0, i]
    for i in range(7, 22):
        states[1, i] = 0.0
    for i in (7, 10, 12):
        states[1, i] = max(attitude_variance, min(widened * attitude_variance, UNKNOWN_ATTITUDE))
    states[1, 22] += widened * bias_variance[0]
    states[1, 25] += widened * bias_variance[1]
    states[1, 27] += widened * bias_variance[2]
    memory[CHALLENGED] = 1.0
    memory[HITS] = 0.0
    memory[MISSES] = 0.0
    memory[SINCE] = now
    memory[MISSED] = 0.0
    memory[NIS] = 0.0
    memory[DEGREES] = 0.0
    for i in range(3):
        memory[FIRST_BIAS + i] = states[1, 4 + i]
    memory[FIRST_BIAS + 3] = states[1, 22]
    memory[FIRST_BIAS + 4] = states[1, 25]
    memory[FIRST_BIAS + 5] = states[1, 27]


def has_failed(memory):
    """Return whether the challenger refuses too many."""
    return memory[MISSES] > TOLERANCE + 0.5 * memory[HITS] or memory[MISSED] >= MISSES_IN_A_ROW


def too_narrow(states, memory):
    """Return whether the challenger's bias has moved too far from its start, or what it accepts fits too ill."""
    move = 0.0
    for i in range(3):
        step = states[1, 4 + i] - memory[FIRST_BIAS + i]
        move += step * step / memory[FIRST_BIAS + 3 + i]
    return move > BIAS_MOVE or memory[NIS] > memory[DEGREES] + MISFIT * math.sqrt(2.0 * memory[DEGREES])


def widen(states, memory):
    """Make the challenger what it would be had its bias started with σ ``WIDENING`` times as wide; nothing that it has seen is lost.

    The start is a measurement of the bias, of variance σ₀². Taken in again with the variance ``−σ₀²/(1 − 1/WIDENING²)``, it leaves one of
    ``WIDENING² σ₀²``.
    """
    for i in range(3):
        if states[1, BIAS_VARIANCE[i]] > 1.05 * memory[FIRST_BIAS + 3 + i]:
            return
    q, b, A, B, C = state_at(states, 1)
    turn = (0.0, 0.0, 0.0)
    for i in range(3):
        variance = memory[FIRST_BIAS + 3 + i]
        P = full(C)
        pa = (B[i], B[3 + i], B[6 + i])
        pb = (P[i], P[3 + i], P[6 + i])
        inverse = 1.0 / (P[4 * i] - variance / (1.0 - 1.0 / (WIDENING * WIDENING)))
        memory[FIRST_BIAS + 3 + i] = WIDENING * WIDENING * variance
        if inverse >= 0.0:
            continue  # the axes before it have left more than its start allows: it holds nothing back any more
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
    memory[LEVEL] += 1.0
    memory[NIS] = 0.0
    memory[DEGREES] = 0.0


def count_refusal(seat, now, sensor, limit, lock_outs, told):
    """Count a refusal in a sensor's row ``seat`` of ``standing``; return the lock-outs told, one more if the excess passes ``limit``."""
    seat[IN_A_ROW] += 1.0
    if seat[EXCESS] == 0.0:
        seat[NUMBER] = 0.0
        seat[FIRST] = now
        seat[TOLD] = -1.0
    seat[EXCESS] = min(seat[EXCESS] + 1.0, 2.0 * limit)
    seat[NUMBER] += 1.0
    seat[LAST] = now
    if seat[EXCESS] > limit and seat[TOLD] < 0.0:
        seat[TOLD] = told
        told += 1
    if seat[TOLD] >= 0.0:
        row = lock_outs[int(seat[TOLD])]
        row[0] = seat[FIRST]
        row[1] = now
        row[2] = sensor
        row[3] = seat[NUMBER]
    return told


def count_acceptance(seat):
    """Count an acceptance in a sensor's row of ``standing``."""
    seat[IN_A_ROW] = 0.0
    seat[EXCESS] = max(seat[EXCESS] - 1.0, 0.0)


def forgive(standing, limit, lock_outs):
    """Set all counts back at a recovery, which tells of the short lock-outs that it ends: their number is set to zero."""
    for s in range(len(standing)):
        if standing[s, TOLD] >= 0.0 and standing[s, NUMBER] <= 2.0 * limit and standing[s, EXCESS] > 0.0:
            lock_outs[int(standing[s, TOLD]), 3] = 0.0
        for j in range(STANDING):
            standing[s, j] = 0.0
        standing[s, TOLD] = -1.0


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
    restart_attitude_variance,
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
    Returns the numbers of segments, of recoveries and of lock-outs.
    """
    n = len(increments)
    running = 1
    if memory[CHALLENGED] > 0.0:
        running = 2
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
                turn = combine(1.0, part, -dt, (states[i, 4], states[i, 5], states[i, 6]))
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
            t = event_reference[e]
            frame = (
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
            challenged = PASSED_OVER
            i = 0
            while i < running:
                q, b, A, B, C = state_at(states, i)
                outcome, w, q, b, A, B, C, e1, s1, e2, s2, e3, s3 = take_in(
                    q,
                    b,
                    A,
                    B,
                    C,
                    kind,
                    vector_at(event_value, e),
                    frame,
                    six_at(event_noise, e),
                    int(memory[PASSES]) if i == 0 else WIDE_PASSES,
                    thresholds[degrees - 1],
                    robust,
                    robust_parameters[degrees - 1, 0],
                    robust_parameters[degrees - 1, 1],
                    robust_passes,
                )
                if i == 0:
                    weight_out[e] = w
                    innovation_out[e, 0] = e1
                    innovation_out[e, 1] = s1
                    innovation_out[e, 2] = e2
                    innovation_out[e, 3] = s2
                    innovation_out[e, 4] = e3
                    innovation_out[e, 5] = s3
                    if outcome == ACCEPTED:
                        count_acceptance(standing[sensor])
                        memory[TRUSTED] += 1.0
                    elif outcome == REFUSED:
                        lock_outs = count_refusal(
                            standing[sensor], now, sensor, lock_out_limit, lock_out_out, lock_outs
                        )
                        if recovery > 0 and running == 1:
                            if memory[TRUSTED] >= FORGOTTEN * recovery:
                                memory[LEVEL] = 0.0
                            start_challenger(states, memory, now, restart_attitude_variance, restart_bias_variance)
                            running = 2
                else:
                    challenged = outcome
                    if outcome == ACCEPTED:
                        memory[NIS] += e1 * e1 / s1 + e2 * e2 / s2 + e3 * e3 / s3
                        memory[DEGREES] += degrees
                if outcome == ACCEPTED:
                    store_state(states[i], q, b, A, B, C)
                i += 1
            if running == 2:
                in_a_row = standing[sensor, IN_A_ROW]
                if challenged == REFUSED:
                    memory[MISSES] += 1.0
                    memory[MISSED] += 1.0
                elif challenged == ACCEPTED:
                    memory[MISSED] = 0.0
                    if in_a_row > 0.0:
                        memory[HITS] += 1.0
                trusted = True
                for s in range(len(standing)):
                    if standing[s, IN_A_ROW] > 0.0:
                        trusted = False
                if trusted:
                    running = 1
                elif has_failed(memory):
                    running = 1
                    memory[LEVEL] = (memory[LEVEL] + 1.0) % (WIDEST + 1.0)
                    memory[TRUSTED] = 0.0
                elif memory[LEVEL] < WIDEST and too_narrow(states, memory):
                    widen(states, memory)
                if running == 2 and in_a_row >= recovery and memory[HITS] >= recovery:
                    recovery_out[recoveries, 0] = now
                    recovery_out[recoveries, 1] = sensor
                    recovery_out[recoveries, 2] = min(memory[SINCE], standing[sensor, FIRST])
                    recovery_out[recoveries, 3] = in_a_row
                    recoveries += 1
                    for j in range(28):
                        states[0, j] = states[1, j]
                    forgive(standing, lock_out_limit, lock_out_out)
                    running = 1
                    memory[LEVEL] = (memory[LEVEL] + 1.0) % (WIDEST + 1.0)
                    memory[TRUSTED] = 0.0
                    memory[PASSES] = WIDE_PASSES
                memory[CHALLENGED] = running - 1.0
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
            if k < n:
                end = edges[k + 1]
                whole = end - now
                theta = vector_at(increments, k)
    return segments, recoveries, lock_outs
