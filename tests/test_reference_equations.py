"""Every numbered equation of *Quaternion differentiation*, (1) to (18), by its number.

The oracle is one rotating body, evaluated to 50 digits by three Euler angles that change with time: its attitude as a product of 2×2
complex matrices, its rates from the derivative of its rotation matrix. Derivatives are mpmath's. The package under test enters none of it.
"""

from dataclasses import dataclass

import mpmath as mp
import numpy as np
import pytest

from strapdown import kinematics, quaternion
from strapdown.motion import Coning

DIGITS = 50
TIMES = (0.0, 0.37, 1.9, 4.2)
CLOSE = 2e-14


def euler_angles(t):
    return mp.mpf("0.4") + mp.sin(t), 1 + mp.mpf("0.5") * mp.cos(2 * t), 3 * t - mp.mpf("0.2") * t * t


def quaternion_path(t):
    """Components of q(t): rotations about z, x, z as 2×2 complex matrices, multiplied."""
    a, b, c = (angle / 2 for angle in euler_angles(t))
    about_z = [mp.matrix([[mp.expj(-h), 0], [0, mp.expj(h)]]) for h in (a, c)]
    about_x = mp.matrix([[mp.cos(b), -1j * mp.sin(b)], [-1j * mp.sin(b), mp.cos(b)]])
    product = about_z[0] * about_x * about_z[1]
    return [mp.re(product[0, 0]), -mp.im(product[1, 0]), mp.re(product[1, 0]), -mp.im(product[0, 0])]


def matrix_path(t):
    """R(t), body to fixed: elementary rotations of vectors about z, x, z."""
    a, b, c = euler_angles(t)

    def z(h):
        return mp.matrix([[mp.cos(h), -mp.sin(h), 0], [mp.sin(h), mp.cos(h), 0], [0, 0, 1]])

    return z(a) * mp.matrix([[1, 0, 0], [0, mp.cos(b), -mp.sin(b)], [0, mp.sin(b), mp.cos(b)]]) * z(c)


def derivative(function, t):
    return mp.diff(function, t)


def floats(values):
    return np.array([float(v) for v in values])


@dataclass(frozen=True, kw_only=True)
class Body:
    """What the oracle says of the body at one time."""

    q: np.ndarray
    q_dot: np.ndarray
    inverse_dot: np.ndarray
    w_f: np.ndarray
    w_b: np.ndarray
    r_0: np.ndarray
    r_t: np.ndarray
    r_dot: np.ndarray


@pytest.fixture(scope="module", params=TIMES, ids=lambda t: f"t={t}")
def body(request) -> Body:
    with mp.workdps(DIGITS):
        t = mp.mpf(request.param)
        q_dot = [derivative(lambda s, k=k: quaternion_path(s)[k], t) for k in range(4)]
        R = matrix_path(t)
        R_dot = mp.matrix(3, 3)
        for i in range(3):
            for j in range(3):
                R_dot[i, j] = derivative(lambda s, i=i, j=j: matrix_path(s)[i, j], t)
        fixed, moving = R_dot * R.T, R.T * R_dot  # the skew matrices of both rates
        r_0 = mp.matrix(["0.3", "-1.2", "0.7"])
        return Body(
            q=floats(quaternion_path(t)),
            q_dot=floats(q_dot),
            inverse_dot=floats([q_dot[0], -q_dot[1], -q_dot[2], -q_dot[3]]),
            w_f=floats([fixed[2, 1], fixed[0, 2], fixed[1, 0]]),
            w_b=floats([moving[2, 1], moving[0, 2], moving[1, 0]]),
            r_0=floats(r_0),
            r_t=floats(R * r_0),
            r_dot=floats(R_dot * r_0),
        )


def pure(v):
    return np.concatenate([[0.0], v])


def product(*factors):
    result = factors[0]
    for factor in factors[1:]:
        result = quaternion.multiply(result, factor)
    return result


def close(actual, wanted):
    np.testing.assert_allclose(actual, wanted, rtol=0.0, atol=CLOSE)


def test_equation_01_the_norm_is_one(body):
    close(np.sum(body.q**2), 1.0)
    close(np.sum(quaternion.normalize(3.0 * body.q) ** 2), 1.0)
    close(np.sum(quaternion.exp(body.r_0) ** 2), 1.0)


def test_equation_02_a_rate_is_a_quaternion_without_scalar_part(body):
    # q = 1 makes ½ W q the rate itself
    np.testing.assert_array_equal(
        2.0 * kinematics.fixed_quaternion_derivative(quaternion.IDENTITY, body.w_f), pure(body.w_f)
    )
    np.testing.assert_array_equal(
        2.0 * kinematics.body_quaternion_derivative(quaternion.IDENTITY, body.w_b), pure(body.w_b)
    )


def test_equation_03_derivative_from_the_fixed_rate(body):
    close(kinematics.fixed_quaternion_derivative(body.q, body.w_f), body.q_dot)
    close(0.5 * product(pure(body.w_f), body.q), body.q_dot)


def test_equation_04_components(body):
    q0, q1, q2, q3 = body.q
    wx, wy, wz = body.w_f
    components = [
        -(wx * q1 + wy * q2 + wz * q3) / 2.0,
        (wx * q0 + wy * q3 - wz * q2) / 2.0,
        (wy * q0 + wz * q1 - wx * q3) / 2.0,
        (wz * q0 + wx * q2 - wy * q1) / 2.0,
    ]
    close(kinematics.fixed_quaternion_derivative(body.q, body.w_f), components)
    close(components, body.q_dot)


def test_equation_05_a_vector_of_the_body_in_the_fixed_frame(body):
    close(quaternion.rotate(body.q, body.r_0), body.r_t)
    close(product(body.q, pure(body.r_0), quaternion.inverse(body.q)), pure(body.r_t))


def test_equation_06_its_derivative_by_the_product_rule(body):
    first = product(body.q_dot, pure(body.r_0), quaternion.inverse(body.q))
    second = product(body.q, pure(body.r_0), body.inverse_dot)
    close(first + second, pure(body.r_dot))


def test_equation_07_the_same_in_the_turned_vector(body):
    first = product(body.q_dot, quaternion.inverse(body.q), pure(body.r_t))
    second = product(pure(body.r_t), body.q, body.inverse_dot)
    close(first + second, pure(body.r_dot))


@pytest.mark.parametrize("norm", [1.0, 0.01, 300.0])
def test_equation_08_a_quaternion_times_its_inverse_is_one(body, norm):
    q = norm * body.q
    close(product(q, quaternion.inverse(q)), quaternion.IDENTITY)
    close(product(quaternion.inverse(q), q), quaternion.IDENTITY)


def test_equation_09_its_derivative_vanishes(body):
    close(product(body.q_dot, quaternion.inverse(body.q)) + product(body.q, body.inverse_dot), np.zeros(4))


def test_equation_10_velocity_as_a_commutator(body):
    p = product(body.q_dot, quaternion.inverse(body.q))
    close(product(p, pure(body.r_t)) - product(pure(body.r_t), p), pure(body.r_dot))


def test_equation_11_p_is_half_the_fixed_rate(body):
    p = product(body.q_dot, quaternion.inverse(body.q))
    close(p[1:], 0.5 * kinematics.fixed_rate(body.q, body.q_dot))
    close(p[1:], 0.5 * body.w_f)


def test_equation_12_inverse_of_a_unit_quaternion_is_its_conjugate(body):
    close(quaternion.inverse(body.q), body.q * [1.0, -1.0, -1.0, -1.0])
    np.testing.assert_array_equal(quaternion.conjugate(body.q), body.q * [1.0, -1.0, -1.0, -1.0])
    # the unnumbered equation after (12): p has no scalar part
    close(product(body.q_dot, quaternion.inverse(body.q))[0], 0.0)
    close(np.sum(body.q_dot * body.q), 0.0)


def test_equation_13_commutator_of_vectors_is_twice_their_cross_product(body):
    p = product(body.q_dot, quaternion.inverse(body.q))
    commutator = product(p, pure(body.r_t)) - product(pure(body.r_t), p)
    close(commutator, pure(2.0 * np.cross(p[1:], body.r_t)))
    close(commutator[1:], 2.0 * kinematics.skew(p[1:]) @ body.r_t)


def test_equation_14_velocity_is_rate_cross_radius(body):
    close(kinematics.skew(body.w_f) @ body.r_t, body.r_dot)
    close(np.cross(kinematics.fixed_rate(body.q, body.q_dot), body.r_t), body.r_dot)


@pytest.mark.parametrize("norm", [1.0, 7.0])
def test_equation_15_the_fixed_rate_from_the_derivative(body, norm):
    """The second norm: (15) holds for a quaternion of any constant norm, so a forgotten square in the inverse shows."""
    close(kinematics.fixed_rate(norm * body.q, norm * body.q_dot), body.w_f)
    close(kinematics.body_rate(norm * body.q, norm * body.q_dot), body.w_b)


def test_equation_16_body_rate_to_fixed_rate_and_back(body):
    close(kinematics.body_to_fixed_rate(body.q, body.w_b), body.w_f)
    close(kinematics.fixed_to_body_rate(body.q, body.w_f), body.w_b)
    close(product(body.q, pure(body.w_b), quaternion.inverse(body.q)), pure(body.w_f))


def test_equation_17_derivative_from_the_body_rate(body):
    close(kinematics.body_quaternion_derivative(body.q, body.w_b), body.q_dot)
    close(0.5 * product(body.q, pure(body.w_b)), body.q_dot)


@pytest.mark.parametrize("beta", [1e-3, 0.5, 2.5])
@pytest.mark.parametrize("frequency", [0.2, 10.0])
def test_equation_18_coning(beta, frequency):
    coning = Coning(angle=beta, frequency=frequency)
    omega = 2.0 * np.pi * frequency
    for t in (0.0, 0.013, 0.4):
        c, s = np.cos(omega * t), np.sin(omega * t)
        q = np.array([np.cos(beta / 2), np.sin(beta / 2) * c, np.sin(beta / 2) * s, 0.0])
        q_dot = omega * np.sin(beta / 2) * np.array([0.0, -s, c, 0.0])
        w_f = omega * np.array([-np.sin(beta) * s, np.sin(beta) * c, 1.0 - np.cos(beta)])
        w_b = omega * np.array([-np.sin(beta) * s, np.sin(beta) * c, np.cos(beta) - 1.0])
        attitude = coning.attitude(t)
        fixed_rate = kinematics.body_to_fixed_rate(attitude, coning.body_rate(t))
        close(attitude, q)
        close(quaternion.inverse(attitude), q * [1.0, -1.0, -1.0, -1.0])
        close(fixed_rate / omega, w_f / omega)
        close(coning.body_rate(t) / omega, w_b / omega)
        # and by (3), (15), (17) and the body twin of (15) all these belong together
        close(kinematics.fixed_quaternion_derivative(attitude, fixed_rate) / omega, q_dot / omega)
        close(kinematics.body_quaternion_derivative(attitude, coning.body_rate(t)) / omega, q_dot / omega)
        close(kinematics.fixed_rate(attitude, q_dot) / omega, w_f / omega)
        close(kinematics.body_rate(attitude, q_dot) / omega, w_b / omega)


def test_no_equation_is_left_out():
    tested = {int(name.split("_")[2]) for name in globals() if name.startswith("test_equation_")}
    assert tested == set(range(1, 19))
