"""Error states in chains, each driven by the next: shaping filters with real poles for the white noise of a chain's last state.

``ċₖ = −λₖ cₖ + gₖ cₖ₊₁``; the last state of a chain is also driven by white noise of PSD q. ``decay`` holds λ and ``chains`` (states, 3) g
and q; its last column is for :func:`strapdown.kernels.error_state_step.turn_values`. A chain has at most :data:`CHAIN` states, and these do
not enter the gyro. :mod:`strapdown.kernels.error_state_step` applies the decay of each state; the coupling follows here, as ``Φ = (I + U)
diag(e^{−λ dt})`` with U strictly upper triangular, so triangular factors stay triangular. Without chains nothing is called.
"""

from __future__ import annotations

import math

import numpy as np

from strapdown.kernels.lane_values import WIDTH, load, spread, total

CALLED = ("chain_step", "step_chains", "carry_chains_back")
"""Called, not inlined, by other kernels: a call costs little compared with their work, and each copy would be compiled again."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(WIDTH)
CHAIN = 3
"""Maximum number of states of a chain."""
TERMS = 14
"""Number of terms in the series of a chain's transition: accurate to rounding for λ dt ≤ 1/2."""
NODES = np.concatenate([0.5 * (1.0 + _NODES), 0.5 * _WEIGHTS])
"""Nodes and weights of Gauss's rule with eight nodes on [0, 1], one lane per node."""
LINKS = 8
"""Width of the scratch for the coupling and the root of the noise of a step."""


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
    """
    own = -decay[k] * dt
    middle, to_middle, far, to_far = 0.0, 0.0, 0.0, 0.0
    if k - 1 >= first:
        middle, to_middle = -decay[k - 1] * dt, chains[k - 1, 0] * dt
    if k - 2 >= first:
        far, to_far = -decay[k - 2] * dt, chains[k - 2, 0] * dt
    a, b, c = 0.0, 0.0, 1.0
    af, bf, cf = 0.0, 0.0, 1.0
    nodes, weights = load(NODES, 0), dt * load(NODES, WIDTH)
    A = B = spread(0.0)
    C = powers = spread(1.0)
    for i in range(1, TERMS + 1):
        share = 1.0 / i
        a = share * (to_far * b + far * a)
        b = share * (to_middle * c + middle * b)
        c = share * (own * c)
        af, bf, cf = af + a, bf + b, cf + c
        powers = powers * nodes
        A, B, C = A + a * powers, B + b * powers, C + c * powers
    a, b, c = weights * A, weights * B, weights * C
    return (af, bf, cf), (total(a * A), total(b * A), total(c * A), total(b * B), total(c * B), total(c * C))


def chain_root(Q):
    """Return N with ``Q = Nᵀ N`` as (n20, n21, n22, n10, n11, n00), by rows from that of the last state upwards."""
    n22 = math.sqrt(Q[5])
    n21 = Q[4] / n22 if n22 > 0.0 else 0.0
    n20 = Q[2] / n22 if n22 > 0.0 else 0.0
    n11 = math.sqrt(max(Q[3] - n21 * n21, 0.0))
    n10 = (Q[1] - n20 * n21) / n11 if n11 > 0.0 else 0.0
    n00 = math.sqrt(max(Q[0] - n20 * n20 - n10 * n10, 0.0))
    return n20, n21, n22, n10, n11, n00


def alike(decay, chains, k, number):
    """Return whether the ``number`` states up to k form a chain with the same parameters as the ``number`` states before them."""
    begin = k - 2 * number + 1
    if begin < 0 or chains[k - number, 0] != 0.0 or (begin > 0 and chains[begin - 1, 0] != 0.0):
        return False
    same = True
    for i in range(k - number + 1, k + 1):
        same = same and decay[i] == decay[i - number] and chains[i, 0] == chains[i - number, 0]
    return same


def link_chains(decay, chains, dt, links):
    """Write the entries of U for each state, for the next and the next but one, and the root of its noise for unit PSD, to ``links``."""
    for k in range(len(chains)):
        links[k, 0] = 0.0
        links[k, 1] = 0.0
        if k > 0 and chains[k - 1, 0] != 0.0:
            first = chain_start(chains, k)
            number = k - first + 1
            if alike(decay, chains, k, number):
                links[k - 1, 0] = links[k - 1 - number, 0]
                if number > 2:
                    links[k - 2, 1] = links[k - 2 - number, 1]
                for i in range(2, 8):
                    links[k, i] = links[k - number, i]
            else:
                (far, near, own), Q = chain_step(decay, chains, k, first, dt)
                links[k - 1, 0] = near / own
                if number > 2:
                    links[k - 2, 1] = far / own
                links[k, 2], links[k, 3], links[k, 4], links[k, 5], links[k, 6], links[k, 7] = chain_root(Q)


def feed_states(values, first, links):
    """Apply I + U to the states, which start at ``first`` in ``values``."""
    for k in range(len(links)):
        if links[k, 0] != 0.0:
            values[first + k] += links[k, 0] * values[first + k + 1]
            if links[k, 1] != 0.0:
                values[first + k] += links[k, 1] * values[first + k + 2]


def carry_chains(F, first, end, links):
    """Apply I + U to the columns of rows of F: ``S ← (I + U) S``."""
    for k in range(len(links)):
        if links[k, 0] != 0.0:
            near, far = links[k, 0], links[k, 1]
            for j in range(first, end):
                F[j, 6 + k] += near * F[j, 7 + k]
            if far != 0.0:
                for j in range(first, end):
                    F[j, 6 + k] += far * F[j, 8 + k]


def carry_chains_back(F, first, end, links):
    """Undo :func:`carry_chains`."""
    for k in range(len(links) - 1, -1, -1):
        if links[k, 0] != 0.0:
            near, far = links[k, 0], links[k, 1]
            for j in range(first, end):
                F[j, 6 + k] -= near * F[j, 7 + k]
            if far != 0.0:
                for j in range(first, end):
                    F[j, 6 + k] -= far * F[j, 8 + k]


def fill_chain_noise(F, row, columns, chains, links):
    """Write the noise rows of driven chains, starting at a row of F, after those of ``error_state_step.fill_noise``."""
    for k in range(len(chains)):
        if chains[k, 1] > 0.0:
            number = k - chain_start(chains, k) + 1
            size = math.sqrt(chains[k, 1])
            for r in range(number):
                for i in range(columns):
                    F[row + r, i] = 0.0
            F[row, 6 + k] = size * links[k, 4]
            F[row, 5 + k] = size * links[k, 3]
            F[row + 1, 5 + k] = size * links[k, 6]
            if number > 2:
                F[row, 4 + k] = size * links[k, 2]
                F[row + 1, 4 + k] = size * links[k, 5]
                F[row + 2, 4 + k] = size * links[k, 7]
            row += number
    return row


def step_chains(F, size, row, x, dt, decay, chains, links):
    """Apply the chains' part of a step to states, factor and noise rows, starting at ``row``; return the row after them."""
    link_chains(decay, chains, dt, links)
    feed_states(x, 3, links)
    carry_chains(F, 0, size, links)
    return fill_chain_noise(F, row, size, chains, links)
