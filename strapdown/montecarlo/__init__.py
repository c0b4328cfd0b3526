"""Monte Carlo: many independent runs of one scenario through one filter, and sums over runs at each epoch.

Memory grows with the number of epochs, not with the number of runs: runs are taken in chunks, and the chunks' sums are merged in their
order, so the statistics do not depend on the number of threads, processes or hosts.

``plan``
    What is computed: :class:`Plan`, :class:`Dispersions`.
``statistics``
    Mergeable sums over runs: :class:`Statistics`; what a machine must return.
``scalar``, ``lanes``
    The machines: the general one, and the fast one over vectors of runs.
``engine``
    Choosing a machine, threads, merging: :func:`run_plan`, :func:`run`, :func:`replay`.
``verdicts``
    What statistics say of a filter, as a table: :func:`summary`.
``campaign``
    A run that survives being killed, and its file.
``cluster``
    Chunks on other processes and hosts, through Dask.
"""

from __future__ import annotations

from strapdown.montecarlo.engine import Choice, choose, in_threads, machine_named, replay, run, run_plan
from strapdown.montecarlo.plan import Dispersions, Plan, from_table, read_dispersions, whole_epochs
from strapdown.montecarlo.scalar import start
from strapdown.montecarlo.statistics import EXAMPLES, WORST, Replay, Statistics, judged_epochs, merge, merge_all
from strapdown.montecarlo.verdicts import summary
from strapdown.setup import FilterSetup

__all__ = [
    "EXAMPLES",
    "WORST",
    "Choice",
    "Dispersions",
    "FilterSetup",
    "Plan",
    "Replay",
    "Statistics",
    "choose",
    "from_table",
    "in_threads",
    "judged_epochs",
    "machine_named",
    "merge",
    "merge_all",
    "read_dispersions",
    "replay",
    "run",
    "run_plan",
    "start",
    "summary",
    "whole_epochs",
]
