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

from strapdown.kernels.augmented_chain import carry_chains_back, step_chains
from strapdown.kernels.augmented_factor import covariances, triangularise, variances
from strapdown.kernels.augmented_step import (
    carry,
    carry_back,
    fill_noise,
    fixed_turn,
    move,
    turn_columns,
    turn_rows,
    turn_values,
)
from strapdown.kernels.rotation import logarithm, quaternion_multiply
from strapdown.kernels.smoother_step import inverse_right_jacobian, moved

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""


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


def prepare_step(
    segments,
    j,
    angle_variance,
    rate_variance,
    decay,
    density,
    changing,
    gyro,
    gyro_use,
    force_f,
    chains,
    links,
    x,
    F,
    noise,
    gain,
    left,
    scratch,
):
    """Prepare what segment j makes of any later knowledge; return the predicted attitude, Φ11, Φ12 and the rows of F in use.

    ``F`` (size + p, size + p) is scratch. ``x`` is left at the predicted values, ``noise`` (p, size) at the rows of noise, ``gain``
    (p, size) at ``Y S⁻⁻¹``, ``left`` (p, size) at ``Z N``, and so are Φ's own numbers in ``scratch``: arrays (states, 3), (states,) and
    one as wide as F.
    """
    size = len(x) + 3
    noisy = 6 + changing
    coupling, factor, work = scratch
    q = load_segment(segments, j, x, F, size)
    dt = segments[j, 0]
    part = (segments[j, 1], segments[j, 2], segments[j, 3])
    predicted, phi11, phi12, rate, D = move(q, x, dt, part, decay, gyro, gyro_use, force_f, coupling, factor)
    carry(F, 0, size, phi11, phi12, coupling, factor, gyro_use, changing)
    rows = fill_noise(F, size, size, dt, rate, D, angle_variance, rate_variance, decay, density, gyro, gyro_use)
    if len(chains) > 0:
        rows = step_chains(F, size, rows, x, dt, decay, chains, links)
    p = rows - size
    for r in range(p):
        for i in range(size):
            noise[r, i] = F[size + r, i]
    for r in range(size + p):
        for i in range(size, size + p):
            F[r, i] = 1.0 if r == i else 0.0
    triangularise(F, noisy, 3, size, rows, size, rows, work)
    for w in range(p):
        for c in range(size):
            total = F[c, size + w]
            for i in range(c):
                total -= gain[w, i] * F[c, i]
            gain[w, c] = total / F[c, c]
    for r in range(p):
        for i in range(size):
            left[r, i] = 0.0
        for w in range(p):
            for i in range(noisy):
                left[r, i] += F[size + r, size + w] * noise[w, i]
    return predicted, phi11, phi12, rows


def step_back(
    segments,
    j,
    predicted,
    phi11,
    phi12,
    rows,
    changing,
    gyro_use,
    chains,
    links,
    x,
    noise,
    gain,
    left,
    scratch,
    later_q,
    later_x,
    later_F,
):
    """Take what is known at the end of segment j, prepared, to its start: ``later_x`` and ``later_F`` in place; return the attitude.

    ``later_F`` (size + p + 1, size) holds the triangle.
    """
    size = len(x) + 3
    noisy = 6 + changing
    p = rows - size
    coupling, factor, work = scratch
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
                total = 0.0
                for i in range(size):
                    total += gain[w, i] * later_F[r, i]
                work[w] = total
            for w in range(p):
                for i in range(noisy):
                    later_F[r, i] -= work[w] * noise[w, i]
    if len(chains) > 0:
        carry_chains_back(later_F, 0, rows + 1, links)
    carry_back(later_F, 0, rows + 1, phi11, phi12, coupling, factor, gyro_use, changing)
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


def smooth_augmented(
    segments,
    starts,
    first,
    upto,
    last,
    angle_variance,
    rate_variance,
    decay,
    density,
    changing,
    gyro,
    gyro_use,
    force_f,
    chains,
    links,
    x,
    F,
    prepared,
    scratch,
    later_q,
    later_x,
    later_F,
    attitude_out,
    x_out,
    variance_out,
    covariance_out,
):
    """Run backward passes: pass p goes from the filtered state at edge ``last[p]`` down and writes edges ``upto[p]`` to ``first[p]``.

    ``segments`` holds the filter's rows, the last one the end state, and ``starts[k]`` is the row that starts at edge k. From pass to pass
    ``last`` does not fall and ``upto`` stays below the next ``first``. ``later_q`` (n, 4), ``later_x`` (n, size − 3) and ``later_F``
    (n, size + p + 1, size) are for n passes at once, which share what is prepared of a segment in ``prepared``, three arrays (p, size). The
    rest is scratch as :func:`prepare_step` wants it.
    """
    size = len(x) + 3
    noise, gain, left = prepared
    together = len(later_q)
    for begin in range(0, len(first), together):
        passes = min(together, len(first) - begin)
        joining = passes - 1
        leaving = passes - 1
        edge = upto[begin + leaving]
        s = starts[last[begin + joining]]
        while True:
            while joining >= 0 and starts[last[begin + joining]] == s:
                q = load_segment(segments, s, later_x[joining], later_F[joining], size)
                later_q[joining, 0], later_q[joining, 1], later_q[joining, 2], later_q[joining, 3] = q
                joining -= 1
            while leaving >= 0 and starts[edge] == s:
                for i in range(4):
                    attitude_out[edge, i] = later_q[leaving, i]
                for i in range(len(x)):
                    x_out[edge, i] = later_x[leaving, i]
                variances(later_F[leaving], size, variance_out, edge)
                if edge < len(covariance_out):
                    covariances(later_F[leaving], size, covariance_out, edge)
                if edge > first[begin + leaving]:
                    edge -= 1
                else:
                    leaving -= 1
                    edge = upto[begin + max(leaving, 0)]
            if leaving < 0:
                break
            s -= 1
            predicted, phi11, phi12, rows = prepare_step(
                segments,
                s,
                angle_variance,
                rate_variance,
                decay,
                density,
                changing,
                gyro,
                gyro_use,
                force_f,
                chains,
                links,
                x,
                F,
                noise,
                gain,
                left,
                scratch,
            )
            for i in range(joining + 1, leaving + 1):
                later_q[i, 0], later_q[i, 1], later_q[i, 2], later_q[i, 3] = step_back(
                    segments,
                    s,
                    predicted,
                    phi11,
                    phi12,
                    rows,
                    changing,
                    gyro_use,
                    chains,
                    links,
                    x,
                    noise,
                    gain,
                    left,
                    scratch,
                    (later_q[i, 0], later_q[i, 1], later_q[i, 2], later_q[i, 3]),
                    later_x[i],
                    later_F[i],
                )
