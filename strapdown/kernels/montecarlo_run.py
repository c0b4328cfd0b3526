"""Monte Carlo runs in lanes (SIMD): gyro errors, sensors and filter of eight runs at once along one motion; run by the walk.

Truth, times and all else common to the runs are plain arrays; values that differ between runs are lanes. Each run has its own random
streams (:func:`strapdown.kernels.noise.stream_state`, with one key per source and the run's number), so it does not depend on its
neighbours. Noise is exact in discrete time, by the formulas of :mod:`strapdown.kernels.gyro_errors`. It is drawn before each interval and
each measurement. The filter defines the functions in ``OPEN``: :mod:`strapdown.kernels.montecarlo_six` or
:mod:`strapdown.kernels.montecarlo_filter`.

In memory lanes are contiguous, so place p of a flat array begins at ``p · WIDTH``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import add, combine, dot, matrix_times_vector, scale, subtract
from strapdown.kernels.lane_angles import inverse_root
from strapdown.kernels.lane_values import WIDTH, broadcast, halves, lanes_of, load_like, narrowed, select, store
from strapdown.kernels.measurement import ATTITUDE, KIND, VECTOR, frame_at, quaternion_at, vector_at
from strapdown.kernels.noise import next_word, single_normals, stream_state
from strapdown.kernels.rotation import exponential, quaternion_multiply, unit
from strapdown.kernels.structure import Body as Filter

OPEN = ("start_filters", "propagated", "corrected", "keep_filters")
PATTERN = (0.0,) * WIDTH
"""Gives the number of runs."""

GYRO, FLICKER, MARKOV, TURN_ON, START, SENSORS = range(6)
"""Sources of noise: random streams of a run. From SENSORS on there are two per sensor: its white noise and its faults."""

STATES = 16
"""Number of flicker states of an axis."""

# Places in the memory of a group of runs: of the gyro, then of each sensor its correlated noise.
_WALK, _MARKOV, _TURN_ON, _BEFORE, _NOW, _STATES = 0, 3, 6, 9, 12, 15
_SENSORS = _STATES + 3 * STATES

# Places in what differs between units: gyro error matrix, sensitivity to specific force, turn-on bias; of each sensor offset, lever arm.
_MATRIX, _FORCE, _CONSTANT, _OFFSETS = 0, 9, 18, 21

TRIPLES = 32
AHEAD = 3 * TRIPLES
"""Number of normals drawn ahead for each source: drawing many in one loop is faster than a few between the steps of the filter."""

KEPT = 31
"""Number of values stored at an epoch: q (4), whole bias (3), their covariance in blocks (21), true bias (3)."""

WHITE_SIGMA, WALK_SIGMA, MARKOV_DECAY, MARKOV_SIGMA, MARKOV_MEAN, MARKOV_START, TURN_ON_SIGMA, FLICKER_SIZE = range(8)
RANGE, RESOLUTION = 8, 9
"""Rows of ``sizes``, by axis: σ of the increment given the bias at both ends, σ of the step of the random walk, decay of the Markov bias, σ
of its step, weight of its end values in the increment, its initial σ, σ of the turn-on bias, flicker B; maximum and resolution of the
rate."""

_ROUNDING = 6755399441055744.0
"""1.5 · 2^52: added and subtracted, it rounds a number to the nearest integer."""


class Gyro(NamedTuple):
    """Gyro over n steps of the filter; the walk has its increments without the errors that differ between runs."""

    edges: np.ndarray
    """Edges of the steps (n + 1,), s."""
    substeps: np.ndarray
    """Maximum duration of one prediction of the filter in each step (n,), s. A step beyond the range of the polynomials is divided; at
    constant rate the parts compose exactly, so the model is the same."""
    true_increments: np.ndarray
    """(n, 3), rad."""
    true_force: np.ndarray
    """Integrals of the specific force in body axes (n, 3), m/s; no rows if the runs do not differ in the gyro's sensitivity to it."""
    true_bias: np.ndarray
    """Part of the bias common to all runs at the epochs kept (rows, 3), rad/s."""
    terms: np.ndarray
    """Whether each term is present (6,): random walk, Markov, flicker, units that differ, limited range, resolution."""
    sizes: np.ndarray
    """Sizes by axis (10, 3), rows :data:`WHITE_SIGMA` to :data:`RESOLUTION`."""
    poles: np.ndarray
    gains: np.ndarray
    poles_start: np.ndarray
    """Flicker (:class:`strapdown.gyro.flicker.Shaping`) (16,), (16,), and the root of its stationary covariance (16, 16) or (0, 16)."""


class Start(NamedTuple):
    """Initial state, at the first edge."""

    attitude: np.ndarray
    """True attitude (4,)."""
    error: np.ndarray
    """True initial error (8,): σ of δθ and δb, then the part common to all runs (6)."""
    P: np.ndarray
    """Initial covariance of the filter (n, n)."""
    fast: float
    """Variance of the bias with a bandwidth above that of the filter's states, which the initial covariance contains."""


class Events(NamedTuple):
    """Measurements in order of time (m,), beside the walk's."""

    span: np.ndarray
    """Time bin of the NIS."""
    exact: np.ndarray
    """Value without noise (m, 4): a vector or a quaternion."""
    sigma: np.ndarray
    """True σ (m, 3)."""
    scale: np.ndarray
    """Size of an offset of the sensor in the value."""
    turning: np.ndarray
    """Acceleration per lever arm, ``[ẇ] + [w]²`` by rows (m, 9); no rows if the runs do not differ in lever arms."""
    decay: np.ndarray
    share: np.ndarray
    """Decay of the correlated noise since the sensor's last measurement, and σ of its new part."""
    number: np.ndarray
    """Index among the measurements of its sensor."""
    boresight: np.ndarray
    """For each sensor its boresight, and σ about it less σ across it (sensors, 4), 0 if the noise is independent by axis."""
    struck_below: np.ndarray
    """For each sensor, the random word below which a measurement is an outlier; 0: no outliers."""
    outlier_scale: np.ndarray


class Draws(NamedTuple):
    """Random streams and memory of a group of runs, flat."""

    numbers: np.ndarray
    """Numbers of the runs, words (WIDTH,)."""
    keys: np.ndarray
    """Words (sources, 2)."""
    streams: np.ndarray
    """States of the streams."""
    ahead: np.ndarray
    """:data:`AHEAD` normals per source, in single precision."""
    memory: np.ndarray
    """See :func:`memory`."""
    units: np.ndarray
    """Differences of the runs' gyros and sensors from the common ones, see :func:`units`."""
    innovation: np.ndarray
    """Scratch: e₁, s₁, e₂, s₂, e₃, s₃ and the NIS of a measurement."""
    increments: np.ndarray
    """Measured increments, 3 per interval; empty except for a replay."""
    longest: np.ndarray
    """Scratch: longest prediction in the present step (1,), s."""


class Body(NamedTuple):
    """Filters and simulation of a group of runs."""

    filters: Filter
    gyro: Gyro
    start: Start
    events: Events
    draws: Draws


class Outputs(NamedTuple):
    """Outputs of a group of runs, flat; the last two are empty except for a replay."""

    kept: np.ndarray
    """:data:`KEPT` numbers per epoch."""
    nis: np.ndarray
    """Sum of the NIS by sensor and time bin; updates add to it."""
    values: np.ndarray
    """Measured value and innovations e₁, s₁, e₂, s₂, e₃, s₃ of each measurement, 10 numbers."""
    states: np.ndarray
    """Values, then variances, of the error states per epoch."""


def start_filters(q, b, body, like):
    """Return the filters with this attitude and bias and the initial covariance; ``lost`` of theirs: a measurement was too precise."""


def propagated(state, part, dt, body, like):
    """Return the filters after an increment."""


def corrected(state, value, e, measured, body, like):
    """Return the filters after measurement e, a vector or an attitude (4), its NIS, and e₁, s₁, e₂, s₂, e₃, s₃."""


def keep_filters(state, row, body, out, like):
    """Write q, b and the blocks of their covariance to a row of what is kept, and for a replay the error states to theirs."""


def memory(sensors):
    """Return the number of places in the memory of a group."""
    return _SENSORS + 3 * sensors


def units(sensors):
    """Return the number of places of what differs between the units of the runs."""
    return _OFFSETS + 6 * sensors


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


def start_streams(draws, like):
    """Set the states of all streams of the runs, and draw the normals of their initial values."""
    number, keys = load_like(draws.numbers, 0, like), draws.keys
    for source in range(len(keys)):
        store_several(draws.streams, 4 * source, like, stream_state(keys[source, 0], keys[source, 1], number))
    for source in (FLICKER, TURN_ON, START):
        refill(draws.streams, source, draws.ahead, 3 * STATES, like)


def start_gyro(gyro, draws, like):
    """Draw what a run's gyro starts with: turn-on bias, Markov bias, flicker states."""
    n = len(like)
    sizes, poles_start = gyro.sizes, gyro.poles_start
    ahead, memory = draws.ahead, draws.memory
    store_several(memory, _WALK, like, (like, like, like))
    turn_on = by_axis(drawn_triple(ahead, TURN_ON, 0, like), sizes, TURN_ON_SIGMA)
    store_several(memory, _TURN_ON, like, add(turn_on, triple(draws.units, _CONSTANT, like)))
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
        for axis in range(3):
            value = gyro.sizes[FLICKER_SIZE, axis] * flicker_value(gyro.gains, memory, axis, like)
            store(memory, (_NOW + axis) * n, value)
        draw_flicker(gyro, 0 * n, draws, like)


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


def draw_flicker(gyro, number, draws, like):
    """Draw the flicker of interval ``number``: it is drawn an interval ahead, for the mean over the two intervals at an edge."""
    sizes, poles, gains, memory = gyro.sizes, gyro.poles, gyro.gains, draws.memory
    x = normal_triple(draws.streams, FLICKER, draws.ahead, number, like)
    store_several(memory, _BEFORE, like, triple(memory, _NOW, like))
    now = (
        sizes[FLICKER_SIZE, 0] * flicker_step(poles, gains, memory, 0, x[0], like),
        sizes[FLICKER_SIZE, 1] * flicker_step(poles, gains, memory, 1, x[1], like),
        sizes[FLICKER_SIZE, 2] * flicker_step(poles, gains, memory, 2, x[2], like),
    )
    store_several(memory, _NOW, like, now)


def bias_now(gyro, row, draws, like):
    """Return the true bias at the edge of a row of what is kept, the end of the last interval drawn."""
    memory = draws.memory
    bias = triple(memory, _TURN_ON, like)
    if gyro.terms[0]:
        bias = add(triple(memory, _WALK, like), bias)
    if gyro.terms[1]:
        bias = add(bias, triple(memory, _MARKOV, like))
    if gyro.terms[2]:
        bias = combine(1.0, bias, 0.5, add(triple(memory, _BEFORE, like), triple(memory, _NOW, like)))
    return add(vector_at(gyro.true_bias, row), bias)


def drift_step(gyro, k, draws, like):
    """Draw interval k of the gyro; return the error of its increment, without the part common to all runs."""
    terms, sizes, dt = gyro.terms, gyro.sizes, gyro.edges[k + 1] - gyro.edges[k]
    streams, ahead, memory = draws.streams, draws.ahead, draws.memory
    turn_on = triple(memory, _TURN_ON, like)
    if terms[0]:
        walk = triple(memory, _WALK, like)
        white = normal_triple(streams, GYRO, ahead, 2 * k, like)
        steps = normal_triple(streams, GYRO, ahead, 2 * k + 1, like)
        after = add(walk, by_axis(steps, sizes, WALK_SIGMA))
        store_several(memory, _WALK, like, after)
        drift = combine(dt, turn_on, 0.5 * dt, add(walk, after))
    else:
        white = normal_triple(streams, GYRO, ahead, k, like)
        drift = scale(dt, turn_on)
    if terms[1]:
        g = triple(memory, _MARKOV, like)
        x = normal_triple(streams, MARKOV, ahead, k, like)
        after = add(by_axis(g, sizes, MARKOV_DECAY), by_axis(x, sizes, MARKOV_SIGMA))
        store_several(memory, _MARKOV, like, after)
        drift = add(drift, by_axis(add(g, after), sizes, MARKOV_MEAN))
    if terms[2]:
        drift = combine(1.0, drift, dt, triple(memory, _NOW, like))
        draw_flicker(gyro, k + 1, draws, like)
    if terms[3]:
        units = draws.units
        drift = add(drift, matrix_times_vector(nine(units, _MATRIX, like), vector_at(gyro.true_increments, k)))
        if len(gyro.true_force) > 0:
            drift = add(drift, matrix_times_vector(nine(units, _FORCE, like), vector_at(gyro.true_force, k)))
    return add(drift, by_axis(white, sizes, WHITE_SIGMA))


def begin(body):
    """Draw the initial values, and start the filters: at the truth minus the error drawn."""
    like, start, draws = lanes_of(PATTERN), body.start, body.draws
    start_streams(draws, like)
    start_gyro(body.gyro, draws, like)
    x = drawn_triple(draws.ahead, START, 0, like)
    y = drawn_triple(draws.ahead, START, 3, like)
    errors = start.error
    error = combine(errors[0], x, 1.0, (errors[2], errors[3], errors[4]))
    attitude = (start.attitude[0], start.attitude[1], start.attitude[2], start.attitude[3])
    q = unit(quaternion_multiply(attitude, exponential((-error[0], -error[1], -error[2]))))
    offset = combine(errors[1], y, 1.0, (errors[5], errors[6], errors[7]))
    b = subtract(bias_now(body.gyro, 0, draws, like), offset)
    return start_filters(q, b, body, like)


def clipped(increment, gyro, k):
    """Return an increment of a rate within the gyro's range."""
    dt = gyro.edges[k + 1] - gyro.edges[k]
    most = tuple(dt * gyro.sizes[RANGE, i] for i in range(3))
    upper = tuple(select(x > y, y, x) for x, y in zip(increment, most, strict=True))
    return tuple(select(x < -y, -y, x) for x, y in zip(upper, most, strict=True))


def rounded(increment, gyro, k):
    """Return an increment of a rate that is an integer multiple of the gyro's resolution; 0: not rounded."""
    dt = gyro.edges[k + 1] - gyro.edges[k]
    step = tuple(dt * gyro.sizes[RESOLUTION, i] for i in range(3))
    return tuple(
        select(y > 0.0, ((x / y + _ROUNDING) - _ROUNDING) * y, x) for x, y in zip(increment, step, strict=True)
    )


def increment_over(increments, k, body):
    """Draw interval k, and return its increments; zero for the interval before the first edge."""
    like, draws = broadcast(0.0), body.draws
    if k < 0:
        return (like, like, like)
    draws.longest[0] = body.gyro.substeps[k]
    increment = add(vector_at(increments, k), drift_step(body.gyro, k, draws, like))
    if body.gyro.terms[4]:
        increment = clipped(increment, body.gyro, k)
    if body.gyro.terms[5]:
        increment = rounded(increment, body.gyro, k)
    if len(draws.increments) > 0:
        store_several(draws.increments, 3 * k, like, increment)
    return increment


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return body.draws.longest[0]


def predict(state, part, dt, body, out):
    """Propagate all runs."""
    return propagated(state, part, dt, body, broadcast(0.0))


def sensor_noise(e, sensor, events, draws, like):
    """Return the noise of a measurement: white by component, outliers and correlated noise."""
    streams, ahead, memory = draws.streams, draws.ahead, draws.memory
    number, share = events.number[e], events.share[e]
    struck_below, boresight = events.struck_below[sensor], events.boresight[sensor]
    mine = _SENSORS + 3 * sensor
    source = SENSORS + 2 * sensor
    white = normal_triple(streams, source, ahead, number, like)
    noise = by_axis(white, events.sigma, e)
    if boresight[3] != 0.0:
        b = (boresight[0], boresight[1], boresight[2])
        noise = add(noise, scale(boresight[3] * dot(b, white), b))
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


def measured_value(e, sensor, kind, body, like):
    """Draw measurement e: an attitude, or a vector and a fourth number without meaning."""
    events, draws = body.events, body.draws
    noise, exact = sensor_noise(e, sensor, events, draws, like), events.exact
    if kind == ATTITUDE:
        true = quaternion_at(exact, e)
        return quaternion_multiply(true, exponential(noise))
    z = add(vector_at(exact, e), noise)
    if body.gyro.terms[3]:
        at = _OFFSETS + 6 * sensor
        z = combine(events.scale[e], triple(draws.units, at, like), 1.0, z)
        if len(events.turning) > 0:
            turned = matrix_times_vector(frame_at(events.turning, e), triple(draws.units, at + 3, like))
            z = combine(events.scale[e], turned, 1.0, z)
    if kind != VECTOR:
        z = scale(inverse_root(dot(z, z)), z)
    return (z[0], z[1], z[2], like)


def update(state, e, now, measured, body, out):
    """Draw measurement e and update all runs; the NIS is added to that of its sensor and span of time."""
    like, sensor = broadcast(0.0), measured.sensor[e]
    kind = measured.series[sensor, KIND]
    value = measured_value(e, sensor, kind, body, like)
    state, nis, innovations = corrected(state, value, e, measured, body, like)
    spans = len(out.nis) // (WIDTH * len(body.events.struck_below))
    at = (sensor * spans + body.events.span[e]) * WIDTH
    store(out.nis, at, load_like(out.nis, at, like) + nis)
    if len(out.values) > 0:
        store_several(out.values, 10 * e, like, (*value, *innovations))
    return state


def keep(state, row, e, body, out):
    """Write the :data:`KEPT` values of an epoch."""
    like = broadcast(0.0)
    keep_filters(state, row, body, out, like)
    store_several(out.kept, row * KEPT + 28, like, bias_now(body.gyro, row, body.draws, like))
    return state


def stopped(state):
    """Return false: the runs are independent, so the walk goes to the end."""
    return False


def finish(state, row, e, body):
    """Return whether a measurement was too precise."""
    return state.lost
