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
    filter_file: Annotated[Path, typer.Argument(metavar="FILTER", help="TOML file of a filter setup.")],
    sensors: Annotated[
        str,
        typer.Argument(
            metavar="SENSORS", help="Simulated record or scenario (name or TOML file) whose sensors the filter uses."
        ),
    ],
    to: Literal["c", "js"] = typer.Option("c", "--to", help="Language: C99, or JavaScript (an ES module)."),
    precision: Literal["double", "single"] = typer.Option("double", help="Precision of all numbers in C."),
    out: Path = typer.Option(Path("strapdown-filter"), help="Folder of the source code."),
) -> None:
    """Export a filter as source code for a microcontroller or a web page."""
    import strapdown

    paths = strapdown.export(filter_file, _sensors(sensors), folder=out, to=to, precision=precision)
    console.print(f"Filter of {filter_file} with the sensors of {sensors}, {precision} precision.")
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
