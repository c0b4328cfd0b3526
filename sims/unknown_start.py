"""Which attitude is it? Attitude from a magnetometer only, from an unknown initial state.

The built-in scenario ``magnetometer-only``: a satellite in a low orbit that rotates once per orbit, a good gyro of unknown bias, a
magnetometer every ten seconds. One direction at a time leaves the rotation about it unobserved until the field has rotated. Initial
attitudes are uniform over all attitudes, gyro biases normal with 20 °/h. On the same records run

- the bank of hypotheses (:mod:`strapdown.estimation.multiple_model`), for several numbers of hypotheses;
- the MEKF from the identity, with the covariance of an unknown attitude.

Run ``python sims/unknown_start.py --out unknown-start-results`` (a minute).
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import consistency, estimation, plots, quaternion, scenarios
from strapdown.checks import Array
from strapdown.estimation import multiple_model
from strapdown.estimation.states import ProcessNoise
from strapdown.plots import style
from strapdown.randomness import generator
from strapdown.units import DEGREE, DEGREE_PER_HOUR

CONVERGED = 1.0 * DEGREE
"""Attitude error below which a run is converged if it stays below, rad."""
BIAS_SIGMA = 20.0 * DEGREE_PER_HOUR
ANYWHERE = float(np.sqrt((np.pi**2 / 3.0 + 2.0) / 3.0))
"""RMS error per axis of an attitude uniform over all attitudes, rad: the angle has the density (1 − cos θ)/π."""
EVERY = 10
"""Interval of the kept edges: one per measurement."""
FILTERS = ("bank of 24", "bank of 48", "bank of 96", "mekf")

SMALL = {"runs": 3, "duration": 900.0}
"""Arguments of a quick test run."""

COLOURS = {
    "bank of 24": style.SKY,
    "bank of 48": style.GREEN,
    "bank of 96": style.BLUE,
    "mekf": style.VERMILION,
}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one filter from many initial states."""

    filter: str
    time: Array
    """Epochs (m,), s."""
    error: Array
    """Attitude error of each run (runs, m), rad."""
    nees: Array
    """NEES of all six states of each run (runs, m), per degree of freedom."""
    became_one: Array
    """Time at which one hypothesis is left in each run (runs,), s; 0 for a single filter."""

    @property
    def runs(self) -> int:
        """Number of independent runs."""
        return len(self.error)

    @property
    def convergence(self) -> Array:
        """Time of each run after which its error stays below 1° (runs,), s; NaN if it does not."""
        first = np.where(self.error > CONVERGED, np.arange(1, 1 + len(self.time)), 0).max(axis=1)
        return np.append(self.time, np.nan)[first]

    @property
    def anees(self) -> Array:
        """Mean NEES over the runs (m,), 1 for a consistent filter."""
        return np.asarray(self.nees.mean(axis=0))

    @property
    def bounds(self) -> tuple[float, float]:
        """Two-sided 99 % bounds of the ANEES at one epoch."""
        return consistency.mean_bounds(6, self.runs)


@dataclass(frozen=True, kw_only=True)
class Result:
    """Results of the study."""

    outcomes: tuple[Outcome, ...]
    figures: tuple[Path, ...]

    def outcome(self, name: str) -> Outcome:
        """Return the outcome of one filter."""
        return next(o for o in self.outcomes if o.filter == name)


def anywhere(random: np.random.Generator) -> Array:
    """Return an attitude (4,), uniform over all attitudes."""
    return quaternion.normalize(random.standard_normal(4))


def study(name: str, *, runs: int, duration: float, seed: int) -> Outcome:
    """Return the outcome of one filter over independent runs."""
    scenario = dataclasses.replace(scenarios.load_scenario("magnetometer-only"), duration=duration)
    gyro = scenario.gyro
    noise = ProcessNoise(angle_random_walk=float(gyro.angle_random_walk), rate_random_walk=float(gyro.rate_random_walk))
    errors, nees, became_one = [], [], []
    first = 0
    for run in range(runs):
        # The motion's initial attitude is random, so that the identity is a random initial estimate.
        random = generator(seed, run, "start")
        turned = dataclasses.replace(scenario.motion, initial_attitude=anywhere(random))  # type: ignore[type-var]
        record = scenarios.simulate(dataclasses.replace(scenario, motion=turned), seed, run)
        assert record.truth is not None
        if name.startswith("bank"):
            bank = multiple_model.run(
                record, noise, hypotheses=int(name.rpartition(" ")[2]), bias_sigma=BIAS_SIGMA, every=EVERY
            )
            estimate, rows = bank.estimate, np.searchsorted(record.time, bank.estimate.time)
            became_one.append(bank.became_one)
        else:
            initial = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=ANYWHERE, bias_sigma=BIAS_SIGMA)
            estimate = estimation.run(record, noise, initial, every=EVERY, full_covariance=True)
            rows = np.arange(0, len(record.time), EVERY)
            became_one.append(0.0)
        truth = record.truth
        e = consistency.errors(estimate.attitude, estimate.bias, truth.attitude[rows], truth.bias[rows])
        errors.append(quaternion.angle_between(truth.attitude[rows], estimate.attitude))
        nees.append(consistency.nees(e, estimate.covariance) / 6.0)
        first = rows[0]
    return Outcome(
        filter=name,
        time=record.time[first::EVERY],
        error=np.array(errors),
        nees=np.array(nees),
        became_one=np.array(became_one),
    )


def draw(outcomes: Sequence[Outcome], path: Path) -> Path:
    """Draw error and ANEES over time and write the figure."""
    figure, (left, middle, right) = plots.new_figure(1, 3, size=(10.5, 4.6))
    for o in outcomes:
        hours = o.time / 3600.0
        line: dict[str, Any] = {"color": COLOURS.get(o.filter, style.ORANGE), "linewidth": 1.5}
        left.plot(
            hours,
            np.quantile(o.error, 0.5, axis=0) / DEGREE,
            label=f"{o.filter}, {o.runs} {'run' if o.runs == 1 else 'runs'}",
            **line,
        )
        left.plot(hours, np.quantile(o.error, 0.95, axis=0) / DEGREE, linestyle=(0, (3, 2)), **line)
        middle.plot(hours, o.anees, **line)
        if o.filter.startswith("bank"):
            right.plot(hours, o.anees, **line)
    most = max(outcomes, key=lambda o: o.runs)
    right.axhspan(*most.bounds, color="0.85", zorder=0)
    left.axhline(CONVERGED / DEGREE, color="0.6", linewidth=0.8, linestyle=":")
    left.set(yscale="log", xlabel="time, h", ylabel="attitude error, °")
    left.set_title("Median; dashes: 95th percentile")
    middle.set(yscale="log", xlabel="time, h", ylabel="ANEES / 6")
    middle.set_title("Consistent: 1 (log scale)")
    right.set(xlabel="time, h", ylabel="ANEES / 6")
    right.set_title("The banks, with 99 % bounds")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    return plots.save(figure, path)


def table(result: Result) -> str:
    """Return the figures as text."""
    lines = [
        f"{'filter':16s} {'runs':>5s} {'converged':>9s} {'to 1°, h: median':>16s} {'95 %':>7s} {'worst':>7s} "
        f"{'ANEES/6: 0.1 h':>14s} {'0.25 h':>9s} {'1 h':>9s} {'end':>9s}  99 % bounds"
    ]
    for o in result.outcomes:
        hours = np.sort(o.convergence) / 3600.0
        anees = [float(o.anees[min(int(np.searchsorted(o.time, t)), len(o.time) - 1)]) for t in (360.0, 900.0, 3600.0)]
        low, high = o.bounds
        quantiles = [hours[min(int(np.ceil(p * o.runs)) - 1, o.runs - 1)] for p in (0.5, 0.95, 1.0)]
        within = [f"{time:.3f}" if np.isfinite(time) else "never" for time in quantiles]
        lines.append(
            f"{o.filter:16s} {o.runs:5d} {100.0 * np.mean(np.isfinite(hours)):7.0f} % {within[0]:>16s} {within[1]:>7s} "
            f"{within[2]:>7s} {anees[0]:14.3g} {anees[1]:9.3g} {anees[2]:9.3g} {o.anees[-1]:9.3g}  {low:.3f} to {high:.3f}"
        )
    return "\n".join(lines)


def main(
    *,
    runs: int = 200,
    duration: float = 10800.0,
    filters: Sequence[str] = FILTERS,
    seed: int = 1,
    out: str | os.PathLike[str] | None = None,
) -> Result:
    """Compare the filters; ``duration`` in s. The figure and the table are written to ``out`` if it is given."""
    outcomes = tuple(study(name, runs=runs, duration=duration, seed=seed) for name in filters)
    if out is None:
        return Result(outcomes=outcomes, figures=())
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    result = Result(outcomes=outcomes, figures=(draw(outcomes, folder / "unknown_start.png"),))
    (folder / "unknown_start.txt").write_text(table(result) + "\n", encoding="utf-8")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/unknown_start"))
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--duration", type=float, default=10800.0, help="s")
    parser.add_argument("--seed", type=int, default=1)
    print(table(main(**vars(parser.parse_args()))))
