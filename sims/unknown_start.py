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
from strapdown.results import Column, Table
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

    @property
    def convergence(self) -> Array:
        """Time of each run after which its error stays below 1° (runs,), s; NaN if it does not."""
        first = np.where(self.error > CONVERGED, np.arange(1, 1 + len(self.time)), 0).max(axis=1)
        return np.append(self.time, np.nan)[first]

    @property
    def anees(self) -> Array:
        """Mean NEES over the runs (m,), 1 for a consistent filter."""
        return np.asarray(self.nees.mean(axis=0))


@dataclass(frozen=True, kw_only=True)
class Result:
    """Results of the study."""

    outcomes: tuple[Outcome, ...]


def study(name: str, *, runs: int, duration: float, seed: int) -> Outcome:
    """Return the outcome of one filter over independent runs."""
    scenario = dataclasses.replace(scenarios.load_scenario("magnetometer-only"), duration=duration)
    gyro = scenario.gyro
    noise = ProcessNoise(angle_random_walk=float(gyro.angle_random_walk), rate_random_walk=float(gyro.rate_random_walk))
    errors, nees = [], []
    for run in range(runs):
        # The motion's initial attitude is uniform over all attitudes, so that the identity is a random initial estimate.
        anywhere = quaternion.normalize(generator(seed, run, "start").standard_normal(4))
        turned = dataclasses.replace(scenario.motion, initial_attitude=anywhere)  # type: ignore[type-var]
        record = scenarios.simulate(dataclasses.replace(scenario, motion=turned), seed, run)
        if name.startswith("bank"):
            number = int(name.rpartition(" ")[2])
            bank = multiple_model.run(record, noise, hypotheses=number, bias_sigma=BIAS_SIGMA, every=EVERY)
            estimate = bank.estimate
        else:
            initial = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=ANYWHERE, bias_sigma=BIAS_SIGMA)
            estimate = estimation.run(record, noise, initial, every=EVERY, full_covariance=True)
        assert record.truth is not None
        truth = record.truth.taken(np.searchsorted(record.time, estimate.time))
        e = consistency.errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)
        errors.append(quaternion.angle_between(truth.attitude, estimate.attitude))
        nees.append(consistency.nees(e, estimate.covariance) / 6.0)
    return Outcome(filter=name, time=estimate.time, error=np.array(errors), nees=np.array(nees))


def draw(outcomes: Sequence[Outcome], path: Path) -> Path:
    """Draw error and ANEES over time and write the figure."""
    figure, (left, middle, right) = plots.new_figure(1, 3, size=(10.5, 4.6))
    for o, color in zip(outcomes, (style.SKY, style.GREEN, style.BLUE, style.VERMILION), strict=False):
        hours = o.time / 3600.0
        line: dict[str, Any] = {"color": color, "linewidth": 1.5}
        median, most = np.quantile(o.error, [0.5, 0.95], axis=0) / DEGREE
        left.plot(hours, median, label=f"{o.filter}, {len(o.error)} runs", **line)
        left.plot(hours, most, linestyle=(0, (3, 2)), **line)
        for ax in (middle, right) if o.filter.startswith("bank") else (middle,):
            ax.plot(hours, o.anees, **line)
    right.axhspan(*consistency.mean_bounds(6, len(outcomes[0].error)), color="0.85", zorder=0)
    left.axhline(CONVERGED / DEGREE, color="0.6", linewidth=0.8, linestyle=":")
    left.set(yscale="log", xlabel="time, h", ylabel="attitude error, °")
    left.set_title("Median; dashes: 95th percentile")
    middle.set(yscale="log", xlabel="time, h", ylabel="ANEES")
    middle.set_title("Consistent: 1 (log scale)")
    right.set(xlabel="time, h", ylabel="ANEES")
    right.set_title("The banks, with 99 % bounds")
    style.legend_below(figure, [left], ncols=5)
    return plots.save(figure, path)


def table(result: Result) -> Table:
    """Return the outcomes as a table."""
    hour = lambda t: f"{t:.3f}" if np.isfinite(t) else "never"  # noqa: E731
    times = [Column(f"to 1°: {words}, h", shown=hour) for words in ("median", "95 %", "worst")]
    anees = [Column(f"ANEES/6, {words}", digits=3) for words in ("0.1 h", "0.25 h", "1 h", "end")]
    rows = []
    for o in result.outcomes:
        hours = np.sort(o.convergence) / 3600.0
        quantiles = [hours[int(np.ceil(p * len(hours))) - 1] for p in (0.5, 0.95, 1.0)]
        epochs = np.minimum(np.searchsorted(o.time, [360.0, 900.0, 3600.0, np.inf]), len(o.time) - 1)
        rows.append((o.filter, len(hours), f"{np.mean(np.isfinite(hours)):.0%}", *quantiles, *o.anees[epochs]))
    low, high = consistency.mean_bounds(6, len(result.outcomes[0].error))
    note = f"99 % bounds of ANEES/6: {low:.3f} to {high:.3f}."
    return Table("Attitude from a magnetometer alone", ["filter", "runs", "converged", *times, *anees], rows, [note])


def main(
    *,
    runs: int = 200,
    duration: float = 10800.0,
    filters: Sequence[str] = FILTERS,
    seed: int = 1,
    out: str | os.PathLike[str] | None = None,
) -> Result:
    """Compare the filters; ``duration`` in s. The figure and the table are written to ``out`` if it is given."""
    result = Result(outcomes=tuple(study(name, runs=runs, duration=duration, seed=seed) for name in filters))
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        draw(result.outcomes, folder / "unknown_start.png")
        (folder / "unknown_start.txt").write_text(table(result).text + "\n", encoding="utf-8")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/unknown_start"))
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--duration", type=float, default=10800.0, help="s")
    parser.add_argument("--seed", type=int, default=1)
    print(table(main(**vars(parser.parse_args()))).text)
