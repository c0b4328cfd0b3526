"""The filter over eight stretches of one record side by side, a stretch a lane.

A filter is a chain: no step can begin before the one before it. What can be known beforehand is where each stretch begins to a hundredth of
its σ, from a filter that takes many steps as one (:func:`bundle`). From there :func:`run_with_sensitivity` runs the filter over all
stretches at once, and tells beside their ends how these would move with their starts; so the ends can be joined to the starts
(:mod:`strapdown.kernels.stretch_seams`), and :func:`run_stretches` runs the filter from where each stretch truly begins.

**How the end depends on the start.** Let the run start at (x̃, P̃) instead of (x, P), d = x − x̃, ΔP = P − P̃. A filter's end is linear in
its start's mean and linear-fractional in its covariance (Redheffer 1960; Särkkä & García-Fernández 2021, section IV): with
``Ψ = Π (I − K H) Φ`` over the run, ``J = Σ Ψᵀ Hᵀ S⁻¹ H Ψ`` and ``η = Σ Ψᵀ Hᵀ S⁻¹ e``, Ψ in the sums being that up to each measurement,
``x_end = x̃_end + Ψ (I + ΔP J)⁻¹ (d + ΔP η)``, ``P_end = P̃_end + Ψ (I + ΔP J)⁻¹ ΔP Ψᵀ``. η and J are the adjoint variables of Bryson &
Frazier's smoother too, so they say what a stretch tells of its own start.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    combine,
    dot,
    full,
    matrix_times_vector,
    multiply,
    scale,
    symmetric_times_vector,
    times_transpose_upper,
    transpose_times_vector,
)
from strapdown.kernels.filter_loop import CHECKED, least_share
from strapdown.kernels.filter_step import SHORT_FORM, direction_rows, predict, rows_at_once, transition
from strapdown.kernels.lane_angles import rotation_vector
from strapdown.kernels.lane_values import (
    WIDTH,
    anywhere,
    everywhere,
    fetch_ahead,
    lanes_of,
    load,
    load_triples,
    store,
    store_quadruples,
)
from strapdown.kernels.rotation import exponential, right_jacobian, rotation_matrix, turned
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.kernels.stretch_lanes import (
    AHEAD,
    ETA,
    PRESENT,
    STATE,
    J,
    fetch_lanes,
    load_lanes,
    measured,
    store_lanes,
)

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""

SENSITIVITY = 75
"""Numbers of Ψ (36), the upper triangle of J (21), η (6), and scratch for two rows of six."""
SUMS, SUMMED = 8, 5
"""Where in the scratch a bundle's sums begin, and how many each sensor has: weight, time, vector."""
_ROWS = 63
_LARGEST_SQUARE = LARGEST_ANGLE * LARGEST_ANGLE


def lay_out(edges, first, steps, dts_out):
    """Write the lengths of the intervals from ``first`` on, (steps, lanes) flat."""
    for k in range(steps):
        for i in range(WIDTH):
            n = first + steps * i + k
            dts_out[WIDTH * k + i] = edges[n + 1] - edges[n]


def lay_out_variances(sigma, first, steps, variances_out):
    """Write the squares of ``sigma`` from row ``first`` on, (steps, lanes) flat; return whether all are those of measurements."""
    present = True
    for k in range(steps):
        for i in range(WIDTH):
            one = sigma[first + steps * i + k]
            variances_out[WIDTH * k + i] = one * one
            present = present and one * one < PRESENT
    return present


def bundle(
    increments,
    first,
    steps,
    dts,
    bias,
    values,
    places,
    complete,
    rows,
    variances,
    frames,
    scratch,
    size,
    turns_out,
    seen_out,
):
    """Take ``size`` steps as one: their turn, and of each sensor the mean of its vectors, seen from the mean of their times.

    Bundle n of stretch i goes to row ``i · bundles + n``, the last of a stretch has what steps are left. ``turns_out`` (rows, 4) gets
    rotation vector and time; ``seen_out`` (sensors, rows, 8) mean vector, variance, and four times the time from the bundle's start; both
    are flat.
    The turns within a bundle are taken without ``bias``, and what the gyro's noise does to them is neglected.
    """
    zero = lanes_of((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    w = WIDTH
    bundles = (steps + size - 1) // size
    for n in range(bundles):
        q = (zero + 1.0, zero, zero, zero)
        span = zero
        for s in range(len(places)):
            sums = w * (SUMS + SUMMED * s)
            store(scratch, sums, zero + 1.0 / (PRESENT * PRESENT))
            for i in range(1, SUMMED):
                store(scratch, sums + w * i, zero)
        for k in range(size * n, min(size * (n + 1), steps)):
            dt = load(dts, w * k)
            theta = load_triples(increments, 3 * (first + k), 3 * steps)
            q = turned(q, (theta[0] - dt * bias[0], theta[1] - dt * bias[1], theta[2] - dt * bias[2]))
            span = span + dt
            R = rotation_matrix(q)
            for s in range(len(places)):
                at = w * (steps * s + k)
                variance = load(variances, at)
                if not (complete[s] or anywhere(variance < PRESENT)):
                    continue
                z = measured(values, places[s], complete[s], rows, at, k, steps, scratch)
                weight = 1.0 / variance
                sums = w * (SUMS + SUMMED * s)
                z = matrix_times_vector(R, z)
                store(scratch, sums, load(scratch, sums) + weight)
                store(scratch, sums + w, load(scratch, sums + w) + weight * span)
                for i in range(3):
                    store(scratch, sums + w * (2 + i), load(scratch, sums + w * (2 + i)) + weight * z[i])
        turn = rotation_vector(q)
        store_quadruples(
            turns_out,
            4 * n,
            4 * bundles,
            (turn[0] + span * bias[0], turn[1] + span * bias[1], turn[2] + span * bias[2], span),
        )
        for s in range(len(places)):
            sums = w * (SUMS + SUMMED * s)
            variance = 1.0 / load(scratch, sums)
            elapsed = variance * load(scratch, sums + w)
            R = rotation_matrix(exponential(scale(elapsed / span, turn)))
            mean = (load(scratch, sums + 2 * w), load(scratch, sums + 3 * w), load(scratch, sums + 4 * w))
            z = scale(variance, transpose_times_vector(R, mean))
            place = 8 * (w * bundles * s + n)
            store_quadruples(seen_out, place, 8 * bundles, (z[0], z[1], z[2], variance))
            store_quadruples(seen_out, place + 4, 8 * bundles, (elapsed, elapsed, elapsed, elapsed))


def record_of_bundles(
    edges,
    first,
    steps,
    size,
    turns,
    seen,
    edges_out,
    increments_out,
    time_out,
    row_out,
    series_out,
    value_out,
    sigma_out,
):
    """Write the bundles of all stretches but the last as :func:`strapdown.kernels.filter_loop.run_filter` takes them.

    A sensor's row is that of its bundle; bundles that it saw nothing in have no event. Returns the number of events.
    """
    bundles = (steps + size - 1) // size
    rows = (WIDTH - 1) * bundles
    sensors = len(seen)
    events = 0
    edges_out[0] = edges[first]
    for n in range(rows):
        lane = n // bundles
        edges_out[n + 1] = edges[first + steps * lane + min(size * (n - bundles * lane + 1), steps)]
        for i in range(3):
            increments_out[n, i] = turns[n, i]
        begin = events
        for s in range(sensors):
            variance = seen[s, n, 3]
            if not variance < PRESENT:
                continue
            row = rows * s + n
            for i in range(3):
                value_out[3 * row + i] = seen[s, n, i]
            sigma_out[row] = math.sqrt(variance)
            time = min(edges_out[n] + seen[s, n, 4], edges_out[n + 1])
            place = events
            while place > begin and time_out[place - 1] > time:
                time_out[place], row_out[place] = time_out[place - 1], row_out[place - 1]
                series_out[place] = series_out[place - 1]
                place -= 1
            time_out[place], row_out[place], series_out[place] = time, row, s
            events += 1
    return events


def innovation_rows(A, R, u, v, z, variance):
    """Return the two rows of a direction, h and y, A h of both, and their covariance (s1, s12, s22)."""
    h1, e1, h2, y2 = direction_rows(R, u, v, z)
    pa1 = symmetric_times_vector(A, h1)
    pa2 = symmetric_times_vector(A, h2)
    return h1, e1, h2, y2, pa1, pa2, dot(h1, pa1) + variance, dot(h1, pa2), dot(h2, pa2) + variance


def near_reset(q, A, B, correction):
    """Do as :func:`strapdown.kernels.filter_step.reset` with a correction of one radian at most; return the Jacobian G too."""
    G = right_jacobian(correction)
    return turned(q, correction), times_transpose_upper(multiply(G, full(A)), G), multiply(G, B), G


def update_sensitivity(memory, B, G, h1, e1, h2, y2, pa1, pa2, s1, s12, s22):
    """Take the two rows of a direction into Ψ, J and η, and Ψ to the tangent space that the reset by G leaves.

    As :func:`strapdown.kernels.filter_step.rows_at_once`: the second row is freed of the first.
    """
    w = WIDTH
    determinant = s1 * s22 - s12 * s12
    inverse1 = 1.0 / s1
    inverse2 = (1.0 / determinant) * s1
    share = inverse1 * s12
    h2 = combine(1.0, h2, -share, h1)
    gains1 = scale(inverse1, matrix_times_vector(G, pa1))
    gains2 = scale(inverse2, matrix_times_vector(G, combine(1.0, pa2, -share, pa1)))
    biases1 = scale(inverse1, transpose_times_vector(B, h1))
    biases2 = scale(inverse2, transpose_times_vector(B, h2))
    for j in range(6):
        at = w * j
        x, y, z = load(memory, at), load(memory, at + 6 * w), load(memory, at + 12 * w)
        g1 = h1[0] * x + h1[1] * y + h1[2] * z
        g2 = h2[0] * x + h2[1] * y + h2[2] * z
        for i in range(3):
            r = 3 * i
            theta = G[r] * x + G[r + 1] * y + G[r + 2] * z
            store(memory, at + 6 * w * i, theta - gains1[i] * g1 - gains2[i] * g2)
            place = at + 6 * w * (3 + i)
            store(memory, place, load(memory, place) - biases1[i] * g1 - biases2[i] * g2)
        store(memory, w * (_ROWS + j), g1)
        store(memory, w * (_ROWS + 6 + j), g2)
    add_information(memory, inverse1, inverse2, inverse1 * e1, inverse2 * (y2 - share * e1))


def add_information(memory, inverse1, inverse2, f1, f2):
    """Add what two rows g of h · Ψ tell of the start to J and η."""
    w = WIDTH
    at = J * w
    for i in range(6):
        g1 = load(memory, w * (_ROWS + i))
        g2 = load(memory, w * (_ROWS + 6 + i))
        k1, k2 = inverse1 * g1, inverse2 * g2
        place = w * (ETA + i)
        store(memory, place, load(memory, place) + g1 * f1 + g2 * f2)
        for j in range(i, 6):
            other1, other2 = load(memory, w * (_ROWS + j)), load(memory, w * (_ROWS + 6 + j))
            store(memory, at, load(memory, at) + k1 * other1 + k2 * other2)
            at += w


def predict_sensitivity(memory, phi11, phi12):
    """Take Ψ_θ ← Φ11 Ψ_θ + Φ12 Ψ_b."""
    w = WIDTH
    for j in range(6):
        at = w * j
        x, y, z = load(memory, at), load(memory, at + 6 * w), load(memory, at + 12 * w)
        u, v, t = load(memory, at + 18 * w), load(memory, at + 24 * w), load(memory, at + 30 * w)
        for i in range(3):
            r = 3 * i
            turned_part = phi11[r] * x + phi11[r + 1] * y + phi11[r + 2] * z
            store(memory, at + 6 * w * i, turned_part + phi12[r] * u + phi12[r + 1] * v + phi12[r + 2] * t)


def run_with_sensitivity(
    increments,
    first,
    steps,
    dts,
    angle_variance,
    rate_variance,
    values,
    places,
    complete,
    rows,
    variances,
    frames,
    scratch,
    state,
    sensitivity,
):
    """Run the filter over eight stretches and carry Ψ, J and η along (:data:`SENSITIVITY` places); return whether it came to the end.

    Arguments as for :func:`run_stretches`.
    """
    lanes_of((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    w = WIDTH
    q, b, A, B, C = load_lanes(state, 0)
    for k in range(steps):
        theta = load_triples(increments, 3 * (first + k), 3 * steps)
        dt = load(dts, w * k)
        phi = combine(1.0, theta, -dt, b)
        if not everywhere(dot(phi, phi) <= _LARGEST_SQUARE):
            return False
        q, A, B, C = predict(q, b, A, B, C, theta, dt, angle_variance, rate_variance)
        phi11, phi12 = transition(phi, dt)
        predict_sensitivity(sensitivity, phi11, phi12)
        for s in range(len(places)):
            at = w * (steps * s + k)
            variance = load(variances, at)
            if not (complete[s] or anywhere(variance < PRESENT)):
                continue
            z = measured(values, places[s], complete[s], rows, at, k, steps, scratch)
            u = (frames[s, 0], frames[s, 1], frames[s, 2])
            v = (frames[s, 3], frames[s, 4], frames[s, 5])
            R = rotation_matrix(q)
            h1, e1, h2, y2, pa1, pa2, s1, s12, s22 = innovation_rows(A, R, u, v, z, variance)
            if not everywhere(s1 + s22 <= SHORT_FORM * variance):
                return False
            prior = B
            correction, b, A, B, C, _, _, _ = rows_at_once(b, A, B, C, pa1, pa2, h1, e1, h2, y2, s1, s12, s22)
            if not everywhere(dot(correction, correction) <= 1.0):
                return False
            q, A, B, G = near_reset(q, A, B, correction)
            update_sensitivity(sensitivity, prior, G, h1, e1, h2, y2, pa1, pa2, s1, s12, s22)
    store_lanes(state, 0, q, b, A, B, C)
    return True


def least_kept_share(kept, steps, one, work):
    """Return the least of :func:`strapdown.kernels.filter_loop.least_share` over the states that were kept, one a ``CHECKED`` steps.

    ``one`` (28,) and ``work`` (7, 6) are scratch.
    """
    least = math.inf
    for k in range(steps, -1, -CHECKED):
        for i in range(WIDTH):
            for j in range(STATE):
                one[j] = kept[WIDTH * (STATE * k + j) + i]
            share = least_share(one, work)
            if not share > 0.0:
                return 0.0
            least = min(least, share)
    return least


def run_stretches(
    increments,
    first,
    steps,
    dts,
    angle_variance,
    rate_variance,
    values,
    places,
    complete,
    rows,
    variances,
    frames,
    scratch,
    state,
    kept,
    innovation_out,
    innovation_places,
    wide,
):
    """Run the filter over eight stretches of ``steps`` intervals each, one after the other from interval ``first`` on.

    All arrays but ``frames`` (sensors, 9) are flat. Intervals are in ``dts`` and variances in ``variances`` (sensors, steps, lanes).
    ``values`` holds at ``places`` the first measurement of a sensor that is ``complete``, of another the one that the table ``rows`` counts
    from. ``state`` (28 places) is left at the ends; ``kept`` (steps + 1 states) gets the states at the start of each step and at the end.
    Innovations go to ``innovation_out``, rows of ``wide`` numbers, 4 or 6, at ``innovation_places`` in the same way.

    Returns whether it came to the end: not where a step turns by more than the polynomials take, a measurement is so sharp that it wants
    Joseph's form, or it corrects by more than a radian.
    """
    lanes_of((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    w = WIDTH
    q, b, A, B, C = load_lanes(state, 0)
    for k in range(steps):
        theta = load_triples(increments, 3 * (first + k), 3 * steps)
        dt = load(dts, w * k)
        phi = combine(1.0, theta, -dt, b)
        if not everywhere(dot(phi, phi) <= _LARGEST_SQUARE):
            return False
        fetch_lanes(kept, STATE * w * (k + AHEAD))
        store_lanes(kept, STATE * w * k, q, b, A, B, C)
        q, A, B, C = predict(q, b, A, B, C, theta, dt, angle_variance, rate_variance)
        for s in range(len(places)):
            at = w * (steps * s + k)
            variance = load(variances, at)
            if not (complete[s] or anywhere(variance < PRESENT)):
                continue
            z = measured(values, places[s], complete[s], rows, at, k, steps, scratch)
            u = (frames[s, 0], frames[s, 1], frames[s, 2])
            v = (frames[s, 3], frames[s, 4], frames[s, 5])
            R = rotation_matrix(q)
            h1, e1, h2, y2, pa1, pa2, s1, s12, s22 = innovation_rows(A, R, u, v, z, variance)
            if not everywhere(s1 + s22 <= SHORT_FORM * variance):
                return False
            correction, b, A, B, C, e2, s2, _ = rows_at_once(b, A, B, C, pa1, pa2, h1, e1, h2, y2, s1, s12, s22)
            if not everywhere(dot(correction, correction) <= 1.0):
                return False
            q, A, B, _ = near_reset(q, A, B, correction)
            place = innovation_places[s]
            at_once = complete[s]
            if at_once:
                for i in range(w):
                    fetch_ahead(innovation_out, place + wide * (k + 2 * AHEAD + steps * i))
                store_quadruples(innovation_out, place + wide * k, wide * steps, (e1, s1, e2, s2))
            else:
                store_quadruples(scratch, 0, wide, (e1, s1, e2, s2))
            if wide > 4:
                # The length of a vector says nothing of the attitude, but belongs to the innovation; of a direction nobody reads it.
                r = (frames[s, 6], frames[s, 7], frames[s, 8])
                third = (e2, s2, dot(transpose_times_vector(R, r), z) - 1.0, variance)
                if at_once:
                    store_quadruples(innovation_out, place + wide * k + 2, wide * steps, third)
                else:
                    store_quadruples(scratch, 2, wide, third)
            if not at_once:
                for i in range(w):
                    row = rows[at + i]
                    if row >= 0:
                        for j in range(wide):
                            innovation_out[place + wide * row + j] = scratch[wide * i + j]
    store_lanes(kept, STATE * w * steps, q, b, A, B, C)
    store_lanes(state, 0, q, b, A, B, C)
    return True
