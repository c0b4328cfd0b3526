"""The verdict on a filter, and reports of results."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError
from strapdown.cli import terminal as ui
from strapdown.cli.options import options_given
from strapdown.files import HDF5, reading


@dataclass(frozen=True)
class _Foreign:
    """With a truth: an estimate of any filter."""

    truth: Path | None = Option(None, help="Reference attitudes, any clock and frames: TUM, EuRoC, BROAD, CSV, bag.")
    topic: str = Option(
        "", help="Topic of the bag, if it has several; of two bags: of the estimate, or ESTIMATE,TRUTH."
    )
    error_frame: str = Option("find", help="Frame of the covariance: body, fixed or euler; find: by the errors.")
    align: str = Option(
        "auto",
        help="Differences to estimate and remove: any of time,fixed,body (frames), or none; auto: clock offset, and rotations beyond 5°, "
        "the table of errors also with all removed.",
    )
    aligned: Path | None = Option(None, help="HDF5 file for the aligned estimate, which `strapdown report` reads.")


@ui.command("json")
def check(
    *,
    result: Path = Argument(
        help="HDF5 file of `strapdown estimate` or `strapdown montecarlo`; or an estimate of any filter: CSV, TUM, ROS bag, ULog."
    ),
    foreign: _Foreign,
    confidence_level: float = Option(0.99, help="Minimum probability with which a consistent filter passes all tests."),
    detectable_error: float = Option(1.5, help="Factor on σ that the tests must be able to detect."),
    record: Path | None = Option(None, help="Record from which the estimate was made, to search for likely causes."),
    filter_file: Path | None = Option(None, "--filter", help="TOML of the filter. Default: that in the estimate."),
) -> dict[str, Any]:
    """Judge whether a filter is consistent: exit status 0 consistent, 1 not, 3 cannot tell, 2 bad usage or input.

    With --record, the verdict combines the statistics with a search for causes. With --truth, the estimate may be from any filter; clocks
    and frames are compared first. Without a truth, an estimate of another program is judged by its innovations, if it has any.
    """
    from strapdown.recordings.recordfiles import read_record
    from strapdown.workflows.judging import need_same_draw

    how: dict[str, Any] = {"confidence_level": confidence_level, "detectable_error": detectable_error}
    # A missing file is reported as one of this package.
    own = foreign.truth is None and (not result.exists() or bool(reading.kind(result)))
    if record is None and filter_file is not None:
        raise InputError("--filter goes with --record: the record is needed to search for causes")
    if record is not None and not own:
        raise InputError("--record goes with an estimate of `strapdown estimate` alone; leave out --truth or --record")
    for name in options_given(foreign) if foreign.truth is None else ():
        raise InputError(f"{name} goes with --truth; give a reference, or leave it out")
    if foreign.aligned is not None:
        ui.check_files(foreign.aligned, suffixes=HDF5, name="aligned")
    if own:
        held: Any = sd.read(result)
        if record is not None and not isinstance(held, sd.records.Estimate):
            raise InputError("--record and --filter go with an estimate; for a Monte Carlo, replay a run first")
        if filter_file is not None:
            held = replace(held, setup=sd.estimation.setup.read_setup(filter_file))
        if record is not None:  # whose specification is that of the estimate, or replaces it
            source = read_record(record)
            need_same_draw(held, source)
            held = replace(held, origin=source.origin or held.origin)
        with reading.from_file(result):
            judgement = sd.check(held, **how)
        content: dict[str, Any] = {"source": result.name, "kind": reading.kind(result)}
        ui.say(f"{result.name}: {held.extent}.")
    else:
        judgement, content = _judged_foreign(result, foreign, how)
    table, words = judgement.listing(), judgement.words
    if judgement.findings:
        ui.show(table, title=ui.EVIDENCE)
    else:
        ui.say(*table.notes)
    if record is not None:
        content["diagnosis"], causes = _diagnosed(held, source, record, judgement)
        if causes is not None:
            judgement, words = causes.judgement, causes.words
    ui.say(words)
    return content | judgement.summary()


def _judged_foreign(result: Path, options: _Foreign, how: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Judge an estimate of another program; return the verdict and the start of the JSON content."""
    of_estimate = "," in options.topic or sd.recordings.formats.format_of(result).name == "ROS bag"
    topic, _, true_topic = options.topic.partition(",") if of_estimate else ("", "", options.topic)
    own = sd.read_attitudes(result, topic=topic)
    truth = None if options.truth is None else sd.read_attitudes(options.truth, topic=true_topic)
    checked = sd.consistency.check_attitudes(own, truth, error_frame=options.error_frame, align=options.align, **how)
    ui.say(f"{own.source}: {own.extent}.", *own.remarks)
    ui.say("" if truth is None else f"Truth: {truth.source}, {truth.extent}.")
    ui.say(*(f"Note: {remark}." for remark in checked.remarks))
    ui.show(*checked.tables)
    if options.aligned is not None:
        ui.written(sd.write(checked.estimate, options.aligned))
    return checked.judgement, {"source": own.source, "kind": "estimate from elsewhere", **checked.summary()}


def _diagnosed(held: Any, source: Any, record: Path, judgement: Any) -> tuple[dict[str, Any], Any]:
    """Print the causes found from a record; return them for JSON, and, if they count in the verdict, as they are."""
    with ui.progress_bar("searching for causes"), reading.from_file(record):
        causes, reason = sd.diagnose(held, source, judgement=judgement)
    if causes is None:
        ui.say(f"Causes were not searched for: {reason}.")
        return {"not_looked_for": reason}, None
    ui.show(causes.listing(), title="Causes by their effect on the likelihood", notes=False)
    if reason:
        ui.say(f"{reason}; therefore the verdict is based on the statistics only.", causes.cause_words)
    return causes.summary(), None if reason else causes


@ui.command()
def report(
    result: Path = Argument(help="HDF5 of `estimate` or `montecarlo`, or JSON of `tune` or `coning`."),
    other: Path | None = Argument(None, help="A second estimate of the same motion: both, with their difference."),
    out: Path | None = Option(None, "--out", "-o", help="The page, .html. Default: beside the result."),
) -> None:
    """Write a self-contained HTML page about a result: verdict, numbers, figures, provenance; and the statistics as JSON."""
    with ui.progress_bar("judging, drawing"):
        done = sd.report.write(result, out, other=other)
    ui.say(f"{result.name}: {done.verdict}.")
    ui.written(done.page, done.statistics)
