"""Keys of a scenario file."""

from __future__ import annotations

from typing import Annotated

import typer

from strapdown.cli.terminal import command, console, say, show, table


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
        rows = table(title, "key", "unit", "value", "default", "meaning", left=5)
        for key in one.keys:
            names = " or ".join((key.name, *key.others))
            rows.add_row(names, key.unit, key.type, key.default.replace("`", ""), key.meaning.replace("`", ""))
        say(one.summary.replace("`", ""))
        show(rows)
        console.print(f"Example:\n{reference.example(one)}")
    if section is None:
        console.print("The keys of one section: strapdown keys SECTION, such as gyro or coning.")
