"""A bank of attitude filters over one record, with weights, until their mixture is one Gaussian.

Each hypothesis is the filter of :mod:`strapdown.kernels.filter_step` with two changes that a wide covariance asks for. Directions are taken
in by Gauss–Newton passes (the iterated filter), so that row and evidence belong to the attitude that the measurement leads to. And a
correction a carries the covariance by ``exp(−[a])`` instead of J_r(a): that keeps its axes in the *fixed* frame (the right-invariant
error), where the turn about a reference that never changes stays exactly as unknown as it was.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    combine,
    dot,
    full,
    matrix_times_vector,
    multiply,
    scale,
    skew_polynomial,
    subtract,
    symmetric_times_vector,
    times_transpose_upper,
    transpose_times_vector,
)
from strapdown.kernels.filter_step import predict, update_attitude, update_heading, update_row
from strapdown.kernels.measurement import (
    ATTITUDE,
    HEADING,
    VECTOR,
    degrees_of_freedom,
    direction_rows,
    heading_error,
    heading_row,
    vector_at,
)
from strapdown.kernels.robust_step import HUBER, STUDENT
from strapdown.kernels.rotation import logarithm, quaternion_multiply, rotation_matrix, turned, unit
from strapdown.kernels.series import LARGEST_ANGLE, second, sinc
from strapdown.kernels.state import load_state, store_state
from strapdown.kernels.walk import MAX_TURN

PASSES = 5
"""Most Gauss–Newton passes of one update."""
SETTLED = 1e-6
"""Square of a step, rad², below which no further pass is made: what it leaves is half of it."""
NEVER = -1
LOST = -2
"""Instead of the edge at which hypotheses became one: they did not; most of them, by weight, refuse one measurement after the other."""


def update_iterated(q, b, A, B, C, u, v, z, variance):
    """Update with a unit direction ``z`` (body), its reference in the triad u × v = r, by Gauss–Newton passes.

    Pass by pass the point q moves towards the most probable attitude. At each the prior has the mean ``m`` (body axes of that point) and
    the covariance carried there; rows are those of the point. Returns (q, b, A, B, C) and both innovations with their variances.
    """
    m = (0.0, 0.0, 0.0)
    e1 = e2 = s1 = s2 = 1.0
    A_new, B_new, C_new, b_new = A, B, C, b
    for _ in range(PASSES):
        h1, y1, h2, y2 = direction_rows(rotation_matrix(q), u, v, z)
        e1 = y1 - dot(h1, m)
        first, b_new, A_new, B_new, C_new, s1 = update_row(b, A, B, C, h1, e1, variance)
        e2 = y2 - dot(h2, m) - dot(h2, first)
        last, b_new, A_new, B_new, C_new, s2 = update_row(b_new, A_new, B_new, C_new, h2, e2, variance)
        step = add(m, add(first, last))
        squared = dot(step, step)
        turn = skew_polynomial(1.0, -sinc(squared), second(squared), step)
        q = unit(turned(q, step))
        A = times_transpose_upper(multiply(turn, full(A)), turn)
        B = multiply(turn, B)
        A_new = times_transpose_upper(multiply(turn, full(A_new)), turn)
        B_new = multiply(turn, B_new)
        m = matrix_times_vector(turn, subtract(m, step))
        if squared < SETTLED:
            break
    return q, b_new, A_new, B_new, C_new, e1, s1, e2, s2


def taken_in(kind, q, b, A, B, C, z, frame, variance, weight):
    """Update with one measurement of any kind, its variance divided by ``weight``.

    ``frame`` is the row of the triads. Returns (q, b, A, B, C), the innovations with their variances (e₁, s₁, e₂, s₂, e₃, s₃), of a
    measurement with fewer filled up by (0, 1), and the mean square of its residual after the update over its own variance:
    rᵀR⁻¹r and tr R⁻¹HP⁺Hᵀ, R not divided.
    """
    e1, s1, e2, s2, e3, s3 = 0.0, 1.0, 0.0, 1.0, 0.0, 1.0
    if kind == ATTITUDE:
        measured = (frame[0], frame[1], frame[2], frame[3])
        q, b, A, B, C, e1, s1, e2, s2, e3, s3 = update_attitude(q, b, A, B, C, measured, scale(1.0 / weight, z))
        r = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), measured))
        distance = r[0] * r[0] / z[0] + r[1] * r[1] / z[1] + r[2] * r[2] / z[2]
        spread = A[0] / z[0] + A[3] / z[1] + A[5] / z[2]
    elif kind == HEADING:
        level = (frame[6], frame[7], frame[8])
        R = rotation_matrix(q)
        h = heading_row(R, z)
        error = heading_error(R, z, level)
        q, b, A, B, C, e1, s1 = update_heading(q, b, A, B, C, h, error, variance / weight)
        R = rotation_matrix(q)
        h = heading_row(R, z)
        left = heading_error(R, z, level)
        distance = left * left / variance
        spread = dot(h, symmetric_times_vector(A, h)) / variance
    else:
        u = (frame[0], frame[1], frame[2])
        v = (frame[3], frame[4], frame[5])
        q, b, A, B, C, e1, s1, e2, s2 = update_iterated(q, b, A, B, C, u, v, z, variance / weight)
        R = rotation_matrix(q)
        h1, y1, h2, y2 = direction_rows(R, u, v, z)
        distance = (y1 * y1 + y2 * y2) / variance
        spread = (dot(h1, symmetric_times_vector(A, h1)) + dot(h2, symmetric_times_vector(A, h2))) / variance
        if kind == VECTOR:
            # Its length says nothing of the attitude, but belongs to the innovation.
            e3 = dot(transpose_times_vector(R, (frame[6], frame[7], frame[8])), z) - 1.0
            s3 = variance / weight
            distance += e3 * e3 / variance
    return q, b, A, B, C, e1, s1, e2, s2, e3, s3, distance, spread


def heavy_tailed(robust, parameter, numerator, nis):
    """Return what stands for the NIS in −2 log of the likelihood under a robust update: Huber's function, or that of Student's t."""
    if robust == STUDENT:
        return numerator * math.log(1.0 + nis / parameter)
    if robust == HUBER and nis > parameter:
        return 2.0 * math.sqrt(parameter * nis) - parameter
    return nis


def turn_quaternion(phi):
    """Return exp(φ) of any angle."""
    angle = math.sqrt(dot(phi, phi))
    half = 0.5 * angle
    factor = 0.5 if angle < 1e-8 else math.sin(half) / angle
    return (math.cos(half), factor * phi[0], factor * phi[1], factor * phi[2])


def inverse_right_jacobian(phi):
    """Return J_r⁻¹(φ) = I + ½[φ] + (1/θ² − cot(θ/2)/(2θ)) [φ]², 0 ≤ θ ≤ π."""
    x = dot(phi, phi)
    angle = math.sqrt(x)
    quadratic = (
        1.0 / 12.0 + x / 720.0
        if angle < 0.03
        else 1.0 / x - math.cos(0.5 * angle) / (2.0 * angle * math.sin(0.5 * angle))
    )
    return skew_polynomial(1.0, 0.5, quadratic, phi)


def mean_attitude(states, weight):
    """Return the weighted mean attitude, Σ w Log(q̄⁻¹ ⊗ q_i) = 0, nearest to the heaviest hypothesis."""
    heaviest = 0
    for i in range(len(weight)):
        if weight[i] > weight[heaviest]:
            heaviest = i
    q = (states[heaviest, 0], states[heaviest, 1], states[heaviest, 2], states[heaviest, 3])
    for _ in range(20):
        shift = (0.0, 0.0, 0.0)
        for i in range(len(weight)):
            if weight[i] > 0.0:
                other = (states[i, 0], states[i, 1], states[i, 2], states[i, 3])
                d = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), other))
                shift = combine(1.0, shift, weight[i], d)
        q = unit(quaternion_multiply(q, turn_quaternion(shift)))
        if dot(shift, shift) < 1e-24:
            break
    return q


def moment_match(states, weight, between, out):
    """Write the Gaussian of the mixture's first two moments to ``out`` (28,), and how far its members lie apart to ``between`` (12,).

    About the mean q̄ a member lies at d_i = Log(q̄⁻¹ ⊗ q_i), b_i − b̄, and its covariance is carried there by J_r⁻¹(d_i):
    ``P = Σ w_i (G_i P_i G_iᵀ + d_i d_iᵀ)``. ``between`` gets the second part's attitude and bias blocks.
    """
    q = mean_attitude(states, weight)
    mean = (0.0, 0.0, 0.0)
    for i in range(len(weight)):
        if weight[i] > 0.0:
            mean = combine(1.0, mean, weight[i], (states[i, 4], states[i, 5], states[i, 6]))
    for n in range(12):
        between[n] = 0.0
    for n in range(28):
        out[n] = 0.0
    out[0], out[1], out[2], out[3] = q
    out[4], out[5], out[6] = mean
    for i in range(len(weight)):
        w = weight[i]
        if w > 0.0:
            own, b, A, B, C = load_state(states[i])
            d = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), own))
            e = subtract(b, mean)
            G = inverse_right_jacobian(d)
            A = times_transpose_upper(multiply(G, full(A)), G)
            B = multiply(G, B)
            k = 0
            for r in range(3):
                for c in range(r, 3):
                    between[k] += w * d[r] * d[c]
                    between[6 + k] += w * e[r] * e[c]
                    out[7 + k] += w * (A[k] + d[r] * d[c])
                    out[22 + k] += w * (C[k] + e[r] * e[c])
                    k += 1
                for c in range(3):
                    out[13 + 3 * r + c] += w * (B[3 * r + c] + d[r] * e[c])


def share_between(total, part):
    """Return tr(T⁻¹ S) of symmetric T > 0 and S: the part of a covariance that lies between the members, summed over its axes.

    By Cholesky's factor T = L Lᵀ, a column of L⁻¹ at a time: T may have one axis open and two known a hundred thousand times better.
    """
    a = math.sqrt(total[0])
    b, c = total[1] / a, total[2] / a
    d = math.sqrt(total[3] - b * b)
    e = (total[4] - b * c) / d
    f = math.sqrt(total[5] - c * c - e * e)
    # Rows of L⁻¹, each then w S wᵀ.
    x = (1.0 / a, 0.0, 0.0)
    y = (-b / (a * d), 1.0 / d, 0.0)
    z = ((b * e - c * d) / (a * d * f), -e / (d * f), 1.0 / f)
    S = (part[0], part[1], part[2], part[3], part[4], part[5])
    return (
        dot(x, symmetric_times_vector(S, x))
        + dot(y, symmetric_times_vector(S, y))
        + dot(z, symmetric_times_vector(S, z))
    )


def normalized_weights(log_weight, least, weight):
    """Write the weights, those below ``least`` as 0 for good; return what was taken from each logarithm, so that the largest is 0."""
    best = -math.inf
    for i in range(len(log_weight)):
        best = max(best, log_weight[i])
    total = 0.0
    for i in range(len(log_weight)):
        relative = math.exp(log_weight[i] - best)
        if relative < least:
            log_weight[i] = -math.inf
            relative = 0.0
        else:
            log_weight[i] -= best
        weight[i] = relative
        total += relative
    for i in range(len(log_weight)):
        weight[i] /= total
    return best


def run_bank(
    edges,
    increments,
    angle_variance,
    rate_variance,
    event_time,
    event_kind,
    event_value,
    event_variance,
    event_reference,
    triads,
    states,
    log_weight,
    start,
    first,
    later,
    sets,
    charge,
    every,
    least_weight,
    largest_share,
    weight,
    between,
    matched,
    attitude_out,
    bias_out,
    covariance_out,
    weight_out,
    innovation_out,
    thresholds,
    robust,
    robust_parameters,
    robust_passes,
    recovery,
    taken_out,
):
    """Run the hypotheses ``states`` (h, 28) from the time ``start`` until they are one Gaussian at a kept edge, or to the end.

    Event ``first`` is the first after those that made the hypotheses. Outputs begin with the first kept edge (a multiple of ``every``) not
    before ``start``; ``weight_out`` may have no rows, ``innovation_out`` (events, 6) gets the innovations of the heaviest hypothesis. They
    are one when one is left, or when the part of the attitude's and the bias's covariance that lies between them is below
    ``largest_share``; then ``states[0]`` is that Gaussian. A hypothesis refuses what has a NIS above ``thresholds`` (by degrees of freedom,
    3), and weighs the rest as :func:`strapdown.kernels.robust_step.robust_weight` does (0: not at all); ``taken_out`` (events,) gets the
    weights of the heaviest hypothesis. When hypotheses of more than half the weight have refused ``recovery`` measurements in a row (0:
    whatever they refuse), the answer is ``LOST`` and the first of those. ``weight`` (h,), ``between`` (12,) and ``matched`` (28,) are room
    to work in; the first is left at the last weights. Returns the rows written, the edge at which they became one (``NEVER``, ``LOST``),
    and the number of the next event.

    There may be further sets of hypotheses, of no weight at first: what the events ``later`` leave open, each on its own. ``sets`` has
    where they begin, and the number of all. A set is given, at its event, the weight that those before would have had they refused all
    directions until then at a NIS of ``charge``: the first ones may lie off, and nothing else tells which. Hypotheses are not one before
    the first of these.
    """
    number = len(log_weight)
    normalized_weights(log_weight, least_weight, weight)
    started = 0
    refused = 0.0  # logarithm of the weight of having refused all
    for i in range(number):
        if weight[i] > 0.0:
            refused += math.exp(log_weight[i])
    refused = math.log(refused)
    k = -1
    while edges[k + 1] < start:
        k += 1
    now = start
    e = first
    row = 0
    streak = 0
    while k < len(increments):
        end = edges[k + 1] if k >= 0 else edges[0]
        while now < end or (e < len(event_time) and event_time[e] <= end):
            due = e < len(event_time) and event_time[e] <= end
            dt = (event_time[e] if due else end) - now
            if dt > 0.0 and k >= 0:
                part = scale(dt / (end - edges[k]), vector_at(increments, k))
                for i in range(number):
                    if weight[i] > 0.0:
                        q, b, A, B, C = load_state(states[i])
                        # A turn beyond the range of the polynomials goes in sub-steps: at constant rate they compose exactly.
                        turn = combine(1.0, part, -dt, b)
                        squared = dot(turn, turn)
                        pieces = 1
                        if LARGEST_ANGLE * LARGEST_ANGLE < squared < MAX_TURN * MAX_TURN:
                            pieces = int(math.sqrt(squared) / LARGEST_ANGLE) + 1
                        for _ in range(pieces):
                            q, A, B, C = predict(
                                q, b, A, B, C, scale(1.0 / pieces, part), dt / pieces, angle_variance, rate_variance
                            )
                        store_state(states[i], q, b, A, B, C)
            now = event_time[e] if due else end
            if due:
                leader = 0
                for i in range(number):
                    if weight[i] > weight[leader]:
                        leader = i
                z = vector_at(event_value, e)
                frame = triads[event_reference[e]]
                kind = event_kind[e]
                degrees = degrees_of_freedom(kind)
                threshold = thresholds[degrees - 1]
                parameter, numerator = robust_parameters[degrees - 1, 0], robust_parameters[degrees - 1, 1]
                refusing = 0.0
                height = 0.0
                for i in range(number):
                    if weight[i] > 0.0:
                        q, b, A, B, C = load_state(states[i])
                        done = taken_in(kind, q, b, A, B, C, z, frame, event_variance[e], 1.0)
                        _, _, _, _, _, e1, s1, e2, s2, e3, s3, _, _ = done
                        nis = e1 * e1 / s1 + e2 * e2 / s2 + e3 * e3 / s3
                        share = 1.0
                        if nis > threshold:
                            share = 0.0
                            refusing += weight[i]
                        elif robust != 0:
                            for _ in range(robust_passes):
                                distance, spread = done[11], done[12]
                                if robust == STUDENT:
                                    share = numerator / (parameter + distance + spread)
                                elif distance > parameter:
                                    share = math.sqrt(parameter / distance)
                                else:
                                    share = 1.0
                                done = taken_in(kind, q, b, A, B, C, z, frame, event_variance[e], share)
                        if share > 0.0:
                            store_state(states[i], done[0], done[1], done[2], done[3], done[4])
                        # What a hypothesis refuses counts against it as if it lay at the threshold: else none would outlive an outlier.
                        told = min(heavy_tailed(robust, parameter, numerator, nis), threshold)
                        log_weight[i] -= 0.5 * (told + math.log(s1) + math.log(s2) + math.log(s3))
                        if i == leader:
                            height = math.log(s1) + math.log(s2) + math.log(s3)
                            innovation_out[e, 0], innovation_out[e, 1], innovation_out[e, 2] = e1, s1, e2
                            innovation_out[e, 3], innovation_out[e, 4], innovation_out[e, 5] = s2, e3, s3
                            taken_out[e] = share
                refused -= 0.5 * (height + (1.0 if kind == HEADING else charge))
                if started < len(later) and e == later[started]:
                    members = sets[started + 1] - sets[started]
                    for i in range(sets[started], sets[started + 1]):
                        log_weight[i] = refused - math.log(members)
                    started += 1
                refused -= normalized_weights(log_weight, least_weight, weight)
                e += 1
                streak = streak + 1 if refusing > 0.5 else 0
                if recovery > 0 and streak >= recovery:
                    return row, LOST, e - streak
        if (k + 1) % every == 0:
            moment_match(states, weight, between, matched)
            for n in range(4):
                attitude_out[row, n] = matched[n]
            for n in range(3):
                bias_out[row, n] = matched[4 + n]
            for n in range(21):
                covariance_out[row, n] = matched[7 + n]
            left = 0
            for i in range(number):
                if row < len(weight_out):
                    weight_out[row, i] = weight[i]
                left += weight[i] > 0.0
            row += 1
            apart = max(share_between(matched[7:13], between[:6]), share_between(matched[22:28], between[6:]))
            if (started > 0 or len(later) == 0) and (left == 1 or apart < largest_share):
                for n in range(28):
                    states[0, n] = matched[n]
                return row, k + 1, e
        k += 1
    return row, NEVER, e
