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
    sizes = [{key: size(row[key]) for key in ("drift_deg_per_hour", "predicted_deg_per_hour")} for row in drifts]
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
        *_charts([row["algorithm"] for row in drifts], sizes, _DRIFT),
        page.listed(drift_table),
        *_charts([row["integration"] for row in filters], filters, _FILTER),
        page.listed(filter_table),
        page.stored_figure(path.with_name("errors"), "Errors about the cone's axis with the filter's ±3σ"),
        page.section("Provenance", page.provenance({**scenario, "source": path.name})),
    )
    return content, {"source": path.name, "judgement": {"verdict": answer, "reason": reason}, "study": study}


def _charts(names: list[str], rows: list[dict[str, Any]], charts: Any) -> list[str]:
    """Return a chart for each title and unit, of its series (label, key of the rows, colour) over the algorithms of these names."""
    places = np.linspace(0.0, len(names) - 1.0, len(names))
    html = []
    for (title, unit), lines in charts.items():
        values = {
            key: np.array([np.nan if row[key] is None else float(row[key]) for row in rows]) for _, key, _ in lines
        }
        series = [page.Series(label=label, value=values[key], colour=colour) for label, key, colour in lines]
        html.append(page.chart(title, unit, places, series, x="algorithm", ticks=names, log=True))
    return html


_DRIFT = {
    ("Drift about the cone's axis", "|drift|, °/h"): [
        ("measured", "drift_deg_per_hour", "--a"),
        ("predicted", "predicted_deg_per_hour", "--b"),
    ]
}
_FILTER = {
    ("NEES and NIS: 1 for a consistent filter", "per degree of freedom"): [
        ("ANEES of the attitude", "anees_attitude", "--a"),
        ("ANEES of the bias", "anees_bias", "--b"),
        ("NIS", "nis", "--c"),
    ],
    ("Bias error", "°/h"): [
        ("RMS error of the bias", "bias_rms_deg_per_hour", "--b"),
        ("σ of the filter", "bias_sigma_deg_per_hour", "--faint"),
    ],
}
