"""Calibration of one unit: errors of its sensors with σ, their correction in a recording, and the file that holds them.

In a file it is the table ``[calibration]`` of a TOML document, with σ of the same keys in ``[calibration.sigma]``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from strapdown.checks import Array, InputError, array, finite
from strapdown.files import tables, write_text
from strapdown.records import ErrorStateEstimate
from strapdown.records.recording import MAGNETIC_UNITS, Recording
from strapdown.results import ByValue, Column, Listed, Table

AXES = ("x", "y", "z")
MILLISECONDS: tables.Choice = (("ms", 1e-3), ("s", 1.0))
_FIELDS: dict[str, tuple[tables.Choice, str, str]] = {
    "gyro_bias": (tables.DEGREES_PER_SECOND, "gyro bias", "°/s"),
    "gyro_matrix": (tables.PLAIN, "gyro", "%"),
    "accelerometer_bias": (tables.METRES_PER_SECOND_SQUARED, "accelerometer bias", "m/s²"),
    "accelerometer_matrix": (tables.PLAIN, "accelerometer", "%"),
    "hard_iron": (tables.PLAIN, "hard iron", "unit of the field"),
    "magnetometer_matrix": (tables.PLAIN, "magnetometer", "%"),
    "accelerometer_delay": (MILLISECONDS, "accelerometer delay", "ms"),
    "magnetometer_delay": (MILLISECONDS, "magnetometer delay", "ms"),
}
"""Fields of :class:`SensorErrors`: the units of their keys in a file, their name and unit in print."""
FORM: tables.Form = {name: choice for name, (choice, _, _) in _FIELDS.items()}
SCALE = {"°/s": np.pi / 180.0, "%": 0.01, "ms": 1e-3}
"""Printed units in SI."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorErrors(ByValue):
    """Errors of the sensors of one unit, or their standard deviations.

    The gyro measures ``(I + M) w + b``, the other sensors the same of specific force and field. The body axes are those of the
    accelerometer: its matrix is symmetric.

    Parameters
    ----------
    gyro_bias : ndarray (3,), default zeros
        b of the gyro, rad/s, at the end of the calibration.
    gyro_matrix : ndarray (3, 3), default zeros
        M of the gyro: diagonal scale-factor errors, off-diagonal misalignments, rad.
    accelerometer_bias : ndarray (3,), default zeros
        b of the accelerometer, m/s².
    accelerometer_matrix : ndarray (3, 3), default zeros
        M of the accelerometer.
    hard_iron : ndarray (3,), default zeros
        b of the magnetometer, in the unit of the field.
    magnetometer_matrix : ndarray (3, 3), default zeros
        M of the magnetometer: scale factors, misalignments and soft iron.
    accelerometer_delay, magnetometer_delay : float, default 0.0
        Delays of the stamps of the accelerometer and of the magnetometer relative to the gyro's, s; 0: unknown.
    """

    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))
    gyro_matrix: Array = field(default_factory=lambda: np.zeros((3, 3)))
    accelerometer_bias: Array = field(default_factory=lambda: np.zeros(3))
    accelerometer_matrix: Array = field(default_factory=lambda: np.zeros((3, 3)))
    hard_iron: Array = field(default_factory=lambda: np.zeros(3))
    magnetometer_matrix: Array = field(default_factory=lambda: np.zeros((3, 3)))
    accelerometer_delay: float = 0.0
    magnetometer_delay: float = 0.0

    def __post_init__(self) -> None:
        for name in FORM:
            value = getattr(self, name)
            if name.endswith("delay"):
                finite(name, value, unit="s")
                continue
            value = array(name, value, (3, 3) if name.endswith("matrix") else (3,))
            object.__setattr__(self, name, value)
        for name in ("gyro_matrix", "accelerometer_matrix"):
            largest = float(np.max(np.abs(getattr(self, name))))
            if largest > 0.5:
                raise InputError(f"{name} has an entry of {largest:g}; scale factors are within 50 %: give M of I + M")
        if np.linalg.cond(np.eye(3) + self.magnetometer_matrix) > 100.0:
            raise InputError("magnetometer_matrix is M of I + M, and I + M is singular or nearly so; give M of I + M")

    def entries(self) -> Iterator[tuple[str, str, float]]:
        """Yield field, component (``x``, ``xy``, …; empty for a number) and value of each error, in the order of the fields.

        Of the accelerometer's symmetric matrix each entry appears once.

        Yields
        ------
        tuple of (str, str, float)
            Name, component and value in SI.
        """
        for name in FORM:
            value = np.atleast_1d(getattr(self, name))
            for index in np.ndindex(value.shape):
                if name == "accelerometer_matrix" and index[0] > index[1]:
                    continue
                axes = "".join(AXES[i] for i in dict.fromkeys(index)) if value.size > 1 else ""
                yield name, axes, float(value[index])


def printed(name: str, axes: str, magnetic_unit: str) -> tuple[str, str, float]:
    """Return the words for an entry of a field of :class:`SensorErrors`, its printed unit, and this unit in SI."""
    _, words, unit = _FIELDS[name]
    if name.endswith("matrix"):
        off = "soft iron" if name == "magnetometer_matrix" else "misalignment"
        words = f"{words} {'scale' if len(axes) == 1 else off}"
    unit = magnetic_unit or unit if name == "hard_iron" else unit
    return f"{words} {axes}".strip(), unit, SCALE.get(unit, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class UnitCalibration(SensorErrors, Listed):
    """Calibration of one unit, from :func:`strapdown.calibrate` or a file of it.

    Parameters
    ----------
    gyro_bias, gyro_matrix, accelerometer_bias, accelerometer_matrix, hard_iron, magnetometer_matrix : ndarray, default zeros
        As for :class:`SensorErrors`.
    accelerometer_delay, magnetometer_delay : float, default 0.0
        As for :class:`SensorErrors`. The estimate corrects for that of the magnetometer.
    sigma : SensorErrors, optional
        Standard deviation of each error; 0: the error was not estimated.
    magnetic_unit : str, default ""
        Unit of ``hard_iron``, a key of :data:`strapdown.records.recording.MAGNETIC_UNITS`; empty if unknown.
    source : str, default ""
        Recordings from which it was found.
    remarks : tuple of str, default ()
        Motion that is missing for parameters whose σ is large.
    """

    sigma: SensorErrors = field(default_factory=SensorErrors)
    magnetic_unit: str = ""
    source: str = ""
    remarks: tuple[str, ...] = ()

    @property
    def gyro_scale_sigma(self) -> float:
        """Root mean square of the standard deviations of the entries of the gyro's matrix; 0: unknown."""
        return float(np.sqrt(np.mean(self.sigma.gyro_matrix**2)))

    def applied(self, recording: Recording) -> Recording:
        """Return a recording of the same unit with its samples corrected; the delays are left to the estimator.

        Parameters
        ----------
        recording : Recording
            Recording of the same unit.

        Returns
        -------
        Recording
            Recording with the rates ``(I + M)⁻¹ (w − b)``, and the same of specific force and field.

        Raises
        ------
        InputError
            If the unit of the hard iron is known and that of the recording's field is not, or the other way round.
        """
        changes = {"rate": _corrected(recording.rate, self.gyro_bias, self.gyro_matrix)}
        if recording.specific_force is not None:
            changes["specific_force"] = _corrected(
                recording.specific_force, self.accelerometer_bias, self.accelerometer_matrix
            )
        if recording.magnetic_field is not None and (self.hard_iron.any() or self.magnetometer_matrix.any()):
            iron = self.hard_iron * self._unit_ratio(recording)
            changes["magnetic_field"] = _corrected(recording.magnetic_field, iron, self.magnetometer_matrix)
        return replace(recording, **changes)  # type: ignore[arg-type]

    def _unit_ratio(self, recording: Recording) -> float:
        """Return the unit of the hard iron in that of the recording's field."""
        own, other = self.magnetic_unit, recording.magnetic_unit
        if own == other:
            return 1.0
        if not own or not other:
            raise InputError(
                f"the calibration's hard iron is in {own or 'an unknown unit'} and the field of {recording.source} in "
                f"{other or 'an unknown unit'}; declare the unit of the magnetometer when reading it"
            )
        return MAGNETIC_UNITS[own] / MAGNETIC_UNITS[other]

    def listing(self) -> Table:
        """Return the errors and their σ as a table, with the motion that is missing below."""
        rows = []
        for (name, axes, value), (_, _, sigma) in zip(self.entries(), self.sigma.entries(), strict=True):
            if sigma == 0.0:
                continue
            words, unit, factor = printed(name, axes, self.magnetic_unit)
            rows.append((words, unit, value / factor, sigma / factor))
        title = f"Calibration from {self.source or 'an unknown source'}"
        return Table(title, ("error", "unit", "value", Column("σ", digits=2)), rows, self.remarks, left=2)


def iron_sigma(calibration: UnitCalibration, recording: Recording) -> float:
    """Return the root mean square of σ of the components of the hard iron, in the unit of a recording's field; 0: unknown."""
    return float(np.sqrt(np.mean(calibration.sigma.hard_iron**2))) * calibration._unit_ratio(recording)


def _corrected(samples: Array, bias: Array, matrix: Array) -> Array:
    """Return samples (n, 3) without the bias and the matrix of their sensor."""
    return np.asarray((samples - bias) @ np.linalg.inv(np.eye(3) + matrix).T)


def with_gyro_states(
    calibration: UnitCalibration | None, block: ErrorStateEstimate, magnetometer_delay: float, source: str
) -> UnitCalibration:
    """Return a calibration with the last values of the states of gyro scale and misalignment that a filter estimated with it.

    The states are named x, xy, … by row and column of M, two equal entries xy=yx; ``magnetometer_delay`` and ``source`` are those of the
    recording.
    """
    further, sigma = np.zeros((2, 3, 3))
    for name, value, variance in zip(block.components, block.values[-1], block.variance[-1], strict=True):
        for entry in name.split("="):
            place = AXES.index(entry[0]), AXES.index(entry[-1])
            further[place], sigma[place] = value, np.sqrt(variance)
    own = calibration or UnitCalibration()
    return replace(
        own,
        gyro_matrix=(np.eye(3) + own.gyro_matrix) @ (np.eye(3) + further) - np.eye(3),
        magnetometer_delay=magnetometer_delay,
        sigma=replace(own.sigma, gyro_matrix=sigma),
        source=source,
        remarks=(),
    )


def write(calibration: UnitCalibration, path: str | os.PathLike[str]) -> None:
    """Write a calibration as TOML with the table ``[calibration]``.

    Parameters
    ----------
    calibration : UnitCalibration
        Calibration.
    path : path-like
        File, ``*.toml``.
    """
    import tomli_w

    content: dict[str, Any] = {"source": calibration.source, "magnetic_unit": calibration.magnetic_unit}
    content |= tables.encode(calibration, FORM)
    content["sigma"] = tables.encode(calibration.sigma, FORM)
    text = (
        "# each sensor measures (I + M) v + b: M is its matrix, by rows, b its bias or hard iron (in magnetic_unit)\n"
        + "".join(f"# {line}\n" for line in calibration.remarks)
    )
    write_text(path, text + tomli_w.dumps({"calibration": content}))


def read(path: str | os.PathLike[str]) -> UnitCalibration:
    """Read the table ``[calibration]`` of a TOML file.

    Parameters
    ----------
    path : path-like
        File.

    Returns
    -------
    UnitCalibration
        The calibration.
    """
    return tables.read(path, "calibration", "`strapdown calibrate` writes one", _from_table)


def _from_table(table: Mapping[str, Any], place: str) -> UnitCalibration:
    """Return the calibration from a table."""
    sigma = tables.subtable(table.get("sigma", {}), f"{place}.sigma")
    values = {key: value for key, value in table.items() if key != "sigma"}
    form = {**FORM, "source": tables.TEXT, "magnetic_unit": tables.TEXT}
    unit = values.get("magnetic_unit", "")
    if unit and unit not in MAGNETIC_UNITS:
        raise InputError(f"{place}: magnetic_unit is {unit!r}; give one of {', '.join(MAGNETIC_UNITS)} or leave it out")
    errors: SensorErrors = tables.build(SensorErrors, sigma, FORM, f"{place}.sigma")
    negative = [name for name, _, value in errors.entries() if value < 0.0]
    if negative:
        raise InputError(f"{place}.sigma: {negative[0]} has a negative entry; a standard deviation is positive, or 0")
    result: UnitCalibration = tables.build(UnitCalibration, values, form, place, sigma=errors)
    return result
