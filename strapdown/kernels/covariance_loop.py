"""Covariance analysis over one trajectory: contribution of each error source to the covariance of the estimate, with the filter's gains.

Everything is linearised about the truth. The error state is that of the filter, (δθ, δb); measurements are processed as scalar rows
``y = h · δθ + v``, one after the other. A covariance is stored as 21 numbers (blocks A, B, C), as in the filter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

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
    n = tuple(row[i] for i in range(21))
    return n[:6], n[6:15], n[15:]


def store_blocks(row, A, B, C):
    """Write (A, B, C) as 21 numbers."""
    for i, value in enumerate((*A, *B, *C)):
        row[i] = value


def error_with(cross, a, n):
    """Return the covariances of attitude and bias error with state n of axis a of a coloured rate."""
    c = tuple(cross[i, a, n] for i in range(6))
    return c[:3], c[3:]


def axis_vector(i):
    """Return a unit vector along an axis."""
    return (1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0)


def driven(phi, phi12, dt, angle, rate):
    """Return Q11, Q12, Q22 over a rotation φ for white noise of densities ``angle`` and ``rate`` by axis (rad²/s, rad²/s³).

    The part common to all axes is exact; the excess of an axis is approximated as acting at the middle of the rotation.
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
            axis = axis_vector(i)
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
    """Return the blocks of (I − k h) Σ (I − k h)ᵀ + r k kᵀ for any gain k, and h Σ hᵀ."""
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
    """Return the blocks after a segment with an additional constant coloured rate f: Φ Σ Φᵀ + Φ F Γᵀ + Γ Fᵀ Φᵀ + Γ V Γᵀ, Γ = (Φ12, 0).

    ``cross`` (6, 3, n) is the covariance of the error and the states of f, ``variance`` (3,) is V.
    """
    A, B, C = carried(A, B, C, phi11, phi12)
    for a in range(3):
        ft = (0.0, 0.0, 0.0)
        fb = (0.0, 0.0, 0.0)
        for n in range(len(gains)):
            t, b = error_with(cross, a, n)
            ft, fb = combine(1.0, ft, gains[n], t), combine(1.0, fb, gains[n], b)
        column = (phi12[a], phi12[3 + a], phi12[6 + a])
        m = add(matrix_times_vector(phi11, ft), matrix_times_vector(phi12, fb))
        whole = combine(1.0, m, 0.5 * variance[a], column)
        A = symmetric_minus_outer(symmetric_minus_outer(A, scale(-1.0, whole), column), scale(-1.0, column), whole)
        B = minus_outer(B, scale(-1.0, column), fb)
    return A, B, C


def reported(A, B, C, cross, gains, poles, variance, edge_variance, first):
    """Return the blocks of (δθ, δb + f): the true bias includes the coloured rate, at an edge the mean of both adjacent intervals."""
    for a in range(3):
        ft = (0.0, 0.0, 0.0)
        fb = (0.0, 0.0, 0.0)
        for n in range(len(gains)):
            weight = gains[n] * (1.0 if first else 0.5 * (1.0 + poles[n]))
            t, b = error_with(cross, a, n)
            ft, fb = combine(1.0, ft, weight, t), combine(1.0, fb, weight, b)
        axis = axis_vector(a)
        whole = combine(-1.0, fb, -0.5 * (variance[a] if first else edge_variance[a]), axis)
        B = minus_outer(B, scale(-1.0, ft), axis)
        C = symmetric_minus_outer(symmetric_minus_outer(C, whole, axis), axis, whole)
    return A, B, C


class Path(NamedTuple):
    """Segments of the trajectory (segments,), between edges, stations and measurements."""

    dt: np.ndarray
    phi: np.ndarray
    """Rotation vectors (segments, 3), rad."""
    new_sample: np.ndarray
    """Whether a gyro sample interval starts."""
    row_bounds: np.ndarray
    """Station j, which lies after j segments, has the rows ``row_bounds[j]`` to ``row_bounds[j + 1]`` (segments + 2,)."""


class Rows(NamedTuple):
    """Scalar rows ``y = h · δθ + v`` of the measurements (rows,)."""

    h: np.ndarray
    noise: np.ndarray
    """Weights of the three components of a sensor's coloured noise (rows, 3)."""
    filter_variance: np.ndarray
    variance: np.ndarray
    """Variances assumed by the filter, and true."""
    sensor: np.ndarray
    time: np.ndarray
    error: np.ndarray
    """Errors without noise by column (rows, k)."""


class White(NamedTuple):
    """Sources of white noise (1 + s,); the first is the filter's P."""

    angle_density: np.ndarray
    rate_density: np.ndarray
    """By axis (1 + s, 3), rad²/s and rad²/s³."""
    sensor: np.ndarray
    """Sensor with this noise; −1: none."""
    blocks: np.ndarray
    """Covariances (1 + s, 21), including those of coloured sources."""


class Shapes(NamedTuple):
    """Coloured rates of the gyro (c,), each with n first-order states per axis."""

    amplitude: np.ndarray
    gains: np.ndarray
    poles: np.ndarray
    states: np.ndarray
    cross: np.ndarray
    """Covariances of the error and the states of the rate (c, 6, 3, n)."""
    source: np.ndarray


class Coloured(NamedTuple):
    """First-order coloured noise of sensors (c,)."""

    sensor: np.ndarray
    sigma: np.ndarray
    time: np.ndarray
    """Correlation times, s."""
    cross: np.ndarray
    """Covariances of the error and the noise (c, 6, 3)."""
    source: np.ndarray
    seen: np.ndarray
    """Time of the last row of the sensor, s."""


class Columns(NamedTuple):
    """Deterministic errors (k,): the first ``fixed`` are the same in every run, the others have unit variance."""

    rate: np.ndarray
    """Rates of each segment (segments, r, 3), rad/s."""
    place: np.ndarray
    """Index of the rate of each column; −1: none."""
    ramp: np.ndarray
    """Bias ramp (k, 3), rad/s²."""
    fixed: int
    value: np.ndarray
    """The errors (k, 6)."""


class Outputs(NamedTuple):
    """Outputs at ``stations``, in order, and by sensor."""

    stations: np.ndarray
    blocks: np.ndarray
    columns: np.ndarray
    nis: np.ndarray
    """Sum of the expected NIS, and the number of rows (sensors, 2)."""


def shape_of(shapes, source):
    """Return the index of the coloured rate of a source, or −1."""
    for c in range(len(shapes.source)):
        if shapes.source[c] == source:
            return c
    return -1


def shape_powers(shapes, c):
    """Return the variances (3,) of a coloured rate over an interval and at an edge."""
    inside, edge = 0.0, 0.0
    for n in range(shapes.gains.shape[1]):
        power = shapes.gains[c, n] * shapes.states[c, n]
        inside += power
        edge += 0.5 * (1.0 + shapes.poles[c, n]) * power
    a = vector_at(shapes.amplitude, c)
    squared = (a[0] * a[0], a[1] * a[1], a[2] * a[2])
    return scale(inside, squared), scale(edge, squared)


def propagate_shape(A, B, C, shapes, c, phi11, phi12, new_sample):
    """Return the blocks of a coloured rate's source after a segment, and propagate its cross-covariance."""
    gains, poles, states, cross = shapes.gains[c], shapes.poles[c], shapes.states[c], shapes.cross[c]
    amplitude = vector_at(shapes.amplitude, c)
    if new_sample:
        for r in range(6):
            for a in range(3):
                for n in range(len(gains)):
                    cross[r, a, n] *= poles[n]
    variance, _ = shape_powers(shapes, c)
    A, B, C = shaped_rate(A, B, C, cross, gains, phi11, phi12, variance)
    for a in range(3):
        for n in range(len(gains)):
            t, b = error_with(cross, a, n)
            t = add(matrix_times_vector(phi11, t), matrix_times_vector(phi12, b))
            drive = amplitude[a] * amplitude[a] * states[n]
            cross[0, a, n] = t[0] + phi12[a] * drive
            cross[1, a, n] = t[1] + phi12[3 + a] * drive
            cross[2, a, n] = t[2] + phi12[6 + a] * drive
    return A, B, C


def propagate_white(A, B, C, turn, dt, phi11, phi12, angle, rate):
    """Return the blocks of a white source after a segment."""
    A, B, C = carried(A, B, C, phi11, phi12)
    if angle[0] + angle[1] + angle[2] + rate[0] + rate[1] + rate[2] > 0.0:
        q11, q12, q22 = driven(turn, phi12, dt, angle, rate)
        A, B, C = add_matrices(A, q11), add_matrices(B, q12), add_matrices(C, q22)
    return A, B, C


def propagate_columns(columns, i, dt, phi11, phi12):
    """Propagate the errors without noise over segment i."""
    value = columns.value
    for k in range(len(value)):
        t = (value[k, 0], value[k, 1], value[k, 2])
        b = (value[k, 3], value[k, 4], value[k, 5])
        ramp = vector_at(columns.ramp, k)
        held = combine(1.0, b, 0.5 * dt, ramp)
        r = columns.place[k]
        if r >= 0:
            held = add(held, (columns.rate[i, r, 0], columns.rate[i, r, 1], columns.rate[i, r, 2]))
        value[k, 0], value[k, 1], value[k, 2] = add(matrix_times_vector(phi11, t), matrix_times_vector(phi12, held))
        value[k, 3], value[k, 4], value[k, 5] = combine(1.0, b, dt, ramp)


def propagate(i, path, white, shapes, coloured, columns):
    """Propagate every source over segment i."""
    turn = vector_at(path.phi, i)
    dt = path.dt[i]
    phi11, phi12 = transition(turn, dt)
    for s in range(len(white.blocks)):
        A, B, C = load_blocks(white.blocks[s])
        shape = shape_of(shapes, s)
        if shape >= 0:
            A, B, C = propagate_shape(A, B, C, shapes, shape, phi11, phi12, path.new_sample[i])
        else:
            angle, rate = vector_at(white.angle_density, s), vector_at(white.rate_density, s)
            A, B, C = propagate_white(A, B, C, turn, dt, phi11, phi12, angle, rate)
        store_blocks(white.blocks[s], A, B, C)
    for c in range(len(coloured.source)):
        cross = coloured.cross[c]
        for a in range(3):
            t = (cross[0, a], cross[1, a], cross[2, a])
            b = (cross[3, a], cross[4, a], cross[5, a])
            t = add(matrix_times_vector(phi11, t), matrix_times_vector(phi12, b))
            cross[0, a], cross[1, a], cross[2, a] = t
    propagate_columns(columns, i, dt, phi11, phi12)


def gain_at(ka, kb, r):
    """Return component r of the gain (6,)."""
    return ka[r] if r < 3 else kb[r - 3]


def update_coloured(A, B, C, e, h, ka, kb, rows, coloured, c):
    """Return the blocks of a coloured source after row e, and its contribution to the expected squared innovation."""
    cross = coloured.cross[c]
    sigma = coloured.sigma[c]
    mine = coloured.sensor[c] == rows.sensor[e]
    if mine:
        decay = math.exp(-(rows.time[e] - coloured.seen[c]) / coloured.time[c])
        coloured.seen[c] = rows.time[e]
        for r in range(6):
            for a in range(3):
                cross[r, a] *= decay
    weight = vector_at(rows.noise, e) if mine else (0.0, 0.0, 0.0)
    seen = (0.0, 0.0, 0.0)
    for r in range(3):
        seen = combine(1.0, seen, h[r], vector_at(cross, r))
    for r in range(6):
        for a in range(3):
            cross[r, a] -= gain_at(ka, kb, r) * seen[a]
    # Covariance of the error after the update and the noise of this row.
    lt = (dot(vector_at(cross, 0), weight), dot(vector_at(cross, 1), weight), dot(vector_at(cross, 2), weight))
    lb = (dot(vector_at(cross, 3), weight), dot(vector_at(cross, 4), weight), dot(vector_at(cross, 5), weight))
    power = sigma * sigma * dot(weight, weight)
    lt = combine(1.0, lt, -0.5 * power, ka)
    lb = combine(1.0, lb, -0.5 * power, kb)
    A = symmetric_minus_outer(symmetric_minus_outer(A, ka, lt), lt, ka)
    B = minus_outer(minus_outer(B, ka, lb), lt, kb)
    C = symmetric_minus_outer(symmetric_minus_outer(C, kb, lb), lb, kb)
    for r in range(6):
        for a in range(3):
            cross[r, a] -= gain_at(ka, kb, r) * sigma * sigma * weight[a]
    return A, B, C, power + 2.0 * dot(seen, weight)


def update_shapes(h, ka, kb, shapes):
    """Update the cross-covariances of coloured rates with a row."""
    for c in range(len(shapes.source)):
        cross = shapes.cross[c]
        for a in range(3):
            for n in range(cross.shape[2]):
                seen = h[0] * cross[0, a, n] + h[1] * cross[1, a, n] + h[2] * cross[2, a, n]
                for r in range(6):
                    cross[r, a, n] -= gain_at(ka, kb, r) * seen


def update(e, rows, white, shapes, coloured, columns, nis):
    """Update every source with row e by the filter's gain."""
    h = vector_at(rows.h, e)
    A, B, C = load_blocks(white.blocks[0])
    pa = symmetric_times_vector(A, h)
    innovation = dot(h, pa) + rows.filter_variance[e]
    ka = scale(1.0 / innovation, pa)
    kb = scale(1.0 / innovation, transpose_times_vector(B, h))
    A, B, C, _ = corrected(A, B, C, h, ka, kb, rows.filter_variance[e])
    store_blocks(white.blocks[0], A, B, C)
    expected = rows.variance[e]
    for s in range(1, len(white.blocks)):
        A, B, C = load_blocks(white.blocks[s])
        own = rows.variance[e] if white.sensor[s] == rows.sensor[e] else 0.0
        A, B, C, seen = corrected(A, B, C, h, ka, kb, own)
        expected += seen
        for c in range(len(coloured.source)):
            if coloured.source[c] == s:
                A, B, C, more = update_coloured(A, B, C, e, h, ka, kb, rows, coloured, c)
                expected += more
        store_blocks(white.blocks[s], A, B, C)
    update_shapes(h, ka, kb, shapes)
    mean = 0.0
    value = columns.value
    for k in range(len(value)):
        shift = h[0] * value[k, 0] + h[1] * value[k, 1] + h[2] * value[k, 2] + rows.error[e, k]
        if k < columns.fixed:
            mean += shift
        else:
            expected += shift * shift
        for r in range(6):
            value[k, r] -= gain_at(ka, kb, r) * shift
    nis[rows.sensor[e], 0] += (expected + mean * mean) / innovation
    nis[rows.sensor[e], 1] += 1.0


def keep(row, first, white, shapes, columns, out):
    """Write the covariances and errors at a station; ``first``: whether no segment precedes it."""
    for s in range(len(white.blocks)):
        A, B, C = load_blocks(white.blocks[s])
        c = shape_of(shapes, s)
        if c >= 0:
            inside, edge = shape_powers(shapes, c)
            A, B, C = reported(A, B, C, shapes.cross[c], shapes.gains[c], shapes.poles[c], inside, edge, first)
        store_blocks(out.blocks[row, s], A, B, C)
    for k in range(len(columns.value)):
        for r in range(6):
            out.columns[row, k, r] = columns.value[k, r]


def run_covariance(path, rows, white, shapes, coloured, columns, out):
    """Propagate and update every source with the filter's gains; write its covariance at the stations of ``out``."""
    wanted = 0
    for j in range(len(path.dt) + 1):
        if j > 0:
            propagate(j - 1, path, white, shapes, coloured, columns)
        for e in range(path.row_bounds[j], path.row_bounds[j + 1]):
            update(e, rows, white, shapes, coloured, columns, out.nis)
        if wanted < len(out.stations) and out.stations[wanted] == j:
            keep(wanted, j == 0, white, shapes, columns, out)
            wanted += 1
