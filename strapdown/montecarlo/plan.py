"""Plan of a Monte Carlo campaign: scenario, filter, seed, dispersions between runs, epochs of the statistics."""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from strapdown import scenarios
from strapdown.checks import Array, InputError, array, count, half_turn, instance, non_negative
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup, need_setup
from strapdown.files import tables
from strapdown.gyro import GyroSpec
from strapdown.randomness import generator
from strapdown.records import Origin
from strapdown.results import ByValue
from strapdown.scenarios import Scenario


@dataclass(frozen=True, kw_only=True, eq=False)
class Dispersions(ByValue):
    """Independent normal dispersions between runs besides the noise. Default: initial errors from the filter's prior.

    Parameters
    ----------
    attitude_sigma : float, optional
        σ of the initial attitude error, each body axis, rad. Default: that of the filter's prior, so that a matched filter is consistent.
    bias_sigma : float, optional
        σ of the initial bias error, each body axis, rad/s. Default: that of the filter's prior.
    attitude_error : ndarray (3,), default zeros
        Fixed part of the initial attitude error δθ in all runs, rad, body axes.
    bias_error : ndarray (3,), default zeros
        Fixed part of the initial bias error δb in all runs, rad/s, body axes.
    scale_factor_sigma : float, default 0.0
        σ of the scale-factor error of each gyro axis, dimensionless, added to the scenario's.
    misalignment_sigma : float, default 0.0
        σ of each of the six misalignments of the gyro, rad, added to the scenario's.
    turn_on_bias_sigma : float, default 0.0
        σ of a turn-on bias of each gyro axis, rad/s, added to the scenario's. The filter starts from the true bias minus its initial error,
        so this changes the true bias of the tests, not the initial bias error.
    """

    attitude_sigma: float | None = None
    bias_sigma: float | None = None
    attitude_error: Array = field(default_factory=lambda: np.zeros(3))
    bias_error: Array = field(default_factory=lambda: np.zeros(3))
    scale_factor_sigma: float = 0.0
    misalignment_sigma: float = 0.0
    turn_on_bias_sigma: float = 0.0

    def __post_init__(self) -> None:
        """Check every field."""
        for name, unit in (("attitude_sigma", "rad"), ("bias_sigma", "rad/s")):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, non_negative(f"dispersions: {name}", getattr(self, name), unit=unit))
        half_turn("dispersions: attitude_sigma", self.attitude_sigma or 0.0)
        for name in ("attitude_error", "bias_error"):
            object.__setattr__(self, name, array(f"dispersions: {name}", getattr(self, name), (3,)))
        for name, unit in (("scale_factor_sigma", ""), ("misalignment_sigma", "rad"), ("turn_on_bias_sigma", "rad/s")):
            object.__setattr__(self, name, non_negative(f"dispersions: {name}", getattr(self, name), unit=unit))

    @property
    def of_the_gyro(self) -> bool:
        """Whether the gyro's parameters differ from run to run."""
        return max(self.scale_factor_sigma, self.misalignment_sigma, self.turn_on_bias_sigma) > 0.0

    def to_table(self) -> dict[str, Any]:
        """Return the values that differ from the default as a table for a file, with units in the keys.

        Returns
        -------
        dict
            Values by key; the suffix of a key is its unit (``attitude_sigma_deg``).
        """
        return tables.encode(self, _FORM)


def initial_sigmas(dispersions: Dispersions, setup: FilterSetup) -> tuple[float, float]:
    """Return the σ of the initial attitude error, rad, and bias error, rad/s: by default those of the filter's prior."""
    return (
        setup.attitude_sigma if dispersions.attitude_sigma is None else dispersions.attitude_sigma,
        setup.bias_sigma if dispersions.bias_sigma is None else dispersions.bias_sigma,
    )


def dispersed(spec: GyroSpec, dispersions: Dispersions, seed: int, run: int) -> GyroSpec:
    """Return the gyro of one run: three scale factors, six misalignments by rows and three turn-on biases are drawn, in this order."""
    if not dispersions.of_the_gyro:
        return spec
    draw = generator(seed, run, "dispersions").standard_normal(12)
    misalignment = spec.misalignment.copy()
    misalignment[~np.eye(3, dtype=bool)] += dispersions.misalignment_sigma * draw[3:9]
    return replace(
        spec,
        scale_factor=spec.scale_factor + dispersions.scale_factor_sigma * draw[:3],
        misalignment=misalignment,
        turn_on_bias=spec.turn_on_bias + dispersions.turn_on_bias_sigma * draw[9:],
    )


_FORM: tables.Form = {
    "attitude_sigma": tables.DEGREES,
    "bias_sigma": tables.DEGREES_PER_HOUR,
    "attitude_error": tables.DEGREES,
    "bias_error": tables.DEGREES_PER_HOUR,
    "scale_factor_sigma": tables.PPM,
    "misalignment_sigma": tables.MILLIRADIANS,
    "turn_on_bias_sigma": tables.DEGREES_PER_HOUR,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan(ByValue):
    """Definition of a campaign: everything that run number k depends on, and the epochs of the statistics.

    Filter and truth are separate: a ``setup`` that differs from :meth:`strapdown.estimation.setup.FilterSetup.for_scenario` is a mismatched
    filter. Outages, outliers and correlated noise are properties of the scenario's sensors.

    Parameters
    ----------
    scenario : Scenario
        Simulated motion, gyro and sensors.
    setup : FilterSetup
        Filter to be tested.
    seed : int, default 0
        Seed of all random streams, which depend on (seed, run, source).
    epochs : int, default 100
        Number of equal intervals between the epochs at which errors are evaluated; each epoch is at the end of a filter step.
    nis_bins : int, default 100
        Number of equal time bins over which the NIS is summed.
    dispersions : Dispersions, default Dispersions()
        Initial errors and gyro parameters that differ from run to run.
    individuals : bool, default False
        Whether each run draws its own gyro and sensors (:func:`strapdown.scenarios.drawn`): the errors of the specification are then
        standard deviations, as in a filter with states for them. Otherwise every run has exactly those errors.
    """

    scenario: Scenario
    setup: FilterSetup
    seed: int = 0
    epochs: int = 100
    nis_bins: int = 100
    dispersions: Dispersions = field(default_factory=Dispersions)
    individuals: bool = False

    def __post_init__(self) -> None:
        """Check every field."""
        for name, least in (("seed", 0), ("epochs", 1), ("nis_bins", 1)):
            object.__setattr__(self, name, count(name, getattr(self, name), minimum=least))
        need_setup(self.setup)
        instance(
            "dispersions", self.dispersions, Dispersions, "give montecarlo.Dispersions(attitude_sigma=0.01, …), SI"
        )
        if self.samples % (self.epochs * self.setup.integration.samples):
            raise InputError(
                f"{self.samples} gyro samples do not divide into {self.epochs} epochs of whole {self.setup.integration.name} steps; choose "
                f"a duration whose sample count is a multiple of {self.epochs * self.setup.integration.samples}, or other epochs"
            )

    @property
    def samples(self) -> int:
        """Nominal number of gyro samples in a run, including lost ones."""
        return round(self.scenario.duration * self.scenario.rate)

    @property
    def every(self) -> int:
        """Filter steps from one epoch to the next."""
        return self.samples // (self.epochs * self.setup.integration.samples)

    @property
    def time(self) -> Array:
        """Epochs (m,), m = epochs + 1, s, including the start."""
        return np.linspace(0.0, self.samples / self.scenario.rate, self.epochs + 1)

    @property
    def nis_edges(self) -> Array:
        """Edges of the time bins of the NIS (nis_bins + 1,), s. A measurement at an edge belongs to the bin that ends there."""
        return np.linspace(0.0, self.samples / self.scenario.rate, self.nis_bins + 1)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors, in the scenario's order."""
        return tuple(sensor.name for sensor in self.scenario.sensors)

    @property
    def unmodelled(self) -> tuple[str, ...]:
        """Errors, in words, that the scenario specifies and the filter does not model."""
        return setup.unmodelled_errors(self.origin, self.setup)

    @property
    def origin(self) -> Origin:
        """Origin of the records of the runs."""
        return Origin(gyro=self.scenario.gyro, scenario=self.scenario)

    def to_table(self) -> dict[str, Any]:
        """Return the plan as a table of strings and numbers, for comparison and for :func:`from_table`.

        Returns
        -------
        dict
            Plain values with units in the keys; :attr:`digest` is its hash.
        """
        return {
            "scenario": scenarios.scenario_to_table(self.scenario),
            "filter": setup.to_table(self.setup),
            "seed": self.seed,
            "epochs": self.epochs,
            "nis_bins": self.nis_bins,
            "dispersions": self.dispersions.to_table(),
            **({"individuals": True} if self.individuals else {}),
        }

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of :meth:`to_table`."""
        text = json.dumps(self.to_table(), sort_keys=True, allow_nan=False, default=float)
        return hashlib.sha256(text.encode()).hexdigest()


def unit(plan: Plan, run: int, scenario: Scenario | None = None) -> Scenario:
    """Return the scenario of one run, with its own gyro and sensors; ``scenario``: the plan's, prepared."""
    common = plan.scenario if scenario is None else scenario
    own = scenarios.drawn(common, plan.seed, run) if plan.individuals else common
    return replace(own, gyro=dispersed(own.gyro, plan.dispersions, plan.seed, run))


def from_table(table: Mapping[str, Any]) -> Plan:
    """Return the plan of a table that :meth:`Plan.to_table` returned."""
    import tomli_w

    return Plan(
        scenario=scenarios.scenario_from_toml(tomli_w.dumps(dict(table["scenario"]))),
        setup=setup.from_table(table["filter"]),
        dispersions=_dispersions(table["dispersions"], "dispersions"),
        individuals=bool(table.get("individuals", False)),
        **{name: table[name] for name in ("seed", "epochs", "nis_bins")},
    )


def read_dispersions(path: str | os.PathLike[str]) -> Dispersions:
    """Read the table ``[dispersions]`` of a TOML file, such as a scenario's with this table added."""
    remedy = f"its keys are {', '.join(tables.keys(_FORM))}"
    return tables.read(path, "dispersions", remedy, _dispersions)


def _dispersions(table: Mapping[str, Any], place: str) -> Dispersions:
    return tables.build(Dispersions, table, _FORM, place)  # type: ignore[no-any-return]


def whole_epochs(scenario: Scenario, filter_setup: FilterSetup) -> int:
    """Return the largest number of epochs, at most 100, that divide the filter steps of a scenario; 1 if its last step is not whole."""
    need_setup(filter_setup)
    samples, step = round(scenario.duration * scenario.rate), filter_setup.integration.samples
    return max((n for n in range(1, 101) if samples % (n * step) == 0), default=1)
