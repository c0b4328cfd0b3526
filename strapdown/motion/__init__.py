"""Exact motions: attitude, rates and gyro increments to rounding accuracy, the truth for integration algorithms and simulations.

Every motion is a frozen dataclass that satisfies :class:`Motion`. None of them uses an integration algorithm under test, and no
increment is a difference of attitudes or of angles: each is the integral of the body rate over its interval, with a relative accuracy
of rounding, however short the interval and however far from the origin of time.

- ``protocol``: :class:`Motion`: the methods of a motion, and the declaration of its breaks.
- ``closed_forms``: :class:`ConstantRate` and :func:`rest`; :class:`Coning`, equation (18) of *Quaternion differentiation*, and
  :class:`SpinCone`; :class:`SpinRock`, a spinning body whose axis rocks; :class:`Slew`, a rotation from rest to rest.
- ``torque_free``: :class:`TorqueFree`: the free rigid body, in elliptic functions.
- ``harmonic``: :class:`HarmonicRates` of :class:`Harmonic` terms: vibration on any axes.
- ``sampled``: :class:`SampledAttitude` and :func:`waypoints`: smooth motion through given attitudes.
- ``composed``: :class:`Composed`: a vibration on a base motion.

Shared parts: ``exact_phase`` forms ω t as exact products, so that an hour of a 100 Hz motion is as accurate as its first second;
``quadrature`` integrates a rate without a closed-form integral.
"""

from strapdown.motion import orbit as orbit
from strapdown.motion.closed_forms import Coning, ConstantRate, Slew, SpinCone, SpinRock, rest
from strapdown.motion.composed import Composed
from strapdown.motion.harmonic import Harmonic, HarmonicRates
from strapdown.motion.protocol import Motion
from strapdown.motion.sampled import SampledAttitude, waypoints
from strapdown.motion.torque_free import TorqueFree

__all__ = [
    "Composed",
    "Coning",
    "ConstantRate",
    "Harmonic",
    "HarmonicRates",
    "Motion",
    "SampledAttitude",
    "Slew",
    "SpinCone",
    "SpinRock",
    "TorqueFree",
    "rest",
    "waypoints",
]
