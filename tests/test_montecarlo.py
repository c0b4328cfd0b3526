"""Is the filter as good as it says? Statistics over independent runs, fixed seeds, two-sided bounds."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from measured import turn_to

from sims import campaign as sim
from strapdown import coning, montecarlo, motion
from strapdown.estimation.states import ProcessNoise
from strapdown.montecarlo import FilterSetup, coning_study
from strapdown.montecarlo.coning_study import ConingParameters

PARAMETERS = ConingParameters(duration=24.0)
SCENARIO = PARAMETERS.scenario
NOISE = ProcessNoise(angle_random_walk=coning_study.ANGLE_RANDOM_WALK, rate_random_walk=coning_study.RATE_RANDOM_WALK)
EPOCHS = np.arange(5, 101, 5)


def setup(algorithm="matched-4-11", noise=NOISE, **changes):
    return FilterSetup(
        process_noise=noise,
        attitude_sigma=coning_study.ATTITUDE_SIGMA,
        bias_sigma=coning_study.BIAS_SIGMA,
        integration=coning.ALGORITHMS[algorithm],
        **changes,
    )


def inside(statistics, subset, probability=0.99):
    """Whether no more of the 20 epochs lie outside their own bounds than chance allows (binomial, once in 1000)."""
    verdict = statistics.verdict(EPOCHS, subset, probability)
    low, high = verdict.bounds
    outside = np.sum((verdict.mean < low) | (verdict.mean > high))
    return outside <= scipy.stats.binom.ppf(0.999, len(EPOCHS), 1.0 - probability)


WRONG = {
    "a quarter of the process noise": setup(
        noise=ProcessNoise(
            angle_random_walk=0.5 * NOISE.angle_random_walk, rate_random_walk=0.5 * NOISE.rate_random_walk
        )
    ),
    "sigma 20 % too large": setup(measurement_sigma_factor=1.25),
    "no coning correction": setup("one-sample"),
}


def hold_to_their_covariance(statistics):
    """Hold errors and innovations of runs to the covariances of the filter."""
    for subset in ("state", "attitude", "bias"):
        assert inside(statistics, subset), (subset, statistics.verdict(EPOCHS, subset).mean)
    low, high = statistics.nis_bounds()
    assert low < statistics.mean_nis < high
    # RMS error against the filter's own σ: (runs × 3 axes) at each epoch
    ratio = np.sqrt((statistics.rms_error[EPOCHS] ** 2).reshape(20, 2, 3).mean(axis=2)) / np.sqrt(
        (statistics.sigma[EPOCHS] ** 2).reshape(20, 2, 3).mean(axis=2)
    )
    assert np.all(np.abs(ratio - 1.0) < 4.5 / np.sqrt(2 * statistics.runs * 3))


def test_the_filter_is_as_good_as_it_says_and_wrong_ones_are_found_out():
    """Over the same 60 runs of coning at 10 Hz; the wrong ones on the side that it must be."""
    right, *wrong = montecarlo.run(SCENARIO, (setup(), *WRONG.values()), runs=60, seed=3)
    hold_to_their_covariance(right)
    for name, statistics in zip(WRONG, wrong, strict=True):
        verdict = statistics.verdict(EPOCHS, "bias" if "coning" in name else "attitude")
        assert not verdict.consistent, name
        assert (verdict.mean.mean() > 1.0) == ("quarter" in name or "coning" in name), name  # too sure of itself


def test_a_filter_of_a_spinning_body_is_as_good_as_it_says():
    spinning = replace(SCENARIO, motion=motion.ConstantRate(rate=(1.0, -1.5, 0.8)))
    hold_to_their_covariance(montecarlo.run(spinning, (setup("one-sample"),), runs=60, seed=3)[0])


def test_the_filter_is_consistent_from_large_errors_too():
    """Initial errors of 0.1 rad an axis, known to a fifth of that after one measurement."""
    sensors = tuple(replace(s, sigma=0.02, rate=25.0) for s in SCENARIO.sensors)
    scenario = replace(SCENARIO, motion=motion.rest(), sensors=sensors, duration=12.0)
    big = replace(setup("one-sample"), attitude_sigma=0.1, bias_sigma=0.05)
    (statistics,) = montecarlo.run(scenario, (big,), runs=60, seed=6)
    verdict = statistics.verdict(np.arange(1, 100, 5), "attitude")
    assert verdict.consistent, verdict.mean


def test_the_start_is_drawn_from_the_prior():
    from strapdown.scenarios import simulate

    record = simulate(replace(SCENARIO, duration=1.2), 1)
    draws = []
    for run in range(400):
        state = montecarlo.start(record, setup(), 1, run)
        delta = turn_to(state.attitude, record.truth.attitude[0]) / coning_study.ATTITUDE_SIGMA
        draws.append(np.concatenate([delta, (record.truth.bias[0] - state.bias) / coning_study.BIAS_SIGMA]))
    assert np.all(np.abs(np.mean(draws, axis=0)) < 4.0 / 20.0)
    assert np.all(np.abs(np.var(draws, axis=0) - 1.0) < 4.0 * np.sqrt(2.0 / 400.0))


def held_against_theory(runs, seed, machine):
    result = sim.main(runs=runs, seed=seed, machine=machine)
    for name, predicted in result.predictions.items():
        statistics = result.statistics[name]
        # 100 epochs × 3 subsets × 5 filters, and 300 spans of NIS: 4.5σ is passed by chance in one of some 50 such tests.
        for column, subset in enumerate(("state", "attitude", "bias")):
            spread = predicted.standard_error(subset, runs)[1:]
            off = (statistics.anees[1:, column] - predicted.anees(subset)[1:]) / spread
            assert np.abs(off).max() < 4.5, (name, subset)
        off = (statistics.nis / predicted.nis - 1.0) / np.sqrt(2.0 / (3.0 * runs))
        assert np.abs(off).max() < 4.5, name
        P = np.einsum("mii->mi", statistics.covariance)
        modelled = np.einsum("mii->mi", predicted.covariance)
        assert np.allclose(P[:, :3], modelled[:, :1], rtol=1e-4)
        assert np.allclose(P[:, 3:], modelled[:, 1:], rtol=1e-4)
        # the true spread, Σ e eᵀ over the runs, against its own sampling error
        square = np.einsum("mii->mi", statistics.mean_square_error)[1:]
        true = np.einsum("mii->mi", predicted.true_covariance)[1:]
        ratio = square.reshape(-1, 2, 3).mean(axis=2) / true
        assert np.abs(ratio - 1.0).max() < 4.5 * np.sqrt(2.0 / (3.0 * runs)), name
        assert montecarlo.summary(statistics)["consistent"] == (name == "right"), name


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
