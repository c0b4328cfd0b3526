"""The filter step's formulas against independent oracles: matrix exponentials, Van Loan, quadrature, a textbook update."""

import functools
import math

import mpmath
import numpy as np
import pytest
import scipy.linalg
from filterpy.common import van_loan_discretization
from in_steps import transition_and_noise

from strapdown import estimation, gyro, kinematics, motion, quaternion, records
from strapdown.estimation.states import ProcessNoise, State, covariance_matrices
from strapdown.kernels import filter_step

RATES = [
    np.array([0.0, 0.0, 0.0]),
    np.array([1e-6, 2e-6, -1e-6]),
    np.array([0.3, -0.2, 0.5]),
    np.array([15.0, -22.0, 18.0]),
]
DT = 0.01


def error_dynamics(w):
    """δθ̇ = −[ω] δθ − δb − n_v, δḃ = n_u."""
    F = np.zeros((6, 6))
    F[:3, :3] = -kinematics.skew(w)
    F[:3, 3:] = -np.eye(3)
    return F


@pytest.mark.parametrize("w", RATES, ids=lambda w: f"{np.linalg.norm(w):.3g}")
def test_transition_is_the_matrix_exponential(w):
    F, _ = transition_and_noise(w * DT, DT, ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-4))
    assert np.allclose(F, scipy.linalg.expm(error_dynamics(w) * DT), rtol=0.0, atol=3e-16)


@pytest.mark.parametrize("w", RATES, ids=lambda w: f"{np.linalg.norm(w):.3g}")
@pytest.mark.parametrize("dt", [1e-3, DT])
def test_process_noise_is_van_loans(w, dt):
    sigma_v, sigma_u = 1.0, 30.0  # of like size, so that no block of Van Loan's matrix drowns in another's rounding
    _, Q = transition_and_noise(w * dt, dt, ProcessNoise(angle_random_walk=sigma_v, rate_random_walk=sigma_u))
    G = np.diag([sigma_v] * 3 + [sigma_u] * 3)
    _, oracle = van_loan_discretization(error_dynamics(w), G, dt)
    scale = np.sqrt(np.outer(np.diag(oracle), np.diag(oracle)))
    assert np.abs((Q - oracle) / scale).max() < 1e-13


def test_process_noise_of_the_rate_alone_at_forty_digits():
    """σ_v = 0 leaves the dt³ terms alone, which σ_v dt would hide: ∫ Φ12(s) Φ12(s)ᵀ ds by mpmath."""
    w, dt, sigma_u = np.array([15.0, -22.0, 18.0]), DT, 1.0
    q11, q12, _ = filter_step.process_noise(tuple(w * dt), dt, 0.0, sigma_u**2)
    with mpmath.workdps(40):
        W = mpmath.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        speed = mpmath.norm(mpmath.matrix(w.tolist()))

        @functools.cache  # the nodes of all integrals are the same
        def phi12(s):
            x = speed * s
            return -(mpmath.eye(3) * s - W * (1 - mpmath.cos(x)) / speed**2 + W * W * (x - mpmath.sin(x)) / speed**3)

        @functools.cache
        def square(s):
            return phi12(s) * phi12(s).T

        def integral(i, j, f):
            return float(mpmath.quad(lambda s: f(s)[i, j], [0, dt]))

        upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
        exact11 = [integral(i, j, square) for i, j in upper]
        exact12 = [integral(i, j, phi12) for i in range(3) for j in range(3)]
    assert np.allclose(q11, exact11, rtol=1e-12, atol=1e-12 * dt**3)
    assert np.allclose(q12, exact12, rtol=1e-12, atol=1e-13 * dt**2)


def random_state(generator, spread=1.0, bias_sigma=3e-3):
    root = generator.normal(size=(6, 6)) * 0.4 + np.eye(6)
    D = np.diag([2e-2 * spread] * 3 + [bias_sigma] * 3)
    attitude = quaternion.normalize(generator.normal(size=4))
    return State(attitude=attitude, bias=generator.normal(size=3) * 1e-3, covariance=D @ root @ root.T @ D)


def blocks(P):
    u = np.triu_indices(3)
    return tuple(P[:3, :3][u]), tuple(P[:3, 3:].ravel()), tuple(P[3:, 3:][u])


def matrix(A, B, C):
    return covariance_matrices(np.array([*A, *B, *C]))


@pytest.mark.parametrize("sigma", [1e-7, 1e-4, 1e-2, 1.0, 20.0])
@pytest.mark.parametrize("bias_sigma", [3e-3, 1e-9])
@pytest.mark.parametrize("seed", range(4))
def test_update_of_rows_is_the_kalman_update_at_fifty_digits(sigma, bias_sigma, seed):
    generator = np.random.default_rng(seed)
    P = random_state(generator, bias_sigma=bias_sigma).covariance
    A, B, C = blocks(P)
    H = np.zeros((2, 6))
    H[:, :3] = np.linalg.qr(generator.normal(size=(3, 3)))[0][:2]
    y = generator.normal(size=2) * 1e-2
    correction, b, nis = np.zeros(3), (0.0, 0.0, 0.0), 0.0
    for h, value in zip(H, y, strict=True):
        e = value - h[:3] @ correction
        part, b, A, B, C, s = filter_step.update_row(b, A, B, C, tuple(h[:3]), e, sigma**2)
        correction = correction + np.array(part)
        nis += e * e / s
    with mpmath.workdps(50):
        exact_P, exact_H = mpmath.matrix(P.tolist()), mpmath.matrix(H.tolist())
        S = exact_H * exact_P * exact_H.T + mpmath.eye(2) * mpmath.mpf(sigma) ** 2
        K = exact_P * exact_H.T * S**-1
        x = np.array((K * mpmath.matrix(y.tolist())).tolist(), float).ravel()
        after = np.array(((mpmath.eye(6) - K * exact_H) * exact_P).tolist(), float)
        residual = mpmath.matrix(y.tolist())
        exact_nis = float((residual.T * S**-1 * residual)[0])
    d = np.sqrt(np.diag(after))
    # In units of the new sigmas a rounding of the prior counts (prior σ / new σ) times.
    rounding = 1e-15 * max(1.0, 2e-2 / sigma)
    assert np.abs((matrix(A, B, C) - after) / np.outer(d, d)).max() < 100.0 * rounding
    assert np.abs((np.array([*correction, *b]) - x) / d).max() < 100.0 * rounding * np.abs(x / d).max()
    assert nis == pytest.approx(exact_nis, rel=1e-9)


@pytest.mark.parametrize("angle", [0.9, 1.1, 3.0, 12.0])
def test_a_reset_of_any_size_is_a_rotation_of_the_covariance(angle):
    """Either side of where the polynomials give way; A and B against J_r in NumPy, q of norm one."""
    rng = np.random.default_rng(3)
    M = rng.standard_normal((6, 6))
    P = M @ M.T
    c = angle * np.array([-0.64, 0.6, 0.48])
    q = quaternion.normalize(rng.standard_normal(4))
    moved, A, B = filter_step.reset(tuple(q), tuple(P[np.triu_indices(3)]), tuple(P[:3, 3:].ravel()), tuple(c))
    G = kinematics.right_jacobian(c)
    assert np.linalg.norm(moved) == pytest.approx(1.0, abs=1e-13 if angle > 1.0 else 1e-9)
    assert abs(abs(np.dot(moved, quaternion.multiply(q, quaternion.exp(c)))) - 1.0) < 1e-9
    assert np.allclose(A, (G @ P[:3, :3] @ G.T)[np.triu_indices(3)], rtol=0.0, atol=1e-8)
    assert np.allclose(np.reshape(B, (3, 3)), G @ P[:3, 3:], rtol=0.0, atol=1e-8)


def test_direction_rows_are_the_derivative_of_the_measurement():
    generator = np.random.default_rng(5)
    q = quaternion.normalize(generator.normal(size=4))
    frame = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    frame *= np.linalg.det(frame)
    u, v, r = frame
    R = tuple(quaternion.to_matrix(q).ravel())
    for delta in np.eye(3) * 1e-6:
        true = quaternion.multiply(q, quaternion.exp(delta))
        z = quaternion.rotate(quaternion.conjugate(true), r)
        h1, y1, h2, y2 = filter_step.direction_rows(R, tuple(u), tuple(v), tuple(z))
        assert y1 == pytest.approx(np.dot(h1, delta), abs=3e-12)
        assert y2 == pytest.approx(np.dot(h2, delta), abs=3e-12)


def test_reset_is_the_change_of_tangent_space():
    """The new error is Log(exp(−a) ⊗ exp(δ)) for δ about a: its derivative by δ is J_r(a), found here by differences."""
    generator = np.random.default_rng(6)
    P = random_state(generator).covariance
    A, B, C = blocks(P)
    a = np.array([0.3, -0.2, 0.1])
    G = np.empty((3, 3))
    step = 1e-6
    for j in range(3):
        shift = np.zeros(3)
        shift[j] = step
        plus = quaternion.log(quaternion.multiply(quaternion.exp(-a), quaternion.exp(a + shift)))
        minus = quaternion.log(quaternion.multiply(quaternion.exp(-a), quaternion.exp(a - shift)))
        G[:, j] = (plus - minus) / (2.0 * step)
    big = scipy.linalg.block_diag(G, np.eye(3))
    q, A, B = filter_step.reset((1.0, 0.0, 0.0, 0.0), A, B, tuple(a))
    assert np.allclose(matrix(A, B, C), big @ P @ big.T, rtol=0.0, atol=1e-9 * P.max())
    assert np.allclose(q, quaternion.exp(a), rtol=0.0, atol=1e-15)


def across(x):
    """Variance across the axis of turn over σ_v² dt: |J_r|² = 2(1 − cos x)/x²."""
    return 2.0 * (1.0 - math.cos(x)) / x**2


def test_the_simulated_gyros_errors_have_that_covariance():
    """20 000 increments of 2 rad about z, each turned into an attitude by itself."""
    n, dt, sigma = 20_000, 0.01, 1e-3
    body = motion.ConstantRate(rate=(0.0, 0.0, 200.0))
    edges = np.arange(n + 1) * dt
    spec = gyro.GyroSpec(angle_random_walk=sigma)
    output = gyro.simulate(spec, body.increments(edges), edges, np.random.default_rng(4))
    true = quaternion.exp(np.array([0.0, 0.0, 2.0]))
    error = quaternion.log(quaternion.multiply(quaternion.conjugate(quaternion.exp(output.increments)), true))
    covariance = error.T @ error / n / (sigma**2 * dt)
    spread = math.sqrt(2.0 / n)  # of a variance over itself
    expected = np.array([across(2.0), across(2.0), 1.0])
    assert np.all(np.abs(np.diag(covariance) / expected - 1.0) < 4.0 * spread)
    assert np.all(np.abs(covariance - np.diag(np.diag(covariance))) < 4.0 / math.sqrt(n))


@pytest.mark.parametrize("x", [0.1, 0.35, 1.0, 2.0])
def test_the_filter_is_off_by_no_more_than_its_docstring_says(x):
    """Too large across the axis, never too small: 1 % of the variance at 0.35 rad a sample, 9 % at 1 rad, 41 % at 2 rad."""
    dt, sigma = 0.01, 1e-3
    record = records.ImuRecord(time=np.array([0.0, dt]), increments=np.array([[0.0, 0.0, x]]))
    start = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-9, bias_sigma=1e-12)
    noise = estimation.ProcessNoise(angle_random_walk=sigma, rate_random_walk=0.0)
    P = estimation.run(record, noise, start, full_covariance=True).covariance[-1] / (sigma**2 * dt)
    assert P[2, 2] == pytest.approx(1.0, rel=1e-6)
    for axis in (0, 1):
        excess = P[axis, axis] / across(x) - 1.0
        assert -1e-6 <= excess <= 1.0 / across(x) - 1.0 + 1e-6
        assert excess <= {0.1: 0.00084, 0.35: 0.0103, 1.0: 0.088, 2.0: 0.413}[x]
