"""The documentation says what there is: commands and options in README and site exist, links lead somewhere, the reference is whole.

The pages' code is run by the build of the site (``docs/conf.py``), not here.
"""

import builtins
import importlib
import json
import pkgutil
import re
import shlex
import symtable
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command

import strapdown
from benchmarks import recording_parameters, recordings
from strapdown import quaternion
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.setup import FilterSetup, to_table
from strapdown.estimation.states import ProcessNoise

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", *(page for page in DOCS.rglob("*.md") if "_build" not in page.parts)])
FENCE = re.compile(r"^(`{3,})([^\n]*)\n(.*?)^\1\s*$", re.MULTILINE | re.DOTALL)


def without_output(text: str) -> str:
    """Return the text of a page without its blocks of code."""
    return FENCE.sub("", text)


def shell_lines(page: Path) -> list[str]:
    """Return the lines that a reader would type into a shell: of ``sh`` blocks and of cells that Bash runs."""
    lines = []
    for _, info, body in FENCE.findall(page.read_text(encoding="utf-8")):
        shell = info.strip() in ("sh", "bash", "console") or (info.startswith("{code-cell}") and "%%bash" in body)
        lines += body.replace("\\\n", " ").splitlines() if shell else []
        lines += [row.removeprefix("!") for row in body.splitlines() if row.startswith("!")]
    return lines


def commands(page: Path) -> list[list[str]]:
    """Return each call of the program on a page as its words, also of those in the running text."""
    text = page.read_text(encoding="utf-8")
    lines = [f"strapdown {call}" for call in re.findall(r"`strapdown ([^`\n]+)`", without_output(text))]
    lines += re.findall(r"^\| (`strapdown [^|]*`) \|", text, re.MULTILINE)
    calls = []
    for line in [*shell_lines(page), *(part for entry in lines for part in entry.replace("`", "").split(", "))]:
        for part in re.split(r"&&|\|\||[;|](?![^']*'\s)", re.sub(r"(^|\s)#.*", "", line)):
            try:
                words = shlex.split(part)
            except ValueError:  # an apostrophe in the running text
                words = part.split()
            if words[:1] == ["strapdown"]:
                calls.append(words[1:])
    return calls


def unknown(words: list[str]) -> str:
    """Return what of a call does not exist, "" if all does."""
    program = get_command(importlib.import_module("strapdown.cli").app)
    if not words:
        return ""
    if words[0].startswith("-"):
        name, options = "strapdown", program.params
    else:
        name = words[0]
        if name not in program.commands:
            return f"command {name}"
        options = program.commands[name].params
    known = {flag for option in options for flag in (*option.opts, *option.secondary_opts)} | {"--help"}
    used = [word.split("=")[0] for word in words if re.fullmatch(r"--?[A-Za-z][\w-]*(=.*)?", word)]
    return ", ".join(f"{name} {flag}" for flag in used if flag not in known)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_and_option_exists(page):
    calls = commands(page)
    assert [problem for words in calls if (problem := unknown(words))] == []


def test_the_reference_of_the_command_line_has_every_command_and_option():
    program = get_command(importlib.import_module("strapdown.cli").app)
    sections = re.split(r"^### strapdown ", with_generated(DOCS / "commands.md"), flags=re.MULTILINE)[1:]
    printed = {section.split()[0]: set(re.findall(r"(?<![\w-])--?[a-z][\w-]*", section)) for section in sections}
    assert set(printed) == set(program.commands)
    for name, command in program.commands.items():
        flags = {flag for option in command.params for flag in option.opts if flag.startswith("-") and flag != "--help"}
        assert flags <= printed[name], f"{name}: {flags - printed[name]}"


def test_the_commands_are_seen():
    """What the test above reads: a page that it read nothing of would pass."""
    assert ["simulate", "two-stars"] in commands(ROOT / "README.md")
    assert ["montecarlo", "two-stars", "--runs", "1000"] in commands(ROOT / "README.md")
    assert ["check", "estimate-results/estimate.h5"] in commands(DOCS / "start.md")
    assert unknown(["simulate", "two-stars", "--sed", "3"]) == "simulate --sed"
    assert unknown(["simulat"]) == "command simulat"


def with_generated(page: Path) -> str:
    """Return the text of a page with the Markdown that its ``{generated}`` directives insert."""
    text = page.read_text(encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        for call in re.findall(r"^```\{generated\} (.*)$", text, re.MULTILINE):
            name, *arguments = call.split()
            module, _, function = name.rpartition(".")
            text += "\n\n" + getattr(pytest.importorskip(module), function)(*arguments)
    return text


def anchors(page: Path) -> set[str]:
    """Return what a link into a page may end in: its headings as GitHub and MyST name them, and its labels."""
    text = with_generated(page)
    heads = re.findall(r"^#{1,6}\s+(.*)$", without_output(text), re.MULTILINE)
    slugs = {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}
    return slugs | set(re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_resolves(page):
    text = without_output(page.read_text(encoding="utf-8"))
    dead = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue  # an address on the network
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
            labels = {label for other in PAGES for label in anchors(other)}
            if path or anchor not in labels:
                dead.append(target)
    assert dead == []


def test_every_page_is_in_a_table_of_contents():
    listed = {DOCS / "index.md"}
    for page in DOCS.rglob("*.md"):
        for _, info, body in FENCE.findall(page.read_text(encoding="utf-8")):
            if info.startswith("{toctree}"):
                rows = [row.strip() for row in body.splitlines() if row.strip() and not row.startswith(":")]
                listed |= {page.parent / f"{row}.md" for row in rows}
    assert {page for page in PAGES if DOCS in page.parents} == listed


def test_the_reference_lists_every_public_module():
    public = set()
    for module in pkgutil.walk_packages(strapdown.__path__, "strapdown."):
        name = module.name.removeprefix("strapdown.")
        if name.split(".")[0] not in (*strapdown.__all__, "codegen", "workflows"):
            continue
        if hasattr(importlib.import_module(module.name), "__all__"):
            public.add(name)
    text = (DOCS / "api/index.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^   ([\w.]+)$", text, re.MULTILINE)) == public


def test_the_validation_data_say_where_they_are_from():
    data = json.loads((DOCS / "_data/validation.json").read_text(encoding="utf-8"))
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", data["date"])
    assert data["version"]
    assert {"coefficients", "coning_drift", "farrenkopf", "allan", "ukfm"} <= set(data)
    assert all(row["equal"] for row in data["coefficients"])
    for row in data["allan"]:
        assert row["ours"] == pytest.approx(row["published"], rel=1e-6)  # seven digits are published
    for row in data["farrenkopf"]:
        assert row["ours"] == pytest.approx(row["published"], rel=1e-9)


@pytest.mark.parametrize("name", ["filter_comparison", "peer_judged"])
def test_the_comparison_data_say_where_they_are_from(name):
    data = json.loads((DOCS / f"_data/{name}.json").read_text(encoding="utf-8"))
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", data["date"])
    assert data["version"]
    assert data["seed"] == 1
    assert all(data["peers"].values())


def test_the_comparison_shows_what_the_theory_says():
    """Kalman filters of small errors attain the bound, no filter beats it; a right filter passes and a wrong one does not."""
    data = json.loads((DOCS / "_data/filter_comparison.json").read_text(encoding="utf-8"))
    ratios = {row["filter"]: row["rms_over_root_pcrb"] for row in data["outcomes"]}
    assert ratios["mekf"] == pytest.approx(1.0, abs=0.05)
    assert all(ratio > 0.95 for ratio in ratios.values())
    judged = json.loads((DOCS / "_data/peer_judged.json").read_text(encoding="utf-8"))
    assert judged["runs"] == 200
    verdicts = {name: case["verdict"] for name, case in judged["cases"].items()}
    assert verdicts["GTSAM"] == verdicts["AttiPy, heading's derivative mended"] == "consistent"
    wrong = ("smsfusion", "AttiPy", "smsfusion, noises of another sensor", "GTSAM, gyro with a bias")
    assert {verdicts[name] for name in wrong} == {"not consistent"}


def test_the_filter_file_is_described_with_its_own_keys():
    described = (DOCS / "formats.md").read_text(encoding="utf-8").partition("## Filter\n")[2].partition("\n## ")[0]
    shown = dict(re.findall(r"^\| `\[(filter[.a-z]*)\]` \| (.*) \|$", described, re.MULTILINE))
    # No default, which the file would leave out.
    setup = FilterSetup(
        process_noise=ProcessNoise(angle_random_walk=1e-5, rate_random_walk=1e-8),
        attitude_sigma=0.1,
        bias_sigma=1e-5,
        measurement_sigma_factor=2.0,
        gate=Gate(probability=0.9, recovery=5, restart_attitude_sigma=0.1, restart_bias_sigma=1e-5),
        robust=Robust(kind="huber", probability=0.9, degrees_of_freedom=5.0, iterations=3),
    )
    table = to_table(setup)
    for name, part in (("filter", table), ("filter.gate", table["gate"]), ("filter.robust", table["robust"])):
        keys = {key for key, value in part.items() if not isinstance(value, dict)}
        described_keys = set(re.findall(r"`([a-z_]+)`", shown[name]))
        assert keys <= described_keys if name == "filter" else keys == described_keys  # integration has no default here


def test_the_statistics_of_a_verdict_are_explained():
    record = strapdown.simulate("two-stars")
    judged = (
        strapdown.check(strapdown.estimate(record), record),
        strapdown.check(strapdown.monte_carlo("two-stars", runs=8)),
    )
    page = (DOCS / "guide/verdict.md").read_text(encoding="utf-8")
    shown = {finding.name for judgement in judged for finding in judgement.findings}
    assert shown <= set(re.findall(r"^\| ([\w -]+) \|", page, re.MULTILINE))


def test_tests_that_pages_name_exist():
    """Each formula of the mathematics names the test that checks it."""
    named = {
        test for page in PAGES for test in re.findall(r"(test_\w+\.py)::(test_\w+)", page.read_text(encoding="utf-8"))
    }
    assert len(named) > 10
    for file, name in sorted(named):
        assert f"\ndef {name}(" in (ROOT / "tests" / file).read_text(encoding="utf-8"), f"{file}::{name}"


README = Path(__file__).resolve().parents[1] / "README.md"


@pytest.fixture
def blocks():
    """The blocks of Python in the README, in order."""
    return re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


def write_walk(path):
    """Ten seconds of a unit at rest for three and then turned about, 100 Hz: its accelerometer in g, its gyro in °/s."""
    draw = np.random.default_rng(5)
    time = 0.01 * np.arange(1000)
    rate = np.where(time > 3.0, 40.0 * np.sin(2.0 * np.pi * 0.5 * (time - 3.0)), 0.0)
    angle = np.radians(np.cumsum(rate) * 0.01)
    force = np.stack([np.zeros_like(time), np.sin(angle), np.cos(angle)], axis=1)
    gyro = np.stack([rate, np.zeros_like(time), np.zeros_like(time)], axis=1)
    rows = np.column_stack(
        [time, gyro + 0.05 * draw.standard_normal((1000, 3)), force + 2e-3 * draw.standard_normal((1000, 3))]
    )
    np.savetxt(path, rows, delimiter=",", header="time,gx,gy,gz,ax,ay,az", comments="")
    return angle


def code_of(page: Path) -> Iterator[tuple[str, bool]]:
    """Yield the Python of each cell that is executed, and whether a reader can copy it."""
    for cell in re.findall(
        r"^```\{code-cell\}[^\n]*\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    ):
        tags, code = re.match(r"(:tags:[^\n]*\n)?\n*(.*)", cell, re.DOTALL).groups()
        if not code.startswith("%%"):
            yield code, "remove-input" not in (tags or "")


@pytest.mark.parametrize("page", [page for page in PAGES if any(code_of(page))], ids=lambda page: page.stem)
def test_cells_that_can_be_copied_need_none_that_cannot(page):
    known = set(dir(builtins))
    for code, visible in code_of(page):
        if visible:
            table = symtable.symtable(code, page.stem, "exec")
            known |= {
                symbol.get_name() for symbol in table.get_symbols() if symbol.is_assigned() or symbol.is_imported()
            }
            assert names_from_elsewhere(table) <= known, code


def names_from_elsewhere(table: symtable.SymbolTable) -> set[str]:
    """Return the global names that code and its functions read."""
    own = {symbol.get_name() for symbol in table.get_symbols() if symbol.is_referenced() and symbol.is_global()}
    return own.union(*map(names_from_elsewhere, table.get_children()))


def test_the_tables_of_recordings_are_those_of_the_data_files():
    """As ``benchmarks/recordings.py`` and ``benchmarks/recording_parameters.py`` print them."""
    page = (DOCS / "comparison.md").read_text(encoding="utf-8")
    scores, parts = (
        json.loads((DOCS / "_data" / f"{name}.json").read_text()) for name in ("recordings", "recording_parts")
    )
    assert len(scores["sets"]) == 8
    _, after, before = re.findall(r"{include} (\.\./README\.md)\n:start-after: (.*)\n:end-before: (.*)\n", page)[0]
    readme = README.read_text(encoding="utf-8")
    assert recordings.table(scores) in readme[readme.index(after) : readme.index(before)]
    assert recording_parameters.table(parts) in page


def test_the_code_of_the_readme_runs(blocks, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    angle = write_walk(tmp_path / "walk.csv")
    assert len(blocks) == 1
    names = {}
    exec(blocks[0], names)
    assert len(re.findall(r"^(?:consistent|cannot tell)", capsys.readouterr().out, re.MULTILINE)) == 2
    estimate, truth = names["estimate"], names["record"].truth
    error = quaternion.log(quaternion.multiply(quaternion.conjugate(estimate.attitude[-1]), truth.attitude[-1]))
    assert np.all(np.abs(error) < 5.0 * estimate.sigma[-1, :3])
    roll = np.radians(names["angles"][:, 2])
    assert np.sqrt(np.mean((roll - angle[-len(roll) :]) ** 2)) < np.radians(1.0)


def test_the_font_of_formulas_is_small_and_stands_beside_its_licence():
    folder = DOCS / "_static/fonts"
    assert (folder / "formulas.woff2").read_bytes()[:4] == b"wOF2"
    assert (folder / "formulas.woff2").stat().st_size < 100_000
    assert "GUST Font License" in (folder / "GUST-FONT-LICENSE.txt").read_text(encoding="utf-8")
    assert 'url("fonts/formulas.woff2")' in (DOCS / "_static/strapdown.css").read_text(encoding="utf-8")
