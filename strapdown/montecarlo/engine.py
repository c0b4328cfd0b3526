"""Running a plan: choosing the machine, chunks in threads, merging in the order of the runs."""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from typing import Any, NamedTuple, TypeVar

import numpy as np

import strapdown
from strapdown.checks import InputError, count, one_of
from strapdown.estimation.setup import FilterSetup
from strapdown.montecarlo import lanes, scalar
from strapdown.montecarlo.plan import Dispersions, Plan, dispersed
from strapdown.montecarlo.statistics import Replay, Statistics, merge
from strapdown.records import Origin
from strapdown.scenarios import Scenario

Parts = tuple[Statistics, ...]
"""Statistics of the same runs, one per plan."""

MACHINES: dict[str, Any] = {lanes.NAME: lanes, scalar.NAME: scalar}
"""Machines by name, the fast one first. Each is a module with

``NAME``, ``CHUNK``
    Its name in files and tables; its default number of runs per chunk.
``run_chunk(plan, first_run, runs) -> Statistics``, ``replay(plan, run) -> Replay``
    Sums over these runs in an order that depends only on ``first_run`` and ``runs``; one run in full detail. Both may be called in several
    threads, and run k is the same to the bit in any chunk, thread, vector width and host.
"""

AHEAD = 4
"""Maximum number of chunks per worker that are submitted and not yet merged; bounds the memory."""


class Choice(NamedTuple):
    """The machine that computes a plan, and the reason for not using a faster one."""

    machine: str
    reason: str = ""
    """Terms that the lanes do not cover; empty if they cover all, or if the machine was given."""

    def __str__(self) -> str:
        """Return the choice as one line."""
        return f"{self.machine} (lanes do not cover {self.reason})" if self.reason else self.machine


def choose(plan: Plan, machine: str = "auto") -> Choice:
    """Return the machine that computes a plan: the lanes if they cover all its terms, else the scalar one.

    The choice depends only on the plan, because the machines draw different noise.
    """
    one_of("machine", machine, ("auto", *MACHINES))
    if machine == scalar.NAME:
        return Choice(scalar.NAME)
    reason = lanes.supports(plan)
    if reason and machine == lanes.NAME:
        raise InputError(
            f"the lanes do not cover this plan: {reason}; use the machine scalar, or a simpler filter or scenario"
        )
    return Choice(scalar.NAME if reason else lanes.NAME, reason)


class Identity(NamedTuple):
    """What the bits of a run depend on beside its plan; equal in all parts of a campaign."""

    version: str
    """Version of this package."""
    sources: str
    """Digest of its sources, which differ between two edits of one version."""
    arithmetic: str
    """See :func:`arithmetic`."""


def identity() -> Identity:
    """Return the identity of this process."""
    return Identity(strapdown.__version__, sources(), arithmetic())


FACES = ("cli", "plots", "report")
"""Sub-packages that compute nothing."""


@functools.cache
def sources() -> str:
    """Return a digest of the sources of this package, without :data:`FACES`."""
    root = Path(strapdown.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in FACES:
            digest.update(f"{name.as_posix()}\n".encode() + path.read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()[:16]


def arithmetic() -> str:
    """Return the processor features that rounding depends on: numba contracts products and sums if the processor can."""
    import platform

    from numba.core.codegen import get_host_cpu_features

    arm = platform.machine() in ("aarch64", "arm64")
    fused = arm or "+fma" in get_host_cpu_features().split(",")
    return f"{platform.machine()}, {'FMA' if fused else 'no FMA'}"


def replay(plan: Plan, run: int, *, machine: str = "auto") -> Replay:
    """Compute one run of a plan again in full detail, bitwise identical to that of the campaign.

    Parameters
    ----------
    plan : Plan
        Plan of the campaign.
    run : int
        Index of the run, from 0.
    machine : {"auto", "lanes", "scalar"}

    Returns
    -------
    Replay
        Record, initial state and estimate.
    """
    replayed: Replay = MACHINES[choose(plan, machine).machine].replay(plan, count("run", run, minimum=0))
    spec = dispersed(plan.scenario.gyro, plan.dispersions, plan.seed, run)
    of_this_run = plan.scenario
    if spec is not plan.scenario.gyro:  # dispersed, so no longer a preset
        of_this_run = replace(plan.scenario, gyro=spec, gyro_preset="")
    origin = Origin(gyro=spec, scenario=of_this_run, seed=plan.seed, run=run)
    record, estimate = replayed.record, replayed.estimate
    assert record.truth is not None
    # If a filter step combines several samples, the record is at the samples or at the steps, depending on the machine.
    truth = record.truth.taken(np.searchsorted(record.time, estimate.time - 1e-9))
    details = {"machine": choose(plan, machine).machine, "dispersions": json.dumps(plan.to_table()["dispersions"])}
    estimate = replace(estimate, setup=plan.setup, origin=origin, truth=truth, details=details)
    return replace(replayed, record=replace(record, origin=origin), estimate=estimate)


def chunks_of(runs: int, chunk: int, first: int = 0) -> Iterator[tuple[int, int]]:
    """Yield the chunks of the runs ``first`` to ``runs`` − 1 as (first run, number of runs)."""
    return ((start, min(chunk, runs - start)) for start in range(first, runs, chunk))


def compute(plans: tuple[Plan, ...], machine: str, first_run: int, runs: int) -> Parts:
    """Return the statistics of a chunk, one per plan; the plans differ only in the filter."""
    if machine == scalar.NAME:  # simulates each run once
        return scalar.run_chunks(plans, first_run, runs)
    return tuple(MACHINES[machine].run_chunk(plan, first_run, runs) for plan in plans)


Work = Callable[[int, int], Parts]
"""Function that computes a chunk from its first run and number of runs; picklable, for other processes."""
Workers = Callable[[Work, Iterable[tuple[int, int]]], Iterator[Parts]]
"""Function that computes chunks and yields their statistics in the order of the chunks."""

Submitted = TypeVar("Submitted")


def in_order(
    chunks: Iterable[tuple[int, int]], submit: Callable[[int, int], Submitted], workers: int
) -> Iterator[Submitted]:
    """Yield what ``submit`` returns for each chunk, in order; at most :data:`AHEAD` per worker are submitted and not yet yielded."""
    waiting: deque[Submitted] = deque()
    for chunk in chunks:
        waiting.append(submit(*chunk))
        if len(waiting) == AHEAD * workers:
            yield waiting.popleft()
    while waiting:
        yield waiting.popleft()


def in_threads(threads: int | None = None) -> Workers:
    """Return workers that are threads of this process. Default: one per core."""
    number = os.cpu_count() or 1 if threads is None else count("threads", threads)

    def work_through(work: Work, chunks: Iterable[tuple[int, int]]) -> Iterator[Parts]:
        tasks: SimpleQueue[tuple[Future[Parts], int, int] | None] = SimpleQueue()
        stopped = Event()

        def worker_loop() -> None:
            while (task := tasks.get()) is not None and not stopped.is_set():
                future, *chunk = task
                try:
                    future.set_result(work(*chunk))
                except BaseException as error:
                    future.set_exception(error)

        def submit(first_run: int, runs: int) -> Future[Parts]:
            future: Future[Parts] = Future()
            tasks.put((future, first_run, runs))
            return future

        for _ in range(number):  # daemons: Python waits for the threads of a ThreadPoolExecutor, also after Ctrl-C
            Thread(target=worker_loop, daemon=True).start()
        try:
            for future in in_order(chunks, submit, number):
                yield future.result()
        finally:
            stopped.set()
            for _ in range(number):
                tasks.put(None)

    return work_through


def run_plan(
    plan: Plan,
    *,
    runs: int,
    chunk: int | None = None,
    threads: int | None = None,
    machine: str = "auto",
    workers: Workers | None = None,
    progress: Callable[[int], None] | None = None,
) -> Statistics:
    """Return the statistics of runs 0 … ``runs`` − 1 of a plan.

    Parameters
    ----------
    plan : Plan
        Scenario, filter, seed and epochs of the statistics.
    runs : int
        Number of runs. Run k is bitwise identical for any number of runs, chunk, threads and workers.
    chunk : int, optional
        Number of runs per chunk. Default: that of the machine. It affects only the rounding of the statistics.
    threads : int, optional
        Number of threads. Default: one per core.
    machine : {"auto", "lanes", "scalar"}
    workers : Workers, optional
        Workers that compute the chunks instead of threads (:func:`strapdown.montecarlo.cluster.on_dask`).
    progress : callable, optional
        Called with the number of runs just finished.

    Returns
    -------
    Statistics
        Sums over all runs, merged in the order of the chunks.
    """
    how = in_threads(threads) if workers is None else workers
    return _run((plan,), choose(plan, machine).machine, runs, chunk, how, progress)[0]


def run(
    scenario: Scenario,
    setups: Sequence[FilterSetup],
    *,
    runs: int,
    seed: int,
    epochs: int = 100,
    nis_bins: int = 100,
    dispersions: Dispersions | None = None,
    machine: str = "scalar",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Statistics]:
    """Run several filter setups on the same simulated runs and return the statistics of each.

    Equivalent to :func:`run_plan` for each setup; the scalar machine simulates each run once for all setups.

    Parameters
    ----------
    scenario : Scenario
        Simulated motion, gyro and sensors.
    setups : sequence of FilterSetup
        Filters to compare.
    runs : int
        Number of independent runs.
    seed : int
        Seed of all random streams.
    epochs, nis_bins, dispersions : optional
        See :class:`Plan`.
    machine : {"scalar", "auto", "lanes"}
        "auto": the lanes if they support every setup.
    threads, progress : optional
        See :func:`run_plan`.

    Returns
    -------
    list of Statistics
        One per setup.
    """
    common: dict[str, Any] = {"scenario": scenario, "seed": seed, "epochs": epochs, "nis_bins": nis_bins}
    plans = tuple(Plan(setup=setup, dispersions=dispersions or Dispersions(), **common) for setup in setups)
    names = {choose(plan, machine).machine for plan in plans}
    name = names.pop() if len(names) == 1 else scalar.NAME
    return list(_run(plans, name, runs, None, in_threads(threads), progress))


def _run(
    plans: tuple[Plan, ...],
    machine: str,
    runs: int,
    chunk: int | None,
    workers: Workers,
    progress: Callable[[int], None] | None,
) -> Parts:
    size = MACHINES[machine].CHUNK if chunk is None else count("chunk", chunk)
    total: Parts = ()
    for parts in workers(functools.partial(compute, plans, machine), chunks_of(count("runs", runs), size)):
        total = tuple(map(merge, total, parts)) if total else parts
        if progress is not None:
            progress(parts[0].runs)
    return tuple(replace(part, plan=plan) for part, plan in zip(total, plans, strict=True))
