"""The coning study: effect of the commutation error on integration and on a filter.

Under coning motion, equation (18), the error of an integration algorithm is a constant rate along the cone's axis. A filter that estimates
gyro bias cannot distinguish that rate from a bias: its attitude is accurate, its bias is in error by the drift, and only the bias NEES
shows it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from strapdown import coning, quaternion
from strapdown.checks import InputError, count, positive
from strapdown.consistency import Judgement
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.montecarlo import engine
from strapdown.montecarlo.statistics import SUBSETS, Statistics
from strapdown.motion import Coning
from strapdown.results import Column, Table, counted
from strapdown.scenarios import Scenario
from strapdown.units import (
    ARCSECOND,
    DEGREE,
    DEGREE_PER_HOUR,
    DEGREE_PER_HOUR_PER_ROOT_HOUR,
    DEGREE_PER_ROOT_HOUR,
)
from strapdown.vectors import VectorSensor

__all__ = [
    "ConingParameters",
    "ConingStudy",
    "run",
]

ALGORITHMS = ("one-sample", "two-sample", "three-sample", "four-sample", "matched-4-11")
"""Integration algorithms that the study compares, by name in :data:`strapdown.coning.ALGORITHMS`."""

STEP_MULTIPLE = 12
"""The number of samples between measurements, and between epochs, is a multiple of this, so that they are at the ends of steps of 1, 2, 3,
4, 6 or 12 samples; for user-defined steps the least common multiple.

A coning-compensated step divided in its middle would be treated as a rotation at constant rate, which it is not under coning."""

MIN_SAMPLES_A_CYCLE = 0.1
"""Minimum number of gyro samples per cone cycle; with fewer, a step contains more than ten cycles and the results are meaningless."""
MAX_STEPS = 60_000
"""Maximum number of steps of a run in which a drift is measured."""
EPOCHS = 100
ANGLE_RANDOM_WALK, RATE_RANDOM_WALK = 0.08 * DEGREE_PER_ROOT_HOUR, 1.0 * DEGREE_PER_HOUR_PER_ROOT_HOUR
"""Noise of the gyro."""
DIRECTION_SIGMA = 20.0 * ARCSECOND
"""σ of each component of two measured directions, about once per second."""
ATTITUDE_SIGMA, BIAS_SIGMA = 200.0 * ARCSECOND, 20.0 * DEGREE_PER_HOUR
"""σ of the initial errors, each body axis."""
PROBABILITY = 0.99
"""Probability of all bounds for a consistent filter, the default of :class:`Statistics`."""


@dataclass(frozen=True, kw_only=True)
class ConingParameters:
    """Cone and Monte Carlo of the study, SI and radians. By default the gyro is sampled only ten times per coning cycle.

    Parameters
    ----------
    angle : float, default 0.7°
        Half-angle β of the cone, rad.
    frequency : float, default 10.0
        Coning frequency, Hz.
    rate : float, default 100.0
        Gyro sample rate, Hz.
    duration : float, default 240.0
        Duration of each run, s; rounded to whole epochs.
    runs : int, default 100
        Number of Monte Carlo runs.
    seed : int, default 1
        Seed of the Monte Carlo.
    own : tuple of Algorithm, default ()
        User-defined algorithms, compared with those of the package.
    """

    angle: float = 0.7 * DEGREE
    frequency: float = 10.0
    rate: float = 100.0
    duration: float = 240.0
    runs: int = 100
    seed: int = 1
    own: tuple[coning.Algorithm, ...] = ()

    def __post_init__(self) -> None:
        """Check every field."""
        angle = positive("angle", self.angle / DEGREE, unit="degrees")
        if angle >= 90.0:
            raise InputError(f"angle is {angle:g} degrees; the half-angle of a cone must be below 90 degrees")
        for name in ("frequency", "rate", "duration"):
            positive(name, getattr(self, name))
        if self.rate / self.frequency < MIN_SAMPLES_A_CYCLE:
            raise InputError(
                f"rate is {self.rate:g} Hz, {self.rate / self.frequency:.3g} samples per cone cycle at {self.frequency:g} Hz, too few for "
                f"any algorithm; raise the rate to at least {MIN_SAMPLES_A_CYCLE:g} samples per cycle"
            )
        count("runs", self.runs)
        count("seed", self.seed, minimum=0)
        names = [algorithm.name for algorithm in self.algorithms]
        if len(set(names)) < len(names):
            raise InputError(
                f"own has an algorithm whose name is already one of {', '.join(names)}; give it another name"
            )

    @property
    def algorithms(self) -> tuple[coning.Algorithm, ...]:
        """Algorithms compared: the package's (:data:`ALGORITHMS`), then ``own``."""
        return (*(coning.ALGORITHMS[name] for name in ALGORITHMS), *self.own)

    @property
    def step_multiple(self) -> int:
        """Least common multiple of :data:`STEP_MULTIPLE` and the steps of ``own``."""
        return math.lcm(STEP_MULTIPLE, *(algorithm.samples for algorithm in self.own))

    @property
    def samples(self) -> int:
        """Gyro samples in a run: the duration rounded to a multiple of ``EPOCHS`` times :attr:`step_multiple`."""
        block = EPOCHS * self.step_multiple
        return block * max(1, round(self.duration * self.rate / block))

    @property
    def measurement_interval(self) -> float:
        """Interval of the direction measurements, s: about one second, in whole steps."""
        return self.step_multiple * max(1, round(self.rate / self.step_multiple)) / self.rate

    @property
    def scenario(self) -> Scenario:
        """The motion and the sensors."""
        references = {"direction x": np.array([1.0, 0.0, 0.0]), "direction yz": np.array([0.0, 1.0, 1.0])}
        return Scenario(
            motion=Coning(angle=self.angle, frequency=self.frequency),
            gyro=GyroSpec(angle_random_walk=ANGLE_RANDOM_WALK, rate_random_walk=RATE_RANDOM_WALK),
            sensors=tuple(
                VectorSensor(name=name, reference_f=r, sigma=DIRECTION_SIGMA, rate=1.0 / self.measurement_interval)
                for name, r in references.items()
            ),
            rate=self.rate,
            duration=self.samples / self.rate,
        )


@dataclass(frozen=True, kw_only=True)
class Drift:
    """Drift of one integration algorithm, rad/s along the cone's axis: estimated minus true."""

    algorithm: str
    samples: int
    measured: float
    """Measured drift of a long noise-free run against the closed form."""
    predicted: float
    """Drift by the formula; NaN if it does not apply."""

    @classmethod
    def of(cls, algorithm: coning.Algorithm, motion: Coning, rate: float) -> Drift:
        """Return the drift of an algorithm under coning, sampled at a rate, Hz."""
        measured, predicted = (drift(motion, rate, algorithm) for drift in (measured_drift, predicted_drift))
        return cls(algorithm=algorithm.name, samples=algorithm.samples, measured=measured, predicted=predicted)


@dataclass(frozen=True, kw_only=True, eq=False)
class FilterOutcome:
    """Errors of the filter with one integration algorithm."""

    integration: str
    statistics: Statistics

    @functools.cached_property
    def judgement(self) -> Judgement:
        """Verdict on the filter, that of any Monte Carlo."""
        return self.statistics.judge()

    def summary(self) -> dict[str, Any]:
        """Return the outcome in degrees and hours, as in ``coning.json``. ANEES and NIS are per degree of freedom.

        RMS errors are over the judged epochs and axes; ``anees`` is the mean over the judged epochs and its bounds are those of one epoch.
        """
        statistics, epochs, verdict = self.statistics, self.statistics.judged_epochs, self.judgement.verdict
        nees = {subset: statistics.verdict(epochs, subset) for subset in SUBSETS}
        row: dict[str, Any] = {"integration": self.integration, "runs": statistics.runs}
        for what, values in (("rms", statistics.rms_error), ("sigma", statistics.sigma)):
            square = values[epochs] ** 2
            row[f"attitude_{what}_arcsec"] = float(np.sqrt(square[:, :3].mean()) / ARCSECOND)
            row[f"bias_{what}_deg_per_hour"] = float(np.sqrt(square[:, 3:].mean()) / DEGREE_PER_HOUR)
        for subset, part in nees.items():
            name = "anees" if subset == "state" else f"anees_{subset}"
            row |= {name: float(part.mean.mean()), f"{name}_bounds": list(part.bounds)}
        return {
            **row,
            "bias_mean_deg_per_hour": (statistics.mean_error[epochs, 3:].mean(axis=0) / DEGREE_PER_HOUR).tolist(),
            "epochs": len(epochs),
            "epochs_outside": {subset: part.outside for subset, part in nees.items()},
            "nis": statistics.mean_nis,
            "nis_bounds": list(statistics.nis_bounds()),
            "verdict": verdict,
            "consistent": verdict == "consistent",
        }


@dataclass(frozen=True, kw_only=True)
class ConingStudy:
    """Result of the study.

    Parameters
    ----------
    parameters : ConingParameters
        Parameters of the study.
    drifts : tuple of Drift
        Drift of each algorithm, measured and predicted, rad/s along the cone's axis.
    outcomes : tuple of FilterOutcome
        Statistics of the filter with each algorithm.
    """

    parameters: ConingParameters
    drifts: tuple[Drift, ...]
    outcomes: tuple[FilterOutcome, ...]

    def summary(self) -> dict[str, Any]:
        """Return the study as in ``coning.json``: degrees, hours, arcseconds, with the unit in each key.

        Returns
        -------
        dict
            Plain values for JSON: ``scenario``, ``integration`` (drifts), ``filter`` (outcomes), and ``own`` if there is any.
        """
        p = self.parameters
        return {
            "scenario": {
                "motion": "coning, equation (18)",
                "angle_deg": p.angle / DEGREE,
                "frequency_hz": p.frequency,
                "rate_hz": p.rate,
                "samples_per_cycle": p.rate / p.frequency,
                "duration_s": p.samples / p.rate,
                "runs": p.runs,
                "seed": p.seed,
                "angle_random_walk_deg_per_root_hour": ANGLE_RANDOM_WALK / DEGREE_PER_ROOT_HOUR,
                "rate_random_walk_deg_per_hour_per_root_hour": RATE_RANDOM_WALK / DEGREE_PER_HOUR_PER_ROOT_HOUR,
                "direction_sigma_arcsec": DIRECTION_SIGMA / ARCSECOND,
                "direction_interval_s": p.measurement_interval,
                "bounds_probability": PROBABILITY,
            },
            "integration": [
                {
                    "algorithm": drift.algorithm,
                    "samples": drift.samples,
                    "drift_deg_per_hour": drift.measured / DEGREE_PER_HOUR,
                    "predicted_deg_per_hour": None if np.isnan(drift.predicted) else drift.predicted / DEGREE_PER_HOUR,
                }
                for drift in self.drifts
            ],
            "filter": [outcome.summary() for outcome in self.outcomes],
            **({"own": [own_summary(algorithm) for algorithm in p.own]} if p.own else {}),
        }


ROUNDING = 1e-6
"""Drifts below this are rounding errors of the simulation, °/h."""


def _drift(value: float | None) -> str:
    if value is None:
        return "no formula"
    return f"{value:.4g}" if abs(value) > ROUNDING else "rounding"


def words(summary: Mapping[str, Any]) -> str:
    """Return the cone, the gyro and the runs of a study's :meth:`ConingStudy.summary` in words."""
    p = summary["scenario"]
    return (
        f"Coning of {p['angle_deg']:g}° at {p['frequency_hz']:g} Hz, gyro sampled at {p['rate_hz']:g} Hz ({p['samples_per_cycle']:.3g} "
        f"samples per cycle); {counted(p['runs'], 'run')} of {p['duration_s']:g} s, seed {p['seed']}"
    )


def tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return the tables of a study's :meth:`ConingStudy.summary`: one's own algorithms, if any, the drifts, and the filter with each.

    They are those of the terminal, the files and the report.
    """
    drifts = [
        Column("algorithm", "algorithm"),
        Column("samples", "samples"),
        Column("measured", "drift_deg_per_hour", shown=_drift),
        Column("predicted", "predicted_deg_per_hour", shown=_drift),
    ]
    filters = [
        Column("integration", "integration"),
        Column("attitude, arcsec", "attitude_rms_arcsec"),
        Column("σ", "attitude_sigma_arcsec"),
        Column("bias, °/h", "bias_rms_deg_per_hour"),
        Column("σ", "bias_sigma_deg_per_hour"),
        Column("mean z, °/h", "bias_mean_z_deg_per_hour", 3),
        Column("ANEES, attitude", "anees_attitude"),
        Column("ANEES, bias", "anees_bias"),
        Column("NIS", "nis"),
        Column("verdict", "verdict"),
    ]
    (low, high), (nis_low, nis_high) = (summary["filter"][0][f"{key}_bounds"] for key in ("anees_bias", "nis"))
    note = (
        "ANEES and NIS are per degree of freedom: 1 for a consistent filter. 99 % bounds: ANEES of attitude and of bias "
        f"{low:.3f} to {high:.3f} at one epoch, NIS {nis_low:.4f} to {nis_high:.4f}."
    )
    outcomes = [{**row, "bias_mean_z_deg_per_hour": row["bias_mean_deg_per_hour"][2]} for row in summary["filter"]]
    return [
        *_own_table(summary),
        _table("Drift of the integration, °/h about the cone's axis", drifts, summary["integration"], name="drift"),
        _table("The same filter with each algorithm: RMS error and its σ", filters, outcomes, (note,), name="filters"),
    ]


def _own_table(summary: Mapping[str, Any]) -> list[Table]:
    """Return the orders and drift constants of user-defined algorithms, with the best for their numbers of increments; none without any."""
    labels = ("algorithm", "samples", "order", "n", "C", "optimum n", "C for the same increments")
    keys = ("name", "samples", "order", "drift_order", "drift_constant", "best_drift_order", "best_drift_constant")
    columns = list(map(Column, labels, keys))
    samples, rows = {drift["algorithm"]: drift["samples"] for drift in summary["integration"]}, []
    for own in summary.get("own", ()):
        exact = f" = {own['drift_constant']}" if Fraction(own["drift_constant"]).denominator < SHOWN_DENOMINATOR else ""
        constant = f"{own['drift_constant_value']:.4g}{exact}"
        rows.append({**own, "samples": samples[own["name"]], "drift_constant": constant})
    title = "Your own algorithms: drift under small coning is −C β² ω (ωh)^n, derived from the coefficients"
    return [_table(title, columns, rows, name="own")] if rows else []


SHOWN_DENOMINATOR = 10**7
"""Drift constants with a smaller denominator are also shown as fractions."""


def _table(title: str, columns: list[Column], rows: Sequence[Any], notes: Sequence[str] = (), *, name: str) -> Table:
    return Table(title, columns, [[row[column.key] for column in columns] for row in rows], notes, name=name)


def own_summary(algorithm: coning.Algorithm) -> dict[str, Any]:
    """Return properties of the coefficients of a user-defined algorithm, with the best possible for its number of increments.

    ``drift_constant`` is C of the leading drift −C β² ω λ^``drift_order``, as a fraction and as a number. The best has drift order 2M and
    the constant (M!)²/(2 (2M+1)!), where M is the number of increments in the window.
    """
    m = algorithm.window
    return {
        **algorithm.to_table(),
        "order": algorithm.order,
        "drift_order": algorithm.drift_order,
        "drift_constant": str(algorithm.drift_constant),
        "drift_constant_value": float(algorithm.drift_constant),
        "best_drift_order": 2 * m,
        "best_drift_constant": math.factorial(m) ** 2 / (2.0 * math.factorial(2 * m + 1)),
    }


def predicted_drift(motion: Coning, rate: float, algorithm: coning.Algorithm) -> float:
    """Return the theoretical drift, rad/s along the cone's axis.

    For one sample per step at any λ; otherwise the full power series of the part in β², which begins with ``−c_M β² ω λ^{2M}``, λ = ω/rate.
    The term in β⁴ of rotation-vector forms is neglected. NaN where the series does not apply, λ > 1.
    """
    ratio = 2.0 * np.pi * motion.frequency / rate
    if algorithm.name == "one-sample":
        return coning.predicted_coning_drift(algorithm, motion.angle, motion.frequency, 1.0 / rate)
    if ratio > 1.0:
        return float("nan")
    return motion.angle**2 * 2.0 * np.pi * motion.frequency * coning.small_angle_drift(algorithm, ratio)


def measured_drift(motion: Coning, rate: float, algorithm: coning.Algorithm) -> float:
    """Return the drift of noise-free integration against the closed form, rad/s along the cone's axis: estimated minus true.

    Drift rotates the estimate about the fixed z axis at a constant rate. The run ends where coning cycles and steps most nearly coincide,
    so that the periodic error cancels, or earlier if the estimate would rotate by more than a radian.
    """
    expected = abs(coning.predicted_coning_drift(algorithm, motion.angle, motion.frequency, 1.0 / rate))
    step = algorithm.samples / rate
    longest = int(min(MAX_STEPS, max(1.0 / (expected * step), 100.0))) if expected > 0.0 else MAX_STEPS
    cycles = np.arange(longest // 2, longest + 1) * (step * motion.frequency)
    steps = longest // 2 + int(np.argmin(np.abs(cycles - np.round(cycles))))
    edges = np.arange(steps * algorithm.samples + 1) / rate
    estimate = coning.integrate(motion.increments(edges), algorithm, motion.attitude(0.0))[-1]
    error_f = quaternion.log(quaternion.multiply(estimate, quaternion.conjugate(motion.attitude(edges[-1]))))
    return float(error_f[2] / edges[-1])


def run(parameters: ConingParameters, *, progress: Callable[[int], None] | None = None) -> ConingStudy:
    """Run the coning study: drift of each algorithm, and the same filter with each.

    Parameters
    ----------
    parameters : ConingParameters
        Cone, gyro, filter and Monte Carlo.
    progress : callable, optional
        Called with the number of Monte Carlo runs just finished.

    Returns
    -------
    ConingStudy
        Drift of each algorithm, and statistics of the filter with it over the same runs.

    References
    ----------
    P. G. Savage, Strapdown inertial navigation integration algorithm design part 1: attitude algorithms, J. Guidance, Control, and
    Dynamics 21(1), 1998.
    """
    algorithms = parameters.algorithms
    motion = Coning(angle=parameters.angle, frequency=parameters.frequency)
    drifts = tuple(Drift.of(algorithm, motion, parameters.rate) for algorithm in algorithms)
    noise = ProcessNoise(angle_random_walk=ANGLE_RANDOM_WALK, rate_random_walk=RATE_RANDOM_WALK)
    base = FilterSetup(process_noise=noise, attitude_sigma=ATTITUDE_SIGMA, bias_sigma=BIAS_SIGMA)
    setups = [replace(base, integration=algorithm) for algorithm in algorithms]
    statistics = engine.run(
        parameters.scenario, setups, runs=parameters.runs, seed=parameters.seed, epochs=EPOCHS, progress=progress
    )
    outcomes = tuple(
        FilterOutcome(integration=algorithm.name, statistics=part)
        for algorithm, part in zip(algorithms, statistics, strict=True)
    )
    return ConingStudy(parameters=parameters, drifts=drifts, outcomes=outcomes)
