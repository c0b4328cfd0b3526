"""The sections of a page for a judgement."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from strapdown import consistency
from strapdown.checks import InputError
from strapdown.consistency import Judgement
from strapdown.estimation import setup
from strapdown.records import Estimate, Truth, read_reference
from strapdown.report import page
from strapdown.scenarios import scenario_from_toml


def verdict(judgement: Judgement) -> str:
    """Return the verdict box."""
    return page.verdict(
        judgement.verdict, judgement.reason, [finding.means for finding in judgement.findings if finding.rejected]
    )


def evidence(judgement: Judgement) -> str:
    """Return the section with all statistics, their bounds and their limitations."""
    rows = [
        (
            "fail" if finding.rejected else "pass",
            finding.name,
            finding.of,
            page.number(finding.value),
            page.number(finding.low),
            page.number(finding.high),
            page.number(finding.p_value, 3),
            page.number(finding.samples, 4 if finding.samples % 1.0 else 9),
        )
        for finding in judgement.findings
    ]
    head = ("", "statistic", "of", "value", "from", "to", "p-value", "samples")
    marked = ["fail" if finding.rejected else "pass" for finding in judgement.findings]
    percent = 100.0 * judgement.probability
    note = (
        f"Bounds, pass and fail are for all tests together: a consistent filter fails with at most {100.0 - percent:g} %. Each p-value is "
        "for one statistic. For correlated samples, the number is the effective number of independent samples."
    )
    parts = [page.table(head, rows, numbers=5, marked=marked), page.paragraph(note, faint=True)]
    parts += [page.paragraph(f"Limitation: {limit}.", faint=True) for limit in judgement.limits]
    return page.section("Evidence", *parts)


def judged(
    path: Path, attributes: Mapping[str, Any], estimate: Estimate, truth: Truth | None, *, probability: float
) -> Judgement:
    """Return the verdict on an estimate, with the filter described in its file."""
    states, unmodelled = _filter_of(path, attributes)
    if truth is None:
        truth = read_reference(path)
    return consistency.judge(
        estimate,
        truth,
        probability=probability,
        upper_bounds="motion" in attributes,  # the estimate of a recording
        error_states=states,
        unmodelled=unmodelled,
    )


def _filter_of(path: Path, attributes: Mapping[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the error states of the filter of an estimate, and descriptions of the specified errors that it does not model."""
    if "filter" not in attributes:
        return (), ()
    try:
        chosen = setup.from_toml(str(attributes["filter"]), f"{path}: filter")
        states = () if chosen.states is None else chosen.states.names
        if "scenario" not in attributes:
            return states, ()
        scenario = scenario_from_toml(str(attributes["scenario"]), f"{path}: scenario")
    except InputError:
        return (), ()
    return states, setup.unmodelled_errors(scenario.gyro, scenario.sensors, chosen.states, gravity_f=scenario.gravity_f)
