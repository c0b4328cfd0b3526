"""Lanes: several scalars in one value (SIMD), so that one call of a kernel processes eight runs, or eight segments of one record.

A kernel reads and writes lanes with the functions below and computes with the same arithmetic as for floats. In plain Python lanes are
NumPy arrays of ``WIDTH``; compiled, :mod:`strapdown.kernels.lanes` replaces them by SIMD vectors. Nothing is checked: rows must be inside
their arrays, which are contiguous.

``WIDTH`` is the default number of lanes. A kernel for any number of lanes takes a ``pattern``, a tuple of that many floats:
:func:`lanes_of` returns zeros of its length and type, and :func:`load_like` and others take such a value as ``like``. One lane is a scalar.

There is no ``if`` on lanes: branch with :func:`all_lanes` or :func:`any_lane`, and select by lane with :func:`select`. These three take
plain conditions and floats too.
"""

from __future__ import annotations

import numpy as np

WIDTH = 8
"""Lanes in a value, on every machine: a narrower one takes several instructions for each, and the order of operations is the same."""


def load(array, start):
    """Return ``array[start : start + WIDTH]``, an array of several dimensions read by rows."""
    return array.reshape(-1)[start : start + WIDTH].copy()


def prefetch(array, start):
    """Prefetch ``array[start]``, which is read soon; it may lie outside."""


def load_triples(array, start, stride):
    """Return the three components of eight 3-vectors, the i-th at ``array[start + i stride]``; ``stride`` is 3 or more."""
    rows = [array[start + i * stride : start + i * stride + 3] for i in range(WIDTH)]
    return tuple(np.array(rows).T)


def load_quadruples(array, start, stride):
    """Return the four components of eight quaternions, the i-th at ``array[start + i stride]``."""
    rows = [array[start + i * stride : start + i * stride + 4] for i in range(WIDTH)]
    return tuple(np.array(rows).T)


def store(array, start, value):
    """Write lanes, any number of them, to ``array[start : …]`` likewise, converted to the precision of the array."""
    array.reshape(-1)[start : start + len(value)] = value


def store_quadruples(array, start, stride, q):
    """Write the four components of eight quaternions, the i-th to ``array[start + i stride]``."""
    for i in range(WIDTH):
        row = start + i * stride
        array[row : row + 4] = [q[0][i], q[1][i], q[2][i], q[3][i]]


def lanes_of(pattern):
    """Return zero in as many lanes as ``pattern``, a tuple of floats, has entries, and of their type."""
    return np.zeros(len(pattern), np.asarray(pattern).dtype)


def load_like(array, start, like):
    """Return as many elements of ``array`` from ``start`` on as ``like`` has lanes; their type is the array's."""
    return array.reshape(-1)[start : start + len(like)].copy()


def with_lane(x, place, value):
    """Return lanes with another number in one of them, whose place is known while compiling."""
    x = x.copy()
    x[place] = value
    return x


def narrowed(x, like):
    """Return doubles in the precision of ``like``."""
    return np.asarray(x, np.asarray(like).dtype)[()]


def sum_lanes(x):
    """Return the sum over the lanes, the upper half added to the lower until one is left: one order on every machine."""
    while len(x) > 1:
        x = x[: len(x) // 2] + x[len(x) // 2 :]
    return x[0]


def number_where(condition):
    """Return in how many lanes the condition holds."""
    return int(np.sum(condition))


def bits_of(x):
    """Return the bits of doubles as words of 64, of singles as words of 32."""
    x = np.asarray(x)
    return x.view(np.uint32)[()] if x.dtype == np.float32 else np.float64(x).view(np.uint64)


def number_of_bits(word):
    """Return the doubles with these bits, of words of 32 the singles."""
    word = np.asarray(word)
    return word.view(np.float32)[()] if word.dtype == np.uint32 else np.uint64(word).view(np.float64)


def halves(a, b):
    """Return the lower and the upper halves of words of 64, those of a followed by those of b, as words of 32."""
    both = np.concatenate([np.atleast_1d(a), np.atleast_1d(b)])
    return both.astype(np.uint32), (both >> np.uint64(32)).astype(np.uint32)


def leading_zeros(word):
    """Return how many zeros words of 32 begin with."""
    return (32 - np.frexp(np.float64(word))[1]).astype(np.uint32)


def signed_number(word):
    """Return the singles nearest to words of 32 that are read as whole numbers with a sign."""
    return np.asarray(word).view(np.int32).astype(np.float32)


def broadcast(x):
    """Return a float in every lane."""
    return np.full(WIDTH, x)


def all_lanes(condition):
    """Return whether the condition holds in all lanes."""
    return bool(np.all(condition))


def any_lane(condition):
    """Return whether the condition holds in any lane."""
    return bool(np.any(condition))


def select(condition, a, b):
    """Return a in the lanes where the condition holds, b in the others."""
    if isinstance(condition, bool | np.bool_):
        return a if condition else b
    return np.where(condition, a, b)
