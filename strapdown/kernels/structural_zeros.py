"""Sums and products without the terms that are zero in the structure of a model.

Such a zero is a Python 0, and a one a Python 1, while a formula is traced: they cost nothing. Vectors and matrices (by rows) are tuples.
"""

from __future__ import annotations


def is_zero(x):
    """Return whether x is a Python 0 while tracing."""
    return isinstance(x, int) and x == 0


def plus(a, b):
    """Return a + b; zeros vanish."""
    return b if is_zero(a) else a if is_zero(b) else a + b


def times(a, b):
    """Return a b; zeros and ones vanish."""
    if is_zero(a) or is_zero(b):
        return 0
    return b if isinstance(a, int) else a if isinstance(b, int) else a * b


def products(a, b):
    """Return Σ aᵢ bᵢ; zeros vanish."""
    s = 0
    for x, y in zip(a, b, strict=True):
        s = plus(s, times(x, y))
    return s


def sum_of(a, b):
    """Return a + b of two tuples; zeros vanish."""
    return tuple(plus(x, y) for x, y in zip(a, b, strict=True))


def matrix_products(A, v):
    """Return A v of a matrix (9) and a vector; zeros vanish."""
    return tuple(products(A[3 * i : 3 * i + 3], v) for i in (0, 1, 2))


def any_number(entries):
    """Return whether an entry is not zero."""
    return any(not is_zero(entry) for entry in entries)
