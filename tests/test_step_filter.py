"""The step-by-step filter: simultaneous measurements, its clock, missing samples, and what it refuses."""

import functools
import pickle
from dataclasses import replace

import numpy as np
import pytest
from gated_steps import GatedStepFilter
from measured import resting, sample, series_of

from strapdown import estimation, motion, quaternion
from strapdown.checks import InputError
from strapdown.estimation import error_states
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import ProcessNoise, initial_state
from strapdown.estimation.step_filter import StepFilter
from strapdown.gyro import GyroSpec
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import AttitudeSensor, Faults, VectorMeasurements, VectorSensor

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
IDENTITY = (1.0, 0.0, 0.0, 0.0)
X, _, UP = np.eye(3)


def start(sigma=0.1):
    return initial_state(IDENTITY, attitude_sigma=sigma, bias_sigma=1e-3)


# ------------------------------------------------------------------------------------------------------------- at one time

OUTLIERS = Faults(outlier_probability=0.1)
IRON = error_states.VectorBias(sensor="a", bias_sigma=0.01, rate_random_walk=1e-4)
SWAY = error_states.GaussMarkov(sensor="b", noise_sigma=0.02, correlation_time=0.5, frame="fixed")


@functools.cache
def record_of(duration=2.0):
    """Sensors of three kinds, all at the same ten stamps a second, some of them far off."""
    scenario = Scenario(
        motion=motion.Coning(angle=0.3, frequency=0.3),
        gyro=GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias=np.array([1e-3, -2e-3, 5e-4])),
        sensors=(
            VectorSensor(name="a", reference_f=[1.0, 0.2, 0.0], sigma=1e-3, rate=10.0, faults=OUTLIERS),
            VectorSensor(name="north", reference_f=[0.0, 1.0, -1.0], sigma=5e-3, rate=10.0, kind="heading"),
            AttitudeSensor(name="tracker", sigma_across=1e-2, sigma_about=5e-2, rate=10.0),
            VectorSensor(name="b", reference_f=[0.0, 1.0, 1.0], sigma=2e-3, rate=10.0, faults=OUTLIERS),
        ),
        rate=50.0,
        duration=duration,
    )
    return simulate(scenario, 5)


OPTIONS = {
    "plain": {},
    "gate, Student": {"gate": Gate(probability=0.9999), "robust": Robust(degrees_of_freedom=3.0)},
    "lost": {"gate": Gate(recovery=4)},
}


def begun(record, option):
    error = (1.0, 0.5, -1.0) if option == "lost" else (0.05, -0.06, 0.07)
    attitude = quaternion.multiply(record.truth.attitude[0], quaternion.exp(error))
    return initial_state(attitude, attitude_sigma=1e-2 if option == "lost" else 0.1, bias_sigma=3e-3)


# ----------------------------------------------------------------------------------------- what the record refuses or skips


def test_noise_is_given_by_axes_or_by_covariance():
    covariances = []
    for noise in ({"sigma_axes": [[1e-2, 2e-2, 3e-2]]}, {"covariance": np.diag([1e-4, 4e-4, 9e-4])}):
        f = StepFilter(NOISE, begun(record_of(1.2), "plain"), (IRON,))
        assert f.update(replace(sample("direction", X, X, 0.0, "a"), **noise))
        covariances.append(f.P)
    np.testing.assert_allclose(*covariances, rtol=1e-14)


@pytest.mark.parametrize("unit", [1.0, 2e-5])
def test_a_whole_vector_updates_in_its_own_unit_as_the_record_s(unit):
    """filterpy's y, R and S are in the unit of the reference, and what they lead to does not depend on it."""
    reference, value = unit * np.array([0.0, 0.6, -0.8]), unit * np.array([0.05, 0.58, -0.83])
    f = StepFilter(NOISE, start())
    assert f.update(sample("vector", value, reference, 0.01 * unit, "mag"))
    series = series_of("mag", "vector", [0.0], [value], reference, 0.01 * unit)
    record = resting(series)
    estimate = estimation.run(record, NOISE, start(), full_covariance=True)
    assert quaternion.angle_between(f.attitude, estimate.attitude[0]) < 1e-12
    np.testing.assert_allclose(f.bias, estimate.bias[0], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(f.P, estimate.covariance[0], rtol=1e-9, atol=1e-15)
    assert np.linalg.norm(f.y) == pytest.approx(np.linalg.norm(value - reference), rel=1e-9)
    np.testing.assert_allclose(f.R, (0.01 * unit) ** 2 * np.eye(3), rtol=1e-12, atol=1e-15 * unit**2)
    for nis in (f.nis, f.y @ np.linalg.solve(f.S, f.y)):
        assert nis == pytest.approx(estimate.innovations["mag"].nis[0], rel=1e-9)


@pytest.mark.parametrize("name", ["", "Mag", "acc"])
@pytest.mark.parametrize("value", [X, np.full(3, np.nan)], ids=["measured", "missing"])
def test_a_sensor_that_no_block_knows_is_refused_before_anything_changes(value, name):
    face = StepFilter(NOISE, start(), (error_states.VectorBias(sensor="mag", bias_sigma=0.01),))
    face.predict([0.0, 0.0, 0.01], 0.1)
    before = pickle.dumps(face.__dict__)
    with pytest.raises(InputError, match=f"sensor '{name}' is not known.* mag"):
        face.update(sample("direction", value, X, 0.1, name))
    assert pickle.dumps(face.__dict__) == before
    assert face.update(sample("direction", X, X, 0.1, "mag"))


VERTICAL_OPTIONS = [{}, {"gate": Gate(recovery=2)}, {"robust": Robust()}]


UNBIASED = (error_states.VectorBias(sensor="up", bias_sigma=1e-3),)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("options", VERTICAL_OPTIONS, ids=["plain", "gate", "robust"])
@pytest.mark.parametrize(
    "blocks",
    [(), pytest.param((error_states.VectorBias(sensor="north", bias_sigma=1e-3),), marks=pytest.mark.slow)],
    ids=["no states", "states"],
)
def test_both_faces_skip_a_vertical_heading_and_a_missing_sample_alike(blocks, options):
    """One heading in two is measured of a vertical vector; the run is that of the record without them, and says how many."""
    time = 0.1 * np.arange(1.0, 9.0)
    vertical, lost = np.arange(8) % 2 == 0, np.arange(8) == 3
    heading, up = np.where(vertical[:, None], UP, X), np.where(lost[:, None], np.nan, UP)
    north, level = series_of("north", "heading", time, heading, X, 0.1), series_of("up", "direction", time, up, UP, 0.1)
    edges = resting(north, level, time=np.linspace(0.0, 1.0, 11))
    rest = replace(edges, vectors=(north.taken(~vertical), level.taken(~lost)))
    both, without = (estimation.run(r, NOISE, start(), blocks, full_covariance=True, **options) for r in (edges, rest))
    assert both.skipped == {"north": 4, "up": 1}
    assert both.refused == {"north": 0, "up": 0}
    assert both.events == without.events
    assert np.array_equal(both.innovations["north"].time, time[~vertical])
    assert np.array_equal(both.innovations["north"].nis, without.innovations["north"].nis)
    assert np.array_equal(both.covariance, without.covariance)
    assert estimation.smooth(edges, NOISE, start(), blocks, **options).skipped == both.skipped
    f = GatedStepFilter(NOISE, start(), blocks, sensors=("north", "up"), **options)
    for k in range(8):
        f.predict(np.zeros(3), 0.1)
        f.update(north, k)
        f.update(level, k)
    assert f.skipped == both.skipped
    assert np.allclose(f.P[:6, :6], both.covariance[8], rtol=1e-10, atol=1e-18)


@pytest.mark.parametrize("blocks", [(), UNBIASED], ids=["no states", "states"])
@pytest.mark.parametrize("kind", ["direction", "vector", "heading", "attitude"])
def test_a_missing_sample_is_skipped_and_counted(kind, blocks):
    f = StepFilter(NOISE, start(), blocks, sensors=("up", "s"))
    f.predict(np.zeros(3), 0.5)
    P = f.P.copy()
    for value in ([np.nan] * 3, UP if kind == "heading" else [0.0, np.nan, 1.0]):  # a vertical vector has no heading
        if kind == "attitude":
            series = VectorMeasurements(sensor="s", kind=kind, time=[0.0], attitude=[[*value, 1.0]], sigma=0.1)
        else:
            series = sample(kind, value, X, 0.1)
        assert f.update(series) is False
    assert f.skipped == {"s": 2}
    assert np.array_equal(f.P, P)
    with pytest.raises(InputError, match="k is 1"):
        f.update(series, 1)


def test_a_correction_turns_what_is_known_of_a_vector_in_fixed_axes():
    """Of coloured noise that is independent of the attitude: its mean and covariance are those before, turned with the attitude."""
    initial = estimation.with_error_states(start(), (SWAY,))
    P, v = initial.covariance.copy(), np.array([0.03, -0.02, 0.01])
    P[6:, 6:] = np.diag([1e-4, 2e-4, 3e-4])
    f = StepFilter(NOISE, replace(initial, values=v, covariance=P), (SWAY,), sensors=("a", "b"))
    assert f.update(sample("direction", quaternion.rotate(quaternion.exp([0.0, 0.3, 0.2]), X), X, 0.05, "a"))
    R = quaternion.to_matrix(quaternion.multiply(f.attitude, quaternion.conjugate(IDENTITY)))
    assert quaternion.angle_between(f.attitude, IDENTITY) > 0.2
    np.testing.assert_allclose(f.values, R @ v, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(f.P[6:, 6:], R @ P[6:, 6:] @ R.T, rtol=0.0, atol=1e-18)
