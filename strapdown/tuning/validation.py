"""Validation on held-out data: performance of the filter before and after tuning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from strapdown import consistency
from strapdown.checks import Array, fraction
from strapdown.consistency import Judgement, mean_bounds
from strapdown.estimation import setup
from strapdown.estimation.schedule import selected
from strapdown.estimation.setup import FilterSetup
from strapdown.records import Estimate, Truth
from strapdown.results import Column, Listed, Table, figure
from strapdown.tuning.objective import Case, need_measurements, of_sensors
from strapdown.units import DEGREE

MAX_ROWS = 20_000
"""Maximum number of states of a record that are judged."""


def split(cases: Sequence[Case], share: float) -> tuple[tuple[Case, ...], tuple[Case, ...]]:
    """Divide cases into tuning data and held-out data, the end of every record, which the filter reaches from its beginning.

    Parameters
    ----------
    cases : sequence of Case
        Records to divide.
    share : float
        Fraction of the data held out, between 0 and 1.

    Returns
    -------
    tuned, held : tuple of Case
        Cases to tune on, and cases held out: the same records, with different ``first`` and ``last``.
    """
    fraction("holdout", share)
    train, test = [], []
    for case in cases:
        first, last = case.span
        border = float(last - share * (last - first))
        train.append(replace(case, last=border))
        test.append(replace(case, first=float(np.nextafter(border, np.inf))))
        need_measurements(test[-1])
    return tuple(train), tuple(test)


@dataclass(frozen=True, kw_only=True, eq=False)
class Performance:
    """Performance of a filter on held-out data."""

    log_likelihood: float
    """Log likelihood per innovation, nats, without those refused by a gate."""
    nis: float
    """Mean NIS per degree of freedom; 1 for a consistent filter."""
    nis_bounds: tuple[float, float]
    """Two-sided 99 % bounds of the mean NIS."""
    nees: dict[str, float]
    """NEES per state, averaged over time and records, of all states, attitude and bias; of those whose truth is known."""
    attitude_rms: float
    """RMS of the attitude error (all axes together), rad; NaN without a truth."""
    judgements: tuple[Judgement, ...]
    """The verdict on each record."""

    @property
    def anees(self) -> float:
        """NEES per state of attitude and bias; NaN without a truth of both."""
        return self.nees.get("state", math.nan)

    @property
    def row(self) -> tuple[Any, ...]:
        """Row of the table :meth:`Comparison.listing`."""
        verdicts = [judgement.verdict for judgement in self.judgements]
        attitude_alone = list(self.nees) == ["attitude"]
        return (
            self.log_likelihood,
            self.nis,
            f"{self.nis_bounds[0]:.3f} to {self.nis_bounds[1]:.3f}",
            *self.nis_bounds,
            f"{figure(self.nees['attitude'], 3)} (attitude)" if attitude_alone else figure(self.anees, 3),
            self.anees,
            self.attitude_rms / DEGREE,
            self.attitude_rms,
            verdicts[0] if len(set(verdicts)) == 1 else f"{verdicts.count('consistent')} of {len(verdicts)} consistent",
        )


@dataclass(frozen=True, kw_only=True)
class Comparison(Listed):
    """The filter before and after tuning on the same held-out data."""

    before: Performance
    after: Performance

    def listing(self) -> Table:
        """Return likelihood, NIS, ANEES, attitude error and verdict of both, as a table."""
        columns = (
            Column("filter", "filter"),
            Column("log likelihood", "log_likelihood_per_innovation", shown="{:.4f}".format),
            Column("NIS", "nis_per_degree", shown="{:.3f}".format),
            Column("99 % bounds"),
            Column(None, "nis_lower"),
            Column(None, "nis_upper"),
            Column("ANEES"),
            Column(None, "anees_per_state"),
            Column("attitude RMS, °", digits=3),
            Column(None, "attitude_rms_rad"),
            Column("verdict"),
        )
        rows = [("before", *self.before.row), ("after", *self.after.row)]
        notes = [
            "The NIS of a consistent filter is within its bounds with a probability of 99 %; the verdict is for all tests of a record "
            "together, so each statistic may be slightly outside its bounds."
        ]
        return Table("On the data held out", columns, rows, notes, name="held-out")

    def summary(self) -> dict[str, Any]:
        """Return the performance before and after as values for JSON."""
        return {
            name: {
                "log_likelihood_per_innovation": performance.log_likelihood,
                "nis_per_degree": performance.nis,
                "nis_bounds": performance.nis_bounds,
                "anees_per_state": performance.anees,
                "attitude_rms_rad": performance.attitude_rms,
                "nees_per_state": {
                    name: performance.nees[name] for name in ("attitude", "bias") if name in performance.nees
                },
                "judgements": [judgement.summary() for judgement in performance.judgements],
            }
            for name, performance in (("before", self.before), ("after", self.after))
        }

    @property
    def better(self) -> bool:
        """Whether the likelihood of the held-out innovations has increased."""
        return self.after.log_likelihood > self.before.log_likelihood


def compare(cases: Sequence[Case], before: FilterSetup, after: FilterSetup, *, threads: int = 1) -> Comparison:
    """Return the performance of two filters on held-out data.

    Parameters
    ----------
    cases : sequence of Case
        Held-out cases, with initial attitudes and biases; the initial σ are those of each setup.
    before : FilterSetup
        The filter before tuning.
    after : FilterSetup
        The tuned filter.
    threads : int, default 1
        Number of cases filtered in parallel.

    Returns
    -------
    Comparison
        Log likelihood, NIS, NEES and RMS attitude error (rad) of each filter; NaN where the truth needed is unknown.
    """
    with ThreadPoolExecutor(threads) as pool:
        results = list(pool.map(lambda filter_setup: performance(cases, filter_setup), (before, after)))
    return Comparison(before=results[0], after=results[1])


def performance(cases: Sequence[Case], filter_setup: FilterSetup) -> Performance:
    """Return the performance of a filter on the judged part of these cases."""
    for case in cases:
        need_measurements(case)
    judged = [_judged(case, filter_setup) for case in cases]
    total, number, squares = 0.0, 0, 0.0
    for innovations in (innovations for estimate, _ in judged for innovations in estimate.innovations.values()):
        e, s = innovations.innovation[innovations.used], innovations.variance[innovations.used]
        total -= 0.5 * float(np.sum(np.log(2.0 * np.pi * s) + e**2 / s))
        number += e.size
        squares += float(innovations.nis[innovations.used].sum())
    nees: dict[str, list[Array]] = {}
    error_squares = []
    for estimate, truth in judged:
        if truth is None:
            continue
        known, size = truth.known, 6 if truth.has_bias else 3
        assert estimate.covariance is not None
        attitude, bias, P = (part[known] for part in (estimate.attitude, estimate.bias, estimate.covariance))
        error = consistency.errors(attitude, bias, truth.attitude[known], truth.bias[known])
        error_squares.append(np.sum(error[:, :3] ** 2, axis=1))
        for name in consistency.SUBSETS if truth.has_bias else ("attitude",):
            states = consistency.SUBSETS[name]
            nees.setdefault(name, []).append(consistency.nees(error[:, :size], P[:, :size, :size], states))
    return Performance(
        log_likelihood=total / number,
        nis=squares / number,
        nis_bounds=mean_bounds(1, number, 0.99),
        nees={name: float(np.mean(np.concatenate(x)) / len(consistency.SUBSETS[name])) for name, x in nees.items()},
        attitude_rms=float(np.sqrt(np.mean(np.concatenate(error_squares)))) if error_squares else math.nan,
        judgements=tuple(
            consistency.judge(estimate, truth if truth is not None and truth.has_bias else None)
            for estimate, truth in judged
        ),
    )


def _judged(case: Case, filter_setup: FilterSetup) -> tuple[Estimate, Truth | None]:
    """Return the judged part of the filter's estimate, with the truth at its times; a reference has no bias."""
    used = of_sensors(filter_setup, case.record)
    record = setup.modelled_record(case.record, used)
    truth, reference = record.truth, case.true_attitude
    every = 1 if reference is not None else max(1, len(record.increments) // MAX_ROWS)
    if truth is None and reference is not None:
        edges = slice(None, None, filter_setup.integration.samples)
        attitude = reference[edges][: len(record.time)].copy()
        if case.judged is not None:
            attitude[~case.judged[edges][: len(record.time)]] = np.nan
        truth = Truth(attitude=attitude)
    initial = setup.initial_state(used, case.initial.attitude, case.initial.bias)
    estimate = setup.run_modelled(record, used, initial, every=every, full_covariance=truth is not None)

    def judged(time: Array) -> np.ndarray:
        return (time >= case.first) & (time <= case.last)

    innovations = {name: selected(series, judged(series.time)) for name, series in estimate.innovations.items()}
    inside = judged(estimate.time)
    values = {name: getattr(estimate, name) for name in ("time", "attitude", "bias", "variance", "covariance")}
    part: dict[str, Any] = {name: value[inside] for name, value in values.items() if value is not None}
    if truth is not None:
        truth = truth.taken(slice(None, None, every)).taken(inside)
    return replace(estimate, innovations=innovations, setup=used, origin=record.origin, **part), truth
