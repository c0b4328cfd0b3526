"""Verdicts: whether a filter is consistent, and which conventions a recording follows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer import Argument, Option

from strapdown.checks import Hint, InputError
from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.cli.terminal import command, console, counted, json_target, options_given, put_json, say, show, written
from strapdown.files import reading, writable
from strapdown.results import Column, Table

if TYPE_CHECKING:
    from strapdown.consistency import Judgement
    from strapdown.records import Estimate

CONSISTENT, NOT, CANNOT_TELL = 0, 1, 3
"""Exit status of a verdict; 2 is that of bad usage or input."""


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


@command
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

    json_target(json, result, record, filter_file, foreign.truth)
    if record is None and filter_file is not None:
        raise InputError("--filter goes with --record: the record is needed to search for causes")
    tail(confidence_level)
    how: dict[str, Any] = {"confidence_level": confidence_level, "detectable_error": detectable_error}
    # A missing file is reported as one of this package.
    own = (
        not result.exists()
        or result.suffix.lower() in (".h5", ".hdf5")
        or (result.is_file() and reading.is_hdf5(result))
    )
    own = own and foreign.truth is None
    if record is not None and not own:
        raise InputError(
            "--record goes with an estimate of `strapdown estimate` without --truth; leave out --truth or --record"
        )
    for name in options_given(foreign) if foreign.truth is None else ():
        raise InputError(f"{name} goes with --truth; give a reference, or leave it out")
    if own:
        held, judgement, content = _judged_own(result, how)
        words = judgement.words
        _show_statistics(judgement)
        if record is not None:
            content["diagnosis"], judgement, words = _diagnosed(held, record, filter_file, judgement)
    else:
        judgement, content = _judged_foreign(result, topic or "", foreign, how)
        words = judgement.words
        _show_statistics(judgement)
    console.print(words)
    put_json(json, content | judgement.summary())
    if foreign.aligned is not None:
        written(foreign.aligned)
    raise typer.Exit(status_of(judgement))


def _judged_own(result: Path, how: dict[str, Any]) -> tuple[Any, Judgement, dict[str, Any]]:
    """Judge a result of this package; return it, the verdict and the start of the JSON content."""
    import strapdown as sd

    held: Any = sd.read(result)
    kind = reading.kind(result)
    if kind == "strapdown montecarlo":
        if held.statistics is None:
            raise InputError(f"{result} has no completed run yet; resume it with `strapdown montecarlo --resume`")
        console.print(f"{result.name}: {held.statistics.runs} of {counted(held.runs, 'run')}, machine {held.machine}.")
    elif kind == "strapdown estimate":
        truth = "no truth"
        if held.truth is not None:
            truth = "with its truth" if held.truth.has_bias else "with a reference attitude"
        console.print(
            f"{result.name}: {len(held.time)} epochs over {held.time[-1] - held.time[0]:.6g} s, "
            f"{sum(len(one.time) for one in held.innovations.values())} measurements, {truth}."
        )
    else:
        raise InputError(
            f"{result} is {f'a {kind}' if kind else 'a recording'}; give a result of `strapdown estimate` or `strapdown montecarlo`"
        )
    return held, sd.check(held, **how), {"source": result.name, "kind": kind}


def status_of(judgement: Judgement) -> int:
    """Return the exit status of a verdict."""
    return {"consistent": CONSISTENT, "not consistent": NOT}.get(judgement.verdict, CANNOT_TELL)


def _judged_foreign(
    result: Path, topic: str, options: _Foreign, how: dict[str, Any]
) -> tuple[Judgement, dict[str, Any]]:
    """Judge an estimate of another program; return the verdict and the start of the JSON content."""
    import strapdown as sd
    from strapdown import consistency
    from strapdown.records import Origin

    if options.aligned is not None:
        writable("aligned", options.aligned, suffixes=(".h5", ".hdf5"), sources=(result, options.truth))
    own = sd.read_attitudes(result, topic=topic)
    if reading.kind(result) == "strapdown estimate":
        own = replace(own, innovations=sd.read(result).innovations)  # type: ignore[union-attr]
    length = (own.stamps_ns[-1] - own.stamps_ns[0]) / 1e9
    console.print(f"{own.source}: {len(own.stamps_ns)} attitudes over {length:.6g} s.")
    say(*own.remarks)
    content: dict[str, Any] = {"source": own.source, "kind": "estimate from elsewhere"}
    reference = None if options.truth is None else sd.read_attitudes(options.truth)
    if reference is not None:
        console.print(f"Truth: {reference.source}, {len(reference.stamps_ns)} attitudes.")
    checked = consistency.check_attitudes(own, reference, error_frame=options.error_frame, align=options.align, **how)
    if reference is None:
        return checked.judgement, content
    say(*(f"Note: {remark}." for remark in checked.remarks))
    show(
        *([checked.accuracy.listing()] if checked.accuracy else []),
        *([checked.listing()] if checked.explanations else []),
    )
    if options.aligned is not None:
        origin, details = Origin(source=own.source), {"truth": reference.source}
        sd.write(replace(checked.estimate, truth=checked.truth, origin=origin, details=details), options.aligned)
    return checked.judgement, content | checked.summary()


def _show_statistics(judgement: Judgement) -> None:
    table = judgement.listing()
    if judgement.findings:
        show(table, title="Statistics of the filter and their bounds for a consistent filter")
    else:
        say(*table.notes)


def _diagnosed(
    held: Estimate, record: Path, filter_file: Path | None, judgement: Judgement
) -> tuple[dict[str, Any], Judgement, str]:
    """Print the causes found from a record; return them for JSON, and the verdict and its words, combined with them if possible."""
    import strapdown as sd
    from strapdown.estimation.setup import read_setup
    from strapdown.estimation.setup.for_record import unmodelled_errors
    from strapdown.recordings import recordfiles
    from strapdown.records import Estimate
    from strapdown.workflows import no_state_words

    if not isinstance(held, Estimate):
        raise InputError("--record and --filter go with an estimate; for a Monte Carlo, replay a run first")
    source = recordfiles.read_record(record)
    chosen = held.setup if filter_file is None else read_setup(filter_file)
    missing = () if chosen is None else unmodelled_errors(source.origin, chosen)
    say(*no_state_words(missing, chosen))
    with progress_bar("searching for causes"), reading.from_file(record):
        diagnosis, reason = sd.diagnose(held, source, setup=chosen, judgement=judgement)
    if diagnosis is None:
        console.print(f"Causes were not searched for: {reason}.")
        return {"not_looked_for": reason, "without_a_state": list(missing)}, judgement, judgement.words
    show(diagnosis.listing(), title="Causes by their effect on the likelihood", notes=False)
    content = {**diagnosis.summary(), "without_a_state": list(missing)}
    if reason:
        say(f"{reason}; therefore the verdict is based on the statistics only.", diagnosis.cause_words)
        return content, judgement, judgement.words
    return content, diagnosis.judgement, diagnosis.words


@command
def doctor(
    *,
    recording: Path = Argument(help=f"{RECORDING_HELP}."),
    layout: Layout,
    json: Path | None = Option(None, "--json", help="File for the explanations and scores; - for standard output."),
) -> None:
    """Test the axes, signs, frames and units of a recording against alternatives: exit status 0 as declared, 1 wrong, 3 cannot tell."""
    from strapdown import recordings
    from strapdown.ahrs import check_conventions

    json_target(json, recording)
    source = recordings.read(recording, **layout.options(recording))
    with progress_bar("testing conventions"):
        checked = check_conventions.examine(source)
    say(
        f"{checked.source}: {checked.words}",
        *(f"warning: {words}." for words in checked.doubts),
        *(f"Note: {remark}" for remark in source.remarks),
    )
    if checked.candidates:
        names = list(checked.candidates[0].misfit)
        plain = lambda words: Hint.replaced(words, lambda hint: "").replace(" ()", "").replace("; )", ")")  # noqa: E731
        short = lambda name: name.replace("accelerometer", "acc").replace("magnetometer", "mag").replace(" and ", "–")  # noqa: E731
        columns = [Column("explanation"), Column("score", shown="{:.1f}".format)]
        columns += [Column(short(name), shown="{:.3f}".format) for name in names]  # hints are in the verdict
        rows = [(plain(one.words), one.score, *one.misfit.values()) for one in checked.candidates[:8]]
        title = "Explanations: score (log-likelihood) and misfit, 0 perfect, 1 unrelated, 2 opposite"
        show(Table(title, columns, rows))
    say(*(f"Note: {note}." for note in checked.notes))
    put_json(json, checked.summary())
    raise typer.Exit({"as declared": CONSISTENT, "wrong convention": NOT}.get(checked.verdict, CANNOT_TELL))
