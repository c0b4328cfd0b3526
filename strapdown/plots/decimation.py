"""Long series drawn as what a screen can show: of each span of samples its least and its largest, so that no extreme is lost."""

from __future__ import annotations

import numpy as np

from strapdown.checks import Array

MOST = 4000
"""Points of a drawn line: two for each pixel of a wide figure."""


def decimated(time: Array, value: Array, most: int = MOST) -> tuple[Array, Array]:
    """Return at most ``most`` points of a series (n,): the least and the largest of each span of samples, in their order.

    A series that is short enough comes back as it is. A span that is all NaN gives NaN, so that gaps stay.
    """
    n = len(value)
    if n <= most:
        return time, value
    step = -(-n // (most // 2))
    whole = n // step * step
    low, high = _extremes(value[:whole].reshape(-1, step))
    rows = np.arange(0, whole, step)
    low, high = rows + low, rows + high
    if whole < n:
        last_low, last_high = _extremes(value[None, whole:])
        low, high = np.append(low, whole + last_low), np.append(high, whole + last_high)
    kept = np.sort(np.stack([low, high], axis=1), axis=1).ravel()
    return time[kept], value[kept]


def _extremes(spans: Array) -> tuple[np.ndarray, np.ndarray]:
    missing = np.isnan(spans)
    if not missing.any():
        return spans.argmin(axis=1), spans.argmax(axis=1)
    return np.where(missing, np.inf, spans).argmin(axis=1), np.where(missing, -np.inf, spans).argmax(axis=1)
