"""Monte Carlo campaigns."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError, count
from strapdown.cli import terminal as ui
from strapdown.cli.options import GYRO, SCENARIO, STATES, options_given
from strapdown.files import HDF5, write_json
from strapdown.results import counted

if TYPE_CHECKING:
    from strapdown.montecarlo import Plan
    from strapdown.montecarlo.campaign import Campaign


@dataclass(frozen=True)
class _Model:
    """Filter and errors; a campaign file contains its own."""

    filter_file: Path | None = Option(
        None, "--filter", help="TOML with a filter table, and its gate; or FILE.py:NAME, your own, executed."
    )
    gyro: Path | None = GYRO
    dispersions: Path | None = Option(None, help="TOML with a table named dispersions: what differs from run to run.")
    seed: int | None = Option(None, help="Seed. Default: that of the scenario.")
    states: bool | None = STATES


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
        help="Compute on the Dask scheduler at this address, tcp://HOST:8786 or tls://. Scheduler and workers can run any code in your "
        "account: connect only to one that you trust.",
    )
    resume: bool = Option(False, "--resume", help="Continue with the file if it exists.")
    overwrite: bool = Option(False, "--overwrite", help="Start from the beginning even if the file exists.")


@ui.command("tables")
def montecarlo(
    *,
    scenario: str = Argument(help=f"{SCENARIO[:-1]}, or the HDF5 file of a campaign, with its plan."),
    model: _Model,
    computing: _Computing,
    out: Path | None = Option(None, help="HDF5 file. Default: NAME-montecarlo.h5, of the scenario or TOML file."),
    replay: int | None = Option(None, help="Repeat this run and write its record and estimate."),
) -> dict[str, Any] | None:
    """Run many simulations of a scenario and judge the filter: exit status 0 consistent, 1 not, 3 cannot tell."""
    from strapdown.montecarlo import campaign, verdicts

    source = Path(scenario)
    held, plan = _planned(source, scenario, model)
    if held is not None and computing.machine == "auto":
        computing = replace(computing, machine=held.machine)
    target = out or (source if held is not None else Path(f"{source.stem}-montecarlo.h5"))
    beside = target.with_suffix(".json")
    if computing.resume + computing.overwrite + (replay is not None) > 1:
        raise InputError("--resume, --overwrite and --replay exclude each other; give one of them")
    if beside.exists() and not target.exists() and not computing.overwrite and replay is None:
        raise InputError(f"{beside} exists and would be replaced; move it, choose another --out, or give --overwrite")
    ui.check_files(target, suffixes=HDF5, reads=False)
    ui.check_files(beside)
    if replay is not None:
        if held is not None and replay >= held.runs:
            raise InputError(f"--replay is {replay}, and {source} has the runs 0 to {held.runs - 1}; give one of them")
        _replay(plan, replay, computing.machine, target)
        return None
    new = held is None or target != source or computing.resume or computing.overwrite
    result = held if held is not None and not new else _computed(plan, target, source.stem, computing)
    ui.show((judgement := sd.check(result)).listing(), title=ui.EVIDENCE)
    content = result.summary(judgement)
    ui.show(*verdicts.tables(content))
    ui.say("Use --replay to examine a run.", *campaign.words(result, judgement))
    if new:
        write_json(beside, content)
        ui.written(target, beside)
    return {"verdict": judgement.verdict}


def _planned(source: Path, scenario: str, model: _Model) -> tuple[Campaign | None, Plan]:
    """Return the campaign of a file, None if the source is no campaign file, and the plan."""
    from strapdown import workflows
    from strapdown.estimation.filters.own import Own, read_filter
    from strapdown.estimation.setup import FilterSetup, read_setup
    from strapdown.montecarlo import campaign as campaigns
    from strapdown.workflows import filters

    place: Path | None = model.filter_file
    setup: FilterSetup | Own | None = None
    if place is not None and (place.suffix == ".py" or ".py:" in place.name):
        ui.say(f"Executing {place.name.partition(':')[0]} with your permissions.")
        setup = read_filter(place)
    if source.suffix.lower() in HDF5:
        held = campaigns.read(source)
        if isinstance(setup, Own):
            held, model = campaigns.with_filter(held, setup, source), replace(model, filter_file=None)
        for name in options_given(model):
            raise InputError(f"{name} is given, but {source} contains its own; leave it out, or name a scenario")
        return held, held.plan
    plan = workflows.plan(
        sd.scenarios.load_scenario(scenario),
        noise=None if model.gyro is None else sd.gyro.read_spec(model.gyro),
        setup=read_setup(place) if place is not None and setup is None else setup,
        seed=model.seed,
        states=model.states,
        dispersions=None if model.dispersions is None else sd.montecarlo.read_dispersions(model.dispersions),
    )
    if model.states is None and place is None and plan.setup.states is not None:
        ui.say(filters.state_words(plan.setup.states.names))
    if plan.individuals:
        ui.say("Each run draws its own gyro and sensors: specified constant errors are standard deviations.")
    return None, plan


def _computed(plan: Plan, target: Path, name: str, options: _Computing) -> Campaign:
    """Compute the runs, in threads or on Dask, and write each chunk to the file."""
    from strapdown.montecarlo import campaign as campaigns

    runs = options.runs
    if runs is None:
        runs = campaigns.read(target).runs if options.resume and target.exists() else 1000
    choice = sd.montecarlo.choose(plan, options.machine)
    count("runs", runs)
    ui.say(f"{plan.scenario.name or name}: {counted(runs, 'run')}, seed {plan.seed}, machine: {choice}.")
    with contextlib.ExitStack() as stack:
        workers = None
        if options.workers is not None or options.cluster is not None:
            from strapdown.montecarlo.cluster import dask_client, on_dask

            client = stack.enter_context(dask_client(workers=options.workers, address=options.cluster))
            workers = on_dask(client)
            ui.say(f"Dask at {client.scheduler.address}: {sum(client.nthreads().values())} worker threads.")
        advance = stack.enter_context(ui.progress_bar("runs", runs))
        how = {name: getattr(options, name) for name in ("resume", "overwrite", "chunk", "machine", "threads")}
        try:
            return campaigns.run(plan, target, runs=runs, workers=workers, progress=advance, **how)
        except KeyboardInterrupt:
            ui.say(f"The completed runs are in {target}; continue with --resume." if target.exists() else "")
            raise


def _replay(plan: Plan, run: int, machine: str, target: Path) -> None:
    """Repeat a run, and write its record and its estimate."""
    paths = [target.with_name(f"{target.stem}-run-{run}-{what}.h5") for what in ("record", "estimate")]
    ui.check_files(*paths)
    again = sd.montecarlo.replay(plan, run, machine=machine)
    nees, worst = again.largest_nees(plan.time)
    ui.say(
        f"Run {run} of seed {plan.seed}, machine: {sd.montecarlo.choose(plan, machine)}. Its maximum NEES of the states at the "
        f"{plan.epochs} epochs of the campaign is {nees:.1f}, at {worst:g} s."
    )
    ui.written(sd.write(again.record, paths[0]), sd.write(again.estimate, paths[1]))
