"""Monte Carlo campaigns."""

from __future__ import annotations

import contextlib
import json
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from strapdown.checks import InputError, count
from strapdown.cli.filters import default_words, filter_of_scenario, own_filter
from strapdown.cli.progress import progress_bar, rate_text
from strapdown.cli.terminal import (
    TABLES,
    command,
    console,
    counted,
    given,
    scenario_named,
    show,
    table,
    tables_folder,
    tables_written,
    verdict,
    writable,
    written,
)
from strapdown.files import write_json

if TYPE_CHECKING:
    from types import FrameType

    from strapdown.estimation.filters.own import Own
    from strapdown.montecarlo import Plan
    from strapdown.montecarlo.campaign import Campaign

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
    """Run many simulations of a scenario and judge the filter: exit status 0 consistent, 1 not, 2 cannot tell (or bad input)."""
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
        status, content = _print_result(held)
        if output.tables is not None:
            written(*tables_written(output.tables, "montecarlo", content))
        raise typer.Exit(status)
    result = _computed(plan, target, source.stem, replace(computing, machine=machine), output)
    status, content = _print_result(result)
    write_json(target.with_suffix(".json"), content)
    written(target, target.with_suffix(".json"), *tables_written(output.tables, "montecarlo", content))
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
    for name in given(model):
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
        hands = None
        if computing.workers is not None or computing.cluster is not None:
            from strapdown.montecarlo.cluster import dask_client, on_dask

            client = stack.enter_context(dask_client(workers=computing.workers, address=computing.cluster))
            hands = on_dask(client)
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
                workers=hands,
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


def _print_result(campaign: Campaign) -> tuple[int, dict[str, Any]]:
    """Print the statistics and the verdict of `strapdown check`; return the exit status and the content of the JSON file."""
    from strapdown.cli.judgement import status_of
    from strapdown.estimation.setup import MEKF
    from strapdown.montecarlo import summary
    from strapdown.montecarlo.verdicts import bound_of

    if campaign.statistics is None:
        raise InputError("no chunk of the campaign is completed; continue it with --resume")
    if not campaign.finished:
        console.print(f"{campaign.statistics.runs} of {campaign.runs} runs are completed.")
    report = summary(campaign.statistics, bound=bound_of(campaign.plan))
    figure = lambda value: "-" if value is None else f"{value:.4g}" if value >= 1e3 else f"{value:.4f}"  # noqa: E731
    judgement = campaign.statistics.judge(unmodelled=campaign.plan.unmodelled)
    rows = table(
        f"Per degree of freedom; 1 for a consistent filter. NEES over {report['epochs_judged']} epochs",
        *("", "mean", "minimum", "maximum", "from", "to", ""),
    )
    for subset, part in report["nees"].items():
        values = (part["anees"], part["least"], part["greatest"], *part["bounds"])
        rows.add_row(f"NEES of the {subset}", *map(figure, values), verdict(part["consistent"]))
    for part in report["nis"]:
        name = f"NIS of {part['sensor']}"
        rows.add_row(name, figure(part["nis"]), "", "", *map(figure, part["bounds"]), verdict(part["consistent"]))
    show(rows)
    refused = ", ".join(f"{part['refused']} of {part['sensor']}" for part in report["nis"] if part["refused"])
    if refused:
        console.print(f"The gate rejected {refused}.")
    _print_errors(report)
    worst = ", ".join(
        f"{part['run']} ({'failed' if part['largest_nees'] is None else format(part['largest_nees'], '.1f')})"
        for part in report["worst_runs"][:5]
    )
    console.print(f"Worst runs, by maximum NEES of the state: {worst}. Use --replay to examine one.")
    if report["failed_runs"]:
        console.print(f"In {counted(report['failed_runs'], 'run')} the filter failed: no finite error or covariance.")
    rate = ""
    if campaign.seconds > 0.0:
        rate = f" ({rate_text(campaign.statistics.runs / campaign.seconds)} runs/s, including compilation)"
    console.print(
        f"{counted(report['runs'], 'run')}, {campaign.seconds:.3g} s{rate}. The verdict combines all {len(judgement.findings)} "
        f"statistics of `strapdown check`: a consistent filter passes with {100.0 * report['probability']:g} %."
    )
    console.print(judgement.words)
    if judgement.verdict == "cannot tell":
        console.print("More runs (--runs, with --resume) are needed for a decision.")
    if judgement.unmodelled and campaign.plan.setup.states is None and campaign.plan.setup.estimator == MEKF:
        console.print("--states adds states for most of these errors to the filter.")
    return status_of(judgement), {
        "plan": campaign.plan.to_table(),
        "digest": campaign.plan.digest,
        "machine": campaign.machine,
        "lanes_do_not_serve": campaign.reason or None,
        "chunk": campaign.chunk,
        "version": campaign.version,
        "seconds": campaign.seconds,
        "judgement": judgement.summary(),
        **report,
    }


def _print_errors(report: dict[str, Any]) -> None:
    """Print the errors of the worst axis at the end, and the coverage."""
    from strapdown.montecarlo.verdicts import QUANTILES

    last = report["last_epoch"]
    errors = table(
        f"Errors at {last['time_s']:g} s, worst axis; fraction of the tested errors within kσ",
        "",
        "unit",
        "RMS",
        "filter's σ",
        *(f"{100.0 * q:g} %" for q in QUANTILES),
        "1σ",
        "2σ",
        "3σ",
        left=2,
    )
    for name, unit, text in (("attitude", "arcsec", "arcsec"), ("bias", "deg_per_hour", "°/h")):
        if name not in report["nees"]:  # a user's filter without a bias
            continue
        axis = int(np.argmax([np.inf if x is None else x for x in last[f"{name}_rms_error_{unit}"]]))
        keys = ("rms_error", "sigma", *(f"error_quantile_{q:g}" for q in QUANTILES))
        sizes = [last[f"{name}_{key}_{unit}"][axis] for key in keys]
        large = name == "attitude" and (sizes[0] or 0.0) > 3600.0
        if large:
            sizes = [None if x is None else x / 3600.0 for x in sizes]
        shares = ("-" if x is None else f"{100.0 * x:.2f} %" for x in report["coverage"][name])
        errors.add_row(
            f"{name} {'xyz'[axis]}", "°" if large else text, *("-" if x is None else f"{x:.4g}" for x in sizes), *shares
        )
    show(errors)
    expected = ", ".join(f"{100.0 * share:.2f}" for share in report["coverage"]["expected"])
    console.print(f"For a consistent filter, {expected} % of the errors are within 1, 2, 3 σ.")
    if (efficiency := report.get("rms_over_root_cramer_rao_bound")) is not None:
        low, high = efficiency["bounds_of_an_efficient_filter"]
        ratios = "; ".join(
            f"{name} {', '.join(f'{x:.3f}' for x in efficiency[name])}"
            for name in ("attitude", "bias")
            if name in efficiency
        )
        console.print(
            f"RMS error divided by the root of the Cramér–Rao bound, by axis: {ratios} "
            f"(at one epoch {low:.3f} to {high:.3f} for an efficient filter)."
        )


def _replayed(target: Path, run: int) -> list[Path]:
    """Return the files of a replayed run: record and estimate."""
    return [target.with_name(f"{target.stem}-run-{run}-{what}.h5") for what in ("record", "estimate")]


def _replay(plan: Plan, run: int, machine: str, target: Path) -> None:

    from strapdown import consistency
    from strapdown import montecarlo as engine
    from strapdown.estimation import setup
    from strapdown.recordings import recordfiles
    from strapdown.records import Origin, Truth, write_estimate
    from strapdown.scenarios import scenario_to_toml

    choice = engine.choose(plan, machine)
    again = engine.replay(plan, run, machine=machine)
    truth = again.record.truth
    assert truth is not None
    # If a filter step combines several samples, the record is at the samples or at the steps, depending on the machine.
    edges = np.searchsorted(again.record.time, again.estimate.time - 1e-9)
    true = Truth(attitude=truth.attitude[edges], bias=truth.bias[edges])
    attributes: dict[str, Any] = {
        "scenario": scenario_to_toml(plan.scenario),
        "seed": plan.seed,
        "run": run,
        "machine": choice.machine,
        "filter": setup.to_toml(plan.setup),
        "dispersions": json.dumps(plan.to_table()["dispersions"]),
    }
    paths = _replayed(target, run)
    origin = Origin(gyro=plan.scenario.gyro, scenario=plan.scenario, seed=plan.seed, run=run)
    recordfiles.write_record(
        paths[0],
        replace(again.record, origin=origin),
        attributes={name: attributes[name] for name in ("machine", "dispersions")},
    )
    write_estimate(paths[1], again.estimate, attributes, truth=true)
    estimate = again.estimate
    size, states = (6, "six") if estimate.has_bias else (3, "three")
    error = consistency.errors(estimate.attitude, np.nan_to_num(estimate.bias), true.attitude, true.bias)[:, :size]
    assert estimate.covariance is not None
    nees = consistency.nees(error, estimate.covariance[:, :size, :size])
    step = int(np.argmax(nees))
    console.print(
        f"Run {run} of seed {plan.seed}, machine: {choice}. Its maximum NEES is {nees[step]:.4g} ({states} states), "
        f"at {estimate.time[step]:g} s."
    )
    written(*paths)
