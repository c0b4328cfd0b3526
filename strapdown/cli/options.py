"""Options of several commands, such as those for units, columns, topic, axes and signs of every command that reads a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from typer import Option

from strapdown.checks import InputError

Format = Literal["png", "pdf", "svg"]
"""Formats of figures."""
FORMAT: Any = Option("png", "--format", help="Format of the figures.")
FILTER: Any = Option(None, "--filter", help="TOML with a table named filter, and its gate. Default: a matched one.")
STATES: Any = Option(None, "--states/--no-states", help="States for the specified errors, or none. Default: if needed.")
GYRO: Any = Option(None, help="TOML with a table named gyro, as of `strapdown allan`: the gyro noise of the filter.")
SCENARIO = "Name of a built-in scenario, or a TOML file."
RECORDING_HELP = (
    "Recording of any format: table (CSV, TSV, Parquet) with time, gx, gy, gz[, ax, ay, az[, mx, my, mz]], ROS bag, ULog, EuRoC folder, "
    "BROAD HDF5, camera or phone log"
)


@dataclass(frozen=True)
class Samples:
    """Layout of the recording."""

    gyro_unit: str | None = Option(None, help="Table: unit of the gyro, rad/s, deg/s, mrad/s or mdeg/s.")
    accelerometer_unit: str | None = Option(None, help="Table: unit of the accelerometer, m/s2, mm/s2, g or mg.")
    magnetometer_unit: str | None = Option(None, help="Table: unit of the magnetometer, T, mT, uT, nT, G or mG.")
    time_unit: str | None = Option(None, help="Table: unit of the time, s, ms, us or ns.")
    columns: str | None = Option(
        None,
        metavar="ROLE=NAME,…",
        help="Table: names of its columns, with units: time=timestamp(us),gx=gyro_x(dps),….",
    )
    topic: str | None = Option(None, help="Bag or flight log: topic of the inertial unit, if there are several.")

    @property
    def options(self) -> dict[str, Any]:
        """Options of :func:`strapdown.read` that are given."""
        units = {name: getattr(self, f"{name}_unit") for name in ("gyro", "accelerometer", "magnetometer", "time")}
        columns = by_name("--columns", (self.columns or "").split(","), "ROLE=NAME, as in time=when,gx=gyro_x[dps]")
        values = {"units": {name: unit for name, unit in units.items() if unit}, "columns": columns}
        return {name: value for name, value in (values | {"topic": self.topic}).items() if value}


@dataclass(frozen=True, eq=False)
class Layout(Samples):
    """Layout of the recording."""

    axes: list[str] | None = Option(
        None,
        metavar="[SENSOR=]AXES",
        help="Recorded axes that become the body's x, y, z: x,-y,-z for a unit whose z axis points down, magnetometer=y,x,-z for one "
        "sensor; may be repeated.",
    )
    invert: list[str] | None = Option(
        None,
        metavar="SENSOR",
        help="Sensor with inverted sign: accelerometer (if it reads -g upward at rest), magnetometer or gyro; may be repeated.",
    )

    @property
    def options(self) -> dict[str, Any]:
        """Options of :func:`strapdown.read` that are given."""
        axes: Any = self.axes or []
        whole = [text for text in axes if "=" not in text]
        if whole and len(axes) > 1:
            raise InputError(f"--axes {whole[0]} applies to the whole unit; give only it, or those of each sensor")
        axes = whole[0] if whole else by_name("--axes", axes, "SENSOR=AXES")
        return super().options | {name: value for name, value in (("axes", axes), ("invert", self.invert)) if value}


def options_given(group: Any) -> list[str]:
    """Return the options of a group that were given, as on the command line."""
    flags = []
    for field in dataclasses.fields(group):
        option: Any = field.default
        if getattr(group, field.name) not in (option.default, []):
            flag = option.param_decls[0] if option.param_decls else "--" + field.name.replace("_", "-")
            flags.append(flag.partition("/")[0])
    return flags


def by_name(option: str, texts: Iterable[str], form: str) -> dict[str, str]:
    """Return the values of an option by name, given as texts NAME=VALUE; ``form`` is the one to give."""
    values: dict[str, str] = {}
    for text in filter(None, texts):
        name, _, value = (part.strip() for part in text.partition("="))
        if not name or not value:
            raise InputError(f"{option} is {text.strip()!r}; give {form}")
        if name in values:
            raise InputError(f"{option}: {name} is given twice; give it once")
        values[name] = value
    return values


def numbers(option: str, text: str, form: str, *lengths: int) -> list[float]:
    """Return the numbers of an option, separated by commas; ``form`` says which to give, ``lengths`` how many there may be."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in lengths:
        raise InputError(f"{option} is {text!r}; give {form}")
    return values
