"""Recordings of other programs that are damaged or made to harm: refused by name, in time and within memory."""

import contextlib
import dataclasses
import os
import resource
import signal
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
from strapdown.recordings import attitudes, trajectories

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
    refused(path, r"bomb\.parquet has 0.* MB and unpacks to 800 MB")


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
    times = [*range(40), *range(9)]
    tum.write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in times))
    restarted = "row 41 is not after the one before; the clock restarted in row 41: split the recording there"
    refused(tum, restarted, trajectories.read_tum)
    table = tmp_path / "walk.csv"
    table.write_text("time_s,qw,qx,qy,qz\n" + "".join(f"{k},1,0,0,0\n" for k in times))
    refused(table, restarted, attitudes.read_attitudes)


# ------------------------------------------------------------------------------------------------------------------ interruption


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
