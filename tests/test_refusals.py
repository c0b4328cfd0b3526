"""What commands and readers refuse before anything is computed or replaced: damaged results, inputs for outputs, numbers too large."""

import dataclasses
import json
import os
import shutil

import numpy as np
import pytest
from hdf5 import changed
from typer.testing import CliRunner

from strapdown import cli, records, scenarios
from strapdown.checks import InputError, count
from strapdown.estimation import setup
from strapdown.estimation.setup.states import States
from strapdown.files import reading
from strapdown.recordings import recordfiles


@pytest.fixture(scope="module")
def short():
    return dataclasses.replace(scenarios.load_scenario("two-stars"), duration=20.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, short):
    """A record, the estimate made from it, and a campaign."""
    where = tmp_path_factory.mktemp("results")
    (where / "short.toml").write_text(scenarios.scenario_to_toml(short), encoding="utf-8")
    (where / "filter.toml").write_text(setup.to_toml(setup.FilterSetup.for_scenario(short)), encoding="utf-8")
    for command in (
        ["simulate", str(where / "short.toml"), "--out", str(where / "record.h5")],
        ["estimate", str(where / "record.h5"), "--out", str(where / "run")],
        ["montecarlo", str(where / "short.toml"), "--runs", "8", "--out", str(where / "runs.h5")],
    ):
        result = CliRunner().invoke(cli.app, command)
        assert result.exit_code == (3 if command[0] == "montecarlo" else 0), result.output  # 8 runs cannot tell
    return where


def refused(command):
    """Return what a command says in refusing."""
    result = CliRunner().invoke(cli.app, [str(part) for part in command])
    assert isinstance(result.exception, InputError), result.output
    return str(result.exception)


def test_an_estimate_does_not_replace_its_record(folder, tmp_path):
    shutil.copy(folder / "record.h5", tmp_path / "estimate.h5")
    before = (tmp_path / "estimate.h5").read_bytes()
    assert "the same file that is read" in refused(["estimate", tmp_path / "estimate.h5", "--out", tmp_path])
    assert (tmp_path / "estimate.h5").read_bytes() == before


BUDGET = ["coning-budget", "--rate", 1000, "--psd"]
CAMPAIGN = ["montecarlo", "short.toml", "--runs"]
CONSIDER = ["covariance", "short.toml", "--consider"]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ([*BUDGET, "lines.csv", "--json", "lines.csv"], "choose such a suffix"),
        ([*BUDGET, "lines.json", "--json", "lines.json"], "the same file"),
        ([*BUDGET, "record.h5"], "cannot be read as text"),
        ([*BUDGET, "run"], "is a folder"),
        ([*BUDGET, "quarter.csv"], "an amplitude of 90°"),
        ([*CAMPAIGN, 8, "--out", "runs.h5", "--resume", "--overwrite"], "exclude each other"),
        ([*CAMPAIGN, 0, "--out", "new.h5"], "runs is 0"),
        ([*CAMPAIGN, 4, "--out", "x.csv"], "choose such a suffix"),
        ([*CAMPAIGN, 4, "--filter", "short.toml"], "no table [filter]"),
        ([*CAMPAIGN, 4, "--replay", -1], "run is -1"),
        ([*CAMPAIGN, 4, "--machine", "gpu"], "machine 'gpu'"),
        (["montecarlo", "sort"], "scenario 'sort' is not known"),
        (["montecarlo", "none.toml"], "none.toml does not exist"),
        (["montecarlo", "none.h5"], "none.h5 does not exist"),
        (["check", "run/estimate.h5", "--confidence-level", 1], "confidence_level is 1"),
        (["tune", "record.h5", "--seed", -1, "--out", "new.toml"], "seed is -1"),
        (["tune", "record.h5", "--spacing", -1.0, "--out", "new.toml"], "spacing"),
        (["tune", "record.h5", "record.h5", "--out", "new.toml"], "given twice"),
        (["tune", "record.h5", "--prior", "filter.toml", "--out", "filter.toml"], "the same file that is read"),
        (["covariance", "short.toml", "--filter", "lines.json", "--tables", "lines.json"], "lines.json is a file"),
        (["estimate", "record.h5", "--every", 5000, "--out", "new"], "every is 5000, more than the 2000 filter steps"),
        (
            ["integrate", "record.h5", "--gyro-unit", "rad/s", "--out", "new.h5"],
            "declares its own layout; leave `units=",
        ),
        (["coning", "--frequency", "1e300"], "too few for any algorithm"),
        (["coning", "--rate", "1e-5"], "too few for any algorithm"),
        (["coning", "--rate", "0.9"], "too few for any algorithm"),
        (["coning", "--runs", 0], "runs is 0; it must be a whole number of 1 or more"),
        (["coning", "--seed", -1], "seed is -1; it must be a whole number of 0 or more"),
        (["coning", "--angle", 0], "angle is 0 degrees; it must be greater than zero"),
        (["coning", "--angle", 200], "angle is 200 degrees; the half-angle of a cone must be below"),
        (["coning", "--angle", "nan"], "angle is nan; it must be a finite number"),
        (["coning", "--frequency", -1], "frequency is -1"),
        (["coning", "--rate", "inf"], "rate is inf"),
        (["coning", "--duration", -5], "duration is -5"),
        (["algorithms", "--tables", "lines.json"], "--tables cannot be written"),
        (["coning", "--tables", "lines.json"], "--tables cannot be written"),
        ([*CAMPAIGN, 8, "--tables", "lines.json"], "--tables cannot be written"),
        (["covariance", "nowhere"], "nowhere"),
        ([*CONSIDER, "star 1.delay"], "NAME=VALUE"),
        ([*CONSIDER, "sta 1.mounting=3"], "did you mean 'star 1.mounting'"),
        ([*CONSIDER, "star 1.bias=x"], "--consider star 1.bias is 'x'; give a number"),
        ([*CONSIDER, "scale_factor=-1"], "--consider scale_factor is -1; it must not be negative"),
        ([*CONSIDER, "initial.bias=-2"], "--consider initial.bias is -2"),
        ([*CONSIDER, "initial.attitude=200"], "initial_attitude_sigma is 3.49066 rad"),
        ([*CONSIDER, "scale_factor=1e300"], "scale_factor is 1e+294; no error is larger"),
        ([*CONSIDER, "g_sensitivity=1e300"], "g_sensitivity is"),
        ([*CONSIDER, "initial.bias=1e300"], "initial_bias_sigma is"),
        ([*CONSIDER, "initial.attitude=1e200"], "initial_attitude_sigma is"),
        ([*CONSIDER, "star 1.bias=1e300"], "sensor_bias['star 1'] is"),
        ([*CONSIDER, "star 1.bias=inf"], "star 1.bias is inf"),
        ([*CONSIDER, "star 1.mounting=1", "--consider", "star 1.mounting=2"], "star 1.mounting is given twice"),
        ([*CONSIDER, "star 1.delay=1e9"], "time_offset of star 1 is 1e+06 s, and the scenario lasts 20 s"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_a_command_refuses_before_it_writes(there, command, words):
    for name, angle in (("lines.json", 0.1), ("quarter.csv", 90)):
        (there / name).write_text(f"frequency_hz,angle_deg\n10,{angle}\n", encoding="utf-8")
    before = sorted(there.rglob("*"))
    assert words in refused_at_once(command)
    assert sorted(there.rglob("*")) == before


@pytest.mark.parametrize("name", ["../evil", "a/b", ".hidden", "two\nlines"])
def test_a_scenario_is_not_named_like_a_path(short, name):
    with pytest.raises(InputError, match="which is used in file names"):
        dataclasses.replace(short, name=name)


def test_a_campaign_does_not_replace_a_json_of_another_maker(folder, tmp_path):
    (tmp_path / "mine.json").write_text("{}")
    command = ["montecarlo", folder / "short.toml", "--runs", 8, "--out", tmp_path / "mine.h5"]
    assert "mine.json exists" in refused(command)
    assert (tmp_path / "mine.json").read_text() == "{}"


@pytest.mark.parametrize("value", [10**30, -(10**30), float("inf"), float("nan"), 2.0**63])
def test_counts_too_large_are_refused_by_name(value):
    below = " and below 2\\^63" if isinstance(value, int) else ""
    with pytest.raises(InputError, match=f"seed is .*; it must be a whole number of 1 or more,?{below}$"):
        count("seed", value)


def test_a_tuning_does_not_replace_what_no_tuning_wrote(folder, tmp_path):
    """The filter that is written where no name is given may be one by hand."""
    (tmp_path / "filter.toml").write_text("# by hand\n[filter]\n")
    command = ["tune", folder / "record.h5", "--out", tmp_path / "filter.toml"]
    assert "filter.toml exists and was not written by `strapdown tune`" in refused(command)
    (tmp_path / "filter.json").write_text('{"mine": 1}')
    assert "filter.toml exists and was not written by `strapdown tune`" in refused(command)
    (tmp_path / "filter.toml").unlink()
    assert "filter.json exists and was not written by `strapdown tune`" in refused(command)
    assert (tmp_path / "filter.json").read_text() == '{"mine": 1}'


@pytest.mark.parametrize("command", [["simulate", "short.toml"], ["integrate", "record.h5"]])
def test_a_command_does_not_replace_what_others_wrote(there, tmp_path, command):
    (tmp_path / "data.h5").write_bytes(b"\x89HDF of others")
    said = refused_at_once([*command, "--out", tmp_path / "data.h5"])
    assert f"data.h5 exists and was not written by `strapdown {command[0]}`; move it, or choose another --out" in said
    assert (tmp_path / "data.h5").read_bytes() == b"\x89HDF of others"


@pytest.mark.parametrize(
    ("file", "name", "change", "complaint"),
    [
        ("run/estimate.h5", "bias", lambda value: value[:-1], "bias"),
        ("run/estimate.h5", "time", lambda value: value[::-1], "time"),
        ("run/estimate.h5", "variance", lambda value: np.full_like(value, np.nan), "variance"),
        ("runs.h5", "statistics/nees_sum", lambda value: value[:-1], "damaged"),
        ("runs.h5", "statistics/nees_sum", lambda value: np.full_like(value, np.nan), "damaged"),
    ],
)
@pytest.mark.parametrize("command", ["check", "report"])
def test_damaged_results_are_no_verdict(folder, tmp_path, file, name, change, complaint, command):
    path = tmp_path / "bad.h5"
    shutil.copy(folder / file, path)
    with changed(path) as held:
        value = change(held[name][:])
        del held[name]
        held[name] = value
    assert complaint in refused([command, path])


def test_causes_are_sought_in_the_record_that_was_estimated(folder, short, tmp_path):
    held = recordfiles.read_record(folder / "record.h5")
    others = {
        "made from another record": scenarios.simulate(
            scenarios.load_scenario("magnetometer-only"), seed=held.origin.seed
        ),
        "the record is of seed 8": scenarios.simulate(short, seed=8),
    }
    for complaint, other in others.items():
        recordfiles.write_record(tmp_path / "other.h5", other)
        assert complaint in refused(["check", folder / "run" / "estimate.h5", "--record", tmp_path / "other.h5"])


@pytest.mark.parametrize("known", [True, False])
def test_no_cause_is_named_of_a_filter_that_the_search_does_not_know(folder, short, tmp_path, known):
    """Of one with optional states the plain filter would be diagnosed, and every cause it names be false."""
    spec = dataclasses.replace(short.gyro, scale_factor=np.full(3, 1e-3), asymmetry=np.full(3, 2e-3))
    held = recordfiles.read_record(folder / "record.h5")
    origin = records.Origin(gyro=spec, scenario=dataclasses.replace(short, gyro=spec))
    recordfiles.write_record(tmp_path / "record.h5", dataclasses.replace(held, origin=origin))
    shutil.copy(folder / "run" / "estimate.h5", tmp_path / "estimate.h5")
    if not known:
        with changed(tmp_path / "estimate.h5") as file:
            filter_setup = setup.from_toml(reading.attributes(file)["filter"])
            states = States(gyro_scale_sigma=1e-3)
            file.attrs["filter"] = setup.to_toml(dataclasses.replace(filter_setup, states=states))
    options = ["--record", str(tmp_path / "record.h5"), "--json", str(tmp_path / "check.json")]
    result = CliRunner().invoke(cli.app, ["check", str(tmp_path / "estimate.h5"), *options])
    assert ("Causes by their effect on the likelihood" in result.output) == known
    content = json.loads((tmp_path / "check.json").read_text())
    asymmetry = "the gyro's asymmetry of 2000 ppm"
    if known:
        missing = ["the gyro's scale factor of 1000 ppm", asymmetry]
        assert f"the filter does not model {', '.join(missing)}" in " ".join(result.output.split())
        assert content["unmodelled"] == missing
    else:
        reason = "the search supports filters of attitude and bias only, and this one has the states gyro.scale"
        assert f"Causes were not searched for: {reason}." in result.output
        assert content["diagnosis"] == {"not_looked_for": reason}
        assert content["unmodelled"] == [asymmetry]


@pytest.mark.parametrize("command", ["check", "report", "estimate", "integrate", "doctor", "tune", "allan"])
def test_a_folder_for_a_file_is_reported_in_one_line(tmp_path, command):
    (tmp_path / "d.h5").mkdir()
    said = refused([command, tmp_path / "d.h5", *(["--algorithm", "one-sample"] if command == "integrate" else [])])
    assert said.startswith(f"{tmp_path / 'd.h5'} is a folder; name ")


# ------------------------------------------------------------------------------------------------ what cannot be written

FOLDERS = {
    "coning": (
        ["coning", "--runs", 2, "--duration", 12],
        ("coning.json", "drift.png", "errors.png", "consistency.png"),
    ),
    "allan": (["allan", "gyro.npy", "--rate", 100, "--gyro-unit", "rad/s"], ("gyro.toml", "allan.json", "allan.png")),
    "covariance": (["covariance", "short.toml", "--epochs", 2], ("covariance.json", "budget.png")),
    "estimate": (
        ["estimate", "record.h5", "--from-truth"],
        ("estimate.h5", "errors.json", "states.json", "calibration.toml", "estimate.png", "errors.png", "states.png"),
    ),
    "export": (["export", "filter.toml", "short.toml"], ("strapdown_filter.h", "strapdown_filter.c")),
}
"""Commands that write to a folder, and the files that they write there."""
FILES = {
    "simulate": (["simulate", "short.toml", "--out"], "x.h5", ()),
    "integrate": (["integrate", "record.h5", "--out"], "x.h5", ()),
    "coning-budget": (["coning-budget", "--psd", "lines.csv", "--rate", 100, "--json"], "x.json", ()),
    "check": (["check", "run/estimate.h5", "--json"], "x.json", ()),
    "doctor": (["doctor", "unit.csv", "--json"], "x.json", ()),
    "montecarlo": (["montecarlo", "short.toml", "--runs", 8, "--overwrite", "--out"], "x.h5", ("x.json",)),
    "calibrate": (["calibrate", "unit.csv", "--out"], "x.toml", ()),
    "montecarlo replay": (
        ["montecarlo", "short.toml", "--replay", 3, "--out"],
        "x.h5",
        ("x-run-3-record.h5", "x-run-3-estimate.h5"),
    ),
    "report": (["report", "run/estimate.h5", "--out"], "x.html", ("x.report.json",)),
    "tune": (["tune", "record.h5", "--out"], "x.toml", ("x.json", "x-likelihood.png")),
}
"""Commands that write a file, its name, and what goes beside it."""


@pytest.fixture
def there(folder, monkeypatch):
    """The folder of results, with a recording and a spectrum in it, to be in."""
    monkeypatch.chdir(folder)
    if not (folder / "gyro.npy").exists():
        rng = np.random.default_rng(3)
        np.save(folder / "gyro.npy", 1e-4 * rng.standard_normal((2000, 3)))
        (folder / "lines.csv").write_text("frequency_hz,angle_deg\n10,0.1\n", encoding="utf-8")
        columns = np.hstack([np.arange(400)[:, None] / 100.0, rng.standard_normal((400, 6))])
        header = "time [s],gx [rad/s],gy,gz,ax [m/s2],ay,az"
        np.savetxt(folder / "unit.csv", columns, delimiter=",", header=header, comments="")
    return folder


def refused_at_once(command):
    """Return what a command says in refusing, and check that it printed and wrote nothing before."""
    result = CliRunner().invoke(cli.app, [str(part) for part in command])
    assert isinstance(result.exception, InputError), (result.exception, result.output)
    assert result.output == ""
    return str(result.exception)


def test_every_command_that_writes_is_held_to_it():
    import typer.main

    group = typer.main.get_command(cli.app)
    writing = {
        name
        for name, command in group.commands.items()
        if {"--out", "--json"} & {flag for parameter in command.params for flag in parameter.opts}
    }
    assert writing == set(FOLDERS) | {name for name in FILES if " " not in name}


PLACES = [(name, [*command, "--out"], "", file) for name, (command, files) in FOLDERS.items() for file in files]
PLACES += [
    (name, command, target, file)
    for name, (command, target, others) in FILES.items()
    for file in (target, *others)
    if (name, file) != ("montecarlo replay", target)  # which names the campaign, and a replay leaves it as it is
]


@pytest.mark.parametrize(("name", "command", "target", "file"), PLACES, ids=[f"{row[0]} {row[3]}" for row in PLACES])
def test_a_folder_in_the_place_of_a_result_is_reported_before_the_work(there, tmp_path, name, command, target, file):
    (tmp_path / file).mkdir()
    said = refused_at_once([*command, tmp_path / target])
    assert f"{tmp_path / file} is a folder" in said
    assert [path.name for path in tmp_path.iterdir()] == [file]


@pytest.mark.parametrize("name", [*FOLDERS, *FILES])
@pytest.mark.parametrize("place", ["below a file", "not to be written"])
def test_a_place_that_cannot_be_written_is_reported_before_the_work(there, tmp_path, monkeypatch, name, place):
    command, target = (FILES[name][0], FILES[name][1]) if name in FILES else ([*FOLDERS[name][0], "--out"], "")
    if place == "below a file":
        (tmp_path / "a").write_text("")
        said = refused_at_once([*command, tmp_path / "a" / "b" / target])
        assert f"{tmp_path / 'a'} is a file" in said
    else:  # reported by the system, whoever runs the tests
        monkeypatch.setattr("os.access", lambda path, mode, **_: not mode & os.W_OK)
        said = refused_at_once([*command, tmp_path / "b" / target])
        assert f"cannot be written: there is no permission to write to {tmp_path}" in said
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["coning", "simulate", "coning-budget"])
def test_missing_folders_above_a_result_are_made(there, tmp_path, name):
    command, target = (FILES[name][0], FILES[name][1]) if name in FILES else ([*FOLDERS[name][0], "--out"], "coning")
    result = CliRunner().invoke(cli.app, [str(part) for part in (*command, tmp_path / "new" / "newer" / target)])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "new" / "newer" / target).exists()


# ------------------------------------------------------------------------------------------------ numbers that nothing can be


@pytest.mark.parametrize("command", ["simulate", "montecarlo", "covariance"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("sigma_arcsec = 20.0", "sigma_arcsec = 1e300"), r"sensors[0].sigma_arcsec is 1e+300"),
        (("0.1,", "-1e200,"), r"motion.rate_deg_per_s[0] is -1e+200"),
        (
            ("angle_random_walk_deg_per_sqrt_hour = 0.15", "angle_random_walk_deg_per_sqrt_hour = 1e200"),
            "gyro.angle_random_walk",
        ),
        (("duration_s = 20.0", "duration_s = 0.001"), "0.001 s at 100 Hz contain no gyro sample"),
        (("rate_hz = 1.0", "rate_hz = 1e9"), "star 1 would measure 2e+10 times"),
    ],
)
def test_scenarios_of_impossible_numbers_are_reported_by_their_keys(
    folder, tmp_path, monkeypatch, command, change, words
):
    monkeypatch.chdir(tmp_path)
    text = (folder / "short.toml").read_text(encoding="utf-8")
    assert change[0] in text
    (tmp_path / "bad.toml").write_text(text.replace(*change, 1), encoding="utf-8")
    said = refused_at_once([command, "bad.toml"])
    assert said.startswith("bad.toml: ")
    assert words in said
    assert [path.name for path in tmp_path.iterdir()] == ["bad.toml"]


@pytest.mark.parametrize(
    ("command", "source"),
    [("estimate", "record.h5"), ("tune", "record.h5"), ("montecarlo", "short.toml"), ("covariance", "short.toml")],
)
def test_sigma_of_an_angle_in_another_unit_is_reported(folder, short, tmp_path, command, source):
    filter_setup = dataclasses.replace(setup.FilterSetup.for_scenario(short, states=False), sigma={"star 1": 20.0})
    (tmp_path / "filter.toml").write_text(setup.to_toml(filter_setup))
    out = tmp_path / {"tune": "new.toml", "montecarlo": "new.h5"}.get(command, "new")
    said = refused([command, folder / source, "--filter", tmp_path / "filter.toml", "--out", out])
    assert "star 1 is 20 rad, more than half a rotation; sigma is in rad, and 20 arcsec would be 9.696e-05" in said
    assert not out.exists()


@pytest.mark.parametrize(
    ("rate", "factor", "words"),
    [
        (1e300, 1.0, "no gyro has 1e+300 Hz"),
        (1e-300, 1.0, "no gyro has 1e-300 Hz"),
        (100.0, 1e300, "no gyro has 100 Hz and "),
    ],
)
def test_allan_refuses_what_no_gyro_measures(tmp_path, rate, factor, words):
    np.save(tmp_path / "gyro.npy", factor * np.random.default_rng(3).uniform(0.1, 1.0, (100, 3)))
    command = ["allan", tmp_path / "gyro.npy", "--gyro-unit", "rad/s", "--rate", rate, "--out", tmp_path / "out"]
    assert words in refused_at_once(command)


def test_integration_reports_samples_that_fill_no_step(there, tmp_path):
    rows = "".join(f"{k / 100.0},0.1,0.2,0.3\n" for k in range(8))
    (tmp_path / "short.csv").write_text("time [s],gx [rad/s],gy,gz\n" + rows, encoding="utf-8")
    out = ["--out", str(tmp_path / "attitude.h5")]
    said = refused_at_once(["integrate", tmp_path / "short.csv", "--algorithm", "eight-sample", *out])
    assert "holds 7 gyro samples, fewer than the 8 of one step of eight-sample" in said
    assert not (tmp_path / "attitude.h5").exists()
    result = CliRunner().invoke(cli.app, ["integrate", str(tmp_path / "short.csv"), *out])
    assert result.exit_code == 0, result.output
    assert "Samples not used at the end, an incomplete step of 4: 3." in result.output


def test_want_of_memory_ends_with_one_line(run, monkeypatch):
    def wanting(*_: object) -> None:
        raise MemoryError("Unable to allocate 149. GiB")

    monkeypatch.setattr(scenarios, "simulate", wanting)
    status, said, error = run("simulate", "two-stars")
    assert (status, said) == (2, "")
    assert error == "error: not enough memory (Unable to allocate 149. GiB); shorten the record, or lower the rates\n"
