"""Optional states in chains, each fed by the next: what shapes the white noise of a chain's last state by any real poles.

``ċₖ = −λₖ cₖ + gₖ cₖ₊₁``, the last one of a chain driven by white noise of PSD q besides: ``decay`` λ, and ``chains`` (states, 3) with g
and q; the last column is what :func:`strapdown.kernels.error_state_step.turn_values` wants. Chains have up to :data:`CHAIN` states and do
not enter the gyro. :mod:`strapdown.kernels.error_state_step` lets each state decay by itself; what is here comes after it, as
``Φ = (I + U) diag(e^{−λ dt})`` with U strictly upper triangular. Triangular factors stay triangular, and where there is no chain nothing is
called.

Plain arithmetic on arrays, for both faces.
"""

from __future__ import annotations

import math

import numpy as np

from strapdown.kernels.lane_values import WIDTH, load, spread, total

CALLED = ("chain_step", "step_chains", "carry_chains_back")
"""Not inlined where other kernels use them: their work is far more than a call, and each copy would be compiled anew."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(WIDTH)
CHAIN = 3
"""Most states of a chain."""
TERMS = 14
"""Of the series of a chain's transition: to rounding for λ dt ≤ 1/2."""
NODES = np.concatenate([0.5 * (1.0 + _NODES), 0.5 * _WEIGHTS])
"""Nodes and weights of Gauss's rule of eight on [0, 1], a lane a node."""
LINKS = 8
"""Width of the scratch that a step's shares and root of noise are kept in."""


def chain_start(chains, k):
    """Return the first state of the chain that state k ends or belongs to."""
    first = k
    while first > 0 and chains[first - 1, 0] != 0.0:
        first -= 1
    return first


def chain_step(decay, chains, k, first, dt):
    """Return what state k of a chain makes in dt of the states k − 2, k − 1 and k, and a root of what unit white noise on it makes of them.

    First its column of Φ, (φ_{k−2}, φ_{k−1}, φ_k), by the series of the exponential of the chain's matrix: equal poles, and those at zero,
    are no special case. Then N with ``Q = Nᵀ N`` as (n20, n21, n22, n10, n11, n00), by rows from that of state k up, what is not there 0:
    the same series at the nodes of Gauss's rule, exact to 3e-14 for λ dt ≤ 1/2.
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
    q22, q12, q11 = total(c * C), total(c * B), total(b * B)
    q02, q01, q00 = total(c * A), total(b * A), total(a * A)
    n22 = math.sqrt(q22)
    n21, n20 = q12 / n22, q02 / n22
    n11 = n10 = n00 = 0.0
    if k - 1 >= first:
        n11 = math.sqrt(q11 - n21 * n21)
        n10 = (q01 - n20 * n21) / n11
    if k - 2 >= first:
        n00 = math.sqrt(q00 - n20 * n20 - n10 * n10)
    return af, bf, cf, n20, n21, n22, n10, n11, n00


def alike(decay, chains, k, number):
    """Return whether the so many states up to k are a chain of the same numbers as the chain of so many before them."""
    begin = k - 2 * number + 1
    if begin < 0 or chains[k - number, 0] != 0.0 or (begin > 0 and chains[begin - 1, 0] != 0.0):
        return False
    same = True
    for i in range(k - number + 1, k + 1):
        same = same and decay[i] == decay[i - number] and chains[i, 0] == chains[i - number, 0]
    return same


def link_chains(decay, chains, dt, links):
    """Write for each state U's share of the next and of the next but one, and the root of its unit white noise, to ``links``."""
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
                far, near, own, n20, n21, n22, n10, n11, n00 = chain_step(decay, chains, k, first, dt)
                links[k - 1, 0] = near / own
                if number > 2:
                    links[k - 2, 1] = far / own
                links[k, 2], links[k, 3], links[k, 4] = n20, n21, n22
                links[k, 5], links[k, 6], links[k, 7] = n10, n11, n00


def feed_states(values, first, links):
    """Let each state that has decayed be fed; states stand in ``values`` from ``first`` on."""
    for k in range(len(links)):
        if links[k, 0] != 0.0:
            values[first + k] += links[k, 0] * values[first + k + 1]
            if links[k, 1] != 0.0:
                values[first + k] += links[k, 1] * values[first + k + 2]


def carry_chains(F, first, end, links):
    """Let the columns of rows of F be fed likewise: ``S ← (I + U) S``."""
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
    """Write the rows of noise of driven chains from a row of F on; ``error_state_step.fill_noise`` writes those before."""
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
    """Take states, factor and rows of noise, which go on at ``row``, over a chain's part of a step; return the row after them."""
    link_chains(decay, chains, dt, links)
    feed_states(x, 3, links)
    carry_chains(F, 0, size, links)
    return fill_chain_noise(F, row, size, chains, links)
