"""A filter setup as a table of a TOML document, with units in the names of its keys; it is read back bit for bit."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from strapdown import coning, gyro
from strapdown.checks import InputError, known_keys, one_of
from strapdown.estimation.filters.own import Own
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.setup import states as optional
from strapdown.estimation.setup.filter_setup import MEKF, FilterSetup, sensor_sigma
from strapdown.estimation.states import ProcessNoise
from strapdown.files import reading, tables

_NOISE_FORM: tables.Form = {name: gyro.FORM[name] for name in ("angle_random_walk", "rate_random_walk")}
_FORM: tables.Form = {
    "attitude_sigma": tables.DEGREES,
    "bias_sigma": tables.DEGREES_PER_HOUR,
    "measurement_sigma_factor": tables.RATIO,
}
_GATE_FORM: tables.Form = {
    "probability": tables.RATIO,
    "recovery": tables.PLAIN,
    "restart_attitude_sigma": tables.DEGREES,
    "restart_bias_sigma": tables.DEGREES_PER_HOUR,
}
_ROBUST_FORM: tables.Form = {
    "kind": tables.PLAIN,
    "probability": tables.RATIO,
    "degrees_of_freedom": tables.RATIO,
    "iterations": tables.PLAIN,
}
_PARTS = ("integration", "sigma", "gate", "robust", "states", "estimator")
NO_RECOVERY = 0
"""Value of ``recovery`` in a file for a gate that never recovers, as TOML has no null."""


def to_table(setup: FilterSetup) -> dict[str, Any]:
    """Return a setup as the table of its file."""
    table = {**tables.encode(setup.process_noise, _NOISE_FORM), **tables.encode(setup, _FORM)}
    own = setup.integration.name not in coning.ALGORITHMS
    table["integration"] = setup.integration.to_table() if own else setup.integration.name
    if setup.sigma:
        table["sigma"] = {name: list(s) if isinstance(s, tuple) else s for name, s in setup.sigma.items()}
    if setup.gate is not None:
        table["gate"] = tables.encode(setup.gate, _GATE_FORM)
        if setup.gate.recovery is None:
            table["gate"]["recovery"] = NO_RECOVERY
    if setup.robust is not None:
        table["robust"] = tables.encode(setup.robust, _ROBUST_FORM)
    if setup.states is not None:
        table["states"] = optional.to_table(setup.states)
    if setup.estimator != MEKF:
        table["estimator"] = setup.estimator.table if isinstance(setup.estimator, Own) else setup.estimator
    return table


def from_table(table: Mapping[str, Any], place: str = "filter") -> FilterSetup:
    """Return the setup in a table; an unknown key is an error that names the nearest known one."""
    known_keys(place, table, {*tables.keys(_NOISE_FORM), *tables.keys(_FORM), *_PARTS})
    sections = {name: table[name] for name in _PARTS if name in table}
    for name in ("sigma", "gate", "robust", "states"):
        if name in sections:
            sections[name] = tables.subtable(sections[name], f"{place}: {name}", f", [{place}.{name}]")
    noise = {key: table[key] for key in tables.keys(_NOISE_FORM) if key in table}
    parts: dict[str, Any] = {}
    if "integration" in sections:
        algorithm = sections["integration"]
        if isinstance(algorithm, Mapping):
            parts["integration"] = coning.Algorithm.from_table(algorithm, f"{place}: integration")
        else:
            parts["integration"] = coning.ALGORITHMS[one_of(f"{place}: integration", algorithm, coning.ALGORITHMS)]
    if "sigma" in sections:
        parts["sigma"] = {name: sensor_sigma(f"{place}: sigma: {name}", s) for name, s in sections["sigma"].items()}
    if "gate" in sections:
        never = {"recovery": None} if sections["gate"].get("recovery") == NO_RECOVERY else {}
        gate = {key: value for key, value in sections["gate"].items() if key not in never}
        parts["gate"] = tables.build(Gate, gate, _GATE_FORM, f"{place}: gate", **never)
    if "robust" in sections:
        parts["robust"] = tables.build(Robust, sections["robust"], _ROBUST_FORM, f"{place}: robust")
    if "states" in sections:
        parts["states"] = optional.from_table(sections["states"], f"{place}: states")
    if "estimator" in sections:
        estimator = sections["estimator"]  # a table describes a user's filter, whose code is in no file
        own = isinstance(estimator, Mapping) and "name" in estimator
        parts["estimator"] = Own(estimator) if own else str(estimator)
    parts["process_noise"] = tables.build(ProcessNoise, noise, _NOISE_FORM, place)
    rest = {key: value for key, value in table.items() if key not in {*noise, *sections}}
    return tables.build(FilterSetup, rest, _FORM, place, **parts)  # type: ignore[no-any-return]


def to_toml(setup: FilterSetup) -> str:
    """Return a setup as TOML text with the table ``[filter]``, with units in the names of its keys; :func:`read_setup` reads it."""
    import tomli_w

    sensors = setup.sigma or (setup.states is not None and setup.states.sensors)
    note = "# sigma of sensors: rad, or for whole vectors the unit of their reference\n" if sensors else ""
    return note + tomli_w.dumps({"filter": to_table(setup)})


def from_toml(text: str, place: str = "filter") -> FilterSetup:
    """Return the setup in the table ``[filter]`` of a TOML text, as from :func:`to_toml`."""
    table = reading.from_toml(text, place).get("filter")
    if not isinstance(table, dict):
        raise InputError(f"{place} has no table [filter]")
    return from_table(table, place)


def read_setup(path: str | os.PathLike[str]) -> FilterSetup:
    """Read the table ``[filter]`` of a TOML file, as written by ``strapdown tune``; other tables are ignored.

    Parameters
    ----------
    path : path
        TOML file; keys have their units in their names.

    Returns
    -------
    FilterSetup
        Setup of the table, in SI units and radians.
    """
    if ".py" in (Path(path).suffix, Path(path).name.partition(":")[0][-3:]):
        raise InputError(f"{path} is a filter of your own, which only a Monte Carlo runs; give a TOML file here")
    return tables.read(path, "filter", "`strapdown tune` writes one", from_table)
