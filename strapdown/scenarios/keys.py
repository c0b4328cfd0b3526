"""Keys of a scenario file with units, defaults and examples, from the tables and dataclasses that the parser itself uses."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import math
import re
import textwrap
import typing
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from strapdown import gyro, motion, vectors
from strapdown.checks import InputError
from strapdown.files import tables
from strapdown.gyro import datasheets
from strapdown.motion import orbit
from strapdown.results import WIDTH, default_of
from strapdown.scenarios import toml
from strapdown.scenarios.scenario import Scenario, Temperature

_SYMBOLS = {"deg": "°", "degc": "°C", "arcsec": "″", "ratio": "1", "hz": "Hz", "nt": "nT", "t": "T", "hour": "h"}
_SYMBOLS |= {"sqrt": "√"}
"""Symbols of the words in the ending of a key that are not symbols themselves."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Key:
    """One quantity of a table."""

    name: str
    """Key with its usual unit."""
    others: tuple[str, ...] = ()
    """The same quantity in other units."""
    unit: str = ""
    type: str
    default: str
    """As TOML; "required" where there is none, "none" for one that no number stands for."""
    meaning: str = ""
    example: Any
    """A value that the parser accepts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Section:
    """One table of the file, of one type."""

    group: Literal["top", "motion", "gyro", "sensors"]
    header: str
    """How the table begins in the file."""
    type: str = ""
    """Value of the key ``type``, if the table has one."""
    summary: str
    keys: tuple[Key, ...] = ()


def sections() -> list[Section]:
    """Return every table of a scenario file, in its order, one for each type of motion and of sensor."""
    keys = _keys(Scenario, toml.TOP_FORM)
    top = Section(group="top", header="top of the file", summary="before the first table.", keys=keys)
    warm = _section("gyro", "[temperature]", Temperature, _keys(Temperature, toml.TEMPERATURE))
    sensors = [
        _section("sensors", "[[sensors]]", kind, (*_keys(kind, form), *_keys(vectors.Faults, faults)), word)
        for word, (kind, form, faults) in toml.SENSORS.items()
    ]
    path = _section("sensors", "[sensors.orbit]", orbit.CircularOrbit, _keys(orbit.CircularOrbit, toml.ORBIT))
    return [top, *_motions(), _gyro(), _warm_gyro(), warm, *sensors, path]


def named(name: str) -> list[Section]:
    """Return the tables of a group, ``top``, ``motion``, ``gyro`` or ``sensors``, or those of one type, such as "coning", or header."""
    every = sections()
    tables = [section.header.strip("[]") for section in every]
    selected = [
        section
        for section, table in zip(every, tables, strict=True)
        if name in (section.group, section.type, section.header, table, table.rpartition(".")[2])
    ]
    if not selected:
        types = [section.type or table for section, table in zip(every, tables, strict=True) if section.group != "top"]
        known = dict.fromkeys([*(section.group for section in every), *types])
        raise InputError(f"there is no section {name!r} in a scenario file; name one of {', '.join(known)}")
    return selected


def heading(section: Section) -> str:
    """Return the header of a section and its summary in one line."""
    kind = f', type = "{section.type}"' if section.type else ""
    return f"{section.header}{kind}: {re.sub('[`*]', '', section.summary)}"


def described(section: Section) -> str:
    """Return the heading of a section, its keys, and an example as text."""
    lines = textwrap.wrap(heading(section), WIDTH)
    for key in section.keys:
        default = key.default if key.default == "required" else f"default {key.default}"
        words = f"{', '.join(filter(None, (key.unit, key.type, default)))}. {key.meaning}".replace("`", "")
        lines += [" or ".join((key.name, *key.others)), textwrap.indent(textwrap.fill(words, WIDTH - 4), "    ")]
    return "\n".join([*lines, *(["", f"Example:\n{example(section)}"] if section.keys else []), ""])


def example(section: Section) -> str:
    """Return a table as in a scenario file, TOML: its required keys, and the others as comments with their default."""
    lines = [] if section.group == "top" else [section.header]
    if section.type:
        lines.append(f'type = "{section.type}"')
    for key in section.keys:
        value = json.dumps(key.example, ensure_ascii=False).replace("Infinity", "inf")
        lines.append(f"{'' if key.default == 'required' else '# '}{key.name} = {value}")
    return "\n".join(lines)


# ---------------------------------------------------------------------------------------------------------------- the tables


def _section(group: Any, header: str, subject: Any, keys: tuple[Key, ...], word: str = "", more: str = "") -> Section:
    """Return a section whose summary is the first paragraph about a class or function."""
    text = " ".join((inspect.getdoc(subject) or "").split("\n\n")[0].split())
    summary = text.replace("``", "`").removeprefix("Return ") + more
    return Section(group=group, header=header, type=word, summary=summary, keys=keys)


def _motions() -> list[Section]:
    lists: dict[str, dict[str, Any]] = {  # of a sampled motion
        "time_s": {"type": "list of numbers", "example": [0.4 * k for k in range(6)]},
        "attitudes": {"type": "list of quaternions", "example": [[1.0, 0.0, 0.0, 0.0]] * 6},
    }
    motions = []
    for word, (kind, form) in toml.MOTIONS.items():
        keys = tuple(replace(k, **lists.get(k.name, {})) if word == "sampled" else k for k in _keys(kind, form))
        motions.append(_section("motion", "[motion]", kind, keys, word))
    start = _keys(motion.ConstantRate, {"initial_attitude": tables.PLAIN})
    parts = " Each is a table with a `type` and keys of its own: `[motion.base]`, `[motion.vibration]`."
    harmonic, each = _keys(motion.Harmonic, toml.HARMONIC), " One such table for each."
    return [
        *motions,
        _section("motion", "[[motion.harmonics]]", motion.Harmonic, harmonic, more=each),
        _section("motion", "[motion]", motion.rest, start, "rest"),
        _section("motion", "[motion]", motion.Composed, (), "composed", parts),
    ]


def _gyro() -> Section:
    names = ", ".join(f"`{name}`" for name in datasheets.PRESETS)
    meaning = f"A gyro on the market, whose values other keys replace. One of {names}."
    example = next(iter(datasheets.PRESETS))
    preset = Key(name="preset", type="text", default="none", meaning=meaning, example=example)
    own = (replace(k, type=_TYPES[gyro.Axes]) if k.type == "list of 3" else k for k in _keys(gyro.GyroSpec, gyro.FORM))
    return Section(group="gyro", header="[gyro]", summary="the gyro; errors left out are zero.", keys=(preset, *own))


def _warm_gyro() -> Section:
    """Return the table of the bias over temperature, to first order."""
    span, each = "temperature of the fit, beyond which the bias is constant", [0.0] * 3
    keys = (
        ("reference_degc", "°C", "number", "Temperature T₀ of the polynomial", 25.0),
        ("lowest_degc", "°C", "number", f"Lowest {span}", 0.0),
        ("highest_degc", "°C", "number", f"Highest {span}", 50.0),
        ("bias_rad_per_s", "rad/s", "list of 3", "Bias c₀ at T₀, body axes", each),
        ("bias_rad_per_s_per_k", "rad/s/K", "list of 3", "Slope c₁; for a higher order also …_per_k2, and so on", each),
        ("sigma_rad_per_s_per_k", "rad/s/K", "list of 3", "Standard deviation of the slope, drawn in every run", each),
    )
    return Section(
        group="gyro",
        header="[gyro.temperature]",
        summary="Bias of the gyro over temperature, Σ c_k (T − T₀)^k, as `strapdown allan` writes it to `gyro-temperature.toml`.",
        keys=tuple(
            Key(name=name, unit=unit, type=kind, default="required", meaning=f"{meaning}.", example=example)
            for name, unit, kind, meaning, example in keys
        ),
    )


# ------------------------------------------------------------------------------------------------------- from the dataclasses


def _keys(kind: type, form: tables.Form) -> tuple[Key, ...]:
    own = {name: text for name, text in _meanings(kind).items() if not text.startswith("As for")}
    meanings = _meanings(vectors.VectorSensor) | own
    hints = typing.get_type_hints(kind, localns={"CircularOrbit": orbit.CircularOrbit})
    fields = {field.name: field for field in dataclasses.fields(kind)}
    return tuple(_key(fields[name], hints[name], choice, meanings.get(name, "")) for name, choice in form.items())


def _key(field: dataclasses.Field[Any], hint: Any, choice: tables.Choice, meaning: str) -> Key:
    names = [f"{field.name}_{suffix}" if suffix else field.name for suffix, _ in choice]
    suffix, factor = choice[0]
    if si := symbol(choice[-1][0]):  # the unit of the field, which is not that of every key
        meaning = re.sub(rf", {re.escape(si)}(?![\w/√²])", "", meaning, count=1)
    default = default_of(field)
    kind = _type(hint, default)
    if default is dataclasses.MISSING:
        example = _EXAMPLES[kind]
    else:
        example = default if isinstance(default, str | int) else (np.asarray(default, float) / (factor or 1.0)).tolist()
    return Key(
        name=names[0],
        others=tuple(names[1:]),
        unit=symbol(suffix),
        type=kind,
        default="required" if default is dataclasses.MISSING else _toml(example),
        meaning=meaning,
        example=example,
    )


_TYPES = {str: "text", int: "whole number", float: "number", gyro.Axes: "number, or one per axis"}


def _type(hint: Any, default: Any) -> str:
    if hint in _TYPES or typing.get_origin(hint) is Literal:
        return _TYPES.get(hint, "text")
    if isinstance(default, str):
        return "text, or list of numbers"
    shape: tuple[int, ...] = (3,) if default is dataclasses.MISSING else np.shape(default)
    if shape == (0,):
        return "list of [from, to]"
    return f"{shape[0]} rows of {shape[1]}" if len(shape) == 2 else f"list of {shape[0]}"


_EXAMPLES: dict[str, Any] = {"text": "some text", "number": 1.0, "list of 3": [1.0, 1.0, 1.0]}


def symbol(ending: str) -> str:
    """Return the unit that the ending of a key stands for: ``deg_per_sqrt_hour`` is °/√h."""
    text = re.sub(r"[a-z]+", lambda word: _SYMBOLS.get(word[0], word[0]), ending.replace("_per_", "/"))
    return text.replace("√_", "√").replace("_", " ").replace("2", "²").replace("h/h", "h²")


def _toml(value: Any) -> str:
    if isinstance(value, list):
        flat = np.asarray(value).ravel()
        if value and not np.any(flat):
            return "zeros"
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, float):
        return "none (`inf`)" if math.isinf(value) else f"{value:.9g}"
    return f"`{value!r}`".replace("'", '"') if isinstance(value, str) else str(value)


@functools.cache
def _meanings(kind: type) -> dict[str, str]:
    """Return what the sections Parameters and Attributes of the docstring of a class say of each field."""
    said: dict[str, str] = {}
    for part in re.findall(
        r"^(?:Parameters|Attributes)\n-+\n(.*?)(?=^\S+\n-+\n|\Z)", inspect.getdoc(kind) or "", re.M | re.S
    ):
        for names, text in re.findall(r"^(\S[^:\n]*?) ?:.*\n((?:[ \n].*\n?)*)", part + "\n", re.M):
            plain = " ".join(re.sub(r":\w+:`", "`", text).split()).replace("``", "`")
            said |= {name.strip(): plain for name in names.split(",")}
    return said
