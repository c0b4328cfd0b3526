"""Which integration algorithm, at what sample rate? Exact drift and periodic error under coning, and cost against error.

The errors are computed without simulation. Under coning every step of an algorithm is the same rotation δq, rotated about the cone's axis
by ωT per step; so δq ⊗ R_z(ωT) is one fixed rotation, applied repeatedly. Its angle minus ωT is the drift per step, and the angle between
its axis and the true one is half the maximum periodic error. Both are computed with mpmath to 50 digits, by a second implementation of the
step that is independent of the package's, so that a drift of 1e-30 is resolved as well as one of 1e-3.

Run it: ``python sims/coning_algorithms.py --out results/coning_algorithms`` (about two minutes; ``--quick`` for a coarse grid).
"""

from __future__ import annotations

import argparse
import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np

from strapdown import coning, plots
from strapdown.coning import ALGORITHMS, Algorithm
from strapdown.files import write_json
from strapdown.plots import style
from strapdown.units import DEGREE

DIGITS = 50
SMALL = {"quick": True}
"""Arguments of a quick test run."""
OWN = ("matched-2-8", "matched-4-11", "matched-1-4-4", "matched-1-8-8")
PUBLISHED = tuple(name for name in ALGORITHMS if name not in OWN)
ROUNDING = 2.0**-52
"""Errors per step below this are rounding and not due to the algorithm, rad."""

MANOEUVRE_ROUNDING = 1e-12
"""Errors of a manoeuvre below this are rounding, after hundreds of steps with large fit weights, rad."""

Vector = tuple[Any, ...]


# ------------------------------------------------------------------------------------------------ the steps, in 50 digits


def multiply(p: Vector, q: Vector) -> Vector:
    """Return the Hamilton product p ⊗ q."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def exponential(phi: Vector) -> Vector:
    """Return exp(φ)."""
    angle = mp.sqrt(sum(x * x for x in phi))
    s = mp.sin(angle / 2) / angle if angle else mp.mpf(1) / 2
    return (mp.cos(angle / 2), *(s * x for x in phi))


def cross(a: Vector, b: Vector) -> Vector:
    """Return a × b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def combination(weights: Sequence[Any], vectors: Sequence[Vector]) -> Vector:
    """Return Σ w_i v_i."""
    return tuple(mp.fdot(weights, [v[axis] for v in vectors]) for axis in range(3))


def pair_sum(pairs: Any, vectors: Sequence[Vector]) -> Vector:
    """Return Σ_{i<j} K_ij v_i × v_j."""
    total: Vector = (mp.mpf(0),) * 3
    for j in range(1, len(vectors)):
        part = cross(
            combination([mp.mpf(pairs[i][j].numerator) / pairs[i][j].denominator for i in range(j)], vectors[:j]),
            vectors[j],
        )
        total = tuple(x + y for x, y in zip(total, part, strict=True))
    return total


@functools.cache
def vandermonde(window: int, start: int, digits: int) -> Any:
    """Return the matrix from increments to the powers of the rate, t = 0 at the start of the step, by inverting the integrals of powers.

    ``digits`` is the working precision, an argument because the results are cached.
    """
    edges = [mp.mpf(k - start) for k in range(window + 1)]
    rows = [[(edges[i + 1] ** (m + 1) - edges[i] ** (m + 1)) / (m + 1) for m in range(window)] for i in range(window)]
    return mp.matrix(rows) ** -1


def rate_powers(window: Sequence[Vector], start: int) -> list[Vector]:
    """Return the powers of t of the rate polynomial through the window, t = 0 at the start of the step."""
    inverse = vandermonde(len(window), start, mp.mp.dps)
    return [combination([inverse[m, j] for j in range(len(window))], window) for m in range(len(window))]


def polynomial_step(powers: Sequence[Vector], samples: int) -> Vector:
    """Return the solution of equation (17) over ``samples`` intervals on a rate polynomial: one power series per half interval."""
    total: Vector = (mp.mpf(1), mp.mpf(0), mp.mpf(0), mp.mpf(0))
    half = mp.mpf(1) / 2
    for _ in range(2 * samples):
        q: list[Vector] = [(mp.mpf(1), mp.mpf(0), mp.mpf(0), mp.mpf(0))]
        arrived = q[0]
        scaled = [tuple(half ** (m + 1) * x for x in w) for m, w in enumerate(powers)]
        for n in range(200):
            # Σ q_{n−m} ⊗ (0, w_m), by components, as scalar products, which take half the time.
            a, b, c, d = map(list, zip(*q[: -len(scaled) - 1 : -1], strict=True))
            x, y, z = map(list, zip(*scaled[: len(a)], strict=True))
            minus_x, minus_y, minus_z = ([-u for u in w] for w in (x, y, z))
            term = (
                mp.fdot(b + c + d, minus_x + minus_y + minus_z),
                mp.fdot(a + c + d, x + z + minus_y),
                mp.fdot(a + d + b, y + x + minus_z),
                mp.fdot(a + b + c, z + y + minus_x),
            )
            q.append(tuple(u / (2 * (n + 1)) for u in term))
            arrived = tuple(u + v for u, v in zip(arrived, q[-1], strict=True))
            if n >= len(scaled) and max(abs(u) for term in q[-len(scaled) :] for u in term) < mp.eps:
                break  # all terms that later ones depend on are negligible
        total = multiply(total, arrived)
        # Shift the polynomial's origin by half an interval.
        powers = [
            combination([math.comb(k, m) * half ** (k - m) for k in range(m, len(powers))], powers[m:])
            for m in range(len(powers))
        ]
    return total


def exact_step(table: Algorithm, window: Sequence[Vector]) -> Vector:
    """Return the step quaternion of an algorithm from the increments of its window, directly by its definition."""
    n, p = table.samples, table.previous
    whole = combination([1] * n, window[p : p + n])
    if table.solver == "compressed":
        lags = [mp.mpf(k.numerator) / k.denominator for k in table.coefficients]
        if not lags:
            return exponential(whole)
        others = combination(lags, [window[-1 - lag] for lag in range(1, len(lags) + 1)])
        return exponential(combination([1, 1], [whole, cross(others, window[-1])]))
    if table.solver == "pairs":
        return exponential(combination([1, 1], [whole, pair_sum(table.products, window)]))
    if table.solver == "euler":
        return unit((mp.mpf(1), *(x / 2 for x in whole)))
    powers = rate_powers(window, p)
    if table.solver == "polynomial":
        q = polynomial_step(powers, n)
        return multiply(q, exponential(pair_sum(table.correction, window))) if any(map(any, table.correction)) else q
    return runge_kutta_step(powers, n) if table.solver == "runge-kutta-4" else magnus_step(powers, n)


def unit(q: Vector) -> Vector:
    """Return q / |q|."""
    norm = mp.sqrt(sum(x * x for x in q))
    return tuple(x / norm for x in q)


def runge_kutta_step(powers: Sequence[Vector], samples: int) -> Vector:
    """Return the classical Runge–Kutta step over ``samples`` intervals on a rate polynomial, normalised."""
    n = samples
    rates = [combination([(mp.mpf(n) * f) ** k for k in range(len(powers))], powers) for f in (0, mp.mpf(1) / 2, 1)]
    identity = (mp.mpf(1), mp.mpf(0), mp.mpf(0), mp.mpf(0))

    def slope(q: Vector, w: Vector) -> Vector:
        return tuple(n * x / 2 for x in multiply(q, (0, *w)))

    def moved(k: Vector, h: Any) -> Vector:
        return tuple(a + h * b for a, b in zip(identity, k, strict=True))

    k1 = slope(identity, rates[0])
    k2 = slope(moved(k1, mp.mpf(1) / 2), rates[1])
    k3 = slope(moved(k2, mp.mpf(1) / 2), rates[1])
    k4 = slope(moved(k3, 1), rates[2])
    return unit(tuple(o + (a + 2 * b + 2 * c + d) / 6 for o, a, b, c, d in zip(identity, k1, k2, k3, k4, strict=True)))


def magnus_step(powers: Sequence[Vector], samples: int) -> Vector:
    """Return the sixth-order Magnus step from the moments B_i = T⁻ⁱ ∫ (t − T/2)ⁱ w dt."""
    b0, b1, b2 = (combination(moment_weights(samples, i, mp.mp.dps), powers) for i in range(3))
    a1 = combination([mp.mpf(9) / 4, -15], [b0, b2])
    a2 = combination([12], [b1])
    a3 = combination([-15, 180], [b0, b2])
    c1 = combination([-1], [cross(a1, a2)])
    c2 = combination([mp.mpf(1) / 60], [cross(a1, combination([2, 1], [a3, c1]))])
    inner = combination([-1], [cross(combination([-20, -1, 1], [a1, a3, c1]), combination([1, 1], [a2, c2]))])
    return exponential(combination([1, mp.mpf(1) / 12, mp.mpf(1) / 240], [a1, a3, inner]))


@functools.cache
def moment_weights(samples: int, order: int, digits: int) -> tuple[Any, ...]:
    """Return T⁻ⁱ ∫ (t − T/2)ⁱ tᵏ dt for every power k, T = ``samples``; ``digits`` is the precision of the cached result."""
    half = mp.mpf(samples) / 2
    return tuple(
        mp.quad(lambda t, k=k: (t - half) ** order * t**k, [0, samples]) / mp.mpf(samples) ** order
        for k in range(samples)
    )


# ------------------------------------------------------------------------------------------------------ errors under coning


def coning_increments(angle: Any, ratio: Any, first: int, last: int) -> list[Vector]:
    """Return the increments of the coning of equation (18) over the sample intervals from ``first`` to ``last``, ratio λ = ωh."""

    def integral(k: int) -> Vector:
        return (mp.sin(angle) * mp.cos(ratio * k), mp.sin(angle) * mp.sin(ratio * k), (mp.cos(angle) - 1) * ratio * k)

    edges = [integral(k) for k in range(first, last + 1)]
    return [tuple(b - a for a, b in zip(u, v, strict=True)) for u, v in itertools.pairwise(edges)]


@dataclass(frozen=True, kw_only=True)
class ConingError:
    """Errors of an algorithm under continuous coning."""

    drift: Any
    """Drift about the cone's axis, in units of ω."""
    periodic: Any
    """Maximum angle of the error without the drift, rad."""


def exact_error(algorithm: str | Algorithm, angle: float, ratio: float, digits: int = DIGITS) -> ConingError:
    """Return the exact errors of an algorithm under coning of half-angle β rad at λ = ωh, in ``digits`` digits."""
    table = coning.named(algorithm)
    with mp.workdps(digits + 10):
        beta, lam = mp.mpf(angle), mp.mpf(ratio)
        first, last = -table.previous, table.samples + table.following
        window = coning_increments(beta, lam, first, last)
        turn = table.samples * lam
        about_z = (mp.cos(turn / 2), mp.mpf(0), mp.mpf(0), mp.sin(turn / 2))
        start = (mp.cos(beta / 2), mp.sin(beta / 2), mp.mpf(0), mp.mpf(0))
        back = (start[0], -start[1], mp.mpf(0), mp.mpf(0))
        fixed = multiply(exact_step(table, window), about_z)
        true = multiply(back, multiply(about_z, start))
        length = mp.sqrt(sum(x * x for x in fixed[1:]))
        true_length = mp.sqrt(sum(x * x for x in true[1:]))
        # sin and cos of the difference of the half angles, then of the axes.
        drift = 2 * mp.atan2(length * true[0] - fixed[0] * true_length, fixed[0] * true[0] + length * true_length)
        drift *= mp.sign(true[3])  # the axis of the rotation is reversed after an odd number of half rotations
        axis = cross(tuple(x / length for x in fixed[1:]), tuple(x / true_length for x in true[1:]))
        tilt = mp.sqrt(sum(x * x for x in axis))
        return ConingError(drift=+drift / turn, periodic=+2 * mp.asin(min(tilt, mp.mpf(1))))


# ------------------------------------------------------------------------------------------------------------- the question


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Exact errors of every algorithm over a grid of cone angles and frequency ratios, as lists (angle, ratio) by name."""

    angles: tuple[float, ...]
    """Half-angles of the cone, rad."""
    ratios: tuple[float, ...]
    drift: dict[str, list[list[float]]]
    """Drift in units of ω; zero below the smallest float."""
    periodic: dict[str, list[list[float]]]
    """Maximum periodic error, rad."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Comparison of one of the package's algorithms with the published ones at the points of the grid."""

    own: str
    points: int
    drift_lost: tuple[tuple[float, float, str], ...]
    """(angle in degrees, ratio, published algorithm) where a published drift is lower and the package's is above rounding."""
    periodic_lost: tuple[tuple[float, float, str], ...]
    worst_drift_ratio: float
    """Maximum ratio of its drift to the smallest published one, where its drift is above rounding."""
    worst_periodic_ratio: float


@dataclass(frozen=True, kw_only=True)
class Curves:
    """Drift against frequency ratio at one cone angle, and against cone angle at one ratio."""

    ratios: tuple[float, ...]
    small_angle: float
    large_angle: float
    drift_at_small_angle: dict[str, list[float]]
    drift_at_large_angle: dict[str, list[float]]
    angles: tuple[float, ...]
    ratio: float
    drift_by_angle: dict[str, list[float]]


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Cost and errors of an algorithm under one coning motion."""

    name: str
    nanoseconds: float
    """Time per sample on this machine, ns."""
    drift: float
    """Drift in units of ω."""
    periodic: float
    """Maximum periodic error, rad."""
    noise_gain: float
    """Factor of the increments' white noise in the attitude through the cross terms, per unit of rotation per sample."""


@dataclass(frozen=True, kw_only=True)
class ManoeuvreError:
    """Errors on random manoeuvres: maximum attitude error, rad, by algorithm; one entry per manoeuvre."""

    ratios: tuple[float, ...]
    """2π × the highest frequency of the manoeuvre × sample interval."""
    errors: dict[str, list[float]]


@dataclass(frozen=True, kw_only=True)
class Result:
    """Data of the figures."""

    comparison: Comparison
    verdicts: tuple[Verdict, ...]
    curves: Curves
    costs: tuple[Cost, ...]
    manoeuvres: ManoeuvreError


CURVES = (
    "one-sample",
    "two-sample",
    "three-sample",
    "four-sample",
    "eight-sample",
    "one-sample-previous-3",
    "runge-kutta-4",
    "magnus-6",
    "polynomial-4",
    "polynomial-8",
    "matched-4-11",
    "matched-1-8-8",
)


def compare(angles: Sequence[float], ratios: Sequence[float]) -> Comparison:
    """Return the exact errors of every published algorithm and of the package's own over the grid."""
    drift: dict[str, list[list[float]]] = {}
    periodic: dict[str, list[list[float]]] = {}
    for name in (*PUBLISHED, *OWN):
        errors = [[exact_error(name, angle, ratio) for ratio in ratios] for angle in angles]
        drift[name] = [[float(e.drift) for e in row] for row in errors]
        periodic[name] = [[float(e.periodic) for e in row] for row in errors]
    return Comparison(angles=tuple(angles), ratios=tuple(ratios), drift=drift, periodic=periodic)


def judge(comparison: Comparison, own: str) -> Verdict:
    """Return the points where ``own`` is neither better than every published algorithm nor at rounding."""
    samples = ALGORITHMS[own].samples
    lost: dict[str, list[tuple[float, float, str]]] = {"drift": [], "periodic": []}
    worst = {"drift": 0.0, "periodic": 0.0}
    for i, angle in enumerate(comparison.angles):
        for j, ratio in enumerate(comparison.ratios):
            for what, table, rounding in (
                ("drift", comparison.drift, ROUNDING / (samples * ratio)),
                ("periodic", comparison.periodic, ROUNDING),
            ):
                mine = abs(table[own][i][j])
                best = min(PUBLISHED, key=lambda name, table=table, i=i, j=j: abs(table[name][i][j]))
                theirs = abs(table[best][i][j])
                if mine > rounding:
                    worst[what] = max(worst[what], mine / theirs if theirs else math.inf)
                    if mine >= theirs:
                        lost[what].append((angle / DEGREE, ratio, best))
    return Verdict(
        own=own,
        points=len(comparison.angles) * len(comparison.ratios),
        drift_lost=tuple(lost["drift"]),
        periodic_lost=tuple(lost["periodic"]),
        worst_drift_ratio=worst["drift"],
        worst_periodic_ratio=worst["periodic"],
    )


def curves(
    ratios: Sequence[float], angles: Sequence[float], small_angle: float, large_angle: float, ratio: float
) -> Curves:
    """Return the curves of the figures."""

    def drifts(pairs: Sequence[tuple[float, float]]) -> dict[str, list[float]]:
        return {name: [abs(float(exact_error(name, a, r).drift)) for a, r in pairs] for name in CURVES}

    return Curves(
        ratios=tuple(ratios),
        small_angle=small_angle,
        large_angle=large_angle,
        drift_at_small_angle=drifts([(small_angle, r) for r in ratios]),
        drift_at_large_angle=drifts([(large_angle, r) for r in ratios]),
        angles=tuple(angles),
        ratio=ratio,
        drift_by_angle=drifts([(a, ratio) for a in angles]),
    )


def noise_gain(table: Algorithm) -> float:
    """Return the root sum of squares of Σ_j K_ij over the window, over √N: noise during a constant rotation of one unit per sample."""
    row = [float(sum(products)) for products in table.products]
    return math.sqrt(math.fsum(x * x for x in row) / table.samples)


def cost(name: str, angle: float, ratio: float, samples: int) -> Cost:
    """Return an algorithm's time per sample, minimum of several runs, with its errors."""
    table = ALGORITHMS[name]
    error = exact_error(name, angle, ratio)
    return Cost(
        name=name,
        nanoseconds=1e9 * coning.time_per_sample(table, samples),
        drift=abs(float(error.drift)),
        periodic=float(error.periodic),
        noise_gain=noise_gain(table),
    )


def manoeuvres(count: int, seed: int) -> ManoeuvreError:
    """Return errors on random manoeuvres: sums of harmonics on all axes, sampled at random ratios λ up to 0.8."""
    from strapdown.motion import Harmonic, HarmonicRates
    from strapdown.quaternion import conjugate, log, multiply

    generator = np.random.default_rng(seed)
    errors: dict[str, list[float]] = {name: [] for name in (*PUBLISHED, *OWN)}
    ratios = []
    for _ in range(count):
        ratio = float(10 ** generator.uniform(-1.3, -0.1))
        frequencies = np.append(generator.uniform(0.1, 0.9, 3), 1.0)
        harmonics = tuple(
            Harmonic(
                amplitude=tuple(generator.uniform(-0.6, 0.6, 3) * 2 * math.pi * f),
                frequency=float(f),
                phase=float(generator.uniform(0, 6)),
            )
            for f in frequencies
        )
        h = ratio / (2 * math.pi)
        edges = np.arange(840 + 1) * h
        truth = HarmonicRates(harmonics=harmonics, mean=tuple(generator.uniform(-0.5, 0.5, 3)))
        attitude, increments = truth.attitude(edges), truth.increments(edges)
        ratios.append(ratio)
        for name, norms in errors.items():
            n = ALGORITHMS[name].samples
            estimate = coning.integrate(increments, name, attitude[0])
            norms.append(float(np.linalg.norm(log(multiply(conjugate(estimate), attitude[::n])), axis=1).max()))
    return ManoeuvreError(ratios=tuple(ratios), errors=errors)


# --------------------------------------------------------------------------------------------------------------- the figures


def _look(k: int, name: str) -> dict[str, Any]:
    """Return the style of the line of algorithm k; the package's own are thick."""
    if name in OWN:
        return {"color": "k" if name == OWN[-1] else "0.5", "linewidth": 2.2}
    number = len(style.CYCLE)
    return {"color": style.CYCLE[k % number], "linewidth": 1.2, "linestyle": ("-", "--")[k // number % 2]}


def draw_drift(result: Curves, axes: Any) -> None:
    """Draw drift against frequency ratio at both cone angles; closed forms are dotted."""
    shown = np.asarray(result.ratios)
    for ax, table, angle in zip(
        axes,
        (result.drift_at_small_angle, result.drift_at_large_angle),
        (result.small_angle, result.large_angle),
        strict=True,
    ):
        for k, (name, drift) in enumerate(table.items()):
            ax.loglog(shown, drift, label=name, **_look(k, name))
            a = ALGORITHMS[name]
            leading = abs(float(a.drift_constant)) * angle**2 * shown**a.drift_order
            ax.loglog(shown, leading, color="0.6", lw=0.6, ls=":")
        ax.axhspan(1e-60, ROUNDING, color="0.9")
        ax.set(xlabel="frequency ratio λ = ωh", title=f"β = {angle / DEGREE:.3g}°", ylim=(1e-34, 1e-1))
    axes[0].set_ylabel("drift / ω   (dotted: closed form; grey: below rounding)")
    axes[1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def draw_floor(result: Curves, ax: Any) -> None:
    """Draw drift against cone angle: second-order forms deviate from β² towards a floor that grows as β⁴."""
    angles = np.asarray(result.angles) / DEGREE
    for k, (name, drift) in enumerate(result.drift_by_angle.items()):
        ax.loglog(angles, drift, label=name, **_look(k, name))
    ax.axhspan(1e-60, ROUNDING, color="0.9")
    ax.set(xlabel="cone half-angle β, °", ylabel="drift / ω", title=f"λ = {result.ratio:g}", ylim=(1e-30, 1e-2))
    ax.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def draw_costs(costs: Sequence[Cost], ax: Any) -> None:
    """Draw drift against time per sample, with the Pareto front."""
    front = [c for c in costs if not any(o.nanoseconds < c.nanoseconds and o.drift < c.drift for o in costs)]
    ax.loglog([c.nanoseconds for c in costs], [c.drift for c in costs], "o", color="0.7", ms=4, label="others")
    front.sort(key=lambda c: c.nanoseconds)
    ax.loglog(
        [c.nanoseconds for c in front],
        [c.drift for c in front],
        "o-",
        color=style.BLUE,
        ms=5,
        label="none is both faster and more accurate",
    )
    labelled: list[Cost] = []
    for c in front:  # labels that would overlap are omitted
        if all(abs(math.log10(c.drift / o.drift)) > 0.7 for o in labelled):
            ax.annotate(
                c.name, (c.nanoseconds, c.drift), fontsize=7, xytext=(-6, -3), textcoords="offset points", ha="right"
            )
            labelled.append(c)
    ax.set_xlim(left=1.0)
    ax.set(xlabel="time per sample, ns", ylabel="drift / ω", title="cost against error")
    ax.legend(fontsize=8, loc="lower left")


def draw_comparison(comparison: Comparison, own: str, axes: Any) -> None:
    """Draw the ratio of own error to the smallest published one over the grid: below zero own is better. Dot: rounding; cross: worse."""
    angles, ratios = np.asarray(comparison.angles) / DEGREE, np.asarray(comparison.ratios)
    for ax, table, what in zip(axes, (comparison.drift, comparison.periodic), ("drift", "periodic error"), strict=True):
        mine = np.abs(np.array(table[own]))
        best = np.min([np.abs(np.array(table[name])) for name in PUBLISHED], axis=0)
        rounding = ROUNDING / (ALGORITHMS[own].samples * ratios) if what == "drift" else np.full(len(ratios), ROUNDING)
        ratio = np.log10(np.maximum(mine, 1e-300) / np.maximum(best, 1e-300))
        ax.grid(visible=False)
        image = ax.imshow(ratio, cmap="RdBu_r", vmin=-6, vmax=6, origin="lower", aspect="auto")
        for i, j in np.argwhere(mine < rounding):
            ax.text(j, i, "·", ha="center", va="center", fontsize=16, color="0.65")
        for i, j in np.argwhere((mine >= best) & (mine >= rounding)):
            ax.text(j, i, "×", ha="center", va="center", fontsize=9)
        ax.set_xticks(range(len(ratios)), [f"{r:g}" for r in ratios], fontsize=7)
        ax.set_yticks(range(len(angles)), [f"{a:g}" for a in angles], fontsize=7)
        ax.set(xlabel="frequency ratio λ", ylabel="cone half-angle β, °", title=f"{own}: {what} (dots: rounding)")
        ax.figure.colorbar(image, ax=ax, label="log₁₀ (own / smallest published)")


def draw_manoeuvres(result: ManoeuvreError, ax: Any) -> None:
    """Draw the errors on random manoeuvres against their frequency ratio: published in grey, their best and the package's in colour."""
    ratios = np.asarray(result.ratios)
    published = np.array([result.errors[name] for name in PUBLISHED])
    for k, errors in enumerate(published):
        ax.loglog(ratios, errors, ".", color="0.75", ms=3, label=None if k else "each published")
    ax.loglog(ratios, published.min(axis=0), "v", color=style.ORANGE, ms=5, label="smallest published")
    for k, name in enumerate(OWN):
        ax.loglog(ratios, result.errors[name], "o", color=style.CYCLE[k] if k < 3 else "k", ms=3, label=name)
    ax.set(
        xlabel="frequency ratio λ of the highest frequency",
        ylabel="maximum attitude error, rad",
        title="random manoeuvres, 840 samples",
    )
    ax.legend(fontsize=8)


def draw(result: Result, folder: Path) -> list[Path]:
    """Write the figures into ``folder``; return their paths."""
    drift, axes = plots.new_figure(1, 2, size=(10.5, 5.0), sharey=True)
    draw_drift(result.curves, axes)
    floor, ax = plots.new_figure(size=(8.0, 5.0))
    draw_floor(result.curves, ax)
    cost, ax = plots.new_figure(size=(8.0, 5.0))
    draw_costs(result.costs, ax)
    comparison, axes = plots.new_figure(2, 2, size=(10.5, 8.0))
    for row, own in zip(axes, ("matched-4-11", "matched-1-8-8"), strict=True):
        draw_comparison(result.comparison, own, row)
    manoeuvres, ax = plots.new_figure(size=(8.0, 5.0))
    draw_manoeuvres(result.manoeuvres, ax)
    figures = {"drift": drift, "floor": floor, "cost": cost, "comparison": comparison, "manoeuvres": manoeuvres}
    return [plots.save(figure, folder / f"coning-{name}.png") for name, figure in figures.items()]


def main(*, out: str | Path | None = None, quick: bool = False, seed: int = 1) -> Result:
    """Run the study; with ``out``, write the figures and ``coning.json`` into that folder."""
    degrees = (1.0, 20.0) if quick else (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 20.0, 30.0, 45.0)
    ratios = (0.1, 0.5) if quick else (0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
    comparison = compare([d * DEGREE for d in degrees], ratios)
    result = Result(
        comparison=comparison,
        verdicts=tuple(judge(comparison, own) for own in OWN),
        curves=curves(
            np.geomspace(0.02, 1.0, 2 if quick else 25).tolist(),
            (np.geomspace(0.01, 45.0, 2 if quick else 25) * DEGREE).tolist(),
            0.1 * DEGREE,
            20.0 * DEGREE,
            0.2,
        ),
        costs=tuple(cost(name, 5.0 * DEGREE, 0.3, 840 if quick else 20160) for name in ALGORITHMS),
        manoeuvres=manoeuvres(3 if quick else 60, seed),
    )
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "coning.json", asdict(result))
        draw(result, folder)
    return result


def table(result: Result) -> str:
    """Return the verdicts as text."""
    lines = []
    for v in result.verdicts:
        lines.append(
            f"{v.own:15s} {v.points} points: drift worse at {len(v.drift_lost)} (maximum own/published {v.worst_drift_ratio:.2g}), "
            f"periodic error worse at {len(v.periodic_lost)} (maximum {v.worst_periodic_ratio:.2g})"
        )
        for what, places in (("drift", v.drift_lost), ("periodic", v.periodic_lost)):
            lines += [f"    {what}: β = {b:g}°, λ = {r:g}: {name}" for b, r, name in places]
    lines.append("")
    for c in sorted(result.costs, key=lambda c: c.drift):
        lines.append(
            f"{c.name:25s} {c.nanoseconds:8.1f} ns  drift {c.drift:9.2e}  periodic {c.periodic:9.2e}  noise {c.noise_gain:6.2f}"
        )
    m = result.manoeuvres
    best = np.min([m.errors[name] for name in PUBLISHED], axis=0)
    for own in OWN:
        mine = np.asarray(m.errors[own])
        won = np.sum((mine < best) | (mine < MANOEUVRE_ROUNDING))
        lines.append(
            f"random manoeuvres: {own} below every published, or below {MANOEUVRE_ROUNDING:g} rad, in {won} of {len(mine)}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/coning_algorithms"))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    print(table(main(out=arguments.out, quick=arguments.quick, seed=arguments.seed)))
