"""The filter of N error states in a Monte Carlo: that of :mod:`strapdown.kernels.filter` for eight runs."""

from __future__ import annotations

from typing import NamedTuple

from strapdown.kernels.filter import whole_element
from strapdown.kernels.lane_values import WIDTH, load_like, store
from strapdown.kernels.layout import element_at, put_element
from strapdown.kernels.model import propagate
from strapdown.kernels.montecarlo_run import KEPT
from strapdown.kernels.state import store_several
from strapdown.kernels.update import take


class Progress(NamedTuple):
    """State of the walk: all else is in arrays."""

    lost: bool


def start_filters(q, b, body, like):
    """Write the initial state."""
    x, P, n = body.filters.x[0], body.filters.P[0], len(body.start.P)
    store_several(x, 0, (*q, *b))
    for i in range(7, n + 1):
        store(x, i * WIDTH, like)
    for i in range(n):
        for j in range(i, n):
            put_element(P, i, j, like + body.start.P[i, j])
    lost = n < 0  # False, not as a literal: numba would compile the loop for its type too
    return Progress(lost)


def propagated(state, part, dt, body, like):
    """Propagate all runs."""
    propagate(body.filters, 0, part, dt, like)
    return state


def corrected(state, value, e, measured, body, like):
    """Update all runs."""
    store_several(measured.value, 0, value)
    innovation = body.draws.innovation
    lost = take(body.filters.shape[measured.sensor[e]], body.filters, measured, e, innovation, like)
    return Progress(state.lost or lost), load_like(innovation, 6 * WIDTH, like), six(innovation, like)


def six(array, like):
    """Return the first six values."""
    return tuple(load_like(array, i * WIDTH, like) for i in range(6))


def keep_filters(state, row, body, out, like):
    """Write the state; the bias is the whole one, with that part of its variance that has no states."""
    f, start, at = body.filters, body.start, row * KEPT
    x, P, offsets = f.x[0], f.P[0], f.offsets
    for i in range(7):
        s = load_like(x, i * WIDTH, like)
        for k in range(len(offsets) if i >= 4 else 0):
            s = s + offsets[k, i - 4] * load_like(x, (7 + k) * WIDTH, like)
        store(out.kept, (at + i) * WIDTH, s)
    at += 7
    for block in range(3):
        for a in range(6):
            for b in range(a, 6):
                if (a >= 3) + (b >= 3) == block:
                    s = whole_element(P, offsets, a, b, like)
                    if a == b and a >= 3:
                        s = s + (start.fast if row > 0 else -start.fast)
                    store(out.kept, at * WIDTH, s)
                    at += 1
    m = len(offsets)
    for k in range(m if len(out.states) > 0 else 0):
        store(out.states, (2 * m * row + k) * WIDTH, load_like(x, (7 + k) * WIDTH, like))
        store(out.states, (2 * m * row + m + k) * WIDTH, element_at(P, 6 + k, 6 + k, like))
