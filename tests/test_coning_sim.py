"""The sim runs small, writes what it says, and its verdicts follow from its numbers."""

import json

import pytest

from sims import coning_algorithms as sim


# The tests of the whole sim are slow: a step of .ci/run.
@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("coning")
    return sim.main(out=folder, quick=True), folder


@pytest.mark.slow
def test_it_writes_its_figures_and_numbers(result):
    _, folder = result
    assert {p.name for p in folder.iterdir()} == {
        "coning.json",
        "coning-drift.png",
        "coning-floor.png",
        "coning-cost.png",
        "coning-comparison.png",
        "coning-manoeuvres.png",
    }
    assert set(json.loads((folder / "coning.json").read_text())) == {
        "comparison",
        "verdicts",
        "curves",
        "costs",
        "manoeuvres",
    }


@pytest.mark.slow
def test_own_best_loses_nowhere(result):
    verdicts = {v.own: v for v in result[0].verdicts}
    best = verdicts["matched-1-8-8"]
    assert best.drift_lost == ()
    assert best.periodic_lost == ()
    assert 0.0 < best.worst_drift_ratio < 0.1
    assert best.points == 4


def test_own_best_leads_on_random_manoeuvres():
    found = sim.manoeuvres(3, 1)
    errors = found.errors
    least = [min(errors[name][k] for name in sim.PUBLISHED) for k in range(len(found.ratios))]
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
