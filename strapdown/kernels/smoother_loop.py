"""The smoother over whole records: backward passes over the segments that the filter stored.

A pass processes the segments in groups of ``WIDTH``, counted from the end of the record. Quantities that depend only on the filter are
computed for a group at once, one segment per lane, and stored as rows of matrices (``prepare_…``), which the recursion reads segment by
segment: a row in a SIMD register, times a scalar. Two recursions run together, the covariances one group behind the errors, because each
covariance needs the Jacobians at both errors of its segment, computed for a group at once (:func:`fold_jacobians`). They do not depend on
each other, so each hides the latency of the other. The next group is prepared in four parts between their steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import dot, multiply, scale, times_transpose_upper
from strapdown.kernels.lane_values import (
    WIDTH,
    any_lane,
    broadcast,
    load,
    load_quadruples,
    prefetch,
    select,
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
from strapdown.kernels.series import SQUARED_RANGE
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
"""Length of a stored segment: dt, increment (3), state (28)."""

# Offsets in a prepared group. For each segment ``MATRICES`` numbers: the columns of G, six numbers each, contiguous (36 and 4 more), the
# upper triangle of D by rows (21 and 3 more), and the corrections at its end (13 and 3 more). Loaded as a vector, a column of G includes
# two numbers of the next, and row i of D starts with i numbers of the row before; these lanes are not used. Then, one segment per lane,
# whether there was a measurement, and the filtered state at the start.
MATRICES = 80
NOISE = 40
TURN = 64
"""(−r3, r0, r1, r2, r3) of the quaternion r from the predicted attitude to that of the next segment, the correction of the bias (3), and
(r2, −r1, r0, r3, −r2): the columns of r0 I + [r1, r2, r3] are three consecutive numbers of these."""
MOVED = MATRICES * WIDTH
"""0: no measurement, so (a, d) = (ε, β); 1: small rotation; 2: large rotation."""
ATTITUDE = MOVED + WIDTH
BIAS = ATTITUDE + 4 * WIDTH
GROUP = BIAS + 3 * WIDTH
"""Length of a prepared group."""

# Offsets in the work space.
COLUMNS = 0
"""G, D and rotations of the group in preparation, one segment per lane."""
SHARE = COLUMNS + MATRICES * WIDTH
"""Its N and Q̄."""
STEP = SHARE + 52 * WIDTH
"""Its dt and rotation vectors."""
ERRORS = STEP + 4 * WIDTH
"""Smoothed errors (ε, β) of two groups alternately, a row of eight for each segment and one for the end of the group."""
RELATIVE = ERRORS + 2 * (WIDTH + 1) * WIDTH
"""a of each segment of a group, without the factor in ``FACTOR``, a row of eight each."""
STEPPED = RELATIVE + WIDTH * WIDTH
"""Three numbers and d, a row of eight."""
FACTOR = STEPPED + WIDTH
JACOBIAN = FACTOR + WIDTH
FOLDED = JACOBIAN + 9 * WIDTH
"""The first three columns of each G J, in the layout of the group."""
FOLDED_ROW = 24
COVARIANCE = FOLDED + FOLDED_ROW * WIDTH
"""P_s of each segment of a group and of its end: six rows of eight each, of which only the upper triangle is valid."""
COVARIANCE_ROW = 48
SMOOTHED = COVARIANCE + COVARIANCE_ROW * (WIDTH + 1)
"""A group's smoothed states in lanes: attitude, bias, A, B."""
GROUPS = SMOOTHED + 22 * WIDTH
"""From here the group in preparation, that of the errors, and that of the covariances, alternately."""
_ROOM = 3
WORK_SIZE = GROUPS + GROUP * _ROOM + WIDTH
"""Length of the work space, including alignment to a cache line."""

FEWEST_ROWS = WIDTH + 1
"""Minimum number of rows of the array of segments; rows after the end state are not read."""

_NOTHING = 1e-30
SIX = (0, 1, 2, 3, 4, 5)


def locate_edges(edges, event_time, segments, number, starts_out):
    """Write for each edge the number of the segment that starts there; for the last edge, ``number``.

    It repeats the steps of the filter (:func:`strapdown.kernels.walk.walk`) in the same arithmetic, so comparisons are exact: a stored dt
    that reaches the next event or edge is *equal* to the difference of the times.
    """
    e = 0
    k = 1
    now = edges[0]
    ahead = 0.0
    starts_out[0] = 0
    for j in range(number):
        while e < len(event_time) and event_time[e] <= now:
            e += 1
        stop = edges[k]
        if e < len(event_time) and event_time[e] < stop:
            stop = event_time[e]
        dt = segments[j, 0]
        reached = dt == stop - now - ahead or ahead + dt == stop - now
        ahead = 0.0 if reached else ahead + dt
        now = stop if reached else now
        if now >= edges[k]:
            starts_out[k] = j + 1
            k += 1
    return k


def store_columns(work, place, M):
    """Write a 3×3 block of G, its columns six numbers apart."""
    for column in range(3):
        store_several(work, place + 6 * WIDTH * column, M[column::3])


def prepare_turns(segments, start, work, group):
    """Write the states of the eight segments from ``segments[start]`` and the corrections at their ends; store dt and rotation."""
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
    # Without an update the bias is unchanged to the bit, the attitude to rounding.
    rotates = select(dot(step_b, step_b) > 0.0, broadcast(1.0), squared) > _NOTHING
    if any_lane(rotates):
        turn = (-r[3], *r, *step_b, r[2], -r[1], r[0], r[3], -r[2])
        store_several(work, COLUMNS + TURN * w, turn)
        near = select(r[0] > 0.0, squared, broadcast(1.0)) < 0.25 * SHORT
        how = select(near, broadcast(1.0), broadcast(2.0))
        store(work, group + MOVED, select(rotates, how, broadcast(0.0)))
    else:
        store(work, group + MOVED, broadcast(0.0))


def prepare_shares(segments, start, work, angle_variance, rate_variance):
    """Store N and Q̄ of the segments of :func:`prepare_turns`."""
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
    """Return the covariance blocks of eight segments, which start at the fourth number after ``segments[start]``."""
    n = sum((load_quadruples(segments, start + 4 * i, ROW) for i in range(6)), ())[3:]
    return n[:6], n[6:15], n[15:]


def prepare_gains(work):
    """Store G and D of the segments of :func:`prepare_shares`, one segment per lane."""
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
    """Return the blocks of N stored by :func:`prepare_shares`."""
    return tuple(load_matrix(work, SHARE + 9 * WIDTH * i) for i in range(4))


def prepare_rows(work, group):
    """Write the matrices of :func:`prepare_gains`, one row per segment, eight numbers of four segments at a time."""
    blocks = MATRICES // WIDTH if any_lane(load(work, group + MOVED) > 0.5) else TURN // WIDTH
    for k in range(blocks):
        for i in range(0, WIDTH, 4):
            first, second, third, fourth = load_quadruples(work, COLUMNS + WIDTH * WIDTH * k + i, WIDTH)
            s = group + MATRICES * i + WIDTH * k
            store(work, s, first)
            store(work, s + MATRICES, second)
            store(work, s + 2 * MATRICES, third)
            store(work, s + 3 * MATRICES, fourth)


def times_columns(work, places, columns):
    """Return the sum of six columns, each times its number."""
    a, b, c, d, e, f = places
    return (work[a] * columns[0] + work[b] * columns[1] + work[c] * columns[2]) + (
        work[d] * columns[3] + work[e] * columns[4] + work[f] * columns[5]
    )


def load_columns(work, first, last):
    """Return the six columns of a gain, three from each offset."""
    return tuple(load(work, place + column) for place in (first, last) for column in (0, 6, 12))


def carry_error(work, group, errors, i):
    """Propagate the smoothed error from the end of segment i of a group back to its start: (ε, β) ← G (a, d).

    Its latency limits the speed of the recursion. For small angles, the usual case, a = f v with v = sin(|a|/2) a/|a|, and f is computed
    from the cosine in parallel with G v.
    """
    w = WIDTH
    c0, c1, c2, c3, c4, c5 = load_columns(work, group + MATRICES * i, group + MATRICES * i + 18)
    e = errors + w * i + w
    moved_there = work[group + MOVED + i]
    if moved_there != 0.0:
        t = group + MATRICES * i + TURN
        s = RELATIVE + w * i
        d = STEPPED
        x = work[e] * work[e] + work[e + 1] * work[e + 1] + work[e + 2] * work[e + 2]
        turn = load(work, t + 2)
        store(work, d, turn + load(work, e))
        if moved_there < 1.5 and x < SHORT:
            # The product r ⊗ exp(ε), by a series of four terms. The precision of 1 − w² is sufficient for z, the squared sine.
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
        moved = work[s] * c0 + work[s + 1] * c1 + work[s + 2] * c2
        stepped = work[d + 3] * c3 + work[d + 4] * c4 + work[d + 5] * c5
        store(work, e - w, factor * moved + stepped)
    else:
        store(work, e - w, times_columns(work, (e, e + 1, e + 2, e + 3, e + 4, e + 5), (c0, c1, c2, c3, c4, c5)))


def fold_jacobians(work, group, errors):
    """Write the first three columns of G J for a group, J = J_r(a)⁻¹ J_r(ε) with ε the error at the end of each segment."""
    w = WIDTH
    rotates = load(work, group + MOVED) > 0.5
    if any_lane(rotates):
        e0, e1, e2, _ = load_quadruples(work, errors + w, w)
        a0, a1, a2, _ = load_quadruples(work, RELATIVE, w)
        a0, a1, a2 = scale(load(work, FACTOR), (a0, a1, a2))
        e = (e0, e1, e2)
        a = (select(rotates, a0, e0), select(rotates, a1, e1), select(rotates, a2, e2))
        if any_lane(dot(e, e) > SQUARED_RANGE) or any_lane(dot(a, a) > SQUARED_RANGE):
            for i in range(WIDTH):
                s = errors + w + w * i
                e = (work[s], work[s + 1], work[s + 2])
                _, J = moved((1.0, 0.0, 0.0, 0.0), e)
                a = e
                if work[group + MOVED + i] != 0.0:
                    s = RELATIVE + w * i
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
    """Return ``start`` plus the sum of six rows z times one row of the gain (entries a column apart, three at f and three at g)."""
    return (start + work[f] * z[0] + work[f + 6] * z[1] + work[f + 12] * z[2]) + (
        work[g] * z[3] + work[g + 6] * z[4] + work[g + 12] * z[5]
    )


def carry_covariance(work, group, i):
    """Propagate the smoothed covariance from the end of segment i of a group back to its start: P_s ← (G J) P_s (G J)ᵀ + D."""
    g = group + MATRICES * i
    f = FOLDED + FOLDED_ROW * i
    p = COVARIANCE + COVARIANCE_ROW * i + COVARIANCE_ROW
    d = g + NOISE
    g += 18
    columns = load_columns(work, f, g)
    # Rows of P_s (G J)ᵀ; P_s is read from its upper triangle.
    z = tuple(times_columns(work, tuple(p + 8 * min(r, c) + max(r, c) for c in SIX), columns) for r in SIX)
    for r, begin in enumerate((0, 5, 9, 12, 14, 15)):
        store(work, p - COVARIANCE_ROW + 8 * r, row_times(work, f + r, g + r, z, load(work, d + begin)))


def move_states(work, group, errors, whole):
    """Write the smoothed states of a group: the filtered states corrected by the errors, with the covariance in the new tangent space.

    B is written only for the ``whole`` covariance; C is unchanged.
    """
    w = WIDTH
    e0, e1, e2, beta0 = load_quadruples(work, errors, w)
    beta1, beta2, _, _ = load_quadruples(work, errors + 4, w)
    b0, b1, b2 = load_triple(work, group + BIAS)
    t = SMOOTHED
    store_several(work, t + 4 * w, (b0 + beta0, b1 + beta1, b2 + beta2))
    e = (e0, e1, e2)
    if any_lane(dot(e, e) > SQUARED_RANGE):
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
    """Return 13 numbers of a lane, starting at ``start``."""
    return tuple(work[start + WIDTH * i] for i in range(13))


def diagonal_block(work, start):
    """Return the upper triangle of the 3×3 block at ``start``, in rows of eight."""
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
    """Output arrays of a pass, a row for each edge."""

    attitude: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    """By rows (edges, 36), or (0, 36)."""


def smooth_back(segments, starts, angle_variance, rate_variance, work, out):
    """Smooth from the filtered state at the last edge back to the first, and write all edges.

    ``segments`` holds the filter's rows (dt, increment, state at the start), flat, at least ``FEWEST_ROWS``, with the end state in the
    last; ``starts[k]`` is the row that starts at edge k. ``work`` has ``WORK_SIZE`` numbers.
    """
    w = WIDTH
    # Aligned to a cache line, so that vectors do not cross one. Not in a function, because kernels must not return arrays.
    work = work[-(work.ctypes.data // 8) % WIDTH :]
    for i in range(GROUPS):
        work[i] = 0.0
    k = len(starts) - 1
    j = starts[k]
    q, b, A, B, C = load_state(segments[ROW * j + 4 : ROW * j + 4 + SIZE])
    keep_state(out, k, q, b, A, B, C)
    k -= 1
    if k < 0:
        return
    # Group t ends t groups before this row; the last starts with row 0 and may overlap the one before it.
    end = len(segments) // ROW - 1
    top = (end - j) // w
    bottom = (end - 1 - starts[0]) // w
    count, group, place = 0, GROUPS, GROUPS
    # Each iteration prepares a group, propagates errors over the previous one, and covariances over the one before that.
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
                store(work, errors + w * i, broadcast(0.0))
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
                    prefetch(segments, start - ROW * (1 + i) + WIDTH * line)
                if i < count:
                    carry_error(work, group, errors, i)
                if i < count_before:
                    carry_covariance(work, group_before, i)
        if t > top:
            begin = max(end - w * t, 0)
            if starts[k] >= begin:
                move_states(work, group_before, errors_before, len(out.covariance) > 0)
                while k >= 0 and starts[k] >= begin:
                    write_smoothed(work, starts[k] - begin, k, out)
                    k -= 1
        if top <= t <= bottom:
            fold_jacobians(work, group, errors)
