"""The page of a Monte Carlo, complete or not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import consistency, records, workflows
from strapdown.checks import Array, Hint, InputError
from strapdown.consistency.bounds import COVERED
from strapdown.consistency.judgement import state_name
from strapdown.files import plain
from strapdown.montecarlo import campaign, verdicts
from strapdown.montecarlo.statistics import SUBSETS, Statistics
from strapdown.plots.style import settled
from strapdown.report import page
from strapdown.results import Table, counted
from strapdown.units import angle_unit, rate_unit


def report(path: Path) -> tuple[str, dict[str, Any]]:
    """Return the page and the statistics for a campaign file."""
    attributes = records.read_attributes(path)
    held = campaign.read(path)
    statistics = held.statistics
    if statistics is None:
        raise InputError(f"{path} has no completed run yet; continue the campaign first, {Hint('resume', True)}")
    judgement = workflows.check(held)
    bound = verdicts.bound_of(held.plan)
    numbers = verdicts.summary(statistics, judgement=judgement, bound=bound)
    parts = [page.paragraph(f"{table.title}:") + "\n" + page.table(table) for table in verdicts.tables(numbers)]
    name = held.plan.scenario.name or "a scenario"
    shown = {k: v for k, v in attributes.items() if k not in ("plan", "conventions") and v != ""}
    content = page.page(
        f"Monte Carlo: {name}",
        f"{held.extent}, {counted(len(statistics.time) - 1, 'epoch')}; strapdown {held.identity.version}",
        page.judged(judgement),
        page.section("Evidence", page.table(judgement.listing())),
        page.section("Key numbers", *parts),
        page.section("Over time", *_over_time(statistics, judgement)),
        *([page.section("At the end", *_end(statistics))] if statistics.finite[-1] else []),
        _worst(statistics, path),
        page.section("Provenance", page.provenance(shown)),
    )
    estimated = len(_estimated(statistics))
    table = {
        "source": path.name,
        "judgement": judgement.summary(),
        "runs": statistics.runs,
        "failed_runs": statistics.failed,
        "time_s": statistics.time,
        "anees": {name: statistics.anees[:, SUBSETS[name][0]] for name in statistics.subsets},
        "rms_error_si": statistics.rms_error[:, :estimated],
        "sigma_si": statistics.sigma[:, :estimated],
        "nis_by_sensor": dict(zip(statistics.sensors, statistics.sensor_nis, strict=True)),
        "worst_runs": statistics.worst_run,
    }
    if bound is not None:
        table["rms_over_root_cramer_rao_bound"] = verdicts.efficiency(statistics, bound)[:, :estimated]
    return content, plain(table)


def _estimated(statistics: Statistics) -> tuple[str, ...]:
    """Return the names of the states that the filter estimates."""
    return tuple(map(state_name, range(6 if statistics.has_bias else 3)))


def _unit(state: int, value: Array) -> tuple[str, float]:
    """Return the unit in which an error of a state (0 to 5) of this magnitude is printed."""
    return angle_unit(value) if state < 3 else rate_unit(value)


def _over_time(statistics: Statistics, judgement: consistency.Judgement) -> list[str]:
    """Return charts of ANEES and NIS with their bounds, and of the quantiles of the errors with those that the filter predicts."""
    charts = [
        _bounded(
            f"ANEES of the {of}", statistics.time, statistics.anees[:, SUBSETS[of][0]], (finding.low, finding.high)
        )
        for finding in judgement.findings
        if finding.name == "ANEES" and (of := finding.of) in ("attitude", "bias")
    ]
    if statistics.sensor_degrees.any():
        bounds = statistics.nis_interval_bounds
        charts.append(_bounded("NIS in each interval", statistics.nis_time, statistics.nis, bounds))
    for k, name in enumerate(_estimated(statistics)):
        sigma = statistics.sigma[:, k]
        unit, size = _unit(k, settled(3.0 * statistics.sigma[:, k // 3 * 3 : k // 3 * 3 + 3]))
        quantiles, predicted = [], []
        for share, factor, colour in ((0.99, 2.5758, "--a"), (0.5, 0.6745, "--c")):
            words, value = f"{100 * share:g} %", statistics.error_quantile(share)[:, k] / size
            quantiles.append(page.Series(label=f"{words} of the runs", value=value, colour=colour))
            value = factor * sigma / size
            predicted.append(page.Series(label=f"{words} by the filter", value=value, colour=colour, dash=True))
        title = f"|{name} error|: quantiles of the runs, and those predicted by the filter"
        courses = [*quantiles, *predicted]
        least, largest = (each([line.value for line in courses]) for each in (np.min, np.max))
        log = bool(20.0 * least < largest < 1000.0 * least)  # beyond, the 16 bits of the chart would show as steps
        charts.append(page.chart(title, f"|{name} error|, {unit}", statistics.time, courses, log=log))
    return charts


def _bounded(title: str, time: Array, value: Array, bounds: tuple[float, float]) -> str:
    """Return a chart of a statistic per degree of freedom with the bounds of a consistent filter."""
    series = page.band(*bounds) + page.lines([f"{title.split(maxsplit=1)[0]}, all runs"], [value])
    return page.chart(title, "per degree of freedom", time, series, log=bool(np.nanmax(value) > 4.0))


def _end(statistics: Statistics) -> list[str]:
    """Return charts of the σ-coverage by state at the last epoch, and of the ellipses of the filter's and of the actual errors."""
    from scipy.stats import binom

    names, runs = _estimated(statistics), int(statistics.finite[-1])
    places, shares = np.arange(float(len(names))), []
    for k, expected in enumerate(COVERED):
        low, high = 100.0 * binom.ppf([0.005, 0.995], runs, expected) / runs
        shares += page.band(low, high, (f"99 % bounds, {k + 1}σ", "lower bound"))
        words = f"within {k + 1}σ, expected {100.0 * expected:.1f} %"
        covered = 100.0 * statistics.covered[-1, : len(names), k]
        shares.append(page.Series(label=words, value=covered, colour=page.COLOURS[k]))
    title = "σ-coverage by state, with the bounds of a consistent filter"
    charts = [page.chart(title, f"fraction of {counted(runs, 'run')}, %", places, shares, x="state", ticks=names)]
    claimed, actual = statistics.covariance[-1], statistics.mean_square_error[-1]
    # The bias axis with the largest ratio between actual and filter variance, with the attitude about it.
    ratio = np.diag(actual)[3:] / np.diag(claimed)[3:]
    worst = int(np.argmax(np.abs(np.log(np.maximum(ratio, 1e-300))))) if statistics.has_bias else 0
    for pair in ((0, 1), (worst, 3 + worst) if statistics.has_bias else (0, 2)):
        charts.append(_ellipses(names, claimed[np.ix_(pair, pair)], actual[np.ix_(pair, pair)], pair))
    return charts


def _ellipses(names: Sequence[str], claimed: Array, actual: Array, pair: tuple[int, int]) -> str:
    """Return a chart of the 95 % ellipses of the errors of two states: by the filter's covariance (2, 2), and of the actual errors."""
    largest = np.sqrt(np.maximum(np.diag(claimed), np.diag(actual)))
    alike = pair[0] // 3 == pair[1] // 3  # two angles, or two rates: the same unit
    (unit, size), (unit_up, size_up) = (
        _unit(state, 3.0 * (largest if alike else largest[[k]])) for k, state in enumerate(pair)
    )
    square = -2.0 * math.log(0.05)  # 95 % quantile of χ² with two degrees of freedom
    x = np.linspace(-1.0, 1.0, 401) * math.sqrt(square) * largest[0]

    def ends(P: Array) -> tuple[Array, Array]:
        """Return lower and upper end at each x of eᵀP⁻¹e = square, NaN beyond."""
        slope = P[0, 1] / P[0, 0]
        left = square - x**2 / P[0, 0]
        half = np.sqrt(np.where(left >= 0.0, left, np.nan) * max(P[1, 1] - slope * P[0, 1], 0.0))
        return (slope * x - half) / size_up, (slope * x + half) / size_up

    lines = page.band(*ends(claimed), ("filter", "its lower side"))
    lines += page.band(*ends(actual), ("actual errors", "their lower side"), colour="--b", dash=True)
    title = f"95 % ellipses: {names[pair[1]]} over {names[pair[0]]}"
    return page.chart(title, f"{names[pair[1]]} error, {unit_up}", x / size, lines, x=f"{names[pair[0]]} error, {unit}")


def _worst(statistics: Statistics, path: Path) -> str:
    rows = list(zip(statistics.worst_run, statistics.worst_score, strict=True))
    head = ("run", "maximum NEES of the state (6 degrees of freedom)")
    return page.section(
        "Worst runs",
        page.table(Table("", head, rows, left=0)),
        page.paragraph("A run can be repeated by its number, bit for bit, with its record and estimate:"),
        page.code(f'run = sd.montecarlo.replay(sd.read("{path.name}").plan, {int(statistics.worst_run[0])})'),
    )
