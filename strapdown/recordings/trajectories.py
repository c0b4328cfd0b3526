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

import os
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, order_remedy
from strapdown.files import atomic_write, reading
from strapdown.recordings.delimited import is_number, read_csv
from strapdown.records import Estimate
from strapdown.records.estimate import frame_words
from strapdown.records.recording import Recording, interpolated, whole_ns

TRUTHS = ("state_groundtruth_estimate0", "mocap0")


def _root(path: Path) -> Path | None:
    """Return the folder that contains imu0, from a data set's folder; None if there is none."""
    return next((folder for folder in (path, path / "mav0") if (folder / "imu0" / "data.csv").is_file()), None)


def is_folder(path: Path) -> bool:
    """Return whether a folder has the layout of EuRoC."""
    return path.is_dir() and _root(path) is not None


def read_euroc(folder: Path) -> Recording:
    """Read a folder of EuRoC or TUM-VI: the inertial unit, and the ground truth if there is one."""
    root = _root(folder)
    assert root is not None  # by which its format was recognised
    recording = replace(read_csv(root / "imu0" / "data.csv"), source=folder.name, remarks=("EuRoC layout, imu0.",))
    truth = next((root / name / "data.csv" for name in TRUTHS if (root / name / "data.csv").is_file()), None)
    if truth is None:
        return recording
    stamps, rows = _table(truth, ",", 1)
    if rows.shape[1] < 8:
        raise InputError(f"{truth} has {rows.shape[1]} columns; wanted time, position and quaternion, 8 or more")
    return _with_reference(recording, stamps, rows[:, 4:8], f"{truth.parent.name}/data.csv")


def read_tum(path: str | os.PathLike[str]) -> tuple[NDArray[np.int64], Array]:
    """Read stamps (n,), ns, and unit quaternions (n, 4), scalar first, of a TUM trajectory."""
    file = Path(path)
    stamps, rows = _table(file, None, 10**9)
    if rows.shape[1] != 8:
        raise InputError(f"{file.name}: data row 1 has {rows.shape[1]} numbers, not time tx ty tz qx qy qz qw")
    return stamps, unit_quaternions(file.name, rows[:, [7, 4, 5, 6]])


def unit_quaternions(name: str, q: Array) -> Array:
    """Return the quaternions (m, 4) of a file, which may be rounded to two digits, with norm one."""
    length = np.linalg.norm(array(f"{name}: quaternion", q, ("m", 4)), axis=1)
    bad = np.abs(length - 1.0) > 1e-2
    if bad.any():
        raise InputError(f"{name}: quaternion {int(np.argmax(bad)) + 1} has norm {length[np.argmax(bad)]:.4g}, not 1")
    return quaternion.normalize(q)


def is_tum(head: bytes) -> bool:
    """Return whether a text begins like a TUM trajectory: rows of eight numbers separated by blanks."""
    whole = head.decode("utf-8", "ignore").rpartition("\n")[0].splitlines()
    rows = [line.split() for line in whole if line.strip() and not line.startswith("#")]
    return bool(rows) and all(len(row) == 8 and all(map(is_number, row)) for row in rows)


def _table(path: Path, separator: str | None, tick: int) -> tuple[NDArray[np.int64], Array]:
    """Return the times (n,) of a table without header, the first column in units of ``tick`` ns, in whole ns, and all columns (n, k).

    Times are read as decimal numbers, because seconds since 1970 have more digits than a float.
    """
    lines = [line for line in reading.text(path).splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise InputError(f"{path.name} has no data rows")
    with reading.from_file(path):
        rows = np.array([[float(cell) for cell in line.split(separator)] for line in lines])
    stamps = np.empty(len(lines), np.int64)
    for k, line in enumerate(lines):
        time = line.split(separator)[0].strip()
        if not Decimal(time).is_finite() or abs(Decimal(time)) >= 2**63 // tick:
            raise InputError(
                f"{path.name}: data row {k + 1}: the time is {time}, which no clock counts; remove the row"
            )
        stamps[k] = int(Decimal(time) * tick)
    back = np.diff(stamps) <= 0
    if back.any():
        k = int(np.argmax(back)) + 1
        remedy = order_remedy(stamps, k, k + 1)
        raise InputError(f"{path.name}: data row {k + 1} is not after the one before; {remedy}")
    return stamps, rows


def with_reference(recording: Recording, path: str | os.PathLike[str]) -> Recording:
    """Return a recording with the attitudes of a TUM trajectory, with the same clock and body axes, as its reference."""
    with reading.from_file(path):
        stamps, attitude = read_tum(path)
    return _with_reference(recording, stamps, attitude, Path(path).name)


def _with_reference(recording: Recording, stamps: NDArray[np.int64], attitude: Array, name: str) -> Recording:
    time = (stamps - recording.epoch_ns) / 1e9
    reference = interpolated(recording.time, time, quaternion.normalize(attitude))
    known = int(np.sum(~np.isnan(reference[:, 0])))
    if not known:
        raise InputError(
            f"{name} goes from {time[0]:.3f} to {time[-1]:.3f} s of the recording's time and {recording.source} from "
            f"{recording.time[0]:.3f} to {recording.time[-1]:.3f} s; both must have the same clock"
        )
    words = f"Reference of {name}: at {known} of {len(reference)} stamps."
    return replace(recording, true_attitude=reference, remarks=(*recording.remarks, words))


def write_tum(estimate: Estimate, path: Path, *, frame: str = "ENU") -> None:
    """Write attitudes as a TUM trajectory: ``time tx ty tz qx qy qz qw``, s of the recording's clock, positions zero."""
    table = estimate.table(frame=frame)
    q = np.stack([table[name] for name in ("qx", "qy", "qz", "qw")], axis=1)
    stamps = whole_ns(estimate.time) + estimate.epoch_ns
    with atomic_write(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        context = [frame_words(estimate.fixed_frame, frame), "smoothed" if estimate.smoothed else ""]
        file.write("; ".join(["# time tx ty tz qx qy qz qw", *filter(None, context)]) + "\n")
        for stamp, row in zip(stamps.tolist(), q.tolist(), strict=True):
            file.write(f"{Decimal(stamp).scaleb(-9):f} 0 0 0 {' '.join(map(repr, row))}\n")
