"""Attitude from gyro increments: this package compared with numpy-quaternion, ahrs and SciPy in one run, with ratios.

Run ``python benchmarks/integration.py [--json FILE] [--samples N]``. Every figure is the minimum processor time of several runs, in ns per
sample. Peers that are not installed are skipped and named.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from strapdown import coning, quaternion
from strapdown.files import write_json
from strapdown.kernels import integration as kernels
from strapdown.kernels.machine import compiled, describe

IN_CACHE = 2000
"""Number of samples of a record that fits in the cache with its attitude: 48 + 64 kB."""
INTERVAL = 0.01
"""Sample interval, s; the peers take a rate and an interval."""


def least_time(function: Callable[[], object], seconds: float) -> float:
    """Return the minimum processor time of a call, s, over the calls that fit in ``seconds``, at least two."""
    function()
    best, spent = math.inf, 0.0
    while spent < seconds or best == math.inf:
        start = time.process_time()
        function()
        elapsed = time.process_time() - start
        best, spent = min(best, elapsed), spent + elapsed
    return best


def numpy_quaternion(increments: np.ndarray) -> np.ndarray:
    import quaternion as peer

    return peer.as_float_array(np.multiply.accumulate(peer.from_rotation_vector(increments)))


def scipy_loop(increments: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    attitude = Rotation.identity()
    rows = np.empty((len(increments), 4))
    for k, step in enumerate(increments):
        attitude = attitude * Rotation.from_rotvec(step)
        rows[k] = attitude.as_quat()
    return np.roll(rows, 1, axis=1)


def ahrs_angular_rate(increments: np.ndarray) -> np.ndarray:
    from ahrs.filters import AngularRate

    return AngularRate(
        gyr=np.vstack([np.zeros(3), increments]) / INTERVAL,
        Dt=INTERVAL,
        q0=np.array([1.0, 0.0, 0.0, 0.0]),
        method="closed",
    ).Q


PEERS = {
    "numpy-quaternion": (numpy_quaternion, 20_000),
    "ahrs AngularRate": (ahrs_angular_rate, 2_000),
    "scipy Rotation loop": (scipy_loop, 2_000),
}
WANTED = {"numpy-quaternion": 10.0, "ahrs AngularRate": 1000.0}


def measure(samples: int, seconds: float) -> dict:
    increments = 1e-2 * np.random.default_rng(0).standard_normal((samples, 3))
    cached = np.ascontiguousarray(increments[:IN_CACHE])
    attitude = np.empty((len(cached) + 1, 4))
    work = np.empty(kernels.WORK)
    initial = np.array([1.0, 0.0, 0.0, 0.0])
    accumulate = compiled(kernels.accumulate_vectors)
    kernel = least_time(lambda: accumulate(cached.reshape(-1), initial, work, attitude.reshape(-1)), seconds) / len(
        cached
    )
    own = {
        name: least_time(lambda name=name: coning.integrate(increments, name), seconds) / samples
        for name in coning.ALGORITHMS
    }
    peers, errors, absent = {}, {}, []
    for name, (function, rows) in PEERS.items():
        part = increments[: min(rows, samples)]
        try:
            estimate = function(part)
        except ImportError:
            absent.append(name)
            continue
        ours = coning.integrate(part)[-len(estimate) :]
        errors[name] = float(
            np.linalg.norm(quaternion.log(quaternion.multiply(quaternion.conjugate(estimate[-1]), ours[-1])))
        )
        peers[name] = least_time(lambda function=function, part=part: function(part), seconds) / len(part)
    return {
        "machine": describe(),
        "samples": samples,
        "samples_in_cache": len(cached),
        "kernel_ns": 1e9 * kernel,
        "algorithms_ns": {name: 1e9 * t for name, t in own.items()},
        "peers_ns": {name: 1e9 * t for name, t in peers.items()},
        "ratios": {name: t / own["one-sample"] for name, t in peers.items()},
        "difference_rad": errors,
        "absent": absent,
    }


def main(arguments: list[str] | None = None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--samples", type=int, default=20_160)
    parser.add_argument("--seconds", type=float, default=0.5, help="time per figure, s")
    options = parser.parse_args(arguments)
    result = measure(options.samples, options.seconds)
    print(", ".join(f"{k} {v}" for k, v in result["machine"].items()))
    print(
        f"exact exponential, sequential, {result['samples_in_cache']} samples in cache: {result['kernel_ns']:.2f} ns per sample"
    )
    for name, ns in result["algorithms_ns"].items():
        print(f"  {name:30s} {ns:10.1f} ns per sample")
    for name, ns in result["peers_ns"].items():
        wanted = f" (wanted {WANTED[name]:g})" if name in WANTED else ""
        print(
            f"{name:30s} {ns:10.1f} ns per sample: {result['ratios'][name]:.0f} times one-sample{wanted}; "
            f"attitudes differ by {result['difference_rad'][name]:.1e} rad"
        )
    for name in result["absent"]:
        print(f"{name}: not installed, skipped")
    if options.json:
        write_json(options.json, result)
    return result


if __name__ == "__main__":
    main(sys.argv[1:])
