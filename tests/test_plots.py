"""Figures: what is drawn is what was given, with units, in both themes, and no extreme is lost."""

from __future__ import annotations

import dataclasses

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from strapdown import (
    coning,
    consistency,
    covariance,
    gyro,
    montecarlo,
    motion,
    plots,
    quaternion,
    records,
    scenarios,
    setup,
    units,
)
from strapdown.checks import InputError
from strapdown.coning_study import Drift
from strapdown.montecarlo.statistics import BINS_PER_OCTAVE
from strapdown.plots import style
from strapdown.plots.sphere import body_axis_path


@pytest.fixture(scope="module")
def scenario():
    spec = gyro.GyroSpec(angle_random_walk=5e-5, rate_random_walk=1e-6, turn_on_bias_sigma=1e-4)
    return dataclasses.replace(scenarios.load_scenario("coning"), gyro=spec, gyro_preset="", duration=20.0)


@pytest.fixture(scope="module")
def filter_setup(scenario):
    return dataclasses.replace(setup.matched(scenario), integration=coning.ALGORITHMS["four-sample"])


@pytest.fixture(scope="module")
def run(scenario, filter_setup):
    record = scenarios.simulate(scenario, 3)
    start = setup.initial_state(filter_setup, record.truth.attitude[0], record.truth.bias[0])
    estimate = setup.run(record, filter_setup, start, full_covariance=True)
    return estimate, records.compress(record, filter_setup.integration).truth


@pytest.fixture(scope="module")
def statistics(scenario, filter_setup):
    return montecarlo.run_plan(montecarlo.Plan(scenario=scenario, setup=filter_setup, epochs=25, nis_bins=20), runs=24)


@pytest.mark.parametrize("samples", [10, 4000, 4001, 12_345, 1_000_003])
def test_decimation_keeps_every_extreme_and_the_order(samples):
    random = np.random.default_rng(5)
    value = random.standard_normal(samples)
    spikes = random.integers(0, samples, 4)
    value[spikes] = [50.0, -60.0, 70.0, -80.0]
    time = np.arange(samples, dtype=float)
    when, drawn = plots.decimated(time, value)
    assert len(drawn) <= 4000 + 2
    assert drawn.max() == value.max()
    assert drawn.min() == value.min()
    assert np.all(np.diff(when) >= 0.0)
    np.testing.assert_array_equal(drawn, value[when.astype(int)])


def test_decimation_keeps_gaps():
    value = np.ones(100_000)
    value[30_000:60_000] = np.nan
    _, drawn = plots.decimated(np.arange(100_000.0), value)
    assert 0.25 < np.isnan(drawn).mean() < 0.35


def test_a_long_record_is_drawn_with_few_points():
    time = np.linspace(0.0, 1e4, 2_000_000)
    error = np.sin(time)[None]
    error[0, 1_234_567] = 42.0
    _, ax = plots.new_figure()
    plots.errors_in_envelope(time, error, np.ones(len(time)), ax)
    line = ax.lines[-1]
    assert len(line.get_xdata()) <= 4002
    assert line.get_ydata().max() == 42.0


def test_every_function_draws_into_the_axes_it_is_given(run, statistics):
    estimate, truth = run
    innovations = next(iter(estimate.innovations.values()))
    white = innovations.whitened
    error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)
    size = consistency.distribution(np.linalg.norm(error[:, :3], axis=1))
    for draw in (
        lambda ax: plots.innovation_histogram(white, ax),
        lambda ax: plots.innovation_quantiles(consistency.quantile_pairs(white), ax),
        lambda ax: plots.innovation_autocorrelation(consistency.autocorrelation(white), ax),
        lambda ax: plots.nis_over_record(innovations, consistency.mean_bounds(2, 1), ax),
        lambda ax: plots.error_distribution(size, ax),
        lambda ax: plots.body_axis_on_sphere(estimate.attitude, truth.attitude, 2, ax),
        lambda ax: plots.fan(statistics, 0, ax),
        lambda ax: plots.fan(statistics, 4, ax),
        lambda ax: plots.coverage_by_state(statistics, -1, ax),
        lambda ax: plots.covariance_ellipses(statistics.covariance[-1], statistics.mean_square_error[-1], (0, 4), ax),
        lambda ax: plots.nees_over_time([("filter", statistics)], (0.8, 1.2), "bias", ax),
        lambda ax: plots.nis_over_time([("filter", statistics)], ax),
    ):
        _, ax = plots.new_figure()
        assert draw(ax) is ax
        assert ax.get_ylabel()
        ax.figure.canvas.draw()
        assert draw(None) is not ax


def test_the_histogram_counts_what_lies_beyond():
    white = np.concatenate([np.zeros(100), [9.0, -7.0]])[:, None]
    ax = plots.innovation_histogram(white)
    assert any("2 beyond" in text.get_text() for text in ax.get_legend().get_texts())


def test_errors_are_drawn_in_the_unit_of_their_label(run):
    estimate, truth = run
    figure = plots.error_overview(estimate, truth)
    error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)
    for column, unit, size in ((0, "arcsec", units.ARCSECOND), (1, "°/h", units.DEGREE_PER_HOUR)):
        ax = figure.axes[column]
        assert unit in ax.get_ylabel()
        drawn = ax.lines[-1].get_ydata()
        assert np.abs(drawn).max() == pytest.approx(np.abs(error[:, 3 * column]).max() / size)


@pytest.mark.filterwarnings("error")
def test_a_budget_that_starts_without_error_shows_what_comes_after(scenario, tmp_path):
    found = covariance.analyse(
        dataclasses.replace(scenario, duration=2.0), initial_attitude_sigma=0.0, initial_bias_sigma=0.0, epochs=4
    )
    assert not found.rms[0].any()
    figure = plots.error_budget(found)
    plots.save(figure, tmp_path / "budget.png")
    named = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"angle random walk", "star 1"} <= named
    for ax in figure.axes[2:]:
        tops = [np.max(part.get_paths()[0].vertices, axis=0) for part in ax.collections if part.get_paths()]
        assert max(top[1] for top in tops) == pytest.approx(100.0)  # the shares of later epochs are all that there is
    line = figure.axes[0].lines[0].get_ydata()
    assert np.isnan(line[0])
    assert np.all(line[1:] > 0.0)


@pytest.mark.filterwarnings("error")
def test_drifts_that_are_rounding_are_told_and_not_drawn(tmp_path):
    size = units.DEGREE_PER_HOUR
    drifts = [
        Drift(algorithm="one-sample", samples=1, measured=-62.0 * size, predicted=-60.0 * size),
        Drift(algorithm="exact", samples=1, measured=0.0, predicted=0.0),
        Drift(algorithm="without formula", samples=4, measured=1e-9 * size, predicted=np.nan),
    ]
    for given in (drifts, drifts[1:]):
        ax = plots.drift_by_algorithm(given)
        plots.save(ax.figure, tmp_path / "drift.png")
        low, high = ax.get_ylim()
        said = [text for text in ax.texts if text.get_text() == "rounding"]
        assert len(said) == 2
        assert all(low <= text.xy[1] < high for text in said)
        assert sum(np.isfinite(bar.get_height()) for bar in ax.patches) == len(given) - 2


def test_the_ellipse_holds_its_share():
    random = np.random.default_rng(1)
    factor = np.array([[1.0, 0.0], [0.7, 0.4]])
    claimed = np.zeros((6, 6))
    claimed[:2, :2] = factor @ factor.T
    ax = plots.covariance_ellipses(claimed, claimed, (0, 1))
    ellipse = ax.patches[0]
    points = (factor @ random.standard_normal((2, 20_000))).T / units.DEGREE
    inside = ellipse.contains_points(ax.transData.transform(points))
    assert inside.mean() == pytest.approx(0.95, abs=0.01)


def test_the_path_is_that_of_the_axis():
    cone = motion.Coning(angle=0.4, frequency=0.5)
    path = body_axis_path(cone.attitude(np.linspace(0.0, 2.0, 50)), 2)
    np.testing.assert_allclose(np.linalg.norm(path, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(path[:, 2], np.cos(0.4), atol=1e-12)  # equation (18): the axis stays on its cone
    with pytest.raises(InputError, match="0, 1 or 2"):
        body_axis_path(np.array([[1.0, 0.0, 0.0, 0.0]]), 3)


@pytest.mark.parametrize("angle", [0.01, 0.8])
def test_the_sphere_is_drawn_for_wide_paths_only(angle):
    attitude = motion.Coning(angle=angle, frequency=0.5).attitude(np.linspace(0.0, 2.0, 50))
    figure = plots.sphere_figure(attitude, attitude)
    figure.canvas.draw()
    assert (len(figure.axes[0].lines) > 2) == (angle > 0.35)


def test_an_animation_is_written_whole(tmp_path):
    from PIL import Image

    attitude = motion.Coning(angle=0.5, frequency=0.5).attitude(np.linspace(0.0, 2.0, 50))
    target = plots.animate_body_axis(tmp_path / "cone.gif", attitude, frames=5)
    with Image.open(target) as image:
        assert image.n_frames == 5
    with pytest.raises(InputError, match=r"\.gif or \.mp4"):
        plots.animate_body_axis(tmp_path / "cone.avi", attitude)
    assert [path.name for path in tmp_path.iterdir()] == ["cone.gif"]


@pytest.mark.parametrize(("theme", "ground"), [("light", "#ffffff"), ("dark", "#16181d")])
def test_both_themes_keep_ink_apart_from_the_ground(theme, ground, statistics):
    with plots.theme(theme):
        figure, ax = plots.new_figure()
        plots.nees_over_time([("filter", statistics)], (0.8, 1.2), "state", ax)
        assert to_rgb(figure.get_facecolor()) == to_rgb(ground)
        contrast = abs(sum(to_rgb(style.ink())) - sum(to_rgb(ground)))
        assert contrast > 2.0
    assert matplotlib.rcParams["figure.facecolor"] == "white"  # nothing stays behind
    with pytest.raises(InputError, match="light"), plots.theme("ligth"):
        pass


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_figures_are_saved_in_every_form(tmp_path, suffix):
    figure, ax = plots.new_figure()
    ax.plot([0.0, 1.0])
    assert plots.save(figure, tmp_path / f"figure.{suffix}").stat().st_size > 1000


def test_angle_units_are_those_that_are_read_best():
    assert style.angle_unit(np.array([1e-5]))[0] == "arcsec"
    assert style.angle_unit(np.array([0.1, np.nan]))[0] == "°"
    assert style.rate_unit(np.array([1e-6]))[0] == "°/h"
    assert style.rate_unit(np.array([0.1]))[0] == "°/s"


def test_wrapped_quaternions_do_not_matter_to_the_path():
    q = quaternion.exp(np.array([[0.1, 0.2, 0.3]]))
    np.testing.assert_allclose(body_axis_path(q), body_axis_path(-q), atol=1e-15)


def test_axes_beside_each_other_are_in_one_unit(statistics):
    """Of three attitude errors of which one is large none is told in arcseconds."""
    histogram = statistics.histogram.copy()
    for state in (2, 5):
        histogram[:, state] = np.roll(histogram[:, state], 12 * BINS_PER_OCTAVE, axis=-1)
    uneven = dataclasses.replace(statistics, histogram=histogram)
    quantile = uneven.error_quantile(0.99)[-1]
    assert quantile[2] > 1e3 * statistics.error_quantile(0.99)[-1, 2]
    for first in (0, 3):
        labels = {plots.fan(uneven, first + k).get_ylabel().rsplit(", ")[-1] for k in range(3)}
        assert len(labels) == 1
    P = np.diag([1e-5, 1e-5, 1e-1, 1e-7, 1e-7, 1e-2]) ** 2
    ax = plots.covariance_ellipses(P, P, (0, 2))
    assert ax.get_xlabel().endswith(", °")
    assert ax.get_ylabel().endswith(", °")


def test_a_name_that_the_font_lacks_makes_no_noise(tmp_path, recwarn):
    figure, ax = plots.new_figure()
    ax.set_title("記録.h5")
    plots.save(figure, tmp_path / "x.png")
    assert not recwarn.list
