"""`strapdown estimate` on a simulated record, as a user types it."""

import dataclasses
import json
import shutil

import h5py
import numpy as np
import pytest

import strapdown as sd
from sims import hand_held
from strapdown import (
    ahrs,
    calibration,
    coning,
    consistency,
    estimation,
    motion,
    quaternion,
    records,
    report,
    scenarios,
    units,
)
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.estimation.setup import read_estimate
from strapdown.estimation.states import PRIOR_INFLATION, ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.recordings.recordfiles import read_record, write_record
from strapdown.records import ImuRecord
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import Accelerometer, AttitudeSensor, Faults, Magnetometer, VectorSensor

SPEC = GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias=np.array([1e-3, -2e-3, 5e-4]))
NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
STARS = (
    VectorSensor(name="a", reference_f=np.array([1.0, 0.2, 0.0]), sigma=1e-3, rate=10.0),
    VectorSensor(name="b", reference_f=np.array([0.0, 1.0, 1.0]), sigma=2e-3, rate=5.0),
)
HAND = (
    Accelerometer(name="up", sigma=0.05, rate=10.0, kind="vector"),
    Magnetometer(name="north", field_f=np.array([0.0, 2e-5, -4e-5]), sigma=2e-7, rate=10.0, kind="heading"),
)
TRACKER = (AttitudeSensor(name="tracker", sigma_across=1e-3, sigma_about=5e-3, rate=5.0),)


def scenario_of(sensors=STARS, duration=6.0):
    return Scenario(
        motion=motion.Coning(angle=0.3, frequency=0.3), gyro=SPEC, sensors=sensors, rate=50.0, duration=duration
    )


@pytest.fixture
def run(run, monkeypatch):
    """Run ``strapdown ARGUMENTS`` as the fixture of all tests does, its words on one line."""
    monkeypatch.setenv("COLUMNS", "1000")

    def call(*arguments):
        status, said, complaint = run(*arguments)
        return status, " ".join(said.split()), complaint

    return call


def specified(record):
    """The record with the gyro's specification, and without its scenario."""
    return dataclasses.replace(record, origin=records.Origin(gyro=SPEC, seed=4, run=0))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Records: of stars, of one star, without a specification, of a spinning body; and a hand as CSV, its samples 5 ms late."""
    folder = tmp_path_factory.mktemp("records")
    write_record(folder / "record.h5", specified(simulate(scenario_of(), 4)))
    alone = simulate(scenario_of(STARS[:1]), 4)
    write_record(folder / "alone.h5", specified(alone))
    write_record(folder / "bare.h5", ImuRecord(time=alone.time, increments=alone.increments, vectors=alone.vectors))
    spin = scenarios.load_scenario("spin")
    write_record(folder / "spin.h5", simulate(spin, 3))
    without = setup.FilterSetup.for_scenario(spin, states=False)
    (folder / "filter.toml").write_text(setup.to_toml(without), encoding="utf-8")
    hand = hand_held.simulated(1, 0, 12.0)
    columns = [hand.time + 0.005, hand.rate, hand.specific_force, hand.magnetic_field]
    header = "time,gx [rad/s],gy,gz,ax [m/s2],ay,az,mx,my,mz"
    np.savetxt(folder / "hand.csv", np.column_stack(columns), delimiter=",", header=header, comments="")
    return folder


@pytest.fixture
def record(files):
    return files / "record.h5"


@pytest.fixture
def spinning(files):
    return files / "spin.h5"


def test_a_simulated_record_is_estimated_by_the_filter_that_matches_it(succeeds, refusal, record, tmp_path):
    said = succeeds("estimate", record, "--out", tmp_path / "out", "--figures")
    assert "Started from the first measurements with 10 times their σ, since the filter uses them again: σ " in said
    assert "Gyro bias: RMS error" in said
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "estimate.h5",
        "errors.json",
        "estimate.png",
        "errors.png",
    }
    estimate = read_estimate(tmp_path / "out" / "estimate.h5")
    truth = simulate(scenario_of(), 4).truth
    assert estimate.covariance.shape == (301, 6, 6)
    assert np.max(quaternion.angle_between(estimate.attitude[100:], truth.attitude[100:])) < 5e-3
    errors = json.loads((tmp_path / "out" / "errors.json").read_text())
    assert 0.3 < errors["given"]["all samples"]["total"]["rms_over_sigma"] < 3.0
    assert 0.0 < errors["bias"]["rms_deg_per_h"] < 3.0 * errors["bias"]["sigma_deg_per_h"]
    with h5py.File(tmp_path / "out" / "estimate.h5") as file:
        assert np.array_equal(file["truth/attitude"][:], truth.attitude)
    for command, out in (("estimate", "2"), ("tune", "2.toml")):
        assert "a result, not a recording" in refusal(
            command, tmp_path / "out" / "estimate.h5", "--out", tmp_path / out
        )


def test_a_filter_from_a_file_and_the_options(succeeds, record, tmp_path):
    own = setup.FilterSetup(
        process_noise=NOISE,
        attitude_sigma=0.1,
        bias_sigma=3e-3,
        integration=coning.ALGORITHMS["two-sample"],
        sigma={"a": 3e-3},
    )
    (tmp_path / "filter.toml").write_text(setup.to_toml(own))
    options = ("--filter", tmp_path / "filter.toml", "--from-truth", "--every", 10, "--variances", "--gate", 0.999)
    said = succeeds("estimate", record, "--out", tmp_path / "out", *options, "--robust", "huber")
    assert "with errors drawn" in said
    estimate = read_estimate(tmp_path / "out" / "estimate.h5")
    assert estimate.covariance is None
    assert np.allclose(np.diff(estimate.time), 0.4)
    assert 0.0 < estimate.innovations["b"].weight.min() < 1.0
    assert np.isclose(np.median(estimate.innovations["a"].variance), 9e-6, rtol=0.2)


def test_a_lost_filter_says_that_it_recovered(succeeds, record, tmp_path):
    said = succeeds("estimate", record, "--out", tmp_path / "out", "--attitude", "0,0,1,0.1", "--gate", 0.999)
    assert "Recovered at" in said
    assert "rejected by the gate" in said


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("bare.h5", (), "give the gyro's noise, --gyro, or a filter, --filter"),
        ("alone.h5", (), "two directions are needed"),
        ("alone.h5", (), "--from-truth"),
        ("record.h5", ("--attitude", "1,0,0"), "w,x,y,z"),
        ("record.h5", ("--attitude", "1,0,0,0", "--from-truth"), "give one of them"),
        ("record.h5", ("--robust", "hubert"), "did you mean 'huber'"),
        ("record.h5", ("--gate", 1.5), "between 0 and 1"),
        ("record.h5", ("--time-unit", "ms"), "declares its own layout; leave --time-unit ms out"),
        ("record.h5", ("--columns", "time=t"), "declares its own layout; leave --columns time=t out"),
        ("record.h5", ("--motion", "hand"), "--motion goes with a recording"),
        ("record.h5", ("--latency", 4.0), "--latency goes with a recording"),
        ("record.h5", ("--smooth", "--every", 2), "leave one of them out"),
        ("spin.h5", ("--state", "gyro.scael"), "did you mean 'gyro.scale'"),
        (
            "spin.h5",
            ("--filter", "filter.toml", "--states"),
            "--filter is the complete filter, with its noise and states; leave --states out",
        ),
        ("none.csv", ("--every", 2), "none.csv does not exist"),
        ("hand.csv", ("--states",), "goes with a record"),
        ("hand.csv", ("--motion", "hnd"), "did you mean 'hand'?"),
        ("hand.csv", ("--latency", -1.0), "--latency is -1 ms"),
        ("hand.csv", ("--latency", "nan"), "--latency is nan"),
        ("hand.csv", ("--latency", 60000.0), "lasts"),
        ("hand.csv", ("--calibration", "none.toml"), "none.toml does not exist"),
    ],
)
def test_what_does_not_go_together_or_is_missing_is_refused(refusal, files, tmp_path, name, options, words):
    shutil.copy(files / "filter.toml", tmp_path)
    assert words in refusal("estimate", files / name, "--out", tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()


def test_a_folder_is_not_named_like_a_file(refusal, run, record, tmp_path):
    said = refusal("estimate", record, "--out", tmp_path / "x.h5")
    assert "x.h5, but a folder is meant, for estimate.h5; name one without a suffix: " in said
    assert not (tmp_path / "x.h5").exists()
    (tmp_path / "x.h5").mkdir()
    assert run("estimate", record, "--out", tmp_path / "x.h5")[0] == 0


@pytest.mark.parametrize("sensors", [STARS, HAND, TRACKER], ids=["directions", "vertical and heading", "attitude"])
def test_the_first_measurements_start_the_filter_where_its_sigma_says(sensors):
    errors = []
    for run_number in range(20):
        record = simulate(scenario_of(sensors, 1.0), 8, run_number)
        state = estimation.first_state(record, NOISE, bias_sigma=2e-3)
        e = quaternion.log(quaternion.multiply(quaternion.conjugate(state.attitude), record.truth.attitude[0]))
        errors.append(e @ np.linalg.solve(state.covariance[:3, :3], e) * PRIOR_INFLATION**2 / 3.0)
    assert 0.4 < np.mean(errors) < 1.8


def test_an_outlier_among_the_first_measurements_does_not_start_the_filter():
    record = simulate(scenario_of(), 8)
    a, b = record.vectors
    wrong = a.vector_b.copy()
    wrong[0] = [0.0, 0.0, 1.0]
    record = dataclasses.replace(record, vectors=(dataclasses.replace(a, vector_b=wrong), b))
    state = estimation.first_state(record, NOISE, bias_sigma=2e-3)
    assert quaternion.angle_between(state.attitude, record.truth.attitude[0]) < 0.02


def test_faults_do_not_hide_that_a_start_is_missing():
    blind = (
        VectorSensor(
            name="a", reference_f=np.array([1.0, 0, 0]), sigma=1e-3, rate=10.0, faults=Faults(outages=((0, 9),))
        ),
    )
    with pytest.raises(InputError, match="0 of directions"):
        estimation.first_state(simulate(scenario_of(blind), 1), NOISE, bias_sigma=1e-3)


# ---------------------------------------------------------------------------------------------------- optional states, one direction


def test_states_that_the_errors_call_for(run, succeeds, spinning, tmp_path):
    options = ("--states", "--from-truth", "--every", 100, "--figures")
    status, said, error = run("estimate", spinning, "--out", tmp_path / "out", *options)
    assert (status, error) == (0, "")
    assert "Optional states: gyro.scale." in said
    assert "ppm" in said
    assert "does not model" not in said
    assert (tmp_path / "out" / "states.png").exists()
    states = json.loads((tmp_path / "out" / "states.json").read_text())["gyro scale"]
    assert states["components"] == ["z"]
    assert states["first_sigma"] == pytest.approx([1e-4])
    assert states["sigma"][0] < 0.7e-4
    estimate = read_estimate(tmp_path / "out" / "estimate.h5")
    kept = estimate.error_states["gyro scale"]
    assert (kept.components, kept.units, len(kept.values)) == (("z",), ("1",), len(estimate.time))
    np.testing.assert_allclose([kept.values[-1], kept.sigma[-1]], [states["values"], states["sigma"]])
    saved = setup.from_toml(records.read_attributes(tmp_path / "out" / "estimate.h5")["filter"])
    assert saved == setup.FilterSetup.for_record(read_record(spinning), states=True)
    assert sd.check(estimate).verdict == "cannot tell"  # of the bias
    (tmp_path / "filter.toml").write_text(setup.to_toml(saved))
    options = ("--filter", tmp_path / "filter.toml", "--from-truth", "--every", 100)
    succeeds("estimate", spinning, "--out", tmp_path / "again", *options)
    other = read_estimate(tmp_path / "again" / "estimate.h5")
    assert np.array_equal(estimate.attitude, other.attitude)
    assert np.array_equal(estimate.covariance, other.covariance)


def test_what_a_record_shows_of_each_state(succeeds, record, tmp_path):
    said = succeeds("estimate", record, "--out", tmp_path / "out", "--observability")
    assert "directions are observed" in said
    saved = json.loads((tmp_path / "out" / "observability.json").read_text())
    assert len(saved["states"]) == len(saved["directions"]) == len(saved["directions"][0]) == 6
    assert saved["rank"] == sum(value >= saved["threshold"] for value in saved["singular_values"])
    assert set(saved["units"]) == {"rad", "rad/s"}
    printed = f"gyro bias x °/h {3600.0 * np.degrees(saved['prior_sigma'][3]):.3g} "
    assert printed in " ".join(said.partition("prior σ")[2].split())
    # The next estimate replaces all of this one and nothing else.
    (tmp_path / "out" / "estimate.html").write_text("a report of the first estimate")
    (tmp_path / "out" / "notes.txt").write_text("mine")
    succeeds("estimate", record, "--out", tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"estimate.h5", "errors.json", "notes.txt"}


def test_what_the_filter_has_no_state_for_is_reported(spinning, record):
    scenario = scenarios.load_scenario("spin")
    toml = setup.to_toml(setup.FilterSetup.for_scenario(scenario, states=False))
    held = read_record(spinning)
    for options in ({"states": False}, {"setup": setup.from_toml(toml)}):
        message = sd.estimate(held, every=1000, **options).remarks[-1]
        assert "does not model the gyro's scale factor of 100 ppm; `states=True` adds states" in message
    assert len(sd.estimate(read_record(record), every=100).remarks) == 1
    estimate = sd.estimate(held, every=1000)
    assert estimate.setup.states.names == ("gyro.scale",)
    assert estimate.remarks[-1].startswith("The filter has states for the specified errors, gyro.scale: without them")


def test_the_verdict_names_what_the_filter_has_no_state_for(run, succeeds, spinning, tmp_path):
    no_state = "; the filter does not model the gyro's scale factor of 100 ppm"
    for options, missing in (((), False), (("--no-states",), True)):
        succeeds("estimate", spinning, "--out", tmp_path / "out", "--every", 10, *options)
        said = run("check", tmp_path / "out" / "estimate.h5")[1]
        assert (no_state in said) == missing
        assert ("the σ of gyro scale is not tested: the truth is not known" in said) == (not missing)
    page = report.write(tmp_path / "out" / "estimate.h5").page.read_text(encoding="utf-8")
    assert no_state.replace("'", "&#x27;") in page[: page.index("<h2>")]  # in the headline


@pytest.fixture(scope="module")
def satellite(tmp_path_factory):
    """The specification of a small satellite: 0.15 °/√h, 0.3 °/h bias instability, 200 ppm, a tracker of 5/5/30 arcsec at 2 Hz."""
    spec = GyroSpec(
        angle_random_walk=0.15 * units.DEGREE_PER_ROOT_HOUR,
        bias_instability=0.3 * units.DEGREE_PER_HOUR,
        scale_factor=np.full(3, 200e-6),
    )
    tracker = AttitudeSensor(
        name="tracker", sigma_across=5.0 * units.ARCSECOND, sigma_about=30.0 * units.ARCSECOND, rate=2.0
    )
    body = motion.TorqueFree(inertia=[10.0, 15.0, 20.0], initial_rate=np.radians([0.3, 0.5, 0.2]))
    scenario = Scenario(
        motion=body, gyro=spec, sensors=(tracker,), rate=10.0, duration=600.0, seed=3, name="sat", gravity_f=(0.0,) * 3
    )
    path = tmp_path_factory.mktemp("satellite") / "sat.toml"
    path.write_text(scenarios.scenario_to_toml(scenario), encoding="utf-8")
    return path


def test_the_verdict_on_a_satellite_says_no_more_than_one_record_shows(run, succeeds, satellite, tmp_path):
    """Without states the bias σ is wrong by 1.3 (a Monte Carlo says so), which this record of ten minutes does not show.

    Its time-averaged NEES shows an error of 2: over 160 runs that average has the spread of 17 independent epochs, whose bounds at this
    level differ by the factor 1.9², and σ wrong by 2.04 is contradicted in 95 % of runs. The NEES at the end alone would show one of 31.
    """
    succeeds("simulate", satellite, "--seed", 6, "--out", tmp_path / "sat.h5")
    succeeds("estimate", tmp_path / "sat.h5", "--no-states", "--out", tmp_path / "plain")
    status, said, _ = run("check", tmp_path / "plain" / "estimate.h5", "--json", tmp_path / "check.json")
    assert status == 3
    headline = said[said.index("cannot tell: attitude and innovations consistent; bias not testable from this run") :]
    assert "only an error of σ of ×" in headline
    assert "does not model the gyro's scale factor of 200 ppm, the gyro's flicker of 0.3 °/h" in headline
    parts = json.loads((tmp_path / "check.json").read_text())["parts"]
    errors = {part["of"]: part["detectable_error"] for part in parts}
    assert errors["attitude"] < 1.5
    assert 1.5 < errors["bias"] < 2.6


def test_states_of_a_record_without_a_scenario_and_a_gate(succeeds, record, tmp_path):
    said = succeeds("estimate", record, "--out", tmp_path / "out", "--states", "--gate", 0.999)
    assert "does not contain its scenario" in said
    assert "the filter has none" in said
    assert not (tmp_path / "out" / "states.json").exists()


def test_a_file_of_someone_else_is_not_replaced(refusal, record, tmp_path):
    (tmp_path / "estimate.h5").write_text("mine")
    assert "was not written by `strapdown estimate`" in refusal("estimate", record, "--out", tmp_path)
    assert (tmp_path / "estimate.h5").read_text() == "mine"


def test_directions_that_contradict_each_other_start_nothing(refusal, tmp_path):
    """A star taken for another: no bank makes a start of that, unless the filter has states for what sensors get wrong."""
    whole = simulate(scenario_of(), 4)
    first, *others = whole.vectors
    wrong = dataclasses.replace(first, reference_f=np.array([0.6, 0.8, 0.0]))
    path = tmp_path / "mixed.h5"
    write_record(path, specified(dataclasses.replace(whole, vectors=(wrong, *others))))
    error = refusal("estimate", path, "--out", tmp_path / "out")
    assert "check for a mixed-up pair" in error
    assert "--attitude" in error
    assert not (tmp_path / "out").exists()


def test_one_direction_that_turns_starts_by_a_bank(run, succeeds, tmp_path):
    scenario = dataclasses.replace(scenarios.load_scenario("magnetometer-only"), duration=2400.0)
    path = tmp_path / "alone.h5"
    whole = simulate(scenario, 1)
    write_record(path, whole)
    said = succeeds("estimate", path, "--out", tmp_path / "out")
    assert "96 hypotheses were merged into one at" in said
    assert "the estimate begins there" in said
    estimate = read_estimate(tmp_path / "out" / "estimate.h5")
    assert 300.0 < estimate.time[0] < 2000.0
    assert estimate.time[-1] == whole.time[-1]
    k = np.searchsorted(whole.time, estimate.time)
    truth = whole.truth.attitude[k]
    error = consistency.errors(estimate.attitude, estimate.bias, truth, whole.truth.bias[k])
    assert consistency.nees(error, estimate.covariance)[[0, -1]].max() / 6.0 < 3.0
    with h5py.File(tmp_path / "out" / "estimate.h5") as file:
        assert np.array_equal(file["truth/attitude"][:], truth)
    status, _, _ = run("check", tmp_path / "out" / "estimate.h5")
    assert status in (0, 3)


# ---------------------------------------------------------------------------------------------------- smoothed


def test_a_record_is_smoothed(succeeds, record, tmp_path):
    succeeds("estimate", record, "--out", tmp_path / "out", "--smooth")
    smoothed = read_estimate(tmp_path / "out" / "estimate.h5")
    succeeds("estimate", record, "--out", tmp_path / "plain")
    plain = read_estimate(tmp_path / "plain" / "estimate.h5")
    np.testing.assert_array_equal(smoothed.time, plain.time)
    assert np.all(smoothed.variance <= plain.variance * (1.0 + 1e-9))
    assert np.mean(smoothed.variance[:150]) < 0.5 * np.mean(plain.variance[:150])
    errors, before = (json.loads((tmp_path / name / "errors.json").read_text()) for name in ("out", "plain"))
    assert errors["bias"]["sigma_deg_per_h"] < before["bias"]["sigma_deg_per_h"]
    assert 0.4 < errors["given"]["all samples"]["total"]["rms_over_sigma"] < 1.7
    with h5py.File(tmp_path / "out" / "estimate.h5") as file:
        assert file.attrs["smoothed"]


def test_states_of_a_direction_are_printed_relative_to_its_vector(record):
    """Those of a whole vector are in its unit."""
    estimate = sd.estimate(read_record(record))
    m = len(estimate.time)
    iron = records.estimate.ErrorStateEstimate(
        components=("x", "y", "z"), units=("1",) * 3, values=np.full((m, 3), 0.02), variance=np.full((m, 3), 1e-4)
    )
    with_states = dataclasses.replace(estimate, error_states={"a bias": iron, "c bias": iron})
    cells = with_states.listing().cells
    labels = [ax.get_ylabel() for ax in sd.plots.states_over_time(with_states).axes]
    assert labels == ["% of the vector", "dimensionless"]
    assert [tuple(row[:4]) for row in cells[-6:] if row[0].endswith("x")] == [
        ("a bias x", "% of the vector", "2", "1"),
        ("c bias x", "dimensionless", "0.02", "0.01"),
    ]
    coloured = setup.SensorStates(bias_sigma=1e-7, correlated_sigma=1e-8, correlation_time=10.0)
    for kind, unit in (("direction", "1"), ("vector", "unit of the reference"), ("attitude", "rad")):
        blocks = setup.States(sensors={"c": coloured}).blocks({"c": kind})
        assert [block.units for block in blocks] == [(unit,) * 3] * 2
    assert units.error_state_unit("c disturbance x", "rad") == ("arcsec", units.ARCSECOND)  # as in a scenario
    assert units.error_state_unit("attitude x", "rad") == ("°", units.DEGREE)
    assert units.error_state_unit(units.error_state_name("gyro scale", "xy", "rad"), "rad")[0] == "mrad"


# ---------------------------------------------------------------------------------------------------- a recording of a hand


@pytest.fixture
def recording(files):
    return files / "hand.csv"


def off(folder, shift):
    """RMS angle, °, beside the truth of a recording whose samples are 5 ms late, made good by ``shift`` s."""
    estimate = read_estimate(folder / "estimate.h5")
    truth = hand_held.simulated(1, 0, 12.0).true_attitude
    at = np.interp(estimate.time - 0.005 + shift, np.arange(len(truth)) / hand_held.RATE, np.arange(len(truth)))
    return np.rad2deg(
        np.sqrt(np.mean(quaternion.angle_between(estimate.attitude, truth[np.round(at).astype(int)]) ** 2))
    )


def test_a_recording_is_by_default_that_of_a_hand(succeeds, recording, tmp_path):
    said = succeeds("estimate", recording, "--out", tmp_path / "out")
    assert "Motion: of a hand, velocity σ 0.7 m/s, correlation time 0.3 s." in said
    assert "The gyro's bias is measured at rest, in " in said
    assert "Samples are assumed to be stamped 2.5 ms late, half a sample interval, σ 2 ms" in said
    assert "warning" not in said
    attributes = records.read_attributes(tmp_path / "out" / "estimate.h5")
    states = json.loads((tmp_path / "out" / "states.json").read_text())
    assert states["accelerometer velocity"]["units"] == ["m/s", "m/s²"] * 3
    assert states["gyro scale"]["components"] == ["x", "xy=yx", "xz=zx", "y", "yz=zy", "z"]
    assert (attributes["motion"], attributes["smoothed"], attributes["latency"]) == (
        "hand",
        False,
        pytest.approx(0.0025),
    )
    assert attributes["parameter.velocity_sigma"] == ahrs.HAND_HELD.velocity_sigma
    assert setup.from_toml(attributes["filter"]) == ahrs.HAND_HELD.setup
    assert off(tmp_path / "out", 0.0) < 1.5


def test_any_motion_smoothing_and_latency(run, recording, tmp_path):
    errors = {}
    for name, options in {
        "hand": (),
        "any": ("--motion", "any"),
        "smoothed": ("--smooth",),
        "later": ("--latency", 5.0),
    }.items():
        status, said, error = run("estimate", recording, "--out", tmp_path / name, *options)
        assert (status, error) == (0, ""), name
        errors[name] = off(tmp_path / name, 0.005 if name == "later" else 0.0)
        assert ("Samples are assumed to be stamped 5 ms late." in said) == (name == "later")
        assert ("Motion: any" in said) == (name == "any")
    assert errors["smoothed"] < errors["hand"] < errors["any"]
    assert "gyro scale" in json.loads((tmp_path / "smoothed" / "states.json").read_text())
    assert abs(errors["later"] - errors["hand"]) < 0.3


def test_a_recording_that_is_not_what_it_says_is_doubted(run, succeeds, recording, tmp_path):
    wrong = tmp_path / "hand.csv"
    wrong.write_text(recording.read_text().replace("[rad/s]", "[deg/s]").replace("[m/s2]", "[g]"))
    said = succeeds("estimate", wrong, "--out", tmp_path / "out")
    words = "warning: hand.csv: probably gyro in rad/s (--gyro-unit rad/s); accelerometer in m/s2 (--accelerometer-unit m/s2)"
    assert words in said
    # Which then ends for want of the parameter.
    assert words in run("tune", wrong, "--free", "nothing", "--out", tmp_path / "filter.toml")[1]
    assert "See `strapdown doctor`, with the same file and its options." in said


@pytest.mark.slow
def test_gate_robust_weights_and_observability_of_a_recording(succeeds, recording, tmp_path):
    options = ("--gate", 0.999, "--robust", "student", "--observability")
    succeeds("estimate", recording, "--out", tmp_path / "out", *options)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "estimate.h5",
        "states.json",
        "calibration.toml",
        "observability.json",
    }
    with h5py.File(tmp_path / "out" / "estimate.h5") as file:
        used = setup.from_toml(file.attrs["filter"].decode())
    assert (used.gate.probability, used.robust.kind) == (0.999, "student")
    estimate = read_estimate(tmp_path / "out" / "estimate.h5")
    assert all(innovations.weight is not None for innovations in estimate.innovations.values())
    assert off(tmp_path / "out", 0.0) < 1.5


def test_a_calibration_is_written_and_used(succeeds, recording, tmp_path):
    succeeds("estimate", recording, "--out", tmp_path / "first", "--smooth")
    first = calibration.read(tmp_path / "first" / "calibration.toml")
    again = ("--calibration", tmp_path / "first" / "calibration.toml")
    succeeds("estimate", recording, "--out", tmp_path / "again", *again)
    second = calibration.read(tmp_path / "again" / "calibration.toml")
    assert second.gyro_scale_sigma < first.gyro_scale_sigma < 4e-3  # of the smoother's prior
    assert np.abs(second.gyro_matrix - first.gyro_matrix).max() < 2e-3


def test_a_clipped_gyro_and_a_hand_that_never_rests_are_reported(succeeds, recording, tmp_path):
    header, *rows = recording.read_text().splitlines()
    values = np.loadtxt(rows[799:], delimiter=",")  # after the rest
    values[:, 1] = np.clip(values[:, 1], -1.2, 1.2)
    np.savetxt(tmp_path / "moving.csv", values, delimiter=",", header=header, comments="")
    said = succeeds("estimate", tmp_path / "moving.csv", "--out", tmp_path / "out")
    assert "The gyro was clipped: x at 68.75 °/s" in said
    assert "No second is quiet enough to measure the gyro's bias, so the heading may drift at first." in said
