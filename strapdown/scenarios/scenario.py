"""A scenario: a motion, a gyro and sensors."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from strapdown import vectors
from strapdown.checks import Array, InputError, array, count, finite, instance, positive
from strapdown.gyro import BEFORE_RANGE, GyroSpec, simulate
from strapdown.motion import Motion
from strapdown.motion.protocol import break_times
from strapdown.results import ByValue
from strapdown.units import DEGREE
from strapdown.vectors import Sensor

MAX_SAMPLES = 1e9
"""Maximum number of gyro samples of a simulated record; more do not fit into memory."""


@dataclass(frozen=True, kw_only=True)
class Temperature:
    """Temperature of the unit: an exponential change, or without a time constant a linear change over the record.

    Parameters
    ----------
    start : float
        Temperature at the start, °C.
    end : float
        Final temperature of the exponential, or without a time constant the temperature at the end of the record, °C.
    time_constant : float, default inf
        Thermal time constant, s; infinite: linear change.
    """

    start: float
    end: float
    time_constant: float = np.inf

    def __post_init__(self) -> None:
        finite("start", self.start, unit="°C")
        finite("end", self.end, unit="°C")
        if self.time_constant != np.inf:
            positive("time_constant", self.time_constant, unit="s")

    def _at(self, time: Array) -> Array:
        """Return the temperature at the edges of a record (n + 1,), °C."""
        elapsed = time - time[0]
        share = elapsed / elapsed[-1] if self.time_constant == np.inf else -np.expm1(-elapsed / self.time_constant)
        return np.asarray(self.start + (self.end - self.start) * share)


@dataclass(frozen=True, kw_only=True, eq=False)
class Scenario(ByValue):
    """A motion, a gyro and sensors, with sample rate and duration.

    Parameters
    ----------
    motion : Motion
        True attitude and body rate over time (:mod:`strapdown.motion`).
    gyro : GyroSpec
        Specification of the gyro's errors.
    sensors : tuple of Sensor
        Vector, attitude and heading sensors (:mod:`strapdown.vectors`), each with a different name.
    rate : float
        Sample rate of the gyro, Hz.
    duration : float
        Duration of the record, s; rounded to whole gyro samples.
    name : str, default ""
        Name in files and tables.
    description : str, default ""
        Description in one sentence.
    seed : int, default 0
        Default seed of :func:`simulate`.
    gravity_f : tuple of 3 floats, default (0, 0, -9.80665)
        Gravity, m/s², fixed frame; a g-sensitive gyro responds to its reaction. Zeros in free fall.
    gyro_preset : str, default ""
        Name of the preset equal to ``gyro``, for files.
    temperature : Temperature, optional
        Temperature of the unit, °C, on which the gyro's bias may depend; it is recorded. Default: none.

    Examples
    --------
    >>> import strapdown as sd
    >>> scenario = sd.Scenario(
    ...     motion=sd.motion.Coning(angle=0.7 * sd.units.DEGREE, frequency=10.0),
    ...     gyro=sd.GyroSpec(angle_random_walk=0.08 * sd.units.DEGREE_PER_ROOT_HOUR),
    ...     sensors=(sd.VectorSensor(name="star", reference_f=[1.0, 0.0, 0.0], sigma=1e-4, rate=1.0),),
    ...     rate=100.0,
    ...     duration=60.0,
    ... )
    >>> len(scenario.edges)
    6001
    """

    motion: Motion
    gyro: GyroSpec
    sensors: tuple[Sensor, ...]
    rate: float
    duration: float
    name: str = ""
    description: str = ""
    seed: int = 0
    gravity_f: tuple[float, ...] = vectors.GRAVITY_F
    gyro_preset: str = ""
    temperature: Temperature | None = None

    def __post_init__(self) -> None:
        positive("rate", self.rate, unit="Hz")
        positive("duration", self.duration, unit="s")
        if round(self.duration * self.rate) == 0:
            raise InputError(
                f"{self.duration:g} s at {self.rate:g} Hz contain no gyro sample; lengthen the run or raise the rate"
            )
        if self.duration * self.rate > MAX_SAMPLES:
            raise InputError(
                f"{self.duration:g} s at {self.rate:g} Hz are {self.duration * self.rate:.3g} gyro samples, more than {MAX_SAMPLES:.0e}; "
                "shorten the run or lower the rate"
            )
        count("seed", self.seed, minimum=0)
        if any(mark in self.name for mark in "/\\\0\n") or self.name.startswith("."):
            raise InputError(
                f"name is {self.name!r}, which is used in file names: leave out slashes, line breaks and leading dots"
            )
        instance("gyro", self.gyro, GyroSpec, "give the specification of a gyro")
        if isinstance(self.motion, type) or not hasattr(self.motion, "increments"):
            raise InputError(f"motion is {self.motion!r}; give a motion, such as motion.rest() or motion.Coning(…)")
        if not np.iterable(self.sensors):
            raise InputError(f"sensors is {self.sensors!r}; give a tuple, also of one sensor: (sensor,)")
        object.__setattr__(self, "sensors", tuple(self.sensors))
        object.__setattr__(self, "gravity_f", tuple(array("gravity_f", self.gravity_f, (3,)).tolist()))
        for sensor in self.sensors:
            if isinstance(sensor, type) or not hasattr(sensor, "name"):
                raise InputError(f"a sensor is {sensor!r}; give sensors, such as VectorSensor(…) or AttitudeSensor(…)")
        names = [sensor.name for sensor in self.sensors]
        for name in names:
            if not str(name).strip():
                raise InputError("a sensor has no name; give each sensor a different name")
            if names.count(name) > 1 or name.startswith("gyro"):
                raise InputError(
                    f"two sensors are named {name!r}, or it begins with 'gyro'; give each sensor a different name"
                )

    @property
    def edges(self) -> Array:
        """Nominal edges of the gyro's sample intervals (n + 1,), s, from 0."""
        return np.arange(round(self.duration * self.rate) + 1) / self.rate

    @functools.cached_property
    def saturation(self) -> str:
        """Samples in which the rate, without noise, exceeds the gyro's range, in words; empty if there are none."""
        limit = self.gyro.range
        if np.isinf(limit):
            return ""
        quiet = GyroSpec(**{name: getattr(self.gyro, name) for name in BEFORE_RANGE})
        rates = simulate(quiet, self.motion.increments(self.edges), self.edges, np.random.default_rng(0)).rates
        beyond = np.any(np.abs(rates) > limit, axis=1)
        words = f"the gyro's saturation at {limit / DEGREE:.4g} °/s in {np.sum(beyond)} of {len(beyond)} samples"
        return words if beyond.any() else ""

    @functools.cached_property
    def temperature_curve(self) -> float:
        """Maximum deviation of the gyro's bias from a line over the fitted temperatures of the record, rad/s; 0 below 1 % of its change."""
        if self.gyro.temperature is None or self.temperature is None:
            return 0.0
        T = np.clip(self.temperature._at(self.edges), *self.gyro.temperature.span)
        bias = self.gyro.temperature.bias(T)
        line = np.column_stack([np.ones_like(T), T - T[0]])
        deviation = np.abs(bias - line @ np.linalg.lstsq(line, bias)[0])
        return float(np.max(np.where(deviation > 0.01 * np.ptp(bias, axis=0), deviation, 0.0)))

    @property
    def late_motion(self) -> str:
        """Time at which the motion first changes if that is after the end, in words; empty if it is not."""
        times = break_times("motion", self.motion)
        if not len(times) or times[0] < self.duration:
            return ""
        return (
            f"the motion changes at {times[0]:.6g} s, after the end at {self.duration:.6g} s, so the change is not simulated: let it start "
            "earlier, or make the scenario longer"
        )
