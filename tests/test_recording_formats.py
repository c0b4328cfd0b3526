"""Formats beside bags and text: Parquet, data frames, flight logs, EuRoC folders, trajectories; conversion between all of them."""

import sys
import types
from dataclasses import replace

import numpy as np
import pytest
from measured import walk
from scipy.spatial.transform import Rotation, Slerp
from typer.testing import CliRunner
from ulog_writer import write_ulog

import strapdown as sd
from strapdown import quaternion, recordings
from strapdown.checks import InputError
from strapdown.cli import app
from strapdown.recordings import Recording, formats, read, trajectories
from strapdown.recordings.attitudes import read_attitudes
from strapdown.recordings.formats import OmissionWarning

START = 1_700_000_000_123_456_789
MISSING = "is not installed: pip install 'strapdown[formats]'"


def same(a: Recording, b: Recording, *names: str, rtol: float = 0.0) -> None:
    assert a.clock_ns.tolist() == b.clock_ns.tolist()
    for name in names:
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=rtol, atol=0.0, err_msg=name)


ALL = ("rate", "specific_force", "magnetic_field", "temperature", "true_attitude", "movement")

# --------------------------------------------------------------------------------------------- columns in memory, Parquet


def test_a_truncated_parquet_is_refused(tmp_path):
    pytest.importorskip("pyarrow", reason=f"pyarrow {MISSING}")
    path = tmp_path / "cut.parquet"
    recordings.write(walk(), path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match=r"cut.parquet cannot be read as Parquet .* truncated"):
        read(path)


def test_parquet_of_pandas_is_read(tmp_path):
    pandas = pytest.importorskip("pandas", reason=f"pandas {MISSING}")
    pytest.importorskip("pyarrow", reason=f"pyarrow {MISSING}")
    stamps = pandas.date_range("2024-03-01T12:00:00Z", periods=4, freq="10ms")
    frame = pandas.DataFrame({"timestamp": stamps, "gyro_x_dps": [1.0, 2, 3, 4], "gyro_y_dps": 0.0, "gyro_z_dps": 0.0})
    frame.to_parquet(tmp_path / "p.parquet")
    recording = read(tmp_path / "p.parquet")
    np.testing.assert_allclose(recording.rate[:, 0], np.radians([1, 2, 3, 4]), rtol=1e-15)
    np.testing.assert_allclose(recording.time, [0, 0.01, 0.02, 0.03], rtol=1e-15)
    assert recording.epoch_ns == 1_709_294_400 * 10**9


def test_a_data_frame_is_a_recording():
    pandas = pytest.importorskip("pandas", reason=f"pandas {MISSING}")
    index = pandas.date_range("2024-03-01T13:00:00+01:00", periods=3, freq="5ms")
    frame = pandas.DataFrame(
        {
            "gx [dps]": [1, 2, 3],
            "gy": [0.0, 0, 0],
            "gz": [0.0, 0, 0],
            "mx": pandas.array([1, None, 3], dtype="Int64"),
            "my": 1.0,
            "mz": 2.0,
        },
        index=index,
    )
    recording = recordings.from_table(frame, source="frame")
    np.testing.assert_allclose(recording.rate[:, 0], np.radians([1, 2, 3]), rtol=1e-15)
    assert recording.epoch_ns == 1_709_294_400 * 10**9
    assert recordings.from_table(frame.reset_index(names="time")).epoch_ns == 1_709_294_400 * 10**9
    assert recording.magnetic_field[:, 0].tolist()[::2] == [1.0, 3.0]
    assert np.isnan(recording.magnetic_field[1, 0])
    np.testing.assert_array_equal(sd.read(frame, units={"magnetometer": "uT"}).rate, recording.rate)
    with pytest.raises(InputError, match=r"frame: .*lacks gy"):
        recordings.from_table(frame.drop(columns="gy"), source="frame")
    frame["gx [dps]"] = ["fast", "slow", "still"]
    with pytest.raises(InputError, match=r"frame: column gx \[dps\] is not an array of numbers"):
        recordings.from_table(frame, source="frame")


def test_a_dataset_is_a_recording():
    xarray = pytest.importorskip("xarray", reason=f"xarray {MISSING}")
    values = np.arange(12.0).reshape(4, 3)
    dataset = xarray.Dataset(
        {
            "gyro": (("time", "axis"), values, {"units": "deg/s"}),
            "acc": (("time", "axis"), values, {"units": "g"}),
            "note": ((), 1.0),
        },
        coords={"time": ("time", [10, 20, 30, 40], {"units": "ms"}), "axis": ["x", "y", "z"]},
    )
    assert sd.read(dataset).time[-1] == 0.04
    recording = recordings.from_table(dataset)
    np.testing.assert_allclose(recording.time, [0.01, 0.02, 0.03, 0.04], rtol=1e-15)
    np.testing.assert_allclose(recording.rate, np.radians(values), rtol=1e-15)
    np.testing.assert_allclose(recording.specific_force, values * 9.80665, rtol=1e-15)


def test_arrays_by_name_are_a_recording():
    columns = {"time": np.arange(3.0), "gx": [1, 2, 3], "gy": np.zeros(3), "gz": np.zeros(3)}
    assert recordings.from_table(columns, units={"gyro": "rad/s"}).rate[2, 0] == 3.0
    assert sd.read(columns, units={"gyro": "rad/s"}).rate[2, 0] == 3.0
    values = np.arange(12.0).reshape(4, 3)
    recording = sd.read({"time": np.arange(4.0), "gyro [deg/s]": values, "acc": values}, units={"accelerometer": "g"})
    np.testing.assert_allclose(recording.rate, np.radians(values), rtol=1e-15)
    np.testing.assert_allclose(recording.specific_force, values * 9.80665, rtol=1e-15)
    with pytest.raises(InputError, match=r"path is 3, .*give a path, a data frame"):
        sd.read(3)
    with pytest.raises(InputError, match=r"table: column gz has shape \(2,\), the first \(3,\)"):
        recordings.from_table({**columns, "gz": np.zeros(2)}, units={"gyro": "rad/s"})


# --------------------------------------------------------------------------------------------- flight logs


@pytest.fixture
def ulog(tmp_path):
    """Write a flight log by the library's own writer and return its path, and the recording in it."""
    pyulog = pytest.importorskip("pyulog", reason=f"pyulog {MISSING}")
    whole = walk(single=True)
    write_ulog(whole, tmp_path / "ours.ulg")
    pyulog.ULog(str(tmp_path / "ours.ulg")).write_ulog(str(tmp_path / "theirs.ulg"))
    return tmp_path / "theirs.ulg", whole


def test_a_flight_log_is_read(ulog):
    path, whole = ulog
    back = read(path)
    same(back, whole, "rate", "specific_force", "magnetic_field")
    assert back.magnetic_unit == "G"
    known = ~np.isnan(back.true_attitude[:, 0])
    assert known.all()
    assert quaternion.angle_between(quaternion.normalize(back.true_attitude), whole.true_attitude).max() < 1e-6
    assert back.remarks[0] == "Topic sensor_combined: 60 messages."
    assert "vehicle_attitude, the vehicle's estimate" in " ".join(back.remarks)


def test_a_flight_log_uses_the_time_of_the_samples(ulog, monkeypatch):
    """A magnetometer logged 20 ms late with its sample's time, and an accelerometer 30 ms before the gyro, which is said."""
    import pyulog

    path, whole = ulog
    log = pyulog.ULog(str(path))
    data = {topic.name: topic.data for topic in log.data_list}
    data["vehicle_magnetometer"]["timestamp"] += 20_000
    data["sensor_combined"]["accelerometer_timestamp_relative"][:] = -30_000
    monkeypatch.setattr(pyulog, "ULog", lambda *arguments, **options: log)
    recording = read(path)
    same(recording, whole, "magnetic_field")
    assert "offset by -30 ms from the gyro's stamps" in " ".join(recording.remarks)
    # Logs of earlier firmware have the field beside the rates, where a stamp of 2³¹ − 1 says that there is no new sample.
    data["sensor_combined"] |= {f"magnetometer_ga[{k}]": whole.magnetic_field[:, k].copy() for k in range(3)}
    data["sensor_combined"]["magnetometer_timestamp_relative"] = np.where(np.arange(60) < 30, 2**31 - 1, 0)
    next(topic for topic in log.data_list if topic.name == "vehicle_magnetometer").name = "vehicle_magnetometer_bias"
    expected = np.where(np.arange(60)[:, None] < 30, np.nan, whole.magnetic_field)
    np.testing.assert_array_equal(read(path).magnetic_field, expected)


def test_the_library_reads_the_attitude_as_px4_has_it(ulog):
    """From forward-right-down body axes to North-East-Down: a body whose axes are those has the identity."""
    import pyulog

    path, whole = ulog
    data = {topic.name: topic.data for topic in pyulog.ULog(str(path)).data_list}
    q = np.stack([data["vehicle_attitude"][f"q[{k}]"] for k in range(4)], axis=1)[:, [1, 2, 3, 0]]
    to_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    expected = to_enu @ Rotation.from_quat(q).as_matrix()
    np.testing.assert_allclose(expected, quaternion.to_matrix(whole.true_attitude), atol=1e-6)
    np.testing.assert_array_equal(data["sensor_combined"]["timestamp"], whole.clock_ns // 1000)


def test_a_truncated_flight_log_gives_what_is_whole(ulog):
    path, whole = ulog
    content = path.read_bytes()
    path.write_bytes(content[: int(0.7 * len(content))])
    recording = read(path)
    n = len(recording.time)
    assert 30 < n < 50
    np.testing.assert_array_equal(recording.rate, whole.rate[:n])
    path.write_bytes(content[:200])
    with pytest.raises(InputError, match=r"theirs.ulg (has no message of sensor_combined|cannot be read)"):
        read(path)


@pytest.mark.parametrize(
    ("module", "ending"), [("pyulog", "ulg"), ("pyarrow.parquet", "parquet"), ("rosbags.typesys", "mcap")]
)
def test_a_missing_library_is_named_with_its_remedy(tmp_path, monkeypatch, module, ending):
    pytest.importorskip(module, reason=f"{module} {MISSING}")
    path, write = tmp_path / f"x.{ending}", write_ulog if ending == "ulg" else recordings.write
    write(walk(single=True), path)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"needs {module.partition('.')[0]} .*pip install 'strapdown\[formats\]'"):
        write(walk(), path) if ending == "mcap" else read(path)  # bags are read without it


# --------------------------------------------------------------------------------------------- cameras and flight controllers

GCSV = """GYROFLOW IMU LOG
version,1.3
id,custom_logger_name
orientation,XYZ
timestamp,1644159993
vendor,potatocam
tscale,0.001
gscale,0.00122173047
ascale,0.00048828125
t,gx,gy,gz,ax,ay,az
0,39,86,183,-1137,-15689,-2986
1,56,100,202,-1179,-15694,-2887
2,63,108,218,-1247,-15702,-2794
"""
"""Gyroflow's documented format: counts, with their scales to s, rad/s and g."""


def test_a_cameras_log_is_read(tmp_path):
    pytest.importorskip("telemetry_parser", reason=f"telemetry-parser {MISSING}")
    path = tmp_path / "camera.gcsv"
    path.write_text(GCSV)
    recording = read(path)
    counts = np.array(
        [
            [39, 86, 183, -1137, -15689, -2986],
            [56, 100, 202, -1179, -15694, -2887],
            [63, 108, 218, -1247, -15702, -2794],
        ]
    )
    np.testing.assert_allclose(recording.rate, counts[:, :3] * 0.00122173047, rtol=1e-6)
    np.testing.assert_allclose(recording.specific_force, counts[:, 3:] * 0.00048828125 * 9.80665, rtol=1e-6)
    np.testing.assert_allclose(recording.time, [0.0, 1e-3, 2e-3], atol=1e-12)
    assert recording.magnetic_field is None
    assert "potatocam custom logger name" in recording.remarks[0]
    (tmp_path / "none.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(200))
    with pytest.raises(InputError, match=r"none.mp4 (cannot be read as camera or flight log|.*has no gyro samples)"):
        read(tmp_path / "none.mp4")


@pytest.mark.parametrize("rows", [[], [{"timestamp_ms": 0.0, "gyro": [1, 2, 3]}], [{"timestamp_ms": 0.0}] * 3])
def test_a_cameras_log_without_gyro_samples_is_refused(tmp_path, monkeypatch, rows):
    parser = types.SimpleNamespace(camera="GoPro", model="H9", normalized_imu=lambda: rows)
    monkeypatch.setitem(sys.modules, "telemetry_parser", types.SimpleNamespace(Parser=lambda path: parser))
    (tmp_path / "video.log").write_text(GCSV)
    with pytest.raises(InputError, match=r"video.log \(GoPro\) has no gyro samples; give a log with raw"):
        read(tmp_path / "video.log")


@pytest.mark.parametrize("kept", [1, 2, 3])
def test_a_table_is_text_wherever_its_beginning_is_cut(tmp_path, kept):
    """A header whose character of four bytes lies across the end of the bytes by which a format is recognised."""
    header = "time,gx [rad/s],gy,gz,"
    header += "x" * (formats.HEAD - kept - len(header)) + "𝛚"
    (tmp_path / "table.dat").write_text(header + "\n" + "".join(f"{k},1,2,3,0\n" for k in range(5)), encoding="utf-8")
    assert read(tmp_path / "table.dat").rate.shape == (5, 3)


# --------------------------------------------------------------------------------------------- EuRoC, trajectories


def euroc(folder, truth: str = "state_groundtruth_estimate0"):
    """Write a folder of EuRoC, ground truth at other stamps and with a gap, and return it with its truth."""
    n = 400
    stamps = 1403636579758555392 + 5_000_000 * np.arange(n)
    (folder / "mav0" / "imu0").mkdir(parents=True)
    values = np.random.default_rng(4).standard_normal((n, 6))
    rows = "\n".join(",".join([str(s), *map(repr, v)]) for s, v in zip(stamps.tolist(), values.tolist(), strict=True))
    header = (
        "#timestamp [ns],"
        + ",".join(f"w_RS_S_{a} [rad s^-1]" for a in "xyz")
        + ","
        + ",".join(f"a_RS_S_{a} [m s^-2]" for a in "xyz")
    )
    (folder / "mav0" / "imu0" / "data.csv").write_text(f"{header}\n{rows}\n")
    at = stamps[0] + 3_000_000 + 10_000_000 * np.arange(180)
    at = np.delete(at, slice(60, 80))
    turns = Rotation.from_rotvec(np.outer((at - at[0]) / 1e9, [0.3, -0.5, 0.8]))
    q = turns.as_quat()[:, [3, 0, 1, 2]] * np.where(np.arange(len(at)) % 3, 1.0, -1.0)[:, None]  # of either sign
    (folder / "mav0" / truth).mkdir()
    more = [] if truth == "mocap0" else ["0.5"] * 9  # velocity, biases
    lines = "\n".join(
        ",".join([str(s), "1.0", "2.0", "3.0", *map(repr, p), *more])
        for s, p in zip(at.tolist(), q.tolist(), strict=True)
    )
    (folder / "mav0" / truth / "data.csv").write_text(f"#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z\n{lines}\n")
    return folder, stamps, values, (at, turns)


@pytest.mark.parametrize("truth", ["state_groundtruth_estimate0", "mocap0"])
def test_a_folder_of_euroc_is_read_with_its_truth_between_its_stamps(tmp_path, truth):
    folder, stamps, values, (at, turns) = euroc(tmp_path / "MH_01", truth)
    recording = read(folder)
    assert recording.source == "MH_01"
    assert recording.clock_ns.tolist() == stamps.tolist()
    np.testing.assert_array_equal(recording.rate, values[:, :3])
    np.testing.assert_array_equal(recording.specific_force, values[:, 3:])
    known = ~np.isnan(recording.true_attitude[:, 0])
    gap = (stamps > at[59]) & (stamps < at[60])
    np.testing.assert_array_equal(known, (stamps >= at[0]) & (stamps <= at[-1]) & ~gap)
    expected = Slerp((at - at[0]) / 1e9, turns)((stamps[known] - at[0]) / 1e9)
    attitude = Rotation.from_quat(recording.true_attitude[known][:, [1, 2, 3, 0]])
    assert (expected * attitude.inv()).magnitude().max() < 1e-12
    assert f"Reference of {truth}/data.csv" in recording.remarks[1]
    np.testing.assert_array_equal(read(folder / "mav0").rate, recording.rate)
    reference = read_attitudes(folder)
    assert reference.stamps_ns.tolist() == stamps[known].tolist()
    np.testing.assert_array_equal(reference.attitude, recording.true_attitude[known])
    (folder / "mav0" / truth / "data.csv").write_text("#timestamp, p_x, p_y\n1,2.0,3.0\n2,2.0,3.0\n")
    with pytest.raises(InputError, match="has 3 columns; wanted time, position and quaternion"):
        read(folder)


def test_a_trajectory_is_a_reference(tmp_path):
    whole = replace(walk(), true_attitude=None)
    stamps = whole.clock_ns[0] - 10_000_000 + 7_000_000 * np.arange(60)
    q = Rotation.from_rotvec(np.outer(np.arange(60), [0.01, 0.0, 0.02])).as_quat()
    path = tmp_path / "truth.txt"
    lines = [
        f"{s // 10**9}.{s % 10**9:09d} 1 2 3 " + " ".join(map(repr, row))
        for s, row in zip(stamps.tolist(), q.tolist(), strict=True)
    ]
    path.write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")
    at, attitude = recordings.read_tum(path)
    assert at.tolist() == stamps.tolist()
    np.testing.assert_allclose(attitude, q[:, [3, 0, 1, 2]], atol=1e-15)
    joined = recordings.with_reference(whole, path)
    assert not np.isnan(joined.true_attitude).any()
    with pytest.raises(InputError, match="is a TUM trajectory, which has no inertial samples"):
        read(path)
    with pytest.raises(InputError, match=r"truth.txt goes from .* both must have the same clock"):
        recordings.with_reference(replace(whole, epoch_ns=0), path)
    path.write_text("-1.25 0 0 0 0 0 0 1\n-0.5 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    assert recordings.read_tum(path)[0].tolist() == [-1_250_000_000, -500_000_000, 2_000_000_000]
    path.write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"data row 1 has 3 numbers, not time tx"):
        recordings.read_tum(path)


def test_interpolation_ends_where_the_reference_does():
    stamps = np.array([0.0, 0.05, 0.5])
    q = quaternion.exp(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]))
    attitude = trajectories.interpolated(np.array([-0.01, 0.0, 0.025, 0.05, 0.2, 0.5, 0.6]), stamps, q)
    assert np.isnan(attitude[:, 0]).tolist() == [True, False, False, True, True, True, True]
    np.testing.assert_allclose(quaternion.log(attitude[2]), [0.05, 0, 0], atol=1e-15)


# --------------------------------------------------------------------------------------------- conversion


def convert(*arguments) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["convert", *map(str, arguments)])
    return done.exit_code, done.output + str(done.exception or "")


ROUND = ("csv", "tsv", "parquet", "bag", "mcap", "db3")


@pytest.mark.parametrize("ending", ROUND)
@pytest.mark.parametrize("epoch", [0, START])
def test_what_is_written_comes_back_to_the_bit(tmp_path, ending, epoch):
    needed = {"bag": "rosbags", "mcap": "rosbags", "db3": "rosbags", "parquet": "pyarrow"}.get(ending, "")
    whole = replace(walk(epoch=epoch), magnetic_unit="mG")
    if needed:
        pytest.importorskip(needed, reason=f"{needed} {MISSING}")
    if needed == "rosbags":  # a bag has a field in T, and no movement
        whole = replace(whole, magnetic_unit="T", movement=None)
    recordings.write(whole, tmp_path / f"x.{ending}")
    back = read(tmp_path / f"x.{ending}")
    same(back, whole, *(name for name in ALL if getattr(whole, name) is not None))
    assert (back.parts, back.magnetic_unit) == (whole.parts, whole.magnetic_unit)
    assert back.remarks == () or needed == "rosbags"
    assert [path.name for path in tmp_path.iterdir()] == [f"x.{ending}"]


def test_what_the_target_has_no_room_for_is_said(tmp_path):
    whole = replace(walk(), time=0.01 * np.arange(60))
    recordings.write(whole, tmp_path / "a.csv")
    with pytest.warns(OmissionWarning, match=r"b\.h5 \(BROAD\) cannot store temperature, clock: omitted; \.csv"):
        status, said = convert(tmp_path / "a.csv", tmp_path / "b.h5")
    assert status == 0, said
    back = read(tmp_path / "b.h5")
    np.testing.assert_array_equal(back.rate, whole.rate)
    np.testing.assert_array_equal(back.movement, whole.movement)
    np.testing.assert_allclose(back.time, whole.time, rtol=1e-12)


def test_what_is_there_is_not_replaced_by_default(tmp_path):
    recordings.write(walk(), tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("precious")
    for target, words in (
        ("b.csv", "exists; move it, choose another name, or give --force"),
        ("a.csv", "the same file that is read"),
    ):
        status, said = convert(tmp_path / "a.csv", tmp_path / target)
        assert (status, words in said) == (1, True), said
    assert (tmp_path / "b.csv").read_text() == "precious"
    assert convert(tmp_path / "a.csv", tmp_path / "b.csv", "--force")[0] == 0
    assert convert(tmp_path / "none.csv", tmp_path / "c.csv")[0] == 1
    assert convert(tmp_path / "a.csv", tmp_path / "c.docx")[0] == 1


def test_a_simulated_record_and_an_estimate_are_converted(tmp_path):
    from strapdown import scenarios
    from strapdown.recordings.recordfiles import write_record

    record = scenarios.simulate(replace(scenarios.load_scenario("rest"), duration=20.0), 3)
    write_record(tmp_path / "r.h5", record)
    status, said = convert(tmp_path / "r.h5", tmp_path / "r.csv")
    assert status == 0, said
    assert "mean over the sample interval before it" in said
    back = read(tmp_path / "r.csv")
    np.testing.assert_allclose(back.rate * np.diff(record.time)[:, None], record.increments, rtol=1e-14)
    np.testing.assert_array_equal(back.time, record.time[1:])
    np.testing.assert_array_equal(back.true_attitude, record.truth.attitude[1:])
    from strapdown.estimation.setup import write_estimate
    from strapdown.records import Estimate

    q = quaternion.normalize(np.random.default_rng(1).standard_normal((5, 4)))
    estimate = Estimate(time=np.arange(5.0), attitude=q, bias=np.zeros((5, 3)), variance=np.ones((5, 6)))
    write_estimate(tmp_path / "e.h5", estimate)
    status, said = convert(tmp_path / "e.h5", tmp_path / "e.tum")
    assert status == 0, said
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "e.tum")[:, 4:], q[:, [1, 2, 3, 0]])
    assert convert(tmp_path / "e.h5", tmp_path / "e.bag")[0] == 1
    write_record(tmp_path / "s.h5", scenarios.simulate(replace(scenarios.load_scenario("two-stars"), duration=5.0)))
    status, said = convert(tmp_path / "s.h5", tmp_path / "s.csv")
    assert (status, "Left out: star 1 (direction), star 2 (direction)." in said) == (0, True), said


def test_a_trajectory_goes_along_as_reference(tmp_path):
    whole = replace(walk(), true_attitude=None)
    recordings.write(whole, tmp_path / "a.csv")
    lines = [f"{s // 10**9}.{s % 10**9:09d} 0 0 0 0 0 0 1\n" for s in whole.clock_ns.tolist()]
    (tmp_path / "t.tum").write_text("".join(lines))
    status, said = convert(tmp_path / "a.csv", tmp_path / "b.csv", "--reference", tmp_path / "t.tum")
    assert status == 0, said
    np.testing.assert_allclose(np.abs(read(tmp_path / "b.csv").true_attitude[:, 0]), 1.0)
