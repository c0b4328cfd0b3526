"""One result, one verdict: the command, Python in memory, Python on a file, and the report agree in words, numbers and exit status."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

import strapdown as sd
from strapdown.cli import app
from strapdown.records import Estimate
from tests.conftest import BROAD

TRIALS = sorted(BROAD.glob("*.hdf5"))
STATUS = {"consistent": 0, "not consistent": 1, "cannot tell": 3}


def run(*arguments: object) -> int:
    return int(CliRunner().invoke(app, [str(argument) for argument in arguments]).exit_code)


def agree(result, file: Path) -> dict:
    """Check a file by the command, by Python and in a report, and compare with the result in memory."""
    in_memory = sd.check(result).summary()
    assert sd.check(sd.read(file)).summary() == in_memory
    code = run("check", file, "--json", file.with_suffix(".json"))
    by_command = json.loads(file.with_suffix(".json").read_text())
    assert {name: by_command[name] for name in in_memory} == in_memory
    assert code == STATUS[in_memory["verdict"]]
    page = sd.report.write(file, file.with_suffix(".html"))
    assert json.loads(page.statistics.read_text())["judgement"] == in_memory
    assert page.verdict == in_memory["verdict"]
    return in_memory


SCENARIOS = [name for name in sd.scenarios.SCENARIOS if name != "rest"]  # which has no sensor besides the gyro


QUICK = "earth-observer"
"""The others take 1 to 10 s each: they are long, or their filter has a structure of its own to compile. Two stars follow with options."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == QUICK else pytest.mark.slow) for name in SCENARIOS]
)
def test_a_scenario_by_every_way(name, tmp_path):
    source = sd.write(sd.simulate(name, seed=5), tmp_path / "record.h5")
    assert run("estimate", source, "--out", tmp_path / "out") == 0
    result = sd.estimate(sd.read(source))
    file = tmp_path / "out" / "estimate.h5"
    assert sd.read(file) == result
    agree(result, file)
    assert sd.read(sd.write(result, tmp_path / "again.h5")) == result


@pytest.mark.skipif(not TRIALS, reason="the BROAD trials are not here")
@pytest.mark.parametrize(
    "trial",
    [pytest.param(path, marks=[] if path is TRIALS[0] else pytest.mark.slow) for path in TRIALS],
    ids=lambda path: path.stem[:2],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_recording_with_a_reference_by_every_way(trial, tmp_path):
    source = tmp_path / trial.name
    with h5py.File(trial) as whole, h5py.File(source, "w") as part:
        part.attrs.update(whole.attrs)
        for name, values in whole.items():
            part[name] = values[len(values) // 2 :][:6_000]
    assert run("estimate", source, "--out", tmp_path / "out") == 0
    recording = sd.read(source)
    result = sd.estimate(recording)
    file = tmp_path / "out" / "estimate.h5"
    assert sd.read(file) == result
    summary = agree(result, file)
    assert any(finding["name"] != "NIS" for finding in summary["findings"])  # the reference takes part
    assert sd.check(result, recording).summary() == summary
    assert sd.read(sd.write(result, tmp_path / "again.h5")) == result


def test_an_estimate_with_options_by_every_way(tmp_path):
    short = replace(sd.scenarios.load_scenario("two-stars"), duration=60.0)
    source = sd.write(sd.simulate(short, seed=5), tmp_path / "record.h5")
    for name, flags, estimator, options in (
        ("smooth", ("--smooth",), sd.smooth, {}),
        ("gate", ("--gate", "0.99"), sd.estimate, {"gate": 0.99}),
        ("huber", ("--robust", "huber", "--no-states"), sd.estimate, {"robust": "huber", "states": False}),
    ):
        assert run("estimate", source, "--out", tmp_path / name, *flags) == 0
        result = estimator(sd.read(source), **options)
        assert sd.read(tmp_path / name / "estimate.h5") == result
        agree(result, tmp_path / name / "estimate.h5")


def test_a_filter_with_an_error_of_its_own_by_every_way(tmp_path):
    """One-sample integration of coning: errors that its innovations hardly show, and that the truth in the result does."""
    record = sd.simulate("coning", seed=5)
    source = sd.write(record, tmp_path / "record.h5")
    setup = sd.FilterSetup.for_record(record)
    assert setup.integration.name == "one-sample"
    filter_file = sd.write(setup, tmp_path / "filter.toml")
    assert run("estimate", source, "--filter", filter_file, "--out", tmp_path / "out") == 0
    result = sd.estimate(sd.read(source), setup=setup)
    assert sd.read(tmp_path / "out" / "estimate.h5") == result
    assert agree(result, tmp_path / "out" / "estimate.h5")["verdict"] == "not consistent"


def held(record, initial):
    """A filter of one's own: the initial attitude, for ever, without innovations."""
    m = len(record.time)
    return Estimate.from_arrays(
        record.time, np.tile(initial.attitude, (m, 1)), np.tile(initial.covariance[:3, :3], (m, 1, 1))
    )


def test_a_filter_of_ones_own_by_every_way(tmp_path):
    scenario = replace(sd.scenarios.load_scenario("two-stars"), duration=20.0)
    setup = replace(sd.FilterSetup.for_scenario(scenario), estimator=held)
    plan = sd.montecarlo.Plan(scenario=scenario, setup=setup, epochs=10)
    again = sd.montecarlo.replay(plan, 3)
    file = sd.write(again.estimate, tmp_path / "own.h5")
    assert sd.read(file) == again.estimate
    agree(again.estimate, file)


def test_rows_without_an_estimate_by_every_way(tmp_path):
    """NaN, as before the first fix of a filter or after its failure; Monte Carlos write such estimates of a filter of one's own."""
    scenario = replace(sd.scenarios.load_scenario("two-stars"), duration=60.0)
    result = sd.estimate(sd.simulate(scenario, seed=5), every=2)
    late, m = slice(100, None), len(result.time)
    for name in ("attitude", "bias", "variance", "covariance"):
        values = getattr(result, name).copy()
        values[:100] = np.nan
        result = replace(result, **{name: values})
    file = sd.write(result, tmp_path / "late.h5")
    assert sd.read(file) == result
    summary = agree(result, file)
    whole = sd.check(result.taken(late)).summary()
    assert summary["findings"] == whole["findings"]
    assert f"no estimate at 100 of {m} times, which are not judged" in summary["limits"]
    assert len(sd.read_attitudes(file).attitude) == m - 100
    assert sd.accuracy(result).summary() == sd.accuracy(result.taken(late)).summary()
    assert sd.plots.estimate_overview(result)
    assert sd.read(sd.write(replace(result, truth=None), tmp_path / "alone.h5")) == replace(result, truth=None)
    agree(replace(result, truth=None), tmp_path / "alone.h5")
    partly = result.truth.bias.copy()
    partly[:200] = np.nan
    result = replace(result, truth=replace(result.truth, bias=partly))
    assert (
        agree(result, sd.write(result, tmp_path / "partly.h5"))["findings"]
        == sd.check(result.taken(slice(200, None))).summary()["findings"]
    )


def test_a_truth_without_attitudes_by_every_way(tmp_path):
    scenario = replace(sd.scenarios.load_scenario("two-stars"), duration=60.0)
    result = sd.estimate(sd.simulate(scenario, seed=5))
    unknown = replace(result.truth, attitude=np.full_like(result.truth.attitude, np.nan), bias=None)
    result = replace(result, truth=unknown)
    agree(result, sd.write(result, tmp_path / "unknown.h5"))


def test_a_campaign_by_every_way(tmp_path):
    file = tmp_path / "c.h5"
    assert run("montecarlo", "two-stars", "--runs", 40, "--out", file) in STATUS.values()
    campaign = sd.read(file)
    by_command = json.loads(file.with_suffix(".json").read_text())["judgement"]
    assert agree(campaign, file) == by_command
    in_memory = sd.monte_carlo("two-stars", runs=40)
    assert in_memory == campaign.statistics
    assert sd.check(in_memory).summary() == by_command
