"""Records of an IMU with their truth, and estimates of a filter.

- ``record``: :class:`ImuRecord` and its parts.
- ``estimate``: :class:`Estimate` and its parts, its columns as a table.
- ``result_files``: What HDF5 files of all results have in common.
- ``recording``: :class:`Recording`: point samples of a device, and their units.
- ``outputs``: Attitudes in other quantities: Euler angles, heading, NED, specific force, each with its σ.
"""

from __future__ import annotations

from strapdown.records import outputs as outputs
from strapdown.records.estimate import ErrorStateEstimate as ErrorStateEstimate
from strapdown.records.estimate import Estimate as Estimate
from strapdown.records.estimate import Event as Event
from strapdown.records.estimate import Innovations as Innovations
from strapdown.records.record import LARGEST_TURN as LARGEST_TURN
from strapdown.records.record import ImuRecord as ImuRecord
from strapdown.records.record import Origin as Origin
from strapdown.records.record import Truth as Truth
from strapdown.records.record import compress as compress
from strapdown.records.record import cut as cut
from strapdown.records.recording import Recording as Recording
from strapdown.records.result_files import CONVENTIONS as CONVENTIONS
from strapdown.records.result_files import put as put
from strapdown.records.result_files import read_attributes as read_attributes
from strapdown.records.result_files import result_file as result_file
from strapdown.records.result_files import write_attitude as write_attitude

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
