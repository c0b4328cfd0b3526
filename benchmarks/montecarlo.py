"""The Monte Carlo of the lanes: ns a run-step, against the machine's own peak and against peers. ``python benchmarks/montecarlo.py``.

A run-step is one gyro sample of one run: noise, sensor, prediction, one update with a direction, statistics. Times are process times, the
least of several repeats, so that other work on the machine counts little; the ratio of two threads is of wall times and wants an idle
machine.
"""

from __future__ import annotations

import argparse
import json
import operator
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import motion, vectors
from strapdown.files import write_json
from strapdown.gyro import GyroSpec
from strapdown.kernels import lane_probes
from strapdown.kernels.filter_step import predict, update_direction_and_judge
from strapdown.kernels.machine import compiled, describe
from strapdown.kernels.rotation import rotation_matrix
from strapdown.mekf import ProcessNoise, StepFilter, initial_state
from strapdown.montecarlo import lanes, scalar
from strapdown.montecarlo.plan import Plan
from strapdown.scenarios import Scenario
from strapdown.setup import FilterSetup

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)
RATE = 100.0


class Counted:
    """A number that counts what is done with it."""

    operations = 0

    def __init__(self, value: float) -> None:
        self.value = value

    def _with(self, other: Any, work: Callable[[float, float], float]) -> Counted:
        Counted.operations += 1
        return Counted(work(self.value, other.value if isinstance(other, Counted) else other))

    def __add__(self, other: Any) -> Counted:
        return self._with(other, operator.add)

    def __sub__(self, other: Any) -> Counted:
        return self._with(other, operator.sub)

    def __mul__(self, other: Any) -> Counted:
        return self._with(other, operator.mul)

    def __truediv__(self, other: Any) -> Counted:
        return self._with(other, operator.truediv)

    __radd__, __rmul__ = __add__, __mul__

    def __rsub__(self, other: Any) -> Counted:
        return self._with(other, lambda a, b: b - a)

    def __rtruediv__(self, other: Any) -> Counted:
        return self._with(other, lambda a, b: b / a)

    def __neg__(self) -> Counted:
        return Counted(-self.value)

    def __lt__(self, other: Any) -> bool:
        return bool(self.value < (other.value if isinstance(other, Counted) else other))

    def __gt__(self, other: Any) -> bool:
        return bool(self.value > (other.value if isinstance(other, Counted) else other))


def operations_a_step() -> int:
    """Return the additions, multiplications and divisions of one prediction and one update, by counting them."""

    def numbers(*values: float) -> tuple[Counted, ...]:
        return tuple(Counted(value) for value in values)

    Counted.operations = 0
    q, b, B = numbers(1.0, 0.0, 0.0, 0.0), numbers(0.0, 0.0, 0.0), numbers(*[0.0] * 9)
    A, C = numbers(1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4), numbers(1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
    q, A, B, C = predict(q, b, A, B, C, numbers(1e-3, 2e-3, 3e-3), 0.01, 1e-8, 1e-12)
    u, v, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), numbers(0.01, 0.0, 1.0)
    update_direction_and_judge(q, b, A, B, C, rotation_matrix(q), u, v, z, 1e-4)
    return Counted.operations


def plan(steps: int, precision: str = "float64") -> Plan:
    """Return one direction a gyro sample, ARW and rate random walk, a hundred epochs."""
    scenario = Scenario(
        motion=motion.ConstantRate(rate=np.array([0.02, -0.03, 0.05])),
        gyro=GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-6, turn_on_bias_sigma=1e-3),
        sensors=(vectors.VectorSensor(name="star", reference_f=[0.3, 0.5, 1.0], sigma=0.01, rate=RATE),),
        rate=RATE,
        duration=steps / RATE,
    )
    setup = FilterSetup(process_noise=NOISE, attitude_sigma=0.02, bias_sigma=1e-3)
    return Plan(scenario=scenario, setup=setup, seed=1, epochs=100, nis_bins=100, precision=precision)


def least(work: Callable[[], Any], repeats: int) -> float:
    """Return the least process time of some calls after one to warm up, s."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def probes(repeats: int) -> dict[str, dict[str, float]]:
    """Return by precision: fused multiply-adds a ns of all lanes together, ns a run-step of the filter alone, ns a normal."""
    return {
        "float64": probe(np.float64, 8, repeats),
        "float32": probe(np.float32, 16, repeats),
    }


def probe(real: Any, width: int, repeats: int) -> dict[str, float]:
    """Return the figures of one precision."""
    pattern = tuple(real(0.0) for _ in range(width))
    turns, number = 20_000, 2000
    peak = least(lambda: compiled(lane_probes.peak)(pattern, np.ones(width, real), turns), repeats)
    state = np.zeros((28, width), real)
    state[0] = 1.0
    state[[7, 10, 12]], state[[22, 25, 27]] = 1e-4, 1e-6
    inputs = (1e-3 * np.random.default_rng(0).standard_normal((3, width))).astype(real).reshape(-1)
    kernel = least(lambda: compiled(lane_probes.steps)(pattern, state.copy().reshape(-1), inputs, number), repeats)
    rows, runs = np.empty(4000 * width, real), np.arange(width, dtype=np.uint64)
    normals = least(lambda: compiled(lane_probes.normals)(pattern, runs, rows), repeats)
    return {
        "fused_per_ns": turns * lane_probes.FUSED * width / peak * 1e-9,
        "kernel_ns": kernel / number / width * 1e9,
        "normal_ns": normals / len(rows) * 1e9,
    }


def simdkalman_ns(repeats: int) -> float | None:
    """Return ns a run-step of simdkalman: plain 6 states, 3 measurements, 200 runs at once."""
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
    """Return ns a step of the filter's face on filterpy."""

    def work() -> None:
        f = StepFilter(NOISE, initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-2, bias_sigma=1e-3))
        for _ in range(few):
            f.predict((1e-3, 0.0, 0.0), 1.0 / RATE)
            f.update_direction((0.0, 0.0, 1.0), (0.0, 0.0, 1.0), 0.01)

    return least(work, max(repeats // 4, 2)) / few * 1e9


def threads_ratio(one: Plan, runs: int) -> float:
    """Return wall time of two chunks one after the other over that of two threads."""
    start = time.perf_counter()
    for first in (0, runs):
        lanes.run_chunk(one, first, runs)
    alone = time.perf_counter() - start
    with ThreadPoolExecutor(2) as pool:
        start = time.perf_counter()
        list(pool.map(lambda first: lanes.run_chunk(one, first, runs), (0, runs)))
        return alone / (time.perf_counter() - start)


def main(*, steps: int = 10_000, runs: int = 160, repeats: int = 9) -> dict[str, Any]:
    """Return all figures, ns a run-step unless the name says otherwise."""
    machine = probes(repeats)
    full = {}
    for precision in ("float64", "float32"):
        one = plan(steps, precision)
        # The first runs are kept as examples; later ones are what a campaign is made of.
        full[precision] = least(lambda p=one: lanes.run_chunk(p, 1000, runs), repeats) / runs / steps * 1e9  # type: ignore[misc]
    few = plan(2000)
    peers = {
        "scalar machine": least(lambda: scalar.run_chunk(few, 100, 4), 3) / 4 / 2000 * 1e9,
        "simdkalman 6x3": simdkalman_ns(repeats),
        "StepFilter on filterpy": filterpy_ns(repeats),
    }
    return {
        "machine": describe(),
        "steps": steps,
        "runs": runs,
        "full": full,
        "probes": machine,
        "operations_a_step": operations_a_step(),
        "share_of_peak": {
            name: operations_a_step() / values["kernel_ns"] / (2.0 * values["fused_per_ns"])
            for name, values in machine.items()
        },
        "peers": peers,
        "two_threads": threads_ratio(plan(steps), runs),
        "ten_thousand_squared_s": {name: ns * 1e-9 * 1e8 / 2 for name, ns in full.items()},
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
    for name, ns in result["full"].items():
        probe = result["probes"][name]
        print(
            f"{name}: whole run-step {ns:.1f} ns, filter alone {probe['kernel_ns']:.1f} ns "
            f"({100 * result['share_of_peak'][name]:.0f} % of the peak of {2 * probe['fused_per_ns']:.0f} operations a ns), "
            f"normal {probe['normal_ns']:.2f} ns"
        )
        print(f"    10000 runs of 10000 steps on two idle cores: {result['ten_thousand_squared_s'][name]:.1f} s")
    for name, ns in result["peers"].items():
        if ns is not None:
            print(f"{name}: {ns:.0f} ns, {ns / result['full']['float64']:.0f} times the lanes' whole run-step")
    print(f"two threads: {result['two_threads']:.2f} times one")
    if arguments.json:
        write_json(arguments.json, result)
