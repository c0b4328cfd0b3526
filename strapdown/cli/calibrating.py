"""Calibration of a unit from recordings of motion by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.cli.terminal import command, need_own, show, warn_about_conventions, written
from strapdown.files import writable


@command
def calibrate(
    recordings: Annotated[
        list[Path],
        typer.Argument(help=f"Recordings of one unit that is turned by hand, best with pauses. {RECORDING_HELP}."),
    ],
    layout: Layout,
    out: Path = typer.Option(Path("calibration.toml"), help="TOML file for the calibration."),
    gravity: float = typer.Option(9.80665, help="Gravity at the place, m/s²."),
) -> None:
    """Calibrate a unit by hand: bias, scale and misalignment of gyro and accelerometer, hard and soft iron, delays, each with σ.

    Turn the unit about all its axes for a minute or more, with pauses of some seconds in different positions. What is missing is said.
    """
    from strapdown import calibration
    from strapdown import recordings as files

    writable("out", out, suffixes=(".toml",), sources=tuple(recordings))
    need_own(out, "calibrate", lambda path: bool(calibration.read(path)))
    with progress_bar("reading"):
        sources = [files.read(path, **layout.options(path)) for path in recordings]
    for source, path in zip(sources, recordings, strict=True):
        warn_about_conventions(source, path)
    with progress_bar("calibrating"):
        found = calibration.calibrate(sources, gravity=gravity)
    show(found.listing())
    calibration.write(found, out)
    written(out)
