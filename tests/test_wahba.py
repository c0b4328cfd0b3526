"""Attitude from vector observations: exact data, oracles at any weights, covariance by Monte Carlo, and what is refused."""

import math

import mpmath
import numpy as np
import pytest
from scipy.stats import chi2

from strapdown import quaternion
from strapdown.checks import InputError
from strapdown.vectors import wahba


def directions(rng: np.random.Generator, *shape: int) -> np.ndarray:
    v = rng.standard_normal((*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def geometry(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Directions whose first two are at least 30° from one line."""
    while True:
        r = directions(rng, *shape)
        if np.all(np.linalg.norm(np.cross(r[..., 0, :], r[..., 1, :]), axis=-1) > 0.5):
            return r


def measured(q: np.ndarray, r: np.ndarray, sigmas: np.ndarray | float, rng: np.random.Generator) -> np.ndarray:
    exact = quaternion.rotate(quaternion.conjugate(q)[..., None, :], r)
    noisy = exact + np.broadcast_to(sigmas, r.shape[:-1])[..., None] * rng.standard_normal(r.shape)
    return noisy / np.linalg.norm(noisy, axis=-1, keepdims=True)


def attitudes(rng: np.random.Generator) -> list[np.ndarray]:
    """Random ones, identity, and turns at and near 180° about the axes and about random ones."""
    axes = [*np.eye(3), *directions(rng, 4)]
    near = [math.pi, *(math.pi - 10.0 ** rng.uniform(-15, 0, 4))]
    turns = [quaternion.exp(angle * axis) for axis in axes for angle in near]
    return [quaternion.IDENTITY, *turns, *quaternion.normalize(rng.standard_normal((20, 4)))]


def optimum(b: np.ndarray, r: np.ndarray, sigmas: np.ndarray) -> tuple[np.ndarray, float]:
    """Davenport's eigenvector and the loss with 60 digits, from the rotation matrix of a quaternion written out."""
    with mpmath.workdps(60):
        K = mpmath.zeros(4)
        for bi, ri, si in zip(b, r, sigmas, strict=True):
            # exactly unit directions, as the loss has them
            u, v = mpmath.matrix(bi.tolist()), mpmath.matrix(ri.tolist())
            u, v = u / mpmath.norm(u), v / mpmath.norm(v)
            # |b q⁻¹ − q⁻¹ r|² = |L(r) q − R(b) q|² / |q|²; both are linear in q, so that K is a sum of products
            left = mpmath.matrix(
                [[0, -v[0], -v[1], -v[2]], [v[0], 0, -v[2], v[1]], [v[1], v[2], 0, -v[0]], [v[2], -v[1], v[0], 0]]
            )
            right = mpmath.matrix(
                [[0, -u[0], -u[1], -u[2]], [u[0], 0, u[2], -u[1]], [u[1], -u[2], 0, u[0]], [u[2], u[1], -u[0], 0]]
            )
            D = left - right
            K += D.T * D / mpmath.mpf(float(si)) ** 2
        values, vectors = mpmath.eigsy(K)
        q = np.array([float(vectors[i, 0]) for i in range(4)])
        return np.where(q[0] < 0.0, -q, q), float(values[0] / 2)


def whiteness(error: np.ndarray, covariance: np.ndarray) -> None:
    """Sample covariance over covariance is I and the NEES χ²₃, both two-sided at about 1e-5."""
    n = len(error)
    white = np.linalg.solve(np.linalg.cholesky(covariance), error[..., None])[..., 0]
    sample = white.T @ white / n
    np.testing.assert_allclose(np.diag(sample), 1.0, atol=4.5 * math.sqrt(2.0 / n))
    np.testing.assert_allclose(sample - np.diag(np.diag(sample)), 0.0, atol=4.5 / math.sqrt(n))
    low, high = chi2.ppf([5e-6, 1.0 - 5e-6], 3 * n) / n
    assert low < np.mean(np.sum(white**2, axis=-1)) < high


def test_exact_data_give_the_exact_attitude() -> None:
    """With equal weights, and with weights over eight decades."""
    rng = np.random.default_rng(11)
    for q in attitudes(rng):
        for n, decades, bound in ((2, 0.0, 3e-15), (3, 0.0, 3e-15), (7, 0.0, 3e-15), (4, 8.0, 1e-14)):
            r = geometry(rng, n)
            b = measured(q, r, 0.0, rng)
            solution = wahba.solve(b, r, 1e-6 * 10.0 ** rng.uniform(0.0, 0.5 * decades, n))
            assert quaternion.angle_between(solution.attitude, q) < bound
            assert solution.attitude[0] >= 0.0
            assert solution.loss < 5e-16


def check_optimum(
    q: np.ndarray, r: np.ndarray, sigmas: np.ndarray, rng: np.random.Generator, bound: float, **of_loss: float
) -> None:
    """One set of measurements against 60 digits: the attitude, and the loss where it has a bound."""
    b = measured(q, r, sigmas, rng)
    solution = wahba.solve(b, r, sigmas)
    best, loss = optimum(b, r, sigmas)
    assert quaternion.angle_between(solution.attitude, best) < bound
    if of_loss:
        np.testing.assert_allclose(solution.loss, loss, **of_loss)


def test_the_optimum_of_noisy_data_with_weights_over_eight_decades() -> None:
    rng = np.random.default_rng(13)
    for q in attitudes(rng)[::3]:
        n = int(rng.integers(2, 6))
        r, sigmas = geometry(rng, n), 1e-5 / np.sqrt(10.0 ** rng.uniform(-6, 2, n))  # from 1e-6 to 1e-2 rad
        # The least loss there is, but for the rounding 1e-16/σ of each residual.
        check_optimum(q, r, sigmas, rng, 1e-14, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("ratio", [1e4, 1e7, 1e10])
def test_the_optimum_at_extreme_ratios_of_sigma(ratio: float) -> None:
    rng = np.random.default_rng(20)
    for q in attitudes(rng)[::3]:
        r, sigmas = geometry(rng, 4), 1e-12 * rng.permutation(ratio ** np.array([0.0, 1.0, *rng.random(2)]))
        check_optimum(q, r, sigmas, rng, 1e-14 + 2e-23 * ratio)


@pytest.mark.parametrize("noise", [0.03, 0.3])
def test_coarse_noise_ends_at_the_minimum(noise: float) -> None:
    rng = np.random.default_rng(15)
    for q in attitudes(rng)[::2]:
        r = np.concatenate([np.eye(3), directions(rng, 3)])
        check_optimum(q, r, np.full(6, noise), rng, 1e-13, rtol=1e-12)


@pytest.mark.parametrize("angle", [1e-1, 1e-3, 1e-5])
def test_narrow_fields_of_view(angle: float) -> None:
    rng = np.random.default_rng(16)
    r = np.array([0.0, 0.0, 1.0]) + angle * np.array([[1.0, 0.0, 0.0], [-0.3, 0.8, 0.0], [0.1, -0.9, 0.0]])
    r /= np.linalg.norm(r, axis=-1, keepdims=True)
    for q in attitudes(rng)[::3]:
        # A residual's rounding turns the attitude about the line of sight by 1e-16/angle.
        check_optimum(q, r, np.full(3, 1e-2 * angle), rng, 1e-14 + 4e-16 / angle)


def test_lengths_and_order_do_not_matter() -> None:
    rng = np.random.default_rng(18)
    r = geometry(rng, 5)
    sigmas = 10.0 ** rng.uniform(-4, -2, 5)
    b = measured(quaternion.normalize(rng.standard_normal(4)), r, sigmas, rng)
    plain = wahba.solve(b, r, sigmas)
    order = rng.permutation(5)
    length = np.array([1e-200, 1e-3, 1.0, 9.81, 1e200])[:, None]
    other = wahba.solve((length * b)[order], (length[::-1] * r)[order], sigmas[order])
    np.testing.assert_allclose(other.attitude, plain.attitude, atol=2e-15)
    np.testing.assert_allclose(other.loss, plain.loss, rtol=1e-10)
    np.testing.assert_allclose(other.covariance, plain.covariance, atol=1e-12 * np.trace(plain.covariance))


@pytest.mark.parametrize("ratio", [1.0, 1e2, 1e4])
def test_covariance_is_the_inverse_of_the_information(ratio: float) -> None:
    rng = np.random.default_rng(22)
    for _ in range(10):
        r = geometry(rng, 3)
        sigmas = 1e-6 * np.array([1.0, math.sqrt(ratio), ratio])
        q = quaternion.normalize(rng.standard_normal(4))
        b = measured(q, r, 0.0, rng)
        P = wahba.solve(b, r, sigmas).covariance
        with mpmath.workdps(60):
            information = mpmath.zeros(3)
            for bi, si in zip(b, sigmas, strict=True):
                u = mpmath.matrix(bi.tolist())
                information += (mpmath.eye(3) - u * u.T / (u.T * u)[0]) / mpmath.mpf(float(si)) ** 2
            exact = np.array((information**-1).tolist(), dtype=float)
        np.testing.assert_allclose(P, exact, atol=1e-13 * np.trace(exact))
        np.testing.assert_array_equal(P, P.T)
        # Relative to the least variance, too: rounding of the directions, 1e-16 rad, turns the axes of P.
        least, theirs = np.linalg.eigvalsh(np.linalg.inv(P))[-1], np.linalg.eigvalsh(np.linalg.inv(exact))[-1]
        assert abs(least / theirs - 1.0) < 1e-14 * ratio**2


@pytest.mark.parametrize(
    ("sigmas", "count"),
    [
        ((1e-4, 3e-3, 1e-3), 2000),
        *(
            pytest.param(s, 5000, marks=pytest.mark.slow)
            for s in ((1e-4, 3e-3, 1e-3), (1e-3, 1e-3), (1e-5, 1e-3, 1e-2, 3e-3, 1e-4, 1e-3))
        ),
    ],
)
def test_covariance_and_residual_by_monte_carlo(sigmas: tuple[float, ...], count: int) -> None:
    """None of the draws is refused as inconsistent."""
    rng = np.random.default_rng(23)
    n = len(sigmas)
    r, dof = geometry(rng, n), 2 * n - 3
    q = quaternion.normalize(rng.standard_normal((count, 4)))
    b = measured(q, np.broadcast_to(r, (count, n, 3)), np.array(sigmas), rng)
    solutions = [wahba.solve(vectors_b, r, sigmas) for vectors_b in b]
    attitude, covariance, loss, probability = (
        np.array([getattr(solution, name) for solution in solutions])
        for name in ("attitude", "covariance", "loss", "probability")
    )
    whiteness(quaternion.log(quaternion.multiply(quaternion.conjugate(attitude), q)), covariance)
    assert solutions[0].dof == dof
    low, high = chi2.ppf([5e-6, 1.0 - 5e-6], dof * count) / count
    assert low < np.mean(2.0 * loss) < high
    # Its probability is uniform: mean ½ and variance 1/12.
    assert abs(np.mean(probability) - 0.5) < 4.5 / math.sqrt(12.0 * count)
    np.testing.assert_allclose(probability, chi2.sf(2.0 * loss, dof), rtol=1e-12)


def test_the_residual_shows_a_sigma_too_small() -> None:
    rng = np.random.default_rng(24)
    r = geometry(rng, 40)
    b = measured(quaternion.normalize(rng.standard_normal(4)), r, 1.5e-3, rng)
    assert wahba.solve(b, r, 1.5e-3).probability > 0.01
    assert wahba.solve(b, r, 1e-3).probability < 1e-4


def test_vertical_and_heading_for_any_attitude_and_dip() -> None:
    rng = np.random.default_rng(31)
    for q in attitudes(rng):
        for dip in rng.uniform(-1.4, 1.4, 8):
            vectors_f = np.array([[0.0, 0.0, 9.8], [0.0, 48.0 * np.cos(dip), -48.0 * np.sin(dip)]])
            attitude = wahba.from_vertical_and_heading(*quaternion.rotate(quaternion.conjugate(q), vectors_f))
            assert quaternion.angle_between(attitude, q) < 1e-14


def test_the_vertical_counts_most() -> None:
    rng = np.random.default_rng(32)
    up, field = directions(rng, 2)
    q = wahba.from_vertical_and_heading(up, field)
    np.testing.assert_allclose(quaternion.rotate(q, up), [0.0, 0.0, 1.0], atol=1e-15)
    x, y, _ = quaternion.rotate(q, field)
    assert abs(x) < 1e-15
    assert y > 0.0


EYE = np.eye(3)
SKEWED = np.array([[1.3, 0.3, 0.3], [0.5, 1.5, 0.5], [0.1, 0.1, 1.1]])
REFUSED = {
    "one direction": ((EYE[:1], EYE[:1], 1e-3), "1 directions and references_f 1"),
    "parallel": (([EYE[0], EYE[0]], [EYE[1], EYE[1]], 1e-3), "directions 0 and 1 .* 0° apart"),
    "opposite": (([EYE[0], -EYE[0]], [EYE[1], -EYE[1]], 1e-3), "directions 0 and 1 .* 180° apart"),
    "many on one line": (
        (np.outer([1, -2, 3], [1, 2, 3]), np.outer([1, -2, 3], [3, 2, 1]), 1e-3),
        "not determined.*add a direction",
    ),
    "parallel but for rounding": (
        (np.outer([1.0, 0.1], [1.0, 2.0, 3.0]), np.outer([1.0, 0.1], [1.0, 2.0, 3.0]), 1e-18),
        "not determined",
    ),
    "closer than the noise": (
        ([EYE[0], EYE[0] + 1e-4 * EYE[1]],) * 2 + (1e-3,),
        "1σ of its least determined rotation is 1[0-9.]* rad.*0.005729",
    ),
    "nearly opposite": (([EYE[0], 1e-4 * EYE[1] - EYE[0]],) * 2 + (1e-3,), "179.99"),
    "parallel in the body only": (
        ([EYE[0], EYE[0] + 1e-5 * EYE[1]], [EYE[0], EYE[0] + 5e-3 * EYE[1]], 1e-3),
        r"vectors_b: the attitude is not determined",
    ),
    "inconsistent": (
        ([EYE[0], EYE[1], EYE[2]], [EYE[0], EYE[1], EYE[2] + 0.1 * EYE[1]], 1e-3),
        r"directions 1 and 2 are 90° apart in the body frame but 84.2894° in the fixed frame.*0.486",
    ),
    "inconsistent beyond rounding": (
        ([EYE[0], EYE[1], EYE[2]], [EYE[0], EYE[1], EYE[2] + 1e-12 * EYE[1]], 1e-17),
        "directions 1 and 2 are 90° apart",
    ),
    "swapped": ((EYE[[1, 0, 2]] + 0.3, SKEWED, 1e-3), "mixed-up pair"),
    "zero body": (([EYE[0], 0.0 * EYE[1]], EYE[:2], 1e-3), r"vectors_b\[1\] is the zero vector"),
    "zero reference": ((EYE[:2], [0.0 * EYE[0], EYE[1]], 1e-3), r"references_f\[0\] is the zero vector"),
    "NaN": (([EYE[0], [0.0, np.nan, 1.0]], EYE[:2], 1e-3), r"vectors_b\[1, 1\] is nan"),
    "infinite": ((EYE[:2], [EYE[0], [0.0, np.inf, 1.0]], 1e-3), r"references_f\[1, 1\] is inf"),
    "NaN sigma": ((EYE[:2], EYE[:2], [1e-3, np.nan]), r"sigmas\[1\] is nan"),
    "zero sigma": ((EYE[:2], EYE[:2], [1e-3, 0.0]), r"sigmas\[1\] is 0 rad"),
    "number of sigmas": ((EYE[:2], EYE[:2], [1e-3] * 3), r"sigmas has shape \(3,\), wanted \(2,\)"),
    "number of directions": ((EYE, EYE[:2], 1e-3), "3 directions and references_f 2"),
    "one vector": ((EYE[0], EYE[0], 1e-3), r"wanted \(n, 3\)"),
    "sigma of radians as weights": ((EYE[:2], EYE[:2], 100.0), "smaller sigmas"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case: str) -> None:
    arguments, message = REFUSED[case]
    with pytest.raises(InputError, match=message):
        wahba.solve(*arguments)


def test_heading_refuses_a_vertical_field_and_free_fall() -> None:
    with pytest.raises(InputError, match=r"up_b and magnetic_b are 179.9\d*° apart"):
        wahba.from_vertical_and_heading([0.0, 0.0, 9.8], [0.0, 0.01, -48.0])
    with pytest.raises(InputError, match=r"up_b is the zero vector"):
        wahba.from_vertical_and_heading([0.0, 0.0, 0.0], [0.0, 0.01, -48.0])
    with pytest.raises(InputError, match=r"magnetic_b\[2\] is nan"):
        wahba.from_vertical_and_heading([0.0, 0.0, 9.8], [0.0, 0.01, np.nan])


@pytest.mark.parametrize(("uncertainty", "determined"), [(0.99, True), (1.01, False)])
def test_the_largest_uncertainty_is_one_radian(uncertainty: float, determined: bool) -> None:
    """Of two directions α apart, the rotation about their bisector has the variance σ²/(2 sin²(α/2))."""
    half, sigma = 0.05, uncertainty * np.sqrt(2.0) * np.sin(0.05)
    pair = np.array([[np.cos(half), np.sin(half), 0.0], [np.cos(half), -np.sin(half), 0.0]])
    if determined:
        assert wahba.solve(pair, pair, [sigma, sigma]).covariance[0, 0] == pytest.approx(uncertainty**2, rel=1e-6)
    else:
        with pytest.raises(InputError, match=r"the 1σ of its least determined rotation is 1.01 rad"):
            wahba.solve(pair, pair, [sigma, sigma])
