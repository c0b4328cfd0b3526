"""Filters called once per sample, compared in one process and thread: ``python benchmarks/live.py``.

Each gets the same samples one at a time, as lists or arrays, whichever is faster for it: gyro, accelerometer, magnetometer. The filters
differ in their states and purpose; the table compares only their run time. smsfusion and AttiPy use a heading in place of the
magnetometer. `LiveAhrs` updates its 18 states every 30 ms, with the mean of three samples.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import timing
from strapdown import LiveAhrs, VectorSensor
from strapdown.estimation import Gate, LiveFilter, ProcessNoise, StepFilter, initial_state
from strapdown.estimation.error_states import GyroScale
from strapdown.vectors import VectorMeasurements

RATE = 100.0
NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)
START = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-2, bias_sigma=1e-3)
UP, FIELD = [0.0, 0.0, 1.0], [20.0, 0.0, -40.0]
SENSORS = [
    VectorSensor(name="accelerometer", reference_f=UP, sigma=0.01, rate=RATE),
    VectorSensor(name="magnetometer", reference_f=FIELD, sigma=0.01, rate=RATE),
]
OURS = "strapdown LiveFilter, two vectors"

Call = Callable[[int], object]


def ours(rate: list[Any], force: list[Any], field: list[Any]) -> dict[str, tuple[Call, int]]:
    """Return a call of each of our filters with a sample, and its number of samples."""
    n = len(rate)

    def live(two: bool = True, **options: Any) -> Call:
        f = LiveFilter(NOISE, START, sensors=SENSORS, **options)
        if two:
            return lambda k: f.update(f.time + 0.01, rate[k], accelerometer=force[k], magnetometer=field[k])
        return lambda k: f.update(f.time + 0.01, rate[k], accelerometer=force[k])

    imu, nine, step = (
        LiveAhrs(interval=1.0 / RATE),
        LiveAhrs(interval=1.0 / RATE, magnetometer=True),
        StepFilter(NOISE, START),
    )

    directions = [
        VectorMeasurements(
            sensor=sensor.name,
            kind="direction",
            time=np.arange(float(n)),
            vector_b=np.array(values) / np.linalg.norm(values, axis=1, keepdims=True),
            reference_f=sensor.reference_f,
            sigma=np.full(1, 0.01),
        )
        for sensor, values in zip(SENSORS, (force, field), strict=True)
    ]

    def steps(k: int) -> None:
        step.predict(np.array(rate[k]) / RATE, 1.0 / RATE)
        for series in directions:
            step.update(series, k)

    stamps = itertools.count()

    def samples(k: int) -> None:
        imu.update(next(stamps) / RATE, rate[k], force[k])

    def with_field(k: int) -> None:
        nine.update(next(stamps) / RATE, rate[k], force[k], field[k])

    return {
        OURS: (live(), n),
        "the same, one vector": (live(two=False), n),
        "the same, gate": (live(gate=Gate()), n),
        "the same, look-back of 0.5 s": (live(look_back=0.5), n),
        "the same, nine error states": (live(error_states=(GyroScale(scale_sigma=1e-3, misalignment_sigma=1e-3),)), n),
        "strapdown LiveAhrs, gyro and accelerometer, 18 states": (samples, n),
        "strapdown LiveAhrs, and magnetometer, 24 states": (with_field, n),
        "strapdown StepFilter on filterpy, two vectors": (steps, 500),
    }


def peers(rate: np.ndarray, force: np.ndarray, field: np.ndarray) -> dict[str, tuple[Call, int]]:
    """Return a call of each installed peer with a sample, and its number of samples."""
    calls: dict[str, tuple[Call, int]] = {}
    n, few = len(rate), 2000
    try:
        import imufusion

        fusion, degrees = imufusion.Ahrs(), np.degrees(rate)
        fusion.set_sample_period(1.0 / RATE)
        calls["imufusion update (C)"] = (lambda k: fusion.update(degrees[k], force[k], field[k]), n)
    except ImportError:
        pass
    try:
        from vqf import VQF, PyVQF

        vqf, six, plain = VQF(1.0 / RATE), VQF(1.0 / RATE), PyVQF(1.0 / RATE)
        calls["vqf VQF.update 9D (C++)"] = (lambda k: vqf.update(rate[k], force[k], field[k]), n)
        calls["vqf VQF.update 6D (C++)"] = (lambda k: six.update(rate[k], force[k]), n)
        calls["vqf PyVQF.update 9D (Python)"] = (lambda k: plain.update(rate[k], force[k], field[k]), few)
    except ImportError:
        pass
    try:
        import smsfusion

        sms = smsfusion.AHRS(RATE)
        calls["smsfusion AHRS.update, heading (numba)"] = (
            lambda k: sms.update(force[k], rate[k], head=0.0, head_var=0.01, head_degrees=False),
            few,
        )
    except ImportError:
        pass
    try:
        import attipy

        atti = attipy.AHRS(RATE, nav_frame="ENU")
        calls["AttiPy AHRS.update, yaw (numba)"] = (
            lambda k: atti.update(force[k], rate[k], yaw=0.0, yaw_var=0.01),
            few,
        )
    except ImportError:
        pass
    return calls


def in_turn(call: Call, samples: int) -> timing.Work:
    """Return the calls with each of the first samples as one."""

    def work() -> None:
        for k in range(samples):
            call(k)

    return work, samples


def main(*, samples: int = 20_000, repeats: int = 5) -> dict[str, float]:
    """Return the time of a call of each filter, ns."""
    generator = np.random.default_rng(0)
    rate = 0.1 * generator.standard_normal((samples, 3))
    force = np.array([0.0, 0.0, 9.81]) + 0.1 * generator.standard_normal((samples, 3))
    field = np.array(FIELD) + 0.1 * generator.standard_normal((samples, 3))
    calls = {**ours(rate.tolist(), force.tolist(), field.tolist()), **peers(rate, force, field)}
    return timing.least({name: in_turn(*call) for name, call in calls.items()}, repeats)


if __name__ == "__main__":
    timing.command(main, OURS)
