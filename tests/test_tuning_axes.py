"""A sensor's σ of each body axis: how a filter models it, and that tuning keeps their ratios."""

import dataclasses

import numpy as np
import pytest
from measured import FIELD, waves
from two_stars import drawn_case as case_of

from strapdown import gyro, montecarlo, motion, scenarios, tuning, units, vectors
from strapdown.estimation import setup
from strapdown.scenarios import Scenario

ARCSEC = units.ARCSECOND
STAR = np.array([10.0, 10.0, 60.0]) * ARCSEC
SWAY = waves(((0.8, 0.2, -0.3), 0.21), ((-0.3, 0.7, 0.4), 0.37))


def tracked(duration=120.0) -> Scenario:
    """Return a star tracker, coarse about z, beside a gyro that is worth about as much."""
    return Scenario(
        motion=motion.rest(),
        gyro=gyro.GyroSpec(angle_random_walk=3e-5, rate_random_walk=1e-6, turn_on_bias_sigma=1e-5),
        sensors=(vectors.AttitudeSensor(name="star", sigma_across=STAR[0], sigma_about=STAR[2], rate=5.0),),
        rate=20.0,
        duration=duration,
    )


def swaying(kind="vector", duration=40.0) -> Scenario:
    return Scenario(
        motion=SWAY,
        gyro=gyro.GyroSpec(angle_random_walk=1e-3, rate_random_walk=1e-4, turn_on_bias_sigma=3e-3),
        sensors=(
            vectors.Magnetometer(name="mag", field_f=FIELD, sigma=5e-7, rate=10.0, kind=kind),
            vectors.Accelerometer(name="acc", sigma=0.05, rate=10.0, kind="vector"),
        ),
        rate=20.0,
        duration=duration,
    )


def test_modelled_record_replaces_the_axes_of_an_attitude_and_any_covariance():
    record = scenarios.simulate(tracked(5.0), 1)
    whole = dataclasses.replace(record.vectors[0], sigma_axes=None, covariance=np.diag(STAR**2) + 1e-10)
    filter_setup = dataclasses.replace(
        setup.FilterSetup.for_scenario(tracked(5.0), states=False), sigma={"star": (3e-5, 1e-5, 2e-5)}
    )
    silent = dataclasses.replace(record.vectors[0], sigma_axes=np.zeros(3))
    for series in (record.vectors[0], whole, silent):
        (star,) = setup.modelled_record(dataclasses.replace(record, vectors=(series,)), filter_setup).vectors
        np.testing.assert_allclose(star.sigma_axes, np.tile([3e-5, 1e-5, 2e-5], (len(star.time), 1)))
        assert star.covariance is None


@pytest.mark.slow
def test_the_monte_carlo_takes_a_sigma_for_each_axis_in_lanes():
    for scenario, sigma, rtol in (
        (tracked(20.0), {"star": (3e-5, 6e-5, 1.5e-4)}, 1e-3),
        (swaying(), {"mag": (5e-7, 1e-6, 5e-7)}, 5e-3),  # vectors: the rows depend on the estimate
    ):
        filter_setup = dataclasses.replace(setup.FilterSetup.for_scenario(scenario, states=False), sigma=sigma)
        plan = montecarlo.Plan(scenario=scenario, setup=filter_setup, epochs=4)
        by_lanes, scalar = (montecarlo.run_plan(plan, runs=8, machine=name) for name in ("lanes", "scalar"))
        np.testing.assert_allclose(by_lanes.sigma, scalar.sigma, rtol=rtol)


def test_values_start_from_the_present_sigma_and_keep_the_ratios_of_the_axes():
    record = scenarios.simulate(tracked(5.0), 1)
    filter_setup = setup.FilterSetup.for_scenario(tracked(5.0), states=False)
    assert tuning.default_names([record]) == ("gyro.arw", "gyro.rrw", "star.sigma")
    value = tuning.values_of(filter_setup, ["star.sigma"], [record])["star.sigma"]
    assert value == pytest.approx(np.sqrt(np.mean(STAR**2)))
    # Three in the setup are themselves; the setup's factor is on all.
    three = dataclasses.replace(filter_setup, sigma={"star": (1e-5, 2e-5, 3e-5)}, measurement_sigma_factor=3.0)
    value = tuning.values_of(three, ["star.sigma"], [record])["star.sigma"]
    assert value == pytest.approx(3e-5 * np.sqrt(14.0 / 3.0))
    assert tuning.with_values(three, {"star.sigma": 2.0 * value}).sigma["star"] == pytest.approx((2e-5, 4e-5, 6e-5))
    assert tuning.unit_of("star.sigma", [record]).name == "arcsec"
    # As the estimate prints the error states of such a sensor.
    assert tuning.unit_of("acc.sigma", [scenarios.simulate(swaying(duration=1.0), 1)]).name == "unit of the reference"


@pytest.mark.parametrize(("seeds", "squares"), [(6, (0.1, 3.0)), pytest.param(60, (0.7, 1.4), marks=pytest.mark.slow)])
def test_the_factor_of_a_star_tracker_with_three_sigmas_is_recovered_within_its_interval(seeds, squares):
    """From one that is wrong by 3: its errors over their standard errors."""
    filter_setup = setup.FilterSetup.for_scenario(tracked(), states=False)
    off = dataclasses.replace(filter_setup, sigma={"star": tuple(3.0 * STAR)})
    ratios = []
    for seed in range(seeds):
        objective = tuning.likelihood([case_of(tracked(), filter_setup, seed)], off, ["gyro.arw", "star.sigma"])
        fit = tuning.fit(objective, starts=1, intervals=False)
        factor = np.array(fit.setup.sigma["star"]) / STAR
        np.testing.assert_allclose(factor, factor[0], rtol=1e-9)
        assert fit["star.sigma"].standard_error < 0.2
        ratios.append(np.log(factor[0]) / fit["star.sigma"].standard_error)
    assert squares[0] < np.mean(np.square(ratios)) < squares[1], ratios
