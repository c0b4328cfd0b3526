"""Likely causes of an inconsistent filter, from the innovations of one record: a ranked table of evidence.

Each hypothesis is a change of the record or of the filter's model with a few unknown numbers θ: the noise of a sensor by a factor, the
stamps of a sensor by an offset, a magnetometer's hard iron, … The innovations of a consistent filter are independent and normal, so the
likelihood of the record is ``−½ Σ (ln s + z²)`` over its whitened innovations z with variances s (Schweppe 1965). For every hypothesis the
filter is run again and the θ of the largest likelihood found: by Gauss–Newton on the innovations, whose derivatives are differences of
filter runs, where θ shifts them, and by a parabola where it scales them. Twice the gain in log-likelihood is χ² with as many degrees of
freedom as θ has numbers if the filter is consistent (Wilks 1938; Willsky & Jones 1976). Causes are ranked by that probability; so each one
is named with its size, and a cause that only looks alike explains less. Where two explain the same (of two directions, which reference is
off) both are named.

Commutation error is the exception: to the innovations it *is* a gyro bias, which the filter estimates. It is computed from the increments
themselves, by a better integration algorithm, and held against the filter's own σ of the bias, and against the truth if there is one.

- ``diagnosing``: :func:`diagnose`.
- ``causes``: What it returns.
- ``hypotheses``, ``commutation``: What may be wrong.
- ``turning``: What a gyro's scale factor, misalignment and mounting act on.
- ``likelihood``: How well a hypothesis explains the record.
"""

from strapdown.tuning.diagnosis.causes import Cause, Diagnosis
from strapdown.tuning.diagnosis.commutation import commutation_drift as commutation_drift
from strapdown.tuning.diagnosis.diagnosing import diagnose

__all__ = [
    "Cause",
    "Diagnosis",
    "diagnose",
]
