"""The family of attitude filters on one interface.

They can be compared in one line::

    {name: family.run(name, record, process_noise, initial) for name in family.FILTERS}

All of them estimate attitude and gyro bias from the same record, by the same schedule of measurements, with the same belief of the gyro,
and report their covariance in the body-side convention of the package, (δθ, δb). They differ in how they define the error:

- ``mekf``: body side, ``q_true = q ⊗ exp(δθ)``, with the reset of the covariance (:mod:`strapdown.mekf`; the one to use);
- ``fixed-side``: ``q_true = exp(δφ) ⊗ q``, with its reset: the same filter in other coordinates;
- ``right-invariant``: fixed-side without a reset, the "imperfect" invariant filter (Barrau & Bonnabel 2017);
- ``two-frame``: right-invariant on the two-frames group, attitude and bias error both in fixed axes (Barrau & Bonnabel 2023);
- ``geometric``: bias error in a common frame, body side (Andrle & Crassidis 2015);
- ``usque``: unscented, generalised Rodrigues parameters (Crassidis & Markley 2003);
- ``mahony``: complementary, fixed gains (Mahony, Hamel & Pflimlin 2008).

Modules: ``stepping`` the schedule of steps, ``extended`` the Kalman filters, ``unscented``, ``complementary``.
"""

from __future__ import annotations

from typing import Protocol

from strapdown import mekf
from strapdown.checks import one_of
from strapdown.family import complementary, extended, unscented
from strapdown.mekf import ProcessNoise, State
from strapdown.records import Estimate, ImuRecord

__all__ = ["FILTERS", "Filter", "run"]


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
    "mekf": mekf.run,
    "fixed-side": extended.fixed_side,
    "right-invariant": extended.right_invariant,
    "two-frame": extended.two_frame,
    "geometric": extended.geometric,
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
    """Run one filter of the family over a whole record.

    Parameters
    ----------
    name : str
        One of :data:`FILTERS`.
    record : ImuRecord
        Measurements are directions, vectors or headings (``mekf`` takes what it takes); of ``mahony`` with one constant reference a series.
    process_noise : ProcessNoise
    initial : State
        State at the first edge, body side.
    every : int
        Keep the state at every ``every``-th edge, the first included.
    full_covariance : bool
        Keep whole covariance matrices too.

    Raises
    ------
    InputError
        If the name is not known, or the record holds what the filter does not take.
    """
    one_of("filter", name, FILTERS)
    return FILTERS[name](record, process_noise, initial, every=every, full_covariance=full_covariance)
