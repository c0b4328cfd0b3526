"""Integration of the gyro alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from strapdown import coning, quaternion, recordings
from strapdown.checks import Array, InputError, are_finite, instance
from strapdown.recordings import Recording
from strapdown.records import Estimate, ImuRecord, Origin
from strapdown.workflows.estimating import SOURCE


def integrate(
    source: ImuRecord | Recording,
    algorithm: str | coning.Algorithm = "four-sample",
    *,
    initial_attitude: ArrayLike | None = None,
) -> Estimate:
    """Integrate gyro samples to attitude, without other sensors.

    Parameters
    ----------
    source : ImuRecord or Recording
        Only its gyro samples are used; gyro errors are not corrected.
    algorithm : str or Algorithm, default "four-sample"
        Coning algorithm (``strapdown.coning.ALGORITHMS``).
    initial_attitude : array_like (4,), optional
        q_fb at the first edge. Default: the true attitude if the source has it, otherwise the identity.

    Returns
    -------
    Estimate
        ``time`` (k + 1,), s, and ``attitude`` (k + 1, 4), q_fb, at the edges of the algorithm's steps; remaining samples are dropped.
        Bias and covariance are NaN. ``remarks`` have the error relative to a true attitude, ``details`` the algorithm.

    Examples
    --------
    >>> import strapdown as sd
    >>> attitude = sd.integrate(sd.simulate("coning")).attitude  # doctest: +SKIP
    """
    rule = coning.named(algorithm)
    instance("source", source, (ImuRecord, Recording), SOURCE)
    if isinstance(source, ImuRecord):
        time, increments, origin = source.time, source.increments, source.origin
        known, place = None if source.truth is None else source.truth.attitude, "the record"
    else:
        place, origin = source.source, Origin(source=source.source, epoch_ns=source.epoch_ns)
        time, increments, known = source.time, recordings.increments(source), source.true_attitude
    if len(increments) < rule.samples:
        raise InputError(
            f"{place} holds {len(increments)} gyro samples, fewer than the {rule.samples} of one step of {rule.name}; choose another "
            "algorithm or a longer recording"
        )
    start: ArrayLike = quaternion.IDENTITY
    if initial_attitude is not None:
        start = initial_attitude
    elif known is not None and np.isfinite(known[0]).all():
        start = known[0]
    attitude = coning.integrate(increments, rule, start, edges=time)
    steps = time[: len(attitude) * rule.samples : rule.samples]
    remarks = [f"{len(increments)} samples over {steps[-1] - steps[0]:.6g} s with {rule.name}."]
    if left := len(increments) % rule.samples:
        remarks.append(f"Samples not used at the end, an incomplete step of {rule.samples}: {left}.")
    if known is not None:
        remarks.append(_error_words(known[:: rule.samples][: len(attitude)], attitude))
    if isinstance(source, Recording):
        if gaps := recordings.gaps(source.time):
            begin, length = max(gaps, key=lambda gap: gap[1])
            longest = f"the longest {length:.3g} s after {begin:.3f} s"
            remarks.append(f"Gaps between stamps: {len(gaps)}, {longest}: the rotation during a gap is interpolated.")
        remarks += [*source.remarks, source.left_out_words]
    return Estimate(
        time=steps,
        attitude=attitude,
        bias=np.broadcast_to(np.nan, (len(steps), 3)),
        variance=np.broadcast_to(np.nan, (len(steps), 6)),
        covariance=np.broadcast_to(np.nan, (len(steps), 6, 6)),
        origin=origin,
        remarks=tuple(filter(None, remarks)),
        details={"algorithm": rule.name},
    )


def _error_words(true: Array, attitude: Array) -> str:
    """Return a sentence on the errors of attitudes where the true ones (m, 4), of the first m of them, are known; empty if none is."""
    rows = are_finite(true)
    if not rows.any():
        return ""
    error = np.degrees(quaternion.angle_between(quaternion.normalize(true[rows]), attitude[: len(true)][rows]))
    return f"Error relative to the true attitude: final {error[-1]:.4g}°, maximum {error.max():.4g}°."
