"""Conversion of recordings and estimates to other formats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from strapdown.checks import InputError
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.cli.terminal import command, console, say, written
from strapdown.files import writable

if TYPE_CHECKING:
    from strapdown.recordings import Recording


@command
def convert(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="IN",
            help=f"{RECORDING_HELP}; record of `strapdown simulate`, or estimate.h5 of `strapdown estimate`.",
        ),
    ],
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="File whose suffix selects the format: .csv, .tsv, .parquet, .bag (ROS 1), .mcap or .db3 (ROS 2), .h5 (BROAD); for an "
            "estimate .csv, .tsv, .parquet, .tum, .rrd.",
        ),
    ],
    layout: Layout,
    reference: Path | None = typer.Option(
        None, help="TUM trajectory whose attitudes become the recording's reference."
    ),
    force: bool = typer.Option(False, "--force", help="Replace OUT if it exists."),
) -> None:
    """Convert a recording, a simulated record or an estimate; the format of IN is detected, that of OUT is given by its suffix."""
    from strapdown import recordings
    from strapdown.estimation.setup import read_estimate

    options = layout.options(source)
    estimate = recordings.is_estimate(source)
    writable(
        "OUT",
        target,
        suffixes=recordings.writers("write_estimate" if estimate else "write"),
        sources=(source, reference),
    )
    if target.exists() and not force:
        raise InputError(f"{target} exists; move it, choose another name, or give --force")
    if estimate:
        recordings.estimate_format(target, recording=False)
        if layout.axes or layout.invert:
            raise InputError("--axes and --invert apply to a recording; estimate again with them")
        if reference is not None:
            raise InputError("--reference applies to a recording; an estimate contains attitudes")
        held = read_estimate(source)
        recordings.write(held, target)
        console.print(
            f"{source.name}: an estimate at {len(held.time)} times over {held.time[-1] - held.time[0]:.6g} s."
        )
    else:
        if recordings.is_record(source):
            from strapdown.recordings.recordfiles import read_record

            content = recordings.from_record(read_record(source), source.name)
            console.print(
                "Simulated record: the rate at each time stamp is the mean over the sample interval before it."
            )
        else:
            content = recordings.read(source, **options)
        if reference is not None:
            content = recordings.with_reference(content, reference)
        recordings.write(content, target)
        _report(content, target)
    written(target)


def _report(recording: Recording, target: Path) -> None:
    """Print what was read, and which quantities the format of the target cannot store."""
    from strapdown import recordings

    held = {
        "accelerometer": recording.specific_force,
        "magnetometer": recording.magnetic_field,
        "temperature": recording.temperature,
        "reference": recording.true_attitude,
        "movement": recording.movement,
    }
    parts = ["gyro", *(name for name, values in held.items() if values is not None)]
    length = recording.time[-1] - recording.time[0]
    console.print(f"{recording.source}: {len(recording.time)} samples over {length:.6g} s of {', '.join(parts)}.")
    say(*recording.remarks, recording.left_out_words)
    lost = [name for name in recordings.not_held(target) if name in parts or (name == "clock" and recording.epoch_ns)]
    if lost:
        console.print(f"{target.name} cannot store {', '.join(lost)}: omitted.")
