"""The table of formats: how each is recognised, read and written, and what installs it.

A format is one entry of :data:`FORMATS` and the module of its family. Content decides: the first bytes of a file, the files of a folder.
A file of no known content is read by its ending, whose reader reports its fault.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import InputError
from strapdown.files import reading
from strapdown.recordings import recordfiles, ros, telemetry, trajectories
from strapdown.recordings.body_axes import with_axes
from strapdown.records import Estimate, ImuRecord
from strapdown.records.recording import Recording, with_gyro

HEAD = 4096
"""Bytes of a file that its format is recognised by."""


@dataclass(frozen=True)
class Format:
    """One format of recordings or estimates."""

    name: str
    endings: tuple[str, ...]
    recognised: Callable[[Path, bytes], bool]
    """Whether a file's path and first bytes (a folder: none) are of this format."""
    read: str = ""
    """``module:function`` below :mod:`strapdown.recordings`; empty: not read as a recording."""
    write: str = ""
    """The same for a recording."""
    write_estimate: str = ""
    """The same for an estimate."""
    options: tuple[str, ...] = ()
    """Keywords of :func:`read` that the reader takes."""
    estimate_options: tuple[str, ...] = ()
    """Keywords that the writer of estimates takes."""
    lacks: tuple[str, ...] = ()
    """Contents of a recording that the format cannot hold: ``"temperature"``, ``"reference"``, ``"movement"``, ``"clock"``."""
    with_samples: bool = False
    """Whether an estimate is written with the recording's samples, and so never without a recording."""


def _starts(*signatures: bytes) -> Callable[[Path, bytes], bool]:
    return lambda path, head: head.startswith(signatures)


def _text(head: bytes) -> bool:
    """Return whether a file begins as text of numbers and names does; a character cut in two at the end is none of its faults."""
    if not head.strip() or b"\0" in head:
        return False
    try:
        head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        return error.start >= len(head) - 3
    return True


FORMATS: tuple[Format, ...] = (
    Format(
        name="ROS bag",
        endings=(".bag", ".mcap", ".db3"),
        recognised=lambda path, head: ros.is_folder(path) or head.startswith(ros.MAGICS),
        read="ros:read_bag",
        options=("topic",),
        write="ros:write_bag",
        lacks=("movement",),
        write_estimate="ros:write_estimate",
        estimate_options=("source",),
        with_samples=True,
    ),
    Format(
        name="ULog",
        endings=(".ulg",),
        recognised=_starts(b"ULog\x01\x12\x35"),
        read="ulog:read_ulog",
        options=("topic",),
        write="ulog:write_ulog",
        lacks=("temperature", "movement"),
    ),
    Format(
        name="Parquet",
        endings=(".parquet",),
        recognised=_starts(b"PAR1"),
        read="dataframes:read_parquet",
        options=("units", "columns", "gyro_alone"),
        write="dataframes:write_parquet",
        write_estimate="estimates:write_parquet",
        estimate_options=("sequence", "frame"),
    ),
    Format(
        name="camera or flight log",
        endings=telemetry.ENDINGS,
        recognised=lambda path, head: telemetry.is_log(head),
        read="telemetry:read_telemetry",
    ),
    Format(
        name="EuRoC folder",
        endings=(),
        recognised=lambda path, head: trajectories.is_folder(path),
        read="trajectories:read_euroc",
    ),
    Format(
        name="TUM trajectory",
        endings=(".tum",),
        recognised=lambda path, head: _text(head) and trajectories.is_tum(head),
        write_estimate="estimates:write_tum",
        estimate_options=("frame",),
    ),
    Format(
        name="Rerun recording",
        endings=(".rrd",),
        recognised=_starts(b"RRF"),
        write_estimate="estimates:write_rerun",
    ),
    Format(
        name="BROAD",
        endings=(".hdf5", ".h5"),
        recognised=_starts(b"\x89HDF\r\n\x1a\n"),
        read="broad:read_broad",
        write="broad:write_broad",
        lacks=("temperature", "clock"),
        write_estimate="estimates:write_hdf5",
    ),
    Format(
        name="CSV",
        endings=(".csv", ".tsv", ".txt"),
        recognised=lambda path, head: _text(head),
        read="delimited:read_csv",
        options=("units", "columns", "gyro_alone"),
        write="delimited:write_csv",
        write_estimate="estimates:write_csv",
        estimate_options=("sequence", "frame"),
    ),
)
"""Formats in the order that they are tried."""


def format_of(path: str | os.PathLike[str]) -> Format:
    """Return the format of a file or folder by its content, or by its ending where the content is not conclusive."""
    file = Path(path)
    if not file.exists():
        raise InputError(f"{path} does not exist; check the path")
    head = b""
    if not file.is_dir():
        with reading.opened(file) as stream:
            head = stream.read(HEAD)
    table = FORMATS[-1]
    found = next((one for one in FORMATS if one is not table and one.recognised(file, head)), None)
    if found is not None:
        return found
    if file.is_dir():
        raise InputError(
            f"{path} is a folder; name the file in it (a folder is read that is a ROS 2 bag, or holds imu0/data.csv as EuRoC)"
        )
    by_ending = next((one for one in FORMATS if file.suffix.lower() in one.endings), None)
    if by_ending is not None:
        return by_ending
    if table.recognised(file, head):
        return table
    raise InputError(
        f"{file} has the suffix {file.suffix!r} and the content of no known format; recordings are {_known()}"
    )


def _known() -> str:
    return ", ".join(
        f"{one.name} ({' or '.join(one.endings)})" if one.endings else one.name for one in FORMATS if one.read
    )


def _function(place: str) -> Callable[..., Any]:
    module, _, name = place.partition(":")
    function: Callable[..., Any] = getattr(import_module(f"strapdown.recordings.{module}"), name)
    return function


def read(
    path: str | os.PathLike[str],
    *,
    units: Mapping[str, str] | None = None,
    gyro_alone: bool = False,
    columns: Mapping[str, str] | None = None,
    topic: str = "",
    axes: str | Mapping[str, str] | None = None,
    invert: str | Iterable[str] = (),
) -> Recording:
    """Read a recording of any format, recognised by its content.

    Parameters
    ----------
    path : path-like
        A file, or the folder of a ROS 2 bag or of EuRoC.
    units : mapping of str to str, optional
        For tables: units of ``time``, ``gyro``, ``accelerometer`` and ``magnetometer`` where the header does not declare them.
    gyro_alone : bool, default False
        Whether to ignore the other sensors, whose units then need not be known.
    columns : mapping of str to str, optional
        For tables: names of columns by role, perhaps with a unit, ``{"time": "timestamp [us]", "gx": "gyro_x[dps]"}``; the others
        are found by their names.
    topic : str, default ""
        For bags and flight logs: topic of the inertial unit, where there are several.
    axes : str or mapping of str to str, optional
        The recorded axes that become the body's x, y, z, ``"x,-y,-z"`` for a unit whose z axis points down; or of single sensors,
        ``{"magnetometer": "y,x,-z"}``. See :func:`strapdown.recordings.with_axes`.
    invert : str or iterable of str, default empty
        Sensors of inverted sign: ``"accelerometer"`` for one that reads −g upward at rest.

    Returns
    -------
    Recording
        The recording; its ``remarks`` state the choices of the reader.

    Raises
    ------
    InputError
        If the file is missing, of no known format, truncated before anything is whole, or its units are unknown or undeclared.

    Examples
    --------
    >>> walk = read("walk.csv", units={"gyro": "deg/s"})  # doctest: +SKIP
    """
    file = Path(path)
    found = format_of(file)
    if not found.read:
        raise InputError(
            f"{file.name} is a {found.name}, which holds no inertial samples; give the recording, and this as its reference"
        )
    given = {"units": units or {}, "columns": columns or {}, "topic": topic}
    for name, value in given.items():
        if value and name not in found.options:
            _refuse_option(file, found, name, value)
    options: dict[str, Any] = {name: value for name, value in given.items() if name in found.options}
    if "gyro_alone" in found.options:
        options["gyro_alone"] = gyro_alone
    recording: Recording = _function(found.read)(file, **options)
    return with_axes(recording, axes, invert) if axes or invert else recording


def _refuse_option(file: Path, found: Format, name: str, value: Any) -> None:
    if name == "units":
        said = found.name if found.name != "BROAD" else "HDF5"
        raise InputError(
            f"{file.name} is {said}, whose layout defines its units; drop the option for {', '.join(value)}"
        )
    what = {"columns": "columns go with a table (CSV, Parquet)", "topic": "a topic goes with a bag or a flight log"}[
        name
    ]
    raise InputError(f"{file.name} ({found.name}): {what}; drop the option")


def write(
    content: Recording | Estimate | ImuRecord,
    path: str | os.PathLike[str],
    *,
    recording: Recording | None = None,
    **options: Any,
) -> None:
    """Write a recording or an estimate in the format of the ending; the file appears whole or not at all.

    Parameters
    ----------
    content : Recording, ImuRecord or Estimate
        What to write. A simulated record is written as the recording of a device.
    path : path-like
        File: ``.csv``, ``.tsv``, ``.parquet``, ``.h5``, ``.bag``, ``.mcap`` …
    recording : Recording, optional
        With an estimate: the recording that it was made from, whose samples are written where the format has room (a ROS bag needs
        it).
    **options : dict
        Options of the format's own writer.

    Raises
    ------
    InputError
        If no format of that ending holds such content, or the content lacks what the format needs.
    """
    if isinstance(content, ImuRecord):
        content = from_record(content, "record")
    if isinstance(content, Estimate):
        found = estimate_format(path, options, recording=recording is not None)
        _function(found.write_estimate)(content, Path(path), recording=recording, **options)
    else:
        _function(_by_ending(path, "write").write)(content, Path(path), **options)


def estimate_format(path: str | os.PathLike[str], options: Iterable[str] = (), *, recording: bool = True) -> Format:
    """Return the format that an estimate's file is written in, so that what cannot be is refused before anything is computed.

    ``options`` are those of the writer that are to be used, ``recording`` whether there is one, whose samples some formats need.
    """
    found = _by_ending(path, "write_estimate")
    for name in options:
        if name not in found.estimate_options:
            raise InputError(f"{path} ({found.name}) has no {name}; leave it out, or choose another ending")
    if found.with_samples and not recording:
        raise InputError(
            f"{path} ({found.name}) holds the samples too; give the recording that the estimate was made from, or choose another "
            "ending"
        )
    return found


def writers(kind: str) -> tuple[str, ...]:
    """Return the endings that are written, of ``"write"`` (recordings) or ``"write_estimate"``."""
    return tuple(dict.fromkeys(ending for one in FORMATS if getattr(one, kind) for ending in one.endings))


def _by_ending(path: str | os.PathLike[str], kind: str) -> Format:
    ending = Path(path).suffix.lower()
    for one in FORMATS:
        if getattr(one, kind) and ending in one.endings:
            return one
    what = "an estimate" if kind == "write_estimate" else "a recording"
    raise InputError(
        f"{path} ends in {ending!r}, and {what} is written as {', '.join(writers(kind))}; choose such an ending"
    )


def from_record(record: ImuRecord, source: str = "record") -> Recording:
    """Return a simulated record of n intervals as a device would have recorded it: n samples.

    The rate at each stamp is the mean over the sample interval that ends there, as of an integrating gyro: half an interval late. Vector
    series named accelerometer and magnetometer are included where they have samples at the stamps; the truth is the reference.
    """
    steps = np.diff(record.time)[:, None]
    own: dict[str, Any] = {}
    left_out = []
    for series in record.vectors:
        field = {"accelerometer": "specific_force", "magnetometer": "magnetic_field"}.get(series.sensor)
        if field is not None and series.kind == "vector":
            values = np.full((len(record.increments), 3), np.nan)
            places = np.searchsorted(record.time[1:], series.time - 1e-9)
            same = places < len(values)
            same[same] &= np.abs(record.time[1:][places[same]] - series.time[same]) < 1e-9
            values[places[same]] = series.vector_b[same]
            own[field] = values
        else:
            left_out.append(f"{series.sensor} ({series.kind})")
    words = (
        f"Left out: {', '.join(left_out)}. Recordings hold whole vectors of an accelerometer and a magnetometer alone."
    )
    return with_gyro(
        source=source,
        time=record.time[1:],
        rate=record.increments / steps,
        true_attitude=None if record.truth is None else record.truth.attitude[1:],
        temperature=None if record.temperature is None else record.temperature[1:],
        remarks=(words,) if left_out else (),
        **own,
    )


def not_held(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Return what a recording may hold and the format of a path's ending has no room for."""
    return _by_ending(path, "write").lacks


def is_estimate(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is an estimate of this package, in HDF5."""
    file = Path(path)
    if not file.is_file() or format_of(file).name != "BROAD":
        return False
    with reading.hdf5(file) as content:
        return bool(reading.attributes(content).get("kind") == "strapdown estimate")


def is_record(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a simulated record (:mod:`strapdown.recordings.recordfiles`); a folder is none."""
    return not Path(path).is_dir() and recordfiles.is_record(path)
