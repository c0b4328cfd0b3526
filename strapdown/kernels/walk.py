"""The loop of every filter over a record: from gyro interval to gyro interval, split at the times of measurements.

A filter is a module that defines the functions left open here (a *body*); :func:`strapdown.kernels.machine.compiled` binds them. Its
state is whatever ``begin`` returns, and what it needs beside (noise, options, scratch) is in ``body``, a NamedTuple of its own.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import combine, dot, scale
from strapdown.kernels.measurement import vector_at
from strapdown.kernels.series import LARGEST_ANGLE

OPEN = ("begin", "keep", "longest_step", "predict", "update", "finish")
REPLACEABLE = ("stopped",)


MAX_TURN = 1e6
"""rad: a step whose bias turns the body by more belongs to a filter that is lost, and is not cut into sub-steps."""
SQUARED_RANGE = LARGEST_ANGLE * LARGEST_ANGLE
"""Of the polynomials, rad²."""


def turn_squared(part, dt, b):
    """Return the squared angle of the turn of a step."""
    turn = combine(1.0, part, -dt, b)
    return dot(turn, turn)


def step_within(squared, dt):
    """Return the longest step, s, of a turn of this squared angle over dt that the polynomials bear."""
    if SQUARED_RANGE < squared < MAX_TURN * MAX_TURN:
        return dt * (LARGEST_ANGLE / math.sqrt(squared))
    return dt


def begin(body):
    """Return the state before the first measurement."""


def longest_step(state, part, dt, body):
    """Return the longest step, s, that an increment over dt may be cut into."""


def predict(state, part, dt, body, out):
    """Return the state after an increment over dt."""


def update(state, e, now, measured, body, out):
    """Return the state after the e-th measurement, at the time ``now``."""


def keep(state, row, e, body, out):
    """Write the state at a kept edge to a row of the outputs and return it; e measurements have been processed."""


def stopped(state):
    """Return whether the walk ends here; where a filter does not say, it goes on to the end."""
    return False


def finish(state, row, e, body):
    """Leave the end state in ``body``, after so many rows and measurements; return what the caller wants to know."""


def walk(edges, increments, measured, every, body, out):
    """Run a filter over a record.

    ``edges`` (n + 1,) and ``increments`` (n, 3) are the gyro's; measurements lie between the first and the last edge. A state is kept at
    every ``every``-th edge, the first included. Turns beyond the range of the polynomials are cut into sub-steps: at constant rate they
    compose exactly, so this is the same model.
    """
    state = begin(body)
    time = measured.time
    events = len(time)
    none = 0 * events  # an integer like any other and not the literal 0: numba would compile the body for that type too
    e = none
    k = -1  # the interval before the first edge has no length; its end takes the measurements at the first edge
    now = edges[0]
    end = now
    whole = 1.0
    theta = (0.0, 0.0, 0.0)
    countdown = 0
    row = none
    # One pass predicts to the next measurement or edge, updates with the measurement, and closes the interval, each where there is one.
    while k < len(increments) and not stopped(state):
        due = e < events and time[e] <= end
        stop = time[e] if due else end
        dt = stop - now
        if dt > 0.0:
            part = theta
            # Most often a whole interval: a predicted branch costs less than a choice between values, which waits for both.
            if dt != whole or longest_step(state, part, dt, body) < dt:
                part = scale(dt / whole, theta)
                longest = longest_step(state, part, dt, body)
                if longest < dt:
                    part = scale(longest / dt, part)
                    dt = longest
                    stop = now + dt
                    due = False
            state = predict(state, part, dt, body, out)
            now = stop
        if due:
            state = update(state, e, now, measured, body, out)
            e += 1
        if now >= end and (e == events or time[e] > end):
            if countdown == 0:
                countdown = every
                state = keep(state, row, e, body, out)
                row += 1
            countdown -= 1
            k += 1
            if k < len(increments):
                end = edges[k + 1]
                whole = end - now
                theta = vector_at(increments, k)
    return finish(state, row, e, body)
