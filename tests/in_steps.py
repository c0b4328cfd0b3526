"""A record processed by the step-by-step filter, for comparison with the compiled one."""

from types import SimpleNamespace

import numpy as np
import pytest
from gated_steps import GatedStepFilter
from measured import correlation, state_errors

from strapdown import estimation
from strapdown.estimation.states import covariance_matrices
from strapdown.kernels import filter_step


def transition_and_noise(phi, dt, process_noise):
    """Return Φ and Q (6, 6) of attitude and bias over a rotation φ at constant rate, as matrices, by the formulas of the kernels."""
    turn = tuple(float(component) for component in phi)
    phi11, phi12 = filter_step.transition(turn, dt)
    q11, q12, q22 = filter_step.process_noise(
        turn, dt, process_noise.angle_random_walk**2, process_noise.rate_random_walk**2
    )
    F = np.eye(6)
    F[:3, :3] = np.reshape(phi11, (3, 3))
    F[:3, 3:] = np.reshape(phi12, (3, 3))
    return F, covariance_matrices(np.array([*q11, *q12, q22, 0.0, 0.0, q22, 0.0, q22]))


def fed(f, record, after=lambda sensor: None):
    """Process a record, intervals split at the measurements; return attitudes, biases, values and covariances at its edges.

    ``after`` is called after each measurement, with its sensor.
    """
    events = sorted((t, i, k) for i, series in enumerate(record.vectors) for k, t in enumerate(series.time))
    events = [event for event in events if event[0] >= record.time[0]]
    rows, now, increments = [], record.time[0], [np.zeros(3), *record.increments]
    for end, whole, delta in zip(record.time, np.diff(record.time, prepend=now), increments, strict=True):
        while events and events[0][0] <= end:
            t, i, k = events.pop(0)
            if t > now:
                f.predict(delta * ((t - now) / whole), t - now)
                now = f.time = t
            f.update(record.vectors[i], k)
            after(record.vectors[i].sensor)
        if end > now:
            f.predict(delta * ((end - now) / whole), end - now)
            now = f.time = end
        rows.append((f.attitude, f.bias, f.values, f.P))
    return [np.array(column) for column in zip(*rows, strict=True)]


def run(record, process_noise, initial, error_states=(), **options):
    """Return the result of the step-by-step filter for a record: states at every edge, innovations, counts and events."""
    sensors = [series.sensor for series in record.vectors]
    f = GatedStepFilter(process_noise, initial, error_states, time=record.time[0], sensors=sensors, **options)
    updates, skipped = {sensor: [] for sensor in sensors}, dict.fromkeys(sensors, 0)

    def note(sensor):
        if f.skipped.get(sensor, 0) == skipped[sensor]:
            updates[sensor].append((f.nis, f.weight, np.linalg.solve(np.linalg.cholesky(f.S), f.y)))
        else:
            skipped[sensor] += 1

    attitude, bias, values, P = fed(f, record, note)
    ends = np.cumsum([block.size for block in error_states])[:-1]
    nis, weight, whitened = (
        {sensor: np.array([update[part] for update in history]) for sensor, history in updates.items()}
        for part in range(3)
    )
    return SimpleNamespace(
        attitude=attitude,
        bias=bias,
        values=dict(zip([block.name for block in error_states], np.split(values, ends, axis=1), strict=False)),
        whole_covariance=P,
        nis=nis,
        weight=weight,
        whitened=whitened,
        refused={sensor: f.refused.get(sensor, 0) for sensor in sensors},
        skipped=skipped,
        events=(*estimation.gaps(record), *f.events),
    )


def apart(whole, step):
    """Return how far the result of the compiled filter is from this one's, in σ, and its covariance in correlations: the largest."""
    P = whole.covariance if whole.whole_covariance is None else whole.whole_covariance
    sigma = np.sqrt(np.einsum("kii->ki", P))
    off = np.abs(state_errors(whole, step.attitude, step.bias, step.values)) / sigma
    return max(np.max(off), np.max(np.abs(correlation(P - step.whole_covariance, sigma))))


def assert_alike(whole, step, tolerance):
    """Assert that the compiled filter's result is this one's: states to ``tolerance``, innovations, weights, counts and events."""
    assert apart(whole, step) < tolerance
    assert (whole.refused, whole.skipped) == (step.refused, step.skipped)
    both = [
        sorted(result.events, key=lambda event: (event.kind, event.sensor, event.start)) for result in (whole, step)
    ]
    assert len(both[0]) == len(both[1])
    for a, b in zip(*both, strict=True):
        assert (a.kind, a.sensor) == (b.kind, b.sensor)
        assert (a.start, a.end, a.value) == pytest.approx((b.start, b.end, b.value))
    for sensor, innovations in whole.innovations.items():
        if innovations.weight is None:
            np.testing.assert_allclose(step.whitened[sensor], innovations.whitened, rtol=1e-9, atol=1e-9)
        else:
            np.testing.assert_allclose(step.nis[sensor], innovations.nis, rtol=1e-7)
            np.testing.assert_allclose(step.weight[sensor], innovations.weight, atol=1e-9)
