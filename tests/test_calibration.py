"""Calibration by hand: errors with σ, the file, and its use by the estimator."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal
from scipy.spatial.transform import Rotation

import strapdown as sd
from sims import calibration as study
from sims import hand_held
from strapdown import ahrs, calibration, quaternion
from strapdown.calibration import SensorErrors, UnitCalibration, calibrating, fitting, intervals, with_gyro_states
from strapdown.checks import InputError
from strapdown.consistency import reference_errors
from strapdown.recordings import Recording
from strapdown.records import ErrorStateEstimate

MATRIX = np.array([[0.02, 0.004, -0.003], [0.0, -0.015, 0.002], [0.005, 0.0, 0.01]])
SETS = Path(__file__).parents[2] / "shared" / "data" / "sassari"


@pytest.fixture(scope="module")
def turned():
    """A unit, its recording with pauses, and its calibration."""
    unit = study.drawn_unit(3)
    recording = study.simulated(unit, 3, 0, 45.0)
    return unit, recording, sd.calibrate(recording)


def spoiled(run: int) -> Recording:
    """A simulated hand whose gyro has the same matrix in each recording."""
    recording = hand_held.simulated(3, run, 40.0)
    return dataclasses.replace(recording, rate=recording.rate @ (np.eye(3) + MATRIX).T)


# ------------------------------------------------------------------------------------------------------------------ the estimate


def normalised(unit, estimate):
    """Errors of a calibration over their σ."""
    pairs = zip(unit.entries(), estimate.entries(), estimate.sigma.entries(), strict=True)
    return np.array([(b - a) / s for (_, _, a), (_, _, b), (_, _, s) in pairs])


def test_every_error_is_found_within_its_sigma(turned):
    unit, _, estimate = turned
    z = normalised(unit, estimate)
    assert np.abs(z).max() < 4.0
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4
    # and the σ are small: thousandths of the matrices, hundredths of m/s², of the field and of ms
    assert estimate.sigma.gyro_matrix.max() < 4e-3
    assert estimate.sigma.accelerometer_bias.max() < 0.03
    assert estimate.sigma.hard_iron.max() < 0.02 * np.linalg.norm(study.FIELD_F)
    assert estimate.sigma.magnetometer_delay < 1e-3


@pytest.mark.slow
def test_95_of_100_intervals_contain_the_truth():
    result = study.main(units=30)
    z = np.concatenate([(result.errors[n] / result.sigma[n]).ravel() for n in result.errors])
    assert 0.93 < np.mean(np.abs(z) < 1.96) < 0.97
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1


def test_a_unit_without_magnetometer_is_calibrated_too(turned):
    unit, recording, _ = turned
    estimate = sd.calibrate(dataclasses.replace(recording, magnetic_field=None, magnetic_unit=""))
    assert not estimate.sigma.magnetometer_matrix.any()
    for name in ("gyro_bias", "gyro_matrix", "accelerometer_bias", "accelerometer_matrix"):
        error = np.abs(getattr(estimate, name) - getattr(unit, name))
        assert np.all(error < 4.0 * getattr(estimate.sigma, name)), name
    assert estimate.sigma.accelerometer_bias.max() < 0.05


@pytest.mark.slow
def test_two_recordings_give_smaller_sigma_than_one(turned):
    unit, recording, first = turned
    both = sd.calibrate([recording, study.simulated(unit, 3, 1, 60.0)])
    assert np.abs(normalised(unit, both)).max() < 4.0
    for name in ("gyro_matrix", "accelerometer_bias", "magnetometer_matrix"):
        ratio = np.sqrt(np.mean(getattr(both.sigma, name) ** 2) / np.mean(getattr(first.sigma, name) ** 2))
        assert 0.2 < ratio < 0.8, name


@pytest.mark.slow
def test_a_gap_does_not_spoil_it(turned):
    unit, recording, _ = turned
    kept = (recording.time < 21.0) | (recording.time > 26.0)
    assert np.abs(normalised(unit, sd.calibrate(recording.taken(kept)))).max() < 4.0


def test_no_interval_goes_over_a_gap(turned):
    _, recording, _ = turned
    kept = recording.taken((recording.time < 21.0) | (recording.time > 26.0))
    assert intervals.gathered([kept]).step.max() < 1.01 / study.RATE


def test_noise_is_no_scale_factor():
    """Of a perfect unit that hardly turns, errors are as likely as their σ: noise of the samples does not make them seem scaled."""
    random, time = np.random.default_rng(3), 0.02 * np.arange(3000)
    attitude = Rotation.from_rotvec(0.1 * np.sin(np.outer(time, [0.9, 1.1, 0.7])))
    rate = (attitude[np.maximum(np.arange(3000) - 1, 0)].inv() * attitude).as_rotvec() / 0.02
    unit = sd.calibrate(
        Recording(
            source="gentle",
            time=time,
            rate=rate + 2e-3 * random.standard_normal((3000, 3)),
            specific_force=attitude.inv().apply([0.0, 0.0, 9.80665]) + 0.03 * random.standard_normal((3000, 3)),
            magnetic_field=attitude.inv().apply([0.0, 20.0, -43.0]) + 0.4 * random.standard_normal((3000, 3)),
        )
    )
    for name in ("gyro_matrix", "accelerometer_bias", "accelerometer_matrix", "hard_iron", "magnetometer_matrix"):
        assert np.all(np.abs(getattr(unit, name)) < 3.5 * getattr(unit.sigma, name)), name


def test_missing_motion_is_said():
    unit = study.drawn_unit(4)
    recording = study.simulated(unit, 4, 0, 30.0)
    still = recording.time < 3.4
    rest = dataclasses.replace(
        recording,
        **{
            name: np.tile(getattr(recording, name)[still], (6, 1))
            for name in ("rate", "specific_force", "magnetic_field", "true_attitude")
        },
        time=np.arange(6 * still.sum()) / study.RATE,
        movement=None,
    )
    estimate = sd.calibrate(rest)
    text = " ".join(estimate.remarks)
    for words in ("Turn about x", "Turn about y", "Turn about z", "Rest with", "into all attitudes"):
        assert words in text
    # at rest nothing is learnt of the gyro's matrix: σ is that of the prior
    assert np.all(estimate.sigma.gyro_matrix > 0.9 * 0.02)
    assert estimate.sigma.gyro_bias.max() < np.radians(0.05)
    assert "gyro scale x" in str(estimate)
    assert "Rest with" in str(estimate)
    # of the errors that one motion shows the one that is furthest from good is named, whatever the order
    several = np.array([[4e-3, 0.0, 0.0], [8e-3, 0.0, 0.0], [6e-3, 0.0, 0.0]])
    sigma = SensorErrors(gyro_matrix=several, gyro_bias=np.radians([0.1, 0.0, 0.0]), magnetometer_delay=0.006)
    bias, matrix, delay = calibrating.missing(UnitCalibration(sigma=sigma))
    assert bias.endswith("σ of gyro bias x is 0.1 °/s, good is 0.05.")
    assert matrix.endswith("σ of gyro misalignment yx is 0.8 %, good is 0.2.")
    assert delay.endswith("σ of magnetometer delay is 6 ms, good is 3.")


def test_acceleration_that_lasts_is_no_error_of_a_unit(turned, tmp_path):
    """A multirotor in flight, whose specific force is along its z axis however it tilts, and a unit without errors."""
    random, time = np.random.default_rng(1), np.arange(6000) / 100.0

    def attitude(t):
        yaw = 0.3 * t + 0.5 * np.sin(0.3 * t)
        return Rotation.from_euler("ZYX", np.stack([yaw, 0.35 * np.sin(0.7 * t + 1.0), 0.35 * np.sin(0.5 * t)], -1))

    rate = (attitude(time - 1e-3).inv() * attitude(time + 1e-3)).as_rotvec() / 2e-3
    thrust = 9.80665 / attitude(time).inv().apply([0.0, 0.0, 1.0])[:, 2]
    flight = Recording(
        source="flight",
        time=time,
        rate=rate + 2e-3 * random.standard_normal(rate.shape),
        specific_force=np.outer(thrust, [0.0, 0.0, 1.0]) + 0.05 * random.standard_normal(rate.shape),
        magnetic_field=attitude(time).inv().apply([0.0, 20.0, -43.0]) + 0.3 * random.standard_normal(rate.shape),
        magnetic_unit="uT",
    )
    wrong = sd.calibrate(flight)
    first = wrong.remarks[0]
    assert first.startswith("Do not use this calibration: its accelerometer scale y of -3.7 % is that of no unit")
    assert not any("Do not use" in remark for remark in turned[2].remarks)
    calibration.write(wrong, tmp_path / "calibration.toml")
    used = sd.estimate(flight, calibration=calibration.read(tmp_path / "calibration.toml"))
    assert any(
        remark.startswith("Doubtful calibration: its accelerometer scale y of -3.7 % is") for remark in used.remarks
    )


def test_an_interval_begins_with_the_sample_after_its_edge():
    """A rate and a force that grow with the time: its integral by the trapezium, which is exact for it, and every sample once."""
    time, edges = np.arange(41) / 16.0, [0, *range(3, 40, 4), 40]
    ramp = time[:, None] * [1.0, -2.0, 3.0]
    gathered = intervals.gathered([Recording(source="ramp", time=time, rate=ramp, specific_force=ramp)])
    np.testing.assert_array_equal(gathered.node_rate, ramp[edges])
    np.testing.assert_allclose(gathered.length, np.diff(time[edges]))
    np.testing.assert_allclose(gathered.angle.sum(axis=1), 0.5 * np.diff(time[edges] ** 2)[:, None] * [1.0, -2.0, 3.0])
    np.testing.assert_array_equal(gathered.force.number, np.diff(edges))
    np.testing.assert_array_equal(gathered.force.samples[gathered.force.known > 0.0], ramp[1:])
    np.testing.assert_array_equal(gathered.rate[gathered.step > 0.0], ramp[1:])


def test_the_prediction_has_the_derivatives_of_its_differences(turned):
    _, recording, _ = turned
    first = recording.taken(slice(int(21.0 * study.RATE)))
    gathered = intervals.gathered([first])
    assert len(gathered.node) >= 80
    random = np.random.default_rng(5)
    x = 0.02 * random.standard_normal(12)
    own = 0.02 * random.standard_normal(13)
    own[12] = 5e-3
    bias = np.tile(x[:3], (len(gathered.node), 1))

    def predicted(x, own, rows=slice(60, 80)):
        errors = intervals.Errors(x[3:].reshape(3, 3), own[:3], own[3:12].reshape(3, 3), own[12], *[np.zeros(3)] * 3)
        errors = errors._replace(magnetometer_matrix=np.zeros((3, 3)), magnetometer_delay=0.0)
        return intervals.predicted(gathered, errors, np.broadcast_to(x[:3], bias.shape)), rows

    base, rows = predicted(x, own)
    for k in range(12):
        step = np.zeros(12)
        step[k] = 1e-6
        more, less = predicted(x + step, own)[0], predicted(x - step, own)[0]
        turn = np.swapaxes(less.turn, 1, 2) @ more.turn
        vector = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1) / 2e-6
        np.testing.assert_allclose(vector[rows], base.turn_by[rows, :, k], atol=2e-6)
        slope = (more.force.value - less.force.value)[rows] / 2e-6
        np.testing.assert_allclose(slope, base.force.by_turn[rows, :, k], atol=3e-5)
    for k in range(13):
        step = np.zeros(13)
        step[k] = 1e-6
        slope = (predicted(x, own + step)[0].force.value - predicted(x, own - step)[0].force.value)[rows] / 2e-6
        np.testing.assert_allclose(slope, base.force.by_own[rows, :, k], atol=3e-5)


def test_the_equations_have_the_derivatives_of_their_differences(turned):
    """Without a lever arm: what its velocity depends on the errors of the gyro is left out."""
    gathered = intervals.gathered([turned[1]])
    random = np.random.default_rng(6)
    nodes = 0.02 * random.standard_normal((len(gathered.node_rate), 12))
    nodes[:, fitting.LEVER - 3 : fitting.LEVER] = 0.0
    errors, small = 0.02 * random.standard_normal(33), 0.02 * random.standard_normal((len(nodes), 3))
    turn = intervals.predicted(gathered, fitting.unpacked(errors), np.zeros((len(gathered.node), 3))).turn
    attitude = calibrating._gyro_frames(gathered, turn) @ Rotation.from_rotvec(small).as_matrix()
    x = fitting.Unknowns(errors, attitude, nodes)
    prior = fitting.Prior(0.02 * random.standard_normal(33), random.uniform(0.5, 2.0, 33))
    problem = fitting.Problem(gathered, prior, 9.81)
    equations = problem.equations(x)
    np.testing.assert_allclose(equations.residual[equations.kinds["prior"]], (errors - prior.mean) / prior.sigma)
    # the mean of white noise N (m/s²/√Hz) over a time L has σ = N/√L, and a change of velocity Δv over it is the mean force Δv/L
    first = equations.kinds["force"].start + np.arange(3)
    by_velocity = equations.jacobian[first][:, fitting.VELOCITY + np.arange(3)].toarray()
    to_sensor = (np.eye(3) + fitting.unpacked(errors).accelerometer_matrix) @ attitude[0].T
    np.testing.assert_allclose(by_velocity, to_sensor / (problem.noise["force"] * np.sqrt(gathered.length[0])))
    step = random.standard_normal(equations.columns)
    change = problem.equations(x.moved(1e-6 * step)).residual - problem.equations(x.moved(-1e-6 * step)).residual
    for rows in equations.kinds.values():
        slope = (equations.jacobian @ step)[rows]
        np.testing.assert_allclose(change[rows] / 2e-6, slope, rtol=0.0, atol=1e-5 * np.max(np.abs(slope)))
    J, r = equations.jacobian, equations.residual
    lower, _, gain = fitting._descended(problem, x, (J.T @ J).tocsc(), J.T @ r, r @ r, 1e-3)
    assert gain == pytest.approx(1.0 - np.sum(problem.equations(lower).residual ** 2) / np.sum(r**2), rel=1e-9)
    assert 0.0 < gain < 1.0


def test_sigma_of_the_field_matrix_is_that_of_its_mean_scale_of_one(turned):
    """A first-order change, by differences, of the matrix divided by its mean scale, which the fit leaves free."""
    random = np.random.default_rng(7)
    root, errors = 1e-2 * random.standard_normal((36, 36)), np.zeros(33)
    errors[fitting.FIELD] = (0.4 * np.eye(3) + 0.1 * random.standard_normal((3, 3))).ravel()
    unknowns = fitting.Unknowns(errors, np.eye(3)[None], np.zeros((1, 12)))
    fit = fitting.Fit(unknowns, root @ root.T)
    unit = calibrating._result(fit, fitting.Prior(errors, errors), 1.0, [turned[1]])

    def scaled(change):
        A = np.eye(3) + (errors[fitting.FIELD] + change).reshape(3, 3)
        return 3.0 * A / np.trace(A)

    np.testing.assert_allclose(np.eye(3) + unit.magnetometer_matrix, scaled(0.0), rtol=1e-14)
    steps = 1e-6 * root[fitting.FIELD].T  # their squares add up to the variance
    variance = sum(((scaled(step) - scaled(-step)) / 2e-6) ** 2 for step in steps)
    np.testing.assert_allclose(unit.sigma.magnetometer_matrix, np.sqrt(variance), rtol=1e-6)


def test_the_power_of_a_process_at_its_own_frequencies_is_that_of_its_model():
    """A Gauss–Markov process by SciPy's filter; twice as large it has four times the power."""
    interval, time = 0.1, 0.3
    decay = np.exp(-interval / time)
    white = np.random.default_rng(2).standard_normal((40000, 3))
    white[1:] *= np.sqrt(1.0 - decay**2)
    nodes = np.zeros((40000, 9))
    nodes[:, fitting.VELOCITY - 3 : fitting.VELOCITY] = 2.0 * scipy.signal.lfilter([1.0], [1.0, -decay], white, axis=0)
    parts = SimpleNamespace(length=np.full(39999, interval), first=np.array([0, 14999]))
    problem, unknowns = SimpleNamespace(intervals=parts), fitting.Unknowns(np.zeros(19), np.zeros((40000, 3, 3)), nodes)
    power = fitting._coherence(problem, unknowns, fitting.VELOCITY, time, np.full(40000, 1.0))
    assert power == pytest.approx(4.0, rel=0.06)  # 4 % by what the taper lets leak in


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda recording: [], "at least one recording"),
        (lambda recording: [recording.time], "recordings"),
        (lambda recording: {"time": recording.time}, "recordings is {.*give recordings, as read returns them"),
        (lambda recording: dataclasses.replace(recording, specific_force=None), "no accelerometer"),
        (lambda recording: [recording, dataclasses.replace(recording, magnetic_unit="mG")], "one unit for all"),
        (lambda recording: hand_held.simulated(1, 0, 3.0), "needs at least 10 s"),
    ],
)
def test_recordings_that_cannot_be_calibrated_are_refused(turned, change, words):
    with pytest.raises(InputError, match=words):
        sd.calibrate(change(turned[1]))


# -------------------------------------------------------------------------------------------------------------- the use of a file


def test_samples_are_corrected(turned):
    unit, recording, _ = turned
    known = UnitCalibration(**{**vars(unit), "magnetic_unit": "mG"})
    known = dataclasses.replace(known, hard_iron=10.0 * known.hard_iron)  # 1 µT is 10 mG
    clean = known.applied(recording)
    ideal = study.simulated(SensorErrors(magnetometer_delay=study.DELAY), 3, 0, 45.0)
    for name in ("rate", "specific_force", "magnetic_field"):
        # the same noise, but for the sensor's matrix
        assert np.abs(getattr(clean, name) - getattr(ideal, name)).max() < 0.3 * np.ptp(getattr(ideal, name)) * 0.05
    with pytest.raises(InputError, match="declare the unit"):
        dataclasses.replace(known, magnetic_unit="").applied(recording)


def test_an_estimate_with_the_calibration_is_better(turned):
    unit, _, estimate = turned
    second = study.simulated(unit, 3, 2, 30.0, pauses=False)
    error = study.attitude_error(second, estimate)
    assert error < np.radians(0.5)
    assert error < 0.1 * study.attitude_error(second, None)


def test_what_one_estimate_shows_serves_the_next():
    first = ahrs.estimate(
        spoiled(0), dataclasses.replace(ahrs.HAND_HELD, gyro_scale_sigma=0.02), latency=0.0, smooth=True
    ).calibration
    # The simulated gyro has 0.3 % of its own, drawn anew in each recording.
    assert np.abs(first.gyro_matrix - MATRIX).max() < 0.02
    assert np.sqrt(np.mean((first.gyro_matrix - MATRIX) ** 2)) < 3.0 * np.hypot(first.gyro_scale_sigma, 3e-3)
    known = dataclasses.replace(
        first, sigma=SensorErrors(gyro_matrix=np.full((3, 3), max(first.gyro_scale_sigma, 3e-3)))
    )
    errors = []
    for unit in (None, known):
        result = ahrs.estimate(spoiled(2), latency=0.0, calibration=unit)
        errors.append(reference_errors(result.estimate.attitude, result.recording.true_attitude).rms()["inclination"])
    assert errors[1] < 0.5 * errors[0]


def test_a_state_of_two_equal_entries_corrects_both():
    block = ErrorStateEstimate(
        components=("x", "xy=yx"),
        units=("1", "rad"),
        values=np.array([[1e-3, 2e-3]]),
        variance=np.array([[1e-8, 4e-8]]),
    )
    shown = with_gyro_states(None, block, 0.0, "")
    np.testing.assert_allclose(shown.gyro_matrix, [[1e-3, 2e-3, 0.0], [2e-3, 0.0, 0.0], [0.0, 0.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(shown.sigma.gyro_matrix[:2, :2], [[1e-4, 2e-4], [2e-4, 0.0]])


def test_corrections_of_the_gyro_follow_one_another(turned):
    known = UnitCalibration(gyro_matrix=MATRIX, accelerometer_bias=[0.1, 0.2, 0.3])
    values = np.array([[0.0] * 9, [1e-3, 2e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1e-3]])
    block = ErrorStateEstimate(
        components=("x", "xy", "xz", "yx", "y", "yz", "zx", "zy", "z"),
        units=("1",) * 9,
        values=values,
        variance=1e-8 * np.arange(18.0).reshape(2, 9),
    )
    after = with_gyro_states(known, block, 0.011, "next")
    further = np.array([[1e-3, 2e-3, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1e-3]])
    # what the filter sees after the correction by MATRIX is off by `further`: the gyro itself by both
    np.testing.assert_allclose(np.eye(3) + after.gyro_matrix, (np.eye(3) + MATRIX) @ (np.eye(3) + further), atol=1e-15)
    assert after.gyro_scale_sigma == pytest.approx(np.sqrt(13e-8))
    assert (after.magnetometer_delay, after.source) == (0.011, "next")
    np.testing.assert_array_equal(after.accelerometer_bias, known.accelerometer_bias)


def test_a_file_gives_it_back(turned, tmp_path):
    unit = turned[2]
    path = tmp_path / "calibration.toml"
    calibration.write(unit, path)
    again = calibration.read(path)
    assert list(again.entries()) == list(unit.entries())
    symmetric = [axes for name, axes, _ in unit.entries() if name == "accelerometer_matrix"]
    assert symmetric == ["x", "xy", "xz", "y", "yz", "z"]
    assert list(again.sigma.entries()) == list(unit.sigma.entries())
    assert (again.source, again.magnetic_unit) == (unit.source, "uT")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gyro_matrix = [[1.0, 0.0], [0.0, 1.0]]", r"\(3, 3\)"),
        ("gyro_matrix = [[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]", "give M of I"),
        ("magnetometer_matrix = [[-1.0,0.0,0.0],[0.0,0.0,0.0],[0.0,0.0,0.0]]", "singular"),
        ("gyro_bais_deg_per_s = [0.0, 0.0, 0.0]", "did you mean 'gyro_bias_deg_per_s'"),
        ("magnetic_unit = 'gauss'", "give one of T"),
        ("[calibration.sigma]\nhard_iron = [1.0, -1.0, 1.0]", "negative"),
        ("sigma = 1e-3", "must be a table"),
        ("[other]", ""),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, text, words):
    path = tmp_path / "calibration.toml"
    path.write_text(f"[calibration]\n{text}\n" if words else f"{text}\n")
    with pytest.raises(InputError, match=words or "no table"):
        calibration.read(path)


def test_a_known_delay_of_the_magnetometer_is_used_from_the_start():
    known = UnitCalibration(magnetometer_delay=0.011)
    result = ahrs.estimate(hand_held.simulated(1, 0, 4.0), calibration=known)
    np.testing.assert_array_equal(result.delays.field, np.full(len(result.recording.time), 0.011))


# -------------------------------------------------------------------------------------------------------------- recorded units


@pytest.mark.slow
def test_recorded_units_err_less_in_fast_motion_when_calibrated_in_slow():
    """The board of Caruso et al. (2021): with VQF, so that nothing else of this package counts."""
    vqf = pytest.importorskip("vqf")
    if not SETS.is_dir():
        pytest.skip(f"needs the recordings of the Sassari set in {SETS}")
    errors = []
    for unit in ("AP1", "SH1", "XS1"):
        estimate = sd.calibrate(sd.read(SETS / f"slow_v4_{unit}.hdf5"))
        fast = sd.read(SETS / f"fast_v4_{unit}.hdf5")
        for recording in (fast, estimate.applied(fast)):
            samples = (
                np.ascontiguousarray(x) for x in (recording.rate, recording.specific_force, recording.magnetic_field)
            )
            q = vqf.VQF(0.01).updateBatch(*samples)["quat9D"]
            errors.append(rms_without_heading_offset(q, fast))
    before, after = np.mean(np.reshape(errors, (3, 2)), axis=0)
    assert after < 0.85 * before


def rms_without_heading_offset(q, recording):
    """RMS of the total error over the movement, after one constant rotation about the vertical."""
    rows = recording.movement & np.isfinite(recording.true_attitude).all(axis=1)
    error = quaternion.multiply(q[rows], quaternion.conjugate(recording.true_attitude[rows]))
    offset = np.angle(np.mean(np.exp(2j * np.arctan2(error[:, 3], error[:, 0]))))
    turned = quaternion.multiply([np.cos(offset / 2), 0.0, 0.0, -np.sin(offset / 2)], error)
    return np.sqrt(np.mean((2.0 * np.arccos(np.minimum(np.abs(turned[:, 0]), 1.0))) ** 2))
