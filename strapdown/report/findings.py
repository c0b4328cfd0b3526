"""A judgement as a part of the page."""

from __future__ import annotations

from strapdown import setup
from strapdown.consistency import Judgement
from strapdown.report import page
from strapdown.scenarios import Scenario
from strapdown.setup.states import States


def verdict(judgement: Judgement) -> str:
    """Return the verdict box."""
    return page.verdict(
        judgement.verdict, judgement.reason, [finding.means for finding in judgement.findings if finding.rejected]
    )


def evidence(judgement: Judgement) -> str:
    """Return the section with every statistic against its bounds, and what they cannot show."""
    rows = [
        (
            "fail" if finding.rejected else "pass",
            finding.name,
            finding.of,
            page.number(finding.value),
            page.number(finding.low),
            page.number(finding.high),
            page.number(finding.p_value, 3),
            page.number(finding.samples, 6),
        )
        for finding in judgement.findings
    ]
    head = ("", "statistic", "of", "value", "from", "to", "p-value", "samples")
    marked = ["fail" if finding.rejected else "pass" for finding in judgement.findings]
    percent = 100.0 * judgement.probability
    note = (
        f"Bounds hold one statistic of a right filter with {percent:g} %. The verdict takes all p-values together: a right filter is "
        f"called wrong with at most {100.0 - percent:g} %. Of correlated samples only their worth in independent ones is counted."
    )
    parts = [page.table(head, rows, numbers=5, marked=marked), page.paragraph(note, faint=True)]
    parts += [page.paragraph(f"What this does not show: {limit}.", faint=True) for limit in judgement.limits]
    return page.section("The evidence", *parts)


def without_a_state(scenario: Scenario, states: States | None, command: str) -> str:
    """Return the paragraph on what the scenario specifies and the filter has no state for; nothing where it has one for all."""
    missing = setup.not_covered(scenario.gyro, scenario.sensors, states, gravity_f=scenario.gravity_f)
    if not missing:
        return ""
    remedy = f"; `strapdown {command} --states` gives it states for most" if states is None else ""
    return page.paragraph(f"The filter has no state for {', '.join(missing)}{remedy}.")
