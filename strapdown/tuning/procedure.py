"""A complete tuning: choice of the objective, search with intervals, and the steps after it for each objective."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from strapdown.checks import InputError
from strapdown.estimation.setup import FilterSetup
from strapdown.tuning.errors import error_objective
from strapdown.tuning.fitting import Tuning, fit
from strapdown.tuning.innovations import Likelihood, likelihood
from strapdown.tuning.objective import OUTLIERS, Case, Objective
from strapdown.tuning.outliers import contaminated_likelihood, log_likelihood, tuned_gate
from strapdown.tuning.parameters import Prior, default_names
from strapdown.tuning.residual_checks import examined, with_misfit_flag
from strapdown.tuning.validation import Comparison, compare

GATED = ("gate.probability", *OUTLIERS)
"""Names of parameters that need a model of outliers."""


def objective_for(
    cases: Sequence[Case],
    setup: FilterSetup,
    names: Sequence[str],
    *,
    truth: bool = False,
    gate: bool = False,
    spacing: float = 0.0,
    threads: int = 1,
) -> Objective:
    """Return the objective of a tuning, for :func:`fit`: by default the likelihood of the innovations.

    ``truth``: likelihood of the errors against the truth, of the filter as used, including its gate. Innovations are those of the filter
    without its gate, because the likelihood of accepted ones increases as the gate becomes narrower; ``gate``: model outliers. ``spacing``:
    minimum time between the samples of a sensor that are used, s.
    """
    if spacing > 0.0 and truth:
        raise InputError(
            "spacing thins the innovations of the likelihood; against a truth there are none to thin: leave it out"
        )
    if gate and (truth or spacing > 0.0):
        raise InputError("gate needs the likelihood of all innovations: leave truth and spacing out")
    if truth:
        return error_objective(cases, setup, names, threads=threads)
    objective = (
        contaminated_likelihood(cases, setup, names, threads=threads)
        if gate
        else likelihood(cases, setup, names, spacing=spacing, threads=threads)
    )
    # If eight points run at once, the threads run searches, otherwise records and points.
    return dataclasses.replace(objective, threads=1) if isinstance(objective, Likelihood) else objective


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
    progress: Callable[[str], None] | None = None,
    gate: bool = False,
    held: Sequence[Case] = (),
    truth: bool = False,
    spacing: float = 0.0,
) -> Tuning:
    """Tune a filter: the objective, the search, and with ``gate`` the filter's gate.

    Parameters
    ----------
    cases : sequence of Case
        Records with their initial states (:func:`record_case`, :func:`recording_case`).
    setup : FilterSetup
        The filter to start from.
    names : sequence of str, optional
        Parameters to tune; those of :data:`GATED` imply ``gate``. Default: :func:`default_names`.
    priors, starts, factor, seed, threads, progress : optional
        As for :func:`fit`; the threads process records if there is one search at a time.
    gate : bool, default False
        Model outliers, and set the gate where an outlier is more likely.
    held : sequence of Case, optional
        Held-out data (:func:`split`), on which the filter before and after tuning are compared.
    truth, spacing : optional
        As for :func:`objective_for`.

    Returns
    -------
    Tuning
        ``setup`` is the tuned filter; the gate and the comparison on held-out data are in it.

    Raises
    ------
    InputError
        If options exclude each other, a parameter is unknown, or the search does not converge.
    """
    gate = gate or any(name in GATED for name in names or ())
    wanted = [name for name in names or () if name not in GATED] or list(default_names([case.record for case in cases]))
    objective = objective_for(cases, setup, wanted, truth=truth, gate=gate, spacing=spacing, threads=threads)
    result = fit(
        objective,
        priors=priors,
        starts=starts,
        factor=factor,
        seed=seed,
        threads=threads if isinstance(objective, Likelihood) or (objective.composite and len(cases) == 1) else 1,
        progress=progress,
    )
    gated = tuned_gate(objective, result) if isinstance(objective, Likelihood) and objective.mixed else None
    if gated is not None and gated.gate is not None:
        result = dataclasses.replace(result, setup=dataclasses.replace(result.setup, gate=gated.gate))
    result = dataclasses.replace(result, gate=gated, comparison=_compared(held, setup, result, objective, threads))
    result = dataclasses.replace(result, measure="likelihood" + " of the errors" * truth)
    return _examined(cases, setup, result)


def _compared(
    held: Sequence[Case], before: FilterSetup, result: Tuning, objective: Objective, threads: int
) -> Comparison | None:
    """Return the filter before and after on held-out data; None if there are none."""
    if not held:
        return None
    comparison = compare(held, before, result.setup, threads=threads)
    if isinstance(objective, Likelihood) and objective.mixed:  # the likelihood after tuning includes the gate
        likely = log_likelihood(held, objective, result)
        comparison = dataclasses.replace(comparison, after=dataclasses.replace(comparison.after, log_likelihood=likely))
    return comparison


def _examined(cases: Sequence[Case], before: FilterSetup, result: Tuning) -> Tuning:
    """Return the tuning with tests for errors that it does not model."""
    tested = examined(cases, before, result)
    for check in sorted(tested, key=lambda check: check.severity)[-1:]:
        result = with_misfit_flag(result, check)
    return dataclasses.replace(result, unmodelled=tested)
