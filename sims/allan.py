"""What noise does a gyro at rest have? Simulate a record, draw its Allan deviation, fit the coefficients, compare with the truth.

Nineteen of twenty 95 % intervals should contain the coefficient of the simulated specification. Run ``python sims/allan.py``; ``--study``
repeats it over 400 axes for records of several durations and gyros of several random walks (two minutes), counts how often the intervals
contain the truth, and compares the errors with the standard errors of the fits.
"""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from strapdown import allan, gyro, plots, units
from strapdown.checks import Array
from strapdown.gyro import GyroSpec
from strapdown.randomness import generator
from strapdown.results import Column, Table

TRUTH = GyroSpec(
    quantization=0.3 * units.ARCSECOND,
    angle_random_walk=0.1 * units.DEGREE_PER_ROOT_HOUR,
    bias_instability=3.0 * units.DEGREE_PER_HOUR,
    rate_random_walk=60.0 * units.DEGREE_PER_HOUR_PER_ROOT_HOUR,
)
"""A fibre-optic or good MEMS gyro, the same on all axes."""

CASES = {
    "5 min": (1 << 15, {}),
    "22 min": (1 << 17, {}),
    "87 min": (1 << 19, {}),
    "22 min, weak K": (1 << 17, {"rate_random_walk": 20.0 * units.DEGREE_PER_HOUR_PER_ROOT_HOUR}),
    "22 min, strong K": (1 << 17, {"rate_random_walk": 180.0 * units.DEGREE_PER_HOUR_PER_ROOT_HOUR}),
    "22 min, strong B": (1 << 17, {"bias_instability": 10.0 * units.DEGREE_PER_HOUR}),
}
"""Records of the study: number of samples at 100 Hz, and differences from :data:`TRUTH`."""

SMALL = {"samples": 1 << 15}
"""Arguments of a quick test run."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """A record's Allan deviation, the fit, and the truth."""

    truth: dict[str, float]
    deviation: allan.AllanDeviation
    fit: allan.NoiseFit


@dataclass(frozen=True, kw_only=True)
class Study:
    """Many fits of one gyro, by axis and noise term."""

    truth: dict[str, float]
    covered: Array
    """Whether the interval contains the truth (axes, terms)."""
    supported: Array
    estimate: Array
    """Estimated coefficients; NaN if not supported."""
    expected: dict[str, float]
    """Root mean square of the standard errors by the intervals, of the terms present."""
    misfit_probability: Array

    def relative_rms(self, term: str) -> float:
        """Return the RMS error relative to the truth, of the fits that support the term."""
        error = self.estimate[:, allan.TERMS.index(term)] / self.truth[term] - 1.0
        return float(np.sqrt(np.nanmean(error**2)))


def coefficients(spec: GyroSpec) -> dict[str, float]:
    """Return the coefficients of a gyro with equal axes."""
    return {term: float(np.max(getattr(spec, term))) for term in allan.TERMS}


def rest_increments(spec: GyroSpec, samples: int, sample_interval: float, seed: int, run: int = 0) -> Array:
    """Return simulated increments of the gyro at rest (samples, 3), rad."""
    edges = np.arange(samples + 1) * sample_interval
    return gyro.simulate(spec, np.zeros((samples, 3)), edges, generator(seed, run, "gyro")).increments


def main(*, samples: int = 1 << 19, sample_interval: float = 0.01, seed: int = 1, out: Path | None = None) -> Result:
    """Simulate a gyro at rest and identify it; figures are written to ``out`` if it is given."""
    increments = rest_increments(TRUTH, samples, sample_interval, seed)
    deviation = allan.allan_deviation(increments, sample_interval, kind="increments")
    fit = allan.fit_noise(increments, sample_interval, kind="increments")
    if out is not None:
        plots.save(plots.allan_overview(deviation, fit), out / "allan.png")
    return Result(truth=coefficients(TRUTH), deviation=deviation, fit=fit)


def study(spec: GyroSpec, *, samples: int, runs: int, sample_interval: float = 0.01, seed: int = 1) -> Study:
    """Simulate and fit ``runs`` records of three axes each."""
    truth = coefficients(spec)
    wanted = np.array(list(truth.values()))
    fits = [
        allan.fit_noise(rest_increments(spec, samples, sample_interval, seed, run), sample_interval, kind="increments")
        for run in range(runs)
    ]
    lower, upper = np.concatenate([f.lower for f in fits]), np.concatenate([f.upper for f in fits])
    supported = np.concatenate([f.supported for f in fits])
    error = np.where(supported, 0.5 * (upper - lower) / 1.96, np.nan)
    present = [i for i, term in enumerate(allan.TERMS) if truth[term] > 0.0]
    return Study(
        truth=truth,
        covered=(lower <= wanted) & (wanted <= upper),
        supported=supported,
        estimate=np.concatenate([f.estimate for f in fits]),
        expected={allan.TERMS[i]: float(np.sqrt(np.nanmean(error[:, i] ** 2))) for i in present},
        misfit_probability=np.concatenate([f.misfit_probability for f in fits]),
    )


def case(name: str, runs: int) -> Study:
    """Return the study of one of :data:`CASES`."""
    samples, changes = CASES[name]
    return study(dataclasses.replace(TRUTH, **changes), samples=samples, runs=runs)


def table(name: str, result: Study) -> Table:
    """Return the coverage of the intervals and the errors of the coefficients."""
    percent = lambda share: f"{100.0 * share:.1f} %"  # noqa: E731
    columns = [Column(words, shown=percent) for words in ("covered", "detected", "RMS error", "expected")]
    rows = [
        (
            term,
            result.covered[:, i].mean(),
            result.supported[:, i].mean(),
            result.relative_rms(term),
            result.expected[term] / result.truth[term],
        )
        for i, term in enumerate(allan.TERMS)
        if result.truth[term] > 0.0
    ]
    return Table(f"{name}: {len(result.covered)} axes", ["term", *columns], rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/allan"))
    parser.add_argument("--study", action="store_true", help="count how often the intervals contain the truth")
    arguments = parser.parse_args()
    if arguments.study:
        for name in CASES:
            print(table(name, case(name, 134)).text, flush=True)
    else:
        result = main(seed=arguments.seed, out=arguments.out)
        print(result.fit.listing().text)
        units_of = allan.UNITS["gyro"]
        truth = (f"{term} {value / units_of[term][1]:.4g} {units_of[term][0]}" for term, value in result.truth.items())
        print(f"Truth: {', '.join(truth)}.")
