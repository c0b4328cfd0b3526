"""A unit's calibration, carried from one recording to the next."""

import dataclasses

import numpy as np
import pytest

from sims import hand_held
from strapdown import ahrs
from strapdown.checks import InputError
from strapdown.consistency import reference_errors
from strapdown.recordings import unit_calibration
from strapdown.recordings.unit_calibration import UnitCalibration
from strapdown.records import ErrorStateEstimate

MATRIX = np.array([[0.02, 0.004, -0.003], [0.0, -0.015, 0.002], [0.005, 0.0, 0.01]])


def spoiled(run: int) -> hand_held.Recording:
    """A simulated hand whose gyro has the same matrix in each recording."""
    one = hand_held.simulated(3, run, 40.0)
    return dataclasses.replace(one, rate=one.rate @ (np.eye(3) + MATRIX).T)


def test_what_one_recording_shows_serves_the_next():
    first = ahrs.estimate(
        spoiled(0), dataclasses.replace(ahrs.HAND_HELD, gyro_scale_sigma=0.02), latency=0.0, smooth=True
    ).calibration
    # The simulated gyro has 0.3 % of its own, drawn anew in each recording.
    assert np.abs(first.matrix - MATRIX).max() < 0.02
    assert np.sqrt(np.mean((first.matrix - MATRIX) ** 2)) < 3.0 * np.hypot(first.sigma, 3e-3)
    errors = []
    for calibration in (None, dataclasses.replace(first, sigma=max(first.sigma, 3e-3))):
        found = ahrs.estimate(spoiled(2), latency=0.0, calibration=calibration)
        errors.append(reference_errors(found.estimate.attitude, found.recording.true_attitude).rms()["inclination"])
    assert errors[1] < 0.5 * errors[0]


def test_rates_are_corrected_and_corrections_follow_one_another():
    one = hand_held.simulated(1, 0, 4.0)
    known = UnitCalibration(matrix=MATRIX, sigma=1e-3)
    np.testing.assert_allclose(
        known.applied(dataclasses.replace(one, rate=one.rate @ (np.eye(3) + MATRIX).T)).rate, one.rate, atol=1e-13
    )
    values = np.array([[0.0] * 9, [1e-3, 2e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1e-3]])
    block = ErrorStateEstimate(
        components=("x", "xy", "xz", "yx", "y", "yz", "zx", "zy", "z"),
        units=("1",) * 9,
        values=values,
        variance=1e-8 * np.arange(18.0).reshape(2, 9),
    )
    after = unit_calibration.combined(known, block, 0.011, "next")
    further = np.array([[1e-3, 2e-3, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1e-3]])
    # what the filter sees after the correction by MATRIX is off by `further`: the gyro itself by both
    np.testing.assert_allclose(np.eye(3) + after.matrix, (np.eye(3) + MATRIX) @ (np.eye(3) + further), atol=1e-15)
    assert (after.sigma, after.magnetometer_delay, after.source) == (pytest.approx(np.sqrt(13e-8)), 0.011, "next")


def test_a_file_gives_it_back(tmp_path):
    known = UnitCalibration(matrix=MATRIX, sigma=1.2e-3, magnetometer_delay=0.0112, source="07.hdf5")
    path = tmp_path / "calibration.toml"
    path.write_text(unit_calibration.to_toml(known))
    found = unit_calibration.read(path)
    np.testing.assert_array_equal(found.matrix, MATRIX)
    assert (found.sigma, found.magnetometer_delay, found.source) == (1.2e-3, pytest.approx(0.0112), "07.hdf5")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[calibration]\nsigma = 1e-3\n", "lacks gyro_scale_and_misalignment"),
        ("[calibration]\ngyro_scale_and_misalignment = [[1.0, 0.0], [0.0, 1.0]]\nsigma = 1e-3\n", r"\(3, 3\)"),
        (
            "[calibration]\ngyro_scale_and_misalignment = [[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]\nsigma = 1e-3\n",
            "give M of I",
        ),
        ("[calibration]\nsigm = 1e-3\n", "did you mean 'sigma'"),
        ("[other]\n", "calibration"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, text, words):
    path = tmp_path / "calibration.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        unit_calibration.read(path)


def test_a_known_delay_of_the_magnetometer_is_used_from_the_start():
    known = UnitCalibration(matrix=np.zeros((3, 3)), sigma=1e-3, magnetometer_delay=0.011)
    found = ahrs.estimate(hand_held.simulated(1, 0, 4.0), calibration=known)
    np.testing.assert_array_equal(found.delays.field, np.full(len(found.recording.time), 0.011))
