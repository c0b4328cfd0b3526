"""Frozen dataclasses as tables for TOML and JSON, with the unit in the name of each key, exact in both directions.

A *form* gives for each field of a class the units that its key may have: ``{"angle": DEGREES, "frequency": HERTZ}`` reads and writes
``angle_deg`` and ``frequency_hz``. A value is written in the first unit in which it is represented exactly; the last unit of a choice is
SI.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from strapdown import units
from strapdown.checks import Array, InputError, known_keys, numbers
from strapdown.files import reading
from strapdown.results import default_of, not_default

Choice = tuple[tuple[str, float], ...]
"""Suffixes of the key and their factors to SI."""
Form = Mapping[str, Choice]

PLAIN: Choice = (("", 1.0),)
TEXT: Choice = (("", 0.0),)
"""A string."""
FLAG: Choice = (("", 2.0),)
"""True or false."""
RATIO: Choice = (("ratio", 1.0),)
PPM: Choice = (("ppm", 1e-6), ("ratio", 1.0))
SECONDS: Choice = (("s", 1.0),)
HERTZ: Choice = (("hz", 1.0),)
METRES: Choice = (("m", 1.0),)
DEGREES_CELSIUS: Choice = (("degc", 1.0),)
DEGREES: Choice = (("deg", units.DEGREE), ("rad", 1.0))
ARCSECONDS: Choice = (("arcsec", units.ARCSECOND), ("deg", units.DEGREE), ("rad", 1.0))
MILLIRADIANS: Choice = (("mrad", 1e-3), ("rad", 1.0))
DEGREES_PER_SECOND: Choice = (("deg_per_s", units.DEGREE), ("rad_per_s", 1.0))
DEGREES_PER_HOUR: Choice = (("deg_per_hour", units.DEGREE_PER_HOUR), ("rad_per_s", 1.0))
METRES_PER_SECOND_SQUARED: Choice = (("m_per_s2", 1.0),)
NANOTESLAS: Choice = (("nt", 1e-9), ("t", 1.0))


def keys(form: Form) -> dict[str, tuple[str, float]]:
    """Return field and factor by key, for every key of a form."""
    return {
        f"{name}_{suffix}" if suffix else name: (name, factor)
        for name, choice in form.items()
        for suffix, factor in choice
    }


def encode(value: Any, form: Form) -> dict[str, Any]:
    """Return a dataclass as a table; fields that are None or equal to their default are left out."""
    table: dict[str, Any] = {}
    for name, content in not_default(value).items():
        if name in form and content is not None:
            table.update(_entry(name, content, form[name]))
    return table


def _entry(name: str, content: Any, choice: Choice) -> dict[str, Any]:
    if isinstance(content, str | bool | int):
        return {name if choice in (PLAIN, TEXT, FLAG) else f"{name}_{choice[0][0]}": content}
    for suffix, factor in choice:
        exact = _exact_quotient(np.asarray(content, np.float64), factor)
        if exact is not None:
            return {f"{name}_{suffix}" if suffix else name: exact.tolist()}
    raise InputError(f"{name} is {content!r}, which cannot be written as a number")


def _exact_quotient(value: Array, factor: float) -> Array | None:
    """Return x, if possible of few digits, with x · factor bitwise equal to ``value``; None if there is no such x."""
    quotient = value / factor
    short = np.array([float(f"{x:.12g}") for x in quotient.ravel()]).reshape(quotient.shape)
    result = np.full(value.shape, np.nan)
    for candidate in (np.nextafter(quotient, -np.inf), np.nextafter(quotient, np.inf), quotient, short):
        result = np.where(candidate * factor == value, candidate, result)
    return None if np.isnan(result).any() else result


def decode(table: Mapping[str, Any], form: Form, place: str) -> dict[str, Any]:
    """Return the fields of a table, in SI; the error for an unknown key names the nearest known one."""
    known = keys(form)
    known_keys(place, table, known)
    values: dict[str, Any] = {}
    for key, content in table.items():
        name, factor = known[key]
        if name in values:
            raise InputError(f"{place}: {key} gives {name} a second time; keep one of the two")
        values[name] = _number(content, factor, form[name], f"{place}: {key}")
    return values


def _number(content: Any, factor: float, choice: Choice, place: str) -> Any:
    if choice == TEXT:
        if not isinstance(content, str):
            raise InputError(f"{place} is {content!r}; it must be a string in quotes")
        return content
    if choice == FLAG:
        if not isinstance(content, bool):
            raise InputError(f"{place} is {content!r}; it must be true or false")
        return content
    if choice == PLAIN and isinstance(content, str):
        return content
    if isinstance(content, bool) or not isinstance(content, int | float | list):
        raise InputError(f"{place} is {content!r}; it must be a number or a list of numbers, its unit is in the key")
    try:
        if isinstance(content, list):
            return numbers(place, content) * factor
        number = float(content) * factor
        return number if choice != PLAIN else content
    except (InputError, OverflowError):
        raise InputError(f"{place} is {content!r}; it must be a list of numbers, rows of equal length") from None


def build(kind: type, table: Mapping[str, Any], form: Form, place: str, **more: Any) -> Any:
    """Return ``kind(**fields)`` from a table; the error for a missing field names its key."""
    values = {**decode(table, form, place), **more}
    for field in dataclasses.fields(kind):
        if field.name not in values and default_of(field) is dataclasses.MISSING:
            choice = form.get(field.name, PLAIN)
            key = f"{field.name}_{choice[0][0]}" if choice[0][0] else field.name
            raise InputError(f"{place}: {key} is missing; add it")
    return construct(kind, values, table, form, place)


def construct(
    make: Callable[..., Any], values: Mapping[str, Any], table: Mapping[str, Any], form: Form, place: str
) -> Any:
    """Return ``make(**values)``; its errors are reported with the place in the file, the key and the number there.

    The values have the type of the file (string, number, list), which may not be that of the field, so type errors of ``make`` are reported
    too.
    """
    try:
        return make(**values)
    except InputError as error:
        raise InputError(_with_typed(str(error), table, form, place)) from None
    except (TypeError, ValueError, ArithmeticError, LookupError) as error:
        keys = ", ".join(table) or "the values"
        raise InputError(f"{place}: one of {keys} is of the wrong type or size ({error}); check each") from error


def _with_typed(text: str, table: Mapping[str, Any], form: Form, place: str) -> str:
    said, verb, _ = text.partition(" is ")
    for key, (name, _) in keys(form).items():
        if verb and key in table and re.sub(r"\[[\d, ]*\]$", "", said).endswith(name):
            return f"{text} ({place}: {key} = {table[key]!r})"
    return text if text.startswith(place.split(":", 1)[0]) else f"{place}: {text}"


def subtable(content: Any, place: str, remedy: str = "") -> dict[str, Any]:
    """Return a value of a file that must be a table; ``remedy`` ends the error if it is none."""
    if not isinstance(content, Mapping):
        raise InputError(f"{place} is {content!r}; it must be a table{remedy}")
    return dict(content)


Kind = TypeVar("Kind")


def read(path: str | os.PathLike[str], name: str, remedy: str, make: Callable[[Mapping[str, Any], str], Kind]) -> Kind:
    """Return ``make(table, place)`` for the table ``[name]`` of a TOML file; ``remedy`` is the advice in the error if there is none."""
    with reading.from_file(path):
        table = reading.toml(path).get(name)
        if not isinstance(table, dict):
            raise InputError(f"{path} has no table [{name}]; {remedy}")
        return make(table, f"{path}: {name}")
