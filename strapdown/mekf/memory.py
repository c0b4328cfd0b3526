"""Memory for the results of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

_ALIGNMENT = 64
"""Bytes: each array begins at a multiple."""


def side_by_side(*wanted: tuple[Sequence[int], Any]) -> list[np.ndarray]:
    """Return uninitialised arrays of these shapes and types in one allocation.

    A system hands out fresh memory page by page when it is first touched, which for the results of a filter takes as long as a tenth of
    the filtering. In one large allocation it can use large pages; arrays of a few megabytes each get small ones at their ends.
    """
    types = [np.dtype(of) for _, of in wanted]
    sizes = [math.prod(shape) * of.itemsize for (shape, _), of in zip(wanted, types, strict=True)]
    starts = [0]
    for size in sizes:
        starts.append(starts[-1] + -(-size // _ALIGNMENT) * _ALIGNMENT)
    whole = np.empty(starts[-1], np.uint8)
    return [
        whole[start : start + size].view(of).reshape(shape)
        for start, size, of, (shape, _) in zip(starts, sizes, types, wanted, strict=False)
    ]
