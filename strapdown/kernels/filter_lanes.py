"""The filter of :mod:`strapdown.kernels.filter` over several records at once, one per lane (SIMD): a body of :mod:`strapdown.kernels.walk`.

All runs have the same gyro edges and the same times, sensors, noise and references of measurements; increments and measured values are
lanes. No run depends on its neighbours: one that leaves the range of the polynomials is marked as lost, and the caller filters it alone.
Sizes are those of an instance of the filter for :data:`LANES` runs, which defines the functions in ``OPEN``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import combine, dot
from strapdown.kernels.filter import advance, fill_coefficients, take
from strapdown.kernels.lane_values import WIDTH, lanes_of, load_like, select, store
from strapdown.kernels.series import SQUARED_RANGE
from strapdown.kernels.structure import Body as Filter

OPEN = ("advance", "fill_coefficients", "take")
PATTERN = (0.0,) * WIDTH
"""Gives the number of runs."""


class Body(NamedTuple):
    """The filters, and which runs are lost."""

    filters: Filter
    """Arrays whose last axis is that of the runs."""
    lost: np.ndarray
    """1 if the run is lost (``WIDTH``,)."""


class Outputs(NamedTuple):
    """Output arrays; the last axis is that of the runs."""

    x: np.ndarray
    """q, b and c at the stored edges (rows, (n + 1) ``WIDTH``)."""
    P: np.ndarray
    """Upper triangle of the covariance by rows (rows, n (n + 1)/2 ``WIDTH``)."""
    innovation: np.ndarray
    """e₁, s₁, e₂, s₂, e₃, s₃ by place, flat."""


def begin(body):
    """Return the number of rows stored."""
    return 0 * len(body.lost)


def increment_over(increments, k, body):
    """Return the increments of interval k; zero for the interval before the first edge."""
    like = lanes_of(PATTERN)
    if k < 0:
        return (like, like, like)
    at = 3 * WIDTH * k
    return (
        load_like(increments, at, like),
        load_like(increments, at + WIDTH, like),
        load_like(increments, at + 2 * WIDTH, like),
    )


def longest_step(state, part, dt, body):
    """Return the longest step, s, of states that decay."""
    return min(dt, body.filters.model.limit)


def predict(state, part, dt, body, out):
    """Propagate all runs, and mark those that leave the range of the polynomials."""
    filters, like = body.filters, lanes_of(PATTERN)
    x = filters.x[0]
    bias = (load_like(x, 4 * WIDTH, like), load_like(x, 5 * WIDTH, like), load_like(x, 6 * WIDTH, like))
    turn = combine(1.0, part, -dt, bias)
    within = dot(turn, turn) <= SQUARED_RANGE  # for NaN it does not hold
    store(body.lost, 0, select(within, load_like(body.lost, 0, like), like + 1.0))
    if dt != filters.dt[0]:
        fill_coefficients(filters.coefficients, dt, filters.model)
        filters.dt[0] = dt
    advance(x, filters.P[0], part, dt, filters.model, filters.coefficients, like)
    return state


def update(state, e, now, measured, body, out):
    """Update all runs with a measurement."""
    like = lanes_of(PATTERN)
    if take(body.filters.shape[measured.sensor[e]], body.filters, measured, e, out.innovation, like):
        store(body.lost, 0, like + 1.0)  # a measurement too precise for double precision: each run reports its own
    return state


def keep(state, row, e, body, out):
    """Write states and covariances to a row of the outputs."""
    x, P, like = body.filters.x[0], body.filters.P[0], lanes_of(PATTERN)
    for i in range(0, len(x), WIDTH):
        store(out.x, row * len(x) + i, load_like(x, i, like))
    for i in range(0, len(P), WIDTH):
        store(out.P, row * len(P) + i, load_like(P, i, like))
    return state


def stopped(state):
    """Return false: the runs are independent, so the walk goes to the end."""
    return state < 0


def finish(state, row, e, body):
    """Return the number of rows."""
    return row
