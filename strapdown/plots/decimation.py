"""Reduction of long series for figures to the extremes of each pixel column, so that no peak is lost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from strapdown.checks import Array

LINE_COLUMNS = 2000
"""Number of columns of equal time for a line: at least one per pixel of a wide figure."""
BAND_COLUMNS = 250
"""Number of columns of equal time for a band: each usually contains a whole increase of σ between two measurements."""


def column_starts(time: Array, columns: int) -> NDArray[np.int64]:
    """Return the index of the first sample of each column of equal duration of ``time`` (n,), without empty columns."""
    span = float(time[-1] - time[0])
    if span <= 0.0:
        return np.zeros(1, np.int64)
    column = np.minimum((time - time[0]) * (columns / span), columns - 1).astype(np.int64)
    return np.flatnonzero(np.diff(column, prepend=-1))


def extreme_rows(time: Array, value: Array, columns: int = LINE_COLUMNS) -> NDArray[np.int64]:
    """Return the sorted indices of the samples of a line to draw: minimum and maximum of each column, and both ends."""
    n = len(value)
    if n <= 2 * columns:
        return np.arange(n)
    starts = column_starts(time, columns)
    group = np.repeat(np.arange(len(starts)), np.diff(starts, append=n))
    parts = [np.array([0, n - 1])]
    for reduce, missing in ((np.fmin, starts), (np.fmax, np.append(starts[1:], n) - 1)):
        hits = np.flatnonzero(value == reduce.reduceat(value, starts)[group])
        rows = missing.copy()
        rows[group[hits][::-1]] = hits[::-1]  # reversed, so that the first of equal values is kept
        parts.append(rows)
    return np.unique(np.concatenate(parts))


def decimated(time: Array, value: Array, columns: int = LINE_COLUMNS) -> tuple[Array, Array]:
    """Return the points of a line (n,) to draw, by :func:`extreme_rows`."""
    rows = extreme_rows(time, value, columns)
    return time[rows], value[rows]


def envelope(
    time: Array, low: Array, high: Array | None = None, columns: int = BAND_COLUMNS
) -> tuple[Array, Array, Array]:
    """Return the lines of a band to draw: time, minimum of ``low`` and maximum of ``high`` (default: ``low``), level over each column.

    The extremes of a column are NaN if all its values are NaN; a series of no more samples than columns is returned as it is.
    """
    high = low if high is None else high
    if len(time) <= columns:
        return time, low, high
    starts = column_starts(time, columns)
    edges = np.append(time[starts], time[-1])
    least, most = np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)
    return np.repeat(edges, 2)[1:-1], np.repeat(least, 2), np.repeat(most, 2)
