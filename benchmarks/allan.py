"""Overlapping Allan deviation compared with allantools in one run: python benchmarks/allan.py [--json FILE]."""

from __future__ import annotations

import argparse
import resource
import time

import allantools
import numpy as np

from strapdown import allan, files
from strapdown.kernels.machine import describe


def seconds(function, repeats=1):
    """Return the minimum time of ``repeats`` calls, and the last result."""
    best, result = float("inf"), None
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        best = min(best, time.perf_counter() - start)
    return best, result


def main(samples=10_000_000, taus=100, large=0):
    """Return times and ratios on the same record and taus."""
    rate = np.random.default_rng(1).standard_normal(samples)
    multiples = np.unique(np.geomspace(1, samples // 3, taus).astype(int))
    allan.allan_deviation(rate[:1000], 1.0)  # compile before timing
    allan.fit_noise(rate[:1000], 1.0)
    own, result = seconds(lambda: allan.allan_deviation(rate, 1.0, taus=multiples), repeats=2)
    peer, expected = seconds(lambda: allantools.oadev(rate, 1.0, "freq", taus=multiples))
    fit, _ = seconds(lambda: allan.fit_noise(rate, 1.0))
    out = {
        "machine": describe(),
        "samples": samples,
        "taus": len(multiples),
        "own_s": own,
        "allantools_s": peer,
        "ratio": peer / own,
        "largest_relative_difference": float(np.max(np.abs(result.deviation[0] / expected[1] - 1.0))),
        "fit_s": fit,
    }
    del rate, result, expected
    if large:
        rate = np.random.default_rng(2).standard_normal(large)
        multiples = np.unique(np.geomspace(1, large // 3, taus).astype(int))
        out["large_samples"] = large
        out["large_own_s"], result = seconds(lambda: allan.allan_deviation(rate, 1.0, taus=multiples))
        inside = result.taus < large / 1000
        error = result.deviation[0] * np.sqrt(result.taus) - 1.0
        out["large_worst_score"] = float(np.max(np.abs(error * np.sqrt(2.0 * result.edf[0]))[inside]))
        out["large_peak_memory_GB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        out["large_fit_s"], fitted = seconds(lambda: allan.fit_noise(rate, 1.0))
        out["large_fit_angle_random_walk"] = float(fitted.estimate[0, 1])
        out["large_fit_peak_memory_GB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--large", type=int, default=0, help="also run on this many samples, for example 100000000")
    parser.add_argument("--json", help="write the results to this file")
    arguments = parser.parse_args()
    figures = main(arguments.samples, large=arguments.large)
    for name, value in figures.items():
        print(f"{name:32s} {value:.4g}" if isinstance(value, float) else f"{name:32s} {value}")
    if arguments.json:
        files.write_json(arguments.json, figures)
