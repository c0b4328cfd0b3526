"""The multiplicative EKF of attitude and gyro bias in registers, without a gate; run by :mod:`strapdown.kernels.walk`.

The formulas are those of :mod:`strapdown.kernels.filter_step`; the same filter for any number of states is :mod:`strapdown.kernels.filter`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import dot, transpose_times_vector
from strapdown.kernels.filter_step import predict as propagated
from strapdown.kernels.filter_step import update_attitude, update_direction, update_heading
from strapdown.kernels.measurement import (
    ATTITUDE,
    HEADING,
    KIND,
    VECTOR,
    frame_of,
    has_heading,
    heading_error,
    heading_row,
    value_of,
)
from strapdown.kernels.rotation import rotation_matrix
from strapdown.kernels.state import keep_state, load_state, store_state
from strapdown.kernels.structure import MAX_PRECISION
from strapdown.kernels.walk import step_within, turn_squared


class Body(NamedTuple):
    """State and noise of the filter."""

    state: np.ndarray
    """Packed state (28,); at return, the end state."""
    angle_variance: float
    """σ_v², rad²/s."""
    rate_variance: float
    """σ_u², rad²/s³."""


class Outputs(NamedTuple):
    """Output arrays: a row for each stored edge (m); innovations by measurement."""

    attitude: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    """By rows (m, 36), or (0, 36)."""
    innovation: np.ndarray
    """e₁, s₁, e₂, s₂, e₃, s₃ (events, 4 or 6): independent innovations and their variances, as many as there are degrees of freedom."""
    segments: np.ndarray
    """Each prediction, for a smoother (k, 32), or (0, 32): dt, increment (3), state before it (28)."""


def store_segment(out, k, dt, part, q, b, A, B, C):
    """Write row k of the segments: dt, increment, state."""
    out[k, 0] = dt
    out[k, 1], out[k, 2], out[k, 3] = part
    store_state(out[k, 4:], q, b, A, B, C)


# ------------------------------------------------------------------------------------------------------------ the filter without options


def begin(body):
    """Return (q, b, A, B, C), the number of segments, and whether a measurement was too precise for double precision."""
    q, b, A, B, C = load_state(body.state)
    # From an array, and not the literal 0: numba would compile the body for that type too.
    segments = 0 * len(body.state)
    return q, b, A, B, C, segments, segments > 0


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return step_within(turn_squared(part, dt, state[1]), dt)


def predict(state, part, dt, body, out):
    """Store the prediction for a smoother, and propagate."""
    q, b, A, B, C, segments, lost = state
    if segments < len(out.segments):
        store_segment(out.segments, segments, dt, part, q, b, A, B, C)
        segments += 1
    q, A, B, C = propagated(q, b, A, B, C, part, dt, body.angle_variance, body.rate_variance)
    return q, b, A, B, C, segments, lost


def update(state, e, now, measured, body, out):
    """Update with a measurement whose noise is isotropic, or of an attitude one variance per axis."""
    q, b, A, B, C, segments, lost = state
    R = rotation_matrix(q)
    at = measured.place[e]
    s = measured.sensor[e]
    kind = measured.series[s, KIND]
    frame = frame_of(measured, at, s)
    z = value_of(measured, at)
    sigma = measured.sigma[at]
    variance = sigma * sigma
    if kind == ATTITUDE:
        q, b, A, B, C, e1, s1, e2, s2, e3, s3 = update_attitude(q, b, A, B, C, frame[:4], z)
        out.innovation[at, 4] = e3
        out.innovation[at, 5] = s3
        sharp = s1 > MAX_PRECISION * z[0] or s2 > MAX_PRECISION * z[1] or s3 > MAX_PRECISION * z[2]
    elif kind != HEADING:
        if kind == VECTOR:
            # The length has no information about the attitude but is part of the innovation.
            out.innovation[at, 4] = dot(transpose_times_vector(R, frame[6:]), z) - 1.0
            out.innovation[at, 5] = variance
        q, b, A, B, C, e1, s1, e2, s2, _ = update_direction(q, b, A, B, C, R, frame[:3], frame[3:6], z, variance)
        sharp = max(s1, s2) > MAX_PRECISION * variance
    else:
        e1, s1, e2, s2 = math.nan, 0.0, 0.0, 1.0
        if has_heading(R, z):
            error = heading_error(R, z, frame[6:])
            q, b, A, B, C, e1, s1 = update_heading(q, b, A, B, C, heading_row(R, z), error, variance)
        sharp = s1 > MAX_PRECISION * variance
    out.innovation[at, 0] = e1
    out.innovation[at, 1] = s1
    out.innovation[at, 2] = e2
    out.innovation[at, 3] = s2
    return q, b, A, B, C, segments, lost or sharp


def keep(state, row, e, body, out):
    """Write a row."""
    keep_state(out, row, *state[:5])
    return state


def stopped(state):
    """Return whether a measurement was too precise."""
    return state[6]


def finish(state, row, e, body):
    """Store the end state and return the number of segments; −1: a measurement was too precise."""
    q, b, A, B, C, segments, lost = state
    store_state(body.state, q, b, A, B, C)
    return -1 if lost else segments
