"""Attitude and heading from recordings: one of known truth, and the shared BROAD trials."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from strapdown import ahrs, quaternion
from strapdown.ahrs import AhrsParameters
from strapdown.checks import InputError
from strapdown.consistency import reference_errors
from strapdown.recordings import Recording, read
from strapdown.units import DEGREE

RATE = 200.0
DIP = 1.1
START = Rotation.from_euler("ZYX", [40.0, 12.0, -25.0], degrees=True)


def path(time: np.ndarray) -> Rotation:
    """Attitude, body to East-North-Up: two seconds of rest, then turns about changing axes."""
    t = np.maximum(time - 2.0, 0.0)
    swing = t**2 / (1.0 + t**2)  # smooth at the start
    angles = np.stack([1.4 * np.sin(0.9 * t), 0.6 * np.sin(1.3 * t), 0.8 * (1.0 - np.cos(0.7 * t))], -1)
    return START * Rotation.from_euler("XYZ", swing[:, None] * angles)


def rates(time: np.ndarray) -> np.ndarray:
    """Body rate by fourth-order differences of SciPy's rotations."""
    h = 1e-3
    here = path(time)

    def turned(step: float) -> np.ndarray:
        return (here.inv() * path(time + step)).as_rotvec()

    return (8.0 * (turned(h) - turned(-h)) - (turned(2 * h) - turned(-2 * h))) / (12.0 * h)


def recording(duration: float = 30.0, bias: tuple[float, ...] = (0.0, 0.0, 0.0), noise: float = 0.0) -> Recording:
    time = 100.0 + np.arange(round(duration * RATE)) / RATE
    attitude = path(time - 100.0)
    random = np.random.default_rng(1)

    def seen(fixed: list[float], size: float) -> np.ndarray:
        return attitude.inv().apply(np.array(fixed)) + size * random.standard_normal((len(time), 3))

    return Recording(
        source="known truth",
        time=time,
        rate=rates(time - 100.0) + bias + 0.01 * noise * random.standard_normal((len(time), 3)),
        specific_force=seen([0.0, 0.0, 9.81], 0.1 * noise),
        magnetic_field=seen([0.0, 50.0 * np.cos(DIP), -50.0 * np.sin(DIP)], 0.5 * noise),
        true_attitude=np.roll(attitude.as_quat(), 1, axis=-1),
    )


def worst(result: ahrs.AhrsEstimate, after: float = 0.0) -> dict[str, float]:
    """Largest errors, degrees, from so many seconds on."""
    errors = reference_errors(result.estimate.attitude, result.recording.true_attitude)
    late = result.recording.time >= result.recording.time[0] + after
    return {name: getattr(errors, name)[late].max() / DEGREE for name in ("total", "heading", "inclination")}


# ---------------------------------------------------------------------------------------------------- known truth


def test_no_noise_gives_no_error_but_that_of_the_trapezoid_rule():
    result = ahrs.estimate(recording())
    assert worst(result)["total"] < 0.01
    assert np.abs(result.estimate.bias).max() < 1e-5
    assert dict(result.estimate.skipped) == {"accelerometer": 0, "magnetometer": 0}


def test_a_gyro_bias_is_found():
    bias = np.array([0.4, -0.3, 0.25]) * DEGREE
    result = ahrs.estimate(recording(120.0, bias=tuple(bias)))
    np.testing.assert_allclose(result.estimate.bias[-1], bias, atol=0.02 * DEGREE)
    assert worst(result, after=60.0)["total"] < 0.3
    # and the filter knows how well
    assert np.all(np.abs(result.estimate.bias[-1] - bias) < 4.0 * result.estimate.sigma[-1, 3:])


def test_sensor_noise_is_filtered():
    assert worst(ahrs.estimate(recording(noise=1.0)), after=5.0)["total"] < 1.0


def test_without_a_magnetometer_the_inclination_is_as_good():
    result = ahrs.estimate(dataclasses.replace(recording(), magnetic_field=None))
    assert worst(result)["inclination"] < 0.01
    # the heading starts anywhere, and keeps its error
    errors = reference_errors(result.estimate.attitude, result.recording.true_attitude)
    assert np.ptp(errors.heading) < 0.02 * DEGREE
    assert set(result.estimate.innovations) == {"accelerometer"}


def test_a_disturbed_field_turns_the_heading_only():
    """The magnetometer serves as the heading alone: whatever it says, the vertical stays."""
    plain = recording()
    field = plain.magnetic_field.copy()
    field[2000:3000] = plain.magnetic_field[2000:3000] @ Rotation.from_rotvec([0.3, 0.9, 0.2]).as_matrix()
    disturbed = ahrs.estimate(dataclasses.replace(plain, magnetic_field=field))
    assert worst(disturbed)["heading"] > 0.05
    assert worst(disturbed)["inclination"] < 0.2 * worst(disturbed)["heading"]


def test_how_the_unit_is_mounted_does_not_matter():
    """Turn the body axes: the attitude turns with them, and nothing else changes."""
    plain, mounting = recording(noise=1.0), Rotation.from_rotvec([0.7, -1.9, 0.4])
    turned = dataclasses.replace(
        plain,
        **{name: mounting.inv().apply(getattr(plain, name)) for name in ("rate", "specific_force", "magnetic_field")},
    )
    q = np.roll(mounting.as_quat(), 1)
    expected = quaternion.multiply(ahrs.estimate(plain).estimate.attitude, q)
    assert quaternion.angle_between(ahrs.estimate(turned).estimate.attitude, expected).max() < 1e-9


def test_units_of_the_magnetic_field_do_not_matter():
    plain = recording(noise=1.0)
    scaled = dataclasses.replace(plain, magnetic_field=1e-6 * plain.magnetic_field)
    difference = quaternion.angle_between(
        ahrs.estimate(plain).estimate.attitude, ahrs.estimate(scaled).estimate.attitude
    )
    assert difference.max() < 1e-9


def test_missing_samples_are_skipped_and_counted():
    plain = recording()
    force, field = plain.specific_force.copy(), plain.magnetic_field.copy()
    force[1000:1100] = np.nan
    field[1500:1510, 1] = np.nan
    gaps = dataclasses.replace(plain, specific_force=force, magnetic_field=field)
    result = ahrs.estimate(gaps)
    assert dict(result.estimate.skipped) == {"accelerometer": 100, "magnetometer": 10}
    assert worst(result)["total"] < 0.01


def test_half_the_rate_gives_the_same_within_the_trapezoid_rule():
    """The weight of a second of measurements does not depend on the recording's rate."""
    plain = recording(60.0, bias=(0.005, 0.0, 0.0), noise=0.0)
    half = dataclasses.replace(
        plain,
        **{
            name: getattr(plain, name)[::2]
            for name in ("time", "rate", "specific_force", "magnetic_field", "true_attitude")
        },
    )
    whole, sparse = ahrs.estimate(plain).estimate, ahrs.estimate(half).estimate
    assert quaternion.angle_between(whole.attitude[::2], sparse.attitude).max() < 0.05 * DEGREE
    np.testing.assert_allclose(whole.sigma[::2][100:], sparse.sigma[100:], rtol=0.03)


# ---------------------------------------------------------------------------------------------------- the start


def test_start_is_triad_of_the_quiet_second():
    plain = recording()
    state = ahrs.start(plain, ahrs.quiet_span(plain), AhrsParameters())
    assert float(quaternion.angle_between(state.attitude, plain.true_attitude[0])) < 1e-9
    np.testing.assert_array_equal(state.bias, np.zeros(3))


def test_quiet_span_is_the_first_quiet_second():
    plain = recording()
    assert ahrs.quiet_span(plain) == slice(0, round(RATE))
    # moving at first: shake most of the first second; the body rests in the second one
    shaken = plain.rate.copy()
    shaken[: round(0.9 * RATE)] += np.sin(np.arange(round(0.9 * RATE)))[:, None]
    later = dataclasses.replace(
        recording(noise=0.1), rate=shaken + 1e-4 * np.random.default_rng(2).standard_normal(shaken.shape)
    )
    span = ahrs.quiet_span(later)
    assert span == slice(round(RATE), 2 * round(RATE))
    result = ahrs.estimate(later)
    assert result.recording.time[0] == later.time[span.start]
    assert len(result.estimate.time) == len(result.recording.time)


def test_a_steady_turn_is_not_rest():
    """Its rate varies no more than at rest, but its vertical and its field turn: here from the second second on."""
    plain = recording(6.0)
    turning = np.zeros_like(plain.rate)
    turning[: 3 * round(RATE), 2] = 1.0
    steady = dataclasses.replace(plain, rate=turning + 1e-4 * np.random.default_rng(3).standard_normal(turning.shape))
    assert ahrs.quiet_span(steady).start == 3 * round(RATE)


def test_too_short_a_recording_is_refused():
    short = recording(0.8)
    with pytest.raises(InputError, match=r"known truth lasts 0\.795 s; the start needs at least 1 s"):
        ahrs.estimate(short)


@pytest.mark.parametrize("sensor", ["specific_force", "magnetic_field"])
@pytest.mark.filterwarnings("error")
def test_a_sensor_without_a_sample_at_the_start_is_refused(sensor):
    plain = recording(10.0)
    gone = getattr(plain, sensor).copy()
    gone[: round(1.2 * RATE)] = np.nan
    name = {"specific_force": "accelerometer", "magnetic_field": "magnetometer"}[sensor]
    with pytest.raises(InputError, match=f"known truth: the {name} has no valid sample in the first quiet second"):
        ahrs.estimate(dataclasses.replace(plain, **{sensor: gone}))


@pytest.mark.filterwarnings("error")
def test_a_magnetometer_that_reads_zero_is_a_missing_sample():
    plain = recording(10.0)
    field = plain.magnetic_field.copy()
    field[900] = 0.0
    assert ahrs.estimate(dataclasses.replace(plain, magnetic_field=field)).estimate.skipped["magnetometer"] == 1


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(AhrsParameters)])
@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_bad_parameters_are_refused(name, value):
    with pytest.raises(InputError, match=f"{name} is"):
        AhrsParameters(**{name: value})


# ---------------------------------------------------------------------------------------------------- BROAD


def test_mean_error_over_the_broad_trials(broad):
    """One parameter set for all: mean total RMSE over the movement below 6° (issue A), and no trial lost."""
    totals = {}
    for file in sorted(broad.glob("*.hdf5")):
        result = ahrs.estimate(read(file))
        errors = reference_errors(result.estimate.attitude, result.recording.true_attitude)
        totals[file.stem] = errors.rms(result.recording.movement)["total"] / DEGREE
    assert len(totals) >= 11
    assert 1.0 < np.mean(list(totals.values())) < 6.0, totals
    assert max(totals.values()) < 15.0, totals
