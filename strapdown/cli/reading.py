"""Options for units, columns, topic, axes and signs of a recording, the same for every command that reads one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer import Option

from strapdown.checks import InputError, one_of
from strapdown.cli.terminal import options_given

RECORDING_HELP = (
    "Recording of any format: table (CSV, TSV, Parquet) with time, gx, gy, gz[, ax, ay, az[, mx, my, mz]], ROS bag, ULog, EuRoC folder, "
    "BROAD HDF5, camera or phone log"
)


@dataclass(frozen=True)
class Samples:
    """Layout of the recording."""

    gyro_unit: str | None = Option(None, help="Table: unit of the gyro, rad/s, deg/s, mrad/s or mdeg/s.")
    accelerometer_unit: str | None = Option(None, help="Table: unit of the accelerometer, m/s2, g or mg.")
    magnetometer_unit: str | None = Option(None, help="Table: unit of the magnetometer, T, mT, uT, nT, G or mG.")
    time_unit: str | None = Option(None, help="Table: unit of the time, s, ms, us or ns.")
    columns: str | None = Option(
        None,
        metavar="ROLE=NAME,…",
        help="Table: names of its columns, with units: time=timestamp(us),gx=gyro_x(dps),….",
    )
    topic: str | None = Option(None, help="Bag or flight log: topic of the inertial unit, if there are several.")

    @property
    def units(self) -> dict[str, str]:
        """Units given, by quantity."""
        names = ("gyro", "accelerometer", "magnetometer", "time")
        return {name: unit for name in names if (unit := getattr(self, f"{name}_unit"))}

    def options(self, path: Path) -> dict[str, Any]:
        """Return the options of :func:`strapdown.read` that are given; a simulated record takes none of them."""
        from strapdown import recordings

        names = options_given(self)
        if recordings.is_record(path):
            if names:
                what = {"--topic": "a bag or a flight log", "--axes": "a recording", "--invert": "a recording"}
                own = "contains its units" if names[0].endswith("-unit") else "needs none"
                raise InputError(f"{names[0]} applies to {what.get(names[0], 'a table')}; the record {path} {own}")
            return {}
        columns = recordings.parse_mapping(self.columns) if self.columns else None
        values = {"units": self.units, "columns": columns, "topic": self.topic}
        return {name: value for name, value in values.items() if value}


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

    def options(self, path: Path) -> dict[str, Any]:
        """Return the options of :func:`strapdown.read` that are given; a simulated record takes none of them."""
        from strapdown import recordings

        options = super().options(path)
        if self.axes:
            options["axes"] = _axes(self.axes)
        if self.invert:
            options["invert"] = tuple(one_of("--invert", sensor, recordings.SENSORS) for sensor in self.invert)
        return options


def _axes(texts: Sequence[str]) -> str | dict[str, str]:
    """Return the axes of the whole unit, or those of sensors by name."""
    from strapdown import recordings

    single = {}
    for text in texts:
        sensor, equals, axes = text.partition("=")
        if not equals and len(texts) > 1:
            raise InputError(
                f"--axes {text} applies to the whole unit; give only it, or the axes of each sensor, such as gyro=y,x,-z"
            )
        recordings.axes_matrix(axes if equals else text, "--axes")
        if not equals:
            return text
        single[one_of("--axes: sensor", sensor, recordings.SENSORS)] = axes
    return single
