"""The likelihood of a filter with optional states: their priors, drifts and coloured noises tuned beside the gyro's and the sensors' noise.

It has the σ of each body axis of a sensor too, with optional states or without: ``SENSOR.sigma.x``, ``.y``, ``.z``
(:mod:`strapdown.tuning.parameters`).

The same sum over the innovations as in :mod:`strapdown.tuning.innovations`, of the filter that :func:`strapdown.setup.run` runs. Its
score and information come from one run more a parameter, off by :data:`STEP`; the curvature at the best point, from which standard errors
come, is the observed one, by central differences of the score. :func:`strapdown.tuning.fit` takes it like any other objective:

>>> objective = extended.likelihood([tuning.record_case(record, chosen)], chosen, ["gyro.arw", "acc.correlated_sigma"])  # doctest: +SKIP
>>> result = tuning.fit(objective, starts=1)  # doctest: +SKIP

The σ of a constant state is known from as many draws as there are such states and records: of a scale factor on three axes, one record
determines it within a factor of 1.5 at best.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from strapdown import setup, units
from strapdown.checks import Array, InputError, count, one_of
from strapdown.estimation.states import State
from strapdown.records import Estimate, ImuRecord
from strapdown.setup import FilterSetup
from strapdown.setup.states import VELOCITY, Entries, SensorStates, States
from strapdown.tuning import parameters
from strapdown.tuning.innovations import STEP, Case, Derivatives
from strapdown.tuning.parameters import INITIAL_ATTITUDE, INITIAL_BIAS, SCALE, Unit

CURVATURE_STEP = 0.02
"""Step of a log parameter for the differences of the score that are the curvature."""
GYRO = {
    "gyro.scale_sigma": "gyro_scale_sigma",
    "gyro.misalignment_sigma": "gyro_misalignment_sigma",
    "gyro.force_sigma": "gyro_force_sigma",
    "gyro.cross_force_sigma": "gyro_cross_force_sigma",
    "gyro.drift_sigma": "gyro_drift_sigma",
    "gyro.drift_time": "gyro_drift_time",
}
"""Parameters of the gyro's states, and the fields of :class:`strapdown.states.States` that they scale."""
SENSOR = {
    "bias_sigma": "bias_sigma",
    "correlated_sigma": "correlated_sigma",
    "correlation_time": "correlation_time",
    "lever_sigma": "lever_arm_sigma",
    **{name: name for name in VELOCITY},
}
"""Parameters of a sensor's states by what follows its name and a dot, and the fields of :class:`strapdown.states.SensorStates`."""
LARGEST_SCALE = 0.1
"""σ of scale factors and misalignments from which on a filter that is linear in them makes no sense: noise would pass for a turn."""
QUICKEST, SLOWEST = 0.05, 100.0
"""Range of a time constant that makes a difference: from this part of the interval between measurements to this multiple of the record."""


def _size(value: Entries) -> float:
    """Return the root mean square of the entries above zero."""
    entries = np.asarray(value, np.float64)
    return float(np.sqrt(np.mean(np.square(entries[entries > 0.0])))) if np.any(entries > 0.0) else 0.0


def _scaled(value: Entries, factor: float) -> Any:
    entries: Any = (factor * np.asarray(value, np.float64)).tolist()
    return (
        tuple(tuple(row) if isinstance(row, list) else row for row in entries) if isinstance(entries, list) else entries
    )


def state_names(states: States | None) -> tuple[str, ...]:
    """Return the names of the parameters that these states have; none where there are no states."""
    if states is None:
        return ()
    found = [name for name, part in GYRO.items() if _size(getattr(states, part)) > 0.0]
    for sensor, one in states.sensors.items():
        found += [f"{sensor}.{name}" for name, part in SENSOR.items() if _size(getattr(one, part)) > 0.0]
    return tuple(found)


def unit_of(name: str) -> Unit:
    """Return the unit that a parameter of the states is printed in."""
    known = {
        "gyro.scale_sigma": Unit(name="ppm", factor=1e-6),
        "gyro.misalignment_sigma": Unit(name="mrad", factor=1e-3),
        "gyro.force_sigma": Unit(name="°/h/g", factor=units.DEGREE_PER_HOUR / units.STANDARD_GRAVITY),
        "gyro.cross_force_sigma": Unit(name="°/h/g", factor=units.DEGREE_PER_HOUR / units.STANDARD_GRAVITY),
        "gyro.drift_sigma": Unit(name="°/h", factor=units.DEGREE_PER_HOUR),
        "gyro.drift_time": Unit(name="s", factor=1.0),
        "correlation_time": Unit(name="s", factor=1.0),
        "lever_sigma": Unit(name="m", factor=1.0),
        **{name: Unit(name=unit, factor=1.0) for name, unit in VELOCITY.items()},
    }
    return known.get(name, known.get(name.rpartition(".")[2], Unit(name="rad, or the vector's unit", factor=1.0)))


def value_of(states: States, name: str) -> float:
    """Return the value of one parameter of states: of several axes or drifts the root mean square."""
    if name in GYRO:
        return _size(getattr(states, GYRO[name]))
    sensor, _, last = name.rpartition(".")
    return _size(getattr(states.sensors[sensor], SENSOR[last]))


def with_state_values(states: States, values: Mapping[str, float]) -> States:
    """Return states with other values of these parameters; several axes or drifts keep their ratios."""
    changed: dict[str, Any] = {}
    sensors: dict[str, SensorStates] = dict(states.sensors)
    for name, value in values.items():
        factor = value / value_of(states, name)
        if name in GYRO:
            changed[GYRO[name]] = _scaled(getattr(states, GYRO[name]), factor)
            if name == "gyro.drift_sigma":
                changed["gyro_fast_bias_sigma"] = factor * states.gyro_fast_bias_sigma
        else:
            sensor, _, last = name.rpartition(".")
            part = SENSOR[last]
            sensors[sensor] = replace(sensors[sensor], **{part: _scaled(getattr(sensors[sensor], part), factor)})
    return replace(states, sensors=sensors, **changed)


@dataclass(frozen=True, kw_only=True, eq=False)
class ExtendedLikelihood:
    """Minus the log likelihood of the innovations of a filter with optional states; built by :func:`likelihood`."""

    names: tuple[str, ...]
    chosen: FilterSetup
    """The setup that the fixed parameters are taken from."""
    start: Array
    """Logarithms of the free parameters in that setup (p,)."""
    cases: tuple[Case, ...] = field(repr=False)
    parts: int = 20
    threads: int = 1
    composite: ClassVar[bool] = False

    def setup(self, point: Array) -> FilterSetup:
        """Return the setup of a point."""
        values = {name: float(np.exp(x)) for name, x in zip(self.names, point, strict=True)}
        if self.chosen.states is None:
            return parameters.with_values(self.chosen, values)
        own = set(state_names(self.chosen.states))
        plain = {name: value for name, value in values.items() if name not in own}
        result = parameters.with_values(self.chosen, plain) if plain else self.chosen
        bounded = {name: self._bounded(name, value) for name, value in values.items() if name in own}
        return replace(result, states=with_state_values(self.chosen.states, bounded))

    def _bounded(self, name: str, value: float) -> float:
        """Return the value of a parameter inside what makes a difference, or sense."""
        if name in ("gyro.scale_sigma", "gyro.misalignment_sigma"):
            return min(value, LARGEST_SCALE)
        if not name.endswith("_time"):
            return value
        spans = [case.record.time[-1] - case.record.time[0] for case in self.cases]
        numbers = [max(len(series.time) for series in case.record.vectors) for case in self.cases]
        shortest = min(span / number for span, number in zip(spans, numbers, strict=True))
        return float(np.clip(value, QUICKEST * shortest, SLOWEST * max(spans)))

    def minus_log(self, points: Array) -> Array:
        """Return minus the log likelihood, without its constant, at several points (k, p): (k,)."""
        rows = np.atleast_2d(points)
        runs = self._runs(rows)
        each = [[0.5 * float(np.sum(np.log(s) + e * e / s)) for e, s, _, _ in found] for found in runs]
        return np.asarray(np.sum(np.array(each), axis=1))

    def derivatives(self, point: Array) -> Derivatives:
        """Return the likelihood and its derivatives at a point: p + 1 runs over each record."""
        p = len(self.names)
        rows = np.concatenate([point[None], point + STEP * np.eye(p)])
        runs = self._runs(rows)
        values, scores = [], []
        information, outer = np.zeros((p, p)), np.zeros((p, p))
        for number in range(len(self.cases)):
            e, s, part, measurement = runs[0][number]
            de = np.stack([(runs[1 + j][number][0] - e) / STEP for j in range(p)], axis=1)
            ds = np.stack([(runs[1 + j][number][1] - s) / STEP for j in range(p)], axis=1)
            value = 0.5 * (np.log(s) + e * e / s)
            score = e[:, None] * de / s[:, None] + 0.5 * ds * ((1.0 - e * e / s) / s)[:, None]
            values.append(np.bincount(part, value, self.parts))
            sums = np.zeros((self.parts, p))
            np.add.at(sums, part, score)
            scores.append(sums)
            information += (de / s[:, None]).T @ de + 0.5 * (ds / s[:, None] ** 2).T @ ds
            gradients = np.zeros((int(measurement[-1]) + 1, p))
            np.add.at(gradients, measurement, score)
            outer += gradients.T @ gradients
        return Derivatives(
            value=np.concatenate(values), score=np.concatenate(scores), information=information, outer=outer
        )

    def curvature(self, point: Array) -> Array:
        """Return the observed information at a point (p, p): the second derivatives of minus the log likelihood."""
        p = len(self.names)
        rows = np.empty((p, p))
        for j in range(p):
            step = CURVATURE_STEP * np.eye(p)[j]
            ahead, back = (self.derivatives(point + sign * step).score.sum(axis=0) for sign in (1.0, -1.0))
            rows[j] = (ahead - back) / (2.0 * CURVATURE_STEP)
        return np.asarray(0.5 * (rows + rows.T))

    def _runs(self, points: Array) -> list[list[tuple[Array, Array, np.ndarray, np.ndarray]]]:
        """Return innovations, their variances, and the parts and measurements they belong to, of every point and record."""
        setups = [self.setup(point) for point in points]
        found = self.each(lambda job: self._run(*job), [(chosen, case) for chosen in setups for case in self.cases])
        return [found[k : k + len(self.cases)] for k in range(0, len(found), len(self.cases))]

    def each(self, work: Callable[[Any], Any], jobs: Sequence[Any]) -> list[Any]:
        """Return ``work`` of every job, spread over the threads."""
        if self.threads == 1:
            return [work(job) for job in jobs]
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(work, jobs))

    def estimates(self, number: int, points: Array, epochs: np.ndarray) -> tuple[Array, Array, Array]:
        """Return q_fb (m, k, 4), bias (m, k, 3) and P (m, k, 6, 6) on record ``number`` at edges (m,), at points (k, p)."""
        found = [self._estimate(self.setup(point), self.cases[number], full_covariance=True) for point in points]
        rows = [(one.attitude[epochs], one.bias[epochs], one.covariance[epochs]) for one in found]  # type: ignore[index]
        attitude, bias, P = (np.stack(parts, axis=1) for parts in zip(*rows, strict=True))
        return attitude, bias, P

    def _estimate(self, chosen: FilterSetup, case: Case, **options: Any) -> Estimate:
        own = [series.sensor for series in case.record.vectors]
        used = replace(chosen, sigma={name: value for name, value in chosen.sigma.items() if name in own})
        initial = case.initial
        if {INITIAL_ATTITUDE, INITIAL_BIAS} & set(self.names):
            initial = setup.initial_state(used, case.initial.attitude, case.initial.bias)
        return setup.run(case.record, used, initial, **options)

    def _run(self, chosen: FilterSetup, case: Case) -> tuple[Array, Array, np.ndarray, np.ndarray]:
        # The filter of optional states has the innovations of measurements whose noise differs by axis, with none too.
        used = replace(chosen, states=States() if chosen.states is None else chosen.states)
        estimate = self._estimate(used, case, every=_rows_away(case, used), gate=None, robust=None)
        first, last = max(case.first, case.record.time[0]), min(case.last, case.record.time[-1])
        errors, variances, places, numbers, seen = [], [], [], [], 0
        for one in estimate.innovations.values():
            inside = (one.time >= first) & (one.time <= last)
            errors.append(one.innovation[inside].ravel())
            variances.append(one.variance[inside].ravel())
            place = ((one.time[inside] - first) / (last - first) * self.parts).astype(np.int64)
            degrees = one.innovation.shape[1]
            places.append(np.repeat(np.minimum(place, self.parts - 1), degrees))
            numbers.append(np.repeat(seen + np.arange(len(place)), degrees))
            seen += len(place)
        joined = (np.concatenate(part) for part in (errors, variances, places, numbers))
        return tuple(joined)  # type: ignore[return-value]


def _rows_away(case: Case, chosen: FilterSetup) -> int:
    """Return so long a stride that the filter keeps its first state and its last."""
    return max(1, len(case.record.increments) // chosen.integration.samples)


def likelihood(
    cases: Sequence[Case],
    chosen: FilterSetup,
    free: Sequence[str],
    *,
    parts: int = 20,
    threads: int = 1,
) -> ExtendedLikelihood:
    """Return the likelihood of the free parameters of a filter with error states on these records.

    The initial states of the cases are of the whole bias. Gate and robust weights of ``chosen`` are not applied. ``free`` are names of
    :mod:`strapdown.tuning.parameters` but ``filter.scale``, those of single axes (``SENSOR.sigma.x``) too, and of :func:`state_names`.
    """
    if not cases:
        raise InputError("there is no record to tune on; give one")
    records = [case.record for case in cases]
    _check_axes(free, records)
    own = state_names(chosen.states)
    plain = [name for name in parameters.known_names(records) if name != SCALE] + list(parameters.axis_names(records))
    if not free:
        raise InputError(f"free names no parameter; give some of {', '.join([*plain, *own])}")
    for name in free:
        one_of("free: parameter", name, [*plain, *own])
        if list(free).count(name) > 1:
            raise InputError(f"free names {name} twice; once is enough")
    chosen = parameters.by_axis(chosen, free, records)
    values = parameters.values_of(chosen, [name for name in free if name in plain], records)
    if chosen.states is not None:
        values |= {name: value_of(chosen.states, name) for name in free if name not in plain}
    for name, value in values.items():
        if value <= 0.0:
            raise InputError(f"{name} starts from {value:g}; it must start from a number greater than zero")
    for case in cases:
        _check_case(case, chosen)
    names = tuple(free)
    given = {name: values[name] for name in names if name in plain}
    return ExtendedLikelihood(
        names=names,
        chosen=parameters.with_values(chosen, given) if given else chosen,
        start=np.log([values[name] for name in names]),
        cases=tuple(cases),
        parts=count("parts", parts),
        threads=count("threads", threads),
    )


def _check_axes(free: Sequence[str], records: Sequence[ImuRecord]) -> None:
    """Refuse a σ of one axis of a heading, and one beside that of all axes."""
    headings = {series.sensor for record in records for series in record.vectors if series.kind == "heading"}
    for name in free:
        part = parameters.axis_of(name)
        if part is not None and part[0] in headings:
            raise InputError(f"free: {name}: a heading has one degree of freedom; give {part[0]}{parameters.SIGMA}")
        if part is not None and f"{part[0]}{parameters.SIGMA}" in free:
            raise InputError(f"free: {name} is part of {part[0]}{parameters.SIGMA}; give that, or the axes")


def _check_case(case: Case, chosen: FilterSetup) -> None:
    """Refuse a record that has nothing to tune on, or lacks a sensor that the states are of."""
    what = case.name or "record"
    names = [series.sensor for series in case.record.vectors]
    for sensor in () if chosen.states is None else chosen.states.sensors:
        one_of(f"{what}: sensor of the states", sensor, names)
    first, last = max(case.first, case.record.time[0]), min(case.last, case.record.time[-1])
    seen = sum(int(np.sum((series.time >= first) & (series.time <= last))) for series in case.record.vectors)
    if seen == 0:
        raise InputError(
            f"{what} has no measurement between {first:g} and {last:g} s; tuning needs vector measurements"
        )
    if not isinstance(case.initial, State):
        raise InputError(
            f"{what}: initial is {case.initial!r}; it must be an estimation.State, which holds the whole bias"
        )
