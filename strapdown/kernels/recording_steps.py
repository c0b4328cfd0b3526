"""Samples of a recording to averages over filter steps, and an estimate at the steps to every stamp."""

from __future__ import annotations

import math

from strapdown.kernels.rotation import quaternion_multiply


def average_samples(samples, frame, edge, total, number):
    """Add up the samples (n, 3) of each step in the axes that ``frame`` (n, 4) turns them to, in ``total`` (k, 3), and count them.

    Step i has the samples after ``edge[i]`` up to ``edge[i + 1]``. Samples that are not finite, or 0, are missing.
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


def carry_to_stamps(row, step, covariance_f, turned, ahead, rate, timing, iron, attitude, covariance):
    """Carry attitudes at steps to the stamps of samples, and their covariance (k, 3, 3), fixed axes, to body axes there (n, 3, 3).

    Attitude n is ``step[row] ⊗ turned[n] ⊗ exp(ahead[n])``. The covariance includes a timing error of variance ``timing``, s², along the
    rate, and ``iron``, rad², about the vertical.
    """
    for n in range(len(row)):
        k = row[n]
        vx, vy, vz = ahead[n, 0], ahead[n, 1], ahead[n, 2]
        angle = math.sqrt(vx * vx + vy * vy + vz * vz)
        s = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
        q = quaternion_multiply(
            (step[k, 0], step[k, 1], step[k, 2], step[k, 3]),
            (turned[n, 0], turned[n, 1], turned[n, 2], turned[n, 3]),
        )
        w, x, y, z = quaternion_multiply(q, (math.cos(0.5 * angle), s * vx, s * vy, s * vz))
        scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = scale * w, scale * x, scale * y, scale * z
        attitude[n, 0], attitude[n, 1], attitude[n, 2], attitude[n, 3] = w, x, y, z
        R = (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
            (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
            (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
        )
        for j in range(3):
            a, b, c = R[0][j], R[1][j], R[2][j]
            px = covariance_f[k, 0, 0] * a + covariance_f[k, 0, 1] * b + covariance_f[k, 0, 2] * c
            py = covariance_f[k, 1, 0] * a + covariance_f[k, 1, 1] * b + covariance_f[k, 1, 2] * c
            pz = covariance_f[k, 2, 0] * a + covariance_f[k, 2, 1] * b + covariance_f[k, 2, 2] * c
            for i in range(j + 1):
                p = R[0][i] * px + R[1][i] * py + R[2][i] * pz
                p += timing * rate[n, i] * rate[n, j] + iron * R[2][i] * R[2][j]
                covariance[n, i, j] = p
                covariance[n, j, i] = p


def low_pass(values, share, result):
    """Pass rows (k, m) through ``y += share (x − y)``, from the first row on."""
    for j in range(values.shape[1]):
        y = values[0, j]
        for i in range(len(values)):
            y += share * (values[i, j] - y)
            result[i, j] = y
