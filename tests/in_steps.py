"""A record processed by the step-by-step filter, for comparison with the compiled one."""

from types import SimpleNamespace

import numpy as np
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


def fed(f, record, after=lambda used: None):
    """Process a record, intervals split at the measurements; return attitudes, biases and covariances at the ends of the intervals.

    ``after`` is called after each measurement, with whether it was used.
    """
    events = sorted((t, i, k) for i, series in enumerate(record.vectors) for k, t in enumerate(series.time))
    rows = []
    for n, delta in enumerate(record.increments):
        now, end = record.time[n], record.time[n + 1]
        whole = end - now
        while events and events[0][0] <= end:
            t, i, k = events.pop(0)
            if t > now:
                f.predict(delta * ((t - now) / whole), t - now)
                now = t
            after(f.update(record.vectors[i], k))
        if end > now:
            f.predict(delta * ((end - now) / whole), end - now)
        rows.append((f.attitude, f.bias, f.P))
    return [np.array(column) for column in zip(*rows, strict=True)]


def run(record, process_noise, initial, error_states=(), **options):
    """Return the result of the step-by-step filter for a record: states at every edge, innovations, counts and events."""
    sensors = [series.sensor for series in record.vectors]
    f = GatedStepFilter(process_noise, initial, error_states, time=record.time[0], sensors=sensors, **options)
    events = sorted((t, i, k) for i, series in enumerate(record.vectors) for k, t in enumerate(series.time))
    events = [event for event in events if event[0] >= record.time[0]]
    rows, updates = [], {sensor: [] for sensor in sensors}

    def give_until(end):
        now = f.time
        while events and events[0][0] <= end:
            t, i, k = events.pop(0)
            if t > now:
                f.predict(delta * ((t - now) / whole), t - now)
                now = f.time = t
            series, skipped = record.vectors[i], sum(f.skipped.values())
            f.update(series, k)
            if sum(f.skipped.values()) == skipped:
                updates[series.sensor].append((f.nis, f.weight, f.y, f.S))
        return now

    whole, delta = 0.0, np.zeros(3)
    give_until(record.time[0])
    rows.append((f.attitude, f.bias, f.values, f.P))
    for n, delta in enumerate(record.increments):
        end = record.time[n + 1]
        whole = end - record.time[n]
        now = give_until(end)
        if end > now:
            f.predict(delta * ((end - now) / whole), end - now)
            f.time = end
        rows.append((f.attitude, f.bias, f.values, f.P))
    attitude, bias, values, P = (np.array(column) for column in zip(*rows, strict=True))
    ends = np.cumsum([block.size for block in error_states])[:-1]
    return SimpleNamespace(
        attitude=attitude,
        bias=bias,
        values=dict(zip([block.name for block in error_states], np.split(values, ends, axis=1), strict=False)),
        whole_covariance=P,
        nis={sensor: np.array([update[0] for update in history]) for sensor, history in updates.items()},
        weight={sensor: np.array([update[1] for update in history]) for sensor, history in updates.items()},
        whitened={
            sensor: np.array([whitened(*update[2:]) for update in history]) for sensor, history in updates.items()
        },
        refused={sensor: f.refused.get(sensor, 0) for sensor in sensors},
        skipped={sensor: f.skipped.get(sensor, 0) for sensor in sensors},
        events=tuple(sorted([*estimation.gaps(record), *f.events], key=lambda event: event.start)),
    )


def apart(whole, step):
    """Return how far the result of the compiled filter is from this one's, in σ, and its covariance in correlations: the largest."""
    P = whole.covariance if whole.whole_covariance is None else whole.whole_covariance
    sigma = np.sqrt(np.einsum("kii->ki", P))
    off = np.abs(state_errors(whole, step.attitude, step.bias, step.values)) / sigma
    return max(np.max(off), np.max(np.abs(correlation(P - step.whole_covariance, sigma))))


def whitened(y, S):
    """Return an innovation decorrelated in the order of its rows and divided by its standard deviations."""
    return np.linalg.solve(np.linalg.cholesky(S), y)
