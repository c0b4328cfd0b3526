"""Whole-record filters and smoothers compared in one process and one thread: ``python benchmarks/filter.py``.

Each processes the same record: gyro, and a vector per sample (an accelerometer at rest with noise). The filters differ in their states and
purpose; the table compares only their run time, not their quality. A smoother's time includes its run of the filter.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import timing
from benchmarks.timing import Work
from strapdown import ahrs, estimation
from strapdown.estimation.error_states import GyroScale, VectorBias
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import ProcessNoise, initial_state
from strapdown.estimation.step_filter import StepFilter
from strapdown.recordings import Recording
from strapdown.records import ImuRecord, cut
from strapdown.vectors import VectorMeasurements

RATE = 100.0
NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)
START = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-2, bias_sigma=1e-3)
BASE = "strapdown estimation.run, one vector"
STATES = (
    GyroScale(scale_sigma=1e-3, misalignment_sigma=1e-3),
    VectorBias(sensor="up", bias_sigma=1e-2),
    VectorBias(sensor="field", bias_sigma=1e-2),
)
"""Filter states: 15 in addition to attitude and bias."""


def simulated(n: int, vectors: int) -> tuple[ImuRecord, np.ndarray, np.ndarray, np.ndarray]:
    """Return a record with one or two directions per sample, and the same data as rate, specific force and field."""
    generator = np.random.default_rng(0)
    rate = 0.1 * generator.standard_normal((n, 3))
    force = np.array([0.0, 0.0, 9.81]) + 0.1 * generator.standard_normal((n, 3))
    field = np.array([20.0, 0.0, -40.0]) + 0.1 * generator.standard_normal((n, 3))
    edges = np.arange(n + 1) / RATE
    series = tuple(
        VectorMeasurements(
            sensor=name,
            kind="direction",
            time=edges[1:],
            vector_b=value / np.linalg.norm(value, axis=1, keepdims=True),
            reference_f=reference,
            sigma=np.full(n, 0.01),
        )
        for name, value, reference in (("up", force, [0.0, 0.0, 1.0]), ("field", field, [20.0, 0.0, -40.0]))
    )
    return ImuRecord(time=edges, increments=rate / RATE, vectors=series[:vectors]), rate, force, field


def asynchronous(record: ImuRecord) -> ImuRecord:
    """Return the record with both series between the gyro's edges at different phases: every interval is split in three."""
    shifted = tuple(
        replace(series, time=series.time - share / RATE)
        for series, share in zip(record.vectors, (0.31, 0.67), strict=True)
    )
    return replace(record, vectors=shifted)


def at_edges(record: ImuRecord) -> ImuRecord:
    """Return a record of the same rotations with gyro edges at all times: the same predictions and updates, no interval is split."""
    times = np.unique(np.concatenate([record.time, *(series.time for series in record.vectors)]))
    interval = np.searchsorted(record.time, times[:-1], side="right") - 1
    share = np.diff(times) / record.intervals[interval]
    return replace(record, time=times, increments=share[:, None] * record.increments[interval])


def with_states(record: ImuRecord, recording: Recording) -> dict[str, Work]:
    """Return the filters with error states: on the record, also with measurements at every 50th sample, and for recordings."""
    n, few = len(record.increments), len(recording.time)
    rare = replace(record, vectors=tuple(series.taken(slice(49, None, 50)) for series in record.vectors))
    return {
        "strapdown estimation.run, two vectors, 15 error states": (
            lambda: estimation.run(record, NOISE, START, STATES),
            n,
        ),
        "strapdown estimation.run, the same at every 50th sample, every=50": (
            lambda: estimation.run(rare, NOISE, START, STATES, every=50),
            n,
        ),
        "strapdown estimation.smooth, two vectors, 15 error states": (
            lambda: estimation.smooth(record, NOISE, START, STATES),
            n,
        ),
        "strapdown ahrs.estimate, 9D": (lambda: ahrs.estimate(recording), few),
        "strapdown ahrs.estimate, 9D, smooth": (lambda: ahrs.estimate(recording, smooth=True), few),
    }


def peers(rate: np.ndarray, force: np.ndarray, field: np.ndarray) -> dict[str, Work]:
    """Return the call of each installed peer on the record, and its number of samples (fewer for slow ones)."""
    calls: dict[str, Work] = {}
    n = len(rate)
    try:
        from vqf import VQF, offlineVQF

        calls["vqf offlineVQF 9D (C++)"] = (lambda: offlineVQF(rate, force, field, 1.0 / RATE), n)
        calls["vqf VQF.updateBatch 6D (C++)"] = (lambda: VQF(1.0 / RATE).updateBatch(rate, force), n)
        calls["vqf VQF.updateBatch 9D (C++)"] = (lambda: VQF(1.0 / RATE).updateBatch(rate, force, field), n)
    except ImportError:
        pass
    try:
        import imufusion

        few = 20_000

        def fusion() -> None:
            ahrs = imufusion.Ahrs()
            ahrs.set_sample_period(1.0 / RATE)
            degrees = np.degrees(rate[:few])
            for k in range(few):
                ahrs.update_no_magnetometer(degrees[k], force[k])

        calls["imufusion update_no_magnetometer (C, a call a sample)"] = (fusion, few)
    except ImportError:
        pass
    try:
        from ahrs.filters import EKF

        few_ekf = 2_000
        calls["ahrs EKF"] = (lambda: EKF(gyr=rate[:few_ekf], acc=force[:few_ekf], frequency=RATE), few_ekf)
    except ImportError:
        pass
    return calls


def step_by_step(record: ImuRecord, few: int) -> Work:
    """Return a loop of the filterpy interface over the first ``few`` samples."""

    def work() -> None:
        f = StepFilter(NOISE, START)
        up = record.vectors[0]
        for k in range(few):
            f.predict(record.increments[k], 1.0 / RATE)
            f.update(up, k)

    return work, few


def main(*, samples: int = 200_000, repeats: int = 7) -> dict[str, float]:
    """Return the time of each filter, ns per sample."""
    one_vector, rate, force, field = simulated(samples, 1)
    two, *_ = simulated(samples, 2)
    between = asynchronous(two)
    edges = at_edges(between)
    gate, robust = Gate(recovery=None), Robust()
    recording = Recording(
        source="benchmark", time=np.arange(samples) / RATE, rate=rate, specific_force=force, magnetic_field=field
    )
    works: dict[str, Work] = {
        BASE: (lambda: estimation.run(one_vector, NOISE, START), samples),
        "strapdown estimation.run, two vectors": (lambda: estimation.run(two, NOISE, START), samples),
        "strapdown estimation.smooth, two vectors": (lambda: estimation.smooth(two, NOISE, START), samples),
        "strapdown estimation.run, two vectors, asynchronous": (lambda: estimation.run(between, NOISE, START), samples),
        "strapdown estimation.run, the same with gyro samples at their times": (
            lambda: estimation.run(edges, NOISE, START, every=3),
            samples,
        ),
        "strapdown estimation.run, two vectors, gate": (lambda: estimation.run(two, NOISE, START, gate=gate), samples),
        "strapdown estimation.run, two vectors, Student's t": (
            lambda: estimation.run(two, NOISE, START, robust=robust),
            samples,
        ),
        **with_states(cut(two, 0, samples // 10), recording),
        **peers(rate, force, field),
        "strapdown StepFilter on filterpy": step_by_step(one_vector, 1000),
    }
    return timing.least(works, repeats)


if __name__ == "__main__":
    timing.command(main, BASE)
