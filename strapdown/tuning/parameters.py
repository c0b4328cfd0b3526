"""Tunable parameters: their fields in a filter setup, units and values, and setups with other values.

The gyro's axes share two noise parameters, because the filter has one σ_v and one σ_u: only isotropic noise is invariant to rotations of
the body within a step, and has the closed form of :func:`strapdown.kernels.filter_step.process_noise`.

``SENSOR.sigma`` is the root mean square of the σ of all axes; their ratios are those of the setup or the record. The σ and times of a
filter's optional states (:data:`GYRO_STATES`, :data:`SENSOR_STATES`) scale all axes or drifts of a state together; their value is the root
mean square.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from strapdown import gyro, units
from strapdown.checks import InputError, one_of, positive
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import VELOCITY, SensorStates, States
from strapdown.gyro import GyroSpec
from strapdown.records import ImuRecord

ARW = "gyro.arw"
"""Angle random walk σ_v, rad/√s."""
RRW = "gyro.rrw"
"""Rate random walk σ_u, rad/s/√s; the only parameter that may be zero."""
INITIAL_ATTITUDE = "initial.attitude"
"""Standard deviation of the initial attitude error, rad."""
INITIAL_BIAS = "initial.bias"
"""Standard deviation of the initial bias error, rad/s."""
SCALE = "filter.scale"
"""A common factor on every σ of the filter: gyro, sensors, states and initial state. It scales the covariance and leaves the estimates
unchanged; it can only be tuned alone."""
OUTLIER_SHARE = "outliers.share"
"""Fraction of the measurements that are outliers (:mod:`strapdown.tuning.outliers`)."""
OUTLIER_SCALE = "outliers.scale"
"""Ratio of the σ of outliers to that of the other measurements."""
SIGMA = ".sigma"
"""Suffix of a sensor's σ."""


class Unit(NamedTuple):
    """Unit in which a parameter is printed; ``factor`` converts to SI."""

    name: str
    factor: float


_PER_HOUR = Unit("°/h", units.DEGREE_PER_HOUR)
_PER_G = Unit("°/h/g", units.DEGREE_PER_HOUR / units.STANDARD_GRAVITY)
_OF_SENSOR = Unit("rad, or unit of the reference", 1.0)

PLAIN = {
    ARW: (("process_noise", "angle_random_walk"), Unit("°/√h", units.DEGREE_PER_ROOT_HOUR)),
    RRW: (("process_noise", "rate_random_walk"), Unit("°/h/√h", units.DEGREE_PER_HOUR_PER_ROOT_HOUR)),
    INITIAL_ATTITUDE: (("attitude_sigma",), Unit("°", units.DEGREE)),
    INITIAL_BIAS: (("bias_sigma",), _PER_HOUR),
}
"""Parameters of attitude and bias: field in a setup, and unit."""
GYRO_STATES = {
    "gyro.scale_sigma": (("states", "gyro_scale_sigma"), Unit("ppm", 1e-6)),
    "gyro.misalignment_sigma": (("states", "gyro_misalignment_sigma"), Unit("mrad", 1e-3)),
    "gyro.force_sigma": (("states", "gyro_force_sigma"), _PER_G),
    "gyro.cross_force_sigma": (("states", "gyro_cross_force_sigma"), _PER_G),
    "gyro.temperature_sigma": (("states", "gyro_temperature_sigma"), Unit("°/h/K", units.DEGREE_PER_HOUR)),
    "gyro.drift_sigma": (("states", "gyro_drift_sigma"), _PER_HOUR),
    "gyro.drift_time": (("states", "gyro_drift_time"), Unit("s", 1.0)),
}
"""Parameters of the gyro's optional states."""
SENSOR_STATES = {
    "mounting_sigma": ("mounting_sigma", Unit("mrad", 1e-3)),
    "bias_sigma": ("bias_sigma", _OF_SENSOR),
    "correlated_sigma": ("correlated_sigma", _OF_SENSOR),
    "correlation_time": ("correlation_time", Unit("s", 1.0)),
    "lever_sigma": ("lever_arm_sigma", Unit("m", 1.0)),
    **{name: (name, Unit(unit, 1.0)) for name, unit in VELOCITY.items()},
}
"""Parameters of a sensor's optional states, named ``SENSOR.KEY``: field of :class:`.SensorStates`, unit."""
WHOLE = {SCALE: Unit("1", 1.0), OUTLIER_SHARE: Unit("%", 0.01), OUTLIER_SCALE: Unit("1", 1.0)}
"""Units of the parameters that are no fields of a setup."""


def _place(name: str) -> tuple[tuple[str, ...], Unit] | None:
    """Return the field of a parameter in a setup, and its unit; None for a sensor's σ."""
    sensor, _, last = name.rpartition(".")
    if last in SENSOR_STATES and name not in PLAIN:
        field, unit = SENSOR_STATES[last]
        return ("states", "sensors", sensor, field), unit
    return PLAIN.get(name) or GYRO_STATES.get(name)


def _at(owner: Any, path: Sequence[str]) -> Any:
    for part in path:
        owner = owner[part] if isinstance(owner, Mapping) else getattr(owner, part)
    return owner


def _put(owner: Any, path: Sequence[str], value: Any) -> Any:
    """Return a dataclass or mapping with another value of the field at a path."""
    head, *rest = path
    inner = _put(_at(owner, [head]), rest, value) if rest else value
    return {**owner, head: inner} if isinstance(owner, Mapping) else replace(owner, **{head: inner})


def state_names(states: States | None) -> tuple[str, ...]:
    """Return the names of the parameters of these states; none if there are no states."""
    if states is None:
        return ()
    names = [*GYRO_STATES, *(f"{sensor}.{last}" for sensor in states.sensors for last in SENSOR_STATES)]
    places = {name: place[0][1:] for name in names if (place := _place(name)) is not None}
    return tuple(name for name, path in places.items() if _size(_at(states, path)) > 0.0)


def default_names(records: Sequence[ImuRecord]) -> tuple[str, ...]:
    """Return the default parameters: the gyro's two noises and the σ of every sensor."""
    sensors = dict.fromkeys(series.sensor for record in records for series in record.vectors if len(series.time))
    return (ARW, RRW, *(f"{sensor}{SIGMA}" for sensor in sensors))


def checked_names(free: Sequence[str], filter_setup: FilterSetup, records: Sequence[ImuRecord]) -> tuple[str, ...]:
    """Return the given names, checked: each is a parameter of this filter on these records, and none repeats."""
    known = [*default_names(records), INITIAL_ATTITUDE, INITIAL_BIAS, SCALE, *state_names(filter_setup.states)]
    if not free:
        raise InputError(f"free names no parameter; give some of {', '.join(known)}")
    for name in free:
        one_of("free: parameter", name, known)
        if list(free).count(name) > 1:
            raise InputError(f"free names {name} twice; give it once")
    if SCALE in free and len(free) > 1:
        raise InputError(f"{SCALE} scales all noise of the filter, other parameters included; tune it alone")
    return tuple(free)


def unit_of(name: str, records: Sequence[ImuRecord] = ()) -> Unit:
    """Return the unit in which a parameter is printed; for a sensor's σ one that suits its size in the records."""
    place = _place(name)
    if place is not None:
        return place[1]
    if name in WHOLE:
        return WHOLE[name]
    sensor = name.removesuffix(SIGMA)
    kinds = [series.kind for record in records for series in record.vectors if series.sensor == sensor]
    if kinds and kinds[0] == "vector":
        return Unit("unit of the reference", 1.0)
    if own_sigma(sensor, records) > 0.1 * units.DEGREE:
        return Unit("°", units.DEGREE)
    return Unit("arcsec", units.ARCSECOND)


def own_sigma(sensor: str, records: Sequence[ImuRecord]) -> float:
    """Return the root mean square of a sensor's σ in the records, over all of its measurements."""
    squares = [np.square(series.sigma) for record in records for series in record.vectors if series.sensor == sensor]
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 0.0


def _size(value: Any) -> float:
    """Return a number unchanged; for several their root mean square, without those that are zero."""
    entries = np.asarray(value, np.float64)
    if entries.ndim == 0:
        return float(value)
    return float(np.sqrt(np.mean(np.square(entries[entries > 0.0])))) if np.any(entries > 0.0) else 0.0


def _times(value: Any, factor: float) -> Any:
    """Return a number, or nested tuples of them, times a factor."""
    return tuple(_times(part, factor) for part in value) if isinstance(value, tuple) else factor * value


def values_of(filter_setup: FilterSetup, names: Sequence[str], records: Sequence[ImuRecord]) -> dict[str, float]:
    """Return the values of the parameters in a setup."""
    values = {}
    for name in names:
        place, sensor = _place(name), name.removesuffix(SIGMA)
        if name == SCALE:
            values[name] = 1.0
        elif place is not None:
            values[name] = _size(_at(filter_setup, place[0]))
        else:
            sigma = _size(filter_setup.sigma.get(sensor, own_sigma(sensor, records)))
            if sigma == 0.0:
                raise InputError(f"{sensor}: its sigma is 0 in the records; give a starting value in [filter.sigma]")
            values[name] = sigma * filter_setup.measurement_sigma_factor
    return values


def with_values(filter_setup: FilterSetup, values: Mapping[str, float]) -> FilterSetup:
    """Return the setup with other values of these parameters; a σ is divided by the setup's factor.

    ``SENSOR.sigma`` and the σ of states keep the ratios of their axes.
    """
    if SCALE in values:
        return _scaled(filter_setup, values[SCALE])
    sigma = dict(filter_setup.sigma)
    for name, value in values.items():
        place = _place(name)
        if place is None:
            sensor, own = name.removesuffix(SIGMA), value / filter_setup.measurement_sigma_factor
            present = sigma.get(sensor)
            sigma[sensor] = _times(present, own / _size(present)) if isinstance(present, tuple) else own
            continue
        present = _at(filter_setup, place[0])
        if name == "gyro.drift_sigma":  # the part with a bandwidth above that of the states is scaled with them
            fast = ("states", "gyro_fast_bias_sigma")
            filter_setup = _put(filter_setup, fast, value / _size(present) * _at(filter_setup, fast))
        several = place[0][0] == "states"
        filter_setup = _put(filter_setup, place[0], _times(present, value / _size(present)) if several else value)
    return replace(filter_setup, sigma=sigma)


Owner = TypeVar("Owner", FilterSetup, States, SensorStates)


def _sigmas_times(owner: Owner, factor: float) -> Owner:
    """Return a setup, or states, with every standard deviation multiplied by a factor."""
    names = [field.name for field in fields(owner) if field.name.endswith("_sigma")]
    return replace(owner, **{name: _times(getattr(owner, name), factor) for name in names})


def _scaled(filter_setup: FilterSetup, factor: float) -> FilterSetup:
    noise, states = filter_setup.process_noise, filter_setup.states
    if states is not None:
        sensors = {name: _sigmas_times(sensor, factor) for name, sensor in states.sensors.items()}
        states = replace(_sigmas_times(states, factor), sensors=sensors)
    return replace(
        _sigmas_times(filter_setup, factor),
        process_noise=replace(noise, **{name: factor * value for name, value in vars(noise).items()}),
        measurement_sigma_factor=factor * filter_setup.measurement_sigma_factor,
        states=states,
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
    """Return priors of the gyro's two noise parameters from a specification, of a datasheet or an Allan deviation.

    Flicker noise is matched as in :meth:`strapdown.estimation.setup.FilterSetup.for_record`; a noise not specified has no prior.

    Parameters
    ----------
    spec : GyroSpec
        Specification whose noise coefficients are the medians of the priors.
    record : ImuRecord
        Record that gives the rate and noise of the measurements.
    factor : float, default 3
        Factor that is one standard deviation of a prior.

    Returns
    -------
    dict of str to Prior
        Priors of ``"gyro.arw"`` (rad/√s) and ``"gyro.rrw"`` (rad/s/√s).
    """
    flickers = np.any(np.asarray(spec.bias_instability) > 0.0)
    densities = vars(setup.FilterSetup.for_record(record, spec).process_noise) if flickers else gyro.process_noise(spec)
    pairs = {ARW: densities["angle_random_walk"], RRW: densities["rate_random_walk"]}
    return {name: Prior(value=value, factor=factor) for name, value in pairs.items() if value > 0.0}
