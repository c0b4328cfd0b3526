"""Scenarios and their simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from typer import Argument, Option

from strapdown.cli.progress import progress_bar
from strapdown.cli.terminal import SCENARIO, check_files, command, console, say, written
from strapdown.cli.terminal import show as show_tables


@command
def scenarios() -> None:
    """List the built-in scenarios."""
    from strapdown.scenarios import builtin

    show_tables(builtin())


@command
def keys(
    section: str | None = Argument(
        None, help="top, motion, gyro or sensors, or a type of motion or sensor, such as coning or magnetometer."
    ),
) -> None:
    """Print the keys of a scenario file with units, defaults and an example. Without a section: all sections."""
    from strapdown.scenarios import keys as reference

    for one in reference.sections() if section is None else reference.named(section):
        table = reference.listing(one)
        if section is None or not one.keys:
            console.print(table.title)
        else:
            show_tables(table)
            console.print(f"Example:\n{reference.example(one)}")
    if section is None:
        console.print("The keys of one section: strapdown keys SECTION, such as gyro or coning.")


@command
def simulate(
    scenario: str = Argument(help=SCENARIO),
    out: Path | None = Option(None, help="HDF5 file. Default: .h5 with the name, or the TOML file, of the scenario."),
    seed: int | None = Option(None, help="Seed. Default: that of the scenario."),
    show: bool = Option(False, "--show", help="Print the scenario as TOML, as a template for your own, and stop."),
) -> None:
    """Simulate a scenario: a record with its truth."""
    from strapdown import scenarios as catalogue
    from strapdown.recordings import recordfiles

    chosen = catalogue.load_scenario(scenario)
    toml = catalogue.scenario_to_toml(chosen)
    if show:
        console.print(toml)
        return
    used = chosen.seed if seed is None else seed
    target = out or Path(f"{Path(scenario).stem}.h5")
    own = recordfiles.is_record
    check_files(target, suffixes=(".h5", ".hdf5"), sources=(scenario,), own=own, command="simulate")
    with progress_bar("simulating, writing", 2) as advance:
        record = catalogue.simulate(chosen, used)
        advance(1)
        recordfiles.write_record(target, record)
        advance(1)
    length = record.time[-1] - record.time[0]
    say(f"{chosen.name or target.stem}: {len(record.increments)} gyro samples over {length:g} s, seed {used}.")
    for series in record.vectors:
        console.print(f"  {series.sensor}: {len(series.time)} measurements ({series.kind})")
        sigma = series.sigma if series.sigma_axes is None else series.sigma_axes
        if series.covariance is None and np.any(sigma == 0.0):
            console.print(
                f"warning: {series.sensor}: its sigma is zero, which a filter cannot use; add noise in the scenario, or give the filter "
                "another sigma in [filter.sigma]"
            )
    written(target)
