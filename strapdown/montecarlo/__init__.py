"""Monte Carlo: many independent runs of one scenario through one filter, and sums over runs at each epoch.

Memory grows with the number of epochs, not of runs: runs are computed in chunks, and the sums of the chunks are merged in their
order, so the statistics do not depend on the number of threads, processes or hosts.

- ``plan``: Definition of the computation: :class:`Plan`, :class:`Dispersions`.
- ``statistics``: Mergeable sums over runs: :class:`Statistics`; requirements on a machine.
- ``scalar``, ``lanes``: The machines that compute runs: the general one, and the fast one over SIMD vectors of runs.
- ``engine``: Choosing a machine, threads, merging: :func:`run_plan`, :func:`run`, :func:`replay`.
- ``verdicts``: Verdict and numbers from statistics, as a table: :func:`summary`.
- ``campaign``: A run with a checkpoint file, from which it can be resumed.
- ``cluster``: Chunks on other processes and hosts, by Dask.
- ``coning_study``: Integration error and consistency of the filter in coning motion: the command ``strapdown coning``.
"""

from strapdown.estimation.setup import FilterSetup as FilterSetup
from strapdown.montecarlo import campaign as campaign
from strapdown.montecarlo import cluster as cluster
from strapdown.montecarlo import coning_study as coning_study
from strapdown.montecarlo.engine import choose as choose
from strapdown.montecarlo.engine import replay, run, run_plan
from strapdown.montecarlo.plan import Dispersions, Plan
from strapdown.montecarlo.plan import from_table as from_table
from strapdown.montecarlo.plan import read_dispersions as read_dispersions
from strapdown.montecarlo.plan import whole_epochs as whole_epochs
from strapdown.montecarlo.scalar import start as start
from strapdown.montecarlo.statistics import Statistics
from strapdown.montecarlo.statistics import merge as merge
from strapdown.montecarlo.verdicts import summary

__all__ = ["Dispersions", "Plan", "Statistics", "replay", "run", "run_plan", "summary"]
