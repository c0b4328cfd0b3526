"""High-level functions for the most common tasks, available as ``sd.NAME`` after ``import strapdown as sd``; also used by the command line.

Each function chooses gyro noise, filter and initial state from the data and then calls a module that has more options:
:mod:`strapdown.estimation` and :mod:`strapdown.estimation.setup`, :mod:`strapdown.ahrs`, :mod:`strapdown.consistency`,
:mod:`strapdown.montecarlo`, :mod:`strapdown.tuning`, :mod:`strapdown.covariance`.
"""

from strapdown.covariance import analyse as covariance_analysis
from strapdown.recordings.attitudes import read_attitudes
from strapdown.scenarios import simulate
from strapdown.workflows.campaigns import monte_carlo, plan
from strapdown.workflows.estimating import Run, estimate, smooth
from strapdown.workflows.files import read, write
from strapdown.workflows.integrating import integrate
from strapdown.workflows.judging import accuracy, check, diagnose
from strapdown.workflows.tuning import tune

__all__ = [
    "Run",
    "accuracy",
    "check",
    "covariance_analysis",
    "diagnose",
    "estimate",
    "integrate",
    "monte_carlo",
    "plan",
    "read",
    "read_attitudes",
    "simulate",
    "smooth",
    "tune",
    "write",
]
