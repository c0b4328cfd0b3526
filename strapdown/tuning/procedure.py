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
        As for :func:`fit`; against a truth the threads process records if there are several.
    gate : bool, default False
        Model outliers, and set the gate where an outlier is more likely.
    held : sequence of Case, optional
        Held-out data (:func:`split`), on which the filter before and after tuning are compared.
    truth : bool, default False
        Maximise the likelihood of the errors against the truth, of the filter as used, including its gate. Default: that of the innovations
        of the filter without its gate, because the likelihood of accepted ones increases as the gate becomes narrower.
    spacing : float, default 0
        Minimum time between the measurements of a sensor that are used, s.

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
    if spacing > 0.0 and truth:
        raise InputError(
            "spacing thins the innovations of the likelihood; against a truth there are none to thin: leave it out"
        )
    if gate and (truth or spacing > 0.0):
        raise InputError("gate needs the likelihood of all innovations: leave truth and spacing out")
    objective: Objective
    if truth:
        objective = error_objective(cases, setup, wanted, threads=threads)
    elif gate:
        objective = contaminated_likelihood(cases, setup, wanted)
    else:
        objective = likelihood(cases, setup, wanted, spacing=spacing)
    result = fit(
        objective,
        priors=priors,
        starts=starts,
        factor=factor,
        seed=seed,
        threads=1 if truth and len(cases) > 1 else threads,  # searches, unless records are evaluated in parallel
        progress=progress,
    )
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
