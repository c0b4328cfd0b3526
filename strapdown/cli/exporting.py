"""Export of a filter as source code."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from strapdown.checks import InputError
from strapdown.cli.terminal import command, console, scenario_named, written

if TYPE_CHECKING:
    from strapdown.records import ImuRecord
    from strapdown.scenarios import Scenario


@command
def export(
    filter_file: Annotated[
        str,
        typer.Argument(
            metavar="FILTER",
            help="TOML file of a filter setup; or a motion (hand, vehicle, vessel, any): the filter of `strapdown estimate` for an IMU.",
        ),
    ],
    sensors: Annotated[
        str | None,
        typer.Argument(
            metavar="SENSORS",
            help="Simulated record or scenario (name or TOML file) whose sensors the filter of a setup uses.",
        ),
    ] = None,
    rate: float | None = typer.Option(None, help="Sample rate of the IMU, Hz."),
    magnetometer: bool = typer.Option(False, "--magnetometer", help="The IMU has a magnetometer."),
    to: Literal["c", "js"] = typer.Option("c", "--to", help="Language: C99, or JavaScript (an ES module)."),
    precision: Literal["double", "single"] = typer.Option("double", help="Precision of all numbers in C."),
    out: Path = typer.Option(Path("strapdown-filter"), help="Folder of the source code."),
) -> None:
    """Export a filter as source code for a microcontroller or a web page."""
    import strapdown
    from strapdown.ahrs.parameters import MOTIONS, of_motion
    from strapdown.checks import positive

    if filter_file in MOTIONS:
        if rate is None or sensors is not None:
            raise InputError(
                f"the filter of an IMU ({filter_file}) has its own sensors; give their rate alone, such as --rate 100"
            )
        parameters = of_motion(filter_file, magnetometer=magnetometer)
        live = strapdown.LiveAhrs(
            interval=1.0 / positive("rate", rate, unit="Hz"), magnetometer=magnetometer, parameters=parameters
        )
        paths = strapdown.export(live, folder=out, to=to, precision=precision)
        what = f"an IMU at {rate:g} Hz"
    else:
        if sensors is None or rate is not None or magnetometer:
            raise InputError(
                "a filter setup needs a record or a scenario of its sensors; rate and magnetometer are of an IMU"
            )
        paths = strapdown.export(filter_file, _sensors(sensors), folder=out, to=to, precision=precision)
        what = f"the sensors of {sensors}"
    console.print(f"Filter of {filter_file} with {what}, {precision} precision.")
    written(*paths)


def _sensors(source: str) -> ImuRecord | Scenario:
    """Return the record of a file, or the scenario of a name or a TOML file."""
    if Path(source).suffix in (".h5", ".csv"):
        from strapdown.records import ImuRecord
        from strapdown.workflows import read

        held = read(source)
        if not isinstance(held, ImuRecord):
            raise InputError(f"{source} is no simulated record; give a record of `strapdown simulate`, or a scenario")
        return held
    return scenario_named(source)
