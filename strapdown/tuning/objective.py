"""Objectives of tuning: the checked problem, the setup of a point, and the sum of an objective over records and threads.

A *point* is the vector of the logarithms of the free parameters; −∞ is a value of zero. Objectives differ in their value on a record: the
likelihood of the innovations (:mod:`strapdown.tuning.innovations`), or of the errors against a truth (:mod:`strapdown.tuning.errors`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from strapdown.checks import Array, InputError, are_finite, count, non_negative, one_of
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import State
from strapdown.records import ImuRecord
from strapdown.tuning.parameters import (
    INITIAL_ATTITUDE,
    INITIAL_BIAS,
    OUTLIER_SCALE,
    OUTLIER_SHARE,
    Prior,
    Unit,
    checked_names,
    unit_of,
    values_of,
    with_values,
)
from strapdown.vectors import VectorMeasurements

STEP = 2.0**-15
"""Step of a log parameter for derivatives; the error of the difference is half of it times the curvature."""
PARTS = 20
"""Number of time spans of each record with separate gradients."""
REACH = 16.0
"""Maximum change of a log parameter from its initial value."""
OUTLIERS = (OUTLIER_SHARE, OUTLIER_SCALE)
"""Parameters of the outliers, the last two of a likelihood with outliers."""
SHARES = (1e-4, 0.4)
"""Range of the share of outliers; more frequent ones are not outliers."""
SCALES = (2.0, 100.0)
"""Range of the scale of outliers; smaller ones are not outliers."""
LARGEST_SCALE = 0.1
"""Maximum σ of scale factors and misalignments, in which the filter is linear."""
QUICKEST, SLOWEST = 0.05, 100.0
"""Range of a time constant: relative to the interval between measurements, and to the duration of the record."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A record to tune on, with the filter's initial state.

    Parameters
    ----------
    record : ImuRecord
        Gyro increments and measurements, at the gyro's rate.
    initial : State
        State at the first edge, with the whole bias; its covariance is that of the setup if the initial σ are tuned.
    name : str, default ""
        Name of the record in errors and reports.
    first : float, default -inf
        Start of the innovations used for tuning, s.
    last : float, default inf
        End of the innovations used for tuning, s; later ones are held out.
    true_attitude : ndarray (n + 1, 4), optional
        q_fb at the edges from a reference system, if the record has no truth; rows of NaN are unknown.
    judged : ndarray (n + 1,) of bool, optional
        Edges at which errors against ``true_attitude`` are used. Default: all.
    """

    record: ImuRecord
    initial: State
    name: str = ""
    first: float = -np.inf
    last: float = np.inf
    true_attitude: Array | None = None
    judged: np.ndarray | None = None

    @property
    def span(self) -> tuple[float, float]:
        """Start and end of the time used, s."""
        return max(self.first, float(self.record.time[0])), min(self.last, float(self.record.time[-1]))


def of_sensors(filter_setup: FilterSetup, record: ImuRecord) -> FilterSetup:
    """Return a setup without the σ of sensors that are not in the record."""
    own = {series.sensor for series in record.vectors}
    return replace(filter_setup, sigma={name: value for name, value in filter_setup.sigma.items() if name in own})


@dataclass(frozen=True, kw_only=True, eq=False)
class Derivatives:
    """Minus the log likelihood, without its constant, and its derivatives with respect to the log parameters, by part."""

    value: Array
    """(parts,)"""
    score: Array
    """Its gradient (parts, p)."""
    information: Array
    """Fisher's information from the sensitivities of the innovations (p, p), or Σ g gᵀ over the measurements, g the gradient of each."""


def outliers_at(points: Array) -> tuple[Array, Array]:
    """Return share and variance ratio of outliers at points (…, p); differences and profiles may exceed the range of the search."""
    return np.minimum(np.exp(points[..., -2]), 0.9), np.exp(2.0 * points[..., -1])


def joined(parts: Sequence[Derivatives]) -> Derivatives:
    """Return the derivatives of several records together."""
    return Derivatives(
        value=np.concatenate([part.value for part in parts]),
        score=np.concatenate([part.score for part in parts]),
        information=np.sum([part.information for part in parts], axis=0),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Objective:
    """Objective to minimise: minus a log likelihood, or a substitute; a subclass defines its value on the records."""

    names: tuple[str, ...]
    """Names of the free parameters."""
    filter_setup: FilterSetup
    """Setup with the values of the fixed parameters."""
    start: Array
    """Logarithms of the free parameters in that setup (p,)."""
    cases: tuple[Case, ...] = field(repr=False)
    threads: int = 1
    spacing: float = 0.0
    priors: Mapping[str, Prior] = field(default_factory=dict)
    """Priors, which a search adds to the objective."""
    composite: ClassVar[bool] = False
    """Whether its curvature is not an information matrix, so standard errors are from the scatter of its gradient."""

    def curvature(self, point: Array) -> Array | None:
        """Return second derivatives at a point (p, p) if the information of the search is not accurate enough for standard errors."""
        return None

    @property
    def mixed(self) -> bool:
        """Whether some measurements are outliers (:mod:`strapdown.tuning.outliers`)."""
        return self.names[-2:] == OUTLIERS

    @property
    def limits(self) -> tuple[Array, Array]:
        """Minimum and maximum logarithm of each parameter in a search (p,), (p,)."""
        low, high = self.start - REACH, self.start + REACH
        if self.mixed:
            low[-2:], high[-2:] = np.log([SHARES, SCALES]).T
        return low, high

    def unit(self, name: str) -> Unit:
        """Return the unit in which a parameter is printed."""
        return unit_of(name, [case.record for case in self.cases])

    def derivatives(self, point: Array) -> Derivatives:
        """Return value, gradient and information at a point."""
        raise NotImplementedError

    def minus_log(self, points: Array) -> Array:
        """Return the value at several points (k, p): (k,)."""
        return np.array([self.derivatives(point).value.sum() for point in np.atleast_2d(points)])

    def setup(self, point: Array) -> FilterSetup:
        """Return the filter setup of a point, with the gate unchanged."""
        values = zip(self.names, np.exp(point).tolist(), strict=True)
        return with_values(
            self.filter_setup, {name: self._bounded(name, x) for name, x in values if name not in OUTLIERS}
        )

    def _bounded(self, name: str, value: float) -> float:
        """Return the value of a parameter, limited to its range."""
        if name == INITIAL_ATTITUDE:
            return min(value, np.pi)
        if name in ("gyro.scale_sigma", "gyro.misalignment_sigma") or name.endswith(".mounting_sigma"):
            return min(value, LARGEST_SCALE)
        if not name.endswith("_time"):
            return value
        spans = [case.record.time[-1] - case.record.time[0] for case in self.cases]
        numbers = [max(len(series.time) for series in case.record.vectors) for case in self.cases]
        shortest = min(span / number for span, number in zip(spans, numbers, strict=True))
        return float(np.clip(value, QUICKEST * shortest, SLOWEST * max(spans)))

    def each(self, work: Callable[..., Any], jobs: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return ``work`` for the arguments of every job, distributed over the threads."""
        if self.threads == 1 or len(jobs) == 1:
            return [work(*job) for job in jobs]
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(lambda job: work(*job), jobs))

    def modelled(self, record: ImuRecord, filter_setup: FilterSetup) -> ImuRecord:
        """Return a record at the rate of the filter's steps as processed by the filter of a setup, with thinned measurements."""
        record = setup.with_sigma(record, of_sensors(filter_setup, record))
        if self.spacing > 0.0:
            record = replace(record, vectors=tuple(thinned(series, self.spacing) for series in record.vectors))
        return record

    def initial(self, case: Case, filter_setup: FilterSetup) -> State:
        """Return the initial state of the filter of a setup."""
        if {INITIAL_ATTITUDE, INITIAL_BIAS} & set(self.names):
            return setup.initial_state(filter_setup, case.initial.attitude, case.initial.bias)
        # The common scale of all σ.
        factor = filter_setup.measurement_sigma_factor / self.filter_setup.measurement_sigma_factor
        return case.initial if factor == 1.0 else replace(case.initial, covariance=factor**2 * case.initial.covariance)


def make_problem(
    cases: Sequence[Case],
    filter_setup: FilterSetup,
    free: Sequence[str],
    *,
    spacing: float = 0.0,
    threads: int = 1,
) -> Objective:
    """Return the checked problem of a tuning: records, filter and parameters, without an objective on the records."""
    setup.need_mekf(filter_setup, "tuning by name")
    if not cases:
        raise InputError("there is no record to tune on; give one")
    records = [case.record for case in cases]
    names = checked_names(free, filter_setup, records)
    values = values_of(filter_setup, names, records)
    for name, value in values.items():
        if value <= 0.0:
            raise InputError(f"{name} starts from {value:g}; it must start from a number greater than zero")
    for case in cases:
        _check_case(case, filter_setup)
    return Objective(
        names=names,
        filter_setup=with_values(filter_setup, values),
        start=np.log(list(values.values())),
        cases=tuple(cases),
        threads=count("threads", threads),
        spacing=non_negative("spacing", spacing, unit="s"),
    )


def _check_case(case: Case, filter_setup: FilterSetup) -> None:
    """Refuse a record without data for tuning, or without a sensor that has error states."""
    what = case.name or "record"
    for sensor in () if filter_setup.states is None else filter_setup.states.sensors:
        one_of(f"{what}: sensor of the states", sensor, [series.sensor for series in case.record.vectors])
    need_measurements(case)
    if not isinstance(case.initial, State):
        raise InputError(
            f"{what}: initial is {case.initial!r}; it must be an estimation.State, which holds the whole bias"
        )


def need_measurements(case: Case) -> int:
    """Return the number of measurements of a case in its time; refuse none."""
    first, last = case.span
    number = sum(int(np.sum(_usable(s) & (s.time >= first) & (s.time <= last))) for s in case.record.vectors)
    if not number:
        raise InputError(
            f"{case.name or 'record'} has no measurement between {first:g} and {last:g} s; tuning needs vector measurements"
        )
    return number


def _usable(series: VectorMeasurements) -> np.ndarray:
    """Return which measurements of a series have a value (m,)."""
    content = series.vector_b if series.attitude is None else series.attitude
    return are_finite(content)


def thinned(series: VectorMeasurements, spacing: float) -> VectorMeasurements:
    """Return the measurements of a series at least ``spacing`` s apart, with σ reduced so that they have the weight of all.

    With a disturbance correlated over n samples, a filter that treats samples as independent needs a σ larger by √n. If samples are thinned
    until their disturbances are independent, that σ can be estimated; the filter then uses it for every sample.
    """
    usable = np.flatnonzero(_usable(series))
    # Slightly less, so that stamps on a grid of exactly this spacing are kept.
    kept, due = [], -np.inf
    for k in usable:
        if series.time[k] >= due:
            kept.append(k)
            due = series.time[k] + spacing * (1.0 - 1e-6)
    if len(kept) == len(series.time):
        return series
    return series.taken(np.array(kept, np.int64)).noise_scaled(float(np.sqrt(len(kept) / max(len(usable), 1))))
