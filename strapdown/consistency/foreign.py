"""The verdict on the estimate of another program, against a truth that may have another clock and other frames.

:func:`check_arrays` aligns clocks and frames: gross differences are removed, reported, and their uncertainty added to the covariance. The
definition of the attitude covariance is given or found from the errors, and :func:`strapdown.consistency.judge` judges the result. Small
differences that would explain the errors are reported with the verdict and not removed unless requested, because a constant rotation
between frames and a constant error of the filter are indistinguishable.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, increasing, one_of, unit_quaternions
from strapdown.consistency.judgement import WITHOUT_TRUTH, Judgement, judge
from strapdown.consistency.manifold import whitened
from strapdown.consistency.timeaverage import effective_samples
from strapdown.records import Estimate, Innovations, Truth
from strapdown.records.estimate import matrices
from strapdown.records.outputs import euler_axes
from strapdown.records.recording import BRIDGED
from strapdown.records.recording import interpolated as between_stamps
from strapdown.units import DEGREE

ERROR_FRAMES = ("body", "fixed", "euler")
"""Definitions of an attitude covariance: of δθ with ``q_true = q ⊗ exp(δθ)``; of δφ with ``q_true = exp(δφ) ⊗ q``, as ROS defines it for
poses; of the errors of roll, pitch and yaw, in this order (ZYX)."""
DECIDED = 0.9
"""Probability above which the errors decide the definition of the covariance; below, "body" is used, this package's own."""
ALIGNED = ("time", "fixed", "body")
"""Parts of an alignment: clocks, fixed frames, body frames."""
GROSS = 5.0 * DEGREE
"""A constant rotation above this is a difference of frames and not an error of a filter, rad."""
SCALE = "σ wrong by one factor"
LIKELY = 1e-3
"""p-value below which an explanation is likely."""
LONGEST_OFFSET = 30.0
"""Maximum offset of the clocks to search for if the records overlap without one, s."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """Differences of clock and frames between an estimate and a truth: ``q_true(t + offset) = exp(fixed) ⊗ q(t) ⊗ exp(body)``."""

    offset: float
    """Offset, s, to be added to the estimate's times."""
    fixed: Array
    """Rotation vector (3,), rad, from the estimate's fixed frame to the truth's."""
    body: Array
    """Rotation vector (3,), rad, from the truth's body frame to the estimate's."""
    sigma: Array
    """Standard deviations of fixed (3), body (3), rad, and offset, s: (7,); 0 for those not estimated."""
    covariance: Array
    """Their covariance (7, 7)."""
    estimated: tuple[str, ...]
    """Which of :data:`ALIGNED` were estimated and removed."""
    residual: float
    """RMS of the remaining angle, rad."""

    @property
    def words(self) -> tuple[str, ...]:
        """Differences that were removed, one sentence each."""
        found = []
        if "time" in self.estimated:
            found.append(
                f"clocks differ by {self.offset:.6g} s ± {self.sigma[6]:.2g} s (added to the estimate's times): removed"
            )
        for name, rotation, rows in (("fixed", self.fixed, slice(0, 3)), ("body", self.body, slice(3, 6))):
            if name in self.estimated:
                text = ", ".join(f"{x / DEGREE:.4g}" for x in rotation)
                sigma = float(np.sqrt(np.mean(self.sigma[rows] ** 2))) / DEGREE
                found.append(
                    f"the {name} frames differ by {np.linalg.norm(rotation) / DEGREE:.4g}° (rotation vector {text}°) ± {sigma:.2g}° an "
                    "axis: removed; a constant error of the filter would look the same"
                )
        return tuple(found)


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """A difference that would explain errors beyond the covariance and was not removed."""

    name: str
    value: str
    nees: float
    """NEES of the attitude per state if it were removed."""
    p_value: float
    """Probability of as large a reduction by chance for a consistent filter; small if the explanation is likely."""

    @property
    def likely(self) -> bool:
        """Whether so large a reduction is improbable by chance."""
        return self.p_value < LIKELY


@dataclass(frozen=True, kw_only=True, eq=False)
class Checked:
    """The verdict on the estimate of another program, with the alignment and definitions it rests on.

    Parameters
    ----------
    judgement : Judgement
        The verdict with its evidence.
    estimate : Estimate
        The estimate as it was judged: in the truth's clock and frames, with the covariance of the body-side error.
    truth : Truth or None
        The truth at the estimate's times.
    alignment : Alignment or None
        Differences of clocks and frames that were estimated and removed.
    error_frame : str
        Definition of the covariance that was judged, one of ``ERROR_FRAMES``; empty if there is no covariance.
    frame_probability : mapping of str to float
        Probability of each definition, all equally probable beforehand; empty if it was given or there is no truth.
    explanations : tuple of Explanation
        Differences that would explain the errors and were not removed, the most likely first.
    remarks : tuple of str
        Differences removed and the definition of the covariance used, one sentence each.
    """

    judgement: Judgement
    estimate: Estimate
    truth: Truth | None
    alignment: Alignment | None
    error_frame: str
    frame_probability: Mapping[str, float]
    explanations: tuple[Explanation, ...]
    remarks: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """Return everything as plain values for JSON.

        Returns
        -------
        dict
            The verdict as of :meth:`Judgement.summary`, with the definition of the covariance, explanations, remarks and
            alignment (degrees, s).
        """
        table: dict[str, Any] = {
            **self.judgement.summary(),
            "error_frame": self.error_frame,
            "error_frame_probability": dict(self.frame_probability),
            "explanations": [vars(one) for one in self.explanations],
            "remarks": list(self.remarks),
        }
        if self.alignment is not None:
            a = self.alignment
            table["alignment"] = {
                "removed": list(a.estimated),
                "time_offset_s": a.offset,
                "fixed_rotation_vector_deg": (a.fixed / DEGREE).tolist(),
                "body_rotation_vector_deg": (a.body / DEGREE).tolist(),
                "sigma_fixed_body_deg": (a.sigma[:6] / DEGREE).tolist(),
                "sigma_time_s": float(a.sigma[6]),
                "residual_rms_deg": a.residual / DEGREE,
            }
        return table


def check_arrays(
    time: ArrayLike,
    attitude: ArrayLike,
    covariance: ArrayLike | None,
    true_time: ArrayLike,
    true_attitude: ArrayLike,
    *,
    bias: ArrayLike | None = None,
    true_bias: ArrayLike | None = None,
    innovations: Mapping[str, Innovations] | None = None,
    error_frame: str = "find",
    align: str | Iterable[str] = "auto",
    probability: float = 0.99,
) -> Checked:
    """Return the verdict on an estimate of any filter against a truth.

    Parameters
    ----------
    time : array_like (m,)
        Times of the estimate, s, increasing.
    attitude : array_like (m, 4)
        Estimated q_fb, scalar first.
    covariance : array_like (m, 3, 3) or (m, 6, 6), or None
        Covariance of the attitude error, rad², or of attitude and bias error, defined as ``error_frame``. If None, errors are reported but
        not judged.
    true_time, true_attitude : array_like (n,), (n, 4)
        The truth, in its own clock and frames.
    bias, true_bias : array_like (m, 3), (n, 3), optional
        Gyro bias, rad/s, body axes; judged if both are given.
    innovations : mapping, optional
        :class:`strapdown.records.Innovations` by sensor.
    error_frame : {"find", "body", "fixed", "euler"}
        Definition of the covariance (:data:`ERROR_FRAMES`). "find" takes the one of maximum likelihood given the errors.
    align : "auto", "none", or any of "time", "fixed", "body"
        Differences to estimate and remove. "auto": a clock offset beyond three times its σ, and rotations above 5°.
    probability : float
        A consistent filter is rejected with probability at most 1 − ``probability``, all tests together.

    Returns
    -------
    Checked
        The verdict, with the alignment and the definition of the covariance that it rests on.

    Examples
    --------
    >>> import numpy as np
    >>> from strapdown import quaternion
    >>> random = np.random.default_rng(1)
    >>> time = np.arange(1000.0)
    >>> truth = quaternion.exp(np.cumsum(0.1 * random.standard_normal((1000, 3)), axis=0) % 2.0)
    >>> estimate = quaternion.multiply(truth, quaternion.exp(0.01 * random.standard_normal((1000, 3))))
    >>> P = np.tile(1e-4 * np.eye(3), (1000, 1, 1))
    >>> check_arrays(time, estimate, P, time, truth).judgement.verdict
    'consistent'
    >>> check_arrays(time, estimate, 0.5 * P, time, truth).judgement.verdict
    'not consistent'
    """
    if error_frame != "find":
        one_of("error_frame", error_frame, ERROR_FRAMES)
    wanted = _wanted(align)
    own = _series("", time, attitude, covariance, bias)
    theirs = _series("true_", true_time, true_attitude, None, true_bias)
    if own.covariance is not None and (own.bias is None or theirs.bias is None):
        own = replace(own, bias=None, covariance=own.covariance[:, :3, :3])
    remarks: list[str] = []
    own, alignment = _aligned(own, theirs, wanted, remarks)
    own, truth = _at_common_times(own, theirs, alignment.offset)
    remarks += alignment.words
    aligned = replace_attitude(own.attitude, alignment)
    if own.covariance is None:
        size = f"RMS attitude error {alignment.residual / DEGREE:.4g}°"
        judged = judge(estimate := without_truth(own.time, aligned, innovations or {}), probability=probability)
        judgement = replace(judged, limits=tuple(limit for limit in judged.limits if limit != WITHOUT_TRUTH))
        remarks.append(f"the estimate has no covariance, so its errors are not judged ({size})")
        chosen, found, explained = "", dict[str, float](), tuple[Explanation, ...]()
    else:
        readings = {name: read_as(name, own.covariance, own.attitude) for name in ERROR_FRAMES}
        readings = {name: _in_truth_axes(P, own, truth, alignment) for name, P in readings.items()}
        error = _turns(aligned, truth.attitude)
        found = frame_probabilities(error, {name: P[:, :3, :3] for name, P in readings.items()})
        chosen, words = _chosen_frame(error_frame, found)
        remarks += words
        body = quaternion.conjugate(quaternion.exp(alignment.body))
        turned = None if own.bias is None else quaternion.rotate(body, own.bias)
        estimate = Estimate.from_arrays(own.time, aligned, readings[chosen], bias=turned, innovations=innovations)
        judgement = judge(estimate, truth, probability=probability)
        explained = explanations(error, readings, chosen, found, truth, own.time, aligned)
    return Checked(
        judgement=judgement,
        estimate=estimate,
        truth=truth,
        alignment=alignment,
        error_frame=chosen,
        frame_probability=found if error_frame == "find" else {},
        explanations=explained,
        remarks=tuple(remarks),
    )


def _chosen_frame(given: str, found: Mapping[str, float]) -> tuple[str, list[str]]:
    """Return the definition of the covariance, given or found, and the remark on it."""
    best = max(found, key=lambda name: found[name])
    if given == "find":
        chosen = best if found[best] >= DECIDED else "body"
        return chosen, [_frame_words(chosen, found)]
    if found[given] < 0.01:
        return given, [f"the covariance is read as {given}, as given; the errors fit far better read as {best}"]
    return given, []


@dataclass(frozen=True, eq=False)
class _Series:
    time: Array
    attitude: Array
    covariance: Array | None = None
    bias: Array | None = None

    def at(self, rows: np.ndarray, time: Array, attitude: Array) -> _Series:
        """Return the given times and attitudes with the covariances and biases of these rows."""
        P, bias = (None if one is None else one[rows] for one in (self.covariance, self.bias))
        return _Series(time, attitude, P, bias)


def _series(
    prefix: str, time: ArrayLike, attitude: ArrayLike, covariance: ArrayLike | None, bias: ArrayLike | None
) -> _Series:
    """Return a checked history; ``prefix`` precedes its names in messages."""
    stamps = increasing(f"{prefix}time", time, minimum=2)
    m = len(stamps)
    q = unit_quaternions(f"{prefix}attitude", array(f"{prefix}attitude", attitude, (m, 4)))
    P = None if covariance is None else matrices("covariance", covariance, m)
    return _Series(stamps, q, P, None if bias is None else array(f"{prefix}bias", bias, (m, 3)))


def _wanted(align: str | Iterable[str]) -> tuple[str, ...] | None:
    """Return the differences to remove; None if the data decide."""
    if align == "auto":
        return None
    if align == "none":
        return ()
    names = [part.strip() for part in align.split(",")] if isinstance(align, str) else list(align)
    return tuple(one_of("align", name, (*ALIGNED, "auto", "none")) for name in names)


def without_truth(time: Array, attitude: Array, innovations: Mapping[str, Innovations]) -> Estimate:
    """Return an estimate without covariances, so that only its innovations can be judged."""
    return Estimate.from_arrays(time, attitude, np.full((len(time), 3, 3), np.nan), innovations=innovations)


# ------------------------------------------------------------------------------------------------------------ readings


def read_as(frame: str, covariance: Array, attitude: Array) -> Array:
    """Return covariances (m, n, n), n ≥ 3, of the body-side error; their first three rows are given as one of :data:`ERROR_FRAMES`."""
    if frame == "body":
        return covariance
    R = quaternion.to_matrix(attitude)
    # δθ_b = Rᵀ δφ; δθ_b = E (yaw, pitch, roll), with the columns reversed for (roll, pitch, yaw).
    turn = np.swapaxes(R, 1, 2) if frame == "fixed" else euler_axes(attitude)[:, :, ::-1]
    T = np.tile(np.eye(covariance.shape[1]), (len(R), 1, 1))
    T[:, :3, :3] = turn
    return np.asarray(T @ covariance @ np.swapaxes(T, 1, 2))


def frame_probabilities(error: Array, readings: Mapping[str, Array]) -> dict[str, float]:
    """Return the probability of each definition of the covariance (m, 3, 3) given errors (m, 3), all equally probable beforehand.

    The scale of each covariance is free, so that the definition is found for an optimistic filter too. The log-likelihood is weighted by
    the effective number of samples, because errors are correlated in time.
    """
    scores = {}
    weight = 1.0
    for name, P in readings.items():
        try:
            white = whitened(error, P)
        except InputError:  # singular Euler angles
            scores[name] = -np.inf
            continue
        scale = max(float(np.mean(white * white)), 1e-300)
        scores[name] = -0.5 * (3.0 * math.log(scale) + float(np.mean(np.linalg.slogdet(P)[1])))
        weight = effective_samples(white / math.sqrt(scale)) if name == "body" else weight
    best = max(scores.values())
    likelihood = {name: math.exp(max(weight * (score - best), -700.0)) for name, score in scores.items()}
    return {name: value / sum(likelihood.values()) for name, value in likelihood.items()}


def _frame_words(chosen: str, found: Mapping[str, float]) -> str:
    said = ", ".join(f"{name} {100.0 * p:.3g} %" for name, p in found.items())
    if found[chosen] < DECIDED:
        return (
            f"the errors do not decide how the covariance is defined ({said}): it is read as {chosen}; "
            "--error-frame (error_frame= in Python) names another"
        )
    return f"the covariance is read as {chosen} ({said}, found from the errors)"


# ----------------------------------------------------------------------------------------------------------- alignment


def replace_attitude(attitude: Array, alignment: Alignment) -> Array:
    """Return attitudes (m, 4) in the truth's frames."""
    return quaternion.multiply(
        quaternion.multiply(quaternion.exp(alignment.fixed), attitude), quaternion.exp(alignment.body)
    )


def _turns(one: Array, other: Array) -> Array:
    """Return the rotation vectors (m, 3), rad, body axes, from attitudes (m, 4) to others."""
    return quaternion.log(quaternion.multiply(quaternion.conjugate(one), other))


def interpolated(time: Array, stamps: Array, attitude: Array, bridged: float) -> Array:
    """Return attitudes (n, 4) at ``time``, interpolated; at the truth's own times they are copied exactly, next to gaps too."""
    result = between_stamps(time, stamps, attitude, bridged)
    k = np.clip(np.searchsorted(stamps, time), 0, len(stamps) - 1)
    exact = time == stamps[k]
    result[exact] = attitude[k[exact]]
    return result


def _bridged(series: _Series) -> float:
    """Return the maximum interval to interpolate over, s: 1.5 times the median one if the series is slow."""
    return max(BRIDGED, 1.5 * float(np.median(np.diff(series.time))))


def _at_common_times(own: _Series, theirs: _Series, offset: float) -> tuple[_Series, Truth]:
    """Return the estimate and the truth at common times: those of the estimate, or of the truth if it is sparser."""
    sparser = np.median(np.diff(theirs.time)) > 1.5 * np.median(np.diff(own.time))
    if sparser:
        inside = (theirs.time - offset >= own.time[0]) & (theirs.time - offset <= own.time[-1])
        at = theirs.time[inside] - offset
        near = np.clip(np.searchsorted(own.time, at), 1, len(own.time) - 1)
        near -= (at - own.time[near - 1]) < (own.time[near] - at)
        own = own.at(near, at, interpolated(at, own.time, own.attitude, _bridged(own)))
        q, bias = theirs.attitude[inside], None if theirs.bias is None else theirs.bias[inside]
        good = np.isfinite(own.attitude[:, 0])
    else:
        q = interpolated(own.time + offset, theirs.time, theirs.attitude, _bridged(theirs))
        good = np.isfinite(q[:, 0])
        bias = None
        if theirs.bias is not None:
            bias = np.stack([np.interp(own.time + offset, theirs.time, theirs.bias[:, k]) for k in range(3)], axis=1)
    if good.sum() < 2:
        raise InputError(
            f"the estimate goes from {own.time[0] + offset:.6g} to {own.time[-1] + offset:.6g} s of the truth's clock, and the truth from "
            f"{theirs.time[0]:.6g} to {theirs.time[-1]:.6g} s: they have fewer than two times in common; "
            "give both of one clock, or --align time (align= in Python)"
        )
    return (
        own.at(good, own.time[good] + offset, own.attitude[good]),
        Truth(attitude=q[good], bias=np.full((int(good.sum()), 3), np.nan) if bias is None else bias[good]),
    )


def _rates(series: _Series) -> tuple[Array, Array]:
    """Return the midpoints of the intervals (m − 1,) and the mean body rate over each (m − 1, 3)."""
    turn = _turns(series.attitude[:-1], series.attitude[1:])
    return 0.5 * (series.time[1:] + series.time[:-1]), turn / np.diff(series.time)[:, None]


def coarse_offset(own_time: Array, own_speed: Array, true_time: Array, true_speed: Array) -> float:
    """Return the offset, s, to add to the first times for the best correlation of two angular speeds; 0 if none is above 0.5."""
    step = max(float(np.median(np.diff(own_time))), float(np.median(np.diff(true_time))))
    apart = own_time[-1] < true_time[0] or true_time[-1] < own_time[0]
    base = true_time[0] - own_time[0] if apart else 0.0
    first, last = min(own_time[0] + base, true_time[0]), max(own_time[-1] + base, true_time[-1])
    grid = np.arange(first, last + step, step)
    a, b = (
        np.interp(grid, t, s, left=np.nan, right=np.nan)
        for t, s in ((own_time + base, own_speed), (true_time, true_speed))
    )
    a, b = (np.nan_to_num(x - np.nanmean(x)) for x in (a, b))
    if min(np.std(a), np.std(b)) < 1e-9:
        return float(base)
    size = 1 << (2 * len(grid) - 1).bit_length()
    product = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
    lags = np.arange(size)
    lags = np.where(lags > size // 2, lags - size, lags)
    near = np.abs(lags * step) <= (np.inf if apart else LONGEST_OFFSET)
    best = int(np.argmax(np.where(near, product, -np.inf)))
    share = product[best] / math.sqrt(float(np.sum(a * a) * np.sum(b * b)))
    return float(base + lags[best] * step) if share > 0.5 else float(base)


def _initial_rotations(own: _Series, theirs: _Series, offset: float) -> list[tuple[Array, Array]]:
    """Return (fixed, body) quaternions to start from: identity, the fixed frame's, and with the body frame's from the rates."""
    matched, truth = _at_common_times(own, theirs, offset)
    identity = np.array([1.0, 0.0, 0.0, 0.0])

    def fixed_of(body: Array) -> Array:
        turns = quaternion.multiply(truth.attitude, quaternion.conjugate(quaternion.multiply(matched.attitude, body)))
        return quaternion.from_rotation(quaternion.to_rotation(turns).mean())

    found = [(identity, identity), (fixed_of(identity), identity)]
    _, w_own = _rates(matched)
    _, w_true = _rates(_Series(matched.time, truth.attitude))
    # Wahba's problem: w_true = Bᵀ w_own.
    u, s, vt = np.linalg.svd(w_own.T @ w_true)
    if s[1] > 1e-3 * s[0]:
        B = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
        body = quaternion.from_matrix(B)
        found.append((fixed_of(body), body))
    return found


def fit(own: _Series, theirs: _Series, names: tuple[str, ...], offset: float) -> Alignment:
    """Return offset and rotations by least squares of the remaining angle; σ from the effective number of residuals."""
    free = np.array([name in names for name in ("fixed",) * 3 + ("body",) * 3 + ("time",)])
    starts = _initial_rotations(own, theirs, offset) if free[:6].any() else [(np.array([1.0, 0, 0, 0]),) * 2]
    best: Alignment | None = None
    for fixed, body in starts:
        if (not free[0] and abs(fixed[0]) < 1.0) or (not free[3] and abs(body[0]) < 1.0):
            continue
        found = _descended(own, theirs, free, fixed, body, offset, names)
        if best is None or found.residual < 0.999 * best.residual:
            best = found
    assert best is not None
    return best


def _descended(
    own: _Series, theirs: _Series, free: np.ndarray, fixed: Array, body: Array, offset: float, names: tuple[str, ...]
) -> Alignment:
    covariance = np.zeros((7, 7))
    residual = np.inf
    for _ in range(20):
        matched, truth = _at_common_times(own, theirs, offset)
        aligned = quaternion.multiply(quaternion.multiply(fixed, matched.attitude), body)
        r = _turns(aligned, truth.attitude)
        now = float(np.sqrt(np.mean(np.sum(r * r, axis=1))))
        if not free.any():
            residual = now
            break
        J = _jacobian(matched.time, aligned, truth)[:, :, free]
        information = np.einsum("mij,mik->jk", J, J)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        value, vector = np.linalg.eigh(information * np.outer(scale, scale))
        seen = value > 1e-6 * value[-1]  # directions that the motion does not determine are left unchanged
        inverse = (vector[:, seen] / value[seen]) @ vector[:, seen].T * np.outer(scale, scale)
        step = np.zeros(7)
        step[free] = inverse @ np.einsum("mij,mi->j", J, r)
        left = r - np.einsum("mij,j->mi", J, step[free])
        share = len(r) / effective_samples(left / max(float(np.sqrt(np.mean(left**2))), 1e-300)) if len(r) > 10 else 1.0
        covariance = np.zeros((7, 7))
        covariance[np.ix_(free, free)] = inverse * float(np.mean(left**2)) * share
        fixed = quaternion.normalize(quaternion.multiply(quaternion.exp(step[:3]), fixed))
        body = quaternion.normalize(quaternion.multiply(body, quaternion.exp(step[3:6])))
        offset += float(step[6])
        residual = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
        if np.all(np.abs(step) <= 1e-3 * np.sqrt(np.diag(covariance)) + 1e-12):
            break
    return Alignment(
        offset=offset,
        fixed=quaternion.log(fixed),
        body=quaternion.log(body),
        sigma=np.sqrt(np.diag(covariance)),
        covariance=covariance,
        estimated=tuple(name for name in ALIGNED if name in names),
        residual=residual,
    )


def _jacobian(time: Array, aligned: Array, truth: Truth) -> Array:
    """Return the derivatives (m, 3, 7) of the attitude error with respect to fixed rotation, body rotation and clock offset."""
    middle, rate = _rates(_Series(time, truth.attitude))
    J = np.zeros((len(time), 3, 7))
    J[:, :, :3] = np.swapaxes(quaternion.to_matrix(aligned), 1, 2)
    J[:, :, 3:6] = np.eye(3)
    J[:, :, 6] = -np.stack([np.interp(time, middle, rate[:, k]) for k in range(3)], axis=1)
    return J


def _aligned(
    own: _Series, theirs: _Series, wanted: tuple[str, ...] | None, remarks: list[str]
) -> tuple[_Series, Alignment]:
    """Return the estimate, its quaternions in the convention that fits, and its alignment with the truth."""
    offset = 0.0
    if wanted is None or "time" in wanted:
        own_at, own_rate = _rates(own)
        true_at, true_rate = _rates(theirs)
        speeds = (np.linalg.norm(own_rate, axis=1), np.linalg.norm(true_rate, axis=1))
        offset = coarse_offset(own_at, speeds[0], true_at, speeds[1])
    if wanted is not None:
        return own, fit(own, theirs, wanted, offset)
    whole = fit(own, theirs, ALIGNED, offset)
    if _gross(whole):
        others = {words: replace(own, attitude=meant(own.attitude)) for words, meant in _CONVENTIONS.items()}
        fits = {words: fit(other, theirs, ALIGNED, offset) for words, other in others.items()}
        words = min(fits, key=lambda words: _gross(fits[words]))
        if _gross(fits[words]) < _gross(whole):
            remarks.append(f"the quaternions fit the truth best if read as {words}, so they are read as such")
            own, whole = others[words], fits[words]
    moved = ("time",) if abs(whole.offset) > 3.0 * whole.sigma[6] + 1e-9 else ()
    base = whole.offset if moved else 0.0
    trials = (moved, ("fixed", *moved), ("body", *moved), ("fixed", "body", *moved))
    for names in trials:
        found = fit(own, theirs, names, base)
        if found.residual < max(GROSS if names == moved else 0.0, 1.5 * whole.residual):
            break
    return own, found


def _gross(found: Alignment) -> int:
    """Return the number of gross rotations, plus 3 if even with them the residual is gross."""
    turned = sum(float(np.linalg.norm(vector)) > GROSS for vector in (found.fixed, found.body))
    return turned + (3 if found.residual > GROSS else 0)


_CONVENTIONS = {
    "the inverse, fixed frame to body": quaternion.conjugate,
    "scalar last": lambda q: q[:, [3, 0, 1, 2]],
    "scalar last and the inverse": lambda q: quaternion.conjugate(q[:, [3, 0, 1, 2]]),
}


def _in_truth_axes(P: Array, own: _Series, truth: Truth, alignment: Alignment) -> Array:
    """Return covariances in the truth's body axes, with the uncertainty of the alignment added."""
    turn = quaternion.to_matrix(quaternion.exp(alignment.body)).T
    size = P.shape[1]
    T = np.kron(np.eye(size // 3), turn)
    result = T @ P @ T.T
    if alignment.estimated:
        J = _jacobian(own.time, replace_attitude(own.attitude, alignment), truth)
        result[:, :3, :3] += J @ alignment.covariance @ np.swapaxes(J, 1, 2)
    return np.asarray(result)


# -------------------------------------------------------------------------------------------------------- explanations


def explanations(
    error: Array,
    readings: Mapping[str, Array],
    chosen: str,
    probabilities: Mapping[str, float],
    truth: Truth,
    time: Array,
    attitude: Array,
) -> tuple[Explanation, ...]:
    """Return differences that would explain the attitude errors (m, 3) better than the covariance, the most likely first."""
    from scipy.special import chdtrc

    P = readings[chosen][:, :3, :3]
    white = whitened(error, P)
    m = len(error)
    before = float(np.mean(white * white))
    effective = effective_samples(white / math.sqrt(max(before, 1e-300))) if m > 10 else 1.0
    factor = np.linalg.cholesky(P)
    whole = _jacobian(time, attitude, truth)
    designs = {
        "constant rotation of the fixed frame (heading, gravity)": whole[:, :, :3],
        "constant rotation of the body frame (mounting)": whole[:, :, 3:6],
        "offset of the clock, delay": whole[:, :, 6:],
    }
    found = []
    for name, J in designs.items():
        A = np.linalg.solve(factor, J)
        N = np.einsum("mij,mik->jk", A, A)
        if np.linalg.matrix_rank(N, 1e-12 * max(float(np.trace(N)), 1e-300)) < N.shape[0]:
            continue
        x = np.linalg.solve(N, np.einsum("mij,mi->j", A, white))
        left = white - np.einsum("mij,j->mi", A, x)
        after = float(np.mean(left**2))
        # The scale of σ is free: the gain is a ratio of variances, so that an optimistic filter does not make everything significant.
        samples = effective_samples(left / math.sqrt(max(after, 1e-300))) if m > 10 else 1.0
        gain = 3.0 * samples * math.log(max(before, 1e-300) / max(after, 1e-300))
        size = f"{1e3 * x[0]:.4g} ms" if len(x) == 1 else f"{', '.join(f'{v / DEGREE:.3g}' for v in x)}°"
        found.append(Explanation(name=name, value=size, nees=after, p_value=float(chdtrc(len(x), max(gain, 0.0)))))
    scale_gain = 3.0 * effective * (before - 1.0 - math.log(max(before, 1e-300)))
    p_value = float(chdtrc(1, max(scale_gain, 0.0)))
    found.append(Explanation(name=SCALE, value=f"{math.sqrt(before):.3g}", nees=1.0, p_value=p_value))
    for name, P_other in readings.items():
        if name == chosen or probabilities[name] <= probabilities[chosen]:
            continue
        other = whitened(error, P_other[:, :3, :3])
        found.append(
            Explanation(
                name=f"covariance meant as {name}",
                value=f"{100.0 * probabilities[name]:.3g} %",
                nees=float(np.mean(other * other)),
                p_value=min(1.0, probabilities[chosen] / max(probabilities[name], 1e-300)),
            )
        )
    # Specific causes come before a factor on σ, which would absorb all of them.
    return tuple(sorted(found, key=lambda one: (not one.likely, one.name == SCALE, one.p_value)))
