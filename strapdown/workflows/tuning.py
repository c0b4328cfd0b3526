"""Tuning of a filter from records or recordings."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from strapdown import ahrs
from strapdown.checks import Hint, InputError, count, instance
from strapdown.estimation import setup as setups
from strapdown.estimation.setup import FilterSetup
from strapdown.gyro import GyroSpec
from strapdown.recordings import Recording
from strapdown.records import ImuRecord
from strapdown.workflows.estimating import SOURCE
from strapdown.workflows.filters import matched_filter, need_angles

if TYPE_CHECKING:
    from strapdown.tuning import Prior, Tuning


def tune(
    sources: ImuRecord | Recording | Sequence[ImuRecord | Recording] | Mapping[str, ImuRecord | Recording],
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
    sources : ImuRecord, Recording, sequence or mapping of them
        Records of one unit; in a mapping with their names in messages.
    setup : FilterSetup, optional
        Initial filter. Default: matched to the first record, or that of recordings.
    free : sequence of str, optional
        Parameters to tune: ``"gyro.arw"``, ``"gyro.rrw"``, ``"SENSOR.sigma"``, …. Default: the two of the gyro and the σ of every sensor;
        for recordings without ``truth`` only ``"filter.scale"``.
    states : bool, optional
        Whether the matched filter has an error state for each error that the record specifies. Default: if there are such errors.
    priors : mapping of str to Prior, or GyroSpec, optional
        Prior distributions of parameters, by name; or a gyro, for weak priors of its noise.
    truth : bool, default False
        Whether to tune by the likelihood of the errors relative to the truth, in place of that of the innovations.
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
        Called after each evaluation with the progress, such as ``"searches: 1 of 4, 23 evaluations"``.

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
    if not isinstance(sources, Mapping):
        listed = [sources] if isinstance(sources, (ImuRecord, Recording, str, os.PathLike)) else list(sources)
        sources = {f"record {k}" if len(listed) > 1 else "": source for k, source in enumerate(listed)}
    if not sources:
        raise InputError("sources is empty; give at least one record or recording")
    for source in sources.values():
        instance("sources", source, (ImuRecord, Recording), SOURCE)
        if isinstance(source, Recording):
            ahrs.need_accelerometer(source)
            ahrs.check_conventions.warn(source)
    own, remarks, cases = setup is not None, list[str](), []
    for label, source in sources.items():
        if isinstance(source, ImuRecord):
            if setup is None:
                if source.origin is None or source.origin.gyro is None:
                    raise InputError(
                        f"{label or 'the record'} does not contain its gyro's specification; give a filter, {Hint('setup')}"
                    )
                setup, remarks = matched_filter(source, states=states)
            elif own and states:
                if setup.states is not None:
                    raise InputError(f"{Hint('setup')} contains the filter's states; leave {Hint('states')} out")
                added = setups.FilterSetup.for_record(source, states=True).states
                setup, states = dataclasses.replace(setup, states=added), None
            need_angles(setup, source)
            cases.append(tuning.record_case(source, setup, name=label))
        else:
            setup = setup or ahrs.AhrsParameters().setup
            cases.append(tuning.recording_case(source))
    assert setup is not None
    if own and (setup.gate or setup.robust) and not (truth or gate):
        remarks.append(
            "The filter's gate and weights are not applied: a narrower gate would always increase the likelihood. "
            f"{Hint('gate', True)} models outliers, and {Hint('truth', True)} tunes the filter with its gate and weights."
        )
    if not (truth or all(isinstance(source, ImuRecord) for source in sources.values())):
        free, spacing = tuning.by_innovations(free, spacing, gate=gate, priors=priors)
    train, held = (tuple(cases), ()) if holdout is None else tuning.split(cases, holdout)
    wanted = [name for name in free or () if name not in tuning.GATED]
    wanted = wanted or list(tuning.default_names([case.record for case in cases]))
    if not own or any(name.startswith(("gyro.", "filter.")) for name in wanted):
        origins = {label: source.origin for label, source in sources.items() if isinstance(source, ImuRecord)}
        tuning.one_gyro({label: origin.gyro for label, origin in origins.items() if origin and origin.gyro})
    if isinstance(priors, GyroSpec):
        by_gyro = tuning.priors_from_gyro(priors, train[0].record)
        priors = {name: prior for name, prior in by_gyro.items() if name in wanted}
    result = tuning.tune(
        train,
        setup,
        [*wanted, *(name for name in free or () if name in tuning.GATED)],
        held=held,
        priors=priors,
        truth=truth,
        gate=gate,
        spacing=spacing,
        starts=starts,
        seed=seed,
        threads=count("threads", threads if threads is not None else os.cpu_count() or 1),
        progress=progress,
    )
    return dataclasses.replace(result, remarks=tuple(remarks))
