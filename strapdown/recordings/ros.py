"""ROS bags: ROS 1 (``.bag``), ROS 2 in SQLite (``.db3``) and MCAP (``.mcap``), or the folder of a ROS 2 bag. Library: ``rosbags``.

``sensor_msgs/Imu``: angular velocity rad/s, linear acceleration m/s² (including gravity: at rest 9.81 upwards), in the axes of the
message's frame, which by REP 103 and 145 are x forward, y left, z up; its orientation is another filter's estimate and is ignored. In
addition ``sensor_msgs/MagneticField`` (T), ``sensor_msgs/Temperature`` (°C), and on a topic ``…reference`` a
``geometry_msgs/QuaternionStamped`` (q_fb, East-North-Up) are read, each at the nearest stamp of the inertial unit. The clock is that of the
headers' stamps, ns; if these are all zero, that of the recorder. Stamps out of order are sorted and counted.

The covariance of the orientation is written about the axes of the fixed frame, as REP 103 defines it for poses: ``R P Rᵀ`` of the filter's
body-side covariance. At stamps without an estimate the first element is −1.

The library reads and writes the bags. The messages have a fixed layout after the name of their frame, so they are decoded here as arrays.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strapdown import quaternion
from strapdown.checks import Array, Hint, InputError, one_of
from strapdown.files import library, reading
from strapdown.records import Estimate
from strapdown.records.recording import Recording, beside, field_in, matched, relative_time, with_gyro

ROS1 = b"#ROSBAG V2.0\n"
BEGINNINGS = (ROS1, b"\x89MCAP0\r\n", b"SQLite format 3\0")
"""First bytes of the kinds of files."""

IMU, FIELD, TEMPERATURE, REFERENCE = (
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/MagneticField",
    "sensor_msgs/msg/Temperature",
    "geometry_msgs/msg/QuaternionStamped",
)
POSE, POSE_COVARIANCE, ODOMETRY = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
DOUBLES = {IMU: 37, FIELD: 12, TEMPERATURE: 2, REFERENCE: 4, POSE: 7, POSE_COVARIANCE: 43, ODOMETRY: 85}
"""Number of doubles after the header of each message; that of odometry also has the name of a second frame."""
READ = {IMU: (13, 29), FIELD: (0, 3), TEMPERATURE: (0, 1), REFERENCE: (0, 4)}
"""Range of them that is read; for an inertial unit rate (3), its covariance (9), specific force (3), first element of its covariance."""
ORIENTED = {IMU: (0, 13), ODOMETRY: (3, 43), POSE_COVARIANCE: (3, 43), POSE: (3, 7), REFERENCE: (0, 4)}
"""Range of the orientation, scalar last, and of its covariance, 3 × 3 or the last rows and columns of 6 × 6, if there is one."""
TOPICS = {IMU: "/imu/data_raw", FIELD: "/imu/mag", TEMPERATURE: "/imu/temperature", REFERENCE: "/imu/reference"}
"""Topics that are written, with the names of REP 145."""
WITH_ORIENTATION = "/imu/data"
MAX_LATE = 5
"""Maximum number of messages in a row that are late and alternate with others in order of time."""
FRAME = "imu_link"


@dataclass(eq=False)
class Topic:
    """The messages of one topic in the order of the recorder's times."""

    name: str
    kind: str
    ros2: bool
    definition: str = ""
    """Definition of the messages' type that the bag has."""
    logged: list[int] = field(default_factory=list)
    """Times of the recorder, ns."""
    raw: list[bytes] = field(default_factory=list)

    def decoded(self, source: str, span: tuple[int, int]) -> tuple[NDArray[np.int64], Array, list[str]]:
        """Return stamps (n,), ns, and a range of the numbers (n, d) of the messages in order of time, and remarks."""
        stamps, values = _decoded(f"{source}, topic {self.name}", self.raw, self.kind, span, self.ros2)
        remarks = []
        if not stamps.any() and len(stamps) > 1:
            stamps = np.array(self.logged, np.int64)
            remarks.append(f"The headers of {self.name} have no stamps: time is that of the recorder.")
        back = np.diff(stamps) < 0
        if back.any():
            _refuse_repeated_time(f"{source}, topic {self.name}", stamps)
            order = np.argsort(stamps, kind="stable")
            stamps, values = stamps[order], values[order]
            remarks.append(
                f"{back.sum()} messages of {self.name}, the first of them number {np.argmax(back) + 2}, were out of order and were sorted."
            )
        return stamps, values, remarks

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.logged)


def _refuse_repeated_time(place: str, stamps: NDArray[np.int64]) -> None:
    """Reject a clock that was set back: messages before and after it alternate in order of time, while late ones fill a hole."""
    latest = np.maximum.accumulate(stamps)
    behind = np.concatenate([[False], stamps < latest, [False]])
    for first, end in np.flatnonzero(np.diff(behind)).reshape(-1, 2).tolist():
        late = stamps[first:end]
        between = np.sum((stamps[:first] > late[0]) & (stamps[:first] < late.max())) if end - first > MAX_LATE else 0
        if between > MAX_LATE:
            back = (latest[first] - late[0]) / 1e9
            raise InputError(
                f"{place}: the clock goes back by {back:.6g} s at message {first + 1}, and {len(late)} messages repeat times before it; "
                "cut the bag there (`rosbag filter`, `mcap filter`)"
            )


# ----------------------------------------------------------------------------------------------------------- reading


def read_bag(file: Path, *, topic: str) -> Recording:
    """Read the inertial unit of a bag, a file or a folder; ``topic`` selects one of several topics of ``sensor_msgs/Imu``."""
    topics = topics_of(file, READ)
    topic_name = topic_of(file.name, topics, topic, "inertial units", [IMU]).name
    stamps, values, order_words = topics[topic_name].decoded(file.name, READ[IMU])
    said = [f"Topic {topic_name}: {len(stamps)} messages.", *order_words]
    if values[0, 3] == -1.0:
        raise InputError(f"{file.name}, topic {topic_name}: its messages have no angular velocity; choose another")
    time, epoch = relative_time(stamps)
    own: dict[str, Any] = {} if values[0, 15] == -1.0 else {"specific_force": values[:, 12:15]}
    units = [t.name for t in topics.values() if t.kind == IMU]
    for kind, name in ((FIELD, "magnetic_field"), (TEMPERATURE, "temperature"), (REFERENCE, "true_attitude")):
        other = _beside(topic_name, [t for t in topics.values() if t.kind == kind and len(t)], units)
        if isinstance(other, str):
            said.append(other)
        if not isinstance(other, Topic) or (kind == REFERENCE and not other.name.endswith("reference")):
            continue
        other_stamps, other_values, words = other.decoded(file.name, READ[kind])
        # In ROS, w is last in a quaternion.
        places = {FIELD: [0, 1, 2], TEMPERATURE: [0], REFERENCE: [3, 0, 1, 2]}[kind]
        own[name], remark = beside(other.name, other_stamps, other_values[:, places], time, epoch)
        said += [remark, *words]
    if "temperature" in own:
        own["temperature"] = own["temperature"][:, 0]
    unit = "T" if "magnetic_field" in own else ""
    return with_gyro(
        source=file.name, time=time, rate=values[:, :3], magnetic_unit=unit, epoch_ns=epoch, remarks=tuple(said), **own
    )


def topic_of(name: str, topics: Mapping[str, Topic], topic: str, what: str, kinds: Collection[str]) -> Topic:
    """Return the topic of one of these kinds that is named, or the only one; ``what`` they are, for messages."""
    filled = {t.name: t for t in topics.values() if t.kind in kinds and len(t)}
    if not filled:
        others = f" (it has: {', '.join(topics)})" if topics else ""
        raise InputError(f"{name} has no message of {' or '.join(kinds)}{others}; give a bag with {what}")
    if topic:
        return filled[one_of(f"{name}: topic", topic, filled)]
    first, *more = filled.values()
    if more:
        kind = {t.name: f"{t.kind.rpartition('/')[2]}, " if len(kinds) > 1 else "" for t in filled.values()}
        listed = ", ".join(f"{t.name} ({kind[t.name]}{len(t)} messages)" for t in filled.values())
        raise InputError(f"{name} has several {what}: {listed}; choose one, {Hint('topic', first.name)}")
    return first


def _beside(unit: str, candidates: list[Topic], units: list[str]) -> Topic | str | None:
    """Return the topic of a kind that belongs to one of the inertial units: the only one of its namespace or, failing that, of none's."""
    space = {name: name.rpartition("/")[0] + "/" for name in units if "/" in name[1:]}
    nearest = {t: max((s for s in space.values() if t.name.startswith(s)), key=len, default="") for t in candidates}
    near = [t for t in candidates if nearest[t] == space.get(unit)] or [t for t in candidates if not nearest[t]]
    if len(near) == 1 or not candidates:
        return near[0] if near else None
    names = ", ".join(t.name for t in candidates)
    return f"None of {names} was read, because it is ambiguous which of them, if any, belongs to {unit}."


def _decoded(
    place: str, raws: Sequence[bytes], kind: str, span: tuple[int, int], ros2: bool
) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (n,), ns, and a range of the doubles (n, d) of messages of a type."""
    first, last = span
    lengths = np.fromiter(map(len, raws), np.int64, len(raws))
    stamps, values = np.empty(len(raws), np.int64), np.empty((len(raws), last - first))

    def refuse(wrong: NDArray[np.bool_], rows: NDArray[np.int64], what: str) -> None:
        if wrong.any():
            number = int(rows[np.argmax(wrong)]) + 1
            raise InputError(f"{place}: message {number} is {what}; the bag is damaged or of another type")

    for length in np.unique(lengths).tolist():
        rows = np.flatnonzero(lengths == length)
        short = f"{length} bytes long, shorter than its type"
        refuse(np.full(len(rows), length < 16 + 8 * DOUBLES[kind]), rows, short)
        table = np.frombuffer(b"".join([raws[k] for k in rows.tolist()]), np.uint8).reshape(len(rows), length)
        if ros2:
            refuse((table[:, 0] != 0) | (table[:, 1] != 1), rows, "in another encoding than little-endian CDR")
        words = table[:, 4:16].copy().view("<u4").astype(np.int64)  # seconds, nanoseconds, length of the frame's name
        begin = 16 + words[:, 2]
        if kind == ODOMETRY:  # the name of a second frame
            begin += -begin % 4 if ros2 else 0
            refuse(begin + 4 > length, rows, short)
            bytes_of_length = begin[:, None] + np.arange(4)
            begin += 4 + np.take_along_axis(table, bytes_of_length, axis=1).view("<u4")[:, 0]
        begin += -(begin - 4) % 8 if ros2 else 0  # CDR aligns doubles
        refuse(begin + 8 * DOUBLES[kind] > length, rows, short)
        for start in np.unique(begin).tolist():
            same = np.flatnonzero(begin == start)
            values[rows[same]] = table[:, start + 8 * first : start + 8 * last][same].view("<f8")
        stamps[rows] = words[:, 0] * 10**9 + words[:, 1]
    return stamps, values


def topics_of(path: Path, kinds: Collection[str] = ()) -> dict[str, Topic]:
    """Return the messages of a bag by topic, of these types or, if there are none, of all."""
    ros2 = path.is_dir()
    if not ros2:
        with reading.opened(path) as file:
            ros2 = file.read(len(ROS1)) != ROS1
    rosbag = library(f"rosbags.rosbag{2 if ros2 else 1}", f"{path.name} is a ROS bag, which")
    topics: dict[str, Topic] = {}
    try:
        with rosbag.Reader(path) as reader:
            connections = [c for c in reader.connections if not kinds or c.msgtype in kinds]
            for c in connections:
                definition = c.msgdef.data if c.msgdef.format.name == "MSG" else ""
                topics[c.topic] = Topic(c.topic, c.msgtype, ros2, definition)
            for connection, logged, data in reader.messages(connections) if connections else ():
                topics[connection.topic].logged.append(logged)
                topics[connection.topic].raw.append(data)
    except rosbag.ReaderError as error:
        raise InputError(
            f"{path.name} cannot be read as a ROS bag ({error}); if its recorder was killed, repair it by `rosbag reindex`, "
            "`ros2 bag reindex` or `mcap recover`"
        ) from error
    return topics


# ----------------------------------------------------------------------------------------------------------- writing


def write_bag(recording: Recording, target: Path) -> None:
    """Write a recording as a bag in one file: ``.bag`` ROS 1, ``.mcap`` and ``.db3`` ROS 2.

    Missing samples are not written; the unit of the magnetometer must be known.
    """
    _write(target, _series(recording, None))


def write_estimate(
    estimate: Estimate, target: Path, *, recording: Recording | None, source: Path | None = None
) -> None:
    """Write the samples that an estimate was made from as a bag, with the estimated orientation and its covariance.

    All other topics of ``source``, the bag that the recording was read from, are copied unchanged if it is of the same ROS version.
    """
    assert recording is not None
    series = _series(recording, estimate)
    others: list[Topic] = []
    if source is not None:
        ros2 = target.suffix.lower() != ".bag"
        written = {TOPICS[kind] if kind != IMU else WITH_ORIENTATION for kind, _, _ in series}
        topics = topics_of(source).values()
        others = [t for t in topics if t.ros2 == ros2 and t.kind != IMU and t.name not in written]
    _write(target, series, others)


_Series = tuple[str, NDArray[np.int64], Array]


def _series(recording: Recording, estimate: Estimate | None) -> list[_Series]:
    """Return the messages of a recording by type: stamps, ns, and the numbers after the header."""
    stamps = recording.clock_ns
    if stamps[0] < 0:
        raise InputError(
            f"{recording.source}: time begins at {recording.time[0]:g} s, and a bag has no negative times; shift it"
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
    series: list[_Series] = [(IMU, stamps, imu)]
    attitude = recording.true_attitude
    others = {
        FIELD: None if recording.magnetic_field is None else field_in("T", recording),
        TEMPERATURE: None if recording.temperature is None else recording.temperature[:, None],
        REFERENCE: None if attitude is None else attitude[:, [1, 2, 3, 0]],
    }
    for kind, values in others.items():
        if values is not None:
            known = ~np.isnan(values).any(axis=1)
            numbers = np.zeros((int(known.sum()), DOUBLES[kind]))
            numbers[:, : values.shape[1]] = values[known]
            series.append((kind, stamps[known], numbers))
    return series


def _fill_orientation(imu: Array, recording: Recording, estimate: Estimate) -> None:
    """Write an estimate's attitude and covariance into the messages at its stamps."""
    places, same = matched(recording.time, estimate.time, 1e-6)
    if not same.any():
        raise InputError(
            f"{recording.source} and the estimate have no stamp in common; give the recording it was made from"
        )
    rows, q = places[same], estimate.attitude[same]
    imu[rows, 0:4] = q[:, [1, 2, 3, 0]]
    P = estimate.attitude_covariance
    body = np.zeros((len(q), 3, 3)) if P is None else P[same]
    turn = quaternion.to_matrix(q)
    imu[rows, 4:13] = (turn @ body @ np.swapaxes(turn, 1, 2)).reshape(-1, 9)


def _encoded(stamps: NDArray[np.int64], numbers: Array, ros2: bool) -> NDArray[np.uint8]:
    """Return messages as rows of bytes."""
    frame = FRAME.encode() + (b"\0" if ros2 else b"")
    begin = 16 + len(frame)
    begin += -(begin - 4) % 8 if ros2 else 0
    table = np.zeros((len(stamps), begin + 8 * numbers.shape[1]), np.uint8)
    words = np.zeros((len(stamps), 4), "<u4")
    # 00 01 00 00: little-endian CDR; in ROS 1 the sequence number of the header.
    words[:, 0] = 256 if ros2 else np.arange(len(stamps))
    words[:, 1], words[:, 2], words[:, 3] = stamps // 10**9, stamps % 10**9, len(frame)
    table[:, :16] = words.view(np.uint8)
    table[:, 16 : 16 + len(frame)] = np.frombuffer(frame, np.uint8)
    table[:, begin:] = np.ascontiguousarray(numbers, "<f8").view(np.uint8)
    return table


def _write(target: Path, series: list[_Series], others: Sequence[Topic] = ()) -> None:
    """Write messages in the order of their times; the bag is created only when complete."""
    what = f"writing {target.name}"
    ros2 = target.suffix.lower() != ".bag"
    typesys = library("rosbags.typesys", what)
    store = typesys.get_typestore(typesys.Stores.LATEST if ros2 else typesys.Stores.ROS1_NOETIC)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.stem}-", dir=target.parent) as folder:
        place = Path(folder) / f"bag{'' if ros2 else '.bag'}"
        rosbag = library(f"rosbags.rosbag{2 if ros2 else 1}", what)
        options: dict[str, Any] = {}
        if ros2:
            plugin = "MCAP" if target.suffix.lower() == ".mcap" else "SQLITE3"
            options = {"version": 9, "storage_plugin": rosbag.StoragePlugin[plugin]}
        with rosbag.Writer(place, **options) as writer:
            queue: list[tuple[int, Any, bytes]] = []
            for kind, stamps, numbers in series:
                name = WITH_ORIENTATION if kind == IMU and np.any(numbers[:, 4] != -1.0) else TOPICS[kind]
                connection = writer.add_connection(name, kind, typestore=store)
                rows = _encoded(stamps, numbers, ros2)
                queue += [(stamp, connection, row.tobytes()) for stamp, row in zip(stamps.tolist(), rows, strict=True)]
            queue += _copied(writer, others, store)
            queue.sort(key=lambda message: message[0])
            for stamp, connection, data in queue:
                writer.write(connection, stamp, data)
        written = place if not ros2 else next(item for item in place.iterdir() if item.suffix == target.suffix.lower())
        if target.is_dir():
            raise InputError(f"{target} is a folder; choose another name")
        shutil.move(written, target)


def _copied(writer: Any, topics: Sequence[Topic], known: Any) -> list[tuple[int, Any, bytes]]:
    """Return the messages of topics that are copied unchanged, with the types of their bag, or else the library's own."""
    typesys = library("rosbags.typesys", "copying topics")
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    types: dict[str, Any] = {}
    for topic in topics:
        types |= typesys.get_types_from_msg(topic.definition, topic.kind) if topic.definition else {}
    store.register(types or known.fielddefs)
    queue: list[tuple[int, Any, bytes]] = []
    for topic in topics:
        connection = writer.add_connection(topic.name, topic.kind, typestore=store)
        queue += [(logged, connection, raw) for logged, raw in zip(topic.logged, topic.raw, strict=True)]
    return queue
