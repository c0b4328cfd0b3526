"""Noise and error states of a filter from the specified errors of gyro and sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from strapdown import coning, gyro, quaternion, units, vectors
from strapdown.checks import Array, InputError, are_finite
from strapdown.estimation.forward import strength
from strapdown.estimation.setup.states import Entries, SensorStates, States
from strapdown.gyro import GyroSpec, flicker
from strapdown.records import ImuRecord
from strapdown.vectors import VectorMeasurements

ATTITUDE_SIGMA = 1.0 * units.DEGREE
"""Default standard deviation of the initial attitude error, per axis, rad; less for very precise sensors."""
LINEAR_SHARE = 0.2
"""Limit on the second-order error of a first measurement, half the square of the initial error, relative to half its σ."""
COMMUTATION_SHARE = 0.1
"""Limit on the drift of one-sample integration, relative to the σ of a constant rate estimated in white noise over the record."""
ACCURATE_ALGORITHM = "matched-1-8-8"
"""Integration algorithm used above that limit: one step per sample."""
MIN_SAMPLES = 32
"""Minimum number of gyro samples for an estimate of the commutation error."""
DECADE = 10.0
"""Ratio of the time constants of neighbouring drifts: their sum is 1/f within 6 %."""
QUICK = 0.3
"""Minimum time constant of a drift that is a state, relative to that of the filter."""
UNSEEN = 1e4
"""Ratio of the record's duration to the minimum time constant of a drift if there are no measurements."""
MIN_STEPS = 10.0
"""Minimum time constant of a drift, in gyro intervals."""


def matched(
    spec: GyroSpec, record: ImuRecord, sensors: Sequence[Any], gravity_f: Array, density: float
) -> tuple[States, float]:
    """Return the states for the specified errors of a gyro and of sensors on a record, and the PSD of the flicker without a state, rad²/s.

    Each error is modelled as one draw from a normal distribution whose σ is its size, entry by entry; an error of zero is no state. Flicker
    is modelled by states with time constants a decade apart, from the record's duration down to the shortest that the measurements can
    resolve (their sum is 1/f within 6 %); flicker of higher frequency is white noise of the attitude and a σ of the reported bias.
    ``density`` is that of :func:`measurement_density`.
    """
    drift_sigma, drift_time, fast, white = _drifts(spec, record, density)
    force = np.abs(spec.g_sensitivity) if np.any(gravity_f) else np.zeros((3, 3))
    series = {vectors.sensor: vectors for vectors in record.vectors}
    matched_sensors = {}
    for sensor in sensors:
        if sensor.name in series and len(series[sensor.name].time):
            own = _of_sensor(sensor, series[sensor.name])
            if own != SensorStates():
                matched_sensors[sensor.name] = own
    states = States(
        gyro_scale_sigma=_entries(np.abs(spec.scale_factor)),
        gyro_misalignment_sigma=_entries(np.abs(spec.misalignment)),
        gyro_force_sigma=_entries(np.diag(force)),
        gyro_cross_force_sigma=_entries(force - np.diag(np.diag(force))),
        **_slope(spec, record),
        gyro_drift_sigma=drift_sigma,
        gyro_drift_time=drift_time,
        gyro_fast_bias_sigma=fast,
        gravity_f=tuple(gravity_f) if np.any(gravity_f) else vectors.GRAVITY_F,
        sensors=matched_sensors,
    )
    return states, white


def _slope(spec: GyroSpec, record: ImuRecord) -> dict[str, Any]:
    """Return the fields for the slope of the bias over temperature: its root mean square over the record combined with its σ."""
    if spec.temperature is None or record.temperature is None:
        return {}
    T = np.clip(record.temperature, *spec.temperature.span)
    if np.ptp(T) == 0.0:
        return {}
    steps, change = np.diff(T)[:, None], np.diff(spec.temperature.bias(T), axis=0)
    size = np.sqrt(
        np.sum(change * change / np.where(steps == 0.0, np.inf, np.abs(steps)), axis=0) / np.sum(np.abs(steps))
    )
    sigma = tuple(np.hypot(size, spec.temperature.slope_sigma).tolist())
    return {"gyro_temperature_sigma": sigma, "gyro_temperature_span": spec.temperature.span}


def _entries(values: Array) -> Entries:
    """Return entries as specified; 0 if all are zero."""
    entries: Any = values.tolist() if values.any() else 0.0
    return entries  # type: ignore[no-any-return]


def _drifts(
    spec: GyroSpec, record: ImuRecord, density: float
) -> tuple[tuple[float, ...], tuple[float, ...], float, float]:
    """Return σ and time constants of Gauss–Markov drifts, and σ, rad/s, and PSD, rad²/s, of the flicker above their bandwidth."""
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
    """Return the approximate bandwidth of the filter, rad/s: ``σ_v/√r`` for white noise, or the ω of ``r ω³ = B²/2`` if it is larger."""
    white = float(np.max(spec.angle_random_walk))
    instability = float(np.max(spec.bias_instability))
    return float(max(white / np.sqrt(density), (0.5 * instability**2 / density) ** (1.0 / 3.0)))


def _quicker(samples: int, step: float, instability: float, each: float, times: Array) -> float:
    """Return the variance of the simulated flicker at an edge minus that of the drifts, above their bandwidth, (rad/s)²."""
    lowest = step / (2.0 * np.pi * float(times[-1]) * np.sqrt(DECADE))
    f = np.geomspace(min(lowest, 0.1), 0.5, 4000)
    # The value at an edge is the mean of the intervals' values on either side.
    whole = instability**2 * flicker.shaping(samples).spectrum(f) * np.cos(np.pi * f) ** 2
    w = 2.0 * np.pi * f[:, None] / step
    held = np.sum(2.0 * each**2 * times / (1.0 + (w * times) ** 2), axis=1) / step
    return float(max(2.0 * np.trapezoid(whole - held, f), 0.0))


def _of_sensor(sensor: Any, series: VectorMeasurements) -> SensorStates:
    """Return the states for the specified errors of one sensor."""
    own = float(sensor.sigma) if hasattr(sensor, "sigma") else 0.0
    over, varying = 1.0, False
    if series.kind in ("direction", "heading") and own > 0.0 and hasattr(sensor, "field_f"):
        # The σ of the series is the sensor's noise divided by the field's magnitude.
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
        # Negligible on an axis without error.
        bias_sigma=_entries(np.where(size > 0.0, size, 1e-6 * float(size.max()))),
        correlated_sigma=coloured,
        correlation_time=float(faults.correlation_time) if faults is not None and coloured > 0.0 else 0.0,
        varying=varying and (coloured > 0.0 or bool(size.any())),
        lever_arm_sigma=_entries(arm),
    )


def noise_beside_states(spec: GyroSpec, white: float) -> dict[str, float]:
    """Return the two noises of a filter that has drifts as states; ``white`` is the PSD of flicker above their bandwidth, rad²/s."""
    walk = np.max(np.square(spec.rate_random_walk))
    if not np.isfinite(spec.markov_correlation_time):
        walk = np.max(np.square(spec.rate_random_walk) + np.square(spec.markov_noise))
    densities = {
        "angle_random_walk": float(np.sqrt(np.max(np.square(spec.angle_random_walk)) + white)),
        "rate_random_walk": float(np.sqrt(walk)),
    }
    _need_white(densities)
    return densities


def commutes_badly(record: ImuRecord, white: float) -> bool:
    """Return whether the drift of one-sample integration would be noticeable in the record."""
    better = coning.ALGORITHMS[ACCURATE_ALGORITHM]
    if len(record.increments) < MIN_SAMPLES:
        return False
    one_sample = coning.integrate(record.increments, coning.ALGORITHMS["one-sample"])[-1]
    other = coning.integrate(record.increments, better, edges=record.time)[-1]
    length = float(record.time[-1] - record.time[0])
    drift = float(np.linalg.norm(quaternion.rotation_between(one_sample, other))) / length
    return bool(drift > COMMUTATION_SHARE * white / np.sqrt(length))


def linear_sigma(record: ImuRecord) -> float:
    """Return the largest σ of the initial attitude for which the most precise sensor's first measurement is linear, rad, at most 1°."""
    finest = min((_finest(series) for series in record.vectors if len(series.time)), default=np.inf)
    return float(min(ATTITUDE_SIGMA, np.sqrt(LINEAR_SHARE * finest))) if finest > 0.0 else ATTITUDE_SIGMA


def _finest(series: VectorMeasurements) -> float:
    """Return the smallest σ of a series, rad."""
    if series.kind == "vector":
        return float(np.min(series.sigma / np.linalg.norm(series.references_f, axis=1)))
    return float(np.min(series.sigma if series.sigma_axes is None else series.sigma_axes))


def noise(spec: GyroSpec, record: ImuRecord) -> dict[str, float]:
    """Return the two noises of a filter without drifts as states; flicker is matched to the record's measurements, or its duration."""
    density = measurement_density(record)
    if not np.any(np.asarray(spec.bias_instability) > 0.0):
        densities = gyro.process_noise(spec)
    elif np.isfinite(density):
        densities = gyro.matched_process_noise(spec, density)
    else:
        densities = gyro.process_noise(spec, bandwidth=2.0 * np.pi / float(record.time[-1] - record.time[0]))
    _need_white(densities)
    return densities


def _need_white(densities: Mapping[str, float]) -> None:
    if densities["angle_random_walk"] == 0.0:
        raise InputError(
            "the gyro's specification has no angle random walk, but a filter needs one greater than zero; "
            "give it, or a filter setup"
        )


def measurement_density(record: ImuRecord) -> float:
    """Return the variance of a measurement about an axis times the interval between measurements, rad² s, for all sensors and axes."""
    information = sum(_information(series) for series in record.vectors)
    length = float(record.time[-1] - record.time[0])
    return length / information if information > 0.0 else float("inf")


def _information(series: VectorMeasurements) -> float:
    """Return Σ 1/σ² about an axis, the mean over the three axes, 1/rad²; without the samples of σ zero, which a filter refuses."""
    if series.attitude is not None:
        assert series.sigma_axes is not None
        return float(np.sum(series.sigma_axes[series.sigma_axes > 0.0] ** -2.0)) / 3.0
    known = are_finite(series.vector_b) & (series.sigma > 0.0)
    length = np.linalg.norm(series.references_f, axis=1) if series.kind == "vector" else np.ones(len(series.time))
    share = 1.0 / 3.0 if series.kind == "heading" else 2.0 / 3.0
    return share * float(np.sum((length[known] / series.sigma[known]) ** 2))
