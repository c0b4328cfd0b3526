"""Update for measurements with outliers, for :mod:`strapdown.kernels.likelihood`.

The noise of a measurement is normal with its variance or, with probability ε, with ``spread`` times that (Tukey 1960). The update is made
with both; the likelihood is that of the mixture, and the filter continues with mean and covariance of the mixture (generalised
pseudo-Bayes of first order; Bar-Shalom, Li & Kirubarajan 2001, section 11.6).
"""

from __future__ import annotations

import math

from strapdown.kernels.lane_values import WIDTH, broadcast, load, store
from strapdown.kernels.layout import LINE, PRIOR, RESIDUAL, ROWS, STEP, VARIANCE, N, copy_values, put_at, value_at
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
    rows, _, _ = write_rows(f.shape[measured.sensor[e]], x, f, measured, e, like)
    copy_values(P, Q, N * (N + 1) // 2, like)
    update_rows(Q, work, rows, load(body.outliers, WIDTH), room, WIDE)
    for i in range(N):
        put_at(work, LINE * PRIOR + i, value_at(work, LINE * STEP + i, like))
    noise = update_rows(P, work, rows, broadcast(1.0), room, 0)
    if len(out.probability) > 0:
        store(room, WORK, noise)
        out.probability[e, 1] = room[WORK] / rows
    weigh(span, rows, body, out)
    w = load(room, 0)
    if len(out.probability) > 0:
        out.probability[e, 0] = room[0]
    for i in range(N):
        step = value_at(work, LINE * STEP + i, like)
        d = value_at(work, LINE * PRIOR + i, like) - step
        put_at(work, LINE * PRIOR + i, d)
        put_at(work, LINE * STEP + i, step + w * d)
    at = 0
    for i in range(N):
        share = w * (1.0 - w) * value_at(work, LINE * PRIOR + i, like)
        for j in range(i, N):
            p = value_at(P, at, like)
            put_at(P, at, p + w * (value_at(Q, at, like) - p) + share * value_at(work, LINE * PRIOR + j, like))
            at += 1
    apply_step(x, P, work, like)


def update_rows(P, work, rows, factor, room, place):
    """Update P and the step with the rows in the work space, their variances times a factor; return the sum of their ratios of noise.

    Innovations and variances are written to ``room`` at ``place``.
    """
    like = broadcast(0.0)
    clear_step(work, like)
    noise = like
    for r in range(rows):
        at = LINE * (ROWS + r)
        variance = factor * value_at(work, at + VARIANCE, like)
        error, s = take_row(P, work, ROWS + r, value_at(work, at + RESIDUAL, like), variance, like)
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
