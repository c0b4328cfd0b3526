"""Tuple kernels against NumPy, mpmath and SciPy, and against themselves: plain floats, arrays as scalars, compiled."""

from __future__ import annotations

from collections.abc import Callable

import mpmath as mp
import numpy as np
import pytest
from plain_kernels import called
from scipy.spatial.transform import Rotation

from strapdown import kinematics, quaternion
from strapdown.kernels import algebra, rotation
from strapdown.kernels.series import LARGEST_ANGLE

EPS = np.finfo(float).eps
UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))


def matrix(a: tuple) -> np.ndarray:
    return np.stack(a, -1).reshape(*np.shape(a[0]), 3, 3)


def symmetric(s: tuple) -> np.ndarray:
    return matrix(tuple(s[k] for k in (0, 1, 2, 1, 3, 4, 2, 4, 5)))


def vector(v: tuple) -> np.ndarray:
    return np.stack(v, -1)


def times(A: np.ndarray, v: tuple) -> np.ndarray:
    return (A @ vector(v)[..., None])[..., 0]


def swapped(A: np.ndarray) -> np.ndarray:
    return np.swapaxes(A, -1, -2)


def outer(a: tuple, b: tuple) -> np.ndarray:
    return vector(a)[..., :, None] * vector(b)[..., None, :]


def skew(v: tuple) -> np.ndarray:
    return np.cross(np.eye(3), vector(v)[..., None, :])


def scalar(s: np.ndarray) -> np.ndarray:
    return np.asarray(s)[..., None]


def upper(A: np.ndarray) -> np.ndarray:
    return A[..., UPPER[0], UPPER[1]]


def flat(A: np.ndarray) -> np.ndarray:
    return A.reshape(*A.shape[:-2], 9)


def quaternion_product(p: tuple, q: tuple) -> np.ndarray:
    a, b = vector(p), vector(q)
    w = a[..., 0] * b[..., 0] - np.sum(a[..., 1:] * b[..., 1:], -1)
    v = scalar(a[..., 0]) * b[..., 1:] + scalar(b[..., 0]) * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([w[..., None], v], -1)


def newton(q: tuple) -> np.ndarray:
    return scalar(1.5 - 0.5 * np.sum(vector(q) ** 2, -1))


def exact_exponential(phi: tuple) -> np.ndarray:
    half = 0.5 * np.linalg.norm(vector(phi), axis=-1)
    return np.concatenate([np.cos(half)[..., None], 0.5 * scalar(np.sinc(half / np.pi)) * vector(phi)], -1)


def exact_jacobian(phi: tuple) -> np.ndarray:
    theta = np.linalg.norm(vector(phi), axis=-1)[..., None, None]
    # at angles of order one, as drawn below, the closed form has its digits
    a, b = (1.0 - np.cos(theta)) / theta**2, (theta - np.sin(theta)) / theta**3
    return np.eye(3) - a * skew(phi) + b * skew(phi) @ skew(phi)


def exact_factors(s: tuple) -> np.ndarray:
    root = np.linalg.cholesky(symmetric(s))
    d = np.diagonal(root, axis1=-2, axis2=-1)
    L = root / d[..., None, :]
    return np.stack([L[..., 1, 0], L[..., 2, 0], L[..., 2, 1], *np.moveaxis(d**-2.0, -1, 0)], -1)


def inverse_of(F: tuple) -> np.ndarray:
    """Return S⁻¹ of (l10, l20, l21, 1/d0, 1/d1, 1/d2), S = L D Lᵀ."""
    zero, one = np.zeros_like(F[0]), np.ones_like(F[0])
    L = np.linalg.inv(matrix((one, zero, zero, F[0], one, zero, F[1], F[2], one)))
    return swapped(L) @ (vector(F[3:])[..., :, None] * L)


# name: (kernel, sizes of its arguments (0: a scalar), what NumPy says of them)
S, V, M, U, Q = 0, 3, 9, 6, 4
KERNELS: dict[str, tuple[Callable, tuple[int, ...], Callable]] = {
    "dot": (algebra.dot, (V, V), lambda a, b: np.sum(vector(a) * vector(b), -1)),
    "cross": (algebra.cross, (V, V), lambda a, b: np.cross(vector(a), vector(b))),
    "add": (algebra.add, (V, V), lambda a, b: vector(a) + vector(b)),
    "subtract": (algebra.subtract, (V, V), lambda a, b: vector(a) - vector(b)),
    "scale": (algebra.scale, (S, V), lambda s, a: scalar(s) * vector(a)),
    "combine": (algebra.combine, (S, V, S, V), lambda s, a, t, b: scalar(s) * vector(a) + scalar(t) * vector(b)),
    "matrix_times_vector": (algebra.matrix_times_vector, (M, V), lambda A, v: times(matrix(A), v)),
    "transpose_times_vector": (algebra.transpose_times_vector, (M, V), lambda A, v: times(swapped(matrix(A)), v)),
    "symmetric_times_vector": (algebra.symmetric_times_vector, (U, V), lambda s, v: times(symmetric(s), v)),
    "multiply": (algebra.multiply, (M, M), lambda A, B: flat(matrix(A) @ matrix(B))),
    "multiply_add": (algebra.multiply_add, (M, M, M), lambda A, B, C: flat(matrix(A) @ matrix(B) + matrix(C))),
    "transpose": (algebra.transpose, (M,), lambda A: flat(swapped(matrix(A)))),
    "full": (algebra.full, (U,), lambda s: flat(symmetric(s))),
    "scale_matrix": (algebra.scale_matrix, (S, M), lambda s, A: flat(scalar(scalar(s)) * matrix(A))),
    "add_matrices": (algebra.add_matrices, (M, M), lambda A, B: flat(matrix(A) + matrix(B))),
    "combine_matrices": (
        algebra.combine_matrices,
        (S, M, S, M),
        lambda s, A, t, B: flat(scalar(scalar(s)) * matrix(A) + scalar(scalar(t)) * matrix(B)),
    ),
    "add_to_diagonal": (
        algebra.add_to_diagonal,
        (U, S),
        lambda s, d: upper(symmetric(s) + scalar(d)[..., None] * np.eye(3)),
    ),
    "times_transpose_upper": (
        algebra.times_transpose_upper,
        (M, M),
        lambda A, B: upper(matrix(A) @ swapped(matrix(B))),
    ),
    "times_transpose_upper_add": (
        algebra.times_transpose_upper_add,
        (M, M, U),
        lambda A, B, s: upper(matrix(A) @ swapped(matrix(B)) + symmetric(s)),
    ),
    "minus_outer": (algebra.minus_outer, (M, V, V), lambda A, a, b: flat(matrix(A) - outer(a, b))),
    "symmetric_minus_outer": (
        algebra.symmetric_minus_outer,
        (U, V, V),
        lambda s, a, b: upper(symmetric(s) - outer(a, b)),
    ),
    "plus_square": (algebra.plus_square, (U, V), lambda s, v: upper(symmetric(s) + outer(v, v))),
    "congruent": (algebra.congruent, (M, U), lambda A, s: upper(matrix(A) @ symmetric(s) @ swapped(matrix(A)))),
    "skew_polynomial": (
        algebra.skew_polynomial,
        (S, S, S, V),
        lambda i, j, k, v: flat(
            scalar(i)[..., None] * np.eye(3) + scalar(j)[..., None] * skew(v) + scalar(k)[..., None] * skew(v) @ skew(v)
        ),
    ),
    "factored": (algebra.factored, (U,), exact_factors),
    "solved": (algebra.solved, (U, V), lambda F, v: times(inverse_of(F), v)),
    "divided": (algebra.divided, (M, U), lambda X, F: flat(matrix(X) @ inverse_of(F))),
    "quaternion_multiply": (rotation.quaternion_multiply, (Q, Q), quaternion_product),
    "exponential": (rotation.exponential, (V,), exact_exponential),
    "turned": (
        rotation.turned,
        (Q, V),
        lambda q, phi: newton(q) * quaternion_product(q, tuple(np.moveaxis(exact_exponential(phi), -1, 0))),
    ),
    "renormalized": (rotation.renormalized, (Q,), lambda q: newton(q) * vector(q)),
    "rotation_matrix": (
        rotation.rotation_matrix,
        (Q,),
        lambda q: flat(Rotation.from_quat(np.roll(vector(q), -1, -1)).as_matrix()),
    ),
    "right_jacobian": (rotation.right_jacobian, (V,), lambda phi: flat(exact_jacobian(phi))),
    "near_inverse_right_jacobian": (
        rotation.near_inverse_right_jacobian,
        (V,),
        lambda phi: flat(np.linalg.inv(exact_jacobian(phi))),
    ),
    "arcsine": (rotation.arcsine, (S,), lambda x: np.arcsin(np.sqrt(x)) / np.sqrt(x)),
    "arcsine_series": (rotation.arcsine_series, (S,), lambda x: 2.0 * np.arcsin(np.sqrt(x)) / np.sqrt(x)),
}
NORMALIZING = ("renormalized", "turned")
"""They bring a quaternion that is not quite of unit length nearer to it."""
RUNS = 11
LARGEST_SQUARE = {"arcsine": np.sin(0.5 * LARGEST_ANGLE) ** 2, "arcsine_series": rotation.SHORT}
"""Of the sine in the range of a polynomial in it."""


def arguments(name: str) -> list:
    """One set of RUNS arguments: a number or a tuple of numbers each, every number an array (RUNS,)."""
    random = np.random.default_rng(sum(name.encode()))
    drawn = []
    for size in KERNELS[name][1]:
        value = random.standard_normal((max(size, 1), RUNS))
        if size == Q:
            value *= (random.uniform(0.99, 1.01, RUNS) if name in NORMALIZING else 1.0) / np.linalg.norm(value, axis=0)
        if size == V and KERNELS[name][0].__module__ == rotation.__name__:
            value *= random.uniform(0.3, LARGEST_ANGLE, RUNS) / np.linalg.norm(value, axis=0)
        if name in LARGEST_SQUARE:
            value = random.uniform(0.01, 1.0, (1, RUNS)) * LARGEST_SQUARE[name]
        if name in ("solved", "divided") and size == U:
            value = np.clip(value, -1.0, 1.0)
        if name == "factored":
            value[[0, 3, 5]] = 3.0 + np.abs(value[[0, 3, 5]])
            value[[1, 2, 4]] = np.clip(value[[1, 2, 4]], -1.0, 1.0)  # positive definite
        drawn.append(tuple(value) if size else value[0])
    return drawn


def row(argument, k: int):
    return tuple(float(x[k]) for x in argument) if isinstance(argument, tuple) else float(argument[k])


def stacked(result) -> np.ndarray:
    return np.stack(result, -1) if isinstance(result, tuple) else np.asarray(result)


APART = {"unit", "logarithm", "inverse_right_jacobian", "sine_and_versine", "moved", "composed", "far_turn"}
"""Rotations of any angle: with branches, which arrays as scalars do not take, or a pair of results."""


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
        moved, far, sine, composed = map(
            function, (rotation.moved, rotation.far_turn, rotation.sine_and_versine, rotation.composed)
        )
        for phi in rotation_vectors(60, 1e-3 * largest, largest):
            turn, J = quaternion.exp(phi), kinematics.right_jacobian(phi)
            theta = np.linalg.norm(phi)
            for (end, jacobian), wanted in (
                (moved(tuple(q), tuple(phi)), quaternion.multiply(q, turn)),
                (far(tuple(phi)), turn),
            ):
                # A quaternion and its negative are one attitude.
                assert np.allclose(np.array(end) * np.sign(end @ wanted), wanted, rtol=0.0, atol=1e-13)
                assert np.allclose(np.reshape(jacobian, (3, 3)), J, rtol=0.0, atol=1e-13)
            expected = np.sin(theta) / theta, 2.0 * (np.sin(0.5 * theta) / theta) ** 2
            assert np.allclose(sine(theta * theta), expected, rtol=1e-12, atol=1e-15)
            assert np.allclose(
                quaternion.exp(np.array(composed(tuple(q), tuple(phi)))),
                quaternion.exp(quaternion.log(quaternion.multiply(q, turn))),
                rtol=0.0,
                atol=1e-13,
            )
            if theta < np.pi:
                inverse = function(rotation.inverse_right_jacobian)(tuple(phi))
                assert np.allclose(np.reshape(inverse, (3, 3)) @ J, np.eye(3), rtol=0.0, atol=1e-13)


def test_every_kernel_is_here():
    here = {function.__name__ for function, _, _ in KERNELS.values()} | {"square_root"} | APART
    for module in (algebra, rotation):
        own = {name for name, f in vars(module).items() if callable(f) and f.__module__ == module.__name__}
        assert own <= here, f"add {own - here} to KERNELS"


@pytest.mark.parametrize("name", KERNELS)
def test_arrays_as_scalars_against_numpy(name):
    function, _, oracle = KERNELS[name]
    drawn = arguments(name)
    np.testing.assert_allclose(stacked(function(*drawn)), oracle(*drawn), rtol=0.0, atol=32 * EPS)


@pytest.mark.parametrize("name", KERNELS)
def test_three_machines_agree(name):
    """Plain floats give the bits of arrays; compiled, products may fuse with sums and differ by rounding."""
    function = KERNELS[name][0]
    drawn = arguments(name)
    together = stacked(function(*drawn))
    fast = called(function)
    for k in range(RUNS):
        one = [row(argument, k) for argument in drawn]
        np.testing.assert_array_equal(stacked(function(*one)), together[k])
        if k < 3:
            np.testing.assert_allclose(stacked(fast(*one)), together[k], rtol=0.0, atol=16 * EPS)


def test_square_root():
    assert algebra.square_root(2.0) == np.sqrt(2.0)
    assert called(algebra.square_root)(2.0) == np.sqrt(2.0)


# ---------------------------------------------------------------------------------------------------- rotations over all angles


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
