"""Chunks on Dask: the bits of one process, whoever computes them and whoever is killed meanwhile."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import CancelledError
from dataclasses import replace

import pytest
from spin_plan import PLAN, SCENARIO, assert_same

from strapdown import cli, montecarlo
from strapdown.checks import InputError
from strapdown.estimation import setup as setups
from strapdown.montecarlo import cluster, engine

distributed = pytest.importorskip(
    "distributed", reason="the extra `cluster` is not installed: pip install '.[cluster]'"
)


def alone(runs, chunk, plan=PLAN):
    return montecarlo.run_plan(plan, runs=runs, chunk=chunk, threads=1, machine="scalar")


@pytest.fixture(scope="module")
def client():
    """A scheduler and two workers in this process."""
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, silence_logs="ERROR"
        ) as local,
        distributed.Client(local, set_as_default=False) as here,
    ):
        yield here


def test_dask_gives_the_bits_of_one_process(client):
    reported = []
    statistics = montecarlo.run_plan(
        PLAN, runs=43, chunk=4, machine="scalar", workers=cluster.on_dask(client), progress=reported.append
    )
    assert sum(reported) == 43
    assert_same(statistics, alone(43, 4))


def test_a_plan_is_unpacked_once_a_worker(client):
    cluster._work.cache_clear()
    montecarlo.run_plan(PLAN, runs=30, chunk=2, machine="scalar", workers=cluster.on_dask(client))
    assert cluster._work.cache_info().misses <= 2  # two workers may begin at one moment


def test_scenarios_of_ones_own_go_to_the_workers_too(client):
    class Wobble:
        def __getattr__(self, name):
            if name.startswith("__"):
                raise AttributeError(name)
            return getattr(SCENARIO.motion, name)

    plan = replace(PLAN, scenario=replace(SCENARIO, motion=Wobble()))
    statistics = montecarlo.run_plan(plan, runs=6, chunk=2, machine="scalar", workers=cluster.on_dask(client))
    assert_same(statistics, alone(6, 2))


def test_an_error_on_a_worker_comes_out(client):
    class Broken(engine.Work):
        def __call__(self, first_run, runs):
            raise InputError(f"runs from {first_run} cannot be computed")

    with pytest.raises(InputError, match="cannot be computed"):
        list(cluster.on_dask(client)(Broken(plans=(PLAN,), machine="scalar"), engine.chunks_of(8, 2)))


@pytest.mark.parametrize(("name", "value"), [("version", "0.0.1"), ("sources", "0123"), ("arithmetic", "no FMA")])
def test_a_worker_of_another_version_edit_or_rounding_is_refused(client, monkeypatch, name, value):
    here = engine.identity()
    wanted = here._replace(**{name: value})
    message = (
        f"a worker has another {name} of strapdown, {getattr(here, name)}, than the process that uses it, {value}, "
    )
    with pytest.raises(InputError, match=message):
        cluster._chunk(b"is not unpacked", 0, 2, wanted)

    def sent(payload, first, runs, identity):
        raise InputError(f"{identity == here}")

    monkeypatch.setattr(cluster, "_chunk", sent)
    with pytest.raises(InputError, match="True"):
        montecarlo.run_plan(PLAN, runs=2, chunk=2, machine="scalar", workers=cluster.on_dask(client))


def test_a_scheduler_without_workers_is_refused_and_not_waited_for(monkeypatch):
    monkeypatch.setattr(cluster, "WORKERS_SECONDS", 0.2)
    with (
        distributed.LocalCluster(
            n_workers=0,
            processes=False,
            protocol="tcp",
            host="127.0.0.1",
            dashboard_address=None,
            silence_logs="CRITICAL",
        ) as local,
        cluster.dask_client(address=local.scheduler_address) as here,
        pytest.raises(InputError, match=r"the scheduler at tcp://\S+ has no workers; start some, `dask worker tcp://"),
    ):
        montecarlo.run_plan(PLAN, runs=2, chunk=2, machine="scalar", workers=cluster.on_dask(here))


def test_the_reason_of_a_lost_scheduler_is_one_line(client):
    error = cluster._lost(client, CancelledError("cancelled for reason: connection-lost.\nClient lost the connection."))
    assert "(cancelled for reason: connection-lost. Client lost the connection.)" in str(error)


def test_a_scheduler_that_is_killed_ends_the_campaign_with_one_line(tmp_path, monkeypatch):
    """Its processes are killed while a chunk computes."""
    monkeypatch.setattr(cluster, "WORKERS_SECONDS", 2)
    code = (
        "import time, distributed\n"
        "local = distributed.LocalCluster(n_workers=1, processes=False, protocol='tcp', host='127.0.0.1', dashboard_address=None)\n"
        "print(local.scheduler_address, flush=True)\n"
        "time.sleep(600)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    try:
        address = process.stdout.readline().strip()
        with (
            cluster.dask_client(address=address) as here,
            pytest.raises(InputError, match=rf"the scheduler at {address} was lost .*; what was finished is kept"),
        ):
            montecarlo.run_plan(
                PLAN, runs=400, chunk=2, workers=cluster.on_dask(here), progress=lambda _: process.kill()
            )
    finally:
        process.kill()
        process.wait()


def test_the_help_says_what_trust_a_scheduler_takes(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["strapdown", "montecarlo", "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    assert "can run any code in your account" in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_without_the_extra_the_remedy_is_reported(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'strapdown\[cluster\]'"), cluster.dask_client(workers=2):
        pass
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["strapdown", "montecarlo", "spin", "--workers", "2", "--machine", "scalar"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    assert "strapdown[cluster]" in capsys.readouterr().err.replace("\n", "")
    assert not list(tmp_path.iterdir())


def test_bad_clusters_are_refused(monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 1)
    for options, message in (
        ({"address": "tcp://127.0.0.1:9"}, r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"),
        ({"address": "nonsense://x"}, "no Dask scheduler answers at nonsense://x"),
        ({"address": "tcp://127.0.0.1:9", "workers": 1}, "exclude each other"),
        ({"workers": 0}, "workers is 0"),
    ):
        with pytest.raises(InputError, match=message), cluster.dask_client(**options):
            pass


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "machine"), [(1, "scalar"), (2, "scalar"), (3, "scalar"), (2, "lanes")])
def test_worker_processes_give_the_bits_of_one_process(workers, machine):
    with cluster.dask_client(workers=workers) as client:
        statistics = montecarlo.run_plan(PLAN, runs=60, chunk=4, machine=machine, workers=cluster.on_dask(client))
    assert_same(statistics, montecarlo.run_plan(PLAN, runs=60, chunk=4, threads=1, machine=machine))


@pytest.mark.slow
def test_ctrl_c_ends_a_campaign_on_worker_processes_without_their_tracebacks(tmp_path):
    """A terminal sends it to the workers too."""
    command = [sys.executable, "-m", "strapdown", "montecarlo", "two-stars", "--runs", "100000", "--workers", "2"]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "c.h5")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        text=True,
    )
    try:
        while not (tmp_path / "c.h5").exists() or montecarlo.campaign.read(tmp_path / "c.h5").finished_runs == 0:
            assert process.poll() is None
            time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)
        printed = process.communicate(timeout=60)[0]
    finally:
        process.kill()
    assert process.returncode == 130
    assert "continue with --resume" in printed
    assert "Traceback" not in printed


@pytest.mark.slow
def test_a_killed_worker_costs_only_its_chunk():
    """One of two worker processes is killed in the middle; the campaign ends in the same bits."""
    longer = replace(SCENARIO, duration=60.0)
    plan = montecarlo.Plan(
        scenario=longer, setup=setups.FilterSetup.for_scenario(longer, states=False), seed=4, epochs=6, nis_bins=5
    )
    with cluster.dask_client(workers=2) as client:
        pid, *_ = client.run(os.getpid).values()
        computed = []

        def progress(runs):
            computed.append(runs)
            if len(computed) == 10:
                os.kill(pid, signal.SIGKILL)

        statistics = montecarlo.run_plan(
            plan, runs=160, chunk=4, machine="scalar", workers=cluster.on_dask(client), progress=progress
        )
        assert pid not in client.run(os.getpid).values()
    assert len(computed) == 40  # every chunk came once
    assert_same(statistics, alone(160, 4, plan))
