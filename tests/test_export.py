"""Exported filters: C and JavaScript against the same formulas in plain Python, and against the compiled filter over records."""

import dataclasses
import functools

import numpy as np
import pytest
from exported import STRICT, Compiled, Plain, compiler, fed, fed_javascript, program_of, samples

import strapdown as sd
from strapdown import estimation, quaternion
from strapdown.checks import InputError
from strapdown.estimation import setup as setups
from strapdown.estimation.setup import SensorStates, States

NOISE = sd.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
GATE = sd.Gate(recovery=None)
RATE = 50.0
TILT = [[4e-4, 1e-4, 0.0], [1e-4, 2e-4, 0.0], [0.0, 0.0, 3e-4]]

SENSORS = {
    "direction": sd.VectorSensor(name="star", reference_f=[0.6, 0.0, 0.8], sigma=0.02, rate=10.0),
    "level": sd.VectorSensor(name="accelerometer", reference_f=[0.0, 0.0, 1.0], sigma=0.02, rate=RATE),
    "vector": sd.VectorSensor(name="field", reference_f=[20.0, 3.0, -40.0], sigma=0.02, rate=10.0),
    "heading": sd.VectorSensor(name="magnetometer", kind="heading", reference_f=[0.1, 1.0, -2.0], sigma=0.03, rate=10.0),
    "attitude": sd.vectors.AttitudeSensor(name="star tracker", sigma_across=1e-3, sigma_about=1e-2, rate=2.0),
    "oblique": sd.vectors.AttitudeSensor(
        name="tracker", sigma_across=1e-3, sigma_about=1e-2, rate=2.0, boresight=[1.0, 2.0, 2.0]
    ),
    "precise": sd.VectorSensor(name="precise", reference_f=[0.6, 0.0, 0.8], sigma=1e-6, rate=10.0),
}

STATES = {
    "scale": States(gyro_scale_sigma=5e-3, gyro_misalignment_sigma=((0.0, 2e-3, 2e-3),) * 1 + ((2e-3, 0.0, 2e-3), (2e-3, 2e-3, 0.0))),
    "force": States(gyro_force_sigma=1e-5),
    "drift": States(gyro_drift_sigma=(1e-4, 3e-5), gyro_drift_time=(10.0, 100.0)),
    "bias": States(sensors={"field": SensorStates(bias_sigma=2.0, mounting_sigma=0.01)}),
    "mounting": States(sensors={"star tracker": SensorStates(bias_sigma=1e-3)}),
    "heading bias": States(sensors={"magnetometer": SensorStates(bias_sigma=0.03)}),
    "correlated": States(
        sensors={"star": SensorStates(bias_sigma=0.01, correlated_sigma=0.02, correlation_time=3.0, frame="fixed")}
    ),
    "hand": States(
        sensors={"accelerometer": SensorStates(velocity_time=0.5, velocity_sigma=0.5, acceleration_sigma=1.0)}
    ),
}

CASES = {
    **{kind: ((kind,), None, None) for kind in SENSORS},
    "gate": (("direction", "vector", "heading"), None, GATE),
    "scale": (("direction", "vector"), "scale", None),
    "force": (("direction", "vector"), "force", None),
    "drift": (("direction", "level"), "drift", GATE),
    "bias": (("level", "vector"), "bias", None),
    "mounting": (("attitude",), "mounting", None),
    "heading bias": (("level", "heading"), "heading bias", GATE),
    "correlated": (("direction", "level"), "correlated", None),
    "hand": (("level", "heading"), "hand", None),
}


def whole(series):
    """The field as a whole vector with its length."""
    if series.sensor != "field":
        return series
    length = np.linalg.norm([20.0, 3.0, -40.0])
    return sd.vectors.VectorMeasurements(
        sensor="field",
        kind="vector",
        time=series.time,
        vector_b=length * series.vector_b,
        reference_f=length * series.reference_f,
        sigma=length * series.sigma,
    )


@functools.cache
def case(name):
    """Record, setup and start of a case: with outliers and fast turns, so that every branch is taken somewhere."""
    sensors, states, gate = CASES[name]
    motion = sd.motion.SpinCone(angle=0.4, precession_rate=2.0, spin_rate=-1.5)
    spec = sd.GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias_sigma=5e-3)
    scenario = sd.Scenario(
        motion=motion, gyro=spec, sensors=tuple(SENSORS[kind] for kind in sensors), rate=RATE, duration=6.0
    )
    record = sd.simulate(scenario, seed=3)
    record = dataclasses.replace(record, vectors=tuple(map(whole, record.vectors)))
    setup = sd.FilterSetup(
        process_noise=NOISE,
        attitude_sigma=0.4,
        bias_sigma=5e-3,
        gate=gate,
        states=None if states is None else STATES[states],
    )
    start = quaternion.multiply(record.truth.attitude[0], quaternion.exp([0.4, -0.2, 0.3]))
    return record, setup, start


def rows_of(name):
    record, setup, start = case(name)
    rows = samples(record, [series.kind for series in record.vectors])
    # Beyond the range of the polynomials, and an outlier: a turn of 1.2 rad in one sample, and a measurement from the other side.
    rows.insert(40, (None, [40.0, -40.0, 20.0], 0.02))
    rows.insert(41, (None, [-40.0, 40.0, -20.0], 0.02))
    at = next(k for k in range(150, len(rows)) if rows[k][0] is not None)
    sensor, value, _ = rows[at]
    rows.insert(at, (sensor, [-x for x in value] if len(value) == 3 else value[::-1], 0.0))
    return rows, start


@functools.cache
def plain(name):
    rows, start = rows_of(name)
    record, setup, _ = case(name)
    return fed(Plain(program_of(setup, record.vectors)), rows, start)


@pytest.mark.parametrize("name", CASES)
def test_c_equals_python_to_the_bit(name, tmp_path):
    record, setup, _ = case(name)
    rows, start = rows_of(name)
    numbers, statuses = fed(Compiled(program_of(setup, record.vectors), tmp_path), rows, start)
    expected, expected_statuses = plain(name)
    assert statuses == expected_statuses
    assert np.isfinite(expected).all()
    np.testing.assert_array_equal(numbers, expected)


@pytest.mark.parametrize("name", CASES)
def test_javascript_equals_python_to_the_bit(name, tmp_path):
    record, setup, _ = case(name)
    rows, start = rows_of(name)
    numbers, statuses = fed_javascript(program_of(setup, record.vectors), tmp_path, rows, start)
    expected, expected_statuses = plain(name)
    assert statuses == expected_statuses
    np.testing.assert_array_equal(numbers, expected)
