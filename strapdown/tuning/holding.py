"""Data that the tuning has not seen, and the filter before and after on it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from strapdown import consistency, setup
from strapdown.checks import Array, InputError, one_of
from strapdown.consistency import Judgement, mean_bounds
from strapdown.records import Estimate, Innovations, Truth
from strapdown.setup import FilterSetup
from strapdown.tuning.objective import Case, of_sensors

By = Literal["time", "record"]
MAX_ROWS = 20_000
"""States that are kept of one record to judge."""
MIN_ERRORS = 100
"""Fewest errors against a truth of which the course is reported."""


def split(cases: Sequence[Case], share: float, by: By = "time") -> tuple[tuple[Case, ...], tuple[Case, ...]]:
    """Divide cases into what is tuned on and what is held out.

    Parameters
    ----------
    cases : sequence of Case
        Records to divide.
    share : float
        Share of the data held out, between 0 and 1.
    by : {"time", "record"}
        Hold out the end of every record, which the filter reaches through its beginning; or whole records, the last ones.

    Returns
    -------
    tuned, held : tuple of Case
        Cases to tune on, and cases held out. By time both have the same records, with other ``first`` and ``last``.
    """
    if not 0.0 < share < 1.0:
        raise InputError(f"holdout is {share:g}; it must lie between 0 and 1")
    one_of("holdout by", by, ("time", "record"))
    if by == "record":
        held = max(1, round(share * len(cases)))
        if held >= len(cases):
            raise InputError(
                f"holding out {share:g} of {len(cases)} record(s) leaves none to tune on; give more records, or split by time"
            )
        return tuple(cases[:-held]), tuple(cases[-held:])
    train, test = [], []
    for case in cases:
        first, last = case.span
        border = float(last - share * (last - first))
        train.append(replace(case, last=border))
        test.append(replace(case, first=float(np.nextafter(border, np.inf))))
    return tuple(train), tuple(test)


@dataclass(frozen=True, kw_only=True, eq=False)
class NeesCourse:
    """NEES of one set of states over the time of a record."""

    of: str
    """"attitude" or "bias"."""
    time: Array
    """Middle of spans of time (k,), s."""
    mean: Array
    """Mean NEES per state in each (k,); NaN where no truth is known."""
    effective: float
    """Independent errors that a span's mean rests on, in effect: errors of one run are alike for a while."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Two-sided 99 % bounds of a consistent filter in each span."""
        return mean_bounds(3, max(self.effective, 1.0), 0.99)


@dataclass(frozen=True, kw_only=True, eq=False)
class Performance:
    """One filter on held-out data."""

    log_likelihood: float
    """Log likelihood per innovation, nats, without those that a gate refused."""
    nis: float
    """Mean NIS per degree of freedom; 1 for a consistent filter."""
    nis_bounds: tuple[float, float]
    """Two-sided 99 % bounds of it."""
    anees: float
    """NEES of attitude and bias, per state, averaged over time and records; NaN without a truth."""
    attitude_rms: float
    """Root mean square of the attitude error (all axes together), rad; NaN without a truth."""
    judgements: tuple[Judgement, ...]
    """The verdict on each record."""
    nis_time: Array
    """Middle of spans of time of the first record (k,), s."""
    nis_course: Array
    """Mean NIS per degree of freedom in each (k,)."""
    nis_degrees: Array
    """Degrees of freedom in each (k,)."""
    nees: tuple[NeesCourse, ...] = ()
    """NEES over the time of the first record, of the attitude and of the bias as far as their truth is known."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The filter before and after tuning on the same held-out data."""

    before: Performance
    after: Performance

    @property
    def better(self) -> bool:
        """Whether the likelihood of the held-out innovations has grown."""
        return self.after.log_likelihood > self.before.log_likelihood


def compare(
    cases: Sequence[Case], before: FilterSetup, after: FilterSetup, *, threads: int = 1, bins: int = 40
) -> Comparison:
    """Return the performance of two filters on held-out data.

    Parameters
    ----------
    cases : sequence of Case
        With the initial attitudes and biases; their σ are those of each setup.
    before : FilterSetup
        The filter before tuning.
    after : FilterSetup
        The tuned filter.
    threads : int, default 1
        Cases filtered at once.
    bins : int, default 40
        Spans of time of the averaged NIS and NEES.

    Returns
    -------
    Comparison
        Log likelihood, NIS, NEES and RMS attitude error (rad) of each filter; NaN where they need a truth that is unknown.
    """
    with ThreadPoolExecutor(threads) as pool:
        results = list(pool.map(lambda chosen: performance(cases, chosen, bins=bins), (before, after)))
    return Comparison(before=results[0], after=results[1])


def performance(cases: Sequence[Case], chosen: FilterSetup, *, bins: int = 40) -> Performance:
    """Return how one filter does on what is to be judged of these cases."""
    total, number, squares = 0.0, 0, 0.0
    nees, error_squares, judgements = [], [], []
    course = (np.empty(0), np.empty(0), np.empty(0))
    nees_courses: tuple[NeesCourse, ...] = ()
    for place, case in enumerate(cases):
        estimate, truth, attitude = _judged(case, chosen)
        innovations = estimate.innovations.values()
        for one in innovations:
            e, s = one.innovation[one.used], one.variance[one.used]
            total -= 0.5 * float(np.sum(np.log(2.0 * np.pi * s) + e**2 / s))
            number += e.size
            squares += float(one.nis[one.used].sum())
        if truth is not None:
            error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)
            assert estimate.covariance is not None
            nees.append(consistency.nees(error, estimate.covariance))
            error_squares.append(np.sum(error[:, :3] ** 2, axis=1))
        elif attitude is not None:
            found = consistency.reference_errors(estimate.attitude, attitude).total
            error_squares.append(found[np.isfinite(found)] ** 2)
        judgements.append(consistency.judge(estimate, truth))
        if place == 0:
            course = _course(list(innovations), bins)
            nees_courses = _nees_courses(estimate, truth, attitude, bins)
    return Performance(
        log_likelihood=total / number,
        nis=squares / number,
        nis_bounds=mean_bounds(1, number, 0.99),
        anees=float(np.mean(np.concatenate(nees)) / 6.0) if nees else float("nan"),
        attitude_rms=float(np.sqrt(np.mean(np.concatenate(error_squares)))) if error_squares else float("nan"),
        judgements=tuple(judgements),
        nis_time=course[0],
        nis_course=course[1],
        nis_degrees=course[2],
        nees=nees_courses,
    )


def _judged(case: Case, chosen: FilterSetup) -> tuple[Estimate, Truth | None, Array | None]:
    """Return the part of the filter's estimate that is to be judged, with the truth, or the reference attitude, at its times."""
    used = of_sensors(chosen, case.record)
    record = setup.modelled_record(case.record, used)
    reference = case.true_attitude
    every = 1 if reference is not None else max(1, len(record.increments) // MAX_ROWS)
    initial = setup.initial_state(used, case.initial.attitude, case.initial.bias)
    estimate = setup.run(
        case.record, used, initial, every=every, full_covariance=record.truth is not None or reference is not None
    )
    inside = (estimate.time >= case.first) & (estimate.time <= case.last)
    covariance = None if estimate.covariance is None else estimate.covariance[inside]
    part = replace(
        estimate,
        time=estimate.time[inside],
        attitude=estimate.attitude[inside],
        bias=estimate.bias[inside],
        variance=estimate.variance[inside],
        covariance=covariance,
        innovations={name: _within(one, case) for name, one in estimate.innovations.items()},
    )
    truth = None
    if record.truth is not None:
        truth = Truth(attitude=record.truth.attitude[::every][inside], bias=record.truth.bias[::every][inside])
    attitude = None
    if truth is None and reference is not None:
        attitude = reference[:: chosen.integration.samples][: len(record.time)].copy()
        if case.judged is not None:
            attitude[~case.judged[:: chosen.integration.samples][: len(record.time)]] = np.nan
        attitude = attitude[inside]
    return part, truth, attitude


def _within(innovations: Innovations, case: Case) -> Innovations:
    inside = (innovations.time >= case.first) & (innovations.time <= case.last)
    return Innovations(
        time=innovations.time[inside],
        innovation=innovations.innovation[inside],
        variance=innovations.variance[inside],
        weight=None if innovations.weight is None else innovations.weight[inside],
    )


def _course(innovations: Sequence[Innovations], bins: int) -> tuple[Array, Array, Array]:
    time = np.concatenate([one.time[one.used] for one in innovations])
    edges = np.linspace(time.min(), time.max() + 1e-9, bins + 1)
    sums, degrees = np.zeros(bins), np.zeros(bins)
    for one in innovations:
        place = np.clip(np.searchsorted(edges, one.time[one.used], side="right") - 1, 0, bins - 1)
        sums += np.bincount(place, one.nis[one.used], bins)
        degrees += np.bincount(place, minlength=bins) * float(one.innovation.shape[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        return 0.5 * (edges[1:] + edges[:-1]), sums / degrees, degrees


def _nees_courses(
    estimate: Estimate, truth: Truth | None, reference: Array | None, bins: int
) -> tuple[NeesCourse, ...]:
    if truth is None and reference is None:
        return ()
    attitude = truth.attitude if truth is not None else reference
    assert attitude is not None
    assert estimate.covariance is not None
    known = np.isfinite(attitude).all(axis=1)
    if int(known.sum()) < MIN_ERRORS:
        return ()
    bias = estimate.bias if truth is None else truth.bias
    error = consistency.errors(estimate.attitude[known], estimate.bias[known], attitude[known], bias[known])
    time, P = estimate.time[known], estimate.covariance[known]
    edges = np.linspace(time[0], time[-1] + 1e-9, bins + 1)
    place = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, bins - 1)
    number = np.bincount(place, minlength=bins)
    found = []
    for name in ("attitude", "bias") if truth is not None else ("attitude",):
        states = consistency.SUBSETS[name]
        # The memory of all states is learnt together where the bias is known too.
        whole = slice(0, 6 if truth is not None else 3)
        own = states if truth is not None else None
        average = consistency.time_average(error[:, whole], P[:, whole, whole], own)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.bincount(place, consistency.nees(error, P, states), bins) / (len(states) * number)
        found.append(
            NeesCourse(of=name, time=0.5 * (edges[1:] + edges[:-1]), mean=mean, effective=average.effective / bins)
        )
    return tuple(found)
