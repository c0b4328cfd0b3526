"""The filter over several records at once, eight in the lanes of SIMD vectors: for the runs of a Monte Carlo.

A record's estimate is bit for bit independent of the other records, and agrees with that of :func:`strapdown.estimation.run` to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest

import numpy as np

from strapdown.checks import Array
from strapdown.estimation import forward, temperature
from strapdown.estimation.forward import Problem
from strapdown.estimation.schedule import innovations_by_sensor, skipped_too
from strapdown.kernels import filter, filter_lanes, machine, measurement
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.series import SQUARED_RANGE
from strapdown.kernels.walk import walk
from strapdown.records import Estimate


def supports(problem: Problem) -> bool:
    """Return whether a record can be filtered with others: its rotations are within the range of the polynomials without sub-steps."""
    small = 3.0 * problem.record.largest_increment**2 <= SQUARED_RANGE
    return small and temperature.slopes(problem.error_states) is None


def run(problems: Sequence[Problem], every: int, alone: Callable[[Problem], Estimate]) -> list[Estimate]:
    """Run one filter over several records, those with the same times eight at once.

    Parameters
    ----------
    problems : sequence of Problem
        Records, prepared for the same filter.
    every : int
        Store every ``every``-th edge, starting with the first.
    alone : callable
        Function that filters a record that :func:`supports` refuses, or that leaves the range of the polynomials.

    Returns
    -------
    list of Estimate
        Estimates as of a run with ``full_covariance`` and ``whole_bias``, without the covariance of the error states.
    """
    groups: list[list[int]] = []
    for i, problem in enumerate(problems):
        if supports(problem):
            group = next((group for group in groups if _alike(problems[group[0]], problem)), None)
            if group is None:
                groups.append([i])
            else:
                group.append(i)
    estimates: dict[int, Estimate | None] = {}
    for group in groups:
        for first in range(0, len(group), WIDTH):
            part = group[first : first + WIDTH]
            estimates.update(zip(part, _filtered([problems[i] for i in part], every), strict=True))
    return [estimates.get(i) or alone(problem) for i, problem in enumerate(problems)]


def _alike(a: Problem, b: Problem) -> bool:
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

    return all(p is q or np.array_equal(p, q) for p, q in zip_longest(columns(a), columns(b)))


def _in_lanes(columns: Sequence[Array]) -> Array:
    """Return a column of each record as the lanes of a flat array; the last record fills the remaining lanes."""
    lanes = [columns[min(lane, len(columns) - 1)] for lane in range(WIDTH)]
    return np.stack(lanes, axis=-1).reshape(-1)


def _values(problem: Problem) -> Array:
    """Return the measured values, one sensor after the other (events, 4): vectors, or attitudes."""
    events = problem.events
    values = np.zeros((len(events.time), 4))
    values[events.row, :3] = events.vector_b
    attitudes = events.kind == measurement.ATTITUDE
    values[events.row[attitudes]] = events.triads[events.reference[attitudes], :4]
    return values


def _filtered(problems: Sequence[Problem], every: int) -> list[Estimate | None]:
    """Filter up to eight such records; None for one that left the range of the polynomials."""
    first = problems[0]
    events, model, record = first.events, first.model, first.record
    kernels = machine.instance(filter, STRUCTURE=model.structure, LANES=WIDTH)
    n, rows, upper = kernels.N, (len(record.time) - 1) // every + 1, np.triu_indices(kernels.N)
    initials = [problem.initial for problem in problems]
    x, P = np.zeros((2, (n + 1) * WIDTH)), np.zeros((2, kernels.SIZE_OF_P))
    x[0] = _in_lanes([np.concatenate([state.attitude, state.bias, state.values]) for state in initials])
    P[0] = _in_lanes([state.covariance[upper] for state in initials])
    units = forward.unit_sigmas(record, model, first.initial.unit_sigma)
    filters = forward.filter_body(first, units)._replace(
        x=x,
        P=P,
        work=np.zeros(kernels.LINES * kernels.LINE * WIDTH),
        turning=_in_lanes([forward.turns(problem) for problem in problems]),
    )
    body = filter_lanes.Body(filters, np.zeros(WIDTH))
    noise = np.empty((len(events.time), 6))
    noise[events.row] = events.body_noise
    measured = events.measurements._replace(
        value=read_only(_in_lanes([_values(problem) for problem in problems])), noise=read_only(noise)
    )
    out = filter_lanes.Outputs(
        np.empty((rows, x.shape[1])), np.empty((rows, P.shape[1])), np.empty(len(events.time) * 6 * WIDTH)
    )
    increments = read_only(_in_lanes([problem.record.increments for problem in problems]).reshape(-1, 3 * WIDTH))
    compiled(walk, filter_lanes, kernels)(read_only(record.time), increments, measured, every, body, out)
    lanes = (values.reshape(len(values), -1, WIDTH) for values in (out.x, out.P))
    stored, covariances = (np.ascontiguousarray(np.moveaxis(values, -1, 0)) for values in lanes)
    innovations = np.moveaxis(out.innovation.reshape(-1, 6, WIDTH), -1, 0)
    return [
        None if lost else _estimate(problem, every, *arrays)
        for problem, lost, *arrays in zip(problems, body.lost, stored, covariances, innovations, strict=False)
    ]


def _estimate(problem: Problem, every: int, x: Array, triangle: Array, innovation: Array) -> Estimate:
    """Return the estimate of one record from the states and the upper triangles of the covariances at the stored edges."""
    model, n = problem.model, problem.model.structure.n
    P = np.empty((len(x), n, n))
    a, b = np.triu_indices(n)
    P[:, a, b] = P[:, b, a] = triangle
    whole = np.zeros((6, n))
    whole[:, :6], whole[3:, 6:] = np.eye(6), model.offsets.T
    covariance = whole @ P @ whole.T
    innovations = innovations_by_sensor(problem.events, np.ascontiguousarray(innovation))
    variance = np.diagonal(P, axis1=1, axis2=2).copy()
    return replace(
        forward.estimate_of(problem, every, x, variance, None),
        innovations=innovations,
        skipped=skipped_too(problem.events, innovations),
        events=tuple(forward.gaps(problem.record)),
        bias=forward.whole_bias(model, x),
        variance=np.diagonal(covariance, axis1=1, axis2=2).copy(),
        covariance=covariance,
    )
