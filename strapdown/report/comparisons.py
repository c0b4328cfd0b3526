"""The page of two estimates of the same motion: overlay and difference."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, InputError, are_finite
from strapdown.estimation import setup
from strapdown.plots.estimates import angle_labels, roll_pitch_yaw
from strapdown.plots.style import AXES, reach, settled
from strapdown.records import Estimate
from strapdown.records.recording import interpolated
from strapdown.report import page
from strapdown.results import Table
from strapdown.units import DEGREE, angle_unit, rate_unit


def report(first: Path, second: Path) -> tuple[str, dict[str, Any]]:
    """Return the page and the statistics for two estimate files; the second is interpolated at the times of the first."""
    a, b = setup.read_estimate(first), setup.read_estimate(second)
    names = (first.name, second.name) if first.name != second.name else (str(first), str(second))
    inside = (a.time >= b.time[0]) & (a.time <= b.time[-1])
    if not inside.any():
        spans = " and ".join(
            f"{of} covers {estimate.time[0]:g} to {estimate.time[-1]:g} s" for of, estimate in ((first, a), (second, b))
        )
        raise InputError(f"{spans}; give estimates of the same time")
    time = a.time[inside]
    attitude, sigma, bias = a.attitude[inside], a.sigma[inside], a.bias[inside]
    other, other_sigma, other_bias = _at(b, time)
    difference = quaternion.rotation_between(attitude, other)
    angle = np.linalg.norm(difference, axis=1)
    statistics = {
        "sources": list(names),
        "epochs": len(time),
        "attitude_difference_rms_rad": float(np.sqrt(np.mean(angle**2))),
        "attitude_difference_maximum_rad": float(angle.max()),
        "attitude_difference_rms_by_axis_rad": np.sqrt(np.mean(difference**2, axis=0)).tolist(),
        "judgement": {"verdict": f"RMS difference of attitude {np.sqrt(np.mean(angle**2)) / DEGREE:.4g}°"},
    }
    charts = _angles(time, (attitude, other), names, a.fixed_frame)
    charts += _differences("Attitude", time, difference, (sigma[:, :3], other_sigma[:, :3]), names, angle_unit)
    if a.has_bias and b.has_bias:
        change = other_bias - bias
        charts += _differences("Gyro bias", time, change, (sigma[:, 3:], other_sigma[:, 3:]), names, rate_unit)
        statistics["bias_difference_rms_by_axis_rad_per_s"] = np.sqrt(np.mean(change**2, axis=0)).tolist()
    if a.truth is not None:
        charts += _errors(time, a.truth.attitude[inside], (attitude, other), names)
    frames = [estimate.fixed_frame or "the scenario's" for estimate in (a, b)]
    differ = f"; fixed frames: {' and '.join(frames)}" if frames[0] != frames[1] else ""
    content = page.page(
        f"Two estimates: {names[0]}, {names[1]}",
        f"{len(time)} epochs from {time[0]:g} to {time[-1]:g} s; the second is interpolated at the times of the first{differ}",
        page.section("Key numbers", _numbers(difference, angle, (sigma, other_sigma), names)),
        page.section("Over time", page.beside_body(charts, time, attitude)),
    )
    return content, statistics


def _at(estimate: Estimate, time: Array) -> tuple[Array, Array, Array]:
    """Return attitude, σ and bias of an estimate at times within its own; the attitude by rotation at constant rate between two epochs."""
    k = np.clip(np.searchsorted(estimate.time, time, side="right") - 1, 0, len(estimate.time) - 2)
    share = (time - estimate.time[k]) / (estimate.time[k + 1] - estimate.time[k])
    between = lambda rows: rows[k] + share[:, None] * (rows[k + 1] - rows[k])  # noqa: E731
    attitude = interpolated(time, estimate.time, estimate.attitude, np.inf)
    return attitude, between(estimate.sigma), between(estimate.bias)


def _angles(time: Array, attitudes: tuple[Array, Array], names: tuple[str, str], fixed_frame: str) -> list[str]:
    angles = zip(*(roll_pitch_yaw(q).T for q in attitudes), strict=True)
    return [
        page.chart(label, "angle, °", time, _both(names, pair, wraps=True))
        for label, pair in zip(angle_labels(fixed_frame), angles, strict=True)
    ]


def _both(names: Sequence[str], values: Iterable[Array], **look: Any) -> list[page.Series]:
    """Return a line of each estimate, the second dashed, as it may cover the first."""
    first, second = page.lines(names, values, **look)
    return [first, dataclasses.replace(second, dash=True)]


def _differences(
    what: str,
    time: Array,
    difference: Array,
    sigmas: tuple[Array, Array],
    names: tuple[str, str],
    unit_of: Callable[[Array], tuple[str, float]],
) -> list[str]:
    """Return a chart of each axis of a difference, with ±3σ of the first estimate as a band and of the second as lines."""
    unit, size = unit_of(settled(3.0 * np.maximum(*sigmas)))
    charts = []
    for k, axis in enumerate(AXES):
        first, second = (3.0 * sigma[:, k] / size for sigma in sigmas)
        series = page.band(-first, first, (f"+3σ of {names[0]}", "−3σ"))
        series += page.band(-second, second, (f"+3σ of {names[1]}", "−3σ "), colour="--b", dash=True)
        series.append(page.Series(label="difference, second minus first", value=difference[:, k] / size))
        title, label = f"{what} {axis}, difference", f"{what.lower()} {axis}, {unit}"
        charts.append(page.chart(title, label, time, series, reach=reach(*(line.value for line in series))))
    return charts


def _errors(time: Array, truth: Array, attitudes: tuple[Array, Array], names: tuple[str, str]) -> list[str]:
    known = are_finite(truth)  # a reference may have gaps
    errors = np.full((2, len(truth)), np.nan)
    for error, attitude in zip(errors, attitudes, strict=True):
        error[known] = quaternion.angle_between(attitude[known], truth[known]) / DEGREE
    return [page.chart("Total attitude error relative to the truth", "error, °", time, _both(names, errors))]


def _numbers(difference: Array, angle: Array, sigmas: tuple[Array, Array], names: tuple[str, str]) -> str:
    unit, size = angle_unit(np.sqrt(np.mean(difference**2, axis=0)))
    rms = lambda x: np.sqrt(np.mean(x**2)) / size  # noqa: E731
    named = [(axis, difference[:, k], [sigma[:, k] for sigma in sigmas]) for k, axis in enumerate(AXES)]
    named.append(("total", angle, [np.linalg.norm(sigma[:, :3], axis=1) for sigma in sigmas]))
    rows = [
        (f"{name}, {unit}", rms(value), np.abs(value).max() / size, *map(rms, spreads))
        for name, value, spreads in named
    ]
    head = ("attitude", "RMS difference", "largest", *(f"σ of {name}" for name in names))
    return page.table(Table("", head, rows))
