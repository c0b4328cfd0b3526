"""Reading recordings: CSV and BROAD HDF5, their units, and clear words where a file is not what it should be."""

import h5py
import numpy as np
import pytest
from measured import series_of
from typer.testing import CliRunner

import strapdown
from strapdown import estimation, motion, recordings, vectors
from strapdown.checks import InputError
from strapdown.cli import app
from strapdown.recordings import Recording, read, recordfiles, samples
from strapdown.records import ImuRecord, result_file
from strapdown.records.recording import at_nearest, gaps, rows_of

HEADER = "time,gx [rad/s],gy,gz,ax [m/s2],ay,az"
ROWS = ("0.00,0.1,0.2,0.3,1,2,9", "0.01,0.4,0.5,0.6,3,4,8", "0.02,0.7,0.8,0.9,5,6,7")


@pytest.fixture
def csv(tmp_path):
    """Write a CSV file of a header and rows and return its path."""

    def write(header: str = HEADER, rows: tuple[str, ...] | list[str] = ROWS, name: str = "walk.csv"):
        path = tmp_path / name
        path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
        return path

    return write


def refused(path, *words: str, **options) -> None:
    with pytest.raises(InputError) as caught:
        read(path, **options)
    for word in (path.name, *words):
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------------------------------------- CSV: what is read


def test_columns_in_any_order_with_others_between_comments_and_blank_lines(csv):
    header = "# logged by hand\n\n az [g], AY ,ax,temperature, mz,my,mx, gz [rad/s],gy,gx,Time"
    recording = read(
        csv(header, ["9,2,1,21.5,30,20,10,0.3,0.2,0.1,0", "", "# a pause", "8,4,3,21.6,3,2,1,0.6,0.5,0.4,1"])
    )
    np.testing.assert_array_equal(recording.rate[0], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(recording.specific_force[0], np.array([1, 2, 9]) * 9.80665, rtol=1e-15)
    np.testing.assert_array_equal(recording.magnetic_field, [[10, 20, 30], [1, 2, 3]])


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path):
    path = tmp_path / "excel.csv"
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join([HEADER, *ROWS, ""]).encode())
    assert len(read(path).time) == 3


@pytest.mark.parametrize(
    ("gyro", "rate", "accelerometer", "force"),
    [
        ("rad/s", 1.0, "m/s2", 1.0),
        ("deg/s", np.pi / 180.0, "m/s²", 1.0),
        ("°/s", np.pi / 180.0, "m/s^2", 1.0),
        ("rad/s", 1.0, "g", 9.80665),
    ],
)
def test_units_of_the_header(csv, gyro, rate, accelerometer, force):
    recording = read(csv(f"time,gx [{gyro}],gy,gz,ax [{accelerometer}],ay [{accelerometer}],az"))
    np.testing.assert_allclose(recording.rate[1], np.array([0.4, 0.5, 0.6]) * rate, rtol=1e-15)
    np.testing.assert_allclose(recording.specific_force[1], np.array([3, 4, 8]) * force, rtol=1e-15)


@pytest.mark.parametrize(("unit", "factor"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)])
def test_time_unit_by_header_and_by_option(csv, unit, factor):
    wanted = np.array([0.0, 0.01, 0.02]) * factor
    np.testing.assert_allclose(read(csv(HEADER.replace("time", f"time [{unit}]"))).time, wanted, rtol=1e-15)
    np.testing.assert_allclose(read(csv(), units={"time": unit}).time, wanted, rtol=1e-15)


def test_units_by_option(csv):
    recording = read(csv("time,gx,gy,gz,ax,ay,az"), units={"gyro": "deg/s", "accelerometer": "g"})
    np.testing.assert_allclose(recording.rate[0], np.deg2rad([0.1, 0.2, 0.3]), rtol=1e-15)
    np.testing.assert_allclose(recording.specific_force[0], np.array([1, 2, 9]) * 9.80665, rtol=1e-15)
    # saying again what the header says is no contradiction
    np.testing.assert_array_equal(read(csv(), units={"gyro": "rad/s"}).rate[0], [0.1, 0.2, 0.3])


def test_empty_fields_of_accelerometer_and_magnetometer_are_missing_samples(csv):
    recording = read(csv(HEADER + ",mx,my,mz", ["0,1,2,3,,,,4,5,6", "1,1,2,3,4,5,6,,nan,"]))
    assert np.isnan(recording.specific_force[0]).all()
    assert np.isnan(recording.magnetic_field[1]).all()
    np.testing.assert_array_equal(recording.specific_force[1], [4, 5, 6])


# ---------------------------------------------------------------------------------------------------- CSV: what is refused


def test_a_sensor_without_any_sample_is_left_out_and_reported(csv):
    recording = read(csv(HEADER + ",mx,my,mz", ["0,1,2,3,,,,4,5,6", "1,1,2,3,,,,4,5,6"]))
    assert recording.specific_force is None
    assert recording.remarks[-1] == "The accelerometer has no sample from 0 s on."


BARE = "time,gx,gy,gz,ax [m/s2],ay,az"
SECOND = "0.01,0.4,0.5,0.6,3,4,8"
REFUSED = {
    "undeclared gyro": (BARE, ROWS, "does not declare the unit of its gyro", "gx [rad/s]", "rad/s, deg/s, mrad/s, mdeg/s"),
    "undeclared force": ("time,gx [rad/s],gy,gz,ax,ay,az", ROWS, "unit of its accelerometer", "ax [m/s2]", "(m/s2, g, mg, mm/s2)"),
    "unknown gyro unit": (HEADER.replace("rad/s", "deg/sec"), ROWS, "unit of the gyro 'deg/sec'", "did you mean 'deg/s'"),
    "unknown force unit": (HEADER.replace("m/s2", "ft/s2"), ROWS, "unit of the accelerometer 'ft/s2' is not known"),
    "two units": ("time,gx [rad/s],gy [deg/s],gz,ax [g],ay,az", ROWS, "column gy is in deg/s", "rad/s", "same unit"),
    "missing axis": ("time,gx [rad/s],gy,ax [g],ay,az", ["0,1,2,3,4,5"], "lacks gz", "it has: time, gx, gy, ax, ay, az"),
    "missing time": ("gx [rad/s],gy,gz,ax [g],ay,az", ["0,1,2,3,4,5"], "lacks time", "or write one: the number"),
    "semicolons": ("time;gx;gy;ax;ay;az", ["0;1;2;3;4;5"], "lacks gz", "`columns={'gz': 'NAME'}`"),
    "doubled column": ("time,gx [rad/s],gy,gz,ax [g],ay,az,GX", ROWS, "column 'gx' twice"),
    # A slip of the pen, and a heading that nobody measures is a quiet way to fail.
    "half a magnetometer": (HEADER + ",mx,my", [row + ",1,2" for row in ROWS], "lacks mz"),
    "decimal commas": (
        HEADER,
        ["0,00,0,1,0,2,0,3,1,0,2,0,9,8"],
        "data row 1 has 14 fields, the header 7",
        "seems to have decimal commas: write points",
    ),
    "one field more": (HEADER, [ROWS[0] + ",1.5"], "data row 1 has 8 fields", "truncated or damaged"),
    "truncated row": (HEADER, [ROWS[0], "0.01,0.4,0.5,0.6,3"], "data row 2 has 5 fields, the header 7", "truncated"),
    **{
        f"no number: {bad}": (HEADER, [ROWS[0], f'0.01,0.4,"{bad}",0.6,3,4,8'], "data row 2, column gy", repr(bad), "not a number")
        for bad in ("fast", "0x1f", "1,5", "1.2.3", "--1")
    },
    **{
        f"rate {bad}": (HEADER, [ROWS[0], SECOND.replace("0.5", bad)], "rate[1, 1] is", "remove or interpolate")
        for bad in ("inf", "-Infinity")
    },
    "infinite force": (HEADER, [ROWS[0], SECOND.replace("4,8", "inf,8")], "specific_force[1, 1] is inf"),
    "hardly a sample": (HEADER, [ROWS[0], SECOND.replace("0.5", "")], "1 of 2 rows have a whole gyro sample", "at least 2"),
    "gap and back": (HEADER, [ROWS[0], "0.02,,0,0,0,0,9", "0.01,1,0,0,0,0,9", ROWS[2]], "time[2] goes back to 0.01 s"),
    "back": (HEADER, [ROWS[0], ROWS[2], ROWS[1]], "time[2] goes back to 0.01 s", "sort"),
    "clock restarted": (
        HEADER,
        [f"{0.01 * (k % 120) + (0.3 if k < 120 else 0.0)},{0.1 * k},0,0,0,0,9" for k in range(200)],
        "time[120] goes back to 0 s after 1.49 s",
        "the clock restarted in row 121: split the recording there",
    ),
    "clock restarted after a repeated row": (
        HEADER,
        [ROWS[0], *(f"{0.01 * (k % 50)},{0.1 * k},0,0,0,0,9" for k in range(70))],
        "the clock restarted in row 52: split",
    ),
    "clock set": (HEADER, [*ROWS[:3], "1.7e9,0,0,0,0,0,9"], "time[3] jumps to 1.7e+09 s after 0.02 s", "cut"),
    "no row": (HEADER, [], "no data rows"),
    "one row": (HEADER, ROWS[:1], "time has 1 stamps"),
    "few digits": (
        HEADER,
        [f"{1.7e9 + 0.01 * k:.10g},{0.1 * k},0,0,0,0,9" for k in range(300)],
        "rows with the stamp of the row before and other samples: 296 of 300, the first 0 s in row 2",
        "write the stamps with more digits",
        "space evenly those of samples that came together",
    ),
    "repeated": (HEADER, [*ROWS[:2], "0.01" + 6 * ",0.5"], "other samples: 1 of 3, the first 0.01 s in row 3", "drop them"),
    "no stamp": (HEADER, [ROWS[0], ",0,0,0,0,0,9"], "time[1] is nan"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_bad_tables_are_refused_by_their_place(csv, case):
    header, rows, *words = REFUSED[case]
    refused(csv(header, rows), *words)


@pytest.mark.parametrize(
    ("header", "options", "words"),
    [
        (BARE, {"units": {"gyro": "mrad"}}, ("unit of the gyro 'mrad'",)),
        (HEADER, {"units": {"gyros": "deg/s"}}, ("'gyros' is not known", "'gyro'")),
        (HEADER, {"units": {"time": "min"}}, ("unit of the time 'min'",)),
        (HEADER, {"units": {"gyro": "deg/s"}}, ("the header declares rad/s", "the option is deg/s", "drop one")),
        (HEADER, {"units": "deg/s"}, ("units is 'deg/s'", "{'gyro': 'deg/s'}")),
        (HEADER, {"columns": "gx"}, ("columns is 'gx'",)),
        (HEADER, {"columns": {"gyro": "gx"}}, ("role 'gyro' is not known", "did you mean 'gy'")),
    ],
)
def test_bad_options_are_refused(csv, header, options, words):
    refused(csv(header), *words, **options)


def test_a_wrong_unit_in_the_header_is_replaced_as_the_refusal_says(csv):
    """`doctor` finds that the header's unit is wrong; the option alone contradicts the header."""
    path = csv()
    columns = {"gx": "gx [deg/s]", "gy": "gy [deg/s]", "gz": "gz [deg/s]"}
    refused(path, f"replace the header's by `columns={columns}`", units={"gyro": "deg/s"})
    np.testing.assert_allclose(read(path, columns=columns).rate, np.radians(read(path).rate), rtol=1e-15)


def test_options_of_samples_that_do_not_apply_are_refused(csv, tmp_path):
    path = csv()
    gyro = recordings.read_samples(path, "gyro")
    np.testing.assert_array_equal(gyro.values, read(path).rate)
    with pytest.raises(InputError, match="states its own rate; drop the option rate"):
        recordings.read_samples(path, "gyro", rate=100.0)
    np.save(tmp_path / "gyro.npy", gyro.values)
    with pytest.raises(InputError, match=r"gyro.npy is one array; leave `topic='/imu'` out"):
        recordings.read_samples(tmp_path / "gyro.npy", units={"gyro": "rad/s"}, rate=100.0, topic="/imu")


def test_an_array_has_the_rate_and_the_unit_that_are_given(tmp_path):
    np.save(tmp_path / "rest.npy", np.full((5, 3), 180.0))
    gyro = recordings.read_samples(tmp_path / "rest.npy", "gyro", rate=200.0, units={"gyro": "deg/s"})
    assert gyro.sample_interval == pytest.approx(0.005)
    np.testing.assert_allclose(gyro.values, np.pi)
    np.save(tmp_path / "one.npy", np.arange(5.0))  # one axis
    gyro = recordings.read_samples(tmp_path / "one.npy", "gyro", rate=200.0, units={"gyro": "rad/s"})
    np.testing.assert_array_equal(gyro.values, np.arange(5.0)[:, None])


def test_rows_of_times_are_those_of_their_stamps():
    recording = Recording(source="a", time=0.5 * np.arange(4.0), rate=np.ones((4, 3)))
    np.testing.assert_array_equal(rows_of(recording, np.array([0.0, 1.0, 1.5])), [0, 2, 3])
    with pytest.raises(InputError):
        rows_of(recording, np.array([0.25]))


def test_vectors_of_a_record_are_at_their_stamps():
    """Row k is the interval that ends at edge k + 1; a vector between two edges belongs to none, that of a direction neither."""
    time, g = np.arange(5.0), np.array([0.0, 0.0, 9.81])
    vectors = (
        series_of("accelerometer", "vector", [1.0, 2.5, 4.0], [g, 2.0 * g, 3.0 * g], g, 0.01),
        series_of("magnetometer", "direction", [1.0], [[1.0, 0.0, 0.0]], [1.0, 0.0, 0.0], 0.01),
    )
    record = ImuRecord(time=time, increments=np.ones((4, 3)), vectors=vectors, temperature=20.0 + time)
    recording = recordings.from_record(record)
    np.testing.assert_array_equal(recording.temperature, 20.0 + recording.time)
    none = np.full(3, np.nan)
    np.testing.assert_array_equal(recording.specific_force, [g, none, none, 3.0 * g])
    assert recording.magnetic_field is None
    assert recording.remarks[0].startswith("From a record")  # which may be measured
    assert "Left out: magnetometer (direction)." in " ".join(recording.remarks)
    assert "only whole vectors of sensors named accelerometer and magnetometer" in " ".join(recording.remarks)


def test_the_magnetometer_of_a_simulated_record_is_in_tesla(tmp_path):
    field = np.array([2e-5, 0.0, -4e-5])
    sensor = vectors.Magnetometer(name="magnetometer", kind="vector", field_f=field, sigma=1e-9, rate=10.0)
    scenario = strapdown.Scenario(
        motion=motion.rest(), gyro=strapdown.GyroSpec(), sensors=(sensor,), rate=10.0, duration=2.0
    )
    strapdown.write(strapdown.simulate(scenario), tmp_path / "unit.h5")
    magnetometer = recordings.read_samples(tmp_path / "unit.h5", "magnetometer")
    np.testing.assert_allclose(magnetometer.values, np.broadcast_to(field, magnetometer.values.shape), atol=1e-8)


@pytest.mark.parametrize("mark", [";", "\t", "|"])
def test_other_separators_are_read_and_their_decimals_may_have_commas(csv, mark):
    plain = read(csv())
    for decimal in (".", ","):
        path = csv(HEADER.replace(",", mark), [row.replace(",", mark).replace(".", decimal) for row in ROWS])
        recording = read(path)
        np.testing.assert_array_equal(recording.time, plain.time)
        np.testing.assert_array_equal(recording.rate, plain.rate)
        np.testing.assert_array_equal(recording.specific_force, plain.specific_force)


def test_columns_separated_by_spaces_are_reported(csv):
    spaced = csv(HEADER.replace(",", " "), [row.replace(",", " ") for row in ROWS])
    refused(spaced, "its header, 'time gx [rad/s] gy", "is one column", "separate columns by comma")


ABOVE = {
    "words": "Device: A\nMade by: B\n\n",
    "comments of a tracker": "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: human, slow (46.1)\n",
    "pairs": "sep=,\nDeviceTag:,Dot 3\nFirmwareVersion:,2.0.0\nOutputRate:,60\n\n",
}


@pytest.mark.parametrize("above", ABOVE.values(), ids=ABOVE)
def test_lines_above_the_header_are_skipped(csv, above):
    rate = read(csv()).rate
    np.testing.assert_array_equal(read(csv(f"{above}{HEADER},", [f"{row}," for row in ROWS])).rate, rate)
    np.testing.assert_array_equal(read(csv(f"{above}time,gx,gy,gz,ax,ay,az\n,rad/s,,,m/s2,,", ROWS)).rate, rate)
    refused(csv(f"{above}{HEADER}", [ROWS[0] + ",1"]), "data row 1 has 8 fields, the header 7")


@pytest.mark.parametrize(("columns", "name"), [("ax [m/s2],ay,az", "specific_force"), ("mx,my,mz", "magnetic_field")])
def test_a_sensor_of_zeros_is_reported(csv, columns, name):
    rows = [f"{k / 100},0.1,0.2,0.3,0,0,{'' if k == 1 else 0}" for k in range(3)]
    refused(csv(f"time,gx [rad/s],gy,gz,{columns}", rows), f"{name} is 0 in every row", "leave its columns out")
    read(csv(f"time,gx [rad/s],gy,gz,{columns}", [*rows, "1,1,1,1,0,0,1"]))
    read(csv(f"time,gx [rad/s],gy,gz,{columns}", [f"{k / 100},0.1,0.2,0.3,,," for k in range(3)]))


@pytest.mark.parametrize("bad", ["nan", "", " ", "zeros"])
def test_rows_without_a_gyro_sample_are_left_out_and_reported(csv, bad):
    """What the turn across them is nobody knows: the intervals beside one are joined, and a filter's covariance grows over all of it."""
    rows = [f"{0.01 * k:.2f},{0.1 * k},0,0,{k},2,9" for k in range(8)]
    for k in (0, 3, 4):
        rows[k] = f"{0.01 * k:.2f}" + (",0" * 6 if bad == "zeros" else f",{0.1 * k},{bad},0,{k},2,9")
    recording = read(csv(rows=rows))
    np.testing.assert_array_equal(recording.time, [0.01, 0.02, 0.05, 0.06, 0.07])
    np.testing.assert_allclose(recording.specific_force[:, 0], [1, 2, 5, 6, 7])
    np.testing.assert_array_equal(recording.missing_gyro, [0.0, 0.03, 0.04])
    for first in (0, 1):
        np.testing.assert_array_equal(recording.taken(slice(first, None)).missing_gyro, [0.03, 0.04])
    # The trapezoid over the joined interval; of a rate that changes evenly it is right.
    np.testing.assert_allclose(recordings.increments(recording)[1, 0], 0.5 * (0.2 + 0.5) * 0.03, rtol=1e-14)
    assert recording.left_out_words.startswith("3 rows without a gyro sample, the first at 0.000 s, were left out")
    assert read(csv()).left_out_words == ""
    assert len(read(csv(rows=rows[:3])).time) == 2  # enough
    growth = estimation.run(
        ImuRecord(time=recording.time, increments=recordings.increments(recording)),
        estimation.ProcessNoise(angle_random_walk=1e-3, rate_random_walk=0.0),
        estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-6, bias_sigma=1e-9),
    ).variance[:, 0]
    np.testing.assert_allclose(np.diff(growth), 1e-6 * np.diff(recording.time), rtol=1e-6)


def test_a_row_for_each_sensor_is_one_recording(csv):
    rows = [f"{0.01 * k:.2f},{k},0,0,,,,\n{0.01 * k + 0.004:.3f},,,,{k},2,9,2{k}" for k in range(4)]
    recording = read(csv(f"{HEADER},temperature", rows))
    np.testing.assert_array_equal(recording.temperature, [20.0, 21.0, 22.0, 23.0])
    np.testing.assert_array_equal(recording.rate[:, 0], range(4))
    assert recording.left_out_words.endswith(
        "and other samples in them moved to the nearest row."
    )  # no rotation is lost
    np.testing.assert_array_equal(recording.specific_force, [[k, 2, 9] for k in range(4)])


@pytest.mark.parametrize("every", [1, 2, 500], ids=["always", "often", "seldom"])
@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["gyro first", "gyro last"])
def test_rows_of_each_sensor_with_one_stamp_are_one_sample(csv, every, order):
    """Sensors with one clock, as concatenated by pandas: no sample is lost."""
    rows = [(f"{0.01 * k:.2f},{k},0,0,,,", f"{0.01 * k:.2f},,,,{k},2,9") for k in range(1000)]
    lines = [row[j] for k, row in enumerate(rows) for j in order if j == 0 or k % every == 0]
    recording = read(csv(rows=lines))
    np.testing.assert_array_equal(recording.rate[:, 0], range(1000))
    np.testing.assert_array_equal(recording.specific_force[::every, 0], range(0, 1000, every))
    assert np.isnan(recording.specific_force).any(axis=1).sum() == 1000 - len(range(0, 1000, every))
    assert (recording.left_out_words, recording.remarks) == ("", ())


def test_two_samples_of_one_sensor_with_one_stamp_are_refused(csv):
    rows = [f"{0.01 * k:.2f},{k},0,0,,,\n{0.01 * k:.2f},,,,{k},2,9" for k in range(4)]
    refused(csv(rows=[*rows, "0.03,,,,4,2,9"]), "other samples: 1 of 9, the first 0.03 s in row 9")


def test_samples_for_which_there_is_no_row_of_the_gyro_are_counted(csv):
    rows = [
        f"{0.01 * k:.2f},{k},0,0,,,\n{0.01 * k + 0.004:.3f},,,,{k},2,9\n{0.01 * k + 0.0049:.4f},,,,7,2,9"
        for k in range(4)
    ]
    assert read(csv(rows=rows)).remarks == (
        "4 of 8 samples of the accelerometer were left out: others are nearer to the gyro's.",
    )


def test_rows_that_repeat_the_row_before_are_left_out_and_reported(csv):
    """A logger that writes a row twice; the same stamp with another sample is refused, and named."""
    rows = [f"{0.01 * k:.2f},{0.1 * k},0,0,{k},2,9" for k in range(6)]
    once = read(csv(rows=rows))
    twice = read(csv(rows=[*rows[:3], rows[2], rows[2], *rows[3:], rows[5]]))
    np.testing.assert_array_equal(twice.time, once.time)
    np.testing.assert_array_equal(twice.rate, once.rate)
    np.testing.assert_array_equal(twice.specific_force, once.specific_force)
    np.testing.assert_array_equal(twice.repeated, [0.02, 0.02, 0.05])
    np.testing.assert_array_equal(twice.taken(slice(3, None)).repeated, [0.05])
    assert twice.left_out_words == "3 rows with the stamp of the row before, the first at 0.020 s, were left out."
    assert once.left_out_words == ""
    missing = rows[2].replace("0.2,0,0", ",0,0")
    both = read(csv(rows=[*rows[:2], missing, missing, *rows[3:]]))
    np.testing.assert_array_equal(both.repeated, [0.02])
    np.testing.assert_array_equal(both.missing_gyro, [0.02])
    with pytest.raises(InputError, match=r"other samples: 1 of 7, the first 0\.02 s in row 4"):
        read(csv(rows=[*rows[:3], rows[2].replace("0.2,0,0", "0.3,0,0"), *rows[3:]]))


def test_what_is_missing_is_reported_where_a_recording_is_used(csv, tmp_path):
    rows = [f"{0.01 * k:.2f},{'' if k in (150, 151) else 0.0},0,0,0,0,9.8" for k in range(300)]
    path = csv(rows=rows)
    for command in (
        ["estimate", str(path), "--out", str(tmp_path / "e")],
        ["integrate", str(path), "--out", str(tmp_path / "i.h5")],
    ):
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
        assert "2 rows without a gyro sample, the first at 1.500 s, were left out" in " ".join(result.output.split())
    assert "2 samples are missing in 1 gaps." in recordings.read_samples(path, "gyro").remarks
    with pytest.raises(InputError, match=r"the interval after 1.49 s is 0.03 s"):
        recordings.write(read(path), tmp_path / "even.hdf5")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("empty.csv", b"", ("is empty", "time,gx")),
        ("binary.csv", bytes(range(256)) * 8, ()),
        ("excel.csv", "time,gx".encode("utf-16"), ("write it in UTF-8, not UTF-16",)),
        ("walk.mat", b"\0" * 100, ("extension '.mat'", ".csv")),
        ("flight.toml", b"rate_hz = 100.0\n", ("is no recording", "`strapdown simulate`")),
        ("walk.h5", b"time,gx", ("cannot be read as HDF5", "of another kind")),
        ("estimate.h5", None, ("is a strapdown estimate, a result, not a recording; give the recording that it was",)),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path, name, content, words):
    if content is None:
        with result_file(tmp_path / name, "estimate", {}):
            pass
    else:
        (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, *words)


# ---------------------------------------------------------------------------------------------------- HDF5


@pytest.fixture
def hdf5(tmp_path):
    """Write a file in the layout of BROAD, some of it changed or (None) left out, and return its path."""

    def write(name: str = "trial.hdf5", **changes):
        random = np.random.default_rng(1)
        content = {
            "imu_gyr": random.standard_normal((50, 3)),
            "imu_acc": random.standard_normal((50, 3)),
            "imu_mag": random.standard_normal((50, 3)),
            "opt_quat": np.tile([1.0, 0.0, 0.0, 0.0], (50, 1)),
            "movement": np.arange(50) > 20,
            "sampling_rate": 250.0,
        } | changes
        path = tmp_path / name
        with h5py.File(path, "w") as file:
            for key, value in content.items():
                if key == "sampling_rate" and value is not None:
                    file.attrs[key] = value
                elif value is not None:
                    file.create_dataset(key, data=value, compression="gzip")
        return path

    return write


def test_samples_go_to_the_nearest_stamp_the_closest_of_several():
    """Sample by sample, within a median interval; some before the first stamp, after the last, and in a gap."""
    random = np.random.default_rng(6)
    time = np.cumsum(random.uniform(0.8, 1.2, 60)) + 40.0 * (np.arange(60) >= 30)
    other = np.sort(random.uniform(-10.0, 110.0, 150))
    wanted = np.full(60, np.nan)
    for j in np.argsort(-np.abs(other[:, None] - time).min(axis=1)):
        distance = np.abs(other[j] - time)
        if distance.min() <= np.median(np.diff(time)):
            wanted[distance.argmin()] = other[j]
    placed, lost = at_nearest(time, other, other[:, None])
    np.testing.assert_array_equal(placed[:, 0], wanted)
    assert lost == 150 - np.isfinite(wanted).sum()
    first_and_last, _ = at_nearest(np.arange(4.0), np.array([-1.0, 2.9]), np.array([[1.0], [2.0]]))
    np.testing.assert_array_equal(first_and_last[:, 0], [1.0, np.nan, np.nan, 2.0])


def test_broad_has_microtesla(tmp_path):
    recording = Recording(
        source="a", time=np.arange(3.0), rate=np.ones((3, 3)), magnetic_field=np.full((3, 3), 0.5), magnetic_unit="G"
    )
    recordings.write(recording, tmp_path / "a.hdf5")
    np.testing.assert_allclose(read(tmp_path / "a.hdf5").magnetic_field, 50.0)
    assert read(tmp_path / "a.hdf5").magnetic_unit == "uT"


def test_broad_layout_is_read(hdf5):
    path = hdf5()
    recording = read(path)
    np.testing.assert_allclose(recording.time, np.arange(50) / 250.0, rtol=1e-15)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(recording.rate, file["imu_gyr"][:])
        np.testing.assert_array_equal(recording.specific_force, file["imu_acc"][:])
        np.testing.assert_array_equal(recording.magnetic_field, file["imu_mag"][:])
    assert recording.movement.dtype == bool
    assert recording.movement.sum() == 29
    assert read(hdf5("short.h5", imu_mag=None, opt_quat=None, movement=None)).magnetic_field is None


@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 0.95])
def test_truncated_hdf5_is_refused(hdf5, share):
    path = hdf5()
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(path, "truncated")


ONE_INFINITE = np.where(np.arange(150).reshape(50, 3) == 23, np.inf, 0.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"imu_gyr": None}, ("lacks imu_gyr", "imu_acc")),
        ({"imu_gyr": None, "sampling_rate": None}, ("lacks imu_gyr, the attribute sampling_rate",)),
        ({"imu_gyr": ONE_INFINITE}, ("rate[7, 2] is inf",)),
        ({"imu_acc": np.zeros((49, 3))}, ("specific_force has shape (49, 3), wanted (50, 3)",)),
        ({"opt_quat": np.zeros((50, 3))}, ("true_attitude has shape",)),
        ({"movement": np.ones(49, bool)}, ("movement has shape (49,)",)),
        *(({"sampling_rate": rate}, ("sampling_rate is",)) for rate in (0.0, -100.0, np.nan)),
    ],
)
def test_bad_values_in_hdf5_are_refused(hdf5, changes, words):
    refused(hdf5(**changes), *words)


def test_broad_may_lack_samples_but_has_its_own_units(hdf5):
    """Its layout says the units; an option without effect would mislead."""
    path = hdf5(imu_gyr=np.where(np.isinf(ONE_INFINITE), np.nan, 0.0))
    np.testing.assert_allclose(read(path).missing_gyro, [7 / 250.0])
    refused(path, "unit", units={"gyro": "deg/s"})


# ---------------------------------------------------------------------------------------------------- the recording


def test_taken():
    recording = Recording(
        source="x",
        time=np.arange(5.0),
        rate=np.arange(15.0).reshape(5, 3),
        specific_force=np.ones((5, 3)),
        temperature=[20, 21, 22, 23, 24],
        movement=np.array([0, 0, 1, 1, 1], bool),
    )
    later = recording.taken(slice(2, None))
    np.testing.assert_array_equal(later.temperature / 2.0, [11.0, 11.5, 12.0])
    np.testing.assert_array_equal(later.time, [2.0, 3.0, 4.0])
    np.testing.assert_array_equal(later.rate, recording.rate[2:])
    assert later.movement.all()
    assert later.magnetic_field is None


def test_a_clock_that_counts_from_the_start_is_left_as_it_is(tmp_path):
    rows = "".join(f"{100_000 + k},0.1,0.2,0.{k + 1}\n" for k in range(9))
    (tmp_path / "walk.csv").write_text("time [ms],gx [rad/s],gy,gz\n" + rows)
    assert recordings.read(tmp_path / "walk.csv").time[0] == 100.0


def test_few_repeated_stamps_are_left_out_whatever_their_samples(tmp_path):
    """Three of 1,000 rows with the stamp of the row before; one of ten is refused."""
    time = np.arange(1000) * 0.01
    time[[200, 500, 800]] = time[[199, 499, 799]]
    values = np.column_stack([time, np.random.default_rng(1).standard_normal((1000, 3))])
    path = tmp_path / "repeated.csv"
    np.savetxt(path, values, delimiter=",", header="time,gx [rad/s],gy,gz", comments="")
    recording = read(path)
    np.testing.assert_allclose(recording.repeated, [1.99, 4.99, 7.99])
    assert len(recording.time) == 997
    np.testing.assert_array_equal(recording.rate, np.delete(values[:, 1:], [200, 500, 800], axis=0))
    np.savetxt(path, values[195:205], delimiter=",", header="time,gx [rad/s],gy,gz", comments="")
    with pytest.raises(InputError, match="rows with the stamp of the row before"):
        read(path)


@pytest.mark.parametrize(("shift", "even"), [(0.2, False), (0.3, True)])
def test_stamps_that_stray_by_more_than_a_quarter_of_the_interval_are_assumed_even(shift, even):
    """A stamp off by a share of 10 ms, and a second later ten samples lost, which are a gap either way."""
    time = 0.01 * np.delete(np.arange(200.0), np.s_[150:160])
    time[40] += 0.01 * shift
    interval, place, words = samples._grid("log", time)
    assert interval == pytest.approx(0.01, rel=1e-3)
    np.testing.assert_array_equal(place, np.delete(np.arange(200), np.s_[150:160]))
    assert [word.split()[0] for word in words] == (["Intervals", "10"] if even else ["10"])
    assert not even or f"deviate by up to {10.0 * shift:.3g} ms" in words[0]


def test_stamps_in_whole_milliseconds_have_the_mean_interval():
    """300 Hz and a lost sample: intervals of 3 and 4 ms. The temperature is interpolated over the loss; a burst is no grid."""
    kept = np.delete(np.arange(900), 600)
    recording = Recording(
        source="log", time=np.rint(1e3 * kept / 300.0) / 1e3, rate=np.ones((899, 3)), temperature=kept * 0.01
    )
    gyro_samples = samples.samples_of(recording)
    assert gyro_samples.sample_interval == pytest.approx(1.0 / 300.0, rel=1e-3)
    assert np.flatnonzero(np.isnan(gyro_samples.values[:, 0])).tolist() == [600]
    np.testing.assert_allclose(gyro_samples.temperature, 0.01 * np.arange(900))
    time = 0.01 * np.arange(100.0)
    time[41:] -= 0.009
    assert samples._grid("log", time)[1].tolist() == list(range(100))


def test_samples_of_a_simulated_record_are_its_increments_and_what_its_sensors_measured(tmp_path):
    random, time = np.random.default_rng(4), 0.01 * np.arange(201)
    force = series_of("accelerometer", "vector", time[4::4], random.standard_normal((50, 3)), [0.0, 0.0, 9.8], 0.1)
    record = ImuRecord(time=time, increments=1e-3 * random.standard_normal((200, 3)), vectors=(force,))
    recordfiles.write_record(tmp_path / "record.h5", record)
    gyro = recordings.read_samples(tmp_path / "record.h5", "gyro")
    np.testing.assert_array_equal(gyro.values, record.increments)
    assert (gyro.kind, gyro.sample_interval) == ("increments", pytest.approx(0.01, rel=1e-12))
    other = recordings.read_samples(tmp_path / "record.h5", "accelerometer")
    np.testing.assert_array_equal(other.values, force.vector_b)
    assert (other.kind, other.sample_interval) == ("rate", pytest.approx(0.04, rel=1e-12))
    direction = series_of("accelerometer", "direction", [0.5], [[0.0, 0.0, 1.0]], [0.0, 0.0, 1.0], 0.1)
    recordfiles.write_record(
        tmp_path / "unit.h5", ImuRecord(time=time, increments=record.increments, vectors=(direction,))
    )
    with pytest.raises(InputError, match='simulate it with kind = "vector"'):
        recordings.read_samples(tmp_path / "unit.h5", "accelerometer")


def test_gaps_are_intervals_of_more_than_five_median_ones():
    assert gaps([0.0, 1.0, 2.0, 3.0, 9.0, 10.0, 15.0]) == [(3.0, 6.0)]
