"""Predicted errors of a filter, with their budget by source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from strapdown import units
from strapdown.checks import Array, InputError
from strapdown.results import Column, Listed, Table
from strapdown.units import DEGREE

LARGEST_LINEAR = 0.15
"""Errors of attitude or direction above this are reported as beyond linear, rad; their squares are above a tenth of them."""
MIN_NEES, MAX_NEES = 0.9, 1.1
"""Limits of the expected NEES per state, and of the NIS, of a consistent filter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Analysis(Listed):
    """Predicted errors of a filter: the error state e = (δθ, δb), rad in the body frame and rad/s.

    Parameters
    ----------
    time : ndarray (m,)
        Epochs, s.
    filter_covariance : ndarray (m, 6, 6)
        P reported by the filter: rad², rad²/s, (rad/s)².
    sources : tuple of str (s,)
        Names of the sources of random error.
    contributions : ndarray (m, s, 6, 6)
        Contribution of each source to the covariance of the actual error: rad², rad²/s, (rad/s)².
    fixed : tuple of str (f,)
        Names of the errors that are the same in every run.
    fixed_errors : ndarray (m, f, 6)
        Mean error due to each of them, rad and rad/s.
    considered : tuple of str (c,)
        Names of the considered errors.
    considered_errors : ndarray (m, c, 6)
        Error due to one standard deviation of each of them, rad and rad/s.
    expected_nis : mapping of str to float
        Mean NIS per degree of freedom over the whole time, by sensor; 1 for a consistent filter.
    drawn : tuple of str
        Those of the fixed errors that a Monte Carlo draws in each run, because the filter has states for them.
    unmodelled : tuple of str
        Errors of the scenario that the filter does not model, in words.
    left_out : tuple of str
        Errors of the scenario that the analysis does not include.
    beyond_linear : tuple of str
        Errors too large for an analysis linear about the truth, in words; use a Monte Carlo for them.
    """

    _drawn_by = "error_budget"

    time: Array
    filter_covariance: Array
    sources: tuple[str, ...]
    contributions: Array
    fixed: tuple[str, ...]
    fixed_errors: Array
    considered: tuple[str, ...]
    considered_errors: Array
    expected_nis: Mapping[str, float]
    drawn: tuple[str, ...]
    unmodelled: tuple[str, ...]
    left_out: tuple[str, ...]
    beyond_linear: tuple[str, ...]

    def listing(self) -> Table:
        """Return the error budget at the last epoch as a table, the largest attitude error first, with the expected NEES and NIS."""
        rms, sigma = self.rms[-1], self.filter_sigma[-1]
        unit, size = units.angle_unit([*rms[:3], *sigma[:3]])
        rate_name, rate = units.rate_unit([*rms[3:], *sigma[3:]])
        sources = sorted(self.budget(), key=lambda row: -row[2])
        for name, kind, six in (("actual error", "all", rms), ("the filter's own σ", "", sigma)):
            parts = np.sqrt(np.mean(six.reshape(2, 3) ** 2, axis=1))
            sources.append((name, kind, float(parts[0]), float(parts[1])))
        rows = [
            (name, kind, attitude / size, bias / rate, attitude / units.ARCSECOND, bias / units.DEGREE_PER_HOUR)
            for name, kind, attitude, bias in sources
        ]
        state, attitude, bias = self.expected_nees[-1]
        nis = ", ".join(f"{sensor} {value:.3g}" for sensor, value in self.expected_nis.items())
        notes = [
            "random: squares add. fixed: the same in every run, adds as an error. considered: 1σ of an error that neither the scenario nor "
            "the filter models.",
            f"Expected NEES per state: {state:.3g} (attitude {attitude:.3g}, bias {bias:.3g}); NIS: {nis or 'none'}.",
            self.words,
            *self._omissions,
            *(f"Beyond linear: {effect}; use a Monte Carlo (`strapdown montecarlo`)." for effect in self.beyond_linear),
        ]
        columns = (
            Column("source", "source"),
            Column("kind", "kind"),
            Column(f"attitude, {unit}", digits=3),
            Column(f"bias, {rate_name}", digits=3),
            Column(None, "attitude_arcsec"),
            Column(None, "bias_deg_per_hour"),
        )
        title = f"Error budget per axis at {self.time[-1]:.6g} s, RMS"
        return Table(title, columns, rows, notes, left=2, name="budget")

    @property
    def _omissions(self) -> list[str]:
        """What the filter does not model, what the analysis leaves out, and what is both, a sentence each."""
        both = [error for error in self.unmodelled if error in self.left_out]
        sentences = {
            "The filter does not model": [error for error in self.unmodelled if error not in both],
            "Neither the filter nor this analysis includes": both,
            "Left out of the analysis:": [error for error in self.left_out if error not in both],
        }
        return [f"{words} {', '.join(errors)}." for words, errors in sentences.items() if errors]

    @property
    def words(self) -> str:
        """Whether the errors, first of all those at the last epoch, and the innovations will be consistent with the filter."""
        largest = float(max(*self.rms[-1, :3], *self.filter_sigma[-1, :3]))
        if largest > LARGEST_LINEAR:
            return (
                f"With an attitude error of {largest / DEGREE:.3g}° the analysis, linear about the truth, cannot tell whether the filter "
                "will be consistent."
            )
        nees = self.expected_nees[:, 1:]
        if words := self._contradiction(len(nees) - 1):
            return words
        odd = [f"{name} {nis:.3g}" for name, nis in self.expected_nis.items() if not MIN_NEES <= nis <= MAX_NEES]
        if odd:
            return f"The errors at the end will agree with σ, but not the innovations: NIS of {', '.join(odd)}."
        for epoch in (np.argmax(nees.max(axis=1)), np.argmin(nees.min(axis=1))):
            if words := self._contradiction(int(epoch)):
                return words
        return f"{'But for what is left out, the' if self.left_out else 'The'} filter will be consistent."

    def _contradiction(self, epoch: int) -> str:
        """Return how the errors at an epoch will contradict the filter, in words; empty if they will not."""
        _, attitude, bias = self.expected_nees[epoch]
        when = "" if epoch == len(self.time) - 1 else f" at {self.time[epoch]:.6g} s, though not at the end"
        if (worst := max(attitude, bias)) > MAX_NEES:
            optimistic = (
                f"optimistic in {'bias' if bias > attitude else 'attitude'}: √NEES is {np.sqrt(worst):.3g}{when}."
            )
            same = [name not in self.drawn for name in self.fixed]
            if all(same) or self._nees(self._moment(self.fixed_errors[:, same]))[epoch, 1:].max() > MAX_NEES:
                return f"The filter will be {optimistic}"
            return (
                f"For a unit with exactly the specified constant errors, the filter is {optimistic} Over units (a Monte Carlo draws them) "
                "it may be consistent."
            )
        if min(attitude, bias) < MIN_NEES:
            return f"The filter will be pessimistic{when}: its σ will be larger than its errors."
        return ""

    @property
    def covariance(self) -> Array:
        """Covariance of the actual error (m, 6, 6), including the considered errors."""
        return np.asarray(
            self.contributions.sum(axis=1) + np.einsum("mci,mcj->mij", self.considered_errors, self.considered_errors)
        )

    @property
    def mean_error(self) -> Array:
        """Mean of the actual error (m, 6)."""
        return np.asarray(self.fixed_errors.sum(axis=1))

    @property
    def second_moment(self) -> Array:
        """E[e eᵀ] of the actual error (m, 6, 6)."""
        return self._moment(self.fixed_errors)

    def _moment(self, fixed: Array) -> Array:
        """Return :attr:`second_moment` with these fixed errors (m, f, 6)."""
        mean = fixed.sum(axis=1)
        return np.asarray(self.covariance + mean[:, :, None] * mean[:, None, :])

    @property
    def rms(self) -> Array:
        """Root mean square of the actual error (m, 6): rad, rad/s."""
        return np.sqrt(np.diagonal(self.second_moment, axis1=1, axis2=2))

    @property
    def filter_sigma(self) -> Array:
        """The filter's σ (m, 6): rad, rad/s."""
        return np.sqrt(np.diagonal(self.filter_covariance, axis1=1, axis2=2))

    @property
    def expected_nees(self) -> Array:
        """Mean NEES per state (m, 3) of all six states, of the attitude, of the bias: tr(P⁻¹ E[e eᵀ])/n; 1 for a consistent filter."""
        return self._nees(self.second_moment)

    def _nees(self, M: Array) -> Array:
        """Return :attr:`expected_nees` for errors of the second moment M (m, 6, 6)."""
        P, parts = self.filter_covariance, (slice(0, 6), slice(0, 3), slice(3, 6))
        sums = [np.trace(np.linalg.solve(P[:, part, part], M[:, part, part]), axis1=1, axis2=2) for part in parts]
        return np.stack(sums, axis=-1) / [part.stop - part.start for part in parts]

    @property
    def cramer_rao(self) -> Array:
        """Posterior Cramér–Rao bound (m, 6, 6) of a matched filter's analysis: lower bound of the mean square error of any filter.

        The Riccati recursion along the true trajectory, for small errors (Tichavský, Muravchik & Nehorai, IEEE Trans. Signal Processing
        46(5), 1998). Fixed errors of the scenario (scale factor, hard iron) are treated as known, which can only lower the bound.

        Raises
        ------
        InputError
            If the filter's noise is not that of the scenario, or the scenario's is not white, or the filter has error states, so that the
            bound does not hold.
        """
        P = self.filter_covariance
        sigma = self.filter_sigma
        # If the filter's model of the noise is the true one, the contributions sum to P.
        off = np.abs(self.contributions.sum(axis=1) - P) / (sigma[:, :, None] * sigma[:, None, :])
        if off.max() > 1e-6:
            raise InputError(
                "the filter's noise is not that of the scenario, and the Cramér–Rao bound of attitude and bias assumes white noise and a "
                "random walk of the bias, the same on each axis; analyse a matched filter without error states, and a scenario without "
                "flicker, correlated noise and outliers"
            )
        return P

    def summary(self) -> dict[str, Any]:
        """Return the errors over time and by source as plain values for JSON.

        Returns
        -------
        dict
            Arrays over time as lists, with the unit in each key.
        """
        sizes = np.array([units.ARCSECOND] * 3 + [units.DEGREE_PER_HOUR] * 3)

        def parts(values: Array) -> dict[str, Any]:
            shown = values / sizes
            return {"attitude_arcsec": shown[..., :3].tolist(), "bias_deg_per_hour": shown[..., 3:].tolist()}

        def by_source(names: Sequence[str], values: Array) -> dict[str, Any]:
            return {name: parts(values[:, k]) for k, name in enumerate(names)}

        random = np.sqrt(np.maximum(np.diagonal(self.contributions, axis1=2, axis2=3), 0.0))
        nees = zip(("state", "attitude", "bias"), self.expected_nees.T.tolist(), strict=True)
        return {
            "time_s": self.time.tolist(),
            **{name: parts(getattr(self, name)) for name in ("rms", "filter_sigma", "mean_error")},
            "expected_nees_per_state": dict(nees),
            "expected_nis": dict(self.expected_nis),
            "random": by_source(self.sources, random),
            "fixed": by_source(self.fixed, self.fixed_errors),
            "considered": by_source(self.considered, self.considered_errors),
            "unmodelled": list(self.unmodelled),
            "left_out": list(self.left_out),
            "beyond_linear": list(self.beyond_linear),
        }

    def budget(self, epoch: int = -1) -> list[tuple[str, str, float, float]]:
        """Return the error budget at an epoch, one row per source.

        Rows add as squares, except the fixed ones, which add as errors. The axes of a considered error share one row.

        Parameters
        ----------
        epoch : int, default -1
            Index of the epoch.

        Returns
        -------
        list of (str, str, float, float)
            Name, kind ("random", "fixed" or "considered"), RMS error of an attitude axis (rad) and of a bias axis (rad/s).
        """
        rows: dict[tuple[str, str], Array] = {}
        for name, block in zip(self.sources, self.contributions[epoch], strict=True):
            rows[name, "random"] = np.diag(block)
        for name, error in zip(self.fixed, self.fixed_errors[epoch], strict=True):
            rows[name, "fixed"] = error**2
        for name, error in zip(self.considered, self.considered_errors[epoch], strict=True):
            key = (name.partition(",")[0], "considered")
            rows[key] = rows.get(key, np.zeros(6)) + error**2
        return [
            (name, kind, float(np.sqrt(np.mean(squares[:3]))), float(np.sqrt(np.mean(squares[3:]))))
            for (name, kind), squares in rows.items()
        ]
