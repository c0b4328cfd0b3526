"""Memory of results that is used again, and the order of events: against each other's copies and NumPy's sort."""

import gc
import threading
from dataclasses import replace

import numpy as np
import pytest
from measured import series_of

from strapdown import estimation
from strapdown.estimation import memory
from strapdown.estimation.memory import side_by_side
from strapdown.estimation.schedule import schedule
from strapdown.records import ImuRecord

MEGABYTE = 1 << 20
NOISE = estimation.ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-5)
START = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=0.1, bias_sigma=0.01)


@pytest.fixture(autouse=True)
def nothing_kept():
    gc.collect()
    memory._kept.clear()
    yield
    memory._kept.clear()


def record(seed, intervals=20_000):
    generator = np.random.default_rng(seed)
    edges = np.arange(intervals + 1) * 0.01
    up = np.array([0.0, 0.0, 1.0]) + 0.01 * generator.standard_normal((intervals, 3))
    series = series_of(
        "up", "direction", edges[1:], up / np.linalg.norm(up, axis=1, keepdims=True), [0.0, 0.0, 1.0], 0.01
    )
    return ImuRecord(time=edges, increments=1e-4 * generator.standard_normal((intervals, 3)), vectors=(series,))


def test_memory_of_a_result_that_is_gone_is_used_again():
    (first,) = side_by_side(((MEGABYTE,), float))
    place = first.ctypes.data
    part = first[10:20]
    del first
    (second,) = side_by_side(((MEGABYTE,), float))
    assert second.ctypes.data != place  # a part of the first is still in use
    del part
    (third,) = side_by_side(((MEGABYTE,), float))
    assert third.ctypes.data == place
    (small,) = side_by_side(((100,), float))
    assert small.ctypes.data != place


def test_results_do_not_change_when_the_filter_runs_again():
    records = [record(seed) for seed in range(3)]
    kept = [estimation.run(each, NOISE, START) for each in records]
    copies = [estimate.attitude.copy() for estimate in kept]
    innovations = [estimate.innovations["up"].innovation.copy() for estimate in kept]
    del kept[1]
    for each in records:
        estimation.run(each, NOISE, START)
    for estimate, copy, innovation in zip(kept, copies[::2], innovations[::2], strict=True):
        assert np.array_equal(estimate.attitude, copy)
        assert np.array_equal(estimate.innovations["up"].innovation, innovation)
    again = estimation.run(records[1], NOISE, START)  # in memory that held other results
    assert np.array_equal(again.attitude, copies[1])


def test_a_larger_piece_is_left_for_who_needs_it():
    (large,) = side_by_side(((8 * MEGABYTE,), np.uint8))
    place = large.ctypes.data
    del large
    (small,) = side_by_side(((2 * MEGABYTE,), np.uint8))
    assert small.ctypes.data != place
    (large,) = side_by_side(((7 * MEGABYTE,), np.uint8))
    assert large.ctypes.data == place


def test_no_more_is_kept_than_said():
    pieces = [side_by_side(((memory.KEPT // 3,), np.uint8)) for _ in range(5)]
    assert not memory._kept
    del pieces
    assert memory.KEPT // 3 <= sum(each.size for each in memory._kept) <= memory.KEPT
    side_by_side(((memory.KEPT + MEGABYTE,), np.uint8))
    assert sum(each.size for each in memory._kept) <= memory.KEPT


def test_threads_never_share_a_piece():
    wrong = []

    def work(number):
        for k in range(200):
            (mine,) = side_by_side(((MEGABYTE // 4,), float))
            mine[:] = number + k
            if np.any(mine != number + k):
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(1000.0 * i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.parametrize("sensors", [0, 1, 2, 3])
@pytest.mark.parametrize("times", ["the same", "with ties", "apart"])
def test_events_come_in_order_of_time_and_of_sensors(sensors, times):
    generator = np.random.default_rng(sensors)
    whole = record(0, 200)
    up = whole.vectors[0]
    vectors = []
    for i in range(sensors):
        picked = np.arange(200) if times == "the same" else np.sort(generator.choice(200, 60 + i, replace=False))
        shift = 1e-4 * i if times == "apart" else 0.0
        vectors.append(replace(up.taken(picked), sensor=f"s{i}", time=up.time[picked] - shift))
    events = schedule(tuple(vectors), whole.time[0], whole.time[-1])
    held_time = np.concatenate([each.time for each in vectors]) if vectors else np.empty(0)
    order = np.argsort(held_time, kind="stable")
    assert np.array_equal(events.row, order)
    assert np.array_equal(events.time, held_time[order])
    assert np.array_equal(events.sensor, np.repeat(np.arange(sensors), [len(each.time) for each in vectors])[order])
