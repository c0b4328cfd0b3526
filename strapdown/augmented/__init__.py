"""The multiplicative extended Kalman filter with optional states, declared as blocks, in square-root form.

Attitude and gyro bias as in :mod:`strapdown.mekf`, and beside them what the blocks say::

    blocks = (
        augmented.GyroScale(scale_sigma=0.01, misalignment_sigma=0.01),
        augmented.VectorBias(sensor="magnetometer", bias_sigma=10e-6, unit="T"),
    )
    estimate = augmented.run(record, process_noise, initial, blocks)
    estimate.blocks["magnetometer bias"].values

Without blocks it is the filter of :mod:`strapdown.mekf`, number for number.

The covariance is held as a triangular factor, ``P = S Sᵀ``: the prediction brings the noise into the triangle by Householder reflections, a
measurement enters by Carlson's row update (Bierman 1977, chapters V to VII). So P is symmetric and positive definite by construction, and
the digits are those of standard deviations, not of variances: states of which some stay as the prior says (a scale factor that no turn
has shown) while others are measured 1e9 times better live in one matrix, where the plain filter's two fixed blocks of three need no more
than Joseph's form. The states that change stand first in the triangle and the constant ones last, so those cost the prediction nothing
but their share of the attitude. Against the plain filter, prediction and two directions, that costs a factor of 2.6 with no block, 3.4
with hard iron (9 states), 4.9 with the gyro's scale (15), 8 with both and a coloured noise (21). The smoother costs 3 to 5 times its own
filter.

States may feed one another in chains (:mod:`strapdown.kernels.augmented_chain`), which shapes coloured noise of more than one pole: of the
acceleration of a moving hand, whose velocity is bounded (:class:`BoundedVelocity`; 3.4 times a filter without a block).

A filter that starts tenths of a radian off, as one does whose heading hard iron has turned, is linearised at the wrong place and believes
too much for good; :func:`recentred` starts it anew where the smoother puts it.

A filter setup (:mod:`strapdown.setup`) holds such states as :class:`States`, in a file and as ``setup.matched(scenario, states=True)``
chooses them.

Modules: ``blocks`` what can be declared, ``model`` blocks as arrays, ``filtering`` the compiled filter, ``stepping`` the step-by-step one,
``smoothing`` the smoother, ``joining`` what it makes of recoveries, ``stepwise`` the one for blocks told by functions, ``observing`` the
observability report, ``turning`` rate and angular acceleration for lever arms, ``states`` what a setup holds, ``matching`` which of them a
specification calls for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from strapdown.augmented.blocks import (
    Block,
    BoundedVelocity,
    Effect,
    GaussMarkov,
    GeneralBlock,
    GyroForce,
    GyroGaussMarkov,
    GyroScale,
    Interval,
    LeverArm,
    LinearBlock,
    VectorBias,
    VectorScale,
    View,
)
from strapdown.augmented.filtering import AugmentedEstimate, run, run_on
from strapdown.augmented.model import AugmentedState, initial_state
from strapdown.augmented.observing import Observability, observability
from strapdown.augmented.smoothing import recentred, smooth, smooth_fixed_lag
from strapdown.augmented.states import SensorStates, States
from strapdown.records import BlockEstimate

if TYPE_CHECKING:
    from strapdown.augmented.stepping import StepFilter

__all__ = [
    "AugmentedEstimate",
    "AugmentedState",
    "Block",
    "BlockEstimate",
    "BoundedVelocity",
    "Effect",
    "GaussMarkov",
    "GeneralBlock",
    "GyroForce",
    "GyroGaussMarkov",
    "GyroScale",
    "Interval",
    "LeverArm",
    "LinearBlock",
    "Observability",
    "SensorStates",
    "States",
    "StepFilter",
    "VectorBias",
    "VectorScale",
    "View",
    "initial_state",
    "observability",
    "recentred",
    "run",
    "run_on",
    "smooth",
    "smooth_fixed_lag",
]


def __getattr__(name: str) -> Any:
    """Load the step-by-step filter only when it is asked for: filterpy's import takes longer than a recording's estimate."""
    if name in ("StepFilter",):
        from strapdown.augmented import stepping

        return getattr(stepping, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
