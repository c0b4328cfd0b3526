"""The scalar machine: any scenario and any filter; each run is simulated, then filtered."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from strapdown import estimation
from strapdown.checks import Array, are_finite
from strapdown.estimation import setup
from strapdown.estimation.filters.own import Own
from strapdown.estimation.setup import FilterSetup
from strapdown.montecarlo.plan import Dispersions, Plan, initial_sigmas, unit
from strapdown.montecarlo.statistics import (
    EXAMPLES,
    Replay,
    Statistics,
    bin_of,
    errors_at,
    nees_at,
    worst,
    zeros,
)
from strapdown.motion import Motion
from strapdown.records import Estimate, ImuRecord
from strapdown.scenarios import Scenario, simulate

NAME = "scalar"
CHUNK = 8

_TINY = float(np.finfo(np.float64).tiny)


def start(
    record: ImuRecord, filter_setup: FilterSetup, seed: int, run: int, dispersions: Dispersions | None = None
) -> estimation.State:
    """Return the initial state of one run: the truth with errors drawn from the dispersions, by default from the filter's prior."""
    errors = Dispersions() if dispersions is None else dispersions
    fixed = errors.attitude_error, errors.bias_error
    return setup.drawn_state(
        filter_setup, record, seed, run, sigmas=initial_sigmas(errors, filter_setup), fixed_errors=fixed
    )


def record_of(plan: Plan, run: int) -> ImuRecord:
    """Return the record of one run of a plan."""
    scenario = _SCENARIOS.get(plan)  # once: an equal plan, the key, may be deleted at any time
    if scenario is None:
        scenario = _SCENARIOS[plan] = replace(plan.scenario, motion=_Remembered(plan.scenario.motion))
    return simulate(unit(plan, run, scenario), plan.seed, run)


class _Remembered:
    """A motion that caches its last results: all runs evaluate it at the same times, at more cost than the filter's."""

    def __init__(self, motion: Motion) -> None:
        self._motion = motion
        self._cached = functools.lru_cache(maxsize=32)(self._evaluated)
        if hasattr(motion, "breaks"):
            self.breaks = motion.breaks

    def _evaluated(self, what: str, times: bytes, shape: tuple[int, ...]) -> Array:
        values = np.array(getattr(self._motion, what)(np.frombuffer(times).reshape(shape)))
        values.flags.writeable = False  # shared by all runs
        return values

    def _answer(self, what: str, time: ArrayLike) -> Array:
        times = np.asarray(time, dtype=np.float64)
        return self._cached(what, times.tobytes(), times.shape)

    attitude = functools.partialmethod(_answer, "attitude")
    body_rate = functools.partialmethod(_answer, "body_rate")
    body_angular_acceleration = functools.partialmethod(_answer, "body_angular_acceleration")
    increments = functools.partialmethod(_answer, "increments")


_SCENARIOS: weakref.WeakKeyDictionary[Plan, Scenario] = weakref.WeakKeyDictionary()


def replay(plan: Plan, run: int) -> Replay:
    """Return one run of a plan in full detail."""
    record = record_of(plan, run)
    initial = start(record, plan.setup, plan.seed, run, plan.dispersions)
    estimate = setup.run(record, plan.setup, initial, full_covariance=True)
    return Replay(record=record, initial=initial, estimate=estimate)


def run_chunk(plan: Plan, first_run: int, runs: int) -> Statistics:
    """Return the statistics of runs ``first_run`` to ``first_run + runs − 1``."""
    return run_chunks((plan,), first_run, runs)[0]


def run_chunks(plans: Sequence[Plan], first_run: int, runs: int) -> tuple[Statistics, ...]:
    """Return the statistics of several plans that differ only in the filter; each run is simulated once for all filters."""
    sums = [Sums(plan, runs) for plan in plans]
    for run in range(first_run, first_run + runs):
        record = record_of(plans[0], run)
        for part in sums:
            part.add(run, record)
    return tuple(part.statistics for part in sums)


class Sums:
    """Sums for the statistics of one plan, accumulated run by run."""

    def __init__(self, plan: Plan, runs: int) -> None:
        self.plan = plan
        self.sums = SimpleNamespace(runs=runs, **zeros(plan))
        self.scores: list[tuple[int, float]] = []
        self.examples: list[tuple[int, Array, Array]] = []

    def add(self, run: int, record: ImuRecord) -> None:
        """Filter a run and add its results."""
        plan = self.plan
        initial = start(record, plan.setup, plan.seed, run, plan.dispersions)
        # With lost samples, or a user's filter that chooses its times, the epochs are at no fixed step: all steps are kept, then selected.
        regular = len(record.increments) == plan.samples and not isinstance(plan.setup.estimator, Own)
        every = plan.every if regular else 1
        estimate = setup.run(record, plan.setup, initial, every=every, full_covariance=True)
        assert record.truth is not None
        assert estimate.covariance is not None
        rows = slice(None) if regular else _at_epochs(estimate.time, self.sums.time)
        edges = np.searchsorted(record.time, estimate.time[rows])
        error = errors_at(estimate, rows, record.truth.taken(edges))
        self._add_errors(run, error, estimate.covariance[rows])
        self._add_innovations(estimate)

    def _add_errors(self, run: int, error: Array, P: Array) -> None:
        with np.errstate(invalid="ignore"):  # not finite after a failure of the filter
            sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        if np.isnan(P[:, 3:, 3:]).all():  # no bias is estimated: the state is the attitude, and the bias adds zero
            attitude = nees_at(error[:, :3], P[:, :3, :3])
            nees = np.stack([attitude, attitude, np.zeros(len(P))], axis=1)
            error = np.where(np.arange(6) < 3, error, 0.0)
            P = np.nan_to_num(P)
        else:
            nees = np.stack([nees_at(error[:, a:b], P[:, a:b, a:b]) for a, b in ((0, 6), (0, 3), (3, 6))], axis=1)
        good = are_finite(nees) & are_finite(error) & np.isfinite(P).all(axis=(1, 2))
        m, sums = np.flatnonzero(good), self.sums
        e, squares = error[m], nees[m]
        sums.finite[m] += 1
        sums.error_sum[m] += e
        sums.error_product_sum[m] += e[:, :, None] * e[:, None, :]
        sums.covariance_sum[m] += P[m]
        sums.nees_sum[m] += squares
        sums.log_nees_sum[m] += np.log(np.maximum(squares, _TINY))
        sums.coverage[m] += np.abs(e)[:, :, None] <= sigma[m][:, :, None] * np.array([1.0, 2.0, 3.0])
        sums.histogram[m[:, None], np.arange(6), bin_of(np.abs(e))] += 1
        self.scores.append((run, float(nees[:, 0].max()) if good.all() else np.inf))
        if run < EXAMPLES:
            self.examples.append((run, error, sigma))

    def _add_innovations(self, estimate: Estimate) -> None:
        bins = self.plan.nis_bins
        for i, sensor in enumerate(self.plan.sensors):
            if sensor not in estimate.innovations:  # a user's filter may return no innovations
                continue
            innovations = estimate.innovations[sensor]
            place = np.clip(np.searchsorted(self.sums.nis_edges, innovations.time, side="left") - 1, 0, bins - 1)
            used, nis, gate = innovations.used, innovations.nis, self.plan.setup.gate
            nis = np.sum(gate.ungated(innovations.whitened[used]) ** 2, axis=1) if gate else nis[used]
            self.sums.sensor_nis_sum[i] += np.bincount(place[used], weights=nis, minlength=bins)
            self.sums.sensor_degrees[i] += np.bincount(place[used], minlength=bins) * innovations.innovation.shape[1]
            self.sums.sensor_refused[i] += np.bincount(place[~used], minlength=bins)

    @property
    def statistics(self) -> Statistics:
        """Statistics of the runs added so far."""
        run, score = (np.array(column) for column in zip(*self.scores, strict=True))
        worst_run, worst_score = worst(run.astype(np.int64), score.astype(np.float64))
        m = len(self.sums.time)
        kept: Any = list(zip(*self.examples, strict=True)) or [(), np.empty((0, m, 6)), np.empty((0, m, 6))]
        return Statistics(
            **vars(self.sums),
            worst_run=worst_run,
            worst_score=worst_score,
            example_run=np.array(kept[0], np.int64),
            example_error=np.array(kept[1]),
            example_sigma=np.array(kept[2]),
        )


def _at_epochs(time: Array, epochs: Array) -> np.ndarray:
    """Return the last step at or before each epoch, or the first; the tolerance is 1e-6 of the mean step."""
    slack = 1e-6 * (time[-1] - time[0]) / max(len(time) - 1, 1)
    return np.asarray(np.maximum(np.searchsorted(time, epochs + slack, side="right") - 1, 0))
