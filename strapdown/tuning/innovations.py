"""The likelihood of filter parameters from the filter's own innovations, with its score and information.

The filter turns a record into independent innovations e with variances s, so its likelihood is ``Π N(e; 0, s)`` (prediction-error
decomposition; Schweppe 1965, Harvey 1989 section 3.4). Parameters are the logarithms of their values.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from strapdown import setup
from strapdown.checks import Array, InputError, count
from strapdown.estimation.schedule import Schedule, schedule
from strapdown.estimation.states import State, covariance_matrices, pack
from strapdown.kernels import likelihood as kernel
from strapdown.kernels import likelihood_outliers
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.walk import walk
from strapdown.records import ImuRecord
from strapdown.setup import FilterSetup
from strapdown.tuning.parameters import (
    ARW,
    INITIAL_ATTITUDE,
    INITIAL_BIAS,
    RRW,
    SCALE,
    SIGMA,
    checked_names,
    values_of,
    with_values,
)
from strapdown.vectors import VectorMeasurements

STEP = 2.0**-15
"""Step of a log-parameter for derivatives: the difference is wrong by half of it relative to the curvature, 1.5e-5."""
MOST = WIDTH - 1
"""Derivatives that one pass over a record gives."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A record to tune on, with the filter's initial state.

    Parameters
    ----------
    record : ImuRecord
        Gyro increments and measurements, at the gyro's rate.
    initial : State
        State at the first edge; its covariance is the setup's where the initial σ are tuned.
    name : str, default ""
        What errors and reports call the record.
    first : float, default -inf
        Innovations from this time on count for tuning, s.
    last : float, default inf
        Innovations up to this time count for tuning, s; what comes later is held out.
    true_attitude : ndarray (n + 1, 4), optional
        q_fb at the edges from a reference system, where the record itself has no truth; rows of NaN are unknown.
    judged : ndarray (n + 1,) of bool, optional
        Edges at which errors against ``true_attitude`` count. Default: all.
    """

    record: ImuRecord
    initial: State
    name: str = ""
    first: float = -np.inf
    last: float = np.inf
    true_attitude: Array | None = None
    judged: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Derivatives:
    """Minus the log likelihood, without its constant, and its derivatives by the log parameters, part by part."""

    value: Array
    """(parts,)"""
    score: Array
    """Its gradient (parts, p)."""
    information: Array
    """Fisher's information from the sensitivities of the innovations (p, p), summed over the parts."""
    outer: Array
    """Σ g gᵀ over the measurements (p, p), g the gradient of each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A record as the kernel takes it."""

    time: Array
    increments: Array
    events: Schedule
    state: Array
    cuts: Array
    used: np.ndarray
    """Which parts count (parts,), bool."""
    sensors: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Likelihood:
    """Minus the log likelihood of the innovations of several records under one set of parameters.

    Built by :func:`likelihood`. A *point* is the vector of the logarithms of the free parameters; −∞ is a value of zero.
    """

    names: tuple[str, ...]
    chosen: FilterSetup
    """The setup that the fixed parameters are taken from."""
    start: Array
    """Logarithms of the free parameters in that setup (p,)."""
    prepared: tuple[Prepared, ...] = field(repr=False)
    threads: int = 1
    composite: ClassVar[bool] = False

    def setup(self, point: Array) -> FilterSetup:
        """Return the setup of a point."""
        return with_values(self.chosen, dict(zip(self.names, np.exp(point).tolist(), strict=True)))

    def minus_log(self, points: Array) -> Array:
        """Return minus the log likelihood, without its constant, at several points (k, p): (k,)."""
        return self.totals(points, self._pass)

    def totals(self, points: Array, run: Callable[[Prepared, Array], dict[str, Array]]) -> Array:
        """Return the sum over the records of what ``run`` finds of each point, eight at once."""
        rows = np.atleast_2d(points)
        blocks = [rows[first : first + WIDTH] for first in range(0, len(rows), WIDTH)]
        jobs = [(case, block) for block in blocks for case in self.prepared]
        results = self.each(lambda job: run(*job)["minus_log"][job[0].used].sum(axis=0)[: len(job[1])], jobs)
        sums = [np.sum(results[k : k + len(self.prepared)], axis=0) for k in range(0, len(jobs), len(self.prepared))]
        return np.concatenate(sums)

    def derivatives(self, point: Array) -> Derivatives:
        """Return the likelihood and its derivatives at a point; one pass over each record for up to seven parameters."""
        p = len(self.names)
        blocks = [tuple(range(p))] if p <= MOST else _pairs_of_groups(p)
        jobs = [(case, block) for case in self.prepared for block in blocks]
        results = self.each(lambda job: self._differences(job[0], point, job[1]), jobs)
        values, scores = [], []
        information, outer = np.zeros((p, p)), np.zeros((p, p))
        for k, case in enumerate(self.prepared):
            score, matrices = np.zeros((int(case.used.sum()), p)), np.zeros((2, p, p))
            for block, (_, part_score, part_information, part_outer) in zip(
                blocks, results[k * len(blocks) : (k + 1) * len(blocks)], strict=True
            ):
                score[:, block] = part_score
                matrices[:, np.array(block)[:, None], block] = part_information, part_outer
            values.append(results[k * len(blocks)][0])
            scores.append(score)
            information += matrices[0]
            outer += matrices[1]
        return Derivatives(
            value=np.concatenate(values), score=np.concatenate(scores), information=information, outer=outer
        )

    def each(self, work: Callable[[Any], Any], jobs: Sequence[Any]) -> list[Any]:
        """Return ``work`` of every job, spread over the threads."""
        if self.threads == 1 or len(jobs) == 1:
            return [work(job) for job in jobs]
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(work, jobs))

    def _differences(self, case: Prepared, point: Array, block: tuple[int, ...]) -> tuple[Array, ...]:
        rows = np.tile(point, (1 + len(block), 1))
        for row, j in enumerate(block):
            rows[row + 1, j] += STEP
        found = self._pass(case, rows, free=len(block))
        whole = [lower + np.tril(lower, -1).transpose(0, 2, 1) for lower in (found["information"], found["outer"])]
        used = case.used
        return found["minus_log"][used, 0], found["score"][used], *(part[used].sum(axis=0) for part in whole)

    def estimates(self, number: int, points: Array, epochs: np.ndarray) -> tuple[Array, Array, Array]:
        """Return q_fb (m, k, 4), bias (m, k, 3) and P (m, k, 6, 6) on record ``number`` at edges (m,), at up to eight points (k, p)."""
        found = self._pass(self.prepared[number], points, epochs=epochs)["states"][:, :, : len(points)]
        states = np.moveaxis(found, 1, 2)
        return states[..., :4], states[..., 4:7], covariance_matrices(states[..., 7:])

    def innovations(self, number: int, points: Array) -> tuple[Array, Array]:
        """Return innovations and variances (events, 3, k) of record ``number`` at up to eight points (k, p), rows a measurement lacks 0."""
        found = self._pass(self.prepared[number], points, innovations=True)["innovations"]
        return found[:, :, 0, : len(points)], found[:, :, 1, : len(points)]

    def lanes(self, case: Prepared, points: Array) -> dict[str, Array]:
        """Return what a kernel takes of up to eight points (k, p), flat: ``noise``, ``factors`` of the sensors' variances, ``state``."""
        rows = np.concatenate([points, np.repeat(points[:1], WIDTH - len(points), axis=0)])
        lane = {name: np.exp(rows[:, j]) for j, name in enumerate(self.names)}
        base = dict(zip(self.names, np.exp(self.start), strict=True))
        noise = self.chosen.process_noise
        all_of = lane.get(SCALE, np.ones(WIDTH))
        white = lane.get(ARW, np.full(WIDTH, noise.angle_random_walk) * all_of) ** 2
        walk = lane.get(RRW, np.full(WIDTH, noise.rate_random_walk) * all_of) ** 2
        factors = np.array(
            [
                (lane[f"{sensor}{SIGMA}"] / base[f"{sensor}{SIGMA}"]) ** 2 if f"{sensor}{SIGMA}" in lane else all_of**2
                for sensor in case.sensors
            ]
        )
        state = np.repeat(case.state[:, None], WIDTH, axis=1)
        angle = lane[INITIAL_ATTITUDE] / base[INITIAL_ATTITUDE] if INITIAL_ATTITUDE in lane else all_of
        bias = lane[INITIAL_BIAS] / base[INITIAL_BIAS] if INITIAL_BIAS in lane else all_of
        state[7:13] *= angle**2
        state[13:22] *= angle * bias
        state[22:] *= bias**2
        return {"noise": np.concatenate([white, walk]), "factors": factors.ravel(), "state": state.ravel()}

    def _pass(
        self,
        case: Prepared,
        points: Array,
        *,
        free: int = 0,
        epochs: np.ndarray | None = None,
        innovations: bool = False,
    ) -> dict[str, Array]:
        """Run up to eight points over one record."""
        kept = np.empty(0, np.int64) if epochs is None else np.ascontiguousarray(epochs, np.int64)
        room = pass_arrays(case, free, epochs=len(kept), innovations=innovations)
        run_lanes(case, self.lanes(case, points), room, free, kept)
        return room


def pass_arrays(
    case: Prepared, free: int, *, epochs: int = 0, innovations: bool = False, outliers: bool = False
) -> dict[str, Array]:
    """Return room for what one pass over a record writes, by its name in :class:`strapdown.kernels.likelihood.Outputs`."""
    parts, events = len(case.cuts) + 1, len(case.events.time)
    return {
        "minus_log": np.zeros((parts, WIDTH)),
        "squares": np.zeros((parts, WIDTH)),
        "score": np.zeros((parts, free)),
        "information": np.zeros((parts, free, free)),
        "outer": np.zeros((parts, free, free)),
        "states": np.empty((epochs, 28, WIDTH)),
        "innovations": np.zeros((events if innovations else 0, 3, 2, WIDTH)),
        "probability": np.empty((events if outliers else 0, 2)),
    }


def run_lanes(
    case: Prepared,
    lane: Mapping[str, Array],
    room: Mapping[str, Array],
    free: int,
    epochs: np.ndarray,
    outliers: Array | None = None,
) -> None:
    """Run the filter over a record at the parameters of each lane; with ``outliers`` by the mixture."""
    flat = ("minus_log", "squares", "states", "innovations")
    body = kernel.Body(
        **lane,
        outliers=np.empty(0) if outliers is None else outliers,
        cuts=read_only(case.cuts),
        epochs=epochs,
        free=free,
        step=STEP,
        room=np.empty(kernel.ROOM),
    )
    out = kernel.Outputs(**{name: value.reshape(-1) if name in flat else value for name, value in room.items()})
    parts = (kernel,) if outliers is None else (likelihood_outliers, kernel)
    compiled(walk, *parts)(read_only(case.time), read_only(case.increments), case.events.measurements, 1, body, out)


def _pairs_of_groups(p: int) -> list[tuple[int, ...]]:
    """Return blocks of at most six parameters such that every two share one: each pair of groups of three."""
    groups = [range(first, min(first + 3, p)) for first in range(0, p, 3)]
    return [(*a, *b) for a, b in itertools.combinations(groups, 2)]


def likelihood(
    cases: Sequence[Case],
    chosen: FilterSetup,
    free: Sequence[str],
    *,
    spacing: float = 0.0,
    parts: int = 20,
    threads: int = 1,
) -> Likelihood:
    """Return the likelihood of the free parameters, by the innovations of the filter on some records.

    Parameters
    ----------
    cases : sequence of Case
        Records, with the filter's initial state on each.
    chosen : FilterSetup
        Starting values of the free parameters, and values of the fixed ones; its gate and robust weights are not applied.
    free : sequence of str
        Names of parameters: ``"gyro.arw"``, ``"gyro.rrw"``, ``"SENSOR.sigma"``, ``"initial.attitude"``, ``"initial.bias"``, or
        ``"filter.scale"`` alone.
    spacing : float, default 0
        Least time between the measurements of a sensor that are used, s; those kept have the weight of all. For disturbances that last:
        only white innovations have this likelihood.
    parts : int, default 20
        Spans of time of each record whose gradients are kept apart.
    threads : int, default 1
        Records, or points, evaluated at once.

    Returns
    -------
    Likelihood
        For :func:`fit`.
    """
    setup.need_mekf(chosen, "tuning by name")
    if not cases:
        raise InputError("there is no record to tune on; give one")
    records = [case.record for case in cases]
    if chosen.states is not None:
        raise InputError(
            "the setup has optional states, which this likelihood knows nothing of; use tuning.extended.likelihood"
        )
    names = checked_names(free, records)
    values = values_of(chosen, names, records)
    for name, value in values.items():
        if value <= 0.0:
            raise InputError(f"{name} starts from {value:g}; it must start from a number greater than zero")
    started = with_values(chosen, values)
    prepared = tuple(_prepare(case, started, names, count("parts", parts), spacing) for case in cases)
    return Likelihood(
        names=names, chosen=started, start=np.log(list(values.values())), prepared=prepared, threads=threads
    )


def thinned(series: VectorMeasurements, spacing: float) -> VectorMeasurements:
    """Return the measurements of a series that lie at least ``spacing`` s apart, their σ lowered so that they weigh as much as all did.

    A disturbance that lasts over n samples makes them worth one; a filter that takes them for independent needs a σ larger by √n. Thinned
    to where disturbances are independent, that σ can be estimated; the filter then uses it on every sample.
    """
    usable = np.flatnonzero(
        np.isfinite(series.attitude if series.attitude is not None else series.vector_b).all(axis=1)
    )
    # A hair less, so that stamps on a grid of the very spacing are kept.
    kept, due = [], -np.inf
    for k in usable:
        if series.time[k] >= due:
            kept.append(k)
            due = series.time[k] + spacing * (1.0 - 1e-6)
    if len(kept) == len(series.time):
        return series
    return series.taken(np.array(kept, np.int64)).noise_scaled(float(np.sqrt(len(kept) / max(len(usable), 1))))


def _prepare(case: Case, chosen: FilterSetup, names: tuple[str, ...], parts: int, spacing: float) -> Prepared:
    sensors = [series.sensor for series in case.record.vectors]
    own = {name: value for name, value in chosen.sigma.items() if name in sensors}
    record = setup.modelled_record(case.record, replace(chosen, sigma=own))
    for series in record.vectors:
        if series.anisotropic:
            raise InputError(
                f"{series.sensor}: this likelihood takes one sigma a sample, not sigma_axes or covariance; free {series.sensor}.sigma.x, "
                ".y and .z in tuning.extended.likelihood, or give one number in [filter.sigma]"
            )
    if spacing > 0.0:
        record = replace(record, vectors=tuple(thinned(series, spacing) for series in record.vectors))
    start, end = float(record.time[0]), float(record.time[-1])
    events = schedule(record.vectors, start, end)
    first, last = max(case.first, start), min(case.last, end)
    inside = (events.time >= first) & (events.time <= last)
    if not inside.any():
        raise InputError(
            f"{case.name or 'record'} has no measurement between {first:g} and {last:g} s; tuning needs vector measurements"
        )
    inner = list(np.linspace(first, last, parts + 1)[1:-1])
    before = [np.nextafter(case.first, -np.inf)] if case.first > start else []
    after = [case.last] if case.last < end else []
    used = np.ones(len(inner) + 1 + len(before) + len(after), bool)
    if before:
        used[0] = False
    if after:
        used[-1] = False
    covariance = case.initial.covariance
    if {INITIAL_ATTITUDE, INITIAL_BIAS} & set(names):
        covariance = np.diag(np.repeat([chosen.attitude_sigma**2, chosen.bias_sigma**2], 3))
    return Prepared(
        time=record.time,
        increments=np.ascontiguousarray(record.increments),
        events=events,
        state=pack(case.initial.attitude, case.initial.bias, covariance),
        cuts=np.array([*before, *inner, *after]),
        used=used,
        sensors=events.sensors,
    )
