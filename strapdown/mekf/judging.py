"""Gate and robust update as the kernels take them, and the events that they report (:mod:`strapdown.kernels.robust_gate`)."""

from __future__ import annotations

import numpy as np

from strapdown.checks import Array
from strapdown.kernels import robust_gate, robust_step
from strapdown.records import Event
from strapdown.robustness import LOCK_OUT, Gate, GateMemory, Robust


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
