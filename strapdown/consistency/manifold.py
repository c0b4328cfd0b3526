"""The error of an estimate on the manifold of attitudes, and its normalised square."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError, array

SUBSETS: dict[str, tuple[int, ...]] = {
    "state": (0, 1, 2, 3, 4, 5),
    "attitude": (0, 1, 2),
    "bias": (3, 4, 5),
}
"""Subsets of the error state by name; any other is a tuple of indices."""


def errors(attitude: ArrayLike, bias: ArrayLike, true_attitude: ArrayLike, true_bias: ArrayLike) -> Array:
    """Return the error state e = (Log(q_est⁻¹ ⊗ q_true), b_true − b_est).

    Parameters
    ----------
    attitude : array_like (..., 4)
        Estimated q_fb.
    bias : array_like (..., 3)
        Estimated gyro bias, rad/s, body axes.
    true_attitude : array_like (..., 4)
        True q_fb.
    true_bias : array_like (..., 3)
        True gyro bias, rad/s, body axes.

    Returns
    -------
    ndarray (..., 6)
        Attitude error as a rotation vector in the body frame, rad, and bias error, rad/s.

    Examples
    --------
    >>> from strapdown import consistency, quaternion
    >>> true = quaternion.exp([0.0, 0.0, 0.01])
    >>> consistency.errors([1.0, 0.0, 0.0, 0.0], [0.0] * 3, true, [1e-5, 0.0, 0.0]).round(6).tolist()
    [0.0, 0.0, 0.01, 1e-05, 0.0, 0.0]
    """
    rows = [np.shape(value)[:-1] for value in (attitude, bias, true_attitude, true_bias)]
    try:
        np.broadcast_shapes(*rows)
    except ValueError:
        raise InputError(
            f"attitude, bias, true_attitude and true_bias have {', '.join(map(str, rows))} rows; give all at the same times"
        ) from None
    q, true_q = array("attitude", attitude, (..., 4)), array("true_attitude", true_attitude, (..., 4))
    b, true_b = (
        array(name, value, (..., 3), allow_nan=True) for name, value in (("bias", bias), ("true_bias", true_bias))
    )
    turn = quaternion.multiply(quaternion.conjugate(q), true_q)
    return np.concatenate([quaternion.log(turn), true_b - b], axis=-1)


def whitened(error: ArrayLike, covariance: ArrayLike) -> Array:
    """Return L⁻¹ e (..., n) with P = L Lᵀ: independent standard normal if the covariance is right."""
    e = array("error", error, (..., "n"))
    P = array("covariance", covariance, (..., e.shape[-1], e.shape[-1]))
    try:
        factor = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        least = np.linalg.eigvalsh(P)[..., 0]
        place = [int(i) for i in np.unravel_index(np.argmin(least), least.shape)]
        raise InputError(
            f"covariance{place or ''} is not positive definite (smallest eigenvalue {least.min():.3g})"
        ) from None
    return np.asarray(np.linalg.solve(factor, e[..., None])[..., 0])


def nees(error: ArrayLike, covariance: ArrayLike, states: tuple[int, ...] | None = None) -> Array:
    """Return the normalised estimation error squared, eᵀ P⁻¹ e.

    Parameters
    ----------
    error : array_like (..., n)
        Errors of the states, for instance of :func:`errors`.
    covariance : array_like (..., n, n)
        The filter's covariance of these errors, in their units.
    states : tuple of int, optional
        Subset of the states (a value of ``strapdown.consistency.manifold.SUBSETS`` or any indices), whose marginal covariance is that
        block of P. Default: all.

    Returns
    -------
    ndarray (...,)
        χ² with the number of states as degrees of freedom if the filter is consistent.

    Raises
    ------
    InputError
        If the shapes do not agree, an index repeats, or a covariance is not positive definite.

    Examples
    --------
    >>> import numpy as np
    >>> from strapdown import consistency
    >>> float(consistency.nees([1.0, 2.0], np.diag([1.0, 4.0])))
    2.0
    """
    if states is not None:
        pick = list(states)
        e = array("error", error, (..., "n"))
        if not pick or len(set(pick)) < len(pick) or not all(0 <= k < e.shape[-1] for k in pick):
            raise InputError(f"states is {states}; give different indices from 0 to {e.shape[-1] - 1}")
        P = array("covariance", covariance, (..., e.shape[-1], e.shape[-1]))
        error, covariance = e[..., pick], P[..., pick, :][..., pick]
    white = whitened(error, covariance)
    return np.asarray(np.sum(white * white, axis=-1))
