"""Checks at the rim: what passes unchanged, and errors that name the value, the place and the remedy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from strapdown import checks
from strapdown.checks import InputError


def refused(call, *words: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_input_errors_are_value_errors():
    assert issubclass(InputError, ValueError)


def test_array_passes_what_fits():
    value = np.arange(6.0).reshape(2, 3)
    assert checks.array("x", value, ("n", 3)) is value
    assert checks.array("x", [[1, 2, 3]], (..., 3)).dtype == np.float64
    assert checks.array("x", [1, 2, 3], (..., 3)).shape == (3,)
    assert checks.array("x", np.zeros((4, 2, 3, 3)), (..., 3, 3)).shape == (4, 2, 3, 3)
    assert checks.array("x", np.float32(2.0), ()).shape == ()
    assert checks.array("x", np.empty((0, 3)), ("n", 3)).shape == (0, 3)


@pytest.mark.parametrize(
    ("value", "shape", "words"),
    [
        ([1.0, 2.0], (3,), ("x has shape (2,)", "wanted (3,)", "reshape")),
        (1.0, ("n",), ("x has shape ()", "wanted (n,)")),
        (np.zeros((2, 3)), ("n",), ("x has shape (2, 3)",)),
        (np.zeros((2, 4)), (..., 3), ("wanted (..., 3)",)),
        (np.zeros(3), (..., 3, 3), ("wanted (..., 3, 3)",)),
        (np.zeros((5, 3)), (4, 3), ("x has shape (5, 3)", "wanted (4, 3)")),
        ([1.0, np.nan, 3.0], (3,), ("x[1] is nan", "remove or interpolate")),
        ([[1.0, 2.0], [3.0, -np.inf]], ("n", 2), ("x[1, 1] is -inf",)),
        (np.nan, (), ("x is nan",)),
        (["one", "two"], ("n",), ("x is not an array of numbers",)),
        ([[1.0, 2.0], [3.0]], ("n", 2), ("x is not an array of numbers",)),
        ({"a": 1}, ("n",), ("x is not an array of numbers",)),
        (True, (), ("x is not an array of numbers", "True or False", "pass floats")),
        ([True, 1.0, 0.0], (3,), ("x is not an array of numbers", "True or False")),
        ([[1.0, 2.0], (3.0, np.bool_(False))], (2, 2), ("True or False",)),
        (np.array([True, False]), (2,), ("True or False",)),
        ([np.array([True])], (1, 1), ("True or False",)),
        (["1.0", "2.0"], (2,), ("x is not an array of numbers", "text")),
        (np.array([b"1.0"]), (1,), ("text",)),
        ([1.0 + 2.0j, 3.0], (2,), ("x is not an array of numbers", "complex")),
        (Rotation.identity(), (4,), ("x is a SciPy Rotation; give rotation.as_quat(scalar_first=True)",)),
        (np.array(["2026-01-01"], dtype="datetime64[s]"), (1,), ("dates",)),
    ],
)
def test_array_names_what_does_not_fit(value, shape, words):
    refused(lambda: checks.array("x", value, shape), *words)


MASKED = np.ma.masked_array([[1, 2], [3, 4], [5, 6]], mask=[[False, False], [False, True], [True, False]])


@pytest.mark.parametrize("value", [MASKED, MASKED.astype(float), list(MASKED)])
def test_what_lies_under_a_mask_is_no_data(value):
    refused(lambda: checks.array("x", value, ("n", 2)), "x[1, 1] is masked", "remove or interpolate")
    refused(lambda: checks.numbers("x", value), "x[1, 1] is masked")
    if value is MASKED:
        array = checks.array("x", value, ("n", 2), allow_nan=True)
        np.testing.assert_array_equal(array, [[1.0, 2.0], [3.0, np.nan], [np.nan, 6.0]])
        assert type(array) is np.ndarray


def test_a_mask_that_masks_nothing_is_no_matter():
    array = checks.array("x", np.ma.masked_array([1.0, 2.0], mask=False), (2,))
    assert type(array) is np.ndarray
    np.testing.assert_array_equal(array, [1.0, 2.0])


def test_nan_may_mark_missing_samples_but_infinity_never_passes():
    np.testing.assert_array_equal(checks.array("x", [np.nan, 1.0], (2,), allow_nan=True), [np.nan, 1.0])
    refused(lambda: checks.array("x", [np.nan, np.inf], (2,), allow_nan=True), "x[1] is inf")


def test_numbers_pass():
    assert checks.positive("x", np.float32(0.5)) == 0.5
    assert checks.non_negative("x", 0) == 0.0
    assert checks.finite("x", -3) == -3.0
    assert isinstance(checks.positive("x", 2), float)


NO_NUMBERS = (
    *(np.nan, np.inf, -np.inf, 1.0 + 0.0j, np.complex128(1.0)),
    *(None, "fast", "60", b"60", np.datetime64("2026-01-01"), {}),
    *(True, np.bool_(True), np.array(True)),
    *([1.0, 2.0], [True], np.array([True]), np.array([1.0])),
)


@pytest.mark.parametrize("check", [checks.positive, checks.non_negative, checks.finite])
@pytest.mark.parametrize("value", NO_NUMBERS)
def test_what_is_no_finite_number_is_refused(check, value):
    refused(lambda: check("rate", value, unit="Hz"), "rate is", "number in Hz")


@pytest.mark.parametrize(
    ("check", "value", "words"),
    [
        (checks.positive, 0.0, ("rate is 0 Hz", "greater than zero")),
        (checks.positive, -1e-3, ("rate is -0.001 Hz", "greater than zero")),
        (checks.non_negative, -2.0, ("rate is -2 Hz", "must not be negative")),
    ],
)
def test_signs(check, value, words):
    refused(lambda: check("rate", value, unit="Hz"), *words)


def test_counts():
    assert checks.count("runs", 3) == 3
    assert checks.count("runs", np.int64(3)) == 3
    assert checks.count("runs", 3.0) == 3
    assert isinstance(checks.count("runs", 3.0), int)
    assert checks.count("seed", 0, minimum=0) == 0


@pytest.mark.parametrize("value", [0, -1, 2.5, True, np.bool_(True), np.array(True), "4", "many", None, np.nan, np.inf])
def test_what_is_no_count_is_refused(value):
    refused(lambda: checks.count("runs", value), "runs is", "whole number of 1 or more")


def test_unit_quaternions_keep_double_rounding_to_the_bit():
    q = np.array([0.5, 0.5, 0.5, 0.5 + 4e-16])
    np.testing.assert_array_equal(checks.unit_quaternions("q", q), q)


def test_unit_quaternions_normalise_single_precision():
    q = np.random.default_rng(1).standard_normal((50, 4))
    q = (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)
    assert np.abs(np.linalg.norm(checks.unit_quaternions("q", q), axis=1) - 1.0).max() < 1e-15


@pytest.mark.parametrize("scale", [1.0 + 2e-6, 1.0 - 2e-6, 2.0, 0.0])
def test_other_norms_are_refused_with_their_place(scale):
    q = np.tile([1.0, 0.0, 0.0, 0.0], (2, 3, 1))
    q[1, 2] *= scale
    refused(lambda: checks.unit_quaternions("q", q), "q[1, 2] has norm", "not 1", "normalise", "scalar first")


def test_increasing():
    np.testing.assert_array_equal(checks.increasing("time", [0, 1, 1.5]), [0.0, 1.0, 1.5])
    assert len(checks.increasing("time", [3.0])) == 1


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        ([0.0, 0.1, 0.1, 0.2], ("time[2] repeats 0.1 s", "drop repeated")),
        ([0.0, 0.2, 0.1], ("time[2] goes back to 0.1 s after 0.2 s", "sort")),
        ([0.0, np.nan, 1.0], ("time[1] is nan",)),
        ([[0.0, 1.0]], ("time has shape (1, 2)",)),
    ],
)
def test_stamps_out_of_order_are_refused(stamps, words):
    refused(lambda: checks.increasing("time", stamps), *words)


def test_too_few_stamps_are_refused():
    refused(lambda: checks.increasing("time", [0.0], minimum=2), "time has 1 stamps", "at least 2")


def test_covariance_passes_with_units_of_very_different_size():
    P = np.diag([1e-4, 1e-4, 1e-4, 1e-22, 1e-22, 1e-22])
    assert checks.covariance("P", P, 6) is P
    # correlated, too: the least eigenvalue of this one is below the rounding of its largest
    random = np.random.default_rng(2)
    sigma = np.array([1e-11, 1e-11, 1e-11, 1e-2, 1e-2, 1e-2])
    for _ in range(20):
        white = random.standard_normal((12, 6)) * sigma
        checks.covariance("P", np.tril(white.T @ white) + np.tril(white.T @ white, -1).T, 6)


def test_covariance_asymmetric_by_rounding_passes():
    """A computed A P Aᵀ is symmetric to rounding of its diagonal, not of each small entry."""
    random = np.random.default_rng(1)
    for _ in range(20):
        axes = np.linalg.qr(random.standard_normal((6, 6)))[0]
        checks.covariance("P", axes @ np.diag(1.0 + 1e-7 * random.random(6)) @ axes.T, 6)


@pytest.mark.parametrize(
    ("P", "words"),
    [
        (np.array([[1.0, 0.1], [0.2, 1.0]]), ("P is not symmetric", "[0, 1] is 0.1", "[1, 0] is 0.2", "½(P + Pᵀ)")),
        (np.diag([1.0, 0.0]), ("P is not positive definite", "variance above zero")),
        (np.diag([1.0, -1.0]), ("P is not positive definite",)),
        (np.array([[1.0, 1.1], [1.1, 1.0]]), ("P is not positive definite", "-0.1")),
        (np.array([[1e-4, 1.1e-13], [1.1e-13, 1e-22]]), ("P is not positive definite",)),
        (np.eye(3), ("P has shape (3, 3)", "wanted (2, 2)")),
        (np.array([[np.nan, 0.0], [0.0, 1.0]]), ("P[0, 0] is nan",)),
    ],
)
def test_bad_covariances_are_refused(P, words):
    refused(lambda: checks.covariance("P", P, 2), *words)


def test_one_of():
    assert checks.one_of("unit", "rad/s", ["rad/s", "deg/s"]) == "rad/s"
    refused(
        lambda: checks.one_of("unit", "deg/sec", ["rad/s", "deg/s"]),
        "unit 'deg/sec' is not known",
        "did you mean 'deg/s'?",
    )
    refused(lambda: checks.one_of("unit", "parsec", ["rad/s", "deg/s"]), "(known: rad/s, deg/s)")


def test_known_keys():
    checks.known_keys("gyro", ["bias", "noise"], ["noise", "bias", "scale"])
    refused(lambda: checks.known_keys("gyro", ["biass"], ["noise", "bias"]), "gyro: key 'biass'", "'bias'")


def test_the_nearest_name_is_one_of_the_same_unit():
    known = ["turn_on_bias_sigma_rad_per_s", "turn_on_bias_sigma_deg_per_hour"]
    with pytest.raises(InputError, match="did you mean 'turn_on_bias_sigma_deg_per_hour'"):
        checks.one_of("key", "turn_on_bias_sigma_deg_per_s", known)
    with pytest.raises(InputError, match="did you mean 'turn_on_bias_sigma_rad_per_s'"):
        checks.one_of("key", "turn_on_bias_sigma_rad_per_sec", known)
