"""Running a plan: choosing the machine, chunks in threads, merging in the order of the runs."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from queue import SimpleQueue
from threading import Thread
from typing import Any

from strapdown.checks import InputError, count, one_of
from strapdown.estimation.setup import FilterSetup
from strapdown.montecarlo import scalar
from strapdown.montecarlo.plan import Plan
from strapdown.montecarlo.statistics import Replay, Statistics, merge
from strapdown.records import Origin
from strapdown.scenarios import Scenario

Parts = tuple[Statistics, ...]
"""Statistics of the same runs, one a plan."""

MACHINES = ("lanes", "scalar")
"""Machines, the fast one first."""

AHEAD = 4
"""Chunks a worker may be ahead of the first unfinished one: what bounds the memory where chunks finish out of order."""


def machine_named(name: str) -> Any:
    """Return a machine by name: a module as :mod:`strapdown.montecarlo.statistics` describes it."""
    one_of("machine", name, MACHINES)
    return scalar if name == "scalar" else importlib.import_module("strapdown.montecarlo.lanes")


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The machine that computes a plan, and why not a faster one."""

    machine: str
    reason: str = ""
    """What the lanes do not cover; empty where they cover all, or where the machine was asked for."""

    def __str__(self) -> str:
        """Return it as one line."""
        return f"{self.machine} (lanes do not cover {self.reason})" if self.reason else self.machine


def choose(plan: Plan, machine: str = "auto") -> Choice:
    """Return the machine that computes a plan: the lanes if every term is among theirs, else the scalar one.

    The choice depends on the plan alone, because the machines draw different noise.
    """
    one_of("machine", machine, ("auto", *MACHINES))
    reasons: dict[str, str] = {}
    for name in MACHINES if machine == "auto" else (machine,):
        try:
            reason = machine_named(name).supports(plan)
        except ModuleNotFoundError as error:
            reason = f"a machine without {error.name}"
        if reason is None:
            return Choice(machine=name, reason=reasons.get("lanes", ""))
        reasons[name] = reason
    refusals = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
    raise InputError(
        f"no machine covers this plan ({refusals}); take a plainer filter or scenario, or precision float64"
    )


def arithmetic() -> str:
    """Return what the bits of a result depend on besides the plan: the processor's family, its vectors and fused multiply-add.

    Numba contracts products and sums where the processor can, and lanes follow the width of its vectors.
    """
    import platform

    from numba.core.codegen import get_host_cpu_features

    from strapdown.kernels.machine import has_vectors

    arm = platform.machine() in ("aarch64", "arm64")
    fused = arm or "+fma" in get_host_cpu_features().split(",")
    return f"{platform.machine()}, {'vectors' if has_vectors() else 'no vectors'}, {'FMA' if fused else 'no FMA'}"


def replay(plan: Plan, run: int, *, machine: str = "auto") -> Replay:
    """Compute one run of a plan again, in full detail; it is bitwise what it was in the campaign.

    Parameters
    ----------
    plan : Plan
        Plan of the campaign.
    run : int
        Number of the run, from 0.
    machine : {"auto", "lanes", "scalar"}

    Returns
    -------
    Replay
        Record, initial state and estimate.
    """
    found: Replay = machine_named(choose(plan, machine).machine).replay(plan, count("run", run, minimum=0))
    spec = scalar.dispersed(plan.scenario.gyro, plan.dispersions, plan.seed, run)
    of_this_run = plan.scenario
    if spec is not plan.scenario.gyro:  # dispersed, and so no preset any more
        of_this_run = replace(plan.scenario, gyro=spec, gyro_preset="")
    origin = Origin(gyro=spec, scenario=of_this_run, seed=plan.seed, run=run)
    return replace(found, record=replace(found.record, origin=origin))


@dataclass(frozen=True)
class Chunks:
    """Chunks as (first run, runs), worked out when asked for: a list of them would grow with the number of runs."""

    firsts: Sequence[int]
    """First run of each."""
    runs: int
    """Runs of the whole campaign, at which the last chunk ends."""
    chunk: int

    def __len__(self) -> int:
        return len(self.firsts)

    def __getitem__(self, place: int) -> tuple[int, int]:
        first = self.firsts[place]
        return first, min(self.chunk, self.runs - first)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return (self[place] for place in range(len(self)))


def chunks_of(runs: int, chunk: int) -> Chunks:
    """Return the chunks of ``runs`` runs."""
    return Chunks(range(0, runs, chunk), runs, chunk)


@dataclass(frozen=True, kw_only=True, eq=False)
class Work:
    """Function that computes a chunk; picklable, for other processes."""

    plans: tuple[Plan, ...]
    """Plans that differ in the filter alone: the runs' sensors give the same to all."""
    machine: str

    def __call__(self, first_run: int, runs: int) -> Parts:
        """Return the statistics of a chunk, one a plan."""
        if self.machine == scalar.NAME:  # simulates each run once
            return scalar.run_chunks(self.plans, first_run, runs)
        chosen = machine_named(self.machine)
        return tuple(chosen.run_chunk(plan, first_run, runs) for plan in self.plans)


Workers = Callable[[Work, Chunks], Iterator[tuple[int, Parts]]]
"""Computes chunks and yields (place among them, result) as they finish: in any order, but never further ahead of the first unfinished one
than :data:`AHEAD` allows."""


class Window:
    """Which chunk may be begun next, so that few wait for one before them."""

    def __init__(self, chunks: int, workers: int) -> None:
        self._next, self._end, self._ahead = 0, chunks, AHEAD * workers
        self._running: set[int] = set()
        self._most = workers

    def begin(self) -> int | None:
        """Return the place of a chunk to be begun now; None if there is none."""
        first = min(self._running, default=self._next)
        if self._next >= self._end or len(self._running) >= self._most or self._next >= first + self._ahead:
            return None
        self._running.add(self._next)
        self._next += 1
        return self._next - 1

    def finish(self, place: int) -> None:
        """Take note that a chunk is done."""
        self._running.remove(place)

    @property
    def open(self) -> bool:
        """Whether there is anything left."""
        return bool(self._running) or self._next < self._end


def in_threads(threads: int | None = None) -> Workers:
    """Return workers that are threads of this process; default one a core."""
    number = os.cpu_count() or 1 if threads is None else count("threads", threads)

    def work_through(work: Work, chunks: Chunks) -> Iterator[tuple[int, Parts]]:
        tasks: SimpleQueue[int | None] = SimpleQueue()
        results: SimpleQueue[tuple[int, Parts | BaseException]] = SimpleQueue()

        def labour() -> None:
            while (place := tasks.get()) is not None:
                try:
                    results.put((place, work(*chunks[place])))
                except BaseException as error:
                    results.put((place, error))

        hands = [Thread(target=labour, daemon=True) for _ in range(min(number, len(chunks)))]
        for hand in hands:
            hand.start()
        window = Window(len(chunks), len(hands))
        try:
            while window.open:
                while (place := window.begin()) is not None:
                    tasks.put(place)
                done, result = results.get()
                if isinstance(result, BaseException):
                    raise result
                window.finish(done)
                yield done, result
        finally:
            for _ in hands:
                tasks.put(None)

    return work_through


def merged_in_order(finished: Iterator[tuple[int, Parts]]) -> Parts:
    """Return the statistics of all chunks, which come in any order, merged in that of their places."""
    early: dict[int, Parts] = {}
    total: Parts = ()
    place = 0
    for number, parts in finished:
        early[number] = parts
        while place in early:
            total = merge_parts(total, early.pop(place))
            place += 1
    return total


def merge_parts(total: Parts, parts: Parts) -> Parts:
    """Return both merged, plan by plan; an empty total is nothing yet."""
    return tuple(merge(a, b) for a, b in zip(total, parts, strict=True)) if total else parts


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
        Scenario, filter and seed, and where statistics are computed.
    runs : int
        Run k is the same to the bit whatever their number, the chunks, threads and workers.
    chunk : int, optional
        Runs between merges; default the machine's. The statistics depend on it by rounding only.
    threads : int, optional
        Default: one a core.
    machine : {"auto", "lanes", "scalar"}
    workers : Workers, optional
        What computes the chunks instead of threads (:func:`strapdown.montecarlo.cluster.on_dask`).
    progress : callable, optional
        Called with the number of runs just finished.

    Returns
    -------
    Statistics
        Sums over all the runs, merged in the order of the chunks.
    """
    chosen = choose(plan, machine).machine
    size = machine_named(chosen).CHUNK if chunk is None else count("chunk", chunk)
    work = Work(plans=(plan,), machine=chosen)
    return _run(work, count("runs", runs), size, in_threads(threads) if workers is None else workers, progress)[0]


def run(
    scenario: Scenario,
    setups: Sequence[FilterSetup],
    *,
    runs: int,
    seed: int,
    chunk: int | None = None,
    threads: int | None = None,
    machine: str = "scalar",
    progress: Callable[[int], None] | None = None,
    **options: Any,
) -> list[Statistics]:
    """Run several filter setups on the same simulated runs and return the statistics of each.

    As :func:`run_plan` for each setup; the scalar machine simulates each run once for all of them.

    Parameters
    ----------
    scenario : Scenario
        Motion, gyro and sensors that are simulated.
    setups : sequence of FilterSetup
        Filters to compare.
    runs : int
        Number of independent runs.
    seed : int
        Seed of all random streams.
    chunk, threads : int, optional
        As of :func:`run_plan`.
    machine : {"scalar", "auto", "lanes"}
        "auto": the lanes if they support every setup.
    progress : callable, optional
        As of :func:`run_plan`.
    **options
        Other fields of :class:`Plan`, such as ``epochs``.

    Returns
    -------
    list of Statistics
        One a setup.
    """
    count("runs", runs)
    plans = tuple(Plan(scenario=scenario, setup=one, seed=seed, **options) for one in setups)
    names = {choose(plan, machine).machine for plan in plans}
    work = Work(plans=plans, machine=names.pop() if len(names) == 1 else scalar.NAME)
    size = machine_named(work.machine).CHUNK if chunk is None else count("chunk", chunk)
    return list(_run(work, runs, size, in_threads(threads), progress))


def _run(work: Work, runs: int, chunk: int, workers: Workers, progress: Callable[[int], None] | None) -> Parts:
    chunks = chunks_of(runs, chunk)

    def counted() -> Iterator[tuple[int, Parts]]:
        for place, parts in workers(work, chunks):
            if progress is not None:
                progress(chunks[place][1])
            yield place, parts

    return merged_in_order(counted())
