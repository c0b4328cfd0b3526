"""Arguments of a kernel in an array of integers, from which it reads them.

numba takes 40 ns to unpack an array that a kernel is called with, so sixty arrays take longer than a step of the filter. A kernel that is
called for every sample has one array of integers, the addresses and shapes of the others, as :func:`packed` writes them.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def packed(value: Any) -> np.ndarray:
    """Return arrays, numbers, and nested tuples of them as integers; the arrays must outlive the result and stay where they are."""
    return np.array(list(_integers(value)), np.int64)


def _integers(value: Any) -> Any:
    if isinstance(value, tuple):
        for item in value:
            yield from _integers(item)
    elif isinstance(value, np.ndarray):
        yield from (value.ctypes.data, *value.shape)
    else:
        yield int(np.float64(value).view(np.int64)) if isinstance(value, float) else value


def unpacked(kind, table):
    """Return the value that was packed in a table; ``kind`` is its type. Compiled only."""


def call(address, arguments, like):
    """Return the numbers that the compiled kernel at an address returns, called with a tuple of arguments. Compiled only.

    ``like`` is a tuple of as many integers, empty for one that returns nothing.
    """
