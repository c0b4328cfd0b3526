"""The coefficient tables against independent derivations, in exact rationals."""

import dataclasses
import math
from fractions import Fraction

import pytest

from strapdown import coning
from strapdown.checks import InputError
from strapdown.coning import ALGORITHMS
from strapdown.coning import coefficients as exact

NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight")
FAMILY = [(n, p) for n in range(1, 9) for p in range(4)]


def compressed_name(n, p):
    return f"{NUMBERS[n - 1]}-sample" + (f"-previous-{p}" if p else "")


def sine_products(lag, power):
    """Return the coefficient of λ^power in 2(1 − cos λ) sin(lag λ), by multiplying the two series."""
    total = Fraction(0)
    for even in range(2, power, 2):
        odd = power - even
        one_minus_cos = -Fraction((-1) ** (even // 2), math.factorial(even)) * 2
        sine = Fraction((-1) ** (odd // 2) * lag**odd, math.factorial(odd))
        total += one_minus_cos * sine
    return total


def solve(matrix, right):
    """Return the exact solution of a square linear system (Gauss–Jordan)."""
    n = len(right)
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    for i in range(n):
        pivot = next(k for k in range(i, n) if rows[k][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for k in range(n):
            if k != i and rows[k][i] != 0:
                rows[k] = [x - rows[k][i] * y for x, y in zip(rows[k], rows[i], strict=True)]
    return tuple(row[n] for row in rows)


@pytest.mark.parametrize(("n", "p"), FAMILY)
def test_compressed_closed_form_solves_the_coning_equations(n, p):
    m = n + p
    powers = [2 * k + 1 for k in range(1, m)]
    matrix = [[sine_products(lag, q) for lag in range(1, m)] for q in powers]
    right = [-Fraction((-1) ** (q // 2) * n**q, 2 * math.factorial(q)) for q in powers]
    assert ALGORITHMS[compressed_name(n, p)].coefficients == solve(matrix, right)


@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("two-sample", [Fraction(2, 3)]),
        ("three-sample", [Fraction(27, 20), Fraction(9, 20)]),
        ("four-sample", [Fraction(214, 105), Fraction(92, 105), Fraction(54, 105)]),
        ("five-sample", [Fraction(1375, 504), Fraction(650, 504), Fraction(525, 504), Fraction(250, 504)]),
        ("one-sample-previous-1", [Fraction(1, 12)]),
        ("one-sample-previous-2", [Fraction(7, 60), Fraction(-1, 60)]),
        ("one-sample-previous-3", [Fraction(113, 840), Fraction(-13, 420), Fraction(1, 280)]),
    ],
)
def test_published_compressed_coefficients(name, published):
    assert list(ALGORITHMS[name].coefficients) == published


@pytest.mark.parametrize(("n", "p"), FAMILY)
def test_drift_constant_is_the_closed_form(n, p):
    m = n + p
    algorithm = ALGORITHMS[compressed_name(n, p)]
    assert algorithm.drift_order == 2 * m
    assert algorithm.drift_constant == Fraction(math.factorial(m) ** 2, 2 * math.factorial(2 * m + 1))


def monomial_increments(power, first, last):
    return [Fraction((k + 1) ** (power + 1) - k ** (power + 1), power + 1) for k in range(first, last)]


def second_order(a, b, n):
    """Return ½ ∫ (A b − B a) dt over [0, n] for the rates tᵃ, tᵇ: the rotation vector's cross term of two axes."""
    return Fraction(n ** (a + b + 2), a + b + 2) * (Fraction(1, a + 1) - Fraction(1, b + 1)) / 2


@pytest.mark.parametrize(
    ("n", "p", "f"), [(n, 0, 0) for n in range(2, 7)] + [(2, 3, 0), (4, 2, 0), (1, 3, 3), (2, 1, 2)]
)
def test_time_taylor_is_exact_for_rate_polynomials(n, p, f):
    table = exact.taylor_pairs(n, p, f) if p else ALGORITHMS[f"time-taylor-{n}"].products
    m = n + p + f
    for a in range(m):
        for b in range(a):
            x, y = monomial_increments(a, -p, n + f), monomial_increments(b, -p, n + f)
            got = sum(table[i][j] * (x[i] * y[j] - x[j] * y[i]) for i in range(m) for j in range(i + 1, m))
            assert got == second_order(a, b, n)


@pytest.mark.parametrize(("n", "p", "f"), [(2, 8, 0), (3, 4, 0), (4, 0, 0), (1, 4, 4), (1, 8, 8)])
def test_matched_correction(n, p, f):
    c = exact.matched_correction(n, p, f)
    m = n + p + f
    assert all(c[i][j] == -c[j][i] for i in range(m) for j in range(m))
    lags = [a + b for a, b in zip(exact.lag_sums(c), exact.lag_sums(exact.taylor_pairs(n, p, f)), strict=True)]
    assert tuple(lags) == exact.compressed_coefficients(n, m - n)
    for power in range(m // 2):  # nothing is corrected where one axis moves as a low polynomial
        x = monomial_increments(power, -p, n + f)
        assert all(sum(c[i][j] * x[j] for j in range(m)) == 0 for i in range(m))


@pytest.mark.parametrize("window", [1, 2, 3, 5, 9])
def test_rates_reproduce_their_increments_about_any_origin(window):
    for origin in (Fraction(k, 2) for k in range(2 * window + 1)):
        for j, powers in enumerate(exact.rates_about(window, origin)):
            for i in range(window):
                low, high = i - origin, i + 1 - origin
                integral = sum(c * (high ** (k + 1) - low ** (k + 1)) / (k + 1) for k, c in enumerate(powers))
                assert integral == (1 if i == j else 0)


def test_moments_of_a_known_polynomial():
    """w = t² over a step of 3 samples: T⁻¹ ∫ (t − 3/2) t² dt = (81/4 − 27/2)/3 = 9/4."""
    increments = monomial_increments(2, 0, 3)
    moments = [sum(w * x for w, x in zip(row, increments, strict=True)) for row in exact.magnus_moments(3)]
    assert moments[:2] == [9, Fraction(9, 4)]


@pytest.mark.parametrize("points", [2, 4, 6, 8])
def test_rate_weights_integrate_polynomials(points):
    for interval in range(points - 1):
        weights = exact.rate_weights(points, interval)
        for power in range(points):
            assert sum(w * j**power for j, w in enumerate(weights)) == Fraction(
                (interval + 1) ** (power + 1) - interval ** (power + 1), power + 1
            )


def test_the_drift_orders_of_the_catalogue():
    """2M of what is optimal under coning, the order of the fit of what is exact for a rate polynomial, that of Magnus."""
    fitted = {n: n + 1 + (n % 2 == 0) for n in range(1, 9)}
    for name, algorithm in ALGORITHMS.items():
        of_fit = name.startswith(("time-taylor", "polynomial"))
        expected = (
            algorithm.order if name == "magnus-6" else fitted[algorithm.samples] if of_fit else 2 * algorithm.window
        )
        assert algorithm.drift_order == expected, name


@pytest.mark.parametrize("name", ["four-sample", "time-taylor-3", "matched-2-8"])
def test_one_wrong_coefficient_shows_in_the_drift_order(name):
    good, m = ALGORITHMS[name], ALGORITHMS[name].window
    rows = [list(row) for row in good.products]
    rows[m - 2][m - 1] += Fraction(1, 1000)
    rows[m - 1][m - 2] -= Fraction(1, 1000)
    assert dataclasses.replace(good, products=tuple(map(tuple, rows))).drift_order < good.drift_order


ZERO, TAYLOR = Fraction(0), ALGORITHMS["time-taylor-3"].products


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("time-taylor-3", {"products": ((Fraction(1),) * 3,) * 3}, "antisymmetric"),
        ("time-taylor-3", {"products": TAYLOR[:2]}, "3 by 3"),
        ("time-taylor-3", {"solver": "compressed"}, "with the last increment of the step only"),
        ("two-sample", {"products": ((0.0, 2.0 / 3.0), (-2.0 / 3.0, 0.0))}, "not rational"),
        ("one-sample", {"following": 1, "products": ((ZERO,) * 2,) * 2}, "with the last increment of the step only"),
        ("polynomial-4", {"products": ((ZERO,) * 5,) * 5}, "products is not 4 by 4"),
        # Or the algorithm would not be what its table says, and its drift order that of something else.
        ("magnus-6", {"products": ALGORITHMS["time-taylor-4"].products}, "by its increments alone"),
        ("magnus-6", {"previous": 2, "products": ((ZERO,) * 6,) * 6}, "by its increments alone"),
    ],
)
def test_tables_that_are_not_those_of_the_solver_are_refused(name, change, words):
    with pytest.raises(InputError, match=words):
        dataclasses.replace(ALGORITHMS[name], **change)


def test_catalogue_names_are_the_algorithms_names():
    assert all(ALGORITHMS[name].name == name for name in ALGORITHMS)
    assert len(coning.algorithm_table().rows) == len(ALGORITHMS)
    assert "two-sample" in ALGORITHMS
    assert "two-samples" not in ALGORITHMS
    with pytest.raises(InputError, match="did you mean 'two-sample'"):
        coning.named("two-samples")


def test_products_of_published_algorithms():
    """Of a rate a + b t they make T³/12 a × b: ½ ∫ (A b − B a) dt, all that there is to second order."""
    table = ALGORITHMS["magnus-6"].products
    n = len(table)
    ones, ramp = monomial_increments(0, 0, n), monomial_increments(1, 0, n)
    got = sum(table[i][j] * (ones[i] * ramp[j] - ones[j] * ramp[i]) for i in range(n) for j in range(i + 1, n))
    assert got == second_order(0, 1, n)
    assert ALGORITHMS["two-sample"].products == ((0, Fraction(2, 3)), (Fraction(-2, 3), 0))
