"""The loop of every filter over a record: one gyro interval after the other, split at the times of measurements.

A filter is a module that defines the functions left open here; :func:`strapdown.kernels.machine.compiled` binds them. The state of the
loop is the value that ``begin`` returns; the filter's own data (state, noise, options, work arrays) are in a NamedTuple, ``body``.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import combine, dot, scale
from strapdown.kernels.measurement import vector_at
from strapdown.kernels.series import LARGEST_ANGLE, SQUARED_RANGE

OPEN = ("begin", "keep", "longest_step", "predict", "update", "finish")
REPLACEABLE = ("stopped", "increment_over")


MAX_TURN = 1e6
"""Maximum rotation by the bias in a step, rad; a larger one belongs to a diverged filter and is not divided into sub-steps."""


def turn_squared(part, dt, b):
    """Return the squared rotation angle of a step."""
    turn = combine(1.0, part, -dt, b)
    return dot(turn, turn)


def step_within(squared, dt):
    """Return the longest step, s, within the limit of the polynomials, for a rotation of this squared angle over dt."""
    if SQUARED_RANGE < squared < MAX_TURN * MAX_TURN:
        return dt * (LARGEST_ANGLE / math.sqrt(squared))
    return dt


def begin(body):
    """Return the state before the first measurement."""


def longest_step(state, part, dt, body):
    """Return the longest step, s, into which an increment over dt may be divided."""


def predict(state, part, dt, body, out):
    """Return the state after an increment over dt."""


def update(state, e, now, measured, body, out):
    """Return the state after the e-th measurement, at the time ``now``."""


def keep(state, row, e, body, out):
    """Write the state at a stored edge to a row of the outputs and return it; e measurements have been processed."""


def increment_over(increments, k, body):
    """Return the increment of interval k; zero for the interval before the first edge."""
    if k < 0:
        return (0.0, 0.0, 0.0)
    return vector_at(increments, k)


def stopped(state):
    """Return whether the walk ends here; by default it continues to the end."""
    return False


def finish(state, row, e, body):
    """Store the end state in ``body``, after these numbers of rows and measurements; return the results for the caller."""


def walk(edges, increments, measured, every, body, out):
    """Run a filter over a record.

    ``edges`` (n + 1,) and ``increments`` (n, 3) are the gyro's; measurements lie between the first and the last edge. The state is stored
    at every ``every``-th edge, starting with the first. Rotations beyond the limit of the polynomials are divided into sub-steps: at
    constant rate they compose exactly, so this is the same model.
    """
    state = begin(body)
    time = measured.time
    events = len(time)
    none = 0 * events  # an integer, not the literal 0, for whose type numba would compile the body too
    e = none
    k = -1  # the interval before the first edge has no duration; the measurements at the first edge belong to it
    now = edges[0]
    ahead = 0.0  # duration of the sub-steps since: added to a time, it would be rounded to that time's digits
    end = now
    whole = 1.0
    theta = increment_over(increments, k, body)
    countdown = 0
    row = none
    # One pass predicts to the next measurement or edge, updates with a measurement there, and closes an interval that ends there.
    while k < len(increments) and not stopped(state):
        due = e < events and time[e] <= end
        stop = time[e] if due else end
        dt = stop - now - ahead
        if dt > 0.0:
            part = theta
            # Usually a whole interval: a predicted branch costs less than a selection of values, which waits for both.
            if dt != whole or longest_step(state, part, dt, body) < dt:
                part = scale(dt / whole, theta)
                longest = longest_step(state, part, dt, body)
                if longest < dt:
                    part = scale(longest / dt, part)
                    dt = longest
                    stop = now
                    due = False
            state = predict(state, part, dt, body, out)
        ahead = ahead + dt if stop == now else 0.0
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
                theta = increment_over(increments, k, body)
    return finish(state, row, e, body)
