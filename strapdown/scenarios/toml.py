"""Scenarios as TOML files with the units in the names of their keys; the built-in ones are such files in this package."""

from __future__ import annotations

import dataclasses
import functools
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import gyro, motion, vectors
from strapdown.checks import InputError, instance, known_keys, one_of
from strapdown.files import reading, tables
from strapdown.files.tables import Form
from strapdown.gyro import GyroSpec
from strapdown.motion import Motion
from strapdown.motion.orbit import CircularOrbit
from strapdown.results import Column, Table
from strapdown.scenarios.scenario import Scenario, Temperature
from strapdown.vectors import Sensor

BUILTIN = Path(__file__).parent / "builtin"

SCENARIOS: tuple[str, ...] = tuple(sorted(path.stem for path in BUILTIN.glob("*.toml")))
"""Names of the built-in scenarios."""

_OWN = ("harmonics", "faults", "orbit", "acceleration_f")
"""Fields that are not keys: tables, and functions, which cannot be written to a file."""


def _form(kind: Any, units: Form) -> Form:
    """Return the keys of a class; a field that is not in ``units`` is a plain number or word."""
    return {
        entry.name: units.get(entry.name, tables.PLAIN) for entry in dataclasses.fields(kind) if entry.name not in _OWN
    }


_OF_MOTIONS: Form = {
    **dict.fromkeys(("angle", "rock_angle", "rock_phase", "rotation_vector"), tables.DEGREES),
    **dict.fromkeys(("rate", "spin_rate", "precession_rate", "initial_rate", "mean"), tables.DEGREES_PER_SECOND),
    **dict.fromkeys(("frequency", "rock_frequency"), tables.HERTZ),
    **dict.fromkeys(("duration", "start", "time"), tables.SECONDS),
    "inertia": (("kg_m2", 1.0),),
    "ends": tables.TEXT,
}
MOTIONS: dict[str, tuple[type, Form]] = {
    word: (kind, _form(kind, _OF_MOTIONS))
    for word, kind in {
        "coning": motion.Coning,
        "spin-cone": motion.SpinCone,
        "constant-rate": motion.ConstantRate,
        "spin-rock": motion.SpinRock,
        "slew": motion.Slew,
        "torque-free": motion.TorqueFree,
        "sampled": motion.SampledAttitude,
        "harmonic-rates": motion.HarmonicRates,
    }.items()
}
"""Motions by their ``type`` in a file, in addition to "rest" and "composed" (tables ``base`` and ``vibration``)."""

HARMONIC: Form = {"amplitude": tables.DEGREES_PER_SECOND, "frequency": tables.HERTZ, "phase": tables.DEGREES}
ORBIT: Form = {"altitude": (("km", 1e3), ("m", 1.0)), "inclination": tables.DEGREES, "phase": tables.DEGREES}

_OF_SENSORS: dict[str, tables.Choice] = {
    **dict.fromkeys(("name", "kind"), tables.TEXT),
    "rate": tables.HERTZ,
    **dict.fromkeys(("phase", "latency", "outages", "correlation_time", "duty_period"), tables.SECONDS),
    **dict.fromkeys(("field_f", "hard_iron"), tables.NANOTESLAS),
    **dict.fromkeys(("bias", "gravity_f"), tables.METRES_PER_SECOND_SQUARED),
    **dict.fromkeys(("lever_arm_b", "baseline_b"), tables.METRES),
}
SENSORS: dict[str, tuple[type, Form, Form]] = {
    word: (
        kind,
        _form(kind, _OF_SENSORS | dict.fromkeys(("sigma", "sigma_across", "sigma_about"), unit)),
        _form(vectors.Faults, _OF_SENSORS | {"correlated_sigma": unit}),
    )
    for word, (kind, unit) in {
        "direction": (vectors.VectorSensor, tables.ARCSECONDS),
        "attitude": (vectors.AttitudeSensor, tables.ARCSECONDS),
        "magnetometer": (vectors.Magnetometer, tables.NANOTESLAS),
        "accelerometer": (vectors.Accelerometer, tables.METRES_PER_SECOND_SQUARED),
        "horizon": (vectors.HorizonSensor, tables.ARCSECONDS),
        "heading-pair": (vectors.HeadingPair, tables.METRES),
    }.items()
}
"""Sensors by their ``type`` in a file: class, keys, keys of its faults. A horizon sensor has a table ``orbit``, and a magnetometer may have
one instead of its field."""

TOP_FORM: Form = {
    "name": tables.TEXT,
    "description": tables.TEXT,
    "seed": tables.PLAIN,
    "rate": tables.HERTZ,
    "duration": tables.SECONDS,
    "gravity_f": tables.METRES_PER_SECOND_SQUARED,
}
_PARTS = ("motion", "gyro", "temperature", "sensors")
TEMPERATURE: Form = {"start": tables.DEGREES_CELSIUS, "end": tables.DEGREES_CELSIUS, "time_constant": tables.SECONDS}


def load_scenario(name_or_path: str | os.PathLike[str]) -> Scenario:
    """Return a built-in scenario by its name, or the scenario of a TOML file.

    Parameters
    ----------
    name_or_path : str or path
        A name of :data:`SCENARIOS`, or a path.

    Returns
    -------
    Scenario
        Scenario in SI units and radians, whatever the units of the keys.

    Examples
    --------
    >>> from strapdown import scenarios
    >>> scenarios.load_scenario("two-stars").rate
    100.0
    """
    text = os.fspath(name_or_path)
    path = Path(text)
    if not path.exists():
        if path.suffix == ".toml":
            raise InputError(f"{path} does not exist; give a TOML file, or a built-in name: {', '.join(SCENARIOS)}")
        path = _builtin_path(text)
    with reading.from_file(path):
        return _from_table(reading.toml(path), path.name)


def scenario_from_toml(text: str, place: str = "scenario") -> Scenario:
    """Return the scenario in a TOML text."""
    return _from_table(reading.from_toml(text, place), place)


LARGEST_NUMBER = 1e30
"""Maximum of a number in a file, in any unit; squares and products of larger ones overflow."""
MAX_MEASUREMENTS = 1e8
"""Maximum number of measurements of one sensor; more do not fit into memory."""


def _numbers(place: str, content: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers in a TOML table with their places."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _numbers(f"{place}.{key}" if place else key, value)
    elif isinstance(content, list):
        for k, value in enumerate(content):
            yield from _numbers(f"{place}[{k}]", value)
    elif isinstance(content, (int, float)) and not isinstance(content, bool):
        yield place, content


def _from_table(table: dict[str, Any], place: str) -> Scenario:
    for key, number in _numbers("", table):
        # Infinity is valid, as for a time that never comes.
        if LARGEST_NUMBER < abs(number) <= float(np.finfo(float).max):
            raise InputError(f"{place}: {key} is {number:g}, which is impossible; check it and its unit")
    known_keys(place, table, (*tables.keys(TOP_FORM), *_PARTS))

    def part(name: str) -> tuple[dict[str, Any], str]:
        return tables.subtable(table.get(name, {}), f"{place}: {name}"), f"{place}: {name}"

    parts: dict[str, Any] = {}
    parts["gyro_preset"], parts["gyro"] = _read_gyro(*part("gyro"))
    if "motion" in table:
        parts["motion"] = _read_motion(*part("motion"))
    if "temperature" in table:
        content, where = part("temperature")
        parts["temperature"] = tables.build(Temperature, content, TEMPERATURE, where)
    parts["sensors"] = [_read_sensor(*entry) for entry in _entries(table.get("sensors", []), "sensors", place)]
    own = {key: value for key, value in table.items() if key not in _PARTS}
    scenario: Scenario = tables.build(Scenario, own, TOP_FORM, place, **parts)
    for sensor in scenario.sensors:
        number = scenario.duration * getattr(sensor, "rate", 0.0)
        if number > MAX_MEASUREMENTS:
            raise InputError(
                f"{place}: {sensor.name} would measure {number:.3g} times, more than {MAX_MEASUREMENTS:.0e}; lower its rate or the duration"
            )
    return scenario


def _entries(content: Any, header: str, place: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield each table of a list in a file, with its place."""
    name = header.rpartition(".")[2]
    if not isinstance(content, list):
        raise InputError(f"{place}: {name} is one table; write [[{header}]] with two brackets")
    for i, entry in enumerate(content):
        yield tables.subtable(entry, f"{place}: {name}[{i}]"), f"{place}: {name}[{i}]"


def _word(table: dict[str, Any], place: str, choices: Any) -> str:
    if "type" not in table:
        raise InputError(f"{place}: type is missing; add one of {', '.join(choices)}")
    return one_of(f"{place}: type", table.pop("type"), choices)


def _read_motion(table: dict[str, Any], place: str) -> Motion:
    word = _word(table, place, [*MOTIONS, "rest", "composed"])
    if word == "rest":
        rest: Form = {"initial_attitude": tables.PLAIN}
        return tables.build(motion.ConstantRate, table, rest, place, rate=np.zeros(3))  # type: ignore[no-any-return]
    if word == "composed":
        known_keys(place, table, ("base", "vibration"))
        parts = {
            key: _read_motion(tables.subtable(table.get(key), f"{place}: {key}"), f"{place}: {key}")
            for key in ("base", "vibration")
        }
        return motion.Composed(**parts)
    kind, form = MOTIONS[word]
    more: dict[str, Any] = {}
    if kind is motion.HarmonicRates:
        entries = _entries(table.pop("harmonics", []), "motion.harmonics", place)
        more["harmonics"] = tuple(tables.build(motion.Harmonic, h, HARMONIC, where) for h, where in entries)
    return tables.build(kind, table, form, place, **more)  # type: ignore[no-any-return]


def _write_motion(body: Motion) -> dict[str, Any]:
    if isinstance(body, motion.Composed):
        return {"type": "composed", "base": _write_motion(body.base), "vibration": _write_motion(body.vibration)}
    for word, (kind, form) in MOTIONS.items():
        if type(body) is kind:
            table = {"type": word, **tables.encode(body, form)}
            if isinstance(body, motion.HarmonicRates):
                table["harmonics"] = [tables.encode(h, HARMONIC) for h in body.harmonics]
            return table
    raise InputError(f"a motion of class {type(body).__name__} cannot be written to a file; keep it in Python")


def _read_gyro(table: dict[str, Any], place: str) -> tuple[str, GyroSpec]:
    name = table.pop("preset", "")
    if not name:
        return "", gyro.from_table(table, place)
    presets = gyro.datasheets.PRESETS
    spec = presets[one_of(f"{place}: preset", name, presets)].spec
    return ("", gyro.from_table(table, place, spec)) if table else (name, spec)


def _read_sensor(table: dict[str, Any], place: str) -> Sensor:
    word = _word(table, place, SENSORS)
    kind, form, faults = SENSORS[word]
    orbit = table.pop("orbit", None) if word in ("magnetometer", "horizon") else None
    known_keys(place, table, {**tables.keys(form), **tables.keys(faults)})
    amiss = {key: table.pop(key) for key in list(table) if key in tables.keys(faults)}
    more: dict[str, Any] = {"faults": tables.build(vectors.Faults, amiss, faults, place)}
    if orbit is not None:
        orbit_place = f"{place}: orbit"
        circular = tables.build(CircularOrbit, tables.subtable(orbit, orbit_place), ORBIT, orbit_place)
        more.update({"orbit": circular} if word == "horizon" else {"field_f": circular.magnetic_field})
    elif word == "horizon":
        raise InputError(f"{place}: orbit is missing; add the table [sensors.orbit]")
    return tables.build(kind, table, form, place, **more)  # type: ignore[no-any-return]


def _write_sensor(sensor: Any) -> dict[str, Any]:
    word = next((word for word, (kind, _, _) in SENSORS.items() if type(sensor) is kind), None)
    if word is None:
        raise InputError(f"a sensor of class {type(sensor).__name__} cannot be written to a file; keep it in Python")
    _, form, faults = SENSORS[word]
    field, orbit = getattr(sensor, "field_f", None), getattr(sensor, "orbit", None)
    if callable(field):
        orbit = getattr(field, "__self__", None)
        form = {name: choice for name, choice in form.items() if name != "field_f"}
    for name in ("acceleration_f", "field_f"):
        if callable(getattr(sensor, name, None)) and not isinstance(orbit, CircularOrbit):
            raise InputError(
                f"{sensor.name}: {name} is a function, which cannot be written to a file; keep it in Python"
            )
    table = {"type": word, **tables.encode(sensor, form), **tables.encode(sensor.faults, faults)}
    return table if orbit is None else {**table, "orbit": tables.encode(orbit, ORBIT)}


def scenario_to_table(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as the table of its TOML file."""
    table: dict[str, Any] = {}
    for key in ("name", "description"):
        if getattr(scenario, key):
            table[key] = getattr(scenario, key)
    table.update(seed=scenario.seed, rate_hz=scenario.rate, duration_s=scenario.duration)
    if scenario.gravity_f != tuple(vectors.GRAVITY_F):
        table["gravity_f_m_per_s2"] = list(scenario.gravity_f)
    table["motion"] = _write_motion(scenario.motion)
    table["gyro"] = {"preset": scenario.gyro_preset} if scenario.gyro_preset else gyro.to_table(scenario.gyro)
    if scenario.temperature is not None:
        table["temperature"] = tables.encode(scenario.temperature, TEMPERATURE)
    table["sensors"] = [_write_sensor(sensor) for sensor in scenario.sensors]
    return table


def scenario_to_toml(scenario: Scenario) -> str:
    """Return a scenario as TOML text, with the unit in each key; reading it gives a bitwise equal scenario."""
    import tomli_w

    text = tomli_w.dumps(scenario_to_table(scenario))
    # A list of numbers on one line.
    return re.sub(
        r"\[\n((?: +[^\[\]{}\"\n]+,\n)+) *\]", lambda match: f"[{' '.join(match[1].split()).rstrip(',')}]", text
    )


def as_scenario(scenario: Scenario | str | os.PathLike[str]) -> Scenario:
    """Return a scenario from a Scenario, a built-in name, or the path of its TOML file."""
    remedy = "give a Scenario, a built-in name, or the path of a TOML file"
    instance("scenario", scenario, (Scenario, str, os.PathLike), remedy)
    return scenario if isinstance(scenario, Scenario) else load_scenario(scenario)


def _builtin_path(name: str) -> Path:
    return BUILTIN / f"{one_of('scenario', name, SCENARIOS)}.toml"


def builtin_toml(name: str) -> str:
    """Return the TOML file of a built-in scenario, with its comments, as a template of your own.

    Examples
    --------
    >>> from strapdown import scenarios
    >>> scenarios.builtin_toml("cubesat").splitlines()[0]
    'name = "cubesat"'
    """
    return reading.text(_builtin_path(name))


@functools.cache
def builtin() -> Table:
    """Return the built-in scenarios as a table."""
    contents = {name: reading.toml(BUILTIN / f"{name}.toml") for name in SCENARIOS}
    rows = [
        (name, table["duration_s"], table["rate_hz"], table["gyro"].get("preset", "own figures"))
        for name, table in contents.items()
    ]
    columns = ("name", Column("s", digits=6), Column("Hz", digits=6), "gyro")
    notes = [f"{name}: {table['description']}" for name, table in contents.items()]
    return Table("Built-in scenarios: `strapdown simulate NAME`", columns, rows, notes)
