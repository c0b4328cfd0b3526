"""`strapdown estimate` on a simulated record, as a user types it."""

import json
import sys

import h5py
import numpy as np
import pytest

from strapdown import cli, coning, mekf, motion, quaternion, records, setup
from strapdown.checks import InputError
from strapdown.gyro import GyroSpec
from strapdown.mekf import ProcessNoise
from strapdown.recordfiles import write_record
from strapdown.records import ImuRecord, Truth, read_estimate
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


def made(sensors=STARS, duration=6.0):
    return Scenario(
        motion=motion.Coning(angle=0.3, frequency=0.3), gyro=SPEC, sensors=sensors, rate=50.0, duration=duration
    )


@pytest.fixture
def run(monkeypatch, capsys):
    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["strapdown", *(str(a) for a in arguments)])
        monkeypatch.setenv("COLUMNS", "1000")
        try:
            cli.main()
            status = 0
        except SystemExit as stop:
            status = stop.code or 0
        said = capsys.readouterr()
        return status, " ".join(said.out.split()), said.err

    return call


@pytest.fixture
def record(tmp_path):
    path = tmp_path / "record.h5"
    write_record(path, simulate(made(), 4), gyro_spec=SPEC, seed=4, run=0)
    return path


def test_a_simulated_record_is_estimated_by_the_filter_that_matches_it(run, record, tmp_path):
    status, said, error = run("estimate", record, "--out", tmp_path / "out")
    assert (status, error) == (0, "")
    assert "Started from the first measurements" in said
    assert "mean NEES per state" in said
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "estimate.h5",
        "errors.json",
        "estimate.png",
        "errors.png",
    }
    estimate = read_estimate(tmp_path / "out" / "estimate.h5")
    truth = simulate(made(), 4).truth
    assert estimate.covariance.shape == (301, 6, 6)
    assert np.max(quaternion.angle_between(estimate.attitude[100:], truth.attitude[100:])) < 5e-3
    found = json.loads((tmp_path / "out" / "errors.json").read_text())
    assert found["attitude_rms_deg"] < 3.0 * found["attitude_sigma_deg"]
    assert 0.2 < found["nees_per_state"] < 3.0
    with h5py.File(tmp_path / "out" / "estimate.h5") as file:
        assert np.array_equal(file["truth/attitude"][:], truth.attitude)


def test_a_filter_from_a_file_and_the_options(run, record, tmp_path):
    own = setup.FilterSetup(
        process_noise=NOISE,
        attitude_sigma=0.1,
        bias_sigma=3e-3,
        integration=coning.ALGORITHMS["two-sample"],
        sigma={"a": 3e-3},
    )
    (tmp_path / "filter.toml").write_text(setup.to_toml(own))
    options = ("--filter", tmp_path / "filter.toml", "--from-truth", "--every", 10, "--variances", "--gate", 0.999)
    status, said, error = run("estimate", record, "--out", tmp_path / "out", *options, "--robust", "huber")
    assert (status, error) == (0, "")
    assert "off by errors drawn" in said
    estimate = read_estimate(tmp_path / "out" / "estimate.h5")
    assert estimate.covariance is None
    assert np.allclose(np.diff(estimate.time), 0.4)
    assert 0.0 < estimate.innovations["b"].weight.min() < 1.0
    assert np.isclose(np.median(estimate.innovations["a"].variance), 9e-6, rtol=0.2)


def test_a_lost_filter_says_that_it_recovered(run, record, tmp_path):
    status, said, _ = run("estimate", record, "--out", tmp_path / "out", "--attitude", "0,0,1,0.1", "--gate", 0.999)
    assert status == 0
    assert "Recovered at" in said
    assert "were refused by the gate" in said


def test_what_a_record_does_not_tell_is_asked_for(run, record, tmp_path):
    bare = tmp_path / "bare.h5"
    whole = simulate(made(STARS[:1]), 4)
    write_record(bare, ImuRecord(time=whole.time, increments=whole.increments, vectors=whole.vectors))
    cases = (
        ((bare,), "--gyro or --filter"),
        ((record, "--attitude", "1,0,0"), "w,x,y,z"),
        ((record, "--attitude", "1,0,0,0", "--from-truth"), "give one of them"),
        ((record, "--robust", "hubert"), "did you mean 'huber'"),
        ((record, "--gate", 1.5), "between 0 and 1"),
        ((record, "--time-unit", "ms"), "goes with a CSV file"),
        ((tmp_path / "none.csv", "--gate", 0.99), "goes with a record"),
    )
    for arguments, words in cases:
        status, _, error = run("estimate", *arguments, "--out", tmp_path / "out")
        assert status == 2
        assert words in error
    alone = tmp_path / "alone.h5"
    write_record(alone, whole, gyro_spec=SPEC)
    status, _, error = run("estimate", alone, "--out", tmp_path / "out")
    assert status == 2
    assert "two directions are needed" in error
    assert "--from-truth" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("sensors", [STARS, HAND, TRACKER], ids=["directions", "vertical and heading", "attitude"])
def test_the_first_measurements_start_the_filter_where_its_sigma_says(sensors):
    errors = []
    for run_number in range(20):
        record = simulate(made(sensors, 1.0), 8, run_number)
        state = mekf.first_state(record, NOISE, bias_sigma=2e-3)
        e = quaternion.log(quaternion.multiply(quaternion.conjugate(state.attitude), record.truth.attitude[0]))
        errors.append(e @ np.linalg.solve(state.covariance[:3, :3], e) * mekf.ONCE**2 / 3.0)
    assert 0.4 < np.mean(errors) < 1.8


def test_an_outlier_among_the_first_measurements_does_not_start_the_filter():
    record = simulate(made(), 8)
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
    state = mekf.first_state(record, NOISE, bias_sigma=2e-3)
    assert quaternion.angle_between(state.attitude, record.truth.attitude[0]) < 0.02


def test_faults_do_not_hide_that_a_start_is_missing():
    blind = (
        VectorSensor(
            name="a", reference_f=np.array([1.0, 0, 0]), sigma=1e-3, rate=10.0, faults=Faults(outages=((0, 9),))
        ),
    )
    with pytest.raises(InputError, match="0 of directions"):
        mekf.first_state(simulate(made(blind), 1), NOISE, bias_sigma=1e-3)
