"""The Earth's field at a place: published values of the model, true North, and samples that differ from the field."""

import dataclasses
import datetime
import json

import numpy as np
import pytest

import strapdown as sd
from strapdown import quaternion
from strapdown.ahrs import MagneticField
from strapdown.recordings import Recording
from strapdown.units import DEGREE

pytest.importorskip("pygeomag", reason="the field at a place needs pygeomag")

# World Magnetic Model 2020, table of test values of NOAA: latitude, longitude, declination, dip, strength in nT.
PUBLISHED = [
    (80.0, 0.0, -1.28, 83.14, 55000.1),
    (0.0, 120.0, 0.16, -15.42, 41104.9),
]


@pytest.mark.parametrize(("latitude", "longitude", "declination", "dip", "strength"), PUBLISHED)
def test_published_values_of_the_model(latitude, longitude, declination, dip, strength):
    field = MagneticField.at(latitude, longitude, date=datetime.date(2020, 1, 1))
    assert field.declination / DEGREE == pytest.approx(declination, abs=0.0051)
    assert field.dip / DEGREE == pytest.approx(dip, abs=0.0051)
    assert field.strength == pytest.approx(1e-9 * strength, abs=6e-11)


def test_strength_decreases_with_the_cube_of_the_distance():
    at = [MagneticField.at(80.0, 0.0, height, date="2020-01-01").strength for height in (0.0, 1e5)]
    assert at[1] / at[0] == pytest.approx((6371.2 / 6471.2) ** 3, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((91.0, 0.0, "2020-01-01"), "latitude is 91; give degrees from -90 to 90"),
        ((0.0, np.nan, "2020-01-01"), "longitude is nan"),
        ((0.0, 0.0, "01.06.2020"), "date is '01.06.2020'; give a day such as"),
        ((0.0, 0.0, "1999-01-01"), "no World Magnetic Model of 1995"),
    ],
)
def test_bad_places_and_dates_are_refused(arguments, words):
    *place, date = arguments
    with pytest.raises(sd.InputError, match=words):
        MagneticField.at(*place, date=date)


FIELD = MagneticField(declination=10.0 * DEGREE, dip=60.0 * DEGREE, strength=5e-5)
MAGNETIC_F = 50.0 * np.array([0.0, np.cos(FIELD.dip), -np.sin(FIELD.dip)])
"""The field, uT, East-North-Up with magnetic North."""


@pytest.fixture(scope="module")
def turning():
    """A recording of 10 s of a level unit that turns about the vertical, and its estimate."""
    time = np.arange(0.0, 10.0, 0.01)
    noise = 1e-4 * np.random.default_rng(1).standard_normal((len(time), 3))
    heading = 0.2 * np.maximum(time - 2.0, 0.0)
    attitude = quaternion.exp(np.stack([0.0 * time, 0.0 * time, heading], axis=1))
    recording = Recording(
        source="turning",
        time=time,
        rate=np.stack([0.0 * time, 0.0 * time, np.where(time > 2.0, 0.2, 0.0)], axis=1) + noise,
        specific_force=np.tile([0.0, 0.0, 9.80665], (len(time), 1)),
        magnetic_field=quaternion.rotate(quaternion.conjugate(attitude), MAGNETIC_F),
        magnetic_unit="uT",
    )
    return recording, sd.estimate(recording)


def test_an_estimate_is_turned_to_true_north(turning):
    _, estimate = turning
    true = FIELD.to_true_north(estimate)
    # The declination is the azimuth of magnetic North, clockwise from true North: East of it if positive.
    north_m = quaternion.rotate(quaternion.conjugate(estimate.attitude), np.array([0.0, 1.0, 0.0]))
    expected = np.array([np.sin(FIELD.declination), np.cos(FIELD.declination), 0.0])
    np.testing.assert_allclose(
        quaternion.rotate(true.attitude, north_m), np.tile(expected, (len(true.time), 1)), atol=1e-12
    )
    assert true.fixed_frame == "East-North-Up, true North"
    assert "Fixed frame: East-North-Up, true North." in true.remarks
    with pytest.raises(sd.InputError, match="true North', without magnetic North"):
        FIELD.to_true_north(true)


def test_samples_unlike_the_field_are_suspect(turning):
    recording, estimate = turning
    samples = recording.magnetic_field.copy()
    samples[100:200] *= 1.25  # strength
    samples[300:350, 2] = -MAGNETIC_F[1] * np.tan(75.0 * DEGREE)  # dip
    samples[300:350] *= 50.0 / np.linalg.norm(samples[300:350], axis=1)[:, None]
    samples[400:450] *= 1.1  # both within the limits
    samples[500:510] = np.nan
    changed = dataclasses.replace(recording, magnetic_field=samples)
    compared = FIELD.compared(changed, estimate)
    expected = np.zeros(len(recording.time), bool)
    expected[100:200] = expected[300:350] = True
    np.testing.assert_array_equal(compared.suspect, expected)
    assert compared.share == pytest.approx(150 / (len(expected) - 10))
    spans = compared.summary()["suspect_spans"]
    np.testing.assert_allclose(spans, [[1.0, 1.99], [3.0, 3.49]], atol=1e-9)
    # Without a unit the median is taken for the model's strength.
    unknown = dataclasses.replace(changed, magnetic_field=0.37 * samples, magnetic_unit="")
    np.testing.assert_array_equal(FIELD.compared(unknown, estimate).suspect, expected)


def test_the_command_reports_the_field_at_the_place(turning, succeeds, refusal, tmp_path):
    recording, _ = turning
    path = sd.write(recording, tmp_path / "turning.csv")
    out = tmp_path / "out"
    text = " ".join(succeeds("estimate", path, "--out", out, "--place", "45.2,5.7,200", "--date", "2021-06-01").split())
    field = MagneticField.at(45.2, 5.7, 200.0, date="2021-06-01")
    assert f"True North: declination {field.declination / DEGREE:.1f}°" in text
    assert "Fixed frame: East-North-Up, true North." in text
    stored = json.loads((out / "field.json").read_text())
    assert stored["field"] == dataclasses.asdict(field)
    plain = sd.estimate(sd.read(path))
    np.testing.assert_allclose(sd.read(out / "estimate.h5").attitude, field.to_true_north(plain).attitude, atol=1e-12)
    for options, words in [
        (("--place", "45.2,5.7"), "--place and --date go together"),
        (("--place", "here", "--date", "2021-06-01"), "--place is 'here'; give LATITUDE,LONGITUDE"),
    ]:
        assert words in refusal("estimate", path, "--out", tmp_path / "none", *options)
    without = sd.write(dataclasses.replace(recording, magnetic_field=None), tmp_path / "without.csv")
    assert "has no magnetometer" in refusal("estimate", without, "--place", "45,5", "--date", "2021-06-01")
