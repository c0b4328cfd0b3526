"""The filter with optional states over whole records, compiled, and what it returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from strapdown import mekf, quaternion
from strapdown.augmented import model as modelling
from strapdown.augmented.blocks import Block
from strapdown.augmented.model import AugmentedGateMemory, AugmentedState, Model
from strapdown.augmented.turning import turning
from strapdown.checks import Array, InputError, count
from strapdown.kernels import augmented_loop, augmented_robust
from strapdown.kernels.augmented_chain import LINKS
from strapdown.kernels.augmented_step import OFFSET
from strapdown.kernels.machine import compiled
from strapdown.kernels.robust_gate import CHALLENGED
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.mekf import ProcessNoise, Schedule
from strapdown.mekf.judging import event_rows, gate_events, kernel_options, remembered
from strapdown.mekf.scheduling import skipped_too
from strapdown.mekf.states import check_arguments, first_bias_variance, restart_bias_variance
from strapdown.records import BlockEstimate, Estimate, Event, ImuRecord
from strapdown.robustness import Gate, Monitor, Robust
from strapdown.vectors import KINDS, VectorMeasurements


@dataclass(frozen=True, kw_only=True, eq=False)
class AugmentedEstimate(Estimate):
    """What the filter made of a record: an estimate of attitude and bias like any other, and the blocks."""

    blocks: Mapping[str, BlockEstimate] = field(default_factory=dict)
    """By name, in the order given."""
    whole_covariance: Array | None = None
    """P (m, n, n) of (δθ, δb, δc), the blocks in their order, if it was asked for; ``covariance`` is its part (m, 6, 6)."""

    whole_bias: Array | None = None
    """Gyro bias and all that blocks add to it, ``b + Σ c e`` (m, 3), rad/s, if it was asked for."""
    whole_bias_variance: Array | None = None
    """Diagonal of the covariance of attitude and whole bias (m, 6)."""
    whole_bias_covariance: Array | None = None
    """That covariance (m, 6, 6)."""

    def errors(
        self, true_attitude: ArrayLike, true_bias: ArrayLike, true_values: Mapping[str, ArrayLike] | None = None
    ) -> Array:
        """Return the error (m, n) of all states: Log(q_est⁻¹ ⊗ q_true), then true less estimated.

        ``true_values`` holds for each block an array (size,) or (m, size), of what is carried in the axes of the estimated attitude
        (:attr:`strapdown.augmented.Effect.carried`).
        """
        given = dict(true_values or {})
        if set(given) != set(self.blocks):
            raise InputError(f"true_values tells {sorted(given)}, the blocks are {sorted(self.blocks)}; tell each")
        turn = quaternion.log(quaternion.multiply(quaternion.conjugate(self.attitude), true_attitude))
        parts = [turn, np.asarray(true_bias) - self.bias]
        parts += [np.asarray(given[name]) - block.values for name, block in self.blocks.items()]
        return np.concatenate(parts, axis=-1)


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State | AugmentedState,
    blocks: Sequence[Block] = (),
    *,
    every: int = 1,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
    monitor: Monitor | None = None,
) -> AugmentedEstimate:
    """Run the filter over a whole record.

    Intervals are split at the measurements as by :func:`strapdown.mekf.run`, and missing measurements (NaN) are counted as skipped. Linear
    blocks run compiled; with a general one among them the run goes step by step in Python, some thousand times slower.

    Parameters
    ----------
    record : ImuRecord
    process_noise : ProcessNoise
    initial : mekf.State or AugmentedState
        State at the first edge; of the former the blocks start at zero with their own sigma.
    blocks : sequence of blocks
    every : int
        Keep the state at every ``every``-th edge, the first included.
    full_covariance : bool
        Keep whole covariance matrices too.
    gate : Gate, optional
        Refuse measurements that no right filter would see, and recover where they agree with each other; the blocks then start anew.
    robust : Robust, optional
        Weigh measurements by how far they lie off.
    monitor : Monitor, optional
        Report when the running NIS leaves its bounds.
    """
    return run_on(
        record,
        process_noise,
        initial,
        blocks,
        every=every,
        full_covariance=full_covariance,
        gate=gate,
        robust=robust,
        monitor=monitor,
    )[0]


def run_on(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State | AugmentedState,
    blocks: Sequence[Block] = (),
    *,
    every: int = 1,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
    monitor: Monitor | None = None,
) -> tuple[AugmentedEstimate, AugmentedState]:
    """Run the filter and return the end state too, from which the next part of a record goes on, bit for bit.

    It holds what a gate remembers as well: its counts, its challenger, how wide a restart is, and the blocks' prior. A lock-out that goes
    on is told by both parts, by the second as a whole. A monitor starts anew in each part, and with a block told by functions a gate does.

    Effects that are fixed in a sensor's own unit (``varying``) keep in all parts the unit of the first in which the sensor is, the strength
    at the root mean square σ there (``unit_sigma`` of the state). A run over the whole record has that of the whole, and so another prior,
    unless ``initial`` tells the same one. With a lever arm parts agree to some 1e-6 of what they estimate only: the angular acceleration
    is found from the gyro about each measurement, and at a cut from one side of it.
    """
    check_arguments(record=record, process_noise=process_noise, gate=gate, robust=robust, monitor=monitor)
    blocks = modelling.as_blocks(blocks)
    state = modelling.begin(initial, blocks)
    count("every", every)
    if modelling.general(blocks):
        from strapdown.augmented import stepping

        estimate, end = stepping.run_on(
            record,
            process_noise,
            state,
            blocks,
            every=every,
            full_covariance=full_covariance,
            gate=gate,
            robust=robust,
        )
        return watched(estimate, monitor, gate), end
    events, model = prepared(record, blocks)
    estimate, end, _ = run_events(
        record,
        events,
        model,
        process_noise,
        state,
        blocks,
        every=every,
        full_covariance=full_covariance,
        gate=gate,
        robust=robust,
    )
    return watched(estimate, monitor, gate), end


def watched(estimate: AugmentedEstimate, monitor: Monitor | None, gate: Gate | None) -> AugmentedEstimate:
    """Return an estimate with what a monitor says of all innovations in order of time; of refused ones the gate's threshold counts."""
    parts = [one for one in estimate.innovations.values() if len(one.time)]
    if monitor is None or not parts:
        return estimate
    time = np.concatenate([one.time for one in parts])
    degrees = np.concatenate([np.full(len(one.time), one.innovation.shape[1]) for one in parts])
    nis = np.concatenate([one.nis for one in parts])
    if gate is not None:
        nis = np.where(np.concatenate([one.used for one in parts]), nis, gate.thresholds[degrees - 1])
    order = np.argsort(time, kind="stable")
    told = [*estimate.events, *monitor.watch(time[order], nis[order], degrees[order])]
    return replace(estimate, events=tuple(sorted(told, key=lambda event: event.start)))


def prepared(record: ImuRecord, blocks: tuple[Block, ...]) -> tuple[Schedule, Model]:
    """Return a record's measurements in order of time, and the blocks as arrays."""
    events = mekf.schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    return events, modelling.assemble(blocks, dict(zip(events.sensors, events.kinds, strict=True)))


def run_events(
    record: ImuRecord,
    events: Schedule,
    model: Model,
    process_noise: ProcessNoise,
    state: AugmentedState,
    blocks: tuple[Block, ...],
    *,
    every: int = 1,
    full_covariance: bool = False,
    segments: int = 0,
    gate: Gate | None = None,
    robust: Robust | None = None,
    whole_bias: bool = False,
) -> tuple[AugmentedEstimate, AugmentedState, Array]:
    """Run the kernel over scheduled events; return the estimate, the end state, and up to ``segments`` segments with the end state.

    With ``whole_bias`` the estimate tells the whole bias, and ``full_covariance`` is about that instead of all states.
    """
    size, width = 6 + model.states, 6 + model.states + model.noise_rows
    plain = gate is None and robust is None
    rows = len(record.increments) // every + 1
    attitude, x, F = start_arrays(model, state, width, size)
    attitude_out, x_out = np.empty((rows, 4)), np.empty((rows, size - 3))
    variance = np.empty((rows, size))
    P = np.empty((rows if full_covariance and not whole_bias else 0, size, size))
    told = np.empty((rows if whole_bias else 0, 6))
    told_covariance = np.empty((rows if whole_bias and full_covariance else 0, 6, 6))
    most = max([2, *(2 * KINDS[kind] for kind in events.kinds)]) if plain else 6
    innovation, weight = np.empty((len(events.time), most)), None
    stored = np.empty((segments + 1 if segments else 0, 8 + size - 3 + size * (size + 1) // 2))
    believed = (
        record.time,
        np.ascontiguousarray(record.increments),
        process_noise.angle_random_walk**2,
        process_noise.rate_random_walk**2,
        model.decay,
        model.density,
        model.changing,
        model.limit,
        model.gyro,
        model.gyro_use,
        model.sensors,
        model.sensor_use,
        tuple(model.force_f.tolist()),
        model.chains,
        np.empty((len(model.chains), LINKS)),
    )
    units = unit_sigmas(record, model, state.unit_sigma)
    measured = (
        lengths(record, events, model, units),
        events.sensor,
        events.reference,
        _turns(record, events, model),
        events.triads,
    )
    steps = np.empty((model.states, 3)), np.empty(model.states)
    rows_of = np.empty((3, size)), np.empty(3), np.empty(3), np.empty((3, 3))
    out = (every, attitude_out, x_out, variance, P, told, told_covariance, innovation)
    judged: list[Event] = []
    memory: AugmentedGateMemory | None = None
    if plain:
        number = compiled(augmented_loop.run_augmented)(
            *believed,
            events.time,
            events.kind,
            events.vector_b,
            events.variance,
            np.empty((0, 6)) if events.noise is None else events.noise,
            *measured,
            attitude,
            x,
            F,
            (*steps, *rows_of, np.empty(size), np.empty(width), np.empty((6, 6))),
            *out,
            stored[:segments],
        )
    else:
        weight = np.empty(len(events.time))
        recoveries, lock_outs = event_rows(len(events.time), len(events.sensors))
        attitudes, xs, Fs = (np.stack([one, one]) for one in (attitude, x, F))
        counts, standing = remembered(gate, state.gate, events.sensors)
        if state.gate is not None and counts[CHALLENGED]:
            rival = state.gate.challenger
            attitudes[1], xs[1] = rival[:4], rival[4 : 4 + len(x)]
            Fs[1, :size, :size] = rival[4 + len(x) :].reshape(size, size)
        first = state.gate or _first(state, blocks, float(record.time[0]))
        number, found, locked = compiled(augmented_robust.run_augmented_robust)(
            *believed,
            events.time,
            events.kind,
            events.vector_b,
            events.body_noise,
            *measured,
            *kernel_options(gate, robust),
            np.sqrt(restart_bias_variance(gate, state)),
            first.values[model.order],
            modelling.lower_root(first.covariance[np.ix_(model.order, model.order)]),
            first.start,
            standing,
            counts,
            attitudes,
            xs,
            Fs,
            (*steps, np.empty(width), np.empty((6, 6))),
            (*rows_of, *np.empty((2, 3, size)), *np.empty((2, size)), np.empty(size - 3), np.empty(width)),
            np.empty((3 * model.states + 6, 3 + model.states)),
            *out,
            weight,
            recoveries,
            lock_outs,
            stored[:segments],
        )
        attitude, x, F = attitudes[0], xs[0], Fs[0]
        if gate is not None:
            memory = replace(
                first,
                challenger=np.concatenate([attitudes[1], xs[1], Fs[1, :size, :size].ravel()]),
                counts=counts,
                standing=dict(zip(events.sensors, standing, strict=True)),
            )
        judged = gate_events(recoveries[:found], lock_outs[:locked], events.sensors)
    if segments:
        stored[number, :4] = 0.0
        stored[number, 4:8] = attitude
        stored[number, 8 : 8 + len(x)] = x
        stored[number, 8 + len(x) :] = F[:size, :size][np.tril_indices(size)]
    innovations = mekf.innovations_by_sensor(events, innovation, weight)
    estimate = packed(
        model,
        blocks,
        record.time,
        every,
        attitude_out,
        x_out,
        variance,
        P if len(P) else None,
        innovations,
        skipped_too(events, innovations),
        judged,
    )
    if whole_bias:
        offsets = model.gyro[:, :3] * (model.gyro_use & OFFSET > 0)[:, None]
        estimate = replace(
            estimate,
            whole_bias=x_out[:, :3] + x_out[:, 3:] @ offsets,
            whole_bias_variance=told,
            whole_bias_covariance=told_covariance if full_covariance else None,
        )
    back = np.argsort(model.whole_order)
    root = F[:size, :size][:, back]
    end = AugmentedState(
        gate=memory,
        unit_sigma=units,
        attitude=attitude,
        bias=x[:3],
        values=x[3:][np.argsort(model.order)],
        covariance=root.T @ root,
        factor=root,
    )
    return estimate, end, stored[: number + 1]


def _first(state: AugmentedState, blocks: tuple[Block, ...], start: float) -> AugmentedGateMemory:
    """Return what a gate knows at the start of a record."""
    values, P = restart_states(state, blocks)
    return AugmentedGateMemory(
        restart_bias_variance=first_bias_variance(state),
        challenger=np.empty(0),
        counts=np.empty(0),
        standing={},
        start=start,
        values=values,
        covariance=P,
    )


def restart_states(state: AugmentedState, blocks: tuple[Block, ...]) -> tuple[Array, Array]:
    """Return values (m,) and covariance (m, m) that the blocks of a challenger have at the start of the record.

    They are those of the filter's own start, but each state at least as uncertain as its block says: a start that goes on from an earlier
    part of a record may be what led the filter astray.
    """
    P = state.covariance[6:, 6:].copy()
    least = np.concatenate([np.empty(0), *(np.asarray(block.sigma) ** 2 for block in blocks)])
    P[np.diag_indices(len(P))] = np.maximum(np.diag(P), least)
    return state.values, P


def _turns(record: ImuRecord, events: Schedule, model: Model) -> Array:
    """Return rate, angular acceleration and the variances of the latter's axes at the events (events, 9); none without a lever arm."""
    if not model.levers.any():
        return np.empty((0, 9))
    turns, variance = turning(record, events.time)
    levered = model.levers[events.sensor]
    return np.concatenate([turns, np.where(levered[:, None], variance, 0.0)], axis=1)


def start_arrays(model: Model, state: AugmentedState, width: int, columns: int) -> tuple[Array, Array, Array]:
    """Return a state as the kernels take it: attitude (4,), x = (b, c), and F (width, columns) with the triangle at its top."""
    size = 6 + model.states
    x = np.concatenate([state.bias, state.values[model.order]])
    F = np.zeros((width, columns))
    F[:size, :size] = modelling.triangle(state, model)
    return state.attitude.copy(), x, F


def lengths(record: ImuRecord, events: Schedule, model: Model, units: Mapping[str, float]) -> Array:
    """Return what each event's effects are divided by (events,).

    For kind ``"vector"`` that is the length of its reference; for a direction or heading with an effect that is fixed in the sensor's unit
    the strength of what is measured over that at the σ that ``units`` tells; else 1.
    """
    result = np.ones(len(events.time))
    for i, series in enumerate(record.vectors):
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
    """Return ``unit_sigma`` of a state (:class:`AugmentedState`) after a record: that kept, and of sensors without it this record's."""
    found = {
        series.sensor: float(np.sqrt(np.mean(level_sigma(series) ** 2)))
        for series in record.vectors
        if series.sensor in model.varying and len(series.time)
    }
    return {**found, **kept}


def strength(series: VectorMeasurements) -> Array:
    """Return the strength of what a direction or heading measures (m,), over that at its root mean square σ."""
    sigma = level_sigma(series)
    return np.asarray(np.sqrt(np.mean(sigma**2)) / sigma)


def level_sigma(series: VectorMeasurements) -> Array:
    """Return a sensor's own noise over the strength of what it measures (m,): σ, which of a heading is over the level part of it."""
    level = np.ones(len(series.time))
    if series.kind == "heading":
        level = np.linalg.norm(series.references_f[:, :2], axis=1)
    sigma = series.sigma * level
    if np.any(sigma <= 0.0):
        raise InputError(
            f"{series.sensor}: sigma is 0, which does not tell how strong what it measures is; give it, or varying=False"
        )
    return np.asarray(sigma)


def packed(
    model: Model,
    blocks: tuple[Block, ...],
    edges: Array,
    every: int,
    attitude: Array,
    x: Array,
    variance: Array,
    P: Array | None,
    innovations: Mapping,  # type: ignore[type-arg]
    skipped: Mapping[str, int],
    told: Sequence[Event] = (),
) -> AugmentedEstimate:
    """Return the estimate in the order of outside."""
    back = np.argsort(model.whole_order)
    values, spread = x[:, 3:][:, back[6:] - 6], variance[:, back]
    whole = None if P is None else P[:, back[:, None], back]
    found, first = {}, 0
    for block in blocks:
        part = slice(first, first + block.size)
        found[block.name] = BlockEstimate(
            components=tuple(block.components),
            units=tuple(block.units),
            values=values[:, part],
            variance=spread[:, 6:][:, part],
        )
        first += block.size
    return AugmentedEstimate(
        time=edges[::every],
        attitude=attitude,
        bias=x[:, :3].copy(),
        variance=spread[:, :6],
        covariance=None if whole is None else whole[:, :6, :6],
        innovations=innovations,
        skipped=skipped,
        events=tuple(sorted([*mekf.gaps(edges), *told], key=lambda event: event.start)),
        blocks=found,
        whole_covariance=whole,
    )


def most_segments(record: ImuRecord, model: Model, events: int) -> int:
    """Return a bound of the number of segments: one an interval and an event, and the sub-steps of both limits."""
    dt = np.diff(record.time)
    turn = np.linalg.norm(record.increments, axis=1) / LARGEST_ANGLE
    steps = np.maximum(turn, dt / model.limit)
    return len(dt) + events + int(np.sum(np.floor(steps[steps > 1.0]) + 1.0))
