"""Estimation over a recording, with the estimate at every time stamp."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from strapdown import estimation, quaternion
from strapdown.ahrs import headings, regions
from strapdown.ahrs.parameters import AhrsParameters, error_states, of_motion
from strapdown.ahrs.preparing import Prepared, prepare
from strapdown.ahrs.starting import (
    LAST_ALIGNMENT,
    Rests,
    align,
    alignments,
    drift_by_rests,
    first_vector,
    for_whole,
    need_accelerometer,
    rests,
    samples_in_span,
    take_rate_at_rest,
    with_all_rests,
)
from strapdown.calibration import UnitCalibration, iron_sigma, with_gyro_states
from strapdown.checks import Array, lengths, median
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.schedule import joined
from strapdown.estimation.states import Change, changed
from strapdown.kernels import alignment, recording_steps
from strapdown.kernels.machine import compiled, read_only
from strapdown.recordings import Recording, sensor_delays, sensor_faults
from strapdown.recordings.sensor_delays import Delays
from strapdown.recordings.sensor_faults import Faults
from strapdown.records import ErrorStateEstimate, Estimate, ImuRecord, cut
from strapdown.units import DEGREE

FAR_START = 20.0 * DEGREE
"""Rotation by which the smoother corrects the attitude at the start, rad, above which it is linearised about the corrected one again."""
BIAS_MISFIT = 2.0
"""RMS over the axes of the smoothed bias at the start, relative to its σ before the recording, above which that σ was too small: a gyro
without factory calibration. It is multiplied by that ratio, and the smoother starts again."""
MAX_STARTS = 3
"""Maximum number of such starts."""
SMALL_TURN = 0.5 * DEGREE
"""σ of an uncertain rotation, rad, below which it is added to the attitude's with those that follow, and hardly shows in innovations."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AhrsEstimate:
    """An estimate with the samples that it was made from, row by row.

    Parameters
    ----------
    recording : Recording
        The recording, clipped gyro samples restored.
    estimate : Estimate
        Attitude and gyro bias at the stamps of the recording. The covariance follows what the innovations up to each stamp show
        (:mod:`strapdown.ahrs.regions`), the variance of the accelerometer's innovations the level of the acceleration; the covariance
        includes timing errors, constant iron and an error of the accelerometer, which the filter does not estimate.
    record : ImuRecord
        Input of the filter: increments and vectors averaged over its steps.
    initial : State
        Initial state of the filter.
    parameters : AhrsParameters
        Parameters of the filter.
    delays : Delays
        Delays of the sensors' samples, s, for which the estimate is corrected.
    faults : Faults
        Faults found in the samples, such as clipping and truncation, and the variance that they add.
    rests : Rests
        Spans at rest whose mean rates were used as measurements of the gyro's bias.
    hard_iron : ndarray (3,)
        Hard iron of the magnetometer at the end, body axes, in the unit of its samples.
    applied : UnitCalibration or None
        Calibration of the unit by which the samples were corrected.
    force_density : float
        Largest spectral density at low frequency of the accelerometer's innovations so far, relative to that of white ones.
    swell_density : float
        The same at the frequencies of waves, over a minute; 0 if not smoothed.
    """

    recording: Recording
    estimate: Estimate
    record: ImuRecord
    initial: estimation.State
    parameters: AhrsParameters
    delays: Delays
    faults: Faults
    rests: Rests
    hard_iron: Array
    applied: UnitCalibration | None
    force_density: float
    swell_density: float

    @property
    def calibration(self) -> UnitCalibration | None:
        """Calibration of the unit found from the recording, for its next recording; None if the filter has no states for it."""
        scale = self.estimate.error_states.get("gyro scale")
        if scale is None:
            return None
        return with_gyro_states(self.applied, scale, self.delays.last_field, self.recording.source)


def estimate(
    recording: Recording,
    parameters: AhrsParameters | None = None,
    *,
    latency: float | None = None,
    calibration: UnitCalibration | None = None,
    gate: Gate | None = None,
    robust: Robust | None = None,
    full_covariance: bool = False,
    smooth: bool = False,
) -> AhrsEstimate:
    """Return attitude and gyro bias at every time stamp of a recording.

    Parameters
    ----------
    recording : Recording
        Samples of a gyro, an accelerometer and optionally a magnetometer.
    parameters : AhrsParameters, optional
        The filter's model of the unit and of its motion. Default: that of a unit in the hand, with or without a magnetometer.
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
        Without ``smooth``, each row depends only on the samples up to its stamp; the faults of the samples (clipping, truncation, length
        of gaps) are found in the whole recording.

    Raises
    ------
    InputError
        If there is no accelerometer, a sensor has no valid sample, or the recording is too short.
    """
    need_accelerometer(recording)
    samples_in_span(recording)  # rejects a recording that is too short
    faults = sensor_faults.find(recording)
    samples = used = faults.recording
    if parameters is None:
        parameters = of_motion("hand", magnetometer=used.magnetic_field is not None, smooth=smooth)
    field_delay = None
    if calibration is not None:
        samples = used = calibration.applied(used)
        field_delay, parameters = calibration.magnetometer_delay or None, _of_unit(parameters, calibration, used)
    turned = sensor_delays.gyro_attitude(used)
    delays = sensor_delays.find(used, latency, field_delay, causal=not smooth, turned=turned)
    at_rest = rests(used, parameters)
    drift = None
    if smooth:
        parameters = for_whole(used, parameters, at_rest)
        if used.magnetic_field is None and len(at_rest.last) > 1:  # the filter's bias hardly drifts
            drift = drift_by_rests(at_rest, used.time)
            used = replace(used, rate=used.rate - drift)
            at_rest, turned = rests(used, parameters), sensor_delays.gyro_attitude(used)
    else:
        at_rest = Rests(*(column[np.isfinite(at_rest.gained)] for column in at_rest))
    prepared = prepare(
        used, parameters, delays.field, faults.turn_variance, causal=not smooth, turned=turned, at_rest=at_rest
    )
    if smooth:
        prepared = prepared._replace(initial=with_all_rests(prepared.initial, at_rest, used.time, parameters))
    options = _Options(gate, robust, smooth, full_covariance)
    filtered = _run(prepared, parameters, at_rest, options)
    interval = max(parameters.step, used.interval)
    density = regions.density(filtered, "accelerometer", interval, causal=not smooth)
    at_stamps = _at_stamps(filtered, density, used, prepared, parameters, delays, options)
    return AhrsEstimate(
        recording=samples,
        estimate=at_stamps if drift is None else replace(at_stamps, bias=at_stamps.bias + drift),
        applied=calibration,
        record=prepared.record,
        initial=prepared.initial,
        parameters=parameters,
        delays=delays,
        faults=faults,
        rests=at_rest,
        hard_iron=_iron_at_end(filtered, prepared),
        force_density=float(density.max()),
        swell_density=regions.swell_density(filtered, interval) if smooth else 0.0,
    )


def _of_unit(parameters: AhrsParameters, calibration: UnitCalibration, used: Recording) -> AhrsParameters:
    """Return the parameters with what the calibration leaves uncertain of the unit that made the recording."""
    if parameters.gyro_scale_sigma > 0.0 < calibration.gyro_scale_sigma:
        parameters = replace(parameters, gyro_scale_sigma=calibration.gyro_scale_sigma)
    if used.magnetic_field is not None and calibration.sigma.hard_iron.any():
        size = lengths(used.magnetic_field)
        sigma = iron_sigma(calibration, used) / median(size[np.isfinite(size)])
        parameters = replace(parameters, unshown_iron_sigma=min(sigma, parameters.unshown_iron_sigma))
    return parameters


def _iron_at_end(filtered: Estimate, prepared: Prepared) -> Array:
    """Return the hard iron at the end (3,), body axes, in the unit of the field: that subtracted and that of the filter's states."""
    if prepared.field is None:
        return np.zeros(3)
    iron = prepared.field.iron[-1]
    states = filtered.error_states.get("magnetometer disturbance")
    return np.asarray(iron if states is None else iron + states.values[-1] * prepared.field.usual[-1, 0])


class _Options(NamedTuple):
    """Options of a run."""

    gate: Gate | None
    robust: Robust | None
    smooth: bool
    full_covariance: bool


def _run(prepared: Prepared, parameters: AhrsParameters, at_rest: Rests, options: _Options) -> Estimate:
    """Return the filter's or the smoother's estimate at the steps.

    The record is run in parts. Before each uncertain rotation (:func:`uncertain_turns`) its variance is added to that of the attitude; the
    parts between are smoothed separately, because samples after an unknown rotation have little information about the attitude before it.
    The filter is aligned coarsely at the start and after large ones (:func:`_alignments`); the smoother starts again from its own result.
    The filter's bias is corrected after each span at rest; the smoother's initial state includes all of them.
    """
    record, own, smooth = prepared.record, parameters.setup, options.smooth
    blocks = error_states(parameters, *((series.sensor, series.kind) for series in record.vectors))
    added = uncertain_turns(prepared.turn_variance)
    rested = np.searchsorted(prepared.edge, [] if smooth else at_rest.last)
    aligned = {} if smooth else _alignments(prepared, added, parameters)

    def change(edge: int, x: Array, P: Array) -> None:
        for k in np.flatnonzero(rested == edge):
            take_rate_at_rest(x, P, at_rest.rate[k], float(at_rest.sigma[k]), float(at_rest.gained[k]))
        if edge in aligned:
            aligned[edge](x, P)
        P[[0, 1, 2], [0, 1, 2]] += added[edge]

    bounds = np.unique([0, *np.flatnonzero(added.any(axis=1)), *rested, *aligned, len(record.increments)]).tolist()
    state = changed(prepared.initial, functools.partial(change, 0))
    judged: dict[str, Any] = {"gate": options.gate, "robust": options.robust}
    if not smooth:
        spans = [estimation.Span(last, functools.partial(change, last)) for last in bounds[1:]]
        online = estimation.run_spans(record, own.process_noise, state, blocks, spans, **judged)
        # Gaps are among the faults of the recording: the rotation over them is uncertain by more than the event says.
        return replace(online, events=tuple(event for event in online.events if event.kind != "gap"))
    parts: list[Estimate] = []
    for first, last in itertools.pairwise(bounds):
        part = record if len(bounds) == 2 else cut(record, first, last)
        for _ in range(MAX_STARTS):
            smoothed = estimation.smooth(
                part, own.process_noise, state, blocks, full_covariance=True, error_state_covariance=False, **judged
            )
            restart = _restart(state, smoothed)
            if restart is None:
                break
            state = restart
        parts.append(smoothed)
        if last < bounds[-1]:
            _, state = estimation.run_part(part, own.process_noise, state, blocks, **judged)
            state = changed(state, functools.partial(change, last))
    return joined(parts)


def _restart(state: estimation.State, smoothed: Estimate) -> estimation.State | None:
    """Return the initial state from which to smooth again; None if the smoothed one is consistent with ``state``."""
    covariance = state.covariance.copy()
    change, P = smoothed.bias[0] - state.bias, covariance[3:6, 3:6]
    misfit = float(np.sqrt(change @ np.linalg.solve(P, change) / 3.0))
    if misfit > BIAS_MISFIT:
        covariance[3:6] *= misfit
        covariance[:, 3:6] *= misfit
    elif quaternion.angle_between(smoothed.attitude[0], state.attitude) < FAR_START:
        return None
    return replace(state, attitude=smoothed.attitude[0], covariance=covariance)


def _alignments(prepared: Prepared, added: Array, parameters: AhrsParameters) -> dict[int, Change]:
    """Return the changes of the state by coarse alignment, by edge of the steps: from the start on, and after large uncertain rotations."""
    time = prepared.record.time
    changes: dict[int, Change] = {}
    for first in [0, *(1 + np.flatnonzero(added.max(axis=1) > alignment.LARGE_TURN**2))]:
        rows = slice(first, int(np.searchsorted(time, time[first] + 2.0 * LAST_ALIGNMENT)))
        steps = alignment.Steps(*(column[rows] for column in prepared.steps))
        aligned = alignments(steps, prepared.interval, parameters, unknown=first > 0)
        for k in np.flatnonzero(aligned.variance > 0.0):
            field = aligned.field[k]
            if first and prepared.field is not None and field.any():
                field = field - prepared.field.iron[first - 1]
            changes[first + 1 + int(k)] = functools.partial(
                align,
                force=aligned.force[k],
                field=field,
                tilt=float(aligned.variance[k]),
                parameters=parameters,
                unknown=first > 0,
            )
    return changes


def uncertain_turns(variance: Array) -> Array:
    """Return the variance that is added to that of the attitude at each edge of the steps (k + 1, 3), from that of each step (k, 3), rad².

    It is added before the step, a smaller one than :data:`SMALL_TURN` squared with that of the next steps.
    """
    added = np.zeros((len(variance) + 1, 3))
    if not variance.any():
        return added
    total = np.cumsum(variance, axis=0)
    level = np.floor(total.max(axis=1, initial=0.0) / SMALL_TURN**2)
    due = np.flatnonzero(np.diff(level, prepend=0.0) > 0.0)
    added[due] = np.diff(total[due], axis=0, prepend=0.0)
    return added


def _at_stamps(
    filtered: Estimate,
    density: Array,
    used: Recording,
    prepared: Prepared,
    parameters: AhrsParameters,
    delays: Delays,
    options: _Options,
) -> Estimate:
    """Return the estimate at the recording's stamps: propagated by the gyro from the step before each stamp, and over the gyro's delay.

    ``density`` (k + 1,): that of the accelerometer's innovations (:func:`regions.density`).
    """
    edge, n = prepared.edge, len(used.time)
    attitude, bias, variance = (np.empty((n, width)) for width in (4, 3, 6))
    P = np.empty((n if options.full_covariance else 0, 36))
    ahead = -sensor_delays.turn_over(used, -delays.gyro) if options.smooth else used.rate * delays.gyro
    interval = max(parameters.step, used.interval)
    scales = regions.scales(filtered, density, parameters, causal=not options.smooth)
    uncertain = prepared.turn_variance.max(axis=1) > SMALL_TURN**2
    level = regions.acceleration_level(filtered, uncertain, interval)
    assert filtered.covariance is not None
    iron = np.zeros(len(edge))
    if prepared.field is not None:
        iron[1:] = prepared.field.variance
        force = first_vector(used.specific_force, prepared.turned, used.source, "accelerometer")
        field = first_vector(used.magnetic_field, prepared.turned, used.source, "magnetometer")
        iron[0] = headings.first_variance(force, field, parameters)
    turned = np.zeros(len(edge)) if options.smooth else uncertain_turns(prepared.turn_variance).max(axis=1)
    at_steps = (filtered.attitude, filtered.bias, filtered.variance, filtered.covariance, *scales, iron, turned)
    limits = regions.limits(parameters, delays.sigma, magnetometer=prepared.field is not None)
    compiled(recording_steps.carry_to_stamps)(
        recording_steps.Steps(edge, *map(read_only, at_steps)),
        recording_steps.Stamps(
            time=read_only(used.time),
            rate=read_only(used.rate),
            turned=read_only(prepared.turned),
            late=delays.gyro,
            ahead=read_only(ahead),
        ),
        limits,
        np.array([limits.tilt, limits.heading]),
        recording_steps.Carried(attitude, bias, variance, P),
    )
    row = functools.partial(np.repeat, np.arange(len(edge)), np.diff(edge, append=n))
    return Estimate(
        time=used.time,
        attitude=attitude,
        bias=bias,
        variance=variance,
        covariance=P.reshape(-1, 6, 6) if options.full_covariance else None,
        innovations=regions.scaled_innovations(filtered, level),
        skipped=prepared.skipped,
        smoothed=options.smooth,
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
