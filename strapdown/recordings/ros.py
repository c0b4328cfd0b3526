"""ROS bags: ROS 1 (``.bag``), ROS 2 in SQLite (``.db3``) and MCAP (``.mcap``), or the folder of a ROS 2 bag. Library: ``rosbags``.

``sensor_msgs/Imu``: angular velocity rad/s, linear acceleration m/s² (including gravity: at rest 9.81 upwards), in the axes of the
message's frame, which by REP 103 and 145 are x forward, y left, z up; its orientation is another filter's estimate and is ignored. In
addition ``sensor_msgs/MagneticField`` (T), ``sensor_msgs/Temperature`` (°C), and on a topic ``…reference`` a
``geometry_msgs/QuaternionStamped`` (q_fb, East-North-Up) are read, each at the nearest stamp of the inertial unit. The clock is that of the
headers' stamps, ns; if these are all zero, that of the recorder. Stamps out of order are sorted and counted.

The covariance of the orientation is written about the axes of the fixed frame, as REP 103 defines it for poses: ``R P Rᵀ`` of the filter's
body-side covariance. At stamps without an estimate the first element is −1.

The messages have a fixed layout after the name of their frame, so they are decoded as arrays. A truncated bag, which the library rejects,
is scanned record by record, and its complete messages are read.
"""

from __future__ import annotations

import bz2
import contextlib
import os
import re
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strapdown import quaternion
from strapdown.checks import Array, InputError, one_of
from strapdown.files import reading
from strapdown.files.extras import library, with_ending
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

ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"
_SUFFIX = {ROS1_MAGIC: ".bag", MCAP_MAGIC: ".mcap", SQLITE_MAGIC: ".db3"}
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
    """Return the storage files of a folder in order: with metadata all, else those named as the folder, or with a number appended."""
    found = [one for suffix in (".mcap", ".db3") for one in path.glob(f"*{suffix}")]
    name = ".*?" if (path / "metadata.yaml").is_file() else re.escape(path.absolute().name)
    numbers = {one: re.fullmatch(rf"{name}(?:_(\d+))?", one.stem) for one in found}
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


_Messages = tuple[dict[str, _Topic], bool, tuple[str, ...]]


def _messages(path: Path, wanted: tuple[str, ...] = ()) -> _Messages:
    """Return the messages of a bag by topic, of the wanted types (empty: all), whether it is of ROS 2, and remarks."""
    files = [path]
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        files = _storages(path)
    topics: dict[str, _Topic] = {}
    try:
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
    except DamagedBagError as error:
        return _salvaged(path, files, wanted, error)
    words: tuple[str, ...] = ()
    if files != [path]:
        words = (f"{path.name} has no metadata.yaml, as if the recorder was killed: read from its {len(files)} files.",)
    return topics, ros2, words


class DamagedBagError(InputError):
    """The library cannot read a bag."""


@contextlib.contextmanager
def opened(name: str, files: Sequence[Path]) -> Iterator[Any]:
    """Yield the library's reader of the files of a bag; any exception of its parsers is a :class:`DamagedBagError`."""
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
    except Exception as error:  # for a truncated file the library raises any exception of its parsers
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DamagedBagError(f"{name} cannot be read as a ROS bag ({reason})") from None


def named_as(path: Path, folder: Path) -> Path:
    """Return a path whose extension matches its content, because the library distinguishes bags by extension."""
    if path.is_dir():
        return path
    with reading.opened(path) as stream:
        head = stream.read(16)
    suffix = next((suffix for magic, suffix in _SUFFIX.items() if head.startswith(magic)), path.suffix)
    return with_ending(path, suffix, folder)


# ----------------------------------------------------------------------------------------------------------- damaged bags


def _salvaged(path: Path, files: list[Path], wanted: tuple[str, ...], error: InputError) -> _Messages:
    """Return the complete messages of a bag that the library cannot open."""
    topics: dict[str, _Topic] = {}
    ros2 = True
    for file in _storages(path) if path.is_dir() else files:
        with reading.opened(file) as stream:
            head = stream.read(16)
            scan = next((scan for magic, scan in _SCANS.items() if head.startswith(magic)), None)
            if scan is None:
                continue
            ros2 = not head.startswith(ROS1_MAGIC)
            found = scan(file)
            while batch := list(islice(found, BATCH)):
                for name, kind in dict.fromkeys(row[:2] for row in batch):
                    if not wanted or kind in wanted:
                        topic = topics.setdefault(name, _Topic(name, kind, ros2=ros2, decodes=bool(wanted)))
                        topic.add([(None, *row[2:]) for row in batch if row[0] == name])
    number = sum(len(topic) for topic in topics.values())
    if not number:
        raise InputError(f"{error}, and has no complete message; record it again")
    return topics, ros2, (f"{error}: it is truncated or damaged, and only its {number} complete messages are read.",)


_Message = tuple[str, str, int, bytes]


def _scan_ros1(path: Path) -> Iterator[_Message]:
    """Yield the complete messages of a ROS 1 bag, record by record, without its index."""
    connections: dict[int, tuple[str, str]] = {}

    def records(data: memoryview) -> Iterator[tuple[dict[bytes, bytes], memoryview, bool]]:
        place = 0
        while place + 4 <= len(data):
            (size,) = struct.unpack_from("<I", data, place)
            end = place + 4 + size
            if end + 4 > len(data):
                return
            fields, at = {}, place + 4
            while at + 4 <= end:
                (length,) = struct.unpack_from("<I", data, at)
                key, _, value = bytes(data[at + 4 : at + 4 + length]).partition(b"=")
                fields[key] = value
                at += 4 + length
            (size,) = struct.unpack_from("<I", data, end)
            yield fields, data[end + 4 : end + 4 + size], end + 4 + size <= len(data)
            place = end + 4 + size

    def messages(data: memoryview) -> Iterator[_Message]:
        for fields, content, whole in records(data):
            kind = fields.get(b"op", b"")
            if kind == b"\x05":
                packed = fields.get(b"compression", b"none")
                if packed == b"none":
                    yield from messages(content)
                elif whole:
                    yield from messages(memoryview(_unpack(packed.decode(), bytes(content))))
            elif kind == b"\x07" and whole:
                number = struct.unpack("<I", fields[b"conn"])[0]
                own = next(
                    (f for f, _, _ in records(memoryview(struct.pack("<I", len(content)) + bytes(content) + bytes(4)))),
                    {},
                )
                connections[number] = (fields[b"topic"].decode(), _ros2_name(own.get(b"type", b"").decode()))
            elif kind == b"\x02" and whole:
                topic = connections.get(struct.unpack("<I", fields[b"conn"])[0])
                if topic is not None:
                    seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
                    yield *topic, seconds * 10**9 + nanoseconds, bytes(content)

    with reading.opened(path) as stream:
        stream.seek(len(ROS1_MAGIC))
        yield from messages(memoryview(stream.read()))


def _ros2_name(kind: str) -> str:
    package, _, name = kind.partition("/")
    return kind if name.startswith("msg/") else f"{package}/msg/{name}"


def _scan_mcap(path: Path) -> Iterator[_Message]:
    """Yield the complete messages of an MCAP file, record by record, without its summary."""
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}

    def text(data: memoryview, place: int) -> tuple[str, int]:
        (size,) = struct.unpack_from("<I", data, place)
        return bytes(data[place + 4 : place + 4 + size]).decode(), place + 4 + size

    def messages(data: memoryview) -> Iterator[_Message]:
        place = 0
        while place + 9 <= len(data):
            kind, size = struct.unpack_from("<BQ", data, place)
            content = data[place + 9 : place + 9 + size]
            whole = len(content) == size
            place += 9 + size
            if kind == 0x06 and len(content) > 40:
                packed, at = text(content, 28)
                inner = content[at + 8 :]
                if not packed:
                    yield from messages(inner)
                elif whole:
                    yield from messages(memoryview(_unpack(packed, bytes(inner))))
            elif kind == 0x03 and whole:
                schemas[struct.unpack_from("<H", content)[0]] = text(content, 2)[0]
            elif kind == 0x04 and whole:
                number, schema = struct.unpack_from("<HH", content)
                channels[number] = (text(content, 4)[0], schemas.get(schema, ""))
            elif kind == 0x05 and whole and size >= 22:
                number, _, logged, _ = struct.unpack_from("<HIQQ", content)
                if number in channels:
                    yield *channels[number], logged, bytes(content[22:])

    with reading.opened(path) as stream:
        stream.seek(len(MCAP_MAGIC))
        yield from messages(memoryview(stream.read()))


def _scan_sqlite(path: Path) -> Iterator[_Message]:
    """Yield the rows of a ROS 2 database up to where it is damaged.

    SQLite rejects a database shorter than its header states, so a copy is padded with zeros; reading ends at the first of them.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "filled.db3"
        shutil.copyfile(path, copy)
        with open(copy, "r+b") as stream:
            header = stream.read(32)
            if len(header) < 32:
                return
            (size,) = struct.unpack_from(">H", header, 16)
            size = 65536 if size == 1 else size
            stream.truncate(copy.stat().st_size // size * size)  # an incomplete page would be read as rows of zeros
            stream.truncate(struct.unpack_from(">I", header, 28)[0] * size)
        database = sqlite3.connect(f"{copy.as_uri()}?immutable=1", uri=True)
        try:
            topics = {
                number: (name, kind) for number, name, kind in database.execute("SELECT id, name, type FROM topics")
            }
            for number, logged, raw in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
                if number in topics:
                    yield *topics[number], logged, raw
        except sqlite3.DatabaseError:
            return
        finally:
            database.close()


def _unpack(compression: str, data: bytes) -> bytes:
    if compression == "bz2":
        return bz2.decompress(data)
    if compression == "lz4":
        unpacked: bytes = library("lz4.frame", "a bag compressed by lz4").decompress(data)
        return unpacked
    if compression == "zstd":
        unpacked = library("backports.zstd", "a bag compressed by zstd").decompress(data)
        return unpacked
    return b""


_SCANS: dict[bytes, Callable[[Path], Iterator[_Message]]] = {
    ROS1_MAGIC: _scan_ros1,
    MCAP_MAGIC: _scan_mcap,
    SQLITE_MAGIC: _scan_sqlite,
}


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
