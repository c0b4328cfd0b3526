"""Series coefficients of the kernels against mpmath: to rounding up to the angle they promise, and no worse than they say beyond."""

import mpmath as mp
import numpy as np
import pytest

from strapdown.kernels import rotation, series

EPS = np.finfo(float).eps

CLOSED_FORMS = {
    "cosine": (series.cosine, mp.cos),
    "sinc": (series.sinc, lambda t: mp.sin(t) / t),
    "third": (series.third, lambda t: (t - mp.sin(t)) / t**3),
    "fourth": (series.fourth, lambda t: (t * t / 2 - 1 + mp.cos(t)) / t**4),
    "fifth": (series.fifth, lambda t: (mp.mpf(1) / 3 - 2 * (t - mp.sin(t)) / t**3) / t**2),
}
LARGEST = {"cosine": 0.5 * series.LARGEST_ANGLE, "sinc": 0.5 * series.LARGEST_ANGLE}
"""Cosine and sine are only ever taken of half the angle; the others of the whole."""
ULPS = {"third": 6.0}
"""Its first dropped term is 5 ulp at the largest angle; it enters multiplied by θ² ≤ ¼ or less beside terms of one."""
LIMITS = {"cosine": 1.0, "sinc": 1.0, "third": 1 / 6, "fourth": 1 / 24, "fifth": 1 / 60}


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_against_the_closed_form_over_all_angles(name):
    function, closed = CLOSED_FORMS[name]
    top = LARGEST.get(name, series.LARGEST_ANGLE)
    angles = np.exp(np.random.default_rng(1).uniform(np.log(1e-12), np.log(top), 300))
    with mp.workdps(80):
        for angle in [*angles, top]:
            x = float(angle) ** 2
            wanted = closed(mp.sqrt(mp.mpf(x)))
            assert abs(float((mp.mpf(function(x)) - wanted) / wanted)) <= ULPS.get(name, 4.0) * EPS


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_limit_at_zero_is_exact(name):
    assert CLOSED_FORMS[name][0](0.0) == LIMITS[name]


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_plain_numbers_and_arrays_agree_to_the_bit(name):
    function = CLOSED_FORMS[name][0]
    x = np.linspace(0.0, series.LARGEST_ANGLE**2, 23)
    np.testing.assert_array_equal(function(x), [function(float(one)) for one in x])


def test_polynomial_is_the_polynomial():
    c = np.random.default_rng(2).standard_normal(6)
    x = np.linspace(-2.0, 2.0, 31)
    np.testing.assert_allclose(
        series.polynomial(x, *c), np.polynomial.polynomial.polyval(x, c), rtol=0.0, atol=64 * EPS * np.abs(c).max()
    )


@pytest.mark.parametrize(("angle", "bound"), [(0.5, 2 * EPS), (1.0, 1e-12), (2.0, 1e-8)])
def test_exponential_degrades_as_the_docstring_says(angle, bound):
    direction = np.array([0.48, -0.6, 0.64])
    wanted = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * direction)])
    error = np.abs(np.array(rotation.exponential(tuple(angle * direction))) - wanted).max()
    assert error <= bound
    if angle > series.LARGEST_ANGLE:
        assert error > 1e-3 * bound  # nor is the promise idle
