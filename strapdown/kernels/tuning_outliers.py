"""The filter over one record at eight sets of parameters in step, where some of the measurements are outliers.

The noise of a measurement is normal with its variance, or with probability ε of one ``spread`` times that (Tukey 1960). The update is made
both ways; the likelihood is that of the mixture, and the state goes on with the mean and the covariance of the mixture of both (generalised
pseudo-Bayes of first order; Bar-Shalom, Li & Kirubarajan 2001, section 11.6). Otherwise the loop is that of
:mod:`strapdown.kernels.tuning_loop`.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import add, dot, scale, subtract
from strapdown.kernels.filter_step import predict, reset, update_row
from strapdown.kernels.lane_values import WIDTH, load, spread, store
from strapdown.kernels.measurement import ATTITUDE, VECTOR, vector_at
from strapdown.kernels.state import load_state
from strapdown.kernels.tuning_loop import calm_turn, longest_interval, longest_step_of_lanes, measured_rows


def row_at(rows, r):
    """Return h (3) and y of row r in lanes from the work space."""
    start = 4 * WIDTH * r
    h = (load(rows, start), load(rows, start + WIDTH), load(rows, start + 2 * WIDTH))
    return h, load(rows, start + 3 * WIDTH)


def row_variance(event_value, event_variance, kind, e, r):
    """Return the variance of row r of measurement e."""
    return event_value[e, r] if kind == ATTITUDE else event_variance[e]


def add_deviance(found, place, e, s):
    """Add e²/s in lanes to ``found`` at ``place``, and multiply what stands behind it by s."""
    store(found, place, load(found, place) + e * e / s)
    store(found, place + WIDTH, load(found, place + WIDTH) * s)


def taken_in(b, A, B, C, rows, taking, kind, e, event_value, event_variance, factor, found, place):
    """Take in a measurement with all its variances times ``factor``; return the attitude correction, b, A, B, C.

    Its NIS and the determinant of its covariance, both in lanes, go to ``found``.
    """
    store(found, place, spread(0.0))
    store(found, place + WIDTH, spread(1.0))
    correction = (spread(0.0), spread(0.0), spread(0.0))
    for r in range(taking):
        h, y = row_at(rows, r)
        innovation = y - dot(h, correction)
        variance = row_variance(event_value, event_variance, kind, e, r) * factor
        turn, b, A, B, C, s = update_row(b, A, B, C, h, innovation, variance)
        correction = add(correction, turn)
        add_deviance(found, place, innovation, s)
    if kind == VECTOR:
        add_deviance(found, place, load(rows, 8 * WIDTH), event_variance[e] * factor)
    return correction, b, A, B, C


def between(w, x, y):
    """Return x + w (y − x) of two tuples of three."""
    return (x[0] + w * (y[0] - x[0]), x[1] + w * (y[1] - x[1]), x[2] + w * (y[2] - x[2]))


def between_symmetric(w, S, T, x, y):
    """Return the covariance of a mixture, (1 − w) of (S, mean x) and w of (T, mean y), as upper triangle."""
    d = subtract(y, x)
    v = scale(w * (1.0 - w), d)
    s0, s1, s2 = between(w, (S[0], S[1], S[2]), (T[0], T[1], T[2]))
    s3, s4, s5 = between(w, (S[3], S[4], S[5]), (T[3], T[4], T[5]))
    return (
        s0 + v[0] * d[0],
        s1 + v[0] * d[1],
        s2 + v[0] * d[2],
        s3 + v[1] * d[1],
        s4 + v[1] * d[2],
        s5 + v[2] * d[2],
    )


def between_matrix(w, S, T, x, y, u, v):
    """Return the cross-covariance of a mixture, of attitude (means x, y) and bias (means u, v)."""
    d = scale(w * (1.0 - w), subtract(y, x))
    g = subtract(v, u)
    a = between(w, (S[0], S[1], S[2]), (T[0], T[1], T[2]))
    b = between(w, (S[3], S[4], S[5]), (T[3], T[4], T[5]))
    c = between(w, (S[6], S[7], S[8]), (T[6], T[7], T[8]))
    return (
        a[0] + d[0] * g[0],
        a[1] + d[0] * g[1],
        a[2] + d[0] * g[2],
        b[0] + d[1] * g[0],
        b[1] + d[1] * g[1],
        b[2] + d[1] * g[2],
        c[0] + d[2] * g[0],
        c[1] + d[2] * g[1],
        c[2] + d[2] * g[2],
    )


def run_contaminated(
    edges,
    increments,
    noise,
    event_time,
    event_kind,
    event_value,
    event_variance,
    event_sensor,
    factors,
    event_reference,
    triads,
    outliers,
    state,
    cuts,
    free,
    step,
    minus_log,
    score,
    outer,
    probability,
    rows,
    found,
    work,
):
    """Run the filter over a record at the parameters of each lane.

    As :func:`strapdown.kernels.tuning_loop.run_parameters`; ``outliers`` (2 × WIDTH) holds ε and the variance of outliers over that of the
    others. ``outer`` (parts, free, free), lower triangles, gets the sums of the outer products of each measurement's gradient;
    ``probability`` (events, 2) gets for lane 0 that each measurement is an outlier, given all so far, and its NIS were it none.
    ``rows`` (12 WIDTH), ``found`` (4 WIDTH) and ``work`` (WIDTH) are work space.
    """
    q, b, A, B, C = load_state(state, 0)
    angle_variance = load(noise, 0)
    rate_variance = load(noise, WIDTH)
    inflation = load(outliers, WIDTH)
    events = len(event_time)
    e = 0
    k = -1
    now = edges[0]
    end = now
    whole = 1.0
    span = longest_interval(edges)
    calm = calm_turn(b, span)
    theta = (0.0, 0.0, 0.0)
    part_of_record = 0
    while k < len(increments):
        due = e < events and event_time[e] <= end
        stop = event_time[e] if due else end
        dt = stop - now
        if dt > 0.0:
            if dot(theta, theta) > calm:
                longest = longest_step_of_lanes(theta, whole, b, work)
                if dt > longest:
                    dt = longest
                    stop = now + dt
                    due = False
            part = theta
            if dt < whole:
                part = scale(dt / whole, theta)
            q, A, B, C = predict(q, b, A, B, C, part, dt, angle_variance, rate_variance)
            now = stop
        if due:
            while part_of_record < len(cuts) and event_time[e] > cuts[part_of_record]:
                part_of_record += 1
            z = vector_at(event_value, e)
            kind = event_kind[e]
            factor = load(factors, WIDTH * event_sensor[e])
            taking = measured_rows(q, z, kind, event_reference[e], triads, rows)
            turn, b0, A0, B0, C0 = taken_in(
                b, A, B, C, rows, taking, kind, e, event_value, event_variance, factor, found, 0
            )
            other, b1, A1, B1, C1 = taken_in(
                b, A, B, C, rows, taking, kind, e, event_value, event_variance, factor * inflation, found, 2 * WIDTH
            )
            base = 0.0
            for i in range(WIDTH):
                inside = math.log1p(-outliers[i]) - 0.5 * (found[i] + math.log(found[WIDTH + i]))
                outside = math.log(outliers[i]) - 0.5 * (found[2 * WIDTH + i] + math.log(found[3 * WIDTH + i]))
                highest = max(inside, outside)
                value = -highest - math.log(math.exp(inside - highest) + math.exp(outside - highest))
                struck = math.exp(outside + value)
                minus_log[WIDTH * part_of_record + i] += value
                if i == 0:
                    base = value
                    probability[e, 0] = struck
                    probability[e, 1] = found[0]
                elif i <= free:
                    work[i - 1] = (value - base) / step
                found[i] = struck
            for j in range(free):
                score[part_of_record, j] += work[j]
                for m in range(j + 1):
                    outer[part_of_record, j, m] += work[j] * work[m]
            w = load(found, 0)
            A = between_symmetric(w, A0, A1, turn, other)
            B = between_matrix(w, B0, B1, turn, other, b0, b1)
            C = between_symmetric(w, C0, C1, b0, b1)
            b = between(w, b0, b1)
            q, A, B = reset(q, A, B, between(w, turn, other))
            calm = calm_turn(b, span)
            e += 1
        if now >= end and (e == events or event_time[e] > end):
            k += 1
            if k < len(increments):
                end = edges[k + 1]
                whole = end - now
                theta = vector_at(increments, k)
