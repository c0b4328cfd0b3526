"""Does tuning converge to the truth from parameters wrong by a factor of 30? One simulated record, many searches, held-out data.

Run ``python sims/tune_filter.py [--out FOLDER]``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from strapdown import gyro, motion, plots, scenarios, tuning, units, vectors
from strapdown.estimation import setup
from strapdown.plots import style
from strapdown.plots import tuning as drawing
from strapdown.tuning import Comparison, Tuning

FREE = ("gyro.arw", "gyro.rrw", "star 1.sigma", "star 2.sigma")


@dataclass(frozen=True, kw_only=True)
class Result:
    """Two tunings of one record, from values too large and too small."""

    truth: dict[str, float]
    """True values, SI."""
    too_large: Tuning
    too_small: Tuning
    held_out: Comparison
    """The optimistic filter before and after tuning, on the end of the record."""
    record: scenarios.ImuRecord


SMALL = {"duration": 300.0, "starts": 4}
"""Arguments of a quick test run."""


def main(*, duration=1800.0, rate=20.0, wrong=30.0, starts=20, seed=1, out=None):
    """Tune from ``wrong`` times and 1/``wrong`` of the true values, with random starts that differ by the same factor again.

    Returns
    -------
    Result
    """
    scenario = scenarios.Scenario(
        motion=motion.SpinRock(rock_angle=0.3, rock_frequency=0.05, spin_rate=0.02),
        gyro=gyro.GyroSpec(
            angle_random_walk=0.15 * units.DEGREE_PER_ROOT_HOUR,
            rate_random_walk=20.0 * units.DEGREE_PER_HOUR_PER_ROOT_HOUR,
            turn_on_bias_sigma=10.0 * units.DEGREE_PER_HOUR,
        ),
        sensors=(
            vectors.VectorSensor(
                name="star 1", reference_f=np.array([1.0, 0.0, 0.0]), sigma=20.0 * units.ARCSECOND, rate=1.0
            ),
            vectors.VectorSensor(
                name="star 2", reference_f=np.array([0.0, 1.0, 1.0]), sigma=60.0 * units.ARCSECOND, rate=2.0
            ),
        ),
        rate=rate,
        duration=duration,
    )
    right = setup.FilterSetup.for_scenario(scenario, attitude_sigma=0.1 * units.DEGREE, states=False)
    record = scenarios.simulate(scenario, seed)
    whole = tuning.record_case(record, right, seed=seed)
    (train,), test = tuning.split([whole], 0.3)
    truth = tuning.values_of(right, FREE, [record])
    tuned, before = {}, {}
    for name, factor in (("too large", wrong), ("too small", 1.0 / wrong)):
        before[name] = tuning.with_values(right, {key: factor * value for key, value in truth.items()})
        objective = tuning.likelihood([train], before[name], FREE)
        tuned[name] = tuning.fit(objective, starts=starts, seed=seed, threads=2)
    result = Result(
        truth=truth,
        too_large=tuned["too large"],
        too_small=tuned["too small"],
        held_out=tuning.compare(test, before["too small"], tuned["too small"].setup),
        record=record,
    )
    if out is not None:
        draw(result, Path(out))
    return result


def draw(result, folder):
    """Write the figures: values against the truth, slices of the likelihood."""
    figure, ax = plots.new_figure(size=(6.5, 4.6))
    values(result, ax)
    tuned = result.too_small
    figures = {
        "tune_filter": figure,
        "tune_filter-likelihood": drawing.likelihood_slices(tuning.slices(tuned), tuned),
    }
    for name, figure in figures.items():
        plots.save(figure, folder / f"{name}.png")


def values(result, ax):
    """Draw tuned values relative to the truth with their intervals, and the spread of the Cramér–Rao bound."""
    place, truth = np.arange(len(FREE)), np.array(list(result.truth.values()))
    for shift, search, name in ((-0.12, result.too_large, "from 30 times"), (0.12, result.too_small, "from a 30th")):
        value, lower, upper = np.array([[p.value, p.lower, p.upper] for p in search.parameters]).T / truth
        ax.errorbar(place + shift, value, (value - lower, upper - value), fmt="o", ms=4, capsize=3, label=name)
    half = 1.96 * np.array([parameter.standard_error for parameter in result.too_small.parameters])
    bound = {"height": np.exp(half) - np.exp(-half), "bottom": np.exp(-half), "width": 0.6, "alpha": 0.2}
    ax.bar(place, **bound, label="95 % of the Cramér–Rao bound")
    ax.axhline(1.0, lw=0.8, color="k")
    ax.set_xticks(place, FREE)
    ax.set_ylabel("tuned value over the true one")
    style.log_scale(ax)
    style.legend_below(ax.figure, [ax])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/tune_filter"))
    parser.add_argument("--starts", type=int, default=20, help="number of searches, each from a random start")
    parser.add_argument("--seed", type=int, default=1)
    result = main(**vars(parser.parse_args()))
    for start, search in (("30 times", result.too_large), ("a 30th", result.too_small)):
        print(f"from {start}: {search.agreeing} of {len(search.starts)} searches agree")
        for parameter, (name, value) in zip(search.parameters, result.truth.items(), strict=True):
            ratio = np.array([parameter.value, parameter.lower, parameter.upper]) / value
            print(f"  {name:14s} {ratio[0]:.3f} of the truth, 95 % {ratio[1]:.3f} to {ratio[2]:.3f}: {parameter.note}")
    print(f"held out, NIS before {result.held_out.before.nis:.4g}, after {result.held_out.after.nis:.4g}")
