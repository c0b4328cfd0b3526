"""The update of :mod:`strapdown.kernels.likelihood` where some of the measurements are outliers.

The noise of a measurement is normal with its variance, or with probability ε of one ``spread`` times that (Tukey 1960). The update is made
both ways; the likelihood is that of the mixture, and the state goes on with the mean and the covariance of the mixture of both (generalised
pseudo-Bayes of first order; Bar-Shalom, Li & Kirubarajan 2001, section 11.6).
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import full, scale, subtract
from strapdown.kernels.filter_step import reset
from strapdown.kernels.lane_values import WIDTH, load
from strapdown.kernels.likelihood import FOUND, WIDE, WORK, deviance_of, measured_rows, part_at, updated
from strapdown.kernels.measurement import KIND, VECTOR, frame_row, value_of


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


def update(state, e, now, measured, body, out):
    """Update all lanes with a measurement that may be an outlier, and add to the sums of its part of the record."""
    q, b, A, B, C, span, kept = state
    span = part_at(span, now, body.cuts)
    room, outliers = body.room, body.outliers
    place = measured.place[e]
    sensor = measured.sensor[e]
    z = value_of(measured, place, sensor)
    factor = load(body.factors, WIDTH * sensor)
    kind = measured.series[sensor, KIND]
    number = measured_rows(q, z, kind, frame_row(measured, place, sensor), measured.triads, room)
    turn, b0, A0, B0, C0 = updated(b, A, B, C, number, measured, place, sensor, z, factor, room, FOUND)
    wide = factor * load(outliers, WIDTH)
    other, b1, A1, B1, C1 = updated(b, A, B, C, number, measured, place, sensor, z, wide, room, WIDE)
    weigh(e, span, 3 if kind == VECTOR else number, body, out)
    w = load(room, FOUND)
    A = between_symmetric(w, A0, A1, turn, other)
    B = between_matrix(w, B0, B1, turn, other, b0, b1)
    C = between_symmetric(w, C0, C1, b0, b1)
    b = between(w, b0, b1)
    q, A, B = reset(q, A, B, between(w, turn, other))
    return q, b, A, B, C, span, kept


def weigh(e, span, number, body, out):
    """Leave the probability of an outlier in lanes in the work space, and add to the sums."""
    room, outliers, free = body.room, body.outliers, body.free
    base = 0.0
    for i in range(WIDTH):
        nis, product = deviance_of(room, FOUND, number, i)
        inside = math.log1p(-outliers[i]) - 0.5 * (nis + math.log(product))
        wide, product = deviance_of(room, WIDE, number, i)
        outside = math.log(outliers[i]) - 0.5 * (wide + math.log(product))
        highest = max(inside, outside)
        value = -highest - math.log(math.exp(inside - highest) + math.exp(outside - highest))
        struck = math.exp(outside + value)
        out.minus_log[WIDTH * span + i] += value
        if i == 0:
            base = value
            out.probability[e, 0] = struck
            out.probability[e, 1] = nis
        elif i <= free:
            room[WORK + i - 1] = (value - base) / body.step
        room[FOUND + i] = struck
    for j in range(free):
        out.score[span, j] += room[WORK + j]
        for m in range(j + 1):
            out.outer[span, j, m] += room[WORK + j] * room[WORK + m]
