from strapdown.estimation.multiple_model import *
from strapdown.estimation.multiple_model import run, run_recovering
