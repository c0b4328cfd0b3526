"""Rate and angular acceleration of the body from the gyro's own samples: what an accelerometer off the centre of turning feels."""

from __future__ import annotations

import functools

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.records import ImuRecord

ORDERS = (3, 5, 7)
"""Degrees of the polynomial fitted to the rate over a window; its slope at the middle is the acceleration (Savitzky & Golay 1964)."""
WINDOWS = (5, 7, 9, 11, 13, 17, 21, 25, 31, 37, 45, 53, 61)
"""Windows tried, samples."""
_REACH = WINDOWS[-1] // 2
MOST = 20000
"""Samples by which order and window are chosen."""
LASTING = 4.0
"""Weight of curvature within the window relative to noise."""
LEAST = 100
"""Samples needed to separate noise from motion, more than the longest window."""
UNEVEN = 0.01
"""Tolerated difference of the gyro's intervals, as a part of their mean."""


def turning(record: ImuRecord, time: Array) -> tuple[Array, Array]:
    """Return measured rate and angular acceleration at times (m, 6), rad/s and rad/s², and the variances of the latter's axes (m, 3).

    The slope of a polynomial over a window of samples trades the gyro's noise, ``σ √Σ h²`` for weights h, against what the motion bends
    within the window. That is seen from how the slope differs from that over half the window, which a motion bends sixteen times less or
    better, less what noise alone would make; the order and window of the least sum are taken. σ is that of the rates' fifth differences,
    in which a smooth motion is nothing: ``σ² = E(Δ⁵)²/252``.
    """
    from scipy.signal import savgol_filter

    dt = np.diff(record.time)
    mean = float(dt.mean())
    k = int(np.argmax(np.abs(dt - mean)))
    if abs(dt[k] - mean) > UNEVEN * mean:
        raise InputError(
            f"a lever arm needs gyro intervals that are alike, and that from {record.time[k]:.9g} s is {dt[k]:.6g} s, "
            f"the mean {mean:.6g} s; cut the record, or leave the lever arm out"
        )
    if len(dt) < LEAST:
        raise InputError(
            f"a lever arm needs {LEAST} gyro samples or more, to tell noise from motion; the record has {len(dt)}"
        )
    rates = record.rates
    white = np.mean(np.diff(rates, 5, axis=0) ** 2, axis=0) / 252.0

    def weights(order: int, window: int) -> Array:
        return np.asarray(_slopes(order, window)[_REACH, : WINDOWS[-1]]) / mean

    def slope(order: int, window: int) -> Array:
        return np.asarray(savgol_filter(rates, window, order, deriv=1, delta=mean, axis=0))

    bending = np.diff(rates[:MOST], 2, axis=0).T
    products = [_products(axis) for axis in bending]
    tried = [(order, window) for order in ORDERS for window in WINDOWS if window >= order + 2]
    noises, bends = [], []
    for order, window in tried:
        apart = (_slopes(order, window) - _slopes(order, _half(order, window))) / mean
        bent = _mean_squares(apart, bending, products)
        bent -= white * float(apart[_REACH] @ apart[_REACH])
        noises.append(white * float(np.sum(weights(order, window) ** 2)))
        bends.append(np.maximum(bent, 0.0))
    best = int(np.argmin(np.sum(np.array(noises) + LASTING * np.array(bends), axis=1)))
    order, window = tried[best]
    acceleration = slope(order, window)
    h, sharper = weights(order, window), weights(order, _half(order, window))
    sharp = slope(order, _half(order, window))
    lost = _lost(acceleration, sharp, white * float(h @ h), white * float(h @ sharper))
    acceleration = acceleration * lost
    smooth = np.asarray(savgol_filter(rates, ORDERS[0] + 2, ORDERS[0], axis=0))
    # A sample is the mean over its interval, f + f″ dt²/24.
    for series in (smooth, acceleration):
        series[1:-1] -= np.diff(series, 2, axis=0) / 24.0
    # The cubic through the four nearest middles: a straight line would cut the crests of what swings within some ten samples.
    place = np.clip((time - 0.5 * (record.time[0] + record.time[1])) / mean, 0.0, len(dt) - 1.0)
    k = np.clip(np.floor(place).astype(np.int64), 1, len(dt) - 3)
    s = place - k
    nodes = np.stack(
        [
            -s * (s - 1.0) * (s - 2.0) / 6.0,
            (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
            -(s + 1.0) * s * (s - 2.0) / 2.0,
            (s + 1.0) * s * (s - 1.0) / 6.0,
        ],
        axis=1,
    )
    near = k[:, None] + np.arange(-1, 3)
    found = [np.einsum("mj,mja->ma", nodes, series[near]) for series in (smooth, acceleration)]
    lags = np.array([h[lag:] @ h[: len(h) - lag] for lag in range(4)]) / (h @ h)
    alike = lags[np.abs(np.subtract.outer(np.arange(4), np.arange(4)))]
    left = np.einsum("mi,ij,mj->m", nodes, alike, nodes)
    return np.concatenate(found, axis=1), noises[best] * left[:, None] + bends[best]


def _products(series: Array) -> Array:
    """Return the sums of products of the second differences in a window, over all positions of the longest window in a series."""
    width = WINDOWS[-1] - 2
    n = len(series) - width + 1
    products = np.zeros((width, width))
    products[0] = np.einsum("n,nj->j", series[:n], np.lib.stride_tricks.sliding_window_view(series, width))
    for i in range(1, width):  # one leaves each sum, one joins it
        gone, new = series[i - 1 : width - 1], series[n + i - 1 :]
        products[i, i:] = products[i - 1, i - 1 : -1] + new[0] * new - gone[0] * gone
    return np.asarray(np.triu(products) + np.triu(products, 1).T)


def _mean_squares(weights: Array, bending: Array, products: list[Array]) -> Array:
    """Return the mean squares (3,) of what weights of samples, as :func:`_slopes` has them, make of axes of second differences (3, n).

    What two slopes differ by is nothing of a straight line, so summed twice the weights are those of the differences, in which the rate
    itself, of which little is left, costs no digits. ``products`` are those of each axis.
    """
    summed = np.cumsum(np.cumsum(weights, axis=1), axis=1)[:, :-2]
    inside, width = summed[_REACH], summed.shape[1]
    found = np.empty(len(bending))
    for i, series in enumerate(bending):
        begin, end = summed[:_REACH] @ series[:width], summed[_REACH + 1 :] @ series[-width:]
        found[i] = inside @ products[i] @ inside + begin @ begin + end @ end
    return np.asarray(found / (bending.shape[1] + 2))


@functools.cache
def _slopes(order: int, window: int) -> Array:
    """Return the weights of slopes: at the first samples of a series, in the middle of the longest window, and at the last ones."""
    from scipy.signal import savgol_filter

    width = WINDOWS[-1]
    every = savgol_filter(np.eye(2 * width), window, order, deriv=1, axis=0)
    middle = every[width : width + 1, width - _REACH : width + _REACH + 1]
    return np.concatenate([every[:_REACH, :width], middle, every[-_REACH:, -width:]])


def _half(order: int, window: int) -> int:
    """Return about half of an odd window, odd too and enough for a polynomial of this order."""
    return max(order + 2, window // 4 * 2 + 1)


def _lost(slope: Array, sharper: Array, own: Array, common: Array) -> Array:
    """Return the factor of each axis (3,), 1 or more, by which slopes (n, 3) fall short of those over half the window: least squares.

    What a window bends of a vibration is little of every sample, but alike in all of them, and a lever arm, which is constant, makes up for
    it by its length. ``own`` is what the gyro's noise makes of the mean square of a slope, ``common`` of the mean product of both (3,).
    """
    power = np.mean(slope**2, axis=0) - own
    seen = power > own  # nothing is known of an axis that hardly turns
    shared = np.mean(slope * sharper, axis=0) - common
    return np.where(seen, np.maximum(shared / np.where(seen, power, 1.0), 1.0), 1.0)
