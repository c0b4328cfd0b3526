"""Monte Carlo of a scenario."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

from strapdown import scenarios
from strapdown.estimation.filters.own import Own
from strapdown.estimation.setup import FilterSetup
from strapdown.gyro import GyroSpec
from strapdown.scenarios import Scenario
from strapdown.workflows.filters import filter_for_scenario, need_alone

if TYPE_CHECKING:
    from strapdown.allan import NoiseFit
    from strapdown.montecarlo import Dispersions, Plan, Statistics


def plan(
    scenario: Scenario,
    *,
    setup: FilterSetup | Own | None = None,
    noise: GyroSpec | NoiseFit | None = None,
    seed: int | None = None,
    states: bool | None = None,
    dispersions: Dispersions | None = None,
) -> Plan:
    """Return the plan of a Monte Carlo: a scenario with the filter that matches it, or with another ``setup``.

    ``noise``: gyro assumed by the matched filter, such as that of a data sheet; default: that of the scenario.
    ``states``: whether the matched filter has an error state for each error that the scenario specifies; default: if there are such errors.
    If constant errors have states, each run draws its own gyro and sensors, since the filter is consistent on average over such units only.
    """
    from strapdown import montecarlo

    if isinstance(setup, Own):
        need_alone(noise, states)
        setup = dataclasses.replace(FilterSetup.for_scenario(scenario, states=False), estimator=setup)
    filter_setup = filter_for_scenario(scenario, setup=setup, noise=noise, states=states)
    return montecarlo.Plan(
        scenario=scenario,
        setup=filter_setup,
        seed=scenario.seed if seed is None else seed,
        epochs=montecarlo.whole_epochs(scenario, filter_setup),
        individuals=filter_setup.states is not None and filter_setup.states.has_constants,
        dispersions=dispersions or montecarlo.Dispersions(),
    )


def monte_carlo(
    scenario: Scenario | str | os.PathLike[str],
    *,
    runs: int = 1000,
    seed: int | None = None,
    noise: GyroSpec | NoiseFit | None = None,
    setup: FilterSetup | None = None,
    states: bool | None = None,
    dispersions: Dispersions | None = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Statistics:
    """Simulate many runs of a scenario with a filter and return the statistics over the runs.

    :func:`strapdown.montecarlo.campaign.run` does the same with a file from which it can be resumed, also on clusters.

    Parameters
    ----------
    scenario : Scenario, str or path
        As for :func:`simulate`.
    runs : int, default 1000
        Number of independent runs.
    seed : int, optional
        Seed of the random numbers. Default: that of the scenario.
    noise, setup : optional
        Gyro assumed by the matched filter, or the complete filter; as for :func:`estimate`.
    states : bool, optional
        Whether the matched filter has an error state for each error that the scenario specifies. Default: True if there are such errors.
    dispersions : Dispersions, optional
        Initial errors and gyro parameters that differ from run to run.
    threads : int, optional
        Number of threads. Default: one per core.
    progress : callable, optional
        Called with the number of runs completed since its last call.

    Returns
    -------
    Statistics
        Argument of :func:`check`; bit-identical for any number of threads.

    Examples
    --------
    >>> import strapdown as sd
    >>> print(sd.check(sd.monte_carlo("two-stars", runs=1000)))  # doctest: +SKIP
    """
    from strapdown import montecarlo

    campaign = plan(
        scenarios.as_scenario(scenario), noise=noise, setup=setup, seed=seed, states=states, dispersions=dispersions
    )
    return montecarlo.run_plan(campaign, runs=runs, threads=threads, progress=progress)
