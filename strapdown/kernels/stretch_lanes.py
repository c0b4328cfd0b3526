"""What the passes over eight stretches of one record share: lanes in memory, and the measurements of a step.

Vectors and matrices lie component by component, eight lanes each, in the order of :func:`strapdown.kernels.filter_loop.store_state`. A
sensor that measured at the end of every step is read in place; of another a table tells for each step and lane the row of its
measurement, −1 for none, whose variance is then :data:`ABSENT`: so large that the update moves nothing by a bit.
"""

from __future__ import annotations

from strapdown.kernels.lane_values import WIDTH, element, fetch_ahead, load, load_triples, store

BORROWS_ARRAYS = True
"""See :mod:`strapdown.kernels.machine`."""

ABSENT = 1e150
"""Variance of a measurement that is not there."""
PRESENT = 1e140
"""One below this is there."""
STATE = 28
"""Numbers of a state."""
J, ETA = 36, 57
"""Where in a sensitivity J (21) and η (6) stand, after Ψ (36)."""
AHEAD = 4
"""Steps that memory is fetched ahead. The machine does so by itself for fewer streams, and not beyond a page, which is two states."""


def load_vector(memory, place):
    """Return three neighbouring places, a 3-vector."""
    w = WIDTH
    return (load(memory, place), load(memory, place + w), load(memory, place + 2 * w))


def store_vector(memory, place, v):
    """Write what :func:`load_vector` reads."""
    w = WIDTH
    store(memory, place, v[0])
    store(memory, place + w, v[1])
    store(memory, place + 2 * w, v[2])


def load_symmetric(memory, place):
    """Return six neighbouring places, the upper triangle of a symmetric matrix."""
    a = load_vector(memory, place)
    b = load_vector(memory, place + 3 * WIDTH)
    return (a[0], a[1], a[2], b[0], b[1], b[2])


def store_symmetric(memory, place, S):
    """Write what :func:`load_symmetric` reads."""
    store_vector(memory, place, (S[0], S[1], S[2]))
    store_vector(memory, place + 3 * WIDTH, (S[3], S[4], S[5]))


def load_matrix(memory, place):
    """Return nine neighbouring places, a matrix by rows."""
    w = WIDTH
    a = load_vector(memory, place)
    b = load_vector(memory, place + 3 * w)
    c = load_vector(memory, place + 6 * w)
    return (a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2])


def store_matrix(memory, place, M):
    """Write what :func:`load_matrix` reads."""
    w = WIDTH
    store_vector(memory, place, (M[0], M[1], M[2]))
    store_vector(memory, place + 3 * w, (M[3], M[4], M[5]))
    store_vector(memory, place + 6 * w, (M[6], M[7], M[8]))


def load_attitude(memory, place):
    """Return four neighbouring places, a quaternion."""
    x, y, z = load_vector(memory, place + WIDTH)
    return (load(memory, place), x, y, z)


def load_lanes(memory, place):
    """Return (q, b, A, B, C) of eight stretches."""
    w = WIDTH
    return (
        load_attitude(memory, place),
        load_vector(memory, place + 4 * w),
        load_symmetric(memory, place + 7 * w),
        load_matrix(memory, place + 13 * w),
        load_symmetric(memory, place + 22 * w),
    )


def store_lanes(memory, place, q, b, A, B, C):
    """Write what :func:`load_lanes` reads."""
    w = WIDTH
    store(memory, place, q[0])
    store_vector(memory, place + w, (q[1], q[2], q[3]))
    store_vector(memory, place + 4 * w, b)
    store_symmetric(memory, place + 7 * w, A)
    store_matrix(memory, place + 13 * w, B)
    store_symmetric(memory, place + 22 * w, C)


def fetch_lanes(memory, place):
    """Have a state fetched that is wanted soon."""
    for i in range(STATE):
        fetch_ahead(memory, place + WIDTH * i)


def gathered(values, place, rows, at, scratch):
    """Return the 3-vectors of the rows that stand in the table from ``at`` on; for none any row."""
    for i in range(WIDTH):
        row = place + 3 * max(rows[at + i], 0)
        for j in range(3):
            scratch[3 * i + j] = element(values, row + j)
    return load_triples(scratch, 0, 3)


def measured(values, place, complete, rows, at, k, steps, scratch):
    """Return the 3-vectors that a sensor measured at the end of step k of each stretch; ``at`` is where those stand in the table."""
    if complete:
        return load_triples(values, place + 3 * k, 3 * steps)
    return gathered(values, place, rows, at, scratch)
