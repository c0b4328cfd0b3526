"""The lane machine: noise, sensors and filter of eight runs at once, one per SIMD lane, compiled together.

The motion, the times of the measurements and all else common to the runs are computed once per plan; only the noise and the units differ.
The random streams depend only on (seed, run, source), and runs do not enter each other, so run k is bitwise identical for any chunk,
threads and host (with fused multiply-add). The noise has the distribution of the simulator's, not its numbers; the units are the
simulator's.

Two things are simpler than in the simulator. With a coning algorithm of N samples the noise is drawn once per filter step, with exactly the
distribution of the sum of N samples, and does not enter the cross products; their contribution is below the rotation over a sample times
the noise. Flicker is generated at the filter's steps, not at the gyro's samples.
"""

from __future__ import annotations

import math
import weakref
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from strapdown import estimation, quaternion, vectors
from strapdown.checks import Array
from strapdown.estimation import forward, setup
from strapdown.estimation.forward import Problem
from strapdown.estimation.schedule import innovations_by_sensor, skipped_too
from strapdown.estimation.states import covariance_matrices
from strapdown.gyro import GyroSpec, flicker
from strapdown.kernels import (
    gyro_errors,
    layout,
    machine,
    montecarlo_filter,
    montecarlo_run,
    montecarlo_six,
    montecarlo_statistics,
)
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.montecarlo_run import KEPT
from strapdown.kernels.noise import minus_two_log
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.kernels.walk import walk
from strapdown.montecarlo.plan import Plan, initial_sigmas, unit
from strapdown.montecarlo.statistics import (
    BINS,
    EXAMPLES,
    FIRST_BIN,
    Counts,
    Replay,
    Statistics,
    worst,
)
from strapdown.randomness import generator
from strapdown.records import ImuRecord, Truth, compress
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import Accelerometer, AttitudeSensor, Magnetometer, VectorMeasurements

NAME = "lanes"
CHUNK = 200

LARGEST_START = 0.5
"""Maximum σ of the initial attitude error for which its rotation is accurate to rounding, rad."""

_SOURCES = ("gyro", "gyro flicker", "gyro markov", "gyro turn-on", "initial error")
_NOT_OF_THE_GYRO = {
    "quantization": 0.0,
    "bandwidth": np.inf,
    "sampling_jitter": 0.0,
    "timestamp_error": 0.0,
    "timestamp_offset": 0.0,
    "drop_probability": 0.0,
}
_SENSORS = (vectors.VectorSensor, vectors.HorizonSensor, Magnetometer, Accelerometer, AttitudeSensor)


def supports(plan: Plan) -> str:
    """Return why the lanes cannot compute a plan; empty if they can."""
    return next(_reasons(plan), "")


def _reasons(plan: Plan) -> Iterator[str]:
    spec = plan.scenario.gyro
    if spec.temperature is not None:
        yield "the gyro's bias over temperature"
    for name, none in _NOT_OF_THE_GYRO.items():
        if np.any(np.asarray(getattr(spec, name)) != none):
            yield f"the gyro's {name}"
    for sensor in plan.scenario.sensors:
        if type(sensor) not in _SENSORS:
            yield f"{sensor.name}: a sensor of class {type(sensor).__name__}"
        elif sensor.faults.latency > 0.0:  # type: ignore[attr-defined]
            yield f"{sensor.name}: latency"
        elif sensor.faults.drop_probability > 0.0:  # type: ignore[attr-defined]
            yield f"{sensor.name}: lost samples"
    if plan.setup.estimator != setup.MEKF:
        yield f"the estimator {plan.setup.estimator_name}"
    for option in ("gate", "robust"):
        if getattr(plan.setup, option, None) is not None:
            yield f"the filter's {option} option"
    if initial_sigmas(plan.dispersions, plan.setup)[0] > LARGEST_START:
        yield f"an initial attitude error of more than {LARGEST_START} rad, 1 sigma"
    if plan.setup.integration.samples > 1:
        if _units_differ(plan):
            yield "gyro parameters that differ from run to run with several gyro samples a filter step"
        if np.isfinite(spec.range) or np.any(np.asarray(spec.rate_resolution) > 0.0):
            yield "a gyro of limited range or resolution with several gyro samples a filter step"
    if plan.setup.states is not None and np.any(plan.setup.states.gyro_temperature_sigma):
        yield "a state of the gyro's bias over temperature"


def _units_differ(plan: Plan) -> bool:
    return plan.individuals or plan.dispersions.of_the_gyro


# ---------------------------------------------------------------------------------------------- common to all runs


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prepared:
    """Data common to all runs of a plan."""

    problem: Problem
    """Record of the filter's steps without noise, with the filter's σ, and the filter."""
    record: ImuRecord
    """The same record with nominal σ."""
    layout: ModuleType
    """Layout of the arrays of several runs, for the structure of the model."""
    filter: ModuleType
    """Module that defines the filter for the kernel of the runs."""
    gyro: montecarlo_run.Gyro
    start: montecarlo_run.Start
    events: montecarlo_run.Events
    filters: Any
    """Filter as the kernels' argument, without the arrays of a group."""
    noise: Array
    """Covariances of the measurements in body axes (events, 6), one sensor after the other."""
    degrees: Counts
    """Degrees of freedom of one run by sensor and time bin (s, k)."""
    keys: np.ndarray

    @property
    def truth(self) -> Array:
        """True attitudes at the filter's steps."""
        assert self.record.truth is not None
        return self.record.truth.attitude


_PREPARED: weakref.WeakKeyDictionary[Plan, _Prepared] = weakref.WeakKeyDictionary()


def _prepared(plan: Plan) -> _Prepared:
    prepared = _PREPARED.get(plan)  # once: an equal plan, the key, may be deleted at any time
    if prepared is None:
        prepared = _PREPARED[plan] = _prepare(plan)
    return prepared


def _quiet(spec: GyroSpec) -> GyroSpec:
    """Return the gyro without the errors that differ from run to run."""
    none = ("angle_random_walk", "rate_random_walk", "bias_instability", "markov_noise", "turn_on_bias_sigma")
    silent: dict[str, Any] = dict.fromkeys(none, 0.0)
    return replace(spec, **silent, range=np.inf, rate_resolution=0.0)


def _prepare(plan: Plan) -> _Prepared:
    scenario, algorithm = plan.scenario, plan.setup.integration
    quiet = simulate(replace(scenario, gyro=_quiet(scenario.gyro), sensors=()), plan.seed, 0)
    # From one run: times, kinds, references and nominal σ are common to all runs.
    ends = scenario.motion, scenario.edges[0], scenario.edges[-1]
    series = tuple(sensor.observe(*ends, generator(plan.seed, 0, sensor.name)) for sensor in scenario.sensors)
    quiet = replace(quiet, vectors=series)
    record = quiet if algorithm.name == "one-sample" else compress(quiet, algorithm)
    assert record.truth is not None
    initial = setup.initial_state(plan.setup, record.truth.attitude[0], record.truth.bias[0])
    problem = setup.prepared(setup.modelled_record(quiet, plan.setup), plan.setup, initial)
    events, model = problem.events, problem.model
    lanes: dict[str, Any] = {"STRUCTURE": model.structure, "LANES": WIDTH}
    plain = not model.states and events.noise_by_axis is None
    noise = np.empty((len(events.time), 6))
    noise[events.row] = events.body_noise
    span = np.clip(np.searchsorted(plan.nis_edges, events.time, side="left") - 1, 0, plan.nis_bins - 1)
    degrees = np.zeros((len(plan.sensors), plan.nis_bins), np.int64)
    np.add.at(degrees, (events.sensor, span), np.array([vectors.KINDS[kind] for kind in events.kinds])[events.sensor])
    turns = np.ascontiguousarray(scenario.motion.increments(scenario.edges))
    states = plan.setup.states
    return _Prepared(
        problem=problem,
        record=record,
        layout=machine.instance(layout, **lanes),
        filter=montecarlo_six if plain else machine.instance(montecarlo_filter, **lanes),
        gyro=_gyro_terms(plan, record, model.limit, turns),
        start=montecarlo_run.Start(
            attitude=np.ascontiguousarray(record.truth.attitude[0]),
            error=np.array(
                [
                    *initial_sigmas(plan.dispersions, plan.setup),
                    *plan.dispersions.attitude_error,
                    *plan.dispersions.bias_error,
                ]
            ),
            P=np.ascontiguousarray(problem.initial.covariance),
            fast=0.0 if states is None else float(states.gyro_fast_bias_sigma) ** 2,
        ),
        events=_event_terms(plan, problem, series, span),
        filters=forward.filter_body(problem, forward.unit_sigmas(problem.record, model, {})),
        noise=read_only(noise),
        degrees=degrees,
        keys=_keys(plan),
    )


def _substeps(record: ImuRecord, limit: float) -> Array:
    """Return, for each step of a record (n,), the longest time, s, over which the filter's polynomials hold: at most the step."""
    angle = np.linalg.norm(record.increments, axis=1)
    share = np.minimum(1.0, LARGEST_ANGLE / np.maximum(angle, LARGEST_ANGLE))
    return np.asarray(np.minimum(record.intervals * share, limit))


def _keys(plan: Plan) -> np.ndarray:
    """Return two words per source, from the seed and the source's name."""
    names = [*_SOURCES, *(word for sensor in plan.sensors for word in (f"sensor {sensor}", f"faults of {sensor}"))]
    return np.array(
        [
            np.random.SeedSequence(plan.seed, spawn_key=(zlib.crc32(name.encode()),)).generate_state(2, np.uint64)
            for name in names
        ]
    )


def _gyro_terms(plan: Plan, record: ImuRecord, limit: float, turns: Array) -> montecarlo_run.Gyro:
    """Return the gyro for the kernel; ``turns``: true increments at the gyro's rate."""
    scenario, spec, samples = plan.scenario, plan.scenario.gyro, plan.setup.integration.samples
    shaping = flicker.shaping(len(record.increments))
    flickers = bool(np.any(np.greater(spec.bias_instability, 0.0)))
    scale = np.sqrt(np.diag(shaping.covariance))
    factor = scale[:, None] * np.linalg.cholesky(shaping.covariance / np.outer(scale, scale))
    force = np.empty((0, 3))
    if plan.individuals and np.any(spec.g_sensitivity != 0.0):
        middle = 0.5 * (scenario.edges[1:] + scenario.edges[:-1])
        force = vectors.specific_force(scenario.motion, middle, gravity_f=scenario.gravity_f) / scenario.rate
    assert record.truth is not None
    return montecarlo_run.Gyro(
        edges=read_only(record.time),
        substeps=_substeps(record, limit),
        true_increments=np.ascontiguousarray(turns.reshape(-1, samples, 3).sum(axis=1)),
        true_force=force,
        true_bias=record.truth.bias,
        terms=np.array(
            [
                np.any(np.greater(spec.rate_random_walk, 0.0)),
                np.any(np.greater(spec.markov_noise, 0.0)),
                flickers,
                _units_differ(plan),
                np.isfinite(spec.range),
                np.any(np.greater(spec.rate_resolution, 0.0)),
            ]
        ),
        sizes=_gyro_sizes(spec, samples / scenario.rate),
        poles=shaping.poles,
        gains=shaping.gains,
        poles_start=factor if flickers else np.empty((0, flicker.STATES)),
    )


def _gyro_sizes(spec: GyroSpec, dt: float) -> Array:
    """Return the magnitudes of the gyro's errors over a step of dt, s, per axis, as the kernel reads them (10, 3)."""
    white, walk, markov = spec.angle_random_walk, spec.rate_random_walk, spec.markov_noise
    tau = spec.markov_correlation_time
    decay, variance, mean, remainder = gyro_errors.markov_step(dt, tau)
    sizes = (
        np.sqrt(np.square(white) * dt + np.square(walk) * dt**3 / 12.0 + np.square(markov) * remainder),
        np.multiply(walk, np.sqrt(dt)),
        decay,
        np.multiply(markov, np.sqrt(variance)),
        mean,
        np.multiply(markov, np.sqrt(0.5 * tau)) if np.isfinite(tau) else 0.0,
        spec.turn_on_bias_sigma,
        spec.bias_instability,
        spec.range,
        spec.rate_resolution,
    )
    return np.array([np.broadcast_to(size, 3) for size in sizes])


def _exact(sensor: Any, scenario: Scenario, series: VectorMeasurements) -> tuple[Array, Array, Array]:
    """Return noise-free values of a sensor (m, 4), its true σ (m, 3) and the scale of its noise (m,), as the filter takes them."""
    silent = vectors.without_noise(sensor)
    if isinstance(sensor, Magnetometer | Accelerometer):
        silent = replace(silent, kind="vector")
    exact = silent.observe(scenario.motion, scenario.edges[0], scenario.edges[-1], generator(0, 0, sensor.name))
    m = len(series.time)
    if series.attitude is not None:
        assert exact.attitude is not None
        tilted = isinstance(sensor.boresight, tuple)
        sigma = np.full(3, sensor.sigma_across) if tilted else sensor.sigma_axes
        return exact.attitude, np.broadcast_to(sigma, (m, 3)), np.ones(m)
    length = np.broadcast_to(np.linalg.norm(exact.reference_f, axis=-1), m)
    values = np.concatenate([exact.vector_b / length[:, None], np.zeros((m, 1))], axis=1)
    return values, np.repeat(sensor.sigma / length[:, None], 3, axis=1), 1.0 / length


def _event_terms(
    plan: Plan, problem: Problem, series: tuple[VectorMeasurements, ...], span: np.ndarray
) -> montecarlo_run.Events:
    """Return the measurements and sensors for the kernel."""
    events, sensors = problem.events, plan.scenario.sensors
    m, s = len(events.time), len(sensors)
    exact, sigma, scale = np.zeros((m, 4)), np.zeros((m, 3)), np.ones(m)
    decay, share, number = np.zeros(m), np.zeros(m), np.zeros(m, np.int64)
    struck, larger, boresight = np.zeros(s, np.uint64), np.ones(s), np.zeros((s, 4))
    for i, (sensor, own) in enumerate(zip(sensors, series, strict=True)):
        faults: vectors.Faults = sensor.faults  # type: ignore[attr-defined]
        mine = np.flatnonzero(events.sensor == i)
        exact[mine], sigma[mine], scale[mine] = _exact(sensor, plan.scenario, own)
        number[mine] = np.arange(len(mine))
        if isinstance(sensor, AttitudeSensor) and isinstance(sensor.boresight, tuple):
            boresight[i] = (*sensor.boresight, sensor.sigma_about - sensor.sigma_across)
        if faults.outlier_probability > 0.0:
            struck[i] = min(int(faults.outlier_probability * 2.0**64), 2**64 - 1)
            larger[i] = faults.outlier_scale
        if faults.correlated_sigma > 0.0 and len(mine):
            decay[mine[1:]] = np.exp(-np.diff(events.time[mine]) / faults.correlation_time)
            share[mine] = faults.correlated_sigma * scale[mine] * np.sqrt(1.0 - decay[mine] ** 2)
    return montecarlo_run.Events(
        span=span.astype(np.int64),
        exact=exact,
        sigma=sigma,
        scale=scale,
        turning=_true_turning(plan, events.time),
        decay=decay,
        share=share,
        number=number,
        boresight=boresight,
        struck_below=struck,
        outlier_scale=larger,
    )


def _true_turning(plan: Plan, time: Array) -> Array:
    """Return ``[ẇ] + [w]²`` by rows (m, 9) at these times; no rows if the runs do not differ in lever arms."""
    motion = plan.scenario.motion
    if not plan.individuals or not any(np.any(getattr(sensor, "lever_arm_b", 0.0)) for sensor in plan.scenario.sensors):
        return np.empty((0, 9))
    rate, arms = np.cross(motion.body_rate(time)[:, None], np.eye(3)), np.eye(3)
    columns = np.cross(motion.body_angular_acceleration(time)[:, None], arms)
    columns += np.cross(motion.body_rate(time)[:, None], rate)
    return np.ascontiguousarray(columns.transpose(0, 2, 1)).reshape(-1, 9)


# ---------------------------------------------------------------------------------------------- running


class _Group:
    """Memory of eight simultaneous runs, and the call that advances them."""

    def __init__(self, plan: Plan, *, every: int | None = None, detail: bool = False) -> None:
        self.plan, self.prepared = plan, _prepared(plan)
        self.every = plan.every if every is None else every
        prepared, arrays, sensors = self.prepared, self.prepared.layout, len(plan.sensors)
        steps, events, n = len(prepared.record.increments), len(prepared.problem.events.time), arrays.N
        self.epochs = steps // self.every + 1
        self.truth = np.ascontiguousarray(prepared.truth[:: self.every])
        self.gyro = prepared.gyro._replace(true_bias=np.ascontiguousarray(prepared.gyro.true_bias[:: self.every]))
        self.kept = np.empty(self.epochs * KEPT * WIDTH)
        self.nis = np.zeros((sensors * plan.nis_bins, WIDTH))
        self.levers = prepared.problem.model.levers.any()
        sizes = (10 * events, 2 * (n - 6) * self.epochs) if detail else (0, 0)
        self.detail = [np.zeros(size * WIDTH) for size in sizes]
        self.draws = montecarlo_run.Draws(
            numbers=np.empty(WIDTH, np.uint64),
            keys=prepared.keys,
            streams=np.empty(4 * len(prepared.keys) * WIDTH, np.uint64),
            ahead=np.empty(len(prepared.keys) * montecarlo_run.AHEAD * WIDTH, np.float32),
            memory=np.zeros(montecarlo_run.memory(sensors) * WIDTH),
            units=np.zeros(montecarlo_run.units(sensors) * WIDTH),
            innovation=np.zeros(7 * WIDTH),
            increments=np.zeros(3 * steps * WIDTH if detail or self.levers else 0),
            longest=np.zeros(1),
        )
        self.filters = prepared.filters._replace(
            x=np.zeros((2, (n + 1) * WIDTH)),
            P=np.zeros((2, arrays.SIZE_OF_P)),
            coefficients=np.zeros_like(prepared.filters.coefficients),
            dt=np.zeros(1),
            turning=np.zeros(prepared.filters.turning.size * WIDTH),
            work=np.zeros(arrays.LINES * arrays.LINE * WIDTH),
        )
        self.measured = prepared.problem.events.measurements._replace(value=np.zeros(4 * WIDTH), noise=prepared.noise)

    def advance(self, first: int) -> None:
        """Compute the runs from index ``first`` on."""
        draws = self.draws
        draws.numbers[:] = np.arange(first, first + WIDTH)
        self.nis[:] = 0.0
        if _units_differ(self.plan):
            differences = [_differences(self.plan, run) for run in range(first, first + WIDTH)]
            draws.units[:] = np.transpose(differences).ravel()
        lost = self._run()
        if self.levers:
            # The angular acceleration is that of the samples around a measurement: the gyro's are drawn in the first pass.
            self.filters = self.filters._replace(turning=self._turns())
            self.nis[:] = 0.0
            lost = self._run()
        if lost:
            raise forward.TooPreciseError

    def _turns(self) -> Array:
        """Return the measured motion of a lever arm at the events (events, 9, runs), flat, from the increments drawn."""
        problem = self.prepared.problem
        runs = np.moveaxis(self.draws.increments.reshape(-1, 3, WIDTH), -1, 0)
        records = [replace(problem.record, increments=np.ascontiguousarray(increments)) for increments in runs]
        turns = [forward.turns(replace(problem, record=record)) for record in records]
        return np.stack(turns, axis=-1).reshape(-1)

    def _run(self) -> bool:
        prepared = self.prepared
        return bool(
            compiled(walk, montecarlo_run, prepared.filter)(
                prepared.gyro.edges,
                read_only(prepared.record.increments),
                self.measured,
                self.every,
                montecarlo_run.Body(self.filters, self.gyro, prepared.start, prepared.events, self.draws),
                montecarlo_run.Outputs(self.kept, self.nis.reshape(-1), *self.detail),
            )
        )


def _differences(plan: Plan, run: int) -> Array:
    """Return the differences of the gyro and the sensors of one run from those of the scenario, in the order of the kernel."""
    nominal, own = plan.scenario, unit(plan, run)
    parts = [getattr(own.gyro, n) - getattr(nominal.gyro, n) for n in ("error_matrix", "g_sensitivity", "turn_on_bias")]
    for mine, common in zip(own.sensors, nominal.sensors, strict=True):
        for names in (("hard_iron", "bias"), ("lever_arm_b",)):
            known = [getattr(mine, name) - getattr(common, name) for name in names if hasattr(mine, name)]
            parts.append(known[0] if known else np.zeros(3))
    return np.concatenate([part.ravel() for part in parts])


def run_chunk(plan: Plan, first_run: int, runs: int) -> Statistics:
    """Return the statistics of runs ``first_run`` to ``first_run + runs − 1``."""
    group = _Group(plan)
    m, s = plan.epochs + 1, len(plan.sensors)
    sums = np.zeros((m, montecarlo_statistics.SUMS, WIDTH))
    sums[:, montecarlo_statistics.NEES_PRODUCT :: 2] = 1.0
    finite = np.zeros(m, np.int64)
    coverage, histogram = np.zeros((m, 6, 3), np.int64), np.zeros((m, 6, BINS), np.int64)
    nis = np.zeros_like(group.nis)
    scratch, score = np.zeros(6 * WIDTH, np.uint64), np.zeros(WIDTH)
    bins = np.array([0, BINS - 1], np.uint64) + np.uint64(FIRST_BIN)
    out = montecarlo_statistics.Sums(finite, sums.reshape(-1), coverage, histogram, scratch)
    scores, examples = np.empty(-(-runs // WIDTH) * WIDTH), []
    for start in range(0, runs, WIDTH):
        group.advance(first_run + start)
        counted = min(WIDTH, runs - start)
        valid = (np.arange(WIDTH) < counted).astype(np.float64)
        compiled(montecarlo_statistics.accumulate)(group.kept, valid, group.truth, bins, out, score)
        scores[start : start + WIDTH] = score
        nis[:, :counted] += group.nis[:, :counted]
        for k in range(min(EXAMPLES - first_run - start, counted)):
            kept = group.kept.reshape(m, KEPT, WIDTH)[:, :, k]
            examples.append((first_run + start + k, *_example(kept, group.truth)))
    worst_run, worst_score = worst(np.arange(first_run, first_run + runs), scores[:runs])
    products, binades = (sums[:, montecarlo_statistics.NEES_PRODUCT + k :: 2] for k in (0, 1))
    total = _total(sums)
    return Statistics(
        time=plan.time,
        runs=runs,
        finite=finite,
        error_sum=total[:, :6],
        error_product_sum=covariance_matrices(total[:, 6:27]),
        covariance_sum=covariance_matrices(total[:, 27:48]),
        nees_sum=total[:, 48:51],
        log_nees_sum=_total(binades * math.log(2.0) - 0.5 * minus_two_log(products)),
        coverage=coverage,
        histogram=histogram,
        nis_edges=plan.nis_edges,
        sensors=plan.sensors,
        sensor_nis_sum=_total(nis).reshape(s, plan.nis_bins),
        sensor_degrees=runs * group.prepared.degrees,
        sensor_refused=np.zeros((s, plan.nis_bins), np.int64),
        worst_run=worst_run,
        worst_score=worst_score,
        example_run=np.array([number for number, *_ in examples], np.int64),
        example_error=np.array([error for _, error, _ in examples]).reshape(-1, m, 6),
        example_sigma=np.array([sigma for *_, sigma in examples]).reshape(-1, m, 6),
    )


def _total(lanes: Array) -> Array:
    """Return the sum over the last axis, in the order of :func:`strapdown.kernels.lane_values.sum_lanes`."""
    first = np.ascontiguousarray(np.moveaxis(lanes, -1, 0))
    while len(first) > 1:
        half = len(first) // 2
        first = first[:half] + first[half:]
    return np.asarray(first[0])


def _example(kept: Array, truth: Array) -> tuple[Array, Array]:
    """Return error and σ (m, 6) from the stored values of one run (m, KEPT)."""
    error = quaternion.rotation_between(kept[:, :4], truth)
    diagonal = kept[:, [7, 10, 12, 22, 25, 27]]
    return np.concatenate([error, kept[:, 28:31] - kept[:, 4:7]], axis=1), np.sqrt(diagonal)


def replay(plan: Plan, run: int) -> Replay:
    """Return one run in full detail, bitwise identical to that of the campaign."""
    group = _Group(plan, every=1, detail=True)
    group.advance(run)
    problem, record = group.prepared.problem, group.prepared.record
    events, n = problem.events, group.prepared.layout.N
    assert record.truth is not None
    lengths = (KEPT, 3, 10, 2 * (n - 6))
    flat = zip((group.kept, group.draws.increments, *group.detail), lengths, strict=True)
    kept, increments, values, states = (
        np.ascontiguousarray(a.reshape(-1, width, WIDTH)[:, :, 0]) if width else np.empty((group.epochs, 0))
        for a, width in flat
    )
    record = replace(
        record,
        increments=increments,
        vectors=tuple(_measured(series, values[events.sensor == i, :4]) for i, series in enumerate(record.vectors)),
        truth=Truth(attitude=record.truth.attitude, bias=kept[:, 28:31]),
    )
    covariance = covariance_matrices(kept[:, 7:28])
    rows = np.empty((len(values), 6))
    rows[events.row] = values[:, 4:]
    innovations = innovations_by_sensor(events, rows)
    x = np.concatenate([kept[:, :7], states[:, : n - 6]], axis=1)
    variance = np.concatenate([kept[:, [7, 10, 12, 22, 25, 27]], states[:, n - 6 :]], axis=1)
    estimate = replace(
        forward.estimate_of(problem, 1, x, variance, None),
        covariance=covariance,
        innovations=innovations,
        skipped=skipped_too(events, innovations),
    )
    initial = estimation.State(attitude=kept[0, :4], bias=kept[0, 4:7], covariance=covariance[0])
    return Replay(record=record, initial=initial, estimate=estimate)


def _measured(series: VectorMeasurements, values: Array) -> VectorMeasurements:
    """Return a series with the values of one run (m, 4), as used by the kernel."""
    if series.attitude is not None:
        return replace(series, attitude=quaternion.normalize(values))
    z = values[:, :3]
    if series.kind == "vector":
        return replace(series, vector_b=z * np.linalg.norm(series.references_f, axis=1)[:, None])
    return replace(series, vector_b=z / np.linalg.norm(z, axis=1)[:, None])
