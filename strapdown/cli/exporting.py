"""Export of a filter as source code, and the versions of this installation."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from typer import Argument, Option

from strapdown.checks import InputError
from strapdown.cli.terminal import command, console, written


@command
def export(
    filter_file: Path = Argument(metavar="FILTER", help="TOML file of a filter setup."),
    sensors: str = Argument(help="Simulated record or scenario (name or TOML file) whose sensors the filter uses."),
    to: Literal["c", "js"] = Option("c", "--to", help="Language: C99, or JavaScript (an ES module)."),
    precision: Literal["double", "single"] = Option("double", help="Precision of all numbers in C."),
    out: Path = Option(Path("strapdown-filter"), help="Folder of the source code."),
) -> None:
    """Export a filter as source code for a microcontroller or a web page."""
    import strapdown as sd
    from strapdown.records import ImuRecord

    recorded = Path(sensors).suffix in (".h5", ".csv")
    source = sd.read(sensors) if recorded else sd.scenarios.load_scenario(sensors)
    if not isinstance(source, (ImuRecord, sd.Scenario)):
        raise InputError(f"{sensors} is no simulated record; give a record of `strapdown simulate`, or a scenario")
    paths = sd.export(filter_file, source, folder=out, to=to, precision=precision)
    console.print(f"Filter of {filter_file} with the sensors of {sensors}, {precision} precision.")
    written(*paths)


@command
def info() -> None:
    """Print the versions and the processor features used by compiled code."""
    import strapdown
    from strapdown.kernels.machine import describe

    console.print(f"strapdown {strapdown.__version__}")
    for name, value in describe().items():
        console.print(f"{name}: {value}")
