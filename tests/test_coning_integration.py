"""Integration of records: orders of convergence on exact motions, rounding over an hour, frames, rates, short records, bad input."""

import dataclasses
import functools
import itertools
import math
from fractions import Fraction

import mpmath as mp
import numpy as np
import pytest
from measured import turn_to, waves

from sims.coning_algorithms import exact_step, polynomial_step
from strapdown import coning, motion, quaternion
from strapdown.checks import InputError
from strapdown.coning import ALGORITHMS
from strapdown.coning import coefficients as exact
from strapdown.kernels import integration as kernels
from strapdown.kernels import integration_polynomial as polynomial_kernels
from strapdown.kernels.machine import compiled

MOTIONS = {
    "coning": motion.Coning(angle=0.5, frequency=0.45),
    "spin-cone": motion.SpinCone(precession_rate=2.5, spin_rate=-1.4, angle=0.7),
    "torque-free": motion.TorqueFree(inertia=(1.0, 1.7, 2.4), initial_rate=(1.2, 1.5, -0.9)),
    "harmonics": waves(((1.1, -0.3, 0.2), 0.4), ((0.2, 0.9, -0.5), 0.31, 1.1), mean=(0.3, -0.2, 0.6)),
}
SECONDS = 12.0


@functools.cache
def truth(name, n):
    edges = np.linspace(0.0, SECONDS, n + 1)
    return MOTIONS[name].attitude(edges), MOTIONS[name].increments(edges)


def angle_errors(estimate, true):
    """Return the angles between two series of attitudes, rad, good to rounding for small ones."""
    return np.linalg.norm(turn_to(estimate, true), axis=-1)


def greatest_error(algorithm, name, n):
    true, increments = truth(name, n)
    return angle_errors(coning.integrate(increments, algorithm, true[0]), true[:: algorithm.samples]).max()


def measured_order(algorithm, name):
    """Return the slope of the error between the two finest records of a ladder whose errors stand above rounding."""
    n = algorithm.samples
    ladder = [n * (k // n + 1) for k in (60, 75, 95, 120, 150, 190, 240, 480, 960, 1920, 3840)]
    ladder = ladder[:-4] if algorithm.order > 4 else ladder[5:]
    for coarse, fine in reversed(list(itertools.pairwise(ladder))):
        fine_error = greatest_error(algorithm, name, fine)
        if fine_error > 5e-13:
            return math.log(greatest_error(algorithm, name, coarse) / fine_error) / math.log(fine / coarse)
    raise AssertionError("every error of the ladder is at rounding")


@pytest.mark.parametrize("name", list(ALGORITHMS))
def test_order_of_convergence(name):
    algorithm = ALGORITHMS[name]
    for key in MOTIONS:
        if (name, key) in {("matched-4-11", "spin-cone"), ("matched-1-8-8", "spin-cone")}:
            assert greatest_error(algorithm, key, 76) < 1e-12  # at rounding on the coarsest records: no order to see
            continue
        order = measured_order(algorithm, key)
        # Not below the stated order; above it where the motion is kind to the algorithm. The highest orders meet rounding before their
        # leading term rules (in 50 digits, test_coning_drift shows it).
        below = 0.15 if algorithm.order <= 4 else 0.6 if algorithm.order <= 11 else 5.0
        assert order > algorithm.order - below, key
        assert order < algorithm.order + (1.3 if algorithm.order <= 11 else 4.0), key


def test_constant_rate_is_exact():
    spin = motion.ConstantRate(rate=(0.3, -0.5, 0.7))
    t = np.arange(8 * 21 + 1) * 0.1
    for name, algorithm in ALGORITHMS.items():
        error = angle_errors(
            coning.integrate(spin.increments(t), algorithm), spin.attitude(t)[:: algorithm.samples]
        ).max()
        assert error < (2e-13 if name == "matched-4-11" else 5e-14), name


@pytest.mark.parametrize("name", ["one-sample", "four-sample", "polynomial-3"])
def test_random_hour_stays_within_the_random_walk_of_rounding(name):
    generator = np.random.default_rng(11)
    n = 360_000
    increments = 1e-3 * generator.standard_normal((n, 3))
    attitude = coning.integrate(increments, name)
    norm = np.abs(np.sqrt(np.einsum("ij,ij->i", attitude, attitude)) - 1.0)
    assert norm.max() <= 4e-16
    if name == "one-sample":
        reference = extended_product(increments)
        error = angle_errors(attitude[-1], reference)
        assert error < 4 * math.sqrt(n) * 2.0**-53
        assert error > 0.01 * math.sqrt(n) * 2.0**-53


def extended_product(increments):
    """Return the product of all exp(Δθ) in 64-bit mantissas, by pairwise reduction."""
    v = increments.astype(np.longdouble)
    half = np.sqrt(np.sum(v * v, axis=1)) / 2
    q = np.concatenate([np.cos(half)[:, None], (np.sin(half) / (2 * half))[:, None] * v], axis=1)
    while len(q) > 1:
        last = q[len(q) - len(q) % 2 :]
        p, r = q[: len(q) - len(q) % 2 : 2], q[1 : len(q) - len(q) % 2 : 2]
        w = p[:, :1] * r[:, :1] - np.sum(p[:, 1:] * r[:, 1:], axis=1, keepdims=True)
        u = p[:, :1] * r[:, 1:] + r[:, :1] * p[:, 1:] + np.cross(p[:, 1:], r[:, 1:])
        q = np.concatenate([np.concatenate([w, u], axis=1), last])
    return np.asarray(q[0], float)


@pytest.mark.parametrize(("length", "at"), [(10, 5), (2 * kernels.BLOCK, 20)])
def test_renormalisation_does_not_hide_a_fault(length, at):
    # A step quaternion of norm 1.001 shows in every row after it, of its block at least: one Newton step takes 1e-3
    # to 1e-6, not to nothing.
    steps = np.tile([1.0, 0.0, 0.0, 0.0], (length, 1))
    steps[at] *= 1.001
    attitude = np.empty((length + 1, 4))
    initial = np.array([1.0, 0.0, 0.0, 0.0])
    compiled(kernels.accumulate_quaternions)(steps.reshape(-1), initial, np.empty(kernels.WORK), attitude.reshape(-1))
    error = np.abs(np.linalg.norm(attitude, axis=1) - 1.0)
    assert np.all(error[: at + 1] == 0.0)
    assert np.all(error[at + 1 : kernels.BLOCK + 1] > 1e-7)


@pytest.mark.parametrize("seed", range(6))
def test_a_constant_rate_is_off_by_a_few_roundings_of_its_total_angle(seed):
    # The same step gives the same rounding in every segment; it adds up with the angle, as the rounding of the step itself does.
    increment = 10.0 ** -(1 + seed / 2) * np.random.default_rng(seed).uniform(-1.0, 1.0, 3)
    n = 100_000
    attitude = coning.integrate(np.broadcast_to(increment, (n, 3)))
    with mp.workdps(40):
        exactly = [mp.mpf(x) for x in increment]
        angle = mp.sqrt(sum(x * x for x in exactly))
        half = n * angle / 2
        true = np.array([mp.cos(half), *(mp.sin(half) * x / angle for x in exactly)], dtype=float)
    error = angle_errors(attitude[-1], true)
    assert error < 4 * math.sqrt(n) * 2.0**-53 + 8 * 2.0**-54 * n * float(angle)


@pytest.mark.parametrize("n", [1, 33, 1000])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_values_that_are_not_finite_are_named(n, bad):
    for place in {0, n // 2, n - 1}:
        increments = 0.01 * np.random.default_rng(n).standard_normal((n, 3))
        increments[place, 1] = bad
        with pytest.raises(InputError, match=rf"increments\[{place}, 1\] is -?(nan|inf); remove"):
            coning.integrate(increments)
    with pytest.raises(InputError, match="more than 1e150 rad"):
        coning.integrate(np.full((n, 3), 1e200))


def test_the_record_and_the_attitude_are_left_alone():
    increments = 0.01 * np.random.default_rng(1).standard_normal((700, 3))
    kept = increments.copy()
    first = coning.integrate(increments)
    again = first.copy()
    coning.integrate(-increments)
    np.testing.assert_array_equal(increments, kept)
    np.testing.assert_array_equal(first, again)
    coning.rotation_vectors(increments, "one-sample")[:] = 9.0
    np.testing.assert_array_equal(increments, kept)
    # Neither layout nor type of the array matters.
    np.testing.assert_array_equal(coning.integrate(np.asfortranarray(increments)), first)
    np.testing.assert_array_equal(coning.integrate(increments.tolist()), first)


def test_the_running_product_is_renormalised():
    # Steps a little too long, as rounding might leave them, do not add up: without renormalisation 20,000 of them make 2e-5.
    steps = np.tile([1.0 + 1e-9, 0.0, 0.0, 0.0], (20_000, 1))
    attitude = np.empty((20_001, 4))
    initial = np.array([1.0, 0.0, 0.0, 0.0])
    compiled(kernels.accumulate_quaternions)(steps.reshape(-1), initial, np.empty(kernels.WORK), attitude.reshape(-1))
    assert np.abs(np.linalg.norm(attitude, axis=1) - 1.0).max() < 1e-12


def test_the_first_steps_of_a_matched_algorithm_have_no_correction():
    # Near the record's ends the step has another place in the window, for which the correction is not made.
    matched = ALGORITHMS["matched-4-11"]
    plain = dataclasses.replace(matched, name="plain", products=exact.taylor_pairs(4, 11))
    increments = motion.Coning(angle=0.5, frequency=0.15).increments(np.arange(61.0))
    with_correction, without = (coning.rotation_vectors(increments, a) for a in (matched, plain))
    np.testing.assert_array_equal(with_correction[:3], without[:3])  # 11 samples of history are missing
    assert np.all(np.any(with_correction[3:] != without[3:], axis=1))


@pytest.mark.parametrize("size", [0.01, 0.03, 0.06, 0.1, 0.2])
def test_rough_data_are_solved_to_rounding_or_not_fitted_at_all(size):
    algorithm = ALGORITHMS["matched-1-8-8"]
    increments = size * np.random.default_rng(int(1000 * size)).standard_normal((17, 3))
    step = quaternion.exp(coning.rotation_vectors(increments, algorithm)[8])
    with mp.workdps(40):
        exactly = np.array(exact_step(algorithm, [tuple(map(mp.mpf, row)) for row in increments.tolist()]), dtype=float)
    plain = quaternion.exp(increments[8])
    assert min(angle_errors(step, exactly), angle_errors(step, plain)) < 1e-14
    if size <= 0.03:
        assert angle_errors(step, exactly) < 1e-14


@pytest.mark.parametrize("top", [1e-3, 1.0, 3.9])
def test_a_series_ruled_by_its_highest_power_is_not_taken_for_ended(top):
    # Two factors of the highest power meet only in term 2M, after many that vanish.
    m = 17
    rates = np.zeros((4, m))
    rates[0, m - 1] = top * 2.0 ** (m - 1)
    rates[1, 2] = 1e-3
    rates[3] = top
    series = np.empty((2 * m + 24, 4))
    step, ended = polynomial_kernels.interval_quaternion(rates, m, series)
    with mp.workdps(30):
        # About the middle, s from −½ to ½; polynomial_step starts at t = 0.
        powers = [(mp.mpf(rates[0, k]), mp.mpf(rates[1, k]), mp.mpf(0)) for k in range(m)]
        moved = [
            tuple(
                sum(mp.binomial(k, j) * (-mp.mpf(1) / 2) ** (k - j) * powers[k][axis] for k in range(j, m))
                for axis in range(3)
            )
            for j in range(m)
        ]
        exactly = np.array(polynomial_step(moved, 1), dtype=float)
    assert ended == (top < 0.1)
    if ended:
        np.testing.assert_allclose(step, exactly, atol=3e-16)


def test_fitted_rates_bound_what_is_left_out():
    fit = (
        np.random.default_rng(1).standard_normal((6, 6))
        * 10.0 ** -np.arange(6.0)
        * np.array([1, 1, 1, 1, 1e-20, 1e-20])
    )
    increments = np.random.default_rng(2).standard_normal((9, 3))
    rates = np.empty((4, 6))
    bound, kept = polynomial_kernels.fitted_rates(increments, 2, fit, rates)
    np.testing.assert_allclose(rates[:3], (fit.T @ increments[2:8]).T, rtol=1e-12)
    sizes = np.abs(rates[:3]).sum(axis=0) * 0.5 ** np.arange(6)
    np.testing.assert_allclose(rates[3], sizes[::-1].cumsum()[::-1], rtol=1e-14)
    assert (bound, kept) == (rates[3, 0], 4)


def test_a_series_without_room_to_end_is_not_used():
    increments = 0.05 * np.random.default_rng(1).standard_normal((12, 3))
    fits = np.array([exact.floats(exact.rates_about(4, Fraction(2 * i + 1, 2))) for i in range(4)])
    steps = np.empty((3, 4))
    for room, used in ((32, True), (3, False)):
        work = np.empty((4, 4)), np.empty((room, 4))
        polynomial_kernels.polynomial_steps(increments, 4, 0, fits, np.zeros((4, 4)), *work, steps)
        plain = coning.integrate(increments)[::4]
        distance = angle_errors(steps, quaternion.multiply(quaternion.conjugate(plain[:-1]), plain[1:]))
        assert np.all(distance > 1e-6) if used else np.all(distance < 1e-15)


@pytest.mark.parametrize(
    "length", [0, 1, 2, 5, 31, 32, 33, 39, kernels.BLOCK - 1, kernels.BLOCK, kernels.BLOCK + 1, 1000]
)
def test_blocks_join(length):
    increments = 0.4 * np.random.default_rng(length).standard_normal((length, 3))
    attitude = coning.integrate(increments)
    assert attitude.shape == (length + 1, 4)
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for k, phi in enumerate(increments):
        q = quaternion.multiply(q, quaternion.exp(phi))
        assert angle_errors(attitude[k + 1], q) < 1e-14 * math.sqrt(k + 1)


@pytest.mark.parametrize("size", [1e-9, 0.5, 0.999, 1.001, 2.0, 3.1, 7.0, 40.0])
def test_large_rotation_vectors(size):
    phi = size * np.array([0.6, -0.64, 0.48])
    attitude = coning.integrate(phi[None, :])
    np.testing.assert_allclose(attitude[1], quaternion.exp(phi), atol=2e-15 * max(1.0, size))


def test_rotation_vectors_are_the_steps_of_integrate():
    increments = 0.03 * np.random.default_rng(5).standard_normal((8 * 15, 3))
    for name, algorithm in ALGORITHMS.items():
        vectors = coning.rotation_vectors(increments, name)
        attitude = coning.integrate(increments, name)
        assert vectors.shape == (len(increments) // algorithm.samples, 3), name
        steps = quaternion.multiply(quaternion.conjugate(attitude[:-1]), attitude[1:])
        np.testing.assert_allclose(quaternion.log(steps), vectors, atol=3e-15, err_msg=name)


@pytest.mark.parametrize("extra", [0, 1, 3, 7])
def test_short_records_and_rests(extra):
    # Every length works; the motion is slow enough that any algorithm of second order follows it.
    cone = motion.Coning(angle=0.1, frequency=0.05)
    for name, algorithm in ALGORITHMS.items():
        n = algorithm.samples + extra
        t = np.arange(n + 1) * 0.1
        attitude = coning.integrate(cone.increments(t), algorithm, cone.attitude(0.0))
        assert len(attitude) == n // algorithm.samples + 1, name
        assert angle_errors(attitude, cone.attitude(t)[:: algorithm.samples][: len(attitude)]).max() < 2e-5, name


@pytest.mark.parametrize("name", ["matched-4-11", "matched-1-8-8"])
def test_data_too_rough_for_a_polynomial_fall_back_to_their_increments(name):
    increments = 2.0 * np.random.default_rng(4).standard_normal((120, 3))
    attitude = coning.integrate(increments, name)
    plain = coning.integrate(increments)[:: ALGORITHMS[name].samples]
    assert np.abs(np.linalg.norm(attitude, axis=1) - 1.0).max() < 4e-16
    assert angle_errors(attitude, plain).max() < 1e-12


@pytest.mark.parametrize("name", ["one-sample-previous-3", "four-sample-previous-2", "one-sample-previous-1"])
def test_the_first_steps_are_as_good_as_the_rest(name):
    # Looking ahead instead of back, the first steps keep the order: reversing the record in time reverses the rotations.
    increments = 0.05 * np.random.default_rng(2).standard_normal((40, 3))
    n, p = ALGORITHMS[name].samples, ALGORITHMS[name].previous
    forward = coning.rotation_vectors(increments, name)
    backward = -coning.rotation_vectors(-increments[::-1], name)[::-1]
    first = -(-p // n)
    np.testing.assert_allclose(forward[:first], backward[:first], atol=1e-16)


@pytest.mark.parametrize("points", [2, 4, 6, 8])
def test_increments_from_rates_are_exact_for_polynomials_everywhere(points):
    t = np.arange(14) * 0.1
    power = points - 1
    rates = np.stack([t**power, 1.0 - t**power, 0.5 + t], axis=1)
    integral = np.stack(
        [t ** (power + 1) / (power + 1), t - t ** (power + 1) / (power + 1), 0.5 * t + 0.5 * t * t], axis=1
    )
    np.testing.assert_allclose(coning.increments_from_rates(rates, 0.1, points), np.diff(integral, axis=0), atol=2e-15)


def test_increments_from_few_rates():
    rates = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    np.testing.assert_allclose(coning.increments_from_rates(rates, 0.5, 8)[:, 0], [0.75, 1.5])


def test_rate_samples_cost_what_the_docstring_says():
    # Increments by the trapezoid drift like no correction at all; by eight points, as the algorithm does with true increments.
    cone = motion.Coning(angle=0.01, frequency=1.0)
    h = 0.02
    t = np.arange(4001) * h
    lam = 2 * math.pi * h
    true = cone.attitude(t)

    def drift(attitude):
        error = quaternion.multiply(attitude[100], quaternion.conjugate(true[200]))
        last = quaternion.multiply(attitude[-1], quaternion.conjugate(true[-1]))
        return 2 * (last[3] - error[3]) / (t[-1] - t[200]) / (cone.angle**2 * 2 * math.pi)

    naive, eight = (
        coning.integrate(coning.increments_from_rates(cone.body_rate(t), h, points), "two-sample", true[0])
        for points in (2, 8)
    )
    assert drift(naive) == pytest.approx(-(lam**2) / 12, rel=0.05)
    assert drift(eight) == pytest.approx(-float(ALGORITHMS["two-sample"].drift_constant) * lam**4, rel=0.05)


@pytest.mark.parametrize(
    ("call", "arguments", "message"),
    [
        (coning.integrate, ([[1.0, 2.0]],), "increments has shape"),
        (coning.integrate, (np.zeros((1, 3)), "two-samples"), "did you mean 'two-sample'"),
        (coning.integrate, (np.zeros((1, 3)), "one-sample", (2.0, 0.0, 0.0, 0.0)), "norm 2"),
        (coning.integrate, (np.zeros((1, 3)), "one-sample", np.eye(4)), "initial_attitude has shape"),
        (coning.increments_from_rates, (np.zeros((5, 3)), 0.1, 3), "even"),
        (coning.increments_from_rates, (np.zeros((1, 3)), 0.1), "at least 2"),
        (coning.increments_from_rates, (np.zeros((5, 3)), 0.0), "sample_interval"),
    ],
)
def test_bad_input(call, arguments, message):
    with pytest.raises(InputError, match=message):
        call(*arguments)


def test_time_per_sample_is_a_time():
    assert 1e-10 < coning.time_per_sample("two-sample", 1000) < 1e-3
    with pytest.raises(InputError, match="samples"):
        coning.time_per_sample("eight-sample", 4)


# ----------------------------------------------------------------------------------------------------------- tables of one's own


@pytest.mark.parametrize(("previous", "following"), [(1, 0), (0, 1), (2, 3), (4, 0)])
def test_a_pair_table_over_a_window_keeps_its_order_up_to_both_ends(previous, following):
    """A polynomial rate that time-Taylor tables integrate exactly to second order; expected by hand from each step's start."""
    n = 2
    a, b, quadratic = (
        np.array([0.02, -0.01, 0.005]),
        np.array([0.004, 0.006, -0.008]),
        np.array([0.001, -0.002, -0.0015]),
    )
    table = coning.Algorithm(
        name="mine",
        solver="pairs",
        samples=n,
        previous=previous,
        following=following,
        order=4,
        products=exact.taylor_pairs(n, previous, following),
    )
    assert exact.second_order(table.products, n, previous) == 4
    for length in (n, n + 1, table.window, table.window + 1, 4 * table.window + 1):
        c = quadratic if length > 2 else np.zeros(3)
        t = np.arange(length + 1.0)[:, None]
        increments = np.diff(a * t + b * t**2 / 2.0 + c * t**3 / 3.0, axis=0)
        expected = []
        for t0 in range(0, length - n + 1, n):
            a0, b0 = a + b * t0 + c * t0**2, b + 2.0 * c * t0
            first_order = a0 * n + b0 * n**2 / 2.0 + c * n**3 / 3.0
            second_order = (
                n**3 / 12.0 * np.cross(a0, b0) + n**4 / 12.0 * np.cross(a0, c) + n**5 / 60.0 * np.cross(b0, c)
            )
            expected.append(first_order + second_order)
        rotations = coning.rotation_vectors(increments, table)
        np.testing.assert_allclose(rotations, expected, rtol=0.0, atol=1e-14)


class Strict(np.ndarray):
    """An array that refuses what NumPy, and compiled code with it, would read elsewhere: negative indices, and those beyond the end."""

    def _check(self, index):
        for item, size in zip(index if isinstance(index, tuple) else (index,), self.shape, strict=False):
            ends = (item.start, item.stop) if isinstance(item, slice) else (item,)
            for end in ends:
                if end is not None and not 0 <= end <= (size if isinstance(item, slice) else size - 1):
                    raise IndexError(f"{index} of an array of shape {self.shape}")

    def __getitem__(self, index):
        self._check(index)
        return super().__getitem__(index)

    def __setitem__(self, index, value):
        self._check(index)
        super().__setitem__(index, value)


def windows():
    """Tables of every solver that takes a window, and of those that take the step alone."""
    for n, p, f in itertools.product((1, 3), (0, 2, 5), (0, 1, 3)):
        if f == 0:
            yield coning.algorithms.compressed(n, p)
        taylor = exact.taylor_pairs(n, p, f)
        yield coning.Algorithm(
            name=f"pairs-{n}-{p}-{f}", solver="pairs", samples=n, previous=p, following=f, order=3, products=taylor
        )
        yield coning.algorithms.matched(n, p, f)
    yield ALGORITHMS["magnus-6"]


def test_no_kernel_reads_or_writes_outside_its_arrays(monkeypatch):
    """Whatever the table and however short the record; compiled code would take what lies there for numbers."""

    def checked(kernel):
        return lambda *arguments: kernel(*(a.view(Strict) if isinstance(a, np.ndarray) else a for a in arguments))

    monkeypatch.setattr(coning.stepping, "compiled", checked)
    tables = list(windows())
    assert len(tables) > 40
    generator = np.random.default_rng(5)
    for table in tables:
        for length in {0, 1, table.samples - 1, table.samples, table.window - 1, table.window + table.samples + 1}:
            increments = 0.05 * generator.standard_normal((length, 3))
            rotations = coning.rotation_vectors(increments, table)
            assert rotations.shape == (length // table.samples, 3)
            assert np.all(np.isfinite(rotations))
            # Products are of second order in turns of a tenth of a radian.
            sums = increments[: len(rotations) * table.samples].reshape(-1, table.samples, 3).sum(axis=1)
            assert np.all(np.abs(rotations - sums) < 0.5)
