"""Scenarios: a motion, a gyro and sensors; simulating one gives a record with its truth.

A scenario can be a TOML file with the units in the names of its keys; the built-in ones (``SCENARIOS``) are such files in this package.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import gyro, motion, vectors
from strapdown.checks import Array, InputError, array, count, finite, instance, known_keys, one_of, positive
from strapdown.files import reading, tables
from strapdown.files.tables import Form
from strapdown.gyro import GyroSpec
from strapdown.motion import Motion
from strapdown.motion.orbit import CircularOrbit
from strapdown.randomness import generator
from strapdown.records import ImuRecord, Origin, Truth
from strapdown.results import Column, Table
from strapdown.vectors import Sensor

__all__ = ["SCENARIOS", "Scenario", "Temperature", "drawn", "load_scenario", "simulate"]

_BUILTIN = Path(__file__).parent / "builtin"

SCENARIOS: tuple[str, ...] = tuple(sorted(path.stem for path in _BUILTIN.glob("*.toml")))
"""Names of the built-in scenarios."""

MAX_SAMPLES = 1e9
"""Maximum number of gyro samples of a simulated record; more do not fit into memory."""


@dataclass(frozen=True, kw_only=True)
class Temperature:
    """Temperature of the unit: an exponential change, or without a time constant a linear change over the record.

    Parameters
    ----------
    start : float
        Temperature at the start, °C.
    end : float
        Final temperature of the exponential, or without a time constant the temperature at the end of the record, °C.
    time_constant : float, default inf
        Thermal time constant, s; infinite: linear change.
    """

    start: float
    end: float
    time_constant: float = np.inf

    def __post_init__(self) -> None:
        """Check all."""
        finite("start", self.start, unit="°C")
        finite("end", self.end, unit="°C")
        if self.time_constant != np.inf:
            positive("time_constant", self.time_constant, unit="s")

    def _at(self, time: Array) -> Array:
        """Return the temperature at the edges of a record (n + 1,), °C."""
        elapsed = time - time[0]
        share = elapsed / elapsed[-1] if self.time_constant == np.inf else -np.expm1(-elapsed / self.time_constant)
        return np.asarray(self.start + (self.end - self.start) * share)


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A motion, a gyro and sensors, with sample rate and duration.

    Parameters
    ----------
    motion : Motion
        True attitude and body rate over time (:mod:`strapdown.motion`).
    gyro : GyroSpec
        Specification of the gyro's errors.
    sensors : tuple of Sensor
        Vector, attitude and heading sensors (:mod:`strapdown.vectors`), each with a different name.
    rate : float
        Sample rate of the gyro, Hz.
    duration : float
        Duration of the record, s; rounded to whole gyro samples.
    name : str, default ""
        Name in files and tables.
    description : str, default ""
        Description in one sentence.
    seed : int, default 0
        Default seed of :func:`simulate`.
    gravity_f : tuple of 3 floats, default (0, 0, -9.80665)
        Gravity, m/s², fixed frame; a g-sensitive gyro responds to its reaction. Zeros in free fall.
    gyro_preset : str, default ""
        Name of the preset equal to ``gyro``, for files.
    temperature : Temperature, optional
        Temperature of the unit, °C, on which the gyro's bias may depend; it is recorded. Default: none.

    Examples
    --------
    >>> import strapdown as sd
    >>> scenario = sd.Scenario(
    ...     motion=sd.motion.Coning(angle=0.7 * sd.units.DEGREE, frequency=10.0),
    ...     gyro=sd.GyroSpec(angle_random_walk=0.08 * sd.units.DEGREE_PER_ROOT_HOUR),
    ...     sensors=(sd.VectorSensor(name="star", reference_f=[1.0, 0.0, 0.0], sigma=1e-4, rate=1.0),),
    ...     rate=100.0,
    ...     duration=60.0,
    ... )
    >>> len(scenario.edges)
    6001
    """

    motion: Motion
    gyro: GyroSpec
    sensors: tuple[Sensor, ...]
    rate: float
    duration: float
    name: str = ""
    description: str = ""
    seed: int = 0
    gravity_f: tuple[float, ...] = vectors.GRAVITY_F
    gyro_preset: str = ""
    temperature: Temperature | None = None

    def __post_init__(self) -> None:
        """Check rate, duration, and the names of the sensors."""
        positive("rate", self.rate, unit="Hz")
        positive("duration", self.duration, unit="s")
        if self.duration * self.rate > MAX_SAMPLES:
            raise InputError(
                f"{self.duration:g} s at {self.rate:g} Hz are {self.duration * self.rate:.3g} gyro samples, more than {MAX_SAMPLES:.0e}; "
                "shorten the run or lower the rate"
            )
        count("seed", self.seed, minimum=0)
        if any(mark in self.name for mark in "/\\\0\n") or self.name.startswith("."):
            raise InputError(
                f"name is {self.name!r}, which is used in file names: leave out slashes, line breaks and leading dots"
            )
        object.__setattr__(self, "sensors", tuple(self.sensors))
        object.__setattr__(self, "gravity_f", tuple(array("gravity_f", self.gravity_f, (3,)).tolist()))
        names = [sensor.name for sensor in self.sensors]
        for name in names:
            if not str(name).strip():
                raise InputError("a sensor has no name; give each sensor a different name")
            if names.count(name) > 1 or name.startswith("gyro"):
                raise InputError(
                    f"two sensors are named {name!r}, or it begins with 'gyro'; give each sensor a different name"
                )

    @property
    def edges(self) -> Array:
        """Nominal edges of the gyro's sample intervals (n + 1,), s, from 0."""
        return np.arange(round(self.duration * self.rate) + 1) / self.rate


def as_scenario(scenario: Scenario | str | os.PathLike[str]) -> Scenario:
    """Return a scenario from a Scenario, a built-in name, or the path of its TOML file."""
    instance(
        "scenario",
        scenario,
        (Scenario, str, os.PathLike),
        "give a Scenario, a built-in name, or the path of a TOML file",
    )
    return scenario if isinstance(scenario, Scenario) else load_scenario(scenario)


def simulate(scenario: Scenario | str | os.PathLike[str], seed: int | None = None, run: int = 0) -> ImuRecord:
    """Simulate one run of a scenario: gyro increments, vector measurements and the truth.

    Each sensor has its own random stream (seed, run, name), so adding one does not change the others. With sampling jitter, the truth is
    given at the actual sampling instants and the stamps are those that the gyro reports. Lost samples are bridged
    (:func:`strapdown.gyro.bridge_dropped`).

    Parameters
    ----------
    scenario : Scenario, str or path
        A scenario, the name of a built-in one (:data:`SCENARIOS`), or the path of its TOML file.
    seed : int, optional
        Seed of the random numbers. Default: that of the scenario.
    run : int, default 0
        Number of the run; runs with the same seed are independent.

    Returns
    -------
    ImuRecord
        Record with ``truth``, and with the scenario as ``origin``, to which :func:`strapdown.estimate` matches its filter.

    Examples
    --------
    >>> import strapdown as sd
    >>> record = sd.simulate("two-stars", seed=1)
    >>> record.truth.attitude.shape, [one.sensor for one in record.vectors]
    ((30001, 4), ['star 1', 'star 2'])
    """
    scenario = as_scenario(scenario)
    seed = scenario.seed if seed is None else seed
    spec, nominal = scenario.gyro, scenario.edges
    edges, stamps = gyro.sampling(spec, nominal, generator(seed, run, "gyro sampling"))
    force = None
    if np.any(spec.g_sensitivity != 0.0):
        middle = 0.5 * (edges[1:] + edges[:-1])
        force = vectors.specific_force(scenario.motion, middle, gravity_f=scenario.gravity_f)
    temperature = None if scenario.temperature is None else scenario.temperature._at(edges)
    output = gyro.simulate(
        spec,
        scenario.motion.increments(edges),
        edges,
        generator(seed, run, "gyro"),
        specific_force=force,
        temperature=temperature,
    )
    increments, bias = output.increments, output.bias
    if spec.drop_probability > 0.0:
        lost = gyro.dropped(spec, len(increments), generator(seed, run, "gyro losses"))
        increments, left = gyro.bridge_dropped(increments, stamps, lost)
        edges, stamps, bias = edges[left], stamps[left], bias[left]
        temperature = None if temperature is None else temperature[left]
    series = tuple(
        sensor.observe(scenario.motion, nominal[0], nominal[-1], generator(seed, run, sensor.name))
        for sensor in scenario.sensors
    )
    truth = Truth(attitude=scenario.motion.attitude(edges), bias=bias)
    origin = Origin(gyro=spec, scenario=scenario, seed=seed, run=run)
    return ImuRecord(
        time=stamps, increments=increments, vectors=series, truth=truth, origin=origin, temperature=temperature
    )


def drawn(scenario: Scenario, seed: int, run: int = 0) -> Scenario:
    """Return the scenario with randomly drawn units of its gyro and sensors: each fixed error is multiplied by a standard normal number.

    The fixed errors (scale factor, misalignment, sensitivity to acceleration, hard iron, a sensor's bias, lever arm) are interpreted as
    standard deviations, entry by entry, as in a datasheet. The coefficients of a bias over temperature get additive errors with their σ. A
    filter with a state for each error (``FilterSetup.for_scenario(scenario, states=True)``) is consistent on average over such units, and
    only approximately for a unit whose errors are all equal to one σ.

    Parameters
    ----------
    scenario : Scenario
        Scenario whose fixed errors are standard deviations.
    seed : int
        Seed of the random numbers.
    run : int, default 0
        Number of the unit; units with the same seed are independent.

    Returns
    -------
    Scenario
        Scenario with the drawn errors, without ``gyro_preset``.
    """
    draw = generator(seed, run, "individual")

    def each(errors: Array) -> Array:
        return np.asarray(np.asarray(errors) * draw.standard_normal(np.shape(errors)))

    errors: dict[str, Any] = {name: each(getattr(scenario.gyro, name)) for name in _FIXED_OF_THE_GYRO}
    warm = scenario.gyro.temperature
    if warm is not None:
        errors["temperature"] = dataclasses.replace(warm, coefficients=warm.coefficients + each(warm.sigma))
    spec = dataclasses.replace(scenario.gyro, **errors)
    sensors = []
    for sensor in scenario.sensors:
        own: dict[str, Any] = {name: each(getattr(sensor, name)) for name in _FIXED_OF_SENSORS if hasattr(sensor, name)}
        sensors.append(dataclasses.replace(sensor, **own))  # type: ignore[type-var]
    return dataclasses.replace(scenario, gyro=spec, gyro_preset="", sensors=tuple(sensors))


_FIXED_OF_THE_GYRO = ("scale_factor", "misalignment", "g_sensitivity")
_FIXED_OF_SENSORS = ("hard_iron", "bias", "lever_arm_b")


# ------------------------------------------------------------------------------------------------------------------------ files

_OWN = ("harmonics", "faults", "orbit", "acceleration_f")
"""Fields that are not keys: tables, and functions, which cannot be written to a file."""


def _form(kind: Any, units: Form) -> Form:
    """Return the keys of a class; a field that is not in ``units`` is a plain number or word."""
    return {one.name: units.get(one.name, tables.PLAIN) for one in dataclasses.fields(kind) if one.name not in _OWN}


_OF_MOTIONS: Form = {
    **dict.fromkeys(("angle", "rock_angle", "rock_phase", "rotation_vector"), tables.DEGREES),
    **dict.fromkeys(("rate", "spin_rate", "precession_rate", "initial_rate", "mean"), tables.DEGREES_PER_SECOND),
    **dict.fromkeys(("frequency", "rock_frequency"), tables.HERTZ),
    **dict.fromkeys(("duration", "start", "time"), tables.SECONDS),
    "inertia": (("kg_m2", 1.0),),
    "ends": tables.TEXT,
}
_MOTIONS: dict[str, tuple[type, Form]] = {
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

_HARMONIC: Form = {"amplitude": tables.DEGREES_PER_SECOND, "frequency": tables.HERTZ, "phase": tables.DEGREES}
_ORBIT: Form = {
    "altitude": (("km", 1e3), ("m", 1.0)),
    "inclination": tables.DEGREES,
    "phase": tables.DEGREES,
}

_OF_SENSORS: dict[str, tables.Choice] = {
    **dict.fromkeys(("name", "kind"), tables.TEXT),
    "rate": tables.HERTZ,
    **dict.fromkeys(("phase", "latency", "outages", "correlation_time", "duty_period"), tables.SECONDS),
    **dict.fromkeys(("field_f", "hard_iron"), tables.NANOTESLAS),
    **dict.fromkeys(("bias", "gravity_f"), tables.METRES_PER_SECOND_SQUARED),
    **dict.fromkeys(("lever_arm_b", "baseline_b"), tables.METRES),
}
_SENSORS: dict[str, tuple[type, Form, Form]] = {
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

_TOP_FORM: Form = {
    "seed": tables.PLAIN,
    "rate": tables.HERTZ,
    "duration": tables.SECONDS,
    "gravity_f": tables.METRES_PER_SECOND_SQUARED,
}
_TOP = ("name", "description", *tables.keys(_TOP_FORM), "motion", "gyro", "temperature", "sensors")
_TEMPERATURE: Form = {"start": tables.DEGREES_CELSIUS, "end": tables.DEGREES_CELSIUS, "time_constant": tables.SECONDS}


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
        path = _BUILTIN / f"{one_of('scenario', text, SCENARIOS)}.toml"
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
        if (
            LARGEST_NUMBER < abs(number) <= float(np.finfo(float).max)
        ):  # infinity is valid, as for a time that never comes
            raise InputError(f"{place}: {key} is {number:g}, which is impossible; check it and its unit")
    known_keys(place, table, _TOP)
    for key in ("rate_hz", "duration_s", "motion"):
        if key not in table:
            raise InputError(f"{place}: {key} is missing; add it")
    for key in ("name", "description"):
        if not isinstance(table.get(key, ""), str):
            raise InputError(f"{place}: {key} is {table[key]!r}; it must be a string")
    preset, spec = _read_gyro(tables.subtable(table.get("gyro", {}), f"{place}: gyro"), f"{place}: gyro")
    sensors = table.get("sensors", [])
    if not isinstance(sensors, list):
        raise InputError(f"{place}: sensors is one table; write [[sensors]] with two brackets")
    values = {
        "name": table.get("name", ""),
        "description": table.get("description", ""),
        "seed": table.get("seed", 0),
        "rate": table["rate_hz"],
        "duration": table["duration_s"],
        "gravity_f": table.get("gravity_f_m_per_s2", vectors.GRAVITY_F),
        "motion": _read_motion(tables.subtable(table["motion"], f"{place}: motion"), f"{place}: motion"),
        "gyro": spec,
        "gyro_preset": preset,
        "sensors": tuple(_read_sensor(entry, f"{place}: sensors[{i}]") for i, entry in enumerate(sensors)),
    }
    if "temperature" in table:
        where = f"{place}: temperature"
        values["temperature"] = tables.build(
            Temperature, tables.subtable(table["temperature"], where), _TEMPERATURE, where
        )
    made: Scenario = tables.construct(Scenario, values, table, _TOP_FORM, place)
    if made.duration * made.rate < 1.0:
        raise InputError(
            f"{place}: {made.duration:g} s at {made.rate:g} Hz are less than one gyro sample; increase the duration or the rate"
        )
    for sensor in made.sensors:
        number = made.duration * getattr(sensor, "rate", 0.0)
        if number > MAX_MEASUREMENTS:
            raise InputError(
                f"{place}: {sensor.name} would measure {number:.3g} times, more than {MAX_MEASUREMENTS:.0e}; lower its rate or the duration"
            )
    return made


def _word(table: dict[str, Any], place: str, choices: Any) -> str:
    if "type" not in table:
        raise InputError(f"{place}: type is missing; add one of {', '.join(choices)}")
    return one_of(f"{place}: type", table.pop("type"), choices)


def _read_motion(table: dict[str, Any], place: str) -> Motion:
    word = _word(table, place, [*_MOTIONS, "rest", "composed"])
    if word == "rest":
        form: Form = {"initial_attitude": tables.PLAIN}
        return tables.construct(motion.rest, tables.decode(table, form, place), table, form, place)  # type: ignore[no-any-return]
    if word == "composed":
        known_keys(place, table, ("base", "vibration"))
        parts = {
            key: _read_motion(tables.subtable(table.get(key), f"{place}: {key}"), f"{place}: {key}")
            for key in ("base", "vibration")
        }
        return motion.Composed(**parts)
    kind, form = _MOTIONS[word]
    more: dict[str, Any] = {}
    if kind is motion.HarmonicRates:
        entries = table.pop("harmonics", [])
        if not isinstance(entries, list):
            raise InputError(f"{place}: harmonics is one table; write [[motion.harmonics]] with two brackets")
        more["harmonics"] = tuple(
            tables.build(
                motion.Harmonic, tables.subtable(h, f"{place}: harmonics[{i}]"), _HARMONIC, f"{place}: harmonics[{i}]"
            )
            for i, h in enumerate(entries)
        )
    return tables.build(kind, table, form, place, **more)  # type: ignore[no-any-return]


def _write_motion(body: Motion) -> dict[str, Any]:
    if isinstance(body, motion.Composed):
        return {"type": "composed", "base": _write_motion(body.base), "vibration": _write_motion(body.vibration)}
    for word, (kind, form) in _MOTIONS.items():
        if type(body) is kind:
            table = {"type": word, **tables.encode(body, form)}
            if isinstance(body, motion.HarmonicRates):
                table["harmonics"] = [tables.encode(h, _HARMONIC) for h in body.harmonics]
            return table
    raise InputError(f"a motion of class {type(body).__name__} cannot be written to a file; keep it in Python")


def _read_gyro(table: dict[str, Any], place: str) -> tuple[str, GyroSpec]:
    name = table.pop("preset", "")
    if not name:
        return "", gyro.from_table(table, place)
    from strapdown.gyro import datasheets

    spec = datasheets.PRESETS[one_of(f"{place}: preset", name, datasheets.PRESETS)].spec
    return ("", gyro.from_table(table, place, spec)) if table else (name, spec)


def _read_sensor(entry: Any, place: str) -> Sensor:
    table = tables.subtable(entry, place)
    word = _word(table, place, _SENSORS)
    kind, form, faults = _SENSORS[word]
    orbit = table.pop("orbit", None) if word in ("magnetometer", "horizon") else None
    known_keys(place, table, {**tables.keys(form), **tables.keys(faults)})
    amiss = {key: table.pop(key) for key in list(table) if key in tables.keys(faults)}
    more: dict[str, Any] = {"faults": tables.build(vectors.Faults, amiss, faults, place)}
    if orbit is not None:
        orbit_place = f"{place}: orbit"
        found = tables.build(CircularOrbit, tables.subtable(orbit, orbit_place), _ORBIT, orbit_place)
        more.update({"orbit": found} if word == "horizon" else {"field_f": found.magnetic_field})
    elif word == "horizon":
        raise InputError(f"{place}: orbit is missing; add the table [sensors.orbit]")
    return tables.build(kind, table, form, place, **more)  # type: ignore[no-any-return]


def _write_sensor(sensor: Any) -> dict[str, Any]:
    word = next((word for word, (kind, _, _) in _SENSORS.items() if type(sensor) is kind), None)
    if word is None:
        raise InputError(f"a sensor of class {type(sensor).__name__} cannot be written to a file; keep it in Python")
    _, form, faults = _SENSORS[word]
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
    return table if orbit is None else {**table, "orbit": tables.encode(orbit, _ORBIT)}


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
        table["temperature"] = tables.encode(scenario.temperature, _TEMPERATURE)
    table["sensors"] = [_write_sensor(sensor) for sensor in scenario.sensors]
    return table


def scenario_to_toml(scenario: Scenario) -> str:
    """Return a scenario as TOML text, with the unit in each key; reading it gives a bitwise equal scenario."""
    import tomli_w

    text = tomli_w.dumps(scenario_to_table(scenario))
    # A list of numbers on one line.
    return re.sub(
        r"\[\n((?: +[^\[\]{}\"\n]+,\n)+) *\]", lambda found: f"[{' '.join(found[1].split()).rstrip(',')}]", text
    )


@functools.cache
def builtin() -> Table:
    """Return the built-in scenarios as a table."""
    contents = {name: reading.toml(_BUILTIN / f"{name}.toml") for name in SCENARIOS}
    rows = [
        (name, one["duration_s"], one["rate_hz"], one["gyro"].get("preset", "own figures"))
        for name, one in contents.items()
    ]
    columns = ("name", Column("s", digits=6), Column("Hz", digits=6), "gyro")
    notes = [f"{name}: {one['description']}" for name, one in contents.items()]
    return Table("Built-in scenarios: `strapdown simulate NAME`", columns, rows, notes)
