"""Tables of studies: CSV that reads back to the bit, LaTeX that compiles, and the commands that write both, and figures in every format."""

import csv
import json
import math
import re
import shutil
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from strapdown import cli
from strapdown.report import page
from strapdown.report.tables import to_csv, to_latex
from strapdown.results import Column, Table

FEW = ("--free", "star 1.sigma", "--starts", 1)
TERMINAL = 100
"""Maximum width of a printed table."""
LATEX = next((path for name in ("pdflatex", "lualatex", "tectonic") if (path := shutil.which(name))), None)
CELLS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**9), 10**9),
    st.floats(),
    st.text(st.characters(blacklist_categories=("Cs", "Cc")), max_size=12).filter(lambda text: text != ""),
)


def keyed(keys, rows, title="c"):
    """A table whose columns are in files too."""
    return Table(title, [Column(key, key) for key in keys], rows, name="t")


def read_back(text):
    head, *rows = csv.reader(text.splitlines(keepends=True))
    return head, rows


def tabular(text):
    """Columns of a tabular, its heading, and its rows as cells; what LaTeX would make of the structure."""
    (columns,) = re.findall(r"\\begin\{tabular\}\{([lr]+)\}", text)
    body = text.split("\\toprule\n")[1].split("\\bottomrule")[0]
    head, rows = body.split("\\midrule\n")
    cut = lambda line: [cell.strip() for cell in re.split(r"(?<!\\)&", line.removesuffix(r" \\"))]  # noqa: E731
    return columns, cut(head.strip()), [cut(line) for line in rows.splitlines()]


@settings(deadline=None)
@given(st.lists(st.tuples(CELLS, CELLS, CELLS), max_size=6))
def test_csv_reads_back_to_the_bit(rows):
    keys = ("a", "b_deg", "c, d")
    head, read_rows = read_back(to_csv(keyed(keys, rows)))
    assert head == list(keys)
    for row, given_row in zip(read_rows, rows, strict=True):
        for text, value in zip(row, given_row, strict=True):
            if value is None or (isinstance(value, float) and math.isnan(value)):
                assert text == ""
            elif isinstance(value, float):
                assert np.float64(text).tobytes() == np.float64(value).tobytes()
            else:
                formula = isinstance(value, str) and value.startswith(("=", "+", "-", "@"))
                assert text == ("'" if formula else "") + str(value)


@settings(deadline=None)
@given(st.lists(st.tuples(CELLS, CELLS, CELLS), min_size=1, max_size=6))
def test_latex_has_a_cell_for_each_value_and_nothing_unescaped(rows):
    keys = ("a", "b", "c")
    text = to_latex(keyed(keys, rows, "50 % of\nall"))
    columns, head, body = tabular(text)
    assert (len(columns), head) == (3, list(keys))
    assert len(body) == len(rows)
    for k, row in enumerate(body):
        assert len(row) == 3, text
        for j, cell in enumerate(row):
            if not isinstance(rows[k][j], str):
                assert re.fullmatch(r"|yes|no|\$-?(\d+(\.\d+)?( \\times 10\^\{-?\d+\})?|\\infty)\$", cell), cell
    bare = re.sub(r"\$[^$]*\$", "", re.sub(r"\\[A-Za-z]+(\{\})?|\\[&%$#_{}\\]", "", "\n".join(text.splitlines()[5:-2])))
    assert not re.search(r"[%#_^~]", bare), bare


def test_latex_rounds_and_aligns():
    rows = [("100 % of a_b", 1.23456e-8, "°/√h"), ("c", -62.391, "")]
    table = keyed(("name", "drift_deg_per_hour", "unit"), rows)
    columns, head, body = tabular(to_latex(table))
    assert columns == "lrl"
    assert head == ["name", r"drift, $^\circ$/h", "unit"]
    assert body[0] == [r"100 \% of a\_b", r"$1.235 \times 10^{-8}$", r"$^\circ$/$\sqrt{\mathrm{h}}$"]
    assert body[1][1] == "$-62.39$"


def test_a_unit_is_below_its_quantity():
    table = Table("t", ("state", Column("bias, °/h", digits=2)), [("x", 7200.0)])
    assert table.lines == ["state  bias", "        °/h", "-----------", "x      7200"]
    assert '<th class="number">bias<br>°/h</th>' in page.table(table)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Each command once, with --tables, and --format where it draws: its folder by the command's name."""
    where = tmp_path_factory.mktemp("studies")
    rest = where / "rest.npy"
    np.save(rest, 1e-4 * np.random.default_rng(3).standard_normal((4000, 3)))
    (where / "lines.csv").write_text("frequency_hz,angle_deg\n10,0.1\n", encoding="utf-8")
    toml = CliRunner().invoke(cli.app, ["scenarios", "two-stars"]).output
    (where / "short.toml").write_text(re.sub(r"duration_s = .*", "duration_s = 40.0", toml), encoding="utf-8")
    commands = {
        "coning": ["--runs", 1, "--duration", 12, "--format", "svg", "--out", where / "coning"],
        "algorithms": ["--no-time"],
        "coning-budget": ["--psd", where / "lines.csv", "--rate", 100, "--rate", 200],
        "covariance": [where / "short.toml", "--epochs", 4, "--format", "pdf", "--out", where / "covariance"],
        "allan": [rest, "--rate", 100, "--gyro-unit", "rad/s", "--format", "svg", "--out", where / "allan"],
        "montecarlo": [where / "short.toml", "--runs", 8, "--out", where / "mc.h5"],
        "simulate": [where / "short.toml", "--out", where / "record.h5"],
        "tune": [where / "record.h5", *FEW, "--holdout", 0.3, "--format", "svg", "--out", where / "filter.toml"],
        "estimate": [where / "record.h5", "--format", "pdf", "--out", where / "estimate"],
    }
    for name, options in commands.items():
        tables = [] if name in ("simulate", "estimate") else ["--tables", where / "tables" / name]
        with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
            patch.setattr("matplotlib.figure.Figure.savefig", lambda figure, path, **options: Path(path).touch())
            if name == "coning":
                warnings.simplefilter("error")  # a study as short as can be warns of nothing
            result = CliRunner().invoke(cli.app, [str(part) for part in [name, *options, *tables]])
        wanted = (0, 3) if name == "montecarlo" else (0,)  # so few runs cannot tell
        assert result.exit_code in wanted, (name, result.output, result.exception)
        assert max(map(len, re.findall("^-+$", result.output, re.MULTILINE)), default=0) <= TERMINAL, name
        for path in (where / "tables" / name).glob("*"):
            assert path.name in result.output.replace("\n", "")
    return where


WANTED = {
    "coning": {"drift", "filters"},
    "algorithms": {"algorithms"},
    "coning-budget": {"coning-budget"},
    "covariance": {"budget"},
    "allan": {"gyro-noise"},
    "montecarlo": {"consistency", "errors", "coverage"},
    "tune": {"parameters", "held-out"},
}


@pytest.mark.parametrize("name", WANTED)
def test_every_study_writes_its_tables(written, name):
    folder = written / "tables" / name
    files = {f"{table}.{end}" for table in WANTED[name] for end in ("csv", "tex")}
    assert {path.name for path in folder.iterdir()} == files
    for table in WANTED[name]:
        head, rows = read_back((folder / f"{table}.csv").read_text(encoding="utf-8"))
        assert rows
        columns, shown, body = tabular((folder / f"{table}.tex").read_text(encoding="utf-8"))
        assert len(head) == len(columns) == len(shown)
        assert [len(row) for row in body] == [len(columns)] * len(rows)


def of(written, name, table):
    head, rows = read_back((written / "tables" / name / f"{table}.csv").read_text(encoding="utf-8"))
    return [dict(zip(head, row, strict=True)) for row in rows]


def test_tables_hold_the_numbers_of_the_json(written):
    study = json.loads((written / "coning" / "coning.json").read_text())
    assert set(study) == {"scenario", "integration", "filter"}  # no "own" without an algorithm of one's own
    for row, algorithm in zip(of(written, "coning", "drift"), study["integration"], strict=True):
        assert float(row["drift_deg_per_hour"]) == algorithm["drift_deg_per_hour"]
    for row, algorithm in zip(of(written, "coning", "filters"), study["filter"], strict=True):
        assert float(row["bias_mean_z_deg_per_hour"]) == algorithm["bias_mean_deg_per_hour"][2]
        assert row["verdict"] == algorithm["verdict"]
    last = json.loads((written / "mc.json").read_text())["last_epoch"]
    errors = of(written, "montecarlo", "errors")
    assert [row["state"] for row in errors] == [f"{what} {axis}" for what in ("attitude", "bias") for axis in "xyz"]
    assert [float(row["rms_error"]) for row in errors[3:]] == last["bias_rms_error_deg_per_hour"]
    assert [float(row["error_quantile_0.95"]) for row in errors[:3]] == last["attitude_error_quantile_0.95_arcsec"]
    (parameter,) = json.loads((written / "filter.json").read_text())["parameters"]
    (row,) = of(written, "tune", "parameters")
    assert float(row["after"]) == parameter["value"] / parameter["si_per_unit"]
    assert row["unit"] == "arcsec"
    held = json.loads((written / "filter.json").read_text())["held_out"]
    for row in of(written, "tune", "held-out"):
        assert [float(row[f"nis_{end}"]) for end in ("lower", "upper")] == held[row["filter"]]["nis_bounds"]
    covariance = json.loads((written / "covariance" / "covariance.json").read_text())
    for row in of(written, "covariance", "budget"):
        if row["kind"] == "random":
            for column in ("attitude_arcsec", "bias_deg_per_hour"):
                axes = covariance["random"][row["source"]][column][-1]
                assert float(row[column]) == pytest.approx(np.sqrt(np.mean(np.square(axes))), rel=1e-12)


def test_figures_are_written_in_the_format_asked_for(written):
    figures = {str(path.relative_to(written)) for path in written.rglob("*") if path.suffix in (".png", ".pdf", ".svg")}
    svg = {"coning/drift", "coning/errors", "coning/consistency", "allan/allan", "filter-likelihood"}
    pdf = {"covariance/budget", "estimate/estimate", "estimate/errors"}
    assert figures == {*(f"{x}.svg" for x in svg), *(f"{x}.pdf" for x in pdf)}


def test_a_report_shows_svg_and_names_pdf(tmp_path):
    (tmp_path / "errors.svg").write_text("<?xml version='1.0'?><svg/>")
    assert "data:image/svg+xml;base64," in page.stored_figure(tmp_path / "errors", "errors")
    (tmp_path / "errors.pdf").write_bytes(b"%PDF-")
    content = page.stored_figure(tmp_path / "errors", "errors")
    assert "data:image" not in content
    assert "In errors.pdf, beside the result" in content


@pytest.mark.skipif(LATEX is None, reason="no LaTeX on this machine; install TeX Live to compile the tables")
def test_the_tables_compile(written, tmp_path):
    inputs = "\n".join(rf"\input{{{path.as_posix()}}}" + "\n" for path in sorted((written / "tables").rglob("*.tex")))
    (tmp_path / "all.tex").write_text(
        "\\documentclass{article}\n\\usepackage{booktabs}\n\\begin{document}\n" + inputs + "\\end{document}\n",
        encoding="utf-8",
    )
    command = [str(LATEX), "all.tex"] if "tectonic" in str(LATEX) else [str(LATEX), "-halt-on-error", "all.tex"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, timeout=120)
    assert (tmp_path / "all.pdf").exists()


def test_text_of_a_csv_is_no_formula():
    """A name of a sensor may come from a scenario of someone else."""
    names = ["=HYPERLINK(1)", "+1", "-2", "@x", "\tx"]
    rows = read_back(to_csv(keyed(("sensor", "value"), [(name, -1.5) for name in names])))[1]
    assert rows == [[f"'{name}", "-1.5"] for name in names]
