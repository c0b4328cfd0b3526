"""The lane machine: noise, sensors and filter of eight runs at once, one per SIMD lane, compiled together.

The motion, the times of the measurements and all else common to the runs are computed once per plan; only the noise differs. Its random
streams depend only on (seed, run, source), and the filter is the scalar machine's source, so run k is bitwise identical for any chunk,
number of lanes, threads and host (with fused multiply-add). The noise has the distribution of the simulator's, not its numbers.

Two things are simpler than in the simulator. With a coning algorithm of N samples the noise is drawn once per filter step, with exactly the
distribution of the sum of N samples, and does not enter the cross products; their contribution is below the rotation over a sample times
the noise. Flicker is generated at the filter's steps, not at the gyro's samples.
"""

from __future__ import annotations

import functools
import math
import weakref
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from strapdown import estimation, quaternion, vectors
from strapdown.checks import Array, count
from strapdown.estimation import setup
from strapdown.estimation.schedule import Schedule, schedule
from strapdown.estimation.states import covariance_matrices
from strapdown.gyro import GyroSpec, flicker
from strapdown.kernels import gyro_errors, machine, montecarlo_run, montecarlo_statistics
from strapdown.kernels.machine import compiled
from strapdown.kernels.noise import minus_two_log
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.montecarlo.plan import Plan, initial_sigmas
from strapdown.montecarlo.statistics import (
    BINS,
    ERROR_EXPONENT,
    EXAMPLES,
    NEES_EXPONENT,
    Counts,
    Replay,
    Statistics,
    first_bin,
    worst,
)
from strapdown.randomness import generator
from strapdown.records import Estimate, ImuRecord, Innovations, Truth, compress
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import Accelerometer, AttitudeSensor, Magnetometer, VectorMeasurements, VectorSensor

NAME = "lanes"
CHUNK = 200

GROUP = 8
"""Number of runs summed together: the same for every number of lanes."""
LARGEST_START = 0.5
"""Maximum σ of the initial attitude error for which its rotation is accurate to rounding, rad."""

_SOURCES = ("gyro", "gyro flicker", "gyro markov", "gyro turn-on", "initial error", "dispersions")
_NOT_OF_THE_GYRO = {
    "quantization": 0.0,
    "rate_resolution": 0.0,
    "bandwidth": np.inf,
    "sampling_jitter": 0.0,
    "timestamp_error": 0.0,
    "timestamp_offset": 0.0,
    "drop_probability": 0.0,
}
_SENSORS = (VectorSensor, Magnetometer, Accelerometer, AttitudeSensor)


def supports(plan: Plan) -> str | None:
    """Return why the lanes cannot compute a plan; None if they can."""
    return next(_reasons(plan), None)


def _reasons(plan: Plan) -> Iterator[str]:
    spec = plan.scenario.gyro
    if spec.temperature is not None:
        yield "the gyro's bias over temperature is not supported by the lanes"
    for name, none in _NOT_OF_THE_GYRO.items():
        if np.any(np.asarray(getattr(spec, name)) != none):
            yield f"the gyro's {name}"
    for sensor in plan.scenario.sensors:
        if type(sensor) not in _SENSORS:
            yield f"{sensor.name}: a sensor of class {type(sensor).__name__}"
        elif isinstance(sensor, AttitudeSensor) and sensor.covariance is not None:
            yield f"{sensor.name}: a boresight other than a body axis"
        elif sensor.faults.latency > 0.0:  # type: ignore[attr-defined]
            yield f"{sensor.name}: latency"
        elif sensor.faults.drop_probability > 0.0:  # type: ignore[attr-defined]
            yield f"{sensor.name}: lost samples"
        elif isinstance(plan.setup.sigma.get(sensor.name), tuple) and not isinstance(sensor, AttitudeSensor):
            yield f"{sensor.name}: a different sigma for each axis"
    if plan.setup.estimator != setup.MEKF:
        yield f"the estimator {plan.setup.estimator_name}"
    if plan.individuals:
        yield "gyro and sensors drawn anew for each run"
    for option in ("gate", "robust", "states"):
        if getattr(plan.setup, option, None) is not None:
            yield f"the filter's {option} option"
    if initial_sigmas(plan.dispersions, plan.setup)[0] > LARGEST_START:
        yield f"an initial attitude error of more than {LARGEST_START} rad, 1 sigma"
    if plan.setup.integration.samples > 1 and plan.dispersions.of_the_gyro:
        yield "gyro parameters that differ from run to run with several gyro samples a filter step"
    if _prepared(plan).saturates:
        yield "a gyro range so close to the motion's rates that the gyro may saturate"


# ---------------------------------------------------------------------------------------------- common to all runs


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prepared:
    """Data common to all runs of a plan, as the kernels take them."""

    gyro: montecarlo_run.Gyro
    start: montecarlo_run.Start
    events_of_runs: montecarlo_run.Events
    record: ImuRecord
    """Record of the filter's steps without noise; its series have nominal σ."""
    events: Schedule
    truth: Array
    """True attitudes at the epochs (m, 4)."""
    degrees: Counts
    """Degrees of freedom of one run by sensor and time bin (s, k)."""
    keys: np.ndarray
    saturates: bool


_PREPARED: weakref.WeakKeyDictionary[Plan, _Prepared] = weakref.WeakKeyDictionary()


def _prepared(plan: Plan) -> _Prepared:
    prepared = _PREPARED.get(plan)
    if prepared is None:
        prepared = _prepare(plan)
        _PREPARED[plan] = prepared
    return prepared


def _quiet(spec: GyroSpec) -> GyroSpec:
    """Return the gyro without the errors that differ from run to run."""
    none = ("angle_random_walk", "rate_random_walk", "bias_instability", "markov_noise", "turn_on_bias_sigma")
    silent: dict[str, Any] = dict.fromkeys(none, 0.0)
    return replace(spec, **silent, range=np.inf)


def _prepare(plan: Plan) -> _Prepared:
    scenario, algorithm = plan.scenario, plan.setup.integration
    spec = scenario.gyro
    quiet = simulate(replace(scenario, gyro=_quiet(spec), sensors=()), plan.seed, 0)
    turns = np.ascontiguousarray(scenario.motion.increments(scenario.edges))
    dt = 1.0 / scenario.rate
    assert quiet.truth is not None
    rate_sigma = (
        np.sqrt(np.square(spec.angle_random_walk) / dt)
        + np.asarray(spec.turn_on_bias_sigma)
        + np.sqrt(np.square(spec.rate_random_walk) * scenario.duration)
        + 5.0 * np.asarray(spec.bias_instability)
        + plan.dispersions.turn_on_bias_sigma
    )
    steps = quiet if algorithm.name == "one-sample" else compress(quiet, algorithm)
    n = algorithm.samples
    # From one run: times, kinds, references and nominal σ are common to all runs.
    ends = scenario.motion, scenario.edges[0], scenario.edges[-1]
    series = tuple(one.observe(*ends, generator(plan.seed, 0, one.name)) for one in scenario.sensors)
    record = replace(steps, vectors=series)
    modelled = setup.modelled_record(replace(quiet, vectors=series), plan.setup)
    events = schedule(modelled.vectors, float(record.time[0]), float(record.time[-1]))
    values = [_exact(sensor, scenario, own) for sensor, own in zip(scenario.sensors, series, strict=True)]
    gyro = montecarlo_run.Gyro(
        np.ascontiguousarray(record.time),
        _substeps(record),
        np.ascontiguousarray(record.increments),
        np.ascontiguousarray(turns.reshape(-1, n, 3).sum(axis=1)),
        np.ascontiguousarray(quiet.truth.bias[::n]),
        *_gyro_terms(plan, n * dt, len(record.increments)),
    )
    noise = plan.setup.process_noise
    start = montecarlo_run.Start(
        attitude=np.ascontiguousarray(quiet.truth.attitude[0]),
        error=np.array(
            [
                *initial_sigmas(plan.dispersions, plan.setup),
                *plan.dispersions.attitude_error,
                *plan.dispersions.bias_error,
            ]
        ),
        variance=np.array([plan.setup.attitude_sigma, plan.setup.bias_sigma]) ** 2,
        noise=np.array([noise.angle_random_walk, noise.rate_random_walk]) ** 2,
    )
    place = np.clip(np.searchsorted(plan.nis_edges, events.time, side="left") - 1, 0, plan.nis_bins - 1)
    degrees = np.zeros((len(plan.sensors), plan.nis_bins), np.int64)
    np.add.at(degrees, (events.sensor, place), np.array([vectors.KINDS[kind] for kind in events.kinds])[events.sensor])
    prepared = _Prepared(
        gyro=gyro,
        start=start,
        events_of_runs=_event_terms(plan, events, values),
        record=record,
        events=events,
        truth=np.ascontiguousarray(quiet.truth.attitude[:: n * plan.every]),
        degrees=degrees,
        keys=_keys(plan),
        saturates=bool(np.any(np.abs(turns) / dt + 10.0 * rate_sigma > spec.range)),
    )
    return prepared


def _substeps(record: ImuRecord) -> Array:
    """Return, for each step of a record (n,), the longest time, s, over which the filter's polynomials hold: at most the step."""
    angle = np.linalg.norm(record.increments, axis=1)
    return np.asarray(record.intervals * np.minimum(1.0, LARGEST_ANGLE / np.maximum(angle, LARGEST_ANGLE)))


def _keys(plan: Plan) -> np.ndarray:
    """Return two words per source, from the seed and the source's name."""
    names = [*_SOURCES, *(word for sensor in plan.sensors for word in (f"sensor {sensor}", f"faults of {sensor}"))]
    return np.array(
        [
            np.random.SeedSequence(plan.seed, spawn_key=(zlib.crc32(name.encode()),)).generate_state(2, np.uint64)
            for name in names
        ]
    )


def _gyro_terms(plan: Plan, dt: float, steps: int) -> tuple[Any, ...]:
    """Return the kernel's gyro parameters: terms, noise per step, flicker, dispersions."""
    spec, given = plan.scenario.gyro, plan.dispersions
    axes = [
        np.broadcast_to(value, 3)
        for value in (spec.angle_random_walk, spec.rate_random_walk, spec.markov_noise, spec.bias_instability)
    ]
    white, walk, markov, instability = axes
    tau = spec.markov_correlation_time
    decay, variance, mean, remainder = gyro_errors.markov_step(dt, tau)
    gyro = np.array(
        [
            np.sqrt(white**2 * dt + walk**2 * dt**3 / 12.0 + markov**2 * remainder),
            walk * np.sqrt(dt),
            np.full(3, decay),
            markov * np.sqrt(variance),
            np.full(3, mean),
            markov * np.sqrt(0.5 * tau) if np.isfinite(tau) else np.zeros(3),
            np.hypot(np.broadcast_to(spec.turn_on_bias_sigma, 3), given.turn_on_bias_sigma),
            instability,
        ]
    )
    shaping = flicker.shaping(steps)
    flickers = bool(np.any(instability > 0.0))
    covariance = shaping.covariance
    scale = np.sqrt(np.diag(covariance))
    factor = scale[:, None] * np.linalg.cholesky(covariance / np.outer(scale, scale))
    dispersion = np.full((3, 3), given.misalignment_sigma)
    np.fill_diagonal(dispersion, given.scale_factor_sigma)
    terms = np.array([np.any(walk > 0.0), np.any(markov > 0.0), flickers, np.any(dispersion > 0.0)])
    return (
        terms,
        gyro,
        shaping.poles,
        shaping.gains,
        factor if flickers else np.empty((0, flicker.STATES)),
        dispersion,
    )


def _exact(sensor: Any, scenario: Scenario, series: VectorMeasurements) -> tuple[Array, Array, Array]:
    """Return noise-free values of a sensor (m, 4), its true σ (m, 3) and the scale of its noise (m,), as the filter takes them."""
    silent = replace(sensor.faults, outlier_probability=0.0, correlated_sigma=0.0)
    changes: dict[str, Any] = {"faults": silent}
    if isinstance(sensor, AttitudeSensor):
        changes.update(sigma_across=0.0, sigma_about=0.0)
    else:
        changes.update(sigma=0.0)
        if not isinstance(sensor, VectorSensor):
            changes.update(kind="vector")
    exact = replace(sensor, **changes).observe(
        scenario.motion, scenario.edges[0], scenario.edges[-1], generator(0, 0, sensor.name)
    )
    m = len(series.time)
    if series.attitude is not None:
        assert exact.attitude is not None
        return exact.attitude, np.broadcast_to(sensor.sigma_axes, (m, 3)), np.ones(m)
    length = np.linalg.norm(exact.references_f, axis=1)
    values = np.concatenate([exact.vector_b / length[:, None], np.zeros((m, 1))], axis=1)
    return values, np.repeat(sensor.sigma / length[:, None], 3, axis=1), 1.0 / length


def _event_terms(plan: Plan, events: Schedule, values: list[tuple[Array, Array, Array]]) -> montecarlo_run.Events:
    """Return the measurements and sensors for the kernel."""
    m = len(events.time)
    exact, sigma = np.zeros((m, 4)), np.zeros((m, 3))
    decay, share, number = np.zeros(m), np.zeros(m), np.zeros(m, np.int64)
    variance = np.repeat(events.variance[:, None], 3, axis=1)
    sensors = plan.scenario.sensors
    struck, scale = np.zeros(len(sensors), np.uint64), np.ones(len(sensors))
    for i, (sensor, (value, deviation, length)) in enumerate(zip(sensors, values, strict=True)):
        faults: vectors.Faults = sensor.faults  # type: ignore[attr-defined]
        mine = np.flatnonzero(events.sensor == i)
        assert len(mine) == len(value)
        exact[mine], sigma[mine], number[mine] = value, deviation, np.arange(len(mine))
        if events.kinds[i] == "attitude":
            variance[mine] = events.vector_b[mine]
        if faults.outlier_probability > 0.0:
            struck[i] = min(int(faults.outlier_probability * 2.0**64), 2**64 - 1)
            scale[i] = faults.outlier_scale
        if faults.correlated_sigma > 0.0 and len(mine):
            decay[mine[1:]] = np.exp(-np.diff(events.time[mine]) / faults.correlation_time)
            share[mine] = faults.correlated_sigma * length * np.sqrt(1.0 - decay[mine] ** 2)
    place = np.clip(np.searchsorted(plan.nis_edges, events.time, side="left") - 1, 0, plan.nis_bins - 1)
    return montecarlo_run.Events(
        time=events.time,
        kind=events.kind,
        sensor=events.sensor.astype(np.int64),
        span=place.astype(np.int64),
        exact=exact,
        sigma=sigma,
        variance=variance,
        decay=decay,
        share=share,
        number=number,
        frame=events.reference,
        frames=events.triads,
        struck_below=struck,
        outlier_scale=scale,
    )


# ---------------------------------------------------------------------------------------------- running


def runs_at_once() -> int:
    """Return the number of runs computed at once on this processor: 8, or 1 if it has no SIMD vectors."""
    return GROUP if _answered(machine.has_vectors) else 1


@functools.cache
def _answered(question: Callable[[], bool]) -> bool:
    """Return the cached answer about the processor: evaluating it takes as long as some thousand steps."""
    return question()


class _Group:
    """Memory of several simultaneous runs, and the call that advances them."""

    def __init__(self, plan: Plan, width: int, *, every: int | None = None, detail: bool = False) -> None:
        self.prepared = _prepared(plan)
        self.width = width
        self.pattern = (0.0,) * width
        self.every = plan.every if every is None else every
        steps, events, sensors = len(self.prepared.record.increments), len(self.prepared.events.time), len(plan.sensors)
        self.epochs = steps // self.every + 1
        self.places = sensors * plan.nis_bins
        self.draws = montecarlo_run.Draws(
            streams=np.empty(4 * len(self.prepared.keys) * width, np.uint64),
            ahead=np.empty(len(self.prepared.keys) * montecarlo_run.AHEAD * width, np.float32),
            memory=np.empty(montecarlo_run.memory(sensors) * width),
        )
        self.kept = np.empty(self.epochs * montecarlo_run.KEPT * width)
        self.nis = np.zeros(self.places * width)
        # Without detail the kernel is compiled without the divisions that the innovations need.
        self.detail = (
            montecarlo_run.Detail(*(np.empty(size * width) for size in (3 * steps, 4 * events, 6 * events)))
            if detail
            else None
        )

    def advance(self, first: int) -> None:
        """Compute the runs from index ``first`` on."""
        self.nis[:] = 0.0
        prepared = self.prepared
        compiled(montecarlo_run.advance)(
            self.pattern,
            np.arange(first, first + self.width, dtype=np.uint64),
            prepared.keys,
            prepared.gyro,
            prepared.start,
            prepared.events_of_runs,
            self.every,
            self.draws,
            montecarlo_run.Outputs(self.kept, self.nis),
            self.detail,
        )


def run_chunk(plan: Plan, first_run: int, runs: int, *, width: int | None = None) -> Statistics:
    """Return the statistics of runs ``first_run`` to ``first_run + runs − 1``, ``width`` runs at once (default: that of the processor)."""
    lanes = runs_at_once() if width is None else width
    group = _Group(plan, lanes)
    m, s = plan.epochs + 1, len(plan.sensors)
    sums = np.zeros((m, montecarlo_statistics.SUMS, GROUP))
    sums[:, montecarlo_statistics.NEES_PRODUCT :: 2] = 1.0
    finite = np.zeros(m, np.int64)
    coverage, histogram = np.zeros((m, 6, 3), np.int64), np.zeros((m, 9, BINS), np.int64)
    nis = np.zeros((group.places, GROUP))
    scratch, score = np.zeros(9 * GROUP, np.uint64), np.zeros(GROUP)
    bins = [np.array([0, BINS - 1], np.uint64) + np.uint64(first_bin(e)) for e in (ERROR_EXPONENT, NEES_EXPONENT)]
    scores = np.empty(-(-runs // GROUP) * GROUP)
    at_once = max(lanes, GROUP)
    kept = group.kept if lanes >= GROUP else np.empty(m * montecarlo_run.KEPT * GROUP)
    group_nis = np.empty((group.places, GROUP)) if lanes < GROUP else group.nis.reshape(-1, lanes)
    valid, pattern = np.ones(GROUP), (0.0,) * GROUP
    examples = []
    for start in range(0, runs, at_once):
        for lane in range(0, at_once, lanes):
            group.advance(first_run + start + lane)
            if lanes < GROUP:
                kept.reshape(-1, GROUP)[:, lane : lane + lanes] = group.kept.reshape(-1, lanes)
                group_nis[:, lane : lane + lanes] = group.nis.reshape(-1, lanes)
        for column in range(0, min(at_once, runs - start), GROUP):
            place = start + column
            valid[runs - place :] = 0.0
            compiled(montecarlo_statistics.accumulate)(
                pattern,
                kept,
                at_once,
                column,
                valid,
                group.prepared.truth,
                *bins,
                montecarlo_statistics.Sums(finite, sums.reshape(-1), coverage, histogram, scratch),
                score,
            )
            scores[place : place + GROUP] = score
            counted = min(GROUP, runs - place)
            nis[:, :counted] += group_nis[:, column : column + counted]
        if first_run + start < EXAMPLES:
            own = kept.reshape(m, montecarlo_run.KEPT, -1)
            examples += [
                (first_run + start + k, *_example(own[:, :, k], group.prepared.truth))
                for k in range(min(EXAMPLES - first_run - start, runs - start, own.shape[2]))
            ]
    numbers = np.arange(first_run, first_run + runs)
    worst_run, worst_score = worst(numbers, scores[:runs])
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
    error = quaternion.log(quaternion.multiply(quaternion.conjugate(kept[:, :4]), truth))
    diagonal = kept[:, [7, 10, 12, 22, 25, 27]]
    return np.concatenate([error, kept[:, 28:31] - kept[:, 4:7]], axis=1), np.sqrt(diagonal)


def replay(plan: Plan, run: int, *, width: int = 1) -> Replay:
    """Return one run in full detail, bitwise identical to that of the campaign."""
    number = count("run", run, minimum=0)
    group = _Group(plan, width, every=1, detail=True)
    group.advance(number)
    prepared = group.prepared
    assert group.detail is not None
    kept = np.ascontiguousarray(group.kept.reshape(group.epochs, montecarlo_run.KEPT, width)[:, :, 0])
    assert prepared.record.truth is not None
    truth = Truth(attitude=prepared.record.truth.attitude, bias=kept[:, 28:31])
    events = prepared.events
    values = group.detail.values.reshape(-1, 4, width)[:, :, 0]
    record = replace(
        prepared.record,
        increments=np.ascontiguousarray(group.detail.increments.reshape(-1, 3, width)[:, :, 0]),
        vectors=tuple(
            _measured(series, values[events.sensor == i]) for i, series in enumerate(prepared.record.vectors)
        ),
        truth=truth,
    )
    covariance = covariance_matrices(kept[:, 7:28])
    rows = group.detail.innovations.reshape(-1, 6, width)[:, :, 0]
    estimate = Estimate(
        time=record.time,
        attitude=kept[:, :4],
        bias=kept[:, 4:7],
        variance=kept[:, [7, 10, 12, 22, 25, 27]],
        covariance=covariance,
        innovations={
            name: Innovations(
                time=events.time[events.sensor == i],
                innovation=rows[events.sensor == i, : 2 * vectors.KINDS[kind] : 2],
                variance=rows[events.sensor == i, 1 : 2 * vectors.KINDS[kind] : 2],
            )
            for i, (name, kind) in enumerate(zip(events.sensors, events.kinds, strict=True))
        },
        skipped=events.skipped,
    )
    initial = estimation.State(attitude=kept[0, :4], bias=kept[0, 4:7], covariance=covariance[0])
    return Replay(record=record, initial=initial, estimate=estimate)


def _measured(series: VectorMeasurements, values: Array) -> VectorMeasurements:
    """Return a series with the values of one run (m, 4), as used by the kernel."""
    if series.attitude is not None:
        return replace(series, attitude=quaternion.normalize(values))
    if series.kind == "vector":
        return replace(series, vector_b=values[:, 1:] * np.linalg.norm(series.references_f, axis=1)[:, None])
    return replace(series, vector_b=values[:, 1:] / np.linalg.norm(values[:, 1:], axis=1)[:, None])
