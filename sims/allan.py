"""What noises does a gyro at rest have? Simulate a record, draw its Allan deviation, fit the coefficients, compare with the truth.

The round trip of the gyro specification: what is put into the simulator must come back, within its interval. ``python sims/allan.py``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from strapdown import allan, gyro, plots, units
from strapdown.gyro import GyroSpec
from strapdown.randomness import generator

TRUTH = GyroSpec(
    quantization=0.35 * units.ARCSECOND,
    angle_random_walk=0.1 * units.DEGREE_PER_ROOT_HOUR,
    bias_instability=3.0 * units.DEGREE_PER_HOUR,
    rate_random_walk=60.0 * units.DEGREE_PER_HOUR_PER_ROOT_HOUR,
)
"""A fibre-optic or good MEMS gyro, alike on all axes."""

SMALL = {"samples": 1 << 15}
"""Arguments of a run that only shows that the script works."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """A record's Allan deviation, the fit, and the truth."""

    truth: dict[str, float]
    deviation: allan.AllanDeviation
    fit: allan.NoiseFit
    figures: tuple[Path, ...]


def main(*, samples: int = 1 << 19, sample_interval: float = 0.01, seed: int = 1, out: Path | None = None) -> Result:
    """Simulate a gyro at rest, identify it, and draw it into ``out`` if that is given."""
    edges = np.arange(samples + 1) * sample_interval
    record = gyro.simulate(TRUTH, np.zeros((samples, 3)), edges, generator(seed, 0, "gyro"))
    deviation = allan.allan_deviation(record.increments, sample_interval, kind="increments")
    fit = allan.fit_noise(record.increments, sample_interval, kind="increments")
    figures = []
    if out is not None:
        out = Path(out)
        curves = allan.curves_by_axis(fit, deviation)
        figures.append(plots.save(plots.allan_overview(deviation, fit, curves), out / "allan.png"))
    truth = {term: float(np.max(getattr(TRUTH, term))) for term in allan.TERMS}
    return Result(truth=truth, deviation=deviation, fit=fit, figures=tuple(figures))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/allan"))
    arguments = parser.parse_args()
    result = main(seed=arguments.seed, out=arguments.out)
    for row in allan.table(result.fit):
        term = str(row["term"])
        interval = (
            f"{row['lower']:.4g} to {row['upper']:.4g}" if row["supported"] else f"not seen, below {row['upper']:.4g}"
        )
        print(
            f"{'xyz'[row['axis']]} {term:20s} {interval:28s} {row['unit']:10s} truth {result.truth[term] / allan.UNITS[term][1]:.4g}"
        )
    print("figures:", *result.figures)
