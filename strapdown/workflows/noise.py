"""Noise of a sensor at rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from strapdown import allan, recordings
from strapdown.checks import InputError
from strapdown.recordings import Recording
from strapdown.records import ImuRecord

if TYPE_CHECKING:
    from strapdown.allan import AllanDeviation, NoiseFit
    from strapdown.recordings import GyroSamples


def _samples(
    source: Recording | ImuRecord | GyroSamples | ArrayLike, sample_interval: float | None, sensor: str, kind: str
) -> tuple[ArrayLike, float, str]:
    """Return samples (missing ones as NaN), sample interval and kind."""
    if isinstance(source, (Recording, ImuRecord)):
        source = recordings.samples_of(source, sensor, gaps=True)
    if isinstance(source, recordings.GyroSamples):
        if sample_interval is not None:
            raise InputError("sample_interval goes with an array; a recording has its own: leave it out")
        return source.values, source.sample_interval, source.kind
    if sample_interval is None:
        raise InputError("sample_interval is missing; for an array, give the time between its samples in s")
    return source, sample_interval, kind


def allan_deviation(
    source: Recording | ImuRecord | GyroSamples | ArrayLike,
    sample_interval: float | None = None,
    *,
    sensor: str = "gyro",
    kind: str = "rate",
    taus: ArrayLike | None = None,
    level: float = 0.95,
) -> AllanDeviation:
    """Return the Allan deviation of a sensor at rest, with its confidence band.

    Parameters
    ----------
    source : Recording, ImuRecord, GyroSamples or array_like (n,) or (n, axes)
        Missing samples are NaN (:func:`strapdown.allan.allan_deviation`).
    sample_interval : float, optional
        For an array: time between its samples, s.
    sensor : {"gyro", "accelerometer", "magnetometer"}
        For a recording: the sensor.
    kind : {"rate", "increments"}
        For an array: averages over each sample interval, or integrals.
    taus : array_like, optional
        Averaging times, s. Default: 12 per decade, up to a third of the record.
    level : float, default 0.95
        Confidence of the band.

    Returns
    -------
    AllanDeviation
        Deviation at each averaging time and axis, in the unit of the samples (increments: that unit per s), and its confidence band.

    Examples
    --------
    >>> import numpy as np
    >>> import strapdown as sd
    >>> white = np.random.default_rng(1).standard_normal(100_000)
    >>> found = sd.allan_deviation(white, 0.01, taus=[1.0])
    >>> round(float(found.deviation[0, 0]), 2)  # σ √(dt/τ)
    0.1
    """
    values, interval, what = _samples(source, sample_interval, sensor, kind)
    return allan.allan_deviation(values, interval, kind=what, taus=taus, level=level)


def fit_noise(
    source: Recording | ImuRecord | GyroSamples | ArrayLike,
    sample_interval: float | None = None,
    *,
    sensor: str = "gyro",
    kind: str = "rate",
    terms: Sequence[str] = allan.TERMS,
    highest_frequency: float | None = None,
    level: float = 0.95,
) -> NoiseFit:
    """Return the noise coefficients of a sensor at rest (angle random walk, bias instability, …), with confidence intervals.

    Parameters
    ----------
    source : Recording, ImuRecord, GyroSamples or array_like (n,) or (n, axes)
        Samples at rest; a recording may have gaps.
    sample_interval : float, optional
        For an array: time between its samples, s.
    sensor, kind : str
        As for :func:`allan_deviation`.
    terms : sequence of str
        Terms to fit, by default all (``strapdown.allan.TERMS``).
    highest_frequency : float, optional
        Maximum frequency of the spectrum that is used, Hz, to exclude a low-pass filter or a vibration.
    level : float, default 0.95
        Confidence of the intervals.

    Returns
    -------
    NoiseFit
        Coefficients and intervals; can be passed to :func:`estimate` as ``noise``.

    Examples
    --------
    >>> import strapdown as sd
    >>> noise = sd.fit_noise(sd.read("rest.csv", units={"gyro": "deg/s"}))  # doctest: +SKIP
    >>> estimate = sd.estimate(record, noise=noise)  # doctest: +SKIP
    """
    values, interval, what = _samples(source, sample_interval, sensor, kind)
    options: dict[str, Any] = {"terms": terms, "highest_frequency": highest_frequency, "level": level}
    return allan.fit_noise(values, interval, kind=what, sensor=sensor, **options)
