"""Files of ROS bags: ROS 1 (``.bag``), MCAP and SQLite (``.db3``), or the folder of a ROS 2 bag, as raw messages by topic.

Each file is scanned once, record by record, without its index. So a truncated or damaged file gives the messages up to the fault, and time
and memory grow with its size only: what chunks unpack to is limited before they are unpacked. The checksums of MCAP are verified; the other
two formats have none. Libraries: ``lz4`` and ``backports.zstd``, which ``rosbags`` brings, for files compressed by them.
"""

from __future__ import annotations

import bz2
import contextlib
import re
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from strapdown.checks import InputError
from strapdown.files import reading
from strapdown.files.extras import library

ROS1, MCAP, SQLITE, ZSTD = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
MAGICS = (ROS1, MCAP, SQLITE)
"""First bytes of the kinds of files."""
_ENDINGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")

_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
_PAIR16, _PAIR = struct.Struct("<HH"), struct.Struct("<II")
_RECORD, _MESSAGE, _CHUNK = struct.Struct("<BQ"), struct.Struct("<HIQQ"), struct.Struct("<QQQI")


Data = memoryview | bytes
Add = Callable[[int, Data], None]
"""Takes a message: time of the recorder, ns, and content."""


def is_folder(path: Path) -> bool:
    """Return whether a folder is a ROS 2 bag: metadata.yaml, or only storage files, if the recorder was killed."""
    return path.is_dir() and ((path / "metadata.yaml").is_file() or bool(storages(path)))


def storages(path: Path) -> list[Path]:
    """Return the storage files of a folder in order: with metadata all, else those named as the folder, or with a number appended."""
    name = ".*?" if (path / "metadata.yaml").is_file() else re.escape(path.absolute().name)
    endings = "|".join(map(re.escape, _ENDINGS))
    numbers = {}
    for file in path.iterdir():
        match = re.fullmatch(rf"{name}(?:_(\d{{1,9}}))?({endings})", file.name)
        if match:
            numbers[file] = int(match[1] or 0)
    return sorted(numbers, key=lambda file: numbers[file])


class Bag:
    """A bag.

    Attributes
    ----------
    ros2 : bool
        Whether the messages are those of ROS 2.
    faults : list of str
        Faults of the files, each with its place; complete after reading.
    definitions : dict of str to str
        Definition of each type of message that the bag contains; complete after reading.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = storages(path) if path.is_dir() else [path]
        self.ros2 = True
        self.faults: list[str] = []
        self.definitions: dict[str, str] = {}
        metadata = path / "metadata.yaml"
        self.with_metadata = metadata.is_file()
        if self.with_metadata:
            named = re.findall(r"^\s*-\s+['\"]?(\S+?)['\"]?\s*$", reading.text(metadata), re.MULTILINE)
            names = {name.rpartition("/")[2] for name in named if name.endswith(_ENDINGS)}
            missing = sorted(names - {file.name for file in self.files})
            self.faults += [f"{', '.join(missing)} of its metadata.yaml is missing"] if missing else []

    def read(self, receiver: Callable[[str, str], Add | None]) -> None:
        """Read the complete messages in the order of the files.

        ``receiver`` returns what takes the messages of a topic, from its name and type; None if they are not wanted. Types have their names
        in ROS 2, ``sensor_msgs/msg/Imu``.
        """
        for file in self.files:
            with reading.mapped(file) as data:
                _Scan(self, file, reading.Unpacked(file, len(data)), receiver).file(data)


@dataclass
class _Scan:
    """The scan of one file."""

    bag: Bag
    path: Path
    unpacked: reading.Unpacked
    receiver: Callable[[str, str], Add | None]
    topics: dict[Any, Add] = field(default_factory=dict)
    """By number of the connection, channel or topic."""
    schemas: dict[int, str] = field(default_factory=dict)
    number: int = 0
    """Number of messages."""
    lost: int = 0
    """Number of those of no topic."""
    checked: bool = False
    """Whether the chunks of an MCAP file have checksums."""

    @contextlib.contextmanager
    def guarded(self, place: int) -> Iterator[None]:
        """Add any exception of the formats or their libraries to the faults."""
        try:
            yield
        except (InputError, MemoryError):
            raise
        except Exception as error:
            self.fault(place, " ".join(str(error).split()) or type(error).__name__)

    def fault(self, place: int, words: str) -> None:
        if len(self.bag.faults) < 3:
            where = f"{self.path.name}, " if self.path != self.bag.path else ""
            self.bag.faults.append(f"{where}byte {place}: {words}")

    def topic(self, number: Any, name: str, kind: str) -> None:
        self.topics[number] = self.receiver(name, kind) or (lambda logged, data: None)

    def lose(self, logged: int, data: Data) -> None:
        self.lost += 1

    def summary(self, place: int, number: int) -> None:
        """Compare the number of messages that the file declares (0: none) with those that are there."""
        if number not in (0, self.number):
            self.fault(place, f"its index has {number} messages, and {self.number} are there")
        if self.lost:
            self.fault(place, f"{self.lost} messages are of no topic")

    def file(self, data: memoryview) -> None:
        path: Path | None = self.path
        with self.guarded(0):
            if data[:4] == ZSTD:
                data, path = self.unpack("zstd", data), None
            if data[: len(ROS1)] == ROS1:
                self.bag.ros2 = False
                self.ros1(data)
            elif data[: len(MCAP)] == MCAP:
                self.mcap(data)
            elif data[: len(SQLITE)] == SQLITE:
                self.sqlite(data, path)
            else:
                raise ValueError("its content is no bag")

    def unpack(self, compression: str, data: Data, size: int | None = None) -> memoryview:
        """Return unpacked bytes, of a declared size if it is known; the limit applies before memory is spent."""
        if compression in ("", "none"):
            return memoryview(data)
        if size is None:
            size = self.unpacked.left
        else:
            self.unpacked.take(size)
        if compression == "bz2":
            decompressor: Any = bz2.BZ2Decompressor()
        elif compression == "lz4":
            decompressor = library("lz4.frame", "a bag compressed by lz4").LZ4FrameDecompressor()
        elif compression == "zstd":
            decompressor = library("backports.zstd", "a bag compressed by zstd").ZstdDecompressor()
        else:
            raise ValueError(f"its compression {compression!r} is not known")
        content = decompressor.decompress(data, max_length=size + 1)
        if len(content) > size or not decompressor.eof:
            raise ValueError(f"its compressed data are truncated, or have more than {size} bytes")
        return memoryview(content)

    # ---------------------------------------------------------------------------------------------------------- ROS 1

    def ros1(self, data: memoryview) -> None:
        indexed = place = 0
        for place, fields, content in _ros1_records(data, len(ROS1)):
            kind = fields[b"op"]
            if kind == b"\x05":
                with self.guarded(place):
                    (size,) = _U32.unpack(fields[b"size"])
                    for _, inner, part in _ros1_records(self.unpack(fields[b"compression"].decode(), content, size), 0):
                        self.ros1_record(inner, part)
            elif kind == b"\x06":
                indexed += sum(count for _, count in _PAIR.iter_unpack(content))
            elif kind == b"\x03" and not any(fields[b"index_pos"]):
                self.fault(place, "it has no index, as if the recorder was killed")
            else:
                self.ros1_record(fields, content)
        self.summary(place, indexed)

    def ros1_record(self, fields: Mapping[bytes, bytes], content: memoryview) -> None:
        kind = fields[b"op"]
        if kind == b"\x02":
            self.number += 1
            seconds, nanoseconds = _PAIR.unpack(fields[b"time"])
            add = self.topics.get(_U32.unpack(fields[b"conn"])[0], self.lose)
            add(seconds * 10**9 + nanoseconds, content)
        elif kind == b"\x07":
            own = _ros1_fields(bytes(content))
            package, _, kind_name = own[b"type"].decode().partition("/")
            name = f"{package}/msg/{kind_name.removeprefix('msg/')}"  # as in ROS 2
            self.topic(_U32.unpack(fields[b"conn"])[0], re.sub("/+", "/", fields[b"topic"].decode()), name)
            self.bag.definitions[name] = own[b"message_definition"].decode(errors="replace")

    # ----------------------------------------------------------------------------------------------------------- MCAP

    def mcap(self, data: memoryview) -> None:
        finished, declared = False, 0
        for place, kind, content in _mcap_records(data, len(MCAP)):
            if kind == 0x06:
                with self.guarded(place):
                    self.mcap_chunk(content)
            elif kind == 0x0F:
                (checksum,) = _U32.unpack_from(content)
                if checksum and checksum != zlib.crc32(data[:place]):
                    self.fault(place, "the content does not match its checksum")
                    if not self.checked:  # else each chunk was checked separately
                        raise InputError(
                            f"{self.path.name} cannot be read: its content does not match its checksum, so it is damaged; restore a copy"
                        )
            elif kind == 0x02:
                finished = True
            elif kind == 0x0B:
                (declared,) = _U64.unpack_from(content)
            else:
                self.mcap_record(kind, content)
        if not finished:
            self.fault(len(data), "it ends without a footer")
        self.summary(len(data), declared)

    def mcap_chunk(self, content: memoryview) -> None:
        """Read a chunk; one that does not match its checksum is left out."""
        _, _, size, checksum = _CHUNK.unpack_from(content)
        self.checked = bool(checksum)
        compression, at = _mcap_text(content, _CHUNK.size)
        (held,) = _U64.unpack_from(content, at)
        records = self.unpack(compression, content[at + 8 : at + 8 + held], size)
        if checksum and zlib.crc32(records) != checksum:
            raise ValueError("a chunk does not match its checksum and is left out")
        for _, kind, part in _mcap_records(records, 0):
            self.mcap_record(kind, part)

    def mcap_record(self, kind: int, content: memoryview) -> None:
        if kind == 0x05:
            self.number += 1
            number, _, logged, _ = _MESSAGE.unpack_from(content)
            self.topics.get(number, self.lose)(logged, self.whole(content[_MESSAGE.size :]))
        elif kind == 0x03:
            name, at = _mcap_text(content, 2)
            encoding, at = _mcap_text(content, at)
            self.schemas[_U16.unpack_from(content)[0]] = name
            if encoding == "ros2msg":
                self.bag.definitions[name] = _mcap_text(content, at)[0]
        elif kind == 0x04:
            number, schema = _PAIR16.unpack_from(content)
            self.topic(number, _mcap_text(content, 4)[0], self.schemas.get(schema, ""))

    # --------------------------------------------------------------------------------------------------------- SQLite

    def sqlite(self, data: memoryview, path: Path | None) -> None:
        """Read the rows of the tables; a truncated database is padded with zeros, because SQLite rejects it."""
        (page,), (pages,) = struct.unpack_from(">H", data, 16), struct.unpack_from(">I", data, 28)
        page = 65536 if page == 1 else page
        missing = pages * page - len(data)
        if path is not None and missing <= 0:
            database = sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)
        else:
            self.unpacked.take(max(missing, 0))
            if missing > 0:
                self.fault(len(data), f"{missing} bytes are missing at the end")
            whole = bytes(data[: len(data) // page * page])  # an incomplete page would be read as rows of zeros
            database = sqlite3.connect(":memory:")
            database.deserialize(whole[:18] + b"\1\1" + whole[20:] + bytes(max(0, pages * page - len(whole))))
        with contextlib.closing(database):
            self.rows(database, len(data))
        self.summary(len(data), 0)

    def rows(self, database: sqlite3.Connection, size: int) -> None:
        work = iter(range(100 + size // 1000))
        database.set_progress_handler(lambda: next(work, None) is None, 100_000)  # an endless query is interrupted
        database.text_factory = lambda text: text.decode(errors="replace")
        database.set_authorizer(_only_reads)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, size)  # of a value, which a generated column may make up
        select = lambda what: _stored(database.execute(f"SELECT {what}"), size)  # noqa: E731
        kinds = dict(select("name, sql FROM sqlite_master WHERE type = 'table'"))
        for name in ("topics", "messages"):
            if not str(kinds.get(name, "")).upper().startswith("CREATE TABLE"):
                raise ValueError(f"it has no table {name}, so it is no bag")
        if "message_definitions" in kinds:
            columns = "topic_type, encoding, encoded_message_definition"
            for name, encoding, text in select(f"{columns} FROM message_definitions"):
                if encoding == "ros2msg":
                    self.bag.definitions[str(name)] = str(text)
        for number, name, kind in select("id, name, type FROM topics"):
            if isinstance(name, str) and isinstance(kind, str):
                self.topic(number, name, kind)
        for number, logged, raw in select("topic_id, timestamp, data FROM messages ORDER BY id"):
            self.number += 1
            if type(logged) is int and type(raw) is bytes:
                self.topics.get(number, self.lose)(logged, self.whole(raw))
            else:
                self.lost += 1

    def whole(self, data: Data) -> Data:
        """Return the content of a ROS 2 message, which may be compressed separately: an uncompressed one begins with a zero."""
        if data[:4] != ZSTD:
            return data
        content = self.unpack("zstd", data)
        self.unpacked.take(len(content))
        return content


def _stored(rows: Iterable[tuple[Any, ...]], size: int) -> Iterator[tuple[Any, ...]]:
    """Yield rows of a database of this size, bytes; more than that is not stored, but made up by a generated column."""
    for row in rows:
        size -= sum(len(value) for value in row if isinstance(value, str | bytes))
        if size < 0:
            raise ValueError("its rows are longer than the file, so a column is generated")
        yield row


def _only_reads(action: int, *_: Any) -> int:
    """Authorise reading of tables, and no function, which a generated column might call."""
    return sqlite3.SQLITE_OK if action in (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ) else sqlite3.SQLITE_DENY


def _ros1_records(data: memoryview, place: int) -> Iterator[tuple[int, dict[bytes, bytes], memoryview]]:
    """Yield place, header and content of each record; an exception for an incomplete one."""
    while place < len(data):
        (size,) = _U32.unpack_from(data, place)
        middle = place + 4 + size
        (length,) = _U32.unpack_from(data, middle)
        end = middle + 4 + length
        fields = _ros1_fields(bytes(data[place + 4 : middle]))
        if end > len(data) and fields.get(b"op") != b"\x05":
            raise ValueError(f"a record of {end - place} bytes goes beyond the end")
        yield place, fields, data[middle + 4 : end]
        if end > len(data):
            raise ValueError(f"a chunk of {end - place} bytes goes beyond the end")
        place = end


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at < len(header):
        end = at + 4 + _U32.unpack_from(header, at)[0]
        key, sign, value = header[at + 4 : end].partition(b"=")
        if not sign or end > len(header):
            raise ValueError("the header of a record is damaged")
        fields[key] = value
        at = end
    return fields


def _mcap_records(data: memoryview, place: int) -> Iterator[tuple[int, int, memoryview]]:
    """Yield place, kind and content of each record; an exception for an incomplete one."""
    while place < len(data):
        if data[place:] == MCAP:
            return
        kind, size = _RECORD.unpack_from(data, place)
        end = place + _RECORD.size + size
        if end > len(data) and kind != 0x06:
            raise ValueError(f"a record of {size} bytes goes beyond the end")
        yield place, kind, data[place + _RECORD.size : end]
        if end > len(data):
            raise ValueError(f"a chunk of {size} bytes goes beyond the end")
        place = end


def _mcap_text(data: memoryview, place: int) -> tuple[str, int]:
    (size,) = _U32.unpack_from(data, place)
    return bytes(data[place + 4 : place + 4 + size]).decode(), place + 4 + size


# ------------------------------------------------------------------------------------------------------------ checksums


def write_checksums(path: Path) -> None:
    """Write the checksums of an MCAP file of uncompressed chunks, which the library leaves at zero: of chunks, data and summary."""
    with open(path, "r+b") as file:
        content = bytearray(file.read())
        view = memoryview(content)
        summary = len(content)
        for place, kind, record in _mcap_records(view, len(MCAP)):
            at = place + _RECORD.size
            if kind == 0x06:
                inner = _mcap_text(record, _CHUNK.size)[1] + 8
                _U32.pack_into(content, at + 24, zlib.crc32(record[inner:]))
            elif kind == 0x0F:
                _U32.pack_into(content, at, zlib.crc32(view[:place]))
                summary = at + len(record)
            elif kind == 0x02:
                _U32.pack_into(content, at + 16, zlib.crc32(view[summary : at + 16]))
        file.seek(0)
        file.write(content)
