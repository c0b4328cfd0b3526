"""Records of an IMU with their truth, and estimates of a filter.

- ``record``: :class:`ImuRecord`, :class:`Estimate` and their parts, and estimates in HDF5.
- ``recording``: :class:`Recording`: point samples of a device, and their units.
- ``outputs``: An estimate in other quantities: Euler angles, heading, NED, specific force, each with its covariance.
"""

from __future__ import annotations

from strapdown.records import outputs as outputs
from strapdown.records.record import CONVENTIONS as CONVENTIONS
from strapdown.records.record import LARGEST_TURN as LARGEST_TURN
from strapdown.records.record import ErrorStateEstimate as ErrorStateEstimate
from strapdown.records.record import Estimate as Estimate
from strapdown.records.record import Event as Event
from strapdown.records.record import ImuRecord as ImuRecord
from strapdown.records.record import Innovations as Innovations
from strapdown.records.record import Origin as Origin
from strapdown.records.record import Truth as Truth
from strapdown.records.record import compress as compress
from strapdown.records.record import cut as cut
from strapdown.records.record import put as put
from strapdown.records.record import read_attributes as read_attributes
from strapdown.records.record import read_estimate as read_estimate
from strapdown.records.record import read_reference as read_reference
from strapdown.records.record import read_states as read_states
from strapdown.records.record import read_truth as read_truth
from strapdown.records.record import result_file as result_file
from strapdown.records.record import write_attitude as write_attitude
from strapdown.records.record import write_estimate as write_estimate
from strapdown.records.recording import Recording as Recording

__all__ = [
    "ErrorStateEstimate",
    "Estimate",
    "Event",
    "ImuRecord",
    "Innovations",
    "Origin",
    "Truth",
    "compress",
    "cut",
]
