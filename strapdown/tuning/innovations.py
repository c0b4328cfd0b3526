"""The likelihood of filter parameters from the filter's own innovations, with its score and information.

The innovations e of a filter are independent with variances s, so the likelihood of a record is ``Π N(e; 0, s)`` (prediction-error
decomposition; Schweppe 1965, Harvey 1989 section 3.4). A filter of attitude and bias runs at eight points at once, with derivatives in the
same pass (:class:`LaneLikelihood`). A filter with error states, or with noise that differs by axis, runs once more for each parameter,
changed by :data:`STEP` (:class:`RunLikelihood`); standard errors are from the observed curvature at the maximum, by central differences of
the score. The σ of a constant error state is estimated from one draw per state and record: for a scale factor on three axes, one record
determines it within a factor of 1.5 at best.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from strapdown.checks import Array
from strapdown.estimation import setup
from strapdown.estimation.schedule import Schedule, schedule, selected
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import States
from strapdown.estimation.states import covariance_matrices, pack
from strapdown.kernels import likelihood as kernel
from strapdown.kernels import likelihood_outliers
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.walk import walk
from strapdown.records import Estimate, ImuRecord, Innovations
from strapdown.tuning.objective import (
    STEP,
    Case,
    Derivatives,
    Objective,
    by_part,
    joined,
    make_problem,
    outliers_at,
)
from strapdown.tuning.parameters import ARW, INITIAL_ATTITUDE, INITIAL_BIAS, RRW, SCALE, SIGMA, axis_of

MAX_DERIVATIVES = WIDTH - 1
"""Maximum number of derivatives in one pass over a record."""
CURVATURE_STEP = 0.02
"""Step of a log parameter for the curvature by differences of the score."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A record in the form of the kernel."""

    time: Array
    increments: Array
    events: Schedule
    state: Array
    cuts: Array
    used: np.ndarray
    """Which parts are used (parts,), bool."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LaneLikelihood(Objective):
    """Minus the log likelihood of the innovations, for eight points at once; with outliers if their parameters are among the names."""

    prepared: tuple[Prepared, ...] = field(repr=False)

    def minus_log(self, points: Array) -> Array:
        """Return minus the log likelihood, without its constant, at several points (k, p): (k,)."""
        rows = np.atleast_2d(points)
        blocks = [rows[first : first + WIDTH] for first in range(0, len(rows), WIDTH)]
        jobs = [(case, block) for block in blocks for case in self.prepared]
        results = self.each(self._total, jobs)
        sums = [np.sum(results[k : k + len(self.prepared)], axis=0) for k in range(0, len(jobs), len(self.prepared))]
        return np.concatenate(sums)

    def _total(self, case: Prepared, points: Array) -> Array:
        return np.asarray(self._pass(case, points)["minus_log"][case.used].sum(axis=0)[: len(points)])

    def derivatives(self, point: Array) -> Derivatives:
        """Return the likelihood and its derivatives at a point, in one pass over each record for up to seven parameters."""
        p = len(self.names)
        blocks = [tuple(range(p))] if p <= MAX_DERIVATIVES else _pairs_of_groups(p)
        jobs = [(case, point, block) for case in self.prepared for block in blocks]
        results = self.each(self._differences, jobs)
        found = []
        for k in range(0, len(results), len(blocks)):
            score, information = np.zeros((len(results[k].value), p)), np.zeros((p, p))
            for block, part in zip(blocks, results[k : k + len(blocks)], strict=True):
                score[:, block] = part.score
                information[np.ix_(block, block)] = part.information
            found.append(replace(results[k], score=score, information=information))
        return joined(found)

    def _differences(self, case: Prepared, point: Array, block: tuple[int, ...]) -> Derivatives:
        rows = np.concatenate([point[None], point + STEP * np.eye(len(point))[list(block)]])
        found = self._pass(case, rows, free=len(block))
        lower = found["information"]
        return Derivatives(
            value=found["minus_log"][case.used, 0],
            score=found["score"][case.used],
            information=(lower + np.tril(lower, -1).transpose(0, 2, 1))[case.used].sum(axis=0),
        )

    def estimates(self, number: int, points: Array, epochs: np.ndarray) -> tuple[Array, Array, Array]:
        """Return q_fb (m, k, 4), bias (m, k, 3) and P (m, k, 6, 6) on record ``number`` at edges (m,), at up to eight points (k, p)."""
        found = self._pass(self.prepared[number], points, epochs=epochs)["states"][:, :, : len(points)]
        states = np.moveaxis(found, 1, 2)
        return states[..., :4], states[..., 4:7], covariance_matrices(states[..., 7:])

    def judged(self, point: Array) -> list[tuple[str, Array]]:
        """Return of each record and sensor the probability that a measurement is an outlier, and the share of its own noise (m, 2)."""
        found = []
        for case in self.prepared:
            rows = self._pass(case, point[None], judged=True)["probability"]
            used = case.used[np.searchsorted(case.cuts, case.events.time, side="left")]
            found += [(name, rows[used & (case.events.sensor == k)]) for k, name in enumerate(case.events.sensors)]
        return found

    def lanes(self, case: Prepared, points: Array) -> dict[str, Array]:
        """Return the parameters of up to eight points (k, p) for the kernel, flat: gyro noise, factors on variances, state, outliers."""
        rows = np.concatenate([points, np.repeat(points[:1], WIDTH - len(points), axis=0)])
        lane = {name: np.exp(rows[:, j]) for j, name in enumerate(self.names)}
        base = dict(zip(self.names, np.exp(self.start), strict=True))
        noise = self.chosen.process_noise
        all_of = lane.get(SCALE, np.ones(WIDTH))

        def factor(name: str) -> Array:
            return np.asarray(lane[name] / base[name]) if name in lane else all_of

        white = lane.get(ARW, np.full(WIDTH, noise.angle_random_walk) * all_of) ** 2
        walk = lane.get(RRW, np.full(WIDTH, noise.rate_random_walk) * all_of) ** 2
        factors = np.array([factor(f"{sensor}{SIGMA}") ** 2 for sensor in case.events.sensors])
        state = np.repeat(case.state[:, None], WIDTH, axis=1)
        angle, bias = factor(INITIAL_ATTITUDE), factor(INITIAL_BIAS)
        state[7:13] *= angle**2
        state[13:22] *= angle * bias
        state[22:] *= bias**2
        return {
            "noise": np.concatenate([white, walk]),
            "factors": factors.ravel(),
            "state": state.ravel(),
            "outliers": np.concatenate(outliers_at(rows)) if self.mixed else np.empty(0),
        }

    def _pass(
        self,
        case: Prepared,
        points: Array,
        *,
        free: int = 0,
        epochs: np.ndarray | None = None,
        judged: bool = False,
    ) -> dict[str, Array]:
        """Run up to eight points over one record; return the outputs by names of :class:`strapdown.kernels.likelihood.Outputs`."""
        kept = np.empty(0, np.int64) if epochs is None else np.ascontiguousarray(epochs, np.int64)
        parts = len(case.cuts) + 1
        room = {
            "minus_log": np.zeros((parts, WIDTH)),
            "score": np.zeros((parts, free)),
            "information": np.zeros((parts, free, free)),
            "states": np.empty((len(kept), 28, WIDTH)),
            "probability": np.empty((len(case.events.time) if judged else 0, 2)),
        }
        body = kernel.Body(
            **self.lanes(case, points),
            cuts=read_only(case.cuts),
            epochs=kept,
            free=free,
            step=STEP,
            room=np.empty(kernel.ROOM),
        )
        flat = ("minus_log", "states")
        out = kernel.Outputs(**{name: value.reshape(-1) if name in flat else value for name, value in room.items()})
        bodies = (likelihood_outliers, kernel) if self.mixed else (kernel,)
        run = compiled(walk, *bodies)
        run(read_only(case.time), read_only(case.increments), case.events.measurements, 1, body, out)
        return room


def _pairs_of_groups(p: int) -> list[tuple[int, ...]]:
    """Return sets of at most six parameters such that any two parameters are in one of them: each pair of groups of three."""
    groups = [range(first, min(first + 3, p)) for first in range(0, p, 3)]
    return [(*a, *b) for a, b in itertools.combinations(groups, 2)]


class Steps(NamedTuple):
    """What the runs over a record have in common at all points."""

    case: Case
    record: ImuRecord
    """The record at the rate of the filter's steps, with its own σ."""
    motion: tuple[Array, Array] | None
    """Rate and angular acceleration at the measurements used, for a lever arm."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RunLikelihood(Objective):
    """The same for a filter with error states, or with noise that differs by axis: one run per point."""

    steps: tuple[Steps, ...] = field(repr=False)

    def minus_log(self, points: Array) -> Array:
        """Return minus the log likelihood, without its constant, at several points (k, p): (k,)."""
        runs = self._runs(np.atleast_2d(points))
        return np.array([sum(float(np.sum(value)) for value, *_ in found) for found in runs])

    def derivatives(self, point: Array) -> Derivatives:
        """Return the likelihood and its derivatives at a point: p + 1 runs over each record."""
        runs = self._runs(np.concatenate([point[None], point + STEP * np.eye(len(point))]))
        return joined([self._differences(*one) for one in zip(*runs, strict=True)])

    def _differences(self, *runs: tuple[Array, ...]) -> Derivatives:
        value, part, e, s = runs[0]
        if self.mixed:
            score = np.stack([(one[0] - value) / STEP for one in runs[1:]], axis=1)
            return by_part(value, score, score.T @ score, part, self.parts)
        de, ds = (np.stack([(one[k] - runs[0][k]) / STEP for one in runs[1:]], axis=1) for k in (2, 3))
        score = e[:, None] * de / s[:, None] + 0.5 * ds * ((1.0 - e * e / s) / s)[:, None]
        information = (de / s[:, None]).T @ de + 0.5 * (ds / s[:, None] ** 2).T @ ds
        return by_part(value, score, information, part, self.parts)

    def curvature(self, point: Array) -> Array:  # type: ignore[override]
        """Return the observed information at a point (p, p): the second derivatives of minus the log likelihood."""
        steps = CURVATURE_STEP * np.eye(len(point))
        ends = [[self.derivatives(point + sign * step).score.sum(axis=0) for sign in (1.0, -1.0)] for step in steps]
        rows = np.array([(ahead - back) / (2.0 * CURVATURE_STEP) for ahead, back in ends])
        return np.asarray(0.5 * (rows + rows.T))

    def judged(self, point: Array) -> list[tuple[str, Array]]:
        """Return of each record and sensor the probability that a measurement is an outlier, and the share of its own noise (m, 2)."""
        found = [self._innovations(point, one) for one in self.steps]
        return [(name, np.asarray(one.weight)[:, 1:]) for by_sensor in found for name, one in by_sensor.items()]

    def _runs(self, points: Array) -> list[list[tuple[Array, ...]]]:
        """Return the value of each term, its part, and innovations with variances, for each point and record."""
        found = self.each(self._run, [(point, one) for point in points for one in self.steps])
        return [found[k : k + len(self.cases)] for k in range(0, len(found), len(self.cases))]

    def _run(self, point: Array, steps: Steps) -> tuple[Array, ...]:
        first, last = steps.case.span
        found = []
        for one in self._innovations(point, steps).values():
            place = ((one.time - first) / (last - first) * self.parts).astype(np.int64)
            e, s = one.innovation.ravel(), one.variance.ravel()
            value = 0.5 * (np.log(s) + e * e / s) if one.weight is None else one.weight[:, 0]
            places = np.repeat(np.minimum(place, self.parts - 1), len(value) // max(len(place), 1))
            found.append((value, places, e, s))
        return tuple(np.concatenate(column) for column in zip(*found, strict=True))

    def _innovations(self, point: Array, steps: Steps) -> dict[str, Innovations]:
        """Return the innovations of a record that are used, by sensor."""
        chosen = self.setup(point)
        # The filter with error states, also without any, has the innovations of measurements whose noise differs by axis.
        used = replace(chosen, states=States() if chosen.states is None else chosen.states)
        # Only the first and the last state are stored.
        every = len(steps.record.increments)
        mixture: Any = tuple(map(float, outliers_at(point))) if self.mixed else None
        estimate = self._estimate(used, steps, every=every, gate=None, robust=None, outliers=mixture)
        first, last = steps.case.span
        found = estimate.innovations.items()
        return {name: selected(one, (one.time >= first) & (one.time <= last)) for name, one in found}

    def estimates(self, number: int, points: Array, epochs: np.ndarray) -> tuple[Array, Array, Array]:
        """Return q_fb (m, k, 4), bias (m, k, 3) and P (m, k, 6, 6) on record ``number`` at edges (m,), at points (k, p)."""
        every = max(1, int(np.gcd.reduce(epochs)))  # fewer rows, with the steps between them taken together
        options = {"every": every, "full_covariance": True}
        found = [self._estimate(self.setup(point), self.steps[number], **options) for point in points]
        kept = epochs // every
        rows = [(one.attitude[kept], one.bias[kept], one.covariance[kept]) for one in found]  # type: ignore[index]
        attitude, bias, P = (np.stack(parts, axis=1) for parts in zip(*rows, strict=True))
        return attitude, bias, P

    def _estimate(self, chosen: FilterSetup, steps: Steps, **options: Any) -> Estimate:
        record, initial = self.modelled(steps.record, chosen), self.initial(steps.case, chosen)
        return setup.run_modelled(record, chosen, initial, motion=steps.motion, **options)


Likelihood = LaneLikelihood | RunLikelihood
Made = TypeVar("Made", bound=Objective)


def construct(kind: type[Made], problem: Objective, **more: Any) -> Made:
    """Return an objective of this class for a problem."""
    return kind(**{one.name: getattr(problem, one.name) for one in fields(Objective)} | more)


def likelihood(
    cases: Sequence[Case],
    chosen: FilterSetup,
    free: Sequence[str],
    *,
    spacing: float = 0.0,
    parts: int = 20,
    threads: int = 1,
) -> Likelihood:
    """Return the likelihood of the free parameters from the innovations of the filter on some records.

    Parameters
    ----------
    cases : sequence of Case
        Records, with the filter's initial state on each.
    chosen : FilterSetup
        Starting values of the free parameters, and values of the fixed ones; its gate and robust weights are not applied.
    free : sequence of str
        Names of parameters: ``"gyro.arw"``, ``"gyro.rrw"``, ``"SENSOR.sigma"``, ``"SENSOR.sigma.x"`` (about one body axis),
        ``"initial.attitude"``, ``"initial.bias"``, those of the filter's error states such as ``"gyro.scale_sigma"`` and
        ``"SENSOR.correlation_time"``, or ``"filter.scale"`` alone.
    spacing : float, default 0
        Minimum time between the measurements of a sensor that are used, s; these have the weight of all. For correlated disturbances: this
        likelihood holds for white innovations only.
    parts : int, default 20
        Number of time spans of each record with separate gradients.
    threads : int, default 1
        Number of records, or points, evaluated in parallel.

    Returns
    -------
    Objective
        For :func:`fit`.
    """
    return with_engine(make_problem(cases, chosen, free, spacing=spacing, parts=parts, threads=threads))


def with_engine(problem: Objective, *, lanes: bool = True) -> Likelihood:
    """Return the likelihood of a problem, for eight points at once if the filter and ``lanes`` allow it."""
    steps = [setup.at_steps(case.record, problem.chosen) for case in problem.cases]
    records = [problem.modelled(record, problem.chosen) for record in steps]
    by_axis = any(axis_of(name) for name in problem.names) or any(
        one.anisotropic for record in records for one in record.vectors
    )
    if by_axis or problem.chosen.states is not None or not lanes:
        motions = [setup.measured_motion(record, problem.chosen) for record in records]
        return construct(RunLikelihood, problem, steps=tuple(map(Steps, problem.cases, steps, motions)))
    prepared = [_prepared(problem, *one) for one in zip(problem.cases, records, strict=True)]
    return construct(LaneLikelihood, problem, prepared=tuple(prepared))


def _prepared(problem: Objective, case: Case, record: ImuRecord) -> Prepared:
    start, end = float(record.time[0]), float(record.time[-1])
    first, last = max(case.first, start), min(case.last, end)
    inner = list(np.linspace(first, last, problem.parts + 1)[1:-1])
    before = [np.nextafter(case.first, -np.inf)] if case.first > start else []
    after = [case.last] if case.last < end else []
    initial = problem.initial(case, problem.chosen)
    return Prepared(
        time=record.time,
        increments=np.ascontiguousarray(record.increments),
        events=schedule(record.vectors, start, end),
        state=pack(initial.attitude, initial.bias, initial.covariance),
        cuts=np.array([*before, *inner, *after]),
        used=np.array([False] * len(before) + [True] * problem.parts + [False] * len(after)),
    )
