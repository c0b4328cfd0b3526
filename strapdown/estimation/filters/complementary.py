"""The explicit complementary filter with bias correction (Mahony, Hamel & Pflimlin 2008, equations (32)): the baseline.

It has fixed gains and converges from almost any start. It computes no covariance; the one reported is that of its linearised error under
its gains, so that its consistency can be tested like that of the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from strapdown.checks import Array, array, instance
from strapdown.estimation.filters import extended
from strapdown.estimation.schedule import Schedule
from strapdown.estimation.states import ProcessNoise, State
from strapdown.kernels.filters import complementary as kernel
from strapdown.records import Estimate, ImuRecord


@dataclass(frozen=True, kw_only=True, eq=False)
class Gains:
    """Gains of each sensor, in the order of the record, for ``ω_mes = z × R̂ᵀ r``."""

    attitude: Array
    """Rotation of the attitude per angle, rad/rad (sensors,): k_P times the weight of the sensor times its sample interval."""
    bias: Array
    """Change of the bias per angle, rad/s/rad (sensors,), not positive: −k_I times the same."""


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


def _steady_gains(record: ImuRecord, events: Schedule, process_noise: ProcessNoise, initial: State) -> Gains:
    duration = float(record.time[-1] - record.time[0])
    number = np.bincount(events.sensor, minlength=len(events.sensors))
    if not number.any():
        return Gains(attitude=np.zeros(len(number)), bias=np.zeros(len(number)))
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
    return Gains(attitude=attitude * share, bias=bias * share)


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int = 1,
    full_covariance: bool = False,
    gains: Gains | None = None,
) -> Estimate:
    """Run the filter over a whole record, compiled; options as for :func:`strapdown.estimation.filters.run`.

    Default gains: Farrenkopf's for all sensors together, divided among them by information, with random walks increased by the initial
    standard deviations of attitude and bias over the record: a fixed gain must be suitable for the start as well as the end.
    """
    events = extended.checked_schedule(record, process_noise, initial, every)
    if gains is not None:
        instance("gains", gains, Gains, "give complementary.Gains(attitude=…, bias=…), or None")
    chosen = _steady_gains(record, events, process_noise, initial) if gains is None else gains
    sensors = len(events.sensors)
    rows = np.stack(
        [array("gains.attitude", chosen.attitude, (sensors,)), array("gains.bias", chosen.bias, (sensors,))]
    )
    return extended.run_scheduled(kernel, record, events, process_noise, initial, rows, every, full_covariance)
