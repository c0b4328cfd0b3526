"""The filter over one record at eight sets of parameters in step, one a lane, and the sensitivities of its innovations.

The same filter as :mod:`strapdown.kernels.filter_loop`: gyro noise, the σ of each sensor and the initial covariance differ from lane to
lane. Where lane i is lane 0 with parameter i moved a little, differences between lanes are the derivatives of each innovation and of its
variance, and their sums the score and the information of the likelihood.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import add, combine, dot, matrix_times_vector, scale, transpose_times_vector
from strapdown.kernels.filter_step import predict, reset, update_row
from strapdown.kernels.lane_angles import arctangent, rotation_vector
from strapdown.kernels.lane_values import WIDTH, load, spread, store, total
from strapdown.kernels.measurement import ATTITUDE, HEADING, VECTOR, direction_rows, heading_row, vector_at
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.kernels.walk import MAX_TURN

HALF_RANGE = 0.25 * LARGEST_ANGLE * LARGEST_ANGLE
"""The square of half the turn that the polynomials bear."""


def load_state(array, start):
    """Return (q, b, A, B, C) in lanes from 28 times ``WIDTH`` numbers."""
    w = WIDTH
    s = start
    return (
        (load(array, s), load(array, s + w), load(array, s + 2 * w), load(array, s + 3 * w)),
        (load(array, s + 4 * w), load(array, s + 5 * w), load(array, s + 6 * w)),
        (
            load(array, s + 7 * w),
            load(array, s + 8 * w),
            load(array, s + 9 * w),
            load(array, s + 10 * w),
            load(array, s + 11 * w),
            load(array, s + 12 * w),
        ),
        (
            load(array, s + 13 * w),
            load(array, s + 14 * w),
            load(array, s + 15 * w),
            load(array, s + 16 * w),
            load(array, s + 17 * w),
            load(array, s + 18 * w),
            load(array, s + 19 * w),
            load(array, s + 20 * w),
            load(array, s + 21 * w),
        ),
        (
            load(array, s + 22 * w),
            load(array, s + 23 * w),
            load(array, s + 24 * w),
            load(array, s + 25 * w),
            load(array, s + 26 * w),
            load(array, s + 27 * w),
        ),
    )


def store_lanes(array, start, q, b, A, B, C):
    """Write (q, b, A, B, C) in lanes to 28 times ``WIDTH`` numbers."""
    w = WIDTH
    s = start
    store(array, s, q[0])
    store(array, s + w, q[1])
    store(array, s + 2 * w, q[2])
    store(array, s + 3 * w, q[3])
    store(array, s + 4 * w, b[0])
    store(array, s + 5 * w, b[1])
    store(array, s + 6 * w, b[2])
    for i in range(6):
        store(array, s + (7 + i) * w, A[i])
        store(array, s + (22 + i) * w, C[i])
    for i in range(9):
        store(array, s + (13 + i) * w, B[i])


def longest_interval(edges):
    """Return the length of the longest interval between edges."""
    longest = 0.0
    for k in range(len(edges) - 1):
        longest = max(longest, edges[k + 1] - edges[k])
    return longest


def calm_turn(b, dt):
    """Return the square of a gyro increment, over ``dt`` at most, up to which the turn of every lane is in the range of the polynomials.

    Increment and bias may each turn by half of that range. Where the bias of a lane turns by more, no increment will do: −1.
    """
    # The sum over the lanes is no less than the largest, and NaN is not below anything.
    return HALF_RANGE if total(dot(b, b)) * (dt * dt) < HALF_RANGE else -1.0


def longest_step_of_lanes(theta, whole, b, room):
    """Return the longest step in an interval of increment ``theta`` and length ``whole`` that turns no lane too far.

    A turn beyond the range of the polynomials, in any lane, is cut into sub-steps of all: at constant rate they compose exactly. A lane
    that is lost, of a turn above ``MAX_TURN``, is left out. ``room`` (WIDTH) is work space.
    """
    turn = combine(1.0, theta, -whole, b)
    store(room, 0, dot(turn, turn))
    squared = LARGEST_ANGLE * LARGEST_ANGLE
    for i in range(WIDTH):
        if squared < room[i] < MAX_TURN * MAX_TURN:
            squared = room[i]
    return whole * (LARGEST_ANGLE / math.sqrt(squared))


def put_row(rows, k, h, y):
    """Write row k of a measurement, h (3) and y in lanes, to the work space."""
    start = 4 * WIDTH * k
    store(rows, start, h[0])
    store(rows, start + WIDTH, h[1])
    store(rows, start + 2 * WIDTH, h[2])
    store(rows, start + 3 * WIDTH, y)


def axis_row(k):
    """Return unit vector k in lanes."""
    return (
        spread(1.0 if k == 0 else 0.0),
        spread(1.0 if k == 1 else 0.0),
        spread(1.0 if k == 2 else 0.0),
    )


def measured_rows(q, z, kind, t, triads, rows):
    """Write the rows of one measurement to ``rows`` and return how many take part in the update."""
    if kind == ATTITUDE:
        measured = (
            spread(triads[t, 0]),
            spread(triads[t, 1]),
            spread(triads[t, 2]),
            spread(triads[t, 3]),
        )
        y = rotation_vector(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), measured))
        put_row(rows, 0, axis_row(0), y[0])
        put_row(rows, 1, axis_row(1), y[1])
        put_row(rows, 2, axis_row(2), y[2])
        return 3
    R = rotation_matrix(q)
    if kind == HEADING:
        m = matrix_times_vector(R, z)
        east, north = triads[t, 6], triads[t, 7]
        put_row(rows, 0, heading_row(R, z), arctangent(m[0] * north - m[1] * east, m[0] * east + m[1] * north))
        return 1
    u = (triads[t, 0], triads[t, 1], triads[t, 2])
    v = (triads[t, 3], triads[t, 4], triads[t, 5])
    h1, y1, h2, y2 = direction_rows(R, u, v, z)
    put_row(rows, 0, h1, y1)
    put_row(rows, 1, h2, y2)
    if kind == VECTOR:
        r = (triads[t, 6], triads[t, 7], triads[t, 8])
        store(rows, 8 * WIDTH, dot(transpose_times_vector(R, r), z) - 1.0)
    return 2


def add_derivatives(found, number, free, step, score, information, outer, work):
    """Add one event to the score Σ ∂ℓ/∂θ, the information and the outer product of the score; ℓ = ½ (log s + e²/s).

    ``found`` holds e and s of ``number`` innovations in lanes; lane i is lane 0 with parameter i moved by ``step``. The information is
    Fisher's by sensitivities, ``ė_j ė_k/s + ½ ṡ_j ṡ_k/s²`` (Segal & Weinstein 1989): positive semidefinite whatever the data.
    """
    for j in range(free):
        work[j] = 0.0
    for r in range(number):
        place = 2 * WIDTH * r
        e = found[place]
        s = found[place + WIDTH]
        inverse = 1.0 / s
        over = inverse / step
        whitened = e * e * inverse
        for j in range(free):
            change_e = (found[place + 1 + j] - e) * over
            change_s = (found[place + WIDTH + 1 + j] - s) * over
            work[WIDTH + j] = change_e
            work[2 * WIDTH + j] = change_s
            work[j] += 0.5 * change_s * (1.0 - whitened) + e * change_e
        for j in range(free):
            a = work[WIDTH + j] * s
            c = 0.5 * work[2 * WIDTH + j]
            for k in range(j + 1):
                information[j, k] += a * work[WIDTH + k] + c * work[2 * WIDTH + k]
    for j in range(free):
        score[j] += work[j]
        for k in range(j + 1):
            outer[j, k] += work[j] * work[k]


def run_parameters(
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
    state,
    cuts,
    free,
    step,
    minus_log,
    squares,
    score,
    information,
    outer,
    epochs,
    state_out,
    innovations,
    rows,
    found,
    work,
):
    """Run the filter over a record at the parameters of each lane.

    ``noise`` holds σ_v² and σ_u² in lanes, ``factors`` (sensors × WIDTH) what each sensor's variances are multiplied by, ``state``
    (28 × WIDTH) the initial states, and is left at the end states. The span from ``cuts[c − 1]`` to ``cuts[c]``, the last without end,
    is part c of the record: ``minus_log`` (parts × WIDTH) gets Σ ½ (log s + e²/s) of its innovations, ``squares`` (parts × WIDTH)
    Σ e²/s, and ``score`` (parts, free), ``information`` and ``outer`` (parts, free, free), lower triangles, the derivatives of lane 0 by
    the ``free`` parameters that lanes 1, 2, … have moved by ``step``. ``state_out`` (epochs × 28 × WIDTH) gets the states at the edges
    ``epochs``. ``innovations`` (events × 6 × WIDTH, or nothing) gets e and s of each measurement, one row after the other. ``rows``
    (12 WIDTH), ``found`` (6 WIDTH) and ``work`` (4 WIDTH) are work space.
    """
    q, b, A, B, C = load_state(state, 0)
    angle_variance = load(noise, 0)
    rate_variance = load(noise, WIDTH)
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
    kept = 0
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
            correction = (spread(0.0), spread(0.0), spread(0.0))
            for r in range(taking):
                start = 4 * WIDTH * r
                h = (load(rows, start), load(rows, start + WIDTH), load(rows, start + 2 * WIDTH))
                innovation = load(rows, start + 3 * WIDTH) - dot(h, correction)
                variance = (event_value[e, r] if kind == ATTITUDE else event_variance[e]) * factor
                turn, b, A, B, C, s = update_row(b, A, B, C, h, innovation, variance)
                correction = add(correction, turn)
                store(found, 2 * WIDTH * r, innovation)
                store(found, 2 * WIDTH * r + WIDTH, s)
            q, A, B = reset(q, A, B, correction)
            calm = calm_turn(b, span)
            if kind == VECTOR:
                store(found, 4 * WIDTH, load(rows, 8 * WIDTH))
                store(found, 5 * WIDTH, event_variance[e] * factor)
                taking = 3
            for i in range(WIDTH):
                product = 1.0
                deviance = 0.0
                for r in range(taking):
                    s = found[2 * WIDTH * r + WIDTH + i]
                    deviance += found[2 * WIDTH * r + i] * found[2 * WIDTH * r + i] / s
                    product *= s
                minus_log[WIDTH * part_of_record + i] += 0.5 * (math.log(product) + deviance)
                squares[WIDTH * part_of_record + i] += deviance
            if len(innovations) > 0:
                start = 6 * WIDTH * e
                for i in range(2 * WIDTH * taking):
                    innovations[start + i] = found[i]
            if free > 0:
                add_derivatives(
                    found,
                    taking,
                    free,
                    step,
                    score[part_of_record],
                    information[part_of_record],
                    outer[part_of_record],
                    work,
                )
            e += 1
        if now >= end and (e == events or event_time[e] > end):
            k += 1
            if kept < len(epochs) and epochs[kept] == k:
                store_lanes(state_out, 28 * WIDTH * kept, q, b, A, B, C)
                kept += 1
            if k < len(increments):
                end = edges[k + 1]
                whole = end - now
                theta = vector_at(increments, k)
    store_lanes(state, 0, q, b, A, B, C)
