"""What the filter over records has and a filter of single samples, or an exported one, has not: one list for refusals and documentation."""

from __future__ import annotations

from typing import NamedTuple

from strapdown.checks import InputError


class Feature(NamedTuple):
    """A feature of the filter over records, which no exported filter has."""

    words: str
    live: bool
    """Whether :class:`strapdown.LiveFilter` has it."""
    remedy: str
    """What to do without it."""


FEATURES = {
    "temperature": Feature("bias driven by temperature", False, "leave the gyro temperature states out"),
    "record": Feature(
        "lever arms or effects relative to a varying field magnitude, which need the whole record",
        False,
        "use estimation.run for them",
    ),
    "estimator": Feature("estimator but the mekf", False, "use the mekf, or the other one over records"),
    "integration": Feature(
        "coning algorithm of several gyro samples",
        False,
        "use one-sample, or correct the increments for coning before they are given to it",
    ),
    "robust": Feature("robust updates, which iterate a weight", True, "use a gate, or none"),
    "varying": Feature("noise or reference that varies from sample to sample", True, "give one for all"),
}


def refuse(who: str, **used: bool) -> None:
    """Raise an error if a feature of :data:`FEATURES` is used that a filter does not have."""
    for name in filter(used.__getitem__, used):
        raise InputError(f"{who} has no {FEATURES[name].words}; {FEATURES[name].remedy}")
