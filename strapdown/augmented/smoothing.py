"""The smoother with optional states: attitude, bias and blocks at each edge from the measurements before and after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from strapdown import kinematics, mekf, quaternion
from strapdown.augmented import filtering, joining
from strapdown.augmented import model as modelling
from strapdown.augmented.blocks import Block
from strapdown.augmented.filtering import AugmentedEstimate
from strapdown.augmented.model import AugmentedGateMemory, AugmentedState, Model
from strapdown.checks import Array, count, non_negative
from strapdown.kernels import augmented_smoother
from strapdown.kernels.augmented_chain import LINKS
from strapdown.kernels.machine import compiled
from strapdown.mekf import ProcessNoise
from strapdown.mekf.states import check_arguments
from strapdown.records import Event, ImuRecord
from strapdown.robustness import Gate, Robust

PASSES = 16
"""Backward passes of a fixed-lag smoother that go together and share what depends on the filter alone."""


def recentred(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State | AugmentedState,
    blocks: Sequence[Block] = (),
    *,
    passes: int = 2,
) -> AugmentedState:
    """Return the start moved to what the smoother makes of it, as uncertain as it was.

    From a start that is off by tenths of a radian the first measurements are linearised at the wrong place, and the filter believes for
    good to know what nothing has shown. Started anew from here it is linearised where it belongs. The record is used once for the place
    and once for the estimate, which counts the prior too little by ``1/s²`` of its information, s the singular value of
    :func:`strapdown.augmented.observability`: for records that show a state much better than the prior.
    """
    check_arguments(record=record, process_noise=process_noise)
    blocks = modelling.as_blocks(blocks)
    state = modelling.begin(initial, blocks)
    model = modelling.assemble(blocks, {series.sensor: series.kind for series in record.vectors})
    for _ in range(count("passes", passes)):
        whole = smooth(record, process_noise, state, blocks)
        # The prior's tangent space goes along: exp(a + ε) = exp(a) ⊗ exp(J_r(a) ε).
        back = np.argsort(model.whole_order)
        carry = modelling.turning_matrix(model.chains, len(back), state.attitude, whole.attitude[0])[np.ix_(back, back)]
        a = quaternion.log(quaternion.multiply(quaternion.conjugate(state.attitude), whole.attitude[0]))
        carry[:3, :3] = kinematics.right_jacobian(a)
        state = AugmentedState(
            attitude=whole.attitude[0],
            bias=whole.bias[0],
            values=np.concatenate([np.empty(0), *(block.values[0] for block in whole.blocks.values())]),
            covariance=carry @ state.covariance @ carry.T,
            unit_sigma=state.unit_sigma,
        )
    return state


def smooth(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State | AugmentedState,
    blocks: Sequence[Block] = (),
    *,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> AugmentedEstimate:
    """Return the fixed-interval smoother's estimate at every edge (Rauch, Tung & Striebel 1965, on the manifold and on triangular factors).

    Innovations and events are the filter's; ``gate`` and ``robust`` are as for :func:`strapdown.augmented.run`. Where the gate has
    recovered, each trajectory is smoothed by itself, as :mod:`strapdown.smoother` says; with a lever arm the second begins
    only with the recovery, and from the first refusal to there the rows are the filter's own.

    Memory: 8 (n (n + 1)/2 + n + 5) bytes for each gyro interval and measurement, n states: 1.7 kB at n = 18.
    """
    return smoothed(record, process_noise, initial, blocks, np.inf, full_covariance, gate, robust)


def smooth_fixed_lag(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State | AugmentedState,
    blocks: Sequence[Block] = (),
    *,
    lag: float,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> AugmentedEstimate:
    """Return the fixed-lag smoother's estimate: at each edge t, what the measurements up to the last edge at or before t + lag tell.

    Exact: equal to :func:`smooth` on the record cut there. Work grows with the number of gyro intervals in ``lag``: for every edge one
    backward step each, of half the time that the fixed interval's takes, for what depends on the filter alone is computed once for
    :data:`PASSES` edges. ``lag`` in s; 0 is the filter, the length of the record or more is :func:`smooth`.
    """
    lag = non_negative("lag", lag, unit="s")
    return smoothed(record, process_noise, initial, blocks, lag, full_covariance, gate, robust)


def smoothed(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State | AugmentedState,
    blocks: Sequence[Block],
    lag: float,
    full_covariance: bool,
    gate: Gate | None,
    robust: Robust | None,
) -> AugmentedEstimate:
    """Return the smoother's estimate with a lag, s, infinite for the fixed interval."""
    check_arguments(record=record, process_noise=process_noise, gate=gate, robust=robust)
    blocks = modelling.as_blocks(blocks)
    state = modelling.begin(initial, blocks)
    forward, model, event_time, segments = _filtered(record, process_noise, state, blocks, gate, robust)
    breaks: list[joining.Break] = []
    again: list[joining.Again] = []
    recovered = joining.recoveries(forward.events)
    if recovered:
        assert gate is not None
        # Parts of the record keep the units of the whole.
        state = replace(state, unit_sigma=filtering.unit_sigmas(record, model, state.unit_sigma))
        breaks, again = _begun_again(
            record,
            process_noise,
            None if model.levers.any() else state,
            blocks,
            recovered,
            event_time,
            segments,
            gate,
            robust,
        )
    edges, size = len(record.time), 6 + model.states
    shapes = (edges, 4), (edges, size - 3), (edges, size), (edges if full_covariance else 0, size, size)
    outputs = [np.empty(shape) for shape in shapes]
    until = joining.last_seen(record.time, lag)
    first = joining.starts(joining.stops(record.time, breaks), event_time, segments)
    for one in joining.trajectories(record.time, until, breaks, first, segments, again):
        written = [np.empty((len(first) if len(out) else 0, *out.shape[1:])) for out in outputs] if breaks else outputs
        for stretch in joining.climbing(one.last):
            _go_back(model, process_noise, one, stretch, written)
        if breaks:
            for out, there in zip(outputs, written, strict=True):
                if len(out):
                    out[one.row] = there[one.edge]
    attitude, x, variance, P = outputs
    found = filtering.packed(
        model,
        blocks,
        record.time,
        1,
        attitude,
        x,
        variance,
        P if full_covariance else None,
        forward.innovations,
        forward.skipped,
    )
    return replace(found, events=forward.events)


def _filtered(
    record: ImuRecord,
    process_noise: ProcessNoise,
    state: AugmentedState,
    blocks: tuple[Block, ...],
    gate: Gate | None,
    robust: Robust | None,
) -> tuple[AugmentedEstimate, Model, Array, Array]:
    """Run the filter and keep its segments; return its estimate, the model, the times of events, and the segments with the end state."""
    events, model = filtering.prepared(record, blocks)
    forward, segments = joining.kept_whole(
        lambda segments: filtering.run_events(
            record,
            events,
            model,
            process_noise,
            state,
            blocks,
            every=len(record.time),
            segments=segments,
            gate=gate,
            robust=robust,
        ),
        filtering.most_segments(record, model, len(events.time)),
        "augmented.run",
    )
    return forward, model, events.time, segments


def _begun_again(
    record: ImuRecord,
    process_noise: ProcessNoise,
    state: AugmentedState | None,
    blocks: tuple[Block, ...],
    recovered: Sequence[Event],
    event_time: Array,
    segments: Array,
    gate: Gate,
    robust: Robust | None,
) -> tuple[list[joining.Break], list[joining.Again]]:
    """Return the breaks of a record, and what took over at each, from its start to the recovery.

    Without the ``state`` at the start of the record a trajectory begins with the recovery.
    """
    breaks: list[joining.Break] = []
    again: list[joining.Again] = []
    begin = float(record.time[0])
    for event in recovered:
        memory: AugmentedGateMemory | None = None
        if state is not None:
            before = joining.part(record, begin, event.end)
            _, state = filtering.run_on(
                before, process_noise, state, blocks, every=len(before.time), gate=gate, robust=robust
            )
            memory = state.gate
            begin = event.end
        one = joining.break_of(event, memory, float(record.time[0]))
        breaks.append(one)
        if memory is None or one.since == one.end:
            again.append(None)
            continue
        bias, variance, counts = joining.begun(gate, memory)
        values, P = modelling.aged_prior(blocks, memory.values, memory.covariance, one.since - memory.start)
        stop = joining.stops(record.time, [one])
        lost = joining.starts(stop, event_time, segments)[np.searchsorted(stop, one.since)]
        whole = np.diag(np.concatenate([variance, np.zeros(len(values))]))
        whole[6:, 6:] = P
        fresh = AugmentedState(
            attitude=segments[lost, 4:8],
            bias=bias,
            values=values,
            covariance=whole,
            gate=replace(memory, counts=counts),
            unit_sigma=state.unit_sigma if state is not None else {},
        )
        stretch = joining.part(record, one.since, one.end)
        _, _, times, rows = _filtered(stretch, process_noise, fresh, blocks, replace(gate, recovery=None), robust)
        again.append((rows, joining.starts(stretch.time, times, rows)))
    return breaks, again


def _go_back(
    model: Model, process_noise: ProcessNoise, trajectory: joining.Trajectory, stretch: slice, outputs: Sequence[Array]
) -> None:
    """Write a stretch of a trajectory's edges, each by a backward pass from the last edge that it sees, to the rows of stops."""
    edge, last = trajectory.edge[stretch], trajectory.last[stretch]
    # One pass for all that see the same.
    ends = np.append(np.flatnonzero(np.diff(last)), len(last) - 1)
    begins = np.append(0, ends[:-1] + 1)
    size, noise, together = 6 + model.states, model.noise_rows, min(PASSES, len(ends))
    compiled(augmented_smoother.smooth_augmented)(
        trajectory.segments,
        trajectory.starts,
        edge[begins],
        edge[ends],
        last[ends],
        process_noise.angle_random_walk**2,
        process_noise.rate_random_walk**2,
        model.decay,
        model.density,
        model.changing,
        model.gyro,
        model.gyro_use,
        tuple(model.force_f.tolist()),
        model.chains,
        np.empty((len(model.chains), LINKS)),
        np.empty(size - 3),
        np.empty((size + noise, size + noise)),
        tuple(np.empty((3, noise, size))),
        (np.empty((model.states, 3)), np.empty(model.states), np.empty(size + noise)),
        np.empty((together, 4)),
        np.empty((together, size - 3)),
        np.empty((together, size + noise + 1, size)),
        *outputs,
    )
