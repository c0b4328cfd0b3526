"""Gyro bias driven by temperature: the record in segments of nearly constant temperature, between which the bias changes by its slopes.

The state of a segment has the bias at the segment's mean temperature. At the next segment it is ``b + c ΔT`` (:func:`shifted`, an exact
linear step of mean and covariance, outside the kernels). Within a segment the slopes estimated at its start are applied to each sample.
This neglects the slopes' error over 1/200 of the range of temperature, about its mean; σ is that at the mean.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.estimation.error_states import ErrorStates, GyroTemperature, spans
from strapdown.estimation.features import refuse
from strapdown.estimation.states import State
from strapdown.records import Estimate, ImuRecord

LEVELS = 200
"""Minimum number of segments over the range of temperature."""
BLOCKS = 1000
"""Maximum number of parts of the record whose mean temperatures are compared: limits the segments of a noisy thermometer."""


def slopes(error_states: Sequence[ErrorStates]) -> slice | None:
    """Return the position of the slopes among the error states; None if there are none."""
    return next((own for block, own in spans(error_states) if isinstance(block, GyroTemperature)), None)


def need_none(error_states: Sequence[ErrorStates], what: str) -> None:
    """Raise an error if there are slopes, which this estimator does not use."""
    refuse(what, temperature=slopes(error_states) is not None)


def of(record: ImuRecord) -> Array:
    """Return the temperature of a record (n + 1,), °C."""
    if record.temperature is None:
        raise InputError(
            "the record has no temperature, which drives the gyro's bias; give it, or leave the gyro temperature states out"
        )
    return record.temperature


def stretches(record: ImuRecord, every: int) -> Iterator[tuple[int, int, float]]:
    """Yield first and last edge and mean temperature, °C, of segments whose length is a multiple of ``every`` intervals."""
    T = of(record)
    middle, dt = 0.5 * (T[1:] + T[:-1]), record.intervals
    starts = np.arange(0, len(dt), every * max(1, -(-len(dt) // (BLOCKS * every))))
    mean = np.add.reduceat(middle * dt, starts) / np.add.reduceat(dt, starts)
    step = np.ptp(mean) / LEVELS
    bounds, level = [0], mean[0]
    for start, value in zip(starts[1:].tolist(), mean[1:], strict=True):
        if abs(value - level) > step:
            bounds.append(start)
            level = value
    for first, last in itertools.pairwise([*bounds, len(dt)]):
        yield first, last, float(np.average(middle[first:last], weights=dt[first:last]))


def shifted(state: State, own: slice, change: float) -> State:
    """Return a state and its gate's restart candidate after a change of temperature, K: ``b + c ΔT``."""
    columns = slice(6 + own.start, 6 + own.stop)
    J = np.eye(6 + len(state.values))
    J[3:6, columns] = change * np.eye(3)

    memory = state.gate
    if memory is not None and memory.candidate is not None:
        candidate = memory.candidate
        memory = replace(
            memory,
            candidate=replace(
                candidate, others=J[3:, 3:] @ candidate.others, covariance=J @ candidate.covariance @ J.T
            ),
        )
    bias = state.bias + change * state.values[own]
    P = J @ state.covariance @ J.T
    return replace(state, bias=bias, gate=memory, covariance=0.5 * (P + P.T))


def at_mean(record: ImuRecord, mean: float, slope: Array) -> tuple[ImuRecord, Array]:
    """Return a segment with increments as if at its mean temperature, and the differences of temperature from it (n + 1,), K."""
    off = of(record) - mean
    turns = 0.5 * ((off[1:] + off[:-1]) * record.intervals)[:, None] * slope
    return replace(record, increments=record.increments - turns), off


def at_edges(estimate: Estimate, own: slice, off: Array) -> Estimate:
    """Return an estimate of a segment with the bias at the temperatures of its edges, ``off`` K from the mean."""
    values = np.concatenate([block.values for block in estimate.error_states.values()], axis=1)[:, own]
    change = values * off[:, None]
    return replace(estimate, bias=estimate.bias + change)
