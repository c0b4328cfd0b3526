"""Recordings with one convention broken: the check names it; whole ones it finds as declared; poor ones it does not call wrong."""

import json
import math
import warnings
from dataclasses import replace

import h5py
import numpy as np
import pytest
from test_ahrs import late

import strapdown as sd
from strapdown import motion, quaternion, recordings, vectors
from strapdown.ahrs import check_conventions
from strapdown.ahrs.check_conventions import AXES, FRAMES
from strapdown.checks import Hint, InputError
from strapdown.cli.terminal import option
from strapdown.recordings import Recording, sensor_delays
from strapdown.units import STANDARD_GRAVITY

EAST_NORTH_UP_FIELD = np.array([0.0, 18e-6, -45e-6])


def simulated(seed: int = 0, *, duration: float = 60.0, amplitude: float = 1.0, reference: bool = True) -> Recording:
    """A hand-held motion with the noise and the bias of a consumer sensor, and accelerations of a hand."""
    random = np.random.default_rng(seed)
    waves = [
        motion.Harmonic(amplitude=amplitude * random.uniform(-1.5, 1.5, 3), frequency=f, phase=random.uniform(0.0, 6.0))
        for f in (0.13, 0.29, 0.53)
    ]
    start = quaternion.normalize(random.standard_normal(4))
    body = motion.HarmonicRates(harmonics=waves, initial_attitude=start)
    time = np.arange(round(duration * 100.0)) / 100.0
    shake = [random.uniform(0.5, 3.0, 3), random.uniform(0.5, 2.0, 3)]

    def acceleration(t: np.ndarray) -> np.ndarray:
        return shake[0] * np.sin(2.0 * np.pi * shake[1] * t[:, None])

    force = vectors.specific_force(body, time, acceleration_f=acceleration)
    field = quaternion.rotate(quaternion.conjugate(body.attitude(time)), EAST_NORTH_UP_FIELD)
    return Recording(
        source="simulated",
        time=time,
        rate=body.body_rate(time) + 0.01 + 0.01 * random.standard_normal((len(time), 3)),
        specific_force=force + 0.05 * random.standard_normal(force.shape),
        magnetic_field=field + 5e-7 * random.standard_normal(field.shape),
        true_attitude=body.attitude(time) if reference else None,
    )


def read_as(matrix: np.ndarray) -> str:
    """What the check says of a sensor whose axes were changed by ``matrix``: the inverse brings them back."""
    if np.array_equal(matrix, -np.eye(3)):
        return "inverted"
    return f"axes ({check_conventions.axes_words(matrix.T)})"


def conjugated(q: np.ndarray) -> np.ndarray:
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def broken(recording: Recording, seed: int) -> dict[str, tuple[Recording, str]]:
    """One mistake each, with what must be said."""
    random = np.random.default_rng([seed, 1])
    gyro, force, field, unit = (AXES[k] for k in random.integers(1, len(AXES), 4))
    assert recording.specific_force is not None
    assert recording.magnetic_field is not None
    f, m, w = recording.specific_force, recording.magnetic_field, recording.rate
    cases = {
        "gyro axes": (replace(recording, rate=w @ gyro.T), f"gyro {read_as(gyro)}"),
        "gyro sign": (replace(recording, rate=-w), "gyro inverted"),
        "gyro too large": (replace(recording, rate=w * 180.0 / np.pi), "gyro in deg/s"),
        "gyro too small": (replace(recording, rate=w * np.pi / 180.0), "gyro in rad/s"),
        "force in mg": (replace(recording, specific_force=f * 1e3 / 9.80665), "accelerometer in mg"),
        "force in mm/s²": (replace(recording, specific_force=f * 1e3), "accelerometer in mm/s2"),
        "force in g": (replace(recording, specific_force=f / 9.80665), "accelerometer in g ("),
        "force twice": (replace(recording, specific_force=f * 9.80665), "accelerometer in m/s2"),
        "force axes": (replace(recording, specific_force=f @ force.T), f"accelerometer {read_as(force)}"),
        "field axes": (replace(recording, magnetic_field=m @ field.T), f"magnetometer {read_as(field)}"),
    }
    if recording.true_attitude is not None:
        q = recording.true_attitude
        cases |= {
            "force inverted": (replace(recording, specific_force=-f), "accelerometer inverted"),
            "conjugated": (replace(recording, true_attitude=conjugated(q)), "reference conjugated"),
            "scalar last": (replace(recording, true_attitude=np.roll(q, -1, axis=1)), "reference scalar-last"),
            "both": (
                replace(recording, true_attitude=np.roll(conjugated(q), -1, axis=1)),
                "reference scalar-last and conjugated",
            ),
            "whole unit": (
                replace(recording, rate=w @ unit.T, specific_force=f @ unit.T, magnetic_field=m @ unit.T),
                f"whole unit {read_as(unit)}",
            ),
        }
        for frame in ("North-East-Down", "North-West-Up"):
            to_frame = quaternion.from_matrix(FRAMES[frame].T)
            known = np.isfinite(q).all(axis=1)
            other = np.full(q.shape, np.nan)
            other[known] = quaternion.multiply(to_frame, q[known])
            cases[frame] = (replace(recording, true_attitude=other), f"reference in {frame}")
    return cases


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 10))])
@pytest.mark.parametrize("reference", [True, False], ids=["reference", "sensors alone"])
def test_one_mistake_in_a_simulated_recording_is_named(seed, reference):
    recording = simulated(seed, reference=reference)
    assert check_conventions.examine(recording).verdict == "as declared"
    for name, (wrong, words) in broken(recording, seed).items():
        examination = check_conventions.examine(wrong)
        assert examination.verdict == "wrong convention", name
        assert max(map(len, examination.listing().lines)) <= 100, name  # a terminal's
        # Without a reference a sensor inverted as a whole fits as well, and is reported beside.
        assert words in " ".join([examination.reason, *(() if reference else examination.notes)]), (
            name,
            examination.reason,
        )


def test_the_axes_of_a_unit_that_is_swung_until_it_clips_are_not_doubted():
    """As a phone in the hand of a runner: the acceleration is along one axis of the body, and its mean is not zero."""
    recording = simulated(2)
    swing = np.outer(np.abs(np.sin(6.0 * recording.time)), [-17.6, 5.3, -3.5])
    swung = replace(recording, specific_force=np.clip(recording.specific_force + swing, -19.6, 19.6))
    assert check_conventions.examine(swung).verdict == "as declared"
    swapped = replace(swung, specific_force=swung.specific_force[:, [1, 0, 2]])
    assert check_conventions.examine(swapped).verdict == "wrong convention"
    assert not check_conventions.examine(replace(swung, specific_force=1.8 * swung.specific_force)).doubts


@pytest.mark.parametrize("number", [1, pytest.param(None, marks=pytest.mark.slow)], ids=["first", "all"])
def test_one_mistake_in_a_broad_trial_is_named(broad, number):
    for k, path in enumerate(sorted(broad.glob("*.hdf5"))[:number]):
        whole = recordings.read(path)
        for recording in (whole, replace(whole, true_attitude=None)):
            plain = check_conventions.examine(recording)
            assert plain.verdict == "as declared" or (recording is not whole and plain.verdict == "cannot tell")
            for name, (wrong, words) in broken(recording, k).items():
                examination = check_conventions.examine(wrong)
                if recording is not whole and examination.verdict == "cannot tell":
                    continue  # the unit is hardly turned there
                said = " ".join([examination.reason, *(() if recording is whole else examination.notes)])
                assert words in said, (path.name, name, examination.reason)


def test_two_mistakes_are_named_together():
    recording = simulated(4)
    wrong = replace(recording, true_attitude=conjugated(recording.true_attitude), rate=recording.rate * 180.0 / np.pi)
    examination = check_conventions.examine(wrong)
    assert "conjugated" in examination.reason
    assert "gyro in deg/s" in examination.reason


def test_the_gyro_and_the_accelerometer_alone():
    recording = replace(simulated(5, reference=False), magnetic_field=None)
    assert check_conventions.examine(recording).verdict == "as declared"
    examination = check_conventions.examine(replace(recording, rate=-recording.rate))
    assert examination.reason.startswith("gyro inverted")
    swapped = replace(recording, rate=recording.rate[:, [1, 0, 2]])
    examination = check_conventions.examine(swapped)
    assert examination.verdict == "wrong convention"
    assert "axes (y, x, z)" in " ".join([examination.reason, *examination.notes])
    assert any("which of the two" in note for note in examination.notes)


def test_a_recording_that_does_not_turn_cannot_tell():
    for reference in (True, False):
        recording = simulated(6, amplitude=1e-4, reference=reference)
        examination = check_conventions.examine(recording)
        assert examination.verdict == "cannot tell"
        assert examination.doubts == ()
        # gravity shows the unit of the accelerometer all the same
        for factor, words in ((STANDARD_GRAVITY, "in m/s2"), (1.0 / STANDARD_GRAVITY, "in g")):
            examination = check_conventions.examine(
                replace(recording, specific_force=factor * recording.specific_force)
            )
            assert examination.verdict == "cannot tell"
            assert any(words in doubt for doubt in examination.doubts)


def test_the_fastest_windows_decide_after_a_long_rest():
    moving = broken(simulated(3, reference=False), 3)["force axes"][0]
    rest = round(4.0 * check_conventions.SPAN * check_conventions.WINDOWS * 100.0)

    def after_rest(samples: np.ndarray | None) -> np.ndarray:
        assert samples is not None
        return np.concatenate([np.tile(samples[0], (rest, 1)), samples])

    examination = check_conventions.examine(
        Recording(
            source="rest, then motion",
            time=np.arange(rest + len(moving.time)) / 100.0,
            rate=np.concatenate([np.zeros((rest, 3)), moving.rate]),
            specific_force=after_rest(moving.specific_force),
            magnetic_field=after_rest(moving.magnetic_field),
        )
    )
    assert examination.verdict == "wrong convention"
    assert "accelerometer axes" in examination.reason


def test_noise_is_no_convention():
    recording = simulated(7)
    random = np.random.default_rng(0)
    other = quaternion.normalize(random.standard_normal(recording.true_attitude.shape))
    examination = check_conventions.examine(replace(recording, true_attitude=other))
    assert examination.verdict == "cannot tell"
    assert "no explanation tried fits" in examination.reason


def test_missing_rows_are_left_out():
    recording = simulated(8)
    holes = {
        name: np.where(np.arange(len(recording.time))[:, None] % 5 == k, np.nan, getattr(recording, name))
        for k, name in enumerate(("specific_force", "magnetic_field", "true_attitude"))
    }
    for name, (wrong, words) in broken(replace(recording, **holes), 8).items():
        assert words in check_conventions.examine(wrong).reason, name


def test_a_magnetometer_slower_than_the_gyro_is_checked():
    recording = simulated(9, reference=False)
    field = np.full_like(recording.magnetic_field, np.nan)
    field[1::4] = recording.magnetic_field[1::4, [1, 0, 2]] * [1.0, -1.0, 1.0]
    assert "magnetometer axes" in check_conventions.examine(replace(recording, magnetic_field=field)).reason


def test_a_gyro_alone_is_refused():
    bare = replace(simulated(0, duration=2.0, reference=False), specific_force=None, magnetic_field=None)
    with pytest.raises(InputError, match=r"has only a gyro; .* name its columns, as in `columns={'ax': 'NAME'}`"):
        check_conventions.examine(bare)


def test_a_force_in_no_unit_is_noted():
    recording = simulated(9)
    examination = check_conventions.examine(replace(recording, specific_force=recording.specific_force / 3.0))
    assert any("is not gravity in" in doubt for doubt in examination.doubts)


def test_an_acceleration_without_gravity_is_named():
    whole = simulated(9)
    gravity = quaternion.rotate(quaternion.conjugate(whole.true_attitude), [0.0, 0.0, STANDARD_GRAVITY])
    linear = replace(whole, specific_force=whole.specific_force - gravity, true_attitude=None)
    for recording in (linear, replace(linear, magnetic_field=None)):
        examination = check_conventions.examine(recording)
        assert examination.verdict == "cannot tell"
        assert "is not gravity" in " ".join(examination.warnings)
        assert "axes" not in " ".join(examination.warnings)
        assert "fits as well" not in " ".join(examination.notes)


def test_rates_beyond_any_gyro_are_doubted():
    recording = simulated(9)
    assert check_conventions.examine(recording).doubts == ()
    rate = recording.rate.copy()
    rate[700, 1] = -1.5e3
    (doubt,) = check_conventions.examine(replace(recording, rate=rate)).doubts
    assert "8.59e+04 °/s at 7 s, and 0.02% of its samples exceed" in doubt


@pytest.mark.parametrize("reference", [True, False])
def test_a_slow_gyro_in_mrad_per_s_is_named(reference):
    slow = simulated(9, amplitude=0.3, reference=reference)
    examination = check_conventions.examine(replace(slow, rate=1e3 * slow.rate))
    assert examination.reason == "gyro in mrad/s (`units={'gyro': 'mrad/s'}`)"
    assert examination.listing().cells[0][0] == "gyro in mrad/s"


def test_both_vectors_are_compared_at_the_same_times():
    """Four seconds of the accelerometer lost in a fast window, whose place another window then takes."""
    whole = simulated(1, duration=240.0, reference=False)
    force = whole.specific_force.copy()
    force[400:800] = np.nan
    whole, lost = (check_conventions.examine(x) for x in (whole, replace(whole, specific_force=force)))
    spread = [x.candidates[0].misfit["accelerometer and magnetometer"] for x in (whole, lost)]
    assert spread[1] < 2.0 * spread[0]


def test_all_axes_are_signed_permutations_the_identity_first():
    assert np.array_equal(AXES[0], np.eye(3))
    assert len({matrix.tobytes() for matrix in AXES}) == 48
    assert all(np.array_equal(matrix @ matrix.T, np.eye(3)) for matrix in AXES)
    assert check_conventions.axes_words(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])) == "y, −x, z"


@pytest.mark.parametrize(
    ("behind", "start"),
    [(0.0, "The magnetometer shows no"), (0.011, "The magnetometer's"), (-0.2, "The magnetometer's")],
)
def test_the_delay_of_the_magnetometer_is_noted_as_the_smoother_compensates_it(behind, start):
    recording = late(field=behind)
    note = check_conventions.examine(recording).notes[-1]
    assert note == sd.ahrs.estimate(recording, smooth=True).delays.field_words
    assert note.startswith(start)
    assert "σ 0." in note
    if behind:
        assert float(note.partition(" come ")[2].split()[0]) == pytest.approx(1e3 * abs(behind), abs=1.0)
        assert f"ms {'after' if behind > 0.0 else 'before'} the gyro's" in note


@pytest.mark.parametrize(
    ("mistake", "status", "verdict"),
    [(None, 0, "as declared"), ("conjugated", 1, "wrong convention"), ("force twice", 1, "wrong convention")],
)
def test_doctor_ends_with_the_status_of_the_verdict(run, tmp_path, mistake, status, verdict):
    recording = simulated(1, duration=30.0)
    if mistake:
        recording = broken(recording, 1)[mistake][0]
    with h5py.File("trial.hdf5", "w") as file:
        file.attrs["sampling_rate"] = 100.0
        file["imu_gyr"], file["imu_acc"] = recording.rate, recording.specific_force
        file["imu_mag"], file["opt_quat"] = recording.magnetic_field, recording.true_attitude
    ended, said, _ = run("doctor", "trial.hdf5", "--json", "doctor.json")
    assert ended == status
    assert f"trial.hdf5: {verdict}: " in said
    rows = said.partition("Explanations")[2].partition("Note:")[0]
    assert not any(
        option in rows for option in ("--axes", "--invert", "--units")
    )  # the options are said once, with the verdict
    saved = json.loads((tmp_path / "doctor.json").read_text())
    assert saved["verdict"] == verdict
    assert saved["candidates"][0]["score"] >= saved["candidates"][1]["score"]


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        ({}, ""),
        ({"specific_force": np.eye(3) / 3.0}, "is not gravity in m/s², g, mm/s² or mg"),
        ({"rate": np.eye(3) * 180.0 / np.pi}, "`units={'gyro': 'deg/s'}`"),
    ],
)
def test_python_warns_of_what_the_command_warns_of(run, mistake, words):
    right = simulated(11, duration=30.0, reference=False)
    wrong = replace(right, **{name: getattr(right, name) @ matrix.T for name, matrix in mistake.items()})
    recordings.write(wrong, "walk.csv")
    said = [line for line in run("estimate", "walk.csv")[1].splitlines() if line.startswith("warning: ")]
    assert len(said) == bool(words)
    walk = sd.read("walk.csv")
    for use in (sd.estimate, sd.smooth, sd.tune):
        with warnings.catch_warnings(record=True) as entries:
            warnings.simplefilter("always")
            use(walk)
        advice = "See `strapdown doctor`, with the same file and its options."
        assert [f"warning: {Hint.replaced(str(entry.message), option)}. {advice}" for entry in entries] == said
        assert all(entry.category is sd.ahrs.ConventionWarning for entry in entries)
    assert all(Hint.replaced(words, option) in line for line in said)


@pytest.mark.parametrize("angle", [0.03, 0.1])
def test_misfits_have_their_closed_forms(angle):
    """Of a reference turned by an angle about East or Up, and of a gyro whose scale factor is off, all without noise."""
    body = motion.HarmonicRates(harmonics=[motion.Harmonic(amplitude=(0.9, -0.7, 0.8), frequency=0.2)])
    time = np.arange(6000) / 100.0
    right = body.attitude(time)

    def misfit(axis: tuple[float, float, float], scale: float = 1.0) -> list[float]:
        back = quaternion.conjugate(right)
        recording = Recording(
            source="exact",
            time=time,
            rate=scale * body.body_rate(time),
            specific_force=quaternion.rotate(back, np.array([0.0, 0.0, 9.80665])),
            magnetic_field=quaternion.rotate(back, EAST_NORTH_UP_FIELD),
            true_attitude=quaternion.multiply(quaternion.exp(angle * np.array(axis)), right),
        )
        best = check_conventions.examine(recording).candidates[0]
        assert best.changes == ()
        logs = [math.log(value + check_conventions.FLOORS["reference"]) for value in best.misfit.values()]
        assert best.score == pytest.approx(
            -1.5 * check_conventions.INDEPENDENT * sum(logs)
        )  # of 20 vectors of unknown variance
        return [best.misfit[name] for name in ("gyro", "accelerometer", "magnetometer")]

    _, north, up = EAST_NORTH_UP_FIELD / np.linalg.norm(EAST_NORTH_UP_FIELD)
    declined = 1.0 - math.hypot(north * math.cos(angle), up)
    scale = angle**2 / ((1.0 + angle) ** 2 + 1.0)
    assert misfit((1.0, 0.0, 0.0)) == pytest.approx([0.0, 1.0 - math.cos(angle), 0.0], abs=1e-9)
    assert misfit((0.0, 0.0, 1.0)) == pytest.approx([0.0, 0.0, declined], abs=1e-9)
    assert misfit((0.0, 0.0, 0.0), 1.0 + angle) == pytest.approx([scale, 0.0, 0.0], rel=1e-3, abs=1e-6)


def test_the_misfit_of_unrelated_directions_is_one():
    """cos of the angle between two random directions is uniform: its variance is a third."""
    u = np.random.default_rng(3).standard_normal((2, 5000, 3))
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    vectors = dict(zip(("accelerometer", "magnetometer"), u, strict=True))
    misfits = check_conventions._fixed_misfits(vectors, dict.fromkeys(vectors, np.ones(5000, int)))
    assert misfits["gyro and magnetometer"] == pytest.approx(0.0, abs=1e-12)
    assert misfits["accelerometer and magnetometer"] == pytest.approx(1.0, rel=0.05)


def test_a_large_sigma_of_the_delay_is_printed_without_exponent():
    delays = sensor_delays.Delays(gyro=0.005, sigma=0.002, field=0.0, field_sigma=0.0743, is_specified=False)
    assert "σ 74 ms" in delays.field_words
