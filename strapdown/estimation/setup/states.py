"""Error states as part of a filter's setup: their declaration, as a table of a file, and as the filter's error states for a record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar

import numpy as np

from strapdown import units
from strapdown.checks import InputError, array, known_keys, non_negative, one_of, positive
from strapdown.estimation.error_states import (
    BoundedVelocity,
    ErrorStates,
    GaussMarkov,
    GyroForce,
    GyroGaussMarkov,
    GyroScale,
    GyroTemperature,
    LeverArm,
    SensorMounting,
    VectorBias,
)
from strapdown.files import tables
from strapdown.results import ByValue
from strapdown.vectors import GRAVITY_F, KINDS

Entries = float | tuple[float, ...] | tuple[tuple[float, ...], ...]
"""A standard deviation: one for all axes or entries, or one for each; 0: no state."""


def _entries(name: str, value: Any, shape: tuple[int, ...], unit: str) -> Entries:
    """Return a number, or nested tuples of an array of this shape; none may be negative."""
    if np.ndim(value) == 0:
        return non_negative(name, value, unit=unit)
    values = array(name, value, shape)
    if np.any(values < 0.0):
        index = tuple(int(i) for i in np.argwhere(values < 0.0)[0])
        raise InputError(f"{name}{list(index)} is {values[index]:g} {unit}; it must not be negative")
    rows: Any = values.tolist()
    return tuple(tuple(row) if isinstance(row, list) else row for row in rows)


VELOCITY = {"velocity_time": "s", "velocity_sigma": "m/s", "acceleration_time": "s", "position_time": "s"}
"""Fields of :class:`SensorStates` for a bounded velocity, and their units."""


@dataclass(frozen=True, kw_only=True)
class SensorStates:
    """Error states of one sensor, by their σ; 0: no such state.

    Parameters
    ----------
    mounting_sigma : float or tuple (3,), default 0.0
        σ of a small constant rotation of the sensor's axes from the body's, about each body axis, rad. A sensor of
        whole attitudes has ``bias_sigma`` instead.
    bias_sigma : float or tuple (3,), default 0.0
        σ of a constant bias on each body axis, such as hard iron: rad, or for whole vectors the unit of their
        reference.
    correlated_sigma : float, default 0.0
        Stationary σ of each component of a first-order Gauss–Markov noise, in the unit of ``bias_sigma``.
    correlation_time : float, default 0.0
        Correlation time of that noise, s; must be above zero if ``correlated_sigma`` is.
    frame : {"body", "fixed"}, default "body"
        Axes in which that noise is correlated.
    varying : bool, default False
        For a direction or heading whose reference changes in magnitude, as the earth's field does along an orbit: bias
        and correlated noise are constant in the sensor's own unit, and their σ above are relative to the magnitude at
        the root mean square σ of the series.
    lever_arm_sigma : float or tuple (3,), default 0.0
        σ of the position of an accelerometer relative to the point that does not accelerate, on each body axis, m.
    velocity_time : float, default 0.0
        Correlation time of the velocity of a hand-held unit, s, for the acceleration that its accelerometer measures
        (:class:`strapdown.estimation.error_states.BoundedVelocity`). Give also the next two.
    velocity_sigma : float, default 0.0
        Stationary σ of each component of the velocity, m/s, fixed axes.
    acceleration_time : float, default 0.0
        Correlation time of the acceleration, s.
    position_time : float, default 0.0
        Correlation time of the position, s; 0: the position is not bounded.
    """

    mounting_sigma: Entries = 0.0
    bias_sigma: Entries = 0.0
    correlated_sigma: float = 0.0
    correlation_time: float = 0.0
    frame: Literal["body", "fixed"] = "body"
    varying: bool = False
    lever_arm_sigma: Entries = 0.0
    velocity_time: float = 0.0
    velocity_sigma: float = 0.0
    acceleration_time: float = 0.0
    position_time: float = 0.0

    def __post_init__(self) -> None:
        """Check every field."""
        for name, unit in (("mounting_sigma", "rad"), ("bias_sigma", ""), ("lever_arm_sigma", "m")):
            value = _entries(name, getattr(self, name), (3,), unit)
            if name != "lever_arm_sigma" and np.any(value) and not np.all(value):
                raise InputError(f"{name} is {value}; give a value above zero for every axis, or leave it out")
            object.__setattr__(self, name, value)
        non_negative("correlated_sigma", self.correlated_sigma)
        non_negative("correlation_time", self.correlation_time, unit="s")
        if (self.correlated_sigma > 0.0) != (self.correlation_time > 0.0):
            raise InputError(
                f"correlated_sigma is {self.correlated_sigma:g} and correlation_time {self.correlation_time:g} s; "
                "give both above zero, or neither"
            )
        one_of("frame", self.frame, ("body", "fixed"))
        if not isinstance(self.varying, bool):
            raise InputError(f"varying is {self.varying!r}; it must be true or false")
        for name, unit in VELOCITY.items():
            non_negative(name, getattr(self, name), unit=unit)
        if any(getattr(self, name) > 0.0 for name in VELOCITY):
            self._velocity("accelerometer", 1.0)

    def _velocity(self, sensor: str, strength: float) -> BoundedVelocity:
        motion = {name: getattr(self, name) for name in VELOCITY}
        return BoundedVelocity(sensor=sensor, strength=strength, **motion)

    def _blocks(self, sensor: str, kind: str, gravity: float) -> list[ErrorStates]:
        """Return the error states of a sensor whose measurements are of this kind; a direction's specific force is divided by gravity."""
        one_of(f"{sensor}: kind", kind, KINDS)
        strength = 1.0 if kind == "vector" else gravity
        # Only beside a velocity is the vector known to be a specific force.
        own = "m/s²" if self.velocity_time > 0.0 else "unit of the reference"
        unit = {"vector": own, "attitude": "rad"}.get(kind, "1")
        blocks: list[ErrorStates] = []
        if np.any(self.mounting_sigma):
            blocks.append(SensorMounting(sensor=sensor, mounting_sigma=np.asarray(self.mounting_sigma)))
        if np.any(self.bias_sigma):
            bias_sigma = np.asarray(self.bias_sigma)
            blocks.append(VectorBias(sensor=sensor, bias_sigma=bias_sigma, varying=self.varying, unit=unit))
        if np.any(self.lever_arm_sigma):
            blocks.append(LeverArm(sensor=sensor, arm_sigma=np.asarray(self.lever_arm_sigma), strength=strength))
        if self.correlated_sigma > 0.0:
            blocks.append(
                GaussMarkov(
                    sensor=sensor,
                    noise_sigma=self.correlated_sigma,
                    correlation_time=self.correlation_time,
                    frame=self.frame,
                    varying=self.varying,
                    unit=unit,
                )
            )
        if self.velocity_time > 0.0:
            one_of(f"{sensor}: velocity_time needs an accelerometer; kind", kind, ("direction", "vector"))
            blocks.append(self._velocity(sensor, strength))
        return blocks


@dataclass(frozen=True, kw_only=True, eq=False)
class States(ByValue):
    """Error states of a filter in addition to attitude and bias, by their initial standard deviations; 0: no such state.

    Parameters
    ----------
    gyro_scale_sigma : float or tuple (3,), default 0.0
        σ of the gyro's scale factors, dimensionless, by axis.
    gyro_misalignment_sigma : float or tuple (3, 3), default 0.0
        σ of the gyro's misalignments, rad, by entry of its error matrix; zeros on the diagonal.
    gyro_symmetric : bool, default False
        Whether that matrix is symmetric: a pair of equal misalignments is one state.
    gyro_force_sigma : float or tuple (3,), default 0.0
        σ of the gyro's sensitivity to specific force along the same axis, rad/s per m/s², by axis.
    gyro_cross_force_sigma : float or tuple (3, 3), default 0.0
        σ of the gyro's sensitivity to specific force across axes, rad/s per m/s², by entry; zeros on the diagonal.
    gyro_temperature_sigma : float or tuple (3,), default 0.0
        σ of the slope of the gyro's bias over the temperature of the record, rad/s/K, by axis.
    gyro_temperature_span : (float, float), default (-inf, inf)
        Lowest and highest temperature of that slope, °C; beyond them the bias does not depend on temperature.
    gyro_drift_sigma : tuple of float, default empty
        Stationary σ of each Gauss–Markov part of the gyro's bias, rad/s; parts with correlation times a decade apart
        model flicker.
    gyro_drift_time : tuple of float, default empty
        Correlation time of each of these parts, s.
    gyro_fast_bias_sigma : float, default 0.0
        σ of the part of the gyro's bias with a bandwidth too large to be estimated, rad/s: no state, but included in the
        reported σ of the bias.
    gravity_f : tuple of float (3,), default strapdown.vectors.GRAVITY_F
        Acceleration of gravity in the fixed frame, m/s², for the gyro's sensitivity to specific force and for lever
        arms.
    sensors : mapping of str to SensorStates, default empty
        Error states of each sensor, by its name.
    """

    gyro_scale_sigma: Entries = 0.0
    gyro_misalignment_sigma: Entries = 0.0
    gyro_symmetric: bool = False
    gyro_force_sigma: Entries = 0.0
    gyro_cross_force_sigma: Entries = 0.0
    gyro_temperature_sigma: Entries = 0.0
    gyro_temperature_span: tuple[float, float] = (-np.inf, np.inf)
    gyro_drift_sigma: tuple[float, ...] = ()
    gyro_drift_time: tuple[float, ...] = ()
    gyro_fast_bias_sigma: float = 0.0
    gravity_f: tuple[float, ...] = GRAVITY_F
    sensors: Mapping[str, SensorStates] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check every field."""
        for name, shape, unit in (
            ("gyro_scale_sigma", (3,), ""),
            ("gyro_misalignment_sigma", (3, 3), "rad"),
            ("gyro_force_sigma", (3,), "rad s/m"),
            ("gyro_cross_force_sigma", (3, 3), "rad s/m"),
            ("gyro_temperature_sigma", (3,), "rad/s/K"),
        ):
            object.__setattr__(self, name, _entries(name, getattr(self, name), shape, unit))
        for name, unit in (("gyro_drift_sigma", "rad/s"), ("gyro_drift_time", "s")):
            values = tuple(float(v) for v in np.atleast_1d(array(name, np.atleast_1d(getattr(self, name)), ("k",))))
            object.__setattr__(self, name, tuple(positive(f"{name}[{k}]", v, unit=unit) for k, v in enumerate(values)))
        if len(self.gyro_drift_sigma) != len(self.gyro_drift_time):
            raise InputError(
                f"gyro_drift_sigma has {len(self.gyro_drift_sigma)} entries and gyro_drift_time {len(self.gyro_drift_time)}; "
                "give each part of the drift both"
            )
        non_negative("gyro_fast_bias_sigma", self.gyro_fast_bias_sigma, unit="rad/s")
        object.__setattr__(self, "gravity_f", tuple(array("gravity_f", self.gravity_f, (3,)).tolist()))
        object.__setattr__(self, "sensors", dict(self.sensors))
        for name, states in self.sensors.items():
            if not isinstance(states, SensorStates):
                raise InputError(f"sensors[{name!r}] is {states!r}; it must be SensorStates")
        self._gyro_blocks()

    def _gyro_blocks(self) -> list[ErrorStates]:
        """Return the error states of the gyro whose σ is above zero."""
        blocks: list[ErrorStates] = []
        if np.any(self.gyro_scale_sigma) or np.any(self.gyro_misalignment_sigma):
            scale, misalignment = np.asarray(self.gyro_scale_sigma), np.asarray(self.gyro_misalignment_sigma)
            blocks.append(GyroScale(scale_sigma=scale, misalignment_sigma=misalignment, symmetric=self.gyro_symmetric))
        if np.any(self.gyro_force_sigma) or np.any(self.gyro_cross_force_sigma):
            along, across = np.asarray(self.gyro_force_sigma), np.asarray(self.gyro_cross_force_sigma)
            blocks.append(GyroForce(along_sigma=along, across_sigma=across, gravity_f=np.array(self.gravity_f)))
        if np.any(self.gyro_temperature_sigma):  # negligible on an axis with σ 0
            slope = np.asarray(self.gyro_temperature_sigma)
            span = self.gyro_temperature_span
            blocks.append(GyroTemperature(slope_sigma=np.maximum(slope, 1e-6 * slope.max()), span=span))
        for sigma, time in zip(self.gyro_drift_sigma, self.gyro_drift_time, strict=True):
            blocks.append(GyroGaussMarkov(bias_sigma=sigma, correlation_time=time, name=f"gyro drift {time:g} s"))
        return blocks

    def blocks(self, kinds: Mapping[str, str]) -> tuple[ErrorStates, ...]:
        """Return all error states of a filter.

        Parameters
        ----------
        kinds : mapping of str to str
            Kind of measurement of each sensor, by its name.

        Returns
        -------
        tuple of ErrorStates
            Declarations of the gyro, then those of the sensors in the order of ``sensors``.
        """
        blocks, gravity = self._gyro_blocks(), float(np.linalg.norm(self.gravity_f))
        for name, states in self.sensors.items():
            known = one_of("states: sensor", name, kinds)
            blocks += states._blocks(known, kinds[known], gravity)
        return tuple(blocks)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the declared states, as :meth:`select` accepts them."""
        names = [f"gyro.{part}" for part, fields in _GYRO_PARTS.items() if _declared(self, fields)]
        for sensor, states in self.sensors.items():
            names += [f"{sensor}.{part}" for part, fields in _SENSOR_PARTS.items() if _declared(states, fields)]
        return tuple(names)

    @property
    def has_constants(self) -> bool:
        """Whether there are states for errors that are constant in a run and differ from unit to unit."""
        return any(not name.endswith((".drift", ".correlated")) for name in self.names)

    def select(self, names: tuple[str, ...]) -> States:
        """Return only the states with these names.

        Parameters
        ----------
        names : tuple of str
            Names from :attr:`names`.

        Returns
        -------
        States
            The same σ for these names, and 0 for all others.
        """
        for name in names:
            if not self.names:
                raise InputError(
                    f"states: {name!r} is requested, but no error with a state is specified; specify its size in the scenario, "
                    "such as scale_factor_ppm in [gyro], or leave it out"
                )
            one_of("states: name", name, self.names)
        sensors = {sensor: _kept(states, sensor, _SENSOR_PARTS, names) for sensor, states in self.sensors.items()}
        used = {sensor: states for sensor, states in sensors.items() if states._blocks(sensor, "direction", 1.0)}
        return replace(_kept(self, "gyro", _GYRO_PARTS, names), sensors=used)


_GYRO_PARTS = {
    "scale": ("gyro_scale_sigma",),
    "misalignment": ("gyro_misalignment_sigma",),
    "force": ("gyro_force_sigma", "gyro_cross_force_sigma"),
    "temperature": ("gyro_temperature_sigma",),
    "drift": ("gyro_drift_sigma",),
}
"""Fields that declare each state of the gyro, by name."""
_SENSOR_PARTS = {
    "mounting": ("mounting_sigma",),
    "bias": ("bias_sigma",),
    "lever": ("lever_arm_sigma",),
    "correlated": ("correlated_sigma",),
    "velocity": tuple(VELOCITY),
}
"""Fields that declare each state of a sensor, by name."""
_BESIDE = {
    "gyro_drift_sigma": ("gyro_drift_time", "gyro_fast_bias_sigma"),
    "gyro_temperature_sigma": ("gyro_temperature_span",),
    "correlated_sigma": ("correlation_time",),
}
"""Fields that belong to another field and declare no state."""
Part = TypeVar("Part", States, SensorStates)


def _declared(states: States | SensorStates, fields: tuple[str, ...]) -> bool:
    return any(np.any(getattr(states, field)) for field in fields)


def _kept(states: Part, owner: str, parts: Mapping[str, tuple[str, ...]], names: tuple[str, ...]) -> Part:
    """Return the states of an owner, the gyro or a sensor, for the given names."""
    none = type(states)()
    dropped = [field for part, fields in parts.items() if f"{owner}.{part}" not in names for field in fields]
    dropped += [beside for field in dropped for beside in _BESIDE.get(field, ())]
    return replace(states, **{field: getattr(none, field) for field in dropped})


# ------------------------------------------------------------------------------------------------------------------------- files

_FORCE: tables.Choice = (("deg_per_hour_per_g", units.DEGREE_PER_HOUR / units.STANDARD_GRAVITY), ("rad_s_per_m", 1.0))
_SPEED: tables.Choice = (("m_per_s", 1.0),)
FORM: tables.Form = {
    "gyro_scale_sigma": tables.PPM,
    "gyro_misalignment_sigma": tables.MILLIRADIANS,
    "gyro_symmetric": tables.FLAG,
    "gyro_force_sigma": _FORCE,
    "gyro_cross_force_sigma": _FORCE,
    "gyro_temperature_sigma": (("deg_per_hour_per_kelvin", units.DEGREE_PER_HOUR), ("rad_per_s_per_kelvin", 1.0)),
    "gyro_temperature_span": tables.DEGREES_CELSIUS,
    "gyro_drift_sigma": tables.DEGREES_PER_HOUR,
    "gyro_drift_time": tables.SECONDS,
    "gyro_fast_bias_sigma": tables.DEGREES_PER_HOUR,
    "gravity_f": tables.METRES_PER_SECOND_SQUARED,
}
"""Keys of the states of the gyro in files."""
SENSOR_FORM: tables.Form = {
    "mounting_sigma": tables.MILLIRADIANS,
    "bias_sigma": tables.PLAIN,
    "correlated_sigma": tables.PLAIN,
    "correlation_time": tables.SECONDS,
    "frame": tables.PLAIN,
    "varying": tables.FLAG,
    "lever_arm_sigma": tables.METRES,
    "velocity_time": tables.SECONDS,
    "velocity_sigma": _SPEED,
    "acceleration_time": tables.SECONDS,
    "position_time": tables.SECONDS,
}
"""Keys of the states of a sensor: its σ in rad, or for whole vectors in the unit of their reference."""


def to_table(states: States) -> dict[str, Any]:
    """Return states as a table of a file, units in the keys; exact in both directions."""
    table = tables.encode(states, FORM)
    if states.sensors:
        table["sensors"] = {name: tables.encode(states, SENSOR_FORM) for name, states in states.sensors.items()}
    return table


def from_table(table: Mapping[str, Any], place: str = "states") -> States:
    """Return the states in a table; an unknown key is an error that names the nearest known one."""
    known_keys(place, table, {*tables.keys(FORM), "sensors"})
    where = f"{place}: sensors"
    by_sensor = {}
    for name, content in tables.subtable(
        table.get("sensors", {}), where, f" of tables, [{place}.sensors.NAME]"
    ).items():
        own = tables.subtable(content, f"{where}: {name}", f", [{place}.sensors.{name}]")
        by_sensor[name] = tables.build(SensorStates, own, SENSOR_FORM, f"{where}: {name}")
    own = {key: value for key, value in table.items() if key != "sensors"}
    return tables.build(States, own, FORM, place, sensors=by_sensor)  # type: ignore[no-any-return]
