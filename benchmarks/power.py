"""False alarms and power of the consistency statistics, over many simulated filters. ``python benchmarks/power.py [--json FILE]``.

The filters are linear: angle and bias of one axis, a gyro step and two angle measurements per step, the covariance by recursion. They are
simulated all at once, so ten thousand take seconds. The truth differs from the filter's model in known ways, and the fraction of filters
rejected by each statistic at 95 and 99 % is printed; for a correct filter it should be 5 and 1 %.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import consistency
from strapdown.checks import Array
from strapdown.consistency import bounds, timeaverage, whiteness
from strapdown.files import write_json


@dataclass(frozen=True, kw_only=True)
class Filters:
    """Errors of many linear filters with their covariances, and whitened innovations."""

    error: Array
    """Errors (runs, steps, 2): angle, bias."""
    covariance: Array
    """Covariance in every filter (steps, 2, 2)."""
    innovation: Array
    """Whitened innovations of two sequential measurements (runs, steps, 2)."""


@dataclass(frozen=True, kw_only=True)
class Mismatch:
    """Difference of the truth from the filter's model. Default: none."""

    measurement: float = 1.0
    """Ratio of the true measurement noise to the modelled one."""
    process: float = 1.0
    """Ratio of the true angle random walk to the modelled one."""
    bias_walk: float = 1.0
    """Ratio of the true rate random walk to the modelled one."""
    outliers: float = 0.0
    """Probability that a measurement has ten times the noise."""
    colour: float = 0.0
    """Correlation of successive measurement noise of a sensor."""
    offset: float = 0.0
    """Constant error of the first sensor relative to its σ."""
    drift: float = 0.0
    """Constant rate error that is not a bias, such as coning error, relative to the final σ of the bias."""


ANGLE_WALK, BIAS_WALK, MEASUREMENT = 0.3, 0.03, 1.0


def linear_filters(
    runs: int, steps: int, generator: np.random.Generator, mismatch: Mismatch | None = None, every: int = 1
) -> Filters:
    """Return the results of ``runs`` filters over ``steps`` steps of unit time; errors are kept at every ``every``-th."""
    truth = mismatch or Mismatch()
    F = np.array([[1.0, -1.0], [0.0, 1.0]])
    Q = ANGLE_WALK**2 * np.diag([1.0, 0.0]) + BIAS_WALK**2 * np.array([[1.0 / 3.0, -0.5], [-0.5, 1.0]])
    true_Q = (truth.process * ANGLE_WALK) ** 2 * np.diag([1.0, 0.0]) + (truth.bias_walk * BIAS_WALK) ** 2 * np.array(
        [[1.0 / 3.0, -0.5], [-0.5, 1.0]]
    )
    root = np.linalg.cholesky(true_Q)
    P = np.diag([1.0, 0.1])
    e = generator.standard_normal((runs, 2)) * np.sqrt(np.diag(P))
    colour = generator.standard_normal((runs, 2))
    drift = truth.drift * np.sqrt(_steady_bias_variance(F, Q))
    kept = range(every - 1, steps, every)
    error, covariance = np.empty((runs, len(kept), 2)), np.empty((len(kept), 2, 2))
    innovation = np.empty((runs, steps, 2))
    for k in range(steps):
        P = F @ P @ F.T + Q
        e = e @ F.T + generator.standard_normal((runs, 2)) @ root.T
        e[:, 0] -= drift
        for sensor in range(2):
            fresh = generator.standard_normal(runs)
            colour[:, sensor] = truth.colour * colour[:, sensor] + np.sqrt(1.0 - truth.colour**2) * fresh
            noise = truth.measurement * colour[:, sensor]
            if truth.outliers:
                noise = np.where(generator.random(runs) < truth.outliers, 10.0 * noise, noise)
            if sensor == 0:
                noise = noise + truth.offset
            s = P[0, 0] + MEASUREMENT**2
            K = P[:, 0] / s
            y = e[:, 0] + MEASUREMENT * noise
            innovation[:, k, sensor] = y / np.sqrt(s)
            e = e - y[:, None] * K
            P = P - np.outer(K, K) * s
        if (k + 1) % every == 0:
            error[:, k // every], covariance[k // every] = e, P
    return Filters(error=error, covariance=covariance, innovation=innovation)


def _steady_bias_variance(F: Array, Q: Array) -> float:
    from scipy.linalg import solve_discrete_are

    H, R = np.array([[1.0, 0.0], [1.0, 0.0]]), MEASUREMENT**2 * np.eye(2)
    P = solve_discrete_are(F.T, H.T, Q, R)
    return float((P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P))[1, 1])


def single_run_p_values(filters: Filters, *, averages: bool = True) -> dict[str, Array]:
    """Return the p-value of every statistic of one run, for each run."""
    white = consistency.whitened(filters.error, np.broadcast_to(filters.covariance, (*filters.error.shape, 2)))
    runs, steps, _ = filters.innovation.shape
    clock = np.arange(steps, dtype=np.float64)
    p_values: dict[str, list[float]] = {}

    def note(name: str, p: float) -> None:
        p_values.setdefault(name, []).append(p)

    for k in range(runs):
        z = filters.innovation[k]
        note("NEES at the end", consistency.mean_p_value(float(np.mean(white[k, -1] ** 2)), 2, 1))
        if averages:
            effective = timeaverage.effective_samples(white[k])
            note("time-averaged NEES", consistency.mean_p_value(float(np.mean(white[k] ** 2)), 2, effective))
        note("NIS", consistency.mean_p_value(float(np.mean(z * z)), 2, steps))
        note("whiteness", whiteness.ljung_box(z)[2])
        note("normality", whiteness.anderson_darling(z)[1])
        note("mean innovation", whiteness.mean_innovation_p_value(z)[1])
        note("cross-correlation", whiteness.cross_correlation_p_value(clock, z[:, 0], clock, z[:, 1])[2])
    return {name: np.array(values) for name, values in p_values.items()}


def many_run_p_values(white: Array) -> dict[str, Array]:
    """Return p-values (groups,) of the statistics of independent runs at one epoch, from whitened errors (groups, runs, n)."""
    _, runs, n = white.shape
    squares = np.sum(white**2, axis=2)
    return {
        "ANEES": np.array([bounds.mean_p_value(float(x), n, runs) for x in squares.mean(axis=1) / n]),
        "log-NEES": np.array([bounds.log_mean_p_value(float(x), n, runs) for x in np.log(squares).mean(axis=1)]),
    }


ENSEMBLE = ("ANEES", "log-NEES")

MISMATCHES: dict[str, Mismatch] = {
    "none": Mismatch(),
    "R: σ 10 % larger": Mismatch(measurement=1.1),
    "R: σ 25 % larger": Mismatch(measurement=1.25),
    "R: σ 20 % smaller": Mismatch(measurement=0.8),
    "Q: angle walk 1.5 times": Mismatch(process=1.5),
    "Q: angle walk 2 times": Mismatch(process=2.0),
    "Q: angle walk half": Mismatch(process=0.5),
    "Q: bias walk 3 times": Mismatch(bias_walk=3.0),
    "outliers 1 %": Mismatch(outliers=0.01),
    "outliers 5 %": Mismatch(outliers=0.05),
    "coloured noise 0.2": Mismatch(colour=0.2),
    "coloured noise 0.5": Mismatch(colour=0.5),
    "sensor offset 0.3 σ": Mismatch(offset=0.3),
    "commutation 3 σ of bias": Mismatch(drift=3.0),
}


def main(*, runs: int = 1000, steps: int = 500, group: int = 50, groups: int = 400, seed: int = 1) -> dict[str, Any]:
    """Return the fraction of filters rejected at 95 and 99 %, by mismatch and statistic."""
    rows = []
    for name, mismatch in MISMATCHES.items():
        random = np.random.default_rng([seed, len(rows)])
        p_values = single_run_p_values(linear_filters(runs, steps, random, mismatch))
        ends = linear_filters(groups * group, 200, random, mismatch, every=200)
        white = consistency.whitened(ends.error[:, -1], np.broadcast_to(ends.covariance[-1], (len(ends.error), 2, 2)))
        p_values |= many_run_p_values(white.reshape(-1, group, 2))
        for statistic, p in p_values.items():
            rows.append(
                {
                    "mismatch": name,
                    "statistic": statistic,
                    "runs_each": group if statistic in ENSEMBLE else 1,
                    "filters": len(p),
                    "refused_at_95": float(np.mean(p < 0.05)),
                    "refused_at_99": float(np.mean(p < 0.01)),
                }
            )
    return {"steps": steps, "group": group, "seed": seed, "rows": rows}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result = main(runs=arguments.runs, steps=arguments.steps)
    statistics = list(dict.fromkeys(row["statistic"] for row in result["rows"]))
    print(f"Rejected at 99 %, in %. The last four are for {result['group']} runs at one epoch, the others for one run.")
    print(f"{'':26s}" + " ".join(f"{name[:11]:>11s}" for name in statistics))
    for mismatch in MISMATCHES:
        shares = [row["refused_at_99"] for row in result["rows"] if row["mismatch"] == mismatch]
        print(f"{mismatch:26s}" + " ".join(f"{100.0 * share:11.1f}" for share in shares))
    if arguments.json:
        write_json(arguments.json, result)
