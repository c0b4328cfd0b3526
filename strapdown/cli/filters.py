"""The filter that a command runs on a record: from a file, or matched to the specification of the record."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from strapdown.checks import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from strapdown.estimation.filters.own import Own
    from strapdown.estimation.setup import FilterSetup
    from strapdown.records import ImuRecord
    from strapdown.scenarios import Scenario


ChosenStates = tuple[str, ...] | Literal[False] | None
"""Names of error states: empty, one for each specified error; False, none; None, one for each if any error is specified."""


def filter_for(
    path: Path,
    record: ImuRecord,
    gyro: Path | None,
    filter_file: Path | None,
    states: ChosenStates,
) -> tuple[FilterSetup, list[str]]:
    """Return the filter of a file, or one that matches the gyro's specification and the record's sensors; and remarks to print."""
    from strapdown.estimation import setup
    from strapdown.estimation.setup.for_record import unmodelled_errors
    from strapdown.gyro import read_spec

    if filter_file is not None:
        if states is not None:
            raise InputError(
                "--filter contains the filter's states in [filter.states]; leave --states, --no-states and --state out"
            )
        chosen = setup.read_setup(filter_file)
        need_angles(filter_file, chosen, record)
        return chosen, no_state_words(unmodelled_errors(record.origin, chosen), chosen)
    spec = None if gyro is None else read_spec(gyro)
    if spec is None and (record.origin is None or record.origin.gyro is None):
        raise InputError(f"{path} does not contain the gyro's specification; give --gyro or --filter, a TOML file")
    chosen = setup.FilterSetup.for_record(record, spec, states=True if states == () else states)
    missing = unmodelled_errors(record.origin, chosen)
    if states is False or (states is None and chosen.states is None):
        return chosen, no_state_words(missing, chosen)
    remarks = []
    if record.origin is None or record.origin.scenario is None:
        remarks.append(
            f"{path.name} does not contain its scenario, so the errors of its sensors are unknown: no state for them."
        )
    if chosen.states is None:
        remarks.append("No errors are specified that need optional states; the filter has none.")
    elif states is None:
        remarks.append(default_words(chosen.states.names))
    else:
        remarks.append(f"Optional states: {', '.join(chosen.states.names)}.")
    return chosen, [*remarks, *([f"Still without a state: {', '.join(missing)}."] if missing else [])]


def default_words(names: Sequence[str]) -> str:
    """Return the reason why a filter has error states by default."""
    return (
        f"The filter has states for the specified errors, {', '.join(names)}: without them its σ would be too small "
        "(--no-states omits them)."
    )


def need_angles(filter_file: Path, chosen: FilterSetup, record: ImuRecord) -> None:
    """Raise an error for σ of the record's sensors that cannot be in rad, unless the record's own are as large."""
    from strapdown.estimation import setup

    fine = {one.sensor: one.kind for one in record.vectors if len(one.time) and np.max(one.sigma) <= np.pi}
    setup.need_angles(chosen, fine, f"{filter_file}: filter")


def filter_of_scenario(filter_file: Path, scenario: Scenario) -> FilterSetup:
    """Read a filter for the sensors of a scenario."""
    from strapdown.estimation import setup

    chosen = setup.read_setup(filter_file)
    kinds = {sensor.name: str(getattr(sensor, "kind", "attitude")) for sensor in scenario.sensors}
    setup.need_angles(chosen, kinds, f"{filter_file}: filter")
    return chosen


def own_filter(place: Path) -> Own | None:
    """Return the filter of a Python file, ``FILE.py:NAME``, which is executed; None for any other file."""
    from strapdown.cli.terminal import console
    from strapdown.estimation.filters.own import read_filter

    if not (place.suffix == ".py" or ".py:" in place.name):
        return None
    console.print(f"Executing {place.name.partition(':')[0]} with your permissions.")
    return read_filter(place)


def no_state_words(missing: tuple[str, ...], chosen: FilterSetup) -> list[str]:
    """Return a message about errors for which a filter has no state, with a remedy; empty if there are none."""
    if not missing:
        return []
    remedy = "; --states of `strapdown estimate` and `strapdown tune` adds states for most of them"
    return [
        f"The record specifies errors for which this filter has no state: {', '.join(missing)}{remedy if chosen.states is None else ''}."
    ]
