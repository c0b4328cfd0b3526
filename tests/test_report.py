"""Reports: self-contained pages whose words, numbers and figures are those of the result."""

import base64
import dataclasses
import html.parser
import json
import re
import shutil
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace

import coning_case
import numpy as np
import pytest
import scipy.stats
from coning_case import SETUP, estimated
from matplotlib.figure import Figure
from typer.testing import CliRunner

import strapdown as sd
from strapdown import cli, montecarlo, quaternion, records, report, scenarios
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.montecarlo import campaign, coning_study, verdicts
from strapdown.report import comparisons, page
from strapdown.results import Table
from strapdown.units import DEGREE_PER_HOUR

sys.path.append(str(Path(__file__).resolve().parents[1] / "docs"))
import headless

SCENARIO = dataclasses.replace(coning_case.SCENARIO, duration=60.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results: an estimate with truth, one without, one of a filter that is wrong, a campaign."""
    where = tmp_path_factory.mktemp("results")
    estimate, truth = estimated(SCENARIO)
    details = {"command": "a <b> & c", "notes": "x = 1\ny = 2"}
    setup.write_estimate(where / "right.h5", dataclasses.replace(estimate, truth=truth, details=details))
    setup.write_estimate(where / "blind.h5", estimate)
    wrong, truth = estimated(SCENARIO, dataclasses.replace(SETUP, measurement_sigma_factor=0.3))
    origin = records.Origin(source="walk.csv")
    setup.write_estimate(where / "wrong.h5", dataclasses.replace(wrong, truth=truth, origin=origin))
    plan = montecarlo.Plan(scenario=coning_case.SCENARIO, setup=SETUP, epochs=25, nis_bins=20)
    campaign.run(plan, where / "campaign.h5", runs=16)
    for name in ("right", "campaign", "blind"):
        report.write(where / f"{name}.h5")
    result = CliRunner().invoke(cli.app, ["report", str(where / "wrong.h5"), "-o", str(where / "wrong.html")])
    assert result.exit_code == 0, result.output
    assert "not consistent" in result.output
    return where


def body(path):
    return path.read_text(encoding="utf-8")


def unpacked(column, kind):
    """Return the integers of a packed column, read independently of the page's JavaScript."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(column["deflate"])), np.uint8)
    size = np.dtype(kind).itemsize
    steps = np.ascontiguousarray(planes.reshape(size, -1).T).view(kind)[:, 0]
    return np.cumsum(steps.astype(np.int64)) if size == 4 else np.cumsum(steps, dtype=np.int16)


def columns(content):
    """Return the times and the series of a chart, NaN where there is a gap."""
    integers = [unpacked(column, "<i2") for column in content["data"]]
    time = content["time"]["first"] + content["time"]["tick"] * unpacked(content["time"], "<i4")
    block = np.arange(len(time)) // page.BLOCK
    return time, *(
        np.where(whole == -32768, np.nan, np.array(column["offset"])[block] + np.array(column["scale"])[block] * whole)
        for column, whole in zip(content["data"], integers, strict=True)
    )


def charts_of(content):
    """Return the JSON of the charts of a page."""
    texts = re.findall(r'<script type="application/json">(.*?)</script>', content, re.S)
    return [chart for text in texts if "unit" in (chart := json.loads(text.replace("<\\/", "</")))]


def test_charts_hold_every_sample(folder):
    charts = charts_of(body(folder / "right.html"))[:6]
    assert [chart["unit"].split(", ")[1] for chart in charts] == ["arcsec"] * 3 + ["°/h"] * 3
    estimate = setup.read_estimate(folder / "right.h5")
    truth = estimate.truth
    error = (truth.bias - estimate.bias) * 180.0 / np.pi * 3600.0
    sigma = np.sqrt(estimate.variance[:, 3:]) * 180.0 / np.pi * 3600.0
    for axis in range(3):
        time, high, low, drawn = columns(charts[3 + axis])
        np.testing.assert_allclose(time, estimate.time, atol=1e-6)
        for value, true in ((high, 3.0 * sigma[:, axis]), (low, -3.0 * sigma[:, axis]), (drawn, error[:, axis])):
            np.testing.assert_allclose(value, true, atol=0.51 * np.ptp(true) / 65534.0)


def test_charts_of_innovations_are_those_of_their_definitions(folder, monkeypatch):
    monkeypatch.setattr(report.estimates, "WINDOW", 7)
    innovations = dataclasses.replace(next(iter(setup.read_estimate(folder / "right.h5").innovations.values())))
    number, degrees = innovations.innovation.shape
    innovations.innovation[:2, 0] = [9.0, -7.0] * np.sqrt(innovations.variance[:2, 0])  # beyond the last bins
    white, nis = innovations.whitened, innovations.nis / degrees
    shape, lags, course = map(columns, charts_of(report.estimates._sensor("star", innovations)))
    width = np.diff(shape[0])[0]
    assert np.sum(shape[1]) * width == pytest.approx(1.0, rel=1e-3)
    assert shape[1][[0, -1]] == pytest.approx([1.0 / (2 * number * width)] * 2, rel=1e-2)
    np.testing.assert_allclose(shape[2], scipy.stats.norm.pdf(shape[0]), atol=1e-5)
    spread = np.sqrt((number - lags[0]) / (number * (number + 2.0)))
    np.testing.assert_allclose(lags[1], scipy.stats.norm.isf(0.005 / (degrees * len(lags[0]))) * spread, rtol=1e-3)
    np.testing.assert_allclose(lags[2], -lags[1], rtol=1e-3)
    first_lag = np.sum(white[1:] * white[:-1], axis=0) / np.sum(white**2, axis=0)
    np.testing.assert_allclose([line[0] for line in lags[3:]], first_lag, atol=1e-4)
    np.testing.assert_allclose(course[3], nis, atol=1e-4 * nis.max())
    for k in (3, number - 4):  # each mean at the middle of its window
        assert course[4][k] == pytest.approx(nis[k - 3 : k + 4].mean(), abs=1e-3)
    assert np.isnan(course[4][[0, 2, -3, -1]]).all()


def test_the_distribution_of_the_error_has_its_quantiles(folder):
    estimate = setup.read_estimate(folder / "right.h5")
    angle, share = columns(charts_of(body(folder / "right.html"))[-1])
    error = np.degrees(quaternion.angle_between(estimate.attitude, estimate.truth.attitude))
    np.testing.assert_allclose(angle, np.sort(error), atol=2e-6)
    np.testing.assert_allclose(share[[0, -1]], [100.0 / len(error), 100.0], rtol=1e-3)
    assert f"median {np.median(error):.3g}°" in body(folder / "right.html")


def test_a_page_says_what_its_file_says_of_itself(folder):
    """It cannot break the page; the title names the recording; without a truth the page says what it cannot show."""
    right, wrong = (body(folder / f"{name}.html") for name in ("right", "wrong"))
    assert "a &lt;b&gt; &amp; c" in right
    assert "<pre>x = 1\ny = 2</pre>" in right
    assert "<title>Estimate of walk.csv</title>" in wrong
    assert "wrong.h5: " in wrong
    assert "without a truth only the innovations are judged" in body(folder / "blind.html")
    worst = json.loads((folder / "campaign.report.json").read_text())["worst_runs"][0]
    assert f'sd.read("campaign.h5").plan, {worst}' in html.unescape(body(folder / "campaign.html"))


def test_the_campaign_page_draws_the_normal_quantiles_of_the_filters_sigma(folder):
    statistics = sd.read(folder / "campaign.h5").statistics
    (chart,) = (
        chart for chart in charts_of(body(folder / "campaign.html")) if chart["title"].startswith("|bias y error|")
    )
    assert chart["log"]  # from 26 to 0.4 °/h
    assert chart["unit"].endswith("°/h")
    assert [series["label"].split(" %")[0] for series in chart["series"]] == ["99", "50", "99", "50"]
    sigma = statistics.sigma[:, 4] / DEGREE_PER_HOUR
    quantiles = [statistics.error_quantile(share)[:, 4] / DEGREE_PER_HOUR for share in (0.99, 0.5)]
    predicted = [scipy.stats.norm.ppf(0.5 + 0.5 * share) * sigma for share in (0.99, 0.5)]
    for drawn, wanted in zip(columns(chart)[1:], [*quantiles, *predicted], strict=True):
        np.testing.assert_allclose(drawn, wanted, rtol=1e-4, atol=2e-5 * wanted.max())


def test_the_campaign_page_says_what_the_filter_has_no_state_for(folder, tmp_path):
    assert "does not model" not in body(folder / "campaign.html")
    assert ">reason<" not in body(folder / "campaign.html")
    held = campaign.read(folder / "campaign.h5")
    spec = dataclasses.replace(SCENARIO.gyro, scale_factor=np.full(3, 0.05))
    plan = dataclasses.replace(held.plan, scenario=dataclasses.replace(held.plan.scenario, gyro=spec))
    campaign.run(plan, tmp_path / "scaled.h5", runs=16)
    content = body(report.write(tmp_path / "scaled.h5").page)
    assert "<strong>Not consistent.</strong>" in content
    assert (
        "; the filter does not model the gyro&#x27;s scale factor of 50000 ppm"
        in content[: content.index("<h2>Key numbers")]
    )


def test_a_tuning_is_reported_from_its_json(folder, tmp_path):
    (tmp_path / "scenario.toml").write_text(scenarios.scenario_to_toml(SCENARIO), encoding="utf-8")
    tune = ["tune", str(tmp_path / "record.h5"), "--free", "star 1.sigma", "--starts", "1"]
    tune += ["-o", str(tmp_path / "filter.toml")]
    for command in (
        ["simulate", str(tmp_path / "scenario.toml"), "--out", str(tmp_path / "record.h5")],
        [*tune, "--holdout", "0.3"],
        ["report", str(tmp_path / "filter.json")],
    ):
        result = CliRunner().invoke(cli.app, command)
        assert result.exit_code == 0, result.output
    content = body(tmp_path / "filter.html")
    tuned = json.loads((tmp_path / "filter.json").read_text())
    (parameter,) = tuned["parameters"]
    assert (parameter["unit"], parameter["si_per_unit"]) == ("arcsec", pytest.approx(np.pi / 648000.0))
    assert "<td>star 1.sigma</td><td>arcsec</td>" in content
    for value in (parameter["value"], parameter["lower"], parameter["upper"]):
        assert f">{value / parameter['si_per_unit']:.3g}<" in content
    assert "the verdict is for all tests of a record together" in content
    assert tuned["held_out"]["after"]["judgements"][0]["verdict"].capitalize() in content.split("<h2>")[0]
    assert "data:image/png" not in content  # the charts are drawn by the browser
    assert "[filter]" in content
    (slices,) = charts_of(content)
    x, high, _, fallen, tuned, _ = columns(slices)
    assert slices["x"] == "star 1.sigma, arcsec"
    assert np.abs(fallen[np.isfinite(tuned)]).max() < 0.01  # no decrease at the tuned value
    np.testing.assert_allclose(x[np.isfinite(tuned)], parameter["value"] / parameter["si_per_unit"], rtol=1e-6)
    edges = np.array([parameter["lower"], parameter["upper"]]) / parameter["si_per_unit"]
    np.testing.assert_allclose(x[np.isfinite(high)][[0, -1]], edges, rtol=1e-6)
    np.testing.assert_allclose(np.interp(edges, x, fallen), 3.84, rtol=0.2)  # one parameter: a likelihood ratio
    if headless.CHROMIUM is not None:
        reported = headless.reported(tmp_path / "filter.html", DRAWN, 1000, "--virtual-time-budget=20000")
        assert (reported["drawn"], reported["console"]) == ("1", [])
    assert (slices["unit"], slices["series"][0]["label"]) == ("−2 Δ log likelihood", "95 % interval")
    held = json.loads((tmp_path / "filter.json").read_text())
    held["objective"]["name"], held["parameters"][0]["identified"] = "likelihood of the errors", False
    (tmp_path / "other.json").write_text(json.dumps(held), encoding="utf-8")
    (slices,) = charts_of(body(report.write(tmp_path / "other.json").page))
    assert (slices["unit"], slices["series"][0]["label"]) == ("2 Δ objective", "below the 95 % bound")
    with pytest.raises(InputError, match="give the JSON that `strapdown tune` writes"):
        report.write(folder / "right.report.json", tmp_path / "page.html")
    # A tuning without data held out, of the same name, leaves nothing of what was said of held-out data before.
    assert CliRunner().invoke(cli.app, tune).exit_code == 0
    content = body(report.write(tmp_path / "filter.json").page)
    assert ", on held-out data" not in content
    assert "<strong>Consistent.</strong> The tuned filter agrees with the data used for tuning" in content


@pytest.fixture(scope="module")
def coning_json(tmp_path_factory):
    where = tmp_path_factory.mktemp("coning")
    study = coning_study.run(coning_study.ConingParameters(runs=1, duration=12.0))
    (where / "coning.json").write_text(json.dumps(study.summary()), encoding="utf-8")
    return where / "coning.json"


def test_a_coning_study_is_reported_from_its_json(coning_json, tmp_path):
    study = json.loads(coning_json.read_text())
    Figure(figsize=(9.0, 2.0), dpi=100).savefig(coning_json.with_name("errors.png"))
    content = body(report.write(coning_json).page)
    assert {row["verdict"] for row in study["filter"][1:]} == {"cannot tell"}  # of one short run
    assert "Not consistent with one-sample; cannot tell with two-sample, three-sample" in content.split("<h2>")[0]
    drift = charts_of(content)[0]
    assert drift["ticks"] == [row["algorithm"] for row in study["integration"]]
    measured = [abs(row["drift_deg_per_hour"]) for row in study["integration"]]
    np.testing.assert_allclose(columns(drift)[1][:3], measured[:3], rtol=2e-3)
    assert np.isnan(columns(drift)[1][4])  # rounding
    for row in study["filter"]:
        shown = rows_of(content.split("The same filter")[-1], f"{row['integration']}")
        np.testing.assert_allclose(shown[2], row["bias_rms_deg_per_hour"], rtol=6e-4)
    if headless.CHROMIUM is not None:  # names side by side where there is room, else aslant
        turned = "{turned: (({plot}) => [plot, {width: 1200}].map(plot.axes[0].rotate))(strapdownCharts.drawn()[0]), "
        turned += (
            "wide: document.images[0].getBoundingClientRect().width, look: getComputedStyle(document.images[0]).filter}"
        )
        script = DRAWN.replace("{drawn}", turned)
        reported = headless.reported(coning_json.with_suffix(".html"), script, 500, *DARK)
        assert reported["turned"] == [30, 0]
        assert reported["wide"] > 300.0
        assert reported["look"] == "invert(0.9) hue-rotate(180deg)"  # white becomes the dark ground
    (tmp_path / "broken.json").write_text(json.dumps({**study, "filter": [{}]}), encoding="utf-8")
    with pytest.raises(InputError, match="does not fit a coning study"):
        report.write(tmp_path / "broken.json")


def test_two_estimates_on_one_page(folder, tmp_path):
    """The second is three times too sure and sees other measurements as more exact: the difference is that of the files."""
    first, second = (setup.read_estimate(folder / f"{name}.h5") for name in ("right", "wrong"))
    cut = {name: getattr(second, name)[100:-50] for name in ("time", "attitude", "bias", "variance", "covariance")}
    part_of = dataclasses.replace(second, **cut, truth=None, fixed_frame="East-North-Up")
    setup.write_estimate(tmp_path / "cut.h5", part_of)
    gaps = first.truth.attitude.copy()
    gaps[:40] = np.nan
    lost = dataclasses.replace(first, truth=dataclasses.replace(first.truth, attitude=gaps))
    setup.write_estimate(tmp_path / "gaps.h5", lost)
    difference = quaternion.angle_between(first.attitude, second.attitude)
    for file, other, part in (
        (tmp_path / "gaps.h5", tmp_path / "cut.h5", slice(100, -50)),
        (folder / "right.h5", folder / "wrong.h5", slice(None)),
    ):
        written = report.write(file, tmp_path / "both.html", other=other)
        numbers = json.loads(written.statistics.read_text())
        rms = np.sqrt(np.mean(difference[part] ** 2))
        assert numbers["attitude_difference_rms_rad"] == pytest.approx(rms, rel=1e-9)
        assert ("fixed frames: the scenario&#x27;s and East-North-Up" in body(written.page)) == (other.stem == "cut")
        assert charts_of(body(written.page))[-1]["title"] == "Total attitude error relative to the truth"
    bias = np.sqrt(np.mean((second.bias - first.bias) ** 2, axis=0))
    np.testing.assert_allclose(numbers["bias_difference_rms_by_axis_rad_per_s"], bias, rtol=1e-9)
    with pytest.raises(InputError, match="only two estimates can be compared"):
        report.write(folder / "right.h5", tmp_path / "page.html", other=folder / "campaign.h5")
    later = dataclasses.replace(second, time=second.time + 1e3)
    setup.write_estimate(tmp_path / "later.h5", later)
    with pytest.raises(InputError, match="give estimates of the same time"):
        report.write(folder / "right.h5", tmp_path / "page.html", other=tmp_path / "later.h5")


def test_a_page_of_two_estimates_has_a_name_of_both(folder, tmp_path):
    """It does not replace that of the first alone; estimates of the same name are told apart by their folders."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        shutil.copy(folder / "right.h5", tmp_path / name / "estimate.h5")
    shutil.copy(folder / "wrong.h5", tmp_path / "a" / "poor.h5")
    for other in (None, tmp_path / "a" / "poor.h5", tmp_path / "b" / "estimate.h5"):
        report.write(tmp_path / "a" / "estimate.h5", other=other)
    pages = {path.name for path in tmp_path.rglob("*.html")}
    assert pages == {"estimate.html", "estimate-and-poor.html", "estimate-and-b.html"}
    assert {path.name for path in tmp_path.rglob("*.json")} == {page.replace("html", "report.json") for page in pages}


def test_a_second_estimate_is_interpolated_by_rotation_at_constant_rate():
    rate = np.array([0.3, -0.5, 0.8])
    edges = np.array([0.0, 0.7, 1.0, 2.5])
    estimate = records.Estimate.from_arrays(
        edges, quaternion.exp(edges[:, None] * rate), np.tile(0.01 * np.eye(3), (4, 1, 1))
    )
    time = np.array([0.0, 0.35, 0.9, 2.0, 2.5])
    attitude, sigma, _ = comparisons._at(estimate, time)
    np.testing.assert_allclose(attitude, quaternion.exp(time[:, None] * rate), atol=1e-15)
    np.testing.assert_allclose(sigma[:, :3], 0.1)


def test_the_verdict_of_a_tuning_is_the_worst_on_held_out_data():
    odd, even = (SimpleNamespace(rejected=True, means=name) for name in ("odd", "even"))
    pairs = (("cannot tell", []), ("not consistent", [odd]), ("not consistent", [even, odd]), ("consistent", []))
    verdicts = [SimpleNamespace(verdict=verdict, reason="r", findings=findings) for verdict, findings in pairs]
    after = SimpleNamespace(judgements=verdicts, attitude_rms=1.0)
    comparison = SimpleNamespace(before=SimpleNamespace(attitude_rms=1.0), after=after, better=False)
    tuned, verdict = (
        SimpleNamespace(comparison=comparison, composite=False, contradicted=()),
        sd.tuning.Tuning.verdict.fget,
    )
    answer, reason, details = verdict(tuned)
    assert (answer, reason) == ("not consistent", "r, on the held-out data of the worst record")
    assert details == ["even", "odd", "on the held-out data the likelihood has decreased: keep the previous filter"]
    comparison.better = True
    assert verdict(tuned)[2] == ["even", "odd"]
    after.attitude_rms, after.judgements = 1.1, verdicts[::3]
    details = ["on the held-out data the attitude error has increased: keep the previous filter"]
    assert verdict(tuned) == ("cannot tell", "r, on the held-out data of the worst record", details)
    after.judgements = verdicts[:1]
    assert verdict(tuned)[1] == "r, on held-out data"


def test_packed_numbers_are_read_back():
    draw = np.random.default_rng(2)
    value = np.concatenate([1e6 * draw.standard_normal(page.BLOCK), draw.standard_normal(5000), [7.0, np.nan, 7.0]])
    time = np.cumsum(draw.uniform(1e-3, 5.0, len(value))) + 1e5
    content = {"time": page.packed_time(time), "data": [page.packed(value), page.packed(np.full(len(value), np.nan))]}
    back, number, nothing = columns(content)
    np.testing.assert_allclose(back, time, atol=0.51e-6)
    np.testing.assert_array_equal(np.isnan(number), np.isnan(value))
    assert np.isnan(nothing).all()
    for part in (slice(0, page.BLOCK), slice(page.BLOCK, 2 * page.BLOCK), slice(2 * page.BLOCK, None)):
        known = value[part][np.isfinite(value[part])]
        assert np.nanmax(np.abs(number[part] - value[part])) <= 0.51 * np.ptp(known) / 65534.0
    wide = page.packed_time(np.array([0.0, 1e-6, 1e7]))  # longer than 32 bits of microseconds
    np.testing.assert_allclose(columns({"time": wide, "data": []})[0], [0.0, 1e-6, 1e7], atol=2.0 * wide["tick"])


def test_a_very_long_chart_keeps_its_extremes(monkeypatch):
    monkeypatch.setattr(page, "CHART_SAMPLES", 2000)
    time = np.arange(6000) / 100.0
    value = np.random.default_rng(1).standard_normal(len(time))
    value[3001] = 50.0
    (chart,) = charts_of(page.chart("t", "u", time, (page.Series(label="error", value=value),)))
    when, drawn = columns(chart)
    assert page.CHART_SAMPLES // 2 < len(when) <= page.CHART_SAMPLES + 2
    assert drawn.max() == pytest.approx(50.0, rel=1e-6)
    assert when[drawn.argmax()] == pytest.approx(time[3001], abs=1e-6)


@pytest.mark.parametrize("samples", [5001, 50_001])
def test_a_chart_of_an_angle_breaks_where_it_wraps(samples, monkeypatch):
    monkeypatch.setattr(page, "CHART_SAMPLES", 10_000)  # the longer chart is reduced to the extremes of each column
    time = np.linspace(0.0, 10.0, samples)
    angle = np.mod(90.0 * time + 180.0, 360.0) - 180.0
    (chart,) = charts_of(page.chart("t", "°", time, (page.Series(label="yaw", value=angle, wraps=True),)))
    data = columns(chart)[1]
    assert np.isnan(data).sum() == 3  # 900° in all: past 180°, 540° and at the end 900°
    assert np.nanmax(np.abs(np.diff(data))) < 180.0


PARENTS = {"li": ["ul"], "tr": ["thead", "tbody"], "td": ["tr"], "th": ["tr"], "figcaption": ["figure"]}
"""Elements that stand in these alone; a head in ``thead`` is repeated on each printed page."""


class Tags(html.parser.HTMLParser):
    """Holds a page to closing what it opens, in order, and to the places where HTML allows an element."""

    VOID = frozenset(("meta", "link", "img", "source", "br"))
    BLOCKS = frozenset(("p", "div", "table", "ul", "figure", "pre", "section"))

    def __init__(self):
        super().__init__()
        self.open, self.seen = [], []

    def handle_starttag(self, tag, attributes):
        assert len({name for name, _ in attributes}) == len(attributes), f"{tag} has an attribute twice"
        assert tag not in PARENTS or self.open[-1] in PARENTS[tag], f"{tag} stands in {self.open[-1]}"
        assert not (self.open and self.open[-1] == "p" and tag in self.BLOCKS), f"{tag} stands in a paragraph"
        self.seen.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open
        assert self.open.pop() == tag


@pytest.mark.parametrize("name", ["right", "blind", "wrong", "campaign"])
def test_a_page_is_well_formed_and_needs_nothing_else(folder, name):
    tags = Tags()
    content = body(folder / f"{name}.html")
    tags.feed(content)
    tags.close()
    assert tags.open == []
    assert content.startswith("<!doctype html>")
    for once in ("html", "head", "title", "body", "h1"):
        assert tags.seen.count(once) == 1
    assert all('alt="' in image for image in re.findall(r"<img [^>]*>", content))
    text = re.sub(r"<script>.*?</script>", "", content, flags=re.S)
    assert not re.search(r"""(src|href|srcset)\s*=\s*["']?(?!data:)[a-z/]""", text)
    assert "@import" not in content


def test_an_estimate_without_covariance_has_no_evidence(folder, tmp_path):
    estimate = setup.read_estimate(folder / "blind.h5")
    unknown = np.full_like(estimate.variance, np.nan)
    nothing = dataclasses.replace(estimate, variance=unknown, covariance=None, innovations={})
    setup.write_estimate(tmp_path / "integrated.h5", nothing)
    assert "Evidence" not in body(report.write(tmp_path / "integrated.h5").page)


def test_the_verdict_comes_first_and_findings_are_called_pass_and_fail(folder):
    for name, verdict, failing in (("right", "cannot tell", False), ("wrong", "not consistent", True)):
        content = re.sub(r"<(script|style)[ >].*?</\1>", "", body(folder / f"{name}.html"), flags=re.S)
        judgement = json.loads((folder / f"{name}.report.json").read_text())["judgement"]
        assert judgement["verdict"] == verdict
        assert f"<strong>{verdict.capitalize()}.</strong>" in content.split("<h2>")[0]
        evidence = content.split("<h2>Evidence</h2>")[1].split("</section>")[0]
        marks = [
            mark.lower()
            for kind, mark in re.findall(r'<td class="(pass|fail)">(\w+)</td></tr>', evidence)
            if kind == mark.lower()
        ]
        assert marks == ["fail" if finding["rejected"] else "pass" for finding in judgement["findings"]]
        assert ("fail" in marks) == failing


def test_bad_input_is_refused_before_anything_is_written(folder, tmp_path):
    (tmp_path / "cut.h5").write_bytes((folder / "right.h5").read_bytes()[:2000])
    for path, complaint in (
        (tmp_path / "none.h5", "does not exist"),
        (tmp_path / "cut.h5", "truncated"),
        (__file__, "HDF5"),
    ):
        with pytest.raises(InputError, match=complaint):
            report.write(path, tmp_path / "page.html")
    with pytest.raises(InputError, match=r"\.html"):
        report.write(folder / "right.h5", tmp_path / "page.pdf")
    assert [path.name for path in tmp_path.iterdir()] == ["cut.h5"]


def test_a_folder_without_a_name_is_no_result():
    for place in (".", "/", ".."):
        with pytest.raises(InputError, match="is a folder; name the file in it"):
            report.write(place)


DARK = ("--blink-settings=preferredColorScheme=0", "--virtual-time-budget=20000")
DRAWN = """const wait = setInterval(() => {
  const drawn = document.documentElement.dataset.drawn;
  if (!drawn) return;
  clearInterval(wait);
  document.title = JSON.stringify({drawn});
}, 50);"""
PROBE = """const wait = setInterval(async () => {
  if (PAGE_HAS_CHARTS && !document.documentElement.dataset.drawn) return;
  clearInterval(wait);
  const found = {charts: document.querySelectorAll(".uplot canvas").length,
    tables: [...document.querySelectorAll(".scroll")].filter((e) => e.querySelector("table")).map((e) => { e.scrollLeft = 1e4;
      const cell = e.querySelector("tr:last-child").lastElementChild.getBoundingClientRect();
      return cell.right <= e.getBoundingClientRect().right + 2 && getComputedStyle(e).overflowX === "auto"; }),
    overflow: document.documentElement.scrollWidth - window.innerWidth,
    unnamed: [...document.querySelectorAll("canvas")].filter((one) => !one.getAttribute("aria-label")).length,
    dead: [...document.querySelectorAll("nav a")].filter((a) => !document.querySelector(a.getAttribute("href"))).length,
    contents: document.querySelectorAll("nav a").length};
  if (PAGE_HAS_CHARTS) {
    const soon = () => new Promise((done) => setTimeout(done, 20));
    const drawn = strapdownCharts.drawn();
    const seen = () => drawn.map(({plot}) => ["x", "y"].flatMap((k) => [plot.scales[k].min, plot.scales[k].max]));
    const press = (place, name) => place.dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true}));
    await soon();
    found.begin = seen();
    found.label = drawn[0].plot.axes[1].values(drawn[0].plot, [2e-5])[0];
    found.samples = drawn[0].plot.data[0].length;
    press(drawn[1].place, "+"); await soon(); press(drawn[1].place, "+"); await soon();
    found.zoomed = seen();
    found.visible = drawn[0].plot.data[0].filter((t) => t >= found.zoomed[0][0] && t <= found.zoomed[0][1]).length;
    drawn[2].plot.over.dispatchEvent(new MouseEvent("dblclick", {bubbles: true})); await soon();
    found.reset = seen();
    const head = document.querySelector(".u-legend .u-series:not(:first-child) th");
    found.focusable = [head.tabIndex, head.getAttribute("role")];
    const marks = (place) => [...place.querySelectorAll(".u-series:not(:first-child) .u-marker")];
    found.marks = drawn.map(({place}) => marks(place).map((mark) => mark.style.borderStyle));
    press(head, "Enter"); await soon();
    found.pressed = head.getAttribute("aria-pressed");
    const bodies = strapdownCharts.bodies();
    found.body = bodies.map((one) => one.k);
    drawn[0].plot.setCursor({left: 0, top: 10}); await soon();
    found.turned = bodies.map((one) => one.k);
    for (const {plot} of drawn.filter(({plot}) => plot.axes[0].label !== "time, s")) {
      plot.setCursor({left: 50, top: 10}); await soon();
      found.turned.push(...bodies.map((one) => one.k));
    }
    window.dispatchEvent(new Event("beforeprint"));
    found.ink = getComputedStyle(document.documentElement).getPropertyValue("--ink").trim();
  }
  document.title = JSON.stringify(found);
}, 50);"""


def shown_by_a_browser(page, width):
    """Return what the probe finds on a page in headless Chromium, in the dark theme."""
    if headless.CHROMIUM is None:
        pytest.skip("no Chromium on this machine; install it to see the pages in a browser")
    charts = str('class="chart"' in body(page)).lower()
    reported = headless.reported(page, PROBE.replace("PAGE_HAS_CHARTS", charts), width, *DARK)
    assert reported["console"] == []
    return reported


@pytest.mark.parametrize(("name", "width"), [("right", 1280), ("campaign", 390)])
def test_a_browser_shows_figures_and_charts(folder, name, width):
    reported = shown_by_a_browser(folder / f"{name}.html", width)
    assert reported["overflow"] <= 0
    assert reported["tables"]
    assert all(reported["tables"])  # scrolled to its end, a table shows its last column
    assert reported["charts"] == (13 if name == "right" else 12)
    assert (reported["unnamed"], reported["dead"]) == (0, 0)
    assert reported["contents"] >= 5
    assert float(reported["label"]) == 2e-5
    whole, zoomed = np.array(reported["begin"]), np.array(reported["zoomed"])
    over_time = np.array([chart["x"] == "time, s" for chart in charts_of(body(folder / f"{name}.html"))])
    np.testing.assert_allclose(
        np.ptp(zoomed[over_time, :2], axis=1), 0.25 * np.ptp(whole[1, :2]), rtol=0.02
    )  # all of them
    np.testing.assert_allclose(zoomed[~over_time], whole[~over_time])
    assert reported["visible"] == pytest.approx(0.25 * reported["samples"], rel=0.05, abs=2)
    np.testing.assert_allclose(reported["reset"], whole)  # a double click on one chart restores all of them
    assert reported["focusable"] == [0, "button"]
    lines = [[line["dash"] for line in chart["series"]] for chart in charts_of(body(folder / f"{name}.html"))]
    assert reported["marks"] == [["dashed" if dash else "solid" for dash in chart] for chart in lines]
    assert reported["pressed"] == "false"
    assert reported["ink"] == "#16181d"  # dark on paper, also in the dark theme
    if name == "right":
        assert reported["samples"] == len(setup.read_estimate(folder / "right.h5").time)
        assert reported["body"] == [reported["samples"] - 1]
        assert reported["turned"] == [0] * (1 + np.sum(~over_time))  # not by a chart of another axis


def rows_of(content, first):
    """Numbers of the row of a table whose first cell begins so."""
    row = next(row for row in re.findall(r"<tr>(.*?)</tr>", content) if re.match(rf"<td[^>]*>{first}", row))
    return [float(cell) for cell in re.findall(r'<td class="number">(.*?)</td>', row)]


def test_names_stand_as_code_and_words_at_the_left():
    assert page.paragraph("give `states=True` & `holdout=`") == (
        "<p>give <code>states=True</code> &amp; <code>holdout=</code></p>"
    )
    rows = [("a", 1.0, "rounding", "cannot tell", None), ("b", None, "−2.1", "consistent", "0.9 to 1.1")]
    content = page.table(Table("", ("filter", "NIS", "drift", "verdict", "bounds"), rows))
    right = [" class=" in cell for cell in re.findall(r"<t[hd][^>]*>", content.partition("<tr>")[2])]
    assert right == [False, True, True, False, True] * 3
    assert "<td>One. Two.</td>" in page.provenance({"remarks": ["One.", "Two."]})


def test_the_tables_of_the_estimates_page_are_those_of_the_terminal(folder):
    """Of a filter that is three times too sure, so that no column is another's."""
    estimate, content = setup.read_estimate(folder / "wrong.h5"), body(folder / "wrong.html")
    for table in (estimate.listing(), sd.accuracy(estimate).listing()):
        for row in table.cells:
            assert "".join(re.findall(r"<td[^>]*>(.*?)</td>", content)).find("".join(row)) >= 0
        assert all(html.escape(note) in content for note in table.notes)
    size = np.pi / 648000.0
    for axis, name in enumerate("xyz"):
        sigma = np.sqrt(estimate.variance[[-1, 0], 3 + axis])
        wanted = [estimate.bias[-1, axis] / size, *(sigma / size)]
        np.testing.assert_allclose(rows_of(content, f"gyro bias {name}"), wanted, rtol=6e-3)


def test_the_estimates_table_of_sensors_leaves_out_what_the_gate_rejected(folder):
    estimate = setup.read_estimate(folder / "right.h5")
    innovation = estimate.innovations["star 1"]
    outlier = np.arange(len(innovation.time)) % 5 == 0
    wild = np.where(outlier[:, None], 100.0 * innovation.innovation, innovation.innovation)
    gated = dataclasses.replace(innovation, innovation=wild, weight=np.where(outlier, 0.0, 1.0))
    gated_estimate = dataclasses.replace(estimate, innovations={"star 1": gated}, skipped={"star 1": 3})
    nis = np.mean(innovation.innovation[~outlier] ** 2 / innovation.variance[~outlier])
    number = len(innovation.time)
    counts = f"{number} measurements, {outlier.sum()} rejected by the gate, 3 more missing or outside the record"
    assert f"star 1: {counts}, mean NIS per degree of freedom {nis:.3g}" in gated_estimate.listing().notes


def test_what_a_campaign_page_says_of_the_end_is_of_the_last_epoch(folder):
    held = campaign.read(folder / "campaign.h5").statistics
    content = body(folder / "campaign.html")
    for state, name in enumerate([f"{what} {axis}" for what in ("attitude", "bias") for axis in "xyz"]):
        size = np.pi / 648000.0  # an hour has as many seconds as a degree has arcseconds
        shown = rows_of(content.partition("Errors at")[2], name)
        wanted = [statistic[-1, state] / size for statistic in (held.mean_error, held.rms_error, held.sigma)]
        quantiles = [held.error_quantile(q)[-1, state] / size for q in verdicts.QUANTILES]
        np.testing.assert_allclose(shown[-6:], [*wanted, *quantiles], rtol=6e-4)
    covered = held.covered[held.judged_epochs][:, :3].mean(axis=(0, 1))
    assert all(f"{100.0 * share:.2f} %" in content for share in covered)
    shares, *ellipses = charts_of(content)[-3:]
    places, *lines = columns(shares)
    assert len(places) == len(shares["ticks"]) == 6
    for k in range(3):
        high, low, share = lines[3 * k : 3 * k + 3]
        np.testing.assert_allclose(share, 100.0 * held.coverage[-1, :, k] / held.finite[-1], rtol=1e-4)
        ends = scipy.stats.binom.ppf([0.005, 0.995], 16, 2.0 * scipy.stats.norm.cdf(k + 1) - 1.0) / 16
        np.testing.assert_allclose([low, high], 100.0 * np.repeat(ends[:, None], 6, axis=1), rtol=1e-4)
    far = np.abs(np.log(np.diag(held.mean_square_error[-1]) / np.diag(held.covariance[-1])))[3:].argmax()
    assert [chart["title"] for chart in ellipses] == [
        "95 % ellipses: attitude y over attitude x",
        f"95 % ellipses: bias {'xyz'[far]} over attitude {'xyz'[far]}",
    ]


def test_an_ellipse_holds_its_share_of_two_errors_in_one_unit():
    factor = np.array([[1e-2, 0.0], [0.7e-2, 0.4e-2]])
    chart = report.campaigns._ellipses(("x", "y"), factor @ factor.T, np.diag([1e-12, 1e-4]), (0, 1))
    (content,) = charts_of(chart)
    assert (content["x"], content["unit"]) == ("x error, °", "y error, °")
    x, high, low, top, bottom = columns(content)
    errors = np.degrees(factor @ np.random.default_rng(1).standard_normal((2, 20_000)))
    inside = (errors[1] < np.interp(errors[0], x, high)) & (errors[1] > np.interp(errors[0], x, low))
    assert inside.mean() == pytest.approx(0.95, abs=0.01)
    assert np.nanmax(top) == pytest.approx(np.degrees(1e-2 * np.sqrt(scipy.stats.chi2.ppf(0.95, 2))), rel=1e-3)
    np.testing.assert_allclose(bottom, -top, atol=1e-3)
