"""The smoother's way back over eight stretches of one record side by side: :mod:`strapdown.kernels.smoother_step` in lanes."""

from __future__ import annotations

from strapdown.kernels.algebra import (
    add,
    combine,
    dot,
    full,
    matrix_times_vector,
    multiply,
    multiply_add,
    scale,
    subtract,
    times_transpose_upper,
    times_transpose_upper_add,
    transpose,
)
from strapdown.kernels.filter_step import transition
from strapdown.kernels.lane_values import (
    WIDTH,
    everywhere,
    fetch_ahead,
    lanes_of,
    load,
    load_triples,
    store_quadruples,
    store_triples,
)
from strapdown.kernels.rotation import quaternion_multiply, right_jacobian, turned
from strapdown.kernels.series import LARGEST_ANGLE, cosine, sinc
from strapdown.kernels.smoother_step import (
    arcsine,
    kept_share,
    near_inverse_right_jacobian,
    step_noise,
)
from strapdown.kernels.stretch_lanes import (
    AHEAD,
    STATE,
    fetch_lanes,
    load_attitude,
    load_lanes,
    load_matrix,
    load_symmetric,
    load_vector,
    store_matrix,
    store_symmetric,
    store_vector,
)

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""

_LARGEST_SQUARE = LARGEST_ANGLE * LARGEST_ANGLE


def smooth_stretches(
    increments,
    first,
    steps,
    dts,
    angle_variance,
    rate_variance,
    kept,
    smoothed,
    attitude_out,
    bias_out,
    variance_out,
    covariance_out,
):
    """Smooth eight stretches from their ends to their starts; return whether it came there.

    ``kept`` is what :func:`strapdown.kernels.stretch_loop.run_stretches` kept. ``smoothed`` (27 places) holds the smoothed error of the
    state at the ends and its covariance, (ε, β, A, B, C), and is left at those of the starts. Row ``first + k`` of the outputs, all flat,
    is that of the start of step k of the first stretch; ``covariance_out`` may be empty. It stops at an error beyond the polynomials.
    """
    lanes_of((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    w = WIDTH
    next_q = load_attitude(kept, STATE * w * steps)
    next_b = load_vector(kept, (STATE * steps + 4) * w)
    e = load_vector(smoothed, 0)
    beta = load_vector(smoothed, 3 * w)
    Ps = load_symmetric(smoothed, 6 * w)
    Pb = load_matrix(smoothed, 12 * w)
    Pc = load_symmetric(smoothed, 21 * w)
    for k in range(steps - 1, -1, -1):
        fetch_lanes(kept, STATE * w * (k - AHEAD))
        for i in range(w):
            ahead = first + k - 2 * AHEAD + steps * i
            fetch_ahead(attitude_out, 4 * ahead)
            fetch_ahead(bias_out, 3 * ahead)
            fetch_ahead(variance_out, 6 * ahead)
            fetch_ahead(increments, 3 * ahead)
        q, b, A, B, C = load_lanes(kept, STATE * w * k)
        dt = load(dts, w * k)
        phi = combine(1.0, load_triples(increments, 3 * (first + k), 3 * steps), -dt, b)
        x = dot(e, e)
        if not everywhere(x <= _LARGEST_SQUARE):
            return False
        # Seen from the predicted state: a = Log(r ⊗ exp(ε)), of which the filter's own corrections are the larger part.
        p = turned(q, phi)
        r = quaternion_multiply((p[0], -p[1], -p[2], -p[3]), next_q)
        h = 0.5 * sinc(0.25 * x)
        u = quaternion_multiply(r, (cosine(0.25 * x), h * e[0], h * e[1], h * e[2]))
        v = (u[1], u[2], u[3])
        squared = dot(v, v)
        if not everywhere(squared <= 0.25 * _LARGEST_SQUARE):
            return False
        a = scale(2.0 * arcsine(squared), v)
        J = multiply(near_inverse_right_jacobian(a), right_jacobian(e))
        d = add(subtract(next_b, b), beta)
        q11, q12, q22 = step_noise(phi, dt, angle_variance, rate_variance)
        n_tt, n_tb, n_bt, n_bb = kept_share(A, B, C, q11, q12, q22)
        # (ε, β) ← N F (a, d) and P_s ← N (F P_s Fᵀ Nᵀ + Q̄) for F = Φ⁻¹ diag(J, I): that is G P_s Gᵀ + D, of which D = N Q̄.
        back, slip = transition(scale(-1.0, phi), -dt)
        t = add(matrix_times_vector(back, a), matrix_times_vector(slip, d))
        e = add(matrix_times_vector(n_tt, t), matrix_times_vector(n_tb, d))
        beta = add(matrix_times_vector(n_bt, t), matrix_times_vector(n_bb, d))
        back = multiply(back, J)
        x_tb = multiply_add(back, Pb, multiply(slip, full(Pc)))
        x_tt = multiply_add(back, full(Ps), multiply(slip, transpose(Pb)))
        x_tt = full(times_transpose_upper_add(x_tt, back, times_transpose_upper(x_tb, slip)))
        # Z = X Nᵀ + Q̄ by blocks, X = F P_s Fᵀ.
        x_bt, x_bb = transpose(x_tb), full(Pc)
        t_tt, t_tb, t_bt, t_bb = transpose(n_tt), transpose(n_tb), transpose(n_bt), transpose(n_bb)
        z_tt = multiply_add(x_tt, t_tt, multiply_add(x_tb, t_tb, full(q11)))
        z_tb = multiply_add(x_tt, t_bt, multiply_add(x_tb, t_bb, q12))
        z_bt = multiply_add(x_bt, t_tt, multiply_add(x_bb, t_tb, transpose(q12)))
        z_bb = multiply_add(x_bt, t_bt, multiply_add(x_bb, t_bb, (q22, 0.0, 0.0, 0.0, q22, 0.0, 0.0, 0.0, q22)))
        Ps = times_transpose_upper_add(n_tt, transpose(z_tt), times_transpose_upper(n_tb, transpose(z_bt)))
        Pb = multiply_add(n_tt, z_tb, multiply(n_tb, z_bb))
        Pc = times_transpose_upper_add(n_bt, transpose(z_tb), times_transpose_upper(n_bb, transpose(z_bb)))
        M = right_jacobian(e)
        S = times_transpose_upper(multiply(M, full(Ps)), M)
        row = first + k
        store_quadruples(attitude_out, 4 * row, 4 * steps, turned(q, e))
        store_triples(bias_out, 3 * row, 3 * steps, add(b, beta))
        store_quadruples(variance_out, 6 * row, 6 * steps, (S[0], S[3], S[5], Pc[0]))
        store_quadruples(variance_out, 6 * row + 2, 6 * steps, (S[5], Pc[0], Pc[3], Pc[5]))
        if len(covariance_out) > 0:
            V = multiply(M, Pb)
            place = 21 * row
            store_triples(covariance_out, place, 21 * steps, (S[0], S[1], S[2]))
            store_triples(covariance_out, place + 3, 21 * steps, (S[3], S[4], S[5]))
            store_triples(covariance_out, place + 6, 21 * steps, (V[0], V[1], V[2]))
            store_triples(covariance_out, place + 9, 21 * steps, (V[3], V[4], V[5]))
            store_triples(covariance_out, place + 12, 21 * steps, (V[6], V[7], V[8]))
            store_triples(covariance_out, place + 15, 21 * steps, (Pc[0], Pc[1], Pc[2]))
            store_triples(covariance_out, place + 18, 21 * steps, (Pc[3], Pc[4], Pc[5]))
        next_q = q
        next_b = b
    store_vector(smoothed, 0, e)
    store_vector(smoothed, 3 * w, beta)
    store_symmetric(smoothed, 6 * w, Ps)
    store_matrix(smoothed, 12 * w, Pb)
    store_symmetric(smoothed, 21 * w, Pc)
    return True
