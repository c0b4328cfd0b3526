"""Which column of a table is what: mapped, guessed and said, or refused."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from strapdown.checks import InputError
from strapdown.cli import app
from strapdown.recordings import delimited, read

DEGREE = np.pi / 180.0
G = 9.80665
VALUES = np.column_stack([[1.0, 2.0, 3.0], np.arange(1.0, 28.0).reshape(3, 9)])
"""time, three of the gyro, of the accelerometer, of the magnetometer; three rows."""


@pytest.fixture
def table(tmp_path):
    """Write a table of VALUES below some header lines and return its path."""

    def write(*header: str, name: str = "walk.csv", separator: str = ",", values=VALUES):
        rows = [separator.join(f"{x:g}" for x in row) for row in np.asarray(values)]
        path = tmp_path / name
        path.write_text("\n".join([*header, *rows]) + "\n", encoding="utf-8")
        return path

    return write


HEADERS = {
    "x-io": "Time (s),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X (g),Accelerometer Y (g),"
    "Accelerometer Z (g),Magnetometer X (uT),Magnetometer Y (uT),Magnetometer Z (uT)",
    "words": "timestamp,gyro_x_dps,gyro_y_dps,gyro_z_dps,accel_x_g,accel_y_g,accel_z_g,mag_x_uT,mag_y_uT,mag_z_uT",
    "camel": "t,GyrX [deg/s],GyrY,GyrZ,AccX [g],AccY,AccZ,MagX [µT],MagY,MagZ",
    "ros": "time,angular_velocity.x [°/s],angular_velocity.y,angular_velocity.z,linear_acceleration.x [g],linear_acceleration.y,"
    "linear_acceleration.z,magnetic_field.x [uT],magnetic_field.y,magnetic_field.z",
    "imu prefix": "Time [s],imu_gyro_x [dps],imu_gyro_y,imu_gyro_z,imu_acc_x [g],imu_acc_y,imu_acc_z,imu_mag_x [uT],imu_mag_y,imu_mag_z",
    "logger": "loggingTime(s),gyroRotationX(deg/s),gyroRotationY(deg/s),gyroRotationZ(deg/s),accelerometerAccelerationX(G),"
    "accelerometerAccelerationY(G),accelerometerAccelerationZ(G),magnetometerX(µT),magnetometerY(µT),magnetometerZ(µT)",
    "blackbox": "time (s),gyroADC[0] (deg/s),gyroADC[1] (deg/s),gyroADC[2] (deg/s),accSmooth[0] (g),accSmooth[1] (g),accSmooth[2] (g),"
    "magADC[0] (uT),magADC[1] (uT),magADC[2] (uT)",
    "symbols": "seconds,omega_x [deg/s],omega_y,omega_z,acc_x [g],acc_y,acc_z,B_x [uT],B_y,B_z",
    "joined": "seconds_elapsed,wx [deg/s],wy,wz,accx [g],accy,accz,magx [uT],magy,magz",
    "joined, unit": "time,gyrox_dps,gyroy_dps,gyroz_dps,accx_g,accy_g,accz_g,magx_uT,magy_uT,magz_uT",
}


@pytest.mark.parametrize("header", HEADERS.values(), ids=HEADERS)
def test_usual_headers_are_understood_and_said(table, header):
    recording = read(table(header))
    np.testing.assert_allclose(recording.time, VALUES[:, 0], rtol=1e-15)
    np.testing.assert_allclose(recording.rate, VALUES[:, 1:4] * DEGREE, rtol=1e-15)
    np.testing.assert_allclose(recording.specific_force, VALUES[:, 4:7] * G, rtol=1e-15)
    np.testing.assert_array_equal(recording.magnetic_field, VALUES[:, 7:])
    assert recording.magnetic_unit == "uT"
    (remark,) = recording.remarks
    assert remark.startswith("Columns assigned by their names: ")
    for role in ("gx gy gz from", "ax ay az from", "mx my mz from"):
        assert role in remark


def test_the_packages_own_names_need_no_remark(table):
    own = "time,gx [dps],gy,gz,ax [mg],ay,az,mx,my,mz"
    path = table(own)
    recording = read(path)
    assert recording.remarks == ()
    assert recording.magnetic_unit == ""
    np.testing.assert_allclose(recording.specific_force, VALUES[:, 4:7] * 1e-3 * G, rtol=1e-14)
    header, *rows = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([header, *(f"{row}," for row in rows)]), encoding="utf-8")  # as some loggers end a row
    np.testing.assert_array_equal(read(path).magnetic_field, recording.magnetic_field)


def test_a_flight_log_as_csv_has_its_axes_in_brackets(table):
    """What ulog2csv writes; the stamps are µs, which the header does not say, and as seconds no gyro has."""
    header = "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2]"
    values = VALUES[:, :7] * [4000.0, 1, 1, 1, 1, 1, 1]
    path = table(header, values=values)
    with pytest.raises(InputError, match=r"stamps of timestamp are 4000 apart.*not plausible in seconds.*\[us\]"):
        read(path)
    with pytest.raises(InputError, match=r"stamps of timestamp are 2.5 apart.*not plausible in seconds"):
        read(table(header, values=VALUES[:, :7] * [2.5, 1, 1, 1, 1, 1, 1], name="slow.csv"))
    with pytest.raises(InputError, match=r"stamps of timestamp are 4e-07 apart.*not plausible in seconds"):
        read(table(header, values=VALUES[:, :7] * [4e-7, 1, 1, 1, 1, 1, 1], name="fast.csv"))
    unsorted = table(header, values=VALUES[::-1, :7] * [4000.0, 1, 1, 1, 1, 1, 1], name="back.csv")
    with pytest.raises(InputError, match=r"time\[1\] goes back to .* sort the rows"):
        read(unsorted)
    recording = read(path, units={"time": "us"})
    np.testing.assert_allclose(recording.time, values[:, 0] * 1e-6, rtol=1e-15)
    np.testing.assert_array_equal(recording.rate, VALUES[:, 1:4])
    np.testing.assert_array_equal(recording.specific_force, VALUES[:, 4:7])


def test_euroc_names_its_columns_in_a_comment_and_keeps_its_nanoseconds(table, tmp_path):
    header = (
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    )
    path = tmp_path / "data.csv"
    stamps = [1403636579758555392 + 5_000_001 * k for k in range(4)]
    path.write_text(header + "\n" + "".join(f"{stamp},1,2,3,4,5,{6 + k}\n" for k, stamp in enumerate(stamps)))
    recording = read(path)
    assert recording.epoch_ns == stamps[0]
    np.testing.assert_allclose(recording.time, 5_000_001e-9 * np.arange(4), rtol=1e-15)
    assert recording.clock_ns.tolist() == stamps
    path.write_text(f"{header}\n2000000000000000,1,2,3,4,5,6\n2000000005000000,1,2,3,4,5,6\n")
    np.testing.assert_allclose(read(path).time, [2e6, 2e6 + 5e-3])  # of a machine that has run for 23 days
    np.testing.assert_array_equal(recording.rate[0], [1, 2, 3])
    np.testing.assert_array_equal(recording.specific_force[3], [4, 5, 9])


def test_two_header_rows_are_one_of_sensors_and_axes(table):
    """As in RepoIMU: the sensor stands once above its three axes, parted by semicolons."""
    first = "Time [s];Gyroscope [rad/s];;;Accelerometer [m/s^2];;;Magnetometer [uT];;"
    recording = read(table(first, ";X;Y;Z;X;Y;Z;X;Y;Z", separator=";"))
    np.testing.assert_array_equal(recording.rate, VALUES[:, 1:4])
    np.testing.assert_array_equal(recording.specific_force, VALUES[:, 4:7])
    np.testing.assert_array_equal(recording.magnetic_field, VALUES[:, 7:])


def test_two_header_rows_are_one_of_names_and_units(table):
    names = "time\tgx\tgy\tgz\tax\tay\taz\tmx\tmy\tmz"
    recording = read(table(names, "ms\tdps\tdps\tdps\tg\tg\tg\tnT\tnT\tnT", separator="\t"))
    np.testing.assert_allclose(recording.time, VALUES[:, 0] * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(recording.rate, VALUES[:, 1:4] * DEGREE, rtol=1e-15)
    assert recording.magnetic_unit == "nT"


@pytest.mark.parametrize("unit", ["a.u.", "(a.u.)", "local_flux"])
def test_a_field_in_arbitrary_units_declares_none(table, unit):
    """As of Xsens, and of Shimmer below the names."""
    bracketed = unit if unit.startswith("(") else f"[{unit}]"
    recording = read(table(f"time,gx [dps],gy,gz,ax [g],ay,az,Mag_X {bracketed},Mag_Y {bracketed},Mag_Z {bracketed}"))
    np.testing.assert_array_equal(recording.magnetic_field, VALUES[:, 7:])
    assert recording.magnetic_unit == ""
    plain = unit.strip("()")
    units = f"ms\tdeg/s\tdeg/s\tdeg/s\tm/(s^2)\tm/(s^2)\tm/(s^2)\t{plain}\t{plain}\t{plain}\t"
    names = (f"Shimmer_{sensor}_{axis}_CAL" for sensor in ("Gyro", "Accel_LN", "Mag") for axis in "XYZ")
    recording = read(table("\t".join(("Shimmer_Timestamp_Unix_CAL", *names, "")), units, separator="\t"))
    np.testing.assert_array_equal(recording.specific_force, VALUES[:, 4:7])
    assert recording.magnetic_unit == ""


ODD = "when,u1,u2,u3,f1,f2,f3,n1,n2,n3"


def test_a_mapping_names_columns_and_units(table):
    path = table(ODD)
    with pytest.raises(InputError, match=r"lacks time.*it has: when, u1.*`columns={'time': "):
        read(path)
    mapping = {"time": "when[ms]", "gx": "u3[dps]", "gy": "u2", "gz": "u1", "ax": "f1[mg]", "ay": "f2", "az": "f3"}
    recording = read(path, columns=mapping)
    np.testing.assert_allclose(recording.time, VALUES[:, 0] * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(recording.rate, VALUES[:, [3, 2, 1]] * DEGREE, rtol=1e-15)
    np.testing.assert_allclose(recording.specific_force, VALUES[:, 4:7] * 1e-3 * G, rtol=1e-14)
    assert recording.magnetic_field is None


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        ("time", "--columns is 'time'; give ROLE=NAME"),
        ("tme=when", "role 'tme' is not known; did you mean 'time'"),
        ("time=when,time=u1", "time is given twice"),
        ("time=then", "has no column 'then' for time"),
        ("time=when,gx=u1(furlong)", "the unit in 'u1(furlong)' for gx is not known (known: rad/s, deg/s"),
        ("time=when,gx=u1", "lacks gy, gz"),
    ],
)
def test_bad_mappings_are_refused(refusal, table, mapping, words):
    assert words in refusal("integrate", table(ODD), "--columns", mapping)


def test_two_sensors_that_fit_are_refused_not_chosen(table):
    header = "time,gyro_x [dps],gyro_y,gyro_z,gyr_x,gyr_y,gyr_z,mx,my,mz"
    path = table(header)
    with pytest.raises(
        InputError, match=r"the gyro may be that of gyro_x \[dps\] or gyr_x; select one, as in `columns={'gx': "
    ):
        read(path)
    recording = read(path, columns={"gx": "gyr_x[deg/s]", "gy": "gyr_y", "gz": "gyr_z"})
    np.testing.assert_allclose(recording.rate, VALUES[:, 4:7] * DEGREE, rtol=1e-15)


@pytest.mark.parametrize(
    "name",
    [
        "Linear Acceleration {} (m/s^2)",
        "LinAcc{} (g)",
        "userAcceleration{}",
        "gyro_bias_{}",
        "acc_{}_std",
        "angular_acceleration_{}",
    ],
)
def test_what_is_no_plain_sample_is_not_taken_for_one(table, name):
    """An acceleration without gravity shows no vertical."""
    other = ",".join(name.format(axis) for axis in "xyz")
    recording = read(table(f"time,gx [rad/s],gy,gz,{other},mx,my,mz"))
    assert recording.specific_force is None
    assert recording.remarks == ()


def test_a_time_may_be_a_date(tmp_path):
    path = tmp_path / "phone.csv"
    rows = (
        "2024-03-01T13:00:00.000250+01:00,1,2,3",
        "2024-03-01T12:00:00.010250Z,1,2,3",
        "2024-03-01 12:00:00.020250,1,2,3",
    )
    path.write_text("timestamp,gyro_x [dps],gyro_y,gyro_z\n" + "\n".join(rows) + "\n")
    recording = read(path)
    np.testing.assert_allclose(recording.time, [0.0, 0.01, 0.02], atol=1e-12)
    assert recording.epoch_ns == 1_709_294_400_000_250_000
    path.write_text(path.read_text().replace("2024-03-01 12", "2024-13-01 12"))
    with pytest.raises(InputError, match=r"data row 3, column timestamp is '2024-13-01 12:00:00.020250', not a number"):
        read(path)


@pytest.mark.parametrize("stamp", ["10:15:30.000", "28.11.2026 10:15:30", "2026-11-28 25:00:00"])
def test_another_time_of_day_or_date_is_refused_with_one_that_is_read(tmp_path, stamp):
    path = tmp_path / "walk.csv"
    path.write_text(f"time,gx [dps],gy,gz\n{stamp},1,2,3\n{stamp},1,2,3\n")
    with pytest.raises(
        InputError, match=rf"column time is '{stamp}', not a number; write seconds, or dates such as (\S+)$"
    ) as error:
        read(path)
    assert delimited.date_ns(str(error.value).split()[-1]) is not None


def test_milliseconds_since_1970_keep_every_nanosecond(table):
    """Doubles of this size are 64 ns apart in seconds, 256 in nanoseconds; the product is taken in integers."""
    stamps = 1_763_850_000_009 + np.array([0, 10, 21])
    path = table("Time since start in ms,wx [dps],wy,wz")
    rows = [f"{stamp},1,2,3" for stamp in stamps]
    path.write_text("\n".join([path.read_text().splitlines()[0], *rows]) + "\n", encoding="utf-8")
    recording = read(path)
    assert recording.epoch_ns == 1_763_850_000_009_000_000
    np.testing.assert_allclose(recording.time, [0.0, 0.01, 0.021], rtol=1e-15)
    fraction = f"{path.read_text(encoding='utf-8').splitlines()[0]}\n1763850000009.25,1,2,3\n1763850000019.5,1,2,3\n"
    path.write_text(fraction, encoding="utf-8")
    assert read(path).epoch_ns == 1_763_850_000_009_250_000


def test_columns_that_nobody_asks_for_may_hold_anything(table, tmp_path):
    path = tmp_path / "labels.csv"
    path.write_text(
        "date,time,gx [dps],gy,gz,label\n2024-03-01T12:00:00Z,0,1,2,3,walk\n2024-03-01T12:00:01Z,1,1,2,3,\n"
    )
    recording = read(path)
    np.testing.assert_allclose(recording.rate[1], np.radians([1, 2, 3]), rtol=1e-15)
    with pytest.raises(InputError, match=r"data row 1, column label is 'walk', not a number"):
        read(path, columns={"gy": "label"})


def test_temperature_goes_along(table):
    recording = read(table("time,gx [rad/s],gy,gz,temperature [°C],a1,a2,mx,my,mz"))
    np.testing.assert_array_equal(recording.temperature, VALUES[:, 4])
    guessed = read(table("time,gx [rad/s],gy,gz,temp_C,a1,a2,mx,my,mz"))
    np.testing.assert_array_equal(guessed.temperature, VALUES[:, 4])


def test_the_xio_recording_is_understood(xio):
    recording = read(xio / "sensor_data.csv")
    assert len(recording.time) == 13514
    assert abs(np.linalg.norm(recording.specific_force[:50].mean(axis=0)) - G) < 0.1
    assert "Gyroscope X" in recording.remarks[0]


@pytest.fixture
def xio():
    folder = Path(__file__).resolve().parents[1] / ".." / "shared" / "data" / "xio"
    if not folder.is_dir():
        pytest.skip("the x-io recording is not here")
    return folder


def test_commands_take_columns_and_say_what_they_guessed(table, tmp_path):
    time = np.arange(300) / 100.0
    values = np.column_stack([time, np.zeros((300, 3)), np.zeros((300, 2)), np.full(300, 1.0)])
    guessed = table("t,GyrX [dps],GyrY,GyrZ,AccX [g],AccY,AccZ", values=values)
    odd = table("t,u1,u2,u3,f1,f2,f3", values=values, name="odd.csv")
    mapping = "time=t,gx=u1[dps],gy=u2,gz=u3,ax=f1[g],ay=f2,az=f3"
    for command, name in {"estimate": "estimate", "integrate": "integrate.h5", "doctor": ""}.items():
        out = ["--out", str(tmp_path / name)] if name else []
        said = CliRunner().invoke(app, [command, str(guessed), *out])
        assert "Columns assigned by their names: time from 't'" in said.output, said.output
        other = CliRunner().invoke(app, [command, str(odd), *out, "--columns", mapping])
        assert other.exit_code == said.exit_code, other.output
        assert "Columns assigned" not in other.output


@pytest.mark.parametrize(("line", "numeric"), [("1;a", True), ("1,a,b", False), ('"1.5",, a ', True), (",;", False)])
def test_a_line_is_of_numbers_if_half_of_its_fields_are(line, numeric):
    assert delimited._numeric(line) == numeric
