"""`strapdown estimate` on a simulated record, as a user types it."""

import dataclasses
import json

import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure

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
from strapdown.records import ImuRecord, Truth
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


@pytest.fixture
def record(tmp_path):
    path = tmp_path / "record.h5"
    write_record(path, specified(simulate(scenario_of(), 4)))
    return path


def test_a_simulated_record_is_estimated_by_the_filter_that_matches_it(succeeds, record, tmp_path):
    said = succeeds("estimate", record, "--out", tmp_path / "out", "--figures")
    assert "Started from the first measurements" in said
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


def test_what_a_record_does_not_hold_is_asked_for(refusal, record, tmp_path):
    bare = tmp_path / "bare.h5"
    whole = simulate(scenario_of(STARS[:1]), 4)
    write_record(bare, ImuRecord(time=whole.time, increments=whole.increments, vectors=whole.vectors))
    (tmp_path / "own.csv").write_text("time,gx,gy,gz\n")
    cases = (
        ((bare,), "give the gyro's noise, --gyro, or a filter, --filter"),
        ((record, "--attitude", "1,0,0"), "w,x,y,z"),
        ((record, "--attitude", "1,0,0,0", "--from-truth"), "give one of them"),
        ((record, "--robust", "hubert"), "did you mean 'huber'"),
        ((record, "--gate", 1.5), "between 0 and 1"),
        ((record, "--time-unit", "ms"), "declares its own layout; leave --time-unit ms out"),
        ((record, "--columns", "time=t"), "declares its own layout; leave --columns time=t out"),
        ((tmp_path / "own.csv", "--every", 2), "goes with a record"),
        ((tmp_path / "none.csv", "--every", 2), "none.csv does not exist"),
    )
    for arguments, words in cases:
        error = refusal("estimate", *arguments, "--out", tmp_path / "out")
        assert words in error
    alone = tmp_path / "alone.h5"
    write_record(alone, specified(whole))
    error = refusal("estimate", alone, "--out", tmp_path / "out")
    assert "two directions are needed" in error
    assert "--from-truth" in error
    assert not (tmp_path / "out").exists()


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
    record = records.ImuRecord(
        time=record.time,
        increments=record.increments,
        vectors=(
            type(a)(sensor="a", kind="direction", time=a.time, vector_b=wrong, reference_f=a.reference_f, sigma=1e-3),
            b,
        ),
        truth=Truth(attitude=record.truth.attitude, bias=record.truth.bias),
    )
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


@pytest.fixture
def spinning(tmp_path):
    scenario = scenarios.load_scenario("spin")
    path = tmp_path / "spin.h5"
    write_record(path, simulate(scenario, 3))
    return path


@pytest.mark.draws
def test_states_that_the_errors_call_for(run, succeeds, spinning, tmp_path, monkeypatch, blank):
    status, said, error = run(
        "estimate", spinning, "--out", tmp_path / "out", "--states", "--from-truth", "--every", 100, "--figures"
    )
    assert (status, error) == (0, "")
    assert "Optional states: gyro.scale." in said
    assert "ppm" in said
    assert "Still without" not in said
    states = json.loads((tmp_path / "out" / "states.json").read_text())
    assert states["gyro scale"]["components"] == ["z"]
    assert states["gyro scale"]["first_sigma"] == pytest.approx([1e-4])
    assert states["gyro scale"]["sigma"][0] < 0.7e-4
    kept = read_estimate(tmp_path / "out" / "estimate.h5").error_states["gyro scale"]
    assert kept.components == ("z",)
    assert kept.units == ("1",)
    assert len(kept.values) == len(read_estimate(tmp_path / "out" / "estimate.h5").time)
    np.testing.assert_allclose(
        [kept.values[-1], kept.sigma[-1]], [[*states["gyro scale"][n]] for n in ("values", "sigma")]
    )
    assert (tmp_path / "out" / "states.png").stat().st_size > 10_000
    saved = setup.from_toml(records.read_attributes(tmp_path / "out" / "estimate.h5")["filter"])
    assert saved == setup.FilterSetup.for_record(simulate(scenarios.load_scenario("spin"), 3), states=True)
    assert sd.check(sd.read(tmp_path / "out" / "estimate.h5")).verdict == "cannot tell"  # of the bias
    monkeypatch.setattr(Figure, "savefig", blank)
    succeeds("report", tmp_path / "out" / "estimate.h5")
    (tmp_path / "filter.toml").write_text(setup.to_toml(saved))
    options = ("--filter", tmp_path / "filter.toml", "--from-truth", "--every", 100)
    succeeds("estimate", spinning, "--out", tmp_path / "again", *options)
    estimate, other = (read_estimate(tmp_path / name / "estimate.h5") for name in ("out", "again"))
    assert np.array_equal(estimate.attitude, other.attitude)
    assert np.array_equal(estimate.covariance, other.covariance)


def test_what_a_record_shows_of_each_state(succeeds, spinning, tmp_path):
    said = succeeds("estimate", spinning, "--out", tmp_path / "out", "--observability", "--states")
    assert "directions are observed" in said
    saved = json.loads((tmp_path / "out" / "observability.json").read_text())
    assert len(saved["states"]) == len(saved["directions"]) == len(saved["directions"][0]) >= 7
    assert saved["rank"] == sum(value >= saved["threshold"] for value in saved["singular_values"])
    assert set(saved["units"][:6]) == {"rad", "rad/s"}


def test_what_the_filter_has_no_state_for_is_reported(spinning, record):
    scenario = scenarios.load_scenario("spin")
    toml = setup.to_toml(setup.FilterSetup.for_scenario(scenario, states=False))
    held = read_record(spinning)
    for options in ({"states": False}, {"setup": setup.from_toml(toml)}):
        message = sd.estimate(held, every=1000, **options).remarks[-1]
        assert "has no state: the gyro's scale factor of 100 ppm; `states=True` adds states" in message
    assert len(sd.estimate(read_record(record), every=100).remarks) == 1
    estimate = sd.estimate(held, every=1000)
    assert estimate.setup.states.names == ("gyro.scale",)
    assert estimate.remarks[-1].startswith("The filter has states for the specified errors, gyro.scale: without them")


def test_the_verdict_names_what_the_filter_has_no_state_for(run, succeeds, spinning, tmp_path):
    no_state = "; the filter has no state for the gyro's scale factor of 100 ppm"
    for options, missing in (((), False), (("--no-states",), True)):
        succeeds("estimate", spinning, "--out", tmp_path / "out", "--every", 10, *options)
        said = run("check", tmp_path / "out" / "estimate.h5")[1]
        assert (no_state in said) == missing
        assert ("the σ of gyro scale is not tested: no truth for it" in said) == (not missing)
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
    assert "no state for the gyro's scale factor of 200 ppm, the gyro's flicker of 0.3 °/h" in headline
    parts = json.loads((tmp_path / "check.json").read_text())["parts"]
    errors = {part["of"]: part["detectable_error"] for part in parts}
    assert errors["attitude"] < 1.5
    assert 1.5 < errors["bias"] < 2.6


@pytest.mark.slow
def test_the_detectable_error_of_a_bias_is_that_of_many_runs(satellite):
    """An error of σ by the reported factor is contradicted in nearly all of 30 runs, one of 1.2 in fewer than half."""
    scenario = scenarios.load_scenario(satellite)
    filter_setup, runs = setup.FilterSetup.for_scenario(scenario, states=False), []
    for seed in range(30):
        record = simulate(scenario, 1000 + seed)
        draw = filter_setup.attitude_sigma * np.random.default_rng(seed).standard_normal(3)
        start = setup.initial_state(filter_setup, quaternion.multiply(record.truth.attitude[0], quaternion.exp(draw)))
        estimate = setup.run(record, filter_setup, start, full_covariance=True)
        runs.append(dataclasses.replace(estimate, truth=record.truth))

    def of_bias(estimate, factor):
        """Return finding and reported error with the bias σ divided by a factor."""
        scale = np.array([1.0, 1.0, 1.0, *[1.0 / factor] * 3])
        scaled = dataclasses.replace(
            estimate, covariance=estimate.covariance * np.outer(scale, scale), variance=estimate.variance * scale**2
        )
        judged = consistency.judge(scaled)
        findings = [
            finding for finding in judged.findings if (finding.name, finding.of) == ("time-averaged NEES", "bias")
        ]
        return findings, next(part.detectable_error for part in judged.parts if part.of == "bias")

    first = [of_bias(estimate, 1.0) for estimate in runs]
    wrong = np.sqrt(np.mean([finding.value for findings, _ in first for finding in findings]))
    reported = np.median([error for _, error in first])
    assert 1.5 < reported < 2.6
    for factor, low, high in ((reported, 0.85, 1.0), (1.2, 0.0, 0.5)):
        rejected = [any(finding.rejected for finding in of_bias(estimate, factor / wrong)[0]) for estimate in runs]
        assert low <= np.mean(rejected) <= high


@pytest.mark.slow
def test_the_default_filter_of_a_satellite_passes_and_says_why_it_has_states(run, succeeds, satellite, tmp_path):
    status, said, _ = run("montecarlo", satellite, "--no-states", "--runs", 120, "--out", tmp_path / "plain.h5")
    assert status == 1
    assert "the filter has no state for the gyro's scale factor of 200 ppm" in said
    plain = json.loads((tmp_path / "plain.json").read_text())
    assert plain["nees"]["bias"]["anees"] > 1.5**2 * 0.8
    status, said, _ = run("montecarlo", satellite, "--runs", 120, "--out", tmp_path / "states.h5")
    assert "The filter has states for the specified errors, gyro.scale, gyro.drift" in said
    assert "consistent: attitude, bias and innovations; detectable error of σ: " in said
    assert status == 0
    succeeds("montecarlo", tmp_path / "states.h5")
    succeeds("check", tmp_path / "states.h5")


def test_states_of_a_record_without_a_scenario_and_a_gate(succeeds, record, tmp_path):
    said = succeeds("estimate", record, "--out", tmp_path / "out", "--states", "--gate", 0.999)
    assert "does not contain its scenario" in said
    assert "the filter has none" in said
    assert not (tmp_path / "out" / "states.json").exists()


def test_states_are_refused_where_they_make_no_sense(refusal, spinning, tmp_path):
    (tmp_path / "filter.toml").write_text(
        setup.to_toml(setup.FilterSetup.for_scenario(scenarios.load_scenario("spin"), states=False))
    )
    (tmp_path / "rec.csv").write_text("")
    cases = (
        ((spinning, "--state", "gyro.scael"), "did you mean 'gyro.scale'"),
        (
            (spinning, "--filter", tmp_path / "filter.toml", "--states"),
            "--filter is the complete filter, with its noise and states; leave --states out",
        ),
        ((tmp_path / "rec.csv", "--states"), "goes with a record"),
    )
    for arguments, words in cases:
        error = refusal("estimate", *arguments, "--out", tmp_path / "out")
        assert words in error
    assert not (tmp_path / "out").exists()


def test_an_estimate_replaces_all_of_an_earlier_one_and_nothing_else(succeeds, refusal, record, tmp_path):
    out = tmp_path / "out"
    succeeds("estimate", record, "--observability", "--out", out)
    left = (out / "observability.json", out / "estimate.html")
    left[1].write_text("a report of the first estimate")
    (out / "notes.txt").write_text("mine")
    assert left[0].exists()
    succeeds("estimate", record, "--out", out)
    assert not left[0].exists()
    assert not left[1].exists()
    assert (out / "notes.txt").read_text() == "mine"
    (out / "estimate.h5").write_text("mine too")
    error = refusal("estimate", record, "--out", out)
    assert "was not written by `strapdown estimate`" in error
    assert (out / "estimate.h5").read_text() == "mine too"


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
    cells = dataclasses.replace(estimate, error_states={"a bias": iron, "c bias": iron}).listing().cells
    assert [tuple(row[:4]) for row in cells[-6:] if row[0].endswith("x")] == [
        ("a bias x", "% of the vector", "2", "1"),
        ("c bias x", "dimensionless", "0.02", "0.01"),
    ]


def test_smoothing_with_states_holds_them(succeeds, tmp_path):
    path = tmp_path / "record.h5"
    scenario = dataclasses.replace(scenarios.load_scenario("spin"), duration=20.0)
    write_record(path, simulate(scenario, 2))
    succeeds("estimate", path, "--out", tmp_path / "out", "--smooth", "--state", "gyro.scale")
    assert "gyro scale" in json.loads((tmp_path / "out" / "states.json").read_text())


# ---------------------------------------------------------------------------------------------------- a recording of a hand


@pytest.fixture
def recording(tmp_path):
    """A simulated hand as CSV, its samples 5 ms late."""
    samples = hand_held.simulated(1, 0, 12.0)
    samples = dataclasses.replace(samples, time=samples.time + 0.005)
    path = tmp_path / "hand.csv"
    header = "time,gx [rad/s],gy,gz,ax [m/s2],ay,az,mx,my,mz"
    np.savetxt(
        path,
        np.column_stack([samples.time, samples.rate, samples.specific_force, samples.magnetic_field]),
        delimiter=",",
        header=header,
        comments="",
    )
    return path


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
    assert len(states["gyro scale"]["values"]) == 9
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
    assert abs(errors["later"] - errors["hand"]) < 0.3


def test_a_recording_that_is_not_what_it_says_is_doubted(run, succeeds, recording, tmp_path):
    recording.write_text(recording.read_text().replace("[rad/s]", "[deg/s]").replace("[m/s2]", "[g]"))
    said = succeeds("estimate", recording, "--out", tmp_path / "out")
    words = "warning: hand.csv: probably gyro rates are 57.3 times too small (rad/s read as deg/s; --gyro-unit rad/s); specific force is "
    assert words in said
    # Which then ends for want of the parameter.
    assert words in run("tune", recording, "--free", "nothing", "--out", tmp_path / "filter.toml")[1]
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


def test_a_clipped_gyro_is_reported(succeeds, recording, tmp_path):
    header, *rows = recording.read_text().splitlines()
    values = np.loadtxt(rows, delimiter=",")
    values[:, 1] = np.clip(values[:, 1], -1.2, 1.2)
    np.savetxt(recording, values, delimiter=",", header=header, comments="")
    said = succeeds("estimate", recording, "--out", tmp_path / "out")
    assert "The gyro was clipped: x at 68.75 °/s" in said


def test_a_hand_that_never_rests_is_reported(succeeds, recording, tmp_path):
    lines = recording.read_text().splitlines()
    moving = tmp_path / "moving.csv"
    moving.write_text("\n".join([lines[0], *lines[800:]]) + "\n")
    said = succeeds("estimate", moving, "--out", tmp_path / "out")
    assert "No second is quiet enough to measure the gyro's bias, so the heading may drift at first." in said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--motion", "hnd"), "did you mean 'hand'?"),
        (("--latency", -1.0), "--latency is -1 ms"),
        (("--latency", "nan"), "--latency is nan"),
        (("--latency", 60000.0), "lasts"),
        (("--gate", 1.5), "between 0 and 1"),
        (("--robust", "hubert"), "did you mean 'huber'"),
        (("--states",), "goes with a record"),
        (("--calibration", "none.toml"), "none.toml does not exist"),
    ],
)
def test_bad_options_of_a_recording_are_refused(refusal, recording, tmp_path, options, words):
    error = refusal("estimate", recording, "--out", tmp_path / "out", *options)
    assert words in error, error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--motion", "hand"), "--motion goes with a recording"),
        (("--latency", 4.0), "--latency goes with a recording"),
        (("--calibration", "unit.toml"), "--calibration goes with a recording"),
        (("--smooth", "--every", 2), "leave one of them out"),
    ],
)
def test_options_of_a_recording_are_refused_with_a_record(refusal, record, tmp_path, options, words):
    error = refusal("estimate", record, "--out", tmp_path / "out", *options)
    assert words in error, error
