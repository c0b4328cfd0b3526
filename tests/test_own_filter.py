"""A filter of one's own wherever the package's filter goes: the same filter, wrapped, must give the same to the bit."""

import json
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
from measured import turn_to

from sims import own_filter
from strapdown import cli, consistency, covariance, estimation, montecarlo, motion, scenarios, tuning, vectors
from strapdown.checks import InputError
from strapdown.estimation import filters, setup
from strapdown.gyro import GyroSpec
from strapdown.montecarlo import Plan, campaign, verdicts
from strapdown.records import Estimate, Truth, cut
from strapdown.report import campaigns

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = own_filter.scenario(20.0)
SETUP = setup.FilterSetup.for_scenario(SCENARIO, states=False)
PLAN = Plan(scenario=SCENARIO, setup=SETUP, seed=3, epochs=20, nis_bins=5)


def wrapped(record, initial):
    """The package's filter as if it were somebody else's."""
    return estimation.run(record, SETUP.process_noise, initial, full_covariance=True)


def attitude_only(record, initial):
    estimate = wrapped(record, initial)
    return Estimate.from_arrays(estimate.time, estimate.attitude, estimate.covariance[:, :3, :3])


@dataclass
class Wrapped:
    """The same as an object that spoils itself: only a copy for each run keeps runs apart."""

    factor: float = 1.0
    runs: int = 0

    def run(self, record, initial):
        self.runs += 1
        assert self.runs == 1, "the state of another run"
        assert record.truth is None, "a filter must not see the truth"
        estimate = wrapped(record, initial)
        return replace(estimate, covariance=self.factor**2 * estimate.covariance)


def with_filter(estimator, plan=PLAN):
    return replace(plan, setup=replace(SETUP, estimator=estimator))


def same(first, second, but=()):
    for field in fields(first):
        if field.name not in ("plan", *but):
            np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name), err_msg=field.name)


@pytest.fixture(scope="module")
def own():
    return montecarlo.run_plan(PLAN, runs=12, machine="scalar", chunk=5)


@pytest.mark.parametrize(("estimator", "threads"), [(wrapped, 1), (Wrapped(), 3)], ids=["function", "object"])
def test_the_packages_filter_wrapped_gives_the_same_statistics_to_the_bit(own, estimator, threads):
    same(own, montecarlo.run_plan(with_filter(estimator), runs=12, chunk=5, threads=threads))


def test_a_filter_at_fewer_times_is_judged_by_the_last_before_each_epoch(own):
    """At every fifth edge, once a second as the epochs."""

    def sparse(record, initial):
        estimate = wrapped(record, initial)
        rows = slice(None, None, 5)
        fewer = Estimate.from_arrays(
            estimate.time[rows], estimate.attitude[rows], estimate.covariance[rows], bias=estimate.bias[rows]
        )
        return replace(fewer, innovations=estimate.innovations)

    same(own, montecarlo.run_plan(with_filter(sparse), runs=12, chunk=5))


def test_with_a_coning_algorithm_it_gets_the_longer_steps():
    from strapdown import coning

    four = replace(SETUP, integration=coning.ALGORITHMS["four-sample"])
    plan = replace(PLAN, setup=four, epochs=5)
    statistics = montecarlo.run_plan(plan, runs=4, machine="scalar")
    same(statistics, montecarlo.run_plan(replace(plan, setup=replace(four, estimator=wrapped)), runs=4))


def test_without_a_bias_the_attitude_alone_is_judged(own, tmp_path, capsys):
    statistics = montecarlo.run_plan(with_filter(attitude_only), runs=12, chunk=5)
    assert statistics.subsets == ("attitude",)
    np.testing.assert_array_equal(statistics.nees_sum[:, 1], own.nees_sum[:, 1])
    np.testing.assert_array_equal(statistics.rms_error[:, :3], own.rms_error[:, :3])
    assert np.isnan(statistics.rms_error[:, 3:]).all()
    assert np.isnan(statistics.anees[:, [0, 2]]).all()
    judgement = statistics.judge()
    assert {finding.of for finding in judgement.findings if "NEES" in finding.name} == {"attitude"}
    assert list(montecarlo.summary(statistics)["anees"]) == ["attitude"]
    campaign.run(with_filter(attitude_only), tmp_path / "own.h5", runs=12)
    page, numbers = campaigns.report(tmp_path / "own.h5")
    assert list(numbers["anees"]) == ["attitude"]
    assert "bias x" not in page
    assert "nan" not in json.dumps(numbers).lower()
    cli.app(["montecarlo", str(tmp_path / "own.h5")], standalone_mode=False)
    assert "ANEES attitude, mean" in (output := " ".join(capsys.readouterr().out.split()))
    assert "bias" not in output


def test_without_a_bias_it_is_consistent_where_the_attitude_shows_it():
    judgement = montecarlo.run_plan(with_filter(attitude_only), runs=160).judge()
    assert judgement.verdict == "consistent"
    assert [part.of for part in judgement.parts if "innov" not in part.of] == ["attitude"]
    assert "bias" not in judgement.words


def test_a_filter_that_fails_in_a_run_is_counted(tmp_path):
    def failing(record, initial):
        estimate = wrapped(record, initial)
        late = estimate.time > 10.0
        return replace(estimate, attitude=np.where(late[:, None], np.nan, estimate.attitude))

    plan = with_filter(failing)
    statistics = campaign.run(plan, tmp_path / "failing.h5", runs=3).statistics
    assert statistics.failed == 3
    assert statistics.judge().verdict == "not consistent"
    errors, coverage = verdicts.tables(verdicts.summary(statistics, bound=verdicts.bound_of(plan)))
    assert not errors.notes
    assert "In 3 runs the filter failed: no finite error or covariance." in coverage.notes
    page, _ = campaigns.report(tmp_path / "failing.h5")
    assert "At the end" not in page
    again = montecarlo.replay(plan, 0)
    assert again.largest_nees(plan.time) == (np.inf, plan.time[plan.time > 10.0][0])
    negative = replace(again, estimate=replace(again.estimate, covariance=-again.estimate.covariance))
    assert negative.largest_nees(plan.time) == (np.inf, plan.time[0])


def test_a_too_modest_filter_is_found_out():
    statistics = montecarlo.run_plan(with_filter(Wrapped(factor=2.0)), runs=20)
    np.testing.assert_allclose(
        statistics.anees, 0.25 * montecarlo.run_plan(with_filter(wrapped), runs=20).anees, rtol=1e-9
    )
    assert statistics.judge().verdict == "not consistent"


MINE = """

from dataclasses import dataclass, replace

from beside import NOISE
from strapdown import estimation
from strapdown.records import Estimate


@dataclass
class Scaled:
    factor: float = 1.0

    def run(self, record, initial):
        estimate = estimation.run(record, NOISE, initial, full_covariance=True)
        return replace(estimate, covariance=self.factor**2 * estimate.covariance)


def alone(record, initial):
    estimate = estimator.run(record, initial)
    rows = [k * k for k in range(1, 11)]
    return Estimate.from_arrays(estimate.time[rows], estimate.attitude[rows], estimate.covariance[rows, :3, :3])


estimator = Scaled()
modest = Scaled(2.0)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a scenario, a filter in a Python file, and what that imports."""
    noise = SETUP.process_noise
    numbers = f"angle_random_walk={noise.angle_random_walk!r}, rate_random_walk={noise.rate_random_walk!r}"
    (tmp_path / "scene.toml").write_text(scenarios.scenario_to_toml(SCENARIO))
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "beside.py").write_text(
        f"from strapdown.estimation.states import ProcessNoise\nNOISE = ProcessNoise({numbers})\n"
    )
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("beside", None)


def command(*arguments):
    return cli.app(["montecarlo", *map(str, arguments)], standalone_mode=False)


@pytest.mark.parametrize("machine", ["threads", "processes"])
def test_a_filter_of_a_python_file_is_run_from_the_command_line(own, folder, capsys, machine):
    """The same statistics to the bit as those of the package's filter."""
    workers = ("--threads", 2) if machine == "threads" else ("--workers", 1)
    if machine == "processes":
        pytest.importorskip("distributed")
    code = command("scene.toml", "--filter", "mine.py", "--runs", 12, "--chunk", 5, "--seed", 3, *workers)
    assert code == 3  # 12 runs cannot tell
    assert "Executing mine.py with your permissions." in capsys.readouterr().out
    plan = replace(PLAN, epochs=100, nis_bins=100)
    held = campaign.read(folder / "scene-montecarlo.h5")
    same(montecarlo.run_plan(plan, runs=12, machine="scalar", chunk=5), held.statistics)
    assert held.plan.setup.estimator.table["file"] == "mine.py:estimator"
    assert "mine" not in sys.modules
    if machine == "processes":
        return
    command("scene.toml", "--filter", "mine.py:modest", "--runs", 12, "--chunk", 5, "--seed", 3, "--out", "modest.h5")
    modest = campaign.read(folder / "modest.h5").statistics
    np.testing.assert_allclose(modest.nees_sum, 0.25 * held.statistics.nees_sum, rtol=1e-12)


def test_its_campaign_goes_on_and_is_replayed_where_the_code_is_given_again(folder):
    command("scene.toml", "--filter", "mine.py", "--runs", 5, "--out", "own.h5")
    with pytest.raises(InputError, match=r"give it again, `estimator='mine.py:estimator'`$"):
        command("own.h5", "--runs", 8, "--resume")
    command("own.h5", "--filter", "mine.py", "--runs", 8, "--resume")
    assert campaign.read(folder / "own.h5").statistics.runs == 8
    command("own.h5", "--filter", "mine.py:estimator", "--replay", 6)
    assert (folder / "own-run-6-estimate.h5").exists()
    with pytest.raises(InputError, match=r"is not the filter of own\.h5"):
        command("own.h5", "--filter", "mine.py:modest", "--runs", 9, "--resume")
    (folder / "mine.py").write_text(MINE + "# edited\n")
    with pytest.raises(InputError, match=r"is not the filter of own\.h5"):
        command("own.h5", "--filter", "mine.py", "--replay", 6)
    with pytest.raises(InputError, match="source_sha256"):
        command("scene.toml", "--filter", "mine.py", "--runs", 9, "--out", "own.h5", "--resume")


def test_a_run_of_a_filter_without_a_bias_and_at_times_of_its_own_is_replayed_and_judged(folder, capsys):
    command("scene.toml", "--filter", "mine.py:alone", "--runs", 3, "--out", "own.h5", "--replay", 1)
    assert "maximum NEES of the states" in capsys.readouterr().out
    files = ["own-run-1-estimate.h5", "--truth", "own-run-1-record.h5"]
    cli.app(["check", *files], standalone_mode=False)
    assert "cannot tell: attitude not testable from this run: too few epochs with a truth" in capsys.readouterr().out
    read = setup.read_estimate("own-run-1-estimate.h5")
    truth = read.truth
    assert np.max(np.abs(turn_to(read.attitude, truth.attitude))) < 5.0 * np.max(
        read.sigma[:, :3]
    )  # the truth of these times


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        (None, "", "mine.py: there is no such Python file"),
        ("1 +", "", "mine.py fails when it is executed: SyntaxError"),
        ("x = 1\n1 / 0", "", "mine.py, line 2 fails when it is executed: ZeroDivisionError"),
        ("x = 1", "", "mine.py defines no estimator; give the name of the filter, mine.py:NAME"),
        ("x = 1", ":x", "1 is no filter"),
        ("class F: run = None", ":F", "F is a class; give an object of it"),
    ],
)
def test_a_file_that_holds_no_filter_is_refused(folder, text, name, message):
    (folder / "mine.py").unlink()
    if text is not None:
        (folder / "mine.py").write_text(text)
    with pytest.raises(InputError, match=message):
        command("scene.toml", "--filter", f"mine.py{name}", "--runs", 2)
    assert not (folder / "scene-montecarlo.h5").exists()


def test_a_campaign_goes_on_and_is_replayed(own, tmp_path):
    plan, path = with_filter(Wrapped()), tmp_path / "own.h5"
    campaign.run(plan, path, runs=5, chunk=5)
    held = campaign.run(plan, path, runs=12, resume=True)
    same(own, held.statistics)
    again = montecarlo.replay(plan, 7)
    same(
        montecarlo.replay(PLAN, 7, machine="scalar").estimate,
        again.estimate,
        but=("innovations", "skipped", "setup", "origin"),
    )
    with pytest.raises(InputError, match=r"filter.estimator.parameters.factor is 1.0 there and 2.0 here"):
        campaign.run(with_filter(Wrapped(factor=2.0)), path, runs=13, resume=True)
    read = campaign.read(path).plan
    assert read.digest == plan.digest
    assert read.setup == plan.setup
    with pytest.raises(InputError, match=r"not in the result file; give it again, replace\(plan.setup, estimator=…\)"):
        montecarlo.replay(read, 0)
    assert "textbook" not in campaigns.report(path)[0]


def test_it_is_compared_with_the_packages_filters():
    record = montecarlo.replay(PLAN, 0, machine="scalar")
    table = filters.compare(
        record.record, SETUP.process_noise, record.initial, filters=["mekf", wrapped, own_filter.textbook], every=5
    )
    rows = table.summary()
    assert list(rows) == ["mekf", "wrapped", "textbook"]
    assert rows["wrapped"] == rows["mekf"]
    # First order in steps of 0.2 s at 0.06 rad/s, and vectors with three degrees of freedom: not the same, but no other filter.
    for what, left in {"attitude_sigma": 0.02, "bias_sigma": 0.02}.items():
        assert rows["textbook"][what] == pytest.approx(rows["mekf"][what], rel=left)
    assert np.isnan(rows["textbook"]["nis"])


def test_one_run_is_judged(own):
    again = montecarlo.replay(with_filter(own_filter.textbook), 1)
    truth = again.record.truth
    judged = consistency.judge(again.estimate, truth)
    assert {finding.of for finding in judged.findings} == {"state", "attitude", "bias"}
    alone = montecarlo.replay(with_filter(attitude_only), 1).estimate
    assert {finding.of for finding in consistency.judge(alone, truth).findings} == {"attitude"}
    no_bias = Truth(attitude=truth.attitude, bias=np.full_like(truth.bias, np.nan))
    assert {finding.of for finding in consistency.judge(again.estimate, no_bias).findings} == {"attitude"}


@pytest.mark.slow
def test_the_example_tells_the_right_filter_from_the_faulty_one():
    study = own_filter.main(runs=100, duration=60.0, seed=1)
    assert study.verdicts["textbook"].startswith("consistent")
    assert study.verdicts["turned reference"].startswith("not consistent")


def test_bad_filters_are_refused():
    class NoRun:
        pass

    for bad, message in (
        (3, "3 is no filter"),
        (Wrapped, "Wrapped is a class"),
        (NoRun(), "is no filter"),
        (lambda record: None, "cannot be called with \\(record, initial\\)"),
        ("mekff", "mekff"),
    ):
        with pytest.raises(InputError, match=message):
            replace(SETUP, estimator=bad)
    with pytest.raises(InputError, match="options of the mekf"):
        replace(SETUP, estimator=wrapped, gate=estimation.Gate())

    def shifted(record, initial):
        estimate = wrapped(record, initial)
        return replace(estimate, time=estimate.time + 0.01)

    def half(record, initial):
        return wrapped(cut(record, 0, len(record.increments) // 2), initial)

    def late(record, initial):
        return wrapped(cut(record, len(record.increments) // 2, len(record.increments)), initial)

    for bad, message in (
        (lambda record, initial: 3, "return Estimate.from_arrays"),
        (shifted, "time\\[0\\] is 0.01 s, where the record has no edge"),
        (
            half,
            "half gives values from 0 to [0-9.]+ s, and the record goes from 0 to [0-9.]+ s; return values over all of it",
        ),
        (late, "late gives values from [0-9.]+ to"),
    ):
        with pytest.raises(InputError, match=message):
            montecarlo.run_plan(with_filter(bad), runs=1)
    record = montecarlo.replay(PLAN, 0, machine="scalar")
    with pytest.raises(InputError, match="two of the name wrapped"):
        filters.compare(record.record, SETUP.process_noise, record.initial, filters=[wrapped, wrapped])


def test_what_works_with_the_mekf_alone_says_so():
    record = montecarlo.replay(PLAN, 0, machine="scalar")
    filter_setup = replace(SETUP, estimator=wrapped)
    for work in (
        lambda: setup.smooth(record.record, filter_setup, record.initial),
        lambda: setup.observability(record.record, filter_setup, record.initial),
        lambda: covariance.analyse(SCENARIO, filter_setup),
        lambda: tuning.likelihood([tuning.record_case(record.record, SETUP)], filter_setup, ["gyro.arw"]),
    ):
        with pytest.raises(InputError, match="needs the mekf, but the estimator is wrapped"):
            work()
    assert "wrapped" in str(montecarlo.choose(with_filter(wrapped)))


def test_arrays_that_make_no_estimate_are_refused():
    time, q, P = np.arange(3.0), np.tile([1.0, 0, 0, 0], (3, 1)), np.tile(np.eye(3), (3, 1, 1))
    assert not Estimate.from_arrays(time, q, P).has_bias
    for change, message in (
        ({"covariance": P[0]}, "a matrix for each time"),
        ({"attitude": 2.0 * q}, "attitude"),
        ({"time": time[::-1]}, "time"),
        ({"bias": np.zeros((3, 3))}, "covariance is of the attitude only"),
    ):
        with pytest.raises(InputError, match=message):
            Estimate.from_arrays(**{"time": time, "attitude": q, "covariance": P, **change})


# ------------------------------------------------------------------------------------------------- the Cramér–Rao bound


def star_tracker(rate=1.0, duration=2000.0, **gyro):
    """A body at rest whose three axes are measured alike."""
    spec = GyroSpec(**{"angle_random_walk": 1e-5, "rate_random_walk": 1e-6, **gyro})
    tracker = vectors.AttitudeSensor(name="tracker", sigma_across=1e-4, sigma_about=1e-4, rate=rate)
    rest = motion.ConstantRate(rate=(0.0, 0.0, 0.0))
    return scenarios.Scenario(motion=rest, gyro=spec, sensors=(tracker,), rate=2.0, duration=duration)


def cramer_rao(scene, attitude_sigma, bias_sigma, epochs):
    filter_setup = replace(
        setup.FilterSetup.for_scenario(scene, states=False), attitude_sigma=attitude_sigma, bias_sigma=bias_sigma
    )
    return covariance.analyse(scene, filter_setup, epochs=epochs).cramer_rao


def test_the_bound_ends_in_farrenkopfs_steady_state():
    """Farrenkopf 1978, one axis at rest, just after an update."""
    su, sv, sn, dt = 1e-6, 1e-5, 1e-4, 1.0
    S_u, S_v = su * dt**1.5 / sn, sv * dt**0.5 / sn
    gamma = np.sqrt(1.0 + S_v**2 / 4.0 + S_u**2 / 48.0)
    zeta = gamma + S_u / 4.0 + 0.5 * np.sqrt(2.0 * gamma * S_u + S_v**2 + S_u**2 / 3.0)
    bound = cramer_rao(star_tracker(), attitude_sigma=1e-3, bias_sigma=1e-5, epochs=10)
    variances = [sn**2 * (1.0 - zeta**-2)] * 3 + [su * sn / np.sqrt(dt) * (zeta - 1.0 / zeta) - 0.5 * su**2 * dt] * 3
    np.testing.assert_allclose(np.diag(bound[-1]), variances, rtol=1e-8)
    np.testing.assert_allclose(np.diag(bound[0]), [1e-6] * 3 + [1e-10] * 3, rtol=1e-12)


@pytest.mark.parametrize(
    "gyro", [{"bias_instability": 1e-6}, {"rate_random_walk": (1e-6, 1e-6, 3e-6)}], ids=["flicker", "axes"]
)
def test_there_is_no_bound_where_the_noise_is_not_that_of_the_recursion(gyro):
    scene = star_tracker(duration=100.0, **gyro)
    with pytest.raises(InputError, match="the filter's noise is not that of the scenario"):
        cramer_rao(scene, attitude_sigma=1e-3, bias_sigma=1e-5, epochs=10)
    plan = Plan(
        scenario=scene, setup=replace(setup.FilterSetup.for_scenario(scene, states=False), estimator=wrapped), epochs=10
    )
    assert verdicts.bound_of(plan) is None


def test_a_filter_that_leaves_measurements_out_stays_above_the_bound_by_just_that(tmp_path, capsys):
    """Every other attitude: the bound of a tracker of half the rate, in closed recursion, says how much that costs."""
    scene = star_tracker(duration=60.0)
    base = replace(setup.FilterSetup.for_scenario(scene, states=False), attitude_sigma=1e-3, bias_sigma=1e-5)

    def half(record, initial):
        (tracker,) = record.vectors
        odd = np.flatnonzero(np.isclose(tracker.time % 2.0, 0.0))
        of_half = {name: getattr(tracker, name)[odd] for name in ("time", "attitude", "sigma", "sigma_axes")}
        kept = replace(tracker, **of_half)
        return estimation.run(replace(record, vectors=(kept,)), base.process_noise, initial, full_covariance=True)

    plan = Plan(scenario=scene, setup=replace(base, estimator=half), seed=5, epochs=6)
    bound = verdicts.bound_of(plan)
    lesser = cramer_rao(star_tracker(rate=0.5, duration=60.0), attitude_sigma=1e-3, bias_sigma=1e-5, epochs=6)
    predicted = np.sqrt(np.diagonal(lesser, axis1=1, axis2=2) / np.diagonal(bound, axis1=1, axis2=2))
    assert predicted[-1, 0] > 1.1
    for dispersions, sigma in ((montecarlo.Dispersions(), 1e-3), (montecarlo.Dispersions(attitude_sigma=3e-3), 3e-3)):
        least = cramer_rao(scene, attitude_sigma=sigma, bias_sigma=1e-5, epochs=6)
        np.testing.assert_array_equal(verdicts.bound_of(replace(plan, dispersions=dispersions)), least)
    for error in ({"attitude_error": (1e-3, 0, 0)}, {"bias_error": (1e-6, 0, 0)}):
        assert verdicts.bound_of(replace(plan, dispersions=montecarlo.Dispersions(**error))) is None
    runs = 100
    statistics = campaign.run(plan, tmp_path / "half.h5", runs=runs).statistics
    ratio = verdicts.efficiency(statistics, bound)
    low, high = consistency.mean_bounds(1, runs, 1.0 - 0.01 / 36)
    assert np.all(ratio[1:] / predicted[1:] > low**0.5)
    assert np.all(ratio[1:] / predicted[1:] < high**0.5)
    said = montecarlo.summary(statistics, bound=bound)["rms_over_root_cramer_rao_bound"]
    np.testing.assert_allclose(said["attitude"], np.sqrt(np.mean(ratio[1:, :3] ** 2, axis=0)), rtol=1e-12)
    cli.app(["montecarlo", str(tmp_path / "half.h5")], standalone_mode=False)
    assert f"by axis: attitude {said['attitude'][0]:.3f}" in capsys.readouterr().out
    page, numbers = campaigns.report(tmp_path / "half.h5")
    np.testing.assert_allclose(numbers["rms_over_root_cramer_rao_bound"], ratio, rtol=1e-12)
    assert "Cramér–Rao" in page
    assert verdicts.bound_of(replace(plan, setup=base)) is None  # of the package's own filter its σ says it


def test_a_comparison_gives_errors_over_the_bound():
    scene = star_tracker(duration=60.0)
    base = setup.FilterSetup.for_scenario(scene, states=False)
    replayed = montecarlo.replay(Plan(scenario=scene, setup=base, seed=5, epochs=6), 0, machine="scalar")
    bound = cramer_rao(
        scene, attitude_sigma=base.attitude_sigma, bias_sigma=base.bias_sigma, epochs=len(replayed.record.increments)
    )

    def mine(record, initial):
        return estimation.run(record, base.process_noise, initial, full_covariance=True)

    comparison = filters.compare(
        replayed.record, base.process_noise, replayed.initial, filters=["mekf", mine], every=2, bound=bound[::2]
    )
    error = comparison.estimates["mine"]
    turn = turn_to(error.attitude, replayed.record.truth.attitude[::2])
    ratio = turn / np.sqrt(np.diagonal(bound[::2], axis1=1, axis2=2)[:, :3])
    expected = np.sqrt(np.mean(ratio[error.time >= 30.0] ** 2))
    assert comparison.summary()["mine"]["attitude_over_bound"] == pytest.approx(expected, rel=1e-12)
    assert f"{expected:.3f}" in str(comparison)
    for bad, message in ((bound, r"bound has shape"), (bound[::2], "no truth")):
        record = replace(replayed.record, truth=None) if message == "no truth" else replayed.record
        with pytest.raises(InputError, match=message):
            filters.compare(record, base.process_noise, replayed.initial, filters=["mekf"], every=2, bound=bad)
