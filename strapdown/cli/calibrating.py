"""Calibration of a unit from recordings of motion by hand."""

from __future__ import annotations

from pathlib import Path

from typer import Argument, Option

from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.cli.terminal import check_files, command, show, warn_about_conventions, written


@command
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
    from strapdown import calibration
    from strapdown import recordings as files

    own = lambda path: bool(calibration.read(path))  # noqa: E731
    check_files(out, suffixes=(".toml",), sources=recordings, own=own, command="calibrate")
    with progress_bar("reading"):
        sources = [files.read(path, **layout.options(path)) for path in recordings]
    for source, path in zip(sources, recordings, strict=True):
        warn_about_conventions(source, path)
    with progress_bar("calibrating"):
        result = calibration.calibrate(sources, gravity=gravity)
    show(result.listing())
    calibration.write(result, out)
    written(out)
