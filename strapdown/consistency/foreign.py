"""The verdict on the estimate of another program, against a truth that may have another clock and other frames.

:func:`check_attitudes` aligns clocks and frames: gross differences are removed, reported, and their uncertainty added to the covariance.
The definition of the attitude covariance is given or found from the errors, and :func:`strapdown.consistency.judge` judges the result.
Small differences that would explain the errors are reported with the verdict and not removed unless requested, because a constant
rotation between frames and a constant error of the filter are indistinguishable.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, Hint, InputError, one_of
from strapdown.consistency.accuracy import Accuracy, accuracy_of
from strapdown.consistency.alignment import (
    ALIGNED,
    Alignment,
    Series,
    align_series,
    at_common_times,
    in_common_frames,
    jacobian,
    series_of,
)
from strapdown.consistency.bounds import mean_p_value
from strapdown.consistency.judgement import DETECTABLE, Judgement, holm, judge, mark
from strapdown.consistency.manifold import whitened
from strapdown.consistency.timeaverage import MIN_ROWS, effective_samples, time_average
from strapdown.estimation.setup import from_toml, unmodelled
from strapdown.records import Estimate, Origin, Truth
from strapdown.records.outputs import euler_axes
from strapdown.results import Column, Table
from strapdown.units import DEGREE, DEGREE_PER_HOUR

if TYPE_CHECKING:
    from strapdown.recordings.attitudes import Attitudes

ERROR_FRAMES = ("body", "fixed", "euler")
"""Definitions of an attitude covariance: of δθ with ``q_true = q ⊗ exp(δθ)``; of δφ with ``q_true = exp(δφ) ⊗ q``, as ROS defines it for
poses; of the errors of roll, pitch and yaw, in this order (ZYX)."""
DECIDED = 0.9
"""Probability above which the errors decide the definition of the covariance; below, "body" is used, this package's own."""
FEW_IN_COMMON = 0.05
"""Share of the times of the shorter history below which the unit of time is doubted."""
SCALE = "σ wrong by one factor"
CLOCK = "offset of the clock, delay"
NO_BIAS = "gyro bias held at zero"


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """A difference that would explain errors beyond the covariance and was not removed."""

    name: str
    value: str
    nees: float
    """NEES of the attitude per state if it were removed."""
    p_value: float
    """Probability of as large a reduction by chance for a consistent filter; small if the explanation is likely."""
    likely: bool = False
    """Whether so large a reduction is improbable by chance, all explanations together (Holm)."""
    known: bool = False
    """Whether the verdict itself names it: σ that are upper bounds are too large, and the gyro's stamps are specified to be late."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Checked:
    """The verdict on the estimate of another program, with the alignment and definitions it rests on.

    Parameters
    ----------
    judgement : Judgement
        The verdict with its evidence.
    estimate : Estimate
        The estimate as it was judged: in the truth's clock and body frame and its own fixed frame, whose z axis is vertical, with the
        covariance of the body-side error, and with its truth.
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
    accuracy : Accuracy or None
        The errors as given and aligned.
    """

    judgement: Judgement
    estimate: Estimate
    alignment: Alignment | None = None
    error_frame: str = ""
    frame_probability: Mapping[str, float] = field(default_factory=dict)
    explanations: tuple[Explanation, ...] = ()
    remarks: tuple[str, ...] = ()
    accuracy: Accuracy | None = None

    @property
    def tables(self) -> list[Table]:
        """The errors relative to the truth, and their possible causes, if there are any."""
        tables = [] if self.accuracy is None else [self.accuracy.listing()]
        return [*tables, self.listing()] if self.explanations else tables

    def listing(self) -> Table:
        """Return the possible causes of the attitude errors as a table."""
        rows = [(e.name, e.value, e.nees, e.p_value, mark(e.likely, e.known)) for e in self.explanations]
        columns = ("cause", "size", "NEES then", Column("p-value", digits=2), "")
        return Table("Possible causes of the attitude errors", columns, rows, left=2)

    def summary(self) -> dict[str, Any]:
        """Return everything as plain values for JSON.

        Returns
        -------
        dict
            The verdict as of :meth:`Judgement.summary`, with the definition of the covariance, explanations, remarks and
            alignment (degrees, s).
        """
        return {
            **self.judgement.summary(),
            "error_frame": self.error_frame,
            "error_frame_probability": dict(self.frame_probability),
            "explanations": [vars(explanation) for explanation in self.explanations],
            "remarks": list(self.remarks),
            "accuracy": None if self.accuracy is None else self.accuracy.summary(),
            **({} if self.alignment is None else {"alignment": self.alignment.summary()}),
        }


def check_attitudes(
    own: Attitudes,
    truth: Attitudes | None = None,
    *,
    error_frame: str = "find",
    align: str | Iterable[str] = "auto",
    confidence_level: float = 0.99,
    detectable_error: float = DETECTABLE,
) -> Checked:
    """Return the verdict on an estimate of any filter against a truth, as ``strapdown check`` with a truth does.

    Parameters
    ----------
    own, truth : Attitudes
        Results of :func:`strapdown.read_attitudes`, or :class:`strapdown.recordings.Attitudes` of arrays; each in its own clock and frames.
        Without a covariance, errors are reported but not judged; biases are judged if both have one. Without a truth only the
        innovations are judged.
    error_frame : {"find", "body", "fixed", "euler"}
        Definition of the covariance (:data:`ERROR_FRAMES`). "find" takes the one that the file declares, else that of maximum likelihood
        given the errors.
    align : "auto", "none", or any of "time", "fixed", "body"
        Differences to estimate and remove. "auto": a clock offset beyond three times its σ, and rotations above 5°; the errors are then
        also reported with all differences removed.
    confidence_level, detectable_error : float
        As for :func:`strapdown.consistency.judge`.

    Returns
    -------
    Checked
        The verdict, with the alignment and the definition of the covariance that it rests on.

    Examples
    --------
    >>> import numpy as np
    >>> from strapdown import quaternion
    >>> from strapdown.recordings import Attitudes
    >>> random = np.random.default_rng(1)
    >>> time = np.arange(1000.0)
    >>> attitude = quaternion.exp(np.cumsum(0.1 * random.standard_normal((1000, 3)), axis=0) % 2.0)
    >>> estimate = quaternion.multiply(attitude, quaternion.exp(0.01 * random.standard_normal((1000, 3))))
    >>> P = np.tile(1e-4 * np.eye(3), (1000, 1, 1))
    >>> truth = Attitudes.from_arrays(time, attitude)
    >>> check_attitudes(Attitudes.from_arrays(time, estimate, covariance=P), truth).judgement.verdict
    'consistent'
    >>> check_attitudes(Attitudes.from_arrays(time, estimate, covariance=0.5 * P), truth).judgement.verdict
    'not consistent'
    """
    how: dict[str, Any] = {"confidence_level": confidence_level, "detectable_error": detectable_error}
    if truth is None:
        return _without_truth(own, how)
    declared = own.error_frame if error_frame == "find" and own.error_frame else error_frame
    one_of("error_frame", declared, ("find", *ERROR_FRAMES))
    whole, theirs = _series_of_both(own, truth)
    remarks: list[str] = []
    wanted = _wanted(align)
    whole, alignment = align_series(whole, theirs, wanted, remarks)
    common, true = at_common_times(whole, theirs, alignment.offset)
    remarks += [*_words_on_few_times(len(common.time), whole, theirs)]
    remarks += [f"for the verdict, {words}" for words in alignment.words]
    aligned, true = in_common_frames(common.attitude, true, *alignment.turns)
    reading = _Reading("", {})
    if whole.covariance is not None:
        reading = _read(common, aligned, true, alignment, declared, confidence_level)
        whole = replace(whole, covariance=read_as(reading.frame, whole.covariance, whole.attitude))
    estimate = Estimate.from_arrays(
        common.time, aligned, reading.covariance, bias=reading.bias, innovations=own.innovations
    )
    remarks += reading.remarks
    if declared != error_frame:
        remarks.append(f"the file declares that its covariance is of the {declared} error")
    estimate = replace(
        estimate,
        truth=true,
        motion=own.motion,
        remarks=tuple(f"Note: {words}." for words in remarks),
        setup=from_toml(own.filter, f"{own.source}: filter") if own.filter else None,
        origin=replace(own.origin or Origin(), source=own.source, epoch_ns=0),
        details={"truth": truth.source},
    )
    return Checked(
        judgement=judge(estimate, **how),
        estimate=estimate,
        alignment=alignment,
        error_frame=reading.frame,
        frame_probability=reading.probabilities if declared == "find" else {},
        explanations=tuple(replace(e, known=_is_known(e, estimate)) for e in reading.explanations),
        remarks=tuple(remarks),
        accuracy=accuracy_of(whole, theirs, None if wanted is None else alignment),
    )


def _words_on_few_times(common: int, own: Series, theirs: Series) -> Iterator[str]:
    """Yield a doubt about the unit of time if few times are in common."""
    if common < FEW_IN_COMMON * min(len(own.time), len(theirs.time)):
        yield (
            f"the estimate lasts {np.ptp(own.time):.4g} s and the truth {np.ptp(theirs.time):.4g} s, with only {common} times in common; "
            "check the unit of time"
        )


def _without_truth(own: Attitudes, how: Mapping[str, Any]) -> Checked:
    """Return the verdict on the innovations of an estimate."""
    if not own.innovations:
        raise InputError(
            f"{own.source} has no innovations, so it cannot be judged without a truth; give {Hint('truth')}, attitudes over the same time"
        )
    estimate = Estimate.from_arrays(own.seconds(int(own.stamps_ns[0])), own.attitude, innovations=own.innovations)
    estimate = replace(estimate, motion=own.motion)
    return Checked(judgement=judge(estimate, **how), estimate=estimate)


def _series_of_both(own: Attitudes, truth: Attitudes) -> tuple[Series, Series]:
    """Return the histories of an estimate and a truth, with biases if both have them."""
    # One clock may count from 1970 and the other from the boot of a machine: both relative to the first stamp, in integer ns.
    origin = int(min(own.stamps_ns[0], truth.stamps_ns[0]))
    with_bias = own.bias is not None and truth.bias is not None
    P = own.covariance if with_bias or own.covariance is None else own.covariance[:, :3, :3]
    return (
        series_of("", own.seconds(origin), own.attitude, P, own.bias if with_bias else None),
        series_of("true_", truth.seconds(origin), truth.attitude, None, truth.bias, truth.movement),
    )


def _is_known(explanation: Explanation, estimate: Estimate) -> bool:
    """Return whether the verdict itself names a difference: late stamps that are specified, or σ that are upper bounds."""
    if explanation.name == CLOCK:
        late = ("gyro", "time offset")
        return any((error.of, error.name) == late for error in unmodelled(estimate.origin, estimate.setup))
    return explanation.name == SCALE and bool(estimate.motion) and float(explanation.value) < 1.0


def _chosen_frame(wanted: str, probabilities: Mapping[str, float]) -> tuple[str, list[str]]:
    """Return the definition of the covariance, given or found, and the remark on it."""
    best = max(probabilities, key=lambda name: probabilities[name])
    if wanted != "find":
        far = probabilities[wanted] < 0.01
        words = f"the covariance is read as {wanted}, as given; the errors fit far better read as {best}"
        return wanted, [words] if far else []
    said = ", ".join(f"{name} {100.0 * p:.3g} %" for name, p in probabilities.items())
    if probabilities[best] >= DECIDED:
        return best, [f"the covariance is read as {best} ({said}, found from the errors)"]
    words = f"the errors do not decide how the covariance is defined ({said}): it is read as body"
    return "body", [f"{words}; {Hint('error_frame')} names another"]


def _wanted(align: str | Iterable[str]) -> tuple[str, ...] | None:
    """Return the differences to remove; None if the data decide."""
    if align == "auto":
        return None
    if align == "none":
        return ()
    names = [part.strip() for part in align.split(",")] if isinstance(align, str) else list(align)
    return tuple(one_of("align", name, (*ALIGNED, "auto", "none")) for name in names)


# ------------------------------------------------------------------------------------------------------------ readings


class _Reading(NamedTuple):
    """The covariance of an estimate as that of the body-side error, in the truth's body axes; empty without one."""

    frame: str
    """Definition by which it is read."""
    probabilities: dict[str, float]
    """Of the definitions, by the errors."""
    covariance: Array | None = None
    bias: Array | None = None
    """The estimate's bias in these axes, if it has one."""
    explanations: tuple[Explanation, ...] = ()
    remarks: Sequence[str] = ()


def _read(
    common: Series, aligned: Array, true: Truth, alignment: Alignment, declared: str, confidence_level: float
) -> _Reading:
    """Return the covariance by the ``declared`` definition, or by that which the errors show, and what would explain the errors.

    ``aligned`` (m, 4): attitudes in the common frames (:func:`in_common_frames`).
    """
    derivatives = jacobian(common.time, aligned, true)
    readings = _readings(common, alignment, derivatives)
    error = quaternion.rotation_between(aligned, true.attitude)
    probabilities = frame_probabilities(error, {name: P[:, :3, :3] for name, P in readings.items()})
    frame, remarks = _chosen_frame(declared, probabilities)
    covariance = readings[frame]
    others = list(_other_frames(error, readings, frame, probabilities))
    bias = None
    if common.bias is not None:
        bias = quaternion.rotate(quaternion.conjugate(alignment.turns[1]), common.bias)
        if not common.bias.any():
            others.append(_zero_bias(true.bias, covariance))
    explained = explanations(error, covariance, derivatives, others, confidence_level=confidence_level)
    return _Reading(frame, probabilities, covariance, bias, explained, remarks)


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
        weight = effective_samples(white) if name == "body" else weight
    best = max(scores.values())
    likelihood = {name: math.exp(max(weight * (score - best), -700.0)) for name, score in scores.items()}
    return {name: value / sum(likelihood.values()) for name, value in likelihood.items()}


def _readings(own: Series, alignment: Alignment, J: Array) -> dict[str, Array]:
    """Return the covariances by definition, in the truth's body axes, with the uncertainty of the alignment added.

    ``J`` (m, 3, 7): derivatives of the errors with respect to the alignment (:func:`jacobian`).
    """
    assert own.covariance is not None
    turn = quaternion.to_matrix(alignment.turns[1]).T
    T = np.kron(np.eye(own.covariance.shape[1] // 3), turn)
    readings = {name: T @ read_as(name, own.covariance, own.attitude) @ T.T for name in ERROR_FRAMES}
    for P in readings.values():
        P[:, :3, :3] += J @ alignment.covariance @ np.swapaxes(J, 1, 2)
    return readings


# -------------------------------------------------------------------------------------------------------- explanations


def explanations(
    error: Array,
    covariance: Array,
    derivatives: Array,
    others: Sequence[Explanation] = (),
    *,
    confidence_level: float = 0.99,
) -> tuple[Explanation, ...]:
    """Return differences that would explain the errors, (m, 3) of the attitude, better than the covariance, the most likely first.

    ``derivatives`` (m, 3, 7) are those of :func:`jacobian`, ``others`` further candidates. For a consistent filter none is likely with
    ``confidence_level``.
    """
    P = covariance[:, :3, :3]
    candidates = [*_constant_differences(error, P, derivatives), _wrong_scale(whitened(error, P)), *others]
    likely = holm([candidate.p_value for candidate in candidates], 1.0 - confidence_level)
    marked = [replace(candidate, likely=is_likely) for candidate, is_likely in zip(candidates, likely, strict=True)]
    # Specific causes come before a factor on σ, which would absorb all of them.
    return tuple(
        sorted(marked, key=lambda explanation: (not explanation.likely, explanation.name == SCALE, explanation.p_value))
    )


def _constant_differences(error: Array, P: Array, derivatives: Array) -> Iterator[Explanation]:
    """Yield constant rotations of the frames and a clock offset."""
    white, factor = whitened(error, P), np.linalg.cholesky(P)
    designs = {
        "fixed frame rotated (heading, gravity)": derivatives[:, :, :3],
        "body frame rotated (mounting)": derivatives[:, :, 3:6],
        CLOCK: derivatives[:, :, 6:],
    }
    for name, J in designs.items():
        A = np.linalg.solve(factor, J)
        N = np.einsum("mij,mik->jk", A, A)
        if np.linalg.matrix_rank(N, 1e-12 * max(float(np.trace(N)), 1e-300)) < N.shape[0]:
            continue
        x = np.linalg.solve(N, np.einsum("mij,mi->j", A, white))
        left = white - np.einsum("mij,j->mi", A, x)
        size = f"{1e3 * x[0]:.4g} ms" if len(x) == 1 else f"{', '.join(f'{v / DEGREE:.3g}' for v in x)}°"
        p_value = _constant_p_value(N @ x, np.einsum("mij,mi->mj", A, left))
        yield Explanation(name=name, value=size, nees=float(np.mean(left**2)), p_value=p_value)


def _wrong_scale(white: Array) -> Explanation:
    """Return one factor on σ as the explanation of whitened errors (m, 3)."""
    average = time_average(white, np.broadcast_to(np.eye(3), (len(white), 3, 3))) if len(white) > MIN_ROWS else None
    p_value, scale = 1.0, math.sqrt(float(np.mean(white * white)))
    if average is not None and average.reliable:
        p_value = mean_p_value(average.mean, 3, average.effective, certainty=average.certainty)
    return Explanation(name=SCALE, value=f"{scale:.3g}", nees=1.0, p_value=p_value)


def _zero_bias(bias: Array, P: Array) -> Explanation:
    """Return a gyro bias that the filter holds at zero as a cause, likely if it exceeds three of its σ."""
    rms, sigma = np.sqrt(3.0 * np.mean(bias**2)), np.sqrt(np.mean(np.trace(P[:, 3:, 3:], axis1=1, axis2=2)))
    value = f"{rms / DEGREE_PER_HOUR:.3g} °/h"
    return Explanation(name=NO_BIAS, value=value, nees=math.nan, p_value=0.0 if rms > 3.0 * sigma else 1.0)


def _other_frames(
    error: Array, readings: Mapping[str, Array], frame: str, probabilities: Mapping[str, float]
) -> Iterator[Explanation]:
    """Yield the definitions of the covariance that the errors fit better than the one used."""
    for name, P in readings.items():
        if probabilities[name] > probabilities[frame]:
            value, nees = f"{100.0 * probabilities[name]:.3g} %", float(np.mean(whitened(error, P[:, :3, :3]) ** 2))
            p_value = probabilities[frame] / probabilities[name]
            yield Explanation(name=f"covariance meant as {name}", value=value, nees=nees, p_value=p_value)


def _constant_p_value(total: Array, scores: Array) -> float:
    """Return the p-value of the sum (k,) of scores by their sums left (m, k) after the fit: Hotelling's T² with the variance of their mean.

    That variance is the spectral density of the scores at frequency zero, by a vector autoregression of sums over blocks. The largest over
    the lengths of the blocks counts, since a slow part is hidden by a fast one in short blocks. 1 if the samples are too few.
    """
    from scipy.special import fdtrc

    m, k = scores.shape
    density, length = None, 1
    while m // length >= MIN_ROWS:
        sums = scores[: m // length * length].reshape(-1, length, k).sum(axis=1)
        B = np.linalg.lstsq(sums[:-1], sums[1:], rcond=None)[0].T * (1.0 + 2.0 / len(sums))
        B /= max(1.0, float(np.max(np.abs(np.linalg.eigvals(B)))) / 0.99)
        noise = sums[1:] - sums[:-1] @ B.T
        inverse = np.linalg.inv(np.eye(k) - B)
        of_mean = inverse @ (noise.T @ noise / len(noise)) @ inverse.T / length
        density = of_mean if density is None or np.linalg.det(of_mean) > np.linalg.det(density) else density
        length *= 2
    if density is None:
        return 1.0
    spread = scores.T @ scores / m
    effective = m * (np.linalg.det(spread) / max(float(np.linalg.det(density)), 1e-300)) ** (1.0 / k)
    if effective <= k + 1.0:
        return 1.0
    square = float(total @ np.linalg.solve(m * density, total))
    return float(fdtrc(k, effective - k, square * (effective - k) / (k * (effective - 1.0))))
