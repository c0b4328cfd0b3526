"""Simulation of a three-axis gyro compared with NumPy in one run: python benchmarks/simulate.py [--json FILE].

The gyro has angle random walk, rate random walk, flicker, scale factors and misalignment. NumPy's flicker is by FFT, as usual.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from strapdown import files, gyro, units
from strapdown.kernels import noise
from strapdown.kernels.machine import compiled, describe
from strapdown.randomness import generator

SPEC = gyro.GyroSpec(
    angle_random_walk=0.15 * units.DEGREE_PER_ROOT_HOUR,
    rate_random_walk=1.0 * units.DEGREE_PER_HOUR_PER_ROOT_HOUR,
    bias_instability=0.5 * units.DEGREE_PER_HOUR,
    scale_factor=[1e-4, 2e-4, -1e-4],
    misalignment=[[0.0, 1e-3, 2e-3], [1e-3, 0.0, 1e-3], [2e-3, 1e-3, 0.0]],
)


def with_numpy(spec, increments, edges, stream):
    """Return the increments computed with NumPy."""
    n, dt = len(increments), np.diff(edges)[:, None]
    draws = stream.standard_normal((2, n, 3))
    walk = np.concatenate([np.zeros((1, 3)), np.cumsum(spec.rate_random_walk * np.sqrt(dt) * draws[0], axis=0)])
    frequency = np.fft.rfftfreq(2 * n)
    lines = stream.standard_normal((3, len(frequency))) + 1j * stream.standard_normal((3, len(frequency)))
    lines[:, 1:] *= np.sqrt(n / (2.0 * np.pi * frequency[1:]))
    lines[:, 0] = 0.0
    flicker = spec.bias_instability * np.fft.irfft(lines, 2 * n, axis=1)[:, :n].T
    spread = np.sqrt(spec.angle_random_walk**2 * dt + spec.rate_random_walk**2 * dt**3 / 12.0)
    return (
        increments @ (np.eye(3) + spec.error_matrix).T
        + (0.5 * (walk[1:] + walk[:-1]) + flicker) * dt
        + spread * draws[1]
    )


def best(function, repeats=3):
    """Return the minimum processor time of some calls, s."""
    shortest = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        function()
        shortest = min(shortest, time.process_time() - start)
    return shortest


def main(samples=1 << 20):
    """Return times per axis and sample, and ratios."""
    edges, increments = np.arange(samples + 1) / 100.0, np.zeros((samples, 3))
    gyro.simulate(SPEC, increments[:100], edges[:101], generator(1, 0, "gyro"))  # compile before timing
    own = best(lambda: gyro.simulate(SPEC, increments, edges, generator(1, 0, "gyro")))
    peer = best(lambda: with_numpy(SPEC, increments, edges, generator(1, 0, "gyro")))
    state, words, out = np.empty((2, 4), np.uint64), np.empty((2, 256), np.uint64), np.empty(512)
    compiled(noise.seed_stream)(np.uint64(1), np.uint64(2), np.uint64(3), state)
    fill = compiled(noise.fill_normals)
    fill(state, words, out)
    own_normal = best(lambda: [fill(state, words, out) for _ in range(4000)]) / (4000 * 512)
    stream = np.random.default_rng(1)
    peer_normal = best(lambda: [stream.standard_normal(512, out=out) for _ in range(4000)]) / (4000 * 512)
    return {
        "machine": describe(),
        "samples": samples,
        "own_ns_per_three_axis_sample": 1e9 * own / samples,
        "own_million_axis_samples_per_s": 3e-6 * samples / own,
        "own_million_three_axis_samples_per_s": 1e-6 * samples / own,
        "numpy_ns_per_three_axis_sample": 1e9 * peer / samples,
        "ratio": peer / own,
        "own_ns_per_normal": 1e9 * own_normal,
        "numpy_ns_per_normal": 1e9 * peer_normal,
        "ratio_of_normals": peer_normal / own_normal,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--json")
    parser.add_argument("--samples", type=int, default=1 << 20)
    arguments = parser.parse_args()
    figures = main(arguments.samples)
    for name, value in figures.items():
        print(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}")
    if arguments.json:
        files.write_json(arguments.json, figures)
