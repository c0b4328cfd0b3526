"""Attitudes in other quantities: Euler angles with σ, heading from North, and North-East-Down.

The fixed frame of an estimate is East-North-Up (without a magnetometer z up with an arbitrary heading), and ``q_fb`` transforms body
vectors to it. For rotation matrices and SciPy rotations see :func:`strapdown.quaternion.to_matrix` and
:func:`strapdown.quaternion.to_rotation`.

Covariances are those of the body-side error, ``q_true = q_est ⊗ exp(δθ)``. If only variances were stored, correlations between axes are
unknown, and σ of angles is that of a diagonal covariance; ``full_covariance=True`` stores the full covariance.
"""

from __future__ import annotations

import itertools
import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, unit_quaternions
from strapdown.kinematics import skew

__all__ = ["Angles", "euler", "heading"]

FRAMES = ("ENU", "NED")
NED_OF_ENU = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
"""Quaternion from East-North-Up to North-East-Down and back: 180° about the horizontal axis to the north-east."""
FIXED_FRAMES = {
    "East-North-Up": np.array([1.0, 0.0, 0.0, 0.0]),
    "North-East-Down": NED_OF_ENU,
    "North-West-Up": np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]),
}
"""Quaternions from usual fixed frames to East-North-Up."""


class Angles(NamedTuple):
    """Angles with their standard deviations.

    Parameters
    ----------
    angles : ndarray (n, 3) or (n,)
        Angles, rad.
    sigma : ndarray, optional
        Standard deviations in the same shape, rad; None without a covariance, infinite in gimbal lock.
    """

    angles: Array
    sigma: Array | None


def euler(attitude: ArrayLike, sequence: str = "ZYX", covariance: ArrayLike | None = None) -> Angles:
    """Return Euler angles of attitudes, and their standard deviations.

    Parameters
    ----------
    attitude : array_like (n, 4)
        Unit quaternions q_fb.
    sequence : str, default "ZYX"
        Axes of the three rotations in SciPy's notation: upper case about the rotating body axes (``"ZYX"``: yaw, pitch, roll), lower
        case about the fixed axes. Adjacent axes must differ.
    covariance : array_like (n, 3, 3), optional
        Covariance of the body-side attitude error, rad².

    Returns
    -------
    Angles
        ``angles`` (n, 3) in the order of the sequence, rad. To first order ``δθ = E δφ``, where the columns of E are the axes of the
        three rotations in the body frame; ``σ²`` is the diagonal of ``E⁻¹ P E⁻ᵀ``.

    Examples
    --------
    >>> euler([[1.0, 0.0, 0.0, 0.0]]).angles.tolist()
    [[0.0, 0.0, 0.0]]
    """
    q = unit_quaternions("attitude", array("attitude", attitude, ("n", 4)))
    axes = [*sequence.upper()]
    repeated = any(a == b for a, b in itertools.pairwise(axes))
    if len(axes) != 3 or set(axes) - set("XYZ") or sequence not in (sequence.upper(), sequence.lower()) or repeated:
        raise InputError(
            f"sequence is {sequence!r}; give three axes such as ZYX (body) or xyz (fixed), neighbours different"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gimbal lock is reported by an infinite σ
        angles = np.asarray(quaternion.to_rotation(q).as_euler(sequence), np.float64)
    if covariance is None:
        return Angles(angles, None)
    P = array("covariance", covariance, (len(q), 3, 3))
    intrinsic = sequence == sequence.upper()
    E = _turn_axes(angles, sequence)
    regular = np.abs(np.linalg.det(E)) > 1e-9
    variance = np.full((len(q), 3), np.inf)
    inverse = np.linalg.inv(E[regular])
    variance[regular] = np.einsum("nij,njk,nik->ni", inverse, P[regular], inverse)
    sigma = np.sqrt(variance)
    return Angles(angles, sigma if intrinsic else sigma[:, ::-1])


def euler_axes(attitude: ArrayLike) -> Array:
    """Return E (n, 3, 3) of ``δθ = E δφ``: its columns are the axes of the three rotations of the sequence ZYX, body frame."""
    return _turn_axes(euler(attitude).angles, "ZYX")


def _turn_axes(angles: Array, sequence: str) -> Array:
    axes = [*sequence.upper()]
    # Rotations about fixed axes are those about body axes in reverse order.
    order = [0, 1, 2] if sequence == sequence.upper() else [2, 1, 0]
    directions = np.eye(3)[["XYZ".index(axes[k]) for k in order]]
    half = 0.5 * angles[:, order]
    turns = [
        np.concatenate([np.cos(half[:, k : k + 1]), np.sin(half[:, k : k + 1]) * directions[k]], axis=1)
        for k in range(3)
    ]
    E = np.empty((len(angles), 3, 3))
    E[:, :, 2] = directions[2]
    E[:, :, 1] = quaternion.rotate(quaternion.conjugate(turns[2]), directions[1])
    E[:, :, 0] = quaternion.rotate(quaternion.conjugate(quaternion.multiply(turns[1], turns[2])), directions[0])
    return E


def heading(attitude: ArrayLike, covariance: ArrayLike | None = None) -> Angles:
    """Return the heading of the body x axis, its angle from North towards East, and its standard deviation.

    Parameters
    ----------
    attitude : array_like (n, 4)
        Unit quaternions q_fb, fixed frame East-North-Up. North is that of the estimate: magnetic, or arbitrary without a magnetometer.
    covariance : array_like (n, 3, 3), optional
        Covariance of the body-side attitude error, rad².

    Returns
    -------
    Angles
        Heading (n,), rad in [0, 2π); σ is infinite if the axis points up or down.

    Examples
    --------
    >>> heading([[1.0, 0.0, 0.0, 0.0]]).angles.round(6).tolist()  # x points East
    [1.570796]
    """
    q = unit_quaternions("attitude", array("attitude", attitude, ("n", 4)))
    R = quaternion.to_matrix(q)
    v = R[:, :, 0]
    angle = np.mod(np.arctan2(v[:, 0], v[:, 1]), 2.0 * np.pi)
    if covariance is None:
        return Angles(angle, None)
    P = array("covariance", covariance, (len(q), 3, 3))
    change = -R @ skew(np.eye(3)[0])  # d(R x)/dδθ
    level = v[:, 0] ** 2 + v[:, 1] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        row = (v[:, 1, None] * change[:, 0] - v[:, 0, None] * change[:, 1]) / level[:, None]
        sigma = np.sqrt(np.einsum("ni,nij,nj->n", row, P, row))
    return Angles(angle, np.where(level > 1e-18, sigma, np.inf))


def to_ned(attitude: ArrayLike) -> Array:
    """Return attitudes q_fb (n, 4) with the fixed frame changed from East-North-Up to North-East-Down, or back."""
    return quaternion.multiply(NED_OF_ENU, array("attitude", attitude, (..., 4)))
