"""Stretches of a record in which the covariance is carried in its triangular factor.

A covariance in doubles keeps sixteen digits. After a measurement 1e-5 times as wide as the prior, or where attitude and bias have become
one for want of measurements, what is left of a variance lies so many digits below what it is taken from that few of them are right, or
none (Bierman 1977, chapter V). The square root has to keep only half as many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from strapdown.checks import Array
from strapdown.kernels import factored_loop
from strapdown.kernels.machine import compiled
from strapdown.mekf.scheduling import Schedule
from strapdown.mekf.states import ProcessNoise, covariance_matrices
from strapdown.records import ImuRecord

FIRST_STRETCH = 64
"""Intervals taken in factors before the covariance is looked at again; each further stretch is twice as long."""
HEALTHY = 1e-7
"""What must be left of each variance when the states after it are known, for the covariance to be carried as it is again."""


@dataclass(frozen=True, kw_only=True)
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
    motion, F = state[:7].copy(), np.zeros((12, 6))
    F[:6] = triangle(covariance_matrices(state[7:]))
    empty = np.empty(0)
    scratch = (
        np.empty(6),
        np.empty((3, 6)),
        np.empty(6),
        empty,
        np.empty((0, 3)),
        np.empty((0, 12)),
        empty.astype(np.int64),
    )
    stretch = max(1, FIRST_STRETCH // every)
    while True:
        to_row = min(row + stretch, last)
        begin, end = row * every, len(increments) if to_row == last else to_row * every
        beyond = int(np.searchsorted(events.time, record.time[end], side="right"))
        mine = slice(event, beyond)
        written = np.zeros((beyond - event, outputs.innovation.shape[1]))
        compiled(factored_loop.run_factored)(
            record.time[begin : end + 1],
            increments[begin:end],
            process_noise.angle_random_walk**2,
            process_noise.rate_random_walk**2,
            events.time[mine],
            events.kind[mine],
            events.vector_b[mine],
            events.variance[mine],
            events.reference[mine],
            events.triads,
            motion,
            F,
            scratch,
            every,
            *outputs.after(row),
            written,
        )
        outputs.innovation[events.row[mine]] = written
        row, event = to_row, beyond
        stretch *= 2
        variance = np.sum(F[:6] ** 2, axis=0)
        left = np.diag(F) ** 2
        if end == len(increments) or np.all(left >= HEALTHY * variance):
            break
    state[:7] = motion
    blocks = np.empty((1, 21))
    factored_loop.store_covariance(F, blocks, 0)
    state[7:] = blocks[0]
    return row, event


def triangle(P: Array) -> Array:
    """Return F, lower triangular, with ``P = Fᵀ F``, of a covariance that may be singular."""
    sigma = np.sqrt(np.diag(P))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * sigma
    return np.asarray(np.linalg.qr(root[:, ::-1], mode="r"))[::-1, ::-1].copy()
