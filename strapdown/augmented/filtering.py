"""The filter with optional states over whole records, compiled, and what it returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from strapdown import mekf, quaternion
from strapdown.augmented import model as modelling
from strapdown.augmented.blocks import Block
from strapdown.augmented.model import AugmentedState, Model
from strapdown.checks import Array, InputError, count
from strapdown.kernels import augmented_loop
from strapdown.kernels.machine import compiled
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.mekf import ProcessNoise, Schedule
from strapdown.records import Estimate, ImuRecord
from strapdown.vectors import KINDS


@dataclass(frozen=True, kw_only=True)
class BlockEstimate:
    """Estimate of one block at the kept edges."""

    components: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    """(m, size), in ``units``."""
    variance: Array
    """(m, size), the square of the units."""

    @property
    def sigma(self) -> Array:
        """Standard deviations (m, size)."""
        return np.sqrt(self.variance)


@dataclass(frozen=True, kw_only=True)
class AugmentedEstimate(Estimate):
    """What the filter made of a record: an estimate of attitude and bias like any other, and the blocks."""

    blocks: Mapping[str, BlockEstimate] = field(default_factory=dict)
    """By name, in the order given."""
    whole_covariance: Array | None = None
    """P (m, n, n) of (δθ, δb, δc), the blocks in their order, if it was asked for; ``covariance`` is its part (m, 6, 6)."""

    def errors(
        self, true_attitude: ArrayLike, true_bias: ArrayLike, true_values: Mapping[str, ArrayLike] | None = None
    ) -> Array:
        """Return the error (m, n) of all states: Log(q_est⁻¹ ⊗ q_true), then true less estimated.

        ``true_values`` holds for each block an array (size,) or (m, size).
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
) -> AugmentedEstimate:
    """Run the filter over a whole record.

    Intervals are split at the measurements as by :func:`strapdown.mekf.run`. Linear blocks run compiled; with a general one among them the
    run goes step by step in Python, some thousand times slower.

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
    """
    return run_on(record, process_noise, initial, blocks, every=every, full_covariance=full_covariance)[0]


def run_on(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State | AugmentedState,
    blocks: Sequence[Block] = (),
    *,
    every: int = 1,
    full_covariance: bool = False,
) -> tuple[AugmentedEstimate, AugmentedState]:
    """Run the filter and return the end state too, from which the next part of a record goes on, bit for bit."""
    blocks = tuple(blocks)
    state = modelling.begin(initial, blocks)
    count("every", every)
    if modelling.general(blocks):
        from strapdown.augmented import stepping

        return stepping.run_on(record, process_noise, state, blocks, every=every, full_covariance=full_covariance)
    events = mekf.schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    model = modelling.assemble(blocks, dict(zip(events.sensors, events.kinds, strict=True)))
    estimate, end, _ = run_events(record, events, model, process_noise, state, blocks, every, full_covariance, 0)
    return estimate, end


def run_events(
    record: ImuRecord,
    events: Schedule,
    model: Model,
    process_noise: ProcessNoise,
    state: AugmentedState,
    blocks: tuple[Block, ...],
    every: int,
    full_covariance: bool,
    segments: int,
) -> tuple[AugmentedEstimate, AugmentedState, Array]:
    """Run the kernel over scheduled events; return the estimate, the end state, and up to ``segments`` segments with the end state."""
    size, width = 6 + model.states, 6 + model.states + model.noise_rows
    rows = len(record.increments) // every + 1
    attitude, x, F = start_arrays(model, state, width, size)
    attitude_out, x_out = np.empty((rows, 4)), np.empty((rows, size - 3))
    variance = np.empty((rows, size))
    P = np.empty((rows if full_covariance else 0, size, size))
    innovation = np.empty((len(events.time), max([2, *(2 * KINDS[kind] for kind in events.kinds)])))
    stored = np.empty((segments + 1 if segments else 0, 8 + size - 3 + size * (size + 1) // 2))
    number = compiled(augmented_loop.run_augmented)(
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
        events.time,
        events.kind,
        events.vector_b,
        events.variance,
        np.empty((0, 6)) if events.noise is None else events.noise,
        lengths(record, events),
        events.sensor,
        events.reference,
        events.triads,
        attitude,
        x,
        F,
        (
            np.empty((model.states, 3)),
            np.empty(model.states),
            np.empty((3, size)),
            np.empty(3),
            np.empty(3),
            np.empty((3, 3)),
            np.empty(size),
            np.empty(width),
        ),
        every,
        attitude_out,
        x_out,
        variance,
        P,
        innovation,
        stored[:segments],
    )
    if segments:
        stored[number, :4] = 0.0
        stored[number, 4:8] = attitude
        stored[number, 8 : 8 + len(x)] = x
        stored[number, 8 + len(x) :] = F[:size, :size][np.tril_indices(size)]
    estimate = packed(
        model,
        blocks,
        record.time,
        every,
        attitude_out,
        x_out,
        variance,
        P if full_covariance else None,
        mekf.innovations_by_sensor(events, innovation),
        events.skipped,
    )
    back = np.argsort(model.whole_order)
    root = F[:size, :size][:, back]
    end = AugmentedState(
        attitude=attitude,
        bias=x[:3],
        values=x[3:][np.argsort(model.order)],
        covariance=root.T @ root,
        factor=root,
    )
    return estimate, end, stored[: number + 1]


def start_arrays(model: Model, state: AugmentedState, width: int, columns: int) -> tuple[Array, Array, Array]:
    """Return a state as the kernels take it: attitude (4,), x = (b, c), and F (width, columns) with the triangle at its top."""
    size = 6 + model.states
    x = np.concatenate([state.bias, state.values[model.order]])
    F = np.zeros((width, columns))
    F[:size, :size] = modelling.triangle(state, model)
    return state.attitude.copy(), x, F


def lengths(record: ImuRecord, events: Schedule) -> Array:
    """Return what each event's vector was divided by (events,): the length of its reference for kind ``"vector"``, else 1."""
    result = np.ones(len(events.time))
    for i, series in enumerate(record.vectors):
        if series.kind == "vector":
            mine = events.sensor == i
            which = np.searchsorted(series.time, events.time[mine])
            result[mine] = np.linalg.norm(series.references_f[which], axis=1)
    return result


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
        events=tuple(mekf.gaps(edges)),
        blocks=found,
        whole_covariance=whole,
    )


def most_segments(record: ImuRecord, model: Model, events: int) -> int:
    """Return a bound of the number of segments: one an interval and an event, and the sub-steps of both limits."""
    dt = np.diff(record.time)
    turn = np.linalg.norm(record.increments, axis=1) / LARGEST_ANGLE
    steps = np.maximum(turn, dt / model.limit)
    return len(dt) + events + int(np.sum(np.floor(steps[steps > 1.0]) + 1.0))
