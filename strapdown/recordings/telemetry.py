"""Logs of cameras, flight controllers and phones. Library: ``telemetry-parser``.

Gyroflow ``.gcsv``, Betaflight Blackbox (``.bbl``, ``.bfl``), ArduPilot (``.bin``), videos of GoPro, DJI, Sony, Insta360 (``.mp4``,
``.mov``, ``.insv``, ``.braw``, ``.r3d``) and other formats of the library, which needs their file extension. It converts the axes of each
device to its own convention and gives gyro in °/s, accelerometer in m/s² and magnetometer in µT. Which body axes these are, and the sign of
the accelerometer, depend on the device: check them with ``strapdown doctor``. The clock counts ms from the beginning of the log or video.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.files import library
from strapdown.records.recording import Recording, with_gyro
from strapdown.units import DEGREE

ENDINGS = (".gcsv", ".bbl", ".bfl", ".bin", ".mp4", ".mov", ".insv", ".braw", ".r3d")
_BEGINNINGS = (b"GYROFLOW IMU LOG", b"CAMERA IMU LOG", b"H Product:Blackbox", b"\xa3\x95\x80")


def is_log(head: bytes) -> bool:
    """Return whether a file begins like such a log or a video."""
    return head.startswith(_BEGINNINGS) or head[4:8] == b"ftyp"


def read_telemetry(file: Path) -> Recording:
    """Read the inertial unit of a camera's, flight controller's or phone's log."""
    parser = library("telemetry_parser", f"{file.name} is a log of a camera or flight controller, which")
    log = parser.Parser(str(file))
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


def _samples(rows: list[dict[str, Any]], name: str) -> Array | None:
    """Return a sensor's samples; None if there are none."""
    samples = np.array([row[name] if row.get(name) is not None else (np.nan,) * 3 for row in rows], np.float64)
    return None if np.isnan(samples).all() else samples
