"""Options for a recording's units, columns, topic, axes and signs: the same in every command that reads one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

GyroUnit = Annotated[
    str | None, typer.Option("--gyro-unit", help="Table: unit of the gyro, rad/s, deg/s, mrad/s or mdeg/s.")
]
AccelerometerUnit = Annotated[
    str | None, typer.Option("--accelerometer-unit", help="Table: unit of the accelerometer, m/s2, g or mg.")
]
MagnetometerUnit = Annotated[
    str | None, typer.Option("--magnetometer-unit", help="Table: unit of the magnetometer, T, mT, uT, nT, G or mG.")
]
TimeUnit = Annotated[str | None, typer.Option("--time-unit", help="Table: unit of the time, s, ms, us or ns.")]
Columns = Annotated[
    str | None,
    typer.Option(
        "--columns",
        metavar="ROLE=NAME,…",
        help="Table: its columns where they are not the usual ones, unit in parentheses: time=timestamp(us),gx=gyro_x(dps),gy=….",
    ),
]
Topic = Annotated[
    str | None, typer.Option("--topic", help="Bag or flight log: topic of the inertial unit, where there are several.")
]
Axes = Annotated[
    list[str] | None,
    typer.Option(
        "--axes",
        metavar="[SENSOR=]AXES",
        help="Recorded axes that become the body's x, y, z: x,-y,-z of a unit whose z axis points down, magnetometer=y,x,-z of one sensor; "
        "may be repeated.",
    ),
]
Invert = Annotated[
    list[str] | None,
    typer.Option(
        "--invert",
        metavar="SENSOR",
        help="Sensor of inverted sign: accelerometer (of one that reads -g upward at rest), magnetometer or gyro; may be repeated.",
    ),
]
RECORDING_HELP = (
    "Recording of any format: table (CSV, TSV, Parquet) with time, gx, gy, gz[, ax, ay, az[, mx, my, mz]], ROS bag, ULog, EuRoC folder, "
    "BROAD HDF5, camera or phone log"
)


def given_layout(
    path: Path,
    *,
    columns: str | None = None,
    topic: str | None = None,
    axes: Sequence[str] | None = None,
    invert: Sequence[str] | None = None,
    **units: str | None,
) -> dict[str, Any]:
    """Return the options of :func:`strapdown.recordings.read` that the command line gives; a simulated record takes none of them."""
    from strapdown import recordings
    from strapdown.checks import InputError, one_of

    given = {name.removesuffix("_unit"): unit for name, unit in units.items() if unit}
    if recordings.is_record(path):
        options = [
            *(f"{name}-unit" for name in given),
            *(["columns"] if columns else []),
            *(["topic"] if topic else []),
            *(["axes"] if axes else []),
            *(["invert"] if invert else []),
        ]
        for name in options:
            what = {"topic": "a bag or a flight log", "axes": "a recording", "invert": "a recording"}.get(
                name, "a table"
            )
            own = "holds its units" if name.endswith("-unit") else "needs none"
            raise InputError(f"--{name} goes with {what}; the record {path} {own}")
    found: dict[str, Any] = {"units": given}
    if columns:
        found["columns"] = recordings.parse_mapping(columns)
    if topic:
        found["topic"] = topic
    if axes:
        found["axes"] = _axes(axes)
    if invert:
        found["invert"] = tuple(one_of("--invert", sensor, recordings.SENSORS) for sensor in invert)
    return found


def _axes(texts: Sequence[str]) -> str | dict[str, str]:
    """Return the axes of the whole unit, or those of sensors by name."""
    from strapdown import recordings
    from strapdown.checks import InputError, one_of

    single = {}
    for text in texts:
        sensor, equals, axes = text.partition("=")
        if not equals and len(texts) > 1:
            raise InputError(
                f"--axes {text} is of the whole unit; give it alone, or each sensor its own, as gyro=y,x,-z"
            )
        recordings.axes_matrix(axes if equals else text, "--axes")
        if not equals:
            return text
        single[one_of("--axes: sensor", sensor, recordings.SENSORS)] = axes
    return single
