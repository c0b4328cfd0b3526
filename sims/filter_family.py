"""Which attitude filter? Convergence and consistency of the family, from small and large initial errors.

One tumbling body, a MEMS gyro, and four cases:

- ``small``: two directions; the initial error, 1° per axis, is drawn from the filter's prior;
- ``large``: the same with an initial error of 60° to 150° about any axis;
- ``one direction``: as large, with only one constant reference. The rotation about it is unobservable. The error shown is the angle
  between the true and the estimated reference in the body; the NEES shows whether the covariance of the unobservable rotation is right;
- ``tracker``: as large, with a star tracker that measures the attitude, with a σ about its boresight ten times that across it.

The filters are the package's MEKF, and others as short filters of one's own, in NumPy. All run on the same records from the same initial
states. Run
``python sims/filter_family.py --out filter-family-results`` (some minutes, nearly all for the unscented filter). It prints a table, and
writes it with the figure and ``filter_family.json``.

Definitions of the error. All Kalman filters have the same gains, in different coordinates. They differ in the step after an update: in the
body-side terms of the package, after an attitude correction a the covariance of (δθ, δb) is transformed by G:

===============  ==================================  ==========================
filter           G                                   bias
===============  ==================================  ==========================
mekf             diag(J_r(a), I)                     b + c
right-invariant  diag(exp(−[a]), I)                  b + c
two-frame        diag(exp(−[a]), exp(−[a]))          b + J_r(a) c
equivariant      as two-frame                        as two-frame
geometric        [[I, 0], [[b⁺ − b], I]]             exp(−[a]) b + c − b × a
===============  ==================================  ==========================

with c the correction of δb. Right-invariant: Barrau & Bonnabel 2017; two-frame: the same 2023; equivariant: van Goor, Hamel & Mahony 2022,
the row of a direction linearised at the mean of reference and measured direction, so that its error is of third order; geometric: Andrle &
Crassidis 2015, with a largest correction that the paper does not have. ``usque`` is the unscented filter of Crassidis & Markley 2003; as in
that paper, half of the process noise is added before a propagation and half after it. ``mahony`` is the complementary filter of Mahony,
Hamel & Pflimlin 2008 with steady-state gains, and the covariance that its error has under them.

Reasons for the differences. For small errors all Kalman filters propagate the same Gaussian in different coordinates, and only the fixed
gains of Mahony's filter cost accuracy: one gain per sensor, which cannot weight the axes of a tracker. For a large error, the rotation that
the first direction leaves unobserved is about an axis constant in the fixed frame; in body axes that axis moves with the correction. The
invariant filters transform their covariance fully with it, the MEKF's reset by half, the geometric filter not at all; in that order the
covariance of the unobserved rotation is in error, and slow to recover. Fixed gains never become overconfident. Of the Kalman filters the
unscented one converges fastest if one measurement determines all that is observable, and slowest if two must be combined. For such initial
errors other methods are better: ``wahba`` if the first measurements determine the attitude, ``multiple_model`` if not.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from strapdown import consistency, estimation, plots, quaternion
from strapdown.checks import Array, InputError
from strapdown.estimation import State
from strapdown.estimation.states import ProcessNoise
from strapdown.files import write_json
from strapdown.gyro import GyroSpec
from strapdown.kinematics import right_jacobian, skew
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.plots import style
from strapdown.randomness import generator
from strapdown.records import Estimate, ImuRecord
from strapdown.results import Column, Table
from strapdown.scenarios import Scenario, simulate
from strapdown.units import DEGREE, DEGREE_PER_HOUR, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR
from strapdown.vectors import AttitudeSensor, Sensor, VectorMeasurements, VectorSensor, triad

CASES = ("small", "large", "one direction", "tracker")
CONVERGED = 3.0 * DEGREE
"""Maximum attitude error of a converged run, rad."""

SUN = np.array([0.0, 0.6, 0.8])
FIELD = np.array([0.8, 0.0, -0.6])
BIAS_SIGMA = 20.0 * DEGREE_PER_HOUR
SMALL_SIGMA = 1.0 * DEGREE
LARGE = (60.0 * DEGREE, 150.0 * DEGREE)
LARGE_SIGMA = np.sqrt((LARGE[0] ** 2 + LARGE[0] * LARGE[1] + LARGE[1] ** 2) / 9.0)
"""RMS per axis of angles uniform between the two, about any axis, rad."""


SMALL = {"runs": 2, "unscented_runs": 1, "duration": 10.0}
"""Arguments of a quick test run."""

COLOURS = {
    "mekf": style.BLUE,
    "right-invariant": style.VERMILION,
    "two-frame": style.ink(),
    "equivariant": style.YELLOW,
    "geometric": style.SKY,
    "usque": style.PURPLE,
    "mahony": style.GREEN,
}
LOOKS = {"two-frame": {"linestyle": (0, (5, 2, 1, 2)), "zorder": 3, "linewidth": 1.1}}
"""Of lines that nearly coincide with another's."""


# Filters of one's own

EXTENDED = ("right-invariant", "two-frame", "equivariant", "geometric")
NAMES = ("mekf", *EXTENDED, "usque", "mahony")
"""All filters of the study; the first is the package's."""
LARGEST_CORRECTION = 1.8954942670339809
"""Maximum correction of the geometric filter, rad: the root of θ = 2 sin θ, beyond which its bias would grow without limit."""


class Step(NamedTuple):
    """Part of a gyro interval that ends at a measurement or at an edge of the record."""

    increment: Array
    dt: float
    measured: tuple[VectorMeasurements, int] | None
    """Series and index of the measurement; None: an edge of the record."""


def steps(record: ImuRecord) -> Iterator[Step]:
    """Yield the steps of a filter over a record."""
    for series in record.vectors:
        if series.kind not in ("direction", "attitude"):
            raise InputError(f"{series.sensor} is a {series.kind}; these filters take directions and attitudes")
    times = [(t, i, k) for i, series in enumerate(record.vectors) for k, t in enumerate(series.time)]
    waiting = [due for due in sorted(times) if due[0] >= record.time[0]]
    now, rate = record.time[0], np.zeros((1, 3))
    rates = np.concatenate([rate, record.increments / record.intervals[:, None]])
    for end, rate in zip(record.time, rates, strict=True):
        while waiting and waiting[0][0] <= end:
            t, i, k = waiting.pop(0)
            yield Step(rate * (t - now), t - now, (record.vectors[i], k))
            now = t
        yield Step(rate * (end - now), end - now, None)
        now = end


def half_noise(noise: ProcessNoise, dt: float) -> Array:
    """Return half of the process noise of a step (6, 6)."""
    return 0.5 * dt * np.diag([noise.angle_random_walk**2] * 3 + [noise.rate_random_walk**2] * 3)


def rows_of(series: VectorMeasurements, k: int, q: Array, midway: bool) -> tuple[Array, Array, Array]:
    """Return H (d, 3), innovation (d,) and noise (d, d) of a measurement; ``midway``: with the equivariant rows."""
    if series.attitude is not None:
        y = quaternion.rotation_between(q, series.attitude[k])
        return np.eye(3), y, series.covariances[k]
    r, z = series.references_f[k], series.vector_b[k]
    predicted = quaternion.rotate(quaternion.conjugate(q), r)
    across = triad(predicted)[:2]
    H = across @ skew(0.5 * (predicted + z) if midway else predicted)
    return H, across @ z, across @ series.covariances[k] @ across.T


@dataclass(frozen=True)
class Extended:
    """An extended Kalman filter of the table, by its name."""

    name: str
    noise: ProcessNoise

    def run(self, record: ImuRecord, initial: State) -> Estimate:
        """Run the filter over a whole record."""
        q, b, P = initial.attitude, initial.bias, initial.covariance
        states = []
        for increment, dt, measured in steps(record):
            if dt > 0.0:
                phi = increment - dt * b
                turn = quaternion.exp(phi)
                q = quaternion.multiply(q, turn)
                F = np.eye(6)
                F[:3, :3], F[:3, 3:] = quaternion.to_matrix(turn).T, -dt * right_jacobian(phi)
                noise = half_noise(self.noise, dt)
                P = F @ (P + noise) @ F.T + noise
            if measured is None:
                states.append((q, b, P))
                continue
            H, y, N, K = self.linearised(*measured, q, P)
            left = np.eye(6)
            left[:, :3] -= K @ H
            P = left @ P @ left.T + K @ N @ K.T
            q, b, G = corrected(self.name, q, b, K @ y)
            P = G @ P @ G.T
        attitude, bias, covariance = zip(*states, strict=True)
        return Estimate.from_arrays(record.time, attitude, covariance, bias=bias)

    def linearised(self, series: VectorMeasurements, k: int, q: Array, P: Array) -> tuple[Array, Array, Array, Array]:
        """Return H (d, 3), innovation (d,) and noise (d, d) of a measurement, and the gain (6, d)."""
        H, y, N = rows_of(series, k, q, self.name == "equivariant")
        return H, y, N, np.linalg.solve(H @ P[:3, :3] @ H.T + N, H @ P[:3]).T


def corrected(name: str, q: Array, b: Array, correction: Array) -> tuple[Array, Array, Array]:
    """Return attitude and bias after a correction (6,), and G (6, 6)."""
    if name == "geometric":
        correction = correction * min(1.0, LARGEST_CORRECTION / max(float(np.linalg.norm(correction[:3])), 1e-300))
    a, c = correction[:3], correction[3:]
    turn, J, G = quaternion.exp(a), right_jacobian(a), np.eye(6)
    back = quaternion.to_matrix(turn).T
    b_next = b + c
    if name in ("mekf", "mahony"):
        G[:3, :3] = J
    elif name == "right-invariant":
        G[:3, :3] = back
    elif name == "geometric":
        b_next = back @ b + c - np.cross(b, a)
        G[3:, :3] = skew(b_next - b)
    else:
        G[:3, :3] = G[3:, 3:] = back
        b_next = b + J @ c
    return quaternion.normalize(quaternion.multiply(q, turn)), b_next, G


def steady_gains(record: ImuRecord, noise: ProcessNoise, initial: State) -> dict[str, Array]:
    """Return the gains (2,) of attitude and bias (1/s) of each sensor: Farrenkopf's for all together, divided by information.

    ``K_θ = 1 − ζ⁻²``, ``K_b = −σ_u √dt / (σ_n ζ)`` (Farrenkopf 1978). The random walks include the initial σ over the record, as a fixed
    gain must be suitable for the start too.
    """
    first, last = record.time[0], record.time[-1]
    sigmas = {s.sensor: s.sigma[(first <= s.time) & (s.time <= last)] for s in record.vectors}
    information = {name: np.sum(sigma**-2.0) / (last - first) for name, sigma in sigmas.items()}
    dt = (last - first) / min(map(len, sigmas.values()))
    start = np.sqrt(np.diag(initial.covariance) / (last - first))
    unit = np.sqrt(dt * sum(information.values()))
    sv = np.hypot(noise.angle_random_walk, start[:3].max()) * unit * np.sqrt(dt)
    su = np.hypot(noise.rate_random_walk, start[3:].max()) * unit * dt**1.5
    gamma = np.sqrt(1.0 + sv**2 / 4.0 + su**2 / 48.0)
    zeta = gamma + su / 4.0 + 0.5 * np.sqrt(2.0 * gamma * su + sv**2 + su**2 / 3.0)
    total = np.array([1.0 - zeta**-2.0, -su / (dt * zeta)]) * (last - first) / (dt * sum(information.values()))
    return {name: total * information[name] / len(sigma) for name, sigma in sigmas.items()}


@dataclass(frozen=True)
class Mahony(Extended):
    """The complementary filter with fixed gains: a measurement rotates the attitude by the gain times ω_mes = z × R̂ᵀ r, equations (32).

    Of a measured attitude ω_mes is that of the passive filter, sin θ about the rotation axis. The covariance is that of any gain (Joseph),
    with ``ω_mes = H δθ + n``.
    """

    gains: dict[str, Array]
    """Of each sensor, :func:`steady_gains`."""

    def linearised(self, series: VectorMeasurements, k: int, q: Array, P: Array) -> tuple[Array, Array, Array, Array]:
        """Return H (3, 3), ω_mes (3,) and its noise (3, 3), and the gain (6, 3)."""
        K, N = np.kron(self.gains[series.sensor][:, None], np.eye(3)), series.covariances[k]
        if series.attitude is not None:
            d = quaternion.multiply(quaternion.conjugate(q), series.attitude[k])
            return np.eye(3), 2.0 * d[0] * d[1:], N, K
        predicted = quaternion.rotate(quaternion.conjugate(q), series.references_f[k])
        across = skew(predicted)
        return -across @ across, np.cross(series.vector_b[k], predicted), across @ N @ across.T, K


def to_quaternion(p: Array) -> Array:
    """Return δq (..., 4) of generalised Rodrigues parameters p (..., 3), a = 1, f = 4: p = 4 tan(θ/4) n."""
    squared = np.sum(p * p, axis=-1, keepdims=True)
    return np.concatenate([16.0 - squared, 8.0 * p], axis=-1) / (16.0 + squared)


def to_rodrigues(q: Array) -> Array:
    """Return p (..., 3) of unit quaternions (..., 4), of the shorter rotation."""
    q = np.where(q[..., :1] < 0.0, -q, q)
    return np.asarray(4.0 * q[..., 1:] / (1.0 + q[..., :1]))


WEIGHTS = np.array([1.0 / 7.0] + [1.0 / 14.0] * 12)
"""Julier's sigma points of six states with κ = 1."""


@dataclass(frozen=True)
class Unscented:
    """USQUE: sigma points of p and b about the attitude, ``q_true = q ⊗ δq(p)``.

    A direction enters with all three components (Shuster's method): the variance along it is the mean of those across it. A measured
    attitude enters as its three parameters about the estimate.
    """

    noise: ProcessNoise
    name: str = "usque"

    def run(self, record: ImuRecord, initial: State) -> Estimate:
        """Run the filter over a whole record."""
        q, b, P = initial.attitude, initial.bias, initial.covariance
        states = []
        for increment, dt, measured in steps(record):
            if dt > 0.0:
                noise = half_noise(self.noise, dt)
                points, attitudes = spread(q, b, P + noise)
                attitudes = quaternion.multiply(attitudes, quaternion.exp(increment - dt * points[:, 3:]))
                points[:, :3] = to_rodrigues(quaternion.multiply(quaternion.conjugate(attitudes[0]), attitudes))
                mean = WEIGHTS @ points
                P = (WEIGHTS * (points - mean).T) @ (points - mean) + noise
                q, b = quaternion.multiply(attitudes[0], to_quaternion(mean[:3])), mean[3:]
            if measured is None:
                states.append((q, b, P))
            else:
                q, b, P = updated(q, b, P, *measured)
        attitude, bias, covariance = zip(*states, strict=True)
        return Estimate.from_arrays(record.time, attitude, covariance, bias=bias)


def spread(q: Array, b: Array, P: Array) -> tuple[Array, Array]:
    """Return the sigma points (13, 6) about (0, b), and their attitudes (13, 4)."""
    root = np.sqrt(7.0) * np.linalg.cholesky(P).T
    points = np.concatenate([np.zeros((1, 6)), root, -root])
    points[:, 3:] += b
    return points, quaternion.multiply(q, to_quaternion(points[:, :3]))


def updated(q: Array, b: Array, P: Array, series: VectorMeasurements, k: int) -> tuple[Array, Array, Array]:
    """Return attitude, bias and covariance after a measurement."""
    points, attitudes = spread(q, b, P)
    noise = series.covariances[k]
    if series.attitude is not None:
        residuals = to_rodrigues(quaternion.multiply(quaternion.conjugate(q), series.attitude[k])) - points[:, :3]
    else:
        r = series.references_f[k]
        basis = triad(quaternion.rotate(quaternion.conjugate(q), r))
        residuals = (series.vector_b[k] - quaternion.rotate(quaternion.conjugate(attitudes), r)) @ basis.T
        noise = basis @ noise @ basis.T
        noise[2, :2] = noise[:2, 2] = 0.0
        noise[2, 2] = 0.5 * (noise[0, 0] + noise[1, 1])
    mean, prior = WEIGHTS @ residuals, np.concatenate([np.zeros(3), b])
    S = (WEIGHTS * (residuals - mean).T) @ (residuals - mean) + noise
    gain = -np.linalg.solve(S, (WEIGHTS * (residuals - mean).T) @ (points - prior)).T
    state, P = prior + gain @ mean, P - gain @ S @ gain.T
    q = quaternion.normalize(quaternion.multiply(q, to_quaternion(state[:3])))
    return q, state[3:], 0.5 * (P + P.T)


def estimated(name: str, record: ImuRecord, noise: ProcessNoise, initial: State) -> Estimate:
    """Return the estimate of a filter by its name, with whole covariances."""
    if name == "mekf":
        return estimation.run(record, noise, initial, full_covariance=True)
    return own_filter(name, record, noise, initial).run(dataclasses.replace(record, truth=None), initial)


def own_filter(name: str, record: ImuRecord, noise: ProcessNoise, initial: State) -> Extended | Unscented:
    """Return a filter of one's own by its name, for a record."""
    if name == "mahony":
        return Mahony(name, noise, steady_gains(record, noise, initial))
    return Unscented(noise) if name == "usque" else Extended(name, noise)


# The study


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One filter in one case."""

    case: str
    filter: str
    time: Array
    """Epochs (m,), s."""
    error: Array
    """Attitude error of each run (runs, m), rad."""
    nees: Array
    """NEES of all six states of each run (runs, m), per degree of freedom."""

    @property
    def anees(self) -> Array:
        """Mean NEES over the runs (m,), 1 for a consistent filter."""
        return np.asarray(self.nees.mean(axis=0))

    def summary(self) -> dict[str, Any]:
        """Return the results as plain values for JSON; a convergence that does not happen is None.

        Converged is a filter from when on 90 % of the runs are below 3°; consistent, if the ANEES is within its joint two-sided 99 % bounds
        at five epochs of the second half. The ANEES at 10 s still shows the effect of the first corrections.
        """
        runs, m = self.error.shape
        slow = np.flatnonzero(np.quantile(self.error, 0.9, axis=0) > CONVERGED)
        first = slow[-1] + 1 if len(slow) else 0
        epochs = np.linspace(m // 2, m - 1, 5).astype(int)
        verdict = consistency.Verdict(mean=self.anees[epochs], degrees=6, runs=runs, confidence_level=0.99)
        return {
            "case": self.case,
            "filter": self.filter,
            "runs": runs,
            "converged": float(np.mean(self.error[:, -1] < CONVERGED)),
            "convergence_time_s": float(self.time[first]) if first < m else None,
            "final_rms_deg": float(np.sqrt(np.mean(self.error[:, -1] ** 2))) / DEGREE,
            "anees_at_10_s": float(self.anees[min(int(np.searchsorted(self.time, 10.0)), m - 1)]),
            "anees_at_end": float(self.anees[-1]),
            "anees_bounds": list(consistency.mean_bounds(6, runs)),
            "consistent": verdict.consistent,
        }


@dataclass(frozen=True, kw_only=True)
class Result:
    """Results of the study."""

    outcomes: tuple[Outcome, ...]


def scenario(case: str, duration: float) -> Scenario:
    """Return the body, the gyro and the sensors of one case."""
    sun = VectorSensor(name="sun", reference_f=SUN, sigma=1.0 * DEGREE, rate=1.0)
    field = VectorSensor(name="field", reference_f=FIELD, sigma=2.0 * DEGREE, rate=1.0, phase=0.45)
    tracker = AttitudeSensor(name="tracker", sigma_across=0.2 * DEGREE, sigma_about=2.0 * DEGREE, rate=0.5)
    alone: dict[str, tuple[Sensor, ...]] = {"one direction": (sun,), "tracker": (tracker,)}
    return Scenario(
        motion=HarmonicRates(
            mean=(1.0 * DEGREE, -2.0 * DEGREE, 3.0 * DEGREE),
            harmonics=(Harmonic(amplitude=(4.0 * DEGREE, 2.0 * DEGREE, 0.0), frequency=0.02, phase=0.3),),
        ),
        gyro=GyroSpec(
            angle_random_walk=0.3 * DEGREE_PER_ROOT_HOUR, rate_random_walk=20.0 * DEGREE_PER_HOUR_PER_ROOT_HOUR
        ),
        sensors=alone.get(case, (sun, field)),
        rate=5.0,
        duration=duration,
    )


def initial_state(case: str, attitude: Array, bias: Array, random: np.random.Generator) -> estimation.State:
    """Return the initial state of a run: the truth with an error as defined by the case."""
    axis = random.standard_normal(3)
    if case == "small":
        sigma, turn = SMALL_SIGMA, SMALL_SIGMA * axis
    else:
        sigma, turn = float(LARGE_SIGMA), random.uniform(*LARGE) * axis / np.linalg.norm(axis)
    return estimation.initial_state(
        quaternion.multiply(attitude, quaternion.exp(-turn)),
        attitude_sigma=sigma,
        bias_sigma=BIAS_SIGMA,
        bias=bias - BIAS_SIGMA * random.standard_normal(3),
    )


def study(
    case: str, names: Sequence[str], *, runs: int, unscented_runs: int, duration: float, seed: int
) -> list[Outcome]:
    """Return the outcomes of the named filters in one case, from independent runs."""
    what = scenario(case, duration)
    noise = ProcessNoise(angle_random_walk=what.gyro.angle_random_walk, rate_random_walk=what.gyro.rate_random_walk)
    every = int(what.rate)  # once a second
    errors: dict[str, list[Array]] = {name: [] for name in names}
    nees: dict[str, list[Array]] = {name: [] for name in names}
    for run in range(runs):
        record = simulate(what, seed, run)
        assert record.truth is not None
        truth = record.truth
        initial = initial_state(case, truth.attitude[0], truth.bias[0], generator(seed, run, "initial error"))
        for name in names:
            if name == "usque" and run >= unscented_runs:
                continue
            estimate = estimated(name, record, noise, initial)
            assert estimate.covariance is not None
            attitude, bias, P = (values[::every] for values in (estimate.attitude, estimate.bias, estimate.covariance))
            e = consistency.errors(attitude, bias, truth.attitude[::every], truth.bias[::every])
            nees[name].append(consistency.nees(e, P) / 6.0)
            errors[name].append(
                _pointing_error(attitude, truth.attitude[::every])
                if case == "one direction"
                else quaternion.angle_between(truth.attitude[::every], attitude)
            )
    time = record.time[::every]
    return [
        Outcome(case=case, filter=name, time=time, error=np.array(errors[name]), nees=np.array(nees[name]))
        for name in names
    ]


def _pointing_error(attitude: Array, truth: Array) -> Array:
    """Return the angle between the estimated and the true direction of the sun in the body (m,), rad."""
    estimated, true = (quaternion.rotate(quaternion.conjugate(q), SUN) for q in (attitude, truth))
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(estimated, true), axis=-1), np.sum(estimated * true, axis=-1)))


TITLES = {
    "small": "initial error 1° per axis",
    "large": "initial error 60° to 150°",
    "one direction": "60° to 150°, one direction only",
    "tracker": "60° to 150°, star tracker",
}


def draw(outcomes: Sequence[Outcome], path: Path) -> Path:
    """Draw error and ANEES over time, one column per case, and write the figure."""
    cases = list(dict.fromkeys(o.case for o in outcomes))
    figure, grid = plots.new_figure(2, len(cases), size=(2.8 * len(cases), 6.2), squeeze=False, sharex=True)
    most = max(len(o.error) for o in outcomes)
    for (top, bottom), case in zip(grid.T, cases, strict=True):
        for o in outcomes:
            if o.case == case:
                runs = f", {len(o.error)} runs" if len(o.error) < most else ""
                look: dict[str, Any] = {"color": COLOURS[o.filter], "label": f"{o.filter}{runs}", "linewidth": 1.4}
                look |= LOOKS.get(o.filter, {})
                top.plot(o.time, np.quantile(o.error, 0.9, axis=0) / DEGREE, **look)
                bottom.plot(o.time, o.anees, **look)
        bounds = consistency.mean_bounds(6, most)
        bottom.axhspan(*bounds, color="0.85", zorder=0, label=f"99 % bounds of {most} runs")
        top.axhline(CONVERGED / DEGREE, color="0.5", linewidth=0.8, linestyle=":")
        bottom.plot([], [], color="0.5", linewidth=0.8, linestyle=":", label=f"{CONVERGED / DEGREE:g}°: converged")
        style.log_scale(top)
        top.set_title(TITLES[case])
        scale = "linear" if case == "small" else "log"
        bottom.set(yscale=scale, xlabel="time, s")
        bottom.set_title(f"{scale} scale", loc="right", fontsize="small")
    grid[0, 0].set_ylabel("attitude error, 90th percentile, °")
    grid[1, 0].set_ylabel("ANEES")
    style.legend_below(figure, [grid[1, 0]], ncols=5)
    return plots.save(figure, path)


def table(result: Result) -> Table:
    """Return the outcomes as a table."""
    columns = {
        "case": Column("case"),
        "filter": Column("filter"),
        "runs": Column("runs"),
        "converged": Column("converged", shown=lambda share: f"{share:.0%}"),
        "convergence_time_s": Column("converged after, s", shown=lambda t: "never" if t is None else f"{t:.0f}"),
        "final_rms_deg": Column("final RMS, °"),
        "anees_at_10_s": Column("ANEES/6, 10 s", digits=3),
        "anees_at_end": Column("ANEES/6, end", digits=3),
        "consistent": Column("consistent"),
    }
    rows = [[o.summary()[key] for key in columns] for o in result.outcomes]
    return Table("Attitude filters from small and large initial errors", list(columns.values()), rows, left=2)


def main(
    *,
    runs: int = 100,
    unscented_runs: int = 40,
    duration: float = 300.0,
    cases: Sequence[str] = CASES,
    filters: Sequence[str] = NAMES,
    seed: int = 1,
    out: Path | None = None,
) -> Result:
    """Compare the filters; ``duration`` in s. Figure, table and JSON are written to ``out`` if it is given."""
    outcomes = tuple(
        outcome
        for case in cases
        for outcome in study(case, filters, runs=runs, unscented_runs=unscented_runs, duration=duration, seed=seed)
    )
    result = Result(outcomes=outcomes)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        draw(outcomes, out / "filter_family.png")
        (out / "filter_family.txt").write_text(table(result).text + "\n", encoding="utf-8")
        content = {"seed": seed, "duration_s": duration, "converged_deg": CONVERGED / DEGREE}
        write_json(out / "filter_family.json", {**content, "outcomes": [outcome.summary() for outcome in outcomes]})
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/filter_family"))
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--unscented-runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    print(table(main(**vars(parser.parse_args()))).text)
