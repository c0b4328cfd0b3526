"""The command ``strapdown calibrate``: the same as the function, and a file for ``estimate``."""

import dataclasses

import numpy as np
import pytest

import strapdown as sd
from sims import calibration as study
from strapdown import calibration, recordings


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Recordings of one unit: turned with pauses, and moved."""
    folder = tmp_path_factory.mktemp("unit")
    unit = study.drawn_unit(8)
    for name, run, pauses in (("turned", 0, True), ("moved", 1, False)):
        recording = dataclasses.replace(study.simulated(unit, 8, run, 11.0, pauses=pauses), true_attitude=None)
        recordings.write(recording, folder / f"{name}.csv")
    return folder


def test_the_command_is_the_function_and_estimate_reads_its_file(succeeds, files, tmp_path):
    out = tmp_path / "unit.toml"
    said = succeeds("calibrate", files / "turned.csv", "--out", out)
    assert "gyro scale x" in said
    assert "good is" in said  # eleven seconds are short
    unit = sd.calibrate(sd.read(files / "turned.csv"))
    again = calibration.read(out)
    assert list(again.entries()) == list(unit.entries())
    assert list(again.sigma.entries()) == list(unit.sigma.entries())
    succeeds("estimate", files / "moved.csv", "--calibration", out, "--out", tmp_path / "out", "--motion", "hand")
    by_command = sd.read(tmp_path / "out" / "estimate.h5")
    by_function = sd.estimate(sd.read(files / "moved.csv"), calibration=unit, motion="hand")
    np.testing.assert_array_equal(by_command.attitude, by_function.attitude)


@pytest.mark.slow
def test_gravity_is_told_and_its_own_file_is_replaced(succeeds, files, tmp_path):
    out = tmp_path / "unit.toml"
    unit = sd.calibrate(sd.read(files / "turned.csv"))
    calibration.write(unit, out)
    succeeds("calibrate", files / "turned.csv", "--out", out, "--gravity", 9.78)
    assert calibration.read(out).accelerometer_matrix[2, 2] > unit.accelerometer_matrix[2, 2]


def test_what_the_command_did_not_write_is_kept(refusal, files, tmp_path):
    out = tmp_path / "mine.toml"
    out.write_text("[filter]\n")
    assert "was not written by `strapdown calibrate`" in refusal("calibrate", files / "turned.csv", "--out", out)
    assert out.read_text() == "[filter]\n"
