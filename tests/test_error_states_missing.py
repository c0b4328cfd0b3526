"""The filter with optional states: what is missing, what shows no heading, and what it refuses, alike on both faces."""

from dataclasses import replace

import numpy as np
import pytest
from measured import series_of

from strapdown import estimation
from strapdown.checks import InputError
from strapdown.estimation.error_states import VectorBias
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import ProcessNoise
from strapdown.estimation.step_filter import StepFilter
from strapdown.records import ImuRecord

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
X, _, UP = np.eye(3)
NAN = np.full(3, np.nan)
BLOCKS = (VectorBias(sensor="up", bias_sigma=1e-3),)
START = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=0.1, bias_sigma=1e-3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "options", [{}, {"gate": Gate(recovery=None)}, {"robust": Robust()}], ids=["plain", "gate", "robust"]
)
def test_vertical_headings_and_missing_samples_are_skipped_and_counted(options):
    time = 0.1 * np.arange(1.0, 9.0)
    odd = np.arange(8) % 2 == 0
    seen, up = np.where(odd[:, None], UP, X), np.tile(UP, (8, 1))
    up[3] = np.nan
    north = series_of("north", "heading", time, seen, X, 0.1)
    vertical = series_of("up", "direction", time, up, UP, 0.1)
    record = ImuRecord(time=np.linspace(0.0, 1.0, 11), increments=np.zeros((10, 3)), vectors=(north, vertical))
    rest = replace(record, vectors=(north.taken(~odd), vertical.taken(np.arange(8) != 3)))
    both, without = (estimation.run(r, NOISE, START, BLOCKS, full_covariance=True, **options) for r in (record, rest))
    assert both.skipped == {"north": 4, "up": 1}
    assert np.array_equal(both.covariance, without.covariance)
    assert np.isfinite(both.covariance).all()
    assert np.array_equal(both.innovations["north"].nis, without.innovations["north"].nis)
    smoothed = estimation.smooth(record, NOISE, START, BLOCKS, **options)
    assert smoothed.skipped == both.skipped
    if options:
        return
    f = StepFilter(NOISE, START, BLOCKS, sensors=("north", "up"))
    for k in range(8):
        f.predict(np.zeros(3), 0.1)
        f.update_heading(seen[k], X, 0.1, "north")
        f.update_direction(up[k], UP, 0.1, "up")
    assert f.skipped == both.skipped
    d = np.sqrt(np.diag(f.P))
    assert np.abs((f.P[:6, :6] - both.covariance[8]) / np.outer(d[:6], d[:6])).max() < 1e-9


def test_missing_samples_of_every_kind_change_nothing():
    f = StepFilter(NOISE, START, BLOCKS, sensors=("a", "up", "c", "d"))
    P = f.P.copy()
    f.update_direction(NAN, NAN, np.nan, "a")
    f.update_vector([0.0, np.nan, 1.0], X, 0.1, "up")
    f.update_heading(NAN, X, np.nan, "c")
    f.update_attitude([1.0, 0.0, np.nan, 0.0], np.nan, "d")
    f.predict(np.zeros(3), 0.0)
    assert f.skipped == {"a": 1, "up": 1, "c": 1, "d": 1}
    assert f.repeated == 1
    assert np.array_equal(f.P, P)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda f: f.update_direction(9.8 * UP, UP, 0.1), "has length 9.8; divide each vector"),
        (lambda f: f.update_heading(1.5 * X, X, 0.1), "has length 1.5"),
        (lambda f: f.update_heading(X, UP, 0.1), "is vertical and shows no heading"),
        (lambda f: f.update_direction(X, X, [0.1, 0.1]), r"sigma has shape \(2,\)"),
        (lambda f: StepFilter(NOISE, START, BLOCKS[0]), "single declaration .*; give a tuple"),
        (lambda f: estimation.with_error_states(START, BLOCKS[0]), "single declaration .*; give a tuple"),
    ],
)
def test_what_the_record_refuses_is_refused(call, words):
    f = StepFilter(NOISE, START, BLOCKS)
    with pytest.raises(InputError, match=words):
        call(f)
