"""The page of a tuning: the verdict, tables and words that `strapdown tune` wrote to its JSON, with its figures and its filter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from strapdown.checks import InputError, one_of
from strapdown.files import reading
from strapdown.report import findings, page
from strapdown.results import Table
from strapdown.tuning.fitting import VERDICTS

_FIGURES = {
    "likelihood": "Likelihood along each parameter, with its interval",
    "heldout": "Statistics on the held-out data, before and after tuning",
}


def report(path: Path, confidence_level: float) -> tuple[str, dict[str, Any]]:
    """Return the page and the statistics for the JSON of a tuning; ``confidence_level`` is not used, since the verdict is in the JSON."""
    content, tables = read(path)
    shown, toml = content["report"], path.with_suffix(".toml")
    parts = [
        page.verdict(shown["verdict"], shown["reason"], shown["details"]),
        *map(findings.listed, tables),
        *map(page.paragraph, shown["words"]),
    ]
    for name, caption in list(_FIGURES.items())[: len(tables)]:
        parts.append(page.stored_figure(path.with_name(f"{path.stem}-{name}"), caption))
    making = [page.provenance({"records": ", ".join(content["records"]), "units of the JSON": content["units"]})]
    if toml.exists():
        making += [page.paragraph(f"The filter, {toml.name}:"), page.code(reading.text(toml, link=False))]
    making += [
        page.paragraph("To use it:"),
        page.code(f'estimate = sd.estimate(record, setup=sd.estimation.setup.read_setup("{toml.name}"))'),
    ]
    number = len(content["records"])
    subtitle = f"{number} record{'' if number == 1 else 's'}"
    html = page.page(f"Tuning: {path.name}", subtitle, *parts, page.section("Provenance", *making))
    return html, {
        "source": path.name,
        "judgement": {key: shown[key] for key in ("verdict", "reason")},
        "tuning": content,
    }


def read(path: Path) -> tuple[dict[str, Any], list[Table]]:
    """Read the JSON of a tuning, and its tables."""
    content = reading.json_file(path)
    try:
        shown = content["report"]
        one_of("report.verdict", shown["verdict"], VERDICTS)
        texts = [content["units"], *content["records"], shown["reason"], *shown["details"], *shown["words"]]
        tables = [Table(**one) for one in shown["tables"]]
        texts += [text for one in tables for row in ([one.title], one.columns, one.notes, *one.rows) for text in row]
        if not all(isinstance(text, str) for text in texts) or not all(isinstance(one.left, int) for one in tables):
            raise TypeError("what is no text")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {error} does not fit a tuning; give the JSON that `strapdown tune` writes beside its filter.toml"
        ) from None
    return content, tables
