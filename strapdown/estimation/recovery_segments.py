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
"""Times the segments that a record takes by its increments: a filter that takes more is lost."""


def filtered_whole(problem: Problem, options: Options) -> tuple[Estimate, Array]:
    """Return the filter's estimate of a record and all its predictions (:attr:`strapdown.estimation.forward.Passed.segments`)."""
    usual = most = most_segments(problem)
    while True:
        # One more than it should take, which shows whether it took more.
        passed = filtered(problem, replace(options, segments=most + 1, full_covariance=False))
        if len(passed.segments) - 1 <= most:
            return passed.estimate, passed.segments
        # Steps are cut by the turn without the bias, which is known only when they are taken.
        most *= 4
        if most > MAX_CUT * usual:
            raise InputError(
                "the filter lost its way: by the bias that it found the body turns many times round in each gyro interval; "
                "look at the record and the start with estimation.run first"
            )


@dataclass(frozen=True, kw_only=True)
class Break:
    """A recovery as a smoother takes it; times in s."""

    start: float
    """First refusal: where the trajectory before it ends."""
    since: float
    """Where the trajectory after it begins."""
    end: float
    """Recovery."""


def recoveries(events: Sequence[Event]) -> list[Event]:
    """Return the recoveries among events, in order of time."""
    return sorted((event for event in events if event.kind == "recovery"), key=lambda event: event.end)


def part(record: ImuRecord, begin: float, end: float) -> ImuRecord:
    """Return the record between two times, with the measurements from ``begin`` on and before ``end``.

    The others are marked missing rather than removed, so that counts of the whole series stay.
    """
    inside = (record.time > begin) & (record.time < end)
    time = np.concatenate([[begin], record.time[inside], [end]])
    k = np.searchsorted(record.time, time[1:], side="left") - 1
    share = np.diff(time) / np.diff(record.time)[k]
    vectors = []
    for series in record.vectors:
        kept = (series.time >= begin) & (series.time < end)
        if series.attitude is None:
            vectors.append(replace(series, vector_b=np.where(kept[:, None], series.vector_b, np.nan)))
        else:
            vectors.append(replace(series, attitude=np.where(kept[:, None], series.attitude, np.nan)))
    return ImuRecord(time=time, increments=share[:, None] * record.increments[k], vectors=tuple(vectors))


def break_of(event: Event, memory: GateMemory | None, begin: float) -> Break:
    """Return a recovery as a break, not before the record's ``begin``.

    ``memory`` is what the gate remembers just before, None where nobody knows what took over.
    """
    since = event.end
    if memory is not None and memory.counts[CANDIDATE]:
        since = min(since, max(begin, float(memory.counts[SINCE])))
    return Break(start=max(begin, event.start), since=since, end=event.end)


def restarted(gate: Gate, memory: GateMemory) -> tuple[Array, Array, Array]:
    """Return bias (3,) and variances of attitude and bias (6,) of a restart candidate's start, with its increased σ; and its counts."""
    sigma = restart_attitude(gate.restart_attitude_sigma, memory.counts)
    bias, variance = memory.counts[FIRST_BIAS : FIRST_BIAS + 3], memory.counts[FIRST_BIAS + 3 : FIRST_BIAS + 6]
    counts = memory.counts.copy()
    counts[PASSES] = WIDE_PASSES
    return bias.copy(), np.concatenate([np.full(3, sigma**2), variance]), counts


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Segments that a smoother goes back over, and what of them it writes."""

    segments: np.ndarray
    """Rows as the filter stores them, from that of the first stop on."""
    starts: np.ndarray
    """Number of the row that starts at each stop, −1 where there is none."""
    edge: np.ndarray
    """Stops to write, in order."""
    last: int
    """Stop from which a smoother goes back; what lies after it is the filter's own."""
    row: np.ndarray
    """Edge of the record of each."""


def stops(time: Array, breaks: Sequence[Break]) -> Array:
    """Return the edges (n,) and the times of breaks."""
    if not breaks:
        return time
    return np.unique(np.concatenate([time, *([one.start, one.since, one.end] for one in breaks)]))


def starts(time: Array, event_time: Array, segments: Array) -> np.ndarray:
    """Return the number of the segment that starts at each time; the last row of segments is the end state."""
    found = np.empty(len(time), np.int64)
    compiled(locate_edges)(read_only(time), event_time, segments, len(segments) - 1, found)
    return found


Rerun = tuple[Array, np.ndarray] | None
"""Segments of a trajectory from its ``since`` to its ``end``, and the number of that which starts at each stop between; None: none."""


def trajectories(
    time: Array,
    breaks: Sequence[Break],
    first: np.ndarray,
    segments: np.ndarray,
    reruns: Sequence[Rerun],
) -> list[Trajectory]:
    """Return the trajectories of a record with these edges.

    ``segments`` are the filter's, ``first`` says which of them starts at each stop, and ``reruns`` those of each break.
    """
    if not breaks:
        every = np.arange(len(time))
        return [Trajectory(segments=segments, starts=first, edge=every, last=len(time) - 1, row=every)]
    stop = stops(time, breaks)
    place = np.searchsorted(stop, time)
    own = np.searchsorted([one.since for one in breaks], time, side="right")
    found = []
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
        found.append(Trajectory(segments=rows, starts=at, edge=place[mine], last=last, row=mine))
    return found
