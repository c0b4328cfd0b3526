"""The one layer that every file passes: what it lets through, and what it refuses in time and by name."""

import dataclasses
import gc
import json
import os
import random
import shutil
import subprocess
import sys
import time
import tracemalloc
import warnings
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from hdf5 import changed
from targets import targets

import strapdown
from strapdown import coning, files, montecarlo, recordings, records, report, scenarios
from strapdown.checks import InputError
from strapdown.files import reading
from strapdown.montecarlo import campaign, engine
from strapdown.recordings import recordfiles
from strapdown.records import ImuRecord
from strapdown.report import page, tunings

UNITS = {"gyro": "rad/s"}


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return {target.name: target for target in targets(tmp_path_factory.mktemp("known"))}


# --------------------------------------------------------------------------------------------------------- no regular files


KINDS = ("record.h5", "estimate.h5", "campaign.h5", "broad.hdf5", "walk.csv", "gyro.npy", "scenario.toml")
KINDS += ("filter.toml", "gyro.toml", "dispersions.toml", "vibration.csv", "tuning.json")


@pytest.mark.parametrize("name", KINDS)
def test_what_is_no_regular_file_is_refused_at_once(known, tmp_path, name):
    """A pipe that nobody writes to would block for ever, /dev/zero never end."""
    path, begun = tmp_path / name, time.process_time()  # a pipe would hold the test itself
    held = len(os.listdir("/dev/fd"))
    with pytest.raises(InputError, match=rf"{name}.*does not exist"):
        known[name].read(path)
    path.mkdir()
    with pytest.raises(InputError, match=rf"{name} is a folder"):
        known[name].read(path)
    path.rmdir()
    os.mkfifo(path)
    with pytest.raises(InputError, match=rf"{name} is not a regular file but a pipe or a device"):
        known[name].read(path)
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(InputError, match=rf"{name} is not a regular file but a pipe or a device"):
        known[name].read(path)
    path.unlink()
    path.symlink_to(path)
    with pytest.raises(InputError, match=rf"{name}"):
        known[name].read(path)
    assert time.process_time() - begun < 2.0
    assert len(os.listdir("/dev/fd")) == held


def test_a_path_that_is_not_utf8_is_read_and_named(known, tmp_path):
    path = tmp_path / os.fsdecode(b"w\xff.csv")
    path.write_bytes(known["walk.csv"].content)
    assert len(recordings.read(path).time) == 20
    with records.result_file(tmp_path / "again.h5", "record", {"note": str(path)}):
        pass
    assert records.read_attributes(tmp_path / "again.h5")["note"] == str(tmp_path / "w\\udcff.csv")
    tuning = tmp_path / os.fsdecode(b"t\xff.json")
    tuning.write_bytes(known["tuning.json"].content)
    assert report.write(tuning).page.stat().st_size > 1000


def _written(path) -> Path:
    increments = np.random.default_rng(2).standard_normal((2000, 3))
    origin = records.Origin(scenario=scenarios.load_scenario("two-stars"), seed=3)
    recordfiles.write_record(path, ImuRecord(time=np.arange(2001.0), increments=increments, origin=origin))
    return path


# --------------------------------------------------------------------------------------------------------------------- sizes


def test_an_array_that_declares_more_than_it_holds_is_refused(tmp_path):
    path = tmp_path / "bomb.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (300_000_000, 3)})
    with pytest.raises(InputError, match=r"bomb\.npy cannot be read \("):
        recordings.read_samples(path, "gyro", rate=100.0, units=UNITS)


ZEROS = zlib.compress(bytes(24_000_000))
"""A chunk of a million rows."""


@pytest.mark.parametrize("sealed", [True, False])
@pytest.mark.parametrize(
    ("rows", "stored", "words"),
    [
        (300_000_000, 0, "increments declares 7200 MB, but the file has 0 MB of it"),
        (12_000_000, 12_000_000, "has 0.* MB and unpacks to 288 MB"),
    ],
)
def test_a_dataset_of_more_than_a_file_can_hold_is_refused_before_memory_is_taken(
    tmp_path, sealed, rows, stored, words
):
    path = _written(tmp_path / "bomb.h5")
    with changed(path) as file:
        del file["increments"]
        chunks = (1_000_000, 3)
        bomb = file.create_dataset("increments", shape=(rows, 3), dtype="f8", chunks=chunks, compression="gzip")
        for first in range(0, stored, chunks[0]):
            bomb.id.write_direct_chunk((first, 0), ZEROS)
    if not sealed:
        _of_another_program(path)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=rf"bomb\.h5.* {words}"), reading.hdf5(path):
            pass
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def processor_seconds(read) -> float:
    """Processor time of a call; the garbage of other tests is not collected in it."""
    gc.disable()
    try:
        begun = time.process_time()
        read()
        return time.process_time() - begun
    finally:
        gc.enable()


@pytest.mark.parametrize(
    ("name", "begin", "unit", "end"),
    [
        ("scenario.toml", "a = ", "[", "\n"),
        ("tuning.json", "", "[", ""),
        ("walk.csv", "time,gx,gy,gz", ",a", "\n1,2,3,4\n"),
        ("walk.csv", "time,gx,gy,gz\n", "x", "\n"),
        ("walk.csv", "time,gx,gy,gz\n1,2,3,", "9", "\n"),
        ("vibration.csv", "", "frequency_hz,", "a\n"),
        ("vibration.csv", "", "\0", ""),
    ],
)
def test_reading_takes_time_in_proportion_to_the_size(known, tmp_path, name, begin, unit, end):
    path = tmp_path / name

    def refused():
        with pytest.raises(InputError, match=name) as refusal:
            known[name].read(path)
        assert len(str(refusal.value)) < 5000

    for _ in range(3):  # what else the machine does only adds to a time: one attempt within the bounds is enough
        took = []
        for number in (12_500, 50_000) if unit == ",a" else (50_000, 200_000):  # columns take longest
            path.write_text(begin + unit * number + end)
            took.append(processor_seconds(refused))
        if took[1] < min(8.0 * took[0] + 0.5, 5.0):
            break
    assert took[1] < 8.0 * took[0] + 0.5
    assert took[1] < 5.0


def test_a_csv_of_many_columns_is_read(tmp_path):
    path = tmp_path / "wide.csv"
    extra = 20_000
    rows = "".join(f"{k},1,2,3{',0' * extra}\n" for k in range(3))
    path.write_text("time,gx [deg/s],gy,gz," + ",".join(f"c{k}" for k in range(extra)) + "\n" + rows)
    captured = []
    assert processor_seconds(lambda: captured.append(recordings.read(path))) < 1.2
    assert captured[0].rate.shape == (3, 3)


# --------------------------------------------------------------------------------------------------------------------- links


def _external(file):
    file["truth/bias"] = h5py.ExternalLink("neighbour.h5", "/truth/bias")


def _soft(file):
    file["truth/bias"] = h5py.SoftLink("/increments")


def _virtual(file):
    layout = h5py.VirtualLayout(shape=(2001, 3), dtype="f8")
    layout[:] = h5py.VirtualSource("neighbour.h5", "truth/bias", shape=(2001, 3))
    file.create_virtual_dataset("truth/bias", layout)


def _external_storage(file):
    file.create_dataset("truth/bias", shape=(2001, 3), dtype="f8", external=[("neighbour.raw", 0, 2001 * 24)])


@pytest.mark.parametrize("sealed", [True, False])
@pytest.mark.parametrize(
    ("refer", "words"),
    [
        (_external, "truth/bias is a link, which is not followed"),
        (_soft, "truth/bias is a link, which is not followed"),
        (_virtual, "truth/bias is stored in other files, which are not read"),
        (_external_storage, "truth/bias is stored in other files, which are not read"),
    ],
)
def test_data_of_other_files_are_refused(tmp_path, refer, words, sealed):
    truth = records.Truth(attitude=np.tile([1.0, 0.0, 0.0, 0.0], (2001, 1)), bias=np.ones((2001, 3)))
    record = ImuRecord(time=np.arange(2001.0), increments=np.zeros((2000, 3)), truth=truth)
    recordfiles.write_record(tmp_path / "neighbour.h5", record)
    (tmp_path / "neighbour.raw").write_bytes(bytes(2001 * 24))
    recordfiles.write_record(tmp_path / "record.h5", record)
    with changed(tmp_path / "record.h5") as file:
        del file["truth/bias"]
        refer(file)
    if not sealed:
        _of_another_program(tmp_path / "record.h5")
    with pytest.raises(InputError, match=rf"record\.h5: {words}"), reading.hdf5(tmp_path / "record.h5"):
        pass


@pytest.mark.parametrize("name", ["filter.toml", "errors.png"])
def test_a_report_does_not_show_what_a_link_beside_the_result_leads_to(known, tmp_path, name):
    (tmp_path / "secret").write_bytes(b"\x89PNG\r\n\x1a\n secret")
    (tmp_path / "filter.json").write_bytes(known["tuning.json"].content)
    beside = tmp_path / name
    beside.write_bytes((tmp_path / "secret").read_bytes() if name.endswith("png") else b"[filter]\n")
    show = lambda: (tunings.report(tmp_path / "filter.json"), page.stored_figure(tmp_path / "errors", "errors"))  # noqa: E731
    assert show()
    beside.unlink()
    beside.symlink_to(tmp_path / "secret")
    with pytest.raises(InputError, match=rf"{name} is a symbolic link"):
        show()


def test_what_lies_beside_a_result_and_is_no_figure_is_not_shown(tmp_path):
    (tmp_path / "errors.png").write_bytes(b"root:x:0:0")
    with pytest.raises(InputError, match=r"errors\.png is not a PNG"):
        page.stored_figure(tmp_path / "errors", "errors")


def test_a_file_that_the_user_names_may_be_a_link(tmp_path):
    (tmp_path / "link.h5").symlink_to(_written(tmp_path / "record.h5"))
    assert len(recordfiles.read_record(tmp_path / "link.h5").time) == 2001


# -------------------------------------------------------------------------------------------------------------------- digest


def _of_another_program(path: Path) -> None:
    """Write a file anew as another program does: no digest and no kind, texts of variable length."""
    content = path.read_bytes()
    with h5py.File(path, "r") as source, h5py.File(path.with_suffix(".new"), "w") as file:
        for name in source:
            source.copy(name, file, expand_soft=False, expand_external=False)
        for name, value in reading.attributes(source).items():
            file.attrs[name] = value
        texts = []
        file.visititems(lambda name, node: texts.extend((node, key) for key in node.attrs))
        for node, key in texts:
            value = reading.attributes(node)[key]
            del node.attrs[key]
            node.attrs[key] = value
        del file.attrs["kind"]
    path.with_suffix(".new").replace(path)
    assert content.startswith(reading.SEAL)
    assert not path.read_bytes().startswith(reading.SEAL)


def test_a_written_file_is_hdf5_to_others_with_its_digest_in_front(tmp_path):
    content = _written(tmp_path / "record.h5").read_bytes()
    line = content.split(b"\n")[0].decode()
    digest = (
        subprocess.run(["sha256sum"], input=content[512:], capture_output=True, check=True).stdout.split()[0].decode()
    )
    assert line == f"strapdown file, SHA-256 of the bytes from 512 on: {digest}"
    assert content[512:520] == b"\x89HDF\r\n\x1a\n"
    assert b"GCOL" not in content  # the heap of texts of variable length
    with h5py.File(tmp_path / "record.h5") as file:
        assert file.userblock_size == 512
        assert file.attrs["kind"].decode() == "strapdown record"
    long = "é" * 100_000
    with records.result_file(tmp_path / "long.h5", "record", {"text": long, "empty": "", "list": ["a", "é", ""]}):
        pass
    held = records.read_attributes(tmp_path / "long.h5")
    assert [held[name] for name in ("text", "empty", "list")] == [long, "", ["a", "é", ""]]


def test_every_bit_counts(tmp_path):
    content = bytearray(_written(tmp_path / "record.h5").read_bytes())
    chance, path = random.Random(3), tmp_path / "flipped.h5"
    begin = len(reading.SEAL)
    places = [8 * begin + bit for bit in range(8 * 64)] + [
        chance.randrange(8 * 512, 8 * len(content)) for _ in range(500)
    ]
    for bit in places:
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"flipped\.h5 cannot be read: its content does not match its digest"):
            recordfiles.read_record(path)
        content[bit // 8] ^= 1 << bit % 8


def test_a_file_changed_on_purpose_gets_a_new_digest(tmp_path):
    path = _written(tmp_path / "record.h5")
    with h5py.File(path, "r+") as file:
        file.attrs["place"] = 5.0
    with pytest.raises(InputError, match=r"if you changed it on purpose, strapdown\.files\.seal"):
        recordfiles.read_record(path)
    files.seal(path)
    assert records.read_attributes(path)["place"] == 5.0
    _of_another_program(path)
    with pytest.raises(InputError, match=r"record\.h5 has no digest; only a file written by this version has one"):
        files.seal(path)


# ----------------------------------------------------------------------------------------------------- wrong types, raw counts


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('boresight = "z"', "boresight = [0, 0, 0]", r"sensors\[0\]: .*boresight"),
        ('name = "tracker"', "name = 5", r"sensors\[0\]"),
        ('name = "tracker"', "name = [1]", r"sensors\[0\]"),
        ("rate_hz = 1.0", 'rate_hz = "1"', "rate_hz is '1'; it must be a number"),
        ("rate_hz = 1.0", "rate_hz = 1979-05-27", "rate_hz is datetime.*; it must be a number"),
        ("rate_hz = 1.0", "rate_hz = true", "rate_hz is True; it must be a number"),
        ("rate_hz = 1.0", f"rate_hz = {'9' * 400}", "rate_hz"),
        ("rate_hz = 1.0", "rate_hz = [1.0, 2.0]", "rate"),
        ("outages_s = [[1.0, 2.0]]", "outages_s = [[1.0], [2.0, 3.0]]", "outages_s is .*rows of equal length"),
        ("outages_s = [[1.0, 2.0]]", "outages_s = 1.0", "outages"),
        ("[motion]", "name = 5\n[motion]", "name is 5; it must be a string"),
        ("[motion]", "sensor = 5\n[motion]", "key 'sensor' is not known"),
    ],
)
def test_a_scenario_of_wrong_types_is_refused_with_its_place(known, tmp_path, old, new, words):
    path = tmp_path / "attitude.toml"
    content = known["attitude.toml"].content.decode()
    if "name =" in new and "motion" in new:
        content = "\n".join(line for line in content.split("\n") if not line.startswith('name = "slew'))
    assert old in content
    path.write_text(content.replace(old, new, 1))
    with pytest.raises(InputError, match=rf"attitude\.toml.*{words}"):
        scenarios.load_scenario(path)


def test_raw_counts_are_refused_before_they_are_integrated(tmp_path):
    rows = "".join(f"{0.01 * k:.2f},{-3000 + k},5,7\n" for k in range(50))
    (tmp_path / "raw.csv").write_text("time,gx [rad/s],gy,gz\n" + rows)
    with pytest.raises(
        InputError, match=r"raw\.csv: rate\[0, 0\] is -3000 rad/s, which no gyro measures; convert raw counts"
    ):
        recordings.read(tmp_path / "raw.csv")


# --------------------------------------------------------------------------------------------------------------- two writers


HOLD = """
import sys, time
from strapdown.files import locked
with locked(sys.argv[1]):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_of_two_processes_on_one_output_the_second_is_reported_who_writes(known, tmp_path):
    path = tmp_path / "runs.h5"
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "locked\n"
    plan = campaign.read(tmp_path_of(known, tmp_path)).plan
    begun = time.monotonic()
    with pytest.raises(InputError, match=r"runs\.h5 is being written by another process; wait for it, or"):
        campaign.run(plan, path, runs=4)
    assert time.monotonic() - begun < 5.0
    assert [file.name for file in tmp_path.iterdir() if "runs" in file.name] == [".runs.h5.lock"]
    other.kill()
    other.communicate()
    with (
        files.locked(path),
        pytest.raises(InputError, match=r"runs\.h5 is being written by another process"),
        files.locked(path),
    ):
        pass
    assert not list(tmp_path.glob(".runs*"))


def tmp_path_of(known, tmp_path) -> Path:
    (tmp_path / "campaign.h5").write_bytes(known["campaign.h5"].content)
    return tmp_path / "campaign.h5"


# ------------------------------------------------------------------------------------------------------------ the processor


def test_a_campaign_goes_on_only_on_a_processor_that_rounds_alike(known, tmp_path, monkeypatch):
    path = tmp_path_of(known, tmp_path)
    plan = campaign.read(path).plan
    held = campaign.read(path)
    campaign._write(path, dataclasses.replace(held, identity=engine.identity()))
    assert campaign.read(path).identity == engine.identity()
    assert campaign.run(plan, path, runs=4, resume=True, chunk=4, machine="lanes").finished
    here = engine.identity()
    for change, words in (
        (
            {"arithmetic": "x86_64, no FMA"},
            r"arithmetic is \w+, .* there and x86_64, no FMA here",
        ),
        ({"sources": "0123"}, r"sources is \w+ there and 0123 here; continue it with the strapdown that began it, or"),
        ({"version": "0.0.9"}, r"version is \S+ there and 0\.0\.9 here; continue it with the strapdown"),
    ):
        monkeypatch.setattr(campaign, "identity", lambda change=change: here._replace(**change))
        with pytest.raises(InputError, match=f"another campaign; {words}"):
            campaign.run(plan, path, runs=4, resume=True, chunk=4, machine="lanes")


def test_the_digest_of_the_sources_is_of_all_that_computes(tmp_path, monkeypatch):
    package = tmp_path / "strapdown"
    shutil.copytree(Path(strapdown.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(strapdown, "__file__", str(package / "__init__.py"))
    digest = engine.sources.__wrapped__
    before = digest()
    assert before == engine.sources()
    for name in ("__init__.py", "kernels/algebra.py", "montecarlo/lanes.py", "scenarios/__init__.py"):
        (package / name).write_text((package / name).read_text() + "# edited\n")
        assert digest() != before, name
        before = digest()
    (package / "cli" / "__init__.py").write_text("# edited\n")
    assert digest() == before
    (package / "quaternion.py").rename(package / "quaternions.py")
    assert digest() != before


def test_the_arithmetic_names_fused_multiply_add():
    parts = engine.arithmetic().split(", ")
    assert len(parts) == 2
    assert parts[1] in ("FMA", "no FMA")
    cpu = Path("/proc/cpuinfo")
    if parts[0] == "x86_64" and cpu.exists():
        flags = next(line for line in cpu.read_text().splitlines() if line.startswith("flags")).split()
        assert (parts[1] == "FMA") == ("fma" in flags)


# -------------------------------------------------------------------------------------------------------- the command line


def test_ctrl_c_while_the_program_is_loaded_is_no_traceback(tmp_path):
    (tmp_path / "typer.py").write_text("raise KeyboardInterrupt\n")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", ""), str(Path.cwd())]),
    }
    done = subprocess.run(
        [sys.executable, "-m", "strapdown", "info"], capture_output=True, text=True, env=environment, check=False
    )
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


@pytest.mark.parametrize(
    "content", [b"", b"[]", b'"x"', b"{}", b"nan", b"\xff", b'{"records": 5}', b'{"records": ["a"], "parameters": {}}']
)
def test_a_json_that_is_no_tuning_is_refused_with_its_place(tmp_path, content):
    (tmp_path / "tuning.json").write_bytes(content)
    with pytest.raises(InputError, match=r"tuning\.json"):
        report.write(tmp_path / "tuning.json")


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("report", "verdict"), "good", r"report\.verdict 'good' is not known"),
        (("report", "tables", 0, "rows"), [["star", 2]], "what is no text"),
        (("report", "tables", 0, "left"), "1", "what is no text"),
        (("report", "tables"), [{"rows": []}], "missing 3 required positional arguments|missing .* 'title'"),
        (("records",), 5, "must be an iterable"),
    ],
)
def test_a_tuning_with_a_damaged_report_is_refused(known, tmp_path, place, value, words):
    tuning = entry = json.loads(known["tuning.json"].content)
    for key in place[:-1]:
        entry = entry[key]
    entry[place[-1]] = value
    (tmp_path / "tuning.json").write_text(json.dumps(tuning))
    with pytest.raises(InputError, match=rf"tuning\.json: .*({words}).* does not fit a tuning"):
        report.write(tmp_path / "tuning.json")


def test_readers_of_vibration_and_dispersions_name_the_file(tmp_path):
    (tmp_path / "v.csv").write_bytes(b"frequency_hz,angle_deg\n10,\xff\n")
    with pytest.raises(InputError, match=r"v\.csv cannot be read as text"):
        coning.read_vibration(tmp_path / "v.csv")
    (tmp_path / "d.toml").write_text("[dispersions]\nattitude_sigma_deg = [1, 2]\n")
    with pytest.raises(InputError, match=r"d\.toml.*attitude_sigma"):
        montecarlo.read_dispersions(tmp_path / "d.toml")


def test_a_fault_in_compiling_is_not_blamed_on_the_file(tmp_path):
    """A reader's handler of exceptions may be around a first call of a kernel."""
    import numba

    broken = numba.njit(lambda x: x.nothing)
    with pytest.raises(numba.TypingError), reading.from_file(tmp_path / "record.h5"):
        broken(1.0)


def test_a_damaged_cache_of_kernels_is_one_line_of_warning_in_the_program(known, tmp_path, run, monkeypatch):
    from strapdown.kernels.cache import CacheWarning

    (tmp_path / "walk.csv").write_bytes(known["walk.csv"].content)
    read = recordings.read

    def warned(*arguments, **options):
        warnings.warn(CacheWarning("a kernel was damaged"), stacklevel=1)
        return read(*arguments, **options)

    monkeypatch.setattr(recordings, "read", warned)
    assert run("integrate", "walk.csv")[::2] == (0, "warning: a kernel was damaged\n")
