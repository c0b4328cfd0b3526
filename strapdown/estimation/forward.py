"""The compiled filter over whole records: :func:`run`, and :func:`run_part` for a record in parts.

The filter is that of :mod:`strapdown.kernels.filter`, compiled for its number of states. Six states without a gate stay in registers
(:mod:`strapdown.kernels.six_states`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from strapdown.checks import Array, InputError, are_finite, count, is_definite, lengths
from strapdown.estimation import model as modelling
from strapdown.estimation.angular_acceleration import turning
from strapdown.estimation.error_states import ErrorStates, GyroTemperature, spans
from strapdown.estimation.gating import LOCK_OUT, Gate, Robust
from strapdown.estimation.model import Model
from strapdown.estimation.schedule import Schedule, innovations_by_sensor, schedule, skipped_too
from strapdown.estimation.states import (
    Candidate,
    Change,
    GateMemory,
    ProcessNoise,
    State,
    changed,
    check_arguments,
    covariance_matrices,
    first_bias_variance,
    pack,
    restart_bias_variance,
)
from strapdown.kernels import (
    chains,
    gate,
    gate_rules,
    iterated_update,
    layout,
    machine,
    restart_candidate,
    six_states,
    structure,
)
from strapdown.kernels import filter as filter_kernels
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.kernels.walk import walk
from strapdown.records import ErrorStateEstimate, Estimate, Event, ImuRecord
from strapdown.records.recording import GAP
from strapdown.vectors import KINDS, VectorMeasurements


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a run over a record."""

    every: int = 1
    full_covariance: bool = False
    error_state_covariance: bool = True
    """Whether ``full_covariance`` includes the covariance of the error states."""
    gate: Gate | None = None
    robust: Robust | None = None
    segments: int = 0
    """Maximum number of predictions to store for a smoother."""
    whole_bias: bool = False
    """Report the whole gyro bias, including the contributions of the error states, and with ``full_covariance`` its covariance instead of
    that of all states."""

    def __post_init__(self) -> None:
        """Check the classes of gate and robust."""
        check_arguments(gate=self.gate, robust=self.robust)

    @property
    def judged(self) -> bool:
        """Whether measurements are tested or weighted."""
        return self.gate is not None or self.robust is not None


class Span(NamedTuple):
    """A part of a record."""

    last: int
    """Last edge."""
    change: Change | None = None
    """Changes the state before the next span."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """A record, prepared for the kernels."""

    record: ImuRecord
    events: Schedule
    process_noise: ProcessNoise
    initial: State
    error_states: tuple[ErrorStates, ...] = ()
    model: Model
    motion: tuple[Array, Array] | None = None
    """:func:`strapdown.estimation.angular_acceleration.turning` at the events, if known; None: computed for a lever arm."""
    spans: tuple[Span, ...] = ()
    """Parts of the record, in order of time; empty: the whole."""

    @property
    def variances(self) -> tuple[float, float]:
        """σ_v², rad²/s, and σ_u², rad²/s³."""
        return self.process_noise.angle_random_walk**2, self.process_noise.rate_random_walk**2

    @property
    def gyro(self) -> tuple[Array, Array]:
        """Edges of the intervals (n + 1,), s, and increments (n, 3), rad, for the kernels."""
        return read_only(self.record.time), read_only(self.record.increments)


@dataclass(frozen=True, kw_only=True, eq=False)
class Passed:
    """Result of the filter over a record."""

    estimate: Estimate
    make_end: Callable[[], State] = field(repr=False)
    segments: Array
    """A row for each prediction, as stored by the kernel of the form, and one more for the end state."""

    @property
    def end(self) -> State:
        """End state, built and checked on request."""
        return self.make_end()


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    error_states: Sequence[ErrorStates] = (),
    *,
    every: int = 1,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> Estimate:
    """Run the multiplicative EKF over a whole record.

    Gyro intervals are split exactly at the times of measurements. Intervals with a rotation of more than a third of a radian are divided
    into sub-steps of the same constant-rate model. Missing measurements (NaN) and those outside the record are counted as skipped; gaps
    of the gyro are reported as events.

    Parameters
    ----------
    record : ImuRecord
        Increments are treated as rotations at constant rate: correct them for coning first (:func:`strapdown.records.compress`).
    process_noise : ProcessNoise
        Angle random walk and rate random walk of the gyro, as the filter models them.
    initial : State
        State at the first edge. If it has no error states, these start at zero with their declared sigma.
    error_states : sequence of ErrorStates
        States in addition to attitude and gyro bias. Default: none.
    every : int
        Store every ``every``-th edge, starting with the first. With error states, rows for different ``every`` agree to rounding.
    full_covariance : bool
        Whether to store whole covariance matrices too.
    gate : Gate, optional
        Gate that refuses improbable measurements and recovers if the refused ones agree with each other; error states then restart.
        Default: use all measurements.
    robust : Robust, optional
        Robust updates, which weight measurements by their residuals. Default: all equally.

    Returns
    -------
    Estimate
        Attitude, bias and error states with their variances at the stored edges; innovations of every sensor; events.

    Raises
    ------
    InputError
        If an argument is invalid.
    """
    options = Options(every=count("every", every), full_covariance=full_covariance, gate=gate, robust=robust)
    return filtered(prepared(record, process_noise, initial, error_states), options).estimate


def run_part(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    error_states: Sequence[ErrorStates] = (),
    *,
    every: int = 1,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> tuple[Estimate, State]:
    """Run the filter and return the end state too, from which the next part of a record continues, bit for bit.

    The end state includes the gate's state: its counts, its candidate, and the σ of the next restart. A lock-out that continues is reported
    by both parts, by the second as a whole.

    Effects that are constant in a sensor's own unit (``varying``) refer in all parts to the first part with the sensor: to the magnitude at
    the root mean square σ there (``unit_sigma`` of the state). A run over the whole record refers to that of the whole record, and so has
    another prior, unless ``initial`` has the same one. With a lever arm parts agree only to about 1e-6 of their estimates: the angular
    acceleration is computed from the gyro samples around each measurement, at a cut from those on one side.
    """
    options = Options(every=count("every", every), full_covariance=full_covariance, gate=gate, robust=robust)
    passed = filtered(prepared(record, process_noise, initial, error_states), options)
    return passed.estimate, passed.end


def run_spans(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    error_states: Sequence[ErrorStates],
    spans: Sequence[Span],
    *,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> Estimate:
    """Run the filter over a record in spans, between which the state changes.

    The row of a common edge is that before the change. Whole covariances are those of attitude and bias only.
    """
    options = Options(full_covariance=True, error_state_covariance=False, gate=gate, robust=robust)
    problem = prepared(record, process_noise, initial, error_states)
    return filtered(replace(problem, spans=tuple(spans)), options).estimate


def prepared(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    error_states: Sequence[ErrorStates],
) -> Problem:
    """Return a record with its measurements in order of time, and the error states as arrays."""
    check_arguments(record=record, process_noise=process_noise)
    declared = modelling.as_blocks(error_states)
    state = modelling.begin(initial, declared)
    events = schedule(record.vectors, record.time[0], record.time[-1])
    kinds = dict(zip(events.sensors, events.kinds, strict=True))
    model = modelling.assemble(declared, kinds, isotropic=events.noise is None)
    return Problem(
        record=record,
        events=events,
        process_noise=process_noise,
        initial=state,
        error_states=declared,
        model=model,
    )


def filtered(problem: Problem, options: Options) -> Passed:
    """Run the filter over a prepared record; raise an error if it diverges."""
    passed = (_in_registers if fits_registers(problem, options) else _run)(problem, options)
    attitude = passed.estimate.attitude
    if not np.isfinite(attitude[-1]).all():  # NaN persists
        end = problem.record.time[options.every * int(np.argmin(are_finite(attitude)))]
        raise InputError(
            f"the filter diverged before {end:g} s: its attitude is not a number; the errors of the start or of the measurements are many "
            "times their sigmas"
        )
    return passed


def fits_registers(problem: Problem, options: Options) -> bool:
    """Return whether the filter is that of attitude and bias in registers."""
    more = problem.model.states or options.judged or options.whole_bias
    return not more and problem.events.noise_by_axis is None


def gaps(record: ImuRecord) -> list[Event]:
    """Return the gyro intervals that are more than :data:`GAP` times as long as the median interval, as events."""
    time, steps = record.time, record.intervals
    if steps.max() <= GAP * steps.min():
        return []  # skips the sort for the median
    usual = float(np.median(steps))
    return [
        Event(kind="gap", start=float(time[k]), end=float(time[k + 1]), value=float(steps[k] / usual))
        for k in np.flatnonzero(steps > GAP * usual)
    ]


def in_order(events: Sequence[Event]) -> tuple[Event, ...]:
    """Return events in order of time."""
    return tuple(sorted(events, key=lambda event: event.start))


def _in_spans(
    problem: Problem, rows: Sequence[Array], body: six_states.Body | structure.Body
) -> Iterator[tuple[slice, slice, tuple[Any, ...], list[Array]]]:
    """Yield intervals, events, the kernel's first arguments and the rows to write for each span; then change the state.

    ``rows``: arrays of the outputs with a row for each edge.
    """
    edges, increments = problem.gyro
    measured = problem.events.measurements
    first = before = 0
    for last, change in problem.spans or (Span(len(increments)),):
        after = int(np.searchsorted(measured.time, edges[last], side="right"))
        events = slice(before, after)
        columns = {name: getattr(measured, name)[events] for name in ("time", "place", "sensor")}
        at_first = [row[first : first + 1].copy() for row in rows]
        arguments = edges[first : last + 1], increments[first:last], measured._replace(**columns)
        yield slice(first, last), events, arguments, [row[first:] for row in rows]
        if first:
            for row, kept in zip(rows, at_first, strict=True):
                row[first : first + 1] = kept
        if change is not None:
            change_state(body, change)
        first, before = last, after


def _innovations(events: Schedule, *, judged: bool) -> tuple[int, int]:
    """Return the shape of the array of innovations: measurements, and the largest number of values written for one."""
    most = 6 if judged else max([4, *(2 * KINDS[kind] for kind in events.kinds)])
    return int(events.bounds[-1]), most


# -------------------------------------------------------------------------------------------------------------- six states in registers


def _in_registers(problem: Problem, options: Options) -> Passed:
    """Run the filter of attitude and bias, without a gate."""
    record, events, every = problem.record, problem.events, options.every
    out, segments = outputs_in_registers(problem, options)
    body = body_in_registers(problem)
    state, number = body.state, 0
    for _, _, arguments, part in _in_spans(problem, out[:-2], body):
        out_of_part = six_states.Outputs._make((*part, *out[-2:]))
        number = compiled(walk, six_states)(*arguments, every, body, out_of_part)
        if number < 0:
            raise TooPreciseError()
    if options.segments:
        segments[number, :4] = 0.0
        segments[number, 4:] = state
    innovations = innovations_by_sensor(events, out.innovation, None)
    estimate = Estimate(
        time=record.time[::every],
        attitude=out.attitude,
        bias=out.bias,
        variance=out.variance,
        covariance=out.covariance.reshape(-1, 6, 6) if options.full_covariance else None,
        innovations=innovations,
        skipped=skipped_too(events, innovations),
        events=in_order(gaps(record)),
    )
    return Passed(
        estimate=estimate,
        make_end=lambda: state_of_numbers(state),
        segments=segments[: number + 1],
    )


def outputs_in_registers(problem: Problem, options: Options) -> tuple[six_states.Outputs, Array]:
    """Return the arrays that the filter fills, and that of its predictions with a further row, for the end."""
    rows = len(problem.record.increments) // options.every + 1
    shapes = (
        *((rows, 4), (rows, 3), (rows, 6), (rows if options.full_covariance else 0, 36)),
        _innovations(problem.events, judged=False),
        (options.segments + 1 if options.segments else 0, 32),
    )
    *arrays, segments = (np.empty(shape) for shape in shapes)
    return six_states.Outputs._make((*arrays, segments[: options.segments])), segments


def body_in_registers(problem: Problem) -> six_states.Body:
    """Return the filter of attitude and bias as the kernels' arguments."""
    initial = problem.initial
    return six_states.Body(pack(initial.attitude, initial.bias, initial.covariance), *problem.variances)


def put_state(body: six_states.Body | structure.Body, state: State) -> None:
    """Write a state to the arrays of a kernel."""
    if isinstance(body, six_states.Body):
        body.state[:] = pack(state.attitude, state.bias, state.covariance)
        return
    n = len(state.covariance)
    body.x[0] = np.concatenate([state.attitude, state.bias, state.values])
    body.P[0].reshape(n, -1)[:, :n] = state.covariance


def change_state(body: six_states.Body | structure.Body, change: Change) -> None:
    """Change the state in the arrays of a kernel."""
    if isinstance(body, six_states.Body):
        put_state(body, changed(state_of_numbers(body.state), change))
        return
    n = body.x.shape[1] - 1
    change(body.x[0], body.P[0].reshape(n, -1)[:, :n])


def state_of_numbers(state: Array) -> State:
    """Return the state from the 28 numbers of a kernel."""
    return State(attitude=state[:4], bias=state[4:7], covariance=definite(covariance_matrices(state[7:])))


# ------------------------------------------------------------------------------------------------------------------------------- a gate


class Judge:
    """Gate and robust weights of a run: their state and their reports."""

    def __init__(self, problem: Problem, options: Options) -> None:
        self.problem = problem
        self.gate = options.gate
        self.options = gate_options(options.gate, options.robust)
        sensors = problem.events.sensors
        self.memory, self.counters = initial_counts(options.gate, problem.initial.gate, sensors)

    def body(self, form: structure.Body) -> gate.Body:
        """Return the body of the walk, with the gate around a filter."""
        start = self.start()
        restart = gate.Restart(
            restart_bias_variance(self.gate, self.problem.initial), start.values, start.covariance, start.start
        )
        return gate.Body(filter=form, options=self.options, restart=restart, counters=self.counters, memory=self.memory)

    def outputs(self, form: structure.Outputs) -> gate.Outputs:
        """Return arrays for the outputs of the gate in addition to the filter's.

        A recovery and a lock-out need two refusals each, except the first recovery, whose other refusals may lie in the part before, and
        lock-outs that continue.
        """
        number = len(self.problem.events.time)
        return gate.Outputs(
            filter=form,
            weight=np.empty(number),
            events=np.empty((number + 1 + len(self.problem.events.sensors), 5)),
        )

    def gate_memory(self, body: structure.Body) -> GateMemory | None:
        """Return the gate's state at the end, with the restart candidate in the filter's arrays; None without a gate."""
        if self.gate is None:
            return None
        candidate = None
        if self.memory[gate_rules.CANDIDATE]:
            candidate = Candidate(x=body.x[1], covariance=covariance_at(body, 1))
        counters = dict(zip(self.problem.events.sensors, self.counters, strict=True))
        return replace(self.start(), candidate=candidate, counts=self.memory, counters=counters)

    def start(self) -> GateMemory:
        """Return the data of a candidate's start, as of the start of the first part of the record."""
        initial = self.problem.initial
        if initial.gate is not None:
            return initial.gate
        values, P = restart_states(initial, self.problem.error_states)
        return GateMemory(
            restart_bias_variance=first_bias_variance(initial),
            counts=np.empty(0),
            counters={},
            start=float(self.problem.record.time[0]),
            values=values,
            covariance=P,
        )


def gate_options(gate_: Gate | None, robust: Robust | None) -> gate.Options:
    """Return a gate and a robust update as the kernels' arguments."""
    return gate.Options(
        thresholds=np.full(3, np.inf) if gate_ is None else gate_.thresholds,
        robust=0
        if robust is None
        else {"huber": iterated_update.HUBER, "student": iterated_update.STUDENT}[robust.kind],
        parameters=np.ones((3, 2)) if robust is None else robust.parameters,
        iterations=0 if robust is None else robust.iterations,
        recovery=0 if gate_ is None else gate_.recovery or 0,
        lock_out=LOCK_OUT if gate_ is None else gate_.lock_out_limit,
        attitude_sigma=0.0 if gate_ is None else gate_.restart_attitude_sigma,
    )


def initial_counts(gate_: Gate | None, memory: GateMemory | None, sensors: tuple[str, ...]) -> tuple[Array, Array]:
    """Return the gate's state with which a kernel continues: its ``memory``, and ``counters`` of these sensors."""
    counts, counters = np.zeros(gate_rules.MEMORY), np.zeros((len(sensors), gate_rules.COUNTERS))
    counts[gate_rules.PASSES] = 1.0
    if gate_ is not None and memory is not None:
        counts[:] = memory.counts
        for row, sensor in zip(counters, sensors, strict=True):
            row[:] = memory.counters.get(sensor, 0.0)
    if gate_ is None or not gate_.recovery:
        counts[gate_rules.CANDIDATE] = 0.0
    counters[:, gate_rules.LOCKED_OUT] = 0.0
    return counts, counters


def gate_events(rows: Array, sensors: Sequence[str]) -> list[Event]:
    """Return events (n, 5) from a kernel."""
    kinds = {gate_rules.RECOVERY: "recovery", gate_rules.LOCK_OUT: "lock-out"}
    return [
        Event(kind=kinds[kind], start=start, end=end, sensor=sensors[int(sensor)], value=value)
        for kind, sensor, start, end, value in rows.tolist()
    ]


def last_lock_outs(counters: Array, sensors: Iterable[str]) -> list[Event]:
    """Return the lock-outs in the counters of the sensors, which a kernel has not reported."""
    return [
        Event(kind="lock-out", start=first, end=last, sensor=sensor, value=number)
        for sensor, (_, _, number, first, last, locked_out) in zip(sensors, counters.tolist(), strict=True)
        if locked_out
    ]


def restart_states(state: State, error_states: tuple[ErrorStates, ...]) -> tuple[Array, Array]:
    """Return values (m,) and covariance (m, m) of a candidate's error states at the start of the record.

    They are those of the filter's initial state, but with at least the declared σ of each state: an initial state from an earlier part of
    the record may be the cause of the filter's error.
    """
    P = state.covariance[6:, 6:].copy()
    minimum = np.concatenate([np.empty(0), *(np.asarray(block.sigma) ** 2 for block in error_states)])
    P[np.diag_indices(len(P))] = np.maximum(np.diag(P), minimum)
    return state.values, P


def aged_states(model: Model, values: Array, covariance: Array, dt: float) -> tuple[Array, Array]:
    """Return values (m,) and covariance (m, m) of error states after dt, s, without measurements: the kernels' function as plain Python."""
    kernels = instance_of(model, restart_candidate)
    x, P = np.append(np.zeros(7), values), np.zeros((kernels.N, kernels.W))
    P[6:, 6 : kernels.N] = covariance
    kernels.age_states(x, P.reshape(-1), np.zeros(kernels.SET * len(model.last)), dt, model)
    return x[7:], P[6:, 6 : kernels.N]


# ------------------------------------------------------------------------------------------------------------- the filter of N error states


def instance_of(model: Model, template: ModuleType) -> ModuleType:
    """Return a template of the kernels for the structure of a model."""
    return machine.instance(template, STRUCTURE=model.structure)


def kernel_model(model: Model, variances: tuple[float, float]) -> structure.Model:
    """Return the numbers of a model, and σ_v² and σ_u², as the kernels' arguments."""
    return structure.Model(
        *variances,
        numbers=model.numbers,
        decay=model.decay,
        chains=model.chains,
        last=model.last,
        limit=model.limit,
        force_f=tuple(model.force_f.tolist()),
    )


def filter_body(problem: Problem, units: Mapping[str, float]) -> structure.Body:
    """Return the filter as the kernels' arguments."""
    model, initial, sizes = problem.model, problem.initial, instance_of(problem.model, layout)
    x, P = np.zeros((2, sizes.N + 1)), aligned_zeros(2, sizes.N, sizes.W)
    if initial.gate is not None and initial.gate.candidate is not None:
        x[1], P[1, :, : sizes.N] = initial.gate.candidate.x, initial.gate.candidate.covariance
    body = structure.Body(
        model=kernel_model(model, problem.variances),
        x=x,
        P=P.reshape(2, -1),
        coefficients=np.zeros(chains.SET * max(len(model.last), 1)),
        dt=np.zeros(1),
        work=aligned_zeros(sizes.LINES * sizes.LINE),
        shape=model.shape,
        length=divisors(problem.record, problem.events, model, units),
        turning=turns(problem),
        offsets=model.offsets,
        warming=warming(problem),
        warming_now=np.zeros(1),
        root=np.zeros(sizes.N**2),
    )
    put_state(body, initial)
    return body


def driving_temperature(problem: Problem) -> Array:
    """Return the temperature of the record (n + 1,), °C, within the span in which it drives the gyro's bias."""
    if problem.record.temperature is None:
        raise InputError(
            "the record has no temperature, which drives the gyro's bias; give it, or leave the gyro temperature states out"
        )
    span = next(block.span for block in problem.error_states if isinstance(block, GyroTemperature))
    return np.clip(problem.record.temperature, *span)


def warming(problem: Problem) -> Array:
    """Return the rate of that temperature in each interval (n,), K/s; empty without slopes of the gyro's bias."""
    if not problem.model.structure.slopes:
        return np.empty(0)
    return np.asarray(np.diff(driving_temperature(problem)) / problem.record.intervals)


def aligned_zeros(*shape: int) -> Array:
    """Return an array of zeros that begins with a cache line, so that no eight numbers from a multiple of eight on lie in two lines."""
    numbers = np.zeros(math.prod(shape) + WIDTH - 1)
    first = -(numbers.ctypes.data // numbers.itemsize) % WIDTH
    return numbers[first : first + math.prod(shape)].reshape(shape)


def _run(problem: Problem, options: Options) -> Passed:
    """Run the filter of any number of error states, with or without a gate."""
    record, events, model, every = problem.record, problem.events, problem.model, options.every
    units = unit_sigmas(record, model, problem.initial.unit_sigma)
    body = filter_body(problem, units)
    out, predictions = outputs(problem, options)
    judge = Judge(problem, options)
    weight, number = None, 0
    happened = gaps(record)
    if options.judged:
        judged = judge.outputs(out)
        weight = judged.weight
    for intervals, at, arguments, part in _in_spans(problem, out[:-2], body):
        form = body._replace(length=body.length[at], turning=body.turning[at], warming=body.warming[intervals])
        out_of_part = structure.Outputs._make((*part, *out[-2:]))
        if options.judged:
            judged = judged._replace(filter=out_of_part)
            number, reported = compiled(walk, instance_of(model, gate))(*arguments, every, judge.body(form), judged)
            happened += gate_events(judged.events[:reported], events.sensors)
        else:
            number = compiled(walk, instance_of(model, filter_kernels))(*arguments, every, form, out_of_part)
        if number < 0:
            raise TooPreciseError()
    if options.segments:
        end, n = predictions[number], model.structure.n
        end[:4] = 0.0
        end[4 : 5 + n] = body.x[0]
        end[5 + n : -(WIDTH - 1)] = body.P[0].reshape(n, -1)[np.triu_indices(n)]
    happened += last_lock_outs(judge.counters, events.sensors)
    innovations = innovations_by_sensor(events, out.innovation, weight)
    estimate = replace(
        _estimate(problem, options, out),
        innovations=innovations,
        skipped=skipped_too(events, innovations),
        events=in_order(happened),
    )
    memory = judge.gate_memory(body)
    return Passed(
        estimate=estimate,
        make_end=lambda: state_of(body, memory, units),
        segments=predictions[: number + 1],
    )


def _estimate(problem: Problem, options: Options, out: structure.Outputs) -> Estimate:
    """Return the estimate of the states, with the bias alone or the whole gyro error as its bias."""
    covariance = out.covariance if len(out.covariance) else None
    estimate = estimate_of(problem, options.every, out.x, out.variance, covariance)
    if not options.whole_bias:
        return estimate
    return replace(
        estimate,
        bias=out.x[:, 4:7] + out.x[:, 7:] @ problem.model.offsets,
        variance=out.whole_variance,
        covariance=out.whole_covariance if options.full_covariance else None,
    )


def outputs(problem: Problem, options: Options) -> tuple[structure.Outputs, Array]:
    """Return the arrays that the filter fills, and that of its predictions with a further row, for the end."""
    n, rows = problem.model.structure.n, len(problem.record.increments) // options.every + 1
    whole_rows = rows if options.whole_bias else 0
    segment_width = 5 + n + n * (n + 1) // 2 + WIDTH - 1  # with seven numbers that are not used
    kept = n if options.error_state_covariance else 6
    shapes = (
        (rows, n + 1),
        (rows, n),
        (rows if options.full_covariance and not options.whole_bias else 0, kept, kept),
        (whole_rows, 6),
        (whole_rows if options.full_covariance else 0, 6, 6),
        _innovations(problem.events, judged=options.judged),
        (options.segments + 1 if options.segments else 0, segment_width),
    )
    *arrays, predictions = (np.empty(shape) for shape in shapes)
    return structure.Outputs._make((*arrays, predictions[: options.segments])), predictions


class TooPreciseError(InputError):
    """A measurement is so much more precise than the state that a covariance in double precision has too few digits left."""

    def __init__(self) -> None:
        ratio = np.sqrt(structure.MAX_PRECISION)
        super().__init__(
            f"a measurement is more than {ratio:.0e} times as precise as the state, and its update would leave the covariance with no "
            "digits left in double precision; give the initial state a smaller sigma, or the measurement a larger one. If both are right, "
            "the filter has diverged before: the errors of the start are many times their sigmas"
        )


def covariance_at(body: structure.Body, i: int) -> Array:
    """Return the covariance (n, n) of state i."""
    n = body.x.shape[1] - 1
    return definite(np.array(body.P[i].reshape(n, -1)[:, :n]))


def definite(P: Array) -> Array:
    """Return a covariance; if rounding has made it indefinite, with smaller correlations."""
    if is_definite(P):
        return P
    sigma = np.sqrt(np.diag(P))
    least = float(np.linalg.eigvalsh(P / np.outer(sigma, sigma))[0])
    if least > 0.0:
        return P
    return np.where(np.eye(len(P), dtype=bool), P, (1.0 - 4.0 * abs(least) - 1e-14) * P)


def state_of(body: structure.Body, memory: GateMemory | None, units: Mapping[str, float]) -> State:
    """Return the state of the filter."""
    return State(
        attitude=body.x[0, :4],
        bias=body.x[0, 4:7],
        values=body.x[0, 7:],
        covariance=covariance_at(body, 0),
        gate=memory,
        unit_sigma=units,
    )


def estimate_of(problem: Problem, every: int, x: Array, variance: Array, P: Array | None) -> Estimate:
    """Return the estimate from arrays (rows, …) of q, bias and error states, of their variances, and of covariances.

    P is (rows, n, n), or (rows, 6, 6) of attitude and bias only.
    """
    states = {
        block.name: ErrorStateEstimate(
            components=tuple(block.components),
            units=tuple(block.units),
            values=x[:, 7 + place.start : 7 + place.stop],
            variance=variance[:, 6 + place.start : 6 + place.stop],
        )
        for block, place in spans(problem.error_states)
    }
    return Estimate(
        time=problem.record.time[::every],
        attitude=x[:, :4],
        bias=x[:, 4:7],
        variance=variance[:, :6],
        covariance=None if P is None else P[:, :6, :6],
        error_states=states,
        whole_covariance=P if P is not None and P.shape[1] > 6 else None,
    )


def turns(problem: Problem) -> Array:
    """Return rate, angular acceleration and the latter's variances per axis at the events (events, 9); no rows without a lever arm."""
    levers, events = problem.model.levers, problem.events
    if not levers.any():
        return np.empty((0, 9))
    turns, variance = problem.motion or turning(problem.record, events.time)
    levered = levers[events.sensor]
    return np.concatenate([turns, np.where(levered[:, None], variance, 0.0)], axis=1)


def divisors(record: ImuRecord, events: Schedule, model: Model, units: Mapping[str, float]) -> Array:
    """Return the divisor of each measurement's effects, in order of time (events,).

    For kind ``"vector"`` it is the length of the reference; for a direction or heading with an effect that is constant in the sensor's own
    unit, the magnitude of the measured vector relative to that at the σ in ``units``; else 1.
    """
    result = np.ones(len(events.time))
    for i, series in enumerate(record.vectors if model.states else ()):
        if series.kind != "vector" and series.sensor not in model.varying:
            continue
        mine = events.sensor == i
        which = np.searchsorted(series.time, events.time[mine])
        if series.kind == "vector":
            result[mine] = lengths(series.references_f)[which]
        else:
            result[mine] = (units[series.sensor] / level_sigma(series))[which]
    return result


def unit_sigmas(record: ImuRecord, model: Model, kept: Mapping[str, float]) -> dict[str, float]:
    """Return ``unit_sigma`` of a :class:`State` after a record: the given values, and for other sensors those of this record."""
    sigmas = {
        series.sensor: float(np.sqrt(np.mean(level_sigma(series) ** 2)))
        for series in record.vectors
        if series.sensor in model.varying and len(series.time)
    }
    return {**sigmas, **kept}


def strength(series: VectorMeasurements) -> Array:
    """Return the magnitude (m,) of the vector measured as a direction or heading, relative to that at its root mean square σ."""
    sigma = level_sigma(series)
    return np.asarray(np.sqrt(np.mean(sigma**2)) / sigma)


def level_sigma(series: VectorMeasurements) -> Array:
    """Return the noise over the magnitude of the measured vector (m,): σ, for a heading times the horizontal part of its reference."""
    level = np.ones(len(series.time))
    if series.kind == "heading":
        level = np.linalg.norm(series.references_f[:, :2], axis=1)
    sigma = series.sigma * level
    if np.any(sigma <= 0.0):
        raise InputError(
            f"{series.sensor}: sigma is 0, which does not determine the magnitude of the measured vector; give it, or varying=False"
        )
    return np.asarray(sigma)


def most_segments(problem: Problem) -> int:
    """Return an upper bound of the number of predictions: one per interval and per measurement, and the sub-steps of both limits."""
    record = problem.record
    most = len(record.increments) + int(problem.events.bounds[-1])
    if np.isinf(problem.model.limit) and 3.0 * record.largest_increment**2 <= LARGEST_ANGLE**2:
        return most
    dt = record.intervals
    steps = np.maximum(np.linalg.norm(record.increments, axis=1) / LARGEST_ANGLE, dt / problem.model.limit)
    return most + int(np.sum(np.floor(steps[steps > 1.0]) + 1.0))
