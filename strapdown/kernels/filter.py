"""The multiplicative EKF of N error states: a body of :mod:`strapdown.kernels.walk`.

Size and structure of the model are known while compiling: :func:`strapdown.kernels.machine.instance` makes a copy of this module for each
:class:`strapdown.kernels.structure.Structure` and number of lanes. A zero of the model is a Python 0 while a formula is traced, and costs
nothing.

State: ``x`` = (q, b, c): attitude, gyro bias and error states; ``P`` the covariance of the errors (δθ, δb, δc), the attitude's on the body
side, ``q_true = q ⊗ exp(δθ)``. Both are in arrays between the functions in ``CALLED``, so that none needs more than a few dozen numbers at
once. P has two layouts, which differ in the functions under *layout* only:

- one run: a value is eight columns of a row; P is stored in full, its rows padded to :data:`WIDTH_OF_ROW`;
- several runs, one per lane: a value is one element of P of all runs; the upper triangle is stored by rows.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    combine,
    congruent,
    cross,
    dot,
    matrix_times_vector,
    multiply,
    scale,
    skew_polynomial,
    square_root,
    subtract,
    symmetric_minus_outer,
    symmetric_times_vector,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.chains import chain_start, chain_step
from strapdown.kernels.filter_step import process_noise, transition, turned_by
from strapdown.kernels.gate_rules import (
    FIRST_BIAS,
    count_widening,
    may_widen,
    reset_candidate,
    restart_attitude,
    restart_width,
    start_undone,
)
from strapdown.kernels.iterated_update import ACCEPTED, PASSED_OVER, REFUSED, arc_over_chord, robust_weight, seen_from
from strapdown.kernels.lane_angles import arctangent, rotation_vector
from strapdown.kernels.lane_values import any_lane, lanes_of, load_like, select, store, with_lane
from strapdown.kernels.measurement import (
    ATTITUDE,
    DIRECTION,
    HEADING,
    VECTOR,
    VERTICAL,
    degrees_of_freedom,
    frame_of,
    six_at,
    value_of,
    vector_at,
)
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix, turned
from strapdown.kernels.series import SQUARED_RANGE
from strapdown.kernels.structure import MAX_PRECISION, SIX_STATES, Effects, Gains, Measured, Progress, Structure
from strapdown.kernels.walk import step_within, turn_squared

STRUCTURE: Structure = globals().get("STRUCTURE", SIX_STATES)
"""Structure of the model, given by :func:`strapdown.kernels.machine.instance`."""
LANES: int = globals().get("LANES", 1)
"""Number of runs in a value, likewise."""
PARAMETERS: bool = globals().get("PARAMETERS", False)
"""Whether the runs differ in noise and error states, instead of gyro and measurements: numbers of the model are lanes."""

N = STRUCTURE.n
STATES = tuple(range(N))
OTHERS = STATES[3:]
CHAINED = tuple(k for states, _ in STRUCTURE.chains for k in states)
ROTATED = (0, 1, 2, *tuple(k for v in STRUCTURE.vectors for k in v))
"""States that a correction of the attitude rotates."""
PLAIN = tuple(k for k in STATES if k not in ROTATED)
WIDTH_OF_ROW = N + 7 - (N + 7) % 8
W = WIDTH_OF_ROW
PARTS = tuple(range(0, W, 8)) if LANES == 1 else STATES
"""First column of each value of a row."""
BLOCKS = tuple(PLAIN[i : i + 4] for i in range(0, len(PLAIN), 4)) if LANES > 1 else (PARTS,)
"""Values of a row that are computed together, for all rows: four columns, whose gains stay in registers."""
EIGHT = (0.0,) * 8
AXES = (0, 1, 2)
NINE = (0, 1, 2, 3, 4, 5, 6, 7, 8)
DIAGONAL = (0, 4, 8)
SIZE_OF_P = N * W if LANES == 1 else N * (N + 1) // 2 * LANES

SET = 16
"""Numbers of a set of coefficients: Φ and Q (6 each, upper triangle by rows) of a chain of up to three states, and ∫ e^{−λs} ds."""
MEAN = 12

# Lines of the work space, each of LINE values.
LINE = W + 8
FACTORS, GAINS, ROWS = 0, 3, 6
"""Products P h of the rows of a measurement; the same given the rows before, over the roots of their innovation variances; the rows h."""
PRODUCT, STEP, ROUNDING, PRIOR, NOW_X, PRIOR_ROWS = 9, 10, 11, 12, 13, 14
"""P h of one row; a correction; the rounding error of P h; prior mean relative to a point of linearisation, the state there, and the rows
there in the tangent space of the prior."""
LINES = 17
RESIDUAL, VARIANCE = N, N + 1
"""Places in a line of the rows, after h."""

SHORT_FORM = 100.0
"""Maximum ratio of innovation variance to measurement variance for the short form of the update, which then loses at most two digits."""
JOSEPH_FORM = 1e8
"""Maximum ratio for Joseph's form, whose rounding is up to 2e-8 of the measurement's variance at this ratio."""
SERIES = tuple(1.0 / math.factorial(k) for k in range(16, 1, -1))
"""1/16! to 1/2!."""
NODES = (0.5 - 0.5 * math.sqrt(0.6), 0.5, 0.5 + 0.5 * math.sqrt(0.6))
WEIGHTS = (5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0)
"""Gauss's rule with three nodes."""

CALLED = (
    "advance",
    "transform",
    "write_noise",
    "write_transition",
    "take_precisely",
    "take_row",
    "inner_product",
    "fill_coefficients",
    "warm",
    *(f"write_{s}" for s in range(len(STRUCTURE.sensors))),
)
"""Called, not inlined, by other kernels: each copy would be compiled again. numba compiles them, so that what must be traced is a function
of its own (``…_formula``). An update is inlined: the sixty numbers of its arguments cost a tenth of its time, and no kernel has two
copies."""


# ------------------------------------------------------------------------------------------------------------------ sums without zeros


def is_zero(x):
    """Return whether x is a Python 0 while tracing."""
    return isinstance(x, int) and x == 0


def number(entry, numbers):
    """Return the number of an entry of the structure."""
    return entry if isinstance(entry, int) else parameter(numbers, entry[0])


def numbers_of(entries, numbers):
    """Return the numbers of entries."""
    return tuple(number(entry, numbers) for entry in entries)


def plus(a, b):
    """Return a + b; zeros vanish."""
    return b if is_zero(a) else a if is_zero(b) else a + b


def times(a, b):
    """Return a b; zeros and ones vanish."""
    if is_zero(a) or is_zero(b):
        return 0
    return b if isinstance(a, int) else a if isinstance(b, int) else a * b


def products(a, b):
    """Return Σ aᵢ bᵢ; zeros vanish."""
    s = 0
    for x, y in zip(a, b, strict=True):
        s = plus(s, times(x, y))
    return s


def sum_of(a, b):
    """Return a + b of two tuples; zeros vanish."""
    return tuple(plus(x, y) for x, y in zip(a, b, strict=True))


def matrix_products(A, v):
    """Return A v of a matrix (9) and a vector; zeros vanish."""
    return tuple(products(A[3 * i : 3 * i + 3], v) for i in AXES)


def any_number(entries):
    """Return whether an entry is not zero."""
    return any(not is_zero(entry) for entry in entries)


# -------------------------------------------------------------------------------------------------------------------------------- layout


def value_at(array, i, like):
    """Return value i of an array of lanes."""
    return array[i] if LANES == 1 else load_like(array, i * LANES, like)


def put_at(array, i, value):
    """Write value i of an array of lanes."""
    if LANES == 1:
        array[i] = value
    else:
        store(array, i * LANES, value)


def parameter(array, i):
    """Return number i of the model."""
    return load_like(array, i * LANES, lanes_of((0.0,) * LANES)) if PARAMETERS else array[i]


def gyro_variances(model):
    """Return σ_v² and σ_u²."""
    if PARAMETERS:
        return parameter(model.angle_variance, 0), parameter(model.rate_variance, 0)
    return model.angle_variance, model.rate_variance


def rate_and_density(model, g):
    """Return λ and the PSD of the driving noise of the last state of chain g."""
    k = model.last[g]
    return parameter(model.decay, k), parameter(model.chains, 2 * k + 1) if PARAMETERS else model.chains[k, 1]


def place(i, j):
    """Return the place of P[i, j]."""
    if LANES == 1:
        return W * i + j
    a, b = min(i, j), max(i, j)
    return a * N - a * (a - 1) // 2 + b - a


def element_at(P, i, j, like):
    """Return P[i, j]."""
    return value_at(P, place(i, j), like)


def put_element(P, i, j, value):
    """Write P[i, j] and P[j, i]."""
    put_at(P, place(i, j), value)
    if LANES == 1 and i != j:
        put_at(P, place(j, i), value)


def part(P, i, c, like):
    """Return the value of row i from column c on."""
    return load_like(P, W * i + c, lanes_of(EIGHT)) if LANES == 1 else element_at(P, i, c, like)


def put_part(P, i, c, value):
    """Write the value of row i from column c on."""
    if LANES == 1:
        store(P, W * i + c, value)
    else:
        put_at(P, place(i, c), value)


def with_entries(t, c, entries):
    """Return the value of a row of one run from column c on with other entries, given by column and number."""
    for j, number in entries:
        if c <= j < c + 8:
            t = with_lane(t, j - c, number)
    return t


def kept(parts, work, line):
    """Return a row, given by parts, for :func:`entry`; if a part has several entries, it is written to a line of the work space."""
    for c, value in zip(PARTS, parts, strict=True) if LANES == 1 else ():
        store(work, line + c, value)
    return parts


def entry(row, work, line, j):
    """Return entry j of a row; read where it is needed, so that no register holds it until then."""
    return work[line + j] if LANES == 1 else row[j]


def tuple_at(array, first, count, like):
    """Return neighbouring values of an array of lanes."""
    return tuple(value_at(array, first + i, like) for i in range(count))


# ------------------------------------------------------------------------------------------------------------------------ prediction


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
            (a, b, c), Q = chain_step(decay, chains, j, first, dt)
            row = 2 - (k - j)
            if row == 2:
                coefficients[here + 2], coefficients[here + 4], coefficients[here + 5] = a, b, c
            if row == 1:
                coefficients[here + 1], coefficients[here + 3] = b, c
            if row == 0:
                coefficients[here] = c
            # Each state of a chain may be driven; its noise reaches the states before it.
            q = chains[j, 1]
            if q != 0.0:
                if row == 2:
                    coefficients[here + 6] += q * Q[0]
                    coefficients[here + 7] += q * Q[1]
                    coefficients[here + 8] += q * Q[2]
                    coefficients[here + 9] += q * Q[3]
                    coefficients[here + 10] += q * Q[4]
                    coefficients[here + 11] += q * Q[5]
                if row == 1:
                    coefficients[here + 6] += q * Q[3]
                    coefficients[here + 7] += q * Q[4]
                    coefficients[here + 9] += q * Q[5]
                if row == 0:
                    coefficients[here + 6] += q * Q[5]
        rate = decay[k]
        coefficients[here + MEAN] = -math.expm1(-rate * dt) / rate if rate > 0.0 else dt


def place_6(i, j):
    """Return the place of an element in a 6-tuple."""
    return (0, 1, 2, 1, 3, 4, 2, 4, 5)[3 * i + j]


def chain_matrix(coefficients, g, size):
    """Return Φ of a chain by rows."""
    first = 3 - size
    return tuple(
        tuple(parameter(coefficients, SET * g + place_6(i, j)) if j >= i else 0 for j in range(first, 3))
        for i in range(first, 3)
    )


def chain_noise(coefficients, g, size, i, d):
    """Return an element of Q of a chain."""
    return parameter(coefficients, SET * g + 6 + place_6(i + 3 - size, d + 3 - size))


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


def inverse(A):
    """Return the inverse of a 3×3 matrix."""
    a, b, c = A[:3], A[3:6], A[6:]
    x, y, z = cross(b, c), cross(c, a), cross(a, b)
    d = 1.0 / dot(a, x)
    return tuple(d * v[i] for i in range(3) for v in (x, y, z))


def gyro_effects(x, delta, dt, model, coefficients, like):
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


def transition_parts(phi, D, force, dt, model):
    """Return Φ11, Φ12 and the effects of the states that enter the gyro: on the rate, if constant over a step, or on the attitude.

    The columns of Φ of the first are Φ12 times their effects.
    """
    phi11, phi12 = transition(phi, dt)
    if D is not None:
        phi12 = multiply(phi12, D)
    numbers = model.numbers
    rate = scale(1.0 / dt, phi)
    effects, columns = [], []
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
                columns.append((g.state, tuple(times(-1.0, t) for t in matrix_products(responses[g.decay], e))))
        if any_number(g.scale):
            effect = sum_of(effect, matrix_products(numbers_of(g.scale, numbers), rate))
        if any_number(g.force):
            effect = sum_of(effect, matrix_products(numbers_of(g.force, numbers), force))
        if any_number(effect):
            effects.append((g.state, effect))
    return phi11, phi12, tuple(effects), tuple(columns)


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


def top_rows(P, phi11, phi12, effects, columns, like):
    """Return the first three rows of Φ P, of the attitude, by parts."""
    rows = []
    for c in PARTS:
        p = tuple(part(P, j, c, like) for j in AXES)
        entering = tuple(part(P, k, c, like) for k, _ in effects)
        z = tuple(plus(part(P, 3 + i, c, like), products(tuple(e[i] for _, e in effects), entering)) for i in AXES)
        direct = tuple(part(P, k, c, like) for k, _ in columns)
        rows.append(
            tuple(
                plus(
                    products((*phi11[3 * a : 3 * a + 3], *phi12[3 * a : 3 * a + 3]), (*p, *z)),
                    products(tuple(e[a] for _, e in columns), direct),
                )
                for a in AXES
            )
        )
    return tuple(zip(*rows, strict=True))


def step_noise(phi, D, dt, model, like):
    """Return Q of a step: Q_θθ, Q_θb, the diagonal of Q_bb, and the columns Q_θk of the other states; without that of the chains."""
    q11, q12, q22 = process_noise(phi, dt, *gyro_variances(model))
    q11, cross_noise = driven_noise(q11, scale(1.0 / dt, phi), D, dt, model, like)
    return q11, q12 if D is None else multiply(q12, D), q22, cross_noise


NO_NOISE = ((0,) * 6, (0,) * 9, 0, (None,) * N)


def predict_formula(x, P, delta, dt, model, coefficients, like):
    """Propagate state and covariance over an increment at constant rate."""
    effects = gyro_effects(x, delta, dt, model, coefficients, like)
    noise = step_noise(effects[0], effects[1], dt, model, like)
    propagate_formula(x, P, effects, noise, dt, model, coefficients, like)


def transform_formula(x, P, delta, dt, model, coefficients, like):
    """Propagate state and covariance without process noise."""
    effects = gyro_effects(x, delta, dt, model, coefficients, like)
    propagate_formula(x, P, effects, NO_NOISE, dt, model, coefficients, like)


def noise_formula(x, Q, delta, dt, model, coefficients, like):
    """Write the process noise over an increment to a matrix whose other elements are zero."""
    phi, D, _ = gyro_effects(x, delta, dt, model, coefficients, like)
    q11, q12, q22, cross_noise = step_noise(phi, D, dt, model, like)
    for a in AXES:
        for d in AXES[a:]:
            put_element(Q, a, d, q11[place_6(a, d)])
        for j in AXES:
            put_element(Q, a, 3 + j, q12[3 * a + j])
        put_element(Q, 3 + a, 3 + a, q22)
    for states, g in STRUCTURE.chains:
        for i, k in enumerate(states):
            for a in AXES if cross_noise[k] is not None else ():
                put_element(Q, a, k, cross_noise[k][a])
            for d, j in enumerate(states[i:]):
                put_element(Q, k, j, chain_noise(coefficients, g, len(states), i, i + d))


def propagate_formula(x, P, gyro, noise, dt, model, coefficients, like):
    """Propagate state and covariance, given the effects of the gyro and the noise of the step."""
    (phi, D, force), (q11, q12, q22, cross_noise) = gyro, noise
    q = tuple_at(x, 0, 4, like)
    phi11, phi12, effects, columns = transition_parts(phi, D, force, dt, model)
    for i, y in enumerate(turned(q, phi)):
        put_at(x, i, y)
    top = tuple(kept(row, P, W * a) for a, row in enumerate(top_rows(P, phi11, phi12, effects, columns, like)))
    for a, t in enumerate([tuple(entry(top[a], P, W * a, j) for j in STATES) for a in AXES]):
        entering, direct = tuple(t[k] for k, _ in effects), tuple(t[k] for k, _ in columns)
        rates = tuple(plus(t[3 + i], products(entering, tuple(e[i] for _, e in effects))) for i in AXES)
        for d in AXES[a:]:
            s = products(t[:3], phi11[3 * d : 3 * d + 3])
            s = s + products(rates, phi12[3 * d : 3 * d + 3])
            s = plus(s, products(direct, tuple(e[d] for _, e in columns)))
            put_element(P, a, d, plus(s, q11[place_6(a, d)]))
        for j in OTHERS:
            if j not in CHAINED:
                if j < 6:
                    put_element(P, a, j, plus(t[j], q12[3 * a + j - 3]))
                else:
                    put_at(P, place(j, a), t[j])  # of one run, the row is written already
    for j in (3, 4, 5):
        put_element(P, j, j, plus(element_at(P, j, j, like), q22))
    apply_chains(x, 1, coefficients, like)
    predict_chains(P, top, noise is not NO_NOISE, cross_noise, coefficients, like)


def predict_chains(P, top, noisy, cross_noise, coefficients, like):
    """Propagate the covariance of the states that decay or are driven; ``top``: rows of the attitude, with these states before the step."""
    half = {}
    for states, g in STRUCTURE.chains:
        F = chain_matrix(coefficients, g, len(states))
        for first in PARTS if LANES == 1 else OTHERS:
            old = tuple(part(P, k, first, like) for k in states)
            for k, row in zip(states, F, strict=True):
                half[k, first] = products(row, old)
        for k in states:
            for first in PARTS if LANES == 1 else OTHERS:
                if first not in CHAINED or LANES == 1:
                    put_part(P, k, first, half[k, first])
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


def advance(x, P, delta, dt, model, coefficients, like):
    """Propagate over an increment; the coefficients are those of dt."""
    predict_formula(x, P, delta, dt, model, coefficients, like)


def transform(x, P, delta, dt, model, coefficients, like):
    """Propagate without process noise."""
    transform_formula(x, P, delta, dt, model, coefficients, like)


def write_noise(x, Q, delta, dt, model, coefficients, like):
    """Write the process noise over an increment; the coefficients are those of dt."""
    noise_formula(x, Q, delta, dt, model, coefficients, like)


def write_transition(x, delta, dt, model, coefficients, top, like):
    """Write the rows of the attitude of Φ over an increment to ``top`` (3 W)."""
    transition_formula(x, delta, dt, model, coefficients, top, like)


def row_at(A, i):
    """Return row i of a matrix (rows of W), by parts."""
    return tuple(part(A, i, c, 0.0) for c in PARTS)


def minus_row(row, factor, other):
    """Return a row less a factor times another."""
    return tuple(t - factor * u for t, u in zip(row, other, strict=True))


def put_row(A, i, factor, row):
    """Write a factor times a row to row i of a matrix."""
    for c, t in zip(PARTS, row, strict=True):
        put_part(A, i, c, factor * t)


NOISY = tuple(sorted({3, 4, 5, 0, 1, 2, *CHAINED}))
"""States with process noise."""
NOISY_WIDTH = len(NOISY) + 7 - (len(NOISY) + 7) % 8


NOISY_PARTS = tuple(range(0, NOISY_WIDTH, 8))


def noisy_row_at(A, i):
    """Return row i of a matrix with columns for the states with process noise, by parts."""
    return tuple(load_like(A, NOISY_WIDTH * i + c, lanes_of(EIGHT)) for c in NOISY_PARTS)


def put_noisy_row(A, i, factor, row):
    """Write a factor times a row to row i of such a matrix."""
    for c, t in zip(NOISY_PARTS, row, strict=True):
        store(A, NOISY_WIDTH * i + c, factor * t)


def gather_noisy_columns(A, B):
    """Write the columns of a matrix (rows of W), of which only rows of states with process noise are not zero, for these states to B."""
    for i in STATES:
        if i in NOISY:
            for c, k in enumerate(NOISY):
                B[NOISY_WIDTH * i + c] = A[W * i + k]
        else:
            for c in NOISY_PARTS:
                store(B, NOISY_WIDTH * i + c, lanes_of(EIGHT))


def scatter_noisy_columns(columns, block, P):
    """Write such columns to P on both sides of the diagonal; ``block`` has the rows of the states with process noise."""
    for c, k in enumerate(NOISY):
        for i in STATES:
            if i not in NOISY:
                P[W * i + k] = P[W * k + i] = columns[NOISY_WIDTH * i + c]
        for d, j in enumerate(NOISY):
            P[W * k + j] = block[NOISY_WIDTH * c + d]


def transition_formula(x, delta, dt, model, coefficients, top, like):
    """Write the rows of the attitude of Φ."""
    phi, D, force = gyro_effects(x, delta, dt, model, coefficients, like)
    phi11, phi12, effects, columns = transition_parts(phi, D, force, dt, model)
    for a in AXES:
        for j in AXES:
            put_at(top, W * a + j, phi11[3 * a + j])
            put_at(top, W * a + 3 + j, phi12[3 * a + j])
        for k in STATES[6:]:
            put_at(top, W * a + k, like)
        for k, e in effects:
            put_at(top, W * a + k, like + products(phi12[3 * a : 3 * a + 3], e))
        for k, e in columns:
            put_at(top, W * a + k, value_at(top, W * a + k, like) + e[a])


def predict_state(x, delta, dt, model, coefficients, like):
    """Propagate the state only."""
    phi, _, _ = gyro_effects(x, delta, dt, model, coefficients, like)
    for i, y in enumerate(turned(tuple_at(x, 0, 4, like), phi)):
        put_at(x, i, y)
    apply_chains(x, 1, coefficients, like)


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


# ---------------------------------------------------------------------------------------------------------------------- measurements


def turning_matrix(rate, acceleration):
    """Return W = [ẇ] + [w]²: the acceleration at lever arm a is W a, body axes."""
    x, y, z = rate
    a, b, c = acceleration
    return (
        -(y * y + z * z),
        x * y - c,
        x * z + b,
        x * y + c,
        -(x * x + z * z),
        y * z - a,
        x * z - b,
        y * z + a,
        -(x * x + y * y),
    )


def across(m, like):
    """Return vectors t and m × t across a vector m ≠ 0: t is the product of m and the axis farthest from it."""
    x, y, z = select(m[0] < 0.0, -m[0], m[0]), select(m[1] < 0.0, -m[1], m[1]), select(m[2] < 0.0, -m[2], m[2])
    ones = like + 1.0
    second = select(y < x, select(y <= z, ones, like), like)
    third = select(z < x, ones - second, like)
    t = cross((ones - second - third, second, third), m)
    return t, cross(m, t)


def effects_of(sensor, x, measured, numbers, like):
    """Return the effects of the states on a sensor."""
    inverted = 1.0 / measured.length
    c = tuple(value_at(x, 1 + t.state, like) for t in sensor.states)
    shares = tuple(inverted * value for value in c)
    offsets = tuple(numbers_of(t.offset, numbers) for t in sensor.states)
    if any(t.lever for t in sensor.states):
        turn = measured.turning
        W_b = turning_matrix(subtract(turn[:3], tuple_at(x, 4, 3, like)), turn[3:6])
        offsets = tuple(
            matrix_products(W_b, offset) if t.lever else offset
            for t, offset in zip(sensor.states, offsets, strict=True)
        )
    fixed = tuple(numbers_of(t.fixed, numbers) for t in sensor.states)
    scales = tuple(numbers_of(t.scale, numbers) for t in sensor.states)
    constant = tuple((0, 0, 0) if t.carried else d for t, d in zip(sensor.states, fixed, strict=True))
    carried = tuple(d if t.carried else (0, 0, 0) for t, d in zip(sensor.states, fixed, strict=True))
    return Effects(
        offsets,
        fixed,
        scales,
        tuple(products(shares, tuple(a[i] for a in offsets)) for i in AXES),
        tuple(products(shares, tuple(d[i] for d in constant)) for i in AXES),
        tuple(products(shares, tuple(d[i] for d in carried)) for i in AXES),
        tuple(products(c, tuple(U[i] for U in scales)) for i in NINE),
    )


def rows_and_axes(s, x, measured, numbers, like, transverse=False):
    """Return the rows h (N each) of a measurement by a sensor of shape s, residuals, axes, angle, and whether it is valid.

    Zeros of h are Python zeros. The axes are those of the body along which the rows measure. Angle: squared sine and cosine, times the
    length of the vector, of the angle between the measured and the predicted one; of other kinds 0 and 1. The heading of a vertical vector
    is not valid, and its row is zero. ``transverse``: the rows of a vector are those of the frame about its reference, also with error
    states.
    """
    kind = STRUCTURE.sensors[s].kind
    if kind == ATTITUDE:
        rows, y, axes, valid = attitude_rows(s, x, measured, numbers, like)
        return rows, y, axes, (like, like + 1.0), valid
    if kind == HEADING:
        rows, y, axes, valid = heading_rows(s, x, measured, numbers, like)
        return rows, y, axes, (like, like + 1.0), valid
    rows, y, axes, along = vector_rows(s, x, measured, numbers, like, transverse)
    return rows, y, axes, (y[0] * y[0] + y[1] * y[1], along), like < like + 1.0


def rows_of(s, x, measured, numbers, like, transverse=False):
    """Return rows, residuals, variances, angle and validity of a measurement (:func:`rows_and_axes`), its rows with independent noise."""
    sensor = STRUCTURE.sensors[s]
    rows, y, axes, angle, valid = rows_and_axes(s, x, measured, numbers, like, transverse)
    levers = any(t.lever for t in sensor.states)
    if sensor.kind == HEADING:
        return rows, y, (measured.noise[0],), angle, valid
    if sensor.isotropic and not levers:
        if sensor.kind == ATTITUDE:
            return rows, y, measured.z, angle, valid
        variance = measured.noise[0]
        if sensor.kind == DIRECTION and sensor.states:
            return rows, y, tuple(variance * dot(t, t) for t in axes), angle, valid
        return rows, y, tuple(variance + like for _ in rows), angle, valid
    noise = measured.noise
    if sensor.isotropic:
        noise = (noise[0], like, like, noise[0], like, noise[0])
    if levers:
        noise = arm_noise(s, x, measured, noise, numbers, like)
    rows, y, variances = independent(rows, y, axes, noise)
    return rows, y, variances, angle, valid


def attitude_rows(s, x, measured, numbers, like):
    """Return the rows of an attitude: the offset is a rotation vector between sensor axes and body axes."""
    sensor, q = STRUCTURE.sensors[s], tuple_at(x, 0, 4, like)
    ones = like + 1.0
    identity = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    if not sensor.states:
        y = rotation_vector(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), measured.frame[:4]))
        axes = ((ones, like, like), (like, ones, like), (like, like, ones))
        return tuple(e + (0,) * (N - 3) for e in identity), y, axes, like < ones
    effects = effects_of(sensor, x, measured, numbers, like)
    offset = tuple(like if is_zero(t) else t for t in effects.offset)
    turned_and_J = turned_by((ones, like, like, like), offset)
    turn, J = turned_and_J[:4], turned_and_J[4:]
    predicted = quaternion_multiply(q, turn)
    y = rotation_vector(
        quaternion_multiply((predicted[0], -predicted[1], -predicted[2], -predicted[3]), measured.frame[:4])
    )
    E = transpose(rotation_matrix(turn))  # exp(−[φ]): transforms a body-side error by the further rotation φ
    entering = {t.state: matrix_products(J, a) for t, a in zip(sensor.states, effects.offsets, strict=True)}
    rows = tuple(E[3 * i : 3 * i + 3] + tuple(entering[k][i] if k in entering else 0 for k in OTHERS) for i in AXES)
    axes = ((ones, like, like), (like, ones, like), (like, like, ones))
    return rows, y, axes, dot(offset, offset) < SQUARED_RANGE * 1e9


def heading_rows(s, x, measured, numbers, like):
    """Return the row of a heading, its residual, and whether the vector has one."""
    sensor, r = STRUCTURE.sensors[s], measured.frame[6:]
    R = rotation_matrix(tuple_at(x, 0, 4, like))
    ones = like + 1.0
    axes = ((ones, like, like),)
    if not sensor.states:
        m = matrix_times_vector(R, measured.z)
        level = m[0] * m[0] + m[1] * m[1]
        valid = level > VERTICAL
        tilt = -m[2] / select(valid, level, ones)
        unit_row = select(valid, ones, like)
        h = transpose_times_vector(R, (unit_row * (tilt * m[0]), unit_row * (tilt * m[1]), unit_row))
        y = unit_row * arctangent(m[0] * r[1] - m[1] * r[0], m[0] * r[0] + m[1] * r[1])
        return (h + (0,) * (N - 3),), (y,), axes, valid
    effects = effects_of(sensor, x, measured, numbers, like)
    M = tuple(plus(ones if i in DIAGONAL else 0, m) for i, m in enumerate(effects.M))
    D = inverse(tuple(like if is_zero(m) else m for m in M)) if any_number(effects.M) else None
    clean = subtract(measured.z, tuple(like if is_zero(t) else t for t in effects.offset))
    if D is not None:
        clean = matrix_times_vector(D, clean)
    fixed = tuple(like if is_zero(t) else t for t in effects.fixed)
    carried = tuple(like if is_zero(t) else t for t in effects.carried)
    p = subtract(matrix_times_vector(R, clean), carried)
    m = subtract(p, fixed)
    level = m[0] * m[0] + m[1] * m[1]
    valid = level > VERTICAL
    unit_row = select(valid, ones, like)
    y = unit_row * arctangent(m[0] * r[1] - m[1] * r[0], m[0] * r[0] + m[1] * r[1])
    # Derivatives at the predicted heading: those at the measured one depend on its noise, which would bias the estimated offsets.
    stretch = square_root(level / (r[0] * r[0] + r[1] * r[1]))
    m = (stretch * r[0], stretch * r[1], m[2])
    p = add(m, fixed)
    clean = transpose_times_vector(R, add(p, carried))
    inverted = unit_row / select(valid, m[0] * m[0] + m[1] * m[1], ones)
    g = (-inverted * m[1], inverted * m[0], like)
    h = dict(enumerate(transpose_times_vector(R, cross(p, g))))
    share = 1.0 / measured.length
    for t, a, d, U in zip(sensor.states, effects.offsets, effects.fixed_each, effects.scales, strict=True):
        e = tuple(times(share, value) for value in a)
        e = sum_of(e, matrix_products(U, clean))
        if D is not None:
            e = matrix_products(D, e)
        e = sum_of(matrix_products(R, e), tuple(times(share, value) for value in d))
        h[t.state] = times(-1.0, products(g, e))
    return (tuple(h.get(k, 0) for k in STATES),), (y,), axes, valid


def vector_rows(s, x, measured, numbers, like, transverse):
    """Return the rows of a direction or vector, residuals, the axes along which the rows measure, and the cosine of :func:`rows_and_axes`.

    The axes of a direction are transverse to the predicted one, and divided by the predicted magnitude, which scales its noise. Those of a
    vector are the frame about its reference or, with error states, the fixed axes: a state along one of them enters one row.
    """
    sensor, z, r = STRUCTURE.sensors[s], measured.z, measured.frame[6:]
    R = rotation_matrix(tuple_at(x, 0, 4, like))
    none = (0,) * (N - 3)
    if not sensor.states:
        u, v = transpose_times_vector(R, measured.frame[:3]), transpose_times_vector(R, measured.frame[3:6])
        third = transpose_times_vector(R, r)
        rows = ((-v[0], -v[1], -v[2], *none), u + none)
        y = (dot(u, z), dot(v, z))
        along = dot(third, z)
        if sensor.kind == DIRECTION:
            return rows, y, (u, v), along
        return (*rows, (0,) * N), (*y, along - 1.0), (u, v, third), along
    effects = effects_of(sensor, x, measured, numbers, like)
    turnable = transpose_times_vector(R, tuple(plus(p, q) for p, q in zip(r, effects.fixed, strict=True)))
    before = tuple(plus(p, products(R[i::3], effects.carried)) for i, p in enumerate(turnable))
    scaled = any(any_number(t.scale) for t in sensor.states)
    M = tuple(plus(like + 1.0 if i in DIAGONAL else 0, m) for i, m in enumerate(effects.M)) if scaled else None
    predicted = matrix_products(M, before) if scaled else before
    predicted = sum_of(predicted, effects.offset)
    squared = dot(predicted, predicted)
    if sensor.kind == DIRECTION:
        t, u = across(predicted, like)
        shrink, over = 1.0 / square_root(squared), 1.0 / square_root(dot(t, t))  # neither root waits for the other
        y = (over * dot(t, z), over * shrink * dot(u, z))
        along = shrink * dot(predicted, z)
        axes = (scale(over * shrink, t), scale(over * shrink * shrink, u))
    else:
        axes = (R[:3], R[3:6], R[6:])
        if transverse:
            axes = tuple(transpose_times_vector(R, measured.frame[3 * i : 3 * i + 3]) for i in AXES)
        y = tuple(dot(t, subtract(z, predicted)) for t in axes)
        along = y[2] + 1.0
    share = 1.0 / measured.length
    rows = []
    for i, t in enumerate(axes):
        ahead = tuple(products(M[j::3], t) for j in AXES) if scaled else t
        h = dict(enumerate(cross(ahead, turnable)))
        for state, a, d, U in zip(sensor.states, effects.offsets, effects.fixed_each, effects.scales, strict=True):
            e = products(t, a)
            if scaled or transverse or sensor.kind == DIRECTION:
                e = plus(e, products(ahead, tuple(products(R[j::3], d) for j in AXES)))
            else:
                e = plus(e, d[i])
            h[state.state] = plus(times(share, e), products(t, matrix_products(U, before)))
        rows.append(tuple(h.get(k, 0) for k in STATES))
    return tuple(rows), y, axes, along


def arm_noise(s, x, measured, noise, numbers, like):
    """Return the noise plus that of the gyro's angular acceleration at the lever arm r: ``[r] diag(variance) [r]ᵀ``."""
    sensor = STRUCTURE.sensors[s]
    share, variance = 1.0 / measured.length, measured.turning[6:]
    r = (like, like, like)
    for t in sensor.states:
        if t.lever:
            c = share * value_at(x, 1 + t.state, like)
            r = tuple(plus(p, times(c, number(a, numbers))) for p, a in zip(r, t.offset, strict=True))
    return (
        noise[0] + r[2] * r[2] * variance[1] + r[1] * r[1] * variance[2],
        noise[1] - r[0] * r[1] * variance[2],
        noise[2] - r[0] * r[2] * variance[1],
        noise[3] + r[2] * r[2] * variance[0] + r[0] * r[0] * variance[2],
        noise[4] - r[1] * r[2] * variance[0],
        noise[5] + r[1] * r[1] * variance[0] + r[0] * r[0] * variance[1],
    )


def independent(rows, y, axes, noise):
    """Return rows, residuals and variances by L⁻¹ of ``T C Tᵀ = L D Lᵀ``, T the axes of the rows, C the noise (6-tuple, body axes)."""
    c = tuple(symmetric_times_vector(noise, t) for t in axes)
    rows, y, variances, below = list(rows), list(y), [], {}
    for i, t in enumerate(axes):
        d = dot(t, c[i])
        for j in AXES[:i]:
            m = dot(t, c[j])
            for k in AXES[:j]:
                m = m - below[i, k] * below[j, k] * variances[k]
            below[i, j] = m / variances[j]
            d = d - below[i, j] * m
            rows[i] = tuple(plus(p, times(-below[i, j], q)) for p, q in zip(rows[i], rows[j], strict=True))
            y[i] = y[i] - below[i, j] * y[j]
        variances.append(d)
    return tuple(rows), tuple(y), tuple(variances)


# --------------------------------------------------------------------------------------------------------------------------- updates


def measurement_of(s, body, measured, e):
    """Return the e-th measurement, by a sensor of shape s."""
    shape, at, sensor = STRUCTURE.sensors[s], measured.place[e], measured.sensor[e]
    if LANES > 1 and not PARAMETERS:
        return measurement_in_lanes(s, body, measured, e, at, sensor)
    z = value_of(measured, at)
    if not shape.isotropic:
        noise = six_at(measured.noise, at)
    elif shape.kind == ATTITUDE:
        noise = (0.0,)
    else:
        sigma = measured.sigma[at]
        noise = (sigma * sigma,)
    if PARAMETERS:
        z, noise = with_factors(shape, z, noise, tuple(parameter(body.factors, 3 * sensor + i) for i in AXES))
    levers = any(t.lever for t in shape.states)
    turning = tuple(body.turning[e, i] for i in NINE) if levers else (0.0,) * 9
    return Measured(z, frame_of(measured, at, sensor), noise, body.length[e] if shape.states else 1.0, turning)


def with_factors(shape, z, noise, f):
    """Return value and noise of a measurement with other σ about the body axes, as factors."""
    if not shape.isotropic:
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        return z, tuple(n * f[i] * f[j] for n, (i, j) in zip(noise, pairs, strict=True))
    if shape.kind == ATTITUDE:
        return tuple(variance * t * t for variance, t in zip(z, f, strict=True)), noise
    return z, (noise[0] * f[0] * f[0],)


def measurement_in_lanes(s, body, measured, e, at, sensor):
    """Return the e-th measurement of several runs: ``value`` has four numbers of each run, a vector or an attitude."""
    shape, like = STRUCTURE.sensors[s], lanes_of((0.0,) * LANES)
    value, noise = tuple_at(measured.value, 0, 4, like), six_at(measured.noise, at)
    levers = any(t.lever for t in shape.states)
    turning = tuple_at(body.turning, 9 * e, 9, like) if levers else (0.0,) * 9
    length = body.length[e] if shape.states else 1.0
    if shape.kind == ATTITUDE:
        return Measured((noise[0], noise[3], noise[5]), value, noise, length, turning)
    return Measured(value[:3], frame_of(measured, at, sensor), noise, length, turning)


def gains(s, x, P, work, measured, numbers, factor, like):
    """Return the gains of a measurement whose noise variances are multiplied by a factor, as a :class:`Gains`.

    Of each row p = P h, given the rows before it, by parts, over the root of its innovation's variance: P decreases by the sum of the outer
    products of these gains, which is symmetric to the last bit.
    """
    H, y, r, angle, valid = rows_of(s, x, measured, numbers, like)
    r = tuple(factor * t for t in r) if factor is not None else r
    used = tuple(i for i in STATES if any(not is_zero(h[i]) for h in H))
    rows = tuple(tuple(h[i] for i in used) for h in H if any_number(h))  # the length of a vector has no information
    p = [tuple(products(row, tuple(part(P, i, c, like) for i in used)) for c in PARTS) for row in rows]
    p = [kept(t, work, LINE * (FACTORS + i)) for i, t in enumerate(p)]
    entries = [tuple(entry(t, work, LINE * (FACTORS + i), k) for k in used) for i, t in enumerate(p)]
    errors, step, gain, inverted, variances, shares = list(y), (0,) * len(PARTS), [], [], [], {}
    precise = None
    # H P Hᵀ + R = L D Lᵀ from the products of all rows, none of which waits for the rows before it.
    for i, row in enumerate(rows):
        variance, column = products(row, entries[i]), []
        for j in AXES[:i]:
            m = products(row, entries[j])
            for k in AXES[:j]:
                m = m - shares[j, k] * column[k]
            column.append(m)
            share = shares[i, j] = m * inverted[j]
            variance = variance - share * m
            errors[i] = errors[i] - share * errors[j]
            p[i] = tuple(u - share * v for u, v in zip(p[i], p[j], strict=True))
        variances.append(variance + r[i])
        inverted.append(1.0 / variances[i])
        weight = inverted[i] * errors[i]
        step = tuple(plus(t, weight * u) for t, u in zip(step, p[i], strict=True))
        root = square_root(inverted[i])
        gain.append(kept(tuple(root * t for t in p[i]), work, LINE * (GAINS + i)))
        far = variances[i] > SHORT_FORM * r[i]
        precise = far if precise is None else precise | far
    for variance in r[len(rows) :]:  # that of the length is part of the innovation
        variances.append(variance)
        inverted.append(1.0 / variance)
        shares[2, 0] = shares[2, 1] = like
    nis = products(tuple(e * e for e in errors), tuple(inverted))
    errors, variances = tuple(errors), tuple(variances)
    skipped = STRUCTURE.sensors[s].kind == HEADING  # possibly: a vertical vector has no heading
    reported = (select(valid, errors[0], like + math.nan),) if skipped else errors
    rest = precise, tuple(shares.values()), tuple(r), tuple(y), angle, valid, nis
    return Gains(tuple(gain), step, errors, variances, reported, *rest)


def innovation_covariance_of(shares, variances, noise, like):
    """Return H P Hᵀ (6-tuple), zero for absent rows, from ``H P Hᵀ + R = L D Lᵀ``: the entries of L, D and R."""
    l10, l20, l21 = (*shares, like, like, like)[:3]
    d = (*variances, like, like)[:3]
    r = (*noise, like, like)[:3]
    return (
        d[0] - r[0],
        l10 * d[0],
        l20 * d[0],
        l10 * l10 * d[0] + d[1] - r[1],
        l20 * l10 * d[0] + l21 * d[1],
        l20 * l20 * d[0] + l21 * l21 * d[1] + d[2] - r[2],
    )


def padded(values, number, like):
    """Return a 3-tuple, with a number for absent rows."""
    return tuple(like + v for v in (*values, number, number)[:3])


def store_innovations(innovation, e, errors, variances):
    """Write the innovations of a measurement, and their variances."""
    for i, (value, variance) in enumerate(zip(errors, variances, strict=True)):
        store_value(innovation, e, 2 * i, value)
        store_value(innovation, e, 2 * i + 1, variance)


def judged(s, g, options):
    """Return the outcome of a measurement: refused if its NIS exceeds the threshold, or a direction is more than 90° from the predicted."""
    kind = STRUCTURE.sensors[s].kind
    threshold = options.thresholds[len(g.errors) - 1]
    accepted = g.nis <= threshold
    if kind == DIRECTION:  # the transverse rows cannot detect it
        accepted = accepted & ((g.angle[1] >= 0.0) | (threshold == math.inf))
    outcome = select(accepted, ACCEPTED, REFUSED)
    return select(g.valid, outcome, PASSED_OVER) if kind == HEADING else outcome


def weighted(g, options, like):
    """Return the robust weight of a measurement."""
    degrees = len(g.errors)
    S = innovation_covariance_of(g.shares, g.variances, g.noise, like)
    parameter, numerator = options.parameters[degrees - 1, 0], options.parameters[degrees - 1, 1]
    y, noise = padded(g.residuals, 0.0, like), padded(g.noise, 1.0, like)
    return robust_weight(options.robust, parameter, numerator, options.iterations, S, y, noise)


def divide_variances(work, rows, weight, like):
    """Divide the variances of the rows in the work space by a weight."""
    for r in range(rows):
        at = LINE * (ROWS + r) + VARIANCE
        put_at(work, at, value_at(work, at, like) / weight)


def store_value(innovation, e, i, value):
    """Write a number to a row of the innovations; of several runs, (events, 6, runs)."""
    if LANES == 1:
        innovation[e, i] = value
    else:
        put_at(innovation, 6 * e + i, value)


def reduced(P, work, gain, i, c, like):
    """Return the value of row i of P from column c on after the update."""
    t = part(P, i, c, like)
    rows = at_part(gain, i)
    for r, u in enumerate(at_part(gain, c)):
        t = t - (work[LINE * (GAINS + r) + i] if LANES == 1 else rows[r]) * u
    return t


def at_part(rows, c):
    """Return the value of each row from column c on."""
    return tuple(row[PARTS.index(c)] for row in rows if c in PARTS)


def fixed_turn(before, after):
    """Return the rotation from one attitude to another, as a matrix in fixed axes."""
    return rotation_matrix(quaternion_multiply(after, (before[0], -before[1], -before[2], -before[3])))


def apply_gains(x, P, work, gain, step, like):
    """Correct the state by a step; subtract Σ g gᵀ from the covariance, and transform it to the new tangent space, in one pass.

    A vector of carried states is defined in the axes of the *estimated* attitude: a correction that rotates the attitude by A in fixed axes
    changes it to A c, and its error likewise.
    """
    rotate_covariance(P, work, gain, *correct_state(x, work, step, like), like)


def correct_state(x, work, step, like):
    """Correct the state by a step; return the transformations of the errors of attitude and carried vectors."""
    step, before = kept(step, work, LINE * STEP), tuple_at(x, 0, 4, like)
    both = turned_by(before, tuple(entry(step, work, LINE * STEP, a) for a in AXES))
    q, G = both[:4], both[4:]
    add_step(x, step, work, like)
    A = fixed_turn(before, q) if STRUCTURE.vectors else ()
    for v in STRUCTURE.vectors:
        for k, t in zip(v, matrix_times_vector(A, tuple(value_at(x, 1 + k, like) for k in v)), strict=True):
            put_at(x, 1 + k, t)
    for i, t in enumerate(q):
        put_at(x, i, t)
    return G, A


def add_step(x, step, work, like):
    """Add a step, given by parts, to the states; it overwrites the vector part of the quaternion, which is written next."""
    for c, t in zip(PARTS, step, strict=True):
        if LANES > 1:
            put_at(x, 1 + c, value_at(x, 1 + c, like) + t)
        elif c + 8 <= N:
            store(x, 1 + c, load_like(x, 1 + c, t) + t)
        else:
            for j in STATES[max(c, 3) :]:
                x[1 + j] = x[1 + j] + entry(step, work, LINE * STEP, j)


def rotate_covariance(P, work, gain, G, A, like):
    """Subtract Σ g gᵀ from P, and transform the attitude by G and the carried vectors by A."""
    groups = ((AXES, G), *((v, A) for v in STRUCTURE.vectors))
    half, whole = {}, {}
    for m, (v, T) in enumerate(groups):
        for first in PARTS if LANES == 1 else STATES:
            if first in PLAIN or LANES == 1 or any(first in w for w, _ in groups[m:]):
                t = tuple(reduced(P, work, gain, i, first, like) for i in v)
                for a in AXES:
                    half[v[a], first] = products(T[3 * a : 3 * a + 3], t)
                    if first in PLAIN or LANES == 1:
                        put_part(P, v[a], first, half[v[a], first])
    for block in BLOCKS:
        for i in PLAIN:
            columns = tuple(c for c in block if c >= i or LANES == 1)
            row = tuple(reduced(P, work, gain, i, c, like) for c in columns)  # read as a whole before it is written
            # Of one run, with the columns that rotate: a store of a number takes as long as that of a part.
            rotated = tuple((j, element_at(P, j, i, like)) for j in ROTATED) if LANES == 1 else ()
            for c, t in zip(columns, row, strict=True):
                put_part(P, i, c, with_entries(t, c, rotated))
    for m, (v, _) in enumerate(groups):
        for w, T in groups[m:]:
            old = tuple(tuple(element_at(P, i, j, like) if LANES == 1 else half[i, j] for j in w) for i in v)
            for a in AXES:
                for d in AXES:
                    if w[d] >= v[a] or w != v:
                        whole[v[a], w[d]] = whole[w[d], v[a]] = products(old[a], T[3 * d : 3 * d + 3])
    for i in ROTATED:
        if LANES == 1:
            entries = tuple((j, whole[i, j]) for j in ROTATED)
            for c in sorted({j - j % 8 for j in ROTATED}):
                put_part(P, i, c, with_entries(half[i, c], c, entries))
        else:
            for j in ROTATED:
                if j >= i:
                    put_element(P, i, j, whole[i, j])


# -------------------------------------------------------------------------- very precise measurements, by Joseph's form or a root of P


def store_rows(s, x, work, measured, numbers, transverse, like):
    """Write the rows of a measurement to the work space; return its angle, and whether it is valid."""
    H, y, r, angle, valid = rows_of(s, x, measured, numbers, like, transverse)
    for i, h in enumerate(H):
        for j, t in enumerate((*h, y[i], r[i])):
            put_at(work, LINE * (ROWS + i) + j, like if is_zero(t) else like + t)
    return angle, valid


def product(P, work, row, line, like):
    """Write P h of a row of the work space to another line."""
    if LANES == 1:
        product_by_parts(P, work, row, line, like)
    else:
        product_by_elements(P, work, row, line, like)


def minus_outer_rows(P, work, left, right, factor, like):
    """Subtract a factor times the outer product of two lines of the work space, known to be symmetric, from P."""
    if LANES == 1:
        minus_outer_by_parts(P, work, left, right, factor, like)
    else:
        minus_outer_by_elements(P, work, left, right, factor, like)


def product_by_parts(P, work, row, line, like):
    """Write P h, eight columns at once."""
    for c in PARTS:
        s = work[row] * part(P, 0, c, like)
        for i in STATES[1:]:
            s = s + work[row + i] * part(P, i, c, like)
        store(work, line + c, s)


def minus_outer_by_parts(P, work, left, right, factor, like):
    """Subtract an outer product, eight columns at once: below the diagonal its transpose, whose bits are those above."""
    columns = tuple(load_like(work, right + c, lanes_of(EIGHT)) for c in PARTS)
    rows = tuple(factor * load_like(work, left + c, lanes_of(EIGHT)) for c in PARTS)
    for i in STATES:
        f, g = factor * work[left + i], work[right + i]
        for c, column, row in zip(PARTS, columns, rows, strict=True):
            put_part(P, i, c, part(P, i, c, like) - (g * row if c + 8 <= i else f * column))
    for i in STATES:
        for j in STATES[i + 1 : 8 * (i // 8) + 8]:  # the parts that the diagonal crosses
            P[W * j + i] = P[W * i + j]


def product_by_elements(P, work, row, line, like):
    """Write P h, one element after the other."""
    for j in range(N):
        t = like
        for i in range(N):
            t = t + value_at(work, row + i, like) * element_at(P, i, j, like)
        put_at(work, line + j, t)


def minus_outer_by_elements(P, work, left, right, factor, like):
    """Subtract an outer product, one element after the other."""
    for i in range(N):
        t = factor * value_at(work, left + i, like)
        for j in range(i, N):
            put_element(P, i, j, element_at(P, i, j, like) - t * value_at(work, right + j, like))


def take_row(P, work, line, residual, variance, like):
    """Update covariance and step with a line of the work space; return its innovation and the innovation's variance.

    By Joseph's form, as :func:`strapdown.kernels.filter_step.update_row`.
    """
    first, p, step = LINE * line, LINE * PRODUCT, LINE * STEP
    s = variance
    error = residual
    product(P, work, first, p, like)
    for i in range(N):
        h = value_at(work, first + i, like)
        s = s + h * value_at(work, p + i, like)
        error = error - h * value_at(work, step + i, like)
    inverted = 1.0 / s
    minus_outer_rows(P, work, p, p, inverted, like)
    for i in range(N):
        t = inverted * value_at(work, p + i, like)
        put_at(work, p + i, t)
        put_at(work, step + i, value_at(work, step + i, like) + error * t)
    precise = s > SHORT_FORM * variance
    if any_lane(precise):
        d = LINE * ROUNDING
        product(P, work, first, d, like)
        for i in range(N):
            rounding = value_at(work, d + i, like) - variance * value_at(work, p + i, like)
            put_at(work, d + i, select(precise, rounding, like))
        minus_outer_rows(P, work, d, p, like + 1.0, like)
    return error, s


def clear_step(work, like):
    """Set the correction in the work space to zero."""
    for i in range(N):
        put_at(work, LINE * STEP + i, like)


def take_precisely(x, P, work, root, rows, like):
    """Update with the rows in the work space, one after the other; return whether one was too precise for double precision.

    In lanes and in exported code, by Joseph's form only.
    """
    clear_step(work, like)
    lost = like < 0.0  # false, of the type of the lanes
    by_root = LANES == 1 and exceeds_joseph_form(work, rows)
    if LANES == 1 and by_root:
        factor_covariance(P, root)
    for i in range(rows):
        line = LINE * (ROWS + i)
        variance = value_at(work, line + VARIANCE, like)
        if LANES == 1 and by_root:
            s = take_row_by_root(root, work, line)
        else:
            _, s = take_row(P, work, ROWS + i, value_at(work, line + RESIDUAL, like), variance, like)
        lost = lost | (s > MAX_PRECISION * variance)
    G, A = correct_state(x, work, stored_step(work, like), like)
    if LANES == 1 and by_root:
        turn_root(P, root, G, A)
    else:
        rotate_covariance(P, work, (), G, A, like)
    return any_lane(lost)


def exceeds_joseph_form(work, rows):
    """Return whether a row is too precise for Joseph's form; :func:`gains` has written P h."""
    far = False
    for r in range(rows):
        row = LINE * (ROWS + r)
        far = far or inner_product(work, row, 1, work, LINE * (FACTORS + r), 1, N) > JOSEPH_FORM * work[row + VARIANCE]
    return far


def inner_product(a, i, stride, b, j, step, count):
    """Return the inner product of every ``stride``-th number of a from the i-th on, and every ``step``-th of b from the j-th on."""
    s = 0.0
    for k in range(count):
        s += a[i + stride * k] * b[j + step * k]
    return s


def factor_covariance(P, root):
    """Write a root of P (Cholesky), unless P is still its square; of a state that those before it determine, a line of zeros."""
    changed = False
    for i in range(N):
        for j in range(N):
            changed = changed or P[W * i + j] != inner_product(root, i, N, root, j, N, N)
    for k in range(N if changed else 0):
        pivot = P[W * k + k] - inner_product(root, k, N, root, k, N, k)
        share = 1.0 / math.sqrt(pivot) if MAX_PRECISION * pivot > P[W * k + k] else 0.0
        for i in range(N):
            root[N * k + i] = share * (P[W * k + i] - inner_product(root, k, N, root, i, N, k)) if i >= k else 0.0


def take_row_by_root(root, work, row):
    """Update root and step with a row in the work space; return the innovation's variance (Potter: Bierman 1977, section V.3)."""
    f, step, variance = LINE * PRODUCT, LINE * STEP, work[row + VARIANCE]
    error = work[row + RESIDUAL] - inner_product(work, row, 1, work, step, 1, N)
    for k in range(N):
        work[f + k] = inner_product(root, N * k, 1, work, row, 1, N)
    s = variance + inner_product(work, f, 1, work, f, 1, N)
    for i in range(N):
        p = inner_product(root, i, N, work, f, 1, N) / s
        work[step + i] += error * p
        for k in range(N):
            root[N * k + i] -= p / (1.0 + math.sqrt(variance / s)) * work[f + k]
    return s


def turn_root(P, root, G, A):
    """Transform a root to the new tangent space, and write P, its square."""
    for k in range(0, N * N, N):
        root[k], root[k + 1], root[k + 2] = matrix_times_vector(G, (root[k], root[k + 1], root[k + 2]))
        rotate_vectors(root, k, A)
    for i in range(N):
        for j in range(N):
            P[W * i + j] = inner_product(root, i, N, root, j, N, N)


def take_precisely_in_lanes(body, gain, step, precise, rows, like):
    """Update by both forms, Joseph's for the runs that are precise."""
    x, P = body.x, body.P
    copy_values(x[0], x[1], N + 1, like)
    copy_values(P[0], P[1], SIZE_OF_P // LANES, like)
    apply_gains(x[0], P[0], body.work, gain, step, like)
    lost = take_precisely(x[1], P[1], body.work, body.root, rows, like)
    blend_values(x[1], x[0], precise, N + 1, like)
    blend_values(P[1], P[0], precise, SIZE_OF_P // LANES, like)
    return lost


def copy_values(a, b, count, like):
    """Copy values of an array of lanes to another."""
    for i in range(count):
        put_at(b, i, value_at(a, i, like))


def blend_values(a, b, condition, count, like):
    """Replace values of b by those of a in the runs in which the condition holds."""
    for i in range(count):
        put_at(b, i, select(condition, value_at(a, i, like), value_at(b, i, like)))


def apply_step(x, P, work, like):
    """Correct the state by the step in the work space, and transform the covariance."""
    apply_gains(x, P, work, (), stored_step(work, like), like)


def stored_step(work, like):
    """Return the step in the work space, by parts."""
    return tuple(
        load_like(work, LINE * STEP + c, lanes_of(EIGHT)) if LANES == 1 else value_at(work, LINE * STEP + c, like)
        for c in PARTS
    )


# --------------------------------------------------------------------------------------- updates by shape, which is known while compiling

_OF_A_SHAPE = """
def gains_{s}(body, measured, e, factor, like):
    m = measurement_of({s}, body, measured, e)
    return gains({s}, body.x[0], body.P[0], body.work, m, body.model.numbers, factor, like)


def rows_{s}(x, body, measured, e, like):
    return store_rows({s}, x, body.work, measurement_of({s}, body, measured, e), body.model.numbers, False, like)


def transverse_rows_{s}(x, body, measured, e, like):
    return store_rows({s}, x, body.work, measurement_of({s}, body, measured, e), body.model.numbers, True, like)


def take_{s}(body, measured, e, innovation, like):
    g = gains_{s}(body, measured, e, None, like)
    store_innovations(innovation, {row}, g.reported, g.variances)
    {nis}
    if any_lane(g.precise):
        rows_{s}(body.x[0], body, measured, e, like)
        return {precise}
    apply_gains(body.x[0], body.P[0], body.work, g.gain, g.step, like)
    return False


def outcome_{s}(g, options):
    return judged({s}, g, options)


def judge_{s}(body, measured, e, options, like):
    g = gains_{s}(body, measured, e, None, like)
    errors, variances = padded(g.reported, 0.0, like), padded(g.variances, 1.0, like)
    outcome = outcome_{s}(g, options)
    weight, lost = 0.0, False
    if outcome == ACCEPTED:
        weight = 1.0
        if options.robust > 0:
            weight = weighted(g, options, like)
            g = gains_{s}(body, measured, e, 1.0 / weight, like)
        if any_lane(g.precise):
            rows_{s}(body.x[0], body, measured, e, like)
            divide_variances(body.work, {rows}, weight, like)
            lost = take_precisely(body.x[0], body.P[0], body.work, body.root, {rows}, like)
        else:
            apply_gains(body.x[0], body.P[0], body.work, g.gain, g.step, like)
    return outcome, weight, errors, variances, lost


def write_{s}(x, body, measured, e, like):
    angle, valid = transverse_rows_{s}(x, body, measured, e, like)
    return {rows}, angle, valid
"""


def take(shape, body, measured, e, innovation, like):
    """Update with the e-th measurement, by a sensor of a shape; return whether it was too precise. Defined below for the structure."""


def judge(shape, body, measured, e, options, like):
    """Test a measurement and update if it is accepted; return what :func:`strapdown.kernels.gate.iterated_update` does. Defined below."""


def write(shape, x, body, measured, e, like):
    """Write the rows of a measurement at a state to the work space; return their number, angle and validity. Defined below."""


def _dispatch(name: str, arguments: str, otherwise: str) -> str:
    """Return the source of a function that calls the one of a shape."""
    calls = (f"    if shape == {s}:\n        return {name}_{s}({arguments})\n" for s in range(len(STRUCTURE.sensors)))
    return f"\n\ndef {name}(shape, {arguments}):\n{''.join(calls)}    return {otherwise}\n"


# In lanes a run that needs Joseph's form must not change the bits of those beside it.
_PRECISE = {
    True: "take_precisely(body.x[0], body.P[0], body.work, body.root, {rows}, like)",
    False: "take_precisely_in_lanes(body, g.gain, g.step, g.precise, {rows}, like)",
}[LANES == 1]
_ROW = "measured.place[e]" if LANES == 1 else "0"  # the first row if another kernel takes the innovations from there
_NIS = "put_at(innovation, 6, g.nis)" if LANES > 1 and not PARAMETERS else ""
_SOURCE = "\n".join(
    _OF_A_SHAPE.format(s=s, rows=rows, precise=_PRECISE.format(rows=rows), row=_ROW, nis=_NIS)
    for s, rows in enumerate(degrees_of_freedom(t.kind) for t in STRUCTURE.sensors)
)
_SOURCE += _dispatch("take", "body, measured, e, innovation, like", "False")
if LANES == 1:
    _NONE = "0, 0.0, (like, like, like), (like, like, like), like < like"
    _SOURCE += _dispatch("judge", "body, measured, e, options, like", _NONE)
_SOURCE += _dispatch("write", "x, body, measured, e, like", "0, (like, like), like < like")
exec(compile(_SOURCE, __file__, "exec"), globals())

# --------------------------------------------------------------------------------------------------------------- the filter without a gate


def begin(body):
    """Return the state of the walk before the first measurement."""
    # From an array, and not the literal 0: numba would compile the body for that type too.
    return Progress(0 * len(body.length), len(body.length) < 0)


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return min(step_within(turn_squared(part, dt, bias_at(body, 0)), dt), body.model.limit)


def increment_over(increments, k, body):
    """Return the increment of interval k, zero for the interval before the first edge; set the change of temperature in the interval."""
    if k < 0:
        return (0.0, 0.0, 0.0)
    if STRUCTURE.slopes:
        body.warming_now[0] = body.warming[k]
    return vector_at(increments, k)


def propagate_row(body, i, part, dt, like):
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


def predict(state, part, dt, body, out):
    """Store the prediction for a smoother, and propagate."""
    segments = state.segments
    if segments < len(out.segments):
        store_segment(out.segments, segments, dt, part, body.x[0], body.P[0])
        segments += 1
    propagate_row(body, 0, part, dt, 0.0)
    return Progress(segments, state.lost)


def update(state, e, now, measured, body, out):
    """Update with a measurement."""
    lost = take(body.shape[measured.sensor[e]], body, measured, e, out.innovation, 0.0)
    return Progress(state.segments, state.lost or lost)


def keep(state, row, e, body, out):
    """Write a row."""
    write_row(body, row, out)
    return state


def stopped(state):
    """Return whether a measurement was too precise for double precision."""
    return state.lost


def finish(state, row, e, body):
    """Return the number of segments; −1: a measurement was too precise."""
    return -1 if state.lost else state.segments


def store_segment(out, k, dt, part, x, P):
    """Write row k of the segments: dt, increment (3), x, and the upper triangle of P by rows, with seven unused numbers at the end."""
    out[k, 0] = dt
    out[k, 1], out[k, 2], out[k, 3] = part
    at = 4 + k * out.shape[1]
    eight = lanes_of(EIGHT)
    for i in range(0, N + 1, 8):  # the next row overwrites the excess
        store(out, at + i, load_like(x, i, eight))
    at += N + 1
    for i in range(N):
        for c in range(i, N, 8):
            store(out, at + c - i, load_like(P, W * i + c, eight))
        at += N - i


def write_row(body, row, out):
    """Write the state of the filter to a row of the outputs, with covariances and the whole bias if these are requested."""
    x, P = body.x[0], body.P[0]
    for i in range(N + 1):
        out.x[row, i] = x[i]
    for i in range(N):
        out.variance[row, i] = P[W * i + i]
    if row < len(out.covariance):
        for i in range(out.covariance.shape[1]):
            for j in range(out.covariance.shape[2]):
                out.covariance[row, i, j] = P[W * i + j]
    if row < len(out.whole_variance):
        write_whole_bias(P, body.offsets, row, out)


def whole_element(P, offsets, a, b, like):
    """Return an element, a ≤ b, of the covariance of attitude and *whole* gyro bias, ``b + Σ c e`` over the states that are an offset."""
    s = element_at(P, a, b, like)
    for k in range(N - 6):
        if b >= 3:
            s = s + offsets[k, b - 3] * element_at(P, a, 6 + k, like)
        if a >= 3:
            s = s + offsets[k, a - 3] * element_at(P, b, 6 + k, like)
            for j in range(N - 6):
                s = s + offsets[k, a - 3] * offsets[j, b - 3] * element_at(P, 6 + k, 6 + j, like)
    return s


def write_whole_bias(P, offsets, row, out):
    """Write variances and, if requested, covariance of attitude and whole gyro bias."""
    for a in range(6):
        for b in range(a, 6):
            s = whole_element(P, offsets, a, b, 0.0)
            if a == b:
                out.whole_variance[row, a] = s
            if row < len(out.whole_covariance):
                out.whole_covariance[row, a, b] = s
                out.whole_covariance[row, b, a] = s


def attitude_at(body, i):
    """Return the attitude of state i."""
    x = body.x
    return (x[i, 0], x[i, 1], x[i, 2], x[i, 3])


def bias_at(body, i):
    """Return the gyro bias of state i."""
    x = body.x
    return (x[i, 4], x[i, 5], x[i, 6])


# -------------------------------------------------------------------------------------------------------------------------- for the gate


def become(form):
    """Replace the filter by the restart candidate."""
    for j in range(N + 1):
        form.x[0, j] = form.x[1, j]
    for j in range(SIZE_OF_P):
        form.P[0, j] = form.P[1, j]


def attitude_covariance(form, i):
    """Return the covariance of the attitude (6-tuple)."""
    P = form.P
    return (P[i, 0], P[i, 1], P[i, 2], P[i, W + 1], P[i, W + 2], P[i, 2 * W + 2])


def start_update(form, i):
    """Start the linearisation at the state."""
    work = form.work
    for j in range(N + 1):
        work[LINE * NOW_X + j] = form.x[i, j]
    for j in range(N):
        work[LINE * PRIOR + j] = 0.0  # prior mean relative to the state of the linearisation


def linearised(form, e, now_q, q, M, measured, kind, sensor):
    """Return the number of rows, y (3,), its prediction by the prior (3,), variances (3,), and θ/sin θ and cos θ of a vector's angle.

    The rows are written to the work space, and in the prior's tangent space to ``PRIOR_ROWS``.
    """
    work = form.work
    now = work[LINE * NOW_X : LINE * NOW_X + N + 1]
    for j, value in enumerate(now_q):
        now[j] = value
    rows, (squared, along), _ = write(form.shape[sensor], now, form, measured, e, 0.0)
    y, p, variance = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    for r in range(rows):
        line, before = LINE * (ROWS + r), LINE * (PRIOR_ROWS + r)
        expected = 0.0
        for j in range(N):
            work[before + j] = work[line + j]
            expected += work[line + j] * work[LINE * PRIOR + j]
        y = with_entry(y, r, work[line + RESIDUAL])
        p = with_entry(p, r, expected)
        variance = with_entry(variance, r, work[line + VARIANCE])
        work[before], work[before + 1], work[before + 2] = transpose_times_vector(
            M, (work[line], work[line + 1], work[line + 2])
        )
        rotate_vectors(work, before, transpose(fixed_turn(q, now_q)))
    far = 1.0
    if kind in (DIRECTION, VECTOR):
        far = arc_over_chord(math.sqrt(squared), along)
    return rows, y, p, variance, far, along


def with_entry(v, i, value):
    """Return a 3-tuple with another entry i."""
    return (value if i == 0 else v[0], value if i == 1 else v[1], value if i == 2 else v[2])


def rotate_vectors(array, first, A):
    """Rotate the carried vectors among n neighbouring numbers, one per state, by A."""
    for v in STRUCTURE.vectors:
        old = tuple(array[first + k] for k in v)
        for k, value in zip(v, matrix_times_vector(A, old), strict=True):
            array[first + k] = value


def innovation_covariance(form, i, rows):
    """Return H P Hᵀ (6-tuple), zero for absent rows, in the prior's tangent space; write P Hᵀ to the work space."""
    work, P = form.work, form.P[i]
    for r in range(rows):
        product(P, work, LINE * (PRIOR_ROWS + r), LINE * (FACTORS + r), 0.0)
    return (
        row_product(work, 0, 0, rows),
        row_product(work, 0, 1, rows),
        row_product(work, 0, 2, rows),
        row_product(work, 1, 1, rows),
        row_product(work, 1, 2, rows),
        row_product(work, 2, 2, rows),
    )


def row_product(work, a, b, rows):
    """Return the product of row a in the prior's tangent space and P Hᵀ of row b; 0 for absent rows."""
    s = 0.0
    if b < rows:
        for j in range(N):
            s += work[LINE * (PRIOR_ROWS + a) + j] * work[LINE * (FACTORS + b) + j]
    return s


def step_of(form, rows, u, M, q, now_q):
    """Return the attitude part (3,) of the step from the linearisation given by P Hᵀ u, and write the whole step to the work space.

    Also return its squared size: of the attitude part, and of the effect of the error states on the rows.
    """
    work, step = form.work, LINE * STEP
    for j in range(N):
        work[step + j] = 0.0
        for r in range(rows):
            w = u[0] if r == 0 else (u[1] if r == 1 else u[2])
            work[step + j] += w * work[LINE * (FACTORS + r) + j]
    work[step], work[step + 1], work[step + 2] = matrix_times_vector(M, (work[step], work[step + 1], work[step + 2]))
    rotate_vectors(work, step, fixed_turn(q, now_q))
    for j in range(N):
        work[step + j] += work[LINE * PRIOR + j]
    squared = work[step] * work[step] + work[step + 1] * work[step + 1] + work[step + 2] * work[step + 2]
    for r in range(rows):
        effect = 0.0
        for j in range(6, N):
            effect += work[LINE * (ROWS + r) + j] * work[step + j]
        squared += effect * effect
    return (work[step], work[step + 1], work[step + 2]), squared


def relinearise(form, i, q, old_q, now_q, prior, fresh):
    """Change the point of linearisation; ``fresh``: reset all states except the attitude to the prior."""
    work, x = form.work, form.x
    now, all_prior = LINE * NOW_X + 1, LINE * PRIOR  # places of state 0 of the error
    work[all_prior], work[all_prior + 1], work[all_prior + 2] = prior
    for j in range(3, N):
        work[now + j] = x[i, 1 + j] if fresh else work[now + j] + work[LINE * STEP + j]
        work[all_prior + j] = x[i, 1 + j]
    rotate_vectors(work, now, fixed_turn(old_q, now_q))
    rotate_vectors(work, all_prior, fixed_turn(q, now_q))
    for j in range(3, N):
        work[all_prior + j] -= work[now + j]


def correct(form, i, rows, e, variance):
    """Update with independent rows of innovations e (3,) in the prior's tangent space; return the correction of the attitude."""
    work, x, P = form.work, form.x, form.P[i]
    clear_step(work, 0.0)
    for r in range(rows):
        value, noise = e[0], variance[0]
        if r == 1:
            value, noise = e[1], variance[1]
        if r == 2:
            value, noise = e[2], variance[2]
        take_row(P, work, PRIOR_ROWS + r, value, noise, 0.0)
    step = LINE * STEP
    for j in range(3, N):
        x[i, 1 + j] += work[step + j]
    return work[step], work[step + 1], work[step + 2]


def turn_covariance(P, v, A):
    """Transform the states v of a covariance by A."""
    for c in PARTS:
        old = tuple(part(P, k, c, 0.0) for k in v)
        for i, k in enumerate(v):
            put_part(P, k, c, products(A[3 * i : 3 * i + 3], old))
    for k in v:
        block = tuple(P[W * k + j] for j in v)
        for d, j in enumerate(v):
            P[W * k + j] = products(A[3 * d : 3 * d + 3], block)
    for j in STATES:
        if j not in v:
            for k in v:
                P[W * j + k] = P[W * k + j]


def turn_attitude(P, M):
    """Transform the attitude in a covariance by M."""
    turn_covariance(P, AXES, M)


def turn_vectors(P, A):
    """Rotate the carried vectors in a covariance by A."""
    for v in STRUCTURE.vectors:
        turn_covariance(P, v, A)


def turn_carried(x, P, before, after):
    """Rotate the carried vectors of a state and its covariance from one attitude to another."""
    A = fixed_turn(before, after)
    rotate_vectors(x, 1, A)
    turn_vectors(P, A)


def put_attitude(x, P, before, after):
    """Replace the attitude of a state, and rotate the states that are carried with it."""
    turn_carried(x, P, before, after)
    for j, value in enumerate(after):
        x[j] = value


def start_candidate(form, memory, now, attitude_sigma, restart):
    """Write state 1: attitude and bias of the filter with initial covariances, and the error states with their prior, propagated to now.

    The error states of the filter may be in error too, by an unknown amount; their prior remains valid. The covariances of attitude and
    bias increase with the number of candidates before it.
    """
    x, P = form.x, form.P
    width, sigma = restart_width(memory), restart_attitude(attitude_sigma, memory)
    for j in range(SIZE_OF_P):
        P[1, j] = 0.0
    for j in range(7):
        x[1, j] = x[0, j]
    for a in range(3):
        P[1, W * a + a] = sigma * sigma
        for b in range(3):
            P[1, W * (3 + a) + 3 + b] = P[0, W * (3 + a) + 3 + b]
        P[1, W * (3 + a) + 3 + a] += width * width * restart.bias_variance[a]
    for a in range(N - 6):
        x[1, 7 + a] = restart.values[a]
        for b in range(N - 6):
            P[1, W * (6 + a) + 6 + b] = restart.covariance[a, b]
    age_states(x[1], P[1], form.coefficients, now - restart.time, form.model)
    form.dt[0] = 0.0  # the coefficients are those of another step
    reset_candidate(memory, now, bias_at(form, 1), bias_variances(P[1]))


def bias_variances(P):
    """Return the variances of the bias (3,)."""
    return (P[W * 3 + 3], P[W * 4 + 4], P[W * 5 + 5])


def age_states(x, P, coefficients, age, model):
    """Propagate error states that are independent of attitude and bias over any time: a short step, doubled."""
    if age > 0.0 and len(model.last) > 0:
        h, doublings = age, 0
        while h > model.limit:
            h *= 0.5
            doublings += 1
        fill_coefficients(coefficients, h, model)
        for _ in range(doublings):
            for g in range(len(model.last)):
                double_step(coefficients, SET * g)
        age_chains(x, P, coefficients)


def double_step(coefficients, here):
    """Replace Φ and Q of a set of coefficients by those of twice the time."""
    c = coefficients[here : here + 12]
    phi = (c[0], c[1], c[2], 0.0, c[3], c[4], 0.0, 0.0, c[5])
    Q = (c[6], c[7], c[8], c[9], c[10], c[11])
    R = congruent(phi, Q)
    phi = multiply(phi, phi)
    for i, value in enumerate((phi[0], phi[1], phi[2], phi[4], phi[5], phi[8])):
        c[i] = value
    for i in AXES:
        c[6 + i] = Q[i] + R[i]
        c[9 + i] = Q[3 + i] + R[3 + i]


def age_chains(x, P, coefficients):
    """Apply the coefficients to the error states, which are independent of attitude and bias."""
    apply_chains(x, 1, coefficients, 0.0)
    for states, g in STRUCTURE.chains:
        F = chain_matrix(coefficients, g, len(states))
        for j in OTHERS[3:]:
            old = tuple(P[W * k + j] for k in states)
            for k, row in zip(states, F, strict=True):
                P[W * k + j] = products(row, old)
    for states, g in STRUCTURE.chains:
        F = chain_matrix(coefficients, g, len(states))
        for j in OTHERS[3:]:
            old = tuple(P[W * j + k] for k in states)
            for i, (k, row) in enumerate(zip(states, F, strict=True)):
                t = products(row, old)
                if j in states:
                    d = states.index(j)
                    t = t + chain_noise(coefficients, g, len(states), min(i, d), max(i, d))
                P[W * j + k] = t


def widen(form, memory):
    """Increase the initial bias variance of the candidate retroactively, if that start still determines its bias.

    The start is removed by a measurement of negative variance, of magnitude above that of the bias, which only adds |1/s| P e (P e)ᵀ to P.
    """
    x, P, work = form.x[1], form.P[1], form.work
    if not may_widen(bias_variances(P), memory):
        return
    column = LINE * PRODUCT
    turn = (0.0, 0.0, 0.0)
    for i in range(3):
        for j in range(N):
            work[column + j] = P[W * j + 3 + i]
        inverse = start_undone(i, work[column + 3 + i], memory)
        share = inverse * (memory[FIRST_BIAS + i] - x[4 + i])
        turn = combine(1.0, turn, share, (work[column], work[column + 1], work[column + 2]))
        for j in range(3, N):
            x[1 + j] += share * work[column + j]
        minus_outer_rows(P, work, column, column, inverse, 0.0)
    before = attitude_at(form, 1)
    q, G = seen_from(turn, attitude_covariance(form, 1))
    turn_attitude(P, G)
    put_attitude(x, P, before, quaternion_multiply(before, q))
    count_widening(memory)
