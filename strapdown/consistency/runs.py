"""The verdict on independent runs, from the sums over them that a Monte Carlo keeps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from strapdown.consistency.bounds import coverage_p_values, log_mean_p_value, tail
from strapdown.consistency.judgement import (
    LOG_NEES,
    STATES,
    Finding,
    Judgement,
    concluded,
    error_words,
    innovation_words,
    ratio,
    state_name,
)
from strapdown.consistency.manifold import SUBSETS

if TYPE_CHECKING:
    from strapdown.montecarlo import Statistics


EPOCHS = 20
"""Epochs at which a Monte Carlo is judged: more of them cost power, because their errors are correlated and are taken as if not."""


def judge_runs(
    statistics: Statistics,
    *,
    epochs: Iterable[int] | None = None,
    probability: float = 0.99,
    unmodelled: Sequence[str] = (),
) -> Judgement:
    """Return the verdict on independent runs.

    Parameters
    ----------
    statistics : Statistics
        Sums over runs, of :mod:`strapdown.montecarlo`.
    epochs : iterable of int, optional
        Indices of the epochs at which errors are judged. Default: 20 evenly spaced ones; the first, where all is prior, is left out.
    probability : float, default 0.99
        A consistent filter is rejected with at most 1 − ``probability``, all tests together.
    unmodelled : sequence of str, default empty
        Errors that are specified and that the filter has no state for; the verdict names them.

    Returns
    -------
    Judgement
        "consistent" only where the runs would have shown a σ of attitude or bias wrong by :data:`.judgement.RESOLUTION`.
    """
    tail(probability)
    last = len(statistics.finite) - 1
    chosen = (
        np.unique(np.linspace(max(1, last // EPOCHS), last, min(EPOCHS, last)).astype(int))
        if epochs is None
        else np.array(list(epochs), int)
    )
    runs = statistics.runs
    failed = int(runs - np.min(statistics.finite[chosen]))
    findings = []
    for column, (subset, states) in enumerate(SUBSETS.items()):
        if subset not in statistics.subsets:
            continue
        verdict = statistics.verdict(chosen, subset, probability)
        extreme = np.abs(np.log(np.clip(verdict.mean, 1e-300, 1e300)))
        worst = int(np.argmax(extreme))
        value = float(verdict.mean[worst])
        findings.append(
            Finding(
                name="ANEES",
                of=subset,
                value=value,
                p_value=verdict.p_value,
                samples=runs,
                degrees=len(states),
                epochs=len(chosen),
                at=_at(statistics, chosen, worst),
                means=error_words(f"the {subset} error at its worst epoch", value)
                if failed == 0
                else f"{failed} of {runs} runs failed: their {subset} error or covariance is not finite",
            )
        )
        if failed == 0:
            findings.append(_log_nees(statistics, chosen, column, subset))
    if failed == 0 and runs >= 3:
        findings += [_mean_error(statistics, chosen), _run_coverage(statistics, chosen)]
    for row, sensor in enumerate(statistics.sensors):
        degrees = float(np.sum(statistics.sensor_degrees[row]))
        if degrees < 1.0:
            continue
        mean = float(np.sum(statistics.sensor_nis_sum[row]) / degrees)
        findings.append(ratio("NIS", sensor, mean, 1, degrees, innovation_words(sensor, mean)))
    tested = [name for name in STATES if name in statistics.subsets]
    return concluded(findings, [], probability, states=tested, needed=tested, unmodelled=unmodelled)


def _at(statistics: Statistics, epochs: np.ndarray, worst: int) -> str:
    return f"worst of {len(epochs)} epochs ({statistics.time[epochs[worst]]:g} s)"


def _log_nees(statistics: Statistics, epochs: np.ndarray, column: int, subset: str) -> Finding:
    runs, degrees = statistics.runs, len(SUBSETS[subset])
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
        at=_at(statistics, epochs, worst),
        means=f"the mean of ln NEES of the {subset} at its worst epoch is {means[worst]:.4g}",
    )


def _estimated(statistics: Statistics) -> slice:
    """Return the states that are estimated: all, or those of the attitude."""
    return slice(None) if "bias" in statistics.subsets else slice(3)


def _mean_error(statistics: Statistics, epochs: np.ndarray) -> Finding:
    """Return whether any state's mean error over the runs is other than zero: Student's t, the worst of all epochs and states."""
    from scipy.special import stdtr

    runs = statistics.runs
    estimated = _estimated(statistics)
    mean = statistics.error_sum[epochs][:, estimated] / runs
    square = np.diagonal(statistics.error_product_sum[epochs], axis1=1, axis2=2)[:, estimated] / runs
    t = np.abs(mean) / np.sqrt(np.maximum(square - mean**2, 1e-300) / (runs - 1))
    name = state_name(int(np.argmax(t.max(axis=0))))
    return Finding(
        name="mean error",
        of=name,
        value=float(t.max()),
        p_value=min(1.0, t.size * 2.0 * float(stdtr(runs - 1, -t.max()))),
        samples=runs,
        means=f"the mean {name} error over the runs is not zero ({t.max():.3g} of its standard errors): it does not average out",
    )


def _run_coverage(statistics: Statistics, epochs: np.ndarray) -> Finding:
    """Return whether the errors of any state lie within 1, 2 or 3 σ too often or too seldom, the worst of all epochs and states."""
    inside = statistics.coverage[epochs][:, _estimated(statistics)] / statistics.runs
    p = coverage_p_values(inside, statistics.runs)
    _, state, k = np.unravel_index(int(np.argmin(p)), p.shape)
    name = state_name(int(state))
    value = float(inside.reshape(-1)[int(np.argmin(p))])
    return Finding(
        name="coverage",
        of=name,
        value=value,
        p_value=min(1.0, p.size * float(p.min())),
        samples=statistics.runs,
        means=f"{100.0 * value:.3g} % of the {name} errors lie within {int(k) + 1} σ at the worst epoch",
    )
