"""The Monte Carlo in lanes: ns per run-step, compared with the machine's peak and with peers. ``python benchmarks/montecarlo.py``.

A run-step is one gyro sample of one run: noise, sensor, prediction, one update with a direction, statistics. Times are the minimum process
times of several repeats, so that other load has little effect; the ratio of two threads is of wall times and needs an idle machine.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import motion, vectors
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import States
from strapdown.estimation.states import ProcessNoise, initial_state
from strapdown.estimation.step_filter import StepFilter
from strapdown.files import write_json
from strapdown.gyro import GyroSpec
from strapdown.kernels.machine import describe
from strapdown.montecarlo import lanes, scalar
from strapdown.montecarlo.plan import Plan
from strapdown.scenarios import Scenario

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


def with_states(seconds: float) -> Plan:
    """Return a plan of a satellite with a star tracker at 2 Hz and a gyro with error states for scale, misalignment and drift."""
    spec = GyroSpec(angle_random_walk=4e-5, scale_factor=np.full(3, 2e-4), turn_on_bias_sigma=1e-4)
    scenario = Scenario(
        motion=motion.ConstantRate(rate=np.array([0.02, -0.03, 0.05])),
        gyro=spec,
        sensors=(vectors.AttitudeSensor(name="tracker", sigma_across=2.4e-5, sigma_about=1.5e-4, rate=2.0),),
        rate=RATE,
        duration=seconds,
    )
    states = States(gyro_scale_sigma=3e-4, gyro_misalignment_sigma=1e-4, gyro_drift_sigma=1.5e-6, gyro_drift_time=300.0)
    noise = ProcessNoise(angle_random_walk=4e-5, rate_random_walk=1e-8)
    setup = FilterSetup(process_noise=noise, attitude_sigma=0.01, bias_sigma=1e-4, states=states)
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


def least(work: Callable[[], Any], repeats: int) -> float:
    """Return the minimum process time of some calls after one to warm up, s."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def simdkalman_ns(repeats: int) -> float | None:
    """Return ns per run-step of simdkalman: 6 states, 3 measurements, 200 runs at once."""
    try:
        import simdkalman
    except ImportError:
        return None
    F, H = np.eye(6), np.eye(3, 6)
    F[:3, 3:] = -np.eye(3) / RATE
    filter_ = simdkalman.KalmanFilter(
        state_transition=F, process_noise=1e-8 * np.eye(6), observation_model=H, observation_noise=1e-4 * np.eye(3)
    )
    data = 0.01 * np.random.default_rng(0).standard_normal((200, 200, 3))
    work = lambda: filter_.compute(data, 0, filtered=True, smoothed=False)  # noqa: E731
    return least(work, max(repeats // 4, 2)) / data.shape[0] / data.shape[1] * 1e9


def filterpy_ns(repeats: int, few: int = 200) -> float:
    """Return ns per step of the filter's interface on filterpy."""
    up = vectors.VectorMeasurements(
        sensor="up", kind="direction", time=np.zeros(1), vector_b=np.eye(3)[2:], sigma=np.full(1, 0.01)
    )

    def work() -> None:
        f = StepFilter(NOISE, initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-2, bias_sigma=1e-3))
        for _ in range(few):
            f.predict((1e-3, 0.0, 0.0), 1.0 / RATE)
            f.update(up)

    return least(work, max(repeats // 4, 2)) / few * 1e9


def threads_ratio(campaign: Plan, runs: int) -> float:
    """Return the ratio of the wall time of two chunks in sequence to that in two threads."""
    start = time.perf_counter()
    for first in (0, runs):
        lanes.run_chunk(campaign, first, runs)
    alone = time.perf_counter() - start
    with ThreadPoolExecutor(2) as pool:
        start = time.perf_counter()
        list(pool.map(lambda first: lanes.run_chunk(campaign, first, runs), (0, runs)))
        return alone / (time.perf_counter() - start)


def main(*, steps: int = 10_000, runs: int = 160, repeats: int = 9) -> dict[str, Any]:
    """Return all figures, in ns per run-step unless named otherwise."""
    base = plan(steps)
    # The first runs are kept as examples; later ones represent a campaign.
    full = least(lambda: lanes.run_chunk(base, 1000, runs), repeats) / runs / steps * 1e9
    few = plan(2000)
    peers = {
        "scalar machine": least(lambda: scalar.run_chunk(few, 100, 4), 3) / 4 / 2000 * 1e9,
        **{
            f"{name}, {count} error states, {words}": least(lambda p=campaign, m=run_chunk: m(p, 100, 8), 3)  # type: ignore[misc]
            / (8 * campaign.samples)
            * 1e9
            for count, words, campaign in (
                (12, "tracker at 2 Hz", with_states(600.0)),
                (9, "two vectors", two_vectors(60.0)),
            )
            for name, run_chunk in (("lanes", lanes.run_chunk), ("scalar machine", scalar.run_chunk))
        },
        "simdkalman 6x3": simdkalman_ns(repeats),
        "StepFilter on filterpy": filterpy_ns(repeats),
    }
    return {
        "machine": describe(),
        "steps": steps,
        "runs": runs,
        "full": full,
        "peers": peers,
        "two_threads": threads_ratio(base, runs),
        "ten_thousand_squared_s": full * 1e-9 * 1e8 / 2,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--runs", type=int, default=160)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result = main(steps=arguments.steps, runs=arguments.runs, repeats=arguments.repeats)
    print(json.dumps(result["machine"]))
    print(f"whole run-step {result['full']:.1f} ns")
    print(f"    10000 runs of 10000 steps on two idle cores: {result['ten_thousand_squared_s']:.1f} s")
    for name, ns in result["peers"].items():
        if ns is not None:
            print(f"{name}: {ns:.0f} ns, {ns / result['full']:.0f} times the lanes' whole run-step")
    print(f"two threads: {result['two_threads']:.2f} times one")
    if arguments.json:
        write_json(arguments.json, result)
