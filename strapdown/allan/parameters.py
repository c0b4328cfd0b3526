"""Noise coefficients of gyros, accelerometers and magnetometers in the usual terms and units, and in the file formats of other programs.

The coefficients of :class:`strapdown.allan.NoiseFit` are SI of the sampled quantity: N in rad/s, m/s² or T per √Hz (the same as per
√Hz of a two-sided density, rad/√s), B in the unit itself, K in the unit per √s. Other programs use one number for all axes: the
largest. If no axis supports a term, the upper end of its interval is written, with a comment.

Kalibr
    ``imu.yaml``: noise densities N and random walks K of gyro and accelerometer, each with the interval of the maximum over the axes
    (:func:`largest_interval`) as a comment, since Kalibr has no key for it. They are commonly multiplied by 5 to 10 or more, because Kalibr
    has no terms for vibration, scale and temperature; here by the given factor, which is stated in a comment.
PX4
    Parameters of EKF2, which uses them as the standard deviation of white noise over one step of the filter, ``EKF2_PREDICT_US``:
    N/√dt for ``EKF2_GYR_NOISE`` (rad/s) and ``EKF2_ACC_NOISE`` (m/s²), K/√dt for ``EKF2_GYR_B_NOISE`` (rad/s²) and
    ``EKF2_ACC_B_NOISE`` (m/s³).
MATLAB
    ``gyroparams``, ``accelparams`` and ``magparams`` of ``imuSensor``, for each axis. ``NoiseType`` must be single-sided for N to be the
    Allan deviation at 1 s; with the default it is smaller by √2. The unit of the magnetometer is µT.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from strapdown import checks
from strapdown.allan import noise_fit
from strapdown.allan.noise_fit import UNITS, NoiseFit
from strapdown.checks import InputError

__all__ = ["to_kalibr", "to_matlab", "to_px4", "to_specification", "to_toml"]

PX4_STEP = 0.01
"""Default of EKF2_PREDICT_US in PX4, s."""
MATLAB = {
    "gyro": ("Gyroscope", "gyroparams", 1.0),
    "accelerometer": ("Accelerometer", "accelparams", 1.0),
    "magnetometer": ("Magnetometer", "magparams", 1e6),
}
"""Property, function and factor to its unit of each sensor in MATLAB."""


TURN_ON = [
    "Add turn_on_bias_sigma_deg_per_hour from the data sheet: one recording has no information",
    "about the variation of the bias between switch-ons, and filters then assume that it is near zero.",
]


def key(sensor: str, term: str) -> str:
    """Return the TOML key of a term, with its unit in the name."""
    unit = UNITS[sensor][term]
    return f"{unit.name}_{unit.suffix}"


def to_toml(fit: NoiseFit) -> dict[str, dict[str, Any]]:
    """Return the TOML table of a sensor: the terms that any axis supports, 0 on the other axes.

    Parameters
    ----------
    fit : NoiseFit
        Coefficients of one sensor.

    Returns
    -------
    dict
        Table with the unit in each key, to six digits; that of a gyro is the input of :func:`strapdown.gyro.read_spec`.
    """
    table = {}
    for term, value in noise_fit.to_gyro_parameters(fit).items():
        shown = [float(f"{x / UNITS[fit.sensor][term].factor:.6g}") for x in np.atleast_1d(value)]
        table[key(fit.sensor, term)] = shown if np.ndim(value) else shown[0]
    return {fit.sensor: table}


def to_specification(fit: NoiseFit, source: str) -> str:
    """Return the text of ``gyro.toml``, or that of another sensor: terms detected, and as comments bounds of the others and warnings.

    Parameters
    ----------
    fit : NoiseFit
        Coefficients of one sensor.
    source : str
        Description of the recording.

    Returns
    -------
    str
        TOML with comments.
    """
    import tomli_w

    sensor = fit.sensor
    lines = [f"{sensor.capitalize()} noise by `strapdown allan` from {source}."]
    lines += [f"WARNING: {warning}." for warning in fit.warnings]
    text = commented(lines) + "\n" + tomli_w.dumps(to_toml(fit))
    partly, wholly = [], []
    for term, bound in noise_fit.upper_bounds(fit).items():
        values = [f"{value / UNITS[sensor][term].factor:.4g}" for value in np.atleast_1d(bound)]
        supported = fit.supported[:, fit.terms.index(term)]
        if supported.any():
            below = (
                f"{axis} below {value}" for axis, value, own in zip("xyz", values, supported, strict=False) if not own
            )
            partly.append(f"{key(sensor, term)}: 0 where not detected, {', '.join(below)}.")
        else:
            joined = ", ".join(values)
            wholly.append(f"{key(sensor, term)} = {joined if len(values) == 1 else f'[{joined}]'}")
    if partly or wholly:
        level = f"{100 * fit.confidence_level:g} %"
        said = f"Not detected in the record, so left out; the upper ends of their {level} intervals:"
        text += "\n" + commented([said, *partly, *wholly])
    if sensor == "gyro":
        text += "\n" + commented(TURN_ON)
    return text


def commented(lines: list[str]) -> str:
    """Return lines as TOML comments."""
    return "".join(f"# {_plain(line)}\n" for line in lines)


def _index(fit: NoiseFit, term: str) -> int:
    """Return the place of a term in a fit."""
    if term not in fit.terms:
        raise InputError(f"the fit has no {term}; add it to the terms of the fit")
    return fit.terms.index(term)


def largest(fit: NoiseFit, term: str) -> tuple[float, bool]:
    """Return the maximum coefficient of a term over the axes, SI, and True, or if no axis supports it the maximum upper end and False."""
    i = _index(fit, term)
    supported = fit.supported[:, i]
    if supported.any():
        return float(fit.estimate[supported, i].max()), True
    return float(fit.upper[:, i].max()), False


def largest_interval(fit: NoiseFit, term: str) -> tuple[float, float]:
    """Return the confidence interval of the maximum coefficient over the axes, SI, at the level of the fit.

    Its lower end is the maximum of the axes' lower ends, its upper end the maximum of their upper ends. If the axes are equal, the interval
    fails if any lower end is too high, or if all upper ends are too low; if one axis is by far the largest, only its ends count. The tail
    probability of the lower ends is that for equal axes, the rest is that of the upper ends, so that the level holds in both cases. The
    ends are moved from the tails of the fit to these in the logarithm.
    """
    from scipy.special import ndtri

    i = _index(fit, term)
    tail = 1.0 - fit.confidence_level
    below = min(1.0 - fit.confidence_level ** (1.0 / len(fit.estimate)), 0.5 * tail)
    usual, supported = ndtri(0.5 * tail), fit.supported[:, i]
    centre = np.where(supported, fit.estimate[:, i], 1.0)

    def moved(end: np.ndarray, probability: float) -> float:
        return float(np.max(np.where(supported, centre * (end / centre) ** (ndtri(probability) / usual), end)))

    return moved(fit.lower[:, i], below), moved(fit.upper[:, i], tail - below)


def to_kalibr(fits: Mapping[str, NoiseFit], *, factor: float = 1.0, topic: str = "/imu0", source: str = "") -> str:
    """Return Kalibr's ``imu.yaml``.

    Parameters
    ----------
    fits : mapping of str to NoiseFit
        Fits of ``"gyro"`` and ``"accelerometer"``.
    factor : float, default 1.0
        Factor on all four numbers.
    topic : str, default "/imu0"
        Topic of the inertial unit.
    source : str, default ""
        Origin of the numbers, for a comment.

    Returns
    -------
    str
        Content of the file.
    """
    _both(fits, "Kalibr")
    checks.positive("factor", factor)
    words = "as identified" if factor == 1.0 else f"multiplied by {factor:g}"
    lines = _heading("#", source, f"the largest of the axes, {words}.")
    for name, sensor, term, unit in (
        ("accelerometer_noise_density", "accelerometer", "angle_random_walk", "m/s^2 1/sqrt(Hz)"),
        ("accelerometer_random_walk", "accelerometer", "rate_random_walk", "m/s^2 1/s/sqrt(Hz)"),
        ("gyroscope_noise_density", "gyro", "angle_random_walk", "rad/s 1/sqrt(Hz)"),
        ("gyroscope_random_walk", "gyro", "rate_random_walk", "rad/s 1/s/sqrt(Hz)"),
    ):
        value, supported = largest(fits[sensor], term)
        low, high = (factor * end for end in largest_interval(fits[sensor], term))
        interval = f"{100.0 * fits[sensor].confidence_level:g} % interval {low:.6e} to {high:.6e}"
        note = "" if supported else "; not detected, the upper end of its interval"
        lines.append(f"{name}: {factor * value:.6e}  # {unit}, {interval}{note}")
    lines += [f"update_rate: {1.0 / fits['gyro'].sample_interval:.6g}  # Hz", f"rostopic: {topic}"]
    return "\n".join(lines) + "\n"


def to_px4(fits: Mapping[str, NoiseFit], *, source: str = "") -> str:
    """Return parameters of PX4's EKF2 in QGroundControl's format.

    Parameters
    ----------
    fits : mapping of str to NoiseFit
        Fits of ``"gyro"`` and ``"accelerometer"``.
    source : str, default ""
        Origin of the numbers, for a comment.

    Returns
    -------
    str
        Content of the file.
    """
    _both(fits, "PX4")
    root = math.sqrt(PX4_STEP)
    lines = [
        *_heading("#", source, f"the largest of the axes, over steps of {1e6 * PX4_STEP:.0f} us (EKF2_PREDICT_US)."),
        "# The defaults of PX4 are larger: they include vibration.",
        "# Vehicle-Id Component-Id Name Value Type",
    ]
    for parameter, sensor, term in (
        ("EKF2_GYR_NOISE", "gyro", "angle_random_walk"),
        ("EKF2_GYR_B_NOISE", "gyro", "rate_random_walk"),
        ("EKF2_ACC_NOISE", "accelerometer", "angle_random_walk"),
        ("EKF2_ACC_B_NOISE", "accelerometer", "rate_random_walk"),
    ):
        value, supported = largest(fits[sensor], term)
        lines += [] if supported else [f"# {parameter}: not detected, the upper end of its interval"]
        lines.append(f"1\t1\t{parameter}\t{value / root:.6e}\t9")
    return "\n".join(lines) + "\n"


def to_matlab(fits: Mapping[str, NoiseFit], *, source: str = "") -> str:
    """Return MATLAB code for an ``imuSensor``, with noise per axis; a term that an axis does not support is 0.

    Parameters
    ----------
    fits : mapping of str to NoiseFit
        Fits by sensor.
    source : str, default ""
        Origin of the numbers, for a comment.

    Returns
    -------
    str
        MATLAB code.
    """
    rate = 1.0 / next(iter(fits.values())).sample_interval
    parts = {"accelerometer": "accel", "gyro": "gyro", "magnetometer": "mag"}
    kinds = "-".join(part for sensor, part in parts.items() if sensor in fits)
    if kinds not in ("accel-gyro", "accel-mag"):
        kinds = "accel-gyro-mag"
    lines = _heading("%", source, "SI; terms not detected on an axis are 0.")
    lines.append(f"imu = imuSensor('{kinds}', 'SampleRate', {rate:.6g});")
    for sensor, fit in fits.items():
        name, make, factor = MATLAB[sensor]
        values = np.where(fit.supported, fit.estimate, 0.0) * factor
        arguments = ["'NoiseType', 'single-sided'"]
        for term, word in (
            ("angle_random_walk", "NoiseDensity"),
            ("bias_instability", "BiasInstability"),
            ("rate_random_walk", "RandomWalk"),
        ):
            column = np.resize(values[:, _index(fit, term)], 3)
            arguments.append(f"'{word}', [{' '.join(f'{x:.6e}' for x in column)}]")
        joined = ", ...\n    ".join(arguments)
        lines.append(f"imu.{name} = {make}({joined});")
    return "\n".join(lines) + "\n"


def _heading(mark: str, source: str, words: str) -> list[str]:
    """Return the comments at the top of a file."""
    return [*([f"{mark} {_plain(source)}"] if source else []), f"{mark} Noise by `strapdown allan`, {words}"]


def _both(fits: Mapping[str, NoiseFit], what: str) -> None:
    for sensor in ("gyro", "accelerometer"):
        if sensor not in fits:
            raise InputError(f"{what} needs the noise of gyro and accelerometer; identify the {sensor} too")


def _plain(text: str) -> str:
    """Return a comment on one line, without the control characters that a file name may contain."""
    return "".join(c if c.isprintable() else "?" for c in text)
