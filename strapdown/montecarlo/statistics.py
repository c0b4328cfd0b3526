"""Statistics over independent runs, in memory that does not depend on their number, and their merging.

The m = epochs + 1 epochs are at the filter steps 0, every, 2·every, … (``plan.every``), after the update with measurements at that time;
errors are those of :func:`strapdown.consistency.errors`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import consistency, estimation, units
from strapdown.checks import Array, InputError, are_finite
from strapdown.consistency import Finding, Judgement, Verdict
from strapdown.consistency.bounds import coverage_p_values, log_mean_p_value, tail
from strapdown.consistency.judgement import (
    INNOVATIONS,
    LOG_NEES,
    STATES,
    concluded,
    error_words,
    innovation_words,
    ratio,
    state_name,
)
from strapdown.montecarlo.plan import Plan
from strapdown.records import Estimate, ImuRecord, Truth
from strapdown.results import ByValue, Listed, Table, counted, figure

Counts = NDArray[np.int64]

EXAMPLES = 8
"""Number of runs whose full error histories are kept for plots: those with a lower index."""
WORST = 10
"""Number of worst runs that are recorded."""

ODD = 1e-4
"""Probability, over all runs and epochs of a consistent filter, of a NEES that contradicts it alone."""

BINS_PER_OCTAVE = 8
"""Histogram bins of equal width between a number and its double: 12.5 to 6.7 % of the value."""
OCTAVES = 43
BINS = BINS_PER_OCTAVE * OCTAVES
ERROR_EXPONENT = -40
"""Bins of errors range from 2⁻⁴⁰ (9.1e-13 rad or rad/s) to 8; values outside are counted in the first and last."""
SHIFT = 49
"""Right shift of a double's bits that leaves the exponent and three bits of the mantissa: the bin, up to a constant."""
FIRST_BIN = (1023 + ERROR_EXPONENT) * BINS_PER_OCTAVE
"""That constant: bin 0 begins at 2 to ``ERROR_EXPONENT``."""

SUBSETS = {name: (column, len(states)) for column, (name, states) in enumerate(consistency.SUBSETS.items())}
"""Column of the NEES and degrees of freedom of each subset of the states."""


def bin_of(value: ArrayLike) -> Counts:
    """Return the bins of non-negative numbers: ``(bits >> SHIFT) − FIRST_BIN``, clipped to 0 … BINS − 1."""
    bits = np.array(value, dtype=np.float64, order="C").view(np.int64)
    return np.asarray(np.clip((bits >> SHIFT) - FIRST_BIN, 0, BINS - 1))


def bin_edges() -> Array:
    """Return the edges of the bins (BINS + 1,)."""
    octave, part = np.divmod(np.arange(BINS + 1), BINS_PER_OCTAVE)
    return np.asarray(np.ldexp(1.0 + part / BINS_PER_OCTAVE, ERROR_EXPONENT + octave))


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """One run in full detail."""

    record: ImuRecord
    """Simulated measurements, with the truth."""
    initial: estimation.State
    """Initial state of the filter."""
    estimate: Estimate
    """Estimate at every filter step, with full covariances."""

    def largest_nees(self, epochs: ArrayLike) -> tuple[float, float]:
        """Return the largest NEES of the states at these epochs (:attr:`Plan.time`), as in the list of worst runs, and its time, s.

        It is infinite at the first epoch at which the filter has failed.
        """
        estimate, truth, size = self.estimate, self.estimate.truth, 6 if self.estimate.has_bias else 3
        assert estimate.covariance is not None
        assert truth is not None
        rows = np.searchsorted(estimate.time, np.asarray(epochs) + 1e-9, side="right") - 1
        error = errors_at(estimate, rows, truth.taken(rows))
        nees = nees_at(error[:, :size], estimate.covariance[rows, :size, :size])
        nees[np.isnan(nees)] = np.inf
        worst = int(np.argmax(nees))
        return float(nees[worst]), float(estimate.time[rows[worst]])


def errors_at(estimate: Estimate, rows: Any, truth: Truth) -> Array:
    """Return the errors (m, 6) of some rows of an estimate, at which the truth is given; NaN where the filter has failed."""
    attitude, bias = estimate.attitude[rows], estimate.bias[rows]
    known = are_finite(attitude)
    error = np.full((len(attitude), 6), np.nan)
    error[known] = consistency.errors(attitude[known], bias[known], truth.attitude[known], truth.bias[known])
    return error


def nees_at(error: Array, P: Array) -> Array:
    """Return the NEES at each epoch (m,), NaN where the filter has failed or P is not positive definite."""
    try:
        return consistency.nees(error, P)
    except InputError:
        if len(error) == 1:
            return np.full(1, np.nan)
        return np.concatenate([nees_at(error[k : k + 1], P[k : k + 1]) for k in range(len(error))])


@dataclass(frozen=True, kw_only=True, eq=False)
class Statistics(ByValue, Listed):
    """Sums over independent runs at each epoch.

    Errors are e = (δθ, δb): rad in the body frame, rad/s. The sums at an epoch exclude runs that are not finite there.

    Parameters
    ----------
    time : ndarray (m,)
        Epochs, s.
    runs : int
        Number of runs.
    finite : ndarray (m,) of int
        Number of runs whose error, covariance P and three NEES are finite there, P positive definite.
    error_sum : ndarray (m, 6)
        Σ e.
    error_product_sum : ndarray (m, 6, 6)
        Σ e eᵀ.
    covariance_sum : ndarray (m, 6, 6)
        Σ P, the filter's covariance, symmetric.
    nees_sum : ndarray (m, 3)
        Σ NEES of all six states, of the attitude, of the bias (by the marginal blocks of P); not divided by the degrees of freedom.
    log_nees_sum : ndarray (m, 3)
        Σ ln NEES of the same; a NEES of 0 (a run that starts without error) adds the logarithm of the smallest normal number.
    coverage : ndarray (m, 6, 3) of int
        Number of runs with |e_i| ≤ k √P_ii, k = 1, 2, 3.
    histogram : ndarray (m, 6, BINS) of int
        Counts of |e| in bin ``bin_of(|e|)``, which shifts the double's bits, so no logarithm is needed.
    nis_edges : ndarray (k + 1,)
        Edges of the time bins of the NIS, s.
    sensors : tuple of str
        Names of the s sensors, in the scenario's order.
    sensor_nis_sum : ndarray (s, k)
        Σ NIS of the measurements used, by sensor and time bin; with a gate that of :meth:`Gate.ungated`.
    sensor_degrees : ndarray (s, k) of int
        Their degrees of freedom.
    sensor_refused : ndarray (s, k) of int
        Number of measurements refused by the gate; their NIS is excluded.
    worst_run : ndarray (w,) of int, w = min(WORST, runs)
        Indices of the runs of largest score, in descending order; equal scores in the order of their indices.
    worst_score : ndarray (w,)
        Their scores: the largest NEES of the state over the epochs; infinite if the run was not finite at some epoch.
    example_run : ndarray (x,) of int
        Indices of the runs, below EXAMPLES, whose full error histories are kept, in order.
    example_error : ndarray (x, m, 6)
        Errors of these runs, finite or not, rad and rad/s.
    example_sigma : ndarray (x, m, 6)
        The filter's σ in these runs, rad and rad/s.
    plan : Plan, optional
        Scenario, filter, seed and dispersions of the runs.
    """

    _drawn_by = "runs_overview"

    time: Array
    runs: int
    finite: Counts
    error_sum: Array
    error_product_sum: Array
    covariance_sum: Array
    nees_sum: Array
    log_nees_sum: Array
    coverage: Counts
    histogram: Counts
    nis_edges: Array
    sensors: tuple[str, ...]
    sensor_nis_sum: Array
    sensor_degrees: Counts
    sensor_refused: Counts
    worst_run: Counts
    worst_score: Array
    example_run: Counts
    example_error: Array
    example_sigma: Array
    plan: Plan | None = None

    def judge(
        self,
        *,
        epochs: Iterable[int] | None = None,
        confidence_level: float = 0.99,
        detectable_error: float = consistency.DETECTABLE,
    ) -> Judgement:
        """Return the verdict on these independent runs.

        Parameters
        ----------
        epochs : iterable of int, optional
            Indices of the epochs at which errors are judged. Default: 20 evenly spaced ones without the first, which is the prior.
        confidence_level, detectable_error : float
            As for :func:`strapdown.consistency.judge`.

        Returns
        -------
        Judgement
            "consistent" only if the runs would have shown an error of σ of attitude, bias and innovations by ``detectable_error``.
        """
        tail(confidence_level)
        rows = self.judged_epochs if epochs is None else np.array(list(epochs), int)
        failed = int(self.runs - np.min(self.finite[rows]))
        findings = []
        for subset in self.subsets:
            findings.append(_anees(self, rows, subset, confidence_level, failed))
            if failed == 0:
                findings.append(_log_nees(self, rows, subset))
        if failed == 0 and self.runs >= 3:
            findings += [_mean_error(self, rows), _run_coverage(self, rows)]
        for row, sensor in enumerate(self.sensors):
            degrees = float(np.sum(self.sensor_degrees[row]))
            if degrees >= 1.0:
                mean = float(np.sum(self.sensor_nis_sum[row]) / degrees)
                findings.append(ratio("NIS", sensor, mean, 1, degrees, innovation_words(sensor, mean)))
        parts = [f"{INNOVATIONS}{finding.of}" for finding in findings if finding.name == "NIS"]
        parts += [name for name in STATES if name in self.subsets]
        judged = concluded(
            findings,
            [],
            confidence_level,
            parts=dict.fromkeys(parts, ""),
            required=detectable_error,
            unmodelled=() if self.plan is None else self.plan.unmodelled,
            runs=counted(self.runs, "run"),
        )
        if not (what := _odd_runs(self)):
            return judged
        reason = (
            f"{judged.reason}; {what}" if judged.verdict == "not consistent" else f"{what}; otherwise {judged.headline}"
        )
        return replace(judged, verdict="not consistent", reason=reason)

    def listing(self) -> Table:
        """Return the evidence of the verdict as a table, with the errors at the end as its notes."""
        evidence = self.judge().listing()

        def at_the_end(values: Array, axes: slice, unit: float) -> str:
            return ", ".join(figure(x) for x in (values[-1, axes] / unit).tolist())

        notes = [
            f"{what} at {self.time[-1]:.6g} s (x, y, z), {words}: "
            f"RMS error {at_the_end(self.rms_error, axes, unit)}, σ {at_the_end(self.sigma, axes, unit)}"
            for what, axes, words, unit in (
                ("attitude", slice(0, 3), "arcsec", units.ARCSECOND),
                ("bias", slice(3, 6), "°/h", units.DEGREE_PER_HOUR),
            )
        ]
        if self.failed:
            notes.append(f"{counted(self.failed, 'run')} failed: their errors or covariances are not finite")
        return replace(evidence, notes=(*evidence.notes, *notes))

    @property
    def has_bias(self) -> bool:
        """Whether the filter estimates a gyro bias; if a user's filter does not, the bias adds zero to every sum."""
        return bool(self.covariance_sum[:, 3:, 3:].any()) or not self.finite.any()

    @property
    def subsets(self) -> tuple[str, ...]:
        """Subsets of the states that are judged: "state", "attitude" and "bias", or only "attitude" if no bias is estimated."""
        return tuple(SUBSETS) if self.has_bias else ("attitude",)

    @property
    def judged_epochs(self) -> Counts:
        """Indices of at most 20 equally spaced epochs, without the start, where the error is drawn, not estimated."""
        last = len(self.time) - 1
        return np.unique(np.linspace(max(1, last // 20), last, min(20, last)).astype(np.int64))

    @property
    def failed(self) -> int:
        """Minimum number of runs that were not finite at some epoch."""
        return int(self.runs - self.finite.min())

    def _mean(self, total: Any) -> Array:
        """Return the mean over runs of sums by epoch and state (m, 6, …), NaN without runs; of the bias if it is not estimated."""
        mean = _divided(total, self.finite.reshape(-1, *(1,) * (total.ndim - 1)))
        if not self.has_bias:
            mean[:, 3:] = mean[..., 3:] = np.nan
        return mean

    @property
    def mean_error(self) -> Array:
        """Mean error at each epoch (m, 6)."""
        return self._mean(self.error_sum)

    @property
    def mean_square_error(self) -> Array:
        """Mean of e eᵀ at each epoch (m, 6, 6), to which P should be equal."""
        return self._mean(self.error_product_sum)

    @property
    def rms_error(self) -> Array:
        """Root mean square error at each epoch (m, 6)."""
        return np.sqrt(np.diagonal(self.mean_square_error, axis1=1, axis2=2))

    @property
    def covariance(self) -> Array:
        """The filter's covariance, mean over runs (m, 6, 6)."""
        return self._mean(self.covariance_sum)

    @property
    def sigma(self) -> Array:
        """The filter's standard deviation, root of the mean variance over runs (m, 6)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def anees(self) -> Array:
        """NEES averaged over runs and states (m, 3): of all six, of attitude, of bias; 1 for a consistent filter, NaN without a bias."""
        return _divided(
            self.nees_sum, self.finite[:, None] * np.array([6.0, 3.0, 3.0] if self.has_bias else [0.0, 3.0, 0.0])
        )

    @property
    def covered(self) -> Array:
        """Fraction of the runs whose error lies inside 1, 2, 3 σ (m, 6, 3); 0.683, 0.954, 0.997 for a consistent filter."""
        return self._mean(self.coverage)

    @property
    def nis_time(self) -> Array:
        """Midpoints of the time bins of the NIS (k,), s."""
        return 0.5 * (self.nis_edges[1:] + self.nis_edges[:-1])

    @property
    def nis_degrees(self) -> Array:
        """Degrees of freedom in each time bin of one run, mean over runs (k,)."""
        return np.asarray(self.sensor_degrees.sum(axis=0) / self.runs)

    @property
    def nis(self) -> Array:
        """NIS per degree of freedom, mean over runs in each time bin (k,); 1 for a consistent filter, NaN without measurements."""
        return _divided(self.sensor_nis_sum.sum(axis=0), self.sensor_degrees.sum(axis=0))

    @property
    def mean_nis(self) -> float:
        """NIS per degree of freedom over the whole time and all runs; innovations are white, so no epochs are needed."""
        return float(_divided(self.sensor_nis_sum.sum(), self.sensor_degrees.sum()))

    @property
    def sensor_nis(self) -> Array:
        """NIS per degree of freedom of each sensor over the whole time and all runs (s,)."""
        return _divided(self.sensor_nis_sum.sum(axis=1), self.sensor_degrees.sum(axis=1))

    def nis_bounds(self, confidence_level: float = 0.99) -> tuple[float, float]:
        """Return two-sided bounds of :attr:`mean_nis` of a consistent filter.

        Parameters
        ----------
        confidence_level : float, default 0.99
            Probability that a consistent filter lies inside the bounds.

        Returns
        -------
        low, high : float
            Bounds per degree of freedom; a mean outside them rejects the filter.
        """
        return consistency.mean_bounds(1, int(self.sensor_degrees.sum()), confidence_level)

    @property
    def nis_interval_bounds(self) -> tuple[float, float]:
        """99 % bounds of :attr:`nis` of a consistent filter in a time bin with the median number of degrees of freedom."""
        return consistency.mean_bounds(1, round(float(np.median(self.nis_degrees[self.nis_degrees > 0]) * self.runs)))

    def verdict(self, epochs: NDArray[Any], subset: str = "state", confidence_level: float = 0.99) -> Verdict:
        """Return the two-sided χ² test of the ANEES at given epochs.

        The ANEES of an epoch at which some run was not finite is infinite: a filter that fails in a run is not consistent.

        Parameters
        ----------
        epochs : array of int
            Indices of epochs.
        subset : {"state", "attitude", "bias"}
        confidence_level : float, default 0.99
            Probability of the bounds at all epochs together.

        Returns
        -------
        Verdict
            ANEES per degree of freedom at each epoch, with its bounds.
        """
        column, degrees = SUBSETS[subset]
        mean = np.where(self.finite == self.runs, self.anees[:, column], np.inf)[epochs]
        return Verdict(mean=mean, degrees=degrees, runs=self.runs, confidence_level=confidence_level)

    def error_quantile(self, probability: float) -> Array:
        """Return a quantile of |e| at each epoch, from the histogram; its error is less than half a bin, 6 %.

        Parameters
        ----------
        probability : float
            Probability of the quantile, from 0 to 1.

        Returns
        -------
        ndarray (m, 6)
            Quantiles, rad and rad/s.
        """
        quantile = _quantile(self.histogram, probability, bin_edges())
        return np.asarray(np.where(np.isnan(self.mean_error), np.nan, quantile))


class Layout(NamedTuple):
    """Shape and type of an array of the statistics, with its description in files."""

    shape: tuple[Any, ...]
    """Lengths; those of :func:`lengths_of`, and of the worst and the example runs, by name."""
    meaning: str
    unit: str = "1"
    counts: bool = False
    """Whether it holds integers."""


_ERROR, _PRODUCT = "rad (columns 0-2), rad/s (columns 3-5)", "rad^2, rad^2/s, (rad/s)^2"
_RUNS = "runs by epoch, absolute error and bin; see bins_per_octave and first_error_exponent"
ARRAYS = {
    "time": Layout(("epochs",), "epochs", "s"),
    "finite": Layout(("epochs",), "runs whose error and covariance are finite numbers, by epoch", counts=True),
    "error_sum": Layout(("epochs", 6), "sum over runs of the error (dtheta, db)", _ERROR),
    "error_product_sum": Layout(("epochs", 6, 6), "sum over runs of error times its transpose", _PRODUCT),
    "covariance_sum": Layout(("epochs", 6, 6), "sum over runs of the filter's covariance", _PRODUCT),
    "nees_sum": Layout(
        ("epochs", 3), "sum over runs of the NEES of the state (6 degrees of freedom), the attitude (3), the bias (3)"
    ),
    "log_nees_sum": Layout(("epochs", 3), "sum over runs of the natural logarithm of the same"),
    "coverage": Layout(("epochs", 6, 3), "runs whose error lies inside 1, 2, 3 sigma, by epoch and state", counts=True),
    "histogram": Layout(("epochs", 6, BINS), _RUNS, counts=True),
    "nis_edges": Layout(("edges",), "edges of the spans of time of the NIS", "s"),
    "sensor_nis_sum": Layout(("sensors", "spans"), "sum over runs of the NIS, by sensor and span of time"),
    "sensor_degrees": Layout(("sensors", "spans"), "sum over runs of its degrees of freedom", counts=True),
    "sensor_refused": Layout(("sensors", "spans"), "measurements that the gate refused", counts=True),
    "worst_run": Layout(("worst",), "numbers of the worst runs", counts=True),
    "worst_score": Layout(("worst",), "their largest NEES of the state"),
    "example_run": Layout(("examples",), "numbers of the example runs", counts=True),
    "example_error": Layout(("examples", "epochs", 6), "errors of the example runs by epoch", _ERROR),
    "example_sigma": Layout(("examples", "epochs", 6), "the filter's standard deviations in the example runs", _ERROR),
}
"""Arrays of the statistics by name."""


def lengths_of(plan: Plan) -> dict[str, int]:
    """Return the lengths that a plan defines, by their names in :data:`ARRAYS`."""
    bins = plan.nis_bins
    return {"epochs": plan.epochs + 1, "edges": bins + 1, "spans": bins, "sensors": len(plan.sensors)}


def zeros(plan: Plan) -> dict[str, Any]:
    """Return the arrays of :class:`Statistics` whose shape a plan defines: times, and sums that are zero."""
    lengths = lengths_of(plan)
    sums = {
        name: np.zeros([lengths.get(n, n) for n in layout.shape], np.int64 if layout.counts else np.float64)
        for name, layout in ARRAYS.items()
        if not {"worst", "examples"} & set(layout.shape)
    }
    return {**sums, "time": plan.time, "nis_edges": plan.nis_edges, "sensors": plan.sensors}


def _anees(statistics: Statistics, epochs: Counts, subset: str, confidence_level: float, failed: int) -> Finding:
    verdict = statistics.verdict(epochs, subset, confidence_level)
    worst = int(np.argmax(np.abs(np.log(np.clip(verdict.mean, 1e-300, 1e300)))))
    value = float(verdict.mean[worst])
    return Finding(
        name="ANEES",
        of=subset,
        value=value,
        p_value=verdict.p_value,
        samples=statistics.runs,
        degrees=verdict.degrees,
        epochs=len(epochs),
        at=f"mean {figure(float(verdict.mean.mean()))}, worst at {statistics.time[epochs[worst]]:g} s",
        means=error_words(f"the {subset} error at its worst epoch", value)
        if failed == 0
        else f"{failed} of {counted(statistics.runs, 'run')} failed: the NEES of their {subset} is not finite",
    )


def _log_nees(statistics: Statistics, epochs: Counts, subset: str) -> Finding:
    runs, (column, degrees) = statistics.runs, SUBSETS[subset]
    means = statistics.log_nees_sum[epochs, column] / runs
    p = np.array([log_mean_p_value(float(mean), degrees, runs) for mean in means])
    worst = int(np.argmin(p))
    return Finding(
        name=LOG_NEES,
        of=subset,
        value=float(means[worst]),
        p_value=min(1.0, len(epochs) * float(p[worst])),
        samples=runs,
        degrees=degrees,
        epochs=len(epochs),
        at=f"worst at {statistics.time[epochs[worst]]:g} s",
        means=f"the mean of ln NEES of the {subset} at its worst epoch is {means[worst]:.4g}",
    )


def _mean_error(statistics: Statistics, epochs: Counts) -> Finding:
    """Return the finding on the mean error over the runs: Student's t, the worst of all epochs and states."""
    from scipy.special import stdtr

    runs, states = statistics.runs, 6 if statistics.has_bias else 3
    mean = statistics.error_sum[epochs, :states] / runs
    square = np.diagonal(statistics.error_product_sum[epochs], axis1=1, axis2=2)[:, :states] / runs
    t = np.abs(mean) / np.sqrt(np.maximum(square - mean**2, 1e-300) / (runs - 1))
    epoch, state = np.unravel_index(int(np.argmax(t)), t.shape)
    name = state_name(int(state))
    return Finding(
        name="mean error",
        of=name,
        value=float(t.max()),
        p_value=min(1.0, t.size * 2.0 * float(stdtr(runs - 1, -t.max()))),
        samples=runs,
        at=f"worst at {statistics.time[epochs[epoch]]:g} s",
        means=f"the mean {name} error over the runs is not zero ({t.max():.3g} times its standard error): it does not average out",
    )


def _run_coverage(statistics: Statistics, epochs: Counts) -> Finding:
    """Return the finding on the fraction of errors within 1, 2 and 3 σ, the worst of all epochs and states."""
    inside = statistics.coverage[epochs, : 6 if statistics.has_bias else 3] / statistics.runs
    p = coverage_p_values(inside, statistics.runs)
    worst = np.unravel_index(int(np.argmin(p)), p.shape)
    (epoch, state, k), value = map(int, worst), float(inside[worst])
    name = state_name(state)
    return Finding(
        name="coverage",
        of=name,
        value=value,
        p_value=min(1.0, p.size * float(p.min())),
        samples=statistics.runs,
        at=f"within {k + 1}σ, worst at {statistics.time[epochs[epoch]]:g} s",
        means=f"{100.0 * value:.3g} % of the {name} errors lie within {k + 1} σ at the worst epoch",
    )


def _odd_runs(statistics: Statistics) -> str:
    """Return the runs whose largest NEES no consistent filter has, by number and seed; empty if there are none.

    The p-value is Bonferroni's over all runs and epochs, by the χ² tail of the NEES, divided by the mean of the other runs at its worst
    epoch if that is above 1: where all σ are too small, or the tail is heavier because the filter is linearised, no single run is to blame.
    """
    from scipy.special import chdtrc

    column, degrees = SUBSETS[statistics.subsets[0]]
    known = np.isfinite(statistics.worst_score)
    score = statistics.worst_score[known]
    others = (statistics.nees_sum[:, column] - score[:, None]) / (degrees * np.maximum(statistics.finite - 1, 1))
    relative = score / others.max(axis=1, initial=1.0)
    odd = statistics.runs * len(statistics.time) * chdtrc(degrees, relative) < ODD
    runs = zip(statistics.worst_run[known][odd], score[odd], strict=True)
    names = ", ".join(f"run {run} (NEES {figure(float(value), 3)})" for run, value in runs)
    seed = "" if statistics.plan is None else f" of seed {statistics.plan.seed}"
    return f"{names}{seed} beyond all chance (p < {ODD:g} over all runs and epochs)" if names else ""


def _divided(total: Any, number: Any) -> Array:
    """Return total / number, NaN where the number is 0."""
    number = np.broadcast_to(np.asarray(number, np.float64), np.shape(total))
    return np.asarray(np.divide(total, number, out=np.full(np.shape(total), np.nan), where=number > 0.0))


def _quantile(histogram: Counts, probability: float, edges: Array) -> Array:
    """Return quantiles along the last axis, the counts evenly distributed over their bins; NaN if there are none."""
    if not 0.0 <= probability <= 1.0:
        raise InputError(f"probability is {probability}; it must lie between 0 and 1")
    before = np.concatenate([np.zeros((*histogram.shape[:-1], 1)), np.cumsum(histogram, axis=-1)], axis=-1)
    total = before[..., -1]
    wanted = probability * total
    # The bin in which the cumulative count reaches the wanted number: the first non-empty one.
    place = np.argmax((before[..., 1:] >= wanted[..., None]) & (histogram > 0), axis=-1)
    start = np.take_along_axis(before, place[..., None], axis=-1)[..., 0]
    held = np.take_along_axis(histogram, place[..., None], axis=-1)[..., 0]
    share = np.clip((wanted - start) / np.maximum(held, 1), 0.0, 1.0)
    value = edges[place] + share * (edges[place + 1] - edges[place])
    return np.asarray(np.where(total > 0, value, np.nan))


_SAME = ("time", "nis_edges", "sensors")
_WORST = ("worst_run", "worst_score")
_EXAMPLES = ("example_run", "example_error", "example_sigma")


def merge(a: Statistics, b: Statistics) -> Statistics:
    """Return the statistics of the runs of both. Sums are added, so the order of merging affects the last bits."""
    for name in _SAME:
        if not np.array_equal(getattr(a, name), getattr(b, name)):
            raise InputError(f"statistics of different {name} cannot be merged; they are of different plans")
    merged: dict[str, Any] = {name: getattr(a, name) for name in (*_SAME, "plan")}
    merged.update(zip(_WORST, worst(*(np.concatenate([getattr(a, n), getattr(b, n)]) for n in _WORST)), strict=True))
    first = np.argsort(np.concatenate([a.example_run, b.example_run]), kind="stable")[:EXAMPLES]
    merged.update({name: np.concatenate([getattr(a, name), getattr(b, name)])[first] for name in _EXAMPLES})
    for field in fields(Statistics):
        if field.name not in merged:
            merged[field.name] = getattr(a, field.name) + getattr(b, field.name)
    return Statistics(**merged)


def worst(run: Counts, score: Array) -> tuple[Counts, Array]:
    """Return the WORST runs and their scores, in descending order; equal scores in the order of the runs."""
    order = np.lexsort((run, -score))[:WORST]
    return run[order], score[order]
