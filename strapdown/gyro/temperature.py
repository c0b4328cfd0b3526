"""Bias of a gyro over temperature: the polynomial identified by ``strapdown allan``, used by simulator and filter."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, InputError, array, finite, known_keys
from strapdown.files import tables
from strapdown.results import ByValue

STEM = "rad_per_s"


@dataclass(frozen=True, kw_only=True, eq=False)
class BiasOverTemperature(ByValue):
    """Bias of each axis over temperature, ``Σ c_k (T − T_0)^k``.

    Parameters
    ----------
    reference : float
        T_0, °C.
    span : (float, float)
        Lowest and highest temperature of the fit, °C; beyond them the bias is constant.
    coefficients : ndarray (order + 1, 3)
        c, rad/s/K^k.
    sigma : ndarray (order + 1, 3)
        Standard deviations of the coefficients; 0 for c_0, which the filter estimates.
    """

    reference: float
    span: tuple[float, float]
    coefficients: Array
    sigma: Array

    def powers(self, temperature: ArrayLike) -> Array:
        """Return ``(T − T_0)^k`` (..., order + 1) at temperatures (...), °C, within the span."""
        T = np.clip(np.asarray(temperature, np.float64), *self.span) - self.reference
        return np.asarray(T[..., None] ** np.arange(len(self.coefficients)))

    def bias(self, temperature: ArrayLike) -> Array:
        """Return the bias (..., 3), rad/s, at temperatures (...), °C."""
        return np.asarray(self.powers(temperature) @ self.coefficients)

    @property
    def slope_sigma(self) -> Array:
        """Maximum σ of the slope dbias/dT within the span (3,), rad/s/K, for independent errors of the coefficients."""
        reach = max(abs(end - self.reference) for end in self.span)
        k = np.arange(1, len(self.sigma))
        return np.asarray(np.sqrt((k * reach ** (k - 1)) ** 2 @ self.sigma[1:] ** 2))

    def walk(self, temperature: ArrayLike, time: ArrayLike) -> float:
        """Return a rate random walk, rad/s/√s, that bounds the error of the polynomial.

        The error depends on the temperature. At every stamp, the variance of the walk is at least that of the change of this error since
        the first stamp.
        """
        powers = self.powers(temperature)
        changed = np.max((powers - powers[0]) ** 2 @ self.sigma**2, axis=1)
        elapsed = np.asarray(time) - np.asarray(time)[0]
        return float(np.sqrt(np.max(changed[1:] / elapsed[1:], initial=0.0)))


def to_table(warm: BiasOverTemperature, stem: str = STEM) -> dict[str, Any]:
    """Return the polynomial as a table for TOML; ``stem`` is the unit of the bias in its keys."""
    table = {"reference_degc": warm.reference, "lowest_degc": warm.span[0], "highest_degc": warm.span[1]}
    keys = _keys(stem, len(warm.coefficients))
    return (
        table
        | {f"bias_{key}": row.tolist() for key, row in zip(keys, warm.coefficients, strict=True)}
        | {f"sigma_{key}": row.tolist() for key, row in zip(keys[1:], warm.sigma[1:], strict=True)}
    )


def from_table(table: Any, place: str = "temperature") -> BiasOverTemperature:
    """Return the polynomial of a table made by :func:`to_table`."""
    table = tables.subtable(table, place, ", as written by `strapdown allan`")
    keys = [key for key in _keys(STEM, len(table)) if key == STEM or f"bias_{key}" in table]
    limits = ("reference_degc", "lowest_degc", "highest_degc")
    needed = [*limits, *(f"bias_{key}" for key in keys), *(f"sigma_{key}" for key in keys[1:])]
    known_keys(place, table, dict.fromkeys([*needed, *(f"{term}_{STEM}_per_k" for term in ("bias", "sigma"))]))
    missing = [key for key in needed if key not in table]
    if missing:
        raise InputError(f"{place} lacks {', '.join(missing)}; `strapdown allan` writes a complete table")
    reference, lowest, highest = (finite(f"{place}: {key}", table[key]) for key in limits)
    if not lowest <= reference <= highest:
        raise InputError(f"{place}: reference_degc is {reference:g}, outside lowest_degc to highest_degc")
    rows = {key: array(f"{place}: {key}", table[key], (3,)) for key in needed[3:]}
    sigma = [rows[f"sigma_{key}"] for key in keys[1:]]
    return BiasOverTemperature(
        reference=reference,
        span=(lowest, highest),
        coefficients=np.array([rows[f"bias_{key}"] for key in keys]),
        sigma=np.array([np.zeros(3), *sigma]),
    )


def _keys(stem: str, number: int) -> list[str]:
    return [stem, f"{stem}_per_k", *(f"{stem}_per_k{k}" for k in range(2, number))][:number]


WRITER = "`strapdown allan` writes one, with the order of the polynomial as its temperature option"


def read(path: str | os.PathLike[str]) -> BiasOverTemperature:
    """Read the table ``[gyro.temperature]`` of a TOML file such as ``gyro-temperature.toml``."""

    def from_fit(table: Mapping[str, Any], place: str) -> BiasOverTemperature:
        if "temperature" not in table:
            raise InputError(f"{place} has no table [gyro.temperature]; {WRITER}")
        return from_table(table["temperature"], f"{place}: temperature")

    return tables.read(path, "gyro", WRITER, from_fit)  # type: ignore[no-any-return]
