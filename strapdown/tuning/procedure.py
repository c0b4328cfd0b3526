"""A whole tuning: which objective, the search with its intervals, and what each objective leaves to be done after it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from strapdown.checks import InputError, non_negative
from strapdown.records import ImuRecord
from strapdown.setup import FilterSetup
from strapdown.tuning import extended
from strapdown.tuning.errors import error_objective
from strapdown.tuning.fitting import Objective, Tuning, fit, rescaled
from strapdown.tuning.innovations import Case, likelihood
from strapdown.tuning.outliers import TunedGate, contaminated_likelihood, tuned_gate
from strapdown.tuning.parameters import (
    OUTLIER_SCALE,
    OUTLIER_SHARE,
    Prior,
    Unit,
    axis_of,
    default_names,
    known_names,
    unit_of,
)

GATED = ("gate.probability", "outliers.share", "outliers.scale")
"""Names of parameters that ask for a model of outliers."""


class Tuned(NamedTuple):
    """The outcome of :func:`tune`.

    Parameters
    ----------
    tuning : Tuning
        Parameters with their intervals, and the tuned filter.
    objective : Objective
        Function that was minimised, for :func:`fit` again or slices of it.
    gate : TunedGate or None
        The gate found where outliers were modelled, else None.
    """

    tuning: Tuning
    objective: Objective
    gate: TunedGate | None


def objective_for(
    cases: Sequence[Case],
    setup: FilterSetup,
    names: Sequence[str],
    *,
    truth: bool = False,
    rmse: bool = False,
    gate: bool = False,
    spacing: float = 0.0,
    threads: int = 1,
) -> Objective:
    """Return the objective of a tuning, for :func:`fit`: by default the likelihood of the innovations.

    With error states, or with a σ of one axis in ``names``, it is that of :mod:`strapdown.tuning.extended`; ``truth`` that of the errors
    against the truth, of the filter as it runs, its gate included; ``rmse`` the RMS attitude error. Innovations are those of the filter
    without its gate, because what passes one is the likelier the narrower it is; ``gate`` models outliers. ``spacing`` is the least time
    between the samples of a sensor that are used, s.
    """
    non_negative("spacing", spacing, unit="s")
    if rmse and truth:
        raise InputError("rmse and truth both say which errors against the truth count; give one of them")
    other = truth or rmse
    if spacing > 0.0 and other:
        raise InputError(
            "spacing thins the innovations of the likelihood; against a truth there are none to thin: leave it out"
        )
    if gate and (other or spacing > 0.0):
        raise InputError("gate needs the likelihood of all innovations: leave truth, rmse and spacing out")
    by_axis = any(axis_of(name) for name in names)
    for whole, what in (
        (setup.states is None, "a filter with optional states"),
        (not by_axis, "a sigma of one axis"),
    ):
        if not whole and (gate or rmse or spacing > 0.0):
            raise InputError(
                f"{what} is tuned by the likelihood of all innovations, or of the errors (truth): leave gate, rmse and spacing out"
            )
    if not other and (setup.states is not None or by_axis):
        return extended.likelihood(cases, setup, names, threads=threads)
    if gate:
        return contaminated_likelihood(cases, setup, names)
    if truth or rmse:
        return error_objective(cases, setup, names, measure="rmse" if rmse else "likelihood", threads=threads)
    return likelihood(cases, setup, names, spacing=spacing)


def with_units(found: Tuning, records: Sequence[ImuRecord]) -> Tuning:
    """Return a tuning whose parameters are printed in units that suit the sensors of these records."""

    def unit(name: str) -> Unit:
        plain = name in (*known_names(records), OUTLIER_SHARE, OUTLIER_SCALE) or axis_of(name) is not None
        return unit_of(name, records) if plain else extended.unit_of(name)

    shown = tuple(dataclasses.replace(one, unit=unit(one.name)) for one in found.parameters)
    return dataclasses.replace(found, parameters=shown)


def tune(
    cases: Sequence[Case],
    setup: FilterSetup,
    names: Sequence[str] | None = None,
    *,
    priors: Mapping[str, Prior] | None = None,
    starts: int = 4,
    factor: float = 30.0,
    seed: int = 0,
    threads: int = 1,
    progress: Callable[[int], None] | None = None,
    gate: bool = False,
    **objective: Any,
) -> Tuned:
    """Tune a filter: the objective, the search, and with ``rmse`` the common scale of all σ, with ``gate`` the filter's gate.

    Parameters
    ----------
    cases : sequence of Case
        Records with their initial states (:func:`record_case`, :func:`recording_case`).
    setup : FilterSetup
        The filter to start from.
    names : sequence of str, optional
        Parameters to tune; those of :data:`GATED` ask for ``gate``. Default: :func:`default_names`.
    priors : mapping of str to Prior, optional
        Prior knowledge by parameter; the result is then the maximum of the posterior density.
    starts : int, default 4
        Searches: the first from the setup's own values, the others from random starts.
    factor : float, default 30
        Random starts differ from the setup's values by factors of up to this, either way.
    seed : int, default 0
        Seed of the random starts.
    threads : int, default 1
        Searches, or records, computed at once.
    progress : callable, optional
        As of :func:`fit`.
    gate : bool, default False
        Model outliers too, and set the gate where an outlier is the likelier explanation.
    **objective
        ``truth``, ``rmse``, ``spacing`` of :func:`objective_for`.

    Returns
    -------
    Tuned
        The tuning, whose ``setup`` is the tuned filter, the objective, and the gate.

    Raises
    ------
    InputError
        If options exclude each other, a parameter is unknown, or the search does not converge.
    """
    gate = gate or any(name in GATED for name in names or ())
    wanted = [name for name in names or () if name not in GATED] or list(default_names([case.record for case in cases]))
    made = objective_for(cases, setup, wanted, gate=gate, threads=threads, **objective)
    # Objectives that filter the records in threads of their own are searched one start at a time.
    plain = gate or not (
        any(objective.get(name) for name in ("truth", "rmse")) or isinstance(made, extended.ExtendedLikelihood)
    )
    result = fit(
        made,
        priors=priors,
        starts=starts,
        factor=factor,
        seed=seed,
        threads=threads if plain else 1,
        progress=progress,
    )
    if objective.get("rmse"):
        # The size of the error leaves a common scale open; the innovations determine it.
        scaled = fit(likelihood(cases, result.setup, ["filter.scale"]), starts=2, threads=threads)
        result = rescaled(result, scaled["filter.scale"].value)
    result = with_units(result, [case.record for case in cases])
    found = tuned_gate(made, result) if gate else None  # type: ignore[arg-type]
    if found is not None and found.gate is not None:
        result = dataclasses.replace(result, setup=dataclasses.replace(result.setup, gate=found.gate))
    return Tuned(result, made, found)
