"""Overlapping Allan deviation compared with allantools, and the fit of noise coefficients: ``python benchmarks/allan.py``."""

from __future__ import annotations

import sys
from pathlib import Path

import allantools
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import timing
from strapdown import allan

OURS = "strapdown allan_deviation"


def main(*, samples: int = 10_000_000, taus: int = 100, repeats: int = 1) -> dict[str, float]:
    """Return the times on the same record and averaging times, ns per sample."""
    rate = np.random.default_rng(1).standard_normal(samples)
    multiples = np.unique(np.geomspace(1, samples // 3, taus).astype(int))
    works = {
        OURS: (lambda: allan.allan_deviation(rate, 1.0, taus=multiples), samples),
        "allantools oadev": (lambda: allantools.oadev(rate, 1.0, "freq", taus=multiples), samples),
        "strapdown fit_noise": (lambda: allan.fit_noise(rate, 1.0), samples),
    }
    return timing.least(works, repeats)


if __name__ == "__main__":
    timing.command(main, OURS)
