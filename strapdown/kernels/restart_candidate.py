"""The restart candidate of a gate: state 1 of the filter, which starts anew beside state 0 after refusals, and may replace it.

When it starts, widens and takes over is decided by :mod:`strapdown.kernels.gate_rules`. Scalar only.
"""

from __future__ import annotations

from strapdown.kernels.algebra import combine
from strapdown.kernels.chains import SET, double_step, fill_coefficients
from strapdown.kernels.gate_rules import (
    FIRST_BIAS,
    count_widening,
    may_widen,
    reset_candidate,
    restart_attitude,
    restart_width,
    start_undone,
)
from strapdown.kernels.iterated_update import tangent_after
from strapdown.kernels.layout import (
    LINE,
    OTHERS,
    PRODUCT,
    SIZE_OF_P,
    STRUCTURE,
    N,
    W,
    attitude_covariance,
    bias_at,
    copy_values,
)
from strapdown.kernels.measurement import quaternion_at
from strapdown.kernels.model import apply_chains, chain_matrix, chain_noise
from strapdown.kernels.rotation import quaternion_multiply
from strapdown.kernels.structural_zeros import products
from strapdown.kernels.tangent_space import put_attitude, turn_attitude
from strapdown.kernels.update import minus_outer_rows


def start_candidate(body, memory, now, attitude_sigma, restart):
    """Write state 1: attitude and bias of the filter with initial covariances, and the error states with their prior, propagated to now.

    The error states of the filter may be in error too, by an unknown amount; their prior remains valid. The covariances of attitude and
    bias increase with the number of candidates before it.
    """
    x, P = body.x, body.P
    width, sigma = restart_width(memory), restart_attitude(attitude_sigma, memory)
    for j in range(SIZE_OF_P):
        P[1, j] = 0.0
    for j in range(7):
        x[1, j] = x[0, j]
    for a in range(3):
        P[1, W * a + a] = sigma * sigma
        for b in range(3):
            P[1, W * (3 + a) + 3 + b] = P[0, W * (3 + a) + 3 + b]
        P[1, W * (3 + a) + 3 + a] += width * width * restart.bias_variance[a]
    for a in range(N - 6):
        x[1, 7 + a] = restart.values[a]
        for b in range(N - 6):
            P[1, W * (6 + a) + 6 + b] = restart.covariance[a, b]
    age_states(x[1], P[1], body.coefficients, now - restart.time, body.model)
    body.dt[0] = 0.0  # the coefficients are those of another step
    reset_candidate(memory, now, bias_at(body, 1), bias_variances(P[1]))


def bias_variances(P):
    """Return the variances of the bias (3,)."""
    return (P[W * 3 + 3], P[W * 4 + 4], P[W * 5 + 5])


def age_states(x, P, coefficients, age, model):
    """Propagate error states that are independent of attitude and bias over any time: a short step, doubled."""
    if age > 0.0 and len(model.last) > 0:
        h, doublings = age, 0
        while h > model.limit:
            h *= 0.5
            doublings += 1
        fill_coefficients(coefficients, h, model)
        for _ in range(doublings):
            for g in range(len(model.last)):
                double_step(coefficients, SET * g)
        age_chains(x, P, coefficients)


def age_chains(x, P, coefficients):
    """Apply the coefficients to the error states, which are independent of attitude and bias."""
    apply_chains(x, 1, coefficients, 0.0)
    for states, g in STRUCTURE.chains:
        F = chain_matrix(coefficients, g, len(states))
        for j in OTHERS[3:]:
            old = tuple(P[W * k + j] for k in states)
            for k, row in zip(states, F, strict=True):
                P[W * k + j] = products(row, old)
    for states, g in STRUCTURE.chains:
        F = chain_matrix(coefficients, g, len(states))
        for j in OTHERS[3:]:
            old = tuple(P[W * j + k] for k in states)
            for i, (k, row) in enumerate(zip(states, F, strict=True)):
                t = products(row, old)
                if j in states:
                    d = states.index(j)
                    t = t + chain_noise(coefficients, g, len(states), min(i, d), max(i, d))
                P[W * j + k] = t


def widen(body, memory):
    """Increase the initial bias variance of the candidate retroactively, if that start still determines its bias.

    The start is removed by a measurement of negative variance, of magnitude above that of the bias, which only adds |1/s| P e (P e)ᵀ to P.
    """
    x, P, work = body.x[1], body.P[1], body.work
    if not may_widen(bias_variances(P), memory):
        return
    column = LINE * PRODUCT
    turn = (0.0, 0.0, 0.0)
    for i in range(3):
        for j in range(N):
            work[column + j] = P[W * j + 3 + i]
        inverse = start_undone(i, work[column + 3 + i], memory)
        share = inverse * (memory[FIRST_BIAS + i] - x[4 + i])
        turn = combine(1.0, turn, share, (work[column], work[column + 1], work[column + 2]))
        for j in range(3, N):
            x[1 + j] += share * work[column + j]
        minus_outer_rows(P, work, column, column, inverse, 0.0)
    before = quaternion_at(body.x, 1)
    q, G = tangent_after(turn, attitude_covariance(body, 1))
    turn_attitude(P, G)
    put_attitude(x, P, before, quaternion_multiply(before, q))
    count_widening(memory)


def replace_by_candidate(body):
    """Replace the filter by the restart candidate."""
    copy_values(body.x[1], body.x[0], N + 1, 0.0)
    copy_values(body.P[1], body.P[0], SIZE_OF_P, 0.0)
