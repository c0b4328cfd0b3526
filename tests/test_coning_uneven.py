"""Integration over sample intervals of unequal length: closed form, exactness, orders, gaps, noise."""

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from strapdown import coning, motion, quaternion
from strapdown.checks import InputError
from strapdown.coning import ALGORITHMS
from strapdown.records import ImuRecord, compress

CONE = motion.Coning(angle=math.radians(1.0), frequency=10.0)
RATE = 200.0
EVEN = np.arange(2401) / RATE
GENERATOR = np.random.default_rng(1)
STAMPS = {
    "one triple interval": EVEN + np.where(np.arange(2401) > 1200, 2.0 / RATE, 0.0),
    "jitter of half an interval": EVEN + 0.25 / RATE * (2.0 * GENERATOR.random(2401) - 1.0),
    "half and one and a quarter": np.concatenate([[0.0], np.cumsum(np.tile([0.5, 1.25, 1.25], 800))]) / RATE,
}


def error(name, edges, body=CONE, *, with_edges=True):
    """Return the greatest angle between the truth and the attitude integrated from exact increments, rad."""
    n = ALGORITHMS[name].samples
    edges = edges[: (len(edges) - 1) // n * n + 1]
    attitude = coning.integrate(
        body.increments(edges), name, body.attitude(edges[0]), edges=edges if with_edges else None
    )
    true = body.attitude(edges[::n])
    return np.linalg.norm(quaternion.log(quaternion.multiply(quaternion.conjugate(attitude), true)), axis=-1).max()


# Error over that with even stamps, and least gain over taking uneven ones for even.
@pytest.mark.parametrize(
    ("name", "times", "gain"),
    [
        ("two-sample", 1.5, 1.25),
        ("four-sample", 20.0, 100.0),
        ("polynomial-4", 1.5, 4.0),
        ("time-taylor-4", 1.5, 4.0),
        ("one-sample-previous-3", 500.0, 30.0),
        ("matched-1-8-8", math.inf, 1e4),
        ("matched-4-11", math.inf, 700.0),
    ],
)
@pytest.mark.parametrize("stamps", STAMPS)
def test_uneven_intervals_are_corrected_for(stamps, name, times, gain):
    edges = STAMPS[stamps]
    corrected = error(name, edges)
    assert corrected < times * error(name, EVEN)
    assert gain * corrected < error(name, edges, with_edges=False)


def test_two_samples_have_the_known_closed_form():
    """For a linear rate ½ ∫ α × w dt = T²/(6 h₁ h₂) Δθ₁ × Δθ₂: ⅔ of the product when both are equal."""
    first, second = np.array([1.1e-3, -0.4e-3, 0.7e-3]), np.array([-0.2e-3, 0.9e-3, 1.3e-3])
    for h1, h2 in ((0.3, 0.7), (0.25, 0.1), (1.0, 1.01)):
        expected = first + second + (h1 + h2) ** 2 / (6.0 * h1 * h2) * np.cross(first, second)
        rotations = coning.rotation_vectors([first, second], "two-sample", edges=[5.0, 5.0 + h1, 5.0 + h1 + h2])
        np.testing.assert_allclose(rotations[0], expected, atol=2e-9)  # the third product of such angles
        assert np.abs(np.cross(first, second)).max() > 1e-6


@pytest.mark.parametrize(
    ("name", "degree"), [("two-sample", 1), ("three-sample", 2), ("magnus-6", 3), ("eight-sample", 4)]
)
def test_polynomial_rates_are_integrated_to_rounding(name, degree):
    """Of eight increments the outer ones see five."""
    powers = np.random.default_rng(4).standard_normal((degree + 1, 3))
    edges = np.concatenate([[0.0], np.cumsum(np.tile([0.09, 0.05, 0.13, 0.07], 4))])[: 2 * ALGORITHMS[name].samples + 1]

    def angle(t):
        return sum(c * t ** (m + 1) / (m + 1) for m, c in enumerate(powers))

    def derivative(t, q):
        w = sum(c * t**m for m, c in enumerate(powers))
        return 0.5 * quaternion.multiply(q, np.concatenate([[0.0], w]))

    increments = np.array([angle(b) - angle(a) for a, b in itertools.pairwise(edges)])
    true = solve_ivp(derivative, (0.0, edges[-1]), [1.0, 0.0, 0.0, 0.0], "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    attitude = coning.integrate(increments, name, edges=edges)[-1]
    assert quaternion.angle_between(attitude, true / np.linalg.norm(true)) < 1e-12
    assert quaternion.angle_between(coning.integrate(increments, name)[-1], true / np.linalg.norm(true)) > 1e-6


@pytest.mark.parametrize(("name", "order"), [("two-sample", 4), ("three-sample", 4), ("four-sample", 6)])
def test_order_of_convergence(name, order):
    """That of the polynomial through the increments of a step."""
    body = motion.Coning(angle=0.02, frequency=1.0)
    errors = []
    for n in (96, 192):
        pattern = np.tile([0.8, 1.3, 0.7, 1.2], n // 4) / n * 4.0
        errors.append(error(name, np.concatenate([[0.0], np.cumsum(pattern)]), body))
    slope = math.log2(errors[0] / errors[1])
    assert order - 1.2 < slope < order + 1.2


def test_even_intervals_are_what_they_were():
    increments = CONE.increments(EVEN)
    microseconds = np.round(np.arange(2401) / 997.0, 6) + 1.7e3
    for name in ("one-sample", "two-sample", "four-sample", "matched-4-11", "magnus-6"):
        for edges in (EVEN, microseconds):
            corrected = coning.rotation_vectors(increments, name, edges=edges)
            np.testing.assert_array_equal(corrected, coning.rotation_vectors(increments, name))
            np.testing.assert_array_equal(
                coning.integrate(increments, name, edges=edges), coning.integrate(increments, name)
            )


@pytest.mark.parametrize("name", ["four-sample", "time-taylor-3", "matched-1-8-8"])
def test_a_gap_is_a_turn_at_constant_rate_and_no_step_beyond_its_window_hears_of_it(name):
    table = ALGORITHMS[name]
    edges = EVEN[:241] + np.where(np.arange(241) > 121, 40.0 / RATE, 0.0)
    increments = CONE.increments(EVEN[:241])
    increments[121] = [0.3, -0.2, 0.5]
    rotations, even = (coning.rotation_vectors(increments, name, edges=e) for e in (edges, EVEN[:241]))
    row = 121 // table.samples
    reach = -(-max(table.previous, table.following) // table.samples)
    far = np.abs(np.arange(len(rotations)) - row) > reach
    np.testing.assert_array_equal(rotations[far], even[far])
    # The gap's own part of the step is exp(Δθ) between the others.
    inside = increments[row * table.samples : (row + 1) * table.samples]
    place = 121 - row * table.samples
    parts = [
        coning.rotation_vectors(part, f"polynomial-{len(part)}" if len(part) > 1 else "one-sample")
        for part in (inside[:place], inside[place : place + 1], inside[place + 1 :])
        if len(part)
    ]
    turn = quaternion.IDENTITY
    for part in parts:
        turn = quaternion.multiply(turn, quaternion.exp(part[0]))
    if table.samples > 1:  # else the neighbours are outside the step
        np.testing.assert_allclose(quaternion.exp(rotations[row]), turn, atol=1e-12)


@pytest.mark.parametrize("name", ["four-sample", "eight-sample", "matched-2-8", "matched-4-11", "matched-1-8-8"])
@pytest.mark.parametrize("shortest", [0.5, 0.3])
def test_noise_is_not_blown_up(name, shortest):
    """Beside a steady turn, noise makes products of the order of turn times noise, as with even stamps, and not hundreds of that."""
    random = np.random.default_rng(3)
    length = shortest + (1.4 - shortest) * random.random(2400)
    turn = np.outer(length, [0.0, 0.0, 0.02])
    noise = 1e-6 * random.standard_normal((2400, 3))
    rotations = coning.rotation_vectors(turn + noise, name, edges=np.concatenate([[0.0], np.cumsum(length)]))
    n = ALGORITHMS[name].samples
    left = rotations - (turn + noise).reshape(-1, n, 3).sum(axis=1)
    assert np.sqrt(np.mean(left**2)) < 6.0 * 0.02 * 1e-6
    assert np.abs(left).max() < 40.0 * 0.02 * 1e-6


def test_data_too_rough_for_a_polynomial_are_taken_one_by_one():
    edges = STAMPS["half and one and a quarter"][:5]
    increments = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [0.0, 0.0, 3.1], [0.0, 0.0, -3.0]])
    np.testing.assert_allclose(
        coning.rotation_vectors(increments, "four-sample", edges=edges), [[0.0, 0.0, 0.1]], atol=1e-14
    )


def test_a_record_shorter_than_the_window_is_fitted_whole():
    edges = STAMPS["half and one and a quarter"][:9]
    assert error("matched-4-11", edges) < 1e-3 * error("one-sample", edges)


def test_edges_that_do_not_fit_are_refused():
    for integrated in (coning.integrate, coning.rotation_vectors):
        with pytest.raises(InputError, match="edges holds 4 times and increments 4 rows; give the 5 edges"):
            integrated(np.zeros((4, 3)), "two-sample", edges=np.arange(4.0))
        with pytest.raises(InputError, match="edges"):
            integrated(np.zeros((4, 3)), "two-sample", edges=[0.0, 1.0, 1.0, 2.0, 3.0])


def test_compress_goes_by_the_stamps():
    edges = STAMPS["jitter of half an interval"]
    record = ImuRecord(time=edges, increments=CONE.increments(edges))
    short = compress(record, "four-sample")
    attitude = coning.integrate(short.increments, "one-sample", CONE.attitude(edges[0]))
    apart = quaternion.angle_between(attitude, CONE.attitude(short.time))
    assert apart.max() == pytest.approx(error("four-sample", edges), rel=1e-3)
    assert apart.max() < 5e-6
