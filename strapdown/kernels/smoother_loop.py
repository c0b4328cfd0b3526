"""The smoother over whole records: backward passes over the segments that the filter stored.

A pass takes the segments in groups of ``WIDTH``, counted from the end of the record. What depends on the filter alone is computed for a
group at once, a segment a lane, and left as rows of matrices (``prepare_…``), which the chain then reads segment by segment: one row in a
machine vector, times a number spread over it. Two chains run in step, the covariances a group behind the errors, because each covariance
wants the Jacobians at both errors of its segment, which are again taken for a group at once (:func:`fold_jacobians`); neither chain waits
for the other, and one works while the other waits for itself. The group that comes next is prepared in four parts between their links.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import dot, multiply, scale, times_transpose_upper
from strapdown.kernels.lane_values import (
    WIDTH,
    anywhere,
    chosen,
    fetch,
    lanes_of,
    load,
    load_quadruples,
    spread,
    store,
)
from strapdown.kernels.rotation import (
    SHORT,
    arcsine_series,
    composed,
    inverse_right_jacobian,
    moved,
    near_inverse_right_jacobian,
    quaternion_multiply,
    right_jacobian,
    turned,
)
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.kernels.smoother_step import gain, kept_share, left_noise, step_noise
from strapdown.kernels.state import (
    SIZE,
    keep_state,
    load_matrix,
    load_quaternion,
    load_state,
    load_triple,
    store_several,
)

ROW = 32
"""Numbers of a stored segment: dt, increment (3), state (28)."""

# Places in a prepared group. Of each segment first ``MATRICES`` numbers: the columns of G, six numbers each, without gaps (36 and 4 more),
# the upper triangle of D by rows (21 and 3 more), and what the updates at its end did (13 and 3 more). Read as a vector, a column of G ends
# in two lanes of the next, and row i of D begins with i lanes of the row before: lanes of which no use is made. Then, a lane a segment,
# whether anything was measured there, and the filtered state at its start.
MATRICES = 80
NOISE = 40
TURN = 64
"""(−r3, r0, r1, r2, r3) of the quaternion r from the predicted attitude to that of the next segment, the three numbers that the bias is
stepped by, and (r2, −r1, r0, r3, −r2): the columns of r0 I + [r1, r2, r3] are three of each five."""
MOVED = MATRICES * WIDTH
"""0 where nothing was measured: then the turn is rounding, and (a, d) = (ε, β). 1 where the turn is short, 2 where it is not."""
ATTITUDE = MOVED + WIDTH
BIAS = ATTITUDE + 4 * WIDTH
GROUP = BIAS + 3 * WIDTH
"""Numbers of a prepared group."""

# Places in the work space.
COLUMNS = 0
"""G, D and turns of the group in preparation, a lane a segment."""
SHARE = COLUMNS + MATRICES * WIDTH
"""Its N and Q̄."""
STEP = SHARE + 52 * WIDTH
"""Its dt and turns."""
ERRORS = STEP + 4 * WIDTH
"""Smoothed errors (ε, β) of two groups in turn, a row of eight for each segment, and one for the state that the group ends in."""
SEEN = ERRORS + 2 * (WIDTH + 1) * WIDTH
"""Of a group's segments a, but for a factor that stands in ``FACTOR``, a row of eight each."""
STEPPED = SEEN + WIDTH * WIDTH
"""Three numbers and d, a row of eight."""
FACTOR = STEPPED + WIDTH
JACOBIAN = FACTOR + WIDTH
FOLDED = JACOBIAN + 9 * WIDTH
"""The first three columns of each G J, as they lie in the group, and where they end."""
FOLDED_ROW = 24
COVARIANCE = FOLDED + FOLDED_ROW * WIDTH
"""P_s of a group's segments and of the state that it ends in: six rows of eight each, of which only the upper triangle holds."""
COVARIANCE_ROW = 48
SMOOTHED = COVARIANCE + COVARIANCE_ROW * (WIDTH + 1)
"""A group's smoothed states in lanes: attitude, bias, A, B."""
GROUPS = SMOOTHED + 22 * WIDTH
"""From here on the group in preparation, that of the errors, and that of the covariances, in turn."""
_ROOM = 3
WORK_SIZE = GROUPS + GROUP * _ROOM + WIDTH
"""Numbers of work space, with room to begin at a cache line."""

FEWEST_ROWS = WIDTH + 1
"""Rows that the array of segments must have; any that follow the end state are not looked at."""

_NOTHING = 1e-30
_LARGEST_SQUARE = LARGEST_ANGLE * LARGEST_ANGLE
SIX = (0, 1, 2, 3, 4, 5)


def locate_edges(edges, event_time, segments, number, starts_out):
    """Write for each edge the number of the segment that starts there; for the last edge, ``number``.

    Follows the filter's own steps (:func:`strapdown.kernels.walk.walk`) in its own arithmetic, so nothing is compared within
    a tolerance: a stored dt that reaches the next event or edge is *equal* to the difference of the times.
    """
    e = 0
    k = 1
    now = edges[0]
    starts_out[0] = 0
    for j in range(number):
        while e < len(event_time) and event_time[e] <= now:
            e += 1
        stop = edges[k]
        if e < len(event_time) and event_time[e] < stop:
            stop = event_time[e]
        dt = segments[j, 0]
        now = stop if dt == stop - now else now + dt
        if now >= edges[k]:
            starts_out[k] = j + 1
            k += 1
    return k


def store_columns(work, place, M):
    """Write a 3×3 block of G, its columns six numbers apart."""
    for column in range(3):
        store_several(work, place + 6 * WIDTH * column, M[column::3])


def prepare_turns(segments, start, work, group):
    """Write the states of the eight segments from ``segments[start]`` on and what the updates at their ends did; keep dt and turn."""
    w = WIDTH
    dt, x, y, z = load_quadruples(segments, start, ROW)
    b0, b1, b2, _ = load_quadruples(segments, start + 8, ROW)
    next_b0, next_b1, next_b2, _ = load_quadruples(segments, start + ROW + 8, ROW)
    store_several(work, group + BIAS, (b0, b1, b2))
    step_b = (next_b0 - b0, next_b1 - b1, next_b2 - b2)
    phi = (x - dt * b0, y - dt * b1, z - dt * b2)
    store(work, STEP, dt)
    store_several(work, STEP + w, phi)
    q = load_quadruples(segments, start + 4, ROW)
    store_several(work, group + ATTITUDE, q)
    p = turned(q, phi)
    r = quaternion_multiply((p[0], -p[1], -p[2], -p[3]), load_quadruples(segments, start + ROW + 4, ROW))
    squared = r[1] * r[1] + r[2] * r[2] + r[3] * r[3]
    # Without an update the bias stays to the bit, the attitude to rounding.
    seen = chosen(dot(step_b, step_b) > 0.0, spread(1.0), squared) > _NOTHING
    if anywhere(seen):
        turn = (-r[3], *r, *step_b, r[2], -r[1], r[0], r[3], -r[2])
        store_several(work, COLUMNS + TURN * w, turn)
        near = chosen(r[0] > 0.0, squared, spread(1.0)) < 0.25 * SHORT
        how = chosen(near, spread(1.0), spread(2.0))
        store(work, group + MOVED, chosen(seen, how, spread(0.0)))
    else:
        store(work, group + MOVED, spread(0.0))


def prepare_shares(segments, start, work, angle_variance, rate_variance):
    """Keep N and Q̄ of the segments of :func:`prepare_turns`."""
    w = WIDTH
    dt = load(work, STEP)
    phi = load_triple(work, STEP + w)
    P = load_covariance(segments, start + 8)
    q11, q12, q22 = step_noise(phi, dt, angle_variance, rate_variance)
    N = kept_share(*P, q11, q12, q22)
    for i, part in enumerate(N):
        store_several(work, SHARE + 9 * w * i, part)
    store_several(work, SHARE + 36 * w, (*q11, *q12, q22))


def load_covariance(segments, start):
    """Return the blocks of eight segments' covariance, of which the first number is the fourth from ``segments[start]`` on."""
    n = sum((load_quadruples(segments, start + 4 * i, ROW) for i in range(6)), ())[3:]
    return n[:6], n[6:15], n[15:]


def prepare_gains(work):
    """Keep G and D of the segments of :func:`prepare_shares`, a lane a segment."""
    w = WIDTH
    N = load_share(work)
    q = load_matrix(work, SHARE + 36 * w)[:6]
    d_tt, d_tb, d_bb = left_noise(N, q, load_matrix(work, SHARE + 42 * w), load(work, SHARE + 51 * w))
    upper = (*d_tt[:3], *d_tb[:3], *d_tt[3:5], *d_tb[3:6], d_tt[5], *d_tb[6:], *d_bb)
    store_several(work, COLUMNS + NOISE * w, upper)
    g_tt, g_tb, g_bt, g_bb = gain(N, load_triple(work, STEP + w), load(work, STEP))
    store_columns(work, COLUMNS, g_tt)
    store_columns(work, COLUMNS + 3 * w, g_bt)
    store_columns(work, COLUMNS + 18 * w, g_tb)
    store_columns(work, COLUMNS + 21 * w, g_bb)


def load_share(work):
    """Return the blocks of N that :func:`prepare_shares` keeps."""
    return tuple(load_matrix(work, SHARE + 9 * WIDTH * i) for i in range(4))


def prepare_rows(work, group):
    """Write the matrices of :func:`prepare_gains` a row a segment, eight numbers of four segments at a time."""
    blocks = MATRICES // WIDTH if anywhere(load(work, group + MOVED) > 0.5) else TURN // WIDTH
    for k in range(blocks):
        for i in range(0, WIDTH, 4):
            one, two, three, four = load_quadruples(work, COLUMNS + WIDTH * WIDTH * k + i, WIDTH)
            s = group + MATRICES * i + WIDTH * k
            store(work, s, one)
            store(work, s + MATRICES, two)
            store(work, s + 2 * MATRICES, three)
            store(work, s + 3 * MATRICES, four)


def times_columns(work, places, columns):
    """Return the sum of six columns, each times the number at its place."""
    a, b, c, d, e, f = places
    return (work[a] * columns[0] + work[b] * columns[1] + work[c] * columns[2]) + (
        work[d] * columns[3] + work[e] * columns[4] + work[f] * columns[5]
    )


def load_columns(work, first, last):
    """Return the six columns of a gain, three from each place."""
    return tuple(load(work, place + column) for place in (first, last) for column in (0, 6, 12))


def carry_error(work, group, errors, i):
    """Take the smoothed error from the end of segment i of a group to its start: (ε, β) ← G (a, d).

    The chain of all smoothed states hangs on it. For small angles, which are the rule, a = f v with v = sin(|a|/2) a/|a|, and f follows
    from the cosine, while v is already multiplied by G.
    """
    w = WIDTH
    c0, c1, c2, c3, c4, c5 = load_columns(work, group + MATRICES * i, group + MATRICES * i + 18)
    e = errors + w * i + w
    moved_there = work[group + MOVED + i]
    if moved_there != 0.0:
        t = group + MATRICES * i + TURN
        s = SEEN + w * i
        d = STEPPED
        x = work[e] * work[e] + work[e + 1] * work[e + 1] + work[e + 2] * work[e + 2]
        turn = load(work, t + 2)
        store(work, d, turn + load(work, e))
        if moved_there < 1.5 and x < SHORT:
            # The product r ⊗ exp(ε), with its series to the fourth term. z, the squared sine, needs no more digits than 1 − w² has.
            c = 1.0 + x * (x * (1.0 / 384.0) - 0.125)
            h = 0.5 + x * (x * (1.0 / 3840.0) - 1.0 / 48.0)
            u = work[e] * load(work, t + 10) + work[e + 1] * load(work, t) + work[e + 2] * load(work, t + 8)
            store(work, s, c * turn + h * u)
            cosine = c * work[t + 1] - h * (
                work[t + 2] * work[e] + work[t + 3] * work[e + 1] + work[t + 4] * work[e + 2]
            )
            factor = arcsine_series(1.0 - cosine * cosine)
        else:
            a = composed(
                (work[t + 1], work[t + 2], work[t + 3], work[t + 4]),
                (work[e], work[e + 1], work[e + 2]),
            )
            work[s], work[s + 1], work[s + 2] = a
            factor = 1.0
        work[FACTOR + i] = factor
        seen = work[s] * c0 + work[s + 1] * c1 + work[s + 2] * c2
        stepped = work[d + 3] * c3 + work[d + 4] * c4 + work[d + 5] * c5
        store(work, e - w, factor * seen + stepped)
    else:
        store(work, e - w, times_columns(work, (e, e + 1, e + 2, e + 3, e + 4, e + 5), (c0, c1, c2, c3, c4, c5)))


def fold_jacobians(work, group, errors):
    """Write the first three columns of G J for a group, J = J_r(a)⁻¹ J_r(ε) with ε the error at the end of each segment."""
    w = WIDTH
    seen = load(work, group + MOVED) > 0.5
    if anywhere(seen):
        e0, e1, e2, _ = load_quadruples(work, errors + w, w)
        a0, a1, a2, _ = load_quadruples(work, SEEN, w)
        a0, a1, a2 = scale(load(work, FACTOR), (a0, a1, a2))
        e = (e0, e1, e2)
        a = (chosen(seen, a0, e0), chosen(seen, a1, e1), chosen(seen, a2, e2))
        if anywhere(dot(e, e) > _LARGEST_SQUARE) or anywhere(dot(a, a) > _LARGEST_SQUARE):
            for i in range(WIDTH):
                s = errors + w + w * i
                e = (work[s], work[s + 1], work[s + 2])
                _, J = moved((1.0, 0.0, 0.0, 0.0), e)
                a = e
                if work[group + MOVED + i] != 0.0:
                    s = SEEN + w * i
                    a = scale(work[FACTOR + i], (work[s], work[s + 1], work[s + 2]))
                J = multiply(inverse_right_jacobian(a), J)
                for c in range(9):
                    work[JACOBIAN + w * c + i] = J[c]
        else:
            J = multiply(near_inverse_right_jacobian(a), right_jacobian(e))
            store_several(work, JACOBIAN, J)
        for i in range(WIDTH):
            g = group + MATRICES * i
            x, y, z = load(work, g), load(work, g + 6), load(work, g + 12)
            f = FOLDED + FOLDED_ROW * i
            for c in range(3):
                j = JACOBIAN + w * c + i
                store(work, f + 6 * c, work[j] * x + work[j + 3 * w] * y + work[j + 6 * w] * z)
    else:
        for i in range(WIDTH):
            g = group + MATRICES * i
            f = FOLDED + FOLDED_ROW * i
            store(work, f, load(work, g))
            store(work, f + 8, load(work, g + 8))
            store(work, f + 16, load(work, g + 16))


def row_times(work, f, g, z, start):
    """Return ``start`` plus the sum of six rows z, times the numbers of one row of the gain, three from column to column at f and at g."""
    return (start + work[f] * z[0] + work[f + 6] * z[1] + work[f + 12] * z[2]) + (
        work[g] * z[3] + work[g + 6] * z[4] + work[g + 12] * z[5]
    )


def carry_covariance(work, group, i):
    """Take the smoothed covariance from the end of segment i of a group to its start: P_s ← (G J) P_s (G J)ᵀ + D."""
    g = group + MATRICES * i
    f = FOLDED + FOLDED_ROW * i
    p = COVARIANCE + COVARIANCE_ROW * i + COVARIANCE_ROW
    d = g + NOISE
    g += 18
    columns = load_columns(work, f, g)
    # Rows of P_s (G J)ᵀ, of which P_s is read from its upper triangle.
    z = tuple(times_columns(work, tuple(p + 8 * min(r, c) + max(r, c) for c in SIX), columns) for r in SIX)
    for r, begin in enumerate((0, 5, 9, 12, 14, 15)):
        store(work, p - COVARIANCE_ROW + 8 * r, row_times(work, f + r, g + r, z, load(work, d + begin)))


def move_states(work, group, errors, whole):
    """Write a group's smoothed states: each filtered one moved by its error, the covariance carried to the new tangent space.

    B only where the ``whole`` covariance is wanted; C stays as it is.
    """
    w = WIDTH
    e0, e1, e2, beta0 = load_quadruples(work, errors, w)
    beta1, beta2, _, _ = load_quadruples(work, errors + 4, w)
    b0, b1, b2 = load_triple(work, group + BIAS)
    t = SMOOTHED
    store_several(work, t + 4 * w, (b0 + beta0, b1 + beta1, b2 + beta2))
    e = (e0, e1, e2)
    if anywhere(dot(e, e) > _LARGEST_SQUARE):
        for i in range(WIDTH):
            u = group + ATTITUDE + i
            s = errors + w * i
            q, J = moved((work[u], work[u + w], work[u + 2 * w], work[u + 3 * w]), (work[s], work[s + 1], work[s + 2]))
            for c in range(4):
                work[t + w * c + i] = q[c]
            for c in range(9):
                work[JACOBIAN + w * c + i] = J[c]
        J = load_matrix(work, JACOBIAN)
    else:
        store_several(work, t, turned(load_quaternion(work, group + ATTITUDE), e))
        J = right_jacobian(e)
    a0, a1, a2, c0 = load_quadruples(work, COVARIANCE, COVARIANCE_ROW)
    a3, a4, c3, c4 = load_quadruples(work, COVARIANCE + 9, COVARIANCE_ROW)
    a5, c6, c7, c8 = load_quadruples(work, COVARIANCE + 18, COVARIANCE_ROW)
    A = times_transpose_upper(multiply(J, (a0, a1, a2, a1, a3, a4, a2, a4, a5)), J)
    store_several(work, t + 7 * w, A)
    if whole:
        c1, c2, _, _ = load_quadruples(work, COVARIANCE + 4, COVARIANCE_ROW)
        c5, _, _, _ = load_quadruples(work, COVARIANCE + 13, COVARIANCE_ROW)
        B = multiply(J, (c0, c1, c2, c3, c4, c5, c6, c7, c8))
        store_several(work, t + 13 * w, B)


def lane_numbers(work, start):
    """Return 13 numbers of a lane, of which the first stands at ``start``."""
    return tuple(work[start + WIDTH * i] for i in range(13))


def diagonal_block(work, start):
    """Return the upper triangle of the 3×3 block that begins at ``start`` of rows of eight."""
    return tuple(work[start + WIDTH * i + j] for i in range(3) for j in range(i, 3))


def write_smoothed(work, i, k, out):
    """Write the smoothed state of segment i of a group to row k of the outputs; B has meaning where the whole covariance is wanted."""
    n = lane_numbers(work, SMOOTHED + i)
    B = lane_numbers(work, SMOOTHED + 13 * WIDTH + i)[:9]
    C = diagonal_block(work, COVARIANCE + COVARIANCE_ROW * i + 27)
    keep_state(out, k, n[:4], n[4:7], n[7:], B, C)


def start_covariance(work, p, segments, s):
    """Write the upper triangle of the filtered covariance at ``segments[s]`` to rows of eight."""
    for i in range(3):
        for j in range(3):
            work[p + 8 * i + 3 + j] = segments[s + 6 + 3 * i + j]
            if i <= j:
                place = i * (5 - i) // 2 + j
                work[p + 8 * i + j] = segments[s + place]
                work[p + 27 + 8 * i + j] = segments[s + 15 + place]


class Outputs(NamedTuple):
    """Arrays that a pass writes, a row an edge."""

    attitude: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    """Blocks A, B, C (edges, 21), or (0, 21)."""


def smooth_back(segments, starts, first, angle_variance, rate_variance, work, out):
    """Go back from the filtered state at the last edge to edge ``first``, and write all between.

    ``segments`` holds the filter's rows (dt, increment, state at its start), flat, the last one the end state, ``FEWEST_ROWS`` at least;
    ``starts[k]`` is the row that starts at edge k. ``work`` has room for ``WORK_SIZE``.
    """
    w = WIDTH
    # From a cache line on, which vectors then do not cross. Not in a function, which may return no part of an array.
    work = work[-(work.ctypes.data // 8) % WIDTH :]
    lanes_of((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    for i in range(GROUPS):
        work[i] = 0.0
    k = len(starts) - 1
    j = starts[k]
    q, b, A, B, C = load_state(segments[ROW * j + 4 : ROW * j + 4 + SIZE])
    keep_state(out, k, q, b, A, B, C)
    k -= 1
    if k < first:
        return
    # Group t ends t groups before this row; the last begins with row 0, however many it shares with the one before.
    end = len(segments) // ROW - 1
    top = (end - j) // w
    bottom = (end - 1 - starts[first]) // w
    count, group, place = 0, GROUPS, GROUPS
    # Each turn prepares a group, takes the errors over the one before, and the covariances over the one before that.
    for n in range(top, bottom + 3):
        group_before, group = group, place
        place = GROUPS + GROUP * (n % _ROOM)
        start = ROW * max(end - w * (n + 1), 0)
        t = n - 1
        count_before = count
        count = min(j, end - w * t) - max(end - w * (t + 1), 0) if top <= t <= bottom else 0
        errors = ERRORS + (w + 1) * w * (t & 1)
        errors_before = ERRORS + (w + 1) * w * (1 - (t & 1))
        if t == top:
            for i in range(w + 1):
                store(work, errors + w * i, spread(0.0))
        elif t > top:
            store(work, errors + w * count, load(work, errors_before))
            p_end = COVARIANCE + COVARIANCE_ROW * count_before
            if t == top + 1:
                start_covariance(work, p_end, segments, ROW * j + 11)
            else:
                for i in range(6):
                    store(work, p_end + w * i, load(work, COVARIANCE + w * i))
        for part in range(4):
            if n <= bottom:
                if part == 0:
                    prepare_turns(segments, start, work, place)
                elif part == 1:
                    prepare_shares(segments, start, work, angle_variance, rate_variance)
                elif part == 2:
                    prepare_gains(work)
                else:
                    prepare_rows(work, place)
            for m in range(2):
                i = w - 1 - 2 * part - m
                for line in range(4):
                    fetch(segments, start - ROW * (1 + i) + WIDTH * line)
                if i < count:
                    carry_error(work, group, errors, i)
                if i < count_before:
                    carry_covariance(work, group_before, i)
        if t > top:
            begin = max(end - w * t, 0)
            if starts[k] >= begin:
                move_states(work, group_before, errors_before, len(out.covariance) > 0)
                while k >= first and starts[k] >= begin:
                    write_smoothed(work, starts[k] - begin, k, out)
                    k -= 1
        if top <= t <= bottom:
            fold_jacobians(work, group, errors)
