"""Statistics of a recording's samples (n, 3): means of blocks, damaged ones, runs of equal ones, extremes, bends, changes of the field."""

from __future__ import annotations

import math

from strapdown.kernels.algebra import combine, cross, dot, matrix_times_vector
from strapdown.kernels.measurement import quaternion_at, vector_at
from strapdown.kernels.rotation import rotation_matrix
from strapdown.kernels.state import store_row

RANGE = 160.0
"""Component of a specific force, m/s², beyond the range of most accelerometers, 16 g; none of 94 recordings of eight sets has one."""
STRONG = 6.0
"""Magnitude of a field, relative to the RMS of those before, beyond that of any magnet near by."""
USUAL_TIME = 10.0
"""Time constant of the mean square of the field, s."""
BURST, AGAIN = 0.15, 10.0
"""Duration, s, up to which such samples are damaged; and the time in which they come again if the unit measures them, as at each step of a
runner, whose accelerometer has a larger range."""


def is_beyond_range(force):
    """Return whether a specific force is beyond the range of most accelerometers."""
    return abs(force[0]) > RANGE or abs(force[1]) > RANGE or abs(force[2]) > RANGE


def is_strong(mean_square, field, share):
    """Return whether a field is much stronger than those before, whose mean square (1,), 0 at first, it updates.

    Missing samples (not finite or zero) do not count.
    """
    square, strong = dot(field, field), False
    if 0.0 < square < math.inf:
        usual = mean_square[0] if mean_square[0] > 0.0 else square
        mean_square[0] = usual + share * (square - usual)
        strong = square > STRONG * STRONG * usual
    return strong


def is_damaged(burst, sensor, time, large):
    """Return whether a sample is damaged: it is if it is large, unless others were in the ten seconds before.

    ``burst`` (k,): when the last ones began, by sensor.
    """
    since = time - burst[sensor]
    damaged = large and (since >= AGAIN or since < BURST)
    if large and since >= BURST:
        burst[sensor] = time if since >= AGAIN else time - BURST
    return damaged


def find_damaged(time, force, field, share, most, mean_square, burst, damaged):
    """Write which samples of specific force and field, (n, 3) or (0, 3), are damaged (2, n), of the first also those above ``most``.

    ``mean_square`` (1,) and ``burst`` (2,): what lasts from one sample to the next.
    """
    for i in range(len(time)):
        if len(force) > 0:
            v = vector_at(force, i)
            damaged[0, i] = is_damaged(burst, 0, time[i], is_beyond_range(v)) or dot(v, v) > most * most
        if len(field) > 0:
            damaged[1, i] = is_damaged(burst, 1, time[i], is_strong(mean_square, vector_at(field, i), share))


def block_statistics(samples, length, mean, square):
    """Write the mean (k, 3) of each block of that many samples, and the sum of the squared deviations from it (k,)."""
    for k in range(len(mean)):
        total = (0.0, 0.0, 0.0)
        for i in range(length * k, length * (k + 1)):
            total = combine(1.0, total, 1.0, vector_at(samples, i))
        middle = (total[0] / length, total[1] / length, total[2] / length)
        store_row(mean, k, middle)
        square[k] = 0.0
        for i in range(length * k, length * (k + 1)):
            off = combine(1.0, vector_at(samples, i), -1.0, middle)
            square[k] += dot(off, off)


def longest_runs(samples, run):
    """Write the first and the last row of the longest run of equal samples about each axis (3, 2); of several the first one."""
    for c in range(3):
        first = 0
        run[c, 0], run[c, 1] = 0, 0
        for i in range(1, len(samples)):
            if samples[i, c] != samples[i - 1, c]:
                first = i
            elif i - first > run[c, 1] - run[c, 0]:
                run[c, 0], run[c, 1] = first, i


def extremes(samples, ends):
    """Write the largest and the smallest sample of each axis, and the number of samples equal to it (3, 2, 2); NaN is missing."""
    for c in range(3):
        high, low, at_high, at_low = -math.inf, math.inf, 0.0, 0.0
        for i in range(len(samples)):
            x = samples[i, c]
            at_high = 0.0 if x > high else at_high
            at_low = 0.0 if x < low else at_low
            high = x if x > high else high
            low = x if x < low else low
            at_high += 1.0 if x == high else 0.0
            at_low += 1.0 if x == low else 0.0
        ends[c, 0, 0], ends[c, 0, 1], ends[c, 1, 0], ends[c, 1, 1] = high, at_high, low, at_low


def bends(samples, bend):
    """Write the largest second difference about any axis at each sample between two (n − 2,)."""
    for i in range(len(bend)):
        largest = 0.0
        for c in range(3):
            largest = max(largest, abs((samples[i + 2, c] - samples[i + 1, c]) - (samples[i + 1, c] - samples[i, c])))
        bend[i] = largest


def shifted_changes(field, turned, rows, stride, lag, square):
    """Write the squared change (m, 2 k + 1) of the field from each row, in the frame fixed by the gyro, if it is −k to k strides late.

    Each is over ``lag`` strides.
    """
    longest = square.shape[1] // 2
    for j in range(len(rows)):
        first, last = rows[j], rows[j] + stride * lag
        before, after = rotation_matrix(quaternion_at(turned, first)), rotation_matrix(quaternion_at(turned, last))
        for k in range(square.shape[1]):
            late = stride * (k - longest)
            at_first = matrix_times_vector(before, vector_at(field, first + late))
            at_last = matrix_times_vector(after, vector_at(field, last + late))
            change = combine(1.0, at_last, -1.0, at_first)
            square[j, k] = dot(change, change)


def field_changes(rate, field, turned, stride, lag, still, late, products):
    """Write c·w, w·w and c·c (k, 3) of the changes c of the field, and w of that by a unit delay; NaN where a sample is missing (NaN or 0).

    Each is over ``lag`` times ``stride`` samples, in the frame fixed by the gyro; ``still`` and ``late`` (k + lag, 3) are scratch.
    """
    for k in range(len(still)):
        i = stride * k
        m, R = vector_at(field, i), rotation_matrix(quaternion_at(turned, i))
        if m[0] == 0.0 and m[1] == 0.0 and m[2] == 0.0:
            m = (math.nan, math.nan, math.nan)
        store_row(still, k, matrix_times_vector(R, m))
        store_row(late, k, matrix_times_vector(R, cross(vector_at(rate, i), m)))
        if k >= lag:
            c = combine(1.0, vector_at(still, k), -1.0, vector_at(still, k - lag))
            w = combine(1.0, vector_at(late, k), -1.0, vector_at(late, k - lag))
            store_row(products, k - lag, (dot(c, w), dot(w, w), dot(c, c)))
