"""What all sensors have in common: times of measurement, white noise and faults."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, InputError, finite, non_negative, positive
from strapdown.kernels import gyro_errors
from strapdown.kernels.machine import compiled
from strapdown.results import ByValue
from strapdown.vectors.measurements import VectorMeasurements


class Sensor(Protocol):
    """A sensor of a scenario."""

    @property
    def name(self) -> str:
        """Name of the sensor and of its stream of random numbers."""

    def observe(self, motion: Any, start: float, end: float, generator: np.random.Generator) -> VectorMeasurements:
        """Return the measurements of a moving body.

        Parameters
        ----------
        motion : Motion or callable
            Motion of the body, or its attitude q_fb (..., 4) as a function of time, s; an accelerometer needs a motion.
        start, end : float
            Interval (start, end], s.
        generator : numpy.random.Generator
            Random stream of the sensor.

        Returns
        -------
        VectorMeasurements
            The series.
        """


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Errors of a sensor beyond its white noise. The default is none.

    Parameters
    ----------
    latency : float, default 0.0
        Delay from the time of a sample to its arrival, s.
    outages : sequence of (float, float), default empty
        Windows (from, to) without samples, s: eclipse, blinding, a lost fix.
    outlier_probability : float, default 0.0
        Probability that a sample is an outlier, independently of the others.
    outlier_scale : float, default 10.0
        Ratio of the noise of an outlier to that of other samples (contaminated normal, Tukey 1960).
    correlated_sigma : float, default 0.0
        Standard deviation of an additional first-order Gauss–Markov noise of each component, in the unit of sigma.
    correlation_time : float, default 100.0
        Correlation time of that noise, s.
    drop_probability : float, default 0.0
        Probability that a sample is lost, independently of the others.
    duty_period : float, default 0.0
        Period of a duty cycle, s, counted from time 0; 0: the sensor is always on.
    duty_share : float, default 1.0
        Fraction of each period, from its beginning, in which the sensor is on.
    """

    latency: float = 0.0
    outages: Sequence[tuple[float, float]] = ()
    outlier_probability: float = 0.0
    outlier_scale: float = 10.0
    correlated_sigma: float = 0.0
    correlation_time: float = 100.0
    drop_probability: float = 0.0
    duty_period: float = 0.0
    duty_share: float = 1.0

    def __post_init__(self) -> None:
        non_negative("latency", self.latency, unit="s")
        windows = tuple(
            (finite("outages: from", a, unit="s"), finite("outages: to", b, unit="s")) for a, b in self.outages
        )
        for a, b in windows:
            if b < a:
                raise InputError(f"outages has a window from {a:g} s to {b:g} s; give (from, to) with from ≤ to")
        object.__setattr__(self, "outages", windows)
        for name in ("outlier_probability", "drop_probability", "duty_share"):
            if non_negative(name, getattr(self, name)) > 1.0:
                raise InputError(f"{name} is {getattr(self, name):g}; it must not be above 1")
        positive("outlier_scale", self.outlier_scale)
        non_negative("correlated_sigma", self.correlated_sigma)
        positive("correlation_time", self.correlation_time, unit="s")
        non_negative("duty_period", self.duty_period, unit="s")

    def _noise(self, time: Array, generator: np.random.Generator) -> tuple[Array, Array]:
        """Return white noise (m, 3) of unit σ including outliers, and the correlated noise (m, 3), in the unit of ``correlated_sigma``."""
        # Drawn first, so that it is the same with and without correlated noise or outliers.
        white = generator.standard_normal((len(time), 3))
        if self.outlier_probability > 0.0:
            struck = generator.random(len(time)) < self.outlier_probability
            white[struck] *= self.outlier_scale
        correlated = np.zeros_like(white)
        if self.correlated_sigma > 0.0 and len(time):
            drive = self.correlated_sigma * generator.standard_normal(white.shape)
            decay = np.exp(-np.diff(time) / self.correlation_time)
            correlated[0] = drive[0]
            compiled(gyro_errors.gauss_markov)(decay, np.sqrt(1.0 - decay**2)[:, None] * drive[1:], correlated)
        return white, correlated

    def _received(self, series: VectorMeasurements, generator: np.random.Generator) -> VectorMeasurements:
        """Return the series without the samples in outages, off duty or lost, with arrival times if there is a latency.

        Lost samples are drawn from a child of the generator, so they do not depend on the noise.
        """
        arrival = series.time + self.latency if self.latency > 0.0 else None
        series = dataclasses.replace(series, arrival=arrival)
        lost = np.zeros(len(series.time), bool)
        for a, b in self.outages:
            lost |= (series.time >= a) & (series.time <= b)
        if self.duty_period > 0.0:
            # The tolerance keeps a sample that differs from a switching time by rounding.
            lost |= np.mod(series.time / self.duty_period + 1e-9, 1.0) > self.duty_share + 2e-9
        if self.drop_probability > 0.0:
            lost |= generator.spawn(1)[0].random(len(lost)) < self.drop_probability
        return series.taken(~lost) if lost.any() else series


def sample_times(rate: float, phase: float, start: float, end: float) -> Array:
    """Return the measurement times in (start, end], s: the first after ``phase``, or after one interval if that is 0."""
    first, skipped = (start + phase, 0) if phase > 0.0 else (start, 1)
    # The tolerance of a millionth of an interval keeps the last sample if end differs from it by rounding.
    number = int(np.floor((finite("end", end) - first) * rate + 1e-6)) + 1 - skipped
    # Computed as integers divided by the rate, as the gyro's edges are: if the rates are multiples, the times are bitwise equal, and a
    # filter needs no step of the size of a rounding error.
    return np.minimum(first + np.arange(skipped, max(number, 0) + skipped) / rate, end)


def attitude_of(motion: Any, time: Array) -> Array:
    """Return q_fb of a motion, which may be given as a function of time."""
    return np.asarray(motion(time) if callable(motion) else motion.attitude(time))


def in_body(motion: Any, time: Array, vector_f: Array) -> Array:
    """Return R_fbᵀ v_f."""
    return quaternion.rotate(quaternion.conjugate(attitude_of(motion, time)), vector_f)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled(ByValue):
    """A sensor with its own rate and faults; :meth:`_measured` of the class returns its measurements."""

    name: str
    rate: float
    phase: float = 0.0
    faults: Faults = field(default_factory=Faults)

    def _check_sampling(self, unit: str, **sigmas: float) -> None:
        """Refuse a negative noise, rate or phase, and a noise of more than half a turn."""
        for name, sigma in sigmas.items():
            if non_negative(f"{self.name}: {name}", sigma, unit=unit) > math.pi and unit == "rad":
                raise InputError(f"{self.name}: {name} is {sigma:g} rad; it must not be above π (is it in degrees?)")
        positive(f"{self.name}: rate", self.rate, unit="Hz")
        non_negative(f"{self.name}: phase", self.phase, unit="s")

    def observe(self, motion: Any, start: float, end: float, generator: np.random.Generator) -> VectorMeasurements:
        """Return noisy measurements over (start, end] of a motion, or of an attitude q_fb given as a function of time."""
        time = sample_times(self.rate, self.phase, start, end)
        white, correlated = self.faults._noise(time, generator)
        measured = self._measured(motion, time, white, correlated)
        return self.faults._received(VectorMeasurements(sensor=self.name, time=time, **measured), generator)

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        """Return the fields of the series of measurements, from white noise of unit σ and correlated noise (m, 3)."""
        raise NotImplementedError


def without_noise(sensor: Any) -> Any:
    """Return a sensor without white and correlated noise and outliers."""
    zero = {name: 0.0 for name in ("sigma", "sigma_across", "sigma_about") if hasattr(sensor, name)}
    faults = dataclasses.replace(sensor.faults, correlated_sigma=0.0, outlier_probability=0.0)
    return dataclasses.replace(sensor, **zero, faults=faults)


def unit_vector(vector: Array) -> Array:
    """Return vectors (..., 3) divided by their lengths."""
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))
