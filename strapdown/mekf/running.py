"""The compiled face: the filter over whole records."""

from __future__ import annotations

import numpy as np

from strapdown.checks import Array, InputError, count
from strapdown.kernels import filter_loop, robust_loop
from strapdown.kernels.machine import compiled
from strapdown.kernels.robust_gate import CHALLENGED
from strapdown.mekf.factored import Outputs, run_robust_sharp, run_sharp
from strapdown.mekf.judging import event_rows, gate_events, kernel_options, remembered
from strapdown.mekf.memory import side_by_side
from strapdown.mekf.scheduling import Schedule, innovations_by_sensor, places, schedule, skipped_too
from strapdown.mekf.states import (
    ProcessNoise,
    State,
    check_arguments,
    covariance_matrices,
    first_bias_variance,
    pack,
    restart_bias_variance,
)
from strapdown.records import Estimate, Event, ImuRecord
from strapdown.robustness import Gate, GateMemory, Monitor, Robust
from strapdown.vectors import KINDS

GAP_FACTOR = 5.0
"""A gyro interval longer than so many times the median one is told as a gap."""
DIGITS = (1e9, 1e-10)
"""An innovation's variance over the measurement's, and what is left of a state's variance when the states after it are known, beyond
which the covariance keeps too few digits."""
LEAST_DIGITS = (1e14, 1e-15)
"""The same where it keeps none."""
LOST = (
    "the covariance loses its digits, by a measurement far sharper than what was known or an outage far too long; "
    "smooth by augmented.smooth, which carries its square root"
)


class LostDigitsError(InputError):
    """The covariance keeps no digit, and what asked for its segments must take them from its square root."""


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

    It holds what a gate remembers as well: its counts, its challenger, and how wide a restart is. A lock-out that goes on is told by both
    parts, by the second as a whole. A monitor starts anew in each part. Where a measurement is so sharp, or an outage so long, that the
    covariance is carried in its square root, parts agree to its rounding.
    """
    check_arguments(record=record)
    events = schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    estimate, end, _, memory = _run(
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
    return estimate, State(attitude=end[:4], bias=end[4:7], covariance=covariance_matrices(end[7:]), gate=memory)


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
    return _run(
        record,
        events,
        process_noise,
        initial,
        every=every,
        full_covariance=full_covariance,
        segments=segments,
        gate=gate,
        robust=robust,
        monitor=monitor,
    )[:3]


def _run(
    record: ImuRecord,
    events: Schedule,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int,
    full_covariance: bool,
    segments: int,
    gate: Gate | None,
    robust: Robust | None,
    monitor: Monitor | None,
) -> tuple[Estimate, Array, Array, GateMemory | None]:
    """Do as :func:`run_events` and return what the gate remembers too."""
    count("every", every)
    check_arguments(process_noise=process_noise, initial=initial, gate=gate, robust=robust, monitor=monitor)
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
    weight, recoveries, lock_outs = None, np.empty((0, 4)), np.empty((0, 4))
    memory = None
    outputs = Outputs(attitude=attitude, bias=bias, variance=variance, blocks=blocks, innovation=innovation)
    if plain:
        number = _run_plain(record, events, process_noise, state, every, outputs, stored[:segments])
    else:
        weight = np.empty(number_of_events)
        recoveries, lock_outs = event_rows(number_of_events, len(events.sensors))
        counts, standing = remembered(gate, initial.gate, events.sensors)
        states[1] = 0.0 if initial.gate is None else initial.gate.challenger
        first = states.copy()
        number, recovered, locked_out = compiled(robust_loop.run_robust)(
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
            *kernel_options(gate, robust),
            restart_bias_variance(gate, initial),
            standing,
            counts,
            states,
            every,
            attitude,
            bias,
            variance,
            blocks,
            innovation,
            weight,
            recoveries,
            lock_outs,
            stored[:segments],
            *(DIGITS if segments == 0 else LEAST_DIGITS),
            np.empty((7, 6)),
        )
        if number < 0:
            if segments:
                raise LostDigitsError(LOST)
            counts, standing = remembered(gate, initial.gate, events.sensors)
            states[:] = first
            recovered, locked_out = run_robust_sharp(
                record,
                events,
                process_noise,
                gate,
                robust,
                restart_bias_variance(gate, initial),
                standing,
                counts,
                states,
                every,
                outputs,
                weight,
                recoveries,
                lock_outs,
            )
        recoveries, lock_outs = recoveries[:recovered], lock_outs[:locked_out]
        if gate is not None:
            memory = GateMemory(
                restart_bias_variance=first_bias_variance(initial),
                challenger=states[1].copy() if counts[CHALLENGED] else np.zeros(28),
                counts=counts,
                standing=dict(zip(events.sensors, standing, strict=True)),
            )
    if segments:
        stored[number, :4] = 0.0
        stored[number, 4:] = state
    told = [
        *gaps(record.time),
        *gate_events(recoveries, lock_outs, events.sensors),
    ]
    if monitor is not None:
        in_order = innovation[events.row] if plain else innovation
        told += monitor.watch(*_nis_in_order(events, in_order, weight, gate))
    innovations = innovations_by_sensor(events, innovation, weight, parted=plain)
    estimate = Estimate(
        time=record.time[::every],
        attitude=attitude,
        bias=bias,
        variance=variance,
        covariance=covariance_matrices(blocks) if full_covariance else None,
        innovations=innovations,
        skipped=skipped_too(events, innovations),
        events=tuple(sorted(told, key=lambda event: event.start)),
    )
    return estimate, state, stored[: number + 1], memory


def _run_plain(
    record: ImuRecord,
    events: Schedule,
    process_noise: ProcessNoise,
    state: Array,
    every: int,
    outputs: Outputs,
    segments: Array,
) -> int:
    """Run the kernel without options, and where the covariance would lose its digits the one on its factor; leave the end state.

    Returns the number of segments stored. Where any are asked for, the covariance is carried as it is, and refused where no digit is left.
    """
    columns = [places(column) for column in (events.series_vector_b, events.series_sigma)]
    starts = [start - width * events.bounds[:-1] for (_, start), width in zip(columns, (3, 1), strict=True)]
    increments = np.ascontiguousarray(record.increments)
    row, event, edge = 0, 0, 0
    while True:
        number, good_row, good_event = compiled(filter_loop.run_filter)(
            record.time[edge:],
            increments[edge:],
            process_noise.angle_random_walk**2,
            process_noise.rate_random_walk**2,
            events.time[event:],
            events.row[event:],
            events.sensor[event:],
            *(first for first, _ in columns),
            np.stack(starts, axis=1),
            events.bounds,
            events.codes,
            events.frames,
            events.triads,
            state,
            every,
            *outputs.after(row),
            outputs.innovation,
            segments,
            *(DIGITS if len(segments) == 0 else LEAST_DIGITS),
            np.empty(28),
            np.empty((7, 6)),
        )
        if good_row < 0:
            return int(number)
        if len(segments):
            raise LostDigitsError(f"after {record.time[good_row * every]:g} s {LOST}")
        place = row + good_row, event + good_event
        row, event = run_sharp(record, events, process_noise, state, every, outputs, *place)
        edge = row * every
        if edge + every > len(increments):
            return 0


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


def _nis_in_order(
    events: Schedule, innovation: Array, weight: Array | None, gate: Gate | None
) -> tuple[Array, Array, np.ndarray]:
    """Return times, NIS and degrees of freedom of all measurements in order; of refused ones the gate's threshold."""
    degrees = np.array([KINDS[kind] for kind in events.kinds], np.int64)[events.sensor]
    # Beyond its degrees of freedom a row is not written.
    each = np.zeros((len(innovation), innovation.shape[1] // 2))
    told = np.arange(each.shape[1]) < degrees[:, None]
    np.divide(np.square(innovation[:, 0::2], where=told, out=each), innovation[:, 1::2], out=each, where=told)
    nis = np.sum(each, axis=1)
    if gate is not None and weight is not None:
        nis = np.where(weight > 0.0, nis, gate.thresholds[degrees - 1])
    if "heading" in events.kinds:
        shown = ~np.isnan(innovation[:, 0])
        return events.time[shown], nis[shown], degrees[shown]
    return events.time, nis, degrees
