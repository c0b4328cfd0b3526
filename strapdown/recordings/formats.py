"""The table of formats: how each is recognised, read and written.

A format is one entry of :data:`FORMATS` and the module of its family. A format is recognised by content: the first bytes of a file, the
files of a folder. A file of unknown content is read according to its extension, and that reader reports its fault.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import Hint, InputError, one_of
from strapdown.files import BAGS, HDF5, TABLES, library, reading
from strapdown.recordings import broad, dataframes, delimited, ros, telemetry, trajectories, ulog
from strapdown.recordings.body_axes import with_axes
from strapdown.records import Estimate, ImuRecord, outputs
from strapdown.records.recording import Recording, matched, with_gyro

HEAD = 4096
"""Number of bytes at the start of a file from which its format is recognised."""


class OmissionWarning(UserWarning):
    """A format cannot store a part of a recording."""


@dataclass(frozen=True, eq=False)
class Format:
    """One format of recordings or estimates."""

    name: str
    endings: tuple[str, ...]
    recognised: Callable[[Path, bytes], bool]
    """Whether a file's path and first bytes (none for a folder) are of this format."""
    read: Any = None
    """Function that reads a recording, from its path and ``options``; None: cannot be read."""
    write: Any = None
    """Function that writes a recording, from it and a path; None: cannot be written."""
    write_estimate: Any = None
    """Function that writes an estimate, likewise, with ``estimate_options``, and with the keyword ``recording`` if ``with_samples``."""
    written_by: str = ""
    """Optional module without which it cannot be written."""
    options: tuple[str, ...] = ()
    """Keywords of :func:`read` that the reader accepts."""
    estimate_options: tuple[str, ...] = ()
    """Keywords that the writer of estimates accepts."""
    lacks: tuple[str, ...] = ()
    """Contents of a recording that the format cannot store: ``"temperature"``, ``"reference"``, ``"movement"``, ``"clock"``."""
    with_samples: bool = False
    """Whether an estimate is written with the recording's samples and therefore needs a recording."""


def _starts(*signatures: bytes) -> Callable[[Path, bytes], bool]:
    return lambda path, head: head.startswith(signatures)


def _text(head: bytes) -> bool:
    """Return whether a file begins with UTF-8 text; an incomplete character at the end of ``head`` is accepted."""
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
        endings=BAGS,
        recognised=lambda path, head: (path / "metadata.yaml").is_file() or head.startswith(ros.BEGINNINGS),
        read=ros.read_bag,
        options=("topic",),
        write=ros.write_bag,
        written_by="rosbags.typesys",
        lacks=("movement",),
        write_estimate=ros.write_estimate,
        estimate_options=("source",),
        with_samples=True,
    ),
    Format(
        name="ULog",
        endings=(".ulg",),
        recognised=_starts(b"ULog\x01\x12\x35"),
        read=ulog.read_ulog,
        options=("topic",),
    ),
    Format(
        name="Parquet",
        endings=(".parquet",),
        recognised=_starts(b"PAR1"),
        read=dataframes.read_parquet,
        options=("units", "columns"),
        write=dataframes.write_recording,
        written_by="pyarrow.parquet",
        write_estimate=dataframes.write_estimate,
        estimate_options=("sequence", "frame"),
    ),
    Format(
        name="camera or flight log",
        endings=telemetry.ENDINGS,
        recognised=lambda path, head: telemetry.is_log(head),
        read=telemetry.read_telemetry,
    ),
    Format(
        name="EuRoC folder",
        endings=(),
        recognised=lambda path, head: trajectories.is_folder(path),
        read=trajectories.read_euroc,
    ),
    Format(
        name="TUM trajectory",
        endings=(".tum",),
        recognised=lambda path, head: _text(head) and trajectories.is_tum(head),
        write_estimate=trajectories.write_tum,
        estimate_options=("frame",),
    ),
    Format(
        name="BROAD",
        endings=HDF5,
        recognised=_starts(b"\x89HDF\r\n\x1a\n", reading.SEAL),
        read=broad.read_broad,
        write=broad.write_broad,
        lacks=("temperature", "clock"),
    ),
    Format(
        name="CSV",
        endings=(".csv", ".tsv", ".txt"),
        recognised=lambda path, head: _text(head),
        read=delimited.read_csv,
        options=("units", "columns"),
        write=dataframes.write_recording,
        write_estimate=dataframes.write_estimate,
        estimate_options=("sequence", "frame"),
    ),
)
"""Formats in the order in which they are tried."""


def format_of(path: str | os.PathLike[str]) -> Format:
    """Return the format of a file or folder by its content, or by its extension if the content is not conclusive."""
    file, head = Path(path), b""
    if not file.is_dir():
        with reading.opened(file) as stream:
            head = stream.read(HEAD)
    *others, table = FORMATS
    recognised = [candidate for candidate in others if candidate.recognised(file, head)]
    if file.is_dir() and not recognised:
        raise InputError(f"{path} is a folder; name the file in it, unless it is a ROS 2 bag or EuRoC with imu0")
    recognised += [candidate for candidate in FORMATS if file.suffix.lower() in candidate.endings]
    if not recognised and file.suffix.lower() == ".toml":
        raise InputError(f"{file} is no recording; `strapdown simulate` makes the record of a scenario")
    if table.recognised(file, head):
        recognised.append(table)
    if recognised:
        return recognised[0]
    known = (
        f"{candidate.name} ({' or '.join(candidate.endings)})" if candidate.endings else candidate.name
        for candidate in FORMATS
        if candidate.read
    )
    raise InputError(f"{file} has the extension {file.suffix!r} and no known content; known are {', '.join(known)}")


_REASONS = {
    "units": "its layout defines its units; correct them in the header of its CSV (`strapdown convert`), or",
    "columns": "columns are for a table (CSV, Parquet);",
    "topic": "a topic is for a bag or a flight log;",
}
"""Why a format has no such option of :func:`read`."""


def read(
    path: str | os.PathLike[str],
    *,
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    topic: str = "",
    axes: str | Mapping[str, str] | None = None,
    invert: str | Iterable[str] = (),
) -> Recording:
    """Read a recording of any format, recognised by its content: a file, or a folder; options as for :func:`strapdown.read`."""
    file = Path(path)
    file_format = format_of(file)
    if file_format.read is None:
        raise InputError(
            f"{file.name} is a {file_format.name}, which has no inertial samples; give it as the reference of a recording"
        )
    options = {"units": units or {}, "columns": columns or {}, "topic": topic}
    for name, reason in _REASONS.items():
        if options[name] and name not in file_format.options:
            raise InputError(f"{file.name} ({file_format.name}): {reason} leave {Hint(name, options[name])} out")
    options = {name: value for name, value in options.items() if name in file_format.options}
    with reading.from_file(file, file_format.name):
        recording: Recording = file_format.read(file, **options)
    return with_axes(recording, axes, invert) if axes or invert else recording


def write(
    content: Recording | Estimate | ImuRecord,
    path: str | os.PathLike[str],
    *,
    recording: Recording | None = None,
    **options: Any,
) -> None:
    """Write a recording or an estimate in the format of the file extension; the file is created only when complete.

    A simulated record is written as the recording of a device. ``recording``, from which an estimate was made, is needed by a ROS bag;
    ``options`` are those of the format's writer.
    """
    if isinstance(content, ImuRecord):
        content = from_record(content)
    if isinstance(content, Estimate):
        file_format = estimate_format(path, options, recording=recording is not None)
        if file_format.with_samples:
            options["recording"] = recording
        file_format.write_estimate(content, Path(path), **options)
    else:
        file_format = _by_ending(path, "write")
        file_format.write(content, Path(path), **options)
        stored = (*content.parts, *(["clock"] if content.epoch_ns else []))
        if lost := [name for name in file_format.lacks if name in stored]:
            words = f"{Path(path).name} ({file_format.name}) cannot store {', '.join(lost)}: omitted; {', '.join(TABLES)} can"
            warnings.warn(words, OmissionWarning, stacklevel=3)


def estimate_format(
    path: str | os.PathLike[str], options: Mapping[str, Any] | None = None, *, recording: bool = True
) -> Format:
    """Return the format of an estimate's file, so that a file that cannot be written is rejected before the computation.

    ``options`` are the writer's options to be used; ``recording`` is whether there is a recording, whose samples some formats need.
    """
    file_format = _by_ending(path, "write_estimate")
    for name, value in (options or {}).items():
        if name not in file_format.estimate_options:
            known = ", ".join(str(Hint(option)) for option in file_format.estimate_options) or "none"
            raise InputError(
                f"{path} ({file_format.name}) has no option {Hint(name)} (known: {known}); leave it out, or change the extension"
            )
        if name == "frame":
            one_of("frame", value, outputs.FRAMES)
        elif name == "sequence":
            outputs.euler([[1.0, 0.0, 0.0, 0.0]], value)
    if file_format.written_by:
        library(file_format.written_by, f"writing {Path(path).name}")
    if file_format.with_samples and not recording:
        raise InputError(
            f"{path} ({file_format.name}) needs the samples too; give the recording that the estimate was made from"
        )
    return file_format


def writers(kind: str) -> tuple[str, ...]:
    """Return the file extensions that can be written; ``kind`` is ``"write"`` (recordings) or ``"write_estimate"``."""
    return tuple(
        dict.fromkeys(ending for file_format in FORMATS if getattr(file_format, kind) for ending in file_format.endings)
    )


def _by_ending(path: str | os.PathLike[str], kind: str) -> Format:
    ending = Path(path).suffix.lower()
    for file_format in FORMATS:
        if getattr(file_format, kind) and ending in file_format.endings:
            return file_format
    what = "an estimate" if kind == "write_estimate" else "a recording"
    raise InputError(f"{path} ends in {ending!r}, but {what} is written as {', '.join(writers(kind))}; choose one")


def from_record(record: ImuRecord, source: str = "record") -> Recording:
    """Return a record of n intervals as a recording of n samples.

    The rate at each stamp is the mean over the sample interval that ends there, as of an integrating gyro, and so delayed by half an
    interval. Series of kind "vector" named accelerometer and magnetometer are included, at the stamps where they have samples; the truth is
    the reference.
    """
    own: dict[str, Any] = {}
    left_out = []
    simulated = record.origin is not None and record.origin.scenario is not None
    for series in record.vectors:
        field = {"accelerometer": "specific_force", "magnetometer": "magnetic_field"}.get(series.sensor)
        if field is not None and series.kind == "vector":
            own[field] = np.full((len(record.increments), 3), np.nan)
            rows, same = matched(record.time[1:], series.time, 1e-9)
            own[field][rows[same]] = series.vector_b[same]
            if simulated and field == "magnetic_field":
                own["magnetic_unit"] = "T"
        else:
            left_out.append(f"{series.sensor} ({series.kind})")
    remarks = ["From a record: the rate at each time stamp is the mean over the sample interval before it."]
    if left_out:
        remarks.append(
            f"Left out: {', '.join(left_out)}. A recording has only whole vectors of sensors named accelerometer and magnetometer."
        )
    return with_gyro(
        source=source,
        time=record.time[1:],
        rate=record.rates,
        true_attitude=None if record.truth is None else record.truth.attitude[1:],
        temperature=None if record.temperature is None else record.temperature[1:],
        remarks=tuple(remarks),
        **own,
    )
