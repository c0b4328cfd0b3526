"""Tuning four parameters on a long record: ours, other optimisers on the same likelihood, the filterpy interface.

Run ``python benchmarks/tuning.py``. Each optimiser starts from parameters wrong by a factor of 30 and uses the same likelihood; derivatives
are from one pass of lanes, or from differences of whole filter runs. Beside the time of each search stand its passes over the record and
how far it ends short of the best likelihood. A pass of the filterpy interface is timed; with nine of them a step, ours would take
``passes × 9`` of its time.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import timing
from strapdown import gyro, motion, scenarios, tuning, vectors
from strapdown.estimation import setup
from strapdown.estimation.step_filter import StepFilter

FREE = ("gyro.arw", "gyro.rrw", "star 1.sigma", "star 2.sigma")
WRONG = 30.0
FILTER = "one ordinary filter run"


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


def step_by_step(case: tuning.Case, filter_setup: setup.FilterSetup, samples: int) -> None:
    """Run the filterpy interface over the first gyro samples and their measurements."""
    modelled = setup.modelled_record(case.record, filter_setup)
    filter_ = StepFilter(filter_setup.process_noise, case.initial)
    first, second = modelled.vectors
    dt = float(modelled.time[1] - modelled.time[0])
    every = round(1.0 / dt)
    for k in range(samples):
        filter_.predict(modelled.increments[k], dt)
        if (k + 1) % every == 0:
            place = (k + 1) // every - 1
            for series in (first, second):
                filter_.update(series, place)


def searches(objective: Any) -> dict[str, Callable[[], tuple[Any, int]]]:
    """Return searches by name, each with its end and its number of passes."""

    def ours() -> tuple[Any, int]:
        optimum = tuning.search(objective, objective.start)
        return optimum.point, optimum.steps + 1

    def gradient(x: np.ndarray) -> tuple[float, np.ndarray]:
        derivatives = objective.derivatives(x)
        return float(derivatives.value.sum()), derivatives.score.sum(axis=0)

    def of_scipy(function: Callable[[np.ndarray], Any], **how: Any) -> Callable[[], tuple[Any, int]]:
        def work() -> tuple[Any, int]:
            optimum = minimize(function, objective.start, **how)
            return optimum.x, int(optimum.nfev)

        return work

    by_runs = lambda x: float(objective.minus_log(x)[0])  # noqa: E731
    return {
        "scoring, lanes (ours)": ours,
        "BFGS, gradient by lanes": of_scipy(gradient, jac=True, method="BFGS", options={"gtol": 1e-2}),
        "BFGS, differences of runs": of_scipy(by_runs, jac="3-point", method="BFGS", options={"gtol": 1e-2}),
        "Nelder-Mead": of_scipy(by_runs, method="Nelder-Mead", options={"maxiter": 2000, "xatol": 1e-3, "fatol": 1e-3}),
        "Powell": of_scipy(by_runs, method="Powell", options={"maxiter": 2000, "xtol": 1e-3, "ftol": 1e-9}),
    }


def main(*, duration: float = 1800.0, rate: float = 100.0, repeats: int = 5) -> dict[str, float]:
    """Return the times of a pass, and of each search, ns per sample."""
    scenario, data = record(duration, rate)
    right = setup.FilterSetup.for_scenario(scenario, attitude_sigma=1e-3, states=False)
    case = tuning.record_case(data, right, seed=1)
    values = tuning.values_of(right, FREE, [data])
    off = tuning.with_values(right, {name: WRONG * value for name, value in values.items()})
    objective = tuning.likelihood([case], off, FREE)
    samples = len(data.increments)
    few = min(samples, 3000)
    passes: dict[str, timing.Work] = {
        FILTER: (lambda: setup.run(data, right, case.initial, every=samples), samples),
        "eight likelihoods (lanes)": (lambda: objective.minus_log(objective.start), samples),
        "likelihood, gradient and information of four (lanes)": (
            lambda: objective.derivatives(objective.start),
            samples,
        ),
        "one run of the filterpy interface": (lambda: step_by_step(case, right, few), few),
    }
    times = timing.least(passes, repeats)
    best = tuning.fit(objective, starts=4, intervals=False).after
    for name, search in searches(objective).items():
        begin = time.process_time()
        point, number = search()
        spent = time.process_time() - begin
        short = float(objective.minus_log(point)[0] - best)
        times[f"{name}: {spent:.2f} s, {number} passes, {short:.1e} short of the best"] = 1e9 * spent / samples
    return times


if __name__ == "__main__":
    timing.command(main, FILTER)
