"""Gyro errors: specification, simulation of increments, and process noise of a matched filter.

- ``model``: :class:`GyroSpec` and its tables in files.
- ``simulation``: :func:`simulate`.
- ``filter_noise``: The process noise of a filter matched to a specification.
- ``flicker``: Flicker noise (bias instability) as a sum of Gauss-Markov processes.
- ``temperature``: Bias over temperature.
- ``datasheets``: Specifications in the units of data sheets.
"""

from __future__ import annotations

from strapdown.gyro import datasheets as datasheets
from strapdown.gyro.filter_noise import matched_process_noise as matched_process_noise
from strapdown.gyro.filter_noise import process_noise as process_noise
from strapdown.gyro.model import FORM as FORM
from strapdown.gyro.model import Axes as Axes
from strapdown.gyro.model import GyroSpec as GyroSpec
from strapdown.gyro.model import from_table as from_table
from strapdown.gyro.model import read_spec as read_spec
from strapdown.gyro.model import to_table as to_table
from strapdown.gyro.simulation import BEFORE_RANGE as BEFORE_RANGE
from strapdown.gyro.simulation import bridge_dropped as bridge_dropped
from strapdown.gyro.simulation import sampling as sampling
from strapdown.gyro.simulation import simulate as simulate

__all__ = ["GyroSpec", "matched_process_noise", "process_noise", "read_spec", "simulate"]
