"""Lanes: eight scalars in one value, so that one call of a kernel advances eight runs, or eight stretches of one record.

A kernel reads and writes lanes by the functions below and computes with them by the same arithmetic as with floats. As plain Python they
work on NumPy arrays of ``WIDTH``; compiled, :mod:`strapdown.kernels.lanes` puts machine vectors in their place. Nothing is checked:
the caller answers for every row being inside its array. Arrays are flat and contiguous.

There is no ``if`` on lanes; a kernel that must choose asks :func:`everywhere` or :func:`anywhere`, and :func:`chosen` lane by lane. These
three take plain conditions and floats too.
"""

from __future__ import annotations

import numpy as np

WIDTH = 8
"""Lanes in a value, on every machine: a narrower one takes several instructions for each, and the order of operations is the same."""


def load(array, start):
    """Return ``array[start : start + WIDTH]``."""
    return array[start : start + WIDTH].copy()


def load_triples(array, start, stride):
    """Return the three components of eight 3-vectors, the i-th at ``array[start + i stride]``; ``stride`` is 3 or more."""
    rows = [array[start + i * stride : start + i * stride + 3] for i in range(WIDTH)]
    return tuple(np.array(rows).T)


def load_quadruples(array, start, stride):
    """Return the four components of eight quaternions, the i-th at ``array[start + i stride]``."""
    rows = [array[start + i * stride : start + i * stride + 4] for i in range(WIDTH)]
    return tuple(np.array(rows).T)


def store(array, start, value):
    """Write lanes to ``array[start : start + WIDTH]``."""
    array[start : start + WIDTH] = value


def store_quadruples(array, start, stride, q):
    """Write the four components of eight quaternions, the i-th to ``array[start + i stride]``."""
    for i in range(WIDTH):
        row = start + i * stride
        array[row : row + 4] = [q[0][i], q[1][i], q[2][i], q[3][i]]


def spread(x):
    """Return a float in every lane."""
    return np.full(WIDTH, x)


def everywhere(condition):
    """Return whether the condition holds in all lanes."""
    return condition if isinstance(condition, bool) else bool(np.all(condition))


def anywhere(condition):
    """Return whether the condition holds in any lane."""
    return condition if isinstance(condition, bool) else bool(np.any(condition))


def chosen(condition, a, b):
    """Return a in the lanes where the condition holds, b in the others."""
    if isinstance(condition, bool):
        return a if condition else b
    return np.where(condition, a, b)
