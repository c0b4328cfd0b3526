from strapdown.estimation.error_states import *
from strapdown.estimation.forward import run, run_part as run_on
from strapdown.estimation.model import with_error_states as initial_state
from strapdown.estimation.observability import Observability, observability
from strapdown.estimation.smoothing import relinearized_start as recentred, smooth
from strapdown.estimation.states import State as AugmentedState
from strapdown.records import Estimate as AugmentedEstimate, ErrorStateEstimate as BlockEstimate

smooth_fixed_lag = smooth


def __getattr__(name):
    if name in ("SensorStates", "States"):
        from strapdown.augmented import states

        return getattr(states, name)
    raise AttributeError(name)
