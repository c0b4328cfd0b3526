"""Triangular factors of a covariance, on arrays: the square-root filter's two operations.

A covariance is ``P = S Sᵀ`` with S *upper* triangular, held as its columns: row j of the array ``F`` is column j of S, so ``P = Fᵀ F`` and
F is lower triangular. A state without process noise that comes last then costs the prediction nothing but its share of the attitude: a
lower row of S has no noise to absorb and stays as it is.
"""

from __future__ import annotations

import math

CALLED = ("triangularise", "take_row", "variances", "covariances", "whole_bias")
"""Not inlined where other kernels use them: their work is far more than a call, and each copy would be compiled anew."""


def triangularise(F, last, dense, first_noise, end_noise, first_extra, end_extra, work):
    """Bring the rows above and the noise rows into the triangle, by Householder reflections: ``Fᵀ F`` stays.

    Row i of the triangle absorbs, for i from ``last`` − 1 down to 0, column i of the rows above it that may reach there (those below
    ``dense``) and of the rows from ``first_noise`` to ``end_noise``. The columns from ``first_extra`` to ``end_extra`` go along: with the
    identity there beside the noise rows they end as the orthogonal matrix's own rows. ``work`` is scratch as long as F is wide.
    """
    for i in range(last - 1, -1, -1):
        above = min(i, dense)
        squared = 0.0
        for r in range(above):
            squared += F[r, i] * F[r, i]
        for r in range(first_noise, end_noise):
            squared += F[r, i] * F[r, i]
        if squared == 0.0:
            continue
        a = F[i, i]
        norm = math.sqrt(a * a + squared)
        v = a + math.copysign(norm, a)
        scale = 1.0 / (norm * (norm + abs(a)))
        for c in range(i):
            work[c] = v * F[i, c]
        for c in range(first_extra, end_extra):
            work[c] = v * F[i, c]
        for r in range(above):
            if F[r, i] != 0.0:
                for c in range(i):
                    work[c] += F[r, i] * F[r, c]
                for c in range(first_extra, end_extra):
                    work[c] += F[r, i] * F[r, c]
        for r in range(first_noise, end_noise):
            if F[r, i] != 0.0:
                for c in range(i):
                    work[c] += F[r, i] * F[r, c]
                for c in range(first_extra, end_extra):
                    work[c] += F[r, i] * F[r, c]
        for c in range(i):
            work[c] *= scale
            F[i, c] -= v * work[c]
        for c in range(first_extra, end_extra):
            work[c] *= scale
            F[i, c] -= v * work[c]
        F[i, i] = -math.copysign(norm, a)
        for r in range(above):
            x = F[r, i]
            if x != 0.0:
                for c in range(i):
                    F[r, c] -= x * work[c]
                for c in range(first_extra, end_extra):
                    F[r, c] -= x * work[c]
                F[r, i] = 0.0
        for r in range(first_noise, end_noise):
            x = F[r, i]
            if x != 0.0:
                for c in range(i):
                    F[r, c] -= x * work[c]
                for c in range(first_extra, end_extra):
                    F[r, c] -= x * work[c]
                F[r, i] = 0.0


def take_row(F, size, H, row, variance, gain):
    """Update with one scalar measurement ``H[row] · x + v``, Var v = ``variance``: Carlson (1973), triangle to triangle.

    Returns the innovation's variance s; ``gain`` is left at P h, so the correction is gain · innovation / s. No difference of squares is
    formed, so the factor stays one however sharp the measurement (Bierman 1977, section V.3).
    """
    s = variance
    for i in range(size):
        gain[i] = 0.0
    for j in range(size):
        f = 0.0
        for i in range(j + 1):
            f += F[j, i] * H[row, i]
        if f != 0.0:
            before = s
            s += f * f
            shrink = math.sqrt(before / s)
            share = f / (s * shrink)
            for i in range(j + 1):
                old = F[j, i]
                F[j, i] = shrink * old - share * gain[i]
                gain[i] += f * old
    return s


def variances(F, size, out, row):
    """Write the diagonal of ``Fᵀ F`` to a row of ``out``."""
    for i in range(size):
        out[row, i] = 0.0
    for j in range(size):
        for i in range(j + 1):
            out[row, i] += F[j, i] * F[j, i]


def covariances(F, size, out, row):
    """Write the first rows and columns of ``Fᵀ F``, as many as ``out`` has room for, to out[row]."""
    first = out.shape[1]
    for a in range(first):
        for b in range(first):
            out[row, a, b] = 0.0
    for j in range(size):
        end = min(j + 1, first)
        for a in range(end):
            for b in range(a, end):
                out[row, a, b] += F[j, a] * F[j, b]
    for a in range(first):
        for b in range(a):
            out[row, a, b] = out[row, b, a]


def whole_bias(F, size, gyro, gyro_use, mark, variance_out, covariance_out, row, work):
    """Write variances (6,), and the covariance (6, 6) where there is room for it, of attitude and *whole* gyro bias to a row.

    The whole bias is ``b + Σ c e`` over the states that are an offset of the gyro, those with the bit ``mark``; what else the gyro gets
    wrong, by its scale or by the specific force, is none. ``work`` (6, 6) is scratch.
    """
    for a in range(6):
        for b in range(6):
            work[a, b] = 0.0
    for j in range(size):
        x = F[j, 3]
        y = F[j, 4]
        z = F[j, 5]
        for k in range(len(gyro_use)):
            if gyro_use[k] & mark:
                f = F[j, 6 + k]
                x += gyro[k, 0] * f
                y += gyro[k, 1] * f
                z += gyro[k, 2] * f
        t = (F[j, 0], F[j, 1], F[j, 2], x, y, z)
        for a in range(6):
            for b in range(a, 6):
                work[a, b] += t[a] * t[b]
    for a in range(6):
        variance_out[row, a] = work[a, a]
    if row < len(covariance_out):
        for a in range(6):
            for b in range(a, 6):
                covariance_out[row, a, b] = work[a, b]
                covariance_out[row, b, a] = work[a, b]
