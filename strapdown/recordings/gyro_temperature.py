"""Bias of a gyro over temperature, as ``strapdown allan --temperature`` identifies it, subtracted from a recording with temperatures.

The table ``[gyro]`` of its file holds the polynomial's coefficients and their σ.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from strapdown.checks import Array, InputError, array, finite
from strapdown.files import tables
from strapdown.recordings.recording import Recording

STEM = "rad_per_s"


@dataclass(frozen=True, kw_only=True, eq=False)
class BiasOverTemperature:
    """``bias = Σ c_k (T − T_0)^k`` of each axis, rad/s."""

    reference: float
    """T_0, °C."""
    span: tuple[float, float]
    """Lowest and highest temperature that it holds for, °C; beyond them it is that of the end."""
    coefficients: Array
    """c (order + 1, 3), rad/s/K^k."""
    sigma: Array
    """σ of each (order + 1, 3); 0 of c_0, which the filter estimates."""

    def applied(self, recording: Recording) -> tuple[Recording, float]:
        """Return a recording without this bias, and the rate random walk, rad/s/√s, that covers what σ leaves of it.

        The error of the polynomial follows the temperature: the walk's variance is at every stamp at least that of its change since the
        first one.
        """
        T = recording.temperature
        if T is None or not np.isfinite(T).all():
            raise InputError(
                f"{recording.source} has no temperature for every sample, over which the gyro's bias is given"
            )
        powers = (np.clip(T, *self.span) - self.reference)[:, None] ** np.arange(len(self.coefficients))
        beyond = int(np.sum((self.span[0] > T) | (self.span[1] < T)))
        words = "The gyro's bias over temperature is subtracted; estimated is what is left."
        if beyond:
            words += (
                f" {beyond} samples are beyond {self.span[0]:.4g} to {self.span[1]:.4g} °C and take that of the end."
            )
        changed = np.max((powers - powers[0]) ** 2 @ self.sigma**2, axis=1)
        elapsed = recording.time - recording.time[0]
        walk = float(np.sqrt(np.max(changed[1:] / elapsed[1:], initial=0.0)))
        rate = recording.rate - powers @ self.coefficients
        return replace(recording, rate=rate, remarks=(*recording.remarks, words)), walk


def read(path: str | os.PathLike[str]) -> BiasOverTemperature:
    """Read the table ``[gyro]`` of ``gyro-temperature.toml``."""
    return tables.read(path, "gyro", "`strapdown allan --temperature` writes one", _from_table)


def _from_table(table: Mapping[str, Any], place: str) -> BiasOverTemperature:
    names = [STEM, f"{STEM}_per_k", *(f"{STEM}_per_k{k}" for k in range(2, len(table)))]
    powers = [name for name in names if name == STEM or f"bias_{name}" in table]
    needed = ["reference_degc", "lowest_degc", "highest_degc", f"bias_{STEM}", *(f"sigma_{one}" for one in powers[1:])]
    missing = [key for key in needed if key not in table]
    if missing:
        raise InputError(f"{place} lacks {', '.join(missing)}")
    rows = [array(f"{place}: bias_{power}", table[f"bias_{power}"], (3,)) for power in powers]
    sigma = [array(f"{place}: sigma_{power}", table[f"sigma_{power}"], (3,)) for power in powers[1:]]
    limits = [finite(f"{place}: {key}", table[key]) for key in ("reference_degc", "lowest_degc", "highest_degc")]
    if not limits[1] <= limits[0] <= limits[2]:
        raise InputError(f"{place}: reference_degc is {limits[0]:g}, outside lowest_degc to highest_degc")
    return BiasOverTemperature(
        reference=limits[0],
        span=(limits[1], limits[2]),
        coefficients=np.array(rows),
        sigma=np.array([np.zeros(3), *sigma]),
    )
