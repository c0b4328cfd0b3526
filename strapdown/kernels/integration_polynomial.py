"""Solution of q̇ = ½ q ⊗ w for a rate polynomial: to rounding by a power series, or by the Magnus expansion."""

from __future__ import annotations

from strapdown.kernels.algebra import (
    add,
    add_matrices,
    combine,
    combine_matrices,
    cross,
    scale_matrix,
)
from strapdown.kernels.integration import large_exponential, pair_correction
from strapdown.kernels.measurement import quaternion_at, vector_at
from strapdown.kernels.rotation import quaternion_multiply, renormalized
from strapdown.kernels.state import store_row

NEGLIGIBLE = 2.0**-56
"""rad; powers of the rate with a smaller total angle are omitted, and the series ends when the remaining terms are below this."""

LARGEST_RATE = 4.0
"""Maximum bound of the polynomial's rate, rad per sample interval; above it the polynomial does not describe the motion."""

TERMS_PER_SAMPLE = 2
"""With ``EXTRA_TERMS``, the maximum length of the power series; data for which it is not sufficient are too rough for the polynomial."""

EXTRA_TERMS = 24
"""At a constant rate of ``LARGEST_RATE`` the terms decrease as 1/n!, to below rounding at n = 18."""


def quaternion_times_vector(q, v):
    """Return q ⊗ (0, v)."""
    return (
        -q[1] * v[0] - q[2] * v[1] - q[3] * v[2],
        q[0] * v[0] + q[2] * v[2] - q[3] * v[1],
        q[0] * v[1] + q[3] * v[0] - q[1] * v[2],
        q[0] * v[2] + q[1] * v[1] - q[2] * v[0],
    )


def fitted_rates(increments, first, fit, rates):
    """Write the powers of s of the rate polynomial through the window from row ``first`` on; return (bound of the rate, powers kept).

    ``fit`` (M, M) holds, for each increment, its weights in the powers; ``rates`` is (4, M): by axis, and then the sum of the bounds of
    this power and all higher ones.
    """
    window = len(fit)
    for m in range(window):
        rates[0, m], rates[1, m], rates[2, m] = 0.0, 0.0, 0.0
    for j in range(window):
        x, y, z = vector_at(increments, first + j)
        for m in range(window):
            rates[0, m] += fit[j, m] * x
            rates[1, m] += fit[j, m] * y
            rates[2, m] += fit[j, m] * z
    return sized(rates, window)


def sized(rates, window):
    """Write the sums of the bounds of each power and all higher ones; return (bound of the rate over |s| ≤ ½, powers kept)."""
    bound = 0.0
    kept = 1
    power = 0.5 ** (window - 1)
    for m in range(window - 1, -1, -1):  # from the highest power, so that ``bound`` is that of the tail
        bound += power * (abs(rates[0, m]) + abs(rates[1, m]) + abs(rates[2, m]))
        rates[3, m] = bound
        power *= 2.0
        if bound > NEGLIGIBLE and kept <= m:
            kept = m + 1
    return (bound, kept)


def interval_quaternion(rates, kept, series):
    """Return (rotation over one sample interval, whether its series has ended), from the powers of the rate polynomial.

    With s ∈ [−½, ½] measured from the interval's middle, w = Σ Ω_m sᵐ and q = Σ q_n sⁿ, equation (17) is
    2(n + 1) q_{n+1} = Σ_m q_{n−m} ⊗ Ω_m. The series from the middle gives both ends at once: δq = q(−½)* ⊗ q(½).

    ``rates`` (4, M) is that of fitted_rates, with ``kept`` powers; ``series`` (terms, 4) is scratch.
    """
    even = (1.0, 0.0, 0.0, 0.0)
    odd = (0.0, 0.0, 0.0, 0.0)
    store_row(series, 0, even)
    power = 1.0
    ended = False
    for n in range(len(series) - 1):
        total = (0.0, 0.0, 0.0, 0.0)
        for m in range(min(n + 1, kept)):
            rate = (rates[0, m], rates[1, m], rates[2, m])
            total = add_matrices(total, quaternion_times_vector(quaternion_at(series, n - m), rate))
        s = 0.5 / (n + 1)
        store_row(series, n + 1, scale_matrix(s, total))
        power *= 0.5
        s *= power
        if n % 2:
            even = combine_matrices(1.0, even, s, total)
        else:
            odd = combine_matrices(1.0, odd, s, total)
        if s * size(total) < NEGLIGIBLE and terms_to_come(rates, kept, series, n + 1) < NEGLIGIBLE:
            ended = True
            break
    backward = (even[0] - odd[0], odd[1] - even[1], odd[2] - even[2], odd[3] - even[3])
    return (quaternion_multiply(backward, add_matrices(even, odd)), ended)


def size(q):
    """Return the sum of the magnitudes of four numbers."""
    return abs(q[0]) + abs(q[1]) + abs(q[2]) + abs(q[3])


def terms_to_come(rates, kept, series, n):
    """Return a bound of the angle of all terms of the series after the n-th, from the last ``kept`` terms.

    Term n − m enters later terms only through powers m and higher, whose bounds sum to ``rates[3, m]``, divided by at least 2(n + 1), and
    by 2 for the half interval; the contributions of those terms are smaller.
    """
    total = 0.0
    for m in range(min(kept, n + 1)):
        i = n - m
        total += rates[3, m] * size(quaternion_at(series, i)) * 0.5**i
    return total / (2.0 * (n + 1))


def polynomial_steps(increments, samples, previous, fits, correction, rates, series, steps):
    """Write the step quaternions (m, 4): the equation on the polynomial, then exp(Σ C_ij Δθ_i × Δθ_j).

    ``fits`` (M, M, M) is indexed by the position of the interval in the window, increments, powers. Near the ends of the record the window
    is shifted to stay inside; the position of the step then differs, and the correction, valid for one position, is omitted. If the data
    are too rough for the polynomial, the increment of the interval is its rotation vector.
    """
    window = len(fits)
    latest = len(increments) - window
    for k in range(len(steps)):
        first = k * samples
        start = min(max(first - previous, 0), latest)
        smooth = first - start == previous
        q = (1.0, 0.0, 0.0, 0.0)
        for i in range(first, first + samples):
            bound, kept = fitted_rates(increments, start, fits[i - start], rates)
            step, ended = interval_quaternion(rates, kept, series)
            if bound > LARGEST_RATE or not ended:
                step = large_exponential(vector_at(increments, i))
                smooth = False
            q = quaternion_multiply(q, step)
        if smooth:
            q = quaternion_multiply(q, large_exponential(pair_correction(increments, start, correction)))
        store_row(steps, k, renormalized(q))


def magnus_6(b0, b1, b2):
    """Return the sixth-order Magnus step (Blanes, Casas, Ros 2000) from the moments B_n = T⁻ⁿ ∫ (t − T/2)ⁿ w dt.

    [a, b] = −a × b because equation (17) multiplies on the right.
    """
    a1 = combine(2.25, b0, -15.0, b2)
    a2 = (12.0 * b1[0], 12.0 * b1[1], 12.0 * b1[2])
    a3 = combine(-15.0, b0, 180.0, b2)
    c1 = cross(a2, a1)
    c2 = cross(a1, combine(2.0 / 60.0, a3, 1.0 / 60.0, c1))
    left = (-20.0 * a1[0] - a3[0] + c1[0], -20.0 * a1[1] - a3[1] + c1[1], -20.0 * a1[2] - a3[2] + c1[2])
    return large_exponential(
        add(combine(1.0, a1, 1.0 / 12.0, a3), combine(1.0 / 240.0, cross(add(a2, c2), left), 0.0, a1))
    )


def weighted(increments, first, weights, row):
    """Return Σ_j weights[row, j] Δθ_j over the window that starts at row ``first``."""
    total = (0.0, 0.0, 0.0)
    for j in range(weights.shape[1]):
        total = combine(1.0, total, weights[row, j], vector_at(increments, first + j))
    return total


def magnus_steps(increments, weights, steps):
    """Write the step quaternions (m, 4) of :func:`magnus_6` on the moments, weighted sums of the N increments of a step."""
    samples = weights.shape[1]
    for k in range(len(steps)):
        first = k * samples
        b0 = weighted(increments, first, weights, 0)
        b1 = weighted(increments, first, weights, 1)
        b2 = weighted(increments, first, weights, 2)
        store_row(steps, k, renormalized(magnus_6(b0, b1, b2)))
