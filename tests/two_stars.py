"""Two stars measured once a second on a body rotating at constant rate: the scenario for tests of tuning."""

from __future__ import annotations

from typing import Any

import numpy as np

from strapdown import gyro, motion, scenarios, tuning, vectors
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise

ARW, RRW = 1e-4, 3e-6
SIGMAS = (1e-4, 2e-4)
FREE = ("gyro.arw", "gyro.rrw", "star 1.sigma", "star 2.sigma")
TRUTH = np.array([ARW, RRW, *SIGMAS])
WRONG = dict(zip(FREE, TRUTH * np.array([3.0, 3.0, 0.3, 3.0]), strict=True))
BELIEVED = FilterSetup(
    process_noise=ProcessNoise(angle_random_walk=ARW, rate_random_walk=RRW), attitude_sigma=1e-3, bias_sigma=1e-4
)


def scenario(
    duration: float = 200.0, *, rate: float = 4.0, walk: float = RRW, outliers: float = 0.0
) -> scenarios.Scenario:
    """Return the scenario; ``walk`` is the rate random walk of the gyro, ``outliers`` the probability of an outlier."""
    faults = vectors.Faults(outlier_probability=outliers, outlier_scale=10.0)
    return scenarios.Scenario(
        motion=motion.ConstantRate(rate=np.array([0.01, 0.02, 0.05])),
        gyro=gyro.GyroSpec(angle_random_walk=ARW, rate_random_walk=walk, turn_on_bias_sigma=1e-4),
        sensors=tuple(
            vectors.VectorSensor(
                name=f"star {k}", reference_f=np.array(reference), sigma=sigma, rate=1.0, faults=faults
            )
            for k, reference, sigma in zip((1, 2), ([1.0, 0.0, 0.0], [0.0, 1.0, 1.0]), SIGMAS, strict=True)
        ),
        rate=rate,
        duration=duration,
    )


def case(seed: int = 0, duration: float = 200.0, **changes: Any) -> tuning.Case:
    """Return a tuning case: a record of the scenario with the initial state of the correct filter."""
    return tuning.record_case(scenarios.simulate(scenario(duration, **changes), seed), BELIEVED, seed=seed)
