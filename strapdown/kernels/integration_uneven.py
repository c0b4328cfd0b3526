"""Steps over sample intervals of unequal length: the quaternion equation on the rate polynomial through their increments."""

from __future__ import annotations

from strapdown.kernels.integration import large_exponential
from strapdown.kernels.integration_polynomial import LARGEST_RATE, interval_quaternion, sized
from strapdown.kernels.measurement import vector_at
from strapdown.kernels.rotation import quaternion_multiply, renormalized
from strapdown.kernels.state import store_row

ROWS = 7
"""Number of rows of the work space: nodes, and by axis divided differences and powers of the polynomial."""


def uneven_rates(increments, edges, first, number, interval, work, rates):
    """Write the powers of s of the rate polynomial through ``number`` increments from row ``first`` on; return (bound, powers kept).

    s ∈ [−½, ½] is the time from the middle of row ``interval`` in units of its length; the rate is in rad per that length. The polynomial
    of the angle has Newton's form on the edges, whose first divided differences are the increments over their intervals. ``work`` is
    (``ROWS``, number + 1 or more), ``rates`` (4, number or more).
    """
    middle = 0.5 * (edges[interval] + edges[interval + 1])
    scale = 1.0 / (edges[interval + 1] - edges[interval])
    for k in range(number + 1):
        work[0, k] = scale * (edges[first + k] - middle)
    for axis in range(3):
        difference = work[1 + axis]
        power = work[4 + axis]
        difference[0] = 0.0
        for k in range(number):
            difference[k + 1] = increments[first + k, axis] / (work[0, k + 1] - work[0, k])
        for order in range(2, number + 1):
            for k in range(number, order - 1, -1):
                difference[k] = (difference[k] - difference[k - 1]) / (work[0, k] - work[0, k - order])
        power[0] = difference[number]
        for k in range(number - 1, -1, -1):  # times (s − node), and the next difference
            power[number - k] = power[number - k - 1]
            for m in range(number - k - 1, 0, -1):
                power[m] = power[m - 1] - work[0, k] * power[m]
            power[0] = difference[k] - work[0, k] * power[0]
        for m in range(number):
            rates[axis, m] = (m + 1) * power[m + 1]
    return sized(rates, number)


def alike(length, other, ratio):
    """Return whether the ratio of two intervals is below ``ratio``, either way."""
    return length < ratio * other and other < ratio * length


def stretch(edges, interval, start, end, ratio, lopsided):
    """Return the rows (first, end) within [start, end) used in the polynomial for an interval.

    On each side they end before the first interval longer or shorter by ``ratio``, with at most ``lopsided`` more than on the other side: a
    one-sided polynomial of high degree through uneven points amplifies noise.
    """
    length = edges[interval + 1] - edges[interval]
    first = interval
    while first > start and alike(length, edges[first] - edges[first - 1], ratio):
        first -= 1
    last = interval + 1
    while last < end and alike(length, edges[last + 1] - edges[last], ratio):
        last += 1
    before = interval - first
    after = last - interval - 1
    return (interval - min(before, after + lopsided), interval + 1 + min(after, before + lopsided))


def uneven_steps(increments, edges, places, samples, previous, window, ratio, lopsided, work, rates, series, steps):
    """Write the step quaternions (m, 4) of the steps at ``places`` (m,), each through the increments of its window.

    The window is that of :func:`strapdown.kernels.integration_polynomial.polynomial_steps`, reduced to the :func:`stretch` of each
    interval. If the data are too rough for the polynomial, the increment of the interval is its rotation vector.
    """
    latest = len(increments) - window
    for j in range(len(places)):
        begin = places[j] * samples
        start = min(max(begin - previous, 0), latest)
        q = (1.0, 0.0, 0.0, 0.0)
        for i in range(begin, begin + samples):
            first, end = stretch(edges, i, start, start + window, ratio, lopsided)
            bound, kept = uneven_rates(increments, edges, first, end - first, i, work, rates)
            step, ended = interval_quaternion(rates, kept, series)
            if bound > LARGEST_RATE or not ended:
                step = large_exponential(vector_at(increments, i))
            q = quaternion_multiply(q, step)
        store_row(steps, j, renormalized(q))
