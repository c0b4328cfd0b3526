"""Joining eight stretches of a record at their seams, on small arrays: where each begins, and what the stretches behind it tell.

Stretch i stands in lane i of flat arrays of lanes (:mod:`strapdown.kernels.stretch_lanes`). ``work`` (8, 6, 6) is scratch.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import add, full, multiply, subtract, times_transpose_upper, transpose
from strapdown.kernels.augmented_step import IDENTITY
from strapdown.kernels.filter_loop import store_state
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.rotation import logarithm, quaternion_multiply, unit
from strapdown.kernels.smoother_loop import write_filtered
from strapdown.kernels.smoother_step import inverse_right_jacobian, moved, smooth
from strapdown.kernels.stretch_lanes import ETA, STATE
from strapdown.kernels.stretch_lanes import J as INFORMATION

CALLED = (
    "read_covariance",
    "write_covariance",
    "read_sensitivity",
    "write_sensitivity",
    "product",
    "times_left_block",
    "invert",
    "carry_adjoint",
)
"""Not inlined: here it is compiling that takes time."""
LEAST_LEFT = 1e-6
"""Of a filtered variance: where less is left when all is known, the difference of covariances keeps too few digits."""


def read_covariance(memory, place, lane, P):
    """Write the covariance (A, B, C) of a lane to a 6×6 array."""
    at = WIDTH * place + lane
    n = 0
    for i in range(3):
        for j in range(i, 3):
            P[i, j] = P[j, i] = memory[at + WIDTH * n]
            P[3 + i, 3 + j] = P[3 + j, 3 + i] = memory[at + WIDTH * (15 + n)]
            n += 1
        for j in range(3):
            P[i, 3 + j] = P[3 + j, i] = memory[at + WIDTH * (6 + 3 * i + j)]


def write_covariance(memory, place, lane, P):
    """Write what :func:`read_covariance` reads."""
    at = WIDTH * place + lane
    n = 0
    for i in range(3):
        for j in range(i, 3):
            memory[at + WIDTH * n] = 0.5 * (P[i, j] + P[j, i])
            memory[at + WIDTH * (15 + n)] = 0.5 * (P[3 + i, 3 + j] + P[3 + j, 3 + i])
            n += 1
        for j in range(3):
            memory[at + WIDTH * (6 + 3 * i + j)] = 0.5 * (P[i, 3 + j] + P[3 + j, i])


def read_sensitivity(sensitivity, lane, psi, J):
    """Write Ψ and J of a lane to 6×6 arrays."""
    n = WIDTH * INFORMATION + lane
    for i in range(6):
        for j in range(6):
            psi[i, j] = sensitivity[WIDTH * (6 * i + j) + lane]
        for j in range(i, 6):
            J[i, j] = J[j, i] = sensitivity[n]
            n += WIDTH


def write_sensitivity(sensitivity, lane, psi, J):
    """Write what :func:`read_sensitivity` reads."""
    n = WIDTH * INFORMATION + lane
    for i in range(6):
        for j in range(6):
            sensitivity[WIDTH * (6 * i + j) + lane] = psi[i, j]
        for j in range(i, 6):
            sensitivity[n] = 0.5 * (J[i, j] + J[j, i])
            n += WIDTH


def product(out, a, b):
    """Write a b."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += a[i, k] * b[k, j]
            out[i, j] = total


def times_left_block(out, M, a):
    """Write diag(M, I) a, M a 9-tuple."""
    for j in range(6):
        for i in range(3):
            out[i, j] = M[3 * i] * a[0, j] + M[3 * i + 1] * a[1, j] + M[3 * i + 2] * a[2, j]
            out[3 + i, j] = a[3 + i, j]


def invert(a, out):
    """Write the inverse of a, which is used up; return whether it has one. Gauss–Jordan with pivots of columns."""
    for i in range(6):
        for j in range(6):
            out[i, j] = 1.0 if i == j else 0.0
    for c in range(6):
        best = c
        for i in range(c + 1, 6):
            if abs(a[i, c]) > abs(a[best, c]):
                best = i
        if not abs(a[best, c]) > 0.0:
            return False
        for j in range(6):
            a[c, j], a[best, j] = a[best, j], a[c, j]
            out[c, j], out[best, j] = out[best, j], out[c, j]
        pivot = 1.0 / a[c, c]
        for j in range(6):
            a[c, j] *= pivot
            out[c, j] *= pivot
        for i in range(6):
            factor = a[i, c]
            if i != c and factor != 0.0:
                for j in range(6):
                    a[i, j] -= factor * a[c, j]
                    out[i, j] -= factor * out[c, j]
    return True


def whitened(P, difference, shift, factor):
    """Return the norms of L⁻¹ ``shift`` and of L⁻¹ ``difference`` L⁻ᵀ for L Lᵀ = P, the larger; infinity where P is not definite.

    That is how many σ a mean is off in the direction in which it is off most, and likewise of the covariance: entry by entry a difference
    may look small that is large along a direction in which much is known. P, ``difference`` and ``factor`` are used up.
    """
    for i in range(6):
        for j in range(i + 1):
            total = P[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 0.0:
                factor[i, i] = math.sqrt(total)
            else:
                return math.inf
    mean = 0.0
    for i in range(6):
        total = shift[i]
        for k in range(i):
            total -= factor[i, k] * P[k, 0]
        P[i, 0] = total / factor[i, i]
        mean += P[i, 0] * P[i, 0]
    for _ in range(2):  # L⁻¹ from the left, and with the transpose once more
        for c in range(6):
            for i in range(6):
                total = difference[i, c]
                for k in range(i):
                    total -= factor[i, k] * difference[k, c]
                difference[i, c] = total / factor[i, i]
        for i in range(6):
            for c in range(i):
                difference[i, c], difference[c, i] = difference[c, i], difference[i, c]
    spread = 0.0
    for i in range(6):
        for j in range(6):
            spread += difference[i, j] * difference[i, j]
    return math.sqrt(max(mean, spread)) if mean + spread < math.inf else math.inf


def lane_attitude(memory, place, lane):
    """Return the quaternion of a lane."""
    at = WIDTH * place + lane
    return (memory[at], memory[at + WIDTH], memory[at + 2 * WIDTH], memory[at + 3 * WIDTH])


def lane_vector(memory, place, lane):
    """Return a 3-vector of a lane."""
    at = WIDTH * place + lane
    return (memory[at], memory[at + WIDTH], memory[at + 2 * WIDTH])


def row_times(a, i, v):
    """Return row i of a times v (6,)."""
    return (a[i, 0] * v[0] + a[i, 1] * v[1] + a[i, 2] * v[2]) + (a[i, 3] * v[3] + a[i, 4] * v[4] + a[i, 5] * v[5])


def times(a, v):
    """Return a v (6,)."""
    return (
        row_times(a, 0, v),
        row_times(a, 1, v),
        row_times(a, 2, v),
        row_times(a, 3, v),
        row_times(a, 4, v),
        row_times(a, 5, v),
    )


def six(a, b):
    """Return two 3-vectors as one row of six."""
    return (a[0], a[1], a[2], b[0], b[1], b[2])


def add_six(a, b):
    """Return a + b of two rows of six."""
    return six(add((a[0], a[1], a[2]), (b[0], b[1], b[2])), add((a[3], a[4], a[5]), (b[3], b[4], b[5])))


def subtract_six(a, b):
    """Return a − b of two rows of six."""
    return six(subtract((a[0], a[1], a[2]), (b[0], b[1], b[2])), subtract((a[3], a[4], a[5]), (b[3], b[4], b[5])))


def join_starts(base, ends, sensitivity, starts, work):
    """Write to ``starts`` where each stretch begins, from runs that began at ``base`` and came to ``ends``.

    Stretch 0 begins where it did. The sensitivities are taken over to the new starts. Returns the largest move of a start
    (:func:`whitened`); infinity where a stretch's end cannot be told from its start.
    """
    psi, J, P, inverse, a, c, difference, moved_by = (
        work[0],
        work[1],
        work[2],
        work[3],
        work[4],
        work[5],
        work[6],
        work[7],
    )
    for i in range(STATE):
        starts[WIDTH * i] = base[WIDTH * i]
    largest = 0.0
    for k in range(WIDTH):
        read_sensitivity(sensitivity, k, psi, J)
        eta = six(lane_vector(sensitivity, ETA, k), lane_vector(sensitivity, ETA + 3, k))
        q = lane_attitude(base, 0, k)
        b = lane_vector(base, 4, k)
        start_b = lane_vector(starts, 4, k)
        turn = quaternion_multiply((q[0], -q[1], -q[2], -q[3]), lane_attitude(starts, 0, k))
        angle = logarithm(turn)
        d = six(angle, (start_b[0] - b[0], start_b[1] - b[1], start_b[2] - b[2]))
        T = inverse_right_jacobian(angle)
        # ΔP, both seen from the base's attitude.
        read_covariance(starts, 7, k, P)
        times_left_block(a, T, P)
        times_left_block(c.T, T, a.T)
        read_covariance(base, 7, k, a)
        for i in range(6):
            for j in range(6):
                difference[i, j] = moved_by[i, j] = c[i, j] - a[i, j]
        move = whitened(P, moved_by, d, c)
        if not move < math.inf:
            return math.inf
        largest = max(largest, move)
        product(a, difference, J)
        for i in range(6):
            a[i, i] += 1.0
        if not invert(a, inverse):
            return math.inf
        if k < WIDTH - 1:
            step = times(psi, times(inverse, add_six(d, times(difference, eta))))
            product(a, inverse, difference)
            product(c, psi, a)
            product(a, c, psi.T)
            read_covariance(ends, 7, k, c)
            for i in range(6):
                for j in range(6):
                    a[i, j] += c[i, j]
            end_q, G = moved(lane_attitude(ends, 0, k), (step[0], step[1], step[2]))
            # A quaternion and its negative are one attitude; from a bundle of more than half a turn came the other one.
            end_q = unit(quaternion_multiply((math.copysign(1.0, turn[0]), 0.0, 0.0, 0.0), end_q))
            times_left_block(c, G, a)
            times_left_block(moved_by.T, G, c.T)
            for i in range(4):
                starts[WIDTH * i + k + 1] = end_q[i]
            for i in range(3):
                starts[WIDTH * (4 + i) + k + 1] = ends[WIDTH * (4 + i) + k] + step[3 + i]
            write_covariance(starts, 7, k + 1, moved_by)
            for i in range(6):
                if not moved_by[i, i] > 0.0:
                    return math.inf
        else:
            G = IDENTITY  # what is behind the last stretch is not asked for
        product(a, psi, inverse)
        times_left_block(psi, G, a)
        # Ψ, J and η of a run from the new start, in its tangent space.
        v = times(inverse.T, subtract_six(eta, times(J, d)))
        product(a, J, inverse)
        back = transpose(T)
        times_left_block(c.T, back, psi.T)
        times_left_block(psi.T, back, a.T)
        times_left_block(a, back, psi)
        write_sensitivity(sensitivity, k, c, a)
        for i in range(3):
            sensitivity[WIDTH * (ETA + i) + k] = T[i] * v[0] + T[3 + i] * v[1] + T[6 + i] * v[2]
            sensitivity[WIDTH * (ETA + 3 + i) + k] = v[3 + i]
    return largest


def join_ends(ends, sensitivity, adjoints, smoothed, work):
    """Write the smoothed error of each stretch's end and its covariance (27 places); return whether enough digits are left.

    By Bryson & Frazier's adjoint variables (Bierman 1977, ch. X): with λ and Λ at an end, λ ← η + Ψᵀ λ and Λ ← J + Ψᵀ Λ Ψ over the stretch
    behind it, the error is P λ, its covariance P − P Λ P. ``adjoints`` (lanes, 6, 7) gets Λ and λ at the start of each stretch.
    """
    psi, J, P, a, c = work[0], work[1], work[2], work[3], work[4]
    last = WIDTH - 1
    for i in range(6):
        smoothed[WIDTH * i + last] = 0.0
    for i in range(21):
        smoothed[WIDTH * (6 + i) + last] = ends[WIDTH * (7 + i) + last]
    for k in range(last, 0, -1):
        read_sensitivity(sensitivity, k, psi, J)
        carry_adjoint(psi, adjoints, k, a, c)
        for i in range(6):
            adjoints[k, i, 6] += sensitivity[WIDTH * (ETA + i) + k]
            for j in range(6):
                adjoints[k, i, j] += J[i, j]
        read_covariance(ends, 7, k - 1, P)
        product(a, P, adjoints[k])
        product(c, a, P)
        for i in range(6):
            total = 0.0
            for j in range(6):
                total += P[i, j] * adjoints[k, j, 6]
                a[i, j] = P[i, j] - c[i, j]
            smoothed[WIDTH * i + k - 1] = total
            if not a[i, i] > LEAST_LEFT * P[i, i]:
                return False
        write_covariance(smoothed, 6, k - 1, a)
    return True


def carry_adjoint(psi, adjoints, k, a, c):
    """Write Ψᵀ Λ Ψ and Ψᵀ λ of the seam behind stretch k to that before it; behind the last there is nothing."""
    if k == WIDTH - 1:
        for i in range(6):
            for j in range(7):
                adjoints[k, i, j] = 0.0
        return
    product(a, psi.T, adjoints[k + 1])
    product(c, a, psi)
    for i in range(6):
        total = 0.0
        for j in range(6):
            total += psi[j, i] * adjoints[k + 1, j, 6]
            adjoints[k, i, j] = 0.5 * (c[i, j] + c[j, i])
        adjoints[k, i, 6] = total


def match_ends(ends, sensitivity, adjoints, assumed, found, work):
    """Take the seams that :func:`join_ends` ``assumed`` to what the smoother ``found`` at the starts (27 places each).

    J and η of each stretch become those that tell of its start what was found there, so that joined again the seams are better by as
    much as Ψ is good. Returns the largest difference over the seams (:func:`whitened`); infinity where a covariance has no inverse.
    """
    psi, J, P, inverse, a, c = work[0], work[1], work[2], work[3], work[4], work[5]
    largest = 0.0
    for k in range(1, WIDTH):
        read_covariance(assumed, 6, k - 1, a)
        read_covariance(found, 6, k, P)
        for i in range(6):
            for j in range(6):
                a[i, j] -= P[i, j]
        before = six(lane_vector(assumed, 0, k - 1), lane_vector(assumed, 3, k - 1))
        after = six(lane_vector(found, 0, k), lane_vector(found, 3, k))
        off = whitened(P, a, subtract_six(after, before), c)
        if not off < math.inf:
            return math.inf
        largest = max(largest, off)
    for k in range(1, WIDTH):
        # Λ = P⁻¹ − P⁻¹ P_s P⁻¹ and λ = P⁻¹ ε at the start, as found.
        read_covariance(ends, 7, k - 1, c)
        if not invert(c, inverse):
            return math.inf
        read_covariance(found, 6, k, P)
        product(a, inverse, P)
        product(c, a, inverse)
        read_sensitivity(sensitivity, k, psi, J)
        for i in range(6):
            total = 0.0
            for j in range(6):
                J[i, j] = inverse[i, j] - c[i, j]
                total += inverse[i, j] * found[WIDTH * j + k]
            P[0, i] = total
        carry_adjoint(psi, adjoints, k, a, c)
        for i in range(6):
            sensitivity[WIDTH * (ETA + i) + k] = P[0, i] - adjoints[k, i, 6]
            for j in range(6):
                J[i, j] -= adjoints[k, i, j]
        write_sensitivity(sensitivity, k, psi, J)
    return largest


def smooth_before(
    segments, state, smoothed, angle_variance, rate_variance, attitude_out, bias_out, variance_out, covariance_out
):
    """Smooth the intervals before the first stretch, whose filtered ``state`` (28,) has the smoothed error of lane 0; write their rows.

    ``segments`` (intervals, 32) are those that :func:`strapdown.kernels.filter_loop.run_filter` kept. Returns nothing; ``state`` is left at
    the smoothed one of the first row.
    """
    e = lane_vector(smoothed, 0, 0)
    beta = lane_vector(smoothed, 3, 0)
    q, M = moved((state[0], state[1], state[2], state[3]), e)
    b = (state[4] + beta[0], state[5] + beta[1], state[6] + beta[2])
    a0, a1 = lane_vector(smoothed, 6, 0), lane_vector(smoothed, 9, 0)
    b0, b1, b2 = lane_vector(smoothed, 12, 0), lane_vector(smoothed, 15, 0), lane_vector(smoothed, 18, 0)
    A = six(a0, a1)
    B = (b0[0], b0[1], b0[2], b1[0], b1[1], b1[2], b2[0], b2[1], b2[2])
    C = six(lane_vector(smoothed, 21, 0), lane_vector(smoothed, 24, 0))
    A, B = times_transpose_upper(multiply(M, full(A)), M), multiply(M, B)
    for k in range(len(segments) - 1, -1, -1):
        s = segments[k]
        q, b, A, B, C = smooth(
            (s[4], s[5], s[6], s[7]),
            (s[8], s[9], s[10]),
            (s[11], s[12], s[13], s[14], s[15], s[16]),
            (s[17], s[18], s[19], s[20], s[21], s[22], s[23], s[24], s[25]),
            (s[26], s[27], s[28], s[29], s[30], s[31]),
            (s[1], s[2], s[3]),
            s[0],
            angle_variance,
            rate_variance,
            q,
            b,
            A,
            B,
            C,
        )
        store_state(state, q, b, A, B, C)
        write_filtered(state, 0, k, attitude_out, bias_out, variance_out, covariance_out)
