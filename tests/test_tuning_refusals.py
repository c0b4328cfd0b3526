"""What tuning refuses: a call, and the argument that is named."""

from dataclasses import replace

import numpy as np
import pytest
from measured import FIELD, HAND
from two_stars import BELIEVED, FREE, case, drawn_case, scenario

from strapdown import covariance, gyro, tuning, vectors, workflows
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.estimation.states import ProcessNoise
from strapdown.recordings import Recording

ONE = case(duration=20.0)
ATTITUDE_ALONE = replace(ONE, record=replace(ONE.record, truth=None), true_attitude=ONE.record.truth.attitude)
SHORT = replace(ONE, record=replace(ONE.record, vectors=tuple(s.taken([0]) for s in ONE.record.vectors)))
SILENT = replace(ONE.record.vectors[0], sigma=np.zeros(1))
SILENT = replace(ONE.record, vectors=(SILENT, *ONE.record.vectors[1:]))
BARE = Recording(source="bare", time=np.arange(5000) / 100.0, rate=np.zeros((5000, 3)))
COMPASS = replace(
    scenario(5.0),
    motion=HAND,
    sensors=(
        vectors.Magnetometer(name="mag", field_f=FIELD, sigma=5e-7, rate=10.0, kind="heading"),
        vectors.Accelerometer(name="acc", sigma=0.05, rate=10.0, kind="vector"),
    ),
)
MATCHED = setup.FilterSetup.for_scenario(COMPASS, states=False)
HELD = drawn_case(COMPASS, MATCHED, 1)
AXES = replace(MATCHED, sigma={"mag": (0.1, 0.1, 0.1)})
OF_ANOTHER = replace(MATCHED, states=States(sensors={"acd": SensorStates(bias_sigma=1.0)}))
COLOURED = replace(MATCHED, states=States(sensors={"acc": SensorStates(correlated_sigma=0.4, correlation_time=1.0)}))
STEADY = replace(BELIEVED, process_noise=ProcessNoise(angle_random_walk=1e-4, rate_random_walk=0.0))
UNSPECIFIED = {"gyro.arv": tuning.Prior(value=1.0, factor=2.0)}
SPEC = gyro.GyroSpec(angle_random_walk=3e-5, rate_random_walk=2e-7, turn_on_bias_sigma=1e-5)


def free(*names, of=ONE, filter_setup=BELIEVED):
    return tuning.likelihood([of], setup=filter_setup, free=names)


def of_compass(*names, filter_setup=MATCHED):
    return free(*names, of=HELD, filter_setup=filter_setup)


def mixed(**options):
    return tuning.contaminated_likelihood([ONE], BELIEVED, FREE, **options)


def two_gyros(**change):
    return tuning.one_gyro({"a.h5": SPEC, "b.h5": replace(SPEC, **change)})


# fmt: off
TABLE = [
    (free, (), {}, "no parameter"),
    (workflows.tune, (ONE.record,), {"setup": BELIEVED, "free": []}, "free names no parameter; give some of gyro.arw"),
    (free, ("gyro.awr",), {}, "did you mean 'gyro.arw'"),
    (free, ("gyro.arw", "gyro.arw"), {}, "free names gyro.arw twice"),
    (free, ("star 3.sigma",), {}, "star 1.sigma"),
    (free, ("filter.scale", "gyro.arw"), {}, "tune it alone"),
    (free, FREE, {"filter_setup": STEADY}, "gyro.rrw starts from 0"),
    (free, FREE, {"of": replace(ONE, first=1e6)}, "no measurement between"),
    (workflows.tune, (SHORT,), {"setup": BELIEVED, "free": list(FREE)}, "2 measurements cannot determine 4 parameters"),
    (workflows.tune, (ONE.record,), {"setup": replace(BELIEVED, sigma={"star": 1e-4})}, "sigma: sensor 'star'"),
    (workflows.tune, ([ONE.record, ONE.record],), {"setup": BELIEVED}, "a record is given twice"),
    (tuning.likelihood, ([], BELIEVED, FREE), {}, "no record"),
    (tuning.error_objective, ([ONE, ATTITUDE_ALONE], BELIEVED, FREE), {}, "on records of one kind"),
    (tuning.recording_case, (BARE,), {}, "bare has no accelerometer samples"),
    (tuning.values_of, (BELIEVED, ["star 1.sigma"], [SILENT]), {}, "sigma is 0"),
    (tuning.Prior, (), {"value": 1.0, "factor": 1.0}, "factor of the prior is 1.0; .* greater than 1"),
    (tuning.fit, (free(*FREE),), {"priors": UNSPECIFIED}, "priors"),
    (tuning.compare, ([replace(ONE, first=19.9, last=19.95)], BELIEVED, BELIEVED), {}, "no measurement between 19.9 and 19.95 s"),
    (setup.modelled_record, (HELD.record, AXES), {}, "mag is .*three numbers, but a heading has one degree of freedom"),
    (of_compass, ("acc.correlated_time",), {"filter_setup": COLOURED}, "did you mean 'acc.correlation_time'"),
    (of_compass, ("acd.bias_sigma",), {"filter_setup": OF_ANOTHER}, "did you mean 'acc'"),
    (mixed, (), {"share": 0.6}, "share of the outliers is 0.6; it must lie between 0.0001 and 0.4"),
    (mixed, (), {"scale": 1.0}, "scale of the outliers is 1"),
    (two_gyros, (), {"angle_random_walk": 6e-5}, "angle_random_walk is 6e-05 and 3e-05"),
    (two_gyros, (), {"rate_random_walk": np.array([2e-7, 2e-7, 3e-7])}, "rate_random_walk is 3e-07 and 2e-07"),
    (two_gyros, (), {"bias_instability": 1e-6}, "bias_instability is 1e-06 and 0"),
    (two_gyros, (), {"markov_noise": 1e-7, "markov_correlation_time": 100.0}, "markov_noise is 1e-07 and 0"),
]
# fmt: on


@pytest.mark.parametrize(("call", "arguments", "options", "named"), TABLE, ids=[row[3] for row in TABLE])
def test_what_makes_no_sense_is_refused_by_name(call, arguments, options, named):
    with pytest.raises(InputError, match=named):
        call(*arguments, **options)


def test_what_is_near_it_is_taken():
    three = replace(MATCHED, sigma={"acc": (0.05, 0.05, 0.1)})
    assert covariance.analyse(COMPASS, three, epochs=2).expected_nis["acc"] > 0.0
    assert tuning.parameters.own_sigma("star 2", [SILENT]) == pytest.approx(2e-4)
    two_gyros(turn_on_bias_sigma=1e-3, scale_factor=np.full(3, 1e-3))
    two_gyros(angle_random_walk=np.full(3, 3e-5))
    tuning.one_gyro({})
