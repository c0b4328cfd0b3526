"""Updates with a gate and robust weights: one linearisation if the filter is sure of its state (:func:`judge`), otherwise iterated.

An iterated update is relinearised at its own result (:func:`iterated_update`). Its work space holds the state of the linearisation and the
prior mean relative to it; :mod:`strapdown.kernels.iterated_update` has the functions on tuples. Scalar only.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    factored,
    matrix_times_vector,
    scale,
    solved,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.iterated_update import (
    ACCEPTED,
    IDENTITY,
    KNOWN,
    MIN_CORRECTION_UNKNOWN,
    PASSED_OVER,
    REFUSED,
    RELINEARIZED,
    TURN_ASIDE,
    UNKNOWN,
    UNKNOWN_TILT,
    arc_over_chord,
    least_certain_axis,
    robust_weight,
    tangent_after,
    tangent_at,
    tilt_variance,
    with_noise,
)
from strapdown.kernels.lane_values import select
from strapdown.kernels.layout import (
    FACTORS,
    LINE,
    NOW_X,
    PRIOR,
    PRIOR_ROWS,
    RESIDUAL,
    ROWS,
    STEP,
    STRUCTURE,
    VARIANCE,
    N,
    attitude_covariance,
    by_shape,
    put_at,
    value_at,
)
from strapdown.kernels.measurement import (
    DIRECTION,
    HEADING,
    KIND,
    VECTOR,
    degrees_of_freedom,
    has_heading,
    quaternion_at,
    value_of,
)
from strapdown.kernels.rotation import moved, quaternion_multiply, rotation_matrix
from strapdown.kernels.rows import measurement_of, store_rows, write_rows  # noqa: F401 - in the source by shape, too
from strapdown.kernels.structure import MAX_PRECISION
from strapdown.kernels.tangent_space import fixed_turn, put_attitude, rotate_vectors, turn_attitude
from strapdown.kernels.update import (  # noqa: F401 - in the source by shape, too
    OF_A_SHAPE,
    apply_gains,
    clear_step,
    gains,
    product,
    take_precisely,
    take_row,
)

# ------------------------------------------------------------------------------------------------------------------------ one linearisation


def gate_outcome(s, g, options):
    """Return the outcome of a measurement: refused if its NIS exceeds the threshold, or a direction is more than 90° from the predicted."""
    kind = STRUCTURE.sensors[s].kind
    threshold = options.thresholds[len(g.errors) - 1]
    accepted = g.nis <= threshold
    if kind == DIRECTION:  # the transverse rows cannot detect it
        accepted = accepted & ((g.angle[1] >= 0.0) | (threshold == math.inf))
    outcome = select(accepted, ACCEPTED, REFUSED)
    return select(g.valid, outcome, PASSED_OVER) if kind == HEADING else outcome


def robust_weight_of(g, options, like):
    """Return the robust weight of a measurement."""
    degrees = len(g.errors)
    S = innovation_covariance_of_gains(g.shares, g.variances, g.noise, like)
    parameter, numerator = options.parameters[degrees - 1, 0], options.parameters[degrees - 1, 1]
    y, noise = three_of(g.residuals, 0.0, like), three_of(g.noise, 1.0, like)
    return robust_weight(options.robust, parameter, numerator, options.iterations, S, y, noise)


def innovation_covariance_of_gains(shares, variances, noise, like):
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


def three_of(values, number, like):
    """Return a 3-tuple, with a number for absent rows."""
    return tuple(like + v for v in (*values, number, number)[:3])


def divide_variances(work, rows, weight, like):
    """Divide the variances of the rows in the work space by a weight."""
    for r in range(rows):
        at = LINE * (ROWS + r) + VARIANCE
        put_at(work, at, value_at(work, at, like) / weight)


def judge(shape, body, measured, e, options, like):
    """Test a measurement at one linearisation and update if it is accepted; return what :func:`iterated_update` does. Defined below."""


_SOURCE = f"""{OF_A_SHAPE}

def outcome_{{s}}(g, options):
    return gate_outcome({{s}}, g, options)


def judge_{{s}}(body, measured, e, options, like):
    g = gains_{{s}}(body, measured, e, None, like)
    errors, variances = three_of(g.reported, 0.0, like), three_of(g.variances, 1.0, like)
    outcome = outcome_{{s}}(g, options)
    weight, lost = 0.0, False
    if outcome == ACCEPTED:
        weight = 1.0
        if options.robust > 0:
            weight = robust_weight_of(g, options, like)
            g = gains_{{s}}(body, measured, e, 1.0 / weight, like)
        if g.precise:
            rows_{{s}}(body, measured, e, like)
            divide_variances(body.work, {{rows}}, weight, like)
            lost = take_precisely(body.x[0], body.P[0], body.work, body.root, {{rows}}, like)
        else:
            apply_gains(body.x[0], body.P[0], body.work, g.gain, g.step, like)
    return outcome, weight, errors, variances, lost
"""
_NONE = "0, 0.0, (like, like, like), (like, like, like), like < like"
exec(compile(by_shape(_SOURCE, "judge", "body, measured, e, options, like", _NONE), __file__, "exec"), globals())


# --------------------------------------------------------------------------------------------------------------- relinearised at the result


def iterated_update(body, i, e, measured, passes, options):
    """Test a measurement with state i, and update if its NIS does not exceed the threshold and a direction is within 90° of the predicted.

    The update is relinearised at its own result, at most ``passes`` times, while the correction exceeds ``RELINEARIZED``. Rows are
    transformed to the tangent space of the prior, and the final covariance to that of the estimate
    (:func:`strapdown.kernels.iterated_update.tangent_at`). If the result exceeds the threshold and the attitude is nearly unknown, the
    update is repeated from 120° to either side about the least certain axis.

    A heading is skipped while the tilt, on which its row depends, is unknown; that of a vertical vector is undefined, with an innovation of
    NaN.

    Returns ``ACCEPTED``, ``REFUSED`` or ``PASSED_OVER``, the weight, independent innovations (3,) with their variances (3,) under the
    nominal noise, from the last linearisation or, without convergence, from the first, and whether it was too precise for double precision.
    """
    place = measured.place[e]
    sensor = measured.sensor[e]
    kind = measured.series[sensor, KIND]
    z = value_of(measured, place)
    degrees = degrees_of_freedom(kind)
    threshold = options.thresholds[degrees - 1]
    parameter, numerator = options.parameters[degrees - 1, 0], options.parameters[degrees - 1, 1]
    q = quaternion_at(body.x, i)
    R = rotation_matrix(q)
    if kind == HEADING and not has_heading(R, z):
        return PASSED_OVER, 0.0, (math.nan, 0.0, 0.0), (1.0, 1.0, 1.0), False
    A = attitude_covariance(body, i)
    unknown = A[0] + A[3] + A[5] >= UNKNOWN
    tolerance = MIN_CORRECTION_UNKNOWN if unknown else RELINEARIZED
    now_q = q
    M = IDENTITY
    prior = (0.0, 0.0, 0.0)  # prior mean relative to the attitude of the linearisation
    start_update(body, i)
    first_e = prior
    first_F = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    done = 1
    trials = 0
    while True:
        rows, y, p, variance, arc, along = linearise(body, e, now_q, q, M, measured, kind, sensor)
        S = innovation_covariance(body, i, rows)
        F = factored(with_noise(S, variance))
        innovation = (y[0] - p[0], y[1] - p[1], y[2] - p[2])
        e1, e2, e3 = decorrelated(F, innovation)
        accepted = e1 * e1 * F[3] + e2 * e2 * F[4] + e3 * e3 * F[5] <= threshold
        if kind == DIRECTION and along < 0.0 and threshold < math.inf:
            accepted = False  # more than 90° from the predicted one, which the transverse rows cannot detect
        if done == 1 and trials == 0:
            first_e = (e1, e2, e3)
            first_F = F
        weight, weighted = 1.0, F
        if options.robust > 0:
            # Linearised at the result of the weighted update: that of an outlier lies elsewhere.
            weight = robust_weight(options.robust, parameter, numerator, options.iterations, S, innovation, variance)
            weighted = factored(with_noise(S, scale(1.0 / weight, variance)))
        u = solved(weighted, (arc * y[0] - p[0], arc * y[1] - p[1], innovation[2]))
        step, squared = store_correction(body, rows, u, M, q, now_q)
        converged = squared < tolerance * tolerance
        fresh = False
        if converged or done >= passes:
            accepted = accepted and converged
            if accepted or trials == 2 or not unknown:
                if not converged:
                    e1, e2, e3 = first_e
                    F = first_F
                break
            trials += 1
            done = 0
            now_q = q
            fresh = True
            step = scale(math.copysign(TURN_ASIDE, trials - 1.5), least_certain_axis(A))
        old_q = now_q
        now_q, _ = moved(now_q, step)
        M, prior = tangent_at(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), now_q), A)
        relinearise(body, i, q, old_q, now_q, prior, fresh)
        done += 1
    lost = False
    outcome = REFUSED
    if kind == HEADING and tilt_variance(R, A) > UNKNOWN_TILT:
        outcome, weight = PASSED_OVER, 0.0
    elif accepted:
        outcome = ACCEPTED
        lost = min(F[3] * variance[0], F[4] * variance[1], F[5] * variance[2]) < 1.0 / MAX_PRECISION
        taken = correct(body, i, rows, innovation, scale(1.0 / weight, variance))
        reset_from(body, i, q, now_q, add(prior, matrix_times_vector(M, taken)), M)
    else:
        weight = 0.0
    return outcome, weight, (e1, e2, e3), (1.0 / F[3], 1.0 / F[4], 1.0 / F[5]), lost


def decorrelated(F, innovation):
    """Return the innovations (3,) made independent by the factors of their covariance."""
    e1 = innovation[0]
    e2 = innovation[1] - F[0] * e1
    return e1, e2, innovation[2] - F[1] * e1 - F[2] * e2


def reset_from(body, i, q, now_q, step, M):
    """Move the attitude of the linearisation by a step, and the covariance to the tangent space of the result."""
    turn_attitude(body.P[i], M)
    A = attitude_covariance(body, i)
    new_q, G = moved(now_q, step)
    if A[0] + A[3] + A[5] > KNOWN:
        _, G = tangent_after(step, A)
    turn_attitude(body.P[i], G)
    put_attitude(body.x[i], body.P[i], q, new_q)


def start_update(body, i):
    """Start the linearisation at the state."""
    work = body.work
    for j in range(N + 1):
        work[LINE * NOW_X + j] = body.x[i, j]
    for j in range(N):
        work[LINE * PRIOR + j] = 0.0  # prior mean relative to the state of the linearisation


def linearise(body, e, now_q, q, M, measured, kind, sensor):
    """Return the number of rows, y (3,), its prediction by the prior (3,), variances (3,), and θ/sin θ and cos θ of a vector's angle.

    The rows are written to the work space, and in the prior's tangent space to ``PRIOR_ROWS``.
    """
    work = body.work
    now = work[LINE * NOW_X : LINE * NOW_X + N + 1]
    for j, value in enumerate(now_q):
        now[j] = value
    rows, (squared, along), _ = write_rows(body.shape[sensor], now, body, measured, e, 0.0)
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
    arc = 1.0
    if kind in (DIRECTION, VECTOR):
        arc = arc_over_chord(math.sqrt(squared), along)
    return rows, y, p, variance, arc, along


def with_entry(v, i, value):
    """Return a 3-tuple with another entry i."""
    return (value if i == 0 else v[0], value if i == 1 else v[1], value if i == 2 else v[2])


def innovation_covariance(body, i, rows):
    """Return H P Hᵀ (6-tuple), zero for absent rows, in the prior's tangent space; write P Hᵀ to the work space."""
    work, P = body.work, body.P[i]
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


def store_correction(body, rows, u, M, q, now_q):
    """Return the attitude part (3,) of the step from the linearisation given by P Hᵀ u, and write the whole step to the work space.

    Also return its squared size: of the attitude part, and of the effect of the error states on the rows.
    """
    work, step = body.work, LINE * STEP
    for j in range(N):
        work[step + j] = 0.0
        for r in range(rows):
            work[step + j] += u[r] * work[LINE * (FACTORS + r) + j]
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


def relinearise(body, i, q, old_q, now_q, prior, fresh):
    """Change the point of linearisation; ``fresh``: reset all states except the attitude to the prior."""
    work, x = body.work, body.x
    now, all_prior = LINE * NOW_X + 1, LINE * PRIOR  # places of state 0 of the error
    work[all_prior], work[all_prior + 1], work[all_prior + 2] = prior
    for j in range(3, N):
        work[now + j] = x[i, 1 + j] if fresh else work[now + j] + work[LINE * STEP + j]
        work[all_prior + j] = x[i, 1 + j]
    rotate_vectors(work, now, fixed_turn(old_q, now_q))
    rotate_vectors(work, all_prior, fixed_turn(q, now_q))
    for j in range(3, N):
        work[all_prior + j] -= work[now + j]


def correct(body, i, rows, e, variance):
    """Update with independent rows of innovations e (3,) in the prior's tangent space; return the correction of the attitude."""
    work, x, P = body.work, body.x, body.P[i]
    clear_step(work, 0.0)
    for r in range(rows):
        take_row(P, work, PRIOR_ROWS + r, e[r], variance[r], 0.0)
    step = LINE * STEP
    for j in range(3, N):
        x[i, 1 + j] += work[step + j]
    return work[step], work[step + 1], work[step + 2]
