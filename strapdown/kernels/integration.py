"""Record loops of gyro integration: increments to rotation vectors, rotation vectors and step quaternions to attitude.

One accumulator serves every algorithm. Arrays are preallocated by the caller; where speed counts they are flat (``a.reshape(-1)``).

A chain of quaternion products is limited by latency, about 16 cycles per product, enough for some three hundred multiplications. A block is
therefore divided into ``WIDTH`` segments of equal length, processed together, one per lane, each starting from the identity. The attitudes
at their starts are the products of the segments' ends; each lane's products are then multiplied by its start. A step needs one more
product; the number of roundings is that of a single chain plus eight per block, and the order of operations does not depend on the CPU.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import add, combine, cross, dot
from strapdown.kernels.lane_values import (
    WIDTH,
    any_lane,
    broadcast,
    load_quadruples,
    load_triples,
    select,
    store_quadruples,
)
from strapdown.kernels.measurement import vector_at
from strapdown.kernels.rotation import exponential, quaternion_multiply, renormalized
from strapdown.kernels.series import SQUARED_RANGE
from strapdown.kernels.state import load_quaternion, store_several

SEGMENT = 48
"""Maximum number of steps of a lane in a block."""

BLOCK = WIDTH * SEGMENT
"""Maximum number of steps of a block; the attitude is normalised at its end, when its norm is within that number of roundings of one."""

FEWEST = 4 * WIDTH
"""Minimum number of steps for lanes; fewer are processed in one chain."""

WORK = 4 * (BLOCK + WIDTH) + WIDTH
"""Length of the work space: products and starts of the lanes, and alignment to a cache line."""


def large_exponential(phi):
    """Return exp(φ) of any rotation vector, by repeated halving, series and squaring; NaN if |φ|² is not finite."""
    halvings = 0
    s = 1.0
    x = dot(phi, phi)
    while SQUARED_RANGE < x < math.inf:
        x *= 0.25
        s *= 0.5
        halvings += 1
    q = exponential((s * phi[0], s * phi[1], s * phi[2]))
    for _ in range(halvings):
        q = renormalized(quaternion_multiply(q, q))
    return q


def accumulate_vectors(vectors, initial, work, attitude):
    """Write q_fb after each step into ``attitude`` (m + 1, 4) from the body rotation vectors (m, 3) of the steps.

    The arrays are flat; ``work`` has ``WORK`` numbers. A rotation vector that is not finite makes every later row NaN.
    """
    q = (initial[0], initial[1], initial[2], initial[3])
    attitude[0], attitude[1], attitude[2], attitude[3] = q
    # Aligned to a cache line (saves a fifth of the time). Not in a function: kernels must not return arrays.
    work = work[-(work.ctypes.data // 8) % WIDTH :]
    m = len(vectors) // 3
    start = 0
    while m - start >= FEWEST:
        length = min(SEGMENT, (m - start) // WIDTH)
        multiply_exponentials(vectors, start, length, work)
        q = turn_segments(q, start, length, work, attitude)
        start += WIDTH * length
    for k in range(start, m):
        q = quaternion_multiply(q, large_exponential((vectors[3 * k], vectors[3 * k + 1], vectors[3 * k + 2])))
        write_row(attitude, k + 1, q)


def accumulate_quaternions(steps, initial, work, attitude):
    """Write q_fb after each step into ``attitude`` (m + 1, 4) from the step quaternions (m, 4); otherwise as accumulate_vectors."""
    q = (initial[0], initial[1], initial[2], initial[3])
    attitude[0], attitude[1], attitude[2], attitude[3] = q
    # Aligned to a cache line (saves a fifth of the time). Not in a function: kernels must not return arrays.
    work = work[-(work.ctypes.data // 8) % WIDTH :]
    m = len(steps) // 4
    start = 0
    while m - start >= FEWEST:
        length = min(SEGMENT, (m - start) // WIDTH)
        multiply_quaternions(steps, start, length, work)
        q = turn_segments(q, start, length, work, attitude)
        start += WIDTH * length
    for k in range(start, m):
        q = quaternion_multiply(q, (steps[4 * k], steps[4 * k + 1], steps[4 * k + 2], steps[4 * k + 3]))
        write_row(attitude, k + 1, q)


def write_row(attitude, k, q):
    """Write one row, renormalised by one Newton step, off the chain of products."""
    for i, value in enumerate(renormalized(q)):
        attitude[4 * k + i] = value


def multiply_exponentials(vectors, start, length, work):
    """Write the running products of exp(φ) in each lane's segment; lane i begins at row ``start`` + i ``length``."""
    p = (broadcast(1.0), broadcast(0.0), broadcast(0.0), broadcast(0.0))
    largest = broadcast(0.0)
    for k in range(length):
        phi = load_triples(vectors, 3 * (start + k), 3 * length)
        x = dot(phi, phi)
        largest = select(x > largest, x, largest)
        p = quaternion_multiply(p, exponential(phi))
        store_several(work, 4 * WIDTH * k, p)
    if any_lane(largest > SQUARED_RANGE):
        multiply_large_exponentials(vectors, start, length, work)


def multiply_large_exponentials(vectors, start, length, work):
    """Do what multiply_exponentials does for rotation vectors of any size."""
    p = (broadcast(1.0), broadcast(0.0), broadcast(0.0), broadcast(0.0))
    for k in range(length):
        for i in range(WIDTH):
            row = 3 * (start + k + i * length)
            write_lane(work, 4 * BLOCK, i, large_exponential((vectors[row], vectors[row + 1], vectors[row + 2])))
        p = quaternion_multiply(p, load_quaternion(work, 4 * BLOCK))
        store_several(work, 4 * WIDTH * k, p)


def multiply_quaternions(steps, start, length, work):
    """Write the running products in each lane's segment; lane i begins at row ``start`` + i ``length``."""
    p = (broadcast(1.0), broadcast(0.0), broadcast(0.0), broadcast(0.0))
    for k in range(length):
        p = quaternion_multiply(p, load_quadruples(steps, 4 * (start + k), 4 * length))
        store_several(work, 4 * WIDTH * k, p)


def turn_segments(q, start, length, work, attitude):
    """Write the rows of a block: q times the segments before, times the lane's product, renormalised; return the last, renormalised."""
    ends = 4 * WIDTH * (length - 1)
    for i in range(WIDTH):
        write_lane(work, 4 * BLOCK, i, q)
        q = quaternion_multiply(
            q, (work[ends + i], work[ends + WIDTH + i], work[ends + 2 * WIDTH + i], work[ends + 3 * WIDTH + i])
        )
    starts = load_quaternion(work, 4 * BLOCK)
    for k in range(length):
        rows = renormalized(quaternion_multiply(starts, load_quaternion(work, 4 * WIDTH * k)))
        store_quadruples(attitude, 4 * (start + k + 1), 4 * length, rows)
    return renormalized(q)


def write_lane(work, place, i, q):
    """Write a quaternion into lane i of the four values at ``place``."""
    work[place + i] = q[0]
    work[place + WIDTH + i] = q[1]
    work[place + 2 * WIDTH + i] = q[2]
    work[place + 3 * WIDTH + i] = q[3]


def compressed_vectors(increments, coefficients, samples, vectors):
    """Write the rotation vectors φ = Σ Δθ_i + (Σ_j k_j Δθ_{N−j}) × Δθ_N of all steps into ``vectors`` (m, 3); both arrays are flat.

    ``coefficients`` holds k_1 … k_{N−1+p}. Steps with fewer than p samples before them take the mirror image in time,
    Δθ_1 × Σ_j k_j Δθ_{1+j}, and look ahead instead: the record has N + 2p samples or more.
    """
    reach = len(coefficients) + 1
    for k in range(len(vectors) // 3):
        first = k * samples
        if first + samples >= reach:
            anchor = 3 * (first + samples - 1)
            stride = -3
            sign = 1.0
        else:
            anchor = 3 * first
            stride = 3
            sign = -1.0
        end = (increments[anchor], increments[anchor + 1], increments[anchor + 2])
        phi = end
        others = (0.0, 0.0, 0.0)
        row = anchor
        for j in range(samples - 1):
            row += stride
            increment = (increments[row], increments[row + 1], increments[row + 2])
            phi = add(phi, increment)
            others = combine(1.0, others, coefficients[j], increment)
        for j in range(samples - 1, reach - 1):
            row += stride
            increment = (increments[row], increments[row + 1], increments[row + 2])
            others = combine(1.0, others, coefficients[j], increment)
        phi = combine(1.0, phi, sign, cross(others, end))
        vectors[3 * k] = phi[0]
        vectors[3 * k + 1] = phi[1]
        vectors[3 * k + 2] = phi[2]


def pair_vectors(increments, samples, previous, tables, vectors):
    """Write the rotation vectors φ = Σ Δθ_i + Σ_{i<j} K_ij Δθ_i × Δθ_j of all steps, Σ Δθ_i over the step, the products over its window.

    ``tables`` (M − N + 1, M, M) holds K by the place of the step in the window of M increments. Near the ends of the record the window
    stays inside it and the step sits elsewhere in the window than at ``previous``.
    """
    latest = len(increments) - tables.shape[1]
    for k in range(len(vectors)):
        first = k * samples
        start = min(max(first - previous, 0), latest)
        phi = pair_correction(increments, start, tables[first - start])
        for i in range(first, first + samples):
            phi = add(phi, vector_at(increments, i))
        vectors[k, 0], vectors[k, 1], vectors[k, 2] = phi


def pair_correction(increments, first, pairs):
    """Return Σ_{i<j} K_ij Δθ_i × Δθ_j over the window that starts at row ``first``."""
    total = (0.0, 0.0, 0.0)
    for j in range(1, len(pairs)):
        before = (0.0, 0.0, 0.0)
        for i in range(j):
            before = combine(1.0, before, pairs[i, j], vector_at(increments, first + i))
        total = add(total, cross(before, vector_at(increments, first + j)))
    return total
