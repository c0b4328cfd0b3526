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
    SIX,
    TURN,
    move_states,
    prepare_gains,
    prepare_rows,
    prepare_shares,
    prepare_turns,
    start_covariance,
    write_filtered,
    write_smoothed,
)
from strapdown.kernels.state import load_matrix, load_triple, store_several

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
        store_several(work, ERROR, a)
        J = multiply(near_inverse_right_jacobian(a), right_jacobian(e))
    for c in range(3):
        store(work, ERROR + w * (3 + c), load(work, ERROR + w * (3 + c)) + work[t + 5 + c])
    turn_passes(work, J)


def turn_passes(work, J):
    """Carry the attitude's part of the covariances by J."""
    n = tuple(load(work, PASSES + WIDTH * i) for i in range(15))
    A = times_transpose_upper(multiply(J, full((*n[:3], *n[6:8], n[11]))), J)
    B = multiply(J, (*n[3:6], *n[8:11], *n[12:]))
    store_several(work, PASSES, (*A[:3], *B[:3], *A[3:5], *B[3:6], A[5], *B[6:]))


def six_products(g, v):
    """Return the sum of six products."""
    return g[0] * v[0] + g[1] * v[1] + g[2] * v[2] + g[3] * v[3] + g[4] * v[4] + g[5] * v[5]


def upper_place(i, j):
    """Return the place of entry (i, j) in the upper triangle by rows."""
    return min(i, j) * (11 - min(i, j)) // 2 + max(i, j)


def gain_row(work, g):
    """Return the six numbers of the row of the gain that begins at g."""
    return tuple(work[g + 6 * j] for j in SIX)


def load_six(work, start, places):
    """Return six lanes, counted in lanes from a start."""
    return tuple(load(work, start + WIDTH * i) for i in places)


def step_passes(work, row):
    """Take errors and covariances over one segment, whose matrices stand at ``row``: (ε, β) ← G (a, d), P_s ← G P_s Gᵀ + D.

    Reading takes longer than multiplying: each number that is read is used two or three times.
    """
    row &= _NOT_NEGATIVE
    error = load_six(work, ERROR, SIX)
    for r in (0, 2, 4):
        # Rows r and r + 1 of P_s Gᵀ are G times those of P_s.
        one, two = (load_six(work, PASSES, tuple(upper_place(k, j) for j in SIX)) for k in (r, r + 1))
        for i in SIX:
            g = gain_row(work, row + i)
            if r == 0:
                store(work, ERROR + WIDTH * i, six_products(g, error))
            store(work, PRODUCT + WIDTH * (6 * r + i), six_products(g, one))
            store(work, PRODUCT + WIDTH * (6 * r + 6 + i), six_products(g, two))
    for i in (0, 2, 4):
        rows = [(k, gain_row(work, row + k)) for k in (i, i + 1)]
        for j in SIX[i:]:
            column = load_six(work, PRODUCT, tuple(6 * r + j for r in SIX))
            for k, g in rows[: j - i + 1]:
                place = upper_place(k, j)
                store(work, PASSES + WIDTH * place, work[row + NOISE + place] + six_products(g, column))


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
