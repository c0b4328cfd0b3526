"""Attitude and heading from a recording: accelerometer as the vertical, magnetometer as the heading only, one filter for both.

The fixed frame is East-North-Up with magnetic North. This module models the sensors (:class:`AhrsParameters`, :data:`MOTIONS`),
averages their samples over filter steps, starts the filter (:mod:`strapdown.estimation`) and carries its estimate to every stamp.

The disturbances of both vectors last much longer than a sample, so little is lost by updating less often than the sensors sample: the
samples of a step are turned by the gyro into one frame and averaged there. What disturbs the heading, iron in the unit and in the
surroundings, shows in the strength and the dip of the field too. The heading's noise follows their deviation, and is the larger the
steeper the field.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from strapdown import coning, estimation, quaternion, sensor_delays, sensor_faults, unit_calibration, wahba
from strapdown.checks import Array, InputError, non_negative, positive
from strapdown.estimation.gating import Gate, Robust
from strapdown.kernels import recording_steps
from strapdown.kernels.machine import compiled
from strapdown.recordings import Recording, increments
from strapdown.records import ErrorStateEstimate, Estimate, ImuRecord, Innovations, cut
from strapdown.sensor_delays import Delays
from strapdown.sensor_faults import Faults
from strapdown.setup import FilterSetup
from strapdown.setup.states import SensorStates, States
from strapdown.unit_calibration import UnitCalibration
from strapdown.units import DEGREE
from strapdown.vectors import VectorMeasurements

__all__ = [
    "MOTIONS",
    "AhrsEstimate",
    "AhrsParameters",
    "estimate",
]

UP = np.array([0.0, 0.0, 1.0])
NORTH = np.array([0.0, 1.0, 0.0])
QUIET_SPAN = 1.0
"""Length of the quiet span that the filter starts from, s."""
VERTICAL_TIME = 1.0
"""Time constant of the low-pass that gives the vertical beside which the field's dip is judged, s."""


@dataclass(frozen=True, kw_only=True)
class AhrsParameters:
    """The filter's model of a unit and of what moves it. The defaults hold for consumer and industrial MEMS units under any motion.

    Noises of the vectors are densities: σ of a mean over one second, whatever the recording's rate. They are much larger than the sensors'
    own noise, because what disturbs them lasts over many samples. With ``velocity_sigma`` the acceleration has states
    (:class:`strapdown.error_states.BoundedVelocity`), and ``specific_force_noise`` is what is left beside it.
    """

    angle_random_walk: float = 3e-3
    """σ_v, rad/√s; scale-factor and alignment errors of a moving unit included."""
    rate_random_walk: float = 1e-5
    """σ_u, rad/s/√s."""
    specific_force_noise: float = 0.6
    """Acceleration without states, each component, m/s²/√Hz."""
    field_disturbance: float = 0.05
    """Disturbance of a field that is as strong and as steep as at the start, across it, share of its strength/√Hz over its level part's:
    the heading's noise density is this over the cosine of the dip."""
    field_deviation: float = 0.025
    """Deviation of the field's strength (share) and dip (rad), as a root sum of squares, that doubles the variance of that noise."""
    field_memory: float = 0.5
    """Time constant over which that deviation is averaged, s: a disturbance does not end where the field happens to look right."""
    iron_sigma: float = 0.02
    """Constant disturbance of the field that nothing shows, share of its strength: part of the σ reported, and not estimated."""
    step: float = 0.03
    """Interval of the filter's steps, s."""
    heading_interval: float = 0.15
    """Interval of the heading measurements, s."""
    attitude_sigma: float = 3.0 * DEGREE
    """Error of the attitude at the start, each axis, rad."""
    bias_sigma: float = 0.5 * DEGREE
    """Gyro bias at the start, each axis, rad/s."""
    rest_bias_sigma: float = 0.0
    """Error of the mean rate of the quiet second as an estimate of the bias, each axis, rad/s; 0: the bias starts at zero."""
    velocity_sigma: float = 0.0
    """Velocity of the unit, each component, m/s; 0: no states, all its acceleration is white."""
    velocity_time: float = 0.3
    """Correlation time of that velocity, s."""
    acceleration_time: float = 0.1
    """Correlation time of the acceleration, s."""
    gyro_scale_sigma: float = 0.0
    """Each of the gyro's scale factors (1) and misalignments (rad); 0: no states."""

    def __post_init__(self) -> None:
        """Check every field."""
        may_be_zero = ("iron_sigma", "rate_random_walk", "rest_bias_sigma", "velocity_sigma", "gyro_scale_sigma")
        for name in self.__dataclass_fields__:
            check = non_negative if name in may_be_zero else positive
            check(name, getattr(self, name))

    @property
    def setup(self) -> FilterSetup:
        """The filter of this model."""
        sensors = {}
        if self.velocity_sigma > 0.0:
            sensors["accelerometer"] = SensorStates(
                velocity_sigma=self.velocity_sigma,
                velocity_time=self.velocity_time,
                acceleration_time=self.acceleration_time,
            )
        states = States(
            gyro_scale_sigma=self.gyro_scale_sigma,
            gyro_misalignment_sigma=self.gyro_scale_sigma,
            sensors=sensors,
        )
        return FilterSetup(
            process_noise=estimation.ProcessNoise(
                angle_random_walk=self.angle_random_walk, rate_random_walk=self.rate_random_walk
            ),
            attitude_sigma=self.attitude_sigma,
            bias_sigma=self.bias_sigma,
            states=states if states.names else None,
        )


HAND_HELD = AhrsParameters(
    specific_force_noise=0.06,
    rest_bias_sigma=0.05 * DEGREE,
    velocity_sigma=1.0,
    gyro_scale_sigma=2e-3,
)
"""A unit in the hand: its velocity is bounded, and of its gyro, whose turns are large, scale factors and misalignments are states."""
MOTIONS = {"hand": HAND_HELD, "any": AhrsParameters()}
"""The model by what moves the unit."""


def quiet_span(recording: Recording) -> slice:
    """Return the samples of the first quiet second: the first whose rate is no more than twice as restless as in the quietest.

    Raises
    ------
    InputError
        If the recording is shorter than that.
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
    rate = recording.rate[: blocks * length].reshape(blocks, length, 3)
    # The mean counts beside the spread, so that a steady turn is not taken for rest; half of it may be bias.
    restless = np.linalg.norm(rate.std(axis=1), axis=1) + 0.5 * np.linalg.norm(rate.mean(axis=1), axis=1)
    first = int(np.argmax(restless <= 2.0 * restless.min()))
    return slice(first * length, (first + 1) * length)


class Prepared(NamedTuple):
    """A recording as the filter takes it."""

    record: ImuRecord
    """Increments and vectors at the filter's steps."""
    initial: estimation.State
    edge: np.ndarray
    """Sample at which each step ends, the first at the start (k + 1,)."""
    turned: Array
    """Attitude by the gyro alone at every sample, from the identity at the first one (n, 4)."""
    dip: float | None
    """Angle of the field below the level at the start, rad; None without a magnetometer."""


def prepare(
    recording: Recording, quiet: slice, parameters: AhrsParameters, field_delay: Array | float = 0.0
) -> Prepared:
    """Return the record that the filter runs on, and its start.

    Parameters
    ----------
    recording : Recording
        From its first quiet second on.
    quiet : slice
        The samples of that second, over which gravity and the field are those of the start.
    parameters : AhrsParameters
    field_delay : float or array_like, (n,)
        Delay of the magnetometer's samples beside the gyro's, s: each is turned forward by the gyro.
    """
    initial = start(recording, quiet, parameters)  # first, for it refuses a sensor without samples
    turned = coning.integrate(increments(recording), coning.ALGORITHMS["one-sample"])
    edge = _edges(recording.time, parameters.step)
    time = recording.time[edge]
    at_edge = turned[edge]
    interval = float(np.median(np.diff(recording.time)))
    assert recording.specific_force is not None
    force, number = _averages(recording.specific_force, turned, edge)
    gravity = _norm(_mean_at_first(recording, recording.specific_force, quiet, "accelerometer")[0])
    vectors = [
        VectorMeasurements(
            sensor="accelerometer",
            kind="vector",
            time=time[1:][number > 0],
            vector_b=quaternion.rotate(quaternion.conjugate(at_edge[1:]), force)[number > 0],
            reference_f=gravity * UP,
            sigma=parameters.specific_force_noise / np.sqrt(number[number > 0] * interval),
        )
    ]
    dip = None
    if recording.magnetic_field is not None:
        back = quaternion.exp(-sensor_delays.turn_over(recording, field_delay)) if np.any(field_delay) else None
        frame = turned if back is None else quaternion.multiply(turned, back)
        field, number = _averages(recording.magnetic_field, frame, edge)
        heading, dip = _headings(field, number * interval, force, at_edge, time, quiet.stop <= edge[1:], parameters)
        vectors.append(heading)
    turn = quaternion.log(quaternion.multiply(quaternion.conjugate(at_edge[:-1]), at_edge[1:]))
    record = ImuRecord(time=time, increments=turn, vectors=tuple(vectors))
    return Prepared(record, initial, edge, turned, dip)


def _edges(time: Array, step: float) -> np.ndarray:
    """Return the samples at which steps end (k + 1,): the first, the last before each multiple of ``step``, s, and the last of all."""
    bins = np.floor((time - time[0]) / step + 1e-6)
    return np.unique(np.concatenate([[0], np.flatnonzero(np.diff(bins)), [len(time) - 1]]))


def _averages(samples: Array, frame: Array, edge: Array) -> tuple[Array, Array]:
    """Return the mean of each step's samples in the axes that ``frame`` (n, 4) turns them to (k, 3), and their number; 0 where none."""
    total, number = np.empty((len(edge) - 1, 3)), np.empty(len(edge) - 1)
    compiled(recording_steps.average_samples)(samples, frame, edge, total, number)
    return total / np.maximum(number, 1.0)[:, None], number


def _headings(
    field: Array,
    length: Array,
    force: Array,
    at_edge: Array,
    time: Array,
    later: np.ndarray,
    parameters: AhrsParameters,
) -> tuple[VectorMeasurements, float]:
    """Return the heading measurements from a field and specific force averaged in one frame (k, 3), and the dip at the start.

    ``length`` (k,) is the time that the field's samples of each step stand for, s, and ``later`` are the steps after the quiet second.
    """
    known = length > 0.0
    strength = np.linalg.norm(field, axis=1)
    strength[~known] = 1.0
    interval = float(np.median(np.diff(time)))
    vertical = _low_pass(
        _low_pass(_held(force, np.asarray(force.any(axis=1))), interval / VERTICAL_TIME), interval / VERTICAL_TIME
    )
    vertical /= np.linalg.norm(vertical, axis=1, keepdims=True)
    dip = np.arcsin(np.clip(-np.sum(field * vertical, axis=1) / strength, -1.0, 1.0))
    first = known & ~later if np.any(known & ~later) else known
    dip_0, strength_0 = float(np.mean(dip[first])), float(np.mean(strength[first]))
    deviation = _held(((strength / strength_0 - 1.0) ** 2 + (dip - dip_0) ** 2)[:, None], known)
    deviation = _low_pass(deviation, interval / parameters.field_memory)[:, 0]
    noise = (parameters.field_disturbance / np.cos(dip_0)) ** 2 * (1.0 + deviation / parameters.field_deviation**2)
    # Steps are gathered over the heading interval, each with its own weight.
    information = length / noise
    edge = np.flatnonzero(np.diff(np.floor((time[1:] - time[0]) / parameters.heading_interval - 1e-6), append=np.inf))
    begin = np.append(0, edge[:-1] + 1)
    total = np.add.reduceat(
        np.where(known[:, None], field / strength[:, None], 0.0) * information[:, None], begin, axis=0
    )
    information = np.add.reduceat(information, begin)
    seen = information > 0.0
    total[seen] /= np.linalg.norm(total[seen], axis=1, keepdims=True)
    return VectorMeasurements(
        sensor="magnetometer",
        kind="heading",
        time=time[1:][edge][seen],
        vector_b=quaternion.rotate(quaternion.conjugate(at_edge[1:][edge][seen]), total[seen]),
        reference_f=NORTH,
        sigma=1.0 / np.sqrt(information[seen]),
    ), dip_0


def _held(values: Array, known: np.ndarray) -> Array:
    """Return rows (k, …) with each that is not known replaced by the last before it that is, or the first of all."""
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.asarray(values[np.where(last < 0, int(np.argmax(known)), last)])


def _low_pass(values: Array, step: float) -> Array:
    """Return rows (k, m) after a first-order low-pass from the first one on, ``step`` being the interval over the time constant; causal."""
    result = np.empty_like(values)
    compiled(recording_steps.low_pass)(values, -np.expm1(-step), result)
    return result


def start(recording: Recording, quiet: slice, parameters: AhrsParameters) -> estimation.State:
    """Return the state at the first of the quiet samples: attitude by TRIAD from the mean vertical and field, any North without a field.

    The means are taken in the frame that the gyro keeps over those samples, and σ grows with the acceleration that is left there. With
    ``rest_bias_sigma`` the bias is that of :func:`resting_bias`.
    """
    assert recording.specific_force is not None
    force, spread = _mean_at_first(recording, recording.specific_force, quiet, "accelerometer")
    if recording.magnetic_field is None:
        # Any horizontal direction will do for a heading that nothing measures.
        across = np.eye(3)[np.argmin(np.abs(force))]
    else:
        across, _ = _mean_at_first(recording, recording.magnetic_field, quiet, "magnetometer")
    bias, bias_sigma = np.zeros(3), parameters.bias_sigma
    if parameters.rest_bias_sigma > 0.0:
        bias, bias_sigma = resting_bias(recording, quiet, parameters)
    return estimation.initial_state(
        wahba.from_vertical_and_heading(force, across),
        bias=bias,
        attitude_sigma=float(np.hypot(parameters.attitude_sigma, spread / _norm(force))),
        bias_sigma=bias_sigma,
    )


def _mean_at_first(recording: Recording, samples: Array, quiet: slice, sensor: str) -> tuple[Array, float]:
    """Return the mean of the quiet samples in the body axes of their first (3,), and how far they spread about it."""
    turn = 0.5 * (recording.rate[quiet][1:] + recording.rate[quiet][:-1]) * np.diff(recording.time[quiet])[:, None]
    own = samples[quiet]
    known = np.isfinite(own).all(axis=1)
    still = quaternion.rotate(coning.integrate(turn)[known], own[known])
    mean = _mean(still, recording.source, sensor)
    return mean, _norm(still.std(axis=0))


def resting_bias(recording: Recording, quiet: slice, parameters: AhrsParameters) -> tuple[Array, float]:
    """Return the gyro bias (3,), rad/s, at quiet samples, and its σ: the mean rate weighed with the prior, zero and ``bias_sigma``.

    The mean rate is the bias to within ``rest_bias_sigma`` and what the rate still changes from tenth to tenth of the samples, the hand's
    turning. Where it is beyond any bias that the prior expects, and the vertical and the field turn as it says, it is a turn and no bias.
    """
    rate, prior = recording.rate[quiet], parameters.bias_sigma
    mean = rate.mean(axis=0)
    tenths = np.array([part.mean(axis=0) for part in np.array_split(rate, min(10, len(rate)))])
    sigma = float(np.hypot(parameters.rest_bias_sigma, _norm(tenths.std(axis=0))))
    if _norm(mean) > 3.0 * prior and _turns(recording, quiet, mean):
        sigma = float(np.hypot(sigma, _norm(mean)))
    share = prior**2 / (prior**2 + sigma**2)
    return share * mean, float(np.sqrt(share)) * sigma


def _turns(recording: Recording, quiet: slice, rate: Array) -> bool:
    """Return whether vertical and field turn at more than half this rate from the first half of the samples to the second."""
    expected, seen = [], []
    for samples in (recording.specific_force, recording.magnetic_field):
        known = np.empty((0, 3)) if samples is None else samples[quiet][np.isfinite(samples[quiet]).all(axis=1)]
        if len(known) > 1:
            first, second = (half.mean(axis=0) / _norm(known.mean(axis=0)) for half in np.array_split(known, 2))
            seen.append(second - first)
            expected.append(-0.5 * QUIET_SPAN * np.cross(rate, 0.5 * (first + second)))
    e, s = np.ravel(expected), np.ravel(seen)
    return bool(s @ e > 0.5 * (e @ e))


@dataclass(frozen=True, kw_only=True, eq=False)
class AhrsEstimate:
    """An estimate beside the samples that it was made from, one row for one row."""

    recording: Recording
    """The recording from its first quiet second on, clipped gyro samples restored."""
    estimate: Estimate
    """At the stamps of the recording; the covariance includes timing and constant iron, which the filter does not estimate."""
    record: ImuRecord
    """What the filter ran on: increments and vectors averaged over its steps."""
    initial: estimation.State
    """Where the filter started."""
    delays: Delays
    """Delays of the sensors that are made good."""
    faults: Faults
    """What of the samples is not what the unit did."""
    calibration: UnitCalibration | None
    """What the recording shows of the unit, for its next recording; None where the filter has no states for it."""


def estimate(
    recording: Recording,
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
    recording : Recording
    parameters : AhrsParameters
    latency : float, optional
        Delay of the gyro's and the accelerometer's samples, s: the group delay of the sensors; 0: point samples at their stamps. By
        default each sample is taken for the mean over the interval before its stamp, half of which is its delay. That of the
        magnetometer beside the gyro is found by :func:`strapdown.sensor_delays.magnetometer_delay`.
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
        Without ``smooth`` each row depends on the samples up to its stamp alone; only the choice of the quiet second does not.

    Raises
    ------
    InputError
        If there is no accelerometer, a sensor has no valid sample in the quiet second, or the recording is too short.
    """
    if recording.specific_force is None:
        raise InputError(f"{recording.source} has no accelerometer, which shows the vertical; add columns ax, ay, az")
    span = quiet_span(recording)
    faults = sensor_faults.find(recording.since(span.start))
    used = faults.recording
    field_delay = None
    if calibration is not None:
        used, field_delay = calibration.applied(used), calibration.magnetometer_delay or None
        if parameters.gyro_scale_sigma > 0.0:
            parameters = replace(parameters, gyro_scale_sigma=calibration.sigma)
    quiet = slice(0, span.stop - span.start)
    delays = sensor_delays.find(used, latency, field_delay, causal=not smooth)
    prepared = prepare(used, quiet, parameters, delays.field)
    filtered = _run(prepared, parameters, faults.turn_variance, gate, robust, smooth)
    found = _at_stamps(filtered, used, prepared, parameters, delays, smooth, full_covariance)
    scale = found.error_states.get("gyro scale")
    return AhrsEstimate(
        recording=used,
        estimate=found,
        calibration=None
        if scale is None
        else (calibration or unit_calibration.NONE).and_then(scale, delays.last_field, used.source),
        record=prepared.record,
        initial=prepared.initial,
        delays=delays,
        faults=faults,
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
    extra = np.add.reduceat(turn_variance, prepared.edge[:-1].astype(np.intp))
    change = np.flatnonzero(np.diff(extra > 0.0)) + 1
    bounds = [0, *change.tolist(), len(extra)]
    state = prepared.initial
    parts: list[Estimate] = []
    for first, last in itertools.pairwise(bounds):
        part = record if len(bounds) == 2 else cut(record, first, last)
        walk = parameters.angle_random_walk**2 + float(np.sum(extra[first:last])) / (part.time[-1] - part.time[0])
        noise = replace(own.process_noise, angle_random_walk=float(np.sqrt(walk)))
        end = state
        if not smooth or last < len(extra):
            found, end = estimation.run_part(part, noise, state, blocks, full_covariance=True, gate=gate, robust=robust)
        if smooth:
            found = estimation.smooth(part, noise, state, blocks, full_covariance=True, gate=gate, robust=robust)
        state = end
        parts.append(found)
    return _joined(parts)


def _joined(parts: list[Estimate]) -> Estimate:
    """Return the estimates of successive parts as one; at an edge between two stands the first part's."""
    if len(parts) == 1:
        return parts[0]

    def rows(name: str) -> Array:
        return np.concatenate([getattr(part, name)[k > 0 :] for k, part in enumerate(parts)])

    innovations = {}
    for sensor in dict.fromkeys(name for part in parts for name in part.innovations):
        own = [part.innovations[sensor] for part in parts if sensor in part.innovations]
        weights = [one.weight for one in own if one.weight is not None]
        innovations[sensor] = Innovations(
            time=np.concatenate([one.time for one in own]),
            innovation=np.concatenate([one.innovation for one in own]),
            variance=np.concatenate([one.variance for one in own]),
            weight=np.concatenate(weights) if len(weights) == len(own) else None,
        )
    blocks = {
        name: replace(
            block,
            values=np.concatenate([part.error_states[name].values[k > 0 :] for k, part in enumerate(parts)]),
            variance=np.concatenate([part.error_states[name].variance[k > 0 :] for k, part in enumerate(parts)]),
        )
        for name, block in parts[0].error_states.items()
    }
    return Estimate(
        time=rows("time"),
        attitude=rows("attitude"),
        bias=rows("bias"),
        variance=rows("variance"),
        covariance=rows("covariance"),
        innovations=innovations,
        events=tuple(event for part in parts for event in part.events),
        error_states=blocks,
    )


def _at_stamps(
    filtered: Estimate,
    used: Recording,
    prepared: Prepared,
    parameters: AhrsParameters,
    delays: Delays,
    smooth: bool,
    full_covariance: bool,
) -> Estimate:
    """Return the estimate at the recording's stamps: carried on by the gyro from the step before each, and over the delay of the gyro."""
    edge, turned = prepared.edge, prepared.turned
    row = np.searchsorted(edge, np.arange(len(used.time)), side="right") - 1
    bias = filtered.bias[row]
    late = np.broadcast_to(delays.gyro, used.time.shape)
    ahead = -sensor_delays.turn_over(used, -late) if smooth else used.rate * late[:, None]
    ahead = ahead - bias * (used.time - used.time[edge][row] + late)[:, None]
    step = quaternion.multiply(filtered.attitude, quaternion.conjugate(turned[edge]))
    assert filtered.covariance is not None
    R = quaternion.to_matrix(filtered.attitude)
    fixed = R @ filtered.covariance[:, :3, :3] @ R.transpose(0, 2, 1)
    iron = 0.0 if prepared.dip is None else (parameters.iron_sigma / np.cos(prepared.dip)) ** 2
    attitude, own = np.empty((len(row), 4)), np.empty((len(row), 3, 3))
    compiled(recording_steps.carry_to_stamps)(
        row, step, fixed, turned, ahead, used.rate, delays.sigma**2, iron, attitude, own
    )
    variance = filtered.variance[row]
    variance[:, :3] = np.einsum("kii->ki", own)
    P = None
    if full_covariance:
        P = filtered.covariance[row]
        P[:, :3, :3] = own
        P[:, :3, 3:] = quaternion.to_matrix(attitude).transpose(0, 2, 1) @ (R @ filtered.covariance[:, :3, 3:])[row]
        P[:, 3:, :3] = P[:, :3, 3:].transpose(0, 2, 1)
    sensors = {"accelerometer": used.specific_force, "magnetometer": used.magnetic_field}
    return Estimate(
        time=used.time,
        attitude=attitude,
        bias=bias,
        variance=variance,
        covariance=P,
        innovations=filtered.innovations,
        skipped={
            name: int(np.sum(~(np.isfinite(samples).all(axis=1) & samples.any(axis=1))))
            for name, samples in sensors.items()
            if samples is not None
        },
        events=filtered.events,
        error_states={
            name: ErrorStateEstimate(
                components=block.components, units=block.units, values=block.values[row], variance=block.variance[row]
            )
            for name, block in filtered.error_states.items()
        },
    )


def _mean(samples: Array, source: str, sensor: str) -> Array:
    """Return the mean of samples (k, 3) of the quiet second, which must show a direction."""
    if len(samples) == 0:
        raise InputError(
            f"{source}: the {sensor} has no valid sample in the first quiet second; cut the recording to where it has"
        )
    mean = np.asarray(samples.mean(axis=0))
    if _norm(mean) == 0.0:
        raise InputError(
            f"{source}: the {sensor} is zero over the first quiet second and shows no direction; cut the recording to where it has one"
        )
    return mean


def _norm(vector: Array) -> float:
    return float(np.linalg.norm(vector))
