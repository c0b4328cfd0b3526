"""Processor times of calls in one process, and the command line that the benchmarks share."""

from __future__ import annotations

import argparse
import inspect
import json
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from strapdown.files import write_json
from strapdown.kernels.machine import describe
from strapdown.results import Column, Table

Work = tuple[Callable[[], object], int]
"""A call, and the number of samples that it processes."""


def least(works: Mapping[str, Work], repeats: int = 7) -> dict[str, float]:
    """Return the least processor time of each call, ns per sample, after a first call that compiles.

    The calls run in turn, so that a drift of the machine's speed affects all of them.
    """
    best = dict.fromkeys(works, math.inf)
    for call, _ in works.values():
        call()
    for _ in range(repeats):
        for name, (call, samples) in works.items():
            begin = time.process_time()  # excludes other processes
            call()
            best[name] = min(best[name], 1e9 * (time.process_time() - begin) / samples)
    return best


def table(times: Mapping[str, float], base: str) -> Table:
    """Return times, ns, as a table with their ratios to that of ``base``."""
    rows = [(name, t, t / times[base]) for name, t in times.items()]
    return Table("", ["", Column("time per sample, ns"), Column("ratio", digits=3)], rows)


def command(main: Callable[..., dict[str, float]], base: str) -> None:
    """Run a benchmark as a program: the arguments of ``main`` are its options; print and, with ``--json``, write its times."""
    parser = argparse.ArgumentParser(description=str(inspect.getmodule(main).__doc__).splitlines()[0])
    for name, argument in inspect.signature(main).parameters.items():
        parser.add_argument(f"--{name}", type=type(argument.default), default=argument.default)
    parser.add_argument("--json", type=Path)
    options = vars(parser.parse_args())
    path, machine = options.pop("json"), describe()
    print(json.dumps(machine))
    times = main(**options)
    print(table(times, base).text)
    if path:
        write_json(path, {"machine": machine, **options, "ns_per_sample": times})
