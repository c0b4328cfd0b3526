"""Coning algorithms of one's own: coefficients as textbooks write them, their orders derived, studied beside the package's."""

import dataclasses
import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from strapdown import coning, motion, quaternion
from strapdown.checks import InputError
from strapdown.coning import ALGORITHMS, Algorithm
from strapdown.coning import coefficients as exact
from strapdown.estimation import setup
from strapdown.montecarlo import coning_study
from strapdown.units import DEGREE

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"
IGNAGNI = coning.read_algorithms(EXAMPLES / "ignagni-1996.toml")
MILLER = coning.named(str(EXAMPLES / "miller-1983.toml"))


def of_coefficients(coefficients, **fields):
    return Algorithm.from_table({"name": "own", "coefficients": coefficients, **fields})


@pytest.mark.parametrize("own", IGNAGNI, ids=lambda algorithm: algorithm.name)
def test_ignagnis_table_is_the_closed_form_and_drifts_as_he_says(own):
    m = own.samples
    built_in = next(a for a in ALGORITHMS.values() if (a.solver, a.samples, a.window) == ("compressed", m, m))
    assert own.coefficients == built_in.coefficients
    assert (own.order, own.drift_order) == (built_in.order, 2 * m)
    assert own.drift_constant == Fraction(math.factorial(m) ** 2, 2 * math.factorial(2 * m + 1))


def test_millers_three_samples_are_the_best_in_drift_and_keep_their_own_products():
    assert (MILLER.samples, MILLER.order, MILLER.drift_order) == (3, 4, 6)
    assert MILLER.drift_constant == Fraction(1, 280)
    increments = motion.SpinRock(rock_angle=0.1, rock_frequency=1.0, spin_rate=1.0).increments(np.arange(4) * 0.01)
    a, b, c = increments
    by_hand = a + b + c + 9 / 20 * np.cross(a, c) + 27 / 40 * np.cross(b, c - a)
    np.testing.assert_allclose(coning.rotation_vectors(increments, MILLER)[0], by_hand, rtol=0, atol=2e-17)


def test_textbook_order_is_that_of_the_increments():
    """φ = Σ Δθ + (c_1 Δθ_1 + c_2 Δθ_2) × Δθ_3, each coefficient alone, with and without increments of the step before."""
    rng = np.random.default_rng(1)
    a, b, c = increments = 1e-2 * rng.standard_normal((3, 3))
    own = of_coefficients([0.3, 0.7])
    by_hand = a + b + c + np.cross(0.3 * a + 0.7 * b, c)
    np.testing.assert_allclose(coning.rotation_vectors(increments, own)[0], by_hand, rtol=0, atol=2e-17)
    late = of_coefficients([0.3, 0.7], previous=1)
    assert (late.samples, late.previous) == (2, 1)
    d, e = 1e-2 * rng.standard_normal((2, 3))
    vectors = coning.rotation_vectors(np.array([a, b, c, d]), late)
    np.testing.assert_allclose(vectors[1], c + d + np.cross(0.3 * b + 0.7 * c, d), rtol=0, atol=2e-17)
    pairs = Algorithm.from_table(
        {"name": "pairs", "samples": 1, "products": [(2, 1, 0.5), (1, 3, 0.25)], "previous": 1, "following": 1}
    )
    vectors = coning.rotation_vectors(np.array([a, b, c, d, e]), pairs)
    np.testing.assert_allclose(vectors[2], c + 0.5 * np.cross(c, b) + 0.25 * np.cross(b, d), rtol=0, atol=2e-17)


def test_derived_orders_are_those_of_the_catalogue():
    compared = 0
    for algorithm in ALGORITHMS.values():
        if algorithm.solver in ("compressed", "pairs"):
            own = Algorithm.from_table(algorithm.to_table())
            assert own == algorithm, algorithm.name
            compared += 1
    assert compared > 30


OWN = [of_coefficients(c) for c in ([], ["1/2"], ["2/3"], ["9/20", "27/20"], ["1/20", "27/20"])]


@pytest.mark.parametrize(("own", "order"), list(zip([*OWN, MILLER], (2, 2, 4, 3, 2, 4), strict=True)))
def test_the_order_of_convergence_shows_over_a_manoeuvre(own, order):
    """Halving the sample interval divides the error by 2 to the order: three axes at once, the truth by the Taylor series."""
    shakes = [
        motion.Harmonic(amplitude=(2.0, 0.0, 0.0), frequency=0.8),
        motion.Harmonic(amplitude=(0.0, 1.5, 0.0), frequency=1.3, phase=1.0),
        motion.Harmonic(amplitude=(0.0, 0.0, 1.0), frequency=2.1, phase=2.0),
    ]
    path = motion.HarmonicRates(mean=(0.0, 0.0, 0.2), harmonics=tuple(shakes))

    def error(rate):
        edges = np.arange(int(2.0 * rate) // own.samples * own.samples + 1) / rate
        attitude = coning.integrate(path.increments(edges), own, path.attitude(0.0))
        return quaternion.angle_between(path.attitude(edges[:: own.samples]), attitude).max()

    errors = np.array([error(rate) for rate in (240.0, 480.0, 960.0)])
    slopes = np.log2(errors[:-1] / errors[1:])
    assert own.order == order
    assert slopes == pytest.approx(order, abs=0.25)


def test_the_derived_constant_is_what_integration_drifts_by():
    own = of_coefficients(["1/2", "13/10"])
    cone = motion.Coning(angle=0.1 * DEGREE, frequency=0.5)
    predicted = coning.predicted_coning_drift(own, cone.angle, cone.frequency, 0.01)
    assert own.drift_order == 2
    assert coning_study.measured_drift(cone, 100.0, own) == pytest.approx(predicted, rel=1e-3)


@pytest.mark.parametrize(
    ("value", "fraction"),
    [
        ("27/20", Fraction(27, 20)),
        (1.35, Fraction(27, 20)),
        ("1.35", Fraction(27, 20)),
        (2 / 3, Fraction(2, 3)),
        (0.6667, Fraction(6667, 10000)),
        (-1375 / 504, Fraction(-1375, 504)),
        (2, Fraction(2)),
        (math.pi, Fraction("3.141592653589793")),
    ],
)
def test_coefficients_are_read_as_fractions(value, fraction):
    assert exact.rational(value) == fraction


def test_a_setup_with_it_is_read_back(tmp_path):
    from strapdown import montecarlo, scenarios

    scenario = scenarios.load_scenario("two-stars")
    filter_setup = dataclasses.replace(setup.FilterSetup.for_scenario(scenario, states=False), integration=MILLER)
    assert setup.from_toml(setup.to_toml(filter_setup)) == filter_setup
    plan = montecarlo.Plan(scenario=scenario, setup=filter_setup, epochs=1)
    assert montecarlo.from_table(json.loads(json.dumps(plan.to_table()))).digest == plan.digest


def test_every_command_takes_a_file_for_a_name():
    assert coning.named(str(EXAMPLES / "miller-1983.toml")) == MILLER
    line = coning.VibrationLine(frequency=10.0, angle=0.1 * DEGREE)
    names = (str(EXAMPLES / "miller-1983.toml"), "three-sample")
    own, built_in = (coning.vibration_drift((line,), name, 200.0) for name in names)
    assert own == pytest.approx(built_in, rel=1e-12)  # the same lag sums


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "x"', "give either coefficients"),
        ('name = "x"\ncoefficients = ["2/0"]', r"coefficients\[0\] is '2/0'"),
        ('name = "x"\ncoefficients = ["two"]', "fraction in quotes"),
        ('name = "x"\ncoefficients = [true]', "is True"),
        ('name = "x"\ncoefficients = "2/3"', "is no list"),
        ('name = "x"\nsamples = 3\ncoefficients = ["2/3"]', "make samples 2"),
        ('name = "x"\nfollowing = 1\ncoefficients = ["2/3"]', "and following 0"),
        ('name = "x"\nprevious = 2\ncoefficients = ["2/3"]', "make samples 0"),
        ('name = "x"\nsamples = 2\nproducts = [[1, 1, 0.5]]', "two different increments"),
        ('name = "x"\nsamples = 3\nproducts = [[1, 2, 0.5], [1, 2, 0.7]]', r"products\[1\] is of Δθ_1 × Δθ_2 again"),
        ('name = "x"\nsamples = 2\nproducts = [[1, 3, 0.5]]', "increments of 1 … 2"),
        ('name = "x"\nsamples = 2\nproducts = [[1, 2]]', r"give \(i, j, K\)"),
        ('name = "x"\nproducts = [[1, 2, 0.5]]', "samples is None"),
        ('name = "x"\nsample = 2\ncoefficients = []', "sample"),
        ('coefficients = ["2/3"]', "name is missing"),
        ('name = "two-sample"\ncoefficients = ["2/3"]', "built-in"),
    ],
)
def test_bad_files_are_refused_with_their_place(tmp_path, text, message):
    path = tmp_path / "own.toml"
    path.write_text(f"[algorithm]\n{text}\n")
    with pytest.raises(InputError, match=message) as refused:
        coning.named(str(path))
    assert "own.toml" in str(refused.value)


def test_several_algorithms_need_names_of_their_own(tmp_path):
    with pytest.raises(InputError, match="holds 4 algorithms"):
        coning.named(str(EXAMPLES / "ignagni-1996.toml"))
    path = tmp_path / "own.toml"
    path.write_text(2 * '[[algorithm]]\nname = "x"\ncoefficients = ["2/3"]\n')
    with pytest.raises(InputError, match="two algorithms of the name x"):
        coning.read_algorithms(path)
    with pytest.raises(InputError, match="give it another name"):
        coning_study.ConingParameters(own=(MILLER, MILLER))
    path.write_text("x = 1\n")
    with pytest.raises(InputError, match="x"):
        coning.read_algorithms(path)


@pytest.mark.parametrize(("name", "best"), [("two-sample", 60), ("three-sample", 280)])
def test_the_best_drift_constant_is_that_of_the_compressed_algorithm_of_as_many_increments(name, best):
    """(M!)²/(2 (2M + 1)!): 1/12, 1/60, 1/280, …, which the frequency-series algorithms reach."""
    summary = coning_study.own_summary(ALGORITHMS[name])
    assert summary["best_drift_constant"] == pytest.approx(1.0 / best, rel=1e-12)
    assert summary["drift_constant_value"] == pytest.approx(1.0 / best, rel=1e-12)
