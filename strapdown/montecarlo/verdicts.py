"""The verdict on the filter from the statistics of a campaign, as a table of numbers for a file or a screen."""

from __future__ import annotations

from typing import Any

import numpy as np

from strapdown import consistency, units
from strapdown.montecarlo.statistics import COVERED, Counts, Statistics, judged_epochs

QUANTILES = (0.5, 0.95, 0.997)
"""Quantiles of the last epoch's errors in the summary."""


def summary(statistics: Statistics, *, epochs: Counts | None = None, probability: float = 0.99) -> dict[str, Any]:
    """Return verdict and numbers: ANEES and NIS per degree of freedom, coverage, errors, worst runs; units in the names.

    A consistent filter passes all tests together (three of NEES at all judged epochs, one of NIS for each sensor) with at least
    ``probability`` (Bonferroni); the bounds reported are those, and so a little wider than those of one test alone.

    Parameters
    ----------
    statistics : Statistics
        Of a filter to be tested.
    epochs : array of int, optional
        Indices of the epochs judged. Default: 20 evenly spaced ones.
    probability : float, default 0.99
        Probability that a consistent filter passes all tests together.

    Returns
    -------
    dict
        Plain values for JSON.
    """
    chosen = judged_epochs(len(statistics.time) - 1) if epochs is None else epochs
    seen = [i for i in range(len(statistics.sensors)) if statistics.sensor_degrees[i].sum() > 0]
    single = 1.0 - (1.0 - probability) / (len(statistics.subsets) + len(seen))
    nees = {}
    for subset in statistics.subsets:
        verdict = statistics.verdict(chosen, subset, single)
        nees[subset] = {
            "anees": _number(verdict.mean.mean()),
            "least": _number(verdict.mean.min()),
            "greatest": _number(verdict.mean.max()),
            "bounds": list(verdict.simultaneous_bounds),
            "epochs_outside": verdict.outside,
            "consistent": verdict.consistent,
        }
    nis = []
    for i in seen:
        low, high = consistency.mean_bounds(1, int(statistics.sensor_degrees[i].sum()), single)
        value = float(statistics.sensor_nis[i])
        nis.append(
            {
                "sensor": statistics.sensors[i],
                "nis": _number(value),
                "bounds": [low, high],
                "degrees_of_freedom": int(statistics.sensor_degrees[i].sum()),
                "refused": int(statistics.sensor_refused[i].sum()),
                "consistent": bool(low <= value <= high),
            }
        )
    return {
        "runs": statistics.runs,
        "failed_runs": statistics.failed,
        "probability": probability,
        "epochs_judged": len(chosen),
        "nees": nees,
        "nis": nis,
        "coverage": {"expected": list(COVERED), **_coverage(statistics, chosen)},
        "last_epoch": _last_epoch(statistics),
        "worst_runs": [
            {"run": int(run), "largest_nees": _number(score)}
            for run, score in zip(statistics.worst_run, statistics.worst_score, strict=True)
        ],
        "consistent": bool(
            statistics.failed == 0
            and all(part["consistent"] for part in nees.values())
            and all(part["consistent"] for part in nis)
        ),
    }


def _coverage(statistics: Statistics, epochs: Counts) -> dict[str, list[float | None]]:
    """Return the share of errors inside 1, 2, 3 σ over the axes and the judged epochs."""
    covered = statistics.covered[epochs]
    return {
        name: [_number(x) for x in covered[:, rows].mean(axis=(0, 1))]
        for name, rows in (("attitude", slice(0, 3)), ("bias", slice(3, 6)))
    }


def _last_epoch(statistics: Statistics) -> dict[str, Any]:
    """Return the errors at the end: mean, root mean square, what the filter says, quantiles of the absolute error by axis."""
    result: dict[str, Any] = {"time_s": float(statistics.time[-1])}
    for name, rows, unit, factor in (
        ("attitude", slice(0, 3), "arcsec", units.ARCSECOND),
        ("bias", slice(3, 6), "deg_per_hour", units.DEGREE_PER_HOUR),
    ):
        for what in ("mean_error", "rms_error", "sigma"):
            values = getattr(statistics, what)[-1, rows] / factor
            result[f"{name}_{what}_{unit}"] = [_number(x) for x in values]
        for q in QUANTILES:
            values = statistics.error_quantile(q)[-1, rows] / factor
            result[f"{name}_error_quantile_{q:g}_{unit}"] = [_number(x) for x in values]
    return result


def _number(value: Any) -> float | None:
    """Return a float, None where it is not finite: JSON has no word for that."""
    return float(value) if np.isfinite(value) else None
