"""The fixed-lag smoother: backward passes of eight successive edges at once, a pass a lane.

The passes of successive edges meet the same segments but for a few at their ends, so each step takes all eight over one segment: what
depends on the filter alone, prepared as for one pass (:mod:`strapdown.kernels.smoother_loop`), is a number that all lanes are multiplied
by. A pass joins at the segment that its last edge begins, where its error is put to zero and its covariance to the filter's, and leaves
at its first edge. Before and after, its lane carries numbers that nobody reads.
"""

from __future__ import annotations

from strapdown.kernels.algebra import (
    dot,
    full,
    multiply,
    scale,
    times_transpose_upper,
)
from strapdown.kernels.lane_values import WIDTH, anywhere, lanes_of, load, store
from strapdown.kernels.rotation import (
    arcsine,
    composed,
    inverse_right_jacobian,
    moved,
    near_inverse_right_jacobian,
    right_jacobian,
)
from strapdown.kernels.series import LARGEST_ANGLE, cosine, sinc
from strapdown.kernels.smoother_loop import (
    ATTITUDE,
    BIAS,
    COVARIANCE,
    COVARIANCE_ROW,
    ERRORS,
    GROUP,
    GROUPS,
    JACOBIAN,
    MATRICES,
    MOVED,
    NOISE,
    ROW,
    TURN,
    load_matrix,
    load_triple,
    move_states,
    prepare_gains,
    prepare_rows,
    prepare_shares,
    prepare_turns,
    start_covariance,
    store_triple,
    write_filtered,
    write_smoothed,
)

# Places in the work space, from where the prepared groups of one pass begin.
ERROR = GROUPS
"""(ε, β), a pass a lane."""
PASSES = ERROR + 6 * WIDTH
"""P_s, of which the upper triangle by rows, a pass a lane."""
PRODUCT = PASSES + 21 * WIDTH
"""P_s Gᵀ."""
RESULT = PRODUCT + 36 * WIDTH
"""A group of which only the states are used: those that are moved to the smoothed ones."""
PREPARED = RESULT + GROUP
"""From here on prepared groups, each followed by its number."""
PREPARED_ROW = GROUP + WIDTH
_NOT_NEGATIVE = 2**62 - 1
_LANE = WIDTH - 1
_LARGEST_SQUARE = LARGEST_ANGLE * LARGEST_ANGLE


def lag_work_size(groups):
    """Return the numbers of work space for so many prepared groups, with room to begin at a cache line."""
    return PREPARED + PREPARED_ROW * groups + WIDTH


def join_pass(work, lane, segments, s):
    """Put a lane's error to zero and its covariance to the filter's at ``segments[s]``."""
    lane &= _LANE
    for c in range(6):
        work[ERROR + WIDTH * c + lane] = 0.0
    start_covariance(work, COVARIANCE + COVARIANCE_ROW * lane, segments, s)
    place = PASSES + lane
    for i in range(6):
        for j in range(i, 6):
            work[place] = work[COVARIANCE + COVARIANCE_ROW * lane + WIDTH * i + j]
            place += WIDTH


def leave_pass(work, lane, segments, s):
    """Keep a lane's error and covariance, and the filter's state at ``segments[s]``, as :func:`move_states` takes them."""
    lane &= _LANE
    for c in range(6):
        work[ERRORS + WIDTH * lane + c] = work[ERROR + WIDTH * c + lane]
    place = PASSES + lane
    for i in range(6):
        for j in range(i, 6):
            work[COVARIANCE + COVARIANCE_ROW * lane + WIDTH * i + j] = work[place]
            place += WIDTH
    for c in range(4):
        work[RESULT + ATTITUDE + WIDTH * c + lane] = segments[s + c]
    for c in range(3):
        work[RESULT + BIAS + WIDTH * c + lane] = segments[s + 4 + c]


def see_update(work, row, how):
    """Take errors and covariances from the state at the end of a segment to what the filter predicted of it: a, d and J P_s Jᵀ."""
    w = WIDTH
    row &= _NOT_NEGATIVE
    t = row + TURN
    e = load_triple(work, ERROR)
    x = dot(e, e)
    if how > 1.5 or anywhere(x > _LARGEST_SQUARE):
        r = (work[t + 1], work[t + 2], work[t + 3], work[t + 4])
        for i in range(w):
            p = ERROR + i
            one = (work[p], work[p + w], work[p + 2 * w])
            other = composed(r, one)
            _, to_end = moved((1.0, 0.0, 0.0, 0.0), one)
            between = multiply(inverse_right_jacobian(other), to_end)
            for c in range(9):
                work[JACOBIAN + w * c + i] = between[c]
            work[p], work[p + w], work[p + 2 * w] = other
        J = load_matrix(work, JACOBIAN)
    else:
        c = cosine(0.25 * x)
        h = 0.5 * sinc(0.25 * x)
        r0, r1, r2, r3 = work[t + 1], work[t + 2], work[t + 3], work[t + 4]
        v = (
            c * r1 + h * (r0 * e[0] + (r2 * e[2] - r3 * e[1])),
            c * r2 + h * (r0 * e[1] + (r3 * e[0] - r1 * e[2])),
            c * r3 + h * (r0 * e[2] + (r1 * e[1] - r2 * e[0])),
        )
        a = scale(2.0 * arcsine(dot(v, v)), v)
        store_triple(work, ERROR, a)
        J = multiply(near_inverse_right_jacobian(a), right_jacobian(e))
    for c in range(3):
        store(work, ERROR + w * (3 + c), load(work, ERROR + w * (3 + c)) + work[t + 5 + c])
    p = PASSES
    a0, a1, a2 = load_triple(work, p)
    a3, a4 = load(work, p + 6 * w), load(work, p + 7 * w)
    a5 = load(work, p + 11 * w)
    A = times_transpose_upper(multiply(J, full((a0, a1, a2, a3, a4, a5))), J)
    b0, b1, b2 = load_triple(work, p + 3 * w)
    b3, b4, b5 = load_triple(work, p + 8 * w)
    b6, b7, b8 = load_triple(work, p + 12 * w)
    B = multiply(J, (b0, b1, b2, b3, b4, b5, b6, b7, b8))
    store_triple(work, p, (A[0], A[1], A[2]))
    store_triple(work, p + 3 * w, (B[0], B[1], B[2]))
    store(work, p + 6 * w, A[3])
    store(work, p + 7 * w, A[4])
    store_triple(work, p + 8 * w, (B[3], B[4], B[5]))
    store(work, p + 11 * w, A[5])
    store_triple(work, p + 12 * w, (B[6], B[7], B[8]))


def gain_row(work, g):
    """Return the six numbers of the row of the gain that begins at g."""
    return (work[g], work[g + 6], work[g + 12], work[g + 18], work[g + 24], work[g + 30])


def six_products(g, v):
    """Return the sum of six products."""
    return g[0] * v[0] + g[1] * v[1] + g[2] * v[2] + g[3] * v[3] + g[4] * v[4] + g[5] * v[5]


def load_six(work, a, b, c, d, e, f):
    """Return six lanes, counted in lanes from the covariances on."""
    w = WIDTH
    p = PASSES
    return (
        load(work, p + w * a),
        load(work, p + w * b),
        load(work, p + w * c),
        load(work, p + w * d),
        load(work, p + w * e),
        load(work, p + w * f),
    )


def noisy_rows(work, row, i, place, noise):
    """Write rows i and i + 1 of G P_s Gᵀ + D, of which (i, i) stands at ``place``, its noise at ``noise``."""
    w = WIDTH
    z = PRODUCT + w * i
    one, two = gain_row(work, row + i), gain_row(work, row + i + 1)
    store(work, place, work[noise] + six_products(one, load_apart(work, z)))
    below, noise_below = place + w * (5 - i), noise + (5 - i)
    for j in range(1, 6 - i):
        column = load_apart(work, z + w * j)
        store(work, place + w * j, work[noise + j] + six_products(one, column))
        store(work, below + w * j, work[noise_below + j] + six_products(two, column))


def load_apart(work, z):
    """Return a column of P_s Gᵀ."""
    w = WIDTH
    return (
        load(work, z),
        load(work, z + 6 * w),
        load(work, z + 12 * w),
        load(work, z + 18 * w),
        load(work, z + 24 * w),
        load(work, z + 30 * w),
    )


def step_passes(work, row):
    """Take errors and covariances over one segment, whose matrices stand at ``row``: (ε, β) ← G (a, d), P_s ← G P_s Gᵀ + D.

    Reading takes longer than multiplying: each number that is read is used two or three times.
    """
    w = WIDTH
    row &= _NOT_NEGATIVE
    z = PRODUCT
    # Row r of P_s Gᵀ is G times row r of P_s.
    e0, e1, e2 = load_triple(work, ERROR)
    e3, e4, e5 = load_triple(work, ERROR + 3 * w)
    a = (e0, e1, e2, e3, e4, e5)
    b = load_six(work, 0, 1, 2, 3, 4, 5)
    c = load_six(work, 1, 6, 7, 8, 9, 10)
    for i in range(6):
        g = gain_row(work, row + i)
        store(work, ERROR + w * i, six_products(g, a))
        store(work, z + w * i, six_products(g, b))
        store(work, z + w * (6 + i), six_products(g, c))
    b = load_six(work, 2, 7, 11, 12, 13, 14)
    c = load_six(work, 3, 8, 12, 15, 16, 17)
    for i in range(6):
        g = gain_row(work, row + i)
        store(work, z + w * (12 + i), six_products(g, b))
        store(work, z + w * (18 + i), six_products(g, c))
    b = load_six(work, 4, 9, 13, 16, 18, 19)
    c = load_six(work, 5, 10, 14, 17, 19, 20)
    for i in range(6):
        g = gain_row(work, row + i)
        store(work, z + w * (24 + i), six_products(g, b))
        store(work, z + w * (30 + i), six_products(g, c))
    noisy_rows(work, row, 0, PASSES, row + NOISE)
    noisy_rows(work, row, 2, PASSES + 11 * w, row + NOISE + 11)
    noisy_rows(work, row, 4, PASSES + 18 * w, row + NOISE + 18)


def smooth_lagged(
    segments,
    starts,
    first,
    last,
    angle_variance,
    rate_variance,
    work,
    attitude_out,
    bias_out,
    variance_out,
    covariance_out,
):
    """Run backward passes, each of which writes one edge: pass p goes from the filtered state at edge ``last[p]`` to edge ``first[p]``.

    ``first`` rises from pass to pass, ``last`` does not fall. Arrays as for :func:`strapdown.kernels.smoother_loop.smooth_back`; ``work``
    has room for one prepared group or more (:func:`lag_work_size`), each of which is prepared once if all that eight passes meet fit.
    """
    w = WIDTH
    # From a cache line on, which vectors then do not cross. Not in a function, which may return no part of an array.
    work = work[-(work.ctypes.data // 8) % WIDTH :]
    lanes_of((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    for i in range(PREPARED):
        work[i] = 0.0
    room = (len(work) - PREPARED) // PREPARED_ROW
    for i in range(room):
        work[PREPARED + PREPARED_ROW * i + GROUP] = -1.0
    final = len(segments) // ROW - 1 - w  # the last group begins here, however many it shares with the one before
    for p in range(0, len(first), w):
        passes = min(w, len(first) - p)
        joining = passes - 1
        leaving = passes - 1
        s = starts[last[p + passes - 1]]
        while True:
            while joining >= 0 and starts[last[p + joining]] == s:
                join_pass(work, joining, segments, ROW * s + 11)
                joining -= 1
            while leaving >= 0 and starts[first[p + leaving]] == s:
                leave_pass(work, leaving, segments, ROW * s + 4)
                leaving -= 1
            if leaving < 0:
                break
            s -= 1
            number = s // w
            start = min(w * number, final)
            group = PREPARED + PREPARED_ROW * (number % room)
            if work[group + GROUP] != number:
                prepare_turns(segments, ROW * start, work, group)
                prepare_shares(segments, ROW * start, work, angle_variance, rate_variance)
                prepare_gains(work)
                prepare_rows(work, group)
                work[group + GROUP] = number
            i = s - start
            how = work[group + MOVED + i]
            if how > 0.5:
                see_update(work, group + MATRICES * i, how)
            step_passes(work, group + MATRICES * i)
        move_states(work, RESULT, ERRORS, len(covariance_out) > 0)
        for i in range(passes):
            k = first[p + i]
            if last[p + i] == k:
                write_filtered(segments, ROW * starts[k] + 4, k, attitude_out, bias_out, variance_out, covariance_out)
            else:
                write_smoothed(work, i, k, attitude_out, bias_out, variance_out, covariance_out)
