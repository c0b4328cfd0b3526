"""Figures: what is drawn is what was given, with units, in light and dark styles, and no extreme is lost."""

import dataclasses
import os
import subprocess
import sys
import xml.etree.ElementTree
from types import SimpleNamespace

import hypothesis
import matplotlib.style
import numpy as np
import pytest
import scipy.stats
from coning_case import SCENARIO, SETUP, estimated
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from strapdown import allan, consistency, covariance, gyro, montecarlo, plots, quaternion, units
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.montecarlo.coning_study import Drift, FilterOutcome
from strapdown.plots import decimation, estimates, style, tuning
from strapdown.records.estimate import ErrorStateEstimate, Estimate

pytestmark = pytest.mark.draws


@pytest.fixture(scope="module")
def run():
    return estimated()


@pytest.fixture(scope="module")
def statistics():
    return montecarlo.run_plan(montecarlo.Plan(scenario=SCENARIO, setup=SETUP, epochs=25, nis_bins=20), runs=24)


def heights(band):
    """Heights of the corners of a filled band."""
    return band.get_paths()[0].vertices[:, 1]


def limits(span):
    """Lower and upper end of a horizontal span."""
    return [span.get_y(), span.get_y() + span.get_height()]


@st.composite
def uneven_series(draw):
    """Times that never go back, with bursts and gaps, values with NaN among them, and a number of columns."""
    n = draw(st.integers(2, 400))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    steps = np.where(random.random(n) < 0.1, random.exponential(50.0, n), random.random(n)) * (random.random(n) < 0.9)
    value = np.where(random.random(n) < draw(st.sampled_from([0.0, 0.5])), np.nan, random.standard_normal(n))
    return np.cumsum(steps), value, draw(st.integers(1, 60))


@hypothesis.settings(deadline=None)
@hypothesis.given(uneven_series())
def test_an_envelope_is_the_least_and_the_largest_of_each_column(series):
    """By counting: which column of the time axis each sample falls into, and the extremes of the samples there."""
    time, value, columns = series
    envelope = decimation.envelope(time, value, value + 1.0, columns)
    if len(time) <= columns:
        np.testing.assert_array_equal(envelope, (time, value, value + 1.0))
        return
    held = {}
    span = time[-1] - time[0]
    for t, x in zip(time, value, strict=True):
        column = min(columns - 1, int((t - time[0]) * (columns / span))) if span > 0.0 else 0
        held.setdefault(column, []).append((t, x))
    edges, low, high = (part.reshape(-1, 2) for part in envelope)
    assert len(edges) == len(held) <= columns
    ends = [*(samples[0][0] for samples in held.values()), time[-1]][1:]
    for k, samples in enumerate(held.values()):
        valid = [x for _, x in samples if not np.isnan(x)]
        assert edges[k].tolist() == [samples[0][0], ends[k]]
        np.testing.assert_equal(low[k].tolist(), 2 * [min(valid, default=np.nan)])
        np.testing.assert_equal(high[k].tolist(), 2 * [max(valid, default=np.nan) + 1.0])


@hypothesis.settings(deadline=None)
@hypothesis.given(uneven_series())
def test_a_line_keeps_the_extremes_of_each_column(series):
    """Its points are samples, in order."""
    time, value, columns = series
    when, drawn = plots.decimated(time, value, columns)
    rows = decimation.extreme_rows(time, value, columns)
    assert np.all(np.diff(rows) > 0)
    np.testing.assert_array_equal((when, drawn), (time[rows], value[rows]))
    whole, kept = decimation.envelope(time, value, columns=columns), decimation.envelope(when, drawn, columns=columns)
    assert (when[0], when[-1]) == (time[0], time[-1])
    assert len(when) <= max(2 * columns + 2, 1)
    if len(when) > columns:
        np.testing.assert_array_equal(kept[1:], whole[1:])


def test_the_band_of_a_long_record_is_the_envelope_of_sigma():
    """σ that grows between measurements: dark to its least in each column, light to its largest, both without teeth; few points."""
    time = np.arange(300_000) / 100.0
    sigma, error = 1.0 + np.mod(time, 1.0), np.sin(time)[None]
    error[0, 123_456] = 42.0
    _, ax = plots.new_figure()
    plots.errors_in_envelope(time, error, sigma, ax)
    dark, upper, lower = (heights(band) for band in ax.collections)
    assert np.unique(dark.round(9)).tolist() == pytest.approx([-3.0, 3.0])
    assert np.unique(upper.round(9)).tolist() == pytest.approx([3.0, 3.0 * 1.99])
    assert np.unique(lower.round(9)).tolist() == pytest.approx([-3.0 * 1.99, -3.0])
    assert "99.7 %" in ax.get_legend_handles_labels()[1][0]
    line = ax.lines[-1]
    assert len(line.get_xdata()) <= 4002
    assert line.get_ydata().max() == 42.0
    assert ax.get_ylim()[1] == pytest.approx(1.3 * 42.0)


@pytest.mark.parametrize("turns", [3.2, 5000.3])
def test_a_line_of_an_angle_breaks_where_it_wraps(turns):
    time = np.linspace(0.0, 1.0, 200_001)
    angle = np.mod(360.0 * turns * time + 180.0, 360.0) - 180.0
    _, drawn = estimates.unbroken(time, angle)
    jumps = np.abs(np.diff(drawn)) > 180.0
    if turns < 100.0:
        assert not jumps.any()
        assert np.isnan(drawn).sum() == 3
    else:  # several turns in a column: a filled area, not nothing
        assert np.isfinite(drawn).mean() > 0.5
        assert jumps.mean() > 0.4


def test_nees_and_nis_are_drawn_with_their_bounds(statistics):
    degrees = np.median(statistics.sensor_degrees.sum(axis=0))
    span = plots.nis_over_time([("filter", statistics)]).patches[0]
    bounds = scipy.stats.chi2.ppf([0.005, 0.995], degrees) / degrees
    np.testing.assert_allclose(limits(span), bounds)
    nees = plots.nees_over_time([("filter", statistics)], (0.8, 1.2), "bias").lines[0].get_ydata()
    with pytest.raises(InputError, match="did you mean 'attitude'"):
        plots.nees_over_time([("filter", statistics)], (0.8, 1.2), "atitude")
    np.testing.assert_allclose(nees, statistics.nees_sum[:, 2] / (3.0 * 24.0))


@pytest.mark.parametrize("start", [2e-4, 1e-9])
def test_a_slice_of_the_likelihood_is_drawn_in_the_unit_of_its_axis(start):
    unit = SimpleNamespace(name="°/h", factor=units.DEGREE_PER_HOUR)
    parameter = SimpleNamespace(name="b", unit=unit, start=start, value=1e-4, lower=6e-5, upper=1.5e-4, identified=True)
    slices = SimpleNamespace(values=np.geomspace(4e-5, 3e-4, 9)[None], fallen=np.arange(9.0)[None])
    ax = tuning.likelihood_slice(slices, SimpleNamespace(parameters=(parameter,), composite=False), 0)
    levels = {line.get_label(): line for line in ax.lines}
    np.testing.assert_allclose(ax.lines[0].get_xdata() * units.DEGREE_PER_HOUR, slices.values[0])
    assert levels["3.84: 95 % of χ², one parameter"].get_ydata()[0] == pytest.approx(
        scipy.stats.chi2.ppf(0.95, 1), rel=1e-3
    )
    assert levels["tuned"].get_xdata()[0] * units.DEGREE_PER_HOUR == pytest.approx(1e-4)
    assert ax.patches[0].get_x() * units.DEGREE_PER_HOUR == pytest.approx(6e-5)
    if start == 2e-4:
        assert levels["before"].get_xdata()[0] * units.DEGREE_PER_HOUR == pytest.approx(2e-4)
    else:
        assert ax.get_xlabel() == f"°/h  (before: {start / units.DEGREE_PER_HOUR:.3g})"


def test_the_legend_of_one_slice_of_the_likelihood_is_within_its_figure():
    unit = SimpleNamespace(name="1", factor=1.0)
    parameter = SimpleNamespace(name="scale", unit=unit, start=1.2, value=1.0, lower=0.8, upper=1.5, identified=True)
    slices = SimpleNamespace(values=np.geomspace(0.5, 2.0, 9)[None], fallen=np.arange(9.0)[None])
    figure = tuning.likelihood_slices(slices, SimpleNamespace(parameters=(parameter,), composite=False))
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert box.x0 >= 0.0
    assert box.x1 <= figure.bbox.x1


def test_an_allan_deviation_is_drawn_with_the_terms_of_its_axis():
    random = np.random.default_rng(2)
    white = 1e-3 * random.standard_normal((3000, 2))
    rate = white + np.cumsum(1e-4 * random.standard_normal((3000, 2)), axis=0) * [0.0, 1.0]
    deviation, fit = allan.allan_deviation(rate, 0.1), allan.fit_noise(rate, 0.1)
    assert fit.supported[:, fit.terms.index("rate_random_walk")].tolist() == [False, True]
    size = units.DEGREE_PER_HOUR
    for axis, ax in enumerate(plots.allan_overview(deviation, fit).axes):
        drawn = [line.get_label() for line in ax.lines[2:]]
        assert drawn == [
            term.replace("_", " ") for term, held in zip(fit.terms, fit.supported[axis], strict=True) if held
        ]
        np.testing.assert_allclose(ax.lines[0].get_ydata() * size, deviation.deviation[axis])
        ends = heights(ax.collections[0]) * size
        finite = deviation.upper[axis][np.isfinite(deviation.upper[axis])]
        np.testing.assert_allclose([ends.min(), ends.max()], [deviation.lower[axis].min(), finite.max()])


def test_coning_errors_are_those_about_the_cones_axis(outcomes):
    held = outcomes[0].statistics
    axes = plots.coning_errors(outcomes).axes
    for ax, state, size in ((axes[0], 2, units.ARCSECOND), (axes[2], 5, units.DEGREE_PER_HOUR)):
        np.testing.assert_allclose(ax.lines[1].get_ydata() * size, held.example_error[0, :, state])
        top = heights(ax.collections[0]).max()
        assert top * size == pytest.approx(3.0 * held.sigma[:, state].max())


def test_errors_are_drawn_in_the_unit_of_their_label(run):
    estimate, truth = run
    with pytest.raises(InputError, match="truth is None"):
        plots.error_overview(dataclasses.replace(estimate, truth=None))
    figure = plots.error_overview(dataclasses.replace(estimate, truth=truth))
    error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)
    for state, ax in enumerate(np.reshape(figure.axes, (3, 2)).T.ravel()):
        unit, size = (("arcsec", units.ARCSECOND), ("°/h", units.DEGREE_PER_HOUR))[state // 3]
        assert ax.get_ylabel() == f"{('attitude', 'bias')[state // 3]} {'xyz'[state % 3]}, {unit}"
        drawn = ax.lines[-1].get_ydata()
        assert np.abs(drawn).max() == pytest.approx(np.abs(error[:, state]).max() / size)
        top = max(heights(part).max() for part in ax.collections)
        assert top == pytest.approx(3.0 * estimate.sigma[:, state].max() / size, rel=0.02)  # or no lighter part


def test_errors_are_drawn_where_estimate_and_truth_are_known(run):
    """A truth with a gap and a filter of another program that begins late and has neither bias nor σ."""
    estimate, truth = (part.taken(slice(3000)) for part in run)  # few enough for a line of all samples
    gap, late = truth.attitude.copy(), estimate.attitude.copy()
    gap[20:60], late[:9] = np.nan, np.nan
    truth, nothing = dataclasses.replace(truth, attitude=gap), np.full_like(estimate.variance, np.nan)
    other = dataclasses.replace(
        estimate, attitude=late, bias=np.full_like(estimate.bias, np.nan), variance=nothing, covariance=None
    )
    for compared, number, unknown in (
        (estimate, 6, 40),
        (other, 3, 49),
        (dataclasses.replace(other, bias=estimate.bias), 6, 49),
    ):
        axes = plots.error_overview(compared, truth).axes
        assert len(axes) == number
        for ax in axes:
            assert np.isnan(ax.lines[-1].get_ydata()).sum() == unknown
            assert ax.get_ylim()[1] >= np.nanmax(np.abs(ax.lines[-1].get_ydata()[len(late) // 20 :]))
    with pytest.raises(InputError, match=f"truth has {len(gap) - 1} times, the estimate {len(gap)}"):
        plots.error_overview(estimate, truth.taken(slice(1, None)))
    with pytest.raises(InputError, match="truth has no attitude at a time of the estimate"):
        plots.error_overview(estimate, dataclasses.replace(truth, attitude=np.full_like(gap, np.nan)))


@pytest.mark.filterwarnings("error")
def test_a_budget_that_starts_without_error_shows_what_comes_after():
    opposite = dataclasses.replace(SCENARIO.gyro, scale_factor=np.full(3, 1e-4), asymmetry=np.full(3, -1e-4))
    brief = dataclasses.replace(SCENARIO, gyro=opposite, duration=2.0)
    belief = dataclasses.replace(setup.FilterSetup.for_scenario(brief), states=None)
    analysis = covariance.analyse(brief, belief, initial_attitude_sigma=0.0, initial_bias_sigma=0.0, epochs=4)
    assert not analysis.rms[0].any()
    figure = plots.error_budget(analysis)
    figure.draw_without_rendering()
    named = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"angle random walk", "star 1"} <= named
    for ax in figure.axes[2:]:
        tops = [np.max(part.get_paths()[0].vertices, axis=0) for part in ax.collections if part.get_paths()]
        assert max(top[1] for top in tops) == pytest.approx(100.0)  # the shares of later epochs are all that there is
    line = figure.axes[0].lines[0].get_ydata()
    assert np.isnan(line[0])
    assert np.all(line[1:] > 0.0)
    for ax, part, size in (
        (figure.axes[0], slice(3), units.ARCSECOND),
        (figure.axes[1], slice(3, 6), units.DEGREE_PER_HOUR),
    ):
        for line, six in zip(ax.lines, (analysis.rms, analysis.filter_sigma), strict=True):
            np.testing.assert_allclose(line.get_ydata()[1:] * size, np.sqrt(np.mean(six[1:, part] ** 2, axis=1)))


@pytest.mark.filterwarnings("error")
def test_drifts_that_are_rounding_are_reported_and_not_drawn():
    size = units.DEGREE_PER_HOUR
    drifts = [
        Drift(algorithm="one-sample", samples=1, measured=-62.0 * size, predicted=-60.0 * size),
        Drift(algorithm="exact", samples=1, measured=0.0, predicted=0.0),
        Drift(algorithm="without formula", samples=4, measured=1e-9 * size, predicted=np.nan),
    ]
    for shown in (drifts, drifts[1:]):
        ax = plots.drift_by_algorithm(shown)
        ax.figure.draw_without_rendering()
        low, high = ax.get_ylim()
        said = [text for text in ax.texts if text.get_text() == "rounding"]
        assert len(said) == 2
        assert all(low <= text.xy[1] < high for text in said)
        assert sum(np.isfinite(bar.get_height()) for bar in ax.patches) == len(shown) - 2


@pytest.mark.parametrize("look", ["default", "dark_background"])
def test_ink_stands_apart_from_the_ground_of_a_style(look, statistics):
    with matplotlib.style.context(look):
        figure, ax = plots.new_figure()
        plots.nees_over_time([("filter", statistics)], (0.8, 1.2), "state", ax)
        (bounds,) = (patch for patch in ax.patches if patch.get_alpha() == 0.12)
        assert abs(sum(bounds.get_facecolor()[:3]) - sum(to_rgb(figure.get_facecolor()))) > 2.0


def test_a_figure_in_one_format_replaces_that_in_another_and_is_the_same_twice(tmp_path, monkeypatch):
    def draw():
        figure, ax = plots.new_figure()
        ax.plot([0.0, 1.0], label="σ")
        ax.legend()
        return figure

    for other in ("png", "svg", "pdf"):
        (tmp_path / f"a.{other}").write_text("old")
    (tmp_path / "a.json").write_text("{}")
    assert style.save_as({tmp_path / "a": draw()}, "svg") == [tmp_path / "a.svg"]
    assert {path.name for path in tmp_path.iterdir()} == {"a.svg", "a.json"}
    first = (tmp_path / "a.svg").read_bytes()
    assert xml.etree.ElementTree.fromstring(first).tag.endswith("svg")
    style.save_as({tmp_path / "a": draw()}, "svg")
    assert (tmp_path / "a.svg").read_bytes() == first
    with pytest.raises(InputError, match="png, pdf, svg"):
        style.save_as({tmp_path / "a": draw()}, "gif")
    dates = []
    monkeypatch.setattr(Figure, "savefig", lambda _, path, metadata: dates.append(metadata) or path.touch())
    style.save_as({tmp_path / "a": draw()}, "pdf")
    assert dates == [{"CreationDate": None}]


def figures(run, statistics, outcomes):
    """Figures with a legend above each axes, of nine and of few lines, and below all, by name."""
    estimate, _ = run
    pairs = [(a, b) for a in "xyz" for b in "xyz"]
    block = ErrorStateEstimate(
        components=tuple(a if a == b else a + b for a, b in pairs),
        units=tuple("1" if a == b else "rad" for a, b in pairs),
        values=np.zeros((len(estimate.time), 9)),
        variance=np.ones((len(estimate.time), 9)),
    )
    with_states = dataclasses.replace(estimate, error_states={"gyro scale": block})
    spec = gyro.GyroSpec(quantization=1.5e-6, angle_random_walk=3e-5, bias_instability=1e-4, rate_random_walk=5e-5)
    increments = gyro.simulate(spec, np.zeros((50000, 3)), 0.01 * np.arange(50001), np.random.default_rng(1)).increments
    all_terms = (f(increments, 0.01, kind="increments") for f in (allan.allan_deviation, allan.fit_noise))
    return {
        "estimate": plots.estimate_overview(estimate, title="record.h5"),
        "states": plots.states_over_time(with_states, title="record.h5"),
        "coning consistency": plots.coning_consistency(outcomes),
        "runs": plots.runs_overview(statistics),
        "Allan": plots.allan_overview(*all_terms),
    }


def test_the_estimate_is_drawn_in_the_unit_of_its_axis(run):
    estimate, _ = run
    axes = plots.estimate_overview(estimate).axes
    yaw, pitch, roll = Rotation.from_quat(estimate.attitude, scalar_first=True).as_euler("ZYX", degrees=True).T
    for ax, name, angle in zip(axes, ("roll, °", "pitch, °", "yaw, °"), (roll, pitch, yaw), strict=False):
        assert ax.get_ylabel() == name
        assert ax.lines[0].get_ydata()[-1] == pytest.approx(angle[-1])
    size = {"gyro bias, °/h": np.pi / 180.0 / 3600.0, "gyro bias, °/s": np.pi / 180.0}[axes[3].get_ylabel()]
    for k, (line, band) in enumerate(zip(axes[3].lines, axes[3].collections, strict=True)):
        assert line.get_ydata()[-1] * size == pytest.approx(estimate.bias[-1, k], rel=1e-12)
        top = np.max(estimate.bias[:, k] + 3.0 * estimate.sigma[:, 3 + k])
        assert heights(band).max() * size == pytest.approx(top)
    assert axes[4].get_ylabel() == "attitude σ, arcsec"
    top = heights(axes[4].collections[0]).max() * units.ARCSECOND
    assert top == pytest.approx(np.linalg.norm(estimate.sigma[:, :3], axis=1).max())


def test_errors_of_a_recording_are_drawn_about_the_fixed_axes_with_sign_and_sigma():
    """A body on its side: the error about fixed z is one about body y, and so is its σ."""
    degree, n = units.DEGREE, 50
    q = np.tile(quaternion.exp([0.5 * np.pi, 0.0, 0.0]), (n, 1))  # body y points along fixed z
    error = np.array([0.4, -0.2, 0.7]) * degree
    reference = quaternion.multiply(quaternion.exp(error), q)
    reference[3] = np.nan
    covariance = np.tile(np.diag([1.0, 4.0, 9.0]) * degree**2, (n, 1, 1))
    for estimate in (
        Estimate.from_arrays(np.arange(n) * 1.0, q, covariance),
        dataclasses.replace(Estimate.from_arrays(np.arange(n) * 1.0, q, covariance), covariance=None),
    ):
        movement = np.arange(n) > 20
        axes = plots.recording_errors(estimate, reference, movement).axes
        for ax, name, value, sigma in zip(
            axes, ("heading", "about x", "about y"), (0.7, 0.4, -0.2), (2.0, 1.0, 3.0), strict=True
        ):
            assert name in ax.get_ylabel()
            drawn = ax.lines[-1].get_ydata()
            assert np.nanmax(drawn) == pytest.approx(value)
            assert np.nanmin(drawn) == pytest.approx(value)
            assert heights(ax.collections[0]).max() == pytest.approx(3.0 * sigma)
            assert ax.get_ylim()[1] > abs(value)


def test_the_errors_of_many_algorithms_go_into_rows(outcomes):
    figure = plots.coning_errors(list(outcomes) * 4)
    assert figure.get_figwidth() <= 3.1 * 5
    drawn = [ax for ax in figure.axes if ax.get_visible()]
    assert len(drawn) == 2 * 4 * len(outcomes)
    assert sum("attitude" in ax.get_ylabel() for ax in drawn) == sum("bias" in ax.get_ylabel() for ax in drawn) == 2


def test_error_states_are_drawn_with_three_sigma(run):
    estimate, _ = run
    every = np.ones((len(estimate.time), 1))
    block = ErrorStateEstimate(
        components=("x", "y"), units=("1", "1"), values=every * [1e-4, -2e-4], variance=every * [1e-10, 4e-10]
    )
    (ax,) = plots.states_over_time(dataclasses.replace(estimate, error_states={"gyro scale": block})).axes
    assert ax.get_ylabel() == "ppm"
    for line, level in zip(ax.lines, (70.0, 130.0, 100.0, -260.0, -140.0, -200.0), strict=True):
        np.testing.assert_allclose(line.get_ydata(), level)


@pytest.fixture(scope="module")
def outcomes(statistics):
    return [FilterOutcome(integration=name, statistics=statistics) for name in ("a", "b")]


def test_no_legend_covers_a_curve_and_ticks_are_plain(run, statistics, outcomes):
    for name, figure in figures(run, statistics, outcomes).items():
        with matplotlib.rc_context(style.STYLE):
            figure.draw_without_rendering()
        assert all(ax.has_data() for ax in figure.axes if ax.get_visible())
        legends = [*figure.legends, *(ax.get_legend() for ax in figure.axes if ax.get_legend())]
        for legend in legends:
            place = legend.get_window_extent()
            assert place.width > 0.0
            for ax in figure.axes:
                inside = ax.get_window_extent().shrunk(0.99, 0.99)
                assert not place.overlaps(inside), f"{name}: the legend lies over the curves"
            assert figure.bbox.x0 <= place.x0, f"{name}: the legend is cut off"
            assert place.x1 <= figure.bbox.x1 + 1.0, f"{name}: the legend is cut off"
        for ax in figure.axes:
            for title in (ax.title, ax._left_title, ax._right_title):
                assert title.get_window_extent().x1 <= figure.bbox.x1 + 1.0, f"{name}: {title.get_text()}"
                own = ax.get_legend().get_window_extent() if title.get_text() and ax.get_legend() else None
                assert own is None or not own.overlaps(title.get_window_extent()), f"{name}: {title.get_text()}"
            with matplotlib.rc_context(style.STYLE):
                for axis in (ax.xaxis, ax.yaxis):
                    labels = axis.get_major_formatter().format_ticks([0.001, 0.01, 1.0, 1000.0])
                    assert not any("10^" in label for label in labels), f"{name}: {labels}"


def test_judged_epochs_are_marked_and_their_bounds_drawn(statistics, outcomes):
    ax = plots.coning_consistency(outcomes).axes[0]
    judged = next(line for line in ax.lines if line.get_label() == "judged epoch")
    np.testing.assert_array_equal(judged.get_xdata(), statistics.time[statistics.judged_epochs])
    low, high = statistics.verdict(statistics.judged_epochs, "attitude", 0.99).simultaneous_bounds
    band = next(patch for patch in ax.patches if "99 %" in patch.get_label())
    np.testing.assert_allclose(limits(band), [low, high])


def test_different_scales_side_by_side_are_marked():
    _, axes = plots.new_figure(1, 3)
    for ax, top in zip(axes, (1.0, 1.8, 20.0), strict=True):
        ax.set_ylim(-top, top)
    style.match_scales(axes)
    assert axes[0].get_ylim() == axes[1].get_ylim() == pytest.approx((-1.8, 1.8))
    assert axes[2].get_ylim() == (-20.0, 20.0)
    assert [ax.get_title(loc="right") for ax in axes] == ["", "", "vertical scale ×11"]


def test_angles_are_named_with_their_sense():
    """By turning a vector: each angle grows as its label says, in the sequence Z-Y-X."""
    roll, pitch, yaw = estimates.angle_labels("East-North-Up, magnetic North")
    assert yaw.endswith("from East to North")
    assert estimates.angle_labels()[2].endswith("from fixed x to y")
    for label, vector, toward in ((roll, 1, 2), (pitch, 2, 0), (yaw, 0, 1)):
        axis = 3 - vector - toward
        turned = quaternion.rotate(quaternion.exp(0.1 * np.eye(3)[axis]), np.eye(3)[vector])
        assert turned[toward] > 0.09
        if "fixed" not in label:
            assert label.endswith(f"{'xyz'[vector]} to {'xyz'[toward]}")


def test_angle_units_are_those_that_are_read_best():
    assert units.angle_unit(np.array([1e-5]))[0] == "arcsec"
    assert units.angle_unit(np.array([0.1, np.nan]))[0] == "°"
    assert units.rate_unit(np.array([1e-6]))[0] == "°/h"
    assert units.rate_unit(np.array([0.1]))[0] == "°/s"


def test_a_name_that_the_font_lacks_makes_no_noise(tmp_path, recwarn):
    figure, ax = plots.new_figure()
    ax.set(title="記録.h5", yscale="log", ylim=(0.5, 3e7))
    plots.save(figure, tmp_path / "x.png")
    assert not recwarn.list
    with matplotlib.rc_context(style.STYLE):
        (label,) = (tick.get_text() for tick in ax.get_yticklabels() if tick.get_position()[1] == 100.0)
    assert "10^" in label  # as beside it 10⁶


def test_a_backend_that_matplotlib_does_not_know_is_reported_in_one_line(tmp_path):
    code = "from strapdown.checks import InputError\ntry:\n    import strapdown.plots\nexcept InputError as error:\n    print(error)"
    environment = {**os.environ, "MPLBACKEND": "nonsense"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("matplotlib cannot be loaded (Key backend: 'nonsense'")
    assert "correct the environment variable MPLBACKEND" in done.stdout


@pytest.mark.parametrize(("limits", "powers"), [((0.5, 3e7), True), ((2e-6, 1.0), True), ((0.5, 5e4), False)])
def test_a_logarithmic_axis_is_labelled_in_one_style(limits, powers):
    """The figure of the unknown start had 10000 beside 10⁶."""
    figure, ax = plots.new_figure()
    ax.set(yscale="log", ylim=limits)
    style.label_alike(figure)
    with matplotlib.rc_context(style.STYLE):
        ticks = ax.get_yticklabels()
    labels = [tick.get_text() for tick in ticks if limits[0] <= tick.get_position()[1] <= limits[1]]
    assert len(labels) >= 3
    assert {"10^" in label for label in labels} == {powers}


@pytest.mark.parametrize("limits", [(3e-3, 6e-3), (0.8, 1.3), (1e-4, 1e3)])
def test_a_logarithmic_axis_has_several_labels_that_are_their_values(limits):
    figure, ax = plots.new_figure()
    style.log_scale(ax)
    ax.set_ylim(limits)
    figure.draw_without_rendering()
    shown = {
        tick.get_position()[1]: tick.get_text()
        for tick in ax.get_yticklabels()
        if limits[0] <= tick.get_position()[1] <= limits[1]
    }
    assert 2 <= len(shown) <= 12
    assert all(float(text) == pytest.approx(value) for value, text in shown.items())
