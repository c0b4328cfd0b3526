"""Several filters over one record, side by side, as numbers and as a table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array
from strapdown.records import Estimate, Truth
from strapdown.units import DEGREE, DEGREE_PER_HOUR


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Estimates of one record by several filters. Printed, it is a table.

    The numbers are of the second half of the record, when filters that find their way have found it: root mean squares over time and axes.
    """

    estimates: Mapping[str, Estimate]
    """Estimates by filter."""
    truth: Truth | None = None
    """At the times of the estimates."""
    bound: Array | None = None
    """Cramér–Rao bound (n, 6, 6) at those times."""

    def summary(self) -> dict[str, dict[str, float]]:
        """Return the numbers of each filter by name, in SI; what the record does not show is NaN.

        ``attitude_error`` and ``bias_error`` are against the truth, or without one the differences from the first filter;
        ``attitude_sigma`` and ``bias_sigma`` the filter's own σ; ``nis`` is the mean normalised innovation squared over the
        degrees of freedom, of which there are ``degrees``: 1 for a right filter, give or take √(2/degrees). With a bound,
        ``attitude_over_bound`` and ``bias_over_bound`` are the RMS of the errors over the root of the bound.
        """
        first = next(iter(self.estimates.values()))
        attitude, bias = (first.attitude, first.bias) if self.truth is None else (self.truth.attitude, self.truth.bias)
        late = first.time >= 0.5 * (first.time[0] + first.time[-1])
        result = {}
        for name, estimate in self.estimates.items():
            turn = quaternion.log(quaternion.multiply(quaternion.conjugate(estimate.attitude), attitude))
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

    def __str__(self) -> str:
        """Return the table: errors beside the filter's own σ, which should agree."""
        against = "error" if self.truth is not None else f"from {next(iter(self.estimates))}"
        head = f"{'filter':16s} {'attitude, °: ' + against:>25s} {'σ':>9s} {'bias, °/h: ' + against:>25s} {'σ':>9s} {'NIS':>9s}"
        lines = [head if self.bound is None else f"{head}   error/√bound"]
        degrees = 0.0
        for name, row in self.summary().items():
            degrees = max(degrees, row["degrees"])
            errors = f"{row['attitude_error'] / DEGREE:.4g}", f"{row['bias_error'] / DEGREE_PER_HOUR:.4g}"
            if self.truth is None and len(lines) == 1:  # from itself
                errors = "-", "-"
            lines.append(
                f"{name:16s} {errors[0]:>25s} {row['attitude_sigma'] / DEGREE:9.4g} "
                f"{errors[1]:>25s} {row['bias_sigma'] / DEGREE_PER_HOUR:9.4g} {row['nis']:9.4g}"
                + (
                    f"   {row['attitude_over_bound']:.3f} {row['bias_over_bound']:.3f}"
                    if "bias_over_bound" in row
                    else ""
                )
            )
        lines.append(
            f"RMS over time and axes of the second half{'' if self.truth is None else '; error and σ should agree'}."
        )
        if self.bound is not None:
            lines.append(
                "error/√bound: of attitude and bias, over the root of the Cramér–Rao bound; about 1 over many runs, of the best."
            )
        if degrees:
            lines.append(
                f"NIS a degree of freedom: {1.0:.3f} ± {2.0 * math.sqrt(2.0 / degrees):.3f} of a right filter."
            )
        return "\n".join(lines)


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
