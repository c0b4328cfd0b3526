"""Two stars seen once a second by a body that turns at constant rate: what tests of tuning tune on."""

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
    """The scenario; ``walk`` is the gyro's rate random walk, ``outliers`` their share among the measurements."""
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
    """A record of it, where a right filter starts on it."""
    return tuning.record_case(scenarios.simulate(scenario(duration, **changes), seed), BELIEVED, seed=seed)
