"""Initial state of the filter of a recording: attitude, gyro bias and their σ from the first quiet second."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown import coning, estimation, quaternion
from strapdown.ahrs.parameters import AhrsParameters
from strapdown.checks import Array, InputError, lengths
from strapdown.recordings import Recording, sensor_faults
from strapdown.recordings.sensor_faults import Faults
from strapdown.vectors import wahba

QUIET_SPAN = 1.0
"""Duration of the quiet span from which the filter is initialised, s."""


def need_accelerometer(recording: Recording) -> None:
    """Reject a recording without an accelerometer."""
    if recording.specific_force is None:
        raise InputError(
            f"{recording.source} has no accelerometer samples from {recording.time[0]:.3g} s on, which show the vertical; add columns "
            "ax, ay, az"
        )


class Begun(NamedTuple):
    """A recording with its first quiet second and its faults, which every use of it needs."""

    recording: Recording
    quiet: slice
    """Samples of the first quiet second, counted from its first sample."""
    faults: Faults
    """Faults of the samples from the quiet second on."""


def begin(recording: Recording | Begun) -> Begun:
    """Return the recording with its first quiet second and the faults from there on; a ``Begun`` is returned unchanged.

    Raises
    ------
    InputError
        If there is no accelerometer, or the recording is too short.
    """
    if isinstance(recording, Begun):
        return recording
    need_accelerometer(recording)
    span = quiet_span(recording)
    faults = sensor_faults.find(recording.since(span.start))
    need_accelerometer(faults.recording)  # it may have had samples before the quiet second alone
    return Begun(recording, slice(0, span.stop - span.start), faults)


def quiet_span(recording: Recording) -> slice:
    """Return the samples of the first quiet second: the first whose measure of motion is at most twice that of the quietest.

    Raises
    ------
    InputError
        If the recording is shorter than a second, or its first second holds one sample.
    """
    length = int(np.searchsorted(recording.time, recording.time[0] + QUIET_SPAN))
    lasts = recording.time[-1] - recording.time[0]
    if length >= len(recording.time):
        raise InputError(
            f"{recording.source} lasts {lasts:.3g} s; the start needs at least {QUIET_SPAN:g} s of samples (or give the unit of its time)"
        )
    if length < 2:
        raise InputError(
            f"{recording.source}: its first {QUIET_SPAN:g} s hold one sample, {lasts / (len(recording.time) - 1):.3g} s is the mean "
            "interval; if its stamps are in ms or us, say so (--time-unit, or units={'time': 'ms'})"
        )
    blocks = len(recording.time) // length
    axes = recording.rate[: blocks * length].T.copy().reshape(3, blocks, length)
    mean = axes.mean(axis=2)
    varying = axes - mean[:, :, None]
    # The mean is added to the spread so that a constant rate is not mistaken for rest; half weight, because it may be bias.
    restless = np.sqrt(np.einsum("abk,abk->b", varying, varying) / length) + 0.5 * lengths(mean.T)
    first = int(np.argmax(restless <= 2.0 * restless.min()))
    return slice(first * length, (first + 1) * length)


def start(
    recording: Recording,
    quiet: slice,
    parameters: AhrsParameters,
    iron: Array | float = 0.0,
    means: tuple[Array, float, Array | None] | None = None,
) -> estimation.State:
    """Return the state at the first of the quiet samples: attitude by TRIAD from the mean vertical and field, any heading without a field.

    The acceleration that remains in the frame fixed by the integrated gyro is added to σ. ``iron`` (3,) is the hard iron to be subtracted
    from the field, body axes. If ``rest_bias_sigma`` is positive, the bias is that of :func:`resting_bias`. ``means``: those of
    :func:`means_at_first`, if already computed.
    """
    force, spread, field = means_at_first(recording, quiet) if means is None else means
    # Without a magnetometer the heading is arbitrary: any horizontal direction will do.
    across = np.eye(3)[np.argmin(np.abs(force))] if field is None else field - iron
    bias, bias_sigma = np.zeros(3), parameters.bias_sigma
    if parameters.rest_bias_sigma > 0.0:
        bias, bias_sigma = resting_bias(recording, quiet, parameters)
    return estimation.initial_state(
        wahba.from_vertical_and_heading(force, across),
        bias=bias,
        attitude_sigma=float(np.hypot(parameters.attitude_sigma, spread / norm(force))),
        bias_sigma=bias_sigma,
    )


def means_at_first(recording: Recording, quiet: slice) -> tuple[Array, float, Array | None]:
    """Return means of the quiet samples in the body axes of the first, and reject a sensor without samples there.

    They are the specific force (3,), the norm of its standard deviation, and the field (3,), None without a magnetometer. The means are
    formed in the frame fixed by the integrated gyro.
    """
    turn = 0.5 * (recording.rate[quiet][1:] + recording.rate[quiet][:-1]) * np.diff(recording.time[quiet])[:, None]
    turned = coning.integrate(turn)

    def still(samples: Array) -> Array:
        known = np.isfinite(samples[quiet]).all(axis=1)
        return quaternion.rotate(turned[known], samples[quiet][known])

    assert recording.specific_force is not None
    force, field = still(recording.specific_force), recording.magnetic_field
    mean = _mean(force, recording.source, "accelerometer")
    across = None if field is None else _mean(still(field), recording.source, "magnetometer")
    return mean, norm(force.std(axis=0)), across


def resting_bias(recording: Recording, quiet: slice, parameters: AhrsParameters) -> tuple[Array, float]:
    """Return the gyro bias (3,), rad/s, and its σ: the mean rate of the quiet samples weighted with the prior, 0 with ``bias_sigma``.

    σ of the mean rate is the root sum of squares of ``rest_bias_sigma`` and the spread of the rate between tenths of the samples, which is
    motion of the hand. If the mean rate exceeds 3 σ of the prior and the vertical and the field rotate with it, it is added to σ as motion.
    """
    rate, prior = recording.rate[quiet], parameters.bias_sigma
    mean = rate.mean(axis=0)
    tenths = np.array([part.mean(axis=0) for part in np.array_split(rate, min(10, len(rate)))])
    sigma = float(np.hypot(parameters.rest_bias_sigma, norm(tenths.std(axis=0))))
    if norm(mean) > 3.0 * prior and _turns(recording, quiet, mean):
        sigma = float(np.hypot(sigma, norm(mean)))
    share = prior**2 / (prior**2 + sigma**2)
    return share * mean, float(np.sqrt(share)) * sigma


def _turns(recording: Recording, quiet: slice, rate: Array) -> bool:
    """Return whether vertical and field rotate at more than half this rate from the first half of the samples to the second."""
    expected, seen = [], []
    for samples in (recording.specific_force, recording.magnetic_field):
        known = np.empty((0, 3)) if samples is None else samples[quiet][np.isfinite(samples[quiet]).all(axis=1)]
        if len(known) > 1:
            first, second = (half.mean(axis=0) / norm(known.mean(axis=0)) for half in np.array_split(known, 2))
            seen.append(second - first)
            expected.append(-0.5 * QUIET_SPAN * np.cross(rate, 0.5 * (first + second)))
    e, s = np.ravel(expected), np.ravel(seen)
    return bool(s @ e > 0.5 * (e @ e))


def _mean(samples: Array, source: str, sensor: str) -> Array:
    """Return the mean of samples (k, 3) of the quiet second, which must not be zero."""
    if len(samples) == 0:
        raise InputError(
            f"{source}: the {sensor} has no valid sample in the first quiet second; cut the recording to a part where it has"
        )
    mean = np.asarray(samples.mean(axis=0))
    if norm(mean) == 0.0:
        raise InputError(
            f"{source}: the {sensor} is zero over the first quiet second and gives no direction; cut the recording to a part where it does"
        )
    return mean


def norm(vector: Array) -> float:
    """Return the length of a vector."""
    return float(np.linalg.norm(vector))
