"""Averages of a recording's samples over filter steps, and propagation of the estimate from the steps to every time stamp."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    combine,
    dot,
    full,
    multiply,
    scale,
    symmetric_minus_outer,
    times_transpose_upper,
    transpose,
)
from strapdown.kernels.rotation import exponential, quaternion_multiply, rotation_matrix, unit
from strapdown.kernels.series import LARGEST_ANGLE


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


def turned_by(q, v):
    """Return q ⊗ exp(v), normalised, for a rotation vector v of any length."""
    square = dot(v, v)
    if square < LARGEST_ANGLE * LARGEST_ANGLE:
        return unit(quaternion_multiply(q, exponential(v)))
    angle = math.sqrt(square)
    s = math.sin(0.5 * angle) / angle
    return unit(quaternion_multiply(q, (math.cos(0.5 * angle), s * v[0], s * v[1], s * v[2])))


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


def turn_back(attitude, turn, result):
    """Write the attitudes (n, 4) before the rotations ``turn`` (n, 3)."""
    for i in range(len(turn)):
        q = (attitude[i, 0], attitude[i, 1], attitude[i, 2], attitude[i, 3])
        result[i, 0], result[i, 1], result[i, 2], result[i, 3] = turned_by(q, (-turn[i, 0], -turn[i, 1], -turn[i, 2]))


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


class Stamps(NamedTuple):
    """Values at every sample."""

    time: np.ndarray
    rate: np.ndarray
    turned: np.ndarray
    """Attitude from the gyro only (n, 4)."""
    late: np.ndarray
    """Delay of the stamp relative to the motion (n,), s."""
    ahead: np.ndarray
    """Rotation vector (n, 3) over that delay, from the gyro."""


class Carried(NamedTuple):
    """Estimate at the stamps."""

    attitude: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    """(n, 6)"""
    covariance: np.ndarray
    """(n, 6, 6), or (0, 6, 6)."""


def carry_to_stamps(steps, stamps, timing, iron, out):
    """Propagate the estimate at each step with the gyro to the stamps before the next step, and over their delay.

    The covariance includes a timing error of variance ``timing``, s², along the rate, and ``iron``, rad², about the vertical.
    """
    for k in range(len(steps.edge)):
        first = steps.edge[k]
        last = steps.edge[k + 1] if k + 1 < len(steps.edge) else len(stamps.time)
        begin = (steps.attitude[k, 0], steps.attitude[k, 1], steps.attitude[k, 2], steps.attitude[k, 3])
        t = stamps.turned
        since = quaternion_multiply(begin, (t[first, 0], -t[first, 1], -t[first, 2], -t[first, 3]))
        bias = (steps.bias[k, 0], steps.bias[k, 1], steps.bias[k, 2])
        P = steps.covariance
        body = (P[k, 0, 0], P[k, 0, 1], P[k, 0, 2], P[k, 1, 1], P[k, 1, 2], P[k, 2, 2])
        R = rotation_matrix(begin)
        xx, xy, xz, yy, yz, zz = times_transpose_upper(multiply(R, full(body)), R)
        s = steps.tilt[k]
        fixed = full((s * s * xx, s * s * xy, s * xz, s * s * yy, s * yz, zz))
        across = (
            P[k, 0, 3],
            P[k, 0, 4],
            P[k, 0, 5],
            P[k, 1, 3],
            P[k, 1, 4],
            P[k, 1, 5],
            P[k, 2, 3],
            P[k, 2, 4],
            P[k, 2, 5],
        )
        across = multiply(R, across)
        a, b = scale(s, across[:3]), scale(s, across[3:6])
        across = (a[0], a[1], a[2], b[0], b[1], b[2], across[6], across[7], across[8])
        for n in range(first, last):
            late = stamps.time[n] - stamps.time[first] + stamps.late[n]
            v = combine(1.0, (stamps.ahead[n, 0], stamps.ahead[n, 1], stamps.ahead[n, 2]), -late, bias)
            q = turned_by(quaternion_multiply(since, (t[n, 0], t[n, 1], t[n, 2], t[n, 3])), v)
            R = rotation_matrix(q)
            own = times_transpose_upper(multiply(transpose(R), fixed), transpose(R))
            w = (stamps.rate[n, 0], stamps.rate[n, 1], stamps.rate[n, 2])
            own = symmetric_minus_outer(own, scale(-timing, w), w)
            up = (R[6], R[7], R[8])  # in body axes
            own = full(symmetric_minus_outer(own, scale(-iron, up), up))
            out.attitude[n, 0], out.attitude[n, 1], out.attitude[n, 2], out.attitude[n, 3] = q
            out.bias[n, 0], out.bias[n, 1], out.bias[n, 2] = bias
            out.variance[n, 0], out.variance[n, 1], out.variance[n, 2] = own[0], own[4], own[8]
            for i in range(3, 6):
                out.variance[n, i] = steps.variance[k, i]
            if n < len(out.covariance):
                mixed = multiply(transpose(R), across)
                for i in range(3):
                    for j in range(3):
                        out.covariance[n, i, j] = own[3 * i + j]
                        out.covariance[n, i, 3 + j] = mixed[3 * i + j]
                        out.covariance[n, 3 + j, i] = mixed[3 * i + j]
                        out.covariance[n, 3 + i, 3 + j] = P[k, 3 + i, 3 + j]


def low_pass(values, share, result):
    """Filter rows (k, m) by ``y += share (x − y)``, starting with the first row."""
    for j in range(values.shape[1]):
        y = values[0, j]
        for i in range(len(values)):
            y += share * (values[i, j] - y)
            result[i, j] = y
