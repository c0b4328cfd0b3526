"""Effect of under-sampled coning on an attitude filter.

The study of ``strapdown coning``, written out step by step as a script to modify. Run ``python sims/coning.py``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from strapdown import coning, montecarlo, plots
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.montecarlo.coning_study import Drift, FilterOutcome
from strapdown.motion import Coning
from strapdown.scenarios import Scenario
from strapdown.units import ARCSECOND, DEGREE, DEGREE_PER_HOUR, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR
from strapdown.vectors import VectorSensor

SMALL = {"runs": 4, "duration": 24.0}
"""Arguments of a quick test run."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Drift of each integration algorithm, and the outcome of the same filter with each."""

    drifts: tuple[Drift, ...]
    outcomes: tuple[FilterOutcome, ...]
    figures: tuple[Path, ...]


def main(*, runs: int = 100, duration: float = 240.0, seed: int = 1, out: Path | None = None) -> Result:
    """Run the study; ``duration`` in s, a multiple of 12 at 100 Hz. Figures are written to ``out`` if it is given."""
    # 1. The motion: a cone of 0.7° half-angle at 10 Hz, equation (18), known in closed form.
    motion = Coning(angle=0.7 * DEGREE, frequency=10.0)

    # 2. The gyro: ten samples per cycle, a good MEMS unit.
    rate = 100.0
    gyro = GyroSpec(angle_random_walk=0.08 * DEGREE_PER_ROOT_HOUR, rate_random_walk=1.0 * DEGREE_PER_HOUR_PER_ROOT_HOUR)

    # 3. Two directions, 20 arcsec, about once a second: every 96 samples, a whole number of steps of every algorithm below.
    sensors = tuple(
        VectorSensor(name=name, reference_f=np.array(r), sigma=20.0 * ARCSECOND, rate=rate / 96)
        for name, r in (("direction x", [1.0, 0.0, 0.0]), ("direction yz", [0.0, 1.0, 1.0]))
    )
    scenario = Scenario(motion=motion, gyro=gyro, sensors=sensors, rate=rate, duration=duration)

    # 4. Integration: one sample per step without correction, then increasingly accurate algorithms.
    algorithms = [
        coning.ALGORITHMS[name] for name in ("one-sample", "two-sample", "three-sample", "four-sample", "matched-4-11")
    ]
    drifts = tuple(Drift.of(algorithm, motion, rate) for algorithm in algorithms)

    # 5. The same filter with each. Its model of the gyro's noise is exact; it does not model coning errors.
    noise = ProcessNoise(angle_random_walk=gyro.angle_random_walk, rate_random_walk=gyro.rate_random_walk)
    setups = tuple(
        montecarlo.FilterSetup(
            process_noise=noise,
            attitude_sigma=200.0 * ARCSECOND,
            bias_sigma=20.0 * DEGREE_PER_HOUR,
            integration=algorithm,
        )
        for algorithm in algorithms
    )
    statistics = montecarlo.run(scenario, setups, runs=runs, seed=seed, epochs=100)

    # 6. The verdict: NEES and NIS at 20 epochs, with two-sided 99 % bounds.
    outcomes = tuple(
        FilterOutcome(integration=a.name, statistics=s) for a, s in zip(algorithms, statistics, strict=True)
    )

    # 7. The figures.
    figures = []
    if out is not None:
        out = Path(out)
        figure, ax = plots.new_figure(size=(7.0, 4.2))
        plots.drift_by_algorithm(drifts, ax)
        figures.append(plots.save(figure, out / "drift.png"))
        figures.append(plots.save(plots.coning_errors(outcomes), out / "errors.png"))
        figures.append(plots.save(plots.coning_consistency(outcomes), out / "consistency.png"))
    return Result(drifts=drifts, outcomes=outcomes, figures=tuple(figures))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/coning"))
    arguments = parser.parse_args()
    result = main(runs=arguments.runs, seed=arguments.seed, out=arguments.out)
    for drift, outcome in zip(result.drifts, result.outcomes, strict=True):
        summary = outcome.summary()
        print(
            f"{drift.algorithm:14s} drift {drift.measured / DEGREE_PER_HOUR:11.4g} °/h, mean bias error about z "
            f"{summary['bias_mean_deg_per_hour'][2]:8.3f} °/h, ANEES attitude {summary['anees_attitude']:6.3f}, bias "
            f"{summary['anees_bias']:10.4g}: {summary['verdict']}"
        )
    print("figures:", *result.figures)
