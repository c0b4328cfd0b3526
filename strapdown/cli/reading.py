"""Options for units, columns, topic, axes and signs of a recording, the same for every command that reads one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from typer import Option

from strapdown.checks import InputError
from strapdown.cli import terminal as ui

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
    def options(self) -> dict[str, Any]:
        """Options of :func:`strapdown.read` that are given."""
        units = {name: getattr(self, f"{name}_unit") for name in ("gyro", "accelerometer", "magnetometer", "time")}
        columns = ui.by_name("--columns", (self.columns or "").split(","), "ROLE=NAME, as in time=when,gx=gyro_x[dps]")
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
            raise InputError(
                f"--axes {whole[0]} applies to the whole unit; give only it, or the axes of each sensor, such as gyro=y,x,-z"
            )
        axes = whole[0] if whole else ui.by_name("--axes", axes, "SENSOR=AXES")
        return super().options | {name: value for name, value in (("axes", axes), ("invert", self.invert)) if value}
