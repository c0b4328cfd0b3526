"""Records in HDF5 and CSV: read back equal, described, and refused where they are not what they should be."""

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
from strapdown.recordings import recordfiles
from strapdown.recordings.recordfiles import export_csv, read_record, write_record
from strapdown.records import ImuRecord, read_attributes

FAULTS = vectors.Faults(latency=0.05, outages=[(0.5, 0.7)])


@pytest.fixture(scope="module")
def made():
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
def written(made, tmp_path):
    write_record(tmp_path / "record.h5", made[1])
    return tmp_path / "record.h5"


def test_hdf5_reads_back_equal_with_all_that_it_holds(made, tmp_path):
    scenario, record = made
    path = tmp_path / "deep" / "record.h5"
    write_record(path, record, attributes={"place": "bench", "weight": 2.5})
    back = read_record(path)
    assert not differing(back, record)
    assert back.origin.gyro == scenario.gyro
    assert scenarios.scenario_to_toml(back.origin.scenario) == scenarios.scenario_to_toml(scenario)
    assert (back.origin.seed, back.origin.run) == (3, 1)
    held = read_attributes(path)
    assert (held["version"], held["place"], held["weight"]) == (strapdown.__version__, "bench", 2.5)
    assert not differing(scenarios.simulate(back.origin.scenario, back.origin.seed, back.origin.run), record)


def test_the_scenario_of_a_file_is_read_when_it_is_asked_for(made, tmp_path, monkeypatch):
    write_record(tmp_path / "record.h5", made[1])
    asked = []
    wanted = scenarios.scenario_from_toml
    monkeypatch.setattr(scenarios, "scenario_from_toml", lambda *given: (asked.append(given[1]), wanted(*given))[1])
    origin = read_record(tmp_path / "record.h5").origin
    assert asked == []
    assert origin.scenario is origin.scenario
    assert asked == [f"{tmp_path / 'record.h5'}: scenario"]
    with changed(tmp_path / "record.h5") as file:
        file.attrs["scenario"] = "[motion"
    with pytest.raises(InputError, match=r"record\.h5: scenario"):
        read_record(tmp_path / "record.h5").origin.scenario.gyro  # noqa: B018


def test_hdf5_describes_itself(made, tmp_path):
    path = tmp_path / "record.h5"
    write_record(path, made[1])
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
    export_csv(tmp_path / "bare.csv", bare)
    assert not differing(read_record(tmp_path / "bare.csv"), bare)


def test_csv_reads_back_equal(made, tmp_path):
    written = export_csv(tmp_path / "record.csv", made[1])
    assert len(written) == 1 + len(made[1].vectors)
    record = made[1]
    # A constant reference of an empty series is the one thing that CSV cannot tell.
    kept = dataclasses.replace(record, vectors=tuple(s for s in record.vectors if len(s.time)))
    back = read_record(written[0])
    assert not differing(dataclasses.replace(back, vectors=tuple(s for s in back.vectors if len(s.time))), kept)


def test_csv_reads_as_many_series_as_the_record_has(made, tmp_path):
    """Not what an earlier, larger record of the same name left behind, and not fewer."""
    fewer = dataclasses.replace(made[1], vectors=made[1].vectors[:1])
    export_csv(tmp_path / "record.csv", made[1])
    written = export_csv(tmp_path / "record.csv", fewer)
    assert not differing(read_record(written[0]), fewer)
    written[1].unlink()
    with pytest.raises(InputError, match=r"record-vectors-0.csv does not exist, one of 1 vector series of record.csv"):
        read_record(written[0])
    # A file that does not say has what is numbered in turn.
    first, rest = written[0].read_text().split("\n", 1)
    written[0].write_text("# strapdown record\n" + rest)
    assert "1 vector series" in first
    assert read_record(written[0]).vectors == ()


def test_what_csv_cannot_hold_is_refused_before_anything_is_written(made, tmp_path):
    *others, last = (series for series in made[1].vectors if series.kind == "direction")
    uneven = dataclasses.replace(last, sigma=np.zeros(len(last.time)), sigma_axes=np.array([1e-3, 2e-3, 3e-3]))
    record = dataclasses.replace(made[1], vectors=(*others, uneven))
    with pytest.raises(InputError, match=f"{last.sensor}: CSV has no columns for sigma_axes or covariance; write HDF5"):
        export_csv(tmp_path / "record.csv", record)
    assert not list(tmp_path.iterdir())


def foreign(**attributes):
    """Return what makes an HDF5 file of another program."""

    def write(path):
        with h5py.File(path, "w") as file:
            file["time"] = [1.0]
            file.attrs.update(attributes)

    return write


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
        (lambda path: path.unlink(), "does not exist"),
        *((cut(share), "cannot be read") for share in (0.0, 0.01, 0.3, 0.6, 0.9, 0.999)),
        (lambda path: path.write_text("time,x\n1,2\n"), "cannot be read"),
        (foreign(), "HDF5 of another program"),
        (foreign(kind="strapdown estimate"), "a strapdown estimate, not a strapdown record"),
        (edited(lambda file: file.attrs.update(format=2)), "layout 2"),
        (edited(lambda file: file.attrs.pop("format")), "cannot be read"),
        (edited(lambda file: file.pop("increments")), "increments is missing"),
        (edited(lambda file: file["truth/attitude"].__setitem__(3, 5.0)), "norm"),
        (edited(lambda file: file.pop("vectors/0/sigma")), r"vectors/0 \(.*\) has no sigma; give each"),
    ],
)
def test_foreign_and_damaged_hdf5_is_refused(written, damage, message):
    damage(written)
    with pytest.raises(InputError, match=message):
        read_record(written)


def test_a_failed_write_leaves_the_old_file(made, tmp_path):
    path = tmp_path / "record.h5"
    write_record(path, made[1])
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_record(path, made[1], attributes={"thing": object()})
    with pytest.raises(InputError, match="choose another name"):
        write_record(path, made[1], attributes={"seed": 3})
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["record.h5"]


def test_foreign_and_damaged_csv_is_refused(made, tmp_path):
    path = tmp_path / "record.csv"
    with pytest.raises(InputError, match="does not exist"):
        read_record(path)
    export_csv(path, made[1])
    lines = path.read_text().splitlines()
    for content, message in (
        ("", "cannot be read as HDF5"),
        ("a,b\n1,2\n", "cannot be read as HDF5"),
        ("\n".join([lines[0], "time_s,x", "1,2"]), "columns"),
        ("\n".join([*lines[:5], lines[5][:40]]), "line 6"),
        ("\n".join([*lines[:4], lines[4].replace(lines[4].split(",")[2], "abc")]), "line 5"),
        ("\n".join(["# strapdown vectors {}", *lines[1:]]), "not a record"),
        ("\n".join(lines[:3]), "at least 2"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match=message):
            read_record(path)
    path.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError, match="cannot be read"):
        read_record(path)
    export_csv(path, made[1])
    beside = tmp_path / "record-vectors-1.csv"
    for content in (beside.read_text().replace('"magnetometer"', "magnetometer"), path.read_text()):
        beside.write_text(content)
        with pytest.raises(InputError, match=r"vectors-1.csv is not a vector series"):
            read_record(path)
    assert recordfiles.KIND == "strapdown record"


def test_a_row_without_an_increment_is_named_with_what_to_do(tmp_path):
    path = tmp_path / "record.csv"
    export_csv(path, ImuRecord(time=np.arange(5.0), increments=np.arange(12.0).reshape(4, 3)))
    lines = path.read_text().splitlines()
    cells = lines[4].split(",")
    path.write_text("\n".join([*lines[:4], ",".join([*cells[:2], "nan", cells[3]]), *lines[5:]]))
    with pytest.raises(InputError, match="line 5: increment_y_rad is nan; leave the row out"):
        read_record(path)
    path.write_text("\n".join([*lines[:4], *lines[5:]]))
    np.testing.assert_array_equal(read_record(path).time, [0.0, 1.0, 3.0, 4.0])


def test_missing_samples_of_every_kind_go_through_both_files(made, tmp_path):
    record = made[1]
    holed = []
    for series in record.vectors:
        name = "vector_b" if series.attitude is None else "attitude"
        value = getattr(series, name).copy()
        value[1:2] = np.nan
        holed.append(dataclasses.replace(series, **{name: value}))
    record = dataclasses.replace(record, vectors=tuple(s for s in holed if len(s.time)))
    write_record(tmp_path / "record.h5", record)
    assert not differing(read_record(tmp_path / "record.h5"), record)
    assert not differing(read_record(export_csv(tmp_path / "record.csv", record)[0]), record)


def test_csv_cut_at_the_end_of_a_line_is_refused(made, tmp_path):
    written = export_csv(tmp_path / "record.csv", made[1])
    empty = next(k for k, series in enumerate(made[1].vectors) if not len(series.time))
    assert read_record(written[0]).vectors[empty].time.shape == (0,)
    for path in written[:2]:
        whole = path.read_text()
        lines = whole.splitlines()
        for cut in (lines[:-1], lines[:-2], [*lines, lines[-1].replace(lines[-1].split(",")[0], "1e3", 1)]):
            path.write_text("\n".join(cut) + "\n")
            with pytest.raises(
                InputError, match=rf"{path.name} ends at .* s, but its first line states .* s; it was truncated or"
            ):
                read_record(written[0])
        path.write_text(whole)
    lines = written[1].read_text().splitlines()
    written[1].write_text("\n".join(lines[:2]) + "\n")
    with pytest.raises(InputError, match=r"record-vectors-0.csv ends at None s"):
        read_record(written[0])


def test_csv_leaves_no_series_of_an_earlier_record(made, tmp_path):
    earlier = export_csv(tmp_path / "record.csv", made[1])
    other = tmp_path / f"record-vectors-{len(made[1].vectors)}.csv"
    other.write_text("of another program\n")
    fewer = dataclasses.replace(made[1], vectors=made[1].vectors[:1])
    assert export_csv(tmp_path / "record.csv", fewer) == earlier[:2]
    assert sorted(tmp_path.iterdir()) == sorted([*earlier[:2], other])


def test_csv_says_how_it_was_made_as_hdf5_does(made, tmp_path):
    scenario, record = made
    path = export_csv(tmp_path / "record.csv", record)[0]
    back = read_record(path).origin
    assert recordfiles.is_record(path)
    assert (back.gyro, back.seed, back.run) == (scenario.gyro, 3, 1)
    assert scenarios.scenario_to_toml(back.scenario) == scenarios.scenario_to_toml(scenario)
    first, rest = path.read_text().split("\n", 1)
    path.write_text(first.replace('"seed"', '"sead"') + "\n" + rest)
    with pytest.raises(InputError, match="line 1: the origin of the record cannot be read"):
        read_record(path)
    export_csv(path, dataclasses.replace(record, origin=None))
    assert read_record(path).origin is None


@pytest.mark.parametrize(
    ("where", "name", "value", "words"),
    [
        ("increments", "unit", "deg", r"increments is in 'deg', but must be in 'rad'; convert it"),
        ("truth/bias", "unit", b"deg/h", r"truth/bias is in 'deg/h', but must be in 'rad/s'"),
        ("vectors/0/time", "unit", "ms", r"vectors/0/time is in 'ms', but must be in 's'"),
        ("/", "conventions", "quaternions scalar last", r"follows other conventions \(quaternions scalar last\)"),
    ],
)
def test_units_and_conventions_that_contradict_are_refused(made, tmp_path, where, name, value, words):
    path = tmp_path / "record.h5"
    write_record(path, made[1])
    with changed(path) as file:
        file[where].attrs[name] = value
    with pytest.raises(InputError, match=words):
        read_record(path)
    with changed(path) as file:
        del file[where].attrs[name]
    assert not differing(read_record(path), made[1])
