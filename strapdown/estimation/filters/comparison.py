"""Several filters over one record, compared in numbers and in a table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array
from strapdown.records import Estimate, Truth
from strapdown.results import Column, Listed, Table
from strapdown.units import DEGREE, DEGREE_PER_HOUR


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison(Listed):
    """Estimates of one record by several filters. Printed, it is a table.

    The numbers are root mean squares over time and axes in the second half of the record, after convergence.
    """

    estimates: Mapping[str, Estimate]
    """Estimates by filter."""
    truth: Truth | None = None
    """Truth at the times of the estimates."""
    bound: Array | None = None
    """Cramér–Rao bound (n, 6, 6) at those times."""

    def summary(self) -> dict[str, dict[str, float]]:
        """Return the numbers of each filter by name, in SI; NaN if not available.

        ``attitude_error`` and ``bias_error`` are relative to the truth, or without one to the first filter; ``attitude_sigma`` and
        ``bias_sigma`` are the filter's σ; ``nis`` is the mean normalised innovation squared over the ``degrees`` of freedom, which is
        1 ± √(2/degrees) for a consistent filter. With a bound, ``attitude_over_bound`` and ``bias_over_bound`` are the RMS of the
        errors over the root of the bound.
        """
        first = next(iter(self.estimates.values()))
        attitude, bias = (first.attitude, first.bias) if self.truth is None else (self.truth.attitude, self.truth.bias)
        late = first.time >= 0.5 * (first.time[0] + first.time[-1])
        result = {}
        for name, estimate in self.estimates.items():
            turn = quaternion.rotation_between(estimate.attitude, attitude)
            total, degrees = _nis(estimate, float(first.time[late][0]))
            result[name] = {
                "attitude_error": _root_mean_square(turn[late]),
                "attitude_sigma": _root_mean_square(estimate.sigma[late, :3]),
                "bias_error": _root_mean_square((bias - estimate.bias)[late]),
                "bias_sigma": _root_mean_square(estimate.sigma[late, 3:]),
                "nis": total / degrees if degrees else math.nan,
                "degrees": float(degrees),
            }
            if self.bound is not None:
                least = np.sqrt(np.diagonal(self.bound, axis1=1, axis2=2))
                result[name]["attitude_over_bound"] = _root_mean_square((turn / least[:, :3])[late])
                result[name]["bias_over_bound"] = _root_mean_square(((bias - estimate.bias) / least[:, 3:])[late])
        return result

    def listing(self) -> Table:
        """Return errors and the filter's σ, which should agree, as a table."""
        against = "error" if self.truth is not None else f"from {next(iter(self.estimates))}"
        summary = self.summary()
        rows: list[tuple[Any, ...]] = []
        for name, row in summary.items():
            itself = self.truth is None and not rows  # no difference to report
            bias, bias_sigma = row["bias_error"] / DEGREE_PER_HOUR, row["bias_sigma"] / DEGREE_PER_HOUR
            angle = None if itself else row["attitude_error"] / DEGREE
            numbers = (row["attitude_sigma"] / DEGREE, math.nan if itself else bias, bias_sigma, row["nis"])
            over = [row[key] for key in ("attitude_over_bound", "bias_over_bound") if key in row]
            rows.append((name, angle, *numbers, *over))
        bounded = self.bound is not None
        notes = [
            f"RMS over time and axes of the second half{'' if self.truth is None else '; error and σ should agree'}."
        ]
        if bounded:
            notes.append(
                "error/√bound: error over the root of the Cramér–Rao bound, about 1 on average for an efficient filter."
            )
        if degrees := max(row["degrees"] for row in summary.values()):
            notes.append(
                f"NIS per degree of freedom: 1 ± {2.0 * math.sqrt(2.0 / degrees):.3f} for a consistent filter."
            )
        columns: list[str | Column] = ["filter", f"attitude {against}, °", "σ", f"bias {against}, °/h", "σ", "NIS"]
        columns += [Column("error/√bound", digits=3), Column("bias", digits=3)] if bounded else []
        return Table("Filters over one record", columns, rows, notes)


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _nis(estimate: Estimate, start: float) -> tuple[float, int]:
    """Return the sum of the NIS of all measurements from a time on, and their degrees of freedom."""
    total, degrees = 0.0, 0
    for innovations in estimate.innovations.values():
        late = innovations.time >= start
        total += float(np.sum(innovations.nis[late]))
        degrees += innovations.innovation[late].size
    return total, degrees
