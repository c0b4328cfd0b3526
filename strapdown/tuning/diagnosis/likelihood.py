"""The likelihood of a record under a hypothesis, and its maximum-likelihood parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from strapdown import estimation
from strapdown.checks import Array, are_finite
from strapdown.estimation.states import ProcessNoise
from strapdown.records import ImuRecord
from strapdown.tuning.diagnosis.causes import Cause
from strapdown.vectors import VectorMeasurements


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A record with the filter's model, the input of a run."""

    record: ImuRecord
    noise: ProcessNoise
    initial: estimation.State

    def with_series(self, sensor: str, change: Callable[[VectorMeasurements], VectorMeasurements]) -> Model:
        """Return the model with one sensor's series changed."""
        vectors = tuple(change(series) if series.sensor == sensor else series for series in self.record.vectors)
        return replace(self, record=replace(self.record, vectors=vectors))

    def with_increments(self, increments: Array) -> Model:
        """Return the model with other increments of the gyro."""
        return replace(self, record=replace(self.record, increments=increments))


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """Innovations of one run in the order of the record's measurements; NaN for those not used."""

    white: Array
    log_variance: Array

    def gain_over(self, other: Run) -> float:
        """Twice the gain in log-likelihood over another run, on the measurements that both used."""
        own, theirs = self.white**2 + self.log_variance, other.white**2 + other.log_variance
        return float(np.nansum(theirs - own))

    def closer_than(self, other: Run) -> float:
        """The same without the variances, for changes that shift innovations: rescaling the data must not count as a gain."""
        return float(np.nansum(other.white**2 - self.white**2))


def run(model: Model) -> Run:
    """Return the innovations of a model's filter."""
    estimate = estimation.run(model.record, model.noise, model.initial, every=len(model.record.increments))
    white, log_variance = [], []
    for series in model.record.vectors:
        innovations = estimate.innovations[series.sensor]
        content = series.vector_b if series.attitude is None else series.attitude
        used = (series.time >= model.record.time[0]) & (series.time <= model.record.time[-1])
        used &= are_finite(content)
        rows = np.full((2, len(series.time), innovations.innovation.shape[1]), np.nan)
        rows[:, used] = innovations.whitened, np.log(innovations.variance)
        white.append(rows[0].ravel())
        log_variance.append(rows[1].ravel())
    return Run(white=np.concatenate(white), log_variance=np.concatenate(log_variance))


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A family of models with parameters θ, where θ = 0 is the filter unchanged."""

    name: str
    of: str
    unit: str
    steps: Array
    """Steps of θ for finite differences (k,)."""
    limit: float
    """Maximum |θ|."""
    apply: Callable[[Model, Array], Model]
    words: Callable[[Array, Array], str]
    """Description for θ and its standard error."""
    plausible: float | None = None
    """Prior standard deviation of θ; None: a third of the limit."""

    def cause(self, theta: Array, spread: Array, gain: float) -> Cause:
        """Return the hypothesis with its best-fitting θ."""
        return Cause(
            name=self.name,
            of=self.of,
            estimate=theta,
            standard_error=spread,
            unit=self.unit,
            gain=gain,
            log_p=log_p(gain, len(theta)),
            words=self.words(theta, spread),
        )


def log_p(gain: float, degrees: int) -> float:
    """Return the natural logarithm of the upper tail of χ²."""
    from scipy.stats import chi2

    if gain <= 0.0 or not math.isfinite(gain):
        return 0.0
    if gain > 1e3:  # leading terms of the tail, because the function underflows
        half = 0.5 * gain
        return -half + (0.5 * degrees - 1.0) * math.log(half) - math.lgamma(0.5 * degrees)
    return float(chi2.logsf(gain, degrees))


def by_mean(model: Model, base: Run, hypothesis: Hypothesis) -> Cause:
    """Return the maximum-likelihood θ by Gauss–Newton on the whitened innovations."""
    k = len(hypothesis.steps)
    prior = (hypothesis.plausible or hypothesis.limit / 3.0) ** -2  # holds weakly observable components near zero
    theta, current, gain = np.zeros(k), base, 0.0
    spread = np.full(k, np.nan)
    for iteration in range(4):
        columns = []
        for j, step in enumerate(hypothesis.steps):
            shifted = run(hypothesis.apply(model, theta + step * np.eye(k)[j]))
            columns.append((shifted.white - current.white) / step)
        J = np.stack(columns, axis=1)
        common = are_finite(J) & np.isfinite(current.white)
        J, z = J[common], current.white[common]
        information = J.T @ J + np.eye(k) * prior
        move = -np.linalg.solve(information, J.T @ z + prior * theta)
        if iteration == 0:
            spread = np.sqrt(np.diag(np.linalg.inv(information)))
        promised = float(move @ information @ move)
        for _ in range(5):
            there = np.clip(theta + move, -hypothesis.limit, hypothesis.limit)
            trial = run(hypothesis.apply(model, there))
            better = trial.closer_than(base)
            if better > gain or promised < 4.0:
                break
            move = 0.4 * move
        rise = better - gain
        if rise <= 0.0:
            break
        theta, current, gain = there, trial, better
        if rise < 0.5 or gain < 3.0:
            break
    return hypothesis.cause(theta, spread, gain)


def by_variance(model: Model, base: Run, hypothesis: Hypothesis) -> Cause:
    """Return the maximum-likelihood factor by parabolas through three points."""
    step = float(hypothesis.steps[0])
    known: dict[float, float] = {0.0: 0.0}

    def gain(x: float) -> float:
        if x not in known:
            known[x] = run(hypothesis.apply(model, np.array([x]))).gain_over(base)
        return known[x]

    x, spread = 0.0, math.nan
    for _ in range(12):
        low, middle, high = gain(x - step), gain(x), gain(x + step)
        slope, curvature = (high - low) / (2.0 * step), (high - 2.0 * middle + low) / step**2
        move = math.copysign(1.0, slope)
        if curvature < 0.0:
            spread = math.sqrt(-2.0 / curvature)
            move = min(max(-slope / curvature, -1.0), 1.0)
        if abs(move) < 0.3 * (spread if math.isfinite(spread) else 0.1) or abs(x + move) > hypothesis.limit:
            break
        x += move
    x = max(known, key=lambda point: known[point])
    cause = hypothesis.cause(np.array([x]), np.array([spread]), known[x])
    return replace(cause, name=f"{hypothesis.name} too {'small' if x > 0.0 else 'large'}")
