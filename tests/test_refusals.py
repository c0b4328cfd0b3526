"""What commands and readers refuse before anything is computed or replaced: damaged results, inputs for outputs, numbers too large."""

from __future__ import annotations

import dataclasses
import shutil

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from strapdown import cli, consistency, records, scenarios
from strapdown.checks import InputError, count


@pytest.fixture(scope="module")
def short():
    return dataclasses.replace(scenarios.load_scenario("two-stars"), duration=20.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, short):
    """A record, the estimate made from it, and a campaign."""
    where = tmp_path_factory.mktemp("results")
    (where / "short.toml").write_text(scenarios.scenario_to_toml(short), encoding="utf-8")
    for command in (
        ["simulate", str(where / "short.toml"), "--out", str(where / "record.h5")],
        ["estimate", str(where / "record.h5"), "--out", str(where / "run")],
        ["montecarlo", str(where / "short.toml"), "--runs", "8", "--out", str(where / "runs.h5")],
    ):
        result = CliRunner().invoke(cli.app, command)
        assert result.exit_code == 0, result.output
    return where


def refused(command):
    """Return what a command says in refusing."""
    result = CliRunner().invoke(cli.app, [str(part) for part in command])
    assert isinstance(result.exception, InputError), result.output
    return str(result.exception)


def test_an_estimate_does_not_replace_its_record(folder, tmp_path):
    shutil.copy(folder / "record.h5", tmp_path / "estimate.h5")
    before = (tmp_path / "estimate.h5").read_bytes()
    assert "the very file that is read" in refused(["estimate", tmp_path / "estimate.h5", "--out", tmp_path])
    assert (tmp_path / "estimate.h5").read_bytes() == before


def test_a_budget_does_not_replace_its_spectrum(tmp_path):
    spectrum = tmp_path / "lines.json"
    spectrum.write_text("frequency_hz,angle_deg\n10,0.1\n")
    assert "the very file" in refused(["coning-budget", "--psd", spectrum, "--rate", 1000, "--json", spectrum])
    assert "choose such a suffix" in refused(
        ["coning-budget", "--psd", spectrum, "--rate", 1000, "--json", tmp_path / "out.csv"]
    )


@pytest.mark.parametrize("name", ["../evil", "a/b", ".hidden", "two\nlines"])
def test_a_scenario_is_not_named_like_a_path(short, name):
    with pytest.raises(InputError, match="files are called after it"):
        dataclasses.replace(short, name=name)


def test_resuming_and_overwriting_exclude_each_other(folder):
    command = ["montecarlo", folder / "short.toml", "--runs", 8, "--out", folder / "runs.h5", "--resume", "--overwrite"]
    assert "exclude each other" in refused(command)


def test_a_campaign_does_not_replace_a_json_of_another_maker(folder, tmp_path):
    (tmp_path / "mine.json").write_text("{}")
    command = ["montecarlo", folder / "short.toml", "--runs", 8, "--out", tmp_path / "mine.h5"]
    assert "mine.json exists" in refused(command)
    assert (tmp_path / "mine.json").read_text() == "{}"


@pytest.mark.parametrize("value", [10**30, -(10**30), float("inf"), float("nan"), 2.0**63])
def test_counts_too_large_are_refused_by_name(value):
    with pytest.raises(InputError, match="seed"):
        count("seed", value)


def test_tuning_refuses_a_negative_seed_and_a_record_twice(folder):
    record = folder / "record.h5"
    assert "seed is -1" in refused(["tune", record, "--seed", -1])
    assert "spacing" in refused(["tune", record, "--spacing", -1.0])
    assert "given twice" in refused(["tune", record, record])


@pytest.mark.parametrize(
    ("name", "change", "complaint"),
    [
        ("bias", lambda value: value[:-1], "bias"),
        ("time", lambda value: value[::-1], "time"),
        ("variance", lambda value: np.full_like(value, np.nan), "variance"),
    ],
)
@pytest.mark.parametrize("command", ["check", "report"])
def test_a_damaged_estimate_is_no_verdict(folder, tmp_path, name, change, complaint, command):
    path = tmp_path / "bad.h5"
    shutil.copy(folder / "run" / "estimate.h5", path)
    with h5py.File(path, "r+") as file:
        value = change(file[name][:])
        del file[name]
        file[name] = value
    assert complaint in refused([command, path])


@pytest.mark.parametrize("change", [lambda value: value[:-1], lambda value: np.full_like(value, np.nan)])
@pytest.mark.parametrize("command", ["check", "report"])
def test_a_damaged_campaign_is_no_verdict(folder, tmp_path, change, command):
    path = tmp_path / "bad.h5"
    shutil.copy(folder / "runs.h5", path)
    with h5py.File(path, "r+") as file:
        value = change(file["statistics/nees_sum"][:])
        del file["statistics/nees_sum"]
        file["statistics/nees_sum"] = value
    assert "damaged" in refused([command, path])


def test_causes_are_sought_in_the_record_that_was_estimated(folder, tmp_path):
    result = CliRunner().invoke(cli.app, ["simulate", "magnetometer-only", "--out", str(tmp_path / "other.h5")])
    assert result.exit_code == 0
    said = refused(["check", folder / "run" / "estimate.h5", "--record", tmp_path / "other.h5"])
    assert "made from another record" in said


def test_the_filter_that_the_estimate_tells_is_enough_to_seek_causes(folder):
    command = ["check", str(folder / "run" / "estimate.h5"), "--record", str(folder / "record.h5")]
    result = CliRunner().invoke(cli.app, command)
    assert result.exit_code in (0, 2), result.output
    assert "Causes by what they would explain" in result.output


def test_an_estimate_keeps_more_than_its_start(folder, tmp_path):
    said = refused(["estimate", folder / "record.h5", "--every", 5000, "--out", tmp_path / "run"])
    assert "every is 5000, more than the 2000 filter steps" in said
    assert not (tmp_path / "run").exists()


def test_errors_are_taken_at_the_same_times(folder):
    estimate = records.read_estimate(folder / "run" / "estimate.h5")
    with pytest.raises(InputError, match="same times"):
        consistency.errors(estimate.attitude, estimate.bias, estimate.attitude[:-1], estimate.bias[:-1])


@pytest.mark.parametrize("command", ["check", "report", "estimate", "integrate", "doctor", "tune", "allan"])
def test_a_folder_for_a_file_is_told_in_one_line(tmp_path, command):
    (tmp_path / "d.h5").mkdir()
    said = refused([command, tmp_path / "d.h5", *(["--algorithm", "one-sample"] if command == "integrate" else [])])
    assert said.startswith(f"{tmp_path / 'd.h5'} is a folder; name ")
