"""Extended Kalman filters that differ from the MEKF in the definition of the error, compiled.

Between updates most of them propagate the same Gaussian in different coordinates, and their gains are the same matrix in different
coordinates. They differ in the step after an update: the tangent space of the covariance, and how a correction changes the bias. In
body-side terms, after an attitude correction a, the covariance is transformed by G:

===============  ==================================  =====================================
filter           G on (δθ, δb)                       bias
===============  ==================================  =====================================
MEKF             diag(J_r(a), I)                     b + c
fixed-side       diag(J_r(a), I): the same filter    b + c
right-invariant  diag(exp(−[a]), I)                  b + c
two-frame        diag(exp(−[a]), exp(−[a]))          b + J_r(a) c
equivariant      as two-frame                        as two-frame
geometric        [[I, 0], [[b⁺ − b], I]]             exp(−[a]) b + c
schmidt          diag(J_r(a), I)                     b
===============  ==================================  =====================================

with c the linear correction of the filter's bias error, and [·] the skew matrix. The geometric filter leaves the covariance of (δθ, η)
unchanged, η = δb − [b] δθ; that is its G in (δθ, δb). The equivariant filter differs from the two-frame one in the rows of directions.

Each is a module of :mod:`strapdown.kernels.filters`, and an entry of :data:`strapdown.estimation.filters.FILTERS`. All stay finite for any
initial error and covariance, and P positive definite to rounding: corrections of any size use closed forms, measurement rows are processed
in Joseph's form, and a heading whose vector is estimated to be vertical is skipped and counted. The geometric filter needs a bound that the
paper does not have: corrections beyond 1.8955 rad would increase its bias, so they are shortened to that
(:data:`strapdown.kernels.filters.geometric.LARGEST_CORRECTION`).
"""

from __future__ import annotations

from types import ModuleType

import numpy as np

from strapdown.checks import Array, count
from strapdown.estimation.forward import gaps
from strapdown.estimation.schedule import Schedule, innovations_by_sensor, schedule, skipped_too
from strapdown.estimation.states import ProcessNoise, State, check_arguments, covariance_matrices, pack
from strapdown.kernels.filters import body_side
from strapdown.kernels.filters import extended as kernel
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.walk import walk
from strapdown.records import Estimate, ImuRecord


def run(
    definition: ModuleType,
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int = 1,
    full_covariance: bool = False,
) -> Estimate:
    """Run the filter defined by a module of :mod:`strapdown.kernels.filters` over a whole record."""
    events = checked_schedule(record, process_noise, initial, every)
    return run_scheduled(definition, record, events, process_noise, initial, np.empty((2, 0)), every, full_covariance)


def checked_schedule(record: ImuRecord, process_noise: ProcessNoise, initial: State, every: int) -> Schedule:
    """Return the measurements of a record in order of time, after a check of the arguments."""
    check_arguments(record=record, process_noise=process_noise, initial=initial)
    count("every", every)
    return schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)


def run_scheduled(
    definition: ModuleType,
    record: ImuRecord,
    events: Schedule,
    process_noise: ProcessNoise,
    initial: State,
    gains: Array,
    every: int,
    full_covariance: bool,
) -> Estimate:
    """Run the filter over scheduled measurements, with ``gains`` (2, sensors) if it has fixed gains."""
    states = np.empty((len(record.increments) // every + 1, 28))
    innovation = np.empty((len(events.time), 6))
    body = kernel.Body(
        state=pack(initial.attitude, initial.bias, initial.covariance),
        angle_variance=process_noise.angle_random_walk**2,
        rate_variance=process_noise.rate_random_walk**2,
        gains=gains,
    )
    out = kernel.Outputs(states=states, innovation=innovation)
    compiled(walk, definition, kernel, body_side)(
        read_only(record.time), read_only(record.increments), events.measurements, every, body, out
    )
    return estimate(record, events, every, states, innovation, full_covariance)


def estimate(
    record: ImuRecord, events: Schedule, every: int, states: Array, innovation: Array, full_covariance: bool
) -> Estimate:
    """Return the estimate of packed states (m, 28), body side, and innovations (events, 6) by place: e₁, s₁, e₂, s₂, e₃, s₃."""
    covariance = covariance_matrices(states[:, 7:])
    innovations = innovations_by_sensor(events, innovation)
    return Estimate(
        time=record.time[::every],
        attitude=states[:, :4],
        bias=states[:, 4:7],
        variance=np.diagonal(covariance, axis1=1, axis2=2).copy(),
        covariance=covariance if full_covariance else None,
        innovations=innovations,
        skipped=skipped_too(events, innovations),
        events=tuple(gaps(record)),
    )
