"""What may be tuned: names of parameters, their values in a filter setup, and setups with other values.

The gyro's two noises are shared by its axes, as the filter believes one σ_v and one σ_u: only isotropic noise is the same seen from a body
that turns within a step, and has the closed form of :func:`strapdown.kernels.filter_step.process_noise`. Of a sensor whose σ differs by
axis one factor on all of them is tuned; their ratios are the record's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from strapdown import gyro, setup, units
from strapdown.checks import InputError, one_of, positive
from strapdown.gyro import GyroSpec
from strapdown.mekf import ProcessNoise
from strapdown.records import ImuRecord
from strapdown.setup import FilterSetup

ARW = "gyro.arw"
"""σ_v, rad/√s."""
RRW = "gyro.rrw"
"""σ_u, rad/s/√s; the one parameter that may be zero."""
INITIAL_ATTITUDE = "initial.attitude"
"""Standard deviation of the initial attitude error, rad."""
INITIAL_BIAS = "initial.bias"
"""Standard deviation of the initial bias error, rad/s."""
SCALE = "filter.scale"
"""A factor on every σ that the filter believes, gyro, sensors and initial state alike; to be tuned alone. It leaves the estimates as they
are and sets their covariance."""
OUTLIER_SHARE = "outliers.share"
"""Share of the measurements that are outliers (:mod:`strapdown.tuning.outliers`)."""
OUTLIER_SCALE = "outliers.scale"
"""Their noise over that of the others."""
GATE = "gate.probability"
"""Probability that the gate lets a right measurement pass: what share and scale of the outliers make it."""
SIGMA = ".sigma"
"""What the name of a sensor's σ ends with."""

OWN = (ARW, RRW, INITIAL_ATTITUDE, INITIAL_BIAS, SCALE)


@dataclass(frozen=True, kw_only=True)
class Unit:
    """A unit that a parameter is told in: multiply by ``factor`` to have SI."""

    name: str
    factor: float


_UNITS = {
    ARW: Unit(name="°/√h", factor=units.DEGREE_PER_ROOT_HOUR),
    RRW: Unit(name="°/h/√h", factor=units.DEGREE_PER_HOUR_PER_ROOT_HOUR),
    INITIAL_ATTITUDE: Unit(name="°", factor=units.DEGREE),
    INITIAL_BIAS: Unit(name="°/h", factor=units.DEGREE_PER_HOUR),
    SCALE: Unit(name="1", factor=1.0),
    OUTLIER_SHARE: Unit(name="%", factor=0.01),
    OUTLIER_SCALE: Unit(name="1", factor=1.0),
}


def known_names(records: Sequence[ImuRecord]) -> tuple[str, ...]:
    """Return the names of all parameters that a filter on these records has."""
    sensors = dict.fromkeys(series.sensor for record in records for series in record.vectors if len(series.time))
    return (*OWN, *(f"{sensor}{SIGMA}" for sensor in sensors))


def default_names(records: Sequence[ImuRecord]) -> tuple[str, ...]:
    """Return what is tuned if nobody says: the gyro's two noises and the σ of every sensor."""
    return tuple(name for name in known_names(records) if not name.startswith("initial.") and name != SCALE)


def checked_names(free: Sequence[str], records: Sequence[ImuRecord]) -> tuple[str, ...]:
    """Return the names given if each is known and none comes twice."""
    if not free:
        raise InputError("free names no parameter; give some of " + ", ".join(known_names(records)))
    for name in free:
        one_of("free: parameter", name, known_names(records))
        if list(free).count(name) > 1:
            raise InputError(f"free names {name} twice; once is enough")
    if SCALE in free and len(free) > 1:
        raise InputError(f"{SCALE} scales all that the filter believes, other parameters too; tune it alone")
    return tuple(free)


def unit_of(name: str, records: Sequence[ImuRecord]) -> Unit:
    """Return the unit that a parameter is printed in."""
    if name in _UNITS:
        return _UNITS[name]
    sensor = name.removesuffix(SIGMA)
    kinds = [series.kind for record in records for series in record.vectors if series.sensor == sensor]
    if kinds and kinds[0] == "vector":
        return Unit(name="unit of the vector", factor=1.0)
    if own_sigma(name, records) > 0.1 * units.DEGREE:
        return Unit(name="°", factor=units.DEGREE)
    return Unit(name="arcsec", factor=units.ARCSECOND)


def own_sigma(name: str, records: Sequence[ImuRecord]) -> float:
    """Return the root mean square of the σ that the records tell of a sensor, over all of its measurements."""
    sensor = name.removesuffix(SIGMA)
    squares = [np.square(series.sigma) for record in records for series in record.vectors if series.sensor == sensor]
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 0.0


def values_of(chosen: FilterSetup, names: Sequence[str], records: Sequence[ImuRecord]) -> dict[str, float]:
    """Return the values that a setup gives the parameters."""
    found = {
        ARW: chosen.process_noise.angle_random_walk,
        RRW: chosen.process_noise.rate_random_walk,
        INITIAL_ATTITUDE: chosen.attitude_sigma,
        INITIAL_BIAS: chosen.bias_sigma,
        SCALE: 1.0,
    }
    for name in names:
        if name in found:
            continue
        sensor = name.removesuffix(SIGMA)
        own = chosen.sigma.get(sensor, own_sigma(name, records)) * chosen.measurement_sigma_factor
        if own == 0.0:
            raise InputError(f"{sensor}: the records say that its sigma is 0; give one to start from in [filter.sigma]")
        found[name] = own
    return {name: found[name] for name in names}


def with_values(chosen: FilterSetup, values: Mapping[str, float]) -> FilterSetup:
    """Return the setup with other values of these parameters; a σ is set with the setup's factor taken off."""
    if SCALE in values:
        return _scaled(chosen, values[SCALE])
    noise = ProcessNoise(
        angle_random_walk=values.get(ARW, chosen.process_noise.angle_random_walk),
        rate_random_walk=values.get(RRW, chosen.process_noise.rate_random_walk),
    )
    sigma = dict(chosen.sigma)
    for name, value in values.items():
        if name not in OWN:
            sigma[name.removesuffix(SIGMA)] = value / chosen.measurement_sigma_factor
    return replace(
        chosen,
        process_noise=noise,
        attitude_sigma=values.get(INITIAL_ATTITUDE, chosen.attitude_sigma),
        bias_sigma=values.get(INITIAL_BIAS, chosen.bias_sigma),
        sigma=sigma,
    )


def _scaled(chosen: FilterSetup, factor: float) -> FilterSetup:
    noise = ProcessNoise(
        angle_random_walk=factor * chosen.process_noise.angle_random_walk,
        rate_random_walk=factor * chosen.process_noise.rate_random_walk,
    )
    return replace(
        chosen,
        process_noise=noise,
        attitude_sigma=factor * chosen.attitude_sigma,
        bias_sigma=factor * chosen.bias_sigma,
        measurement_sigma_factor=factor * chosen.measurement_sigma_factor,
    )


@dataclass(frozen=True, kw_only=True)
class Prior:
    """What is known of a parameter before: log-normal."""

    value: float
    """Its median, in SI."""
    factor: float
    """One standard deviation is a factor of this; greater than 1."""

    def __post_init__(self) -> None:
        """Check both."""
        positive("value of the prior", self.value)
        if not (np.isfinite(self.factor) and self.factor > 1.0):
            raise InputError(f"factor of the prior is {self.factor}; it must be a finite number greater than 1")

    @property
    def spread(self) -> float:
        """Standard deviation of the logarithm."""
        return float(np.log(self.factor))


def priors_from_gyro(spec: GyroSpec, record: ImuRecord, *, factor: float = 3.0) -> dict[str, Prior]:
    """Return priors of the gyro's two noises from a specification: a datasheet's, or what an Allan deviation found.

    Flicker is matched as :func:`strapdown.setup.matched_to_record` does; a noise that the specification does not have gets no prior.
    """
    noise = setup.matched_to_record(spec, record).process_noise if _flickers(spec) else None
    found = gyro.process_noise(spec) if noise is None else vars(noise)
    pairs = {ARW: found["angle_random_walk"], RRW: found["rate_random_walk"]}
    return {name: Prior(value=value, factor=factor) for name, value in pairs.items() if value > 0.0}


def _flickers(spec: GyroSpec) -> bool:
    return bool(np.any(np.asarray(spec.bias_instability) > 0.0))
