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
FIELD = FIRST + 3
"""Place of the magnetometer in a call."""
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
    """Its ``call`` has the sample: time, gyro, accelerometer and magnetometer."""
    magnetometer: int
    """Whether there is one."""
    follow: Routine
    average: Routine
    end: Routine
    scale: Routine
    carry: Routine
    average_field: Routine
    head: Routine
    field_mean: Routine
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
    field: np.ndarray
    """Field at the samples of the step (most, 3)."""
    field_number: np.ndarray
    """Number of them with a field (1,)."""
    head_frame: np.ndarray
    head_length: np.ndarray
    head_end: np.ndarray
    head_time: np.ndarray
    """Attitude by the gyro in the middle of the step, duration of the field's samples, attitude and time at the end (1, …)."""
    head_start: np.ndarray
    """Time of the first sample first (2,)."""
    direction: np.ndarray
    sigma: np.ndarray
    """Heading measurement at the end of the step (1, 3), and its σ (1,); 0: none."""
    iron_variance: np.ndarray
    """Variance of the heading by constant iron, at the end of the step (1,), and as reported (1,)."""
    iron: np.ndarray
    field_nis: np.ndarray
    """NIS of the last heading (1,)."""
    span_time: np.ndarray
    span_rate: np.ndarray
    span_force: np.ndarray
    span_field: np.ndarray
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
    call = imu.filter.call
    if not abs(call[TIME]) < math.inf:
        return NO_TIME
    if task != FIRST_SAMPLE and call[TIME] <= imu.time[1]:
        return BEHIND
    for i in range(3):
        if math.isnan(call[GYRO + i]):
            return NO_GYRO
        if (
            abs(call[GYRO + i]) > imu.largest_rate
            or abs(call[FIRST + i]) == math.inf
            or abs(call[FIELD + i]) == math.inf
        ):
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
        imu.span_field[k, i] = imu.filter.call[FIELD + i]
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
    imu.head_start[0] = imu.time[1]
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
        imu.field[m, i] = imu.filter.call[FIELD + i]
    for i in range(4):
        imu.frame[m, i] = imu.turned[1, i]
    before = math.floor((imu.time[0] + imu.interval - imu.start[0]) / imu.step + 1e-6)
    return math.floor((imu.time[1] + imu.interval - imu.start[0]) / imu.step + 1e-6) != before


def end_step(imu):
    """Filter the step, and update the level of the field's disturbance."""
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
    heading = False
    if imu.magnetometer > 0:
        heading = read_heading(imu)
        if heading:
            write_heading(imu, count)
            count += 1
    for i in range(3):
        live.increment[i] = imu.turn[0, i]
    code = process(live, imu.time[1], count, 1)
    if code < 0:
        return code
    if heading:
        innovation = live.innovation[count - 1, 0]
        nis = innovation * innovation / live.innovation[count - 1, 1]
        imu.field_nis[0] = nis if abs(nis) < math.inf else 0.0
        call(imu.field_mean.address, imu.field_mean.arguments, ())
    imu.iron[0] = imu.iron_variance[0]
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
    call(imu.scale.address, imu.scale.arguments, ())


def read_heading(imu):
    """Process the field of the step; return whether a heading ends with it."""
    m = imu.edge[1]
    call(imu.average_field.address, imu.average_field.arguments, ())
    for i in range(4):
        imu.head_frame[0, i] = imu.frame[(m + 1) // 2, i]
        imu.head_end[0, i] = imu.frame[m, i]
    imu.head_length[0] = imu.field_number[0] * imu.interval
    imu.head_time[0] = imu.time[1]
    call(imu.head.address, imu.head.arguments, ())
    return imu.sigma[0] > 0.0


def write_heading(imu, row):
    """Write the heading to a row of the filter's measurements."""
    rows = imu.filter.rows
    for i in range(ROW):
        rows[row, i] = imu.filter.declared[1, i]
    rows[row, TIME], rows[row, SIGMA] = imu.time[1], imu.sigma[0]
    for i in range(3):
        rows[row, VALUE + i] = imu.direction[0, i]
