"""The filter with error states over several records at once, eight in the lanes of SIMD vectors: for the runs of a Monte Carlo.

A record's estimate is bit for bit independent of the other records, and agrees with that of :func:`strapdown.estimation.run` to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest

import numpy as np

from strapdown.checks import Array
from strapdown.estimation import temperature
from strapdown.estimation.forward import (
    Problem,
    factor_estimate,
    gaps,
    lengths,
    model_arrays,
    turns,
    unit_sigmas,
    whole_bias,
)
from strapdown.estimation.memory import side_by_side
from strapdown.estimation.schedule import innovations_by_sensor, skipped_too
from strapdown.kernels import lane_states, measurement
from strapdown.kernels.error_state_step import FIXED
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.records import Estimate

PATTERN = (0.0,) * WIDTH
"""Argument that gives a kernel the number of lanes: one run per lane."""


def supports(problem: Problem) -> bool:
    """Return whether a record can be filtered with others: its model has no chains, no offset in fixed axes and no temperature."""
    model = problem.model
    driven = temperature.slopes(problem.error_states) is not None
    return not (driven or len(model.chains) or (model.sensor_use & FIXED).any())


def run(problems: Sequence[Problem], every: int, alone: Callable[[Problem], Estimate]) -> list[Estimate]:
    """Run one filter over several records, those with the same times eight at once.

    Parameters
    ----------
    problems : sequence of Problem
        Records, prepared for the same filter.
    every : int
        Store every ``every``-th edge, starting with the first.
    alone : callable
        Function that filters a record that :func:`supports` refuses, or whose covariance lost its digits.

    Returns
    -------
    list of Estimate
        Estimates as of a run with ``full_covariance`` and ``whole_bias``, without the covariance of the error states.
    """
    groups: list[list[int]] = []
    for i, problem in enumerate(problems):
        if supports(problem):
            mine = next((group for group in groups if _alike(problems[group[0]], problem)), None)
            if mine is None:
                groups.append([i])
            else:
                mine.append(i)
    found: dict[int, Estimate | None] = {}
    for group in groups:
        for first in range(0, len(group), WIDTH):
            together = group[first : first + WIDTH]
            found.update(zip(together, _filtered([problems[i] for i in together], every), strict=True))
    return [found.get(i) or alone(problem) for i, problem in enumerate(problems)]


def _alike(one: Problem, other: Problem) -> bool:
    """Return whether two records have the same edges, and measurements of the same sensors, times, noise and references."""

    def columns(problem: Problem) -> Iterator[Array]:
        events = problem.events
        yield problem.record.time
        yield events.codes
        yield from events.series_time
        yield from events.series_sigma
        yield np.empty((0, 6)) if events.noise_by_axis is None else events.noise_by_axis
        for series, value in zip(problem.record.vectors, events.series_vector_b, strict=True):
            yield value if series.kind == "attitude" else series.reference_f

    pairs = zip_longest(columns(one), columns(other))
    return all(a is b or np.array_equal(a, b) for a, b in pairs)


def _common(problem: Problem) -> lane_states.Events:
    """Return the data that the measurements of such records have in common."""
    record, events, model = problem.record, problem.events, problem.model
    columns = (
        events.time,
        events.row.astype(np.int64),
        events.sensor.astype(np.int64),
        events.kind.astype(np.int64),
        events.triads[events.reference],  # not used for an attitude
        events.body_noise,
        lengths(record, events, model, unit_sigmas(record, model, problem.initial.unit_sigma)),
    )
    return lane_states.Events(*(read_only(column) for column in columns))


def _in_lanes(columns: Sequence[Array]) -> Array:
    """Return a column of each record as the lanes of one array (..., WIDTH); the last record fills the remaining lanes."""
    (lanes,) = side_by_side(((*columns[0].shape, WIDTH), float))
    for lane in range(WIDTH):
        lanes[..., lane] = columns[min(lane, len(columns) - 1)]
    return lanes


def _values(problem: Problem) -> Array:
    """Return the measured values in order of time (events, 4): vectors, or attitudes."""
    events = problem.events
    values = np.zeros((len(events.time), 4))
    values[:, :3] = events.vector_b
    attitudes = events.kind == measurement.ATTITUDE
    values[attitudes] = events.triads[events.reference[attitudes], :4]
    return values


def _filtered(problems: Sequence[Problem], every: int) -> list[Estimate | None]:
    """Filter up to eight such records; None for one whose covariance lost its digits."""
    first = problems[0]
    events, model, edges = first.events, first.model, read_only(first.record.time)
    n, order, runs = 6 + model.states, first.model.whole_order, len(problems)
    measurements, rows = len(events.time), (len(edges) - 1) // every + 1
    work = lane_states.Work(
        *side_by_side(
            ((4, WIDTH), float),
            ((n - 3, WIDTH), float),
            ((2, n, n, WIDTH), float),
            ((n, 3, WIDTH), float),
            ((n, 3, WIDTH), float),
            ((3, n, WIDTH), float),
            ((6, n, WIDTH), float),
            ((2, n), float),
            ((n - 5, 4, 12), float),
            ((WIDTH,), float),
            ((2 * n + 22, WIDTH), float),
        )
    )
    initials = [problem.initial for problem in problems]
    work.attitude[:] = _in_lanes([one.attitude for one in initials])
    work.x[:] = _in_lanes([np.concatenate([one.bias, one.values[model.order]]) for one in initials])
    work.P[0] = _in_lanes([one.covariance[np.ix_(order, order)] for one in initials])
    work.table[-1], work.lost[:] = 0.0, 0.0
    levers = [turns(problem) for problem in problems]
    taken = lane_states.Runs(
        increments=_in_lanes([problem.record.increments for problem in problems]),
        value=_in_lanes([_values(problem) for problem in problems]),
        turning=_in_lanes(levers),
    )
    out = lane_states.Outputs(kept=np.empty((runs, rows, 2 * n + 22)), innovation=np.empty((runs, measurements, 6)))
    compiled(lane_states.advance, lane_states)(
        PATTERN, edges, every, model_arrays(model, first.variances), _common(first), taken, work, out
    )
    estimates = [
        _estimate(problem, every, kept, innovation)
        for problem, kept, innovation in zip(problems, out.kept, out.innovation, strict=True)
    ]
    return [None if lost else one for one, lost in zip(estimates, work.lost, strict=False)]


def _estimate(problem: Problem, every: int, kept: Array, innovation: Array) -> Estimate:
    """Return the estimate of one record from the outputs of the kernel."""
    model, n = problem.model, 6 + problem.model.states
    attitude, x, variance, upper = np.split(kept, (4, n + 1, 2 * n + 1), axis=1)
    covariance = np.empty((len(kept), 6, 6))
    a, b = np.triu_indices(6)
    covariance[:, a, b] = covariance[:, b, a] = upper
    innovations = innovations_by_sensor(problem.events, innovation)
    estimate = factor_estimate(problem, every, attitude, x, variance, None)
    return replace(
        estimate,
        innovations=innovations,
        skipped=skipped_too(problem.events, innovations),
        events=tuple(gaps(problem.record)),
        bias=whole_bias(model, x),
        variance=np.diagonal(covariance, axis1=1, axis2=2).copy(),
        covariance=covariance,
    )
