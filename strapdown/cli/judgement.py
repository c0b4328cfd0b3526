"""The verdict on a filter, and reports of results."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError
from strapdown.cli import terminal as ui
from strapdown.files import reading, writable
from strapdown.files.reading import existing_file

if TYPE_CHECKING:
    from strapdown.consistency import Judgement
    from strapdown.records import Estimate


@dataclass(frozen=True)
class _Foreign:
    """With a truth: an estimate of any filter."""

    truth: Path | None = Option(
        None, help="Reference attitudes in any clock and frames: a simulated record, TUM, EuRoC, BROAD, CSV, ROS bag."
    )
    error_frame: str = Option("find", help="Frame of the covariance: body, fixed or euler; find: by the errors.")
    align: str = Option(
        "auto",
        help="Differences to estimate and remove: any of time,fixed,body (frames), or none; auto: clock offset, and rotations beyond 5°.",
    )
    aligned: Path | None = Option(None, help="HDF5 file for the aligned estimate, which `strapdown report` reads.")


@ui.command
def check(
    *,
    result: Path = Argument(
        help="HDF5 file of `strapdown estimate` or `strapdown montecarlo`; or an estimate of any filter: CSV, TUM, ROS bag, ULog."
    ),
    foreign: _Foreign,
    topic: str | None = Option(None, help="Topic of the estimate, if a bag has several."),
    confidence_level: float = Option(0.99, help="Minimum probability with which a consistent filter passes all tests."),
    detectable_error: float = Option(1.5, help="Factor on σ that the tests must be able to detect."),
    record: Path | None = Option(None, help="Record from which the estimate was made, to search for likely causes."),
    filter_file: Path | None = Option(None, "--filter", help="TOML of the filter. Default: that in the estimate."),
    json: Path | None = Option(None, "--json", help="File for all statistics; - for standard output."),
) -> None:
    """Judge whether a filter is consistent: exit status 0 consistent, 1 not, 3 cannot tell, 2 bad usage or input.

    With --record, the verdict combines the statistics with a search for causes. With --truth, the estimate may be from any filter; clocks
    and frames are compared first. Without a truth, an estimate of another program is judged by its innovations, if it has any.
    """
    from strapdown.consistency.bounds import tail

    ui.json_target(json, result, record, filter_file, foreign.truth)
    if record is None and filter_file is not None:
        raise InputError("--filter goes with --record: the record is needed to search for causes")
    tail(confidence_level)
    how: dict[str, Any] = {"confidence_level": confidence_level, "detectable_error": detectable_error}
    # A missing file is reported as one of this package.
    hdf5 = result.suffix.lower() in (".h5", ".hdf5") or (result.is_file() and reading.is_hdf5(result))
    own = (hdf5 or not result.exists()) and foreign.truth is None
    if record is not None and not own:
        raise InputError(
            "--record goes with an estimate of `strapdown estimate` without --truth; leave out --truth or --record"
        )
    for name in ui.options_given(foreign) if foreign.truth is None else ():
        raise InputError(f"{name} goes with --truth; give a reference, or leave it out")
    if own:
        held, judgement, content = _judged_own(result, how)
    else:
        judgement, content = _judged_foreign(result, topic or "", foreign, how)
    table, words = judgement.listing(), judgement.words
    if judgement.findings:
        ui.show(table, title="Statistics of the filter and their bounds for a consistent filter")
    else:
        ui.say(*table.notes)
    if record is not None:
        content["diagnosis"], judgement, words = _diagnosed(held, record, filter_file, judgement)
    ui.say(words)
    ui.put_json(json, content | judgement.summary())
    if foreign.aligned is not None:
        ui.written(foreign.aligned)
    raise typer.Exit(ui.STATUS.get(judgement.verdict, ui.CANNOT_TELL))


def _judged_own(result: Path, how: dict[str, Any]) -> tuple[Any, Judgement, dict[str, Any]]:
    """Judge a result of this package; return it, the verdict and the start of the JSON content."""
    held: Any = sd.read(result)
    kind = reading.kind(result)
    if kind == "strapdown montecarlo":
        if held.statistics is None:
            raise InputError(f"{result} has no completed run yet; resume it with `strapdown montecarlo --resume`")
        ui.say(f"{result.name}: {held.statistics.runs} of {ui.counted(held.runs, 'run')}, machine {held.machine}.")
    elif kind == "strapdown estimate":
        truth = "no truth"
        if held.truth is not None:
            truth = "with its truth" if held.truth.has_bias else "with a reference attitude"
        number = sum(len(innovations.time) for innovations in held.innovations.values())
        length = held.time[-1] - held.time[0]
        ui.say(f"{result.name}: {len(held.time)} epochs over {length:.6g} s, {number} measurements, {truth}.")
    else:
        raise InputError(
            f"{result} is {f'a {kind}' if kind else 'a recording'}; give a result of `strapdown estimate` or `strapdown montecarlo`"
        )
    return held, sd.check(held, **how), {"source": result.name, "kind": kind}


def _judged_foreign(
    result: Path, topic: str, options: _Foreign, how: dict[str, Any]
) -> tuple[Judgement, dict[str, Any]]:
    """Judge an estimate of another program; return the verdict and the start of the JSON content."""
    if options.aligned is not None:
        writable("aligned", options.aligned, suffixes=(".h5", ".hdf5"), sources=(result, options.truth))
    own = sd.read_attitudes(result, topic=topic)
    if reading.kind(result) == "strapdown estimate":
        own = replace(own, innovations=sd.read(result).innovations)  # type: ignore[union-attr]
    length = (own.stamps_ns[-1] - own.stamps_ns[0]) / 1e9
    ui.say(f"{own.source}: {len(own.stamps_ns)} attitudes over {length:.6g} s.")
    ui.say(*own.remarks)
    content: dict[str, Any] = {"source": own.source, "kind": "estimate from elsewhere"}
    reference = None if options.truth is None else sd.read_attitudes(options.truth)
    if reference is not None:
        ui.say(f"Truth: {reference.source}, {len(reference.stamps_ns)} attitudes.")
    checked = sd.consistency.check_attitudes(
        own, reference, error_frame=options.error_frame, align=options.align, **how
    )
    if reference is None:
        return checked.judgement, content
    ui.say(*(f"Note: {remark}." for remark in checked.remarks))
    ui.show(
        *([checked.accuracy.listing()] if checked.accuracy else []),
        *([checked.listing()] if checked.explanations else []),
    )
    if options.aligned is not None:
        origin, details = sd.records.Origin(source=own.source), {"truth": reference.source}
        sd.write(replace(checked.estimate, truth=checked.truth, origin=origin, details=details), options.aligned)
    return checked.judgement, content | checked.summary()


def _diagnosed(
    held: Estimate, record: Path, filter_file: Path | None, judgement: Judgement
) -> tuple[dict[str, Any], Judgement, str]:
    """Print the causes found from a record; return them for JSON, and the verdict and its words, combined with them if possible."""
    from strapdown.estimation.setup import read_setup
    from strapdown.estimation.setup.for_record import unmodelled_errors
    from strapdown.recordings.recordfiles import read_record
    from strapdown.workflows.filters import no_state_words

    if not isinstance(held, sd.records.Estimate):
        raise InputError("--record and --filter go with an estimate; for a Monte Carlo, replay a run first")
    source = read_record(record)
    filter_setup = held.setup if filter_file is None else read_setup(filter_file)
    missing = () if filter_setup is None else unmodelled_errors(source.origin, filter_setup)
    ui.say(*no_state_words(missing, filter_setup))
    with ui.progress_bar("searching for causes"), reading.from_file(record):
        diagnosis, reason = sd.diagnose(held, source, setup=filter_setup, judgement=judgement)
    if diagnosis is None:
        ui.say(f"Causes were not searched for: {reason}.")
        return {"not_looked_for": reason, "without_a_state": missing}, judgement, judgement.words
    ui.show(diagnosis.listing(), title="Causes by their effect on the likelihood", notes=False)
    content = {**diagnosis.summary(), "without_a_state": missing}
    if reason:
        ui.say(f"{reason}; therefore the verdict is based on the statistics only.", diagnosis.cause_words)
        return content, judgement, judgement.words
    return content, diagnosis.judgement, diagnosis.words


@ui.command
def report(
    result: Path = Argument(help="HDF5 of `estimate` or `montecarlo`, or JSON of `tune` or `coning`."),
    other: Path | None = Argument(None, help="A second estimate of the same motion: both, with their difference."),
    out: Path | None = Option(None, "--out", "-o", help="The page, .html. Default: beside the result."),
) -> None:
    """Write a self-contained HTML page about a result: verdict, numbers, figures, provenance; and the statistics as JSON."""
    existing_file(result)
    page = result.with_suffix(".html") if out is None else out
    ui.check_files(page, page.with_suffix(".report.json"), sources=(result, other))
    with ui.progress_bar("judging, drawing"):
        done = sd.report.write(result, out, other=other)
    ui.say(f"{result.name}: {done.verdict}.")
    ui.written(done.page, done.statistics)
