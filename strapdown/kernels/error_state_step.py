"""The MEKF with optional error states, one step at a time: scalars and tuples for the attitude, arrays for the rest.

State: attitude ``q_fb``; ``x`` = (b, c): gyro bias and error states c; factor ``F`` of the covariance of (δθ, δb, δc)
(:mod:`strapdown.kernels.triangle`). The error states are defined by arrays, so that no kernel depends on their meaning:

- each has its own decay rate and white noise, ``ċ = −λ c + √q w``: ``decay`` λ, ``density`` q. Constant states come last.
- the gyro measures ``(I + Σ c T) w + b + Σ c e + Σ c G R_fbᵀ f + n``, f the specific force at rest, fixed frame: ``gyro``
  (states, 12) holds e (3) and T or G (9, by rows), ``gyro_use`` the bits :data:`OFFSET`, :data:`SCALE` and :data:`FORCE`.
- a sensor measures ``(I + Σ c U) R_fbᵀ (r + Σ c d) + Σ c a + v``: ``sensors`` (sensors, states, 15) holds a (3, body), d (3, fixed) and
  U (9), ``sensor_use`` the bits :data:`OFFSET`, :data:`FIXED` and :data:`SCALE`. With :data:`CARRIED` in addition, d is not constant in the
  fixed frame but rotates with corrections of the estimated attitude: the derivative with respect to the attitude omits it, and each
  correction rotates the states themselves (:func:`turn_values`, :func:`turn_columns`).
  With :data:`LEVER` instead of OFFSET, the offset is W a, ``W = [ẇ] + [w]²``: the acceleration at lever arm a from the centre of rotation.

The step-by-step filter uses the same functions, uncompiled.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add_matrices,
    combine,
    cross,
    dot,
    matrix_times_vector,
    multiply,
    scale,
    scale_matrix,
    skew_polynomial,
    symmetric_minus_outer,
    transpose_times_vector,
)
from strapdown.kernels.filter_step import process_noise, transition
from strapdown.kernels.lane_values import lanes_of, load_like, store
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix, turned

CALLED = (
    "response",
    "move",
    "step_noise",
    "follow",
    "fill_noise",
    "carry",
    "carry_back",
    "turn_columns",
    "turn_values",
)
"""Called, not inlined, by other kernels: a call costs little compared with their work, and each copy would be compiled again."""

OFFSET = 1
SCALE = 2
FIXED = 4
CARRIED = 8
FORCE = 16
LEVER = 32

FOUR = (0.0, 0.0, 0.0, 0.0)
"""Pattern of four lanes."""
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

FACTORIALS = tuple(1.0 / math.factorial(k) for k in range(16, 1, -1))
"""1/16! to 1/2!."""
THREE_NODES = (0.5 - 0.5 * math.sqrt(0.6), 0.5, 0.5 + 0.5 * math.sqrt(0.6))
THREE_WEIGHTS = (5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0)


def inverse(A):
    """Return the inverse of a 3×3 matrix."""
    a, b, c = A[:3], A[3:6], A[6:]
    x, y, z = cross(b, c), cross(c, a), cross(a, b)
    d = 1.0 / dot(a, x)
    return tuple(d * v[i] for i in range(3) for v in (x, y, z))


def response(rate, u, decay):
    """Return ``∫₀ᵘ exp(−[ω](u − s)) e^{−λs} ds``, the effect of a decaying rate error on the attitude over u, and ``∫₀ᵘ e^{−λs} ds``.

    With ``φ_k = Σ (−λu)^i/(i + k)!`` and y = −ω²u² the first is ``u φ₁ − u² (φ₂ + φ₄ y + …) [ω] + u³ (φ₃ + φ₅ y + …) [ω]²``, accurate to
    rounding for |ω| u ≤ 1/3 and λ u ≤ 1/2.
    """
    z = -decay * u
    y = -u * u * dot(rate, rate)
    phi = FACTORIALS[0]
    linear = quadratic = 0.0
    for k in range(1, 14, 2):
        phi = FACTORIALS[k] + z * phi
        quadratic = phi + y * quadratic
        phi = FACTORIALS[k + 1] + z * phi
        linear = phi + y * linear
    mean = u * (1.0 + z * phi)
    return skew_polynomial(mean, -u * u * linear, u * u * u * quadratic, rate), mean


def error_matrix(gyro, k):
    """Return the matrix T or G of state k."""
    return tuple(gyro[k, i] for i in range(3, 12))


def gyro_matrix_times(gyro, k, v):
    """Return the product of the matrix of state k and v."""
    return matrix_times_vector(error_matrix(gyro, k), v)


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


def move(q, x, dt, part, model, top, factor):
    """Propagate attitude and error states over an increment ``part``; return q, Φ11, the rate and (I + M)⁻¹.

    Writes e^{−λ dt} of the error states to ``factor``, and the columns of Φ's first four rows, those of attitude and first bias, to ``top``
    (n, 4). With M = Σ c T the rotation is ``φ = (I + M)⁻¹ (Δθ − b dt − Σ e ∫c dt)``, and the rate of its error
    ``−(I + M)⁻¹ (δb + Σ e δc + Σ T ω δc)``. The specific force is that at the middle of the step; its dependence on the attitude *error* is
    neglected, as its effect is small compared with that of the bias.
    """
    decay, gyro, gyro_use, force_f = model.decay, model.gyro, model.gyro_use, model.force_f
    r = combine(1.0, part, -dt, (x[0], x[1], x[2]))
    M = IDENTITY
    scaled = False
    force = (0.0, 0.0, 0.0)
    if dot(force_f, force_f) > 0.0:
        force = transpose_times_vector(rotation_matrix(turned(q, scale(0.5, r))), force_f)
    for k in range(len(decay)):
        if k > 0 and decay[k] == decay[k - 1]:
            factor[k] = factor[k - 1]
        else:
            factor[k] = math.exp(-decay[k] * dt) if decay[k] > 0.0 else 1.0
        if gyro_use[k] & OFFSET:
            mean = -math.expm1(-decay[k] * dt) / decay[k] if decay[k] > 0.0 else dt
            r = combine(1.0, r, -mean * x[3 + k], (gyro[k, 0], gyro[k, 1], gyro[k, 2]))
        if gyro_use[k] & FORCE:
            r = combine(1.0, r, -dt * x[3 + k], gyro_matrix_times(gyro, k, force))
        if gyro_use[k] & SCALE:
            scaled = True
            M = add_matrices(M, scale_matrix(x[3 + k], error_matrix(gyro, k)))
    D = inverse(M) if scaled else IDENTITY
    phi = matrix_times_vector(D, r) if scaled else r
    phi11, phi12 = transition(phi, dt)
    if scaled:
        phi12 = multiply(phi12, D)
    rate = scale(1.0 / dt, phi)
    for i in range(3):
        top[i, 0], top[i, 1], top[i, 2] = phi11[i], phi11[3 + i], phi11[6 + i]
        top[3 + i, 0], top[3 + i, 1], top[3 + i, 2] = phi12[i], phi12[3 + i], phi12[6 + i]
    top[3, 3] = 0.0
    four = lanes_of(FOUR)
    j0, j1, j2 = load_like(top, 12, four), load_like(top, 16, four), load_like(top, 20, four)
    a0, a1, a2 = rate[0] * j0, rate[0] * j1, rate[0] * j2
    b0, b1, b2 = rate[1] * j0, rate[1] * j1, rate[1] * j2
    c0, c1, c2 = rate[2] * j0, rate[2] * j1, rate[2] * j2
    E = IDENTITY
    held = 0.0  # the decay that E is of; states of one block have the same
    for k in range(len(decay)):
        x[3 + k] *= factor[k]
        use = gyro_use[k]
        if use != 0:
            column = four
            if use & OFFSET and decay[k] == 0.0:
                column = gyro[k, 0] * j0 + gyro[k, 1] * j1 + gyro[k, 2] * j2
            if use & SCALE:
                column = column + (gyro[k, 3] * a0 + gyro[k, 4] * b0 + gyro[k, 5] * c0)
                column = column + (gyro[k, 6] * a1 + gyro[k, 7] * b1 + gyro[k, 8] * c1)
                column = column + (gyro[k, 9] * a2 + gyro[k, 10] * b2 + gyro[k, 11] * c2)
            store(top, 24 + 4 * k, column)
            if use & OFFSET and decay[k] > 0.0:
                if decay[k] != held:
                    E, _ = response(rate, dt, decay[k])
                    E, held = multiply(E, D), decay[k]
                add_column(top, k, scale(-1.0, matrix_times_vector(E, (gyro[k, 0], gyro[k, 1], gyro[k, 2]))))
            if use & FORCE:
                add_column(top, k, matrix_times_vector(phi12, gyro_matrix_times(gyro, k, force)))
    top[3, 3] = 1.0
    return turned(q, phi), phi11, rate, D


def add_column(top, k, column):
    """Add a column of Φ, the effect of state k on the attitude, to ``top``."""
    top[6 + k, 0] += column[0]
    top[6 + k, 1] += column[1]
    top[6 + k, 2] += column[2]


def step_noise(noise, dt, rate, D, model):
    """Write the process noise Q of a step to ``noise`` (n, 4): rows 0 to 2 hold Q_θθ, the row of any other state i holds Q_θi and Q_ii.

    For attitude and bias it is the exact Q of :func:`strapdown.kernels.filter_step.process_noise` (the white noise of the gyro is specified
    after its scale factor). For an error state that is a gyro offset, Gauss's rule with three nodes is used.
    """
    decay, density, gyro, gyro_use = model.decay, model.density, model.gyro, model.gyro_use
    q11, q12, q22 = process_noise(scale(dt, rate), dt, model.angle_variance, model.rate_variance)
    for i in range(3):
        noise[3 + i, 0], noise[3 + i, 1], noise[3 + i, 2], noise[3 + i, 3] = q12[i], q12[3 + i], q12[6 + i], q22
    E = (IDENTITY, IDENTITY, IDENTITY)
    kept = (1.0, 1.0, 1.0)
    mean = 0.0
    held = alone = -1.0  # decay rates for which E and kept, and mean, were computed
    for k in range(len(decay)):
        if density[k] > 0.0 and gyro_use[k] & OFFSET:
            if decay[k] != held:
                held = decay[k]
                E0, m0 = response(rate, dt * (1.0 - THREE_NODES[0]), held)
                E1, m1 = response(rate, dt * (1.0 - THREE_NODES[1]), held)
                E2, m2 = response(rate, dt * (1.0 - THREE_NODES[2]), held)
                E = (multiply(E0, D), multiply(E1, D), multiply(E2, D))
                kept = (1.0 - held * m0, 1.0 - held * m1, 1.0 - held * m2)
            e = (gyro[k, 0], gyro[k, 1], gyro[k, 2])
            own = 0.0
            with_attitude = (0.0, 0.0, 0.0)
            for r in range(3):
                q = THREE_WEIGHTS[r] * dt * density[k]
                t = matrix_times_vector(E[r], e)
                with_attitude = combine(1.0, with_attitude, -q * kept[r], t)
                own += q * kept[r] * kept[r]
                q11 = symmetric_minus_outer(q11, scale(-q, t), t)
            noise[6 + k, 0], noise[6 + k, 1], noise[6 + k, 2] = with_attitude
            noise[6 + k, 3] = own
        elif density[k] > 0.0:
            if decay[k] != alone:
                alone = decay[k]
                mean = -0.5 * math.expm1(-2.0 * decay[k] * dt) / decay[k] if decay[k] > 0.0 else dt
            noise[6 + k, 3] = mean * density[k]
    noise[0, 0], noise[0, 1], noise[0, 2] = q11[0], q11[1], q11[2]
    noise[1, 0], noise[1, 1], noise[1, 2] = q11[1], q11[3], q11[4]
    noise[2, 0], noise[2, 1], noise[2, 2] = q11[2], q11[4], q11[5]


def follow(top, factor, noise, next_top, next_factor, next_noise, size, changing):
    """Make one step of two, of which ``next_`` comes after the other: ``Φ₂ Φ₁`` and ``Φ₂ Q₁ Φ₂ᵀ + Q₂``."""
    four = lanes_of(FOUR)
    p0, p1, p2 = load_like(next_top, 0, four), load_like(next_top, 4, four), load_like(next_top, 8, four)
    for i in range(size):
        kept = factor[i - 6] if 6 <= i < 6 + changing else 1.0
        t = top[i, 0] * p0 + top[i, 1] * p1 + top[i, 2] * p2
        if i >= 3:
            t = t + kept * load_like(next_top, 4 * i, four)
        store(top, 4 * i, t)
    a0 = noise[0, 0] * p0 + noise[0, 1] * p1 + noise[0, 2] * p2  # rows of Q_θθ Φ11ᵀ
    a1 = noise[1, 0] * p0 + noise[1, 1] * p1 + noise[1, 2] * p2
    a2 = noise[2, 0] * p0 + noise[2, 1] * p1 + noise[2, 2] * p2
    b0 = next_top[0, 0] * a0 + next_top[1, 0] * a1 + next_top[2, 0] * a2 + load_like(next_noise, 0, four)
    b1 = next_top[0, 1] * a0 + next_top[1, 1] * a1 + next_top[2, 1] * a2 + load_like(next_noise, 4, four)
    b2 = next_top[0, 2] * a0 + next_top[1, 2] * a1 + next_top[2, 2] * a2 + load_like(next_noise, 8, four)
    for i in range(3, 6 + changing):
        own = noise[i, 3]
        if own > 0.0 or next_noise[i, 3] > 0.0:
            ahead = load_like(next_top, 4 * i, four)
            u = noise[i, 0] * p0 + noise[i, 1] * p1 + noise[i, 2] * p2
            v = u + own * ahead  # what the first step's noise has of the attitude after the second
            store(noise, 4 * i, v)
            b0 = b0 + noise[i, 0] * ahead + next_top[i, 0] * u
            b1 = b1 + noise[i, 1] * ahead + next_top[i, 1] * u
            b2 = b2 + noise[i, 2] * ahead + next_top[i, 2] * u
            kept = next_factor[i - 6] if i >= 6 else 1.0
            store(noise, 4 * i, kept * v + load_like(next_noise, 4 * i, four))
            noise[i, 3] = kept * kept * own + next_noise[i, 3]
    store(noise, 0, b0)
    store(noise, 4, b1)
    store(noise, 8, b2)
    for k in range(changing):
        factor[k] *= next_factor[k]


def fill_noise(F, first, noise, noisy):
    """Write N with ``Q = Nᵀ N`` for the first ``noisy`` states to the rows of F from ``first``; return the row after them."""
    q11 = (noise[0, 0], noise[0, 1], noise[0, 2], noise[1, 1], noise[1, 2], noise[2, 2])
    row = first + 3
    for i in range(3, noisy):
        if noise[i, 3] > 0.0:
            root = math.sqrt(noise[i, 3])
            a = scale(1.0 / root, (noise[i, 0], noise[i, 1], noise[i, 2]))
            for c in range(3, noisy):
                F[row, c] = 0.0
            F[row, 0], F[row, 1], F[row, 2] = a
            F[row, i] = root
            q11 = symmetric_minus_outer(q11, a, a)
            row += 1
    for r in range(first, first + 3):
        for c in range(noisy):
            F[r, c] = 0.0
    u22 = math.sqrt(q11[5])
    u12 = q11[4] / u22
    u02 = q11[2] / u22
    u11 = math.sqrt(q11[3] - u12 * u12)
    u01 = (q11[1] - u02 * u12) / u11
    F[first, 0] = math.sqrt(q11[0] - u01 * u01 - u02 * u02)
    F[first + 1, 0], F[first + 1, 1] = u01, u11
    F[first + 2, 0], F[first + 2, 1], F[first + 2, 2] = u02, u12, u22
    return row


def carry(F, size, loose, top, factor, changing):
    """Carry a factor, as many rows of it loose, over a step: each row is a column of S, so ``S ← Φ S``."""
    width = F.shape[1]
    four = lanes_of(FOUR)
    for j in range(
        0, size, 4
    ):  # four rows at once, or each sum would wait for itself; below F there are as many rows of noise
        a = b = c = d = four
        for i in range(max(min(j + 4, size), loose)):
            t = load_like(top, 4 * i, four)
            a, b, c, d = a + F[j, i] * t, b + F[j + 1, i] * t, c + F[j + 2, i] * t, d + F[j + 3, i] * t
        for r in range(max(j, 6), min(j + 4, size)):  # rows before have nothing there
            for k in range(min(max(r + 1, loose) - 6, changing)):
                F[r, 6 + k] *= factor[k]
        store(F, width * j, a)
        store(F, width * (j + 1), b)
        store(F, width * (j + 2), c)
        store(F, width * (j + 3), d)


def carry_back(F, size, end, phi11, top, inverse, changing):
    """Undo :func:`carry` of full rows, to ``end``: rows by ``Φ⁻¹``. ``inverse`` has the reciprocals of ``factor``."""
    width = F.shape[1]
    four = lanes_of(FOUR)
    for j in range(0, end, 4):  # below the last there are rows to spare
        for r in range(j, min(j + 4, end)):
            for k in range(changing):
                F[r, 6 + k] *= inverse[k]
        a, b = load_like(F, width * j, four), load_like(F, width * (j + 1), four)
        c, d = load_like(F, width * (j + 2), four), load_like(F, width * (j + 3), four)
        first = F[j, 3], F[j + 1, 3], F[j + 2, 3], F[j + 3, 3]
        for i in range(3, max(j + 4, 6 + changing) if j + 4 <= size else size):
            t = load_like(top, 4 * i, four)
            a, b, c, d = a - F[j, i] * t, b - F[j + 1, i] * t, c - F[j + 2, i] * t, d - F[j + 3, i] * t
        store(F, width * j, a)
        store(F, width * (j + 1), b)
        store(F, width * (j + 2), c)
        store(F, width * (j + 3), d)
        for r in range(4):
            F[j + r, 0], F[j + r, 1], F[j + r, 2] = transpose_times_vector(
                phi11, (F[j + r, 0], F[j + r, 1], F[j + r, 2])
            )
            F[j + r, 3] = first[r]


def turn_rows(F, end, G):
    """Transform the attitude columns of rows 0 to ``end`` to another tangent space: ``S_θ ← G S_θ``."""
    for j in range(end):
        F[j, 0], F[j, 1], F[j, 2] = matrix_times_vector(G, (F[j, 0], F[j, 1], F[j, 2]))


def fixed_turn(before, after):
    """Return the rotation from one attitude to another, as a matrix in fixed axes."""
    return rotation_matrix(quaternion_multiply(after, (before[0], -before[1], -before[2], -before[3])))


def turn_values(chains, A, values, first):
    """Rotate by A the vectors formed by carried states, which start at ``first`` in ``values``.

    Such a state k, and the states p = ``chains[k, 2]`` and 2p after it, are the components of a vector in the axes of the *estimated*
    attitude, ``c′ = R_est R_fbᵀ c``: the vector in body axes, ``R_estᵀ c′``, does not change when the attitude is corrected. A correction
    that rotates R_est by A therefore changes c′ to A c′, exactly, and its error likewise.
    """
    for k in range(len(chains)):
        p = int(chains[k, 2])
        if p > 0:
            x, y, z = first + k, first + k + p, first + k + 2 * p
            values[x], values[y], values[z] = matrix_times_vector(A, (values[x], values[y], values[z]))


def turn_columns(chains, A, F, end):
    """Rotate the columns of carried states in rows 0 to ``end`` likewise; return the number of leading columns no longer triangular."""
    last = 3
    for k in range(len(chains)):
        p = int(chains[k, 2])
        if p > 0:
            x, y, z = 6 + k, 6 + k + p, 6 + k + 2 * p
            last = max(last, z + 1)
            for r in range(end):
                F[r, x], F[r, y], F[r, z] = matrix_times_vector(A, (F[r, x], F[r, y], F[r, z]))
    return last
