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

from strapdown import checks, gyro
from strapdown.allan import noise_fit
from strapdown.allan.noise_fit import UNITS, NoiseFit, name
from strapdown.checks import InputError

__all__ = ["to_kalibr", "to_matlab", "to_px4", "to_specification", "to_toml"]

_KEYS = {"mm/s": "mm_per_s", "µg/√Hz": "ug_per_sqrt_hz", "µg": "ug", "µg/√h": "ug_per_sqrt_hour", "µg/h": "ug_per_hour"}
_KEYS |= {"nT s": "nt_s", "nT/√Hz": "nt_per_sqrt_hz", "nT": "nt", "nT/√h": "nt_per_sqrt_hour", "nT/h": "nt_per_hour"}
PX4_STEP = 0.01
"""Default of EKF2_PREDICT_US in PX4, s."""


def key(sensor: str, term: str) -> tuple[str, float]:
    """Return the TOML key of a term, with its unit in the name, and the factor of the unit to SI."""
    if sensor == "gyro":
        suffix, factor = gyro.FORM[term][0]
        return f"{term}_{suffix}", factor
    unit, factor = UNITS[checks.one_of("sensor", sensor, UNITS)][term]
    return f"{name(sensor, term)}_{_KEYS[unit]}", factor


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
    sensor = fit.sensor
    rounded: dict[str, Any] = {}
    for term, value in noise_fit.to_gyro_parameters(fit).items():
        factor = key(sensor, term)[1]
        rounded[term] = np.array([float(f"{x / factor:.6g}") for x in np.atleast_1d(value)]).reshape(np.shape(value))
    if sensor == "gyro":
        spec = gyro.GyroSpec(**{term: value * key(sensor, term)[1] for term, value in rounded.items()})
        return {sensor: gyro.to_table(spec)}
    return {sensor: {key(sensor, term)[0]: value.tolist() for term, value in rounded.items()}}


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
        name_of, factor = key(sensor, term)
        values = [bound] if isinstance(bound, float) else list(bound)
        supported = fit.supported[:, fit.terms.index(term)]
        if supported.any():
            below = ", ".join(
                f"{'xyz'[k]} below {values[k] / factor:.4g}" for k in range(len(values)) if not supported[k]
            )
            partly.append(f"{name_of}: 0 where not detected, {below}.")
        else:
            shown = ", ".join(f"{value / factor:.4g}" for value in values)
            wholly.append(f"{name_of} = {shown if len(values) == 1 else f'[{shown}]'}")
    if partly or wholly:
        text += "\n" + commented(
            [
                f"Not detected in the record, so left out; the upper ends of their {100 * fit.confidence_level:g} % intervals:",
                *partly,
                *wholly,
            ]
        )
    if sensor == "gyro":
        text += "\n" + commented(
            [
                "Add turn_on_bias_sigma_deg_per_hour from the data sheet: one recording has no information",
                "about the variation of the bias between switch-ons, and filters then assume that it is near zero.",
            ]
        )
    return text


def commented(lines: list[str]) -> str:
    """Return lines as TOML comments."""
    return "".join(f"# {_plain(line)}\n" for line in lines)


def largest(fit: NoiseFit, term: str) -> tuple[float, bool]:
    """Return the maximum coefficient of a term over the axes, SI, and True, or if no axis supports it the maximum upper end and False."""
    if term not in fit.terms:
        raise InputError(f"the fit has no {term}; add it to the terms of the fit")
    i = fit.terms.index(term)
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

    i = fit.terms.index(term)
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

    Raises
    ------
    InputError
        If a sensor or a term is missing.
    """
    _both(fits, "Kalibr")
    checks.positive("factor", factor)
    words = "as identified" if factor == 1.0 else f"multiplied by {factor:g}"
    lines = [
        f"# {_plain(source)}" if source else "",
        f"# Noise by `strapdown allan`, the largest of the axes, {words}.",
    ]
    for sensor, own, unit in (("accelerometer", "accelerometer", "m/s^2"), ("gyro", "gyroscope", "rad/s")):
        for term, word, per in (
            ("angle_random_walk", "noise_density", "1/sqrt(Hz)"),
            ("rate_random_walk", "random_walk", "1/s/sqrt(Hz)"),
        ):
            value, supported = largest(fits[sensor], term)
            low, high = (factor * end for end in largest_interval(fits[sensor], term))
            interval = f"{100.0 * fits[sensor].confidence_level:g} % interval {low:.6e} to {high:.6e}"
            note = "" if supported else "; not detected, the upper end of its interval"
            lines.append(f"{own}_{word}: {factor * value:.6e}  # {unit} {per}, {interval}{note}")
    lines += [f"update_rate: {1.0 / fits['gyro'].sample_interval:.6g}  # Hz", f"rostopic: {topic}"]
    return "\n".join(line for line in lines if line) + "\n"


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

    Raises
    ------
    InputError
        If a sensor or a term is missing.
    """
    _both(fits, "PX4")
    root = math.sqrt(PX4_STEP)
    lines = [
        *([f"# {_plain(source)}"] if source else []),
        f"# Noise by `strapdown allan`, the largest of the axes, over steps of {1e6 * PX4_STEP:.0f} us (EKF2_PREDICT_US).",
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
    objects = {"gyro": ("Gyroscope", "gyroparams", 1.0), "accelerometer": ("Accelerometer", "accelparams", 1.0)}
    objects["magnetometer"] = ("Magnetometer", "magparams", 1e6)
    rate = 1.0 / next(iter(fits.values())).sample_interval
    kinds = "-".join(
        word
        for sensor, word in (("accelerometer", "accel"), ("gyro", "gyro"), ("magnetometer", "mag"))
        if sensor in fits
    )
    known = {"accel-gyro", "accel-mag", "accel-gyro-mag"}
    lines = [
        *([f"% {_plain(source)}"] if source else []),
        "% Noise by `strapdown allan`, SI; terms not detected on an axis are 0.",
    ]
    lines.append(f"imu = imuSensor('{kinds if kinds in known else 'accel-gyro-mag'}', 'SampleRate', {rate:.6g});")
    for sensor, fit in fits.items():
        own, make, factor = objects[sensor]
        values = np.where(fit.supported, fit.estimate, 0.0) * factor
        parts = ["'NoiseType', 'single-sided'"]
        for term, word in (
            ("angle_random_walk", "NoiseDensity"),
            ("bias_instability", "BiasInstability"),
            ("rate_random_walk", "RandomWalk"),
        ):
            column = np.resize(values[:, fit.terms.index(term)], 3)
            parts.append(f"'{word}', [{' '.join(f'{x:.6e}' for x in column)}]")
        joined = ", ...\n    ".join(parts)
        lines.append(f"imu.{own} = {make}({joined});")
    return "\n".join(lines) + "\n"


def _both(fits: Mapping[str, NoiseFit], what: str) -> None:
    for sensor in ("gyro", "accelerometer"):
        if sensor not in fits:
            raise InputError(f"{what} needs the noise of gyro and accelerometer; identify the {sensor} too")


def _plain(text: str) -> str:
    """Return a comment on one line, without the control characters that a file name may contain."""
    return "".join(c if c.isprintable() else "?" for c in text)
