"""The filter that a record or a scenario gets, and what is said of its error states."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from strapdown import ahrs, allan, gyro
from strapdown.checks import Hint, InputError, instance, one_of
from strapdown.estimation import setup as setups
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise, State
from strapdown.gyro import GyroSpec
from strapdown.records import ImuRecord
from strapdown.scenarios import Scenario
from strapdown.units import DEGREE_PER_HOUR, STANDARD_GRAVITY

if TYPE_CHECKING:
    from strapdown.allan import NoiseFit


def specification_of(noise: GyroSpec | NoiseFit) -> GyroSpec:
    """Return the specification of a gyro, which may be given as a fit of its noise."""
    if isinstance(noise, allan.NoiseFit):
        return GyroSpec(**allan.to_gyro_parameters(noise))  # type: ignore[arg-type]
    instance("noise", noise, GyroSpec, "give a GyroSpec or a NoiseFit, for an estimate also a ProcessNoise")
    return noise


def gyro_of(preset_or_path: str) -> GyroSpec:
    """Return the specification of a preset, or of a TOML file."""
    if preset_or_path.endswith(".toml"):
        return gyro.read_spec(preset_or_path)
    presets = gyro.datasheets.PRESETS
    return presets[one_of("prior", preset_or_path, presets)].spec


def with_gyro_noise(parameters: ahrs.AhrsParameters, spec: GyroSpec) -> ahrs.AhrsParameters:
    """Return the parameters of a recorded unit with the noise of its gyro; flicker is approximated for the accuracy of the tilt."""
    density = (parameters.specific_force_noise / STANDARD_GRAVITY) ** 2  # rad² s
    noise: dict[str, Any] = gyro.matched_process_noise(spec, density)
    return dataclasses.replace(parameters, **noise)


def filter_for_record(
    record: ImuRecord,
    noise: GyroSpec | NoiseFit | ProcessNoise | None,
    setup: FilterSetup | None,
    initial: State | ArrayLike | str | None,
    states: bool | Sequence[str] | None,
    changes: Mapping[str, Any],
) -> tuple[FilterSetup, list[str]]:
    """Return the filter for a record, and remarks on errors and their states; ``changes``: fields of the filter beside them."""
    if setup is not None:
        remedy = "give a FilterSetup, as setup.FilterSetup.for_scenario or tune returns it"
        instance("setup", setup, FilterSetup, remedy)
        need_alone(noise, states)
        need_angles(setup, record)
        setup = dataclasses.replace(setup, **changes)
        return setup, setups.unmodelled_words(record.origin, setup)
    if not isinstance(noise, ProcessNoise):
        return matched_filter(
            record, None if noise is None else specification_of(noise), states=states, changes=changes
        )
    if not isinstance(initial, State):
        raise InputError(
            "noise is a ProcessNoise, which has no σ of the initial gyro bias; give initial= too, or a GyroSpec as noise"
        )
    if states:
        raise InputError(
            "states goes with a specified gyro; declare the states of your own filter in setup=; leave it out"
        )
    sigma = np.sqrt(np.diag(initial.covariance))
    return FilterSetup(
        process_noise=noise, attitude_sigma=float(np.max(sigma[:3])), bias_sigma=float(np.max(sigma[3:6])), **changes
    ), []


def need_alone(noise: Any, states: Any) -> None:
    """Raise an error for options that go with a matched filter, if a complete one is given."""
    for name, value in (("states", states), ("noise", noise)):
        if value is not None:
            raise InputError(
                f"{Hint('setup')} is the complete filter, with its noise and states; leave {Hint(name)} out"
            )


def need_angles(setup: FilterSetup, record: ImuRecord) -> None:
    """Raise an error for σ of the record's sensors that cannot be in rad, unless the record's own are as large."""
    fine = {
        vectors.sensor: vectors.kind
        for vectors in record.vectors
        if len(vectors.time) and np.max(vectors.sigma) <= np.pi
    }
    setups.need_angles(setup, fine, "filter")


def matched_filter(
    record: ImuRecord,
    spec: GyroSpec | None = None,
    *,
    states: bool | Sequence[str] | None = None,
    changes: Mapping[str, Any] | None = None,
) -> tuple[FilterSetup, list[str]]:
    """Return the filter that matches a record's specifications, with ``changes`` of its fields, and remarks on errors and their states."""
    filter_setup = dataclasses.replace(setups.FilterSetup.for_record(record, spec, states=states), **(changes or {}))
    notes = []
    if spec is not None and not np.any([spec.turn_on_bias, np.broadcast_to(spec.turn_on_bias_sigma, 3)]):
        notes.append(
            "The specification of the gyro has no turn-on bias, so its bias at the start is taken as zero, "
            f"±{filter_setup.bias_sigma / DEGREE_PER_HOUR:.3g} °/h (1 σ): add turn_on_bias_sigma to it."
        )
    if states is False or (states is None and filter_setup.states is None):
        return filter_setup, notes + setups.unmodelled_words(record.origin, filter_setup)
    if record.origin is None or record.origin.scenario is None:
        notes.append(
            "The record does not contain its scenario, so the errors of its sensors are unknown: no state for them."
        )
    if filter_setup.states is None:
        notes.append("No errors are specified that need optional states; the filter has none.")
    elif states is None:
        notes.append(state_words(filter_setup.states.names))
    else:
        notes.append(f"Optional states: {', '.join(filter_setup.states.names)}.")
    return filter_setup, notes + setups.unmodelled_words(record.origin, filter_setup)


def filter_for_scenario(
    scenario: Scenario,
    *,
    setup: FilterSetup | None = None,
    noise: GyroSpec | NoiseFit | None = None,
    states: bool | Sequence[str] | None = None,
) -> FilterSetup:
    """Return the filter for a scenario: ``setup``, or one that matches it, assuming the ``noise`` of another gyro if given."""
    if setup is None:
        assumed = scenario if noise is None else dataclasses.replace(scenario, gyro=specification_of(noise))
        return setups.FilterSetup.for_scenario(assumed, states=states)
    setups.need_setup(setup)
    need_alone(noise, states)
    kinds = {sensor.name: str(getattr(sensor, "kind", "attitude")) for sensor in scenario.sensors}
    setups.need_angles(setup, kinds, "filter")
    return setup


def state_words(names: Sequence[str]) -> str:
    """Return the reason why a filter has error states by default."""
    return (
        f"The filter has states for the specified errors, {', '.join(names)}: without them its σ would be too small "
        f"({Hint('states', False)} omits them)."
    )
