"""Covariance analysis: contributions of error sources to the error of a filter; run by :mod:`strapdown.kernels.walk`.

The filter of :mod:`strapdown.kernels.filter` runs along the true trajectory, with measurements without noise: its state remains the truth,
and its covariance gives the gains. The actual error e, linearised there, is propagated by the same transitions and gains, source by source:
``e ← Φ e + …``, and ``e ← e − k (h e + w v)`` for each row h of a measurement, v the noise of the sensor along three axes.

The edges of the walk are those of the gyro and the times of measurements, the increments the true rotations between them. Covariances of n
states are by rows, padded as in the filter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import dot, symmetric_times_vector
from strapdown.kernels.chains import fill_coefficients
from strapdown.kernels.filter_step import transition
from strapdown.kernels.layout import LINE, PRODUCT, RESIDUAL, ROWS, VARIANCE, N, W
from strapdown.kernels.measurement import HEADING, KIND, Measurements, six_at, vector_at
from strapdown.kernels.model import advance, apply_transition, write_transition
from strapdown.kernels.rows import write_rows
from strapdown.kernels.structure import Body as Filter
from strapdown.kernels.structure import Model
from strapdown.kernels.update import clear_step, take_row
from strapdown.kernels.walk import (
    increment_over,  # noqa: F401 - that of the walk, not the filter's
    step_within,
    turn_squared,
)

CALLED = ("correct_source", "propagate_source", "put_rows", "transform")

NO_BIAS = (0.0, 0.0, 0.0)


class Sources(NamedTuple):
    """Sources of random error (s,)."""

    angle: np.ndarray
    rate: np.ndarray
    """Densities of white noise of the gyro by axis (s, 3), rad²/s and rad²/s³."""
    P: np.ndarray
    """Their contributions to the covariance (s, numbers of P)."""


class Rates(NamedTuple):
    """Coloured rates of the gyro (c,), each the sum of m first-order states per axis."""

    amplitude: np.ndarray
    gains: np.ndarray
    poles: np.ndarray
    """Over a gyro interval (c, m)."""
    power: np.ndarray
    """Covariance of each state with the rate, for an amplitude of 1 (c, m)."""
    cross: np.ndarray
    """Covariances of the states and the error (c, 3, m, n)."""
    source: np.ndarray


class Noises(NamedTuple):
    """Noise of sensors (c,): white, or of first order."""

    sensor: np.ndarray
    sigma: np.ndarray
    """σ along each axis of first-order noise; 0: white, with the covariance of :attr:`Body.noise`."""
    time: np.ndarray
    """Correlation times, s; 0 of white noise."""
    cross: np.ndarray
    """Covariances of the noise and the error (c, 3, n)."""
    source: np.ndarray
    last: np.ndarray
    """Time of the last measurement of the sensor, s."""


class Columns(NamedTuple):
    """Errors without noise (k,): the first ``fixed`` are the same in every run, the others have unit variance."""

    rate: np.ndarray
    """Errors of the rate in each segment (segments, r, 3), rad/s."""
    place: np.ndarray
    """Index of the rate of each column; −1: none."""
    ramp: np.ndarray
    """Bias ramp (k, 3), rad/s²."""
    turn: np.ndarray
    """Rotation of a sensor at each measurement (events, k, 3), rad."""
    offset: np.ndarray
    """Error of a sensor along the axes of its noise at each measurement (events, k, 3)."""
    sensor: np.ndarray
    """Sensor whose own error a column is, the residual of its measurements; −1: none."""
    fixed: int
    value: np.ndarray
    """The errors (k, n)."""


class Body(NamedTuple):
    """The filter, the sources, and how the noise of sensors enters."""

    filter: Filter
    quiet: Model
    """The model without noise."""
    coefficients: np.ndarray
    """Of a step of the model without noise."""
    sources: Sources
    rates: Rates
    noises: Noises
    columns: Columns
    truth: np.ndarray
    """True attitudes at the edges (edges, 4)."""
    begins_sample: np.ndarray
    """Whether a gyro interval begins at each edge."""
    shifted: tuple[Measurements, ...]
    """Measurements shifted along the axes of their noise, by ``shift`` and −``shift``."""
    shift: float
    noise: np.ndarray
    """True covariance of white noise along its axes (events, 6); of a heading, the first number is its variance."""
    unit: np.ndarray
    """A unit of the sensor along the axes (events,)."""
    x: np.ndarray
    """Work space: a state (n + 1,)."""
    top: np.ndarray
    """Rows of the attitude of Φ (3 × padded width)."""
    weights: np.ndarray
    """w of the rows of a measurement, for a unit of the sensor and for white noise (2, 3, 3)."""
    product: np.ndarray
    error: np.ndarray
    """Vectors (n,)."""


class Outputs(NamedTuple):
    """Arrays to be written: rows of ``stations``, in order; measurements by time."""

    stations: np.ndarray
    P: np.ndarray
    """Covariance of attitude and whole bias by the filter, and by each source (rows, 1 + s, 6, 6)."""
    columns: np.ndarray
    """(rows, k, 6)"""
    residual: np.ndarray
    """Residuals without noise (events, 3)."""
    nis: np.ndarray
    """Sum of the expected NIS, and the number of rows (sensors, 2)."""


class Progress(NamedTuple):
    """State of the walk."""

    edge: int
    """Edges passed."""
    row: int
    """Rows written."""


# --------------------------------------------------------------------------------------------------------------------------- prediction


def begin(body):
    """Return the state before the first edge."""
    none = 0 * len(body.begins_sample)
    return Progress(none, none)


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return min(step_within(turn_squared(part, dt, NO_BIAS), dt), body.quiet.limit)


def predict(state, part, dt, body, out):
    """Propagate the sources, and the filter, over an increment; ``state.edge`` edges precede it."""
    filters, quiet, coefficients = body.filter, body.quiet, body.coefficients
    x, top = filters.x[0], body.top
    if dt != filters.dt[0]:
        fill_coefficients(filters.coefficients, dt, filters.model)
        fill_coefficients(coefficients, dt, quiet)
        filters.dt[0] = dt
    write_transition(x, part, dt, quiet, coefficients, top, 0.0)
    for s in range(len(body.sources.P)):
        propagate_source(s, part, dt, body)
    for c in range(len(body.rates.source)):
        propagate_rate(c, body)
    for c in range(len(body.noises.source)):
        for a in range(3):
            transform(body.noises.cross[c, a], body)
    columns = body.columns
    for k in range(len(columns.value)):
        value = columns.value[k]
        transform(value, body)
        ramp, place = vector_at(columns.ramp, k), columns.place[k]
        for a in range(3):
            rate = 0.5 * dt * ramp[a]
            if place >= 0:
                rate += columns.rate[state.edge - 1, place, a]
            for i in range(3):
                value[i] += top[W * i + 3 + a] * rate
            value[3 + a] += dt * ramp[a]
    advance(x, filters.P[0], part, dt, filters.model, filters.coefficients, 0.0)
    return state


def transform(error, body):
    """Apply the transition of the step to an error."""
    apply_transition(error, body.top, body.coefficients, 0.0)


def propagate_source(s, part, dt, body):
    """Propagate the contribution of a source.

    The noise that all axes have in common is exact; the excess of an axis is approximated as acting at the middle of the rotation.
    """
    quiet, x, P = body.quiet, body.x, body.sources.P[s]
    angle, rate = vector_at(body.sources.angle, s), vector_at(body.sources.rate, s)
    least_angle, least_rate = min(angle[0], angle[1], angle[2]), min(rate[0], rate[1], rate[2])
    model = Model(
        least_angle, least_rate, quiet.numbers, quiet.decay, quiet.chains, quiet.last, quiet.limit, quiet.force_f
    )
    for i in range(len(x)):
        x[i] = body.filter.x[0, i]
    advance(x, P, part, dt, model, body.coefficients, 0.0)
    _, phi12 = transition(part, dt)
    for a in range(3):
        u, v = angle[a] - least_angle, rate[a] - least_rate
        if u + v > 0.0:
            for i in range(3):
                column = -phi12[3 * i + a] / dt
                for j in range(3):
                    P[W * i + j] += (u * dt + v * dt**3 / 3.0) * column * (-phi12[3 * j + a] / dt)
                P[W * i + 3 + a] -= 0.5 * dt * dt * v * column
                P[W * (3 + a) + i] -= 0.5 * dt * dt * v * column
            P[W * (3 + a) + 3 + a] += v * dt


def propagate_rate(c, body):
    """Add the contribution of a coloured rate that is constant over the step, and propagate its covariance with the error."""
    rates, top, P = body.rates, body.top, body.sources.P[body.rates.source[c]]
    for a in range(3):
        power = 0.0
        for i in range(N):
            body.error[i] = 0.0
        for m in range(rates.gains.shape[1]):
            cross = rates.cross[c, a, m]
            transform(cross, body)
            for i in range(N):
                body.error[i] += rates.gains[c, m] * cross[i]
            drive = rates.amplitude[c, a] ** 2 * rates.power[c, m]
            power += rates.gains[c, m] * drive
            for i in range(3):
                cross[i] += top[W * i + 3 + a] * drive
        for i in range(3):
            body.error[i] += 0.5 * power * top[W * i + 3 + a]
        for i in range(N):
            for j in range(3):
                t = body.error[i] * top[W * j + 3 + a]
                P[W * i + j] += t
                P[W * j + i] += t


# ------------------------------------------------------------------------------------------------------------------------------- update


def put_rows(shape, filters, measured, e):
    """Write the rows of a measurement to the work space; return their number, and whether it is valid."""
    rows, _, valid = write_rows(shape, filters.x[0], filters, measured, e, 0.0)
    return rows, valid


def update(state, e, now, measured, body, out):
    """Correct the filter's covariance and every source by a measurement."""
    filters, noises, columns, nis = body.filter, body.noises, body.columns, out.nis
    work, sensor = filters.work, measured.sensor[e]
    shape = filters.shape[sensor]
    # w by central differences, in which the residuals are linear.
    weights = body.weights
    for a in range(3):
        put_rows(shape, filters, body.shifted[2 * a], e)
        for r in range(3):
            weights[0, r, a] = work[LINE * (ROWS + r) + RESIDUAL]
        put_rows(shape, filters, body.shifted[2 * a + 1], e)
        for r in range(3):
            weights[0, r, a] = (weights[0, r, a] - work[LINE * (ROWS + r) + RESIDUAL]) * (0.5 / body.shift)
    rows, valid = put_rows(shape, filters, measured, e)
    if not valid:
        return state
    scale_weights(weights, measured.series[sensor, KIND], body.unit[e])
    begin_noises(noises, sensor, now)
    clear_step(work, 0.0)
    noise = six_at(body.noise, e)
    for r in range(rows):
        h = LINE * (ROWS + r)
        out.residual[e, r] = work[h + RESIDUAL]
        _, innovation = take_row(filters.P[0], work, ROWS + r, 0.0, work[h + VARIANCE], 0.0)
        k = work[LINE * PRODUCT : LINE * PRODUCT + N]
        expected = 0.0
        for s in range(len(body.sources.P)):
            expected += correct_source(s, r, sensor, work[h : h + N], k, noise, body)
        for c in range(len(body.rates.source)):
            for a in range(3):
                for m in range(body.rates.gains.shape[1]):
                    correct_vector(body.rates.cross[c, a, m], work, h, k, 0.0)
        mean = 0.0
        for i in range(len(columns.value)):
            error = 0.0
            if columns.sensor[i] == sensor:
                error = out.residual[e, r]
            for a in range(3):
                error += work[h + a] * columns.turn[e, i, a] + weights[0, r, a] * columns.offset[e, i, a]
            shift = correct_vector(columns.value[i], work, h, k, error)
            if i < columns.fixed:
                mean += shift
            else:
                expected += shift * shift
        nis[sensor, 0] += (expected + mean * mean) / innovation
        nis[sensor, 1] += 1.0
    return state


def scale_weights(weights, kind, unit):
    """Write w for a unit of the sensor, and for white noise; a heading's white noise is that of the angle."""
    for r in range(3):
        size = 1.0
        if kind == HEADING and r == 0:
            w = vector_at(weights[0], 0)
            size = 1.0 / math.sqrt(dot(w, w))
        for a in range(3):
            weights[1, r, a] = weights[0, r, a]
            if kind == HEADING:
                weights[1, r, a] = 1.0 if a == 0 else 0.0
            weights[0, r, a] *= size * unit


def begin_noises(noises, sensor, now):
    """Reduce the covariances of the sensor's noise and the error by the decay since its last measurement; those of white noise to 0."""
    for c in range(len(noises.source)):
        if noises.sensor[c] == sensor:
            decay = 0.0 if noises.sigma[c] == 0.0 else math.exp(-(now - noises.last[c]) / noises.time[c])
            noises.last[c] = now
            for a in range(3):
                for i in range(noises.cross.shape[2]):
                    noises.cross[c, a, i] *= decay


def correct_vector(value, work, h, k, error):
    """Replace an error by ``value − k (h value + error)``; return the number in brackets."""
    for i in range(N):
        error += work[h + i] * value[i]
    for i in range(N):
        value[i] -= k[i] * error
    return error


def correct_source(s, r, sensor, h, k, noise, body):
    """Correct the contribution P of a source by a row; return its part of the innovation's variance.

    ``P ← (I − k h) P (I − k h)ᵀ − g kᵀ − k gᵀ``, ``g = (I − k h) X w − k w V w/2``, ``X ← (I − k h) X − k w V``: X is the covariance of the
    error and the noise, V that of the noise. The product is by its left and then its right factor, each of which may reduce P by far.
    """
    noises, P, p, g = body.noises, body.sources.P[s], body.product, body.error
    variance = 0.0
    for i in range(N):
        g[i] = 0.0
        p[i] = 0.0
        for j in range(N):
            p[i] += P[W * i + j] * h[j]
        variance += h[i] * p[i]
    for i in range(N):
        for j in range(N):
            P[W * i + j] -= k[i] * p[j]
    for i in range(N):
        p[i] = 0.0
        for j in range(N):
            p[i] += P[W * i + j] * h[j]
    for c in range(len(noises.source)):
        if noises.source[c] == s:
            variance += correct_noise(c, r, sensor, h, k, noise, body)
    for i in range(N):
        for j in range(i, N):
            upper, lower = P[W * i + j] - p[i] * k[j], P[W * j + i] - p[j] * k[i]
            value = 0.5 * (upper + lower) - (g[i] * k[j] + k[i] * g[j])
            P[W * i + j] = value
            P[W * j + i] = value
    return variance


def correct_noise(c, r, sensor, h, k, noise, body):
    """Correct the covariance of a noise and the error by a row; add to g, and return the noise's part of the innovation's variance."""
    noises, g = body.noises, body.error
    white = noises.sigma[c] == 0.0
    w = (0.0, 0.0, 0.0)
    if noises.sensor[c] == sensor:
        w = vector_at(body.weights[1 if white else 0], r)
    square = noises.sigma[c] * noises.sigma[c]
    Vw = symmetric_times_vector(noise if white else (square, 0.0, 0.0, square, 0.0, square), w)
    variance = dot(w, Vw)
    for i in range(N):
        g[i] -= 0.5 * variance * k[i]
    for a in range(3):
        X = noises.cross[c, a]
        projected = 0.0
        for i in range(N):
            projected += h[i] * X[i]
        variance += 2.0 * w[a] * projected
        for i in range(N):
            X[i] -= k[i] * projected
            g[i] += w[a] * X[i]
            X[i] -= k[i] * Vw[a]
    return variance


# ------------------------------------------------------------------------------------------------------------------------------ outputs


def keep(state, row, e, body, out):
    """Write a station, and begin the next gyro interval."""
    edge, number, rates = state.edge, state.row, body.rates
    for i in range(4):
        body.filter.x[0, i] = body.truth[edge, i]
    if number < len(out.stations) and out.stations[number] == edge:
        write_whole(body.filter.P[0], body, out.P[number, 0])
        for s in range(len(body.sources.P)):
            write_whole(body.sources.P[s], body, out.P[number, 1 + s])
        for c in range(len(rates.source)):
            add_rate(c, edge == 0, body, out.P[number, 1 + rates.source[c]])
        for k in range(len(body.columns.value)):
            for a in range(6):
                out.columns[number, k, a] = whole(body.columns.value[k], a, body.filter.offsets)
        number += 1
    if body.begins_sample[edge]:
        for c in range(len(rates.source)):
            for a in range(3):
                for m in range(rates.gains.shape[1]):
                    for i in range(rates.cross.shape[3]):
                        rates.cross[c, a, m, i] *= rates.poles[c, m]
    return Progress(edge + 1, number)


def whole(error, a, offsets):
    """Return an error of attitude or whole bias, ``b + Σ c e`` over the states that are an offset of the gyro."""
    t = error[a]
    if a >= 3:
        for k in range(len(offsets)):
            t += offsets[k, a - 3] * error[6 + k]
    return t


def write_whole(P, body, out):
    """Write the covariance of attitude and whole bias."""
    offsets = body.filter.offsets
    for b in range(6):
        for i in range(N):
            body.error[i] = whole(P[W * i : W * i + N], b, offsets)
        for a in range(6):
            out[a, b] = whole(body.error, a, offsets)


def add_rate(c, first, body, out):
    """Add a coloured rate to the error of the whole bias: the true one includes it, at an edge the mean of both adjacent intervals."""
    rates, offsets = body.rates, body.filter.offsets
    for a in range(3):
        for m in range(rates.gains.shape[1]):
            weight = rates.gains[c, m] * (1.0 if first else 0.5 * (1.0 + rates.poles[c, m]))
            for i in range(6):
                t = weight * whole(rates.cross[c, a, m], i, offsets)
                out[i, 3 + a] += t
                out[3 + a, i] += t
            out[3 + a, 3 + a] += weight * rates.amplitude[c, a] ** 2 * rates.power[c, m]


def stopped(state):
    """Return false: the walk goes to the end."""
    return state.edge < 0


def finish(state, row, e, body):
    """Return the number of rows written."""
    return state.row
