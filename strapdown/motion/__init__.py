"""Exact motions: attitude, rates and gyro increments to rounding accuracy, the truth for integration algorithms and simulations.

Every motion is a frozen dataclass that satisfies :class:`Motion`. None of them uses an integration algorithm under test, and no
increment is a difference of attitudes or of angles: each is the integral of the body rate over its interval, with a relative accuracy
of rounding, however short the interval and however far from the origin of time.

- ``protocol``: :class:`Motion`: the methods of a motion, and the declaration of its breaks.

Closed forms:

- ``constant_rate``: :class:`ConstantRate`, and :func:`rest`.
- ``cones``: :class:`Coning`, equation (18) of *Quaternion differentiation*, and :class:`SpinCone`.
- ``spin_rock``: :class:`SpinRock`: a spinning body whose axis rocks.
- ``slew``: :class:`Slew`: a rotation about one axis from rest to rest.
- ``torque_free``: :class:`TorqueFree`: the free rigid body, in elliptic functions.

From given rates, attitudes or motions:

- ``harmonic``: :class:`HarmonicRates` of :class:`Harmonic` terms: vibration on any axes.
- ``sampled``: :class:`SampledAttitude` and :func:`waypoints`: smooth motion through given attitudes.
- ``composed``: :class:`Composed`: a vibration on a base motion.

Shared parts: ``parameters`` checks and stores the parameters; ``exact_phase`` forms ω t as exact products, so that an hour of a 100
Hz motion is as accurate as its first second; ``quadrature`` integrates a rate without a closed-form integral.
"""

from strapdown.motion import orbit as orbit
from strapdown.motion.composed import Composed
from strapdown.motion.cones import Coning, SpinCone
from strapdown.motion.constant_rate import ConstantRate, rest
from strapdown.motion.harmonic import Harmonic, HarmonicRates
from strapdown.motion.protocol import Motion
from strapdown.motion.sampled import SampledAttitude, waypoints
from strapdown.motion.slew import Slew
from strapdown.motion.spin_rock import SpinRock
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
