"""Files appear whole or not at all."""

import json
import math
import os
import subprocess
import sys
from contextlib import nullcontext

import pytest

from strapdown.checks import InputError
from strapdown.files import atomic_write, locked, tables, write_json


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_target_appears_only_at_the_end(tmp_path):
    target = tmp_path / "new" / "folder" / "result.png"
    with atomic_write(target) as temporary:
        assert temporary.parent == target.parent
        assert temporary.suffix == ".png"
        assert temporary != target
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert names(target.parent) == ["result.png"]


class Killed(BaseException):
    """Not an Exception, like KeyboardInterrupt."""


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, Killed, OSError])
@pytest.mark.parametrize("before", [["result.json"], []], ids=["old", "first"])
def test_an_interrupted_write_leaves_what_was_there_and_no_temporary(tmp_path, error, before):
    target = tmp_path / "result.json"
    if before:
        target.write_text("old")

    def interrupted() -> None:
        with atomic_write(target) as temporary:
            temporary.write_text("half of the n")
            raise error

    with pytest.raises(error):
        interrupted()
    assert names(tmp_path) == before
    assert not before or target.read_text() == "old"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device of Linux")
def test_a_full_disk_is_reported_with_the_file(tmp_path):
    refused = pytest.raises(OSError, match=r"No space left on device: '\S+result.h5'")
    with refused, atomic_write(tmp_path / "result.h5"), open("/dev/full", "w") as full:
        full.write("content")


def test_two_writers_at_once_do_not_meet(tmp_path):
    target = tmp_path / "result.txt"
    with atomic_write(target) as first, atomic_write(target) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert target.read_text() == "first"  # whose block ended last
    assert names(tmp_path) == ["result.txt"]


def test_write_json(tmp_path):
    content = {"angle_deg": 0.1, "runs": [1, 2], "name": "Größe °/h"}
    write_json(tmp_path / "result.json", content)
    text = (tmp_path / "result.json").read_text(encoding="utf-8")
    assert json.loads(text) == content
    assert text.endswith("}\n")


@pytest.mark.parametrize("bad", [{"x": math.nan}, {"x": [math.inf]}, {"x": object()}])
def test_what_json_cannot_tell_is_refused_and_nothing_is_touched(tmp_path, bad):
    target = tmp_path / "result.json"
    target.write_text("old")
    with pytest.raises((ValueError, TypeError)):
        write_json(target, bad)
    assert target.read_text() == "old"
    assert names(tmp_path) == ["result.json"]
    with pytest.raises((ValueError, TypeError)):
        write_json(tmp_path / "folder" / "result.json", bad)
    assert names(tmp_path) == ["result.json"]


FULL = """
import resource, signal, sys
import numpy as np
from strapdown.recordings.recordfiles import write_record
from strapdown.records import ImuRecord

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # so that a write beyond the limit fails as one on a full disk does
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
increments = np.random.default_rng(1).standard_normal((20_000, 3))
try:
    write_record(sys.argv[1], ImuRecord(time=np.arange(20_001.0), increments=increments))
except OSError as error:
    print("error:", error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of the size of files there")
def test_a_full_disk_is_an_ordinary_error_of_hdf5_too(tmp_path):
    """HDF5 that is stopped in the middle of a file ends the process as it closes it."""
    (tmp_path / "record.h5").write_text("old")
    command = [sys.executable, "-c", FULL, str(tmp_path / "record.h5")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("error: [Errno 27]")
    assert (tmp_path / "record.h5").read_text() == "old"
    assert names(tmp_path) == ["record.h5"]


@pytest.mark.parametrize(("suffix", "factor"), [unit for unit in tables.ARCSECONDS if unit[0] != "rad"])
def test_numbers_of_few_digits_are_written_with_them(suffix, factor):
    """Of a thousand decimal numbers some quotients by the factor have 17 digits; those of few digits give the same number."""
    for number in (k / 1000.0 for k in range(1, 1001)):
        (entry,) = tables._entry("angle", number * factor, ((suffix, factor),)).items()
        assert entry == (f"angle_{suffix}", number)


# ---------------------------------------------------------------------------------------------------- links, permissions


POSIX = pytest.mark.skipif(sys.platform == "win32", reason="links and permissions of POSIX")


@POSIX
@pytest.mark.parametrize("make", [os.symlink, os.link])
@pytest.mark.parametrize("name", [".out.h5.lock", ".out.h5.part"])
def test_links_beside_an_output_do_not_lead_to_what_is_overwritten(tmp_path, name, make):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    make(victim, tmp_path / name)
    target = tmp_path / "out.h5"
    if name.endswith("lock"):
        refused = make is os.symlink
        with (
            pytest.raises(InputError, match=r"\.out\.h5\.lock cannot be locked") if refused else nullcontext(),
            locked(target),
        ):
            pass
        assert not target.exists()
    else:
        with atomic_write(target, durable=True) as temporary:
            temporary.write_text("whole")
        assert target.read_text() == "whole"
    assert victim.read_text() == "precious"


@POSIX
def test_a_pipe_in_the_place_of_the_lock_does_not_stop_the_program(tmp_path):
    os.mkfifo(tmp_path / ".out.h5.lock")
    with locked(tmp_path / "out.h5"):
        pass


@POSIX
@pytest.mark.parametrize(("umask", "mode"), [(0o077, 0o600), (0o022, 0o644), (0o002, 0o664)])
@pytest.mark.parametrize("durable", [False, True])
def test_files_have_the_permissions_of_the_umask_or_of_what_they_replace(tmp_path, umask, mode, durable):
    target = tmp_path / "result.json"
    before = os.umask(umask)
    try:
        for expected in (mode, 0o640):
            with atomic_write(target, durable=durable) as temporary:
                temporary.write_text("{}")
            assert target.stat().st_mode & 0o777 == expected
            target.chmod(0o640)
    finally:
        os.umask(before)


@POSIX
def test_a_link_in_the_place_of_an_output_is_replaced_and_not_followed(tmp_path):
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "result.json").symlink_to(tmp_path / "victim")
    write_json(tmp_path / "result.json", {})
    assert (tmp_path / "victim").read_text() == "precious"
    assert not (tmp_path / "result.json").is_symlink()
