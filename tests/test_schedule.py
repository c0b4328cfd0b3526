"""The order of measurements of several sensors, also of more than a byte numbers: against NumPy's sort."""

from dataclasses import replace

import numpy as np
import pytest
from measured import series_of

from strapdown.estimation.schedule import schedule
from strapdown.records import ImuRecord


def record(seed, intervals=20_000):
    generator = np.random.default_rng(seed)
    edges = np.arange(intervals + 1) * 0.01
    up = np.array([0.0, 0.0, 1.0]) + 0.01 * generator.standard_normal((intervals, 3))
    series = series_of(
        "up", "direction", edges[1:], up / np.linalg.norm(up, axis=1, keepdims=True), [0.0, 0.0, 1.0], 0.01
    )
    return ImuRecord(time=edges, increments=1e-4 * generator.standard_normal((intervals, 3)), vectors=(series,))


@pytest.mark.parametrize("sensors", [0, 1, 3, 300])
@pytest.mark.parametrize("times", ["the same", "with ties", "apart"])
def test_events_come_in_order_of_time_and_of_sensors(sensors, times):
    generator = np.random.default_rng(sensors)
    whole = record(0, 200)
    up = whole.vectors[0]
    vectors = []
    for i in range(sensors):
        picked = np.arange(200) if times == "the same" else np.sort(generator.choice(200, 60 + i % 9, replace=False))
        shift = 1e-5 * i if times == "apart" else 0.0
        vectors.append(replace(up.taken(picked), sensor=f"s{i}", time=up.time[picked] - shift))
    events = schedule(tuple(vectors), whole.time[0], whole.time[-1])
    held_time = np.concatenate([each.time for each in vectors]) if vectors else np.empty(0)
    order = np.argsort(held_time, kind="stable")
    assert np.array_equal(events.row, order)
    assert np.array_equal(events.time, held_time[order])
    assert np.array_equal(events.sensor, np.repeat(np.arange(sensors), [len(each.time) for each in vectors])[order])
