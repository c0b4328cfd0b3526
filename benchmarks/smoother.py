"""The smoother compared with the filter and with vqf's offline variant in one run, with ratios.

Run ``python benchmarks/smoother.py [--json FILE] [--samples N]``. Every figure is the minimum of several runs, in ns per gyro sample. The
smoother's time includes its run of the filter. Peers that are not installed are skipped and named.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from strapdown import estimation, quaternion
from strapdown.files import write_json
from strapdown.kernels.machine import describe
from strapdown.records import ImuRecord
from strapdown.vectors import VectorMeasurements

INTERVAL = 0.01
"""Sample interval, s."""
SPACING = {"two vectors a sample": 1, "two vectors every 10 samples": 10, "no measurements": 0}
UP, FIELD = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.5, -math.sqrt(0.75)])
GYRO_SIGMA, SIGMA = 5e-3, 0.02
WANTED = {"filter": 6.0, "vqf": 3.0}


def least_times(functions: dict[str, Callable[[], object]], seconds: float) -> dict[str, float]:
    """Return the minimum time of a call of each, s, timed in turns so that other load affects all equally."""
    best = dict.fromkeys(functions, math.inf)
    for function in functions.values():
        function()
    spent = 0.0
    while spent < seconds:
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            elapsed = time.perf_counter() - start
            best[name] = min(best[name], elapsed)
            spent += elapsed
    return best


def sensors(samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rate (n, 3), rad/s, and measured directions of up and of the field (n, 3) of a swaying body."""
    rng = np.random.default_rng(0)
    t = INTERVAL * np.arange(samples)
    rate = np.stack([0.5 * np.sin(1.3 * t), 0.4 * np.cos(0.9 * t), 0.3 * np.sin(0.7 * t + 1.0)], axis=-1)
    q = quaternion.IDENTITY
    attitude = np.empty((samples, 4))
    for k, step in enumerate(quaternion.exp(rate * INTERVAL)):
        q = attitude[k] = quaternion.normalize(quaternion.multiply(q, step))
    back = quaternion.conjugate(attitude)
    noisy = [quaternion.rotate(back, v) + SIGMA * rng.standard_normal((samples, 3)) for v in (UP, FIELD)]
    up, field = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in noisy)
    return rate + GYRO_SIGMA * rng.standard_normal((samples, 3)), up, field


def record(rate: np.ndarray, up: np.ndarray, field: np.ndarray, spacing: int) -> ImuRecord:
    edges = INTERVAL * np.arange(len(rate) + 1)
    used = slice(spacing - 1, None, spacing or 1)
    vectors = tuple(
        VectorMeasurements(
            sensor=name,
            kind="direction",
            time=edges[1:][used],
            vector_b=vector[used],
            reference_f=reference,
            sigma=np.full(len(edges[1:][used]), SIGMA),
        )
        for name, vector, reference in (("accelerometer", up, UP), ("magnetometer", field, FIELD))
    )
    return ImuRecord(time=edges, increments=rate * INTERVAL, vectors=vectors if spacing else ())


def measure(samples: int, seconds: float) -> dict:
    data = sensors(samples)
    noise = estimation.ProcessNoise(angle_random_walk=GYRO_SIGMA * math.sqrt(INTERVAL), rate_random_walk=1e-5)
    initial = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=0.1, bias_sigma=0.01)
    absent = []
    try:
        import vqf
    except ImportError:
        absent.append("vqf")
    result: dict = {"machine": describe(), "samples": samples, "cases": {}, "absent": absent}
    for name, spacing in SPACING.items():
        spaced = record(*data, spacing)
        functions: dict[str, Callable[[], object]] = {
            "filter": lambda spaced=spaced: estimation.run(spaced, noise, initial),
            "smoother": lambda spaced=spaced: estimation.smooth(spaced, noise, initial),
        }
        if not absent:  # it uses the vectors of every sample in any case
            gyr, acc, mag = (np.ascontiguousarray(x) for x in (data[0], 9.81 * data[1], 50.0 * data[2]))
            functions["vqf"] = lambda gyr=gyr, acc=acc, mag=mag: vqf.offlineVQF(gyr, acc, mag, INTERVAL)
        best = least_times(functions, seconds)
        figures = {f"{key}_ns": 1e9 * value / samples for key, value in best.items()}
        figures["smoother_over_filter"] = best["smoother"] / best["filter"]
        if "vqf" in best:
            figures["vqf_over_smoother"] = best["vqf"] / best["smoother"]
        result["cases"][name] = figures
    return result


def main(arguments: list[str] | None = None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=2.0, help="time per case, s")
    options = parser.parse_args(arguments)
    result = measure(options.samples, options.seconds)
    print(", ".join(f"{k} {v}" for k, v in result["machine"].items()))
    for name, figures in result["cases"].items():
        print(
            f"{name:30s} filter {figures['filter_ns']:7.1f}, smoother {figures['smoother_ns']:7.1f} ns per sample: "
            f"{figures['smoother_over_filter']:.2f} times the filter (wanted: {WANTED['filter']:g} at most)"
        )
        if "vqf_ns" in figures:
            target = f"wanted: {WANTED['vqf']:g} at least" if SPACING[name] == 1 else "with vectors at every sample"
            print(
                f"{'vqf.offlineVQF':30s} {figures['vqf_ns']:.1f} ns per sample: {figures['vqf_over_smoother']:.2f} times the "
                f"smoother ({target})"
            )
    for name in result["absent"]:
        print(f"{name}: not installed, skipped")
    if options.json:
        write_json(options.json, result)
    return result


if __name__ == "__main__":
    main(sys.argv[1:])
