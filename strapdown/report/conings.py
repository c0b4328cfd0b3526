"""The page of a coning study: the drift of each integration algorithm, and the same filter with each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import InputError
from strapdown.files import reading
from strapdown.montecarlo import coning_study
from strapdown.report import page


def report(path: Path) -> tuple[str, dict[str, Any]]:
    """Return the page and the statistics for the JSON of a coning study."""
    study = reading.json_file(path)
    try:
        return _page(path, study)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {error} does not fit a coning study; give the coning.json that `strapdown coning` writes"
        ) from None


def _page(path: Path, study: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    scenario, drifts, filters = study["scenario"], study["integration"], study["filter"]
    drift_table, filter_table = coning_study.tables(study)
    passing = [one["integration"] for one in filters if one["consistent"]]
    answer = "consistent" if len(passing) == len(filters) else "not consistent"
    reason = f"{len(passing)} of {len(filters)} algorithms give a consistent filter: {', '.join(passing) or 'none'}"
    content = page.page(
        "Coning study",
        f"cone of {scenario['angle_deg']:g}° at {scenario['frequency_hz']:g} Hz, gyro at {scenario['rate_hz']:g} Hz; "
        f"{scenario['runs']} runs of {scenario['duration_s']:g} s, seed {scenario['seed']}",
        page.verdict(answer, reason),
        _drift_chart(drifts),
        page.listed(drift_table),
        *_filter_charts(filters),
        page.listed(filter_table),
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
        page.Series(label="measured", value=np.where(measured > coning_study.ROUNDING, measured, np.nan)),
        page.Series(
            label="predicted", value=np.where(predicted > coning_study.ROUNDING, predicted, np.nan), colour="--b"
        ),
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
