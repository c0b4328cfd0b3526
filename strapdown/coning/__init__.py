"""Strapdown integration of gyro samples: algorithms as tables of coefficients whose drift is derived exactly.

An increment Δθ is the integral of the body rate over one sample interval. The rotation δq of a step is computed from its N increments, and
for some algorithms also from p before and f after it; attitude is propagated by ``q ← q ⊗ δq``, the solution of equation (17) of
*Quaternion differentiation*.

- ``coefficients``: Derivation of the coefficients, in exact rationals.
- ``algorithms``: :class:`Algorithm`, the catalogue :data:`ALGORITHMS`, and :func:`algorithm_table`, its printed table.
- ``stepping``: :func:`integrate`, :func:`rotation_vectors`: from records to attitude.
- ``drift``: :func:`predicted_coning_drift`, :func:`vibration_drift`: the drift due to coning and vibration.

Recommended: ``"four-sample"`` in most cases; ``"matched-1-8-8"`` for recorded data or if a delay of eight samples is allowed;
``"matched-2-8"`` in real time; ``"matched-4-11"`` in real time with a low-noise gyro. (Its long one-sided fit amplifies noise 24 times at a
rotation of one radian per sample; ``"matched-2-8"`` 2.1 times, ``"matched-1-8-8"`` 0.12 times.) The matched family was derived for this
package: :func:`strapdown.coning.coefficients.matched_correction`.
"""

from strapdown.coning.algorithms import ALGORITHMS, Algorithm, algorithm_table, named, read_algorithms
from strapdown.coning.drift import (
    VibrationLine,
    predicted_coning_drift,
    read_vibration,
    small_angle_drift,
    vibration_drift,
    vibration_table,
)
from strapdown.coning.stepping import increments_from_rates, integrate, rotation_vectors, time_per_sample

# Names imported as themselves above and not listed here are for use within the package.
__all__ = [
    "ALGORITHMS",
    "Algorithm",
    "increments_from_rates",
    "integrate",
    "predicted_coning_drift",
    "read_algorithms",
    "rotation_vectors",
]
