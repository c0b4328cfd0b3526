"""Recordings of other conventions: warned of before the remedy, right after it. Truth is SciPy's rotation of a closed form."""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from strapdown import recordings
from strapdown.ahrs import check_conventions
from strapdown.checks import InputError
from strapdown.recordings import Recording

GRAVITY = 9.80665
FIELD = {"north": np.array([0.0, 18e-6, -45e-6]), "south": np.array([0.0, 25e-6, 50e-6])}
"""East, North, up, T, of middle latitudes on either side."""
FRD = np.diag([1.0, -1.0, -1.0])
"""Forward-left-up components to forward-right-down ones, and back."""
YAW = 40.0
"""Mean heading of the body's x axis from East towards North, degrees."""


def attitude(time: np.ndarray) -> Rotation:
    """Forward-left-up body to East-North-Up: at rest for 3 s, then yaw, pitch and roll swing."""
    swing = np.where(time > 3.0, np.sin(0.9 * (time - 3.0)), 0.0)
    return Rotation.from_euler("ZYX", np.stack([YAW + 50.0 * swing, 12.0 * swing, -20.0 * swing], axis=1), degrees=True)


def walk(hemisphere: str = "north", duration: float = 40.0, field: bool = True) -> Recording:
    """What a strapped-down unit of the package's own conventions measures of it, without noise."""
    time = np.arange(round(duration * 50.0)) / 50.0
    body = attitude(time)
    step = 1e-4
    rate = (attitude(time - step).inv() * attitude(time + step)).as_rotvec() / (2.0 * step)
    return Recording(
        source="walk",
        time=time,
        rate=rate,
        specific_force=body.inv().apply([0.0, 0.0, GRAVITY]),
        magnetic_field=body.inv().apply(FIELD[hemisphere]) if field else None,
    )


def with_samples(recording: Recording, **factors: np.ndarray) -> Recording:
    """The recording with columns turned by matrices, as another device would have written it."""
    changed = {name: getattr(recording, name) @ matrix.T for name, matrix in factors.items()}
    return Recording(**{**vars(recording), **changed})


def iphone(hemisphere: str = "north") -> Recording:
    """Its accelerometer reads -g upward at rest."""
    return with_samples(walk(hemisphere), specific_force=-np.eye(3))


def forward_right_down() -> Recording:
    return with_samples(walk(), rate=FRD, specific_force=FRD, magnetic_field=FRD)


def file_of(recording: Recording, path) -> str:
    recordings.write(recording, path)
    return str(path)


def angles(path) -> np.ndarray:
    """Columns of an estimate's table (n, 4): yaw, pitch, roll, heading, degrees."""
    with open(path, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return np.array([[float(row[f"{name}_deg"]) for name in ("yaw", "pitch", "roll", "heading")] for row in rows])


def off(actual: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference of angles after the first 5 s, degrees."""
    actual, expected = actual[250:], expected[-len(actual) :][250:]
    return float(np.abs((actual - expected + 180.0) % 360.0 - 180.0).max())


def true_angles(time: np.ndarray) -> np.ndarray:
    body = attitude(time)
    x = body.apply([1.0, 0.0, 0.0])
    return np.column_stack([body.as_euler("ZYX", degrees=True), np.degrees(np.arctan2(x[:, 0], x[:, 1]))])


def true_angles_ned(time: np.ndarray) -> np.ndarray:
    """Of forward-right-down axes to North-East-Down, by rotation matrices."""
    ned_of_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    body = Rotation.from_matrix(ned_of_enu @ attitude(time).as_matrix() @ FRD)
    return np.column_stack([body.as_euler("ZYX", degrees=True), true_angles(time)[:, 3]])


@pytest.mark.parametrize("hemisphere", ["north", "south"])
def test_the_remedy_of_a_phone_with_an_inverted_accelerometer(succeeds, tmp_path, hemisphere):
    source = file_of(iphone(hemisphere), tmp_path / "phone.csv")
    table = tmp_path / "out.csv"
    text = succeeds("estimate", source, "--out", tmp_path / "a", "--to", table)
    first = text.splitlines()[0]
    assert first.startswith("warning: phone.csv: at rest the accelerometer reads -9.81 m/s² along z")
    assert "--invert accelerometer" in first
    truth = true_angles(walk().time)
    assert off(angles(table), truth) > 90.0
    text = succeeds("estimate", source, "--invert", "accelerometer", "--out", tmp_path / "b", "--to", table)
    assert "Sign of the accelerometer inverted." in text
    assert ("warning" in text) == (hemisphere == "south")  # the field points up there, which is said
    assert off(angles(table), truth) < 1.0


def test_the_remedies_of_a_body_whose_z_axis_points_down(succeeds, tmp_path):
    source = file_of(forward_right_down(), tmp_path / "plane.csv")
    table = tmp_path / "out.csv"
    text = succeeds("estimate", source, "--out", tmp_path / "a", "--to", table)
    first = text.splitlines()[0]
    assert "the body's z axis points down" in first
    assert "--axes x,-y,-z" in first
    assert "--frame ned" in first
    assert (
        "south of the magnetic equator the accelerometer is inverted" in first
    )  # the field points down, as in the North
    time = walk().time
    assert off(angles(table), true_angles(time)) > 90.0
    text = succeeds("estimate", source, "--axes", "x,-y,-z", "--out", tmp_path / "b", "--to", table)
    assert "warning" not in text
    assert off(angles(table), true_angles(time)) < 1.0
    text = succeeds("estimate", source, "--out", tmp_path / "c", "--to", table, "--frame", "ned")
    assert off(angles(table), true_angles_ned(time)) < 1.0


def test_the_doctor_says_it_at_the_top(run, succeeds, tmp_path):
    status, text, _ = run("doctor", file_of(iphone(), tmp_path / "phone.csv"))
    assert status == 3
    assert "cannot tell" in text.splitlines()[0]
    assert text.splitlines()[1].startswith("warning: at rest the accelerometer reads -9.81 m/s² along z")
    text = succeeds("doctor", file_of(walk(), tmp_path / "walk.csv"))
    assert "warning" not in text


def test_without_a_field_both_explanations_are_named():
    down = with_samples(walk(field=False), specific_force=-np.eye(3))
    (words,) = check_conventions.at_rest(down)
    assert "`invert='accelerometer'`" in words
    assert "`axes='x,-y,-z'`" in words


def test_an_inverted_magnetometer_shows_in_its_dip():
    (words,) = check_conventions.at_rest(with_samples(walk(), magnetic_field=-np.eye(3)))
    assert "`invert='magnetometer'`" in words


@pytest.mark.parametrize("mounting", [(0.0, 0.0, 0.0), (30.0, 40.0, -30.0), (0.0, 0.0, 90.0), (10.0, -80.0, 0.0)])
def test_a_right_recording_is_not_warned_of(mounting):
    turn = Rotation.from_euler("ZYX", mounting, degrees=True).as_matrix()
    assert check_conventions.at_rest(with_samples(walk(), rate=turn, specific_force=turn, magnetic_field=turn)) == []


def test_a_unit_that_does_not_rest_says_nothing():
    shaken = iphone()
    force = np.asarray(shaken.specific_force) + 3.0 * np.random.default_rng(0).standard_normal((len(shaken.time), 3))
    assert check_conventions.at_rest(Recording(**{**vars(shaken), "specific_force": force})) == []


def test_axes_of_one_sensor_and_of_the_whole_unit():
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    right = walk()
    recording = recordings.with_axes(with_samples(right, magnetic_field=turn.T), {"magnetometer": "y,-x,z"})
    np.testing.assert_array_equal(recording.magnetic_field, right.magnetic_field)
    np.testing.assert_array_equal(recording.rate, right.rate)
    reference = np.roll(attitude(right.time).as_quat(), 1, axis=1)
    recording = recordings.with_axes(Recording(**{**vars(right), "true_attitude": reference}), "y,-x,z")
    np.testing.assert_allclose(recording.rate, right.rate @ turn.T)
    expected = attitude(right.time).as_matrix() @ turn.T
    np.testing.assert_allclose(
        Rotation.from_quat(np.roll(recording.true_attitude, -1, axis=1)).as_matrix(), expected, atol=1e-12
    )
    assert recording.remarks == ("Body axes read as (y,-x,z).",)


@pytest.mark.parametrize("bad", ["x,y", "x,x,z", "a,b,c", "", "x,y,z,z", "--x,y,z"])
def test_what_are_no_axes_is_refused(bad):
    with pytest.raises(InputError, match="give each of x, y and z once"):
        recordings.axes_matrix(bad)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--axes", "x,y"), "--axes is 'x,y'; give each of x, y and z once"),
        (("--axes", "x,-y,-z", "--axes", "gyro=y,x,z"), "applies to the whole unit; give only it"),
        (("--axes", "gyros=x,y,z"), "did you mean 'gyro'"),
        (("--invert", "gyros"), "did you mean 'gyro'"),
        (("--frame", "nwu", "--to", "x.csv"), "--frame 'NWU' is not known"),
    ],
)
def test_bad_options_are_refused(refusal, tmp_path, options, words):
    source = file_of(walk(duration=5.0), tmp_path / "walk.csv")
    text = refusal("estimate", source, "--out", tmp_path / "a", *options)
    assert words in text
    assert not (tmp_path / "a").exists()


def test_a_sensor_that_is_not_there_and_a_mirrored_reference_are_refused():
    with pytest.raises(InputError, match="has no magnetometer"):
        recordings.with_axes(walk(field=False), invert="magnetometer")
    mirrored = Recording(**{**vars(walk()), "true_attitude": np.tile([1.0, 0.0, 0.0, 0.0], (2000, 1))})
    with pytest.raises(InputError, match="axes mirror the unit"):
        recordings.with_axes(mirrored, "y,x,z")
