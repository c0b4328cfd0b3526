"""Records of an IMU with their truth, and estimates of a filter.

- ``record``: :class:`ImuRecord` and its parts.
- ``estimate``: :class:`Estimate` and its parts, its columns as a table.
- ``result_files``: What HDF5 files of all results have in common.
- ``recording``: :class:`Recording`: point samples of a device, and their units.
- ``outputs``: Attitudes in other quantities: Euler angles, heading, NED, specific force, each with its σ.
"""

from __future__ import annotations

from strapdown.records import outputs
from strapdown.records.estimate import ErrorStateEstimate, Estimate, Event, Innovations
from strapdown.records.record import LARGEST_TURN, ImuRecord, Origin, Truth, compress, cut
from strapdown.records.recording import Recording
from strapdown.records.result_files import CONVENTIONS, put, read_attributes, result_file

__all__ = ["ErrorStateEstimate", "Estimate", "Event", "ImuRecord", "Innovations", "Origin", "Truth", "compress"]
