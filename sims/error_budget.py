"""What are the sources of a filter's errors? Its error budget from one pass without noise, compared with a Monte Carlo.

A tumbling satellite with a star tracker that is blinded for a minute, and a gyro with white noise, rate random walk, flicker, and errors of
scale factor and misalignment that no filter models. The covariance analysis (:mod:`strapdown.covariance`) predicts the RMS error, the
filter's σ, the resulting NEES, and the contribution of each source. Independent runs test the prediction, for the filter that matches the
noise and for one that models a quarter of the process noise.

Run it: ``python sims/error_budget.py --out error-budget-results`` (a minute).
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from strapdown import consistency, covariance, plots, quaternion, scenarios
from strapdown.checks import Array
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise
from strapdown.plots import style
from strapdown.randomness import generator
from strapdown.units import ARCSECOND, DEGREE, DEGREE_PER_HOUR

SMALL = {"runs": 4, "duration": 60.0, "epochs": 10}
"""Arguments of a quick test run."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Prediction and Monte Carlo of one filter."""

    filter: str
    analysis: covariance.Analysis
    rms: Array
    """RMS error over the runs (m, 6): rad, rad/s."""
    anees: Array
    """Mean NEES over the runs (m,), per state."""
    runs: int

    @property
    def worst(self) -> float:
        """Largest difference of log RMS between prediction and runs over epochs and states, in standard deviations 1/√(2 runs)."""
        ratio = np.log(self.rms[1:] / self.analysis.rms[1:])
        return float(np.abs(ratio).max() * np.sqrt(2.0 * self.runs))


@dataclass(frozen=True, kw_only=True)
class Result:
    """Results of the study."""

    comparisons: tuple[Comparison, ...]
    figures: tuple[Path, ...]


def more_sure(filter_setup: FilterSetup) -> FilterSetup:
    """Return the setup with a quarter of the process noise."""
    noise = filter_setup.process_noise
    half = ProcessNoise(angle_random_walk=0.5 * noise.angle_random_walk, rate_random_walk=0.5 * noise.rate_random_walk)
    return dataclasses.replace(filter_setup, process_noise=half)


def compare(
    name: str,
    scenario: scenarios.Scenario,
    filter_setup: FilterSetup,
    *,
    runs: int,
    epochs: int,
    seed: int,
    progress: Callable[[str], None],
) -> Comparison:
    """Return prediction and Monte Carlo of one filter."""
    progress(f"{name}: covariance analysis, which is compiled at its first use")
    analysis = covariance.analyse(scenario, filter_setup, epochs=epochs)
    every = (len(scenario.edges) - 1) // filter_setup.integration.samples // epochs
    squares, nees = np.zeros_like(analysis.rms), np.zeros(len(analysis.time))
    for run in range(runs):
        if run % 20 == 0:
            progress(f"{name}: run {run + 1} of {runs}")
        record = scenarios.simulate(scenario, seed, run)
        assert record.truth is not None
        draw = generator(seed, run, "initial error").standard_normal(6)
        attitude = quaternion.multiply(
            record.truth.attitude[0], quaternion.exp(-filter_setup.attitude_sigma * draw[:3])
        )
        initial = setup.initial_state(filter_setup, attitude, record.truth.bias[0] - filter_setup.bias_sigma * draw[3:])
        estimate = setup.run(record, filter_setup, initial, every=every, full_covariance=True)
        truth = setup.modelled_record(record, filter_setup).truth
        assert truth is not None
        e = consistency.errors(estimate.attitude, estimate.bias, truth.attitude[::every], truth.bias[::every])
        squares += e**2
        nees += consistency.nees(e, estimate.covariance) / 6.0
    return Comparison(filter=name, analysis=analysis, rms=np.sqrt(squares / runs), anees=nees / runs, runs=runs)


def draw(comparisons: tuple[Comparison, ...], path: Path) -> Path:
    """Draw predicted and actual RMS and NEES over time and write the figure."""
    figure, axes = plots.new_figure(1, 3, size=(10.5, 4.4))
    for k, c in enumerate(comparisons):
        a, colour = c.analysis, style.CYCLE[k]
        for ax, part, unit in ((axes[0], slice(0, 3), ARCSECOND), (axes[1], slice(3, 6), DEGREE_PER_HOUR)):
            predicted, actual, own = (
                np.sqrt(np.mean(values[:, part] ** 2, axis=1)) / unit for values in (a.rms, c.rms, a.filter_sigma)
            )
            ax.semilogy(a.time, predicted, color=colour, label=f"{c.filter}: predicted RMS")
            ax.semilogy(a.time, actual, ".", color=colour, markersize=4, label=f"{c.filter}: {c.runs} runs")
            ax.semilogy(a.time, own, "--", color=colour, linewidth=1.0, label=f"{c.filter}: its σ")
        axes[2].semilogy(a.time, a.expected_nees[:, 0], color=colour)
        axes[2].semilogy(a.time, c.anees, ".", color=colour, markersize=4)
    axes[0].set(xlabel="time, s", ylabel="attitude, one axis, arcsec")
    axes[1].set(xlabel="time, s", ylabel="bias, one axis, °/h")
    axes[2].set(xlabel="time, s", ylabel="NEES per state")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return plots.save(figure, path)


def table(result: Result) -> str:
    """Return the budgets and the comparison as text."""
    lines = []
    for c in result.comparisons:
        a = c.analysis
        lines += [f"{c.filter}, at {a.time[-1]:g} s, RMS per axis", ""]
        lines += [f"  {'source':32s} {'kind':10s} {'attitude, arcsec':>16s} {'bias, °/h':>10s}"]
        for name, kind, attitude, bias in sorted(a.budget(), key=lambda row: -row[2]):
            lines.append(f"  {name:32s} {kind:10s} {attitude / ARCSECOND:16.3f} {bias / DEGREE_PER_HOUR:10.4f}")
        totals = (("predicted", a.rms[-1]), (f"{c.runs} runs", c.rms[-1]), ("the filter's σ", a.filter_sigma[-1]))
        for name, values in totals:
            attitude, bias = (float(np.sqrt(np.mean(values[part] ** 2))) for part in (slice(0, 3), slice(3, 6)))
            lines.append(f"  {name:43s} {attitude / ARCSECOND:16.3f} {bias / DEGREE_PER_HOUR:10.4f}")
        lines += [
            f"  NEES per state: predicted {a.expected_nees[-1, 0]:.4g}, {c.runs} runs {c.anees[-1]:.4g}",
            f"  largest difference of an RMS over all epochs and states: {c.worst:.2f} standard deviations",
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
    """Predict and run; ``duration`` in s, that of the scenario if not given. Figures and table are written to ``out`` if it is given.

    ``progress`` is called with a line for each twenty runs.
    """
    base = scenarios.load_scenario(scenario)
    if duration is not None:
        base = dataclasses.replace(base, duration=duration)
    matched = setup.FilterSetup.for_scenario(base, attitude_sigma=0.1 * DEGREE, states=False)
    filters = (("matched", matched), ("a quarter of Q", more_sure(matched)))
    comparisons = tuple(
        compare(name, base, filter_setup, runs=runs, epochs=epochs, seed=seed, progress=progress)
        for name, filter_setup in filters
    )
    if out is None:
        return Result(comparisons=comparisons, figures=())
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    figures = (
        draw(comparisons, folder / "error_budget.png"),
        plots.save(plots.error_budget(comparisons[0].analysis), folder / "budget.png"),
    )
    result = Result(comparisons=comparisons, figures=figures)
    (folder / "error_budget.txt").write_text(table(result) + "\n", encoding="utf-8")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/error_budget"))
    parser.add_argument("--scenario", default="tumbling-satellite", help="name of a built-in scenario, or a TOML file")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    print(table(main(**vars(parser.parse_args()), progress=lambda line: print(line, file=sys.stderr))))
