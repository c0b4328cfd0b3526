"""Error states in chains, each driven by the next: shaping filters with real poles for the white noise of a chain's last state.

``ċₖ = −λₖ cₖ + gₖ cₖ₊₁ + √qₖ wₖ``. ``decay`` holds λ and ``chains`` (states, 2) g and q. A chain has at most :data:`CHAIN` states, and
these do not enter the gyro. A single state is a chain of one.
"""

from __future__ import annotations

import math

import numpy as np

from strapdown.kernels.algebra import congruent, multiply, symmetric_index
from strapdown.kernels.lane_values import WIDTH, broadcast, load, sum_lanes

CALLED = ("chain_step", "fill_coefficients")
"""Called, not inlined, by other kernels: a call costs little compared with their work, and each copy would be compiled again."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(WIDTH)
CHAIN = 3
"""Maximum number of states of a chain."""
TERMS = 14
"""Number of terms in the series of a chain's transition: accurate to rounding for λ dt ≤ 1/2."""
NODES = np.concatenate([0.5 * (1.0 + _NODES), 0.5 * _WEIGHTS])
"""Nodes and weights of Gauss's rule with eight nodes on [0, 1], one lane per node."""
SET = 16
"""Numbers of a set of coefficients: Φ and Q (6 each, upper triangle by rows) of a chain of up to three states, and ∫ e^{−λs} ds."""
MEAN = 12
"""Place of that integral in a set."""


def chain_start(chains, k):
    """Return the first state of the chain that contains state k or ends with it."""
    first = k
    while first > 0 and chains[first - 1, 0] != 0.0:
        first -= 1
    return first


def chain_step(decay, chains, k, first, dt):
    """Return the effect over dt of state k of a chain on states k − 2, k − 1 and k, and their process noise covariance for unit PSD.

    The first is column k of Φ, (φ_{k−2}, φ_{k−1}, φ_k), by the series of the matrix exponential, also valid for equal or zero poles. The
    second is Q of the three (6-tuple), zero if absent: the same series at the nodes of Gauss's rule, accurate to 3e-14 for λ dt ≤ 1/2.
    Both are in closed form for the first state of a chain.
    """
    if k == first:
        lost = -math.expm1(-decay[k] * dt)
        noise = 0.5 * lost * (2.0 - lost) / decay[k] if decay[k] > 0.0 else dt
        return (0.0, 0.0, 1.0 - lost), (0.0, 0.0, 0.0, 0.0, 0.0, noise)
    own = -decay[k] * dt
    middle, to_middle, far, to_far = 0.0, 0.0, 0.0, 0.0
    if k - 1 >= first:
        middle, to_middle = -decay[k - 1] * dt, chains[k - 1, 0] * dt
    if k - 2 >= first:
        far, to_far = -decay[k - 2] * dt, chains[k - 2, 0] * dt
    a, b, c = 0.0, 0.0, 1.0
    af, bf, cf = 0.0, 0.0, 1.0
    nodes, weights = load(NODES, 0), dt * load(NODES, WIDTH)
    A = B = broadcast(0.0)
    C = powers = broadcast(1.0)
    for i in range(1, TERMS + 1):
        share = 1.0 / i
        a = share * (to_far * b + far * a)
        b = share * (to_middle * c + middle * b)
        c = share * (own * c)
        af, bf, cf = af + a, bf + b, cf + c
        powers = powers * nodes
        A, B, C = A + a * powers, B + b * powers, C + c * powers
    a, b, c = weights * A, weights * B, weights * C
    return (af, bf, cf), (
        sum_lanes(a * A),
        sum_lanes(b * A),
        sum_lanes(c * A),
        sum_lanes(b * B),
        sum_lanes(c * B),
        sum_lanes(c * C),
    )


def fill_coefficients(coefficients, dt, model):
    """Write the sets of coefficients of a step of dt."""
    decay, chains, last = model.decay, model.chains, model.last
    for g in range(len(last)):
        k = last[g]
        first = chain_start(chains, k)
        here = SET * g
        for i in range(SET):
            coefficients[here + i] = 0.0
        for j in range(first, k + 1):
            column, Q = chain_step(decay, chains, j, first, dt)
            place = 2 - (k - j)  # of state j in the set
            # Each state of a chain may be driven; its noise reaches the states before it.
            q = chains[j, 1]
            for a in range(place + 1):
                coefficients[here + symmetric_index(a, place)] = column[2 - place + a]
                for b in range(a, place + 1):
                    if q != 0.0:
                        coefficients[here + 6 + symmetric_index(a, b)] += (
                            q * Q[symmetric_index(2 - place + a, 2 - place + b)]
                        )
        rate = decay[k]
        coefficients[here + MEAN] = -math.expm1(-rate * dt) / rate if rate > 0.0 else dt


def double_step(coefficients, here):
    """Replace Φ and Q of a set of coefficients by those of twice the time."""
    c = coefficients[here : here + 12]
    phi = (c[0], c[1], c[2], 0.0, c[3], c[4], 0.0, 0.0, c[5])
    Q = (c[6], c[7], c[8], c[9], c[10], c[11])
    R = congruent(phi, Q)
    phi = multiply(phi, phi)
    for i, value in enumerate((phi[0], phi[1], phi[2], phi[4], phi[5], phi[8])):
        c[i] = value
    for i in range(3):
        c[6 + i] = Q[i] + R[i]
        c[9 + i] = Q[3 + i] + R[3 + i]
