"""Scenarios: a motion, a gyro and sensors; simulating one gives a record with its truth.

- ``scenario``: :class:`Scenario`, :class:`Temperature`.
- ``simulation``: :func:`simulate`; units drawn at random, :func:`drawn`.
- ``toml``: Scenarios as TOML files; the built-in ones, :data:`SCENARIOS`.
- ``keys``: The keys of such a file with units, defaults and examples.
"""

from strapdown.scenarios.scenario import Scenario as Scenario
from strapdown.scenarios.scenario import Temperature as Temperature
from strapdown.scenarios.simulation import drawn as drawn
from strapdown.scenarios.simulation import simulate as simulate
from strapdown.scenarios.toml import SCENARIOS as SCENARIOS
from strapdown.scenarios.toml import as_scenario as as_scenario
from strapdown.scenarios.toml import builtin as builtin
from strapdown.scenarios.toml import builtin_toml as builtin_toml
from strapdown.scenarios.toml import load_scenario as load_scenario
from strapdown.scenarios.toml import scenario_from_toml as scenario_from_toml
from strapdown.scenarios.toml import scenario_to_table as scenario_to_table
from strapdown.scenarios.toml import scenario_to_toml as scenario_to_toml

__all__ = ["SCENARIOS", "Scenario", "Temperature", "drawn", "load_scenario", "simulate"]
