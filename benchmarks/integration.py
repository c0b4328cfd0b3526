"""Attitude from gyro increments, compared with numpy-quaternion, ahrs and SciPy: ``python benchmarks/integration.py``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import timing
from strapdown import coning
from strapdown.kernels import integration as kernels
from strapdown.kernels.machine import compiled

IN_CACHE = 2000
"""Number of samples of a record that fits in the cache with its attitude: 48 + 64 kB."""
INTERVAL = 0.01
"""Sample interval, s; the peers take a rate and an interval."""


def kernel(increments: np.ndarray) -> timing.Work:
    """Return the exact exponential of a record in the cache, without the checks of its arguments."""
    attitude, work, initial = np.empty((len(increments) + 1, 4)), np.empty(kernels.WORK), np.array([1.0, 0.0, 0.0, 0.0])
    accumulate = compiled(kernels.accumulate_vectors)
    return lambda: accumulate(increments.reshape(-1), initial, work, attitude.reshape(-1)), len(increments)


def peers(increments: np.ndarray) -> dict[str, timing.Work]:
    """Return the installed peers, with fewer samples for those in Python."""
    few = increments[:2_000]
    works: dict[str, timing.Work] = {}
    try:
        import quaternion as peer

        product = lambda: np.multiply.accumulate(peer.from_rotation_vector(increments))  # noqa: E731
        works["numpy-quaternion"] = (lambda: peer.as_float_array(product()), len(increments))
    except ImportError:
        pass
    try:
        from ahrs.filters import AngularRate

        rate = np.vstack([np.zeros(3), few]) / INTERVAL
        works["ahrs AngularRate"] = (
            lambda: AngularRate(gyr=rate, Dt=INTERVAL, q0=np.array([1.0, 0.0, 0.0, 0.0]), method="closed").Q,
            len(few),
        )
    except ImportError:
        pass
    return {**works, "scipy Rotation loop": (lambda: scipy_loop(few), len(few))}


def scipy_loop(increments: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    attitude = Rotation.identity()
    rows = np.empty((len(increments), 4))
    for k, step in enumerate(increments):
        attitude = attitude * Rotation.from_rotvec(step)
        rows[k] = attitude.as_quat()
    return rows


def main(*, samples: int = 20_160, repeats: int = 20) -> dict[str, float]:
    """Return the time of each algorithm and peer, ns per sample."""
    increments = 1e-2 * np.random.default_rng(0).standard_normal((samples, 3))
    algorithms = {
        name: (lambda name=name: coning.integrate(increments, name), samples)  # type: ignore[misc]
        for name in coning.ALGORITHMS
    }
    in_cache = kernel(np.ascontiguousarray(increments[:IN_CACHE]))
    return timing.least({"exponential, in cache": in_cache, **algorithms, **peers(increments)}, repeats)


if __name__ == "__main__":
    timing.command(main, "one-sample")
