"""Integration of the gyro alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import coning, quaternion, recordings
from strapdown.checks import Array, InputError, instance
from strapdown.recordings import Recording
from strapdown.records import ImuRecord
from strapdown.workflows.estimating import SOURCE


class AttitudeHistory(NamedTuple):
    """Attitude integrated from the gyro only."""

    time: Array
    """Edges of the algorithm's steps (k + 1,), s."""
    attitude: Array
    """q_fb (k + 1, 4)."""


def integrate(
    source: ImuRecord | Recording,
    algorithm: str | coning.Algorithm = "four-sample",
    *,
    initial_attitude: ArrayLike | None = None,
) -> AttitudeHistory:
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
    AttitudeHistory
        ``time`` (k + 1,), s, and ``attitude`` (k + 1, 4), q_fb, at the edges of the algorithm's steps; remaining samples are dropped.

    Examples
    --------
    >>> import strapdown as sd
    >>> found = sd.integrate(sd.simulate("coning"))  # doctest: +SKIP
    """
    rule = coning.named(algorithm)
    instance("source", source, (ImuRecord, Recording), SOURCE)
    if isinstance(source, ImuRecord):
        time, increments = source.time, source.increments
        known, place = None if source.truth is None else source.truth.attitude, "the record"
    else:
        place = source.source
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
    return AttitudeHistory(time[: len(attitude) * rule.samples : rule.samples], attitude)
