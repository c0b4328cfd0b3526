"""Tuning four parameters on a long record: ours, other optimisers on the same likelihood, the filterpy interface.

Run ``python benchmarks/tuning.py``.

Each optimiser starts from parameters wrong by a factor and uses the same likelihood; derivatives are from one pass of lanes, or from
differences of whole filter runs. A pass of the filterpy interface is timed; its tuning time is extrapolated from the search without
derivatives.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from strapdown import gyro, motion, scenarios, tuning, vectors
from strapdown.estimation import setup
from strapdown.estimation.step_filter import StepFilter
from strapdown.files import write_json
from strapdown.kernels.machine import describe

FREE = ("gyro.arw", "gyro.rrw", "star 1.sigma", "star 2.sigma")


def record(duration: float, rate: float) -> tuple[scenarios.Scenario, Any]:
    """Return a scenario with two star directions at 1 Hz, and its record."""
    scenario = scenarios.Scenario(
        motion=motion.ConstantRate(rate=np.array([0.01, 0.02, 0.05])),
        gyro=gyro.GyroSpec(angle_random_walk=3e-5, rate_random_walk=2e-7, turn_on_bias_sigma=1e-5),
        sensors=(
            vectors.VectorSensor(name="star 1", reference_f=np.array([1.0, 0.0, 0.0]), sigma=1e-4, rate=1.0),
            vectors.VectorSensor(name="star 2", reference_f=np.array([0.0, 1.0, 1.0]), sigma=2e-4, rate=1.0),
        ),
        rate=rate,
        duration=duration,
    )
    return scenario, scenarios.simulate(scenario, 3)


def seconds(work: Callable[[], Any], repeats: int) -> float:
    """Return the median processor time of ``repeats`` calls after one to warm up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return statistics.median(times)


def step_seconds(case: tuning.Case, filter_setup: setup.FilterSetup, samples: int) -> float:
    """Return the processor time per gyro sample of the filterpy interface, including measurements, s."""
    modelled = setup.modelled_record(case.record, filter_setup)
    filter_ = StepFilter(filter_setup.process_noise, case.initial)
    first, second = modelled.vectors
    dt = float(modelled.time[1] - modelled.time[0])
    every = round(1.0 / dt)
    start = time.process_time()
    for k in range(samples):
        filter_.predict(modelled.increments[k], dt)
        if (k + 1) % every == 0:
            place = (k + 1) // every - 1
            for series in (first, second):
                filter_.update(series, place)
    return (time.process_time() - start) / samples


def main(*, duration: float = 1800.0, rate: float = 100.0, wrong: float = 30.0, repeats: int = 5) -> dict[str, Any]:
    """Return times of a pass, and of each optimiser with the difference of its end from the best."""
    scenario, data = record(duration, rate)
    right = setup.FilterSetup.for_scenario(scenario, attitude_sigma=1e-3, states=False)
    case = tuning.record_case(data, right, seed=1)
    values = tuning.values_of(right, FREE, [data])
    off = tuning.with_values(right, {name: wrong * value for name, value in values.items()})
    objective = tuning.likelihood([case], off, FREE)
    samples = len(data.increments)

    def filter_run() -> None:
        setup.run(data, right, case.initial, every=samples)

    passes = {
        "one ordinary filter run": seconds(filter_run, repeats),
        "eight likelihoods (lanes)": seconds(lambda: objective.minus_log(objective.start), repeats),
        "likelihood, gradient and information of four (lanes)": seconds(
            lambda: objective.derivatives(objective.start), repeats
        ),
    }
    few = min(samples, 3000)
    passes["one run of the filterpy face"] = step_seconds(case, right, few) * samples

    best = tuning.fit(objective, starts=4, intervals=False)
    rows = []

    def report(name: str, work: Callable[[], tuple[np.ndarray, int]]) -> None:
        start = time.process_time()
        point, number = work()
        used = time.process_time() - start
        rows.append(
            {
                "optimiser": name,
                "seconds": used,
                "passes": int(number),  # COBYLA returns an int64
                "short_of_best": float(objective.minus_log(point)[0] - best.after),
            }
        )

    def ours() -> tuple[np.ndarray, int]:
        optimum = tuning.search(objective, objective.start)
        return optimum.point, optimum.steps + 1

    def gradient(x: np.ndarray) -> tuple[float, np.ndarray]:
        derivatives = objective.derivatives(x)
        return float(derivatives.value.sum()), derivatives.score.sum(axis=0)

    def by_runs(x: np.ndarray) -> float:
        return float(objective.minus_log(x)[0])

    def quasi_newton() -> tuple[np.ndarray, int]:
        optimum = minimize(gradient, objective.start, jac=True, method="BFGS", options={"gtol": 1e-2})
        return optimum.x, optimum.nfev

    def differences() -> tuple[np.ndarray, int]:
        optimum = minimize(by_runs, objective.start, jac="3-point", method="BFGS", options={"gtol": 1e-2})
        return optimum.x, optimum.nfev

    def free_of_derivatives(method: str, tolerance: dict[str, float]) -> Callable[[], tuple[np.ndarray, int]]:
        def work() -> tuple[np.ndarray, int]:
            optimum = minimize(by_runs, objective.start, method=method, options={"maxiter": 2000, **tolerance})
            return optimum.x, optimum.nfev

        return work

    report("scoring, lanes (ours)", ours)
    report("BFGS, gradient by lanes", quasi_newton)
    report("BFGS, differences of runs", differences)
    report("Nelder-Mead", free_of_derivatives("Nelder-Mead", {"xatol": 1e-3, "fatol": 1e-3}))
    report("Powell", free_of_derivatives("Powell", {"xtol": 1e-3, "ftol": 1e-9}))
    report("COBYLA (linear models in a trust region)", free_of_derivatives("COBYLA", {"tol": 1e-3, "rhobeg": 1.0}))

    start = time.perf_counter()
    whole = tuning.fit(tuning.likelihood([case], off, FREE), starts=20, threads=2)
    wall = time.perf_counter() - start
    simplex = next(row for row in rows if row["optimiser"] == "Nelder-Mead")
    mine = next(row for row in rows if "ours" in str(row["optimiser"]))
    return {
        "machine": describe(),
        "samples": samples,
        "passes": passes,
        "optimisers": rows,
        "whole": {
            "what": "20 searches and the intervals, 2 threads",
            "wall_seconds": wall,
            "agreeing": whole.agreeing,
        },
        "filterpy_over_ours": {
            "the same search, differences of nine runs a step": passes["one run of the filterpy face"]
            * 9
            * mine["passes"]
            / mine["seconds"],
            "Nelder-Mead": passes["one run of the filterpy face"] * simplex["passes"] / mine["seconds"],
        },
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=1800.0)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result = main(duration=arguments.duration, rate=arguments.rate)
    print(json.dumps(result["machine"]))
    for name, value in result["passes"].items():
        print(f"{name:56s} {1e3 * value:10.1f} ms")
    print(f"{'':44s} {'s':>8s} {'passes':>7s} {'short of the best':>18s}")
    for row in result["optimisers"]:
        print(f"{row['optimiser']:44s} {row['seconds']:8.2f} {row['passes']:7d} {row['short_of_best']:18.2e}")
    print(result["whole"])
    print({name: round(value) for name, value in result["filterpy_over_ours"].items()}, "times slower on filterpy")
    if arguments.json:
        write_json(arguments.json, result)
