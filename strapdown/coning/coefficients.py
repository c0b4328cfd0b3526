"""Coefficients of the integration algorithms, in exact rationals.

The unit of time is the sample interval. A window of M increments covers [0, M]; a step of N increments starts at sample p of the window,
and f = M − N − p increments follow it. A *pair table* K is antisymmetric and represents Σ_{i<j} K_ij Δθ_i × Δθ_j. Its *lag sums* ``k_l =
Σ_i K_{i,i+l}`` determine the response to small coning: two increments l samples apart have the mean product 2(1 − cos λ) sin lλ, so that
the drift of a step, for small β, is ``β² [Σ k_l 2(1 − cos λ) sin lλ − ½(Nλ − sin Nλ)]``.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
from fractions import Fraction

import numpy as np

from strapdown.checks import Array

Rationals = tuple[Fraction, ...]
Table = tuple[Rationals, ...]


def compressed_coefficients(samples: int, previous: int = 0) -> Rationals:
    """Return k_1 … k_{M−1} of the compressed coning correction with ``samples`` N and ``previous`` p, M = N + p, in closed form.

    They solve ``Σ k_j 2(1 − cos λ) sin jλ = ½(Nλ − sin Nλ)`` up to the power λ^{2M−1}. In the second differences
    ``e_l = k_{l−1} − 2k_l + k_{l+1}`` (k_0 = k_M = 0) the system is a Vandermonde system in l², with the solution

        e_l = ½δ_{lN} + (−1)^l (N/l) (M!)² / ((M−l)! (M+l)!),    l = 1 … M.
    """
    m = samples + previous
    e = [Fraction(0)] * (m + 1)
    for lag in range(1, m + 1):
        numerator = (-1) ** lag * samples * math.factorial(m) ** 2
        e[lag] = Fraction(numerator, lag * math.factorial(m - lag) * math.factorial(m + lag))
    e[samples] += Fraction(1, 2)
    k = [Fraction(0)] * (m + 2)
    for lag in range(m, 1, -1):
        k[lag - 1] = e[lag] + 2 * k[lag] - k[lag + 1]
    return tuple(k[1:m])


def lagrange(last: int) -> list[list[int]]:
    """Return ``last``! times the coefficients, from t⁰ on, of the Lagrange polynomial of each of the nodes 0, 1, … ``last``."""
    nodal = [1]
    for node in range(last + 1):
        nodal = [low - node * high for low, high in zip([0, *nodal], [*nodal, 0], strict=True)]
    polynomials = []
    for node in range(last + 1):
        quotient = [0] * (last + 1)
        for power in range(last, -1, -1):  # synthetic division by (t − node)
            quotient[power] = nodal[power + 1] + (node * quotient[power + 1] if power < last else 0)
        factor = (-1) ** (last - node) * math.comb(last, node)
        polynomials.append([factor * c for c in quotient])
    return polynomials


@functools.cache
def rate_basis(window: int) -> tuple[tuple[int, ...], ...]:
    """Return, for each increment of the window, M! times the coefficients of t⁰ … t^{M−1} of its contribution to the rate polynomial.

    The polynomial of degree M − 1 whose integrals over the M sample intervals are the increments is the derivative of the Lagrange
    interpolant of the summed angle at 0, 1, … M.
    """
    polynomials = lagrange(window)
    # Increment i raises the summed angle at every node after it.
    summed = [[sum(column) for column in zip(*polynomials[i + 1 :], strict=True)] for i in range(window)]
    return tuple(tuple(power * c for power, c in enumerate(angle) if power) for angle in summed)


def rates_about(window: int, origin: Fraction) -> Table:
    """Return, per increment of the window, the rate polynomial in powers of the time from an origin, a multiple of ½."""
    rows = []
    for basis in rate_basis(window):
        c = [x * 2 ** (window - 1 - power) for power, x in enumerate(basis)]  # in 2t, so that all are integers
        for low in range(window):
            for power in range(window - 2, low - 1, -1):
                c[power] += int(2 * origin) * c[power + 1]
        scale = 2 ** (window - 1) * math.factorial(window)
        rows.append(tuple(Fraction(x * 2**power, scale) for power, x in enumerate(c)))
    return tuple(rows)


@functools.cache
def taylor_pairs(samples: int, previous: int = 0, following: int = 0) -> Table:
    """Return the time-Taylor pair table: ``K_ij = ½ ∫ (L_i L_j' − L_j L_i') dt`` over the step, L_i' the rate basis, L_i = 0 at its start.

    It is exact, to second order in the rotation, if the body rate is a polynomial of degree M − 1.
    """
    m = samples + previous + following
    rates = rates_about(m, Fraction(previous))
    moment = [
        [Fraction(samples ** (a + b + 2), a + b + 2) * (Fraction(1, a + 1) - Fraction(1, b + 1)) / 2 for b in range(m)]
        for a in range(m)
    ]
    half = [[sum((r[a] * moment[a][b] for a in range(m)), Fraction(0)) for b in range(m)] for r in rates]
    return tuple(tuple(sum((h[b] * r[b] for b in range(m)), Fraction(0)) for r in rates) for h in half)


def lag_sums(pairs: Table) -> Rationals:
    """Return k_1 … k_{M−1} of a pair table: the sums along its upper diagonals."""
    m = len(pairs)
    return tuple(sum((pairs[i][i + lag] for i in range(m - lag)), Fraction(0)) for lag in range(1, m))


@functools.cache
def matched_correction(samples: int, previous: int = 0, following: int = 0) -> Table:
    """Return the pair table C that, added to an algorithm exact for rate polynomials, makes it optimal under coning as well.

    This is the family ``matched-N-p-f``, derived for this package. Its step is ``δq = δq_polynomial ⊗ exp(Σ C_ij Δθ_i × Δθ_j)``: the
    quaternion equation solved to rounding for the rate polynomial through all M = N + p + f increments of the window, then the correction
    C. Derivation:

    1. *The polynomial* solution contains all powers of the rotation, so there is no error floor of order β⁴ωλ⁴. The remaining error is that
       of the interpolation, of relative order λ^M, in the products of two, three, … rates.
    2. *Products of two rates* cause the drift at small β, which depends only on the lag sums. The optimal M − 1 lag sums are those
       of :func:`compressed_coefficients` (the position of the step in the window does not matter): drift λ^{2M} instead of about λ^{M+1}.
       The lag sums of C must therefore be the difference between those and the lag sums of :func:`taylor_pairs`.
    3. *Other motions must not lose accuracy.* Any pair table with those lag sums would be optimal for coning, but most would cause, for
       example, a periodic error of order β³ for a constant rate combined with an oscillation. Since both tables are exact for polynomials,
       the difference of their generating functions is divisible by (2 − z − 1/z)^d, d = ⌊M/2⌋: C = Dᵀ S D with D the d-th difference. The
       correction is then exactly zero if either factor is a polynomial of degree below d, and otherwise of the order of the interpolation
       error.
    4. The lag sums of S follow from the division; they are distributed evenly along its diagonals.

    With f = 0 the algorithm is causal. With f > 0 it needs a delay of f samples (or a recorded file); the step is then inside the window,
    where the interpolation is most accurate, and errors are smaller by two to four powers of ten.
    """
    m = samples + previous + following
    d = m // 2
    wanted = compressed_coefficients(samples, m - samples)
    difference = [a - b for a, b in zip(wanted, lag_sums(taylor_pairs(samples, previous, following)), strict=True)]
    for _ in range(d):
        quotient = [Fraction(0)] * (len(difference) + 1)
        for lag in range(len(difference) - 1, 0, -1):
            quotient[lag - 1] = 2 * quotient[lag] - quotient[lag + 1] - difference[lag]
        if difference[0] != 2 * quotient[0] - quotient[1]:
            raise ArithmeticError("the two tables are not exact for the same polynomials")
        difference = quotient[: len(difference) - 1]
    size = m - d
    weight = [Fraction(0), *(s / (size - lag) for lag, s in enumerate(difference, start=1))]
    spread = [[weight[abs(j - i)] * (1 if j > i else -1) for j in range(size)] for i in range(size)]
    d_th = [
        [(-1) ** (d - j + i) * math.comb(d, j - i) if 0 <= j - i <= d else 0 for j in range(m)] for i in range(size)
    ]
    half = [[sum((spread[a][b] * d_th[b][j] for b in range(size)), Fraction(0)) for j in range(m)] for a in range(size)]
    return tuple(
        tuple(sum((d_th[a][i] * half[a][j] for a in range(size)), Fraction(0)) for j in range(m)) for i in range(m)
    )


def floats(table: Table) -> Array:
    """Return a table as an array."""
    return np.array([[float(x) for x in row] for row in table])


def sum_of_tables(a: Table, b: Table) -> Table:
    """Return a + b."""
    return tuple(tuple(x + y for x, y in zip(r, s, strict=True)) for r, s in zip(a, b, strict=True))


@functools.cache
def magnus_moments(samples: int) -> Table:
    """Return the weights of the increments in the moments ``B_n = T⁻ⁿ ∫ (t − T/2)ⁿ w dt``, n = 0, 1, 2, of a step, T = N intervals."""
    half = Fraction(samples, 2)
    centred = rates_about(samples, half)
    moments = [[half ** (k + 1) * (1 - (-1) ** (k + 1)) / (k + 1) for k in range(n, n + samples)] for n in range(3)]
    return tuple(
        tuple(sum(map(operator.mul, rate, moment), Fraction(0)) / samples**n for rate in centred)
        for n, moment in enumerate(moments)
    )


def magnus_products(samples: int) -> Table:
    """Return the pair table of the sixth-order Magnus step: (20 α₁ + α₃) × α₂ / 240.

    α₁ = 9/4 B₀ − 15 B₂, α₂ = 12 B₁, α₃ = −15 B₀ + 180 B₂.
    """
    b0, b1, b2 = magnus_moments(samples)
    return outer_pairs(tuple((30 * x - 120 * z) / 240 for x, z in zip(b0, b2, strict=True)), tuple(12 * y for y in b1))


def second_order(pairs: Table, samples: int, previous: int = 0) -> int:
    """Return the global order of convergence of a pair table for any smooth motion, without triple products.

    For the rates 1 and tᵇ along two axes the table must give ``½ ∫ (t tᵇ − tᵇ⁺¹/(b + 1)) dt`` over the step. If it does not, the error
    of a step is of order h^{b+2} and the global error of order h^{b+1}. The products of three rates that such a table omits cause an error
    of order h⁵ per step, so the order is at most 4.
    """
    edges = range(-previous, len(pairs) - previous + 1)
    for b in (1, 2):
        increments = [Fraction(high ** (b + 1) - low ** (b + 1), b + 1) for low, high in itertools.pairwise(edges)]
        # Since K is antisymmetric, Σ_{i<j} K_ij (u_i v_j − u_j v_i) = Σ_ij K_ij u_i v_j, here with u_i = 1.
        total = sum((k * x for row in pairs for k, x in zip(row, increments, strict=True)), Fraction(0))
        if total != Fraction(samples ** (b + 2), 2 * (b + 2)) * (1 - Fraction(1, b + 1)):
            return b + 1
    return 4


MAX_DENOMINATOR = 10**6
"""Maximum denominator of the fraction to which a float is converted."""


def rational(value: float | str | Fraction) -> Fraction:
    """Return a coefficient as a fraction.

    Text is read exactly ("27/20", "1.35"). A float is converted to the fraction of smallest denominator, at most a million, that equals it
    as a float (2/3 for 0.6666666666666666); if there is none, to the decimal number that it prints as.
    """
    if isinstance(value, bool):
        raise TypeError("a truth value is no coefficient")
    if isinstance(value, float):
        near = Fraction(value).limit_denominator(MAX_DENOMINATOR)
        return near if float(near) == value else Fraction(repr(value))
    return Fraction(value)


def outer_pairs(a: Rationals, b: Rationals) -> Table:
    """Return the pair table of (Σ a_i Δθ_i) × (Σ b_j Δθ_j)."""
    return tuple(tuple(x * v - u * y for u, v in zip(a, b, strict=True)) for x, y in zip(a, b, strict=True))


def rate_weights(points: int, interval: int) -> Rationals:
    """Return the weights that integrate the polynomial through ``points`` rate samples over one of the intervals between them.

    Two points: the trapezoidal rule, ½ and ½. Four, the middle one: −1/24, 13/24, 13/24, −1/24.
    """
    integrals = [Fraction((interval + 1) ** k - interval**k, k) for k in range(1, points + 1)]
    scale = math.factorial(points - 1)
    return tuple(sum(map(operator.mul, row, integrals), Fraction(0)) / scale for row in lagrange(points - 1))


def residuals(lags: Rationals, samples: int, terms: int) -> Rationals:
    """Return the coefficients of λ, λ³, λ⁵, … of the drift of a step over β²: ``Σ k_l 2(1 − cos λ) sin lλ − ½(Nλ − sin Nλ)``."""
    total = []
    for n in range(terms):
        q = 2 * n + 1
        moment = sum((k * ((j + 1) ** q + (j - 1) ** q - 2 * j**q) for j, k in enumerate(lags, start=1)), Fraction(0))
        total.append((Fraction(samples**q, 2) - moment) * Fraction((-1) ** n, math.factorial(q)))
    total[0] -= Fraction(samples, 2)
    return tuple(total)
