"""Hard iron of a unit, estimated from its recording.

In the frame fixed by the integrated gyro, the field of the surroundings changes little over a second, while that of iron in the unit
rotates with it. With R the attitude by the gyro and b the iron, the measured field changes by ``(R − R') b`` from one time to another,
which is linear in b. A field that varies along the path of the unit causes an apparent iron too, by which the estimate is reduced.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from strapdown.checks import Array
from strapdown.kernels import headings, recording_steps
from strapdown.kernels.machine import compiled, read_only

SPAN = 1.0
"""Time difference over which the change of the field is computed, s."""
MEMORY = 60.0
"""Time constant of the exponential forgetting of earlier changes, s."""
CHANGE_NOISE = 8e-3
"""Noise density of the change of the field without iron, each component, relative to its magnitude, 1/√Hz."""
LEFT_NOISE = 0.035
"""The same for iron that is weak, which is left to the filter's states: they learn it from headings of more noise and for a shorter time.
Chosen in simulated swings of 0.1 to 1 rad/s, where iron of the prior σ then has the error of the heading that its σ says."""
SIGMA = 0.04
"""Prior σ of the iron, each component, relative to the magnitude of the field."""
NEGLIGIBLE = 1e-3
"""Minimum iron that is not set to zero, relative to the magnitude of the field."""
RISE = 3.0
"""Time constant of the low-pass filter of the iron found up to each time, s: shorter changes are disturbances of the surroundings."""
FEIGNED = 0.028
"""Apparent iron of a field that varies along the path, relative to its magnitude: estimates are multiplied by 1 − (apparent/estimate)²."""


def find(
    field: Array,
    up: Array,
    frame: Array,
    known: np.ndarray,
    time: Array,
    interval: float,
    strength: float,
    sigma: float,
) -> tuple[Array, Array]:
    """Return the hard iron at each row (k, 3), in the unit of the field and body axes, from the rows before and after it.

    Also returns the variance of the iron, relative to the squared magnitude, in the horizontal direction across the field (k,), from that
    of a unit that has not rotated: ``sigma`` squared.

    ``field`` and the vertical ``up`` (k, 3) are in the frame fixed by the integrated gyro, ``frame`` (k, 4) is the attitude by the gyro,
    ``known`` (k,) the rows with a field, ``time`` (k,), s, has intervals of ``interval`` s in the mean. Online, the iron is part of
    :func:`strapdown.kernels.headings.heading_steps`.
    """
    others = dict.fromkeys(headings.Constants._fields, 0.0) | {"every": 1, "iron_prior": sigma * sigma}
    constants, k = headings.Constants(**others | parts(interval)), len(time)
    rows = tuple(read_only(column) for column in (field, up, frame, known, time))
    iron, unshown = np.empty((k, 3)), np.empty(k)
    compiled(headings.iron_of_all)(constants, rows, strength, np.empty((k, 9)), iron, unshown)
    return iron, unshown


def parts(interval: float) -> dict[str, Any]:
    """Return what the kernel needs to know of the iron, for steps of an interval, s."""
    share = -float(np.expm1(-interval / MEMORY))
    return {
        "iron_share": share,
        "iron_interval": interval / share,
        "rise_share": -float(np.expm1(-interval / RISE)),
        "lag": max(1, round(SPAN / interval)),
        "step": interval,
        "span": SPAN,
        "ridge": (CHANGE_NOISE / SIGMA) ** 2,
        "left_ridge": (LEFT_NOISE / SIGMA) ** 2,
        "feigned": FEIGNED,
        "negligible": NEGLIGIBLE,
    }


def memory(lag: int, capacity: int) -> headings.Memory:
    """Return the memory of the kernel at the start, with room for this number of values of each running median."""
    return headings.Memory(
        drift=np.array([1.0, 0.0, 0.0, 0.0]),
        counted=np.zeros(3, np.int64),
        start=np.zeros(2),
        strength=np.zeros(1),
        held=np.zeros((2, 3)),
        vertical=np.zeros((2, 3)),
        mean=np.zeros((3, 3)),
        deviation=np.zeros(3),
        ordered=np.zeros((6, capacity)),
        stride=np.zeros((6, 2), np.int64),
        median=np.zeros(6),
        ring=np.zeros((lag, 8)),
        ring_time=np.zeros(lag),
        sums=np.zeros(9),
        iron=np.zeros(3),
        total=np.zeros(4),
    )


def low_pass(rows: np.ndarray, step: float) -> Array:
    """Return rows (k, m) after a causal first-order low-pass filter that starts at the first; ``step``: interval over time constant."""
    result = np.empty(rows.shape)
    compiled(recording_steps.low_pass)(np.ascontiguousarray(rows), -np.expm1(-step), result)
    return result
