"""Long soak, by option: ``pytest tests/attack --soak 1000000000`` steps of the filter, and a tenth as many with error states."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from strapdown import estimation, quaternion, scenarios
from strapdown.estimation import setup

CHUNK = 100_000


def passes(request) -> int:
    steps = request.config.getoption("--soak")
    if not steps:
        pytest.skip("minutes; run it with --soak STEPS")
    return steps


def need_sound(estimate) -> None:
    """Covariances symmetric and positive definite, attitudes of norm one, nothing that is no number."""
    P = estimate.covariance
    assert np.isfinite(P).all()
    scale = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert (scale > 0.0).all()
    unit = P / (scale[:, :, None] * scale[:, None, :])
    assert np.abs(unit - np.swapaxes(unit, 1, 2)).max() < 1e-9
    assert np.linalg.eigvalsh(unit)[:, 0].min() > 0.0
    assert np.abs(np.linalg.norm(estimate.attitude, axis=1) - 1.0).max() < 1e-9
    assert np.isfinite(estimate.bias).all()


@pytest.mark.parametrize("states", [False, True])
def test_covariances_stay_positive_definite_for_ever(request, states):
    """The same record again and again, each pass from where the one before ended, with its last covariance."""
    scenario = dataclasses.replace(
        scenarios.load_scenario("low-orbit"), rate=100.0, duration=CHUNK / 100.0, gyro_preset=""
    )
    if states:
        scenario = dataclasses.replace(scenario, gyro=dataclasses.replace(scenario.gyro, scale_factor=np.full(3, 1e-4)))
    filter_setup = setup.FilterSetup.for_scenario(scenario, states=states)
    record = scenarios.simulate(scenario, 5)
    state = setup.initial_state(filter_setup, record.truth.attitude[0], record.truth.bias[0])
    ends = record.truth.attitude[0], record.truth.attitude[-1]
    for _ in range(max(1, passes(request) // (10 if states else 1) // CHUNK)):
        estimate = setup.run(record, filter_setup, state, every=1000, full_covariance=True)
        need_sound(estimate)
        # The next pass begins at the record's start with the error of this one's end.
        error = quaternion.multiply(quaternion.conjugate(ends[1]), estimate.attitude[-1])
        attitude = quaternion.normalize(quaternion.multiply(ends[0], error))
        state = estimation.State(attitude=attitude, bias=record.truth.bias[0], covariance=estimate.covariance[-1])
