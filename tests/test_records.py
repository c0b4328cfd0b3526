"""The IMU record and the estimate: checks, compressing, cutting, and the estimate's file."""

import dataclasses
import re

import h5py
import numpy as np
import pytest
from hdf5 import changed

import strapdown
from strapdown import coning, quaternion, records
from strapdown.checks import InputError
from strapdown.estimation.setup import read_estimate, write_estimate
from strapdown.files import reading
from strapdown.recordings import Recording
from strapdown.records import Estimate, ImuRecord, Truth, compress, cut
from strapdown.vectors import VectorMeasurements


def random_attitudes(n: int, seed: int = 1) -> np.ndarray:
    return quaternion.normalize(np.random.default_rng(seed).standard_normal((n, 4)))


def series(name: str, time: np.ndarray, **changes) -> VectorMeasurements:
    vectors = np.random.default_rng(2).standard_normal((len(time), 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    fields = {"kind": "direction", "vector_b": vectors, "reference_f": np.array([0.0, 0.0, 1.0]), "sigma": 0.01}
    return VectorMeasurements(sensor=name, time=time, **(fields | changes))


def record(n: int = 12) -> ImuRecord:
    random = np.random.default_rng(3)
    time = np.cumsum(np.r_[5.0, 0.5 + random.random(n)])
    return ImuRecord(
        time=time,
        increments=0.1 * random.standard_normal((n, 3)),
        vectors=(series("star tracker", time[::2]), series("sun sensor", time[1:-1] + 0.1)),
        truth=Truth(attitude=random_attitudes(n + 1), bias=random.standard_normal((n + 1, 3))),
    )


# ---------------------------------------------------------------------------------------------------- the record


def test_rates_are_increments_over_intervals():
    r = record()
    np.testing.assert_allclose(r.rates * np.diff(r.time)[:, None], r.increments, rtol=1e-15)
    np.testing.assert_array_equal(r.intervals, np.diff(r.time))
    assert not r.intervals.flags.writeable


def test_records_are_frozen_and_lists_are_welcome():
    truth = Truth(attitude=[[1, 0, 0, 0]] * 3, bias=[[0, 0, 0]] * 3)
    r = ImuRecord(time=[0, 1, 2], increments=[[0, 0, 1], [0, 0, 2]], vectors=[], truth=truth)
    assert r.increments.dtype == r.truth.attitude.dtype == r.truth.bias.dtype == np.float64
    assert r.vectors == ()
    with pytest.raises(dataclasses.FrozenInstanceError):
        r.time = np.arange(3.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"time": [0.0]}, "time has 1 stamps; at least 2"),
        ({"time": [0.0, 2.0, 1.0]}, r"time\[2\] goes back"),
        ({"time": [0.0, 1.0, 1.0]}, r"time\[2\] repeats"),
        ({"increments": np.zeros((3, 3))}, r"increments has shape \(3, 3\), wanted \(2, 3\)"),
        ({"increments": [[0, 0, 0], [0, np.nan, 0]]}, r"increments\[1, 1\] is nan"),
        ({"vectors": (series("sun", np.arange(2.0)), series("sun", np.arange(2.0)))}, "two series of the same name"),
        ({"truth": Truth(attitude=random_attitudes(2), bias=np.zeros((3, 3)))}, r"truth.attitude has shape \(2, 4\)"),
        (
            {"truth": Truth(attitude=2.0 * random_attitudes(3), bias=np.zeros((3, 3)))},
            r"truth.attitude\[0\] has norm 2",
        ),
        ({"truth": Truth(attitude=random_attitudes(3), bias=np.zeros(3))}, r"truth.bias has shape \(3,\)"),
        ({"vectors": None}, r"vectors is None.*give a tuple of series, empty for none"),
        (
            {"increments": [[0, 0, 0], [0, -1e10, 0]]},
            r"increments\[1, 1\] is -1e\+10 rad in 0.5 s, more than 1e\+06 rad between",
        ),
        ({"increments": np.ma.masked_equal([[7, 0, 0], [7, 0, 7]], 0)}, r"increments\[0, 1\] is masked"),
        (
            lambda: compress(record(3), coning.ALGORITHMS["four-sample"]),
            "record has 3 intervals; four-sample needs at least 4",
        ),
        *(
            (lambda edges=edges: cut(record(), *edges), "cut from edge .* with edges 0 to 12; choose 0 ≤ first < last")
            for edges in ((-1, 5), (3, 3), (5, 3), (0, 13))
        ),
    ],
)
def test_bad_records_are_refused(changes, words):
    fields = {"time": [0.0, 0.5, 1.0], "increments": np.zeros((2, 3))}
    with pytest.raises(InputError, match=words):
        changes() if callable(changes) else ImuRecord(**(fields | changes))


# ---------------------------------------------------------------------------------------------------- compressing


@pytest.mark.parametrize("name", ["one-sample", "two-sample", "three-sample", "four-sample"])
def test_compress(name):
    algorithm = coning.ALGORITHMS[name]
    r = record(13)
    n, kept = algorithm.samples, 13 // algorithm.samples
    small = compress(r, algorithm)
    np.testing.assert_array_equal(small.time, r.time[: kept * n + 1 : n])
    np.testing.assert_array_equal(small.truth.attitude, r.truth.attitude[: kept * n + 1 : n])
    np.testing.assert_array_equal(small.truth.bias, r.truth.bias[: kept * n + 1 : n])
    assert small.increments.shape == (kept, 3)
    assert small.vectors == r.vectors
    if n == 2:  # the two-sample algorithm, written out; of unequal intervals, see tests/test_coning_uneven.py
        even = compress(dataclasses.replace(r, time=5.0 + np.arange(14.0)), algorithm)
        first, second = r.increments[0:26:2][:kept], r.increments[1:26:2][:kept]
        np.testing.assert_allclose(even.increments, first + second + 2.0 / 3.0 * np.cross(first, second), atol=1e-16)


# ---------------------------------------------------------------------------------------------------- cutting


@pytest.mark.parametrize("middle", [1, 5, 11])
def test_parts_make_up_the_whole(middle):
    r = record()
    parts = cut(r, 0, middle), cut(r, middle, 12)
    np.testing.assert_array_equal(np.concatenate([p.increments for p in parts]), r.increments)
    assert parts[0].time[-1] == parts[1].time[0] == r.time[middle]
    np.testing.assert_array_equal(parts[1].truth.attitude, r.truth.attitude[middle:])
    np.testing.assert_array_equal(parts[0].truth.bias, r.truth.bias[: middle + 1])
    for k, whole in enumerate(r.vectors):
        for field in ("time", "vector_b", "sigma"):
            joined = np.concatenate([getattr(p.vectors[k], field) for p in parts])
            np.testing.assert_array_equal(joined, getattr(whole, field))
        # a measurement at the cut belongs to the part that it ends, at the very start to the first
        assert np.all(parts[1].vectors[k].time > r.time[middle])


def test_cut_keeps_what_belongs_to_each_sample():
    """References that change, times of arrival: a row of each belongs to a measurement."""
    r = record()
    time = r.time[::2]
    moving = np.random.default_rng(4).standard_normal((len(time), 3))
    sensor = series("planet", time, reference_f=moving, arrival=time + 0.2)
    part = cut(dataclasses.replace(r, vectors=(sensor,)), 4, 12).vectors[0]
    inside = time > r.time[4]
    np.testing.assert_array_equal(part.time, time[inside])
    np.testing.assert_allclose(part.reference_f, (moving / np.linalg.norm(moving, axis=1)[:, None])[inside], rtol=1e-15)
    np.testing.assert_array_equal(part.arrival, (time + 0.2)[inside])


# ---------------------------------------------------------------------------------------------------- the estimate's file


def estimate(full: bool = False) -> Estimate:
    random = np.random.default_rng(5)
    P = random.standard_normal((7, 6, 6))
    P = P @ np.swapaxes(P, 1, 2)
    return Estimate(
        time=np.cumsum(random.random(7)),
        attitude=random_attitudes(7),
        bias=random.standard_normal((7, 3)),
        variance=np.diagonal(P, axis1=1, axis2=2).copy(),
        covariance=P if full else None,
        innovations={
            "star tracker": records.Innovations(
                time=np.arange(4.0), innovation=random.standard_normal((4, 2)), variance=1.0 + random.random((4, 2))
            ),
            "magnetometer": records.Innovations(
                time=np.empty(0), innovation=np.empty((0, 1)), variance=np.empty((0, 1))
            ),
        },
        skipped={"star tracker": 3, "magnetometer": 0},
    )


@pytest.mark.parametrize("full", [False, True])
def test_estimate_round_trip_is_exact(tmp_path, full):
    written = estimate(full)
    write_estimate(tmp_path / "new folder" / "estimate.h5", written)
    read = read_estimate(tmp_path / "new folder" / "estimate.h5")
    for name in ("time", "attitude", "bias", "variance"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    if full:
        np.testing.assert_array_equal(read.covariance, written.covariance)
    else:
        assert read.covariance is None
    assert dict(read.skipped) == dict(written.skipped)
    assert set(read.innovations) == set(written.innovations)
    for sensor, innovations in written.innovations.items():
        np.testing.assert_array_equal(read.innovations[sensor].time, innovations.time)
        np.testing.assert_array_equal(read.innovations[sensor].whitened, innovations.whitened)
    assert [path.name for path in (tmp_path / "new folder").iterdir()] == ["estimate.h5"]


def test_estimate_file_holds_units_conventions_and_attributes(tmp_path):
    details = {"parameter.sigma": 0.5}
    written = dataclasses.replace(estimate(full=True), origin=records.Origin(source="test"), details=details)
    write_estimate(tmp_path / "estimate.h5", written)
    with reading.hdf5(tmp_path / "estimate.h5") as file:
        attributes = reading.attributes(file)
        assert attributes["conventions"] == records.CONVENTIONS
        assert attributes["version"] == strapdown.__version__
        assert (attributes["source"], attributes["parameter.sigma"]) == ("test", 0.5)
        units = {
            name: reading.attributes(file[name])["unit"]
            for name in ("time", "attitude", "bias", "variance", "covariance")
        }
    assert units["time"] == "s"
    assert units["bias"] == "rad/s"
    assert all(units.values())


def test_sensor_names_with_a_slash_survive(tmp_path):
    """In HDF5 a slash parts group names."""
    sensor = records.Innovations(time=np.arange(2.0), innovation=np.ones((2, 1)), variance=np.ones((2, 1)))
    written = dataclasses.replace(estimate(), innovations={"GPS/heading": sensor}, skipped={"GPS/heading": 1})
    write_estimate(tmp_path / "estimate.h5", written)
    read = read_estimate(tmp_path / "estimate.h5")
    assert set(read.innovations) == {"GPS/heading"}
    assert dict(read.skipped) == {"GPS/heading": 1}


def test_a_truth_without_a_bias_is_kept_without_one(tmp_path):
    written = estimate()
    truth = Truth(attitude=written.attitude, movement=np.arange(7) > 3)
    write_estimate(tmp_path / "e.h5", dataclasses.replace(written, truth=truth))
    read_truth = read_estimate(tmp_path / "e.h5").truth
    assert read_truth == truth
    np.testing.assert_array_equal(read_truth.attitude, written.attitude)
    assert np.isnan(read_truth.bias).all()


def test_foreign_files_are_refused(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["imu_gyr"] = np.zeros((3, 3))
    with h5py.File(tmp_path / "half.h5", "w") as file:
        file.attrs["kind"] = "strapdown estimate"
        file["time"] = np.arange(3.0)
    for name, words in (("other", "is not a strapdown estimate"), ("half", "is damaged: its digest is missing")):
        with pytest.raises(InputError, match=rf"{name}\.h5 ?{words}"):
            read_estimate(tmp_path / f"{name}.h5")


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        (
            "variance",
            lambda x: np.where(np.arange(6) == 4, 0.0, x),
            r"variance\[0, 4\] is 0, and a variance must be greater than zero",
        ),
        ("variance", lambda x: -x, r"variance\[0, 0\] is -.*repeat the estimate"),
        ("covariance", lambda x: -x, r"covariance, diagonal\[0, 0\] is -"),
        (
            "innovations/000000/variance",
            lambda x: x - 1e3,
            r"innovations/000000/variance\[0, 0\] is -.*give each a sigma",
        ),
        ("innovations/000000/variance", lambda x: x[:, :1], r"innovations/000000/variance has shape"),
        ("innovations/000000/time", lambda x: x[1:], r"innovations/000000/innovation has shape"),
        ("bias", lambda x: x + 1e200, r"bias\[0, 0\] is 1e\+200 rad/s, more than any gyro has.*unit"),
        ("bias", lambda x: x[:, 0], r"bias has shape"),
        ("bias", lambda x: np.array(["1.0"] * 7, dtype="S3"), r"bias "),
        ("attitude", lambda x: 2.0 * x, r"attitude\[0\] has norm 2"),
        ("attitude", lambda x: None, r"attitude is not an array of numbers; .*make it again"),
        ("time", lambda x: None, r"time is not an array"),
        ("time", lambda x: 1.0, r"time has shape \(\)"),
        ("innovations/000000/innovation", lambda x: None, r"innovations/000000/innovation is not an array"),
        ("truth/bias", lambda x: -1e200 + x, r"truth/bias\[0, 0\] is -1e\+200 rad/s"),
        ("truth/attitude", lambda x: x[1:], r"truth/attitude has shape"),
        ("truth/attitude", lambda x: None, r"truth/attitude is not an array"),
    ],
)
def test_what_no_filter_estimates_is_refused(tmp_path, name, damage, words):
    path = tmp_path / "estimate.h5"
    written = estimate(full=True)
    truth = Truth(attitude=random_attitudes(7), bias=np.zeros((7, 3)))
    write_estimate(path, dataclasses.replace(written, truth=truth))
    with changed(path) as file:
        value = damage(file[name][:])
        del file[name]
        if value is None:
            file.create_group(name)
        else:
            file[name] = value
    with pytest.raises(InputError, match=f"^{path}.*{words}"):
        read_estimate(path)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("recovery", r"Recovered at 3.5 s: 7 measurements of compass .* from 1 s on;"),
        ("lock-out", r"Locked out from 1 s to 3.5 s: 7 measurements of compass were rejected,"),
        ("gap", r"Gap of 2.5 s after 1 s:"),
    ],
)
def test_an_event_is_described_by_its_kind(kind, words):
    assert re.match(words, str(records.Event(kind=kind, start=1.0, end=3.5, sensor="compass", value=7.0)))


def test_the_listing_of_a_record_has_the_rate_of_each_series():
    star = VectorMeasurements(
        sensor="star",
        kind="direction",
        time=[0.5, 1.5],
        vector_b=[[0.0, 0.0, 1.0]] * 2,
        reference_f=[0.0, 0.0, 1.0],
        sigma=[0.1, 0.1],
    )
    record = ImuRecord(time=0.01 * np.arange(201.0), increments=np.zeros((200, 3)), vectors=(star,))
    gyro, vectors = record.listing().cells
    assert [gyro[0], *gyro[2:]] == ["gyro", "200", "100"]
    assert [vectors[0], *vectors[2:]] == ["star", "2", "1"]


def test_the_listing_of_a_recording_has_its_rate_and_the_size_of_its_samples():
    rate = np.radians([[3.0, 0.0, 4.0]] * 10 + [[0.0, 60.0, 0.0]])
    force = np.full((11, 3), np.nan)
    force[::5] = [[0.0, 0.0, 9.0], [0.0, 0.0, 9.5], [0.0, 0.0, 10.0]]
    listing = Recording(source="box", time=0.1 * np.arange(11.0), rate=rate, specific_force=force).listing()
    assert listing.title == "box: 11 samples over 1 s, 10 Hz"
    assert listing.cells == [["gyro", "°/s", "11", "5", "60"], ["accelerometer", "m/s²", "3", "9.5", "10"]]


def test_the_listing_of_an_estimate_has_sigma_at_its_end_and_at_its_start():
    """σ of 1, 2 and 3 ° in the first row, 4, 5 and 6 ° in the second, 7, 8 and 9 ° in the last; of the bias as many °/h."""
    sigma = np.arange(1.0, 10.0).reshape(3, 3)
    P = [np.diag(np.radians(np.append(row, row / 3600.0)) ** 2) for row in sigma]
    bias = np.radians([[0, 0, 0], [1, 1, 1], [10, -20, 30]]) / 3600.0
    rows = Estimate.from_arrays([0.0, 1.0, 2.0], [[1, 0, 0, 0]] * 3, P, bias=bias).listing().cells
    assert [tuple(row[1:]) for row in rows] == [
        *[("°", "", last, first) for last, first in (("7", "1"), ("8", "2"), ("9", "3"))],
        *[
            ("°/h", value, last, first)
            for value, last, first in (("10", "7", "1"), ("-20", "8", "2"), ("30", "9", "3"))
        ],
    ]
