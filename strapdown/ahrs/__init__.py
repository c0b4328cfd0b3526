"""Attitude and heading from a recording: one filter, with the accelerometer for the vertical and the magnetometer for the heading only.

The fixed frame is East-North-Up with magnetic North. The disturbances of both vectors last much longer than a sample interval, so little is
lost by updating at a lower rate than the sensors': the samples of a step are rotated by the gyro into one frame and averaged
(:mod:`strapdown.ahrs.preparing`). The filter is that of :mod:`strapdown.estimation`; its estimate is propagated to every time stamp.
"""

from __future__ import annotations

from strapdown.ahrs import check_conventions as check_conventions
from strapdown.ahrs.check_conventions import ConventionWarning
from strapdown.ahrs.estimating import AhrsEstimate, estimate
from strapdown.ahrs.live import LiveAhrs
from strapdown.ahrs.magnetic_field import FieldComparison, MagneticField
from strapdown.ahrs.parameters import HAND_HELD as HAND_HELD
from strapdown.ahrs.parameters import HAND_HELD_SMOOTHED as HAND_HELD_SMOOTHED
from strapdown.ahrs.parameters import HAND_HELD_WITHOUT_MAGNETOMETER as HAND_HELD_WITHOUT_MAGNETOMETER
from strapdown.ahrs.parameters import MOTIONS, AhrsParameters
from strapdown.ahrs.parameters import of_motion as of_motion
from strapdown.ahrs.preparing import prepare as prepare
from strapdown.ahrs.preparing import without_temperature as without_temperature
from strapdown.ahrs.remarks import MotionWarning
from strapdown.ahrs.starting import need_accelerometer as need_accelerometer
from strapdown.ahrs.starting import quiet_span as quiet_span
from strapdown.ahrs.starting import start as start

__all__ = [
    "MOTIONS",
    "AhrsEstimate",
    "AhrsParameters",
    "ConventionWarning",
    "FieldComparison",
    "LiveAhrs",
    "MagneticField",
    "MotionWarning",
    "estimate",
]
