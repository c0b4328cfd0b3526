"""The MEKF and a complementary filter with the same interface, and filters of your own, for comparison.

They are compared by one call, which returns a table::

    print(filters.compare(record, process_noise, initial))

- ``mekf``: multiplicative extended Kalman filter (:mod:`strapdown.estimation.forward`; recommended);
- ``mahony``: complementary, fixed gains (Mahony, Hamel & Pflimlin 2008).

Both estimate attitude and gyro bias from the same record, with the same order of measurements and the same model of the gyro, and report
their covariance in the body-side convention of the package, (δθ, δb). Both accept directions, vectors, headings and attitudes with every
kind of noise (:mod:`strapdown.vectors`). Mahony's filter has one gain per sensor, whatever the shape of its noise; the covariance that it
reports is that of those gains under that noise. They run over whole records only; for sample-by-sample processing use the MEKF
(:class:`strapdown.estimation.StepFilter`).

A filter of your own is compared with them by :mod:`strapdown.estimation.filters.own`; right-invariant, two-frame, equivariant, geometric
and unscented filters written in this way are in ``sims/filter_family.py``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from numpy.typing import ArrayLike

from strapdown.checks import InputError, array, one_of
from strapdown.estimation import forward
from strapdown.estimation.filters import complementary
from strapdown.estimation.filters.comparison import Comparison as Comparison
from strapdown.estimation.filters.own import Own, OwnFilter, as_own
from strapdown.estimation.states import ProcessNoise, State
from strapdown.records import Estimate, ImuRecord, Truth

__all__ = [
    "FILTERS",
    "OwnFilter",
    "compare",
    "run",
]


FILTERS: dict[str, Callable[..., Estimate]] = {
    "mekf": forward.run,
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
        Names, and filters of your own (:mod:`strapdown.estimation.filters.own`).
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
    estimators = [
        name if isinstance(name, str) else as_own(name) for name in ([filters] if isinstance(filters, str) else filters)
    ]
    if not estimators:
        raise InputError(f"filters is empty; name at least one of {', '.join(FILTERS)}")
    for estimator in estimators:
        if isinstance(estimator, str):
            one_of("filter", estimator, FILTERS)
    names = [estimator if isinstance(estimator, str) else estimator.name for estimator in estimators]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"filters has two of the name {min(twice)}; give yours another one by an attribute `name`")
    estimates = {
        name: estimator(record, initial, times=record.time[::every])
        if isinstance(estimator, Own)
        else run(estimator, record, process_noise, initial, every=every, full_covariance=full_covariance)
        for name, estimator in zip(names, estimators, strict=True)
    }
    truth = record.truth
    if bound is not None and truth is None:
        raise InputError(
            "bound is given, but the record has no truth, so there are no errors to compare with it; leave bound out"
        )
    least = None if bound is None else array("bound", bound, (len(record.time[::every]), 6, 6))
    kept = None if truth is None else Truth(attitude=truth.attitude[::every], bias=truth.bias[::every])
    return Comparison(estimates=estimates, truth=kept, bound=least)
