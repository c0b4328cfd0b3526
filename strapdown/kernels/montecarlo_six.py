"""The filter of attitude and bias in a Monte Carlo, by :mod:`strapdown.kernels.filter_step`: its state stays in registers.

Only for measurements whose noise is isotropic, or of an attitude one variance per axis.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from strapdown.kernels.algebra import dot, matrix_times_vector, transpose_times_vector
from strapdown.kernels.filter_step import predict, update_direction, update_heading, update_residual
from strapdown.kernels.lane_angles import arctangent, rotation_vector
from strapdown.kernels.lane_values import WIDTH, any_lane
from strapdown.kernels.measurement import ATTITUDE, HEADING, KIND, VECTOR, frame_of, heading_row
from strapdown.kernels.montecarlo_run import KEPT
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix
from strapdown.kernels.state import store_several
from strapdown.kernels.structure import MAX_PRECISION


class State(NamedTuple):
    """Attitude, bias, the blocks of their covariance, and whether a measurement was too precise for double precision."""

    q: Any
    b: Any
    A: Any
    B: Any
    C: Any
    lost: bool


def start_filters(q, b, body, like):
    """Return the initial state."""
    P = body.start.P
    A = (like + P[0, 0], like, like, like + P[1, 1], like, like + P[2, 2])
    C = (like + P[3, 3], like, like, like + P[4, 4], like, like + P[5, 5])
    lost = len(P) < 0  # False, not as a literal: numba would compile the loop for its type too
    return State(q, b, A, (like, like, like, like, like, like, like, like, like), C, lost)


def propagated(state, part, dt, body, like):
    """Propagate all runs."""
    model, (q, b, A, B, C, lost) = body.filters.model, state
    q, A, B, C = predict(q, b, A, B, C, part, dt, model.angle_variance, model.rate_variance)
    return State(q, b, A, B, C, lost)


def corrected(state, value, e, measured, body, like):
    """Update all runs."""
    q, b, A, B, C, lost = state
    at, sensor = measured.place[e], measured.sensor[e]
    kind, variance = measured.series[sensor, KIND], measured.noise[at, 0]
    z, ones = (value[0], value[1], value[2]), like + 1.0
    e2, s2, e3, s3 = like, ones, like, ones
    if kind == ATTITUDE:
        y = rotation_vector(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), value))
        variances = (variance, measured.noise[at, 3], measured.noise[at, 5])
        q, b, A, B, C, e1, s1, e2, s2, e3, s3 = update_residual(q, b, A, B, C, y, variances)
        nis = e1 * e1 / s1 + e2 * e2 / s2 + e3 * e3 / s3
    else:
        frame = frame_of(measured, at, sensor)
        R = rotation_matrix(q)
        r = frame[6:]
        if kind == HEADING:
            m = matrix_times_vector(R, z)
            error = arctangent(m[0] * r[1] - m[1] * r[0], m[0] * r[0] + m[1] * r[1])
            q, b, A, B, C, e1, s1 = update_heading(q, b, A, B, C, heading_row(R, z), error, variance)
            nis = e1 * e1 / s1
        else:
            q, b, A, B, C, e1, s1, e2, s2, nis = update_direction(q, b, A, B, C, R, frame[:3], frame[3:6], z, variance)
            if kind == VECTOR:
                e3 = dot(transpose_times_vector(R, r), z) - 1.0
                s3 = variance * ones
                nis = nis + e3 * e3 / variance
    lost = lost or any_lane(s1 > MAX_PRECISION * variance)
    return State(q, b, A, B, C, lost), nis, (e1, s1, e2, s2, e3, s3)


def keep_filters(state, row, body, out, like):
    """Write the state."""
    store_several(out.kept, row * KEPT * WIDTH, (*state.q, *state.b, *state.A, *state.B, *state.C))
