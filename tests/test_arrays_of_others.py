"""Arrays of other programs: what is masked, complex or asymmetric is never judged or filtered as if it were plain numbers."""

import dataclasses
import datetime

import numpy as np
import pytest

import strapdown as sd
from strapdown import consistency, quaternion, recordings, records
from strapdown.checks import InputError

N = 200
DRAW = np.random.default_rng(5)
TIME = np.arange(float(N))
TRUE = quaternion.exp(np.cumsum(0.1 * DRAW.standard_normal((N, 3)), axis=0) % 2.0)
BIAS = 1e-3 * DRAW.standard_normal((N, 3))
P = np.tile(np.diag([1e-4] * 3 + [1e-8] * 3), (N, 1, 1))
INNOVATIONS = {
    "star": records.Innovations(time=TIME, innovation=DRAW.standard_normal((N, 2)), variance=np.ones((N, 2)))
}
GIVEN = {"time": TIME, "attitude": TRUE, "covariance": P, "bias": BIAS}
PAIRS = {"attitude": TRUE, "bias": BIAS, "true_attitude": TRUE, "true_bias": BIAS}


def estimate(**change):
    return records.Estimate.from_arrays(**GIVEN | change)


def checked(**change):
    estimate = {**GIVEN, "true_time": TIME, "true_attitude": TRUE, "true_bias": BIAS} | change
    truth = {name: estimate.pop(f"true_{name}") for name in ("time", "attitude", "bias")}
    both = (recordings.Attitudes.from_arrays(**columns) for columns in (estimate, truth))
    return consistency.check_attitudes(*both)


def errors(**change):
    return consistency.errors(**PAIRS | change)


CALLS = [
    *((estimate, name) for name in GIVEN),
    *((checked, name) for name in (*GIVEN, "true_time", "true_attitude", "true_bias")),
    *((errors, name) for name in PAIRS),
]
VALUES = {**GIVEN, **PAIRS, "true_time": TIME}


def masked(value):
    """Return an array whose values under the mask would change the result."""
    hidden = np.ma.array(value, copy=True)
    hidden[3] = np.ma.masked
    hidden.data[3] = hidden.data[2]
    return hidden


@pytest.mark.parametrize(("call", "name"), CALLS, ids=lambda value: getattr(value, "__name__", value))
def test_complex_arrays_are_refused_by_name(call, name):
    with pytest.raises(
        InputError,
        match=rf"{'time' if name == 'true_time' else name} is not an array of numbers \(it holds complex numbers\)",
    ):
        call(**{name: VALUES[name] + 1e-3j})


def test_a_negative_variance_is_refused_by_its_place():
    wrong = P.copy()
    wrong[5, 1, 1] = -1e-4
    for call in (estimate, checked):
        with pytest.raises(InputError, match=r"covariance\[5, 1, 1\] is -0\.0001, but a variance is not negative"):
            call(covariance=wrong)


def test_an_estimate_without_covariance_has_errors_and_no_verdict():
    turned = quaternion.multiply(TRUE, quaternion.exp([0.0, 0.0, 0.01]))
    plain = records.Estimate.from_arrays(TIME, turned)
    truth = records.Truth(attitude=TRUE)
    assert sd.accuracy(plain, truth).given["all samples"]["total"].rms == pytest.approx(0.01)
    assert sd.check(plain, truth).verdict == "cannot tell"
    with pytest.raises(InputError, match="check_attitudes"):
        sd.check(plain, recordings.Attitudes.from_arrays(TIME, TRUE))


def test_attitudes_are_compared_in_the_clock_of_the_estimate():
    """Both count from 1970; the time of the estimate begins at its first stamp."""
    epoch = 1_700_000_000_000_000_000
    own = records.Estimate.from_arrays(TIME, quaternion.multiply(TRUE, quaternion.exp([0.0, 0.0, 0.01])))
    own = dataclasses.replace(own, origin=records.Origin(epoch_ns=epoch))
    compared = sd.accuracy(own, recordings.Attitudes.from_arrays(TIME + epoch / 1e9, TRUE))
    assert compared.given["all samples"]["total"].rms == pytest.approx(0.01)
    assert compared.alignment.offset == pytest.approx(0.0, abs=1e-3)


def test_dates_as_texts_or_objects_are_stamps():
    start = datetime.datetime(2026, 3, 29, 0, 59, tzinfo=datetime.UTC)
    days = [start + datetime.timedelta(seconds=k / 100.0) for k in range(N)]
    zone = datetime.timezone(datetime.timedelta(hours=2))
    for stamps in (days, [str(day) for day in days], [day.astimezone(zone).isoformat() for day in days]):
        walk = sd.read(table() | {"time": np.array(stamps, dtype=object)})
        assert walk.epoch_ns == round(start.timestamp()) * 10**9
        np.testing.assert_allclose(walk.time, TIME / 100.0, atol=1e-9)
    with pytest.raises(InputError, match=r"time\[3\] is not a date"):
        sd.read(table() | {"time": np.array([*map(str, days[:3]), "soon", *map(str, days[4:])], dtype=object)})


MISSING = {
    (estimate, "attitude"),
    (estimate, "covariance"),
    (estimate, "bias"),
    (errors, "bias"),
    (errors, "true_bias"),
}
"""Arrays with NaN at times without an estimate, or without a bias."""


@pytest.mark.parametrize(("call", "name"), CALLS, ids=lambda value: getattr(value, "__name__", value))
def test_masked_values_are_missing_or_refused_by_name(call, name):
    value = masked(VALUES[name])
    with_nan = np.array(VALUES[name])
    with_nan[3] = np.nan
    if (call, name) in MISSING:
        result, expected = call(**{name: value}), call(**{name: with_nan})
        if call is estimate:
            result, expected = getattr(result, name), getattr(expected, name)
        assert np.isnan(np.asarray(result)[3]).any()
        np.testing.assert_array_equal(result, expected)
    else:
        with pytest.raises(InputError, match=rf"{'time' if name == 'true_time' else name}(\[3.*\])? is (masked|nan)"):
            call(**{name: value})


@pytest.mark.parametrize("field", ["time", "innovation", "variance", "weight"])
def test_masked_and_complex_innovations_are_refused(field):
    whole = {**vars(INNOVATIONS["star"]), "weight": np.ones(N)}
    for call in (estimate, checked):
        for change, words in ((masked, "is masked"), (lambda value: value + 1e-3j, "complex numbers")):
            with pytest.raises(InputError, match=rf"star: {field}.* {words}|star: {field} .*{words}"):
                call(innovations={"star": records.Innovations(**whole | {field: change(whole[field])})})


def table():
    return {
        "time": TIME / 100.0,
        "gyro [rad/s]": 0.1 * DRAW.standard_normal((N, 3)),
        "acc [m/s2]": [0.0, 0.0, 9.8] + 0.01 * DRAW.standard_normal((N, 3)),
        "temperature": np.full(N, 20.0),
    }


@pytest.mark.parametrize("read", [sd.read, recordings.from_table])
def test_masked_columns_are_missing_samples(read):
    columns = table()
    nan = {name: value.copy() for name, value in columns.items()}
    for name in ("gyro [rad/s]", "acc [m/s2]", "temperature"):
        columns[name] = masked(columns[name])
        nan[name][3] = np.nan
    recording, expected = read(columns), read(nan)
    for name in ("time", "rate", "specific_force", "temperature", "missing_gyro"):
        np.testing.assert_array_equal(getattr(recording, name), getattr(expected, name))
    assert len(recording.missing_gyro) == 1
    assert len(read(table() | {"time": np.ma.array(TIME)}).time) == N  # nothing masked


@pytest.mark.parametrize(
    "change", [{"time": masked(TIME)}, {"time": masked(np.arange(N))}, {"time": masked(np.arange(N).astype("M8[s]"))}]
)
def test_a_masked_time_is_refused(change):
    with pytest.raises(InputError, match=r"table: time.*\[3\] is (nan|not a date)"):
        recordings.from_table(table() | change)


@pytest.mark.parametrize("name", ["time", "gyro [rad/s]", "acc [m/s2]", "temperature"])
def test_complex_columns_are_refused(name):
    with pytest.raises(InputError, match=r"table: column .* is not an array of numbers \(it holds complex numbers\)"):
        recordings.from_table(table() | {name: table()[name] + 1e-3j})


# ---------------------------------------------------------------------------------------------------- asymmetric covariances


@pytest.mark.parametrize(("i", "j"), [(0, 2), (1, 0), (0, 4), (5, 3)])
def test_an_asymmetric_covariance_is_refused_with_its_place(i, j):
    """Its Cholesky factor is of the lower triangle alone: the other is not judged."""
    lopsided = P.copy()
    sigma = np.sqrt(np.diagonal(P[7]))
    lopsided[7, i, j] += 1e-3 * sigma[i] * sigma[j]
    i, j = sorted((i, j))
    for call in (estimate, checked):
        with pytest.raises(InputError, match=rf"covariance\[7\] is not symmetric: \[{i}, {j}\] is .* use ½\(P \+ Pᵀ\)"):
            call(covariance=lopsided)
    rounded = P.astype(np.float32)
    rounded[7, i, j] += np.float32(2e-7) * sigma[i] * sigma[j]
    assert checked(covariance=rounded).judgement.verdict == checked().judgement.verdict


# ------------------------------------------------------------------------------------------- frames of other libraries


def flat():
    columns = table()
    by_axis = {"time": columns["time"]}
    for name, prefix in (("gyro [rad/s]", "g"), ("acc [m/s2]", "a")):
        unit = name.partition(" ")[2]
        by_axis |= {f"{prefix}{axis} {unit}": columns[name][:, k] for k, axis in enumerate("xyz")}
    return columns, by_axis


class Stream:
    """A frame of any library that speaks Arrow, such as polars: it has columns that are names, and no index."""

    def __init__(self, held):
        self.held, self.columns = held, held.column_names

    def __arrow_c_stream__(self, schema=None):
        return self.held.__arrow_c_stream__(schema)


@pytest.mark.parametrize("frame", ["table", "stream", "batch"])
def test_arrow_tables_and_frames_of_its_kind_are_read(frame):
    arrow = pytest.importorskip("pyarrow")
    columns, by_axis = flat()
    held = arrow.table({name: arrow.array(value) for name, value in by_axis.items()})
    source = {"table": held, "stream": Stream(held), "batch": held.to_batches()[0]}[frame]
    np.testing.assert_array_equal(sd.read(source).rate, columns["gyro [rad/s]"])
    nulls = held.set_column(1, "gx [rad/s]", arrow.array([None, *by_axis["gx [rad/s]"][1:]]))
    assert sd.read(nulls).missing_gyro.tolist() == [0.0]
    unit = arrow.field("temperature", arrow.float64(), metadata={b"unit": b"degC"})
    with_unit = held.append_column(unit, arrow.array(columns["temperature"]))
    np.testing.assert_array_equal(sd.read(with_unit).temperature, columns["temperature"])


def test_structured_arrays_are_read():
    columns, _ = flat()
    kinds = [(name, "f8", np.shape(value)[1:]) for name, value in columns.items()]
    held = np.zeros(N, kinds)
    for name, value in columns.items():
        held[name] = value
    for array in (held, held.view(np.recarray)):
        recording = sd.read(array)
        np.testing.assert_array_equal(recording.rate, columns["gyro [rad/s]"])
        np.testing.assert_array_equal(recording.specific_force, columns["acc [m/s2]"])
    with pytest.raises(InputError, match="table is an array without names of columns"):
        sd.read(np.zeros((N, 4)))
