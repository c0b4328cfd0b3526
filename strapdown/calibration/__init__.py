"""Calibration of a unit by hand: errors of gyro, accelerometer and magnetometer, each with its σ.

- ``unit``: The errors of a unit, their correction in a recording, and the file that holds them.
- ``intervals``: Samples gathered into intervals.
- ``fitting``: Joint least squares of sensor errors and motion.
- ``calibrating``: The calibration from recordings, with its priors, its start, and the motion that is missing.
"""

from __future__ import annotations

from strapdown.calibration.calibrating import calibrate
from strapdown.calibration.unit import SensorErrors, UnitCalibration, iron_sigma, read, with_gyro_states, write

__all__ = ["SensorErrors", "UnitCalibration", "calibrate", "read", "write"]
