"""Covariance analysis over one trajectory: what each source of error, sent through the filter's own gains, makes of the estimate.

Everything is linear about the truth. The error state is that of the filter, (δθ, δb); a measurement enters as scalar rows
``y = h · δθ + v`` one after the other. A covariance is 21 numbers (blocks A, B, C), as the filter holds its own.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    add_matrices,
    combine,
    dot,
    full,
    matrix_times_vector,
    minus_outer,
    multiply,
    multiply_add,
    scale,
    symmetric_minus_outer,
    symmetric_times_vector,
    times_transpose_upper,
    times_transpose_upper_add,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.filter_step import process_noise, transition
from strapdown.kernels.measurement import vector_at


def load_blocks(row):
    """Return (A, B, C) of 21 numbers."""
    return (
        (row[0], row[1], row[2], row[3], row[4], row[5]),
        (row[6], row[7], row[8], row[9], row[10], row[11], row[12], row[13], row[14]),
        (row[15], row[16], row[17], row[18], row[19], row[20]),
    )


def store_blocks(row, A, B, C):
    """Write (A, B, C) as 21 numbers."""
    row[0], row[1], row[2], row[3], row[4], row[5] = A
    row[6], row[7], row[8], row[9], row[10], row[11], row[12], row[13], row[14] = B
    row[15], row[16], row[17], row[18], row[19], row[20] = C


def driven(phi, phi12, dt, angle, rate):
    """Return Q11, Q12, Q22 over a turn φ of white noise of densities ``angle`` and ``rate``, one an axis (rad²/s, rad²/s³).

    What the axes have in common is exact; what an axis has above the least is taken to act at the middle of the turn.
    """
    least_angle = min(angle[0], angle[1], angle[2])
    least_rate = min(rate[0], rate[1], rate[2])
    q11, q12, q22 = process_noise(phi, dt, least_angle, least_rate)
    C = (q22, 0.0, 0.0, q22, 0.0, q22)
    more_angle = (angle[0] - least_angle, angle[1] - least_angle, angle[2] - least_angle)
    more_rate = (rate[0] - least_rate, rate[1] - least_rate, rate[2] - least_rate)
    if max(more_angle[0] + more_rate[0], more_angle[1] + more_rate[1], more_angle[2] + more_rate[2]) > 0.0:
        for i in range(3):
            column = scale(-1.0 / dt, (phi12[i], phi12[3 + i], phi12[6 + i]))
            axis = (1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0)
            q11 = symmetric_minus_outer(q11, scale(-more_angle[i] * dt - more_rate[i] * dt**3 / 3.0, column), column)
            q12 = minus_outer(q12, scale(0.5 * dt * dt * more_rate[i], column), axis)
            C = symmetric_minus_outer(C, scale(-more_rate[i] * dt, axis), axis)
    return q11, q12, C


def carried(A, B, C, phi11, phi12):
    """Return the blocks of Φ Σ Φᵀ."""
    theta_bias = multiply_add(phi11, B, multiply(phi12, full(C)))
    theta_theta = multiply_add(phi11, full(A), multiply(phi12, transpose(B)))
    return (
        times_transpose_upper_add(theta_theta, phi11, times_transpose_upper(theta_bias, phi12)),
        theta_bias,
        C,
    )


def corrected(A, B, C, h, ka, kb, variance):
    """Return the blocks of (I − k h) Σ (I − k h)ᵀ + r k kᵀ, any gain k, and h Σ hᵀ."""
    pa = symmetric_times_vector(A, h)
    pb = transpose_times_vector(B, h)
    seen = dot(h, pa)
    half = -0.5 * (seen + variance)
    ma = combine(1.0, pa, half, ka)
    mb = combine(1.0, pb, half, kb)
    A = symmetric_minus_outer(symmetric_minus_outer(A, ka, ma), ma, ka)
    B = minus_outer(minus_outer(B, ka, mb), ma, kb)
    C = symmetric_minus_outer(symmetric_minus_outer(C, kb, mb), mb, kb)
    return A, B, C, seen


def shaped_rate(A, B, C, cross, gains, phi11, phi12, variance):
    """Return the blocks after a stretch with a coloured rate f on top, constant over it: Φ Σ Φᵀ + Φ F Γᵀ + Γ Fᵀ Φᵀ + Γ V Γᵀ, Γ = (Φ12, 0).

    ``cross`` (6, 3, n) is the covariance of the error and the states that make f, ``variance`` (3,) is V.
    """
    A, B, C = carried(A, B, C, phi11, phi12)
    for a in range(3):
        ft = (0.0, 0.0, 0.0)
        fb = (0.0, 0.0, 0.0)
        for n in range(len(gains)):
            ft = combine(1.0, ft, gains[n], (cross[0, a, n], cross[1, a, n], cross[2, a, n]))
            fb = combine(1.0, fb, gains[n], (cross[3, a, n], cross[4, a, n], cross[5, a, n]))
        column = (phi12[a], phi12[3 + a], phi12[6 + a])
        m = add(matrix_times_vector(phi11, ft), matrix_times_vector(phi12, fb))
        whole = combine(1.0, m, 0.5 * variance[a], column)
        A = symmetric_minus_outer(symmetric_minus_outer(A, scale(-1.0, whole), column), scale(-1.0, column), whole)
        B = minus_outer(B, scale(-1.0, column), fb)
    return A, B, C


def reported(A, B, C, cross, gains, poles, variance, edge_variance, first):
    """Return the blocks of (δθ, δb + f): the truth of the bias holds the coloured rate, at an edge the mean of both its intervals'."""
    for a in range(3):
        ft = (0.0, 0.0, 0.0)
        fb = (0.0, 0.0, 0.0)
        for n in range(len(gains)):
            weight = gains[n] * (1.0 if first else 0.5 * (1.0 + poles[n]))
            ft = combine(1.0, ft, weight, (cross[0, a, n], cross[1, a, n], cross[2, a, n]))
            fb = combine(1.0, fb, weight, (cross[3, a, n], cross[4, a, n], cross[5, a, n]))
        axis = (1.0 if a == 0 else 0.0, 1.0 if a == 1 else 0.0, 1.0 if a == 2 else 0.0)
        whole = combine(-1.0, fb, -0.5 * (variance[a] if first else edge_variance[a]), axis)
        B = minus_outer(B, scale(-1.0, ft), axis)
        C = symmetric_minus_outer(symmetric_minus_outer(C, whole, axis), axis, whole)
    return A, B, C


def run_covariance(
    dt,
    phi,
    new_sample,
    row_bounds,
    row_h,
    row_noise,
    row_filter_variance,
    row_variance,
    row_sensor,
    row_time,
    row_error,
    angle_density,
    rate_density,
    source_sensor,
    blocks,
    shape_amplitude,
    shape_gains,
    shape_poles,
    shape_states,
    shape_cross,
    shape_source,
    noise_sensor,
    noise_sigma,
    noise_time,
    noise_cross,
    noise_source,
    noise_seen,
    column_rate,
    rate_place,
    column_ramp,
    fixed,
    columns,
    stations,
    blocks_out,
    columns_out,
    nis,
):
    """Send every source through the filter's gains; write its covariance at the wanted stations.

    Station j lies after j segments of ``dt``, ``phi``; its rows are ``row_bounds[j]`` to ``row_bounds[j + 1]``. ``blocks`` (1 + s, 21)
    holds the filter's own P first, then a covariance a source: white ones of densities ``angle_density``, ``rate_density`` (1 + s, 3) or
    of the rows of ``source_sensor``; coloured ones, which have a place in ``blocks`` too, ``shape_…`` in the gyro, ``noise_…`` in sensors.
    ``columns`` (k, 6) are errors without noise: column k comes in as the rate ``column_rate[:, rate_place[k]]`` of each segment (−1: none),
    with ``row_error`` (rows, k) in the rows, and with ``column_ramp`` (k, 3) as a bias that grows. The first ``fixed`` are the same in
    every run, the others have unit variance. ``nis`` (sensors, 2) gets the sums of the expected squares of
    normalised innovations, and their number.
    """
    sources = len(blocks)
    shapes = len(shape_source)
    coloured = len(noise_source)
    number = len(columns)
    wanted = 0
    for j in range(len(dt) + 1):
        if j > 0:
            i = j - 1
            turn = vector_at(phi, i)
            step = dt[i]
            phi11, phi12 = transition(turn, step)
            for s in range(sources):
                A, B, C = load_blocks(blocks[s])
                shape = -1
                for c in range(shapes):
                    if shape_source[c] == s:
                        shape = c
                if shape >= 0:
                    gains = shape_gains[shape]
                    poles = shape_poles[shape]
                    states = shape_states[shape]
                    cross = shape_cross[shape]
                    amplitude = vector_at(shape_amplitude, shape)
                    if new_sample[i]:
                        for r in range(6):
                            for a in range(3):
                                for n in range(len(gains)):
                                    cross[r, a, n] *= poles[n]
                    unit_variance = 0.0
                    for n in range(len(gains)):
                        unit_variance += gains[n] * states[n]
                    variance = (
                        amplitude[0] * amplitude[0] * unit_variance,
                        amplitude[1] * amplitude[1] * unit_variance,
                        amplitude[2] * amplitude[2] * unit_variance,
                    )
                    A, B, C = shaped_rate(A, B, C, cross, gains, phi11, phi12, variance)
                    for a in range(3):
                        for n in range(len(gains)):
                            t = (cross[0, a, n], cross[1, a, n], cross[2, a, n])
                            b = (cross[3, a, n], cross[4, a, n], cross[5, a, n])
                            t = add(matrix_times_vector(phi11, t), matrix_times_vector(phi12, b))
                            drive = amplitude[a] * amplitude[a] * states[n]
                            cross[0, a, n] = t[0] + phi12[a] * drive
                            cross[1, a, n] = t[1] + phi12[3 + a] * drive
                            cross[2, a, n] = t[2] + phi12[6 + a] * drive
                else:
                    A, B, C = carried(A, B, C, phi11, phi12)
                    angle = vector_at(angle_density, s)
                    rate = vector_at(rate_density, s)
                    if angle[0] + angle[1] + angle[2] + rate[0] + rate[1] + rate[2] > 0.0:
                        q11, q12, q22 = driven(turn, phi12, step, angle, rate)
                        A = (A[0] + q11[0], A[1] + q11[1], A[2] + q11[2], A[3] + q11[3], A[4] + q11[4], A[5] + q11[5])
                        B = add_matrices(B, q12)
                        C = (C[0] + q22[0], C[1] + q22[1], C[2] + q22[2], C[3] + q22[3], C[4] + q22[4], C[5] + q22[5])
                store_blocks(blocks[s], A, B, C)
            for c in range(coloured):
                for a in range(3):
                    t = (noise_cross[c, 0, a], noise_cross[c, 1, a], noise_cross[c, 2, a])
                    b = (noise_cross[c, 3, a], noise_cross[c, 4, a], noise_cross[c, 5, a])
                    t = add(matrix_times_vector(phi11, t), matrix_times_vector(phi12, b))
                    noise_cross[c, 0, a], noise_cross[c, 1, a], noise_cross[c, 2, a] = t
            for k in range(number):
                t = (columns[k, 0], columns[k, 1], columns[k, 2])
                b = (columns[k, 3], columns[k, 4], columns[k, 5])
                ramp = vector_at(column_ramp, k)
                held = combine(1.0, b, 0.5 * step, ramp)
                r = rate_place[k]
                if r >= 0:
                    held = add(held, (column_rate[i, r, 0], column_rate[i, r, 1], column_rate[i, r, 2]))
                t = add(matrix_times_vector(phi11, t), matrix_times_vector(phi12, held))
                b = combine(1.0, b, step, ramp)
                columns[k, 0], columns[k, 1], columns[k, 2] = t
                columns[k, 3], columns[k, 4], columns[k, 5] = b
        for e in range(row_bounds[j], row_bounds[j + 1]):
            h = vector_at(row_h, e)
            A, B, C = load_blocks(blocks[0])
            pa = symmetric_times_vector(A, h)
            innovation = dot(h, pa) + row_filter_variance[e]
            ka = scale(1.0 / innovation, pa)
            kb = scale(1.0 / innovation, transpose_times_vector(B, h))
            A, B, C, _ = corrected(A, B, C, h, ka, kb, row_filter_variance[e])
            store_blocks(blocks[0], A, B, C)
            expected = row_variance[e]
            for s in range(1, sources):
                A, B, C = load_blocks(blocks[s])
                own = row_variance[e] if source_sensor[s] == row_sensor[e] else 0.0
                A, B, C, seen = corrected(A, B, C, h, ka, kb, own)
                expected += seen
                for c in range(coloured):
                    if noise_source[c] == s:
                        cross = noise_cross[c]
                        sigma = noise_sigma[c]
                        mine = noise_sensor[c] == row_sensor[e]
                        if mine:
                            decay = math.exp(-(row_time[e] - noise_seen[c]) / noise_time[c])
                            noise_seen[c] = row_time[e]
                            for r in range(6):
                                for a in range(3):
                                    cross[r, a] *= decay
                        weight = vector_at(row_noise, e) if mine else (0.0, 0.0, 0.0)
                        seen_cross = (0.0, 0.0, 0.0)
                        for r in range(3):
                            seen_cross = combine(1.0, seen_cross, h[r], vector_at(cross, r))
                        for r in range(6):
                            gain = ka[r] if r < 3 else kb[r - 3]
                            for a in range(3):
                                cross[r, a] -= gain * seen_cross[a]
                        # What is left of the cross-covariance, times the noise's weight: the new error and the noise in this row.
                        lt = (
                            dot(vector_at(cross, 0), weight),
                            dot(vector_at(cross, 1), weight),
                            dot(vector_at(cross, 2), weight),
                        )
                        lb = (
                            dot(vector_at(cross, 3), weight),
                            dot(vector_at(cross, 4), weight),
                            dot(vector_at(cross, 5), weight),
                        )
                        power = sigma * sigma * dot(weight, weight)
                        lt = combine(1.0, lt, -0.5 * power, ka)
                        lb = combine(1.0, lb, -0.5 * power, kb)
                        A = symmetric_minus_outer(symmetric_minus_outer(A, ka, lt), lt, ka)
                        B = minus_outer(minus_outer(B, ka, lb), lt, kb)
                        C = symmetric_minus_outer(symmetric_minus_outer(C, kb, lb), lb, kb)
                        expected += power + 2.0 * dot(seen_cross, weight)
                        for r in range(6):
                            gain = ka[r] if r < 3 else kb[r - 3]
                            for a in range(3):
                                cross[r, a] -= gain * sigma * sigma * weight[a]
                store_blocks(blocks[s], A, B, C)
            for c in range(shapes):
                cross = shape_cross[c]
                for a in range(3):
                    for n in range(cross.shape[2]):
                        seen = h[0] * cross[0, a, n] + h[1] * cross[1, a, n] + h[2] * cross[2, a, n]
                        for r in range(6):
                            cross[r, a, n] -= (ka[r] if r < 3 else kb[r - 3]) * seen
            mean = 0.0
            for k in range(number):
                shift = h[0] * columns[k, 0] + h[1] * columns[k, 1] + h[2] * columns[k, 2] + row_error[e, k]
                if k < fixed:
                    mean += shift
                else:
                    expected += shift * shift
                for r in range(6):
                    columns[k, r] -= (ka[r] if r < 3 else kb[r - 3]) * shift
            nis[row_sensor[e], 0] += (expected + mean * mean) / innovation
            nis[row_sensor[e], 1] += 1.0
        if wanted < len(stations) and stations[wanted] == j:
            for s in range(sources):
                A, B, C = load_blocks(blocks[s])
                for c in range(shapes):
                    if shape_source[c] == s:
                        gains, poles, states = shape_gains[c], shape_poles[c], shape_states[c]
                        now, edge = 0.0, 0.0
                        for n in range(len(gains)):
                            now += gains[n] * states[n]
                            edge += 0.5 * (1.0 + poles[n]) * gains[n] * states[n]
                        a = vector_at(shape_amplitude, c)
                        squared = (a[0] * a[0], a[1] * a[1], a[2] * a[2])
                        A, B, C = reported(
                            A, B, C, shape_cross[c], gains, poles, scale(now, squared), scale(edge, squared), j == 0
                        )
                store_blocks(blocks_out[wanted, s], A, B, C)
            for k in range(number):
                for r in range(6):
                    columns_out[wanted, k, r] = columns[k, r]
            wanted += 1
