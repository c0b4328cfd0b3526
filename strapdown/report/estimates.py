"""The page of one estimate, with or without truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import consistency, quaternion, records, workflows
from strapdown.estimation import setup
from strapdown.plots import style
from strapdown.plots.estimates import StateError, angle_labels, roll_pitch_yaw, state_errors
from strapdown.records import Estimate, Innovations, Truth
from strapdown.report import page
from strapdown.units import DEGREE, rate_unit

REACH = 5.0
"""Range of the distribution of whitened innovations, ±σ; those beyond it are in the outermost bins."""
WINDOW = 50
"""Number of measurements of the moving average of the NIS."""


def report(path: Path) -> tuple[str, dict[str, Any]]:
    """Return the page and the statistics for an estimate file."""
    attributes = records.read_attributes(path)
    estimate = setup.read_estimate(path)
    judgement = workflows.check(estimate)
    estimate = estimate.taken(estimate.known)
    truth = estimate.truth
    states = [] if truth is None else state_errors(estimate, truth)
    charts = _error_charts(estimate, states) or _estimate_charts(estimate)
    table = workflows.accuracy(estimate) if states else None
    source = "" if estimate.origin is None else estimate.origin.source
    content = page.page(
        f"Estimate of {source}" if source else f"Estimate {path.name}",
        f"{path.name}: {estimate.extent}; strapdown {attributes.get('version', '')}",
        page.judged(judgement),
        page.listed(estimate.listing()),
        *([] if table is None else [page.listed(table.listing())]),
        *([page.section("Evidence", page.table(judgement.listing()))] if judgement.findings else []),
        page.section("Over time", page.beside_body(charts, estimate.time, estimate.attitude)),
        *[_sensor(name, innovations) for name, innovations in estimate.innovations.items()],
        *_distribution(estimate, truth),
        page.section(
            "Provenance",
            page.provenance(attributes),
            page.paragraph("To repeat the tests:"),
            page.code(f"strapdown check {path.name}\nstrapdown report {path.name}"),
        ),
    )
    return content, {
        "source": path.name,
        "judgement": judgement.summary(),
        "accuracy": None if table is None else table.summary(),
    }


def _error_charts(estimate: Estimate, states: Sequence[StateError]) -> list[str]:
    """Return a chart of each error with the filter's ±3σ if there is a covariance."""
    charts = []
    for k, (what, axis, unit, error, sigma) in enumerate(states):
        title, bound = f"{what} error {axis}", 3.0 * sigma
        series = [page.Series(label=title, value=error, colour=page.COLOURS[k % 3])]
        if np.isfinite(bound).any():  # an estimate of another program may have no covariance
            series = page.band(-bound, bound, ("+3σ (99.7 %)", "−3σ")) + series
        reach = style.reach(error, bound)
        charts.append(page.chart(title.capitalize(), f"{title}, {unit}", estimate.time, series, reach=reach))
    return charts


def _estimate_charts(estimate: Estimate) -> list[str]:
    """Return charts of the Euler angles, the bias, and the σ of the attitude, as far as the estimate has them."""
    time, sigma = estimate.time, estimate.sigma
    angles = page.lines(angle_labels(estimate.fixed_frame), roll_pitch_yaw(estimate.attitude).T, wraps=True)
    charts = [page.chart("Attitude, Euler angles Z-Y-X", "angle, °", time, angles)]
    if estimate.has_bias:
        unit, size = rate_unit(style.settled(3.0 * sigma[:, 3:]))
        charts.append(
            page.chart("Gyro bias", f"gyro bias, {unit}", time, page.lines(style.AXES, estimate.bias.T / size))
        )
    if estimate.has_covariance:
        spread = np.linalg.norm(sigma[:, :3], axis=1) / DEGREE
        line = page.lines(["σ, root sum square of the three axes"], [spread])
        charts.append(page.chart("Attitude σ", "attitude σ, °", time, line))
    return charts


def _sensor(name: str, innovations: Innovations) -> str:
    """Return charts of the whitened innovations of a sensor: distribution, autocorrelation, and NIS over time."""
    title, number = f"Innovations of {name}", len(innovations.time)
    if number < 8:
        return page.section(title, page.paragraph(f"{number} measurements are too few to draw."))
    white = innovations.whitened
    bins = int(np.clip(np.sqrt(white.size), 12, 80))
    density, edges = np.histogram(np.clip(white, -REACH, REACH), bins, (-REACH, REACH), density=True)
    at = 0.5 * (edges[1:] + edges[:-1])
    shape = [
        page.Series(label="innovations", value=density),
        page.Series(
            label="standard normal", value=np.exp(-0.5 * at**2) / np.sqrt(2.0 * np.pi), colour="--b", dash=True
        ),
    ]
    correlation = consistency.autocorrelation(white)
    lags = page.band(-correlation.bounds, correlation.bounds, ("99 % bounds, all lags", "lower bound"))
    lags += page.lines(style.AXES if correlation.values.shape[1] > 1 else ["innovations"], correlation.values.T)
    nis, (low, high) = innovations.nis / white.shape[1], consistency.mean_bounds(white.shape[1], 1)
    curves = [np.maximum(nis, 1e-4)]
    if number >= 2 * WINDOW:
        mean, first = np.full(number, np.nan), WINDOW // 2
        mean[first : first + number - WINDOW + 1] = np.convolve(nis, np.full(WINDOW, 1.0 / WINDOW), mode="valid")
        curves.append(mean)
    course = page.band(low, high, ("99 % bounds, each", "lower bound"))
    course += page.lines(["one measurement", f"mean of {WINDOW}"], curves)
    return page.section(
        title,
        page.chart("Innovations over their σ", "density", at, shape, x="innovation over its σ"),
        page.chart("Autocorrelation", "autocorrelation", correlation.lags, lags, x="lag, measurements"),
        page.chart("NIS over time", "NIS per degree of freedom", innovations.time, course, log=True),
    )


def _distribution(estimate: Estimate, truth: Truth | None) -> list[str]:
    """Return a chart of the cumulative distribution of the total attitude error over time; none without a truth."""
    if truth is None or not (known := truth.known).any():
        return []
    angle = np.sort(quaternion.angle_between(estimate.attitude[known], truth.attitude[known])) / DEGREE
    share = 100.0 * np.arange(1, len(angle) + 1) / len(angle)
    line = page.Series(label="fraction of the time with at most this error", value=share)
    title = f"Total attitude error: median {np.median(angle):.3g}°, 95 % of the time at most {np.quantile(angle, 0.95):.3g}°"
    return [
        page.section("Attitude", page.chart(title, "fraction of the time, %", angle, [line], x="attitude error, °"))
    ]
