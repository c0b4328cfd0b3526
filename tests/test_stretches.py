"""Eight stretches side by side: equal to one pass where the record is fit, one pass where it is not; the maps that join them are right."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from strapdown import mekf, quaternion, records, smoother
from strapdown.checks import Array
from strapdown.kernels import stretch_loop, stretch_seams
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled
from strapdown.kernels.stretch_lanes import STATE
from strapdown.mekf import ProcessNoise, State
from strapdown.mekf.memory import side_by_side
from strapdown.mekf.states import pack
from strapdown.records import Estimate, ImuRecord, Truth
from strapdown.robustness import Gate
from strapdown.smoother import stretches
from strapdown.vectors import VectorMeasurements

UP, FIELD = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.5, -math.sqrt(0.75)])
INTERVAL = 0.02
NOISE = ProcessNoise(angle_random_walk=5e-4, rate_random_walk=1e-5)
START = mekf.initial_state(quaternion.IDENTITY, attitude_sigma=0.1, bias_sigma=0.01)
CLOSE = 3e-4
"""Of a σ. Seams agree to 1e-4 of that of the filter."""


def body(seed: int, intervals: int, edges: Array | None = None, sigma: float = 0.02, start: float = 0.1) -> ImuRecord:
    """A swaying body with truth, and two directions at every edge but the first."""
    rng = np.random.default_rng(seed)
    edges = INTERVAL * np.arange(intervals + 1) if edges is None else edges
    dt, middle = np.diff(edges), 0.5 * (edges[1:] + edges[:-1])
    rate = np.stack([0.5 * np.sin(1.3 * middle), 0.4 * np.cos(0.9 * middle), 0.3 * np.sin(0.7 * middle + 1.0)], axis=-1)
    q = quaternion.exp(start * rng.standard_normal(3))
    attitude = [q]
    for step in quaternion.exp(rate * dt[:, None]):
        q = quaternion.normalize(quaternion.multiply(q, step))
        attitude.append(q)
    whole = np.array(attitude)
    walk = NOISE.rate_random_walk * np.sqrt(dt)[:, None] * rng.standard_normal((intervals, 3))
    bias = 0.01 * rng.standard_normal(3) + np.concatenate([np.zeros((1, 3)), np.cumsum(walk, axis=0)])
    noise = NOISE.angle_random_walk * np.sqrt(dt)[:, None] * rng.standard_normal((intervals, 3))
    increments = (rate + 0.5 * (bias[1:] + bias[:-1])) * dt[:, None] + noise
    back = quaternion.conjugate(whole[1:])
    series = []
    for name, reference in (("accelerometer", UP), ("magnetometer", FIELD)):
        z = quaternion.rotate(back, reference) + sigma * rng.standard_normal((intervals, 3))
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        told = np.full(intervals, sigma)
        series.append(
            VectorMeasurements(
                sensor=name, kind="direction", time=edges[1:], vector_b=z, reference_f=reference, sigma=told
            )
        )
    return ImuRecord(time=edges, increments=increments, vectors=tuple(series), truth=Truth(attitude=whole, bias=bias))


def with_sensors(record: ImuRecord, *series: VectorMeasurements) -> ImuRecord:
    return dataclasses.replace(record, vectors=series)


def at(series: VectorMeasurements, chosen: np.ndarray | slice) -> VectorMeasurements:
    return dataclasses.replace(
        series, time=series.time[chosen], vector_b=series.vector_b[chosen], sigma=series.sigma[chosen]
    )


def missing(series: VectorMeasurements, gone: np.ndarray | slice) -> VectorMeasurements:
    z = series.vector_b.copy()
    z[gone] = np.nan
    return dataclasses.replace(series, vector_b=z)


def as_vector(series: VectorMeasurements, length: float) -> VectorMeasurements:
    return dataclasses.replace(
        series,
        kind="vector",
        vector_b=length * series.vector_b,
        reference_f=length * series.reference_f,
        sigma=length * series.sigma,
    )


def records_that_fit() -> dict[str, ImuRecord]:
    rng = np.random.default_rng(7)
    plain = body(1, 1613)
    up, field = plain.vectors
    early = dataclasses.replace(up, time=plain.time[:-1])  # one at the first edge, none at the last
    uneven = np.concatenate([[0.0], np.cumsum(rng.uniform(0.5, 1.5, 1613) * INTERVAL)])
    gap = INTERVAL * np.arange(1614) + 0.4 * (np.arange(1614) > 700)
    return {
        "two at each edge": plain,
        "from the first edge on": with_sensors(plain, early, field),
        "in another order": with_sensors(plain, field, up),
        "one sensor": with_sensors(plain, up),
        "another alone": with_sensors(plain, field),
        "none": with_sensors(plain),
        "every tenth": with_sensors(plain, at(up, slice(9, None, 10)), at(field, slice(9, None, 10))),
        "each of its own rate": with_sensors(plain, at(up, slice(1, None, 2)), at(field, slice(4, None, 5))),
        "one slow": with_sensors(plain, up, at(field, slice(3, None, 7))),
        "some missing": with_sensors(plain, missing(up, rng.random(1613) < 0.3), field),
        "one never seen": with_sensors(plain, up, missing(field, slice(None))),
        "one seen at the start alone": with_sensors(plain, up, at(field, slice(0, 5))),
        "an outage": with_sensors(plain, missing(up, slice(500, 800)), missing(field, slice(500, 800))),
        "uneven intervals": body(2, 1613, uneven),
        "a gap": body(2, 1613, gap),
        "σ by sample": with_sensors(
            plain, dataclasses.replace(up, sigma=up.sigma * rng.uniform(0.5, 3.0, 1613)), field
        ),
        "whole vectors": with_sensors(plain, as_vector(up, 9.81), field),
        "whole vectors, slow": with_sensors(plain, up, at(as_vector(field, 48e-6), slice(3, None, 7))),
        "from far away": body(3, 1613, start=0.6),
        "sharp": body(4, 1613, sigma=1e-3),
    }


FIT = records_that_fit()


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut records of this size too."""
    monkeypatch.setattr(stretches, "FEWEST_STEPS", 256)


def one_pass(record: ImuRecord, noise: ProcessNoise = NOISE, start: State = START) -> Estimate:
    assert len(record.increments) < 8192  # else it would be cut
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stretches, "FEWEST_STEPS", 10**9)
        return smoother.run(record, noise, start, full_covariance=True)


def off(found: Estimate, wanted: Estimate) -> float:
    """Return the largest difference of attitude and bias, in σ, and of the covariance, in variances."""
    sigma = np.sqrt(wanted.variance)
    turn = quaternion.log(quaternion.multiply(quaternion.conjugate(wanted.attitude), found.attitude))
    assert found.covariance is not None
    assert wanted.covariance is not None
    spread = (found.covariance - wanted.covariance) / (sigma[:, :, None] * sigma[:, None, :])
    return float(
        max(
            np.max(np.abs(turn / sigma[:, :3])),
            np.max(np.abs((found.bias - wanted.bias) / sigma[:, 3:])),
            np.max(np.abs(spread)),
            np.max(np.abs(found.variance / wanted.variance - 1.0)),
        )
    )


@pytest.mark.parametrize("name", FIT)
@pytest.mark.usefixtures("short")
def test_stretches_are_one_pass(name: str) -> None:
    record = FIT[name]
    wanted = one_pass(record)
    found = stretches.smoothed(record, NOISE, START, True)
    assert found is not None
    assert off(found, wanted) < CLOSE
    assert found.skipped == wanted.skipped
    assert found.events == wanted.events
    assert list(found.innovations) == list(wanted.innovations)
    for sensor, one in wanted.innovations.items():
        other = found.innovations[sensor]
        np.testing.assert_array_equal(other.time, one.time)
        assert np.all(np.abs(other.innovation - one.innovation) < CLOSE * np.sqrt(one.variance))
        np.testing.assert_allclose(other.variance, one.variance, rtol=CLOSE)
    np.testing.assert_allclose(np.linalg.norm(found.attitude, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("rest", range(17))
@pytest.mark.usefixtures("short")
def test_any_number_of_intervals(rest: int) -> None:
    record = records.cut(body(5, 600 + rest), 0, 600 + rest)
    found = stretches.smoothed(record, NOISE, START, True)
    assert found is not None
    assert off(found, one_pass(record)) < CLOSE


@pytest.mark.parametrize(
    ("noise", "start"),
    [
        (ProcessNoise(angle_random_walk=5e-4, rate_random_walk=0.0), START),
        (ProcessNoise(angle_random_walk=1e-9, rate_random_walk=0.0), START),
        (ProcessNoise(angle_random_walk=1e-2, rate_random_walk=1e-3), START),
        (NOISE, mekf.initial_state(quaternion.IDENTITY, attitude_sigma=1.0, bias_sigma=0.5)),
        (NOISE, mekf.initial_state(quaternion.exp([1.0, -1.0, 0.5]), attitude_sigma=1.0, bias_sigma=0.1)),
        (
            NOISE,
            mekf.initial_state(quaternion.IDENTITY, attitude_sigma=[0.01, 0.1, 1.0], bias_sigma=[1e-4, 1e-3, 1e-2]),
        ),
    ],
)
@pytest.mark.usefixtures("short")
def test_noise_and_starts(noise: ProcessNoise, start: State) -> None:
    record = FIT["two at each edge"]
    found = stretches.smoothed(record, noise, start, True)
    assert found is not None
    assert off(found, one_pass(record, noise, start)) < CLOSE


@pytest.mark.usefixtures("short")
def test_public_face_takes_stretches_and_leaves_what_it_was_given() -> None:
    record = FIT["some missing"]
    before = [record.increments.copy(), *(series.vector_b.copy() for series in record.vectors)]
    found = smoother.run(record, NOISE, START)
    again = stretches.smoothed(record, NOISE, START, False)
    assert again is not None
    for name in ("attitude", "bias", "variance"):
        np.testing.assert_array_equal(getattr(found, name), getattr(again, name))
    assert found.covariance is None
    for kept, given in zip(before, [record.increments, *(s.vector_b for s in record.vectors)], strict=True):
        np.testing.assert_array_equal(kept, given)
    whole = smoother.run_fixed_lag(record, NOISE, START, lag=1e9)
    np.testing.assert_array_equal(whole.attitude, found.attitude)


def test_a_long_record_is_cut_without_being_told() -> None:
    record = body(6, 8200)
    found = stretches.smoothed(record, NOISE, START, False)
    assert found is not None
    np.testing.assert_array_equal(smoother.run(record, NOISE, START).attitude, found.attitude)
    assert stretches.smoothed(records.cut(record, 0, 8191), NOISE, START, False) is None


def turned_at(record: ImuRecord, interval: int) -> ImuRecord:
    """A record with one turn of more than a third of a radian."""
    increments = record.increments.copy()
    increments[interval] = [0.4, 0.0, 0.0]
    return dataclasses.replace(record, increments=increments)


def records_that_do_not_fit() -> dict[str, ImuRecord]:
    plain = FIT["two at each edge"]
    up, field = plain.vectors
    n = len(up.time)
    by_axis = VectorMeasurements(
        sensor="accelerometer",
        kind="direction",
        time=up.time,
        vector_b=up.vector_b,
        reference_f=UP,
        covariance=np.diag([1.0, 2.0, 3.0]) * 4e-4,
    )
    between = dataclasses.replace(up, time=up.time - 0.3 * INTERVAL)
    return {
        "between edges": with_sensors(plain, between, field),
        "a heading": with_sensors(plain, up, dataclasses.replace(field, kind="heading")),
        "moving references": with_sensors(plain, dataclasses.replace(up, reference_f=np.tile(UP, (n, 1))), field),
        "noise by axis": with_sensors(plain, by_axis, field),
        **{f"a large turn at {k}": turned_at(plain, k) for k in (0, 5, 30, 900)},
        "a large turn, unseen": turned_at(with_sensors(plain), 5),
        "a long gap at the start": body(2, 1613, INTERVAL * np.arange(1614) + 3.0 * (np.arange(1614) > 7)),
        "a σ that says to ignore it": with_sensors(plain, dataclasses.replace(up, sigma=np.full(n, 1e71)), field),
        "here and there": with_sensors(plain, at(up, np.flatnonzero(np.random.default_rng(1).random(n) < 0.1)), field),
        "far too sharp": body(4, 1613, sigma=1e-6),
    }


@pytest.mark.parametrize("name", list(records_that_do_not_fit()))
@pytest.mark.usefixtures("short")
def test_one_pass_where_the_record_is_not_fit(name: str) -> None:
    record = records_that_do_not_fit()[name]
    assert stretches.smoothed(record, NOISE, START, True) is None
    wanted = one_pass(record)
    np.testing.assert_array_equal(smoother.run(record, NOISE, START, full_covariance=True).attitude, wanted.attitude)


@pytest.mark.usefixtures("short")
def test_quaternions_keep_their_sign() -> None:
    """32 steps of a fast body are more than half a turn, of which the rotation vector does not tell the sign of the quaternion."""
    record = ImuRecord(time=INTERVAL * np.arange(1614), increments=np.tile([0.1, 0.05, 0.0], (1613, 1)))
    found = stretches.smoothed(record, NOISE, START, True)
    assert found is not None
    assert np.all(np.sum(found.attitude[1:] * found.attitude[:-1], axis=1) > 0.9)
    np.testing.assert_allclose(found.attitude, one_pass(record).attitude, atol=1e-9)


def test_what_is_no_number_is_no_agreement() -> None:
    """Seams and states with NaN in any lane are told as such, not passed over."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6))
    covariance = root @ root.T
    room = [np.zeros(STATE * WIDTH) for _ in range(4)]
    base, ends, found, assumed = (memory.reshape(STATE, WIDTH) for memory in room)
    sensitivity, work = np.zeros((stretch_loop.SENSITIVITY, WIDTH)), np.empty((8, 6, 6))
    adjoints = np.zeros((WIDTH, 6, 7))
    whole = pack(quaternion.IDENTITY, np.zeros(3), covariance)
    for lane in range(WIDTH):
        base[:, lane] = ends[:, lane] = whole
        found[6:27, lane] = assumed[6:27, lane] = whole[7:]
    kept = np.repeat(base.reshape(-1)[None], 3, axis=0).reshape(-1)
    least, match = compiled(stretch_loop.least_kept_share), compiled(stretch_seams.match_ends)
    arguments = ends.reshape(-1), sensitivity.reshape(-1), adjoints, assumed.reshape(-1), found.reshape(-1), work
    assert match(*arguments) == 0.0
    assert least(kept, 2, np.empty(STATE), np.empty((7, 6))) > 0.0
    for lane in (1, 3, 7):
        spoilt = found.copy()
        spoilt[:27, lane] = np.nan
        assert not match(*arguments[:4], spoilt.reshape(-1), work) < np.inf
        spoilt = base.copy()
        spoilt[7, lane] = np.nan
        spoilt_kept = np.repeat(spoilt.reshape(-1)[None], 3, axis=0).reshape(-1)
        assert not least(spoilt_kept, 2, np.empty(STATE), np.empty((7, 6))) > 0.0
        assert (
            not compiled(stretch_seams.join_starts)(
                base.reshape(-1), spoilt.reshape(-1), sensitivity.reshape(-1), np.empty(STATE * WIDTH), work
            )
            < np.inf
            or lane == 7
        )


def test_seams_are_measured_where_they_differ_most() -> None:
    """Against NumPy's own factor, for a covariance far from round."""
    rng = np.random.default_rng(1)
    root = np.tril(rng.standard_normal((6, 6))) * np.array([1.0, 0.5, 0.2, 0.1, 0.05, 0.02])
    P = root @ root.T
    difference = 1e-9 * root @ rng.standard_normal((6, 6)) @ root.T
    difference += difference.T
    shift = rng.standard_normal(6) * 1e-9
    inverse = np.linalg.inv(np.linalg.cholesky(P))
    wanted = max(np.linalg.norm(inverse @ shift), np.linalg.norm(inverse @ difference @ inverse.T))
    found = compiled(stretch_seams.whitened)(P.copy(), difference.copy(), tuple(shift), np.empty((6, 6)))
    assert found == pytest.approx(wanted, rel=1e-6)
    found = compiled(stretch_seams.whitened)(P.copy(), difference.copy(), (0.0,) * 6, np.empty((6, 6)))
    assert found == pytest.approx(np.linalg.norm(inverse @ difference @ inverse.T), rel=1e-6)


@pytest.mark.usefixtures("short")
def test_options_are_taken_in_one_pass() -> None:
    record = FIT["two at each edge"]
    with_gate = smoother.run(record, NOISE, START, gate=Gate())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stretches, "FEWEST_STEPS", 10**9)
        np.testing.assert_array_equal(with_gate.attitude, smoother.run(record, NOISE, START, gate=Gate()).attitude)


@pytest.mark.usefixtures("short")
def test_seams_that_never_agree_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stretches, "TOLERANCE", 0.0)
    assert stretches.smoothed(FIT["two at each edge"], NOISE, START, True) is None


@pytest.mark.usefixtures("short")
def test_each_further_run_brings_the_seams_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Newton's way: what one run leaves of the second order, the next leaves of the fourth."""
    record = FIT["one sensor"]
    wanted = one_pass(record)
    reached = []
    for tolerance in (1e-1, 1e-6):
        monkeypatch.setattr(stretches, "TOLERANCE", tolerance)
        found = stretches.smoothed(record, NOISE, START, True)
        assert found is not None
        reached.append(off(found, wanted))
    assert 1e-3 < reached[0] < 1e-1
    assert reached[1] < 1e-5


# ------------------------------------------------------------------------------------------------------------ the maps that join


def run_from(record: ImuRecord, start: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return attitude, bias and covariance at the end of a part of a record by the filter that stands."""
    end = mekf.run_on(record, NOISE, start)[1]
    return end.attitude, end.bias, end.covariance


def moved_by(q: Array, b: Array, other_q: Array, other_b: Array) -> Array:
    return np.concatenate([quaternion.log(quaternion.multiply(quaternion.conjugate(q), other_q)), other_b - b])


def test_end_follows_from_the_start_as_the_sensitivities_say() -> None:
    """Ψ, J and η against the filter itself, run from other starts, at angles where it is linear."""
    record = body(8, 8 * 96, sigma=1e-4, start=1e-4)
    steps = 96
    # As wide as one measurement, and far from round: else the two rows of a direction are independent by themselves.
    root = (
        np.tril(np.random.default_rng(4).uniform(0.5, 1.0, (6, 6)))
        * np.array([1e-4, 1e-4, 1e-4, 2e-5, 2e-5, 2e-5])[:, None]
    )
    covariance = root @ root.T
    truth = record.truth
    assert truth is not None
    starts = [
        State(attitude=truth.attitude[steps * i], bias=truth.bias[steps * i], covariance=covariance)
        for i in range(WIDTH)
    ]
    state, sensitivity = side_by_side(((STATE, WIDTH), float), ((stretch_loop.SENSITIVITY, WIDTH), float))
    for i, one in enumerate(starts):
        state[:, i] = pack(one.attitude, one.bias, one.covariance)
    sensitivity[:] = 0.0
    sensitivity[:36:7] = 1.0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stretches, "FEWEST_STEPS", 0)
        patch.setattr(stretches, "_FEWEST_BEFORE", 1)
        events = mekf.schedule(record.vectors, record.time[0], record.time[-1])
        cut = stretches._cut(record, events)
    assert (cut.steps, cut.first) == (95, 8)
    taken = (cut.increments, 0, steps)
    dts, variances = side_by_side(((steps * WIDTH,), float), ((2 * steps * WIDTH,), float))
    dts[:], variances[:] = INTERVAL, 1e-8
    dts.reshape(steps, WIDTH)[:] = np.diff(record.time).reshape(WIDTH, steps).T
    places = cut.places - 3 * cut.before
    measured = (cut.values, places, np.ones(2, bool), np.empty(0, np.int64), variances, cut.frames, cut.scratch)
    noise = NOISE.angle_random_walk**2, NOISE.rate_random_walk**2
    flat = state.reshape(-1), sensitivity.reshape(-1)
    assert compiled(stretch_loop.run_with_sensitivity)(*taken, dts, *noise, *measured, *flat)
    rng = np.random.default_rng(0)
    for i in (0, 3, 7):
        part = records.cut(record, steps * i, steps * (i + 1))
        q, b, P = run_from(part, starts[i])
        np.testing.assert_allclose(moved_by(q, b, state[:4, i], state[4:7, i]), 0.0, atol=1e-13)
        psi = sensitivity[:36, i].reshape(6, 6)
        J = np.zeros((6, 6))
        J[np.triu_indices(6)] = sensitivity[36:57, i]
        J += np.triu(J, 1).T
        eta = sensitivity[57:63, i]
        # Another mean, another covariance, and both.
        for mean, spread in ((1.0, 0.0), (0.0, 0.3), (1.0, 0.3)):
            sigma = np.sqrt(np.diag(covariance))
            d = mean * sigma * rng.standard_normal(6)
            root = rng.standard_normal((6, 6)) * spread * sigma[:, None]
            dP = root @ root.T
            other = State(
                attitude=quaternion.multiply(starts[i].attitude, quaternion.exp(d[:3])),
                bias=starts[i].bias + d[3:],
                covariance=covariance + dP,
            )
            other_q, other_b, other_P = run_from(part, other)
            share = np.linalg.inv(np.eye(6) + dP @ J)
            end_sigma = np.sqrt(np.diag(P))
            found = moved_by(q, b, other_q, other_b) / end_sigma
            np.testing.assert_allclose(psi @ share @ (d + dP @ eta) / end_sigma, found, atol=2e-3)
            assert np.max(np.abs(found)) > 0.05
            np.testing.assert_allclose(
                (psi @ share @ dP @ psi.T) / np.outer(end_sigma, end_sigma),
                (other_P - P) / np.outer(end_sigma, end_sigma),
                atol=2e-3,
            )


@pytest.mark.usefixtures("short")
def test_consistent() -> None:
    """Mean NEES of attitude and bias over runs inside two-sided 99 % bounds at edges of all stretches and at seams."""
    runs = 40
    nees: list[Array] = []
    for seed in range(runs):
        record = body(100 + seed, 700)
        assert record.truth is not None
        start = mekf.initial_state(quaternion.IDENTITY, attitude_sigma=0.1, bias_sigma=0.01)
        found = stretches.smoothed(record, NOISE, start, True)
        assert found is not None
        assert found.covariance is not None
        error = np.concatenate(
            [
                quaternion.log(quaternion.multiply(quaternion.conjugate(found.attitude), record.truth.attitude)),
                record.truth.bias - found.bias,
            ],
            axis=1,
        )
        nees.append(np.einsum("ki,ki->k", error, np.linalg.solve(found.covariance, error[..., None])[..., 0]))
    mean = np.mean(nees, axis=0)[::35]
    low, high = stats.chi2.ppf([0.005 / len(mean), 1.0 - 0.005 / len(mean)], 6 * runs) / runs
    assert np.all((low < mean) & (mean < high)), (low, high, mean)
