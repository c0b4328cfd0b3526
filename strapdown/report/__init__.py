"""Reports: one self-contained HTML page for a result file, with verdict, numbers, figures and provenance.

- ``page``: HTML, figures and interactive charts on one page without network access. The charts are drawn by uPlot (MIT licence), bundled in
  ``uplot/``.
- ``estimates``: The page of one estimate.
- ``campaigns``: The page of a Monte Carlo.
- ``tunings``: The page of a tuning.
- ``conings``: The page of a coning study.
- ``comparisons``: The page of two estimates.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from strapdown import records
from strapdown.checks import InputError
from strapdown.files import writable, write_json, write_text
from strapdown.files.reading import existing_file, from_file, json_file
from strapdown.report import campaigns, comparisons, conings, estimates, tunings

__all__ = ["write"]

_WRITERS: dict[str, Callable[[Path], tuple[str, dict[str, Any]]]] = {
    "strapdown estimate": estimates.report,
    "strapdown montecarlo": campaigns.report,
    "strapdown tuning": tunings.report,
    "strapdown coning": conings.report,
}


@dataclass(frozen=True, kw_only=True)
class Report:
    """A written report."""

    page: Path
    statistics: Path
    """The same statistics as JSON."""
    verdict: str


def write(
    result: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    other: str | os.PathLike[str] | None = None,
) -> Report:
    """Write the report of a result file, and its statistics as JSON beside it, atomically.

    Parameters
    ----------
    result : path
        HDF5 file of an estimate or a Monte Carlo, or the JSON of a tuning or of a coning study.
    out : path, optional
        The page. Default: ``result`` with the suffix .html; with ``other`` beside it as ``RESULT-and-OTHER.html``.
    other : path, optional
        A second estimate of the same motion: the page has both, and their difference.

    Returns
    -------
    Report
        Paths of the page and of the statistics (``.report.json``), and the verdict in words.
    """
    source = Path(result)
    existing_file(source)
    name = source.stem
    if other is not None:  # named by its folder if both files have the same name
        second = Path(other).resolve()
        name += f"-and-{second.stem if second.stem != name else second.parent.name}"
    target = source.with_name(f"{name}.html") if out is None else Path(out)
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"out is {target}; give a file with the suffix .html")
    beside = target.with_suffix(".report.json")  # not .json, which other commands write beside their results
    writable("out", target, beside, sources=(source, other))
    kind = _kind(source)
    if kind not in _WRITERS:
        known = ", ".join(name.removeprefix("strapdown ") for name in _WRITERS)
        raise InputError(f"{source} holds: {kind.removeprefix('strapdown ')}; reports are available for: {known}")
    with from_file(source):  # errors while drawing invalid numbers name the file
        if other is None:
            content, statistics = _WRITERS[kind](source)
        else:
            existing_file(Path(other))
            if {kind, _kind(Path(other))} != {"strapdown estimate"}:
                raise InputError(f"{source} and {other}: only two estimates can be compared; give their HDF5 files")
            content, statistics = comparisons.report(source, Path(other))
    write_text(target, content, errors="backslashreplace")  # a name may not be UTF-8
    write_json(beside, statistics)
    return Report(page=target, statistics=beside, verdict=str(statistics["judgement"]["verdict"]))


def _kind(source: Path) -> str:
    if source.suffix.lower() != ".json":
        return str(records.read_attributes(source)["kind"])
    content = json_file(source)
    return "strapdown coning" if isinstance(content, dict) and "integration" in content else "strapdown tuning"
