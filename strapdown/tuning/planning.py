"""How well a record of some length will determine each parameter, before it is made: the Cramér–Rao bound from simulated records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from strapdown import quaternion, setup
from strapdown.checks import Array, InputError, count
from strapdown.randomness import generator
from strapdown.records import ImuRecord, Truth, cut
from strapdown.scenarios import Scenario, simulate
from strapdown.setup import FilterSetup
from strapdown.tuning.innovations import Case, likelihood
from strapdown.tuning.parameters import values_of


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """Standard errors that records of several lengths will give at best."""

    names: tuple[str, ...]
    values: Array
    """The parameters assumed (p,), SI."""
    lengths: Array
    """Lengths of a record (k,), s."""
    errors: Array
    """Least standard error of the logarithm of each parameter (k, p): 0.1 is 10 %."""
    scatter: float
    """Largest relative scatter of these over the simulated records, standard deviation of their mean."""

    def needed(self, error: float = 0.1) -> Array:
        """Return the length (p,), s, at which each parameter is known to this relative error, if information grows as at the end."""
        return np.asarray(self.lengths[-1] * (self.errors[-1] / error) ** 2)


def plan(
    scenario: Scenario | ImuRecord,
    chosen: FilterSetup,
    free: Sequence[str],
    *,
    lengths: Sequence[float],
    records: int = 4,
    seed: int = 0,
    threads: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Plan:
    """Return the Cramér–Rao bound of the logarithms of parameters, for records of given lengths.

    Fisher's information is the mean of that of the sensitivities over ``records`` simulated records for which the setup is exact.

    Parameters
    ----------
    scenario : Scenario or ImuRecord
        A scenario is simulated with its own gyro and sensors; of a record the motion is used, with the setup's noise at the times of its
        measurements (``simulated_again``).
    chosen : FilterSetup
        Taken as true.
    free : sequence of str
        Names of parameters, as of :func:`likelihood`.
    lengths : sequence of float
        Lengths of a record, s.
    records : int, default 4
        Number of simulated records over which the information is averaged.
    seed : int, default 0
        Seed of the simulated records.
    threads : int, default 1
        Records simulated at once.
    progress : callable, optional
        Called with the number of records just finished.

    Returns
    -------
    Plan
        Least standard error of the logarithm of each parameter, by record length: 0.1 is 10 %.

    Raises
    ------
    InputError
        If a length is not above zero, or a name is unknown.
    """
    wanted = np.sort(np.asarray(lengths, float))
    if len(wanted) == 0 or not wanted[0] > 0.0:
        raise InputError("lengths must be greater than zero; give the seconds that a record may last")
    count("records", records)

    def one(number: int) -> Array:
        record = _made(scenario, chosen, float(wanted[-1]), seed, number)
        truth = record.truth
        assert truth is not None
        draw = generator(seed, number, "initial error").standard_normal(6)
        initial = setup.initial_state(
            chosen,
            quaternion.multiply(truth.attitude[0], quaternion.exp(-chosen.attitude_sigma * draw[:3])),
            truth.bias[0] - chosen.bias_sigma * draw[3:],
        )
        rows = []
        for length in wanted:
            last = int(np.searchsorted(record.time, record.time[0] + length * (1.0 - 1e-9)))
            part = cut(record, 0, min(max(last, 1), len(record.time) - 1))
            objective = likelihood([Case(record=part, initial=initial, name=f"the first {length:g} s")], chosen, free)
            rows.append(objective.derivatives(objective.start).information)
        if progress is not None:
            progress(1)
        return np.array(rows)

    with ThreadPoolExecutor(threads) as pool:
        found = np.array(list(pool.map(one, range(records))))
    diagonal = np.einsum("rkjj->rkj", found)
    example = _made(scenario, chosen, float(wanted[0]), seed, 0)
    values = values_of(chosen, tuple(free), [example])
    return Plan(
        names=tuple(free),
        values=np.array(list(values.values())),
        lengths=wanted,
        errors=bound(found.mean(axis=0)),
        scatter=float(0.5 * np.max(np.std(diagonal, axis=0) / np.mean(diagonal, axis=0)) / np.sqrt(records)),
    )


def bound(information: Array) -> Array:
    """Return the root of the diagonal of the inverse of information matrices (..., p, p): (..., p)."""
    scale = np.sqrt(np.maximum(np.einsum("...jj->...j", information), 1e-12))
    unit = information / (scale[..., :, None] * scale[..., None, :])
    inverse = np.linalg.pinv(unit, rcond=1e-12, hermitian=True)
    return np.asarray(np.sqrt(np.einsum("...jj->...j", inverse)) / scale)


def _made(scenario: Scenario | ImuRecord, chosen: FilterSetup, length: float, seed: int, number: int) -> ImuRecord:
    if isinstance(scenario, Scenario):
        return simulate(replace(scenario, duration=length), seed, number)
    if length > scenario.time[-1] - scenario.time[0] + 1e-6:
        raise InputError(
            f"the record lasts {scenario.time[-1] - scenario.time[0]:g} s, a plan for {length:g} s needs its motion as long; plan shorter, "
            "or with a scenario"
        )
    return simulated_again(scenario, chosen, generator(seed, number, "plan"))


def simulated_again(record: ImuRecord, chosen: FilterSetup, draw: np.random.Generator) -> ImuRecord:
    """Return a record of the same motion and the same times of measurement, with noise of the setup and its truth.

    The measured increments are taken for the true ones; where the first attitude is not known it is the identity. Only what the filter
    can use is made: of a heading, a vector that is level and as long as a direction.
    """
    modelled = setup.modelled_record(record, chosen)
    time, dt = modelled.time, np.diff(modelled.time)
    noise = chosen.process_noise
    steps = noise.rate_random_walk * np.sqrt(dt)[:, None] * draw.standard_normal((len(dt), 3))
    first = chosen.bias_sigma * draw.standard_normal(3)
    bias = np.concatenate([first[None], first + np.cumsum(steps, axis=0)])
    white = noise.angle_random_walk * np.sqrt(dt)[:, None] * draw.standard_normal((len(dt), 3))
    between = noise.rate_random_walk * np.sqrt(dt**3 / 12.0)[:, None] * draw.standard_normal((len(dt), 3))
    attitude = np.empty((len(time), 4))
    attitude[0] = (1.0, 0.0, 0.0, 0.0) if modelled.truth is None else modelled.truth.attitude[0]
    turns = quaternion.exp(modelled.increments)
    for k in range(len(dt)):
        attitude[k + 1] = quaternion.multiply(attitude[k], turns[k])
    attitude = quaternion.normalize(attitude)
    series = []
    for one in modelled.vectors:
        at = np.clip(np.searchsorted(time, one.time, side="right") - 1, 0, len(dt) - 1)
        share = ((one.time - time[at]) / dt[at])[:, None]
        q = quaternion.multiply(attitude[at], quaternion.exp(share * modelled.increments[at]))
        if one.attitude is not None:
            assert one.sigma_axes is not None
            error = one.sigma_axes * draw.standard_normal((len(q), 3))
            measured = quaternion.multiply(q, quaternion.exp(error))
            measured[~np.isfinite(one.attitude).all(axis=1)] = np.nan
            series.append(replace(one, attitude=measured))
            continue
        exact = quaternion.rotate(
            quaternion.conjugate(q), _level(one.references_f) if one.kind == "heading" else one.references_f
        )
        seen = exact + one.sigma[:, None] * draw.standard_normal((len(q), 3))
        if one.kind != "vector":
            seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        seen[~np.isfinite(one.vector_b).all(axis=1)] = np.nan
        series.append(replace(one, vector_b=seen))
    increments = modelled.increments + white + 0.5 * (bias[1:] + bias[:-1]) * dt[:, None] + between
    return ImuRecord(time=time, increments=increments, vectors=tuple(series), truth=Truth(attitude=attitude, bias=bias))


def _level(reference: Array) -> Array:
    level = reference * np.array([1.0, 1.0, 0.0])
    return np.asarray(level / np.linalg.norm(level, axis=1, keepdims=True))
