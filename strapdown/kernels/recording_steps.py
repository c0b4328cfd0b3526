"""Averages of a recording's samples over filter steps, and propagation of the estimate from the steps to every time stamp."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    combine,
    full,
    multiply,
    scale,
    scale_matrix,
    symmetric_minus_outer,
    times_transpose_upper,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.integration import large_exponential
from strapdown.kernels.lane_values import WIDTH, broadcast, load
from strapdown.kernels.measurement import quaternion_at, vector_at
from strapdown.kernels.rotation import logarithm, moved, quaternion_multiply, renormalized, rotation_matrix
from strapdown.kernels.state import keep_state, store_row, store_several


def follow_gyro(time, rate, attitude):
    """Write the attitude (n, 4) from the gyro only at each stamp, from that at the first one, by the trapezoidal rule."""
    q = quaternion_at(attitude, 0)
    for i in range(1, len(time)):
        half = 0.5 * (time[i] - time[i - 1])
        turn = (
            half * (rate[i - 1, 0] + rate[i, 0]),
            half * (rate[i - 1, 1] + rate[i, 1]),
            half * (rate[i - 1, 2] + rate[i, 2]),
        )
        q = renormalized(quaternion_multiply(q, large_exponential(turn)))
        store_row(attitude, i, q)


def average_samples(samples, frame, edge, total, number):
    """Sum the samples (n, 3) of each step, rotated by ``frame`` (n, 4), in ``total`` (k, 3), and count them.

    Step i has the samples after ``edge[i]`` up to ``edge[i + 1]``. Samples that are not finite, or zero, are missing.
    """
    for i in range(len(edge) - 1):
        sx, sy, sz, count = 0.0, 0.0, 0.0, 0
        for j in range(edge[i] + 1, edge[i + 1] + 1):
            x, y, z = samples[j, 0], samples[j, 1], samples[j, 2]
            square = x * x + y * y + z * z
            if not 0.0 < square < math.inf:
                continue
            w, a, b, c = frame[j, 0], frame[j, 1], frame[j, 2], frame[j, 3]
            tx, ty, tz = 2.0 * (b * z - c * y), 2.0 * (c * x - a * z), 2.0 * (a * y - b * x)
            sx += x + w * tx + b * tz - c * ty
            sy += y + w * ty + c * tx - a * tz
            sz += z + w * tz + a * ty - b * tx
            count += 1
        total[i, 0], total[i, 1], total[i, 2] = sx, sy, sz
        number[i] = count


def end_steps(attitude, edge, total, number, mean, turn):
    """Write the mean of the samples of each step in the axes of the body at its end, and the rotation vector over it (k, 3)."""
    for i in range(len(edge) - 1):
        begin, end = quaternion_at(attitude, edge[i]), quaternion_at(attitude, edge[i + 1])
        count = max(number[i], 1.0)
        fixed = (total[i, 0] / count, total[i, 1] / count, total[i, 2] / count)
        store_row(mean, i, transpose_times_vector(rotation_matrix(end), fixed))
        store_row(turn, i, logarithm(quaternion_multiply((begin[0], -begin[1], -begin[2], -begin[3]), end)))


def turn_over(time, rate, late, sums, turn):
    """Write the rotation vector (n, 3) over the interval ``late`` (n,), s, before each stamp, by the trapezoidal rule.

    Before the first and after the last sample the rate is constant. ``sums`` (n, 3) is scratch.
    """
    n = len(time)
    for c in range(3):
        sums[0, c] = 0.0
    for i in range(1, n):
        half = 0.5 * (time[i] - time[i - 1])
        for c in range(3):
            sums[i, c] = sums[i - 1, c] + half * (rate[i - 1, c] + rate[i, c])
    k = 0
    for i in range(n):
        then = time[i] - late[i]
        while k < n - 1 and time[k + 1] <= then:
            k += 1
        while k > 0 and time[k] > then:
            k -= 1
        beyond = then - time[k]
        inside = beyond >= 0.0 and k < n - 1
        share = beyond / (time[k + 1] - time[k]) if inside else 0.0
        for c in range(3):
            step = share * (sums[k + 1, c] - sums[k, c]) if inside else beyond * rate[k, c]
            turn[i, c] = sums[i, c] - (sums[k, c] + step)


def turns_between(time, rate, first, last, turns):
    """Write the rotation vectors (m, 3) from the samples ``first`` (m,) to the samples ``last``, by the trapezoidal rule."""
    for k in range(len(turns)):
        x, y, z = 0.0, 0.0, 0.0
        for i in range(first[k], last[k]):
            half = 0.5 * (time[i + 1] - time[i])
            x += half * (rate[i, 0] + rate[i + 1, 0])
            y += half * (rate[i, 1] + rate[i + 1, 1])
            z += half * (rate[i, 2] + rate[i + 1, 2])
        store_row(turns, k, (x, y, z))


def add_products(sums, factors, lanes):
    """Return sums of lanes, each increased by a factor times ``lanes``."""
    return tuple(total + factor * lanes for total, factor in zip(sums, factors, strict=True))


def rotated_sums(attitudes, vectors, edges, sums):
    """Write the sums of R_ab v_c over the rows of each window (attitudes, windows, 9, c), R of ``attitudes`` (…, m, 4).

    ``vectors`` (m, ``WIDTH``) has those of two sensors side by side.
    """
    windows = len(edges) - 1
    for n in range(len(attitudes)):
        for w in range(windows):
            total = add_products((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0,) * 9, broadcast(0.0))
            for k in range(edges[w], edges[w + 1]):
                total = add_products(total, rotation_matrix(quaternion_at(attitudes[n], k)), load(vectors, WIDTH * k))
            store_several(sums, 9 * WIDTH * (windows * n + w), total)


def turn_back(attitude, turn, result):
    """Write the attitudes (n, 4) before the rotations ``turn`` (n, 3)."""
    for i in range(len(turn)):
        q, _ = moved(quaternion_at(attitude, i), (-turn[i, 0], -turn[i, 1], -turn[i, 2]))
        store_row(result, i, renormalized(q))


class Steps(NamedTuple):
    """Estimate at the filter's steps."""

    edge: np.ndarray
    """Sample index of each step (k,), the first at the start."""
    attitude: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    """(k, 6)"""
    covariance: np.ndarray
    """(k, 6, 6)"""
    tilt: np.ndarray
    """Factor (k,) on the σ of the tilt."""
    heading: np.ndarray
    """Factor (k,) on the σ of the rotation about the vertical."""
    iron: np.ndarray
    """Variance (k,) of that rotation in addition, rad²."""
    turned: np.ndarray
    """1 if a rotation after the step is uncertain, as over a gap (k,)."""


class Stamps(NamedTuple):
    """Values at every sample."""

    time: np.ndarray
    rate: np.ndarray
    turned: np.ndarray
    """Attitude from the gyro only (n, 4)."""
    late: float
    """Delay of the stamps relative to the motion, s."""
    ahead: np.ndarray
    """Rotation vector (n, 3) over that delay, from the gyro."""


class Carried(NamedTuple):
    """Estimate at the stamps."""

    attitude: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    """(n, 6)"""
    covariance: np.ndarray
    """By rows (n, 36), or (0, 36)."""


def block_at(P, first):
    """Return rows 0 to 2 of three columns of a covariance as a 9-tuple."""
    return tuple(P[i, first + j] for i in range(3) for j in range(3))


class Limits(NamedTuple):
    """Constants of the covariance at the stamps."""

    timing: float
    """Variance of the timing error, along the rate, s²."""
    tilt: float
    heading: float
    """Variances, rad², up to which the factors apply (:func:`known_before`)."""
    accelerometer: float
    """Variance of the tilt by the accelerometer's own error, rad², in addition."""
    bias: float
    """Initial variance of the gyro's bias, (rad/s)²; 0: with a field."""
    unshown: float
    """Least factor on σ of heading and bias without a field; it applies by the share of that variance that is left."""


KNOWN_TILT = 0.25
"""Variance of the tilt, rad², half a radian squared, whose excess is added to that of the heading, which is measured about the vertical."""


def limited(factor, variance, limit):
    """Return the factor on σ if one is to apply to the variance up to a limit only, and not to what exceeds it.

    Such a factor stands for motion and fields that differ from those modelled. They affect at most the variance of a filter that has
    settled; a larger one, as at a start in motion or after a gap, is of a rotation that is unknown.
    """
    return math.sqrt(1.0 + (factor * factor - 1.0) * min(limit / variance, 1.0))


def known_before(memory, row, factor, variance, limit, turned):
    """Return the variance up to which a factor applies: the limit, after an uncertain rotation that before it if the factor is below 1.

    Until the filter knows as much again, the excess is of that rotation. ``memory``: that variance by row.
    """
    if turned > 0.0:
        memory[row] = min(memory[row], variance)
    elif variance <= memory[row]:
        memory[row] = limit
    return memory[row] if factor < 1.0 else limit


def level_factors(factor, xx, xy, yy, limit, turned, memory):
    """Return the symmetric matrix (xx, xy, yy) by which the tilt is scaled: :func:`limited` along the principal axes of its covariance."""
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    apart = math.sqrt(half * half + xy * xy)
    limit = known_before(memory, 0, factor, mean + apart, limit, turned)
    most, least = limited(factor, mean + apart, limit), limited(factor, max(mean - apart, 1e-30), limit)
    middle, slope = 0.5 * (most + least), 0.5 * (most - least) / max(apart, 1e-300)
    return middle + slope * half, slope * xy, middle - slope * half


def carry_to_stamps(steps, stamps, limits, memory, out):
    """Propagate the estimate at each step with the gyro to the stamps before the next step, and over their delay.

    ``memory`` (2,): of :func:`known_before`, for tilt and heading.
    """
    for k in range(len(steps.edge)):
        first = steps.edge[k]
        last = steps.edge[k + 1] if k + 1 < len(steps.edge) else len(stamps.time)
        begin = quaternion_at(steps.attitude, k)
        t = stamps.turned
        since = quaternion_multiply(begin, (t[first, 0], -t[first, 1], -t[first, 2], -t[first, 3]))
        bias = vector_at(steps.bias, k)
        P = steps.covariance[k]
        R = rotation_matrix(begin)
        xx, xy, xz, yy, yz, zz = times_transpose_upper(multiply(R, block_at(P, 0)), R)
        sx, sm, sy = level_factors(steps.tilt[k], xx, xy, yy, limits.tilt, steps.turned[k], memory)
        if limits.bias > 0.0:  # nothing but the gyro shows the heading, whose error is mainly that of the bias
            h = b = max(steps.heading[k], limited(limits.unshown, 3.0 * limits.bias, P[3, 3] + P[4, 4] + P[5, 5]))
        else:
            limit = known_before(memory, 1, steps.heading[k], zz, limits.heading, steps.turned[k])
            h, b = limited(steps.heading[k], zz, limit), 1.0
        floor, iron = limits.accelerometer, steps.iron[k]
        x, y = (sx * xx + sm * xy, sx * xy + sm * yy), (sm * xx + sy * xy, sm * xy + sy * yy)
        level = (x[0] * sx + x[1] * sm + floor, x[0] * sm + x[1] * sy, y[0] * sm + y[1] * sy + floor)
        unknown = max(0.5 * (level[0] + level[2]) - KNOWN_TILT, 0.0)
        beside = (h * (sx * xz + sm * yz), h * (sm * xz + sy * yz))
        fixed = full((level[0], level[1], beside[0], level[2], beside[1], h * h * zz + iron + unknown))
        across = multiply(R, block_at(P, 3))
        first_row, second_row = across[:3], across[3:6]
        level_rows = combine(b * sx, first_row, b * sm, second_row) + combine(b * sm, first_row, b * sy, second_row)
        across = level_rows + scale(b * h, across[6:])
        bias_covariance = scale_matrix(b * b, (P[3, 3], P[3, 4], P[3, 5], P[4, 4], P[4, 5], P[5, 5]))
        for n in range(first, last):
            late = stamps.time[n] - stamps.time[first] + stamps.late
            v = combine(1.0, vector_at(stamps.ahead, n), -late, bias)
            q, _ = moved(quaternion_multiply(since, quaternion_at(t, n)), v)
            q = renormalized(q)
            R = rotation_matrix(q)
            own = times_transpose_upper(multiply(transpose(R), fixed), transpose(R))
            w = vector_at(stamps.rate, n)
            own = symmetric_minus_outer(own, scale(-limits.timing, w), w)
            keep_state(out, n, q, bias, own, multiply(transpose(R), across), bias_covariance)


class Scales(NamedTuple):
    """Factors on the variances of the filter, for innovations that are white: :mod:`strapdown.ahrs.regions`."""

    tilt: float
    heading: float
    max_heading: float
    """Maximum factor on the variance of the heading."""


def scale_factors(force_density, field_density, scales, tilt, heading):
    """Write the factors on σ of the tilt and of the heading (k,), from the densities (:func:`innovation_density`) of both sensors (k,)."""
    for i in range(len(tilt)):
        force, field = force_density[i], field_density[i]
        tilt[i] = math.sqrt(scales.tilt * (force * math.sqrt(math.sqrt(force))))
        heading[i] = math.sqrt(min(scales.heading * (field * math.sqrt(math.sqrt(field))), scales.max_heading))


class Averages(NamedTuple):
    """Constants of the density of innovations."""

    share: float
    """Weight of an innovation in their average."""
    forgotten: float
    """Weight of a density in the mean density."""


def innovation_density(normalized, constants, memory, density):
    """Write the spectral density (k,) of innovations at low frequency up to each, relative to that of white ones.

    It is the mean square of their moving average over that of white innovations. ``normalized`` (k, m): innovations over their σ.
    ``memory`` (m + 3,): their moving averages; the variance of one if they are white; sum of the densities, with exponential forgetting,
    and of their weights.
    """
    m = len(memory) - 3
    kept, remembered = 1.0 - constants.share, 1.0 - constants.forgotten
    for i in range(len(density)):
        square = 0.0
        for j in range(m):
            memory[j] = kept * memory[j] + constants.share * normalized[i, j]
            square += memory[j] * memory[j]
        memory[m] = kept * kept * memory[m] + constants.share * constants.share
        memory[m + 1] = remembered * memory[m + 1] + square / (m * memory[m])
        memory[m + 2] = remembered * memory[m + 2] + 1.0
        density[i] = memory[m + 1] / memory[m + 2]


def low_pass(values, share, result):
    """Filter rows (k, m) by ``y += share (x − y)``, starting with the first row."""
    for j in range(values.shape[1]):
        y = values[0, j]
        for i in range(len(values)):
            y += share * (values[i, j] - y)
            result[i, j] = y
