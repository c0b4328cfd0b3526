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
from strapdown.checks import Array
from strapdown.coning import ALGORITHMS, Algorithm
from strapdown.files import plain, write_json
from strapdown.plots import style
from strapdown.results import Table
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
    powers = rate_powers(window, p)
    if table.solver == "polynomial":
        q = polynomial_step(powers, n)
        return multiply(q, exponential(pair_sum(table.correction, window))) if any(map(any, table.correction)) else q
    return magnus_step(powers, n)


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
    """Exact errors of every algorithm over a grid of cone angles and frequency ratios."""

    angles: Array
    """Half-angles of the cone (a,), rad."""
    ratios: Array
    """Frequency ratios λ (r,)."""
    drift: dict[str, Array]
    """Magnitude of the drift (a, r) by algorithm, in units of ω; zero below the smallest float."""
    periodic: dict[str, Array]
    """Maximum periodic error (a, r), rad."""

    def against_published(self, own: str, what: str) -> tuple[Array, Array, np.ndarray]:
        """Return errors of an own algorithm, the smallest published ones, and where the own are rounding (a, r)."""
        errors = getattr(self, what)
        rounding = ROUNDING / (ALGORITHMS[own].samples * self.ratios) if what == "drift" else ROUNDING
        return errors[own], np.min([errors[name] for name in PUBLISHED], axis=0), errors[own] <= rounding


@dataclass(frozen=True, kw_only=True)
class Result:
    """Data of the figures."""

    comparison: Comparison
    costs: list[dict[str, Any]]
    """Time, errors under one coning motion, and noise gain of each algorithm."""
    ratios: list[float]
    """2π × the highest frequency of each random manoeuvre × sample interval."""
    manoeuvres: dict[str, list[float]]
    """Maximum attitude error of each manoeuvre, rad, by algorithm."""


def compare(angles: Sequence[float], ratios: Sequence[float]) -> Comparison:
    """Return the exact errors of every published algorithm and of the package's own over the grid."""
    errors = {
        name: [[exact_error(name, angle, ratio) for ratio in ratios] for angle in angles] for name in (*PUBLISHED, *OWN)
    }
    return Comparison(
        angles=np.array(angles),
        ratios=np.array(ratios),
        drift={name: np.array([[abs(float(e.drift)) for e in row] for row in rows]) for name, rows in errors.items()},
        periodic={name: np.array([[float(e.periodic) for e in row] for row in rows]) for name, rows in errors.items()},
    )


def lost(comparison: Comparison, own: str, what: str) -> list[str]:
    """Return the points where an own algorithm is above rounding and not below the smallest published error, with its algorithm."""
    mine, best, rounding = comparison.against_published(own, what)
    errors = getattr(comparison, what)
    return [
        f"{what}: β = {comparison.angles[i] / DEGREE:g}°, λ = {comparison.ratios[j]:g}: "
        + min(PUBLISHED, key=lambda name, i=i, j=j: errors[name][i, j])
        for i, j in np.argwhere((mine >= best) & ~rounding)
    ]


def worst_ratio(comparison: Comparison, own: str, what: str) -> float:
    """Return the maximum ratio of an own error to the smallest published one, where it is above rounding."""
    mine, best, rounding = comparison.against_published(own, what)
    with np.errstate(divide="ignore"):
        return float(np.max(np.where(rounding, 0.0, mine / best)))


def cost(name: str, angle: float, ratio: float, samples: int) -> dict[str, Any]:
    """Return the time per sample of an algorithm on this machine, its errors, and its noise gain.

    The noise gain is the factor of the increments' white noise in the attitude through the cross terms, during a constant rotation of one
    unit per sample: the root sum of squares of Σ_j K_ij over the window, over √N.
    """
    table, error = ALGORITHMS[name], exact_error(name, angle, ratio)
    row = [float(sum(products)) for products in table.products]
    return {
        "algorithm": name,
        "ns": 1e9 * coning.time_per_sample(table, samples),
        "drift": abs(float(error.drift)),
        "periodic_rad": float(error.periodic),
        "noise_gain": math.sqrt(math.fsum(x * x for x in row) / table.samples),
    }


def manoeuvres(count: int, seed: int) -> tuple[list[float], dict[str, list[float]]]:
    """Return ratios and errors of random manoeuvres: sums of harmonics on all axes, sampled at random ratios λ up to 0.8."""
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
        edges = np.arange(840 + 1) * (ratio / (2 * math.pi))
        truth = HarmonicRates(harmonics=harmonics, mean=tuple(generator.uniform(-0.5, 0.5, 3)))
        attitude, increments = truth.attitude(edges), truth.increments(edges)
        ratios.append(ratio)
        for name, norms in errors.items():
            n = ALGORITHMS[name].samples
            estimate = coning.integrate(increments, name, attitude[0])
            norms.append(float(np.linalg.norm(log(multiply(conjugate(estimate), attitude[::n])), axis=1).max()))
    return ratios, errors


# --------------------------------------------------------------------------------------------------------------- the figures


def draw_costs(costs: Sequence[dict[str, Any]], ax: Any) -> None:
    """Draw drift against time per sample, with the Pareto front."""
    front = [c for c in costs if not any(o["ns"] < c["ns"] and o["drift"] < c["drift"] for o in costs)]
    front.sort(key=lambda c: c["ns"])
    points = lambda rows: ([c["ns"] for c in rows], [c["drift"] for c in rows])  # noqa: E731
    ax.loglog(*points(costs), "o", color="0.7", ms=4, label="others")
    ax.loglog(*points(front), "o-", color=style.BLUE, ms=5, label="none is both faster and more accurate")
    last = 1e99
    for c in front:  # labels that would overlap are omitted
        if abs(math.log10(c["drift"] / last)) > 0.7:
            last, place = c["drift"], (c["ns"], c["drift"])
            ax.annotate(c["algorithm"], place, fontsize=7, xytext=(-6, -3), textcoords="offset points", ha="right")
    ax.set_xlim(left=1.0)
    ax.set(xlabel="time per sample, ns", ylabel="drift / ω", title="cost against error")
    ax.legend(fontsize=8, loc="lower left")


def draw_comparison(comparison: Comparison, own: str, axes: Any) -> None:
    """Draw the ratio of own error to the smallest published one over the grid: below zero own is better. Dot: rounding; cross: worse."""
    for ax, what, words in zip(axes, ("drift", "periodic"), ("drift", "periodic error"), strict=True):
        mine, best, rounding = comparison.against_published(own, what)
        ratio = np.log10(np.maximum(mine, 1e-300) / np.maximum(best, 1e-300))
        ax.grid(visible=False)
        image = ax.imshow(ratio, cmap="RdBu_r", vmin=-6, vmax=6, origin="lower", aspect="auto")
        for i, j in np.argwhere(rounding):
            ax.text(j, i, "·", ha="center", va="center", fontsize=16, color="0.65")
        for i, j in np.argwhere((mine >= best) & ~rounding):
            ax.text(j, i, "×", ha="center", va="center", fontsize=9)
        ax.set_xticks(range(len(comparison.ratios)), [f"{r:g}" for r in comparison.ratios], fontsize=7)
        ax.set_yticks(range(len(comparison.angles)), [f"{a / DEGREE:g}" for a in comparison.angles], fontsize=7)
        ax.set(xlabel="frequency ratio λ", ylabel="cone half-angle β, °", title=f"{own}: {words} (dots: rounding)")
        ax.figure.colorbar(image, ax=ax, label="log₁₀ (own / smallest published)")


def draw_manoeuvres(result: Result, ax: Any) -> None:
    """Draw the errors on random manoeuvres against their frequency ratio: published in grey, their best and the package's in colour."""
    published = np.array([result.manoeuvres[name] for name in PUBLISHED])
    for k, errors in enumerate(published):
        ax.loglog(result.ratios, errors, ".", color="0.75", ms=3, label=None if k else "each published")
    ax.loglog(result.ratios, published.min(axis=0), "v", color=style.ORANGE, ms=5, label="smallest published")
    for name, color in zip(OWN, (*style.CYCLE[:3], "k"), strict=True):
        ax.loglog(result.ratios, result.manoeuvres[name], "o", color=color, ms=3, label=name)
    ax.set(xlabel="frequency ratio λ of the highest frequency", ylabel="maximum attitude error, rad")
    ax.set_title("random manoeuvres, 840 samples")
    ax.legend(fontsize=8)


def draw(result: Result, folder: Path) -> None:
    """Write the figures into ``folder``."""
    cost, ax = plots.new_figure(size=(8.0, 5.0))
    draw_costs(result.costs, ax)
    comparison, axes = plots.new_figure(2, 2, size=(10.5, 8.0))
    for row, own in zip(axes, ("matched-4-11", "matched-1-8-8"), strict=True):
        draw_comparison(result.comparison, own, row)
    manoeuvres, ax = plots.new_figure(size=(8.0, 5.0))
    draw_manoeuvres(result, ax)
    for name, figure in (("cost", cost), ("comparison", comparison), ("manoeuvres", manoeuvres)):
        plots.save(figure, folder / f"coning-{name}.png")


def main(*, out: str | Path | None = None, quick: bool = False, seed: int = 1) -> Result:
    """Run the study; with ``out``, write the figures and ``coning.json`` into that folder."""
    degrees = (1.0, 20.0) if quick else (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 20.0, 30.0, 45.0)
    ratios = (0.1, 0.5) if quick else (0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
    names = list(ALGORITHMS)
    flown, errors = manoeuvres(3 if quick else 60, seed)
    result = Result(
        comparison=compare([d * DEGREE for d in degrees], ratios),
        costs=[cost(name, 5.0 * DEGREE, 0.3, 840 if quick else 20160) for name in names],
        ratios=flown,
        manoeuvres=errors,
    )
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "coning.json", plain(asdict(result)))
        draw(result, folder)
    return result


def table(result: Result) -> str:
    """Return costs and errors of each algorithm, and a summary of the package's own, as text."""
    lines = []
    for own in OWN:
        best = np.min([result.manoeuvres[name] for name in PUBLISHED], axis=0)
        mine = np.asarray(result.manoeuvres[own])
        won = np.sum((mine < best) | (mine < MANOEUVRE_ROUNDING))
        worse = {what: lost(result.comparison, own, what) for what in ("drift", "periodic")}
        counts = ", ".join(
            f"{what} worse at {len(places)} (maximum own/published {worst_ratio(result.comparison, own, what):.2g})"
            for what, places in worse.items()
        )
        lines.append(f"{own}, {result.comparison.drift[own].size} points: {counts}")
        lines.append(f"  best, or below {MANOEUVRE_ROUNDING:g} rad, in {won} of {len(mine)} random manoeuvres")
        lines += [f"    {place}" for places in worse.values() for place in places]
    columns = ("algorithm", "time, ns", "drift / ω", "periodic, rad", "noise gain")
    rows = [tuple(c.values()) for c in sorted(result.costs, key=lambda c: c["drift"])]
    return Table("Integration algorithms under coning of 5°, λ = 0.3", columns, rows, lines).text


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/coning_algorithms"))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    print(table(main(**vars(parser.parse_args()))))
