"""Records of an IMU with their truth, and estimates of a filter.

- ``record``: :class:`ImuRecord` and its parts.
- ``estimate``, ``estimate_files``: :class:`Estimate` and its parts, its columns as a table; in HDF5.
- ``recording``: :class:`Recording`: point samples of a device, and their units.
- ``outputs``: Attitudes in other quantities: Euler angles, heading, NED, specific force, each with its σ.
"""

from __future__ import annotations

from strapdown.records import outputs as outputs
from strapdown.records.estimate import ErrorStateEstimate as ErrorStateEstimate
from strapdown.records.estimate import Estimate as Estimate
from strapdown.records.estimate import Event as Event
from strapdown.records.estimate import Innovations as Innovations
from strapdown.records.estimate_files import CONVENTIONS as CONVENTIONS
from strapdown.records.estimate_files import put as put
from strapdown.records.estimate_files import read_attributes as read_attributes
from strapdown.records.estimate_files import read_estimate as read_estimate
from strapdown.records.estimate_files import read_reference as read_reference
from strapdown.records.estimate_files import read_states as read_states
from strapdown.records.estimate_files import read_truth as read_truth
from strapdown.records.estimate_files import result_file as result_file
from strapdown.records.estimate_files import write_attitude as write_attitude
from strapdown.records.estimate_files import write_estimate as write_estimate
from strapdown.records.record import LARGEST_TURN as LARGEST_TURN
from strapdown.records.record import ImuRecord as ImuRecord
from strapdown.records.record import Origin as Origin
from strapdown.records.record import Truth as Truth
from strapdown.records.record import compress as compress
from strapdown.records.record import cut as cut
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
