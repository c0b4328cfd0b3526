"""The likelihood of filter parameters from the filter's own innovations, with its score and information.

The innovations e of a filter are independent with variances s, so the likelihood of a record is ``Π N(e; 0, s)`` (prediction-error
decomposition; Schweppe 1965, Harvey 1989 section 3.4). The filter runs at eight points at once, with derivatives in the same pass. With
error states, standard errors are from the observed curvature at the maximum, by central differences of the score. The σ of a constant error
state is estimated from one draw per state and record: for a scale factor on three axes, one record determines it within a factor of 1.5 at
best.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any

import numpy as np

from strapdown.checks import Array
from strapdown.estimation import forward, setup
from strapdown.estimation import model as modelling
from strapdown.estimation.error_states import ErrorStates, temperature_slopes
from strapdown.estimation.forward import Problem
from strapdown.estimation.model import Model
from strapdown.estimation.schedule import Schedule
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.running import state_of_whole_bias
from strapdown.estimation.setup.states import States
from strapdown.estimation.states import State
from strapdown.kernels import layout, likelihood_outliers, machine, structure
from strapdown.kernels import likelihood as kernel
from strapdown.kernels.chains import SET
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.walk import walk
from strapdown.records import ImuRecord
from strapdown.tuning.objective import (
    OUTLIERS,
    PARTS,
    REACH,
    STEP,
    Case,
    Derivatives,
    Objective,
    joined,
    make_problem,
    outliers_at,
)
from strapdown.tuning.parameters import ARW, RRW, SCALE, SIGMA

MAX_DERIVATIVES = WIDTH - 1
"""Maximum number of derivatives in one pass over a record."""
CURVATURE_STEP = 0.02
"""Step of a log parameter for the curvature by differences of the score."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A record in the form of the kernel."""

    case: Case
    steps: ImuRecord
    """The record at the rate of the filter's steps, with its own σ."""
    problem: Problem
    """The same with the σ of the starting point, and the filter there."""
    filter: tuple[Model, State]
    """Model of the error states, whose structure is the same at every point, and initial state with them, at the starting point."""
    cuts: Array
    used: np.ndarray
    """Which parts are used (parts,), bool."""
    lengths: Array
    turning: Array
    """Divisors of the effects of error states on the measurements, and rates and angular accelerations there, for the kernel."""
    warming: Array
    """Change of temperature at the edges since the start (n + 1,), K; (0,) without slopes of the gyro's bias."""
    driven: np.ndarray
    """Places in the model's numbers of that change."""

    def instance_of(self, template: ModuleType) -> ModuleType:
        """Return a template of the kernels for the filter; no field, because a module cannot be pickled."""
        return machine.instance(template, STRUCTURE=self.filter[0].structure, LANES=WIDTH, PARAMETERS=True)


@dataclass(frozen=True, kw_only=True, eq=False)
class Likelihood(Objective):
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
        parts = []
        for k in range(0, len(results), len(blocks)):
            score, information = np.zeros((len(results[k].value), p)), np.zeros((p, p))
            for block, part in zip(blocks, results[k : k + len(blocks)], strict=True):
                score[:, block] = part.score
                information[np.ix_(block, block)] = part.information
            parts.append(replace(results[k], score=score, information=information))
        return joined(parts)

    def _differences(self, case: Prepared, point: Array, block: tuple[int, ...]) -> Derivatives:
        rows = np.concatenate([point[None], point + STEP * np.eye(len(point))[list(block)]])
        written = self._pass(case, rows, free=len(block))
        lower = written["information"]
        return Derivatives(
            value=written["minus_log"][case.used, 0],
            score=written["score"][case.used],
            information=(lower + np.tril(lower, -1).transpose(0, 2, 1))[case.used].sum(axis=0),
        )

    def curvature(self, point: Array) -> Array | None:
        """Return the observed information at a point (p, p), with error states, of which one record has few draws."""
        if self.filter_setup.states is None:
            return None
        steps = CURVATURE_STEP * np.eye(len(point))
        ends = [[self.derivatives(point + sign * step).score.sum(axis=0) for sign in (1.0, -1.0)] for step in steps]
        rows = np.array([(ahead - back) / (2.0 * CURVATURE_STEP) for ahead, back in ends])
        return np.asarray(0.5 * (rows + rows.T))

    def outliers(self, point: Array) -> list[tuple[str, Array]]:
        """Return of each record and sensor the probability that a measurement is an outlier, and the share of its own noise (m, 2)."""
        by_sensor = []
        for case in self.prepared:
            rows = self._pass(case, point[None], outliers=True)["probability"]
            events = case.problem.events
            used = case.used[np.searchsorted(case.cuts, events.time, side="left")]
            by_sensor += [(name, rows[used & (events.sensor == k)]) for k, name in enumerate(events.sensors)]
        return by_sensor

    def estimates(self, number: int, points: Array, epochs: np.ndarray) -> tuple[Array, Array, Array]:
        """Return q_fb (m, k, 4), whole bias (m, k, 3) and P (m, k, 6, 6) on record ``number`` at edges (m,), at points (k, p).

        If the setup has a gate or robust weights, they are applied.
        """
        case = self.prepared[number]
        if self.filter_setup.gate is None and self.filter_setup.robust is None:
            jobs = [(case, points[first : first + WIDTH], epochs) for first in range(0, len(points), WIDTH)]
            parts = self.each(self._estimates, jobs)
        else:
            parts = self.each(self._gated, [(case, point, epochs) for point in points])
        attitude, bias, P = (np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True))
        return attitude, bias, P

    def _estimates(self, case: Prepared, points: Array, epochs: np.ndarray) -> tuple[Array, Array, Array]:
        written = self._pass(case, points, epochs=epochs)
        m, k = len(epochs), len(points)
        x, triangle = (np.moveaxis(written[name].reshape(m, -1, WIDTH), 1, 2)[:, :k] for name in ("x", "P"))
        n = x.shape[2] - 1
        P = np.empty((m, k, n, n))
        a, b = np.triu_indices(n)
        P[..., a, b] = P[..., b, a] = triangle
        setups = [self.setup(point) for point in points]
        model = case.filter[0]
        whole = np.tile(np.eye(6, n), (m, 1, 1, 1))
        whole[..., 3:, 6:] = model.offsets.T
        if len(case.warming):
            slopes = _slopes(case.problem.error_states)
            whole[..., 3:, 6 + slopes.start : 6 + slopes.stop] *= case.warming[epochs, None, None, None]
        bias = (whole[..., 3:, 3:] @ x[..., 4:, None])[..., 0]
        fast = np.array([(filter_setup.states or States()).gyro_fast_bias_sigma for filter_setup in setups])
        at_start = np.where((epochs == 0) & (len(case.case.initial.values) == 0), -1.0, 1.0)
        added = (at_start[:, None] * fast**2)[..., None, None] * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
        return x[..., :4], bias, whole @ P @ np.swapaxes(whole, -1, -2) + added

    def _gated(self, case: Prepared, point: Array, epochs: np.ndarray) -> tuple[Array, Array, Array]:
        filter_setup = self.setup(point)
        every = max(1, int(np.gcd.reduce(epochs)))  # fewer rows, with the steps between them taken together
        record, initial = self.modelled(case.steps, filter_setup), self.initial(case.case, filter_setup)
        options: dict[str, Any] = {"motion": case.problem.motion, "every": every, "full_covariance": True}
        estimate = setup.run_modelled(record, filter_setup, initial, **options)
        rows = epochs // every
        assert estimate.covariance is not None
        return estimate.attitude[rows, None], estimate.bias[rows, None], estimate.covariance[rows, None]

    # ------------------------------------------------------------------------------------------------------- lanes

    def _filters(self, case: Prepared, points: Array) -> list[tuple[Model, State]]:
        """Return model and initial state of the filter of each point; gyro noise, σ of sensors and outliers leave them as they are."""
        others = [j for j, name in enumerate(self.names) if not (name in (ARW, RRW, *OUTLIERS) or name.endswith(SIGMA))]
        if not others:
            return [case.filter] * len(points)
        _, first, place = np.unique(points[:, others], axis=0, return_index=True, return_inverse=True)
        # Zero, −∞, would be no state.
        setups = [self.setup(np.maximum(points[k], self.start - 2.0 * REACH)) for k in first]
        filters = [_filter(self, case.case, case.problem.events, filter_setup) for filter_setup in setups]
        return [filters[k] for k in place.ravel()]

    def _factors(self, case: Prepared, lane: dict[str, Array]) -> Array:
        """Return the factors on σ about each axis of each sensor (sensors, 3, WIDTH)."""
        base = dict(zip(self.names, np.exp(self.start), strict=True))
        names = [f"{sensor}{SIGMA}" for sensor in case.problem.events.sensors]
        common = lane.get(SCALE, np.ones(WIDTH))
        factors = np.array([lane[name] / base[name] if name in lane else common for name in names])
        return np.repeat(factors[:, None], 3, axis=1)

    def _body(self, case: Prepared, points: Array) -> kernel.Body:
        """Return the filters of up to eight points (k, p); those of the first fill the lanes that remain."""
        rows = np.concatenate([points, np.repeat(points[:1], WIDTH - len(points), axis=0)])
        lane = {name: np.exp(rows[:, j]) for j, name in enumerate(self.names)}
        noise, ones = self.filter_setup.process_noise, lane.get(SCALE, np.ones(WIDTH))
        models, states = zip(*self._filters(case, rows), strict=True)
        model, sizes = models[0], case.instance_of(layout)
        decay, chains = np.stack([model.decay for model in models]), np.stack([model.chains for model in models])
        rates = [(a.tobytes(), b.tobytes()) for a, b in zip(decay, chains, strict=True)]
        x, P = np.zeros((2, (sizes.N + 1) * WIDTH)), np.zeros((2, sizes.SIZE_OF_P))
        x[0] = _in_lanes([np.concatenate([state.attitude, state.bias, state.values]) for state in states])
        P[0] = _in_lanes([state.covariance[np.triu_indices(sizes.N)] for state in states])
        return kernel.Body(
            filters=structure.Body(
                model=structure.Model(
                    angle_variance=lane.get(ARW, ones * noise.angle_random_walk) ** 2,
                    rate_variance=lane.get(RRW, ones * noise.rate_random_walk) ** 2,
                    numbers=_in_lanes([model.numbers for model in models]),
                    decay=_in_lanes(list(decay)),
                    chains=_in_lanes(list(chains)),
                    last=model.last,
                    limit=min(model.limit for model in models),
                    force_f=tuple(model.force_f.tolist()),
                ),
                x=x,
                P=P,
                coefficients=np.zeros(SET * max(len(model.last), 1) * WIDTH),
                dt=np.zeros(1),
                work=np.zeros(sizes.LINES * sizes.LINE * WIDTH),
                shape=model.shape,
                length=case.lengths,
                turning=case.turning,
                offsets=model.offsets,
                factors=self._factors(case, lane).ravel(),
            ),
            decay=decay,
            chains=chains,
            same=np.array([rates.index(rate) for rate in rates]),
            coefficients=np.zeros(SET * max(len(model.last), 1)),
            driven=case.driven,
            temperature=0.5 * (case.warming[1:] + case.warming[:-1]),
            outliers=np.concatenate(outliers_at(rows)) if self.mixed else np.empty(0),
            cuts=read_only(case.cuts),
            epochs=np.empty(0, np.int64),
            free=0,
            step=STEP,
            room=np.empty(kernel.ROOM),
        )

    def _pass(
        self,
        case: Prepared,
        points: Array,
        *,
        free: int = 0,
        epochs: np.ndarray | None = None,
        outliers: bool = False,
    ) -> dict[str, Array]:
        """Run up to eight points over one record; return the outputs by names of :class:`strapdown.kernels.likelihood.Outputs`."""
        body = self._body(case, points)
        kept = np.empty(0, np.int64) if epochs is None else np.ascontiguousarray(epochs, np.int64)
        parts, events = len(case.cuts) + 1, case.problem.events
        room = {
            "minus_log": np.zeros((parts, WIDTH)),
            "score": np.zeros((parts, free)),
            "information": np.zeros((parts, free, free)),
            "x": np.empty((len(kept), body.filters.x.shape[1])),
            "P": np.empty((len(kept), body.filters.P.shape[1])),
            "probability": np.empty((len(events.time) if outliers else 0, 2)),
        }
        out = kernel.Outputs(**room | {"minus_log": room["minus_log"].reshape(-1)})
        bodies = map(case.instance_of, (likelihood_outliers, kernel) if self.mixed else (kernel,))
        compiled(walk, *bodies)(*case.problem.gyro, events.measurements, 1, body._replace(free=free, epochs=kept), out)
        return room


def _slopes(blocks: Sequence[ErrorStates]) -> slice:
    """Return the places of the slopes of the gyro's bias over temperature among the error states; empty if there are none."""
    return temperature_slopes(blocks) or slice(0, 0)


def _in_lanes(columns: Sequence[Array]) -> Array:
    """Return an array of each lane as one flat array, whose last axis is that of the lanes."""
    return np.stack(columns, axis=-1).reshape(-1)


def _pairs_of_groups(p: int) -> list[tuple[int, ...]]:
    """Return sets of at most six parameters such that any two parameters are in one of them: each pair of groups of three."""
    groups = [range(first, min(first + 3, p)) for first in range(0, p, 3)]
    return [(*a, *b) for a, b in itertools.combinations(groups, 2)]


def likelihood(
    cases: Sequence[Case],
    setup: FilterSetup,
    free: Sequence[str],
    *,
    spacing: float = 0.0,
    threads: int = 1,
) -> Likelihood:
    """Return the likelihood of the free parameters from the innovations of the filter on some records.

    Parameters
    ----------
    cases : sequence of Case
        Records, with the filter's initial state on each.
    setup : FilterSetup
        Starting values of the free parameters, and values of the fixed ones; its gate and robust weights are not applied.
    free : sequence of str
        Names of parameters: ``"gyro.arw"``, ``"gyro.rrw"``, ``"SENSOR.sigma"``, ``"initial.attitude"``, ``"initial.bias"``, those of the
        filter's error states such as ``"gyro.scale_sigma"`` and ``"SENSOR.correlation_time"``, or ``"filter.scale"`` alone.
    spacing : float, default 0
        Minimum time between the measurements of a sensor that are used, s; these have the weight of all. For correlated disturbances: this
        likelihood holds for white innovations only.
    threads : int, default 1
        Number of records, or points, evaluated in parallel.

    Returns
    -------
    Objective
        For :func:`fit`.
    """
    problem = make_problem(cases, setup, free, spacing=spacing, threads=threads)
    return Likelihood(**vars(problem), prepared=tuple(_prepared(problem, case) for case in problem.cases))


def _filter(problem: Objective, case: Case, events: Schedule, filter_setup: FilterSetup) -> tuple[Model, State]:
    """Return the model of the error states of a setup, and the initial state with them."""
    states, kinds = filter_setup.states or States(), dict(zip(events.sensors, events.kinds, strict=True))
    blocks = states.blocks(kinds)
    start = state_of_whole_bias(problem.initial(case, filter_setup), blocks, states.gyro_fast_bias_sigma)
    model = modelling.assemble(blocks, kinds, isotropic=events.noise_by_axis is None, generic=True)
    return model, modelling.begin(start, blocks)


def _prepared(problem: Objective, case: Case) -> Prepared:
    steps = setup.at_steps(case.record, problem.filter_setup)
    record = problem.modelled(steps, problem.filter_setup)
    motion = setup.measured_motion(record, problem.filter_setup)
    initial = problem.initial(case, problem.filter_setup)
    prepared = replace(setup.prepared(record, problem.filter_setup, initial), motion=motion)
    model, state = _filter(problem, case, prepared.events, problem.filter_setup)
    start, end = float(record.time[0]), float(record.time[-1])
    first, last = max(case.first, start), min(case.last, end)
    inner = list(np.linspace(first, last, PARTS + 1)[1:-1])
    before = [np.nextafter(case.first, -np.inf)] if case.first > start else []
    after = [case.last] if case.last < end else []
    slopes = _slopes(prepared.error_states)
    hot = range(6 + slopes.start, 6 + slopes.stop)
    temperature = forward.driving_temperature(prepared) if hot else np.empty(0)
    return Prepared(
        case=case,
        steps=steps,
        problem=prepared,
        filter=(model, state),
        cuts=np.array([*before, *inner, *after]),
        used=np.array([False] * len(before) + [True] * PARTS + [False] * len(after)),
        lengths=forward.divisors(
            record, prepared.events, prepared.model, forward.unit_sigmas(record, prepared.model, {})
        ),
        turning=forward.turns(prepared),
        warming=temperature - temperature[:1],
        driven=np.array([g.offset[g.state - hot[0]][0] for g in model.structure.gyro if g.state in hot], np.int64),
    )
