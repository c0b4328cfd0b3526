"""Estimates of other filters against a truth: clocks, frames and the reading of their covariance found, faults named."""

import json
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
import scipy.stats
from measured import waves
from scipy.spatial.transform import Rotation
from ulog_writer import message as ulog_message

import strapdown as sd
from sims import peer_judged
from strapdown import consistency, montecarlo, quaternion, recordings, records, report, scenarios, vectors
from strapdown.checks import InputError
from strapdown.consistency import alignment, foreign
from strapdown.estimation import setup
from strapdown.gyro import GyroSpec
from strapdown.motion import SpinCone
from strapdown.recordings import attitudes, recordfiles
from strapdown.recordings.attitudes import Attitudes, read_attitudes
from strapdown.records import Truth
from strapdown.records.outputs import euler, euler_axes, to_ned
from strapdown.units import DEGREE, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR

FLIGHT = scenarios.Scenario(
    motion=waves(((0.3, 0.1, 0.0), 0.07), ((0.0, 0.2, 0.25), 0.11, 1.0), mean=(0.02, -0.03, 0.05)),
    # A gyro so poor that errors forget each other within seconds: one run then has much power.
    gyro=GyroSpec(angle_random_walk=20.0 * DEGREE_PER_ROOT_HOUR, rate_random_walk=20.0 * DEGREE_PER_HOUR_PER_ROOT_HOUR),
    sensors=(
        vectors.VectorSensor(name="fine", reference_f=np.array([0.0, 0.6, 0.8]), sigma=0.2 * DEGREE, rate=1.0),
        vectors.VectorSensor(name="coarse", reference_f=np.array([0.8, 0.0, -0.6]), sigma=2.0 * DEGREE, rate=1.0),
    ),
    rate=10.0,
    duration=150.0,
)


@pytest.fixture(scope="module")
def replayed():
    plan = montecarlo.Plan(
        scenario=FLIGHT, setup=setup.FilterSetup.for_scenario(FLIGHT, states=False), seed=5, epochs=20
    )
    return montecarlo.replay(plan, 0, machine="scalar")


def checked(replayed, **changes):
    """The verdict on the run's estimate against its truth, with changes of either."""
    e, t = replayed.estimate, replayed.record.truth
    arrays = {"time": e.time, "attitude": e.attitude, "covariance": e.covariance, "true_time": e.time}
    arrays |= {"true_attitude": t.attitude, "bias": e.bias, "true_bias": t.bias, "innovations": e.innovations}
    return check_arrays(**{**arrays, **changes})


def check_arrays(time, attitude, covariance, true_time, true_attitude, **more):
    """The verdict on arrays against a truth of arrays."""
    own = {name: more.pop(name) for name in ("bias", "innovations") if name in more}
    theirs = {name: more.pop(f"true_{name}") for name in ("bias", "movement") if f"true_{name}" in more}
    estimate = Attitudes.from_arrays(time, attitude, covariance=covariance, **own)
    return consistency.check_attitudes(estimate, Attitudes.from_arrays(true_time, true_attitude, **theirs), **more)


def carried(P, turn):
    T = np.tile(np.eye(P.shape[1]), (len(P), 1, 1))
    T[:, :3, :3] = turn
    return T @ P @ np.swapaxes(T, 1, 2)


def fixed_side(estimate):
    return carried(estimate.covariance, quaternion.to_matrix(estimate.attitude))


def statistics(judgement):
    return [
        (finding.name, finding.of, finding.value, finding.p_value, finding.rejected) for finding in judgement.findings
    ]


# ---------------------------------------------------------------------------------------------------------- our own


def test_our_own_estimate_gets_its_own_verdict(replayed):
    own = consistency.judge(replayed.estimate, replayed.record.truth)
    outcome = checked(replayed)
    assert own.verdict == "cannot tell"  # of the bias, which hardly changes in one run
    assert statistics(outcome.judgement) == statistics(own)
    assert outcome.alignment.estimated == ()
    assert outcome.error_frame == "body"
    assert outcome.frame_probability["body"] > 0.99
    assert not any(explanation.likely for explanation in outcome.explanations)


@pytest.mark.parametrize(("m", "factor", "likely"), [(400, 1.0, False), (400, 1.3, True), (10, 1.3, False)])
def test_a_factor_on_sigma_is_likely_where_it_shows(m, factor, likely):
    """Of m white errors, three each, whose mean square is exactly f² the σ²; ten do not show how they are correlated."""
    draw = np.random.default_rng(3)
    error = draw.standard_normal((m, 3))
    error *= factor / np.sqrt(np.mean(error**2))
    time, attitude = np.arange(float(m)), quaternion.normalize(draw.standard_normal((m, 4)))
    P, derivatives = (
        np.tile(1e-6 * np.eye(6), (m, 1, 1)),
        alignment.jacobian(time, attitude, Truth(attitude=attitude)),
    )
    known = foreign.explanations(1e-3 * error, P, derivatives)
    (scale,) = (explanation for explanation in known if explanation.name == foreign.SCALE)
    assert float(scale.value) == pytest.approx(factor, rel=1e-3)
    assert scale.likely == likely
    assert (scale.p_value > 0.5) == (not likely)
    assert not any(explanation.likely for explanation in known if explanation.name != foreign.SCALE)


def correlated(draw, memory, m=600):
    """Attitudes with errors of σ 1 mrad an axis and a correlation time of so many samples, and their truth."""
    truth = quaternion.exp(np.cumsum(0.1 * draw.standard_normal((m, 3)), axis=0) % 2.0)
    phi = np.exp(-1.0 / memory)
    drive = np.sqrt(1.0 - phi**2) * draw.standard_normal((m, 3))
    drive[0] = draw.standard_normal(3)
    error = scipy.signal.lfilter([1.0], [1.0, -phi], drive, axis=0)
    return quaternion.multiply(truth, quaternion.exp(-1e-3 * error)), truth


@pytest.mark.parametrize("memory", [1.0, 30.0])
def test_of_right_filters_one_in_a_hundred_is_given_a_cause(memory):
    """Slow errors look like constant ones: of 40 a rate of 1 % gives more than three with a probability of 0.001."""
    draw = np.random.default_rng(5)
    time, P = np.arange(600.0), np.tile(1e-6 * np.eye(6), (600, 1, 1))
    blamed = 0
    for _ in range(40):
        attitude, true = correlated(draw, memory)
        error = quaternion.log(quaternion.multiply(quaternion.conjugate(attitude), true))
        derivatives = alignment.jacobian(time, attitude, Truth(attitude=true))
        explanations = foreign.explanations(error, P, derivatives)
        blamed += any(explanation.likely for explanation in explanations)
    assert blamed <= 3


def test_a_rotation_of_two_sigma_is_a_likely_cause():
    draw = np.random.default_rng(6)
    attitude, truth = correlated(draw, 5.0)
    time, P = np.arange(600.0), np.tile(1e-6 * np.eye(3), (600, 1, 1))
    turned = quaternion.multiply(quaternion.exp([0.0, 0.0, 2e-3]), attitude)
    outcome = check_arrays(time, turned, P, time, truth, align="none")
    assert outcome.explanations[0].likely
    assert outcome.explanations[0].name.startswith("fixed frame rotated")
    assert [table.title for table in outcome.tables][1:] == ["Possible causes of the attitude errors"]
    assert len(replace(outcome, explanations=()).tables) == 1


def test_a_bias_held_at_zero_is_named(replayed):
    sigma = np.sqrt(np.mean(np.trace(replayed.estimate.covariance[:, 3:, 3:], axis1=1, axis2=2)))
    for factor, likely in ((2.9, False), (3.1, True)):
        bias = np.full((len(replayed.estimate.time), 3), factor * sigma / np.sqrt(3.0))
        outcome = checked(replayed, bias=np.zeros_like(bias), true_bias=bias, innovations={})
        (named,) = (explanation for explanation in outcome.explanations if explanation.name == "gyro bias held at zero")
        assert named.likely == likely
        assert named.value == f"{factor * sigma / DEGREE * 3600.0:.3g} °/h"


@pytest.fixture
def command(run):
    """``strapdown ARGUMENTS``: exit status, output and error, each in one line."""

    def in_one_line(*arguments):
        status, *texts = run(*arguments)
        return status, *(" ".join(text.split()) for text in texts)

    return in_one_line


@pytest.fixture(scope="module")
def files(replayed, tmp_path_factory):
    folder = tmp_path_factory.mktemp("foreign")
    recordfiles.write_record(folder / "record.h5", replayed.record)
    setup.write_estimate(folder / "estimate.h5", replace(replayed.estimate, truth=replayed.record.truth))
    recordings.write(replayed.estimate, folder / "estimate.csv")
    recordings.write(replayed.estimate, folder / "estimate.tum")
    # A bag holds stamps of a recording, which begins one sample after the record's first edge.
    late = replace(
        replayed.estimate,
        time=replayed.estimate.time[1:],
        attitude=replayed.estimate.attitude[1:],
        bias=replayed.estimate.bias[1:],
        variance=replayed.estimate.variance[1:],
        covariance=replayed.estimate.covariance[1:],
    )
    recordings.write(late, folder / "estimate.mcap", recording=recordings.from_record(replayed.record))
    return folder


@pytest.mark.parametrize("name", ["estimate.csv", "estimate.h5"])
def test_exported_and_read_back_it_has_the_same_verdict(replayed, files, name, command):
    status, said, _ = command("check", files / name, "--truth", files / "record.h5", "--json", files / "out.json")
    saved = json.loads((files / "out.json").read_text())
    own = consistency.judge(
        replayed.estimate if name.endswith("h5") else replace(replayed.estimate, innovations={}), replayed.record.truth
    )
    assert saved["headline"] == own.headline
    assert status == {"consistent": 0, "cannot tell": 3}[own.verdict]
    assert [(finding["name"], finding["of"]) for finding in saved["findings"]] == [
        (finding.name, finding.of) for finding in own.findings
    ]
    np.testing.assert_allclose(
        [finding["value"] for finding in saved["findings"]], [finding.value for finding in own.findings], rtol=1e-9
    )
    assert saved["alignment"]["removed"] == []
    python = consistency.check_attitudes(*map(read_attitudes, (files / name, files / "record.h5"))).judgement
    assert json.loads(json.dumps(python.summary())) == {key: saved[key] for key in python.summary()}
    assert "the file declares that its covariance is of the body error" in said


def test_sigma_that_are_upper_bounds_remain_so_with_another_truth(replayed, files, tmp_path, command):
    """σ five times too large contradict a filter, except that of a recording (``motion``), with the truth inside the file or beside it."""
    for motion, verdict in (("hand", "cannot tell"), ("", "not consistent")):
        cautious = replace(replayed.estimate, covariance=25.0 * replayed.estimate.covariance, motion=motion)
        setup.write_estimate(tmp_path / "cautious.h5", cautious)
        said = command("check", tmp_path / "cautious.h5", "--truth", files / "record.h5"
        )[1]  # fmt: skip
        assert consistency.judge(cautious, replayed.record.truth).verdict == verdict
        assert f"{verdict}: " in said
        assert ("σ are upper bounds" in said) == bool(motion)


def test_the_reference_of_a_broad_trial_is_a_truth(tmp_path):
    attitude = Rotation.random(50, random_state=0).as_quat(scalar_first=True)
    attitude[7:9] = np.nan
    recordings.write(
        recordings.Recording(
            source="trial", time=np.arange(50) / 100.0, rate=np.zeros((50, 3)), true_attitude=attitude
        ),
        tmp_path / "trial.hdf5",
    )
    reference = read_attitudes(tmp_path / "trial.hdf5")
    assert len(reference.stamps_ns) == 48
    assert reference.stamps_ns[7] == 90_000_000
    np.testing.assert_allclose(reference.attitude, attitude[np.isfinite(attitude[:, 0])], atol=1e-15)
    recordings.write(
        recordings.Recording(source="bare", time=np.arange(50) / 100.0, rate=np.zeros((50, 3))), tmp_path / "bare.hdf5"
    )
    with pytest.raises(InputError, match="without a reference attitude"):
        read_attitudes(tmp_path / "bare.hdf5")


def test_a_bag_has_the_attitude_about_fixed_axes(replayed, files, command):
    pytest.importorskip("rosbags")
    status, said, _ = command("check", files / "estimate.mcap", "--truth", files / "record.h5", "--json", files / "b.json",
        "--topic", "/imu/data",
    )  # fmt: skip
    saved = json.loads((files / "b.json").read_text())
    assert saved["error_frame"] == "fixed"
    assert saved["error_frame_probability"]["fixed"] > 0.99
    assert "the covariance is read as fixed" in said
    topics = "/imu/data,/imu/reference"
    both = command("check", files / "estimate.mcap", "--truth", files / "estimate.mcap", "--topic", topics)
    assert (both[0], "Truth: estimate.mcap" in both[1]) == (status, True), both
    of_truth = ("--truth", files / "estimate.mcap", "--topic", "/imu/reference")
    assert "Truth: estimate.mcap" in command("check", files / "estimate.tum", *of_truth)[1]
    e, t = replayed.estimate, replayed.record.truth
    cut = slice(1, None)
    alone = consistency.judge(
        replace(
            e, time=e.time[cut], attitude=e.attitude[cut], bias=np.full_like(e.bias[cut], np.nan), variance=e.variance[cut],
            covariance=e.covariance[cut], innovations={},
        ),
        Truth(attitude=t.attitude[cut], bias=t.bias[cut]),
    )  # fmt: skip
    assert (saved["verdict"], status) == (alone.verdict, {"consistent": 0, "cannot tell": 3}[alone.verdict])
    np.testing.assert_allclose(
        [finding["value"] for finding in saved["findings"]], [finding.value for finding in alone.findings], rtol=1e-6
    )


def test_a_trajectory_without_covariance_is_not_judged(files, command):
    status, said, _ = command("check", files / "estimate.tum", "--truth", files / "record.h5")
    assert status == 3
    assert "cannot tell: no covariance: nothing to test" in said
    time = setup.read_estimate(files / "estimate.h5").time
    assert f"{len(time)} attitudes over {time[-1] - time[0]:.6g} s" in said
    assert f"Attitude error over {len(time)} samples" in said
    assert "without a truth" not in said
    assert "cannot tell" in said


@pytest.mark.parametrize(("suffix", "verdict"), [("csv", "consistent"), ("tum", "No covariance: nothing to test")])
def test_what_was_judged_can_be_reported(suffix, verdict, files, replayed, command):
    out, truth = files / f"aligned-{suffix}.h5", files / "record.h5"
    status, _, _ = command("check", files / f"estimate.{suffix}", "--truth", truth, "--aligned", out)
    assert command("check", out)[0] == status == 3
    report.write(out, out.with_suffix(".html"))
    page = out.with_suffix(".html").read_text(encoding="utf-8")
    assert verdict in page
    assert "attitude error x, " in page
    held = setup.read_estimate(out)
    assert held.covariance.shape == (len(held.time), 6, 6)
    assert np.isnan(held.covariance).any() == (suffix == "tum")


def test_an_estimate_without_a_bias_is_kept_and_reported(files, replayed, tmp_path):
    e = replayed.estimate
    outcome = checked(replayed, covariance=e.covariance[:, :3, :3], bias=None, innovations={})
    out = tmp_path / "attitude.h5"
    setup.write_estimate(out, outcome.estimate)
    read = setup.read_estimate(out)
    assert not read.has_bias
    np.testing.assert_array_equal(read.covariance[:, :3, :3], e.covariance[:, :3, :3])
    assert statistics(consistency.judge(read)) == statistics(outcome.judgement)
    assert {finding.of for finding in outcome.judgement.findings} == {"attitude"}
    report.write(out, tmp_path / "attitude.html")
    page = (tmp_path / "attitude.html").read_text(encoding="utf-8")
    assert "gyro bias" not in page
    assert all("NaN" not in file.read_text() for file in tmp_path.glob("*.json"))


# ------------------------------------------------------------------------------------------------------- faults, named

HEADING = quaternion.exp(np.array([0.0, 0.0, 2.0 * DEGREE]))
MOUNTING = quaternion.exp(np.array([0.0, 1.5 * DEGREE, 0.0]))
FAULTS = {
    "too sure": ({"covariance": lambda e: e.covariance / 4.0}, "σ wrong by one factor", [2.0]),
    "too modest": ({"covariance": lambda e: e.covariance * 4.0}, "σ wrong by one factor", [0.5]),
    "late": ({"time": lambda e: e.time + 0.1, "align": "none"}, "offset of the clock, delay", [-100.0]),
    "heading": (
        {"attitude": lambda e: quaternion.multiply(HEADING, e.attitude)},
        "fixed frame rotated (heading, gravity)",
        [0.0, 0.0, -2.0],
    ),
    "mounting": (
        {"attitude": lambda e: quaternion.multiply(e.attitude, MOUNTING)},
        "body frame rotated (mounting)",
        [0.0, -1.5, 0.0],
    ),
    "fixed read as body": ({"covariance": fixed_side, "error_frame": "body"}, "covariance meant as fixed", [100.0]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_filter_is_called_wrong_and_its_fault_is_named_first(replayed, fault):
    changes, name, size = FAULTS[fault]
    arguments = {key: value(replayed.estimate) if callable(value) else value for key, value in changes.items()}
    outcome = checked(replayed, **{"error_frame": "body", "innovations": {}, **arguments})
    assert outcome.judgement.verdict == "not consistent"
    assert outcome.explanations[0].name == name, [
        (explanation.name, explanation.p_value, explanation.nees) for explanation in outcome.explanations
    ]
    assert outcome.explanations[0].likely
    assert max(map(len, outcome.listing().lines)) <= 100  # a terminal's
    assert abs(np.log(outcome.explanations[0].nees)) < np.log(1.5)
    numbers = [float(number) for number in re.findall(r"[-+.\de]+(?=[,° ]|$)", outcome.explanations[0].value)]
    np.testing.assert_allclose(numbers, size, rtol=0.1, atol=0.1)


# ------------------------------------------------------------------------------------------------- reading and aligning


def test_the_reading_of_the_covariance_is_found(replayed):
    e = replayed.estimate
    turn = np.linalg.inv(euler_axes(e.attitude)[:, :, ::-1])
    for frame, P in (("fixed", fixed_side(e)), ("euler", carried(e.covariance, turn))):
        outcome = checked(replayed, covariance=P)
        assert outcome.error_frame == frame
        assert outcome.frame_probability[frame] > 0.99
        np.testing.assert_allclose(outcome.estimate.covariance, e.covariance, atol=1e-9 * e.covariance.max())
    wrong = checked(replayed, covariance=fixed_side(e), error_frame="body", innovations={})
    assert wrong.judgement.verdict == "not consistent"
    assert any("the errors fit far better read as fixed" in words for words in wrong.remarks)


def test_equal_axes_leave_the_reading_open(replayed):
    m = len(replayed.estimate.time)
    outcome = checked(replayed, covariance=np.tile(DEGREE**2 * np.eye(3), (m, 1, 1)), bias=None)
    assert outcome.frame_probability["body"] == pytest.approx(outcome.frame_probability["fixed"], rel=1e-6)
    assert any("do not decide how the covariance is defined" in words for words in outcome.remarks)
    assert outcome.error_frame == "body"


def test_euler_axes_are_the_derivative_of_the_angles():
    q = quaternion.exp(np.random.default_rng(1).standard_normal((20, 3)))
    angles, E = euler(q).angles, euler_axes(q)
    for k in range(3):
        moved = angles.copy()
        moved[:, k] += 1e-6
        near = quaternion.from_rotation(Rotation.from_euler("ZYX", moved))
        turn = quaternion.log(quaternion.multiply(quaternion.conjugate(q), near)) / 1e-6
        np.testing.assert_allclose(E[:, :, k], turn, atol=1e-5)


F, B = quaternion.exp(np.array([0.1, 0.2, 2.0])), quaternion.exp(np.array([1.5, 0.3, -0.7]))


def test_usual_frames_are_named():
    """Attitudes as ahrs, NED libraries and forward-right-down units give them, by the directions of their axes."""
    angles = np.stack(
        [np.linspace(0.0, 6.0, 300), 0.5 * np.sin(np.arange(300) / 20.0), np.cos(np.arange(300) / 15.0)], 1
    )
    truth = Rotation.from_euler("ZYX", angles)  # forward-left-up to East-North-Up
    ned = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # East is (0, 1, 0) in North-East-Down
    nwu = Rotation.from_matrix([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # East is (0, −1, 0) in North-West-Up
    frd = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    for own, words in (
        (ned * truth, ["North-East-Down and East-North-Up"]),
        (nwu * truth, ["North-West-Up and East-North-Up"]),
        (nwu * ned.inv() * truth, ["North-West-Up and North-East-Down"]),
        (ned * truth * frd, ["North-East-Down and East-North-Up", "forward-right-down and forward-left-up"]),
        (Rotation.from_euler("z", 1.0) * truth, []),
    ):
        both = (
            recordings.Attitudes.from_arrays(np.arange(300) / 10.0, quaternion.from_rotation(q)) for q in (own, truth)
        )
        remarks = " ".join(consistency.check_attitudes(*both).remarks)
        assert re.findall(r"per axis, as ([\w-]+ and [\w-]+) do", remarks) == words


def test_frames_and_clock_are_found_and_removed(replayed):
    e = replayed.estimate
    turned = quaternion.multiply(quaternion.multiply(F, e.attitude), B)
    T = np.kron(np.eye(2), quaternion.to_matrix(quaternion.conjugate(B)))
    outcome = checked(
        replayed, time=e.time + 1e6, attitude=turned, covariance=T @ e.covariance @ T.T, bias=e.bias @ T[:3, :3].T
    )
    a = outcome.alignment
    assert a.estimated == ("time", "fixed", "body")
    for rotation, applied, rows in ((a.fixed, F, slice(0, 3)), (a.body, B, slice(3, 6))):
        off = quaternion.log(quaternion.multiply(quaternion.exp(rotation), applied))
        assert np.all(np.abs(off) < 4.5 * a.sigma[rows])
        assert np.all(a.sigma[rows] < 0.5 * DEGREE)
    assert abs(a.offset + 1e6) < 4.5 * a.sigma[6] < 0.2
    assert outcome.judgement.verdict != "not consistent"
    removed = [words for words in outcome.estimate.remarks if "removed" in words]
    assert [words.startswith("Note: for the verdict, ") for words in removed] == 3 * [True]
    assert sum("Aligned rows: " in words and "removed" in words for words in outcome.accuracy.listing().notes) == 3
    # In the truth's body axes again, but for the uncertainty of what was removed, which is part of the covariance.
    rows = np.searchsorted(e.time, outcome.estimate.time - 0.05)
    np.testing.assert_allclose(outcome.estimate.bias, e.bias[rows], atol=0.03 * np.abs(e.bias).max())
    added = outcome.estimate.covariance[:, :3, :3] - e.covariance[rows, :3, :3]
    assert np.linalg.eigvalsh(added).min() > 0.0
    assert np.trace(added.mean(axis=0)) > 3.0 * float(np.mean(a.sigma[:6] ** 2))


@pytest.mark.parametrize(
    ("convention", "words"),
    [
        (quaternion.conjugate, "the inverse, fixed"),
        (lambda q: q[:, [1, 2, 3, 0]], "read as scalar last,"),
        (lambda q: quaternion.conjugate(q)[:, [1, 2, 3, 0]], "scalar last and the inverse"),
        (lambda q: q[:, [3, 0, 1, 2]], "read as scalar first,"),  # as a TUM file with w before x is read
        (lambda q: quaternion.conjugate(q)[:, [3, 0, 1, 2]], "scalar first and the inverse"),
    ],
    ids=["conjugate", "last", "last, conjugate", "first", "first, conjugate"],
)
def test_conventions_of_quaternions_are_found(replayed, convention, words):
    e, t, every = replayed.estimate, replayed.record.truth, slice(None, None, 3)
    known = {"time": e.time[every], "true_time": e.time[every], "covariance": e.covariance[every], "innovations": {}}
    known |= {"bias": e.bias[every], "true_attitude": t.attitude[every], "true_bias": t.bias[every]}
    outcome = checked(replayed, attitude=convention(e.attitude[every]), **known)
    assert outcome.judgement.verdict != "not consistent"
    assert outcome.alignment.estimated == ()
    assert any(words in remark for remark in outcome.remarks)


@pytest.mark.parametrize("seed", [3, 24], ids=["clock", "convention"])
def test_a_bad_filter_is_not_explained_by_its_clock_or_convention(seed):
    """Errors of some degrees that drift; the motion is a cone, where a shift in time is nearly two rotations."""
    time = np.arange(150.0)
    cone = SpinCone(angle=20.0 * DEGREE, precession_rate=20.0 * DEGREE, spin_rate=-10.0 * DEGREE)
    truth = cone.attitude(time)
    drift = np.cumsum(0.6 * DEGREE * np.random.default_rng(seed).standard_normal((150, 3)), axis=0)
    own = alignment.Series(time, quaternion.multiply(truth, quaternion.exp(drift)))
    remarks = []
    aligned, removed = alignment.align_series(own, alignment.Series(time, truth), None, remarks)
    assert aligned is own
    assert (remarks, "time" in removed.estimated) == ([], False)


def test_heading_is_about_the_vertical_of_the_estimate_also_if_the_truth_has_y_up(replayed, tmp_path):
    """Cameras often have y up. The error is half a degree of heading that comes and goes, about the z axis of the estimate."""
    e, t = replayed.estimate, replayed.record.truth
    heading = 0.5 * DEGREE * np.sin(e.time)
    own = quaternion.multiply(quaternion.exp(heading[:, None] * [0.0, 0.0, 1.0]), t.attitude)
    y_up = quaternion.multiply(quaternion.exp([-np.pi / 2.0, 0.0, 0.0]), t.attitude)
    outcome = check_arrays(e.time, own, e.covariance, e.time, y_up)
    sizes = outcome.accuracy.aligned["all samples"]
    assert sizes["heading"].rms == pytest.approx(np.std(heading), rel=0.01)  # its mean is removed
    assert sizes["inclination"].rms < 0.05 * sizes["heading"].rms
    assert any("heading is about z of the estimate" in remark for remark in outcome.remarks)
    sd.write(outcome.estimate, tmp_path / "aligned.h5")
    again = sd.accuracy(sd.read(tmp_path / "aligned.h5")).given["all samples"]
    assert again["inclination"].rms < 0.05 * again["heading"].rms
    assert not any("heading is about z" in remark for remark in checked(replayed).remarks)


@pytest.mark.parametrize(("align", "heading"), [("time,fixed", 0.0), ("time", 2.0), ("none", None)])
def test_the_errors_are_those_of_the_alignment_that_was_asked_for(align, heading, replayed):
    """Two degrees of heading are removed with the fixed frame only; by default all differences are."""
    attitude = quaternion.multiply(HEADING, replayed.record.truth.attitude)
    sizes = checked(replayed, attitude=attitude, align=align).accuracy.aligned
    if heading is None:
        assert sizes == {}
    else:
        assert sizes["all samples"]["heading"].rms == pytest.approx(heading * DEGREE, abs=0.5 * DEGREE)
    assert checked(replayed, attitude=attitude).accuracy.aligned["all samples"]["heading"].rms < 1e-6


def test_errors_after_alignment_are_measured_by_their_covariance(tmp_path):
    """Errors drawn from a known P, unequal over axes and time; frames and clock of the truth differ: 95 % in the region, RMS/σ 1."""
    m, shift = 4000, 0.3
    time, random = 0.05 * np.arange(m), np.random.default_rng(12)
    factor = DEGREE * np.array([[0.5, 0.0, 0.0], [-0.3, 1.0, 0.0], [0.6, -0.8, 3.0]])
    factor = factor * (1.0 + 0.5 * np.sin(0.1 * time))[:, None, None]
    P = factor @ np.swapaxes(factor, 1, 2)
    exact = quaternion.multiply(quaternion.multiply(F, FLIGHT.motion.attitude(time + shift)), B)
    error = np.einsum("mij,mj->mi", factor, random.standard_normal((m, 3)))
    attitude = quaternion.multiply(exact, quaternion.exp(-error))
    stamps = np.arange(0.0, 201.0, 0.02)
    truth, own = FLIGHT.motion.attitude(stamps), Attitudes.from_arrays(time, attitude, covariance=P)
    estimate = records.Estimate.from_arrays(time, attitude, P)
    stored = Truth(attitude=FLIGHT.motion.attitude(time))
    of_fixed = Attitudes.from_arrays(time, attitude, covariance=carried(P, quaternion.to_matrix(attitude)))
    sd.write(replace(estimate, truth=stored), tmp_path / "estimate.h5")
    report.write(tmp_path / "estimate.h5")
    page = json.loads((tmp_path / "estimate.report.json").read_text())["accuracy"]
    tables = [
        consistency.check_attitudes(own, Attitudes.from_arrays(stamps, truth), error_frame="body").accuracy.summary(),
        consistency.check_attitudes(
            of_fixed, Attitudes.from_arrays(stamps, truth), error_frame="fixed"
        ).accuracy.summary(),
        sd.accuracy(estimate, Attitudes.from_arrays(stamps, truth)).summary(),
        sd.accuracy(estimate, stored).summary(),
        page,
    ]
    for table in tables:
        for part, degrees in (("total", 3), ("heading", 1), ("inclination", 2)):
            size = table["aligned"]["all samples"][part]
            assert size["coverage"] == pytest.approx(0.95, abs=3.5 * np.sqrt(0.95 * 0.05 / m))
            assert size["rms_over_sigma"] == pytest.approx(1.0, abs=3.5 * np.sqrt(0.5 / (degrees * m)))
    shown = sd.accuracy(estimate, stored).listing()
    assert {row[1] for row in shown.rows if row[6]} == {"as given", "aligned"}


def test_large_rotations_of_both_frames_are_found_in_the_slowest_motion():
    time = 1e3 * np.arange(200.0)
    truth = FLIGHT.motion.attitude(np.linspace(0.0, 100.0, 200))
    for seed in (0, 6, 11):
        fixed, body = quaternion.normalize(np.random.default_rng(seed).standard_normal((2, 4)))
        own = quaternion.multiply(fixed, quaternion.multiply(truth, body))
        fitted = alignment.fit(alignment.Series(time, own), alignment.Series(time, truth), ("fixed", "body"), 0.0)
        assert fitted.residual < 1e-9


def test_a_clock_alone_is_found_far_from_its_start():
    """Half a second off in the fastest motion, by steps until none changes it."""
    stamps = np.arange(0.0, 60.0, 0.01)
    time, truth = stamps[500:5000:10], alignment.Series(stamps, FLIGHT.motion.attitude(stamps))
    own = alignment.Series(time - 0.5, FLIGHT.motion.attitude(time))
    assert alignment.fit(own, truth, ("time",), 0.0).offset == pytest.approx(0.5, abs=1e-9)


def test_sigma_of_the_alignment_is_honest():
    """White errors of 1° an axis, 30 draws of seven parameters: their squares over their covariance are χ² of seven degrees."""
    time = np.arange(0.0, 60.0, 0.2)
    stamps = np.arange(-5.0, 65.0, 0.05)
    truth, exact = alignment.Series(stamps, FLIGHT.motion.attitude(stamps)), FLIGHT.motion.attitude(time)
    squares = []
    for seed in range(30):
        noise = DEGREE * np.random.default_rng([7, seed]).standard_normal((len(time), 3))
        own = quaternion.multiply(exact, quaternion.exp(noise))
        a = alignment.fit(alignment.Series(time, own), truth, alignment.ALIGNED, 0.0)
        x = np.concatenate([a.fixed, a.body, [a.offset]])
        squares.append(x @ np.linalg.solve(a.covariance, x) / 7.0)
    low, high = consistency.mean_bounds(7, 30, 0.999)
    assert low < np.mean(squares) < high * 1.1  # the scatter is estimated, 900 residuals


@pytest.mark.parametrize("correlation", [0.6, 0.9])
def test_sigma_of_an_alignment_is_honest_with_correlated_errors(correlation):
    """Errors of first order, 40 draws of three parameters: with the effective samples of the squares, σ would be up to √2 too small."""
    time = np.arange(0.0, 600.0, 0.2)
    exact = quaternion.exp(0.3 * np.sin(np.outer(time, [0.3, 0.2, 0.11])))
    truth = alignment.Series(time, exact)
    squares = []
    for seed in range(40):
        drawn = np.random.default_rng([8, seed]).standard_normal((len(time), 3))
        drawn[1:] *= np.sqrt(1.0 - correlation**2)
        noise = scipy.signal.lfilter([1.0], [1.0, -correlation], drawn, axis=0)
        own = alignment.Series(time, quaternion.multiply(exact, quaternion.exp(DEGREE * noise)))
        a = alignment.fit(own, truth, ("body",), 0.0)
        squares.append(a.body @ np.linalg.solve(a.covariance[3:6, 3:6], a.body) / 3.0)
    low, high = consistency.mean_bounds(3, 40, 0.999)
    assert low < np.mean(squares) < high * 1.05  # the scatter and its correlation are estimated


def test_a_sparser_truth_is_taken_at_its_own_times(replayed):
    t = replayed.record.truth
    every = slice(3, None, 20)
    outcome = checked(
        replayed, true_time=replayed.estimate.time[every], true_attitude=t.attitude[every], true_bias=t.bias[every]
    )
    assert len(outcome.estimate.time) == len(replayed.estimate.time[every])
    np.testing.assert_allclose(outcome.estimate.attitude, replayed.estimate.attitude[every], atol=1e-12)
    for before in (0.03, -0.03):  # between the estimate's times: its covariance is that of the nearest
        off = {"true_time": replayed.estimate.time[every] + before, "align": "none", "error_frame": "body"}
        off |= {"true_attitude": FLIGHT.motion.attitude(off["true_time"]), "true_bias": t.bias[every]}
        np.testing.assert_array_equal(checked(replayed, **off).estimate.covariance, replayed.estimate.covariance[every])


def test_times_in_another_unit_are_reported(replayed):
    remark = checked(replayed, time=1e2 * replayed.estimate.time, align="none").remarks[0]
    assert "times in common; check the unit of time" in remark
    assert not any("unit of time" in words for words in checked(replayed).remarks)


def test_what_is_asked_for_is_removed(replayed):
    turned = quaternion.multiply(HEADING, replayed.estimate.attitude)
    outcome = checked(replayed, attitude=turned, align="fixed", error_frame="body")
    assert outcome.alignment.estimated == ("fixed",)
    assert outcome.judgement.verdict != "not consistent"


# ---------------------------------------------------------------------------------------------------------------- files


def flight_log(path, replayed, old=True):
    """A log of PX4's estimator, written byte by byte: states, variances, innovations; a second instance that never turned.

    Returns the variances of the quaternion in PX4's axes, and Ξ of its errors by finite differences, δq = ½ Ξ δθ.
    """
    e = replayed.estimate
    stamps = np.rint(1e6 * e.time).astype(np.int64)
    number = 24 if old else 23
    layouts = {
        "estimator_states": f"uint64_t timestamp;uint64_t timestamp_sample;float[24] states;float[{number}] covariances;uint8_t n_states;",
        "estimator_innovations": "uint64_t timestamp;float[3] gravity;float heading;",
        "estimator_innovation_variances": "uint64_t timestamp;float[3] gravity;float heading;",
    }
    content = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), ulog_message("B", bytes(40))]
    content += [ulog_message("F", f"{name}:{text}".encode()) for name, text in layouts.items()]
    content += [ulog_message("A", struct.pack("<BH", 0, k) + name.encode()) for k, name in enumerate(layouts)]
    content.append(ulog_message("A", struct.pack("<BH", 1, 3) + b"estimator_states"))
    ned = to_ned(e.attitude)
    turns = quaternion.exp(1e-6 * np.eye(3))
    xi = np.stack([(quaternion.multiply(ned, turn) - ned) / 0.5e-6 for turn in turns], axis=2)
    variances = np.einsum("mqi,mij,mqj->mq", 0.5 * xi, e.covariance[:, :3, :3], 0.5 * xi)
    random = np.random.default_rng(2)
    for k, stamp in enumerate(stamps.tolist()):
        states, covariances = np.zeros(24), np.ones(number)
        states[:4], covariances[:4] = ned[k], variances[k] if old else 1e-4
        row = struct.pack("<QQ24f", stamp, stamp, *states) + struct.pack(f"<{number}fB", *covariances, number)
        content.append(ulog_message("D", struct.pack("<H", 0) + row))
        level = struct.pack("<24f", 1.0, *np.zeros(23))
        content.append(ulog_message("D", struct.pack("<H", 3) + row[:16] + level + row[16 + len(level) :]))
        if k % 10 == 0:
            values = np.append(0.1 * random.standard_normal(3), 0.02 * random.standard_normal())
            content.append(ulog_message("D", struct.pack("<HQ4f", 1, stamp, *values)))
            content.append(ulog_message("D", struct.pack("<HQ4f", 2, stamp, 0.01, 0.01, 0.01, 4e-4)))
    path.write_bytes(b"".join(content))
    return variances, xi


def test_a_flight_log_is_read_and_judged(replayed, tmp_path, command):
    pytest.importorskip("pyulog")
    log = tmp_path / "flight.ulg"
    variances, xi = flight_log(log, replayed)
    read = read_attitudes(log)
    np.testing.assert_allclose(np.abs(np.sum(read.attitude * replayed.estimate.attitude, axis=1)), 1.0, atol=1e-6)
    # The diagonal of the quaternion's covariance loses the correlations, not the trace: tr P_q = ¼ tr P_θ.
    np.testing.assert_allclose(
        np.trace(read.covariance, axis1=1, axis2=2),
        np.trace(replayed.estimate.covariance[:, :3, :3], axis1=1, axis2=2),
        rtol=0.6,
    )
    exact = 4.0 * np.einsum("mqi,mq,mqj->mij", xi, variances, xi)
    np.testing.assert_allclose(read.covariance, exact, rtol=1e-4, atol=1e-5 * exact.max())
    assert set(read.innovations) == {"gravity", "heading"}
    status, said, _ = command("check", log)
    assert status == 3
    assert (
        "cannot tell: innovations consistent; attitude not testable" in said
        or "innovations consistent; attitude and bias" in said
    )
    recordfiles.write_record(tmp_path / "record.h5", replayed.record)
    _, said, _ = command("check", log, "--truth", tmp_path / "record.h5")
    assert "NEES" in said
    flight_log(log, replayed, old=False)
    np.testing.assert_allclose(
        read_attitudes(log).covariance, np.tile(1e-4 * np.eye(3), (len(read.attitude), 1, 1)), rtol=1e-6
    )


def test_a_flight_log_of_the_attitude_alone_is_turned_sorted_and_has_no_covariance(tmp_path):
    """R from body axes to North-East-Down becomes M R from the same axes to East-North-Up."""
    pytest.importorskip("pyulog")
    ned = Rotation.from_rotvec(np.random.default_rng(3).standard_normal((4, 3)))
    content = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), ulog_message("B", bytes(40))]
    content.append(ulog_message("F", b"vehicle_attitude:uint64_t timestamp;float[4] q;"))
    content.append(ulog_message("A", struct.pack("<BH", 0, 0) + b"vehicle_attitude"))
    for stamp, (x, y, z, w) in zip((7000, 3000, 5000, 5000), ned.as_quat(), strict=True):
        content.append(ulog_message("D", struct.pack("<HQ4f", 0, stamp, w, x, y, z)))
    (tmp_path / "flight.ulg").write_bytes(b"".join(content))
    read = read_attitudes(tmp_path / "flight.ulg")
    assert read.stamps_ns.tolist() == [3_000_000, 5_000_000, 7_000_000]
    M = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    np.testing.assert_allclose(quaternion.to_matrix(read.attitude), M @ ned[[1, 2, 0]].as_matrix(), atol=1e-6)
    assert read.covariance is None
    assert read.innovations == {}


def test_odometry_and_poses_are_read_from_bags(replayed, tmp_path):
    """Messages made by the library itself; the covariance is the last three rows and columns of six."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    t = store.types
    e = replayed.estimate
    P = np.zeros((6, 6))
    P[3:, 3:] = np.diag([1e-4, 4e-4, 9e-4])

    def header(k):
        whole = round(1e9 * e.time[k]) + 10**18
        return t["std_msgs/msg/Header"](
            stamp=t["builtin_interfaces/msg/Time"](sec=whole // 10**9, nanosec=whole % 10**9), frame_id="map"
        )

    def pose(k, known=True):
        w, x, y, z = known * e.attitude[k]
        return t["geometry_msgs/msg/PoseWithCovariance"](
            pose=t["geometry_msgs/msg/Pose"](
                position=t["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0),
                orientation=t["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
            ),
            covariance=P.ravel(),
        )

    zero = t["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = t["geometry_msgs/msg/TwistWithCovariance"](
        twist=t["geometry_msgs/msg/Twist"](linear=zero, angular=zero), covariance=np.zeros(36)
    )
    makers = {
        "nav_msgs/msg/Odometry": lambda k: t["nav_msgs/msg/Odometry"](
            header=header(k), child_frame_id="base_link", pose=pose(k), twist=twist
        ),
        "geometry_msgs/msg/PoseWithCovarianceStamped": lambda k: t["geometry_msgs/msg/PoseWithCovarianceStamped"](
            header=header(k), pose=pose(k, known=k < 2)
        ),
    }
    folder = tmp_path / "bag"
    with rosbag2.Writer(folder, version=9) as writer:
        for kind, make in makers.items():
            connection = writer.add_connection(f"/{kind.rpartition('/')[2].lower()}", kind, typestore=store)
            for k in range(30):
                writer.write(connection, k, store.serialize_cdr(make(k), kind))
    with pytest.raises(InputError, match="several topics with orientations"):
        read_attitudes(folder)
    for topic, number in (("/odometry", 30), ("/posewithcovariancestamped", 2)):
        read = read_attitudes(folder, topic=topic)
        np.testing.assert_allclose(read.attitude, e.attitude[:number], atol=1e-12)
        np.testing.assert_array_equal(read.covariance, np.tile(P[3:, 3:], (number, 1, 1)))
        assert read.stamps_ns[1] - read.stamps_ns[0] == 10**8


@pytest.mark.parametrize(
    ("header", "row", "message"),
    [
        ("time_s,qw,qx,qy", "1,1,0,0", "four columns of a quaternion"),
        ("qw,qx,qy,qz", "1,0,0,0", "lacks time"),
        ("time_s,qw,qx,qy,qz", "1,2,0,0,0", "norm 2"),
        ("time_s,qw,qx,qy,qz,cov_xx_rad2,cov_yy_rad2", "1,1,0,0,0,1,1", "cov_zz is missing|cov_xy is missing"),
        ("time_s,qw,qx,qy,qz,cov_body_xx,cov_fixed_yy", "1,1,0,0,0,1,1", "give all of one kind"),
        ("time_s,qw,qx,qy,qz,q_w", "1,1,0,0,0,1", "has the same meaning"),
        (
            "time_s,qw,qx,qy,qz,roll_sigma_deg,pitch_sigma_deg,yaw_sigma_deg",
            "1,,,,,0,0,0\n2,1,0,0,0,3,0,3",  # a row without an attitude is not read
            "σ of pitch in data row 2 is not above zero; remove the row",
        ),
        ("time_s,qw,qx,qy,qz", "3,,,,\n4,1,0,0,0", "row 4 is not after the one before"),
    ],
)
def test_bad_tables_are_refused(tmp_path, header, row, message):
    path = tmp_path / "estimate.csv"
    path.write_text(f"{header}\n{row}\n{row.replace('1', '2', 1)}\n")
    with pytest.raises(InputError, match=message):
        read_attitudes(path)


def test_tables_of_sigma_and_of_other_units_are_read(tmp_path):
    path = tmp_path / "estimate.csv"
    row = "0,0,0,1,1,2,3"
    path.write_text(f"timestamp_us,qx,qy,qz,qw,roll_sigma_deg,pitch_sigma_deg,yaw_sigma_deg\n5,{row}\n1000005,{row}\n")
    read = read_attitudes(path)
    assert read.stamps_ns.tolist() == [5000, 1000005000]
    assert read.error_frame == "euler"
    np.testing.assert_allclose(read.covariance[0], np.diag([1.0, 4.0, 9.0]) * DEGREE**2)
    np.testing.assert_array_equal(read.attitude[0], [1.0, 0.0, 0.0, 0.0])
    names = [f"cov_body_{a}{b}_deg2" for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")]
    path.write_text(f"time_s,qw,qx,qy,qz,{','.join(names)}\n1,1,0,0,0,9,1,2,8,3,7\n2,1,0,0,0,9,1,2,8,3,7\n")
    expected = np.array([[9.0, 1.0, 2.0], [1.0, 8.0, 3.0], [2.0, 3.0, 7.0]]) * (np.pi / 180.0) ** 2
    np.testing.assert_allclose(read_attitudes(path).covariance[1], expected)


def test_a_repeated_innovation_of_a_flight_log_is_no_measurement():
    stamps = np.array([5, 6, 7, 8]) * 100_000
    values = {"timestamp": stamps, "heading": np.array([0.1, 0.1, 0.2, 0.2])}
    innovations = attitudes._ulog_innovations(values, {"timestamp": stamps, "heading": np.full(4, 4.0)}, 500_000)[
        "heading"
    ]
    np.testing.assert_allclose(innovations.time, [0.0, 0.2])
    np.testing.assert_array_equal(innovations.innovation[:, 0], [0.1, 0.2])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("estimate.tum",), "has no innovations, so it cannot be judged without a truth"),
        (("estimate.h5", "--align", "none"), "--align goes with --truth"),
        (("estimate.h5", "--topic", "/imu/data"), "--topic goes with --truth"),
        (("estimate.h5", "--json", "verdict.txt"), "--json is verdict.txt"),
        (("estimate.csv", "--truth", "record.h5", "--align", "clock"), "align"),
        (("estimate.csv", "--truth", "record.h5", "--error-frame", "ned"), "--error-frame 'ned'"),
        (("estimate.csv", "--truth", "record.h5", "--record", "record.h5"), "leave out --truth"),
        (("estimate.csv", "--truth", "nothing.h5"), "nothing.h5"),
    ],
)
def test_the_command_refuses(files, command, monkeypatch, arguments, message):
    monkeypatch.chdir(files)
    status, _, error = command("check", *arguments)
    assert status == 2
    assert message in error


def test_a_definition_of_the_covariance_that_thousands_of_errors_show_is_certain():
    """σ of 1, 1 and 10, by 5000 independent errors: the log-likelihoods differ by 26,000, which no exponential holds."""
    error = np.random.default_rng(2).standard_normal((5000, 3)) * [1.0, 1.0, 10.0]
    readings = {name: np.tile(np.diag(P), (5000, 1, 1)) for name, P in (("body", [1, 1, 100]), ("fixed", [100, 1, 1]))}
    probability = foreign.frame_probabilities(error, readings)
    assert probability["body"] == 1.0
    assert 0.0 < probability["fixed"] < 1e-300
    readings["euler"] = np.zeros((5000, 3, 3))  # as at a pitch of 90°
    assert foreign.frame_probabilities(error, readings)["euler"] < 1e-300


def test_after_a_slew_about_one_axis_no_rotation_is_invented():
    """The part of both rotations about that axis is only determined together; a difference of the fixed frames alone fits."""
    time = np.arange(0.0, 60.0, 0.2)
    exact = quaternion.exp(np.outer(np.sin(0.1 * time), [0.3, 0.9, 0.2]))
    noise = quaternion.exp(1e-5 * np.random.default_rng(1).standard_normal((len(time), 3)))
    own = quaternion.multiply(quaternion.exp([0.0, 0.0, 0.2]), quaternion.multiply(exact, noise))
    a = alignment.fit(alignment.Series(time, own), alignment.Series(time, exact), alignment.ALIGNED, 0.0)
    np.testing.assert_allclose([a.fixed, a.body], [[0.0, 0.0, -0.2], np.zeros(3)], atol=1e-4)


def test_at_a_constant_rate_a_far_frame_is_no_offset_of_the_clock():
    """A shift in time is then a rotation. An attitude relative to North-East-Down had its clock moved by the 30 s of the search."""
    time = np.arange(0.0, 300.0, 0.5)
    exact = quaternion.exp(np.outer(time, np.array([0.1, -0.2, 0.5]) * DEGREE))
    size = np.where(time < 2.0, 1e-2, 1e-4)[:, None]  # without the first samples the residual is smaller
    noise = quaternion.exp(size * np.random.default_rng(0).standard_normal((len(time), 3)))
    own = alignment.Series(time, to_ned(quaternion.multiply(exact, noise)))
    _, a = alignment.align_series(own, alignment.Series(time, exact), None, [])
    assert a.estimated == ("fixed",)
    np.testing.assert_allclose(
        quaternion.to_matrix(quaternion.exp(a.fixed)), quaternion.to_matrix(to_ned([1.0, 0, 0, 0])).T, atol=1e-4
    )


@pytest.mark.parametrize("steady", [True, False])
def test_an_offset_of_the_clock_that_may_be_a_rotation_is_said_to_be(steady):
    time, late = np.arange(0.0, 300.0, 0.5), 0.35
    if steady:
        of, true = (quaternion.exp(np.outer(t, np.array([0.1, -0.2, 0.5]) * DEGREE)) for t in (time, time + late))
    else:
        of, true = (FLIGHT.motion.attitude(t) for t in (time, time + late))
    own, truth = alignment.Series(time + late, of), alignment.Series(time + late, true)
    a = alignment.fit(own, truth, ("time", "fixed"), 0.0)
    assert a.ambiguous == steady
    assert ("at a constant rate a rotation of the frames would look the same" in a.words[0]) == steady
    if not steady:
        assert a.offset == pytest.approx(-late, abs=2e-3)  # the attitudes between the stamps are interpolated


def test_the_first_errors_of_a_filter_do_not_decide_its_alignment():
    """σ of 6° for two seconds and 0.006° for five minutes: unweighted, σ of the frame would be 57 times as large."""
    time = np.arange(0.0, 300.0, 0.5)
    exact = FLIGHT.motion.attitude(time)
    sigma = np.where(time < 2.0, 0.1, 1e-4)
    noise = quaternion.exp(sigma[:, None] * np.random.default_rng(0).standard_normal((len(time), 3)))
    own = quaternion.multiply(F, quaternion.multiply(exact, noise))
    P = sigma[:, None, None] ** 2 * np.eye(3)
    outcome = check_arrays(time, own, P, time, exact)
    a = outcome.alignment
    assert a.estimated == ("fixed",)
    np.testing.assert_allclose(a.sigma[:3], 1e-4 / np.sqrt(len(time) - 4), rtol=0.15)
    assert np.linalg.norm(quaternion.log(quaternion.multiply(quaternion.exp(a.fixed), F))) < 4.0 * a.sigma[0]
    assert outcome.judgement.verdict == "consistent"


def test_an_alignment_is_described_with_its_sigma():
    sigma = np.array([*np.full(3, 2.0 * DEGREE), *np.full(3, 5.0 * DEGREE), 0.25])
    fixed, body = np.array([0.0, 3.0, 4.0]) * DEGREE, np.array([6.0, 0.0, 0.0]) * DEGREE
    known = {"covariance": np.diag(sigma**2), "estimated": ("time", "fixed", "body"), "residual": 7.0 * DEGREE}
    described = alignment.Alignment(offset=1.5, fixed=fixed, body=body, **known)
    clock, *frames = described.words
    assert clock.startswith("clocks differ by 1.5 s ± 0.25 s")
    epoch = replace(described, offset=1_700_000_000.1234)
    assert epoch.words[0].startswith("clocks differ by 1700000000.12 s ± 0.25 s")
    assert frames[0].startswith("the fixed frames differ by 5° (rotation vector 0, 3, 4°) ± 2° per axis")
    assert frames[1].startswith("the body frames differ by 6° (rotation vector 6, 0, 0°) ± 5° per axis")
    *numbers, residual = [value for key, value in described.summary().items() if key != "removed"]
    np.testing.assert_allclose(np.hstack(numbers), [1.5, 0, 3, 4, 6, 0, 0, 2, 2, 2, 5, 5, 5, 0.25], rtol=1e-12)
    assert residual == pytest.approx(7.0)


def test_times_without_anything_in_common_are_refused(replayed):
    with pytest.raises(InputError, match="fewer than two times in common"):
        checked(replayed, time=replayed.estimate.time + 1e4, align="none")
    own = alignment.Series(np.arange(10.0), np.tile([1.0, 0.0, 0.0, 0.0], (10, 1)))
    words = "goes from 5 to 14 s of the truth's clock, and the truth from 20 to 29 s"
    with pytest.raises(InputError, match=words):
        alignment.at_common_times(own, alignment.Series(own.time + 20.0, own.attitude), 5.0)


@pytest.mark.parametrize("offset", [-5.0, 5.0])
def test_a_sparser_truth_gives_the_times_within_those_of_the_estimate(offset):
    turned = lambda time: quaternion.exp(np.outer(time, [0.0, 0.0, 0.1]))  # noqa: E731
    own, theirs = np.arange(101) / 10.0, np.arange(-30.0, 31.0)
    common, truth = alignment.at_common_times(
        alignment.Series(own, turned(own)), alignment.Series(theirs, turned(theirs)), offset
    )
    np.testing.assert_array_equal(common.time, np.arange(11.0) + offset)
    np.testing.assert_allclose(common.attitude, turned(common.time - offset), atol=1e-12)
    np.testing.assert_array_equal(truth.attitude, turned(common.time))


RAMP = np.arange(203.0)
WHITE = np.random.default_rng(9).standard_normal((203, 2)) @ [[2.0, 0.3], [0.5, 0.5]]
SCORES = {
    "white": WHITE,
    "high frequencies": scipy.signal.lfilter([1.0, -0.9], [1.0], WHITE, axis=0),
    "low frequencies": scipy.signal.lfilter([1.0], [1.0, -0.8], WHITE, axis=0),
    "both": scipy.signal.lfilter([1.0, -1.8], [1.0, -0.995], WHITE, axis=0),
    "ramp": np.stack([RAMP, np.diff(WHITE[:, 1], prepend=0.0)], axis=1),
    "ramps": np.stack([RAMP, np.cos(0.03 * RAMP)], axis=1),
}


@pytest.mark.parametrize("kind", SCORES)
@pytest.mark.parametrize("samples", [80, 203])
def test_the_p_value_of_a_constant_is_that_of_the_autocovariances(kind, samples):
    """Hotelling's T² by SciPy: autocovariances of the fitted autoregression are summed, and the F distribution is SciPy's."""
    x = SCORES[kind][:samples] - SCORES[kind][:samples].mean(axis=0)
    densities = []
    for length in [n for n in (1, 2, 4) if samples // n >= 40]:
        sums = np.stack([x[i : i + length].sum(axis=0) for i in range(0, samples - length + 1, length)])
        m = len(sums)
        B = (1.0 + 2.0 / m) * np.linalg.solve(sums[:-1].T @ sums[:-1], sums[:-1].T @ sums[1:]).T
        B *= min(1.0, 0.99 / np.abs(np.linalg.eigvals(B)).max())
        noise = sums[1:] - np.einsum("ij,tj->ti", B, sums[:-1])
        covariance = scipy.linalg.solve_discrete_lyapunov(B, noise.T @ noise / (m - 1))
        ahead, density = covariance, covariance.copy()
        for _ in range(3000):
            ahead = B @ ahead
            density += ahead + ahead.T
        densities.append(density / length)
    density = max(densities, key=np.linalg.det)
    n = samples * np.sqrt(np.linalg.det(x.T @ x / samples) / np.linalg.det(density))
    total = np.sqrt(samples) * np.linalg.cholesky(density) @ [1.2, 1.6]  # T² = 4
    expected = scipy.stats.f.sf(4.0 * (n - 2.0) / (2.0 * (n - 1.0)), 2, n - 2.0) if n > 3.0 else 1.0
    assert foreign._constant_p_value(total, x) == pytest.approx(expected, rel=1e-6)
    assert foreign._constant_p_value(1e6 * total, x[: foreign.MIN_ROWS - 1]) == 1.0  # too few


@pytest.mark.slow
def test_peers_are_right_where_all_is_and_found_out_where_it_is_not():
    """Over 40 runs; the errors are on the body side, as smsfusion's source says."""
    for package in ("smsfusion", "attipy", "gtsam"):
        pytest.importorskip(package)
    study = peer_judged.main(runs=40, duration=40.0)
    for right in ("AttiPy, heading's derivative mended", "GTSAM"):
        assert study.judgements[right].verdict != "not consistent"
    for wrong in ("smsfusion, noises of another sensor", "GTSAM, gyro with a bias"):
        assert study.judgements[wrong].words.startswith("not consistent: the filter is optimistic")
    assert study.judgements["smsfusion, covariance read as fixed"].verdict == "not consistent"
    assert study.frame_probability["body"] > 0.99


def test_the_heading_gradient_of_the_sim_is_the_derivative():
    """By differences of the yaw angle, at any yaw."""
    for yaw in (0.0, 1.5, 3.0):
        q = quaternion.multiply(quaternion.exp([0.0, 0.0, yaw]), quaternion.exp([0.1, 0.2, 0.0]))
        turned = quaternion.multiply(q, quaternion.exp(1e-6 * np.eye(3)))
        difference = (euler(turned).angles[:, 0] - euler(q[None]).angles[0, 0]) / 1e-6
        np.testing.assert_allclose(peer_judged.heading_gradient(q), difference, atol=1e-5)


def test_an_estimate_of_this_package_is_judged_with_its_specification(tmp_path):
    """With its record as the truth, the verdict names what the filter does not model, as it does without."""
    spin = replace(scenarios.load_scenario("spin"), duration=60.0)
    late = replace(spin.gyro, scale_factor=np.full(3, 1e-4), timestamp_offset=0.02)
    record = sd.simulate(replace(spin, gyro=late, gyro_preset=""), seed=3)
    result = sd.estimate(record, states=False)
    sd.write(record, tmp_path / "record.h5")
    sd.write(result, tmp_path / "estimate.h5")
    own, truth = (read_attitudes(tmp_path / name) for name in ("estimate.h5", "record.h5"))
    checked = consistency.check_attitudes(own, truth)
    assert checked.judgement.unmodelled == sd.check(result).unmodelled
    assert len(checked.judgement.unmodelled) == 2
    assert [explanation.name for explanation in checked.explanations if explanation.known] == [foreign.CLOCK]


def test_upper_bounds_are_known_to_be_too_large():
    random = np.random.default_rng(1)
    time = np.arange(1000.0)
    attitude = quaternion.exp(np.cumsum(0.1 * random.standard_normal((1000, 3)), axis=0) % 2.0)
    estimate = quaternion.multiply(attitude, quaternion.exp(0.01 * random.standard_normal((1000, 3))))
    truth = Attitudes.from_arrays(time, attitude)
    for motion, factor, mark in (("hand", 9.0, "known"), ("", 9.0, "likely"), ("hand", 0.1, "likely")):
        P = np.tile(factor * 1e-4 * np.eye(3), (1000, 1, 1))
        own = Attitudes.from_arrays(time, estimate, covariance=P, motion=motion)
        marks = {row[0]: row[-1] for row in consistency.check_attitudes(own, truth).listing().rows}
        assert marks[foreign.SCALE] == mark
