"""The filter over a recording, and its estimate at every stamp."""

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
from strapdown.checks import Array
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.memory import side_by_side
from strapdown.estimation.schedule import joined
from strapdown.kernels import recording_steps
from strapdown.kernels.machine import compiled, read_only
from strapdown.recordings import Recording, sensor_delays, unit_calibration
from strapdown.recordings.hard_iron import low_pass
from strapdown.recordings.sensor_delays import Delays
from strapdown.recordings.sensor_faults import Faults
from strapdown.recordings.unit_calibration import UnitCalibration
from strapdown.records import ErrorStateEstimate, Estimate, ImuRecord, Innovations, cut
from strapdown.records.recording import sampled

LEVEL_TIME = 5.0
"""Time constant over which the level of the acceleration is found, s."""
OWN_SHARE = 0.1
"""Share of the modelled variance, of the tilt or an innovation, that does not follow the acceleration's level: the sensor's own errors."""
ACCELERATION_SHARE = 0.7
"""Share of the tilt's that follows the root of that level: the steady-state variance goes as the σ of the acceleration."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AhrsEstimate:
    """An estimate beside the samples that it was made from, one row for one row.

    Parameters
    ----------
    recording : Recording
        The recording from its first quiet second on, clipped gyro samples restored.
    estimate : Estimate
        Attitude and gyro bias at the stamps of the recording; the covariance of the tilt and the variance of the
        accelerometer's innovations follow the acceleration's level so far, and the former includes timing and constant
        iron, which the filter does not estimate.
    record : ImuRecord
        What the filter processed: increments and vectors averaged over its steps.
    initial : State
        Where the filter started.
    parameters : AhrsParameters
        The filter's model, with the velocity that the recording shows.
    delays : Delays
        Delays of the sensors' samples, s, for which the estimate is corrected.
    faults : Faults
        Faults found in the samples, such as clipping and truncation, and the variance that they add.
    hard_iron : ndarray (3,)
        Hard iron subtracted from the magnetometer's samples at the end, body axes, in their unit; 0: none was found.
    calibration : UnitCalibration or None
        What the recording shows of the unit, for its next recording; None where the filter has no states for it.
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
    """Return attitude and gyro bias over a recording, at its time stamps from the first quiet second on.

    Parameters
    ----------
    recording : Recording or Begun
        Samples of gyro, accelerometer and, if there is one, magnetometer; as :func:`strapdown.ahrs.begin` returns it, where
        :func:`strapdown.ahrs.motions.chosen` needs that too.
    parameters : AhrsParameters
        The filter's model of the unit and of its motion.
    latency : float, optional
        Delay of the gyro's and the accelerometer's samples, s: the group delay of the sensors; 0: point samples at their stamps. By
        default each sample is taken for the mean over the interval before its stamp, half of which is its delay. That of the
        magnetometer beside the gyro is found by :func:`strapdown.recordings.sensor_delays.magnetometer_delay`.
    calibration : UnitCalibration, optional
        What an earlier recording of the same unit showed: scale and misalignment of its gyro, the magnetometer's delay.
    gate : Gate, optional
        Refuse measurements that the filter's model does not explain.
    robust : Robust, optional
        Weigh measurements by how far they lie off, each sensor by itself.
    full_covariance : bool
        Keep whole covariance matrices too.
    smooth : bool
        From all samples, by the fixed-interval smoother, instead of those up to each stamp.

    Returns
    -------
    AhrsEstimate
        Without ``smooth`` each row depends on the samples up to its stamp alone, but for the choice of the quiet second and, with
        ``velocity_from_record``, of the velocity: both are from the whole recording.

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
        if parameters.gyro_scale_sigma > 0.0:
            parameters = replace(parameters, gyro_scale_sigma=calibration.sigma)
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
        calibration=None
        if scale is None
        else (calibration or unit_calibration.NONE).and_then(scale, delays.last_field, used.source),
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

    Where the gyro does not show how the unit turned, the record is run in parts, each with an angle random walk of its own: that of the
    gyro, or as much more as makes up ``turn_variance`` (n,), rad², of the sample intervals. Each part is smoothed by itself, for samples
    after such a part say little about what was before it.
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
    """Return the estimate at the recording's stamps: carried on by the gyro from the step before each, and over the delay of the gyro."""
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
    """Error states at the rows that ``row`` returns (n,), each gathered when it is asked for."""

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
    """Return the level (k + 1,) of the acceleration so far at the edges of the steps: its variance, as a share of that modelled.

    One model holds for slow and fast motion, so most motion is slower than modelled. Without a measurement, and at first and in steps
    whose turn is ``uncertain`` (k,), the level is taken for that modelled.
    """
    seen = filtered.innovations["accelerometer"]
    nis = np.ones((len(filtered.time), 1))
    nis[np.searchsorted(filtered.time, seen.time), 0] = np.where(np.isfinite(seen.nis), seen.nis / 3.0, 1.0)
    step = float(np.median(np.diff(filtered.time))) / LEVEL_TIME
    begin = np.append(0, np.flatnonzero(uncertain) + 1)
    nis[begin] = 1.0
    return np.concatenate([low_pass(part, step) for part in np.split(nis, begin[1:])])[:, 0]


def _innovations(filtered: Estimate, level: Array) -> dict[str, Innovations]:
    """Return the innovations, the variance of the accelerometer's by the level before each, as that of the tilt."""
    own = filtered.innovations["accelerometer"]
    before = level[np.searchsorted(filtered.time, own.time) - 1]
    share = OWN_SHARE + (1.0 - OWN_SHARE) * before
    return {**filtered.innovations, "accelerometer": replace(own, variance=own.variance * share[:, None])}
