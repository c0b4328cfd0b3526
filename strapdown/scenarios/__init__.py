"""Scenarios: a motion, a gyro and sensors; simulating one gives a record with its truth.

- ``scenario``: :class:`Scenario`, :class:`Temperature`.
- ``simulation``: :func:`simulate`; units drawn at random, :func:`drawn`.
- ``toml``: Scenarios as TOML files; the built-in ones, :data:`SCENARIOS`.
- ``keys``: The keys of such a file with units, defaults and examples.
"""

from strapdown.scenarios.scenario import Scenario, Temperature
from strapdown.scenarios.simulation import drawn, simulate
from strapdown.scenarios.toml import (
    SCENARIOS,
    as_scenario,
    builtin,
    builtin_toml,
    load_scenario,
    scenario_from_toml,
    scenario_to_table,
    scenario_to_toml,
)

__all__ = ["SCENARIOS", "Scenario", "Temperature", "drawn", "load_scenario", "simulate"]
