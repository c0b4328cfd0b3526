"""The verdict on the filter from the statistics of a campaign, as a table of numbers for a file or a screen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from strapdown import consistency, covariance, units
from strapdown.checks import Array, InputError
from strapdown.consistency import Judgement
from strapdown.consistency.bounds import COVERED
from strapdown.estimation.setup import MEKF, FilterSetup
from strapdown.files import plain
from strapdown.montecarlo.plan import Plan, initial_sigmas
from strapdown.montecarlo.statistics import Statistics
from strapdown.results import Column, Table, counted

QUANTILES = (0.5, 0.95, 0.997)
"""Quantiles of the last epoch's errors in the summary."""


def bound_of(plan: Plan) -> Array | None:
    """Return the Cramér–Rao bound (m, 6, 6) at a plan's epochs; None for the MEKF and where the bound does not hold.

    The bound of a matched MEKF is its own covariance. It holds for scenarios with white noise whose initial errors have no fixed part.
    """
    dispersions = plan.dispersions
    if plan.setup.estimator == MEKF or np.any(dispersions.attitude_error) or np.any(dispersions.bias_error):
        return None
    attitude_sigma, bias_sigma = initial_sigmas(dispersions, plan.setup)
    setup = replace(
        FilterSetup.for_scenario(plan.scenario, states=False), attitude_sigma=attitude_sigma, bias_sigma=bias_sigma
    )
    try:
        return covariance.analyse(plan.scenario, setup, epochs=plan.epochs).cramer_rao
    except InputError:
        return None


def efficiency(statistics: Statistics, bound: Array) -> Array:
    """Return the ratio of the RMS error to the root of the Cramér–Rao bound at each epoch and state (m, 6)."""
    return np.asarray(statistics.rms_error / np.sqrt(np.diagonal(bound, axis1=1, axis2=2)))


def summary(
    statistics: Statistics,
    *,
    judgement: Judgement | None = None,
    bound: Array | None = None,
) -> dict[str, Any]:
    """Return the verdict (:meth:`Statistics.judge`) and numbers: mean ANEES, coverage, errors, worst runs; units in the names.

    Parameters
    ----------
    statistics : Statistics
        Statistics of the filter to be tested.
    judgement : Judgement, optional
        Verdict, if known. Default: that of :meth:`Statistics.judge`.
    bound : ndarray (m, 6, 6), optional
        Cramér–Rao bound at the epochs (:attr:`strapdown.covariance.Analysis.cramer_rao`), with which the errors are compared.

    Returns
    -------
    dict
        Plain values for JSON.
    """
    rows = statistics.judged_epochs
    judgement = judgement or statistics.judge()
    covered = statistics.covered[rows]
    table = {
        "judgement": judgement.summary(),
        "runs": statistics.runs,
        "failed_runs": statistics.failed,
        "epochs_judged": len(rows),
        "anees": {subset: statistics.verdict(rows, subset).mean.mean() for subset in statistics.subsets},
        "refused": dict(zip(statistics.sensors, statistics.sensor_refused.sum(axis=1), strict=True)),
        "coverage": {
            "expected": list(COVERED),
            "attitude": covered[:, :3].mean(axis=(0, 1)),
            **({"bias": covered[:, 3:].mean(axis=(0, 1))} if statistics.has_bias else {}),
        },
        "last_epoch": _last_epoch(statistics),
        **({} if bound is None else {"rms_over_root_cramer_rao_bound": _efficiency(statistics, bound)}),
        "worst_runs": [
            {"run": int(run), "largest_nees": score}
            for run, score in zip(statistics.worst_run, statistics.worst_score, strict=True)
        ],
        "consistent": statistics.failed == 0 and judgement.verdict == "consistent",
    }
    return plain(table)  # type: ignore[no-any-return]


def tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return the errors at the end and the coverage of a :func:`summary` as tables; those of terminal, files and report."""
    return [_errors(summary), _coverage(summary)]


def _errors(summary: Mapping[str, Any]) -> Table:
    """Return the errors at the last epoch by axis."""
    last = summary["last_epoch"]
    sizes = ("mean_error", "rms_error", "sigma", *(f"error_quantile_{q:g}" for q in QUANTILES))
    labels = ("mean", "RMS", "filter's σ", *(f"{100.0 * q:g} %" for q in QUANTILES))
    rows = [
        (f"{what} {axis}", words, *(last[f"{what}_{key}_{unit}"][k] for key in sizes))
        for what, unit, words in (("attitude", "arcsec", "arcsec"), ("bias", "deg_per_hour", "°/h"))
        if what in summary["coverage"]  # not all filters estimate a bias
        for k, axis in enumerate("xyz")
    ]
    notes = []
    if (ratios := dict(summary.get("rms_over_root_cramer_rao_bound", {}))) and not summary["failed_runs"]:
        low, high = ratios.pop("bounds_of_an_efficient_filter")
        axes = "; ".join(f"{name} {', '.join(f'{x:.3f}' for x in values)}" for name, values in ratios.items())
        notes.append(
            f"RMS error divided by the root of the Cramér–Rao bound, by axis: {axes} (at one epoch {low:.3f} to {high:.3f} for an "
            "efficient filter)."
        )
    title = f"Errors at {last['time_s']:g} s, {counted(summary['runs'], 'run')}; quantiles of the absolute error"
    columns = (Column("", "state"), Column("unit", "unit"), *map(Column, labels, sizes))
    return Table(title, columns, rows, notes, left=2, name="errors")


def _coverage(summary: Mapping[str, Any]) -> Table:
    """Return the fraction of errors within kσ, with the worst runs."""
    percent = lambda share: "-" if share is None else f"{100.0 * share:.2f} %"  # noqa: E731
    rows = [(what, *shares) for what, shares in summary["coverage"].items()]
    worst = ", ".join(
        f"{part['run']} ({'failed' if part['largest_nees'] is None else format(part['largest_nees'], '.1f')})"
        for part in summary["worst_runs"][:5]
    )
    notes = [f"Worst runs, by maximum NEES of the state: {worst}."]
    if refused := ", ".join(f"{number} of {sensor}" for sensor, number in summary["refused"].items() if number):
        notes.append(f"The gate rejected {refused}.")
    if failed := summary["failed_runs"]:
        notes.append(f"In {counted(failed, 'run')} the filter failed: no finite error or covariance.")
    columns = (Column("of", "of"), *(Column(f"{k}σ", f"inside_{k}_sigma", shown=percent) for k in (1, 2, 3)))
    epochs, runs = counted(summary["epochs_judged"], "tested epoch"), counted(summary["runs"], "run")
    title = f"Fraction of the errors within kσ at the {epochs}, {runs}"
    return Table(title, columns, rows, notes, name="coverage")


def _efficiency(statistics: Statistics, bound: Array) -> dict[str, Any]:
    """Return the RMS over the judged epochs of the ratio of RMS error to the root of the bound, by axis, and its bounds at one epoch."""
    ratio = np.sqrt(np.mean(efficiency(statistics, bound)[statistics.judged_epochs] ** 2, axis=0))
    parts = {"attitude": ratio[:3], **({"bias": ratio[3:]} if statistics.has_bias else {})}
    return {**parts, "bounds_of_an_efficient_filter": np.sqrt(consistency.mean_bounds(1, statistics.runs))}


def _last_epoch(statistics: Statistics) -> dict[str, Any]:
    """Return the errors at the end: mean, root mean square, the filter's σ, quantiles of the absolute error by axis."""
    result: dict[str, Any] = {"time_s": float(statistics.time[-1])}
    for name, rows, unit, factor in (
        ("attitude", slice(0, 3), "arcsec", units.ARCSECOND),
        ("bias", slice(3, 6), "deg_per_hour", units.DEGREE_PER_HOUR),
    ):
        values = {what: getattr(statistics, what) for what in ("mean_error", "rms_error", "sigma")}
        values |= {f"error_quantile_{q:g}": statistics.error_quantile(q) for q in QUANTILES}
        result |= {f"{name}_{what}_{unit}": value[-1, rows] / factor for what, value in values.items()}
    return result
