"""Clocks and frames of two histories of attitudes: differences found by least squares, and the histories at common times."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, Hint, InputError, array, increasing, unit_quaternions
from strapdown.consistency.timeaverage import effective_samples
from strapdown.records import Truth
from strapdown.records.estimate import matrices
from strapdown.records.outputs import FIXED_FRAMES
from strapdown.records.recording import BRIDGED
from strapdown.records.recording import interpolated as between_stamps
from strapdown.units import DEGREE

ALIGNED = ("time", "fixed", "body")
"""Parts of an alignment: clocks, fixed frames, body frames."""
USUAL_FRAMES = {
    "fixed": {
        f"{own} and {other}": quaternion.multiply(quaternion.conjugate(to), q)
        for (own, q), (other, to) in itertools.permutations(reversed(FIXED_FRAMES.items()), 2)
    },
    "body": {"forward-right-down and forward-left-up": np.array([0.0, 1.0, 0.0, 0.0])},
}
"""Rotations between usual frames (4,), from that of the estimate, the first, to that of the truth."""
GROSS = 5.0 * DEGREE
"""A constant rotation above this is a difference of frames and not an error of a filter, rad."""
LONGEST_OFFSET = 30.0
"""Maximum offset of the clocks to search for if the records overlap without one, s."""
AMBIGUOUS = 0.1
"""Component of the offset, scaled to unit information, in an undetermined direction, above which that is said."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """Differences of clock and frames between an estimate and a truth: ``q_true(t + offset) = exp(fixed) ⊗ q(t) ⊗ exp(body)``."""

    offset: float
    """Offset, s, to be added to the estimate's times."""
    fixed: Array
    """Rotation vector (3,), rad, from the estimate's fixed frame to the truth's."""
    body: Array
    """Rotation vector (3,), rad, from the truth's body frame to the estimate's."""
    covariance: Array
    """Covariance (7, 7) of the rotations, about the estimate's fixed and the truth's body axes, rad, and offset, s; 0 if not estimated.

    It is that of the remaining errors and their correlation. If a long outage dominates them, and no covariance says so, it is too small.
    """
    estimated: tuple[str, ...]
    """Which of :data:`ALIGNED` were estimated and removed."""
    residual: float
    """RMS of the remaining angle, rad."""
    ambiguous: bool = False
    """Whether the motion does not distinguish the offset of the clock from a rotation of the frames; σ is that of what it determines."""

    @property
    def turns(self) -> tuple[Array, Array]:
        """Quaternions of the rotations ``fixed`` and ``body``."""
        return quaternion.exp(self.fixed), quaternion.exp(self.body)

    @property
    def sigma(self) -> Array:
        """Standard deviations of fixed (3), body (3), rad, and offset, s: (7,)."""
        return np.sqrt(np.diag(self.covariance))

    def summary(self) -> dict[str, Any]:
        """Return the differences as plain values for JSON."""
        return {
            "removed": list(self.estimated),
            "time_offset_s": self.offset,
            "fixed_rotation_vector_deg": (self.fixed / DEGREE).tolist(),
            "body_rotation_vector_deg": (self.body / DEGREE).tolist(),
            "sigma_fixed_body_deg": (self.sigma[:6] / DEGREE).tolist(),
            "sigma_time_s": float(self.sigma[6]),
            "residual_rms_deg": self.residual / DEGREE,
        }

    @property
    def words(self) -> tuple[str, ...]:
        """Differences that were removed, one sentence each."""
        words = []
        if "time" in self.estimated:
            # Digits down to a tenth of σ, also if one clock counts from 1970.
            digits = max(6.0, 2.0 + np.ceil(np.log10(max(abs(self.offset), 1e-9) / max(self.sigma[6], 1e-9))))
            words.append(
                f"clocks differ by {self.offset:.{int(digits)}g} s ± {self.sigma[6]:.2g} s (added to the estimate's times): removed"
                + ("; at a constant rate a rotation of the frames would look the same" if self.ambiguous else "")
            )
        for name, rotation, rows in (("fixed", self.fixed, slice(0, 3)), ("body", self.body, slice(3, 6))):
            if name in self.estimated:
                text = ", ".join(f"{x / DEGREE:.4g}" for x in rotation)
                sigma = float(np.sqrt(np.mean(self.sigma[rows] ** 2))) / DEGREE
                words.append(
                    f"the {name} frames differ by {np.linalg.norm(rotation) / DEGREE:.4g}° (rotation vector {text}°) ± {sigma:.2g}° per "
                    f"axis{_usual(name, rotation)}: removed; a constant error of the filter would look the same"
                )
        if abs(quaternion.to_matrix(self.turns[0])[2, 2]) < math.cos(GROSS):
            words.append("the truth's z axis is not that of the estimate: heading is about z of the estimate")
        return tuple(words)


def _usual(name: str, rotation: Array) -> str:
    """Return the usual frames that differ by nearly this rotation vector, rad, in words; empty if there are none."""
    for words, usual in USUAL_FRAMES[name].items():
        if quaternion.angle_between(quaternion.exp(rotation), usual) < GROSS:
            return f", as {words} do"
    return ""


@dataclass(frozen=True, eq=False)
class Series:
    """A history of attitudes q_fb (m, 4), with the covariance of its error, gyro bias and movement (m,) if they are known."""

    time: Array
    attitude: Array
    covariance: Array | None = None
    bias: Array | None = None
    movement: np.ndarray | None = None

    def at(self, rows: np.ndarray, time: Array, attitude: Array) -> Series:
        """Return the given times and attitudes with the covariances and biases of these rows."""
        P, bias, movement = (
            None if column is None else column[rows] for column in (self.covariance, self.bias, self.movement)
        )
        return Series(time, attitude, P, bias, movement)


def series_of(
    prefix: str,
    time: ArrayLike,
    attitude: ArrayLike,
    covariance: ArrayLike | None = None,
    bias: ArrayLike | None = None,
    movement: ArrayLike | None = None,
) -> Series:
    """Return a checked history; ``prefix`` precedes its names in messages."""
    stamps = increasing(f"{prefix}time", time, minimum=2)
    m = len(stamps)
    q = unit_quaternions(f"{prefix}attitude", array(f"{prefix}attitude", attitude, (m, 4)))
    P = None if covariance is None else matrices("covariance", covariance, m)
    moves = None if movement is None else np.asarray(movement, bool)
    return Series(stamps, q, P, None if bias is None else array(f"{prefix}bias", bias, (m, 3)), moves)


def in_common_frames(own: Array, truth: Truth, fixed: Array, body: Array) -> tuple[Array, Truth]:
    """Return both attitudes (m, 4) in the estimate's fixed frame and the truth's body frame, given the quaternions between the frames.

    The z axis of an estimate's fixed frame is vertical; that of a truth may not be.
    """
    true_attitude = quaternion.multiply(quaternion.conjugate(fixed), truth.attitude)
    return quaternion.multiply(own, body), replace(truth, attitude=true_attitude)


def interpolated(time: Array, stamps: Array, attitude: Array, bridged: float) -> Array:
    """Return attitudes (n, 4) at ``time``, interpolated; at the truth's own times they are copied exactly, next to gaps too."""
    result = between_stamps(time, stamps, attitude, bridged)
    k = np.clip(np.searchsorted(stamps, time), 0, len(stamps) - 1)
    exact = time == stamps[k]
    result[exact] = attitude[k[exact]]
    return result


def _bridged(series: Series) -> float:
    """Return the maximum interval to interpolate over, s: 1.5 times the median one if the series is slow."""
    return max(BRIDGED, 1.5 * float(np.median(np.diff(series.time))))


def at_common_times(own: Series, theirs: Series, offset: float) -> tuple[Series, Truth]:
    """Return the estimate and the truth at common times: those of the estimate, or of the truth if it is sparser."""
    sparser = np.median(np.diff(theirs.time)) > 1.5 * np.median(np.diff(own.time))
    if sparser:
        inside = (theirs.time - offset >= own.time[0]) & (theirs.time - offset <= own.time[-1])
        at = theirs.time[inside] - offset
        near = np.clip(np.searchsorted(own.time, at), 1, len(own.time) - 1)
        near -= (at - own.time[near - 1]) < (own.time[near] - at)
        own = own.at(near, at, interpolated(at, own.time, own.attitude, _bridged(own)))
        q, bias = theirs.attitude[inside], None if theirs.bias is None else theirs.bias[inside]
        movement = None if theirs.movement is None else theirs.movement[inside]
        good = np.isfinite(own.attitude[:, 0])
    else:
        q = interpolated(own.time + offset, theirs.time, theirs.attitude, _bridged(theirs))
        good = np.isfinite(q[:, 0])
        bias = movement = None
        if theirs.movement is not None:
            after = np.clip(np.searchsorted(theirs.time, own.time + offset), 0, len(theirs.time) - 1)
            movement = theirs.movement[after]
        if theirs.bias is not None:
            bias = np.stack([np.interp(own.time + offset, theirs.time, theirs.bias[:, k]) for k in range(3)], axis=1)
    if good.sum() < 2:
        raise InputError(
            f"the estimate goes from {own.time[0] + offset:.6g} to {own.time[-1] + offset:.6g} s of the truth's clock, and the truth from "
            f"{theirs.time[0]:.6g} to {theirs.time[-1]:.6g} s: they have fewer than two times in common; "
            f"give both of one clock in one unit, or {Hint('align', 'time')}"
        )
    bias = np.full((len(q), 3), np.nan) if bias is None else bias
    truth = Truth(attitude=q, bias=bias, movement=movement).taken(good)
    return own.at(good, own.time[good] + offset, own.attitude[good]), truth


def rates(series: Series) -> tuple[Array, Array]:
    """Return the midpoints of the intervals (m − 1,) and the mean body rate over each (m − 1, 3)."""
    turn = quaternion.rotation_between(series.attitude[:-1], series.attitude[1:])
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


def _initial_rotations(own: Series, theirs: Series, names: tuple[str, ...], offset: float) -> list[tuple[Array, Array]]:
    """Return (fixed, body) quaternions to start from: identity, the fixed frame's, and with the body frame's from the rates."""
    matched, truth = at_common_times(own, theirs, offset)
    identity = np.array([1.0, 0.0, 0.0, 0.0])

    def fixed_of(body: Array) -> Array:
        turns = quaternion.multiply(truth.attitude, quaternion.conjugate(quaternion.multiply(matched.attitude, body)))
        return quaternion.from_rotation(quaternion.to_rotation(turns).mean(_weights(matched)[:, 0] ** 2))

    pairs = [(identity, identity)]
    if "fixed" in names:
        turn = fixed_of(identity)
        # From afar the first step would move the clock: at a constant rate it is a rotation too.
        pairs = [(turn, identity)] if abs(turn[0]) < 0.9 else [*pairs, (turn, identity)]
    if not {"fixed", "body"} <= set(names):
        return pairs
    _, w_own = rates(matched)
    _, w_true = rates(Series(matched.time, truth.attitude))
    # Wahba's problem: w_true = Bᵀ w_own.
    u, s, vt = np.linalg.svd(w_own.T @ w_true)
    if s[1] > 1e-3 * s[0]:
        B = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
        body = quaternion.from_matrix(B)
        pairs.append((fixed_of(body), body))
    return pairs


def fit(own: Series, theirs: Series, names: tuple[str, ...], offset: float) -> Alignment:
    """Return offset and rotations by weighted least squares of the remaining angle; σ from the effective number of residuals."""
    best: Alignment | None = None
    for fixed, body in _initial_rotations(own, theirs, names, offset):
        fitted = _descended(own, theirs, names, fixed, body, offset)
        best = fitted if best is None or fitted.residual < 0.999 * best.residual else best
    assert best is not None
    return best


def _descended(
    own: Series, theirs: Series, names: tuple[str, ...], fixed: Array, body: Array, offset: float
) -> Alignment:
    free = np.array([name in names for name in ("fixed",) * 3 + ("body",) * 3 + ("time",)])
    covariance, ambiguous = np.zeros((7, 7)), False
    common = min(own.time[-1] + offset, theirs.time[-1]) - max(own.time[0] + offset, theirs.time[0])
    near = offset + np.array([-1.0, 1.0]) * min(LONGEST_OFFSET, 0.5 * common)  # half of the common time remains common
    for _ in range(20):
        matched, truth = at_common_times(own, theirs, offset)
        aligned, truth = in_common_frames(matched.attitude, truth, fixed, body)
        weight = _weights(matched)
        left = r = weight * quaternion.rotation_between(aligned, truth.attitude)
        if not free.any():
            break
        J = weight[:, :, None] * jacobian(matched.time, aligned, truth)[:, :, free]
        information = np.einsum("mij,mik->jk", J, J)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        value, vector = np.linalg.eigh(information * np.outer(scale, scale))
        determined = value > 1e-6 * value[-1]  # directions that the motion does not determine are left unchanged
        ambiguous = bool(free[6] and np.abs(vector[-1, ~determined]).max(initial=0.0) > AMBIGUOUS)
        inverse = (vector[:, determined] / value[determined]) @ vector[:, determined].T * np.outer(scale, scale)
        step = np.zeros(7)
        step[free] = inverse @ np.einsum("mij,mi->j", J, r)
        left = r - np.einsum("mij,j->mi", J, step[free])
        share = len(r) / effective_samples(left, of_mean=True) if len(r) > 10 else 1.0
        if free[:6].all():  # a slew determines only the sum of both turns about its axis: that of the body is zero
            value, vector = np.linalg.eigh(information[:6, :6])
            both = vector[:, value <= 1e-6 * value[-1]]
            step[:6] += both @ np.linalg.lstsq(both[3:], -quaternion.log(body) - step[3:6], rcond=None)[0]
        covariance = np.zeros((7, 7))
        covariance[np.ix_(free, free)] = inverse * float(np.mean(left**2)) * share
        fixed = quaternion.normalize(quaternion.multiply(fixed, quaternion.exp(step[:3])))
        body = quaternion.normalize(quaternion.multiply(body, quaternion.exp(step[3:6])))
        offset = float(np.clip(offset + step[6], *near))
        if np.all(np.abs(step) <= 1e-3 * np.sqrt(np.diag(covariance)) + 1e-12):
            break
    return Alignment(
        offset=offset,
        fixed=quaternion.log(fixed),
        body=quaternion.log(body),
        covariance=covariance,
        estimated=tuple(name for name in ALIGNED if name in names),
        residual=float(np.sqrt(np.mean(np.sum((left / weight) ** 2, axis=1)))),
        ambiguous=ambiguous,
    )


def _weights(own: Series) -> Array:
    """Return the weight (m, 1) of each error: where a filter's σ is larger than its median, as before it converges, the ratio of both."""
    weight = np.ones((len(own.time), 1))
    if own.covariance is not None:
        size = np.trace(own.covariance[:, :3, :3], axis1=1, axis2=2)
        rows = size > 0.0  # others are refused later
        if rows.any():
            weight[rows, 0] = np.sqrt(np.minimum(1.0, np.median(size[rows]) / size[rows]))
    return weight


def jacobian(time: Array, aligned: Array, truth: Truth) -> Array:
    """Return the derivatives (m, 3, 7) of the attitude error with respect to fixed rotation, body rotation and clock offset.

    The attitudes are in common frames (:func:`in_common_frames`).
    """
    middle, rate = rates(Series(time, truth.attitude))
    J = np.zeros((len(time), 3, 7))
    J[:, :, :3] = np.swapaxes(quaternion.to_matrix(aligned), 1, 2)
    J[:, :, 3:6] = np.eye(3)
    J[:, :, 6] = -np.stack([np.interp(time, middle, rate[:, k]) for k in range(3)], axis=1)
    return J


def align_series(
    own: Series, theirs: Series, wanted: tuple[str, ...] | None, remarks: list[str]
) -> tuple[Series, Alignment]:
    """Return the estimate, its quaternions in the convention that fits, and its alignment with the truth."""
    offset = 0.0
    if wanted is None or "time" in wanted:
        own_at, own_rate = rates(own)
        true_at, true_rate = rates(theirs)
        speeds = (np.linalg.norm(own_rate, axis=1), np.linalg.norm(true_rate, axis=1))
        offset = coarse_offset(own_at, speeds[0], true_at, speeds[1])
    if wanted is not None:
        return own, fit(own, theirs, wanted, offset)
    whole = fit(own, theirs, ALIGNED, offset)
    if _gross(whole, GROSS):
        others = {words: replace(own, attitude=meant(own.attitude)) for words, meant in _CONVENTIONS.items()}
        fits = {words: fit(other, theirs, ALIGNED, offset) for words, other in others.items()}
        # A filter may be bad in any convention: residuals that are nearly the same do not decide.
        limit = max(GROSS, 1.5 * min(fitted.residual for fitted in (whole, *fits.values())))
        words = min(fits, key=lambda words: _gross(fits[words], limit))
        if _gross(fits[words], limit) < _gross(whole, limit):
            remarks.append(f"the quaternions fit the truth best if read as {words}, so they are read as such")
            own, whole = others[words], fits[words]
    moved = ("time",) if abs(whole.offset) > 3.0 * whole.sigma[6] + 1e-9 else ()
    base = whole.offset if moved else 0.0
    trials = (moved, ("fixed", *moved), ("body", *moved), ("fixed", "body", *moved))
    for names in trials:
        fitted = fit(own, theirs, names, base)
        if fitted.residual < max(GROSS if names == moved else 0.0, 1.5 * whole.residual):
            break
    return own, fitted


def _gross(fitted: Alignment, limit: float) -> int:
    """Return the number of gross rotations, plus 3 if even with them the residual is above the limit, rad."""
    turned = sum(float(np.linalg.norm(vector)) > GROSS for vector in (fitted.fixed, fitted.body))
    return turned + (3 if fitted.residual > limit else 0)


_CONVENTIONS = {
    "the inverse, fixed frame to body": quaternion.conjugate,
    "scalar last": lambda q: q[:, [3, 0, 1, 2]],
    "scalar last and the inverse": lambda q: quaternion.conjugate(q[:, [3, 0, 1, 2]]),
    "scalar first": lambda q: q[:, [1, 2, 3, 0]],  # in a format whose scalar is last, such as TUM
    "scalar first and the inverse": lambda q: quaternion.conjugate(q[:, [1, 2, 3, 0]]),
}
