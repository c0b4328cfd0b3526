"""Logs of cameras, flight controllers and phones. Library: ``telemetry-parser``.

Gyroflow ``.gcsv``, Betaflight Blackbox (``.bbl``, ``.bfl``), ArduPilot (``.bin``), videos of GoPro, DJI, Sony, Insta360 (``.mp4``,
``.mov``, ``.insv``, ``.braw``, ``.r3d``) and other formats of the library. The library converts the axes of each device to its own
convention and gives gyro in °/s, accelerometer in m/s² and magnetometer in µT. Which body axes these are, and the sign of the
accelerometer, depend on the device: check them with ``strapdown doctor``. The clock counts ms from the beginning of the log or video.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.files import reading
from strapdown.files.extras import library
from strapdown.records.recording import Recording, with_gyro
from strapdown.units import DEGREE

ENDINGS = (".gcsv", ".bbl", ".bfl", ".bin", ".mp4", ".mov", ".insv", ".braw", ".r3d")
_BEGINNINGS = {
    b"GYROFLOW IMU LOG": ".gcsv",
    b"CAMERA IMU LOG": ".gcsv",
    b"H Product:Blackbox": ".bbl",
    b"\xa3\x95\x80": ".bin",
}
"""Beginnings of logs, with the file extension that the library requires."""


def is_log(head: bytes) -> bool:
    """Return whether a file begins like such a log or a video."""
    return head.startswith(tuple(_BEGINNINGS)) or head[4:8] == b"ftyp"


def read_telemetry(file: Path) -> Recording:
    """Read the inertial unit of a camera's, flight controller's or phone's log."""
    parser = library("telemetry_parser", f"{file.name} is a log of a camera or flight controller, which")
    with tempfile.TemporaryDirectory() as folder:
        named, ending = file, _ending(file)
        if file.suffix.lower() != ending:  # a link with the extension that the library requires
            named = Path(folder) / f"{file.stem}{ending}"
            named.symlink_to(file.absolute())
        log = parser.Parser(str(named))
        rows: list[dict[str, Any]] = log.normalized_imu()
    rate, force, field = (_samples(rows, name) for name in ("gyro", "accl", "magn"))
    if len(rows) < 2 or rate is None:
        raise InputError(f"{file.name} ({log.camera or 'unknown'}) has no gyro samples; give a log with raw ones")
    time = np.array([row["timestamp_ms"] for row in rows], np.float64) / 1e3
    device = " ".join(part for part in (log.camera, log.model) if part)
    return with_gyro(
        source=file.name,
        time=time,
        rate=rate * DEGREE,
        specific_force=force,
        magnetic_field=field,
        magnetic_unit="" if field is None else "uT",
        remarks=(f"Device: {device}. Its axes are those of telemetry-parser; check them with `strapdown doctor`.",),
    )


def _ending(file: Path) -> str:
    """Return the file extension that the library requires: that of the file if it is a known one, else from the content."""
    if file.suffix.lower() in ENDINGS:
        return file.suffix.lower()
    with reading.opened(file) as stream:
        head = stream.read(32)
    return next((ending for begin, ending in _BEGINNINGS.items() if head.startswith(begin)), ".mp4")


def _samples(rows: list[dict[str, Any]], name: str) -> Array | None:
    """Return a sensor's samples; None if there are none."""
    samples = np.array([row[name] if row.get(name) is not None else (np.nan,) * 3 for row in rows], np.float64)
    return None if np.isnan(samples).all() else samples
