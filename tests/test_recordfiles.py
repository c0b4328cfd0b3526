"""Records in HDF5: read back equal, described, and refused where they are not what they should be."""

import dataclasses

import h5py
import numpy as np
import pytest
from hdf5 import changed
from measured import differing

import strapdown
from strapdown import scenarios, vectors
from strapdown.checks import InputError
from strapdown.files import reading
from strapdown.recordings.recordfiles import read_record, write_record
from strapdown.records import ImuRecord, read_attributes

FAULTS = vectors.Faults(latency=0.05, outages=[(0.5, 0.7)])


@pytest.fixture(scope="module")
def simulated():
    base = dataclasses.replace(scenarios.load_scenario("low-orbit"), duration=6.0, gyro_preset="")
    more = (
        vectors.AttitudeSensor(name="tracker / α", sigma_across=1e-4, sigma_about=3e-4, rate=2.0, faults=FAULTS),
        vectors.Accelerometer(name="force", sigma=0.01, rate=3.0, kind="vector"),
        vectors.HeadingPair(name="gnss", baseline_b=[1.0, 0.0, 0.0], sigma=0.01, rate=1.0),
        vectors.VectorSensor(name="rare", reference_f=[1.0, 0.0, 0.0], sigma=0.01, rate=0.01),
    )
    scenario = dataclasses.replace(base, sensors=base.sensors + more)
    return scenario, scenarios.simulate(scenario, 3, 1)


@pytest.fixture
def written(simulated, tmp_path):
    write_record(tmp_path / "record.h5", simulated[1])
    return tmp_path / "record.h5"


def test_hdf5_reads_back_equal_with_all_that_it_holds(simulated, tmp_path):
    scenario, record = simulated
    path = tmp_path / "deep" / "record.h5"
    write_record(path, record)
    back = read_record(path)
    assert not differing(back, record)
    assert back.origin.gyro == scenario.gyro
    assert scenarios.scenario_to_toml(back.origin.scenario) == scenarios.scenario_to_toml(scenario)
    assert (back.origin.seed, back.origin.run) == (3, 1)
    assert read_attributes(path)["version"] == strapdown.__version__
    assert not differing(scenarios.simulate(back.origin.scenario, back.origin.seed, back.origin.run), record)


def test_hdf5_describes_itself(simulated, tmp_path):
    path = tmp_path / "record.h5"
    write_record(path, simulated[1])
    with reading.hdf5(path) as file:
        assert "scalar first" in reading.attributes(file)["conventions"]
        datasets = []
        file.visititems(lambda name, node: datasets.append(node) if isinstance(node, h5py.Dataset) else None)
        assert len(datasets) > 20
        assert all(reading.attributes(node)["unit"] for node in datasets)


def test_a_bare_record_needs_no_extras(tmp_path):
    bare = ImuRecord(time=[0.0, 1.0, 3.0], increments=[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    write_record(tmp_path / "bare.h5", bare)
    back = read_record(tmp_path / "bare.h5")
    assert not differing(back, bare)
    assert back.origin is None


def foreign(path):
    """Make an HDF5 file of another program."""
    with h5py.File(path, "w") as file:
        file["time"] = [1.0]


def edited(change):
    """Return what changes a record's file."""

    def write(path):
        with changed(path) as file:
            change(file)

    return write


def cut(share):
    """Return what truncates a file."""
    return lambda path: path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        *((cut(share), "cannot be read") for share in (0.0, 0.01, 0.3, 0.6, 0.9, 0.999)),
        (foreign, "HDF5 of another program"),
        (
            edited(lambda file: file.attrs.update(kind="strapdown estimate")),
            "a strapdown estimate, not a strapdown record",
        ),
        (edited(lambda file: file.attrs.update(format=2)), "layout 2"),
        (edited(lambda file: file.attrs.pop("format")), "cannot be read"),
        (edited(lambda file: file.pop("increments")), "increments is missing"),
        (edited(lambda file: file.attrs.update(scenario="[motion")), r"record\.h5: scenario is not TOML"),
        (edited(lambda file: file.attrs.update(scenario=3)), "scenario is .*3.*; it must be TOML text"),
        (edited(lambda file: file["truth/attitude"].__setitem__(3, 5.0)), "norm"),
        (edited(lambda file: file.pop("vectors/0/sigma")), r"vectors/0 \(.*\) has no sigma; give each"),
    ],
)
def test_foreign_and_damaged_hdf5_is_refused(written, damage, message):
    damage(written)
    with pytest.raises(InputError, match=message):
        read_record(written)


def test_missing_samples_of_every_kind_go_through_a_file(simulated, tmp_path):
    record = simulated[1]
    holed = []
    for series in record.vectors:
        name = "vector_b" if series.attitude is None else "attitude"
        value = getattr(series, name).copy()
        value[1:2] = np.nan
        holed.append(dataclasses.replace(series, **{name: value}))
    record = dataclasses.replace(record, vectors=tuple(s for s in holed if len(s.time)))
    write_record(tmp_path / "record.h5", record)
    assert not differing(read_record(tmp_path / "record.h5"), record)


def test_the_movement_of_a_truth_goes_through_a_file(simulated, tmp_path):
    record = simulated[1]
    moving = np.arange(len(record.time)) % 3 > 0
    record = dataclasses.replace(record, truth=dataclasses.replace(record.truth, movement=moving))
    write_record(tmp_path / "record.h5", record)
    assert read_record(tmp_path / "record.h5") == record
    with pytest.raises(InputError, match=r"truth.movement has shape .*; give it at each edge"):
        dataclasses.replace(record, truth=dataclasses.replace(record.truth, movement=moving[1:]))


@pytest.mark.parametrize(
    ("where", "name", "value", "words"),
    [
        ("increments", "unit", "deg", r"increments is in 'deg', but must be in 'rad'; convert it"),
        ("truth/bias", "unit", b"deg/h", r"truth/bias is in 'deg/h', but must be in 'rad/s'"),
        ("vectors/0/time", "unit", "ms", r"vectors/0/time is in 'ms', but must be in 's'"),
    ],
)
def test_units_and_conventions_that_contradict_are_refused(simulated, tmp_path, where, name, value, words):
    path = tmp_path / "record.h5"
    write_record(path, simulated[1])
    with changed(path) as file:
        file[where].attrs[name] = value
    with pytest.raises(InputError, match=words):
        read_record(path)
    with changed(path) as file:
        del file[where].attrs[name]
    assert not differing(read_record(path), simulated[1])
