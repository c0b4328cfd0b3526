"""Long series reduced to what a figure can show: the extremes of each column of pixels, so that no peak is lost."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from strapdown.checks import Array

LINE_COLUMNS = 2000
"""Columns of equal time that a drawn line is reduced to: at least one for each pixel of a wide figure."""
BAND_COLUMNS = 250
"""Columns of equal time that a drawn band is reduced to: wide enough to hold a tooth of σ between two measurements."""


class Envelope(NamedTuple):
    """Extremes of a series in columns of equal time."""

    time: Array
    """Time of the first sample of each column (k,)."""
    low: Array
    """Least value in each column (k,); NaN where it holds NaN alone."""
    high: Array
    """Largest value in each column (k,); NaN where it holds NaN alone."""


def column_starts(time: Array, columns: int) -> NDArray[np.int64]:
    """Return the index of the first sample of each column: the span of ``time`` (n,) in equal parts, those without a sample left out."""
    span = float(time[-1] - time[0])
    if span <= 0.0:
        return np.zeros(1, np.int64)
    column = np.minimum((time - time[0]) * (columns / span), columns - 1).astype(np.int64)
    return np.flatnonzero(np.diff(column, prepend=-1))


def extreme_rows(time: Array, value: Array, columns: int = LINE_COLUMNS) -> NDArray[np.int64]:
    """Return the indices, in order, of the samples that a line needs: of each column the least and the largest, and both ends."""
    n = len(value)
    if n <= 2 * columns:
        return np.arange(n)
    starts = column_starts(time, columns)
    group = np.repeat(np.arange(len(starts)), np.diff(starts, append=n))
    found = [np.array([0, n - 1])]
    for reduce, missing in ((np.fmin, starts), (np.fmax, np.append(starts[1:], n) - 1)):
        hits = np.flatnonzero(value == reduce.reduceat(value, starts)[group])
        rows = missing.copy()
        rows[group[hits][::-1]] = hits[::-1]  # the first of equal ones, written last
        found.append(rows)
    return np.unique(np.concatenate(found))


def decimated(time: Array, value: Array, columns: int = LINE_COLUMNS) -> tuple[Array, Array]:
    """Return the points of a line (n,) that a figure can show, by :func:`extreme_rows`."""
    rows = extreme_rows(time, value, columns)
    return time[rows], value[rows]


def envelope(time: Array, low: Array, high: Array | None = None, columns: int = BAND_COLUMNS) -> Envelope:
    """Return the least of ``low`` and the largest of ``high`` (``low`` if not given) in each column."""
    high = low if high is None else high
    if len(time) <= columns:
        return Envelope(time, low, high)
    starts = column_starts(time, columns)
    return Envelope(time[starts], np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts))
