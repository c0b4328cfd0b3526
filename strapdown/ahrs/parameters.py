"""The filter's model of a unit and of its motion."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from strapdown import estimation
from strapdown.checks import InputError, non_negative, one_of, positive
from strapdown.estimation.error_states import ErrorStates
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.units import DEGREE


@dataclass(frozen=True, kw_only=True)
class AhrsParameters:
    """The filter's model of a unit and of its motion. The defaults hold for consumer and industrial MEMS units under any motion.

    Noises of the vectors are densities: σ of a mean over one second, whatever the recording's rate. They are much larger than the sensors'
    own noise, because disturbances last over many samples. With ``velocity_sigma`` the acceleration has states
    (:class:`strapdown.estimation.error_states.BoundedVelocity`), and ``specific_force_noise`` is the remaining noise.

    Parameters
    ----------
    angle_random_walk : float, default 3e-3
        Angle random walk σ_v, rad/√s; includes errors of a moving gyro that have no states.
    rate_random_walk : float, default 1e-5
        Rate random walk σ_u, rad/s/√s.
    specific_force_noise : float, default 0.6
        Noise density of the part of the acceleration that has no states, each component, m/s²/√Hz.
    field_disturbance : float, default 0.05
        Noise density across the field, relative to its magnitude, 1/√Hz, of a field that does not change. The noise density of the
        heading, rad/√Hz, is this divided by the cosine of the dip.
    field_deviation : float, default 0.05
        Deviation of the field, relative to its magnitude, that doubles the variance of that noise. It is the root sum of squares of the
        deviations of its magnitude and dip from their medians so far, and of the whole field, in the frame fixed by the gyro, from its
        mean over ``field_change_time``.
    field_memory : float, default 0.5
        Time constant of the average of that square deviation, s: a field that momentarily is as expected may still be disturbed.
    field_change_time : float, default 10.0
        Time constant of the mean from which the whole field deviates, s.
    hard_iron_sigma : float, default 0.0
        Stationary σ of the unit's hard iron, each component, relative to the magnitude of the field; 0: no states.
    hard_iron_time : float, default 30.0
        Correlation time of the hard iron, s.
    iron_sigma : float, default 0.004
        σ of a constant, unobservable disturbance of the field, relative to its magnitude. It is part of the reported σ and is not
        estimated.
    unshown_iron_sigma : float, default 0.0
        σ of the unit's hard iron, each component, relative to the magnitude of the field, in directions that no rotation has shown in the
        last minute. It is part of the reported σ too.
    step : float, default 0.03
        Interval of the filter's steps, s.
    heading_interval : float, default 0.15
        Interval of the heading measurements, s.
    attitude_sigma : float, default 3°
        σ of the initial attitude of a unit at rest, each axis, rad.
    bias_sigma : float, default 0.5 °/s
        σ of the initial gyro bias, each axis, rad/s.
    rest_bias_sigma : float, default 0.0
        σ of the mean rate of a second at rest as a measurement of the bias, each axis, rad/s; 0: not measured.
    velocity_sigma : float, default 0.0
        σ of the velocity of the unit, each component, m/s; 0: no states, all its acceleration is white.
    velocity_time : float, default 0.3
        Time constant of that velocity, s.
    acceleration_time : float, default 0.1
        Time constant of the acceleration, s.
    position_time : float, default 0.0
        Time constant of the position, s; 0: the position is not bounded.
    usual_variation : float, default 0.0
        Standard deviation of the magnitude of the specific force, m/s², in the motion that these parameters model. The smoother, which has
        the whole recording, multiplies ``velocity_sigma`` by that of the recording relative to it; 0: it does not.
    accelerometer_bias_sigma : float, default 0.0
        σ of a constant bias of the accelerometer, each component, m/s²; 0: no states. The smoother replaces it by the difference between
        the specific force at rest and gravity if that is larger than 0.1 m/s².
    tilt_sigma : float, default 0.04
        σ of a horizontal error of the accelerometer, m/s², that is part of the reported σ of the tilt and is not estimated.
    tilt_scale, heading_scale : float, default 5.0, 3.5
        Reported variance of tilt and heading relative to that of the filter if the innovations of the accelerometer or of the magnetometer
        are white; in others it follows their spectral density at low frequency with the power 5/4 (:mod:`strapdown.ahrs.regions`). Without
        a magnetometer ``heading_scale`` is the least factor on the variances of heading and bias before anything has shown the bias.
    gyro_scale_sigma : float, default 0.0
        σ of each entry of the gyro's matrix of scale factors and misalignments, dimensionless; 0: no states. Its symmetric part has
        states. The other part, a rotation relative to the accelerometer's axes, is zero for sensors on one chip.
    gyro_temperature_sigma : float or tuple (3,), default 0.0
        σ of the slope of the gyro's bias over temperature, each axis, rad/s/K; 0: no states.
    """

    angle_random_walk: float = 3e-3
    rate_random_walk: float = 1e-5
    specific_force_noise: float = 0.6
    field_disturbance: float = 0.05
    field_deviation: float = 0.05
    field_memory: float = 0.5
    field_change_time: float = 10.0
    hard_iron_sigma: float = 0.0
    hard_iron_time: float = 30.0
    iron_sigma: float = 0.004
    unshown_iron_sigma: float = 0.0
    step: float = 0.03
    heading_interval: float = 0.15
    attitude_sigma: float = 3.0 * DEGREE
    bias_sigma: float = 0.5 * DEGREE
    rest_bias_sigma: float = 0.0
    velocity_sigma: float = 0.0
    velocity_time: float = 0.3
    acceleration_time: float = 0.1
    position_time: float = 0.0
    usual_variation: float = 0.0
    accelerometer_bias_sigma: float = 0.0
    tilt_sigma: float = 0.04
    tilt_scale: float = 5.0
    heading_scale: float = 3.5
    gyro_scale_sigma: float = 0.0
    gyro_temperature_sigma: float | tuple[float, ...] = 0.0

    def __post_init__(self) -> None:
        """Check every field."""
        may_be_zero = (
            "accelerometer_bias_sigma",
            "gyro_scale_sigma",
            "hard_iron_sigma",
            "iron_sigma",
            "position_time",
            "rate_random_walk",
            "rest_bias_sigma",
            "tilt_sigma",
            "unshown_iron_sigma",
            "usual_variation",
            "velocity_sigma",
        )
        for axis in np.atleast_1d(self.gyro_temperature_sigma):
            non_negative("gyro_temperature_sigma", float(axis))
        for name in set(self.__dataclass_fields__) - {"gyro_temperature_sigma"}:
            check = non_negative if name in may_be_zero else positive
            check(name, getattr(self, name))

    @property
    def first_iron_sigma(self) -> float:
        """σ of all iron, each component, relative to the magnitude of the field, before the unit rotates."""
        return math.hypot(self.iron_sigma, self.unshown_iron_sigma)

    @functools.cached_property
    def setup(self) -> FilterSetup:
        """Setup of the filter with this model."""
        force: dict[str, Any] = {}
        if self.velocity_sigma > 0.0:
            names = ("velocity_sigma", "velocity_time", "acceleration_time", "position_time")
            force = {name: getattr(self, name) for name in names}
        if self.accelerometer_bias_sigma > 0.0:
            force["bias_sigma"] = self.accelerometer_bias_sigma
        sensors = {"accelerometer": SensorStates(**force)} if force else {}
        if self.hard_iron_sigma > 0.0:
            sensors["magnetometer"] = SensorStates(
                correlated_sigma=self.hard_iron_sigma, correlation_time=self.hard_iron_time
            )
        states = States(
            gyro_scale_sigma=self.gyro_scale_sigma,
            gyro_misalignment_sigma=self.gyro_scale_sigma / np.sqrt(2.0),
            gyro_symmetric=True,
            gyro_temperature_sigma=self.gyro_temperature_sigma,
            sensors=sensors,
        )
        return FilterSetup(
            process_noise=estimation.ProcessNoise(
                angle_random_walk=self.angle_random_walk, rate_random_walk=self.rate_random_walk
            ),
            attitude_sigma=self.attitude_sigma,
            bias_sigma=self.bias_sigma,
            states=states if states.names else None,
        )


@functools.lru_cache(maxsize=16)
def error_states(parameters: AhrsParameters, *sensors: tuple[str, str]) -> tuple[ErrorStates, ...]:
    """Return the error states of the filter with these sensors, each with its kind."""
    kinds, iron, states = dict(sensors), parameters.hard_iron_sigma, parameters.setup.states
    if iron > 0.0 and "magnetometer" not in kinds:
        raise InputError(
            f"hard_iron_sigma is {iron:g}, but there is no magnetometer; give parameters without one, such as ahrs.MOTIONS['hand'][1]"
        )
    return () if states is None else states.blocks(kinds)


HAND_HELD = AhrsParameters(
    angle_random_walk=2e-3,
    rate_random_walk=3e-4,
    specific_force_noise=0.06,
    field_disturbance=0.025,
    hard_iron_sigma=0.04,
    unshown_iron_sigma=0.04,
    bias_sigma=2.0 * DEGREE,
    rest_bias_sigma=0.05 * DEGREE,
    velocity_sigma=0.7,
    acceleration_time=0.15,
    accelerometer_bias_sigma=0.02,
    tilt_sigma=0.035,
    tilt_scale=12.6,
    gyro_scale_sigma=3e-3,
)
"""A unit with a magnetometer in the hand, on a person or a small aircraft: its velocity is bounded. Chosen on the development halves of
BROAD, RepoIMU, Sassari, OxIOD and the phones of PerCom 2017 (``benchmarks/recording_parameters.py``)."""
HAND_HELD_SMOOTHED = replace(
    HAND_HELD,
    field_disturbance=0.02,
    field_change_time=2.0,
    hard_iron_time=500.0,
    rate_random_walk=1.5e-4,
    velocity_sigma=1.0,
    usual_variation=1.4,
    tilt_sigma=0.045,
    tilt_scale=20.5,
    heading_scale=2.4,
    gyro_scale_sigma=4e-3,
)
"""The same for the smoother, which weighs acceleration that lasts over all the time before and after, and follows the motion. Chosen on the
same recordings; ``hard_iron_time`` and that ``velocity_sigma`` is proportional to the variation are chosen whichever set is left out."""
HAND_HELD_WITHOUT_MAGNETOMETER = replace(
    HAND_HELD,
    rate_random_walk=1e-5,
    specific_force_noise=0.3,
    hard_iron_sigma=0.0,
    bias_sigma=0.25 * DEGREE,
    velocity_sigma=3.0,
    velocity_time=1.0,
    acceleration_time=0.1,
    accelerometer_bias_sigma=0.0,
    tilt_sigma=0.04,
    tilt_scale=5.5,
    heading_scale=12.0,
    gyro_scale_sigma=5e-3,
)
"""Such a unit without a magnetometer. Acceleration that lasts, in body axes too, would otherwise be modelled as gyro bias about the
vertical, which nothing else shows. Chosen on the same recordings, without their magnetometers, and on those of EuRoC and TUM-VI."""
SMOOTHED = {
    HAND_HELD: HAND_HELD_SMOOTHED,
    HAND_HELD_WITHOUT_MAGNETOMETER: replace(HAND_HELD_WITHOUT_MAGNETOMETER, tilt_scale=8.0),
}
"""Parameters of the smoother for those of the filter; without a magnetometer only the reported σ differs."""
_VEHICLE = {"specific_force_noise": 0.15, "velocity_sigma": 8.0, "velocity_time": 10.0, "acceleration_time": 2.0}
_VESSEL = {"velocity_sigma": 3.0, "velocity_time": 10.0, "acceleration_time": 2.0, "position_time": 10.0}
MOTIONS: dict[str, tuple[AhrsParameters, AhrsParameters]] = {
    "hand": (HAND_HELD, HAND_HELD_WITHOUT_MAGNETOMETER),
    "vehicle": (
        replace(HAND_HELD, field_disturbance=0.1, rate_random_walk=1.5e-4, **_VEHICLE),
        replace(HAND_HELD_WITHOUT_MAGNETOMETER, **_VEHICLE),
    ),
    "vessel": (
        replace(HAND_HELD, bias_sigma=0.5 * DEGREE, **_VESSEL),
        replace(HAND_HELD_WITHOUT_MAGNETOMETER, **_VESSEL),
    ),
    "any": (AhrsParameters(), AhrsParameters()),
}
"""Parameters by kind of motion, with a magnetometer and without: of a hand, the default; of a vehicle on a road or a large aircraft, whose
acceleration lasts for seconds and could be mistaken for tilt; of a vessel on waves, whose position is bounded; of any unit, white noise."""


def of_motion(motion: str, *, magnetometer: bool, smooth: bool = False) -> AhrsParameters:
    """Return the parameters of a kind of motion, with a magnetometer or without, for the filter or the smoother."""
    parameters = MOTIONS[one_of("motion", motion, MOTIONS)][0 if magnetometer else 1]
    return SMOOTHED.get(parameters, parameters) if smooth else parameters
