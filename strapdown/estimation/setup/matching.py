"""What of a filter follows from the specified errors of gyro and sensors: its noise, and its error states with their σ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from strapdown import coning, gyro, quaternion, units, vectors
from strapdown.checks import Array, InputError
from strapdown.estimation.forward import strength
from strapdown.estimation.setup.states import Entries, SensorStates, States
from strapdown.gyro import GyroSpec, flicker
from strapdown.records import ImuRecord, Origin
from strapdown.vectors import VectorMeasurements

ATTITUDE_SIGMA = 1.0 * units.DEGREE
"""Standard deviation of the initial attitude error where nobody says, each axis, rad; less where the sensors are very fine."""
LINEAR_SHARE = 0.2
"""The second-order error of a first measurement, half the square of the initial error, may be about this share of half its σ."""
COMMUTATION_SHARE = 0.1
"""Part of the σ of a constant rate, by white noise over the record; a one-sample drift above it calls for a better algorithm."""
ACCURATE_ALGORITHM = "matched-1-8-8"
"""The integration algorithm chosen then: one step a sample."""
MIN_SAMPLES = 32
"""Fewest gyro samples for which the commutation error is estimated."""
DECADE = 10.0
"""Ratio of the time constants of neighbouring drifts: their sum follows 1/f within 6 %."""
QUICK = 0.3
"""A drift is a state if its time constant is at least this part of the filter's own."""
UNSEEN = 1e4
"""Part of the record's length that the quickest drift lasts where nothing is measured."""
MIN_STEPS = 10.0
"""Gyro intervals that the quickest drift lasts at least."""


@dataclass(frozen=True, kw_only=True)
class Matched:
    """States for a record, and what beside them changes."""

    states: States
    white: float
    """PSD that the gyro's white noise gains by flicker too quick for a state, rad²/s."""


def matched(spec: GyroSpec, record: ImuRecord, sensors: Sequence[Any], gravity_f: Array) -> Matched:
    """Return the states that the specified errors of a gyro and of sensors call for on a record.

    Each error is taken for one draw from a normal distribution whose σ is its size, entry by entry; one of zero is no state. Of flicker,
    parts a decade apart from the record's length down to what the measurements can follow are states (their sum is 1/f within 6 %), what is
    quicker is white noise of the attitude and a σ of the reported bias.
    """
    drift_sigma, drift_time, fast, white = _drifts(spec, record, measurement_density(record))
    force = np.abs(spec.g_sensitivity) if np.any(gravity_f) else np.zeros((3, 3))
    series = {one.sensor: one for one in record.vectors}
    found = {}
    for sensor in sensors:
        if sensor.name in series and len(series[sensor.name].time):
            states = _of_sensor(sensor, series[sensor.name])
            if states != SensorStates():
                found[sensor.name] = states
    return Matched(
        states=States(
            gyro_scale_sigma=_entries(np.abs(spec.scale_factor)),
            gyro_misalignment_sigma=_entries(np.abs(spec.misalignment)),
            gyro_force_sigma=_entries(np.diag(force)),
            gyro_cross_force_sigma=_entries(force - np.diag(np.diag(force))),
            gyro_temperature_sigma=_slope(spec, record),
            gyro_drift_sigma=drift_sigma,
            gyro_drift_time=drift_time,
            gyro_fast_bias_sigma=fast,
            gravity_f=tuple(gravity_f) if np.any(gravity_f) else States().gravity_f,
            sensors=found,
        ),
        white=white,
    )


def _slope(spec: GyroSpec, record: ImuRecord) -> Entries:
    """Return the size of the bias's slope over the record's temperature (3,), rad/s/K: its root mean square and its σ; 0 without any."""
    if spec.temperature is None or record.temperature is None or np.ptp(record.temperature) == 0.0:
        return 0.0
    steps = np.diff(record.temperature)[:, None]
    change = np.diff(spec.temperature.bias(record.temperature), axis=0)
    size = np.sqrt(
        np.sum(change * change / np.where(steps == 0.0, np.inf, np.abs(steps)), axis=0) / np.sum(np.abs(steps))
    )
    return tuple(np.hypot(size, spec.temperature.slope_sigma).tolist())


def _entries(values: Array) -> Entries:
    """Return entries as they are specified: 0 where there is none."""
    return (
        tuple(map(tuple, values.tolist()))
        if values.ndim == 2 and values.any()
        else (tuple(values.tolist()) if values.any() else 0.0)
    )


def _drifts(
    spec: GyroSpec, record: ImuRecord, density: float
) -> tuple[tuple[float, ...], tuple[float, ...], float, float]:
    """Return σ and time constants of Gauss–Markov drifts, the σ of what is quicker, rad/s, and its PSD, rad²/s."""
    sigma, time, fast, white = [], [], 0.0, 0.0
    if np.isfinite(spec.markov_correlation_time) and np.any(np.asarray(spec.markov_noise) > 0.0):
        driven = float(np.max(spec.markov_noise))
        sigma.append(driven * float(np.sqrt(0.5 * spec.markov_correlation_time)))
        time.append(float(spec.markov_correlation_time))
    instability = float(np.max(spec.bias_instability))
    if instability > 0.0:
        length = float(record.time[-1] - record.time[0])
        step = length / len(record.increments)
        follows = QUICK / bandwidth(spec, density) if np.isfinite(density) else length / UNSEEN
        shortest = max(follows, MIN_STEPS * step)
        number = max(1, int(np.floor(np.log10(length / shortest))) + 1)
        times = length / DECADE ** np.arange(number)
        each = instability * float(np.sqrt(np.log(DECADE) / np.pi))
        sigma += [each] * number
        time += times.tolist()
        white = 2.0 * each**2 * float(times[-1]) / (DECADE - 1.0)
        fast = float(np.sqrt(_quicker(len(record.increments), step, instability, each, np.asarray(times))))
    return tuple(sigma), tuple(time), fast, white


def bandwidth(spec: GyroSpec, density: float) -> float:
    """Return about how quickly the filter follows, rad/s: ``σ_v/√r`` of white noise, or where it is more the ω of ``r ω³ = B²/2``."""
    white = float(np.max(spec.angle_random_walk))
    instability = float(np.max(spec.bias_instability))
    return float(max(white / np.sqrt(density), (0.5 * instability**2 / density) ** (1.0 / 3.0)))


def _quicker(samples: int, step: float, instability: float, each: float, times: Array) -> float:
    """Return the variance of the simulated flicker at an edge less that of the drifts, over what is quicker than they, (rad/s)²."""
    lowest = step / (2.0 * np.pi * float(times[-1]) * np.sqrt(DECADE))
    f = np.geomspace(min(lowest, 0.1), 0.5, 4000)
    # At an edge it is the mean of the intervals' values on either side.
    whole = instability**2 * flicker.shaping(samples).spectrum(f) * np.cos(np.pi * f) ** 2
    w = 2.0 * np.pi * f[:, None] / step
    held = np.sum(2.0 * each**2 * times / (1.0 + (w * times) ** 2), axis=1) / step
    return float(max(2.0 * np.trapezoid(whole - held, f), 0.0))


def _of_sensor(sensor: Any, series: VectorMeasurements) -> SensorStates:
    """Return the states that one sensor calls for."""
    own = float(sensor.sigma) if hasattr(sensor, "sigma") else 0.0
    over, varying = 1.0, False
    if series.kind in ("direction", "heading") and own > 0.0 and hasattr(sensor, "field_f"):
        # The series gives the sensor's noise over the field's strength.
        level = np.linalg.norm(series.references_f[:, :2], axis=1) if series.kind == "heading" else 1.0
        over = float(np.sqrt(np.mean((series.sigma * level) ** 2))) / own
        varying = bool(np.ptp(strength(series)) > 1e-9)
    elif series.kind == "direction" and hasattr(sensor, "gravity_f"):
        over = 1.0 / float(np.linalg.norm(sensor.gravity_f))
    constant = getattr(sensor, "hard_iron", getattr(sensor, "bias", np.zeros(3)))
    size = np.abs(np.asarray(constant, np.float64)) * over
    faults = getattr(sensor, "faults", None)
    coloured = float(getattr(faults, "correlated_sigma", 0.0)) * over
    arm = np.abs(np.asarray(getattr(sensor, "lever_arm_b", np.zeros(3)), np.float64))
    if series.kind == "attitude":
        arm = np.zeros(3)
    return SensorStates(
        bias_sigma=_all_axes(size),
        correlated_sigma=coloured,
        correlation_time=float(faults.correlation_time) if faults is not None and coloured > 0.0 else 0.0,
        varying=varying and (coloured > 0.0 or bool(size.any())),
        lever_arm_sigma=_entries(arm),
    )


def _all_axes(size: Array) -> Entries:
    """Return σ of each axis, those without an error as small beside the others as it makes no difference."""
    if not size.any():
        return 0.0
    return tuple(np.where(size > 0.0, size, 1e-6 * float(size.max())).tolist())


def specified(origin: Origin) -> tuple[Sequence[Any], Sequence[float]]:
    """Return the sensors, whose errors are specified, and gravity in the fixed frame, as far as they are known."""
    scenario = origin.scenario
    return ((), vectors.GRAVITY_F) if scenario is None else (scenario.sensors, scenario.gravity_f)


def noise_beside_states(spec: GyroSpec, white: float) -> dict[str, float]:
    """Return the two noises of a filter that has drifts as states, ``white`` being the PSD of what of them is too quick, rad²/s."""
    walk = np.max(np.square(spec.rate_random_walk))
    if not np.isfinite(spec.markov_correlation_time):
        walk = np.max(np.square(spec.rate_random_walk) + np.square(spec.markov_noise))
    found = {
        "angle_random_walk": float(np.sqrt(np.max(np.square(spec.angle_random_walk)) + white)),
        "rate_random_walk": float(np.sqrt(walk)),
    }
    _need_white(found)
    return found


def commutes_badly(record: ImuRecord, white: float) -> bool:
    """Return whether a turn at constant rate over each sample drifts by more than the record can leave unnoticed."""
    better = coning.ALGORITHMS[ACCURATE_ALGORITHM]
    if len(record.increments) < MIN_SAMPLES:
        return False
    one = coning.integrate(record.increments, coning.ALGORITHMS["one-sample"])[-1]
    other = coning.integrate(record.increments, better, edges=record.time)[-1]
    length = float(record.time[-1] - record.time[0])
    drift = float(np.linalg.norm(quaternion.log(quaternion.multiply(quaternion.conjugate(one), other)))) / length
    return bool(drift > COMMUTATION_SHARE * white / np.sqrt(length))


def unmodelled_errors(
    spec: GyroSpec,
    sensors: Sequence[Any] = (),
    states: States | None = None,
    *,
    gravity_f: Sequence[float] = vectors.GRAVITY_F,
) -> tuple[str, ...]:
    """Return, in words with their size, the specified errors of gyro and sensors that a filter has no state for.

    Where there are any, a filter that models the noise alone is overconfident.

    Examples
    --------
    >>> from strapdown import GyroSpec
    >>> from strapdown.estimation import setup
    >>> setup.unmodelled_errors(GyroSpec(angle_random_walk=1e-5, scale_factor=(1e-4, 0.0, 0.0)))
    ("the gyro's scale factor of 100 ppm",)
    """
    scale, asymmetry, misalignment, flicker = (
        float(np.max(np.abs(getattr(spec, name))))
        for name in ("scale_factor", "asymmetry", "misalignment", "bias_instability")
    )
    found: list[tuple[Any, str, str]] = [
        (scale, "gyro.scale", f"the gyro's scale factor of {scale / 1e-6:.3g} ppm"),
        (asymmetry, "", f"the gyro's asymmetry of {asymmetry / 1e-6:.3g} ppm"),
        (misalignment, "gyro.misalignment", f"the gyro's misalignment of {misalignment / 1e-3:.3g} mrad"),
        (
            flicker,
            "gyro.drift",
            f"the gyro's flicker of {flicker / units.DEGREE_PER_HOUR:.3g} °/h, covered in the attitude but not in the bias",
        ),
        (np.any(gravity_f) * spec.g_sensitivity, "gyro.force", "the gyro's sensitivity to acceleration"),
        (spec.temperature is not None, "gyro.temperature", "the gyro's bias over temperature"),
        (np.max(spec.quantization) + np.max(spec.rate_resolution), "", "the gyro's quantisation"),
    ]
    for sensor in sensors:
        name, faults = sensor.name, getattr(sensor, "faults", vectors.Faults())
        accelerated = getattr(sensor, "acceleration_f", None) is not None
        found += [
            (getattr(sensor, "hard_iron", 0.0), f"{name}.bias", f"the hard iron of the {name}"),
            (getattr(sensor, "soft_iron", 0.0), "", f"the soft iron of the {name}"),
            (getattr(sensor, "bias", 0.0), f"{name}.bias", f"the bias of the {name}"),
            (
                getattr(sensor, "lever_arm_b", 0.0),
                f"{name}.lever",
                f"the accelerations that the {name} feels at its lever arm",
            ),
            (accelerated, f"{name}.velocity", f"the acceleration of the point that the {name} is at"),
            (faults.correlated_sigma, f"{name}.correlated", f"the correlated noise of the {name}"),
            (faults.outlier_probability, "", f"the outliers of the {name}"),
        ]
    known = () if states is None else states.names
    return tuple(words for size, state, words in found if np.any(size) and state not in known)


def linear_sigma(record: ImuRecord) -> float:
    """Return the σ of the initial attitude that the finest sensor's first measurement is still linear in, rad, at most 1°."""
    finest = min((_finest(series) for series in record.vectors if len(series.time)), default=np.inf)
    return float(min(ATTITUDE_SIGMA, np.sqrt(LINEAR_SHARE * finest))) if finest > 0.0 else ATTITUDE_SIGMA


def _finest(series: VectorMeasurements) -> float:
    """Return the least σ of a series, rad."""
    if series.kind == "vector":
        return float(np.min(series.sigma / np.linalg.norm(series.references_f, axis=1)))
    return float(np.min(series.sigma if series.sigma_axes is None else series.sigma_axes))


def noise(spec: GyroSpec, record: ImuRecord) -> dict[str, float]:
    """Return the two noises of a filter without drifts as states; flicker is matched to the record's measurements, or its length."""
    density = measurement_density(record)
    if not np.any(np.asarray(spec.bias_instability) > 0.0):
        found = gyro.process_noise(spec)
    elif np.isfinite(density):
        found = gyro.matched_process_noise(spec, density)
    else:
        found = gyro.process_noise(spec, bandwidth=2.0 * np.pi / float(record.time[-1] - record.time[0]))
    _need_white(found)
    return found


def _need_white(found: Mapping[str, float]) -> None:
    if found["angle_random_walk"] == 0.0:
        raise InputError(
            "the gyro's specification has no angle random walk, and a filter needs one greater than zero; "
            "give it, or a filter setup of your own"
        )


def measurement_density(record: ImuRecord) -> float:
    """Return the variance of a measurement about an axis times the interval between measurements, rad² s, over all sensors and axes."""
    information = sum(_information(series) for series in record.vectors)
    length = float(record.time[-1] - record.time[0])
    return length / information if information > 0.0 else float("inf")


def _information(series: VectorMeasurements) -> float:
    """Return Σ 1/σ² about an axis, the mean over the three axes, 1/rad²."""
    if series.attitude is not None:
        assert series.sigma_axes is not None
        return float(np.sum(series.sigma_axes**-2.0)) / 3.0
    seen = np.isfinite(series.vector_b).all(axis=1)
    length = np.linalg.norm(series.references_f, axis=1) if series.kind == "vector" else np.ones(len(series.time))
    share = 1.0 / 3.0 if series.kind == "heading" else 2.0 / 3.0
    return share * float(np.sum((length[seen] / series.sigma[seen]) ** 2))
