"""The live filter of an IMU against the online estimate of a recording of the same samples, bit for bit."""

from dataclasses import replace

import numpy as np
import pytest
from test_ahrs import late

from strapdown import ahrs, quaternion
from strapdown.ahrs import HAND_HELD_WITHOUT_MAGNETOMETER, AhrsParameters, LiveAhrs
from strapdown.checks import InputError
from strapdown.randomness import generator
from strapdown.recordings import Recording, read, sensor_delays

DRIFTING = replace(HAND_HELD_WITHOUT_MAGNETOMETER, rate_random_walk=1e-3)
"""A gyro whose bias is measured in nearly every second at rest."""


def swinging(duration=20.0, interval=0.01, jitter=0.0, shaken=0.0) -> Recording:
    """A unit at rest, or shaken in x by an acceleration, m/s², for two seconds; then swung; then tilted slowly, which is no rest."""
    draw = generator(11, 0, "samples")
    time = 50.0 + interval * np.arange(round(duration / interval))
    time += jitter * draw.uniform(-0.5, 0.5, len(time))
    since = time - time[0]
    swing = np.where((since > 0.3 * duration) & (since < 0.7 * duration), 1.0, 0.0)
    rate = swing[:, None] * np.stack([np.sin(3.0 * since), np.cos(2.0 * since), 0.5 * np.sin(since)], axis=1)
    tilt = np.radians(0.6) * np.maximum(since - 0.7 * duration, 0.0)
    rate[since >= 0.7 * duration, 0] += np.radians(0.6)
    up = np.stack([0.5 * swing * np.sin(since), np.sin(tilt), np.cos(tilt)], axis=1)
    rate += np.array([2e-3, -1e-3, 5e-4]) + draw.normal(0.0, 1e-3, rate.shape)
    force = 9.81 * up + draw.normal(0.0, 0.05, up.shape)
    force[:, 0] += np.where(since < 2.0, shaken * np.cos(15.0 * since), 0.0)
    return Recording(source="swinging", time=time, rate=rate, specific_force=force)


def with_missing(recording: Recording) -> Recording:
    """The recording without some samples of the accelerometer, for single stamps and for whole steps of the filter."""
    force = recording.specific_force.copy()
    force[7::11] = np.nan
    force[300:340] = 0.0
    return replace(recording, specific_force=force)


def rows_live(recording: Recording, **options) -> tuple[np.ndarray, ...]:
    field = recording.magnetic_field
    live = LiveAhrs(interval=float(np.median(np.diff(recording.time))), magnetometer=field is not None, **options)
    rows = []
    columns = recording.time, recording.rate, recording.specific_force, recording.time if field is None else field
    for time, rate, force, vector in zip(*columns, strict=True):
        live.update(time, rate, force, None if field is None else vector)
        rows.append((live.attitude, live.bias, live.variance, live.covariance))
    assert live.time == recording.time[-1]
    return tuple(map(np.array, zip(*rows, strict=True)))


def need_equal(recording: Recording, parameters: AhrsParameters | None = None, **options) -> ahrs.AhrsEstimate:
    """Require the same bits in each row but the last; return the estimate of the recording."""
    result = ahrs.estimate(recording, parameters, full_covariance=True, **options)
    live = rows_live(result.recording, parameters=parameters, **options)
    rows = result.estimate
    for mine, its in zip(live, (rows.attitude, rows.bias, rows.variance, rows.covariance), strict=True):
        np.testing.assert_array_equal(mine[:-1], its[:-1])
    return result


@pytest.mark.parametrize(
    "parameters",
    [None, DRIFTING, pytest.param(AhrsParameters(), marks=pytest.mark.slow)],
    ids=["hand", "drifting", "six states"],
)
def test_each_sample_gives_the_row_of_the_recording(parameters):
    result = need_equal(with_missing(swinging()), parameters)
    assert (len(result.rests.last) > 3) == (parameters is DRIFTING)
    assert result.rests.last.max(initial=0) < 600  # neither the swing nor the slow turn is a rest
    assert not result.faults.words


def test_a_magnetometer_with_iron_in_the_unit_and_a_disturbed_field():
    """With iron of a tenth of the field, which is subtracted once the unit has turned, and samples of one sensor or both missing."""
    plain = with_missing(swinging())
    time = plain.time - plain.time[0]
    turned = quaternion.conjugate(sensor_delays.gyro_attitude(plain))
    fixed = np.where(time[:, None] > 12.0, [2.0, 20.0, -35.0], [0.0, 20.0, -43.0])
    field = quaternion.rotate(turned, fixed) + np.array([4.0, -2.0, 1.0])
    field += generator(12, 0, "field").normal(0.0, 0.3, field.shape)
    field[5::13] = np.nan
    field[320:350] = 0.0
    result = need_equal(replace(plain, magnetic_field=field))
    assert not np.any(result.delays.field)
    assert np.linalg.norm(result.hard_iron) > 1.0


def test_damaged_samples_are_left_out():
    """Three in a row, which as they are turn the attitude by 10°; and a field of ten times its strength."""
    plain = swinging(duration=12.0)
    force, field = plain.specific_force.copy(), np.tile([0.0, 20.0, -43.0], (len(plain.time), 1))
    plain = replace(plain, magnetic_field=field.copy())
    force[500:503], field[700:702] = (
        [[800.0, 0.0, 100.0], [0.0, 900.0, 0.0], [-300.0, 200.0, 10.0]],
        [400.0, 0.0, 300.0],
    )
    damaged = replace(plain, specific_force=force, magnetic_field=field)
    rows = ahrs.estimate(damaged, full_covariance=True).estimate
    live = rows_live(damaged)
    for mine, its in zip(live, (rows.attitude, rows.bias, rows.variance, rows.covariance), strict=True):
        np.testing.assert_array_equal(mine[:-1], its[:-1])
    assert quaternion.angle_between(live[0], rows_live(plain)[0]).max() < np.radians(0.5)


@pytest.mark.parametrize("magnetometer", [False, True])
def test_a_start_in_motion_is_aligned_by_the_means_over_a_second(magnetometer):
    """The first sample is tilted by 45°."""
    shaken = with_missing(swinging(duration=8.0, shaken=10.0))
    if magnetometer:
        still = quaternion.conjugate(sensor_delays.gyro_attitude(shaken))
        field = quaternion.rotate(still, [0.0, 20.0, -43.0]) + generator(12, 0, "field").normal(0.0, 0.3, (800, 3))
        shaken = replace(shaken, magnetic_field=field)
    result = need_equal(shaken)
    tilt = quaternion.to_matrix(result.estimate.attitude)[:, 2, 2]
    assert tilt[0] < 0.72
    assert np.all(tilt[105:200] > np.cos(np.radians(20.0)))


def test_a_known_delay_of_the_magnetometer_is_made_good_by_the_gyro():
    """As the class says; of 11 ms at up to 8 rad/s."""
    recording = late(field=0.011)
    field = recording.magnetic_field - 0.011 * np.cross(recording.rate, recording.magnetic_field)
    rows = (rows_live(replace(recording, magnetic_field=m), latency=0.0)[0] for m in (recording.magnetic_field, field))
    late_by, right = (np.sqrt(np.mean(quaternion.angle_between(q, recording.true_attitude)[1000:] ** 2)) for q in rows)
    assert right < 0.1 * late_by


def test_stamps_that_jitter_and_a_known_delay():
    need_equal(swinging(interval=1.0 / 286.0, jitter=1e-3), latency=0.003)


def test_a_row_of_a_recording_depends_on_the_samples_up_to_it_alone():
    whole = swinging()
    half = whole.taken(slice(1000))
    first, second = (ahrs.estimate(recording).estimate for recording in (half, whole))
    np.testing.assert_array_equal(first.attitude[:-1], second.attitude[:999])
    np.testing.assert_array_equal(first.variance[:-1], second.variance[:999])


def test_recordings_in_the_hand_and_of_an_aircraft(broad, monkeypatch):
    hand = read(broad / "07_undisturbed_fast_rotation_B.hdf5")
    need_equal(replace(hand, magnetic_field=None))
    monkeypatch.setattr(sensor_delays, "_fitted", lambda *_: (0.0, np.inf))
    result = need_equal(hand)
    assert result.rests.last.size
    aircraft = broad.parent / "euroc" / "V1_02_medium.hdf5"
    if not aircraft.exists():
        pytest.skip("the shared recordings of EuRoC are absent")
    need_equal(read(aircraft))


def test_it_starts_at_the_first_specific_force():
    live = LiveAhrs(interval=0.01, latency=0.0)
    live.update(1.0, (0.0, 0.0, 0.1))
    live.update(1.01, (0.0, 0.0, 0.1), (0.0, 0.0, 0.0))
    assert np.isnan(live.attitude).all()
    live.update(1.02, [0.0, 0.0, 0.1], [0.0, 9.81 * np.sin(0.3), 9.81 * np.cos(0.3)])
    assert 2.0 * np.arctan2(live.attitude[1], live.attitude[0]) == pytest.approx(0.3)
    assert live.time == 1.02


@pytest.mark.parametrize(
    ("sample", "message"),
    [
        ((np.nan, (0, 0, 0), (0, 0, 9.8)), "time is nan s"),
        ((0.3, (0, 0, 0), (0, 0, 9.8)), "time is 0.3 s, not after the last sample"),
        ((1.7e9, (0, 0, 0), (0, 0, 9.8)), r"time is 1.7e\+09 s, more than an hour after the last sample"),
        ((0.31, (0, np.nan, 0), (0, 0, 9.8)), "gyro has a NaN"),
        ((0.31, (0, 1e5, 0), (0, 0, 9.8)), r"give finite numbers, rates in rad/s"),
        ((0.31, (0, 0, 0), (0, 0, np.inf)), r"give finite numbers"),
        ((0.31, (0, 0, 0), (0, -3000, 9.8)), r"specific force in m/s² below 1000"),
        ((0.31, (0, 0), (0, 0, 9.8)), r"gyro is \(0, 0\); give three numbers"),
        ((0.31, (0, 0, 0), "abc"), r"accelerometer is 'abc'; give three numbers"),
        ((10**400, (0, 0, 0), (0, 0, 9.8)), r"time is 1000+; give one number"),
        ((0.31, (0, 0, 0), (0, 0, 9.8), (1, 0, 0)), r"this filter has none; start LiveAhrs\(magnetometer=True\)"),
    ],
)
def test_bad_samples_are_refused_and_leave_the_filter_as_it_was(sample, message):
    first, second = LiveAhrs(interval=0.01), LiveAhrs(interval=0.01)
    for k in range(31):
        for live in (first, second):
            live.update(0.01 * k, (0.1, 0.0, 0.2), (0.0, 1.0, 9.7))
    with pytest.raises(InputError, match=message):
        first.update(*sample)
    for k in range(31, 50):
        for live in (first, second):
            live.update(0.01 * k, (0.1, 0.0, 0.2), (0.0, 1.0, 9.7))
    np.testing.assert_array_equal(first.covariance, second.covariance)
    np.testing.assert_array_equal(first.attitude, second.attitude)


@pytest.mark.parametrize(("name", "value"), [("magnetometer", "yes"), ("parameters", "vehicle")])
def test_arguments_of_another_class_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=f"{name} is '{value}', not of class"):
        LiveAhrs(interval=0.01, **{name: value})


def test_a_rate_is_no_interval():
    with pytest.raises(InputError, match=r"interval is 100 s; give that of the samples"):
        LiveAhrs(interval=100)


def test_parameters_for_a_magnetometer_are_refused_without_one():
    parameters = ahrs.MOTIONS["vehicle"][0]
    words = r"hard_iron_sigma is 0.04, but there is no magnetometer; .*, such as ahrs.MOTIONS\['hand'\]\[1\]"
    with pytest.raises(InputError, match=words):
        LiveAhrs(interval=0.01, parameters=parameters)
    with pytest.raises(InputError, match=words):
        ahrs.estimate(swinging(), parameters)


def test_samples_far_faster_than_declared_are_refused():
    live = LiveAhrs(interval=0.01)
    for k in range(14):
        live.update(1e-4 * k, (0.1, 0.0, 0.2), (0.0, 1.0, 9.7))
    with pytest.raises(InputError, match=r"far below 0.01 s, their usual interval"):
        live.update(14e-4, (0.1, 0.0, 0.2), (0.0, 1.0, 9.7))
