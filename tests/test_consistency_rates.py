"""False alarms: of filters that are right, every statistic refuses as many as it says, to a binomial error."""

from dataclasses import replace

import numpy as np
import pytest
from spin_plan import PLAN

from benchmarks import power
from strapdown import consistency, montecarlo, motion, scenarios, units, vectors
from strapdown.estimation import setup
from strapdown.gyro import GyroSpec
from strapdown.montecarlo import scalar, statistics


def within_binomial(p_values, sigmas):
    """Assert that 5 and 1 % of the p-values lie below 0.05 and 0.01; return what did."""
    n = len(p_values)
    for nominal in (0.05, 0.01):
        share = np.mean(p_values < nominal)
        assert abs(share - nominal) < sigmas * np.sqrt(nominal * (1.0 - nominal) / n), (nominal, share)


SINGLE = (
    "NEES at the end",
    "time-averaged NEES",
    "NIS",
    "whiteness",
    "normality",
    "mean innovation",
    "cross-correlation",
)


@pytest.fixture(scope="module")
def few():
    return power.single_run_p_values(power.linear_filters(400, 500, np.random.default_rng(1)))


@pytest.mark.parametrize("statistic", SINGLE)
def test_statistics_of_one_run(few, statistic):
    within_binomial(few[statistic], 4.0)


@pytest.mark.parametrize(("runs", "n"), [(50, 6), (20, 3)])
def test_statistics_of_many_runs(runs, n):
    white = np.random.default_rng(3).standard_normal((3000, runs, n))
    for p in power.many_run_p_values(white).values():
        within_binomial(p, 4.0)


def test_no_run_of_right_filters_is_beyond_chance(monkeypatch):
    """The bound holds for independent epochs, its worst case, and for a few runs, where the mean of the others scatters."""
    random = np.random.default_rng(5)
    plain = scalar.run_chunk(PLAN, 0, 1)
    for runs in (3, 48):
        nees = random.chisquare(6, (2000, runs, len(plain.time)))
        named = {0.05: 0, 1e-4: 0}
        for campaign in nees:
            run, score = statistics.worst(np.arange(runs), campaign.max(axis=1))
            sums = np.repeat(campaign.sum(axis=0)[:, None], 3, axis=1)
            total = replace(
                plain, runs=runs, finite=runs + 0 * plain.finite, nees_sum=sums, worst_run=run, worst_score=score
            )
            for level in named:
                monkeypatch.setattr(statistics, "ODD", level)
                named[level] += bool(statistics._odd_runs(total))
        assert named[1e-4] <= 2
        assert named[0.05] <= 100 + 3.0 * np.sqrt(95.0)
    assert named[0.05] > 0  # conservative, not idle


@pytest.mark.slow
def test_ten_thousand_right_filters():
    """The measure of all bounds: within three binomial standard errors of nominal."""
    p_values = power.single_run_p_values(power.linear_filters(10_000, 500, np.random.default_rng(7)))
    for statistic in SINGLE:
        within_binomial(p_values[statistic], 3.0)
    ends = [power.linear_filters(100_000, 60, np.random.default_rng([8, k]), every=60) for k in range(5)]
    white = np.concatenate(
        [consistency.whitened(e.error[:, -1], np.broadcast_to(e.covariance[-1], (100_000, 2, 2))) for e in ends]
    )
    for p in power.many_run_p_values(white.reshape(10_000, 50, 2)).values():
        within_binomial(p, 3.0)


def satellite(duration=300.0):
    """A datasheet with bias instability and scale factor; the filter that matches it by default has states for both."""
    scenario = scenarios.Scenario(
        motion=motion.TorqueFree(inertia=[10.0, 15.0, 20.0], initial_rate=np.radians([0.3, 0.5, 0.2])),
        gyro=GyroSpec(
            angle_random_walk=0.15 * units.DEGREE_PER_ROOT_HOUR,
            bias_instability=0.3 * units.DEGREE_PER_HOUR,
            scale_factor=200e-6,
        ),
        sensors=(
            vectors.AttitudeSensor(
                name="tracker", sigma_across=5.0 * units.ARCSECOND, sigma_about=30.0 * units.ARCSECOND, rate=2.0
            ),
        ),
        rate=50.0,  # at 5 Hz the states for flicker are 2 % too careful
        duration=duration,
        gravity_f=(0.0, 0.0, 0.0),
    )
    filter_setup = setup.FilterSetup.for_scenario(scenario, states=True)
    return montecarlo.Plan(scenario=scenario, setup=filter_setup, epochs=50, individuals=True)


def verdicts_of_runs(plan, runs):
    """The verdict on single runs of a plan, each of its own gyro."""
    verdicts = []
    for run in range(runs):
        again = montecarlo.replay(plan, run, machine="scalar")
        verdicts.append(consistency.judge(again.estimate, again.record.truth).verdict)
    return verdicts


def verdicts_of_campaigns(campaigns, runs):
    """The verdict on campaigns of the lanes, of a right filter."""
    scenario = replace(scenarios.load_scenario("two-stars"), duration=20.0)
    verdicts = []
    for seed in range(campaigns):
        plan = montecarlo.Plan(
            scenario=scenario, setup=setup.FilterSetup.for_scenario(scenario, states=False), seed=seed, epochs=40
        )
        verdicts.append(montecarlo.run_plan(plan, runs=runs, threads=1).judge().verdict)
    return verdicts


def test_few_campaigns_of_a_right_filter_are_called_wrong():
    verdicts = verdicts_of_campaigns(20, 160)
    assert verdicts.count("not consistent") <= 2
    assert verdicts.count("consistent") >= 18  # and 160 runs suffice


@pytest.mark.slow
def test_verdicts_a_thousand_times():
    """At most 1 % of right filters are called wrong, to three binomial errors: of single runs with error states, and of campaigns."""
    most = 1000 * 0.01 + 3.0 * np.sqrt(1000 * 0.01 * 0.99)
    assert verdicts_of_runs(satellite(), 1000).count("not consistent") <= most
    assert verdicts_of_campaigns(1000, 160).count("not consistent") <= most
