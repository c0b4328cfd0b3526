"""Chunks on other processes and hosts, through Dask distributed (the extra ``cluster``).

Chunks are bitwise identical on processors of one kind (:func:`strapdown.montecarlo.engine.arithmetic`); Dask reassigns the chunks of a lost
worker.

Security: client, scheduler and workers exchange pickles, so each can run any code on the others. Use only a scheduler that you trust with
your account. Plain ``tcp://`` is neither encrypted nor authenticated; on a shared network use ``tls://`` with Dask's own configuration of
certificates: ``distributed.comm.tls.ca-file``, ``.client.cert`` and ``.client.key`` in a file of ``~/.config/dask``, or the environment
variables ``DASK_DISTRIBUTED__COMM__TLS__CA_FILE``, ``DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT`` and ``…__CLIENT__KEY``.
"""

from __future__ import annotations

import contextlib
import functools
import pickle
import signal
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError
from threading import Event
from typing import Any

import strapdown
from strapdown.checks import InputError, count
from strapdown.files import library
from strapdown.montecarlo.engine import Identity, Parts, Work, Workers, identity, in_order

__all__ = [
    "dask_client",
    "on_dask",
]

CONNECT_SECONDS = 15
WORKERS_SECONDS = 60
"""Time without a finished chunk after which there must be a worker, and time that a scheduler has to get its first."""


@contextlib.contextmanager
def dask_client(*, workers: int | None = None, address: str | None = None) -> Iterator[Any]:
    """Yield a Dask client: with worker processes of one thread each on this host, or of the scheduler at an address.

    Parameters
    ----------
    workers : int, optional
        Number of processes on this host.
    address : str, optional
        Address of a running scheduler, ``tcp://HOST:8786`` or ``tls://HOST:8786``. Scheduler and workers can run any code here: use only
        one that you trust.

    Yields
    ------
    distributed.Client

    Raises
    ------
    InputError
        If both are given, Dask is not installed, or no scheduler answers at the address.
    """
    if address is not None and workers is not None:
        raise InputError("workers and cluster exclude each other: a cluster has its own workers; give only one")
    distributed = library("distributed", "a cluster of workers", "cluster")
    if address is not None:
        try:
            client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address} ({error}); start one with `dask scheduler` and give its address, "
                "tcp://HOST:8786, or tls:// with Dask's certificates configured"
            ) from None
        with client:
            yield client
        return
    number = count("workers", 1 if workers is None else workers)
    cluster = distributed.LocalCluster(
        n_workers=number,
        threads_per_worker=1,
        processes=True,
        memory_limit=0,
        dashboard_address="127.0.0.1:0",  # any free port; the dashboard cannot be turned off
        silence_logs="ERROR",
    )
    with cluster, distributed.Client(cluster, set_as_default=False) as client:
        client.run(_ignore_ctrl_c)
        yield client


def _ignore_ctrl_c() -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that ends the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def on_dask(client: Any) -> Workers:
    """Return workers that compute chunks of runs through a Dask client.

    Workers may join and leave during the work.

    Parameters
    ----------
    client : distributed.Client
        Client connected to the workers, for instance of :func:`dask_client`.

    Returns
    -------
    Workers
        For ``workers`` of :func:`strapdown.montecarlo.run_plan` and :func:`strapdown.montecarlo.campaign.run`.

    Raises
    ------
    InputError
        If the cluster has no workers, if a worker has other sources of this package, or if the scheduler is lost.
    """
    distributed = library("distributed", "a cluster of workers", "cluster")

    def work_through(work: Work, chunks: Iterable[tuple[int, int]]) -> Iterator[Parts]:
        payload = distributed.protocol.pickle.dumps(work)  # the user's classes and functions are pickled by value
        _need_workers(client, distributed)

        def submit(first_run: int, runs: int) -> tuple[str, Any, Event]:
            future, done = client.submit(_chunk, payload, first_run, runs, identity(), pure=False), Event()
            future.add_done_callback(lambda _: done.set())
            return f"runs {first_run} to {first_run + runs - 1}", future, done

        for runs, future, done in in_order(chunks, submit, max(1, sum(client.nthreads().values()))):
            while not done.wait(WORKERS_SECONDS):
                _need_workers(client, distributed)
            yield _result(distributed, client, future, runs)

    return work_through


def _need_workers(client: Any, distributed: Any) -> None:
    """Wait for a worker; raise an error if none comes, or if the scheduler is gone."""
    try:
        client.wait_for_workers(1, timeout=WORKERS_SECONDS)
    except TimeoutError:
        address = client.scheduler.address
        raise InputError(
            f"the scheduler at {address} has no workers; start some, `dask worker {address}`, and begin or continue the campaign"
        ) from None
    except (OSError, ValueError, RuntimeError) as error:
        raise _lost(client, error) from None


def _lost(client: Any, error: object) -> InputError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return InputError(
        f"the scheduler at {client.scheduler.address} was lost ({reason}); what was finished is kept: start it again and continue the "
        "campaign"
    )


def _result(distributed: Any, client: Any, future: Any, runs: str) -> Parts:
    """Return what a worker computed."""
    try:
        parts: Parts = future.result()
    except distributed.KilledWorker:
        raise InputError(
            f"{runs} were lost because every worker that computed them died; check the workers' logs and memory"
        ) from None
    except ModuleNotFoundError as error:
        raise InputError(
            f"a worker cannot compute {runs} ({error}); install strapdown {strapdown.__version__} there"
        ) from None
    except (CancelledError, distributed.comm.CommClosedError) as error:
        raise _lost(client, error) from None
    return parts


def _chunk(payload: bytes, first_run: int, runs: int, wanted: Identity) -> Parts:
    """Compute a chunk on a worker, if it is of the wanted identity."""
    for name, own, other in zip(Identity._fields, identity(), wanted, strict=True):
        if own != other:
            raise InputError(
                f"a worker has another {name} of strapdown, {own}, than the process that uses it, {other}, and may compute other bits; "
                "install the same everywhere, on processors of one kind, and restart the workers"
            )
    return _work(payload)(first_run, runs)


@functools.lru_cache(maxsize=4)
def _work(payload: bytes) -> Work:
    """Return the unpickled work, one object for all chunks of a worker, so that a plan is prepared once per worker."""
    work: Work = pickle.loads(payload)
    return work
