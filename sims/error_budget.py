"""What are the sources of a filter's errors? Its error budget from one pass without noise, compared with a Monte Carlo.

A tumbling satellite with a star tracker that is blinded for a minute, and a gyro with white noise, rate random walk, flicker, and errors of
scale factor and misalignment that no filter models. The covariance analysis (:mod:`strapdown.covariance`) predicts the RMS error, the
filter's σ, the resulting NEES, and the contribution of each source. Independent runs test the prediction, for the filter that matches the
noise and for one that models a quarter of the process noise.

Run it: ``python sims/error_budget.py --out error-budget-results`` (a minute).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from strapdown import covariance, montecarlo, plots, scenarios
from strapdown.estimation import setup
from strapdown.estimation.states import ProcessNoise
from strapdown.plots import style
from strapdown.units import ARCSECOND, DEGREE, DEGREE_PER_HOUR

SMALL = {"runs": 4, "duration": 60.0, "epochs": 10}
"""Arguments of a quick test run."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Prediction and Monte Carlo by filter."""

    analyses: dict[str, covariance.Analysis]
    statistics: dict[str, montecarlo.Statistics]

    def worst(self, name: str) -> float:
        """Return the largest difference of log RMS over epochs and states, in standard deviations 1/√(2 runs)."""
        statistics = self.statistics[name]
        ratio = np.log(statistics.rms_error[1:] / self.analyses[name].rms[1:])
        return float(np.abs(ratio).max() * np.sqrt(2.0 * statistics.runs))


def draw(result: Result, path: Path) -> Path:
    """Draw predicted and actual RMS and NEES over time and write the figure."""
    figure, axes = plots.new_figure(1, 3, size=(10.5, 4.4))
    for (name, a), colour in zip(result.analyses.items(), style.CYCLE, strict=False):
        s = result.statistics[name]
        for ax, part, unit in ((axes[0], slice(0, 3), ARCSECOND), (axes[1], slice(3, 6), DEGREE_PER_HOUR)):
            predicted, actual, own = (
                np.sqrt(np.mean(values[:, part] ** 2, axis=1)) / unit for values in (a.rms, s.rms_error, a.filter_sigma)
            )
            ax.semilogy(a.time, predicted, color=colour, label=f"{name}: predicted RMS")
            ax.semilogy(a.time, actual, ".", color=colour, markersize=4, label=f"{name}: {s.runs} runs")
            ax.semilogy(a.time, own, "--", color=colour, linewidth=1.0, label=f"{name}: its σ")
        axes[2].semilogy(a.time, a.expected_nees[:, 0], color=colour)
        axes[2].semilogy(a.time, s.anees[:, 0], ".", color=colour, markersize=4)
    for ax, label in zip(axes, ("attitude, one axis, arcsec", "bias, one axis, °/h", "NEES per state"), strict=True):
        ax.set(xlabel="time, s", ylabel=label)
    style.legend_below(figure, [axes[0]], ncols=3)
    return plots.save(figure, path)


def table(result: Result) -> str:
    """Return the budgets and the comparison as text."""
    lines = []
    for name, analysis in result.analyses.items():
        statistics = result.statistics[name]
        attitude, bias = (float(np.sqrt(np.mean(x**2))) for x in np.split(statistics.rms_error[-1], 2))
        lines += [
            f"{name}: {analysis.listing().text}",
            f"RMS of {statistics.runs} runs: attitude {attitude / ARCSECOND:.3f} arcsec, bias {bias / DEGREE_PER_HOUR:.4f} °/h; "
            f"NEES per state: predicted {analysis.expected_nees[-1, 0]:.4g}, runs {statistics.anees[-1, 0]:.4g}",
            f"largest difference of an RMS over all epochs and states: {result.worst(name):.2f} standard deviations",
            "",
        ]
    return "\n".join(lines)


def main(
    *,
    scenario: str = "tumbling-satellite",
    runs: int = 200,
    duration: float | None = None,
    epochs: int = 100,
    seed: int = 1,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> Result:
    """Predict and run; ``duration`` in s, that of the scenario if not given. Figures and table are written to ``out`` if it is given."""
    base = scenarios.load_scenario(scenario)
    if duration is not None:
        base = replace(base, duration=duration)
    matched = setup.FilterSetup.for_scenario(base, attitude_sigma=0.1 * DEGREE, states=False)
    noise = matched.process_noise
    half = ProcessNoise(angle_random_walk=0.5 * noise.angle_random_walk, rate_random_walk=0.5 * noise.rate_random_walk)
    filters = {"matched": matched, "a quarter of Q": replace(matched, process_noise=half)}
    analyses, statistics = {}, {}
    for name, f in filters.items():
        progress(f"{name}: covariance analysis")
        analyses[name] = covariance.analyse(base, f, epochs=epochs)
        progress(f"{name}: {runs} runs")
        plan = montecarlo.Plan(scenario=base, setup=f, seed=seed, epochs=epochs)
        statistics[name] = montecarlo.run_plan(plan, runs=runs)
    result = Result(analyses=analyses, statistics=statistics)
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        draw(result, folder / "error_budget.png")
        plots.save(plots.error_budget(result.analyses["matched"]), folder / "budget.png")
        (folder / "error_budget.txt").write_text(table(result), encoding="utf-8")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/error_budget"))
    parser.add_argument("--scenario", default="tumbling-satellite", help="name of a built-in scenario, or a TOML file")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    print(table(main(**vars(parser.parse_args()), progress=lambda line: print(line, file=sys.stderr))))
