"""Rate and angular acceleration of the body from the gyro's samples: the acceleration of a point off the centre of rotation."""

from __future__ import annotations

import functools

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.records import ImuRecord

ORDERS = (3, 5, 7)
"""Degrees of the polynomial fitted to the rate over a window; its slope at the middle is the acceleration (Savitzky & Golay 1964)."""
WINDOWS = (5, 7, 9, 11, 13, 17, 21, 25, 31, 37, 45, 53, 61)
"""Windows tried, number of samples."""
_REACH = WINDOWS[-1] // 2
MAX_SAMPLES = 20000
"""Maximum number of samples from which order and window are chosen."""
BIAS_WEIGHT = 4.0
"""Weight of the bias due to curvature within the window relative to noise."""
MIN_SAMPLES = 100
"""Minimum number of samples, to separate noise from motion; more than the longest window."""
UNEVEN = 0.01
"""Maximum difference of the gyro's intervals from their mean, relative to it."""


def turning(record: ImuRecord, time: Array) -> tuple[Array, Array]:
    """Return measured rate and angular acceleration at times (m, 6), rad/s and rad/s², and the variances of the latter's axes (m, 3).

    The slope of a polynomial over a window of samples is a compromise between the gyro's noise, ``σ √Σ h²`` for weights h, and the bias due
    to the curvature of the motion within the window. The bias is estimated by comparison with the slope over half the window, whose
    bias is smaller by a factor of sixteen or more, after subtraction of the difference due to noise; order and window of the smallest sum
    are used. σ is estimated from the fifth differences of the rates, to which a smooth motion contributes nothing: ``σ² = E(Δ⁵)²/252``.
    """
    from scipy.signal import savgol_filter

    dt = record.intervals
    mean = float(dt.mean())
    k = int(np.argmax(np.abs(dt - mean)))
    if abs(dt[k] - mean) > UNEVEN * mean:
        raise InputError(
            f"a lever arm needs equal gyro intervals, but that from {record.time[k]:.9g} s is {dt[k]:.6g} s, "
            f"the mean {mean:.6g} s; cut the record, or leave the lever arm out"
        )
    if len(dt) < MIN_SAMPLES:
        raise InputError(
            f"a lever arm needs {MIN_SAMPLES} gyro samples or more, to separate noise from motion; the record has {len(dt)}"
        )
    rates = record.rates
    white = np.mean(np.diff(rates, 5, axis=0) ** 2, axis=0) / 252.0
    order, window, noise, bend = _best_window(rates, white, mean)
    acceleration, sharp = (
        np.asarray(savgol_filter(rates, w, order, deriv=1, delta=mean, axis=0)) for w in (window, _half(order, window))
    )
    h, sharper = (_slopes(order, w)[_REACH, : WINDOWS[-1]] / mean for w in (window, _half(order, window)))
    acceleration = acceleration * _lost(acceleration, sharp, white * float(h @ h), white * float(h @ sharper))
    smooth = np.asarray(savgol_filter(rates, ORDERS[0] + 2, ORDERS[0], axis=0))
    # A sample is the mean over its interval, f + f″ dt²/24.
    for series in (smooth, acceleration):
        series[1:-1] -= np.diff(series, 2, axis=0) / 24.0
    near, nodes = _cubic((time - 0.5 * (record.time[0] + record.time[1])) / mean, len(dt))
    turns_over = [np.einsum("mj,mja->ma", nodes, series[near]) for series in (smooth, acceleration)]
    lags = np.array([h[lag:] @ h[: len(h) - lag] for lag in range(4)]) / (h @ h)
    alike = lags[np.abs(np.subtract.outer(np.arange(4), np.arange(4)))]
    left = np.einsum("mi,ij,mj->m", nodes, alike, nodes)
    return np.concatenate(turns_over, axis=1), noise * left[:, None] + bend


def _best_window(rates: Array, white: Array, dt: float) -> tuple[int, int, Array, Array]:
    """Return order and window of the slope whose variance, the sum of those of noise and of bias, is smallest, and these two (3,).

    ``white`` (3,) is the variance of the gyro's noise in a sample.
    """
    bending = np.diff(rates[:MAX_SAMPLES], 2, axis=0).T
    products = [_products(axis) for axis in bending]
    tried = [(order, window) for order in ORDERS for window in WINDOWS if window >= order + 2]
    noises, bends = [], []
    for order, window in tried:
        apart = (_slopes(order, window) - _slopes(order, _half(order, window))) / dt
        bent = _mean_squares(apart, bending, products)
        bent -= white * float(apart[_REACH] @ apart[_REACH])
        noises.append(white * float(np.sum((_slopes(order, window)[_REACH, : WINDOWS[-1]] / dt) ** 2)))
        bends.append(np.maximum(bent, 0.0))
    best = int(np.argmin(np.sum(np.array(noises) + BIAS_WEIGHT * np.array(bends), axis=1)))
    return *tried[best], noises[best], bends[best]


def _cubic(place: Array, number: int) -> tuple[np.ndarray, Array]:
    """Return the four of a number of points nearest to each place (m, 4), and their weights in cubic interpolation.

    Linear interpolation would reduce the peaks of oscillations of about ten samples.
    """
    place = np.clip(place, 0.0, number - 1.0)
    k = np.clip(np.floor(place).astype(np.int64), 1, number - 3)
    s = place - k
    weights = (
        -s * (s - 1.0) * (s - 2.0) / 6.0,
        (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
        -(s + 1.0) * s * (s - 2.0) / 2.0,
        (s + 1.0) * s * (s - 1.0) / 6.0,
    )
    return k[:, None] + np.arange(-1, 3), np.stack(weights, axis=1)


def _products(series: Array) -> Array:
    """Return the sums of products of the second differences in a window, over all positions of the longest window in a series."""
    width = WINDOWS[-1] - 2
    n = len(series) - width + 1
    products = np.zeros((width, width))
    products[0] = np.einsum("n,nj->j", series[:n], np.lib.stride_tricks.sliding_window_view(series, width))
    for i in range(1, width):  # one product leaves each sum, one enters
        gone, new = series[i - 1 : width - 1], series[n + i - 1 :]
        products[i, i:] = products[i - 1, i - 1 : -1] + new[0] * new - gone[0] * gone
    return np.asarray(np.triu(products) + np.triu(products, 1).T)


def _mean_squares(weights: Array, bending: Array, products: list[Array]) -> Array:
    """Return the mean squares (3,) of the difference of two slopes, from its weights of samples and axes of second differences (3, n).

    The difference is zero for a straight line, so its weights summed twice are weights of the second differences; then no digits are lost
    by cancellation of the rate itself. ``products`` are those of each axis.
    """
    summed = np.cumsum(np.cumsum(weights, axis=1), axis=1)[:, :-2]
    inside, width = summed[_REACH], summed.shape[1]
    squares = np.empty(len(bending))
    for i, series in enumerate(bending):
        begin, end = summed[:_REACH] @ series[:width], summed[_REACH + 1 :] @ series[-width:]
        squares[i] = inside @ products[i] @ inside + begin @ begin + end @ end
    return np.asarray(squares / (bending.shape[1] + 2))


@functools.cache
def _slopes(order: int, window: int) -> Array:
    """Return the weights of slopes: at the first samples of a series, in the middle of the longest window, and at the last samples."""
    from scipy.signal import savgol_filter

    width = WINDOWS[-1]
    every = savgol_filter(np.eye(2 * width), window, order, deriv=1, axis=0)
    middle = every[width : width + 1, width - _REACH : width + _REACH + 1]
    return np.concatenate([every[:_REACH, :width], middle, every[-_REACH:, -width:]])


def _half(order: int, window: int) -> int:
    """Return about half of an odd window, also odd, and long enough for a polynomial of this order."""
    return max(order + 2, window // 4 * 2 + 1)


def _lost(slope: Array, sharper: Array, own: Array, common: Array) -> Array:
    """Return the factor of each axis (3,), at least 1, by which slopes (n, 3) are smaller than those over half the window: least squares.

    The smoothing of a vibration by the window is small in each sample but the same in all of them, so a constant lever arm would compensate
    it by its length. ``own`` is the contribution of the gyro's noise to the mean square of a slope, ``common`` to the mean product of both
    slopes (3,).
    """
    power = np.mean(slope**2, axis=0) - own
    rotates = power > own  # no factor for an axis that hardly rotates
    shared = np.mean(slope * sharper, axis=0) - common
    return np.where(rotates, np.maximum(shared / np.where(rotates, power, 1.0), 1.0), 1.0)
