"""Every script in sims/ runs small, by itself, in an empty folder, and returns a frozen result.

A script may define ``SMALL``, keyword arguments that make its ``main`` quick; without it ``main`` runs as it is. Each gets a new process,
as a reader would give it, and so many seconds.
"""

import ast
import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import recordings as leaderboard
from sims import coning_algorithms as sim
from sims import error_budget, hand_held
from strapdown import quaternion

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


@pytest.mark.slow
def test_the_error_budget_reports_what_it_computes_before_it_does():
    lines = []
    error_budget.main(**error_budget.SMALL, progress=lines.append)
    assert lines[:2] == ["matched: covariance analysis", "matched: 4 runs"]
    assert len(lines) == 4


# The tests of the whole sim are slow: a step of .ci/run.
@pytest.mark.slow
def test_own_best_loses_nowhere(tmp_path):
    result = sim.main(out=tmp_path, quick=True)
    assert {p.name for p in tmp_path.iterdir()} == {
        "coning.json",
        *(f"coning-{name}.png" for name in ("cost", "comparison", "manoeuvres")),
    }
    assert set(json.loads((tmp_path / "coning.json").read_text())) == {"comparison", "costs", "ratios", "manoeuvres"}
    assert all(name in sim.table(result) for name in (*sim.PUBLISHED, *sim.OWN))
    assert result.comparison.drift["matched-1-8-8"].size == 4
    assert [sim.lost(result.comparison, "matched-1-8-8", what) for what in ("drift", "periodic")] == [[], []]
    assert 0.0 < sim.worst_ratio(result.comparison, "matched-1-8-8", "drift") < 0.1


def test_own_best_leads_on_random_manoeuvres():
    _, errors = sim.manoeuvres(3, 1)
    least = np.min([errors[name] for name in sim.PUBLISHED], axis=0)
    assert np.all(errors["matched-1-8-8"] < np.maximum(least, sim.MANOEUVRE_ROUNDING))
    assert max(least) > 100 * sim.MANOEUVRE_ROUNDING  # there was something to beat


def test_a_verdict_names_what_was_lost(monkeypatch):
    monkeypatch.setattr(sim, "PUBLISHED", ("two-sample", "eight-sample"))
    comparison = sim.compare([0.1], [0.5])
    comparison.drift["two-sample"][0, 0] = 0.0
    assert [place.split(": ")[-1] for place in sim.lost(comparison, "matched-2-8", "drift")] == ["two-sample"]
    assert sim.lost(comparison, "matched-2-8", "periodic") == []


def test_the_regions_of_the_leaderboard_are_those_of_any_heading_of_the_reference():
    """The covariance is rotated with the heading offset that is removed; of an error about one level axis, and its σ about the other."""
    unit = hand_held.simulated(1, 0, 4.0)
    attitude = quaternion.multiply(unit.true_attitude, quaternion.exp([0.05, 0.0, 0.0]))
    covariance = np.broadcast_to(np.diag([1e-4, 1e-2, 1e-2]), (len(unit.time), 3, 3))
    scores = [
        leaderboard.score(
            dataclasses.replace(unit, true_attitude=quaternion.multiply(quaternion.exp(turn), unit.true_attitude)),
            lambda _: (attitude, covariance),
        )
        for turn in ([0.0, 0.0, 0.0], [0.0, 0.0, 0.5 * np.pi])
    ]
    for score in scores:
        np.testing.assert_allclose(score.error_deg, scores[0].error_deg)
        np.testing.assert_allclose(score.coverage, scores[0].coverage)
        np.testing.assert_allclose(score.nees, scores[0].nees)
    assert scores[0].coverage[0] == 0.0
