"""Prediction: Φ and Q of attitude, gyro bias and error states over an increment of the gyro, and Φ P Φᵀ + Q.

The rotation of a step is that of the gyro model with the error states in it; Φ and Q are those of :mod:`strapdown.kernels.filter_step`,
with columns for these states. States that decay or are driven are propagated in chains (:mod:`strapdown.kernels.chains`).
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    combine,
    dot,
    inverse,
    matrix_times_vector,
    multiply,
    scale,
    skew_polynomial,
    symmetric_index,
    symmetric_minus_outer,
    transpose_times_vector,
)
from strapdown.kernels.chains import MEAN, SET, fill_coefficients
from strapdown.kernels.filter_step import process_noise, transition
from strapdown.kernels.layout import (
    AXES,
    CHUNKS,
    DIAGONAL,
    LANES,
    OTHERS,
    PARAMETERS,
    STATES,
    STRUCTURE,
    N,
    W,
    chunk_at,
    element_at,
    entry,
    index_of,
    numbers_of,
    parameter,
    put_at,
    put_chunk,
    put_element,
    stored_row,
    tuple_at,
    value_at,
)
from strapdown.kernels.rotation import rotation_matrix, turned
from strapdown.kernels.structural_zeros import any_number, matrix_products, plus, products, sum_of, times

CHAINED = tuple(k for states, _ in STRUCTURE.chains for k in states)
"""States that decay or are driven."""
SERIES = tuple(1.0 / math.factorial(k) for k in range(16, 1, -1))
"""1/16! to 1/2!."""
NODES = (0.5 - 0.5 * math.sqrt(0.6), 0.5, 0.5 + 0.5 * math.sqrt(0.6))
WEIGHTS = (5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0)
"""Gauss's rule with three nodes."""

CALLED = ("advance", "advance_without_noise", "write_noise", "write_transition", "warm")
"""Called, not inlined, by other kernels: each copy would be compiled again. numba compiles them, so that what must be traced is a function
of its own (``…_formula``)."""

NO_NOISE = ((0,) * 6, (0,) * 9, 0, (None,) * N)
"""That of a step without process noise, in the form of :func:`step_noise`."""


def propagate(body, i, part, dt, like):
    """Propagate state i; a bias driven by temperature changes before and after by half the change of temperature."""
    if dt != body.dt[0]:
        fill_coefficients(body.coefficients, dt, body.model)
        body.dt[0] = dt
    if STRUCTURE.slopes:
        warm(body.x[i], body.P[i], 0.5 * dt * body.warming_now[0])
    advance(body.x[i], body.P[i], part, dt, body.model, body.coefficients, like)
    if STRUCTURE.slopes:
        warm(body.x[i], body.P[i], 0.5 * dt * body.warming_now[0])


def warm(x, P, change):
    """Change the gyro bias of one run by its slopes over temperature, ``b + c ΔT``."""
    for i in range(3):
        bias, slope = 3 + i, STRUCTURE.slopes + i
        x[1 + bias] += change * x[1 + slope]
        for j in range(N):
            P[W * bias + j] += change * P[W * slope + j]
        for j in range(N):
            P[W * j + bias] += change * P[W * j + slope]


def advance(x, P, delta, dt, model, coefficients, like):
    """Propagate over an increment; the coefficients are those of dt."""
    advance_formula(x, P, delta, dt, model, coefficients, like)


def advance_without_noise(x, P, delta, dt, model, coefficients, like):
    """Propagate without process noise."""
    advance_without_noise_formula(x, P, delta, dt, model, coefficients, like)


def write_noise(x, Q, delta, dt, model, coefficients, like):
    """Write the process noise over an increment; the coefficients are those of dt."""
    noise_formula(x, Q, delta, dt, model, coefficients, like)


def write_transition(x, delta, dt, model, coefficients, top, like):
    """Write the rows of the attitude of Φ over an increment to ``top`` (3 W)."""
    transition_formula(x, delta, dt, model, coefficients, top, like)


def advance_state(x, delta, dt, model, coefficients, like):
    """Propagate the state only."""
    phi, _, _ = rotation_of_step(x, delta, dt, model, coefficients, like)
    for i, y in enumerate(turned(tuple_at(x, 0, 4, like), phi)):
        put_at(x, i, y)
    apply_chains(x, 1, coefficients, like)


# ----------------------------------------------------------------------------------------------------- effects of the gyro over a step


def rotation_of_step(x, delta, dt, model, coefficients, like):
    """Return the rotation φ of a step, (I + M)⁻¹ or None, and the specific force in body axes or None.

    With M = Σ c T the rotation is ``φ = (I + M)⁻¹ (Δθ − b dt − Σ e ∫c dt − Σ c G f dt)``. The specific force is that at the middle of the
    step.
    """
    numbers = model.numbers
    r = combine(1.0, delta, -dt, tuple_at(x, 4, 3, like))
    force = None
    if any(any_number(g.force) for g in STRUCTURE.gyro):
        middle = turned(tuple_at(x, 0, 4, like), scale(0.5, r))
        force = transpose_times_vector(rotation_matrix(middle), model.force_f)
    M = (0,) * 9
    scaled = any(any_number(g.scale) for g in STRUCTURE.gyro)
    for g in STRUCTURE.gyro:
        c = value_at(x, 1 + g.state, like)
        if any_number(g.offset):
            mean = parameter(coefficients, SET * g.decay + MEAN) if g.decay >= 0 else dt
            e = numbers_of(g.offset, numbers)
            r = tuple(plus(s, times(-(mean * c), t)) for s, t in zip(r, e, strict=True))
        if any_number(g.force):
            f = matrix_products(numbers_of(g.force, numbers), force)
            r = tuple(plus(s, times(-(dt * c), t)) for s, t in zip(r, f, strict=True))
        if any_number(g.scale):
            M = sum_of(M, tuple(times(c, t) for t in numbers_of(g.scale, numbers)))
    if not scaled:
        return r, None, force
    D = inverse(tuple(plus(like + 1.0 if i in DIAGONAL else 0, m) for i, m in enumerate(M)))
    return matrix_times_vector(D, r), D, force


def response(rate, u, decay):
    """Return ``∫₀ᵘ exp(−[ω](u − s)) e^{−λs} ds``, the effect of a decaying rate error on the attitude over u, and ``∫₀ᵘ e^{−λs} ds``.

    With ``φ_k = Σ (−λu)^i/(i + k)!`` and y = −ω²u² the first is ``u φ₁ − u² (φ₂ + φ₄ y + …) [ω] + u³ (φ₃ + φ₅ y + …) [ω]²``, accurate to
    rounding for |ω| u ≤ 1/3 and λ u ≤ 1/2.
    """
    z = -decay * u
    y = -u * u * dot(rate, rate)
    phi = SERIES[0]
    linear = quadratic = 0.0
    for k in (1, 3, 5, 7, 9, 11, 13):
        phi = SERIES[k] + z * phi
        quadratic = phi + y * quadratic
        phi = SERIES[k + 1] + z * phi
        linear = phi + y * linear
    mean = u * (1.0 + z * phi)
    return skew_polynomial(mean, -u * u * linear, u * u * u * quadratic, rate), mean


def transition_blocks(phi, D, force, dt, model):
    """Return Φ11, Φ12, and by state the effects of those that enter the gyro: on the rate, if constant over a step, or on the attitude.

    The column of Φ of a state is Φ12 times its effect on the rate, or its effect on the attitude.
    """
    phi11, phi12 = transition(phi, dt)
    if D is not None:
        phi12 = multiply(phi12, D)
    numbers = model.numbers
    rate = scale(1.0 / dt, phi)
    rate_effects, attitude_effects = [], []
    responses = {}
    for g in STRUCTURE.gyro:
        effect = (0, 0, 0)
        if any_number(g.offset):
            e = numbers_of(g.offset, numbers)
            if g.decay < 0:
                effect = e
            else:
                if g.decay not in responses:
                    E, _ = response(rate, dt, rate_and_density(model, g.decay)[0])
                    responses[g.decay] = E if D is None else multiply(E, D)
                attitude_effects.append(
                    (g.state, tuple(times(-1.0, t) for t in matrix_products(responses[g.decay], e)))
                )
        if any_number(g.scale):
            effect = sum_of(effect, matrix_products(numbers_of(g.scale, numbers), rate))
        if any_number(g.force):
            effect = sum_of(effect, matrix_products(numbers_of(g.force, numbers), force))
        if any_number(effect):
            rate_effects.append((g.state, effect))
    return phi11, phi12, tuple(rate_effects), tuple(attitude_effects)


def driven_noise(q11, rate, D, dt, model, like):
    """Return Q_θθ with the part of the gyro offsets that are driven by white noise, and the columns Q_θk by state, None of others.

    By Gauss's rule with three nodes.
    """
    cross_noise = [None] * N
    nodes = {}
    for g in STRUCTURE.gyro:
        if g.decay >= 0:
            decay, density = rate_and_density(model, g.decay)
            if g.decay not in nodes:
                nodes[g.decay] = tuple(response(rate, dt * (1.0 - node), decay) for node in NODES)
            e = numbers_of(g.offset, model.numbers)
            column = (like, like, like)
            for (E, mean), weight in zip(nodes[g.decay], WEIGHTS, strict=True):
                q = (weight * dt) * density
                # The response of the attitude is −E e, that of the state 1 − λ ∫e^{−λs} ds.
                t = matrix_products(E if D is None else multiply(E, D), e)
                column = combine(1.0, column, -(q * (1.0 - decay * mean)), t)
                q11 = symmetric_minus_outer(q11, scale(-q, t), t)
            cross_noise[g.state] = column
    return q11, tuple(cross_noise)


def step_noise(phi, D, dt, model, like):
    """Return Q of a step: Q_θθ, Q_θb, the diagonal of Q_bb, and the columns Q_θk of the other states; without that of the chains."""
    q11, q12, q22 = process_noise(phi, dt, *gyro_variances(model))
    q11, cross_noise = driven_noise(q11, scale(1.0 / dt, phi), D, dt, model, like)
    return q11, q12 if D is None else multiply(q12, D), q22, cross_noise


def gyro_variances(model):
    """Return σ_v² and σ_u²."""
    if PARAMETERS:
        return parameter(model.angle_variance, 0), parameter(model.rate_variance, 0)
    return model.angle_variance, model.rate_variance


# ----------------------------------------------------------------------------------------------------------------- formulas of a prediction


def advance_formula(x, P, delta, dt, model, coefficients, like):
    """Propagate state and covariance over an increment at constant rate."""
    rotation = rotation_of_step(x, delta, dt, model, coefficients, like)
    noise = step_noise(rotation[0], rotation[1], dt, model, like)
    propagate_with(x, P, rotation, noise, dt, model, coefficients, like)


def advance_without_noise_formula(x, P, delta, dt, model, coefficients, like):
    """Propagate state and covariance without process noise."""
    rotation = rotation_of_step(x, delta, dt, model, coefficients, like)
    propagate_with(x, P, rotation, NO_NOISE, dt, model, coefficients, like)


def noise_formula(x, Q, delta, dt, model, coefficients, like):
    """Write the process noise over an increment to a matrix whose other elements are zero."""
    phi, D, _ = rotation_of_step(x, delta, dt, model, coefficients, like)
    q11, q12, q22, cross_noise = step_noise(phi, D, dt, model, like)
    for a in AXES:
        for d in AXES[a:]:
            put_element(Q, a, d, q11[symmetric_index(a, d)])
        for j in AXES:
            put_element(Q, a, 3 + j, q12[3 * a + j])
        put_element(Q, 3 + a, 3 + a, q22)
    for states, g in STRUCTURE.chains:
        for i, k in enumerate(states):
            for a in AXES if cross_noise[k] is not None else ():
                put_element(Q, a, k, cross_noise[k][a])
            for d, j in enumerate(states[i:]):
                put_element(Q, k, j, chain_noise(coefficients, g, len(states), i, i + d))


def transition_formula(x, delta, dt, model, coefficients, top, like):
    """Write the rows of the attitude of Φ."""
    phi, D, force = rotation_of_step(x, delta, dt, model, coefficients, like)
    phi11, phi12, rate_effects, attitude_effects = transition_blocks(phi, D, force, dt, model)
    for a in AXES:
        for j in AXES:
            put_at(top, W * a + j, phi11[3 * a + j])
            put_at(top, W * a + 3 + j, phi12[3 * a + j])
        for k in STATES[6:]:
            put_at(top, W * a + k, like)
        for k, e in rate_effects:
            put_at(top, W * a + k, like + products(phi12[3 * a : 3 * a + 3], e))
        for k, e in attitude_effects:
            put_at(top, W * a + k, value_at(top, W * a + k, like) + e[a])


def propagate_with(x, P, rotation, noise, dt, model, coefficients, like):
    """Propagate state and covariance, given the rotation of the step (:func:`rotation_of_step`) and its noise (:func:`step_noise`)."""
    (phi, D, force), (q11, q12, q22, cross_noise) = rotation, noise
    phi11, phi12, rate_effects, attitude_effects = blocks = transition_blocks(phi, D, force, dt, model)
    for i, y in enumerate(turned(tuple_at(x, 0, 4, like), phi)):
        put_at(x, i, y)
    # Only the rows of the attitude differ between P and Φ P, and those of chains; the same for columns and Φᵀ.
    top = tuple(stored_row(row, P, W * a) for a, row in enumerate(propagated_attitude_rows(P, blocks, like)))
    for a, t in enumerate([tuple(entry(top[a], P, W * a, j) for j in STATES) for a in AXES]):
        in_rate, in_attitude = tuple(t[k] for k, _ in rate_effects), tuple(t[k] for k, _ in attitude_effects)
        rate = tuple(plus(t[3 + i], products(in_rate, tuple(e[i] for _, e in rate_effects))) for i in AXES)
        for d in AXES[a:]:
            s = products(t[:3], phi11[3 * d : 3 * d + 3])
            s = s + products(rate, phi12[3 * d : 3 * d + 3])
            s = plus(s, products(in_attitude, tuple(e[d] for _, e in attitude_effects)))
            put_element(P, a, d, plus(s, q11[symmetric_index(a, d)]))
        for j in OTHERS:
            if j not in CHAINED:
                if j < 6:
                    put_element(P, a, j, plus(t[j], q12[3 * a + j - 3]))
                else:
                    put_at(P, index_of(j, a), t[j])  # of one run, the row is written already
    for j in (3, 4, 5):
        put_element(P, j, j, plus(element_at(P, j, j, like), q22))
    apply_chains(x, 1, coefficients, like)
    propagate_chains(P, top, noise is not NO_NOISE, cross_noise, coefficients, like)


def propagated_attitude_rows(P, blocks, like):
    """Return the first three rows of Φ P, of the attitude, in chunks."""
    phi11, phi12, rate_effects, attitude_effects = blocks
    rows = []
    for c in CHUNKS:
        attitude = tuple(chunk_at(P, j, c, like) for j in AXES)
        in_rate = tuple(chunk_at(P, k, c, like) for k, _ in rate_effects)
        rate = tuple(
            plus(chunk_at(P, 3 + i, c, like), products(tuple(e[i] for _, e in rate_effects), in_rate)) for i in AXES
        )
        in_attitude = tuple(chunk_at(P, k, c, like) for k, _ in attitude_effects)
        rows.append(
            tuple(
                plus(
                    products((*phi11[3 * a : 3 * a + 3], *phi12[3 * a : 3 * a + 3]), (*attitude, *rate)),
                    products(tuple(e[a] for _, e in attitude_effects), in_attitude),
                )
                for a in AXES
            )
        )
    return tuple(zip(*rows, strict=True))


# -------------------------------------------------------------------------------------------------------- states that decay or are driven


def propagate_chains(P, top, noisy, cross_noise, coefficients, like):
    """Propagate the covariance of the states that decay or are driven; ``top``: rows of the attitude, with these states before the step."""
    half = {}  # chunks of Φ P in the rows of these states
    for states, g in STRUCTURE.chains:
        F = chain_matrix(coefficients, g, len(states))
        for first in CHUNKS if LANES == 1 else OTHERS:
            old = tuple(chunk_at(P, k, first, like) for k in states)
            for k, row in zip(states, F, strict=True):
                half[k, first] = products(row, old)
        for k in states:
            for first in CHUNKS if LANES == 1 else OTHERS:
                if first not in CHAINED or LANES == 1:
                    put_chunk(P, k, first, half[k, first])
    for states, g in STRUCTURE.chains:
        F = chain_matrix(coefficients, g, len(states))
        for k, row in zip(states, F, strict=True):
            for a in AXES:
                s = products(row, tuple(entry(top[a], P, W * a, j) for j in states))
                put_element(P, a, k, s if cross_noise[k] is None else s + cross_noise[k][a])
            for j in OTHERS if LANES == 1 else ():
                if j not in CHAINED:
                    put_element(P, k, j, element_at(P, k, j, like))
    for m, (states, _) in enumerate(STRUCTURE.chains):
        for others, g in STRUCTURE.chains[m:]:
            F = chain_matrix(coefficients, g, len(others))
            for i, k in enumerate(states):
                old = tuple(element_at(P, k, j, like) if LANES == 1 else half[k, j] for j in others)
                for row, j in zip(F, others, strict=True):
                    if j >= k:
                        t = products(row, old)
                        if noisy and states == others:
                            t = t + chain_noise(coefficients, g, len(states), i, others.index(j))
                        put_element(P, k, j, t)


def apply_chains(array, first, coefficients, like):
    """Apply Φ of the states that decay or are driven to neighbouring numbers, one per state of the error."""
    for states, g in STRUCTURE.chains:
        F = chain_matrix(coefficients, g, len(states))
        old = tuple(value_at(array, first + k, like) for k in states)
        for k, row in zip(states, F, strict=True):
            put_at(array, first + k, products(row, old))


def apply_transition(error, top, coefficients, like):
    """Replace an error (n,) by Φ times it; ``top``: the rows of the attitude of Φ."""
    old = tuple_at(error, 0, N, like)
    for a in AXES:
        put_at(error, a, products(old, tuple_at(top, W * a, N, like)))
    apply_chains(error, 0, coefficients, like)


def chain_matrix(coefficients, g, size):
    """Return Φ of a chain by rows."""
    first = 3 - size
    return tuple(
        tuple(parameter(coefficients, SET * g + symmetric_index(i, j)) if j >= i else 0 for j in range(first, 3))
        for i in range(first, 3)
    )


def chain_noise(coefficients, g, size, i, d):
    """Return Q[i, d] of a chain."""
    return parameter(coefficients, SET * g + 6 + symmetric_index(i + 3 - size, d + 3 - size))


def rate_and_density(model, g):
    """Return λ and the PSD of the driving noise of the last state of chain g."""
    k = model.last[g]
    return parameter(model.decay, k), parameter(model.chains, 2 * k + 1) if PARAMETERS else model.chains[k, 1]
