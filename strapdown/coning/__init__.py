"""Strapdown integration of gyro samples: algorithms as frozen tables that check their own order conditions, one accumulator for all.

An increment Δθ is the integral of the body rate over one sample interval. A step takes N of them, perhaps with p before and f after, to
the rotation of the step; attitude advances by ``q ← q ⊗ δq``, the solution of equation (17).

``coefficients``
    The mathematics of the tables, in exact rationals.
``algorithms``
    :class:`Algorithm`, the catalogue :data:`ALGORITHMS`, and :func:`algorithm_rows`, its printed table.
``stepping``
    :func:`integrate`, :func:`integrate_rates`, :func:`rotation_vectors`: records in, attitude out; :func:`time_per_sample`.
``drift``
    :func:`predicted_coning_drift`, :func:`small_angle_drift`, :class:`ConingBudget`: what vibration costs.

What to choose: ``"four-sample"`` for ordinary work, ``"matched-1-8-8"`` for recorded data or where a delay of eight samples does no
harm, ``"matched-2-8"`` in real time, ``"matched-4-11"`` in real time with a quiet gyro (through its long one-sided fit, noise beside a
turn of one radian a sample counts 24 times, with ``"matched-2-8"`` twice, with ``"matched-1-8-8"`` a tenth). The matched family is this
package's own; :func:`strapdown.coning.coefficients.matched_correction` derives it.
"""

from strapdown.coning.algorithms import ALGORITHMS, Algorithm, read_algorithms
from strapdown.coning.algorithms import algorithm_rows as algorithm_rows
from strapdown.coning.algorithms import named as named
from strapdown.coning.drift import (
    ConingBudget,
    VibrationLine,
    predicted_coning_drift,
    read_vibration,
    small_angle_drift,
)
from strapdown.coning.stepping import increments_from_rates, integrate, integrate_rates, rotation_vectors
from strapdown.coning.stepping import time_per_sample as time_per_sample

__all__ = [
    "ALGORITHMS",
    "Algorithm",
    "ConingBudget",
    "VibrationLine",
    "increments_from_rates",
    "integrate",
    "integrate_rates",
    "predicted_coning_drift",
    "read_algorithms",
    "read_vibration",
    "rotation_vectors",
    "small_angle_drift",
]
