"""The compiled filter over whole records: :func:`run`, and :func:`run_part` for a record in parts.

Without error states the covariance is carried in blocks (:mod:`strapdown.kernels.covariance_form`), which is faster; with error states,
and where the blocks would lose their digits, as its triangular factor (:mod:`strapdown.kernels.root_form`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from strapdown.checks import Array, InputError, count
from strapdown.estimation import model as modelling
from strapdown.estimation import temperature
from strapdown.estimation.angular_acceleration import turning
from strapdown.estimation.error_states import ErrorStates, spans
from strapdown.estimation.gating import LOCK_OUT, Gate, Robust
from strapdown.estimation.memory import side_by_side
from strapdown.estimation.model import Model
from strapdown.estimation.schedule import Schedule, innovations_by_sensor, joined, schedule, skipped_too
from strapdown.estimation.states import (
    Candidate,
    GateMemory,
    ProcessNoise,
    State,
    check_arguments,
    covariance_blocks,
    covariance_matrices,
    first_bias_variance,
    pack,
    restart_bias_variance,
)
from strapdown.kernels import covariance_form, gate, gate_rules, iterated_update, likelihood_outliers, root_form
from strapdown.kernels.chains import LINKS
from strapdown.kernels.error_state_step import OFFSET
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.measurement import Measurements
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.kernels.triangle import padded
from strapdown.kernels.walk import walk
from strapdown.records import ErrorStateEstimate, Estimate, Event, ImuRecord, cut
from strapdown.records.recording import GAP
from strapdown.vectors import KINDS, VectorMeasurements

CHECK_INTERVALS = 1024
"""Number of intervals between checks of the covariance for lost digits."""
SHARPNESS = 1e9
"""Maximum ratio of an innovation's variance to the measurement's at which the covariance keeps enough digits."""
MIN_SHARE = 1e-10
"""Minimum conditional variance of a state, given the states after it, relative to its variance, at which enough digits are kept."""
SMOOTHED_DIGITS = (1e11, 1e-11)
"""The same two limits for a smoother, which beyond them uses the factor for the whole record, a dozen times as slow."""
HEALTHY_SHARE = 1e-7
"""Conditional variance, relative to the variance, from which on the covariance is carried in blocks again."""
FIRST_SPAN = 64
"""Number of intervals carried as a factor before the covariance is checked again; each further span is twice as long."""
SHRINK = 1.0 - 1e-14
"""Factor on reported correlations: near 1, rounding could make the covariance indefinite."""


class LostDigitsError(InputError):
    """The covariance in blocks has lost its digits; the caller that needs the segments must use the factor."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a run over a record."""

    every: int = 1
    full_covariance: bool = False
    error_state_covariance: bool = True
    """Whether ``full_covariance`` includes the covariance of the error states."""
    gate: Gate | None = None
    robust: Robust | None = None
    together: bool = False
    """Whether the factor takes all steps between two measurements at once: faster if few rows of a long record are stored."""
    segments: int = 0
    """Maximum number of predictions to store for a smoother."""
    whole_bias: bool = False
    """Report the whole gyro bias, including the contributions of the error states, and with ``full_covariance`` its covariance instead of
    that of all states."""
    factor: bool = False
    """Whether to carry the triangular factor even without error states."""
    outliers: tuple[float, float] | None = None
    """Share and variance ratio of outliers, for the factor without a gate. ``weight`` of each measurement is then minus its log likelihood,
    the probability that it is an outlier, and the mean ratio of its noise to its innovations' variances (m, 3)."""

    def __post_init__(self) -> None:
        """Check the classes of gate and robust."""
        check_arguments(gate=self.gate, robust=self.robust)

    @property
    def judged(self) -> bool:
        """Whether measurements are tested or weighted."""
        return self.gate is not None or self.robust is not None


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
    options = Options(
        every=count("every", every), full_covariance=full_covariance, gate=gate, robust=robust, together=every > 1
    )
    return filtered(prepared(record, process_noise, initial, error_states, driven=True), options).estimate


def run_part(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    error_states: Sequence[ErrorStates] = (),
    *,
    every: int = 1,
    full_covariance: bool = False,
    error_state_covariance: bool = True,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> tuple[Estimate, State]:
    """Run the filter and return the end state too, from which the next part of a record continues, bit for bit.

    The end state includes the gate's state: its counts, its candidate, and the σ of the next restart. A lock-out that continues is reported
    by both parts, by the second as a whole. Where the blocks would lose their digits and the covariance is carried as its factor, parts
    agree to its rounding.

    Effects that are constant in a sensor's own unit (``varying``) refer in all parts to the first part with the sensor: to the magnitude at
    the root mean square σ there (``unit_sigma`` of the state). A run over the whole record refers to that of the whole record, and so has
    another prior, unless ``initial`` has the same one. With a lever arm parts agree only to about 1e-6 of their estimates: the angular
    acceleration is computed from the gyro samples around each measurement, at a cut from those on one side.

    If ``error_state_covariance`` is false, whole covariances are those of attitude and bias only, which saves a tenth of the time.
    """
    options = Options(
        every=count("every", every),
        full_covariance=full_covariance,
        error_state_covariance=error_state_covariance,
        gate=gate,
        robust=robust,
    )
    passed = filtered(prepared(record, process_noise, initial, error_states, driven=True), options)
    return passed.estimate, passed.end


def prepared(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    error_states: Sequence[ErrorStates],
    *,
    driven: bool = False,
) -> Problem:
    """Return a record with its measurements in order of time, and the error states as arrays.

    ``driven``: whether a bias driven by temperature is allowed, as for :func:`filtered`.
    """
    check_arguments(record=record, process_noise=process_noise)
    declared = modelling.as_blocks(error_states)
    if not driven:
        temperature.need_none(declared, "this estimator")
    state = modelling.begin(initial, declared)
    events = schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    model = modelling.assemble(declared, dict(zip(events.sensors, events.kinds, strict=True)))
    return Problem(
        record=record,
        events=events,
        process_noise=process_noise,
        initial=state,
        error_states=declared,
        model=model,
    )


def filtered(problem: Problem, options: Options) -> Passed:
    """Run the filter over a prepared record, in the form that it needs; raise an error if it diverges."""
    slopes = temperature.slopes(problem.error_states)
    if slopes is not None:
        passed = _over_temperature(problem, options, slopes)
    elif problem.model.states or options.factor or options.whole_bias:
        passed = _in_factor(problem, options)
    elif options.judged or problem.events.noise is not None:
        passed = _judged_in_blocks(problem, options)
    else:
        passed = _in_blocks(problem, options)
    attitude = passed.estimate.attitude
    if not np.isfinite(attitude[-1]).all():  # NaN persists
        end = problem.record.time[options.every * int(np.argmin(np.isfinite(attitude).all(axis=1)))]
        raise InputError(
            f"the filter diverged before {end:g} s: its attitude is not a number; the errors of the start or of the measurements are many "
            "times their sigmas"
        )
    return passed


def _over_temperature(problem: Problem, options: Options, slopes: slice) -> Passed:
    """Run the filter with a bias driven by temperature, in segments of nearly constant temperature."""
    record, initial = problem.record, problem.initial
    T = temperature.of(record)
    state = replace(initial, unit_sigma=unit_sigmas(record, problem.model, initial.unit_sigma))
    parts: list[Estimate] = []
    before = float(T[0])
    for first, last, mean in temperature.stretches(record, options.every):
        state = temperature.shifted(state, slopes, mean - before)
        part, off = temperature.at_mean(cut(record, first, last), mean, state.values[slopes])
        declared = prepared(part, problem.process_noise, state, problem.error_states, driven=True)
        passed = _in_factor(declared, options)
        parts.append(temperature.at_edges(passed.estimate, slopes, off[:: options.every]))
        state, before = passed.end, mean
    end = temperature.shifted(state, slopes, float(T[-1]) - before)
    estimate = joined(parts)
    skipped = skipped_too(problem.events, estimate.innovations)
    return Passed(estimate=replace(estimate, skipped=skipped), make_end=lambda: end, segments=np.empty((0, 0)))


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


def _innovations(events: Schedule, *, judged: bool) -> tuple[int, int]:
    """Return the shape of the array of innovations: measurements, and the largest number of values written for one."""
    most = 6 if judged else max([4, *(2 * KINDS[kind] for kind in events.kinds)])
    return int(events.bounds[-1]), most


# ------------------------------------------------------------------------------------------------------------- the covariance in blocks


def _block_outputs(problem: Problem, options: Options, *, judged: bool) -> covariance_form.Outputs:
    """Return arrays for the outputs of a run."""
    rows = len(problem.record.increments) // options.every + 1
    shapes = (rows, 4), (rows, 3), (rows, 6), (rows if options.full_covariance else 0, 21)
    innovations = _innovations(problem.events, judged=judged)
    written = side_by_side(*((shape, float) for shape in (*shapes, innovations)))
    segments = side_by_side(((options.segments + 1 if options.segments else 0, 32), float))
    return covariance_form.Outputs(*written, *segments)


def _block_body(problem: Problem, options: Options, states: Array) -> covariance_form.Body:
    """Return the filter as the kernels' arguments."""
    sharpness, share = SMOOTHED_DIGITS if options.segments else (SHARPNESS, MIN_SHARE)
    angle_variance, rate_variance = problem.variances
    return covariance_form.Body(
        states=states,
        angle_variance=angle_variance,
        rate_variance=rate_variance,
        sharpness=sharpness,
        least_share=share,
        check=(CHECK_INTERVALS + options.every - 1) // options.every,
        good=np.zeros(2, np.int64),
        work=np.empty((7, 6)),
    )


def _packed_states(initial: State) -> Array:
    """Return the states of the filter and its candidate, packed (2, 28)."""
    states = np.zeros((2, 28))
    states[0] = pack(initial.attitude, initial.bias, initial.covariance)
    if initial.gate is not None and initial.gate.candidate is not None:
        one = initial.gate.candidate
        states[1] = pack(one.attitude, one.others, one.covariance)
    return states


def _in_blocks(problem: Problem, options: Options) -> Passed:
    """Run the filter without gate and robust weights; spans in which the blocks would lose their digits are carried as the factor."""
    record, events, every = problem.record, problem.events, options.every
    out = _block_outputs(problem, options, judged=False)
    written = out._replace(segments=out.segments[: options.segments])
    body = _block_body(problem, options, _packed_states(problem.initial))
    (edges, increments), measurements = problem.gyro, events.measurements
    row, event = 0, 0
    while True:
        number = compiled(walk, covariance_form)(
            edges[row * every :],
            increments[row * every :],
            after(measurements, event),
            every,
            body,
            _rows_from(written, row),
        )
        if number >= 0:
            break
        row, event = row + int(body.good[0]), event + int(body.good[1])
        if options.segments:
            raise LostDigitsError(f"after {record.time[row * every]:g} s the covariance keeps no digits")
        row, event = _span_in_factor(problem, options, body.states[0], out, row, event)
        if row * every + every > len(increments):
            number = 0
            break
    return _block_result(problem, options, out, body.states[0], int(number))


def after(measurements: Measurements, first: int, last: int | None = None) -> Measurements:
    """Return the measurements from number ``first`` to ``last`` in order of time."""
    own = slice(first, last)
    return measurements._replace(
        time=measurements.time[own], place=measurements.place[own], sensor=measurements.sensor[own]
    )


def _rows_from(out: covariance_form.Outputs, row: int) -> covariance_form.Outputs:
    """Return the outputs from a row on."""
    kept = {name: getattr(out, name)[row:] for name in ("attitude", "bias", "variance", "covariance")}
    return out._replace(**kept)


def _block_result(
    problem: Problem,
    options: Options,
    out: covariance_form.Outputs,
    end: Array,
    number: int,
    weight: Array | None = None,
    events: Sequence[Event] = (),
    memory: GateMemory | None = None,
) -> Passed:
    """Return the result of a run from its outputs and its packed end state."""
    if options.segments:
        out.segments[number, :4] = 0.0
        out.segments[number, 4:] = end
    innovations = innovations_by_sensor(problem.events, out.innovation, weight)
    estimate = Estimate(
        time=problem.record.time[:: options.every],
        attitude=out.attitude,
        bias=out.bias,
        variance=out.variance,
        covariance=covariance_matrices(out.covariance) if options.full_covariance else None,
        innovations=innovations,
        skipped=skipped_too(problem.events, innovations),
        events=in_order([*gaps(problem.record), *events]),
    )
    return Passed(
        estimate=estimate,
        make_end=lambda: State(attitude=end[:4], bias=end[4:7], covariance=covariance_matrices(end[7:]), gate=memory),
        segments=out.segments[: number + 1],
    )


def _judged_in_blocks(problem: Problem, options: Options) -> Passed:
    """Run the filter with a gate, robust weights or anisotropic noise; with the factor for the whole record if digits would be lost."""
    body = _block_body(problem, options, _packed_states(problem.initial))
    judge = Judge(problem, options)
    out = _block_outputs(problem, options, judged=True)
    written = judge.outputs(out._replace(segments=out.segments[: options.segments]))
    restart = covariance_form.Restart(bias_variance=restart_bias_variance(options.gate, problem.initial))
    number, recovered, locked = compiled(walk, gate, covariance_form)(
        *problem.gyro,
        problem.events.measurements,
        options.every,
        judge.body(body, restart),
        written,
    )
    if number < 0:
        if options.segments:
            raise LostDigitsError("the covariance keeps no digits")
        return _in_factor(problem, options)
    states = body.states
    candidate = None
    if judge.memory[gate_rules.CANDIDATE]:
        candidate = Candidate(
            attitude=states[1, :4], others=states[1, 4:7], covariance=covariance_matrices(states[1, 7:])
        )
    return _block_result(
        problem,
        options,
        out,
        states[0],
        int(number),
        written.weight,
        judge.events(written, recovered, locked),
        judge.remembered(candidate),
    )


# ------------------------------------------------------------------------------------------------------------------------------- a gate


class Judge:
    """Gate and robust weights of a run: their state and their reports."""

    def __init__(self, problem: Problem, options: Options) -> None:
        self.problem = problem
        self.gate = options.gate
        self.options = gate_options(options.gate, options.robust)
        sensors = problem.events.sensors
        self.memory, self.counters = remembered(options.gate, problem.initial.gate, sensors)

    def body(self, form: covariance_form.Body | root_form.Body, restart: Any) -> gate.Body:
        """Return the body of the walk, with the gate around a form."""
        return gate.Body(form=form, options=self.options, restart=restart, standing=self.counters, memory=self.memory)

    def outputs(self, form: covariance_form.Outputs | root_form.Outputs) -> gate.Outputs:
        """Return arrays for the outputs of the gate in addition to the form's.

        A recovery or a lock-out needs two refusals, except the first recovery, whose other refusals may lie in the part before, and a
        lock-out that continues.
        """
        number = len(self.problem.events.time)
        return gate.Outputs(
            form=form,
            weight=np.empty(number),
            recoveries=np.empty((number // 2 + 1, 4)),
            lock_outs=np.empty((number // 2 + len(self.problem.events.sensors), 4)),
        )

    def events(self, out: gate.Outputs, recovered: int, locked: int) -> list[Event]:
        """Return recoveries and lock-outs as events."""
        return gate_events(out.recoveries[:recovered], out.lock_outs[:locked], self.problem.events.sensors)

    def remembered(self, candidate: Candidate | None) -> GateMemory | None:
        """Return the gate's state at the end; None without a gate."""
        if self.gate is None:
            return None
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


def remembered(gate_: Gate | None, memory: GateMemory | None, sensors: tuple[str, ...]) -> tuple[Array, Array]:
    """Return the gate's state with which a kernel continues: its ``memory``, and ``counters`` of these sensors."""
    counts, counters = np.zeros(gate_rules.MEMORY), np.zeros((len(sensors), gate_rules.STANDING))
    counts[gate_rules.PASSES] = 1.0
    if gate_ is not None and memory is not None:
        counts[:] = memory.counts
        for row, sensor in zip(counters, sensors, strict=True):
            row[:] = memory.counters.get(sensor, 0.0)
    if gate_ is None or not gate_.recovery:
        counts[gate_rules.CANDIDATE] = 0.0
    counters[:, gate_rules.REPORTED] = -1.0
    return counts, counters


def gate_events(recoveries: Array, lock_outs: Array, sensors: tuple[str, ...]) -> list[Event]:
    """Return recoveries (n, 4) and lock-outs (m, 4) from a kernel as events."""
    rows = [("recovery", row[[2, 0, 1, 3]]) for row in recoveries]
    rows += [("lock-out", row) for row in lock_outs if row[3] > 0.0]
    return [
        Event(kind=kind, start=float(start), end=float(end), sensor=sensors[int(sensor)], value=float(value))
        for kind, (start, end, sensor, value) in rows
    ]


def restart_states(state: State, error_states: tuple[ErrorStates, ...]) -> tuple[Array, Array]:
    """Return values (m,) and covariance (m, m) of a candidate's error states at the start of the record.

    They are those of the filter's initial state, but with at least the declared σ of each state: an initial state from an earlier part of
    the record may be the cause of the filter's error.
    """
    P = state.covariance[6:, 6:].copy()
    minimum = np.concatenate([np.empty(0), *(np.asarray(one.sigma) ** 2 for one in error_states)])
    P[np.diag_indices(len(P))] = np.maximum(np.diag(P), minimum)
    return state.values, P


# ----------------------------------------------------------------------------------------------------------------- the triangular factor


def model_arrays(model: Model, variances: tuple[float, float]) -> root_form.Model:
    """Return noise and error states as the kernels' arguments."""
    same = {name: getattr(model, name) for name in root_form.Model._fields[2:]}
    return root_form.Model(*variances, **{**same, "force_f": tuple(model.force_f.tolist())})


def scratch(model: Model) -> root_form.Scratch:
    """Return work space for the kernels."""
    m, width = model.states, padded(6 + model.states)
    return root_form.Scratch(
        rows=np.zeros((3, 3, width)),
        lines=np.zeros((root_form.LINES, width)),
        steps=np.zeros((2, 2, 6 + m, 4)),
        links=np.empty((len(model.chains), LINKS)),
        six=np.empty((6, 6)),
    )


def factor_body(problem: Problem, units: Mapping[str, float], *, together: bool = False) -> root_form.Body:
    """Return the filter as the kernels' arguments."""
    model, initial = problem.model, problem.initial
    size = 6 + model.states
    rows = size + max(model.noise_rows, size + 1)
    attitude, x, F = np.zeros((2, 4)), np.zeros((2, size - 3)), np.zeros((2, rows, padded(size)))
    attitude[0], x[0] = initial.attitude, np.concatenate([initial.bias, initial.values[model.order]])
    F[0, :size, :size] = modelling.triangle(initial, model)
    if initial.gate is not None and initial.gate.candidate is not None:
        one = initial.gate.candidate
        attitude[1], x[1] = one.attitude, np.concatenate([one.others[:3], one.others[3:][model.order]])
        F[1, :size, :size] = modelling.triangle(one, model)
    return root_form.Body(
        model=model_arrays(model, problem.variances),
        attitude=attitude,
        x=x,
        F=F,
        length=lengths(problem.record, problem.events, model, units),
        turning=turns(problem),
        scratch=scratch(model),
        together=together and not len(model.chains),
        sharpness=np.inf,
        least_share=0.0,
        check=CHECK_INTERVALS,
    )


def _in_factor(problem: Problem, options: Options) -> Passed:
    """Run the filter with the triangular factor of its covariance."""
    record, events, model, every = problem.record, problem.events, problem.model, options.every
    size, rows = 6 + model.states, len(record.increments) // every + 1
    units = unit_sigmas(record, model, problem.initial.unit_sigma)
    body = factor_body(problem, units, together=options.together)
    whole_rows = rows if options.whole_bias else 0
    kept = size if options.error_state_covariance else 6
    stands = np.tri(size, dtype=bool)
    stands[:6, :6] = stands[6 : model.loose, : model.loose] = True
    end = 5 + size + int(np.sum(stands))
    (stored,) = side_by_side(((options.segments + 1 if options.segments else 0, end + WIDTH - 1), float))
    shapes = (
        (rows, 4),
        (rows, size - 3),
        (rows, size),
        (rows if options.full_covariance and not options.whole_bias else 0, kept, kept),
        (whole_rows, 6),
        (whole_rows if options.full_covariance else 0, 6, 6),
        _innovations(events, judged=options.judged) if options.outliers is None else (len(events.time), 9),
    )
    written = side_by_side(*((shape, float) for shape in shapes))
    out = root_form.Outputs._make((*written, stored[: options.segments]))
    judge = Judge(problem, options)
    weight, happened = None, []
    arguments = *problem.gyro, events.measurements, every
    if options.judged:
        restart = restart_in_factor(judge)
        judged = judge.outputs(out)
        number, recovered, locked = compiled(walk, gate, root_form)(*arguments, judge.body(body, restart), judged)
        weight, happened = judged.weight, judge.events(judged, recovered, locked)
    else:
        if options.outliers is not None:
            body, weight = body._replace(outliers=options.outliers), out.innovation[:, 6:]
        bodies = (root_form,) if options.outliers is None else (likelihood_outliers, root_form)
        number = compiled(walk, *bodies)(*arguments, body, out)
    if number < 0:  # the following rows are not written
        raise RuntimeError("the triangular factor lost its last digits; please report this with the record")
    if options.segments:
        stored[number, :4] = 0.0
        stored[number, 4:8] = body.attitude[0]
        stored[number, 8 : 5 + size] = body.x[0]
        stored[number, 5 + size : end] = body.F[0, :size, :size][stands]
    innovations = innovations_by_sensor(events, out.innovation, weight)
    estimate = replace(
        factor_estimate(
            problem, every, out.attitude, out.x, out.variance, out.covariance if len(out.covariance) else None
        ),
        innovations=innovations,
        skipped=skipped_too(events, innovations),
        events=in_order([*gaps(record), *happened]),
    )
    if options.whole_bias:
        estimate = replace(
            estimate,
            bias=whole_bias(model, out.x),
            variance=out.whole_variance,
            covariance=out.whole_covariance if options.full_covariance else None,
        )
    candidate = candidate_in_factor(body, model) if judge.memory[gate_rules.CANDIDATE] else None
    memory = judge.remembered(candidate)
    return Passed(
        estimate=estimate,
        make_end=lambda: end_in_factor(body, model, memory, units),
        segments=stored[: number + 1],
    )


def restart_in_factor(judge: Judge) -> root_form.Restart:
    """Return the initial state of a restart candidate."""
    problem, first = judge.problem, judge.start()
    model = problem.model
    return root_form.Restart(
        bias_sigma=np.sqrt(restart_bias_variance(judge.gate, problem.initial)),
        values=first.values[model.order],
        root=modelling.lower_root(first.covariance[np.ix_(model.order, model.order)]),
        time=first.start,
        fresh=np.empty((3 * model.states + 6, padded(3 + model.states))),
    )


def whole_bias(model: Model, x: Array) -> Array:
    """Return the whole gyro bias (rows, 3) from the kernels' bias and error states (rows, 3 + m)."""
    offsets = model.gyro[:, :3] * (model.gyro_use & OFFSET > 0)[:, None]
    return np.asarray(x[:, :3] + x[:, 3:] @ offsets)


def outside(body: root_form.Body, model: Model, i: int) -> tuple[Array, Array, Array, Array]:
    """Return attitude, bias, values and factor of state i in the order of the declarations."""
    size = 6 + model.states
    root = body.F[i, :size][:, np.argsort(model.whole_order)]
    return body.attitude[i], body.x[i, :3], body.x[i, 3:][np.argsort(model.order)], root


def candidate_in_factor(body: root_form.Body, model: Model) -> Candidate:
    """Return the restart candidate."""
    attitude, bias, values, root = outside(body, model, 1)
    return Candidate(attitude=attitude, others=np.concatenate([bias, values]), covariance=root.T @ root, factor=root)


def end_in_factor(body: root_form.Body, model: Model, memory: GateMemory | None, units: Mapping[str, float]) -> State:
    """Return the state at the end."""
    attitude, bias, values, root = outside(body, model, 0)
    if not model.states:
        return State(attitude=attitude, bias=bias, covariance=_reported(root.T @ root), gate=memory)
    return State(
        attitude=attitude,
        bias=bias,
        values=values,
        covariance=root.T @ root,
        factor=root,
        gate=memory,
        unit_sigma=units,
    )


def factor_estimate(
    problem: Problem, every: int, attitude: Array, x: Array, variance: Array, P: Array | None
) -> Estimate:
    """Return the estimate from arrays in the kernels' order, (b, c) and P, in the order of the declarations.

    P is (rows, n, n), or (rows, 6, 6) of attitude and bias only.
    """
    model = problem.model
    if P is not None and not model.states:
        P = _reported(P)
    back = np.argsort(model.whole_order)
    whole = P
    if P is not None and P.shape[1] > 6 and np.any(np.diff(back) != 1):
        whole = P[:, back[:, None], back]
    found = {}
    for one, place in spans(problem.error_states):
        own = back[6:][place]
        found[one.name] = ErrorStateEstimate(
            components=tuple(one.components),
            units=tuple(one.units),
            values=_columns(x, own - 3),
            variance=_columns(variance, own),
        )
    return Estimate(
        time=problem.record.time[::every],
        attitude=attitude,
        bias=x[:, :3],
        variance=variance[:, :6],
        covariance=None if whole is None else whole[:, :6, :6],
        error_states=found,
        whole_covariance=whole if whole is not None and whole.shape[1] > 6 else None,
    )


def _columns(values: Array, which: np.ndarray) -> Array:
    """Return columns of an array, without a copy if they are adjacent."""
    if np.all(np.diff(which) == 1):
        return values[:, which[0] : which[0] + len(which)]
    return values[:, which]


def _reported(P: Array) -> Array:
    """Return covariances (..., n, n) with correlations reduced so that rounding cannot make them indefinite."""
    return np.where(np.eye(P.shape[-1], dtype=bool), P, SHRINK * P)


def _span_in_factor(
    problem: Problem, options: Options, state: Array, out: covariance_form.Outputs, row: int, event: int
) -> tuple[int, int]:
    """Continue from a row of the outputs and a measurement with the factor until the blocks keep enough digits, or to the end.

    ``state`` (28,) is the state at the row, replaced by that at the returned row, or after the last row by the end state. Returns the row
    and the number of measurements processed up to it.
    """
    events, every = problem.events, options.every
    (edges, increments), measurements = problem.gyro, events.measurements
    last = len(increments) // every
    start = State(attitude=state[:4], bias=state[4:7], covariance=np.eye(6))
    body = factor_body(replace(problem, initial=start), {})
    body.F[0, :6, :6] = _singular_triangle(covariance_matrices(state[7:]))
    span = max(1, FIRST_SPAN // every)
    while True:
        to_row = min(row + span, last)
        begin, end = row * every, len(increments) if to_row == last else to_row * every
        beyond = int(np.searchsorted(events.time, edges[end], side="right"))
        rows = slice(row, to_row + 1)
        whole = np.empty((to_row - row + 1 if options.full_covariance else 0, 6, 6))
        written = root_form.Outputs(
            attitude=out.attitude[rows],
            x=out.bias[rows],
            variance=out.variance[rows],
            covariance=whole,
            whole_variance=np.empty((0, 6)),
            whole_covariance=np.empty((0, 6, 6)),
            innovation=out.innovation,
            segments=np.empty((0, 32)),
        )
        compiled(walk, root_form)(
            edges[begin : end + 1],
            increments[begin:end],
            after(measurements, event, beyond),
            every,
            body,
            written,
        )
        if len(whole):
            out.covariance[rows] = covariance_blocks(_reported(whole))
        row, event = to_row, beyond
        span *= 2
        F = modelling.lower(body.F[0, :6, :6])
        if end == len(increments) or np.all(np.diag(F) ** 2 >= HEALTHY_SHARE * np.sum(F**2, axis=0)):
            break
    state[:4], state[4:7] = body.attitude[0], body.x[0]
    state[7:] = covariance_blocks(_reported(F.T @ F))
    return row, event


def _singular_triangle(P: Array) -> Array:
    """Return F, lower triangular, with ``P = Fᵀ F``, for a covariance that may be singular."""
    sigma = np.sqrt(np.diag(P))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * sigma
    return np.asarray(np.linalg.qr(root[:, ::-1], mode="r"))[::-1, ::-1].copy()


def turns(problem: Problem) -> Array:
    """Return rate, angular acceleration and the latter's variances per axis at the events (events, 9); no rows without a lever arm."""
    levers, events = problem.model.levers, problem.events
    if not levers.any():
        return np.empty((0, 9))
    turns, variance = problem.motion or turning(problem.record, events.time)
    levered = levers[events.sensor]
    return np.concatenate([turns, np.where(levered[:, None], variance, 0.0)], axis=1)


def lengths(record: ImuRecord, events: Schedule, model: Model, units: Mapping[str, float]) -> Array:
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
            result[mine] = np.linalg.norm(series.references_f[which], axis=1)
        else:
            result[mine] = (units[series.sensor] / level_sigma(series))[which]
    return result


def unit_sigmas(record: ImuRecord, model: Model, kept: Mapping[str, float]) -> dict[str, float]:
    """Return ``unit_sigma`` of a :class:`State` after a record: the given values, and for other sensors those of this record."""
    found = {
        series.sensor: float(np.sqrt(np.mean(level_sigma(series) ** 2)))
        for series in record.vectors
        if series.sensor in model.varying and len(series.time)
    }
    return {**found, **kept}


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
