"""Attitude from vector observations at one instant: TRIAD, and the optimal solution of Wahba's problem with its covariance.

Directions ``b_i`` measured in the body frame are known as ``r_i`` in the fixed frame; wanted is the attitude ``q_fb``, matrix R,
that minimises Wahba's loss ``½ Σ |b_i − Rᵀ r_i|² / σ_i²`` (Wahba 1965, SIAM Review 7). ``σ_i`` is the noise of each of the *two*
components across the direction, rad: ``E[n nᵀ] = σ² (I − b bᵀ)``, the QUEST measurement model (Shuster & Oh 1981, J. Guidance and
Control 4).

Only directions count: every vector is divided by its length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, one_of
from strapdown.kinematics import skew
from strapdown.units import DEGREE

__all__ = [
    "InconsistentError",
    "Solution",
    "from_vertical_and_heading",
    "solve",
    "triad",
]

Method = Literal["svd", "davenport", "quest", "foam"]

INCONSISTENT = 6.0
"""Two measured directions whose angle is off by more than this many σ are inconsistent: chance exceeds it twice in 1e9 pairs."""

LARGEST_UNCERTAINTY = 1.0
"""A 1σ of the attitude, rad, beyond which a direction of it counts as undetermined (a uniform angle has 1.8)."""

LEAST_ANGLE = 1e-6
"""Smallest angle between two directions and one line, rad, where no σ is given to judge by."""

LEAST_HORIZONTAL_ANGLE = 1e-3
"""Angle between magnetic field and vertical, rad, below which there is no heading."""

LEAST_WEIGHT = 1e-12
"""Weights 1/σ² below this part of the largest are lifted to it in the matrices that the methods start from: doubles hold no more."""

ROUNDING = 1e-15
"""Rounding error of the direction of a unit vector, rad."""


# ----------------------------------------------------------------------------------------------------------------------
# Two directions


def triad(
    primary_b: ArrayLike,
    secondary_b: ArrayLike,
    primary_f: ArrayLike,
    secondary_f: ArrayLike,
    *,
    sigmas: ArrayLike | None = None,
) -> Array:
    """Return the attitude from two directions: the first is met exactly, the second fixes the rotation about it.

    Parameters
    ----------
    primary_b, secondary_b : array_like (..., 3)
        Directions measured in the body frame; the more accurate one first.
    primary_f, secondary_f : array_like (..., 3)
        The same directions in the fixed frame.
    sigmas : array_like (2,), optional
        Noise of both, rad. If given, the angle between the two must agree in both frames within the noise; it is not checked
        otherwise.

    Returns
    -------
    ndarray (..., 4)
        Unit quaternions q_fb (TRIAD; Black 1964).

    Raises
    ------
    InputError
        If two directions of one frame lie on one line, or their angles disagree beyond the noise.

    Examples
    --------
    >>> triad([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]).tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    first_b, second_b = _directions("primary_b", primary_b), _directions("secondary_b", secondary_b)
    first_f, second_f = _directions("primary_f", primary_f), _directions("secondary_f", secondary_f)
    if sigmas is not None:
        sigma = _sigmas(sigmas, (2,))
        _refuse_inconsistent(_stacked(first_b, second_b), _stacked(first_f, second_f), sigma)
    _refuse_parallel("primary_b", "secondary_b", first_b, second_b, LEAST_ANGLE)
    _refuse_parallel("primary_f", "secondary_f", first_f, second_f, LEAST_ANGLE)
    return _triad(first_b, second_b, first_f, second_f)


def triad_covariance(
    primary_b: ArrayLike, secondary_b: ArrayLike, primary_sigma: float, secondary_sigma: float
) -> Array:
    """Return the covariance of TRIAD's body-side error δθ, q_true = q ⊗ exp(δθ).

    Parameters
    ----------
    primary_b, secondary_b : array_like (..., 3)
        Directions in the body frame.
    primary_sigma, secondary_sigma : float
        Noise of each component across them, rad.

    Returns
    -------
    ndarray (..., 3, 3)
        Covariance, rad², body axes.

    Raises
    ------
    InputError
        If the two directions lie on one line.

    Notes
    -----
    With c, s the cosine and sine of the angle between the two and (b₁, u, e) the right-handed axes in which b₂ = c b₁ + s u: σ₁²
    about u and about e, ``(σ₂² + c² σ₁²)/s²`` about b₁, and ``c σ₁²/s`` between b₁ and u (Shuster & Oh 1981, in other letters).
    """
    first, second = _directions("primary_b", primary_b), _directions("secondary_b", secondary_b)
    _refuse_parallel("primary_b", "secondary_b", first, second, LEAST_ANGLE)
    sigma = _sigmas([primary_sigma, secondary_sigma], (2,))
    axes = _frame(first, second)
    cosine = np.sum(first * second, axis=-1)
    sine = np.linalg.norm(np.cross(first, second), axis=-1)
    # δθ in (b₁, u, e) as a matrix times three independent unit normals, so that the product is never indefinite.
    factor = np.zeros((*cosine.shape, 3, 3))
    factor[..., 0, 0] = sigma[1] / sine
    factor[..., 0, 1] = sigma[0] * cosine / sine
    factor[..., 1, 1] = factor[..., 2, 2] = sigma[0]
    root = axes @ factor
    return np.asarray(root @ np.swapaxes(root, -1, -2))


def from_vertical_and_heading(up_b: ArrayLike, magnetic_b: ArrayLike) -> Array:
    """Return the attitude in the East-North-Up frame (x East, y magnetic North, z up).

    Parameters
    ----------
    up_b : array_like (..., 3)
        Specific force of a body at rest (an accelerometer then measures *up*), any unit, body axes.
    magnetic_b : array_like (..., 3)
        Magnetic field without hard and soft iron, any unit, body axes.

    Returns
    -------
    ndarray (..., 4)
        Unit quaternions q_fb. The vertical is met exactly; of the field only the horizontal part counts, which points North
        whatever the dip. The covariance is :func:`triad_covariance` of the same two vectors.

    Raises
    ------
    InputError
        If a vector is zero or not finite, or the field is vertical.
    """
    up, field = _directions("up_b", up_b), _directions("magnetic_b", magnetic_b)
    _refuse_parallel("up_b", "magnetic_b", up, field, LEAST_HORIZONTAL_ANGLE)
    return _triad(up, field, np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]))


def _stacked(first: Array, second: Array) -> Array:
    return np.stack(np.broadcast_arrays(first, second), axis=-2)


def _frame(first: Array, second: Array) -> Array:
    """Return the axes (b₁, u, e) as columns (..., 3, 3): e along b₁ × b₂, u = e × b₁."""
    normal = np.cross(first, second)
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.stack(np.broadcast_arrays(first, np.cross(normal, first), normal), axis=-1)


def _triad(first_b: Array, second_b: Array, first_f: Array, second_f: Array) -> Array:
    return quaternion.from_matrix(_frame(first_f, second_f) @ np.swapaxes(_frame(first_b, second_b), -1, -2))


# ----------------------------------------------------------------------------------------------------------------------
# Any number of directions


class InconsistentError(InputError):
    """Directions whose angles differ between the frames by more than their noise explains."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """The attitude that minimises Wahba's loss, and its uncertainty.

    Parameters
    ----------
    attitude : ndarray (..., 4)
        Unit quaternions q_fb, w ≥ 0.
    covariance : ndarray (..., 3, 3)
        Covariance of the body-side error δθ, q_true = q ⊗ exp(δθ), rad²: ``[Σ (I − b bᵀ)/σ²]⁻¹``.
    loss : ndarray (...,)
        Wahba's loss ``½ Σ |b − Rᵀ r|²/σ²`` at the minimum.
    dof : int
        Degrees of freedom of the residual: two per direction, less three.
    """

    attitude: Array
    covariance: Array
    loss: Array
    dof: int

    @property
    def chi_square(self) -> Array:
        """Twice the loss: χ² with ``dof`` degrees of freedom if directions and σ are right."""
        return np.asarray(2.0 * self.loss)

    @property
    def probability(self) -> Array:
        """Probability that right data leave a residual at least as large (...,). Near 0: an outlier, a wrong reference or a σ too small."""
        from scipy.special import chdtrc

        return np.asarray(chdtrc(self.dof, self.chi_square))


def solve(
    vectors_b: ArrayLike, references_f: ArrayLike, sigmas: ArrayLike, *, method: Method = "svd", refine: bool = True
) -> Solution:
    """Return the attitude that minimises Wahba's loss, with its covariance and residual.

    Parameters
    ----------
    vectors_b : array_like (..., n, 3)
        Directions measured in the body frame.
    references_f : array_like (..., n, 3)
        The same directions in the fixed frame, in the same order.
    sigmas : array_like (..., n) or float
        Noise of each component across each direction, rad.
    method : {"svd", "davenport", "quest", "foam"}, default "svd"
        Methods with the same minimum and different arithmetic. ``foam`` needs n³ operations as implemented here, to keep its
        digits.
    refine : bool, default True
        End with Gauss–Newton steps on the residuals. The matrix that all methods start from holds 1/σ², so that its rounding
        rotates the attitude by up to 1e-16 (σ_max/σ_min)² rad about the worst known axis; the residuals hold 1/σ and do not.
        Without these steps keep σ_max/σ_min below 1e6.

    Returns
    -------
    Solution
        Attitude, covariance, loss and degrees of freedom.

    Raises
    ------
    InputError
        If there are fewer than two directions, one is zero or not finite, all lie on one line within the noise, or the angle of a
        pair differs between the frames by more than the noise explains (:class:`InconsistentError`).

    Examples
    --------
    >>> found = solve([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 1e-3)
    >>> found.attitude.tolist(), found.dof
    ([1.0, 0.0, 0.0, 0.0], 1)
    """
    one_of("method", method, _METHODS)
    b, r = _directions("vectors_b", vectors_b), _directions("references_f", references_f)
    for name, value in (("vectors_b", b), ("references_f", r)):
        if value.ndim < 2:
            raise InputError(f"{name} has shape {value.shape}, wanted (..., n, 3); pass one row a direction")
    if b.shape[-2] != r.shape[-2]:
        raise InputError(
            f"vectors_b has {b.shape[-2]} directions but references_f has {r.shape[-2]}; pass them in pairs"
        )
    if b.shape[-2] < 2:
        raise InputError(
            f"vectors_b has {b.shape[-2]} direction(s), which leaves the rotation about it undetermined; give two or more, not on one line"
        )
    try:
        b, r = (np.asarray(value) for value in np.broadcast_arrays(b, r))
    except ValueError:
        raise InputError(
            f"vectors_b has shape {b.shape} and references_f {r.shape}, which do not broadcast; give both the same leading axes"
        ) from None
    sigma = _sigmas(sigmas, b.shape[:-1])
    _refuse_inconsistent(b, r, sigma)
    _refuse_undetermined("references_f", r, sigma)
    _refuse_undetermined("vectors_b", b, sigma)

    # The best known direction has weight 1: only ratios matter. What the floor moves the Gauss–Newton steps move back.
    weight = np.maximum(np.square(np.min(sigma, axis=-1, keepdims=True) / sigma), LEAST_WEIGHT)
    attitude = _METHODS[method](b, r, weight)
    if refine:
        attitude = _refined(attitude, b, r, sigma)
    attitude = np.where(attitude[..., :1] < 0.0, -attitude, attitude)
    predicted = _to_body(attitude, r)
    root = np.linalg.inv(_factorised(predicted, b - predicted, sigma)[0])
    return Solution(
        attitude=attitude,
        covariance=np.asarray(root @ np.swapaxes(root, -1, -2)),
        loss=0.5 * np.sum(np.square((b - predicted) / sigma[..., None]), axis=(-2, -1)),
        dof=2 * b.shape[-2] - 3,
    )


def _to_body(attitude: Array, vectors_f: Array) -> Array:
    return quaternion.rotate(quaternion.conjugate(attitude)[..., None, :], vectors_f)


def _profile(b: Array, r: Array, weight: Array) -> Array:
    """Return the attitude profile matrix B = Σ a r bᵀ: the best R maximises tr(R Bᵀ)."""
    return np.asarray(np.swapaxes(weight[..., None] * r, -1, -2) @ b)


def _svd(b: Array, r: Array, weight: Array) -> Array:
    """R = U diag(1, 1, det U det V) Vᵀ for B = U S Vᵀ (Markley 1988, J. Astronautical Sciences 36)."""
    U, _, Vt = np.linalg.svd(_profile(b, r, weight))
    handed = np.linalg.det(U) * np.linalg.det(Vt)
    U = U * np.stack([np.ones_like(handed), np.ones_like(handed), np.sign(handed)], axis=-1)[..., None, :]
    return quaternion.from_matrix(U @ Vt)


def _davenport(b: Array, r: Array, weight: Array) -> Array:
    """The eigenvector of K's largest eigenvalue: tr(R Bᵀ) = qᵀ K q (Davenport's q method; Markley & Mortari 2000, section 3)."""
    B = _profile(b, r, weight)
    trace = np.trace(B, axis1=-2, axis2=-1)
    K = np.empty((*trace.shape, 4, 4))
    K[..., 0, 0] = trace
    K[..., 0, 1:] = K[..., 1:, 0] = np.sum(weight[..., None] * np.cross(b, r), axis=-2)
    K[..., 1:, 1:] = B + np.swapaxes(B, -1, -2) - trace[..., None, None] * np.eye(3)
    return np.asarray(np.linalg.eigh(K)[1][..., -1])


def _best_pair(b: Array, r: Array, weight: Array) -> Array:
    """Return TRIAD of the best known direction and that which fixes the turn about it best."""
    first = np.argmax(weight, axis=-1)[..., None]
    lead = np.take_along_axis(r, first[..., None], axis=-2)
    cosine = np.sum(lead * r, axis=-1)
    sine = np.linalg.norm(np.cross(lead, r), axis=-1)
    # inverse of TRIAD's variance about the first direction, (σ₂² + c² σ₁²)/s², in units of 1/σ₁²
    second = np.argmax(sine**2 * weight / (1.0 + weight * cosine**2), axis=-1)[..., None]
    chosen = [np.take_along_axis(v, k[..., None], axis=-2)[..., 0, :] for v in (b, r) for k in (first, second)]
    return _triad(*chosen)


def _quest(b: Array, r: Array, weight: Array) -> Array:
    """Gibbs vector by Newton's method on the characteristic equation of K, in a frame turned to a first attitude (Shuster & Oh 1981).

    Shuster's sequential rotations, but to TRIAD's attitude of the best pair instead of by 180° about an axis: there the answer is a
    small turn, far from the singularity at 180°, and λ = Σa − L with a small L. With z = Σ a b × r and
    ``M = Σ a [(1 + b·r) I − b rᵀ − r bᵀ]`` the Gibbs vector is ``g = (M − L I)⁻¹ z`` and the characteristic equation
    ``L = ½ Σ a |b − r|² − z·g``: no difference of large numbers, where the polynomial in λ loses all digits with unequal weights.
    """
    start = _best_pair(b, r, weight)
    turned = quaternion.rotate(start[..., None, :], b)
    a = weight[..., None]
    z = np.sum(a * np.cross(turned, r), axis=-2)
    outer = np.swapaxes(a * turned, -1, -2) @ r
    total = np.sum(weight * (1.0 + np.sum(turned * r, axis=-1)), axis=-1)
    M = total[..., None, None] * np.eye(3) - outer - np.swapaxes(outer, -1, -2)
    half = 0.5 * np.sum(a * np.square(turned - r), axis=(-2, -1))
    pole = np.linalg.eigvalsh(M)[..., 0]
    L = np.zeros_like(half)
    for _ in range(_NEWTON_STEPS):
        g = np.linalg.solve(M - L[..., None, None] * np.eye(3), z[..., None])[..., 0]
        # f(L) = L − half + z·g rises and is convex up to the pole at M's least eigenvalue; f′ = 1 + g·g.
        step = (half - L - np.sum(z * g, axis=-1)) / (1.0 + np.sum(g * g, axis=-1))
        following = np.where(L + step < pole, L + step, 0.5 * (L + pole))
        if np.array_equal(following, L):
            break
        L = following
    turn = quaternion.normalize(np.concatenate([np.ones((*g.shape[:-1], 1)), g], axis=-1))
    return quaternion.multiply(turn, start)


def _foam(b: Array, r: Array, weight: Array) -> Array:
    """R = [(κ + |B|²) B + λ cof B − B Bᵀ B]/(κ λ − det B), κ = ½(λ² − |B|²) (FOAM; Markley 1993, J. Astronautical Sciences 41).

    λ is the largest root of ``(λ² − |B|²)² − 8 λ det B − 4 |cof B|²``. Written for L = Σa − λ, with its coefficients as sums over pairs and
    triples of directions (Cauchy–Binet), so that what cancels for consistent data is never formed.
    """
    i, j = np.triu_indices(b.shape[-2], 1)
    pair = weight[..., i] * weight[..., j]
    across_b, across_r = np.cross(b[..., i, :], b[..., j, :]), np.cross(r[..., i, :], r[..., j, :])
    cosine_b, cosine_r = np.sum(b[..., i, :] * b[..., j, :], axis=-1), np.sum(r[..., i, :] * r[..., j, :], axis=-1)
    # 1 − c c′ = ½ (s² + s′² + (c − c′)²)
    unlike = np.sum(across_b**2, axis=-1) + np.sum(across_r**2, axis=-1) + (cosine_b - cosine_r) ** 2
    gap = np.sum(pair * unlike, axis=-1)  # (Σa)² − |B|²
    cofactor = np.swapaxes(pair[..., None] * across_r, -1, -2) @ across_b
    determinant = np.zeros(gap.shape)
    for k in range(2, b.shape[-2]):
        volume_b = np.sum(across_b * b[..., k : k + 1, :], axis=-1)
        volume_r = np.sum(across_r * r[..., k : k + 1, :], axis=-1)
        determinant += weight[..., k] * np.sum(np.where(j < k, pair * volume_b * volume_r, 0.0), axis=-1)
    cofactor_squared = np.sum(cofactor**2, axis=(-2, -1))
    total = np.sum(weight, axis=-1)
    L = np.zeros_like(gap)
    for _ in range(_NEWTON_STEPS):
        difference = gap - L * (2.0 * total - L)
        value = difference**2 - 8.0 * (total - L) * determinant - 4.0 * cofactor_squared
        following = L + value / (4.0 * difference * (total - L) - 8.0 * determinant)
        if np.array_equal(following, L):
            break
        L = following
    largest = total - L
    kappa = 0.5 * (gap - L * (2.0 * total - L))
    B = _profile(b, r, weight)
    squared = np.sum(B * B, axis=(-2, -1))
    R = (kappa + squared)[..., None, None] * B + largest[..., None, None] * cofactor - B @ np.swapaxes(B, -1, -2) @ B
    R /= (kappa * largest - determinant)[..., None, None]
    for _ in range(
        3
    ):  # Rounding leaves R orthogonal to 1e-16 (σ_max/σ_min)²; each step to the nearest rotation squares the defect.
        R = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)
    return quaternion.from_matrix(R)


_NEWTON_STEPS = 30

_METHODS: dict[str, Callable[[Array, Array, Array], Array]] = {
    "svd": _svd,
    "davenport": _davenport,
    "quest": _quest,
    "foam": _foam,
}


def _factorised(predicted: Array, residual: Array, sigma: Array) -> tuple[Array, Array]:
    """Return (T, y): δθ = T⁻¹ y minimises Σ |residual − [predicted] δθ|²/σ², and its covariance is T⁻¹ T⁻ᵀ.

    By orthogonal factorisation, which keeps the digits of the least weight beside the largest; the normal equations lose them.
    """
    scale = sigma[..., None, None]
    rows = (skew(predicted) / scale).reshape(*predicted.shape[:-2], -1, 3)
    right = (residual[..., None] / scale).reshape(*rows.shape[:-1], 1)
    Q, triangle = np.linalg.qr(rows)
    return triangle, np.swapaxes(Q, -1, -2) @ right


def _refined(attitude: Array, b: Array, r: Array, sigma: Array) -> Array:
    """Return the attitude after Gauss–Newton steps on Wahba's loss, until they are lost in rounding."""
    for _ in range(_GAUSS_NEWTON_STEPS):
        predicted = _to_body(attitude, r)
        triangle, right = _factorised(predicted, b - predicted, sigma)
        step = np.linalg.solve(triangle, right)[..., 0]
        attitude = quaternion.normalize(quaternion.multiply(attitude, quaternion.exp(step)))
        if np.max(np.abs(step), initial=0.0) < ROUNDING:
            break
    return attitude


_GAUSS_NEWTON_STEPS = 10


# ----------------------------------------------------------------------------------------------------------------------
# Checks of the input


def _place(name: str, *index: int | np.intp) -> str:
    return f"{name}[{', '.join(str(int(i)) for i in index)}]" if index else name


def _directions(name: str, value: ArrayLike) -> Array:
    """Return vectors (..., 3) divided by their lengths."""
    vector = array(name, value, (..., 3))
    largest = np.max(np.abs(vector), axis=-1, keepdims=True, initial=0.0)
    if np.any(largest == 0.0):
        index = np.argwhere(largest[..., 0] == 0.0)[0]
        raise InputError(f"{_place(name, *index)} is the zero vector, which has no direction; leave it out")
    # Scaled by the largest component first, so that no square leaves the range of a float.
    scaled = vector / largest
    return np.asarray(scaled / np.linalg.norm(scaled, axis=-1, keepdims=True))


def _sigmas(value: ArrayLike, shape: tuple[int, ...]) -> Array:
    sigma = array("sigmas", value, (...,))
    try:
        sigma = np.broadcast_to(sigma, shape)
    except ValueError:
        raise InputError(
            f"sigmas has shape {sigma.shape}, wanted {shape}; give one number a direction, or one for all"
        ) from None
    if np.any(sigma <= 0.0):
        index = np.argwhere(sigma <= 0.0)[0]
        raise InputError(
            f"{_place('sigmas', *index)} is {sigma[tuple(index)]:g} rad; every direction needs a noise greater than zero"
        )
    return sigma


def _angle(u: Array, v: Array) -> Array:
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), np.sum(u * v, axis=-1)))


def _refuse_parallel(first_name: str, second_name: str, first: Array, second: Array, least: float) -> None:
    angle = np.asarray(_angle(first, second))
    bad = np.minimum(angle, np.pi - angle) < least
    if np.any(bad):
        index = np.argwhere(bad)[0]
        raise InputError(
            f"{_place(first_name, *index)} and {_place(second_name, *index)} are {angle[tuple(index)] / DEGREE:.6g}° apart, less than "
            f"{least / DEGREE:.2g}° from one line: the rotation about it is not determined; give a second direction away from the first"
        )


def _refuse_inconsistent(b: Array, r: Array, sigma: Array) -> None:
    """Refuse pairs whose angle differs between the frames by more than the noise explains."""
    i, j = np.triu_indices(b.shape[-2], 1)
    angle_b, angle_f = _angle(b[..., i, :], b[..., j, :]), _angle(r[..., i, :], r[..., j, :])
    allowed = INCONSISTENT * np.hypot(sigma[..., i], sigma[..., j]) + 4.0 * ROUNDING
    excess = np.abs(angle_b - angle_f) / allowed
    if np.any(excess > 1.0):
        *index, k = np.unravel_index(int(np.argmax(excess)), excess.shape)
        here = (*index, k)
        allowed_here = float(np.broadcast_to(allowed, excess.shape)[here])
        raise InconsistentError(
            f"directions {i[k]} and {j[k]}{' of set ' + str([int(n) for n in index]) if index else ''} are "
            f"{np.broadcast_to(angle_b, excess.shape)[here] / DEGREE:.6g}° apart in the body frame but "
            f"{np.broadcast_to(angle_f, excess.shape)[here] / DEGREE:.6g}° in the fixed frame, where the noise allows a difference of "
            f"{allowed_here / DEGREE:.3g}° ({INCONSISTENT:g} σ); look for a mixed-up pair, a reference in another frame, an outlier "
            "or a σ too small"
        )


def _refuse_undetermined(name: str, vectors: Array, sigma: Array) -> None:
    """Refuse sets of directions that leave a turn undetermined: all on one line, as seen by the noise."""
    rows = skew(vectors) / np.maximum(sigma, ROUNDING)[..., None, None]
    least = np.linalg.svd(rows.reshape(*rows.shape[:-3], -1, 3), compute_uv=False)[..., -1]
    bad = least < 1.0 / LARGEST_UNCERTAINTY
    if np.any(bad):
        index = tuple(np.argwhere(bad)[0]) if np.ndim(bad) else ()
        one = vectors[index]
        i, j = np.triu_indices(one.shape[-2], 1)
        angle = _angle(one[i], one[j])
        widest = int(np.argmax(np.minimum(angle, np.pi - angle)))
        uncertainty = "without bound" if least[index] == 0.0 else f"{1.0 / least[index]:.3g} rad"
        raise InputError(
            f"{_place(name, *index)}: the attitude is not determined, the 1σ of its worst known turn is "
            f"{uncertainty}; of all pairs, directions {i[widest]} and {j[widest]} are furthest from one line, "
            f"{angle[widest] / DEGREE:.6g}° "
            "apart; add a direction away from that line, or give smaller sigmas (rad) if the noise is smaller"
        )
