"""Stretches of a record in which the covariance is carried in its triangular factor.

A covariance in doubles keeps sixteen digits. After a measurement 1e-5 times as wide as the prior, or where attitude and bias have become
one for want of measurements, what is left of a variance lies so many digits below what it is taken from that few of them are right, or
none (Bierman 1977, chapter V). The square root has to keep only half as many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from strapdown.checks import Array
from strapdown.kernels import augmented_loop, augmented_robust
from strapdown.kernels.augmented_chain import LINKS
from strapdown.kernels.machine import compiled
from strapdown.kernels.robust_gate import CHALLENGED
from strapdown.mekf.judging import kernel_options
from strapdown.mekf.scheduling import Schedule
from strapdown.mekf.states import ProcessNoise, covariance_blocks, covariance_matrices
from strapdown.records import ImuRecord
from strapdown.robustness import Gate, Robust

FIRST_STRETCH = 64
"""Intervals taken in factors before the covariance is looked at again; each further stretch is twice as long."""
SHRUNK = 1.0 - 1e-14
"""Correlations are told times this: rounding could make the covariance of one nearer to 1 indefinite."""
HEALTHY = 1e-7
"""What must be left of each variance when the states after it are known, for the covariance to be carried as it is again."""
STEPS = np.empty((0, 3)), np.empty(0)
"""Scratch of the optional states, of which there are none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outputs:
    """Arrays that a run writes, a row for each kept edge; innovations a row for each event, one sensor after the other."""

    attitude: Array
    bias: Array
    variance: Array
    blocks: Array
    innovation: Array

    def after(self, row: int) -> tuple[Array, Array, Array, Array]:
        """Return all but the innovations from a row on."""
        return self.attitude[row:], self.bias[row:], self.variance[row:], self.blocks[row:]


def run_sharp(
    record: ImuRecord,
    events: Schedule,
    process_noise: ProcessNoise,
    state: Array,
    every: int,
    outputs: Outputs,
    row: int,
    event: int,
) -> tuple[int, int]:
    """Go on from a row of the outputs and an event until the covariance can be carried as it is, or to the end.

    ``state`` (28,) is that at the row, and is left at that of the row returned, or at the end state after the last one. Returns the row
    and the number of events up to there.
    """
    increments = np.ascontiguousarray(record.increments)
    last = len(increments) // every
    attitude, bias, F = unpacked(state)
    model = no_blocks(len(events.sensors))
    work = (*STEPS, *rows_of(), np.empty(6), np.empty(12), np.empty((6, 6)))
    stretch = max(1, FIRST_STRETCH // every)
    while True:
        to_row = min(row + stretch, last)
        begin, end = row * every, len(increments) if to_row == last else to_row * every
        beyond = int(np.searchsorted(events.time, record.time[end], side="right"))
        mine = slice(event, beyond)
        whole = np.empty((to_row - row + 1 if len(outputs.blocks) else 0, 6, 6))
        written = np.zeros((beyond - event, 6))
        compiled(augmented_loop.run_augmented)(
            record.time[begin : end + 1],
            increments[begin:end],
            process_noise.angle_random_walk**2,
            process_noise.rate_random_walk**2,
            *model,
            events.time[mine],
            events.kind[mine],
            events.vector_b[mine],
            events.variance[mine],
            np.empty((0, 6)),
            np.ones(beyond - event),
            events.sensor[mine],
            events.reference[mine],
            np.empty((0, 9)),
            events.triads,
            attitude,
            bias,
            F,
            work,
            every,
            outputs.attitude[row:],
            outputs.bias[row:],
            outputs.variance[row:],
            whole,
            np.empty((0, 6)),
            np.empty((0, 6, 6)),
            written,
            np.empty((0, 32)),
        )
        if len(whole):
            outputs.blocks[row : to_row + 1] = told(whole)
        outputs.innovation[events.row[mine]] = written[:, : outputs.innovation.shape[1]]
        row, event = to_row, beyond
        stretch *= 2
        variance = np.sum(F[:6] ** 2, axis=0)
        left = np.diag(F) ** 2
        if end == len(increments) or np.all(left >= HEALTHY * variance):
            break
    pack_into(state, attitude, bias, F)
    return row, event


def run_robust_sharp(
    record: ImuRecord,
    events: Schedule,
    process_noise: ProcessNoise,
    gate: Gate | None,
    robust: Robust | None,
    restart_bias_variance: Array,
    standing: Array,
    counts: Array,
    states: Array,
    every: int,
    outputs: Outputs,
    weight: Array,
    recoveries: Array,
    lock_outs: Array,
) -> tuple[int, int]:
    """Run the filter with options over a whole record: what :func:`strapdown.kernels.robust_loop.run_robust` does, in the square root.

    Innovations are in order of time. ``states`` (2, 28), ``standing`` and ``counts`` are left as by that. Returns the numbers of
    recoveries and of lock-outs.
    """
    attitude, bias, F = (np.array(both) for both in zip(*(unpacked(state) for state in states), strict=True))
    whole = np.empty((len(outputs.attitude) if len(outputs.blocks) else 0, 6, 6))
    none = np.empty(0)
    _, recovered, locked_out = compiled(augmented_robust.run_augmented_robust)(
        record.time,
        np.ascontiguousarray(record.increments),
        process_noise.angle_random_walk**2,
        process_noise.rate_random_walk**2,
        *no_blocks(len(events.sensors)),
        events.time,
        events.kind,
        events.vector_b,
        events.body_noise,
        np.ones(len(events.time)),
        events.sensor,
        events.reference,
        np.empty((0, 9)),
        events.triads,
        *kernel_options(gate, robust),
        np.sqrt(restart_bias_variance),
        none,
        np.empty((0, 0)),
        float(record.time[0]),
        standing,
        counts,
        attitude,
        bias,
        F,
        (*STEPS, np.empty(12), np.empty((6, 6))),
        (*rows_of(), *np.empty((2, 3, 6)), *np.empty((2, 6)), np.empty(3), np.empty(12)),
        np.empty((6, 3)),
        every,
        outputs.attitude,
        outputs.bias,
        outputs.variance,
        whole,
        np.empty((0, 6)),
        np.empty((0, 6, 6)),
        outputs.innovation,
        weight,
        recoveries,
        lock_outs,
        np.empty((0, 32)),
    )
    if len(whole):
        outputs.blocks[:] = told(whole)
    for i in range(2 if counts[CHALLENGED] else 1):
        pack_into(states[i], attitude[i], bias[i], F[i])
    return int(recovered), int(locked_out)


def no_blocks(sensors: int) -> tuple[object, ...]:
    """Return a model without states beside attitude and bias: nothing decays or enters the gyro, a sensor, or another state."""
    none, unused = np.empty(0), np.empty(0, np.int64)
    return (
        none,
        none,
        0,
        np.inf,
        np.empty((0, 12)),
        unused,
        np.empty((sensors, 0, 15)),
        np.empty((sensors, 0), np.int64),
        (0.0, 0.0, 0.0),
        np.empty((0, 2)),
        np.empty((0, LINKS)),
    )


def rows_of() -> tuple[Array, ...]:
    """Return scratch for the rows of a measurement."""
    return np.empty((3, 6)), np.empty(3), np.empty(3), np.empty((3, 3))


def unpacked(state: Array) -> tuple[Array, Array, Array]:
    """Return attitude, bias and F (12, 6), room below its triangle, of a packed state (28,)."""
    F = np.zeros((12, 6))
    F[:6] = triangle(covariance_matrices(state[7:]))
    return state[:4].copy(), state[4:7].copy(), F


def pack_into(state: Array, attitude: Array, bias: Array, F: Array) -> None:
    """Write a state (28,) as the kernels without optional states hold it."""
    state[:4], state[4:7] = attitude, bias
    state[7:] = told(F[:6].T @ F[:6])


def told(P: Array) -> Array:
    """Return the blocks of covariances (..., 6, 6)."""
    return covariance_blocks(np.where(np.eye(6, dtype=bool), P, SHRUNK * P))


def triangle(P: Array) -> Array:
    """Return F, lower triangular, with ``P = Fᵀ F``, of a covariance that may be singular."""
    sigma = np.sqrt(np.diag(P))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * sigma
    return np.asarray(np.linalg.qr(root[:, ::-1], mode="r"))[::-1, ::-1].copy()
