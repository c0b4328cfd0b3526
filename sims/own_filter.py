"""Is a user-defined filter consistent? A filter that is not part of the package, judged like the package's own.

The filter below is the textbook's MEKF in twenty lines of NumPy: one vector at a time, the covariance propagated to first order. It is a
function of a record and an initial state; an object with such a method ``run`` works too. In a setup, it can be used like the package's
filter: in a Monte Carlo in threads or on Dask, resumed after a kill, replayed run by run, and in ``filters.compare``.

``python sims/own_filter.py`` runs it and the package's filter on the same runs, and then one with a deliberate fault: the reference of the
second sensor rotated by 0.3°.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from strapdown import montecarlo, motion, quaternion, scenarios, vectors
from strapdown.estimation import State, filters, setup
from strapdown.files import write_json
from strapdown.gyro import GyroSpec
from strapdown.kinematics import skew
from strapdown.records import Estimate, ImuRecord
from strapdown.units import DEGREE, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR

SMALL = {"runs": 6, "duration": 20.0}
"""Arguments of a quick test run."""

GYRO = GyroSpec(angle_random_walk=0.3 * DEGREE_PER_ROOT_HOUR, rate_random_walk=20.0 * DEGREE_PER_HOUR_PER_ROOT_HOUR)


# [example]
def textbook(record: ImuRecord, initial: State) -> Estimate:
    """Return attitude and bias by a multiplicative Kalman filter, one vector at a time (Markley & Crassidis 2014, section 6.2)."""
    q, b, P = initial.attitude, initial.bias, initial.covariance
    Q = np.kron(np.diag([GYRO.angle_random_walk**2, GYRO.rate_random_walk**2]), np.eye(3))
    rows = [(q, b, P)]
    for k, dt in enumerate(record.intervals):
        turn = record.increments[k] - b * dt
        q = quaternion.multiply(q, quaternion.exp(turn))
        F = np.eye(6) + np.block([[-skew(turn), -dt * np.eye(3)], [np.zeros((3, 6))]])
        P = F @ P @ F.T + Q * dt
        for series in record.vectors:
            for j in np.flatnonzero(np.abs(series.time - record.time[k + 1]) < 0.5 * dt):
                expected = quaternion.rotate(quaternion.conjugate(q), series.references_f[j])
                H = np.hstack([skew(expected), np.zeros((3, 3))])
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + series.sigma[j] ** 2 * np.eye(3))
                d = K @ (series.vector_b[j] - expected)
                q, b = quaternion.normalize(quaternion.multiply(q, quaternion.exp(d[:3]))), b + d[3:]
                P = (np.eye(6) - K @ H) @ P
        rows.append((q, b, P))
    attitude, bias, covariance = zip(*rows, strict=True)
    return Estimate.from_arrays(record.time, attitude, covariance, bias=bias)


# [end]


def turned_reference(record: ImuRecord, initial: State) -> Estimate:
    """Return the estimate of the same filter with a wrong reference: the second sensor's, rotated by 0.3° about z."""
    turn = quaternion.exp(np.array([0.0, 0.0, 0.3 * DEGREE]))
    first, second = record.vectors
    wrong = replace(second, reference_f=quaternion.rotate(turn, second.reference_f))
    return textbook(replace(record, vectors=(first, wrong)), initial)


def scenario(duration: float) -> scenarios.Scenario:
    """Return a slowly tumbling body with two direction sensors at 1 Hz."""
    references = {"sun": (0.0, 0.6, 0.8), "field": (0.8, 0.0, -0.6)}
    return scenarios.Scenario(
        motion=motion.ConstantRate(rate=(0.02, -0.03, 0.05)),
        gyro=GYRO,
        sensors=tuple(
            vectors.VectorSensor(name=name, reference_f=np.array(r), sigma=0.5 * DEGREE, rate=1.0)
            for name, r in references.items()
        ),
        rate=5.0,
        duration=duration,
    )


@dataclass(frozen=True, kw_only=True)
class Result:
    """Verdicts on each filter."""

    statistics: dict[str, montecarlo.Statistics]
    verdicts: dict[str, str]
    comparison: str
    """The table of one run."""


FILTERS: dict[str, str | Callable[[ImuRecord, State], Estimate]] = {
    "mekf": "mekf",
    "textbook": textbook,
    "turned reference": turned_reference,
}


def main(*, runs: int = 200, duration: float = 60.0, seed: int = 1, out: Path | str | None = None) -> Result:
    """Judge the filters over the same runs; verdicts are written to ``out`` if it is given."""
    flight = scenario(duration)
    base = setup.FilterSetup.for_scenario(flight, states=False)
    setups = [replace(base, estimator=estimator) for estimator in FILTERS.values()]
    statistics = montecarlo.run(flight, setups, runs=runs, seed=seed, epochs=20)
    judgements = {name: result.judge() for name, result in zip(FILTERS, statistics, strict=True)}
    plan = montecarlo.Plan(scenario=flight, setup=base, seed=seed, epochs=20)
    replayed = montecarlo.replay(plan, 0, machine="scalar")
    table = filters.compare(replayed.record, base.process_noise, replayed.initial, filters=["mekf", textbook])
    if out is not None:
        Path(out).mkdir(parents=True, exist_ok=True)
        write_json(Path(out) / "own_filter.json", {name: judgement.summary() for name, judgement in judgements.items()})
    return Result(
        statistics=dict(zip(FILTERS, statistics, strict=True)),
        verdicts={name: judgement.words for name, judgement in judgements.items()},
        comparison=str(table),
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/own_filter"))
    arguments = parser.parse_args()
    result = main(runs=arguments.runs, seed=arguments.seed, out=arguments.out)
    print(result.comparison)
    for name, words in result.verdicts.items():
        print(f"\n{name}: {words}")
