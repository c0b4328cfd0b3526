"""The page of a coning study: the drift of each integration algorithm, and the same filter with each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import InputError
from strapdown.files import reading
from strapdown.report import page


def report(path: Path, probability: float) -> tuple[str, dict[str, Any]]:
    """Return the page and the statistics for the JSON of a coning study; the bounds are those of the study, not of ``probability``."""
    study = reading.json_file(path)
    try:
        return _page(path, study)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {error} does not fit a coning study; give the coning.json that `strapdown coning` writes"
        ) from None


def _page(path: Path, study: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    scenario, drifts, filters = study["scenario"], study["integration"], study["filter"]
    passing = [one["integration"] for one in filters if one["consistent"]]
    answer = "consistent" if len(passing) == len(filters) else "not consistent"
    reason = f"{len(passing)} of {len(filters)} algorithms give a consistent filter: {', '.join(passing) or 'none'}"
    content = page.page(
        "Coning study",
        f"cone of {scenario['angle_deg']:g}° at {scenario['frequency_hz']:g} Hz, gyro at {scenario['rate_hz']:g} Hz; "
        f"{scenario['runs']} runs of {scenario['duration_s']:g} s, seed {scenario['seed']}",
        page.verdict(answer, reason),
        page.section("Drift of the integration", _drift_chart(drifts), _drift_table(drifts)),
        page.section("The same filter with each algorithm", *_filter_charts(filters), _filter_table(filters)),
        page.stored_figure(path.with_name("errors"), "Errors about the cone's axis with the filter's ±3σ"),
        page.section("Provenance", page.provenance({**scenario, "source": path.name})),
    )
    return content, {"source": path.name, "judgement": {"verdict": answer, "reason": reason}, "study": study}


def _values(rows: list[dict[str, Any]], key: str) -> np.ndarray:
    return np.array([np.nan if row[key] is None else float(row[key]) for row in rows])


def _drift_chart(drifts: list[dict[str, Any]]) -> str:
    measured = np.abs(_values(drifts, "drift_deg_per_hour"))
    predicted = np.abs(_values(drifts, "predicted_deg_per_hour"))
    series = [
        page.Series(label="measured", value=np.where(measured > ROUNDING, measured, np.nan)),
        page.Series(label="predicted", value=np.where(predicted > ROUNDING, predicted, np.nan), colour="--b"),
    ]
    names = [row["algorithm"] for row in drifts]
    return page.chart(
        "Drift about the cone's axis",
        "|drift|, °/h",
        np.linspace(0.0, len(names) - 1.0, len(names)),
        series,
        ticks=names,
        log=True,
    )


ROUNDING = 1e-6
"""Drifts below this are rounding errors of the simulation, °/h, and are not drawn."""


def _drift_table(drifts: list[dict[str, Any]]) -> str:
    shown = lambda value: "rounding" if abs(value) < ROUNDING else page.number(value)  # noqa: E731
    rows = [
        (row["algorithm"], row["samples"], shown(measured), "" if np.isnan(predicted) else shown(predicted))
        for row, measured, predicted in zip(
            drifts, _values(drifts, "drift_deg_per_hour"), _values(drifts, "predicted_deg_per_hour"), strict=True
        )
    ]
    return page.table(("algorithm", "samples", "measured, °/h", "predicted, °/h"), rows, numbers=3)


def _filter_charts(filters: list[dict[str, Any]]) -> list[str]:
    names, place = [row["integration"] for row in filters], np.linspace(0.0, len(filters) - 1.0, len(filters))
    anees = [
        page.Series(label=f"ANEES of the {part}", value=_values(filters, f"anees_{part}"), colour=colour)
        for part, colour in (("attitude", "--a"), ("bias", "--b"))
    ]
    anees.append(page.Series(label="NIS", value=_values(filters, "nis"), colour="--c"))
    errors = [
        page.Series(label="RMS error of the bias", value=_values(filters, "bias_rms_deg_per_hour"), colour="--b"),
        page.Series(label="σ of the filter", value=_values(filters, "bias_sigma_deg_per_hour"), colour="--faint"),
    ]
    return [
        page.chart(
            "NEES and NIS: 1 for a consistent filter",
            "per degree of freedom",
            place,
            anees,
            x="algorithm",
            ticks=names,
            log=True,
        ),
        page.chart("Bias error", "°/h", place, errors, x="algorithm", ticks=names, log=True),
    ]


def _filter_table(filters: list[dict[str, Any]]) -> str:
    rows = [
        (
            "pass" if row["consistent"] else "fail",
            row["integration"],
            *(page.number(row[key]) for key in ("attitude_rms_arcsec", "attitude_sigma_arcsec")),
            *(page.number(row[key]) for key in ("bias_rms_deg_per_hour", "bias_sigma_deg_per_hour")),
            page.number(row["bias_mean_deg_per_hour"][2]),
            *(page.number(row[key]) for key in ("anees_attitude", "anees_bias", "nis")),
        )
        for row in filters
    ]
    head = (
        "",
        "integration",
        "attitude RMS, arcsec",
        "σ",
        "bias RMS, °/h",
        "σ",
        "mean z, °/h",
        "ANEES attitude",
        "ANEES bias",
        "NIS",
    )
    return page.table(head, rows, numbers=8, marked=[row[0] for row in rows])
