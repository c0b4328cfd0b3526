"""Triangular factors of a covariance: the two operations of a square-root filter.

A covariance is ``P = S Sᵀ`` with S *upper* triangular, stored by columns: row j of the array ``F`` is column j of S, so ``P = Fᵀ F`` and F
is lower triangular. With states without process noise last, the prediction does not change their rows of S, so they cost only their effect
on the attitude.

The first rows may be *loose*, with as many full columns: a correction rotates columns, and the next prediction triangularises them together
with its noise. Rows are processed eight columns at a time and therefore :func:`padded` with zeros.
"""

from __future__ import annotations

import math

import numpy as np

from strapdown.kernels.lane_values import WIDTH, load, spread, store

CALLED = ("triangularise", "take_rows", "variances", "covariances", "whole_bias")
"""Called, not inlined, by other kernels: a call costs little compared with their work, and each copy would be compiled again."""

TAKEN = 7
"""Number of scratch rows of :func:`take_rows`."""
_UNIT = np.repeat([0.0, 1.0, 0.0], [WIDTH, 1, WIDTH])


def padded(n):
    """Return the length of rows with n columns."""
    return n + (WIDTH - 1) - (n + WIDTH - 1) % WIDTH


def triangularise(F, last, loose, first_noise, end_noise, first_extra, end_extra, work):
    """Triangularise F with its loose rows and noise rows by Householder reflections, which leave ``Fᵀ F`` unchanged.

    For i from ``last`` − 1 down to 0, column i of the loose rows above row i and of the rows from ``first_noise`` to ``end_noise``, which
    are zero from column ``last``, is eliminated into row i. The columns from ``first_extra``, a multiple of ``WIDTH``, to ``end_extra`` are
    transformed too: with an identity there in the noise rows, they end as rows of the orthogonal matrix. ``work`` is scratch of a row of F.
    """
    width = F.shape[1]
    for i in range(last - 1, -1, -1):
        above = min(i, loose)
        first = first_noise
        while first < end_noise and F[first, i] == 0.0:
            first += 1
        begin = 0
        while begin < above and F[begin, i] == 0.0:
            begin += 1
        own = i - i % WIDTH
        seen = column_products(F, i, own, begin, above, first, end_noise)
        store(work, own, seen)
        squared = work[i]
        if squared == 0.0:
            continue
        a = F[i, i]
        norm = math.sqrt(a * a + squared)
        v = a + math.copysign(norm, a)
        scale = 1.0 / (norm * (norm + abs(a)))
        for c in range(0, own, WIDTH):
            w = scale * (column_products(F, i, c, begin, above, first, end_noise) + v * load(F, width * i + c))
            reflect(F, i, c, begin, above, first, end_noise, v, w)
        for c in range(first_extra, end_extra, WIDTH):
            w = scale * (column_products(F, i, c, begin, above, first, end_noise) + v * load(F, width * i + c))
            reflect(F, i, c, begin, above, first, end_noise, v, w)
        # Last the eight with column i, which the others needed: with a factor of 1 it becomes exactly zero.
        w = scale * (seen + v * load(F, width * i + own))
        there = load(_UNIT, WIDTH - i % WIDTH)
        reflect(F, i, own, begin, above, first, end_noise, v, (w - there * w) + there)


def column_products(F, i, c, begin, above, first, end):
    """Return the products of column i with the eight columns from c on, over rows ``begin`` to ``above`` and ``first`` to ``end``."""
    width = F.shape[1]
    loose = spread(0.0)
    noise = spread(0.0)
    for r in range(begin, above):
        loose = loose + F[r, i] * load(F, width * r + c)
    for r in range(first, end):
        noise = noise + F[r, i] * load(F, width * r + c)
    return loose + noise


def reflect(F, i, c, begin, above, first, end, v, w):
    """Subtract w times column i, of which row i is v, from the eight columns from c on."""
    width = F.shape[1]
    for r in range(begin, above):
        store(F, width * r + c, load(F, width * r + c) - F[r, i] * w)
    for r in range(first, end):
        store(F, width * r + c, load(F, width * r + c) - F[r, i] * w)
    store(F, width * i + c, load(F, width * i + c) - v * w)


def first_row(c, loose):
    """Return the first row that may be nonzero in the eight columns from c; rows of attitude and bias end before them."""
    return min(c, 6) if c < loose else c


def seen_columns(H, size):
    """Return the range of nonzero columns of three rows, beyond those of the attitude."""
    first, end = 3, size
    while end > first and H[0, end - 1] == 0.0 and H[1, end - 1] == 0.0 and H[2, end - 1] == 0.0:
        end -= 1
    while first < end and H[0, first] == 0.0 and H[1, first] == 0.0 and H[2, first] == 0.0:
        first += 1
    return first, end


def seen_by(F, j, H, first, end):
    """Return the products of row j of F with three rows, over the columns of the attitude and from ``first`` to ``end``."""
    a, b, c = F[j, 0], F[j, 1], F[j, 2]
    f0 = a * H[0, 0] + b * H[0, 1] + c * H[0, 2]
    f1 = a * H[1, 0] + b * H[1, 1] + c * H[1, 2]
    f2 = a * H[2, 0] + b * H[2, 1] + c * H[2, 2]
    for i in range(first, end):
        f0 += F[j, i] * H[0, i]
        f1 += F[j, i] * H[1, i]
        f2 += F[j, i] * H[2, i]
    return f0, f1, f2


def take_rows(F, size, loose, H, rows, y, variance, step, scratch):
    """Update with up to three independent measurements ``y[r] = H[r] · x + v``, Var v = ``variance[r]``: Carlson (1973), one after another.

    Returns the innovations, each after the corrections by those before it, and their variances; writes the correction to ``step``. No
    difference of squares is formed, so the factor is valid for any precision of the measurement (Bierman 1977, section V.3). Loose rows
    stay loose. Rows of H (3, n or more) beyond ``rows`` are zero. ``scratch`` has ``TAKEN`` rows of the length of F's.

    A measurement replaces row j of F by ``√k_j (F_j − t_j Σ w_i F_i)``, i < j. All measurements are processed in one pass over F, with the
    roots of the k_j at the end: the products of a measurement with updated rows follow from those with the original rows.
    """
    width = F.shape[1]
    first, end = seen_columns(H, size)
    s0, s1, s2 = variance
    i0, i1, i2 = 1.0 / s0, 1.0 / s1, 1.0 / s2
    p01 = p02 = p12 = 0.0
    for j in range(size):
        f0, f1, f2 = seen_by(F, j, H, first, min(max(j + 1, loose), end))
        t0 = f0 * i0
        kept = s0
        s0 += f0 * f0
        i0 = 1.0 / s0
        kept *= i0
        scratch[0, j], scratch[1, j] = t0, f0
        if rows > 1:
            f = f1 - t0 * p01
            p01 += f0 * f1
            t1 = f * i1
            w1 = kept * f
            kept *= s1
            s1 += w1 * f
            i1 = 1.0 / s1
            kept *= i1
            scratch[2, j], scratch[3, j] = t1, w1
            if rows > 2:
                f = f2 - t0 * p02
                p02 += f0 * f2
                f2 = f - t1 * p12
                p12 += w1 * f
                w2 = kept * f2
                scratch[4, j], scratch[5, j] = f2 * i2, w2
                kept *= s2
                s2 += w2 * f2
                i2 = 1.0 / s2
                kept *= i2
        scratch[6, j] = kept
    for c in range(6 * width, 7 * width, WIDTH):
        store(scratch, c, math.sqrt(load(scratch, c)))
    e0 = y[0]
    g0 = e0 * i0
    e1 = y[1] - p01 * g0
    g1 = e1 * i1 if rows > 1 else 0.0
    e2 = y[2] - p02 * g0 - p12 * g1
    g2 = e2 * i2 if rows > 2 else 0.0
    for c in range(0, width, WIDTH):
        a0 = a1 = a2 = spread(0.0)
        for j in range(first_row(c, loose), size):
            old = load(F, width * j + c)
            new = old - scratch[0, j] * a0
            a0 = a0 + scratch[1, j] * old
            if rows > 1:
                old, new = new, new - scratch[2, j] * a1
                a1 = a1 + scratch[3, j] * old
            if rows > 2:
                old, new = new, new - scratch[4, j] * a2
                a2 = a2 + scratch[5, j] * old
            store(F, width * j + c, scratch[6, j] * new)
        store(step, c, g0 * a0 + g1 * a1 + g2 * a2)
    return (e0, e1, e2), (s0, s1, s2)


def variances(F, size, out, row, work):
    """Write the diagonal of ``Fᵀ F`` to a row of ``out``. ``work`` is scratch of a row of F."""
    width = F.shape[1]
    for c in range(0, width, WIDTH):
        products = spread(0.0)
        for j in range(size):
            f = load(F, width * j + c)
            products = products + f * f
        store(work, c, products)
    for i in range(size):
        out[row, i] = work[i]


def covariances(F, size, out, row, work):
    """Write the leading block of ``Fᵀ F``, of the size of out[row], to it. ``work`` is scratch of a row of F."""
    width = F.shape[1]
    first = out.shape[1]
    for a in range(first):
        for c in range(0, first, WIDTH):
            products = spread(0.0)
            for j in range(size):
                products = products + F[j, a] * load(F, width * j + c)
            store(work, c, products)
        for b in range(a, first):
            out[row, a, b] = work[b]
            out[row, b, a] = work[b]


def whole_bias(F, size, gyro, gyro_use, mark, variance_out, covariance_out, row, work):
    """Write the variances (6,) and, if requested, the covariance (6, 6) of attitude and *whole* gyro bias to a row.

    The whole bias is ``b + Σ c e`` over the states that are an offset of the gyro (bit ``mark``); errors by scale or specific force are not
    part of it. ``work`` (6, 6) is scratch.
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
