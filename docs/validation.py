"""Run the package against published figures and write ``docs/_data/validation.json``, which the page *Validation* prints.

    python docs/validation.py [--runs 100]

Only the published figures are written by hand, each beside its source; everything else is what the runs gave. It takes about a minute.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import strapdown  # noqa: E402
from sims.coning_algorithms import exact_error  # noqa: E402
from strapdown import allan, coning, consistency, estimation, motion, quaternion  # noqa: E402
from strapdown.montecarlo import coning_study  # noqa: E402
from strapdown.records import ImuRecord  # noqa: E402
from strapdown.units import DEGREE, DEGREE_PER_HOUR  # noqa: E402
from strapdown.vectors import VectorMeasurements  # noqa: E402

OUT = ROOT / "docs" / "_data" / "validation.json"

MILLER = "Miller 1983, J. Guidance 6(4)"
LEE = "Lee, Mark, Tazartes & Yoon 1990, J. Guidance 13(4)"
IGNAGNI = "Ignagni 1996, J. Guidance 19(2)"
COEFFICIENTS = {
    "two-sample": ("2/3", MILLER),
    "three-sample": ("27/20 9/20", MILLER),
    "four-sample": ("214/105 92/105 54/105", LEE),
    "five-sample": ("1375/504 650/504 525/504 250/504", IGNAGNI),
    "one-sample-previous-1": ("1/12", IGNAGNI),
    "one-sample-previous-2": ("7/60 -1/60", IGNAGNI),
    "one-sample-previous-3": ("113/840 -13/420 1/280", IGNAGNI),
}
"""Coefficients of the compressed forms, of the increments counted back from the last."""

NBS14 = "NBS Monograph 140, annex 8.E; NIST SP 1065 (Riley 2008), section 12.4"
NBS1000 = "1000-point set of NIST SP 1065 (Riley 2008), section 12.4"
NINE_POINTS = [892.0, 809.0, 823.0, 798.0, 671.0, 644.0, 883.0, 903.0, 677.0]
ALLAN = {
    "nine points": ([1, 2], [91.22945, 85.95287], NBS14),
    "1000 points": ([1, 10, 100], [2.922319e-01, 9.159953e-02, 3.241343e-02], NBS1000),
}
UKFM = {
    "source": "Brossard, Barrau & Bonnabel, UKF-M (ICRA 2020), documentation, 3D Attitude Estimation - Benchmark",
    "rmse_deg": {"left UKF": 1.09, "right UKF": 1.09, "EKF": 1.09},
    "nees": {"left UKF": 1.01, "right UKF": 1.00, "EKF": 1.01},
    "runs": 100,
}


def coefficients() -> list[dict[str, Any]]:
    """Return the coefficients of the package's tables beside published ones."""
    return [
        {
            "algorithm": name,
            "published": published,
            "ours": " ".join(str(c) for c in coning.ALGORITHMS[name].coefficients),
            "equal": [Fraction(c) for c in published.split()] == list(coning.ALGORITHMS[name].coefficients),
            "source": source,
        }
        for name, (published, source) in COEFFICIENTS.items()
    ]


def coning_drift() -> dict[str, Any]:
    """Return the drift under coning: published leading term, 50-digit arithmetic, and integration by this package."""
    cone, rate = motion.Coning(angle=0.7 * DEGREE, frequency=10.0), 100.0
    omega = 2.0 * np.pi * cone.frequency
    names = ["one-sample", "two-sample", "three-sample", "four-sample"]
    names += [f"one-sample-previous-{p}" for p in (1, 2, 3)] + ["polynomial-4", "matched-2-8", "matched-1-8-8"]
    rows = []
    for name in names:
        table = coning.ALGORITHMS[name]
        exact = float(exact_error(name, cone.angle, omega / rate, digits=30).drift) * omega
        rows.append(
            {
                "algorithm": name,
                "source": table.source,
                "leading_term": coning.predicted_coning_drift(table, cone.angle, cone.frequency, 1.0 / rate),
                "exact": exact,
                "ours": coning_study.measured_drift(cone, rate, table),
            }
        )
    for row in rows:
        for key in ("leading_term", "exact", "ours"):
            row[f"{key}_deg_per_h"] = row.pop(key) / DEGREE_PER_HOUR
    return {"angle_deg": 0.7, "frequency_hz": 10.0, "rate_hz": rate, "rows": rows}


def farrenkopf() -> list[dict[str, Any]]:
    """Return the steady state of one axis at rest: closed form and the filter's own covariance after the last update."""
    rows = []
    for sigma_v, sigma_u, sigma, dt in ((3e-5, 1e-6, 1e-4, 1.0), (1e-6, 1e-9, 5e-5, 0.1), (4e-4, 5e-7, 1e-3, 10.0)):
        steps = 200_000
        time = dt * np.arange(steps + 1)
        fixed = np.array([1.0, 0.0, 0.0])
        measured = VectorMeasurements(
            sensor="x",
            kind="direction",
            time=time[1:],
            vector_b=np.tile(fixed, (steps, 1)),
            reference_f=fixed,
            sigma=sigma,
        )
        record = ImuRecord(time=time, increments=np.zeros((steps, 3)), vectors=(measured,))
        noise = estimation.ProcessNoise(angle_random_walk=sigma_v, rate_random_walk=sigma_u)
        start = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-2, bias_sigma=1e-4)
        P = estimation.run(record, noise, start, every=steps, full_covariance=True).covariance[-1]
        s_u, s_v = sigma_u * dt**1.5 / sigma, sigma_v * dt**0.5 / sigma
        gamma = np.sqrt(1.0 + s_v**2 / 4.0 + s_u**2 / 48.0)
        zeta = gamma + s_u / 4.0 + 0.5 * np.sqrt(2.0 * gamma * s_u + s_v**2 + s_u**2 / 3.0)
        closed = {
            "attitude": sigma**2 * (1.0 - zeta**-2),
            "bias": sigma_u * sigma / dt**0.5 * (zeta - 1.0 / zeta) - 0.5 * sigma_u**2 * dt,
        }
        for name, k in (("attitude", 2), ("bias", 5)):
            rows.append(
                {
                    "sigma_v": sigma_v,
                    "sigma_u": sigma_u,
                    "sigma_n": sigma,
                    "interval": dt,
                    "quantity": name,
                    "published": float(np.sqrt(closed[name])),
                    "ours": float(np.sqrt(P[k, k])),
                }
            )
    return rows


def allan_values() -> list[dict[str, Any]]:
    """Return the Allan deviations of the two published data sets."""
    thousand = [1234567890]
    while len(thousand) < 1000:
        thousand.append(16807 * thousand[-1] % 2147483647)
    data = {"nine points": np.array(NINE_POINTS), "1000 points": np.array(thousand) / 2147483647.0}
    rows = []
    for name, (multiples, published, source) in ALLAN.items():
        taus = [float(m) for m in multiples]
        deviation = allan.allan_deviation(data[name], 1.0, taus=taus).deviation[0]
        rows += [
            {"data": name, "tau": tau, "published": value, "ours": float(ours), "source": source}
            for tau, value, ours in zip(taus, published, deviation, strict=True)
        ]
    return rows


def ukfm(runs: int) -> dict[str, Any]:
    """Return the attitude benchmark of UKF-M: RMSE an axis over all samples, and NEES a degree of freedom, of ``runs`` runs.

    Two seconds at rest and then 10 °/s about the vertical, 100 s at 100 Hz; white noise a sample of 5 °/s in the gyro, 0.4 m/s² in the
    accelerometer and 0.3 in the magnetometer. The published script starts its filters at the truth with σ 10°, and counts as the first
    sample a start drawn with σ 10°; so do we. ``drawn`` starts at that draw instead.
    """
    n, dt = 10_000, 0.01
    references = {"accelerometer": np.array([0.0, 0.0, -9.82]), "magnetometer": np.array([0.33, 0.0, -0.95])}
    sigmas = {"accelerometer": 0.4, "magnetometer": 0.3}
    time = dt * np.arange(n)
    rate = np.zeros((n - 1, 3))
    rate[time[:-1] > 2.0, 2] = 10.0 * DEGREE
    angle = np.concatenate([[0.0], np.cumsum(rate[:, 2]) * dt])
    truth = quaternion.exp(np.stack([np.zeros(n), np.zeros(n), angle], axis=1))
    noise = estimation.ProcessNoise(angle_random_walk=5.0 * DEGREE * np.sqrt(dt), rate_random_walk=0.0)
    square, nees = {"truth": [], "drawn": []}, {"truth": [], "drawn": []}
    for run in range(runs):
        draw = np.random.default_rng([20260, run])
        increments = dt * (rate + 5.0 * DEGREE * draw.standard_normal((n - 1, 3)))
        series = tuple(
            VectorMeasurements(
                sensor=name,
                kind="vector",
                time=time[1:],
                vector_b=quaternion.rotate(quaternion.conjugate(truth[1:]), r)
                + sigmas[name] * draw.standard_normal((n - 1, 3)),
                reference_f=r,
                sigma=sigmas[name],
            )
            for name, r in references.items()
        )
        record = ImuRecord(time=time, increments=increments, vectors=series)
        drawn = quaternion.exp(10.0 * DEGREE * draw.standard_normal(3))
        for name, attitude in (("truth", truth[0]), ("drawn", drawn)):
            start = estimation.initial_state(attitude, attitude_sigma=10.0 * DEGREE, bias_sigma=1e-9)
            estimate = estimation.run(record, noise, start, full_covariance=True)
            e = quaternion.log(quaternion.multiply(quaternion.conjugate(estimate.attitude), truth))
            e[0] = quaternion.log(quaternion.conjugate(drawn))
            square[name].append(np.mean(e**2))
            assert estimate.covariance is not None
            nees[name].append(np.mean(consistency.nees(e[1:], estimate.covariance[1:, :3, :3])) / 3.0)
    return {
        **UKFM,
        "our_runs": runs,
        "ours": {
            name: {
                "rmse_deg": float(np.sqrt(np.mean(square[name])) / DEGREE),
                "rmse_error_deg": float(0.5 * np.std(square[name]) / np.sqrt(runs * np.mean(square[name])) / DEGREE),
                "nees": float(np.mean(nees[name])),
                "nees_error": float(np.std(nees[name]) / np.sqrt(runs)),
            }
            for name in square
        },
    }


def main(runs: int = 100, out: Path = OUT) -> dict[str, Any]:
    """Run everything and write it to ``out``."""
    result = {
        "version": strapdown.__version__,
        "date": datetime.date.today().isoformat(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "coefficients": coefficients(),
        "coning_drift": coning_drift(),
        "farrenkopf": farrenkopf(),
        "allan": allan_values(),
        "ukfm": ukfm(runs),
    }
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100, help="of the attitude benchmark")
    main(**vars(parser.parse_args()))
