"""The filter over a stretch of a record with its covariance in a triangular factor: where the covariance itself would lose its digits.

A factor's numbers are square roots, so that a correlation of 1 − 1e-20 is still one to a digit. It costs some twenty times as much as
:func:`strapdown.kernels.filter_loop.run_filter`, which is left for it only where it must be.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import add, combine, dot, scale, transpose_times_vector
from strapdown.kernels.augmented_factor import take_row, triangularise
from strapdown.kernels.augmented_step import carry, fill_noise, turn_rows
from strapdown.kernels.filter_loop import ATTITUDE, HEADING, MOST_TURN, VECTOR, heading_error, vector_at
from strapdown.kernels.filter_step import direction_rows, far_turn, heading_row, shows_heading, transition
from strapdown.kernels.rotation import (
    exponential,
    logarithm,
    quaternion_multiply,
    right_jacobian,
    rotation_matrix,
    turned,
    unit,
)
from strapdown.kernels.series import LARGEST_ANGLE

NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
SHRUNK = 1.0 - 1e-14
"""Correlations are told times this: rounding could make the covariance of one nearer to 1 indefinite."""


def store_covariance(F, out, row):
    """Write the blocks of ``Fᵀ F`` to a row of 21 numbers."""
    place = 0
    for block in range(3):
        for a in range(3):
            for b in range(0 if block == 1 else a, 3):
                i = a + 3 * (block == 2)
                j = b + 3 * (block > 0)
                total = 0.0
                for r in range(max(i, j), 6):
                    total += F[r, i] * F[r, j]
                out[row, place] = total if i == j else SHRUNK * total
                place += 1


def run_factored(
    edges,
    increments,
    angle_variance,
    rate_variance,
    time,
    kinds,
    value,
    variance,
    references,
    triads,
    state,
    F,
    scratch,
    every,
    attitude_out,
    bias_out,
    variance_out,
    covariance_out,
    innovation_out,
):
    """Run the filter over a stretch of a record as :func:`strapdown.kernels.filter_loop.run_filter` does.

    Events stand in order of time, with the code of each in ``kinds`` and the row of ``triads`` in ``references``. ``state`` (7,) holds
    (q, b), and the first six rows of ``F`` (12, 6) the lower triangle with ``P = Fᵀ F``; both are left at the end state. ``scratch`` holds
    (6,), (3, 6), (6,), and the four empty arrays of a filter without further states.
    """
    work, H, correction, decay, coupling, gyro, use = scratch
    q = (state[0], state[1], state[2], state[3])
    b = (state[4], state[5], state[6])
    events = len(time)
    e = 0
    k = -1
    now = edges[0]
    end = now
    whole = 1.0
    theta = (0.0, 0.0, 0.0)
    countdown = 0
    row = 0
    while k < len(increments):
        due = e < events and time[e] <= end
        stop = time[e] if due else end
        dt = stop - now
        if dt > 0.0:
            part = theta if dt == whole else scale(dt / whole, theta)
            turn = combine(1.0, part, -dt, b)
            squared = dot(turn, turn)
            if LARGEST_ANGLE * LARGEST_ANGLE < squared < MOST_TURN * MOST_TURN:
                share = LARGEST_ANGLE / squared**0.5
                dt = share * dt
                turn = scale(share, turn)
                stop = now + dt
                due = False
            phi11, phi12 = transition(turn, dt)
            carry(F, 0, 6, phi11, phi12, coupling, decay, use, 0)
            if angle_variance > 0.0 or rate_variance > 0.0:
                rate = scale(1.0 / dt, turn)
                rows = fill_noise(F, 6, 6, dt, rate, NOTHING, angle_variance, rate_variance, decay, decay, gyro, use)
                triangularise(F, 6, 3, 6, rows, 0, 0, work)
            else:
                triangularise(F, 3, 3, 6, 6, 0, 0, work)
            q = turned(q, turn)
            now = stop
        if due:
            R = rotation_matrix(q)
            t = references[e]
            kind = kinds[e]
            z = vector_at(value, e)
            for r in range(3):
                for i in range(6):
                    H[r, i] = 0.0
            s = (variance[e], variance[e], variance[e])
            rows = 2
            y = (0.0, 0.0, 0.0)
            if kind == ATTITUDE:
                measured = (triads[t, 0], triads[t, 1], triads[t, 2], triads[t, 3])
                y = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), measured))
                for r in range(3):
                    H[r, r] = 1.0
                s = z
                rows = 3
            elif kind == HEADING:
                y = (heading_error(R, z, (triads[t, 6], triads[t, 7], triads[t, 8])), 0.0, 0.0)
                H[0, 0], H[0, 1], H[0, 2] = heading_row(R, z)
                rows = 1
                innovation_out[e, 2] = 0.0
                innovation_out[e, 3] = 1.0
            else:
                u = (triads[t, 0], triads[t, 1], triads[t, 2])
                v = (triads[t, 3], triads[t, 4], triads[t, 5])
                h1, y1, h2, y2 = direction_rows(R, u, v, z)
                H[0, 0], H[0, 1], H[0, 2] = h1
                H[1, 0], H[1, 1], H[1, 2] = h2
                y = (y1, y2, 0.0)
                if kind == VECTOR:
                    reference = (triads[t, 6], triads[t, 7], triads[t, 8])
                    innovation_out[e, 4] = dot(transpose_times_vector(R, reference), z) - 1.0
                    innovation_out[e, 5] = variance[e]
            for i in range(6):
                correction[i] = 0.0
            for r in range(rows):
                error = y[r] - H[r, 0] * correction[0] - H[r, 1] * correction[1] - H[r, 2] * correction[2]
                spread = take_row(F, 6, H, r, s[r], work)
                for i in range(6):
                    correction[i] += error / spread * work[i]
                innovation_out[e, 2 * r] = error
                innovation_out[e, 2 * r + 1] = spread
            if kind == HEADING and not shows_heading(R, z):
                innovation_out[e, 0] = math.nan  # skipped: its row is zero
            a = (correction[0], correction[1], correction[2])
            b = add(b, (correction[3], correction[4], correction[5]))
            if dot(a, a) > 1.0:
                far, G = far_turn(a)
                q = unit(quaternion_multiply(q, far))
            else:
                G = right_jacobian(a)
                q = unit(quaternion_multiply(q, exponential(a)))
            turn_rows(F, 6, G)
            triangularise(F, 3, 3, 6, 6, 0, 0, work)
            e += 1
        if now >= end and (e == events or time[e] > end):
            if countdown == 0:
                countdown = every
                attitude_out[row, 0], attitude_out[row, 1], attitude_out[row, 2], attitude_out[row, 3] = q
                bias_out[row, 0], bias_out[row, 1], bias_out[row, 2] = b
                for i in range(6):
                    total = 0.0
                    for r in range(i, 6):
                        total += F[r, i] * F[r, i]
                    variance_out[row, i] = total
                if row < len(covariance_out):
                    store_covariance(F, covariance_out, row)
                row += 1
            countdown -= 1
            k += 1
            if k < len(increments):
                end = edges[k + 1]
                whole = end - now
                theta = vector_at(increments, k)
    state[0], state[1], state[2], state[3] = q
    state[4], state[5], state[6] = b
