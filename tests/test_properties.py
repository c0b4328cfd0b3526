"""Properties that hold for any input, sought by hypothesis: files, filter = batch least squares."""

import dataclasses

import numpy as np
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from measured import differing, series_of

from strapdown import estimation, files, quaternion, records
from strapdown.files import reading
from strapdown.recordings import recordfiles
from strapdown.records import ImuRecord, Truth

numbers = st.floats(-1e3, 1e3, allow_nan=False, width=64)
quaternions = (
    arrays(np.float64, 4, elements=st.floats(-1.0, 1.0))
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: q / np.linalg.norm(q))
)
few = settings(
    derandomize=True, max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


texts = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"), max_size=40)


@st.composite
def recorded(draw) -> ImuRecord:
    n = draw(st.integers(1, 12))
    steps = draw(st.lists(st.floats(1e-6, 1e3), min_size=n, max_size=n))
    time = draw(st.floats(-1e3, 1e6)) + np.concatenate([[0.0], np.cumsum(steps)])
    assume(np.all(np.diff(time) > 0.0))
    increments = draw(arrays(np.float64, (n, 3), elements=st.floats(-1e3, 1e3)))
    series = []
    if draw(st.booleans()):
        m = draw(st.integers(1, 4))
        values = draw(arrays(np.float64, (m, 3), elements=st.floats(-1.0, 1.0)))
        values[np.linalg.norm(values, axis=1) < 0.1] = [1.0, 0.0, 0.0]
        if draw(st.booleans()):
            values[0] = np.nan
        name = draw(st.text(st.characters(categories=("L", "N")), min_size=1, max_size=10))
        unit = values / np.linalg.norm(values, axis=1, keepdims=True)
        series.append(
            series_of(name, "direction", time[0] + np.arange(m), unit, [0.0, 0.0, 1.0], draw(st.floats(1e-9, 1.0)))
        )  # fmt: skip
    truth = None
    if draw(st.booleans()):
        attitude = np.array([draw(quaternions) for _ in time])
        truth = Truth(attitude=attitude, bias=draw(arrays(np.float64, (n + 1, 3), elements=numbers)))
    return ImuRecord(time=time, increments=increments, vectors=tuple(series), truth=truth)


@few
@given(recorded(), texts, st.integers(0, 2**62))
def test_a_record_goes_through_hdf5_to_the_last_bit(tmp_path, record, text, seed):
    seeded = dataclasses.replace(record, origin=records.Origin(seed=seed))
    recordfiles.write_record(tmp_path / "r.h5", seeded)
    back = recordfiles.read_record(tmp_path / "r.h5")
    assert not differing(record, back)
    assert back.origin.seed == seed
    with records.result_file(tmp_path / "a.h5", "record", {"note": text, "list": ["a", text]}):
        pass
    held = records.read_attributes(tmp_path / "a.h5")
    assert (held["note"], held["list"]) == (text, ["a", text])


trees = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False) | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=20,
)


@few
@given(trees)
def test_json_goes_through_a_file(tmp_path, tree):
    files.write_json(tmp_path / "t.json", tree)
    assert reading.json_file(tmp_path / "t.json") == tree


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.floats(1e-6, 1e-4), st.floats(1e-5, 1e-3))
def test_without_process_noise_and_with_small_errors_the_filter_is_batch_least_squares(seed, n, spread, sigma):
    """At rest, with a bias, no process noise: each direction is a linear measurement of the error and bias at the start."""
    chance = np.random.default_rng(seed)
    dt = 0.1
    P0 = np.diag([spread**2] * 3 + [(0.1 * spread) ** 2] * 3)
    rows, values = [np.eye(6)], [np.zeros(6)]
    weights = [np.linalg.inv(P0)]
    sensors = []
    for k, reference in enumerate(np.eye(3)[:2]):
        b = reference + sigma * chance.standard_normal((n, 3))
        b /= np.linalg.norm(b, axis=1, keepdims=True)
        time = dt * np.arange(1, n + 1)
        sensors.append(series_of(f"s{k}", "direction", time, b, reference, sigma))
        for direction, t in zip(b, time, strict=True):
            # b = exp(-δθ) r = r + r × δθ; of the gyro's increments, all zero, the filter takes its bias: δθ(t) = δθ(0) - t δb.
            skew = np.array(
                [
                    [0.0, -reference[2], reference[1]],
                    [reference[2], 0.0, -reference[0]],
                    [-reference[1], reference[0], 0.0],
                ]
            )
            rows.append(np.hstack([skew, -t * skew]))
            values.append(direction - reference)
            weights.append((np.eye(3) - np.outer(reference, reference)) / sigma**2)
    information = sum(H.T @ W @ H for H, W in zip(rows, weights, strict=True))
    solution = np.linalg.solve(information, sum(H.T @ W @ z for H, W, z in zip(rows, weights, values, strict=True)))
    record = ImuRecord(time=dt * np.arange(n + 1), increments=np.zeros((n, 3)), vectors=tuple(sensors))
    start = estimation.State(attitude=np.array([1.0, 0.0, 0.0, 0.0]), bias=np.zeros(3), covariance=P0)
    noise = estimation.ProcessNoise(angle_random_walk=1e-14, rate_random_walk=1e-14)
    estimate = estimation.run(record, noise, start, full_covariance=True)
    moved = np.eye(6)
    moved[:3, 3:] = -n * dt * np.eye(3)
    covariance = moved @ np.linalg.inv(information) @ moved.T
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        estimate.covariance[-1] / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=2e-3
    )
    error = np.concatenate([quaternion.log(estimate.attitude[-1]), estimate.bias[-1]])
    np.testing.assert_allclose(error / scale, (moved @ solution) / scale, atol=5e-3)
