"""Calibration of one unit, found from one recording and used for the next of the same unit: gyro scale, misalignment, and delays.

In a file it is the table ``[calibration]`` of a TOML document, with the units in the names of its keys.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from strapdown.checks import Array, InputError, array, finite, known_keys, non_negative
from strapdown.files import tables
from strapdown.records import ErrorStateEstimate
from strapdown.records.recording import Recording

__all__ = [
    "UnitCalibration",
    "read",
    "to_toml",
]

KEYS = ("gyro_scale_and_misalignment", "sigma", "magnetometer_delay_ms", "source")


@dataclass(frozen=True, kw_only=True, eq=False)
class UnitCalibration:
    """Calibration of one unit.

    Parameters
    ----------
    matrix : ndarray (3, 3)
        M of a gyro that measures ``(I + M) w``: diagonal scale-factor errors, off-diagonal misalignments, rad.
    sigma : float
        Root mean square of the standard deviations of the entries.
    magnetometer_delay : float, default 0.0
        Delay of the magnetometer's stamps relative to the gyro's, s; 0: unknown.
    source : str, default ""
        Recording from which it was found.
    """

    matrix: Array
    sigma: float
    magnetometer_delay: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        """Check every field."""
        M = array("matrix", self.matrix, (3, 3))
        if np.abs(M).max() > 0.5:
            raise InputError(
                f"matrix has an entry of {np.abs(M).max():g}; a gyro's scale is within 50 %: give M of I + M"
            )
        object.__setattr__(self, "matrix", M)
        non_negative("sigma", self.sigma)
        finite("magnetometer_delay", self.magnetometer_delay)

    def applied(self, recording: Recording) -> Recording:
        """Return the recording with its rates corrected.

        Parameters
        ----------
        recording : Recording
            Recording of the same unit.

        Returns
        -------
        Recording
            Recording with the rates ``(I + M)⁻¹ w``, rad/s.
        """
        return replace(recording, rate=recording.rate @ np.linalg.inv(np.eye(3) + self.matrix).T)


NONE = UnitCalibration(matrix=np.zeros((3, 3)), sigma=0.0)
"""Calibration of an unknown unit: no correction."""


def matrix_of(block: ErrorStateEstimate) -> Array:
    """Return M (3, 3) from a filter's states of the gyro's scale and misalignment at the end, named x, xy, … by row and column."""
    M = np.zeros((3, 3))
    for name, value in zip(block.components, block.values[-1], strict=True):
        row, column = name[0], name[-1]
        M["xyz".index(row), "xyz".index(column)] = value
    return M


def combined(
    calibration: UnitCalibration, block: ErrorStateEstimate, magnetometer_delay: float, source: str
) -> UnitCalibration:
    """Return a calibration combined with the last values of the states of gyro scale and misalignment that a filter estimated with it."""
    return UnitCalibration(
        matrix=(np.eye(3) + calibration.matrix) @ (np.eye(3) + matrix_of(block)) - np.eye(3),
        sigma=float(np.sqrt(np.mean(block.variance[-1]))),
        magnetometer_delay=magnetometer_delay,
        source=source,
    )


def to_toml(calibration: UnitCalibration) -> str:
    """Return a calibration as TOML with the table ``[calibration]``.

    Parameters
    ----------
    calibration : UnitCalibration
        Calibration.

    Returns
    -------
    str
        TOML, for :func:`read`.
    """
    import tomli_w

    content: dict[str, Any] = {
        "gyro_scale_and_misalignment": calibration.matrix.tolist(),
        "sigma": calibration.sigma,
        "magnetometer_delay_ms": 1e3 * calibration.magnetometer_delay,
        "source": calibration.source,
    }
    return "# the gyro measures (I + M) w, M by rows; sigma: standard deviation of its entries\n" + tomli_w.dumps(
        {"calibration": content}
    )


def read(path: str | os.PathLike[str]) -> UnitCalibration:
    """Read the table ``[calibration]`` of a TOML file written by ``strapdown estimate``.

    Parameters
    ----------
    path : path-like
        File.

    Returns
    -------
    UnitCalibration
        The calibration.

    Raises
    ------
    InputError
        If the file is missing, is not TOML, has no such table, or has another key or shape.
    """
    return tables.read(path, "calibration", "`strapdown estimate` writes one", _from_table)


def _from_table(table: Mapping[str, Any], place: str) -> UnitCalibration:
    """Return the calibration from a table."""
    known_keys(place, table, KEYS)
    missing = [key for key in KEYS[:2] if key not in table]
    if missing:
        raise InputError(f"{place} lacks {', '.join(missing)}; add the missing keys")
    try:
        return UnitCalibration(
            matrix=np.asarray(table["gyro_scale_and_misalignment"], np.float64),
            sigma=table["sigma"],
            magnetometer_delay=1e-3 * table.get("magnetometer_delay_ms", 0.0),
            source=str(table.get("source", "")),
        )
    except (InputError, TypeError, ValueError) as error:
        raise InputError(f"{place}: {error}") from None
