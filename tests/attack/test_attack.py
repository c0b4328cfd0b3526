"""Damaged and hostile files: read right or refused by name, in time, with nothing wrong without a word.

``pytest tests/attack --attack-files 1000000 --attack-log signatures.txt`` makes more of them, and writes what was found.
"""

from __future__ import annotations

import collections
import os
import random
import resource
import shutil
import signal
import tempfile
import traceback
import warnings
from pathlib import Path

import pytest
from targets import Target, targets

from strapdown.checks import InputError
from strapdown.files.reading import BLOCK, SEAL

DEFAULT = 10_000
CPU_SECONDS = 45.0
HANG_SECONDS = 8.0
"""Of the processor, for each file."""
MEMORY = 1_000_000
"""Kilobytes that the process may grow by."""


CAUSES: collections.Counter[str] = collections.Counter()
"""What refusals came from, for the log: many of one kind want a message of their own."""


class HangError(BaseException):
    """A reader took too long."""


def signature(error: BaseException) -> str:
    """Where an error came from, for the log: one kind a place."""
    # Without the lines of the source, which take longer than to read a file.
    codes = [frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)]
    inside = [code for code in codes if "strapdown/" in code.co_filename]
    place = f" at {Path(inside[-1].co_filename).name}:{inside[-1].co_name}" if inside else ""
    return f"{type(error).__name__}{place}"


def fault(target: Target, path: Path, content: bytes, damage: str) -> tuple[str, str]:
    """What happened to a damaged file, and what is wrong with it; the second is empty where nothing is."""
    signal.setitimer(signal.ITIMER_PROF, HANG_SECONDS)
    try:
        target.read(path)
    except InputError as error:
        said = str(error)
        CAUSES[signature(error.__cause__) if error.__cause__ else "a message of its own"] += 1
        if path.name not in said:
            return "refused", f"refusal does not name the file: {signature(error)}: {said[:100]}"
        return "refused", "" if len(said) < 3000 else f"message of {len(said)} characters: {signature(error)}"
    except HangError as error:
        return "hung", f"hang: {signature(error)}"
    except Exception as error:
        return "broke", f"{signature(error)}: {str(error)[:100]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    own = target.content
    sealed = own.startswith(SEAL) and damage != "change_hdf5"
    mark = len(SEAL) + 64  # what follows in the user block is never read
    if sealed and (content[:mark], content[BLOCK:]) != (own[:mark], own[BLOCK:]):
        return "read", "damage was read as data"
    return "read", ""


@pytest.fixture
def folder(tmp_path):
    """A folder for the damaged files: in memory where there is room, for to make a file on a disk costs as much as to read it."""
    memory = Path("/dev/shm")
    roomy = memory.is_dir() and os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > 1 << 30
    with tempfile.TemporaryDirectory(dir=memory if roomy else tmp_path) as name:
        yield Path(name)


def cpu_seconds() -> float:
    return sum(
        resource.getrusage(who).ru_utime + resource.getrusage(who).ru_stime
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )


def test_damaged_files_are_read_right_or_refused_by_name(tmp_path, folder, request):
    number = request.config.getoption("--attack-files") or DEFAULT
    chance = random.Random(request.config.getoption("--attack-seed"))
    known = targets(tmp_path)
    for target in known:
        target.read(tmp_path / target.name)  # whole, each is read
    faults: collections.Counter[str] = collections.Counter()
    outcomes: collections.Counter[str] = collections.Counter()

    def alarm(number: int, frame: object) -> None:
        raise HangError

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    before, begun = signal.signal(signal.SIGPROF, alarm), cpu_seconds()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for k in range(number):
                (target,) = chance.choices(known, [candidate.share for candidate in known])
                change = chance.choice(target.damages)
                content = change(chance, target.content)
                while content == target.content:  # no damage: zeros for zeros
                    content = change(chance, target.content)
                path = folder / f"{k % 64}-{target.name}"
                path.write_bytes(content)
                outcome, wrong = fault(target, path, content, change.__name__)
                outcomes[f"{target.name} {change.__name__} {outcome}"] += 1
                memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                if memory > most + MEMORY:
                    wrong, most = f"{(memory - most) / 1e6:.1f} GB of memory", memory
                if wrong:
                    faults[f"{target.name} {change.__name__}: {wrong}"] += 1
                    if request.config.getoption("--attack-log"):
                        (tmp_path / f"fault-{k}-{target.name}").write_bytes(content)
    finally:
        signal.signal(signal.SIGPROF, before)
    spent = cpu_seconds() - begun
    log = request.config.getoption("--attack-log")
    if log:
        lines = [f"{number} files, {spent:.1f} CPU-seconds"]
        lines += [
            f"{count:8d} {what}" for counter in (faults, outcomes, CAUSES) for what, count in counter.most_common()
        ]
        Path(log).write_text("\n".join(lines) + "\n")
    assert not faults, "\n".join(f"{count} {what}" for what, count in faults.most_common(40))
    assert spent < CPU_SECONDS * number / DEFAULT
    kinds = {target.name for target in known}
    for outcome in ("read", "refused"):  # or the damage is no damage, or nothing else than damage
        names = {name.split()[0] for name in outcomes if name.endswith(outcome)}
        assert names >= kinds - ({"record.h5", "estimate.h5", "campaign.h5"} if outcome == "read" else set())
