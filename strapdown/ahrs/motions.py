"""What moves a unit, from its recording: whether acceleration lasts.

The likelihood of the filter's innovations does not show it. At the filter's steps a smooth movement of the hand is predicted best by the
acceleration of a vehicle, with which the heading and the tilt are lost; so what matters is compared, means over seconds.
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
"""Word for the likelier of a hand and a vehicle."""
SPAN = 4.0
"""Spans whose mean accelerations are compared, s: independent for a hand."""
MIN_ACCELERATION = 0.5
"""RMS acceleration, m/s², of the models of a unit that hardly moves."""


def chosen(recording: Recording | Begun, motion: str = AUTO, *, name: str = "motion") -> tuple[str, float]:
    """Return the motion named, or the likelier one, and its log-likelihood beyond that of the other; infinite of the one named.

    ``name`` is what the caller calls it.
    """
    if one_of(name, motion, (AUTO, *MOTIONS)) != AUTO:
        return motion, math.inf
    found = likelihoods(recording)
    best = max(found, key=lambda one: found[one])
    return best, found[best] - min(found.values())


def likelihoods(recording: Recording | Begun) -> dict[str, float]:
    """Return the log-likelihoods of motion by a hand and by a vehicle: of the changes of mean specific force from span to span.

    In the frame that the gyro keeps, gravity changes with the error of the gyro alone: of its bias, of its scale, and where it was clipped.
    What else changes is mean acceleration. That of a hand with a velocity of σ_v is of the order of σ_v over the span, that of a vehicle
    hardly less than the acceleration itself.

    Parameters
    ----------
    recording : Recording or Begun
        With an accelerometer.

    Returns
    -------
    dict of str to float
        By names of :data:`strapdown.ahrs.MOTIONS`.

    Examples
    --------
    >>> found = likelihoods(recording)  # doctest: +SKIP
    >>> max(found, key=found.get)  # doctest: +SKIP
    'hand'
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
