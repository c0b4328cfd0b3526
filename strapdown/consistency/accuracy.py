"""Accuracy of an estimate against a truth or a reference: one table for all; convergence time."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError, are_finite, array
from strapdown.consistency.alignment import ALIGNED, Alignment, Series, align_series, at_common_times, in_common_frames
from strapdown.consistency.manifold import nees
from strapdown.files import plain
from strapdown.records import Estimate, Truth
from strapdown.results import Column, Listed, Table, figure
from strapdown.units import DEGREE, DEGREE_PER_HOUR

KINDS = ("total", "heading", "inclination")
"""Parts of an attitude error: its angle, its part about the vertical, the angle between the two verticals."""
_STATES = {"total": (0, 1, 2), "heading": (2,), "inclination": (0, 1)}
REGION = 0.95
"""Probability of the regions of an error given its covariance, whose coverage is reported."""
FITTED = 4000
"""Maximum number of attitudes from which clocks and frames are aligned."""


class ReferenceErrors(NamedTuple):
    """Errors of an estimated attitude against a reference, as defined by the BROAD benchmark, rad; NaN where there is no reference."""

    total: Array
    """Angle of the rotation between estimate and reference (n,)."""
    heading: Array
    """Angle of its part about the vertical (n,)."""
    inclination: Array
    """Angle of the remaining rotation, between the two verticals (n,)."""

    def rms(self, movement: np.ndarray | None = None) -> dict[str, float]:
        """Return the RMS of each error, rad, over the samples with a reference; if given, only those of the ``movement`` mask."""
        judged = np.isfinite(self.total) if movement is None else np.isfinite(self.total) & movement
        if not judged.any():
            raise InputError(
                "no sample to judge has a valid reference attitude; check the movement mask and the reference"
            )
        return {kind: float(np.sqrt(np.mean(getattr(self, kind)[judged] ** 2))) for kind in KINDS}


def reference_errors(attitude: ArrayLike, reference: ArrayLike) -> ReferenceErrors:
    """Return the attitude errors against a reference whose fixed frame has its z axis vertical.

    With ``d = q_est ⊗ q_ref⁻¹`` in the fixed frame: total 2 acos |d_w|, heading 2 atan |d_z / d_w|, inclination 2 acos √(d_w² + d_z²), in
    forms that are accurate for small errors.

    Parameters
    ----------
    attitude : array_like (n, 4)
        Estimated q_fb.
    reference : array_like (n, 4)
        Reference q_fb; rows of NaN are unknown.

    Returns
    -------
    ReferenceErrors
        Angles, rad; NaN where the reference is unknown.

    References
    ----------
    D. Laidig, M. Caruso, A. Cereatti, T. Seel, BROAD — A benchmark for robust inertial orientation estimation, Data 6(7):72, 2021, section
    4.1.
    """
    q = array("attitude", attitude, ("n", 4))
    r = array("reference", reference, (len(q), 4), allow_nan=True)
    known = are_finite(r)
    zero = known & (np.linalg.norm(r, axis=1) == 0.0)
    if zero.any():
        raise InputError(f"reference[{int(np.argmax(zero))}] is the zero quaternion; mark missing rows as NaN")
    d = quaternion.multiply(q[known], quaternion.conjugate(quaternion.normalize(r[known])))
    w, x, y, z = np.moveaxis(d, -1, 0)
    results = np.full((3, len(q)), np.nan)
    results[0, known] = 2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w))
    results[1, known] = 2.0 * np.arctan2(np.abs(z), np.abs(w))
    results[2, known] = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z))
    return ReferenceErrors(*results)


class ErrorSize(NamedTuple):
    """Size of one part of the attitude error over some samples."""

    rms: float
    """Root mean square of the angle, rad."""
    median: float
    """Median of the angle, rad."""
    maximum: float
    """Maximum of the angle, rad."""
    samples: int
    """Number of samples."""
    coverage: float = math.nan
    """Fraction of the errors inside the 95 % region of the covariance; NaN without a covariance."""
    rms_over_sigma: float = math.nan
    """Root mean square of the error divided by its σ: 1 for a consistent filter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Accuracy(Listed):
    """Attitude errors of an estimate against a truth or a reference.

    Parameters
    ----------
    given : mapping of str to mapping of str to ErrorSize
        Errors by span ("all samples", and "movement" if the truth states it) and by part (:data:`KINDS`), as given.
    aligned : mapping, default empty
        The same after clocks and frames are aligned.
    alignment : Alignment, optional
        The differences of clocks and frames; they are removed from ``aligned`` only.
    bias : tuple of float, optional
        RMS error of the gyro bias and the root mean square of its σ, both of three axes together, rad/s.
    """

    given: Mapping[str, Mapping[str, ErrorSize]]
    aligned: Mapping[str, Mapping[str, ErrorSize]] = field(default_factory=dict)
    alignment: Alignment | None = None
    bias: tuple[float, float] | None = None

    @property
    def samples(self) -> dict[str, int]:
        """Number of samples by span."""
        return {span: sizes["total"].samples for span, sizes in (self.given or self.aligned).items()}

    @property
    def rms_over_sigma(self) -> dict[str, float]:
        """RMS error over σ by part, over all samples as given; empty without a covariance."""
        sizes = self.given.get("all samples", {})
        return {kind: size.rms_over_sigma for kind, size in sizes.items() if math.isfinite(size.rms_over_sigma)}

    def listing(self) -> Table:
        """Return the errors as given and aligned, by span and part, in degrees."""
        rows = []
        for words, table in (("as given", self.given), ("aligned", self.aligned)):
            for span, sizes in table.items():
                for kind, size in sizes.items():
                    angles = (x / DEGREE for x in size[:3])
                    share = "" if math.isnan(size.coverage) else f"{100.0 * size.coverage:.1f} %"
                    ratio = "" if math.isnan(size.rms_over_sigma) else size.rms_over_sigma
                    rows.append((span, words, kind, *angles, share, ratio))
        notes = [
            "RMS, median and maximum of the angle of each part; RMS/σ per axis of the part, 1 for a consistent filter"
            + ("; aligned, less if its errors are partly constant." if self.aligned else ".")
        ]
        if self.bias is not None:
            error, sigma = (figure(value / DEGREE_PER_HOUR) for value in self.bias)
            notes.append(f"Gyro bias: RMS error {error} °/h, σ {sigma} °/h, of three axes together.")
        if self.alignment is not None:
            notes += [f"Aligned rows: {words}." for words in self.alignment.words]
        columns = (
            "over",
            "frames",
            "error",
            "RMS, °",
            "median, °",
            "maximum, °",
            "in 95 % region",
            Column("RMS/σ", digits=3),
        )
        spans = ", ".join(
            f"{number} {'samples' if name == 'all samples' else f'of {name}'}" for name, number in self.samples.items()
        )
        return Table(f"Attitude error over {spans}", columns, rows, notes, left=3)

    def summary(self) -> dict[str, Any]:
        """Return the errors as plain values for JSON, in degrees.

        Returns
        -------
        dict
            ``samples``; ``given`` and ``aligned`` by span and part; ``alignment``; ``bias``.
        """

        def angles(table: Mapping[str, Mapping[str, ErrorSize]]) -> dict[str, Any]:
            return {
                span: {
                    kind: {
                        **{f"{name}_deg": getattr(size, name) / DEGREE for name in ("rms", "median", "maximum")},
                        "coverage": size.coverage,
                        "rms_over_sigma": size.rms_over_sigma,
                    }
                    for kind, size in sizes.items()
                }
                for span, sizes in table.items()
            }

        summary = {"samples": self.samples, "given": angles(self.given), "aligned": angles(self.aligned)}
        if self.bias is not None:
            rms, sigma = self.bias
            summary["bias"] = {"rms_deg_per_h": rms / DEGREE_PER_HOUR, "sigma_deg_per_h": sigma / DEGREE_PER_HOUR}
        if self.alignment is not None:
            summary["alignment"] = self.alignment.summary()
        return plain(summary)  # type: ignore[no-any-return]


def accuracy(estimate: Estimate, truth: Truth | None = None, *, align: bool = False) -> Accuracy:
    """Return the attitude errors of an estimate against a truth at its times, NaN where unknown; by default its own.

    With ``align`` they are also reported after clocks and frames are aligned.
    """
    truth = estimate.truth if truth is None else truth
    if truth is None:
        raise InputError("the estimate has no truth; give one")
    if not (estimated := estimate.known).all():
        estimate, truth = estimate.taken(estimated), truth.taken(estimated)
    known = truth.known
    if not known.any():
        raise InputError("the truth has no attitude at the estimate's times")
    P = estimate.attitude_covariance
    own = Series(estimate.time, estimate.attitude, P if P is not None and np.isfinite(P).all() else None)
    theirs = truth.taken(known)
    as_stored = _sizes(own.at(known, own.time[known], own.attitude[known]), theirs)
    alignment, aligned, bias = None, dict[str, dict[str, ErrorSize]](), None
    if align:
        truth_at = Series(own.time[known], theirs.attitude, movement=theirs.movement)
        alignment = _whole_alignment(own, truth_at)
        aligned = _aligned_sizes(own, truth_at, alignment)
    if truth.has_bias and estimate.has_bias:
        rows = are_finite(truth.bias)
        squares = (estimate.bias - truth.bias)[rows] ** 2, estimate.variance[rows, 3:]
        bias = tuple(float(np.sqrt(np.mean(np.sum(square, axis=1)))) for square in squares)
    return Accuracy(given=as_stored, aligned=aligned, alignment=alignment, bias=bias)  # type: ignore[arg-type]


def accuracy_of(own: Series, theirs: Series, alignment: Alignment | None = None) -> Accuracy:
    """Return the errors of a history of attitudes against another in its own clock and frames, as given and aligned.

    By default all differences of clocks and frames are removed. The errors as given are left out if the two have no times in common.
    """
    alignment = _whole_alignment(own, theirs) if alignment is None else alignment
    aligned = _aligned_sizes(own, theirs, alignment) if alignment.estimated else {}
    as_stored: dict[str, dict[str, ErrorSize]] = {}
    with contextlib.suppress(InputError):
        as_stored = _sizes(*at_common_times(own, theirs, 0.0))
    return Accuracy(given=as_stored, aligned=aligned, alignment=alignment)


def _whole_alignment(own: Series, theirs: Series) -> Alignment:
    """Return all differences of clocks and frames of two histories."""
    thin = slice(None, None, max(1, len(own.time) // FITTED))
    return align_series(Series(own.time[thin], own.attitude[thin]), theirs, ALIGNED, [])[1]


def _aligned_sizes(own: Series, theirs: Series, alignment: Alignment) -> dict[str, dict[str, ErrorSize]]:
    """Return the errors after an alignment, about the vertical of the estimate."""
    return _sizes(*at_common_times(own, theirs, alignment.offset), *alignment.turns)


def _sizes(own: Series, truth: Truth, *turns: Array) -> dict[str, dict[str, ErrorSize]]:
    """Return the sizes of the errors by span and part, after the rotations ``turns`` of fixed and body frames, if any, are removed."""
    attitude, truth = in_common_frames(own.attitude, truth, *turns) if turns else (own.attitude, truth)
    errors = reference_errors(attitude, truth.attitude)
    squares = None
    if own.covariance is not None:
        R = quaternion.to_matrix(own.attitude)  # to the fixed frame, in which another body frame changes nothing
        squares = _normalised(attitude, truth.attitude, R @ own.covariance[:, :3, :3] @ np.swapaxes(R, 1, 2))
    spans = {"all samples": np.ones(len(attitude), bool)}
    if truth.movement is not None and truth.movement.any():
        spans["movement"] = truth.movement
    return {
        span: {
            kind: _size(kind, getattr(errors, kind)[rows], None if squares is None else squares[kind][rows])
            for kind in KINDS
        }
        for span, rows in spans.items()
    }


def _size(kind: str, angle: Array, squares: Array | None) -> ErrorSize:
    from scipy.special import chdtri

    size = ErrorSize(float(np.sqrt(np.mean(angle**2))), float(np.median(angle)), float(angle.max()), len(angle))
    if squares is None:
        return size
    degrees = len(_STATES[kind])
    inside = float(np.mean(squares <= chdtri(degrees, 1.0 - REGION)))
    return size._replace(coverage=inside, rms_over_sigma=float(np.sqrt(np.mean(squares) / degrees)))


def _normalised(attitude: Array, true_attitude: Array, covariance: Array) -> dict[str, Array]:
    """Return the normalised squares (m,) of each part of the error; axes and covariance are those of the fixed frame, z vertical."""
    error = quaternion.log(quaternion.multiply(true_attitude, quaternion.conjugate(attitude)))
    return {kind: nees(error, covariance, states) for kind, states in _STATES.items()}
