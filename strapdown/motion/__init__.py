"""Exact motions: attitude, rates and gyro increments known to rounding, the truth that integration algorithms are measured against.

Every motion is a frozen dataclass that satisfies :class:`Motion`. Nothing here comes from an integration algorithm under test, and no
increment is a difference of attitudes or of angles: each is the integral of the body rate over its own interval, good to rounding
relative to its own size, however short the interval is and however far from the origin of time.

``protocol``
    :class:`Motion`: what a motion offers, and how one with kinks of its own declares them.

Closed forms:

``constant_rate``
    :class:`ConstantRate`, and :func:`rest`.
``cones``
    :class:`Coning`, equation (18), and :class:`SpinCone`.
``spin_rock``
    :class:`SpinRock`: a spinning body whose axis rocks.
``slew``
    :class:`Slew`: a turn about one axis from rest to rest.
``torque_free``
    :class:`TorqueFree`: the free rigid body, solved in ``euler_poinsot`` by the functions of ``elliptic``.

From given rates, given attitudes, given motions:

``harmonic``
    :class:`HarmonicRates` of :class:`Harmonic` terms: vibration on any axes.
``sampled``
    :class:`SampledAttitude` and :func:`waypoints`: smooth motion through given attitudes.
``composed``
    :class:`Composed`: a vibration on a base motion.

What they share: ``parameters`` checks and keeps what they are made of; ``exact_phase`` forms ω t as exact products, so that an hour of a
100 Hz motion is as good as its first second; ``quadrature`` integrates a rate that has no closed integral.
"""

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
