"""Outliers in the measurements, and the gate that suits them, by maximum likelihood.

A gate's threshold cannot be tuned by the likelihood of what passes it: the narrower the gate, the likelier what is left. So outliers are
modelled: with probability ε (``outliers.share``) the noise of a measurement is κ times as large (``outliers.scale``; Tukey's contaminated
normal, 1960). Each innovation is then a mixture of two normals, and share and scale are estimated with the filter's other parameters, which
so no longer answer for the outliers. The filter of this likelihood makes each update both ways and goes on with mean and covariance of the
mixture (:mod:`strapdown.kernels.likelihood_outliers`). Share and scale are those of all sensors together. The noise of an
angular acceleration, at a lever arm, is taken to be larger with that of the accelerometer.

The gate refuses where an outlier has become the likelier explanation (Bayes): with d rows and κ′ the ratio of σ of the innovations,

    NIS > 2 (ln((1 − ε)/ε) + d ln κ′)/(1 − 1/κ′²).

The information is the sum of the outer products of each measurement's gradient (Berndt, Hall, Hall & Hausman 1974).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from strapdown.checks import Array, InputError, positive
from strapdown.estimation.gating import Gate
from strapdown.estimation.setup import FilterSetup
from strapdown.tuning.fitting import Estimated, Tuning
from strapdown.tuning.innovations import Likelihood, likelihood
from strapdown.tuning.objective import OUTLIERS, SCALES, SHARES, Case
from strapdown.tuning.parameters import OUTLIER_SCALE, OUTLIER_SHARE
from strapdown.vectors import KINDS

SHARE, SCALE = 0.02, 5.0
"""Where the search for share and scale starts."""
MAX_REFUSED = 0.25
"""A share above which what is called outliers is a second size of the noise, and nothing to refuse."""
MIN_REFUSED = 1e-9
"""Share of right measurements that any gate refuses."""


def contaminated_likelihood(
    cases: Sequence[Case],
    chosen: FilterSetup,
    free: Sequence[str],
    *,
    share: float = SHARE,
    scale: float = SCALE,
    threads: int = 1,
) -> Likelihood:
    """Return the likelihood of the free parameters, and of the outliers' share and scale, which are always free."""
    for name, value, (least, most) in (("share", share, SHARES), ("scale", scale, SCALES)):
        if not least <= positive(name, value) <= most:
            raise InputError(f"{name} of the outliers is {value:g}; it must lie between {least:g} and {most:g}")
    base = likelihood(cases, chosen, free, threads=threads)
    return replace(base, names=(*base.names, *OUTLIERS), start=np.concatenate([base.start, np.log([share, scale])]))


@dataclass(frozen=True, kw_only=True, eq=False)
class TunedGate:
    """The gate that suits the outliers of the records."""

    gate: Gate | None
    """None where the records show no outliers, or so many that they are noise: then there is nothing to refuse."""
    probability: float
    """That a right measurement passes; NaN where there is no gate, and so its interval."""
    lower: float
    """Lower end of its 95 % interval."""
    upper: float
    """Upper end."""
    thresholds: dict[str, float]
    """The NIS from which on an outlier is likelier, by sensor; the filter has one probability for all, the mean over measurements."""
    share: Estimated
    scale: Estimated


def tuned_gate(objective: Likelihood, tuning: Tuning, *, draws: int = 2000) -> TunedGate:
    """Return the gate at the Bayes threshold, its interval from that of share and scale."""
    share, scale = tuning[OUTLIER_SHARE], tuning[OUTLIER_SCALE]
    seen = _seen(objective, tuning.point[:-2])
    best, thresholds = _probability(seen, np.array([[share.value, scale.value]]))
    chosen = {name: float(value[0]) for name, value in thresholds.items()}
    if not share.identified or share.value > MAX_REFUSED:
        return TunedGate(
            gate=None, probability=math.nan, lower=math.nan, upper=math.nan, thresholds={}, share=share, scale=scale
        )
    # Errors by the sandwich where the tuning took those.
    swollen = np.array([one.standard_error for one in (share, scale)]) / np.sqrt(np.diag(tuning.covariance)[-2:])
    covariance = tuning.covariance[-2:, -2:] * swollen[:, None] * swollen
    normal = np.random.default_rng(0).standard_normal((draws, 2)) @ np.linalg.cholesky(covariance).T
    tried = np.exp(np.log([share.value, scale.value]) + normal)
    tried = np.column_stack([np.minimum(tried[:, 0], SHARES[1]), np.maximum(tried[:, 1], 1.01)])
    lower, upper = np.quantile(_probability(seen, tried)[0], [0.025, 0.975])
    return TunedGate(
        gate=replace(tuning.setup.gate or Gate(), probability=float(best[0])),
        probability=float(best[0]),
        lower=float(lower),
        upper=float(upper),
        thresholds=chosen,
        share=share,
        scale=scale,
    )


def log_likelihood(cases: Sequence[Case], tuned: Likelihood, result: Tuning) -> float:
    """Return the log likelihood of cases under the tuned filter and its outliers, in nats an innovation, as on data held out."""
    share, scale = result[OUTLIER_SHARE].value, result[OUTLIER_SCALE].value
    other = contaminated_likelihood(
        cases,
        result.setup,
        tuned.names[:-2],
        share=float(np.clip(share, *SHARES)),
        scale=float(np.clip(scale, *SCALES)),
    )
    number = sum(one.degrees * one.number for one in _seen(other, other.start[:-2]).values())
    return float(-other.minus_log(other.start)[0] / number - 0.5 * np.log(2.0 * np.pi))


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """How one sensor's measurements look to the filter."""

    degrees: int
    number: int
    noise: float
    """Mean share of the measurement's own noise in the variance of its innovation."""


def _seen(objective: Likelihood, point: Array) -> dict[str, _Seen]:
    none = np.concatenate([point, [-np.inf, 0.0]])
    shares: dict[str, list[float]] = {}
    for name, rows in objective.judged(none):
        shares.setdefault(name, []).extend(rows[:, 1])
    kinds = {series.sensor: KINDS[series.kind] for case in objective.cases for series in case.record.vectors}
    return {
        name: _Seen(degrees=kinds[name], number=len(own), noise=float(np.mean(own)))
        for name, own in shares.items()
        if own
    }


def _probability(seen: dict[str, _Seen], tried: Array) -> tuple[Array, dict[str, Array]]:
    """Return for each share and scale (k, 2) the probability that a right measurement passes, and the thresholds of the sensors."""
    from scipy.special import chdtrc

    share, scale = tried.T
    thresholds, refused, total = {}, np.zeros(len(tried)), 0
    for name, one in seen.items():
        wider = 1.0 + (scale**2 - 1.0) * one.noise
        odds = np.log1p(-share) - np.log(share) + 0.5 * one.degrees * np.log(wider)
        thresholds[name] = np.maximum(2.0 * odds / (1.0 - 1.0 / wider), 0.0)
        refused += one.number * np.log(np.maximum(chdtrc(one.degrees, thresholds[name]), MIN_REFUSED))
        total += one.number
    return 1.0 - np.exp(refused / total), thresholds
