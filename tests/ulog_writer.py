"""A writer of flight logs (ULog), for tests of their reader."""

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strapdown import quaternion
from strapdown.recordings.ulog import ATTITUDE, FIELD, NO_SAMPLE, UNIT
from strapdown.records import outputs
from strapdown.records.recording import Recording, field_in

_LAYOUTS: dict[str, list[tuple[str, str, int]]] = {
    UNIT: [
        ("float", "gyro_rad", 3),
        ("int32_t", "accelerometer_timestamp_relative", 0),
        ("float", "accelerometer_m_s2", 3),
    ],
    FIELD: [("uint64_t", "timestamp_sample", 0), ("float", "magnetometer_ga", 3)],
    ATTITUDE: [("float", "q", 4)],
}
_TYPES = {"float": "<f4", "int32_t": "<i4", "uint64_t": "<u8"}


def write_ulog(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording as a flight log: numbers in single precision, stamps in integer µs; body axes are unchanged."""
    stamps = np.rint(recording.clock_ns / 1000).astype(np.int64)
    known = np.asarray(~np.isnan(recording.specific_force).any(axis=1))
    topics: list[tuple[str, NDArray[np.int64], list[NDArray[Any]]]] = [
        (
            UNIT,
            stamps,
            [recording.rate, np.where(known, 0, NO_SAMPLE), np.nan_to_num(recording.specific_force)],
        )
    ]
    if recording.magnetic_field is not None:
        present = ~np.isnan(recording.magnetic_field).any(axis=1)
        topics.append((FIELD, stamps[present], [stamps[present], field_in("G", recording)[present]]))
    if recording.true_attitude is not None:
        present = ~np.isnan(recording.true_attitude).any(axis=1)
        topics.append(
            (ATTITUDE, stamps[present], [outputs.to_ned(quaternion.normalize(recording.true_attitude[present]))])
        )
    content = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", int(stamps[0])), message("B", bytes(40))]
    for name, _, _ in topics:
        fields = "".join(f"{kind}{f'[{size}]' if size else ''} {field};" for kind, field, size in _LAYOUTS[name])
        content.append(message("F", f"{name}:uint64_t timestamp;{fields}".encode()))
    content += [
        message("A", struct.pack("<BH", 0, number) + name.encode()) for number, (name, _, _) in enumerate(topics)
    ]
    rows: list[tuple[int, bytes]] = []
    for number, (name, at, values) in enumerate(topics):
        rows += zip(at.tolist(), _rows(name, number, at, values), strict=True)
    rows.sort(key=lambda row: row[0])
    Path(path).write_bytes(b"".join([*content, *(row for _, row in rows)]))


def message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def _rows(name: str, number: int, stamps: NDArray[np.int64], values: list[NDArray[Any]]) -> list[bytes]:
    """Return the data messages of a topic."""
    fields: list[Any] = [("size", "<u2"), ("kind", "u1"), ("number", "<u2"), ("timestamp", "<u8")]
    fields += [
        (field, _TYPES[kind], (size,)) if size else (field, _TYPES[kind]) for kind, field, size in _LAYOUTS[name]
    ]
    table = np.zeros(len(stamps), np.dtype(fields))
    table["size"], table["kind"], table["number"] = table.dtype.itemsize - 3, ord("D"), number
    table["timestamp"] = stamps
    for (_, field, _), column in zip(_LAYOUTS[name], values, strict=True):
        table[field] = column
    return [row.tobytes() for row in table]
