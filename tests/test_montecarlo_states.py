"""Filters with error states in the lanes: each run is what the filter of one record makes of it, in its own bits and with its own unit."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from measured import errors_at, waves
from spin_plan import assert_same, different

from strapdown import consistency, montecarlo, scenarios, vectors
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup, SensorStates, States
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.montecarlo import scalar

FIELD = np.array([20000.0, 3000.0, -43000.0])
GYRO = GyroSpec(
    angle_random_walk=1e-4,
    rate_random_walk=1e-6,
    bias_instability=2e-5,
    scale_factor=np.array([3e-3, -2e-3, 1e-3]),
    misalignment=1e-3 * (1.0 - np.eye(3)),
    g_sensitivity=np.diag([2e-6, -1e-6, 3e-6]),
)
MOTION = waves((np.array([1.0, 0.1, 0.3]), 0.4), (np.array([0.0, 0.8, 0.5]), 0.27, 1.2))
GYRO_STATES = States(
    gyro_scale_sigma=3e-3,
    gyro_misalignment_sigma=((0.0, 1e-3, 1e-3), (1e-3, 0.0, 1e-3), (1e-3, 1e-3, 0.0)),
    gyro_force_sigma=(2e-6, 1e-6, 3e-6),
    gyro_drift_sigma=(1e-5, 2e-5, 1e-5),
    gyro_drift_time=(30.0, 2.0, 0.05),
)
"""The quickest drift makes a filter step of several."""
NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)
SLANTED = vectors.AttitudeSensor(name="star", sigma_across=5e-5, sigma_about=3e-4, rate=3.0, boresight=(0.6, 0.0, 0.8))
TRACKER = replace(SLANTED, boresight="z")


def accelerometer(kind="direction", **changes):
    return vectors.Accelerometer(
        name="accelerometer", sigma=0.05, rate=20.0, kind=kind, lever_arm_b=np.array([0.1, -0.05, 0.3]), **changes
    )


def magnetometer(kind):
    faults = vectors.Faults(correlated_sigma=100.0, correlation_time=5.0)
    return vectors.Magnetometer(
        name="magnetometer",
        sigma=300.0,
        rate=7.0,
        kind=kind,
        field_f=FIELD,
        hard_iron=np.array([900.0, 0.0, 200.0]),
        faults=faults,
    )


# name: (sensors, the filter's states)
MODELS = {
    "gyro, star tracker": ((TRACKER,), GYRO_STATES),
    "mounting of a tilted star tracker": (
        (TRACKER, replace(SLANTED, name="other")),
        replace(GYRO_STATES, sensors={"other": SensorStates(bias_sigma=2e-4)}),
    ),
    "lever arm, hard iron, soft iron": (
        (accelerometer(), magnetometer("direction")),
        States(
            sensors={
                "accelerometer": SensorStates(lever_arm_sigma=0.3, bias_sigma=3e-3),
                "magnetometer": SensorStates(
                    bias_sigma=0.02, mounting_sigma=0.01, correlated_sigma=2e-3, correlation_time=5.0
                ),
            }
        ),
    ),
    "whole vectors": (
        (accelerometer("vector"), magnetometer("vector")),
        replace(
            GYRO_STATES,
            sensors={
                "accelerometer": SensorStates(lever_arm_sigma=(0.0, 0.1, 0.3)),
                "magnetometer": SensorStates(bias_sigma=900.0, mounting_sigma=0.01),
            },
        ),
    ),
    "heading": (
        (accelerometer(), magnetometer("heading")),
        States(
            gyro_drift_sigma=(2e-5,),
            gyro_drift_time=(20.0,),
            gyro_fast_bias_sigma=3e-5,
            sensors={"magnetometer": SensorStates(bias_sigma=0.02, mounting_sigma=0.01)},
        ),
    ),
    "no error states, plain sensors": ((accelerometer(), magnetometer("heading"), TRACKER), States()),
}


@cache
def plan(name: str, **changes) -> montecarlo.Plan:
    sensors, states = MODELS[name]
    scenario = scenarios.Scenario(motion=MOTION, gyro=GYRO, sensors=sensors, rate=50.0, duration=20.0)
    filter_setup = FilterSetup(process_noise=NOISE, attitude_sigma=0.02, bias_sigma=1e-4, states=states)
    return montecarlo.Plan(scenario=scenario, setup=filter_setup, seed=3, epochs=20, nis_bins=10, **changes)


def quick_or_slow(names) -> list:
    """Mark all models slow but that of a heading: the filter of each, and its lanes, take 6 to 9 s to compile."""
    return [pytest.param(name, marks=[] if name == "heading" else pytest.mark.slow) for name in names]


def assert_filtered_alike(replayed, filter_setup):
    """Assert that a replayed run is what the filter of one record, another loop and layout, makes of it: to 1e-8 of σ."""
    estimate = replayed.estimate
    other = setup.run(replayed.record, filter_setup, replayed.initial, full_covariance=True)
    sigma = np.sqrt(other.variance)
    apart = consistency.errors(estimate.attitude, estimate.bias, other.attitude, other.bias) / sigma
    assert np.abs(apart).max() < 1e-8
    P = (estimate.covariance - other.covariance) / (sigma[:, :, None] * sigma[:, None, :])
    assert np.abs(P).max() < 1e-8
    assert np.allclose(estimate.variance, other.variance, rtol=1e-8, atol=0.0)
    assert estimate.skipped == other.skipped
    for sensor, innovations in other.innovations.items():
        mine = estimate.innovations[sensor]
        assert np.array_equal(mine.time, innovations.time)
        assert np.allclose(mine.variance, innovations.variance, rtol=1e-8, atol=0.0)
        assert np.allclose(mine.nis, innovations.nis, rtol=1e-7, atol=1e-7)
    for block, state in other.error_states.items():
        mine = estimate.error_states[block]
        assert np.abs((mine.values - state.values) / np.sqrt(state.variance)).max() < 1e-8
        assert np.allclose(mine.variance, state.variance, rtol=1e-8, atol=0.0)


@pytest.mark.parametrize("name", quick_or_slow(MODELS))
def test_each_run_is_what_the_filter_alone_makes_of_it(name):
    """Errors, σ, correlations, NIS and error states; also where the first measurements are far more precise than the state."""
    model_plan = plan(name)
    assert montecarlo.choose(model_plan).machine == "lanes"
    vague = replace(model_plan, setup=replace(model_plan.setup, attitude_sigma=0.3))
    for run in (0, 5):
        assert_filtered_alike(montecarlo.replay(model_plan, run), model_plan.setup)
        assert_filtered_alike(montecarlo.replay(vague, run), vague.setup)


@pytest.mark.parametrize("name", quick_or_slow(["whole vectors", "heading"]))
def test_the_units_of_the_runs_are_those_of_the_simulator(name):
    """Without noise a run has the same gyro and sensors on both machines: error matrix, force, hard iron, lever arm."""
    model_plan = plan(
        name, individuals=True, dispersions=montecarlo.Dispersions(scale_factor_sigma=1e-3, turn_on_bias_sigma=1e-4)
    )
    gyro = replace(GYRO, angle_random_walk=0.0, rate_random_walk=0.0, bias_instability=0.0)
    sensors = tuple(replace(sensor, sigma=1e-9, faults=vectors.Faults()) for sensor in model_plan.scenario.sensors)
    sigma = {sensor.name: 0.01 for sensor in sensors}
    model_plan = replace(
        model_plan,
        scenario=replace(model_plan.scenario, gyro=gyro, sensors=sensors),
        setup=replace(model_plan.setup, sigma=sigma, states=plan(name).setup.states),
    )
    for run in (0, 11):
        fast, slow = montecarlo.replay(model_plan, run).record, scalar.record_of(model_plan, run)
        assert not np.allclose(fast.increments, scalar.record_of(model_plan, run + 1).increments, atol=1e-7)
        assert np.allclose(fast.increments, slow.increments, rtol=0.0, atol=1e-12)
        assert np.allclose(fast.truth.bias, slow.truth.bias, rtol=0.0, atol=1e-12)
        for mine, series in zip(fast.vectors, slow.vectors, strict=True):
            assert np.allclose(mine.vector_b, series.vector_b, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("name", quick_or_slow(["gyro, star tracker", "heading"]))
def test_statistics_do_not_depend_on_chunks_and_threads_and_a_replay_is_the_run(name):
    model_plan = plan(name, individuals=True)
    whole = montecarlo.run_plan(model_plan, runs=20, chunk=20, threads=1)
    for chunk, threads in ((8, 2), (3, 1), (1, 2)):  # in chunks of one each run is in the first lane
        other = montecarlo.run_plan(model_plan, runs=20, chunk=chunk, threads=threads)
        exact = ["finite", "coverage", "histogram", "worst_run", "worst_score"]
        assert not different(whole, other, [*exact, "example_run", "example_error", "example_sigma"])
    again = montecarlo.run_plan(model_plan, runs=20, chunk=20, threads=2)
    assert_same(whole, again)
    for run in (0, 5):
        replayed = montecarlo.replay(model_plan, run)
        rows = slice(None, None, model_plan.every)
        assert np.array_equal(errors_at(replayed.estimate, replayed.record.truth, rows), whole.example_error[run])
        assert np.array_equal(np.sqrt(replayed.estimate.variance[rows]), whole.example_sigma[run])
