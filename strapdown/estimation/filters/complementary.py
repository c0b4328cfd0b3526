"""The explicit complementary filter with bias correction (Mahony, Hamel & Pflimlin 2008, equations (32)): the baseline.

It has fixed gains and converges from almost any start. It computes no covariance; the one reported is that of its linearised error under
its gains, so that its consistency can be tested like that of the others.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, array, count
from strapdown.estimation import forward
from strapdown.estimation.schedule import Schedule, innovations_by_sensor, skipped_too
from strapdown.estimation.states import ProcessNoise, State
from strapdown.kernels import complementary, structure
from strapdown.kernels.machine import compiled
from strapdown.kernels.walk import walk
from strapdown.records import Estimate, ImuRecord


def farrenkopf_gains(
    angle_random_walk: float, rate_random_walk: float, sigma: float, interval: float
) -> tuple[float, float]:
    """Return the steady-state Kalman gains (attitude, bias in 1/s) of one axis measured with ``sigma`` rad every ``interval`` s.

    Farrenkopf 1978, for a gyro read continuously (Markley & Crassidis 2014, chapter 6):
    ``K_θ = 1 − ζ⁻²``, ``K_b = −σ_u √dt / (σ_n ζ)``.
    """
    su = rate_random_walk * interval**1.5 / sigma
    sv = angle_random_walk * math.sqrt(interval) / sigma
    gamma = math.sqrt(1.0 + sv * sv / 4.0 + su * su / 48.0)
    zeta = gamma + su / 4.0 + 0.5 * math.sqrt(2.0 * gamma * su + sv * sv + su * su / 3.0)
    # (ζ² − 1)/ζ² written with (ζ − 1), which keeps its digits if the gain is small.
    return (zeta - 1.0) * (zeta + 1.0) / (zeta * zeta), -su / (interval * zeta)


def _steady_gains(record: ImuRecord, events: Schedule, process_noise: ProcessNoise, initial: State) -> Array:
    """Return Farrenkopf's gains (2, sensors) for all sensors together, divided among them by information."""
    duration = float(record.time[-1] - record.time[0])
    number = np.bincount(events.sensor, minlength=len(events.sensors))
    if not number.any():
        return np.zeros((2, len(number)))
    information = np.bincount(events.sensor, weights=1.0 / events.variance, minlength=len(number)) / duration
    interval = duration / np.maximum(number, 1)
    longest = float(interval[number > 0].max())
    initial_sigma = np.sqrt(np.diag(initial.covariance) / duration)
    attitude, bias = farrenkopf_gains(
        math.hypot(process_noise.angle_random_walk, float(initial_sigma[:3].max())),
        math.hypot(process_noise.rate_random_walk, float(initial_sigma[3:].max())),
        1.0 / math.sqrt(information.sum() * longest),
        longest,
    )
    share = information / information.sum() * interval / longest
    return np.stack([attitude * share, bias * share])


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int = 1,
    full_covariance: bool = False,
    gains: ArrayLike | None = None,
) -> Estimate:
    """Run the filter over a whole record, compiled; options as for :func:`strapdown.estimation.filters.run`.

    ``gains`` (2, sensors) are of each sensor, in the order of the record, for ``ω_mes = z × R̂ᵀ r``: the rotation of the attitude per angle,
    k_P times the sensor's weight times its sample interval, and the change of the bias per angle, rad/s/rad, −k_I times the same.
    Default: Farrenkopf's for all sensors together, divided among them by information, with random walks increased by the initial
    standard deviations of attitude and bias over the record: a fixed gain must be suitable for the start as well as the end.
    """
    count("every", every)
    problem = forward.with_any_sensor(forward.prepared(record, process_noise, initial, ()))
    events = problem.events
    used = _steady_gains(record, events, process_noise, initial) if gains is None else gains
    rows = len(record.increments) // every + 1
    shapes = (
        (rows, 7),
        (rows, 6),
        (rows if full_covariance else 0, 6, 6),
        (0, 6),
        (0, 6, 6),
        (len(events.time), 6),
        (0, 0),
    )
    out = structure.Outputs._make(np.empty(shape) for shape in shapes)
    body = complementary.Body(
        form=forward.filter_body(problem, {}),
        options=forward.gate_options(None, None)._replace(thresholds=np.full(3, -1.0)),
        gains=array("gains", used, (2, len(events.sensors))),
        room=np.empty((2, 6, 6)),
    )
    measured, kernels = forward.measurements_in_body_axes(events), forward.instance_of(problem.model)
    compiled(walk, complementary, kernels)(*problem.gyro, measured, every, body, out)
    innovations = innovations_by_sensor(events, out.innovation)
    return replace(
        forward.estimate_of(problem, every, out.x, out.variance, out.covariance if full_covariance else None),
        innovations=innovations,
        skipped=skipped_too(events, innovations),
        events=tuple(forward.gaps(record)),
    )
