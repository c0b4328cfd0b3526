"""Coarse alignment against closed form: units that start in motion, and after gaps of the recording."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from strapdown import ahrs, quaternion
from strapdown.ahrs import starting
from strapdown.kernels import alignment
from strapdown.recordings import Recording

RATE = 100.0
GRAVITY = np.array([0.0, 0.0, 9.81])
FIELD = np.array([0.0, 20.0, -43.0])


def run_with(seed: int, duration: float, *, magnetometer: bool, amplitude: float = 5.0) -> Recording:
    """A unit in the hand of a runner: to and fro at 3 Hz, with an amplitude in g, and swung by 70° at 1.5 Hz, from any phase on."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(duration * RATE)) / RATE
    phase, direction = rng.uniform(0.0, 2.0 * np.pi, 2), rng.standard_normal(3)
    axis, first = rng.standard_normal(3), Rotation.random(random_state=seed)
    direction, axis = direction / np.linalg.norm(direction), axis / np.linalg.norm(axis)
    swing = 2.0 * np.pi * 1.5
    attitude = first * Rotation.from_rotvec(np.multiply.outer(np.radians(70.0) * np.sin(swing * time + phase[0]), axis))
    rate = np.multiply.outer(np.radians(70.0) * swing * np.cos(swing * time + phase[0]), axis)
    acceleration = np.multiply.outer(amplitude * 9.81 * np.sin(2.0 * swing * time + phase[1]), direction)
    return Recording(
        source="runner",
        time=time,
        rate=rate + 2e-3 * rng.standard_normal(rate.shape),
        specific_force=attitude.inv().apply(GRAVITY + acceleration) + 0.05 * rng.standard_normal(rate.shape),
        magnetic_field=attitude.inv().apply(FIELD) + 0.3 * rng.standard_normal(rate.shape) if magnetometer else None,
        true_attitude=np.roll(attitude.as_quat(), 1, axis=-1),
    )


def tilt_errors(result: ahrs.AhrsEstimate, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the angle between estimated and true vertical, and its σ from the covariance, both rad (n,)."""
    rows = result.estimate
    up, true_up = (quaternion.to_matrix(q)[:, 2] for q in (rows.attitude, true))
    angle = np.arctan2(np.linalg.norm(np.cross(up, true_up), axis=1), np.sum(up * true_up, axis=1))
    R = quaternion.to_matrix(rows.attitude)
    C = R @ rows.covariance[:, :3, :3] @ np.swapaxes(R, 1, 2)
    return angle, np.sqrt(C[:, 0, 0] + C[:, 1, 1])


def test_a_start_in_motion_ends_upright_within_its_sigma():
    """Without the alignment one of these thirty is upside down for five seconds, with a σ of 12°."""
    angles, sigmas = [], []
    for seed in range(30):
        runner = run_with(seed, 6.0, magnetometer=False)
        angle, sigma = tilt_errors(ahrs.estimate(runner, full_covariance=True), runner.true_attitude)
        angles.append(angle[[50, 110, 250, 500]])
        sigmas.append(sigma[[50, 110, 250, 500]])
    angle, sigma = np.array(angles), np.array(sigmas)
    assert np.all(np.mean(angle < 3.0 * sigma, axis=0) >= 0.96)
    assert np.all(angle < np.radians([90.0, 70.0, 35.0, 20.0]))
    assert np.all(np.mean(angle / sigma, axis=0) > 0.2)  # σ is not so large that it says nothing


def test_the_attitude_after_a_gap_is_found_again():
    """Of six seconds nothing is known, while the unit turns by up to a hundred degrees."""
    for seed in range(6):
        runner = run_with(seed, 24.0, magnetometer=True, amplitude=2.0)
        known = np.abs(runner.time - 13.0 - 0.1 * seed) > 3.0
        cut = runner.taken(np.flatnonzero(known))
        angle, sigma = tilt_errors(ahrs.estimate(cut, full_covariance=True), cut.true_attitude)
        after = np.flatnonzero(np.diff(cut.time) > 1.0)[0]
        assert np.all(angle[after + 160 : after + 500] < np.minimum(3.0 * sigma[after + 160 : after + 500], 0.5))


@pytest.mark.parametrize("magnetometer", [False, True])
def test_after_a_gap_the_live_filter_finds_the_vertical_again(magnetometer):
    """Its σ grows with the first sample after the gap, and covers the error from then on."""
    for seed in range(6):
        runner = run_with(seed, 24.0, magnetometer=magnetometer, amplitude=2.0)
        cut = runner.taken(np.flatnonzero(np.abs(runner.time - 13.0 - 0.1 * seed) > 3.0))
        live = ahrs.LiveAhrs(interval=1.0 / RATE, magnetometer=magnetometer)
        after = np.flatnonzero(np.diff(cut.time) > 1.0)[0] + 1
        tilts = []
        for k in range(after + 500):
            field = None if cut.magnetic_field is None else cut.magnetic_field[k]
            live.update(cut.time[k], cut.rate[k], cut.specific_force[k], field)
            if k < after:
                continue
            up, true_up = (quaternion.to_matrix(q)[2] for q in (live.attitude, cut.true_attitude[k]))
            R = quaternion.to_matrix(live.attitude)
            C = R @ live.covariance[:3, :3] @ R.T
            tilts.append((np.arccos(min(up @ true_up, 1.0)), np.sqrt(C[0, 0] + C[1, 1])))
        angle, sigma = np.array(tilts).T
        assert sigma[0] > 1.0
        assert np.all(angle[160:] < np.minimum(3.0 * sigma[160:], 0.6))


@pytest.mark.parametrize("lost", [5, 10])
def test_sigma_of_the_live_filter_holds_over_short_gaps(lost):
    """The rotation over a gap is uncertain by as much as the rate of the seconds before changes over it."""
    nees = []
    for seed in range(4):
        runner = run_with(seed, 25.0, magnetometer=True, amplitude=0.3)
        first = np.arange(1200, 2400, 137)
        cut = runner.taken(np.setdiff1d(np.arange(len(runner.time)), np.add.outer(first, np.arange(lost))))
        after = np.flatnonzero(np.diff(cut.time) > 0.05) + 1
        live = ahrs.LiveAhrs(interval=1.0 / RATE, magnetometer=True)
        before = np.inf
        for k in range(len(cut.time)):
            live.update(cut.time[k], cut.rate[k], cut.specific_force[k], cut.magnetic_field[k])
            if k in after + 5:  # the step in which the gap lies has ended
                error = quaternion.log(quaternion.multiply(quaternion.conjugate(live.attitude), cut.true_attitude[k]))
                nees.append(error @ np.linalg.solve(live.covariance[:3, :3], error))
                assert live.variance[:3].sum() > before
            if k in after - 1:
                before = live.variance[:3].sum()
    # The errors are about one axis, so their squares scatter more than those of three.
    assert np.mean(np.array(nees) < 7.81) > 0.7
    assert 0.2 < np.mean(nees) / 3.0 < 1.7


def test_the_mean_of_an_acceleration_that_changes_is_the_vertical():
    """Over whole periods the mean is exact; the variation gives σ."""
    k, every = 40, 0.025
    time = every * np.arange(1, k + 1)
    attitude = Rotation.from_rotvec(np.multiply.outer(time, [0.5, -1.0, 2.0]))
    swung = np.multiply.outer(8.0 * np.sin(2.0 * np.pi * 8.0 * time), [1.0, 0.0, 0.0])
    steps = alignment.Steps(
        force=GRAVITY + swung,
        force_number=np.ones(k),
        field=np.tile(FIELD, (k, 1)),
        field_number=np.ones(k),
        end=np.roll(attitude.as_quat(), 1, axis=-1),
    )
    parameters = ahrs.AhrsParameters()
    out = starting.alignments(steps, every, parameters, unknown=False)
    at = np.flatnonzero(out.variance > 0.0)
    np.testing.assert_allclose((at + 1) * every, [0.075, 0.125, 0.25, 0.5, 1.0], atol=1e-9)
    np.testing.assert_allclose(out.force[at[2:]], attitude[at[2:]].inv().apply(np.tile(GRAVITY, (3, 1))), atol=1e-9)
    np.testing.assert_allclose(out.field[at], attitude[at].inv().apply(np.tile(FIELD, (5, 1))), atol=1e-9)
    variation = 8.0 / np.sqrt(2.0) / 9.80665
    expected = parameters.attitude_sigma**2 + (variation * starting.CHANGE_TIME / 1.0) ** 2
    assert out.variance[-1] == pytest.approx(expected, rel=1e-2)


def test_a_unit_that_hardly_moves_is_left_to_the_filter():
    steps = alignment.Steps(
        np.tile(GRAVITY, (50, 1)), np.ones(50), np.empty((0, 3)), np.empty(0), np.tile([1.0, 0.0, 0.0, 0.0], (50, 1))
    )
    assert not starting.alignments(steps, 0.03, ahrs.AhrsParameters(), unknown=False).variance.any()
    # After a gap it is aligned all the same, from the first step on, and little is made of that one.
    after = starting.alignments(steps, 0.03, ahrs.AhrsParameters(), unknown=True).variance
    assert after[0] == pytest.approx(starting.MAX_TILT_SIGMA**2)


@pytest.mark.parametrize("field", [0.0, 30.0], ids=["no field", "a field along the vertical"])
def test_the_heading_is_kept_without_a_horizontal_field(field):
    q = Rotation.from_euler("ZYX", [70.0, 20.0, -30.0], degrees=True)
    x = np.concatenate([np.roll(q.as_quat(), 1), np.zeros(3)])
    P = np.diag([0.01, 0.02, 0.03, 1e-4, 1e-4, 1e-4]) + 1e-4
    up = 9.0 * q.inv().apply([0.5, 0.1, 0.9])  # nearer to East than to North
    starting.align(x, P, up, field * up, 0.04, ahrs.AhrsParameters(), unknown=False)
    R = quaternion.to_matrix(x[:4])
    np.testing.assert_allclose(R[2], up / np.linalg.norm(up), atol=1e-12)
    # The horizontal axis that is kept: North, projected on the new horizon.
    north = q.as_matrix()[1]
    level = north - (north @ R[2]) * R[2]
    np.testing.assert_allclose(R[1], level / np.linalg.norm(level), atol=1e-12)
    assert not P[:3, 3:].any()
    np.testing.assert_allclose(np.linalg.eigvalsh(P[:3, :3])[:2], 0.04, rtol=1e-9)
