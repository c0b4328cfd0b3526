"""Conversion of recordings and estimates to other formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from typer import Argument, Option

from strapdown.checks import InputError
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.cli.terminal import command, console, say, written
from strapdown.files import writable


@command
def convert(
    *,
    source: Path = Argument(metavar="IN", help=f"{RECORDING_HELP}; record of `strapdown simulate`, or estimate.h5."),
    target: Path = Argument(
        metavar="OUT",
        help="File whose suffix selects the format: .csv, .tsv, .parquet, .bag (ROS 1), .mcap or .db3 (ROS 2), .h5 (BROAD); for an "
        "estimate .csv, .tsv, .parquet, .tum, .rrd.",
    ),
    layout: Layout,
    reference: Path | None = Option(None, help="TUM trajectory whose attitudes become the recording's reference."),
    force: bool = Option(False, "--force", help="Replace OUT if it exists."),
) -> None:
    """Convert a recording, a simulated record or an estimate; the format of IN is detected, that of OUT is given by its suffix."""
    import strapdown as sd
    from strapdown import recordings

    options, estimate, simulated = layout.options(source), recordings.is_estimate(source), recordings.is_record(source)
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
            console.print(
                "Simulated record: the rate at each time stamp is the mean over the sample interval before it."
            )
        if reference is not None:
            content = recordings.with_reference(content, reference)
        time, parts, name = content.time, content.parts, content.source
    recordings.write(content, target)
    console.print(f"{name}: {len(time)} samples over {time[-1] - time[0]:.6g} s of {', '.join(parts)}.")
    if not estimate:
        say(*content.remarks, content.left_out_words)
        stored = (*parts, *(["clock"] if content.epoch_ns else []))
        lost = [name for name in recordings.not_held(target) if name in stored]
        say(f"{target.name} cannot store {', '.join(lost)}: omitted." if lost else "")
    written(target)
