"""Noise of any sensor at rest: other sensors' units, gaps, temperature, the files of other programs, and the whole way through a bag."""

import itertools
import json
import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import strapdown as sd
from strapdown import ahrs, allan, gyro, recordings, units, workflows
from strapdown.allan import noise_fit
from strapdown.allan import parameters as noise_parameters
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.gyro.temperature import from_table
from strapdown.recordings import Recording, broad, gyro_temperature
from strapdown.units import DEGREE_PER_HOUR, DEGREE_PER_ROOT_HOUR, STANDARD_GRAVITY

DT = 0.01
GYRO = (2e-4, 2e-4)
"""N and K, SI."""
ACC = (1.5e-3, 1.5e-3)
MAG = (4e-8, 4e-8)


def noise(samples: int, coefficients: tuple[float, float], random: np.random.Generator) -> np.ndarray:
    """Return averaged samples (n, 3) of white noise N and random walk K."""
    N, K = coefficients
    walk = np.cumsum(K * np.sqrt(DT) * random.standard_normal((samples + 1, 3)), axis=0)
    return 0.5 * (walk[1:] + walk[:-1]) + np.sqrt(N**2 / DT + K**2 * DT / 12.0) * random.standard_normal((samples, 3))


def at_rest(samples: int = 30_000, seed: int = 1) -> Recording:
    random = np.random.default_rng(seed)
    return Recording(
        source="rest",
        time=DT * np.arange(samples),
        rate=1e-3 + noise(samples, GYRO, random),
        specific_force=np.array([0.1, 0.2, 9.8]) + noise(samples, ACC, random),
        magnetic_field=np.array([2e-5, 0.0, -4e-5]) + noise(samples, MAG, random),
        magnetic_unit="T",
    )


@pytest.fixture(scope="module")
def rest(tmp_path_factory):
    path = tmp_path_factory.mktemp("rest") / "rest.csv"
    recordings.write(at_rest(), path)
    return path


OTHERS = ("--kalibr", "--px4", "--matlab", "--factor", 5)
IN_UNITS = {
    "gyro": (GYRO, ("angle_random_walk_deg_per_sqrt_hour", "rate_random_walk_deg_per_hour_per_sqrt_hour"),
             (10800 / np.pi, 38880e3 / np.pi)),
    "accelerometer": (ACC, ("velocity_random_walk_ug_per_sqrt_hz", "acceleration_random_walk_ug_per_sqrt_hour"),
                      (1e6 / STANDARD_GRAVITY, 60e6 / STANDARD_GRAVITY)),
    "magnetometer": (MAG, ("white_noise_nt_per_sqrt_hz", "random_walk_nt_per_sqrt_hour"), (1e9, 60e9)),
}  # fmt: skip


def test_each_sensor_is_identified_in_its_units_and_for_other_programs(succeeds, rest, tmp_path):
    said = succeeds("allan", rest, *itertools.chain(*(("--sensor", sensor) for sensor in IN_UNITS)), *OTHERS)
    out = tmp_path / "allan-results"
    for sensor, (truth, names, factors) in IN_UNITS.items():
        table = tomllib.loads((out / f"{sensor}.toml").read_text())[sensor]
        stem = "allan" if sensor == "gyro" else sensor
        for i, term in enumerate(names):
            np.testing.assert_allclose(table[term], truth[i] * factors[i], rtol=(0.03, 0.35)[i])
        for row in json.loads((out / f"{stem}.json").read_text())["coefficients"]:
            if names[0].startswith(row["term"]):
                assert row["lower"] < truth[0] * factors[0] * 1.02
                assert row["upper"] > truth[0] * factors[0] * 0.98
        assert (out / f"{stem}.png").exists()
        assert noise_fit.UNITS[sensor]["angle_random_walk"].name in said
    lines = [line for line in (out / "imu.yaml").read_text().splitlines() if line[0] != "#"]
    pairs = (line.partition("#")[0].split(":") for line in lines)
    kalibr = {name: word.strip() if name == "rostopic" else float(word) for name, word in pairs}
    assert "times 5 (--factor)" in said
    assert "multiplied by 5" in (out / "imu.yaml").read_text()
    np.testing.assert_allclose(kalibr["gyroscope_noise_density"], 5 * GYRO[0], rtol=0.03)
    np.testing.assert_allclose(kalibr["accelerometer_noise_density"], 5 * ACC[0], rtol=0.03)
    np.testing.assert_allclose(kalibr["gyroscope_random_walk"], 5 * GYRO[1], rtol=0.35)
    np.testing.assert_allclose(kalibr["accelerometer_random_walk"], 5 * ACC[1], rtol=0.35)
    assert (kalibr["update_rate"], kalibr["rostopic"]) == (100.0, "/imu0")
    rows = [line.split("\t") for line in (out / "px4.params").read_text().splitlines() if line[0] != "#"]
    px4 = {row[2]: row for row in rows}
    np.testing.assert_allclose(float(px4["EKF2_GYR_NOISE"][3]), 10.0 * GYRO[0], rtol=0.03)  # over 10 ms: 1/√0.01
    np.testing.assert_allclose(float(px4["EKF2_ACC_B_NOISE"][3]), 10.0 * ACC[1], rtol=0.35)
    assert px4["EKF2_ACC_NOISE"][:2] + px4["EKF2_ACC_NOISE"][4:] == ["1", "1", "9"]
    matlab = (out / "imu_sensor.m").read_text()
    assert "imuSensor('accel-gyro-mag', 'SampleRate', 100)" in matlab
    assert matlab.count("'NoiseType', 'single-sided'") == 3
    for sensor, truth in (("Gyroscope", GYRO[0]), ("Magnetometer", 1e6 * MAG[0])):
        density = float(matlab.split(f"imu.{sensor}")[1].split("'NoiseDensity', [")[1].split()[0])
        np.testing.assert_allclose(density, truth, rtol=0.03)


def test_what_is_not_seen_is_bounded_and_said():
    x = np.random.default_rng(3).standard_normal((4000, 3)) * GYRO[0] / np.sqrt(DT)
    fit = allan.fit_noise(x, DT)
    i = fit.terms.index("rate_random_walk")
    assert not fit.supported[:, i].any()
    assert noise_parameters.largest(fit, "rate_random_walk") == (fit.upper[:, i].max(), False)
    text = noise_parameters.to_kalibr({"gyro": fit, "accelerometer": fit})
    assert text.count("not detected, the upper end of its interval") == 2
    assert f"gyroscope_random_walk: {fit.upper[:, i].max():.6e}" in text
    assert "# EKF2_GYR_B_NOISE: not detected" in noise_parameters.to_px4({"gyro": fit, "accelerometer": fit})
    with pytest.raises(
        InputError, match="Kalibr needs the noise of gyro and accelerometer; identify the accelerometer too"
    ):
        noise_parameters.to_kalibr({"gyro": fit})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--kalibr",), "--sensor gyro --sensor accelerometer"),
        (("--sensor", "barometer"), "'barometer' is not known"),
        (("--temperature", 1), "no temperature is recorded"),
        (("--factor", 0), "factor is 0"),
    ],
)
def test_what_does_not_go_is_refused_before_anything_is_written(run, rest, tmp_path, options, words):
    status, _, error = run("allan", rest, *options)
    assert (status, words in error) == (2, True), error
    assert not list(tmp_path.rglob("*.toml"))


def test_a_magnetometer_without_a_unit_is_refused(run, succeeds, tmp_path):
    whole = replace(at_rest(200), magnetic_unit="")
    recordings.write(whole, tmp_path / "x.csv")
    status, _, error = run("allan", tmp_path / "x.csv", "--sensor", "magnetometer")
    assert (status, "does not declare the unit of its magnetometer" in error) == (2, True)
    succeeds("allan", tmp_path / "x.csv", "--sensor", "magnetometer", "--magnetometer-unit", "uT")


def test_gaps_are_said_and_the_noise_is_right(succeeds, tmp_path):
    whole = at_rest(20_000)
    keep = np.ones(20_000, bool)
    keep[3000:3700] = keep[9000:9001] = keep[15_000:15_100] = False
    cut = Recording(source="gappy", time=whole.time[keep], rate=whole.rate[keep])
    recordings.write(cut, tmp_path / "gappy.csv")
    said = succeeds("allan", "gappy.csv")
    assert "801 samples are missing in 3 gaps." in said
    assert "Because of gaps the fit uses 19199 samples" in said
    table = tomllib.loads((tmp_path / "allan-results" / "gyro.toml").read_text())["gyro"]
    np.testing.assert_allclose(table["angle_random_walk_deg_per_sqrt_hour"], GYRO[0] / DEGREE_PER_ROOT_HOUR, rtol=0.03)


def test_stamps_that_stray_are_taken_for_even_and_said():
    whole = at_rest(2000)
    random = np.random.default_rng(2)
    late = np.maximum.accumulate(whole.time + 0.008 * random.random(2000)) + 1e-7 * np.arange(2000)
    late[1000:] += 1.0
    from strapdown.recordings import samples

    gyro_samples = samples._of_recording(replace(whole, time=late), "gyro")
    assert "deviate by up to" in gyro_samples.remarks[0]
    assert abs(gyro_samples.sample_interval - DT) < 1e-4
    assert abs(np.isnan(gyro_samples.values[:, 0]).sum() - 100) <= 2
    with pytest.raises(InputError, match="cut the recording to a part with equal sample intervals"):
        broad.sample_interval(whole.source, late)


@pytest.mark.parametrize("change", [-0.3, 0.3])
def test_the_interval_that_differs_most_is_named(change):
    whole = at_rest(100)
    time = whole.time + np.where(np.arange(100) > 40, change * DT, 0.0)
    words = f"the interval after {time[40]:.6g} s is {(1.0 + change) * DT:.6g} s"
    with pytest.raises(InputError, match=re.escape(words)):
        broad.sample_interval(whole.source, time)


def test_temperature_is_regressed_out_and_written(succeeds, tmp_path):
    whole = at_rest(10_000)
    T = 25.0 + 10.0 * (1.0 - np.exp(-whole.time / 60.0))
    warm = replace(whole, rate=whole.rate + 2e-3 * (T - T.mean())[:, None] * [1.0, -1.0, 0.0], temperature=T)
    recordings.write(warm, tmp_path / "warm.csv")
    said = succeeds("allan", "warm.csv", "--temperature", 1)
    assert "Bias over temperature" in said
    table = tomllib.loads((tmp_path / "allan-results" / "gyro-temperature.toml").read_text())["gyro"]["temperature"]
    slope, sigma = np.array(table["bias_rad_per_s_per_k"]), np.array(table["sigma_rad_per_s_per_k"])
    assert (np.abs(slope - [2e-3, -2e-3, 0.0]) < 4.0 * sigma).all()
    assert abs(table["reference_degc"] - T.mean()) < 1e-9
    noise_of = tomllib.loads((tmp_path / "allan-results" / "gyro.toml").read_text())["gyro"]
    np.testing.assert_allclose(
        noise_of["angle_random_walk_deg_per_sqrt_hour"], GYRO[0] / DEGREE_PER_ROOT_HOUR, rtol=0.04
    )
    assert "rate_ramp_deg_per_hour_per_hour" not in noise_of


def test_the_bias_over_temperature_is_subtracted_and_its_error_becomes_a_walk():
    """At a constant rise of a K/s the error σ₁ a t of the slope is largest over √t at the end: σ₁ a √t."""
    time, rise = np.linspace(0.0, 100.0, 101), 0.05
    T = 24.0 + rise * time
    warm = Recording(source="warm", time=time, rate=np.ones((101, 3)), temperature=T)
    entries = {"reference_degc": 25.0, "lowest_degc": 20.0, "highest_degc": 27.0}
    entries |= {"bias_rad_per_s": [0.1, 0.2, 0.3], "bias_rad_per_s_per_k": [1e-2, 0.0, 0.0]}
    entries |= {"bias_rad_per_s_per_k2": [0.0, 1e-3, 0.0]}
    entries |= {"sigma_rad_per_s_per_k": [0.0, 0.0, 2e-4], "sigma_rad_per_s_per_k2": [0.0, 0.0, 0.0]}
    table = from_table(entries, "file: gyro")
    corrected, walk = gyro_temperature.applied(warm, table), table.walk(T, time)
    held = np.minimum(T, 27.0) - 25.0  # beyond the table's range the bias at its end
    expected = 1.0 - np.stack([0.1 + 1e-2 * held, 0.2 + 1e-3 * held**2, np.full(101, 0.3)], axis=1)
    np.testing.assert_allclose(corrected.rate, expected, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(corrected.temperature, held + 25.0)  # which drives the error of the slope
    assert walk == pytest.approx(2e-4 * rise * np.sqrt(60.0), rel=1e-12)  # 3 K, which it takes 60 s for
    assert "40 samples are beyond 20 to 27 °C" in corrected.remarks[-1]
    np.testing.assert_allclose(table.slope_sigma, [0.0, 0.0, 2e-4])
    bent = from_table(
        {**entries, "sigma_rad_per_s_per_k2": [0.0, 3e-5, 3e-5]}, "file"
    )  # 2 σ₂ (T − T₀) at 20 °C, 5 K off
    np.testing.assert_allclose(bent.slope_sigma, [0.0, 3e-4, np.hypot(2e-4, 3e-4)])
    # A thermometer that is slower than the gyro: between its samples the line.
    slow = np.where(np.arange(101) % 10 == 0, T, np.nan)
    np.testing.assert_allclose(
        gyro_temperature.applied(replace(warm, temperature=slow), table).rate, expected, atol=1e-15
    )
    with pytest.raises(InputError, match="warm has no temperature; leave out"):
        gyro_temperature.applied(replace(warm, temperature=None), table)
    with pytest.raises(InputError, match="file: gyro lacks bias_rad_per_s"):
        from_table({k: v for k, v in entries.items() if k != "bias_rad_per_s"}, "file: gyro")


@pytest.mark.slow
def test_a_simulated_unit_goes_through_allan_and_its_table_into_the_filter(succeeds, tmp_path):
    """Round trip: the scenario's polynomial lies inside the intervals, and the filter that reads the table finds the turn-on bias."""
    rest = """
    rate_hz = 100.0
    duration_s = {duration}
    motion.type = "rest"
    gyro.angle_random_walk_deg_per_sqrt_hour = 0.3
    gyro.turn_on_bias_deg_per_hour = {bias}
    [gyro.temperature]
    reference_degc = 30.0
    lowest_degc = 10.0
    highest_degc = 50.0
    bias_rad_per_s = [0.0, 0.0, 0.0]
    bias_rad_per_s_per_k = [2e-4, -1e-4, 0.0]
    sigma_rad_per_s_per_k = [0.0, 0.0, 0.0]
    bias_rad_per_s_per_k2 = [0.0, 4e-6, 0.0]
    sigma_rad_per_s_per_k2 = [0.0, 0.0, 0.0]
    [temperature]
    start_degc = {start}
    end_degc = {end}
    time_constant_s = 60.0
    [[sensors]]
    type = "accelerometer"
    name = "accelerometer"
    rate_hz = 100.0
    kind = "vector"
    sigma_m_per_s2 = 0.01
    """
    (tmp_path / "lab.toml").write_text(rest.format(duration=300.0, bias=[0.0] * 3, start=20.0, end=40.0))
    (tmp_path / "use.toml").write_text(rest.format(duration=60.0, bias=[360.0, 0.0, -360.0], start=38.0, end=12.0))
    for name in ("lab", "use"):
        succeeds("simulate", f"{name}.toml")
    succeeds("allan", "lab.h5", "--temperature", 2)
    path = tmp_path / "allan-results" / "gyro-temperature.toml"
    unit_table = tomllib.loads(path.read_text())["gyro"]["temperature"]
    T0 = unit_table["reference_degc"] - 30.0
    for key, truth in (("k", [2e-4, -1e-4 + 8e-6 * T0, 0.0]), ("k2", [0.0, 4e-6, 0.0])):
        off = np.array(unit_table[f"bias_rad_per_s_per_{key}"]) - truth
        assert (np.abs(off) < 4.0 * np.array(unit_table[f"sigma_rad_per_s_per_{key}"])).all()
    text = (tmp_path / "allan-results" / "gyro.toml").read_text()
    both = tomllib.loads(text + path.read_text())["gyro"]  # the two files in one are a gyro's table
    assert gyro.from_table(both).temperature.span == (unit_table["lowest_degc"], unit_table["highest_degc"])
    succeeds("convert", "use.h5", "use.db3")
    succeeds("estimate", "use.db3", "--temperature", path)
    estimate = setup.read_estimate(tmp_path / "estimate-results" / "estimate.h5")
    slope = estimate.error_states["gyro temperature"]
    assert (slope.sigma[0] < 1e-4).all()
    # The two files in one, as the gyro's noise, do the same.
    (tmp_path / "whole.toml").write_text(text + path.read_text())
    again = sd.estimate(recordings.read(tmp_path / "use.db3"), noise=gyro.read_spec(tmp_path / "whole.toml"))
    succeeds("estimate", "use.db3", "--gyro", "whole.toml")
    by_command = setup.read_estimate(tmp_path / "estimate-results" / "estimate.h5")
    np.testing.assert_array_equal(again.bias, by_command.bias)
    np.testing.assert_allclose(again.bias[-1], estimate.bias[-1], atol=3.0 * estimate.sigma[-1, 3])
    # About the two level axes, which the accelerometer shows: the bias at turn-on all the time, and c_0 has no interval.
    off = np.abs(estimate.bias - np.array([360.0, 0.0, -360.0]) * DEGREE_PER_HOUR)[:, :2]
    assert (off < 4.0 * estimate.sigma[:, 3:5]).all()
    rested = estimate.time > estimate.time[0] + 1.1
    assert off[rested].max() < 5e-4  # after the second at rest that measures it
    # The accelerometer shows a little more; the reported σ has the factor for the share of the bias's first variance that is left.
    assert estimate.sigma[-1, 3] < 0.75 * estimate.sigma[rested][0, 3]


@pytest.mark.parametrize(("axes", "others"), [(1, 1.0), (3, 1.0), (3, 0.2)], ids=["one", "alike", "one much larger"])
def test_the_interval_of_the_largest_axis_covers_it(axes, others):
    """Estimates that are log-normal about the truth, σ 5 %, as their intervals say: 2,000 of them."""
    truth = np.array([2.0, *[2.0 * others] * (axes - 1)])
    draws = np.random.default_rng(5).standard_normal((2_000, axes))
    template = allan.fit_noise(draws[:500], 0.01, terms=("angle_random_walk",))
    estimate = truth * np.exp(0.05 * draws)
    reach = np.exp(0.05 * 1.959964)
    inside = []
    for row in estimate:
        fit = replace(template, estimate=row[:, None], lower=row[:, None] / reach, upper=row[:, None] * reach)
        low, high = noise_parameters.largest_interval(fit, "angle_random_walk")
        inside.append(low <= 2.0 <= high)
    assert abs(np.mean(inside) - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / 2_000)


FLICKER = 20.0 * units.DEGREE_PER_HOUR


@pytest.fixture
def table(tmp_path):
    """Twenty seconds of a unit that lies still for three and is then rolled about, with its true roll, rad."""
    random, time = np.random.default_rng(5), 0.01 * np.arange(2000)
    rate = np.where(time > 3.0, 40.0 * np.sin(np.pi * (time - 3.0)), 0.0)
    roll = np.radians(np.cumsum(rate) * 0.01)
    turn = np.stack([rate, 0.0 * time, 0.0 * time], axis=1) + 0.05 * random.standard_normal((2000, 3))
    force = np.stack([0.0 * time, np.sin(roll), np.cos(roll)], axis=1) + 2e-3 * random.standard_normal((2000, 3))
    path = tmp_path / "walk.csv"
    header = "time,gx [deg/s],gy [deg/s],gz [deg/s],ax [g],ay [g],az [g]"
    np.savetxt(path, np.column_stack([time, turn, force]), delimiter=",", header=header, comments="")
    return path, roll


def test_the_file_of_an_allan_fit_with_flicker_serves_a_recording(table, succeeds, tmp_path):
    path, roll = table
    text = "[gyro]\nangle_random_walk_deg_per_sqrt_hour = [0.3, 0.3, 0.3]\nbias_instability_deg_per_hour = [20.0, 20.0, 20.0]\n"
    (tmp_path / "gyro.toml").write_text(text)
    succeeds("estimate", path, "--gyro", "gyro.toml", "--out", "found")
    estimate = sd.read(tmp_path / "found" / "estimate.h5")
    error = estimate.rotation.as_euler("ZYX")[:, 2] - roll[-len(estimate.time) :]
    assert np.sqrt(np.mean(error**2)) < np.radians(0.5)


def test_flicker_is_covered_at_every_frequency_that_the_filter_of_the_tilt_follows():
    """At the natural frequency ω of the filter the covering spectrum σ_v² + σ_u²/ω² is at least 2/π of the flicker's, B²/ω."""
    spec = gyro.GyroSpec(angle_random_walk=1e-4, bias_instability=FLICKER)
    for parameters in itertools.chain(*ahrs.MOTIONS.values()):
        filter_parameters = workflows.filters.with_gyro_noise(parameters, spec)
        white = filter_parameters.angle_random_walk**2 - spec.angle_random_walk**2
        walk = filter_parameters.rate_random_walk**2
        assert white > 0.0
        assert walk > 0.0
        natural = np.sqrt(walk / white)  # where the two parts of the covering spectrum cross
        share = (white + walk / natural**2) / (FLICKER**2 / natural)
        assert 2.0 / np.pi <= share <= 1.0 + 1e-12
        density = (parameters.specific_force_noise / units.STANDARD_GRAVITY) ** 2
        assert natural**4 == pytest.approx(walk / density, rel=1e-6)  # Farrenkopf's limit: ω⁴ = σ_u²/r


def test_a_gyro_without_flicker_keeps_its_own_noise():
    spec = gyro.GyroSpec(angle_random_walk=1e-4, rate_random_walk=2e-6)
    filter_parameters = workflows.filters.with_gyro_noise(ahrs.HAND_HELD, spec)
    assert (filter_parameters.angle_random_walk, filter_parameters.rate_random_walk) == (1e-4, 2e-6)
