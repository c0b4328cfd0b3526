"""The smoother with optional states over whole records: backward passes over the segments that the filter stored.

A step back estimates the step's own noise w from what came later and takes it off. With the prediction's own reflections
``[Φ S, Nᵀ] Θ = [S⁻, 0]`` and ``[0, I] Θ = [Y, Z]``, later knowledge of the predicted error δ says ``w = Y S⁻⁻¹ δ`` and leaves w the
covariance ``Z Zᵀ`` (Bierman 1983 does it one noise at a time). So ``δ_before = Φ⁻¹ (δ − Nᵀ w)``, and the covariance is a sum of two
squares: no difference is formed, and what has no noise is not touched. As in :mod:`strapdown.kernels.smoother_step`, the later factor is
carried to the tangent space at the predicted attitude before the step, and the result to that at the smoothed one after it; so are
states that go along with the attitude.

What depends on the filter alone, Φ, N, ``Y S⁻⁻¹`` and ``Z N``, is prepared once for all passes that meet a segment (:func:`prepare_step`).
Compiled by :func:`strapdown.kernels.machine.compiled`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.chains import LINKS, carry_chains_back
from strapdown.kernels.error_state_step import (
    carry,
    carry_back,
    fixed_turn,
    move,
    turn_columns,
    turn_rows,
    turn_values,
)
from strapdown.kernels.root_form import step_noise
from strapdown.kernels.rotation import inverse_right_jacobian, logarithm, moved, quaternion_multiply
from strapdown.kernels.triangle import covariances, triangularise, variances

CALLED = ("load_segment",)

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""


class Passes(NamedTuple):
    """Backward passes: pass p goes from the filtered state at edge ``last[p]`` down and writes edges ``upto[p]`` to ``first[p]``."""

    segments: np.ndarray
    """The filter's rows, the last one the end state."""
    starts: np.ndarray
    """Row that starts at each edge."""
    first: np.ndarray
    upto: np.ndarray
    last: np.ndarray
    """From pass to pass ``last`` does not fall and ``upto`` stays below the next ``first``."""


class Workspace(NamedTuple):
    """Scratch of n states, p rows of noise and several passes that go together."""

    links: np.ndarray
    x: np.ndarray
    """(n − 3,), the predicted values of a segment."""
    F: np.ndarray
    """(n + p, n + p)"""
    noise: np.ndarray
    """(p, n): the rows of noise of a segment."""
    gain: np.ndarray
    """(n, p): ``Y S⁻⁻¹``, transposed."""
    left: np.ndarray
    """(p, n): ``Z N``."""
    coupling: np.ndarray
    factor: np.ndarray
    work: np.ndarray
    later_q: np.ndarray
    """Of each pass, what is known at the end of the segment: attitude (4,), x (n − 3,), and the triangle (n + p + 1, n)."""
    later_x: np.ndarray
    later_F: np.ndarray


class Outputs(NamedTuple):
    """Arrays that the passes write, a row an edge."""

    attitude: np.ndarray
    x: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    """(edges, m, m), of the first m states, or (0, m, m)."""


def workspace(states, rows, chained, together):
    """Return room for so many error states, rows of noise and passes at once."""
    size = 6 + states
    prepared = np.empty((2, rows, size))
    return Workspace(
        links=np.empty((chained, LINKS)),
        x=np.empty(size - 3),
        F=np.empty((size + rows, size + rows)),
        noise=prepared[0],
        gain=np.empty((size, rows)),
        left=prepared[1],
        coupling=np.empty((states, 3)),
        factor=np.empty(states),
        work=np.empty(size + rows),
        later_q=np.empty((together, 4)),
        later_x=np.empty((together, size - 3)),
        later_F=np.empty((together, size + rows + 1, size)),
    )


def load_segment(segments, k, x, F, size):
    """Read x and the triangle of row k; return the attitude."""
    place = 8
    for i in range(len(x)):
        x[i] = segments[k, place + i]
    place += len(x)
    for j in range(size):
        for i in range(j + 1):
            F[j, i] = segments[k, place + i]
        for i in range(j + 1, size):
            F[j, i] = 0.0
        place += j + 1
    return (segments[k, 4], segments[k, 5], segments[k, 6], segments[k, 7])


def prepare_step(segments, j, model, space):
    """Prepare what segment j makes of any later knowledge; return the predicted attitude, Φ11, Φ12 and the rows of F in use.

    Leaves ``noise``, ``gain``, ``left`` and ``x`` of the work space, and Φ's own numbers there.
    """
    x, F, noise, gain, left = space.x, space.F, space.noise, space.gain, space.left
    coupling, factor, work = space.coupling, space.factor, space.work
    gyro_use, changing = model.gyro_use, model.changing
    size = len(x) + 3
    noisy = 6 + changing
    q = load_segment(segments, j, x, F, size)
    dt = segments[j, 0]
    part = (segments[j, 1], segments[j, 2], segments[j, 3])
    predicted, phi11, phi12, rate, D = move(
        q, x, dt, part, model.decay, model.gyro, gyro_use, model.force_f, coupling, factor
    )
    carry(F, 0, size, phi11, phi12, coupling, factor, gyro_use, changing)
    rows = step_noise(model, space.links, F, size, dt, rate, D, x)
    p = rows - size
    for r in range(p):
        for i in range(size):
            noise[r, i] = F[size + r, i]
    for r in range(size + p):
        for i in range(size, size + p):
            F[r, i] = 1.0 if r == i else 0.0
    triangularise(F, noisy, 3, size, rows, size, rows, work)
    for c in range(size):
        for w in range(p):
            work[w] = F[c, size + w]
        for i in range(c):
            for w in range(p):
                work[w] -= gain[i, w] * F[c, i]
        for w in range(p):
            gain[c, w] = work[w] / F[c, c]
    for r in range(p):
        for i in range(size):
            left[r, i] = 0.0
        for w in range(p):
            for i in range(noisy):
                left[r, i] += F[size + r, size + w] * noise[w, i]
    return predicted, phi11, phi12, rows


def step_back(segments, j, prepared, model, space, pass_, later_q):
    """Take what a pass knows at the end of segment j, ``prepared`` by :func:`prepare_step`, to its start; return the attitude.

    The pass's ``later_x`` and ``later_F`` are left there.
    """
    predicted, phi11, phi12, rows = prepared
    x, noise, gain, left, work = space.x, space.noise, space.gain, space.left, space.work
    later_x, later_F = space.later_x[pass_], space.later_F[pass_]
    chains, changing = model.chains, model.changing
    size = len(x) + 3
    noisy = 6 + changing
    p = rows - size
    # From the tangent space at the smoothed attitude to that at the predicted one: exp(a) ⊗ exp(ε) = exp(a + J_r(a)⁻¹ ε).
    inverse = (predicted[0], -predicted[1], -predicted[2], -predicted[3])
    a = logarithm(quaternion_multiply(inverse, later_q))
    turn_rows(later_F, size, inverse_right_jacobian(a))
    if len(chains) > 0:
        A = fixed_turn(later_q, predicted)
        turn_values(chains, A, later_x, 3)
        turn_columns(chains, A, later_F, size)
    # The difference itself goes through the step as one row more.
    later_F[rows, 0], later_F[rows, 1], later_F[rows, 2] = a
    for i in range(len(x)):
        later_F[rows, 3 + i] = later_x[i] - x[i]
    for r in range(p):
        for i in range(size):
            later_F[size + r, i] = left[r, i]
    for r in range(rows + 1):
        if r < size or r == rows:
            for w in range(p):
                work[w] = 0.0
            for i in range(size):
                f = later_F[r, i]
                if f != 0.0:
                    for w in range(p):
                        work[w] += gain[i, w] * f
            for w in range(p):
                for i in range(noisy):
                    later_F[r, i] -= work[w] * noise[w, i]
    if len(chains) > 0:
        carry_chains_back(later_F, 0, rows + 1, space.links)
    carry_back(later_F, 0, rows + 1, phi11, phi12, space.coupling, space.factor, model.gyro_use, changing)
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


def smooth_augmented(passes, model, space, out):
    """Run backward passes. As many go together as the work space has room for, and share what is prepared of a segment."""
    segments, starts, first, upto, last = passes
    later_q, later_x, later_F = space.later_q, space.later_x, space.later_F
    size = len(space.x) + 3
    together = len(later_q)
    for begin in range(0, len(first), together):
        number = min(together, len(first) - begin)
        joining = number - 1
        leaving = number - 1
        edge = upto[begin + leaving]
        s = starts[last[begin + joining]]
        while True:
            while joining >= 0 and starts[last[begin + joining]] == s:
                q = load_segment(segments, s, later_x[joining], later_F[joining], size)
                later_q[joining, 0], later_q[joining, 1], later_q[joining, 2], later_q[joining, 3] = q
                joining -= 1
            while leaving >= 0 and starts[edge] == s:
                write_smoothed(out, edge, later_q[leaving], later_x[leaving], later_F[leaving], size)
                if edge > first[begin + leaving]:
                    edge -= 1
                else:
                    leaving -= 1
                    edge = upto[begin + max(leaving, 0)]
            if leaving < 0:
                break
            s -= 1
            prepared = prepare_step(segments, s, model, space)
            for i in range(joining + 1, leaving + 1):
                q = (later_q[i, 0], later_q[i, 1], later_q[i, 2], later_q[i, 3])
                q = step_back(segments, s, prepared, model, space, i, q)
                later_q[i, 0], later_q[i, 1], later_q[i, 2], later_q[i, 3] = q


def write_smoothed(out, edge, q, x, F, size):
    """Write a smoothed state to the row of an edge."""
    for i in range(4):
        out.attitude[edge, i] = q[i]
    for i in range(len(x)):
        out.x[edge, i] = x[i]
    variances(F, size, out.variance, edge)
    if edge < len(out.covariance):
        covariances(F, size, out.covariance, edge)
