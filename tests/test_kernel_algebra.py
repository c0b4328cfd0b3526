"""Rotations of tuple kernels and their series over all angles against the public algebra, mpmath and SciPy."""

import mpmath as mp
import numpy as np
import pytest
from plain_kernels import called
from scipy.spatial.transform import Rotation

from strapdown import kinematics, quaternion
from strapdown.kernels import rotation, series
from strapdown.kernels.series import LARGEST_ANGLE

EPS = np.finfo(float).eps


def test_unit_and_logarithm_against_the_public_algebra(rotation_vectors):
    for phi in rotation_vectors(200):
        q = quaternion.exp(phi)
        for sign in (1.0, -1.0):
            assert np.allclose(rotation.logarithm(tuple(sign * q)), quaternion.log(q), rtol=8 * EPS, atol=0.0)
        assert np.allclose(rotation.unit(tuple(3.0 * q)), q, rtol=0.0, atol=2 * EPS)
    assert rotation.logarithm((1.0, 0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("largest", [0.9 * LARGEST_ANGLE, np.pi, 19.0])
def test_turns_of_any_angle_against_the_public_algebra(rotation_vectors, largest):
    """Plain and compiled; beyond π what has an inverse there, that of the angle itself."""
    q = quaternion.exp(np.array([0.7, -0.4, 1.1]))
    for function in (lambda f: f, called):
        moved, far, composed = map(function, (rotation.moved, rotation.far_turn, rotation.composed))
        for phi in rotation_vectors(60, 1e-3 * largest, largest):
            turn, J = quaternion.exp(phi), kinematics.right_jacobian(phi)
            for (end, jacobian), wanted in (
                (moved(tuple(q), tuple(phi)), quaternion.multiply(q, turn)),
                (far(tuple(phi)), turn),
            ):
                # A quaternion and its negative are one attitude.
                assert np.allclose(np.array(end) * np.sign(end @ wanted), wanted, rtol=0.0, atol=1e-13)
                assert np.allclose(np.reshape(jacobian, (3, 3)), J, rtol=0.0, atol=1e-13)
            assert np.allclose(
                quaternion.exp(np.array(composed(tuple(q), tuple(phi)))),
                quaternion.exp(quaternion.log(quaternion.multiply(q, turn))),
                rtol=0.0,
                atol=1e-13,
            )
            if np.linalg.norm(phi) < np.pi:
                inverse = function(rotation.inverse_right_jacobian)(tuple(phi))
                assert np.allclose(np.reshape(inverse, (3, 3)) @ J, np.eye(3), rtol=0.0, atol=1e-13)


def test_exponential_against_mpmath_over_all_angles(rotation_vectors):
    with mp.workdps(50):
        for phi in rotation_vectors(200, 1e-12, LARGEST_ANGLE):
            x = [mp.mpf(float(c)) for c in phi]
            angle = mp.sqrt(sum(c * c for c in x))
            wanted = [float(mp.cos(angle / 2)), *(float(mp.sin(angle / 2) / angle * c) for c in x)]
            actual = rotation.exponential(tuple(phi.tolist()))
            np.testing.assert_allclose(actual, wanted, rtol=4 * EPS, atol=0.0)


def test_right_jacobian_against_mpmath_over_all_angles(rotation_vectors):
    with mp.workdps(50):
        for phi in rotation_vectors(100, 1e-12, LARGEST_ANGLE):
            x, y, z = (mp.mpf(float(c)) for c in phi)
            step = -mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            term = total = mp.eye(3)
            for k in range(1, 30):
                term = term * step / (k + 1)
                total = total + term
            wanted = np.array([[float(total[i, j]) for j in range(3)] for i in range(3)])
            error = np.array(rotation.right_jacobian(tuple(phi.tolist()))).reshape(3, 3) - wanted
            assert np.abs(error).max() <= 4 * EPS
            assert np.abs(error - error.T).max() <= 8 * EPS * np.linalg.norm(phi)


def test_turned_is_scipys_composition_and_stays_of_unit_norm(rotation_vectors):
    q = (1.0, 0.0, 0.0, 0.0)
    phi = rotation_vectors(300, 1e-4, LARGEST_ANGLE)
    theirs = Rotation.identity()
    for step in phi:
        q = rotation.turned(q, tuple(step.tolist()))
        theirs = theirs * Rotation.from_rotvec(step)
    np.testing.assert_allclose(Rotation.from_quat(np.roll(q, -1)).as_matrix(), theirs.as_matrix(), atol=1e-13)
    assert abs(np.linalg.norm(q) - 1.0) <= 4 * EPS


def test_turned_removes_rounding_and_shows_a_fault():
    still = (0.0, 0.0, 0.0)
    q = np.array([0.5, -0.5, 0.5, 0.5])
    assert abs(np.linalg.norm(rotation.turned(tuple((1.0 + 1e-9) * q), still)) - 1.0) <= 2 * EPS
    shown = np.linalg.norm(rotation.turned(tuple(1.001 * q), still)) - 1.0
    assert -2e-6 < shown < -1e-6
    np.testing.assert_allclose(
        rotation.renormalized(tuple(1.001 * q)), rotation.turned(tuple(1.001 * q), still), rtol=4 * EPS
    )


CLOSED_FORMS = {
    "cosine": (series.cosine, mp.cos),
    "sinc": (series.sinc, lambda t: mp.sin(t) / t),
    "third": (series.third, lambda t: (t - mp.sin(t)) / t**3),
    "fourth": (series.fourth, lambda t: (t * t / 2 - 1 + mp.cos(t)) / t**4),
    "fifth": (series.fifth, lambda t: (mp.mpf(1) / 3 - 2 * (t - mp.sin(t)) / t**3) / t**2),
}
LARGEST = {"cosine": 0.5 * series.LARGEST_ANGLE, "sinc": 0.5 * series.LARGEST_ANGLE}
"""Cosine and sine are only ever taken of half the angle; the others of the whole."""
ULPS = {"third": 6.0}
"""Its first dropped term is 5 ulp at the largest angle; it enters multiplied by θ² ≤ ¼ or less beside terms of one."""
LIMITS = {"cosine": 1.0, "sinc": 1.0, "third": 1 / 6, "fourth": 1 / 24, "fifth": 1 / 60}


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_against_the_closed_form_over_all_angles(name):
    function, closed = CLOSED_FORMS[name]
    top = LARGEST.get(name, series.LARGEST_ANGLE)
    angles = np.exp(np.random.default_rng(1).uniform(np.log(1e-12), np.log(top), 300))
    with mp.workdps(80):
        for angle in [*angles, top]:
            x = float(angle) ** 2
            wanted = closed(mp.sqrt(mp.mpf(x)))
            assert abs(float((mp.mpf(function(x)) - wanted) / wanted)) <= ULPS.get(name, 4.0) * EPS


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_limit_at_zero_is_exact(name):
    assert CLOSED_FORMS[name][0](0.0) == LIMITS[name]


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_plain_numbers_and_arrays_agree_to_the_bit(name):
    function = CLOSED_FORMS[name][0]
    x = np.linspace(0.0, series.LARGEST_ANGLE**2, 23)
    np.testing.assert_array_equal(function(x), [function(float(value)) for value in x])


@pytest.mark.parametrize(("angle", "bound"), [(0.5, 2 * EPS), (1.0, 1e-12), (2.0, 1e-8)])
def test_exponential_degrades_as_the_docstring_says(angle, bound):
    direction = np.array([0.48, -0.6, 0.64])
    wanted = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * direction)])
    error = np.abs(np.array(rotation.exponential(tuple(angle * direction))) - wanted).max()
    assert error <= bound
    if angle > series.LARGEST_ANGLE:
        assert error > 1e-3 * bound  # nor is the promise idle
