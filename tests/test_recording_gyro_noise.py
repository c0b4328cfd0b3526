"""The noise of a gyro, flicker and all, in the filter of a recording: what `strapdown allan` writes is what `--gyro` reads."""

import numpy as np
import pytest

import strapdown as sd
from strapdown import ahrs, gyro, units, workflows

FLICKER = 20.0 * units.DEGREE_PER_HOUR


@pytest.fixture
def table(tmp_path):
    """Twenty seconds of a unit that lies still for three and is then rolled about, with its true roll, rad."""
    random, time = np.random.default_rng(5), 0.01 * np.arange(2000)
    rate = np.where(time > 3.0, 40.0 * np.sin(np.pi * (time - 3.0)), 0.0)
    roll = np.radians(np.cumsum(rate) * 0.01)
    turn = np.stack([rate, 0.0 * time, 0.0 * time], axis=1) + 0.05 * random.standard_normal((2000, 3))
    force = np.stack([0.0 * time, np.sin(roll), np.cos(roll)], axis=1) + 2e-3 * random.standard_normal((2000, 3))
    path = tmp_path / "walk.csv"
    header = "time,gx [deg/s],gy [deg/s],gz [deg/s],ax [g],ay [g],az [g]"
    np.savetxt(path, np.column_stack([time, turn, force]), delimiter=",", header=header, comments="")
    return path, roll


def test_the_file_of_an_allan_fit_with_flicker_serves_a_recording(table, succeeds, tmp_path):
    path, roll = table
    text = "[gyro]\nangle_random_walk_deg_per_sqrt_hour = [0.3, 0.3, 0.3]\nbias_instability_deg_per_hour = [20.0, 20.0, 20.0]\n"
    (tmp_path / "gyro.toml").write_text(text)
    succeeds("estimate", path, "--gyro", "gyro.toml", "--out", "found")
    estimate = sd.read(tmp_path / "found" / "estimate.h5")
    error = estimate.rotation.as_euler("ZYX")[:, 2] - roll[-len(estimate.time) :]
    assert np.sqrt(np.mean(error**2)) < np.radians(0.5)


def test_flicker_is_covered_at_every_frequency_that_the_filter_of_the_tilt_follows():
    """At the natural frequency ω of the filter the covering spectrum σ_v² + σ_u²/ω² is at least 2/π of the flicker's, B²/ω."""
    spec = gyro.GyroSpec(angle_random_walk=1e-4, bias_instability=FLICKER)
    for parameters in ahrs.MOTIONS.values():
        found = workflows.with_gyro_noise(parameters, spec)
        white = found.angle_random_walk**2 - spec.angle_random_walk**2
        walk = found.rate_random_walk**2
        assert white > 0.0
        assert walk > 0.0
        natural = np.sqrt(walk / white)  # where the two parts of the covering spectrum cross
        share = (white + walk / natural**2) / (FLICKER**2 / natural)
        assert 2.0 / np.pi <= share <= 1.0 + 1e-12
        density = (parameters.specific_force_noise / units.STANDARD_GRAVITY) ** 2
        assert natural**4 == pytest.approx(walk / density, rel=1e-6)  # Farrenkopf's limit: ω⁴ = σ_u²/r


def test_a_gyro_without_flicker_keeps_its_own_noise():
    spec = gyro.GyroSpec(angle_random_walk=1e-4, rate_random_walk=2e-6)
    found = workflows.with_gyro_noise(ahrs.MOTIONS["hand"], spec)
    assert (found.angle_random_walk, found.rate_random_walk) == (1e-4, 2e-6)
