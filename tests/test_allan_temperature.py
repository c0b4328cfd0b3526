"""The bias over temperature: exact without noise, intervals that cover with noises that wander, and what plain least squares would say."""

import numpy as np
import pytest
from scipy.optimize import minimize

from strapdown.allan import temperature as allan_temperature

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
    fit = allan_temperature.fit_temperature(x, T, DT, order=2)
    polynomial = fit.polynomial
    np.testing.assert_allclose(polynomial.coefficients.T, [[0.3, 2e-3, -4e-5], [-1.0, -1e-3, 0.0]], atol=1e-9)
    np.testing.assert_allclose(polynomial.bias([T[0], T[-1]]), (x - quiet)[[0, -1]], atol=1e-8)
    assert polynomial.span == (T.min(), T.max())
    np.testing.assert_allclose(fit.left, np.broadcast_to(x.mean(axis=0), x.shape), atol=1e-7)


def test_its_intervals_cover_where_plain_least_squares_would_not():
    """12 records of a bias that wanders: 95 % intervals hold 11.4, 9 is 3.2 σ below; those of white residuals hold fewer than half."""
    samples, runs = 3000, 12
    T = warm_up(samples)
    x = 1e-3 * (T - T.mean())[:, None] + records(samples, runs, 5)
    fit = allan_temperature.fit_temperature(x, T, DT, order=1)
    inside = np.abs(fit.polynomial.coefficients[1] - 1e-3) <= fit.reach[1]
    assert 9 <= inside.sum() <= 12
    assert 0.5 < np.std(fit.polynomial.coefficients[1]) / fit.polynomial.sigma[1].mean() < 1.5  # of 12: ±20 %
    A = np.stack([np.ones(samples), T - T.mean()], axis=1)
    plain, rest, *_ = np.linalg.lstsq(A, x, rcond=None)
    sigma = np.sqrt(rest / (samples - 2) / np.sum((T - T.mean()) ** 2))
    assert np.sum(np.abs(plain[1] - 1e-3) < 1.96 * sigma) < runs / 2
    # and it is nearer, for it knows where the noise is
    assert np.std(fit.polynomial.coefficients[1]) < np.std(plain[1])


def three_hours(shape: str, K: float, runs: int):
    """Return the temperature and records of N 2e-4 and K without a slope, and the σ of the slope if the noise is known, by matrices."""
    dt, samples = 5.0, 2160
    time = dt * np.arange(samples)
    T = 20.0 + {"exponential": 15.0 * (1.0 - np.exp(-time / 1800.0)), "line": 1e-3 * time}[shape]
    walk = np.tril(np.ones((samples, samples + 1)), 1)  # averages of a walk over each interval
    walk[np.arange(samples), np.arange(1, samples + 1)] = 0.5
    walk *= K * np.sqrt(dt)
    white = 2e-4**2 / dt + K**2 * dt / 12.0
    random = np.random.default_rng(7)
    x = walk @ random.standard_normal((samples + 1, runs)) + np.sqrt(white) * random.standard_normal((samples, runs))
    A = np.stack([np.ones(samples), T - T.mean()], axis=1)
    information = A.T @ np.linalg.solve(walk @ walk.T + white * np.eye(samples), A)
    return T, x, dt, np.sqrt(np.linalg.inv(information)[1, 1])


@pytest.mark.parametrize(
    ("shape", "K", "runs"),
    [
        ("line", 3e-7, 10),
        pytest.param("line", 3e-7, 60, marks=pytest.mark.slow),
        pytest.param("exponential", 3e-6, 60, marks=pytest.mark.slow),
    ],
)
def test_sigma_of_the_slope_is_not_smaller_because_the_walk_is_not_seen(shape, K, runs):
    """σ over that with known noise: with one estimate of the walk, zero in some records, its minimum was 0.2 and its median 0.67."""
    T, x, dt, known = three_hours(shape, K, runs)
    ratio = allan_temperature.fit_temperature(x, T, dt).polynomial.sigma[1] / known
    assert ratio.min() > 0.5
    assert 0.97 < np.median(ratio) < 1.3
    assert np.sqrt(np.mean(ratio**2)) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "K"), [("exponential", 3e-6), ("line", 3e-6), ("exponential", 3e-7), ("line", 3e-7)])
def test_intervals_of_the_slope_hold_with_a_weak_walk(shape, K):
    """Of 600 records the 95 % intervals hold 93 to 97 %, within two standard errors of the study; error over σ is near 1."""
    T, x, dt, _ = three_hours(shape, K, 600)
    polynomial, reach, _ = allan_temperature.fit_temperature(x, T, dt)
    error = polynomial.coefficients[1]
    assert 0.93 - 0.018 < np.mean(np.abs(error) <= reach[1]) < 0.97 + 0.018
    assert 0.9 < np.sqrt(np.mean((error / polynomial.sigma[1]) ** 2)) < 1.15
    assert np.abs(error / polynomial.sigma[1]).max() < 6.0


@pytest.mark.parametrize("first", [np.ones(4), np.array([1e6, 1e-6, 1e-6, 1e-6])])
def test_the_noise_is_that_of_the_greatest_restricted_likelihood(first):
    """By a search that uses the likelihood alone, no derivative of it and no expected power; from far off steps are halved."""
    T = warm_up(3000)
    bins, _, _ = allan_temperature._binned(records(3000, 1, 0)[:, 0], (T - T.mean())[:, None], DT)
    start = first * bins.square.sum() / (bins.basis @ bins.number).sum()
    fit = allan_temperature._maximised(bins, start, np.ones(4, bool))
    loss = lambda logs: allan_temperature._fitted(bins, np.exp(logs)).loss  # noqa: E731
    assert fit.loss - minimize(loss, np.log(fit.theta), method="Nelder-Mead", options={"maxiter": 4000}).fun < 1e-6


def test_an_interval_of_a_mixture_holds_its_draws():
    """Two normal distributions, a narrow one and a wide one beside it: 2e5 draws, ±4 standard errors."""
    weights, centre, sigma = np.array([0.7, 0.3]), np.array([-0.3, 0.7]), np.array([0.2, 3.0])
    reach = allan_temperature._half_width(weights, centre, sigma)
    random = np.random.default_rng(1)
    which = random.choice(2, 200_000, p=weights)
    held = np.mean(np.abs(centre[which] + sigma[which] * random.standard_normal(200_000)) <= reach)
    assert abs(held - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / 200_000)
