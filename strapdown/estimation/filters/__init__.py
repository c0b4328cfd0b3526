"""Filters of your own, and their comparison with the package's, the MEKF.

They are compared by one call, which returns a table::

    print(filters.compare(record, process_noise, initial, filters=["mekf", mine]))

A filter of your own is a function or an object (:mod:`strapdown.estimation.filters.own`). Right-invariant, two-frame, equivariant,
geometric, unscented and complementary filters written in this way are in ``sims/filter_family.py``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from numpy.typing import ArrayLike

from strapdown.checks import InputError, array, one_of
from strapdown.estimation import forward
from strapdown.estimation.filters.comparison import Comparison as Comparison
from strapdown.estimation.filters.own import Own, OwnFilter, as_own
from strapdown.estimation.states import ProcessNoise, State
from strapdown.records import Estimate, ImuRecord, Truth

__all__ = [
    "OwnFilter",
    "compare",
]

MEKF = "mekf"
"""Name of the package's filter, :func:`strapdown.estimation.run`."""


def compare(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    filters: Iterable[str | OwnFilter | Callable[[ImuRecord, State], Estimate]],
    every: int = 1,
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
        As for :func:`strapdown.estimation.run`; a filter of your own does not get ``process_noise``.
    filters : iterable of str or filter
        ``"mekf"``, the package's, and filters of your own (:mod:`strapdown.estimation.filters.own`).
    every : int
        As for :func:`strapdown.estimation.run`.
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
        raise InputError("filters is empty; name at least one, mekf or your own")
    for estimator in estimators:
        if isinstance(estimator, str):
            one_of("filter", estimator, (MEKF,))
    names = [estimator if isinstance(estimator, str) else estimator.name for estimator in estimators]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"filters has two of the name {min(twice)}; give yours another one by an attribute `name`")
    estimates = {
        name: estimator(record, initial, times=record.time[::every])
        if isinstance(estimator, Own)
        else forward.run(record, process_noise, initial, every=every)
        for name, estimator in zip(names, estimators, strict=True)
    }
    truth = record.truth
    if bound is not None and truth is None:
        raise InputError(
            "bound is given, but the record has no truth, so there are no errors to compare with it; leave bound out"
        )
    least = None if bound is None else array("bound", bound, (len(record.time[::every]), 6, 6))
    kept = None if truth is None else truth.taken(slice(None, None, every))
    return Comparison(estimates=estimates, truth=kept, bound=least)
