"""Gyro errors: specification, simulation of increments, and process noise of a matched filter.

- ``model``: :class:`GyroSpec` and its tables in files.
- ``simulation``: :func:`simulate`.
- ``filter_noise``: The process noise of a filter matched to a specification.
- ``flicker``: Flicker noise (bias instability) as a sum of Gauss-Markov processes.
- ``temperature``: Bias over temperature.
- ``datasheets``: Specifications in the units of data sheets.
"""

from __future__ import annotations

from strapdown.gyro import datasheets
from strapdown.gyro.filter_noise import matched_process_noise, process_noise
from strapdown.gyro.model import FORM, Axes, GyroSpec, from_table, read_spec, to_table
from strapdown.gyro.simulation import BEFORE_RANGE, bridge_dropped, sampling, simulate

__all__ = ["GyroSpec", "matched_process_noise", "process_noise", "read_spec", "simulate"]
