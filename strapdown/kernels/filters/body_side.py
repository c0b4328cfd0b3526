"""The error of the MEKF, body side: ``q_true = q ⊗ exp(δθ)``, ``δb = b_true − b``: the default of the other filters."""

from __future__ import annotations

from strapdown.kernels.algebra import add, congruent, multiply
from strapdown.kernels.filter_step import predict as propagated_body_side
from strapdown.kernels.filters.extended import joseph_row
from strapdown.kernels.measurement import measurement_rows
from strapdown.kernels.rotation import moved, unit


def from_body_side(q, A, B, C):
    """Return the blocks unchanged."""
    return A, B, C


def to_body_side(q, A, B, C):
    """Return the blocks unchanged."""
    return A, B, C


def propagated(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance):
    """Propagate (δθ, δb) exactly at constant rate."""
    return propagated_body_side(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance)


def error_rows(kind, q, R, z, frame, noise):
    """Return a measurement's rows in body axes."""
    return measurement_rows(kind, q, R, z, frame, noise)


def row_update(a, c, A, B, C, h, y, variance):
    """Update with one scalar row by Joseph's form."""
    return joseph_row(a, c, A, B, C, h, y, variance)


def closed(q, b, A, B, C, correction, bias_correction):
    """Correct the state, and transform the covariance to the new tangent space by J_r."""
    q, G = moved(q, correction)
    return unit(q), add(b, bias_correction), congruent(G, A), multiply(G, B), C
