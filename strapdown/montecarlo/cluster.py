"""Chunks on other processes and hosts, through Dask distributed (the extra ``cluster``).

Chunks are bitwise identical on processors of one kind (:func:`strapdown.montecarlo.engine.arithmetic`); Dask reassigns the chunk of a lost
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
from collections.abc import Iterator
from typing import Any

import strapdown
from strapdown.checks import InputError, count
from strapdown.files.extras import library
from strapdown.montecarlo.engine import Chunks, Parts, Window, Work, Workers, arithmetic

__all__ = [
    "dask_client",
    "on_dask",
]

CONNECT_SECONDS = 15


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
        yield client


def on_dask(client: Any) -> Workers:
    """Return workers that compute chunks of runs through a Dask client.

    Workers may join and leave during the work. At most two chunks per thread are submitted ahead.

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
        If the cluster has no workers, or another version of this package.
    """
    distributed = library("distributed", "a cluster of workers", "cluster")

    def work_through(work: Work, chunks: Chunks) -> Iterator[tuple[int, Parts]]:
        payload = distributed.protocol.pickle.dumps(work)  # the user's classes and functions are pickled by value
        window = Window(len(chunks), 2 * max(1, sum(client.nthreads().values())))
        places: dict[Any, int] = {}
        finished = distributed.as_completed(loop=client.loop)
        try:
            while window.open:
                while (place := window.begin()) is not None:
                    future = client.submit(_chunk, payload, *chunks[place], pure=False)
                    places[future] = place
                    finished.add(future)
                future = next(finished)
                place = places.pop(future)
                version, features, parts = _result(distributed, future, chunks[place])
                if version != strapdown.__version__:
                    raise InputError(
                        f"a worker has strapdown {version}, this process {strapdown.__version__}; install the same everywhere"
                    )
                if features != arithmetic():
                    raise InputError(
                        f"a worker computes on {features}, this process on {arithmetic()}, which round differently; use workers "
                        "of one kind and start the campaign on such a machine"
                    )
                window.finish(place)
                yield place, parts
        finally:
            client.cancel(list(places))

    return work_through


def _result(distributed: Any, future: Any, chunk: tuple[int, int]) -> tuple[str, str, Parts]:
    runs = f"runs {chunk[0]} to {sum(chunk) - 1}"
    try:
        result: tuple[str, str, Parts] = future.result()
    except distributed.KilledWorker:
        raise InputError(
            f"{runs} were lost because every worker that computed them died; check the workers' logs and memory"
        ) from None
    except ModuleNotFoundError as error:
        raise InputError(
            f"a worker cannot compute {runs} ({error}); install strapdown {strapdown.__version__} there"
        ) from None
    return result


def _chunk(payload: bytes, first_run: int, runs: int) -> tuple[str, str, Parts]:
    """Compute a chunk on a worker; return it with the worker's version and arithmetic."""
    return strapdown.__version__, arithmetic(), _work(payload)(first_run, runs)


@functools.lru_cache(maxsize=4)
def _work(payload: bytes) -> Work:
    """Return the unpickled work, one object for all chunks of a worker, so that a plan is prepared once per worker."""
    work: Work = pickle.loads(payload)
    return work
