"""Tuning of a filter from records or recordings."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from strapdown import ahrs
from strapdown.checks import Hint, InputError, count, instance, one_of
from strapdown.estimation import setup as setups
from strapdown.estimation.gating import Gate
from strapdown.estimation.setup import FilterSetup
from strapdown.gyro import GyroSpec
from strapdown.recordings import Recording
from strapdown.records import ImuRecord
from strapdown.workflows.estimating import SOURCE
from strapdown.workflows.filters import matched_filter, need_angles

if TYPE_CHECKING:
    from strapdown.tuning import Case, Prior, Tuning
    from strapdown.tuning.objective import Objective

    Source = ImuRecord | Recording | Case


def tune(
    sources: Source | Sequence[Source] | Mapping[str, Source],
    *,
    setup: FilterSetup | None = None,
    free: Sequence[str] | None = None,
    states: bool | None = None,
    priors: Mapping[str, Prior] | GyroSpec | None = None,
    truth: bool = False,
    gate: bool = False,
    spacing: float = 0.0,
    holdout: float | None = None,
    starts: int = 4,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> Tuning:
    """Tune noise parameters of a filter by maximum likelihood of its innovations, with confidence intervals.

    Parameters
    ----------
    sources : ImuRecord, Recording, Case, sequence or mapping of them
        Records of one unit; in a mapping with their names in messages. A Case (:mod:`strapdown.tuning`) has its own initial state.
    setup : FilterSetup, optional
        Initial filter. Default: matched to the first record, or that of recordings.
    free : sequence of str, optional
        Parameters to tune: ``"gyro.arw"``, ``"gyro.rrw"``, ``"SENSOR.sigma"``, …. Default: the two of the gyro and the σ of every sensor;
        for recordings without ``truth`` only ``"filter.scale"``. Those of outliers imply ``gate``.
    states : bool, optional
        Whether the matched filter has an error state for each error that the record specifies. Default: if there are such errors.
    priors : mapping of str to Prior, or GyroSpec, optional
        Prior distributions of parameters, by name; or a gyro, for weak priors of its noise.
    truth : bool, default False
        Whether to tune by the likelihood of the errors relative to the truth, of the filter with its gate. Default: by that of the
        innovations of the filter without its gate, because the likelihood of accepted ones increases as the gate becomes narrower.
    gate : bool, default False
        Whether to model the fraction and scale of outliers too, for the filter's gate.
    spacing : float, default 0.0
        Interval between the samples of a sensor that are used, with the weight of all, s: for correlated disturbances.
    holdout : float, optional
        Fraction of each record, its end, held out for comparing the filter before and after tuning (``Tuning.comparison``).
    starts : int, default 4
        Number of searches: one from the initial filter, the others from random initial values.
    seed : int, default 0
        Seed of the random initial values.
    threads : int, optional
        Number of threads. Default: one per core.
    progress : callable, optional
        Called with the progress, such as ``"searches: 1 of 4"``.

    Returns
    -------
    Tuning
        ``setup`` is the tuned filter, for :func:`estimate` and :func:`monte_carlo`; ``words`` say what it does not model.

    Examples
    --------
    >>> import strapdown as sd
    >>> tuned = sd.tune(record, free=["gyro.arw", "star 1.sigma"])  # doctest: +SKIP
    >>> estimate = sd.estimate(record, setup=tuned.setup)  # doctest: +SKIP
    """
    from strapdown import tuning

    count("seed", seed, minimum=0)
    instance("free", () if free is None else free, (list, tuple), "give a list of names")
    threads = count("threads", threads if threads is not None else os.cpu_count() or 1)
    gate = gate or any(name in tuning.GATED for name in free or ())
    own, by_name = setup is not None, _by_name(sources)
    setup, cases, remarks = _cases(by_name, setup, states, gate)
    if own and (setup.gate or setup.robust) and not (truth or gate):
        remarks.append(
            "The filter's gate and weights are not applied: a narrower gate would always increase the likelihood. "
            f"{Hint('gate', True)} models outliers, and {Hint('truth', True)} tunes the filter with its gate and weights."
        )
    if not truth and any(isinstance(source, Recording) for source in by_name.values()):
        free, spacing = tuning.by_innovations(free, spacing, gate=gate, priors=priors)
    names = [name for name in free or () if name not in tuning.GATED]
    if free is None or (free and not names):
        names = list(tuning.default_names([case.record for case in cases]))
    if not own or any(name.startswith(("gyro.", "filter.")) for name in names):
        origins = {label: case.record.origin for label, case in zip(by_name, cases, strict=True)}
        tuning.one_gyro({label: origin.gyro for label, origin in origins.items() if origin and origin.gyro})
    train, held = (tuple(cases), ()) if holdout is None else tuning.split(cases, holdout)
    if isinstance(priors, GyroSpec):
        by_gyro = tuning.priors_from_gyro(priors, train[0].record)
        priors = {name: prior for name, prior in by_gyro.items() if name in names}
    objective = _objective(train, setup, names, truth=truth, gate=gate, spacing=spacing, threads=threads)
    at_once = 1 if truth and len(train) > 1 else threads  # searches, unless records are evaluated in parallel
    result = tuning.fit(objective, priors=priors, starts=starts, seed=seed, threads=at_once, progress=progress)
    result = tuning.examined(train, _completed(result, setup, held, threads))
    return dataclasses.replace(result, remarks=tuple(remarks))


def _by_name(sources: Source | Sequence[Source] | Mapping[str, Source]) -> Mapping[str, Source]:
    """Return the sources by their names in messages, checked."""
    from strapdown.tuning import Case

    if not isinstance(sources, Mapping):
        listed = sources if isinstance(sources, (list, tuple)) else [sources]
        sources = {f"record {k}" if len(listed) > 1 else "": source for k, source in enumerate(listed)}
    if not sources:
        raise InputError("sources is empty; give at least one record or recording")
    if len({id(source) for source in sources.values()}) < len(sources):
        raise InputError("sources: a record is given twice, which would halve the variances; give each record once")
    for source in sources.values():
        instance("sources", source, (ImuRecord, Recording, Case), SOURCE)
        if isinstance(source, Recording):
            ahrs.need_accelerometer(source)
            ahrs.check_conventions.warn(source)
    return sources


def _cases(
    sources: Mapping[str, Source], setup: FilterSetup | None, states: bool | None, gate: bool
) -> tuple[FilterSetup, list[Case], list[str]]:
    """Return the initial filter, the records with the filter's initial states, and remarks on the filter, which may get a gate."""
    from strapdown import tuning

    own, remarks, cases = setup is not None, list[str](), []
    for label, source in sources.items():
        if isinstance(source, Recording):
            setup = setup or ahrs.AhrsParameters().setup
            cases.append(tuning.recording_case(source))
            continue
        record = source if isinstance(source, ImuRecord) else source.record
        if setup is None:
            if record.origin is None or record.origin.gyro is None:
                raise InputError(
                    f"{label or 'the record'} does not contain its gyro's specification; give a filter, {Hint('setup')}"
                )
            setup, remarks = matched_filter(record, states=states, changes={"gate": Gate()} if gate else None)
            setup = dataclasses.replace(setup, gate=None)
        elif own and states:
            if setup.states is not None:
                raise InputError(f"{Hint('setup')} contains the filter's states; leave {Hint('states')} out")
            added = setups.FilterSetup.for_record(record, states=True).states
            setup, states = dataclasses.replace(setup, states=added), None
        need_angles(setup, record)
        cases.append(tuning.record_case(source, setup, name=label) if isinstance(source, ImuRecord) else source)
    assert setup is not None
    for name in setup.sigma if own else ():
        one_of("sigma: sensor", name, {series.sensor for case in cases for series in case.record.vectors})
    return setup, cases, remarks


def _objective(
    cases: Sequence[Case],
    setup: FilterSetup,
    names: Sequence[str],
    *,
    truth: bool,
    gate: bool,
    spacing: float,
    threads: int,
) -> Objective:
    """Return the objective that the options select."""
    from strapdown import tuning

    if spacing > 0.0 and truth:
        raise InputError(
            "spacing thins the innovations of the likelihood; against a truth there are none to thin: leave it out"
        )
    if gate and (truth or spacing > 0.0):
        raise InputError("gate needs the likelihood of all innovations: leave truth and spacing out")
    if truth:
        return tuning.error_objective(cases, setup, names, threads=threads)
    if gate:
        return tuning.contaminated_likelihood(cases, setup, names)
    return tuning.likelihood(cases, setup, names, spacing=spacing)


def _completed(result: Tuning, before: FilterSetup, held: Sequence[Case], threads: int) -> Tuning:
    """Return the result of a search with the gate, if outliers are modelled, and the comparison on held-out data, if there are any."""
    from strapdown import tuning

    if result.objective.mixed:
        gated = tuning.tuned_gate(result)
        tuned = result.setup if gated.gate is None else dataclasses.replace(result.setup, gate=gated.gate)
        result = dataclasses.replace(result, gate=gated, setup=tuned)
    if held:
        comparison = tuning.compare(held, before, result.setup, threads=threads)
        if result.objective.mixed:  # the likelihood after tuning includes the gate
            after = dataclasses.replace(comparison.after, log_likelihood=tuning.log_likelihood(held, result))
            comparison = dataclasses.replace(comparison, after=after)
        result = dataclasses.replace(result, comparison=comparison)
    return result
