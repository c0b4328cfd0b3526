"""Initial state of the filter of a recording from its first samples, and the gyro's bias measured while the unit is at rest."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from strapdown import estimation, quaternion
from strapdown.ahrs.parameters import AhrsParameters
from strapdown.checks import Array, Hint, InputError, lengths
from strapdown.estimation.states import changed
from strapdown.kernels import alignment, recording_samples
from strapdown.kernels import rests as kernel
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.rotation import moved, unit
from strapdown.recordings import Recording
from strapdown.units import DEGREE, STANDARD_GRAVITY
from strapdown.vectors import wahba

QUIET_SPAN = 1.0
"""Duration of the spans in which rest is looked for, s."""
TENTHS = 10
"""Number of parts of such a span whose mean rates are compared."""
MAX_REST_SIGMA = 1.0 * DEGREE
"""Maximum σ, rad/s, of the mean rate of a span as a measurement of the bias."""
TURNING_RATE = 0.3 * DEGREE
"""Mean rate, rad/s, above which vertical and field are examined for a rotation with it."""
CHANGE_BY_NOISE = 3e-3
"""Change of the mean specific force or field, relative to it, from half to half of a span at rest."""
VIBRATION_SPANS, VIBRATION_ODDS = 5, 3.0
"""Number of successive spans in which a unit rests though its specific force changes by more, if their means agree to within that factor
times the σ that vibration gives them. On 88 recordings such spans agree with other rests, on simulated ships there are none."""
VIBRATION_BIAS = 0.25 * DEGREE
"""Maximum σ of the bias then, rad/s: a rate beyond that factor times it may be a steady turn."""
TURN_ODDS = 5.0
"""Difference of a mean rate from the bias by the rests before, relative to its σ, above which it is a turn."""
FIELD_TURN, FIELD_TIME = 0.5 * DEGREE, 15.0
"""Turn of the field with the gyro, rad, in that time, s, above which a unit that seems at rest turns slowly."""
FIRST_BIAS_SIGMA = 2.0 * DEGREE
"""Its σ before the first rest, rad/s, without a magnetometer too."""
FIRST_ALIGNMENT, LAST_ALIGNMENT = 0.0625, 1.0
"""Durations of the first and of the last coarse alignment, s."""
MIN_MOTION = 0.3
"""Variation of the specific force, in g, from which on a unit that starts is aligned coarsely; with less the filter corrects itself."""
CHANGE_TIME = 0.35
"""Duration over which an acceleration has one direction, s: σ of the mean vertical is the variation, in g, times this over the duration.
Chosen on 373 starts in motion in 27 recordings of all eight sets."""
SWING_TIME = 0.3
"""Time, s, over which a rate at the start is assumed to accelerate the unit: it adds to σ of the tilt."""
MAX_TILT_SIGMA = 0.7
"""Maximum σ of the initial tilt, rad."""
BIAS_DRIFT = 3e-4
"""Least random walk of the gyro's bias between rests, rad/s/√s: that of the model with a magnetometer. Without one the filter's is smaller,
so that acceleration is not treated as bias."""
SLOW_DRIFT = 3e-5
"""Random walk of the gyro's bias by which the smoother without a magnetometer follows all rests, and beyond which a rest is a turn,
rad/s/√s: 0.07 °/s in half an hour. With a larger one, slow turns would pass for rests or for drift."""
VELOCITY_FACTORS = 0.4, 2.0
"""Limits of the factor on σ of the velocity by which the smoother follows the motion."""
MAX_DEVIATION = 0.1
"""Maximum difference of the specific force at rest from gravity, m/s², with which σ of the accelerometer's bias is the usual one."""
SLOWEST_SWELL = 0.1
"""Frequency of the slowest acceleration that is distinguished from such a bias, Hz."""
ONE_DIRECTION = 0.985
"""Cosine of the angle, 10°, between two directions of the specific force that count as one."""
MIN_LEVEL = 0.07
"""Squared cosine of the dip, 75°, beyond which a field has hardly a heading."""
FIRST_HEADING = 0.1
"""σ of the first sample of the field, relative to its magnitude, which a disturbance has that later ones show."""


def need_accelerometer(recording: Recording) -> None:
    """Reject a recording without an accelerometer."""
    if recording.specific_force is None:
        raise InputError(
            f"{recording.source} has no accelerometer samples from {recording.time[0]:.3g} s on, which show the vertical; add columns "
            "ax, ay, az"
        )


def samples_in_span(recording: Recording) -> int:
    """Return the number of samples in a span of :data:`QUIET_SPAN`.

    Raises
    ------
    InputError
        If the recording is shorter, or its first second holds one sample.
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
            f"interval; if its stamps are in ms or us, say so ({Hint('units', {'time': 'ms'})})"
        )
    return length


def quiet_span(recording: Recording) -> slice:
    """Return the samples of the first quiet second: the first whose measure of motion is at most twice that of the quietest.

    Raises
    ------
    InputError
        As :func:`samples_in_span`.
    """
    length = samples_in_span(recording)
    mean, square = _blocks(recording.rate, length)
    # The mean is added to the spread so that a constant rate is not mistaken for rest; half weight, because it may be bias.
    restless = np.sqrt(square / length) + 0.5 * lengths(mean)
    first = int(np.argmax(restless <= 2.0 * restless.min()))
    return slice(first * length, (first + 1) * length)


def _blocks(samples: Array, length: int) -> tuple[Array, Array]:
    """Return the mean (k, 3) of each block of that many samples (n, 3), and the sum of the squared deviations from it (k,)."""
    mean, square = np.empty((len(samples) // length, 3)), np.empty(len(samples) // length)
    compiled(recording_samples.block_statistics)(read_only(samples), length, mean, square)
    return mean, square


def first_vector(samples: Array | None, turned: Array, source: str, sensor: str) -> Array:
    """Return the first valid sample (3,) of a sensor in the body axes of the first row; ``turned``: attitude by the gyro (n, 4).

    Raises
    ------
    InputError
        If there is none, or all are zero.
    """
    assert samples is not None
    for rows in (samples[:1], samples):  # nearly always the first row
        size = lengths(rows)
        valid = np.isfinite(size) & (size > 0.0)
        if valid.any():
            break
    else:
        state = "is zero and gives no direction" if np.isfinite(size).any() else "has no valid sample"
        raise InputError(f"{source}: the {sensor} {state}; cut the recording to where it has, or leave its columns out")
    k = int(np.argmax(valid))
    return np.asarray(quaternion.rotate(turned[k], samples[k]))


def start(recording: Recording, turned: Array, parameters: AhrsParameters) -> estimation.State:
    """Return the state at the first sample: attitude by TRIAD from the first specific force and field, any heading without a field.

    σ of the tilt includes the deviation of the specific force from gravity and the motion that the first rate implies; that of the
    heading includes the tilt, because the field dips, and a disturbance of the field. The bias is zero with σ ``bias_sigma``.
    """
    assert recording.specific_force is not None
    force = first_vector(recording.specific_force, turned, recording.source, "accelerometer")
    across, heading = np.array(alignment.least_axis(force.tolist())), 0.0
    constants = start_constants(parameters)
    tilt = alignment.tilt_variance(constants, force.tolist(), recording.rate[0].tolist())
    if recording.magnetic_field is not None:
        across = first_vector(recording.magnetic_field, turned, recording.source, "magnetometer")
        sine = alignment.sine_of_dip(force.tolist(), across.tolist())
        heading = alignment.heading_variance(constants, sine, tilt)
    attitude, P = wahba.from_vertical_and_heading(force, across), np.eye(6) * parameters.bias_sigma**2
    P[:3, :3] = attitude_covariance(force, tilt, heading)
    return estimation.State(attitude=attitude, bias=np.zeros(3), covariance=P)


def attitude_covariance(force: Array, tilt: float, heading: float) -> Array:
    """Return the covariance (3, 3), rad², of an attitude whose vertical is that of a specific force (3,), from variances.

    ``heading``: variance of the heading in addition to that by the tilt.
    """
    up = force / np.linalg.norm(force)
    return np.asarray(tilt * np.eye(3) + heading * np.outer(up, up))


def align(
    x: Array, P: Array, force: Array, field: Array, tilt: float, parameters: AhrsParameters, *, unknown: bool
) -> None:
    """Replace the attitude in a state x (n + 1,) and its covariance by that of mean specific force and field (3,), body axes.

    ``tilt``: variance of the tilt, rad². An attitude that agrees remains, unless the rotation before was ``unknown``; then the heading
    remains if it is more certain than that of the field.
    """
    q, present = x[:4].tolist(), P[np.triu_indices(3)].tolist()
    if not unknown and not alignment.departs(q, force.tolist(), tilt):
        return
    x[:4], heading = alignment.aligned(
        start_constants(parameters), force.tolist(), field.tolist(), tilt, float(unknown), q, present
    )
    P[:3], P[:, :3] = 0.0, 0.0
    P[:3, :3] = attitude_covariance(force, tilt, heading)


def alignment_constants(interval: float, parameters: AhrsParameters) -> alignment.Constants:
    """Return the constants of the coarse alignment at this interval of the samples, s."""
    return alignment.Constants(
        interval=interval,
        first=FIRST_ALIGNMENT,
        last=LAST_ALIGNMENT,
        min_motion=MIN_MOTION**2,
        change_time=CHANGE_TIME,
        known=parameters.attitude_sigma**2,
        unknown=MAX_TILT_SIGMA**2,
        gravity=STANDARD_GRAVITY,
    )


def alignment_memory(*, unknown: bool) -> Array:
    """Return the memory before the first step; after an ``unknown`` rotation the first step already shows more than is known."""
    memory = np.zeros(alignment.SIZE)
    memory[alignment.UNKNOWN if unknown else alignment.DUE] = 1.0 if unknown else FIRST_ALIGNMENT
    return memory


def alignments(
    steps: alignment.Steps, interval: float, parameters: AhrsParameters, *, unknown: bool
) -> alignment.Outputs:
    """Return the coarse alignments over steps, at the start or after an ``unknown`` rotation; ``interval``: that of the samples, s."""
    k = len(steps.force)
    out = alignment.Outputs(np.zeros((k, 3)), np.zeros((k, 3)), np.empty(k))
    constants, memory = alignment_constants(interval, parameters), alignment_memory(unknown=unknown)
    compiled(alignment.align_steps)(constants, alignment.Steps(*map(read_only, steps)), memory, out)
    return out


def start_constants(parameters: AhrsParameters) -> alignment.FirstConstants:
    """Return the constants of the variances at the start."""
    return alignment.FirstConstants(
        attitude_sigma=parameters.attitude_sigma,
        max_tilt_sigma=MAX_TILT_SIGMA,
        swing_time=SWING_TIME,
        gravity=STANDARD_GRAVITY,
        min_level=MIN_LEVEL,
        field_sigma=FIRST_HEADING,
    )


class Rests(NamedTuple):
    """Measurements of the gyro's bias: the mean rates of spans at rest."""

    last: np.ndarray
    """Last sample of each span (m,)."""
    rate: Array
    """Mean rate (m, 3), rad/s."""
    sigma: Array
    """σ of each axis (m,), rad/s."""
    gained: Array
    """Variance that the bias has gained since the rest before and the filter does not model (m,), (rad/s)²; infinite if a rest shows no
    more than is known: a long one is measured once, and again as the bias drifts."""
    bias: Array
    """Bias by all rests so far (m, 3), rad/s."""


NO_REST = Rests(np.empty(0, np.intp), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty((0, 3)))


def rests(recording: Recording, parameters: AhrsParameters) -> Rests:
    """Return the spans in which the unit hardly moves: :func:`strapdown.kernels.rests.find_rest`."""
    if parameters.rest_bias_sigma == 0.0:
        return NO_REST
    with_field = recording.magnetic_field is not None
    constants = constants_of(recording.interval, parameters, magnetometer=with_field)
    memory = memory_of(recording.interval, parameters)
    memory.rest_clock[1] = recording.time[0]
    length = constants.parts * constants.part
    n = len(recording.time) // length
    means = kernel.Means(np.empty((n, 3)), np.empty(n), np.empty(n), np.empty((n, 3)))
    field = np.empty((0, 3)) if recording.magnetic_field is None else recording.magnetic_field
    assert recording.specific_force is not None
    samples = recording.time, recording.rate, recording.specific_force, field
    compiled(kernel.find_rests)(constants, *map(read_only, samples), memory, means)
    (quiet,) = np.nonzero(np.isfinite(means.variance))
    return Rests(
        last=length * (quiet + 1) - 1,
        rate=means.rate[quiet],
        sigma=np.sqrt(means.variance[quiet]),
        gained=means.gained[quiet],
        bias=means.bias[quiet],
    )


def rest_length(interval: float) -> tuple[int, int]:
    """Return the number of parts of a span in which rest is looked for, and of samples of a part, at this interval of the samples, s."""
    length = max(2, round(QUIET_SPAN / interval))
    parts = min(TENTHS, length)
    return parts, length // parts


def constants_of(interval: float, parameters: AhrsParameters, *, magnetometer: bool) -> kernel.Constants:
    """Return the kernel's constants at this interval of the samples, s."""
    parts, part = rest_length(interval)
    modelled = parameters.rate_random_walk**2
    walk = max(modelled, BIAS_DRIFT**2)
    return kernel.Constants(
        with_field=int(magnetometer),
        parts=parts,
        part=part,
        span=QUIET_SPAN,
        own_variance=parameters.rest_bias_sigma**2,
        max_variance=MAX_REST_SIGMA**2,
        turning=TURNING_RATE**2,
        odds=TURN_ODDS**2,
        walk=walk,
        unmodelled=walk - modelled,
        slow_walk=SLOW_DRIFT**2,
        noise=CHANGE_BY_NOISE**2,
        vibration_odds=VIBRATION_ODDS**2,
        vibration_bias=VIBRATION_BIAS**2,
        vibration_spans=VIBRATION_SPANS,
        field_turn=FIELD_TURN**2,
        field_time=FIELD_TIME,
    )


def memory_of(interval: float, parameters: AhrsParameters) -> kernel.Memory:
    """Return the kernel's memory before the first sample."""
    return kernel.Memory(
        tenths=np.zeros((rest_length(interval)[0], 3)),
        force_tenths=np.zeros((rest_length(interval)[0], 4)),
        halves=np.zeros((4, 3)),
        halves_number=np.zeros(4, np.int64),
        steady=np.zeros((2, 3)),
        steady_spans=np.zeros(1, np.int64),
        resting=np.zeros(2, np.int64),
        rest_rate=np.zeros((1, 3)),
        rest_variance=np.array([np.inf]),
        rest_gained=np.array([np.inf]),
        rest_bias=np.zeros((1, 3)),
        bias_variance=np.array([parameters.bias_sigma**2]),
        plausible_variance=np.array([FIRST_BIAS_SIGMA**2]),
        rest_clock=np.zeros(2),
        field_before=np.zeros((1, 3)),
        field_clock=np.zeros(1),
        turned_slowly=np.zeros(1, np.int64),
    )


def take_rate_at_rest(x: Array, P: Array, rate: Array, sigma: float, gained: float = 0.0) -> None:
    """Correct attitude, bias and error states x (n + 1,) and their covariance by a measurement of the gyro's bias (3,) with σ, rad/s.

    ``gained``: variance that the bias has gained and P has not, (rad/s)².

    The velocity, which is defined in the axes of the estimated attitude, is not rotated with it: at rest it is as small as the correction,
    so the difference is of second order (at most 0.01° over 88 public recordings).
    """
    P[[3, 4, 5], [3, 4, 5]] += gained
    change = np.zeros(len(P))
    for k, component in zip((3, 4, 5), rate - x[4:7], strict=True):  # errors of the axes are independent
        root = 1.0 / math.sqrt(P[k, k] + sigma**2)
        gain = root * P[k]
        change += (root * (component - change[k])) * gain
        P -= gain[:, None] * gain
    attitude, reset = moved(x[:4].tolist(), change[:3].tolist())
    J = np.reshape(reset, (3, 3))
    P[:3] = J @ P[:3]
    P[:3, :3] = P[:3, :3] @ J.T
    P[:, :3] = P[:3].T
    x[:4] = unit(attitude)
    x[4:] += change[3:]


def for_whole(recording: Recording, parameters: AhrsParameters, at_rest: Rests) -> AhrsParameters:
    """Return the smoother's parameters, which follow what a whole recording shows of the motion and of the accelerometer.

    σ of the velocity is proportional to the standard deviation of the specific force's magnitude (``usual_variation``). If the specific
    force at rest differs from gravity by more than :data:`MAX_DEVIATION`, and constantly, σ of the accelerometer's bias is that difference.
    """
    assert recording.specific_force is not None
    if parameters.usual_variation > 0.0:
        size = lengths(recording.specific_force)
        variation = float(np.std(size[np.isfinite(size)]))
        factor = float(np.clip(variation / parameters.usual_variation, *VELOCITY_FACTORS))
        parameters = replace(parameters, velocity_sigma=factor * parameters.velocity_sigma)
    if parameters.accelerometer_bias_sigma > 0.0 and len(at_rest.last):
        parts, part = rest_length(recording.interval)
        spans = recording.specific_force[np.add.outer(at_rest.last, np.arange(1 - parts * part, 1))]
        halves = [np.nanmean(half, axis=1) for half in np.array_split(spans, 2, axis=1)]
        first, second = (lengths(half) - STANDARD_GRAVITY for half in halves)
        deviation, up = 0.5 * (first + second), (halves[0] + halves[1]) / lengths(halves[0] + halves[1])[:, None]
        # An acceleration of frequency f changes by π f of its amplitude from half to half of a second; a bias does not.
        by_motion = (second - first) ** 2 / (np.pi * SLOWEST_SWELL) ** 2
        # From rest to rest in one direction a bias does not change either.
        change = np.diff(deviation)[np.sum(up[1:] * up[:-1], axis=1) > ONE_DIRECTION]
        between = 0.5 * np.mean(change**2) if len(change) else 0.0
        square = float(np.mean(deviation**2 - by_motion) - between)
        if square > MAX_DEVIATION**2:
            parameters = replace(parameters, accelerometer_bias_sigma=square**0.5)
    return parameters


def bias_by_rests(at_rest: Rests, time: Array, edge: np.ndarray, *, causal: bool) -> Array:
    """Return the gyro's bias that the rests before each step show, or all rests (k, 3), rad/s; zero without one.

    ``time`` (n,): of the samples, s; ``edge`` (k + 1,): the steps' first and last samples.
    """
    if len(at_rest.last) == 0:
        return np.zeros((len(edge) - 1, 3))
    if causal:
        return np.asarray(np.concatenate([np.zeros((1, 3)), at_rest.bias])[np.searchsorted(at_rest.last, edge[1:])])
    return np.stack([np.interp(time[edge[1:]], time[at_rest.last], axis) for axis in at_rest.bias.T], axis=-1)


def drift_by_rests(at_rest: Rests, time: Array) -> Array:
    """Return the change of the gyro's bias since the first rest, rad/s, at every sample (n, 3), by all spans at rest.

    The bias at the rests is that of a random walk with :data:`SLOW_DRIFT`, smoothed; between them it changes linearly.
    """
    if len(at_rest.last) < 2:
        return np.zeros((len(time), 3))
    rested = time[at_rest.last]
    apart, weight = 1.0 / (SLOW_DRIFT**2 * np.diff(rested)), at_rest.sigma**-2
    normal = np.zeros((2, len(rested)))
    normal[0] = weight + np.append(apart, 0.0) + np.append(0.0, apart)
    normal[1, :-1] = -apart
    bias = solveh_banded(normal, weight[:, None] * at_rest.rate, lower=True)
    return np.stack([np.interp(time, rested, axis) for axis in (bias - bias[0]).T], axis=-1)


def with_all_rests(
    state: estimation.State, at_rest: Rests, time: Array, parameters: AhrsParameters
) -> estimation.State:
    """Return the state at the first sample with the bias that all spans at rest show, from the last one back, as it drifts."""
    if len(at_rest.last) == 0:
        return state
    walk = parameters.rate_random_walk**2
    mean, information, after = np.zeros(3), 0.0, time[at_rest.last[-1]]
    for last, rate, sigma in zip(at_rest.last[::-1], at_rest.rate[::-1], at_rest.sigma[::-1], strict=True):
        information = information / (1.0 + information * walk * (after - time[last]))
        total = information + sigma**-2
        mean, information, after = (information * mean + sigma**-2 * rate) / total, total, time[last]
    sigma = float(np.sqrt(1.0 / information + walk * (after - time[0])))
    return changed(state, functools.partial(take_rate_at_rest, rate=mean, sigma=sigma))
