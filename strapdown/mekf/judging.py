"""A gate's judging outside the kernels: what they take of its options and memory, and the step faces' own.

The rules are those of :mod:`strapdown.kernels.robust_gate`, for filters with and without optional states.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, Generic, Protocol, Self, TypeVar, overload

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array
from strapdown.kernels import robust_gate, robust_step
from strapdown.kernels.gate import Options
from strapdown.records import Event
from strapdown.estimation.gating import LOCK_OUT, Gate, GateMemory, Monitor, Robust, seen_from


def gate_options(gate: Gate | None, robust: Robust | None) -> Options:
    """Return a gate and a robust update as the kernels take them."""
    return Options(
        thresholds=np.full(3, np.inf) if gate is None else gate.thresholds,
        robust=0 if robust is None else {"huber": robust_step.HUBER, "student": robust_step.STUDENT}[robust.kind],
        parameters=np.ones((3, 2)) if robust is None else robust.parameters,
        iterations=0 if robust is None else robust.iterations,
        recovery=0 if gate is None else gate.recovery or 0,
        lock_out=LOCK_OUT if gate is None else gate.lock_out_limit,
        attitude_sigma=0.0 if gate is None else gate.restart_attitude_sigma,
    )


def kernel_options(gate: Gate | None, robust: Robust | None) -> tuple[object, ...]:
    """Return a gate and a robust update as the kernels take them, up to the width of a restart."""
    return (
        np.full(3, np.inf) if gate is None else gate.thresholds,
        0 if robust is None else {"huber": robust_step.HUBER, "student": robust_step.STUDENT}[robust.kind],
        np.ones((3, 2)) if robust is None else robust.parameters,
        0 if robust is None else robust.iterations,
        0 if gate is None else gate.recovery or 0,
        LOCK_OUT if gate is None else gate.lock_out_limit,
        0.0 if gate is None else gate.restart_attitude_sigma,
    )


def remembered(gate: Gate | None, memory: GateMemory | None, sensors: tuple[str, ...]) -> tuple[Array, Array]:
    """Return what a kernel goes on with: its ``memory``, and ``standing`` of these sensors."""
    counts, standing = np.zeros(robust_gate.MEMORY), np.zeros((len(sensors), robust_gate.STANDING))
    counts[robust_gate.PASSES] = 1.0
    if gate is not None and memory is not None:
        counts[:] = memory.counts
        for row, sensor in zip(standing, sensors, strict=True):
            row[:] = memory.standing.get(sensor, 0.0)
    if gate is None or not gate.recovery:
        counts[robust_gate.CHALLENGED] = 0.0
    standing[:, robust_gate.TOLD] = -1.0
    return counts, standing


def event_rows(events: int, sensors: int) -> tuple[Array, Array]:
    """Return room for what a kernel tells of recoveries and of lock-outs, of so many measurements of so many sensors.

    Either takes two refusals, but for the first recovery, whose others may be of the part before, and a lock-out that goes on.
    """
    return np.empty((events // 2 + 1, 4)), np.empty((events // 2 + sensors, 4))


def gate_events(recoveries: Array, lock_outs: Array, sensors: tuple[str, ...]) -> list[Event]:
    """Return what a kernel tells of recoveries (n, 4) and of lock-outs (m, 4) as events."""
    rows = [("recovery", row[[2, 0, 1, 3]]) for row in recoveries]
    rows += [("lock-out", row) for row in lock_outs if row[3] > 0.0]
    return [
        Event(kind=kind, start=float(start), end=float(end), sensor=sensors[int(sensor)], value=float(value))
        for kind, (start, end, sensor, value) in rows
    ]


class Judged(Protocol):
    """A filter step by step, as it is judged."""

    time: float
    bias: Array
    P: Array
    nis: float
    """That of the last measurement."""
    dim_z: int
    """The degrees of freedom of it."""
    _passes: int
    """Linearisations of an update."""

    def _restarted(self, attitude_sigma: float, bias_width: float) -> Self:
        """Return a challenger: with this σ of the attitude, rad, and so many times what the gate adds to that of the bias."""

    def _move(self, correction: Array) -> None:
        """Correct attitude, bias and what other states there are."""

    def _become(self, other: Self) -> None:
        """Take over another's state."""


class ToldEvents:
    """``events`` of a filter step by step: recoveries and lock-outs so far, in order of time.

    No property, for of each of these filterpy's ``Saver`` makes an array, which a tuple that grows is not.
    """

    @overload
    def __get__(self, filter: None, owner: type) -> Self: ...

    @overload
    def __get__(self, filter: object, owner: type) -> tuple[Event, ...]: ...

    def __get__(self, filter: Any, owner: type) -> Self | tuple[Event, ...]:
        """Return those of a filter."""
        return self if filter is None else filter._judging.events  # type: ignore[no-any-return]


Filter = TypeVar("Filter", bound=Judged)


class Judging(Generic[Filter]):
    """A gate and a monitor beside a filter that goes step by step: what they remember, the challenger, and what they have told."""

    def __init__(self, gate: Gate | None, memory: GateMemory | None, monitor: Monitor | None = None) -> None:
        self.gate = gate
        self.monitor = monitor
        # Time, NIS and degrees of freedom of what was measured. Copies share the rows, of which each knows how many are its own: the
        # filter goes back to what it was, and never forth again.
        self.seen: list[tuple[float, float, int]] = []
        self.number = 0
        self.sensors: tuple[str, ...] = () if memory is None else tuple(memory.standing)
        self.memory, self.standing = remembered(gate, memory, self.sensors)
        self.challenger: Filter | None = None
        self.recoveries, self.lock_outs = np.empty((0, 4)), np.empty((0, 4))

    @property
    def challenged(self) -> bool:
        """Whether there is a challenger; of one that the memory tells of the filter has to make :attr:`challenger`."""
        return bool(self.memory[robust_gate.CHALLENGED])

    @property
    def passes(self) -> int:
        """Linearisations of an update of the filter."""
        return int(self.memory[robust_gate.PASSES])

    @property
    def events(self) -> tuple[Event, ...]:
        """Recoveries, lock-outs and what the monitor says so far, in order of time."""
        told = gate_events(self.recoveries, self.lock_outs, self.sensors)
        if self.monitor is not None and self.number:
            time, nis, degrees = (np.array(column) for column in zip(*self.seen[: self.number], strict=True))
            told += self.monitor.watch(time, nis, degrees)
        return tuple(sorted(told, key=lambda event: event.start))

    def judge(self, filter: Filter, sensor: str, outcome: int, follow: Callable[[Filter], int]) -> None:
        """Judge the filter by what it has made of a measurement, and its challenger, which ``follow`` gives the same one, too."""
        if self.monitor is not None and outcome != robust_step.PASSED_OVER:
            self._watch(filter, outcome)
        if self.gate is None:
            return
        if sensor not in self.sensors:
            self.sensors = (*self.sensors, sensor)
            self.standing = np.vstack([self.standing, remembered(None, None, (sensor,))[1]])
        s, recovery, limit = self.sensors.index(sensor), self.gate.recovery or 0, self.gate.lock_out_limit
        memory, standing, room = self.memory, self.standing, np.vstack([self.lock_outs, np.empty((1, 4))])
        told, challenge = robust_gate.judge_filter(
            outcome, filter.time, s, recovery, limit, standing, memory, room, len(self.lock_outs)
        )
        self.lock_outs = room[:told]
        if challenge:
            sigma = robust_gate.restart_attitude(self.gate.restart_attitude_sigma, memory)
            self.challenger = filter._restarted(sigma, robust_gate.restart_width(memory))
            variance = np.diag(self.challenger.P)[3:6]
            robust_gate.begin_challenge(memory, filter.time, self.challenger.bias, variance)
        rival = self.challenger
        if rival is None:
            return
        outcome = follow(rival)
        verdict = robust_gate.judge_challenger(outcome, rival.nis, rival.dim_z, s, standing, memory, rival.bias)
        if verdict == robust_gate.DROPPED:
            self.challenger = None
            return
        if verdict == robust_gate.TOO_NARROW:
            self._widen(rival)
        if robust_gate.is_believed(s, recovery, standing, memory):
            row = np.empty(4)
            robust_gate.recover(filter.time, s, limit, standing, memory, row, self.lock_outs)
            self.recoveries = np.vstack([self.recoveries, row])
            filter._become(rival)
            filter._passes = self.passes
            self.challenger = None

    def _watch(self, filter: Filter, outcome: int) -> None:
        """Note the NIS of what was just measured; of what was not taken in the gate's threshold."""
        degrees, nis = filter.dim_z, filter.nis
        if self.gate is not None and outcome != robust_step.ACCEPTED:
            nis = float(self.gate.thresholds[degrees - 1])
        del self.seen[self.number :]
        self.seen.append((filter.time, nis, degrees))
        self.number += 1

    def _widen(self, rival: Filter) -> None:
        """Make the challenger what it would be had its bias started wider, if that holds it back; all states go along."""
        P = rival.P.copy()
        if not robust_gate.may_widen(np.diag(P)[3:6], self.memory):
            return
        correction = np.zeros(len(P))
        for i in range(3):
            gain = robust_gate.start_undone(i, P[3 + i, 3 + i], self.memory) * P[:, 3 + i]
            moved = rival.bias[i] + correction[3 + i]
            correction += gain * (self.memory[robust_gate.FIRST_BIAS + i] - moved)
            P -= np.outer(gain, P[3 + i])
        rival._move(correction)
        rival.P, _ = seen_from(quaternion.exp(correction[:3]), P)
        robust_gate.count_widening(self.memory)

    def copied(self) -> Self:
        """Return it as it is now."""
        other = copy.copy(self)
        other.memory, other.standing, other.lock_outs = self.memory.copy(), self.standing.copy(), self.lock_outs.copy()
        other.challenger = copy.deepcopy(self.challenger)
        return other
