"""Errors against a reference, as the BROAD benchmark defines them, against formulas of their own on SciPy rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from strapdown.checks import InputError
from strapdown.consistency import ReferenceErrors, reference_errors
from strapdown.consistency.accuracy import accuracy
from strapdown.records import Estimate, Truth

UP = np.array([0.0, 0.0, 1.0])


def scalar_first(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)


def random_pairs(n: int = 200, seed: int = 1) -> tuple[Rotation, Rotation]:
    random = np.random.RandomState(seed)  # SciPy's own generator of rotations takes this kind
    return Rotation.random(n, random), Rotation.random(n, random)


def test_against_scipy():
    """Total: SciPy's magnitude. Inclination: the angle between both verticals. Heading: the twist about the vertical, by projection."""
    estimate, reference = random_pairs()
    errors = reference_errors(scalar_first(estimate), scalar_first(reference))
    difference = estimate * reference.inv()
    np.testing.assert_allclose(errors.total, difference.magnitude(), atol=1e-7)
    tilted = difference.apply(UP)
    np.testing.assert_allclose(errors.inclination, np.arccos(np.clip(tilted[:, 2], -1.0, 1.0)), atol=1e-7)
    # the shortest rotation takes the vertical to where the difference has it; what is left is the twist about the vertical
    axis = np.cross(UP, tilted)
    swing = Rotation.from_rotvec(axis / np.linalg.norm(axis, axis=1)[:, None] * errors.inclination[:, None])
    twist = swing.inv() * difference
    np.testing.assert_allclose(twist.apply(UP), np.tile(UP, (200, 1)), atol=1e-9)
    np.testing.assert_allclose(errors.heading, twist.magnitude(), atol=1e-7)


@pytest.mark.parametrize("angle", [1e-12, 1e-8, 1e-3, 0.5, 3.0])
def test_pure_errors_of_any_size(angle):
    """A turn about the vertical is heading alone, one about a level axis inclination alone, to the last digits even when tiny."""
    _, reference = random_pairs(20)
    level = np.array([0.6, -0.8, 0.0])
    for axis, heading, inclination in ((UP, angle, 0.0), (-UP, angle, 0.0), (level, 0.0, angle)):
        estimate = Rotation.from_rotvec(angle * axis) * reference
        errors = reference_errors(scalar_first(estimate), scalar_first(reference))
        np.testing.assert_allclose(errors.total, angle, rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(errors.heading, heading, rtol=1e-14, atol=4e-15)
        np.testing.assert_allclose(errors.inclination, inclination, rtol=1e-14, atol=4e-15)


def test_errors_are_of_the_fixed_frame():
    """An error about the body's z axis of a body that lies on its side is one of inclination."""
    lying = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0])
    errors = reference_errors(
        scalar_first(lying * Rotation.from_rotvec([0.0, 0.0, 0.1]))[None], scalar_first(lying)[None]
    )
    np.testing.assert_allclose([errors.heading[0], errors.inclination[0]], [0.0, 0.1], atol=1e-15)


def test_missing_references_give_nan_and_are_not_judged():
    estimate, reference = (scalar_first(r) for r in random_pairs(6))
    reference[[1, 4]] = np.nan
    reference[2, 3] = np.nan
    errors = reference_errors(estimate, reference)
    np.testing.assert_array_equal(np.isnan(errors.total), [False, True, True, False, True, False])
    np.testing.assert_array_equal(np.isnan(errors.heading), np.isnan(errors.inclination))
    assert np.isfinite(list(errors.rms().values())).all()


def test_single_precision_references_are_taken():
    estimate, reference = (scalar_first(r) for r in random_pairs(10))
    rough = reference_errors(estimate, reference.astype(np.float32))
    np.testing.assert_allclose(rough.total, reference_errors(estimate, reference).total, atol=1e-6)


def test_rms_over_the_movement():
    errors = ReferenceErrors(
        total=np.array([5.0, 3.0, 4.0, np.nan]),
        heading=np.array([0.0, 1.0, 7.0, np.nan]),
        inclination=np.array([1.0, 2.0, 2.0, np.nan]),
    )
    moving = np.array([False, True, True, True])
    np.testing.assert_allclose(list(errors.rms(moving).values()), [np.sqrt(12.5), 5.0, 2.0], rtol=1e-15)
    assert list(errors.rms(moving)) == ["total", "heading", "inclination"]
    assert errors.rms()["total"] == pytest.approx(np.sqrt(50.0 / 3.0), rel=1e-15)


def test_nothing_to_judge_is_said():
    errors = ReferenceErrors(total=np.array([np.nan, 1.0]), heading=np.zeros(2), inclination=np.zeros(2))
    with pytest.raises(InputError, match=r"no sample to judge .* movement mask"):
        errors.rms(np.array([True, False]))


def test_the_accuracy_over_the_movement_is_that_of_its_rows():
    """Headings in error by 1°, 2°, 3° and one without a reference, of which the last three move."""
    turned = scalar_first(Rotation.from_rotvec(np.radians(np.outer([1.0, 2.0, 3.0, 9.0], UP))))
    reference = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    reference[3] = np.nan
    estimate = Estimate.from_arrays(np.arange(4.0), turned, np.full((4, 3, 3), np.nan))
    errors = accuracy(estimate, Truth(attitude=reference, movement=np.array([False, True, True, True]))).given
    for span, rms in (("all samples", np.sqrt(14.0 / 3.0)), ("movement", np.sqrt(6.5))):
        sizes = np.degrees([size.rms for size in errors[span].values()])
        np.testing.assert_allclose(sizes, [rms, rms, 0.0], atol=1e-9)
    assert list(errors["movement"]) == ["total", "heading", "inclination"]


def test_bad_input_is_named():
    good = np.array([[1.0, 0.0, 0.0, 0.0]])
    with pytest.raises(InputError, match=r"attitude\[0, 1\] is nan"):
        reference_errors([[1.0, np.nan, 0.0, 0.0]], good)
    with pytest.raises(InputError, match=r"reference has shape \(2, 4\), wanted \(1, 4\)"):
        reference_errors(good, np.tile(good, (2, 1)))


def test_a_zero_reference_is_named_by_its_own_row():
    reference = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    reference[0] = np.nan
    reference[2] = 0.0
    with pytest.raises(InputError, match=r"reference\[2\]"):
        reference_errors(np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)), reference)
