"""Properties of files that hold for any content, sought by hypothesis."""

import dataclasses

import numpy as np
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from measured import differing, series_of

from strapdown import files, records
from strapdown.files import reading
from strapdown.recordings import recordfiles
from strapdown.records import ImuRecord, Truth

numbers = st.floats(-1e3, 1e3, allow_nan=False, width=64)
quaternions = (
    arrays(np.float64, 4, elements=st.floats(-1.0, 1.0))
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: q / np.linalg.norm(q))
)
few = settings(
    derandomize=True, max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


texts = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"), max_size=40)


@st.composite
def recorded(draw) -> ImuRecord:
    n = draw(st.integers(1, 12))
    steps = draw(st.lists(st.floats(1e-6, 1e3), min_size=n, max_size=n))
    time = draw(st.floats(-1e3, 1e6)) + np.concatenate([[0.0], np.cumsum(steps)])
    assume(np.all(np.diff(time) > 0.0))
    increments = draw(arrays(np.float64, (n, 3), elements=st.floats(-1e3, 1e3)))
    series = []
    if draw(st.booleans()):
        m = draw(st.integers(1, 4))
        values = draw(arrays(np.float64, (m, 3), elements=st.floats(-1.0, 1.0)))
        values[np.linalg.norm(values, axis=1) < 0.1] = [1.0, 0.0, 0.0]
        if draw(st.booleans()):
            values[0] = np.nan
        name = draw(st.text(st.characters(categories=("L", "N")), min_size=1, max_size=10))
        unit = values / np.linalg.norm(values, axis=1, keepdims=True)
        series.append(
            series_of(name, "direction", time[0] + np.arange(m), unit, [0.0, 0.0, 1.0], draw(st.floats(1e-9, 1.0)))
        )  # fmt: skip
    truth = None
    if draw(st.booleans()):
        attitude = np.array([draw(quaternions) for _ in time])
        truth = Truth(attitude=attitude, bias=draw(arrays(np.float64, (n + 1, 3), elements=numbers)))
    return ImuRecord(time=time, increments=increments, vectors=tuple(series), truth=truth)


@few
@given(recorded(), texts, st.integers(0, 2**62))
def test_a_record_goes_through_hdf5_to_the_last_bit(tmp_path, record, text, seed):
    seeded = dataclasses.replace(record, origin=records.Origin(seed=seed))
    recordfiles.write_record(tmp_path / "r.h5", seeded)
    back = recordfiles.read_record(tmp_path / "r.h5")
    assert not differing(record, back)
    assert back.origin.seed == seed
    with records.result_file(tmp_path / "a.h5", "record", {"note": text, "list": ["a", text]}):
        pass
    held = records.read_attributes(tmp_path / "a.h5")
    assert (held["note"], held["list"]) == (text, ["a", text])


trees = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False) | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=20,
)


@few
@given(trees)
def test_json_goes_through_a_file(tmp_path, tree):
    files.write_json(tmp_path / "t.json", tree)
    assert reading.json_file(tmp_path / "t.json") == tree
