"""NEES, bounds and verdicts against scipy and brute force."""

import numpy as np
import pytest
import scipy.stats

from strapdown import consistency, quaternion
from strapdown.checks import InputError
from strapdown.consistency import Verdict


def test_errors_are_zero_for_the_truth_and_signed_true_minus_estimate():
    generator = np.random.default_rng(0)
    q = quaternion.normalize(generator.normal(size=(20, 4)))
    delta = 1e-3 * generator.normal(size=(20, 3))
    bias = generator.normal(size=(20, 3))
    true = quaternion.multiply(q, quaternion.exp(delta))
    e = consistency.errors(q, bias - 0.25, true, bias)
    assert np.allclose(e[:, :3], delta, atol=1e-15)
    assert np.allclose(e[:, 3:], 0.25)


def test_nees_is_the_quadratic_form():
    generator = np.random.default_rng(1)
    root = generator.normal(size=(5, 4, 6, 6)) + 2.0 * np.eye(6)
    P = root @ np.swapaxes(root, -1, -2)
    e = generator.normal(size=(5, 4, 6))
    expected = np.einsum("...i,...ij,...j->...", e, np.linalg.inv(P), e)
    assert np.allclose(consistency.nees(e, P), expected, rtol=1e-10)
    assert consistency.nees(e[0, 0], P[0, 0]).shape == ()


def test_nees_refuses_a_covariance_that_is_none():
    with pytest.raises(InputError, match=r"covariance\[1\] is not positive definite"):
        consistency.nees(np.zeros((2, 2)), np.array([np.eye(2), np.diag([1.0, -1.0])]))


@pytest.mark.parametrize(
    ("runs", "expected"), [(50, (0.8464, 1.1662)), (1000, (0.9645, 1.0361))], ids=["50 runs", "1000 runs"]
)
def test_bounds_are_the_published_ones(runs, expected):
    assert consistency.mean_bounds(6, runs, 0.95) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("probability", [0.95, 0.99])
def test_bounds_hold_what_they_promise(probability):
    """10 000 means of 40 runs of χ²₃ fall inside as often as promised, to a binomial ±4σ."""
    means = np.random.default_rng(2).chisquare(3, size=(10_000, 40)).mean(axis=1) / 3.0
    low, high = consistency.mean_bounds(3, 40, probability)
    inside = np.mean((means >= low) & (means <= high))
    assert abs(inside - probability) < 4.0 * np.sqrt(probability * (1.0 - probability) / 10_000)
    assert scipy.stats.chi2.cdf(low * 120, 120) == pytest.approx(0.5 * (1.0 - probability))


def test_simultaneous_bounds_hold_for_independent_and_for_equal_epochs():
    generator = np.random.default_rng(3)
    trials, wrong = 2000, [0, 0]
    for _ in range(trials):
        independent = generator.chisquare(6, size=(20, 100)).mean(axis=1) / 6.0
        equal = np.full(20, generator.chisquare(600) / 600.0)
        for k, mean in enumerate((independent, equal)):
            wrong[k] += not Verdict(mean=mean, degrees=6, runs=100, probability=0.99).consistent
    assert 0.004 * trials < wrong[0] < 0.018 * trials  # Bonferroni is nearly exact for independent epochs
    assert wrong[1] < 0.005 * trials  # and conservative for equal ones


def test_a_verdict_has_two_sides():
    for factor, expected in ((0.5, False), (1.0, True), (2.0, False)):
        assert Verdict(mean=np.full(5, factor), degrees=6, runs=100, probability=0.99).consistent is expected


@pytest.mark.parametrize("bad", [0.0, 1.0, 1.5])
def test_a_probability_lies_between_0_and_1(bad):
    with pytest.raises(InputError, match="probability"):
        consistency.mean_bounds(6, 10, bad)
