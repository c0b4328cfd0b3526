"""The update where some of the measurements are outliers: of :mod:`strapdown.kernels.likelihood`, and of :mod:`.root_form`.

The noise of a measurement is normal with its variance, or with probability ε of one ``spread`` times that (Tukey 1960). The update is made
both ways; the likelihood is that of the mixture, and the state goes on with the mean and the covariance of the mixture of both (generalised
pseudo-Bayes of first order; Bar-Shalom, Li & Kirubarajan 2001, section 11.6).
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import full, scale, subtract
from strapdown.kernels.lane_values import WIDTH, load, store
from strapdown.kernels.likelihood import FOUND, WIDE, WORK, deviance_of, updated, variance_of
from strapdown.kernels.measurement import KIND, VECTOR
from strapdown.kernels.root_form import PRIOR, ROWS, STEP, loose
from strapdown.kernels.root_form import WORK as LINE
from strapdown.kernels.triangle import take_rows, triangularise


def mixed(share, nis, product, wide, wide_product):
    """Return minus the log likelihood of a measurement, and the probability that it is an outlier.

    NIS and determinant of the innovations' covariance are of both kinds of noise; ``share`` is how frequent outliers are.
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
    """Update all lanes both ways, and add to the sums; return attitude correction, b, A, B, C of the mixture."""
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
    """Leave the probability of an outlier in lanes in the work space, and add to the sums."""
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


# -------------------------------------------------------------------------------------------------------------------------- the factor


def take(form, place, rows, y, variance, out):
    """Update the factor both ways, and go on with the mixture; write what :class:`strapdown.estimation.forward.Options` says of it."""
    scratch, (share, spread), F = form.scratch, form.outliers, form.F[0]
    H, step, other, work = scratch.rows[0], scratch.lines[STEP], scratch.lines[PRIOR], scratch.lines[ROWS:]
    size, width, first = len(form.x[0]) + 3, F.shape[1], loose(form.model)
    G = F[size:]
    for c in range(0, size * width, WIDTH):
        store(G, c, load(F, c))
    e, s = take_rows(F, size, first, H, rows, y, variance, step, work)
    far, wide = take_rows(G, size, first, H, rows, y, scale(spread, variance), other, work)
    nis = wide_nis = own = 0.0
    product = wide_product = 1.0
    for r in range(rows):
        nis, product = nis + e[r] * e[r] / s[r], product * s[r]
        wide_nis, wide_product = wide_nis + far[r] * far[r] / wide[r], wide_product * wide[r]
        own += variance[r] / (s[r] * rows)
    value, w = mixed(share, nis, product, wide_nis, wide_product)
    out.innovation[place, 6], out.innovation[place, 7], out.innovation[place, 8] = value, w, own
    # (1 − w) P₀ + w P₁ + w (1 − w) d dᵀ: the factors and d, row under row.
    for c in range(0, width, WIDTH):
        d = load(other, c) - load(step, c)
        store(step, c, load(step, c) + w * d)
        store(G, size * width + c, math.sqrt(w * (1.0 - w)) * d)
    for c in range(0, size * width, WIDTH):
        store(F, c, math.sqrt(1.0 - w) * load(F, c))
        store(G, c, math.sqrt(w) * load(G, c))
    triangularise(F, size, first, size, 2 * size + 1, 0, 0, scratch.lines[LINE])
    return e, s
