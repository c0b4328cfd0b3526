"""Tuning by credibility: the squares that have a known distribution in a consistent filter should have it, in whole.

The innovations of a consistent filter are white, and standard normal once they are over their own σ. So the NIS of a measurement with d
rows is χ² of d degrees of freedom; and so is that of a *block*, the square of the sum of the whitened innovations of L measurements in a
row over L. Blocks of 1, 2, 4, … measurements are judged, each size and each sensor by itself: what is not white is too much or too little
in blocks as long as its cause lasts. Against a truth the NEES at epochs that have forgotten each other is judged instead.

Squares x become uniform, ``u = F(x)``, by the probability integral transform. How far they are from it is Neyman's smooth statistic (1937)

    Σ_k z_k²,  z_k = n^{-½} Σ_i √(2k + 1) P_k(2 u_i − 1),

P_k Legendre's polynomials: the first components of Anderson & Darling's (Durbin & Knott 1972), each of unit variance, and unlike it smooth
in the parameters. Four of them judge single squares; of blocks, whose sums are near normal whatever the noise, the first judges the size.
Half the sum over all samples is minimised.

*What it determines.* The size of a sensor's noise where the state is known, with 1.3 times the likelihood's standard error (single squares
alone have 93 % of its efficiency at one degree of freedom and 96 % at two; the blocks, which see the gyro, add their own scatter). The
gyro's white noise and the walk of its bias by what they make of long blocks, with about twice the likelihood's. *What it cannot.* Whether
the errors are small: a filter that throws measurements away and says so is credible. The NEES of attitude and bias determines a common
scale and hardly more: free one parameter or two against a truth.

*Outliers.* A square however large moves ln σ by at most 2.8/n (one degree of freedom) or 1.75/n (two), where the likelihood's pull has no
bound. But an outlier spoils a block of every size, and moves the filter itself, so many of them need a model of their own
(:mod:`strapdown.tuning.outliers`).

The value is no likelihood and its curvature no information: standard errors and intervals come from the scatter of the estimating function
over parts of the records and the actual curvature (sandwich).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from strapdown import consistency
from strapdown.checks import Array, InputError
from strapdown.setup import FilterSetup
from strapdown.tuning.errors import ErrorObjective, error_objective
from strapdown.tuning.innovations import MOST, STEP, Case, Composite, Derivatives, likelihood
from strapdown.vectors import KINDS

ORDER = 4
"""Components of the distribution of single squares that are judged: Neyman's own number."""
FAR = 1.0
"""Mean of ln(1 + x/d) so far from its own that all transforms are near 0 or 1, which know no way back: a square of what lies beyond leads
there, and is nothing where it ends."""
LEAST_BLOCKS = 10
"""Blocks of a size that are judged, at least; of all records together."""
CURVATURE_STEP = 0.05
"""Of a log parameter, for second derivatives."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """Squares that should all be χ² of one number of degrees of freedom."""

    name: str
    """The sensor, or the set of states."""
    length: int
    """Measurements of a block."""
    degrees: int
    squares: Array
    """x (n,)."""
    slope: Array
    """∂x/∂θ (n, p)."""
    part: np.ndarray
    """Part of the records that each belongs to (n,)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Distance:
    """Half of Neyman's statistic of one sample, and its derivatives."""

    value: float
    score: Array
    """(p,)"""
    information: Array
    """Gauss–Newton's (p, p): the mean slope of each component, squared."""
    influence: Array
    """What each square adds to the estimating function (n, p)."""


def distance(sample: Sample) -> Distance:
    """Return how far a sample is from χ²: single squares by ``ORDER`` components, blocks by one."""
    from scipy.special import chdtr, gammaln

    n, half, x = len(sample.squares), 0.5 * sample.degrees, np.maximum(sample.squares, 1e-300)
    density = np.exp((half - 1.0) * np.log(0.5 * x) - 0.5 * x - gammaln(half)) / 2.0
    components, slopes = components_of(np.asarray(chdtr(sample.degrees, x)), ORDER if sample.length == 1 else 1)
    components, slopes = components / np.sqrt(n), slopes * (density / np.sqrt(n))[:, None]
    z, J = components.sum(axis=0), slopes.T @ sample.slope
    away = float(np.mean(np.log1p(x / sample.degrees))) - _usual_log(sample.degrees)
    beyond = np.sqrt(n) * max(abs(away) - FAR, 0.0) * np.sign(away)
    lead = np.sqrt(n) * np.mean(sample.slope / (sample.degrees + x)[:, None], axis=0) * (beyond != 0.0)
    return Distance(
        value=0.5 * float(z @ z + beyond**2),
        score=z @ J + beyond * lead,
        information=J.T @ J + np.outer(lead, lead),
        influence=components @ J + (slopes @ z)[:, None] * sample.slope,
    )


def components_of(u: Array, order: int) -> tuple[Array, Array]:
    """Return √(2k + 1) P_k(2u − 1), orthonormal over 0 … 1, and their derivatives by u, k = 1 … ``order``: (n, order) each."""
    from numpy.polynomial import legendre

    norm = np.sqrt(2.0 * np.arange(1, order + 1) + 1.0)
    derivatives = np.stack(
        [legendre.legval(2.0 * u - 1.0, legendre.legder(row)) for row in np.eye(order + 1)[1:]], axis=1
    )
    return legendre.legvander(2.0 * u - 1.0, order)[:, 1:] * norm, 2.0 * derivatives * norm


@functools.cache
def _usual_log(degrees: int) -> float:
    """Return the mean of ln(1 + x/d), x χ² of d degrees of freedom."""
    from scipy.special import chdtri

    levels = (np.arange(2000) + 0.5) / 2000.0
    return float(np.mean(np.log1p(chdtri(degrees, levels) / degrees)))


@dataclass(frozen=True, kw_only=True)
class CredibilityObjective(Composite):
    """Distance of NIS, or NEES, from their distribution in a consistent filter; built by :func:`credibility_objective`."""

    errors: ErrorObjective | None = None
    """Where the errors against a truth are judged; None: innovations."""

    def minus_log(self, points: Array) -> Array:
        """Return half the statistic at several points (k, p): (k,)."""
        return np.array(
            [sum(distance(sample).value for sample in self.samples(point[None])) for point in np.atleast_2d(points)]
        )

    def derivatives(self, point: Array) -> Derivatives:
        """Return half the statistic, its gradient and Gauss–Newton's curvature at a point."""
        p = len(point)
        parts = sum(int(case.used.sum()) for case in self.base.prepared)
        value, score, information, outer = 0.0, np.zeros(p), np.zeros((p, p)), np.zeros((p, p))
        scatter = np.zeros((parts, p))
        for sample in self.samples(np.concatenate([point[None], point + STEP * np.eye(p)])):
            found = distance(sample)
            value += found.value
            score += found.score
            information += found.information
            outer += found.influence.T @ found.influence
            np.add.at(scatter, sample.part, found.influence)
        # The influences add up to twice the gradient; only how they differ is taken from them.
        return Derivatives(
            value=np.full(parts, value / parts),
            score=scatter + (score - scatter.sum(axis=0)) / parts,
            information=information,
            outer=outer,
        )

    def curvature(self, point: Array) -> Array:
        """Return the second derivatives of half the statistic (p, p), by differences.

        Gauss–Newton's are too large in all but long records: the slopes that it squares are noisy.
        """
        steps = CURVATURE_STEP * np.eye(len(point))
        rows = [
            self.derivatives(point + h).score.sum(axis=0) - self.derivatives(point - h).score.sum(axis=0) for h in steps
        ]
        found = np.array(rows) / (2.0 * CURVATURE_STEP)
        return np.asarray(0.5 * (found + found.T))

    def samples(self, rows: Array) -> Iterator[Sample]:
        """Yield all that is judged at the point of the first row, its slopes the differences to the others over ``STEP``."""
        judged = self._nis if self.errors is None else self._nees
        per_record = self.base.each(lambda number: judged(number, rows), range(len(self.base.prepared)))
        first = np.cumsum([0, *(int(case.used.sum()) for case in self.base.prepared)])
        for key in dict.fromkeys(key for found in per_record for key in found):
            having = [
                (*found[key], before) for found, before in zip(per_record, first[:-1], strict=True) if key in found
            ]
            squares = np.concatenate([x for x, _, _ in having])
            if len(squares) < LEAST_BLOCKS:
                continue
            name, length, degrees = key
            yield Sample(
                name=name,
                length=length,
                degrees=degrees,
                squares=squares[:, 0],
                slope=(squares[:, 1:] - squares[:, :1]) / STEP,
                part=np.concatenate([part + before for _, part, before in having]),
            )

    def _nis(self, number: int, rows: Array) -> dict[tuple[str, int, int], tuple[Array, np.ndarray]]:
        """Return by name and degrees of freedom the NIS of blocks (n, lanes) of one record and the part of each."""
        case = self.base.prepared[number]
        white = self._whitened(number, rows)
        part = np.searchsorted(case.cuts, case.events.time, side="left")
        place = np.cumsum(case.used) - 1
        found = {}
        for sensor, (name, kind) in enumerate(zip(case.events.sensors, case.events.kinds, strict=True)):
            mine = np.flatnonzero((case.events.sensor == sensor) & case.used[part])
            own, at, length = white[mine][:, : KINDS[kind]], place[part[mine]], 1
            while len(own) > 0:
                found[name, length, KINDS[kind]] = np.einsum("mdl,mdl->ml", own, own) / length, at
                even = len(own) // 2 * 2
                own, at, length = own[0:even:2] + own[1:even:2], at[1:even:2], 2 * length
        return found

    def _whitened(self, number: int, rows: Array) -> Array:
        """Return whitened innovations (events, 3, k) at any number of points (k, p), each pass holding the first."""
        blocks = []
        for start in range(1, max(len(rows), 2), MOST):
            e, s = self.base.innovations(number, np.concatenate([rows[:1], rows[start : start + MOST]]))
            white = e / np.sqrt(np.where(s > 0.0, s, 1.0))
            blocks.append(white[..., 0 if start == 1 else 1 :])
        return np.concatenate(blocks, axis=-1)

    def _nees(self, number: int, rows: Array) -> dict[tuple[str, int, int], tuple[Array, np.ndarray]]:
        """Return by name and degrees of freedom the NEES at the epochs of one record (n, lanes) and the part of each."""
        assert self.errors is not None
        case = self.base.prepared[number]
        error, P = self.errors.errors_of(number, rows)
        time = case.time[self.errors.epochs[number]]
        part = (np.cumsum(case.used) - 1)[np.searchsorted(case.cuts, time, side="left")]
        subsets = {name: states for name, states in consistency.SUBSETS.items() if max(states) < error.shape[-1]}
        return {(name, 1, len(states)): (consistency.nees(error, P, states), part) for name, states in subsets.items()}


def credibility_objective(
    cases: Sequence[Case], chosen: FilterSetup, free: Sequence[str], *, truth: bool = False, threads: int = 1
) -> CredibilityObjective:
    """Return the objective of consistency: of the NIS, or with ``truth`` of the NEES against the records' truth or reference attitude."""
    errors = error_objective(cases, chosen, free, threads=threads) if truth else None
    base = errors.base if errors is not None else likelihood(cases, chosen, free, threads=threads)
    objective = CredibilityObjective(base=base, errors=errors)
    if not any(True for _ in objective.samples(base.start[None])):
        what = "epochs with a truth" if truth else "measurements of one sensor"
        raise InputError(
            f"the records have fewer than {LEAST_BLOCKS} {what}, too few to judge a distribution by; give longer ones"
        )
    return objective
