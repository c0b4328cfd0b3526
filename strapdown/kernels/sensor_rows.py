"""Rows of a measurement with error states, for one filter or several in lanes (SIMD); the model is that of :mod:`.error_state_step`.

The functions in ``REPLACEABLE`` are defined here for one filter; a kernel for lanes replaces them. ``like`` is zero, a float or lanes. If
``sensor_use`` is all zero, the rows are those of the filter without error states.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    add_matrices,
    combine,
    cross,
    dot,
    matrix_times_vector,
    scale,
    scale_matrix,
    square_root,
    subtract,
    symmetric_times_vector,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.error_state_step import CARRIED, FIXED, LEVER, OFFSET, SCALE, inverse
from strapdown.kernels.lane_values import chosen, everywhere
from strapdown.kernels.measurement import ATTITUDE, DIRECTION, HEADING, VERTICAL
from strapdown.kernels.rotation import logarithm, moved, quaternion_multiply, rotation_matrix
from strapdown.kernels.series import SQUARED_RANGE

REPLACEABLE = ("state_at", "row_entry", "set_row_entry", "turned_by", "turn_vector", "angle_of")
CALLED = ("fill_rows", "decorrelate", "arm_noise")
"""Called, not inlined, by other kernels: a call costs little compared with their work, and each copy would be compiled again."""


def state_at(x, i, like):
    """Return component i of bias and error states."""
    return x[i]


def row_entry(H, r, i, like):
    """Return an entry of the rows."""
    return H[r, i]


def set_row_entry(H, r, i, like, value):
    """Write an entry of the rows."""
    H[r, i] = value


def turned_by(q, phi):
    """Return q ⊗ exp(φ) and J_r(φ)."""
    return moved(q, phi)


def turn_vector(q):
    """Return the rotation vector of a unit quaternion."""
    return logarithm(q)


def angle_of(y, x):
    """Return the angle of the point (x, y), rad."""
    return math.atan2(y, x)


# ------------------------------------------------------------------------------------------------------------------------------- rows


def identity(like):
    """Return the identity matrix."""
    one = like + 1.0
    return (one, like, like, like, one, like, like, like, one)


def triple_at(array, s, k, first):
    """Return three numbers of row (s, k) of an array."""
    return tuple(array[s, k, first + i] for i in range(3))


def matrix_at(array, s, k):
    """Return the 3×3 matrix that ends row (s, k) of an array (…, …, 15)."""
    return tuple(array[s, k, i] for i in range(6, 15))


def offset_of(sensors, sensor_use, s, k, W):
    """Return the offset of sensor s per unit of state k, body axes."""
    a = triple_at(sensors, s, k, 0)
    if sensor_use[s, k] & LEVER:
        return matrix_times_vector(W, a)
    return a


def put_row(H, row, like, h):
    """Write the attitude columns of a row."""
    set_row_entry(H, row, 0, like, h[0])
    set_row_entry(H, row, 1, like, h[1])
    set_row_entry(H, row, 2, like, h[2])


def across(d, like):
    """Return unit vectors t1, t2 with t1 × t2 = d, for a unit vector d."""
    one = like + 1.0
    x, y, z = chosen(d[0] < 0.0, -d[0], d[0]), chosen(d[1] < 0.0, -d[1], d[1]), chosen(d[2] < 0.0, -d[2], d[2])
    second = chosen(y < x, chosen(y <= z, one, like), like)
    third = chosen(z < x, one - second, like)
    t = cross((one - second - third, second, third), d)
    t = scale(1.0 / square_root(dot(t, t)), t)
    return t, cross(d, t)


def sensed(x, s, length, sensors, sensor_use, W, like):
    """Return the effects of the states on a sensor's vector, and whether any state affects it.

    The effects are the offset in body axes, the constant and the carried offset in fixed axes, and I + M.
    """
    offset = fixed = carried = (like, like, like)
    M = identity(like)
    coupled = False
    for k in range(sensor_use.shape[1]):
        use = sensor_use[s, k]
        if use != 0:
            coupled = True
            c = state_at(x, 3 + k, like)
            if use & (OFFSET | LEVER):
                offset = combine(1.0, offset, c / length, offset_of(sensors, sensor_use, s, k, W))
            if use & CARRIED:
                carried = combine(1.0, carried, c / length, triple_at(sensors, s, k, 3))
            elif use & FIXED:
                fixed = combine(1.0, fixed, c / length, triple_at(sensors, s, k, 3))
            if use & SCALE:
                M = add_matrices(M, scale_matrix(c, matrix_at(sensors, s, k)))
    return offset, fixed, carried, M, coupled


def fill_rows(q, x, H, kind, value, frame, length, s, sensors, sensor_use, W, like):
    """Write the rows of one measurement to H (3, n or more), which is zero for states that do not affect it.

    ``value`` is the measured vector divided by ``length``, with an unused fourth number, or the measured attitude. ``frame`` is the
    right-handed frame about the reference as a 9-tuple, ``length`` the divisor of the vector or, for a direction or heading, the magnitude
    of the measured vector. ``W`` is the current :func:`strapdown.kernels.error_state_step.turning_matrix`, for lever arms.

    Returns the number of rows (2 direction, 3 vector, 1 heading, 3 attitude), the residual y (3,), the body axes along which the rows
    measure (for a direction divided by the predicted magnitude, which scales its noise), and whether the rows are valid: a vertical vector
    has no heading, and its row remains zero.
    """
    if kind == ATTITUDE:
        return attitude_rows(q, x, H, value, length, s, sensors, sensor_use, W, like)
    if kind == HEADING:
        return heading_rows(q, x, H, value, frame, length, s, sensors, sensor_use, W, like)
    return vector_rows(q, x, H, kind, value, frame, length, s, sensors, sensor_use, W, like)


def body_axes(like):
    """Return the body axes, as the axes of a measurement."""
    one = like + 1.0
    return ((one, like, like), (like, one, like), (like, like, one))


def attitude_rows(q, x, H, value, length, s, sensors, sensor_use, W, like):
    """Write the rows of an attitude: the offset is a rotation vector between sensor axes and body axes."""
    offset, _, _, _, _ = sensed(x, s, length, sensors, sensor_use, W, like)
    predicted, J = turned_by(q, offset)
    y = turn_vector(quaternion_multiply((predicted[0], -predicted[1], -predicted[2], -predicted[3]), value))
    turn, _ = turned_by((like + 1.0, like, like, like), offset)
    E = transpose(rotation_matrix(turn))  # exp(−[φ]): transforms a body-side error by the further rotation φ
    put_row(H, 0, like, E[:3])
    put_row(H, 1, like, E[3:6])
    put_row(H, 2, like, E[6:])
    for k in range(sensor_use.shape[1]):
        if sensor_use[s, k] & OFFSET:
            t = matrix_times_vector(J, triple_at(sensors, s, k, 0))
            for i in range(3):
                set_row_entry(H, i, 6 + k, like, t[i])
    return 3, y, body_axes(like), dot(offset, offset) <= SQUARED_RANGE


def heading_rows(q, x, H, value, frame, length, s, sensors, sensor_use, W, like):
    """Write the row of a heading."""
    r = frame[6:]
    R = rotation_matrix(q)
    offset, fixed, carried, M, coupled = sensed(x, s, length, sensors, sensor_use, W, like)
    D = inverse(M) if coupled else M
    clean = matrix_times_vector(D, subtract(value[:3], offset))
    p = subtract(matrix_times_vector(R, clean), carried)
    m = subtract(p, fixed)
    level = m[0] * m[0] + m[1] * m[1]
    if everywhere(level <= VERTICAL):
        return 1, (like, like, like), body_axes(like), level > VERTICAL
    y = angle_of(m[0] * r[1] - m[1] * r[0], m[0] * r[0] + m[1] * r[1])
    if coupled:
        # Derivatives at the predicted heading: those at the measured one depend on its noise, which would bias the estimated offsets.
        stretch = square_root(level / (r[0] * r[0] + r[1] * r[1]))
        m = (stretch * r[0], stretch * r[1], m[2])
        p = add(m, fixed)
        clean = transpose_times_vector(R, add(p, carried))
    inverted = 1.0 / (m[0] * m[0] + m[1] * m[1])
    g = (-inverted * m[1], inverted * m[0], like)
    put_row(H, 0, like, transpose_times_vector(R, cross(p, g)))
    for k in range(sensor_use.shape[1]):
        use = sensor_use[s, k]
        if use != 0:
            e = combine(1.0, (like, like, like), 1.0 / length, offset_of(sensors, sensor_use, s, k, W))
            if use & SCALE:
                e = add(e, matrix_times_vector(matrix_at(sensors, s, k), clean))
            e = matrix_times_vector(R, matrix_times_vector(D, e))
            d = scale(1.0 / length, triple_at(sensors, s, k, 3))
            set_row_entry(H, 0, 6 + k, like, -dot(g, add(e, d)))
    return 1, (y, like, like), body_axes(like), level > VERTICAL


def vector_rows(q, x, H, kind, value, frame, length, s, sensors, sensor_use, W, like):
    """Write the rows of a direction or vector."""
    number = 2 if kind == DIRECTION else 3
    z, r = value[:3], frame[6:]
    R = rotation_matrix(q)
    u, v = transpose_times_vector(R, frame[:3]), transpose_times_vector(R, frame[3:6])
    third = transpose_times_vector(R, r)
    offset, fixed, carried, M, coupled = sensed(x, s, length, sensors, sensor_use, W, like)
    if not coupled:
        put_row(H, 0, like, (-v[0], -v[1], -v[2]))
        put_row(H, 1, like, u)
        put_row(H, 2, like, (like, like, like))
        return number, (dot(u, z), dot(v, z), dot(third, z) - 1.0), (u, v, third), like < like + 1.0
    turnable = transpose_times_vector(R, add(r, fixed))
    seen = add(turnable, transpose_times_vector(R, carried))
    m = add(matrix_times_vector(M, seen), offset)
    shrink = like + 1.0
    residual = subtract(z, m)
    if number == 2:
        residual = z
        shrink = 1.0 / square_root(dot(m, m))
        u, v = across(scale(shrink, m), like)
    axes = (u, v, third)
    # ∂m/∂δθ = (I + M) [R_fbᵀ (r + d)], and t · (A × δθ) = (t × A) · δθ
    for i in range(number):
        put_row(H, i, like, scale(shrink, cross(transpose_times_vector(M, axes[i]), turnable)))
    for k in range(sensor_use.shape[1]):
        use = sensor_use[s, k]
        if use != 0:
            e = add((like, like, like), offset_of(sensors, sensor_use, s, k, W))
            if use & FIXED:
                e = add(e, matrix_times_vector(M, transpose_times_vector(R, triple_at(sensors, s, k, 3))))
            e = scale(1.0 / length, e)
            if use & SCALE:
                e = add(e, matrix_times_vector(matrix_at(sensors, s, k), seen))
            for i in range(number):
                set_row_entry(H, i, 6 + k, like, shrink * dot(axes[i], e))
    y = (dot(u, residual), dot(v, residual), dot(third, residual))
    return number, y, (scale(shrink, u), scale(shrink, v), scale(shrink, third)), like < like + 1.0


def arm_noise(x, s, sensors, sensor_use, length, variance, C, like):
    """Return C plus the noise from the gyro's angular acceleration at lever arm r: ``[r] diag(variance) [r]ᵀ``, ``variance`` by axis."""
    r = (like, like, like)
    for k in range(sensor_use.shape[1]):
        if sensor_use[s, k] & LEVER:
            r = combine(1.0, r, state_at(x, 3 + k, like) / length, triple_at(sensors, s, k, 0))
    return (
        C[0] + r[2] * r[2] * variance[1] + r[1] * r[1] * variance[2],
        C[1] - r[0] * r[1] * variance[2],
        C[2] - r[0] * r[2] * variance[1],
        C[3] + r[2] * r[2] * variance[0] + r[0] * r[0] * variance[2],
        C[4] - r[1] * r[2] * variance[0],
        C[5] + r[1] * r[1] * variance[0] + r[0] * r[0] * variance[1],
    )


def decorrelate(H, use, rows, y, axes, C, like):
    """Decorrelate the rows of a measurement whose noise in body axes has the covariance C (6-tuple); return y and the variances.

    With ``T C Tᵀ = L D Lᵀ``, T the axes of the rows, the noise of the rows ``L⁻¹ H`` has the diagonal covariance D.
    """
    t0, t1, t2 = axes
    c0, c1 = symmetric_times_vector(C, t0), symmetric_times_vector(C, t1)
    d0 = dot(t0, c0)
    l10, l20 = dot(t1, c0) / d0, dot(t2, c0) / d0
    d1 = dot(t1, c1) - l10 * l10 * d0
    l21 = (dot(t2, c1) - l20 * l10 * d0) / d1
    d2 = dot(t2, symmetric_times_vector(C, t2)) - l20 * l20 * d0 - l21 * l21 * d1
    for i in range(6 + len(use) if rows > 1 else 0):
        if i < 3 or (i >= 6 and use[i - 6] != 0):
            h0 = row_entry(H, 0, i, like)
            h1 = row_entry(H, 1, i, like) - l10 * h0
            set_row_entry(H, 1, i, like, h1)
            if rows > 2:
                set_row_entry(H, 2, i, like, row_entry(H, 2, i, like) - l20 * h0 - l21 * h1)
    y1 = y[1] - l10 * y[0]
    return (y[0], y1, y[2] - l20 * y[0] - l21 * y1), (d0, d1, d2)
