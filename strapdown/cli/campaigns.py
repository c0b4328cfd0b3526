"""Monte Carlo campaigns."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError, count
from strapdown.cli import terminal as ui
from strapdown.cli.progress import rate_text
from strapdown.files import write_json

if TYPE_CHECKING:
    from strapdown.estimation.filters.own import Own
    from strapdown.montecarlo import Plan
    from strapdown.montecarlo.campaign import Campaign

_RUNS = 1000
_SUFFIXES = (".h5", ".hdf5")


@dataclass(frozen=True)
class _Model:
    """Filter and errors; a campaign file contains its own."""

    filter_file: Path | None = Option(
        None,
        "--filter",
        help="TOML with a table named filter, as of `strapdown tune`; or FILE.py:NAME, your own filter, which is executed. Default: a "
        "matched one.",
    )
    gyro: Path | None = ui.GYRO
    dispersions: Path | None = Option(
        None,
        help="TOML with a table named dispersions: initial errors and gyro parameters that differ from run to run.",
    )
    seed: int | None = Option(None, help="Seed. Default: that of the scenario.")
    states: bool | None = ui.STATES


@dataclass(frozen=True)
class _Computing:
    """Runs and computation."""

    runs: int | None = Option(None, help="Number of runs. Default: 1000, or that of the resumed file.")
    threads: int | None = Option(None, help="Number of threads. Default: one per core.")
    machine: str = Option("auto", help="lanes (eight runs at once), scalar (any filter), or auto.")
    chunk: int | None = Option(None, help="Runs between merges and writes. Default: chosen by the machine.")
    workers: int | None = Option(None, help="Number of processes to use instead of threads (needs Dask).")
    cluster: str | None = Option(
        None,
        help="Compute on the Dask scheduler at this address, tcp://HOST:8786, or tls:// with Dask's certificates configured. Scheduler "
        "and workers can run any code in your account (they send pickles): connect only to one that you trust.",
    )
    resume: bool = Option(False, "--resume", help="Continue with the file if it exists.")
    overwrite: bool = Option(False, "--overwrite", help="Start from the beginning even if the file exists.")


@ui.command
def montecarlo(
    *,
    scenario: str = Argument(help=f"{ui.SCENARIO[:-1]}, or the HDF5 file of a campaign, with its plan."),
    model: _Model,
    computing: _Computing,
    out: Path | None = Option(None, help="HDF5 file. Default: NAME-montecarlo.h5 with the name of the scenario."),
    replay: int | None = Option(None, help="Repeat this run and write its record and estimate."),
    tables: Path | None = ui.TABLES,
) -> None:
    """Run many simulations of a scenario and judge the filter: exit status 0 consistent, 1 not, 3 cannot tell."""
    source, again = Path(scenario), computing.resume or computing.overwrite
    held, plan = _planned(source, scenario, model)
    if held is not None and computing.machine == "auto":
        computing = replace(computing, machine=held.machine)
    target = out or (source if held is not None else Path(f"{source.stem}-montecarlo.h5"))
    beside = target.with_suffix(".json")
    if computing.resume and computing.overwrite:
        raise InputError("--resume and --overwrite exclude each other; give one of them")
    if beside.exists() and not target.exists() and not computing.overwrite and replay is None:
        raise InputError(f"{beside} exists and would be replaced; move it, choose another --out, or give --overwrite")
    ui.check_files(target, suffixes=_SUFFIXES)
    ui.check_files(beside, tables=tables)
    if replay is not None:
        _replay(plan, replay, computing.machine, target)
        return
    if held is not None and target == source and not again:
        status, _, listed = _print_result(held)
        ui.written(tables=(tables, listed))
    else:
        status, content, listed = _print_result(_computed(plan, target, source.stem, computing))
        write_json(beside, content)
        ui.written(target, beside, tables=(tables, listed))
    raise typer.Exit(status)


def _planned(source: Path, scenario: str, model: _Model) -> tuple[Campaign | None, Plan]:
    """Return the campaign of a file, None if the source is no campaign file, and the plan."""
    from strapdown import workflows
    from strapdown.estimation.setup import read_setup
    from strapdown.montecarlo import campaign as campaigns
    from strapdown.workflows import filters

    own = _own_filter(model.filter_file)
    if source.suffix.lower() in _SUFFIXES:
        held = campaigns.read(source)
        if own is not None:
            held, model = campaigns.with_filter(held, own, source), replace(model, filter_file=None)
        for name in ui.options_given(model):
            raise InputError(f"{name} is given, but {source} contains its own; leave it out, or name a scenario")
        return held, held.plan
    from_file = None if model.filter_file is None or own is not None else read_setup(model.filter_file)
    plan = workflows.plan(
        sd.scenarios.load_scenario(scenario),
        gyro=None if model.gyro is None else sd.gyro.read_spec(model.gyro),
        setup=from_file if own is None else own,
        seed=model.seed,
        states=model.states,
        dispersions=None if model.dispersions is None else sd.montecarlo.read_dispersions(model.dispersions),
    )
    if model.states is None and model.filter_file is None and plan.setup.states is not None:
        ui.say(filters.state_words(plan.setup.states.names))
    if plan.individuals:
        ui.say("Each run draws its own gyro and sensors: specified constant errors are standard deviations.")
    return None, plan


def _own_filter(place: Path | None) -> Own | None:
    """Return the filter of a Python file, ``FILE.py:NAME``, which is executed; None for any other file."""
    from strapdown.estimation.filters.own import read_filter

    if place is None or not (place.suffix == ".py" or ".py:" in place.name):
        return None
    ui.say(f"Executing {place.name.partition(':')[0]} with your permissions.")
    return read_filter(place)


def _computed(plan: Plan, target: Path, name: str, options: _Computing) -> Campaign:
    """Compute the runs, in threads or on Dask, and write each chunk to the file."""
    from strapdown.montecarlo import campaign as campaigns

    runs = options.runs
    if runs is None:
        runs = campaigns.read(target).runs if options.resume and target.exists() else _RUNS
    choice = sd.montecarlo.choose(plan, options.machine)
    count("runs", runs)
    sd.montecarlo.in_threads(options.threads)  # checks the number
    ui.say(f"{plan.scenario.name or name}: {ui.counted(runs, 'run')}, seed {plan.seed}, machine: {choice}.")
    with contextlib.ExitStack() as stack:
        workers = None
        if options.workers is not None or options.cluster is not None:
            from strapdown.montecarlo.cluster import dask_client, on_dask

            client = stack.enter_context(dask_client(workers=options.workers, address=options.cluster))
            workers = on_dask(client)
            ui.say(f"Dask at {client.scheduler.address}: {sum(client.nthreads().values())} worker threads.")
        stop_if_asked = stack.enter_context(asked_to_stop())
        advance = stack.enter_context(ui.progress_bar("runs", runs))

        def advanced(number: int) -> None:
            advance(number)
            stop_if_asked()

        how = {name: getattr(options, name) for name in ("resume", "overwrite", "chunk", "machine", "threads")}
        try:
            return campaigns.run(plan, target, runs=runs, workers=workers, progress=advanced, **how)
        except KeyboardInterrupt:
            ui.say(f"The completed runs are in {target}; continue with --resume.")
            raise


@contextlib.contextmanager
def asked_to_stop() -> Iterator[Callable[[], None]]:
    """Treat SIGTERM, which batch systems send before they kill a process, as Ctrl-C, so that completed runs are written.

    Yields a function that raises again after a signal: Python drops an exception that is raised while a weak reference is cleared.
    """
    asked = False

    def ask(number: int, frame: Any) -> None:
        nonlocal asked
        asked = True
        raise KeyboardInterrupt

    def again() -> None:
        if asked:
            raise KeyboardInterrupt

    heeded = [number for number in (signal.SIGTERM, signal.SIGINT) if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, ask) for number in heeded}
    try:
        yield again
    finally:
        for heeded_signal, handler in before.items():
            signal.signal(heeded_signal, handler)


def _print_result(campaign: Campaign) -> tuple[int, dict[str, Any], list[Any]]:
    """Print the statistics and the verdict of `strapdown check`; return the exit status, the content of the JSON file, and the tables."""
    from strapdown.estimation.setup import MEKF
    from strapdown.montecarlo.verdicts import bound_of, tables

    if campaign.statistics is None:
        raise InputError("no chunk of the campaign is completed; continue it with --resume")
    if not campaign.finished:
        ui.say(f"{campaign.statistics.runs} of {campaign.runs} runs are completed.")
    report = sd.montecarlo.summary(campaign.statistics, bound=bound_of(campaign.plan))
    judgement = sd.check(campaign)
    listed = tables(report)
    ui.show(*listed)
    ui.say("Use --replay to examine a run.")
    rate = ""
    if campaign.seconds > 0.0:
        rate = f" ({rate_text(campaign.statistics.runs / campaign.seconds)} runs/s, including compilation)"
    ui.say(
        f"{ui.counted(report['runs'], 'run')}, {campaign.seconds:.3g} s{rate}. The verdict combines all {len(judgement.findings)} "
        f"statistics of `strapdown check`: a consistent filter passes with {100.0 * report['confidence_level']:g} %."
    )
    ui.say(judgement.words)
    if judgement.verdict == "cannot tell":
        ui.say("More runs (--runs, with --resume) are needed for a decision.")
    if judgement.unmodelled and campaign.plan.setup.states is None and campaign.plan.setup.estimator == MEKF:
        ui.say("--states adds states for most of these errors to the filter.")
    return (
        ui.STATUS.get(judgement.verdict, ui.CANNOT_TELL),
        {**campaign.summary(), "judgement": judgement.summary(), **report},
        listed,
    )


def _replay(plan: Plan, run: int, machine: str, target: Path) -> None:

    paths = [target.with_name(f"{target.stem}-run-{run}-{what}.h5") for what in ("record", "estimate")]
    ui.check_files(*paths)
    again = sd.montecarlo.replay(plan, run, machine=machine)
    sd.write(again.record, paths[0], attributes=again.estimate.details)
    sd.write(again.estimate, paths[1])
    nees, worst = again.largest_nees(plan.time)
    ui.say(
        f"Run {run} of seed {plan.seed}, machine: {sd.montecarlo.choose(plan, machine)}. Its maximum NEES at the {plan.epochs} epochs of "
        f"the campaign is {nees:.1f} ({'six' if again.estimate.has_bias else 'three'} states), at {worst:g} s."
    )
    ui.written(*paths)
