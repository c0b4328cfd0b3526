"""A short Monte Carlo of a spinning body, and whether two statistics are equal to the bit."""

from dataclasses import fields, replace

import numpy as np

from strapdown import montecarlo, scenarios
from strapdown.estimation.setup import FilterSetup
from strapdown.montecarlo.statistics import Statistics

SCENARIO = replace(scenarios.load_scenario("spin"), duration=2.4)
SETUP = FilterSetup.for_scenario(SCENARIO, states=False)
PLAN = montecarlo.Plan(scenario=SCENARIO, setup=SETUP, seed=4, epochs=6, nis_bins=5)


def different(a, b, names=None):
    """Return the names of the fields in which two statistics differ in any bit."""
    names = names or [field.name for field in fields(Statistics)]
    return [name for name in names if not np.array_equal(getattr(a, name), getattr(b, name))]


def assert_same(a, b) -> None:
    """Assert that two statistics are equal to the bit."""
    assert not different(a, b)
