"""A filter for one gyro interval at a time: what :class:`strapdown.estimation.LiveFilter` does with each sample.

A sample is checked, its measurements become rows with what the sensors declare, and the compiled :func:`strapdown.kernels.walk.walk` of
records is called by its address for the interval, so the machine code, and thus every bit, is that of a record's run.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from strapdown.kernels.argument_tables import call, unpacked
from strapdown.kernels.measurement import ATTITUDE, HEADING, KIND, VECTOR, Measurements

NO_TURN, RATE, INCREMENT, AGAIN = range(4)
"""What a call has of the gyro; ``AGAIN``: an interval of the past, already in the arrays."""
DONE, REPORT, PENDING = 0, 1, 2
"""Results of a call: done; done, and the gate has events to report; measurements that were not used, because they are of the past."""
NO_TIME, AHEAD, BEHIND, NO_GYRO, INFINITE_GYRO, LARGE_GYRO, INFINITE, NO_DIRECTION, TOO_PRECISE = range(-9, 0)
"""Refusals."""
LARGEST_TURN = 1e6
"""Maximum rotation in an interval, rad."""
UNIT = 2e-6
"""A measured direction whose squared length differs from 1 by less than this is used without normalisation, as in a record."""

TIME, GYRO, FIRST, STRIDE = 0, 1, 4, 5
"""Places in a call: time, gyro, and from ``FIRST`` on for each measurement its sensor and up to four numbers."""
SENSOR, VALUE, FRAME, SIGMA, NOISE, LENGTH, ROW = 1, 2, 5, 14, 15, 21, 22
"""Columns of a row: time, sensor, value (3), frame (9), σ, covariance (6), divisor of the effects of error states."""


class Live(NamedTuple):
    """A filter and its arrays, of which the filter's arguments have read-only views."""

    address: int
    """Address of the compiled walk."""
    arguments: tuple[Any, ...]
    """Arguments of the walk: two edges, one increment, the most measurements."""
    result: tuple[int, ...]
    """As many numbers as it returns."""
    holds: int
    """Whether measurements without a gyro sample are left to the caller, who keeps the intervals of a look-back."""
    call: np.ndarray
    """Time, gyro (3), and sensor and value (4) of each measurement."""
    clock: np.ndarray
    """Time of the state (1,)."""
    edges: np.ndarray
    increment: np.ndarray
    """(3,)"""
    time: np.ndarray
    sensor: np.ndarray
    value: np.ndarray
    """(3 most,)"""
    sigma: np.ndarray
    noise: np.ndarray
    """(most, 6), or (0, 6) if σ defines all noise."""
    frame: np.ndarray
    length: np.ndarray
    rows: np.ndarray
    """Measurements of the interval (most, ``ROW``)."""
    declared: np.ndarray
    """Row of each sensor."""
    state: np.ndarray
    """Whatever changes from one interval to the next."""
    before: np.ndarray
    """The same before the last interval."""
    counts: np.ndarray
    """Refused measurements, and headings of vertical vectors (sensors, 2); part of the state."""
    missing: np.ndarray
    """Number of missing measurements (sensors,), and those of this call."""
    missing_now: np.ndarray
    innovation: np.ndarray
    weight: np.ndarray
    report: np.ndarray
    """Two numbers that the walk returned, number of measurements of the call, of the last interval, and sensor of a refused one (5,)."""


NUMBER, LAST, CULPRIT = 2, 3, 4
"""Places in ``report``."""


def step(kind, table, number, turn):
    """Process a call with a number of measurements; return its result, or a refusal, which leaves the filter as it was."""
    live = unpacked(kind, table)
    now = live.clock[0]
    time = live.call[TIME]
    count = number
    if turn != AGAIN:
        code = check_time(now, time, turn)
        if code == DONE and turn != NO_TURN:
            code = read_gyro(live, time - now, turn)
        if code == DONE:
            code = read_measurements(live, time, number)
        if code != DONE:
            return code
        count = live.report[NUMBER]
        for s in range(len(live.missing)):
            live.missing[s] += live.missing_now[s]
    intervals = 1
    if turn == NO_TURN or not time > now:
        if count == 0:
            return DONE
        if turn != AGAIN and (live.holds or time < now):
            return PENDING
        intervals = 0
    return process(live, time, count, intervals)


def check_time(now, time, turn):
    """Check the time of a call."""
    if not abs(time) < math.inf:
        return NO_TIME
    if turn == NO_TURN:
        return AHEAD if time > now else DONE
    return BEHIND if time < now else DONE


def read_gyro(live, dt, turn):
    """Check the gyro, and write the increment."""
    for i in range(3):
        x = live.call[GYRO + i]
        if math.isnan(x):
            return NO_GYRO
        if abs(x) == math.inf:
            return INFINITE_GYRO
        if turn == RATE:
            x = x * dt
        if abs(x) > LARGEST_TURN:
            return LARGE_GYRO
        live.increment[i] = x
    return DONE


def read_measurements(live, time, number):
    """Write the measurements of a call to the rows, in the order of the sensors."""
    live.report[NUMBER] = 0
    for s in range(len(live.declared)):
        live.missing_now[s] = 0.0
        for k in range(number):
            if live.call[FIRST + STRIDE * k] == s:
                code = read_measurement(live, time, s, FIRST + STRIDE * k + 1)
                if code != DONE:
                    live.report[CULPRIT] = s
                    return code
    return DONE


def read_measurement(live, time, s, at):
    """Write a measurement of sensor s to the next row, unless it is missing."""
    row = live.report[NUMBER]
    kind = live.arguments[2].series[s, KIND]
    missing = False
    for i in range(4 if kind == ATTITUDE else 3):
        if abs(live.call[at + i]) == math.inf:
            return INFINITE
        missing = missing or math.isnan(live.call[at + i])
    if missing:
        live.missing_now[s] = 1.0
        return DONE
    for i in range(ROW):
        live.rows[row, i] = live.declared[s, i]
    live.rows[row, TIME] = time
    if kind == ATTITUDE:
        for i in range(4):
            live.rows[row, FRAME + i] = live.call[at + i]
    else:
        x, y, z = live.call[at], live.call[at + 1], live.call[at + 2]
        length = 1.0
        if kind == VECTOR:
            length = live.declared[s, LENGTH]
        elif not abs(x * x + y * y + z * z - 1.0) < UNIT:
            largest = max(abs(x), abs(y), abs(z))
            if largest == 0.0:
                return NO_DIRECTION
            x, y, z = x / largest, y / largest, z / largest
            length = math.sqrt(x * x + y * y + z * z)
        live.rows[row, VALUE], live.rows[row, VALUE + 1], live.rows[row, VALUE + 2] = x / length, y / length, z / length
    live.report[NUMBER] = row + 1
    return DONE


def process(live, end, count, intervals):
    """Walk over an interval, or from its end to its end, with the measurements in the rows."""
    for i in range(len(live.state)):
        live.before[i] = live.state[i]
    live.edges[0], live.edges[1] = live.clock[0], end
    for k in range(count):
        write_measurement(live, k)
    edges, increments, every_measured, every, body, out = live.arguments
    measured = Measurements(
        every_measured.time[:count],
        every_measured.place[:count],
        every_measured.sensor[:count],
        every_measured.value,
        every_measured.sigma,
        every_measured.noise,
        every_measured.series,
        every_measured.triads,
    )
    interval = (edges[: intervals + 1], increments[:intervals], measured, every, body, out)
    result = call(live.address, interval, live.result)
    for i in range(len(result)):
        live.report[i] = result[i]
    if live.report[0] < 0:
        for i in range(len(live.state)):
            live.state[i] = live.before[i]
        return TOO_PRECISE
    live.clock[0] = end
    live.report[LAST] = count
    for k in range(count):
        s = live.sensor[k]
        if measured.series[s, KIND] == HEADING and math.isnan(live.innovation[k, 0]):
            live.counts[s, 1] += 1.0
        elif live.weight[k] == 0.0:
            live.counts[s, 0] += 1.0
    return REPORT if live.report[1] > 0 else DONE


def write_measurement(live, k):
    """Write row k as measurement k of the walk."""
    rows = live.rows
    live.time[k] = rows[k, TIME]
    live.sensor[k] = int(rows[k, SENSOR])
    for i in range(3):
        live.value[3 * k + i] = rows[k, VALUE + i]
    for i in range(9):
        live.frame[k, i] = rows[k, FRAME + i]
    live.sigma[k] = rows[k, SIGMA]
    if len(live.noise) > 0:
        for i in range(6):
            live.noise[k, i] = rows[k, NOISE + i]
    live.length[k] = rows[k, LENGTH]
