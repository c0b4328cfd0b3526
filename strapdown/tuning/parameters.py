"""Tunable parameters: their names, their values in a filter setup, and setups with other values.

The gyro's two noises are shared by its axes, as the filter has one σ_v and one σ_u: only isotropic noise is the same seen from a body
that turns within a step, and has the closed form of :func:`strapdown.kernels.filter_step.process_noise`.

``SENSOR.sigma`` is one factor on the σ of all axes, as their root mean square; their ratios are the setup's or the record's.
``SENSOR.sigma.x``, ``.y`` and ``.z`` are the σ about (of whole vectors along) each body axis on its own, of any sensor but a heading; the
likelihood of :mod:`strapdown.tuning.extended` has them. There are no such names of the gyro, for the reason above.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from strapdown import gyro, setup, units
from strapdown.checks import Array, InputError, one_of, positive
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.records import ImuRecord
from strapdown.setup import FilterSetup, Sigma

ARW = "gyro.arw"
"""σ_v, rad/√s."""
RRW = "gyro.rrw"
"""σ_u, rad/s/√s; the one parameter that may be zero."""
INITIAL_ATTITUDE = "initial.attitude"
"""Standard deviation of the initial attitude error, rad."""
INITIAL_BIAS = "initial.bias"
"""Standard deviation of the initial bias error, rad/s."""
SCALE = "filter.scale"
"""A factor on every σ of the filter, gyro, sensors and initial state alike; to be tuned alone. It leaves the estimates as they
are and sets their covariance."""
OUTLIER_SHARE = "outliers.share"
"""Share of the measurements that are outliers (:mod:`strapdown.tuning.outliers`)."""
OUTLIER_SCALE = "outliers.scale"
"""Their noise over that of the others."""
GATE = "gate.probability"
"""Probability that the gate lets a right measurement pass: what share and scale of the outliers make it."""
SIGMA = ".sigma"
"""Suffix of a sensor's σ."""

AXES = tuple(f"{SIGMA}.{axis}" for axis in "xyz")
"""Suffixes of a sensor's σ of one body axis."""

OWN = (ARW, RRW, INITIAL_ATTITUDE, INITIAL_BIAS, SCALE)


@dataclass(frozen=True, kw_only=True)
class Unit:
    """Unit of a parameter in print: multiply by ``factor`` for SI."""

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


def axis_of(name: str) -> tuple[str, int] | None:
    """Return the sensor and the axis that a name such as ``star.sigma.x`` is of; None of another name."""
    for axis, ending in enumerate(AXES):
        if name.endswith(ending) and name != ending:
            return name.removesuffix(ending), axis
    return None


def axis_names(records: Sequence[ImuRecord]) -> tuple[str, ...]:
    """Return the names of the σ of single body axes: of every sensor but headings, which have one degree of freedom."""
    series = [one for record in records for one in record.vectors if len(one.time)]
    headings = {one.sensor for one in series if one.kind == "heading"}
    sensors = dict.fromkeys(one.sensor for one in series if one.sensor not in headings)
    return tuple(f"{sensor}{axis}" for sensor in sensors for axis in AXES)


def default_names(records: Sequence[ImuRecord]) -> tuple[str, ...]:
    """Return what is tuned by default: the gyro's two noises and the σ of every sensor."""
    return tuple(name for name in known_names(records) if not name.startswith("initial.") and name != SCALE)


def checked_names(free: Sequence[str], records: Sequence[ImuRecord]) -> tuple[str, ...]:
    """Return the names given if each is known and none comes twice."""
    if not free:
        raise InputError("free names no parameter; give some of " + ", ".join(known_names(records)))
    for name in free:
        if axis_of(name) is not None and name not in known_names(records):
            raise InputError(
                f"free: {name} is a sigma of one axis, which this objective does not tune; use tuning.extended.likelihood"
            )
        one_of("free: parameter", name, known_names(records))
        if list(free).count(name) > 1:
            raise InputError(f"free names {name} twice; once is enough")
    if SCALE in free and len(free) > 1:
        raise InputError(f"{SCALE} scales all noise of the filter, other parameters included; tune it alone")
    return tuple(free)


def unit_of(name: str, records: Sequence[ImuRecord]) -> Unit:
    """Return the unit that a parameter is printed in."""
    if name in _UNITS:
        return _UNITS[name]
    part = axis_of(name)
    if part is not None:
        name = f"{part[0]}{SIGMA}"
    sensor = name.removesuffix(SIGMA)
    kinds = [series.kind for record in records for series in record.vectors if series.sensor == sensor]
    if kinds and kinds[0] == "vector":
        return Unit(name="unit of the vector", factor=1.0)
    if own_sigma(name, records) > 0.1 * units.DEGREE:
        return Unit(name="°", factor=units.DEGREE)
    return Unit(name="arcsec", factor=units.ARCSECOND)


def fixed_unit(name: str) -> Unit:
    """Return the unit that a parameter is printed in where its records are not known: SI of a sensor's σ."""
    return _UNITS.get(name, Unit(name="rad or SI", factor=1.0))


def own_sigma(name: str, records: Sequence[ImuRecord]) -> float:
    """Return the root mean square of a sensor's σ in the records, over all of its measurements."""
    sensor = name.removesuffix(SIGMA)
    squares = [np.square(series.sigma) for record in records for series in record.vectors if series.sensor == sensor]
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 0.0


def own_axes(sensor: str, records: Sequence[ImuRecord]) -> Array:
    """Return the root mean square of a sensor's σ in the records about each body axis (3,), over all of its measurements."""
    squares = []
    for series in (one for record in records for one in record.vectors if one.sensor == sensor):
        if series.sigma_axes is not None:
            squares.append(np.square(series.sigma_axes))
        elif series.covariance is not None:
            squares.append(np.einsum("kii->ki", series.covariance))
        else:
            squares.append(np.repeat(np.square(series.sigma)[:, None], 3, axis=1))
    return np.asarray(np.sqrt(np.mean(np.concatenate(squares), axis=0))) if squares else np.zeros(3)


def by_axis(chosen: FilterSetup, names: Sequence[str], records: Sequence[ImuRecord]) -> FilterSetup:
    """Return the setup with three σ for each sensor that ``names`` has one axis of: those that it, or the records, say at present."""
    sigma = dict(chosen.sigma)
    for sensor in dict.fromkeys(part[0] for part in map(axis_of, names) if part is not None):
        given = sigma.get(sensor)
        if isinstance(given, tuple):
            continue
        own = own_axes(sensor, records)
        size = float(np.sqrt(np.mean(own**2)))
        if given is None and size == 0.0:
            raise InputError(f"{sensor}: the records say that its sigma is 0; give one to start from in [filter.sigma]")
        x, y, z = (own if given is None else given * (own / size if size > 0.0 else np.ones(3))).tolist()
        sigma[sensor] = x, y, z
    return replace(chosen, sigma=sigma)


def _size(sigma: Sigma) -> float:
    """Return one σ, or the root mean square of three."""
    return float(np.sqrt(np.mean(np.square(sigma)))) if isinstance(sigma, tuple) else sigma


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
        part = axis_of(name)
        if part is not None:
            axes = by_axis(chosen, [name], records).sigma[part[0]]
            assert isinstance(axes, tuple)
            found[name] = axes[part[1]] * chosen.measurement_sigma_factor
            continue
        sensor = name.removesuffix(SIGMA)
        own = _size(chosen.sigma.get(sensor, own_sigma(name, records))) * chosen.measurement_sigma_factor
        if own == 0.0:
            raise InputError(f"{sensor}: the records say that its sigma is 0; give one to start from in [filter.sigma]")
        found[name] = own
    return {name: found[name] for name in names}


def with_values(chosen: FilterSetup, values: Mapping[str, float]) -> FilterSetup:
    """Return the setup with other values of these parameters; a σ is set with the setup's factor taken off.

    ``SENSOR.sigma`` keeps the ratios of three; ``SENSOR.sigma.x`` and the like need three in the setup (:func:`by_axis`).
    """
    if SCALE in values:
        return _scaled(chosen, values[SCALE])
    noise = ProcessNoise(
        angle_random_walk=values.get(ARW, chosen.process_noise.angle_random_walk),
        rate_random_walk=values.get(RRW, chosen.process_noise.rate_random_walk),
    )
    sigma = dict(chosen.sigma)
    for name, value in values.items():
        if name not in OWN:
            _set(sigma, name, value / chosen.measurement_sigma_factor)
    return replace(
        chosen,
        process_noise=noise,
        attitude_sigma=values.get(INITIAL_ATTITUDE, chosen.attitude_sigma),
        bias_sigma=values.get(INITIAL_BIAS, chosen.bias_sigma),
        sigma=sigma,
    )


def _set(sigma: dict[str, Sigma], name: str, value: float) -> None:
    """Set one σ, all three in their ratios, or that of one axis."""
    part = axis_of(name)
    if part is None:
        sensor = name.removesuffix(SIGMA)
        given = sigma.get(sensor)
        if isinstance(given, tuple):
            x, y, z = (value * one / _size(given) for one in given)
            sigma[sensor] = x, y, z
        else:
            sigma[sensor] = value
        return
    sensor, axis = part
    given = sigma.get(sensor)
    if not isinstance(given, tuple):
        raise InputError(f"{name}: the setup has no three sigmas of {sensor}; make them with tuning.parameters.by_axis")
    x, y, z = (value if k == axis else one for k, one in enumerate(given))
    sigma[sensor] = x, y, z


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
    """Log-normal prior of a parameter.

    Parameters
    ----------
    value : float
        Median of the parameter, SI.
    factor : float
        Factor by which one standard deviation multiplies or divides the median; greater than 1.
    """

    value: float
    factor: float

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
    """Return priors of the gyro's two noise parameters from a specification: of a datasheet, or of an Allan deviation.

    Flicker noise is matched as by :func:`strapdown.setup.matched_to_record`; a noise that the specification does not have gets no prior.

    Parameters
    ----------
    spec : GyroSpec
        Its noise coefficients are the medians of the priors.
    record : ImuRecord
        For the rate and quality of its measurements.
    factor : float, default 3
        One standard deviation of a prior is a factor of this.

    Returns
    -------
    dict of str to Prior
        For ``"gyro.arw"`` (rad/√s) and ``"gyro.rrw"`` (rad/s/√s).
    """
    noise = setup.matched_to_record(record, spec).process_noise if _flickers(spec) else None
    found = gyro.process_noise(spec) if noise is None else vars(noise)
    pairs = {ARW: found["angle_random_walk"], RRW: found["rate_random_walk"]}
    return {name: Prior(value=value, factor=factor) for name, value in pairs.items() if value > 0.0}


def _flickers(spec: GyroSpec) -> bool:
    return bool(np.any(np.asarray(spec.bias_instability) > 0.0))
