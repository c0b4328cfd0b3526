"""Triangular factors of a covariance, on arrays: the square-root filter's two operations.

A covariance is ``P = S Sᵀ`` with S *upper* triangular, held as its columns: row j of the array ``F`` is column j of S, so ``P = Fᵀ F`` and
F is lower triangular. A state without process noise that comes last then costs the prediction nothing but its share of the attitude: a
lower row of S has no noise to absorb and stays as it is.

The first rows may be *loose*, full up to as many columns: a correction turns columns, and the next prediction brings them back to a
triangle together with its noise. Rows are worked on eight columns at a time, so they are :func:`padded`, with zeros.
"""

from __future__ import annotations

import math

import numpy as np

from strapdown.kernels.lane_values import WIDTH, anywhere, load, spread, store, total

CALLED = ("triangularise", "take_row", "dot_rows", "variances", "covariances", "whole_bias")
"""Not inlined where other kernels use them: their work is far more than a call, and each copy would be compiled anew."""

_UNIT = np.repeat([0.0, 1.0, 0.0], [WIDTH, 1, WIDTH])


def padded(n):
    """Return the length of rows with room for n columns."""
    return n + (WIDTH - 1) - (n + WIDTH - 1) % WIDTH


def triangularise(F, last, loose, first_noise, end_noise, first_extra, end_extra, work):
    """Bring the loose rows and the noise rows into the triangle, by Householder reflections: ``Fᵀ F`` stays.

    Row i of the triangle absorbs, for i from ``last`` − 1 down to 0, column i of the loose rows above it and of the rows from
    ``first_noise`` to ``end_noise``, which have nothing beyond column ``last``. The columns from ``first_extra``, a multiple of
    ``WIDTH``, to ``end_extra`` go along: with the identity there beside the noise rows they end as the orthogonal matrix's own rows.
    ``work`` is scratch as long as F is wide.
    """
    width = F.shape[1]
    for i in range(last - 1, -1, -1):
        above = min(i, loose)
        first = first_noise
        while first < end_noise and F[first, i] == 0.0:
            first += 1
        own = i - i % WIDTH
        seen = column_products(F, i, own, above, first, end_noise)
        store(work, own, seen)
        squared = work[i]
        if squared == 0.0:
            continue
        a = F[i, i]
        norm = math.sqrt(a * a + squared)
        v = a + math.copysign(norm, a)
        scale = 1.0 / (norm * (norm + abs(a)))
        for c in range(0, own, WIDTH):
            w = scale * (column_products(F, i, c, above, first, end_noise) + v * load(F, width * i + c))
            reflect(F, i, c, above, first, end_noise, v, w)
        for c in range(first_extra, end_extra, WIDTH):
            w = scale * (column_products(F, i, c, above, first, end_noise) + v * load(F, width * i + c))
            reflect(F, i, c, above, first, end_noise, v, w)
        # At last the eight with column i itself, which the others needed: its own share is 1, and then it ends as zeros to the bit.
        w = scale * (seen + v * load(F, width * i + own))
        there = load(_UNIT, WIDTH - i % WIDTH)
        reflect(F, i, own, above, first, end_noise, v, (w - there * w) + there)


def column_products(F, i, c, above, first, end):
    """Return the products of column i with the eight columns from c on, over the rows to ``above`` and from ``first`` to ``end``."""
    width = F.shape[1]
    loose = spread(0.0)
    noise = spread(0.0)
    for r in range(above):
        loose = loose + F[r, i] * load(F, width * r + c)
    for r in range(first, end):
        noise = noise + F[r, i] * load(F, width * r + c)
    return loose + noise


def reflect(F, i, c, above, first, end, v, w):
    """Subtract w times column i, of which row i is v, from the eight columns from c on."""
    width = F.shape[1]
    for r in range(above):
        store(F, width * r + c, load(F, width * r + c) - F[r, i] * w)
    for r in range(first, end):
        store(F, width * r + c, load(F, width * r + c) - F[r, i] * w)
    store(F, width * i + c, load(F, width * i + c) - v * w)


def dot_rows(A, i, B, j):
    """Return the scalar product of a row each of two padded arrays."""
    width = A.shape[1]
    products = spread(0.0)
    for c in range(0, width, WIDTH):
        products = products + load(A, width * i + c) * load(B, width * j + c)
    return total(products)


def take_row(F, size, loose, H, row, variance, gain, scratch):
    """Update with one scalar measurement ``H[row] · x + v``, Var v = ``variance``: Carlson (1973), triangle to triangle.

    Returns the innovation's variance s; ``gain`` is left at P h, so the correction is gain · innovation / s. No difference of squares is
    formed, so the factor stays one however sharp the measurement (Bierman 1977, section V.3). Loose rows stay loose. ``scratch`` has
    three rows as long as F's.
    """
    width = F.shape[1]
    seen, share, shrink = scratch[0], scratch[1], scratch[2]
    used = width
    while used > WIDTH and not anywhere(load(H, width * row + used - WIDTH) != 0.0):
        used -= WIDTH
    s = variance
    for j in range(size):
        products = load(F, width * j) * load(H, width * row)
        for c in range(WIDTH, used, WIDTH):
            products = products + load(F, width * j + c) * load(H, width * row + c)
        f = total(products)
        seen[j] = f
        shrink[j] = s  # before this column of S, and after it
        s += f * f
        share[j] = s
    for j in range(size, width):
        seen[j] = 0.0
        shrink[j] = s
        share[j] = s
    for c in range(0, width, WIDTH):
        after = load(share, c)
        factor = math.sqrt(load(shrink, c) / after)
        store(share, c, load(seen, c) / (after * factor))
        store(shrink, c, factor)
    for c in range(0, width, WIDTH):
        so_far = spread(0.0)
        for j in range(0 if c < loose else c, size):
            old = load(F, width * j + c)
            store(F, width * j + c, shrink[j] * old - share[j] * so_far)
            so_far = so_far + seen[j] * old
        store(gain, c, so_far)
    return s


def variances(F, size, out, row, work):
    """Write the diagonal of ``Fᵀ F`` to a row of ``out``. ``work`` is scratch as long as F is wide."""
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
    """Write the first rows and columns of ``Fᵀ F``, as many as ``out`` has room for, to out[row]. ``work`` is scratch likewise."""
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
