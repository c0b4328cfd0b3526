"""Runs of a Monte Carlo over lanes: gyro errors, sensors and filter of 1, 8 or 16 runs at once, along one motion that all share.

The truth, the times and all that is the same in every run come in as plain arrays; what differs is lanes. Each run draws from streams of
its own (:func:`strapdown.kernels.noise.stream_state` of a key a source and the run's number), so it is the same whoever its neighbours are.
Noise is exact in discrete time, by the formulas of :mod:`strapdown.kernels.gyro_errors`; the filter is that of
:mod:`strapdown.kernels.filter_step`.

Lanes in memory lie one after the other, so place p of a flat array begins at ``p · len(like)``.
"""

from __future__ import annotations

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
    chosen,
    flush_tiny,
    halves,
    lanes_of,
    load_like,
    narrowed,
    restore_mode,
    store_like,
)
from strapdown.kernels.measurement import ATTITUDE, HEADING, VECTOR, heading_row
from strapdown.kernels.noise import next_word, single_normals, stream_state
from strapdown.kernels.rotation import exponential, quaternion_multiply, rotation_matrix, unit

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""

GYRO, FLICKER, MARKOV, TURN_ON, START, DISPERSIONS, SENSORS = range(7)
"""Sources of noise: streams of a run. Two a sensor follow, from SENSORS on: its white noise, and its faults."""

STATES = 16
"""States of the flicker of an axis."""

# Places in the memory of a group of runs.
_WALK, _MARKOV, _TURN_ON, _BEFORE, _MATRIX, _STATES = 0, 3, 6, 9, 12, 21
_SENSORS = _STATES + 3 * STATES
_OF_A_SENSOR = 3
"""The correlated noise."""

TRIPLES = 32
AHEAD = 3 * TRIPLES
"""Normals that a source has drawn ahead: a loop of their own is faster than a few at a time between the filter's steps."""

KEPT = 31
"""Numbers kept at an epoch: q (4), b (3), P in blocks (21), true bias (3)."""

WHITE_SIGMA, WALK_SIGMA, MARKOV_DECAY, MARKOV_SIGMA, MARKOV_MEAN, MARKOV_START, TURN_ON_SIGMA, FLICKER_SIZE = range(8)
"""Rows of ``gyro``: what a step's noise is by axis. σ of the increment given the bias at both ends, σ of the walk's step, decay of the
Markov bias, σ of its step, what its ends add to the increment, σ at the start, σ of the turn-on bias, flicker B."""


def memory(sensors):
    """Return how many places the memory of a group needs."""
    return _SENSORS + _OF_A_SENSOR * sensors


def stored_stream(streams, place, like):
    """Return the four words of state of the streams in as many lanes as ``like`` has, at ``place`` of a flat array."""
    n = len(like)
    return (
        load_like(streams, place, like),
        load_like(streams, place + n, like),
        load_like(streams, place + 2 * n, like),
        load_like(streams, place + 3 * n, like),
    )


def store_stream(streams, place, like, s0, s1, s2, s3):
    """Write what :func:`stored_stream` reads."""
    n = len(like)
    store_like(streams, place, s0)
    store_like(streams, place + n, s1)
    store_like(streams, place + 2 * n, s2)
    store_like(streams, place + 3 * n, s3)


def triple(memory, place, like):
    """Return three neighbouring places."""
    n = len(like)
    return (
        load_like(memory, place * n, like),
        load_like(memory, (place + 1) * n, like),
        load_like(memory, (place + 2) * n, like),
    )


def store_triple(memory, place, like, v):
    """Write three neighbouring places."""
    n = len(like)
    store_like(memory, place * n, v[0])
    store_like(memory, (place + 1) * n, v[1])
    store_like(memory, (place + 2) * n, v[2])


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
    place = 4 * source * n
    begin = AHEAD * source * n
    s0, s1, s2, s3 = stored_stream(streams, place, like)
    for at in range(begin, begin + count * n, 4 * n):
        x, y, s0, s1, s2, s3 = next_four(s0, s1, s2, s3)
        store_like(ahead, at, x)
        store_like(ahead, at + 2 * n, y)
    store_stream(streams, place, like, s0, s1, s2, s3)


def drawn(ahead, source, index, like):
    """Return the normal of a source at a place among those drawn ahead."""
    return narrowed(load_like(ahead, (AHEAD * source + index) * len(like), like), like)


def drawn_triple(ahead, source, index, like):
    """Return three neighbouring normals."""
    return (
        drawn(ahead, source, index, like),
        drawn(ahead, source, index + 1, like),
        drawn(ahead, source, index + 2, like),
    )


def normal_triple(streams, source, ahead, number, like):
    """Return the 3-vector of normals of this number, from 0 on, of a source; they are asked for one after the other."""
    turn = number & (TRIPLES - 1)
    if turn == 0:
        refill(streams, source, ahead, AHEAD, like)
    return drawn_triple(ahead, source, 3 * turn, like)


def fill_with_normals(pattern, k0, k1, numbers, out):
    """Fill out (flat, places a multiple of four) with the normals of the streams of these runs under the key (k0, k1)."""
    like = lanes_of(pattern)
    n = len(like)
    s0, s1, s2, s3 = stream_state(k0, k1, load_like(numbers, 0, like))
    for at in range(0, len(out), 4 * n):
        x, y, s0, s1, s2, s3 = next_four(s0, s1, s2, s3)
        store_like(out, at, x)
        store_like(out, at + 2 * n, y)


def start_streams(keys, numbers, streams, ahead, like):
    """Fill the states of all streams of the runs of these numbers, ``keys`` (sources, 2), and draw what a run starts with."""
    number = load_like(numbers, 0, like)
    for source in range(len(keys)):
        s0, s1, s2, s3 = stream_state(keys[source, 0], keys[source, 1], number)
        store_stream(streams, 4 * source * len(like), like, s0, s1, s2, s3)
    for source in (FLICKER, TURN_ON, START, DISPERSIONS):
        refill(streams, source, ahead, 3 * STATES, like)


def start_gyro(gyro, poles_start, dispersion, ahead, memory, like):
    """Draw what a run's gyro starts with: turn-on bias, Markov bias, flicker states, error matrix."""
    n = len(like)
    x = drawn_triple(ahead, TURN_ON, 0, like)
    y = drawn_triple(ahead, TURN_ON, 3, like)
    for i in range(3):
        store_like(memory, (_WALK + i) * n, lanes_zero(like))
    store_triple(
        memory,
        _TURN_ON,
        like,
        (x[0] * gyro[TURN_ON_SIGMA, 0], x[1] * gyro[TURN_ON_SIGMA, 1], x[2] * gyro[TURN_ON_SIGMA, 2]),
    )
    store_triple(
        memory,
        _MARKOV,
        like,
        (y[0] * gyro[MARKOV_START, 0], y[1] * gyro[MARKOV_START, 1], y[2] * gyro[MARKOV_START, 2]),
    )
    for i in range(3 * STATES):
        store_like(memory, (_STATES + i) * n, lanes_zero(like))
    if len(poles_start) > 0:
        for axis in range(3):
            for j in range(0, STATES, 2):
                x0 = drawn(ahead, FLICKER, axis * STATES + j, like)
                x1 = drawn(ahead, FLICKER, axis * STATES + j + 1, like)
                for i in range(j, STATES):
                    at = (_STATES + axis * STATES + i) * n
                    state = load_like(memory, at, like) + poles_start[i, j] * x0
                    store_like(memory, at, state + poles_start[i, j + 1] * x1)
    for row in range(3):
        x = drawn_triple(ahead, DISPERSIONS, 3 * row, like)
        store_triple(
            memory,
            _MATRIX + 3 * row,
            like,
            (x[0] * dispersion[row, 0], x[1] * dispersion[row, 1], x[2] * dispersion[row, 2]),
        )


def lanes_zero(like):
    """Return zeros of the kind of ``like``."""
    return like - like


def flicker_step(poles, gains, memory, axis, w, like):
    """Advance the flicker of one axis by a normal; return its value for B = 1."""
    n = len(like)
    base = (_STATES + axis * STATES) * n
    even = lanes_zero(like)
    odd = lanes_zero(like)
    for i in range(0, STATES, 2):
        at = base + i * n
        a = poles[i] * load_like(memory, at, like) + w
        b = poles[i + 1] * load_like(memory, at + n, like) + w
        store_like(memory, at, a)
        store_like(memory, at + n, b)
        even = even + gains[i] * a
        odd = odd + gains[i + 1] * b
    return even + odd


def flicker_value(gains, memory, axis, like):
    """Return the flicker of the states as they are, for B = 1."""
    n = len(like)
    base = (_STATES + axis * STATES) * n
    value = lanes_zero(like)
    for i in range(STATES):
        value = value + gains[i] * load_like(memory, base + i * n, like)
    return value


def drift_step(terms, gyro, poles, gains, k, dt, true_increment, memory, streams, ahead, like):
    """Draw interval k of the gyro; return the bias at its start and what the noise adds to its increment.

    The bias is without its part common to all runs. ``terms`` tells which noises there are: (walk, Markov, flicker, matrix).
    """
    walk = triple(memory, _WALK, like)
    turn_on = triple(memory, _TURN_ON, like)
    bias = add(walk, turn_on)
    if terms[0]:
        white = normal_triple(streams, GYRO, ahead, 2 * k, like)
        steps = normal_triple(streams, GYRO, ahead, 2 * k + 1, like)
        after = (
            walk[0] + gyro[WALK_SIGMA, 0] * steps[0],
            walk[1] + gyro[WALK_SIGMA, 1] * steps[1],
            walk[2] + gyro[WALK_SIGMA, 2] * steps[2],
        )
        store_triple(memory, _WALK, like, after)
        drift = combine(dt, turn_on, 0.5 * dt, add(walk, after))
    else:
        white = normal_triple(streams, GYRO, ahead, k, like)
        bias = turn_on
        drift = scale(dt, turn_on)
    if terms[1]:
        g = triple(memory, _MARKOV, like)
        x = normal_triple(streams, MARKOV, ahead, k, like)
        after = (
            gyro[MARKOV_DECAY, 0] * g[0] + gyro[MARKOV_SIGMA, 0] * x[0],
            gyro[MARKOV_DECAY, 1] * g[1] + gyro[MARKOV_SIGMA, 1] * x[1],
            gyro[MARKOV_DECAY, 2] * g[2] + gyro[MARKOV_SIGMA, 2] * x[2],
        )
        store_triple(memory, _MARKOV, like, after)
        bias = add(bias, g)
        drift = (
            drift[0] + gyro[MARKOV_MEAN, 0] * (g[0] + after[0]),
            drift[1] + gyro[MARKOV_MEAN, 1] * (g[1] + after[1]),
            drift[2] + gyro[MARKOV_MEAN, 2] * (g[2] + after[2]),
        )
    if terms[2]:
        if k == 0:
            for axis in range(3):
                value = gyro[FLICKER_SIZE, axis] * flicker_value(gains, memory, axis, like)
                store_like(memory, (_BEFORE + axis) * len(like), value)
        x = normal_triple(streams, FLICKER, ahead, k, like)
        before = triple(memory, _BEFORE, like)
        now = (
            gyro[FLICKER_SIZE, 0] * flicker_step(poles, gains, memory, 0, x[0], like),
            gyro[FLICKER_SIZE, 1] * flicker_step(poles, gains, memory, 1, x[1], like),
            gyro[FLICKER_SIZE, 2] * flicker_step(poles, gains, memory, 2, x[2], like),
        )
        store_triple(memory, _BEFORE, like, now)
        bias = combine(1.0, bias, 0.5, add(before, now))
        drift = combine(1.0, drift, dt, now)
    if terms[3]:
        M = (
            *triple(memory, _MATRIX, like),
            *triple(memory, _MATRIX + 3, like),
            *triple(memory, _MATRIX + 6, like),
        )
        drift = add(drift, matrix_times_vector(M, true_increment))
    drift = (
        drift[0] + gyro[WHITE_SIGMA, 0] * white[0],
        drift[1] + gyro[WHITE_SIGMA, 1] * white[1],
        drift[2] + gyro[WHITE_SIGMA, 2] * white[2],
    )
    return bias, drift


def sensor_noise(sensor, sigma, decay, share, struck_below, outlier_scale, number, memory, streams, ahead, like):
    """Return the noise of a sensor's measurement of this number: white, of ``sigma`` by component, outliers and correlated noise."""
    mine = _SENSORS + _OF_A_SENSOR * sensor
    source = SENSORS + 2 * sensor
    white = normal_triple(streams, source, ahead, number, like)
    noise = (sigma[0] * white[0], sigma[1] * white[1], sigma[2] * white[2])
    if struck_below > np.uint64(0) or share > 0.0:
        place = 4 * (source + 1) * len(like)
        s0, s1, s2, s3 = stored_stream(streams, place, like)
        word, s0, s1, s2, s3 = next_word(s0, s1, s2, s3)
        larger = chosen(word < struck_below, like - like + outlier_scale, 1.0)
        noise = (larger * noise[0], larger * noise[1], larger * noise[2])
        store_stream(streams, place, like, s0, s1, s2, s3)
        if share > 0.0:
            refill(streams, source + 1, ahead, 4, like)
            drive = scale(share, drawn_triple(ahead, source + 1, 0, like))
            if number > 0:
                drive = combine(decay, triple(memory, mine, like), 1.0, drive)
            store_triple(memory, mine, like, drive)
            noise = add(noise, drive)
    return noise


def keep(kept, row, like, q, b, A, B, C, bias):
    """Write one epoch: :data:`KEPT` places."""
    n = len(like)
    at = row * KEPT * n
    for i in range(4):
        store_like(kept, at + i * n, q[i])
    for i in range(6):
        store_like(kept, at + (7 + i) * n, A[i])
        store_like(kept, at + (22 + i) * n, C[i])
    for i in range(9):
        store_like(kept, at + (13 + i) * n, B[i])
    for i in range(3):
        store_like(kept, at + (4 + i) * n, b[i])
        store_like(kept, at + (28 + i) * n, bias[i])


def add_nis(nis, place, like, value):
    """Add lanes to a place."""
    at = place * len(like)
    store_like(nis, at, load_like(nis, at, like) + value)


def advance(
    pattern,
    numbers,
    keys,
    edges,
    substeps,
    increments,
    true_increments,
    true_bias,
    first_attitude,
    terms,
    gyro,
    poles,
    gains,
    poles_start,
    dispersion,
    start,
    believed,
    event_time,
    event_kind,
    event_sensor,
    event_bin,
    event_exact,
    event_sigma,
    event_variance,
    event_decay,
    event_share,
    event_count,
    event_frame,
    frames,
    struck_below,
    outlier_scale,
    every,
    streams,
    ahead,
    memory,
    kept,
    nis,
    increments_out,
    values_out,
    innovations_out,
):
    """Run ``len(pattern)`` runs of the given numbers over a whole scenario.

    Parameters
    ----------
    pattern : tuple of floats, one a run
        Its length and type are those of the lanes.
    numbers : array of words (W,)
    keys : array of words (sources, 2)
    edges : array (n + 1,)
        Edges of the filter's steps, s.
    substeps : array (n,)
        The longest time that the filter may predict over at once in each step, s. Beyond the range of the polynomials a step is made of
        several: at constant rate they compose exactly, so this is the same model.
    increments, true_increments : array (n, 3)
        What the gyro gives without any error that differs from run to run, and the true turns, rad.
    true_bias : array (n + 1, 3)
        The part of the bias that all runs share, rad/s.
    first_attitude : array (4,)
    terms, gyro : array (4,) of booleans, (8, 3)
        :func:`drift_step`, :data:`FLICKER_SIZE`.
    poles, gains, poles_start : array (16,), (16,), (16, 16) or (0, 16)
        Flicker (:class:`strapdown.flicker.Shaping`) and what makes stationary states of normals.
    dispersion : array (3, 3)
        σ of the entries of the gyro's error matrix.
    start : array (14,)
        σ of the true initial error (δθ, δb), its fixed part (6), the filter's prior variances of attitude and bias.
    believed : array (2,)
        σ_v² and σ_u² of the filter.
    event_… : arrays (events, …)
        Measurements in order of time: kind (:mod:`strapdown.kernels.filter_loop`), sensor, span of time for the NIS, value without noise
        (4: a vector or a quaternion), σ (3), the filter's variance (3), decay and share of correlated noise, number among its sensor's,
        row of ``frames`` (rows, 9: triads).
    struck_below, outlier_scale : arrays (sensors,)
        Word below which a measurement is an outlier; 0 for none.
    every : int
        Steps from one kept epoch to the next.
    streams, ahead, memory, kept, nis : arrays
        Flat: states of the streams, :data:`AHEAD` normals a source (singles), places of :func:`memory`, :data:`KEPT` numbers an epoch,
        NIS by sensor and span of time. ``nis`` is added to.
    increments_out, values_out, innovations_out : arrays
        Flat, 3 an interval, 4 and 6 an event, or None: what the sensors gave, and e₁, s₁, e₂, s₂, e₃, s₃.
    """
    like = lanes_of(pattern)
    n = len(like)
    one = like + 1.0
    mode = flush_tiny(like)
    events = len(event_time)
    steps = len(increments)
    bins = len(nis) // (n * max(len(struck_below), 1))
    start_streams(keys, numbers, streams, ahead, like)
    start_gyro(gyro, poles_start, dispersion, ahead, memory, like)
    q = (one, like, like, like)
    b = (like, like, like)
    A = (start[8] * one, like, like, start[8] * one, like, start[8] * one)
    B = (like, like, like, like, like, like, like, like, like)
    C = (start[9] * one, like, like, start[9] * one, like, start[9] * one)
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
            due = e < events and event_time[e] <= end
            stop = event_time[e] if due else end
            dt = stop - now
            if dt > 0.0:
                if dt > longest:
                    dt = longest
                    stop = now + dt
                    due = False
                part = theta
                if dt < whole:
                    part = scale(dt / whole, theta)
                q, A, B, C = predict(q, b, A, B, C, part, dt, believed[0], believed[1])
                now = stop
            if due:
                sensor = event_sensor[e]
                noise = sensor_noise(
                    sensor,
                    (event_sigma[e, 0], event_sigma[e, 1], event_sigma[e, 2]),
                    event_decay[e],
                    event_share[e],
                    struck_below[sensor],
                    outlier_scale[sensor],
                    event_count[e],
                    memory,
                    streams,
                    ahead,
                    like,
                )
                exact = (event_exact[e, 0], event_exact[e, 1], event_exact[e, 2])
                place = sensor * bins + event_bin[e]
                e3 = like
                s3 = one
                if event_kind[e] == ATTITUDE:
                    whole_attitude = (event_exact[e, 0], event_exact[e, 1], event_exact[e, 2], event_exact[e, 3])
                    measured = quaternion_multiply(whole_attitude, exponential(noise))
                    y = rotation_vector(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), measured))
                    variances = (event_variance[e, 0], event_variance[e, 1], event_variance[e, 2])
                    q, b, A, B, C, e1, s1, e2, s2, e3, s3 = update_residual(q, b, A, B, C, y, variances)
                    add_nis(nis, place, like, e1 * e1 / s1 + e2 * e2 / s2 + e3 * e3 / s3)
                    z = (measured[1], measured[2], measured[3])
                    z0 = measured[0]
                else:
                    z0 = like
                    z = add(exact, noise)
                    t = event_frame[e]
                    R = rotation_matrix(q)
                    r = (frames[t, 6], frames[t, 7], frames[t, 8])
                    variance = event_variance[e, 0]
                    if event_kind[e] != VECTOR:
                        z = scale(inverse_root(dot(z, z)), z)
                    if event_kind[e] == HEADING:
                        m = matrix_times_vector(R, z)
                        error = arctangent(m[0] * r[1] - m[1] * r[0], m[0] * r[0] + m[1] * r[1])
                        q, b, A, B, C, e1, s1 = update_heading(q, b, A, B, C, heading_row(R, z), error, variance)
                        add_nis(nis, place, like, e1 * e1 / s1)
                        e2 = like
                        s2 = one
                    else:
                        u = (frames[t, 0], frames[t, 1], frames[t, 2])
                        v = (frames[t, 3], frames[t, 4], frames[t, 5])
                        q, b, A, B, C, e1, s1, e2, s2, chi = update_direction_and_judge(
                            q, b, A, B, C, R, u, v, z, variance
                        )
                        if event_kind[e] == VECTOR:
                            e3 = dot(transpose_times_vector(R, r), z) - 1.0
                            s3 = variance * one
                            chi = chi + e3 * e3 / variance
                        add_nis(nis, place, like, chi)
                if values_out is not None:
                    at = 4 * e * n
                    store_like(values_out, at, z0)
                    store_like(values_out, at + n, z[0])
                    store_like(values_out, at + 2 * n, z[1])
                    store_like(values_out, at + 3 * n, z[2])
                    at = 6 * e * n
                    store_like(innovations_out, at, e1)
                    store_like(innovations_out, at + n, s1)
                    store_like(innovations_out, at + 2 * n, e2)
                    store_like(innovations_out, at + 3 * n, s2)
                    store_like(innovations_out, at + 4 * n, e3)
                    store_like(innovations_out, at + 5 * n, s3)
                e += 1
            elif now >= end:
                break
        i = min(k + 1, steps - 1)
        whole = edges[i + 1] - edges[i]
        true_increment = (true_increments[i, 0], true_increments[i, 1], true_increments[i, 2])
        given = (increments[i, 0], increments[i, 1], increments[i, 2])
        bias, drift = drift_step(terms, gyro, poles, gains, k + 1, whole, true_increment, memory, streams, ahead, like)
        theta = add(given, drift)
        bias = add((true_bias[k + 1, 0], true_bias[k + 1, 1], true_bias[k + 1, 2]), bias)
        longest = substeps[i]
        if increments_out is not None and k + 1 < steps:
            store_triple(increments_out, 3 * (k + 1), like, theta)
        if k < 0:
            x = drawn_triple(ahead, START, 0, like)
            y = drawn_triple(ahead, START, 3, like)
            error = combine(start[0], x, 1.0, (start[2], start[3], start[4]))
            initial = (first_attitude[0], first_attitude[1], first_attitude[2], first_attitude[3])
            q = unit(quaternion_multiply(initial, exponential((-error[0], -error[1], -error[2]))))
            b = subtract(bias, combine(start[1], y, 1.0, (start[5], start[6], start[7])))
        if countdown == 0:
            countdown = every
            keep(kept, row, like, q, b, A, B, C, bias)
            row += 1
        countdown -= 1
    restore_mode(mode)
