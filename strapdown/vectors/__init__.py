"""Vector and attitude sensors, and attitude from their measurements at one time.

Every sensor has its own rate, phase and :class:`Faults` (latency, outages, outliers, correlated noise), and returns a series of
:class:`VectorMeasurements`: body-frame measurements ``q⁻¹ r q + v`` of vectors known in the fixed frame, or of the attitude itself. The
series has the *nominal* noise only: outliers, correlation, hard iron and acceleration are not disclosed to the filter.

- ``measurements``: A series of measurements, its kinds and its noise; unit vectors about a reference, ``triad``.
- ``sensor``: What all sensors have in common: times, noise, faults.
- ``vector_sensor``, ``horizon_sensor``, ``attitude_sensor``, ``magnetometer``, ``accelerometer``, ``heading_pair``: One sensor each.
- ``wahba``: Attitude from two or more vectors by least squares (Wahba's problem), with its covariance.
"""

from __future__ import annotations

from strapdown.vectors import wahba
from strapdown.vectors.accelerometer import GRAVITY_F, Accelerometer, specific_force
from strapdown.vectors.attitude_sensor import AttitudeSensor
from strapdown.vectors.heading_pair import HeadingPair
from strapdown.vectors.horizon_sensor import HorizonSensor
from strapdown.vectors.magnetometer import Magnetometer
from strapdown.vectors.measurements import KINDS, VectorMeasurements, need_level, triad
from strapdown.vectors.sensor import Faults, Sensor, without_noise
from strapdown.vectors.vector_sensor import VectorSensor

__all__ = [
    "Accelerometer",
    "AttitudeSensor",
    "Faults",
    "HeadingPair",
    "HorizonSensor",
    "Magnetometer",
    "VectorMeasurements",
    "VectorSensor",
    "specific_force",
]
