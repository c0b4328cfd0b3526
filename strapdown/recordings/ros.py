"""ROS bags: ROS 1 (``.bag``), ROS 2 in SQLite (``.db3``) and MCAP (``.mcap``), or the folder of a ROS 2 bag. Library: ``rosbags``.

``sensor_msgs/Imu``: angular velocity rad/s, linear acceleration m/s² (including gravity: at rest 9.81 upwards), in the axes of the
message's frame, which by REP 103 and 145 are x forward, y left, z up; its orientation is another filter's estimate and is ignored. In
addition ``sensor_msgs/MagneticField`` (T), ``sensor_msgs/Temperature`` (°C), and on a topic ``…reference`` a
``geometry_msgs/QuaternionStamped`` (q_fb, East-North-Up) are read, each at the nearest stamp of the inertial unit. The clock is that of the
headers' stamps, ns; if these are all zero, that of the recorder. Stamps out of order are sorted and counted.

The covariance of the orientation is written about the axes of the fixed frame, as REP 103 defines it for poses: ``R P Rᵀ`` of the filter's
body-side covariance. At stamps without an estimate the first element is −1.

The messages have a fixed layout after the name of their frame, so they are decoded as arrays.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strapdown import quaternion
from strapdown.checks import Array, InputError, one_of
from strapdown.files import reading
from strapdown.recordings.extras import library, with_ending
from strapdown.records import Estimate
from strapdown.records.recording import Recording, at_nearest, field_in, relative_time, with_gyro

IMU, FIELD, TEMPERATURE, REFERENCE = (
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/MagneticField",
    "sensor_msgs/msg/Temperature",
    "geometry_msgs/msg/QuaternionStamped",
)
DOUBLES = {IMU: 37, FIELD: 12, TEMPERATURE: 2, REFERENCE: 4}
"""Number of doubles after the header of each message."""
READ = {IMU: (13, 29), FIELD: (0, 3), TEMPERATURE: (0, 1), REFERENCE: (0, 4)}
"""Range of them that is read; for an inertial unit rate (3), its covariance (9), specific force (3), first element of its covariance."""
TOPICS = {IMU: "/imu/data_raw", FIELD: "/imu/mag", TEMPERATURE: "/imu/temperature", REFERENCE: "/imu/reference"}
"""Topics that are written, with the names of REP 145."""
WITH_ORIENTATION = "/imu/data"
FRAME = "imu_link"
BATCH = 1024
"""Number of messages processed at once: processing each one separately would double the time."""

_SUFFIX = {b"#ROSBAG V2.0\n": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
MAGICS = tuple(_SUFFIX)
"""First bytes of the kinds of bags."""


@dataclass(eq=False)
class _Topic:
    """The messages of one topic in the order of the bag: decoded, or raw if they are to be copied."""

    name: str
    kind: str
    ros2: bool = True
    decodes: bool = True
    logged: list[int] = field(default_factory=list)
    """Times of the recorder, ns."""
    parts: list[tuple[NDArray[np.int64], Array]] = field(default_factory=list)
    """Stamps, ns, and numbers of the messages, by batch."""
    fault: str = ""
    """Fault of the first message that cannot be decoded."""
    raw: list[bytes] = field(default_factory=list)

    def add(self, rows: Sequence[tuple[Any, int, bytes]]) -> None:
        """Append messages (connection, time of the recorder, content)."""
        raws = [raw for _, _, raw in rows]
        if not self.decodes:
            self.raw += raws
        elif not self.fault:
            try:
                self.parts.append(_decoded(raws, self.kind, self.ros2, len(self.logged)))
            except _UnreadableError as error:
                self.fault = str(error)
        self.logged += [logged for _, logged, _ in rows]

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.logged)


def is_folder(path: Path) -> bool:
    """Return whether a folder is a ROS 2 bag: metadata.yaml, or only storage files, if the recorder was killed."""
    return path.is_dir() and ((path / "metadata.yaml").is_file() or bool(_storages(path)))


def _storages(path: Path) -> list[Path]:
    """Return the storage files of a folder without metadata in order: those named as the folder, or with a number appended."""
    found = [one for suffix in (".mcap", ".db3") for one in path.glob(f"*{suffix}")]
    numbers = {one: re.fullmatch(rf"{re.escape(path.absolute().name)}(?:_(\d+))?", one.stem) for one in found}
    return sorted(
        (one for one, number in numbers.items() if number), key=lambda one: int((numbers[one] or [0, 0])[1] or 0)
    )


# ----------------------------------------------------------------------------------------------------------- reading


def read_bag(path: str | os.PathLike[str], *, topic: str = "") -> Recording:
    """Read the inertial unit of a bag, a file or a folder; ``topic`` selects one of several topics of ``sensor_msgs/Imu``."""
    file = Path(path)
    topics, _, remarks = _messages(file, wanted=tuple(DOUBLES))
    chosen = _chosen(file.name, topics, topic)
    stamps, values, order_words = _joined(file.name, topics[chosen])
    said = [f"Topic {chosen}: {len(stamps)} messages.", *remarks, *order_words]
    if values[0, 3] == -1.0:
        raise InputError(
            f"{file.name}, topic {chosen}: message 1 declares that it has no angular velocity; choose another topic"
        )
    time, epoch = relative_time(stamps)
    own: dict[str, Any] = {} if values[0, 15] == -1.0 else {"specific_force": values[:, 12:15]}
    for kind, name in ((FIELD, "magnetic_field"), (TEMPERATURE, "temperature"), (REFERENCE, "true_attitude")):
        other = _beside(chosen, [t for t in topics.values() if t.kind == kind and len(t)])
        if isinstance(other, str):
            said.append(other)
        if not isinstance(other, _Topic) or (kind == REFERENCE and not other.name.endswith("reference")):
            continue
        other_stamps, other_values, words = _joined(file.name, other)
        places = {FIELD: [0, 1, 2], TEMPERATURE: [0], REFERENCE: [3, 0, 1, 2]}[
            kind
        ]  # in ROS, w is last in a quaternion
        own[name], lost = at_nearest(time, (other_stamps - epoch) / 1e9, other_values[:, places])
        said += [
            f"Topic {other.name}: {len(other_stamps)} messages{f', {lost} of them beyond its stamps' if lost else ''}."
        ]
        said += words
    if "magnetic_field" in own:
        own["magnetic_unit"] = "T"
    if "temperature" in own:
        own["temperature"] = own["temperature"][:, 0]
    return with_gyro(source=file.name, time=time, rate=values[:, :3], epoch_ns=epoch, remarks=tuple(said), **own)


def _chosen(name: str, topics: Mapping[str, _Topic], topic: str) -> str:
    """Return the topic of the inertial unit: the one given, or the only one."""
    units = {t.name: t for t in topics.values() if t.kind == IMU}
    listed = ", ".join(f"{t.name} ({len(t)} messages)" for t in units.values())
    if topic:
        if not units:
            raise InputError(f"{name} has no topic of {IMU} (it has: {', '.join(topics) or 'none that is read'})")
        return one_of(f"{name}: topic", topic, units)
    filled = [t.name for t in units.values() if len(t)]
    if not filled:
        what = f"no message of {IMU}" + (f" on {listed}" if units else "")
        raise InputError(f"{name} has {what}; give a bag of an inertial unit")
    if len(filled) > 1:
        raise InputError(
            f"{name} has several inertial units: {listed}; choose one, --topic {filled[0]} (topic= in Python)"
        )
    return filled[0]


def _beside(unit: str, found: list[_Topic]) -> _Topic | str | None:
    """Return the topic of a kind that belongs to an inertial unit: the only one, or the only one of its namespace; else a remark."""
    if len(found) <= 1:
        return found[0] if found else None
    space = unit.rpartition("/")[0] + "/"
    near = [t for t in found if t.name.startswith(space)]
    if len(near) == 1:
        return near[0]
    names = ", ".join(t.name for t in found)
    return f"None of {names} was read, because it is ambiguous which of them belongs to {unit}."


class _UnreadableError(ValueError):
    """A message is not of the type of its topic."""


def _decoded(raws: list[bytes], kind: str, ros2: bool, before: int) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (n,), ns, and numbers (n, d) of messages of a type; ``before`` is the number of earlier messages."""
    wanted, (first, last) = DOUBLES[kind], READ[kind]
    lengths = np.fromiter(map(len, raws), np.int64, len(raws))
    stamps, values = np.empty(len(raws), np.int64), np.empty((len(raws), last - first))

    def refuse(rows: NDArray[np.int64], what: str) -> None:
        raise _UnreadableError(f"message {before + int(rows[0]) + 1} is {what}")

    for length in np.unique(lengths).tolist():
        rows = np.flatnonzero(lengths == length)
        if length < 16 + 8 * wanted:
            refuse(rows, f"{length} bytes long, shorter than its type")
        table = np.frombuffer(b"".join([raws[k] for k in rows.tolist()]), np.uint8).reshape(len(rows), length)
        if ros2 and not np.all((table[:, 0] == 0) & (table[:, 1] == 1)):
            refuse(rows[(table[:, 0] != 0) | (table[:, 1] != 1)], "in another encoding than little-endian CDR")
        words = table[:, 4:16].copy().view("<u4")  # seconds, nanoseconds, length of the frame's name
        for frame in np.unique(words[:, 2]).tolist():
            same = np.flatnonzero(words[:, 2] == frame)
            begin = 16 + frame
            begin += -(begin - 4) % 8 if ros2 else 0  # CDR aligns doubles
            if begin + 8 * wanted > length:
                refuse(rows[same], f"{length} bytes long, shorter than its type")
            numbers = table[:, begin + 8 * first : begin + 8 * last][same].view("<f8")
            values[rows[same]] = numbers
        stamps[rows] = words[:, 0].astype(np.int64) * 10**9 + words[:, 1]
    return stamps, values


def _joined(name: str, topic: _Topic) -> tuple[NDArray[np.int64], Array, list[str]]:
    """Return stamps (n,), ns, and numbers (n, d) of a topic's messages, in order of time, and remarks."""
    if topic.fault:
        raise InputError(f"{name}, topic {topic.name}: {topic.fault}; the bag is damaged or of another type")
    stamps, values = (np.concatenate(column) for column in zip(*topic.parts, strict=True))
    said = []
    if not stamps.any() and len(stamps) > 1:
        stamps = np.array(topic.logged, np.int64)
        said.append(f"The headers of {topic.name} have no stamps: time is that of the recorder.")
    back = int(np.sum(np.diff(stamps) < 0))
    if back:
        number = int(np.argmax(np.diff(stamps) < 0)) + 2
        order = np.argsort(stamps, kind="stable")
        stamps, values = stamps[order], values[order]
        said.append(
            f"{back} messages of {topic.name}, the first of them number {number}, were out of order and were sorted."
        )
    return stamps, values, said


def _messages(path: Path, wanted: tuple[str, ...] = ()) -> tuple[dict[str, _Topic], bool, tuple[str, ...]]:
    """Return the messages of a bag by topic, of the wanted types (empty: all), whether it is of ROS 2, and remarks."""
    files = [path]
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        files = _storages(path)
    topics: dict[str, _Topic] = {}
    with opened(path.name, files) as reader:
        ros2 = bool(reader.is2)
        chosen = [c for c in reader.connections if not wanted or c.msgtype in wanted]
        for c in chosen:
            topics.setdefault(c.topic, _Topic(c.topic, c.msgtype, ros2=ros2, decodes=bool(wanted)))
        if chosen:
            messages = reader.messages(connections=chosen)
            while batch := list(islice(messages, BATCH)):
                for name in {connection.topic for connection, _, _ in batch}:
                    topics[name].add([row for row in batch if row[0].topic == name])
    words: tuple[str, ...] = ()
    if files != [path]:
        words = (f"{path.name} has no metadata.yaml, as if the recorder was killed: read from its {len(files)} files.",)
    return topics, ros2, words


@contextlib.contextmanager
def opened(name: str, files: Sequence[Path]) -> Iterator[Any]:
    """Yield the library's reader of the files of a bag; any exception of its parsers is an InputError."""
    highlevel = library("rosbags.highlevel", f"{name} is a ROS bag, which")
    typesys = library("rosbags.typesys", f"{name} is a ROS bag, which")
    try:
        with tempfile.TemporaryDirectory() as folder:
            store = typesys.get_typestore(typesys.Stores.LATEST)
            named = [named_as(one, Path(folder)) for one in files]
            with highlevel.AnyReader(named, default_typestore=store) as reader:
                yield reader
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{name} cannot be read as a ROS bag ({reason}); if it is truncated, restore its index by `rosbag reindex` (ROS 1), "
            "`ros2 bag reindex` or `mcap recover`"
        ) from None


def named_as(path: Path, folder: Path) -> Path:
    """Return a path whose extension matches its content, because the library distinguishes bags by extension."""
    if path.is_dir():
        return path
    with reading.opened(path) as stream:
        head = stream.read(16)
    suffix = next((suffix for magic, suffix in _SUFFIX.items() if head.startswith(magic)), path.suffix)
    return with_ending(path, suffix, folder)


# ----------------------------------------------------------------------------------------------------------- writing


def write_bag(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording as a bag in one file: ``.bag`` ROS 1, ``.mcap`` and ``.db3`` ROS 2.

    Missing samples are not written; the unit of the magnetometer must be known.
    """
    _write(Path(path), _series(recording, None))


def write_estimate(
    estimate: Estimate, path: str | os.PathLike[str], *, recording: Recording | None = None, source: Path | None = None
) -> None:
    """Write the samples that an estimate was made from as a bag, with the estimated orientation and its covariance.

    All other topics of ``source``, the bag that the recording was read from, are copied unchanged if it is of the same ROS version.
    """
    assert recording is not None
    target = Path(path)
    series = _series(recording, estimate)
    others: list[_Topic] = []
    if source is not None:
        topics, ros2, _ = _messages(source)
        if ros2 == (target.suffix.lower() != ".bag"):
            written = {TOPICS[kind] if kind != IMU else WITH_ORIENTATION for kind, _, _ in series}
            others = [t for t in topics.values() if t.kind != IMU and t.name not in written]
    _write(target, series, others, source)


_Series = tuple[str, NDArray[np.int64], Array]


def _series(recording: Recording, estimate: Estimate | None) -> list[_Series]:
    """Return the messages of a recording by type: stamps, ns, and the numbers after the header."""
    stamps = recording.clock_ns
    if stamps[0] < 0:
        raise InputError(
            f"{recording.source}: time begins at {recording.time[0]:g} s, and a bag's clock has no negative times; shift it"
        )
    imu = np.zeros((len(stamps), DOUBLES[IMU]))
    imu[:, 3] = 1.0
    imu[:, 4] = -1.0  # no orientation
    if estimate is not None:
        _fill_orientation(imu, recording, estimate)
    imu[:, 13:16] = recording.rate
    if recording.specific_force is None:
        imu[:, 28] = -1.0
    else:
        imu[:, 25:28] = recording.specific_force
    found: list[_Series] = [(IMU, stamps, imu)]
    if recording.magnetic_field is not None:
        known = ~np.isnan(recording.magnetic_field).any(axis=1)
        magnetic = np.zeros((int(known.sum()), DOUBLES[FIELD]))
        magnetic[:, :3] = field_in("T", recording)[known]
        found.append((FIELD, stamps[known], magnetic))
    if recording.temperature is not None:
        known = ~np.isnan(recording.temperature)
        found.append(
            (TEMPERATURE, stamps[known], np.stack([recording.temperature[known], np.zeros(known.sum())], axis=1))
        )
    if recording.true_attitude is not None:
        known = ~np.isnan(recording.true_attitude).any(axis=1)
        found.append((REFERENCE, stamps[known], recording.true_attitude[known][:, [1, 2, 3, 0]]))
    return found


def _fill_orientation(imu: Array, recording: Recording, estimate: Estimate) -> None:
    """Write an estimate's attitude and covariance into the messages at its stamps."""
    places = np.clip(np.searchsorted(recording.time, estimate.time - 1e-7), 0, len(recording.time) - 1)
    same = np.abs(recording.time[places] - estimate.time) < 1e-6
    if not same.any():
        raise InputError(
            f"{recording.source} and the estimate have no stamp in common; give the recording that the estimate was made from"
        )
    rows, q = places[same], estimate.attitude[same]
    imu[rows, 0:4] = q[:, [1, 2, 3, 0]]
    body = np.zeros((len(q), 3, 3))
    if estimate.covariance is not None:
        body[:] = estimate.covariance[same, :3, :3]
    else:
        body[:, [0, 1, 2], [0, 1, 2]] = estimate.variance[same, :3]
    turn = quaternion.to_matrix(q)
    imu[rows, 4:13] = (turn @ body @ np.swapaxes(turn, 1, 2)).reshape(-1, 9)


def _encoded(stamps: NDArray[np.int64], numbers: Array, ros2: bool) -> NDArray[np.uint8]:
    """Return messages as rows of bytes."""
    frame = FRAME.encode() + (b"\0" if ros2 else b"")
    begin = 16 + len(frame)
    begin += -(begin - 4) % 8 if ros2 else 0
    table = np.zeros((len(stamps), begin + 8 * numbers.shape[1]), np.uint8)
    words = np.zeros((len(stamps), 4), "<u4")
    words[:, 0] = (
        256 if ros2 else np.arange(len(stamps))
    )  # 00 01 00 00: little-endian CDR; in ROS 1 the sequence number of the header
    words[:, 1], words[:, 2], words[:, 3] = stamps // 10**9, stamps % 10**9, len(frame)
    table[:, :16] = words.view(np.uint8)
    table[:, 16 : 16 + len(frame)] = np.frombuffer(frame, np.uint8)
    table[:, begin:] = np.ascontiguousarray(numbers, "<f8").view(np.uint8)
    return table


def _write(target: Path, series: list[_Series], others: list[_Topic] | None = None, source: Path | None = None) -> None:
    """Write messages in the order of their times; the bag is created only when complete."""
    what = f"writing {target.name}"
    ros2 = target.suffix.lower() != ".bag"
    typesys = library("rosbags.typesys", what)
    store = typesys.get_typestore(typesys.Stores.LATEST if ros2 else typesys.Stores.ROS1_NOETIC)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.stem}-", dir=target.parent) as folder:
        place = Path(folder) / f"bag{'' if ros2 else '.bag'}"
        with _writer(place, target.suffix.lower(), what) as writer:
            queue: list[tuple[int, Any, bytes | memoryview]] = []
            for kind, stamps, numbers in series:
                name = WITH_ORIENTATION if kind == IMU and np.any(numbers[:, 4] != -1.0) else TOPICS[kind]
                connection = writer.add_connection(name, kind, typestore=store)
                rows = _encoded(stamps, numbers, ros2)
                queue += [(stamp, connection, row.tobytes()) for stamp, row in zip(stamps.tolist(), rows, strict=True)]
            if others and source is not None:
                queue += _copied(writer, others, source)
            queue.sort(key=lambda one: one[0])
            for stamp, connection, data in queue:
                writer.write(connection, stamp, data)
        made = place if not ros2 else next(one for one in place.iterdir() if one.suffix == target.suffix.lower())
        if target.is_dir():
            raise InputError(f"{target} is a folder; choose another name")
        shutil.move(made, target)


def _writer(place: Path, suffix: str, what: str) -> Any:
    if suffix == ".bag":
        return library("rosbags.rosbag1", what).Writer(place)
    rosbag2 = library("rosbags.rosbag2", what)
    plugin = rosbag2.StoragePlugin.MCAP if suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    return rosbag2.Writer(place, version=9, storage_plugin=plugin)


def _copied(writer: Any, topics: list[_Topic], source: Path) -> list[tuple[int, Any, bytes]]:
    """Return the messages of topics that are copied unchanged, with their types from the source."""
    queue = []
    with opened(source.name, [source]) as reader:
        for topic in topics:
            connection = writer.add_connection(topic.name, topic.kind, typestore=reader.typestore)
            queue += [(logged, connection, raw) for logged, raw in zip(topic.logged, topic.raw, strict=True)]
    return queue
