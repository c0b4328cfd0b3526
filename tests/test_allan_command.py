"""`strapdown allan`: what it writes, what it says of terms not seen and of records not at rest, and how it refuses."""

import json
import tomllib

import numpy as np
import pytest

from strapdown import allan, gyro, units
from strapdown.gyro import datasheets
from strapdown.randomness import generator

NOISE = units.DEGREE_PER_ROOT_HOUR
AT_100_HZ = ("--rate", 100, "--gyro-unit", "rad/s")


def white(samples=20_000, axes=3, seed=1):
    """Rates of angle random walk 1 °/√h at 100 Hz."""
    return NOISE * 10.0 * np.random.default_rng(seed).standard_normal((samples, axes))


def written(tmp_path, folder="allan-results"):
    """The specification, as read back, and its text."""
    text = (tmp_path / folder / "gyro.toml").read_text(encoding="utf-8")
    return gyro.read_spec(tmp_path / folder / "gyro.toml"), text


def commented(text):
    """The keys that comment lines give, as TOML."""
    lines = [line.removeprefix("# ") for line in text.splitlines() if line.startswith("# ") and " = " in line]
    return tomllib.loads("\n".join(lines))


def test_the_scenario_at_rest_gives_its_preset_back(succeeds, tmp_path):
    succeeds("simulate", "rest")
    said = succeeds("allan", "rest.h5")
    assert "432000 samples at 10 Hz, 12 h" in said
    spec, text = written(tmp_path)
    preset = datasheets.PRESETS["adis16470"].spec
    content = json.loads((tmp_path / "allan-results" / "allan.json").read_text(encoding="utf-8"))
    for term, most in (("angle_random_walk", 0.006), ("bias_instability", 0.1), ("rate_random_walk", 0.35)):
        truth = getattr(preset, term)
        assert np.all(np.abs(getattr(spec, term) / truth - 1.0) < most), term
        rows = [row for row in content["coefficients"] if row["term"] == term]
        assert [row["supported"] for row in rows] == [True] * 3
        factor = allan.UNITS["gyro"][term][1]
        # Nine intervals at 95 %: two or more misses have a chance of 7 %, these have none.
        assert all(row["lower"] <= truth / factor <= row["upper"] for row in rows)
    assert sorted(commented(text)) == ["quantization_arcsec", "rate_ramp_deg_per_hour_per_hour"]
    assert "warning" not in said
    assert "WARNING" not in text


def test_terms_not_seen_are_left_out_and_bounded_in_comments(succeeds, tmp_path):
    walking = white()
    walking[:, 2] += np.cumsum(3e-5 * np.random.default_rng(2).standard_normal(20_000))
    np.save(tmp_path / "gyro.npy", walking)
    succeeds("allan", "gyro.npy", *AT_100_HZ)
    spec, text = written(tmp_path)
    table = tomllib.loads(text)["gyro"]
    assert sorted(table) == ["angle_random_walk_deg_per_sqrt_hour", "rate_random_walk_deg_per_hour_per_sqrt_hour"]
    assert np.all(np.abs(spec.angle_random_walk / NOISE - 1.0) < 0.05)
    assert np.array_equal(spec.rate_random_walk > 0.0, [False, False, True])
    bounds = commented(text)
    assert sorted(bounds) == ["bias_instability_deg_per_hour", "quantization_arcsec", "rate_ramp_deg_per_hour_per_hour"]
    assert np.all(np.array(list(bounds.values())) > 0.0)
    fit = allan.fit_noise(walking, 0.01)
    for row, supported in zip(fit.listing().records, fit.supported.ravel(), strict=True):
        assert [row[key] is not None for key in ("estimate", "lower", "upper")] == [supported, supported, True]
    assert bounds["quantization_arcsec"] == pytest.approx(fit.upper[:, 0] / units.ARCSECOND, rel=1e-3)
    partly = next(line for line in text.splitlines() if "0 where not detected" in line)
    bound = fit.upper[:2, 3] / units.DEGREE_PER_HOUR_PER_ROOT_HOUR
    assert f"x below {bound[0]:.4g}, y below {bound[1]:.4g}." in partly
    # Six digits, in the unit of the key.
    assert table["angle_random_walk_deg_per_sqrt_hour"] == [float(f"{v / NOISE:.6g}") for v in fit.estimate[:, 1]]


def test_one_column_gives_one_number_for_all_axes_and_a_name_with_a_line_break_toml(succeeds, tmp_path):
    name = "at\nrest=1\t.npy"
    np.save(tmp_path / name, white(4096, axes=1)[:, 0])
    succeeds("allan", name, *AT_100_HZ)
    spec, text = written(tmp_path)
    assert list(tomllib.loads(text)) == ["gyro"]
    assert np.ndim(spec.angle_random_walk) == 0
    assert all(isinstance(value, float | int) for value in commented(text).values())


def test_a_record_of_something_else_is_said_in_the_file_and_last(succeeds, tmp_path):
    rates = white()
    rates[8000:12_000, 1] += 0.3  # two steps: a spectrum as f⁻², like that of a rate random walk
    words = (
        "axis y has other errors than these noise terms: its noise is not stationary, and largest from 78.12 to 81.25 s"
    )
    np.save(tmp_path / "gyro.npy", rates)
    said = succeeds("allan", "gyro.npy", *AT_100_HZ)
    assert "do not trust" in said.splitlines()[-1]
    assert words in " ".join(said.split())
    assert "axis x" not in said
    _, text = written(tmp_path)
    assert words in text
    assert "# WARNING: do not trust" in text
    content = json.loads((tmp_path / "allan-results" / "allan.json").read_text(encoding="utf-8"))
    assert content["misfit_probability"][1] < 1e-3
    assert min(content["misfit_probability"][0], content["misfit_probability"][2]) > 1e-3


@pytest.mark.parametrize(
    ("values", "options", "words"),
    [
        (white(100, axes=2), AT_100_HZ, "gyro.npy has 2 columns"),
        (white(3), AT_100_HZ, "gyro.npy: values has 3 samples; at least 64"),
        (white(0), AT_100_HZ, "gyro.npy: values has 0 samples"),
        (np.zeros((500, 3)), AT_100_HZ, "gyro.npy: values, axis 0, has no noise"),
        (np.zeros((10, 20, 3)), AT_100_HZ, "gyro.npy has shape (10, 20, 3)"),
        (np.where(np.arange(300)[:, None] == 7, np.nan, white(300)), AT_100_HZ, "gyro.npy[7, 0] is nan"),
        (white(300), (), "give its rate in Hz and its unit"),
        (white(300), ("--rate", 100, "--gyro-unit", "deg/h"), "did you mean 'deg/s'"),
        (white(300), ("--rate", -1, "--gyro-unit", "deg/s"), "rate is -1 Hz"),
        (white(300), (*AT_100_HZ, "--highest-frequency", 1e-3), "raise it"),
    ],
)
def test_bad_records_end_with_one_clear_line_and_nothing_written(refusal, tmp_path, values, options, words):
    np.save(tmp_path / "gyro.npy", values)
    error = refusal("allan", "gyro.npy", *options)
    assert words in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not list(tmp_path.glob("allan-results/*"))


# Specification → simulation → Allan → specification, through the public functions alone


DT = 0.01
ONE_TERM = {
    "quantization": gyro.GyroSpec(quantization=0.3 * units.ARCSECOND, angle_random_walk=0.1 * NOISE),
    "angle_random_walk": gyro.GyroSpec(angle_random_walk=0.1 * NOISE),
    "bias_instability": gyro.GyroSpec(bias_instability=3.0 * units.DEGREE_PER_HOUR, angle_random_walk=0.01 * NOISE),
    "rate_random_walk": gyro.GyroSpec(
        rate_random_walk=60.0 * units.DEGREE_PER_HOUR_PER_ROOT_HOUR, angle_random_walk=0.01 * NOISE
    ),
    "rate_ramp": gyro.GyroSpec(rate_ramp=-300.0 * units.DEGREE_PER_HOUR / 3600.0, angle_random_walk=0.01 * NOISE),
}


@pytest.mark.parametrize("term", allan.TERMS)
def test_the_round_trip_of_each_term(term):
    spec = ONE_TERM[term]
    samples = 1 << 15
    edges = DT * np.arange(samples + 1)
    increments = gyro.simulate(spec, np.zeros((samples, 3)), edges, generator(3, 0, "gyro")).increments
    fit = allan.fit_noise(increments, DT, kind="increments")
    estimate = gyro.GyroSpec(**allan.to_gyro_parameters(fit))
    truth = {name: float(getattr(spec, name)) for name in allan.TERMS}
    expected = dict(zip(allan.TERMS, 0.5 * (fit.upper - fit.lower).T / 1.96, strict=True))
    for name in allan.TERMS:
        if truth[name] != 0.0:
            error = (np.asarray(getattr(estimate, name)) - truth[name]) / expected[name]
            # The χ² of three at 1e-4 on either side; found afresh on each axis, so not the same on all.
            assert 0.003 < error @ error < 21.1, name
        else:
            assert np.all(np.asarray(getattr(estimate, name)) == 0.0), name
    assert np.all(expected[term] < 0.12 * abs(truth[term]))
    assert gyro.from_table(gyro.to_table(estimate)) == estimate
