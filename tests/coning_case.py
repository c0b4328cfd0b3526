"""What tests of figures and pages use: the coning scenario with a noisy gyro, and a filter of four samples a step on it."""

import dataclasses

from strapdown import coning, gyro, records, scenarios
from strapdown.estimation import setup

SPEC = gyro.GyroSpec(angle_random_walk=5e-5, rate_random_walk=1e-6, turn_on_bias_sigma=1e-4)
SCENARIO = dataclasses.replace(scenarios.load_scenario("coning"), gyro=SPEC, gyro_preset="", duration=20.0)
SETUP = dataclasses.replace(
    setup.FilterSetup.for_scenario(SCENARIO, states=False), integration=coning.ALGORITHMS["four-sample"]
)


def estimated(scenario=SCENARIO, filter_setup=SETUP):
    """Return an estimate from the true start, and the truth at its epochs."""
    record = scenarios.simulate(scenario, 3)
    start = setup.initial_state(filter_setup, record.truth.attitude[0], record.truth.bias[0])
    estimate = setup.run(record, filter_setup, start, full_covariance=True)
    return estimate, records.compress(record, filter_setup.integration).truth
