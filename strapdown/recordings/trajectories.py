"""Folders of EuRoC and TUM-VI, with their ground truth, and TUM trajectories.

EuRoC (Burri et al. 2016; TUM-VI has the same layout): ``imu0/data.csv`` below ``mav0`` or the given folder; time ns since 1970, gyro rad/s,
accelerometer m/s², in the axes of the inertial unit. The ground truth is the first file found of ``state_groundtruth_estimate0/data.csv``
and ``mocap0/data.csv``: time ns, position m, quaternion scalar first, body to a frame whose z axis is up, with any heading (EuRoC's body
frame is that of the inertial unit; TUM-VI's motion-capture body was transformed to it by the data set's authors).

A TUM trajectory is text with rows ``time tx ty tz qx qy qz qw``: s, m, quaternion **scalar last**, body to a fixed frame, assumed to be z
up. It has no inertial samples: it is read as the reference of a recording, or written from an estimate.

References have their own stamps. They are interpolated along the shortest rotation to the stamps of the recording if the reference's
stamps on both sides are at most :data:`strapdown.records.recording.BRIDGED` apart; otherwise they are missing.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from strapdown import quaternion
from strapdown.checks import Array, InputError
from strapdown.files import reading
from strapdown.recordings.delimited import is_number, read_csv
from strapdown.records.recording import Recording, interpolated

TRUTHS = ("state_groundtruth_estimate0", "mocap0")


def _root(path: Path) -> Path | None:
    """Return the folder that contains imu0, from a data set's folder; None if there is none."""
    return next((one for one in (path, path / "mav0") if (one / "imu0" / "data.csv").is_file()), None)


def is_folder(path: Path) -> bool:
    """Return whether a folder has the layout of EuRoC."""
    return path.is_dir() and _root(path) is not None


def read_euroc(path: str | os.PathLike[str]) -> Recording:
    """Read a folder of EuRoC or TUM-VI: the inertial unit, and the ground truth if there is one."""
    folder = Path(path)
    root = _root(folder)
    if root is None:
        raise InputError(f"{path} has no imu0/data.csv; give the folder of a EuRoC or TUM-VI sequence")
    recording = replace(read_csv(root / "imu0" / "data.csv"), source=folder.name, remarks=("EuRoC layout, imu0.",))
    truth = next((root / name / "data.csv" for name in TRUTHS if (root / name / "data.csv").is_file()), None)
    if truth is None:
        return recording
    stamps, attitude = _read_truth(truth)
    return _with_reference(recording, stamps, attitude, f"{truth.parent.name}/data.csv")


def _read_truth(path: Path) -> tuple[NDArray[np.int64], Array]:
    """Return stamps, ns, and quaternions, scalar first, of an EuRoC ground truth."""
    rows = _rows(path, ",")
    if rows and len(rows[0]) < 8:
        raise InputError(f"{path} has {len(rows[0])} columns; wanted time, position and quaternion, 8 or more")
    return _whole(path, [row[0] for row in rows], 1), np.array([[float(x) for x in row[4:8]] for row in rows])


def read_tum(path: str | os.PathLike[str]) -> tuple[NDArray[np.int64], Array]:
    """Read stamps (n,), ns, and unit quaternions (n, 4), scalar first, of a TUM trajectory."""
    file = Path(path)
    rows = _rows(file, None)
    for k, row in enumerate(rows):
        if len(row) != 8:
            raise InputError(
                f"{file.name}: data row {k + 1} has {len(row)} numbers; a TUM trajectory has time tx ty tz qx qy qz qw"
            )
    q = np.array([[float(x) for x in row[4:]] for row in rows])[:, [3, 0, 1, 2]]
    if np.any(np.linalg.norm(q, axis=1) < 0.5):
        raise InputError(
            f"{file.name}: data row {int(np.argmin(np.linalg.norm(q, axis=1))) + 1} has a quaternion of norm below 0.5; it must be 1"
        )
    return _whole(file, [row[0] for row in rows], 10**9), quaternion.normalize(q)


def is_tum(head: bytes) -> bool:
    """Return whether a text begins like a TUM trajectory: rows of eight numbers separated by blanks."""
    lines = [
        line.split()
        for line in head.decode("utf-8", "ignore").splitlines()[:-1]
        if line.strip() and not line.startswith("#")
    ]
    if not lines:
        return False
    return all(len(line) == 8 and all(map(is_number, line)) for line in lines)


def _rows(path: Path, separator: str | None) -> list[list[str]]:
    lines = reading.text(path).splitlines()
    rows = [line.strip().split(separator) for line in lines if line.strip() and not line.lstrip().startswith("#")]
    for k, row in enumerate(rows):
        try:
            [float(x) for x in row]
        except ValueError:
            raise InputError(f"{path.name}: data row {k + 1} is not numeric: {' '.join(row)[:60]!r}") from None
        if len(row) != len(rows[0]):
            raise InputError(
                f"{path.name}: data row {k + 1} has {len(row)} fields, the first {len(rows[0])}; the file is truncated there"
            )
    if not rows:
        raise InputError(f"{path.name} has no data rows")
    return rows


def _whole(path: Path, cells: list[str], factor: int) -> NDArray[np.int64]:
    """Return stamps in integer ns without rounding: seconds since 1970 have more digits than a float."""
    stamps = np.empty(len(cells), np.int64)
    for k, cell in enumerate(cells):
        whole, _, part = cell.partition(".")
        if re.fullmatch("-?[0-9]{1,19}", whole) and re.fullmatch("[0-9]*", part):
            digits = int((part + "0" * 9)[:9]) if factor > 1 else 0
            stamp = int(whole) * factor + (-digits if whole.startswith("-") else digits)
        else:
            number = float(cell) * factor
            stamp = round(number) if math.isfinite(number) else 2**63
        if abs(stamp) >= 2**63:
            raise InputError(
                f"{path.name}: data row {k + 1}: the time is {cell}, which no clock counts; remove the row"
            )
        stamps[k] = stamp
    back = np.diff(stamps) <= 0
    if back.any():
        raise InputError(f"{path.name}: data row {int(np.argmax(back)) + 2} is not after the one before; sort the rows")
    return stamps


def with_reference(recording: Recording, path: str | os.PathLike[str]) -> Recording:
    """Return a recording with the attitudes of a TUM trajectory, with the same clock and body axes, as its reference."""
    with reading.from_file(path):
        stamps, attitude = read_tum(path)
    return _with_reference(recording, stamps, attitude, Path(path).name)


def _with_reference(recording: Recording, stamps: NDArray[np.int64], attitude: Array, name: str) -> Recording:
    time = (stamps - recording.epoch_ns) / 1e9
    found = interpolated(recording.time, time, quaternion.normalize(attitude))
    known = int(np.sum(~np.isnan(found[:, 0])))
    if not known:
        raise InputError(
            f"{name} goes from {time[0]:.3f} to {time[-1]:.3f} s of the recording's time and {recording.source} from "
            f"{recording.time[0]:.3f} to {recording.time[-1]:.3f} s; both must have the same clock"
        )
    words = f"Reference of {name}: at {known} of {len(found)} stamps."
    return replace(recording, true_attitude=found, remarks=(*recording.remarks, words))
