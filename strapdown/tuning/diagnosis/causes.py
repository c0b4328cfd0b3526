"""A cause with its evidence, and a diagnosis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from strapdown.checks import Array
from strapdown.consistency import Finding, Judgement
from strapdown.consistency.judgement import mark
from strapdown.files import plain
from strapdown.results import Listed, Table

LIKELIER = math.log(20.0)
"""Minimum difference in ln p to prefer one of two causes: odds of 20 to 1, "strong" evidence (Kass & Raftery 1995)."""
APPROXIMATION = 0.01
"""Relative error of ln p: hypotheses keep the filter's initial state and are linearised, which matters for gross faults."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cause:
    """One hypothesis with its best-fitting θ.

    Parameters
    ----------
    name : str
        Fault, such as "R too small", "time offset" or "hard iron".
    of : str
        Object with the fault: a sensor, "gyro", …
    estimate : ndarray (k,)
        Best-fitting θ, in ``unit``.
    standard_error : ndarray (k,)
        Standard error of θ, in ``unit``; NaN if there is none.
    unit : str
        SI unit of θ.
    gain : float
        Twice the gain in log-likelihood.
    log_p : float
        Natural logarithm of the probability of as large a gain for a consistent filter.
    words : str
        Description with the size of the fault.
    known : bool, default False
        Whether it is specified, and only the filter does not model it.
    """

    name: str
    of: str
    estimate: Array
    standard_error: Array
    unit: str
    gain: float
    log_p: float
    words: str
    known: bool = False

    @property
    def sentence(self) -> str:
        """The cause as known or as likely."""
        return f"{'Known, as specified' if self.known else 'Most likely cause'}: {self.words}"

    @property
    def finding(self) -> Finding:
        """The cause as evidence against the filter, for a joint test with the statistics."""
        return Finding(name=self.name, of=self.of, value=self.gain, p_value=math.exp(self.log_p), samples=1)


@dataclass(frozen=True, kw_only=True)
class Diagnosis(Listed):
    """Likely causes, the most likely first, with the evidence.

    Parameters
    ----------
    causes : tuple of Cause
        Significant causes, all evidence taken together. Those after the first may be side effects of it: correct it and
        repeat the diagnosis.
    considered : tuple of Cause
        All hypotheses in order of rank.
    judgement : Judgement
        The verdict on the filter from statistics and causes together (Holm), so that neither contradicts the other.
    """

    causes: tuple[Cause, ...]
    considered: tuple[Cause, ...]
    judgement: Judgement

    def listing(self) -> Table:
        """Return the causes considered, the most likely first, as a table."""
        rows = [
            (cause.name, cause.of, cause.gain, cause.log_p, mark(cause in self.causes, cause.known))
            for cause in self.considered[:8]
        ]
        notes = self.words.splitlines()
        return Table("Causes by what they would explain", ("cause", "of", "gain", "ln p", ""), rows, notes, left=2)

    @property
    def alternatives(self) -> tuple[Cause, ...]:
        """The most likely cause, and those that the data do not distinguish from it: within a factor of 20 or 1 % of ln p.

        If some of these are known, only they.
        """
        best = self.causes[0].log_p if self.causes else 0.0
        near = tuple(cause for cause in self.causes if cause.log_p <= best + max(LIKELIER, APPROXIMATION * -best))
        return tuple(cause for cause in near if cause.known) or near

    @property
    def words(self) -> str:
        """The verdict and the causes as text."""
        return f"{self.judgement.words}\n{self.cause_words}"

    @property
    def cause_words(self) -> str:
        """The causes as text."""
        if not self.causes:
            return "No cause among those considered is significant."
        first = self.alternatives
        lines = [first[0].sentence]
        if len(first) > 1:
            heading = "One of these causes, which the data do not distinguish:"
            lines = [heading, *(f"  - {cause.words}" for cause in first)]
        others = [cause for cause in self.causes if cause not in first]
        lines += [
            f"  then, unless a side effect of the first:  {cause.words}" for cause in others[: max(4 - len(first), 0)]
        ]
        return "\n".join(lines)

    def summary(self) -> dict[str, Any]:
        """Return causes and verdict as plain values for JSON.

        Returns
        -------
        dict
            All hypotheses with their figures and whether they are significant, and the verdict as of
            :meth:`strapdown.consistency.Judgement.summary`.
        """
        causes = [
            {**vars(cause), "significant": cause in self.causes, "alternative": cause in self.alternatives}
            for cause in self.considered
        ]
        table = {"causes": causes, "judgement": self.judgement.summary()}
        return plain(table)  # type: ignore[no-any-return]
