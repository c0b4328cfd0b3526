"""Verdicts: whether a filter is consistent, and which conventions a recording follows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strapdown.checks import Hint, InputError
from strapdown.cli.filters import no_state_words
from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.cli.terminal import (
    command,
    console,
    counted,
    json_target,
    options_given,
    put_json,
    say,
    show,
    written,
)
from strapdown.files import reading, writable
from strapdown.results import Column, Table

if TYPE_CHECKING:
    from strapdown.consistency import Judgement
    from strapdown.tuning.diagnosis import Diagnosis

CONSISTENT, NOT, CANNOT_TELL = 0, 1, 3
"""Exit status of a verdict; 2 is that of bad usage or input."""


@dataclass(frozen=True)
class _Foreign:
    """With a truth: an estimate of any filter."""

    truth: Path | None = typer.Option(
        None,
        help="Reference attitudes in any clock and frames: a simulated record, TUM, EuRoC, BROAD, CSV, ROS bag. Differences are printed.",
    )
    error_frame: str = typer.Option(
        "find",
        help="Frame of the covariance: body, fixed or euler (roll, pitch, yaw); find: determined from the errors.",
    )
    align: str = typer.Option(
        "auto",
        help="Differences to estimate and remove: any of time,fixed,body (frames), or none; auto: clock offset, and rotations beyond 5°.",
    )
    aligned: Path | None = typer.Option(
        None, help="HDF5 file for the aligned estimate, which `strapdown report` reads."
    )
    topic: str | None = typer.Option(None, help="Topic of the estimate, if a bag has several.")
    truth_topic: str | None = typer.Option(None, help="Topic of the truth, if a bag has several.")


@command
def check(
    result: Annotated[
        Path,
        typer.Argument(
            help="estimate.h5 of `strapdown estimate`, the HDF5 file of `strapdown montecarlo`, or with --truth an estimate of "
            "any filter: CSV, TUM, ROS bag, ULog."
        ),
    ],
    foreign: _Foreign,
    confidence_level: float = typer.Option(
        0.99, help="Minimum probability with which a consistent filter passes all tests together."
    ),
    detectable_error: float = typer.Option(
        1.5,
        help="Factor on σ that the tests of attitude, bias and innovations must be able to detect for the verdict consistent.",
    ),
    record: Path | None = typer.Option(
        None, help="Record from which the estimate was made; likely causes are then determined."
    ),
    filter_file: Path | None = typer.Option(
        None,
        "--filter",
        help="TOML with the table named filter of the filter that made the estimate. Default: that in the estimate.",
    ),
    json: Path | None = typer.Option(None, "--json", help="File for all statistics; - for standard output."),
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
    own = _is_own(result)
    if record is not None and (foreign.truth is not None or not own):
        raise InputError(
            "--record goes with an estimate of `strapdown estimate` without --truth; leave out --truth or --record"
        )
    for name in options_given(foreign) if foreign.truth is None else ():
        if name not in ("--topic", "--truth-topic"):
            raise InputError(f"{name} goes with --truth; give a reference, or leave it out")
    if foreign.truth is not None or not own:
        judgement, content = _judged_foreign(result, foreign, how)
    else:
        judgement, content = _judged_own(result, how, with_record=record is not None)
    words = judgement.words
    _show_statistics(judgement)
    if record is not None:
        content["diagnosis"], found = _diagnosed(result, record, filter_file, judgement)
        if found is not None:
            judgement, words = found.judgement, found.words
    say(*(f"Note: {limit}." for limit in judgement.limits), words)
    content.update(judgement.summary())
    put_json(json, content)
    if foreign.aligned is not None:
        written(foreign.aligned)
    raise typer.Exit(status_of(judgement))


def _judged_own(result: Path, how: dict[str, Any], *, with_record: bool) -> tuple[Judgement, dict[str, Any]]:
    """Judge a result of this package; return the verdict and the start of the JSON content."""
    from strapdown import workflows

    held: Any = workflows.read(result)
    kind = reading.kind(result)
    if kind == "strapdown montecarlo":
        if with_record:
            raise InputError("--record and --filter go with an estimate; for a Monte Carlo, replay a run first")
        if held.statistics is None:
            raise InputError(f"{result} has no completed run yet; resume it with `strapdown montecarlo --resume`")
        console.print(f"{result.name}: {held.statistics.runs} of {counted(held.runs, 'run')}, machine {held.machine}.")
    elif kind == "strapdown estimate":
        truth = held.truth
        console.print(
            f"{result.name}: {len(held.time)} epochs over {held.time[-1] - held.time[0]:.6g} s, "
            f"{sum(len(one.time) for one in held.innovations.values())} measurements, "
            f"{'no truth' if truth is None else 'with its truth' if truth.has_bias else 'with a reference attitude'}."
        )
    else:
        raise InputError(
            f"{result} is {f'a {kind}' if kind else 'a recording'}; give a result of `strapdown estimate` or `strapdown montecarlo`"
        )
    return workflows.check(held, **how), {"source": result.name, "kind": kind}


def status_of(judgement: Judgement) -> int:
    """Return the exit status of a verdict."""
    return {"consistent": CONSISTENT, "not consistent": NOT}.get(judgement.verdict, CANNOT_TELL)


def _is_own(path: Path) -> bool:
    """Return whether a file is a result of this package, by content or name; a missing file is treated as one and reported later."""
    return not path.exists() or path.suffix.lower() in (".h5", ".hdf5") or (path.is_file() and reading.is_hdf5(path))


def _judged_foreign(result: Path, options: _Foreign, how: dict[str, Any]) -> tuple[Judgement, dict[str, Any]]:
    """Judge an estimate of another program; return the verdict and the start of the JSON content."""
    from strapdown import consistency, workflows
    from strapdown.consistency import foreign
    from strapdown.estimation.setup import read_estimate
    from strapdown.recordings.attitudes import read_attitudes
    from strapdown.records import Origin

    if options.aligned is not None:
        writable("aligned", options.aligned, suffixes=(".h5", ".hdf5"), sources=(result, options.truth))
    own = read_attitudes(result, topic=options.topic or "")
    if reading.kind(result) == "strapdown estimate":
        own = replace(own, innovations=read_estimate(result).innovations)
    length = (own.stamps_ns[-1] - own.stamps_ns[0]) / 1e9
    console.print(f"{own.source}: {len(own.stamps_ns)} attitudes over {length:.6g} s.")
    say(*own.remarks)
    content: dict[str, Any] = {"source": own.source, "kind": "estimate from elsewhere"}
    if options.truth is None:
        if not own.innovations:
            raise InputError(
                f"{result} has no innovations, so it cannot be judged without a truth; give --truth, attitudes over the same time"
            )
        estimate = foreign.without_truth(own.seconds(int(own.stamps_ns[0])), own.attitude, own.innovations)
        return consistency.judge(estimate, **how), content
    reference = read_attitudes(options.truth, topic=options.truth_topic or "")
    console.print(f"Truth: {reference.source}, {len(reference.stamps_ns)} attitudes.")
    found = consistency.check_attitudes(own, reference, error_frame=options.error_frame, align=options.align, **how)
    content.update(found.summary())
    say(*(f"Note: {remark}." for remark in found.remarks))
    show(found.accuracy.listing())
    if found.explanations:
        show(found.listing())
    if options.aligned is not None:
        aligned = replace(found.estimate, truth=found.truth, origin=Origin(source=own.source))
        workflows.write(replace(aligned, details={"truth": reference.source}), options.aligned)
    return found.judgement, content


def _show_statistics(judgement: Judgement) -> None:
    if judgement.findings:
        show(judgement.listing(), "Statistics of the filter and their bounds for a consistent filter", notes=False)
        share = 100.0 * (1.0 - judgement.confidence_level)
        console.print(
            "Each p-value is for one statistic; bounds, pass and FAIL are for all together (a consistent filter fails with at most "
            f"{share:.2g} %). NIS, NEES: per degree of freedom."
        )


def _diagnosed(
    result: Path, record: Path, filter_file: Path | None, judgement: Judgement
) -> tuple[dict[str, Any], Diagnosis | None]:
    """Print the causes found from a record; return them for JSON, and the diagnosis with the combined verdict, or None."""
    from strapdown import workflows
    from strapdown.estimation.setup import read_estimate, read_setup
    from strapdown.estimation.setup.for_record import unmodelled_errors
    from strapdown.recordings import recordfiles

    estimate, held = read_estimate(result), recordfiles.read_record(record)
    chosen = estimate.setup if filter_file is None else read_setup(filter_file)
    missing = () if chosen is None else unmodelled_errors(held.origin, chosen)
    say(*no_state_words(missing, chosen))
    with progress_bar("searching for causes"), reading.from_file(record):
        found, reason = workflows.diagnose(estimate, held, setup=chosen, judgement=judgement)
    if found is None:
        console.print(f"Causes were not searched for: {reason}.")
        return {"not_looked_for": reason, "without_a_state": list(missing)}, None
    show(found.listing(), "Causes by their effect on the likelihood", notes=False)
    content = {**found.summary(), "without_a_state": list(missing)}
    if reason:
        console.print(f"{reason}; therefore the verdict is based on the statistics only.")
        console.print(found.cause_words)
        return content, None
    return content, found


@command
def doctor(
    recording: Annotated[Path, typer.Argument(help=f"{RECORDING_HELP}.")],
    layout: Layout,
    json: Path | None = typer.Option(
        None, "--json", help="File for the explanations and their scores; - for standard output."
    ),
) -> None:
    """Test the axes, signs, frames and units of a recording against alternatives: exit status 0 as declared, 1 wrong, 3 cannot tell."""
    from strapdown import recordings
    from strapdown.ahrs import check_conventions
    from strapdown.recordings.sensor_faults import stuck_words

    json_target(json, recording)
    source = recordings.read(recording, **layout.options(recording))
    with progress_bar("testing conventions"):
        found = check_conventions.examine(source)
    say(
        f"{found.source}: {found.words}",
        *(f"warning: {words}." for words in found.doubts),
        *(f"warning: {words}" for words in stuck_words(source)),
        *(f"Note: {remark}" for remark in source.remarks),
    )
    if found.candidates:
        names = list(found.candidates[0].misfit)
        plain = lambda words: Hint.replaced(words, lambda hint: "").replace(" ()", "").replace("; )", ")")  # noqa: E731
        columns = [Column("explanation"), Column("score", shown="{:.1f}".format)]
        for name in names:  # hints are in the verdict
            short = name.replace("accelerometer", "acc").replace("magnetometer", "mag").replace(" and ", "–")
            columns.append(Column(short, shown="{:.3f}".format))
        rows = [(plain(one.words), one.score, *(one.misfit[name] for name in names)) for one in found.candidates[:8]]
        title = "Explanations: score (log-likelihood) and misfit, 0 perfect, 1 unrelated, 2 opposite"
        show(Table(title, columns, rows))
    say(*(f"Note: {note}." for note in found.notes))
    put_json(json, found.summary())
    raise typer.Exit({"as declared": CONSISTENT, "wrong convention": NOT}.get(found.verdict, CANNOT_TELL))
