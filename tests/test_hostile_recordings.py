"""Recordings of other programs that are damaged or made to harm: refused by name, in time and within memory, or read up to the fault."""

import bz2
import contextlib
import dataclasses
import os
import resource
import signal
import sqlite3
import struct
import threading
import time

import h5py
import numpy as np
import pytest
from measured import walk
from ulog_writer import write_ulog

from strapdown import recordings
from strapdown.checks import InputError
from strapdown.files import reading
from strapdown.recordings import attitudes, bag_files, ros, trajectories, ulog

SECONDS = 8.0
MEGABYTES = 1000.0


@contextlib.contextmanager
def bounded():
    """Fail if the work takes more time of the processor, or memory, than any file may."""
    begun, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert time.process_time() - begun < SECONDS
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1000.0 * MEGABYTES


def refused(path, words, read=recordings.read):
    with bounded(), pytest.raises(InputError, match=words) as caught:
        read(path)
    assert path.name in str(caught.value)


# ---------------------------------------------------------------------------------------------------------------------- ULog

ULOG = b"ULog\x01\x12\x35\x01" + bytes(8)


def block(kind: bytes, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), kind[0]) + content


def test_a_log_on_which_the_library_goes_back_for_ever_is_refused_with_the_place(tmp_path, monkeypatch):
    monkeypatch.setattr(ulog, "SECONDS", 2.0 * SECONDS)  # not because of the time
    path = tmp_path / "endless.ulg"
    path.write_bytes(ULOG + bytes(20_000) + struct.pack("<HB", 15_000, 214) + bytes(100))
    refused(path, r"endless\.ulg cannot be read as ULog \(the library does not come to an end at byte 20119\)")
    refused(path, "does not come to an end", attitudes.read_attitudes)


@pytest.mark.parametrize(
    "formats",
    [
        [b"a:float[60000] x;", b"b:a[60000] y;", b"sensor_combined:b[60000] z;"],
        [b"sensor_combined:sensor_combined[2] again;"],
        [b"a:b x;", b"b:a x;", b"sensor_combined:a x;"],
    ],
)
def test_a_log_of_messages_with_too_many_fields_is_refused(tmp_path, formats):
    path = tmp_path / "fields.ulg"
    subscription = block(b"A", b"\0\0\0sensor_combined")
    path.write_bytes(ULOG + b"".join(block(b"F", declaration) for declaration in formats) + subscription)
    refused(path, r"fields\.ulg cannot be read: its message \w+ has more than 65535 fields")


def test_many_subscriptions_of_large_messages_come_to_an_end(tmp_path, monkeypatch):
    monkeypatch.setattr(ulog, "SECONDS", 0.1)
    path = tmp_path / "subscriptions.ulg"
    path.write_bytes(
        ULOG + block(b"F", b"sensor_combined:float[60000] x;") + 2000 * block(b"A", b"\0\0\0sensor_combined")
    )
    refused(path, r"does not come to an end at byte \d+")


def test_a_log_with_a_changed_name_of_a_field_is_refused_by_the_field(tmp_path):
    pytest.importorskip("pyulog")
    path = tmp_path / "flight.ulg"
    write_ulog(dataclasses.replace(walk(), magnetic_unit="G"), path)
    for old, new, words in (
        (b"gyro_rad", b"gyrn_rad", r"flight\.ulg: a message has no field gyro_rad\[0\] \(it has: .*gyrn_rad\[0\]"),
        (b"timestamp;", b"timestamq;", r"flight\.ulg cannot be read as ULog"),
    ):
        damaged = tmp_path / "damaged" / path.name
        damaged.parent.mkdir(exist_ok=True)
        damaged.write_bytes(path.read_bytes().replace(old, new))
        refused(damaged, words)


# ---------------------------------------------------------------------------------------------------------------------- bags


def ros1_record(op: int, fields: dict[bytes, bytes], content: bytes) -> bytes:
    header = b"".join(
        struct.pack("<I", len(key) + 1 + len(value)) + key + b"=" + value
        for key, value in {b"op": bytes([op]), **fields}.items()
    )
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(content)) + content


def ros1_chunk(compression: bytes, packed: bytes, size: int) -> bytes:
    fields = {b"compression": compression, b"size": struct.pack("<I", size)}
    return bag_files.ROS1 + ros1_record(5, fields, packed)


def test_what_a_chunk_unpacks_to_is_limited_before_memory_is_spent(tmp_path, monkeypatch):
    path = tmp_path / "bomb.bag"
    packed = bz2.compress(bytes(80_000_000))
    assert len(packed) < 1000
    path.write_bytes(ros1_chunk(b"bz2", packed, 80_000_000))
    refused(path, r"bomb\.bag unpacks to more than its limit, 64 MB left and 80 MB to come.*STRAPDOWN_MAX_MB")
    path.write_bytes(ros1_chunk(b"bz2", packed, 1000))  # it declares less than it has
    refused(path, "its compressed data are truncated, or have more than 1000 bytes")
    monkeypatch.setenv("STRAPDOWN_MAX_MB", "100")
    path.write_bytes(ros1_chunk(b"bz2", packed, 80_000_000))
    with pytest.raises(InputError, match="no complete message"):
        recordings.read(path)


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_chunks_of_mcap_are_limited_alike(tmp_path, compression):
    zstd, lz4 = pytest.importorskip("backports.zstd"), pytest.importorskip("lz4.frame")
    packed = {"zstd": zstd, "lz4": lz4}[compression].compress(bytes(80_000_000))
    path = tmp_path / "bomb.mcap"
    for size, words in ((80_000_000, "unpacks to more than its limit"), (1000, "have more than 1000 bytes")):
        name = struct.pack("<I", len(compression)) + compression.encode()
        chunk = struct.pack("<QQQI", 0, 0, size, 0) + name + struct.pack("<Q", len(packed)) + packed
        path.write_bytes(bag_files.MCAP + struct.pack("<BQ", 6, len(chunk)) + chunk)
        refused(path, words)
    whole = tmp_path / "whole.mcap.zstd"
    whole.write_bytes(zstd.compress(bag_files.MCAP + bytes(80_000_000)))
    refused(whole, r"have more than 64000000 bytes", lambda path: ros.topics_of(path, ros.READ))


def database(path, *statements: str) -> None:
    path.unlink(missing_ok=True)
    with contextlib.closing(sqlite3.connect(path)) as held:
        for statement in statements:
            held.execute(statement)
        held.commit()


TOPICS = "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type)"
MESSAGES = "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)"
ENDLESS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
)
MESSAGE = "INSERT INTO messages VALUES (1, 1, 1, x'00')"
GENERATED = MESSAGES.replace("data)", "data AS (zeroblob(900000000)))")
SHORT = GENERATED.replace("900000000", "4000")
ROWS = (
    "INSERT INTO messages (id, topic_id, timestamp) "
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 3000) SELECT i, 9, i FROM n"
)
UNIT = "INSERT INTO topics VALUES (1, '/imu', 'sensor_msgs/msg/Imu')"


@pytest.mark.parametrize(
    ("statements", "words"),
    [
        ([TOPICS, UNIT, f"CREATE VIEW messages AS {ENDLESS}"], "it has no table messages"),
        ([MESSAGES, f"CREATE VIEW topics AS {ENDLESS}"], "it has no table topics"),
        ([TOPICS, UNIT, GENERATED, "INSERT INTO messages VALUES (1, 1, 1)"], "too big|not authorized"),
        ([TOPICS, UNIT, SHORT, ROWS], "its rows are longer than the file, so a column is generated|not authorized"),
        ([TOPICS, UNIT, MESSAGES, "INSERT INTO messages VALUES (1, 1, NULL, 'text')"], "1 messages are of no topic"),
        ([TOPICS, UNIT.replace("'/imu'", "NULL"), MESSAGES, MESSAGE], "1 messages are of no topic"),
        ([TOPICS, UNIT.replace("'/imu'", "CAST(x'ff' AS TEXT)"), MESSAGES, MESSAGE], "topic �: message 1 is 1 bytes"),
        (["CREATE TABLE other (a)"], "it has no table topics"),
    ],
)
def test_databases_of_hostile_content_are_refused(tmp_path, statements, words):
    path = tmp_path / "hostile.db3"
    database(path, *statements)
    refused(path, words)


def test_rows_of_wrong_types_are_left_out_and_reported(tmp_path):
    pytest.importorskip("rosbags")
    path = tmp_path / "rows.db3"
    whole = dataclasses.replace(walk(), magnetic_unit="T", movement=None)
    recordings.write(whole, path)
    for change in ("data = 'text'", "timestamp = 'soon'", "topic_id = 99"):
        damaged = tmp_path / "damaged.db3"
        damaged.write_bytes(path.read_bytes())
        with contextlib.closing(sqlite3.connect(damaged)) as held:
            held.execute(f"UPDATE messages SET {change} WHERE id = (SELECT min(id) FROM messages WHERE topic_id = 1)")
            held.commit()
        recording = recordings.read(damaged)
        np.testing.assert_array_equal(recording.rate, whole.rate[1:])
        assert "1 messages are of no topic" in " ".join(recording.remarks)


def test_a_folder_whose_storage_is_a_pipe_is_refused_at_once(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  relative_file_paths:\n    - bag_0.mcap\n")
    os.mkfifo(folder / "bag_0.mcap")
    refused(folder, r"bag_0\.mcap is not a regular file but a pipe")
    (folder / "bag_0.mcap").unlink()
    refused(folder, r"bag_0\.mcap of its metadata\.yaml is missing.*no complete message")


def test_reading_a_bag_takes_time_in_proportion_to_its_topics(tmp_path):
    """Each with one message: the messages were sorted out topic by topic."""
    path = tmp_path / "topics.bag"

    def bag(number: int) -> float:
        records = [bag_files.ROS1]
        definition = b"".join(
            struct.pack("<I", len(field)) + field for field in (b"type=sensor_msgs/Imu", b"message_definition=")
        )
        for k in range(number):
            conn = struct.pack("<I", k)
            records.append(ros1_record(7, {b"conn": conn, b"topic": b"/%d" % k}, definition))
            records.append(ros1_record(2, {b"conn": conn, b"time": bytes(8)}, b""))
        path.write_bytes(b"".join(records))
        begun = time.process_time()
        with pytest.raises(InputError, match=r"topics\.bag has several inertial units"):
            recordings.read(path)
        return time.process_time() - begun

    bag(10)
    assert bag(10_000) < 30.0 * max(bag(1_000), 0.01)


def test_a_written_mcap_has_checksums_and_damage_is_left_out(tmp_path):
    pytest.importorskip("rosbags")
    whole = dataclasses.replace(walk(), magnetic_unit="T", movement=None)
    path = tmp_path / "walk.mcap"
    recordings.write(whole, path)
    content = path.read_bytes()
    at = content.index(whole.rate[30].tobytes()) + 3
    path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    refused(path, "a chunk does not match its checksum and is left out.*no complete message")


# -------------------------------------------------------------------------------------------------------------------- Parquet


def test_parquet_of_repeated_values_is_limited_by_its_rows(tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "bomb.parquet"
    rows = arrow.array(np.zeros(1_000_000))
    fields = [arrow.field(name, rows.type) for name in ("time", "gx", "gy", "gz")]
    table = arrow.Table.from_arrays([rows] * 4, schema=arrow.schema(fields))
    with parquet.ParquetWriter(path, table.schema) as writer:
        for _ in range(25):
            writer.write_table(table)
    assert path.stat().st_size < 600_000
    refused(path, r"bomb\.parquet unpacks to more than its limit, .* 800 MB to come")


def test_parquet_columns_that_are_no_numbers_cost_nothing(tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "text.parquet"
    n = 1000
    text = arrow.DictionaryArray.from_arrays(arrow.array(np.zeros(n, np.int32)), arrow.array(["x" * 1_000_000]))
    numbers = {name: arrow.array(np.arange(float(n))) for name in ("time", "gx [rad/s]", "gy [rad/s]", "gz [rad/s]")}
    parquet.write_table(arrow.table({**numbers, "text": text}), path)
    with bounded():
        assert len(recordings.read(path).time) == n
    assert arrow.total_allocated_bytes() < 100_000_000


def test_a_flipped_bit_of_our_parquet_is_refused_and_a_unit_that_is_no_text_too(tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "walk.parquet"
    whole = walk()
    recordings.write(whole, path)
    content = path.read_bytes()
    data = (
        content.index(whole.rate[40:42, 0].tobytes())
        if whole.rate[40:42, 0].tobytes() in content
        else len(content) // 3
    )
    path.write_bytes(content[:data] + bytes([content[data] ^ 2]) + content[data + 1 :])
    refused(path, r"walk\.parquet cannot be read as Parquet \(.*(CRC|could not verify|checksum)")
    table = arrow.table({name: arrow.array(np.arange(3.0)) for name in ("time", "gx", "gy", "gz")})
    fields = [arrow.field(name, arrow.float64(), metadata={b"unit": b"\xff\xfe"}) for name in table.column_names]
    parquet.write_table(table.cast(arrow.schema(fields)), path)
    refused(path, r"walk\.parquet cannot be read as Parquet .*utf-8")


# ---------------------------------------------------------------------------------------------------------------------- text


@pytest.mark.parametrize(
    "stamp", ["nan", "inf", "-inf", "1e30", "9999999999999999999", "99999999999999999999", "1e999"]
)
def test_times_that_no_clock_counts_are_refused(tmp_path, stamp):
    tum = tmp_path / "walk.tum"
    tum.write_text(f"1 0 0 0 0 0 0 1\n{stamp} 0 0 0 0 0 0 1\n")
    refused(tum, f"data row 2: the time is {stamp}, which no clock counts", attitudes.read_attitudes)
    root = tmp_path / "mav0"
    for name in ("imu0", "state_groundtruth_estimate0"):
        (root / name).mkdir(parents=True)
    (root / "imu0" / "data.csv").write_text(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]\n1,0,0,0.1\n5000001,0,0,0.1\n"
    )
    truth = root / "state_groundtruth_estimate0" / "data.csv"
    truth.write_text(f"#t\n1,0,0,0,1,0,0,0\n{stamp},0,0,0,1,0,0,0\n")
    with pytest.raises(InputError, match=rf"data\.csv: data row 2: the time is {stamp.split('.')[0]}"):
        recordings.read(tmp_path)
    table = tmp_path / "attitude.csv"
    table.write_text(f"time_s,qw,qx,qy,qz\n1,1,0,0,0\n{stamp},1,0,0,0\n")
    refused(table, r"time.*(is (nan|inf|-inf)|no clock counts)", attitudes.read_attitudes)


def test_a_repeated_time_of_a_trajectory_is_refused(tmp_path):
    tum = tmp_path / "walk.tum"
    tum.write_text("1 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n")
    refused(tum, "data row 2 is not after the one before", trajectories.read_tum)


# ------------------------------------------------------------------------------------------------------------------ interruption


def test_an_interruption_that_a_library_turned_into_another_exception_remains_one(tmp_path):
    def library():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise RuntimeError("FastRLock returned a result with an exception set") from error

    with pytest.raises(KeyboardInterrupt), reading.from_file(tmp_path / "x.h5"):
        library()
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:  # handled before the file is read: no business of the file's
        with pytest.raises(InputError, match=r"x\.h5 cannot be read \(damage\)"), reading.from_file(tmp_path / "x.h5"):
            raise ValueError("damage") from None


@pytest.fixture
def interruptible():
    """A background job may be started with the signal ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_within_hdf5_an_interruption_waits_for_the_end(tmp_path):
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file["time"] = np.arange(3.0)
    read = []

    def interrupted():
        with reading.hdf5(path) as file:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
            read.append(reading.numbers(file, "time"))

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(read) == 1
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    other = threading.Thread(target=lambda: read.append(reading.kind(path)))
    other.start()
    other.join()
    assert read[1:] == [""]
