"""A Monte Carlo compared with theory: a matched filter passes, and a mismatched one fails by the predicted amount.

A body at rest, a gyro with white and random-walk noise, an attitude sensor once a second. The filter's noise differs from the true one by a
known factor. The covariance of its true errors is then also known: it is propagated with the filter's gains and the true noise (Joseph's
form). Both covariances give the mean NEES and NIS at every time without a run. Run ``python sims/campaign.py``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import consistency, montecarlo, motion, plots
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.montecarlo import FilterSetup, Plan, Statistics
from strapdown.plots import style
from strapdown.scenarios import Scenario
from strapdown.units import ARCSECOND, DEGREE_PER_HOUR, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR
from strapdown.vectors import AttitudeSensor

SMALL = {"runs": 40, "machine": "scalar"}
"""Arguments of a quick test run."""

GYRO = GyroSpec(angle_random_walk=0.15 * DEGREE_PER_ROOT_HOUR, rate_random_walk=20.0 * DEGREE_PER_HOUR_PER_ROOT_HOUR)
SIGMA = 40.0 * ARCSECOND
"""σ of the attitude sensor about each axis, rad."""
INTERVAL = 1.0
"""Interval of the attitude measurements, s."""
SCENARIO = Scenario(
    name="rest-mismatched",
    motion=motion.rest(),
    gyro=GYRO,
    sensors=(AttitudeSensor(name="star tracker", sigma_across=SIGMA, sigma_about=SIGMA, rate=1.0 / INTERVAL),),
    rate=10.0,
    duration=300.0,
)
RIGHT = FilterSetup(
    process_noise=ProcessNoise(
        angle_random_walk=float(GYRO.angle_random_walk), rate_random_walk=float(GYRO.rate_random_walk)
    ),
    attitude_sigma=200.0 * ARCSECOND,
    bias_sigma=20.0 * DEGREE_PER_HOUR,
)
FACTORS: dict[str, tuple[float, float]] = {
    "right": (1.0, 1.0),
    "Q × 4": (4.0, 1.0),
    "Q / 4": (0.25, 1.0),
    "R × 4": (1.0, 4.0),
    "R / 4": (1.0, 0.25),
}
"""Process noise Q and measurement noise R of the filter, as multiples of the true ones."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Theoretical values for one axis at each epoch, including the start."""

    covariance: np.ndarray
    """The filter's covariance (m, 2, 2): attitude, bias."""
    true_covariance: np.ndarray
    """The covariance of the filter's true errors (m, 2, 2)."""
    nis: np.ndarray
    """Mean NIS of each measurement, per degree of freedom (measurements,)."""

    def anees(self, subset: str) -> np.ndarray:
        """Return the mean NEES of a subset per state (m,): tr(P⁻¹ Σ) divided by the number of states."""
        return self._eigenvalues(subset).mean(axis=1)

    def standard_error(self, subset: str, runs: int) -> np.ndarray:
        """Return the standard error of the ANEES of a Monte Carlo over three axes (m,): eᵀP⁻¹e has variance 2 tr((P⁻¹ Σ)²)."""
        values = self._eigenvalues(subset)
        return np.sqrt(2.0 * np.sum(values**2, axis=1) / (3.0 * runs)) / values.shape[1]

    def _eigenvalues(self, subset: str) -> np.ndarray:
        rows = {"state": slice(0, 2), "attitude": slice(0, 1), "bias": slice(1, 2)}[subset]
        P, S = self.covariance[:, rows, rows], self.true_covariance[:, rows, rows]
        return np.real(np.linalg.eigvals(np.linalg.solve(P, S)))


def predict(factor_q: float, factor_r: float, epochs: int) -> Prediction:
    """Return the theoretical values for one axis at rest of a filter that models ``factor_q`` times Q and ``factor_r`` times R."""
    T, white, walk = INTERVAL, float(GYRO.angle_random_walk) ** 2, float(GYRO.rate_random_walk) ** 2
    phi = np.array([[1.0, -T], [0.0, 1.0]])
    Q = np.array([[white * T + walk * T**3 / 3.0, -walk * T**2 / 2.0], [-walk * T**2 / 2.0, walk * T]])
    R, H = SIGMA**2, np.array([[1.0, 0.0]])
    P = np.diag([RIGHT.attitude_sigma**2, RIGHT.bias_sigma**2])
    S = P.copy()
    modelled, true, nis = [P], [S], []
    for _ in range(round(SCENARIO.duration / T)):
        P = phi @ P @ phi.T + factor_q * Q
        S = phi @ S @ phi.T + Q
        innovation = float(P[0, 0] + factor_r * R)
        nis.append((S[0, 0] + R) / innovation)
        K = P @ H.T / innovation
        left = np.eye(2) - K @ H
        P = left @ P @ left.T + factor_r * R * (K @ K.T)
        S = left @ S @ left.T + R * (K @ K.T)
        modelled.append(P)
        true.append(S)
    every = slice(None, None, round(SCENARIO.duration / T) // epochs)
    return Prediction(covariance=np.array(modelled)[every], true_covariance=np.array(true)[every], nis=np.array(nis))


@dataclass(frozen=True, kw_only=True)
class Result:
    """Monte Carlo and theory of each mismatch."""

    statistics: dict[str, Statistics]
    predictions: dict[str, Prediction]
    machine: str
    figures: tuple[Path, ...]


def plan(factor_q: float, factor_r: float, seed: int) -> Plan:
    """Return the plan of a filter that models ``factor_q`` times Q and ``factor_r`` times R."""
    root = float(np.sqrt(factor_q))
    noise = ProcessNoise(
        angle_random_walk=root * RIGHT.process_noise.angle_random_walk,
        rate_random_walk=root * RIGHT.process_noise.rate_random_walk,
    )
    setup = replace(RIGHT, process_noise=noise, measurement_sigma_factor=float(np.sqrt(factor_r)))
    return Plan(scenario=SCENARIO, setup=setup, seed=seed, epochs=100, nis_bins=round(SCENARIO.duration / INTERVAL))


def main(*, runs: int = 4000, seed: int = 1, machine: str = "auto", out: Path | str | None = None) -> Result:
    """Run each mismatch and compare it with its prediction. Figures are written to ``out`` if it is given."""
    plans = {name: plan(*factors, seed) for name, factors in FACTORS.items()}
    statistics = {name: montecarlo.run_plan(plan, runs=runs, machine=machine) for name, plan in plans.items()}
    predictions = {name: predict(*factors, plans[name].epochs) for name, factors in FACTORS.items()}
    figures = []
    if out is not None:
        figures.append(plots.save(draw(statistics, predictions, runs), Path(out) / "mismatch.png"))
    return Result(
        statistics=statistics,
        predictions=predictions,
        machine=str(montecarlo.choose(plans["right"], machine)),
        figures=tuple(figures),
    )


def draw(statistics: dict[str, Statistics], predictions: dict[str, Prediction], runs: int) -> Any:
    """Draw NEES of attitude and bias and NIS over time, from the runs and predicted."""
    figure, axes = plots.new_figure(1, 3, size=(10.5, 4.6))
    for ax, subset in zip(axes, ("attitude", "bias", None), strict=True):
        low, high = consistency.mean_bounds(3, runs)
        ax.axhspan(low, high, color=style.ink(), alpha=0.15, linewidth=0, label="99 % bounds of a consistent filter")
        for k, name in enumerate(FACTORS):
            measured, predicted = statistics[name], predictions[name]
            if subset is None:
                ax.plot(measured.nis_time[::3], measured.nis[::3], ".", markersize=3, color=style.CYCLE[k], label=name)
                ax.plot(measured.nis_time, predicted.nis, color=style.CYCLE[k], linewidth=1.0)
            else:
                column = ("state", "attitude", "bias").index(subset)
                ax.plot(measured.time, measured.anees[:, column], ".", markersize=3, color=style.CYCLE[k], label=name)
                ax.plot(measured.time, predicted.anees(subset), color=style.CYCLE[k], linewidth=1.0)
        ax.set_yscale("log")
        ax.set_yticks([0.25, 0.5, 1.0, 2.0, 4.0], ["¼", "½", "1", "2", "4"])
        ax.minorticks_off()
        ax.set_ylim(0.2, 5.0)
        ax.set_xlabel("time, s")
        ax.set_title("NIS" if subset is None else f"NEES of the {subset}")
    axes[0].set_ylabel("mean per degree of freedom")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False, markerscale=4)
    figure.suptitle(
        f"Filters whose Q or R is wrong by a factor: {runs} runs (dots) and theory, tr(P⁻¹Σ) with the filter's gains (lines)"
    )
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/campaign"))
    arguments = parser.parse_args()
    result = main(runs=arguments.runs, seed=arguments.seed, out=arguments.out)
    print(
        f"{arguments.runs} runs of each, machine: {result.machine}. At the end, per degree of freedom, from the runs (predicted):"
    )
    for name, measured in result.statistics.items():
        predicted = result.predictions[name]
        parts = [
            f"{subset} {measured.anees[-1, k]:.3f} ({predicted.anees(subset)[-1]:.3f})"
            for k, subset in ((1, "attitude"), (2, "bias"))
        ]
        verdict = measured.judge().verdict
        print(f"{name:6s} NEES of {', '.join(parts)}, NIS {measured.nis[-1]:.3f} ({predicted.nis[-1]:.3f}): {verdict}")
    print("figures:", *result.figures)
