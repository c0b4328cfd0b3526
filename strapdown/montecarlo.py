"""Monte Carlo: many independent runs of one scenario through one filter, and sums over runs at each epoch.

Memory grows with the number of epochs, not with the number of runs: runs are taken in chunks, each chunk's sums are kept, and the
chunks are merged in their order, so the statistics do not depend on the number of threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from strapdown import coning, consistency, mekf, quaternion
from strapdown.checks import Array, InputError, count
from strapdown.consistency import Verdict
from strapdown.mekf import ProcessNoise
from strapdown.randomness import generator
from strapdown.records import ImuRecord, compress
from strapdown.scenarios import Scenario, simulate

EXAMPLES = 8
"""Runs of which whole error histories are kept, for pictures."""


@dataclass(frozen=True, kw_only=True)
class FilterSetup:
    """How the filter is set up in each run: what it believes, where it starts, what integrates the gyro."""

    process_noise: ProcessNoise
    attitude_sigma: float
    """Standard deviation of the initial attitude error, each axis, rad; the true error is drawn from it."""
    bias_sigma: float
    """Standard deviation of the initial bias error, each axis, rad/s; the true error is drawn from it."""
    integration: coning.Algorithm
    """Coning algorithm that turns its N gyro samples into one filter step."""
    measurement_sigma_factor: float = 1.0
    """What the filter takes each sensor's σ for, as a multiple of the true one."""


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """Sums over independent runs at each epoch, and the first few runs in full.

    Errors are e = (δθ, δb): rad in the body frame, rad/s.
    """

    time: Array
    """Epochs (m,), s."""
    runs: int
    error_sum: Array
    """Σ e (m, 6)."""
    error_square_sum: Array
    """Σ e² (m, 6)."""
    variance_sum: Array
    """Σ diag P (m, 6)."""
    nees_sum: Array
    """Σ NEES of (all six states, attitude, bias) (m, 3)."""
    example_error: Array
    """Errors of the first few runs (k, m, 6)."""
    example_sigma: Array
    """The filter's own standard deviations in those runs (k, m, 6)."""
    nis_time: Array
    """Times of the NIS bins, s (k,)."""
    nis_sum: Array
    """Σ over runs of the NIS summed over each bin (k,)."""
    nis_degrees: Array
    """Degrees of freedom in each bin of one run (k,)."""

    @property
    def mean_error(self) -> Array:
        """Mean error at each epoch (m, 6)."""
        return np.asarray(self.error_sum / self.runs)

    @property
    def rms_error(self) -> Array:
        """Root mean square error at each epoch (m, 6)."""
        return np.asarray(np.sqrt(self.error_square_sum / self.runs))

    @property
    def sigma(self) -> Array:
        """The filter's own standard deviation, root mean over runs (m, 6)."""
        return np.asarray(np.sqrt(self.variance_sum / self.runs))

    @property
    def anees(self) -> Array:
        """NEES averaged over runs and states (m, 3): of all six states, attitude, bias; 1 for a right filter."""
        return np.asarray(self.nees_sum / (self.runs * np.array([6.0, 3.0, 3.0])))

    @property
    def nis(self) -> Array:
        """NIS per degree of freedom, averaged over runs and over each bin (k,); 1 for a right filter, NaN where nothing was measured."""
        seen = self.nis_degrees > 0.0
        return np.asarray(np.where(seen, self.nis_sum / (self.runs * np.where(seen, self.nis_degrees, 1.0)), np.nan))

    @property
    def mean_nis(self) -> float:
        """NIS per degree of freedom over the whole time and all runs; innovations of a right filter are white, so no epochs are needed."""
        return float(self.nis_sum.sum() / (self.runs * self.nis_degrees.sum()))

    def nis_bounds(self, probability: float = 0.99) -> tuple[float, float]:
        """Return two-sided bounds of :attr:`mean_nis`."""
        return consistency.mean_bounds(1, round(self.runs * self.nis_degrees.sum()), probability)

    def verdict(self, epochs: Array, subset: str = "state", probability: float = 0.99) -> Verdict:
        """Return the two-sided χ² verdict on ``subset`` ("state", "attitude" or "bias") at the epochs of the given indices."""
        column, degrees = {"state": (0, 6), "attitude": (1, 3), "bias": (2, 3)}[subset]
        return Verdict(mean=self.anees[epochs, column], degrees=degrees, runs=self.runs, probability=probability)


@dataclass(frozen=True, kw_only=True)
class _Run:
    error: Array
    variance: Array
    nees: Array
    nis_sum: Array
    nis_degrees: Array


def start(record: ImuRecord, setup: FilterSetup, seed: int, run: int) -> mekf.State:
    """Return the initial state of one run: the truth, off by errors drawn from the filter's own prior."""
    if record.truth is None:
        raise InputError("record has no truth to start from; simulate one, or give an initial state to mekf.run")
    draw = generator(seed, run, "initial error").standard_normal(6)
    attitude = quaternion.multiply(record.truth.attitude[0], quaternion.exp(-setup.attitude_sigma * draw[:3]))
    return mekf.initial_state(
        attitude,
        attitude_sigma=setup.attitude_sigma,
        bias_sigma=setup.bias_sigma,
        bias=record.truth.bias[0] - setup.bias_sigma * draw[3:],
    )


def run(
    scenario: Scenario,
    setups: tuple[FilterSetup, ...],
    *,
    runs: int,
    seed: int,
    epochs: int = 100,
    nis_bins: int = 100,
    chunk: int = 10,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Statistics]:
    """Return the statistics of ``runs`` independent runs for each filter setup, all fed the same sensor data.

    Parameters
    ----------
    scenario : Scenario
    setups : tuple of FilterSetup
    runs, seed : int
        Run k of one seed is the same whatever the number of runs, chunks or threads.
    epochs : int
        Number of equally spaced epochs at which errors and NEES are summed, besides the start.
    nis_bins : int
        Number of equal spans of time over which NIS is summed.
    chunk : int
        Runs between merges; the statistics depend on it by rounding only.
    threads : int, optional
        Default: one a core.
    progress : callable, optional
        Called with the number of runs just finished.
    """
    count("runs", runs)
    count("chunk", chunk)
    samples = len(scenario.edges) - 1
    for setup in setups:
        if samples % (epochs * setup.integration.samples):
            raise InputError(
                f"{samples} gyro samples cannot be cut into {epochs} epochs of whole {setup.integration.name} steps; choose a "
                f"duration whose sample count is a multiple of {epochs * setup.integration.samples}"
            )

    def one_chunk(numbers: range) -> list[list[_Run]]:
        return [_one_run(scenario, setups, seed, number, epochs, nis_bins) for number in numbers]

    chunks = [range(first, min(first + chunk, runs)) for first in range(0, runs, chunk)]
    sums: list[list[Array]] = [[] for _ in setups]
    examples: list[list[_Run]] = [[] for _ in setups]
    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        try:
            for numbers, results in zip(chunks, _in_order(pool, one_chunk, chunks), strict=True):
                for setup_sums, kept, part in zip(sums, examples, zip(*results, strict=True), strict=True):
                    _merge(setup_sums, part)
                    kept.extend(part[: EXAMPLES - len(kept)])
                if progress is not None:
                    progress(len(numbers))
        except BaseException:  # Ctrl-C too: drop what has not started
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    time = np.linspace(scenario.edges[0], scenario.edges[-1], epochs + 1)
    bins = np.linspace(scenario.edges[0], scenario.edges[-1], nis_bins + 1)
    return [
        Statistics(
            time=time,
            runs=runs,
            error_sum=total[0],
            error_square_sum=total[1],
            variance_sum=total[2],
            nees_sum=total[3],
            example_error=np.stack([one.error for one in example]),
            example_sigma=np.sqrt([one.variance for one in example]),
            nis_time=0.5 * (bins[1:] + bins[:-1]),
            nis_sum=total[4],
            nis_degrees=total[5] / runs,
        )
        for total, example in zip(sums, examples, strict=True)
    ]


def _in_order(
    pool: ThreadPoolExecutor, work: Callable[[range], list[list[_Run]]], chunks: list[range]
) -> Iterator[list[list[_Run]]]:
    futures = [pool.submit(work, numbers) for numbers in chunks]
    for k, future in enumerate(futures):
        yield future.result()
        futures[k] = None  # type: ignore[call-overload]  # the sums are merged: let the runs go


def _merge(sums: list[Array], part: Sequence[_Run]) -> None:
    totals = [
        np.sum([run.error for run in part], axis=0),
        np.sum([run.error**2 for run in part], axis=0),
        np.sum([run.variance for run in part], axis=0),
        np.sum([run.nees for run in part], axis=0),
        np.sum([run.nis_sum for run in part], axis=0),
        np.sum([run.nis_degrees for run in part], axis=0),
    ]
    sums[:] = totals if not sums else [a + b for a, b in zip(sums, totals, strict=True)]


def _one_run(
    scenario: Scenario, setups: tuple[FilterSetup, ...], seed: int, number: int, epochs: int, nis_bins: int
) -> list[_Run]:
    record = simulate(scenario, seed, number)
    return [_filtered(record, setup, seed, number, epochs, nis_bins) for setup in setups]


def _filtered(record: ImuRecord, setup: FilterSetup, seed: int, number: int, epochs: int, nis_bins: int) -> _Run:
    believed = compress(record, setup.integration)
    if setup.measurement_sigma_factor != 1.0:
        vectors = tuple(series.noise_scaled(setup.measurement_sigma_factor) for series in record.vectors)
        believed = replace(believed, vectors=vectors)
    every = len(believed.increments) // epochs
    estimate = mekf.run(
        believed, setup.process_noise, start(record, setup, seed, number), every=every, full_covariance=True
    )
    assert believed.truth is not None
    assert estimate.covariance is not None
    truth = believed.truth
    error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude[::every], truth.bias[::every])
    P = estimate.covariance
    nees = np.stack(
        [
            consistency.nees(error, P),
            consistency.nees(error[:, :3], P[:, :3, :3]),
            consistency.nees(error[:, 3:], P[:, 3:, 3:]),
        ],
        axis=-1,
    )
    bins = np.linspace(record.time[0], record.time[-1], nis_bins + 1)
    nis, degrees = np.zeros(nis_bins), np.zeros(nis_bins)
    for innovations in estimate.innovations.values():
        # A measurement on a bin's edge belongs to the bin that it ends.
        place = np.clip(np.searchsorted(bins, innovations.time, side="left") - 1, 0, nis_bins - 1)
        nis += np.bincount(place, weights=innovations.nis, minlength=nis_bins)
        degrees += np.bincount(place, minlength=nis_bins) * innovations.innovation.shape[1]
    return _Run(error=error, variance=estimate.variance, nees=nees, nis_sum=nis, nis_degrees=degrees)
