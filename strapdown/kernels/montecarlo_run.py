"""Monte Carlo runs in lanes (SIMD): gyro errors, sensors and filter of 1 to 8 runs at once, along one common motion.

Truth, times and all else common to the runs are plain arrays; values that differ between runs are lanes. Each run has its own random
streams (:func:`strapdown.kernels.noise.stream_state`, with one key per source and the run's number), so it does not depend on its
neighbours. Noise is exact in discrete time, by the formulas of :mod:`strapdown.kernels.gyro_errors`; the filter is that of
:mod:`strapdown.kernels.filter_step`.

In memory lanes are contiguous, so place p of a flat array begins at ``p · len(like)``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    add,
    combine,
    dot,
    matrix_times_vector,
    scale,
    subtract,
    transpose_times_vector,
)
from strapdown.kernels.filter_step import predict, update_direction_and_judge, update_heading, update_residual
from strapdown.kernels.lane_angles import arctangent, inverse_root, rotation_vector
from strapdown.kernels.lane_values import (
    halves,
    lanes_of,
    load_like,
    narrowed,
    select,
    store,
)
from strapdown.kernels.measurement import ATTITUDE, HEADING, VECTOR, frame_at, heading_row, vector_at
from strapdown.kernels.noise import next_word, single_normals, stream_state
from strapdown.kernels.rotation import exponential, quaternion_multiply, rotation_matrix, unit

GYRO, FLICKER, MARKOV, TURN_ON, START, DISPERSIONS, SENSORS = range(7)
"""Sources of noise: random streams of a run. From SENSORS on there are two per sensor: its white noise and its faults."""

STATES = 16
"""Number of flicker states of an axis."""

# Offsets in the memory of a group of runs.
_WALK, _MARKOV, _TURN_ON, _BEFORE, _MATRIX, _STATES = 0, 3, 6, 9, 12, 21
_SENSORS = _STATES + 3 * STATES
_OF_A_SENSOR = 3
"""Length of the memory of a sensor, its correlated noise."""

TRIPLES = 32
AHEAD = 3 * TRIPLES
"""Number of normals drawn ahead for each source: drawing many in one loop is faster than a few between the steps of the filter."""

KEPT = 31
"""Number of values stored at an epoch: q (4), b (3), P in blocks (21), true bias (3)."""

WHITE_SIGMA, WALK_SIGMA, MARKOV_DECAY, MARKOV_SIGMA, MARKOV_MEAN, MARKOV_START, TURN_ON_SIGMA, FLICKER_SIZE = range(8)
"""Rows of ``sizes``, the noise of a step by axis: σ of the increment given the bias at both ends, σ of the step of the random walk, decay
of the Markov bias, σ of its step, weight of its end values in the increment, its initial σ, σ of the turn-on bias, flicker B."""


class Gyro(NamedTuple):
    """Gyro data over n steps of the filter."""

    edges: np.ndarray
    """Edges of the steps (n + 1,), s."""
    substeps: np.ndarray
    """Maximum duration of one prediction of the filter in each step (n,), s. A step beyond the range of the polynomials is divided; at
    constant rate the parts compose exactly, so the model is the same."""
    increments: np.ndarray
    """Gyro increments without the errors that differ between runs (n, 3), rad."""
    true_increments: np.ndarray
    """(n, 3), rad."""
    true_bias: np.ndarray
    """Part of the bias common to all runs (n + 1, 3), rad/s."""
    terms: np.ndarray
    """Whether each noise is present (4,): random walk, Markov, flicker, error matrix."""
    sizes: np.ndarray
    """Sizes of the noises by axis (8, 3), rows :data:`WHITE_SIGMA` to :data:`FLICKER_SIZE`."""
    poles: np.ndarray
    gains: np.ndarray
    poles_start: np.ndarray
    """Flicker (:class:`strapdown.gyro.flicker.Shaping`) (16,), (16,), and the root of its stationary covariance (16, 16) or (0, 16)."""
    dispersion: np.ndarray
    """σ of the entries of the error matrix (3, 3)."""


class Start(NamedTuple):
    """Initial state, at the first edge, and process noise of the filter."""

    attitude: np.ndarray
    """True attitude (4,)."""
    error: np.ndarray
    """True initial error (8,): σ of δθ and δb, then the part common to all runs (6)."""
    variance: np.ndarray
    """Initial variances of attitude and bias in the filter (2,)."""
    noise: np.ndarray
    """σ_v² and σ_u² of the filter (2,)."""


class Events(NamedTuple):
    """Measurements in order of time (m,)."""

    time: np.ndarray
    kind: np.ndarray
    """Code of :mod:`strapdown.kernels.measurement`."""
    sensor: np.ndarray
    span: np.ndarray
    """Time bin of the NIS."""
    exact: np.ndarray
    """Value without noise (m, 4): a vector or a quaternion."""
    sigma: np.ndarray
    """True σ (m, 3)."""
    variance: np.ndarray
    """Variances in the filter (m, 3)."""
    decay: np.ndarray
    share: np.ndarray
    """Decay of the correlated noise since the sensor's last measurement, and σ of its new part."""
    number: np.ndarray
    """Index among the measurements of its sensor."""
    frame: np.ndarray
    """Row of ``frames``."""
    frames: np.ndarray
    """Right-handed frames (u, v, r) by rows about the references (rows, 9)."""
    struck_below: np.ndarray
    """For each sensor, the random word below which a measurement is an outlier; 0: no outliers."""
    outlier_scale: np.ndarray


class Draws(NamedTuple):
    """Random streams and memory of a group of runs, flat."""

    streams: np.ndarray
    """States of the streams."""
    ahead: np.ndarray
    """:data:`AHEAD` normals per source, in single precision."""
    memory: np.ndarray
    """See :func:`memory`."""


class Outputs(NamedTuple):
    """Outputs of a group of runs, flat."""

    kept: np.ndarray
    """:data:`KEPT` numbers per epoch."""
    nis: np.ndarray
    """Sum of the NIS by sensor and time bin; updates add to it."""


class Detail(NamedTuple):
    """Detailed outputs for the replay of runs, flat."""

    increments: np.ndarray
    """Measured increments, 3 per interval."""
    values: np.ndarray
    """Measured values, 4 per measurement."""
    innovations: np.ndarray
    """e₁, s₁, e₂, s₂, e₃, s₃ of each measurement."""


def memory(sensors):
    """Return the number of places in the memory of a group."""
    return _SENSORS + _OF_A_SENSOR * sensors


def triple(memory, place, like):
    """Return three neighbouring places."""
    return tuple(load_like(memory, (place + i) * len(like), like) for i in range(3))


def four(memory, place, like):
    """Return four neighbouring places."""
    return tuple(load_like(memory, (place + i) * len(like), like) for i in range(4))


def nine(memory, place, like):
    """Return nine neighbouring places."""
    return tuple(load_like(memory, (place + i) * len(like), like) for i in range(9))


def store_several(memory, place, like, values):
    """Write neighbouring places."""
    for i, value in enumerate(values):
        store(memory, (place + i) * len(like), value)


def by_axis(v, sizes, row):
    """Return the product of v and a row of ``sizes``, by component."""
    return tuple(v[i] * sizes[row, i] for i in range(3))


def next_four(s0, s1, s2, s3):
    """Return four normals, as two values of twice the lanes, and the state of the streams after them."""
    word0, s0, s1, s2, s3 = next_word(s0, s1, s2, s3)
    word1, s0, s1, s2, s3 = next_word(s0, s1, s2, s3)
    low, high = halves(word0, word1)
    x, y = single_normals(low, high)
    return x, y, s0, s1, s2, s3


def refill(streams, source, ahead, count, like):
    """Draw the next normals of a source, ``count`` of them, a multiple of four."""
    n = len(like)
    begin = AHEAD * source * n
    s0, s1, s2, s3 = four(streams, 4 * source, like)
    for at in range(begin, begin + count * n, 4 * n):
        x, y, s0, s1, s2, s3 = next_four(s0, s1, s2, s3)
        store(ahead, at, x)
        store(ahead, at + 2 * n, y)
    store_several(streams, 4 * source, like, (s0, s1, s2, s3))


def drawn(ahead, source, index, like):
    """Return a normal of a source by its index among those drawn ahead."""
    return narrowed(load_like(ahead, (AHEAD * source + index) * len(like), like), like)


def drawn_triple(ahead, source, index, like):
    """Return three neighbouring normals."""
    return tuple(drawn(ahead, source, index + i, like) for i in range(3))


def normal_triple(streams, source, ahead, number, like):
    """Return the 3-vector of normals ``number`` of a source; numbers must be requested in order from 0."""
    turn = number & (TRIPLES - 1)
    if turn == 0:
        refill(streams, source, ahead, AHEAD, like)
    return drawn_triple(ahead, source, 3 * turn, like)


def start_streams(keys, numbers, draws, like):
    """Set the states of all streams of the runs ``numbers``, ``keys`` (sources, 2), and draw the normals of their initial values."""
    number = load_like(numbers, 0, like)
    for source in range(len(keys)):
        store_several(draws.streams, 4 * source, like, stream_state(keys[source, 0], keys[source, 1], number))
    for source in (FLICKER, TURN_ON, START, DISPERSIONS):
        refill(draws.streams, source, draws.ahead, 3 * STATES, like)


def start_gyro(gyro, draws, like):
    """Draw what a run's gyro starts with: turn-on bias, Markov bias, flicker states, error matrix."""
    n = len(like)
    sizes, poles_start, dispersion = gyro.sizes, gyro.poles_start, gyro.dispersion
    ahead, memory = draws.ahead, draws.memory
    store_several(memory, _WALK, like, (like, like, like))
    store_several(memory, _TURN_ON, like, by_axis(drawn_triple(ahead, TURN_ON, 0, like), sizes, TURN_ON_SIGMA))
    store_several(memory, _MARKOV, like, by_axis(drawn_triple(ahead, TURN_ON, 3, like), sizes, MARKOV_START))
    for i in range(3 * STATES):
        store(memory, (_STATES + i) * n, like)
    if len(poles_start) > 0:
        for axis in range(3):
            for j in range(0, STATES, 2):
                x0 = drawn(ahead, FLICKER, axis * STATES + j, like)
                x1 = drawn(ahead, FLICKER, axis * STATES + j + 1, like)
                for i in range(j, STATES):
                    at = (_STATES + axis * STATES + i) * n
                    state = load_like(memory, at, like) + poles_start[i, j] * x0
                    store(memory, at, state + poles_start[i, j + 1] * x1)
    for row in range(3):
        x = drawn_triple(ahead, DISPERSIONS, 3 * row, like)
        store_several(memory, _MATRIX + 3 * row, like, by_axis(x, dispersion, row))


def flicker_step(poles, gains, memory, axis, w, like):
    """Advance the flicker of one axis by a normal; return its value for B = 1."""
    n = len(like)
    base = (_STATES + axis * STATES) * n
    even = odd = like
    for i in range(0, STATES, 2):
        at = base + i * n
        a = poles[i] * load_like(memory, at, like) + w
        b = poles[i + 1] * load_like(memory, at + n, like) + w
        store(memory, at, a)
        store(memory, at + n, b)
        even = even + gains[i] * a
        odd = odd + gains[i + 1] * b
    return even + odd


def flicker_value(gains, memory, axis, like):
    """Return the flicker of the current states, for B = 1."""
    n = len(like)
    base = (_STATES + axis * STATES) * n
    value = like
    for i in range(STATES):
        value = value + gains[i] * load_like(memory, base + i * n, like)
    return value


def drift_step(gyro, k, dt, true_increment, draws, like):
    """Draw interval k of the gyro; return the bias at its start, without its part common to all runs, and the noise of its increment."""
    terms, sizes, poles, gains = gyro.terms, gyro.sizes, gyro.poles, gyro.gains
    streams, ahead, memory = draws.streams, draws.ahead, draws.memory
    walk = triple(memory, _WALK, like)
    turn_on = triple(memory, _TURN_ON, like)
    bias = add(walk, turn_on)
    if terms[0]:
        white = normal_triple(streams, GYRO, ahead, 2 * k, like)
        steps = normal_triple(streams, GYRO, ahead, 2 * k + 1, like)
        after = add(walk, by_axis(steps, sizes, WALK_SIGMA))
        store_several(memory, _WALK, like, after)
        drift = combine(dt, turn_on, 0.5 * dt, add(walk, after))
    else:
        white = normal_triple(streams, GYRO, ahead, k, like)
        bias = turn_on
        drift = scale(dt, turn_on)
    if terms[1]:
        g = triple(memory, _MARKOV, like)
        x = normal_triple(streams, MARKOV, ahead, k, like)
        after = add(by_axis(g, sizes, MARKOV_DECAY), by_axis(x, sizes, MARKOV_SIGMA))
        store_several(memory, _MARKOV, like, after)
        bias = add(bias, g)
        drift = add(drift, by_axis(add(g, after), sizes, MARKOV_MEAN))
    if terms[2]:
        if k == 0:
            for axis in range(3):
                value = sizes[FLICKER_SIZE, axis] * flicker_value(gains, memory, axis, like)
                store(memory, (_BEFORE + axis) * len(like), value)
        x = normal_triple(streams, FLICKER, ahead, k, like)
        before = triple(memory, _BEFORE, like)
        now = (
            sizes[FLICKER_SIZE, 0] * flicker_step(poles, gains, memory, 0, x[0], like),
            sizes[FLICKER_SIZE, 1] * flicker_step(poles, gains, memory, 1, x[1], like),
            sizes[FLICKER_SIZE, 2] * flicker_step(poles, gains, memory, 2, x[2], like),
        )
        store_several(memory, _BEFORE, like, now)
        bias = combine(1.0, bias, 0.5, add(before, now))
        drift = combine(1.0, drift, dt, now)
    if terms[3]:
        drift = add(drift, matrix_times_vector(nine(memory, _MATRIX, like), true_increment))
    return bias, add(drift, by_axis(white, sizes, WHITE_SIGMA))


def sensor_noise(e, events, draws, like):
    """Return the noise of a measurement: white by component, outliers and correlated noise."""
    streams, ahead, memory = draws.streams, draws.ahead, draws.memory
    sensor, number, share = events.sensor[e], events.number[e], events.share[e]
    struck_below = events.struck_below[sensor]
    mine = _SENSORS + _OF_A_SENSOR * sensor
    source = SENSORS + 2 * sensor
    white = normal_triple(streams, source, ahead, number, like)
    noise = by_axis(white, events.sigma, e)
    if struck_below > np.uint64(0) or share > 0.0:
        s0, s1, s2, s3 = four(streams, 4 * (source + 1), like)
        word, s0, s1, s2, s3 = next_word(s0, s1, s2, s3)
        larger = select(word < struck_below, like - like + events.outlier_scale[sensor], 1.0)
        noise = scale(larger, noise)
        store_several(streams, 4 * (source + 1), like, (s0, s1, s2, s3))
        if share > 0.0:
            refill(streams, source + 1, ahead, 4, like)
            drive = scale(share, drawn_triple(ahead, source + 1, 0, like))
            if number > 0:
                drive = combine(events.decay[e], triple(memory, mine, like), 1.0, drive)
            store_several(memory, mine, like, drive)
            noise = add(noise, drive)
    return noise


def keep(kept, row, like, q, b, A, B, C, bias):
    """Write the :data:`KEPT` values of an epoch."""
    store_several(kept, row * KEPT, like, (*q, *b, *A, *B, *C, *bias))


def update(q, b, A, B, C, e, events, draws, out, detail, like):
    """Draw measurement e, update the filter with it, and return its state; the NIS is added to that of its sensor and span of time."""
    noise = sensor_noise(e, events, draws, like)
    exact, kind = events.exact, events.kind[e]
    spans = len(out.nis) // (len(like) * max(len(events.struck_below), 1))
    place = events.sensor[e] * spans + events.span[e]
    one = like + 1.0
    e2 = like
    s2 = one
    e3 = like
    s3 = one
    z0 = like
    if kind == ATTITUDE:
        measured = quaternion_multiply((exact[e, 0], exact[e, 1], exact[e, 2], exact[e, 3]), exponential(noise))
        y = rotation_vector(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), measured))
        q, b, A, B, C, e1, s1, e2, s2, e3, s3 = update_residual(q, b, A, B, C, y, vector_at(events.variance, e))
        chi = e1 * e1 / s1 + e2 * e2 / s2 + e3 * e3 / s3
        z = (measured[1], measured[2], measured[3])
        z0 = measured[0]
    else:
        z = add(vector_at(exact, e), noise)
        frame = frame_at(events.frames, events.frame[e])
        R = rotation_matrix(q)
        r = frame[6:]
        variance = events.variance[e, 0]
        if kind != VECTOR:
            z = scale(inverse_root(dot(z, z)), z)
        if kind == HEADING:
            m = matrix_times_vector(R, z)
            error = arctangent(m[0] * r[1] - m[1] * r[0], m[0] * r[0] + m[1] * r[1])
            q, b, A, B, C, e1, s1 = update_heading(q, b, A, B, C, heading_row(R, z), error, variance)
            chi = e1 * e1 / s1
        else:
            q, b, A, B, C, e1, s1, e2, s2, chi = update_direction_and_judge(
                q, b, A, B, C, R, frame[:3], frame[3:6], z, variance
            )
            if kind == VECTOR:
                e3 = dot(transpose_times_vector(R, r), z) - 1.0
                s3 = variance * one
                chi = chi + e3 * e3 / variance
    store(out.nis, place * len(like), load_like(out.nis, place * len(like), like) + chi)
    if detail is not None:
        store_several(detail.values, 4 * e, like, (z0, z[0], z[1], z[2]))
        store_several(detail.innovations, 6 * e, like, (e1, s1, e2, s2, e3, s3))
    return q, b, A, B, C


def filter_start(bias, start, draws, like):
    """Return the initial attitude and bias of the filter: the truth minus the error drawn."""
    x = drawn_triple(draws.ahead, START, 0, like)
    y = drawn_triple(draws.ahead, START, 3, like)
    given = start.error
    error = combine(given[0], x, 1.0, (given[2], given[3], given[4]))
    attitude = (start.attitude[0], start.attitude[1], start.attitude[2], start.attitude[3])
    q = unit(quaternion_multiply(attitude, exponential((-error[0], -error[1], -error[2]))))
    return q, subtract(bias, combine(given[1], y, 1.0, (given[5], given[6], given[7])))


def advance(pattern, numbers, keys, gyro, start, events, every, draws, out, detail):
    """Compute the ``len(pattern)`` runs ``numbers`` over a whole scenario.

    Parameters
    ----------
    pattern : tuple of floats, one per run
        Its length and type define the lanes.
    numbers : array of words (W,)
    keys : array of words (sources, 2)
    gyro : Gyro
    start : Start
    events : Events
    every : int
        Number of steps between stored epochs.
    draws : Draws
    out : Outputs
    detail : Detail or None
    """
    like = lanes_of(pattern)
    one = like + 1.0
    count = len(events.time)
    edges = gyro.edges
    steps = len(gyro.increments)
    start_streams(keys, numbers, draws, like)
    start_gyro(gyro, draws, like)
    q = (one, like, like, like)
    b = (like, like, like)
    A = (start.variance[0] * one, like, like, start.variance[0] * one, like, start.variance[0] * one)
    B = (like, like, like, like, like, like, like, like, like)
    C = (start.variance[1] * one, like, like, start.variance[1] * one, like, start.variance[1] * one)
    theta = (like, like, like)
    e = 0
    countdown = 0
    row = 0
    now = edges[0]
    whole = 0.0
    longest = 1.0
    for k in range(-1, steps):
        end = edges[k + 1]
        while k >= 0:
            due = e < count and events.time[e] <= end
            stop = events.time[e] if due else end
            dt = stop - now
            if dt > 0.0:
                if dt > longest:
                    dt = longest
                    stop = now + dt
                    due = False
                part = theta
                if dt < whole:
                    part = scale(dt / whole, theta)
                q, A, B, C = predict(q, b, A, B, C, part, dt, start.noise[0], start.noise[1])
                now = stop
            if due:
                q, b, A, B, C = update(q, b, A, B, C, e, events, draws, out, detail, like)
                e += 1
            if now >= end and (e == count or events.time[e] > end):
                break
        i = min(k + 1, steps - 1)
        whole = edges[i + 1] - edges[i]
        bias, drift = drift_step(gyro, k + 1, whole, vector_at(gyro.true_increments, i), draws, like)
        theta = add(vector_at(gyro.increments, i), drift)
        bias = add(vector_at(gyro.true_bias, k + 1), bias)
        longest = gyro.substeps[i]
        if detail is not None and k + 1 < steps:
            store_several(detail.increments, 3 * (k + 1), like, theta)
        if k < 0:
            q, b = filter_start(bias, start, draws, like)
        if countdown == 0:
            countdown = every
            keep(out.kept, row, like, q, b, A, B, C, bias)
            row += 1
        countdown -= 1
