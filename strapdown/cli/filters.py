"""The filter that a command runs on a record: of a file, or matched to what the record tells."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from strapdown.recordfiles import RecordFile
    from strapdown.setup import FilterSetup


def filter_for(
    path: Path, held: RecordFile, gyro: Path | None, filter_file: Path | None, states: tuple[str, ...] | None
) -> tuple[FilterSetup, list[str]]:
    """Return the filter, and what to say of it: of a file, or matched to the gyro's specification and what the sensors say of themselves.

    ``states`` None: of attitude and bias alone; empty: with all states that the specified errors call for.
    """
    from strapdown import setup
    from strapdown.augmented import States
    from strapdown.checks import InputError
    from strapdown.gyro import read_spec
    from strapdown.scenarios import scenario_from_toml

    if filter_file is not None:
        if states is not None:
            raise InputError(
                "--filter tells the filter's states itself, in [filter.states]; leave --states and --state out"
            )
        return setup.read_setup(filter_file), []
    spec = held.gyro if gyro is None else read_spec(gyro)
    if spec is None:
        raise InputError(f"{path} does not tell the gyro's specification; give --gyro or --filter, a TOML file")
    if states is None:
        return setup.matched_to_record(spec, held.record), []
    if not held.scenario:
        chosen = setup.matched_to_record(spec, held.record, states=True)
        remarks = [
            f"{path.name} does not tell its scenario, so the errors of its sensors are not known: no state for them."
        ]
        missing = setup.not_covered(spec, (), chosen.states)
    else:
        scenario = scenario_from_toml(held.scenario, f"{path}: scenario")
        chosen = setup.matched_to_record(
            spec, held.record, states=True, sensors=scenario.sensors, gravity_f=scenario.gravity_f
        )
        remarks = []
    optional = chosen.states or States()
    if states:
        optional = optional.chosen(states)
    chosen = dataclasses.replace(chosen, states=optional)
    if held.scenario:
        missing = setup.not_covered(spec, scenario.sensors, optional, gravity_f=scenario.gravity_f)
    if not optional.names:
        remarks.append("No error is specified that would call for an optional state; the filter has none.")
        chosen = dataclasses.replace(chosen, states=None)
    else:
        remarks.append(f"Optional states: {', '.join(optional.names)}.")
    if missing:
        remarks.append(f"Still without a state: {', '.join(missing)}.")
    return chosen, remarks
