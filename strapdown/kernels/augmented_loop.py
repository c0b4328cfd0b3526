"""The MEKF with optional states over one whole record. Compiled by :func:`strapdown.kernels.machine.compiled`."""

from __future__ import annotations

import math

from strapdown.kernels.algebra import combine, dot, scale
from strapdown.kernels.augmented_chain import step_chains
from strapdown.kernels.augmented_factor import covariances, take_row, triangularise, variances, whole_bias
from strapdown.kernels.augmented_step import (
    OFFSET,
    arm_noise,
    carry,
    decorrelate,
    fill_noise,
    fill_rows,
    fixed_turn,
    longest_step,
    move,
    turn_columns,
    turn_rows,
    turn_values,
    turning_matrix,
)
from strapdown.kernels.filter_loop import ATTITUDE, DIRECTION, HEADING, vector_at
from strapdown.kernels.filter_step import far_turn
from strapdown.kernels.robust_loop import frame_at, six_at
from strapdown.kernels.rotation import quaternion_multiply, right_jacobian, rotation_matrix, turned, unit

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""


def store_segment(out, k, dt, part, q, x, F, size):
    """Write row k of the segments: dt, increment (3), attitude (4), x, and the rows of the triangle."""
    out[k, 0] = dt
    out[k, 1], out[k, 2], out[k, 3] = part
    out[k, 4], out[k, 5], out[k, 6], out[k, 7] = q
    place = 8
    for i in range(len(x)):
        out[k, place + i] = x[i]
    place += len(x)
    for j in range(size):
        for i in range(j + 1):
            out[k, place + i] = F[j, i]
        place += j + 1


def store_row(
    q,
    x,
    F,
    size,
    gyro,
    gyro_use,
    row,
    attitude_out,
    x_out,
    variance_out,
    covariance_out,
    whole_variance_out,
    whole_covariance_out,
    six,
):
    """Write a state to a row of the outputs, of covariances and of the whole bias where there is room; ``six`` (6, 6) is scratch."""
    attitude_out[row, 0], attitude_out[row, 1], attitude_out[row, 2], attitude_out[row, 3] = q
    for i in range(len(x)):
        x_out[row, i] = x[i]
    variances(F, size, variance_out, row)
    if row < len(covariance_out):
        covariances(F, size, covariance_out, row)
    if row < len(whole_variance_out):
        whole_bias(F, size, gyro, gyro_use, OFFSET, whole_variance_out, whole_covariance_out, row, six)


def longest_common_step(dt, part, x, running, limit):
    """Return the longest step within an interval for ``running`` rows of states: cut where filter_loop cuts, and where they decay."""
    longest = dt
    for i in range(running):
        turn = combine(1.0, part, -dt, (x[i, 0], x[i, 1], x[i, 2]))
        longest = min(longest, longest_step(dt, turn, limit))
    return longest


def advance(
    q,
    x,
    F,
    size,
    noisy,
    changing,
    dt,
    part,
    angle_variance,
    rate_variance,
    decay,
    density,
    gyro,
    gyro_use,
    force_f,
    chains,
    links,
    coupling,
    factor,
    work,
):
    """Propagate a state over an increment ``part``, ``x`` and ``F`` in place; return q."""
    q, phi11, phi12, rate, D = move(q, x, dt, part, decay, gyro, gyro_use, force_f, coupling, factor)
    carry(F, 0, size, phi11, phi12, coupling, factor, gyro_use, changing)
    rows = fill_noise(F, size, size, dt, rate, D, angle_variance, rate_variance, decay, density, gyro, gyro_use)
    if len(chains) > 0:
        rows = step_chains(F, size, rows, x, dt, decay, chains, links)
    triangularise(F, noisy, 3, size, rows, 0, 0, work)
    return q


def run_augmented(
    edges,
    increments,
    angle_variance,
    rate_variance,
    decay,
    density,
    changing,
    limit,
    gyro,
    gyro_use,
    sensors,
    sensor_use,
    force_f,
    chains,
    links,
    event_time,
    event_kind,
    event_value,
    event_variance,
    event_noise,
    event_length,
    event_sensor,
    event_reference,
    event_turning,
    triads,
    attitude,
    x,
    F,
    scratch,
    every,
    attitude_out,
    x_out,
    variance_out,
    covariance_out,
    whole_variance_out,
    whole_covariance_out,
    innovation_out,
    segment_out,
):
    """Run the filter over a record; the splitting of intervals is that of :func:`strapdown.kernels.filter_loop.run_filter`.

    ``attitude`` (4,), ``x`` and the triangle at the top of ``F`` hold the state and are left at the end state; the rest of F takes the rows
    of noise. ``scratch`` holds arrays (states, 3), (states,), (3, size), (3,), (3,), (3, 3), (size,), one as wide as F and (6, 6).
    ``limit`` bounds a step by the states that decay. ``chains`` and its scratch ``links`` are those of
    :mod:`strapdown.kernels.augmented_chain`, empty where no state feeds another and none is carried. ``event_turning`` (events, 9) has the
    measured rate and the angular acceleration of each event, and the variances of the latter's axes, 0 for sensors without a lever arm. It
    may be empty, as ``event_noise``, the two covariances, ``whole_variance_out`` and ``segment_out`` may.
    Returns the number of segments stored.
    """
    size = len(x) + 3
    noisy = 6 + changing
    q = (attitude[0], attitude[1], attitude[2], attitude[3])
    coupling, factor, H, y, spread, basis, correction, work, six = scratch
    events = len(event_time)
    e = 0
    k = -1  # the interval before the first edge has no length; its end takes the events at the first edge
    now = edges[0]
    end = now
    whole = 1.0
    theta = (0.0, 0.0, 0.0)
    countdown = 0
    row = 0
    segments = 0
    while k < len(increments):
        due = e < events and event_time[e] <= end
        stop = event_time[e] if due else end
        dt = stop - now
        if dt > 0.0:
            part = theta
            if dt < whole:
                part = scale(dt / whole, theta)
            # Cut where filter_loop cuts, and where the states decay too far.
            turn = combine(1.0, part, -dt, (x[0], x[1], x[2]))
            longest = longest_step(dt, turn, limit)
            if longest < dt:
                share = longest / dt
                dt = longest
                part = scale(share, part)
                stop = now + dt
                due = False
            if segments < len(segment_out):
                store_segment(segment_out, segments, dt, part, q, x, F, size)
                segments += 1
            q = advance(
                q,
                x,
                F,
                size,
                noisy,
                changing,
                dt,
                part,
                angle_variance,
                rate_variance,
                decay,
                density,
                gyro,
                gyro_use,
                force_f,
                chains,
                links,
                coupling,
                factor,
                work,
            )
            now = stop
        if due:
            frame = frame_at(triads, event_reference[e])
            z = vector_at(event_value, e)
            R = rotation_matrix(q)
            s = event_sensor[e]
            kind = event_kind[e]
            W = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            if len(event_turning) > 0:
                turn = (event_turning[e, 0] - x[0], event_turning[e, 1] - x[1], event_turning[e, 2] - x[2])
                W = turning_matrix(turn, (event_turning[e, 3], event_turning[e, 4], event_turning[e, 5]))
            rows = fill_rows(q, R, x, kind, z, frame, event_length[e], s, sensors, sensor_use, W, H, y, basis)
            for r in range(rows):
                spread[r] = event_value[e, r] if kind == ATTITUDE else event_variance[e]
                if kind == DIRECTION:
                    spread[r] *= basis[r, 0] ** 2 + basis[r, 1] ** 2 + basis[r, 2] ** 2
            levered = len(event_turning) > 0 and event_turning[e, 6] > 0.0
            if levered or len(event_noise) > 0:
                C = (event_variance[e], 0.0, 0.0, event_variance[e], 0.0, event_variance[e])
                if len(event_noise) > 0:
                    C = six_at(event_noise, e)
                if levered:
                    noise = (event_turning[e, 6], event_turning[e, 7], event_turning[e, 8])
                    C = arm_noise(x, s, sensors, sensor_use, event_length[e], noise, C)
                decorrelate(H, y, rows, basis, C, spread)
            for i in range(size):
                correction[i] = 0.0
            for r in range(rows):
                error = y[r]
                for i in range(size):
                    error -= H[r, i] * correction[i]  # what the rows before it have corrected
                s2 = take_row(F, size, H, r, spread[r], work)
                for i in range(size):
                    correction[i] += error / s2 * work[i]
                innovation_out[e, 2 * r] = error
                innovation_out[e, 2 * r + 1] = s2
            if kind == HEADING and H[0, 0] == 0.0 and H[0, 1] == 0.0 and H[0, 2] == 0.0:
                innovation_out[e, 0] = math.nan  # of a vertical vector, which shows none: skipped
            a = (correction[0], correction[1], correction[2])
            before = q
            if dot(a, a) > 1.0:
                far, G = far_turn(a)
                q = unit(quaternion_multiply(q, far))
            else:
                G = right_jacobian(a)
                q = turned(q, a)
            for i in range(len(x)):
                x[i] += correction[3 + i]
            turn_rows(F, size, G)
            if len(chains) > 0:
                A = fixed_turn(before, q)
                turn_values(chains, A, x, 3)
                loose = turn_columns(chains, A, F, size)
                triangularise(F, loose, loose, size, size, 0, 0, work)
            else:
                triangularise(F, 3, 3, size, size, 0, 0, work)  # numbers known beforehand
            e += 1
        if now >= end and (e == events or event_time[e] > end):
            if countdown == 0:
                countdown = every
                store_row(
                    q,
                    x,
                    F,
                    size,
                    gyro,
                    gyro_use,
                    row,
                    attitude_out,
                    x_out,
                    variance_out,
                    covariance_out,
                    whole_variance_out,
                    whole_covariance_out,
                    six,
                )
                row += 1
            countdown -= 1
            k += 1
            if k < len(increments):
                end = edges[k + 1]
                whole = end - now
                theta = vector_at(increments, k)
    attitude[0], attitude[1], attitude[2], attitude[3] = q
    return segments
