"""Errors that neither the scenario nor the filter models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from strapdown import vectors
from strapdown.checks import InputError, instance, known_keys, non_negative, one_of
from strapdown.results import ByValue
from strapdown.scenarios import Scenario
from strapdown.units import ARCSECOND, DEGREE, DEGREE_PER_HOUR, STANDARD_GRAVITY

LARGEST_SIZE = 1e12
"""Maximum considered or initial error, in the units of :class:`Consider`; keeps its square in the range of doubles."""


def checked_size(name: str, value: float, *, unit: str = "") -> float:
    """Return the size of an error, checked to be zero or more and at most :data:`LARGEST_SIZE`."""
    size = non_negative(name, value, unit=unit)
    if size > LARGEST_SIZE:
        raise InputError(
            f"{name} is {size:g}{f' {unit}' if unit else ''}; no error is larger than {LARGEST_SIZE:g}: check its unit"
        )
    return size


@dataclass(frozen=True, kw_only=True, eq=False)
class Consider(ByValue):
    """Errors that neither the scenario nor the filter models: a standard deviation each, independent on every axis.

    Parameters
    ----------
    scale_factor : float, default 0.0
        σ of the gyro's three scale factors, dimensionless.
    misalignment : float, default 0.0
        σ of the six off-diagonal entries of the gyro's error matrix, rad.
    g_sensitivity : float, default 0.0
        σ of the nine entries of the gyro's g-sensitivity, rad/s per m/s².
    sensor_bias : mapping of str to float, default empty
        By sensor, σ of a constant error of each component, body axes, in the unit of the sensor's σ: T for a hard iron, rad for a
        direction.
    mounting : mapping of str to float, default empty
        By sensor, σ of the mounting rotation about each body axis, rad.
    time_offset : mapping of str to float, default empty
        By sensor, σ of the delay of its measurements after their stamps, s.
    """

    scale_factor: float = 0.0
    misalignment: float = 0.0
    g_sensitivity: float = 0.0
    sensor_bias: Mapping[str, float] = field(default_factory=dict)
    mounting: Mapping[str, float] = field(default_factory=dict)
    time_offset: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check every number."""
        checked_size("scale_factor", self.scale_factor)
        checked_size("misalignment", self.misalignment, unit="rad")
        checked_size("g_sensitivity", self.g_sensitivity, unit="rad/s per m/s²")
        for name in ("sensor_bias", "mounting", "time_offset"):
            values = getattr(self, name)
            if not isinstance(values, Mapping):
                raise InputError(f"{name} is {values!r}; give a number for each sensor by its name")
            checked = {str(sensor): checked_size(f"{name}[{sensor!r}]", value) for sensor, value in values.items()}
            object.__setattr__(self, name, checked)


def check_considered(scenario: Scenario, consider: Consider) -> None:
    """Raise if the scenario cannot have a considered error."""
    instance("consider", consider, Consider, "give covariance.Consider(scale_factor=3e-4, …), SI")
    names = [sensor.name for sensor in scenario.sensors]
    for part in ("sensor_bias", "mounting", "time_offset"):
        known_keys(f"consider: {part}", getattr(consider, part), names)
    for name in consider.sensor_bias:
        if isinstance(scenario.sensors[names.index(name)], vectors.HeadingPair):
            raise InputError(f"consider: sensor_bias of {name}: a heading pair has none; consider its mounting")
    for name, offset in consider.time_offset.items():
        if offset >= scenario.duration:
            raise InputError(
                f"consider: time_offset of {name} is {offset:g} s, and the scenario lasts {scenario.duration:g} s; "
                "give an offset shorter than the scenario, in seconds"
            )


def considered(sizes: Mapping[str, float], sensors: Sequence[Any]) -> dict[str, Any]:
    """Return 1σ of errors by name, in the units of a data sheet, as arguments of :func:`strapdown.covariance_analysis`.

    scale_factor in ppm, misalignment in mrad, g_sensitivity in °/h/g; SENSOR.bias in nT, m/s² or arcsec by its kind, SENSOR.mounting in
    arcsec, SENSOR.delay in ms; initial.attitude in °, initial.bias in °/h.
    """
    units_of = {"scale_factor": 1e-6, "misalignment": 1e-3, "g_sensitivity": DEGREE_PER_HOUR / STANDARD_GRAVITY}
    units_of |= {"initial.attitude": DEGREE, "initial.bias": DEGREE_PER_HOUR}
    fields = {"bias": "sensor_bias", "mounting": "mounting", "delay": "time_offset"}
    for sensor in sensors:
        bias = {vectors.Magnetometer: 1e-9, vectors.Accelerometer: 1.0}.get(type(sensor), ARCSECOND)
        units_of |= zip((f"{sensor.name}.{what}" for what in fields), (bias, ARCSECOND, 1e-3), strict=True)
    errors: dict[str, Any] = {field: {} for field in fields.values()}
    initial: dict[str, float] = {}
    for name, size in sizes.items():
        one_of("consider", name, units_of)
        value = non_negative(f"consider {name}", size) * units_of[name]
        sensor, _, what = name.rpartition(".")
        if sensor == "initial":
            initial[f"initial_{what}_sigma"] = value
        else:
            (errors[fields[what]] if sensor else errors)[sensor or name] = value
    return {"consider": Consider(**errors), **initial}
