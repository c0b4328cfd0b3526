"""Kind of motion of a recorded unit, by a hand or by a vehicle: whether its acceleration lasts.

The likelihood of the filter's innovations does not distinguish them. Over a filter step a smooth movement of the hand is predicted best by
the acceleration model of a vehicle, with which tilt and heading drift. Therefore means of the acceleration over seconds are compared.
"""

from __future__ import annotations

import math

import numpy as np

from strapdown import coning
from strapdown.ahrs import preparing
from strapdown.ahrs.parameters import HAND_HELD, MOTIONS, AhrsParameters
from strapdown.ahrs.starting import Begun, begin, resting_bias
from strapdown.checks import lengths, one_of
from strapdown.recordings import Recording, increments
from strapdown.units import STANDARD_GRAVITY

AUTO = "auto"
"""Selects the maximum-likelihood kind of motion, hand or vehicle."""
SPAN = 4.0
"""Duration of the spans whose mean accelerations are compared, s; those of a hand are independent."""
MIN_ACCELERATION = 0.5
"""Minimum RMS acceleration of the models, m/s², for a unit that hardly moves."""


def chosen(recording: Recording | Begun, motion: str = AUTO, *, name: str = "motion") -> tuple[str, float]:
    """Return the motion named, or for "auto" the maximum-likelihood one, and its log-likelihood less that of the other (∞ if named).

    ``name`` is the name of the argument in error messages.
    """
    if one_of(name, motion, (AUTO, *MOTIONS)) != AUTO:
        return motion, math.inf
    found = likelihoods(recording)
    best = max(found, key=lambda one: found[one])
    return best, found[best] - min(found.values())


def likelihoods(recording: Recording | Begun) -> dict[str, float]:
    """Return the log-likelihoods of motion by a hand and by a vehicle, from the changes of mean specific force between adjacent spans.

    In the frame fixed by the integrated gyro, gravity changes only by the gyro's errors: bias, scale factor, clipping. Any other change is
    one of mean acceleration. For a hand with velocity σ_v it is of the order of σ_v over the span, for a vehicle hardly less than the
    acceleration itself.
    """
    _, quiet, faults = begin(recording)
    used, force = faults.recording, faults.recording.specific_force
    assert force is not None
    bias, bias_sigma = resting_bias(used, quiet, HAND_HELD)
    turns = increments(used) - bias * np.diff(used.time)[:, None]
    turned = coning.integrate(turns)
    steps, number = preparing.averages(force, turned, preparing.edges(used.time, HAND_HELD.step))
    acceleration = max(preparing.liveliest(steps, number > 0.0, HAND_HELD.step), MIN_ACCELERATION)
    edge = preparing.edges(used.time, SPAN)
    mean, number = preparing.averages(force, turned, edge)
    both = (number[1:] > 0.0) & (number[:-1] > 0.0)
    square = np.sum(np.diff(mean, axis=0) ** 2, axis=1)[both]
    angle = np.add.reduceat(lengths(turns), edge[:-1]) * HAND_HELD.gyro_scale_sigma
    drift = angle**2 + np.add.reduceat(faults.turn_variance, edge[:-1]) + bias_sigma**2 * SPAN**2
    own = STANDARD_GRAVITY**2 * (drift[1:] + drift[:-1])[both]
    found = {}
    for name in ("hand", "vehicle"):
        variance = own + _change(MOTIONS[name].matched(acceleration))
        found[name] = -0.5 * float(np.sum(square / variance + 3.0 * np.log(variance)))
    return found


def _change(parameters: AhrsParameters) -> float:
    """Return the variance of the change of mean acceleration between adjacent spans, each component, m²/s⁴."""
    slow, fast = parameters.velocity_time, parameters.acceleration_time

    def correlation(t: float) -> float:
        return (slow * math.exp(-t / slow) - fast * math.exp(-t / fast)) / (slow - fast)

    return (parameters.velocity_sigma / SPAN) ** 2 * (6.0 - 8.0 * correlation(SPAN) + 2.0 * correlation(2.0 * SPAN))
