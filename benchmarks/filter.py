"""Whole-record filters compared in one process and one thread: ns per sample, and ratios. ``python benchmarks/filter.py``.

Each processes the same record: gyro, and a vector per sample (an accelerometer at rest with noise). The filters differ in their states and
purpose; the table compares only their run time, not their quality.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import ahrs, estimation
from strapdown.estimation.error_states import GyroScale, VectorBias
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import ProcessNoise, initial_state
from strapdown.estimation.step_filter import StepFilter
from strapdown.files import write_json
from strapdown.kernels.machine import describe
from strapdown.recordings import Recording
from strapdown.records import ImuRecord, cut
from strapdown.vectors import VectorMeasurements

RATE = 100.0
NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)
START = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-2, bias_sigma=1e-3)
STATES = (
    GyroScale(scale_sigma=1e-3, misalignment_sigma=1e-3),
    VectorBias(sensor="up", bias_sigma=1e-2),
    VectorBias(sensor="field", bias_sigma=1e-2),
)
"""Filter states: 15 in addition to attitude and bias."""


def samples(n: int, vectors: int) -> tuple[ImuRecord, np.ndarray, np.ndarray, np.ndarray]:
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


def with_states(record: ImuRecord, recording: Recording) -> dict[str, tuple[Callable[[], Any], int]]:
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


def peers(rate: np.ndarray, force: np.ndarray, field: np.ndarray) -> dict[str, tuple[Callable[[], Any], int]]:
    """Return the call of each installed peer on the record, and its number of samples (fewer for slow ones)."""
    calls: dict[str, tuple[Callable[[], Any], int]] = {}
    n = len(rate)
    try:
        from vqf import VQF

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


def step_by_step(record: ImuRecord, few: int) -> Callable[[], None]:
    """Return a loop of the filterpy interface over the first ``few`` samples."""

    def work() -> None:
        f = StepFilter(NOISE, START)
        up = record.vectors[0]
        for k in range(few):
            f.predict(record.increments[k], 1.0 / RATE)
            f.update(up, k)

    return work


def import_times(repeats: int = 7) -> tuple[float, float]:
    """Return median wall times of ``import numpy`` and ``import numpy, strapdown`` in fresh processes, s."""

    def once(what: str) -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", f"import {what}"], check=True)
        return time.perf_counter() - start

    pairs = [(once("numpy"), once("numpy, strapdown")) for _ in range(repeats)]
    return statistics.median(a for a, _ in pairs), statistics.median(b for _, b in pairs)


def main(*, n: int = 200_000, repeats: int = 7) -> dict[str, Any]:
    """Return ns per sample (median and minimum) of each, the ratios to ours, and the import times."""
    one_vector, rate, force, field = samples(n, 1)
    two, *_ = samples(n, 2)
    between = asynchronous(two)
    edges = at_edges(between)
    gate, robust = Gate(recovery=None), Robust()
    few = n // 10
    works = {
        "strapdown estimation.run, one vector": (lambda: estimation.run(one_vector, NOISE, START), n),
        "strapdown estimation.run, two vectors": (lambda: estimation.run(two, NOISE, START), n),
        "strapdown estimation.run, two vectors, asynchronous": (lambda: estimation.run(between, NOISE, START), n),
        "strapdown estimation.run, the same with gyro samples at their times": (
            lambda: estimation.run(edges, NOISE, START, every=3),
            n,
        ),
        "strapdown estimation.run, two vectors, gate": (lambda: estimation.run(two, NOISE, START, gate=gate), n),
        "strapdown estimation.run, two vectors, Student's t": (
            lambda: estimation.run(two, NOISE, START, robust=robust),
            n,
        ),
        **with_states(
            cut(two, 0, few),
            Recording(
                source="benchmark",
                time=np.arange(n) / RATE,
                rate=rate,
                specific_force=force,
                magnetic_field=field,
            ),
        ),
        **peers(rate, force, field),
        "strapdown StepFilter on filterpy": (step_by_step(one_vector, 1000), 1000),
    }
    for work, _ in works.values():
        work()
    # Timed in turns, so that a drift of the machine's speed affects all equally.
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, (work, count) in works.items():
            start = time.process_time()  # excludes other processes
            work()
            times[name].append((time.process_time() - start) / count * 1e9)
    base = statistics.median(times["strapdown estimation.run, one vector"])
    rows = [
        {"name": name, "ns_per_sample": statistics.median(t), "least": min(t), "ratio": statistics.median(t) / base}
        for name, t in times.items()
    ]
    numpy_alone, with_strapdown = import_times()
    return {
        "machine": describe(),
        "samples": n,
        "rows": rows,
        "import_seconds": {"numpy": numpy_alone, "numpy and strapdown": with_strapdown},
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=200_000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result = main(n=arguments.samples, repeats=arguments.repeats)
    print(json.dumps(result["machine"]))
    print(f"{'':66s} {'ns/sample':>10s} {'least':>10s} {'ratio':>8s}")
    for row in result["rows"]:
        print(f"{row['name']:66s} {row['ns_per_sample']:10.1f} {row['least']:10.1f} {row['ratio']:8.2f}")
    print({name: round(value, 3) for name, value in result["import_seconds"].items()})
    if arguments.json:
        write_json(arguments.json, result)
