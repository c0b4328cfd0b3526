"""The page of a coning study: the drift of each integration algorithm, and the same filter with each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import InputError
from strapdown.consistency.judgement import VERDICTS
from strapdown.files import reading
from strapdown.montecarlo import coning_study
from strapdown.report import page

_DRIFT = {"measured": "drift_deg_per_hour", "predicted": "predicted_deg_per_hour"}
_CONSISTENCY = {"ANEES of the attitude": "anees_attitude", "ANEES of the bias": "anees_bias", "NIS": "nis"}
_BIAS = {"RMS error of the bias": "bias_rms_deg_per_hour", "σ of the filter": "bias_sigma_deg_per_hour"}


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
    *own_tables, drift_table, filter_table = coning_study.tables(study)
    size = lambda x: None if x is None or abs(x) <= coning_study.ROUNDING else abs(x)  # noqa: E731
    sizes = [row | {key: size(row[key]) for key in _DRIFT.values()} for row in drifts]
    answer = max((row["verdict"] for row in filters), key=VERDICTS.index)
    names = {verdict: [row["integration"] for row in filters if row["verdict"] == verdict] for verdict in VERDICTS}
    reason = "; ".join(
        f"{verdict} with {', '.join(names[verdict])}" for verdict in reversed(VERDICTS) if names[verdict]
    )
    content = page.page(
        "Coning study",
        coning_study.words(study),
        page.verdict(answer, reason),
        *map(page.listed, own_tables),
        _chart("Drift about the cone's axis", "|drift|, °/h", "algorithm", sizes, _DRIFT),
        page.listed(drift_table),
        _chart(
            "NEES and NIS: 1 for a consistent filter", "per degree of freedom", "integration", filters, _CONSISTENCY
        ),
        _chart("Bias error", "°/h", "integration", filters, _BIAS),
        page.listed(filter_table),
        page.stored_figure(path.with_name("errors"), "Errors about the cone's axis with the filter's ±3σ"),
        page.section("Provenance", page.provenance({**scenario, "source": path.name})),
    )
    return content, {"source": path.name, "judgement": {"verdict": answer, "reason": reason}, "study": study}


def _chart(title: str, unit: str, name: str, rows: list[dict[str, Any]], lines: dict[str, str]) -> str:
    """Return a chart of lines (key of the rows by label) over the algorithms, whose key is ``name``."""
    values = [np.array([row[key] for row in rows], float) for key in lines.values()]  # NaN for None
    names, places = [row[name] for row in rows], np.arange(float(len(rows)))
    return page.chart(title, unit, places, page.lines(list(lines), values), x="algorithm", ticks=names, log=True)
