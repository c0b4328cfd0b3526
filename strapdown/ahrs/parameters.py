"""The filter's model of a unit and of its motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from strapdown import estimation
from strapdown.checks import instance, non_negative, positive
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.units import DEGREE

MIN_VELOCITY = 0.1
"""Minimum σ of the velocity, m/s: a unit that appears at rest in a recording may have been moved slowly."""


@dataclass(frozen=True, kw_only=True)
class AhrsParameters:
    """The filter's model of a unit and of its motion. The defaults hold for consumer and industrial MEMS units under any motion.

    Noises of the vectors are densities: σ of a mean over one second, whatever the recording's rate. They are much larger than the sensors'
    own noise, because disturbances last over many samples. With ``velocity_sigma`` the acceleration has states
    (:class:`strapdown.error_states.BoundedVelocity`), and ``specific_force_noise`` is the remaining noise.

    Parameters
    ----------
    angle_random_walk : float, default 3e-3
        Angle random walk σ_v, rad/√s; includes scale-factor and alignment errors of a moving unit.
    rate_random_walk : float, default 1e-5
        Rate random walk σ_u, rad/s/√s.
    specific_force_noise : float, default 0.6
        Noise density of the part of the acceleration that has no states, each component, m/s²/√Hz.
    field_disturbance : float, default 0.05
        Noise density across the field, relative to its magnitude, 1/√Hz, while magnitude and dip are those at the start. The noise
        density of the heading, rad/√Hz, is this divided by the cosine of the dip.
    field_deviation : float, default 0.025
        Deviation of the field's magnitude (relative) and dip (rad), as a root sum of squares, that doubles the variance of that noise.
    field_memory : float, default 0.5
        Time constant of the average of that deviation, s: a field that momentarily has the expected magnitude and dip may still be
        disturbed.
    iron_sigma : float, default 0.012
        σ of a constant, unobservable disturbance of the field, relative to its magnitude. It is part of the reported σ and is not
        estimated.
    step : float, default 0.03
        Interval of the filter's steps, s.
    heading_interval : float, default 0.15
        Interval of the heading measurements, s.
    attitude_sigma : float, default 3°
        σ of the initial attitude error, each axis, rad.
    bias_sigma : float, default 0.5 °/s
        σ of the initial gyro bias, each axis, rad/s.
    rest_bias_sigma : float, default 0.0
        σ of the mean rate of the quiet second as an estimate of the bias, each axis, rad/s; 0: the bias starts at zero.
    velocity_sigma : float, default 0.0
        σ of the velocity of the unit, each component, m/s; 0: no states, all its acceleration is white.
    velocity_from_record : bool, default False
        Whether ``velocity_sigma`` is computed from the acceleration of the recording (:attr:`strapdown.ahrs.Prepared.acceleration`);
        the value given here is then used only without a recording.
    velocity_time : float, default 0.3
        Time constant of that velocity, s.
    acceleration_time : float, default 0.1
        Time constant of the acceleration, s.
    gyro_scale_sigma : float, default 0.0
        σ of each of the gyro's scale factor errors, dimensionless, and misalignments, rad; 0: no states.
    gyro_temperature_sigma : float or tuple (3,), default 0.0
        σ of the slope of the gyro's bias over temperature, each axis, rad/s/K; 0: no states.
    """

    angle_random_walk: float = 3e-3
    rate_random_walk: float = 1e-5
    specific_force_noise: float = 0.6
    field_disturbance: float = 0.05
    field_deviation: float = 0.025
    field_memory: float = 0.5
    iron_sigma: float = 0.012
    step: float = 0.03
    heading_interval: float = 0.15
    attitude_sigma: float = 3.0 * DEGREE
    bias_sigma: float = 0.5 * DEGREE
    rest_bias_sigma: float = 0.0
    velocity_sigma: float = 0.0
    velocity_from_record: bool = False
    velocity_time: float = 0.3
    acceleration_time: float = 0.1
    gyro_scale_sigma: float = 0.0
    gyro_temperature_sigma: float | tuple[float, ...] = 0.0

    def __post_init__(self) -> None:
        """Check every field."""
        may_be_zero = ("iron_sigma", "rate_random_walk", "rest_bias_sigma", "velocity_sigma", "gyro_scale_sigma")
        for axis in np.atleast_1d(self.gyro_temperature_sigma):
            non_negative("gyro_temperature_sigma", float(axis))
        instance("velocity_from_record", self.velocity_from_record, bool, "give true or false")
        for name in set(self.__dataclass_fields__) - {"gyro_temperature_sigma", "velocity_from_record"}:
            check = non_negative if name in may_be_zero else positive
            check(name, getattr(self, name))

    def matched(self, acceleration: float) -> AhrsParameters:
        """Return the parameters for a unit moved with this acceleration.

        The acceleration of a bounded velocity has σ ``velocity_sigma / √(velocity_time acceleration_time)``.

        Parameters
        ----------
        acceleration : float
            RMS of each component, m/s².

        Returns
        -------
        AhrsParameters
            With the ``velocity_sigma`` of that acceleration if ``velocity_from_record`` is set, otherwise unchanged.
        """
        if not self.velocity_from_record:
            return self
        sigma = acceleration * math.sqrt(self.velocity_time * self.acceleration_time)
        return replace(self, velocity_sigma=max(sigma, MIN_VELOCITY))

    @property
    def setup(self) -> FilterSetup:
        """Setup of the filter with this model."""
        sensors = {}
        if self.velocity_sigma > 0.0:
            sensors["accelerometer"] = SensorStates(
                velocity_sigma=self.velocity_sigma,
                velocity_time=self.velocity_time,
                acceleration_time=self.acceleration_time,
            )
        states = States(
            gyro_scale_sigma=self.gyro_scale_sigma,
            gyro_misalignment_sigma=self.gyro_scale_sigma,
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


HAND_HELD = AhrsParameters(
    specific_force_noise=0.06,
    rest_bias_sigma=0.05 * DEGREE,
    velocity_sigma=1.0,
    velocity_from_record=True,
    gyro_scale_sigma=2e-3,
)
"""A unit in the hand: its velocity is bounded, with σ found from the recording; because its rotations are large, the gyro's scale factors
and misalignments are states."""
VEHICLE = replace(
    HAND_HELD, specific_force_noise=0.15, field_disturbance=0.1, velocity_time=10.0, acceleration_time=2.0
)
"""A unit in a car, a boat or an aircraft: its acceleration lasts for seconds and could be mistaken for tilt, and iron is near."""
MOTIONS = {"hand": HAND_HELD, "vehicle": VEHICLE, "any": AhrsParameters()}
"""Parameters by kind of motion."""
