"""Record loops of the gyro error model: drifting bias and noise, low-pass, saturation, quantisation. One axis at a time in blocks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.noise import fill_normals

BLOCK = 512
"""Number of samples in a block; a change of it changes the random numbers of a seed."""

WALK, MARKOV, FLICKER, WHITE = 0, 1, 2, 3
"""Random streams of an axis: one for each noise term, so an additional term changes no other."""


def bridge_remainder(u):
    """Return (1 − tanh(u)/u)/(4u²), which tends to 1/12, for u ≥ 0."""
    if u < 0.02:
        x = u * u
        return (1.0 / 3.0 - x * (2.0 / 15.0 - x * (17.0 / 315.0 - x * (62.0 / 2835.0)))) / 4.0
    return (1.0 - math.tanh(u) / u) / (4.0 * u * u)


def markov_step(dt, correlation_time):
    """Return φ, variance of a step over q, mean factor and variance of the integral over q, for a Gauss–Markov process with driving PSD q.

    Over dt, u = dt/(2τ): ``x₁ = φ x₀ + n`` with φ = e^(−2u) and ``var n = q dt (1 − e^(−4u))/(4u)``; given both ends, the integral has mean
    ``½ dt (x₀ + x₁) tanh(u)/u`` and variance ``q dt³ (1 − tanh(u)/u)/(4u²)``. For an infinite τ, a random walk, these are 1, q dt, ½ dt and
    q dt³/12.
    """
    u = 0.5 * dt / correlation_time
    step = dt
    mean = 0.5 * dt
    if u > 0.0:
        step = dt * (-math.expm1(-4.0 * u) / (4.0 * u))
        mean = 0.5 * dt * (math.tanh(u) / u)
    return math.exp(-2.0 * u), step, mean, dt * dt * dt * bridge_remainder(u)


def gauss_markov(decay, steps, values):
    """Fill values (n + 1, 3), starting from the first row: x ← φ x + w with decays φ (n,) and steps w (n, 3)."""
    for k in range(len(decay)):
        for i in range(3):
            values[k + 1, i] = decay[k] * values[k, i] + steps[k, i]


def flicker_block(poles, gains, states, normals, out):
    """Fill out (m,) with flicker noise of B = 1, and update its 16 states: x ← p x + w, out = g · x."""
    c, x = gains, states
    for k in range(out.shape[0]):
        w = normals[k]
        for i in range(16):
            x[i] = poles[i] * x[i] + w
        s0 = ((c[0] * x[0] + c[4] * x[4]) + c[8] * x[8]) + c[12] * x[12]
        s1 = ((c[1] * x[1] + c[5] * x[5]) + c[9] * x[9]) + c[13] * x[13]
        s2 = ((c[2] * x[2] + c[6] * x[6]) + c[10] * x[10]) + c[14] * x[14]
        s3 = ((c[3] * x[3] + c[7] * x[7]) + c[11] * x[11]) + c[15] * x[15]
        out[k] = (s0 + s2) + (s1 + s3)


class Errors(NamedTuple):
    """Errors of a gyro; values by axis are (3,)."""

    matrix: np.ndarray
    """Identity plus scale factors and misalignments (3, 3)."""
    asymmetry: np.ndarray
    constant: np.ndarray
    """Bias, rad/s."""
    ramp: np.ndarray
    """rad/s²."""
    white: np.ndarray
    """σ_v, rad/√s."""
    walk: np.ndarray
    """σ_u, rad/s/√s."""
    markov: np.ndarray
    """√q of the Markov bias, rad/s/√s."""
    correlation_time: np.ndarray
    """Correlation time of the Markov bias, s."""
    flicker: np.ndarray
    """Bias instability B, rad/s."""
    poles: np.ndarray
    gains: np.ndarray
    """Gains of the flicker states (16,)."""


class Drift(NamedTuple):
    """State of the drift by axis, updated by each call."""

    flicker_states: np.ndarray
    """(3, 16)."""
    flicker_before: np.ndarray
    """Flicker of the previous interval (3,), rad/s."""
    walk: np.ndarray
    markov: np.ndarray
    """Random walk and Markov bias (3,), rad/s."""


class Draws(NamedTuple):
    """Generators and scratch."""

    streams: np.ndarray
    """State of each generator (3, terms, 2, 4), by axis and noise term."""
    words: np.ndarray
    """(2, BLOCK / 2)."""
    normals: np.ndarray
    """(4, BLOCK)."""


def drift_and_noise(edges, true_increments, errors, drift, draws, increments, bias):
    """Fill increments (n, 3) and bias (n + 1, 3) from the true increments.

    The bias at an edge includes the mean flicker of the two adjacent intervals.
    """
    matrix, asymmetry, constant, ramp, white, walk, markov, correlation_time, flicker, poles, gains = errors
    flicker_states, flicker_before, walk_now, markov_now = drift
    streams, words, normals = draws
    n = increments.shape[0]
    start = edges[0]
    for first in range(0, n + 1, BLOCK):
        m = min(BLOCK, n + 1 - first)
        for axis in range(3):
            walking = normals[WALK]
            wandering = normals[MARKOV]
            flickering = normals[FLICKER]
            whites = normals[WHITE]
            if walk[axis] > 0.0:
                fill_normals(streams[axis, WALK], words, walking)
            if markov[axis] > 0.0:
                fill_normals(streams[axis, MARKOV], words, wandering)
            if flicker[axis] > 0.0:
                fill_normals(streams[axis, FLICKER], words, whites)
                flicker_block(poles, gains, flicker_states[axis], whites, flickering[:m])
            if white[axis] > 0.0 or walk[axis] > 0.0 or markov[axis] > 0.0:
                fill_normals(streams[axis, WHITE], words, whites)
            a0 = matrix[axis, 0]
            a1 = matrix[axis, 1]
            a2 = matrix[axis, 2]
            bent = asymmetry[axis]
            steady = constant[axis]
            slope = ramp[axis]
            q = markov[axis] * markov[axis]
            r = walk_now[axis]
            g = markov_now[axis]
            before = flicker_before[axis]
            spread = 0.0
            walk_step = 0.0
            markov_spread = 0.0
            decay = 1.0
            mean = 0.0
            known = -1.0  # interval that the coefficients above hold for, to a part in 1e9
            for i in range(m):
                k = first + i
                now = flicker[axis] * flickering[i]
                b = steady + slope * (edges[k] - start) + r + g
                bias[k, axis] = b + 0.5 * (before + now)
                before = now
                if k < n:
                    dt = edges[k + 1] - edges[k]
                    if abs(dt - known) > 1e-9 * dt:
                        known = dt
                        walk_step = walk[axis] * math.sqrt(dt)
                        decay, variance, mean, remainder = markov_step(dt, correlation_time[axis])
                        markov_spread = math.sqrt(q * variance)
                        spread = math.sqrt(
                            white[axis] * white[axis] * dt
                            + walk[axis] * walk[axis] * dt * dt * dt / 12.0
                            + q * remainder
                        )
                    r1 = r + walk_step * walking[i]
                    g1 = decay * g + markov_spread * wandering[i]
                    turn = a0 * true_increments[k, 0] + a1 * true_increments[k, 1] + a2 * true_increments[k, 2]
                    turn += bent * abs(true_increments[k, axis])
                    rate = steady + slope * (edges[k] - start + 0.5 * dt) + 0.5 * (r + r1) + now
                    increments[k, axis] = turn + rate * dt + mean * (g + g1) + spread * whites[i]
                    r = r1
                    g = g1
            walk_now[axis] = r
            markov_now[axis] = g
            flicker_before[axis] = before


def low_pass(dt, transition, factor, white, state, streams, words, normals, increments, out):
    """Fill out (n, 3) with the increments of a second-order low-pass, from those of its input.

    In each interval the input rate is linear, with the area of the interval and the slope between the means of the adjacent intervals.
    ``transition`` (3, 4) maps (y, ẏ, mean, slope) to (y, ẏ, ∫y) at the end; white noise of σ_v enters in continuous time, through the
    Cholesky factor (3, 3) of its effect on the three. ``state`` (3, 2) is updated.
    """
    n = increments.shape[0]
    for first in range(0, n, BLOCK):
        m = min(BLOCK, n - first)
        for axis in range(3):
            for j in range(3):
                fill_normals(streams[axis, j], words, normals[j])
            y = state[axis, 0]
            v = state[axis, 1]
            sigma = white[axis]
            for i in range(m):
                k = first + i
                mean = increments[k, axis] / dt
                left = max(k - 1, 0)
                right = min(k + 1, n - 1)
                slope = (increments[right, axis] - increments[left, axis]) / (max(right - left, 1) * dt * dt)
                e0 = sigma * normals[0, i]
                e1 = sigma * normals[1, i]
                e2 = sigma * normals[2, i]
                t = transition
                area = t[2, 0] * y + t[2, 1] * v + t[2, 2] * mean + t[2, 3] * slope
                area += factor[2, 0] * e0 + factor[2, 1] * e1 + factor[2, 2] * e2
                y1 = t[0, 0] * y + t[0, 1] * v + t[0, 2] * mean + t[0, 3] * slope + factor[0, 0] * e0
                v1 = (
                    t[1, 0] * y + t[1, 1] * v + t[1, 2] * mean + t[1, 3] * slope + factor[1, 0] * e0 + factor[1, 1] * e1
                )
                y = y1
                v = v1
                out[k, axis] = area
            state[axis, 0] = y
            state[axis, 1] = v


def digitize(edges, limit, step, resolution, carried, increments):
    """Clip the rate of increments (n, 3) at ± ``limit``, then round: increments to ``step`` with the remainder carried, rates to
    ``resolution``, each by axis; 0: not rounded; an infinite limit: not clipped.
    """  # noqa: D205
    for axis in range(3):
        most = limit[axis]
        q = step[axis]
        unit = resolution[axis]
        rest = carried[axis]
        for k in range(increments.shape[0]):
            dt = edges[k + 1] - edges[k]
            turn = min(max(increments[k, axis], -most * dt), most * dt)
            if unit > 0.0:
                turn = unit * math.floor(turn / dt / unit + 0.5) * dt
            if q > 0.0:
                turn += rest
                rounded = q * math.floor(turn / q + 0.5)
                rest = turn - rounded
                turn = rounded
            increments[k, axis] = turn
        carried[axis] = rest
