"""Integrals of a body rate without a closed form over intervals, converged to rounding."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from strapdown.checks import Array
from strapdown.motion.exact_phase import exact_sum

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(8)
# From values at the nodes to the discrete Legendre coefficients of degree 0 to 7, and to the derivative at the nodes.
_TO_LEGENDRE = np.array(
    [(k + 0.5) * _GAUSS_WEIGHTS * np.polynomial.legendre.legval(_GAUSS_NODES, np.eye(8)[k]) for k in range(8)]
)
_DERIVATIVE = (
    np.polynomial.legendre.legval(_GAUSS_NODES, np.polynomial.legendre.legder(np.eye(8), axis=0)).T @ _TO_LEGENDRE
)
_QUADRATURE_TOLERANCE = 1e-16
_ROUNDING_FLOOR = 1e-14
_MAX_BISECTIONS = 40
_QUADRATURE_CHUNK = 1 << 14


def interval_integrals(rate: Callable[[Array], Array], edges: Array, breaks: Array) -> Array:
    """Return ∫ rate dt (n, 3) over each interval, converged to rounding relative to the integral of |rate|.

    Eight-point Gauss–Legendre quadrature, exact to degree 15, on pieces that are bisected until the first neglected term, of degree 16, is
    below 1e-16 of the largest value. That term is extrapolated from the Legendre coefficients of degrees 2 and 3 and of degrees 6 and 7,
    which decrease geometrically if the rate is smooth and slowly if it is not. ``breaks`` are the sorted times at which the rate is known
    not to be smooth; no piece extends across one (an undeclared kink may lie undetected between two nodes). An hour from the origin a float
    represents a node's time only to 5e-13 s; the values are corrected for this rounding error to first order.
    """
    result = np.zeros((len(edges) - 1, 3))
    for first in range(0, len(edges) - 1, _QUADRATURE_CHUNK):
        part = edges[first : first + _QUADRATURE_CHUNK + 1]
        cuts = np.union1d(part, breaks[(breaks > part[0]) & (breaks < part[-1])])
        start, stop = cuts[:-1], cuts[1:]
        owner = np.searchsorted(part, start, side="right") - 1
        total = result[first : first + len(part) - 1]
        size = np.zeros(len(total))
        for level in range(_MAX_BISECTIONS + 1):
            step = stop - start
            time, cut_off = exact_sum(start[:, None], 0.5 * (1.0 + _GAUSS_NODES) * step[:, None])
            values = rate(time)
            if level == 0:
                np.maximum.at(size, owner, np.abs(values).max(axis=(1, 2)))
            coefficients = np.abs(_TO_LEGENDRE @ values).max(axis=2)
            low, high = coefficients[:, 2:4].max(axis=1), coefficients[:, 6:].max(axis=1)
            # The error of a piece is weighted by its share of the interval, so that bisection towards a kink terminates.
            high_share = high * step / (part[owner + 1] - part[owner])
            decay = np.minimum(high / np.maximum(low, np.finfo(float).tiny), 1.0)
            rough = (high_share * decay**2 > _QUADRATURE_TOLERANCE * size[owner]) & (
                high_share > _ROUNDING_FLOOR * size[owner]
            )
            middle = start + 0.5 * step
            rough &= (level < _MAX_BISECTIONS) & (middle > start)
            done = ~rough
            values = 0.5 * step[:, None, None] * values + cut_off[..., None] * (_DERIVATIVE @ values)
            np.add.at(total, owner[done], _GAUSS_WEIGHTS @ values[done])
            if done.all():
                break
            middle = middle[rough]
            start, stop = np.concatenate([start[rough], middle]), np.concatenate([middle, stop[rough]])
            owner = np.concatenate([owner[rough]] * 2)
    return result
