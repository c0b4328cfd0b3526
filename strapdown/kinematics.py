"""Kinematics of attitude: rates and quaternion derivatives, equations (3), (4), (15)–(17), and the Jacobians of the rotation vector.

Equation numbers are those of *Quaternion differentiation*. ``w_b`` is the angular velocity in body axes (W̄ there), ``w_f`` the same vector
in fixed axes (W there), rad/s, shapes (..., 3).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, array

__all__ = [
    "body_quaternion_derivative",
    "body_rate",
    "body_to_fixed_rate",
    "fixed_quaternion_derivative",
    "fixed_rate",
    "fixed_to_body_rate",
    "skew",
]


def _pure(v: Array) -> Array:
    """Return vectors as quaternions with zero scalar part, equation (2)."""
    return np.concatenate([np.zeros((*v.shape[:-1], 1)), v], axis=-1)


def fixed_quaternion_derivative(q: ArrayLike, w_f: ArrayLike) -> Array:
    """Return q̇ = ½ W ⊗ q for a rate in fixed axes, equation (3); in components equation (4).

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb.
    w_f : array_like (..., 3)
        Angular rate in fixed axes, rad/s.

    Returns
    -------
    ndarray (..., 4)
        q̇, 1/s.

    Examples
    --------
    >>> fixed_quaternion_derivative([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0]).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    return 0.5 * quaternion.multiply(_pure(array("w_f", w_f, (..., 3))), q)


def body_quaternion_derivative(q: ArrayLike, w_b: ArrayLike) -> Array:
    """Return q̇ = ½ q ⊗ W̄ for a rate in body axes, equation (17).

    This is the process model of the filters.

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb.
    w_b : array_like (..., 3)
        Angular rate in body axes, rad/s.

    Returns
    -------
    ndarray (..., 4)
        q̇, 1/s.
    """
    return 0.5 * quaternion.multiply(q, _pure(array("w_b", w_b, (..., 3))))


def fixed_rate(q: ArrayLike, q_dot: ArrayLike) -> Array:
    """Return the rate in fixed axes, the vector part of 2 q̇ ⊗ q⁻¹, equation (15).

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb.
    q_dot : array_like (..., 4)
        Time derivative q̇, 1/s.

    Returns
    -------
    ndarray (..., 3)
        w_f, rad/s.
    """
    return 2.0 * quaternion.multiply(q_dot, quaternion.inverse(q))[..., 1:]


def body_rate(q: ArrayLike, q_dot: ArrayLike) -> Array:
    """Return the rate in body axes, the vector part of 2 q⁻¹ ⊗ q̇, equation (17) solved for W̄.

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb.
    q_dot : array_like (..., 4)
        Time derivative q̇, 1/s.

    Returns
    -------
    ndarray (..., 3)
        w_b, rad/s.
    """
    return 2.0 * quaternion.multiply(quaternion.inverse(q), q_dot)[..., 1:]


def body_to_fixed_rate(q: ArrayLike, w_b: ArrayLike) -> Array:
    """Return w_f = q ⊗ w_b ⊗ q⁻¹, equation (16).

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb.
    w_b : array_like (..., 3)
        Angular rate in body axes, rad/s.

    Returns
    -------
    ndarray (..., 3)
        w_f, rad/s.
    """
    return quaternion.rotate(q, w_b)


def fixed_to_body_rate(q: ArrayLike, w_f: ArrayLike) -> Array:
    """Return w_b = q⁻¹ ⊗ w_f ⊗ q, the inverse of equation (16).

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb.
    w_f : array_like (..., 3)
        Angular rate in fixed axes, rad/s.

    Returns
    -------
    ndarray (..., 3)
        w_b, rad/s.
    """
    return quaternion.rotate(quaternion.conjugate(q), w_f)


def skew(v: ArrayLike) -> Array:
    """Return the skew-symmetric matrices [v] with [v] u = v × u.

    Parameters
    ----------
    v : array_like (..., 3)
        Vectors.

    Returns
    -------
    ndarray (..., 3, 3)
        Matrices.

    Examples
    --------
    >>> skew([1.0, 2.0, 3.0]).tolist()
    [[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]]
    """
    vector = array("v", v, (..., 3))
    result = np.zeros((*vector.shape[:-1], 3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        result[..., k, j] = vector[..., i]
        result[..., j, k] = -vector[..., i]
    return result


# Below θ² = 4 the series is used, which has converged there; above it the closed form, whose cancellation costs at most two bits.
_JOIN = 4.0
_THIRD = np.array([(-1.0) ** k / math.factorial(2 * k + 3) for k in range(15)])


def right_jacobian(rotation_vector: ArrayLike) -> Array:
    """Return the right Jacobian J_r(φ) (..., 3, 3) of rotation vectors (..., 3), rad, of any length θ: w_b = J_r(φ) φ̇.

    ``J_r = I − (1 − cos θ)/θ² [φ] + (θ − sin θ)/θ³ [φ]²`` (Solà, Deray & Atchuthan 2018, *A micro Lie theory*, eq. (143)); to first order
    in δ, exp(φ + δ) = exp(φ) ⊗ exp(J_r(φ) δ).
    """
    phi = array("rotation_vector", rotation_vector, (..., 3))
    theta = np.linalg.norm(phi, axis=-1)
    x, safe = theta * theta, np.maximum(theta, math.sqrt(_JOIN))
    sinc_half = np.sinc(theta / (2.0 * math.pi))  # (1 − cos θ)/θ² = ½ sinc²(θ/2) has no cancellation at any θ
    series = np.polynomial.polynomial.polyval(np.minimum(x, _JOIN), _THIRD)
    third = np.where(x < _JOIN, series, (safe - np.sin(safe)) / safe**3)
    cross = skew(phi)
    return np.asarray(
        np.eye(3) - (0.5 * sinc_half**2)[..., None, None] * cross + third[..., None, None] * (cross @ cross)
    )
