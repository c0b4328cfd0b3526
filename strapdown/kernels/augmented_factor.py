"""Triangular factors of a covariance, on arrays: the square-root filter's two operations.

A covariance is ``P = S Sᵀ`` with S *upper* triangular, held as its columns: row j of the array ``F`` is column j of S, so ``P = Fᵀ F`` and
F is lower triangular. A state without process noise that comes last then costs the prediction nothing but its share of the attitude: a
lower row of S has no noise to take in and stays as it is.
"""

from __future__ import annotations

import math


def triangularise(F, last, dense, first_noise, end_noise, first_extra, end_extra, work):
    """Bring the rows above and the noise rows into the triangle, by Householder reflections: ``Fᵀ F`` stays.

    Row i of the triangle takes in, for i from ``last`` − 1 down to 0, column i of the rows above it that may reach there (those below
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
    """Take in one scalar measurement ``H[row] · x + v``, Var v = ``variance``: Carlson (1973), triangle to triangle.

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
        total = 0.0
        for j in range(i, size):
            total += F[j, i] * F[j, i]
        out[row, i] = total


def covariances(F, size, out, row):
    """Write ``Fᵀ F`` to out[row] (size, size)."""
    for a in range(size):
        for b in range(a, size):
            total = 0.0
            for j in range(b, size):
                total += F[j, a] * F[j, b]
            out[row, a, b] = total
            out[row, b, a] = total
