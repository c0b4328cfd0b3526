"""Vector and attitude sensors, and attitude from their measurements at one time.

- ``sensors``: Star trackers, sun and horizon sensors, magnetometers, accelerometers: their measurements, with noise and faults.
- ``wahba``: Attitude from two or more vectors by least squares (Wahba's problem), with its covariance.
"""

from __future__ import annotations

from strapdown.vectors import wahba as wahba
from strapdown.vectors.sensors import GRAVITY_F as GRAVITY_F
from strapdown.vectors.sensors import KINDS as KINDS
from strapdown.vectors.sensors import Accelerometer as Accelerometer
from strapdown.vectors.sensors import AttitudeSensor as AttitudeSensor
from strapdown.vectors.sensors import Faults as Faults
from strapdown.vectors.sensors import HeadingPair as HeadingPair
from strapdown.vectors.sensors import HorizonSensor as HorizonSensor
from strapdown.vectors.sensors import Magnetometer as Magnetometer
from strapdown.vectors.sensors import Sensor as Sensor
from strapdown.vectors.sensors import VectorMeasurements as VectorMeasurements
from strapdown.vectors.sensors import VectorSensor as VectorSensor
from strapdown.vectors.sensors import need_level as need_level
from strapdown.vectors.sensors import need_unit as need_unit
from strapdown.vectors.sensors import specific_force as specific_force
from strapdown.vectors.sensors import triad as triad

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
