"""Recordings: test of their conventions, calibration of their unit, conversion to other formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError
from strapdown.cli import terminal as ui
from strapdown.cli.options import RECORDING_HELP, Layout
from strapdown.files import reading


@ui.command("json")
def doctor(
    *,
    recording: Path = Argument(help=f"{RECORDING_HELP}."),
    layout: Layout,
) -> dict[str, Any]:
    """Test the axes, signs, frames and units of a recording against alternatives: exit status 0 as declared, 1 wrong, 3 cannot tell."""
    source = sd.recordings.read(recording, **layout.options)
    with ui.progress_bar("testing conventions"):
        checked = sd.ahrs.check_conventions.examine(source)
    ui.say(f"{checked.source}: {checked.words}", *(f"warning: {words}." for words in checked.doubts))
    ui.say(*(f"Note: {remark}" for remark in source.remarks))
    if checked.candidates:
        ui.show(checked.listing())
    ui.say(*(f"Note: {note}." for note in checked.notes))
    return checked.summary()


@ui.command()
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
    ui.check_files(out, suffixes=(".toml",), own=sd.calibration.read)
    with ui.progress_bar("reading"):
        sources = [sd.recordings.read(path, **layout.options) for path in recordings]
    for source in sources:
        sd.ahrs.check_conventions.warn(source)
    with ui.progress_bar("calibrating"):
        result = sd.calibrate(sources, gravity=gravity)
    ui.show(result.listing())
    sd.calibration.write(result, out)
    ui.written(out)


@ui.command()
def convert(
    *,
    source: Path = Argument(metavar="IN", help=f"{RECORDING_HELP}; record of `strapdown simulate`, or estimate.h5."),
    target: Path = Argument(
        metavar="OUT", help="Its suffix selects the format: .csv, .tsv, .parquet, .bag, .mcap, .db3, .h5 (BROAD), .tum."
    ),
    layout: Layout,
    reference: Path | None = Option(None, help="TUM trajectory whose attitudes become the recording's reference."),
    force: bool = Option(False, "--force", help="Replace OUT if it exists."),
) -> None:
    """Convert a recording, a simulated record or an estimate; the format of IN is detected, that of OUT is given by its suffix."""
    estimate = reading.kind(source) == "strapdown estimate"
    ui.check_files(target, name="OUT", suffixes=sd.recordings.writers("write_estimate" if estimate else "write"))
    if target.exists() and not force:
        raise InputError(f"{target} exists; move it, choose another name, or give --force")
    if estimate and reference is not None:
        raise InputError("--reference applies to a recording; estimate again with it")
    content: Any = sd.read(source, **layout.options)
    if isinstance(content, sd.records.ImuRecord):
        content = sd.recordings.from_record(content, source.name)
    if reference is not None:
        content = sd.recordings.with_reference(content, reference)
    sd.write(content, target)
    ui.show(content.listing())
    ui.written(target)
