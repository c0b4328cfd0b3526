"""Heading measurements from a magnetometer.

Iron in the unit and in the surroundings disturbs the heading, and the magnitude and the dip of the field too. The noise of the heading is
computed from their deviation, and is larger for a steeper field.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown import quaternion
from strapdown.ahrs.parameters import AhrsParameters
from strapdown.checks import Array, lengths
from strapdown.recordings import hard_iron
from strapdown.recordings.hard_iron import low_pass
from strapdown.vectors import VectorMeasurements

NORTH = np.array([0.0, 1.0, 0.0])
VERTICAL_TIME = 1.0
"""Time constant of the low-pass filter for the vertical from which the field's dip is measured, s."""


class FieldSteps(NamedTuple):
    """Samples averaged over the filter's steps, in the frame fixed by the integrated gyro."""

    field: Array
    """Field (k, 3)."""
    frame: Array
    """Attitude by the gyro in the middle of each step (k, 4)."""
    length: Array
    """Duration that the field's samples of each step cover, s; 0: none (k,)."""
    force: Array
    """Specific force (k, 3)."""
    at_edge: Array
    """Attitude by the gyro at the steps' edges (k + 1, 4)."""
    time: Array
    """Time there, s (k + 1,)."""
    start: int
    """Number of steps in the quiet second."""


def measured(steps: FieldSteps, parameters: AhrsParameters, *, causal: bool) -> tuple[VectorMeasurements, float, Array]:
    """Return the heading measurements, the dip at the start, and the hard iron subtracted (k, 3), body axes, in the unit of the field."""
    known = steps.length > 0.0
    first = known & (np.arange(len(known)) < steps.start)
    first = first if first.any() else known
    interval = float(np.median(np.diff(steps.time)))
    memory = interval / parameters.field_memory
    vertical = _vertical(steps.force, interval)
    level = _strength_and_dip(steps.field, vertical)
    reference = level[first].mean(axis=0)
    as_measured = _deviation(level, reference, known, memory)
    iron = hard_iron.find(steps.field, steps.frame, steps.time[1:], known, reference[0], causal=causal)
    field = steps.field
    if iron.any():
        # Iron may have been attached or removed: it is subtracted only where that does not increase the deviation of magnitude and dip.
        without = _deviation(
            _strength_and_dip(field - quaternion.rotate(steps.frame, iron), vertical), reference, known, memory
        )
        odds = np.clip((as_measured - without) / (2.0 * parameters.field_deviation**2), -50.0, 0.0)
        iron *= (2.0 / (1.0 + np.exp(-odds)))[:, None]
        iron[lengths(iron) < hard_iron.NEGLIGIBLE * reference[0]] = 0.0
        field = field - quaternion.rotate(steps.frame, iron)
        level = _strength_and_dip(field, vertical)
        reference = level[first].mean(axis=0)
    deviation = _deviation(level, reference, known, memory)
    dip = float(reference[1])
    noise = (parameters.field_disturbance / np.cos(dip)) ** 2 * (1.0 + deviation / parameters.field_deviation**2)
    direction = np.where(known[:, None], field / level[:, :1], 0.0)
    return _gathered(steps, direction, steps.length / noise, parameters.heading_interval), dip, iron


def _gathered(steps: FieldSteps, direction: Array, information: Array, heading_interval: float) -> VectorMeasurements:
    """Return heading measurements: directions (k, 3) averaged over the heading interval, weighted by their information (k,)."""
    time = steps.time
    edge = np.flatnonzero(np.diff(np.floor((time[1:] - time[0]) / heading_interval - 1e-6), append=np.inf))
    begin = np.append(0, edge[:-1] + 1)
    total = np.add.reduceat(direction * information[:, None], begin, axis=0)
    information = np.add.reduceat(information, begin)
    seen = information > 0.0
    total = total[seen] / lengths(total[seen])[:, None]
    return VectorMeasurements(
        sensor="magnetometer",
        kind="heading",
        time=time[1:][edge][seen],
        vector_b=quaternion.rotate(quaternion.conjugate(steps.at_edge[1:][edge][seen]), total),
        reference_f=NORTH,
        sigma=1.0 / np.sqrt(information[seen]),
    )


def _vertical(force: Array, interval: float) -> Array:
    """Return the vertical (k, 3) from specific force passed twice through a low-pass filter."""
    share = interval / VERTICAL_TIME
    vertical = low_pass(low_pass(_held(force, np.asarray(force.any(axis=1))), share), share)
    return np.asarray(vertical / lengths(vertical)[:, None])


def _strength_and_dip(field: Array, vertical: Array) -> Array:
    """Return the magnitude of a field, and its angle below the horizontal, rad (k, 2)."""
    strength = lengths(field)
    strength[strength == 0.0] = 1.0
    return np.column_stack(
        [strength, np.arcsin(np.clip(-np.einsum("ki,ki->k", field, vertical) / strength, -1.0, 1.0))]
    )


def _deviation(level: Array, reference: Array, known: np.ndarray, memory: float) -> Array:
    """Return the square deviation of magnitude (relative) and dip (rad) from the start, low-passed (k,); ``memory``: step/time constant."""
    square = (level[:, 0] / reference[0] - 1.0) ** 2 + (level[:, 1] - reference[1]) ** 2
    return low_pass(_held(square[:, None], known), memory)[:, 0]


def _held(values: Array, known: np.ndarray) -> Array:
    """Return rows (k, …) with each unknown row replaced by the last known one before it, or by the first known one."""
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.asarray(values[np.where(last < 0, int(np.argmax(known)), last)])
