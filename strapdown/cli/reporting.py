"""Reports of results."""

from __future__ import annotations

from pathlib import Path

from typer import Argument, Option

from strapdown.cli.progress import progress_bar
from strapdown.cli.terminal import check_files, command, console, written
from strapdown.files.reading import existing_file


@command
def report(
    result: Path = Argument(help="HDF5 of `estimate` or `montecarlo`, or JSON of `tune` or `coning`."),
    other: Path | None = Argument(None, help="A second estimate of the same motion: both, with their difference."),
    out: Path | None = Option(None, "--out", "-o", help="The page, .html. Default: beside the result."),
) -> None:
    """Write a self-contained HTML page about a result: verdict, numbers, figures, provenance; and the statistics as JSON."""
    from strapdown import report as reports

    existing_file(result)
    page = result.with_suffix(".html") if out is None else out
    check_files(page, page.with_suffix(".report.json"), sources=(result, other))
    with progress_bar("judging, drawing"):
        done = reports.write(result, out, other=other)
    console.print(f"{result.name}: {done.verdict}.", highlight=False)
    written(done.page, done.statistics)
