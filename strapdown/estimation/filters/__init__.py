"""Other attitude filters on one interface.

They can be compared in one line, which prints a table::

    print(filters.compare(record, process_noise, initial))

All of them estimate attitude and gyro bias from the same record, by the same schedule of measurements, with the same model of the gyro,
and report their covariance in the body-side convention of the package, (δθ, δb). They differ in how they define the error:

- ``mekf``: body side, ``q_true = q ⊗ exp(δθ)``, with the reset of the covariance (:mod:`strapdown.estimation.forward`; the one to use);
- ``fixed-side``: ``q_true = exp(δφ) ⊗ q``, with its reset: the same filter in other coordinates;
- ``right-invariant``: fixed-side without a reset, the "imperfect" invariant filter (Barrau & Bonnabel 2017);
- ``two-frame``: right-invariant on the two-frames group, attitude and bias error both in fixed axes (Barrau & Bonnabel 2023);
- ``equivariant``: that of two-frame, with the equivariant rows of directions (van Goor, Hamel & Mahony 2022; Fornasier et al. 2022);
- ``geometric``: bias error in a common frame, body side (Andrle & Crassidis 2015);
- ``schmidt``: body side, the gyro bias considered and not estimated (Schmidt 1966);
- ``usque``: unscented, generalised Rodrigues parameters (Crassidis & Markley 2003);
- ``mahony``: complementary, fixed gains (Mahony, Hamel & Pflimlin 2008).

Every filter takes directions, vectors, headings and attitudes with every form of noise (:mod:`strapdown.vectors`). Mahony's gains are
one number a sensor, whatever the shape of its noise; the covariance that it reports is that of those gains under that noise.

They run over whole records only: sample by sample the MEKF is there (:class:`strapdown.estimation.StepFilter`).

To add a filter, write a module like those of :mod:`strapdown.kernels.filters`, which defines its error, and enter it in :data:`FILTERS`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Protocol

from strapdown.checks import InputError, one_of
from strapdown.estimation import forward
from strapdown.estimation.filters import complementary, extended, unscented
from strapdown.estimation.filters.comparison import Comparison as Comparison
from strapdown.estimation.states import ProcessNoise, State
from strapdown.kernels.filters import equivariant, fixed_side, geometric, right_invariant, schmidt, two_frame
from strapdown.records import Estimate, ImuRecord, Truth

__all__ = [
    "FILTERS",
    "compare",
    "run",
]


class Filter(Protocol):
    """What runs a filter over a record."""

    def __call__(
        self,
        record: ImuRecord,
        process_noise: ProcessNoise,
        initial: State,
        *,
        every: int = 1,
        full_covariance: bool = False,
    ) -> Estimate:
        """Return the estimate at every ``every``-th edge."""


FILTERS: dict[str, Filter] = {
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
"""The filters by name."""


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
        With measurements of any kind and noise.
    process_noise : ProcessNoise
    initial : State
        State at the first edge, body side.
    every : int, default 1
        Store every n-th edge, the first included.
    full_covariance : bool, default False
        Store whole covariance matrices too.

    Returns
    -------
    Estimate

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
    filters: Iterable[str] = tuple(FILTERS),
    every: int = 1,
    full_covariance: bool = False,
) -> Comparison:
    """Run several filters over one record.

    One record shows how filters differ on it, not which are consistent: for that use :func:`strapdown.consistency.judge` on each estimate,
    or many runs (``sims/filter_family.py``).

    Parameters
    ----------
    record : ImuRecord
        With its truth, errors are compared; without it, the differences from the first filter.
    process_noise, initial, every, full_covariance
        As of :func:`run`.
    filters : iterable of str, default all of :data:`FILTERS`
        The unscented filter needs some tenths of a millisecond a step, the others a microsecond.

    Returns
    -------
    Comparison
        Prints as a table.

    Raises
    ------
    InputError
        If a name is unknown, or ``filters`` is empty.
    """
    names = [filters] if isinstance(filters, str) else list(filters)
    if not names:
        raise InputError(f"filters is empty; name at least one of {', '.join(FILTERS)}")
    for name in names:
        one_of("filter", name, FILTERS)
    estimates = {
        name: run(name, record, process_noise, initial, every=every, full_covariance=full_covariance) for name in names
    }
    truth = record.truth
    kept = None if truth is None else Truth(attitude=truth.attitude[::every], bias=truth.bias[::every])
    return Comparison(estimates=estimates, truth=kept)
