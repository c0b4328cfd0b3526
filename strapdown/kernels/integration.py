"""Record loops of gyro integration: increments to rotation vectors, rotation vectors and step quaternions to attitude.

One accumulator serves every algorithm. Arrays are preallocated by the caller; where speed counts they are flat (``a.reshape(-1)``).
"""

from __future__ import annotations

from strapdown.kernels.algebra import add, combine, cross, dot
from strapdown.kernels.rotation import exponential, quaternion_multiply, renormalized
from strapdown.kernels.series import LARGEST_ANGLE

BLOCK = 192
"""Steps between two renormalisations of the running attitude: its norm is then still within 192 roundings of one."""

_LARGEST_SQUARE = LARGEST_ANGLE * LARGEST_ANGLE


def large_exponential(phi):
    """Return exp(φ) of any rotation vector: halved until the series holds, then squared as often."""
    halvings = 0
    s = 1.0
    x = dot(phi, phi)
    while x > _LARGEST_SQUARE:
        x *= 0.25
        s *= 0.5
        halvings += 1
    q = exponential((s * phi[0], s * phi[1], s * phi[2]))
    for _ in range(halvings):
        q = renormalized(quaternion_multiply(q, q))
    return q


def accumulate_vectors(vectors, initial, w, x, y, z, attitude):
    """Write q_fb after each step into ``attitude`` (m + 1, 4) from the body rotation vectors (m, 3) of the steps.

    Block by block: the exponentials, which vectorise; the chain of products, which cannot, and takes most of the time; the rows,
    renormalised by one Newton step each, off the chain. The chain itself is renormalised once a block.

    The arrays are flat and cut to the block, so that the compiler knows strides and lengths; w, x, y, z (``BLOCK``) are work.
    """
    q = (initial[0], initial[1], initial[2], initial[3])
    attitude[0], attitude[1], attitude[2], attitude[3] = q
    m = len(vectors) // 3
    for start in range(0, m, BLOCK):
        end = min(start + BLOCK, m)
        exponentials(vectors[3 * start : 3 * end], w[: end - start], x, y, z)
        q = products(q, w[: end - start], x, y, z)
        rows(w[: end - start], x, y, z, attitude[4 * start + 4 : 4 * end + 4])


def accumulate_quaternions(steps, initial, w, x, y, z, attitude):
    """Write q_fb after each step into ``attitude`` (m + 1, 4) from the step quaternions (m, 4); otherwise as accumulate_vectors."""
    q = (initial[0], initial[1], initial[2], initial[3])
    attitude[0], attitude[1], attitude[2], attitude[3] = q
    m = len(steps) // 4
    for start in range(0, m, BLOCK):
        end = min(start + BLOCK, m)
        columns(steps[4 * start : 4 * end], w[: end - start], x, y, z)
        q = products(q, w[: end - start], x, y, z)
        rows(w[: end - start], x, y, z, attitude[4 * start + 4 : 4 * end + 4])


def exponentials(vectors, w, x, y, z):
    """Write exp(φ) of a block of rotation vectors."""
    large = 0
    for k in range(len(w)):
        phi = (vectors[3 * k], vectors[3 * k + 1], vectors[3 * k + 2])
        large += 1 if dot(phi, phi) > _LARGEST_SQUARE else 0
        q = exponential(phi)
        w[k] = q[0]
        x[k] = q[1]
        y[k] = q[2]
        z[k] = q[3]
    if large:
        for k in range(len(w)):
            w[k], x[k], y[k], z[k] = large_exponential((vectors[3 * k], vectors[3 * k + 1], vectors[3 * k + 2]))


def columns(steps, w, x, y, z):
    """Write a block of quaternions by component."""
    for k in range(len(w)):
        w[k] = steps[4 * k]
        x[k] = steps[4 * k + 1]
        y[k] = steps[4 * k + 2]
        z[k] = steps[4 * k + 3]


def products(q, w, x, y, z):
    """Replace each step of a block by the product of q and all steps up to it; return the last, renormalised.

    A product waits for the one before it, about 16 cycles. So the block is cut in three: three chains run at once, and the second and
    the third are then multiplied by the ends of those before them, which vectorises.
    """
    third = len(w) // 3
    middle = (1.0, 0.0, 0.0, 0.0)
    late = (1.0, 0.0, 0.0, 0.0)
    for k in range(third):
        i = k + third
        j = i + third
        q = quaternion_multiply(q, (w[k], x[k], y[k], z[k]))
        middle = quaternion_multiply(middle, (w[i], x[i], y[i], z[i]))
        late = quaternion_multiply(late, (w[j], x[j], y[j], z[j]))
        w[k] = q[0]
        x[k] = q[1]
        y[k] = q[2]
        z[k] = q[3]
        w[i] = middle[0]
        x[i] = middle[1]
        y[i] = middle[2]
        z[i] = middle[3]
        w[j] = late[0]
        x[j] = late[1]
        y[j] = late[2]
        z[j] = late[3]
    middle = quaternion_multiply(q, middle)
    multiply_block(q, w[third : 2 * third], x[third : 2 * third], y[third : 2 * third], z[third : 2 * third])
    multiply_block(
        middle, w[2 * third : 3 * third], x[2 * third : 3 * third], y[2 * third : 3 * third], z[2 * third : 3 * third]
    )
    q = quaternion_multiply(middle, late)
    for k in range(3 * third, len(w)):
        q = quaternion_multiply(q, (w[k], x[k], y[k], z[k]))
        w[k] = q[0]
        x[k] = q[1]
        y[k] = q[2]
        z[k] = q[3]
    return renormalized(q)


def multiply_block(q, w, x, y, z):
    """Replace each quaternion of a block by q times it."""
    for k in range(len(w)):
        p = quaternion_multiply(q, (w[k], x[k], y[k], z[k]))
        w[k] = p[0]
        x[k] = p[1]
        y[k] = p[2]
        z[k] = p[3]


def rows(w, x, y, z, attitude):
    """Write a block of quaternions by row, renormalised."""
    for k in range(len(w)):
        q = renormalized((w[k], x[k], y[k], z[k]))
        attitude[4 * k] = q[0]
        attitude[4 * k + 1] = q[1]
        attitude[4 * k + 2] = q[2]
        attitude[4 * k + 3] = q[3]


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


def one_sample_vectors(increments, coefficients, vectors):
    """Do what compressed_vectors does for steps of one sample, faster: each lag is one pass over flat arrays, block by block."""
    reach = len(coefficients)
    compressed_vectors(increments[: 6 * reach], coefficients, 1, vectors[: 3 * reach])
    for start in range(3 * reach, len(vectors), 3 * BLOCK):
        end = min(start + 3 * BLOCK, len(vectors))
        newest = increments[start:end]
        others = vectors[start:end]
        others[:] = 0.0
        for j in range(reach):
            add_scaled(coefficients[j], increments[start - 3 * (j + 1) : end - 3 * (j + 1)], others)
        for k in range(len(others) // 3):
            row = 3 * k
            x = newest[row]
            y = newest[row + 1]
            z = newest[row + 2]
            a = others[row]
            b = others[row + 1]
            c = others[row + 2]
            others[row] = x + (b * z - c * y)
            others[row + 1] = y + (c * x - a * z)
            others[row + 2] = z + (a * y - b * x)


def add_scaled(s, a, b):
    """Add s a to b."""
    for i in range(len(b)):
        b[i] += s * a[i]


def pair_vectors(increments, pairs, vectors):
    """Write the rotation vectors φ = Σ Δθ_i + Σ_{i<j} K_ij Δθ_i × Δθ_j of all steps of N = len(``pairs``) samples."""
    samples = len(pairs)
    for k in range(len(vectors)):
        first = k * samples
        phi = pair_correction(increments, first, pairs)
        x, y, z = phi
        for i in range(first, first + samples):
            x += increments[i, 0]
            y += increments[i, 1]
            z += increments[i, 2]
        vectors[k, 0] = x
        vectors[k, 1] = y
        vectors[k, 2] = z


def pair_correction(increments, first, pairs):
    """Return Σ_{i<j} K_ij Δθ_i × Δθ_j over the window that starts at row ``first``."""
    x = 0.0
    y = 0.0
    z = 0.0
    for j in range(1, len(pairs)):
        a = 0.0
        b = 0.0
        c = 0.0
        for i in range(j):
            s = pairs[i, j]
            a += s * increments[first + i, 0]
            b += s * increments[first + i, 1]
            c += s * increments[first + i, 2]
        last = first + j
        part = cross((a, b, c), (increments[last, 0], increments[last, 1], increments[last, 2]))
        x += part[0]
        y += part[1]
        z += part[2]
    return (x, y, z)
