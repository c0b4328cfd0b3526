"""Monte Carlo campaigns."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strapdown.checks import InputError, count
from strapdown.cli.filters import default_words, filter_of_scenario, own_filter
from strapdown.cli.progress import progress_bar, rate_text
from strapdown.cli.terminal import (
    TABLES,
    command,
    console,
    counted,
    options_given,
    scenario_named,
    show,
    tables_folder,
    tables_written,
    written,
)
from strapdown.files import writable, write_json

if TYPE_CHECKING:
    from types import FrameType

    from strapdown.estimation.filters.own import Own
    from strapdown.montecarlo import Plan
    from strapdown.montecarlo.campaign import Campaign
    from strapdown.results import Table

_RUNS = 1000
_CAMPAIGN_SUFFIXES = (".h5", ".hdf5")


@dataclass(frozen=True)
class _Model:
    """Filter and errors; a campaign file contains its own."""

    filter_file: Path | None = typer.Option(
        None,
        "--filter",
        help="TOML with a table named filter, as written by `strapdown tune`; or FILE.py:NAME, your own filter in a Python file, "
        "which is executed. Default: the filter that matches the scenario.",
    )
    gyro: Path | None = typer.Option(
        None,
        help="TOML with a table named gyro, such as that of a data sheet: the filter matches it, not the gyro of the scenario.",
    )
    dispersions: Path | None = typer.Option(
        None,
        help="TOML with a table named dispersions: initial errors and gyro parameters that differ from run to run.",
    )
    seed: int | None = typer.Option(None, help="Seed. Default: that of the scenario.")
    float32: bool = typer.Option(False, "--float32", help="Compute in single precision; only with lanes.")
    states: bool | None = typer.Option(
        None,
        "--states/--no-states",
        help="With or without a state for each error that the scenario specifies. Default: with, if there are such errors and "
        "neither a filter nor --float32 nor lanes are given.",
    )


@dataclass(frozen=True)
class _Computing:
    """Runs and computation."""

    runs: int | None = typer.Option(None, help="Number of runs. Default: 1000, or that of the resumed file.")
    threads: int | None = typer.Option(None, help="Number of threads. Default: one per core.")
    machine: str = typer.Option(
        "auto",
        help="lanes: eight runs at once in SIMD lanes; scalar: any scenario and filter; auto: lanes if they support both.",
    )
    chunk: int | None = typer.Option(None, help="Runs between merges and writes. Default: chosen by the machine.")
    workers: int | None = typer.Option(None, help="Number of processes to use instead of threads (needs Dask).")
    cluster: str | None = typer.Option(
        None,
        help="Compute on the Dask scheduler at this address, tcp://HOST:8786, or tls:// with Dask's certificates configured. Scheduler "
        "and workers can run any code in your account (they send pickles): connect only to one that you trust.",
    )


@dataclass(frozen=True)
class _Output:
    """Output."""

    out: Path | None = typer.Option(
        None, help="HDF5 file. Default: NAME-montecarlo.h5 with the name, or the TOML file, of the scenario."
    )
    resume: bool = typer.Option(False, "--resume", help="Continue with the file if it exists.")
    overwrite: bool = typer.Option(False, "--overwrite", help="Start from the beginning even if the file exists.")
    replay: int | None = typer.Option(None, help="Repeat this run and write its record and estimate.")
    tables: Path | None = TABLES


@command
def montecarlo(
    scenario: Annotated[
        str,
        typer.Argument(help="Name of a built-in scenario, a TOML file, or the HDF5 file of a campaign, with its plan."),
    ],
    model: _Model,
    computing: _Computing,
    output: _Output,
) -> None:
    """Run many simulations of a scenario and judge the filter: exit status 0 consistent, 1 not, 3 cannot tell."""
    source = Path(scenario)
    held, plan = _planned(source, scenario, model, computing.machine)
    machine = held.machine if held is not None and computing.machine == "auto" else computing.machine
    target = output.out or (source if held is not None else Path(f"{source.stem}-montecarlo.h5"))
    tables_folder(output.tables)
    if output.resume and output.overwrite:
        raise InputError("--resume and --overwrite exclude each other; give one of them")
    _check_files(target, replaced=output.overwrite or output.replay is not None)
    if output.replay is not None:
        writable("out", *_replayed(target, output.replay))
        _replay(plan, output.replay, machine, target)
        return
    if held is not None and target == source and not (output.resume or output.overwrite):
        status, _, listed = _print_result(held)
        if output.tables is not None:
            written(*tables_written(output.tables, *listed))
        raise typer.Exit(status)
    result = _computed(plan, target, source.stem, replace(computing, machine=machine), output)
    status, content, listed = _print_result(result)
    write_json(target.with_suffix(".json"), content)
    written(target, target.with_suffix(".json"), *tables_written(output.tables, *listed))
    raise typer.Exit(status)


def _planned(source: Path, scenario: str, model: _Model, machine: str) -> tuple[Campaign | None, Plan]:
    """Return the campaign of a file, None if the source is no campaign file, and the plan."""
    from strapdown.montecarlo import campaign as campaigns

    if source.suffix.lower() not in _CAMPAIGN_SUFFIXES:
        if model.states is None and (model.float32 or machine == "lanes"):
            model = replace(model, states=False)
        return None, _plan(scenario, model)
    held = campaigns.read(source)
    if model.filter_file is not None and (own := own_filter(model.filter_file)) is not None:
        held, model = _with_filter(held, own, source), replace(model, filter_file=None)
    for name in options_given(model):
        raise InputError(f"{name} is given, but {source} contains its own; leave it out, or name a scenario")
    return held, held.plan


def _check_files(target: Path, *, replaced: bool) -> None:
    """Raise an error if the file or its JSON report cannot be written, or if the report exists without the file and not ``replaced``."""
    writable("out", target, suffixes=_CAMPAIGN_SUFFIXES)
    beside = target.with_suffix(".json")
    if beside.exists() and not target.exists() and not replaced:
        raise InputError(f"{beside} exists and would be replaced; move it, choose another --out, or give --overwrite")
    writable("out", beside)


def _computed(plan: Plan, target: Path, name: str, computing: _Computing, output: _Output) -> Campaign:
    """Compute the runs, in threads or on Dask, and write each chunk to the file."""
    from strapdown import montecarlo as engine
    from strapdown.montecarlo import campaign as campaigns

    runs = computing.runs
    if runs is None:
        runs = campaigns.read(target).runs if output.resume and target.exists() else _RUNS
    choice = engine.choose(plan, computing.machine)
    count("runs", runs)
    engine.in_threads(computing.threads)  # checks the number
    console.print(f"{plan.scenario.name or name}: {counted(runs, 'run')}, seed {plan.seed}, machine: {choice}.")
    with contextlib.ExitStack() as stack:
        workers = None
        if computing.workers is not None or computing.cluster is not None:
            from strapdown.montecarlo.cluster import dask_client, on_dask

            client = stack.enter_context(dask_client(workers=computing.workers, address=computing.cluster))
            workers = on_dask(client)
            console.print(f"Dask at {client.scheduler.address}: {sum(client.nthreads().values())} worker threads.")
        stop_if_asked = stack.enter_context(asked_to_stop())
        advance = stack.enter_context(progress_bar("runs", runs, rate="runs/s"))

        def advanced(number: int) -> None:
            advance(number)
            stop_if_asked()

        try:
            return campaigns.run(
                plan,
                target,
                runs=runs,
                resume=output.resume,
                overwrite=output.overwrite,
                chunk=computing.chunk,
                machine=computing.machine,
                threads=computing.threads,
                workers=workers,
                progress=advanced,
            )
        except KeyboardInterrupt:
            console.print(f"The completed runs are in {target}; continue with --resume.")
            raise


@contextlib.contextmanager
def asked_to_stop() -> Iterator[Callable[[], None]]:
    """Treat SIGTERM, which batch systems send before they kill a process, as Ctrl-C, so that completed runs are written.

    Yields a function that raises again after a signal: Python drops an exception that is raised while a weak reference is cleared.
    """
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        raise KeyboardInterrupt

    def again() -> None:
        if asked:
            raise KeyboardInterrupt

    heeded = [one for one in (signal.SIGTERM, signal.SIGINT) if signal.getsignal(one) is not signal.SIG_IGN]
    before = {one: signal.signal(one, ask) for one in heeded}
    try:
        yield again
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def _plan(scenario: str, model: _Model) -> Plan:
    from strapdown import montecarlo as engine
    from strapdown import workflows
    from strapdown.estimation.setup import FilterSetup
    from strapdown.gyro import read_spec

    if model.states is not None and model.filter_file is not None:
        raise InputError("--filter defines the complete filter with its states; leave --states and --no-states out")
    if model.gyro is not None and model.filter_file is not None:
        raise InputError("--gyro and --filter both define the gyro noise of the filter; give one of them")
    loaded = scenario_named(scenario)
    chosen = None
    if model.filter_file is not None:
        own = own_filter(model.filter_file)
        chosen = (
            filter_of_scenario(model.filter_file, loaded)
            if own is None
            else replace(FilterSetup.for_scenario(loaded, states=False), estimator=own)
        )
    plan = workflows.plan(
        loaded,
        gyro=None if model.gyro is None else read_spec(model.gyro),
        setup=chosen,
        seed=model.seed,
        states=model.states,
        dispersions=None if model.dispersions is None else engine.read_dispersions(model.dispersions),
        precision="float32" if model.float32 else "float64",
    )
    if model.states is None and model.filter_file is None and plan.setup.states is not None:
        console.print(default_words(plan.setup.states.names))
    if plan.individuals:
        console.print("Each run draws its own gyro and sensors: specified constant errors are standard deviations.")
    return plan


def _with_filter(held: Campaign, own: Own, source: Path) -> Campaign:
    """Return a campaign with the code of its filter, which its file does not contain."""
    if held.plan.setup.estimator != own:
        raise InputError(
            f"{own.name} in its present file is not the filter of {source}, {held.plan.setup.estimator_name}; restore the file, or "
            "start again with the scenario and another --out"
        )
    return replace(held, plan=replace(held.plan, setup=replace(held.plan.setup, estimator=own)))


def _print_result(campaign: Campaign) -> tuple[int, dict[str, Any], list[Table]]:
    """Print the statistics and the verdict of `strapdown check`; return the exit status, the content of the JSON file, and the tables."""
    from strapdown import workflows
    from strapdown.cli.judgement import status_of
    from strapdown.estimation.setup import MEKF
    from strapdown.montecarlo import summary
    from strapdown.montecarlo.verdicts import bound_of, tables

    if campaign.statistics is None:
        raise InputError("no chunk of the campaign is completed; continue it with --resume")
    if not campaign.finished:
        console.print(f"{campaign.statistics.runs} of {campaign.runs} runs are completed.")
    report = summary(campaign.statistics, bound=bound_of(campaign.plan))
    judgement = workflows.check(campaign)
    listed = tables(report)
    for one in listed:
        show(one)
    console.print("Use --replay to examine a run.")
    rate = ""
    if campaign.seconds > 0.0:
        rate = f" ({rate_text(campaign.statistics.runs / campaign.seconds)} runs/s, including compilation)"
    console.print(
        f"{counted(report['runs'], 'run')}, {campaign.seconds:.3g} s{rate}. The verdict combines all {len(judgement.findings)} "
        f"statistics of `strapdown check`: a consistent filter passes with {100.0 * report['confidence_level']:g} %."
    )
    console.print(judgement.words)
    if judgement.verdict == "cannot tell":
        console.print("More runs (--runs, with --resume) are needed for a decision.")
    if judgement.unmodelled and campaign.plan.setup.states is None and campaign.plan.setup.estimator == MEKF:
        console.print("--states adds states for most of these errors to the filter.")
    content = {**campaign.summary(), "judgement": judgement.summary(), **report}
    return status_of(judgement), content, listed


def _replayed(target: Path, run: int) -> list[Path]:
    """Return the files of a replayed run: record and estimate."""
    return [target.with_name(f"{target.stem}-run-{run}-{what}.h5") for what in ("record", "estimate")]


def _replay(plan: Plan, run: int, machine: str, target: Path) -> None:
    from strapdown import montecarlo as engine
    from strapdown import workflows
    from strapdown.recordings import recordfiles

    again = engine.replay(plan, run, machine=machine)
    paths = _replayed(target, run)
    recordfiles.write_record(paths[0], again.record, attributes=again.estimate.details)
    workflows.write(again.estimate, paths[1])
    nees, worst = again.largest_nees(plan.time)
    console.print(
        f"Run {run} of seed {plan.seed}, machine: {engine.choose(plan, machine)}. Its maximum NEES at the {plan.epochs} epochs of the "
        f"campaign is {nees:.1f} ({'six' if again.estimate.has_bias else 'three'} states), at {worst:g} s."
    )
    written(*paths)
