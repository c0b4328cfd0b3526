"""``import strapdown as sd``: the five commonest programs, what the package shows, and that it loads nothing before it is used."""

import ast
import base64
import dataclasses
import importlib.metadata
import math
import os
import subprocess
import sys
import types
import xml.etree.ElementTree
from pathlib import Path

import numpy as np
import pytest

import strapdown as sd
from strapdown import results

SHOWN = """FilterSetup Gate GyroSpec InputError LiveAhrs LiveFilter ProcessNoise Robust Scenario StepFilter VectorSensor accuracy
    allan_deviation calibrate check covariance_analysis diagnose estimate export fit_noise initial_state integrate monte_carlo read
    read_attitudes simulate smooth tune write"""
NAMES = set(SHOWN.split())


def scenario(duration: float = 60.0) -> sd.Scenario:
    return sd.Scenario(
        motion=sd.motion.ConstantRate(rate=(0.01, -0.02, 0.03), initial_attitude=[0.5, 0.5, -0.5, 0.5]),
        gyro=sd.GyroSpec(angle_random_walk=2e-5, rate_random_walk=1e-7, turn_on_bias_sigma=5e-6),
        sensors=(
            sd.VectorSensor(name="star 1", reference_f=[1.0, 0.0, 0.0], sigma=1e-4, rate=1.0),
            sd.VectorSensor(name="star 2", reference_f=[0.0, 1.0, 1.0], sigma=1e-4, rate=1.0),
        ),
        rate=20.0,
        duration=duration,
        name="two stars, small",
        seed=3,
    )


# ------------------------------------------------------------------------------------------------------------ the five programs


def test_simulate_estimate_check(tmp_path):
    record = sd.simulate(scenario(200.0))
    estimate = sd.estimate(record)
    assert sd.check(estimate, record).verdict != "not consistent"
    # The error of the attitude is that of its own σ, and not of another: 3 axes, the last half.
    error = sd.consistency.errors(estimate.attitude, estimate.bias, record.truth.attitude, record.truth.bias)
    ratio = error[len(error) // 2 :] / estimate.sigma[len(error) // 2 :]
    assert 0.3 < np.sqrt(np.mean(ratio[:, :3] ** 2)) < 2.0
    # A filter with a hundredth of the measurements' σ is not consistent, and the check says so.
    wrong = dataclasses.replace(
        sd.FilterSetup.for_scenario(scenario(200.0), states=False), measurement_sigma_factor=0.01
    )
    assert sd.check(sd.estimate(record, setup=wrong), record).verdict == "not consistent"
    # From a file the same numbers.
    sd.write(record, tmp_path / "record.h5")
    again = sd.read(tmp_path / "record.h5")
    assert again.origin.scenario == record.origin.scenario
    np.testing.assert_array_equal(sd.estimate(again).attitude, estimate.attitude)


RATE = np.radians(20.0)
"""Of the phone about the vertical after three seconds."""


def phone_recording(folder: Path) -> Path:
    """Write what a phone on a turntable measures."""
    time = np.arange(0.0, 12.0, 0.01)
    moving = time > 3.0
    yaw = np.where(moving, RATE * (time - 3.0), 0.0)
    noise = np.random.default_rng(5)
    gyro = np.degrees(np.where(moving, RATE, 0.0))[:, None] * [0.0, 0.0, 1.0] + 0.05 * noise.standard_normal(
        (len(time), 3)
    )
    force = np.tile([0.0, 0.0, 1.0], (len(time), 1)) + 0.002 * noise.standard_normal((len(time), 3))
    # The field points North (y) and down; the body's yaw turns it the other way.
    field = 50.0 * np.stack([0.5 * np.sin(yaw), 0.5 * np.cos(yaw), np.full_like(yaw, -0.87)], axis=1)
    table = np.column_stack([time, gyro, force, field + 0.1 * noise.standard_normal((len(time), 3))])
    path = folder / "phone.csv"
    np.savetxt(path, table, delimiter=",", header="time,gx,gy,gz,ax,ay,az,mx,my,mz", comments="", fmt="%.9g")
    return path


def test_a_recording_to_euler_angles(tmp_path):
    """A unit that turns at a constant rate about the vertical: roll and pitch stay, yaw turns at that rate."""
    path = phone_recording(tmp_path)
    phone = sd.read(path, units={"time": "s", "gyro": "deg/s", "accelerometer": "g", "magnetometer": "uT"})
    estimate = sd.estimate(phone)
    angles = estimate.euler("ZYX").angles
    truth = RATE * np.maximum(estimate.time - 3.0, 0.0)
    turned = np.unwrap(angles[:, 0]) - angles[0, 0]
    assert np.degrees(np.abs(turned - truth)).max() < 3.0
    assert np.degrees(np.abs(angles[:, 1:])).max() < 3.0
    sd.write(estimate, tmp_path / "angles.csv", sequence="ZYX")
    assert (tmp_path / "angles.csv").read_text().count("\n") >= len(estimate.time)
    smoothed = sd.smooth(phone)
    assert np.mean(smoothed.variance[:, 2]) < np.mean(estimate.variance[:, 2])


def test_noise_from_a_rest_recording_into_the_filter(tmp_path):
    arw, dt = 3e-4, 0.01
    samples = arw / np.sqrt(dt) * np.random.default_rng(7).standard_normal((30_000, 3))
    table = np.column_stack([dt * np.arange(len(samples)), samples])
    path = tmp_path / "rest.csv"
    np.savetxt(path, table, delimiter=",", header="time,gx,gy,gz", comments="", fmt="%.9g")

    rest = sd.read(path, units={"time": "s", "gyro": "rad/s"})
    deviation = sd.allan_deviation(rest, taus=[1.0])
    np.testing.assert_allclose(deviation.deviation, arw, rtol=0.1)  # N/√τ of white noise
    noise = sd.fit_noise(rest)
    k = noise.terms.index("angle_random_walk")
    np.testing.assert_allclose(noise.estimate[:, k], arw, rtol=0.03)

    record = sd.simulate(scenario())
    wider = sd.estimate(record, noise=noise)
    matched = sd.estimate(record)
    assert np.all(wider.variance[-1, :3] > 1.5 * matched.variance[-1, :3])
    # A rest recording says nothing of the bias after the next start: the filter takes it as known, and says so.
    said, initial_sigma = " ".join(wider.remarks), np.degrees(wider.sigma[0, 3]) * 3600.0
    assert f"no turn-on bias, so its bias at the start is taken as zero, ±{initial_sigma:.3g} °/h" in said
    assert "turn-on" not in " ".join(matched.remarks)


# ---------------------------------------------------------------------------------------------------- as the commands do it


def test_one_state_by_name_is_that_of_the_command(succeeds, tmp_path):
    errors = {"scale_factor": (0.0, 0.0, 3e-4), "misalignment": np.full((3, 3), 1e-4) - 1e-4 * np.eye(3)}
    with_errors = dataclasses.replace(scenario(), gyro=dataclasses.replace(scenario().gyro, **errors))
    sd.write(sd.simulate(with_errors, seed=9), tmp_path / "record.h5")
    succeeds("estimate", tmp_path / "record.h5", "--out", tmp_path / "out", "--state", "gyro.scale")
    call = sd.estimate(sd.read(tmp_path / "record.h5"), states=["gyro.scale"])
    assert call == sd.read(tmp_path / "out" / "estimate.h5")
    assert call.error_states["gyro scale"].values.shape[1] == 1


def test_without_a_seed_a_campaign_has_that_of_the_scenario(tmp_path):
    sd.write(scenario(10.0), tmp_path / "small.toml")
    call = sd.monte_carlo(tmp_path / "small.toml", runs=10, threads=1)
    np.testing.assert_array_equal(call.nees_sum, sd.monte_carlo(scenario(10.0), seed=3, runs=10, threads=1).nees_sum)
    assert not np.array_equal(call.nees_sum, sd.monte_carlo(scenario(10.0), seed=0, runs=10, threads=1).nees_sum)


@pytest.mark.parametrize("machine", ["lanes", "scalar"])
def test_a_replayed_run_is_a_record_like_any_other(tmp_path, machine):
    plan = sd.montecarlo.Plan(
        scenario=scenario(10.0), setup=sd.FilterSetup.for_scenario(scenario(10.0), states=False), seed=5, epochs=10
    )
    replayed = sd.montecarlo.replay(plan, 2, machine=machine)
    sd.write(replayed.record, tmp_path / "run.h5")
    origin = sd.read(tmp_path / "run.h5").origin
    assert (origin.scenario, origin.seed, origin.run) == (scenario(10.0), 5, 2)
    assert len(sd.estimate(replayed.record).time) == len(replayed.record.time)


def test_a_record_of_a_motion_of_ones_own_is_written_without_its_scenario(tmp_path):
    class Own(sd.motion.ConstantRate):
        pass

    own = dataclasses.replace(scenario(5.0), motion=Own(rate=(0.0, 0.0, 0.1)))
    record = sd.simulate(own)
    sd.write(record, tmp_path / "own.h5")
    again = sd.read(tmp_path / "own.h5")
    assert again.origin.scenario is None
    assert again.origin.gyro == own.gyro
    np.testing.assert_array_equal(sd.estimate(again).attitude, sd.estimate(record).attitude)


def test_a_cut_record_is_still_matched():
    """What a record was simulated from stays with it when it is cut or compressed."""
    record = sd.simulate(scenario(40.0))
    half = sd.records.cut(record, 400, 800)
    assert half.origin is record.origin
    assert sd.check(sd.estimate(half), half).verdict != "not consistent"
    assert sd.records.compress(record, "four-sample").origin is record.origin


# ----------------------------------------------------------------------------------------------------------------- other calls


def test_own_data_with_own_noise():
    simulated = sd.simulate(scenario())
    own = sd.records.ImuRecord(time=simulated.time, increments=simulated.increments, vectors=simulated.vectors)
    with pytest.raises(sd.InputError, match="noise="):
        sd.estimate(own)
    noise = sd.ProcessNoise(angle_random_walk=2e-5, rate_random_walk=1e-7)
    with pytest.raises(sd.InputError, match="initial="):
        sd.estimate(own, noise=noise)
    start = sd.initial_state(simulated.truth.attitude[0], attitude_sigma=1e-3, bias_sigma=1e-5)
    estimate = sd.estimate(own, noise=noise, initial=start)
    direct = sd.estimation.run(own, noise, start, full_covariance=True)
    np.testing.assert_array_equal(estimate.attitude, direct.attitude)
    np.testing.assert_array_equal(estimate.covariance, direct.covariance)


def test_integrate_starts_at_the_truth(tmp_path):
    record = sd.simulate(scenario(10.0))
    history = sd.integrate(record, "one-sample")
    np.testing.assert_array_equal(history.time, record.time)
    error = sd.quaternion.angle_between(history.attitude, record.truth.attitude)
    assert history.remarks[-1].startswith(f"Error relative to the true attitude: final {np.degrees(error[-1]):.4g}°")
    assert error.max() < 1e-3  # at constant rate one sample is exact: what is left is noise and bias
    assert sd.integrate(record, initial_attitude=[1.0, 0.0, 0.0, 0.0]).attitude[0] == pytest.approx([1, 0, 0, 0])
    path = sd.write(history, tmp_path / "attitude.h5")
    assert sd.read(path) == history
    assert sd.read_attitudes(path).covariance is None
    assert sd.accuracy(history, record).given["all samples"]["total"].maximum == pytest.approx(error.max())


def test_an_integrated_attitude_has_no_bias_and_no_sigma():
    history = sd.integrate(sd.simulate(scenario(10.0)))
    assert not history.has_bias
    assert not history.has_covariance
    assert history.euler().sigma is None
    assert list(history.table())[5:] == ["yaw_deg", "pitch_deg", "roll_deg", "heading_deg"]
    assert sd.check(history).reason == "no covariance: nothing to test"
    assert len(sd.plots.estimate_overview(history).axes) == 3


def test_setups_and_scenarios_are_read_as_written(tmp_path):
    setup = sd.FilterSetup.for_scenario(scenario(), states=False)
    assert sd.estimation.setup.read_setup(sd.write(setup, tmp_path / "filter.toml")) == setup
    assert sd.scenarios.load_scenario(sd.write(scenario(), tmp_path / "scenario.toml")) == scenario()


@pytest.mark.parametrize(
    "call",
    [
        lambda: sd.simulate(3),
        lambda: sd.monte_carlo(3.5),
        lambda: sd.estimate("record.h5"),
        lambda: sd.estimate(sd.simulate(scenario(5.0)), setup=3),
        lambda: sd.estimate(sd.simulate(scenario(5.0)), noise=3.0),
        lambda: sd.tune("record.h5"),
        lambda: sd.tune([]),
        lambda: sd.tune(3),
        lambda: sd.integrate("record.h5"),
        lambda: sd.check(3),
        lambda: sd.check(sd.estimate(sd.simulate(scenario(5.0))), np.zeros(3)),
        lambda: sd.write(3, "x.h5"),
        lambda: sd.write(scenario(), "scenario.h5"),
        lambda: sd.read("no-such-file.h5"),
        lambda: sd.allan_deviation(np.zeros(100)),
        lambda: sd.fit_noise([math.nan] * 100, 0.1),
    ],
)
def test_what_is_none_of_these_things_is_refused_in_words(call):
    with pytest.raises(sd.InputError, match=r"; .|give|add|check"):
        call()


def test_a_refused_object_is_named_by_its_class_and_a_text_in_place_of_names_as_such():
    with pytest.raises(sd.InputError, match="content is of class GyroSpec, not of class ImuRecord or Recording"):
        sd.write(scenario().gyro, "x.h5")
    estimate = sd.estimate(sd.simulate(scenario(5.0)))
    with pytest.raises(
        sd.InputError, match="setup is of class Estimate, not of class FilterSetup or LiveAhrs or str or PathLike"
    ):
        sd.export(estimate, folder="x")
    recording = sd.recordings.Recording(source="walk", time=[0.0, 1.0], rate=np.zeros((2, 3)))
    with pytest.raises(
        sd.InputError, match="record is of class Recording, not of class ImuRecord; causes are searched for in"
    ):
        sd.diagnose(estimate, recording)
    with pytest.raises(sd.InputError, match=r"states is 'gyro\.scale', a text; give .* \['gyro\.scale'\]"):
        sd.estimate(sd.simulate(scenario(5.0)), states="gyro.scale")


def test_check_refuses_the_truth_of_another_record():
    estimate = sd.estimate(sd.simulate(scenario(10.0)))
    for other in (sd.check, sd.diagnose, sd.accuracy):
        with pytest.raises(sd.InputError, match="record is of seed 7, run 0, and the estimate of seed 3"):
            other(estimate, sd.simulate(scenario(10.0), seed=7))
        faulty = dataclasses.replace(scenario(10.0).gyro, scale_factor=1e-3)
        with pytest.raises(sd.InputError, match="another scenario"):
            other(estimate, sd.simulate(dataclasses.replace(scenario(10.0), gyro=faulty)))
    slower = sd.simulate(dataclasses.replace(scenario(10.0), rate=40.0, duration=5.0))
    with pytest.raises(sd.InputError, match="stamps"):
        sd.check(estimate, dataclasses.replace(slower, origin=None))
    with pytest.raises(sd.InputError, match="epochs"):
        sd.check(estimate, sd.simulate(scenario(5.0)).truth)


# ---------------------------------------------------------------------------------------------------------- results in print


def test_a_listing_is_aligned_text_and_escaped_html():
    rows = [("x", "rad", 1.5, "random"), ("long name", "", 12, "a")]
    table = results.Table("A < B", ("state", "", "σ", "kind"), rows, ["a note"], left=2)
    assert table.text.splitlines() == [
        "A < B",
        "state             σ  kind",
        "---------------------------",
        "x          rad  1.5  random",
        "long name        12  a",
        "a note",
    ]
    html = xml.etree.ElementTree.fromstring(table.html)
    assert html.find("p/b").text == "A < B"
    assert [cell.text for cell in html.iter("td")] == ["x", "rad", "1.5", "random", "long name", None, "12", "a"]
    assert [results.figure(x) for x in (0.00012345, None, math.nan, math.inf)] == ["0.0001234", "-", "-", "∞"]
    sides = [row.get("style").removeprefix("text-align:") for row in html.iter("th")]
    assert sides == ["left", "left", "right", "left"]


def test_an_estimate_prints_what_is_known_at_the_end():
    sigma = np.radians([0.1, 0.2, 0.3, 1.0 / 3600, 2.0 / 3600, 3.0 / 3600])
    estimate = sd.records.Estimate(
        time=np.array([0.0, 10.0]),
        attitude=np.array([[1.0, 0.0, 0.0, 0.0]] * 2),
        bias=np.radians([[0.0] * 3, [5.0 / 3600, -6.0 / 3600, 7.0 / 3600]]),
        variance=np.stack([4.0 * sigma**2, sigma**2]),
    )
    lines = [line.split() for line in str(estimate).splitlines()]
    assert lines[3] == ["attitude", "x", "°", "0.1", "0.2"]
    assert lines[8] == ["gyro", "bias", "z", "°/h", "7", "3", "6"]
    assert "1.000000, 0.000000" in str(estimate)


def test_results_print_as_short_tables():
    """In a notebook some have a figure below."""
    record = sd.simulate(scenario(30.0))
    estimate = sd.estimate(record)
    statistics = sd.monte_carlo(scenario(30.0), runs=20, threads=1)
    samples = np.random.default_rng(1).standard_normal((2000, 3))
    force = np.tile([0, 0, 9.8], (100, 1))
    time = 0.01 * np.arange(100)
    for result, drawn in (
        (record, False),
        (sd.recordings.Recording(source="walk.csv", time=time, rate=np.zeros((100, 3)), specific_force=force), False),
        (estimate, True),
        (sd.check(estimate, record), False),
        (statistics, True),
        (sd.check(statistics), False),
        (sd.covariance_analysis(scenario(30.0), epochs=5), True),
        (sd.allan_deviation(samples, 0.01), False),
        (sd.fit_noise(samples, 0.01), False),
        (sd.tune(record, free=["star 1.sigma"], starts=1, threads=1), False),
    ):
        lines = str(result).splitlines()
        assert 3 < len(lines) < 30, result
        assert repr(result) == str(result)
        assert max(map(len, lines)) < 140, result
        rows = xml.etree.ElementTree.fromstring(result._repr_html_())
        assert len({len(row) for row in rows.iter("tr")}) == 1
        images = [base64.b64decode(image.get("src").partition(",")[2])[1:4] for image in rows.iter("img")]
        assert images == [b"PNG"] * drawn
    # Of another sensor than a gyro the units are not the gyro's.
    assert "°/√h" in str(sd.fit_noise(samples, 0.01))
    assert "°" not in str(sd.fit_noise(samples, 0.01, sensor="accelerometer"))


# ------------------------------------------------------------------------------------------------------------ what it shows


def test_dir_shows_the_names_and_the_public_submodules_alone():
    shown = set(dir(sd))
    modules = shown - NAMES
    assert shown >= NAMES
    package = Path(sd.__file__).parent
    present = {path.stem for path in package.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert modules <= present
    private = {"kernels", "cli", "checks", "files", "tables", "equality", "reading", "workflows", "randomness"}
    assert not modules & private
    for name in shown:
        assert getattr(sd, name) is not None
    with pytest.raises(AttributeError, match="mekf"):
        _ = sd.mekf


BELOW = ("ahrs.check_conventions", "allan.parameters", "allan.temperature", "estimation.error_states")
BELOW += ("estimation.filters", "estimation.multiple_model", "gyro.datasheets", "montecarlo.campaign")
BELOW += ("montecarlo.cluster", "motion.orbit", "records.outputs", "vectors.wahba")
"""Public modules below the public submodules."""


def test_every_public_module_says_what_is_public_and_it_is_not_much():
    public = {f"strapdown.{name}" for name in NAMES}
    for name in (*sorted(set(dir(sd)) - NAMES), *BELOW):
        module = importlib.import_module(f"strapdown.{name}")
        assert module.__all__, name
        for public_name in module.__all__:
            value = getattr(module, public_name)
            assert not isinstance(value, types.ModuleType), f"{name}.{public_name}"
            if value is not getattr(sd, public_name, None):  # what the front door shows too is one name
                public.add(f"strapdown.{name}.{public_name}")
    assert 180 < len(public) <= 210, len(public)


def test_type_checkers_see_what_is_there():
    """The imports for type checkers name each public name, from the module that it is loaded from."""
    tree = ast.parse(Path(sd.__file__).read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    homes = {
        alias.name: node.module.removeprefix("strapdown").removeprefix(".")
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module != "typing"
        for alias in node.names
    }
    assert set(homes) == set(dir(sd))
    assert {name: home for name, home in homes.items() if home} == sd._HOMES


def python(*arguments, **options):
    """Return the words that another interpreter prints."""
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60, **options).stdout.split()


def test_import_loads_nothing_else():
    code = "import sys; before = set(sys.modules); import strapdown; print(sorted(set(sys.modules) - before))"
    assert python("-c", code) == ["['strapdown']"]


# ----------------------------------------------------------------------------------------------------------------- the program


def test_python_dash_m_is_the_program_and_the_script_too():
    assert python("-m", "strapdown", "--version") == ["strapdown", sd.__version__]
    (script,) = importlib.metadata.entry_points(group="console_scripts", name="strapdown")
    assert script.value == "strapdown.__main__:main"


def test_shells_complete_commands():
    """As a shell asks: the words so far in the environment, the program's own name before them."""
    words = {"_STRAPDOWN_COMPLETE": "complete_bash", "COMP_WORDS": "strapdown mon", "COMP_CWORD": "1"}
    code = "import sys; sys.argv = ['strapdown']; from strapdown.__main__ import main; main()"
    assert python("-c", code, env={**os.environ, **words}) == ["montecarlo"]
