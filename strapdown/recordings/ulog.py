"""Flight logs of PX4 (ULog, ``.ulg``). Library: ``pyulog``.

``sensor_combined``: gyro rad/s and specific force m/s², in the body axes of the vehicle, forward, right, down (so at rest and level the
specific force is (0, 0, −9.81)). In addition ``vehicle_magnetometer`` (Gauss; for old logs the field in ``sensor_combined``) is read at the
nearest stamps, and as reference ``vehicle_attitude_groundtruth`` of a simulator, else ``vehicle_attitude``, the vehicle's estimate. PX4
gives them from body to North-East-Down, and they are transformed to East-North-Up here; its North is true North if the vehicle had a
position. Body axes are unchanged. Numbers are single precision. The clock counts µs from the start of the machine.

For a damaged or truncated log, the complete messages are read.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strapdown import quaternion
from strapdown.checks import Array, InputError, one_of
from strapdown.files import library
from strapdown.records import outputs
from strapdown.records.recording import Recording, beside, interpolated, relative_time, with_gyro

UNIT, FIELD, ATTITUDE = "sensor_combined", "vehicle_magnetometer", "vehicle_attitude"
TRUTH = "vehicle_attitude_groundtruth"
"""Attitude of a simulator, which is the reference if there is one."""
NO_SAMPLE = 0x7FFFFFFF
"""``accelerometer_timestamp_relative`` if there is no new sample."""
LATE = 0.5
"""Minimum time offset of the accelerometer, in sample intervals, that is reported."""


def read_ulog(file: Path, *, topic: str) -> Recording:
    """Read the inertial unit of a flight log."""
    log = opened(file, [UNIT, FIELD, ATTITUDE, TRUTH])
    data = {
        dataset.name if dataset.multi_id == 0 else f"{dataset.name}:{dataset.multi_id}": dataset.data
        for dataset in log.data_list
    }
    units = [name for name in data if name.startswith(UNIT) and len(data[name]["timestamp"])]
    if not units:
        raise InputError(f"{file.name} has no message of {UNIT} (it has: {', '.join(data) or 'none that is read'})")
    topic_name = one_of(f"{file.name}: topic", topic or units[0], units)
    stamps, order, remarks = in_order(topic_name, data[topic_name]["timestamp"])
    remarks = [f"Topic {topic_name}: {len(stamps)} messages.", *remarks]
    if log.file_corruption:
        remarks.append(f"{file.name} is damaged: only complete messages are read.")
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts)
        remarks.append(f"The logger lost {lost} ms in {len(log.dropouts)} dropouts.")
    time, epoch = relative_time(stamps * 1000)
    rows = data[topic_name]
    rate = columns(rows, "gyro_rad", 3)[order]
    force, offsets = _samples(rows, "accelerometer_m_s2", order)
    usual = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0
    late = float(np.median(offsets)) if len(offsets) else 0.0
    if abs(late) > LATE * usual:
        remarks.append(
            f"The accelerometer's samples are offset by {1e-3 * late:.3g} ms from the gyro's stamps, which is not corrected."
        )
    own: dict[str, Any] = {}
    if FIELD in data:
        at, kept, words = in_order(FIELD, data[FIELD].get("timestamp_sample", data[FIELD]["timestamp"]))
        samples = columns(data[FIELD], "magnetometer_ga", 3)[kept]
        own["magnetic_field"], remark = beside(FIELD, at * 1000, samples, time, epoch)
        remarks += [remark, *words]
    elif "magnetometer_ga[0]" in rows:
        own["magnetic_field"], _ = _samples(rows, "magnetometer_ga", order)
    own["magnetic_unit"] = "G" if "magnetic_field" in own else ""
    reference = next((name for name in (TRUTH, ATTITUDE) if name in data and len(data[name]["timestamp"]) > 1), None)
    if reference is not None:
        own["true_attitude"], words = _reference(reference, data[reference], time, epoch)
        remarks += words
    return with_gyro(
        source=file.name, time=time, rate=rate, specific_force=force, epoch_ns=epoch, remarks=tuple(remarks), **own
    )


def _reference(topic: str, rows: dict[str, Any], time: Array, epoch: int) -> tuple[Array, list[str]]:
    """Return the attitude of a topic (m, 4), q_fb, at times, s, and remarks on it."""
    stamps, kept, words = in_order(topic, rows["timestamp"])
    ned = quaternion.normalize(columns(rows, "q", 4)[kept])
    whose = "that of the simulator" if topic == TRUTH else "the vehicle's estimate"
    attitude = interpolated(time, (stamps * 1000 - epoch) / 1e9, outputs.to_ned(ned))
    return attitude, [f"Reference: {topic}, {whose}.", *words]


def opened(file: Path, topics: list[str]) -> Any:
    """Return a flight log with these topics, read by the library."""
    pyulog = library("pyulog", f"{file.name} is a flight log of PX4, which")
    with contextlib.redirect_stdout(io.StringIO()):  # the library prints its findings
        return pyulog.ULog(str(file), topics)


def columns(rows: dict[str, Any], name: str, size: int) -> Array:
    """Return the elements of an array field, one row per message."""
    if missing := [f"{name}[{k}]" for k in range(size) if f"{name}[{k}]" not in rows]:
        raise InputError(f"a message has no field {missing[0]} (it has: {', '.join(rows)}); the log is damaged")
    return np.stack([np.asarray(rows[f"{name}[{k}]"], np.float64) for k in range(size)], axis=1)


def _samples(rows: dict[str, Any], name: str, order: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the samples of a sensor in the messages of the gyro, NaN where there is no new one, and the time offsets of the others, µs."""
    samples = columns(rows, name, 3)[order]
    none = np.zeros_like(rows["timestamp"], np.int64)
    offsets = np.asarray(rows.get(f"{name.partition('_')[0]}_timestamp_relative", none))[order]
    samples[offsets == NO_SAMPLE] = np.nan
    return samples, offsets[offsets != NO_SAMPLE]


def in_order(topic: str, timestamp: Any) -> tuple[NDArray[np.int64], NDArray[np.int64], list[str]]:
    """Return stamps, µs, in order, their rows, and remarks; of repeated stamps only the first is kept."""
    stamps = np.asarray(timestamp).astype(np.int64)
    order = np.argsort(stamps, kind="stable")
    fresh = np.concatenate([[True], np.diff(stamps[order]) > 0])
    words = []
    back, twice = int(np.sum(np.diff(stamps) < 0)), int(np.sum(~fresh))
    if back:
        words.append(f"{back} messages of {topic} were out of order and were sorted.")
    if twice:
        words.append(f"{twice} messages of {topic} have the stamp of the one before and were left out.")
    kept = order[fresh]
    return stamps[kept], kept, words
