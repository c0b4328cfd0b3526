"""A vector that is normalised has less noise than its components: how much, and what a filter of directions makes of it."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from strapdown import estimation, motion, scenarios, vectors
from strapdown.gyro import GyroSpec


def variance_across(sigma):
    """Variance of a component across the direction, by the mixture of χ² that the squares are: ∫ t² exp(−(1 − t²)/(2σ²)) dt over [0, 1]."""
    return quad(lambda t: t * t * math.exp(-(1.0 - t * t) / (2.0 * sigma**2)), 0.0, 1.0, epsabs=0.0, epsrel=1e-12)[0]


def observed(kind, sigma, samples):
    """A body at rest, its attitude known but for 1e-6 rad, sees the field: mean NIS per degree of freedom."""
    field = vectors.Magnetometer(
        name="field", field_f=np.array([3.0, 0.0, 4.0]), sigma=5.0 * sigma, rate=10.0, kind=kind
    )
    made = scenarios.Scenario(
        motion=motion.ConstantRate(rate=(0.0, 0.0, 0.0)),
        gyro=GyroSpec(),
        sensors=(field,),
        rate=10.0,
        duration=samples / 10.0,
    )
    record = scenarios.simulate(made, seed=11)
    start = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-6, bias_sigma=1e-12)
    noise = estimation.ProcessNoise(angle_random_walk=1e-9, rate_random_walk=0.0)
    found = estimation.run(record, noise, start, every=samples).innovations["field"]
    return float(np.mean(found.nis)) / found.innovation.shape[1], found.innovation.size


@pytest.mark.parametrize("sigma", [0.05, 0.2])
def test_the_nis_of_directions_is_too_small_by_that_share_and_that_of_whole_vectors_right(sigma):
    for kind, expected in (("direction", variance_across(sigma) / sigma**2), ("vector", 1.0)):
        mean, degrees = observed(kind, sigma, 40_000)
        assert mean == pytest.approx(expected, abs=4.0 * math.sqrt(2.0 / degrees))
