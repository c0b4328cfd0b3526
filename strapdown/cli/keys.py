"""Keys of a scenario file."""

from __future__ import annotations

from typing import Annotated

import typer

from strapdown.cli.terminal import command, console, show
from strapdown.results import Table


@command
def keys(
    section: Annotated[
        str | None,
        typer.Argument(
            help="top, motion, gyro or sensors, or a type of motion or sensor, such as coning or magnetometer."
        ),
    ] = None,
) -> None:
    """Print the keys of a scenario file with units, defaults and an example. Without a section: all sections."""
    from strapdown.scenarios import keys as reference

    for one in reference.sections() if section is None else reference.named(section):
        title = one.header + (f', type = "{one.type}"' if one.type else "")
        if section is None or not one.keys:
            console.print(f"{title}: {one.summary.replace('`', '')}")
            continue
        rows = [
            (
                " or ".join((key.name, *key.others)),
                key.unit,
                key.type,
                key.default.replace("`", ""),
                key.meaning.replace("`", ""),
            )
            for key in one.keys
        ]
        show(
            Table(
                f"{title}: {one.summary.replace('`', '')}", ("key", "unit", "value", "default", "meaning"), rows, left=5
            )
        )
        console.print(f"Example:\n{reference.example(one)}")
    if section is None:
        console.print("The keys of one section: strapdown keys SECTION, such as gyro or coning.")
