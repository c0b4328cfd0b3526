"""A sensor's σ of each body axis: how a filter models it, who refuses it, and that tuning recovers it."""

import dataclasses
import json

import numpy as np
import pytest
from measured import FIELD, waves
from two_stars import drawn_case as case_of

from strapdown import gyro, montecarlo, motion, quaternion, scenarios, tuning, units, vectors
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.recordings import recordfiles
from strapdown.scenarios import Scenario
from strapdown.tuning import parameters

ARCSEC = units.ARCSECOND
STAR = np.array([10.0, 10.0, 60.0]) * ARCSEC
AXES = ("star.sigma.x", "star.sigma.y", "star.sigma.z")
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


def test_modelled_record_gives_a_series_three_and_keeps_its_course():
    record = scenarios.simulate(swaying(duration=2.0), 1)
    course = np.linspace(1.0, 2.0, len(record.vectors[0].time))
    varying = dataclasses.replace(record.vectors[0], sigma=course * 1e-7)
    record = dataclasses.replace(record, vectors=(varying, record.vectors[1]))
    filter_setup = dataclasses.replace(
        setup.FilterSetup.for_scenario(swaying(duration=2.0), states=False),
        sigma={"mag": (1e-7, 2e-7, 3e-7)},
        measurement_sigma_factor=2.0,
    )
    mag, acc = setup.modelled_record(record, filter_setup).vectors
    np.testing.assert_allclose(np.sqrt(np.mean(mag.sigma_axes**2, axis=0)), [2e-7, 4e-7, 6e-7], rtol=1e-14)
    np.testing.assert_allclose(mag.sigma_axes / mag.sigma_axes[0], (course / course[0])[:, None] * np.ones(3))
    np.testing.assert_allclose(mag.sigma, np.sqrt(np.mean(mag.sigma_axes**2, axis=1)))
    assert mag.anisotropic
    np.testing.assert_allclose(acc.sigma, 0.1)
    assert not acc.anisotropic


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


def test_names_start_from_the_present_sigma():
    record = scenarios.simulate(tracked(5.0), 1)
    filter_setup = setup.FilterSetup.for_scenario(tracked(5.0), states=False)
    assert tuning.parameters.axis_names([record]) == AXES
    assert tuning.default_names([record]) == ("gyro.arw", "gyro.rrw", "star.sigma")
    values = tuning.values_of(filter_setup, AXES, [record])
    np.testing.assert_allclose([values[name] for name in AXES], STAR)
    size = tuning.values_of(filter_setup, ["star.sigma"], [record])["star.sigma"]
    assert size == pytest.approx(np.sqrt(np.mean(STAR**2)))
    # One number stands for all axes in the record's ratios; three are themselves; the setup's factor is on both.
    twice = dataclasses.replace(filter_setup, sigma={"star": 2.0 * size}, measurement_sigma_factor=3.0)
    assert list(tuning.values_of(twice, AXES, [record]).values()) == pytest.approx(6.0 * STAR)
    three = dataclasses.replace(twice, sigma={"star": (1e-5, 2e-5, 3e-5)})
    assert list(tuning.values_of(three, AXES, [record]).values()) == pytest.approx([3e-5, 6e-5, 9e-5])
    changed = tuning.with_values(three, {"star.sigma.y": 3e-5})
    assert changed.sigma["star"] == pytest.approx((1e-5, 1e-5, 3e-5))
    changed = tuning.with_values(three, {"star.sigma": 6.0 * np.sqrt(14.0 / 3.0) * 1e-5})
    assert changed.sigma["star"] == pytest.approx((2e-5, 4e-5, 6e-5))
    with pytest.raises(InputError, match="no three sigmas for star"):
        tuning.with_values(filter_setup, {"star.sigma.y": 3e-5})
    assert tuning.unit_of("star.sigma.x", [record]).name == "arcsec"
    assert tuning.parameters.axis_of("star.sigma") is None
    silent = dataclasses.replace(record, vectors=(dataclasses.replace(record.vectors[0], sigma_axes=np.zeros(3)),))
    assert parameters.by_axis(twice, ["star.sigma.z"], [silent]).sigma["star"] == (2.0 * size,) * 3
    filled = parameters.by_axis(filter_setup, ["star.sigma.z"], [record])
    assert setup.from_toml(setup.to_toml(filled)) == filled


def test_of_an_attitude_one_factor_on_three_is_the_same_in_both_likelihoods():
    filter_setup = setup.FilterSetup.for_scenario(tracked(20.0), states=False)
    three = dataclasses.replace(filter_setup, sigma={"star": (5e-5, 1e-4, 2e-4)})
    case = case_of(tracked(20.0), filter_setup, 1)
    plain = tuning.likelihood([case], three, ["gyro.arw", "star.sigma"])
    other = tuning.likelihood([case], three, ["gyro.arw", *AXES])
    for log_factor in (0.0, 0.4):
        expected = plain.minus_log(plain.start + np.array([0.3, log_factor]))
        value = other.minus_log(other.start + np.array([0.3, log_factor, log_factor, log_factor]))
        np.testing.assert_allclose(value, expected, rtol=1e-9)


def recovered(scenario, truth, free, seed, **measured) -> np.ndarray:
    """Return the errors of the log σ over their standard errors, from a start wrong by 3 either way."""
    filter_setup = setup.FilterSetup.for_scenario(scenario, states=False)
    case = case_of(scenario, filter_setup, seed)
    if measured:
        record = dataclasses.replace(case.record, **measured)
        case = dataclasses.replace(case, record=record)
    sensor = parameters.axis_of(free[-1])[0]
    off = dataclasses.replace(filter_setup, sigma={sensor: tuple(truth * np.array([3.0, 1.0 / 3.0, 3.0]))})
    objective = tuning.likelihood([case], off, free)
    fit = tuning.fit(objective, starts=1, intervals=False)
    assert fit.setup.states is None
    assert isinstance(fit.setup.sigma[sensor], tuple)
    by_name = [fit[f"{sensor}.sigma.{axis}"] for axis in "xyz"]
    assert [parameter.value for parameter in by_name] == pytest.approx(list(fit.setup.sigma[sensor]))
    errors = [parameter.standard_error for parameter in by_name]
    np.testing.assert_array_less(errors, 0.2)
    return np.log(np.array(fit.setup.sigma[sensor]) / truth) / errors


@pytest.mark.parametrize(
    ("seeds", "inside", "squares"),
    [(6, (0.75, 1.0), (0.2, 2.5)), pytest.param(60, (0.901, 0.99), (0.7, 1.4), marks=pytest.mark.slow)],
)
def test_a_star_tracker_is_recovered_within_its_intervals(seeds, inside, squares):
    ratios = np.array([recovered(tracked(), STAR, ["gyro.arw", *AXES], seed) for seed in range(seeds)])
    assert inside[0] <= np.mean(np.abs(ratios) < 1.96) <= inside[1], ratios
    assert squares[0] < np.mean(ratios**2) < squares[1], ratios


@pytest.mark.parametrize("kind", ["vector", "direction"])
def test_a_magnetometer_is_recovered_though_its_axes_mix_in_every_innovation(kind):
    scenario = swaying(kind)
    truth = np.array([3e-7, 6e-7, 1.5e-6]) / (1.0 if kind == "vector" else np.linalg.norm(FIELD))
    ratios = []
    for seed in range(2):
        mag, acc = scenarios.simulate(scenario, seed).vectors
        exact = scenario.motion.attitude(mag.time)
        size = FIELD if kind == "vector" else FIELD / np.linalg.norm(FIELD)
        vector = quaternion.rotate(quaternion.conjugate(exact), np.broadcast_to(size, (len(mag.time), 3)))
        vector = vector + truth * np.random.default_rng(seed).standard_normal(vector.shape)
        if kind == "direction":
            vector /= np.linalg.norm(vector, axis=1, keepdims=True)
        noisy = dataclasses.replace(mag, vector_b=vector)
        free = ["mag.sigma.x", "mag.sigma.y", "mag.sigma.z"]
        ratios.append(recovered(scenario, truth, free, seed, vectors=(noisy, acc)))
    assert np.max(np.abs(ratios)) < 2.9, ratios
    assert np.mean(np.square(ratios)) < 2.5, ratios


@pytest.mark.slow
def test_the_command_tunes_the_axes_of_a_record(succeeds, tmp_path):
    path, out, first = tmp_path / "star.h5", tmp_path / "tuned.toml", tmp_path / "first.toml"
    scenario = tracked(60.0)
    recordfiles.write_record(path, scenarios.simulate(scenario, 4))
    off = dataclasses.replace(setup.FilterSetup.for_scenario(scenario, states=False), sigma={"star": tuple(3.0 * STAR)})
    first.write_text(setup.to_toml(off), encoding="utf-8")
    command = ("tune", path, "--filter", first, "--free", ",".join(AXES), "--starts", 1, "-o", out)
    said = succeeds(*command, "--holdout", 0.3)
    assert "star.sigma.z" in said
    filter_setup = setup.read_setup(out)
    assert filter_setup.states is None
    np.testing.assert_allclose(filter_setup.sigma["star"], STAR, rtol=0.4)
    names = [parameter["name"] for parameter in json.loads(out.with_suffix(".json").read_text())["parameters"]]
    assert names == list(AXES)
    said = succeeds(*command, "--gate")
    assert "The records show no outliers" in said
    np.testing.assert_allclose(setup.read_setup(out).sigma["star"], STAR, rtol=0.4)
