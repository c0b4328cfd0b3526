"""Errors that neither the scenario nor the filter models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from strapdown import vectors
from strapdown.checks import InputError, known_keys, non_negative
from strapdown.results import ByValue
from strapdown.scenarios import Scenario

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
