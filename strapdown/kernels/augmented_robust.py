"""The filter with optional states over one whole record with all its options: any noise, a gate that recovers, robust weights.

:func:`strapdown.kernels.augmented_loop.run_augmented` is the same filter without them, and faster; :mod:`strapdown.kernels.robust_loop` and
:mod:`strapdown.kernels.robust_step` are the plain filter with them, whose reasons hold here too; what a gate makes of a measurement is in
:mod:`strapdown.kernels.robust_gate`. The state lives in rows of arrays: row 0 the filter, row 1 the challenger beside it while there is
one, so that both go through one piece of code.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    combine,
    cross,
    dot,
    full,
    matrix_times_vector,
    multiply,
    scale,
    times_transpose_upper,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.augmented_chain import chain_start, chain_step
from strapdown.kernels.augmented_factor import take_row, triangularise
from strapdown.kernels.augmented_loop import advance, longest_common_step, store_row, store_segment
from strapdown.kernels.augmented_step import (
    IDENTITY,
    arm_noise,
    decorrelate,
    fill_rows,
    fixed_turn,
    put_row,
    turn_columns,
    turn_rows,
    turn_values,
    turning_matrix,
)
from strapdown.kernels.filter_loop import ATTITUDE, DIRECTION, HEADING, vector_at
from strapdown.kernels.robust_gate import (
    CHALLENGED,
    DROPPED,
    FIRST_BIAS,
    PASSES,
    TOO_NARROW,
    WIDE_PASSES,
    begin_challenge,
    count_widening,
    is_believed,
    judge_challenger,
    judge_filter,
    may_widen,
    recover,
    restart_attitude,
    restart_width,
    start_undone,
)
from strapdown.kernels.robust_loop import frame_at, six_at
from strapdown.kernels.robust_step import (
    ACCEPTED,
    KNOWN,
    PASSED_OVER,
    REFUSED,
    RELINEARIZED,
    SETTLED,
    TURN_ASIDE,
    UNKNOWN,
    UNKNOWN_TILT,
    has_heading,
    innovation_factors,
    least_certain_axis,
    robust_weight,
    seen_from,
    tilt_variance,
)
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix
from strapdown.kernels.smoother_step import moved, solved

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""

SHORT = 0.2
"""Of λ dt of a state in a chain: its series is exact."""

X = (1.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)


def predicted_rows(F, size, H, rows, work):
    """Return the upper triangle of H P Hᵀ as a 6-tuple, rows that are not there as zeros; ``work`` (3, size) is left at ``F Hᵀ``."""
    for r in range(3):
        for j in range(size):
            total = 0.0
            if r < rows:
                for i in range(j + 1):
                    total += F[j, i] * H[r, i]
            work[r, j] = total
    s00 = s01 = s02 = s11 = s12 = s22 = 0.0
    for j in range(size):
        a, b, c = work[0, j], work[1, j], work[2, j]
        s00 += a * a
        s01 += a * b
        s02 += a * c
        s11 += b * b
        s12 += b * c
        s22 += c * c
    return (s00, s01, s02, s11, s12, s22)


def attitude_covariance(F, size):
    """Return the attitude's part of ``Fᵀ F`` as a 6-tuple."""
    s00 = s01 = s02 = s11 = s12 = s22 = 0.0
    for j in range(size):
        a, b, c = F[j, 0], F[j, 1], F[j, 2]
        s00 += a * a
        s01 += a * b
        s02 += a * c
        s11 += b * b
        s12 += b * c
        s22 += c * c
    return (s00, s01, s02, s11, s12, s22)


def seen_from_afar(kind, z, rows, y, basis):
    """Return θ/sin θ of the angle θ between a measured and a predicted vector, and its cosine times their length; of other kinds 1, 1.

    As :func:`strapdown.kernels.robust_step.arc_over_chord` and ``behind``, but of what is predicted with the optional states: the rows of
    a direction measure across that, those of a vector across the reference, along which the third row tells the length.
    """
    if kind in (ATTITUDE, HEADING):
        return 1.0, 1.0
    if rows == 3:
        along = y[2] + 1.0
    else:
        d = cross((basis[0, 0], basis[0, 1], basis[0, 2]), (basis[1, 0], basis[1, 1], basis[1, 2]))
        along = dot(d, z) / math.sqrt(dot(d, d))
    sine = math.sqrt(y[0] * y[0] + y[1] * y[1])
    if sine < 1e-9:
        return 1.0, along
    return math.atan2(sine, along) / sine, along


def take_in(
    q,
    x,
    F,
    size,
    kind,
    z,
    frame,
    noise,
    arm,
    length,
    s,
    sensors,
    sensor_use,
    chains,
    turning,
    passes,
    threshold,
    robust,
    parameter,
    numerator,
    robust_passes,
    scratch,
):
    """Test a measurement against the state and take it in: :func:`strapdown.kernels.robust_step.take_in` with optional states.

    ``noise`` is its covariance in body axes, ``turning`` the measured rate and the angular acceleration, and ``arm`` the variances of the
    latter, which a lever arm needs. An iterated update is linearised anew in all states, until neither the attitude's correction nor what
    the others' does to the rows exceeds ``RELINEARIZED``. The rows are turned to the prior's tangent space, not the factor to theirs; it is
    carried to that of the estimate at the end, with the reset. Carried states are turned along with the attitude likewise. A heading of a
    vertical vector is passed over, and its innovation is NaN.

    Returns ``ACCEPTED``, ``REFUSED`` or ``PASSED_OVER``, the weight, q, and e₁, s₁, e₂, s₂, e₃, s₃; ``x`` and ``F`` are left at the new
    state, or as they were.
    """
    H, y, spread, basis, turned_H, seen, prior, step, now_x, work = scratch
    for i in range(size):
        prior[i] = 0.0  # where the prior's mean lies, seen from the state of the linearisation
    for i in range(len(x)):
        now_x[i] = x[i]
    now_q = q
    first_R = rotation_matrix(q)
    if kind == HEADING and not has_heading(first_R, z):
        return PASSED_OVER, 0.0, q, math.nan, 1.0, 0.0, 1.0, 0.0, 1.0
    A = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    first_H = H
    if passes > 1:
        A = attitude_covariance(F, size)
        first_H = turned_H
    tolerance = SETTLED if A[0] + A[3] + A[5] >= UNKNOWN else RELINEARIZED
    M = IDENTITY
    B = IDENTITY  # the turn from the prior's attitude, fixed axes
    first_error = (0.0, 0.0, 0.0)
    first_factors = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    done = 1
    trials = 0
    while True:
        R = rotation_matrix(now_q)
        W = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        C = noise
        rate = (turning[0] - now_x[0], turning[1] - now_x[1], turning[2] - now_x[2])
        if arm[0] > 0.0:
            W = turning_matrix(rate, (turning[3], turning[4], turning[5]))
            C = arm_noise(now_x, s, sensors, sensor_use, length, arm, noise)
        rows = fill_rows(now_q, R, now_x, kind, z, frame, length, s, sensors, sensor_use, W, H, y, basis)
        far, along = seen_from_afar(kind, z, rows, y, basis)
        decorrelate(H, y, rows, basis, C, spread)
        p0 = p1 = p2 = 0.0
        if passes > 1:
            for i in range(size):
                for r in range(3):
                    turned_H[r, i] = H[r, i]
                p0 += H[0, i] * prior[i]
                p1 += H[1, i] * prior[i]
                p2 += H[2, i] * prior[i]
            for r in range(3):
                put_row(turned_H, r, transpose_times_vector(M, (H[r, 0], H[r, 1], H[r, 2])))
            if len(chains) > 0:
                turn_columns(chains, transpose(B), turned_H, 3)
        S = predicted_rows(F, size, first_H, rows, seen)
        y0 = y[0]
        y1 = y[1] if rows > 1 else 0.0
        y2 = y[2] if rows > 2 else 0.0
        variance = (spread[0], spread[1] if rows > 1 else 1.0, spread[2] if rows > 2 else 1.0)
        error = (y0 - p0, y1 - p1, y2 - p2)
        factors = innovation_factors(S, X, Y, Z, variance)
        e1 = error[0]
        e2 = error[1] - factors[0] * e1
        e3 = error[2] - factors[1] * e1 - factors[2] * e2
        accepted = e1 * e1 * factors[3] + e2 * e2 * factors[4] + e3 * e3 * factors[5] <= threshold
        if threshold < math.inf and kind == DIRECTION and along < 0.0:
            accepted = False
        if passes == 1:
            break
        if done == 1 and trials == 0:
            first_error = (e1, e2, e3)
            first_factors = factors
        u = solved(factors, (far * y0 - p0, far * y1 - p1, y2 - p2))
        for j in range(size):
            step[j] = 0.0
        for j in range(size):
            w = u[0] * seen[0, j] + u[1] * seen[1, j] + u[2] * seen[2, j]
            for i in range(j + 1):
                step[i] += F[j, i] * w
        step[0], step[1], step[2] = matrix_times_vector(M, (step[0], step[1], step[2]))
        if len(chains) > 0:
            turn_values(chains, B, step, 6)
        for i in range(size):
            step[i] += prior[i]
        squared = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
        for r in range(rows):
            total = 0.0
            for i in range(6, size):
                total += H[r, i] * step[i]
            squared += total * total
        converged = squared < tolerance * tolerance
        if converged or done >= passes:
            accepted = accepted and converged
            if accepted or trials == 2 or A[0] + A[3] + A[5] < UNKNOWN:
                if not converged:
                    e1, e2, e3 = first_error
                    factors = first_factors
                break
            trials += 1
            done = 0
            now_q = q
            for i in range(len(x)):
                now_x[i] = x[i]
                step[3 + i] = 0.0
            step[0], step[1], step[2] = scale(math.copysign(TURN_ASIDE, trials - 1.5), least_certain_axis(A))
        old_q = now_q
        now_q, _ = moved(now_q, (step[0], step[1], step[2]))
        _, M, back = seen_from(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), now_q), A, IDENTITY)
        prior[0], prior[1], prior[2] = back
        for i in range(len(x)):
            now_x[i] += step[3 + i]
            prior[3 + i] = x[i]
        if len(chains) > 0:
            B = fixed_turn(q, now_q)
            turn_values(chains, fixed_turn(old_q, now_q), now_x, 3)
            turn_values(chains, B, prior, 6)
        for i in range(len(x)):
            prior[3 + i] -= now_x[i]
        done += 1
    weight = 0.0
    outcome = REFUSED
    if passes > 1 and kind == HEADING and tilt_variance(first_R, A) > UNKNOWN_TILT:
        outcome = PASSED_OVER
    elif accepted:
        outcome = ACCEPTED
        weight = 1.0
        if robust > 0:
            weight = robust_weight(robust, parameter, numerator, robust_passes, S, X, Y, Z, error, variance)
        for i in range(size):
            step[i] = 0.0
        for r in range(rows):
            left = error[0] if r == 0 else (error[1] if r == 1 else error[2])
            for i in range(size):
                left -= first_H[r, i] * step[i]  # what the rows before it have corrected
            s2 = take_row(F, size, first_H, r, spread[r] / weight, work)
            for i in range(size):
                step[i] += left / s2 * work[i]
        a = add((prior[0], prior[1], prior[2]), matrix_times_vector(M, (step[0], step[1], step[2])))
        before = q
        q, G = moved(now_q, a)
        for i in range(len(x)):
            x[i] += step[3 + i]
        turn_rows(F, size, M)
        if passes > 1:
            A = attitude_covariance(F, size)
            if A[0] + A[3] + A[5] > KNOWN:
                turn, _ = moved((1.0, 0.0, 0.0, 0.0), a)
                _, G, _ = seen_from(turn, A, IDENTITY)
        turn_rows(F, size, G)
        if len(chains) > 0:
            B = fixed_turn(before, q)
            turn_values(chains, B, x, 3)
            loose = turn_columns(chains, B, F, size)
            triangularise(F, loose, loose, size, size, 0, 0, work)
        else:
            triangularise(F, 3, 3, size, size, 0, 0, work)
    return outcome, weight, q, e1, 1.0 / factors[3], e2, 1.0 / factors[4], e3, 1.0 / factors[5]


def aged_chain(decay, chains, first, k, age):
    """Return Φ (9-tuple) of the states ``first`` to k of a chain, two or three, over any time, and Q (6-tuple) of what drives them.

    :func:`strapdown.kernels.augmented_chain.chain_step` over a step short enough, doubled as often as it takes.
    """
    fastest = 0.0
    for j in range(first, k + 1):
        fastest = max(fastest, decay[j])
    h = age
    doublings = 0
    while fastest * h > SHORT:
        h *= 0.5
        doublings += 1
    _, _, own0, n20, n21, n22, n10, n11, n00 = chain_step(decay, chains, first, first, h)
    # What drives the first state, which feeds none, is not the chain's.
    _, near1, own1, n20, n21, n22, n10, n11, n00 = chain_step(decay, chains, first + 1, first, h)
    d = chains[first + 1, 1]
    q00 = d * (n21 * n21 + n11 * n11)
    q01 = d * n21 * n22
    q11 = d * n22 * n22
    q02 = q12 = q22 = 0.0
    far2, near2, own2 = 0.0, 0.0, 1.0
    if k - first > 1:
        far2, near2, own2, n20, n21, n22, n10, n11, n00 = chain_step(decay, chains, k, first, h)
        d = chains[k, 1]
        q00 += d * (n20 * n20 + n10 * n10 + n00 * n00)
        q01 += d * (n20 * n21 + n10 * n11)
        q02 = d * n20 * n22
        q11 += d * (n21 * n21 + n11 * n11)
        q12 = d * n21 * n22
        q22 = d * n22 * n22
    phi = (own0, near1, far2, 0.0, own1, near2, 0.0, 0.0, own2)
    Q = (q00, q01, q02, q11, q12, q22)
    for _ in range(doublings):
        more = times_transpose_upper(multiply(phi, full(Q)), phi)
        Q = (Q[0] + more[0], Q[1] + more[1], Q[2] + more[2], Q[3] + more[3], Q[4] + more[4], Q[5] + more[5])
        phi = multiply(phi, phi)
    return phi, Q


def age_chains(x, fresh, decay, chains, age):
    """Take the mean and the root of the optional states' prior over ``age``, of those in chains; the rows of their noise likewise."""
    m = len(decay)
    for k in range(1, m):
        if chains[k - 1, 0] != 0.0 and chains[k, 0] == 0.0 and age > 0.0:
            first = chain_start(chains, k)
            last = k - first == 2
            phi, Q = aged_chain(decay, chains, first, k, age)
            a, b, c = x[1, 3 + first], x[1, 4 + first], x[1, 5 + first] if last else 0.0
            x[1, 3 + first] = phi[0] * a + phi[1] * b + phi[2] * c
            x[1, 4 + first] = phi[4] * b + phi[5] * c
            if last:
                x[1, 5 + first] = phi[8] * c
            for r in range(3, 3 + m):
                a, b, c = fresh[r, 3 + first], fresh[r, 4 + first], fresh[r, 5 + first] if last else 0.0
                fresh[r, 3 + first] = phi[0] * a + phi[1] * b + phi[2] * c
                fresh[r, 4 + first] = phi[4] * b + phi[5] * c
                if last:
                    fresh[r, 5 + first] = phi[8] * c
            # A root of Q by rows from the last state up; what drives the first by itself stands in its row already.
            n22 = math.sqrt(Q[5])
            n21 = Q[4] / n22 if n22 > 0.0 else 0.0
            n20 = Q[2] / n22 if n22 > 0.0 else 0.0
            n11 = math.sqrt(max(Q[3] - n21 * n21, 0.0))
            n10 = (Q[1] - n20 * n21) / n11 if n11 > 0.0 else 0.0
            n00 = math.sqrt(max(Q[0] - n20 * n20 - n10 * n10, 0.0))
            row = 3 + m + first
            if last:
                fresh[row + 2, 3 + first], fresh[row + 2, 4 + first], fresh[row + 2, 5 + first] = n20, n21, n22
            fresh[row + 1, 3 + first], fresh[row + 1, 4 + first] = n10, n11
            fresh[row, 3 + first] = math.sqrt(fresh[row, 3 + first] ** 2 + n00 * n00)


def start_challenger(
    attitude,
    x,
    F,
    size,
    memory,
    now,
    attitude_sigma,
    bias_sigma,
    values,
    root,
    begun,
    decay,
    density,
    chains,
    fresh,
    work,
):
    """Write row 1: the filter's attitude and bias, as uncertain as a fresh start, and the optional states as the prior has them by now.

    Whatever led the filter astray has gone into the optional states too, and what they are still worth cannot be told; their prior is
    right all the same. It is ``values`` (m,) with the covariance ``rootᵀ root`` (m, m), of the time ``begun``. ``bias_sigma`` (3,) is added
    to the bias's. Attitude and bias are widened by how many challengers have been before it. ``fresh`` (3 m + 6, 3 + m) is scratch.
    """
    age = now - begun
    width = restart_width(memory)
    m = len(values)
    for r in range(3 * m + 6):
        for c in range(3 + m):
            fresh[r, c] = 0.0
    for r in range(3):
        fresh[r, r] = width * bias_sigma[r]
    for k in range(m):
        kept = math.exp(-decay[k] * age)
        if len(chains) > 0 and (chains[k, 0] != 0.0 or (k > 0 and chains[k - 1, 0] != 0.0)):
            kept = 1.0  # age_chains has all of it
        x[1, 3 + k] = kept * values[k]
        for r in range(k, m):
            fresh[3 + r, 3 + k] = kept * root[r, k]
        driven = age
        if decay[k] > 0.0:
            driven = -0.5 * math.expm1(-2.0 * decay[k] * age) / decay[k]
        fresh[3 + m + k, 3 + k] = math.sqrt(driven * density[k])
    if len(chains) > 0:
        age_chains(x, fresh, decay, chains, age)
    for r in range(3 + m):
        for c in range(3):
            fresh[3 + 2 * m + r, c] = F[0, 3 + r, 3 + c]
    triangularise(fresh, 3 + m, 0, 3 + m, 3 * m + 6, 0, 0, work)
    for r in range(size):
        for c in range(size):
            F[1, r, c] = 0.0
    for r in range(3):
        F[1, r, r] = restart_attitude(attitude_sigma, memory)
        x[1, r] = x[0, r]
    for r in range(3 + m):
        for c in range(r + 1):
            F[1, 3 + r, 3 + c] = fresh[r, c]
    for i in range(4):
        attitude[1, i] = attitude[0, i]
    begin_challenge(memory, now, vector_at(x, 1), bias_variances(F[1], size))


def bias_variances(F, size):
    """Return the variances of the bias (3,) of a factor's covariance."""
    x = y = z = 0.0
    for j in range(size):
        x += F[j, 3] * F[j, 3]
        y += F[j, 4] * F[j, 4]
        z += F[j, 5] * F[j, 5]
    return (x, y, z)


def widen(attitude, x, F, size, memory, chains, column, work):
    """Make the challenger what it would be had its bias started wider: :func:`strapdown.kernels.robust_loop.widen` with optional states.

    What is taken in has a negative variance, beyond that of the bias, and only adds to P: |1/s| P e (P e)ᵀ, a row more of the factor.
    ``column`` (size,) is scratch, and so is the row of F under the triangle.
    """
    if not may_widen(bias_variances(F[1], size), memory):
        return
    turn = (0.0, 0.0, 0.0)
    for i in range(3):
        for c in range(size):
            column[c] = 0.0
            for j in range(max(c, 3 + i), size):
                column[c] += F[1, j, c] * F[1, j, 3 + i]
        inverse = start_undone(i, column[3 + i], memory)
        share = inverse * (memory[FIRST_BIAS + i] - x[1, i])
        turn = combine(1.0, turn, share, (column[0], column[1], column[2]))
        for c in range(3, size):
            x[1, c - 3] += share * column[c]
        root = math.sqrt(-inverse)
        for c in range(size):
            F[1, size, c] = root * column[c]
        triangularise(F[1], size, 0, size, size + 1, 0, 0, work)
    q, _ = moved((1.0, 0.0, 0.0, 0.0), turn)
    _, G, _ = seen_from(q, attitude_covariance(F[1], size), IDENTITY)
    turn_rows(F[1], size, G)
    before = attitude_at(attitude, 1)
    after = quaternion_multiply(before, q)
    loose = 3
    if len(chains) > 0:
        B = fixed_turn(before, after)
        turn_values(chains, B, x[1], 3)
        loose = turn_columns(chains, B, F[1], size)
    triangularise(F[1], loose, loose, size, size, 0, 0, work)
    attitude[1, 0], attitude[1, 1], attitude[1, 2], attitude[1, 3] = after
    count_widening(memory)


def attitude_at(attitude, i):
    """Return row i as a 4-tuple."""
    return (attitude[i, 0], attitude[i, 1], attitude[i, 2], attitude[i, 3])


def run_augmented_robust(
    edges,
    increments,
    angle_variance,
    rate_variance,
    decay,
    density,
    changing,
    limit,
    gyro,
    gyro_use,
    sensors,
    sensor_use,
    force_f,
    chains,
    links,
    event_time,
    event_kind,
    event_value,
    event_noise,
    event_length,
    event_sensor,
    event_reference,
    event_turning,
    triads,
    thresholds,
    robust,
    robust_parameters,
    robust_passes,
    recovery,
    lock_out_limit,
    restart_attitude_sigma,
    restart_bias_sigma,
    restart_values,
    restart_root,
    restart_time,
    standing,
    memory,
    attitude,
    x,
    F,
    scratch,
    measuring,
    fresh,
    every,
    attitude_out,
    x_out,
    variance_out,
    covariance_out,
    whole_variance_out,
    whole_covariance_out,
    innovation_out,
    weight_out,
    recovery_out,
    lock_out_out,
    segment_out,
):
    """Run the filter over a record as :func:`strapdown.kernels.augmented_loop.run_augmented` does, with options.

    Options, ``standing``, ``memory``, ``weight_out``, ``recovery_out``, ``lock_out_out`` and what is counted are those of
    :func:`strapdown.kernels.robust_loop.run_robust`; a challenger starts as :func:`start_challenger` says, from a prior that is of
    ``restart_time``. ``attitude`` (2, 4), ``x``
    (2, size − 3) and ``F`` (2, …, size) hold the state in row 0 and are left at the end state. ``measuring`` holds the scratch of
    :func:`take_in`: arrays (3, size), (3,), (3,), (3, 3), (3, size), (3, size), (size,), (size,), (size − 3,) and one as wide as F.
    Returns the numbers of segments, of recoveries and of lock-outs.
    """
    size = x.shape[1] + 3
    noisy = 6 + changing
    coupling, factor, work, six = scratch
    n = len(increments)
    running = 1
    if memory[CHALLENGED] > 0.0:
        running = 2
    recoveries = 0
    lock_outs = 0
    events = len(event_time)
    e = 0
    k = -1  # the interval before the first edge has no length; its end takes the events at the first edge
    now = edges[0]
    end = now
    whole = 1.0
    theta = (0.0, 0.0, 0.0)
    countdown = 0
    row = 0
    segments = 0
    while k < n:
        due = e < events and event_time[e] <= end
        stop = event_time[e] if due else end
        dt = stop - now
        if dt > 0.0:
            part = theta
            if dt < whole:
                part = scale(dt / whole, theta)
            # All states that run go the same sub-steps.
            longest = longest_common_step(dt, part, x, running, limit)
            if longest < dt:
                share = longest / dt
                dt = longest
                part = scale(share, part)
                stop = now + dt
                due = False
            for i in range(running):
                q = attitude_at(attitude, i)
                if i == 0 and segments < len(segment_out):
                    store_segment(segment_out, segments, dt, part, q, x[0], F[0], size)
                    segments += 1
                attitude[i, 0], attitude[i, 1], attitude[i, 2], attitude[i, 3] = advance(
                    q,
                    x[i],
                    F[i],
                    size,
                    noisy,
                    changing,
                    dt,
                    part,
                    angle_variance,
                    rate_variance,
                    decay,
                    density,
                    gyro,
                    gyro_use,
                    force_f,
                    chains,
                    links,
                    coupling,
                    factor,
                    work,
                )
            now = stop
        if due:
            kind = event_kind[e]
            sensor = event_sensor[e]
            degrees = 3
            if kind == HEADING:
                degrees = 1
            elif kind == DIRECTION:
                degrees = 2
            turning = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            arm = (0.0, 0.0, 0.0)
            if len(event_turning) > 0:
                turning = six_at(event_turning, e)
                arm = (event_turning[e, 6], event_turning[e, 7], event_turning[e, 8])
            i = 0
            while i < running:
                outcome, w, q, e1, s1, e2, s2, e3, s3 = take_in(
                    attitude_at(attitude, i),
                    x[i],
                    F[i],
                    size,
                    kind,
                    vector_at(event_value, e),
                    frame_at(triads, event_reference[e]),
                    six_at(event_noise, e),
                    arm,
                    event_length[e],
                    sensor,
                    sensors,
                    sensor_use,
                    chains,
                    turning,
                    int(memory[PASSES]) if i == 0 else WIDE_PASSES,
                    thresholds[degrees - 1],
                    robust,
                    robust_parameters[degrees - 1, 0],
                    robust_parameters[degrees - 1, 1],
                    robust_passes,
                    measuring,
                )
                attitude[i, 0], attitude[i, 1], attitude[i, 2], attitude[i, 3] = q
                if i == 0:
                    weight_out[e] = w
                    innovation_out[e, 0] = e1
                    innovation_out[e, 1] = s1
                    innovation_out[e, 2] = e2
                    innovation_out[e, 3] = s2
                    innovation_out[e, 4] = e3
                    innovation_out[e, 5] = s3
                    lock_outs, challenge = judge_filter(
                        outcome, now, sensor, recovery, lock_out_limit, standing, memory, lock_out_out, lock_outs
                    )
                    if challenge:
                        start_challenger(
                            attitude,
                            x,
                            F,
                            size,
                            memory,
                            now,
                            restart_attitude_sigma,
                            restart_bias_sigma,
                            restart_values,
                            restart_root,
                            restart_time,
                            decay,
                            density,
                            chains,
                            fresh,
                            work,
                        )
                        running = 2
                else:
                    nis = e1 * e1 / s1 + e2 * e2 / s2 + e3 * e3 / s3
                    verdict = judge_challenger(outcome, nis, degrees, sensor, standing, memory, vector_at(x, 1))
                    if verdict == DROPPED:
                        running = 1
                    elif verdict == TOO_NARROW:
                        widen(attitude, x, F, size, memory, chains, measuring[6], work)
                    if verdict != DROPPED and is_believed(sensor, recovery, standing, memory):
                        recover(now, sensor, lock_out_limit, standing, memory, recovery_out[recoveries], lock_out_out)
                        recoveries += 1
                        for j in range(4):
                            attitude[0, j] = attitude[1, j]
                        for j in range(size - 3):
                            x[0, j] = x[1, j]
                        for j in range(size):
                            for c in range(size):
                                F[0, j, c] = F[1, j, c]
                        running = 1
                i += 1
            e += 1
        if now >= end and (e == events or event_time[e] > end):
            if countdown == 0:
                countdown = every
                store_row(
                    attitude_at(attitude, 0),
                    x[0],
                    F[0],
                    size,
                    gyro,
                    gyro_use,
                    row,
                    attitude_out,
                    x_out,
                    variance_out,
                    covariance_out,
                    whole_variance_out,
                    whole_covariance_out,
                    six,
                )
                row += 1
            countdown -= 1
            k += 1
            if k < n:
                end = edges[k + 1]
                whole = end - now
                theta = vector_at(increments, k)
    return segments, recoveries, lock_outs
