"""Other attitude filters with the same interface, for comparison.

They are compared by one call, which returns a table::

    print(filters.compare(record, process_noise, initial))

All of them estimate attitude and gyro bias from the same record, with the same order of measurements and the same model of the gyro, and
report their covariance in the body-side convention of the package, (δθ, δb). They differ in the definition of the error:

- ``mekf``: body side, ``q_true = q ⊗ exp(δθ)``, with the reset of the covariance (:mod:`strapdown.estimation.forward`; recommended);
- ``fixed-side``: ``q_true = exp(δφ) ⊗ q``, with its reset: the same filter in other coordinates;
- ``right-invariant``: fixed-side without a reset, the "imperfect" invariant filter (Barrau & Bonnabel 2017);
- ``two-frame``: right-invariant on the two-frames group, attitude and bias error both in fixed axes (Barrau & Bonnabel 2023);
- ``equivariant``: two-frame with the equivariant rows of directions (van Goor, Hamel & Mahony 2022; Fornasier et al. 2022);
- ``geometric``: bias error in a common frame, body side (Andrle & Crassidis 2015);
- ``schmidt``: body side, the gyro bias considered and not estimated (Schmidt 1966);
- ``usque``: unscented, generalised Rodrigues parameters (Crassidis & Markley 2003);
- ``mahony``: complementary, fixed gains (Mahony, Hamel & Pflimlin 2008).

Every filter accepts directions, vectors, headings and attitudes with every kind of noise (:mod:`strapdown.vectors`). Mahony's filter has
one gain per sensor, whatever the shape of its noise; the covariance that it reports is that of those gains under that noise.

They run over whole records only; for sample-by-sample processing use the MEKF (:class:`strapdown.estimation.StepFilter`).

A filter of your own can be compared with them (:mod:`strapdown.estimation.filters.own`). To add one to the package, write a module like
those of :mod:`strapdown.kernels.filters`, which defines its error, and enter it in :data:`FILTERS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, one_of
from strapdown.estimation import forward
from strapdown.estimation.filters import complementary, extended, unscented
from strapdown.estimation.filters.own import Own, OwnFilter, as_own
from strapdown.estimation.states import ProcessNoise, State
from strapdown.kernels.filters import equivariant, fixed_side, geometric, right_invariant, schmidt, two_frame
from strapdown.records import Estimate, ImuRecord, Truth
from strapdown.results import Listed, Listing, figure
from strapdown.units import DEGREE, DEGREE_PER_HOUR

__all__ = [
    "FILTERS",
    "OwnFilter",
    "compare",
    "run",
]


FILTERS: dict[str, Callable[..., Estimate]] = {
    "mekf": forward.run,
    "fixed-side": partial(extended.run, fixed_side),
    "right-invariant": partial(extended.run, right_invariant),
    "two-frame": partial(extended.run, two_frame),
    "equivariant": partial(extended.run, equivariant),
    "geometric": partial(extended.run, geometric),
    "schmidt": partial(extended.run, schmidt),
    "usque": unscented.run,
    "mahony": complementary.run,
}
"""Filters by name: functions with the arguments of :func:`run` after the name."""


def run(
    name: str,
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int = 1,
    full_covariance: bool = False,
) -> Estimate:
    """Run one filter over a whole record.

    Parameters
    ----------
    name : str
        One of :data:`FILTERS`.
    record : ImuRecord
        Record with measurements of any kind and noise.
    process_noise : ProcessNoise
        Angle random walk and rate random walk of the gyro, as the filter models them.
    initial : State
        State at the first edge, body side.
    every : int, default 1
        Store every n-th edge, the first included.
    full_covariance : bool, default False
        Store whole covariance matrices too.

    Returns
    -------
    Estimate
        Attitude and bias with their variances at the stored edges, and the innovations.

    Raises
    ------
    InputError
        If the name is unknown, or an argument is out of range.
    """
    one_of("filter", name, FILTERS)
    return FILTERS[name](record, process_noise, initial, every=every, full_covariance=full_covariance)


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

    def listing(self) -> Listing:
        """Return errors and the filter's σ, which should agree, as a table."""
        against = "error" if self.truth is not None else f"from {next(iter(self.estimates))}"
        found = self.summary()
        rows: list[tuple[str, ...]] = []
        for name, row in found.items():
            itself = self.truth is None and not rows  # no difference to report
            bias, bias_sigma = row["bias_error"] / DEGREE_PER_HOUR, row["bias_sigma"] / DEGREE_PER_HOUR
            angle = "-" if itself else figure(row["attitude_error"] / DEGREE)
            numbers = (row["attitude_sigma"] / DEGREE, math.nan if itself else bias, bias_sigma, row["nis"])
            over = [figure(row[key], 3) for key in ("attitude_over_bound", "bias_over_bound") if key in row]
            rows.append((name, angle, *map(figure, numbers), *over))
        bounded = self.bound is not None
        notes = [
            f"RMS over time and axes of the second half{'' if self.truth is None else '; error and σ should agree'}."
        ]
        if bounded:
            notes.append(
                "error/√bound: error over the root of the Cramér–Rao bound, about 1 on average for an efficient filter."
            )
        if degrees := max(row["degrees"] for row in found.values()):
            notes.append(
                f"NIS per degree of freedom: 1 ± {2.0 * math.sqrt(2.0 / degrees):.3f} for a consistent filter."
            )
        columns = ("filter", f"attitude {against}, °", "σ", f"bias {against}, °/h", "σ", "NIS")
        return Listing(
            "Filters over one record", (*columns, *(("error/√bound", "bias") if bounded else ())), rows, notes
        )


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


def compare(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    filters: Iterable[str | OwnFilter | Callable[[ImuRecord, State], Estimate]] = tuple(FILTERS),
    every: int = 1,
    full_covariance: bool = False,
    bound: ArrayLike | None = None,
) -> Comparison:
    """Run several filters over one record.

    One record shows how filters differ on it, not which are consistent: for that use :func:`strapdown.consistency.judge` on each estimate,
    or many runs (``sims/filter_family.py``).

    Parameters
    ----------
    record : ImuRecord
        Record; if it has a truth, errors are compared, otherwise the differences from the first filter.
    process_noise, initial : ProcessNoise, State
        As for :func:`run`, for all filters.
    filters : iterable of str or filter, default all of :data:`FILTERS`
        Names, and filters of your own (:mod:`strapdown.estimation.filters.own`). The unscented filter needs some tenths of a
        millisecond per step, the others a microsecond.
    every, full_covariance : int, bool
        As for :func:`run`.
    bound : array_like (n, 6, 6), optional
        Cramér–Rao bound at the stored edges (:attr:`strapdown.covariance.Analysis.cramer_rao`): errors are compared with its root.

    Returns
    -------
    Comparison
        Result, which prints as a table.

    Raises
    ------
    InputError
        If a name is unknown, or ``filters`` is empty.
    """
    chosen = [
        one if isinstance(one, str) else as_own(one) for one in ([filters] if isinstance(filters, str) else filters)
    ]
    if not chosen:
        raise InputError(f"filters is empty; name at least one of {', '.join(FILTERS)}")
    for one in chosen:
        if isinstance(one, str):
            one_of("filter", one, FILTERS)
    names = [one if isinstance(one, str) else one.name for one in chosen]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"filters has two of the name {min(twice)}; give yours another one by an attribute `name`")
    estimates = {
        name: one(record, initial, times=record.time[::every])
        if isinstance(one, Own)
        else run(one, record, process_noise, initial, every=every, full_covariance=full_covariance)
        for name, one in zip(names, chosen, strict=True)
    }
    truth = record.truth
    if bound is not None and truth is None:
        raise InputError(
            "bound is given, but the record has no truth, so there are no errors to compare with it; leave bound out"
        )
    least = None if bound is None else array("bound", bound, (len(record.time[::every]), 6, 6))
    kept = None if truth is None else Truth(attitude=truth.attitude[::every], bias=truth.bias[::every])
    return Comparison(estimates=estimates, truth=kept, bound=least)
