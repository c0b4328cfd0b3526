"""ROS bags: written by the library's own serialiser and read here, written here and read by the library, of several units."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from measured import walk
from typer.testing import CliRunner

from strapdown import recordings
from strapdown.checks import InputError
from strapdown.cli import app
from strapdown.recordings import Recording, read
from strapdown.recordings.attitudes import read_attitudes
from strapdown.records import Estimate

rosbags = pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'strapdown[formats]'")

START = 1_700_000_000_123_456_789
KINDS = ("bag", "mcap", "db3", "folder")


def stores():
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.LATEST)


def message(store, kind: str, stamp: int, frame: str, numbers, ros1: bool):
    """Build a message of the library's own classes from the numbers behind the header."""
    t = store.types
    more = {"seq": 0} if ros1 else {}
    time = t["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    header = t["std_msgs/msg/Header"](stamp=time, frame_id=frame, **more)
    vector = lambda v: t["geometry_msgs/msg/Vector3"](x=v[0], y=v[1], z=v[2])  # noqa: E731
    zeros = np.zeros(9)
    if kind == "Imu":
        none = zeros.copy()
        none[0] = -1.0
        return t["sensor_msgs/msg/Imu"](
            header=header,
            orientation=t["geometry_msgs/msg/Quaternion"](x=0.1, y=0.2, z=0.3, w=0.9),
            orientation_covariance=none,
            angular_velocity=vector(numbers[:3]),
            angular_velocity_covariance=zeros,
            linear_acceleration=vector(numbers[3:6]),
            linear_acceleration_covariance=zeros if len(numbers) > 3 and numbers[3] != 0.0 else none,
        )
    if kind == "MagneticField":
        return t["sensor_msgs/msg/MagneticField"](
            header=header, magnetic_field=vector(numbers), magnetic_field_covariance=zeros
        )
    return t["std_msgs/msg/String"](data=str(numbers))


@pytest.fixture
def bag(tmp_path):
    """Write messages (topic, kind, stamp, frame, numbers) with the library's own writer and serialiser and return the bag's path."""

    def write(suffix: str, content, name: str = "walk") -> Path:
        from rosbags import rosbag1, rosbag2

        ros1 = suffix == "bag"
        store = stores()[0 if ros1 else 1]
        path = tmp_path / (f"{name}.bag" if ros1 else name)
        plugin = rosbag2.StoragePlugin.SQLITE3 if suffix == "db3" else rosbag2.StoragePlugin.MCAP
        with rosbag1.Writer(path) if ros1 else rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
            connections = {}
            for k, (topic, kind, stamp, frame, numbers) in enumerate(content):
                full = ("std_msgs/msg/" if kind == "String" else "sensor_msgs/msg/") + kind
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, full, typestore=store)
                instance = message(store, kind, stamp, frame, numbers, ros1)
                raw = store.serialize_ros1(instance, full) if ros1 else store.serialize_cdr(instance, full)
                writer.write(connections[topic], START + 1000 * k, raw)
        if suffix in ("bag", "folder"):
            return path
        return next(file for file in path.iterdir() if file.suffix == f".{suffix}")

    return write


def imu(n: int = 40, topic: str = "/imu/data", frame: str = "imu_link", start: int = START):
    values = np.random.default_rng(1).standard_normal((n, 6))
    return values, [(topic, "Imu", start + 5_000_001 * k, frame, values[k]) for k in range(n)]


@pytest.mark.parametrize("suffix", KINDS)
@pytest.mark.parametrize("frame", ["", "a", "imu", "imu_link", "a/long/frame/name"])
def test_an_inertial_unit_is_read(bag, suffix, frame):
    """Whatever the length of the frame's name, by which the numbers behind it move."""
    values, content = imu(frame=frame)
    recording = read(bag(suffix, content))
    np.testing.assert_array_equal(recording.rate, values[:, :3])
    np.testing.assert_array_equal(recording.specific_force, values[:, 3:])
    assert recording.clock_ns.tolist() == [entry[2] for entry in content]
    assert recording.epoch_ns == START
    assert recording.magnetic_field is None
    assert recording.remarks == ("Topic /imu/data: 40 messages.",)


def test_frames_of_several_names_are_read_in_their_order(bag):
    values, content = imu()
    content = [(t, k, s, "x" * (j % 5), v) for j, (t, k, s, _, v) in enumerate(content)]
    for suffix in KINDS:
        np.testing.assert_array_equal(read(bag(suffix, content, name=f"x{suffix}")).rate, values[:, :3])


@pytest.mark.parametrize("suffix", KINDS)
def test_a_magnetometer_goes_to_the_nearest_stamps(bag, suffix):
    _, content = imu()
    field = np.arange(30.0).reshape(10, 3) * 1e-6
    content += [("/magnet/mag", "MagneticField", START + 20_000_004 * k + 1_000_000, "m", field[k]) for k in range(10)]
    content.append(("/chatter", "String", START, "", "hello"))
    recording = read(bag(suffix, content))
    np.testing.assert_array_equal(recording.magnetic_field[::4], field)
    assert np.isnan(recording.magnetic_field[np.arange(40) % 4 != 0]).all()
    assert recording.magnetic_unit == "T"
    assert recording.remarks[1] == "Topic /magnet/mag: 10 messages."
    content.append(("/other/mag", "MagneticField", START, "m", field[0]))
    recording = read(bag(suffix, content, name="two"))
    assert recording.magnetic_field is None
    assert "None of /magnet/mag, /other/mag was read, because it is ambiguous which" in recording.remarks[1]


def test_of_several_units_one_must_be_chosen(bag):
    _, first = imu(topic="/left/imu")
    other, second = imu(20, topic="/right/imu")
    field = [("/right/mag", "MagneticField", START + 5_000_001 * k, "m", [1e-5 + k, 0, 0]) for k in range(20)]
    content = first + second + field + [("/left/mag", "MagneticField", START, "m", [1e-5, 0, 0])]
    path = bag("mcap", content)
    with pytest.raises(
        InputError,
        match=r"several inertial units: /left/imu \(40 messages\), /right/imu \(20 messages\).*`topic='/left/imu'`",
    ):
        read(path)
    with pytest.raises(InputError, match=r"topic '/right/im' is not known; did you mean '/right/imu'"):
        read(path, topic="/right/im")
    right = read(path, topic="/right/imu")
    np.testing.assert_array_equal(right.rate, other[:, :3])
    assert right.magnetic_field[3, 0] == 1e-5 + 3
    assert len(read(path, topic="/left/imu").time) == 40
    of_one = bag("mcap", first + second + field, name="of_one")
    assert read(of_one, topic="/left/imu").magnetic_field is None
    none = "None of /right/mag was read, because it is ambiguous which of them, if any, belongs to /left/imu."
    assert read(of_one, topic="/left/imu").remarks[1] == none
    of_part = bag("mcap", imu(topic="/right/arm/imu")[1] + second + [("/right/arm/mag", *field[0][1:])], name="of_part")
    assert read(of_part, topic="/right/imu").magnetic_field is None


def test_a_unit_without_an_accelerometer_has_none(bag):
    _, content = imu()
    content = [(t, k, s, f, np.r_[v[:3], 0, 0, 0]) for t, k, s, f, v in content]
    assert read(bag("mcap", content)).specific_force is None


def test_a_wrong_unit_of_a_bag_is_corrected_in_its_csv(bag, tmp_path):
    values, content = imu()
    path = bag("mcap", content)
    with pytest.raises(
        InputError, match=r"header of its CSV \(`strapdown convert`\), or leave `units={'gyro': 'deg/s'}` out"
    ):
        read(path, units={"gyro": "deg/s"})
    table = tmp_path / "walk.csv"
    recordings.write(read(path), table)
    table.write_text(table.read_text().replace("[rad/s]", "[deg/s]"))
    np.testing.assert_allclose(read(table).rate, np.radians(values[:, :3]), rtol=1e-15)


def test_headers_without_stamps_and_stamps_out_of_order_are_said(bag):
    values, content = imu()
    path = bag("mcap", [content[1], content[0], *content[2:]], name="order")
    recording = read(path)
    np.testing.assert_array_equal(recording.rate, values[:, :3])
    assert (
        "1 messages of /imu/data, the first of them number 2, were out of order and were sorted." in recording.remarks
    )


@pytest.mark.parametrize("format", ["bag", "mcap"])
def test_a_clock_that_was_set_back_is_refused_and_late_messages_are_not(bag, format):
    """Sorted, the messages before and after the step would alternate; late ones fill the hole that they left."""
    _, content = imu()
    late = read(bag(format, content[:10] + content[20:30] + content[10:20] + content[30:], name="late"))
    np.testing.assert_array_equal(late.rate, read(bag(format, content)).rate)
    step = 52_000_000
    set_back = content[:20] + [(topic, kind, stamp - step, *rest) for topic, kind, stamp, *rest in content[20:]]
    with pytest.raises(
        InputError,
        match=r"topic /imu/data: the clock goes back by 0.047 s at message 21, and 10 messages .* cut the bag",
    ):
        read(bag(format, set_back, name="step"))


def test_equal_stamps_are_not_out_of_order(bag):
    """Of a gyro they are refused, by their own name; of a magnetometer the sample is taken."""
    _, content = imu()
    field = [("/imu/mag", "MagneticField", START + 5_000_001 * k, "m", [1e-5, 0, 0]) for k in (1, 2, 2, 3)]
    assert not any("sorted" in remark for remark in read(bag("mcap", content + field)).remarks)
    content[2] = (*content[2][:2], content[1][2], *content[2][3:])
    with pytest.raises(InputError, match="other samples: 1 of 40"):
        read(bag("mcap", content, name="again"))


def test_bags_without_an_inertial_unit_and_what_is_no_bag_are_refused(bag, tmp_path):
    with pytest.raises(InputError, match=r"has no message of sensor_msgs/msg/Imu; give a bag"):
        read(bag("bag", [("/chatter", "String", START, "", "x")]))
    with pytest.raises(InputError, match=r"topic /imu/data has no orientation in its 40 messages"):
        read_attitudes(bag("mcap", imu()[1]))
    fake = tmp_path / "fake.bag"
    fake.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(InputError, match=r"fake.bag cannot be read as a ROS bag"):
        read(fake)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="is a folder; name the file in it"):
        read(tmp_path / "empty")


@pytest.mark.parametrize("suffix", ["bag", "mcap", "db3"])
def test_of_a_truncated_bag_the_repair_is_named(bag, suffix):
    path = bag(suffix, imu(2000)[1])
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=rf"walk\.{suffix} cannot be read as a ROS bag .*`mcap recover`"):
        read(path)


def test_a_message_of_another_layout_is_named(bag):
    """A type of the right name and another definition: its message is too short."""
    from strapdown.recordings import ros

    messages = [bytes([0, 1, 0, 0]) + bytes(size) for size in (340, 20)]
    topic = ros.Topic("/imu", ros.IMU, ros2=True, logged=[0, 1], raw=messages)
    with pytest.raises(InputError, match=r"x.bag, topic /imu: message 2 is 24 bytes long, shorter than its type"):
        topic.decoded("x.bag", ros.READ[ros.IMU])


def tesla(*size, **options) -> Recording:
    """Return a recording with its field in the unit of a bag."""
    return replace(walk(*size, **options), magnetic_unit="T", movement=None)


@pytest.mark.parametrize("suffix", ["bag", "mcap"])
def test_the_library_reads_what_is_written(tmp_path, suffix):
    from rosbags.highlevel import AnyReader

    whole = tesla()
    recordings.write(whole, tmp_path / f"x.{suffix}")
    with AnyReader([tmp_path / f"x.{suffix}"]) as reader:
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == "/imu/data_raw"]
    assert len(messages) == 60
    assert messages[7].header.frame_id == "imu_link"
    assert messages[7].header.stamp.sec * 10**9 + messages[7].header.stamp.nanosec == whole.clock_ns[7]
    assert messages[7].angular_velocity.y == whole.rate[7, 1]
    assert messages[7].linear_acceleration.z == whole.specific_force[7, 2]
    assert messages[7].orientation_covariance[0] == -1.0


@pytest.mark.parametrize("suffix", ["bag", "mcap"])
def test_an_estimate_fills_in_orientation_and_covariance_and_keeps_other_topics(bag, tmp_path, suffix):
    """About the fixed axes: a third of a turn about (1, 1, 1) takes the body's x, y, z to the fixed y, z, x."""
    from rosbags.highlevel import AnyReader

    _, content = imu()
    content.append(("/chatter", "String", START, "", "hello"))
    source = bag(suffix, content)
    recording = read(source)
    q = np.full((30, 4), 0.5)
    variance = np.tile([1.0, 4.0, 9.0, 1.0, 1.0, 1.0], (30, 1))
    estimate = Estimate(time=recording.time[10:], attitude=q, bias=np.zeros((30, 3)), variance=variance)
    recordings.write(estimate, tmp_path / f"out.{suffix}", recording=recording, source=source)
    with AnyReader([tmp_path / f"out.{suffix}"]) as reader:
        messages = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]
    units = [decoded for topic, decoded in messages if topic == "/imu/data"]
    assert [decoded.data for topic, decoded in messages if topic == "/chatter"] == ["hello"]
    assert units[9].orientation_covariance[0] == -1.0
    np.testing.assert_allclose(units[10].orientation_covariance.reshape(3, 3), np.diag([9.0, 1.0, 4.0]), atol=1e-12)
    assert (units[10].orientation.w, units[10].orientation.z) == (0.5, 0.5)
    assert units[10].angular_velocity.x == recording.rate[10, 0]
    certain = replace(estimate, variance=np.zeros((30, 6)))
    recordings.write(certain, tmp_path / f"certain.{suffix}", recording=recording)
    back = read_attitudes(tmp_path / f"certain.{suffix}")
    assert back.covariance is None
    assert back.remarks[-1] == "Its covariances are zero: unknown."
    other = tmp_path / f"other.{'mcap' if suffix == 'bag' else 'bag'}"  # messages of the other ROS cannot be copied
    recordings.write(estimate, other, recording=recording, source=source)
    with AnyReader([other]) as reader:
        assert {c.topic for c in reader.connections} == {"/imu/data"}
    with pytest.raises(InputError, match="have no stamp in common"):
        recordings.write(estimate, tmp_path / f"no.{suffix}", recording=tesla(10))
    with pytest.raises(InputError, match="give the recording that the estimate was made from"):
        recordings.write(estimate, tmp_path / f"no.{suffix}")


def test_what_a_bag_cannot_hold_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not declare the unit of its magnetometer, which is needed in T"):
        recordings.write(replace(tesla(), magnetic_unit=""), tmp_path / "x.bag")
    with pytest.raises(InputError, match="no negative times"):
        recordings.write(replace(tesla(epoch=0), time=np.arange(60.0) - 0.5), tmp_path / "x.bag")
    assert not list(tmp_path.iterdir())
    recordings.write(replace(tesla(epoch=0), time=np.arange(60.0)), tmp_path / "x.bag")
    assert read(tmp_path / "x.bag").clock_ns[0] == 0


def test_commands_read_bags_and_say_the_topic(bag, tmp_path):
    rest = np.tile([0.0, 0.0, 0.0, 0.1, 0.1, 9.8], (300, 1)) + 1e-3 * np.random.default_rng(3).standard_normal((300, 6))
    content = [("/a/imu", "Imu", START + 10_000_000 * k, "i", rest[k]) for k in range(300)]
    path = bag("folder", content)
    said = CliRunner().invoke(app, ["estimate", str(path), "--out", str(tmp_path / "out")])
    assert said.exit_code == 0, said.output
    assert "Topic /a/imu: 300 messages." in said.output
    two = bag("mcap", content + [("/b/imu", "Imu", *entry[2:]) for entry in content], name="two")
    for options, status in (((), 1), (("--topic", "/b/imu"), 0)):
        said = CliRunner().invoke(app, ["integrate", str(two), "--out", str(tmp_path / "i.h5"), *options])
        assert said.exit_code == status, said.output
