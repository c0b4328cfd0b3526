"""Filters that model a known multiple of Q or R: the Monte Carlo fails them by as much as theory says, and passes the right one."""

import numpy as np
import pytest

from sims import campaign as sim
from strapdown import montecarlo


def held_against_theory(runs, seed, machine):
    result = sim.main(runs=runs, seed=seed, machine=machine)
    for name, predicted in result.predictions.items():
        found = result.statistics[name]
        # 100 epochs × 3 subsets × 5 filters, and 300 spans of NIS: 4.5σ is passed by chance in one of some 50 such tests.
        for column, subset in enumerate(("state", "attitude", "bias")):
            off = (found.anees[1:, column] - predicted.anees(subset)[1:]) / predicted.standard_error(subset, runs)[1:]
            assert np.abs(off).max() < 4.5, (name, subset)
        off = (found.nis / predicted.nis - 1.0) / np.sqrt(2.0 / (3.0 * runs))
        assert np.abs(off).max() < 4.5, name
        P = np.einsum("mii->mi", found.covariance)
        modelled = np.einsum("mii->mi", predicted.covariance)
        assert np.allclose(P[:, :3], modelled[:, :1], rtol=1e-4)
        assert np.allclose(P[:, 3:], modelled[:, 1:], rtol=1e-4)
        # the true spread, Σ e eᵀ over the runs, against its own sampling error
        square = np.einsum("mii->mi", found.mean_square_error)[1:]
        true = np.einsum("mii->mi", predicted.true_covariance)[1:]
        ratio = square.reshape(-1, 2, 3).mean(axis=2) / true
        assert np.abs(ratio - 1.0).max() < 4.5 * np.sqrt(2.0 / (3.0 * runs)), name
        assert montecarlo.summary(found)["consistent"] == (name == "right"), name


def test_mismatched_filters_fail_by_as_much_as_theory_says():
    held_against_theory(150, 3, "lanes")


@pytest.mark.slow
@pytest.mark.parametrize("machine", ["scalar", "lanes"])
def test_mismatched_filters_fail_by_as_much_as_theory_says_over_5000_runs(machine):
    held_against_theory(5000, 4, machine)


def test_theory_ends_in_the_steady_state_of_farrenkopf():
    """The filter's own covariance, against the closed form of one axis at rest."""
    T, sigma_v, sigma_u = sim.INTERVAL, float(sim.GYRO.angle_random_walk), float(sim.GYRO.rate_random_walk)
    s_u, s_v = sigma_u * T**1.5 / sim.SIGMA, sigma_v * np.sqrt(T) / sim.SIGMA
    gamma = np.sqrt(1.0 + s_v**2 / 4.0 + s_u**2 / 48.0)
    zeta = gamma + s_u / 4.0 + 0.5 * np.sqrt(2.0 * gamma * s_u + s_v**2 + s_u**2 / 3.0)
    end = sim.predict(1.0, 1.0, 100)
    assert end.covariance[-1, 0, 0] == pytest.approx(sim.SIGMA**2 * (1.0 - zeta**-2), rel=1e-6)
    bias = sigma_u * sim.SIGMA / np.sqrt(T) * (zeta - 1.0 / zeta) - 0.5 * sigma_u**2 * T
    assert end.covariance[-1, 1, 1] == pytest.approx(bias, rel=1e-5)
    assert np.allclose(end.covariance, end.true_covariance, rtol=1e-12)
    assert np.allclose(end.nis, 1.0, rtol=1e-12)
