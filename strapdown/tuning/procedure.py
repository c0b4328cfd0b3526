"""A complete tuning: choice of the objective, search with intervals, and the steps after it for each objective."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from strapdown.checks import InputError
from strapdown.estimation.setup import FilterSetup
from strapdown.tuning.errors import error_objective
from strapdown.tuning.fitting import Tuning, fit
from strapdown.tuning.innovations import Likelihood, likelihood
from strapdown.tuning.objective import OUTLIERS, Case, Objective
from strapdown.tuning.outliers import contaminated_likelihood, log_likelihood, tuned_gate
from strapdown.tuning.parameters import Prior, default_names
from strapdown.tuning.residual_checks import examined, with_misfit_flag
from strapdown.tuning.validation import compare

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
    # The threads run searches, because eight points run at once.
    return contaminated_likelihood(cases, setup, names) if gate else likelihood(cases, setup, names, spacing=spacing)


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
        threads=1 if truth and len(cases) > 1 else threads,
        progress=progress,
    )
    result = replace(result, measure="likelihood" + " of the errors" * truth)
    if isinstance(objective, Likelihood) and gate:
        gated = tuned_gate(objective, result)
        tuned = result.setup if gated.gate is None else replace(result.setup, gate=gated.gate)
        result = replace(result, gate=gated, setup=tuned)
    if held:
        comparison = compare(held, setup, result.setup, threads=threads)
        if isinstance(objective, Likelihood) and gate:  # the likelihood after tuning includes the gate
            likely = log_likelihood(held, objective, result)
            comparison = replace(comparison, after=replace(comparison.after, log_likelihood=likely))
        result = replace(result, comparison=comparison)
    tested = examined(cases, setup, result)
    if tested:
        result = with_misfit_flag(result, max(tested, key=lambda check: check.severity))
    return replace(result, unmodelled=tested)
