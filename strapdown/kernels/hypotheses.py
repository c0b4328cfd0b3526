"""A weighted set of attitude filters, until their mixture is close to one Gaussian: a body of :mod:`strapdown.kernels.walk`.

Each hypothesis is a state of the filter (:mod:`strapdown.kernels.filter`) of six error states, updated as by a gate
(:func:`strapdown.kernels.gate.iterated_update`). Its weight is the likelihood of its innovations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import add, combine, dot, factored, solved
from strapdown.kernels.filter import WIDTH_OF_ROW, bias_at, load, propagate_row, turn_tangent
from strapdown.kernels.gate import Options, iterated_update
from strapdown.kernels.gate_rules import WIDE_PASSES
from strapdown.kernels.iterated_update import PASSED_OVER
from strapdown.kernels.measurement import KIND, VECTOR, store_innovations
from strapdown.kernels.rotation import inverse_right_jacobian, logarithm, moved, quaternion_multiply, unit
from strapdown.kernels.structure import Body as Filter
from strapdown.kernels.walk import step_within, turn_squared

OPEN = ("bias_at", "load", "propagate_row", "turn_tangent")
CALLED = ("normalized_weights",)

RUNNING = 0
MERGED = 1
"""Why the walk ended: not before the end of the record; merged into one Gaussian."""


class Body(NamedTuple):
    """Hypotheses and options."""

    form: Filter
    """The hypotheses, and one more state, which is scratch."""
    log_weight: np.ndarray
    """(h,), as ``weight``; at return, the final values."""
    weight: np.ndarray
    options: Options
    """A gate that accepts all."""
    min_weight: float
    """Minimum weight relative to the largest; hypotheses below it are dropped."""
    max_share: float
    """Maximum fraction of the covariance of attitude and of bias due to differences between hypotheses, below which these are merged."""
    first_row: int
    """First row of the outputs that is written."""


class Outputs(NamedTuple):
    """Output arrays: a row for each stored edge; innovations by measurement."""

    x: np.ndarray
    """Mean attitude and bias (rows, 7)."""
    P: np.ndarray
    """(rows, 6, 6)."""
    between: np.ndarray
    """The part of the covariance that is due to differences between hypotheses (6, 6), at the last edge."""
    weights: np.ndarray
    """(rows, h)."""
    innovation: np.ndarray
    """Innovations of the hypothesis of the largest weight (events, 6)."""


def heaviest(weight):
    """Return the hypothesis of the largest weight."""
    best = 0
    for i in range(len(weight)):
        if weight[i] > weight[best]:
            best = i
    return best


def away_from(q, form, i):
    """Return Log(q⁻¹ ⊗ q_i), the rotation from an attitude to that of state i, rad."""
    return logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), load(form, i)))


def moment_match(form, weight, x, P, between):
    """Write the first two moments of the mixture to ``x`` (7,) and P (6, 6), and the covariance between its members to ``between``.

    The mean attitude q̄, Σ w Log(q̄⁻¹ ⊗ q_i) = 0, is that nearest to the hypothesis of the largest weight. Relative to the mean a member is
    at d_i = Log(q̄⁻¹ ⊗ q_i), b_i − b̄; its covariance is transformed by G_i = J_r⁻¹(d_i): ``P = Σ w_i (G_i P_i G_iᵀ + d_i d_iᵀ)``.
    """
    members = len(weight)
    q = load(form, heaviest(weight))
    mean = (0.0, 0.0, 0.0)
    for i in range(members):
        mean = combine(1.0, mean, weight[i], bias_at(form, i))
    for _ in range(20):
        shift = (0.0, 0.0, 0.0)
        for i in range(members):
            if weight[i] > 0.0:
                shift = combine(1.0, shift, weight[i], away_from(q, form, i))
        q, _ = moved(q, shift)
        q = unit(q)
        if dot(shift, shift) < 1e-24:
            break
    for i, value in enumerate((*q, *mean)):
        x[i] = value
    for a in range(6):
        for c in range(6):
            P[a, c] = between[a, c] = 0.0
    own = form.P[members]
    for i in range(members):
        if weight[i] > 0.0:
            for j in range(len(own)):
                own[j] = form.P[i, j]
            d, b = away_from(q, form, i), add(bias_at(form, i), (-mean[0], -mean[1], -mean[2]))
            turn_tangent(form, members, q, inverse_right_jacobian(d))
            for a, e in enumerate((*d, *b)):
                for c, f in enumerate((*d, *b)):
                    between[a, c] += weight[i] * e * f
                    P[a, c] += weight[i] * (own[WIDTH_OF_ROW * a + c] + e * f)


def block(P, k):
    """Return a symmetric block of three states from k on (6-tuple)."""
    return (P[k, k], P[k, k + 1], P[k, k + 2], P[k + 1, k + 1], P[k + 1, k + 2], P[k + 2, k + 2])


def share_between(P, between, k):
    """Return tr(T⁻¹ S) of the blocks of three states from k on: the fraction of a covariance due to differences, summed over the axes."""
    F, S = factored(block(P, k)), block(between, k)
    columns = solved(F, S[:3]), solved(F, (S[1], S[3], S[4])), solved(F, (S[2], S[4], S[5]))
    return columns[0][0] + columns[1][1] + columns[2][2]


def normalized_weights(log_weight, least, weight):
    """Write normalised weights, permanently 0 below ``least``, relative to the largest."""
    best = -math.inf
    for i in range(len(log_weight)):
        best = max(best, log_weight[i])
    total = 0.0
    for i in range(len(log_weight)):
        log_weight[i] -= best
        weight[i] = math.exp(log_weight[i])
        if weight[i] < least:
            log_weight[i], weight[i] = -math.inf, 0.0
        total += weight[i]
    for i in range(len(log_weight)):
        weight[i] /= total


def begin(body):
    """Return why the walk ended: it is running."""
    normalized_weights(body.log_weight, body.min_weight, body.weight)
    return 0 * len(body.weight)


def longest_step(state, part, dt, body):
    """Return the longest step, s, within the limit of the polynomials for every hypothesis."""
    squared = 0.0
    for i in range(len(body.weight)):
        if body.weight[i] > 0.0:
            squared = max(squared, turn_squared(part, dt, bias_at(body.form, i)))
    return step_within(squared, dt)


def predict(state, part, dt, body, out):
    """Propagate every hypothesis."""
    for i in range(len(body.weight)):
        if body.weight[i] > 0.0:
            propagate_row(body.form, i, part, dt)
    return state


def update(state, e, now, measured, body, out):
    """Update every hypothesis with a measurement, and its weight by the likelihood."""
    weight, log_weight = body.weight, body.log_weight
    place, sensor = measured.place[e], measured.sensor[e]
    kind = measured.series[sensor, KIND]
    leader = heaviest(weight)
    for i in range(len(weight)):
        if weight[i] > 0.0:
            outcome, _, y, s, _ = iterated_update(body.form, i, e, measured, WIDE_PASSES, body.options)
            if outcome != PASSED_OVER:
                nis = y[0] * y[0] / s[0] + y[1] * y[1] / s[1]
                if kind != VECTOR:  # its length has no information about the attitude
                    nis += y[2] * y[2] / s[2]
                log_weight[i] -= 0.5 * (nis + (math.log(s[0]) + math.log(s[1]) + math.log(s[2])))
            if i == leader:
                store_innovations(out.innovation, place, y, s)
    normalized_weights(log_weight, body.min_weight, weight)
    return state


def keep(state, row, e, body, out):
    """Write the mixture at a stored edge, and check whether the hypotheses have converged."""
    ended = state
    if ended == RUNNING and row >= body.first_row:
        P, between = out.P[row], out.between
        moment_match(body.form, body.weight, out.x[row], P, between)
        left = 0
        for i in range(len(body.weight)):
            out.weights[row, i] = body.weight[i]
            left += body.weight[i] > 0.0
        if left == 1 or max(share_between(P, between, 0), share_between(P, between, 3)) < body.max_share:
            ended = 0 * ended + MERGED
    return ended


def stopped(state):
    """Return whether the hypotheses are merged."""
    return state != RUNNING


def finish(state, row, e, body):
    """Return the number of edges, why the walk ended, and the number of measurements processed."""
    return row, state, e
