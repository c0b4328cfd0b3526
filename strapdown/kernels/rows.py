"""Rows of measurements: ``y = h · (δθ, δb, δc) + noise`` of every kind of sensor with every error state.

First the measurement from the arrays of a record, then its rows by kind and the effects of error states on them, then noise that is not
the same along all axes. At the end the functions by shape of sensor, which is known while they are compiled.
"""

from __future__ import annotations

from strapdown.kernels.algebra import (
    add,
    cross,
    dot,
    inverse,
    matrix_times_vector,
    scale,
    square_root,
    subtract,
    symmetric_times_vector,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.filter_step import turned_by
from strapdown.kernels.lane_angles import arctangent, rotation_vector
from strapdown.kernels.lane_values import lanes_of, select
from strapdown.kernels.layout import (
    AXES,
    DIAGONAL,
    LANES,
    LINE,
    OTHERS,
    PARAMETERS,
    ROWS,
    STATES,
    STRUCTURE,
    N,
    by_shape,
    number,
    numbers_of,
    parameter,
    put_at,
    tuple_at,
    value_at,
)
from strapdown.kernels.measurement import (
    ATTITUDE,
    DIRECTION,
    HEADING,
    VERTICAL,
    frame_of,
    six_at,
    value_of,
)
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix
from strapdown.kernels.series import SQUARED_RANGE
from strapdown.kernels.structural_zeros import any_number, is_zero, matrix_products, plus, products, sum_of, times
from strapdown.kernels.structure import Effects, Measured

NINE = (0, 1, 2, 3, 4, 5, 6, 7, 8)

CALLED = tuple(f"write_rows_{s}" for s in range(len(STRUCTURE.sensors)))


def measurement_of(s, body, measured, e):
    """Return the e-th measurement, by a sensor of shape s."""
    shape, at, sensor = STRUCTURE.sensors[s], measured.place[e], measured.sensor[e]
    if LANES > 1 and not PARAMETERS:
        return measurement_of_lanes(s, body, measured, e, at, sensor)
    z = value_of(measured, at)
    if not shape.isotropic:
        noise = six_at(measured.noise, at)
    elif shape.kind == ATTITUDE:
        noise = (0.0,)
    else:
        sigma = measured.sigma[at]
        noise = (sigma * sigma,)
    if PARAMETERS:
        z, noise = with_factors(shape, z, noise, tuple(parameter(body.factors, 3 * sensor + i) for i in AXES))
    levers = any(t.lever for t in shape.states)
    turning = tuple(body.turning[e, i] for i in NINE) if levers else (0.0,) * 9
    return Measured(z, frame_of(measured, at, sensor), noise, body.length[e] if shape.states else 1.0, turning)


def measurement_of_lanes(s, body, measured, e, at, sensor):
    """Return the e-th measurement of several runs: ``value`` has four numbers of each run, a vector or an attitude."""
    shape, like = STRUCTURE.sensors[s], lanes_of((0.0,) * LANES)
    value, noise = tuple_at(measured.value, 0, 4, like), six_at(measured.noise, at)
    levers = any(t.lever for t in shape.states)
    turning = tuple_at(body.turning, 9 * e, 9, like) if levers else (0.0,) * 9
    length = body.length[e] if shape.states else 1.0
    if shape.kind == ATTITUDE:
        return Measured((noise[0], noise[3], noise[5]), value, noise, length, turning)
    return Measured(value[:3], frame_of(measured, at, sensor), noise, length, turning)


def with_factors(shape, z, noise, f):
    """Return value and noise of a measurement with other σ about the body axes, as factors."""
    if not shape.isotropic:
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        return z, tuple(n * f[i] * f[j] for n, (i, j) in zip(noise, pairs, strict=True))
    if shape.kind == ATTITUDE:
        return tuple(variance * t * t for variance, t in zip(z, f, strict=True)), noise
    return z, (noise[0] * f[0] * f[0],)


# ----------------------------------------------------------------------------------------------------------------------------- rows by kind


def rows_of(s, x, measured, numbers, like, transverse=False):
    """Return rows, residuals, variances, angle and validity of a measurement (:func:`rows_and_axes`), its rows with independent noise."""
    sensor = STRUCTURE.sensors[s]
    rows, y, axes, angle, valid = rows_and_axes(s, x, measured, numbers, like, transverse)
    levers = any(t.lever for t in sensor.states)
    if sensor.kind == HEADING:
        return rows, y, (measured.noise[0],), angle, valid
    if sensor.isotropic and not levers:
        if sensor.kind == ATTITUDE:
            return rows, y, measured.z, angle, valid
        variance = measured.noise[0]
        if sensor.kind == DIRECTION and sensor.states:
            return rows, y, tuple(variance * dot(t, t) for t in axes), angle, valid
        return rows, y, tuple(variance + like for _ in rows), angle, valid
    noise = measured.noise
    if sensor.isotropic:
        noise = (noise[0], like, like, noise[0], like, noise[0])
    if levers:
        noise = arm_noise(s, x, measured, noise, numbers, like)
    rows, y, variances = decorrelated(rows, y, axes, noise)
    return rows, y, variances, angle, valid


def rows_and_axes(s, x, measured, numbers, like, transverse=False):
    """Return the rows h (N each) of a measurement by a sensor of shape s, residuals, axes, angle, and whether it is valid.

    Zeros of h are Python zeros. The axes are those of the body along which the rows measure. Angle: squared sine and cosine, times the
    length of the vector, of the angle between the measured and the predicted one; of other kinds 0 and 1. The heading of a vertical vector
    is not valid, and its row is zero. ``transverse``: the rows of a vector are those of the frame about its reference, also with error
    states.
    """
    kind = STRUCTURE.sensors[s].kind
    if kind == ATTITUDE:
        rows, y, axes, valid = rows_of_attitude(s, x, measured, numbers, like)
        return rows, y, axes, (like, like + 1.0), valid
    if kind == HEADING:
        rows, y, axes, valid = rows_of_heading(s, x, measured, numbers, like)
        return rows, y, axes, (like, like + 1.0), valid
    rows, y, axes, along = rows_of_vector(s, x, measured, numbers, like, transverse)
    return rows, y, axes, (y[0] * y[0] + y[1] * y[1], along), like < like + 1.0


def rows_of_attitude(s, x, measured, numbers, like):
    """Return the rows of an attitude: the offset is a rotation vector between sensor axes and body axes."""
    sensor, q = STRUCTURE.sensors[s], tuple_at(x, 0, 4, like)
    ones = like + 1.0
    axes = ((ones, like, like), (like, ones, like), (like, like, ones))
    if not sensor.states:
        y = rotation_vector(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), measured.frame[:4]))
        identity = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        return tuple(e + (0,) * (N - 3) for e in identity), y, axes, like < ones
    effects = effects_of(sensor, x, measured, numbers, like)
    offset = tuple(like if is_zero(t) else t for t in effects.offset)
    turned_and_J = turned_by((ones, like, like, like), offset)
    turn, J = turned_and_J[:4], turned_and_J[4:]
    predicted = quaternion_multiply(q, turn)
    y = rotation_vector(
        quaternion_multiply((predicted[0], -predicted[1], -predicted[2], -predicted[3]), measured.frame[:4])
    )
    E = transpose(rotation_matrix(turn))  # exp(−[φ]): transforms a body-side error by the further rotation φ
    entering = {t.state: matrix_products(J, a) for t, a in zip(sensor.states, effects.offsets, strict=True)}
    rows = tuple(E[3 * i : 3 * i + 3] + tuple(entering[k][i] if k in entering else 0 for k in OTHERS) for i in AXES)
    return rows, y, axes, dot(offset, offset) < SQUARED_RANGE * 1e9


def rows_of_heading(s, x, measured, numbers, like):
    """Return the row of a heading, its residual, and whether the vector has one."""
    sensor, r = STRUCTURE.sensors[s], measured.frame[6:]
    R = rotation_matrix(tuple_at(x, 0, 4, like))
    ones = like + 1.0
    axes = ((ones, like, like),)
    if not sensor.states:
        m = matrix_times_vector(R, measured.z)
        level = m[0] * m[0] + m[1] * m[1]
        valid = level > VERTICAL
        tilt = -m[2] / select(valid, level, ones)
        unit_row = select(valid, ones, like)
        h = transpose_times_vector(R, (unit_row * (tilt * m[0]), unit_row * (tilt * m[1]), unit_row))
        y = unit_row * arctangent(m[0] * r[1] - m[1] * r[0], m[0] * r[0] + m[1] * r[1])
        return (h + (0,) * (N - 3),), (y,), axes, valid
    effects = effects_of(sensor, x, measured, numbers, like)
    M = tuple(plus(ones if i in DIAGONAL else 0, m) for i, m in enumerate(effects.M))
    D = inverse(tuple(like if is_zero(m) else m for m in M)) if any_number(effects.M) else None
    clean = subtract(measured.z, tuple(like if is_zero(t) else t for t in effects.offset))
    if D is not None:
        clean = matrix_times_vector(D, clean)
    fixed = tuple(like if is_zero(t) else t for t in effects.fixed)
    carried = tuple(like if is_zero(t) else t for t in effects.carried)
    p = subtract(matrix_times_vector(R, clean), carried)
    m = subtract(p, fixed)
    level = m[0] * m[0] + m[1] * m[1]
    valid = level > VERTICAL
    unit_row = select(valid, ones, like)
    y = unit_row * arctangent(m[0] * r[1] - m[1] * r[0], m[0] * r[0] + m[1] * r[1])
    # Derivatives at the predicted heading: those at the measured one depend on its noise, which would bias the estimated offsets.
    stretch = square_root(level / (r[0] * r[0] + r[1] * r[1]))
    m = (stretch * r[0], stretch * r[1], m[2])
    p = add(m, fixed)
    clean = transpose_times_vector(R, add(p, carried))
    inverted = unit_row / select(valid, m[0] * m[0] + m[1] * m[1], ones)
    g = (-inverted * m[1], inverted * m[0], like)
    h = dict(enumerate(transpose_times_vector(R, cross(p, g))))
    share = 1.0 / measured.length
    for t, a, d, U in zip(sensor.states, effects.offsets, effects.fixed_each, effects.scales, strict=True):
        e = tuple(times(share, value) for value in a)
        e = sum_of(e, matrix_products(U, clean))
        if D is not None:
            e = matrix_products(D, e)
        e = sum_of(matrix_products(R, e), tuple(times(share, value) for value in d))
        h[t.state] = times(-1.0, products(g, e))
    return (tuple(h.get(k, 0) for k in STATES),), (y,), axes, valid


def rows_of_vector(s, x, measured, numbers, like, transverse):
    """Return the rows of a direction or vector, residuals, the axes along which the rows measure, and the cosine of :func:`rows_and_axes`.

    The axes of a direction are transverse to the predicted one, and divided by the predicted magnitude, which scales its noise. Those of a
    vector are the frame about its reference or, with error states, the fixed axes: a state along one of them enters one row.
    """
    sensor, z, r = STRUCTURE.sensors[s], measured.z, measured.frame[6:]
    R = rotation_matrix(tuple_at(x, 0, 4, like))
    none = (0,) * (N - 3)
    if not sensor.states:
        u, v = transpose_times_vector(R, measured.frame[:3]), transpose_times_vector(R, measured.frame[3:6])
        third = transpose_times_vector(R, r)
        rows = ((-v[0], -v[1], -v[2], *none), u + none)
        y = (dot(u, z), dot(v, z))
        along = dot(third, z)
        if sensor.kind == DIRECTION:
            return rows, y, (u, v), along
        return (*rows, (0,) * N), (*y, along - 1.0), (u, v, third), along
    effects = effects_of(sensor, x, measured, numbers, like)
    turnable = transpose_times_vector(R, tuple(plus(p, q) for p, q in zip(r, effects.fixed, strict=True)))
    before = tuple(plus(p, products(R[i::3], effects.carried)) for i, p in enumerate(turnable))
    scaled = any(any_number(t.scale) for t in sensor.states)
    M = tuple(plus(like + 1.0 if i in DIAGONAL else 0, m) for i, m in enumerate(effects.M)) if scaled else None
    predicted = matrix_products(M, before) if scaled else before
    predicted = sum_of(predicted, effects.offset)
    squared = dot(predicted, predicted)
    if sensor.kind == DIRECTION:
        t, u = transverse_vectors(predicted, like)
        shrink, over = 1.0 / square_root(squared), 1.0 / square_root(dot(t, t))  # neither root waits for the other
        y = (over * dot(t, z), over * shrink * dot(u, z))
        along = shrink * dot(predicted, z)
        axes = (scale(over * shrink, t), scale(over * shrink * shrink, u))
    else:
        axes = (R[:3], R[3:6], R[6:])
        if transverse:
            axes = tuple(transpose_times_vector(R, measured.frame[3 * i : 3 * i + 3]) for i in AXES)
        y = tuple(dot(t, subtract(z, predicted)) for t in axes)
        along = y[2] + 1.0
    share = 1.0 / measured.length
    rows = []
    for i, t in enumerate(axes):
        ahead = tuple(products(M[j::3], t) for j in AXES) if scaled else t
        h = dict(enumerate(cross(ahead, turnable)))
        for state, a, d, U in zip(sensor.states, effects.offsets, effects.fixed_each, effects.scales, strict=True):
            e = products(t, a)
            if scaled or transverse or sensor.kind == DIRECTION:
                e = plus(e, products(ahead, tuple(products(R[j::3], d) for j in AXES)))
            else:
                e = plus(e, d[i])
            h[state.state] = plus(times(share, e), products(t, matrix_products(U, before)))
        rows.append(tuple(h.get(k, 0) for k in STATES))
    return tuple(rows), y, axes, along


def transverse_vectors(m, like):
    """Return vectors t and m × t across a vector m ≠ 0: t is the product of m and the axis farthest from it."""
    x, y, z = select(m[0] < 0.0, -m[0], m[0]), select(m[1] < 0.0, -m[1], m[1]), select(m[2] < 0.0, -m[2], m[2])
    ones = like + 1.0
    second = select(y < x, select(y <= z, ones, like), like)
    third = select(z < x, ones - second, like)
    t = cross((ones - second - third, second, third), m)
    return t, cross(m, t)


# ------------------------------------------------------------------------------------------------------------------ effects of error states


def effects_of(sensor, x, measured, numbers, like):
    """Return the effects of the states on a sensor."""
    inverted = 1.0 / measured.length
    c = tuple(value_at(x, 1 + t.state, like) for t in sensor.states)
    shares = tuple(inverted * value for value in c)
    offsets = tuple(numbers_of(t.offset, numbers) for t in sensor.states)
    if any(t.lever for t in sensor.states):
        turn = measured.turning
        W_b = turning_matrix(subtract(turn[:3], tuple_at(x, 4, 3, like)), turn[3:6])
        offsets = tuple(
            matrix_products(W_b, offset) if t.lever else offset
            for t, offset in zip(sensor.states, offsets, strict=True)
        )
    fixed = tuple(numbers_of(t.fixed, numbers) for t in sensor.states)
    scales = tuple(numbers_of(t.scale, numbers) for t in sensor.states)
    constant = tuple((0, 0, 0) if t.carried else d for t, d in zip(sensor.states, fixed, strict=True))
    carried = tuple(d if t.carried else (0, 0, 0) for t, d in zip(sensor.states, fixed, strict=True))
    return Effects(
        offsets,
        fixed,
        scales,
        tuple(products(shares, tuple(a[i] for a in offsets)) for i in AXES),
        tuple(products(shares, tuple(d[i] for d in constant)) for i in AXES),
        tuple(products(shares, tuple(d[i] for d in carried)) for i in AXES),
        tuple(products(c, tuple(U[i] for U in scales)) for i in NINE),
    )


def turning_matrix(rate, acceleration):
    """Return W = [ẇ] + [w]²: the acceleration at lever arm a is W a, body axes."""
    x, y, z = rate
    a, b, c = acceleration
    return (
        -(y * y + z * z),
        x * y - c,
        x * z + b,
        x * y + c,
        -(x * x + z * z),
        y * z - a,
        x * z - b,
        y * z + a,
        -(x * x + y * y),
    )


# ------------------------------------------------------------------------------------------------------------------------------------ noise


def arm_noise(s, x, measured, noise, numbers, like):
    """Return the noise plus that of the gyro's angular acceleration at the lever arm r: ``[r] diag(variance) [r]ᵀ``."""
    sensor = STRUCTURE.sensors[s]
    share, variance = 1.0 / measured.length, measured.turning[6:]
    r = (like, like, like)
    for t in sensor.states:
        if t.lever:
            c = share * value_at(x, 1 + t.state, like)
            r = tuple(plus(p, times(c, number(a, numbers))) for p, a in zip(r, t.offset, strict=True))
    return (
        noise[0] + r[2] * r[2] * variance[1] + r[1] * r[1] * variance[2],
        noise[1] - r[0] * r[1] * variance[2],
        noise[2] - r[0] * r[2] * variance[1],
        noise[3] + r[2] * r[2] * variance[0] + r[0] * r[0] * variance[2],
        noise[4] - r[1] * r[2] * variance[0],
        noise[5] + r[1] * r[1] * variance[0] + r[0] * r[0] * variance[1],
    )


def decorrelated(rows, y, axes, noise):
    """Return rows, residuals and variances by L⁻¹ of ``T C Tᵀ = L D Lᵀ``, T the axes of the rows, C the noise (6-tuple, body axes)."""
    c = tuple(symmetric_times_vector(noise, t) for t in axes)
    rows, y, variances, below = list(rows), list(y), [], {}
    for i, t in enumerate(axes):
        d = dot(t, c[i])
        for j in AXES[:i]:
            m = dot(t, c[j])
            for k in AXES[:j]:
                m = m - below[i, k] * below[j, k] * variances[k]
            below[i, j] = m / variances[j]
            d = d - below[i, j] * m
            rows[i] = tuple(plus(p, times(-below[i, j], q)) for p, q in zip(rows[i], rows[j], strict=True))
            y[i] = y[i] - below[i, j] * y[j]
        variances.append(d)
    return tuple(rows), tuple(y), tuple(variances)


# ----------------------------------------------------------------------------------------------------------------------- by shape of sensor


def store_rows(s, x, work, measured, numbers, transverse, like):
    """Write the rows of a measurement to the work space; return its angle, and whether it is valid."""
    H, y, r, angle, valid = rows_of(s, x, measured, numbers, like, transverse)
    for i, h in enumerate(H):
        for j, t in enumerate((*h, y[i], r[i])):
            put_at(work, LINE * (ROWS + i) + j, like if is_zero(t) else like + t)
    return angle, valid


def write_rows(shape, x, body, measured, e, like):
    """Write the rows of a measurement at a state to the work space; return their number, angle and validity. Defined below."""


_SOURCE = """
def transverse_rows_{s}(x, body, measured, e, like):
    return store_rows({s}, x, body.work, measurement_of({s}, body, measured, e), body.model.numbers, True, like)


def write_rows_{s}(x, body, measured, e, like):
    angle, valid = transverse_rows_{s}(x, body, measured, e, like)
    return {rows}, angle, valid
"""
_SOURCE = by_shape(_SOURCE, "write_rows", "x, body, measured, e, like", "0, (like, like), like < like")
exec(compile(_SOURCE, __file__, "exec"), globals())
