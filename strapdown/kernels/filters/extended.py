"""An extended Kalman filter with any definition of the error: a body of :mod:`strapdown.kernels.walk` that leaves the definition open.

A module of this folder defines the error: propagation of its covariance over a step (``propagated``), rows of a measurement
(``error_rows``), correction of the state (``closed``), and conversion of the covariance from and to the body-side error (δθ, δb)
(``from_body_side``, ``to_body_side``). The default of each is that of the MEKF. R = R_fb of the estimate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    combine,
    congruent,
    dot,
    matrix_times_vector,
    minus_outer,
    multiply,
    scale,
    symmetric_minus_outer,
    symmetric_times_vector,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.measurement import (
    HEADING,
    KIND,
    degrees_of_freedom,
    frame_of,
    has_heading,
    independent_rows,
    measurement_rows,
    noise_of,
    store_innovations,
    value_of,
)
from strapdown.kernels.rotation import moved, quaternion_multiply, rotation_matrix, unit
from strapdown.kernels.state import load_state, store_state
from strapdown.kernels.walk import step_within, turn_squared

OPEN = ("from_body_side", "to_body_side", "propagated", "error_rows", "row_update", "closed")


class Body(NamedTuple):
    """State, noise and gains of the filter."""

    state: np.ndarray
    """Packed state (28,), body side; at return, the end state."""
    angle_variance: float
    """σ_v², rad²/s."""
    rate_variance: float
    """σ_u², rad²/s³."""
    gains: np.ndarray
    """Gains of attitude and bias (1/s) by sensor (2, sensors) for a filter with fixed gains; otherwise empty."""


class Outputs(NamedTuple):
    """Output arrays."""

    states: np.ndarray
    """Packed states (rows, 28), body side."""
    innovation: np.ndarray
    """(events, 6) by place."""


def from_body_side(q, A, B, C):
    """Return the covariance blocks of the filter's error from those of the body-side error."""


def to_body_side(q, A, B, C):
    """Return the covariance blocks of the body-side error from those of the filter's error."""


def propagated(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance):
    """Return q, A, B, C after a small increment."""


def error_rows(kind, q, R, z, frame, noise):
    """Return (h1, h2, h3, y1, y2, y3, covariance of the noise) in the axes of the attitude error."""


def row_update(a, c, A, B, C, h, y, variance):
    """Return (a, c, A, B, C, innovation, its variance) after a scalar row; (a, c) is the correction by the rows before it."""


def closed(q, b, A, B, C, correction, bias_correction):
    """Return q, b, A, B, C after a correction."""


# ------------------------------------------------------------------------------------------------------------------ the body of the walk


def begin(body):
    """Return (q, b, A, B, C) in the filter's own error."""
    q, b, A, B, C = load_state(body.state)
    A, B, C = from_body_side(q, A, B, C)
    return q, b, A, B, C


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return step_within(turn_squared(part, dt, state[1]), dt)


def predict(state, part, dt, body, out):
    """Propagate."""
    q, b, A, B, C = state
    q, A, B, C = propagated(q, b, A, B, C, part, dt, body.angle_variance, body.rate_variance)
    return q, b, A, B, C


def update(state, e, now, measured, body, out):
    """Update with a measurement, row by row."""
    q, b, A, B, C = state
    place = measured.place[e]
    sensor = measured.sensor[e]
    kind = measured.series[sensor, KIND]
    z = value_of(measured, place, sensor)
    R = rotation_matrix(q)
    a = (0.0, 0.0, 0.0)
    c = (0.0, 0.0, 0.0)
    e1, s1, e2, s2, e3, s3 = math.nan, 0.0, 0.0, 1.0, 0.0, 1.0
    if kind != HEADING or has_heading(R, z):
        noise = noise_of(measured, place, sensor, kind, z)
        h1, h2, h3, y1, y2, y3, noise = error_rows(kind, q, R, z, frame_of(measured, place, sensor), noise)
        h1, h2, h3, y1, y2, y3, noise = independent_rows(h1, h2, h3, y1, y2, y3, noise)
        number = degrees_of_freedom(kind)
        a, c, A, B, C, e1, s1 = row_update(a, c, A, B, C, h1, y1, noise[0])
        if number > 1:
            a, c, A, B, C, e2, s2 = row_update(a, c, A, B, C, h2, y2, noise[1])
        if number > 2:
            a, c, A, B, C, e3, s3 = row_update(a, c, A, B, C, h3, y3, noise[2])
        q, b, A, B, C = closed(q, b, A, B, C, a, c)
    store_innovations(out.innovation, place, (e1, e2, e3), (s1, s2, s3))
    return q, b, A, B, C


def keep(state, row, e, body, out):
    """Write a row, body side."""
    q, b, A, B, C = state
    A_b, B_b, C_b = to_body_side(q, A, B, C)
    store_state(out.states[row], q, b, A_b, B_b, C_b)
    return state


def finish(state, row, e, body):
    """Store the end state, body side."""
    q, b, A, B, C = state
    A, B, C = to_body_side(q, A, B, C)
    store_state(body.state, q, b, A, B, C)
    return row


# -------------------------------------------------------------------------------------------------------- pieces that definitions share


def negated(v):
    """Return −v."""
    return (-v[0], -v[1], -v[2])


def turned_in_fixed_axes(q, phi):
    """Return exp(φ) ⊗ q, normalised: a rotation by φ of any size in fixed axes."""
    turn, _ = moved((1.0, 0.0, 0.0, 0.0), phi)
    return unit(quaternion_multiply(turn, q))


def joseph_row(a, c, A, B, C, h, y, variance):
    """Update with one scalar row ``y = h · (attitude error) + v``, Var v = ``variance``; (a, c) is the correction by the rows before it.

    Joseph's form ``(I − k hᵀ) P (I − k hᵀ)ᵀ + r k kᵀ``, written as the short form with a correction by its rounding error in the attitude,
    ``d = (P − k p) h − r k``.
    """
    pa = symmetric_times_vector(A, h)
    pb = transpose_times_vector(B, h)
    s = dot(h, pa) + variance
    ka = scale(1.0 / s, pa)
    kb = scale(1.0 / s, pb)
    innovation = y - dot(h, a)
    short = symmetric_minus_outer(A, ka, pa)
    d = combine(1.0, symmetric_times_vector(short, h), -variance, ka)
    return (
        combine(1.0, a, innovation, ka),
        combine(1.0, c, innovation, kb),
        symmetric_minus_outer(short, d, ka),
        minus_outer(minus_outer(B, ka, pb), d, kb),
        symmetric_minus_outer(C, kb, pb),
        innovation,
        s,
    )


def rows_in_fixed_axes(kind, q, R, z, frame, noise):
    """Return a measurement's rows for an attitude error in fixed axes, R h; for a constant direction they do not depend on the estimate."""
    h1, h2, h3, y1, y2, y3, noise = measurement_rows(kind, q, R, z, frame, noise)
    return matrix_times_vector(R, h1), matrix_times_vector(R, h2), matrix_times_vector(R, h3), y1, y2, y3, noise


def attitude_turned_axes(M, A, B):
    """Return blocks A and B with the attitude error in other axes, by the rotation M."""
    return congruent(M, A), multiply(M, B)


def bias_turned_axes(M, B, C):
    """Return blocks B and C with the bias error in other axes, by the rotation M."""
    return multiply(B, transpose(M)), congruent(M, C)
