"""Outliers in the measurements, and the gate for them, by maximum likelihood.

The threshold of a gate cannot be tuned by the likelihood of the accepted measurements, which increases as the gate becomes narrower.
Outliers are therefore modelled: with probability ε (``outliers.share``) the noise of a measurement is larger by the factor κ
(``outliers.scale``; Tukey's contaminated normal, 1960). The distribution of each innovation is a mixture of two normals, and share and
scale are estimated together with the other parameters, which are then not biased by the outliers. The filter of this likelihood makes each
update with both noises and continues with mean and covariance of the mixture (:mod:`strapdown.kernels.likelihood_outliers`). Share and
scale are common to all sensors. With a lever arm, the noise of the angular acceleration is scaled like that of the accelerometer.

The gate refuses a measurement if it is more likely to be an outlier (Bayes): with d rows and κ′ the ratio of σ of the innovations,

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
from strapdown.tuning.innovations import Likelihood, likelihood
from strapdown.tuning.objective import OUTLIERS, SCALES, SHARES, Case
from strapdown.tuning.parameters import OUTLIER_SCALE, OUTLIER_SHARE
from strapdown.tuning.result import Estimated, Tuning
from strapdown.vectors import KINDS

GATED = ("gate.probability", *OUTLIERS)
"""Names of parameters that need a model of outliers."""
SHARE, SCALE = 0.02, 5.0
"""Initial share and scale of the search."""
MAX_REFUSED = 0.25
"""Maximum share of outliers; above it they are a second noise level, and no gate is set."""
DRAWS = 2000
"""Number of draws of share and scale for the interval of the probability."""
MIN_REFUSED = 1e-9
"""Minimum share of valid measurements that a gate refuses."""


def contaminated_likelihood(
    cases: Sequence[Case],
    setup: FilterSetup,
    free: Sequence[str],
    *,
    share: float = SHARE,
    scale: float = SCALE,
    threads: int = 1,
) -> Likelihood:
    """Return the likelihood of the free parameters and of share and scale of the outliers, which are always free."""
    for name, value, (least, most) in (("share", share, SHARES), ("scale", scale, SCALES)):
        if not least <= positive(name, value) <= most:
            raise InputError(f"{name} of the outliers is {value:g}; it must lie between {least:g} and {most:g}")
    base = likelihood(cases, setup, free, threads=threads)
    return replace(base, names=(*base.names, *OUTLIERS), start=np.concatenate([base.start, np.log([share, scale])]))


@dataclass(frozen=True, kw_only=True, eq=False)
class TunedGate:
    """The gate for the outliers of the records."""

    gate: Gate | None
    """None if the records have no outliers, or more than :data:`MAX_REFUSED`."""
    probability: float
    """Probability that a valid measurement is accepted; it and its interval are NaN without a gate."""
    lower: float
    """Lower end of its 95 % interval."""
    upper: float
    """Upper end."""
    thresholds: dict[str, float]
    """NIS above which an outlier is more likely, by sensor; the filter has one probability for all, the mean over measurements."""
    share: Estimated
    """Fraction of the measurements that are outliers."""

    @property
    def words(self) -> str:
        """The gate in a sentence, or why there is none."""
        if self.gate is None:
            why = "no outliers" if not self.share.identified else "noise of two sizes rather than outliers"
            return f"The records show {why}; the filter's gate is unchanged."
        thresholds = ", ".join(f"{value:.1f} of {name}" for name, value in self.thresholds.items())
        refused, least, most = (100.0 * (1.0 - p) for p in (self.probability, self.upper, self.lower))
        return (
            f"A measurement with a NIS above {thresholds} is more likely an outlier than noise. The gate rejects "
            f"{refused:.2g} % of valid measurements (95 %: {least:.2g} to {most:.2g})."
        )


def tuned_gate(tuning: Tuning) -> TunedGate:
    """Return the gate at the Bayes threshold, with its interval from those of share and scale."""
    share, scale = tuning[OUTLIER_SHARE], tuning[OUTLIER_SCALE]
    if not share.identified or share.value > MAX_REFUSED:
        nan = math.nan
        return TunedGate(gate=None, probability=nan, lower=nan, upper=nan, thresholds={}, share=share)
    assert isinstance(tuning.objective, Likelihood)
    sensors = _noise_by_sensor(tuning.objective, tuning.point[:-2])
    best, thresholds = _probability(sensors, np.array([[share.value, scale.value]]))
    normal = np.random.default_rng(0).standard_normal((DRAWS, 2)) @ np.linalg.cholesky(tuning.covariance[-2:, -2:]).T
    drawn = np.exp(np.log([share.value, scale.value]) + normal)
    drawn = np.column_stack([np.minimum(drawn[:, 0], SHARES[1]), np.maximum(drawn[:, 1], 1.01)])
    lower, upper = np.quantile(_probability(sensors, drawn)[0], [0.025, 0.975])
    return TunedGate(
        gate=replace(tuning.setup.gate or Gate(), probability=float(best[0])),
        probability=float(best[0]),
        lower=float(lower),
        upper=float(upper),
        thresholds={name: float(value[0]) for name, value in thresholds.items()},
        share=share,
    )


def log_likelihood(cases: Sequence[Case], tuning: Tuning) -> float:
    """Return the log likelihood of cases, such as held-out ones, under the tuned filter and its outliers, in nats per innovation."""
    share, scale = np.clip(np.exp(tuning.point[-2:]), *np.transpose([SHARES, SCALES])).tolist()
    held = contaminated_likelihood(cases, tuning.setup, tuning.objective.names[:-2], share=share, scale=scale)
    number = sum(sensor.degrees * sensor.number for sensor in _noise_by_sensor(held, held.start[:-2]).values())
    return float(-held.minus_log(held.start)[0] / number - 0.5 * np.log(2.0 * np.pi))


@dataclass(frozen=True, kw_only=True)
class _SensorNoise:
    """Measurements of one sensor, as processed by the filter."""

    degrees: int
    number: int
    noise: float
    """Mean ratio of measurement noise to innovation variance."""


def _noise_by_sensor(objective: Likelihood, point: Array) -> dict[str, _SensorNoise]:
    none = np.concatenate([point, [-np.inf, 0.0]])
    shares: dict[str, list[float]] = {}
    for name, rows in objective.outliers(none):
        shares.setdefault(name, []).extend(rows[:, 1])
    kinds = {series.sensor: KINDS[series.kind] for case in objective.cases for series in case.record.vectors}
    return {
        name: _SensorNoise(degrees=kinds[name], number=len(own), noise=float(np.mean(own)))
        for name, own in shares.items()
        if own
    }


def _probability(sensors: dict[str, _SensorNoise], tried: Array) -> tuple[Array, dict[str, Array]]:
    """Return the probability that a valid measurement is accepted, and the thresholds of the sensors, for each share and scale (k, 2)."""
    from scipy.special import chdtrc

    share, scale = tried.T
    thresholds, refused, total = {}, np.zeros(len(tried)), 0
    for name, sensor in sensors.items():
        wider = 1.0 + (scale**2 - 1.0) * sensor.noise
        odds = np.log1p(-share) - np.log(share) + 0.5 * sensor.degrees * np.log(wider)
        thresholds[name] = np.maximum(2.0 * odds / (1.0 - 1.0 / wider), 0.0)
        refused += sensor.number * np.log(np.maximum(chdtrc(sensor.degrees, thresholds[name]), MIN_REFUSED))
        total += sensor.number
    return 1.0 - np.exp(refused / total), thresholds
