"""What tests of tuning use: two stars seen once a second on a body rotating at constant rate, every kind of measurement, angles alone."""

import dataclasses
from typing import Any

import numpy as np

from strapdown import gyro, motion, quaternion, scenarios, tuning, vectors
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise
from strapdown.montecarlo.scalar import start
from strapdown.records import Estimate, ImuRecord, Truth

ARW, RRW = 1e-4, 3e-6
SIGMAS = (1e-4, 2e-4)
FREE = ("gyro.arw", "gyro.rrw", "star 1.sigma", "star 2.sigma")
TRUTH = np.array([ARW, RRW, *SIGMAS])
WRONG = dict(zip(FREE, TRUTH * np.array([3.0, 3.0, 0.3, 3.0]), strict=True))
BELIEVED = FilterSetup(
    process_noise=ProcessNoise(angle_random_walk=ARW, rate_random_walk=RRW), attitude_sigma=1e-3, bias_sigma=1e-4
)


def stars(first: float, second: float, rate: float = 1.0, **changes: Any) -> tuple[vectors.VectorSensor, ...]:
    """Return two sensors of directions 90° apart with these σ."""
    references = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
    return tuple(
        vectors.VectorSensor(name=f"star {k}", reference_f=reference, sigma=sigma, rate=rate, **changes)
        for k, reference, sigma in zip((1, 2), references, (first, second), strict=True)
    )


def scenario(
    duration: float = 200.0, *, rate: float = 4.0, walk: float = RRW, outliers: float = 0.0
) -> scenarios.Scenario:
    """Return the scenario; ``walk`` is the rate random walk of the gyro, ``outliers`` the probability of an outlier."""
    faults = vectors.Faults(outlier_probability=outliers, outlier_scale=10.0)
    return scenarios.Scenario(
        motion=motion.ConstantRate(rate=np.array([0.01, 0.02, 0.05])),
        gyro=gyro.GyroSpec(angle_random_walk=ARW, rate_random_walk=walk, turn_on_bias_sigma=1e-4),
        sensors=stars(*SIGMAS, faults=faults),
        rate=rate,
        duration=duration,
    )


def case(seed: int = 0, duration: float = 200.0, **changes: Any) -> tuning.Case:
    """Return a tuning case: a record of the scenario with the initial state of the correct filter."""
    return tuning.record_case(scenarios.simulate(scenario(duration, **changes), seed), BELIEVED, seed=seed)


def drawn_case(scenario: scenarios.Scenario, filter_setup: FilterSetup, seed: int, run: int = 0) -> tuning.Case:
    """Return a run of a scenario with a start whose errors are drawn from the filter's own σ."""
    record = scenarios.simulate(scenario, seed, run)
    return tuning.Case(record=record, initial=start(record, filter_setup, seed, run), name=f"run {run}")


KINDS = FilterSetup(
    process_noise=ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-4), attitude_sigma=0.3, bias_sigma=1e-2
)


def every_kind(seed: int = 0, *, gaps: bool = True) -> ImuRecord:
    """Return a record that turns fast enough for sub-steps, with a series of each kind at odd times; with gaps two samples miss."""
    body = motion.ConstantRate(rate=np.array([0.4, -0.7, 1.1]))
    random = np.random.default_rng(seed)
    edges = np.cumsum(np.concatenate([[0.0], random.uniform(0.2, 0.6, 120)]))
    spec = gyro.GyroSpec(angle_random_walk=1e-3, rate_random_walk=1e-4)
    output = gyro.simulate(spec, body.increments(edges), edges, random)
    sensors = (
        vectors.VectorSensor(name="sun", reference_f=np.array([0.0, 0.6, 0.8]), sigma=1e-2, rate=1.3),
        vectors.Accelerometer(name="up", sigma=0.2, rate=1.0, kind="vector"),
        vectors.Magnetometer(name="north", field_f=np.array([2e-5, 1e-5, -3e-5]), sigma=1e-6, rate=0.7, kind="heading"),
        vectors.AttitudeSensor(name="tracker", sigma_across=5e-3, sigma_about=2e-2, rate=0.5),
    )
    sun, *others = (sensor.observe(body, float(edges[0]), float(edges[-1]), random) for sensor in sensors)
    if gaps:
        missing = (np.arange(len(sun.time)) // 2 == 2)[:, None]
        sun = dataclasses.replace(sun, vector_b=np.where(missing, np.nan, sun.vector_b))
    truth = Truth(attitude=body.attitude(edges), bias=output.bias)
    return ImuRecord(time=edges, increments=output.increments, vectors=(sun, *others), truth=truth)


ANGLES = FilterSetup(
    process_noise=ProcessNoise(angle_random_walk=8e-7, rate_random_walk=2e-7), attitude_sigma=2e-6, bias_sigma=1e-6
)


def angle_case(n: int, *, struck: float = 0.0) -> tuple[tuning.Case, np.ndarray, np.ndarray]:
    """Return the case of a body at rest to within microradians, gyro and measured angles: three axes apart, linear to 1e-6.

    A share of the measurements, ``struck``, is eight times as far off.
    """
    random = np.random.default_rng(4)
    increments = 3e-7 * random.standard_normal((n, 3))
    scale = np.where(random.random(n) < struck, 8.0, 1.0)[:, None] if struck else 1.0
    angles = np.cumsum(increments, axis=0) + 1e-6 * scale * random.standard_normal((n, 3))
    time = 0.5 * np.arange(n + 1)
    series = vectors.VectorMeasurements(
        sensor="tracker", kind="attitude", time=time[1:], attitude=quaternion.exp(angles), sigma=1e-6
    )
    record = ImuRecord(time=time, increments=increments, vectors=(series,))
    return tuning.Case(record=record, initial=setup.initial_state(ANGLES, quaternion.IDENTITY)), increments, angles


def minus_log(estimate: Estimate) -> float:
    """Return minus the log likelihood, without its constant, of the innovations of an ordinary run of the filter."""
    series = estimate.innovations.values()
    return float(0.5 * sum(np.sum(np.log(i.variance) + i.innovation**2 / i.variance) for i in series))


def differences(value: Any, point: np.ndarray, step: float = 1e-3) -> np.ndarray:
    """Return the gradient by central differences of fourth order."""
    rows = []
    for unit in step * np.eye(len(point)):
        f = [value(point + k * unit) for k in (-2, -1, 1, 2)]
        rows.append((f[0] - 8.0 * f[1] + 8.0 * f[2] - f[3]) / (12.0 * step))
    return np.array(rows)
