"""Reports: one self-contained HTML page for a result file, with verdict, numbers, figures and provenance.

- ``page``: HTML, figures and interactive charts on one page without network access. The charts are drawn by uPlot (MIT licence), bundled in
  ``uplot/``.
- ``estimates``: The page of one estimate.
- ``campaigns``: The page of a Monte Carlo.
- ``tunings``: The page of a tuning.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from strapdown import records
from strapdown.checks import InputError
from strapdown.files import write_json, written_beside
from strapdown.files.reading import existing_file, from_file
from strapdown.report import campaigns, estimates, tunings

__all__ = [
    "write",
]

_WRITERS: dict[str, Callable[[Path, float], tuple[str, dict[str, Any]]]] = {
    "strapdown estimate": estimates.report,
    "strapdown montecarlo": campaigns.report,
    "strapdown tuning": tunings.report,
}


@dataclass(frozen=True, kw_only=True)
class Report:
    """A written report."""

    page: Path
    statistics: Path
    """The same statistics as JSON."""
    verdict: str


def write(
    result: str | os.PathLike[str], out: str | os.PathLike[str] | None = None, *, confidence_level: float = 0.99
) -> Report:
    """Write the report of a result file, and its statistics as JSON beside it, atomically.

    Parameters
    ----------
    result : path
        HDF5 file of an estimate or a Monte Carlo, or the JSON of a tuning.
    out : path, optional
        The page. Default: ``result`` with the suffix .html.
    confidence_level : float, default 0.99
        Minimum probability that no test rejects a consistent filter.

    Returns
    -------
    Report
        Paths of the page and of the statistics (``.report.json``), and the verdict in words.
    """
    source = Path(result)
    existing_file(source)
    target = source.with_suffix(".html") if out is None else Path(out)
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"out is {target}; give a file with the suffix .html")
    kind = "strapdown tuning" if source.suffix.lower() == ".json" else records.read_attributes(source)["kind"]
    if kind not in _WRITERS:
        known = ", ".join(name.removeprefix("strapdown ") for name in _WRITERS)
        raise InputError(f"{source} holds: {kind.removeprefix('strapdown ')}; reports are available for: {known}")
    with from_file(source):  # errors while drawing invalid numbers name the file
        content, statistics = _WRITERS[kind](source, confidence_level)
    beside = target.with_suffix(".report.json")  # not .json, which other commands write beside their results
    with written_beside(target) as temporary:
        temporary.write_text(content, encoding="utf-8", errors="backslashreplace")  # a name may not be UTF-8
    write_json(beside, statistics)
    return Report(page=target, statistics=beside, verdict=str(statistics["judgement"]["verdict"]))
