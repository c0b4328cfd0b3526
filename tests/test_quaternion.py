"""Quaternion algebra: its axioms over batch shapes, and values against mpmath, SciPy and 2×2 complex matrices."""

import mpmath
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from strapdown import quaternion
from strapdown.checks import InputError

SHAPES = [(), (1,), (5,), (2, 3), (0,)]
EPS = np.finfo(float).eps


def random_quaternions(shape: tuple[int, ...], seed: int = 1) -> np.ndarray:
    q = np.random.default_rng(seed).standard_normal((*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def random_vectors(shape: tuple[int, ...], seed: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((*shape, 3))


def complex_matrix(q: np.ndarray) -> np.ndarray:
    """The quaternions as 2×2 complex matrices: i, j, k are −i times the Pauli matrices, and ⊗ is the product of matrices."""
    w, x, y, z = np.moveaxis(np.asarray(q), -1, 0)
    return np.stack([np.stack([w - 1j * z, -y - 1j * x], -1), np.stack([y - 1j * x, w + 1j * z], -1)], -2)


def close(actual: np.ndarray, wanted: np.ndarray, ulps: float = 8.0) -> None:
    np.testing.assert_allclose(actual, wanted, rtol=0.0, atol=ulps * EPS)


# ---------------------------------------------------------------------------------------------------- the algebra


@pytest.mark.parametrize("shape", SHAPES)
def test_product_is_that_of_complex_matrices(shape):
    p, q = 3.0 * random_quaternions(shape), 0.2 * random_quaternions(shape, 5)
    close(complex_matrix(quaternion.multiply(p, q)), complex_matrix(p) @ complex_matrix(q))
    np.testing.assert_array_equal(quaternion.multiply(p, quaternion.IDENTITY), p)
    np.testing.assert_array_equal(quaternion.multiply(quaternion.IDENTITY, p), p)
    conjugated = np.swapaxes(complex_matrix(p), -1, -2).conj()
    np.testing.assert_array_equal(complex_matrix(quaternion.conjugate(p)), conjugated)


def test_leading_axes_broadcast():
    p, q = random_quaternions((2, 1)), random_quaternions((3,), 4)
    product = quaternion.multiply(p, q)
    assert product.shape == (2, 3, 4)
    np.testing.assert_array_equal(product[1, 2], quaternion.multiply(p[1, 0], q[2]))
    assert quaternion.rotate(p, random_vectors((3,))).shape == (2, 3, 3)
    assert quaternion.rotate(p[:0], random_vectors((1, 1))).shape == (0, 1, 3)
    assert quaternion.rotate(p[0, 0], random_vectors(())).shape == (3,)
    assert quaternion.angle_between(p, q).shape == (2, 3)
    assert quaternion.exp(quaternion.log(p)).shape == (2, 1, 4)
    assert quaternion.from_matrix(quaternion.to_matrix(quaternion.exp(quaternion.log(p[:0])))).shape == (0, 1, 4)


def test_identity_cannot_be_written_to():
    with pytest.raises(ValueError, match="read-only"):
        quaternion.IDENTITY[0] = 2.0


# ---------------------------------------------------------------------------------------------------- rotation


@pytest.mark.parametrize("shape", SHAPES[:4])
def test_matrix_and_rotation_agree_with_scipy(shape):
    q, v = random_quaternions(shape), random_vectors(shape)
    flat = q.reshape(-1, 4)
    theirs = Rotation.from_quat(flat[:, [1, 2, 3, 0]])
    close(quaternion.to_matrix(q).reshape(-1, 3, 3), theirs.as_matrix())
    close(quaternion.rotate(q, v).reshape(-1, 3), theirs.apply(v.reshape(-1, 3)), 16)
    close(quaternion.to_rotation(flat).as_matrix(), theirs.as_matrix())
    close(np.abs(np.sum(quaternion.from_rotation(theirs) * flat, -1)), np.ones(len(flat)))
    close(quaternion.from_rotation(quaternion.to_rotation(flat[0])), flat[0])
    close(quaternion.from_matrix(quaternion.to_matrix(q)), np.where(q[..., :1] < 0.0, -q, q))


def test_from_matrix_at_half_turns_and_near_each_axis():
    """Where one branch of Shepperd's method gives way to the next, and where the scalar part vanishes."""
    cases = [np.eye(4)[k] for k in range(4)]
    cases += [np.eye(4)[k] + s * np.eye(4)[m] for k in range(4) for m in range(4) if k != m for s in (1.0, 1e-8, -1e-9)]
    cases += [np.array([1.0, 1.0, 1.0, 1.0]), np.array([0.0, 1.0, 1.0, 1.0]), np.array([1e-17, 0.6, -0.8, 0.0])]
    q = quaternion.normalize(np.array(cases))
    back = quaternion.from_matrix(quaternion.to_matrix(q))
    close(np.abs(np.sum(back * q, axis=-1)), np.ones(len(q)), 4)
    close(quaternion.to_matrix(back), quaternion.to_matrix(q))


# ---------------------------------------------------------------------------------------------------- exp and log


def mp_exp(phi: np.ndarray) -> list[mpmath.mpf]:
    x = [mpmath.mpf(float(c)) for c in phi]
    angle = mpmath.sqrt(sum(c * c for c in x))
    s = mpmath.sin(angle / 2) / angle if angle else mpmath.mpf("0.5")
    return [mpmath.cos(angle / 2), *(s * c for c in x)]


def mp_log(q: np.ndarray) -> list[mpmath.mpf]:
    w, *u = (mpmath.mpf(float(c)) for c in q)
    norm = mpmath.sqrt(sum(c * c for c in u))
    sign = -1 if w < 0 else 1
    factor = 2 * mpmath.atan2(norm, abs(w)) / norm if norm else mpmath.mpf(2)
    return [sign * factor * c for c in u]


def test_exp_against_mpmath_over_all_angles(rotation_vectors):
    phi = np.concatenate([rotation_vectors(150), rotation_vectors(50, 1e-200, 1e-12), rotation_vectors(30, 3.0, 50.0)])
    with mpmath.workdps(60):
        wanted = np.array([[float(c) for c in mp_exp(row)] for row in phi])
    actual = quaternion.exp(phi)
    angle = np.linalg.norm(phi, axis=-1)
    size = np.maximum(1.0, angle)  # an angle above 1 rad is itself rounded at more than EPS
    assert np.all(np.abs(actual[:, 0] - wanted[:, 0]) <= 2 * EPS * size)
    vector = np.linalg.norm(actual[:, 1:] - wanted[:, 1:], axis=1)
    small = angle < np.pi
    assert np.all(vector[small] <= 4 * EPS * np.linalg.norm(wanted[small, 1:], axis=1))
    assert np.all(vector[~small] <= 2 * EPS * size[~small])
    np.testing.assert_allclose(np.linalg.norm(actual, axis=-1), 1.0, atol=4 * EPS)


def test_log_against_mpmath_over_all_angles(rotation_vectors):
    q = quaternion.exp(np.concatenate([rotation_vectors(150), rotation_vectors(50, 1e-200, 1e-12)]))
    q[::2] *= -1.0
    with mpmath.workdps(60):
        wanted = np.array([[float(c) for c in mp_log(row)] for row in q])
    assert np.all(np.linalg.norm(quaternion.log(q) - wanted, axis=1) <= 4 * EPS * np.linalg.norm(wanted, axis=1))


def test_log_takes_the_shorter_way_round():
    axis = np.array([0.0, 0.6, 0.8])
    close(quaternion.log(quaternion.exp((2.0 * np.pi - 0.1) * axis)), -0.1 * axis, 16)
    # at half a turn both ways are as short; the angle is what counts
    for q in (np.array([0.0, 0.0, 0.6, 0.8]), np.array([0.0, 0.0, -0.6, -0.8])):
        close(np.linalg.norm(quaternion.log(q)), np.array(np.pi), 4)
        close(np.abs(np.sum(quaternion.exp(quaternion.log(q)) * q)), np.array(1.0), 4)


def test_zero_rotation():
    np.testing.assert_array_equal(quaternion.exp(np.zeros(3)), quaternion.IDENTITY)
    np.testing.assert_array_equal(quaternion.log(quaternion.IDENTITY), np.zeros(3))
    np.testing.assert_array_equal(quaternion.log(-quaternion.IDENTITY), np.zeros(3))


def test_rotation_between(rotation_vectors):
    p, q = (Rotation.from_rotvec(rotation_vectors(80, 1e-12, 3.1)[::step]) for step in (1, -1))
    between = quaternion.rotation_between(quaternion.from_rotation(p), quaternion.from_rotation(q))
    np.testing.assert_allclose(Rotation.from_rotvec(between).as_matrix(), (p.inv() * q).as_matrix(), atol=4 * EPS)


def test_angle_between(rotation_vectors):
    phi = rotation_vectors(80, 1e-12, 3.1)
    p = random_quaternions((80,))
    angle = np.linalg.norm(phi, axis=1)
    q = quaternion.multiply(p, quaternion.exp(phi))
    np.testing.assert_allclose(quaternion.angle_between(p, q), angle, rtol=1e-14, atol=4 * EPS)
    np.testing.assert_allclose(quaternion.angle_between(q, -p), angle, rtol=1e-14, atol=4 * EPS)


# ---------------------------------------------------------------------------------------------------- bad input


THREE, TWO = np.tile(quaternion.IDENTITY, (3, 1)), np.tile(quaternion.IDENTITY, (2, 1))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: quaternion.multiply([1.0, 0.0, 0.0], quaternion.IDENTITY), ("p has shape (3,)", "(..., 4)")),
        (lambda: quaternion.multiply(quaternion.IDENTITY, [[1.0, np.nan, 0.0, 0.0]]), ("q[0, 1] is nan",)),
        (lambda: quaternion.rotate([1.0, 0.1, 0.0, 0.0], [1.0, 0.0, 0.0]), ("q has norm 1.00498", "normalise")),
        (lambda: quaternion.rotate(quaternion.IDENTITY, [1.0, 0.0]), ("v has shape (2,)",)),
        (lambda: quaternion.log([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0]]), ("q[1] has norm 2",)),
        (lambda: quaternion.exp([np.inf, 0.0, 0.0]), ("rotation_vector[0] is inf",)),
        (lambda: quaternion.inverse(np.zeros(4)), ("zero quaternion",)),
        (lambda: quaternion.normalize([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]), ("q[1]", "zero quaternion")),
        (lambda: quaternion.to_matrix([2.0, 0.0, 0.0, 0.0]), ("q has norm 2",)),
        (lambda: quaternion.to_rotation([2.0, 0.0, 0.0, 0.0]), ("q has norm 2",)),
        (lambda: quaternion.from_matrix(1.01 * np.eye(3)), ("not orthogonal", "0.0201")),
        (lambda: quaternion.from_matrix(np.diag([1.0, 1.0, -1.0])), ("reflection", "signs of its axes")),
        (lambda: quaternion.from_matrix(np.eye(4)), ("matrix has shape (4, 4)",)),
        (lambda: quaternion.angle_between([2.0, 0.0, 0.0, 0.0], quaternion.IDENTITY), ("p has norm 2",)),
        (lambda: quaternion.multiply(THREE, TWO), ("p has shape (3, 4) and q has shape (2, 4); their leading axes",)),
        (lambda: quaternion.rotate(THREE, np.zeros((2, 3))), ("q has shape (3, 4) and v has shape (2, 3)",)),
        (lambda: quaternion.angle_between(THREE, TWO), ("their leading axes",)),
        (lambda: quaternion.exp([1e300, 0.0, 0.0]), ("rotation_vector holds 1e+300 rad",)),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(InputError) as caught:
        call()
    for word in words:
        assert word in str(caught.value)


def test_inputs_are_not_changed():
    q, v = random_quaternions((3,)), random_vectors((3,))
    before = q.copy(), v.copy()
    for name in ("conjugate", "inverse", "normalize", "log", "to_matrix"):
        getattr(quaternion, name)(q)
    quaternion.rotate(q, v)
    np.testing.assert_array_equal(q, before[0])
    np.testing.assert_array_equal(v, before[1])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [1e-300, 1e-200, 1.0, 1e200, 1e300])
def test_quaternions_of_any_size_are_normalised_and_inverted(size):
    q = size * np.array([[0.5, -0.5, 0.5, 0.5], [0.0, 3.0, 0.0, -4.0]])
    unit = np.array([[0.5, -0.5, 0.5, 0.5], [0.0, 0.6, 0.0, -0.8]])
    np.testing.assert_allclose(quaternion.normalize(q), unit, rtol=1e-15)
    expected = quaternion.conjugate(unit) / (size * np.array([[1.0], [5.0]]))
    np.testing.assert_allclose(quaternion.inverse(q), expected, rtol=1e-15)


@pytest.mark.filterwarnings("error")
def test_a_turn_of_any_norm_is_one():
    assert np.isfinite(quaternion.exp([-1e149, 1e149, 0.0])).all()
