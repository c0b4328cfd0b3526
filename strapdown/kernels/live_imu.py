"""Samples of an IMU as they come, by the kernels that process a recording: what :class:`strapdown.ahrs.LiveAhrs` does with each sample.

Each kernel of a recording is called by its address for one step, or for one stamp, on arrays of two rows, so its bits are those of the
recording's run.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from strapdown.kernels.argument_tables import call, unpacked
from strapdown.kernels.live import FIRST, GYRO, LENGTH, ROW, SIGMA, TIME, VALUE, Live, process

FIRST_SAMPLE, START, SAMPLE = range(3)
"""What to do: take the first sample, show the state in which the filter starts at it, or take another sample."""
STEP, REST = 1, 2
"""Flags of a result: a step of the filter ended, a span in which rest is looked for ended."""
NO_TIME, BEHIND, NO_GYRO, INFINITE, TOO_FAST = range(-25, -20)
"""Refusals."""


class Routine(NamedTuple):
    """A compiled kernel that returns nothing."""

    address: int
    arguments: tuple[Any, ...]


class Imu(NamedTuple):
    """Arrays of an IMU's samples and of the kernels that process them."""

    filter: Live
    """Its ``call`` has the sample: time, gyro and accelerometer."""
    follow: Routine
    average: Routine
    end: Routine
    level: Routine
    tilt: Routine
    carry: Routine
    interval: float
    """Usual interval of the samples, s."""
    step: float
    """Interval of the filter's steps, s."""
    noise: float
    """Noise density of the specific force, m/s²/√Hz."""
    largest_rate: float
    late: float
    """Delay of the samples, s."""
    start: np.ndarray
    """Time of the first sample (1,)."""
    time: np.ndarray
    rate: np.ndarray
    turned: np.ndarray
    """The last two samples (2,), (2, 3), and the attitude by the gyro at them (2, 4)."""
    force: np.ndarray
    frame: np.ndarray
    """Specific force and attitude by the gyro at the samples of the step, after that at its start (most, 3), (most, 4)."""
    edge: np.ndarray
    """0 and the number of samples in the step (2,)."""
    number: np.ndarray
    """Number of them with a specific force (1,)."""
    mean: np.ndarray
    turn: np.ndarray
    levels: np.ndarray
    """Level of the acceleration before the step, and its NIS over its degrees of freedom (2, 1)."""
    level_after: np.ndarray
    """(2, 1)"""
    state: np.ndarray
    """Attitude and bias of the filter (7 or more,)."""
    numbers: np.ndarray
    places: np.ndarray
    """Numbers of its covariance, and the place in them of each element of that of attitude and bias (6, 6)."""
    attitude: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    """Estimate at the start of the step (1, 4), (1, 3), (1, 6), (1, 6, 6)."""
    stamp_time: np.ndarray
    stamp_rate: np.ndarray
    stamp_turned: np.ndarray
    ahead: np.ndarray
    """Start of the step and last sample: time (2,), rate (2, 3), attitude by the gyro (2, 4), rotation over the delay (2, 3)."""
    span_time: np.ndarray
    span_rate: np.ndarray
    span_force: np.ndarray
    """Samples of the span in which rest is looked for (length,), (length, 3)."""
    in_span: np.ndarray
    """Number of them (1,)."""


def take(kind, table, task):
    """Process the sample in the call; return flags, or a refusal, which leaves everything as it was."""
    imu = unpacked(kind, table)
    flags = 0
    if task != START:
        flags = refusal(imu, task)
        if flags < 0:
            return flags
        flags = keep_for_rest(imu)
    if task == FIRST_SAMPLE:
        begin(imu)
        return flags
    if task == START:
        show_step(imu)
    elif turn_with_gyro(imu):
        ended = end_step(imu)
        if ended < 0:
            return ended
        flags += STEP
    write_stamp(imu, 1)
    call(imu.carry.address, imu.carry.arguments, ())
    return flags


def refusal(imu, task):
    """Return the reason to refuse a sample, or 0."""
    given = imu.filter.call
    if not abs(given[TIME]) < math.inf:
        return NO_TIME
    if task != FIRST_SAMPLE and given[TIME] <= imu.time[1]:
        return BEHIND
    for i in range(3):
        if math.isnan(given[GYRO + i]):
            return NO_GYRO
        if abs(given[GYRO + i]) > imu.largest_rate or abs(given[FIRST + i]) == math.inf:
            return INFINITE
    if task != FIRST_SAMPLE and imu.edge[1] + 1 >= len(imu.force):
        return TOO_FAST
    return 0


def keep_for_rest(imu):
    """Write the sample to the span in which rest is looked for; return ``REST`` if it is the last one of the span."""
    k = imu.in_span[0]
    imu.span_time[k] = imu.filter.call[TIME]
    for i in range(3):
        imu.span_rate[k, i] = imu.filter.call[GYRO + i]
        imu.span_force[k, i] = imu.filter.call[FIRST + i]
    imu.in_span[0] = (k + 1) % len(imu.span_time)
    return REST if k + 1 == len(imu.span_time) else 0


def write_sample(imu, row):
    """Write time and rate of the sample to a row of the last two."""
    imu.time[row] = imu.filter.call[TIME]
    for i in range(3):
        imu.rate[row, i] = imu.filter.call[GYRO + i]


def write_stamp(imu, row):
    """Write the last sample to a row of the stamps."""
    imu.stamp_time[row] = imu.time[1]
    for i in range(3):
        imu.stamp_rate[row, i] = imu.rate[1, i]
        imu.ahead[row, i] = imu.rate[1, i] * imu.late
    for i in range(4):
        imu.stamp_turned[row, i] = imu.turned[1, i]


def begin(imu):
    """Start at the first sample, with the identity as attitude by the gyro."""
    write_sample(imu, 1)
    imu.start[0] = imu.time[1]
    imu.filter.clock[0] = imu.time[1]
    for i in range(4):
        imu.turned[1, i] = 1.0 if i == 0 else 0.0
    begin_step(imu)


def begin_step(imu):
    """Start a step at the last sample."""
    imu.edge[1] = 0
    for i in range(4):
        imu.frame[0, i] = imu.turned[1, i]
    write_stamp(imu, 0)


def turn_with_gyro(imu):
    """Follow the gyro to the sample; return whether it ends a step."""
    imu.time[0] = imu.time[1]
    for i in range(3):
        imu.rate[0, i] = imu.rate[1, i]
    for i in range(4):
        imu.turned[0, i] = imu.turned[1, i]
    write_sample(imu, 1)
    call(imu.follow.address, imu.follow.arguments, ())
    m = imu.edge[1] + 1
    imu.edge[1] = m
    for i in range(3):
        imu.force[m, i] = imu.filter.call[FIRST + i]
    for i in range(4):
        imu.frame[m, i] = imu.turned[1, i]
    before = math.floor((imu.time[0] + imu.interval - imu.start[0]) / imu.step + 1e-6)
    return math.floor((imu.time[1] + imu.interval - imu.start[0]) / imu.step + 1e-6) != before


def end_step(imu):
    """Filter the step, and update the level of the acceleration."""
    live = imu.filter
    call(imu.average.address, imu.average.arguments, ())
    call(imu.end.address, imu.end.arguments, ())
    number = imu.number[0]
    count = 0
    if number > 0.0:
        count = 1
        length = live.declared[0, LENGTH]
        for i in range(ROW):
            live.rows[0, i] = live.declared[0, i]
        live.rows[0, TIME] = imu.time[1]
        live.rows[0, SIGMA] = imu.noise / math.sqrt(number * imu.interval) / length
        for i in range(3):
            live.rows[0, VALUE + i] = imu.mean[0, i] / length
    for i in range(3):
        live.increment[i] = imu.turn[0, i]
    code = process(live, imu.time[1], count, 1)
    if code < 0:
        return code
    nis = 1.0
    if count > 0:
        total = live.innovation[0, 0] * live.innovation[0, 0] / live.innovation[0, 1]
        total += live.innovation[0, 2] * live.innovation[0, 2] / live.innovation[0, 3]
        total += live.innovation[0, 4] * live.innovation[0, 4] / live.innovation[0, 5]
        if abs(total) < math.inf:
            nis = total / 3.0
    imu.levels[0, 0] = imu.level_after[1, 0]
    imu.levels[1, 0] = nis
    call(imu.level.address, imu.level.arguments, ())
    begin_step(imu)
    show_step(imu)
    return 0


def show_step(imu):
    """Write the state of the filter, and the scale of its tilt, for the stamps up to the next step."""
    for i in range(4):
        imu.attitude[0, i] = imu.state[i]
    for i in range(3):
        imu.bias[0, i] = imu.state[4 + i]
    for i in range(6):
        for j in range(6):
            imu.covariance[0, i, j] = imu.numbers[imu.places[i, j]]
        imu.variance[0, i] = imu.covariance[0, i, i]
    call(imu.tilt.address, imu.tilt.arguments, ())
