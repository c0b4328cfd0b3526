"""Export of a filter as source code, and the versions of this installation."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError, positive
from strapdown.cli import terminal as ui


@ui.command
def export(
    filter_file: str = Argument(
        metavar="FILTER",
        help="TOML file of a filter setup; or a motion (hand, vehicle, vessel, any): the filter of `strapdown estimate` for an IMU.",
    ),
    sensors: str | None = Argument(
        None, help="Simulated record or scenario (name or TOML file) whose sensors the filter of a setup uses."
    ),
    rate: float | None = Option(None, help="Sample rate of the IMU, Hz."),
    magnetometer: bool = Option(False, "--magnetometer", help="The IMU has a magnetometer."),
    to: Literal["c", "js"] = Option("c", "--to", help="Language: C99, or JavaScript (an ES module)."),
    precision: Literal["double", "single"] = Option("double", help="Precision of all numbers in C."),
    out: Path = Option(Path("strapdown-filter"), help="Folder of the source code."),
) -> None:
    """Export a filter as source code for a microcontroller or a web page."""
    from strapdown.ahrs.parameters import MOTIONS, of_motion
    from strapdown.records import ImuRecord

    if filter_file in MOTIONS:
        if rate is None or sensors is not None:
            raise InputError(
                f"the filter of an IMU ({filter_file}) has its own sensors; give their rate alone, such as --rate 100"
            )
        parameters = of_motion(filter_file, magnetometer=magnetometer)
        interval = 1.0 / positive("rate", rate, unit="Hz")
        live = sd.LiveAhrs(interval=interval, magnetometer=magnetometer, parameters=parameters)
        paths = sd.export(live, folder=out, to=to, precision=precision)
        what = f"an IMU at {rate:g} Hz"
    else:
        if sensors is None or rate is not None or magnetometer:
            raise InputError(
                "a filter setup needs a record or a scenario of its sensors; rate and magnetometer are of an IMU"
            )
        recorded = Path(sensors).suffix in (".h5", ".csv")
        source = sd.read(sensors) if recorded else sd.scenarios.load_scenario(sensors)
        if not isinstance(source, (ImuRecord, sd.Scenario)):
            raise InputError(f"{sensors} is no simulated record; give a record of `strapdown simulate`, or a scenario")
        paths = sd.export(filter_file, source, folder=out, to=to, precision=precision)
        what = f"the sensors of {sensors}"
    ui.say(f"Filter of {filter_file} with {what}, {precision} precision.")
    ui.written(*paths)


@ui.command
def info() -> None:
    """Print the versions and the processor features used by compiled code."""
    import strapdown
    from strapdown.kernels.machine import describe

    ui.say(f"strapdown {strapdown.__version__}")
    for name, value in describe().items():
        ui.say(f"{name}: {value}")
