"""Every script in sims/ runs small, by itself, in an empty folder, and returns a frozen result.

A script may define ``SMALL``, keyword arguments that make its ``main`` quick; without it ``main`` runs as it is. Each gets a new process,
as a reader would give it, and so many seconds.
"""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sims import coning_algorithms as sim

ROOT = Path(__file__).resolve().parents[1]
SIMS = sorted((ROOT / "sims").glob("*.py"))
SECONDS = 60

RUN = """
import dataclasses, importlib.util, sys
import matplotlib
matplotlib.use("Agg")
spec = importlib.util.spec_from_file_location("sim", sys.argv[1])
sim = sys.modules["sim"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sim)
result = sim.main(**getattr(sim, "SMALL", {}))
assert dataclasses.is_dataclass(result), f"main returns {type(result).__name__}, not a dataclass"
assert type(result).__dataclass_params__.frozen, f"{type(result).__name__} is not frozen"
"""


def test_there_are_sims():
    assert SIMS


@pytest.mark.parametrize("path", SIMS, ids=lambda path: path.stem)
def test_sim_is_a_script_with_a_main(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree), "say in the docstring which question it answers and how to run it"
    mains = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "main"]
    assert len(mains) == 1
    guards = [ast.unparse(node.test) for node in tree.body if isinstance(node, ast.If)]
    assert "__name__ == '__main__'" in guards, "let the file run by itself"
    names = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert "argparse.ArgumentParser" in names, "take options by argparse, so that --help lists them"
    assert "sys.argv" not in names, "an option unknown to the script must not be taken for a file's name"
    options = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    assert {"--out", "--seed"} <= options


@pytest.mark.slow  # minutes for all of them: a step of .ci/run
@pytest.mark.parametrize("path", SIMS, ids=lambda path: path.stem)
def test_sim_runs_small(path, tmp_path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    try:
        done = subprocess.run(
            [sys.executable, "-c", RUN, path],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        pytest.fail(f"sims/{path.name} took more than {SECONDS} s; define SMALL there, arguments that make main quick")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Warning" not in done.stderr, done.stderr[-3000:]


# The tests of the whole sim are slow: a step of .ci/run.
@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("coning")
    return sim.main(out=folder, quick=True), folder


@pytest.mark.slow
def test_it_writes_its_figures_and_numbers(result):
    _, folder = result
    figures = {f"coning-{name}.png" for name in ("drift", "floor", "cost", "comparison", "manoeuvres")}
    assert {p.name for p in folder.iterdir()} == {"coning.json", *figures}
    parts = {"comparison", "verdicts", "curves", "costs", "manoeuvres"}
    assert set(json.loads((folder / "coning.json").read_text())) == parts


@pytest.mark.slow
def test_own_best_loses_nowhere(result):
    verdicts = {v.own: v for v in result[0].verdicts}
    best = verdicts["matched-1-8-8"]
    assert best.drift_lost == ()
    assert best.periodic_lost == ()
    assert 0.0 < best.worst_drift_ratio < 0.1
    assert best.points == 4


def test_own_best_leads_on_random_manoeuvres():
    manoeuvres = sim.manoeuvres(3, 1)
    errors = manoeuvres.errors
    least = [min(errors[name][k] for name in sim.PUBLISHED) for k in range(len(manoeuvres.ratios))]
    assert all(
        own < max(best, sim.MANOEUVRE_ROUNDING) for own, best in zip(errors["matched-1-8-8"], least, strict=True)
    )
    assert max(least) > 100 * sim.MANOEUVRE_ROUNDING  # there was something to beat


def test_a_verdict_names_what_was_lost(monkeypatch):
    monkeypatch.setattr(sim, "PUBLISHED", ("two-sample", "eight-sample"))
    comparison = sim.compare([0.1], [0.5])
    comparison.drift["two-sample"][0][0] = 0.0
    verdict = sim.judge(comparison, "matched-2-8")
    assert [name for _, _, name in verdict.drift_lost] == ["two-sample"]
    assert verdict.periodic_lost == ()


@pytest.mark.slow
def test_the_table_has_every_algorithm(result):
    text = sim.table(result[0])
    assert all(name in text for name in (*sim.PUBLISHED, *sim.OWN))
