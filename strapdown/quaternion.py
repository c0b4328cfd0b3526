"""Quaternion algebra: Hamilton product, scalar first ``(w, x, y, z)``, shape ``(..., 4)``, vectorised over leading axes.

A unit quaternion ``q_fb`` takes body vectors to the fixed frame, ``v_f = q_fb ⊗ v_b ⊗ q_fb⁻¹``. Equation numbers are those of
*Quaternion differentiation*; this is equation (5).
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, InputError, array, lengths, place, unit_quaternions

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

__all__ = [
    "IDENTITY",
    "angle_between",
    "conjugate",
    "exp",
    "from_matrix",
    "from_rotation",
    "inverse",
    "log",
    "multiply",
    "normalize",
    "rotate",
    "rotation_between",
    "to_matrix",
    "to_rotation",
]

IDENTITY: Array = np.array([1.0, 0.0, 0.0, 0.0])
IDENTITY.flags.writeable = False

LONGEST = 1e150
"""Maximum component of a rotation vector, rad; the square of a larger one overflows."""
ROTATION_MATRIX_TOLERANCE = 1e-6
"""Maximum entry of ``R Rᵀ − I`` of a rotation matrix."""


def multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Return the Hamilton product p ⊗ q.

    Parameters
    ----------
    p, q : array_like (..., 4)
        Quaternions of any norm; their leading axes broadcast.

    Returns
    -------
    ndarray (..., 4)
        Product p ⊗ q.

    Examples
    --------
    >>> multiply([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]).tolist()  # i j = k
    [0.0, 0.0, 0.0, 1.0]
    """
    a, b = array("p", p, (..., 4)), array("q", q, (..., 4))
    pw, px, py, pz = _components(a)
    qw, qx, qy, qz = _components(b)
    with _together(p=a, q=b):
        return np.stack(
            [
                pw * qw - px * qx - py * qy - pz * qz,
                pw * qx + px * qw + py * qz - pz * qy,
                pw * qy - px * qz + py * qw + pz * qx,
                pw * qz + px * qy - py * qx + pz * qw,
            ],
            axis=-1,
        )


def _components(value: Array) -> Array:
    """Return an array with its last axis first, as views: ``np.moveaxis`` takes ten times as long."""
    return value.transpose(-1, *range(value.ndim - 1))


@contextlib.contextmanager
def _together(**arrays: Array) -> Iterator[None]:
    """Raise an InputError if leading axes do not broadcast."""
    try:
        yield
    except ValueError:
        shapes = " and ".join(f"{name} has shape {value.shape}" for name, value in arrays.items())
        raise InputError(f"{shapes}; their leading axes must be equal, or 1") from None


def conjugate(q: ArrayLike) -> Array:
    """Return the conjugate (w, −x, −y, −z).

    Parameters
    ----------
    q : array_like (..., 4)
        Quaternions of any norm.

    Returns
    -------
    ndarray (..., 4)
        Conjugates; the inverses of unit quaternions, equation (12).
    """
    return np.asarray(array("q", q, (..., 4)) * np.array([1.0, -1.0, -1.0, -1.0]))


def inverse(q: ArrayLike) -> Array:
    """Return q⁻¹, so that q ⊗ q⁻¹ = 1, equation (8).

    Parameters
    ----------
    q : array_like (..., 4)
        Quaternions of any norm except zero.

    Returns
    -------
    ndarray (..., 4)
        The conjugate divided by the *squared* norm.

    Examples
    --------
    >>> inverse([2.0, 0.0, 0.0, 0.0]).tolist()
    [0.5, -0.0, -0.0, -0.0]
    """
    value = array("q", q, (..., 4))
    scale = _scale(value)
    value = value / scale
    return np.asarray(conjugate(value) / np.sum(value * value, axis=-1, keepdims=True) / scale)


def normalize(q: ArrayLike) -> Array:
    """Return quaternions divided by their norm, so that equation (1) holds.

    Parameters
    ----------
    q : array_like (..., 4)
        Quaternions of any norm except zero.

    Returns
    -------
    ndarray (..., 4)
        Unit quaternions.
    """
    value = array("q", q, (..., 4))
    value = value / _scale(value)
    return np.asarray(value / lengths(value)[..., None])


def _scale(value: Array) -> Array:
    """Return powers of two (..., 1) near the largest entry; scaled by them, squares neither overflow nor underflow, without rounding."""
    largest = functools.reduce(np.maximum, _components(np.abs(value)))[..., None]
    zero = largest[..., 0] == 0.0
    if np.any(zero):
        raise InputError(
            f"{place('q', np.argwhere(zero)[0])} is the zero quaternion, which has no direction; remove it"
        )
    return np.asarray(np.ldexp(1.0, np.frexp(largest)[1] - 1))


def rotate(q: ArrayLike, v: ArrayLike) -> Array:
    """Return q ⊗ v ⊗ q⁻¹, equation (5): body vectors in the fixed frame.

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb; their conjugates take fixed-frame vectors to the body.
    v : array_like (..., 3)
        Vectors in body axes, any unit; leading axes broadcast with those of q.

    Returns
    -------
    ndarray (..., 3)
        The vectors in fixed axes.

    Examples
    --------
    >>> rotate([0.5, 0.5, 0.5, 0.5], [1.0, 0.0, 0.0]).tolist()  # x → y → z → x
    [0.0, 1.0, 0.0]
    """
    value = unit_quaternions("q", q)
    vector = array("v", v, (..., 3))
    w, x, y, z = _components(value)
    vx, vy, vz = _components(vector)
    # v + 2 w (u × v) + 2 u × (u × v): no matrix, no loss for small angles
    with _together(q=value, v=vector):
        tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
        turned = (vx + w * tx + (y * tz - z * ty), vy + w * ty + (z * tx - x * tz), vz + w * tz + (x * ty - y * tx))
        return np.stack(turned, axis=-1)


def exp(rotation_vector: ArrayLike) -> Array:
    """Return the unit quaternion (cos θ/2, φ/θ sin θ/2) of a rotation vector φ of length θ.

    Parameters
    ----------
    rotation_vector : array_like (..., 3)
        φ, rad, of any length, each component at most 1e150.

    Returns
    -------
    ndarray (..., 4)
        Unit quaternions.

    Examples
    --------
    >>> exp([0.0, 0.0, np.pi]).round(12).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    phi = array("rotation_vector", rotation_vector, (..., 3))
    longest = float(np.max(np.abs(phi), initial=0.0))
    if longest > LONGEST:
        raise InputError(f"rotation_vector holds {longest:g} rad, more than {LONGEST:g} rad; check the unit")
    half = 0.5 * lengths(phi)
    # sin x / x needs no series: the quotient is accurate for every x but zero.
    safe = np.where(half > 0.0, half, 1.0)
    half_sinc = 0.5 * np.where(half > 0.0, np.sin(safe) / safe, 1.0)
    return np.stack([np.cos(half), *(half_sinc * component for component in _components(phi))], axis=-1)


def log(q: ArrayLike) -> Array:
    """Return the rotation vectors of unit quaternions, with an angle of at most π.

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb.

    Returns
    -------
    ndarray (..., 3)
        φ, rad, of length at most π. ``q`` and ``−q`` are the same attitude and give the same vector; at exactly π (w = 0) both ±φ are
        valid.

    Examples
    --------
    >>> log([0.0, 0.0, 0.0, 1.0]).round(6).tolist()
    [0.0, 0.0, 3.141593]
    """
    value = unit_quaternions("q", q)
    w, u = value[..., 0], value[..., 1:]
    # Scaled by its largest entry, so that the squares of a 1e-200 rad rotation do not underflow.
    largest = functools.reduce(np.maximum, _components(np.abs(u)))
    scale = np.where(largest > 0.0, largest, 1.0)
    norm = scale * lengths(u / scale[..., None])
    sign = np.where(w < 0.0, -1.0, 1.0)
    safe = np.where(norm > 0.0, norm, 1.0)
    factor = np.where(norm > 0.0, 2.0 * np.arctan2(norm, np.abs(w)) / safe, 2.0)
    return np.asarray((sign * factor)[..., None] * u)


def to_matrix(q: ArrayLike) -> Array:
    """Return the rotation matrices R_fb of unit quaternions, v_f = R_fb v_b.

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb.

    Returns
    -------
    ndarray (..., 3, 3)
        Rotation matrices.
    """
    from strapdown.kernels.rotation import rotation_matrix

    value = unit_quaternions("q", q)
    entries = rotation_matrix(tuple(_components(value)))
    return np.stack(entries, axis=-1).reshape(*value.shape[:-1], 3, 3)


def from_matrix(matrix: ArrayLike) -> Array:
    """Return the unit quaternions of rotation matrices.

    Parameters
    ----------
    matrix : array_like (..., 3, 3)
        Rotation matrices R_fb, v_f = R_fb v_b; orthogonal to 1e-6.

    Returns
    -------
    ndarray (..., 4)
        Unit quaternions q_fb, w ≥ 0.

    Notes
    -----
    Shepperd's method (1978): the largest of the four components is computed first, so that no branch divides by a small number.
    """
    R = array("matrix", matrix, (..., 3, 3))
    defect = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    if np.any(defect > ROTATION_MATRIX_TOLERANCE):
        raise InputError(
            f"matrix is not orthogonal: an entry of R Rᵀ − I is {np.max(defect):.3g}; orthonormalise it first"
        )
    if np.any(np.linalg.det(R) < 0.0):
        raise InputError("matrix is a reflection (determinant −1), not a rotation; check the signs of its axes")
    trace = np.trace(R, axis1=-2, axis2=-1)
    diagonal = np.diagonal(R, axis1=-2, axis2=-1)
    # Rows of 4 q qᵀ: the row of the largest component, normalised, is the quaternion.
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1.0 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[..., i + 1, i + 1] = 1.0 + 2.0 * diagonal[..., i] - trace
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
        outer[..., i + 1, j + 1] = outer[..., j + 1, i + 1] = R[..., i, j] + R[..., j, i]
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = row / np.linalg.norm(row, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0.0, -q, q))


def to_rotation(q: ArrayLike) -> Rotation:
    """Return a SciPy ``Rotation`` that takes body vectors to the fixed frame.

    Parameters
    ----------
    q : array_like (..., 4)
        Unit quaternions q_fb, scalar first.

    Returns
    -------
    scipy.spatial.transform.Rotation
        The same rotations; SciPy stores quaternions scalar last.
    """
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(unit_quaternions("q", q), -1, axis=-1))


def from_rotation(rotation: Rotation) -> Array:
    """Return the unit quaternions, scalar first, of a SciPy ``Rotation``.

    Parameters
    ----------
    rotation : scipy.spatial.transform.Rotation
        Rotations that take body vectors to the fixed frame.

    Returns
    -------
    ndarray (..., 4)
        Unit quaternions q_fb.
    """
    return np.roll(np.asarray(rotation.as_quat(), dtype=np.float64), 1, axis=-1)


def rotation_between(p: ArrayLike, q: ArrayLike) -> Array:
    """Return the rotation vector of the rotation that takes attitude p to attitude q, in body axes: log(p* ⊗ q).

    Parameters
    ----------
    p, q : array_like (..., 4)
        Unit quaternions; their leading axes broadcast.

    Returns
    -------
    ndarray (..., 3)
        Rotation vector, rad, at most π long; also accurate for small angles.

    Examples
    --------
    >>> rotation_between(IDENTITY, exp([0.0, 0.0, 0.5]))
    array([0. , 0. , 0.5])
    """
    return log(multiply(conjugate(p), q))


def angle_between(p: ArrayLike, q: ArrayLike) -> Array:
    """Return the angle of the rotation that takes attitude p to attitude q.

    Parameters
    ----------
    p, q : array_like (..., 4)
        Unit quaternions; their leading axes broadcast.

    Returns
    -------
    ndarray (...,)
        Angle, rad, in [0, π]; also accurate for small angles.

    Examples
    --------
    >>> float(angle_between(IDENTITY, exp([0.0, 0.0, 1e-9])).round(15))
    1e-09
    """
    return np.asarray(np.linalg.norm(rotation_between(unit_quaternions("p", p), unit_quaternions("q", q)), axis=-1))
