"""The Monte Carlo in lanes, compared with one run at a time and with a peer: ``python benchmarks/montecarlo.py``.

A sample is one gyro sample of one run: noise, sensor, prediction, one update with a direction, statistics.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import timing
from strapdown import motion, vectors
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import States
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.montecarlo import lanes, scalar
from strapdown.montecarlo.plan import Plan
from strapdown.scenarios import Scenario

LANES = "lanes"
NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)
RATE = 100.0


def plan(steps: int) -> Plan:
    """Return a plan with one direction per gyro sample, angle and rate random walk, and 100 epochs."""
    scenario = Scenario(
        motion=motion.ConstantRate(rate=np.array([0.02, -0.03, 0.05])),
        gyro=GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-6, turn_on_bias_sigma=1e-3),
        sensors=(vectors.VectorSensor(name="star", reference_f=[0.3, 0.5, 1.0], sigma=0.01, rate=RATE),),
        rate=RATE,
        duration=steps / RATE,
    )
    setup = FilterSetup(process_noise=NOISE, attitude_sigma=0.02, bias_sigma=1e-3)
    return Plan(scenario=scenario, setup=setup, seed=1, epochs=100, nis_bins=100)


def two_vectors(seconds: float) -> Plan:
    """Return a plan with two directions per gyro sample and a gyro with error states for scale and misalignment: 15 states."""
    rotation = motion.ConstantRate(rate=np.array([0.02, -0.03, 0.05]))
    spec = GyroSpec(
        angle_random_walk=1e-4, rate_random_walk=1e-6, scale_factor=np.full(3, 2e-4), turn_on_bias_sigma=1e-3
    )
    sensors = tuple(
        vectors.VectorSensor(name=name, reference_f=r, sigma=0.01, rate=RATE)
        for name, r in (("star", [0.3, 0.5, 1.0]), ("sun", [1.0, 0.0, 0.1]))
    )
    scenario = Scenario(motion=rotation, gyro=spec, sensors=sensors, rate=RATE, duration=seconds)
    states = States(gyro_scale_sigma=3e-4, gyro_misalignment_sigma=1e-4)
    setup = FilterSetup(process_noise=NOISE, attitude_sigma=0.02, bias_sigma=1e-3, states=states)
    return Plan(scenario=scenario, setup=setup, seed=1, epochs=100, nis_bins=100)


def simdkalman_work() -> dict[str, timing.Work]:
    """Return simdkalman, if it is installed: 6 states, 3 measurements, 200 runs at once."""
    try:
        import simdkalman
    except ImportError:
        return {}
    F, H = np.eye(6), np.eye(3, 6)
    F[:3, 3:] = -np.eye(3) / RATE
    filter_ = simdkalman.KalmanFilter(
        state_transition=F, process_noise=1e-8 * np.eye(6), observation_model=H, observation_noise=1e-4 * np.eye(3)
    )
    data = 0.01 * np.random.default_rng(0).standard_normal((200, 200, 3))
    return {"simdkalman 6x3": (lambda: filter_.compute(data, 0, filtered=True, smoothed=False), 200 * 200)}


def main(*, steps: int = 10_000, runs: int = 160, repeats: int = 9) -> dict[str, float]:
    """Return the times per run and step, ns."""
    base, few, states = plan(steps), plan(2000), two_vectors(60.0)
    # The first runs are kept as examples; later ones represent a campaign.
    works: dict[str, timing.Work] = {
        LANES: (lambda: lanes.run_chunk(base, 1000, runs), runs * steps),
        "scalar machine": (lambda: scalar.run_chunk(few, 1000, 4), 4 * 2000),
        "lanes, 9 error states, two vectors": (lambda: lanes.run_chunk(states, 1000, 8), 8 * states.samples),
        "scalar machine, 9 error states, two vectors": (lambda: scalar.run_chunk(states, 1000, 8), 8 * states.samples),
        **simdkalman_work(),
    }
    return timing.least(works, repeats)


if __name__ == "__main__":
    timing.command(main, LANES)
