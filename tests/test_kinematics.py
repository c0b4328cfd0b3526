"""Rates and Jacobians. The numbered equations have their own file; here: shapes, round trips, and the Jacobians against mpmath."""

import mpmath as mp
import numpy as np
import pytest

from strapdown import kinematics, quaternion
from strapdown.checks import InputError

SHAPES = [(), (1,), (5,), (2, 3)]
EPS = np.finfo(float).eps


def random(shape: tuple[int, ...], last: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((*shape, last))


@pytest.mark.parametrize("shape", SHAPES)
def test_rates_and_derivatives_are_inverse(shape):
    q, w = quaternion.normalize(random(shape, 4, 1)), random(shape, 3, 2)
    body = kinematics.body_quaternion_derivative(q, w)
    fixed = kinematics.fixed_quaternion_derivative(q, w)
    assert body.shape == fixed.shape == (*shape, 4)
    np.testing.assert_allclose(kinematics.body_rate(q, body), w, atol=1e-14)
    np.testing.assert_allclose(kinematics.fixed_rate(q, fixed), w, atol=1e-14)
    np.testing.assert_allclose(kinematics.body_to_fixed_rate(q, w), kinematics.fixed_rate(q, body), atol=1e-14)
    np.testing.assert_allclose(kinematics.fixed_to_body_rate(q, w), kinematics.body_rate(q, fixed), atol=1e-14)


@pytest.mark.parametrize("shape", SHAPES)
def test_skew_is_the_cross_product(shape):
    a, b = random(shape, 3, 3), random(shape, 3, 4)
    np.testing.assert_allclose((kinematics.skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=4 * EPS)
    np.testing.assert_array_equal(kinematics.skew(a), -np.swapaxes(kinematics.skew(a), -1, -2))


def mp_skew(v):
    x, y, z = v
    return mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def mp_jacobian(phi: np.ndarray) -> np.ndarray:
    """J_r from its power series Σ (−[φ])ᵏ/(k+1)!, summed in 60 digits: no closed form, no join."""
    with mp.workdps(60):
        step = -mp_skew([mp.mpf(float(c)) for c in phi])
        term = total = mp.eye(3)
        for k in range(1, 90):
            term = term * step / (k + 1)
            total = total + term
        return np.array([[float(total[i, j]) for j in range(3)] for i in range(3)])


def test_jacobian_is_good_to_four_ulp_over_all_angles(rotation_vectors):
    """Relative to the matrix; and its skew part, all that is left of a small angle, relative to itself."""
    join = np.outer(2.0 * (1.0 + np.array([-1e-3, -1e-9, -EPS, 0.0, EPS, 1e-9, 1e-3])), [0.48, 0.6, 0.64])
    for phi in np.concatenate([rotation_vectors(30), rotation_vectors(15, 1.0, np.pi, seed=8), join]):
        actual, wanted = kinematics.right_jacobian(phi), mp_jacobian(phi)
        error = actual - wanted
        size = np.abs(wanted).max()
        assert np.abs(error).max() <= 4 * EPS * size
        skew, skew_error = (0.5 * (m - m.T) for m in (wanted, error))
        # where the symmetric part is large its rounding enters the off-diagonal entries too
        symmetric = np.abs(wanted + wanted.T)[~np.eye(3, dtype=bool)].max()
        assert np.abs(skew_error).max() <= 4 * EPS * (np.abs(skew).max() + 0.5 * symmetric)


def test_quadratic_coefficient_keeps_its_digits():
    """Off-diagonal entries of [φ]² stand alone where the skew part vanishes: with φ = (a, a, 0), entry (0, 1) is a² × the coefficient."""
    with mp.workdps(60):
        for angle in np.exp(np.random.default_rng(4).uniform(np.log(1e-6), np.log(np.pi), 80)):
            a = float(angle / np.sqrt(2.0))
            theta = mp.sqrt(2) * mp.mpf(a)
            third = (theta - mp.sin(theta)) / theta**3
            wanted = float(mp.mpf(a) ** 2 * third)
            actual = kinematics.right_jacobian([a, a, 0.0])[0, 1]
            assert abs(actual - wanted) <= 4 * EPS * abs(wanted)


@pytest.mark.parametrize("shape", [*SHAPES, (0,)])
def test_batch_shapes(shape):
    phi = random(shape, 3, 5)
    J = kinematics.right_jacobian(phi)
    assert J.shape == (*shape, 3, 3)
    for index in np.ndindex(shape):
        np.testing.assert_array_equal(J[index], kinematics.right_jacobian(phi[index]))
    np.testing.assert_array_equal(kinematics.right_jacobian(np.zeros((*shape, 3))), np.broadcast_to(np.eye(3), J.shape))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: kinematics.body_quaternion_derivative(quaternion.IDENTITY, [1.0, 2.0]), "w_b has shape"),
        (lambda: kinematics.fixed_quaternion_derivative(quaternion.IDENTITY, [1.0, np.nan, 0.0]), r"w_f\[1\] is nan"),
        (lambda: kinematics.fixed_rate(np.zeros(4), quaternion.IDENTITY), "zero quaternion"),
        (lambda: kinematics.body_to_fixed_rate([1.0, 1.0, 0.0, 0.0], np.zeros(3)), "norm 1.414"),
        (lambda: kinematics.right_jacobian([[1.0, 0.0, np.inf]]), r"rotation_vector\[0, 2\] is inf"),
        (lambda: kinematics.right_jacobian([1.0, 0.0]), "rotation_vector has shape"),
        (lambda: kinematics.skew([1.0]), "v has shape"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(InputError, match=words):
        call()
