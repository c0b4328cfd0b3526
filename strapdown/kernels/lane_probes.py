"""Loops that measure the machine and the lanes' filter by itself; ``benchmarks/montecarlo.py`` runs them."""

from __future__ import annotations

import numpy as np

from strapdown.kernels.filter_step import predict, update_direction_and_judge
from strapdown.kernels.lane_values import flush_tiny, lanes_of, load_like, restore_mode, store_like
from strapdown.kernels.montecarlo_run import next_four
from strapdown.kernels.noise import stream_state
from strapdown.kernels.rotation import rotation_matrix

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""

FUSED = 10
"""Independent fused multiply-adds of :func:`peak` in each turn: enough to hide their latency."""


def peak(pattern, x, turns):
    """Do so many turns of independent fused multiply-adds."""
    like = lanes_of(pattern)
    a = load_like(x, 0, like)
    c = a * 1e-9
    b, d, e, f, g, h, i, j, k = a + 1.0, a + 2.0, a + 3.0, a + 4.0, a + 5.0, a + 6.0, a + 7.0, a + 8.0, a + 9.0
    for _ in range(turns):
        a = a * c + a
        b = b * c + b
        d = d * c + d
        e = e * c + e
        f = f * c + f
        g = g * c + g
        h = h * c + h
        i = i * c + i
        j = j * c + j
        k = k * c + k
    store_like(x, 0, a + b + d + e + f + g + h + i + j + k)


def normals(pattern, numbers, out):
    """Fill out (flat) with normals of the streams of these runs."""
    like = lanes_of(pattern)
    n = len(like)
    s0, s1, s2, s3 = stream_state(np.uint64(1), np.uint64(2), load_like(numbers, 0, like))
    for at in range(0, len(out), 4 * n):
        x, y, s0, s1, s2, s3 = next_four(s0, s1, s2, s3)
        store_like(out, at, x)
        store_like(out, at + 2 * n, y)


def steps(pattern, state, inputs, number):
    """Predict and update so many times; ``state`` is 28 rows of lanes, ``inputs`` 3: an increment, and what a direction is off by."""
    like = lanes_of(pattern)
    n = len(like)
    mode = flush_tiny(like)
    q = (
        load_like(state, 0, like),
        load_like(state, n, like),
        load_like(state, 2 * n, like),
        load_like(state, 3 * n, like),
    )
    b = (like, like, like)
    A = (
        load_like(state, 7 * n, like),
        like,
        like,
        load_like(state, 10 * n, like),
        like,
        load_like(state, 12 * n, like),
    )
    B = (like, like, like, like, like, like, like, like, like)
    C = (
        load_like(state, 22 * n, like),
        like,
        like,
        load_like(state, 25 * n, like),
        like,
        load_like(state, 27 * n, like),
    )
    nis = like
    for _ in range(number):
        turn = (load_like(inputs, 0, like), load_like(inputs, n, like), load_like(inputs, 2 * n, like))
        q, A, B, C = predict(q, b, A, B, C, turn, 0.01, 1e-8, 1e-12)
        R = rotation_matrix(q)
        z = (R[6] + turn[0], R[7] + turn[1], R[8] + turn[2])
        q, b, A, B, C, _, _, _, _, chi = update_direction_and_judge(
            q, b, A, B, C, R, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), z, 1e-4
        )
        nis = nis + chi
    store_like(state, 0, q[0] + q[1] + q[2] + q[3])
    store_like(state, n, b[0] + b[1] + b[2])
    store_like(state, 2 * n, A[0] + A[1] + A[2] + A[3] + A[4] + A[5] + nis)
    store_like(state, 3 * n, B[0] + B[1] + B[2] + B[3] + B[4] + B[5] + B[6] + B[7] + B[8])
    store_like(state, 4 * n, C[0] + C[1] + C[2] + C[3] + C[4] + C[5])
    restore_mode(mode)
