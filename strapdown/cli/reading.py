"""Options that tell a recording's units, columns and topic: the same in every command that reads one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
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
RECORDING_HELP = (
    "Recording of any format: table (CSV, TSV, Parquet) with time, gx, gy, gz[, ax, ay, az[, mx, my, mz]], ROS bag, ULog, EuRoC folder, "
    "BROAD HDF5, camera or phone log"
)


def told(
    path: Path,
    *,
    columns: str | None = None,
    topic: str | None = None,
    **units: str | None,
) -> dict[str, Any]:
    """Return the options of :func:`strapdown.recordings.read` that the command line tells; of a simulated record none is left standing."""
    from strapdown import recordings
    from strapdown.checks import InputError

    given = {name.removesuffix("_unit"): unit for name, unit in units.items() if unit}
    if recordings.is_record(path):
        options = [
            *(f"{name}-unit" for name in given),
            *(["columns"] if columns else []),
            *(["topic"] if topic else []),
        ]
        for name in options:
            what = "a table" if name != "topic" else "a bag or a flight log"
            own = "tells its units itself" if name.endswith("-unit") else "says itself what it holds"
            raise InputError(f"--{name} goes with {what}; the record {path} {own}")
    found: dict[str, Any] = {"units": given}
    if columns:
        found["columns"] = recordings.parse_mapping(columns)
    if topic:
        found["topic"] = topic
    return found
