"""How well a record of some length will determine each parameter, before it is made: the Cramér–Rao bound from simulated records."""

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
    """Standard errors that records of several lengths will give at best."""

    names: tuple[str, ...]
    values: Array
    """The parameters assumed (p,), SI."""
    units: tuple[Unit, ...]
    """Units that they are printed in."""
    lengths: Array
    """Lengths of a record (k,), s."""
    errors: Array
    """Least standard error of the logarithm of each parameter (k, p): 0.1 is 10 %."""
    scatter: float
    """Largest relative scatter of these over the simulated records, standard deviation of their mean."""

    def listing(self) -> Listing:
        """Return the least standard errors as factors, as a table."""
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
        note = "Above about × 1.5 a record gives a bound rather than a value. The last column lets information grow as at the end."
        return Listing("Least standard error, as a factor (Cramér–Rao)", columns, rows, [note], left=2)

    def needed(self, error: float = 0.1) -> Array:
        """Return the length (p,), s, at which each parameter is known to this relative error, if information grows as at the end.

        Infinite for the σ of a constant error: more records tell more of it, a longer one does not.
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
    """Return the Cramér–Rao bound of the logarithms of parameters, for records of given lengths.

    Fisher's information is the mean of that of the sensitivities over ``records`` simulated records for which the setup is exact. For a
    filter with optional states each record has other individuals of the gyro and the sensors (:func:`strapdown.scenarios.drawn`).

    Parameters
    ----------
    scenario : Scenario
        Simulated with its own gyro and sensors.
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
    """
    instance("scenario", scenario, Scenario, "give a Scenario")
    wanted = np.sort(np.asarray(lengths, float))
    if len(wanted) == 0 or not wanted[0] > 0.0:
        raise InputError("lengths must be greater than zero; give the seconds that a record may last")
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
    """Return the root of the diagonal of the inverse of information matrices (..., p, p): (..., p)."""
    scale = np.sqrt(np.maximum(np.einsum("...jj->...j", information), 1e-12))
    unit = information / (scale[..., :, None] * scale[..., None, :])
    inverse = np.linalg.pinv(unit, rcond=1e-12, hermitian=True)
    return np.asarray(np.sqrt(np.einsum("...jj->...j", inverse)) / scale)
