"""``strapdown tune`` as its users run it: files in, table and files out, mistakes reported in one line."""

import dataclasses
import json

import numpy as np
import pytest
import two_stars

import strapdown as sd
from sims import hand_held
from strapdown import gyro, scenarios, tuning
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.estimation.gating import Gate
from strapdown.estimation.setup import FilterSetup
from strapdown.recordings import recordfiles
from strapdown.report import tunings

SCENARIO = two_stars.scenario(300.0)
STRUCK = two_stars.scenario(300.0, outliers=0.05)


@pytest.fixture
def record(tmp_path):
    path = tmp_path / "sat.h5"
    recordfiles.write_record(path, scenarios.simulate(SCENARIO, 1))
    return path


@pytest.fixture
def wrong(tmp_path):
    """A filter wrong by ten."""
    path = tmp_path / "wrong.toml"
    filter_setup = setup.FilterSetup.for_scenario(SCENARIO, states=False)
    values = {"gyro.arw": 1e-3, "gyro.rrw": 3e-7, "star 1.sigma": 1e-5, "star 2.sigma": 2e-3}
    path.write_text(setup.to_toml(tuning.with_values(filter_setup, values)), encoding="utf-8")
    return path


@pytest.fixture
def scaled(tmp_path):
    """A record whose gyro has a scale factor, given by its scenario."""
    scenario = dataclasses.replace(
        SCENARIO, gyro=dataclasses.replace(SCENARIO.gyro, scale_factor=np.array([0.0, 0.0, 2e-3]))
    )
    path = tmp_path / "scaled.h5"
    record = scenarios.simulate(scenario, 2)
    recordfiles.write_record(path, record)
    return path


@pytest.mark.draws
def test_tune_writes_the_filter_the_report_and_the_figures(succeeds, tmp_path, record, wrong):
    out = tmp_path / "results" / "tuned.toml"
    said = succeeds("tune", record, "--filter", wrong, "--holdout", 0.3, "--starts", 3, "-o", out)
    assert "3 of 3 searches" in said
    assert "On the data held out" in said
    filter_setup = setup.read_setup(out)
    assert isinstance(filter_setup, FilterSetup)
    assert filter_setup.process_noise.angle_random_walk == pytest.approx(1e-4, rel=0.3)
    assert filter_setup.sigma["star 2"] == pytest.approx(2e-4, rel=0.2)
    content = json.loads(out.with_suffix(".json").read_text())
    assert "standard_error: relative" in content["units"]
    names = [parameter["name"] for parameter in content["parameters"]]
    assert names == ["gyro.arw", "gyro.rrw", "star 1.sigma", "star 2.sigma"]
    assert content["innovations_fit"]
    held = content["held_out"]
    assert held["after"]["log_likelihood_per_innovation"] > held["before"]["log_likelihood_per_innovation"]
    low, high = held["after"]["nis_bounds"]
    assert low < held["after"]["nis_per_degree"] < high
    assert (out.parent / "tuned-likelihood.png").stat().st_size > 10_000


def test_the_command_and_python_give_the_same_with_a_gate_too(succeeds, tmp_path):
    """Stars with outliers: the gate is written into the filter, and the report says why."""
    path, first, out = tmp_path / "struck.h5", tmp_path / "first.toml", tmp_path / "tuned.toml"
    record = scenarios.simulate(STRUCK, 1)
    recordfiles.write_record(path, record)
    first.write_text(setup.to_toml(setup.FilterSetup.for_scenario(SCENARIO, states=False)), encoding="utf-8")
    free = ["gate.probability", "star 1.sigma", "star 2.sigma"]
    shared = ("--filter", first, "--free", ",".join(free), "--starts", 1, "--threads", 1, "--holdout", 0.3)
    said = succeeds("tune", path, *shared, "-o", out)
    assert "outliers.share" in said
    assert "is more likely an outlier than noise" in said
    content = json.loads(out.with_suffix(".json").read_text())
    tuned = sd.tune(sd.read(path), setup=setup.read_setup(first), free=free, starts=1, threads=1, holdout=0.3)
    assert tuned.setup == setup.read_setup(out)
    gate = content["gate"]
    assert tuned.setup.gate.probability == pytest.approx(gate["probability"])
    assert gate["lower"] < gate["probability"] < gate["upper"]
    assert set(gate["thresholds"]) == {"star 1", "star 2"}
    assert "A measurement with a NIS above" in tunings.report(out.with_suffix(".json"))[0]
    estimate = setup.run(record, tuned.setup, tuning.record_case(record, tuned.setup, seed=1).initial)
    assert all(innovation.refused > 5 for innovation in estimate.innovations.values())
    for document in (content, summary := tuned.summary()):
        for tested in document["unmodelled"]:
            tested.pop("record")  # the command names the file
            tested.pop("words")
        for name in ("details", "words"):
            document["report"].pop(name)
    likelihood = content.pop("slices")[0]
    assert likelihood["name"] == content["parameters"][0]["name"]
    np.testing.assert_allclose(likelihood["values"][12], content["parameters"][0]["value"])
    assert likelihood["fallen"][12] < 3.84
    assert content == {"records": [path.name], **json.loads(json.dumps(summary))}


def test_states_are_added_to_a_filter_without_them(succeeds, run, tmp_path, scaled):
    """Its own message advises it: a scale factor of 2000 ppm at 3 °/s is no white noise."""
    plain, out, shared = tmp_path / "plain.toml", tmp_path / "states.toml", ("--starts", 1, "-o")
    said = succeeds("tune", scaled, "--no-states", "--free", "star 1.sigma", *shared, plain)
    assert "; --states adds states for most of these errors." in " ".join(said.split())
    free = ("--states", "--free", "gyro.arw,gyro.scale_sigma")
    for options in (("--filter", plain), ()):
        said = succeeds("tune", scaled, *options, *free, *shared, out)
        filter_setup = setup.read_setup(out)
        assert filter_setup.states.names == ("gyro.scale",)
        assert filter_setup.process_noise.angle_random_walk == pytest.approx(1e-4, rel=0.5)
        names = [parameter["name"] for parameter in json.loads(out.with_suffix(".json").read_text())["parameters"]]
        assert names == ["gyro.arw", "gyro.scale_sigma"]
    assert "Optional states: gyro.scale" in said
    assert "leave --states out" in run("tune", scaled, "--filter", out, "--states")[2]


def test_tune_against_the_truth_and_with_a_prior(succeeds, tmp_path, record, wrong):
    out = tmp_path / "tuned.toml"
    said = succeeds("tune", record, "--truth", "--free", "gyro.arw,star 2.sigma", "--starts", 1, "-o", out)
    assert "gyro.arw" in said
    assert set(setup.read_setup(out).sigma) == {"star 2"}
    spec = tmp_path / "gyro.toml"
    spec.write_text("[gyro]\nangle_random_walk_rad_per_sqrt_s = 1e-4\nrate_random_walk_rad_per_s_per_sqrt_s = 3e-7\n")
    succeeds("tune", record, "--filter", wrong, "--prior", spec, "-o", out)
    assert setup.read_setup(out).process_noise.rate_random_walk == pytest.approx(2.2e-6, rel=0.05)  # 2.7e-6 without


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--free", "gyro.awr"), "did you mean 'gyro.arw'"),
        (("--holdout", "1.5"), "between 0 and 1"),
        (("--out", "filter.json"), ".toml"),
        (("--truth", "--spacing", "1"), "leave it out"),
        (("--prior", "no-such-gyro"), "no-such-gyro"),
        (("--free", " , "), "names no parameter"),
        (("--gate", "--truth"), "likelihood of all innovations"),
    ],
)
def test_mistakes_are_reported_in_one_line(refusal, tmp_path, record, arguments, complaint):
    said = refusal("tune", record, *arguments)
    assert complaint in said.replace("\n", " ")
    assert not (tmp_path / "filter.toml").exists()


def test_a_record_that_does_not_specify_its_gyro_needs_a_filter(refusal, tmp_path):
    bare = tmp_path / "bare.h5"
    recordfiles.write_record(bare, dataclasses.replace(scenarios.simulate(SCENARIO, 1), origin=None))
    assert "--filter" in refusal("tune", bare, "-o", tmp_path / "f.toml")


@pytest.mark.slow
def test_a_filter_with_states_and_a_gate_is_tuned_against_the_truth(run, succeeds, tmp_path, scaled):
    first, out = tmp_path / "first.toml", tmp_path / "states.toml"
    record = recordfiles.read_record(scaled)
    gated = dataclasses.replace(setup.FilterSetup.for_record(record, states=True), gate=Gate())
    first.write_text(setup.to_toml(gated), encoding="utf-8")
    command = ("tune", scaled, "--filter", first, "--free", "gyro.arw", "--starts", 1, "-o", out)
    said = succeeds(*command, "--truth")
    filter_setup = setup.read_setup(out)
    assert filter_setup.states == gated.states
    assert filter_setup.gate == gated.gate
    assert "with its gate and weights" not in said
    assert run(*command)[1].count("--truth tunes the filter with its gate and weights") == 1


@pytest.mark.slow
def test_outliers_beside_optional_states(succeeds, tmp_path):
    out = tmp_path / "states.toml"
    spec = gyro.GyroSpec(angle_random_walk=1e-4, turn_on_bias_sigma=1e-5, scale_factor=np.array([0.0, 0.0, 2e-3]))
    recordfiles.write_record(tmp_path / "struck.h5", scenarios.simulate(dataclasses.replace(STRUCK, gyro=spec), 2))
    options = ("--states", "--gate", "--free", "star 1.sigma,star 2.sigma", "--starts", 1, "--holdout", 0.3)
    succeeds("tune", tmp_path / "struck.h5", *options, "-o", out)
    filter_setup, content = setup.read_setup(out), json.loads(out.with_suffix(".json").read_text())
    assert filter_setup.states is not None
    assert filter_setup.gate.probability == pytest.approx(content["gate"]["probability"])
    held = content["held_out"]
    assert held["after"]["log_likelihood_per_innovation"] > held["before"]["log_likelihood_per_innovation"]


@pytest.mark.parametrize("option", ["--columns", "--topic"])
def test_columns_and_topic_are_read_as_estimate_reads_them(run, refusal, tmp_path, option):
    """A layout that the file does not have is refused before the search, which shows that the option reached the reader."""
    path = tmp_path / "walk.csv"
    path.write_text("stamp,p,q,r\n" + "".join(f"{10 * k},0.1,0.2,0.3\n" for k in range(50)))
    good = {"--columns": "time=stamp(ms),gx=p(dps),gy=q(dps),gz=r(dps)", "--topic": "/imu"}[option]
    bad = {"--columns": "time=stamp(ms),gx=p(dps),gy=q(dps),gz=s(dps)", "--topic": "/imu"}[option]
    complaint = refusal("tune", path, option, bad)
    assert {"--columns": "no column 's(dps)'", "--topic": "topic"}[option] in complaint
    _, _, complaint = run("tune", path, option, good)
    assert {"--columns": "no accelerometer", "--topic": "topic"}[option] in complaint


def test_of_a_recording_without_its_errors_only_the_scale_is_tuned(refusal, tmp_path):
    """Its disturbances last: the likelier filter is as a rule worse."""
    path = tmp_path / "walk.csv"
    recording = hand_held.simulated(3, 0, 8.0)
    columns = np.column_stack([recording.time, recording.rate, recording.specific_force, recording.magnetic_field])
    header = "time,gx [rad/s],gy,gz,ax [m/s2],ay,az,mx,my,mz"
    np.savetxt(path, columns, delimiter=",", header=header, comments="")
    for options in (("--free", "gyro.arw"), ("--gate",), ("--prior", "bmi088")):
        complaint = refusal("tune", path, "--out", tmp_path / "filter.toml", *options)
        assert "cannot be tuned by the innovations of a recording" in complaint
        assert not (tmp_path / "filter.toml").exists()
    with pytest.raises(InputError, match="cannot be tuned by the innovations"):
        sd.tune(recording, free=["gyro.arw"], threads=1)
    tuned = sd.tune(recording, starts=1, threads=1)
    assert [parameter.name for parameter in tuned.parameters] == ["filter.scale"]
