"""The filter for eight sets of parameters together, one per lane, and the sensitivities of its innovations; run by the walk.

The filter is an instance of :mod:`strapdown.kernels.filter` with ``PARAMETERS``: gyro noise, σ of each sensor, error states and initial
covariance differ between lanes. If lane i is lane 0 with a small change of parameter i, differences between lanes are the derivatives of
each innovation and of its variance, from which score and information of the likelihood are summed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import combine, dot
from strapdown.kernels.chains import SET, fill_coefficients
from strapdown.kernels.lane_values import WIDTH, broadcast, load, select, store, sum_lanes
from strapdown.kernels.measurement import HEADING, KIND, degrees_of_freedom, vector_at
from strapdown.kernels.model import advance
from strapdown.kernels.series import LARGEST_ANGLE, SQUARED_RANGE
from strapdown.kernels.state import load_triple
from strapdown.kernels.structure import Body as Filter
from strapdown.kernels.update import take
from strapdown.kernels.walk import MAX_TURN

REPLACEABLE = ("counted",)

HALF_RANGE = 0.25 * SQUARED_RANGE
"""Squared half of the maximum angle of the polynomials, rad²."""
WORK = 6 * WIDTH
"""Offset of derivatives in the work space, after innovations and variances of a measurement."""
WIDE = 9 * WIDTH
"""Offset of innovations and variances for the noise of an outlier."""
ROOM = 15 * WIDTH
"""Size of the work space."""


class Chains(NamedTuple):
    """Error states that decay or are driven, of one lane, as :func:`strapdown.kernels.chains.fill_coefficients` takes them."""

    decay: np.ndarray
    chains: np.ndarray
    last: np.ndarray


class Body(NamedTuple):
    """The filters, and the time spans of the record with separate sums."""

    filters: Filter
    """Filters whose parameters differ; ``limit`` of their model is the shortest."""
    decay: np.ndarray
    """λ of each error state by lane (WIDTH, m), 1/s."""
    chains: np.ndarray
    """Coupling of each state to the next, and PSD of its driving noise, by lane (WIDTH, m, 2)."""
    same: np.ndarray
    """First lane with the same ``decay`` and ``chains`` (WIDTH,)."""
    coefficients: np.ndarray
    """Sets of coefficients of a step of one lane; scratch."""
    driven: np.ndarray
    """Places in the model's numbers of the change of temperature since the start; none without slopes of the bias."""
    temperature: np.ndarray
    """That change in each interval (n,), K."""
    outliers: np.ndarray
    """Share and variance ratio of outliers (2 × WIDTH); empty without outliers."""
    cuts: np.ndarray
    """Limits of the parts: part c is from ``cuts[c − 1]`` to ``cuts[c]``, the last one unlimited."""
    epochs: np.ndarray
    """Edges at which states are stored."""
    free: int
    """Number of parameters, changed by ``step`` in lanes 1, 2, …"""
    step: float
    room: np.ndarray
    """Scratch (``ROOM``,)."""


class Outputs(NamedTuple):
    """Sums by part of the record, and outputs of a run."""

    minus_log: np.ndarray
    """Σ ½ (log s + e²/s) of the innovations (parts × WIDTH)."""
    score: np.ndarray
    """Derivatives of lane 0 (parts, free)."""
    information: np.ndarray
    """Lower triangles (parts, free, free); with outliers, sums of the outer products of each measurement's gradient."""
    x: np.ndarray
    """q, b and c at the epochs (epochs, (n + 1) WIDTH)."""
    P: np.ndarray
    """Upper triangle of the covariance by rows (epochs, n (n + 1)/2 WIDTH)."""
    probability: np.ndarray
    """Probability that each measurement is an outlier, and mean ratio of its noise to its innovations' variances, in lane 0 (events, 2), or
    (0, 2)."""


def begin(body):
    """Return the part of the record, and the number of states stored."""
    none = 0 * len(body.cuts)
    return none, none


def increment_over(increments, k, body):
    """Return the increment of interval k, zero for the interval before the first edge; set the temperature of the interval."""
    if k < 0:
        return (0.0, 0.0, 0.0)
    for at in body.driven:
        store(body.filters.model.numbers, at * WIDTH, broadcast(body.temperature[k]))
    return vector_at(increments, k)


def longest_step(state, part, dt, body):
    """Return the longest step, s, for all lanes except diverged ones, with angles above ``MAX_TURN``."""
    b = load_triple(body.filters.x, 4 * WIDTH)
    limit = min(dt, body.filters.model.limit)
    # Usually sufficient: the sum over the lanes is not less than the largest, and comparisons with NaN are false.
    if dot(part, part) <= HALF_RANGE and sum_lanes(dot(b, b)) * (dt * dt) < HALF_RANGE:
        return limit
    turn = combine(1.0, part, -dt, b)
    room = body.room
    store(room, WORK, dot(turn, turn))
    squared = SQUARED_RANGE
    for i in range(WIDTH):
        if squared < room[WORK + i] < MAX_TURN * MAX_TURN:
            squared = room[WORK + i]
    return min(limit, dt * (LARGEST_ANGLE / math.sqrt(squared)))


def fill(body, dt):
    """Write the sets of coefficients of a step of dt, in lanes."""
    f = body.filters
    size = SET * len(f.model.last)
    for i in range(WIDTH):
        if body.same[i] == i:
            fill_coefficients(body.coefficients, dt, Chains(body.decay[i], body.chains[i], f.model.last))
            for lane in range(i, WIDTH):
                if body.same[lane] == i:
                    for k in range(size):
                        f.coefficients[WIDTH * k + lane] = body.coefficients[k]
    f.dt[0] = dt


def predict(state, part, dt, body, out):
    """Propagate all lanes."""
    f = body.filters
    if len(f.model.last) > 0 and dt != f.dt[0]:
        fill(body, dt)
    advance(f.x[0], f.P[0], part, dt, f.model, f.coefficients, broadcast(0.0))
    return state


def add_derivatives(room, number, free, step, score, information):
    """Add one event to the score Σ ∂ℓ/∂θ and the information; ℓ = ½ (log s + e²/s).

    The work space holds e and s of ``number`` innovations in lanes; lane i is lane 0 with parameter i changed by ``step``. The information
    is Fisher's by sensitivities, ``ė_j ė_k/s + ½ ṡ_j ṡ_k/s²`` (Segal & Weinstein 1989): positive semidefinite for any data.
    """
    work = room[WORK:]
    for j in range(free):
        work[j] = 0.0
    for r in range(number):
        place = 2 * WIDTH * r
        e = room[place]
        s = room[place + WIDTH]
        inverse = 1.0 / s
        over = inverse / step
        whitened = e * e * inverse
        for j in range(free):
            change_e = (room[place + 1 + j] - e) * over
            change_s = (room[place + WIDTH + 1 + j] - s) * over
            work[WIDTH + j] = change_e
            work[2 * WIDTH + j] = change_s
            work[j] += 0.5 * change_s * (1.0 - whitened) + e * change_e
        for j in range(free):
            a = work[WIDTH + j] * s
            c = 0.5 * work[2 * WIDTH + j]
            for k in range(j + 1):
                information[j, k] += a * work[WIDTH + k] + c * work[2 * WIDTH + k]
    for j in range(free):
        score[j] += work[j]


def update(state, e, now, measured, body, out):
    """Update all lanes with a measurement, and add to the sums of its part of the record."""
    span, kept = state
    while span < len(body.cuts) and now > body.cuts[span]:
        span += 1
    counted(e, span, measured, body, out)
    return span, kept


def counted(e, span, measured, body, out):
    """Update all lanes, and add to the sums."""
    room, sensor = body.room, measured.sensor[e]
    take(body.filters.shape[sensor], body.filters, measured, e, room, broadcast(0.0))
    kind = measured.series[sensor, KIND]
    number = degrees_of_freedom(kind)
    if kind == HEADING:  # a vertical vector has none; that of a diverged lane has no variance either
        y, s = load(room, 0), load(room, WIDTH)
        known, none = y - y == 0.0, s - s
        store(room, 0, select(known, y, none))
        store(room, WIDTH, select(known, s, none + 1.0))
    for i in range(WIDTH):
        deviance, product = deviance_of(room, 0, number, i)
        out.minus_log[WIDTH * span + i] += 0.5 * (math.log(product) + deviance)
    if body.free > 0:
        add_derivatives(room, number, body.free, body.step, out.score[span], out.information[span])


def deviance_of(room, place, number, i):
    """Return the NIS of a measurement and the determinant of its innovation covariance in lane i."""
    deviance, product = 0.0, 1.0
    for r in range(number):
        e = room[place + 2 * WIDTH * r + i]
        s = room[place + 2 * WIDTH * r + WIDTH + i]
        deviance += e * e / s
        product *= s
    return deviance, product


def keep(state, row, e, body, out):
    """Write the states if the edge is an epoch."""
    span, kept = state
    if kept < len(body.epochs) and body.epochs[kept] == row:
        x, P = body.filters.x[0], body.filters.P[0]
        for i in range(0, len(x), WIDTH):
            store(out.x, kept * len(x) + i, load(x, i))
        for i in range(0, len(P), WIDTH):
            store(out.P, kept * len(P) + i, load(P, i))
        kept += 1
    return span, kept


def stopped(state):
    """Return false: a lane that is lost does not end the others."""
    return state[1] < 0


def finish(state, row, e, body):
    """Return the number of edges."""
    return row
