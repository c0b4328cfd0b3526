"""A gate and robust weights around the filter of :mod:`strapdown.kernels.filter`; run by :mod:`strapdown.kernels.walk`.

Updates are in :mod:`strapdown.kernels.gated_update`, the consequences of refusals in :mod:`strapdown.kernels.gate_rules`. Row 0 of the
states is the filter, row 1 the restart candidate (:mod:`strapdown.kernels.restart_candidate`), if there is one; both are processed by the
same code.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.filter import increment_over as increment_of_filter
from strapdown.kernels.filter import store_segment, write_row
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
from strapdown.kernels.gated_update import iterated_update, judge
from strapdown.kernels.layout import bias_at
from strapdown.kernels.measurement import KIND, degrees_of_freedom, store_innovations
from strapdown.kernels.model import propagate
from strapdown.kernels.restart_candidate import replace_by_candidate, start_candidate, widen
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

    filter: Filter
    options: Options
    restart: Restart
    """Initial values of a candidate."""
    counters: np.ndarray
    """Counters of each sensor (sensors, ``COUNTERS``); at return, their final values."""
    memory: np.ndarray
    """Counters of the candidate (``MEMORY``,); at return, final values. Initially zero, except ``PASSES`` = 1."""


class Outputs(NamedTuple):
    """Outputs of a run in addition to those of the filter."""

    filter: FilterOutputs
    weight: np.ndarray
    """Weight of each measurement (events,), by place; 0: refused."""
    events: np.ndarray
    """(rows, 5): kind, sensor, start, end and number of refusals of each recovery and lock-out, except lock-outs in the counters."""


# ----------------------------------------------------------------------------------------------------------- the functions for the walk


def increment_over(increments, k, body):
    """Return the increment of interval k."""
    return increment_of_filter(increments, k, body.filter)


def begin(body):
    """Return the numbers of states, events and segments, and whether a measurement was too precise."""
    # From an array, and not literals: numba would compile the body for that type too.
    none = 0 * len(body.memory)
    running = none + 1
    if body.memory[CANDIDATE] > 0.0:
        running = none + 2
    return running, none, none, running < 0


def longest_step(state, part, dt, body):
    """Return the longest step, s, common to all states: that of the largest rotation."""
    squared = 0.0
    for i in range(state[0]):
        squared = max(squared, turn_squared(part, dt, bias_at(body.filter, i)))
    return min(step_within(squared, dt), body.filter.model.limit)


def predict(state, part, dt, body, out):
    """Propagate the filter and the candidate."""
    running, events, segments, lost = state
    f = body.filter
    if segments < len(out.filter.segments):
        store_segment(out.filter.segments, segments, dt, part, f.x[0], f.P[0])
        segments += 1
    for i in range(running):
        propagate(f, i, part, dt, 0.0)
    return running, events, segments, lost


def update(state, e, now, measured, body, out):
    """Test a measurement with the filter and the candidate, if there is one, and update."""
    running, events, segments, lost = state
    f, options, memory, counters = body.filter, body.options, body.memory, body.counters
    recovery, limit = options.recovery, options.lock_out
    place = measured.place[e]
    sensor = measured.sensor[e]
    degrees = degrees_of_freedom(measured.series[sensor, KIND])
    i = 0
    while i < running:
        passes = int(memory[PASSES]) if i == 0 else WIDE_PASSES
        if passes == 1:
            outcome, weight, innovation, variance, too_precise = judge(f.shape[sensor], f, measured, e, options, 0.0)
        else:
            outcome, weight, innovation, variance, too_precise = iterated_update(f, i, e, measured, passes, options)
        if i == 0:
            lost = lost or too_precise
            out.weight[place] = weight
            store_innovations(out.filter.innovation, place, innovation, variance)
            events, start = judge_filter(outcome, now, sensor, recovery, limit, counters, memory, out.events, events)
            if start:
                start_candidate(f, memory, now, options.attitude_sigma, body.restart)
                running = 2
        else:
            nis = 0.0
            for r in range(3):
                nis += innovation[r] * innovation[r] / variance[r]
            verdict = judge_candidate(outcome, nis, degrees, sensor, counters, memory, bias_at(f, 1))
            if verdict == DROPPED:
                running = 1
            elif verdict == TOO_NARROW:
                widen(f, memory)
            if verdict != DROPPED and takes_over(sensor, recovery, counters, memory):
                events = recover(now, sensor, limit, counters, memory, out.events, events)
                replace_by_candidate(f)
                running = 1
        i += 1
    return running, events, segments, lost


def keep(state, row, e, body, out):
    """Write a row."""
    write_row(body.filter, row, out.filter)
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
