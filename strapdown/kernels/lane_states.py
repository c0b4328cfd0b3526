"""The filter with error states for several runs at once, one per lane (SIMD): the covariance form of :mod:`strapdown.kernels.root_form`.

All runs have the same gyro edges and the same times, sensors, noise and references of measurements; the values that differ are lanes.
Models, formulas and names are those of :mod:`strapdown.kernels.error_state_step`, without chains and without offsets in fixed axes. The
covariance P is stored in full, but only its upper triangle is used.

A run whose covariance might lose digits, or that leaves the range of the polynomials, is marked as lost; the caller repeats it in root
form. No lane depends on its neighbours. In memory lanes are contiguous, so place p of a flat array begins at ``p · len(like)``.
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
    multiply,
    scale,
    scale_matrix,
    skew_polynomial,
    subtract,
    symmetric_minus_outer,
    times_transpose_upper_add,
    transpose_times_vector,
)
from strapdown.kernels.error_state_step import (
    FACTORIALS,
    FORCE,
    OFFSET,
    SCALE,
    THREE_NODES,
    THREE_WEIGHTS,
    error_matrix,
    gyro_matrix_times,
    inverse,
    turning_matrix,
)
from strapdown.kernels.filter_step import SHORT_FORM, process_noise, reset, transition
from strapdown.kernels.lane_angles import arctangent, rotation_vector
from strapdown.kernels.lane_values import anywhere, chosen, lanes_of, load_like, store
from strapdown.kernels.measurement import ATTITUDE, HEADING, frame_at, six_at
from strapdown.kernels.montecarlo_run import four, store_several, triple
from strapdown.kernels.rotation import right_jacobian, rotation_matrix, turned
from strapdown.kernels.sensor_rows import arm_noise, decorrelate, fill_rows, identity
from strapdown.kernels.series import SQUARED_RANGE

CALLED = (
    "step",
    "follow",
    "fill_table",
    "at_node",
    "absorb",
    "product",
    "minus_outer",
    "take_row",
    "least_share",
    "keep",
)
"""Called, not inlined: a call costs little compared with their work."""

MISS, GAIN, STEP, AXES = 0, 1, 2, 3
"""Rows of ``lines``: the rounding error of P h (:func:`take_row`), P h, the correction, and from the last on three rows, one per axis."""
OWN, KEPT = 0, 1
"""Rows of ``alone``, the same for all lanes: the noise Q_ii and the decay of each state over the steps not yet applied to P."""
LEFT, MEAN, OF_NOISE, TIME, SERIES = 0, 1, 10, 11, 10
"""Columns of a state's table: e^{−λu}, ``∫₀ᵘ e^{−λs} ds``, ``∫₀ᵘ e^{−2λs} ds``, u; column k between them: ``Σ (−λu)ⁱ/(i + k)!``."""
SAME = 1e-9
"""Maximum relative difference of two steps that use the same table."""
MAX_SHARPNESS = 1e9
"""Maximum ratio of innovation variance to measurement variance at which P keeps enough digits."""
MIN_SHARE = 1e-6
"""Minimum share of a state's variance that remains given the states before it, at which P has enough digits."""
CHECK = 1024
"""Number of intervals between two checks of the digits."""


class Events(NamedTuple):
    """Measurements in order of time (m,), the same in all runs."""

    time: np.ndarray
    place: np.ndarray
    """Row of the innovations."""
    sensor: np.ndarray
    kind: np.ndarray
    frame: np.ndarray
    """Right-handed frames about the references (m, 9)."""
    noise: np.ndarray
    """Upper triangles of the covariances in body axes (m, 6)."""
    length: np.ndarray
    """Divisor of the effects of error states."""


class Runs(NamedTuple):
    """Data that differ between runs; the last axis is that of the lanes."""

    increments: np.ndarray
    """(n, 3, W), rad."""
    value: np.ndarray
    """Measured vectors, or attitudes (m, 4, W)."""
    turning: np.ndarray
    """Rate, angular acceleration and variances of the latter (m, 9, W), or (0, 9, W) without lever arms."""


class Work(NamedTuple):
    """State of the filter and work space, for n states in all; the last axis is that of the lanes."""

    attitude: np.ndarray
    """(4, W)"""
    x: np.ndarray
    """Bias and error states (n − 3, W)."""
    P: np.ndarray
    """(2, n, n, W): that of the filter, and that at an edge between two measurements."""
    top: np.ndarray
    """Effect of each state on the attitude over the steps not yet applied to P (n, 3, W)."""
    cross: np.ndarray
    """Process noise of those steps: covariance of the attitude with each state (n, 3, W)."""
    rows: np.ndarray
    """H of a measurement (3, n, W)."""
    lines: np.ndarray
    """(6, n, W): :data:`MISS` to :data:`AXES`."""
    alone: np.ndarray
    """(2, n): :data:`OWN` and :data:`KEPT`."""
    table: np.ndarray
    """Coefficients of a step for each state, and last the step, s (m + 1, 4, 12)."""
    lost: np.ndarray
    """1 if the run is lost (W,)."""
    written: np.ndarray
    """Numbers to be written to the outputs (2 n + 22, W)."""


class Outputs(NamedTuple):
    """Outputs of the first runs, as many as the arrays hold."""

    kept: np.ndarray
    """q (4), x (n − 3), variances (n) and the covariance of attitude and whole bias (21) at the kept edges (runs, rows, 2 n + 22)."""
    innovation: np.ndarray
    """e₁, s₁, e₂, s₂, e₃, s₃ by place (runs, m, 6)."""


def place_of(n, i, j):
    """Return the place of P's entry (i, j)."""
    return n * min(i, j) + max(i, j)


def one_of(array, place, like):
    """Return a lane value by its place."""
    return load_like(array, place * len(like), like)


def seen(work, like, place):
    """Return a lane value of P by its place."""
    return one_of(work.P, place, like)


def put(array, place, like, value):
    """Write a lane value to its place."""
    store(array, place * len(like), value)


def state_at(x, i, like):
    """Return component i of bias and error states."""
    return one_of(x, i, like)


def row_entry(H, r, i, like):
    """Return an entry of the rows (3, n, lanes)."""
    return one_of(H, H.shape[1] * r + i, like)


def set_row_entry(H, r, i, like, value):
    """Write an entry of the rows."""
    put(H, H.shape[1] * r + i, like, value)


def turned_by(q, phi):
    """Return q ⊗ exp(φ) and J_r(φ) for a small rotation."""
    return turned(q, phi), right_jacobian(phi)


def turn_vector(q):
    """Return the rotation vector of a unit quaternion."""
    return rotation_vector(q)


def angle_of(y, x):
    """Return the angle of the point (x, y), rad."""
    return arctangent(y, x)


def mark(work, like, good):
    """Mark the runs in which a condition does not hold as lost; for NaN no condition holds."""
    lost = one_of(work.lost, 0, like)
    put(work.lost, 0, like, chosen(good, lost, like + 1.0))


# ------------------------------------------------------------------------------------------------------------------------ prediction


def step(model, work, like, q, turn, noise, dt, part):
    """Propagate attitude and ``x`` over an increment; append the step to those not yet applied to P; return q and their Φ_θθ and Q_θθ."""
    gyro, gyro_use, decay, density = model.gyro, model.gyro_use, model.decay, model.density
    x, table = work.x, work.table
    if abs(dt - table[len(decay), 0, 0]) > SAME * dt:
        fill_table(table, decay, dt)
    r = combine(1.0, part, -dt, triple(x, 0, like))
    force = (like, like, like)
    if dot(model.force_f, model.force_f) > 0.0:
        force = transpose_times_vector(rotation_matrix(turned(q, scale(0.5, r))), model.force_f)
    D = identity(like)
    coupled = False
    for k in range(len(decay)):
        use = gyro_use[k]
        if use != 0:
            c = one_of(x, 3 + k, like)
            if use & OFFSET:
                r = combine(1.0, r, -table[k, 3, MEAN] * c, (gyro[k, 0], gyro[k, 1], gyro[k, 2]))
            if use & FORCE:
                r = combine(1.0, r, -dt * c, gyro_matrix_times(gyro, k, force))
            if use & SCALE:
                coupled = True
                D = add_matrices(D, scale_matrix(c, error_matrix(gyro, k)))
    if coupled:
        D = inverse(D)
        r = matrix_times_vector(D, r)
    mark(work, like, dot(r, r) <= SQUARED_RANGE)
    phi11, phi12 = transition(r, dt)
    q11, q12, q22 = process_noise(r, dt, model.angle_variance, model.rate_variance)
    if coupled:
        phi12 = multiply(phi12, D)
    rate = scale(1.0 / dt, r)
    noise = times_transpose_upper_add(multiply(phi11, full(noise)), phi11, q11)
    for i in range(3):
        column = (phi12[i], phi12[3 + i], phi12[6 + i])
        noise = follow(work, like, 3 + i, phi11, column, (q12[i], q12[3 + i], q12[6 + i]), q22, 1.0, noise)
    E = E0 = E1 = E2 = D
    held = -1.0
    for k in range(len(decay)):
        use, kept, own = gyro_use[k], table[k, 3, LEFT], density[k] * table[k, 3, OF_NOISE]
        put(x, 3 + k, like, kept * one_of(x, 3 + k, like))
        if use == 0:
            work.alone[OWN, 6 + k] = kept * kept * work.alone[OWN, 6 + k] + own
            work.alone[KEPT, 6 + k] *= kept
        else:
            e = (gyro[k, 0], gyro[k, 1], gyro[k, 2])
            w = (like, like, like)
            if use & SCALE:
                w = add(w, gyro_matrix_times(gyro, k, rate))
            if use & FORCE:
                w = add(w, gyro_matrix_times(gyro, k, force))
            column = matrix_times_vector(phi12, w)
            share = (like, like, like)
            if use & OFFSET:
                if decay[k] != held:
                    held = decay[k]
                    E0, E1 = at_node(table, k, 0, rate, D, coupled), at_node(table, k, 1, rate, D, coupled)
                    E2, E = at_node(table, k, 2, rate, D, coupled), at_node(table, k, 3, rate, D, coupled)
                column = subtract(column, matrix_times_vector(E, e))
                if density[k] > 0.0:
                    noise, share = driven(table, k, 0, density[k], E0, e, noise, share)
                    noise, share = driven(table, k, 1, density[k], E1, e, noise, share)
                    noise, share = driven(table, k, 2, density[k], E2, e, noise, share)
            noise = follow(work, like, 6 + k, phi11, column, share, own, kept, noise)
    return turned(q, r), multiply(phi11, turn), noise


def fill_table(table, decay, dt):
    """Write the coefficients of a step dt for each state: rows for the three nodes of its noise, and one for the whole step."""
    table[len(decay), 0, 0] = dt
    for k in range(len(decay)):
        same = k > 0 and decay[k] == decay[k - 1]
        for i in range(12 if same else 0):
            for r in range(4):
                table[k, r, i] = table[k - 1, r, i]
        for i in range(0 if same else 4):
            u = dt * (1.0 - THREE_NODES[i]) if i < 3 else dt
            z = -decay[k] * u
            phi = FACTORIALS[0]
            for j in range(1, 15):
                phi = FACTORIALS[j] + z * phi
                if 16 - j < SERIES:
                    table[k, i, 16 - j] = phi
            table[k, i, TIME] = u
            table[k, i, MEAN] = u * (1.0 + z * phi)
            table[k, i, LEFT] = math.exp(z)
        if not same:
            table[k, 3, OF_NOISE] = -0.5 * math.expm1(-2.0 * decay[k] * dt) / decay[k] if decay[k] > 0.0 else dt


def at_node(table, k, i, rate, D, coupled):
    """Return :func:`strapdown.kernels.error_state_step.response` from node i of state k's noise to the end of the step, times (I + M)⁻¹.

    Node 3 is the start of the step. Four terms of each series are accurate to 1e-10 in the range of a step.
    """
    f = table[k, i]
    u = f[TIME]
    y = -u * u * dot(rate, rate)
    linear = f[2] + y * (f[4] + y * (f[6] + y * f[8]))
    quadratic = f[3] + y * (f[5] + y * (f[7] + y * f[9]))
    E = skew_polynomial(f[MEAN], -u * u * linear, u * u * u * quadratic, rate)
    return multiply(E, D) if coupled else E


def driven(table, k, i, density, E, e, noise, share):
    """Add the contribution of state k's white noise at Gauss's node i to Q_θθ and to its covariance with the attitude."""
    weight = THREE_WEIGHTS[i] * density * table[k, 3, TIME]
    t = matrix_times_vector(E, e)
    return symmetric_minus_outer(noise, scale(-weight, t), t), combine(1.0, share, -weight * table[k, i, LEFT], t)


def follow(work, like, i, phi11, column, share, own, kept, noise):
    """Append a step to those not yet applied to P, for state i; return Q_θθ with its contribution. As ``error_state_step.follow``."""
    alone = work.alone
    u = matrix_times_vector(phi11, triple(work.cross, 3 * i, like))
    v = combine(1.0, u, alone[OWN, i], column)
    top = matrix_times_vector(phi11, triple(work.top, 3 * i, like))
    store_several(work.top, 3 * i, like, combine(1.0, top, alone[KEPT, i], column))
    store_several(work.cross, 3 * i, like, combine(kept, v, 1.0, share))
    alone[OWN, i] = kept * kept * alone[OWN, i] + own
    alone[KEPT, i] *= kept
    return crossed(noise, column, u, v)


def crossed(S, a, u, v):
    """Return S + a uᵀ + v aᵀ, which is symmetric."""
    T = full(S)
    return tuple(T[3 * i + j] + (a[i] * u[j] + v[i] * a[j]) for i in range(3) for j in range(i, 3))


def start_steps(work, like):
    """Reset the steps not yet applied to P."""
    for i in range(work.alone.shape[1]):
        store_several(work.top, 3 * i, like, (like, like, like))
        store_several(work.cross, 3 * i, like, (like, like, like))
        work.alone[OWN, i] = 0.0
        work.alone[KEPT, i] = 1.0


def absorb(model, work, like, base, turn, noise):
    """Apply the steps not yet applied to the P that begins at place ``base``: ``Φ P Φᵀ + Q``."""
    n, last = work.alone.shape[1], 6 + model.changing
    kept = work.alone[KEPT]
    for j in range(n):
        t = matrix_times_vector(
            turn,
            (
                seen(work, like, base + place_of(n, 0, j)),
                seen(work, like, base + place_of(n, 1, j)),
                seen(work, like, base + place_of(n, 2, j)),
            ),
        )
        for i in range(3, n):
            if i < 6 or model.gyro_use[i - 6] != 0:
                t = combine(1.0, t, seen(work, like, base + place_of(n, i, j)), triple(work.top, 3 * i, like))
        for a in range(3):
            put(work.lines, n * (AXES + a) + j, like, t[a])
    A = (axes_at(work, like, n, 0), axes_at(work, like, n, 1), axes_at(work, like, n, 2))
    T = (A[0][0], A[1][0], A[2][0], A[0][1], A[1][1], A[2][1], A[0][2], A[1][2], A[2][2])
    S = times_transpose_upper_add(T, turn, noise)
    for i in range(3, n):
        t = axes_at(work, like, n, i)
        if i < 6 or model.gyro_use[i - 6] != 0:
            S = symmetric_minus_outer(S, scale(-1.0, t), triple(work.top, 3 * i, like))
        t = combine(kept[i], t, 1.0, triple(work.cross, 3 * i, like))
        for a in range(3):
            put(work.P, base + n * a + i, like, t[a])
    put_attitude(work, like, base, n, S)
    for i in range(3, last):
        for j in range(max(i, 6), last):
            here = base + n * i + j
            put(work.P, here, like, kept[i] * kept[j] * seen(work, like, here))
        for j in range(last, n if i >= 6 else 0):
            here = base + n * i + j
            put(work.P, here, like, kept[i] * seen(work, like, here))
        here = base + n * i + i
        put(work.P, here, like, seen(work, like, here) + work.alone[OWN, i])


def axes_at(work, like, n, i):
    """Return the entries of state i in the three rows of the axes."""
    return tuple(one_of(work.lines, n * (AXES + a) + i, like) for a in range(3))


def attitude_of(work, like, n):
    """Return the covariance of the attitude (6-tuple)."""
    a, b = triple(work.P, 0, like), triple(work.P, n, like)
    return (a[0], a[1], a[2], b[1], b[2], seen(work, like, 2 * n + 2))


def put_attitude(work, like, base, n, S):
    """Write the covariance of the attitude."""
    store_several(work.P, base, like, (S[0], S[1], S[2]))
    put(work.P, base + n + 1, like, S[3])
    put(work.P, base + n + 2, like, S[4])
    put(work.P, base + 2 * n + 2, like, S[5])


# ----------------------------------------------------------------------------------------------------------------------- measurements


def product(work, like, use, r, line):
    """Write P h to a row of ``lines``, h being row r of H; ``use`` marks the states that affect the sensor."""
    n = work.alone.shape[1]
    for j in range(n):
        put(work.lines, n * line + j, like, like)
    for i in range(n):
        if i < 3 or (i >= 6 and use[i - 6] != 0):
            h = one_of(work.rows, n * r + i, like)
            for j in range(n):
                p = one_of(work.lines, n * line + j, like) + h * seen(work, like, place_of(n, i, j))
                put(work.lines, n * line + j, like, p)


def against(work, like, use, r, line):
    """Return the scalar product of a row of H and a row of ``lines``."""
    n = work.alone.shape[1]
    p = like
    for i in range(n):
        if i < 3 or (i >= 6 and use[i - 6] != 0):
            p = p + one_of(work.rows, n * r + i, like) * one_of(work.lines, n * line + i, like)
    return p


def minus_outer(work, like, left, right, factor):
    """Subtract the outer product of two rows of ``lines``, times a factor, from P."""
    n = work.alone.shape[1]
    for i in range(n):
        a = factor * one_of(work.lines, n * left + i, like)
        for j in range(i, n):
            here = n * i + j
            put(work.P, here, like, seen(work, like, here) - a * one_of(work.lines, n * right + j, like))


def take_row(work, like, use, r, y, variance):
    """Update P and the correction with y, measured by row r of H with noise ``variance``; return the innovation and its variance.

    Joseph's form, as in :func:`strapdown.kernels.filter_step.update_row`.
    """
    n = work.alone.shape[1]
    product(work, like, use, r, GAIN)
    s = against(work, like, use, r, GAIN) + variance
    inverted = 1.0 / s
    error = y - against(work, like, use, r, STEP)
    gain = error * inverted
    for i in range(n):
        here = n * STEP + i
        put(work.lines, here, like, one_of(work.lines, here, like) + gain * one_of(work.lines, n * GAIN + i, like))
    minus_outer(work, like, GAIN, GAIN, inverted)
    precise = s > SHORT_FORM * variance
    if anywhere(precise):
        product(work, like, use, r, MISS)
        for i in range(n):
            here = n * MISS + i
            missed = one_of(work.lines, here, like) - (variance * inverted) * one_of(work.lines, n * GAIN + i, like)
            put(work.lines, here, like, chosen(precise, missed, like))
        minus_outer(work, like, MISS, GAIN, inverted)
    mark(work, like, s >= variance)
    mark(work, like, s <= MAX_SHARPNESS * variance)
    return error, s


def update(model, work, like, q, e, events, runs, out):
    """Update with measurement e; return q."""
    n = work.alone.shape[1]
    s, kind, length = events.sensor[e], events.kind[e], events.length[e]
    use = model.sensor_use[s]
    value, C = four(runs.value, 4 * e, like), six_at(events.noise, e)
    W = identity(like)
    if len(runs.turning) > 0 and kind not in (ATTITUDE, HEADING):
        turn = subtract(triple(runs.turning, 9 * e, like), triple(work.x, 0, like))
        W = turning_matrix(turn, triple(runs.turning, 9 * e + 3, like))
    rows, y, axes, shown = fill_rows(
        q,
        work.x,
        work.rows,
        kind,
        value,
        frame_at(events.frame, e),
        length,
        s,
        model.sensors,
        model.sensor_use,
        W,
        like,
    )
    mark(work, like, shown)
    C = (like + C[0], like + C[1], like + C[2], like + C[3], like + C[4], like + C[5])
    if len(runs.turning) > 0:
        variance = triple(runs.turning, 9 * e + 6, like)
        C = arm_noise(work.x, s, model.sensors, model.sensor_use, length, variance, C, like)
    y, variance = decorrelate(work.rows, use, rows, y, axes, C, like)
    for i in range(n):
        put(work.lines, n * STEP + i, like, like)
    for r in range(rows):
        error, s2 = take_row(work, like, use, r, y[r], variance[r])
        put(work.written, 2 * r, like, error)
        put(work.written, 2 * r + 1, like, s2)
    hand_out(work, like, out.innovation, events.place[e], 2 * rows)
    q, A, G = reset(q, attitude_of(work, like, n), identity(like), triple(work.lines, n * STEP, like))
    put_attitude(work, like, 0, n, A)
    for i in range(3, n):
        put(work.x, i - 3, like, one_of(work.x, i - 3, like) + one_of(work.lines, n * STEP + i, like))
        p = (seen(work, like, i), seen(work, like, n + i), seen(work, like, 2 * n + i))
        p = matrix_times_vector(G, p)
        for a in range(3):
            put(work.P, n * a + i, like, p[a])
    return q


# ------------------------------------------------------------------------------------------------------------------------------ the run


def hand_out(work, like, out, row, count):
    """Write the first ``count`` numbers of ``work.written`` to a row of each run in ``out``."""
    for i in range(count):
        for lane in range(out.shape[0]):
            out[lane, row, i] = work.written[i, lane]


def keep(model, work, like, base, q, row, out):
    """Write a row of the outputs, the covariance from the P that begins at place ``base``."""
    n, written = work.alone.shape[1], work.written
    store_several(written, 0, like, q)
    for i in range(n - 3):
        put(written, 4 + i, like, one_of(work.x, i, like))
    for i in range(n):
        put(written, n + 1 + i, like, seen(work, like, base + n * i + i))
    # Covariances of each state with attitude and whole bias, b + Σ c e, then that of attitude and whole bias.
    reported = work.lines.shape[0]
    for a in range(reported):
        for j in range(n):
            t = seen(work, like, base + place_of(n, a, j))
            for k in range(n - 6 if a >= 3 else 0):
                if model.gyro_use[k] & OFFSET:
                    t = t + model.gyro[k, a - 3] * seen(work, like, base + place_of(n, 6 + k, j))
            put(work.lines, n * a + j, like, t)
    here = 2 * n + 1
    for a in range(reported):
        for b in range(a, reported):
            t = one_of(work.lines, n * b + a, like)
            for k in range(n - 6 if a >= 3 else 0):
                if model.gyro_use[k] & OFFSET:
                    t = t + model.gyro[k, a - 3] * one_of(work.lines, n * b + 6 + k, like)
            put(written, here, like, t)
            here += 1
    hand_out(work, like, out, row, here)


def least_share(work, like):
    """Return the smallest share of a state's variance that remains given the states before it, by elimination in the second P."""
    n = work.alone.shape[1]
    base = n * n
    least = like + 1.0
    for i in range(n):
        for j in range(i, n):
            t = seen(work, like, n * i + j)
            for r in range(i):
                up, right = seen(work, like, base + n * r + i), seen(work, like, base + n * r + j)
                t = t - up * right / seen(work, like, base + n * r + r)
            put(work.P, base + n * i + j, like, t)
        share = seen(work, like, base + n * i + i) / seen(work, like, n * i + i)
        least = chosen(share >= least, least, share)
    return least


def advance(pattern, edges, every, model, events, runs, work, out):
    """Filter ``len(pattern)`` runs from the state in ``work``; a row is written at every ``every``-th edge.

    Parameters
    ----------
    pattern : tuple of floats, one a run
    edges : array (n + 1,)
    every : int
    model : strapdown.kernels.root_form.Model
    events : Events
    runs : Runs
    work : Work
    out : Outputs
    """
    like = lanes_of(pattern)
    n = work.alone.shape[1]
    unmoved = identity(like)
    still = (like, like, like, like, like, like)
    turn, noise = unmoved, still
    q = four(work.attitude, 0, like)
    start_steps(work, like)
    count, e, row, countdown = len(events.time), 0, 0, 0
    behind = False
    now = edges[0]
    whole = 1.0
    for k in range(-1, len(edges) - 1):
        end = edges[k + 1]
        if k >= 0:
            whole = end - edges[k]
        while True:
            due = e < count and events.time[e] <= end
            stop = events.time[e] if due else end
            dt = stop - now
            if dt > 0.0:
                if dt > model.limit:
                    dt = model.limit
                    stop = now + dt
                    due = False
                part = scale(dt / whole, triple(runs.increments, 3 * k, like))
                q, turn, noise = step(model, work, like, q, turn, noise, dt, part)
                behind = True
                now = stop
            if due:
                if behind:
                    absorb(model, work, like, 0, turn, noise)
                    start_steps(work, like)
                    turn, noise, behind = unmoved, still, False
                q = update(model, work, like, q, e, events, runs, out)
                e += 1
            if now >= end and (e == count or events.time[e] > end):
                break
        if countdown == 0:
            countdown = every
            base = 0
            if behind:
                base = n * n
                for i in range(n * n):
                    put(work.P, base + i, like, seen(work, like, i))
                absorb(model, work, like, base, turn, noise)
            keep(model, work, like, base, q, row, out.kept)
            row += 1
        countdown -= 1
        if (k + 1) % CHECK == 0 or k == len(edges) - 2:
            mark(work, like, least_share(work, like) >= MIN_SHARE)
