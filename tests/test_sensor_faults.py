"""Clipped samples and gaps: recognised, restored as far as can be, and uncertain by as much as they are off."""

import dataclasses
import itertools

import numpy as np
import pytest
from measured import by_sensors, rates
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import strapdown as sd
from strapdown import ahrs, quaternion
from strapdown.ahrs import check_conventions, estimating
from strapdown.kernels import recording_samples
from strapdown.kernels.machine import compiled, read_only
from strapdown.recordings import Recording, sensor_delays, sensor_faults
from strapdown.records.recording import SENSORS, sampled
from strapdown.units import DEGREE

RATE = 200.0


def swing(duration: float = 40.0) -> Recording:
    """A unit at rest for 2 s that then swings about its x axis at up to 8 rad/s, and slowly about the vertical; noise of a MEMS unit."""

    def attitude(time: np.ndarray) -> Rotation:
        since = np.maximum(time - 2.0, 0.0)
        size = since**2 / (1.0 + since**2)
        return Rotation.from_euler(
            "ZX", size[:, None] * np.stack([0.3 * np.sin(0.5 * since), 1.3 * np.sin(6.0 * since)], -1)
        )

    time = np.arange(round(duration * RATE)) / RATE
    field, noise = (0.0, 20.0, -45.0), (2e-3, 0.05, 0.3)
    return by_sensors("swing", time, attitude(time), rates(time, attitude), field=field, noise=noise, seed=3)


def with_rate(recording: Recording, limit: float) -> Recording:
    return dataclasses.replace(recording, rate=np.clip(recording.rate, -limit, limit))


def interpolated(rate: np.ndarray) -> list[tuple[int, int]]:
    return sensor_faults.interpolated(rate, sensor_faults.second_differences(rate))


def test_samples_at_the_limit_are_recognised():
    plain = swing().rate
    clipped = np.clip(plain, -5.0, 5.0)
    np.testing.assert_array_equal(sensor_faults.clipped_samples(clipped, 1.0), np.abs(plain) >= 5.0)
    assert not sensor_faults.clipped_samples(plain, 1.0).any()
    one_side = np.minimum(plain, 5.0)
    np.testing.assert_array_equal(sensor_faults.clipped_samples(one_side, 1.0), plain >= 5.0)


def test_a_quantised_sensor_that_repeats_samples_at_rest_may_be_clipped():
    moving = np.round(swing().rate, 2)
    plain = np.concatenate([np.zeros((4000, 3)), moving])
    clipped = sensor_faults.clipped_samples(np.clip(plain, -5.0, 5.0), 1.0)
    np.testing.assert_array_equal(clipped, np.abs(plain) >= 5.0)


def test_rows_of_nan_or_of_zeros_are_no_samples():
    rows = np.array(
        [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, np.nan, 1.0], [1.0, -1.0, 0.0]]
    )
    np.testing.assert_array_equal(sampled(rows), [True, True, True, False, False, True])


def test_quantised_rest_and_held_samples_are_not_clipped():
    random = np.random.default_rng(1)
    rest = np.round(0.02 * random.standard_normal((2000, 3)), 2)
    assert not sensor_faults.clipped_samples(rest, 1.0).any()
    held = np.repeat(swing().rate[::4], 4, axis=0)
    assert not sensor_faults.clipped_samples(held, 1.0).any()
    peaks = np.sin(0.5 * np.pi * np.arange(1, 18))[:, None] * [5.0, 0.0, 0.0]  # from its largest value on, each alone
    assert not sensor_faults.clipped_samples(peaks, 1.0).any()


@pytest.mark.parametrize("limit", [5.0, 6.5])
def test_a_clipped_rate_is_restored_to_within_its_sigma(limit):
    plain = swing()
    clipped = with_rate(plain, limit)
    rate, variance, at = sensor_faults.restored(plain.time, clipped.rate)
    starts = np.flatnonzero(np.diff(at[:, 0].astype(int)) == 1)
    assert len(starts) > 20
    runs = (
        np.array([np.sum((plain.rate - rate)[first : first + 40, 0] * at[first : first + 40, 0]) for first in starts])
        / RATE
    )
    sigma = np.array([np.sqrt(np.sum(variance[first : first + 30, 0])) for first in starts])
    off = np.sqrt(np.mean(runs**2))
    beyond = (
        np.sqrt(np.mean([np.sum((plain.rate - clipped.rate)[f : f + 40, 0] * at[f : f + 40, 0]) ** 2 for f in starts]))
        / RATE
    )
    assert off < 0.4 * beyond
    # Hands are not as smooth as this swing: on the BROAD trials, clipped, 0.3 to 0.5 of what is beyond is missed.
    assert off < np.sqrt(np.mean(sigma**2))
    assert 0.3 * beyond < np.sqrt(np.mean(sigma**2)) < 0.7 * beyond
    np.testing.assert_array_equal(rate[~at], plain.rate[~at])
    assert np.all(np.abs(rate[at]) >= limit)


def test_the_variance_of_a_restored_turn_is_spread_over_its_intervals():
    """σ of the turn beyond the limit is half of it, whatever the number of intervals from the sample before the run to that after it.

    The turns about the other axes are known.
    """
    plain = swing()
    only_x = dataclasses.replace(plain, rate=plain.rate * [1.0, 0.0, 0.0])
    rate, variance, at = sensor_faults.restored(plain.time, with_rate(only_x, 5.0).rate)
    expected = np.zeros(variance.shape)
    for first, stop in np.flatnonzero(np.diff(at[:, 0].astype(int))).reshape(-1, 2) + 1:
        turn = np.sum(np.abs(rate[first:stop, 0]) - 5.0) / RATE
        slopes = RATE * np.diff(only_x.rate[[first - 2, first - 1, stop, stop + 1], 0])[[0, 2]]
        ends = [first - 1, stop]
        cubic = CubicHermiteSpline(plain.time[ends], only_x.rate[ends, 0], slopes)(plain.time[first:stop])
        np.testing.assert_allclose(np.abs(rate[first:stop, 0]), np.maximum(np.abs(cubic), 5.0), rtol=1e-9)
        expected[first - 1 : stop, 0] += (0.5 * turn) ** 2 / (stop - first + 1)
    np.testing.assert_allclose(variance, expected, rtol=1e-9, atol=1e-18)
    assert np.count_nonzero(variance[:, 0]) > 1000


def test_only_the_turn_about_the_clipped_axis_is_uncertain():
    """σ about the other axes is that without clipping, to the tenth, while that about x grows by the turn that is missed.

    Hard iron, which such turns do not show, is left out.
    """
    plain, unit = swing(), dataclasses.replace(ahrs.HAND_HELD, unshown_iron_sigma=0.0)
    sigma = []
    for recording in (plain, with_rate(plain, 5.0)):
        ahrs_estimate = ahrs.estimate(recording, unit, latency=0.0)
        sigma.append(np.sqrt(ahrs_estimate.estimate.variance[:, :3]))
    run = np.flatnonzero(ahrs_estimate.faults.turn_variance[:, 0])
    ratio = (sigma[1] / sigma[0])[run[run > 5.0 * RATE] + 1]
    assert np.median(ratio[:, 0]) > 1.5
    assert np.all(np.abs(np.median(ratio[:, 1:], axis=0) - 1.0) < 0.1)


def test_an_uncertain_turn_is_added_before_its_step_and_a_small_one_with_those_that_follow():
    small = estimating.SMALL_TURN**2
    steps = small * np.array([[0.0, 0.0, 0.0], [0.4, 0.1, 0.0], [0.7, 0.0, 0.0], [9.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
    expected = small * np.array([[0.0] * 3] * 2 + [[1.1, 0.1, 0.0], [9.0, 3.0, 0.0]] + [[0.0] * 3] * 2)
    np.testing.assert_allclose(estimating.uncertain_turns(steps), expected, rtol=1e-12, atol=1e-18)


def test_the_turn_over_a_gap_is_that_of_a_brownian_bridge():
    """A rate that is a random walk of density s² turns by s² T³/12 about the mean of the rates at both ends."""
    random, dt, density = np.random.default_rng(2), 1e-3, 4.0
    time = np.arange(400_000) * dt
    rate = np.cumsum(np.sqrt(density * dt) * random.standard_normal((len(time), 3)), axis=0)
    length = 0.05
    lengths = length * np.array([1.0, 2.0, 1.0])
    variance = sensor_faults.turn_variance_over(rate, lengths, dt)
    np.testing.assert_allclose(variance, density * lengths**3 / 12.0, rtol=0.05)


def test_the_turn_over_a_gap_that_is_long_for_the_motion():
    """A rate of variance s², first-order Gauss–Markov with time constant c: the variance in closed form, and the errors themselves."""
    random, dt, c, s = np.random.default_rng(3), 0.01, 0.3, 1.5
    kept = np.exp(-dt / c)
    drive = s * np.sqrt(1.0 - kept**2) * random.standard_normal((400_000, 3))
    rate = lfilter([1.0], [1.0, -kept], drive, axis=0)[1000:]
    length = np.array([0.05, 0.3, 1.0, 4.0])
    variance = sensor_faults.turn_variance_over(rate, length, dt)
    x = length / c
    # E (T (w₀ + w_T)/2 − ∫ w)², by integration of the autocorrelation s² exp(−|τ|/c)
    ends = x**2 * (1.0 + np.exp(-x)) / 2.0
    between = 2.0 * x * (1.0 - np.exp(-x))
    inside = 2.0 * (x - 1.0 + np.exp(-x))
    np.testing.assert_allclose(variance, (s * c) ** 2 * (ends - between + inside), rtol=0.05)
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]), axis=0)])
    for T, expected in zip(length, variance, strict=True):
        n = round(T / dt)
        error = angle[n:] - angle[:-n] - 0.5 * T * (rate[n:] + rate[:-n])
        assert np.mean(error**2) == pytest.approx(expected, rel=0.05)


def test_the_turn_over_a_gap_of_a_rate_that_changes_steadily_is_known():
    ramp = np.outer(np.arange(5000) * 0.01, [1.0, -2.0, 0.5])
    length = np.array([0.5, 2.0])
    change = np.mean((length[:, None] * [1.0, -2.0, 0.5]) ** 2, axis=1)
    assert np.all(sensor_faults.turn_variance_over(ramp, length, 0.01) < 0.01 * length**2 * change)


def off_by(recording: Recording, **options: bool) -> tuple[np.ndarray, np.ndarray, ahrs.AhrsEstimate]:
    """Errors of the attitude, rad, and NEES of it, from 3 s on."""
    ahrs_estimate = ahrs.estimate(recording, latency=0.0, full_covariance=True, **options)
    used, q = ahrs_estimate.recording, ahrs_estimate.estimate.attitude
    error = quaternion.log(quaternion.multiply(quaternion.conjugate(q), used.true_attitude))
    nees = np.einsum(
        "ki,ki->k", error, np.linalg.solve(ahrs_estimate.estimate.covariance[:, :3, :3], error[..., None])[..., 0]
    )
    late = used.time > 3.0
    return np.linalg.norm(error, axis=1)[late], nees[late], ahrs_estimate


@pytest.mark.parametrize("smooth", [False, True])
def test_sigma_holds_where_the_gyro_was_clipped(smooth, monkeypatch):
    clipped = with_rate(swing(), 5.0)
    error, nees, ahrs_estimate = off_by(clipped, smooth=smooth)
    assert np.mean(nees < 7.81) > 0.9
    assert "The gyro was clipped: x at 286.5 °/s" in ahrs_estimate.faults.words[0]
    assert np.sqrt(np.mean(error**2)) < 15.0 * DEGREE
    # taken as it is
    monkeypatch.setattr(sensor_faults, "MIN_CLIPPED_RATE", 100.0)
    error_then, nees_then, _ = off_by(clipped, smooth=smooth)
    assert np.mean(error_then**2) > 2.0 * np.mean(error**2)
    assert np.mean(nees_then < 7.81) < 0.5


def test_sigma_grows_over_a_dropout():
    plain = swing()
    kept = np.ones(len(plain.time), bool)
    for begin in (10.0, 20.0, 30.0):
        kept[round(begin * RATE) : round((begin + 0.2) * RATE)] = False
    _, nees, ahrs_estimate = off_by(plain.taken(kept))
    assert (
        "Intervals between stamps longer than 1.5 median ones: 3, the longest 0.205 s after 9.99"
        in ahrs_estimate.faults.words[0]
    )
    assert np.mean(nees < 7.81) > 0.9
    lost, length = round(0.205 * RATE), np.array([0.205])
    attitude, first = sensor_delays.gyro_attitude(plain), np.arange(round(3.0 * RATE), len(plain.time) - lost)
    turn = quaternion.multiply(quaternion.conjugate(attitude[first]), attitude[first + lost])
    by_ends = quaternion.exp(0.5 * length * (plain.rate[first] + plain.rate[first + lost]))
    off = quaternion.log(quaternion.multiply(quaternion.conjugate(by_ends), turn))
    added = sensor_faults.turn_variance_over(plain.rate, length, 1.0 / RATE)
    assert added == pytest.approx(np.mean(off**2), rel=0.15)
    variance = ahrs_estimate.estimate.variance[:, :3].sum(axis=1)
    row = int(np.searchsorted(ahrs_estimate.recording.time, 20.1))
    assert variance[row] - variance[row - 1] == pytest.approx(3.0 * added, rel=0.6)


LSB = 1e-3


def quantised(rounding, duration: float = 120.0, noise: float = 1.5) -> tuple[Recording, np.ndarray]:
    """The swing with a bias and a gyro that gives whole numbers of a step, and the rates before."""
    plain = swing(duration)
    random = np.random.default_rng(7)
    rate = plain.rate + [2.2 * LSB, -3.1 * LSB, 0.4 * LSB] + noise * LSB * random.standard_normal(plain.rate.shape)
    return dataclasses.replace(plain, rate=LSB * rounding(rate / LSB)), rate


@pytest.mark.parametrize("rounding", [np.round, np.floor, np.ceil, lambda x: x])
@pytest.mark.parametrize("noise", [0.2, 1.5, 3.0])
def test_only_truncated_rates_are_taken_for_such(rounding, noise):
    assert sensor_faults.truncation_step(quantised(rounding, noise=noise)[0].rate) is None


@pytest.mark.parametrize(("rounding", "truncated"), [(np.round, False), (np.trunc, True)])
def test_zeros_at_rest_are_no_sign_of_truncation(rounding, truncated):
    """A gyro whose noise is a fraction of a step gives many zeros at rest, however it rounds; it turns for half of the time."""
    time = np.arange(40_000) / RATE
    turning = np.where(time < 100.0, 0.0, np.sin(0.9 * (time - 100.0)))[:, None] * [1.0, 0.7, 0.4]
    rate = turning + 0.3 * LSB * np.random.default_rng(9).standard_normal((len(time), 3))
    assert (sensor_faults.truncation_step(LSB * rounding(rate / LSB)) is not None) == truncated


def test_a_truncated_gyro_shows_the_same_bias_at_rest_and_in_motion():
    truncated, rate = quantised(np.trunc)
    assert sensor_faults.truncation_step(truncated.rate) == pytest.approx(LSB, rel=1e-3)
    faults = sensor_faults.find(truncated)
    assert "multiples of 0.0573 °/s truncated toward zero" in faults.words[0]
    resting = truncated.time < 2.0
    for samples in (resting, ~resting):
        assert np.abs(np.mean((faults.recording.rate - rate)[samples], axis=0)).max() < 0.1 * LSB
    assert np.abs(np.mean((truncated.rate - rate)[resting], axis=0)).max() > 0.3 * LSB


def filled(plain: Recording, *spans: tuple[float, float], held: bool = False) -> Recording:
    """The recording with straight lines from begin to end of each span, s, in every sensor, or with its first sample held."""
    samples = {name: getattr(plain, name).copy() for name in ("rate", "specific_force", "magnetic_field")}
    for begin, end in spans:
        first, last = round(begin * RATE), round(end * RATE)
        u = np.linspace(0.0, 1.0, last - first + 1)[:, None]
        for values in samples.values():
            values[first : last + 1] = np.where(
                held & (u < 1.0), values[first], (1.0 - u) * values[first] + u * values[last]
            )
    return dataclasses.replace(plain, **samples)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("smooth", [False, True])
def test_a_gap_filled_by_interpolation_is_a_gap(smooth, held):
    """Neither its samples count nor its steady rate as rest; as if the last sample before it was repeated."""
    spans = ((10.0, 10.2), (20.0, 20.4), (38.0, 39.9))
    plain = swing()
    broken = filled(plain, *spans, held=held)
    rows = np.rint(RATE * np.array(spans)).astype(int)
    assert interpolated(broken.rate) == [tuple(span) for span in rows.tolist()]
    _, nees, ahrs_estimate = off_by(broken, smooth=smooth)
    assert "Gaps filled by interpolation or repeated samples: 3, up to 1.9 s" in ahrs_estimate.faults.words[0]
    gap = np.concatenate([np.arange(first + 1, last) for first, last in rows])
    lead = round(sensor_faults.LEAD * RATE)
    left_out = np.concatenate([np.arange(first + 1 - lead, last) for first, last in rows])
    for samples in (ahrs_estimate.recording.specific_force, ahrs_estimate.recording.magnetic_field):
        np.testing.assert_array_equal(np.flatnonzero(~sampled(samples)), left_out)
    assert np.mean(nees < 7.81) > 0.9
    within = nees[gap - np.sum(plain.time <= 3.0)]
    assert np.mean(within < 7.81) > 0.7 + 0.1 * smooth  # the smoother knows the attitude at both ends, but not within
    assert not np.intersect1d(ahrs_estimate.rests.last, gap).size
    assert np.abs(ahrs_estimate.estimate.bias[-1]).max() < 0.5 * DEGREE


def test_the_turn_over_a_long_gap_has_a_variance_of_one():
    """No more is known of it than that it is a turn."""
    variance = sensor_faults.find(filled(swing(80.0), (5.0, 35.0))).turn_variance
    np.testing.assert_allclose(variance.max(axis=0), 1.0, rtol=1e-9)


def test_straight_lines_of_a_still_or_noisy_gyro_are_no_gaps():
    level = np.zeros((200, 3))
    level[100:, 1] = 0.01  # a coarse gyro
    assert interpolated(level) == []
    assert interpolated(np.random.default_rng(1).normal(0.0, 1e-3, (5000, 3))) == []
    assert interpolated(np.zeros((5, 3))) == []
    slow = np.sin(0.11 * np.outer(np.arange(500), [1.0, 1.5, 2.0]))  # some of its changes are above 0.2 rad/s
    assert interpolated(np.repeat(slow, 20, axis=0)) == []


def test_a_gyro_sampled_too_slowly_is_reported_with_its_error():
    """The error of the trapezoidal rule for a sinusoid: T (ω₀ + ω₁)/2 less its integral."""
    frequency, time = 6.0, np.arange(0.0, 40.0, 0.1)
    rate = np.zeros((len(time), 3))
    rate[:, 1] = 3.0 * np.sin(frequency * time)
    slow = dataclasses.replace(swing(4.0).taken(slice(len(time))), time=time, rate=rate)
    error = 0.05 * (rate[1:, 1] + rate[:-1, 1]) + 3.0 / frequency * np.diff(np.cos(frequency * time))
    (words,) = sensor_faults.find(slow).words
    assert "samples at 10 Hz" in words
    reported = float(words.partition("about ")[2].split()[0]) * DEGREE
    assert reported == pytest.approx(np.sqrt(np.mean(error**2) / 0.1), rel=0.05)
    assert sensor_faults.find(dataclasses.replace(slow, rate=0.1 * rate)).words == ()


def test_a_clipped_accelerometer_is_left_out():
    plain = swing()
    force = plain.specific_force + 30.0 * np.sin(40.0 * plain.time)[:, None] * (plain.time > 5.0)[:, None]
    clipped = np.clip(force, -19.6, 19.6)
    faults = sensor_faults.find(dataclasses.replace(plain, specific_force=clipped))
    lost = np.any(np.abs(force) >= 19.6, axis=1)
    np.testing.assert_array_equal(np.isnan(faults.recording.specific_force).all(axis=1), lost)
    assert f"clipped in {np.sum(lost)} samples" in faults.words[0]


def test_a_sensor_that_is_often_clipped_is_warned_of():
    plain = swing()
    force = np.clip(
        plain.specific_force + 30.0 * np.sin(40.0 * plain.time)[:, None] * (plain.time > 5.0)[:, None], -19.6, 19.6
    )
    for sensor, clipped in (
        ("gyro", with_rate(plain, 4.0)),
        ("accelerometer", dataclasses.replace(plain, specific_force=force)),
    ):
        with pytest.warns(ahrs.ConventionWarning, match=f"the {sensor} is clipped in .*% of its samples.*larger"):
            sd.estimate(clipped)
    assert not sensor_faults.clipped_words(with_rate(plain, 7.8))


@pytest.mark.parametrize("sensor", ["accelerometer", "magnetometer"])
def test_samples_that_a_slow_sensor_repeats_are_reported(sensor):
    plain, name = swing(), SENSORS[sensor]
    k = np.arange(len(plain.time))
    faults = sensor_faults.find(dataclasses.replace(plain, **{name: getattr(plain, name)[k // 8 * 8]}))
    turns = np.linalg.norm(plain.rate, axis=1) > 0.2
    ignored = turns & (k % 8 > 0) & (sensor == "accelerometer")
    np.testing.assert_array_equal(np.isnan(getattr(faults.recording, name)[:, 0]), ignored)
    assert f"The {sensor} is slower than the gyro" in faults.words[0]
    level = np.where(
        k[:, None] < 0.7 * len(k), [0.0, 0.0, 9.81], getattr(plain, name)
    )  # without noise, about the vertical
    assert sensor_faults.repeated_samples(dataclasses.replace(plain, **{name: level})) == {}


def with_damaged(name: str, rows: slice, size: float) -> tuple[Recording, Recording]:
    """A recording, and the same with samples of a size in any direction; each of these is different."""
    plain = swing(10.0)
    samples = getattr(plain, name).copy()
    draw = np.random.default_rng(8).standard_normal((len(samples), 3))[rows]
    samples[rows] = size * draw / np.linalg.norm(draw, axis=1, keepdims=True)
    return plain, dataclasses.replace(plain, **{name: samples})


def left_out(recording: Recording, name: str) -> np.ndarray:
    return np.flatnonzero(np.isnan(getattr(sensor_faults.find(recording).recording, name)).any(axis=1))


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize(
    ("name", "size"),
    [("specific_force", 300.0), ("specific_force", 900.0), ("specific_force", 3000.0), ("magnetic_field", 500.0)],
)
def test_some_damaged_samples_are_left_out(name, size, smooth):
    """In swings of 8 rad/s; of the accelerometer they cost up to 20°."""
    rows = slice(1000, 1005)
    plain, damaged = with_damaged(name, rows, size)
    np.testing.assert_array_equal(left_out(damaged, name), np.arange(1000, 1005))
    assert ": 5, ignored" in sensor_faults.find(damaged).words[0]
    whole, other = (ahrs.estimate(x, latency=0.0, smooth=smooth).estimate.attitude for x in (plain, damaged))
    assert quaternion.angle_between(whole, other).max() < 0.5 * DEGREE


@pytest.mark.parametrize(("name", "size"), [("specific_force", 300.0), ("magnetic_field", 500.0)])
def test_large_samples_that_last_or_come_again_are_used(name, size):
    """As of an accelerometer of 200 g at a runner's steps, or of a magnet."""
    _, lasting = with_damaged(name, slice(1000, 1200), size)
    np.testing.assert_array_equal(left_out(lasting, name), np.arange(1000, 1030))
    _, again = with_damaged(name, slice(1000, 1600, 60), size)
    np.testing.assert_array_equal(left_out(again, name), [1000])


def test_an_impact_within_16_g_is_used():
    plain = swing(10.0)
    force = plain.specific_force.copy()
    force[1000:1003] = [156.9, -140.0, 150.0], [-156.8, 120.0, 80.0], [30.0, 100.0, -156.0]
    assert sensor_faults.find(dataclasses.replace(plain, specific_force=force)).words == ()


@pytest.mark.parametrize("size", [30.0, 50.0, 1999.0])
def test_a_damaged_rate_is_replaced_by_the_mean_of_those_beside_it(size):
    plain, damaged = with_damaged("rate", slice(1000, 1800, 100), size)
    faults = sensor_faults.find(damaged)
    expected = plain.rate.copy()
    expected[1000:1800:100] = 0.5 * (plain.rate[999:1799:100] + plain.rate[1001:1801:100])
    np.testing.assert_array_equal(faults.recording.rate, expected)
    assert faults.words == ("Damaged samples of the gyro: 8, replaced by the means of those beside them",)
    whole, other = (ahrs.estimate(x, latency=0.0).estimate.attitude for x in (plain, damaged))
    assert quaternion.angle_between(whole, other).max() < 0.1 * DEGREE


def test_a_rate_that_changes_in_one_interval_is_used():
    """A unit that is caught, and one that is shaken at the limit of its sampling."""
    plain = swing(10.0)
    rate = plain.rate.copy()
    rate[1000:, 2] += 30.0
    assert sensor_faults.find(dataclasses.replace(plain, rate=rate)).words == ()
    shaken = plain.rate + np.outer(np.where(np.arange(len(rate)) % 2, 4.0, -4.0), [0.0, 1.0, 0.0])
    bend = sensor_faults.second_differences(shaken)
    assert len(sensor_faults.damaged_rates(shaken, bend, plain.interval)) == 0


def test_an_ordinary_recording_has_no_faults():
    faults = sensor_faults.find(swing(10.0))
    assert faults.words == ()
    assert not faults.turn_variance.any()


@pytest.mark.parametrize(
    ("rows", "axes", "value", "words"),
    [
        (slice(None), 1, 0.0, "stuck about y: 0 °/s throughout"),
        (slice(300, 700), 1, 0.1, "stuck about y: 5.73 °/s from 3 to 6.99 s"),
        (slice(300, 400), 1, 0.1, ""),
        (
            slice(300, 700),
            slice(None),
            0.0,
            "stuck about x: 0 °/s from 3 to 6.99 s",
        ),  # the accelerometer shows the motion
    ],
)
def test_a_stuck_gyro_is_reported(rows, axes, value, words):
    rng = np.random.default_rng(1)
    rate, force = rng.normal(0.0, 0.5, (1000, 3)), rng.normal([0.0, 0.0, 9.8], 2.0, (1000, 3))
    rate[rows, axes] = value
    recording = Recording(source="a", time=0.01 * np.arange(1000), rate=rate, specific_force=force)
    said = sensor_faults.stuck_words(recording)
    assert (words in said[0]) if words else not said
    if words:
        examined = check_conventions.examine(recording)
        assert said[0] in examined.warnings
        assert examined.verdict == "cannot tell"
    at_rest = dataclasses.replace(recording, specific_force=rng.normal([0.0, 0.0, 9.8], 0.01, (1000, 3)))
    assert bool(sensor_faults.stuck_words(at_rest)) == (axes == 1 and words != "")


def test_samples_stamped_when_their_packet_arrived_are_reported():
    """Ten samples in a packet; a recording that pauses for 9 s of every 10 s is none."""
    plain, k = swing(), np.arange(len(swing().time))
    arrived = dataclasses.replace(plain, time=(k // 10 * 10 + 9) / RATE + k % 10 * 1e-4)
    with pytest.warns(ahrs.ConventionWarning, match="the samples come in bursts"):
        sd.estimate(arrived)
    assert check_conventions.examine(arrived).reason == "the samples come in bursts; see the warning"
    assert sensor_faults.burst_words(dataclasses.replace(plain, time=k / RATE + 9.0 * (k // RATE))) == []


@pytest.mark.parametrize("sensor", ["accelerometer", "magnetometer"])
def test_a_vector_that_does_not_turn_with_the_unit_is_reported(sensor):
    turning = swing(10.0)
    samples = turning.specific_force.copy()
    samples[400:1000] = samples[400]
    stuck = dataclasses.replace(turning, **{SENSORS[sensor]: samples})
    assert sensor_faults.stuck_words(stuck)[0].startswith(f"the {sensor} is stuck at one value from 2 to 4.995 s")
    assert check_conventions.examine(dataclasses.replace(stuck, true_attitude=None)).verdict == "cannot tell"
    about_it = 0.1 * samples * np.linspace(1.0, 2.0, len(samples))[:, None]
    assert not sensor_faults.stuck_words(dataclasses.replace(stuck, rate=about_it))


def test_a_coarse_gyro_at_rest_is_not_stuck():
    rate = np.random.default_rng(1).normal(0.0, 1e-3, (1000, 3))
    rate[100:900, 2] = 0.0  # below its resolution
    assert not sensor_faults.stuck_words(Recording(source="a", time=0.01 * np.arange(1000), rate=rate))


def test_the_compiled_statistics_are_those_of_numpy():
    samples = np.rint(np.random.default_rng(2).normal(0.0, 2.0, (600, 3)))
    mean, square = np.empty((30, 3)), np.empty(30)
    compiled(recording_samples.block_statistics)(read_only(samples), 20, mean, square)
    blocks = samples.reshape(30, 20, 3)
    np.testing.assert_allclose(mean, blocks.mean(axis=1), rtol=0, atol=1e-15)
    np.testing.assert_allclose(square, 20.0 * blocks.var(axis=1).sum(axis=1), rtol=1e-14)
    bend = np.empty(598)
    compiled(recording_samples.bends)(read_only(samples), bend)
    np.testing.assert_array_equal(bend, np.abs(np.diff(samples, n=2, axis=0)).max(axis=1))
    run = np.empty((3, 2), np.int64)
    compiled(recording_samples.longest_runs)(read_only(samples), run)
    for column, (first, last) in zip(samples.T, run, strict=True):
        runs = [len(list(equal)) for _, equal in itertools.groupby(column)]
        k = int(np.argmax(runs))
        assert (first, last) == (sum(runs[:k]), sum(runs[: k + 1]) - 1)
    samples[np.random.default_rng(3).random(600) < 0.2] = np.nan
    ends = np.empty((3, 2, 2))
    compiled(recording_samples.extremes)(read_only(samples), ends)
    for column, counted in zip(samples.T, ends, strict=True):
        extremes = [np.nanmax(column), np.nanmin(column)]
        assert counted.tolist() == [[end, np.sum(column == end)] for end in extremes]
