"""The smoother with optional error states over whole records: backward passes over the segments that the filter stored.

A step back estimates the process noise w of the step from later measurements and removes it. With the reflections of the prediction,
``[Φ S, Nᵀ] Θ = [S⁻, 0]`` and ``[0, I] Θ = [Y, Z]``, a smoothed error δ of the predicted state gives ``w = Y S⁻⁻¹ δ``, with the remaining
covariance ``Z Zᵀ`` (Bierman 1983 processes one noise at a time). Then ``δ_before = Φ⁻¹ (δ − Nᵀ w)``, and the covariance is a sum of two
squares: no difference is formed, and states without noise are not changed. As in :mod:`strapdown.kernels.smoother_step`, the later factor
is transformed to the tangent space at the predicted attitude before the step, and the result to that at the smoothed attitude after it;
so are states that rotate with the attitude.

Φ, N, ``Y S⁻⁻¹`` and ``Z N`` depend only on the filter (:func:`prepare_step`). Compiled by :func:`strapdown.kernels.machine.compiled`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.chains import LINKS, carry_chains_back, step_chains
from strapdown.kernels.error_state_step import (
    carry,
    carry_back,
    fill_noise,
    fixed_turn,
    move,
    step_noise,
    turn_columns,
    turn_rows,
    turn_values,
)
from strapdown.kernels.lane_values import WIDTH, chosen, fetch, load, spread, store
from strapdown.kernels.root_form import loose, row_end
from strapdown.kernels.rotation import inverse_right_jacobian, logarithm, moved, quaternion_multiply
from strapdown.kernels.triangle import covariances, padded, triangularise, variances

CALLED = ("load_segment",)

_FIRST = np.repeat([1.0, 0.0], WIDTH)


class Workspace(NamedTuple):
    """Work space for n states and p noise rows; columns are :func:`strapdown.kernels.triangle.padded`."""

    links: np.ndarray
    x: np.ndarray
    """(n − 3,): predicted values at the end of a segment."""
    F: np.ndarray
    """(n + p, columns for n and p)"""
    noise: np.ndarray
    """(p, columns for n): noise rows of a segment."""
    gain: np.ndarray
    """(n, columns for p): ``Y S⁻⁻¹``, transposed."""
    left: np.ndarray
    """(p, columns for n): ``Z N``."""
    step: np.ndarray
    """(2, n, 4): Φ and Q of a segment, as in :class:`strapdown.kernels.root_form.Scratch`."""
    factor: np.ndarray
    work: np.ndarray
    later_x: np.ndarray
    """(n − 3,): smoothed values at the end of a segment."""
    later_F: np.ndarray
    """(n + p + 4, columns for n): triangular factor of the smoothed covariance there."""


class Outputs(NamedTuple):
    """Arrays that the passes write, a row an edge."""

    attitude: np.ndarray
    x: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    """(edges, m, m) for the first m states, or (0, m, m)."""


def workspace(states, rows, chained):
    """Return a work space for these numbers of error states, noise rows and states in chains."""
    size = 6 + states
    width = padded(size)
    both = width + padded(rows)
    return Workspace(
        links=np.empty((chained, LINKS)),
        x=np.empty(size - 3),
        F=np.zeros((size + rows, both)),
        noise=np.zeros((rows, width)),
        gain=np.empty((size, both - width)),
        left=np.zeros((rows, width)),
        step=np.zeros((2, size, 4)),
        factor=np.empty(states),
        work=np.zeros(max(both, 4 * (both - width))),
        later_x=np.empty(size - 3),
        later_F=np.zeros((size + rows + 4, width)),
    )


def load_segment(segments, k, x, F, loose):
    """Read x and the factor of row k; return the attitude."""
    place = 8
    for i in range(len(x)):
        x[i] = segments[k, place + i]
    place += len(x) + k * segments.shape[1]
    size = len(x) + 3
    for j in range(size):
        end = row_end(j, loose)
        for c in range(0, size, WIDTH):
            own = spread(0.0)
            if c < end:
                own = chosen(load(_FIRST, max(WIDTH + c - end, 0)) > 0.0, load(segments, place + c), own)
            store(F, F.shape[1] * j + c, own)
        place += end
    return (segments[k, 4], segments[k, 5], segments[k, 6], segments[k, 7])


def prepare_step(segments, j, model, space):
    """Prepare the step back over segment j; return the predicted attitude, Φ11 and the number of rows of F in use.

    Writes ``noise``, ``gain``, ``left``, ``x`` and Φ to the work space.
    """
    x, F, noise, gain, left = space.x, space.F, space.noise, space.gain, space.left
    top, driven, factor, work = space.step[0], space.step[1], space.factor, space.work
    size = len(x) + 3
    noisy = 6 + model.changing
    width, room = noise.shape[1], gain.shape[1]
    q = load_segment(segments, j, x, F, loose(model))
    dt = segments[j, 0]
    part = (segments[j, 1], segments[j, 2], segments[j, 3])
    predicted, phi11, rate, D = move(q, x, dt, part, model, top, factor)
    carry(F, size, loose(model), top, factor, model.changing)
    for k in range(model.changing):
        factor[k] = 1.0 / factor[k]  # as the way back needs it
    step_noise(driven, dt, rate, D, model)
    rows = fill_noise(F, size, driven, noisy)
    if len(model.chains) > 0:
        rows = step_chains(F, size, rows, x, dt, model.decay, model.chains, space.links)
    for r in range(rows):
        for c in range(width, width + room, WIDTH):
            store(F, (width + room) * r + c, spread(0.0))
    for r in range(rows - size):
        F[size + r, width + r] = 1.0
        for c in range(0, width, WIDTH):
            store(noise, width * r + c, load(F, (width + room) * (size + r) + c))
    triangularise(F, noisy, loose(model), size, rows, width, width + room, work)
    for i in range(size):
        for c in range(0, room, WIDTH):
            store(gain, room * i + c, load(F, (width + room) * i + width + c))
    length = segments.shape[1]
    for i in range(size):
        for c in range(WIDTH * i, length, WIDTH * size):  # the row before, needed next, is far from the cache
            fetch(segments, length * (j - 1) + c)
        inverse = 1.0 / F[i, i]
        for c in range(0, room, WIDTH):
            g = load(gain, room * i + c)
            for r in range(i):
                g = g - F[i, r] * load(gain, room * r + c)
            store(gain, room * i + c, inverse * g)
    for r in range(rows - size):
        for c in range(0, noisy, WIDTH):
            z = spread(0.0)
            for w in range(rows - size):
                z = z + F[size + r, width + w] * load(noise, width * w + c)
            store(left, width * r + c, z)
    return predicted, phi11, rows


def remove_noise(F, r, end, gain, noise, number, noisy, work):
    """Remove from four rows of F from r on, with columns to ``end``, the process noise that they determine: ``F ← F − (F gain) noise``."""
    width, room = noise.shape[1], gain.shape[1]
    for c in range(0, room, WIDTH):
        p0 = p1 = p2 = p3 = spread(0.0)
        for i in range(end):  # four rows at once, or each sum would wait for itself
            g = load(gain, room * i + c)
            p0, p1, p2, p3 = p0 + F[r, i] * g, p1 + F[r + 1, i] * g, p2 + F[r + 2, i] * g, p3 + F[r + 3, i] * g
        store(work, c, p0)
        store(work, room + c, p1)
        store(work, 2 * room + c, p2)
        store(work, 3 * room + c, p3)
    place = width * r
    for c in range(0, noisy, WIDTH):
        t0, t1 = load(F, place + c), load(F, place + width + c)
        t2, t3 = load(F, place + 2 * width + c), load(F, place + 3 * width + c)
        for k in range(number):
            n = load(noise, width * k + c)
            t0, t1 = t0 - work[k] * n, t1 - work[room + k] * n
            t2, t3 = t2 - work[2 * room + k] * n, t3 - work[3 * room + k] * n
        store(F, place + c, t0)
        store(F, place + width + c, t1)
        store(F, place + 2 * width + c, t2)
        store(F, place + 3 * width + c, t3)


def step_back(segments, j, model, space, later_q):
    """Propagate the smoothed state (``later_x``, ``later_F``) from the end of segment j back to its start; return the attitude there."""
    predicted, phi11, rows = prepare_step(segments, j, model, space)
    x, noise, gain, left, work = space.x, space.noise, space.gain, space.left, space.work
    later_x, later_F = space.later_x, space.later_F
    chains, changing = model.chains, model.changing
    size = len(x) + 3
    noisy = 6 + changing
    width = noise.shape[1]
    # From the tangent space at the smoothed attitude to that at the predicted one: exp(a) ⊗ exp(ε) = exp(a + J_r(a)⁻¹ ε).
    inverse = (predicted[0], -predicted[1], -predicted[2], -predicted[3])
    a = logarithm(quaternion_multiply(inverse, later_q))
    turn_rows(later_F, size, inverse_right_jacobian(a))
    if len(chains) > 0:
        A = fixed_turn(later_q, predicted)
        turn_values(chains, A, later_x, 3)
        turn_columns(chains, A, later_F, size)
    # The difference of the states is processed as one more row.
    later_F[rows, 0], later_F[rows, 1], later_F[rows, 2] = a
    for i in range(len(x)):
        later_F[rows, 3 + i] = later_x[i] - x[i]
    for r in range(0, size, 4):
        remove_noise(later_F, r, min(row_end(r + 3, loose(model)), size), gain, noise, rows - size, noisy, work)
    remove_noise(later_F, rows, size, gain, noise, rows - size, noisy, work)
    for r in range(rows - size):
        for c in range(0, width, WIDTH):
            store(later_F, width * (size + r) + c, load(left, width * r + c))
    if len(chains) > 0:
        carry_chains_back(later_F, 0, rows + 1, space.links)
    carry_back(later_F, size, rows + 1, phi11, space.step[0], space.factor, changing)
    filtered = (segments[j, 4], segments[j, 5], segments[j, 6], segments[j, 7])
    q, J = moved(filtered, (later_F[rows, 0], later_F[rows, 1], later_F[rows, 2]))
    for i in range(len(x)):
        later_x[i] = segments[j, 8 + i] + later_F[rows, 3 + i]
    turn_rows(later_F, rows, J)
    if len(chains) > 0:
        A = fixed_turn(filtered, q)
        turn_values(chains, A, later_x, 3)
        turn_columns(chains, A, later_F, rows)
    triangularise(later_F, noisy, noisy, size, rows, 0, 0, work)
    return q


def smooth_augmented(segments, starts, first, model, space, out):
    """Go back from the filtered state at the last edge to edge ``first``, and write all between.

    Parameters
    ----------
    segments : array (rows, 5 + n + numbers of the factor)
        The filter's rows, the last one the end state.
    starts : array (edges,)
        Row that starts at each edge.
    first : int
    model : strapdown.kernels.root_form.Model
    space : Workspace
    out : Outputs
    """
    size = len(space.x) + 3
    edge = len(starts) - 1
    s = starts[edge]
    q = load_segment(segments, s, space.later_x, space.later_F, loose(model))
    while True:
        while edge >= first and starts[edge] == s:
            write_smoothed(out, edge, q, space.later_x, space.later_F, size, space.work)
            edge -= 1
        if edge < first:
            break
        s -= 1
        q = step_back(segments, s, model, space, q)


def write_smoothed(out, edge, q, x, F, size, work):
    """Write a smoothed state to the row of an edge."""
    for i in range(4):
        out.attitude[edge, i] = q[i]
    for i in range(len(x)):
        out.x[edge, i] = x[i]
    variances(F, size, out.variance, edge, work)
    if edge < len(out.covariance):
        covariances(F, size, out.covariance, edge, work)
