"""Campaigns and their files: killed, interrupted, resumed, extended, and refused where they do not fit."""

import itertools
import json
import multiprocessing
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from hdf5 import changed
from measured import errors_at
from spin_plan import PLAN, SCENARIO, SETUP, assert_same

import strapdown as sd
from strapdown import coning, montecarlo, records, scenarios
from strapdown.checks import InputError
from strapdown.estimation import setup as setups
from strapdown.files import locked, reading
from strapdown.montecarlo import campaign, engine, scalar, statistics
from strapdown.recordings import recordfiles

CHUNK = 8


def go(path, runs, plan=PLAN, **options):
    return campaign.run(plan, path, **{"runs": runs, "machine": "scalar", "chunk": CHUNK, "threads": 2, **options})


@cache
def straight(runs):
    return montecarlo.run_plan(PLAN, runs=runs, chunk=CHUNK, threads=1, machine="scalar")


def noting(computed):
    """Workers in this thread, and a list of the chunks that they compute."""

    def workers(work, chunks):
        computed.extend(chunks)
        return map(work, *zip(*computed, strict=True)) if computed else iter(())

    return workers


# ------------------------------------------------------------------------------------------------------------ the file


@pytest.fixture(scope="module")
def of_21_runs(tmp_path_factory):
    path, reported = tmp_path_factory.mktemp("campaign") / "deeper" / "c.h5", []
    result = go(path, 21, progress=reported.append)
    assert result.finished
    assert sum(reported) == 21
    return path


def test_the_file_holds_what_a_plain_run_gives_and_describes_itself(of_21_runs):
    held = campaign.read(of_21_runs)
    assert_same(held.statistics, straight(21))
    assert held.plan.digest == PLAN.digest
    assert (held.machine, held.chunk, held.runs, held.finished) == ("scalar", CHUNK, 21, True)
    assert list(of_21_runs.parent.iterdir()) == [of_21_runs]
    with reading.hdf5(of_21_runs) as file:
        attributes = reading.attributes(file)
        assert attributes["kind"] == "strapdown montecarlo"
        again = scenarios.scenario_from_toml(attributes["scenario"])
        assert scenarios.scenario_to_toml(again) == attributes["scenario"]
        assert "[filter]" in attributes["filter"]
        assert attributes["finished_runs"] == 21
        assert {"python", "numpy", "numba", "h5py"} == set(json.loads(attributes["versions"]))
        assert "quaternions Hamilton" in attributes["conventions"]
        for dataset in file["statistics"].values():
            assert reading.attributes(dataset).keys() >= {"unit", "meaning"}
        names = {field.name for field in fields(statistics.Statistics)} - {"runs", "sensors", "plan"}
        assert set(file["statistics"]) == names


def test_a_campaign_runs_in_any_thread(tmp_path):
    """Only the main thread may handle signals."""
    with ThreadPoolExecutor(1) as pool:
        result = pool.submit(go, tmp_path / "c.h5", 4).result()
    assert_same(result.statistics, straight(4))


def test_a_campaign_can_be_extended_to_the_same_bits(tmp_path):
    """From ends on whole chunks and on short ones, of which only the short one is computed again; at its end nothing is."""
    path, computed, nothing, reported = tmp_path / "c.h5", [], [], []
    go(path, 5)
    for end in (8, 13):
        go(path, end, resume=True, chunk=None)
    result = go(path, 30, resume=True, workers=noting(computed))
    assert computed == list(engine.chunks_of(30, CHUNK))[1:]
    assert_same(result.statistics, straight(30))
    assert_same(campaign.read(path).statistics, straight(30))
    again = go(path, 30, resume=True, workers=noting(nothing), progress=reported.append)
    assert (nothing, reported) == ([], [30])
    assert_same(result.statistics, again.statistics)
    assert again.seconds >= result.seconds


@pytest.mark.parametrize("stop", [0, 1, 3])
def test_finished_chunks_are_not_computed_again(tmp_path, stop):
    """Interrupted after some chunks, the file has them; resuming computes the others alone."""
    path, computed = tmp_path / "c.h5", []

    def interrupted(work, chunks):
        for chunk in itertools.islice(chunks, stop):
            yield work(*chunk)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        go(path, 29, workers=interrupted)
    held = campaign.read(path)
    assert held.finished_runs == stop * CHUNK
    assert not held.finished
    result = go(path, 29, resume=True, workers=noting(computed))
    assert computed == list(engine.chunks_of(29, CHUNK))[stop:]
    assert_same(result.statistics, straight(29))


def test_writing_takes_a_small_share_of_the_time(tmp_path, monkeypatch):
    written = []
    original = campaign._write

    def slow(*arguments):
        written.append(time.perf_counter())
        time.sleep(0.05)
        original(*arguments)

    monkeypatch.setattr(campaign, "_write", slow)
    begun = time.perf_counter()
    go(tmp_path / "c.h5", 60, chunk=2)
    elapsed = time.perf_counter() - begun
    assert 2 <= len(written) <= 3 + elapsed / 0.5
    assert campaign.read(tmp_path / "c.h5").finished


# ------------------------------------------------------------------------------------------------------------ killed


def _killed(path, runs, die_at):
    """Resume a campaign in a forked process that kills itself in the middle of writing its n-th dataset."""
    written, original = [], campaign.put

    def put(*arguments):
        written.append(arguments)
        if len(written) == die_at:
            os.kill(os.getpid(), signal.SIGKILL)
        original(*arguments)

    campaign.put = put
    go(path, runs, resume=True, threads=1)


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("die_at", [18, 31])
def test_killed_in_the_middle_of_writing_the_file_is_the_one_before(tmp_path, die_at):
    scalar.run_chunk(PLAN, 0, 1)  # compiled before the child forks
    path = tmp_path / "c.h5"
    go(path, 16)
    before = path.read_bytes()
    child = multiprocessing.get_context("fork").Process(target=_killed, args=(path, 24, die_at))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    if die_at <= 18:  # the first writing of the resumed campaign
        assert path.read_bytes() == before
    assert campaign.read(path).statistics.runs >= 16
    assert_same(go(path, 24, resume=True).statistics, straight(24))
    assert [p.name for p in tmp_path.iterdir()] == ["c.h5"]  # nothing of the killed one is left


# ------------------------------------------------------------------------------------------------------------ refused


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"plan": replace(PLAN, seed=5)}, "seed is 4 there and 5 here"),
        ({"plan": replace(PLAN, seed=0)}, "seed is 4 there and 0 here"),
        ({"plan": replace(PLAN, nis_bins=4)}, "nis_bins is 5 there and 4 here"),
        ({"plan": replace(PLAN, setup=replace(SETUP, attitude_sigma=0.1))}, "filter.attitude_sigma_deg is"),
        ({"plan": replace(PLAN, scenario=replace(SCENARIO, duration=4.8))}, "scenario.duration_s is 2.4 there and 4.8"),
        (
            {"plan": replace(PLAN, scenario=replace(SCENARIO, duration=4.8, name="other"))},
            "scenario.name is .* there and other",
        ),
        (
            {"plan": replace(PLAN, scenario=replace(SCENARIO, name="other"), setup=replace(SETUP, attitude_sigma=0.1))},
            "scenario.name is spin there and other here",  # not the filter, which follows from it
        ),
        (
            {"plan": replace(PLAN, scenario=replace(SCENARIO, sensors=SCENARIO.sensors[:1]))},
            r"scenario.sensors.1.\S+ is \S+ there and not given here",
        ),
        (
            {"plan": replace(PLAN, dispersions=montecarlo.Dispersions(scale_factor_sigma=1e-4))},
            "dispersions.scale_factor_sigma_ppm is not given there and 100",
        ),
        ({"chunk": 9}, "chunk is 8 there and 9 here"),
        ({"runs": 20}, "holds 21 runs already"),
        ({"runs": 0}, "runs is 0"),
    ],
)
def test_a_file_of_another_campaign_is_refused_and_left_as_it_is(of_21_runs, changes, message):
    path, before = of_21_runs, of_21_runs.read_bytes()
    options = {"runs": 30, "plan": PLAN, **changes}
    with pytest.raises(InputError, match=message):
        go(path, resume=True, **options)
    assert path.read_bytes() == before


def test_a_file_of_another_version_or_format_is_refused(of_21_runs, tmp_path):
    path = tmp_path / "c.h5"
    for name, value, message in (
        ("version", "0.0.1", r"version is 0\.0\.1 there"),
        ("arithmetic", "another processor", "arithmetic is another processor there"),  # which rounds differently
        ("format", 99, "format 99, newer"),
    ):
        path.write_bytes(of_21_runs.read_bytes())
        with changed(path) as file:
            file.attrs[name] = value
        with pytest.raises(InputError, match=message):
            go(path, 30, resume=True)


def test_an_existing_file_is_not_written_over_by_mistake(tmp_path):
    path = tmp_path / "c.h5"
    path.write_text("the only copy of my thesis")
    with pytest.raises(InputError, match="`resume=True`"):
        go(path, 8)
    assert path.read_text() == "the only copy of my thesis"
    with pytest.raises(InputError, match="cannot be read as HDF5"):
        go(path, 8, resume=True)
    assert path.read_text() == "the only copy of my thesis"
    assert go(path, 2, overwrite=True).finished
    with locked(path), pytest.raises(InputError, match="being written by another process"):
        go(path, 2)  # it is not read before it is locked


def test_files_that_are_no_campaign_are_refused(of_21_runs, tmp_path):
    path, whole = tmp_path / "c.h5", of_21_runs.read_bytes()
    with pytest.raises(InputError, match="does not exist"):
        campaign.read(path)
    for share in (0.1, 0.5, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match="truncated"):
            campaign.read(path)
    with records.result_file(path, "estimate", None):
        pass
    with pytest.raises(InputError, match="no Monte Carlo campaign"):
        campaign.read(path)


def test_a_plan_without_a_form_in_a_file_is_refused_before_anything_is_computed(tmp_path):
    class Own:
        def __getattr__(self, name):
            return getattr(SCENARIO.motion, name)

    with pytest.raises(InputError, match="cannot be written to a file"):
        go(tmp_path / "c.h5", 8, plan=replace(PLAN, scenario=replace(SCENARIO, motion=Own())))
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------------------------------------------------ the command


@pytest.fixture
def command(run, tmp_path):
    """``strapdown montecarlo ARGUMENTS`` in an empty folder: exit status, standard output and standard error."""
    Path("short.toml").write_text(scenarios.scenario_to_toml(replace(SCENARIO, name="short")), encoding="utf-8")
    return partial(run, "montecarlo")


SCALAR = ("--machine", "scalar")


def test_the_command_computes_prints_and_writes(command, monkeypatch):
    judged, judge = [], statistics.Statistics.judge
    monkeypatch.setattr(statistics.Statistics, "judge", lambda *a, **k: judged.append(a) or judge(*a, **k))
    status, said, error = command("short.toml", "--runs", 30, "--seed", 4, *SCALAR)
    assert (status, error, len(judged)) == (3, "", 1)  # 30 runs cannot tell
    assert "More runs (--runs, with --resume) are needed for a decision." in said
    assert "short: 30 runs, seed 4, machine: scalar." in said
    for words in (
        "ANEES attitude, mean",
        "NIS sun sensor",
        "NIS star",
        "Worst runs",
        "cannot tell: ",
    ):
        assert words in " ".join(said.split())
    report = json.loads(Path("short-montecarlo.json").read_text())
    held = campaign.read("short-montecarlo.h5")
    assert report["runs"] == 30
    assert report["digest"] == held.plan.digest
    assert report["anees"]["attitude"] == pytest.approx(held.statistics.anees[4:, 1].mean(), rel=0.2)
    assert json.loads(json.dumps(held.summary())) == report
    expected = montecarlo.summary(held.statistics)
    assert (report["judgement"]["verdict"], report["consistent"]) == ("cannot tell", False)
    assert {name: report[name] for name in expected} == json.loads(json.dumps(expected))
    assert held.plan.seed == 4
    assert held.plan.epochs == 80


def test_drift_by_coning_is_named_where_the_filter_is_not_consistent(command):
    status, said, _ = command("coning", "--runs", 100, "--no-states")
    assert status == 1
    assert "One-sample integration drifts in this motion (coning)" in " ".join(said.split())
    matched = setups.FilterSetup.for_scenario(scenarios.load_scenario("coning"), states=False)
    accurate = replace(matched, integration=coning.ALGORITHMS["matched-1-8-8"])
    Path("accurate.toml").write_text(setups.to_toml(accurate), encoding="utf-8")
    assert "One-sample" not in command("coning", "--runs", 100, "--filter", "accurate.toml", "--out", "other.h5")[1]


def test_the_command_matches_the_filter_to_a_data_sheet(command):
    """``--gyro`` changes the filter alone; the file is named after that of the scenario, whatever name the scenario has."""
    Path("other.toml").write_text(Path("short.toml").read_text(), encoding="utf-8")
    sheet = "[gyro]\nangle_random_walk_deg_per_sqrt_hour = 0.9\nrate_random_walk_deg_per_hour_per_sqrt_hour = 6.0\n"
    Path("gyro.toml").write_text(sheet, encoding="utf-8")
    status, said, _ = command("other.toml", "--runs", 4, "--no-states", "--gyro", "gyro.toml", *SCALAR)
    assert status in (1, 3)
    assert "--states adds states for most of these errors" in said
    plan = campaign.read("other-montecarlo.h5").plan
    assert plan.scenario.gyro == SCENARIO.gyro
    assert plan.setup.process_noise.angle_random_walk == pytest.approx(0.9 * np.pi / 10800.0)
    assert plan.setup.process_noise.rate_random_walk == pytest.approx(6.0 * np.pi / 180.0 / 3600.0 / 60.0)
    options = {"runs": 4, "states": False, "noise": sd.gyro.read_spec("gyro.toml")}
    assert sd.monte_carlo("other.toml", **options).plan == plan
    Path("filter.toml").write_text(setups.to_toml(plan.setup), encoding="utf-8")
    status, _, error = command("short.toml", "--gyro", "gyro.toml", "--filter", "filter.toml")
    assert status == 2
    assert "--filter is the complete filter, with its noise and states; leave --gyro out" in error


def test_the_command_resumes_extends_and_shows(command):
    assert command("short.toml", "--runs", 4, *SCALAR)[0] == 3
    status, _, error = command("short.toml", "--runs", 4, *SCALAR)
    assert status == 2
    assert "--resume" in error
    assert "--overwrite" in error
    assert command("short.toml", "--runs", 6, "--resume", *SCALAR)[0] == 3
    status, said, _ = command("short-montecarlo.h5")
    assert status == 3
    assert "6 runs" in said
    assert command("short-montecarlo.h5", "--runs", 8, "--resume")[0] == 3
    assert campaign.read("short-montecarlo.h5").statistics.runs == 8
    status, _, error = command("short-montecarlo.h5", "--seed", 3, "--resume")
    assert status == 2
    assert "--seed" in error


def test_each_run_draws_its_own_gyro_where_the_filter_has_states_for_its_errors(command):
    """Scale factors over the runs: independent standard normals times that of the specification, whatever the chunks."""
    Path("f.toml").write_text(setups.to_toml(setups.FilterSetup.for_scenario(SCENARIO, states=True)))
    _, said, _ = command("short.toml", "--runs", 4, "--filter", "f.toml", "--out", "by-file.h5", *SCALAR)
    assert "Each run draws its own gyro" in said
    command("short.toml", "--runs", 4, "--states", *SCALAR)
    plan = campaign.read("short-montecarlo.h5").plan
    assert plan == campaign.read("by-file.h5").plan
    assert plan.individuals
    assert plan.setup.states.names == ("gyro.scale",)
    known = replace(SCENARIO.gyro, scale_factor=np.zeros(3))
    exact = replace(plan, scenario=replace(plan.scenario, gyro=known))
    ratio = []
    for run in range(40):
        # The drift of the increments beside those of a perfect scale factor, of the same noise, is the error drawn.
        flawed, perfect = (scalar.record_of(each, run).increments for each in (plan, exact))
        turn = perfect.sum(axis=0)
        k = int(np.argmax(np.abs(turn) * np.abs(SCENARIO.gyro.scale_factor)))
        ratio.append((flawed - perfect).sum(axis=0)[k] / turn[k] / SCENARIO.gyro.scale_factor[k])
    assert abs(np.mean(ratio)) < 3.5 / np.sqrt(40)
    assert 0.65 < np.std(ratio) < 1.4


def test_a_file_in_which_no_run_was_finished_does_not_stand_in_the_way(tmp_path):
    """As after a fault in a filter of one's own, which is found in the first run; a file of another kind is kept."""
    path = tmp_path / "c.h5"

    def faulty(record, initial):
        raise ValueError("a mistake")

    with pytest.raises(ValueError, match="a mistake"):
        go(path, 4, plan=replace(PLAN, setup=replace(SETUP, estimator=faulty)))
    assert campaign.read(path).finished_runs == 0
    assert go(path, 4).finished
    path.write_text("a report")
    with pytest.raises(InputError, match="exists"):
        go(path, 4)


def test_the_command_takes_a_filter_and_dispersions_of_ones_own(command):
    Path("f.toml").write_text(setups.to_toml(replace(SETUP, measurement_sigma_factor=0.5)))
    Path("d.toml").write_text("[dispersions]\nattitude_error_deg = [0.0, 0.0, 5.0]\nattitude_sigma_deg = 0.0\n")
    status, said, _ = command("short.toml", "--runs", 12, "--filter", "f.toml", "--dispersions", "d.toml", *SCALAR)
    assert status == 1
    assert "not consistent: the filter is" in said
    held = campaign.read("short-montecarlo.h5")
    assert held.plan.setup.measurement_sigma_factor == 0.5
    assert np.allclose(held.statistics.mean_error[0, :3], np.deg2rad([0.0, 0.0, 5.0]), atol=1e-12)


@pytest.mark.parametrize("machine", ["scalar", pytest.param("lanes", marks=pytest.mark.slow)])
def test_a_replay_is_the_run_of_the_campaign_to_the_bit(command, machine):
    assert command("short.toml", "--runs", 6, "--machine", machine)[0] in (1, 3)
    held = campaign.read("short-montecarlo.h5")
    status, _, error = command("short-montecarlo.h5", "--replay", 6)
    assert (status, "has the runs 0 to 5; give one of them" in " ".join(error.split())) == (2, True)
    assert "exclude each other" in command("short-montecarlo.h5", "--replay", 5, "--overwrite")[2]
    status, said, _ = command("short-montecarlo.h5", "--replay", 5)
    assert status == 0
    assert "Run 5 of seed 1" in said
    estimate = setups.read_estimate("short-montecarlo-run-5-estimate.h5")
    record = recordfiles.read_record("short-montecarlo-run-5-record.h5")
    step = (len(estimate.time) - 1) // held.plan.epochs
    rows = slice(None, None, step)
    assert np.array_equal(errors_at(estimate, record.truth, rows), held.statistics.example_error[5])
    assert np.array_equal(np.sqrt(estimate.variance[rows]), held.statistics.example_sigma[5])
    # Causes can be sought in it: it holds its filter as any estimate does.
    assert setups.from_toml(records.read_attributes("short-montecarlo-run-5-estimate.h5")["filter"]) == held.plan.setup


@pytest.fixture
def heeded():
    """Signals as a program has them that was started in the foreground; tests may run in the background, with SIGINT ignored."""
    before = {signal_number: signal.getsignal(signal_number) for signal_number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    for signal_number, handler in before.items():
        signal.signal(signal_number, handler)


@pytest.mark.parametrize("how", ["Ctrl-C", "SIGTERM"])
def test_interrupted_it_keeps_what_is_finished_and_says_so(command, heeded, monkeypatch, how):
    original, done = scalar.run_chunks, []

    def interrupted(plans, first_run, runs):
        done.append(first_run)
        if len(done) > 2:
            if how == "Ctrl-C":
                raise KeyboardInterrupt
            time.sleep(0.5)  # until those before are merged
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1.0)  # a signal at the moment in which the main thread begins to wait is heeded after the chunk
        return original(plans, first_run, runs)

    before = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as at_once:
        at_once.setattr(campaign, "choose", lambda *_: signal.raise_signal(signal.SIGINT))
        status, said, _ = command("short.toml", "--runs", 60, *SCALAR)
    assert (status, "--resume" in said) == (130, False)  # nothing is written yet
    monkeypatch.setattr(scalar, "run_chunks", interrupted)
    status, said, _ = command("short.toml", "--runs", 60, "--threads", 1, *SCALAR)
    assert status == 130
    assert "continue with --resume" in said
    assert signal.getsignal(signal.SIGTERM) == before
    assert campaign.read("short-montecarlo.h5").statistics.runs == 2 * scalar.CHUNK


def test_a_signal_that_whoever_started_the_command_had_ignored_stays_ignored(command, heeded, monkeypatch):
    """As a shell has SIGINT ignored for what it starts in the background, and nohup SIGHUP."""
    original = campaign._write

    def interrupted(*arguments):
        signal.raise_signal(signal.SIGTERM)
        original(*arguments)

    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    monkeypatch.setattr(campaign, "_write", interrupted)
    status, _, _ = command("short.toml", "--runs", 4, "--threads", 1, *SCALAR)
    assert status == 3  # 4 runs cannot tell
    assert campaign.read("short-montecarlo.h5").finished
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
