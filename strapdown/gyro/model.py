"""Specification of a gyro, and its tables in files."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from strapdown import units
from strapdown.checks import Array, InputError, array, finite, known_keys, non_negative, positive
from strapdown.files import tables
from strapdown.gyro import temperature as thermal
from strapdown.gyro.temperature import BiasOverTemperature
from strapdown.results import ByValue

Axes = float | Array
"""One number for all axes, or an array (3,) of one per axis."""


_BY_AXIS = {
    "angle_random_walk": "rad/√s",
    "bias_instability": "rad/s",
    "rate_random_walk": "rad/s/√s",
    "markov_noise": "rad/s/√s",
    "quantization": "rad",
    "rate_resolution": "rad/s",
    "turn_on_bias_sigma": "rad/s",
}
"""Non-negative fields, one number or one per axis, and their units."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroSpec(ByValue):
    """Parameters of a three-axis gyro, SI and radians. The defaults are those of a gyro without errors.

    Noise coefficients are one number for all axes, or one per axis.

    Parameters
    ----------
    angle_random_walk : float or ndarray (3,), default 0.0
        Angle random walk σ_v (N), rad/√s; 1 °/√h = π/10800 rad/√s. The filter has one for all axes, that of the noisiest.
    rate_random_walk : float or ndarray (3,), default 0.0
        Rate random walk σ_u (K) of the bias, rad/s/√s, from 0 at the first edge.
    bias_instability : float or ndarray (3,), default 0.0
        Bias instability B, rad/s: flicker of two-sided PSD B²/(2π f), stationary from the first sample; the floor of
        the Allan deviation is 0.664 B.
    quantization : float or ndarray (3,), default 0.0
        Quantisation Q, rad: the increments are integer multiples of Q√12 and the remainder is carried to the next; Allan variance 3Q²/τ².
    rate_ramp : float or ndarray (3,), default 0.0
        Rate ramp R, rad/s²: slope of the bias, which starts at 0 at the first edge.
    markov_noise : float or ndarray (3,), default 0.0
        Noise √q, rad/s/√s: it drives a Gauss–Markov bias ``ḃ = −b/τ + √q w``; its stationary standard deviation is √(qτ/2).
    markov_correlation_time : float, default inf
        Correlation time τ of that bias, s; stationary from the start if finite, a random walk from 0 if infinite.
    turn_on_bias : ndarray (3,), default zeros
        Constant bias, rad/s, body axes.
    turn_on_bias_sigma : float or ndarray (3,), default 0.0
        Standard deviation of a constant bias drawn in every run, rad/s.
    scale_factor : ndarray (3,), default zeros
        Scale-factor errors, dimensionless: the diagonal of M in the measured rate (I + M) w_b.
    asymmetry : ndarray (3,), default zeros
        Scale-factor asymmetry a, dimensionless: adds ``a |w|``, so that the scale factor is 1 + s ± a by the sign of the rate.
    misalignment : ndarray (3, 3), default zeros
        Off-diagonal part of M, rad; entry (i, j) is the fraction of the rate about axis j that axis i senses.
    g_sensitivity : ndarray (3, 3), default zeros
        Bias per specific force, rad/s per m/s², body axes.
    temperature : BiasOverTemperature, optional
        Bias over temperature in °C (:class:`strapdown.gyro.temperature.BiasOverTemperature`). Default: none.
    bandwidth : float, default inf
        Natural frequency of a second-order low-pass filter, Hz; needs uniform edges. Infinite: no filter.
    damping : float, default √½
        Damping ratio of the low-pass filter.
    range : float, default inf
        Maximum rate of an axis, rad/s; beyond it the output saturates.
    rate_resolution : float or ndarray (3,), default 0.0
        Resolution of a rate output, rad/s: each averaged rate is rounded separately, without carrying the remainder.
    sampling_jitter : float, default 0.0
        Standard deviation of the sampling instants about the nominal ones, s; below 0.4 sample intervals.
    timestamp_error : float, default 0.0
        Standard deviation of the time stamps about the nominal instants, s; below 0.4 sample intervals.
    timestamp_offset : float, default 0.0
        Delay of the time stamps after the nominal instants, s.
    drop_probability : float, default 0.0
        Probability that a sample is lost, independently of the others; 0 to below 1.

    Examples
    --------
    >>> from strapdown.units import DEGREE_PER_HOUR, DEGREE_PER_ROOT_HOUR
    >>> spec = GyroSpec(angle_random_walk=0.15 * DEGREE_PER_ROOT_HOUR, turn_on_bias_sigma=20.0 * DEGREE_PER_HOUR)
    >>> print(f"{spec.angle_random_walk:.3g} rad/√s, {spec.turn_on_bias_sigma:.3g} rad/s")
    4.36e-05 rad/√s, 9.7e-05 rad/s
    """

    angle_random_walk: Axes = 0.0
    rate_random_walk: Axes = 0.0
    bias_instability: Axes = 0.0
    quantization: Axes = 0.0
    rate_ramp: Axes = 0.0
    markov_noise: Axes = 0.0
    markov_correlation_time: float = np.inf
    turn_on_bias: Array = field(default_factory=lambda: np.zeros(3))
    turn_on_bias_sigma: Axes = 0.0
    scale_factor: Array = field(default_factory=lambda: np.zeros(3))
    asymmetry: Array = field(default_factory=lambda: np.zeros(3))
    misalignment: Array = field(default_factory=lambda: np.zeros((3, 3)))
    g_sensitivity: Array = field(default_factory=lambda: np.zeros((3, 3)))
    temperature: BiasOverTemperature | None = None
    bandwidth: float = np.inf
    damping: float = 0.7071067811865476
    range: float = np.inf
    rate_resolution: Axes = 0.0
    sampling_jitter: float = 0.0
    timestamp_error: float = 0.0
    timestamp_offset: float = 0.0
    drop_probability: float = 0.0

    def __post_init__(self) -> None:
        fields: dict[str, Any] = {name: _by_axis(name, getattr(self, name), unit) for name, unit in _BY_AXIS.items()}
        ramp: Any = self.rate_ramp
        fields["rate_ramp"] = (
            array("rate_ramp", ramp, (3,)) if np.ndim(ramp) else finite("rate_ramp", ramp, unit="rad/s²")
        )
        for name in ("turn_on_bias", "scale_factor", "asymmetry"):
            value = getattr(self, name)
            if not isinstance(value, (bool, str)) and np.ndim(value) == 0:
                value = np.full(3, finite(name, value))
            fields[name] = array(name, value, (3,))
        for name in ("misalignment", "g_sensitivity"):
            fields[name] = array(name, getattr(self, name), (3, 3))
        if np.any(np.diag(fields["misalignment"]) != 0.0):
            raise InputError("misalignment has entries on its diagonal; give those as scale_factor")
        for name, unit in (("scale_factor", "ppm"), ("asymmetry", "ppm"), ("misalignment", "mrad")):
            if (largest := np.max(np.abs(fields[name]))) > 1.0:
                raise InputError(f"{name} is up to {largest:g} and must not be above 1 (is it in {unit}?)")
        for name, unit in (("markov_correlation_time", "s"), ("bandwidth", "Hz"), ("range", "rad/s")):
            value = float(getattr(self, name))
            fields[name] = value if value == np.inf else positive(name, value, unit=unit)
        fields["damping"] = positive("damping", self.damping)
        for name in ("sampling_jitter", "timestamp_error"):
            fields[name] = non_negative(name, getattr(self, name), unit="s")
        fields["timestamp_offset"] = finite("timestamp_offset", self.timestamp_offset, unit="s")
        fields["drop_probability"] = non_negative("drop_probability", self.drop_probability)
        if self.drop_probability >= 1.0:
            raise InputError(f"drop_probability is {self.drop_probability:g}; it must be below 1")
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @property
    def error_matrix(self) -> Array:
        """M of ``(I + M) w_b``: scale factors on the diagonal, misalignments off it."""
        return self.misalignment + np.diag(self.scale_factor)

    @property
    def quantization_step(self) -> Axes:
        """Quantisation step of the increments, Q√12, rad."""
        return self.quantization * float(np.sqrt(12.0))


def _by_axis(name: str, value: Any, unit: str) -> Axes:
    if np.ndim(value) == 0:
        return non_negative(name, value, unit=unit)
    values = array(name, value, (3,))
    for k, number in enumerate(values):
        non_negative(f"{name}[{k}]", number, unit=unit)
    return values


FORM: tables.Form = {
    "angle_random_walk": (("deg_per_sqrt_hour", units.DEGREE_PER_ROOT_HOUR), ("rad_per_sqrt_s", 1.0)),
    "rate_random_walk": (
        ("deg_per_hour_per_sqrt_hour", units.DEGREE_PER_HOUR_PER_ROOT_HOUR),
        ("rad_per_s_per_sqrt_s", 1.0),
    ),
    "bias_instability": tables.DEGREES_PER_HOUR,
    "quantization": (("arcsec", units.ARCSECOND), ("rad", 1.0)),
    "rate_ramp": (("deg_per_hour_per_hour", units.DEGREE_PER_HOUR / 3600.0), ("rad_per_s2", 1.0)),
    "markov_noise": (
        ("deg_per_hour_per_sqrt_hour", units.DEGREE_PER_HOUR_PER_ROOT_HOUR),
        ("rad_per_s_per_sqrt_s", 1.0),
    ),
    "markov_correlation_time": tables.SECONDS,
    "turn_on_bias": tables.DEGREES_PER_HOUR,
    "turn_on_bias_sigma": tables.DEGREES_PER_HOUR,
    "scale_factor": tables.PPM,
    "asymmetry": tables.PPM,
    "misalignment": tables.MILLIRADIANS,
    "g_sensitivity": (("deg_per_hour_per_g", units.DEGREE_PER_HOUR / units.STANDARD_GRAVITY), ("rad_s_per_m", 1.0)),
    "bandwidth": tables.HERTZ,
    "damping": tables.RATIO,
    "range": tables.DEGREES_PER_SECOND,
    "rate_resolution": tables.DEGREES_PER_SECOND,
    "sampling_jitter": tables.SECONDS,
    "timestamp_error": tables.SECONDS,
    "timestamp_offset": tables.SECONDS,
    "drop_probability": tables.RATIO,
}
"""Keys of the specification in files, except the table ``temperature``."""


def to_table(spec: GyroSpec) -> dict[str, Any]:
    """Return the fields that differ from the defaults as a table for TOML or JSON, with the units in the keys; read back exactly."""
    warm = {} if spec.temperature is None else {"temperature": thermal.to_table(spec.temperature)}
    return tables.encode(spec, FORM) | warm


def from_table(table: Mapping[str, Any], place: str = "gyro", base: GyroSpec | None = None) -> GyroSpec:
    """Return the specification of a table with the units in the keys; with ``base``, the table has the changes to it."""
    known_keys(place, table, [*tables.keys(FORM), "temperature", *(["preset"] if base else [])])
    own = {key: value for key, value in table.items() if key != "temperature"}
    values = tables.decode(own, FORM, place)
    if "temperature" in table:
        values["temperature"] = thermal.from_table(table["temperature"], f"{place}: temperature")
    return tables.construct(functools.partial(replace, base or GyroSpec()), values, own, FORM, place)  # type: ignore[no-any-return]


def read_spec(path: str | os.PathLike[str]) -> GyroSpec:
    """Read the table ``[gyro]`` of a TOML file, as written by ``strapdown allan``.

    Parameters
    ----------
    path : path-like
        File.

    Returns
    -------
    GyroSpec
        The specification.
    """
    return tables.read(path, "gyro", "`strapdown allan` writes one", from_table)
