"""Reports of results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from strapdown.cli.progress import progress_bar
from strapdown.cli.terminal import command, console, written
from strapdown.files import writable
from strapdown.files.reading import existing_file


@command
def report(
    result: Annotated[
        Path,
        typer.Argument(
            help="HDF5 file of `strapdown estimate` or `montecarlo`, or the JSON of `strapdown tune` or `coning`."
        ),
    ],
    other: Annotated[
        Path | None,
        typer.Argument(help="A second estimate of the same motion: both on one page, with their difference."),
    ] = None,
    out: Path | None = typer.Option(
        None, "--out", "-o", help="The page, .html. Default: the file name of the result with this suffix."
    ),
    confidence_level: float = typer.Option(
        0.99, help="Probability that a consistent filter passes all tests, between 0 and 1."
    ),
) -> None:
    """Write a self-contained HTML page about a result: verdict, numbers, figures, provenance; and the statistics as JSON."""
    from strapdown import report as reports

    existing_file(result)
    page = result.with_suffix(".html") if out is None else out
    writable("out", page, page.with_suffix(".report.json"), sources=(result, other))
    with progress_bar("judging, drawing"):
        done = reports.write(result, out, other=other, confidence_level=confidence_level)
    console.print(f"{result.name}: {done.verdict}.", highlight=False)
    written(done.page, done.statistics)
