"""Attitude from vector observations at one instant: from vertical and North, and the optimal solution of Wahba's problem.

Directions ``b_i`` are measured in the body frame and known as ``r_i`` in the fixed frame. The attitude ``q_fb``, matrix R, minimises
Wahba's loss ``½ Σ |b_i − Rᵀ r_i|² / σ_i²`` (Wahba 1965, SIAM Review 7). ``σ_i`` is the noise of each of the *two* components across the
direction, rad: ``E[n nᵀ] = σ² (I − b bᵀ)``, the QUEST measurement model (Shuster & Oh 1981, J. Guidance and Control 4).

Every vector is divided by its length: only its direction is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, place
from strapdown.kernels.alignment import first_attitude
from strapdown.kinematics import skew
from strapdown.units import DEGREE

__all__ = ["InconsistentError", "Solution", "from_vertical_and_heading", "solve"]

INCONSISTENT = 6.0
"""Maximum error of the angle between two measured directions, σ; correct data exceed it in two of 1e9 pairs."""

LARGEST_UNCERTAINTY = 1.0
"""Maximum 1σ of a component of the attitude, rad, for it to count as determined (a uniform angle has 1.8)."""

MIN_HORIZONTAL_ANGLE = 1e-3
"""Minimum angle between magnetic field and vertical for a heading, rad."""

MIN_WEIGHT = 1e-12
"""Minimum weight 1/σ² in the matrix of the SVD, relative to the largest weight; double precision cannot represent a larger ratio."""

ROUNDING = 1e-15
"""Rounding error of the direction of a unit vector, rad."""
MAX_STEPS = 10
"""Maximum number of Gauss–Newton steps."""


def from_vertical_and_heading(up_b: ArrayLike, magnetic_b: ArrayLike) -> Array:
    """Return the attitude in the East-North-Up frame (x East, y magnetic North, z up).

    Parameters
    ----------
    up_b : array_like (3,)
        Specific force of a body at rest (an accelerometer then measures *up*), any unit, body axes.
    magnetic_b : array_like (3,)
        Magnetic field without hard and soft iron, any unit, body axes.

    Returns
    -------
    ndarray (4,)
        Unit quaternion q_fb (TRIAD; Black 1964). The vertical is matched exactly; only the horizontal part of the field is used, which
        points North whatever the dip.
    """
    up, field = _directions("up_b", up_b, (3,)), _directions("magnetic_b", magnetic_b, (3,))
    angle = float(_angle(up, field))
    if min(angle, np.pi - angle) < MIN_HORIZONTAL_ANGLE:
        raise InputError(
            f"up_b and magnetic_b are {angle / DEGREE:.6g}° apart, less than {MIN_HORIZONTAL_ANGLE / DEGREE:.2g}° from one line: such a "
            "field gives no heading; check both"
        )
    return np.array(first_attitude(up.tolist(), field.tolist()))


class InconsistentError(InputError):
    """The angle of two directions differs between the frames by more than their noise allows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """The attitude that minimises Wahba's loss, and its uncertainty.

    Parameters
    ----------
    attitude : ndarray (4,)
        Unit quaternion q_fb, w ≥ 0.
    covariance : ndarray (3, 3)
        Covariance of the body-side error δθ, q_true = q ⊗ exp(δθ), rad²: ``[Σ (I − b bᵀ)/σ²]⁻¹``.
    loss : float
        Wahba's loss ``½ Σ |b − Rᵀ r|²/σ²`` at the minimum, half of a χ² with ``dof`` degrees of freedom if the data are correct.
    dof : int
        Degrees of freedom of the residual: two per direction, less three.
    """

    attitude: Array
    covariance: Array
    loss: float
    dof: int

    @property
    def probability(self) -> float:
        """Probability of a residual at least as large with correct data. Near 0: outlier, wrong reference or σ too small."""
        from scipy.special import chdtrc

        return float(chdtrc(self.dof, 2.0 * self.loss))


def solve(vectors_b: ArrayLike, references_f: ArrayLike, sigmas: ArrayLike) -> Solution:
    """Return the attitude that minimises Wahba's loss, with its covariance and residual.

    Markley's SVD method, followed by Gauss–Newton steps on the residuals. The matrix of the SVD is weighted by 1/σ², so its rounding
    rotates the attitude by up to 1e-16 (σ_max/σ_min)² rad about the least determined axis; the residuals, weighted by 1/σ, do not have
    this error.

    Parameters
    ----------
    vectors_b : array_like (n, 3)
        Directions measured in the body frame.
    references_f : array_like (n, 3)
        The same directions in the fixed frame, in the same order.
    sigmas : array_like (n,) or float
        Noise of each component across each direction, rad.

    Returns
    -------
    Solution
        Attitude, covariance, loss and degrees of freedom.

    Raises
    ------
    InputError
        If there are fewer than two directions, one is zero or not finite, all lie on one line within the noise, or the angle of a
        pair differs between the frames by more than the noise allows (:class:`InconsistentError`).

    Examples
    --------
    >>> solution = solve([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 1e-3)
    >>> solution.attitude.tolist(), solution.dof
    ([1.0, 0.0, 0.0, 0.0], 1)
    """
    b, r = _directions("vectors_b", vectors_b, ("n", 3)), _directions("references_f", references_f, ("n", 3))
    if len(b) != len(r) or len(b) < 2:
        raise InputError(
            f"vectors_b has {len(b)} directions and references_f {len(r)}; give two or more, in pairs, that are not on one line"
        )
    sigma = array("sigmas", sigmas, (...,))
    if sigma.shape not in ((), (len(b),)):
        raise InputError(
            f"sigmas has shape {sigma.shape}, wanted ({len(b)},); give one number a direction, or one for all"
        )
    sigma = np.broadcast_to(sigma, len(b))
    if np.any(sigma <= 0.0):
        k = int(np.argmax(sigma <= 0.0))
        raise InputError(f"sigmas[{k}] is {sigma[k]:g} rad; every direction needs a σ greater than zero")
    _refuse_inconsistent(b, r, sigma)
    _refuse_undetermined("references_f", r, sigma)
    _refuse_undetermined("vectors_b", b, sigma)

    attitude = _refined(_svd(b, r, sigma), b, r, sigma)
    attitude = -attitude if attitude[0] < 0.0 else attitude
    predicted = _to_body(attitude, r)
    root = np.linalg.inv(_factorised(predicted, b - predicted, sigma)[0])
    return Solution(
        attitude=attitude,
        covariance=np.asarray(root @ root.T),
        loss=float(0.5 * np.sum(np.square((b - predicted) / sigma[:, None]))),
        dof=2 * len(b) - 3,
    )


def _to_body(attitude: Array, vectors_f: Array) -> Array:
    return quaternion.rotate(quaternion.conjugate(attitude), vectors_f)


def _svd(b: Array, r: Array, sigma: Array) -> Array:
    """Return the R of largest tr(R Bᵀ), B = Σ a r bᵀ = U S Vᵀ: U diag(1, 1, det U det V) Vᵀ (Markley 1988, J. Astronaut. Sci. 36)."""
    # Only ratios of weights matter: the most precise direction has weight 1. The Gauss–Newton steps correct the effect of the minimum.
    weight = np.maximum(np.square(np.min(sigma) / sigma), MIN_WEIGHT)
    U, _, Vt = np.linalg.svd((weight[:, None] * r).T @ b)
    return quaternion.from_matrix(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))]) @ Vt)


def _factorised(predicted: Array, residual: Array, sigma: Array) -> tuple[Array, Array]:
    """Return (T, y): δθ = T⁻¹ y minimises Σ |residual − [predicted] δθ|²/σ², and its covariance is T⁻¹ T⁻ᵀ.

    By orthogonal factorisation: the normal equations would lose the digits of the smallest weights.
    """
    rows = (skew(predicted) / sigma[:, None, None]).reshape(-1, 3)
    Q, triangle = np.linalg.qr(rows)
    return triangle, Q.T @ (residual / sigma[:, None]).ravel()


def _refined(attitude: Array, b: Array, r: Array, sigma: Array) -> Array:
    """Return the attitude after Gauss–Newton steps on Wahba's loss, down to the size of rounding errors."""
    for _ in range(MAX_STEPS):
        predicted = _to_body(attitude, r)
        step = np.linalg.solve(*_factorised(predicted, b - predicted, sigma))
        attitude = quaternion.normalize(quaternion.multiply(attitude, quaternion.exp(step)))
        if np.max(np.abs(step)) < ROUNDING:
            break
    return attitude


def _directions(name: str, value: ArrayLike, shape: tuple[int | str, ...]) -> Array:
    """Return vectors divided by their lengths."""
    vector = array(name, value, shape)
    largest = np.max(np.abs(vector), axis=-1, keepdims=True)
    if np.any(largest == 0.0):
        index = np.argwhere(largest[..., 0] == 0.0)[0]
        raise InputError(f"{place(name, index)} is the zero vector, which has no direction; leave it out")
    # Scaled by the largest component first, so that no square overflows or underflows.
    scaled = vector / largest
    return np.asarray(scaled / np.linalg.norm(scaled, axis=-1, keepdims=True))


def _angle(u: Array, v: Array) -> Array:
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), np.sum(u * v, axis=-1)))


def _refuse_inconsistent(b: Array, r: Array, sigma: Array) -> None:
    """Reject pairs whose angle differs between the frames by more than the noise allows."""
    i, j = np.triu_indices(len(b), 1)
    angle_b, angle_f = _angle(b[i], b[j]), _angle(r[i], r[j])
    allowed = INCONSISTENT * np.hypot(sigma[i], sigma[j]) + 4.0 * ROUNDING
    excess = np.abs(angle_b - angle_f) / allowed
    k = int(np.argmax(excess))
    if excess[k] > 1.0:
        raise InconsistentError(
            f"directions {i[k]} and {j[k]} are {angle_b[k] / DEGREE:.6g}° apart in the body frame but {angle_f[k] / DEGREE:.6g}° in the "
            f"fixed frame, where the noise allows a difference of {allowed[k] / DEGREE:.3g}° ({INCONSISTENT:g} σ); check for a mixed-up "
            "pair, a reference in another frame, an outlier or a σ too small"
        )


def _refuse_undetermined(name: str, vectors: Array, sigma: Array) -> None:
    """Reject directions that lie on one line within the noise, so that a rotation is undetermined."""
    rows = skew(vectors) / np.maximum(sigma, ROUNDING)[:, None, None]
    least = float(np.linalg.svd(rows.reshape(-1, 3), compute_uv=False)[-1])
    if least < 1.0 / LARGEST_UNCERTAINTY:
        i, j = np.triu_indices(len(vectors), 1)
        angle = _angle(vectors[i], vectors[j])
        k = int(np.argmax(np.minimum(angle, np.pi - angle)))
        uncertainty = "without bound" if least == 0.0 else f"{1.0 / least:.3g} rad"
        raise InputError(
            f"{name}: the attitude is not determined, the 1σ of its least determined rotation is {uncertainty}; of all pairs, directions "
            f"{i[k]} and {j[k]} are furthest from one line, {angle[k] / DEGREE:.6g}° apart; add a direction away from that line, or give "
            "smaller sigmas (rad) if the noise is smaller"
        )
