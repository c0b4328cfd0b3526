"""The noise of a gyro's increment in the attitude at large turns a sample, and how far the filter's σ_v² dt I is from it."""

import math

import numpy as np
import pytest

from strapdown import estimation, gyro, motion, quaternion, records


def across(x):
    """Variance across the axis of turn over σ_v² dt: |J_r|² = 2(1 − cos x)/x²."""
    return 2.0 * (1.0 - math.cos(x)) / x**2


def test_the_simulated_gyros_errors_have_that_covariance():
    """20 000 increments of 2 rad about z, each turned into an attitude by itself."""
    n, dt, sigma = 20_000, 0.01, 1e-3
    body = motion.ConstantRate(rate=(0.0, 0.0, 200.0))
    edges = np.arange(n + 1) * dt
    spec = gyro.GyroSpec(angle_random_walk=sigma)
    given = gyro.simulate(spec, body.increments(edges), edges, np.random.default_rng(4))
    true = quaternion.exp(np.array([0.0, 0.0, 2.0]))
    error = quaternion.log(quaternion.multiply(quaternion.conjugate(quaternion.exp(given.increments)), true))
    found = error.T @ error / n / (sigma**2 * dt)
    spread = math.sqrt(2.0 / n)  # of a variance over itself
    expected = np.array([across(2.0), across(2.0), 1.0])
    assert np.all(np.abs(np.diag(found) / expected - 1.0) < 4.0 * spread)
    assert np.all(np.abs(found - np.diag(np.diag(found))) < 4.0 / math.sqrt(n))


@pytest.mark.parametrize("x", [0.1, 0.35, 1.0, 2.0])
def test_the_filter_is_off_by_no_more_than_its_docstring_says(x):
    """Too large across the axis, never too small: 1 % of the variance at 0.35 rad a sample, 9 % at 1 rad, 41 % at 2 rad."""
    dt, sigma = 0.01, 1e-3
    record = records.ImuRecord(time=np.array([0.0, dt]), increments=np.array([[0.0, 0.0, x]]))
    start = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-9, bias_sigma=1e-12)
    noise = estimation.ProcessNoise(angle_random_walk=sigma, rate_random_walk=0.0)
    P = estimation.run(record, noise, start, full_covariance=True).covariance[-1] / (sigma**2 * dt)
    assert P[2, 2] == pytest.approx(1.0, rel=1e-6)
    for axis in (0, 1):
        excess = P[axis, axis] / across(x) - 1.0
        assert -1e-6 <= excess <= 1.0 / across(x) - 1.0 + 1e-6
        assert excess <= {0.1: 0.00084, 0.35: 0.0103, 1.0: 0.088, 2.0: 0.413}[x]
