"""Attitude drift due to coning, in closed form, and its sum over a vibration spectrum."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from strapdown import checks
from strapdown.checks import InputError
from strapdown.coning.algorithms import Algorithm, named
from strapdown.files import reading, tables
from strapdown.results import Column, Table
from strapdown.units import DEGREE, DEGREE_PER_HOUR


def predicted_coning_drift(algorithm: str | Algorithm, angle: float, frequency: float, sample_interval: float) -> float:
    """Return the leading term of the attitude drift under coning, for a small angle.

    Parameters
    ----------
    algorithm : str or Algorithm
        Name in :data:`ALGORITHMS`, or an algorithm.
    angle : float
        Half-angle β of the cone, rad.
    frequency : float
        Coning frequency, Hz; ω = 2π × frequency.
    sample_interval : float
        h, s; λ = ωh.

    Returns
    -------
    float
        Drift about the cone's axis, rad/s: −C β² ω λ^(drift order), which for M = N + p compressed samples is −c_M β² ω λ^(2M),
        c_M = (M!)²/(2(2M+1)!) (Miller 1983; Ignagni 1996). For one sample without correction, −½ sin²β ω (1 − sin λ/λ) for any λ, also
        without the terms of order β⁴: with ten samples per turn, 0.1 % too small at β = 17° and 0.6 % at 45°.

    Examples
    --------
    >>> from strapdown.units import DEGREE, DEGREE_PER_HOUR
    >>> drift = predicted_coning_drift("two-sample", angle=0.7 * DEGREE, frequency=10.0, sample_interval=0.01)
    >>> print(f"{drift / DEGREE_PER_HOUR:.2f} °/h")
    -5.02 °/h
    """
    table = named(algorithm)
    beta = checks.finite("angle", angle, unit="rad")
    omega = 2.0 * math.pi * checks.positive("frequency", frequency, unit="Hz")
    lam = omega * checks.positive("sample_interval", sample_interval, unit="s")
    if table.window == 1 and table.solver == "compressed":
        return -0.5 * math.sin(beta) ** 2 * omega * (1.0 - math.sin(lam) / lam)
    return -float(table.drift_constant) * beta**2 * omega * lam**table.drift_order


def small_angle_drift(algorithm: str | Algorithm, frequency_ratio: float) -> float:
    """Return the drift divided by β²ω for small β, from the full power series in λ = ω × sample interval, 0 to 1."""
    table = named(algorithm)
    lam = checks.non_negative("frequency_ratio", frequency_ratio)
    if lam > 1.0:
        raise InputError(f"frequency_ratio is {lam:g}; the series is valid up to 1 (6 samples a period): sample faster")
    return float(np.polynomial.polynomial.polyval(lam * lam, table.drift_series))


@dataclass(frozen=True, kw_only=True)
class VibrationLine:
    """One line of an angular vibration spectrum: two orthogonal axes at one frequency."""

    frequency: float
    """Frequency, Hz."""
    angle: float
    """Amplitude about the first axis, rad."""
    angle_across: float | None = None
    """Amplitude about the second axis, rad. Default: ``angle``."""
    phase: float = 0.5 * math.pi
    """Phase lag of the second axis behind the first, rad; π/2 is coning, 0 or π rocking without drift."""

    def __post_init__(self) -> None:
        checks.positive("frequency", self.frequency, unit="Hz")
        checks.non_negative("angle", self.angle, unit="rad")
        if self.angle_across is not None:
            checks.non_negative("angle_across", self.angle_across, unit="rad")
        checks.finite("phase", self.phase, unit="rad")

    @property
    def coning_square(self) -> float:
        """β² of the circular coning with the same drift: θ_x θ_y sin(phase), rad²."""
        across = self.angle if self.angle_across is None else self.angle_across
        return self.angle * across * math.sin(self.phase)


BUDGETED = ("one-sample", "two-sample", "four-sample", "matched-4-11", "matched-1-8-8")
"""Default algorithms of a drift budget."""


def vibration_drift(lines: Sequence[VibrationLine], algorithm: str | Algorithm, sample_rate: float) -> float:
    """Return the drift about the third axis, rad/s, due to a vibration spectrum, for an algorithm and a sample rate, Hz.

    The products of lines at different frequencies average to zero, so the drifts of the lines add. Angles are assumed small: only the term
    in β² of each drift is included. The β⁴ error floor of rotation-vector algorithms is additional; it matters above about one degree.
    """
    table, rate = named(algorithm), checks.positive("sample rate", sample_rate, unit="Hz")
    omegas = [2.0 * math.pi * line.frequency for line in lines]
    if max(omegas, default=0.0) > rate:
        raise InputError(
            f"sample rate {rate:g} Hz is below 2π × the highest line, {max(omegas) / (2.0 * math.pi):g} Hz, where the drift series is not "
            f"valid; sample at {max(omegas):.4g} Hz or more, or leave out the line"
        )
    drifts = (
        line.coning_square * w * small_angle_drift(table, w / rate) for line, w in zip(lines, omegas, strict=True)
    )
    return math.fsum(drifts)


_FORM = {"frequency": tables.HERTZ, **dict.fromkeys(("angle", "angle_across", "phase"), tables.DEGREES)}


def read_vibration(path: str | os.PathLike[str]) -> tuple[VibrationLine, ...]:
    """Read vibration lines from CSV with the columns ``frequency_hz, angle_deg[, angle_across_deg][, phase_deg]``."""
    file = Path(path)
    with reading.from_file(file):
        text = reading.text(file).splitlines()
        rows = csv.reader(line for line in text if line.strip() and not line.lstrip().startswith("#"))
        names = [name.strip() for name in next(rows, [])]
        lines: list[VibrationLine] = []
        for k, row in enumerate(rows):
            place = f"{file.name}: data row {k + 1}"
            if len(row) != len(names):
                raise InputError(f"{place} has {len(row)} fields, the header {len(names)}")
            cells = {name: _number(f"{place}, {name}", field) for name, field in zip(names, row, strict=True)}
            lines.append(tables.build(VibrationLine, cells, _FORM, place))
        if not lines:
            raise InputError(f"{file.name} has no lines below a header; give {', '.join(tables.keys(_FORM))}")
        largest = max(max(line.angle, line.angle_across or 0.0) for line in lines)
        if largest >= 90.0 * DEGREE:
            raise InputError(
                f"{file} has an amplitude of {largest / DEGREE:.4g}°, but that of a vibration is below 90°; check the unit"
            )
        return tuple(lines)


def _number(name: str, field: str) -> float:
    try:
        return checks.finite(name, float(field))
    except ValueError:
        raise InputError(f"{name} is {field!r}, not a finite number") from None


def vibration_table(
    lines: Sequence[VibrationLine], sample_rates: Sequence[float], algorithms: Sequence[str] | None = None
) -> Table:
    """Return the drift due to a vibration spectrum as a table, for each algorithm and sample rate, Hz."""
    rows = [
        (name, rate, vibration_drift(lines, name, rate) / DEGREE_PER_HOUR)
        for name in algorithms or BUDGETED
        for rate in sample_rates
    ]
    columns = (
        Column("algorithm", "algorithm"),
        Column("sample rate, Hz", "sample_rate_hz", 6),
        Column("drift, °/h", "drift_deg_per_hour"),
    )
    title = f"Drift about the third axis caused by {len(lines)} vibration lines"
    return Table(title, columns, rows, name="coning-budget")
