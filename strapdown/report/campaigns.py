"""The page of a Monte Carlo, complete or not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from strapdown import consistency, plots, records, workflows
from strapdown.checks import Array, Hint, InputError
from strapdown.files import plain
from strapdown.montecarlo import campaign, verdicts
from strapdown.montecarlo.statistics import SUBSETS, Statistics
from strapdown.plots.statistics import STATES, state_unit
from strapdown.report import page
from strapdown.results import Table


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
    ending = "σ-coverage by state, and the covariance of the errors and of the filter"
    parts = [page.paragraph(f"{table.title}:") + "\n" + page.table(table) for table in verdicts.tables(numbers)]
    name = held.plan.scenario.name or "a scenario"
    shown = {k: v for k, v in attributes.items() if k not in ("plan", "conventions") and v != ""}
    content = page.page(
        f"Monte Carlo: {name}",
        f"{held.extent}, {len(statistics.time) - 1} epochs; strapdown {held.identity.version}",
        page.judged(judgement),
        page.section("Evidence", page.table(judgement.listing())),
        page.section("Key numbers", *parts),
        page.section("Over time", *_over_time(statistics, judgement)),
        page.section("At the end", page.figure(lambda: _end(statistics), ending)),
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
    return STATES if statistics.has_bias else STATES[:3]


def _over_time(statistics: Statistics, judgement: consistency.Judgement) -> list[str]:
    """Return charts of ANEES and NIS with their bounds, and of the quantiles of the errors with those that the filter predicts."""
    charts = []
    for finding in judgement.findings:
        if finding.name == "ANEES" and finding.of in ("attitude", "bias"):
            lines = (page.Series(label="ANEES, all runs", value=statistics.anees[:, SUBSETS[finding.of][0]]),)
            charts.append(_bounded(f"ANEES of the {finding.of}", statistics.time, lines, (finding.low, finding.high)))
    known = statistics.nis_degrees > 0
    if known.any():
        samples = round(float(np.median(statistics.nis_degrees[known]) * statistics.runs))
        lines = (page.Series(label="NIS, all runs", value=np.where(known, statistics.nis, np.nan), colour="--b"),)
        bounds = consistency.mean_bounds(1, samples)
        charts.append(_bounded("NIS in each interval", statistics.nis_time, lines, bounds))
    settled = slice(len(statistics.time) // 20, None)
    for k, name in enumerate(_estimated(statistics)):
        sigma = statistics.sigma[:, k]
        unit, size = state_unit(k, 3.0 * statistics.sigma[settled, k // 3 * 3 : k // 3 * 3 + 3])
        quantiles, predicted = [], []
        for share, factor, colour in ((0.99, 2.5758, "--a"), (0.5, 0.6745, "--c")):
            words, value = f"{100 * share:g} %", statistics.error_quantile(share)[:, k] / size
            quantiles.append(page.Series(label=f"{words} of the runs", value=value, colour=colour))
            value = factor * sigma / size
            predicted.append(page.Series(label=f"{words} by the filter", value=value, colour=colour, dash=True))
        title = f"|{name} error|: quantiles of the runs, and those predicted by the filter"
        courses = [*quantiles, *predicted]
        least, largest = (each([each(line.value) for line in courses]) for each in (np.min, np.max))
        log = bool(20.0 * least < largest < 1000.0 * least)  # beyond, the 16 bits of the chart would show as steps
        charts.append(page.chart(title, f"|{name} error|, {unit}", statistics.time, courses, log=log))
    return charts


def _bounded(title: str, time: Array, lines: tuple[page.Series, ...], bounds: tuple[float, float]) -> str:
    """Return a chart of a statistic per degree of freedom with the bounds of a consistent filter."""
    band = page.band(np.full(len(time), bounds[0]), np.full(len(time), bounds[1]))
    log = bool(max(np.nanmax(line.value) for line in lines) > 4.0)
    return page.chart(title, "per degree of freedom", time, (*band, *lines), log=log)


def _end(statistics: Statistics) -> Figure:
    figure, axes = plots.new_figure(1, 3, size=(13.0, 4.4))
    plots.coverage_by_state(statistics, -1, axes[0])
    # The bias axis with the largest ratio between actual and filter variance, with the attitude about it.
    ratio = np.diag(statistics.mean_square_error[-1]) / np.diag(statistics.covariance[-1])
    worst = int(np.argmax(np.abs(np.log(np.maximum(ratio[3:], 1e-300)))))
    for ax, pair in zip(axes[1:], ((0, 1), (worst, 3 + worst) if statistics.has_bias else (0, 2)), strict=True):
        plots.covariance_ellipses(statistics.covariance[-1], statistics.mean_square_error[-1], pair, ax)
    return figure


def _worst(statistics: Statistics, path: Path) -> str:
    rows = list(zip(statistics.worst_run, statistics.worst_score, strict=True))
    head = ("run", "maximum NEES of the state (6 degrees of freedom)")
    return page.section(
        "Worst runs",
        page.table(Table("", head, rows, left=0)),
        page.paragraph("A run can be repeated by its number, bit for bit, with its record and estimate:"),
        page.code(f'run = sd.montecarlo.replay(sd.read("{path.name}").plan, {int(statistics.worst_run[0])})'),
    )
