"""The filter over one whole record: the scalar machine. Compiled by :func:`strapdown.kernels.machine.compiled`."""

from __future__ import annotations

import math

from strapdown.kernels.algebra import combine, dot, matrix_times_vector, scale, transpose_times_vector
from strapdown.kernels.filter_step import (
    heading_row,
    predict,
    shows_heading,
    update_attitude,
    update_direction,
    update_heading,
)
from strapdown.kernels.lane_values import element
from strapdown.kernels.rotation import rotation_matrix
from strapdown.kernels.series import LARGEST_ANGLE

DIRECTION = 0
"""Kind of an event: a unit direction, two degrees of freedom."""
VECTOR = 1
"""Kind of an event: a whole vector over the length of its reference, three degrees of freedom."""
HEADING = 2
"""Kind of an event: a body vector of which only the heading of its horizontal part is used, one degree of freedom."""
ATTITUDE = 3
"""Kind of an event: a whole attitude, three degrees of freedom. Its frame holds the quaternion in its first four numbers, its value the
three variances."""

CALLED = ("run_stretch", "least_share")
"""Not inlined where other kernels use them."""
MOST_TURN = 1e6
"""rad: a step whose bias turns the body by more is of a filter that is lost, and is not cut into sub-steps."""


CHECKED = 1024
"""Intervals from one look at that to the next."""


def least_share(state, work):
    """Return the least part that is left of any state's variance when the states after it are known; 1 of a state without variance.

    It is the square of the diagonal of the covariance's triangular factor over the variance, and falls to the rounding of a double, or
    below zero, where the covariance has lost its digits. ``state`` holds (q, b, A, B, C), ``work`` (7, 6) is scratch.
    """
    k = 0
    for i in range(3):
        for j in range(i, 3):
            work[i, j] = state[7 + k]
            work[3 + i, 3 + j] = state[22 + k]
            k += 1
        for j in range(3):
            work[i, 3 + j] = state[13 + 3 * i + j]
    for j in range(6):
        work[6, j] = work[j, j]
    least = 1.0
    for j in range(5, -1, -1):
        pivot = work[j, j]
        if work[6, j] == 0.0:
            continue
        share = pivot / work[6, j]
        if not share >= least:
            least = share
        if not share > 0.0:
            return share
        for i in range(j):
            factor = work[i, j] / pivot
            for c in range(i, j):
                work[i, c] -= factor * work[c, j]
    return least


def vector_at(array, k):
    """Return row k of an (n, 3) array as a 3-tuple."""
    return (array[k, 0], array[k, 1], array[k, 2])


def heading_error(R, z, reference):
    """Return the angle about the fixed z axis from the horizontal part of R z to that of ``reference``, rad in (−π, π]."""
    x, y, _ = matrix_times_vector(R, z)
    return math.atan2(x * reference[1] - y * reference[0], x * reference[0] + y * reference[1])


def merge_order(time, heads, ends, ordered, row, series):
    """Merge several series, each sorted, that stand one after the other in ``time``; at one time the earlier series comes first.

    Writes for each event in order of time when and where it stands and the number of its series. ``heads`` and ``ends`` bound each
    series; ``heads`` is used up.
    """
    for e in range(len(row)):
        best = 0
        earliest = math.inf
        for s in range(len(heads)):
            k = heads[s]
            if k < ends[s] and time[k] < earliest:
                best = s
                earliest = time[k]
        ordered[e] = earliest
        row[e] = heads[best]
        series[e] = best
        heads[best] += 1


def common_order(time, number, ordered, row, series):
    """Write what :func:`merge_order` does for ``number`` series that share the times ``time``."""
    count = len(time)
    if number == 2:  # the commonest; written out, the loop goes in machine vectors and takes a third of the time
        for k in range(count):
            now = time[k]
            ordered[2 * k] = now
            ordered[2 * k + 1] = now
            row[2 * k] = k
            row[2 * k + 1] = count + k
            series[2 * k] = 0
            series[2 * k + 1] = 1
        return
    for s in range(number):
        e = s
        for k in range(count):
            ordered[e] = time[k]
            row[e] = s * count + k
            series[e] = s
            e += number


def store_state(out, q, b, A, B, C):
    """Write (q, b, A, B, C) to 28 numbers."""
    for i in range(4):
        out[i] = q[i]
    for i in range(3):
        out[4 + i] = b[i]
    for i in range(6):
        out[7 + i] = A[i]
        out[22 + i] = C[i]
    for i in range(9):
        out[13 + i] = B[i]


def store_segment(out, k, dt, part, q, b, A, B, C):
    """Write row k of the segments: dt, increment, state."""
    out[k, 0] = dt
    out[k, 1], out[k, 2], out[k, 3] = part
    store_state(out[k, 4:], q, b, A, B, C)


def run_stretch(
    edges,
    increments,
    angle_variance,
    rate_variance,
    time,
    event_row,
    event_series,
    value,
    sigma,
    places,
    bounds,
    kinds,
    frames,
    triads,
    state,
    every,
    attitude_out,
    bias_out,
    variance_out,
    covariance_out,
    innovation_out,
    segment_out,
    sharp,
):
    """Run the filter over a stretch of a record: see :func:`run_filter`, of which the arguments are parts.

    Returns the numbers of segments stored and of events taken, and whether it ended before the stretch does, after a measurement whose
    innovation has more than ``sharp`` times its own variance.
    """
    q = (state[0], state[1], state[2], state[3])
    b = (state[4], state[5], state[6])
    A = (state[7], state[8], state[9], state[10], state[11], state[12])
    B = (state[13], state[14], state[15], state[16], state[17], state[18], state[19], state[20], state[21])
    C = (state[22], state[23], state[24], state[25], state[26], state[27])
    events = len(event_row)
    e = 0
    k = -1  # the interval before the first edge has no length; its end takes the events at the first edge
    now = edges[0]
    end = now
    whole = 1.0
    theta = (0.0, 0.0, 0.0)
    countdown = 0
    row = 0
    segments = 0
    # One pass predicts to the next event or edge, takes in the event, and closes the interval, each where there is one.
    while k < len(increments):
        due = e < events and time[e] <= end
        stop = time[e] if due else end
        dt = stop - now
        if dt > 0.0:
            part = theta
            turn = combine(1.0, theta, -dt, b)
            squared = dot(turn, turn)
            # Most often a whole interval: a branch that is foretold costs less than a choice between values, which waits for both.
            if dt != whole or squared > LARGEST_ANGLE * LARGEST_ANGLE:
                part = scale(dt / whole, theta)
                turn = combine(1.0, part, -dt, b)
                squared = dot(turn, turn)
                # Beyond the range of the polynomials, sub-steps: at constant rate they compose exactly, so this is the same model.
                if LARGEST_ANGLE * LARGEST_ANGLE < squared < MOST_TURN * MOST_TURN:
                    share = LARGEST_ANGLE / math.sqrt(squared)
                    dt = share * dt
                    part = scale(share, part)
                    stop = now + dt
                    due = False
            if segments < len(segment_out):
                store_segment(segment_out, segments, dt, part, q, b, A, B, C)
                segments += 1
            q, A, B, C = predict(q, b, A, B, C, part, dt, angle_variance, rate_variance)
            now = stop
        if due:
            R = rotation_matrix(q)
            at = event_row[e]
            series = event_series[e]
            kind = kinds[series]
            t = frames[series, 0] + frames[series, 1] * (at - bounds[series])
            here = places[series, 0] + 3 * at
            z = (element(value, here), element(value, here + 1), element(value, here + 2))
            deviation = element(sigma, places[series, 1] + at)
            variance = deviation * deviation
            if kind == ATTITUDE:
                measured = (triads[t, 0], triads[t, 1], triads[t, 2], triads[t, 3])
                q, b, A, B, C, e1, s1, e2, s2, e3, s3 = update_attitude(q, b, A, B, C, measured, z)
                innovation_out[at, 4] = e3
                innovation_out[at, 5] = s3
                if s1 > sharp * z[0] or s2 > sharp * z[1] or s3 > sharp * z[2]:
                    return segments, e, True
            elif kind != HEADING:
                u = (triads[t, 0], triads[t, 1], triads[t, 2])
                v = (triads[t, 3], triads[t, 4], triads[t, 5])
                if kind == VECTOR:
                    # Its length says nothing of the attitude, but belongs to the innovation.
                    r = (triads[t, 6], triads[t, 7], triads[t, 8])
                    innovation_out[at, 4] = dot(transpose_times_vector(R, r), z) - 1.0
                    innovation_out[at, 5] = variance
                q, b, A, B, C, e1, s1, e2, s2 = update_direction(q, b, A, B, C, R, u, v, z, variance)
                if s1 + s2 > sharp * variance:
                    return segments, e, True
            else:
                e1, s1, e2, s2 = math.nan, 0.0, 0.0, 1.0
                if shows_heading(R, z):
                    error = heading_error(R, z, (triads[t, 6], triads[t, 7], triads[t, 8]))
                    q, b, A, B, C, e1, s1 = update_heading(q, b, A, B, C, heading_row(R, z), error, variance)
                if s1 > sharp * variance:
                    return segments, e, True
            innovation_out[at, 0] = e1
            innovation_out[at, 1] = s1
            innovation_out[at, 2] = e2
            innovation_out[at, 3] = s2
            e += 1
        if now >= end and (e == events or time[e] > end):
            if countdown == 0:
                countdown = every
                attitude_out[row, 0], attitude_out[row, 1], attitude_out[row, 2], attitude_out[row, 3] = q
                bias_out[row, 0], bias_out[row, 1], bias_out[row, 2] = b
                variance_out[row, 0], variance_out[row, 1], variance_out[row, 2] = A[0], A[3], A[5]
                variance_out[row, 3], variance_out[row, 4], variance_out[row, 5] = C[0], C[3], C[5]
                if row < len(covariance_out):
                    for i in range(6):
                        covariance_out[row, i] = A[i]
                        covariance_out[row, 15 + i] = C[i]
                    for i in range(9):
                        covariance_out[row, 6 + i] = B[i]
                row += 1
            countdown -= 1
            k += 1
            if k < len(increments):
                end = edges[k + 1]
                whole = end - now
                theta = vector_at(increments, k)
    store_state(state, q, b, A, B, C)
    return segments, e, False


def run_filter(
    edges,
    increments,
    angle_variance,
    rate_variance,
    time,
    event_row,
    event_series,
    value,
    sigma,
    places,
    bounds,
    kinds,
    frames,
    triads,
    state,
    every,
    attitude_out,
    bias_out,
    variance_out,
    covariance_out,
    innovation_out,
    segment_out,
    sharp,
    least,
    stretch_state,
    work,
):
    """Run the filter over a record; events lie between the first and the last edge.

    The e-th event, at ``time[e]``, is of series ``event_series[e]`` and stands at ``event_row[e]``, counted over all series one after
    the other, of which ``bounds`` tells where each begins. Its three numbers are ``value[places[s, 0] + 3 · row]`` and the next two, its
    σ is ``sigma[places[s, 1] + row]``: only the first series need lie in these arrays, each stays where it was measured. The kind of a
    series is in ``kinds`` and its frames are in ``triads`` (frames: row of the first, and how many rows on the next).

    The interval from ``edges[k]`` to ``edges[k + 1]`` is split at the times of the events inside it. ``state`` holds (q, b, A, B, C) as
    28 numbers and is left at the end state, so a run may be continued. Row j of the outputs is the state after ``every · j`` intervals;
    ``covariance_out`` (blocks A, B, C as 21 numbers) may be empty. One series after the other, ``innovation_out``
    (events, 4 or 6) gets e₁, s₁, e₂, s₂, e₃, s₃: independent innovations and their variances, as many as it has degrees of
    freedom.
    ``segment_out`` (segments, 32), which may be
    empty, gets what a smoother needs of each predicted segment: its dt, its increment (3) and the state (28) that it starts from.
    ``stretch_state`` (28,) and ``work`` (7, 6) are scratch.

    Returns the number of segments stored, and −1 and 0. Where the covariance would lose its digits, by a measurement of which the
    innovation has more than ``sharp`` times its own variance or bit by bit until :func:`least_share` is below ``least``, the run ends,
    ``state`` is left as it was when it had enough at last, at a row of the outputs, and that row and the number of events up to there are
    returned: :func:`strapdown.mekf.factored.run_sharp` goes on from there.
    """
    if not least_share(state, work) >= least:
        return 0, 0, 0
    stretch = every * ((CHECKED + every - 1) // every)
    segments = 0
    row = 0
    event = 0
    begin = 0
    while True:
        end = min(begin + stretch, len(increments))
        for i in range(28):
            stretch_state[i] = state[i]
        number, taken, too_sharp = run_stretch(
            edges[begin : end + 1],
            increments[begin:end],
            angle_variance,
            rate_variance,
            time[event:],
            event_row[event:],
            event_series[event:],
            value,
            sigma,
            places,
            bounds,
            kinds,
            frames,
            triads,
            stretch_state,
            every,
            attitude_out[row:],
            bias_out[row:],
            variance_out[row:],
            covariance_out[row:],
            innovation_out,
            segment_out[segments:],
            sharp,
        )
        if too_sharp or not least_share(stretch_state, work) >= least:
            return segments, row, event
        for i in range(28):
            state[i] = stretch_state[i]
        segments += number
        event += taken
        begin = end
        row = end // every
        if end == len(increments):
            return segments, -1, 0
