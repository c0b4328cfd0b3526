"""Scenarios and their simulation."""

from __future__ import annotations

from pathlib import Path

from typer import Argument, Option

import strapdown as sd
from strapdown.cli import terminal as ui
from strapdown.cli.options import SCENARIO
from strapdown.files import HDF5


@ui.command()
def scenarios(
    name: str | None = Argument(None, help="Built-in scenario, whose TOML file is printed as a template of your own."),
) -> None:
    """List the built-in scenarios, or print the TOML file of one."""
    if name is None:
        ui.show(sd.scenarios.builtin())
    else:
        ui.say(sd.scenarios.builtin_toml(name).rstrip())


@ui.command()
def keys(
    section: str | None = Argument(
        None, help="top, motion, gyro or sensors, or a type of motion or sensor, such as coning or magnetometer."
    ),
) -> None:
    """Print the keys of a scenario file with units, defaults and an example. Without a section: all sections."""
    from strapdown.scenarios import keys as reference

    if section is None:
        ui.say(*map(reference.heading, reference.sections()))
        ui.say("The keys of one section: strapdown keys SECTION, such as gyro or coning.")
    else:
        ui.say(*map(reference.described, reference.named(section)))


@ui.command()
def simulate(
    scenario: str = Argument(help=SCENARIO),
    out: Path | None = Option(None, help="HDF5 file. Default: .h5 with the name, or the TOML file, of the scenario."),
    seed: int | None = Option(None, help="Seed. Default: that of the scenario."),
) -> None:
    """Simulate a scenario: a record with its truth."""
    loaded = sd.scenarios.load_scenario(scenario)
    target = out or Path(f"{Path(scenario).stem}.h5")
    ui.check_files(target, suffixes=HDF5, own="strapdown record")
    with ui.progress_bar("simulating, writing"):
        record = sd.scenarios.simulate(loaded, seed)
        sd.write(record, target)
    ui.show(record.listing())
    ui.written(target)
