from strapdown.estimation.gating import *
from strapdown.estimation.gating import (
    Gate,
    Robust,
    Monitor,
    student_scale,
    seen_from,
    linearise,
    Linearised,
    tilt_unknown,
    UNIFORM_SIGMA,
)
from strapdown.estimation.states import GateMemory
