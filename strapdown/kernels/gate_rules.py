"""How a gate judges: refusals sensor by sensor, lock-outs, a challenger beside the filter, and restarts that widen.

The rules of :class:`strapdown.estimation.gating.Gate`; none depends on the form of a state. They work on what a gate remembers:
``memory`` (``MEMORY``,) of the challenger, and ``standing`` (sensors, ``STANDING``). The record loops of both filters call them compiled
(:mod:`strapdown.kernels.robust_loop`, :mod:`strapdown.kernels.augmented_robust`), the step faces as they are, by
:mod:`strapdown.estimation.judging`.

Of each measurement :func:`judge_filter` counts what the filter has made of it, and may ask for a challenger (:func:`begin_challenge`); then
:func:`judge_challenger` what the challenger has made of it. One that is too narrow is made wider where :func:`may_widen` says so; one that
:func:`is_believed` becomes the filter (:func:`recover`).
"""

from __future__ import annotations

import math

from strapdown.kernels.iterated_update import ACCEPTED, REFUSED

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""

WIDE_PASSES = 20
"""Linearisations of one update at most, of a challenger and of a filter that has recovered."""
WIDENING = 3.0
"""Each challenger that fails makes the next one's σ so many times wider, and so is one made that was too narrow."""
WIDEST = 7
"""After so many widenings, to 2187 times the first σ, the next challenger is as narrow as the first."""
UNIFORM_SIGMA = math.pi / math.sqrt(3.0)
"""Standard deviation of an angle uniform over the whole turn, rad: no widening of the attitude goes beyond."""
BIAS_MOVE = 2.366
"""Largest squared move of a challenger's bias over its first variance: the median of χ² of three degrees of freedom. One that moves
farther is held back by its start, and is made wider; one wider than need be does no harm."""
BIAS_GROWN = 1.05
"""A bias whose variance has grown so many times since the start is not held back by it."""
MISFIT = 3.0
"""The NIS of what a challenger accepts may add up to so many standard deviations above the degrees of freedom, or it is made wider."""
TOLERANCE = 1
"""A challenger may refuse so many measurements, and half of those that it accepts, before it is dropped."""
MISSES_IN_A_ROW = 3
"""It is dropped when it refuses so many in a row."""
FORGOTTEN = 5.0
"""When the filter has accepted so many times ``recovery`` since a challenger failed or took over, the next is as narrow as the first."""

# Columns of ``memory``.
CHALLENGED = 0
"""Whether there is a challenger."""
PASSES = 1
"""Linearisations of an update of the filter."""
LEVEL = 2
"""How often the next challenger's σ is widened."""
HITS = 3
"""What the challenger has accepted of what the filter refused."""
MISSES = 4
"""What it has refused."""
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
"""The challenger's bias at its start, three columns, and the variances of it, three more."""
FIRST_VARIANCE = 13
MEMORY = 16

# Columns of a sensor's row of ``standing``.
IN_A_ROW = 0
"""Refusals in a row."""
EXCESS = 1
"""Refusals less acceptances, between zero and twice the limit."""
NUMBER = 2
"""Refusals since the excess was zero, the time of the first and of the last of them, s."""
FIRST = 3
LAST = 4
TOLD = 5
"""Row of ``lock_outs`` that tells of them, −1 while none does."""
STANDING = 6

# What becomes of a challenger.
DROPPED = 0
FOLLOWED = 1
TOO_NARROW = 2


def judge_filter(outcome, now, sensor, recovery, limit, standing, memory, lock_outs, told):
    """Count what the filter has made of a measurement; return the lock-outs told, and whether a challenger is to start.

    ``limit``: so many more of a sensor may be refused than accepted before it is told, in a row of ``lock_outs``: times of the first and of
    the last refusal, sensor and number. ``recovery``: 0: never.
    """
    seat = standing[sensor]
    if outcome == ACCEPTED:
        seat[IN_A_ROW] = 0.0
        seat[EXCESS] = max(seat[EXCESS] - 1.0, 0.0)
        memory[TRUSTED] += 1.0
    if outcome != REFUSED:
        return told, False
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
    if recovery == 0 or memory[CHALLENGED] > 0.0:
        return told, False
    if memory[TRUSTED] >= FORGOTTEN * recovery:
        memory[LEVEL] = 0.0
    return told, True


def restart_width(memory):
    """Return how many times the first σ the next challenger's is."""
    return WIDENING ** memory[LEVEL]


def restart_attitude(sigma, memory):
    """Return σ of the next challenger's attitude where that of the first is ``sigma``, rad."""
    return max(sigma, min(restart_width(memory) * sigma, UNIFORM_SIGMA))


def begin_challenge(memory, now, bias, variance):
    """Remember the challenger's bias and the variances of it (3,) at its start, and count from zero."""
    memory[CHALLENGED] = 1.0
    memory[HITS] = 0.0
    memory[MISSES] = 0.0
    memory[SINCE] = now
    memory[MISSED] = 0.0
    memory[NIS] = 0.0
    memory[DEGREES] = 0.0
    for i in range(3):
        memory[FIRST_BIAS + i] = bias[i]
        memory[FIRST_VARIANCE + i] = variance[i]


def judge_challenger(outcome, nis, degrees, sensor, standing, memory, bias):
    """Count what the challenger has made of a measurement that the filter has been judged by, and return what becomes of it.

    It is dropped when the filter is trusted again, no sensor being refused, or when it fails; the next starts wider then.
    """
    if outcome == REFUSED:
        memory[MISSES] += 1.0
        memory[MISSED] += 1.0
    elif outcome == ACCEPTED:
        memory[MISSED] = 0.0
        memory[NIS] += nis
        memory[DEGREES] += degrees
        if standing[sensor, IN_A_ROW] > 0.0:
            memory[HITS] += 1.0
    trusted = True
    for s in range(len(standing)):
        if standing[s, IN_A_ROW] > 0.0:
            trusted = False
    if trusted:
        memory[CHALLENGED] = 0.0
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
    """End a challenge by which the filter did not right itself: the next starts wider."""
    memory[CHALLENGED] = 0.0
    memory[LEVEL] = (memory[LEVEL] + 1.0) % (WIDEST + 1.0)
    memory[TRUSTED] = 0.0


def may_widen(variance, memory):
    """Return whether the start still holds back a challenger whose bias has these variances (3,)."""
    held = True
    for i in range(3):
        held = held and variance[i] <= BIAS_GROWN * memory[FIRST_VARIANCE + i]
    return held


def start_undone(i, variance, memory):
    """Return 1/s, s the variance of the innovation that gives component i of the bias back what its start took; 0 where nothing is left.

    The start is a measurement of the bias, of variance σ₀². Taken in again with the variance ``−σ₀²/(1 − 1/WIDENING²)``, it leaves one of
    ``WIDENING² σ₀²``, as if the challenger had started so, and nothing that it has seen is lost. Where ``variance``, the component's own by
    now, is beyond that, the components before it have left more than its start allows: it holds nothing back any more.
    """
    s = variance - memory[FIRST_VARIANCE + i] / (1.0 - 1.0 / (WIDENING * WIDENING))
    if s >= 0.0:
        return 0.0
    return 1.0 / s


def count_widening(memory):
    """Count a challenger as one that has started wider, and its fit from zero."""
    for i in range(3):
        memory[FIRST_VARIANCE + i] *= WIDENING * WIDENING
    memory[LEVEL] += 1.0
    memory[NIS] = 0.0
    memory[DEGREES] = 0.0


def is_believed(sensor, recovery, standing, memory):
    """Return whether the challenger takes over: it agrees with as many measurements that the filter refused as this sensor's in a row."""
    return standing[sensor, IN_A_ROW] >= recovery and memory[HITS] >= recovery


def recover(now, sensor, limit, standing, memory, row, lock_outs):
    """Tell of a recovery in a row (4,), time, sensor, time of the first refusal and refusals in a row, and set the counts back.

    It tells of the short lock-outs that it ends too: their number is set to zero.
    """
    row[0] = now
    row[1] = sensor
    row[2] = min(memory[SINCE], standing[sensor, FIRST])
    row[3] = standing[sensor, IN_A_ROW]
    for s in range(len(standing)):
        if standing[s, TOLD] >= 0.0 and standing[s, NUMBER] <= 2.0 * limit and standing[s, EXCESS] > 0.0:
            lock_outs[int(standing[s, TOLD]), 3] = 0.0
        for j in range(STANDING):
            standing[s, j] = 0.0
        standing[s, TOLD] = -1.0
    step_aside(memory)
    memory[PASSES] = WIDE_PASSES
