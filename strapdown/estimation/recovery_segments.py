"""Smoothing across recoveries of a gate: segments, each with its own measurements, and the edges that each of them covers.

At a recovery a restart candidate, which does not depend on the measurements that the filter processed before, replaces the filter's state.
So the states before and after are two segments, and no information passes from one to the other. The first ends with the first of the
refusals that led to the recovery; its states after that are wrong. The second begins where the candidate started, before it replaced the
filter: from the candidate's start the filter is run again up to the recovery, so that the smoother has the candidate's states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.estimation.forward import Options, Problem, filtered, most_segments
from strapdown.estimation.gating import Gate
from strapdown.estimation.states import GateMemory
from strapdown.kernels.gate_rules import CANDIDATE, FIRST_BIAS, PASSES, SINCE, WIDE_PASSES, restart_attitude
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.smoother_loop import locate_edges
from strapdown.records import Estimate, Event, ImuRecord

MAX_CUT = 64
"""Maximum ratio of the number of sub-steps to that expected from the increments; above it the filter has diverged."""


def filtered_whole(problem: Problem, options: Options) -> tuple[Estimate, Array]:
    """Return the filter's estimate of a record and all its predictions (:attr:`strapdown.estimation.forward.Passed.segments`)."""
    usual = most = most_segments(problem)
    while True:
        # One row more than expected shows whether more were needed.
        passed = filtered(problem, replace(options, segments=most + 1, full_covariance=False))
        if len(passed.segments) - 1 <= most:
            return passed.estimate, passed.segments
        # The number of sub-steps depends on the rotation without the bias, which is known only during the run.
        most *= 4
        if most > MAX_CUT * usual:
            raise InputError(
                "the filter diverged: with its estimate of the bias the body makes many rotations in each gyro interval; "
                "check the record and the initial state with estimation.run first"
            )


@dataclass(frozen=True, kw_only=True)
class Break:
    """A recovery for a smoother; times in s."""

    start: float
    """First refusal: end of the trajectory before."""
    since: float
    """Start of the trajectory after."""
    end: float
    """Recovery."""


def recoveries(events: Sequence[Event]) -> list[Event]:
    """Return the recoveries among events, in order of time."""
    return sorted((event for event in events if event.kind == "recovery"), key=lambda event: event.end)


def part(record: ImuRecord, begin: float, end: float) -> ImuRecord:
    """Return the record between two times, with the measurements from ``begin`` on and before ``end``.

    Measurements outside are marked missing rather than removed, so that counts of the whole series stay.
    """
    inside = (record.time > begin) & (record.time < end)
    time = np.concatenate([[begin], record.time[inside], [end]])
    k = np.searchsorted(record.time, time[1:], side="left") - 1
    share = np.diff(time) / record.intervals[k]
    vectors = []
    for series in record.vectors:
        kept = (series.time >= begin) & (series.time < end)
        if series.attitude is None:
            vectors.append(replace(series, vector_b=np.where(kept[:, None], series.vector_b, np.nan)))
        else:
            vectors.append(replace(series, attitude=np.where(kept[:, None], series.attitude, np.nan)))
    return ImuRecord(time=time, increments=share[:, None] * record.increments[k], vectors=tuple(vectors))


def break_of(event: Event, memory: GateMemory | None, begin: float) -> Break:
    """Return a recovery as a break, not earlier than ``begin`` of the record.

    ``memory`` is the gate's state just before; None if the candidate that took over is unknown.
    """
    since = event.end
    if memory is not None and memory.counts[CANDIDATE]:
        since = min(since, max(begin, float(memory.counts[SINCE])))
    return Break(start=max(begin, event.start), since=since, end=event.end)


def restarted(gate: Gate, memory: GateMemory) -> tuple[Array, Array, Array]:
    """Return bias (3,) and variances of attitude and bias (6,) at a restart candidate's start, with its increased σ; and its counts."""
    sigma = restart_attitude(gate.restart_attitude_sigma, memory.counts)
    bias, variance = memory.counts[FIRST_BIAS : FIRST_BIAS + 3], memory.counts[FIRST_BIAS + 3 : FIRST_BIAS + 6]
    counts = memory.counts.copy()
    counts[PASSES] = WIDE_PASSES
    return bias.copy(), np.concatenate([np.full(3, sigma**2), variance]), counts


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Segments for a backward pass, and the rows that it writes."""

    segments: np.ndarray
    """Rows as stored by the filter, from that of the first stop on."""
    starts: np.ndarray
    """Index of the row that starts at each stop, −1 if there is none."""
    edge: np.ndarray
    """Stops to write, in order."""
    last: int
    """Stop at which the backward pass starts; later states are the filter's."""
    row: np.ndarray
    """Edge of the record for each of ``edge``."""


def stops(time: Array, breaks: Sequence[Break]) -> Array:
    """Return the edges (n,) and the times of breaks."""
    return np.unique(np.concatenate([time, *([gap.start, gap.since, gap.end] for gap in breaks)]))


def starts(time: Array, event_time: Array, segments: Array) -> np.ndarray:
    """Return the index of the segment that starts at each time; the last row of segments is the end state."""
    first = np.empty(len(time), np.int64)
    compiled(locate_edges)(read_only(time), event_time, segments, len(segments) - 1, first)
    return first


Rerun = tuple[Array, np.ndarray] | None
"""Segments of a trajectory from its ``since`` to its ``end``, and the index of the one that starts at each stop between; None: none."""


def trajectories(
    time: Array,
    breaks: Sequence[Break],
    first: np.ndarray,
    segments: np.ndarray,
    reruns: Sequence[Rerun],
) -> list[Trajectory]:
    """Return the trajectories of a record with these edges.

    ``segments`` are the filter's, ``first`` is the index of the one that starts at each stop, and ``reruns`` are those of each break.
    """
    stop = stops(time, breaks)
    place = np.searchsorted(stop, time)
    own = np.searchsorted([gap.since for gap in breaks], time, side="right")
    parts = []
    for k in range(len(breaks) + 1):
        mine = np.flatnonzero(own == k)
        begin = int(np.searchsorted(stop, breaks[k - 1].end)) if k > 0 else 0
        after = first[np.searchsorted(stop, breaks[k].end)] + 1 if k < len(breaks) else len(segments)
        rows, at = segments[first[begin] : after], first - first[begin]
        at[:begin] = -1
        ran = reruns[k - 1] if k > 0 else None
        if ran is not None:
            before, early = ran
            at[begin:] += len(before) - 1
            at[begin - len(early) + 1 : begin] = early[:-1]
            rows = np.concatenate([before[:-1], rows])
        last = int(np.searchsorted(stop, breaks[k].start)) if k < len(breaks) else len(stop) - 1
        parts.append(Trajectory(segments=rows, starts=at, edge=place[mine], last=last, row=mine))
    return parts
