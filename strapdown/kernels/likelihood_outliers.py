"""Update for measurements with outliers: for :mod:`strapdown.kernels.likelihood` and :mod:`strapdown.kernels.filter`.

The noise of a measurement is normal with its variance or, with probability ε, with ``spread`` times that (Tukey 1960). The update is made
with both; the likelihood is that of the mixture, and the filter continues with mean and covariance of the mixture (generalised
pseudo-Bayes of first order; Bar-Shalom, Li & Kirubarajan 2001, section 11.6).
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import full, scale, subtract
from strapdown.kernels.filter import LINES, PRIOR, ROWS, STEP, apply_step, clear_step, take_row, write
from strapdown.kernels.lane_values import WIDTH, load
from strapdown.kernels.likelihood import FOUND, WIDE, WORK, deviance_of, updated, variance_of
from strapdown.kernels.measurement import KIND, VECTOR

OPEN = ("apply_step", "clear_step", "take_row", "write")
"""Functions of the instance of the filter."""


def mixed(share, nis, product, wide, wide_product):
    """Return minus the log likelihood of a measurement, and the probability that it is an outlier.

    NIS and determinant of the innovation covariance are given for both noises; ``share`` is the probability of an outlier.
    """
    inside = math.log1p(-share) - 0.5 * (nis + math.log(product))
    outside = math.log(share) - 0.5 * (wide + math.log(wide_product))
    highest = max(inside, outside)
    near, far = math.exp(inside - highest), math.exp(outside - highest)
    return -highest - math.log(near + far), far / (near + far)


# ------------------------------------------------------------------------------------------------------------------------------- lanes


def between(w, x, y):
    """Return x + w (y − x) of two tuples of three."""
    return tuple(a + w * (b - a) for a, b in zip(x, y, strict=True))


def between_matrix(w, S, T, x, y, u, v):
    """Return the cross-covariance of a mixture, (1 − w) of S and w of T, of attitude (means x, y) and bias (means u, v)."""
    d, g = scale(w * (1.0 - w), subtract(y, x)), subtract(v, u)
    M = between(w, S, T)
    return tuple(M[3 * i + j] + d[i] * g[j] for i in range(3) for j in range(3))


def between_symmetric(w, S, T, x, y):
    """Return the covariance of a mixture, (1 − w) of (S, mean x) and w of (T, mean y), as upper triangle."""
    d = subtract(y, x)
    v, M = scale(w * (1.0 - w), d), full(between(w, S, T))
    return tuple(M[3 * i + j] + v[i] * d[j] for i in range(3) for j in range(i, 3))


def counted(b, A, B, C, e, span, number, measured, z, body, out):
    """Update all lanes with both noises, and add to the sums; return attitude correction, b, A, B, C of the mixture."""
    room, place, sensor = body.room, measured.place[e], measured.sensor[e]
    kind = measured.series[sensor, KIND]
    factor = load(body.factors, WIDTH * sensor)
    turn, b0, A0, B0, C0 = updated(b, A, B, C, number, measured, place, sensor, z, factor, room, FOUND)
    wide = factor * load(body.outliers, WIDTH)
    other, b1, A1, B1, C1 = updated(b, A, B, C, number, measured, place, sensor, z, wide, room, WIDE)
    rows = 3 if kind == VECTOR else number
    weigh(span, rows, body, out)
    w = load(room, FOUND)
    if len(out.probability) > 0:
        out.probability[e, 0] = room[FOUND]
        out.probability[e, 1] = 0.0
        for r in range(rows):
            variance = variance_of(measured, place, sensor, kind, z, r) * body.factors[WIDTH * sensor]
            out.probability[e, 1] += variance / (room[FOUND + 2 * WIDTH * r + WIDTH] * rows)
    A = between_symmetric(w, A0, A1, turn, other)
    B = between_matrix(w, B0, B1, turn, other, b0, b1)
    C = between_symmetric(w, C0, C1, b0, b1)
    return between(w, turn, other), between(w, b0, b1), A, B, C


def weigh(span, number, body, out):
    """Write the probability of an outlier, in lanes, to the work space, and add to the sums."""
    room, free = body.room, body.free
    base = 0.0
    for i in range(WIDTH):
        nis, product = deviance_of(room, FOUND, number, i)
        wide, wide_product = deviance_of(room, WIDE, number, i)
        value, struck = mixed(body.outliers[i], nis, product, wide, wide_product)
        out.minus_log[WIDTH * span + i] += value
        if i == 0:
            base = value
        elif i <= free:
            room[WORK + i - 1] = (value - base) / body.step
        room[FOUND + i] = struck
    for j in range(free):
        out.score[span, j] += room[WORK + j]
        for m in range(j + 1):
            out.information[span, j, m] += room[WORK + j] * room[WORK + m]


# ------------------------------------------------------------------------------------------------------------------------- one filter


def take(shape, body, measured, e, innovation, like):
    """Update with both noises and replace the state by the mixture; write the outputs of :class:`strapdown.estimation.forward.Options`."""
    x, P, Q, work, (share, spread) = body.x[0], body.P[0], body.P[1], body.work, body.outliers
    n = len(x) - 1
    width, line = len(P) // n, len(work) // LINES
    rows, _, _ = write(shape, x, body, measured, e, like)
    at = measured.place[e]
    for i in range(n * width):
        Q[i] = P[i]
    wide_nis, wide_product, _ = taken(Q, work, rows, line, n, spread, False)
    for i in range(n):
        work[line * PRIOR + i] = work[line * STEP + i]
    nis, product, noise = taken(P, work, rows, line, n, 1.0, True)
    for r in range(rows):
        innovation[at, 2 * r] = work[line * (ROWS + r) + n]
        innovation[at, 2 * r + 1] = work[line * (ROWS + r) + n + 1]
    value, w = mixed(share, nis, product, wide_nis, wide_product)
    innovation[at, 6], innovation[at, 7], innovation[at, 8] = value, w, noise / rows
    for i in range(n):
        d = work[line * PRIOR + i] - work[line * STEP + i]
        work[line * PRIOR + i] = d
        work[line * STEP + i] += w * d
    for i in range(n):
        for j in range(n):
            d = w * (1.0 - w) * work[line * PRIOR + i] * work[line * PRIOR + j]
            P[width * i + j] = P[width * i + j] + w * (Q[width * i + j] - P[width * i + j]) + d
    apply_step(x, P, work, like)
    return False


def taken(P, work, rows, line, n, factor, replaces):
    """Update P and the step with the rows in the work space, their variances times a factor; return NIS, determinant and noise ratios.

    If ``replaces``, the residuals and variances in the work space become the innovations and theirs.
    """
    clear_step(work, 0.0)
    nis, product, noise = 0.0, 1.0, 0.0
    for r in range(rows):
        place = line * (ROWS + r) + n
        variance = factor * work[place + 1]
        error, s = take_row(P, work, ROWS + r, work[place], variance, 0.0)
        nis, product, noise = nis + error * error / s, product * s, noise + variance / s
        if replaces:
            work[place], work[place + 1] = error, s
    return nis, product, noise
