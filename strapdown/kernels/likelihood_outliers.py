"""Update for measurements with outliers, for :mod:`strapdown.kernels.likelihood`.

The noise of a measurement is normal with its variance or, with probability ε, with ``spread`` times that (Tukey 1960). The update is made
with both; the likelihood is that of the mixture, and the filter continues with mean and covariance of the mixture (generalised
pseudo-Bayes of first order; Bar-Shalom, Li & Kirubarajan 2001, section 11.6).
"""

from __future__ import annotations

import math

from strapdown.kernels.lane_values import WIDTH, broadcast, load, store
from strapdown.kernels.layout import LINES, PRIOR, ROWS, STEP
from strapdown.kernels.likelihood import WIDE, WORK, deviance_of
from strapdown.kernels.rows import write_rows
from strapdown.kernels.update import apply_step, clear_step, take_row


def mixed(share, nis, product, wide, wide_product):
    """Return minus the log likelihood of a measurement, and the probability that it is an outlier.

    NIS and determinant of the innovation covariance are given for both noises; ``share`` is the probability of an outlier.
    """
    inside = math.log1p(-share) - 0.5 * (nis + math.log(product))
    outside = math.log(share) - 0.5 * (wide + math.log(wide_product))
    highest = max(inside, outside)
    near, far = math.exp(inside - highest), math.exp(outside - highest)
    return -highest - math.log(near + far), far / (near + far)


def counted(e, span, measured, body, out):
    """Update all lanes with both noises, continue with the mixture, and add to the sums."""
    f, room, like = body.filters, body.room, broadcast(0.0)
    x, P, Q, work = f.x[0], f.P[0], f.P[1], f.work
    line = len(work) // LINES
    rows, _, _ = write_rows(f.shape[measured.sensor[e]], x, f, measured, e, like)
    for i in range(0, len(P), WIDTH):
        store(Q, i, load(P, i))
    size = len(x) - WIDTH
    taken(Q, work, rows, line, size, load(body.outliers, WIDTH), room, WIDE)
    for i in range(0, size, WIDTH):
        store(work, line * PRIOR + i, load(work, line * STEP + i))
    noise = taken(P, work, rows, line, size, broadcast(1.0), room, 0)
    if len(out.probability) > 0:
        store(room, WORK, noise)
        out.probability[e, 1] = room[WORK] / rows
    weigh(span, rows, body, out)
    w = load(room, 0)
    if len(out.probability) > 0:
        out.probability[e, 0] = room[0]
    for i in range(0, size, WIDTH):
        d = load(work, line * PRIOR + i) - load(work, line * STEP + i)
        store(work, line * PRIOR + i, d)
        store(work, line * STEP + i, load(work, line * STEP + i) + w * d)
    at = 0
    for i in range(0, size, WIDTH):
        share = w * (1.0 - w) * load(work, line * PRIOR + i)
        for j in range(i, size, WIDTH):
            p = load(P, at)
            store(P, at, p + w * (load(Q, at) - p) + share * load(work, line * PRIOR + j))
            at += WIDTH
    apply_step(x, P, work, like)


def taken(P, work, rows, line, size, factor, room, place):
    """Update P and the step with the rows in the work space, their variances times a factor; return the sum of their ratios of noise.

    Innovations and variances are written to ``room`` at ``place``.
    """
    like = broadcast(0.0)
    clear_step(work, like)
    noise = like
    for r in range(rows):
        at = line * (ROWS + r) + size
        variance = factor * load(work, at + WIDTH)
        error, s = take_row(P, work, ROWS + r, load(work, at), variance, like)
        noise = noise + variance / s
        store(room, place + 2 * WIDTH * r, error)
        store(room, place + 2 * WIDTH * r + WIDTH, s)
    return noise


def weigh(span, number, body, out):
    """Write the probability of an outlier, in lanes, to the work space, and add to the sums."""
    room, free = body.room, body.free
    base = 0.0
    for i in range(WIDTH):
        nis, product = deviance_of(room, 0, number, i)
        wide, wide_product = deviance_of(room, WIDE, number, i)
        value, struck = mixed(body.outliers[i], nis, product, wide, wide_product)
        out.minus_log[WIDTH * span + i] += value
        if i == 0:
            base = value
        elif i <= free:
            room[WORK + i - 1] = (value - base) / body.step
        room[i] = struck
    for j in range(free):
        out.score[span, j] += room[WORK + j]
        for m in range(j + 1):
            out.information[span, j, m] += room[WORK + j] * room[WORK + m]
