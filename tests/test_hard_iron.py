"""Hard iron from a magnetometer whose turns the gyro shows: against iron of known size."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from strapdown.kernels import headings
from strapdown.recordings import hard_iron

FIELD = np.array([0.0, 18.0, -40.0])
STRENGTH = float(np.linalg.norm(FIELD))
STEP = 0.03


def turned(iron, duration: float = 60.0, size: float = 1.0, noise: float = 0.2, oblique: bool = False):
    """Field in the frame that the gyro keeps, turns, and times, of a unit that swings about all axes; ``iron`` (3,) or (k, 3)."""
    time = STEP * np.arange(1, round(duration / STEP) + 1)
    angles = size * np.stack([np.sin(0.9 * time), 0.6 * np.sin(1.3 * time), 0.8 * np.sin(0.7 * time)], -1)
    if oblique:  # axes whose products of components do not average out
        angles = np.sin(0.9 * time)[:, None] * [0.7, 0.6, 0.5] + 0.2 * angles
    R = Rotation.from_euler("XYZ", angles)
    random = np.random.default_rng(4)
    field = (
        FIELD + R.apply(np.broadcast_to(iron, (len(time), 3)).copy()) + noise * random.standard_normal((len(time), 3))
    )
    return field, np.roll(R.as_quat(), 1, axis=-1), time


def iron_of(field, frame, time, causal=True, known=None):
    known = np.ones(len(time), bool) if known is None else known
    if not causal:
        up = np.tile([0.0, 0.0, 1.0], (len(time), 1))
        return hard_iron.find(field, up, frame, known, time, STEP, STRENGTH, hard_iron.SIGMA)[0]
    others = dict.fromkeys(headings.Constants._fields, 0.0) | {"every": 1}
    constants = headings.Constants(**others | hard_iron.parts(STEP))
    memory, result = hard_iron.memory(constants.lag, 1), np.empty((len(time), 3))
    for k in range(len(time)):
        result[k] = headings.iron_step(constants, field[k], frame[k], known[k], time[k], STRENGTH, memory)
        memory.counted[1] += 1
    return result


@pytest.mark.parametrize("causal", [True, False])
@pytest.mark.parametrize("oblique", [True, False])
def test_strong_iron_is_found_to_within_a_percent_of_the_field(causal, oblique):
    iron = np.array([6.0, -3.0, 12.0])
    result = iron_of(*turned(iron, oblique=oblique), causal=causal)
    np.testing.assert_allclose(result[-1], iron, atol=0.01 * STRENGTH)
    # From all samples it is known at the start too; from those so far there is none yet.
    np.testing.assert_allclose(result[0], 0.0 if causal else iron, atol=0.01 * STRENGTH)


def test_weak_iron_is_left_for_what_a_field_along_a_path_may_feign():
    """1.8 % of the field; at 5 % a share of (2.8 / 5)² stays."""
    assert not iron_of(*turned(0.018 * STRENGTH * np.array([0.0, 1.0, 0.0]), noise=0.0)).any()
    some = iron_of(*turned(0.05 * STRENGTH * np.array([0.0, 1.0, 0.0]), noise=0.0), causal=False)
    assert some[1000, 1] / STRENGTH == pytest.approx(0.05 * (1.0 - (0.028 / 0.05) ** 2), rel=0.03)


def test_iron_that_no_turn_shows_is_none():
    assert not iron_of(*turned([6.0, -3.0, 12.0], size=0.0)).any()
    assert not iron_of(*turned([6.0, -3.0, 12.0], duration=0.6)).any()


def test_each_row_depends_on_those_up_to_it():
    field, frame, time = turned([6.0, -3.0, 12.0])
    part = slice(0, 1200)
    both = iron_of(field, frame, time)[part], iron_of(field[part], frame[part], time[part])
    np.testing.assert_allclose(*both, atol=1e-9)


def test_a_fixed_frame_that_is_turned_changes_nothing():
    field, frame, time = turned([6.0, -3.0, 12.0])
    T = Rotation.from_rotvec([0.3, -0.5, 1.1])
    other = np.roll((T * Rotation.from_quat(np.roll(frame, -1, axis=-1))).as_quat(), 1, axis=-1)
    np.testing.assert_allclose(iron_of(T.apply(field), other, time), iron_of(field, frame, time), atol=1e-9)


def test_pairs_without_a_field_or_over_a_gap_are_left_out():
    iron = np.array([6.0, -3.0, 12.0])
    field, frame, time = turned(iron)
    known = np.ones(len(time), bool)
    known[600:700] = False
    wrong = field.copy()
    wrong[600:700] = 1e3
    np.testing.assert_allclose(iron_of(wrong, frame, time, known=known)[-1], iron, atol=0.01 * STRENGTH)
    # The gyro's frame is another one after a gap.
    after = time > 30.0
    T = Rotation.from_rotvec([0.0, 0.0, 2.0])
    broken = np.where(after[:, None], T.apply(field), field)
    other = np.where(
        after[:, None], np.roll((T * Rotation.from_quat(np.roll(frame, -1, axis=-1))).as_quat(), 1, axis=-1), frame
    )
    np.testing.assert_allclose(iron_of(broken, other, time + 5.0 * after)[-1], iron, atol=0.01 * STRENGTH)


def test_iron_is_forgotten():
    """Iron that is gone for four time constants."""
    time = STEP * np.arange(1, round(300.0 / STEP) + 1)
    iron = np.where((time < 60.0)[:, None], [6.0, -3.0, 12.0], 0.0)
    result = iron_of(*turned(iron, duration=300.0))
    assert np.linalg.norm(result[round(60.0 / STEP) - 1]) > 12.0
    assert np.linalg.norm(result[-1]) < 0.01 * STRENGTH


@pytest.mark.parametrize("axis", [None, [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
def test_iron_is_as_uncertain_as_at_first_in_directions_that_no_rotation_shows(axis):
    """Body axes are East, North, up in the mean: iron to the East turns the heading, and a rotation about it does not show it."""
    time = STEP * np.arange(1, 2001)
    R = Rotation.from_rotvec(np.sin(0.9 * time)[:, None] * np.array(axis or [0.0, 0.0, 0.0]))
    frame, up = np.roll(R.as_quat(), 1, axis=-1), np.tile([0.0, 0.0, 1.0], (len(time), 1))
    field = np.tile(FIELD, (len(time), 1))
    known = np.ones(len(time), bool)
    variance = hard_iron.find(field, up, frame, known, time, STEP, STRENGTH, 0.04)[1]
    # With A = R − R' a second apart and noise density n: (AᵀA summed over n² + I/σ²)⁻¹ along the East in body axes.
    lag = round(1.0 / STEP)
    A = R.as_matrix()[lag:] - R.as_matrix()[:-lag]
    k = 1500
    weight = np.exp(-np.abs(time[lag:] - time[k]) / hard_iron.MEMORY)
    N = np.einsum("k,kij,kil->jl", weight, A, A) * STEP / hard_iron.LEFT_NOISE**2 + np.eye(3) / 0.04**2
    east = R[k].inv().apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(variance[k], east @ np.linalg.solve(N, east), rtol=0.1)
    assert (variance[k] > 0.9 * 0.04**2) == (axis in (None, [1.0, 0.0, 0.0]))
