"""The command line: what it writes, what it says, and how it refuses."""

import io
import json
import os
import subprocess
import sys
from itertools import takewhile
from pathlib import Path

import h5py
import numpy as np
import pytest
import typer

import strapdown
from strapdown import cli, recordings, scenarios
from strapdown.cli import COMMANDS
from strapdown.cli.terminal import app
from strapdown.estimation.setup import read_estimate
from strapdown.montecarlo import coning_study
from strapdown.montecarlo.coning_study import ALGORITHMS
from strapdown.records import read_attributes


def assert_refused(ended: tuple[int, str, str], *words: str) -> None:
    """Assert that a command ended with status 2 and one line that has these words."""
    status, said, error = ended
    assert (status, said) == (2, "")
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert all(word in error for word in words), error


# ---------------------------------------------------------------------------------------------------- the whole


def test_version(run):
    assert run("--version") == (0, f"strapdown {strapdown.__version__}\n", "")


def test_help_shows_options_in_groups_and_examples_that_parse(run):
    """Each example names options and arguments that its command takes; each heading stands over its options."""
    commands = typer.main.get_command(app).commands
    for examples in COMMANDS.values():
        for name, (module, *lines) in examples.items():
            home = commands[name].callback.__module__
            assert home == f"strapdown.cli.{module}"  # the only one that is imported for it
            for line in lines:
                commands[name].make_context(name, line.split())
    said = " ".join(run("estimate", "--help")[1].replace("│", " ").split())
    order = ("─ Filter ─", "--gate", "─ Layout of the recording ─", "--gyro-unit", "strapdown estimate two-stars.h5")
    places = [said.index(words) for words in order]
    assert places == sorted(places)
    for unit in (*recordings.RATE_UNITS, *recordings.FORCE_UNITS, *recordings.TIME_UNITS):
        assert unit in said


@pytest.mark.parametrize("closed", ["stdout", "stderr"])
def test_a_command_whose_reader_has_left_still_writes_its_numbers(tmp_path, closed):
    """As ``strapdown coning-budget … | head`` does: nothing can be printed, and the file, or what goes to the other stream, is whole."""
    (tmp_path / "lines.csv").write_text("frequency_hz,angle_deg,phase_deg\n20,0.02,90\n")
    ending, beginning = os.pipe()
    os.close(ending)
    numbers = {"stdout": "budget.json", "stderr": "-"}[closed]
    arguments = ["coning-budget", "--psd", "lines.csv", "--rate", "1000", "--json", numbers]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, closed: beginning}
    ended = subprocess.run([sys.executable, "-m", "strapdown", *arguments], cwd=tmp_path, check=False, **streams)
    os.close(beginning)
    assert (ended.returncode, ended.stderr or b"") == (0, b"")
    assert json.loads((tmp_path / numbers).read_text() if closed == "stdout" else ended.stdout)


def test_unknown_commands_and_options_end_with_status_2(refusal, tmp_path):
    for arguments in (
        ("conning",),
        ("coning", "--angel", "1"),
        ("coning", "--format", "gif"),
        ("coning", "--runs", "many"),
        ("estimate",),
    ):
        error = refusal(*arguments)
        assert error.strip()
    assert not list(tmp_path.iterdir())


def test_ctrl_c_ends_with_status_130(run, monkeypatch, tmp_path):
    from strapdown.montecarlo import coning_study

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(coning_study, "run", interrupted)
    status, _, error = run("coning")
    assert status == 130
    assert "Traceback" not in error
    assert not list(tmp_path.iterdir())


def test_a_fault_of_the_program_is_no_verdict(run, monkeypatch):
    """Status 1 of a raw traceback would be "not consistent" of `check`."""

    def broken(*_: object) -> str:
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr("strapdown.read", broken)
    status, said, error = run("check", "estimate.h5")
    assert (status, said) == (70, "")
    assert "ZeroDivisionError: a fault" in error.splitlines()
    assert error.splitlines()[0].startswith("Traceback")
    assert error.splitlines()[-1].startswith(f"error: internal error of strapdown {strapdown.__version__}")


def test_a_fault_of_a_filter_of_ones_own_is_not_the_programs(refusal, tmp_path):
    (tmp_path / "mine.py").write_text("def mine(record, initial):\n    return record.nothing\n")
    error = refusal("montecarlo", "two-stars", "--runs", 2, "--filter", "mine.py:mine")
    assert "    return record.nothing" in error.splitlines()
    assert error.splitlines()[-1].startswith("error: mine, a filter of your own, failed (AttributeError)")


def test_an_output_that_cannot_hold_every_letter_gets_question_marks(run, monkeypatch):
    ascii_only = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", ascii_only)
    assert run("algorithms", "--no-time") == (0, "", "")
    ascii_only.flush()
    assert b"drift under small coning is ?C ?? ? (?h)^n" in ascii_only.buffer.getvalue()


# ---------------------------------------------------------------------------------------------------- coning


SMALL = ("--runs", 3, "--duration", 24, "--seed", 5)
MILLER = Path(__file__).resolve().parents[1] / "docs" / "examples" / "miller-1983.toml"

SCENARIO_KEYS = {"angle_deg", "frequency_hz", "rate_hz", "duration_s", "runs", "seed"}
INTEGRATION_KEYS = {"algorithm", "samples", "drift_deg_per_hour", "predicted_deg_per_hour"}
FILTER_KEYS = {"integration", "runs", "attitude_rms_arcsec", "bias_rms_deg_per_hour", "bias_mean_deg_per_hour"}
FILTER_KEYS |= {"anees", "anees_bounds", "nis", "nis_bounds", "consistent"}


@pytest.fixture(scope="module")
def coning(tmp_path_factory, blank) -> tuple[Path, dict, str]:
    """One small study, with two algorithms of one's own: its folder, its JSON and what was printed."""
    out = tmp_path_factory.mktemp("coning") / "results"
    own = '[algorithm]\nname = "rounded"\ncoefficients = [0.5143, 0.8762, 2.0381]\n'
    out.with_name("own.toml").write_text(own, encoding="utf-8")
    algorithms = ("--algorithm", out.with_name("own.toml"), "--algorithm", MILLER)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("matplotlib.figure.Figure.savefig", blank)
        patch.setattr(sys, "argv", ["strapdown", "coning", *map(str, (*SMALL, *algorithms)), "--out", str(out)])
        with cli.console.capture() as said, pytest.raises(SystemExit) as end:
            cli.main()
    assert not end.value.code
    return out, json.loads((out / "coning.json").read_text()), said.get()


def test_the_readme_shows_the_tables_of_the_study(coning):
    shown = [line.split() for line in Path(__file__).parents[1].joinpath("README.md").read_text("utf-8").splitlines()]
    for table in coning_study.tables(coning[1])[1:]:
        assert table.title.split() in shown
        assert all(line.split() in shown for line in takewhile(lambda line: line[0] != "-", table.lines))


def test_coning_json_has_the_keys_that_others_read(coning):
    """Those at least: more may come, none may go."""
    _, study, _ = coning
    scenario, own = study["scenario"], ["rounded", "miller-3"]
    assert set(scenario) >= SCENARIO_KEYS
    assert (scenario["runs"], scenario["seed"], scenario["duration_s"]) == (3, 5, 24.0)
    assert scenario["angle_deg"] == pytest.approx(0.7, rel=1e-12)
    assert [row["algorithm"] for row in study["integration"]] == [*ALGORITHMS, *own]
    assert [row["integration"] for row in study["filter"]] == [*ALGORITHMS, *own]
    assert [row["name"] for row in study["own"]] == own
    for row in study["integration"]:
        assert set(row) >= INTEGRATION_KEYS
        assert type(row["samples"]) is int
    for row in study["filter"]:
        assert set(row) >= FILTER_KEYS
        assert row["consistent"] is (row["verdict"] == "consistent")
        assert (row["runs"], len(row["bias_mean_deg_per_hour"])) == (3, 3)
        assert min(row[name] for name in ("attitude_rms_arcsec", "bias_rms_deg_per_hour", "anees", "nis")) > 0.0
        assert all(0.0 < row[f"{name}_bounds"][0] < 1.0 < row[f"{name}_bounds"][1] for name in ("anees", "nis"))


def test_coning_studies_algorithms_of_ones_own(coning):
    _, study, said = coning
    assert "0.003571 = 1/280" in " ".join(said.split())
    rows = {row["algorithm"]: row for row in study["integration"]}
    predicted = rows["miller-3"]["predicted_deg_per_hour"]
    assert rows["miller-3"]["drift_deg_per_hour"] == pytest.approx(predicted, rel=0.02)
    assert predicted == pytest.approx(rows["three-sample"]["predicted_deg_per_hour"], rel=0.2)


def test_coning_shows_what_it_is_for(coning):
    """The uncorrected integration drifts as predicted; the filter takes that for a bias of the other sign, and fails for it."""
    _, study, _ = coning
    drift = {row["algorithm"]: row for row in study["integration"]}
    outcome = {row["integration"]: row for row in study["filter"]}
    measured, predicted = (drift["one-sample"][k] for k in ("drift_deg_per_hour", "predicted_deg_per_hour"))
    assert measured == pytest.approx(predicted, rel=0.02)
    # ½ sin²β ω (1 − sin λ/λ) at β = 0.7°, ω = 2π 10 rad/s, λ = 2π/10, by hand
    beta, omega, lam = np.deg2rad(0.7), 20.0 * np.pi, 0.2 * np.pi
    by_hand = -0.5 * np.sin(beta) ** 2 * omega * (1.0 - np.sin(lam) / lam)
    assert predicted == pytest.approx(np.rad2deg(by_hand) * 3600.0, rel=1e-9)
    assert abs(drift["four-sample"]["drift_deg_per_hour"]) < 0.01 * abs(measured)
    assert (outcome["one-sample"]["verdict"], outcome["matched-4-11"]["verdict"]) == (
        "not consistent",
        "cannot tell",
    )  # of 3 runs
    assert outcome["one-sample"]["bias_rms_deg_per_hour"] > 2.0 * outcome["four-sample"]["bias_rms_deg_per_hour"]


def test_coning_writes_figures_and_says_where(coning):
    out, _, said = coning
    assert {path.name for path in out.iterdir()} == {"coning.json", "drift.png", "errors.png", "consistency.png"}
    assert all(words in said for words in (*(path.name for path in out.iterdir()), "not consistent", "cannot tell"))


# ---------------------------------------------------------------------------------------------------- simulate


EXACT = """
rate_hz = 10.0
duration_s = 3.0

[motion]
type = "constant-rate"
rate_deg_per_s = [0.0, 0.0, 1.0]

[gyro]
angle_random_walk_deg_per_sqrt_hour = 0.1

[[sensors]]
type = "direction"
name = "star"
reference_f = [1.0, 0.0, 0.0]
sigma_arcsec = STAR
rate_hz = 1.0

[[sensors]]
type = "attitude"
name = "tracker"
sigma_across_arcsec = 5.0
sigma_about_arcsec = TRACKER
rate_hz = 1.0
"""


@pytest.mark.parametrize(("star", "tracker", "warned"), [(20, 0, ["tracker"]), (0, 5, ["star"]), (20, 5, [])])
def test_simulate_warns_of_sensors_that_no_filter_can_use(succeeds, tmp_path, star, tracker, warned):
    text = EXACT.replace("STAR", f"{star}.0").replace("TRACKER", f"{tracker}.0")
    (tmp_path / "exact.toml").write_text(text, encoding="utf-8")
    said = succeeds("simulate", "exact.toml")
    assert [line.split(":")[1].strip() for line in said.splitlines() if line.startswith("warning")] == warned
    if warned:
        assert "its sigma is zero, which a filter cannot use" in said


# ---------------------------------------------------------------------------------------------------- estimate


def walk(n: int = 800, rate: float = 100.0) -> np.ndarray:
    """Columns time, gx … mz of a unit at rest for two seconds, then yawing at 20 °/s about the vertical."""
    time = np.arange(n) / rate
    yaw = np.deg2rad(20.0) * np.maximum(time - 2.0, 0.0)
    speed = np.where(time >= 2.0, np.deg2rad(20.0), 0.0)
    zero = np.zeros(n)
    # The body frame yawed by ψ from East-North-Up sees North at (sin ψ, cos ψ).
    return np.stack(
        [time, zero, zero, speed, zero, zero, zero + 9.81, 20.0 * np.sin(yaw), 20.0 * np.cos(yaw), zero - 40.0], -1
    )


def write_csv(path: Path, columns: np.ndarray, header: str) -> Path:
    np.savetxt(path, columns, delimiter=",", header=header, comments="", fmt="%.9g")
    return path


UNITS = "time,gx [rad/s],gy,gz,ax [m/s2],ay,az,mx,my,mz"
BARE = "time,gx,gy,gz,ax,ay,az,mx,my,mz"


def yaw_of(attitude: np.ndarray) -> np.ndarray:
    w, x, y, z = np.moveaxis(attitude, -1, 0)
    return np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def test_estimate_on_csv(succeeds, tmp_path):
    columns = walk()
    walked = write_csv(tmp_path / "walk.csv", columns, UNITS)
    said = succeeds("estimate", walked, "--out", tmp_path / "out", "--figures")
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {"estimate.h5", "calibration.toml", "estimate.png", "states.json", "states.png"}
    assert "walk.csv" in said
    estimate = read_estimate(tmp_path / "out" / "estimate.h5")
    np.testing.assert_allclose(estimate.time, columns[:, 0], atol=1e-9)
    wanted = np.deg2rad(20.0) * np.maximum(columns[:, 0] - 2.0, 0.0)
    np.testing.assert_allclose(yaw_of(estimate.attitude), wanted, atol=np.deg2rad(0.3))
    assert estimate.covariance is None
    attributes = read_attributes(tmp_path / "out" / "estimate.h5")
    assert attributes["source"] == "walk.csv"
    assert "scalar first" in attributes["conventions"]
    assert "East-North-Up" in attributes["fixed_frame"]
    assert attributes["parameter.field_disturbance"] > 0.0


def test_estimate_takes_units_by_option(succeeds, tmp_path):
    columns = walk() * np.array([1e3, *[180.0 / np.pi] * 3, *[1.0 / 9.80665] * 3, 1.0, 1.0, 1.0])
    path = write_csv(tmp_path / "walk.csv", columns, BARE)
    options = ("--gyro-unit", "deg/s", "--accelerometer-unit", "g", "--time-unit", "ms", "--full-covariance")
    succeeds("estimate", path, "--out", tmp_path / "out", *options)
    estimate = read_estimate(tmp_path / "out" / "estimate.h5")
    assert estimate.time[-1] == pytest.approx(7.99)
    assert yaw_of(estimate.attitude)[-1] == pytest.approx(np.deg2rad(20.0 * 5.99), abs=np.deg2rad(0.3))
    assert estimate.covariance.shape == (800, 6, 6)


def test_estimate_reports_missing_samples_and_errors_over_all_without_a_mask(run, tmp_path):
    columns = np.column_stack([walk()[:, :7], np.tile([1.0, 0.0, 0.0, 0.0], (800, 1))])
    columns[500:507, 4:7] = np.nan
    header = UNITS.removesuffix(",mx,my,mz") + ",reference_qw,reference_qx,reference_qy,reference_qz"
    _, said, _ = run("estimate", write_csv(tmp_path / "walk.csv", columns, header), "--out", tmp_path / "out")
    assert "7 of the gyro's samples have no sample of the accelerometer at the same time" in said
    assert "Attitude error over" in said


def test_many_gaps_are_said_in_one_line(run, tmp_path):
    columns = np.delete(walk(), [*range(200, 220), *range(300, 310), *range(500, 510)], axis=0)
    path = write_csv(tmp_path / "walk.csv", columns, UNITS)
    for command, what in (
        ("estimate", "Intervals between stamps longer than 1.5 median ones"),
        ("integrate", "Gaps between stamps"),
    ):
        _, said, _ = run(command, path, "--out", tmp_path / ("out" if command == "estimate" else "out.h5"))
        assert f"{what}: 3, the longest 0.21 s after 1.990 s" in said
        assert said.count("between stamps") == 1


def test_estimate_on_broad(succeeds, broad, tmp_path):
    path = broad / "11_undisturbed_slow_translation_B.hdf5"
    said = succeeds("estimate", path, "--out", tmp_path / "out", "--figures")
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "estimate.h5",
        "calibration.toml",
        "estimate.png",
        "errors.json",
        "errors.png",
        "states.json",
        "states.png",
    }
    errors = json.loads((tmp_path / "out" / "errors.json").read_text())
    assert errors["source"] == path.name
    rms = {kind: error["rms_deg"] for kind, error in errors["given"]["movement"].items()}
    assert 0.3 < rms["total"] < 6.0
    assert max(rms["heading"], rms["inclination"]) <= rms["total"]
    assert f"{rms['total']:.4g}" in said
    assert "of movement" in said


@pytest.mark.parametrize(
    ("rows", "header", "options", "words"),
    [
        (300, BARE, (), "declare it in the header, as in gx [rad/s], or by --gyro-unit"),
        (300, BARE, ("--gyro-unit", "deg/sec", "--accelerometer-unit", "g"), "did you mean 'deg/s'?"),
        (50, UNITS, (), "lasts 0.49 s; the start needs at least 1 s"),
        (300, f"{UNITS},temperature", (), "data row 1 has 10 fields, the header 11"),
    ],
    ids=["undeclared", "unknown unit", "short", "truncated"],
)
def test_bad_recordings_end_with_one_clear_line_and_nothing_written(run, tmp_path, rows, header, options, words):
    """What the readers refuse is in their own tests; here the hints are options."""
    path = write_csv(tmp_path / "bad.csv", walk(rows), header)
    assert_refused(run("estimate", path, *options, "--out", tmp_path / "out"), words)
    assert not (tmp_path / "out").exists()


def test_a_name_in_brackets_is_said_as_it_is(succeeds, refusal, tmp_path):
    """Square brackets are mark-up to rich; in a file's name they are letters."""
    good = write_csv(tmp_path / "walk [red] [x].csv", walk(300), UNITS)
    said = succeeds("estimate", good, "--out", tmp_path / "out")
    assert "walk [red] [x].csv: " in said
    assert "none [/b].csv does not exist" in refusal("estimate", "none [/b].csv")


def test_nothing_is_written_where_there_is_nothing_to_judge(refusal, tmp_path):
    """Truth without a sample of movement is bad input like any other: said first, with nothing left behind."""
    columns = walk()
    with h5py.File(tmp_path / "still.hdf5", "w") as file:
        file.attrs["sampling_rate"] = 100.0
        file["imu_gyr"], file["imu_acc"], file["imu_mag"] = columns[:, 1:4], columns[:, 4:7], columns[:, 7:]
        file["opt_quat"] = np.tile([1.0, 0.0, 0.0, 0.0], (len(columns), 1))
        file["movement"] = np.zeros(len(columns), bool)
    error = refusal("estimate", tmp_path / "still.hdf5", "--out", tmp_path / "out")
    assert "no sample to judge" in error
    assert not (tmp_path / "out").exists()


def test_the_file_of_a_built_in_scenario_is_printed(succeeds, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    for name in ("cubesat", "hand-held"):
        (tmp_path / "mine.toml").write_text(succeeds("scenarios", name), encoding="utf-8")
        assert scenarios.load_scenario(tmp_path / "mine.toml") == scenarios.load_scenario(name)


def test_a_statement_is_one_line_wherever_it_goes(succeeds, monkeypatch):
    """What a narrow terminal would break is whole in a file, so that a command printed in it can be copied and searched for."""
    monkeypatch.setenv("COLUMNS", "40")
    said = succeeds("scenarios")
    for name in scenarios.SCENARIOS:
        assert f"{name}: {scenarios.load_scenario(name).description}" in said.splitlines()
