"""Rules of a gate: refusals by sensor, lock-outs, a restart candidate beside the filter, and restarts that widen.

They implement :class:`strapdown.estimation.gating.Gate` for any form of the state. Their state is ``memory`` (``MEMORY``,), of the restart
candidate, and ``counters`` (sensors, ``COUNTERS``), the counters of each sensor. :mod:`strapdown.kernels.gate` calls them compiled.

For each measurement :func:`judge_filter` counts the filter's outcome and may request a candidate (:func:`reset_candidate`); then
:func:`judge_candidate` counts the candidate's. A candidate whose start is too narrow is widened where :func:`may_widen` allows it; one
that :func:`takes_over` becomes the filter (:func:`recover`).
"""

from __future__ import annotations

import math

from strapdown.kernels.iterated_update import ACCEPTED, REFUSED

WIDE_PASSES = 20
"""Maximum number of linearisations of one update, of a candidate and of a filter that has recovered."""
WIDENING = 3.0
"""Factor on σ of the next candidate after one has failed, and of a candidate whose start was too narrow."""
WIDEST = 7
"""Number of widenings, to 2187 times the first σ, after which the next candidate is as narrow as the first."""
UNIFORM_SIGMA = math.pi / math.sqrt(3.0)
"""Standard deviation of an angle uniform over the whole turn, rad: upper limit of the attitude's σ."""
BIAS_MOVE = 2.366
"""Maximum of the squared change of a candidate's bias over its initial variance: the median of χ² of three degrees of freedom. A
candidate whose bias changes more is held back by its start and is widened; one that is wider than necessary does no harm."""
BIAS_GROWN = 1.05
"""Growth of the bias variance since the start above which the start no longer holds the bias back."""
MISFIT = 3.0
"""Standard deviations by which the summed NIS of a candidate may exceed its degrees of freedom; above that it is widened."""
TOLERANCE = 1
"""A candidate is dropped when it has refused more than this number plus half of those that it has accepted."""
MISSES_IN_A_ROW = 3
"""Number of refusals in a row at which it is dropped."""
FORGOTTEN = 5.0
"""Multiple of ``recovery``: after that number of accepted measurements since a candidate failed or took over, the next is as narrow as
the first."""

# Columns of ``memory``.
CANDIDATE = 0
"""Whether there is a candidate."""
PASSES = 1
"""Maximum number of linearisations of an update of the filter."""
LEVEL = 2
"""Number of widenings of the next candidate's σ."""
HITS = 3
"""Measurements that the filter refused and the candidate accepted."""
MISSES = 4
"""Measurements that the candidate refused."""
SINCE = 5
"""Time of the candidate's start, s."""
NIS = 6
DEGREES = 7
"""Summed NIS of the measurements accepted by the candidate, and their degrees of freedom."""
MISSED = 8
"""Refusals of the candidate in a row."""
TRUSTED = 9
"""Measurements accepted by the filter since a candidate failed or took over."""
FIRST_BIAS = 10
"""Bias of the candidate at its start (three columns) and its variances (three more)."""
FIRST_VARIANCE = 13
MEMORY = 16

# Columns of a sensor's row of ``counters``.
IN_A_ROW = 0
"""Refusals in a row."""
EXCESS = 1
"""Refusals less acceptances, between zero and twice the limit."""
NUMBER = 2
"""Refusals since the excess was zero, the time of the first and of the last of them, s."""
FIRST = 3
LAST = 4
LOCKED_OUT = 5
"""Whether the excess has exceeded the limit: these refusals are a lock-out."""
COUNTERS = 6

# Kinds of events.
RECOVERY = 0
LOCK_OUT = 1

# Outcomes for a candidate.
DROPPED = 0
FOLLOWED = 1
TOO_NARROW = 2


def judge_filter(outcome, now, sensor, recovery, limit, counters, memory, events, number):
    """Count the filter's outcome of a measurement; return the number of events, and whether a candidate must start.

    Refusals of a sensor that exceed its acceptances by more than ``limit`` are a lock-out. It becomes an event when it has ended and others
    begin; the last one of each sensor remains in the counters. ``recovery``: refusals in a row that start a candidate; 0: never.
    """
    counts = counters[sensor]
    if outcome == ACCEPTED:
        counts[IN_A_ROW] = 0.0
        counts[EXCESS] = max(counts[EXCESS] - 1.0, 0.0)
        memory[TRUSTED] += 1.0
    if outcome != REFUSED:
        return number, False
    counts[IN_A_ROW] += 1.0
    if counts[EXCESS] == 0.0:
        number = report_lock_out(sensor, counts, events, number)
        counts[NUMBER] = 0.0
        counts[FIRST] = now
    counts[EXCESS] = min(counts[EXCESS] + 1.0, 2.0 * limit)
    counts[NUMBER] += 1.0
    counts[LAST] = now
    if counts[EXCESS] > limit:
        counts[LOCKED_OUT] = 1.0
    if recovery == 0 or memory[CANDIDATE] > 0.0:
        return number, False
    if memory[TRUSTED] >= FORGOTTEN * recovery:
        memory[LEVEL] = 0.0
    return number, True


def report_lock_out(sensor, counts, events, number):
    """Report the lock-out in the counters of a sensor, if there is one; return the number of events."""
    if counts[LOCKED_OUT] == 0.0:
        return number
    row = events[number]
    row[0], row[1], row[2], row[3], row[4] = LOCK_OUT, sensor, counts[FIRST], counts[LAST], counts[NUMBER]
    counts[LOCKED_OUT] = 0.0
    return number + 1


def restart_width(memory):
    """Return the factor on the first σ for the next candidate."""
    return WIDENING ** memory[LEVEL]


def restart_attitude(sigma, memory):
    """Return σ of the next candidate's attitude, rad; that of the first is ``sigma``."""
    return max(sigma, min(restart_width(memory) * sigma, UNIFORM_SIGMA))


def reset_candidate(memory, now, bias, variance):
    """Store the candidate's bias (3,) and its variances (3,) at the start, and reset the counters."""
    memory[CANDIDATE] = 1.0
    memory[HITS] = 0.0
    memory[MISSES] = 0.0
    memory[SINCE] = now
    memory[MISSED] = 0.0
    memory[NIS] = 0.0
    memory[DEGREES] = 0.0
    for i in range(3):
        memory[FIRST_BIAS + i] = bias[i]
        memory[FIRST_VARIANCE + i] = variance[i]


def judge_candidate(outcome, nis, degrees, sensor, counters, memory, bias):
    """Count the candidate's outcome of a measurement, after the filter's, and return whether it is dropped, kept or too narrow.

    It is dropped when the filter accepts all sensors again, or when it fails itself; then the next one starts wider.
    """
    if outcome == REFUSED:
        memory[MISSES] += 1.0
        memory[MISSED] += 1.0
    elif outcome == ACCEPTED:
        memory[MISSED] = 0.0
        memory[NIS] += nis
        memory[DEGREES] += degrees
        if counters[sensor, IN_A_ROW] > 0.0:
            memory[HITS] += 1.0
    trusted = True
    for s in range(len(counters)):
        if counters[s, IN_A_ROW] > 0.0:
            trusted = False
    if trusted:
        memory[CANDIDATE] = 0.0
        return DROPPED
    if memory[MISSES] > TOLERANCE + 0.5 * memory[HITS] or memory[MISSED] >= MISSES_IN_A_ROW:
        step_aside(memory)
        return DROPPED
    move = 0.0
    for i in range(3):
        step = bias[i] - memory[FIRST_BIAS + i]
        move += step * step / memory[FIRST_VARIANCE + i]
    misfit = memory[NIS] > memory[DEGREES] + MISFIT * math.sqrt(2.0 * memory[DEGREES])
    if memory[LEVEL] < WIDEST and (move > BIAS_MOVE or misfit):
        return TOO_NARROW
    return FOLLOWED


def step_aside(memory):
    """Drop the candidate while the filter is still lost: the next one starts wider."""
    memory[CANDIDATE] = 0.0
    memory[LEVEL] = (memory[LEVEL] + 1.0) % (WIDEST + 1.0)
    memory[TRUSTED] = 0.0


def may_widen(variance, memory):
    """Return whether the start still holds back a candidate whose bias has these variances (3,)."""
    held = True
    for i in range(3):
        held = held and variance[i] <= BIAS_GROWN * memory[FIRST_VARIANCE + i]
    return held


def start_undone(i, variance, memory):
    """Return 1/s, s the innovation variance of the update that widens the start of component i of the bias; 0 if nothing is left of it.

    The start is a measurement of the bias with variance σ₀². A second update with the variance ``−σ₀²/(1 − 1/WIDENING²)`` turns it into
    one of ``WIDENING² σ₀²``, as if the candidate had started with that, and keeps all information of later measurements. If ``variance``,
    the present one of the component, is larger, widening the components before it has already removed the start of this one.
    """
    s = variance - memory[FIRST_VARIANCE + i] / (1.0 - 1.0 / (WIDENING * WIDENING))
    if s >= 0.0:
        return 0.0
    return 1.0 / s


def count_widening(memory):
    """Record that the candidate's start was widened, and reset its fit."""
    for i in range(3):
        memory[FIRST_VARIANCE + i] *= WIDENING * WIDENING
    memory[LEVEL] += 1.0
    memory[NIS] = 0.0
    memory[DEGREES] = 0.0


def takes_over(sensor, recovery, counters, memory):
    """Return whether the candidate takes over: it has accepted at least ``recovery`` measurements that the filter refused."""
    return counters[sensor, IN_A_ROW] >= recovery and memory[HITS] >= recovery


def recover(now, sensor, limit, counters, memory, events, number):
    """Report a recovery, from the first refusal, and reset the counters; return the number of events.

    It replaces the short lock-outs that it ends.
    """
    row, first = events[number], min(memory[SINCE], counters[sensor, FIRST])
    row[0], row[1], row[2], row[3], row[4] = RECOVERY, sensor, first, now, counters[sensor, IN_A_ROW]
    number += 1
    for s in range(len(counters)):
        if counters[s, NUMBER] > 2.0 * limit or counters[s, EXCESS] == 0.0:
            number = report_lock_out(s, counters[s], events, number)
        for j in range(COUNTERS):
            counters[s, j] = 0.0
    step_aside(memory)
    memory[PASSES] = WIDE_PASSES
    return number
