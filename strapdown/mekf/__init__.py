from strapdown.estimation.forward import GAP_FACTOR, gaps, run, run_part as run_on
from strapdown.estimation.schedule import Schedule, innovations_by_sensor, schedule, skipped_too
from strapdown.estimation.states import (
    FIRST_SETS,
    ONCE,
    VERTICAL,
    ProcessNoise,
    State,
    covariance_matrices,
    first_state,
    initial_state,
    pack,
)
