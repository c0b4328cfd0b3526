"""A campaign and its file: a Monte Carlo that can be resumed after being killed, with bitwise identical results.

The file is HDF5 and always complete: each version is written to a temporary file and renamed. A reader, during the campaign or after it was
killed, finds the statistics of the runs finished until then. The file holds sums, not runs, so its size does not depend on their number.

The statistics are a left fold over chunks in the order of their runs, which depends only on plan, machine and chunk. If the last chunk is
short, the group ``resume/whole`` holds the fold without it, so that an extended campaign is bitwise identical to one that was as long from
the start.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import scenarios
from strapdown.checks import Hint, InputError, count, finite, one_of
from strapdown.consistency import Judgement
from strapdown.estimation import setup
from strapdown.estimation.filters.own import Own
from strapdown.files import locked, reading, set_attributes
from strapdown.montecarlo import verdicts
from strapdown.montecarlo.engine import MACHINES, Identity, Workers, choose, chunks_of, compute, identity, in_threads
from strapdown.montecarlo.plan import Plan, from_table
from strapdown.montecarlo.statistics import ARRAYS, Statistics, lengths_of, merge
from strapdown.records import put
from strapdown.records.result_files import result_file
from strapdown.results import Listed, Table, counted

__all__ = ["Campaign", "read", "run"]

KIND = "strapdown montecarlo"
"""The attribute ``kind`` of a campaign's file."""
FORMAT = 1
"""Version of the layout; a newer one is refused."""
SHARE = 0.1
"""Maximum fraction of the time spent writing the file; fast chunks are written several at a time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Campaign(Listed):
    """A campaign as stored in its file.

    Parameters
    ----------
    plan : Plan
        Scenario, filter and seed of the campaign.
    machine : {"lanes", "scalar"}
        Machine that computes the runs.
    chunk : int
        Number of runs per chunk.
    runs : int
        Total number of runs.
    statistics : Statistics or None
        Statistics of the finished runs, from the first; None if there are none.
    identity : Identity, optional
        Version and sources of this package that computed it, and the processor's arithmetic. Default: those of this process.
    seconds : float, default 0.0
        Time spent computing, s, over all resumptions.
    whole : Statistics, optional
        Statistics without a short last chunk, with which a longer campaign continues.
    """

    plan: Plan
    machine: str
    chunk: int
    runs: int
    statistics: Statistics | None
    identity: Identity = field(default_factory=identity)
    seconds: float = 0.0
    whole: Statistics | None = field(default=None, repr=False)

    def listing(self) -> Table:
        """Return the statistics of the finished runs as a table."""
        if self.statistics is None:
            return Table(f"Monte Carlo of {counted(self.runs, 'run')}, none finished", (), ())
        return self.statistics.listing()

    def summary(self, judgement: Judgement | None = None) -> dict[str, Any]:
        """Return plan, provenance, verdict and statistics as plain values for JSON.

        Parameters
        ----------
        judgement : Judgement, optional
            Verdict on the finished runs, if known.

        Returns
        -------
        dict
            Plan, digest, engine, chunk size, version, time; if runs are finished, also :func:`strapdown.montecarlo.summary`.
        """
        statistics, bound = self.statistics, verdicts.bound_of(self.plan)
        return {
            "plan": self.plan.to_table(),
            "digest": self.plan.digest,
            "machine": self.machine,
            "reason_for_scalar_engine": choose(self.plan).reason or None,
            "chunk": self.chunk,
            "version": self.identity.version,
            "seconds": self.seconds,
            **({} if statistics is None else verdicts.summary(statistics, judgement=judgement, bound=bound)),
        }

    @property
    def extent(self) -> str:
        """Numbers of runs, seed and machine, in words."""
        done = self.finished_runs
        number = counted(done, "run") if self.finished else f"{done} of {counted(self.runs, 'run')}"
        return f"{number} of {self.plan.scenario.duration:g} s, seed {self.plan.seed}, machine {self.machine}"

    @property
    def finished_runs(self) -> int:
        """Number of runs in the statistics."""
        return 0 if self.statistics is None else self.statistics.runs

    @property
    def finished(self) -> bool:
        """Whether the statistics contain all runs."""
        return self.finished_runs == self.runs


def words(campaign: Campaign, judgement: Judgement) -> list[str]:
    """Return extent and verdict of a campaign, and what would make the verdict clearer."""
    scenario, filter_setup = campaign.plan.scenario, campaign.plan.setup
    sentences = [f"{campaign.extent}, computed in {campaign.seconds:.3g} s.", judgement.words]
    if scenario.late_motion:
        sentences.append(f"Warning: {scenario.late_motion}.")
    if judgement.verdict == "cannot tell":
        sentences.append(f"More runs ({Hint('runs')}, with {Hint('resume', True)}) are needed for a decision.")
    if judgement.unmodelled and (remedy := setup.remedy(campaign.plan.origin, filter_setup)):
        sentences.append(f"{remedy}.")
    one_sample = filter_setup.estimator == setup.MEKF and filter_setup.integration.name == "one-sample"
    if (
        judgement.verdict != "consistent"
        and one_sample
        and setup.commutes_badly(scenarios.simulate(scenario), filter_setup.process_noise.angle_random_walk)
    ):
        sentences.append(
            "One-sample integration drifts in this motion (coning) by more than the gyro's noise explains; give a filter with another "
            "integration, such as matched-1-8-8."
        )
    return sentences


def with_filter(held: Campaign, own: Own, path: Path) -> Campaign:
    """Return the campaign of a file with the code of its filter, which the file does not contain."""
    setup = held.plan.setup
    if setup.estimator != own:
        raise InputError(
            f"{own.name} in its present file is not the filter of {path}, {setup.estimator_name}; restore the file, or start again with "
            "the scenario and another file"
        )
    return replace(held, plan=replace(held.plan, setup=replace(setup, estimator=own)))


def run(
    plan: Plan,
    path: str | os.PathLike[str],
    *,
    runs: int,
    resume: bool = False,
    overwrite: bool = False,
    chunk: int | None = None,
    machine: str = "auto",
    threads: int | None = None,
    workers: Workers | None = None,
    progress: Callable[[int], None] | None = None,
) -> Campaign:
    """Run a plan with a checkpoint file, from which an interrupted run can be resumed.

    Parameters
    ----------
    plan : Plan
        Scenario, filter and seed.
    path : path
        HDF5 file. Finished chunks are written at intervals, so that writing takes below a tenth of the time, and on Ctrl-C or SIGTERM.
    runs : int
        Total number of runs; if more than the file holds, it is extended.
    resume : bool, default False
        Continue from the file if it exists; plan, machine, chunk and version must be the same.
    overwrite : bool, default False
        Overwrite the file if it exists.
    chunk : int, optional
        Number of runs per chunk. Default: that of the file, or of the machine.
    machine, threads, workers : optional
        See :func:`strapdown.montecarlo.run_plan`.
    progress : callable, optional
        Called with the number of runs just finished, first with the number in the file.

    Returns
    -------
    Campaign
        The finished campaign, as stored in the file.

    Raises
    ------
    InputError
        If a new campaign would destroy the runs of the file, or if the one to be resumed is of another plan, or no campaign.
    """
    target = Path(path)
    count("runs", runs)
    name = choose(plan, machine).machine
    with locked(target), _sigterm_as_ctrl_c():
        if not resume and not overwrite and _would_lose(target):
            raise InputError(
                f"{target} exists; continue it ({Hint('resume', True)}), overwrite it ({Hint('overwrite', True)}), or choose another name"
            )
        held = read(target) if resume and target.exists() else None
        default = MACHINES[name].CHUNK if held is None else held.chunk
        start = Campaign(
            plan=plan,
            machine=name,
            chunk=default if chunk is None else count("chunk", chunk),
            runs=runs,
            statistics=None,
            identity=identity(),
        )
        if held is not None:
            _need_same(target, held, start)
            known = held.statistics if held.finished_runs == runs else held.whole
            start = replace(start, statistics=known, whole=held.whole, seconds=held.seconds)
        how = in_threads(threads) if workers is None else workers
        return _compute(start, target, how, progress or (lambda number: None))


def _would_lose(path: Path) -> bool:
    """Return whether there is a file that a new campaign would destroy: any but a campaign of which no run is finished."""
    try:
        return path.exists() and read(path).finished_runs > 0
    except InputError:
        return True


@contextlib.contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Treat SIGTERM, which batch systems send before they kill a process, as Ctrl-C, so that completed runs are written.

    Only the main thread receives signals; one that whoever started the process had ignored stays ignored.
    """
    before = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or before == signal.SIG_IGN:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _compute(campaign: Campaign, path: Path, workers: Workers, progress: Callable[[int], None]) -> Campaign:
    """Compute the missing chunks; write at once, at intervals, and at the end or an exception; return the last written state."""
    statistics, whole, begun = campaign.statistics, campaign.whole, time.perf_counter()

    def write() -> Campaign:
        now = replace(
            campaign,
            statistics=statistics and replace(statistics, plan=campaign.plan),
            whole=whole,
            seconds=campaign.seconds + time.perf_counter() - begun,
        )
        _write(path, now)
        return now

    if campaign.finished_runs:
        progress(campaign.finished_runs)
    written = write()  # fails before anything is computed if the file cannot be written
    due, unwritten = 0.0, False
    work = partial(compute, (campaign.plan,), campaign.machine)
    try:
        for (part,) in workers(work, chunks_of(campaign.runs, campaign.chunk, campaign.finished_runs)):
            statistics = part if whole is None else merge(whole, part)
            whole = statistics if part.runs == campaign.chunk else whole
            unwritten = True
            progress(part.runs)
            if (now := time.perf_counter()) >= due:
                written, unwritten = write(), False
                due = time.perf_counter() + (time.perf_counter() - now) * (1.0 / SHARE - 1.0)
    finally:
        if unwritten:
            written = write()
    return written


def _need_same(target: Path, held: Campaign, wanted: Campaign) -> None:
    """Raise if the campaign of a file is another one, naming the first difference: that of the scenario, on which the filter depends."""
    here, there = (
        dict(_values(campaign.plan.to_table()))
        | {"machine": campaign.machine, "chunk": campaign.chunk, **campaign.identity._asdict()}
        for campaign in (wanted, held)
    )
    for name in here | there:
        if here.get(name) != there.get(name):
            of_code = name in ("version", "sources")
            remedy = "continue it with the strapdown that began it" if of_code else "give the value in the file"
            raise InputError(
                f"{target} is of another campaign; {name} is {there.get(name, 'not given')} there and {here.get(name, 'not given')} here; "
                f"{remedy}, or choose another file"
            )
    if wanted.runs < held.finished_runs:
        raise InputError(
            f"{target} holds {held.finished_runs} runs already, more than the {wanted.runs} wanted; give more runs"
        )


def _values(content: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables and lists of tables with their places, names joined by dots."""
    tables = isinstance(content, list) and content and isinstance(content[0], Mapping)
    inside = enumerate(content) if tables else content.items() if isinstance(content, Mapping) else None
    if inside is None:
        yield place, content
    else:
        for name, value in inside:
            yield from _values(value, f"{place}.{name}" if place else str(name))


# -------------------------------------------------------------------------------------------------------------------------- file


def _write(path: Path, campaign: Campaign) -> None:
    import h5py
    import numba

    plan = campaign.plan
    packages = {module.__name__: module.__version__ for module in (np, numba, h5py)}
    attributes = {
        "format": FORMAT,
        **campaign.identity._asdict(),
        "versions": json.dumps({"python": platform.python_version(), **packages}),
        "scenario": scenarios.scenario_to_toml(plan.scenario),
        "filter": setup.to_toml(plan.setup),
        "plan": json.dumps(plan.to_table(), default=float),
        "digest": plan.digest,
        "seed": plan.seed,
        "machine": campaign.machine,
        "chunk": campaign.chunk,
        "runs": campaign.runs,
        "finished_runs": campaign.finished_runs,
        "seconds": campaign.seconds,
    }
    with result_file(path, "montecarlo", attributes, durable=True) as file:
        if campaign.statistics is not None:
            _put_statistics(file.create_group("statistics"), campaign.statistics)
        if campaign.whole is not None and campaign.whole.runs < campaign.finished_runs:
            _put_statistics(file.create_group("resume/whole"), campaign.whole)


def _put_statistics(group: Any, statistics: Statistics) -> None:
    from strapdown.montecarlo.statistics import BINS_PER_OCTAVE, ERROR_EXPONENT

    attributes = {
        "runs": statistics.runs,
        "sensors": json.dumps(statistics.sensors),
        "bins_per_octave": BINS_PER_OCTAVE,
        "first_error_exponent": ERROR_EXPONENT,
    }
    set_attributes(group, attributes)
    for name, layout in ARRAYS.items():
        put(group, name, getattr(statistics, name), layout.unit, layout.meaning)


def _statistics_of(group: Any, plan: Plan) -> Statistics:
    """Return the statistics in a group; their shapes must be those of the plan."""
    arrays = {name: reading.numbers(group, name) for name in ARRAYS}
    place = f"{group.file.filename}: {group.name.lstrip('/')}"
    lengths = lengths_of(plan) | {"worst": len(arrays["worst_run"]), "examples": len(arrays["example_run"])}
    for name, layout in ARRAYS.items():
        value, shape = arrays[name], tuple(lengths.get(n, n) for n in layout.shape)
        finite_sums = layout.shape[0] != "epochs" or np.isfinite(value).all()
        if value.shape != shape or value.dtype.kind != ("i" if layout.counts else "f") or not finite_sums:
            raise InputError(f"{place}: {name} does not fit the plan; the file is damaged: run the campaign again")
    runs = count(f"{place}: runs", reading.attributes(group)["runs"])
    return Statistics(runs=runs, sensors=plan.sensors, plan=plan, **arrays)


def read(path: str | os.PathLike[str]) -> Campaign:
    """Read a campaign's file, finished or not.

    Parameters
    ----------
    path : path
        HDF5 file that :func:`run` writes.

    Returns
    -------
    Campaign
        The campaign with the statistics of the finished runs.
    """
    path = Path(path)
    with reading.hdf5(path) as file:
        attributes = reading.attributes(file)
        if attributes.get("kind") != KIND:
            raise InputError(f"{path} is no Monte Carlo campaign; `strapdown montecarlo` writes one")
        if count("format", attributes["format"]) > FORMAT:
            raise InputError(
                f"{path} has format {attributes['format']}, newer than this package supports; install strapdown {attributes['version']}"
            )
        plan = from_table(reading.from_json(attributes["plan"], f"{path}: plan"))
        if attributes["digest"] != plan.digest:
            raise InputError(f"{path}: digest is not that of the plan; the file is damaged: run the campaign again")
        chunk = count("chunk", attributes["chunk"])
        statistics = _statistics_of(file["statistics"], plan) if "statistics" in file else None
        whole = statistics if statistics is not None and statistics.runs % chunk == 0 else None
        return Campaign(
            plan=plan,
            machine=one_of("machine", attributes["machine"], MACHINES),
            chunk=chunk,
            runs=count("runs", attributes["runs"]),
            statistics=statistics,
            whole=_statistics_of(file["resume/whole"], plan) if "resume/whole" in file else whole,
            identity=Identity(*(str(attributes[name]) for name in Identity._fields)),
            seconds=finite("seconds", attributes["seconds"], unit="s"),
        )
