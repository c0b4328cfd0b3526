"""Extended Kalman filters that differ from the MEKF in what they call the error, compiled.

Between updates all of them propagate the same Gaussian, seen in different coordinates, and their gains are the same matrix seen in
different coordinates. What differs is the step over an update: which tangent space the covariance is taken to belong to afterwards, and how
a correction moves the bias. In body-side terms, after an attitude correction a, the covariance is carried by

===============  ==================================  =====================================
filter           G on (δθ, δb)                       bias
===============  ==================================  =====================================
MEKF             diag(J_r(a), I)                     b + c
fixed-side       diag(J_r(a), I): the same filter    b + c
right-invariant  diag(exp(−[a]), I)                  b + c
two-frame        diag(exp(−[a]), exp(−[a]))          b + J_r(a) c
geometric        [[I, 0], [[b⁺ − b], I]]             exp(−[a]) b + c
===============  ==================================  =====================================

with c the linear correction of the filter's own bias error, and [·] the skew matrix. The geometric filter leaves the covariance of (δθ, η)
alone, η = δb − [b] δθ; that is its G in (δθ, δb).

All stay finite from any start, however far off and however wrong its covariance, and P positive definite to rounding: turns and
corrections of any size go through closed forms (:mod:`strapdown.kernels.family_turns`), a row of a measurement is taken in by Joseph's
form, and a heading whose vector is estimated to be vertical is skipped and counted. The geometric filter needs one bound more, which the
paper does not have: its bias grows across corrections beyond 1.8955 rad, so a longer one is shortened to that
(:data:`strapdown.kernels.family_step.LARGEST_CORRECTION`).
"""

from __future__ import annotations

import numpy as np

from strapdown import mekf
from strapdown.family import stepping
from strapdown.kernels import family_loop
from strapdown.kernels.machine import compiled
from strapdown.mekf import ProcessNoise, State
from strapdown.records import Estimate, ImuRecord


def fixed_side(
    record: ImuRecord, process_noise: ProcessNoise, initial: State, *, every: int = 1, full_covariance: bool = False
) -> Estimate:
    """Run the MEKF with its attitude error in fixed axes, ``q_true = exp(δφ) ⊗ q``, reset by the left Jacobian: the MEKF's equal."""
    return _run(family_loop.FIXED_SIDE, record, process_noise, initial, every, full_covariance)


def right_invariant(
    record: ImuRecord, process_noise: ProcessNoise, initial: State, *, every: int = 1, full_covariance: bool = False
) -> Estimate:
    """Run the right-invariant filter with an additive bias ("imperfect": Barrau & Bonnabel 2017): the fixed-side filter without its reset.

    The rows of a constant reference do not depend on the estimate, so what they do not show stays unobserved for ever.
    """
    return _run(family_loop.RIGHT_INVARIANT, record, process_noise, initial, every, full_covariance)


def two_frame(
    record: ImuRecord, process_noise: ProcessNoise, initial: State, *, every: int = 1, full_covariance: bool = False
) -> Estimate:
    """Run the right-invariant filter of the two-frames group (Barrau & Bonnabel 2023): the bias error too in fixed axes."""
    return _run(family_loop.TWO_FRAME, record, process_noise, initial, every, full_covariance)


def geometric(
    record: ImuRecord, process_noise: ProcessNoise, initial: State, *, every: int = 1, full_covariance: bool = False
) -> Estimate:
    """Run the geometric filter of Andrle & Crassidis (2015): the bias error is taken in one common frame, ``η = b_true − exp(−[δθ]) b``."""
    return _run(family_loop.GEOMETRIC, record, process_noise, initial, every, full_covariance)


def _run(
    variant: int, record: ImuRecord, process_noise: ProcessNoise, initial: State, every: int, full_covariance: bool
) -> Estimate:
    stepping.check(record, process_noise, initial)
    events, steps = stepping.events_and_steps(record, every)
    states, innovation = np.empty((len(steps.time), 28)), np.empty((len(events.time), 6))
    compiled(family_loop.run_extended)(
        variant,
        steps.dt,
        steps.increment,
        steps.event,
        steps.row,
        process_noise.angle_random_walk**2,
        process_noise.rate_random_walk**2,
        events.kind,
        events.vector_b,
        events.body_noise,
        events.reference,
        events.triads,
        mekf.pack(initial.attitude, initial.bias, initial.covariance),
        states,
        innovation,
    )
    return stepping.estimate(events, steps, states, innovation, full_covariance)
