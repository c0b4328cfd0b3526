"""Estimation over a recording, with the estimate at every time stamp."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from strapdown import estimation
from strapdown.ahrs.parameters import HAND_HELD, AhrsParameters
from strapdown.ahrs.preparing import Prepared, prepare
from strapdown.ahrs.starting import Begun, begin
from strapdown.calibration import UnitCalibration, with_gyro_states
from strapdown.checks import Array
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.memory import side_by_side
from strapdown.estimation.schedule import joined
from strapdown.kernels import recording_steps
from strapdown.kernels.machine import compiled, read_only
from strapdown.recordings import Recording, sensor_delays
from strapdown.recordings.hard_iron import low_pass
from strapdown.recordings.sensor_delays import Delays
from strapdown.recordings.sensor_faults import Faults
from strapdown.records import ErrorStateEstimate, Estimate, ImuRecord, Innovations, cut
from strapdown.records.recording import sampled

LEVEL_TIME = 5.0
"""Time constant of the average that gives the level of the acceleration, s."""
OWN_SHARE = 0.1
"""Share of the modelled variance of the tilt or an innovation that comes from the sensor's errors, whatever the acceleration's level."""
ACCELERATION_SHARE = 0.7
"""Share of the tilt variance that is proportional to the root of that level, as the steady-state variance is to σ of the acceleration."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AhrsEstimate:
    """An estimate with the samples that it was made from, row by row.

    Parameters
    ----------
    recording : Recording
        The recording from its first quiet second on, clipped gyro samples restored.
    estimate : Estimate
        Attitude and gyro bias at the stamps of the recording. The covariance of the tilt and the variance of the accelerometer's
        innovations follow the level of the acceleration up to each stamp; the covariance includes timing errors and constant iron,
        which the filter does not estimate.
    record : ImuRecord
        Input of the filter: increments and vectors averaged over its steps.
    initial : State
        Initial state of the filter.
    parameters : AhrsParameters
        Parameters of the filter, with the velocity found from the recording.
    delays : Delays
        Delays of the sensors' samples, s, for which the estimate is corrected.
    faults : Faults
        Faults found in the samples, such as clipping and truncation, and the variance that they add.
    hard_iron : ndarray (3,)
        Hard iron subtracted from the magnetometer's samples at the end, body axes, in their unit; 0: none was found.
    calibration : UnitCalibration or None
        Calibration of the unit found from the recording, for its next recording; None if the filter has no states for it.
    """

    recording: Recording
    estimate: Estimate
    record: ImuRecord
    initial: estimation.State
    parameters: AhrsParameters
    delays: Delays
    faults: Faults
    hard_iron: Array
    calibration: UnitCalibration | None


def estimate(
    recording: Recording | Begun,
    parameters: AhrsParameters = HAND_HELD,
    *,
    latency: float | None = None,
    calibration: UnitCalibration | None = None,
    gate: Gate | None = None,
    robust: Robust | None = None,
    full_covariance: bool = False,
    smooth: bool = False,
) -> AhrsEstimate:
    """Return attitude and gyro bias at the time stamps of a recording, from its first quiet second on.

    Parameters
    ----------
    recording : Recording or Begun
        Samples of a gyro, an accelerometer and optionally a magnetometer. The result of :func:`strapdown.ahrs.begin` can be given
        instead, for example one that :func:`strapdown.ahrs.motions.chosen` has used.
    parameters : AhrsParameters
        The filter's model of the unit and of its motion.
    latency : float, optional
        Delay of the gyro's and the accelerometer's samples, s: the group delay of the sensors; 0: point samples at their stamps. By
        default each sample is treated as the mean over the interval before its stamp, so its delay is half the interval. The delay of
        the magnetometer relative to the gyro is found by :func:`strapdown.recordings.sensor_delays.magnetometer_delay`.
    calibration : UnitCalibration, optional
        Calibration of the unit (:func:`strapdown.calibrate`, or that of an earlier estimate), by which its samples are corrected.
    gate : Gate, optional
        Rejects measurements whose innovation is too large for its predicted covariance.
    robust : Robust, optional
        Reduces the weight of measurements with large innovations, separately for each sensor.
    full_covariance : bool
        Whether to keep whole covariance matrices too.
    smooth : bool
        Whether to use all samples, with the fixed-interval smoother, instead of those up to each stamp.

    Returns
    -------
    AhrsEstimate
        Without ``smooth``, each row depends only on the samples up to its stamp, except for the choice of the quiet second and, with
        ``velocity_from_record``, for the velocity: both are from the whole recording.

    Raises
    ------
    InputError
        If there is no accelerometer, a sensor has no valid sample in the quiet second, or the recording is too short.
    """
    _, quiet, faults = begin(recording)
    used = faults.recording
    field_delay = None
    if calibration is not None:
        used, field_delay = calibration.applied(used), calibration.magnetometer_delay or None
        if parameters.gyro_scale_sigma > 0.0 < calibration.gyro_scale_sigma:
            parameters = replace(parameters, gyro_scale_sigma=calibration.gyro_scale_sigma)
    turned = sensor_delays.gyro_attitude(used)
    delays = sensor_delays.find(used, latency, field_delay, causal=not smooth, turned=turned)
    prepared = prepare(used, quiet, parameters, delays.field, causal=not smooth, turned=turned)
    parameters = parameters.matched(prepared.acceleration)
    filtered = _run(prepared, parameters, faults.turn_variance, gate, robust, smooth)
    found = _at_stamps(filtered, used, prepared, parameters, delays, faults.turn_variance, smooth, full_covariance)
    scale = filtered.error_states.get("gyro scale")
    return AhrsEstimate(
        recording=used,
        estimate=found,
        calibration=None if scale is None else with_gyro_states(calibration, scale, delays.last_field, used.source),
        record=prepared.record,
        initial=prepared.initial,
        parameters=parameters,
        delays=delays,
        faults=faults,
        hard_iron=prepared.iron,
    )


def _run(
    prepared: Prepared,
    parameters: AhrsParameters,
    turn_variance: Array,
    gate: Gate | None,
    robust: Robust | None,
    smooth: bool,
) -> Estimate:
    """Return the filter's or the smoother's estimate at the steps.

    If the rotation over some sample intervals is uncertain (``turn_variance`` (n,), rad², is positive), the record is run in parts. The
    angle random walk of each part is that of the gyro plus that variance spread over the part. Each part is smoothed separately, because
    samples after an interval of unknown rotation have little information about the attitude before it.
    """
    record, own = prepared.record, parameters.setup
    kinds = {series.sensor: series.kind for series in record.vectors}
    blocks = () if own.states is None else own.states.blocks(kinds)
    extra = _over_steps(turn_variance, prepared.edge)
    change = np.flatnonzero(np.diff(extra > 0.0)) + 1
    bounds = [0, *change.tolist(), len(extra)]
    state = prepared.initial
    parts: list[Estimate] = []
    options: dict[str, Any] = {"full_covariance": True, "error_state_covariance": False, "gate": gate, "robust": robust}
    for first, last in itertools.pairwise(bounds):
        part = record if len(bounds) == 2 else cut(record, first, last)
        walk = parameters.angle_random_walk**2 + float(np.sum(extra[first:last])) / (part.time[-1] - part.time[0])
        noise = replace(own.process_noise, angle_random_walk=float(np.sqrt(walk)))
        end = state
        if not smooth or last < len(extra):
            found, end = estimation.run_part(part, noise, state, blocks, **options)
        if smooth:
            found = estimation.smooth(part, noise, state, blocks, **options)
        state = end
        parts.append(found)
    return joined(parts)


def _over_steps(variance: Array, edge: np.ndarray) -> Array:
    """Return the sum over each step (k,) of a variance of each sample interval (n − 1,)."""
    return np.asarray(np.add.reduceat(variance, edge[:-1].astype(np.intp)))


def _at_stamps(
    filtered: Estimate,
    used: Recording,
    prepared: Prepared,
    parameters: AhrsParameters,
    delays: Delays,
    turn_variance: Array,
    smooth: bool,
    full_covariance: bool,
) -> Estimate:
    """Return the estimate at the recording's stamps: propagated by the gyro from the step before each stamp, and over the gyro's delay."""
    edge, n = prepared.edge, len(used.time)
    attitude, bias, variance = side_by_side(*(((n, width), float) for width in (4, 3, 6)))
    (P,) = side_by_side(((n if full_covariance else 0, 6, 6), float))
    late = np.broadcast_to(delays.gyro, used.time.shape)
    ahead = -sensor_delays.turn_over(used, -late) if smooth else used.rate * late[:, None]
    level = _level(filtered, _over_steps(turn_variance, edge) > 0.0)
    tilt = np.sqrt(OWN_SHARE + ACCELERATION_SHARE * np.sqrt(level))
    assert filtered.covariance is not None
    iron = 0.0 if prepared.dip is None else (parameters.iron_sigma / np.cos(prepared.dip)) ** 2
    at_steps = (filtered.attitude, filtered.bias, filtered.variance, filtered.covariance, tilt)
    compiled(recording_steps.carry_to_stamps)(
        recording_steps.Steps(edge, *map(read_only, at_steps)),
        recording_steps.Stamps(*map(read_only, (used.time, used.rate, prepared.turned, late, ahead))),
        delays.sigma**2,
        iron,
        recording_steps.Carried(attitude, bias, variance, P),
    )
    row = functools.partial(np.repeat, np.arange(len(edge)), np.diff(edge, append=n))
    sensors = {"accelerometer": used.specific_force, "magnetometer": used.magnetic_field}
    return Estimate(
        time=used.time,
        attitude=attitude,
        bias=bias,
        variance=variance,
        covariance=P if full_covariance else None,
        innovations=_innovations(filtered, level),
        skipped={
            name: len(samples) - int(np.count_nonzero(sampled(samples)))
            for name, samples in sensors.items()
            if samples is not None
        },
        events=filtered.events,
        error_states=_OfRows(filtered.error_states, row),
    )


class _OfRows(Mapping[str, ErrorStateEstimate]):
    """Error states at the rows that ``row`` returns (n,), each gathered on access."""

    def __init__(self, states: Mapping[str, ErrorStateEstimate], row: Callable[[], np.ndarray]) -> None:
        self.states, self.row = states, row

    def __getitem__(self, name: str) -> ErrorStateEstimate:
        block, row = self.states[name], self.row()
        return replace(block, values=block.values.take(row, axis=0), variance=block.variance.take(row, axis=0))

    def __iter__(self) -> Iterator[str]:
        return iter(self.states)

    def __len__(self) -> int:
        return len(self.states)


def _level(filtered: Estimate, uncertain: np.ndarray) -> Array:
    """Return the level (k + 1,) of the acceleration up to each edge of the steps: its variance, relative to that modelled.

    The same model serves slow and fast motion, so most motion is slower than modelled. The level is set to 1 at the start, without a
    measurement, and in steps whose rotation is ``uncertain`` (k,).
    """
    seen = filtered.innovations["accelerometer"]
    nis = np.ones((len(filtered.time), 1))
    nis[np.searchsorted(filtered.time, seen.time), 0] = np.where(np.isfinite(seen.nis), seen.nis / 3.0, 1.0)
    step = float(np.median(np.diff(filtered.time))) / LEVEL_TIME
    begin = np.append(0, np.flatnonzero(uncertain) + 1)
    nis[begin] = 1.0
    return np.concatenate([low_pass(part, step) for part in np.split(nis, begin[1:])])[:, 0]


def _innovations(filtered: Estimate, level: Array) -> dict[str, Innovations]:
    """Return the innovations; the variance of the accelerometer's is scaled, as that of the tilt, by the level before each."""
    own = filtered.innovations["accelerometer"]
    before = level[np.searchsorted(filtered.time, own.time) - 1]
    share = OWN_SHARE + (1.0 - OWN_SHARE) * before
    return {**filtered.innovations, "accelerometer": replace(own, variance=own.variance * share[:, None])}
