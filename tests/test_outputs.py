"""An estimate in other forms: angles and σ against SciPy and finite differences, frames against closed forms, files read back."""

import csv
import itertools
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import strapdown as sd
from strapdown import quaternion, recordings
from strapdown.checks import InputError
from strapdown.cli import app
from strapdown.estimation.setup import read_estimate, write_estimate
from strapdown.recordings import Recording
from strapdown.records import Estimate, Origin, outputs

SEQUENCES = ["".join(s) for s in itertools.product("XYZ", repeat=3) if s[0] != s[1] != s[2]]


def attitudes(n: int = 20) -> np.ndarray:
    return quaternion.normalize(np.random.default_rng(5).standard_normal((n, 4)))


def covariances(n: int = 20) -> np.ndarray:
    roots = np.random.default_rng(6).standard_normal((n, 3, 3))
    return roots @ np.swapaxes(roots, 1, 2) * 1e-6


@pytest.mark.parametrize("sequence", [*SEQUENCES, *(s.lower() for s in SEQUENCES)])
def test_euler_angles_are_scipys_and_their_sigma_that_of_differences(sequence):
    q, P = attitudes(), covariances()
    euler = outputs.euler(q, sequence, P)
    rotation = Rotation.from_quat(q[:, [1, 2, 3, 0]])
    np.testing.assert_allclose(euler.angles, rotation.as_euler(sequence), atol=1e-12)
    step = 1e-6
    J = np.empty((len(q), 3, 3))
    for k in range(3):
        turn = Rotation.from_rotvec(step * np.eye(3)[k])
        change = (rotation * turn).as_euler(sequence) - (rotation * turn.inv()).as_euler(sequence)
        J[:, :, k] = (np.mod(change + np.pi, 2 * np.pi) - np.pi) / (2 * step)
    expected = np.sqrt(np.einsum("nij,njk,nik->ni", J, P, J))
    np.testing.assert_allclose(euler.sigma, expected, rtol=1e-5)


def test_gimbal_lock_has_no_sigma():
    up = quaternion.from_rotation(Rotation.from_euler("ZYX", [0.3, np.pi / 2, 0.0]))
    assert np.isinf(outputs.euler(up[None], "ZYX", np.eye(3)[None]).sigma).all()


@pytest.mark.parametrize("bad", ["ZZX", "ZY", "ZyX", "ABC", ""])
def test_what_is_no_sequence_is_refused(bad):
    with pytest.raises(InputError, match="give three axes such as ZYX"):
        outputs.euler([[1.0, 0, 0, 0]], bad)


@pytest.mark.parametrize(("yaw", "degrees"), [(0.0, 90.0), (90.0, 0.0), (180.0, 270.0), (-90.0, 180.0)])
def test_heading_is_from_north_towards_east(yaw, degrees):
    """East-North-Up: at rest the body's x looks East; a turn to the left about up takes it North."""
    q = quaternion.from_rotation(Rotation.from_euler("z", yaw, degrees=True))
    heading = outputs.heading(q[None], np.diag([1.0, 4.0, 9.0])[None])
    assert abs((np.degrees(heading.angles[0]) - degrees + 180.0) % 360.0 - 180.0) < 1e-9
    assert abs(heading.sigma[0] - 3.0) < 1e-12  # level: a turn about up alone moves it
    estimate = sd.records.Estimate.from_arrays(
        [0.0, 1.0], [q, q], np.tile(np.radians(np.diag([1.0, 4.0, 9.0])), (2, 1, 1))
    )
    notes = " ".join(replace(estimate, fixed_frame="East-North-Up, magnetic North").listing().notes)
    sigma = np.degrees(3.0 * np.sqrt(np.radians(1.0)))
    assert f" {degrees % 360.0:.2f}°, σ {sigma:.3g}°; of the z axis from the vertical: 0.00°" in notes.replace(
        "360.00", "0.00"
    )


def test_heading_of_a_tilted_body_has_the_sigma_of_differences():
    q, P = attitudes(), covariances()
    heading = outputs.heading(q, P)
    rotation = Rotation.from_quat(q[:, [1, 2, 3, 0]])
    J = np.empty((len(q), 3))
    for k in range(3):
        both = []
        for step in (1e-6, -1e-6):
            v = (rotation * Rotation.from_rotvec(step * np.eye(3)[k])).apply([1.0, 0.0, 0.0])
            both.append(np.arctan2(v[:, 0], v[:, 1]))
        J[:, k] = (np.mod(both[0] - both[1] + np.pi, 2 * np.pi) - np.pi) / 2e-6
    np.testing.assert_allclose(heading.sigma, np.sqrt(np.einsum("ni,nij,nj->n", J, P, J)), rtol=1e-5)
    up = quaternion.from_rotation(Rotation.from_euler("y", -90.0, degrees=True))
    assert np.isinf(outputs.heading(up[None], np.eye(3)[None]).sigma[0])
    with np.errstate(divide="raise", invalid="raise"):  # no warning where it is exactly up
        half = np.sqrt(0.5)
        assert np.isinf(outputs.heading([[half, 0.0, -half, 0.0]], np.eye(3)[None]).sigma[0])


def test_north_east_down():
    """A body whose axes are East, North and Up: in North-East-Down these are (0, 1, 0), (1, 0, 0) and (0, 0, −1)."""
    R = quaternion.to_matrix(outputs.to_ned([1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(R, [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-15)
    q = attitudes()
    np.testing.assert_allclose(quaternion.angle_between(outputs.to_ned(outputs.to_ned(q)), q), 0.0, atol=1e-14)


@pytest.fixture
def case():
    n = 30
    random = np.random.default_rng(8)
    recording = Recording(
        source="walk",
        time=np.arange(n) * 0.01,
        rate=random.standard_normal((n, 3)),
        specific_force=random.standard_normal((n, 3)),
        epoch_ns=1_700_000_000_000_000_001,
    )
    P = np.zeros((20, 6, 6))
    P[:, :3, :3], P[:, 3:, 3:] = covariances(), 0.25 * covariances()
    P[:, :3, 3:] = P[:, 3:, :3] = 0.1 * covariances()
    estimate = Estimate(
        time=recording.time[10:],
        attitude=attitudes(),
        bias=1e-3 * random.standard_normal((20, 3)),
        variance=np.diagonal(P, axis1=1, axis2=2).copy(),
        covariance=P,
        origin=Origin(epoch_ns=recording.epoch_ns),
    )
    return estimate, recording


def test_the_file_of_an_estimate_keeps_the_clock(case, tmp_path):
    _, recording = case
    n = 300
    rest = {"rate": np.zeros((n, 3)), "specific_force": np.tile([0.0, 0.0, 9.81], (n, 1))}
    made_from = replace(recording, time=np.arange(n) * 0.01, **rest)
    write_estimate(tmp_path / "walk.h5", sd.estimate(made_from))
    assert read_estimate(tmp_path / "walk.h5").table()["time_ns"][3] == 1_700_000_000_030_000_001
    attitudes_of_file = sd.read_attitudes(tmp_path / "walk.h5")
    np.testing.assert_array_equal(attitudes_of_file.stamps_ns, made_from.clock_ns)
    assert attitudes_of_file.motion == "hand"  # whose σ are upper bounds
    before_1970 = sd.integrate(replace(made_from, epoch_ns=-5_000_000_000))
    write_estimate(tmp_path / "walk.h5", before_1970)
    assert read_estimate(tmp_path / "walk.h5").origin.epoch_ns == -5_000_000_000


@pytest.mark.parametrize("ending", ["csv", "tsv", "parquet"])
def test_a_table_of_an_estimate_is_read_back(case, tmp_path, ending):
    pytest.importorskip("pyarrow" if ending == "parquet" else "numpy")
    estimate, recording = case
    path = sd.write(estimate, tmp_path / f"walk.{ending}")
    again = sd.read_attitudes(path)
    np.testing.assert_array_equal(again.stamps_ns, recording.clock_ns[10:])
    np.testing.assert_allclose(again.attitude, estimate.attitude, atol=1e-15)
    np.testing.assert_allclose(again.covariance, estimate.covariance, rtol=1e-12)
    with pytest.raises(InputError, match="has attitudes and no gyro; read it by `sd"):
        sd.read(path)


def test_a_table_says_all_in_its_names(case):
    estimate, _ = case
    table = estimate.table()
    assert table["time_ns"][3] == 1_700_000_000_130_000_001
    np.testing.assert_array_equal(table["qw"], estimate.attitude[:, 0])
    yaw = Rotation.from_quat(estimate.attitude[:, [1, 2, 3, 0]]).as_euler("ZYX", degrees=True)
    np.testing.assert_allclose(np.stack([table[f"{n}_deg"] for n in ("yaw", "pitch", "roll")], axis=1), yaw, atol=1e-10)
    np.testing.assert_allclose(table["bias_z_deg_per_h"], np.degrees(estimate.bias[:, 2]) * 3600.0, rtol=1e-12)
    np.testing.assert_allclose(
        table["bias_x_sigma_deg_per_h"], np.degrees(np.sqrt(estimate.variance[:, 3])) * 3600.0, rtol=1e-12
    )
    for name, place in (("xz_rad2", (0, 2)), ("xby_rad2_per_s", (0, 4)), ("bxby_rad2_per_s2", (3, 4))):
        np.testing.assert_array_equal(table[f"cov_body_{name}"], estimate.covariance[:, *place])
    ned = estimate.table(frame="NED", sequence="ZXZ")
    np.testing.assert_array_equal(ned["qx"], outputs.to_ned(estimate.attitude)[:, 1])
    assert "angle_1_z_deg" in ned
    np.testing.assert_array_equal(ned["heading_deg"], table["heading_deg"])


def test_a_file_alone_says_what_sigma_and_axes_are(case, tmp_path):
    """Filtered or smoothed, upper bounds or not, the axes: without them a table of a recording cannot be judged or used."""
    estimate, _ = case
    for smoothed, motion, words in (
        (False, "", "East-North-Up, magnetic North"),
        (True, "hand", "z up, heading arbitrary (no magnetometer)"),
    ):
        told = replace(estimate, smoothed=smoothed, motion=motion, fixed_frame=words)
        table = told.table()
        *_, smooth_column, bound_column, frame_column = table
        assert (smooth_column, bound_column) == ("smoothed", "sigma_upper_bound")
        assert set(table["smoothed"]) == {smoothed}
        assert set(table["sigma_upper_bound"]) == {bool(motion)}
        names = {"East": "east_north_up_magnetic_north", "z up": "z_up_heading_arbitrary"}
        assert frame_column == f"fixed_frame_{names[words[:4]]}"
        names = {"East": "north_east_down_magnetic_north", "z up": "z_down_heading_arbitrary"}
        assert list(told.table(frame="NED"))[-1] == f"fixed_frame_{names[words[:4]]}"
        recordings.write(told, tmp_path / "told.csv")
        assert bool(sd.read_attitudes(tmp_path / "told.csv").motion) is bool(motion)
        recordings.write(told, tmp_path / "told.tum", frame="NED")
        head = (tmp_path / "told.tum").read_text().splitlines()[0]
        assert ("down" in head.lower(), "smoothed" in head) == (True, smoothed)
        assert len(sd.read_attitudes(tmp_path / "told.tum").attitude) == len(told.time)
    assert list(replace(estimate, fixed_frame="").table())[-1] == "sigma_upper_bound"
    assert list(replace(estimate, fixed_frame="").table(frame="NED"))[-1] == "fixed_frame_north_east_down"


@pytest.mark.parametrize("ending", ["csv", "tsv", "parquet"])
def test_tables_in_files_hold_the_same_numbers(case, tmp_path, ending):
    estimate, _ = case
    path = tmp_path / f"estimate.{ending}"
    if ending == "parquet":
        pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'strapdown[formats]'")
    recordings.write(estimate, path, sequence="XYZ")
    wanted = estimate.table(sequence="XYZ")
    if ending == "parquet":
        import pyarrow.parquet

        columns = {
            name: column.to_numpy()
            for name, column in zip(wanted, pyarrow.parquet.read_table(path).columns, strict=True)
        }
    else:
        with open(path, newline="") as stream:
            rows = list(csv.reader(stream, delimiter="\t" if ending == "tsv" else ","))
        assert rows[0] == list(wanted)
        columns = {name: np.array([float(row[k]) for row in rows[1:]]) for k, name in enumerate(rows[0])}
        assert rows[4][0] == "1700000000130000001"
    for name, values in wanted.items():
        np.testing.assert_array_equal(columns[name], values, err_msg=name)


def test_a_tum_trajectory_and_the_packages_own_file(case, tmp_path):
    estimate, _ = case
    recordings.write(estimate, tmp_path / "x.tum")
    lines = (tmp_path / "x.tum").read_text().splitlines()
    assert lines[0].startswith("#")
    assert lines[4].split()[0] == "1700000000.130000001"
    table = np.loadtxt(tmp_path / "x.tum")
    np.testing.assert_array_equal(table[:, 4:], estimate.attitude[:, [1, 2, 3, 0]])
    recordings.write(replace(estimate, origin=None), tmp_path / "x.tum")  # without an origin there is no epoch
    stamps = [line.split()[0] for line in (tmp_path / "x.tum").read_text().splitlines()[1:]]
    assert stamps == [f"{time:.9f}" for time in estimate.time]
    write_estimate(tmp_path / "x.h5", estimate)
    np.testing.assert_array_equal(read_estimate(tmp_path / "x.h5").covariance, estimate.covariance)


def test_a_data_frame(case):
    pandas = pytest.importorskip("pandas", reason="pandas is not installed: pip install 'strapdown[formats]'")
    estimate, _ = case
    frame = estimate.to_dataframe()
    assert isinstance(frame, pandas.DataFrame)
    assert list(frame) == list(estimate.table())
    assert len(frame) == 20


def test_what_an_ending_has_no_room_for_is_refused(case, tmp_path):
    estimate, _ = case
    with pytest.raises(InputError, match=r"ends in '.xls', but an estimate is written as .bag, "):
        recordings.write(estimate, tmp_path / "x.xls")
    with pytest.raises(InputError, match=r"x.xls must end in one of .h5, "):
        sd.write(estimate, tmp_path / "x.xls")
    with pytest.raises(InputError, match=r"x.tum \(TUM trajectory\) has no option `sequence=` \(known: `frame=`\)"):
        recordings.write(estimate, tmp_path / "x.tum", sequence="ZYX")
    with pytest.raises(InputError, match="needs the samples too; give the recording"):
        recordings.write(estimate, tmp_path / "x.bag")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("module", "ending"), [("pyarrow.parquet", "parquet"), ("rosbags.typesys", "mcap")])
def test_a_file_whose_library_is_missing_is_refused_before_the_computation(
    refusal, tmp_path, monkeypatch, module, ending
):
    monkeypatch.setitem(sys.modules, module, None)
    path, out = tmp_path / "rest.csv", tmp_path / "out"
    rows = "".join(f"{k / 100},0,0,0,0,0,9.8\n" for k in range(300))
    path.write_text(f"time,gx [rad/s],gy,gz,ax [m/s2],ay,az\n{rows}")
    error = refusal("estimate", path, "--out", out, "--to", tmp_path / f"e.{ending}")
    assert f"writing e.{ending} needs {module.partition('.')[0]}" in error
    assert not out.exists()
    error = refusal("estimate", path, "--out", out, "--to", tmp_path / "e.tum", "--euler", "ZYX")
    assert "has no option --euler (known: --frame)" in error


def test_the_command_writes_further_files(tmp_path):
    n = 300
    rows = np.column_stack([np.arange(n) / 100.0, np.zeros((n, 3)), np.zeros((n, 2)), np.full(n, 9.8)])
    path = tmp_path / "rest.csv"
    recordings.write(Recording(source="rest", time=rows[:, 0], rate=rows[:, 1:4], specific_force=rows[:, 4:]), path)
    run = lambda *more: CliRunner().invoke(app, ["estimate", str(path), "--out", str(tmp_path / "out"), *more])  # noqa: E731
    said = run("--to", str(tmp_path / "e.csv"), "--to", str(tmp_path / "f.tsv"), "--euler", "xyz", "--frame", "NED")
    assert said.exit_code == 0, said.output
    assert "e.csv" in said.output
    assert "roll_sigma_deg" in (tmp_path / "e.csv").read_text().splitlines()[0]
    said = run("--to", str(tmp_path / "e.tum"))
    assert said.exit_code == 0, said.output
    assert len((tmp_path / "e.tum").read_text().splitlines()) == len((tmp_path / "e.csv").read_text().splitlines())
    for bad in (
        ("--euler", "ZYX"),
        ("--to", str(path)),
        ("--to", "x.xls"),
        ("--to", str(tmp_path / "e.tum"), "--euler", "ZYX"),
    ):
        assert run(*bad).exit_code == 1
    (tmp_path / "out").rename(tmp_path / "first")
    assert run("--to", str(tmp_path / "no.csv"), "--euler", "ZZZ").exit_code == 1
    assert not (tmp_path / "out").exists()
