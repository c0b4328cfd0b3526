"""The family of filters: each formula by itself, each pair that must agree, and all of them against truth and χ²."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import mpmath
import numpy as np
import pytest
from filterpy.common import van_loan_discretization
from filterpy.kalman import JulierSigmaPoints, KalmanFilter, MerweScaledSigmaPoints
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from strapdown import consistency, family, kinematics, mekf, motion, quaternion
from strapdown.checks import InputError
from strapdown.consistency import Verdict
from strapdown.family import complementary, extended, stepping, unscented
from strapdown.kernels import family_complementary, family_loop, family_step, family_turns
from strapdown.kernels.machine import compiled
from strapdown.records import ImuRecord, Truth
from strapdown.units import DEGREE
from strapdown.vectors import VectorMeasurements

EXTENDED = ("mekf", "fixed-side", "right-invariant", "two-frame", "geometric")
BODY = motion.HarmonicRates(
    mean=(0.05, -0.1, 0.3), harmonics=(motion.Harmonic(amplitude=(0.2, 0.1, 0.0), frequency=0.1, phase=0.3),)
)
REFERENCES = {
    "direction": np.array([1.0, 0.2, 0.5]) / np.sqrt(1.29),
    "vector": np.array([2.0, 1.0, -3.0]),
    "heading": np.array([1.0, 0.3, 0.0]) / np.sqrt(1.09),
}


def simulated(
    rng,
    *,
    intervals=200,
    dt=0.1,
    kinds=("direction", "vector", "heading"),
    noise=(1e-4, 1e-6),
    bias=0.0,
    sigma=0.01,
    measurements=25,
    jitter=0.5,
    body=BODY,
):
    """A record with truth: irregular gyro intervals, measurements at random times, white noises of the given sizes."""
    edges = np.concatenate([[0.0], np.cumsum(dt * rng.uniform(1.0 - jitter, 1.0 + jitter, intervals))])
    d = np.diff(edges)[:, None]
    walk = noise[1] * np.sqrt(d) * rng.standard_normal((intervals, 3))
    biases = np.full(3, bias) + np.concatenate([np.zeros((1, 3)), np.cumsum(walk, axis=0)])
    white = np.sqrt(noise[0] ** 2 * d + noise[1] ** 2 * d**3 / 12.0) * rng.standard_normal((intervals, 3))
    increments = body.increments(edges) + 0.5 * d * (biases[1:] + biases[:-1]) + white
    series = []
    for kind in kinds:
        time = np.sort(rng.uniform(edges[0], edges[-1], measurements))
        r = REFERENCES[kind]
        scale = float(np.linalg.norm(r))
        z = Rotation.from_quat(body.attitude(time), scalar_first=True).inv().apply(r)
        z = z + sigma * scale * rng.standard_normal(z.shape)
        if kind != "vector":
            z /= np.linalg.norm(z, axis=1, keepdims=True)
        series.append(
            VectorMeasurements(sensor=kind, kind=kind, time=time, vector_b=z, reference_f=r, sigma=sigma * scale)
        )
    truth = Truth(attitude=body.attitude(edges), bias=biases)
    return ImuRecord(time=edges, increments=increments, vectors=tuple(series), truth=truth)


BELIEF = mekf.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)


def started(record, rng, *, attitude_sigma, bias_sigma):
    draw = rng.standard_normal(6)
    return mekf.initial_state(
        quaternion.multiply(record.truth.attitude[0], quaternion.exp(-attitude_sigma * draw[:3])),
        attitude_sigma=attitude_sigma,
        bias_sigma=bias_sigma,
        bias=record.truth.bias[0] - bias_sigma * draw[3:],
    )


def difference(estimate, reference):
    """Largest differences of attitude (rad), and of bias and P in the reference's largest standard deviations."""
    sigma = np.sqrt(np.diagonal(reference.covariance, axis1=1, axis2=2)).max(axis=0)
    return (
        float(np.abs(quaternion.angle_between(estimate.attitude, reference.attitude)).max()),
        float(np.abs((estimate.bias - reference.bias) / sigma[3:]).max()),
        float(np.abs((estimate.covariance - reference.covariance) / np.outer(sigma, sigma)).max()),
    )


# ------------------------------------------------------------------------------------------------------------ the fixed side


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    attitude_sigma=st.floats(-4.0, -0.7).map(lambda x: 10.0**x),
    bias_sigma=st.floats(-5.0, -2.0).map(lambda x: 10.0**x),
    kinds=st.sampled_from([("direction",), ("direction", "heading"), ("direction", "vector", "heading")]),
)
def test_fixed_side_equals_the_mekf(seed, attitude_sigma, bias_sigma, kinds):
    rng = np.random.default_rng(seed)
    record = simulated(rng, kinds=kinds, sigma=10.0 ** rng.uniform(-3.0, -1.0), intervals=100)
    initial = started(record, rng, attitude_sigma=attitude_sigma, bias_sigma=bias_sigma)
    reference = family.run("mekf", record, BELIEF, initial, full_covariance=True)
    fixed = family.run("fixed-side", record, BELIEF, initial, full_covariance=True)
    attitude, _, covariance = difference(fixed, reference)
    assert max(attitude, covariance) < 1e-12
    np.testing.assert_allclose(fixed.bias, reference.bias, rtol=0.0, atol=1e-12)
    for sensor, innovations in reference.innovations.items():
        np.testing.assert_allclose(fixed.innovations[sensor].whitened, innovations.whitened, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("name", ["right-invariant", "two-frame", "geometric"])
@pytest.mark.parametrize("seed", range(3))
def test_without_its_reset_it_is_another_filter(name, seed):
    rng = np.random.default_rng(seed)
    record = simulated(rng)
    initial = started(record, rng, attitude_sigma=0.2, bias_sigma=1e-3)
    reference = family.run("mekf", record, BELIEF, initial, full_covariance=True)
    other = family.run(name, record, BELIEF, initial, full_covariance=True)
    attitude, _, covariance = difference(other, reference)
    assert attitude > 1e-6
    assert covariance > 1e-3


@pytest.mark.parametrize("name", EXTENDED[1:])
def test_what_each_filter_does_over_one_update(name):
    """The table of :mod:`strapdown.family.extended`: P⁺ = G P⁻ Gᵀ and b⁺, with the Kalman update done by plain matrices."""
    rng = np.random.default_rng(5)
    time = np.array([0.0, 1.0])
    M = rng.standard_normal((6, 6)) * np.array([0.3] * 3 + [0.02] * 3)[:, None]
    bias = np.array([0.3, -0.2, 0.1])
    initial = mekf.State(attitude=quaternion.exp([0.3, 0.2, -0.4]), bias=bias, covariance=M @ M.T)
    r, variance = REFERENCES["direction"], 0.05**2
    z = quaternion.rotate(
        quaternion.conjugate(quaternion.multiply(initial.attitude, quaternion.exp([0.2, -0.3, 0.1]))), r
    )
    series = VectorMeasurements(
        sensor="sun", kind="direction", time=time[:1], vector_b=z[None], reference_f=r, sigma=np.sqrt(variance)
    )
    record = ImuRecord(time=time, increments=np.zeros((1, 3)), vectors=(series,))
    estimate = family.run(name, record, BELIEF, initial, full_covariance=True)
    # The update in the body side's own terms: predicted r_b and z = r_b + r_b × δθ, across r_b.
    r_b = quaternion.rotate(quaternion.conjugate(initial.attitude), r)
    across = np.linalg.svd(r_b[None])[2][1:]
    H = np.hstack([across @ kinematics.skew(r_b), np.zeros((2, 3))])
    P = initial.covariance
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + variance * np.eye(2))
    correction = K @ (across @ (z - r_b))
    a, c = correction[:3], correction[3:]
    assert np.linalg.norm(a) > 0.1
    P = (np.eye(6) - K @ H) @ P
    back = expm(-kinematics.skew(a))
    G = np.eye(6)
    if name == "fixed-side":
        G[:3, :3] = kinematics.right_jacobian(a)
        b = bias + c
    elif name == "right-invariant":
        G[:3, :3] = back
        b = bias + c
    elif name == "two-frame":
        G[:3, :3] = G[3:, 3:] = back
        b = bias + kinematics.right_jacobian(a) @ c
    else:
        # Linear in (δθ, η): the gain of η is that of δb less [b] that of δθ.
        b = back @ bias + c - np.cross(bias, a)
        G[3:, :3] = kinematics.skew(b - bias)
    np.testing.assert_allclose(
        estimate.attitude[0], quaternion.multiply(initial.attitude, quaternion.exp(a)), atol=1e-12
    )
    np.testing.assert_allclose(estimate.bias[0], b, atol=1e-12)
    np.testing.assert_allclose(estimate.covariance[0], G @ P @ G.T, atol=1e-13)


@pytest.mark.parametrize("name", family.FILTERS)
@pytest.mark.parametrize("kind", ["direction", "vector"])
def test_nis_is_that_of_the_whole_innovation(name, kind):
    """One update under a prior with correlations: the sum of the whitened squares is eᵀ S⁻¹ e."""
    rng = np.random.default_rng(6)
    M = rng.standard_normal((6, 6)) * 1e-5
    initial = mekf.State(attitude=quaternion.exp([0.3, 0.2, -0.4]), bias=np.zeros(3), covariance=M @ M.T)
    r, sigma = REFERENCES["direction"], 1e-5
    r_b = quaternion.rotate(quaternion.conjugate(initial.attitude), r)
    z = r_b + 2e-5 * rng.standard_normal(3)
    series = VectorMeasurements(
        sensor="sun",
        kind=kind,
        time=[0.0],
        vector_b=(z if kind == "vector" else z / np.linalg.norm(z))[None],
        reference_f=r,
        sigma=sigma,
    )
    record = ImuRecord(time=np.array([0.0, 1.0]), increments=np.zeros((1, 3)), vectors=(series,))
    rows = np.eye(3) if kind == "vector" else np.linalg.svd(r_b[None])[2][1:]
    H = rows @ kinematics.skew(r_b)
    S = H @ initial.covariance[:3, :3] @ H.T + sigma**2 * np.eye(len(rows))
    e = rows @ (series.vector_b[0] - r_b)
    nis = family.run(name, record, BELIEF, initial).innovations["sun"].nis
    np.testing.assert_allclose(nis, [e @ np.linalg.solve(S, e)], rtol=1e-3 if name == "usque" else 1e-8)


# -------------------------------------------------------------------------------------------- the two-frames group and others


def compose(first, second):
    """The group law of the two-frames group, attitude and body vector: (R₁, b₁) • (R₂, b₂) = (R₁R₂, b₂ + R₂ᵀ b₁)."""
    return (
        quaternion.multiply(first[0], second[0]),
        second[1] + quaternion.rotate(quaternion.conjugate(second[0]), first[1]),
    )


@pytest.mark.parametrize("seed", range(4))
def test_two_frame_correction_is_the_group_exponential(seed):
    rng = np.random.default_rng(seed)
    a, c, b = 0.3 * rng.standard_normal(3), rng.standard_normal(3), rng.standard_normal(3)
    q = quaternion.exp(rng.standard_normal(3))
    squarings = 17
    small, n = a / 2**squarings, c / 2**squarings
    element = (quaternion.exp(small), n - 0.5 * np.cross(small, n))
    for _ in range(squarings):
        element = compose(element, element)
    wanted = compose(element, (q, b))
    got = family_step.close_two_frame(tuple(q), tuple(b), tuple(a), tuple(c))
    np.testing.assert_allclose(got[0], wanted[0], atol=1e-10)
    np.testing.assert_allclose(got[1], wanted[1], atol=1e-9)


def matrix_of(A, B, C):
    P = np.empty((6, 6))
    P[:3, :3], P[3:, 3:] = np.reshape(mekf_full(A), (3, 3)), np.reshape(mekf_full(C), (3, 3))
    P[:3, 3:] = np.reshape(B, (3, 3))
    P[3:, :3] = P[:3, 3:].T
    return P


def mekf_full(S):
    return (S[0], S[1], S[2], S[1], S[3], S[4], S[2], S[4], S[5])


def blocks_of(P):
    upper = np.triu_indices(3)
    return (
        tuple(map(float, P[:3, :3][upper])),
        tuple(map(float, P[:3, 3:].ravel())),
        tuple(map(float, P[3:, 3:][upper])),
    )


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 0.02, 0.4])
def test_two_frame_propagation_is_that_of_its_linear_system(angle):
    """F = [[0, −I], [0, [w_f]]] is constant at constant rate: Van Loan's discretisation is an oracle."""
    rng = np.random.default_rng(7)
    dt = 0.3
    q, b = quaternion.exp(rng.standard_normal(3)), rng.standard_normal(3)
    phi = angle * np.array([0.6, -0.64, 0.48])
    w_f = quaternion.rotate(q, phi) / dt
    M = rng.standard_normal((6, 6))
    P = M @ M.T
    F = np.zeros((6, 6))
    F[:3, 3:], F[3:, 3:] = -np.eye(3), kinematics.skew(w_f)
    transition, Q = van_loan_discretization(F, np.diag([0.7] * 3 + [0.9] * 3), dt)
    _, A, B, C = family_step.predict_two_frame(tuple(q), tuple(b), *blocks_of(P), tuple(phi + b * dt), dt, 0.49, 0.81)
    np.testing.assert_allclose(matrix_of(A, B, C), transition @ P @ transition.T + Q, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("size", [0.1, 1.0, 1.8])
def test_geometric_update_is_what_its_error_says(size):
    """η = b_true − exp(−[δθ]) b: the covariance goes there by finite differences at b, and comes back at b⁺ = exp(−[a]) b + c_η."""
    rng = np.random.default_rng(8)
    b, a, c = rng.standard_normal(3), rng.standard_normal(3), rng.standard_normal(3)
    a *= size / np.linalg.norm(a)
    M = rng.standard_normal((6, 6))
    P = M @ M.T
    h = 1e-6

    def to_eta(bias):
        numeric = np.zeros((6, 6))
        for j, e in enumerate(np.eye(6)):
            ends = [
                np.concatenate([s * e[:3], bias + s * e[3:] - expm(-kinematics.skew(s * e[:3])) @ bias])
                for s in (h, -h)
            ]
            numeric[:, j] = (ends[0] - ends[1]) / (2.0 * h)
        return numeric

    q = quaternion.exp(rng.standard_normal(3))
    A, B, C = blocks_of(P)
    moved_q, moved_b, B, C = family_step.close_geometric(tuple(q), tuple(b), A, B, C, tuple(a), tuple(c))
    eta = (to_eta(b) @ np.concatenate([a, c]))[3:]
    wanted = expm(-kinematics.skew(a)) @ b + eta
    np.testing.assert_allclose(moved_b, wanted, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(moved_q, quaternion.multiply(q, quaternion.exp(a)), rtol=0.0, atol=1e-12)
    G = np.linalg.solve(to_eta(wanted), to_eta(b))
    np.testing.assert_allclose(matrix_of(A, B, C), G @ P @ G.T, rtol=1e-7, atol=1e-7)


def test_invariant_filters_never_see_what_one_reference_hides():
    """A turn about the only reference cannot be observed; the variance about it must only grow. The MEKF's reset leaks into it."""
    rng = np.random.default_rng(3)
    record = simulated(rng, kinds=("direction",), sigma=0.02, intervals=300, measurements=100)
    r = REFERENCES["direction"]
    initial = mekf.initial_state(
        quaternion.multiply(quaternion.exp([0.0, 0.9, 0.0]), record.truth.attitude[0]),
        attitude_sigma=1.0,
        bias_sigma=1e-6,
    )
    about = {}
    for name in EXTENDED:
        estimate = family.run(name, record, BELIEF, initial, full_covariance=True)
        r_b = quaternion.rotate(quaternion.conjugate(estimate.attitude), r)
        about[name] = np.einsum("ki,kij,kj->k", r_b, estimate.covariance[:, :3, :3], r_b)
    for name in ("right-invariant", "two-frame"):
        assert np.all(np.diff(about[name]) > -1e-9)
        assert about[name][-1] >= 1.0 - 1e-9
    assert about["mekf"][-1] < 0.99


# ------------------------------------------------------------------------------------------------------------- agreement


def heading_record(angles_measured, increments, dt, sigma, every):
    """A body at rest but for tiny turns about z, its heading measured every few intervals."""
    n = len(increments)
    time = np.arange(n + 1) * dt
    r = np.array([1.0, 0.0, 0.0])
    z = np.stack([np.cos(angles_measured), -np.sin(angles_measured), np.zeros_like(angles_measured)], axis=-1)
    series = VectorMeasurements(
        sensor="heading", kind="heading", time=time[every::every], vector_b=z, reference_f=r, sigma=sigma
    )
    turns = np.stack([np.zeros(n), np.zeros(n), increments], axis=-1)
    return ImuRecord(time=time, increments=turns, vectors=(series,))


@pytest.mark.parametrize("name", [*EXTENDED, "usque"])
def test_small_angles_about_one_axis_are_the_kalman_filter(name):
    rng = np.random.default_rng(9)
    n, every, dt, sigma = 120, 4, 0.5, 1e-6
    sv, su = 3e-7, 2e-8
    measured, increments = 1e-6 * rng.standard_normal(n // every), 1e-6 * rng.standard_normal(n)
    record = heading_record(measured, increments, dt, sigma, every)
    initial = mekf.initial_state(
        [1.0, 0.0, 0.0, 0.0], attitude_sigma=[1e-9, 1e-9, 2e-6], bias_sigma=[1e-10, 1e-10, 1e-6]
    )
    noise = mekf.ProcessNoise(angle_random_walk=sv, rate_random_walk=su)
    estimate = family.run(name, record, noise, initial, full_covariance=True)
    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.x, kf.P = np.zeros((2, 1)), np.diag([4e-12, 1e-12])
    kf.F, kf.H, kf.R = np.array([[1.0, -dt], [0.0, 1.0]]), np.array([[1.0, 0.0]]), np.array([[sigma**2]])
    q12 = -(su**2) * dt**2 / 2.0
    kf.Q = np.array([[sv**2 * dt + su**2 * dt**3 / 3.0, q12], [q12, su**2 * dt]])
    B = np.array([[1.0], [0.0]])
    for k in range(n):
        kf.predict(u=np.array([[increments[k]]]), B=B)
        if (k + 1) % every == 0:
            kf.update(measured[(k + 1) // every - 1])
        scale = np.sqrt(np.diag(kf.P))
        angle = quaternion.log(estimate.attitude[k + 1])[2]
        got = np.array([angle, estimate.bias[k + 1, 2]])
        np.testing.assert_allclose(got / scale, kf.x[:, 0] / scale, rtol=0.0, atol=1e-8)
        P = estimate.covariance[k + 1][np.ix_([2, 5], [2, 5])]
        np.testing.assert_allclose(P / np.outer(scale, scale), kf.P / np.outer(scale, scale), rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("points", [JulierSigmaPoints(6, kappa=0.5), MerweScaledSigmaPoints(6, 0.5, 2.0, 0.0)])
def test_usque_of_either_sigma_points_tends_to_the_mekf(points):
    rng = np.random.default_rng(11)
    record = simulated(rng, intervals=60, measurements=10, sigma=1e-5, noise=(1e-6, 1e-8))
    noise = mekf.ProcessNoise(angle_random_walk=1e-6, rate_random_walk=1e-8)
    initial = started(record, rng, attitude_sigma=1e-4, bias_sigma=1e-5)
    reference = mekf.run(record, noise, initial, full_covariance=True)
    attitude, bias, covariance = difference(
        unscented.run(record, noise, initial, full_covariance=True, points=points), reference
    )
    assert attitude < 1e-7
    assert bias < 1e-3
    assert covariance < 1e-3


@pytest.mark.parametrize("name", family.FILTERS)
def test_an_edge_more_at_each_measurement_changes_nothing(name):
    """The interval is split at a measurement anyway; told so by the record, the filter must arrive at the same state."""
    rng = np.random.default_rng(12)
    record = simulated(rng, intervals=30, measurements=6)
    initial = started(record, rng, attitude_sigma=0.1, bias_sigma=1e-3)
    times = np.unique(np.concatenate([record.time, *[s.time for s in record.vectors]]))
    interval = np.searchsorted(record.time, times[1:], side="left") - 1
    split = ImuRecord(
        time=times,
        increments=record.increments[interval] * (np.diff(times) / np.diff(record.time)[interval])[:, None],
        vectors=record.vectors,
    )
    whole = family.run(name, record, BELIEF, initial, full_covariance=True)
    parts = family.run(name, split, BELIEF, initial, full_covariance=True)
    kept = np.isin(times, record.time)
    np.testing.assert_allclose(parts.attitude[kept], whole.attitude, atol=1e-12)
    np.testing.assert_allclose(parts.bias[kept], whole.bias, atol=1e-12)
    np.testing.assert_allclose(parts.covariance[kept], whole.covariance, atol=1e-12)


@pytest.mark.parametrize("name", family.FILTERS)
def test_every_and_variance_tell_the_same_as_the_whole(name):
    rng = np.random.default_rng(13)
    record = simulated(rng, intervals=31, measurements=6)
    initial = started(record, rng, attitude_sigma=0.1, bias_sigma=1e-3)
    whole = family.run(name, record, BELIEF, initial, full_covariance=True)
    some = family.run(name, record, BELIEF, initial, every=7)
    np.testing.assert_array_equal(some.time, record.time[::7])
    np.testing.assert_array_equal(some.attitude, whole.attitude[::7])
    np.testing.assert_array_equal(some.variance, whole.variance[::7])
    assert some.covariance is None
    np.testing.assert_array_equal(whole.variance, np.diagonal(whole.covariance, axis1=1, axis2=2))
    for kind, dof in (("direction", 2), ("vector", 3), ("heading", 1)):
        assert whole.innovations[kind].whitened.shape == (6, dof)


def test_steps_hold_the_whole_record_once():
    rng = np.random.default_rng(14)
    record = simulated(rng, intervals=40, dt=6.0, jitter=0.0)  # two radians an interval: large turns are cut
    events, steps = stepping.events_and_steps(record, 4)
    np.testing.assert_allclose(steps.dt.sum(), record.time[-1], rtol=1e-13)
    np.testing.assert_allclose(steps.increment.sum(axis=0), record.increments.sum(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(steps.event[steps.event >= 0], np.arange(len(events.time)))
    np.testing.assert_array_equal(steps.row[steps.row >= 0], np.arange(len(steps.time)))
    assert np.linalg.norm(steps.increment, axis=1).max() <= 0.5
    clock = np.cumsum(steps.dt)
    np.testing.assert_allclose(clock[steps.event >= 0], events.time, rtol=1e-12)
    np.testing.assert_allclose(clock[steps.row >= 0], record.time[::4], rtol=1e-12)


@pytest.mark.parametrize("variant", range(4))
def test_plain_python_equals_compiled(variant):
    rng = np.random.default_rng(15)
    record = simulated(rng, intervals=15, measurements=4)
    initial = started(record, rng, attitude_sigma=0.1, bias_sigma=1e-3)
    events, steps = stepping.events_and_steps(record, 1)
    gains = complementary.steady_gains(record, BELIEF, initial)
    given_events = (events.kind, events.vector_b, events.variance, events.reference, events.triads)
    walk = (steps.dt, steps.increment, steps.event, steps.row, 1e-8, 1e-12, *given_events)
    state = mekf.pack(initial.attitude, initial.bias, initial.covariance)
    results = []
    for function in (family_loop.run_extended, compiled(family_loop.run_extended)):
        states, innovation = np.zeros((len(steps.time), 28)), np.zeros((len(events.time), 6))
        function(variant, *walk, state, states, innovation)
        results.append((states, innovation))
    for function in (family_complementary.run_complementary, compiled(family_complementary.run_complementary)):
        states, innovation = np.zeros((len(steps.time), 28)), np.zeros((len(events.time), 6))
        function(*walk, gains.attitude, gains.bias, state, states, innovation)
        results.append((states, innovation))
    for plain, fast in (results[:2], results[2:]):
        np.testing.assert_allclose(fast[0], plain[0], rtol=0.0, atol=1e-13)
        np.testing.assert_allclose(fast[1], plain[1], rtol=0.0, atol=1e-13)


# ------------------------------------------------------------------------------------------------- USQUE and complementary


@pytest.mark.parametrize("angle", [1e-12, 1e-6, 1e-2, 1.0, 2.5, 3.1])
def test_rodrigues_parameters(angle):
    """a = 1, f = 4: p = 4 tan(θ/4) n, four times the modified Rodrigues parameters of SciPy."""
    n = np.array([0.6, -0.64, 0.48])
    q = quaternion.exp(angle * n)
    np.testing.assert_allclose(unscented.quaternion_to_rodrigues(q), 4.0 * np.tan(angle / 4.0) * n, rtol=1e-12)
    np.testing.assert_allclose(
        unscented.quaternion_to_rodrigues(-q), 4.0 * Rotation.from_rotvec(angle * n).as_mrp(), rtol=1e-12
    )
    np.testing.assert_allclose(unscented.rodrigues_to_quaternion(4.0 * np.tan(angle / 4.0) * n), q, atol=1e-15)


@pytest.mark.parametrize(
    ("sv", "su", "sigma", "dt"), [(1e-4, 1e-6, 1e-2, 1.0), (1e-3, 1e-3, 1e-3, 0.5), (1e-6, 1e-9, 1e-5, 10.0)]
)
def test_gains_are_those_of_the_riccati_equation(sv, su, sigma, dt):
    F, H = np.array([[1.0, -dt], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    q12 = -(su**2) * dt**2 / 2.0
    Q = np.array([[sv**2 * dt + su**2 * dt**3 / 3.0, q12], [q12, su**2 * dt]])
    scale = np.diag([1.0 / sigma, dt / sigma])  # digits: angles in sigmas, biases in sigmas an interval
    S = np.linalg.inv(scale)
    P = solve_discrete_are((scale @ F @ S).T, (H @ S / sigma).T, scale @ Q @ scale.T, np.eye(1))
    P = S @ P @ S.T
    gain = P @ H.T / (P[0, 0] + sigma**2)
    np.testing.assert_allclose(complementary.farrenkopf_gains(sv, su, sigma, dt), gain[:, 0], rtol=1e-8)


def test_covariance_of_any_gain_is_josephs_form():
    rng = np.random.default_rng(16)
    M6 = rng.standard_normal((6, 6))
    P = M6 @ M6.T
    r = rng.standard_normal(3)
    r /= np.linalg.norm(r)
    M = np.eye(3) - np.outer(r, r)
    g, kappa, variance = 0.3, -0.2, 0.7
    K = np.vstack([g * M, kappa * M])
    H = np.hstack([M, np.zeros((3, 3))])
    wanted = (np.eye(6) - K @ H) @ P @ (np.eye(6) - K @ H).T + variance * K @ K.T
    got = family_complementary.corrected_covariance(
        *blocks_of(P), tuple(map(float, M[np.triu_indices(3)])), g, kappa, variance
    )
    np.testing.assert_allclose(matrix_of(*got), wanted, rtol=1e-12, atol=1e-12)


def test_complementary_filter_follows_the_paper_in_the_limit():
    """Small steps of one vector against equations (32), integrated by SciPy: R̂̇ = R̂ [Ω − b̂ + k_P ω_mes], b̂̇ = −k_I ω_mes."""
    r, true, gyro = np.array([0.0, 0.6, 0.8]), quaternion.exp([0.1, 0.2, 0.3]), np.array([0.02, -0.01, 0.03])
    kp, ki, duration, n = 1.0, 0.3, 4.0, 4000
    z = quaternion.rotate(quaternion.conjugate(true), r)
    start = quaternion.multiply(true, quaternion.exp([1.0, -0.8, 0.5]))

    def slope(t, y):
        q = quaternion.normalize(y[:4])
        mes = np.cross(z, quaternion.rotate(quaternion.conjugate(q), r))
        return np.concatenate([kinematics.body_quaternion_derivative(y[:4], gyro - y[4:] + kp * mes), -ki * mes])

    wanted = solve_ivp(slope, (0.0, duration), np.concatenate([start, np.zeros(3)]), rtol=1e-10, atol=1e-12).y[:, -1]
    dt = duration / n
    time = np.arange(n + 1) * dt
    series = VectorMeasurements(
        sensor="sun", kind="direction", time=time[1:], vector_b=np.tile(z, (n, 1)), reference_f=r, sigma=0.01
    )
    record = ImuRecord(time=time, increments=np.tile(gyro * dt, (n, 1)), vectors=(series,))
    gains = complementary.Gains(attitude=np.array([kp * dt]), bias=np.array([-ki * dt]))
    estimate = complementary.run(
        record, BELIEF, mekf.initial_state(start, attitude_sigma=1.0, bias_sigma=0.1), gains=gains
    )
    assert quaternion.angle_between(estimate.attitude[-1], quaternion.normalize(wanted[:4])) < 1e-3
    np.testing.assert_allclose(estimate.bias[-1], wanted[4:], atol=1e-3)


# ----------------------------------------------------------------------------------------------------------------- truth


@pytest.mark.parametrize("name", family.FILTERS)
def test_no_noise_and_no_error_stay_no_error(name):
    rng = np.random.default_rng(17)
    bias = np.array([1e-3, -2e-3, 5e-4])
    body = motion.ConstantRate(rate=(0.3, -0.5, 0.8))
    record = simulated(rng, bias=bias, noise=(0.0, 0.0), sigma=0.0, body=body)
    vectors = tuple(
        VectorMeasurements(
            sensor=s.sensor, kind=s.kind, time=s.time, vector_b=s.vector_b, reference_f=s.reference_f, sigma=0.01
        )
        for s in record.vectors
    )
    record = ImuRecord(time=record.time, increments=record.increments, vectors=vectors, truth=record.truth)
    initial = mekf.initial_state(record.truth.attitude[0], attitude_sigma=1e-6, bias_sigma=1e-7, bias=bias)
    believed = mekf.ProcessNoise(angle_random_walk=1e-7, rate_random_walk=1e-9)
    estimate = family.run(name, record, believed, initial)
    error = consistency.errors(estimate.attitude, estimate.bias, record.truth.attitude, record.truth.bias)
    assert np.abs(error[:, :3]).max() < 1e-12
    assert np.abs(error[:, 3:]).max() < 1e-12


@pytest.mark.parametrize("name", family.FILTERS)
def test_consistent_from_small_errors(name):
    """ANEES of attitude and bias within two-sided 99 % bounds at three epochs; outside when the noise is believed half as large."""
    runs = 30 if name == "usque" else 100
    nees, doubted = [], []
    for run in range(runs):
        rng = np.random.default_rng([18, run])
        record = simulated(rng, intervals=90, kinds=("direction", "vector"), measurements=25, dt=0.3)
        initial = started(record, rng, attitude_sigma=0.5 * DEGREE, bias_sigma=5e-4)
        for belief, values in ((record, nees), (halved(record), doubted)):
            if name == "usque" and values is doubted:
                continue
            estimate = family.run(name, belief, BELIEF, initial, every=30, full_covariance=True)
            error = consistency.errors(
                estimate.attitude, estimate.bias, record.truth.attitude[::30], record.truth.bias[::30]
            )
            values.append(consistency.nees(error, estimate.covariance)[1:] / 6.0)
    assert Verdict(mean=np.mean(nees, axis=0), degrees=6, runs=runs, probability=0.99).consistent
    if doubted:
        assert not Verdict(mean=np.mean(doubted, axis=0), degrees=6, runs=runs, probability=0.99).consistent


def halved(record):
    """The same record, its measurements believed twice as good as they are."""
    vectors = tuple(dataclasses.replace(s, sigma=0.5 * s.sigma) for s in record.vectors)
    return dataclasses.replace(record, vectors=vectors)


@pytest.mark.parametrize("name", family.FILTERS)
@pytest.mark.parametrize(("degrees", "left"), [(60.0, 0.5), (120.0, 3.0)])
def test_converges_from_large_errors(name, degrees, left):
    rng = np.random.default_rng(20)
    record = simulated(rng, intervals=600, kinds=("direction", "vector"), measurements=150, bias=1e-3)
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    initial = mekf.initial_state(
        quaternion.multiply(record.truth.attitude[0], quaternion.exp(degrees * DEGREE * axis)),
        attitude_sigma=60.0 * DEGREE,
        bias_sigma=2e-3,
    )
    estimate = family.run(name, record, BELIEF, initial)
    error = quaternion.angle_between(estimate.attitude, record.truth.attitude) / DEGREE
    np.testing.assert_allclose(error[0], degrees, rtol=1e-9)
    assert error[-1] < left


# ------------------------------------------------------------------------------------------------------------- wild starts


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.33333, 0.33334, 1.0, np.pi, 2.0 * np.pi, 50.0, 1e4])
def test_coefficients_of_a_turn_of_any_size(angle):
    """Against the series and closed forms in forty digits; either side of where polynomials give way to closed forms."""
    with mpmath.workdps(60):
        t = mpmath.mpf(angle) ** 2
        t = mpmath.sqrt(mpmath.mpf(float(t)))  # of the squared angle as a double

        def alternating(first):
            return mpmath.nsum(lambda k: (-1) ** k * t ** (2 * k) / mpmath.factorial(2 * k + first), [0, mpmath.inf])

        if angle <= 1.0:
            wanted = [alternating(1), alternating(2), alternating(3), alternating(4), 2 * alternating(5)]
        else:
            third = (t - mpmath.sin(t)) / t**3
            wanted = [mpmath.sin(t) / t, (1 - mpmath.cos(t)) / t**2, third, (t**2 / 2 - 1 + mpmath.cos(t)) / t**4]
            wanted.append((mpmath.mpf(1) / 3 - 2 * third) / t**2)
        wanted = [float(one) for one in wanted]
    got = family_turns.turn_coefficients(angle * angle)
    np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("angle", [1e-6, 0.2, 0.5, 2.0, np.pi, 9.0])
def test_propagation_over_any_turn_is_that_of_its_linear_system(angle):
    """Φ and Q against Van Loan's discretisation of δθ̇ = −[ω] δθ − δb, q against SciPy's rotations."""
    rng = np.random.default_rng(31)
    dt, phi = 0.7, angle * np.array([0.6, -0.64, 0.48])
    M = rng.standard_normal((6, 6))
    P = M @ M.T
    F = np.zeros((6, 6))
    F[:3, :3], F[:3, 3:] = -kinematics.skew(phi / dt), -np.eye(3)
    transition, Q = van_loan_discretization(F, np.diag([0.7] * 3 + [0.9] * 3), dt)
    q, b = quaternion.exp(rng.standard_normal(3)), rng.standard_normal(3)
    moved, A, B, C = family_step.predict_body_side(
        tuple(q), tuple(b), *blocks_of(P), tuple(phi + b * dt), dt, 0.49, 0.81
    )
    np.testing.assert_allclose(matrix_of(A, B, C), transition @ P @ transition.T + Q, rtol=0.0, atol=1e-11)
    wanted = Rotation.from_quat(q, scalar_first=True) * Rotation.from_rotvec(phi)
    assert (Rotation.from_quat(moved, scalar_first=True).inv() * wanted).magnitude() < 1e-12
    J = family_turns.right_jacobian_of_any_turn(tuple(phi))
    np.testing.assert_allclose(np.reshape(J, (3, 3)), -transition[:3, 3:] / dt, rtol=0.0, atol=1e-12)


def test_the_largest_correction_is_where_the_geometric_bias_begins_to_grow():
    theta = family_step.LARGEST_CORRECTION
    assert brentq(lambda x: x - 2.0 * np.sin(x), 1.0, 3.0, xtol=1e-15) == pytest.approx(theta, abs=1e-14)
    b = np.array([0.0, 1.0, 0.0])
    for angle, grows in ((0.5, False), (theta - 1e-6, False), (theta + 1e-6, True), (3.0, True)):
        a = np.array([angle, 0.0, 0.0])
        size = np.linalg.norm(expm(-kinematics.skew(a)) @ b - np.cross(b, a))
        assert (size > 1.0) == grows
    nothing = (0.0,) * 6, (0.0,) * 9, (0.0,) * 6
    q, moved, _, _ = family_step.close_geometric(
        (1.0, 0.0, 0.0, 0.0), tuple(b), *nothing, (3.0, 0.0, 0.0), (0.0, 0.0, 6.0)
    )
    np.testing.assert_allclose(q, quaternion.exp([theta, 0.0, 0.0]), atol=1e-14)
    a = np.array([theta, 0.0, 0.0])
    np.testing.assert_allclose(
        moved, expm(-kinematics.skew(a)) @ b - np.cross(b, a) + [0.0, 0.0, 2.0 * theta], atol=1e-12
    )


def wild(seed, intervals):
    """A record and a start from anywhere: errors up to 180°, covariances from far too small to far too large, good and bad sensors."""
    rng = np.random.default_rng([32, seed])
    kinds = (("direction",), ("direction", "vector"), ("direction", "vector", "heading"), ("heading",))[seed % 4]
    record = simulated(
        rng,
        intervals=intervals,
        kinds=kinds,
        measurements=intervals // 2,
        dt=10.0 ** rng.uniform(-1.0, 1.0),
        sigma=10.0 ** rng.uniform(-5.0, -1.0),
    )
    axis = rng.standard_normal(3)
    turn = (np.pi - 10.0 ** rng.uniform(-8.0, 0.4)) * axis / np.linalg.norm(axis)
    initial = mekf.initial_state(
        quaternion.multiply(record.truth.attitude[0], quaternion.exp(turn)),
        attitude_sigma=10.0 ** rng.uniform(-3.0, 1.0),
        bias_sigma=10.0 ** rng.uniform(-6.0, 0.0),
    )
    return record, initial


def assert_sound(estimate):
    """Unit quaternions, finite biases, covariances finite and positive definite."""
    np.testing.assert_allclose(np.linalg.norm(estimate.attitude, axis=1), 1.0, rtol=0.0, atol=1e-12)
    assert np.isfinite(estimate.bias).all()
    sigma = np.sqrt(estimate.variance)
    assert np.isfinite(sigma).all()
    assert np.linalg.eigvalsh(estimate.covariance / (sigma[:, :, None] * sigma[:, None, :])).min() > -1e-9


@pytest.mark.parametrize("name", family.FILTERS)
def test_every_filter_stays_finite_from_any_start(name):
    for seed in range(8 if name == "usque" else 100):
        record, initial = wild(seed, 60 if name == "usque" else 300)
        assert_sound(family.run(name, record, BELIEF, initial, full_covariance=True))


@pytest.mark.parametrize("seed", [35, 163, 375, 483])
def test_the_geometric_filter_stays_finite_where_its_bias_would_run_away(seed):
    """Starts from which the bias grows without end if corrections are taken in at any length."""
    record, initial = wild(seed, 2000)
    assert_sound(family.run("geometric", record, BELIEF, initial, full_covariance=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", family.FILTERS)
def test_every_filter_stays_finite_from_thousands_of_starts(name):
    for seed in range(100, 300 if name == "usque" else 3000):
        record, initial = wild(seed, 60 if name == "usque" else 2000)
        assert_sound(family.run(name, record, BELIEF, initial, full_covariance=True))


@pytest.mark.parametrize("name", family.FILTERS)
def test_a_heading_seen_straight_up_says_nothing(name):
    """The start takes the measured vector to the vertical exactly: it has no heading, and the filter waits for the next."""
    series = VectorMeasurements(
        sensor="compass", kind="heading", time=[0.5], vector_b=[[0.0, 0.0, 1.0]], reference_f=[1.0, 0.0, 0.0], sigma=0.1
    )
    record = ImuRecord(time=np.array([0.0, 1.0]), increments=np.zeros((1, 3)), vectors=(series,))
    initial = mekf.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=1.0, bias_sigma=0.1)
    estimate = family.run(name, record, BELIEF, initial, full_covariance=True)
    assert_sound(estimate)
    if name in EXTENDED:
        np.testing.assert_allclose(estimate.attitude[-1], initial.attitude, atol=1e-15)
        assert np.all(np.diff(estimate.variance[:, :3], axis=0) >= 0.0)


@pytest.mark.parametrize("name", family.FILTERS)
def test_a_gap_of_the_gyro_is_told(name):
    rng = np.random.default_rng(23)
    record = simulated(rng, intervals=20, measurements=5)
    initial = started(record, rng, attitude_sigma=0.1, bias_sigma=1e-3)
    longest = np.diff(record.time).max()
    late = dataclasses.replace(record, time=record.time + np.where(np.arange(21) > 12, 30.0 * longest, 0.0))
    (event,) = family.run(name, late, BELIEF, initial).events
    assert (event.kind, event.start, event.end) == ("gap", late.time[12], late.time[13])
    assert event == mekf.run(late, BELIEF, initial).events[0]
    assert family.run(name, record, BELIEF, initial).events == ()


# --------------------------------------------------------------------------------------------------------------- bad input


def test_bad_input_is_refused():
    rng = np.random.default_rng(20)
    record = simulated(rng, intervals=10, measurements=3)
    initial = started(record, rng, attitude_sigma=0.1, bias_sigma=1e-3)
    with pytest.raises(InputError, match="did you mean 'usque'"):
        family.run("usqe", record, BELIEF, initial)
    attitude = VectorMeasurements(
        sensor="tracker", kind="attitude", time=[0.1], attitude=[[1.0, 0.0, 0.0, 0.0]], sigma_axes=[1e-4] * 3
    )
    exact = VectorMeasurements(
        sensor="sun", kind="direction", time=[0.1], vector_b=[[1.0, 0, 0]], reference_f=[1.0, 0, 0], sigma=0.0
    )
    uneven = dataclasses.replace(exact, sigma_axes=[1e-3, 2e-3, 3e-3])
    for name in list(family.FILTERS)[1:]:
        with pytest.raises(InputError, match="every"):
            family.run(name, record, BELIEF, initial, every=0)
        for series, message in (
            (attitude, r"tracker.*attitude"),
            (exact, "sun: sigma"),
            (uneven, "^sun: the family's filters take one sigma a sample.*give sigma alone, or use mekf.run"),
        ):
            wrong = ImuRecord(time=record.time, increments=record.increments, vectors=(series,))
            with pytest.raises(InputError, match=message):
                family.run(name, wrong, BELIEF, initial)
    with pytest.raises(InputError, match="6"):
        unscented.run(record, BELIEF, initial, points=JulierSigmaPoints(3, kappa=0.0))
    moving = VectorMeasurements(
        sensor="field", kind="direction", time=[0.1], vector_b=[[1.0, 0, 0]], reference_f=[[1.0, 0, 0]], sigma=0.1
    )
    with pytest.raises(InputError, match="field: reference_f"):
        family.run("mahony", dataclasses.replace(record, vectors=(moving,)), BELIEF, initial)
    gains = complementary.Gains(attitude=np.zeros(2), bias=np.zeros(2))
    with pytest.raises(InputError, match=r"gains\.attitude"):
        complementary.run(record, BELIEF, initial, gains=gains)


@pytest.mark.parametrize("name", [name for name in family.FILTERS if name != "mahony"])
def test_a_reference_for_each_measurement_is_taken_as_it_is(name):
    rng = np.random.default_rng(22)
    record = simulated(rng, intervals=20, measurements=5)
    initial = started(record, rng, attitude_sigma=0.1, bias_sigma=1e-3)
    each = tuple(dataclasses.replace(series, reference_f=series.references_f.copy()) for series in record.vectors)
    one = family.run(name, record, BELIEF, initial)
    other = family.run(name, dataclasses.replace(record, vectors=each), BELIEF, initial)
    assert np.allclose(one.attitude, other.attitude, rtol=0.0, atol=1e-12)
    assert np.allclose(one.bias, other.bias, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", family.FILTERS)
def test_a_record_without_measurements_is_dead_reckoning(name):
    rng = np.random.default_rng(21)
    record = simulated(rng, intervals=20, kinds=())
    initial = started(record, rng, attitude_sigma=1e-5, bias_sigma=1e-6)
    reference = mekf.run(record, BELIEF, initial, full_covariance=True)
    attitude, bias, covariance = difference(family.run(name, record, BELIEF, initial, full_covariance=True), reference)
    assert attitude < 1e-12
    assert bias < 1e-6
    assert covariance < 1e-6


def test_extended_filters_are_those_of_the_table():
    assert family.FILTERS["fixed-side"] is extended.fixed_side
    assert set(EXTENDED) | {"usque", "mahony"} == set(family.FILTERS)


@pytest.fixture(scope="module")
def comparison():
    spec = importlib.util.spec_from_file_location(
        "filter_family", Path(__file__).parents[1] / "sims" / "filter_family.py"
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules["filter_family"] = module
    spec.loader.exec_module(module)
    return module


def test_study_says_which_filter_may_be_believed(comparison):
    """From small errors all are right; from large ones the MEKF is overconfident, the invariant filters less so, the baseline not."""
    names = [name for name in family.FILTERS if name != "usque"]
    result = comparison.main(runs=25, duration=120.0, filters=names, seed=3)
    for name in names:
        assert result.outcome("small", name).consistent
        assert result.outcome("small", name).converged == 1.0
    at = 10
    for case in ("large", "one direction"):
        mekf_, invariant, baseline = (
            result.outcome(case, name).anees[at] for name in ("mekf", "right-invariant", "mahony")
        )
        assert mekf_ > 3.0 * invariant > 9.0 * baseline
        np.testing.assert_allclose(
            result.outcome(case, "fixed-side").anees, result.outcome(case, "mekf").anees, rtol=1e-6
        )


def test_study_runs_small_and_draws(comparison, tmp_path):
    result = comparison.main(**comparison.SMALL, out=tmp_path)
    assert [path.name for path in result.figures] == ["filter_family.png"]
    assert (tmp_path / "filter_family.png").stat().st_size > 10_000
    text = (tmp_path / "filter_family.txt").read_text(encoding="utf-8")
    assert all(name in text for name in family.FILTERS)
