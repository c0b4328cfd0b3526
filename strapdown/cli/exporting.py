"""Export of a filter as source code, and the versions of this installation."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from typer import Argument, Option

import strapdown as sd
from strapdown.cli import terminal as ui


@ui.command()
def export(
    filter_file: str = Argument(
        metavar="FILTER", help="TOML of a filter; or hand, vehicle, vessel, any: that of `estimate`."
    ),
    sensors: str | None = Argument(None, help="Record or scenario whose sensors the filter of a TOML file uses."),
    rate: float | None = Option(None, help="Sample rate of the IMU, Hz."),
    magnetometer: bool = Option(False, "--magnetometer", help="The IMU has a magnetometer."),
    to: Literal["c", "js"] = Option("c", "--to", help="Language: C99, or JavaScript (an ES module)."),
    precision: Literal["double", "single"] = Option("double", help="Precision of all numbers in C."),
    out: Path = Option(Path("strapdown-filter"), help="Folder of the source code."),
) -> None:
    """Export a filter as source code for a microcontroller or a web page."""
    source: Any = sensors
    if sensors is not None:
        named = Path(sensors).suffix.lower() in ("", ".toml")
        source = sd.scenarios.load_scenario(sensors) if named else sd.read(sensors)
    paths = sd.export(filter_file, source, folder=out, rate=rate, magnetometer=magnetometer, to=to, precision=precision)
    ui.say(f"Filter of {filter_file} for {sensors or f'an IMU at {rate:g} Hz'}, {precision} precision.")
    ui.written(*paths)


@ui.command()
def info() -> None:
    """Print the versions and the processor features used by compiled code."""
    from strapdown.kernels.machine import describe

    ui.say(f"strapdown {sd.__version__}", *(f"{name}: {value}" for name, value in describe().items()))
