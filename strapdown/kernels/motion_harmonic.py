"""Attitude under harmonic body rates by Taylor series about evenly spaced nodes, used as truth by :mod:`strapdown.motion`.

About a node the rate is a power series known in closed form, so equation (17), ``q̇ = ½ q ⊗ w_b``, gives the attitude relative to the
node by recurrence: ``q_{n+1} = ½/(n + 1) Σ q_i ⊗ w_{n−i}``. Deviations from the identity are stored instead of quaternions, and summed
with compensation, so the error over a chain of nodes is only the rounding of the deviations.
"""

from __future__ import annotations

from strapdown.kernels.algebra import add_matrices
from strapdown.kernels.measurement import quaternion_at
from strapdown.kernels.rotation import quaternion_multiply


def rate_series(cosines, sines, factors, amplitudes, mean, series):
    """Fill ``series`` (terms, 3) with the Taylor coefficients of ``mean + Σ a_j cos(ω_j t + θ_j)`` about a node.

    ``cosines`` and ``sines`` are those of the phases at the node; ``factors`` (harmonics, terms) holds ω^n/n! rounded once, because
    their error is the same at every node and accumulates.
    """
    for n in range(series.shape[0]):
        for axis in range(3):
            series[n, axis] = mean[axis] if n == 0 else 0.0
    for j in range(factors.shape[0]):
        c = cosines[j]
        s = sines[j]
        for n in range(series.shape[0]):
            value = factors[j, n] * c
            for axis in range(3):
                series[n, axis] += amplitudes[j, axis] * value
            c, s = -s, c


def attitude_series(rate, series):
    """Fill ``series`` (terms + 1, 4) with the Taylor coefficients of the attitude relative to the node; the first is the identity."""
    series[0, 0] = 1.0
    series[0, 1] = 0.0
    series[0, 2] = 0.0
    series[0, 3] = 0.0
    for n in range(rate.shape[0]):
        w = 0.0
        x = 0.0
        y = 0.0
        z = 0.0
        for i in range(n + 1):
            q0 = series[i, 0]
            q1 = series[i, 1]
            q2 = series[i, 2]
            q3 = series[i, 3]
            wx = rate[n - i, 0]
            wy = rate[n - i, 1]
            wz = rate[n - i, 2]
            w -= q1 * wx + q2 * wy + q3 * wz
            x += q0 * wx + q2 * wz - q3 * wy
            y += q0 * wy + q3 * wx - q1 * wz
            z += q0 * wz + q1 * wy - q2 * wx
        divisor = 2.0 * (n + 1.0)
        series[n + 1, 0] = w / divisor
        series[n + 1, 1] = x / divisor
        series[n + 1, 2] = y / divisor
        series[n + 1, 3] = z / divisor


def deviation(series, t):
    """Return the sum of an attitude series at ``t`` less the identity, by Horner's rule."""
    w = 0.0
    x = 0.0
    y = 0.0
    z = 0.0
    for n in range(series.shape[0] - 1, 0, -1):
        w = (w + series[n, 0]) * t
        x = (x + series[n, 1]) * t
        y = (y + series[n, 2]) * t
        z = (z + series[n, 3]) * t
    return (w, x, y, z)


def node_deviations(cosines, sines, factors, amplitudes, mean, half, rate, series, before, after):
    """Fill ``before`` and ``after`` (n, 4): each node's deviation half a spacing earlier and later."""
    for k in range(cosines.shape[0]):
        rate_series(cosines[k], sines[k], factors, amplitudes, mean, rate)
        attitude_series(rate, series)
        earlier = deviation(series, -half)
        later = deviation(series, half)
        for i in range(4):
            before[k, i] = earlier[i]
            after[k, i] = later[i]


def advance(q, low, d):
    """Return q ⊗ (1 + d) for a quaternion stored as the unevaluated sum ``q + low``, in the same form (two-sum, Knuth)."""
    p = quaternion_multiply(add_matrices(q, low), d)
    s = add_matrices(q, p)
    b = tuple(x - y for x, y in zip(s, q, strict=True))
    return s, tuple(low[i] + ((q[i] - (s[i] - b[i])) + (p[i] - b[i])) for i in range(4))


def chain(leaving, arriving, attitudes, lows):
    """Fill rows 1… of ``attitudes`` and ``lows`` (n, 4), attitudes at consecutive nodes, from row 0.

    ``leaving[k]`` takes node k to the point half-way to the next, ``arriving[k + 1]`` is that point as seen from node k + 1: the step
    is ``(1 + a) ⊗ (1 + b)*``, its deviation ``a + b* + a ⊗ b*``.
    """
    q = quaternion_at(attitudes, 0)
    low = quaternion_at(lows, 0)
    for k in range(leaving.shape[0] - 1):
        a = quaternion_at(leaving, k)
        b = (arriving[k + 1, 0], -arriving[k + 1, 1], -arriving[k + 1, 2], -arriving[k + 1, 3])
        ab = quaternion_multiply(a, b)
        q, low = advance(q, low, add_matrices(add_matrices(a, b), ab))
        for i in range(4):
            attitudes[k + 1, i] = q[i]
            lows[k + 1, i] = low[i]


def evaluate(node, offset, cosines, sines, factors, amplitudes, mean, attitudes, lows, rate, series, result):
    """Fill ``result`` (n, 4) with the attitudes at ``offset`` from each time's node; ``node`` is sorted, so each series is made once."""
    last = -1
    for k in range(node.shape[0]):
        j = node[k]
        if j != last:
            rate_series(cosines[j], sines[j], factors, amplitudes, mean, rate)
            attitude_series(rate, series)
            last = j
        q = quaternion_at(attitudes, j)
        low = quaternion_at(lows, j)
        q, low = advance(q, low, deviation(series, offset[k]))
        for i in range(4):
            result[k, i] = q[i] + low[i]
