"""Samples of an IMU as they come: what :class:`strapdown.ahrs.LiveAhrs` does with each, and the exported filter of an IMU too.

Each kernel of a recording is called by its address for one step, or for one stamp, on arrays of two rows, so its bits are those of the
recording's run. :mod:`strapdown.codegen.recording` executes the same functions on symbols.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from strapdown.kernels.algebra import dot
from strapdown.kernels.alignment import LARGE_TURN, SIZE, UNKNOWN, UNKNOWN_TURN, align_steps
from strapdown.kernels.argument_tables import call, unpacked
from strapdown.kernels.headings import heading_steps
from strapdown.kernels.live import LENGTH, ROW, SIGMA, TIME, VALUE, Live, process
from strapdown.kernels.measurement import vector_at
from strapdown.kernels.recording_samples import AGAIN, USUAL_TIME, is_beyond_range, is_damaged, is_strong
from strapdown.kernels.recording_steps import (
    average_samples,
    carry_to_stamps,
    end_steps,
    follow_gyro,
    innovation_density,
    scale_factors,
)
from strapdown.kernels.rests import find_rests

CHECK, START, SAMPLE = range(3)
"""What to do with a sample: check it, start at it, or take it."""
RESTED, ALIGNED = 1, 2
"""Results, which may be added: a step ended after a rest that shows the bias, or with a coarse alignment."""
NO_TIME, BEHIND, NO_GYRO, INFINITE, TOO_FAST, AHEAD = range(-26, -20)
"""Refusals."""
MAX_INTERVAL = 3600.0
"""Maximum interval between samples, s, over which the filter predicts step by step: of a clock that jumps it would take for hours."""

LONG_GAP = 0.5
"""Interval between samples, s, after which the attitude is unknown; of units with fewer samples four times the usual one."""
SHORT_GAP = 1.5
"""Interval between samples, relative to the usual one, above which the rotation over it is uncertain (:func:`turn_variance`)."""
RATE_MEMORY = 10.0
"""Time constant with which the mean square change of the rate over a step forgets, s."""
FIRST_RATE_CHANGE = 0.01
"""That mean square at first, (rad/s)²."""
GAP_SHARE = 0.06
"""Variance of the rotation over a gap T, relative to T² times the mean square change of the rate over T, if this is proportional to T^1.5.
By :func:`strapdown.recordings.sensor_faults.turn_variance_over` nine in ten of 47 recordings of eight sets have less at 0.05 to 0.5 s."""

MOST = -1
"""In a shape: the most samples of a step."""
LASTING = {
    "rate": ((3,), "", "last rate, rad/s"),
    "turned": ((4,), "", "attitude by the gyro alone, since the start"),
    "force": ((MOST, 3), "", "specific force at the samples of this step"),
    "frame": ((MOST, 4), "", "attitude by the gyro at its start and at its samples"),
    "force_innovation": ((1, 2), "", "last level innovations of the accelerometer over their sigma"),
    "force_density": ((1,), "", "density of the accelerometer's innovations at low frequency"),
    "force_averages": ((5,), "", "its averages and sums"),
    "tilt": ((1,), "", "factor on sigma of the tilt"),
    "heading": ((1,), "", "factor on sigma of the heading"),
    "turned_by_gap": ((1,), "", "1 if the rotation after this step is uncertain"),
    "known_before": ((2,), "", "variances of tilt and heading before such a rotation, rad^2"),
    "iron_variance": ((1,), "", "variance that is added to that of the heading, rad^2"),
    "field": ((MOST, 3), "", "field at the samples of this step"),
    "field_innovation": ((1, 1), "", "last innovation of the heading over its sigma"),
    "field_density": ((1,), "", "density of the heading's innovations at low frequency"),
    "field_averages": ((4,), "", "its averages and sums"),
    "alignment": (
        (SIZE,),
        "",
        "of the coarse alignment: when it is due, s; numbers and sums of specific force and field",
    ),
    "mean_square": ((1,), "", "of the field so far"),
    "burst": ((2,), "wide", "when the last large specific forces and the last strong fields began, s"),
    "over_gap": ((1,), "", "variance of the rotation over the gaps in this step, rad^2"),
    "step_rate": ((3,), "", "rate at the start of the step, rad/s"),
    "rate_change": ((1,), "", "mean square change of the rate over a step, (rad/s)^2"),
    "aligned_force": ((1, 3), "", "mean specific force by which the attitude is aligned"),
    "aligned_field": ((1, 3), "", "mean field, zero without one"),
    "aligned_variance": ((1,), "", "variance of its tilt, rad^2; 0: it is not aligned"),
    "clock": ((3,), "wide", "time of the last sample, of the start of the step, of the first sample, s"),
    "count": ((2,), "int", "whether the filter has started; samples in the step"),
}
"""Arrays that last from one sample to the next: shape; ``"wide"`` (double in single precision too) or ``"int"``; and what they are."""
PASSING = {
    "times": ((2,), "wide", "of the last sample or of the start of the step, and of this sample, s"),
    "rates": ((2, 3), "", "at these times, rad/s"),
    "turns": ((2, 4), "", "attitude by the gyro there"),
    "ahead": ((2, 3), "", "rotation over the delay there"),
    "edge": ((2,), "int", "0 and the number of samples in the step"),
    "total": ((1, 3), "", "sum of the specific force of the step, in the frame fixed by the gyro"),
    "number": ((1,), "", "number of its samples"),
    "mean": ((1, 3), "", "their mean at the end of the step, body axes"),
    "turn": ((1, 3), "", "rotation over the step"),
    "field_total": ((1, 3), "", "sum of the field"),
    "field_number": ((1,), "", "number of its samples"),
    "length": ((1,), "", "duration that they cover, s"),
    "middle": ((1, 4), "", "attitude by the gyro in the middle of the step"),
    "end": ((1, 4), "", "and at its end"),
    "now": ((1,), "wide", "time of its end, s"),
    "turn_variance": ((1, 3), "", "variance of the rotation over the step in addition to the gyro's noise, rad^2"),
    "heading_direction": ((1, 3), "", "heading measurement at the end of the step"),
    "heading_sigma": ((1,), "", "its sigma; 0: none"),
    "usual_field": ((1, 2), "", "usual magnitude and dip of the field"),
    "subtracted_iron": ((1, 3), "", "iron subtracted"),
    "heading_iron_variance": ((1,), "", "variance of the heading by constant iron"),
    "rate_at_rest": ((1, 3), "", "mean rate at rest"),
    "rate_at_rest_variance": ((1,), "", "its variance"),
    "bias_gained": ((1,), "", "variance that the bias has gained"),
    "bias_by_rests": ((1, 3), "", "bias by all rests so far"),
}
"""Arrays that are written anew for each sample or step."""
Arrays: Any = NamedTuple("Arrays", [(name, np.ndarray) for name in (*LASTING, *PASSING)])  # type: ignore[misc]


class Routine(NamedTuple):
    """A compiled kernel that returns nothing."""

    address: int
    arguments: tuple[Any, ...]


class Routines(NamedTuple):
    """The kernels of a recording, with the arrays of the samples."""

    follow: Any
    average: Any
    end: Any
    align: Any
    judge: Any
    scale: Any
    carry: Any
    average_field: Any
    head: Any
    judge_field: Any
    watch: Any


KERNELS = Routines(
    follow=follow_gyro,
    average=average_samples,
    end=end_steps,
    align=align_steps,
    judge=innovation_density,
    scale=scale_factors,
    carry=carry_to_stamps,
    average_field=average_samples,
    head=heading_steps,
    judge_field=innovation_density,
    watch=find_rests,
)


class Imu(NamedTuple):
    """A filter of an IMU: constants, arrays, and the kernels that process them."""

    filter: Live
    magnetometer: int
    """Whether there is one."""
    rests: int
    """Whether the bias is measured at rest."""
    interval: float
    """Usual interval of the samples, s."""
    step: float
    """Interval of the filter's steps, s."""
    noise: float
    """Noise density of the specific force, m/s²/√Hz."""
    largest_rate: float
    largest_force: float
    late: float
    """Delay of the samples, s."""
    time: np.ndarray
    gyro: np.ndarray
    accelerometer: np.ndarray
    magnetic: np.ndarray
    """The sample (1,), (1, 3)."""
    arrays: Any
    """:data:`LASTING` and :data:`PASSING`."""
    resting: np.ndarray
    """Of :class:`strapdown.kernels.rests.Memory`."""
    first: np.ndarray
    """Time of the first sample, of :class:`strapdown.kernels.headings.Memory`."""
    routines: Routines
    state: np.ndarray
    """Attitude and bias of the filter (7 or more,)."""
    numbers: np.ndarray
    places: np.ndarray
    """Numbers of its covariance, and the place in them of each element of that of attitude and bias (6, 6)."""
    refused: np.ndarray
    """Refusal of the filter (1,)."""
    attitude: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    """Estimate at the start of the step (1, 4), (1, 3), (1, 6), (1, 6, 6)."""


def take(kind, table, task):
    """Process a sample; return ``RESTED`` plus ``ALIGNED``, either or 0, or a refusal, which leaves everything as it was."""
    imu = unpacked(kind, table)
    if task != START:
        code = refusal(imu)
        if code < 0 or task == CHECK:
            return code
    imu.refused[0] = 0
    if task == START:
        start(imu)
    else:
        take_sample(imu)
    if imu.refused[0] < 0:
        return imu.refused[0]
    return (RESTED if imu.resting[1] == 2 else 0) + (ALIGNED if imu.arrays.aligned_variance[0] > 0.0 else 0)


def refusal(imu):
    """Return the reason to refuse a sample, or 0."""
    a, started = imu.arrays, imu.arrays.count[0] > 0
    if not abs(imu.time[0]) < math.inf:
        return NO_TIME
    if started and not a.clock[0] < imu.time[0] <= a.clock[0] + MAX_INTERVAL:
        return BEHIND if imu.time[0] <= a.clock[0] else AHEAD
    force = vector_at(imu.accelerometer, 0)
    large = dot(force, force) > imu.largest_force * imu.largest_force
    for i in range(3):
        if math.isnan(imu.gyro[0, i]):
            return NO_GYRO
        if large or abs(imu.gyro[0, i]) > imu.largest_rate or abs(imu.magnetic[0, i]) == math.inf:
            return INFINITE
    if started and a.count[1] + 1 >= len(a.force):
        return TOO_FAST
    return 0


def start(imu):
    """Start at the sample: the state of the filter is that at it, and the attitude by the gyro the identity."""
    a = imu.arrays
    for i in range(3):
        a.clock[i] = imu.time[0]
        a.rate[i] = imu.gyro[0, i]
    for i in range(4):
        a.turned[i] = 1.0 if i == 0 else 0.0
    if imu.magnetometer > 0:
        imu.first[0] = imu.time[0]
        a.mean_square[0] = 0.0
    a.count[0] = 1
    a.burst[0] = a.burst[1] = imu.time[0] - AGAIN
    leave_out_damaged(imu)
    begin_step(imu)
    carry_to_sample(imu)
    look_for_rest(imu, False)


def take_sample(imu):
    """Take a sample after the first one."""
    a = imu.arrays
    leave_out_damaged(imu)
    length = imu.time[0] - a.clock[0]
    if length > SHORT_GAP * imu.interval:
        a.over_gap[0] = min(a.over_gap[0] + turn_variance(imu, length), UNKNOWN_TURN)
    ended = turn_with_gyro(imu)
    if ended:
        change = mean_square_change(imu)
        end_step(imu)
        if a.over_gap[0] > 0.0:
            if a.over_gap[0] > LARGE_TURN * LARGE_TURN:
                forget_attitude(imu)
            a.turned_by_gap[0] = 1.0
            carry_to_sample(imu)  # remembers what is known before
            a.turned_by_gap[0] = 0.0
            add_turn_variance(imu)
            show_filter(imu)
            a.over_gap[0] = 0.0
        else:
            a.rate_change[0] += min(imu.step / RATE_MEMORY, 1.0) * (change - a.rate_change[0])
    carry_to_sample(imu)
    look_for_rest(imu, ended)


def leave_out_damaged(imu):
    """Set a damaged specific force or field to zero: it is missing."""
    a, time = imu.arrays, imu.time[0]
    damaged = is_damaged(a.burst, 0, time, is_beyond_range(vector_at(imu.accelerometer, 0)))
    for i in range(3):
        imu.accelerometer[0, i] = 0.0 if damaged else imu.accelerometer[0, i]
    if imu.magnetometer > 0:
        share = imu.interval / USUAL_TIME
        damaged = is_damaged(a.burst, 1, time, is_strong(a.mean_square, vector_at(imu.magnetic, 0), share))
        for i in range(3):
            imu.magnetic[0, i] = 0.0 if damaged else imu.magnetic[0, i]


def turn_variance(imu, length):
    """Return the variance about each axis, rad², of the rotation by the mean of the rates at the ends of a gap of a length, s."""
    if length > max(LONG_GAP, 4.0 * imu.interval):
        return UNKNOWN_TURN
    steps = length / imu.step
    return GAP_SHARE * length * length * imu.arrays.rate_change[0] * steps * math.sqrt(steps)


def mean_square_change(imu):
    """Return the mean square over the axes of the change of the rate since the start of the step, for one of the usual length."""
    a, square = imu.arrays, 0.0
    for i in range(3):
        square += (a.rate[i] - a.step_rate[i]) * (a.rate[i] - a.step_rate[i])
    share = imu.step / (a.clock[0] - a.clock[1])
    return square * share * math.sqrt(share) / 3.0


def turn_with_gyro(imu):
    """Follow the gyro to the sample, and keep it for the end of the step; return whether it ends it.

    A step ends with the last sample before a multiple of its interval.
    """
    a = imu.arrays
    a.times[0], a.times[1] = a.clock[0], imu.time[0]
    for i in range(3):
        a.rates[0, i], a.rates[1, i] = a.rate[i], imu.gyro[0, i]
    for i in range(4):
        a.turns[0, i] = a.turned[i]
    call(imu.routines.follow.address, imu.routines.follow.arguments, ())
    before = math.floor((a.clock[0] + imu.interval - a.clock[2]) / imu.step + 1e-6)
    n = a.count[1] + 1
    a.count[1] = n
    a.clock[0] = imu.time[0]
    for i in range(3):
        a.rate[i] = imu.gyro[0, i]
        a.force[n, i] = imu.accelerometer[0, i]
        if imu.magnetometer > 0:
            a.field[n, i] = imu.magnetic[0, i]
    for i in range(4):
        a.turned[i] = a.turns[1, i]
        a.frame[n, i] = a.turns[1, i]
    return math.floor((imu.time[0] + imu.interval - a.clock[2]) / imu.step + 1e-6) != before


def end_step(imu):
    """Filter a step: its rotation, the mean of its specific force, and a heading that ends with it."""
    a, routines = imu.arrays, imu.routines
    a.edge[0], a.edge[1] = 0, a.count[1]
    call(routines.average.address, routines.average.arguments, ())
    call(routines.end.address, routines.end.arguments, ())
    predict_filter(imu, a.turn)
    number = a.number[0]
    if number > 0.0:
        update_filter(imu, 0, a.mean, imu.noise / math.sqrt(number * imu.interval), a.force_innovation)
        call(routines.judge.address, routines.judge.arguments, ())
    for i in range(4):
        a.end[0, i] = a.turned[i]
    if imu.magnetometer > 0:
        end_field(imu)
    call(routines.align.address, routines.align.arguments, ())
    begin_step(imu)


def end_field(imu):
    """Process the field of a step; update with a heading that ends with it."""
    a, routines = imu.arrays, imu.routines
    call(routines.average_field.address, routines.average_field.arguments, ())
    middle = (a.edge[1] + 1) // 2
    for i in range(4):
        a.middle[0, i] = a.frame[middle, i]
    a.length[0] = a.field_number[0] * imu.interval
    a.now[0] = a.clock[0]
    for i in range(3):
        a.turn_variance[0, i] = a.over_gap[0]
    call(routines.head.address, routines.head.arguments, ())
    if a.heading_sigma[0] > 0.0:
        update_filter(imu, 1, a.heading_direction, a.heading_sigma[0], a.field_innovation)
        call(routines.judge_field.address, routines.judge_field.arguments, ())
    a.iron_variance[0] = a.heading_iron_variance[0]


def begin_step(imu):
    """Begin a step at the last sample, with the scales of the reported σ."""
    a = imu.arrays
    a.count[1] = 0
    a.clock[1] = a.clock[0]
    for i in range(3):
        a.step_rate[i] = a.rate[i]
    for i in range(4):
        a.frame[0, i] = a.turned[i]
    show_filter(imu)
    call(imu.routines.scale.address, imu.routines.scale.arguments, ())


def carry_to_sample(imu):
    """Propagate the estimate from the start of the step to the last sample, and over its delay."""
    a = imu.arrays
    a.times[0], a.times[1] = a.clock[1], a.clock[0]
    for row in range(2):
        for i in range(3):
            a.rates[row, i] = a.rate[i]
            a.ahead[row, i] = a.rate[i] * imu.late
    for i in range(4):
        a.turns[0, i], a.turns[1, i] = a.frame[0, i], a.turned[i]
    call(imu.routines.carry.address, imu.routines.carry.arguments, ())


def look_for_rest(imu, ended):
    """Look for rest; one that shows the bias corrects it with the end of the step."""
    if imu.rests > 0:
        call(imu.routines.watch.address, imu.routines.watch.arguments, ())
        if ended and imu.resting[1] == 1:
            imu.resting[1] = 2


# -------------------------------------------------------------------------------------- the filter, which the exported one has of its own


def predict_filter(imu, turn):
    """Propagate the filter over the rotation of a step."""
    for i in range(3):
        imu.filter.increment[i] = turn[0, i]
    code = process(imu.filter, imu.arrays.clock[0], 0, 1)
    if code < 0:
        imu.refused[0] = code


def update_filter(imu, sensor, vector, sigma, normalized):
    """Update the filter with a vector of a sensor; write the innovations over their σ (1, m), 0 if they were not used."""
    live = imu.filter
    length = live.declared[sensor, LENGTH]
    for i in range(ROW):
        live.rows[0, i] = live.declared[sensor, i]
    live.rows[0, TIME], live.rows[0, SIGMA] = imu.arrays.clock[0], sigma / length
    for i in range(3):
        live.rows[0, VALUE + i] = vector[0, i] / length
    code = process(live, imu.arrays.clock[0], 1, 0)
    if code < 0:
        imu.refused[0] = code
    for i in range(normalized.shape[1]):
        value = live.innovation[0, 2 * i] / math.sqrt(live.innovation[0, 2 * i + 1])
        normalized[0, i] = value if abs(value) < math.inf else 0.0


def forget_attitude(imu):
    """Begin a coarse alignment after a rotation of which hardly anything is known."""
    alignment = imu.arrays.alignment
    for i in range(SIZE):
        alignment[i] = 1.0 if i == UNKNOWN else 0.0
    imu.arrays.aligned_variance[0] = 0.0


def add_turn_variance(imu):
    """Add the variance of the rotation over gaps to that of the attitude."""
    for i in range(3):
        imu.numbers[imu.places[i, i]] += imu.arrays.over_gap[0]


def show_filter(imu):
    """Copy the state of the filter for the samples up to the next step."""
    for i in range(4):
        imu.attitude[0, i] = imu.state[i]
    for i in range(3):
        imu.bias[0, i] = imu.state[4 + i]
    for i in range(6):
        for j in range(6):
            imu.covariance[0, i, j] = imu.numbers[imu.places[i, j]]
        imu.variance[0, i] = imu.covariance[0, i, i]
