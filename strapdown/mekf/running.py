"""The compiled face: the filter over whole records."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from strapdown.checks import Array, count
from strapdown.kernels import filter_loop, robust_loop, robust_step
from strapdown.kernels.machine import compiled
from strapdown.mekf.memory import side_by_side
from strapdown.mekf.scheduling import Schedule, innovations_by_sensor, places, schedule
from strapdown.mekf.states import ProcessNoise, State, covariance_matrices, pack
from strapdown.records import Estimate, Event, ImuRecord
from strapdown.robustness import Gate, Monitor, Robust
from strapdown.vectors import KINDS

GAP_FACTOR = 5.0
"""A gyro interval longer than so many times the median one is told as a gap."""


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int = 1,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
    monitor: Monitor | None = None,
) -> Estimate:
    """Run the filter over a whole record, compiled.

    Gyro intervals are split exactly at the times of measurements. Intervals in which the body turns by more than a third of a radian are
    taken in sub-steps of the same constant-rate model. Missing measurements and those outside the record are counted as skipped; gaps of
    the gyro are told as events.

    Parameters
    ----------
    record : ImuRecord
        Increments are taken as turns at constant rate: correct them for coning first (:func:`strapdown.records.compress`).
    process_noise : ProcessNoise
    initial : State
        State at the first edge.
    every : int
        Keep the state at every ``every``-th edge, the first included.
    full_covariance : bool
        Keep whole covariance matrices too.
    gate : Gate, optional
        Refuse measurements that no right filter would see, and recover where they agree with each other. Default: take in all.
    robust : Robust, optional
        Weigh measurements by how far they lie off. Default: all alike.
    monitor : Monitor, optional
        Report when the running NIS leaves its bounds. Default: do not watch it.

    Returns
    -------
    Estimate
    """
    return run_on(
        record,
        process_noise,
        initial,
        every=every,
        full_covariance=full_covariance,
        gate=gate,
        robust=robust,
        monitor=monitor,
    )[0]


def run_on(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int = 1,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
    monitor: Monitor | None = None,
) -> tuple[Estimate, State]:
    """Run the filter and return the end state too, from which the next part of a record goes on, bit for bit.

    A gate's count of refusals, its challenger and a monitor start anew in each part.
    """
    events = schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    estimate, end, _ = run_events(
        record,
        events,
        process_noise,
        initial,
        every=every,
        full_covariance=full_covariance,
        segments=0,
        gate=gate,
        robust=robust,
        monitor=monitor,
    )
    return estimate, State(attitude=end[:4], bias=end[4:7], covariance=covariance_matrices(end[7:]))


def run_events(
    record: ImuRecord,
    events: Schedule,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int,
    full_covariance: bool,
    segments: int,
    gate: Gate | None = None,
    robust: Robust | None = None,
    monitor: Monitor | None = None,
) -> tuple[Estimate, Array, Array]:
    """Run the kernel over scheduled events; return the estimate, the packed end state (28,), and up to ``segments`` predicted segments.

    A segment (32,) is what a smoother needs of one prediction: dt, increment (3), packed state (28) that it starts from. Where any are
    asked for, one row more follows them: the end state, from which nothing is predicted (dt and increment 0).
    """
    count("every", every)
    rows = (len(record.increments)) // every + 1
    states = np.empty((2, 28))
    state = states[0]
    state[:] = pack(initial.attitude, initial.bias, initial.covariance)
    plain = gate is None and robust is None and events.noise is None
    width = max([4, *(2 * KINDS[kind] for kind in events.kinds)]) if plain else 6
    number_of_events = int(events.bounds[-1])
    shapes = (rows, 4), (rows, 3), (rows, 6), (rows if full_covariance else 0, 21), (number_of_events, width)
    attitude, bias, variance, blocks, innovation = side_by_side(*((shape, float) for shape in shapes))
    (stored,) = side_by_side(((segments + 1 if segments else 0, 32), float))
    weight, recoveries = None, np.empty((0, 4))
    if plain:
        columns = [places(column) for column in (events.series_vector_b, events.series_sigma)]
        number = compiled(filter_loop.run_filter)(
            record.time,
            np.ascontiguousarray(record.increments),
            process_noise.angle_random_walk**2,
            process_noise.rate_random_walk**2,
            events.time,
            events.row,
            events.sensor,
            *(first for first, _ in columns),
            np.stack(
                [starts - width * events.bounds[:-1] for (_, starts), width in zip(columns, (3, 1), strict=True)],
                axis=1,
            ),
            events.bounds,
            events.codes,
            events.frames,
            events.triads,
            state,
            every,
            attitude,
            bias,
            variance,
            blocks,
            innovation,
            stored[:segments],
        )
    else:
        options = _KernelOptions.of(gate, robust, initial)
        weight = np.empty(number_of_events)
        # A recovery takes at least two refusals.
        recoveries = np.empty((number_of_events // 2, 4))
        number, recovered = compiled(robust_loop.run_robust)(
            record.time,
            np.ascontiguousarray(record.increments),
            process_noise.angle_random_walk**2,
            process_noise.rate_random_walk**2,
            events.time,
            events.kind,
            events.sensor,
            events.vector_b,
            events.body_noise,
            events.reference,
            events.triads,
            options.thresholds,
            options.robust,
            options.robust_parameters,
            options.robust_passes,
            options.recovery,
            options.restart_attitude_variance,
            options.restart_bias_variance,
            np.zeros(len(events.sensors), np.int64),
            states,
            every,
            attitude,
            bias,
            variance,
            blocks,
            innovation,
            weight,
            recoveries,
            stored[:segments],
        )
        recoveries = recoveries[:recovered]
    if segments:
        stored[number, :4] = 0.0
        stored[number, 4:] = state
    told = [*gaps(record.time), *_recovery_events(recoveries, events.sensors)]
    if monitor is not None:
        in_order = innovation[events.row] if plain else innovation
        told += monitor.watch(*_nis_in_order(events, in_order, weight, gate))
    estimate = Estimate(
        time=record.time[::every],
        attitude=attitude,
        bias=bias,
        variance=variance,
        covariance=covariance_matrices(blocks) if full_covariance else None,
        innovations=innovations_by_sensor(events, innovation, weight, parted=plain),
        skipped=events.skipped,
        events=tuple(sorted(told, key=lambda event: event.start)),
    )
    return estimate, state, stored[: number + 1]


@dataclass(frozen=True, kw_only=True)
class _KernelOptions:
    """A gate and a robust update as the kernel takes them."""

    thresholds: Array
    robust: int
    robust_parameters: Array
    robust_passes: int
    recovery: int
    restart_attitude_variance: float
    restart_bias_variance: Array

    @classmethod
    def of(cls, gate: Gate | None, robust: Robust | None, initial: State) -> _KernelOptions:
        return cls(
            thresholds=np.full(3, np.inf) if gate is None else gate.thresholds,
            robust=0 if robust is None else {"huber": robust_step.HUBER, "student": robust_step.STUDENT}[robust.kind],
            robust_parameters=np.ones((3, 2)) if robust is None else robust.parameters,
            robust_passes=0 if robust is None else robust.iterations,
            recovery=0 if gate is None else gate.recovery or 0,
            restart_attitude_variance=0.0 if gate is None else gate.restart_attitude_sigma**2,
            restart_bias_variance=np.zeros(3) if gate is None else gate.restart_bias_variance(initial.covariance),
        )


def gaps(time: Array, factor: float = GAP_FACTOR) -> list[Event]:
    """Return the gyro intervals that are more than ``factor`` times as long as the median interval, as events."""
    steps = np.diff(time)
    if np.max(steps, initial=0.0) <= factor * np.min(steps, initial=np.inf):
        return []  # the median need not be sought
    usual = float(np.median(steps))
    return [
        Event(kind="gap", start=float(time[k]), end=float(time[k + 1]), value=float(steps[k] / usual))
        for k in np.flatnonzero(steps > factor * usual)
    ]


def _recovery_events(rows: Array, sensors: tuple[str, ...]) -> list[Event]:
    return [
        Event(kind="recovery", start=float(since), end=float(time), sensor=sensors[int(sensor)], value=float(number))
        for time, sensor, since, number in rows
    ]


def _nis_in_order(
    events: Schedule, innovation: Array, weight: Array | None, gate: Gate | None
) -> tuple[Array, Array, np.ndarray]:
    """Return times, NIS and degrees of freedom of all measurements in order; of refused ones the gate's threshold."""
    degrees = np.array([KINDS[kind] for kind in events.kinds], np.int64)[events.sensor]
    each = innovation[:, 0::2] ** 2 / innovation[:, 1::2]
    nis = np.sum(np.where(np.arange(each.shape[1]) < degrees[:, None], each, 0.0), axis=1)
    if gate is not None and weight is not None:
        nis = np.where(weight > 0.0, nis, gate.thresholds[degrees - 1])
    return events.time, nis, degrees
