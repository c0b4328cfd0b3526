"""The bias over temperature: exact without noise, intervals that cover with noises that wander, and what plain least squares would say."""

import numpy as np
import pytest

from strapdown.allan import temperature as allan_temperature
from strapdown.checks import InputError

DT, N, K = 0.1, 1e-3, 2e-4


def warm_up(samples: int) -> np.ndarray:
    time = DT * np.arange(samples)
    return 20.0 + 15.0 * (1.0 - np.exp(-time / 100.0)) + 0.5 * np.sin(time / 17.0)


def records(samples: int, runs: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    walk = np.cumsum(K * np.sqrt(DT) * random.standard_normal((samples + 1, runs)), axis=0)
    return 0.5 * (walk[1:] + walk[:-1]) + np.sqrt(N**2 / DT + K**2 * DT / 12.0) * random.standard_normal(
        (samples, runs)
    )


def test_what_is_put_in_comes_out():
    T = warm_up(4000)
    t = T - T.mean()
    quiet = 1e-9 * np.random.default_rng(1).standard_normal((4000, 2))
    x = np.stack([0.3 + 2e-3 * t - 4e-5 * t**2, -1.0 - 1e-3 * t], axis=1) + quiet
    found = allan_temperature.fit_temperature(x, T, DT, order=2)
    polynomial = found.polynomial
    np.testing.assert_allclose(polynomial.coefficients.T, [[0.3, 2e-3, -4e-5], [-1.0, -1e-3, 0.0]], atol=1e-9)
    np.testing.assert_allclose(polynomial.bias([T[0], T[-1]]), (x - quiet)[[0, -1]], atol=1e-8)
    assert polynomial.span == (T.min(), T.max())
    np.testing.assert_allclose(found.left, np.broadcast_to(x.mean(axis=0), x.shape), atol=1e-7)


def test_its_intervals_cover_where_plain_least_squares_would_not():
    """75 records of a bias that wanders: 95 % intervals hold 71, 64 is four σ below; those of white residuals hold fewer than half."""
    samples, runs = 3000, 75
    T = warm_up(samples)
    x = 1e-3 * (T - T.mean())[:, None] + records(samples, runs, 5)
    found = allan_temperature.fit_temperature(x, T, DT, order=1)
    inside = np.abs(found.polynomial.coefficients[1] - 1e-3) <= found.reach[1]
    assert 64 <= inside.sum() <= 75
    assert 0.7 < np.std(found.polynomial.coefficients[1]) / found.polynomial.sigma[1].mean() < 1.3  # of 75: ±8 %
    np.testing.assert_allclose(found.reach[1], 1.959964 * found.polynomial.sigma[1], rtol=1e-6)
    A = np.stack([np.ones(samples), T - T.mean()], axis=1)
    plain, rest, *_ = np.linalg.lstsq(A, x, rcond=None)
    sigma = np.sqrt(rest / (samples - 2) / np.sum((T - T.mean()) ** 2))
    assert np.sum(np.abs(plain[1] - 1e-3) < 1.96 * sigma) < runs / 2
    # and it is nearer, for it knows where the noise is
    assert np.std(found.polynomial.coefficients[1]) < np.std(plain[1])


def test_the_noise_that_the_polynomial_took_is_put_back():
    """A short record and a cubic, which takes most of a wandering bias: of 60 intervals 57 would hold; 34 do where it is not put back."""
    T = warm_up(1500)
    x = 1e-3 * (T - T.mean())[:, None] + records(1500, 60, 5)
    found = allan_temperature.fit_temperature(x, T, DT, order=3)
    assert 50 <= np.sum(np.abs(found.polynomial.coefficients[1] - 1e-3) <= found.reach[1]) <= 60


@pytest.mark.parametrize(
    ("temperature", "words"),
    [(np.full(500, 20.0), "spans 0 K, less than 0.5 K"), (np.linspace(0, 9, 400), "temperature has shape")],
)
def test_what_shows_nothing_is_refused(temperature, words):
    with pytest.raises(InputError, match=words):
        allan_temperature.fit_temperature(np.random.default_rng(1).standard_normal(500), temperature, DT)
