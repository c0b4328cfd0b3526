"""Likely causes of an inconsistent filter, from the innovations of one record: a ranked table of evidence.

Each hypothesis is a change of the record or of the filter's model with a few unknown parameters θ: a factor on the noise of a sensor, an
offset of its time stamps, a magnetometer's hard iron, … The innovations of a consistent filter are independent and normal, so the
log-likelihood of the record is ``−½ Σ (ln s + z²)`` over its whitened innovations z with variances s (Schweppe 1965). For every hypothesis
the filter is run again and the maximum-likelihood θ found: by Gauss–Newton on the innovations, with finite differences of filter runs, if
θ shifts them, and by a parabola if it scales them. Twice the gain in log-likelihood is χ² with the dimension of θ as degrees of freedom if
the filter is consistent (Wilks 1938; Willsky & Jones 1976). Causes are ranked by that probability, so each is reported with its size, and a
cause that merely resembles the true one explains less. If two explain the same (which of two references is in error), both are reported.

Commutation error is the exception: in the innovations it *is* a gyro bias, which the filter estimates. It is computed from the increments
by a more accurate integration algorithm, and compared with the filter's σ of the bias, and with the truth if there is one.

- ``diagnosing``: :func:`diagnose`, and commutation.
- ``causes``: The result, :class:`Diagnosis`.
- ``hypotheses``: Possible faults.
- ``likelihood``: The likelihood of the record under a hypothesis.
"""

from strapdown.tuning.diagnosis.causes import Cause, Diagnosis
from strapdown.tuning.diagnosis.diagnosing import commutation_drift, diagnose

__all__ = ["Cause", "Diagnosis", "diagnose"]
