"""Memory for the results of a run."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

_ALIGNMENT = 64
"""Each array begins at a multiple of this number of bytes."""
_SMALL = 1 << 20
"""Minimum size of memory that is kept, bytes."""
KEPT = 128 << 20
"""Maximum memory kept for the results of later runs, bytes."""

_kept: deque[np.ndarray] = deque()  # whose operations are atomic: threads and garbage collection may interleave


class _Block:
    """Memory that is kept for a later run when its last array is deleted."""

    def __init__(self, memory: np.ndarray) -> None:
        self.memory = memory
        self.__array_interface__ = memory.__array_interface__

    def __del__(self, kept: deque[np.ndarray] = _kept) -> None:
        kept.append(self.memory)
        while sum(memory.size for memory in tuple(kept)) > KEPT:
            kept.popleft()


def _taken(size: int) -> np.ndarray:
    """Return uninitialised bytes: a stored block of at least that size and at most twice it, or a new one."""
    if size < _SMALL:
        return np.empty(size, np.uint8)
    for _ in range(len(_kept)):
        try:
            memory = _kept.popleft()
        except IndexError:  # another thread took it
            break
        if size <= memory.size <= 2 * size:
            return np.asarray(_Block(memory))
        _kept.append(memory)
    return np.asarray(_Block(np.empty(size, np.uint8)))


def side_by_side(*wanted: tuple[Sequence[int], Any]) -> list[np.ndarray]:
    """Return uninitialised arrays of these shapes and types in one piece of memory.

    The system provides fresh memory page by page at first access and clears it, which for the results of a filter takes up to a fifth of
    the filtering. One large piece can use large pages; and pieces of earlier results that are no longer needed are reused, up to
    :data:`KEPT` bytes.
    """
    sizes = [math.prod(shape) * np.dtype(of).itemsize for shape, of in wanted]
    places = [0, *itertools.accumulate(-(-size // _ALIGNMENT) * _ALIGNMENT for size in sizes)]
    whole = _taken(places[-1] + _ALIGNMENT)
    first = -whole.ctypes.data % _ALIGNMENT
    return [np.ndarray(shape, of, whole, first + place) for place, (shape, of) in zip(places, wanted, strict=False)]
