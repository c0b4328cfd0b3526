"""Protection of a filter against wrong measurements: a gate with recovery, and robust updates.

:class:`Gate`
    A χ² test of each measurement, with as many degrees of freedom as it has. If the filter itself is wrong, it would refuse good
    measurements for ever. So the first refusal starts a *restart candidate* in parallel, which replaces the filter if the refused
    measurements agree with each other.
:class:`Robust`
    Updates that reduce the weight of a measurement with a large innovation, for noise with heavier tails than the normal distribution.

They are options of :func:`strapdown.estimation.run`, of :class:`strapdown.estimation.LiveFilter` and of the other estimators there.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Literal

import numpy as np

from strapdown.checks import Array, count, fraction, half_turn, one_of, positive
from strapdown.kernels.gate_rules import UNIFORM_SIGMA

LOCK_OUT = 10
"""Default limit, without recovery: a lock-out is reported if the refusals of a sensor exceed its acceptances by more than this."""


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Refuse measurements whose NIS is improbable, and recover if the filter itself is wrong and refuses good ones.

    The first refusal starts a restart candidate from the filter's state with the uncertainty of a new start: attitude independent of the
    bias with ``restart_attitude_sigma``, bias variance increased by that of ``restart_bias_sigma``, and error states at their prior,
    independent of both, because the cause of the error may have corrupted them too. It processes all measurements that follow, and is
    dropped as soon as no sensor is refused any more. When one sensor has been refused ``recovery`` times in a row and the candidate has
    accepted as many of the refused measurements, these agree with each other and not with the filter: the candidate replaces the filter,
    and the estimate contains an event ``"recovery"``.

    A candidate fails if it refuses three measurements in a row, or more than 1 + half of those that it accepts; the next starts with
    three times the σ. Its σ is increased during its run by the same factor, as if it had started with it, if its bias moves far from its
    start (the sum of squares over the initial variances exceeds the median of χ²₃) or if the sum of its accepted NIS exceeds the degrees
    of freedom by more than three standard deviations. A recovery increases the σ of the next candidate too. The attitude's σ is limited to
    that of a uniform angle, the bias's to 3⁷ times the first; after that, or when the filter has accepted ``5 recovery`` measurements, σ
    is that of the first candidate again. The process noise does not change. The rotation between two measurements that results from such
    an unknown bias must stay well below one radian.

    With and without recovery, the estimate contains an event of kind ``"lock-out"`` for each interval in which the refusals of a sensor
    exceed its acceptances by more than ``recovery`` (ten without recovery); a recovery within twice that number is reported instead.

    Parameters
    ----------
    probability : float, default 0.999
        Probability that a measurement is accepted if the filter is consistent: the threshold is this quantile of χ²,
        with as many degrees of freedom as the measurement has.
    recovery : int or None, default 10
        Refusals of one sensor in a row that lead to recovery; None: no recovery.
    restart_attitude_sigma : float, default π/√3
        Standard deviation of a restart candidate's initial attitude error, rad, per axis; the default is that of an
        unknown angle, uniform over a full rotation.
    restart_bias_sigma : float, optional
        Standard deviation added to that of the first restart candidate's bias error, rad/s, per axis. Default: that of the
        initial state (for a record filtered in parts, of the initial state of the first part).
    """

    probability: float = 0.999
    recovery: int | None = 10
    restart_attitude_sigma: float = UNIFORM_SIGMA
    restart_bias_sigma: float | None = None

    def __post_init__(self) -> None:
        """Check every field."""
        fraction("gate: probability", self.probability)
        if self.recovery is not None:
            count("gate: recovery", self.recovery, minimum=2)
        name = "gate: restart_attitude_sigma"
        half_turn(name, positive(name, self.restart_attitude_sigma, unit="rad"))
        if self.restart_bias_sigma is not None:
            positive("gate: restart_bias_sigma", self.restart_bias_sigma, unit="rad/s")

    @property
    def thresholds(self) -> Array:
        """Maximum accepted NIS for one, two and three degrees of freedom (3,)."""
        from scipy.special import chdtri

        return np.asarray(chdtri([1.0, 2.0, 3.0], 1.0 - self.probability))

    def ungated(self, white: Array) -> Array:
        """Return accepted innovations stretched to their length without the gate: of a consistent filter, standard normal again.

        The NIS of accepted ones is χ² below the threshold; that of the result is at the same fraction of the whole distribution.

        Parameters
        ----------
        white : ndarray (m, n)
            Accepted innovations over their standard deviations.

        Returns
        -------
        ndarray (m, n)
            By which a verdict judges a filter with this gate.
        """
        from scipy.special import chdtr, chdtri

        degrees, nis = white.shape[1], np.maximum(np.sum(white**2, axis=1), np.finfo(float).tiny)
        beyond = 1.0 - np.minimum(chdtr(degrees, nis) / self.probability, 1.0 - 1e-9)  # also of one used to recover
        return np.asarray(white * np.sqrt(chdtri(degrees, beyond) / nis)[:, None])

    @property
    def lock_out_limit(self) -> int:
        """Difference of refusals and acceptances of a sensor above which a lock-out is reported."""
        return self.recovery or LOCK_OUT


@dataclass(frozen=True, kw_only=True)
class Robust:
    """Weight each measurement by its residual after the update: its covariance is divided by the weight.

    With r the residual *after* the update and R the measurement's covariance, the weight is found by iteration (IRLS):

    - ``"huber"``: w = min(1, k/√(rᵀR⁻¹r)), k² the quantile ``probability`` of χ² (Huber 1964);
    - ``"student"``: w = (ν + d)/(cν + rᵀR⁻¹r + tr R⁻¹HP⁺Hᵀ), the variational update for noise of Student's t with ν
      ``degrees_of_freedom`` and scale cR, d the number of rows (Agamennoni, Nieto & Nebot 2012); c is chosen so that the covariance is
      right to first order if the noise is in fact normal with covariance R (:func:`student_scale`).

    In normal noise both lose a few per cent of accuracy. In contaminated noise their covariance is somewhat too small, because an outlier
    with little weight still has some effect: tests/test_robustness.py has the figures.

    Parameters
    ----------
    kind : {"student", "huber"}, default "student"
        Weight function.
    probability : float, default 0.82
        Huber: fraction of normal measurements that keep full weight; 0.82 is the usual 1.345 σ of one degree of
        freedom.
    degrees_of_freedom : float, default 4.0
        Student: ν; smaller values mean heavier tails.
    iterations : int, default 5
        Number of iterations.
    """

    kind: Literal["huber", "student"] = "student"
    probability: float = 0.82
    degrees_of_freedom: float = 4.0
    iterations: int = 5

    def __post_init__(self) -> None:
        """Check every field."""
        one_of("robust: kind", self.kind, ("huber", "student"))
        fraction("robust: probability", self.probability)
        positive("robust: degrees_of_freedom", self.degrees_of_freedom)
        count("robust: iterations", self.iterations)

    @property
    def parameters(self) -> Array:
        """Constants of the weight's formula for one, two and three degrees of freedom (3, 2): Huber k², 0; Student cν, ν + d."""
        from scipy.special import chdtri

        d = np.array([1.0, 2.0, 3.0])
        if self.kind == "student":
            nu = self.degrees_of_freedom
            return np.stack([[student_scale(nu, k) * nu for k in (1, 2, 3)], nu + d], axis=1)
        return np.stack([chdtri(d, 1.0 - self.probability), np.zeros(3)], axis=1)


@functools.cache
def student_scale(degrees_of_freedom: float, rows: int) -> float:
    """Return the scale c of Student's t for which a filter is consistent in normal noise of unit variance and ``rows`` components.

    With ψ = w(r²) r, the estimate's variance is ``(E w²r²/d) / (E w + 2 r² w′/d)²`` over the number of measurements, and the filter's own
    ``1/E w`` (Huber 1981, section 6.3); c makes them equal.
    """
    from scipy.optimize import brentq
    from scipy.special import chdtri

    nu, d = degrees_of_freedom, float(rows)
    levels = (np.arange(4000) + 0.5) / 4000.0
    squared = chdtri(d, levels)

    def excess(c: float) -> float:
        w = (nu + d) / (c * nu + squared)
        slope = -w / (c * nu + squared)
        actual = np.mean(w * w * squared) / d / np.mean(w + 2.0 * squared * slope / d) ** 2
        return float(np.mean(w) * actual - 1.0)

    return float(brentq(excess, 0.2, 10.0, xtol=1e-12))
