"""Roles and units of a table's columns: by name, by a mapping, or guessed from the header with a remark.

The package's names are ``time``, ``gx gy gz`` (gyro), ``ax ay az`` (specific force), ``mx my mz`` (magnetic field), ``temperature``
(°C), and for a reference ``reference_qw … reference_qz`` (q_fb) and ``movement`` (0 or 1). If a header has other names, complete triples
whose names end in an axis and contain a usual name of a sensor are assigned to that sensor: ``gyro_x``, ``GyrX``, ``angular_velocity.x``,
``w_RS_S_x``, ``Gyroscope X (deg/s)``, ``accelerometer_m_s2[0]``. The recording's ``remarks`` list the columns assigned. If two triples fit
one sensor, the table is rejected. An acceleration without gravity is not used.

A unit is given in brackets after the name, in parentheses, or at the end of the name (``time_us``, ``gyro_x_dps``). Because a factor of
57.3 or 9.81 is the most common mistake, a gyro or an accelerometer without a unit is rejected rather than guessed. Time is in s unless
declared otherwise; the values of a magnetometer without a unit are kept unchanged.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from strapdown.checks import Array, Hint, InputError, instance, known_keys, one_of
from strapdown.records.recording import (
    CLOCK_OFFSET,
    FIELDS,
    FORCE_UNITS,
    MAGNETIC_UNITS,
    RATE_UNITS,
    SENSORS,
    TIME_UNITS,
    Recording,
    relative_time,
    with_gyro,
)

GROUPS = {
    "time": ("time",),
    "gyro": ("gx", "gy", "gz"),
    "accelerometer": ("ax", "ay", "az"),
    "magnetometer": ("mx", "my", "mz"),
    "temperature": ("temperature",),
    "reference": ("reference_qw", "reference_qx", "reference_qy", "reference_qz"),
    "movement": ("movement",),
}
"""Columns by group."""
UNITS: Mapping[str, Mapping[str, float]] = {
    "time": TIME_UNITS,
    "gyro": RATE_UNITS,
    "accelerometer": FORCE_UNITS,
    "magnetometer": MAGNETIC_UNITS,
    "temperature": {"degC": 1.0},
}
"""Units by group, with their factors to SI."""
ARBITRARY = "a.u."
"""Unit of a field that is as good as none."""

_SPELLINGS = {
    "time": {"sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "usec": "us", "nsec": "ns"}
    | {"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns"},
    "gyro": {"dps": "deg/s", "mdps": "mdeg/s", "rads-1": "rad/s", "rads": "rad/s", "rad": "rad/s", "degs-1": "deg/s"}
    | {"degs": "deg/s", "degpers": "deg/s", "radpers": "rad/s", "mrads": "mrad/s", "mdegs": "mdeg/s"},
    "accelerometer": {"ms-2": "m/s2", "m/s/s": "m/s2", "ms2": "m/s2", "mpers2": "m/s2", "m/(s2)": "m/s2"}
    | {"milli-g": "mg", "gs": "g"},
    "magnetometer": {"microtesla": "uT", "nanotesla": "nT", "gauss": "G", "ga": "G", "milligauss": "mG", "mgauss": "mG"}
    | {"tesla": "T", "mga": "mG", "ut": "uT", "nt": "nT", "g": "G", "mg": "mG"}
    | {"au": ARBITRARY, "localflux": ARBITRARY},
    "temperature": {"c": "degC", "celsius": "degC", "degc": "degC"},
}
"""Other spellings of units, without spaces and in lower case."""
_PLAIN = str.maketrans({"²": "2", "¹": "1", "⁻": "-", "^": "", "°": "deg", "µ": "u", "μ": "u"})
_WORDS = {
    "gyro": {"gyro", "gyr", "gyros", "gyroscope", "gyrometer", "g", "w", "omega", "angular", "angularvelocity"},
    "accelerometer": {"acc", "accel", "accl", "accelerometer", "acceleration", "a", "specific"},
    "magnetometer": {"mag", "magn", "magnet", "magnetometer", "magnetic", "m", "compass", "magneticfield"},
}
_OTHER = {"linear", "lin", "user", "gravity", "free", "world", "earth", "global", "nav", "bias", "std", "sigma", "cov"}
_OTHER |= {"covariance", "var", "variance", "offset", "delta", "filtered", "temperature", "temp"}
"""Words in names of columns that are not samples of a sensor."""
_TIMES = ("time", "timestamp", "timestamps", "t", "stamp", "ts", "seconds elapsed", "seconds", "datetime", "date")


@dataclass(frozen=True)
class Column:
    """A column's header: its name, and the unit it declares."""

    name: str
    unit: str = ""

    @property
    def said(self) -> str:
        """The header, nearly as written."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def column(cell: str) -> Column:
    """Return a header's cell as name and unit; in parentheses only a known unit counts as one."""
    text = " ".join(cell.replace("\N{NO-BREAK SPACE}", " ").split()).strip('"')
    unit = ""
    parted = re.fullmatch(r"(.*\S)\s*\(([^()]*)\)", text)
    if parted and any(unit_of(group, parted[2]) for group in UNITS):
        text, unit = parted[1], parted[2]
    indexed = re.fullmatch(r"(.*\S)\s*\[([012])\]", text)  # accelerometer_m_s2[0] of flight logs
    if indexed:
        return Column(f"{indexed[1]}[{indexed[2]}]", unit)
    bracketed = re.fullmatch(r"(.*?)\s*\[(.*)\]?", text)
    if bracketed and bracketed[1]:
        return Column(bracketed[1].strip(), bracketed[2].removesuffix("]").strip())
    return Column(text, unit)


def unit_of(group: str, text: str) -> str:
    """Return the package's name of a unit of that group, in any spelling; empty if the text is not a unit."""
    plain = text.strip().translate(_PLAIN)
    if plain in UNITS[group]:
        return plain
    squeezed = re.sub(r"[\s_·*.]", "", plain).lower()
    small = {unit.lower(): unit for unit in UNITS[group]}
    spelled = _SPELLINGS[group].get(squeezed) or (squeezed if squeezed in UNITS[group] else "")
    return spelled or ("" if group == "magnetometer" else small.get(squeezed, ""))


class Table(Protocol):
    """A table in a file or in memory, of which only the requested columns are read; the others may have any content."""

    source: str
    header: list[str]

    def load(self, places: Sequence[int], time: int) -> Mapping[int, Array]:
        """Return the numbers (n,) of columns, empty fields NaN, from their indices and that of the time."""

    def clock_ns(self, unit: str) -> NDArray[np.int64] | None:
        """Return the loaded stamps, of a unit, "" if unknown, if they are dates, or integers that count ns from 1970; else None."""


def recording(
    table: Table,
    *,
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
) -> Recording:
    """Return the recording of a table.

    ``units`` are used if the header declares none. ``columns`` gives columns by role, optionally with a unit,
    ``{"gx": "gyro_x [dps]"}``; the others are found by their names.
    """
    source, units, columns = table.source, units or {}, columns or {}
    for name, value in (("units", units), ("columns", columns)):
        instance(name, value, Mapping, "give a mapping, such as units={'gyro': 'deg/s'} or columns={'gx': 'gyro_x'}")
    known_keys("units", units, [group for group in UNITS if group != "temperature"])
    header = [column(cell) for cell in table.header]
    counts = Counter(column.name.lower() for column in header if column.name)
    if twice := [name for name, number in counts.items() if number > 1]:
        raise InputError(f"{source}: the header names the column {twice[0]!r} twice; rename or drop one")
    roles, declared, remark = _roles(source, header, columns)
    _need_whole_groups(source, header, roles)
    unit_of_group = _units(source, {role: header[k].name for role, k in roles.items()}, declared, units)
    values = table.load(sorted(set(roles.values())), roles["time"]).__getitem__
    stamps = table.clock_ns(declared.get("time", ""))
    if stamps is None:
        time, epoch = _seconds(values(roles["time"]), TIME_UNITS[unit_of_group["time"]])
    else:
        time, epoch = relative_time(stamps)
    if "time" not in declared and not units.get("time"):
        _need_time_unit(source, header[roles["time"]].name, time)
    return with_gyro(
        source=source,
        time=time,
        epoch_ns=epoch,
        magnetic_unit=unit_of_group.get("magnetometer", ""),
        remarks=(remark,) if remark else (),
        **_fields(roles, values, unit_of_group),
    )


def _need_whole_groups(source: str, header: Sequence[Column], roles: Mapping[str, int]) -> None:
    """Raise an error if columns of time or gyro, or some of another group, are missing."""
    if len(header) == 1:
        raise InputError(
            f"{source}: its header, {header[0].said[:60]!r}, is one column; separate columns by comma, semicolon, tab or |"
        )
    for group, members in GROUPS.items():
        missing = [role for role in members if role not in roles]
        if group == "gyro" and missing and {"qw", "qx", "qy", "qz"} <= {column.name.lower() for column in header}:
            raise InputError(
                f"{source} has attitudes and no gyro; read it by `sd.read_attitudes`, or check it with {Hint('truth')}"
            )
        if missing and (group in ("time", "gyro") or len(missing) < len(members)):
            raise InputError(
                f"{source}: the header lacks {', '.join(missing)} (it has: {', '.join(column.name for column in header)}); "
                f"name the columns, as in {Hint('columns', {missing[0]: 'NAME'})}"
                + (", or write one: the number of the sample over the sample rate, s" if group == "time" else "")
            )


def _fields(roles: Mapping[str, int], values: Callable[[int], Array], units: Mapping[str, str]) -> dict[str, Any]:
    """Return the samples in the fields of a recording, those of gyro and accelerometer in SI."""
    fields: dict[str, Any] = {}
    for group in FIELDS.keys() & {_group(role) for role in roles}:
        factor = UNITS[group][units[group]] if group in ("gyro", "accelerometer") else 1.0
        samples = np.stack([values(roles[role]) for role in GROUPS[group]], axis=1) * factor
        fields[FIELDS[group]] = samples if samples.shape[1] > 1 else samples[:, 0]
    if "movement" in fields:
        fields["movement"] = fields["movement"] > 0.5
    return fields


def _group(role: str) -> str:
    return next(group for group, members in GROUPS.items() if role in members)


def _roles(
    source: str, columns: Sequence[Column], mapping: Mapping[str, str]
) -> tuple[dict[str, int], dict[str, str], str]:
    """Return the column of each role, the declared unit of each group, and a remark on guessed columns."""
    names = [column.name.lower() for column in columns]
    unit_by_role: dict[str, str] = {}
    roles: dict[str, int] = {}
    for role, cell in mapping.items():
        one_of("columns: role", role, [role for members in GROUPS.values() for role in members])
        wanted = column(cell)
        cells = {column.said.lower(): k for k, column in enumerate(columns)} | {name: k for k, name in enumerate(names)}
        index = cells.get(cell.lower(), cells.get(wanted.name.lower()))
        if index is None:
            known = UNITS.get(_group(role))
            bare = re.sub(r"\s*[\[(][^\[(]*$", "", cell).lower()
            if bare in names and known:  # brackets that hold no unit
                units = ", ".join(known)
                raise InputError(f"{source}: columns: the unit in {cell!r} for {role} is not known (known: {units})")
            held = ", ".join(column.name for column in columns)
            raise InputError(f"{source} has no column {cell!r} for {role} (it has: {held})")
        roles[role] = index
        if wanted.unit and cell.lower() not in names:
            unit_by_role[role] = wanted.unit
    guessed: list[str] = []
    for group, members in GROUPS.items():
        named = {role: names.index(role) for role in members if role in names}
        if named or any(role in roles for role in members):
            roles = named | roles
            continue
        guess = _guess(source, group, columns)
        if guess is not None:
            places, unit = guess
            roles |= dict(zip(members, places, strict=True))
            unit_by_role |= dict.fromkeys(members, unit) if unit else {}
            said = ", ".join(repr(columns[k].said) for k in places)
            guessed.append(f"{' '.join(members)} from {said}{f' in {unit}' if unit else ''}")
    declared: dict[str, str] = {}
    for role, k in roles.items():
        unit = unit_by_role.get(role) or columns[k].unit
        group = _group(role)
        if unit and group in UNITS:
            unit = unit_of(group, unit) or unit
            if unit != ARBITRARY and declared.setdefault(group, unit) != unit:
                raise InputError(
                    f"{source}: column {columns[k].name} is in {unit} but another {group} column in {declared[group]}; "
                    "give all axes of one sensor the same unit"
                )
    return roles, declared, f"Columns assigned by their names: {'; '.join(guessed)}." if guessed else ""


def _words(name: str) -> list[str]:
    """Return the words of a name: split at other characters, between lower and upper case, and before an index in brackets."""
    name = re.sub(r"\[(\d)\]", r" axis\1 ", name)
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name)
    return [word.lower() for word in re.split(r"[^A-Za-z0-9µμ°²/]+", name) if word]


def _guess(source: str, group: str, columns: Sequence[Column]) -> tuple[tuple[int, ...], str] | None:
    """Return the columns that match a group and the unit in their names; None if there is no match, an error if there are several."""
    if group == "time":
        return _guess_time(columns)
    if group == "temperature":
        hits = [k for k, column in enumerate(columns) if _words(column.name)[:1] in (["temp"], ["temperature"])]
        usable = len(hits) == 1 and unit_of("temperature", columns[hits[0]].unit or _end(columns[hits[0]].name))
        return ((hits[0],), "degC") if usable else None
    if group not in SENSORS:
        return None
    whole = _triples(group, columns) or _triples(group, columns, by_unit=True)  # B_x [uT]
    if len(whole) > 1:
        said = " or ".join(columns[axes[0][0]].said for _, axes in whole)
        role = GROUPS[group][0]
        raise InputError(
            f"{source}: the {group} may be that of {said}; select one, as in "
            f"{Hint('columns', {role: columns[whole[0][1][0][0]].name})}"
        )
    if not whole:
        return None
    axes = whole[0][1]
    return tuple(axes[axis][0] for axis in range(3)), axes[0][1]


def _triples(
    group: str, columns: Sequence[Column], *, by_unit: bool = False
) -> list[tuple[tuple[str, ...], dict[int, tuple[int, str]]]]:
    """Return the triples of columns of a sensor by their names: the words before the axis, and the place and unit of each axis.

    ``by_unit``: whatever their names, those that declare a unit of this sensor only.
    """
    groups: dict[tuple[str, ...], dict[int, tuple[int, str]]] = {}
    declared: set[tuple[str, ...]] = set()
    for k, column in enumerate(columns):
        parted = _axis(group, column.name, is_known=by_unit)
        if parted is not None:
            prefix, axis, unit = parted
            groups.setdefault(prefix, {})[axis] = (k, unit)
            if [sensor for sensor in SENSORS if unit_of(sensor, column.unit)] == [group]:
                declared.add(prefix)
    return [(prefix, axes) for prefix, axes in groups.items() if len(axes) == 3 and (prefix in declared or not by_unit)]


def _axis(group: str, name: str, *, is_known: bool) -> tuple[tuple[str, ...], int, str] | None:
    """Return a column's name without its axis, the axis, and the unit in the name; None if it is not an axis of that sensor.

    ``is_known``: whether the sensor is known without the name.
    """
    words: list[str] = []
    for word in _words(name):
        joined = re.fullmatch(r"([a-z]+)([xyz])", word)
        words += joined.groups() if joined and joined[1] in _WORDS[group] else [word]
    places = [k for k, word in enumerate(words) if word in ("x", "y", "z", "axis0", "axis1", "axis2")]
    if not places:
        return None
    place = places[-1]
    before, after = words[:place], [word for word in words[place + 1 :] if word != "cal"]  # of Shimmer: calibrated
    unit = unit_of(group, "".join(after)) if after else ""
    if after and not unit:
        return None
    known = is_known or (
        before and (before[0] in _WORDS[group] or any(len(word) > 2 for word in _WORDS[group] & set(before)))
    )
    foreign = set(before) & _OTHER
    if "linear_acceleration" in name.lower():  # the field of a ROS message, which includes gravity
        foreign -= {"linear"}
    if not known or foreign or any(set(before) & _WORDS[o] - {"g", "a", "m", "w"} for o in SENSORS if o != group):
        return None
    rest = [word for word in before if word not in _WORDS[group]]
    if not unit and rest:
        unit = unit_of(group, "".join(rest))
    return tuple(before), "xyz012".index(words[place][-1]) % 3, unit


def _guess_time(columns: Sequence[Column]) -> tuple[tuple[int, ...], str] | None:
    for wanted in _TIMES:
        for k, column in enumerate(columns):
            words = _words(column.name)
            size = len(wanted.split())
            if " ".join(words[:size]) == wanted:
                unit = unit_of("time", "".join(words[size:])) if words[size:] else ""
                if unit or not words[size:]:
                    return (k,), unit
    # loggingTime(ms), Time since start in ms: if only one column is a time
    hits = [k for k, column in enumerate(columns) if {"time", "timestamp"} & set(_words(column.name))]
    return ((hits[0],), unit_of("time", _end(columns[hits[0]].name))) if len(hits) == 1 else None


def _end(name: str) -> str:
    words = _words(name)
    return words[-1] if len(words) > 1 else ""


def _units(
    source: str, names: Mapping[str, str], declared: Mapping[str, str], options: Mapping[str, str]
) -> dict[str, str]:
    """Return the unit of each group of the table's columns, named by role; empty for a magnetometer without a declared unit."""
    result: dict[str, str] = {}
    for group, units in UNITS.items():
        present = [role for role in GROUPS[group] if role in names]
        if not present:
            continue
        option = options.get(group, "")
        option = unit_of(group, option) or option
        unit = option or declared.get(group) or {"time": "s", "temperature": "degC"}.get(group, "")
        if not unit and group != "magnetometer":
            raise InputError(
                f"{source} does not declare the unit of its {group} columns; declare it in the header, as in "
                f"{GROUPS[group][0]} [{next(iter(units))}], or by "
                f"{Hint('units', {group: next(iter(units))})} ({', '.join(units)})"
            )
        if option and declared.get(group) and option != declared[group]:
            replaced = {role: f"{names[role]} [{option}]" for role in present}
            raise InputError(
                f"{source}: the header declares {declared[group]} for the {group}, the option is {option}; drop one, or replace the "
                f"header's by {Hint('columns', replaced)}"
            )
        result[group] = one_of(f"{source}: unit of the {group}", unit, units) if unit else ""
    return result


def _seconds(stamps: Array, factor: float) -> tuple[Array, int]:
    """Return stamps as time in s and the clock's reading at time 0, ns; for a clock that counts from 1970 the first time is 0."""
    beyond = len(stamps) > 0 and abs(stamps[0] * factor) > CLOCK_OFFSET
    origin = float(stamps[0]) if beyond else 0.0
    # In integer arithmetic: seconds since 1970 have a resolution of only 0.2 µs in double precision.
    whole, scale = int(origin), round(1e9 * factor)
    return np.asarray((stamps - origin) * factor), whole * scale + round((origin - whole) * scale)


USUAL_INTERVALS = (1e-6, 2.0)
"""Minimum and maximum sample interval, s, for stamps of an undeclared unit to be seconds."""


def _need_time_unit(source: str, name: str, time: Array) -> None:
    """Reject stamps of an undeclared unit that cannot be seconds of an inertial sensor; flight logs mostly have microseconds."""
    steps = np.diff(time)
    if np.any(steps < 0.0):
        return  # is refused for that
    usual = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 1.0
    if not USUAL_INTERVALS[0] <= usual <= USUAL_INTERVALS[1]:
        low, high = USUAL_INTERVALS
        unit = next((unit for unit, size in TIME_UNITS.items() if low <= size * usual <= high), "us")
        raise InputError(
            f"{source}: the stamps of {name} are {usual:g} apart, not plausible in seconds; declare the unit, as in {name} [{unit}], or by "
            f"{Hint('units', {'time': unit})} ({', '.join(TIME_UNITS)})"
        )
