"""Cramér–Rao bound of each parameter for records of given durations, from simulated records."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from strapdown.checks import Array, InputError, count, instance
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup
from strapdown.records import cut
from strapdown.results import Listed, Listing, figure
from strapdown.scenarios import Scenario, drawn, simulate
from strapdown.tuning.innovations import likelihood
from strapdown.tuning.objective import Case
from strapdown.tuning.parameters import CONSTANTS, Unit, unit_of, values_of


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan(Listed):
    """Minimum standard errors of the parameters for records of several durations."""

    names: tuple[str, ...]
    values: Array
    """Assumed values of the parameters (p,), SI."""
    units: tuple[Unit, ...]
    """Units in which they are printed."""
    lengths: Array
    """Durations of a record (k,), s."""
    errors: Array
    """Minimum standard error of the logarithm of each parameter (k, p): 0.1 is 10 %."""
    scatter: float
    """Largest relative standard deviation of the mean of these over the simulated records."""

    def listing(self) -> Listing:
        """Return the minimum standard errors as factors, in a table."""
        rows = [
            (
                name,
                unit.name,
                figure(value / unit.factor, 3),
                *(f"× {math.exp(error):.3f}" if error < 2.0 else "nothing" for error in errors),
                f"{needed:.3g} s" if math.isfinite(needed) else "more records",
            )
            for name, unit, value, errors, needed in zip(
                self.names, self.units, self.values, self.errors.T, self.needed(), strict=True
            )
        ]
        columns = ("parameter", "unit", "value", *(f"{length:g} s" for length in self.lengths), "10 % needs")
        note = "Above about × 1.5 a record gives a bound and not a value. The last column extrapolates the information at its final rate."
        return Listing("Minimum standard error, as a factor (Cramér–Rao)", columns, rows, [note], left=2)

    def needed(self, error: float = 0.1) -> Array:
        """Return the duration (p,), s, at which each parameter has this relative error, extrapolating the information at its last rate.

        Infinite for the σ of a constant error, whose information grows with the number of records and not with their duration.
        """
        drawn_once = np.array([name.endswith(CONSTANTS) for name in self.names])
        longer = drawn_once & (self.errors[-1] > error)
        return np.where(longer, np.inf, self.lengths[-1] * (self.errors[-1] / error) ** 2)


def plan(
    scenario: Scenario,
    chosen: FilterSetup,
    free: Sequence[str],
    *,
    lengths: Sequence[float],
    records: int = 4,
    seed: int = 0,
    threads: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Plan:
    """Return the Cramér–Rao bound of the logarithms of parameters for records of given durations.

    Fisher's information is averaged over ``records`` simulated records, evaluated from sensitivities, with the setup exact. For a
    filter with optional states gyro and sensors are drawn anew for each record (:func:`strapdown.scenarios.drawn`).

    Parameters
    ----------
    scenario : Scenario
        Scenario to simulate, with its gyro and sensors.
    chosen : FilterSetup
        Filter whose parameters are the true ones.
    free : sequence of str
        Names of parameters, as in :func:`likelihood`.
    lengths : sequence of float
        Durations of a record, s.
    records : int, default 4
        Number of simulated records over which the information is averaged.
    seed : int, default 0
        Seed of the simulated records.
    threads : int, default 1
        Number of records simulated in parallel.
    progress : callable, optional
        Called with the number of records just finished.

    Returns
    -------
    Plan
        Minimum standard error of the logarithm of each parameter, by duration: 0.1 is 10 %.
    """
    instance("scenario", scenario, Scenario, "give a Scenario")
    wanted = np.sort(np.asarray(lengths, float))
    if len(wanted) == 0 or not wanted[0] > 0.0:
        raise InputError("lengths must be greater than zero; give durations of a record in seconds")
    count("records", records)

    def one(number: int) -> Array:
        one = scenario if chosen.states is None else drawn(scenario, seed, number)
        record = simulate(replace(one, duration=float(wanted[-1])), seed, number)
        initial = setup.drawn_state(chosen, record, seed, number)
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
    example = simulate(replace(scenario, duration=float(wanted[0])), seed, 0)
    values = values_of(chosen, tuple(free), [example])
    return Plan(
        names=tuple(free),
        values=np.array(list(values.values())),
        units=tuple(unit_of(name, [example]) for name in free),
        lengths=wanted,
        errors=bound(found.mean(axis=0)),
        scatter=float(0.5 * np.max(np.std(diagonal, axis=0) / np.mean(diagonal, axis=0)) / np.sqrt(records)),
    )


def bound(information: Array) -> Array:
    """Return the roots (..., p) of the diagonals of the inverses of information matrices (..., p, p)."""
    scale = np.sqrt(np.maximum(np.einsum("...jj->...j", information), 1e-12))
    unit = information / (scale[..., :, None] * scale[..., None, :])
    inverse = np.linalg.pinv(unit, rcond=1e-12, hermitian=True)
    return np.asarray(np.sqrt(np.einsum("...jj->...j", inverse)) / scale)
