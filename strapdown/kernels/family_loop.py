"""Whole records through the extended Kalman filters beside the MEKF. Compiled by :func:`strapdown.kernels.machine.compiled`.

A record comes as a list of steps (:class:`strapdown.family.stepping.Steps`): each predicts over ``dt`` if it is greater than zero, then
takes in the event that it names, if any, then stores the output row that it names, if any.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import matrix_times_vector, transpose
from strapdown.kernels.family_step import (
    attitude_turned_axes,
    bias_turned_axes,
    close_fixed_side,
    close_geometric,
    close_right_invariant,
    close_two_frame,
    predict_body_side,
    predict_fixed_side,
    predict_two_frame,
    take_row,
)
from strapdown.kernels.measurement import (
    ATTITUDE,
    HEADING,
    VECTOR,
    frame_at,
    has_heading,
    independent_rows,
    measurement_rows,
    six_at,
    vector_at,
)
from strapdown.kernels.rotation import rotation_matrix
from strapdown.kernels.state import load_state, store_state

FIXED_SIDE = 0
RIGHT_INVARIANT = 1
TWO_FRAME = 2
GEOMETRIC = 3


def from_body_side(variant, q, A, B, C):
    """Return the blocks of a filter's own error coordinates of those of the body side (δθ, δb)."""
    if variant != GEOMETRIC:
        R = rotation_matrix(q)
        A, B = attitude_turned_axes(R, A, B)
        if variant == TWO_FRAME:
            B, C = bias_turned_axes(R, B, C)
    return A, B, C


def to_body_side(variant, q, A, B, C):
    """Return the blocks of the body side (δθ, δb) of those of a filter's own error coordinates."""
    if variant != GEOMETRIC:
        R = transpose(rotation_matrix(q))
        A, B = attitude_turned_axes(R, A, B)
        if variant == TWO_FRAME:
            B, C = bias_turned_axes(R, B, C)
    return A, B, C


def run_extended(
    variant,
    dt,
    increment,
    event,
    row,
    angle_variance,
    rate_variance,
    event_kind,
    event_value,
    event_noise,
    event_reference,
    triads,
    state,
    state_out,
    innovation_out,
):
    """Run one extended Kalman filter over the steps of a record.

    ``state`` (28 numbers: q, b, A, B, C, body side) is the initial state; ``state_out`` (rows, 28) gets the states, body side too;
    ``event_noise`` (events, 6) holds the upper triangle of each measurement's covariance in body axes, of a heading its variance first.
    ``innovation_out`` (events, 6) gets e₁, s₁, e₂, s₂, e₃, s₃ of each event as :func:`strapdown.kernels.filter_loop.run_filter` does.
    """
    q, b, A, B, C = load_state(state)
    A, B, C = from_body_side(variant, q, A, B, C)
    for k in range(len(dt)):
        if dt[k] > 0.0:
            theta = vector_at(increment, k)
            if variant == GEOMETRIC:
                q, A, B, C = predict_body_side(q, b, A, B, C, theta, dt[k], angle_variance, rate_variance)
            elif variant == TWO_FRAME:
                q, A, B, C = predict_two_frame(q, b, A, B, C, theta, dt[k], angle_variance, rate_variance)
            else:
                q, A, B, C = predict_fixed_side(q, b, A, B, C, theta, dt[k], angle_variance, rate_variance)
        e = event[k]
        if e >= 0:
            R = rotation_matrix(q)
            z = vector_at(event_value, e)
            kind = event_kind[e]
            a = (0.0, 0.0, 0.0)
            c = (0.0, 0.0, 0.0)
            e1, s1, e2, s2, e3, s3 = math.nan, 0.0, 0.0, 1.0, 0.0, 1.0
            if kind != HEADING or has_heading(R, z):
                h1, h2, h3, y1, y2, y3, noise = measurement_rows(
                    kind, q, R, z, frame_at(triads, event_reference[e]), six_at(event_noise, e)
                )
                h1, h2, h3, y1, y2, y3, noise = independent_rows(h1, h2, h3, y1, y2, y3, noise)
                if variant != GEOMETRIC:
                    # A row h of the body side is R h in fixed axes, of a constant direction its triad, whatever the estimate.
                    h1 = matrix_times_vector(R, h1)
                    h2 = matrix_times_vector(R, h2)
                    h3 = matrix_times_vector(R, h3)
                a, c, A, B, C, e1, s1 = take_row(a, c, A, B, C, h1, y1, noise[0])
                if kind != HEADING:
                    a, c, A, B, C, e2, s2 = take_row(a, c, A, B, C, h2, y2, noise[1])
                if kind in (VECTOR, ATTITUDE):
                    a, c, A, B, C, e3, s3 = take_row(a, c, A, B, C, h3, y3, noise[2])
            if variant == FIXED_SIDE:
                q, b, A, B = close_fixed_side(q, b, A, B, a, c)
            elif variant == RIGHT_INVARIANT:
                q, b = close_right_invariant(q, b, a, c)
            elif variant == TWO_FRAME:
                q, b = close_two_frame(q, b, a, c)
            else:
                q, b, B, C = close_geometric(q, b, A, B, C, a, c)
            innovation_out[e, 0], innovation_out[e, 1] = e1, s1
            innovation_out[e, 2], innovation_out[e, 3] = e2, s2
            innovation_out[e, 4], innovation_out[e, 5] = e3, s3
        if row[k] >= 0:
            A_b, B_b, C_b = to_body_side(variant, q, A, B, C)
            store_state(state_out[row[k]], q, b, A_b, B_b, C_b)
