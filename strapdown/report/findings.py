"""The sections of a page for a judgement."""

from __future__ import annotations

from strapdown.consistency import Judgement
from strapdown.report import page
from strapdown.results import Table


def verdict(judgement: Judgement) -> str:
    """Return the verdict box."""
    return page.verdict(
        judgement.verdict, judgement.reason, [finding.means for finding in judgement.findings if finding.rejected]
    )


def listed(table: Table) -> str:
    """Return the section of a table of a result."""
    return page.section(table.title, *tabled(table))


def tabled(table: Table) -> list[str]:
    """Return a table of a result and its notes, without its title."""
    notes = (page.paragraph(note, faint=True) for note in table.notes)
    return [page.table(table.head, table.cells, numbers=len(table.head) - table.left), *notes]


def evidence(judgement: Judgement) -> str:
    """Return the section with all statistics, their bounds and their limitations."""
    return page.section("Evidence", *tabled(judgement.listing()))
