"""The sections of a page for a judgement."""

from __future__ import annotations

from strapdown.consistency import Judgement
from strapdown.report import page
from strapdown.results import Listing


def verdict(judgement: Judgement) -> str:
    """Return the verdict box."""
    return page.verdict(
        judgement.verdict, judgement.reason, [finding.means for finding in judgement.findings if finding.rejected]
    )


def listed(listing: Listing, *, numbers: int) -> str:
    """Return the section of a table of a result, its last ``numbers`` columns numbers."""
    notes = [page.paragraph(note, faint=True) for note in listing.notes]
    return page.section(listing.title, page.table(listing.columns, listing.rows, numbers=numbers), *notes)


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
    percent = 100.0 * judgement.confidence_level
    note = (
        f"Bounds, pass and fail are for all tests together: a consistent filter fails with at most {100.0 - percent:g} %. Each p-value is "
        "for one statistic. For correlated samples, the number is the effective number of independent samples."
    )
    parts = [page.table(head, rows, numbers=5, marked=marked), page.paragraph(note, faint=True)]
    parts += [page.paragraph(f"Limitation: {limit}.", faint=True) for limit in judgement.limits]
    return page.section("Evidence", *parts)
