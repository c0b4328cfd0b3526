"""Attitude and heading from a recording: accelerometer as the vertical, magnetometer as the heading only, one filter for both.

The fixed frame is East-North-Up with magnetic North. This module says what the filter's measurements are, where it starts and what it
believes (:data:`MOTIONS`); the filter is that of :mod:`strapdown.setup`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from strapdown import coning, estimation, quaternion, setup, wahba
from strapdown.checks import Array, InputError, non_negative, positive
from strapdown.recordings import Recording, increments
from strapdown.records import Estimate, ImuRecord
from strapdown.setup import FilterSetup
from strapdown.setup.states import SensorStates, States
from strapdown.units import DEGREE
from strapdown.vectors import VectorMeasurements

UP = np.array([0.0, 0.0, 1.0])
NORTH = np.array([0.0, 1.0, 0.0])
QUIET_SPAN = 1.0
"""Length of the quiet span that the filter starts from, s."""
FIELD_SPAN = 0.2
"""Over which the field, turned back by the gyro, must stand still for the magnetometer's latency, s."""
MOST_LATENCY_SIGMA = 2e-3
"""A latency of the magnetometer that is known no better is not used, s."""
MOST_LATENCY = 0.05
"""Nor is one beyond this, which is another error than a latency, s."""


@dataclass(frozen=True, kw_only=True)
class AhrsParameters:
    """What the filter believes of the unit. The defaults are one set for consumer and industrial MEMS units on whatever moves.

    The noises are those of *independent* samples at ``reference_rate``, and are spread so that the weight a second does not depend on the
    recording's rate. They are much larger than the sensors' own noise, because what disturbs them, acceleration and iron, lasts over
    many samples. With ``velocity_sigma`` the acceleration has states (:class:`strapdown.error_states.BoundedVelocity`), and
    ``specific_force_sigma`` is what is left beside it; :data:`HAND_HELD` is such a set.
    """

    angle_random_walk: float = 3e-3
    """σ_v, rad/√s; scale-factor and alignment errors of a moving unit included."""
    rate_random_walk: float = 1e-5
    """σ_u, rad/s/√s."""
    specific_force_sigma: float = 10.0
    """Acceleration that has no states, each component, m/s²."""
    heading_sigma: float = 5.0
    """Disturbance of the magnetic heading, rad."""
    field_strength_weight: float = 10.0
    """Heading σ added, in rad, for each unit of relative deviation of the field's strength from that at the start."""
    reference_rate: float = 285.0
    """Rate that the two noises above are told for, Hz."""
    attitude_sigma: float = 3.0 * DEGREE
    """Error of the attitude at the start, each axis, rad."""
    bias_sigma: float = 0.5 * DEGREE
    """Gyro bias at the start, each axis, rad/s."""
    rest_bias_sigma: float = 0.0
    """How well the mean rate of the quiet second at the start tells the bias where the unit rests, each axis, rad/s; 0: it is not asked."""
    velocity_sigma: float = 0.0
    """Velocity of the hand, each component, m/s; 0: no states, all its acceleration is white."""
    velocity_time: float = 0.3
    """How long a velocity of the hand lasts, s."""
    acceleration_time: float = 0.1
    """How long a push of the hand lasts, s."""
    gyro_scale_sigma: float = 0.0
    """Each of the gyro's scale factors (1) and misalignments (rad); 0: no states."""

    def __post_init__(self) -> None:
        """Check every field."""
        may_be_zero = (
            "field_strength_weight",
            "rate_random_walk",
            "rest_bias_sigma",
            "velocity_sigma",
            "gyro_scale_sigma",
        )
        for name in self.__dataclass_fields__:
            check = non_negative if name in may_be_zero else positive
            check(name, getattr(self, name))

    @property
    def setup(self) -> FilterSetup:
        """The filter of these beliefs."""
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
    specific_force_sigma=1.0,
    rest_bias_sigma=0.05 * DEGREE,
    velocity_sigma=0.5,
    gyro_scale_sigma=2e-3,
)
"""A unit in the hand: its velocity is bounded, and of its gyro, whose turns are large, scale factors and misalignments are states."""
MOTIONS = {"hand": HAND_HELD, "any": AhrsParameters()}
"""What may move a unit, and what the filter then believes."""


def aligned(recording: Recording, latency: float = 0.0, magnetometer: float = 0.0) -> Recording:
    """Return a recording whose samples show what was at their time stamps.

    They come ``latency``, s, after what they show, those of the magnetometer ``magnetometer`` more. A sensor's low-pass delays what it
    shows by its group delay, and the sensors of one unit differ in it: a magnetometer 11 ms behind the gyro is 6° off at 500 °/s. Samples
    are taken between their neighbours; the last ones are held.
    """
    non_negative("latency", latency, unit="s")
    length = recording.time[-1] - recording.time[0]
    moved: dict[str, Any] = {}
    for name in ("rate", "specific_force", "magnetic_field"):
        samples, late = getattr(recording, name), latency + (magnetometer if name == "magnetic_field" else 0.0)
        if abs(late) >= length:
            raise InputError(f"latency is {late:g} s, and {recording.source} lasts {length:.3g} s")
        if late != 0.0 and samples is not None:
            if (
                name == "magnetic_field"
            ):  # a field of zero is a missing sample, and nothing lies between it and the next
                samples = np.where(np.any(samples != 0.0, axis=1, keepdims=True), samples, np.nan)
            moved[name] = _moved(recording.time, samples, late)
    return replace(recording, **moved)


def _moved(time: Array, samples: Array, late: float) -> Array:
    """Return samples as they were ``late``, s, before their stamps; nothing is taken across a gap.

    Of a slower sensor, which has samples at fewer than half of the stamps, the rows between them stay missing.
    """
    known = np.flatnonzero(np.isfinite(samples).all(axis=1))
    if 2 * len(known) >= len(time):
        return np.stack([np.interp(time + late, time, one) for one in samples.T], axis=1)
    result = np.full(samples.shape, np.nan)
    if len(known) < 2:
        return result
    stamps = time[known]
    wanted = stamps + late
    result[known] = np.stack([np.interp(wanted, stamps, one) for one in samples[known].T], axis=1)
    steps = np.diff(stamps)
    place = np.clip(np.searchsorted(stamps, wanted), 1, len(steps)) - 1
    across = (steps[place] > 1.5 * np.median(steps)) & (wanted > stamps[place]) & (wanted < stamps[place + 1])
    result[known[across]] = np.nan
    return result


def magnetometer_latency(recording: Recording) -> tuple[float, float]:
    """Return how long after the gyro's the magnetometer's samples come, s, and the σ of that; (0, ∞) where nothing shows it.

    Turned back by the gyro alone, the field m stands still over a fraction of a second. Samples that are late by τ are off by ``−τ ṁ``,
    ``ṁ = −w × m``, and how that changes over :data:`FIELD_SPAN` is what is fitted, least squares without the farthest. A field that
    turns with the body (hard iron) is in quadrature to it in a swing: it does not pass for latency, but a strong one hides some.
    """
    nothing = (0.0, np.inf)
    lag = int(np.searchsorted(recording.time, recording.time[0] + FIELD_SPAN))
    if recording.magnetic_field is None or len(recording.time) < 10 * lag:
        return nothing
    attitude = coning.integrate(increments(recording), coning.ALGORITHMS["one-sample"])
    field = np.nan_to_num(recording.magnetic_field)
    known = np.asarray(np.isfinite(recording.magnetic_field).all(axis=1))
    still = quaternion.rotate(attitude, field)
    late = quaternion.rotate(attitude, np.cross(recording.rate, field))
    pairs = known[lag:] & known[:-lag]
    change, wanted = (still[lag:] - still[:-lag])[pairs], (late[lag:] - late[:-lag])[pairs]
    kept = np.full(len(change), True)
    for _ in range(6):
        information = float(np.sum(wanted[kept] ** 2))
        if information == 0.0:
            return nothing
        latency = float(np.sum(change[kept] * wanted[kept])) / information
        left = np.linalg.norm(change - latency * wanted, axis=1)
        middle = float(np.median(left))
        kept = left <= 2.5 * middle
    # Of a normal residual with three components the median length is 1.54 σ; pairs that overlap are not independent.
    return latency, middle / 1.54 * float(np.sqrt(lag / information))


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
            f"{recording.source} lasts {lasts:.3g} s; the start needs at least {QUIET_SPAN:g} s of samples (or tell the unit "
            "of its time)"
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


def imu_record(recording: Recording, quiet: slice, parameters: AhrsParameters) -> ImuRecord:
    """Return what the filter takes: increments by the trapezoid rule, specific force and heading with their noise.

    The strengths of gravity and of the field are those of the samples ``quiet``.
    """
    spread = np.sqrt(1.0 / (np.median(np.diff(recording.time)) * parameters.reference_rate))
    assert recording.specific_force is not None
    gravity = _norm(_mean(recording.specific_force[quiet], recording.source, "accelerometer"))
    vectors = [
        VectorMeasurements(
            sensor="accelerometer",
            kind="vector",
            time=recording.time,
            vector_b=recording.specific_force,
            reference_f=gravity * UP,
            sigma=np.full(len(recording.time), parameters.specific_force_sigma * spread),
        )
    ]
    if recording.magnetic_field is not None:
        strength = np.linalg.norm(recording.magnetic_field, axis=1, keepdims=True)
        strength[strength == 0.0] = np.nan  # a field of zero is no field: a missing sample
        _mean(recording.magnetic_field[quiet], recording.source, "magnetometer")
        deviation = np.nan_to_num(strength[:, 0] / np.nanmean(strength[quiet]) - 1.0)
        vectors.append(
            VectorMeasurements(
                sensor="magnetometer",
                kind="heading",
                time=recording.time,
                vector_b=recording.magnetic_field / strength,
                reference_f=NORTH,
                sigma=np.hypot(parameters.heading_sigma, parameters.field_strength_weight * deviation) * spread,
            )
        )
    return ImuRecord(time=recording.time, increments=increments(recording), vectors=tuple(vectors))


def start(recording: Recording, quiet: slice, parameters: AhrsParameters) -> estimation.State:
    """Return the state at the quiet samples: attitude by TRIAD from the mean vertical and field; any North without a magnetometer.

    With ``rest_bias_sigma`` the bias is that of :func:`resting_bias`.
    """
    assert recording.specific_force is not None
    up = _mean(recording.specific_force[quiet], recording.source, "accelerometer")
    sigma = np.full(3, parameters.attitude_sigma)
    if recording.magnetic_field is None:
        # Any horizontal direction will do for a heading that nothing measures.
        across = np.eye(3)[np.argmin(np.abs(up))]
        attitude = wahba.from_vertical_and_heading(up, across)
    else:
        field = _mean(recording.magnetic_field[quiet], recording.source, "magnetometer")
        attitude = wahba.from_vertical_and_heading(up, field)
    bias, bias_sigma = np.zeros(3), parameters.bias_sigma
    if parameters.rest_bias_sigma > 0.0:
        bias, bias_sigma = resting_bias(recording, quiet, parameters)
    return estimation.initial_state(attitude, bias=bias, attitude_sigma=sigma, bias_sigma=bias_sigma)


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


@dataclass(frozen=True, kw_only=True)
class AhrsEstimate:
    """An estimate beside the samples that it was made from, one row for one row."""

    recording: Recording
    """The recording from its first quiet second on, its samples as the filter takes them."""
    estimate: Estimate
    initial: estimation.State
    """Where the filter started."""
    magnetometer_latency: float = 0.0
    """How much later than the gyro's the magnetometer's samples were taken for, s."""


def estimate(
    recording: Recording,
    parameters: AhrsParameters = HAND_HELD,
    *,
    latency: float = 0.0,
    full_covariance: bool = False,
    smooth: bool = False,
) -> AhrsEstimate:
    """Return attitude and gyro bias over a recording, at its time stamps from the first quiet second on.

    Parameters
    ----------
    recording : Recording
    parameters : AhrsParameters
    latency : float
        How long after what they show the samples of gyro and accelerometer come, s: the group delay of the sensors. That of the
        magnetometer beside the gyro is found by :func:`magnetometer_latency` where the recording shows it.
    full_covariance : bool
        Keep whole covariance matrices too.
    smooth : bool
        From all samples, by the fixed-interval smoother, instead of those up to each stamp.
    """
    if recording.specific_force is None:
        raise InputError(f"{recording.source} has no accelerometer, which shows the vertical; add columns ax, ay, az")
    span = quiet_span(recording)
    field_latency, sigma = magnetometer_latency(recording)
    if not (sigma < MOST_LATENCY_SIGMA and 3.0 * sigma < abs(field_latency) < MOST_LATENCY):
        field_latency = 0.0
    used = aligned(recording, latency, field_latency).since(span.start)
    quiet = slice(0, span.stop - span.start)
    initial = start(used, quiet, parameters)
    face = setup.smooth if smooth else setup.run
    result = face(imu_record(used, quiet, parameters), parameters.setup, initial, full_covariance=full_covariance)
    return AhrsEstimate(recording=used, estimate=result, initial=initial, magnetometer_latency=field_latency)


def _mean(samples: Array, source: str, sensor: str) -> Array:
    known = samples[np.isfinite(samples).all(axis=1)]
    if len(known) == 0:
        raise InputError(
            f"{source}: the {sensor} has no valid sample in the first quiet second; cut the recording to where it has"
        )
    mean = np.asarray(known.mean(axis=0))
    if _norm(mean) == 0.0:
        raise InputError(
            f"{source}: the {sensor} is zero over the first quiet second and shows no direction; cut the recording to where it has one"
        )
    return mean


def _norm(vector: Array) -> float:
    return float(np.linalg.norm(vector))
