"""Recordings: test of their conventions, calibration of their unit, conversion to other formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer
from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError
from strapdown.cli import terminal as ui
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.files import reading, writable


@ui.command
def doctor(
    *,
    recording: Path = Argument(help=f"{RECORDING_HELP}."),
    layout: Layout,
    json: Path | None = Option(None, "--json", help="File for the explanations and scores; - for standard output."),
) -> None:
    """Test the axes, signs, frames and units of a recording against alternatives: exit status 0 as declared, 1 wrong, 3 cannot tell."""
    ui.json_target(json, recording)
    source = sd.recordings.read(recording, **layout.options(recording))
    with ui.progress_bar("testing conventions"):
        checked = sd.ahrs.check_conventions.examine(source)
    ui.say(f"{checked.source}: {checked.words}", *(f"warning: {words}." for words in checked.doubts))
    ui.say(*(f"Note: {remark}" for remark in source.remarks))
    if checked.candidates:
        ui.show(checked.listing())
    ui.say(*(f"Note: {note}." for note in checked.notes))
    ui.put_json(json, checked.summary())
    raise typer.Exit(ui.STATUS.get(checked.verdict, ui.CANNOT_TELL))


@ui.command
def calibrate(
    *,
    recordings: list[Path] = Argument(help=f"Recordings of one unit that is turned by hand. {RECORDING_HELP}."),
    layout: Layout,
    out: Path = Option(Path("calibration.toml"), help="TOML file for the calibration."),
    gravity: float = Option(9.80665, help="Gravity at the place, m/s²."),
) -> None:
    """Calibrate a unit by hand: bias, scale and misalignment of gyro and accelerometer, hard and soft iron, delays, each with σ.

    Turn the unit about all its axes for a minute or more, with pauses of some seconds in different positions. What is missing is said.
    """
    own = lambda path: bool(sd.calibration.read(path))  # noqa: E731
    ui.check_files(out, suffixes=(".toml",), sources=recordings, own=own, command="calibrate")
    with ui.progress_bar("reading"):
        sources = [sd.recordings.read(path, **layout.options(path)) for path in recordings]
    for source, path in zip(sources, recordings, strict=True):
        ui.warn_about_conventions(source, path)
    with ui.progress_bar("calibrating"):
        result = sd.calibrate(sources, gravity=gravity)
    ui.show(result.listing())
    sd.calibration.write(result, out)
    ui.written(out)


@ui.command
def convert(
    *,
    source: Path = Argument(metavar="IN", help=f"{RECORDING_HELP}; record of `strapdown simulate`, or estimate.h5."),
    target: Path = Argument(
        metavar="OUT",
        help="File whose suffix selects the format: .csv, .tsv, .parquet, .bag (ROS 1), .mcap or .db3 (ROS 2), .h5 (BROAD); for an "
        "estimate .csv, .tsv, .parquet, .tum.",
    ),
    layout: Layout,
    reference: Path | None = Option(None, help="TUM trajectory whose attitudes become the recording's reference."),
    force: bool = Option(False, "--force", help="Replace OUT if it exists."),
) -> None:
    """Convert a recording, a simulated record or an estimate; the format of IN is detected, that of OUT is given by its suffix."""
    from strapdown import recordings

    options, kind = layout.options(source), reading.kind(source)
    estimate, simulated = kind == "strapdown estimate", kind == "strapdown record"
    suffixes = recordings.writers("write_estimate" if estimate else "write")
    writable("OUT", target, suffixes=suffixes, sources=(source, reference))
    if target.exists() and not force:
        raise InputError(f"{target} exists; move it, choose another name, or give --force")
    if estimate:
        recordings.estimate_format(target, recording=False)
        if reference is not None or "axes" in options or "invert" in options:
            raise InputError("--reference, --axes and --invert apply to a recording; estimate again with them")
    content: Any = sd.read(source, **({} if estimate else options))
    parts: Any = ("attitude", "bias") if estimate and content.has_bias else ("attitude",)
    time, name = content.time, source.name
    if not estimate:
        if simulated:
            content = recordings.from_record(content, name)
            ui.say("Simulated record: the rate at each time stamp is the mean over the sample interval before it.")
        if reference is not None:
            content = recordings.with_reference(content, reference)
        time, parts, name = content.time, content.parts, content.source
    recordings.write(content, target)
    ui.say(f"{name}: {len(time)} samples over {time[-1] - time[0]:.6g} s of {', '.join(parts)}.")
    if not estimate:
        ui.say(*content.remarks, content.left_out_words)
        stored = (*parts, *(["clock"] if content.epoch_ns else []))
        lost = [name for name in recordings.not_held(target) if name in stored]
        ui.say(f"{target.name} cannot store {', '.join(lost)}: omitted." if lost else "")
    ui.written(target)
