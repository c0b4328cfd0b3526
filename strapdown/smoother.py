from functools import partial
from strapdown.estimation.smoothing import smooth as run

run_fixed_lag = run
