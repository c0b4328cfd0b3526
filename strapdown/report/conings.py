"""The page of a coning study: tables and figures of the drift of each integration algorithm, and of the same filter with each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from strapdown.checks import InputError
from strapdown.files import reading
from strapdown.montecarlo import coning_study
from strapdown.report import findings, page

_FIGURES = {
    "drift": "Drift about the cone's axis",
    "errors": "Errors about the cone's axis with the filter's ±3σ",
    "consistency": "NEES of attitude and bias, and NIS: 1 for a consistent filter",
}
"""Figures that `strapdown coning` writes beside its JSON."""


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
    scenario, filters = study["scenario"], study["filter"]
    drift_table, filter_table = coning_study.tables(study)
    passing = [one["integration"] for one in filters if one["consistent"]]
    answer = "consistent" if len(passing) == len(filters) else "not consistent"
    reason = f"{len(passing)} of {len(filters)} algorithms give a consistent filter: {', '.join(passing) or 'none'}"
    content = page.page(
        "Coning study",
        f"cone of {scenario['angle_deg']:g}° at {scenario['frequency_hz']:g} Hz, gyro at {scenario['rate_hz']:g} Hz; "
        f"{scenario['runs']} runs of {scenario['duration_s']:g} s, seed {scenario['seed']}",
        page.verdict(answer, reason),
        findings.listed(drift_table),
        findings.listed(filter_table),
        *(page.stored_figure(path.with_name(name), caption) for name, caption in _FIGURES.items()),
        page.section("Provenance", page.provenance({**scenario, "source": path.name})),
    )
    return content, {"source": path.name, "judgement": {"verdict": answer, "reason": reason}, "study": study}
