"""Calibration of a unit from recordings in which it is turned by hand, with or without rests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from strapdown.calibration import fitting
from strapdown.calibration.fitting import Fit, Prior, Problem, Unknowns
from strapdown.calibration.intervals import Intervals, gathered, predicted
from strapdown.calibration.unit import SensorErrors, UnitCalibration, printed
from strapdown.checks import Array, InputError, instance, positive
from strapdown.recordings import Recording
from strapdown.units import DEGREE, STANDARD_GRAVITY

GYRO_SIGMA, FORCE_SIGMA = 0.02, 0.01
"""Prior σ of the entries of the matrices of gyro and accelerometer: tolerances of data sheets are up to 3 and 1 %."""
FORCE_BIAS_SIGMA = 0.3
"""Prior σ of the accelerometer's bias, m/s²; data sheets have up to 80 mg."""
IRON_SIGMA, SOFT_IRON_SIGMA = 1.0, 0.3
"""Prior σ of the hard iron about its first estimate, relative to the field, and of the entries of the magnetometer's matrix."""
DELAY_SIGMA = 0.01
"""Prior σ of the delays, s."""
DIP_SIGMA = 1.0
"""Prior σ of the dip, rad."""
AVERAGED = 2.0
"""Duration before and after a node over which vertical and field are averaged for its initial attitude, s."""
MOVED_RATE = 0.1
"""Spread of the rate, rad/s, above which no second of a part is treated as a rest."""
PLAUSIBLE = 3.5
"""Largest plausible error of a unit, relative to the prior σ. Of 15 recordings of four public sets, units in the hand have up to 3.2."""
WANTED = {
    "gyro_bias": 0.05 * DEGREE,
    "gyro_matrix": 2e-3,
    "accelerometer_bias": 0.03,
    "accelerometer_matrix": 3e-3,
    "hard_iron": 0.01,
    "magnetometer_matrix": 0.01,
    "accelerometer_delay": 3e-3,
    "magnetometer_delay": 3e-3,
}
"""Largest σ of each field of a good calibration; the hard iron's relative to the field."""


def calibrate(recordings: Recording | Sequence[Recording], *, gravity: float = STANDARD_GRAVITY) -> UnitCalibration:
    """Estimate the errors of a unit's sensors, each with its σ, from recordings of motion by hand.

    The unit is turned about all its axes for a minute or more, best with pauses of a few seconds in different positions. Estimated are
    bias, scale factors and misalignments of gyro and accelerometer, hard and soft iron of the magnetometer, and the delays of the
    accelerometer and the magnetometer relative to the gyro (:mod:`strapdown.calibration.fitting`).

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Recordings of one unit, each with an accelerometer. The magnetometer is calibrated if all have one.
    gravity : float, default 9.80665
        Gravity at the place, m/s².

    Returns
    -------
    UnitCalibration
        Errors with σ, for :func:`strapdown.estimate` and :func:`strapdown.calibration.write`; its ``remarks`` name the motion that is
        missing for the errors whose σ is large.

    References
    ----------
    D. Tedaldi, A. Pretto, E. Menegatti, A robust and easy to implement method for IMU calibration without external equipments, ICRA 2014.

    Examples
    --------
    >>> import strapdown as sd
    >>> unit = sd.calibrate(sd.read("turned-by-hand.csv"))  # doctest: +SKIP
    >>> print(unit)  # doctest: +SKIP
    >>> estimate = sd.estimate(sd.read("walk.csv"), calibration=unit)  # doctest: +SKIP
    """
    used: list[Any] = list(recordings) if isinstance(recordings, (list, tuple)) else [recordings]
    if not used:
        raise InputError("recordings is empty; give at least one recording")
    for recording in used:
        instance("recordings", recording, Recording, "give recordings, as read returns them")
    units = {recording.magnetic_unit for recording in used}
    if len(units) > 1:
        raise InputError(f"the units of the fields are {', '.join(map(repr, units))}; declare one unit for all")
    intervals = gathered(used)
    if len(intervals.node) < 4 * 10:
        raise InputError(f"the recordings last {np.sum(intervals.length):.3g} s; a calibration needs at least 10 s")
    bias = _resting_bias(intervals)
    strength, intervals, prior = _priors(intervals, bias)
    attitude = _initial_attitude(intervals, prior.mean, bias)
    nodes = np.zeros((len(intervals.node_rate), 12 if intervals.field is not None else 9))
    nodes[:, fitting.GYRO_BIAS - 3 : fitting.GYRO_BIAS] = bias
    problem = Problem(intervals, prior, positive("gravity", gravity, unit="m/s²"))
    fit = fitting.solve(problem, Unknowns(prior.mean.copy(), attitude, nodes))
    return _result(fit, prior, strength, used)


def _resting_bias(intervals: Intervals) -> Array:
    """Return the mean rate of the quietest second of each part, at its nodes (n, 3); 0 for a part without rest."""
    bias = np.zeros((len(intervals.node_rate), 3))
    for nodes in np.split(np.arange(len(bias)), intervals.first[1:]):
        inside = np.isin(intervals.node, nodes)
        length = intervals.length[inside][:, None]
        mean = intervals.angle[inside].sum(axis=1) / length
        known = intervals.step[inside][:, :, None] > 0.0
        spread = np.sqrt(np.mean(known * (intervals.rate[inside] - mean[:, None]) ** 2, axis=1)).sum(axis=1)
        restless = np.convolve(spread + 0.5 * np.linalg.norm(mean, axis=1), np.full(4, 0.25), mode="valid")
        k = int(np.argmin(restless))
        if spread[k : k + 4].mean() < MOVED_RATE:
            bias[nodes] = mean[k : k + 4].mean(axis=0)
    return bias


def _gyro_frames(intervals: Intervals, turn: Array) -> Array:
    """Return the attitude by the gyro only at every node (n, 3, 3), identity at the start of each part."""
    frames = np.tile(np.eye(3), (len(intervals.node_rate), 1, 1))
    for k, node in enumerate(intervals.node):
        frames[node + 1] = frames[node] @ turn[k]
    return frames


def _priors(intervals: Intervals, bias: Array) -> tuple[float, Intervals, Prior]:
    """Return the strength of the field, the intervals with the field divided by it, and the prior of the sensor errors.

    The first estimate of the hard iron is that with which the field, in the frame fixed by the gyro, changes least over a second.
    """
    mean = np.zeros(fitting.IRON.start)
    sigma = np.repeat([GYRO_SIGMA, FORCE_BIAS_SIGMA, FORCE_SIGMA, DELAY_SIGMA], [9, 3, 6, 1])
    if intervals.field is None:
        return 1.0, intervals, Prior(mean, sigma)
    p = predicted(intervals, fitting.unpacked(mean), bias[intervals.node])
    frame = _gyro_frames(intervals, p.turn)[intervals.node]
    assert p.field is not None
    value, by_iron = np.einsum("kij,kj->ki", frame, p.field.value), frame @ p.field.by_own[:, :, :3]
    lag = round(1.0 / float(np.median(intervals.length)))
    pair = (intervals.node[lag:] - intervals.node[:-lag] == lag) & (
        intervals.field.number[lag:] * intervals.field.number[:-lag] > 0.0
    )
    A, b = ((x[lag:] - x[:-lag])[pair] for x in (by_iron, value))
    A, b = A.reshape(-1, 3), -b.ravel()
    iron = np.linalg.solve(A.T @ A + 0.03 * np.eye(3), A.T @ b)
    samples = intervals.field.samples[intervals.field.known > 0.0]
    strength = float(np.median(np.linalg.norm(samples - iron, axis=1)))
    field = intervals.field._replace(samples=intervals.field.samples / strength, noise=intervals.field.noise / strength)
    mean = np.concatenate([mean, iron / strength, np.zeros(11)])
    scaled = intervals._replace(field=field)
    vertical = predicted(scaled, fitting.unpacked(mean), bias[intervals.node])
    assert vertical.field is not None
    up, north = vertical.force.value, vertical.field.value
    sine = np.sum(up * north, axis=1) / np.linalg.norm(up, axis=1) / np.linalg.norm(north, axis=1)
    mean[fitting.DIP] = -np.arcsin(np.median(sine))
    more = np.repeat([IRON_SIGMA, SOFT_IRON_SIGMA, DELAY_SIGMA, DIP_SIGMA], [3, 9, 1, 1])
    return strength, scaled, Prior(mean, np.concatenate([sigma, more]))


def _initial_attitude(intervals: Intervals, errors: Array, bias: Array) -> Array:
    """Return the attitude at the nodes (n, 3, 3) from vertical and field averaged in the frame fixed by the gyro.

    Without a field the heading is that of the gyro.
    """
    p = predicted(intervals, fitting.unpacked(errors), bias[intervals.node])
    frames = _gyro_frames(intervals, p.turn)
    means = [p.force] if p.field is None else [p.force, p.field]
    vectors = [np.einsum("kij,kj->ki", frames[intervals.node], m.value) for m in means]
    width = round(AVERAGED / float(np.median(intervals.length)))
    attitude = np.empty_like(frames)
    for nodes in np.split(np.arange(len(frames)), intervals.first[1:]):
        inside = np.flatnonzero(np.isin(intervals.node, nodes))
        east = np.eye(3)[0]
        for k, node in enumerate(nodes):
            near = inside[max(0, k - width) : k + width]
            up = _unit(vectors[0][near].mean(axis=0))
            across = np.cross(vectors[1][near].mean(axis=0), up) if p.field is not None else east - up * (east @ up)
            east = _unit(across)
            attitude[node] = np.stack([east, np.cross(up, east), up]) @ frames[node]
    return attitude


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))


def _sensor_errors(x: Array, bias: Array, strength: float) -> SensorErrors:
    """Return sensor errors, or their σ, from a vector of unknowns."""
    errors = fitting.unpacked(x)
    return SensorErrors(gyro_bias=bias, **errors._replace(hard_iron=errors.hard_iron * strength)._asdict())


def _result(fit: Fit, prior: Prior, strength: float, recordings: Sequence[Recording]) -> UnitCalibration:
    """Return the calibration of a fit, with its remarks."""
    x, covariance = fit.unknowns.errors.copy(), fit.covariance.copy()
    if len(x) > fitting.IRON.start:
        # The strength of the field is unknown, so the mean scale factor of the magnetometer is set to 1.
        A = np.eye(3).ravel() + x[fitting.FIELD]
        mean = (A[0] + A[4] + A[8]) / 3.0
        x[fitting.FIELD] = A / mean - np.eye(3).ravel()
        J = np.eye(len(covariance))
        J[fitting.FIELD, fitting.FIELD] = (np.eye(9) - np.outer(A / mean, np.eye(3).ravel()) / 3.0) / mean
        covariance = J @ covariance @ J.T
    sigma = np.sqrt(np.diag(covariance))
    values = _sensor_errors(x, fit.unknowns.bias[-1], strength)
    unit = UnitCalibration(
        **vars(values),
        sigma=_sensor_errors(sigma[:-3], sigma[-3:], strength),
        magnetic_unit=recordings[0].magnetic_unit if len(prior.mean) > fitting.IRON.start else "",
        source=", ".join(dict.fromkeys(recording.source for recording in recordings)),
    )
    doubt = implausible(unit)
    refused = (
        f"Do not use this calibration: {doubt}; acceleration that lasts, as in a flight or a vehicle, was mistaken for it. "
        "Turn the unit by hand, in one place."
    )
    return replace(unit, remarks=((refused,) if doubt else ()) + missing(unit, strength))


def implausible(calibration: UnitCalibration) -> str:
    """Return the largest of the errors of gyro and accelerometer that no unit has, in words; empty if there is none."""
    prior = {"gyro_matrix": GYRO_SIGMA, "accelerometer_bias": FORCE_BIAS_SIGMA, "accelerometer_matrix": FORCE_SIGMA}
    errors = [(name, axes, error) for name, axes, error in calibration.entries() if name in prior]
    name, axes, worst = max(errors, key=lambda entry: abs(entry[2]) / prior[entry[0]])
    if abs(worst) <= PLAUSIBLE * prior[name]:
        return ""
    words, unit, factor = printed(name, axes, calibration.magnetic_unit)
    return f"its {words} of {worst / factor:.2g} {unit} is that of no unit"


def missing(calibration: UnitCalibration, strength: float = 1.0) -> tuple[str, ...]:
    """Return the motion that is missing for errors whose σ exceeds :data:`WANTED`, each with the worst of them.

    ``strength`` is that of the field, in the unit of the hard iron.
    """
    lacking: dict[str, tuple[float, str]] = {}
    for name, axes, sigma in calibration.sigma.entries():
        wanted = WANTED[name] * (strength if name == "hard_iron" else 1.0)
        motion = _motion(name, axes)
        if sigma > wanted and sigma / wanted > lacking.get(motion, (0.0, ""))[0]:
            words, unit, factor = printed(name, axes, calibration.magnetic_unit)
            sentence = f"σ of {words} is {sigma / factor:.2g} {unit}, good is {wanted / factor:.2g}"
            lacking[motion] = sigma / wanted, sentence
    return tuple(f"{motion}: {worst}." for motion, (_, worst) in lacking.items())


def _motion(name: str, axes: str) -> str:
    """Return the motion by which an error becomes observable."""
    if name == "gyro_bias":
        return "Rest longer at the end"
    if name == "gyro_matrix":
        return f"Turn about {axes[-1]} by half a turn or more, back and forth, with a rest before and after"
    if name in ("accelerometer_bias", "accelerometer_matrix"):
        return f"Rest with {axes} up and with {axes} down" if len(axes) == 1 else "Rest on edges and corners too"
    return "Turn faster" if name.endswith("delay") else "Turn into all attitudes, away from iron"
