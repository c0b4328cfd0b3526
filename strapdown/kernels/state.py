"""A state (q, b, A, B, C) as 28 numbers: attitude, bias, and the blocks of the covariance, of one filter or of one a lane."""

from __future__ import annotations

from strapdown.kernels.lane_values import WIDTH, load, store

SIZE = 28


def load_state(row):
    """Return (q, b, A, B, C) of 28 numbers."""
    return (
        (row[0], row[1], row[2], row[3]),
        (row[4], row[5], row[6]),
        (row[7], row[8], row[9], row[10], row[11], row[12]),
        (row[13], row[14], row[15], row[16], row[17], row[18], row[19], row[20], row[21]),
        (row[22], row[23], row[24], row[25], row[26], row[27]),
    )


def store_state(row, q, b, A, B, C):
    """Write (q, b, A, B, C) to 28 numbers."""
    for i in range(4):
        row[i] = q[i]
    for i in range(3):
        row[4 + i] = b[i]
    for i in range(6):
        row[7 + i] = A[i]
        row[22 + i] = C[i]
    for i in range(9):
        row[13 + i] = B[i]


def keep_state(out, row, q, b, A, B, C):
    """Write a state to a row of the outputs: attitude, bias, variances, and the blocks of the covariance where there is room."""
    out.attitude[row, 0], out.attitude[row, 1], out.attitude[row, 2], out.attitude[row, 3] = q
    out.bias[row, 0], out.bias[row, 1], out.bias[row, 2] = b
    out.variance[row, 0], out.variance[row, 1], out.variance[row, 2] = A[0], A[3], A[5]
    out.variance[row, 3], out.variance[row, 4], out.variance[row, 5] = C[0], C[3], C[5]
    if row < len(out.covariance):
        for i in range(6):
            out.covariance[row, i] = A[i]
            out.covariance[row, 15 + i] = C[i]
        for i in range(9):
            out.covariance[row, 6 + i] = B[i]


def load_lane(array, start, i):
    """Return number i of the state in lanes from ``array[start]`` on."""
    return load(array, start + i * WIDTH)


def load_lanes(array, start):
    """Return (q, b, A, B, C) in lanes from 28 times ``WIDTH`` numbers."""
    a, s = array, start
    return (
        (load_lane(a, s, 0), load_lane(a, s, 1), load_lane(a, s, 2), load_lane(a, s, 3)),
        (load_lane(a, s, 4), load_lane(a, s, 5), load_lane(a, s, 6)),
        (
            load_lane(a, s, 7),
            load_lane(a, s, 8),
            load_lane(a, s, 9),
            load_lane(a, s, 10),
            load_lane(a, s, 11),
            load_lane(a, s, 12),
        ),
        (
            load_lane(a, s, 13),
            load_lane(a, s, 14),
            load_lane(a, s, 15),
            load_lane(a, s, 16),
            load_lane(a, s, 17),
            load_lane(a, s, 18),
            load_lane(a, s, 19),
            load_lane(a, s, 20),
            load_lane(a, s, 21),
        ),
        (
            load_lane(a, s, 22),
            load_lane(a, s, 23),
            load_lane(a, s, 24),
            load_lane(a, s, 25),
            load_lane(a, s, 26),
            load_lane(a, s, 27),
        ),
    )


def store_lanes(array, start, q, b, A, B, C):
    """Write (q, b, A, B, C) in lanes to 28 times ``WIDTH`` numbers."""
    for i in range(4):
        store(array, start + i * WIDTH, q[i])
    for i in range(3):
        store(array, start + (4 + i) * WIDTH, b[i])
    for i in range(6):
        store(array, start + (7 + i) * WIDTH, A[i])
        store(array, start + (22 + i) * WIDTH, C[i])
    for i in range(9):
        store(array, start + (13 + i) * WIDTH, B[i])
