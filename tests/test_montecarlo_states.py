"""Filters with error states over eight runs at once: each run is what the filter of the factor makes of it, and its own bits."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from measured import errors_at, waves
from spin_plan import assert_same, different

from strapdown import consistency, montecarlo, scenarios, vectors
from strapdown.estimation import in_lanes, setup
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
            sensors={
                "magnetometer": SensorStates(
                    bias_sigma=0.02, mounting_sigma=0.01, correlated_sigma=2e-3, correlation_time=5.0
                )
            },
        ),
    ),
    "no error states, plain sensors": ((accelerometer(), magnetometer("heading"), TRACKER), States()),
}


@cache
def plan(name: str, **changes) -> montecarlo.Plan:
    sensors, states = MODELS[name]
    scenario = scenarios.Scenario(motion=MOTION, gyro=GYRO, sensors=sensors, rate=50.0, duration=20.0)
    chosen = FilterSetup(process_noise=NOISE, attitude_sigma=0.02, bias_sigma=1e-4, states=states)
    return montecarlo.Plan(scenario=scenario, setup=chosen, seed=3, epochs=20, nis_bins=10, **changes)


@cache
def runs(name: str, number: int):
    one = plan(name)
    records = [scalar.record_of(one, run) for run in range(number)]
    return records, [scalar.start(record, one.setup, one.seed, run) for run, record in enumerate(records)]


def bits(estimate):
    """All numbers of an estimate."""
    innovations = [getattr(i, f) for i in estimate.innovations.values() for f in ("time", "innovation", "variance")]
    states = [getattr(s, f) for s in estimate.error_states.values() for f in ("values", "variance")]
    own = [getattr(estimate, f) for f in ("time", "attitude", "bias", "variance", "covariance")]
    return b"".join(np.ascontiguousarray(one).tobytes() for one in (*own, *innovations, *states))


def quick_or_slow(names) -> list:
    """Mark all models slow but that of a heading: the filter of each, and its lanes, take 6 to 9 s to compile."""
    return [pytest.param(name, marks=[] if name == "heading" else pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", quick_or_slow(MODELS))
def test_each_run_is_what_the_filter_alone_makes_of_it(name, monkeypatch):
    """Errors, σ, correlations, NIS and error states, to 1e-8 of σ; none is left to the filter of one record."""
    filtered, found = in_lanes._filtered, []
    monkeypatch.setattr(in_lanes, "_filtered", lambda *given: found.extend(filtered(*given)) or found[-3:])
    records, initials = runs(name, 3)
    chosen = plan(name).setup
    for every in (1, 50):
        eight = setup.run_together(records, chosen, initials, every)
        assert len(found) >= 3
        assert None not in found
        for record, initial, one in zip(records, initials, eight, strict=True):
            other = setup.run(record, chosen, initial, every=every, full_covariance=True)
            sigma = np.sqrt(other.variance)
            apart = consistency.errors(one.attitude, one.bias, other.attitude, other.bias) / sigma
            assert np.abs(apart).max() < 1e-8
            P = (one.covariance - other.covariance) / (sigma[:, :, None] * sigma[:, None, :])
            assert np.abs(P).max() < 1e-8
            assert np.allclose(one.variance, other.variance, rtol=1e-8, atol=0.0)
            assert one.skipped == other.skipped
            for sensor, innovations in other.innovations.items():
                mine = one.innovations[sensor]
                assert np.array_equal(mine.time, innovations.time)
                assert np.allclose(mine.variance, innovations.variance, rtol=1e-8, atol=0.0)
                assert np.allclose(mine.nis, innovations.nis, rtol=1e-7, atol=1e-7)
            for block, state in other.error_states.items():
                mine = one.error_states[block]
                assert np.abs((mine.values - state.values) / np.sqrt(state.variance)).max() < 1e-8
                assert np.allclose(mine.variance, state.variance, rtol=1e-8, atol=0.0)


@pytest.mark.parametrize("name", quick_or_slow(["gyro, star tracker", "heading"]))
def test_a_run_has_the_same_bits_whatever_runs_beside_it(name):
    """Full groups, short ones, runs in another order, and beside one that is lost or has other times, noise or references."""
    records, initials = runs(name, 9)
    chosen = plan(name).setup

    def filtered(numbers, every=10):
        return setup.run_together([records[k] for k in numbers], chosen, [initials[k] for k in numbers], every)

    alone = [bits(filtered([k])[0]) for k in range(9)]
    assert len(set(alone)) == 9
    for numbers in (range(9), [8, 2, 5], [3, 3, 3, 3], range(8, -1, -1)):
        assert [bits(one) for one in filtered(numbers)] == [alone[k] for k in numbers]
    shorter = replace(records[0], vectors=tuple(series.taken(slice(0, 30)) for series in records[0].vectors))
    lost = replace(initials[1], attitude=np.array([0.0, 1.0, 0.0, 0.0]), bias=np.full(3, 100.0))
    mixed = setup.run_together([shorter, records[1], *records[2:4]], chosen, [initials[0], lost, *initials[2:4]], 10)
    assert [bits(one) for one in mixed[2:]] == alone[2:4]
    assert bits(mixed[0]) == bits(setup.run_together([shorter], chosen, initials[:1], 10)[0])
    for change in (
        lambda series: series.noise_scaled(2.0),
        lambda series: series if series.attitude is not None else replace(series, reference_f=-series.reference_f),
    ):
        other = replace(records[0], vectors=tuple(change(series) for series in records[0].vectors))
        pair = setup.run_together([records[2], other], chosen, [initials[2], initials[0]], 10)
        assert bits(pair[0]) == alone[2]
        assert bits(pair[1]) == bits(setup.run_together([other], chosen, initials[:1], 10)[0])
    one = setup.run(records[1], chosen, lost, every=10, full_covariance=True)
    assert bits(mixed[1]) == bits(one)  # a turn beyond the range of the polynomials: filtered alone
    # What is kept does not change what is kept of it.
    (whole,) = filtered([4], every=1)
    assert np.array_equal(whole.covariance[::10], filtered([4])[0].covariance)


@pytest.mark.parametrize(
    "states",
    [
        None,
        pytest.param(
            States(
                sensors={"accelerometer": SensorStates(velocity_time=1.0, velocity_sigma=0.1, acceleration_sigma=0.5)}
            ),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            States(sensors={"magnetometer": SensorStates(correlated_sigma=0.01, correlation_time=5.0, frame="fixed")}),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["of the scenario", "chain", "fixed axes"],
)
def test_lanes_keep_the_digits_of_measurements_far_more_precise_than_the_state(states):
    """Joseph's form in some lanes only: the same as alone, and no bit of a neighbour changes."""
    chosen = plan("heading").setup
    chosen = replace(chosen, states=states) if states else chosen
    records, initials = runs("heading", 3)
    vague = replace(initials[0], covariance=np.diag([0.3, 0.3, 0.3, *np.diag(initials[0].covariance)[3:]]))
    alone = [bits(setup.run_together([r], chosen, [i], 50)[0]) for r, i in zip(records, initials, strict=True)]
    mixed = setup.run_together(records, chosen, [vague, *initials[1:]], 50)
    assert [bits(estimate) for estimate in mixed[1:]] == alone[1:]
    other = setup.run(records[0], chosen, vague, every=50, full_covariance=True)
    assert np.allclose(mixed[0].variance, other.variance, rtol=1e-7, atol=0.0)


def test_statistics_do_not_depend_on_chunks_and_threads_and_a_replay_is_the_run():
    one = plan("heading", individuals=True)
    whole = montecarlo.run_plan(one, runs=20, chunk=20, threads=1)
    for chunk, threads in ((8, 2), (3, 1)):
        other = montecarlo.run_plan(one, runs=20, chunk=chunk, threads=threads)
        exact = ["finite", "coverage", "histogram", "worst_run", "worst_score"]
        assert not different(whole, other, [*exact, "example_run", "example_error", "example_sigma"])
    again = montecarlo.run_plan(one, runs=20, chunk=20, threads=2)
    assert_same(whole, again)
    for run in (0, 5):
        found = montecarlo.replay(one, run)
        rows = slice(None, None, one.every)
        assert np.array_equal(errors_at(found.estimate, found.record.truth, rows), whole.example_error[run])
        assert np.array_equal(np.sqrt(found.estimate.variance[rows]), whole.example_sigma[run])


@pytest.mark.parametrize(
    "fault", [{"sampling_jitter": 1e-4}, {"drop_probability": 0.02}], ids=lambda fault: next(iter(fault))
)
def test_runs_whose_times_differ_are_filtered_one_by_one(fault):
    one = plan("heading")
    one = replace(one, scenario=replace(one.scenario, gyro=replace(GYRO, **fault)))
    found = scalar.run_chunk(one, 0, 2)
    for run in range(2):
        record = scalar.record_of(one, run)
        initial = scalar.start(record, one.setup, one.seed, run)
        each = setup.run(record, one.setup, initial, every=1, full_covariance=True)
        last = np.sqrt(each.variance[-1])
        assert np.allclose(found.example_sigma[run, -1], last, rtol=1e-12)
        assert np.array_equal(montecarlo.replay(one, run).estimate.attitude, each.attitude)


@pytest.mark.slow
def test_the_filter_with_states_is_as_good_as_it_says():
    """Over individuals, whose errors are drawn as the states assume: ANEES inside its bounds, and outside with the states left out."""
    scenario = replace(plan("heading").scenario, duration=10.0)
    verdicts = []
    for states in (True, False):
        chosen = setup.FilterSetup.for_scenario(scenario, states=states)
        one = montecarlo.Plan(scenario=scenario, setup=chosen, seed=8, epochs=10, nis_bins=5, individuals=True)
        verdicts.append(montecarlo.run_plan(one, runs=96, machine="scalar").verdict(np.arange(2, 11, 2), "state"))
    assert verdicts[0].consistent, verdicts[0].mean
    assert not verdicts[1].consistent
